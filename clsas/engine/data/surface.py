"""The surface of a grid: pixels in the cells of a plane, and their offsets from the plane."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.grid import Grid

LEAST_SIDE = (16, 4)
"""Rows and columns of the smallest subimages, whole work-items with any number of lanes; sides of
all others are multiples of these."""

_LEAST_CELL_M = 1e-6
_CORNERS = {n: np.array(list(product((-0.5, 0.5), repeat=n))) for n in (2, 3)}  # of boxes


@dataclass(frozen=True, eq=False)
class Surface:
    """Positions of a grid's pixels, as cells of a plane and offsets from the plane.

    Subimages are rectangles of cells, and their pixels lie in boxes. The extents of a box are its
    rows, its columns and, unless the grid is a plane, its relief in metres. The sides of the box
    are its extents times `steps_m`.

    Attributes
    ----------
    grid : Grid
    plane : Grid
        The cells: the grid itself if it is a plane, else the plane that fits best.
    steps_m : float64 [axes, 3]
        Steps to the next row and to the next column of cells and, unless the grid is a plane, the
        unit vector of offsets.
    cell : int64 [pixels]
        Number of the cell that contains each pixel, in row order; empty on a plane.
    off_m : float64 [pixels]
        Offsets of the pixels along the last of `steps_m`; empty on a plane.
    """

    grid: Grid
    plane: Grid
    steps_m: NDArray[np.float64]
    cell: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    off_m: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    @property
    def is_plane(self) -> bool:
        """True if the grid is a plane, so that cells are pixels."""
        return self.plane is self.grid

    def counts(self, side: tuple[int, int]) -> NDArray[np.int64]:
        """Return the number of pixels in each subimage of a size, [down, across]."""
        return self._held(side)[0]

    def middles_m(self, side: tuple[int, int], corners: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the middles of subimages of a size whose first cells are `corners`, [..., 3].

        The middle is that of the box around the pixels or, without pixels, of the cells.
        """
        middle = corners + (np.array(side) - 1) / 2
        position_m = self.plane.vectors_m[0] + middle @ self.steps_m[:2]
        if not self.is_plane:
            _, low_m, high_m = self._held(side)
            off_m = _at(low_m + high_m, side, corners) / 2
            position_m += off_m[..., None] * self.steps_m[2]
        return position_m

    def holds(self, side: tuple[int, int], corners: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return whether subimages whose first cells are `corners` contain a pixel."""
        inside = np.all(corners < self.plane.shape, axis=-1)
        return inside if self.is_plane else inside & (_at(self.counts(side), side, corners) > 0)

    def pixels_in(self, cells: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the index of a pixel in each cell [n, 2], or in the next cell that has one."""
        inside = np.minimum(cells, np.array(self.plane.shape) - 1)
        number = np.ravel_multi_index((inside[:, 0], inside[:, 1]), self.plane.shape)
        if self.is_plane:
            return number
        last = len(self.cell) - 1
        order = self._in_order
        return order[np.minimum(np.searchsorted(self.cell, number, sorter=order), last)]

    @functools.cached_property
    def _in_order(self) -> NDArray[np.int64]:
        """Pixels in the order of their cells."""
        return np.argsort(self.cell, kind="stable")

    def relief_m(
        self, side: tuple[int, int], root: tuple[int, int] | None = None
    ) -> NDArray[np.float64]:
        """Return the relief of subimages of a size, [down, across], metres.

        If a size of roots is given, return the largest relief of subimages within each root.
        """
        if self.is_plane:
            return np.zeros((1, 1))
        _, low_m, high_m = self._held(side)
        relief_m = high_m - low_m
        return relief_m if root is None else within_roots(np.maximum, relief_m, side, root)

    def extents(self, side: tuple[int, int], relief_m: float = 0.0) -> NDArray[np.float64]:
        """Return the extents of a subimage with a given size and relief, [axes]."""
        return np.array([*side, relief_m][: len(self.steps_m)], np.float64)

    def extents_in(
        self, side: tuple[int, int], root: tuple[int, int], corners: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return the largest extents of subimages of a size within some roots, [roots, axes]."""
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
        """Number of pixels of the smallest subimages, and their lowest and highest offsets."""
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
        """Return the size of half a subimage if it can be halved, else the smallest size."""
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
        """Return the number of pixels of subimages, and their lowest and highest offsets."""
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
    """Return the surface of a grid."""
    if grid.points_m is not None:
        return _through_points(grid)
    origin_m, *in_plane_m = grid.vectors_m
    steps_m = np.stack(in_plane_m)
    if grid.height_m is None:
        return Surface(grid, grid, steps_m)
    # The plane fits in the least-squares sense. On a regular grid its two slopes are independent.
    up = np.array([0.0, 0.0, 1.0])
    height_m, (rows, columns) = grid.height_m, grid.shape
    middle_m, slopes = height_m.mean(), []
    plane_m = np.full(grid.shape, middle_m)
    for axis, n in enumerate(grid.shape):
        offset = np.arange(n) - (n - 1) / 2
        slope = offset @ height_m.mean(axis=1 - axis) / max(offset @ offset, 1.0)
        slopes.append(slope)
        plane_m += np.expand_dims(slope * offset, 1 - axis)
    steps_m = steps_m + np.outer(slopes, up)
    corner_m = plane_m[0, 0]
    plane = Grid.oriented(origin_m + corner_m * up, steps_m[0], steps_m[1], (rows, columns))
    off_m = (height_m - plane_m).ravel()
    return Surface(grid, plane, np.concatenate([steps_m, [up]]), np.arange(grid.size), off_m)


def _through_points(grid: Grid) -> Surface:
    """Return the surface of points, on the plane that fits them best.

    Cells contain about one point each. Columns are as close to the x axis, the usual direction of
    the track, as the plane allows.
    """
    points_m = grid.positions_m().reshape(-1, 3)
    middle_m = points_m.mean(axis=0)
    offset_m = points_m - middle_m
    normal = np.linalg.eigh(offset_m.T @ offset_m)[1][:, 0]
    across = np.eye(3)[0 if abs(normal[0]) < 0.9 else 1]
    across = across - (across @ normal) * normal
    across /= np.linalg.norm(across)
    axes = np.stack([np.cross(normal, across), across])
    # One axis at a time, because NumPy takes ten times as long for long, narrow arrays.
    in_plane_m = [offset_m @ axis for axis in axes]
    low_m, high_m = (np.array([reduce(each) for each in in_plane_m]) for reduce in (np.min, np.max))
    span_m = high_m - low_m
    step_m = max(math.sqrt(math.prod(span_m) / grid.size), span_m.max() / grid.size)
    step_m = max(1.000001 * step_m, _LEAST_CELL_M)
    rows, columns = (int(n) for n in span_m // step_m + 1)
    shape = rows, columns
    row, column = (
        np.minimum(((each - low) / step_m).astype(np.int64), n - 1)
        for each, low, n in zip(in_plane_m, low_m, shape, strict=True)
    )
    steps_m = step_m * axes
    origin_m = middle_m + (low_m + step_m / 2) @ axes
    plane = Grid.oriented(origin_m, steps_m[0], steps_m[1], shape)
    cell = row * columns + column
    return Surface(grid, plane, np.concatenate([steps_m, [normal]]), cell, offset_m @ normal)


def within_roots(
    ufunc: np.ufunc, values: NDArray, side: tuple[int, int], root: tuple[int, int]
) -> NDArray:
    """Return the values of subimages reduced over each root with a ufunc."""
    for axis in range(2):
        starts = np.arange(0, values.shape[axis], root[axis] // side[axis])
        values = ufunc.reduceat(values, starts, axis=axis)
    return values


def _at(values: NDArray, side: tuple[int, int], corners: NDArray[np.int64]) -> NDArray:
    """Return values of subimages whose first cells are `corners`; past the ends, the last ones."""
    row, column = np.moveaxis(corners // np.array(side), -1, 0)
    return values[np.minimum(row, len(values) - 1), np.minimum(column, values.shape[1] - 1)]
