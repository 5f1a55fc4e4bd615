"""Writing of range lines as compensated phase history data (CPHD) in the TOA domain."""

from __future__ import annotations

import datetime
import json
import os
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from clsas.engine.data import validate
from clsas.engine.data.atomic import replacing
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.files.cphd import LOOK, ORIGIN, PLACE, SPEED, sarkit_cphd

SUFFIXES = (".cphd",)
"""Suffix of CPHD files."""

_NAMESPACE = "http://api.nsgreg.nga.mil/schema/cphd/1.1.0"
_CHANNEL = "1"
_EQUATOR_M = np.array([6378137.0, 0.0, 0.0])  # latitude and longitude 0 on the WGS 84 ellipsoid
_AXES = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # east, north, up there
_NEAR_M = 1e4  # positions closer to the origin than this are not shifted
# Least distance of the reference point: angles at the Earth's centre must differ in float64.
_NEAREST_M = 10.0
_GRID = 1024  # lines and samples of the proposed image grid: a plain choice
_DEPRESSION = np.radians(30)  # of the reference point from the track: a plain choice
_PULSE_INTERVAL_S = 1e-3
_OVERSAMPLING = 1.25  # sample rate over the declared bandwidth; the standard requires 1.1
_POSITION = ("f8", (3,))
_VECTOR = np.dtype(
    [("TxTime", "f8"), ("TxPos", *_POSITION), ("TxVel", *_POSITION)]
    + [("RcvTime", "f8"), ("RcvPos", *_POSITION), ("RcvVel", *_POSITION), ("SRPPos", *_POSITION)]
    + [(name, "f8") for name in ("aFDOP", "aFRR1", "aFRR2", "FX1", "FX2", "TOA1", "TOA2")]
    + [("TDTropoSRP", "f8"), ("SC0", "f8"), ("SCSS", "f8"), ("SIGNAL", "i8")]
)
"""Parameters of a vector, in the order of the file."""
_LOOKING_VECTOR = np.dtype([*_VECTOR.descr, (LOOK, *_POSITION)])
"""Parameters of a vector whose look direction is known."""


def write_cphd(path: str | os.PathLike, lines: RangeLines) -> None:
    """Write range lines to a CPHD file, version 1.1.0, in the TOA domain.

    `read_cphd` returns the lines in the same coordinates, to the precision of the samples.

    Parameters
    ----------
    path : path-like
        The file, whose name must end in .cphd. An existing file is replaced in one step.
    lines : RangeLines
        Lines without receiver velocities, since the standard does not model motion during flight.

    Raises
    ------
    TypeError
        If `lines` are not range lines.
    ValueError
        If the lines have receiver velocities, several banks or a profile of the sound speed, or the
        file's name has another suffix.
    ImportError
        If sarkit is not installed (extra `radar`).
    OSError
        If the file cannot be written.

    Notes
    -----
    The standard assumes the speed of light. Lines with another speed c are written with the same
    wavelengths and geometry: frequencies are multiplied by 299 792 458 m/s over c, so that any CPHD
    processor forms the same image. Parameters of the collection store c and the georeference, from
    which `read_cphd` restores them. For other programs, the origin is at latitude and longitude 0,
    with x pointing east, y north and z up. An added parameter of every
    vector stores its look direction, and the side of the track (SideOfTrack) follows from it; if it
    is unknown, the file states the left side, because the standard requires one. Times, velocities,
    polarization and the date are placeholders, since range lines lack them. Lines that still have
    their carrier (`carrier_hz` 0) are written with half their sample rate as the carrier, and read
    back with it.

    See Also
    --------
    read_cphd : Read a CPHD file.

    Examples
    --------
    >>> import clsas
    >>> clsas.write_cphd("collection.cphd", clsas.load("lines.h5"))  # doctest: +SKIP
    """
    sarkit = sarkit_cphd()
    path = validate.path("path", path)
    validate.suffix("path", path, *SUFFIXES)
    validate.instance("lines", lines, RangeLines)
    if lines.rx_velocity_m_s is not None:
        raise ArgumentError(
            "lines",
            "have no `rx_velocity_m_s`",
            hint="CPHD cannot describe motion during flight",
        )
    if lines.banks > 1:
        hint = "write `lines.bank(0)` and the others to files of their own"
        raise ArgumentError("lines", "be of one bank", lines.banks, hint)
    if lines.sound_speed is not None:
        raise ArgumentError("lines", "have no `sound_speed`", hint="CPHD assumes straight rays")
    origin_m = np.rint(lines.phase_centres_m.mean(axis=0))
    origin_m *= np.abs(origin_m).max() > _NEAR_M
    vectors, signal = _vectors(lines, origin_m)
    tree = _document(sarkit, lines, vectors, origin_m, "TOA")
    with replacing(path) as temporary, temporary.open("wb") as file:
        write_vectors(sarkit, file, tree, vectors, signal)


def write_vectors(sarkit: Any, file: Any, tree: Any, vectors: NDArray, signal: NDArray) -> None:
    """Write a CPHD document with the vectors and the signal of its only channel."""
    # As a context manager, the writer would print a warning about missing arrays after an error.
    writer = sarkit.Writer(file, sarkit.Metadata(xmltree=tree))
    writer.write_pvp(_CHANNEL, vectors)
    writer.write_signal(_CHANNEL, signal)


def _vectors(lines: RangeLines, origin_m: NDArray) -> tuple[NDArray, NDArray[np.complex64]]:
    """Return the parameters of every vector, and the signal relative to the reference point."""
    scale = speed_of_light / lines.sound_speed_m_s
    rate_hz = speed_of_light / (2 * lines.range_step_m)
    carrier_hz = scale * lines.carrier_hz or rate_hz / 2
    tx_m, rx_m = lines.tx_m - origin_m, lines.rx_m - origin_m
    along, point_m = _reference(tx_m, rx_m, lines)
    reference_m = sum(np.linalg.norm(each - point_m, axis=1) for each in (tx_m, rx_m)) / 2
    look = lines.look_direction
    vectors = np.zeros(lines.channels, _VECTOR if look is None else _LOOKING_VECTOR)
    if look is not None:
        vectors[LOOK] = look @ _AXES
    delay_s = 2 * reference_m / speed_of_light
    interval_s = max(_PULSE_INTERVAL_S, 1.1 * float(delay_s.max()))
    vectors["TxTime"] = interval_s * np.arange(lines.channels)
    vectors["RcvTime"] = vectors["TxTime"] + delay_s
    extent_m = max(float(np.ptp((tx_m + rx_m) / 2 @ along)), 1.0)
    velocity_m_s = along * extent_m / (interval_s * lines.channels) @ _AXES
    for side, position_m in (("Tx", tx_m), ("Rcv", rx_m)):
        vectors[f"{side}Pos"] = _EQUATOR_M + position_m @ _AXES
        vectors[f"{side}Vel"] = velocity_m_s
    vectors["SRPPos"] = _EQUATOR_M + point_m @ _AXES
    half_band_hz = min(rate_hz / _OVERSAMPLING, 1.99 * carrier_hz) / 2
    vectors["FX1"], vectors["FX2"] = carrier_hz - half_band_hz, carrier_hz + half_band_hz
    vectors["SC0"] = 2 * (lines.first_range_m - reference_m) / speed_of_light
    vectors["SCSS"] = 1 / rate_hz
    vectors["TOA1"] = vectors["SC0"]
    vectors["TOA2"] = vectors["SC0"] + (lines.length - 1) / rate_hz
    vectors["SIGNAL"] = 1
    # Remove the phase of the reference range and, if the lines still have it, the carrier.
    moved_hz = carrier_hz - scale * lines.carrier_hz
    signal = np.empty_like(lines.samples)
    for row, line in enumerate(lines.samples):
        range_m = lines.first_range_m[row] + np.arange(lines.length) * lines.range_step_m
        cycles = 2 / speed_of_light * (carrier_hz * reference_m[row] - moved_hz * range_m)
        signal[row] = line * np.exp(2j * np.pi * (cycles - np.rint(cycles)))
    return vectors, signal


def _reference(
    tx_m: NDArray, rx_m: NDArray, lines: RangeLines
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the track's direction, and a reference point beside it at the middle range.

    The position of the scene is unknown. Any point serves, since phases and ranges are relative to
    it. It lies on the side where the elements look, or on the left if that is unknown.
    """
    centres_m = (tx_m + rx_m) / 2
    middle_m = centres_m.mean(axis=0)
    along = np.linalg.svd(centres_m - middle_m, full_matrices=False)[2][0]
    along[2] = 0
    length = float(np.linalg.norm(along))
    along = along / length if length > 0.1 else np.array([1.0, 0.0, 0.0])
    if along @ (centres_m[-1] - centres_m[0]) < 0:
        along = -along
    aside = np.array([-along[1], along[0], 0.0])
    if lines.look_direction is not None and lines.look_direction.mean(axis=0) @ aside < 0:
        aside = -aside
    range_m = abs(float((lines.first_range_m + lines.last_range_m).mean()) / 2)
    look = np.cos(_DEPRESSION) * aside - np.sin(_DEPRESSION) * np.array([0.0, 0.0, 1.0])
    return along, middle_m + max(range_m, _NEAREST_M) * look


def _document(
    sarkit: Any, lines: RangeLines, vectors: NDArray, origin_m: NDArray, domain: str
) -> Any:
    """Return the XML document of one channel."""
    import lxml.etree

    tree = lxml.etree.ElementTree(
        lxml.etree.Element(f"{{{_NAMESPACE}}}CPHD", nsmap={None: _NAMESPACE})
    )
    root = sarkit.ElementWrapper(tree.getroot())
    monostatic = np.array_equal(lines.tx_m, lines.rx_m)
    own = {
        SPEED: repr(lines.sound_speed_m_s),
        ORIGIN: " ".join(repr(float(each)) for each in origin_m),
    }
    if lines.georeference is not None:
        own[PLACE] = json.dumps(asdict(lines.georeference))
    root["CollectionID"] = {
        "CollectorName": "clsas",
        "CoreName": "lines",
        "CollectType": "MONOSTATIC" if monostatic else "BISTATIC",
        "RadarMode": {"ModeType": "DYNAMIC STRIPMAP"},
        "Classification": "UNCLASSIFIED",
        "ReleaseInfo": "UNRESTRICTED",
        "Parameter": list(own.items()),
    }
    least = {name: float(vectors[name].min()) for name in ("FX1", "TOA1", "TxTime")}
    most = {name: float(vectors[name].max()) for name in ("FX2", "TOA2", "TxTime")}
    root["Global"] = {
        "DomainType": domain,
        "SGN": -1,
        "Timeline": {
            "CollectionStart": datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC),
            "TxTime1": least["TxTime"],
            "TxTime2": most["TxTime"],
        },
        "FxBand": {"FxMin": least["FX1"], "FxMax": most["FX2"]},
        "TOASwath": {"TOAMin": least["TOA1"], "TOAMax": most["TOA2"]},
    }
    root["SceneCoordinates"] = _scene(vectors)
    root["Data"] = {
        "SignalArrayFormat": "CF8",
        "NumBytesPVP": vectors.dtype.itemsize,
        "NumCPHDChannels": 1,
        "Channel": [
            {
                "Identifier": _CHANNEL,
                "NumVectors": len(vectors),
                "NumSamples": lines.length,
                "SignalArrayByteOffset": 0,
                "PVPArrayByteOffset": 0,
            }
        ],
        "NumSupportArrays": 0,
    }
    root["Channel"] = _channel(vectors)
    root["PVP"] = _layout(vectors.dtype)
    times = sarkit.compute_t_ref_from_pvps(vectors)
    root["Dwell"] = {
        "NumCODTimes": 1,
        "CODTime": [{"Identifier": "1", "CODTimePoly": [[float(times[0] + times[-1]) / 2]]}],
        "NumDwellTimes": 1,
        "DwellTime": [{"Identifier": "1", "DwellTimePoly": [[float(times[-1] - times[0])]]}],
    }
    root["ReferenceGeometry"] = sarkit.compute_reference_geometry(tree, vectors)
    return tree


def _channel(vectors: NDArray) -> dict[str, Any]:
    """Return the parameters of the one channel."""
    fixed = {
        "FX": not (np.ptp(vectors["FX1"]) or np.ptp(vectors["FX2"])),
        "TOA": not (np.ptp(vectors["TOA1"]) or np.ptp(vectors["TOA2"])),
        "SRP": bool(np.all(vectors["SRPPos"] == vectors["SRPPos"][0])),
    }
    least_hz, most_hz = float(vectors["FX1"].min()), float(vectors["FX2"].max())
    return {
        "RefChId": _CHANNEL,
        **{f"{name}FixedCPHD": value for name, value in fixed.items()},
        "Parameters": [
            {
                "Identifier": _CHANNEL,
                "RefVectorIndex": len(vectors) // 2,
                **{f"{name}Fixed": value for name, value in fixed.items()},
                "SignalNormal": True,
                "Polarization": {"TxPol": "UNSPECIFIED", "RcvPol": "UNSPECIFIED"},
                "FxC": (most_hz + least_hz) / 2,
                "FxBW": most_hz - least_hz,
                "TOASaved": float(vectors["TOA2"].max() - vectors["TOA1"].min()),
                "DwellTimes": {"CODId": "1", "DwellId": "1"},
            }
        ],
    }


def _scene(vectors: NDArray) -> dict[str, Any]:
    """Return scene coordinates: the tangent plane at the equator, an area about the reference."""
    import sarkit.wgs84

    point_m = (vectors["SRPPos"][len(vectors) // 2] - _EQUATOR_M) @ _AXES.T
    distance_m = np.linalg.norm(vectors["TxPos"] - vectors["SRPPos"], axis=1).max()
    swath_m = speed_of_light / 2 * float((vectors["TOA2"] - vectors["TOA1"]).max())
    half_m = float(max(distance_m, swath_m))
    first, last = point_m[:2] - half_m, point_m[:2] + half_m
    spacing_m = 2 * half_m / _GRID
    corners_m = np.array(
        [[first[0], last[1], 0], [last[0], last[1], 0], [last[0], first[1], 0], [*first, 0]]
    )  # in clockwise order
    corners = sarkit.wgs84.cartesian_to_geodetic(_EQUATOR_M + corners_m @ _AXES)
    return {
        "EarthModel": "WGS_84",
        "IARP": {"ECF": _EQUATOR_M, "LLH": np.zeros(3)},
        "ReferenceSurface": {"Planar": {"uIAX": _AXES[0], "uIAY": _AXES[1]}},
        "ImageArea": {"X1Y1": first, "X2Y2": last},
        "ImageAreaCornerPoints": corners[:, :2],
        "ImageGrid": {
            "Identifier": _CHANNEL,
            "IARPLocation": -first / spacing_m - 0.5,
            "IAXExtent": {"LineSpacing": spacing_m, "FirstLine": 0, "NumLines": _GRID},
            "IAYExtent": {"SampleSpacing": spacing_m, "FirstSample": 0, "NumSamples": _GRID},
        },
    }


def _layout(vector: np.dtype) -> dict[str, Any]:
    """Return the place of every parameter within a vector, in 64-bit words."""
    assert vector.fields is not None  # the type has names
    places: dict[str, Any] = {
        name: {"Offset": offset // 8, "Size": dtype.itemsize // 8, "dtype": dtype}
        for name, (dtype, offset, *_) in vector.fields.items()
    }
    if LOOK in places:
        places["AddedPVP"] = [{"Name": LOOK, **places.pop(LOOK)}]
    return places
