"""Pixels off a plane from the virtual channels of leaves, in groups of points."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsas.factorized.leaves import Finish, Leaves
from clsas.factorized.sectors import Sector
from clsas.opencl.buffers import VECTOR_ROOM, Slot, float_pairs
from clsas.sonar.beam import normalising

_ALL = slice(None)


class SurfaceLeaves(Leaves):
    """Leaves off a plane, in groups of points about their centres."""

    def _prepare(self) -> None:
        found = self.roots.groups(self.width)
        self.groups, self.leaf, self.ends = found.groups, found.leaf, found.ends
        self.pixels_before = found.pixels_before
        self.number = {tuple(root): n for n, root in enumerate(self.geometry.roots)}
        options = self._options(self.groups)
        self.backproject = self.device.kernel("backproject_points", **options)

    def _numbers(self, sector: Sector, batch: slice = _ALL) -> slice:
        """Return the numbers of a sector's roots, or of some of these, among all roots."""
        first = self.number[tuple(sector.roots[0])]
        some = range(first, first + len(sector.roots))[batch]
        return slice(some.start, some.stop)

    def _groups(self, roots: slice) -> slice:
        """Return the groups of some roots."""
        return slice(int(self.ends[roots.start]), int(self.ends[roots.stop]))

    def _parts(self, sector: Sector) -> dict[str, NDArray]:
        roots = self._numbers(sector)
        groups = self._groups(roots)
        root, leaf = np.divmod(self.leaf[groups], sector.relative_m[-1].shape[1])
        root -= roots.start
        return {
            "ranges": self._ranges(sector, root, leaf),
            "centres": float_pairs(sector.relative_m[-1][root, leaf]),
            "offsets": self.groups.offset_m[groups].reshape(-1, 3).T,
        }

    def form(self, tables: Slot, sector: Sector, batch: slice, samples: cl.Buffer) -> Finish:
        """Start forming the pixels of some roots; see `Leaves.form`."""
        first = self._groups(self._numbers(sector)).start
        roots = self._numbers(sector, batch)
        groups = self._groups(roots)
        count, size = self.groups.index[groups].shape
        formed = [np.empty((count, size), np.complex64) for _ in range(1 + self.normalise)]
        ready = []
        if count:
            pixels = self._pixels(tables, count * size)
            self.device.run(
                self.backproject,
                (self.device.in_whole_groups(count),),
                lines=samples,
                groups=count,
                ranges=tables["ranges"],
                first_range=groups.start - first,
                centre_sample=self.level.centre,
                drift=self.geometry.drift,
                geometry=tables["geometry"],
                geometry_pitch=sector.nodes[-1].coordinate.size + VECTOR_ROOM,
                centres=tables["centres"],
                offsets=tables["offsets"],
                points=size * (self._groups(self._numbers(sector)).stop - first),
                samples_per_m=self.geometry.samples_per_m,
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
        """Return a function that sets pixels to 0; see `Leaves.blank`."""
        return lambda: self._put(self._numbers(sector, batch), np.complex64(0))

    def _put(self, roots: slice, pixels: NDArray[np.complex64] | np.complex64) -> int:
        """Set the pixels of some roots; return their number."""
        self.image.reshape(-1)[self.groups.index[self._groups(roots)]] = pixels
        return int(self.pixels_before[roots.stop] - self.pixels_before[roots.start])
