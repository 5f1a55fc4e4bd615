"""Map projections and geographic coordinates, which pyproj knows."""

from __future__ import annotations

import math
import warnings
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.extras import needed

if TYPE_CHECKING:
    import pyproj

_SEMI_MAJOR_M, _SQUARED_ECCENTRICITY = 6378137.0, 0.0066943799901413165  # WGS 84
_DEGREE_KM = 111.3  # of latitude, to 1 %
_VERTICAL = ("up", "down")  # directions of the third axis


def checked(
    latitude_deg: Any, longitude_deg: Any, shape: tuple[int | None, ...] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return latitudes and longitudes, checked; longitudes are from -180 up to 180 degrees.

    Raises
    ------
    TypeError, ValueError
        If a value is outside its limits; the message says so if both are probably swapped.
    """
    if shape == ():
        latitude = np.array(validate.number("latitude_deg", latitude_deg, "degrees"))
        longitude = np.array(validate.number("longitude_deg", longitude_deg, "degrees"))
    else:
        latitude = validate.array("latitude_deg", latitude_deg, np.float64, shape)
        longitude = validate.array("longitude_deg", longitude_deg, np.float64, shape)
    farthest = np.abs(latitude).max(initial=0.0)
    if farthest > 90:
        hint = ""
        if farthest <= 360 and np.abs(longitude).max(initial=0.0) <= 90:
            hint = "; latitude_deg and longitude_deg are probably swapped"
        raise ValueError(
            f"latitude_deg must be from -90 to 90 degrees, got {_worst(latitude):.10g}{hint}"
        )
    if longitude.size and (longitude.min() < -180 or longitude.max() > 360):
        raise ValueError(
            f"longitude_deg must be from -180 to 360 degrees, got {_worst(longitude):.10g}"
        )
    return latitude, np.where(longitude >= 180, longitude - 360, longitude)


def alike(*arrays: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Return latitudes, longitudes and perhaps heights, broadcast to the same shape."""
    try:
        return np.broadcast_arrays(*arrays)
    except ValueError:
        names = ("latitude_deg", "longitude_deg", "height_m")[: len(arrays)]
        raise ValueError(
            f"{', '.join(names)} must have the same shape, got "
            f"{', '.join(str(each.shape) for each in arrays)}"
        ) from None


def _worst(values: NDArray[np.float64]) -> float:
    """Return the value that is farthest from 0."""
    return float(values.reshape(-1)[np.abs(values).argmax()])


@lru_cache(maxsize=32)
def known(name: str) -> pyproj.CRS:
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
        raise ValueError(
            f"crs must be one that PROJ knows, such as 'EPSG:32632', got {validate.shown(name)} "
            f"({reason})"
        ) from None
    if not found.is_projected:
        kind = "a geographic one" if found.is_geographic else "another kind"
        raise ValueError(
            f"crs must be a projection with easting and northing in metres, such as 'EPSG:32632', "
            f"got {kind}: {validate.shown(name)}; for latitudes and longitudes use "
            "Georeference.local"
        )
    units = {axis.unit_name for axis in found.axis_info}
    if units - {"metre"}:
        raise ValueError(
            f"crs must be in metres, got {validate.shown(name)} in {', '.join(sorted(units))}"
        )
    # The order of the axes does not matter: coordinates are always given easting first.
    directions = [axis.direction for axis in found.axis_info if axis.direction not in _VERTICAL]
    if sorted(directions) != ["east", "north"]:
        raise ValueError(
            "crs must have axes that point east and north, got one whose axes point "
            f"{' and '.join(directions)}: {validate.shown(name)}; use a local georeference "
            "(latitude, longitude and heading), also near the poles, or UTM"
        )
    return found


def outside_km(crs: pyproj.CRS, latitude_deg: float, longitude_deg: float) -> float:
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


def scale_of(crs: pyproj.CRS, latitude_deg: float, longitude_deg: float) -> float:
    """Return the point scale of a map: the one along a meridian or parallel farther from 1."""
    import pyproj

    factors = pyproj.Proj(crs).get_factors(longitude_deg, latitude_deg)
    return max(factors.meridional_scale, factors.parallel_scale, key=lambda scale: abs(scale - 1))


def to_map(crs: pyproj.CRS) -> pyproj.Transformer:
    """Return the transform from longitude and latitude (WGS 84) to easting and northing."""
    import pyproj

    return pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)


def warn_of_missing_grid(
    crs: pyproj.CRS, name: str, latitude_deg: float, longitude_deg: float
) -> None:
    """Warn if PROJ lacks the grid of a datum shift that is better than the one it uses at a place.

    Warns
    -----
    ClsasWarning
        The message states both accuracies and the grid.
    """
    from pyproj.transformer import AreaOfInterest, TransformerGroup

    transform = to_map(crs)
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
        f"PROJ converts between WGS 84 and {name} with {accuracy} instead of {best.accuracy:g} m, "
        f"because it lacks {' and '.join(grids)}: run "
        f"{' and '.join(f'`pyproj sync --file {grid}`' for grid in grids)}, or set the environment "
        "variable PROJ_NETWORK to ON"
    )


@lru_cache(maxsize=32)
def centred_on(latitude_deg: float, longitude_deg: float, height_m: float) -> pyproj.CRS:
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
