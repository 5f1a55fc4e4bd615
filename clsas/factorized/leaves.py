"""The last stage of a factorized image: pixels from the virtual channels of the leaves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import permutations

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsas.core.decibels import power
from clsas.core.geometry import bistatic_range_m
from clsas.core.lines import RangeLines, wavelength_m
from clsas.exact.groups import Groups, groups_within
from clsas.exact.lookup import lookup_options
from clsas.exact.tiles import BLOCKS, STACK, Tiles
from clsas.factorized import visibility
from clsas.factorized.sector import MOST_KEPT_BYTES, Geometry, Sector
from clsas.factorized.tree import Division
from clsas.opencl.buffers import (
    GUARD,
    VECTOR_ROOM,
    beam_table,
    channel_pitch,
    expansion_kernel,
    expansion_terms,
    filter_table,
    float_pairs,
    phase_polynomials,
)
from clsas.opencl.device import Device, Slot
from clsas.sonar.beam import INTERVALS, normalising
from clsas.sonar.visibility import sines

_ALL = slice(None)
_SHARE = 0.02  # of an image's error: what neighbours' weights may be off

Finish = Callable[[], int]
"""To be called to wait for pixels, and to put them in place; returns how many they are."""


@dataclass(frozen=True)
class Level:
    """The lines of one stage: `half` samples to either side of a subimage's centre."""

    half: int
    length: int

    @property
    def pitch(self) -> int:
        """Samples of a line with the zeros around it."""
        return self.length + 2 * GUARD

    @property
    def centre(self) -> int:
        """Sample of the subimage's centre."""
        return self.half + GUARD


class Leaves:
    """What forms pixels from leaves: of tiles on a plane, of groups of points elsewhere.

    Lines are of half precision or single, and `gain` times what they stand for.
    """

    def __init__(
        self,
        lines: RangeLines,
        geometry: Geometry,
        level: Level,
        device: Device,
        image: NDArray[np.complex64],
        half_precision: bool,
        gain: float,
    ) -> None:
        chosen = geometry.plan
        self.lines, self.geometry, self.level, self.device = lines, geometry, level, device
        self.plan, self.surface, self.width = chosen, geometry.surface, device.info.width
        self.normalise = chosen.beam is not None and chosen.beam.normalise
        self.beam = beam_table(device, chosen.beam, lines)
        self.arguments = {
            "cycles_per_sample": geometry.cycles_per_m / geometry.samples_per_m,
            "filter": filter_table(device, chosen.final.coefficients / gain),
            "phase_polynomials": phase_polynomials(device, chosen.phase_terms),
            "line_pitch": level.pitch,
            **self.beam.arguments,
        }
        # Where tile and leaf are one, every line is aligned on its centre.
        self.aligned = chosen.tile == chosen.sides[-1]
        self.slot, self.image, self.half_precision = Slot(device), image, half_precision
        self._prepare()

    def _prepare(self) -> None:
        """Build the kernels, and lay out what they work on."""
        raise NotImplementedError

    def _options(self, layout: Tiles | Groups) -> dict[str, int]:
        """Return the kernels' build options."""
        chosen, one_cubic = self.plan, False
        if chosen.beam is not None:
            radius_m = self.surface.radius_m(self.geometry.division.sides[0])
            nearest_m = max(self.geometry.nearest_m - radius_m, 1e-6)
            wave_m, track = wavelength_m(self.lines), self.geometry.track
            places = np.abs(track.samples - 0.5) <= 0.5
            centres_m = self.geometry.division.centres_m(0, self.geometry.division.roots)
            sine = sines(centres_m, track.sampled_m[0][places], self.geometry.along[places])
            error = layout.one_cubic_error(chosen.beam, nearest_m, wave_m)
            error /= chosen.beam.fullness(sine, wave_m, places.sum() / self.lines.channels)
            allowed_db = min(chosen.predicted_error_db, chosen.tolerance_db or 0.0)
            one_cubic = error**2 < _SHARE * power(allowed_db)
        return {
            "WIDTH": self.width,
            "TAPS": chosen.final.taps,
            "BEAM": 0 if chosen.beam is None else INTERVALS,
            "ONE_CUBIC": int(one_cubic),
            "NORMALISE": int(self.normalise),
            "OVERWRITE": 1,
            "ALIGNED": int(self.aligned),
            "HALF": int(self.half_precision),
            "PHASE_TERMS": chosen.phase_terms,
        } | lookup_options(
            self.device, layout, self.lines, self.geometry.samples_per_m, chosen.final.taps
        )

    def fill(self, slot: Slot, sector: Sector) -> None:
        """Start copying to the device what it is told of a sector's leaves."""
        position_m = sector.positions_m(-1)
        rows = [float_pairs(position_m.reshape(-1, 3))]
        if self.plan.beam is not None:
            along = visibility.interpolated_directions(
                self.geometry.track.samples, self.geometry.along, sector.nodes[-1].coordinate
            )
            rows.append((along * self.beam.per_sine).astype(np.float32).reshape(-1, 3))
        slot.fill("geometry", _padded(np.concatenate(rows, axis=1).T))
        if self.normalise:
            slot.fill("represented", _padded(_represented(sector).reshape(1, -1)))
        self._fill(slot, sector)

    def form(self, tables: Slot, sector: Sector, batch: slice, samples: cl.Buffer) -> Finish:
        """Start forming the pixels of some roots of a sector from the lines of their leaves.

        Parameters
        ----------
        tables : Slot
            Filled by `fill`.
        samples : Buffer
            The lines.
        """
        raise NotImplementedError

    def complete(self) -> None:
        """Make sure that the image holds all pixels, once they are finished."""

    def blank(self, sector: Sector, batch: slice) -> Finish:
        """Return what sets the pixels of some roots that no channel sees to 0."""
        raise NotImplementedError

    def _fill(self, slot: Slot, sector: Sector) -> None:
        raise NotImplementedError

    def _ranges(
        self,
        sector: Sector,
        root: NDArray[np.int64],
        leaf: NDArray[np.int64],
    ) -> NDArray[np.int32]:
        """Return the nodes of parts of some leaves, and the first one's line, [..., 3]."""
        need = sector.needs[-1]
        node = root * sector.nodes[-1].coordinate.shape[1]
        in_batch = root % self.plan.roots_at_once * need.first.shape[1] + leaf
        ranges = [
            node + need.first[root, leaf],
            node + need.last[root, leaf],
            in_batch * sector.stride(-1),
        ]
        return np.stack(np.broadcast_arrays(*ranges), axis=-1).astype(np.int32)

    def _weight_sums(self, tables: Slot, pixels: int) -> dict[str, cl.Buffer]:
        """Return the arguments of kernels that sum weights, for a number of pixels."""
        if not self.normalise:
            return {}
        sums = {"weight_sums": self.slot.buffer("weight_sums", 8 * pixels)}
        return sums | ({"represented": tables["represented"]} if self.aligned else {})


class PlaneLeaves(Leaves):
    """Leaves on a plane, in tiles."""

    def _prepare(self) -> None:
        device, image = self.device, self.image
        chosen, plane = self.plan, self.surface.plane
        # A CPU sets the pixels where they belong.
        on_cpu = device.info.kind == "cpu" and not self.normalise
        self.shared = device.share(image) if on_cpu else None
        layout = Tiles(plane, chosen.tile[0], self.width)
        options = self._options(layout)
        tile = {"TILE_ROWS": chosen.tile[0], "TILE_COLUMNS": chosen.tile[1]}
        self.expand = expansion_kernel(device, chosen.beam)
        self.backproject = device.kernel("backproject_tiles", **options, **tile)
        self.tiles = Division(self.surface, (chosen.sides[0], chosen.sides[-1], chosen.tile))
        self.per_root, self.leaf_of = self.tiles.per_root(2), self.tiles.parents(2)
        first = np.zeros((1, 2), np.int64)
        centres_m = self.tiles.centres_m(2, self.tiles.corners(2, first))[0]
        self.tile_m = centres_m - self.tiles.centres_m(0, first)
        self.centres = device.upload(np.tile(float_pairs(self.tile_m), (chosen.roots_at_once, 1)))

    def _fill(self, slot: Slot, sector: Sector) -> None:
        root = np.arange(len(sector.roots))[:, None]
        slot.fill("ranges", self._ranges(sector, root, self.leaf_of))

    def form(self, tables: Slot, sector: Sector, batch: slice, samples: cl.Buffer) -> Finish:
        """Start forming the pixels of some roots; see `Leaves.form`."""
        device, slot, chosen, level = self.device, self.slot, self.plan, self.level
        parts = [self._part(root) for root in sector.roots[batch]]
        tiles, first_tile = len(parts) * self.per_root, batch.start * self.per_root
        pitch = channel_pitch(sector.stride(-1))
        if self.aligned:
            references = {"centre_sample": level.centre}
        else:
            slot.wait()
            references = {}
            for name, values in self._references(sector, batch, pitch).items():
                slot.fill(name, values)
                references[f"reference_{name}"] = slot[name]
        plane, samples_per_m = self.surface.plane, self.geometry.samples_per_m
        steps_m = (plane.column_step_m, plane.row_step_m)
        terms = expansion_terms(chosen.beam)
        most = max(pitch, channel_pitch(chosen.most_channels[-1]))
        expanded = {
            "ranges": tables["ranges"],
            "first_range": first_tile,
            "expansions": slot.buffer("expansions", 4 * terms * tiles * most),
            "channel_pitch": pitch,
        }
        device.run(
            self.expand,
            (pitch // self.width, tiles),
            **expanded,
            geometry=tables["geometry"],
            geometry_pitch=sector.nodes[-1].coordinate.size + VECTOR_ROOM,
            centres=self.centres,
            column_step=steps_m[0],
            row_step=steps_m[1],
            samples_per_m=samples_per_m,
            drift=[self.geometry.drift @ step * samples_per_m for step in steps_m],
            **self.beam.origin,
            wait_for=tables.filled,
        )
        (height, width), corners = chosen.sides[0], sector.roots[batch]
        direct = self.shared is not None and bool(np.all(corners + (height, width) <= plane.shape))
        if direct:
            pixels, columns, sums = self.shared, plane.shape[1], {}
        else:
            corners = np.arange(len(parts))[:, None] * [height, 0]
            pixels, columns = slot.buffer("pixels", 8 * len(parts) * height * width), width
            sums = self._weight_sums(tables, len(parts) * height * width)
        event = device.run(
            self.backproject,
            (chosen.tile[0] * chosen.tile[1] // (self.width * STACK), tiles),
            lines=samples,
            **expanded,
            **references,
            **self.arguments,
            **sums,
            pixels=pixels,
            columns=columns,
            corners=device.upload(corners.astype(np.int32)),
            tiles_down=height // chosen.tile[0],
            tiles_across=width // chosen.tile[1],
            first_tile=0,
            wait_for=slot.filled,
        )
        ready, weights = [event], []
        if not direct:
            ready = [self._read(pixels, n, self.image, part) for n, part in enumerate(parts)]
        if sums:
            weights = [np.empty(self.image[part].shape, np.complex64) for part in parts]
            everything = (slice(None), slice(None))
            ready += [
                self._read(sums["weight_sums"], n, each, everything)
                for n, each in enumerate(weights)
            ]
        slot.busy = ready[-1]
        device.queue.flush()

        def finish() -> int:
            cl.wait_for_events(ready)
            for part, each in zip(parts, weights, strict=bool(weights)):
                self.image[part] *= normalising(each.real, self.lines.channels)
            return sum(self.image[part].size for part in parts)

        return finish

    def blank(self, sector: Sector, batch: slice) -> Finish:
        """Return what sets pixels to 0; see `Leaves.blank`."""
        parts = [self._part(root) for root in sector.roots[batch]]

        def finish() -> int:
            for part in parts:
                self.image[part] = 0
            return sum(self.image[part].size for part in parts)

        return finish

    def complete(self) -> None:
        """Hand the image back to the host; see `Leaves.complete`."""
        if self.shared is not None:
            flags, shape = cl.map_flags.READ, self.image.shape
            mapped, _ = cl.enqueue_map_buffer(
                self.device.queue, self.shared, flags, 0, shape, np.complex64
            )
            mapped.base.release()

    def _part(self, root: NDArray[np.int64]) -> tuple[slice, slice]:
        """Return which pixels of the image a root has."""
        ends = np.minimum(root + self.plan.sides[0], self.surface.plane.shape)
        rows, columns = (slice(int(a), int(b)) for a, b in zip(root, ends, strict=True))
        return rows, columns

    def _read(
        self,
        pixels: cl.Buffer,
        index: int,
        image: NDArray[np.complex64],
        part: tuple[slice, slice],
    ) -> cl.Event:
        """Start reading the pixels of a root into a part of an image."""
        height, width = self.plan.sides[0]
        rows, columns = image[part].shape
        return cl.enqueue_copy(
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

    def _references(self, sector: Sector, batch: slice, pitch: int) -> dict[str, NDArray]:
        """Return where tiles' centres lie in the lines of their leaves, [roots, tiles, pitch]."""
        shape, centre = (batch.stop - batch.start, self.per_root, pitch), self.level.centre
        sample = np.full(shape, centre, np.int32)
        fraction, phase = np.zeros((2, *shape), np.float32)
        first = sector.needs[-1].first[batch][:, self.leaf_of]
        leaves_m = sector.relative_m[-1][batch][:, self.leaf_of]
        for root, position_m in enumerate(sector.positions_m(-1)[batch]):
            index = np.minimum(first[root][:, None] + np.arange(pitch), len(position_m) - 1)
            node_m, leaf_m = position_m[index], leaves_m[root]
            range_m = bistatic_range_m(self.tile_m[:, None], node_m, node_m)
            range_m -= bistatic_range_m(leaf_m[:, None], node_m, node_m)
            range_m -= (self.tile_m - leaf_m) @ self.geometry.drift[:, None]
            place = range_m * self.geometry.samples_per_m
            sample[root] += np.rint(place).astype(np.int32)
            fraction[root] = place - np.rint(place)
            phase[root] = np.remainder(self.geometry.cycles_per_m * range_m + 0.5, 1) - 0.5
        return {"sample": sample, "fraction": fraction, "phase": phase}


class SurfaceLeaves(Leaves):
    """Leaves off a plane, in groups of points about their centres."""

    def _prepare(self) -> None:
        device, geometry = self.device, self.geometry
        division = geometry.division
        roots, last = geometry.roots, len(division.sides) - 1
        corners = division.corners(last, roots)
        key = "groups", self.width
        if key in geometry.kept:
            self.groups, self.leaf, held = geometry.kept[key]
        else:
            middles_m = division.centres_m(last, corners).reshape(-1, 3)
            leaf, place = (each.ravel()[self.surface.cell] for each in self._cells(corners))
            grid = self.surface.grid
            self.groups, self.leaf = groups_within(grid, leaf, place, middles_m, self.width)
            held = np.bincount(leaf // corners.shape[1], minlength=len(roots))
            if self.groups.index.nbytes + self.groups.offset_m.nbytes <= MOST_KEPT_BYTES:
                geometry.kept[key] = self.groups, self.leaf, held
        self.number = {tuple(root): n for n, root in enumerate(roots)}
        self.ends = np.searchsorted(self.leaf, np.arange(len(roots) + 1) * corners.shape[1])
        self.pixels_before = np.concatenate([[0], np.cumsum(held)])
        options = self._options(self.groups)
        self.backproject = device.kernel("backproject_points", **options)

    def _cells(self, corners: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return of every cell, [rows, columns], which leaf holds it and where there it lies.

        The leaves are numbered as their corners come, [roots, leaves, 2], the cells block by block.
        """
        side = self.geometry.division.sides[-1]
        number = np.empty(corners.max(axis=(0, 1)) // side + 1, np.int64)
        count = corners[..., 0].size
        number[tuple(np.moveaxis(corners // side, -1, 0))] = np.arange(count).reshape(
            corners.shape[:-1]
        )
        row, column = (np.arange(n) for n in self.surface.plane.shape)
        height, width = BLOCKS[self.width]
        down = row % side[0] // height * side[1] * height + row % height * width
        across = column % side[1] // width * height * width + column % width
        leaf = number[np.ix_(row // side[0], column // side[1])]
        return leaf, down[:, None] + across

    def _roots(self, sector: Sector, batch: slice = _ALL) -> slice:
        """Return which of all roots those of a sector, or some of these, are."""
        first = self.number[tuple(sector.roots[0])]
        some = range(first, first + len(sector.roots))[batch]
        return slice(some.start, some.stop)

    def _groups(self, roots: slice) -> slice:
        """Return which groups some roots have."""
        return slice(int(self.ends[roots.start]), int(self.ends[roots.stop]))

    def _fill(self, slot: Slot, sector: Sector) -> None:
        roots = self._roots(sector)
        groups = self._groups(roots)
        root, leaf = np.divmod(self.leaf[groups], sector.relative_m[-1].shape[1])
        root -= roots.start
        slot.fill("ranges", self._ranges(sector, root, leaf))
        slot.fill("centres", float_pairs(sector.relative_m[-1][root, leaf]))
        slot.fill("offsets", self.groups.offset_m[groups].reshape(-1, 3).T)

    def form(self, tables: Slot, sector: Sector, batch: slice, samples: cl.Buffer) -> Finish:
        """Start forming the pixels of some roots; see `Leaves.form`."""
        first = self._groups(self._roots(sector)).start
        roots = self._roots(sector, batch)
        groups = self._groups(roots)
        count, size = self.groups.index[groups].shape
        formed = [np.empty((count, size), np.complex64) for _ in range(1 + self.normalise)]
        ready = []
        if count:
            pixels = self.slot.buffer("pixels", 8 * count * size)
            sums = self._weight_sums(tables, count * size)
            self.device.run(
                self.backproject,
                (count,),
                lines=samples,
                ranges=tables["ranges"],
                first_range=groups.start - first,
                centre_sample=self.level.centre,
                drift=self.geometry.drift,
                geometry=tables["geometry"],
                geometry_pitch=sector.nodes[-1].coordinate.size + VECTOR_ROOM,
                centres=tables["centres"],
                offsets=tables["offsets"],
                points=size * (self._groups(self._roots(sector)).stop - first),
                samples_per_m=self.geometry.samples_per_m,
                **self.arguments,
                **sums,
                pixels=pixels,
                first_group=0,
                wait_for=tables.filled,
            )
            buffers = [pixels, *([sums["weight_sums"]] if sums else [])]
            ready = [
                cl.enqueue_copy(self.device.queue, each, buffer, is_blocking=False)
                for each, buffer in zip(formed, buffers, strict=False)
            ]
            self.slot.busy = ready[-1]
            self.device.queue.flush()

        def finish() -> int:
            for event in ready:
                event.wait()
            for sums in formed[1:]:
                formed[0] *= normalising(sums.real, self.lines.channels)
            return self._put(roots, formed[0])

        return finish

    def blank(self, sector: Sector, batch: slice) -> Finish:
        """Return what sets pixels to 0; see `Leaves.blank`."""
        return lambda: self._put(self._roots(sector, batch), np.complex64(0))

    def _put(self, roots: slice, pixels: NDArray[np.complex64]) -> int:
        """Set the pixels of some roots; return how many they are."""
        self.image.reshape(-1)[self.groups.index[self._groups(roots)]] = pixels
        return int(self.pixels_before[roots.stop] - self.pixels_before[roots.start])


def _represented(sector: Sector) -> NDArray[np.float32]:
    """Return how many raw channels each of the last stage's virtual ones stands for, [roots, n].

    Their weights by the beam, a smooth function along the track, are interpolated by cubics: the
    stages' filters, which err as little on average, all err alike on something so smooth.
    """
    nodes = sector.nodes[-1].coordinate
    shares = np.empty(nodes.shape)
    for root, (at, place) in enumerate(zip(nodes, sector.coordinate, strict=True)):
        first = np.clip(np.searchsorted(at, place) - 2, 0, len(at) - 4)
        index = first[:, None] + np.arange(4)
        near = at[index]
        weights = np.ones(near.shape)
        for one, other in permutations(range(4), 2):
            weights[:, one] *= (place - near[:, other]) / (near[:, one] - near[:, other])
        shares[root] = np.bincount(index.ravel(), weights.ravel(), len(at))
    return shares.astype(np.float32)


def _padded(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return rows in which a vector may begin at any channel."""
    return np.pad(rows, ((0, 0), (0, VECTOR_ROOM)), mode="edge")
