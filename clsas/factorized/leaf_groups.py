"""Groups of points in the leaves of grids that are not planes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.exact.groups import Groups, groups_within
from clsas.exact.tiles import BLOCKS
from clsas.factorized.geometry import Geometry


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
        Corrections of ranges of each group; see `clsas.signal.ray_corrections`.
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


def leaf_groups(geometry: Geometry, width: int) -> LeafGroups:
    """Return the groups of points in the leaves of all roots, for a device with `width` lanes."""
    division, surface = geometry.division, geometry.surface
    roots, last = geometry.roots, len(division.sides) - 1
    corners = division.corners(last, roots)
    middles_m = division.centres_m(last, corners).reshape(-1, 3)
    leaves = _cells(geometry, corners, width)
    leaf, cell = (each.ravel()[surface.cell] for each in leaves)
    groups, of_leaf = groups_within(surface.grid, leaf, cell, middles_m, width)
    corrections_m = None
    if geometry.corrections is not None:
        corrections_m = geometry.corrections.at(groups.middle_pixels(slice(None)))
    held = np.bincount(leaf // corners.shape[1], minlength=len(roots))
    return LeafGroups(
        groups,
        of_leaf,
        ends=np.searchsorted(of_leaf, np.arange(len(roots) + 1) * corners.shape[1]),
        pixels_before=np.concatenate([[0], np.cumsum(held)]),
        corrections_m=corrections_m,
    )


def _cells(
    geometry: Geometry, corners: NDArray[np.int64], width: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the leaf of each cell and the number of the cell in it, [rows, columns] each.

    Leaves are numbered in the order of their corners, [roots, leaves, 2]. Cells are numbered block
    by block.
    """
    side = geometry.division.sides[-1]
    number = np.empty(corners.max(axis=(0, 1)) // side + 1, np.int64)
    count = corners[..., 0].size
    number[tuple(np.moveaxis(corners // side, -1, 0))] = np.arange(count).reshape(
        corners.shape[:-1]
    )
    row, column = (np.arange(n) for n in geometry.surface.plane.shape)
    high, wide = BLOCKS[width]
    down = row % side[0] // high * side[1] * high + row % high * wide
    across = column % side[1] // wide * high * wide + column % wide
    leaf = number[np.ix_(row // side[0], column // side[1])]
    return leaf, down[:, None] + across
