"""Grids on maps: their transform to easting and northing, and grids along the axes of the map.

These functions are methods of `Georeference`, which documents them.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.engine.data.validate import ArgumentError
from clsas.maps.georeferencing import geographic

if TYPE_CHECKING:
    import pyproj

Affine = tuple[float, float, float, float, float, float]
"""Transform from columns and rows to easting and northing: see `Georeference.affine`."""

_ROUNDING = 1e-12  # part of a step that may come from rounding: 1e-7 pixels over 100 000
# Distance outside the area of use that is no mistake: zones of UTM are used as far beyond their
# edges, such as zone 32 in western Norway. Places near x = 0 are farther away.
_OUTSIDE_KM = 150.0
_DEGREE_KM = 111.3  # of latitude, to 1 %
_SCALE = 0.01  # difference of the scale from 1 that is probably a mistake: 0.001 within UTM zones
_PARALLEL = 1e-6  # sine of the least angle between rows and columns, seen from above


def affine(place: Georeference, grid: Grid) -> Affine:
    """Return the transform from columns and rows of a grid to easting and northing."""
    validate.instance("grid", grid, Grid)
    right, down = _steps(place, grid)
    if _are_parallel(right, down):
        hint = "seen from above, its rows and columns are parallel"
        raise ArgumentError("grid", "not be vertical", hint=hint)
    corner = place.to_map(grid.vectors_m[0])[:2] - (right + down) / 2
    return (
        *(float(right[0]), float(down[0]), float(corner[0])),
        *(float(right[1]), float(down[1]), float(corner[1])),
    )


def is_vertical(place: Georeference, grid: Grid) -> bool:
    """Return True if rows and columns of a grid that has them are parallel, seen from above."""
    return _are_parallel(*_steps(place, grid))


def _steps(place: Georeference, grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return easting and northing of the steps from column to column and from row to row."""
    _, row_step_m, column_step_m = grid.vectors_m
    right, down = (_on_map(place, step) for step in (column_step_m, row_step_m))
    down, right = completed_steps((grid.shape[0], grid.shape[1]), down, right)
    return right, down


def _are_parallel(right: NDArray[np.float64], down: NDArray[np.float64]) -> bool:
    """Return True if two steps on the map are parallel, or one of them is 0."""
    lengths = math.hypot(*right) * math.hypot(*down)
    return bool(abs(right[0] * down[1] - right[1] * down[0]) <= _PARALLEL * lengths)


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
        raise ArgumentError("grid", "be a horizontal plane to be turned")
    if pixel_m is None:
        pixel_m = min(math.hypot(turn[0], turn[3]), math.hypot(turn[1], turn[4]))
    pixel_m = validate.positive("pixel_m", pixel_m, "m")
    sides_m = [
        n * float(np.linalg.norm(step_m))
        for n, step_m in zip(grid.shape, (row_step_m, column_step_m), strict=True)
    ]
    across_m = max(sides_m)
    if pixel_m > across_m:
        allowed = f"be at most the longer side of the grid, {across_m:.4g} m"
        raise ArgumentError("pixel_m", allowed, f"{pixel_m:.4g} m")
    validate.memory("pixel_m", 8 * (sides_m[0] / pixel_m) * (sides_m[1] / pixel_m))
    left, bottom, rows, columns = cover(grid.shape, turn, pixel_m)
    first_m = place.from_map([(left + 0.5) * pixel_m, (bottom + 0.5) * pixel_m, 0.0])
    first_m[2] = origin_m[2]
    steps_m = np.zeros((2, 3))  # of columns to the east, and of rows to the north
    steps_m[:, :2] = pixel_m * place.axes.T
    return Grid.oriented(first_m, steps_m[1], steps_m[0], (rows, columns), georeference=place)


def warn_of_place(grid: Grid) -> None:
    """Warn if the middle of a grid lies where its map projection is not meant to be used.

    Warns
    -----
    ClsasWarning
        If it is outside the map, far outside the area of use of the coordinate reference system, or
        if the scale differs from 1 by more than 1 % there.
    """
    place = grid.georeference
    if place is None or not place.is_projected:
        return
    hint = "; check the coordinate reference system, and that x and y are easting and northing"
    crs = place.map_crs()
    try:
        latitude, longitude, _ = geographic(place, np.mean(grid.bounds_m, axis=0))
    except ValueError:
        validate.warn(f"the middle of the grid is outside the map of {place}{hint}")
        return
    outside_km = _outside_km(crs, latitude, longitude)
    scale = _scale_of(crs, latitude, longitude)
    is_outside = outside_km > _OUTSIDE_KM
    if is_outside or not abs(scale - 1) <= _SCALE:
        area = f"{outside_km:.0f} km outside the area of use of {place}, " if is_outside else ""
        validate.warn(
            f"the middle of the grid is at latitude {latitude:.4f}, longitude {longitude:.4f}, "
            f"{area}where distances on the map are {scale:.4g} times true ones{hint}"
        )


def _outside_km(crs: pyproj.CRS, latitude_deg: float, longitude_deg: float) -> float:
    """Return about how far a place lies outside the area of use of a map; 0 if none is known."""
    area = crs.area_of_use
    if area is None and crs.sub_crs_list:  # a compound one, with heights
        area = crs.sub_crs_list[0].area_of_use
    if area is None:
        return 0.0
    north = max(area.south - latitude_deg, latitude_deg - area.north, 0.0)
    east = 0.0
    if area.east - area.west < 360:
        # An area across the antimeridian has its western edge east of the eastern one.
        width = (area.east - area.west) % 360
        past = (longitude_deg - area.west) % 360
        east = 0.0 if past <= width else min(past - width, 360 - past)
    return math.hypot(north, east * math.cos(math.radians(latitude_deg))) * _DEGREE_KM


def _scale_of(crs: pyproj.CRS, latitude_deg: float, longitude_deg: float) -> float:
    """Return the point scale of a map: the one along a meridian or parallel farther from 1."""
    import pyproj

    factors = pyproj.Proj(crs).get_factors(longitude_deg, latitude_deg)
    return max(factors.meridional_scale, factors.parallel_scale, key=lambda scale: abs(scale - 1))


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
    return left, bottom, max(top - bottom, 1), max(right - left, 1)


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
