"""Leaves on a plane: tiles of pixels, formed from virtual channels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsas.core.geometry import bistatic_range_m
from clsas.exact.tiles import Tiles, item_pixels
from clsas.factorized.buffers import tile_buffers
from clsas.factorized.leaves import Finish, LeafStage
from clsas.factorized.sectors import Sector
from clsas.factorized.tree import Division
from clsas.opencl.buffers import VECTOR_ROOM, Slot, channel_pitch, expansion_kernel, float_pairs
from clsas.opencl.kernels import Kernel
from clsas.sonar.beam import normalising

_EVERYTHING = slice(None), slice(None)


class PlaneLeaves:
    """Leaves on a plane, in tiles; the methods are those of `leaves.Leaves`.

    Parameters
    ----------
    stage : LeafStage
    image : complex64 array
        The image, whose pixels are set.
    """

    def __init__(self, stage: LeafStage, image: NDArray[np.complex64]) -> None:
        self.stage, self.image = stage, image
        self.geometry, self.device, self.slot = stage.geometry, stage.device, stage.slot
        self.factorization, self.surface = self.geometry.factorization, self.geometry.surface
        # A CPU writes pixels directly into the image.
        on_cpu = self.device.info.kind == "cpu" and not stage.normalise
        self.shared = self.device.share(image) if on_cpu else None
        self.expand = expansion_kernel(self.device, self.geometry.beam)
        self.backproject = self._kernel()
        chosen = self.factorization
        self.tiles = Division(self.surface, (chosen.sides[0], chosen.sides[-1], chosen.tile))
        self.per_root, self.leaf_of = self.tiles.per_root(2), self.tiles.parents(2)
        first = np.zeros((1, 2), np.int64)
        centres_m = self.tiles.centres_m(2, self.tiles.corners(2, first))[0]
        self.tile_m = centres_m - self.tiles.centres_m(0, first)
        centres = np.tile(float_pairs(self.tile_m), (chosen.roots_at_once, 1))
        self.centres = self.device.upload(centres)

    def _kernel(self) -> Kernel:
        """Build the backprojection of tiles."""
        rows, columns = self.factorization.tile
        layout = Tiles(self.surface.plane, rows, self.device.info.width)
        beam, along = self.geometry.beam, self.geometry.along
        if beam is not None and along is not None:
            layout = replace(layout, cosines=layout.cosines_in_beam(beam, along))
        options = self.stage.options(layout) | {"TILE_ROWS": rows, "TILE_COLUMNS": columns}
        return self.device.kernel("backproject_tiles", **options)

    def fill(self, slot: Slot, sector: Sector) -> None:
        """Start copying the tables of a sector's leaves to the device."""
        root = np.arange(len(sector.roots))[:, None]
        ranges = self.stage.ranges(sector, root, self.leaf_of).reshape(-1, 3)
        self.stage.fill(slot, sector, {"ranges": ranges})

    def form(self, tables: Slot, sector: Sector, batch: slice, samples: cl.Buffer) -> Finish:
        """Start forming the pixels of some roots; see `Leaves.form`."""
        parts = [self._part(root) for root in sector.roots[batch]]
        tiles = self._expanded(tables, sector, batch)
        pixels = self._destination(tables, sector.roots[batch])
        sides, tile = self.factorization.sides[0], self.factorization.tile
        count = len(parts) * self.per_root
        event = self.device.run(
            self.backproject,
            (tile[0] * tile[1] // item_pixels(self.device.info.width), count),
            lines=samples,
            **tiles,
            **self.stage.arguments,
            **pixels,
            tiles_down=sides[0] // tile[0],
            tiles_across=sides[1] // tile[1],
            first_tile=0,
            wait_for=self.slot.filled,
        )
        return self._finish(event, parts, pixels)

    def _expanded(self, tables: Slot, sector: Sector, batch: slice) -> dict[str, Any]:
        """Start expanding ranges about tile centres; return arguments for backprojection."""
        tiles = (batch.stop - batch.start) * self.per_root
        stride = sector.stride(-1)
        pitch, most = channel_pitch(stride), max(stride, self.factorization.most_channels[-1])
        beam, aligned = self.geometry.beam, self.stage.aligned
        references: dict[str, Any] = {"centre_sample": self.stage.level.centre}
        if not aligned:  # the host fills references, which the batch before may still read
            self.slot.wait()
        buffers = self.slot.make(tile_buffers(tiles, most, beam, aligned=aligned))
        if not aligned:
            references = {}
            for name, values in self._references(sector, batch, pitch).items():
                self.slot.fill(name, values)
                references[f"reference_{name}"] = buffers[name]
        expanded = {
            "ranges": tables["ranges"],
            "first_range": batch.start * self.per_root,
            "expansions": buffers["expansions"],
            "channel_pitch": pitch,
        }
        row_m, column_m = self.surface.steps_m[:2]
        samples_per_m = self.geometry.samples_per_m
        self.device.run(
            self.expand,
            (pitch // self.device.info.width, tiles),
            **expanded,
            geometry=tables["geometry"],
            geometry_pitch=sector.virtual[-1].coordinate.size + VECTOR_ROOM,
            centres=self.centres,
            column_step=column_m,
            row_step=row_m,
            samples_per_m=samples_per_m,
            drift=[self.geometry.drift @ step * samples_per_m for step in (column_m, row_m)],
            **self.stage.beam.origin,
            wait_for=tables.filled,
        )
        return expanded | references

    def _destination(self, tables: Slot, roots: NDArray[np.int64]) -> dict[str, Any]:
        """Return the kernel's arguments for the destination of the pixels of some roots.

        It is the image itself if the device shares memory with the host and no root extends past
        the image.
        """
        height, width = self.factorization.sides[0]
        shape = self.surface.plane.shape
        if self.shared is not None and bool(np.all(roots + (height, width) <= shape)):
            corners, columns = roots, shape[1]
            pixels: dict[str, Any] = {"pixels": self.shared}
        else:
            corners, columns = np.arange(len(roots))[:, None] * np.array([height, 0]), width
            pixels = self.stage.pixels(tables, len(roots) * height * width)
        uploaded = self.device.upload(corners.astype(np.int32))
        return {"corners": uploaded, "columns": columns, **pixels}

    def _finish(
        self, event: cl.Event, parts: list[tuple[slice, slice]], pixels: dict[str, Any]
    ) -> Finish:
        """Start reading pixels into the image; return a function that waits for them."""
        ready, weights = [event], []
        if pixels["pixels"] is not self.shared:
            ready = [
                self._read(pixels["pixels"], n, self.image, part) for n, part in enumerate(parts)
            ]
        if "weight_sums" in pixels:
            weights = [np.empty(self.image[part].shape, np.complex64) for part in parts]
            ready += [
                self._read(pixels["weight_sums"], n, each, _EVERYTHING)
                for n, each in enumerate(weights)
            ]
        self.slot.busy = ready[-1]
        self.device.queue.flush()

        def finish() -> int:
            cl.wait_for_events(ready)
            for part, each in zip(parts, weights, strict=bool(weights)):
                self.image[part] *= normalising(each.real, self.stage.lines.channels)
            return sum(self.image[part].size for part in parts)

        return finish

    def blank(self, sector: Sector, batch: slice) -> Finish:
        """Return a function that sets pixels to 0; see `Leaves.blank`."""
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
            mapped: Any = cl.enqueue_map_buffer(  # PyOpenCL's types are of NumPy's older ones
                self.device.queue, self.shared, flags, 0, shape, np.dtype(np.complex64)
            )[0]
            mapped.base.release()

    def _part(self, root: NDArray[np.int64]) -> tuple[slice, slice]:
        """Return the rows and columns of a root in the image."""
        ends = np.minimum(root + self.factorization.sides[0], self.surface.plane.shape)
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
        height, width = self.factorization.sides[0]
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

    def _references(self, sector: Sector, batch: slice, pitch: int) -> dict[str, NDArray]:
        """Return where the lines of leaves have the centres of tiles, by names of kernel tables.

        Arrays are [roots, tiles, pitch]: the sample, the position between samples, and the phase in
        cycles.
        """
        shape, centre = (batch.stop - batch.start, self.per_root, pitch), self.stage.level.centre
        sample = np.full(shape, centre, np.int32)
        fraction, phase = np.zeros((2, *shape), np.float32)
        first = sector.needs[-1].first[batch][:, self.leaf_of]
        leaves_m = sector.relative_m[-1][batch][:, self.leaf_of]
        for root, position_m in enumerate(sector.positions_m(-1)[batch]):
            index = np.minimum(first[root][:, None] + np.arange(pitch), len(position_m) - 1)
            channel_m, leaf_m = position_m[index], leaves_m[root]
            range_m = bistatic_range_m(self.tile_m[:, None], channel_m, channel_m)
            range_m -= bistatic_range_m(leaf_m[:, None], channel_m, channel_m)
            range_m -= (self.tile_m - leaf_m) @ self.geometry.drift[:, None]
            position = range_m * self.geometry.samples_per_m
            sample[root] += np.rint(position).astype(np.int32)
            fraction[root] = position - np.rint(position)
            phase[root] = np.remainder(self.geometry.cycles_per_m * range_m + 0.5, 1) - 0.5
        return {"sample": sample, "fraction": fraction, "phase": phase}
