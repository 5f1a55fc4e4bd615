"""Conversions of positions and tracks to maps, and to and from latitudes and longitudes.

`Georeference` and `Track.from_geographic` document these functions. pyproj, which knows the
projections, is imported only when it is used.
"""

from __future__ import annotations

import math
import warnings
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import validate
from clsas.engine.data.extras import needed
from clsas.engine.data.georeference import Georeference, checked_degrees
from clsas.engine.data.validate import ArgumentError

if TYPE_CHECKING:
    import pyproj

_SEMI_MAJOR_M, _SQUARED_ECCENTRICITY = 6378137.0, 0.0066943799901413165  # WGS 84
_VERTICAL = ("up", "down")  # directions of the third axis
_ALIGNED = 0.5  # mean length of unit vectors, above which headings have a common direction
# Largest drift angle of a platform that is believed, and the best agreement needed to suspect
# radians, degrees: plain choices, since crab angles rarely exceed 30 degrees.
_MOST_DRIFT_DEG, _AGREEMENT_DEG = 30.0, 15.0


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
    frame = georeference or _georeference_of(latitude, longitude, height, heading)
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


def _georeference_of(
    latitude_deg: NDArray[np.float64],
    longitude_deg: NDArray[np.float64],
    height_m: NDArray[np.float64],
    heading_deg: NDArray[np.float64],
) -> Georeference:
    """Return a local georeference at the middle of a track, whose x axis has its mean heading.

    If headings have no common direction, as on parallel lines there and back, the x axis has the
    first of them. The numbers are rounded, to 0.1 m and 0.01 degrees.
    """
    turns = (longitude_deg - longitude_deg[0] + 180) % 360 - 180  # also across 180 degrees
    longitude = (longitude_deg[0] + turns.mean() + 180) % 360 - 180
    direction = np.exp(1j * np.radians(heading_deg)).mean()
    heading = np.degrees(np.angle(direction)) if abs(direction) > _ALIGNED else heading_deg[0]
    return Georeference.local(
        round(float(latitude_deg.mean()), 6),
        round(float(longitude), 6),
        round(float(height_m.mean()), 1),
        heading_deg=round(float(heading), 2) % 360,
    )


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
