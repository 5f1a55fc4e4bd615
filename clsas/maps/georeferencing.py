"""Where positions, tracks and grids lie on a map and on Earth.

`Georeference` and `Track.from_geographic` document most of these functions, in this order:
coordinate reference systems, positions, tracks, and grids. `Orientation` turns rasters by quarters,
so that they look like a map. pyproj, which knows the projections, is imported only when it is used.
"""

from __future__ import annotations

import itertools
import math
import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import validate
from clsas.engine.data.extras import needed
from clsas.engine.data.georeference import Georeference, checked_degrees
from clsas.engine.data.grid import Grid
from clsas.engine.data.validate import ArgumentError

if TYPE_CHECKING:
    import pyproj

Affine = tuple[float, float, float, float, float, float]
"""Transform from columns and rows to easting and northing: see `Georeference.affine`."""

_SEMI_MAJOR_M, _SQUARED_ECCENTRICITY = 6378137.0, 0.0066943799901413165  # WGS 84
_VERTICAL = ("up", "down")  # directions of the third axis
_ALIGNED = 0.5  # mean length of unit vectors, above which headings have a common direction
# Largest drift angle of a platform that is believed, and the best agreement needed to suspect
# radians, degrees: plain choices, since crab angles rarely exceed 30 degrees.
_MOST_DRIFT_DEG, _AGREEMENT_DEG = 30.0, 15.0
_ROUNDING = 1e-12  # part of a step that may come from rounding: 1e-7 pixels over 100 000
# Distance outside the area of use that is no mistake: zones of UTM are used as far beyond their
# edges, such as zone 32 in western Norway. Places near x = 0 are farther away.
_OUTSIDE_KM = 150.0
_DEGREE_KM = 111.3  # of latitude, to 1 %
_SCALE = 0.01  # difference of the scale from 1 that is probably a mistake: 0.001 within UTM zones
_PARALLEL = 1e-6  # sine of the least angle between rows and columns, seen from above
_SAME = 1e-9  # smallest gain for which a raster is turned, far above rounding


# Coordinate reference systems


def name_of_crs(crs: str) -> str:
    """Return the name of a projected coordinate reference system, such as "EPSG:32632".

    If no authority lists it, that is the text itself.
    """
    authority = _known(crs).to_authority(min_confidence=100)
    return crs if authority is None else ":".join(authority)


def map_crs(place: Georeference) -> pyproj.CRS:
    """Return the coordinate reference system of the map of a georeference."""
    if place.crs is not None:
        return _known(place.crs)
    assert place.latitude_deg is not None
    assert place.longitude_deg is not None
    assert place.height_m is not None
    return _centred_on(place.latitude_deg, place.longitude_deg, place.height_m)


@lru_cache(maxsize=32)
def _known(name: str) -> pyproj.CRS:
    """Return a projected coordinate reference system that `Georeference.projected` accepts.

    Raises
    ------
    ValueError
        If it is unknown, not a projection in metres, or its axes do not point east and north.
    """
    with needed("coordinate reference systems"):
        import pyproj
        from pyproj.exceptions import CRSError
    try:
        found = pyproj.CRS.from_user_input(name)
    except CRSError as error:
        reason = str(error).partition("(Internal Proj Error: ")[2].rstrip(")") or "not a CRS"
        allowed = "be one that PROJ knows, such as 'EPSG:32632'"
        raise ArgumentError("crs", allowed, f"{validate.shown(name)} ({reason})") from None
    if not found.is_projected:
        kind = "a geographic one" if found.is_geographic else "of another kind"
        raise ArgumentError(
            "crs",
            "be a projection with easting and northing in metres, such as 'EPSG:32632'",
            f"{validate.shown(name)}, {kind}",
            "for latitudes and longitudes use `Georeference.local`",
        )
    units = {axis.unit_name for axis in found.axis_info}
    if units - {"metre"}:
        given = f"{validate.shown(name)} in {', '.join(sorted(units))}"
        raise ArgumentError("crs", "be in metres", given)
    # The order of the axes does not matter: coordinates are always given easting first.
    directions = [axis.direction for axis in found.axis_info if axis.direction not in _VERTICAL]
    if sorted(directions) != ["east", "north"]:
        raise ArgumentError(
            "crs",
            "have axes that point east and north",
            f"{validate.shown(name)}, whose axes point {' and '.join(directions)}",
            "use a local georeference (latitude, longitude and heading), also near the poles, or "
            "UTM",
        )
    return found


@lru_cache(maxsize=32)
def _centred_on(latitude_deg: float, longitude_deg: float, height_m: float) -> pyproj.CRS:
    """Return the transverse Mercator projection of WGS 84 centred on an origin.

    Its scale there is that of the height, relative to the ellipsoid.
    """
    with needed("coordinate reference systems"):
        from pyproj.crs import ProjectedCRS
        from pyproj.crs.coordinate_operation import TransverseMercatorConversion
    sine = math.sin(math.radians(latitude_deg))
    # Gaussian radius of curvature
    radius_m = _SEMI_MAJOR_M * math.sqrt(1 - _SQUARED_ECCENTRICITY)
    radius_m /= 1 - _SQUARED_ECCENTRICITY * sine**2
    conversion = TransverseMercatorConversion(
        latitude_natural_origin=latitude_deg,
        longitude_natural_origin=longitude_deg,
        scale_factor_natural_origin=1 + height_m / radius_m,
    )
    name = f"Transverse Mercator about {latitude_deg:.8g}, {longitude_deg:.9g} (WGS 84)"
    return ProjectedCRS(conversion, name=name, geodetic_crs="EPSG:4326")


def _transform(crs: pyproj.CRS) -> pyproj.Transformer:
    """Return the transform from longitude and latitude (WGS 84) to easting and northing."""
    import pyproj

    return pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)


# Positions


def to_geographic(place: Georeference, positions_m: ArrayLike) -> NDArray[np.float64]:
    """Return latitude, longitude (deg) and height (m) of positions x, y, z, float64 [..., 3]."""
    found = geographic(place, positions_m)
    _warn_of_missing_grid(place, found)
    return found


def geographic(place: Georeference, positions_m: ArrayLike) -> NDArray[np.float64]:
    """Return what `to_geographic` does, and leave out its warning."""
    place_m = place.to_map(positions_m)
    easting_m, northing_m = place_m[..., 0], place_m[..., 1]
    longitude, latitude = _transform(map_crs(place)).transform(
        easting_m, northing_m, direction="INVERSE"
    )
    found = np.stack([latitude, longitude, place_m[..., 2]], axis=-1)
    if not np.isfinite(found).all():
        raise ArgumentError("positions_m", f"lie within the map of {place}")
    return found


def from_geographic(
    place: Georeference, latitude_deg: ArrayLike, longitude_deg: ArrayLike, height_m: ArrayLike
) -> NDArray[np.float64]:
    """Return positions x, y, z of latitudes, longitudes and heights, float64 [..., 3], metres."""
    latitude, longitude = checked_degrees(latitude_deg, longitude_deg)
    height = validate.array("height_m", height_m, np.float64, None)
    latitude, longitude, height = _alike(latitude, longitude, height)
    easting_m, northing_m = _transform(map_crs(place)).transform(longitude, latitude)
    place_m = np.stack([easting_m, northing_m, height], axis=-1)
    if not np.isfinite(place_m).all():
        raise ArgumentError(
            "latitude_deg", f"lie within the map of {place}, together with `longitude_deg`"
        )
    _warn_of_missing_grid(place, np.stack([latitude, longitude], axis=-1))
    return place.from_map(place_m)


def convergence_deg(
    place: Georeference, latitude_deg: ArrayLike, longitude_deg: ArrayLike
) -> NDArray[np.float64]:
    """Return the angle from the map's north to true north, degrees, positive anticlockwise."""
    latitude, longitude = _alike(*checked_degrees(latitude_deg, longitude_deg))
    crs = map_crs(place)  # raises if pyproj is missing
    import pyproj

    factors = pyproj.Proj(crs).get_factors(longitude, latitude)
    return np.asarray(factors.meridian_convergence, np.float64)


def _alike(*arrays: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Return latitudes, longitudes and perhaps heights, broadcast to the same shape."""
    try:
        return np.broadcast_arrays(*arrays)
    except ValueError:
        names = ("latitude_deg", "longitude_deg", "height_m")[: len(arrays)]
        shapes = ", ".join(str(each.shape) for each in arrays)
        raise ArgumentError(", ".join(names), "have the same shape", shapes) from None


def _warn_of_missing_grid(place: Georeference, geographic_deg: NDArray[np.float64]) -> None:
    """Warn if PROJ lacks a better datum shift at the first of latitudes and longitudes.

    Warns
    -----
    ClsasWarning
        The message states both accuracies and the grid.
    """
    if not place.is_projected or not geographic_deg.size:
        return
    from pyproj.transformer import AreaOfInterest, TransformerGroup

    crs = map_crs(place)
    latitude_deg, longitude_deg = geographic_deg.reshape(-1, geographic_deg.shape[-1])[0, :2]
    transform = _transform(crs)
    transform.transform(longitude_deg, latitude_deg)
    used_m = transform.get_last_used_operation().accuracy
    if used_m == 0:  # no shift, as between WGS 84 and its UTM
        return
    there = AreaOfInterest(longitude_deg, latitude_deg, longitude_deg, latitude_deg)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # pyproj's own, without the accuracies
        group = TransformerGroup("EPSG:4326", crs, always_xy=True, area_of_interest=there)
    # PROJ gives -1 for an unknown accuracy, which is that of conversions without a datum shift.
    limit_m = used_m if used_m > 0 else math.inf
    better = [each for each in group.unavailable_operations if 0 <= each.accuracy < limit_m]
    if not better:
        return
    best = min(better, key=lambda operation: operation.accuracy)
    grids = [grid.short_name for grid in best.grids if not grid.available]
    accuracy = f"an accuracy of {used_m:g} m" if used_m > 0 else "unknown accuracy"
    validate.warn(
        f"PROJ converts between WGS 84 and {place} with {accuracy} instead of {best.accuracy:g} m, "
        f"because it lacks {' and '.join(grids)}: run "
        f"{' and '.join(f'`pyproj sync --file {grid}`' for grid in grids)}, or set the environment "
        "variable PROJ_NETWORK to ON"
    )


# Tracks


def geographic_poses(
    latitude_deg: ArrayLike,
    longitude_deg: ArrayLike,
    height_m: ArrayLike,
    heading_deg: ArrayLike,
    georeference: Georeference | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], Georeference]:
    """Return positions [pings, 3] and yaw angles [pings] (rad) of a track, and its georeference.

    Parameters and errors are those of `Track.from_geographic`.
    """
    validate.instance("georeference", georeference, Georeference, type(None))
    latitude, longitude = checked_degrees(latitude_deg, longitude_deg, (None,))
    if len(longitude) != len(latitude):
        allowed = f"have shape ({len(latitude)},) like `latitude_deg`"
        raise ArgumentError("longitude_deg", allowed, str(longitude.shape))
    height = validate.array("height_m", height_m, np.float64, latitude.shape, broadcast=True)
    heading = validate.array("heading_deg", heading_deg, np.float64, latitude.shape, broadcast=True)
    if np.abs(heading).max() > 360:
        worst = f"{heading[np.abs(heading).argmax()]:g}"
        raise ArgumentError("heading_deg", "be from -360 to 360 degrees", worst)
    _check_headings(latitude, longitude, heading)
    frame = georeference
    if frame is None:
        # At the middle of the track, with the mean heading of its x axis, or the first one if
        # headings have no common direction, as on parallel lines there and back.
        turns = (longitude - longitude[0] + 180) % 360 - 180  # also across 180 degrees
        direction = np.exp(1j * np.radians(heading)).mean()
        along = np.degrees(np.angle(direction)) if abs(direction) > _ALIGNED else heading[0]
        frame = Georeference.local(
            round(float(latitude.mean()), 6),
            round(float((longitude[0] + turns.mean() + 180) % 360 - 180), 6),
            round(float(height.mean()), 1),
            heading_deg=round(float(along), 2) % 360,
        )
    positions_m = frame.from_geographic(latitude, longitude, height)
    on_map = heading - frame.convergence_deg(latitude, longitude)
    lost = np.flatnonzero(~np.isfinite(positions_m.sum(axis=1) + on_map))
    if lost.size:
        raise ArgumentError(
            "latitude_deg",
            f"lie on one map, together with `longitude_deg`, but those of ping {lost[0]}, "
            f"{latitude[lost[0]]:g} and {longitude[lost[0]]:g}, are on another side of the Earth",
            hint="probably a wrong fix",
        )
    of_x_axis = 90.0 if frame.heading_deg is None else frame.heading_deg
    yaw = np.radians((of_x_axis - on_map + 180) % 360 - 180)
    return positions_m, yaw, frame


def _check_headings(
    latitude: NDArray[np.float64], longitude: NDArray[np.float64], heading: NDArray[np.float64]
) -> None:
    """Raise ValueError if headings are probably in radians: then they agree with the course."""
    if len(heading) < 2 or np.abs(heading).max() > 2 * np.pi:
        return
    about = Georeference.local(latitude[0], longitude[0], heading_deg=90.0)
    east_m, north_m, _ = about.from_geographic(latitude, longitude, 0.0).T
    steps = np.diff(north_m) + 1j * np.diff(east_m)  # their angles are courses
    if not np.abs(steps).any():
        return
    in_degrees, in_radians = (
        abs(np.degrees(np.angle((steps * np.exp(-1j * (angles[1:] + angles[:-1]) / 2)).sum())))
        for angles in (np.radians(heading), heading)
    )
    if in_degrees > _MOST_DRIFT_DEG and in_radians < _AGREEMENT_DEG:
        raise ArgumentError(
            "heading_deg",
            f"be in degrees, but the headings up to {np.abs(heading).max():.3g} are "
            f"{in_degrees:.0f} degrees off the course of the track, and {in_radians:.0f} degrees "
            "as radians",
            hint="convert them with `numpy.degrees`",
        )


# Grids and rasters


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
    right, down = (step_m[:2] @ place.axes for step_m in (column_step_m, row_step_m))
    for step in (right, down):  # exactly 0 if it is so but for rounding
        step[np.abs(step) < _ROUNDING * np.abs(step).max()] = 0.0
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
        row_step = _quarter_turned(column_step)
    if columns == 1 and not column_step.any():
        column_step = -_quarter_turned(row_step)
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


def _quarter_turned(step: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the horizontal part of a step, turned by a quarter from x to y."""
    turned = np.zeros_like(step)
    turned[:2] = -step[1], step[0]
    return turned


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
    crs = place.map_crs()  # raises if pyproj is missing
    import pyproj

    try:
        latitude, longitude, _ = geographic(place, np.mean(grid.bounds_m, axis=0))
    except ValueError:
        validate.warn(f"the middle of the grid is outside the map of {place}{hint}")
        return
    outside_km = _outside_km(crs, latitude, longitude)
    factors = pyproj.Proj(crs).get_factors(longitude, latitude)
    scales = factors.meridional_scale, factors.parallel_scale
    scale = max(scales, key=lambda each: abs(each - 1))
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


@dataclass(frozen=True)
class Orientation:
    """An image's rows and columns in the order of its raster.

    Programs for maps expect the first row in the north and the first column in the west, and some
    ignore other orders. Turning by quarters and mirroring rows moves no pixel off the grid.

    Attributes
    ----------
    shape : (rows, columns)
        Shape of the raster.
    affine : tuple of float
        Transform from columns and rows of the raster to easting and northing.
    transposed : bool
        True if rows of the image are columns of the raster.
    rows_reversed, columns_reversed : bool
        True if rows or columns of the raster, after transposition, are in reverse order.
    """

    shape: tuple[int, int]
    affine: Affine
    transposed: bool = False
    rows_reversed: bool = False
    columns_reversed: bool = False

    @classmethod
    def of(cls, shape: tuple[int, int], affine: Affine) -> Orientation:
        """Return the orientation closest to north-up of an image with a shape and a transform.

        The raster is never mirrored.
        """
        best, best_score = None, -math.inf
        for transposed, rows, columns in itertools.product((False, True), repeat=3):
            a, b, c, d, e, f = affine
            down, across = shape
            if transposed:
                a, b, d, e, down, across = b, a, e, d, across, down
            if rows:
                b, c, e, f = -b, c + down * b, -e, f + down * e
            if columns:
                a, c, d, f = -a, c + across * a, -d, f + across * d
            if a * e - b * d > 0:
                continue  # mirrored
            score = a / math.hypot(a, d) - e / math.hypot(b, e)
            if score > best_score + _SAME:
                # Adding 0 turns -0 into 0.
                turned = a + 0.0, b + 0.0, c, d + 0.0, e + 0.0, f
                best = cls((down, across), turned, transposed, rows, columns)
                best_score = score
        assert best is not None  # one of the eight is not mirrored
        return best

    @property
    def is_north_up(self) -> bool:
        """True if rows of the raster run east and columns south."""
        return self.affine[1] == 0 and self.affine[3] == 0

    def window(self, rows: slice, columns: slice) -> tuple[slice, slice]:
        """Return the rows and columns of the raster that show a window of the image."""
        parts = (columns, rows) if self.transposed else (rows, columns)
        down, across = (
            slice(n - part.stop, n - part.start) if is_reversed else part
            for part, n, is_reversed in zip(
                parts, self.shape, (self.rows_reversed, self.columns_reversed), strict=True
            )
        )
        return down, across

    def vectors_m(self, grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the position of the raster's first pixel, [3], and its steps, metres.

        The steps, float64 [2, 3], lead from row to row and from column to column.
        """
        first_m, *given_m = grid.vectors_m
        steps_m = np.stack(given_m[::-1] if self.transposed else given_m)
        for axis, is_reversed in enumerate((self.rows_reversed, self.columns_reversed)):
            if is_reversed:
                first_m = first_m + (self.shape[axis] - 1) * steps_m[axis]
                steps_m[axis] = -steps_m[axis]
        return first_m, steps_m

    def turned(self, pixels: NDArray) -> NDArray:
        """Return a window of the image as the raster shows it, without copying."""
        turned = pixels.T if self.transposed else pixels
        return turned[:: -1 if self.rows_reversed else 1, :: -1 if self.columns_reversed else 1]
