"""Subimages of a grid: their number, pixels and extents."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clsas.core.surface import Surface, within_roots
from clsas.exact.tiles import item_pixels

Side = tuple[int, int]
"""Rows and columns of a subimage."""

SMALL = (16, 16)
"""Rows and columns of a subimage that represents a pixel."""


@dataclass(frozen=True, eq=False)
class Subimages:
    """Subimages of every size on a surface."""

    surface: Surface
    _reliefs: dict[tuple[Side, Side], NDArray[np.float64]] = field(default_factory=dict, init=False)

    def count(self, side: Side) -> int:
        """Return the number of subimages of a size that contain a pixel."""
        if self.surface.is_plane:
            shape = self.surface.plane.shape
            return math.prod(-(-n // s) for n, s in zip(shape, side, strict=True))
        return int((self.surface.counts(side) > 0).sum())

    def padded_pixels(self, side: Side, width: int) -> float:
        """Return the mean pixel count of a subimage after padding to whole work-items.

        On a plane, a subimage is whole work-items already; elsewhere its pixels form groups of
        blocks of `width` pixels.
        """
        if self.surface.is_plane:
            return float(math.prod(side))
        padded = self._padded(side, width)
        return float(padded.sum() / (padded > 0).sum())

    def most_padded_pixels(self, side: Side, root: Side, width: int) -> int:
        """Return the largest padded pixel count of any root, summed over its leaves."""
        return int(within_roots(np.add, self._padded(side, width), side, root).max())

    def _padded(self, side: Side, width: int) -> NDArray[np.int64]:
        size = item_pixels(width)
        return -(-self.surface.counts(side) // size) * size

    def extents(self, side: Side, root: Side, *, most: bool = False) -> NDArray[np.float64]:
        """Return the extents of subimages of a size, [axes].

        Their relief is the largest one within a root: the mean over all roots, or the maximum.
        """
        if self.surface.is_plane:
            return self.surface.extents(side)
        relief_m = self._relief_m(side, root)
        of_all_m = relief_m.max() if most else relief_m.sum() / relief_m.size
        return self.surface.extents(side, float(of_all_m))

    def _relief_m(self, side: Side, root: Side) -> NDArray[np.float64]:
        """Return the largest relief of subimages of a size in every root, [down, across]."""
        if (side, root) not in self._reliefs:
            self._reliefs[side, root] = self._found_relief_m(side, root)
        return self._reliefs[side, root]

    def _found_relief_m(self, side: Side, root: Side) -> NDArray[np.float64]:
        if root == side:
            return self.surface.relief_m(side)
        # The relief of roots half as large, which is cached in most cases, leaves two values each.
        axis = 0 if root[0] // side[0] > root[1] // side[1] else 1
        half = (root[0] // 2, root[1]) if axis == 0 else (root[0], root[1] // 2)
        if root[axis] % 2 or half[axis] % side[axis]:
            return self.surface.relief_m(side, root)
        of_half = self._relief_m(side, half)
        return np.maximum.reduceat(of_half, np.arange(0, of_half.shape[axis], 2), axis=axis)
