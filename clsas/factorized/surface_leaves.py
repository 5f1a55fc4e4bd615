"""Leaves off a plane: groups of points, formed from virtual channels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsas.factorized.leaf_groups import LeafGroups
from clsas.factorized.leaves import Finish, LeafStage
from clsas.factorized.sectors import Sector
from clsas.opencl.buffers import VECTOR_ROOM, Slot, channel_pitch, float_pairs
from clsas.sonar.beam import normalising

_ALL = slice(None)


class SurfaceLeaves:
    """Leaves off a plane, in groups of points; the methods are those of `leaves.Leaves`.

    Parameters
    ----------
    stage : LeafStage
    leaves : LeafGroups
        The groups of points in all leaves.
    image : complex64 array
        The image, whose pixels are set.
    """

    def __init__(
        self,
        stage: LeafStage,
        leaves: LeafGroups,
        image: NDArray[np.complex64],
    ) -> None:
        self.stage, self.leaves, self.image = stage, leaves, image
        self.corrections = stage.geometry.corrections
        self.geometry, self.device = stage.geometry, stage.device
        self.number = {tuple(root): n for n, root in enumerate(self.geometry.roots)}
        options = stage.options(leaves.groups)
        if self.corrections is not None:
            options["CORRECTED"] = 1
        self.backproject = self.device.kernel("backproject_points", **options)

    def _numbers(self, sector: Sector, batch: slice = _ALL) -> slice:
        """Return the numbers of a sector's roots, or of a batch of these, among all roots."""
        first = self.number[tuple(sector.roots[0])]
        some = range(first, first + len(sector.roots))[batch]
        return slice(some.start, some.stop)

    def _groups(self, roots: slice) -> slice:
        """Return the groups of some roots."""
        return slice(int(self.leaves.ends[roots.start]), int(self.leaves.ends[roots.stop]))

    def fill(self, slot: Slot, sector: Sector) -> None:
        """Start copying the tables of a sector's leaves to the device."""
        roots = self._numbers(sector)
        groups = self._groups(roots)
        root, leaf = np.divmod(self.leaves.leaf[groups], sector.relative_m[-1].shape[1])
        root -= roots.start
        parts: dict[str, NDArray] = {
            "ranges": self.stage.ranges(sector, root, leaf),
            "centres": float_pairs(sector.relative_m[-1][root, leaf]),
            "offsets": self.leaves.groups.offset_m[groups].reshape(-1, 3).T,
        }
        if self.corrections is not None:
            parts["corrections"] = self._corrections_m(sector, groups, root, leaf)
        self.stage.fill(slot, sector, parts)

    def _corrections_m(
        self, sector: Sector, groups: slice, root: NDArray[np.int64], leaf: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return the corrections of groups for the virtual channels of their leaves.

        The array is [groups, channels], from the first channel of every leaf on.
        """
        assert self.corrections is not None
        assert self.leaves.corrections_m is not None
        at_nodes_m = self.leaves.corrections_m[groups]
        antennas = self.corrections.usual(sector.virtual[-1].position_m.reshape(-1, 3))
        weights = self.corrections.weights(antennas)
        weights = weights.reshape(*sector.virtual[-1].coordinate.shape, -1)
        found = np.zeros((len(root), sector.stride(-1)))
        for number in np.unique(root):
            here = root == number
            of_root_m = at_nodes_m[here] @ weights[number].T
            first = sector.needs[-1].first[number, leaf[here]]
            channel = first[:, None] + np.arange(found.shape[1])
            last = of_root_m.shape[1] - 1
            found[here] = np.take_along_axis(of_root_m, np.minimum(channel, last), axis=1)
        return found

    def form(self, tables: Slot, sector: Sector, batch: slice, samples: cl.Buffer) -> Finish:
        """Start forming the pixels of some roots; see `Leaves.form`."""
        first = self._groups(self._numbers(sector)).start
        roots = self._numbers(sector, batch)
        groups = self._groups(roots)
        count, size = self.leaves.groups.index[groups].shape
        formed = [np.empty((count, size), np.complex64) for _ in range(1 + self.stage.normalise)]
        ready = []
        if count:
            pixels = self.stage.pixels(tables, count * size)
            self.device.run(
                self.backproject,
                (self.device.in_whole_groups(count),),
                lines=samples,
                groups=count,
                ranges=tables["ranges"],
                first_range=groups.start - first,
                centre_sample=self.stage.level.centre,
                **self._corrected(tables, sector),
                drift=self.geometry.drift,
                geometry=tables["geometry"],
                geometry_pitch=sector.virtual[-1].coordinate.size + VECTOR_ROOM,
                centres=tables["centres"],
                offsets=tables["offsets"],
                points=size * (self._groups(self._numbers(sector)).stop - first),
                samples_per_m=self.geometry.samples_per_m,
                **self.stage.arguments,
                **pixels,
                first_group=0,
                wait_for=tables.filled,
            )
            buffers = [pixels[name] for name in ("pixels", "weight_sums") if name in pixels]
            ready = [
                cl.enqueue_copy(self.device.queue, each, buffer, is_blocking=False)
                for each, buffer in zip(formed, buffers, strict=True)
            ]
            self.stage.slot.busy = ready[-1]
            self.device.queue.flush()

        def finish() -> int:
            for event in ready:
                event.wait()
            for sums in formed[1:]:
                formed[0] *= normalising(sums.real, self.stage.lines.channels)
            return self._put(roots, formed[0])

        return finish

    def _corrected(self, tables: Slot, sector: Sector) -> dict[str, Any]:
        """Return the kernel's arguments for corrections, if there are any."""
        if self.corrections is None:
            return {}
        pitch = channel_pitch(sector.stride(-1))
        return {"corrections": tables["corrections"], "channel_pitch": pitch}

    def blank(self, sector: Sector, batch: slice) -> Finish:
        """Return a function that sets pixels to 0; see `Leaves.blank`."""
        return lambda: self._put(self._numbers(sector, batch), np.complex64(0))

    def complete(self) -> None:
        """Do nothing: each batch hands its own pixels to the host."""

    def _put(self, roots: slice, pixels: NDArray[np.complex64] | np.complex64) -> int:
        """Set the pixels of some roots; return their number."""
        self.image.reshape(-1)[self.leaves.groups.index[self._groups(roots)]] = pixels
        return int(self.leaves.pixels_before[roots.stop] - self.leaves.pixels_before[roots.start])
