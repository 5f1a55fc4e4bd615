"""Georeferences: where the coordinates of lines, grids and images lie on Earth.

A georeference is a tag that lines and grids carry. `clsas.maps` looks up its coordinate reference
system, converts to latitudes and longitudes, and places grids; methods import it when called.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.declared import Number
from clsas.engine.data.validate import ArgumentError

if TYPE_CHECKING:
    import pyproj

    from clsas import Grid

HEADING = Number(
    "degrees", least=-360.0, most=360.0, help="Heading of the x axis, clockwise from true north."
)
"""Declares the heading of a local georeference."""

_LOCAL = ("latitude_deg", "longitude_deg", "height_m", "heading_deg")
_MOST_HEIGHT_M = 1e5


@dataclass(frozen=True)
class Georeference:
    """Place of the coordinates x, y and z on Earth.

    There are two kinds. With `projected`, x and y are easting and northing of a map projection.
    With `local`, the origin has a latitude and longitude, and the x axis a heading. The map of a
    local georeference is a transverse Mercator projection centred on the origin.

    Lines, grids and tracks carry a georeference, which passes from lines to images, mosaics and
    files. Create one with `projected` or `local`, which check it.

    Attributes
    ----------
    crs : str or None
        Coordinate reference system in which x is the easting and y the northing, such as
        "EPSG:32632"; None for a local georeference.
    latitude_deg, longitude_deg : float or None
        Geodetic latitude and longitude (WGS 84) of the origin, degrees; None if projected.
    height_m : float or None
        Height of the origin, metres; None if projected.
    heading_deg : float or None
        Heading of the x axis, degrees clockwise from true north at the origin, from 0 up to 360;
        None if projected.
    vertical_datum : str or None
        Name of the surface from which heights are counted, such as "EGM2008". None means that of
        the coordinate reference system, or the WGS 84 ellipsoid.

    See Also
    --------
    Track.from_geographic : Track of latitudes and longitudes, with its georeference.
    export : Write an image as a map.

    Notes
    -----
    The scale of the transverse Mercator projection at its origin is ``1 + height_m / R``, where R
    is the Gaussian radius of curvature there. Distances in the scene are therefore true at the
    height of the origin, not on the ellipsoid. Up to 5 km from the origin they are true to 3e-7
    (Snyder 1987), plus up to 3e-7 for every kilometre of height or depth. On maps such as UTM,
    distances differ from true ones by up to 1e-3, which defocuses images of long apertures:
    prefer a local georeference for imaging.

    References
    ----------
    Snyder, "Map Projections: A Working Manual", US Geological Survey Professional Paper 1395, 1987.

    Examples
    --------
    A scene near Bergen whose x axis points to the south-west:

    >>> import clsas
    >>> place = clsas.Georeference.local(60.39, 5.32, heading_deg=217)
    >>> place
    Georeference(latitude 60.39 deg, longitude 5.32 deg, height 0 m, heading 217 deg)
    >>> grid = clsas.Grid.plane(x=(0, 50, 501), y=(20, 60, 401), georeference=place)
    """

    crs: str | None = None
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    height_m: float | None = None
    heading_deg: float | None = None
    vertical_datum: str | None = None

    def __post_init__(self) -> None:
        """Check every field and convert it."""

        def put(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        if self.vertical_datum is not None:
            put("vertical_datum", _words("vertical_datum", self.vertical_datum))
        local = [name for name in _LOCAL if getattr(self, name) is not None]
        if self.crs is not None:
            put("crs", _words("crs", self.crs))
            if local:
                raise ArgumentError(local[0], "be left out with `crs`, which places the origin")
            return
        for name in _LOCAL:
            if getattr(self, name) is None:
                raise ArgumentError(name, "be given unless `crs` is")
        latitude, longitude = checked_degrees(self.latitude_deg, self.longitude_deg, ())
        put("latitude_deg", float(latitude))
        put("longitude_deg", float(longitude))
        put("height_m", _height("height_m", self.height_m))
        put("heading_deg", _heading("heading_deg", self.heading_deg))

    def __repr__(self) -> str:
        """Return the coordinate reference system, or origin and heading."""
        return reprs.summary(self, *self._words())

    def __str__(self) -> str:
        """Return the coordinate reference system, or origin and heading, in words."""
        return ", ".join(self._words())

    def _words(self) -> list[str]:
        datum = [] if self.vertical_datum is None else [f"heights above {self.vertical_datum}"]
        if self.crs is not None:
            # WKT takes pages; its name is at the start.
            return [self.crs if len(self.crs) < 60 else f"{self.crs[:50]}...", *datum]
        return [
            f"latitude {self.latitude_deg:.10g} deg",
            f"longitude {self.longitude_deg:.10g} deg",
            f"height {self.height_m:.6g} m",
            f"heading {self.heading_deg:.8g} deg",
            *datum,
        ]

    @classmethod
    def projected(cls, crs: str, *, vertical_datum: str | None = None) -> Georeference:
        """Return the georeference of coordinates that are easting, northing and height.

        Parameters
        ----------
        crs : str
            Projected coordinate reference system in metres: "EPSG:32632", or anything else that
            pyproj reads, such as WKT.
        vertical_datum : str, optional
            Name of the surface from which z is counted.

        Raises
        ------
        TypeError, ValueError
            If `crs` is unknown, is not a projection in metres, or its axes do not point east and
            north, such as those of polar stereographic projections.
        ImportError
            If pyproj is not installed (extra `maps`).

        Examples
        --------
        >>> import clsas
        >>> clsas.Georeference.projected("epsg:32632")
        Georeference(EPSG:32632)
        """
        import clsas.maps

        name = clsas.maps.name_of_crs(_words("crs", crs))
        return cls(crs=name, vertical_datum=vertical_datum)

    @classmethod
    def local(
        cls,
        latitude_deg: float,
        longitude_deg: float,
        height_m: float = 0.0,
        *,
        heading_deg: Annotated[float, HEADING],
        vertical_datum: str | None = None,
    ) -> Georeference:
        """Return the georeference of coordinates about an origin.

        Parameters
        ----------
        latitude_deg, longitude_deg : float
            Geodetic latitude and longitude (WGS 84) of the origin, degrees: -90 to 90, and -180 to
            360.
        height_m : float
            Height of the origin above the WGS 84 ellipsoid or `vertical_datum`, metres; negative
            below it.
        heading_deg : float
            Heading of the x axis, degrees clockwise from true north, -360 to 360. The y axis points
            to port of it, and z up.
        vertical_datum : str, optional
            Name of the surface from which heights are counted.

        Raises
        ------
        TypeError, ValueError
            If a value is of another type or outside its limits.
        """
        return cls(
            latitude_deg=latitude_deg,
            longitude_deg=longitude_deg,
            height_m=height_m,
            heading_deg=heading_deg,
            vertical_datum=vertical_datum,
        )

    @property
    def is_projected(self) -> bool:
        """True if x and y are easting and northing of a coordinate reference system."""
        return self.crs is not None

    @property
    def is_north_up(self) -> bool:
        """True if x points east and y north on the map, so that x and y are its axes."""
        return self.is_projected or self.heading_deg == 90.0

    def wkt(self) -> str:
        """Return the coordinate reference system of the map as WKT, version 2:2019.

        Raises
        ------
        ValueError
            If the coordinate reference system is unknown.
        ImportError
            If pyproj is not installed (extra `maps`).
        """
        return self.map_crs().to_wkt("WKT2_2019")

    def map_crs(self) -> pyproj.CRS:
        """Return the coordinate reference system of the map as an object of pyproj.

        Raises
        ------
        ValueError, ImportError
            As for `wkt`.
        """
        import clsas.maps

        return clsas.maps.map_crs(self)

    def to_map(self, positions_m: ArrayLike) -> NDArray[np.float64]:
        """Return easting, northing and height of positions x, y, z, float64 [..., 3], metres.

        Raises
        ------
        TypeError, ValueError
            If the positions are not finite real numbers of shape [..., 3].
        """
        found = _positions("positions_m", positions_m).copy()
        if self.is_projected:
            return found
        found[..., :2] = found[..., :2] @ self.axes
        found[..., 2] += self.height_m or 0.0
        return found

    def from_map(self, places_m: ArrayLike) -> NDArray[np.float64]:
        """Return positions x, y, z from easting, northing and height, float64 [..., 3], metres.

        Raises
        ------
        TypeError, ValueError
            If the places are not finite real numbers of shape [..., 3].
        """
        found = _positions("places_m", places_m).copy()
        if self.is_projected:
            return found
        found[..., :2] = found[..., :2] @ self.axes.T
        found[..., 2] -= self.height_m or 0.0
        return found

    def to_geographic(self, positions_m: ArrayLike) -> NDArray[np.float64]:
        """Return latitude (deg), longitude (deg) and height (m) of positions, float64 [..., 3].

        Heights are not converted between vertical datums.

        Raises
        ------
        TypeError, ValueError
            If the positions are not finite real numbers of shape [..., 3], or lie outside the
            projection.
        ImportError
            If pyproj is not installed (extra `maps`).

        Warns
        -----
        ClsasWarning
            If PROJ lacks the grid of a datum shift that would be more accurate there.
        """
        import clsas.maps

        return clsas.maps.to_geographic(self, positions_m)

    def from_geographic(
        self, latitude_deg: ArrayLike, longitude_deg: ArrayLike, height_m: ArrayLike
    ) -> NDArray[np.float64]:
        """Return positions x, y, z of latitudes, longitudes and heights, float64 [..., 3], metres.

        Parameters
        ----------
        latitude_deg, longitude_deg : array_like
            Geodetic latitudes and longitudes (WGS 84), degrees.
        height_m : array_like
            Heights, metres, above the same surface as those of this georeference.

        Raises
        ------
        TypeError, ValueError
            If a value is outside its limits, latitude and longitude are probably swapped, or a
            position lies outside the projection.
        ImportError
            If pyproj is not installed (extra `maps`).

        Warns
        -----
        ClsasWarning
            As for `to_geographic`.

        Examples
        --------
        >>> import clsas
        >>> place = clsas.Georeference.local(60.39, 5.32, heading_deg=90)
        >>> place.from_geographic(60.39, 5.32, 10.0)
        array([ 0.,  0., 10.])
        """
        import clsas.maps

        return clsas.maps.from_geographic(self, latitude_deg, longitude_deg, height_m)

    def convergence_deg(
        self, latitude_deg: ArrayLike, longitude_deg: ArrayLike
    ) -> NDArray[np.float64]:
        """Return the angle from the map's north to true north, degrees, positive anticlockwise.

        A true heading is that on the map plus the convergence.

        Raises
        ------
        TypeError, ValueError, ImportError
            As for `from_geographic`.
        """
        import clsas.maps

        return clsas.maps.convergence_deg(self, latitude_deg, longitude_deg)

    def affine(self, grid: Grid) -> tuple[float, float, float, float, float, float]:
        """Return the transform from columns and rows of a grid to easting and northing.

        The numbers (a, b, c, d, e, f) are in the order of rasterio and of world files by columns:

            easting = a column + b row + c,   northing = d column + e row + f.

        Column and row count from the outer corner of pixel [0, 0], whose centre is at (0.5, 0.5),
        as GDAL does.

        Parameters
        ----------
        grid : Grid
            A plane or height map that is not vertical.

        Raises
        ------
        ValueError
            If the grid consists of points, or its rows and columns lie above each other.

        Examples
        --------
        >>> import clsas
        >>> place = clsas.Georeference.projected("EPSG:32632")
        >>> place.affine(clsas.Grid.plane((500_000, 500_100, 101), (6_700_000, 6_700_050, 101)))
        (1.0, 0.0, 499999.5, 0.0, 0.5, 6699999.75)
        """
        import clsas.maps

        return clsas.maps.affine(self, grid)

    def north_up(self, grid: Grid, pixel_m: float | None = None) -> Grid:
        """Return the smallest horizontal grid along the axes of the map that covers another one.

        Its columns run east and its rows north. Edges of its pixels are at whole multiples of their
        size, so that images of neighbouring scenes fit together.

        Parameters
        ----------
        grid : Grid
            A horizontal plane.
        pixel_m : float, optional
            Distance of its pixels, metres; by default the smaller one of `grid`.

        Raises
        ------
        TypeError, ValueError
            If the grid is not a horizontal plane, or `pixel_m` is not a positive number, or so
            small that pixels would not fit into memory.

        Examples
        --------
        >>> import clsas
        >>> place = clsas.Georeference.local(60.39, 5.32, heading_deg=45)
        >>> grid = clsas.Grid.plane((0, 10, 101), (20, 25, 51), georeference=place)
        >>> north_up = place.north_up(grid)
        >>> north_up.shape
        (109, 108)
        >>> place.affine(north_up)[1], place.affine(north_up)[3]
        (0.0, 0.0)
        """
        import clsas.maps

        return clsas.maps.north_up(self, grid, pixel_m)

    @property
    def axes(self) -> NDArray[np.float64]:
        """Easting and northing of the unit vectors x and y, float64 [2, 2]."""
        if self.heading_deg is None:
            return np.eye(2)
        quarter, rest = divmod(self.heading_deg, 90.0)  # exact for multiples of 90 degrees
        sine, cosine = math.sin(math.radians(rest)), math.cos(math.radians(rest))
        for _ in range(int(quarter)):
            sine, cosine = cosine, -sine
        return np.array([[sine, cosine], [-cosine, sine]])


class Recorded(Protocol):
    """Range lines or echoes."""

    @property
    def georeference(self) -> Georeference | None:
        """Georeference of the coordinates; None if unknown."""


def placed(lines: Recorded, grid: Grid) -> Grid:
    """Return a grid with the georeference of the lines, unless it has one of its own.

    Raises
    ------
    ValueError
        If lines and grid have different georeferences.
    """
    if lines.georeference is None or lines.georeference == grid.georeference:
        return grid
    if grid.georeference is None:
        return replace(grid, georeference=lines.georeference)
    allowed = f"have the georeference of the lines ({lines.georeference})"
    raise ArgumentError("grid", allowed, str(grid.georeference))


def checked_degrees(
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
            hint = "`latitude_deg` and `longitude_deg` are probably swapped"
        raise ArgumentError(
            "latitude_deg", "be from -90 to 90 degrees", f"{_worst(latitude):.10g}", hint
        )
    if longitude.size and (longitude.min() < -180 or longitude.max() > 360):
        raise ArgumentError(
            "longitude_deg", "be from -180 to 360 degrees", f"{_worst(longitude):.10g}"
        )
    return latitude, np.where(longitude >= 180, longitude - 360, longitude)


def _worst(values: NDArray[np.float64]) -> float:
    """Return the value that is farthest from 0."""
    return float(values.reshape(-1)[np.abs(values).argmax()])


def _words(name: str, value: object) -> str:
    """Return a text that is not empty."""
    text = validate.text(name, value)
    if not text.strip():
        raise ArgumentError(name, "not be empty")
    if "\0" in text:  # PROJ would ignore everything after it
        raise ArgumentError(name, "be text without NUL", validate.shown(text))
    return text.strip()


def _height(name: str, value: Any) -> float:
    return validate.number(name, value, "m", least=-_MOST_HEIGHT_M, most=_MOST_HEIGHT_M)


def _heading(name: str, value: Any) -> float:
    return HEADING.check(name, value) % 360.0


def _positions(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Return positions [..., 3], checked."""
    found = validate.array(name, value, np.float64, None)
    if found.ndim == 0 or found.shape[-1] != 3:
        raise ArgumentError(name, "have shape [..., 3]", str(found.shape))
    return found
