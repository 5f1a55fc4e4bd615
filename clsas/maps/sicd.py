"""SICD files: complex radar images on planes, with the geometry of their collection."""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.polynomial import Polynomial, polynomial
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from clsas.engine.data import validate
from clsas.engine.data.atomic import replacing
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.extras import needed
from clsas.engine.data.geometry import bistatic_range_m, unit_vectors
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, cycles_per_m_at, wavelength_m
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.version import __version__
from clsas.engine.data.visibility import sines
from clsas.engine.signal.spectrum import measure_spectrum, power_spectrum
from clsas.maps.georeferencing import Orientation, geographic, warn_of_place
from clsas.maps.sources import Source
from clsas.measures.resolution import half_power_width

if TYPE_CHECKING:
    from clsas.maps.geotiff import Progress

SUFFIXES = (".nitf", ".ntf")
"""Suffixes of SICD files."""

_NAMESPACE = "urn:SICD:1.4.0"
_SIGN = -1  # of the exponent with which pixels are transformed to spatial frequencies
_LIGHT = 0.01  # relative difference of a radar's wave speed from that in a vacuum: air has 3e-4
_SKEW = 1e-3  # sine of the angle between rows and columns from 90 degrees that SICD allows
_SEPARATION = 0.02  # of transmitter and receiver over the range: ranges differ by 5e-5 at most
_OVERHEAD = 1e-3  # radians from the vertical within which there is no direction of range
_LEVEL = 1e-9  # slope of a horizontal plane, above rounding
# Pixels along either side of the grid to which polynomials are fitted, and their highest order:
# plain choices, with two pixels per coefficient.
_PIXELS, _HIGHEST = 9, 4
_HIGHEST_OF_TRACK = 9  # a circle to 1e-4 of its radius
# Deviation of the polynomials from the track over the distance to the scene. Programs find the
# direction of layover by them, which it changes by as many radians.
_DEVIATION = 1e-3
_BINS = 1024  # of a spectrum; twice as many change its width at half power by 1e-4 at most
_TIME, _FREQUENCY = 1e-3, 1e-2  # deviations over the duration and over the bandwidth that suffice
_INTERVAL_S = 1e-3  # between pings: equal ones, since range lines lack their times


def write(
    path: Path,
    source: Source,
    lines: RangeLines | None,
    beam: BeamWindow | None,
    tags: dict[str, Any],
    progress: Progress | None,
) -> None:
    """Write a SICD file; an existing file is replaced in one step.

    Raises
    ------
    ValueError
        If the image or its lines cannot be described by SICD, or the source changes.
    ImportError
        If sarkit or pyproj is not installed.
    OSError
        If the file cannot be written.
    """
    warn_of_place(source.grid)
    with needed("SICD files"):
        import pyproj  # noqa: F401  the geometry needs it
        import sarkit.sicd
    lines = _checked(source.grid, lines, sarkit.sicd.IS_SIZE_MAX)
    raster = Raster.of(source.grid, lines.phase_centres_m.mean(axis=0))
    distance_m = np.linalg.norm(lines.phase_centres_m - raster.positions_m(raster.centre), axis=1)
    apart_m = np.linalg.norm(lines.tx_m - lines.rx_m, axis=1)
    if (apart_m > _SEPARATION * distance_m).any():
        given = f"transmitters and receivers up to {apart_m.max():.4g} m apart"
        raise ArgumentError("lines", "be monostatic for SICD", given)
    collection = Collection.of(lines, beam)
    if not collection.band_hz[0] > 0:
        allowed = "have frequencies above 0 Hz with their `carrier_hz` for SICD"
        raise ArgumentError("lines", allowed, f"{collection.band_hz[0]:.4g} Hz")
    tree = _document(sarkit.sicd, raster, collection, tags)
    security = sarkit.sicd.NitfSecurityFields(clas="U")
    metadata = sarkit.sicd.NitfMetadata(
        xmltree=tree,
        file_header_part=sarkit.sicd.NitfFileHeaderPart(ostaid="clsas", security=security),
        im_subheader_part=sarkit.sicd.NitfImSubheaderPart(isorce="clsas", security=security),
        de_subheader_part=sarkit.sicd.NitfDeSubheaderPart(security=security),
    )
    layout = sarkit.sicd.jbp_from_nitf_metadata(metadata)
    with replacing(path) as temporary, temporary.open("wb") as file:
        with sarkit.sicd.NitfWriter(file, metadata, jbp_override=layout):
            first_byte = layout["ImageSegments"][0]["Data"].get_offset()
            _write_pixels(file, first_byte, source, raster, progress)
        source.check_unchanged()


def _checked(grid: Grid, lines: RangeLines | None, most_bytes: int) -> RangeLines:
    """Return the lines; raise ValueError if SICD cannot describe an image or its lines."""
    if not grid.is_planar:
        got = "points" if grid.points_m is not None else "a height map"
        raise ArgumentError("source", "be on a plane for SICD", got)
    if grid.georeference is None:
        allowed = "have a georeference for SICD, whose coordinates are fixed to the Earth"
        raise ArgumentError("source", allowed, hint="give `georeference`")
    if min(grid.shape) < 2 or 8 * grid.size > most_bytes:
        allowed = f"have at least 2 rows, 2 columns and at most {most_bytes // 8} pixels for SICD"
        raise ArgumentError("source", allowed, f"{grid.shape[0]} x {grid.shape[1]}")
    _, row_step_m, column_step_m = grid.vectors_m
    lengths = np.linalg.norm(row_step_m) * np.linalg.norm(column_step_m)
    if abs(row_step_m @ column_step_m) > _SKEW * lengths:
        raise ArgumentError("source", "have perpendicular rows and columns for SICD")
    if lines is None:
        allowed = "be given for SICD, which describes track and frequencies of the radar"
        raise ArgumentError("lines", allowed)
    if abs(lines.sound_speed_m_s / speed_of_light - 1) > _LIGHT:
        raise ArgumentError(
            "lines",
            "be those of a radar for SICD, whose waves have the speed of light",
            f"{lines.sound_speed_m_s:g} m/s",
            "export sonar images as a GeoTIFF with `kind='complex'`",
        )
    if lines.georeference not in (None, grid.georeference):
        allowed = f"have the georeference of the source ({grid.georeference})"
        raise ArgumentError("lines", allowed, str(lines.georeference))
    if not lines.samples.any():
        raise ArgumentError("lines", "have samples other than 0, from which the band is measured")
    if len(lines.ping_starts) < 2:
        raise ArgumentError("lines", "have at least 2 pings for SICD")
    if grid.georeference.vertical_datum is not None:
        validate.warn(
            f"heights above {grid.georeference.vertical_datum} are written as heights above the "
            "WGS 84 ellipsoid, since SICD knows no other"
        )
    return lines


@dataclass(frozen=True, eq=False)
class Raster:
    """Rows and columns of an image in the order of SICD: rows lead away from the radar.

    Attributes
    ----------
    orientation : Orientation
        How the pixels of the image are turned.
    first_m : float64 [3]
        Position of the raster's pixel [0, 0], in the image's coordinates.
    steps_m : float64 [2, 3]
        Steps from row to row and from column to column.
    georeference : Georeference
    """

    orientation: Orientation
    first_m: NDArray[np.float64]
    steps_m: NDArray[np.float64]
    georeference: Georeference

    @classmethod
    def of(cls, grid: Grid, radar_m: NDArray[np.float64]) -> Raster:
        """Return the raster of a plane that is seen from a position.

        Raises
        ------
        ValueError
            If the grid is vertical, or lies straight below the radar.
        """
        place = grid.georeference
        assert place is not None  # the caller has checked it
        a, b, c, d, e, f = place.affine(grid)
        towards_m = place.to_map(radar_m) - place.to_map(np.mean(grid.bounds_m, axis=0))
        east_m, north_m, _ = towards_m
        distance_m = float(np.hypot(east_m, north_m))
        if distance_m <= _OVERHEAD * np.linalg.norm(towards_m):
            raise ArgumentError("lines", "look at the grid from the side, not from straight above")
        # With the radar in the north, rows of a north-up map lead away from it.
        sine, cosine = east_m / distance_m, north_m / distance_m
        turned = (
            *(cosine * east - sine * north for east, north in ((a, d), (b, e), (c, f))),
            *(sine * east + cosine * north for east, north in ((a, d), (b, e), (c, f))),
        )
        orientation = Orientation.of((grid.shape[0], grid.shape[1]), turned)
        return cls(orientation, *orientation.vectors_m(grid), place)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns."""
        return self.orientation.shape

    @property
    def centre(self) -> NDArray[np.int64]:
        """Row and column of the scene centre point, int64 [2]."""
        return np.array(self.shape) // 2

    @property
    def corners(self) -> NDArray[np.int64]:
        """Rows and columns of the corners, clockwise from pixel [0, 0], int64 [4, 2]."""
        last_row, last_column = (n - 1 for n in self.shape)
        return np.array([[0, 0], [0, last_column], [last_row, last_column], [last_row, 0]])

    def positions_m(self, index: NDArray) -> NDArray[np.float64]:
        """Return the positions of rows and columns [..., 2], which may be fractions, [..., 3]."""
        return self.first_m + index @ self.steps_m

    def vectors_m(self) -> NDArray[np.float64]:
        """Return the steps from row to row and from column to column in ECF, [2, 3].

        They are chords through the scene centre point, since the Earth is round.
        """
        row, column = self.centre
        last_row, last_column = (n - 1 for n in self.shape)
        ends = np.array([[[0, column], [last_row, column]], [[row, 0], [row, last_column]]])
        first_m, last_m = np.moveaxis(_ecf_m(self.georeference, self.positions_m(ends)), 1, 0)
        return (last_m - first_m) / np.array([[last_row], [last_column]])


@dataclass(frozen=True, eq=False)
class Collection:
    """The range lines of an image, as its pixels receive them.

    Attributes
    ----------
    lines : RangeLines
    beam : BeamWindow or None
        Beam with which the image was formed.
    along : float64 [channels, 3] or None
        Direction of the track at every channel, to which the beam refers.
    cycles_per_m, amplitude : float64 [frequencies]
        Two-way phase per metre of range, cycles, over the band that the lines occupy, ascending;
        and the amplitude of the lines there.
    """

    lines: RangeLines
    beam: BeamWindow | None
    along: NDArray[np.float64] | None
    cycles_per_m: NDArray[np.float64]
    amplitude: NDArray[np.float64]

    @classmethod
    def of(cls, lines: RangeLines, beam: BeamWindow | None) -> Collection:
        """Return the collection of some lines, which must have samples other than 0."""
        spectrum = measure_spectrum(lines)
        frequency, power = power_spectrum(lines)
        offset = (frequency - spectrum.centre + 0.5) % 1.0 - 0.5
        order = np.argsort(offset)
        order = order[np.abs(offset[order]) <= 0.5 / spectrum.oversampling]
        cycles = cycles_per_m_at(lines, spectrum.centre + offset[order])
        along = None if beam is None else beam.directions(lines)
        return cls(lines, beam, along, cycles, np.sqrt(power[order]))

    @property
    def band_hz(self) -> tuple[float, float]:
        """Lowest and highest frequency of the band that the lines occupy."""
        lowest_hz, highest_hz = self.cycles_per_m[[0, -1]] * self.lines.sound_speed_m_s / 2
        return float(lowest_hz), float(highest_hz)

    def contributions(
        self, point_m: NDArray[np.float64], steps_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the channels that a pixel receives from.

        Parameters
        ----------
        point_m : float64 [3]
            Position of the pixel.
        steps_m : float64 [2, 3]
            Steps from row to row and from column to column.

        Returns
        -------
        channels : int64 [n]
        weights : float64 [n]
        changes_m : float64 [2, n]
            Change of the range from row to row and from column to column.
        """
        lines = self.lines
        range_m = bistatic_range_m(point_m, lines.tx_m, lines.rx_m)
        reached = (range_m >= lines.first_range_m) & (range_m <= lines.last_range_m)
        weights = reached.astype(np.float64)
        if self.beam is not None and self.along is not None:
            sine = sines(point_m[None], lines.phase_centres_m, self.along)[:, 0]
            weights *= self.beam.weights(sine, wavelength_m(lines))
        channels = np.flatnonzero(weights)
        changes_m = np.zeros((2, len(channels)))
        for antenna_m in (lines.tx_m[channels], lines.rx_m[channels]):
            changes_m += steps_m @ unit_vectors(point_m - antenna_m).T / 2
        return channels, weights[channels], changes_m

    def support(self, changes_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the lowest and highest frequencies around a pixel, cycles per pixel, [2, 2].

        Rows of the result are frequencies along rows and columns, for the changes of the range that
        `contributions` returns.
        """
        cycles = np.multiply.outer(changes_m, self.cycles_per_m[[0, -1]])
        return np.stack([cycles.min(axis=(1, 2)), cycles.max(axis=(1, 2))], axis=1)


def _document(sicd: Any, raster: Raster, collection: Collection, tags: dict[str, Any]) -> Any:
    """Return the XML document of an image."""
    import lxml.etree

    tree = lxml.etree.ElementTree(
        lxml.etree.Element(f"{{{_NAMESPACE}}}SICD", nsmap={None: _NAMESPACE})
    )
    root = sicd.ElementWrapper(tree.getroot())
    place, centre_m = raster.georeference, raster.positions_m(raster.centre)
    range_m = float(np.linalg.norm(collection.lines.phase_centres_m.mean(axis=0) - centre_m))
    time, axes = _time_and_axes(collection, raster)
    track = _track_polynomials(collection.lines, place, range_m)
    root["CollectionInfo"] = {
        "CollectorName": "unknown",
        "CoreName": "clsas",
        "CollectType": "MONOSTATIC",
        "RadarMode": {"ModeType": "DYNAMIC STRIPMAP"},
        "Classification": "UNCLASSIFIED",
        "Parameter": [("CLSAS_TIMES", "placeholders: equal intervals from 1970-01-01")],
    }
    root["ImageCreation"] = {"Application": f"clsas {__version__}"}
    rows, columns = raster.shape
    root["ImageData"] = {
        "PixelType": "RE32F_IM32F",
        "NumRows": rows,
        "NumCols": columns,
        "FirstRow": 0,
        "FirstCol": 0,
        "FullImage": {"NumRows": rows, "NumCols": columns},
        "SCPPixel": raster.centre,
    }
    corners = _corners_on_ground(raster, track, float(time[0, 0]))
    root["GeoData"] = {
        "EarthModel": "WGS_84",
        "SCP": {"ECF": _ecf_m(place, centre_m), "LLH": place.to_geographic(centre_m)},
        # sarkit 1.8 has no sign for 0 degrees; this is a ten-millionth of a metre.
        "ImageCorners": np.where(corners == 0, 1e-12, corners),
    }
    *across, up = np.cross(*raster.steps_m)
    is_level = np.hypot(*across) <= _LEVEL * abs(up)
    root["Grid"] = {
        "ImagePlane": "GROUND" if is_level else "OTHER",
        "Type": "PLANE",
        "TimeCOAPoly": time,
        "Row": axes[0],
        "Col": axes[1],
    }
    duration_s = float(_INTERVAL_S * collection.lines.ping_numbers[-1])
    root["Timeline"] = {
        "CollectStart": datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC),
        "CollectDuration": duration_s,
    }
    root["Position"] = {"ARPPoly": track}
    lowest_hz, highest_hz = collection.band_hz
    root["RadarCollection"] = {
        "TxFrequency": {"Min": lowest_hz, "Max": highest_hz},
        "TxPolarization": "UNKNOWN",
        "RcvChannels": {
            "@size": 1,
            "ChanParameters": [{"@index": 1, "TxRcvPolarization": "UNKNOWN"}],
        },
    }
    root["ImageFormation"] = {
        "RcvChanProc": {"NumChanProc": 1, "ChanIndex": [1]},
        "TxRcvPolarizationProc": "UNKNOWN",
        "TStartProc": 0.0,
        "TEndProc": duration_s,
        "TxFrequencyProc": {"MinProc": lowest_hz, "MaxProc": highest_hz},
        "ImageFormAlgo": "OTHER",
        "STBeamComp": "NO",
        "ImageBeamComp": "NO",
        "AzAutofocus": "NO",
        "RgAutofocus": "NO",
        "Processing": [
            {
                "Type": "time-domain backprojection",
                "Applied": True,
                "Parameter": [(name, str(value)) for name, value in tags.items()],
            }
        ],
    }
    root["SCPCOA"] = sicd.compute_scp_coa(tree)
    return tree


def _time_and_axes(
    collection: Collection, raster: Raster
) -> tuple[NDArray[np.float64], list[dict[str, Any]]]:
    """Return the time at which pixels are observed, and the elements of rows and columns.

    The time is the mean over the channels that a pixel receives from, as a polynomial of the
    distances in metres from the scene centre point along rows and columns, and so is the middle of
    the band less its centre. The centre is the multiple of the sample rate 1/step closest to the
    middle of the band, since pixels keep their phase. Bands are at most as wide as the sample rate.

    Raises
    ------
    ValueError
        If no line reaches the middle of the grid, or all see it from one direction.
    """
    vectors_m = raster.vectors_m()
    lengths_m = np.linalg.norm(vectors_m, axis=1)
    sides = (np.linspace(0, n - 1, _PIXELS) for n in raster.shape)
    index = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)
    time_of_channels_s = _INTERVAL_S * collection.lines.ping_numbers
    times, supports, used = [], [], []
    for where, point_m in zip(index, raster.positions_m(index), strict=True):
        channels, weight, changes_m = collection.contributions(point_m, raster.steps_m)
        if weight.sum():
            times.append(float(time_of_channels_s[channels] @ weight / weight.sum()))
            supports.append(collection.support(changes_m))
            used.append(where)
    centre_m = raster.positions_m(raster.centre)
    _, weight, changes_m = collection.contributions(centre_m, raster.steps_m)
    if not weight.sum():
        raise ArgumentError("lines", "reach the middle of the image")
    at_m = (np.array(used) - raster.centre) * lengths_m
    corners_m = (raster.corners - raster.centre) * lengths_m
    time = _fitted(at_m, np.array(times), _TIME * float(time_of_channels_s[-1]))
    support = np.array(supports) / lengths_m[:, None]  # cycles per metre
    lowest, highest = (collection.support(changes_m) / lengths_m[:, None]).T
    axes = []
    for axis, step_m in enumerate(lengths_m):
        extent = float(highest[axis] - lowest[axis])
        rate = 1 / step_m
        centre = rate * round((lowest[axis] + highest[axis]) / 2 / rate)
        bandwidth = min(extent, rate)
        offset = _fitted(at_m, support[:, axis].mean(axis=1) - centre, _FREQUENCY * bandwidth)
        at_corners = polynomial.polyval2d(corners_m[:, 0], corners_m[:, 1], offset)
        first, last = at_corners.min() - bandwidth / 2, at_corners.max() + bandwidth / 2
        if max(-first, last) > rate / 2:  # the band continues at the other end
            first, last = -rate / 2, rate / 2
        cycles = np.multiply.outer(changes_m[axis] / step_m, collection.cycles_per_m).ravel()
        amplitude = np.multiply.outer(weight, collection.amplitude).ravel()
        amplitude, edges = np.histogram(cycles, _BINS, weights=amplitude)
        width_m = half_power_width((edges[:-1] + edges[1:]) / 2, amplitude)
        if not np.isfinite(width_m):
            raise ArgumentError(
                "lines",
                "resolve the middle of the image for SICD",
                hint="those within the beam see it from one direction only",
            )
        axes.append(
            {
                "UVectECF": vectors_m[axis] / step_m,
                "SS": float(step_m),
                "ImpRespWid": width_m,
                "Sgn": _SIGN,
                "ImpRespBW": float(bandwidth),
                "KCtr": float(centre),
                "DeltaK1": float(first),
                "DeltaK2": float(last),
                "DeltaKCOAPoly": offset,
            }
        )
    return time, axes


def _fitted(
    at_m: NDArray[np.float64], values: NDArray[np.float64], deviation: float
) -> NDArray[np.float64]:
    """Return the polynomial of the lowest order with a deviation, or else of the highest order."""
    scale_m = np.abs(at_m).max(axis=0)
    x, y = (at_m / scale_m).T
    found = np.zeros((1, 1))
    for order in range(_HIGHEST + 1):
        powers = polynomial.polyvander2d(x, y, [order, order])
        solved = np.linalg.lstsq(powers, values, rcond=None)[0]
        found = np.asarray(solved, np.float64).reshape(order + 1, order + 1)
        if np.abs(powers @ found.ravel() - values).max() <= deviation:
            break
    exponents = np.arange(len(found))
    return found / np.multiply.outer(scale_m[0] ** exponents, scale_m[1] ** exponents)


def _track_polynomials(
    lines: RangeLines, place: Georeference, range_m: float
) -> NDArray[np.float64]:
    """Return polynomials of the track's ECF coordinates over time, float64 [orders + 1, 3].

    Raises
    ------
    ValueError
        If polynomials cannot follow the track as seen from a distance, metres.
    """
    position_m = _ecf_m(place, lines.ping_centres_m)
    middle_m = position_m.mean(axis=0)  # removed from sums of squares of 1e6 m
    time_s = _INTERVAL_S * np.arange(len(position_m))
    deviation_m = np.inf
    for order in range(1, min(_HIGHEST_OF_TRACK, len(time_s) - 1) + 1):
        found = [Polynomial.fit(time_s, each, order) for each in (position_m - middle_m).T]
        fitted_m = np.stack([each(time_s) for each in found], axis=1) + middle_m
        deviation_m = float(np.linalg.norm(fitted_m - position_m, axis=1).max())
        if deviation_m <= _DEVIATION * range_m:
            coefficients = np.zeros((order + 1, 3))
            for axis, each in enumerate(found):
                own = each.convert().coef
                coefficients[: len(own), axis] = own
            coefficients[0] += middle_m
            return coefficients
    raise ArgumentError(
        "lines",
        "come from one pass in the order of recording, since SICD describes the track by "
        "polynomials",
        f"a track that deviates from them by {deviation_m:.3g} m at a range of {range_m:.4g} m",
    )


def _corners_on_ground(
    raster: Raster, track: NDArray[np.float64], time_s: float
) -> NDArray[np.float64]:
    """Return latitude and longitude of the corners at the height of the middle, deg [4, 2].

    A corner above or below it is moved along the normal of the slant plane, on which range and
    Doppler stay the same to first order.
    """
    import sarkit.wgs84

    place, centre_m = raster.georeference, raster.positions_m(raster.centre)
    places = geographic(place, raster.positions_m(raster.corners))
    middle, middle_m = geographic(place, centre_m), _ecf_m(place, centre_m)
    radar_m = polynomial.polyval(time_s, track)
    velocity_m_s = polynomial.polyval(time_s, polynomial.polyder(track))
    normal = np.cross(velocity_m_s, middle_m - radar_m)
    normal /= normal @ sarkit.wgs84.up(middle)
    raised_m = (places[:, 2] - middle[2])[:, None]
    ground_m = sarkit.wgs84.geodetic_to_cartesian(places) - raised_m * normal
    return sarkit.wgs84.cartesian_to_geodetic(ground_m)[:, :2]


def _ecf_m(place: Georeference, positions_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return earth-centred, earth-fixed coordinates of positions [..., 3], metres."""
    import sarkit.wgs84

    return sarkit.wgs84.geodetic_to_cartesian(geographic(place, positions_m))


def _write_pixels(
    file: BinaryIO, first_byte: int, source: Source, raster: Raster, progress: Progress | None
) -> None:
    """Write the pixels of an image window by window, row by row of each."""
    columns_in_all = raster.shape[1]
    windows = list(source.windows())
    for done, window in enumerate(windows):
        if progress is not None:
            progress(done, len(windows))
        pixels = raster.orientation.turned(source.read(*window)).astype(">c8", order="C")
        down, across = raster.orientation.window(*window)
        for row, line in zip(range(down.start, down.stop), pixels, strict=True):
            file.seek(first_byte + pixels.itemsize * (row * columns_in_all + across.start))
            file.write(line.data)
    if progress is not None:
        progress(len(windows), len(windows))
