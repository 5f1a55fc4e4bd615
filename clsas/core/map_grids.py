"""Grids on maps: their transform to easting and northing, and grids along the axes of the map.

These functions are methods of `Georeference`, which documents them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from clsas.core import validate
from clsas.core.georeference import Georeference
from clsas.core.grid import Grid

Affine = tuple[float, float, float, float, float, float]
"""Transform from columns and rows to easting and northing: see `Georeference.affine`."""

_ROUNDING = 1e-12  # part of a step that may come from rounding: 1e-7 pixels over 100 000
_PARALLEL = 1e-6  # sine of the least angle between rows and columns, seen from above


def affine(place: Georeference, grid: Grid) -> Affine:
    """Return the transform from columns and rows of a grid to easting and northing."""
    validate.instance("grid", grid, Grid)
    origin_m, row_step_m, column_step_m = grid.vectors_m
    right, down = (_on_map(place, step) for step in (column_step_m, row_step_m))
    down, right = completed_steps((grid.shape[0], grid.shape[1]), down, right)
    lengths = math.hypot(*right) * math.hypot(*down)
    if abs(right[0] * down[1] - right[1] * down[0]) <= _PARALLEL * lengths:
        raise ValueError(
            "grid must not be vertical: seen from above, its rows and columns are parallel"
        )
    corner = place.to_map(origin_m)[:2] - (right + down) / 2
    return (
        *(float(right[0]), float(down[0]), float(corner[0])),
        *(float(right[1]), float(down[1]), float(corner[1])),
    )


def completed_steps(
    shape: tuple[int, int], row_step: NDArray[np.float64], column_step: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the row step and the column step of a grid, with those that are zero replaced.

    A single row or column may have no step: it is then as wide as the pixels of the other axis,
    which is turned by a quarter about the vertical. Steps have two or three coordinates. They stay
    zero where the other one is zero or vertical.
    """
    rows, columns = shape
    if rows == 1 and not row_step.any():
        row_step = _turned(column_step)
    if columns == 1 and not column_step.any():
        column_step = -_turned(row_step)
    return row_step, column_step


def north_up(place: Georeference, grid: Grid, pixel_m: float | None = None) -> Grid:
    """Return the smallest horizontal grid along the axes of the map that covers another one."""
    turn = affine(place, grid)
    origin_m, row_step_m, column_step_m = grid.vectors_m
    if grid.height_m is not None or row_step_m[2] or column_step_m[2]:
        raise ValueError("grid must be a horizontal plane to be turned, got another one")
    if pixel_m is None:
        pixel_m = min(math.hypot(turn[0], turn[3]), math.hypot(turn[1], turn[4]))
    pixel_m = validate.positive("pixel_m", pixel_m, "m")
    left, bottom, rows, columns = cover(grid.shape, turn, pixel_m)
    validate.memory("pixel_m", 8 * rows * columns)
    first_m = place.from_map([(left + 0.5) * pixel_m, (bottom + 0.5) * pixel_m, 0.0])
    first_m[2] = origin_m[2]
    steps_m = np.zeros((2, 3))  # of columns to the east, and of rows to the north
    steps_m[:, :2] = pixel_m * place.axes.T
    return Grid.oriented(first_m, steps_m[1], steps_m[0], (rows, columns), georeference=place)


def cover(
    shape: tuple[int, ...], affine: tuple[float, ...], pixel_m: float
) -> tuple[int, int, int, int]:
    """Return the north-up raster of whole multiples of a pixel that covers another raster.

    Parameters
    ----------
    shape : (rows, columns)
    affine : tuple of float
        Transform from columns and rows to easting and northing.
    pixel_m : float
        Size of the new pixels, metres.

    Returns
    -------
    left, bottom : int
        Edges of the new raster, in pixels.
    rows, columns : int
        Number of its pixels.
    """
    a, b, c, d, e, f = affine
    rows, columns = shape
    corners = [(i * columns, j * rows) for i in (0, 1) for j in (0, 1)]
    east = [a * across + b * down + c for across, down in corners]
    north = [d * across + e * down + f for across, down in corners]
    # Rounding must not add a row or column of pixels that see nothing.
    left, bottom = (math.floor(min(each) / pixel_m + 1e-6) for each in (east, north))
    right, top = (math.ceil(max(each) / pixel_m - 1e-6) for each in (east, north))
    return left, bottom, top - bottom, right - left


def _turned(step: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the horizontal part of a step, turned by a quarter from x to y."""
    turned = np.zeros_like(step)
    turned[:2] = -step[1], step[0]
    return turned


def _on_map(place: Georeference, step_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a step's easting and northing, exactly 0 if it is so but for rounding."""
    found = step_m[:2] @ place.axes
    found[np.abs(found) < _ROUNDING * np.abs(found).max()] = 0.0
    return found
