"""The last stage of a factorized image: leaves are backprojected from their virtual channels.

On a plane they are formed in tiles (`PlaneLeaves`), elsewhere in groups of points
(`SurfaceLeaves`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsas.engine.data.beam import INTERVALS, normalising
from clsas.engine.data.decibels import power
from clsas.engine.data.geometry import SAME_PLACE_M, bistatic_range_m
from clsas.engine.data.lines import wavelength_m
from clsas.engine.data.visibility import sines
from clsas.engine.device.buffers import (
    VECTOR_ROOM,
    Slot,
    beam_table,
    channel_pitch,
    expansion_kernel,
    filter_table,
    float_pairs,
    phase_polynomials,
    pixel_buffers,
)
from clsas.engine.device.device import Device
from clsas.engine.exact.layout import (
    BLOCKS,
    Groups,
    Tiles,
    groups_within,
    item_pixels,
    lookup_options,
)
from clsas.engine.factorized.buffers import DeviceLines, Level, leaf_tables, tile_buffers
from clsas.engine.factorized.track import MeanTrack
from clsas.engine.factorized.tree import Geometry, Sector, Tree

_SHARE = 0.02  # of an image's error power, for one cubic of weights per block of pixels

Finish = Callable[[], int]
"""Waits for pixels, puts them in place, and returns their number."""


class Leaves:
    """Lines, tables and kernel options of leaves, on a plane and off a plane alike.

    Parameters
    ----------
    lines : DeviceLines
        The raw lines, in the precision of the leaves' lines.
    geometry : Geometry
    device : Device
    work : Slot
        Buffers in which batches of roots are formed.
    image : complex64 array
        The image, whose pixels are set.
    allowed_db : float
        Error that the image may have.
    """

    def __init__(
        self,
        lines: DeviceLines,
        geometry: Geometry,
        device: Device,
        work: Slot,
        image: NDArray[np.complex64],
        allowed_db: float,
    ) -> None:
        self.geometry, self.device, self.work, self.image = geometry, device, work, image
        self.half_precision, self.allowed_db = lines.half_precision, allowed_db
        factorization, beam = geometry.factorization, geometry.beam
        self.level = Level.of(factorization.half_lengths[-1], device.info.width)
        self.normalise = beam is not None and beam.normalise
        # Lines are aligned on the centres of leaves; smaller tiles need references of their own.
        self.aligned = factorization.tile == factorization.sides[-1]
        self.beam_table = beam_table(device, beam, geometry.lines)
        self.arguments = {
            "cycles_per_sample": geometry.cycles_per_m / geometry.samples_per_m,
            "filter": filter_table(device, factorization.final.coefficients / lines.gain),
            "phase_polynomials": phase_polynomials(device, factorization.phase_terms),
            "line_pitch": self.level.pitch,
            **self.beam_table.arguments,
        }

    def _options(self, layout: Tiles | Groups) -> dict[str, int]:
        """Return the build options that the backprojection kernels share."""
        geometry, factorization = self.geometry, self.geometry.factorization
        beam, along, nearest_m = geometry.beam, geometry.along, geometry.nearest_m
        one_cubic = False
        if beam is not None and along is not None and nearest_m is not None:
            # Is one cubic of the beam's weights accurate enough for a block of pixels?
            radius_m = geometry.surface.radius_m(factorization.sides[0])
            nearest_m = max(nearest_m - radius_m, SAME_PLACE_M)
            wave_m, on_track = wavelength_m(geometry.lines), geometry.track.on_track
            centres_m = geometry.tree.centres_m(0, geometry.tree.roots)
            sine = sines(centres_m, geometry.track.sampled_m[0][on_track], along[on_track])
            error = layout.one_cubic_error(beam, nearest_m, wave_m)
            error /= beam.fullness(sine, wave_m, on_track.sum() / geometry.lines.channels)
            one_cubic = bool(error**2 < _SHARE * power(self.allowed_db))
        taps = factorization.final.taps
        lookup = lookup_options(self.device, layout, geometry.lines, geometry.samples_per_m, taps)
        return {
            "WIDTH": self.device.info.width,
            "TAPS": taps,
            "BEAM": 0 if beam is None else INTERVALS,
            "ONE_CUBIC": int(one_cubic),
            "NORMALISE": int(self.normalise),
            "OVERWRITE": 1,
            "ALIGNED": int(self.aligned),
            "HALF": int(self.half_precision),
            "PHASE_TERMS": factorization.phase_terms,
            **lookup,
        }

    def _fill(self, tables: Slot, sector: Sector, parts: dict[str, NDArray]) -> None:
        """Start copying the tables of virtual channels, and those of tiles or groups.

        `parts` are the latter by name; see `clsas.engine.factorized.buffers.leaf_tables`.
        """
        virtual, beam = sector.virtual[-1], self.geometry.beam
        rows = [float_pairs(sector.positions_m(-1).reshape(-1, 3))]
        if self.geometry.directions is not None:
            along = self.geometry.directions.at(virtual.coordinate, virtual.across)
            rows.append((along * self.beam_table.per_sine).astype(np.float32).reshape(-1, 3))
        values = {"geometry": np.concatenate(rows, axis=1).T, **parts}
        if self.normalise:
            values["represented"] = represented(sector, self.geometry.track).reshape(1, -1)
        count = values["ranges"].size // 3
        points = values["offsets"].shape[1] if "offsets" in values else None
        corrected = values["corrections"].shape[1] if "corrections" in values else 0
        for name, buffer in leaf_tables(len(rows[0]), count, points, beam, corrected).items():
            tables.fill(name, buffer.holding(values[name]))

    def _ranges(
        self, sector: Sector, root: NDArray[np.int64], leaf: NDArray[np.int64]
    ) -> NDArray[np.int32]:
        """Return virtual channels of tiles or groups, and the first line, [..., 3].

        `root` is the root of each, among those of the sector, and `leaf` its leaf in the root.
        """
        need = sector.needs[-1]
        first_of_root = root * sector.virtual[-1].coordinate.shape[1]
        at_once = self.geometry.factorization.roots_at_once
        in_batch = root % at_once * need.first.shape[1] + leaf
        ranges = [
            first_of_root + need.first[root, leaf],
            first_of_root + need.last[root, leaf],
            in_batch * sector.most_channels[-1],
        ]
        return np.stack(np.broadcast_arrays(*ranges), axis=-1).astype(np.int32)

    def _pixels(self, tables: Slot, count: int) -> dict[str, Any]:
        """Return the kernels' arguments for some pixels that they form."""
        found: dict[str, Any] = self.work.make(pixel_buffers(count, self.geometry.beam))
        if self.normalise and self.aligned:
            found["represented"] = tables["represented"]
        return found


class PlaneLeaves(Leaves):
    """Leaves on a plane, formed in tiles; the parameters are those of `Leaves`."""

    def __init__(
        self,
        lines: DeviceLines,
        geometry: Geometry,
        device: Device,
        work: Slot,
        image: NDArray[np.complex64],
        allowed_db: float,
    ) -> None:
        super().__init__(lines, geometry, device, work, image, allowed_db)
        sides, tile = geometry.factorization.sides, geometry.factorization.tile
        # A CPU writes pixels directly into the image.
        on_cpu = device.info.kind == "cpu" and not self.normalise
        self.shared = device.share(image) if on_cpu else None

        layout = Tiles(geometry.surface.plane, tile[0], device.info.width)
        if geometry.beam is not None and geometry.along is not None:
            layout = replace(layout, cosines=layout.cosines_in_beam(geometry.beam, geometry.along))
        options = self._options(layout) | {"TILE_ROWS": tile[0], "TILE_COLUMNS": tile[1]}
        self.backproject = device.kernel("backproject_tiles", **options)
        self.expand = expansion_kernel(device, geometry.beam)

        # All roots have the same tiles.
        tiles, first = Tree(geometry.surface, (sides[0], sides[-1], tile)), np.zeros((1, 2), int)
        self.per_root, self.leaf_of = tiles.per_root(2), tiles.parents(2)
        self.tile_m = tiles.centres_m(2, tiles.corners(2, first))[0] - tiles.centres_m(0, first)
        at_once = geometry.factorization.roots_at_once
        self.centres = device.upload(np.tile(float_pairs(self.tile_m), (at_once, 1)))

    def fill(self, tables: Slot, sector: Sector) -> None:
        """Start copying the tables of a sector's leaves to the device."""
        root = np.arange(len(sector.roots))[:, None]
        ranges = self._ranges(sector, root, self.leaf_of).reshape(-1, 3)
        self._fill(tables, sector, {"ranges": ranges})

    def form(self, tables: Slot, sector: Sector, batch: slice, samples: cl.Buffer) -> Finish:
        """Start forming the pixels of some roots of a sector from the lines of their leaves.

        Parameters
        ----------
        tables : Slot
            Filled by `fill`.
        sector : Sector
        batch : slice
            The roots, among those of the sector.
        samples : Buffer
            The lines.
        """
        roots, shape = sector.roots[batch], self.image.shape
        (height, width), tile = self.geometry.tree.sides[0], self.geometry.factorization.tile
        expanded = self._expand(tables, sector, batch)

        # Pixels go into the image itself if the device shares it with the host, and no root extends
        # past it.
        if self.shared is not None and bool(np.all(roots + (height, width) <= shape)):
            corners, columns = roots, shape[1]
            pixels: dict[str, Any] = {"pixels": self.shared}
        else:
            corners, columns = np.arange(len(roots))[:, None] * np.array([height, 0]), width
            pixels = self._pixels(tables, len(roots) * height * width)
        event = self.device.run(
            self.backproject,
            (tile[0] * tile[1] // item_pixels(self.device.info.width), len(roots) * self.per_root),
            lines=samples,
            **expanded,
            **self.arguments,
            **pixels,
            corners=self.device.upload(corners.astype(np.int32)),
            columns=columns,
            tiles_down=height // tile[0],
            tiles_across=width // tile[1],
            first_tile=0,
            wait_for=self.work.filled,
        )

        # Other pixels are read into the image, and sums of weights beside it.
        parts, ready = self._parts(roots), [event]
        weights: list[NDArray[np.complex64]] = []
        if pixels["pixels"] is not self.shared:
            ready = [
                self._read(pixels["pixels"], n, self.image, part) for n, part in enumerate(parts)
            ]
        if "weight_sums" in pixels:
            weights = [np.empty(self.image[part].shape, np.complex64) for part in parts]
            ready += [
                self._read(pixels["weight_sums"], n, each, (slice(None), slice(None)))
                for n, each in enumerate(weights)
            ]

        def finish() -> int:
            cl.wait_for_events(ready)
            for part, each in zip(parts, weights, strict=bool(weights)):
                self.image[part] *= normalising(each.real, self.geometry.lines.channels)
            return sum(self.image[part].size for part in parts)

        return finish

    def _expand(self, tables: Slot, sector: Sector, batch: slice) -> dict[str, Any]:
        """Start expanding ranges about the centres of tiles; return what backprojection needs."""
        geometry, work = self.geometry, self.work
        channels, tiles = sector.most_channels[-1], (batch.stop - batch.start) * self.per_root
        pitch = channel_pitch(channels)
        # Most tiles fit from the start, as in the stages.
        most = max(channels, geometry.factorization.most_channels[-1])
        if not self.aligned:
            work.wait()  # the host fills references, which the batch before may still read
        buffers = work.make(tile_buffers(tiles, most, geometry.beam, aligned=self.aligned))
        expanded: dict[str, Any] = {
            "ranges": tables["ranges"],
            "first_range": batch.start * self.per_root,
            "expansions": buffers["expansions"],
            "channel_pitch": pitch,
        }
        row_m, column_m = geometry.surface.steps_m[:2]
        drift_m = [geometry.drift @ step for step in (column_m, row_m)]
        self.device.run(
            self.expand,
            (pitch // self.device.info.width, tiles),
            **expanded,
            geometry=tables["geometry"],
            geometry_pitch=sector.virtual[-1].coordinate.size + VECTOR_ROOM,
            centres=self.centres,
            column_step=column_m,
            row_step=row_m,
            samples_per_m=geometry.samples_per_m,
            drift=[each * geometry.samples_per_m for each in drift_m],
            **self.beam_table.origin,
            wait_for=tables.filled,
        )
        if self.aligned:
            return expanded | {"centre_sample": self.level.centre}
        for name, values in self._references(sector, batch, pitch).items():
            work.fill(name, values)
            expanded[f"reference_{name}"] = buffers[name]
        return expanded

    def _references(self, sector: Sector, batch: slice, pitch: int) -> dict[str, NDArray]:
        """Return where the lines of leaves have the centres of tiles, by names of kernel tables.

        Arrays are [roots, tiles, pitch]: the sample, the position between samples, and the phase
        in cycles.
        """
        geometry = self.geometry
        shape = batch.stop - batch.start, self.per_root, pitch
        sample = np.full(shape, self.level.centre, np.int32)
        fraction, phase = np.zeros((2, *shape), np.float32)
        first = sector.needs[-1].first[batch][:, self.leaf_of]
        leaves_m = sector.relative_m[-1][batch][:, self.leaf_of]
        for root, position_m in enumerate(sector.positions_m(-1)[batch]):
            index = np.minimum(first[root][:, None] + np.arange(pitch), len(position_m) - 1)
            channel_m, leaf_m = position_m[index], leaves_m[root]
            range_m = bistatic_range_m(self.tile_m[:, None], channel_m, channel_m)
            range_m -= bistatic_range_m(leaf_m[:, None], channel_m, channel_m)
            range_m -= (self.tile_m - leaf_m) @ geometry.drift[:, None]
            position = range_m * geometry.samples_per_m
            sample[root] += np.rint(position).astype(np.int32)
            fraction[root] = position - np.rint(position)
            phase[root] = np.remainder(geometry.cycles_per_m * range_m + 0.5, 1) - 0.5
        return {"sample": sample, "fraction": fraction, "phase": phase}

    def _parts(self, roots: NDArray[np.int64]) -> list[tuple[slice, slice]]:
        """Return the rows and columns of some roots in the image."""
        ends = np.minimum(roots + self.geometry.tree.sides[0], self.image.shape)
        return [
            (slice(int(row), int(below)), slice(int(column), int(beyond)))
            for (row, column), (below, beyond) in zip(roots, ends, strict=True)
        ]

    def _read(
        self,
        pixels: cl.Buffer,
        index: int,
        image: NDArray[np.complex64],
        part: tuple[slice, slice],
    ) -> cl.Event:
        """Start reading the pixels of a root into a part of an image."""
        height, width = self.geometry.tree.sides[0]
        rows, columns = image[part].shape
        return cl.enqueue_copy(  # type: ignore[call-overload]
            self.device.queue,
            image,
            pixels,
            buffer_origin=(0, index * height, 0),
            buffer_pitches=(8 * width, 0),
            host_origin=(8 * (part[1].start or 0), part[0].start or 0, 0),
            host_pitches=(8 * image.shape[1], 0),
            region=(8 * columns, rows, 1),
            is_blocking=False,
        )

    def blank(self, sector: Sector, batch: slice) -> Finish:
        """Return a function that sets the pixels of roots without visible channels to 0."""

        def finish() -> int:
            parts = self._parts(sector.roots[batch])
            for part in parts:
                self.image[part] = 0
            return sum(self.image[part].size for part in parts)

        return finish

    def complete(self) -> None:
        """Hand the image back to the host, once all pixels are finished."""
        if self.shared is not None:
            flags, shape = cl.map_flags.READ, self.image.shape
            mapped: Any = cl.enqueue_map_buffer(  # PyOpenCL's types are of NumPy's older ones
                self.device.queue, self.shared, flags, 0, shape, np.dtype(np.complex64)
            )[0]
            mapped.base.release()


class SurfaceLeaves(Leaves):
    """Leaves off a plane, formed in groups of points.

    The methods are those of `PlaneLeaves`, and the parameters those of `Leaves` and the groups of
    points in all leaves.
    """

    def __init__(
        self,
        lines: DeviceLines,
        geometry: Geometry,
        device: Device,
        work: Slot,
        image: NDArray[np.complex64],
        allowed_db: float,
        leaves: LeafGroups,
    ) -> None:
        super().__init__(lines, geometry, device, work, image, allowed_db)
        self.leaves = leaves
        options = self._options(leaves.groups)
        if geometry.corrections is not None:
            options["CORRECTED"] = 1
        self.backproject = device.kernel("backproject_points", **options)

    def fill(self, tables: Slot, sector: Sector) -> None:
        """Start copying the tables of a sector's leaves to the device."""
        groups = self.leaves.of_roots(sector.first, sector.first + len(sector.roots))
        root, leaf = np.divmod(self.leaves.leaf[groups], sector.relative_m[-1].shape[1])
        root -= sector.first
        parts: dict[str, NDArray] = {
            "ranges": self._ranges(sector, root, leaf),
            "centres": float_pairs(sector.relative_m[-1][root, leaf]),
            "offsets": self.leaves.groups.offset_m[groups].reshape(-1, 3).T,
        }
        if self.geometry.corrections is not None:
            parts["corrections"] = self._corrections_m(sector, groups, root, leaf)
        self._fill(tables, sector, parts)

    def _corrections_m(
        self, sector: Sector, groups: slice, root: NDArray[np.int64], leaf: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return the corrections of groups for the virtual channels of their leaves.

        The array is [groups, channels], from the first channel of every leaf on.
        """
        corrections, virtual = self.geometry.corrections, sector.virtual[-1]
        assert corrections is not None
        assert self.leaves.corrections_m is not None
        at_nodes_m = self.leaves.corrections_m[groups]
        weights = corrections.weights(corrections.usual(virtual.position_m.reshape(-1, 3)))
        weights = weights.reshape(*virtual.coordinate.shape, -1)
        found = np.zeros((len(root), sector.most_channels[-1]))
        for number in np.unique(root):
            here = root == number
            of_root_m = at_nodes_m[here] @ weights[number].T
            first = sector.needs[-1].first[number, leaf[here]]
            channel = first[:, None] + np.arange(found.shape[1])
            last = of_root_m.shape[1] - 1
            found[here] = np.take_along_axis(of_root_m, np.minimum(channel, last), axis=1)
        return found

    def form(self, tables: Slot, sector: Sector, batch: slice, samples: cl.Buffer) -> Finish:
        """Start forming the pixels of some roots of a sector; see `PlaneLeaves.form`."""
        geometry, leaves = self.geometry, self.leaves
        of_sector = leaves.of_roots(sector.first, sector.first + len(sector.roots))
        roots = slice(sector.first + batch.start, sector.first + batch.stop)
        groups = leaves.of_roots(roots.start, roots.stop)
        count, size = leaves.groups.index[groups].shape
        formed = [np.empty((count, size), np.complex64) for _ in range(1 + self.normalise)]
        ready = []
        if count:
            corrected: dict[str, Any] = {}
            if geometry.corrections is not None:
                corrected["corrections"] = tables["corrections"]
                corrected["channel_pitch"] = channel_pitch(sector.most_channels[-1])
            pixels = self._pixels(tables, count * size)
            self.device.run(
                self.backproject,
                (self.device.in_whole_groups(count),),
                lines=samples,
                groups=count,
                ranges=tables["ranges"],
                first_range=groups.start - of_sector.start,
                centre_sample=self.level.centre,
                **corrected,
                drift=geometry.drift,
                geometry=tables["geometry"],
                geometry_pitch=sector.virtual[-1].coordinate.size + VECTOR_ROOM,
                centres=tables["centres"],
                offsets=tables["offsets"],
                points=size * (of_sector.stop - of_sector.start),
                samples_per_m=geometry.samples_per_m,
                **self.arguments,
                **pixels,
                first_group=0,
                wait_for=tables.filled,
            )
            buffers = [pixels[name] for name in ("pixels", "weight_sums") if name in pixels]
            ready = [
                cl.enqueue_copy(self.device.queue, each, buffer, is_blocking=False)
                for each, buffer in zip(formed, buffers, strict=True)
            ]

        def finish() -> int:
            for event in ready:
                event.wait()
            for sums in formed[1:]:
                formed[0] *= normalising(sums.real, geometry.lines.channels)
            return leaves.put(self.image, roots, formed[0])

        return finish

    def blank(self, sector: Sector, batch: slice) -> Finish:
        """Return a function that sets the pixels of roots without visible channels to 0."""
        roots = slice(sector.first + batch.start, sector.first + batch.stop)
        return lambda: self.leaves.put(self.image, roots, np.complex64(0))

    def complete(self) -> None:
        """Do nothing: each batch hands its own pixels to the host."""


@dataclass(frozen=True, eq=False)
class LeafGroups:
    """Groups of points in the leaves of all roots.

    Attributes
    ----------
    groups : Groups
        The groups, in the order of their leaves.
    leaf : int64 [groups]
        Leaf of each group, numbered root by root.
    ends : int64 [roots + 1]
        Number of groups before each root, and in total.
    pixels_before : int64 [roots + 1]
        Number of pixels before each root, and in total.
    corrections_m : float64 [groups, nodes] or None
        Corrections of ranges of each group; see `clsas.engine.water.ray_corrections`.
    """

    groups: Groups
    leaf: NDArray[np.int64]
    ends: NDArray[np.int64]
    pixels_before: NDArray[np.int64]
    corrections_m: NDArray[np.float64] | None

    @property
    def nbytes(self) -> int:
        """Memory of the groups, bytes."""
        of_corrections = 0 if self.corrections_m is None else self.corrections_m.nbytes
        return self.groups.index.nbytes + self.groups.offset_m.nbytes + of_corrections

    def of_roots(self, first: int, stop: int) -> slice:
        """Return the groups of the roots `first` to `stop - 1`."""
        return slice(int(self.ends[first]), int(self.ends[stop]))

    def put(
        self,
        image: NDArray[np.complex64],
        roots: slice,
        pixels: NDArray[np.complex64] | np.complex64,
    ) -> int:
        """Set the pixels of some roots in an image; return their number."""
        index = self.groups.index[self.of_roots(roots.start, roots.stop)]
        image.reshape(-1)[index] = pixels
        return int(self.pixels_before[roots.stop] - self.pixels_before[roots.start])


def leaf_groups(geometry: Geometry, width: int) -> LeafGroups:
    """Return the groups of points in the leaves of all roots, for a device with `width` lanes."""
    tree, surface, roots = geometry.tree, geometry.surface, geometry.roots
    last, side = len(tree.sides) - 1, tree.sides[-1]
    corners = tree.corners(last, roots)
    middles_m = tree.centres_m(last, corners).reshape(-1, 3)

    # The leaf of each cell, numbered in the order of `corners`: [rows, columns].
    number = np.empty(corners.max(axis=(0, 1)) // side + 1, np.int64)
    every = np.arange(corners[..., 0].size).reshape(corners.shape[:-1])
    number[tuple(np.moveaxis(corners // side, -1, 0))] = every
    row, column = (np.arange(n) for n in surface.plane.shape)
    leaf = number[np.ix_(row // side[0], column // side[1])]

    # The number of each cell in its leaf, block by block, so that pixels of a block are neighbours.
    high, wide = BLOCKS[width]
    down = row % side[0] // high * side[1] * high + row % high * wide
    across = column % side[1] // wide * high * wide + column % wide
    rank = down[:, None] + across

    leaf_of_pixel, rank_of_pixel = (each.ravel()[surface.cell] for each in (leaf, rank))
    groups, of_leaf = groups_within(surface.grid, leaf_of_pixel, rank_of_pixel, middles_m, width)
    corrections_m = None
    if geometry.corrections is not None:
        corrections_m = geometry.corrections.at(groups.middle_pixels(slice(None)))
    pixels = np.bincount(leaf_of_pixel // corners.shape[1], minlength=len(roots))
    return LeafGroups(
        groups,
        of_leaf,
        ends=np.searchsorted(of_leaf, np.arange(len(roots) + 1) * corners.shape[1]),
        pixels_before=np.concatenate([[0], np.cumsum(pixels)]),
        corrections_m=corrections_m,
    )


def represented(sector: Sector, track: MeanTrack) -> NDArray[np.float32]:
    """Return the number of raw channels that each virtual channel of the leaves stands for.

    Cubics interpolate the beam's weights, which are smooth along the track and across a sheet. The
    stages' filters have errors as small on average, but of the same sign on such a smooth function.

    Returns
    -------
    float32 [roots, virtual channels]
    """
    virtual, shares = sector.virtual[-1], np.empty(sector.virtual[-1].coordinate.shape)
    for root, coordinate in enumerate(virtual.coordinate):
        raw = sector.coordinate[root]
        if track.is_sheet:
            assert virtual.rows is not None
            assert sector.across is not None
            rows = virtual.rows[root]
            columns = coordinate[: len(coordinate) // len(rows)]
            column, along = _cubics(columns, raw)
            row, across = _cubics(rows, sector.across[root])
            index = len(columns) * row[:, :, None] + column[:, None]
            weights = across[:, :, None] * along[:, None]
        elif track.others:
            assert virtual.bands is not None
            strip = track.strip_of(sector.coordinate[0])
            first = virtual.bands.first[root][strip]
            stop = first + virtual.bands.width[root][strip]
            index, weights = _cubics(coordinate, raw, first, stop)
        else:
            index, weights = _cubics(coordinate, raw)
        shares[root] = np.bincount(index.ravel(), weights.ravel(), len(coordinate))
    return shares.astype(np.float32)


def _cubics(
    virtual: NDArray[np.float64],
    coordinate: NDArray[np.float64],
    first: NDArray[np.int64] | int = 0,
    stop: NDArray[np.int64] | int | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the four virtual channels that interpolate each raw channel, and weights, [n, 4].

    Parameters
    ----------
    virtual : float64 [virtual channels]
        Coordinates of virtual channels, ascending.
    coordinate : float64 [n]
        Coordinates of the raw channels.
    first, stop : int64 [n] or int, optional
        Virtual channels that may interpolate each: the first, and the one after the last.
    """
    stop = len(virtual) if stop is None else stop
    begin = np.clip(np.searchsorted(virtual, coordinate) - 2, first, np.asarray(stop) - 4)
    index = begin[:, None] + np.arange(4)
    near = virtual[index]
    weights = np.ones(near.shape)
    for one, other in permutations(range(4), 2):
        weights[:, one] *= (coordinate - near[:, other]) / (near[:, one] - near[:, other])
    return index, weights
