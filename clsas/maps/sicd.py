"""SICD files: complex radar images on planes, with the geometry of their collection."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from scipy.constants import speed_of_light

from clsas.engine.data import validate
from clsas.engine.data.atomic import replacing
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.extras import needed
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.version import __version__
from clsas.maps.collection import Collection, check_lines
from clsas.maps.sicd_collection import Axis, time_and_axes, times_s, track_polynomials
from clsas.maps.sicd_raster import Raster, ecf_m
from clsas.maps.sources import Source

if TYPE_CHECKING:
    from clsas.maps.geotiff import Progress

SUFFIXES = (".nitf", ".ntf")
"""Suffixes of SICD files."""

_NAMESPACE = "urn:SICD:1.4.0"
_SIGN = -1  # of the exponent with which pixels are transformed to spatial frequencies
_LIGHT = 0.01  # relative difference of a radar's wave speed from that in a vacuum: air has 3e-4
_SKEW = 1e-3  # sine of the angle between rows and columns from 90 degrees that SICD allows
_SEPARATION = 0.02  # of transmitter and receiver over the range: ranges differ by 5e-5 at most


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
    with needed("SICD files"):
        import pyproj  # noqa: F401  the geometry needs it
        import sarkit.sicd
    lines = _checked(source.grid, lines, sarkit.sicd.IS_SIZE_MAX)
    radar_m = lines.phase_centres_m.mean(axis=0)
    raster = Raster.of(source.grid, radar_m)
    _check_range(lines, raster)
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
    check_lines(lines, grid)
    if len(lines.ping_starts) < 2:
        raise ArgumentError("lines", "have at least 2 pings for SICD")
    if grid.georeference.vertical_datum is not None:
        validate.warn(
            f"heights above {grid.georeference.vertical_datum} are written as heights above the "
            "WGS 84 ellipsoid, since SICD knows no other"
        )
    return lines


def _check_range(lines: RangeLines, raster: Raster) -> None:
    """Raise ValueError if transmitters and receivers are too far apart to be one antenna."""
    distance_m = np.linalg.norm(lines.phase_centres_m - raster.positions_m(raster.centre), axis=1)
    apart_m = np.linalg.norm(lines.tx_m - lines.rx_m, axis=1)
    if (apart_m > _SEPARATION * distance_m).any():
        given = f"transmitters and receivers up to {apart_m.max():.4g} m apart"
        raise ArgumentError("lines", "be monostatic for SICD", given)


def _document(sicd: Any, raster: Raster, collection: Collection, tags: dict[str, Any]) -> Any:
    """Return the XML document of an image."""
    import lxml.etree

    tree = lxml.etree.ElementTree(
        lxml.etree.Element(f"{{{_NAMESPACE}}}SICD", nsmap={None: _NAMESPACE})
    )
    root = sicd.ElementWrapper(tree.getroot())
    place, centre_m = raster.georeference, raster.positions_m(raster.centre)
    range_m = float(np.linalg.norm(collection.lines.phase_centres_m.mean(axis=0) - centre_m))
    time, axes = time_and_axes(collection, raster)
    track = track_polynomials(collection.lines, place, range_m)
    root["CollectionInfo"] = {
        "CollectorName": "unknown",
        "CoreName": "clsas",
        "CollectType": "MONOSTATIC",
        "RadarMode": {"ModeType": "DYNAMIC STRIPMAP"},
        "Classification": "UNCLASSIFIED",
        "Parameter": [("CLSAS_TIMES", "placeholders: equal intervals from 1970-01-01")],
    }
    root["ImageCreation"] = {"Application": f"clsas {__version__}"}
    root["ImageData"] = _image_data(raster)
    corners = raster.corners_on_ground(track, float(time[0, 0]))
    root["GeoData"] = {
        "EarthModel": "WGS_84",
        "SCP": {"ECF": ecf_m(place, centre_m), "LLH": place.to_geographic(centre_m)},
        # sarkit 1.8 has no sign for 0 degrees; this is a ten-millionth of a metre.
        "ImageCorners": np.where(corners == 0, 1e-12, corners),
    }
    units = (step_m / np.linalg.norm(step_m) for step_m in raster.vectors_m())
    row, column = (_axis(axis, unit) for axis, unit in zip(axes, units, strict=True))
    root["Grid"] = {
        "ImagePlane": "GROUND" if raster.is_level else "OTHER",
        "Type": "PLANE",
        "TimeCOAPoly": time,
        "Row": row,
        "Col": column,
    }
    root["Timeline"] = {
        "CollectStart": datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC),
        "CollectDuration": float(times_s(collection.lines)[-1]),
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
    root["ImageFormation"] = _image_formation(collection, tags)
    root["SCPCOA"] = sicd.compute_scp_coa(tree)
    return tree


def _image_data(raster: Raster) -> dict[str, Any]:
    """Return the element of the pixels."""
    rows, columns = raster.shape
    return {
        "PixelType": "RE32F_IM32F",
        "NumRows": rows,
        "NumCols": columns,
        "FirstRow": 0,
        "FirstCol": 0,
        "FullImage": {"NumRows": rows, "NumCols": columns},
        "SCPPixel": raster.centre,
    }


def _image_formation(collection: Collection, tags: dict[str, Any]) -> dict[str, Any]:
    """Return the element of the processing, with the tags as its parameters."""
    lowest_hz, highest_hz = collection.band_hz
    return {
        "RcvChanProc": {"NumChanProc": 1, "ChanIndex": [1]},
        "TxRcvPolarizationProc": "UNKNOWN",
        "TStartProc": 0.0,
        "TEndProc": float(times_s(collection.lines)[-1]),
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


def _axis(axis: Axis, unit: np.ndarray) -> dict[str, Any]:
    """Return the element of a raster's rows or columns, which have a direction in ECF."""
    return {
        "UVectECF": unit,
        "SS": axis.step_m,
        "ImpRespWid": axis.width_m,
        "Sgn": _SIGN,
        "ImpRespBW": axis.bandwidth,
        "KCtr": axis.centre,
        "DeltaK1": axis.lowest,
        "DeltaK2": axis.highest,
        "DeltaKCOAPoly": axis.offset,
    }
