"""A grid's pixels as cells of a plane, and how far off it they lie."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from clsas.core.grid import Grid

LEAST_SIDE = (16, 4)
"""Rows and columns of the smallest subimages; sides of all others are multiples of these."""

_LEAST_CELL_M = 1e-6
_CORNERS = {n: np.array(list(product((-0.5, 0.5), repeat=n))) for n in (2, 3)}  # of boxes


@dataclass(frozen=True, eq=False)
class Surface:
    """Where a grid's pixels lie: in cells of a plane, and off it by their relief.

    Subimages are rectangles of cells. What they hold lies in a box: its extents are rows, columns
    and, unless the grid is a plane itself, metres of relief; its sides these times `steps_m`.

    Attributes
    ----------
    grid : Grid
    plane : Grid
        The cells, a plane: the grid itself; that which fits a height map best; or that through
        points.
    steps_m : float64 [axes, 3]
        From a row and from a column of cells to the next; and the unit vector along which pixels
        lie off the plane.
    cell : int64 [pixels] or None
        The cell that holds each pixel, row by row. None on a plane, where they are the same.
    off_m : float64 [pixels] or None
        How far along the last of `steps_m` pixels lie off.
    """

    grid: Grid
    plane: Grid
    steps_m: NDArray[np.float64]
    cell: NDArray[np.int64] | None = None
    off_m: NDArray[np.float64] | None = None

    @property
    def is_plane(self) -> bool:
        """Whether cells and pixels are the same."""
        return self.cell is None

    def counts(self, side: tuple[int, int]) -> NDArray[np.int64]:
        """Return how many pixels (of a plane, cells) subimages of a size hold, [down, across]."""
        return self._held(side)[0]

    def middles_m(self, side: tuple[int, int], corners: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the middles of subimages of a size that begin at some cells, [..., 3].

        Those of the boxes around their pixels; of cells where there are none.
        """
        middle = corners + (np.array(side) - 1) / 2
        position_m = self.plane.origin_m + middle @ self.steps_m[:2]
        if not self.is_plane:
            _, low_m, high_m = self._held(side)
            off_m = _at(low_m + high_m, side, corners) / 2
            position_m += off_m[..., None] * self.steps_m[2]
        return position_m

    def holds(self, side: tuple[int, int], corners: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return whether subimages of a size that begin at some cells hold a pixel, [...]."""
        inside = np.all(corners < self.plane.shape, axis=-1)
        return inside if self.is_plane else inside & (_at(self.counts(side), side, corners) > 0)

    def relief_m(
        self, side: tuple[int, int], root: tuple[int, int] | None = None
    ) -> NDArray[np.float64]:
        """Return the relief of subimages of a size, metres, [down, across].

        With a root: of those with most relief in every subimage of that larger size.
        """
        if self.is_plane:
            return np.zeros((1, 1))
        _, low_m, high_m = self._held(side)
        relief_m = high_m - low_m
        return relief_m if root is None else within_roots(np.maximum, relief_m, side, root)

    def extents(self, side: tuple[int, int], relief_m: float = 0.0) -> NDArray[np.float64]:
        """Return the extents of subimages of a size and of some relief, [axes]."""
        return np.array([*side, relief_m][: len(self.steps_m)], np.float64)

    def extents_in(
        self, side: tuple[int, int], root: tuple[int, int], corners: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return extents that hold all subimages of a size in some roots, [roots, axes]."""
        extents = np.tile(self.extents(side), (len(corners), 1))
        if not self.is_plane:
            extents[:, 2] = _at(self.relief_m(side, root), root, corners)
        return extents

    def radius_m(self, side: tuple[int, int]) -> float:
        """Return the largest distance of a pixel from the middle of its subimage of a size."""
        extents = self.extents(side, float(self.relief_m(side).max()))
        corners_m = (_CORNERS[len(extents)] * extents) @ self.steps_m
        return math.sqrt(np.einsum("ci,ci->c", corners_m, corners_m).max())

    @functools.cached_property
    def _smallest(self) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Pixels of the smallest subimages, and the least and the most that these lie off."""
        rows, columns = self.plane.shape
        shape = -(-rows // LEAST_SIDE[0]), -(-columns // LEAST_SIDE[1])
        if self.is_plane or self.grid.height_m is not None:
            cells = [
                np.minimum(side, n - side * np.arange(many))
                for many, side, n in zip(shape, LEAST_SIDE, self.plane.shape, strict=True)
            ]
            counts = np.outer(*cells)
            if self.is_plane:
                return counts, np.zeros(shape), np.zeros(shape)
            # A height map has one pixel in every cell.
            off_m = self.off_m.reshape(self.plane.shape)
            low_m, high_m = (
                within_roots(reduce, off_m, (1, 1), LEAST_SIDE)
                for reduce in (np.minimum, np.maximum)
            )
            return counts, low_m, high_m
        row, column = np.divmod(self.cell, columns)
        index = row // LEAST_SIDE[0] * shape[1] + column // LEAST_SIDE[1]
        low_m, high_m = np.full(math.prod(shape), np.inf), np.full(math.prod(shape), -np.inf)
        np.minimum.at(low_m, index, self.off_m)
        np.maximum.at(high_m, index, self.off_m)
        counts = np.bincount(index, minlength=math.prod(shape))
        return counts.reshape(shape), low_m.reshape(shape), high_m.reshape(shape)

    @staticmethod
    def _part(side: tuple[int, int]) -> tuple[int, int]:
        """Return half a subimage of a size, if it divides into such; else the smallest."""
        (rows, columns), (least_rows, least_columns) = side, LEAST_SIDE
        if columns // least_columns > rows // least_rows:
            part = rows, columns // 2
        else:
            part = rows // 2, columns
        divides = all(n == 2 * p or n == p for n, p in zip(side, part, strict=True))
        whole = all(p % least == 0 for p, least in zip(part, LEAST_SIDE, strict=True))
        return part if divides and whole else LEAST_SIDE

    @functools.cached_property
    def _known(self) -> dict[tuple[int, int], tuple[NDArray, NDArray, NDArray]]:
        return {}

    def _held(self, side: tuple[int, int]) -> tuple[NDArray, NDArray, NDArray]:
        """Return how many pixels subimages hold, and the least and the most these lie off."""
        if side not in self._known:
            if side == LEAST_SIDE:
                counts, low_m, high_m = self._smallest
            else:
                part = self._part(side)
                parts = self._held(part)
                empty = parts[0] == 0
                counts = within_roots(np.add, parts[0], part, side)
                low_m = within_roots(np.minimum, np.where(empty, np.inf, parts[1]), part, side)
                high_m = within_roots(np.maximum, np.where(empty, -np.inf, parts[2]), part, side)
            empty = counts == 0
            self._known[side] = counts, np.where(empty, 0, low_m), np.where(empty, 0, high_m)
        return self._known[side]


def surface_of(grid: Grid) -> Surface:
    """Return a grid's pixels as cells of a plane, and their relief."""
    if grid.points_m is not None:
        return _through_points(grid)
    steps_m = np.stack([grid.row_step_m, grid.column_step_m])
    if grid.height_m is None:
        return Surface(grid, grid, steps_m)
    # The plane that fits best: over regular rows and columns either slope is found by itself.
    up = np.array([0.0, 0.0, 1.0])
    height_m = grid.height_m
    middle_m, slopes = height_m.mean(), []
    plane_m = np.full(grid.shape, middle_m)
    for axis, n in enumerate(grid.shape):
        place = np.arange(n) - (n - 1) / 2
        slope = place @ height_m.mean(axis=1 - axis) / max(place @ place, 1.0)
        slopes.append(slope)
        plane_m += np.expand_dims(slope * place, 1 - axis)
    steps_m = steps_m + np.outer(slopes, up)
    corner_m = plane_m[0, 0]
    plane = Grid.oriented(grid.origin_m + corner_m * up, *steps_m, grid.shape)
    off_m = (height_m - plane_m).ravel()
    return Surface(grid, plane, np.concatenate([steps_m, [up]]), np.arange(grid.size), off_m)


def _through_points(grid: Grid) -> Surface:
    """Return points in cells of the plane that they lie off least, about one in each.

    Its columns run along x as far as that can be: along the track of most.
    """
    points_m = grid.points_m.reshape(-1, 3)
    middle_m = points_m.mean(axis=0)
    away_m = points_m - middle_m
    normal = np.linalg.eigh(away_m.T @ away_m)[1][:, 0]
    across = np.eye(3)[0 if abs(normal[0]) < 0.9 else 1]
    across = across - (across @ normal) * normal
    across /= np.linalg.norm(across)
    axes = np.stack([np.cross(normal, across), across])
    place_m = away_m @ axes.T
    low_m, span_m = place_m.min(axis=0), np.ptp(place_m, axis=0)
    step_m = max(math.sqrt(math.prod(span_m) / grid.size), span_m.max() / grid.size)
    step_m = max(1.000001 * step_m, _LEAST_CELL_M)
    shape = tuple(int(n) for n in span_m // step_m + 1)
    index = np.minimum(((place_m - low_m) // step_m).astype(np.int64), np.array(shape) - 1)
    steps_m = step_m * axes
    plane = Grid.oriented(middle_m + (low_m + step_m / 2) @ axes, *steps_m, shape)
    cell = index[:, 0] * shape[1] + index[:, 1]
    return Surface(grid, plane, np.concatenate([steps_m, [normal]]), cell, away_m @ normal)


def within_roots(
    ufunc: np.ufunc, values: NDArray, side: tuple[int, int], root: tuple[int, int]
) -> NDArray:
    """Return what a ufunc makes of what there is of all subimages of a size in each larger one."""
    for axis in range(2):
        starts = np.arange(0, values.shape[axis], root[axis] // side[axis])
        values = ufunc.reduceat(values, starts, axis=axis)
    return values


def _at(values: NDArray, side: tuple[int, int], corners: NDArray[np.int64]) -> NDArray:
    """Return what there is of subimages that begin at some cells; beyond the last, its."""
    row, column = np.moveaxis(corners // np.array(side), -1, 0)
    return values[np.minimum(row, len(values) - 1), np.minimum(column, values.shape[1] - 1)]
