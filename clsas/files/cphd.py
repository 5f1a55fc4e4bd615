"""Compensated phase history data (CPHD, NGA.STND.0068) of radar, read and written by sarkit.

A vector of a CPHD channel becomes one line. Its signal is relative to the stabilization reference
point: a target whose delay exceeds that of the point by dt has a phase of SGN f dt cycles. In the
FX domain f is the frequency of the sample; in the TOA domain it is the middle of the band.
"""

from __future__ import annotations

import datetime
import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from clsas.engine.data import reading, validate
from clsas.engine.data.atomic import replacing
from clsas.engine.data.extras import needed
from clsas.engine.data.fourier import turned
from clsas.engine.data.geometry import course, unit_vectors
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.reading import parse_json
from clsas.engine.data.validate import ArgumentError
from clsas.engine.signal.compression import OVERSAMPLING, WINDOW, Window
from clsas.engine.signal.phase_history import from_phase_history
from clsas.files.hdf5 import FileFormatError
from clsas.files.positions import checked_positions
from clsas.files.tables import located

SPEED, ORIGIN = "clsas.sound_speed_m_s", "clsas.origin_m"
"""Names of the collection parameters with which a CPHD file describes sonar data."""
PLACE = "clsas.georeference"
"""Name of the collection parameter with the georeference of lines, as JSON."""
LOOK = "clsas.look_direction"
"""Name of the added parameter of every vector that stores where the elements look."""

START = b"CPHD/"
_LONGEST_XML = 64 << 20  # bytes; arbitrary, since even thousands of parameters take less than 1 MiB
_VELOCITIES, _PLATFORMS = ("TxVel", "RcvVel"), ("TxPlatform", "RcvPlatform")
_ALIKE = 0.5  # least cosine between the directions of two antennas that look to the same side
_BYTES = 24  # per sample while a signal becomes lines: as read, as complex64, and a working copy

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


def sarkit_cphd() -> ModuleType:
    """Import `sarkit.cphd`, or raise ImportError with the command that installs it."""
    with needed("CPHD files"):
        import sarkit.cphd
    return sarkit.cphd


def read_cphd(
    path: str | os.PathLike,
    *,
    channel: str | None = None,
    window: Window = "none",
    oversampling: float = 2.0,
) -> RangeLines:
    """Return range lines from a channel of a CPHD file in the FX or TOA domain.

    The collection may be monostatic or bistatic.

    Parameters
    ----------
    path : path-like
        The file, of version 1.0.1 or 1.1.0.
    channel : str, optional
        Identifier of the channel; by default the file's reference channel.
    window : str, float or tuple
        Window over the band of FX data (FX1 to FX2 of every vector), as for `from_phase_history`.
        It has no effect on TOA data, which are compressed already.
    oversampling : float
        Sample rate of lines from FX data over the bandwidth, at least 1.

    Returns
    -------
    RangeLines
        One line per vector with a signal. Positions are relative to the reference point of the
        image area (IARP), with x and y along the axes of the image area and z normal to them. If
        the reference surface is not a plane, x points east, y north and z up at the IARP.
        `look_direction` is that of the file if clsas wrote it. Otherwise it is horizontal and
        perpendicular to the velocity, on the file's side of the track (SideOfTrack).

    Raises
    ------
    FileFormatError
        If the file is damaged, incomplete or compressed, or claims more data than it contains.
    ValueError
        If the file has no such channel, or an option is outside its limits.
    ImportError
        If sarkit is not installed (extra `radar`).
    OSError
        If the file cannot be read.

    Warns
    -----
    ClsasWarning
        If vectors lack positions and are left out, if transmission times do not ascend, if the
        track turns back, or if all vectors have the same position.

    Notes
    -----
    Positions are those that the file contains for every vector at the times of transmission and
    reception, as in the model of the standard [1]_. The standard assumes the speed of light. A file
    of sonar lines that clsas wrote contains the true speed, to which the frequencies are converted
    back.

    References
    ----------
    .. [1] National Geospatial-Intelligence Agency, "Compensated Phase History Data (CPHD)",
       NGA.STND.0068.

    Examples
    --------
    >>> import clsas
    >>> lines = clsas.read_cphd("collection.cphd", window="hann")  # doctest: +SKIP
    """
    sarkit = sarkit_cphd()
    path = validate.path("path", path)
    if channel is not None:
        channel = validate.text("channel", channel)
    WINDOW.check("window", window)
    OVERSAMPLING.check("oversampling", oversampling)
    with _defects(path):
        reading.check_ordinary(path)
    with path.open("rb") as file:
        with _defects(path):
            header = _header(file, path.stat().st_size)
            file.seek(0)
            reader = sarkit.Reader(file)
            tree = sarkit.ElementWrapper(reader.metadata.xmltree.getroot())
            there = [each["Identifier"] for each in tree["Data"].findall("Channel")]
            reference = tree["Channel"]["RefChId"]
        if channel is not None:
            validate.one_of("channel", channel, there)
        with _defects(path):
            name = reference if channel is None else channel
            _check_sizes(tree, name, header)
            vectors = reader.read_pvps(name)
            signal = reader.read_signal(name)
            collection = _collection(tree)
            kept = _usable(path, vectors)
            if not kept.any():
                raise FileFormatError(
                    "must contain vectors with a signal and complete positions, got none"
                )
            vectors, signal = vectors[kept], signal[kept]
            if signal.dtype.names:
                signal = signal["real"] + np.complex64(1j) * signal["imag"]
            signal = signal.astype(np.complex64)
            if "AmpSF" in (vectors.dtype.names or ()):
                signal *= vectors["AmpSF"].astype(np.float32)[:, None]
            if collection.sign == 1:
                np.conj(signal, out=signal)

            look = _look_direction(tree, vectors, collection)
            tx_m, rx_m, point_m = (
                (vectors[part].astype(np.float64) - collection.centre_m) @ collection.axes.T
                + collection.origin_m
                for part in ("TxPos", "RcvPos", "SRPPos")
            )
            out_m, back_m = (np.linalg.norm(each - point_m, axis=1) for each in (tx_m, rx_m))
            reference_m = (out_m + back_m) / 2

    if collection.domain == "FX":
        scale = collection.speed_m_s / speed_of_light  # of true frequencies
        with located(f"{path}:"):
            band_hz = scale * np.stack([vectors["FX1"], vectors["FX2"]], axis=1).astype(np.float64)
            sampled_hz = signal.shape[1] * vectors["SCSS"]
            occupied = float(np.max((vectors["FX2"] - vectors["FX1"]) / sampled_hz))
            lines = from_phase_history(
                signal,
                first_frequency_hz=scale * vectors["SC0"].astype(np.float64),
                frequency_step_hz=scale * vectors["SCSS"].astype(np.float64),
                tx_m=tx_m,
                rx_m=rx_m,
                reference_range_m=reference_m,
                sound_speed_m_s=collection.speed_m_s,
                band_hz=band_hz,
                window=window,
                oversampling=max(1.0, oversampling * min(1.0, occupied)),
            )
    else:
        with _defects(path):
            lines = _lines_of_toa(signal, vectors, collection.speed_m_s, tx_m, rx_m, reference_m)
    lines = replace(lines, look_direction=look, georeference=collection.georeference)
    return checked_positions(path, lines)


@contextmanager
def _defects(path: Path) -> Iterator[None]:
    """Convert every exception raised by reading into a FileFormatError with the file's name."""
    try:
        yield
    except FileFormatError as error:
        raise FileFormatError(f"{path} {error}") from None
    except (MemoryError, OSError, validate.ClsasWarning):  # filters may raise warnings
        raise
    # sarkit and lxml may raise any exception on damaged files.
    except Exception as error:
        text = validate.shown(str(error) or type(error).__name__)
        raise FileFormatError(f"{path} is damaged: {text}") from error


def _header(file: Any, size: int) -> dict[str, int]:
    """Return the offsets and sizes of the file's blocks after checking them against its size."""
    start = file.read(1 << 14)
    if not start.startswith(START) or b"\f\n" not in start:
        raise FileFormatError("is not a CPHD file")
    rows = start[: start.index(b"\f\n")].decode().splitlines()[1:]
    fields = dict(row.split(" := ", 1) for row in rows if " := " in row)
    values: dict[str, int] = {}
    for block in ("XML", "PVP", "SIGNAL"):
        names = [f"{block}_BLOCK_{part}" for part in ("BYTE_OFFSET", "SIZE")]
        given = [fields.get(name, "") for name in names]
        if not all(each.isascii() and each.isdigit() for each in given):
            raise FileFormatError(f"lacks {' or '.join(names)}")
        offset, length = map(int, given)
        if offset + length > size:
            raise FileFormatError(
                f"is damaged: its {block} block ends at byte {offset + length} of {size}"
            )
        values |= {names[0]: offset, names[1]: length}
    if values["XML_BLOCK_SIZE"] > _LONGEST_XML:
        raise FileFormatError(f"must have at most {_LONGEST_XML} bytes of XML")
    return values


def _check_sizes(tree: Any, name: str, header: dict[str, int]) -> None:
    """Raise FileFormatError unless a channel's arrays lie within the file and fit into memory."""
    data = tree["Data"]
    if "SignalCompressionID" in data:
        raise FileFormatError("must not have a compressed signal")
    described = next((each for each in data.findall("Channel") if each["Identifier"] == name), None)
    if described is None:
        raise FileFormatError(f"lacks its channel {validate.shown(name)}")
    vectors, length = described["NumVectors"], described["NumSamples"]
    item = {"CI2": 2, "CI4": 4, "CF8": 8}.get(data["SignalArrayFormat"])
    if item is None:
        raise FileFormatError(f"has an unknown format {validate.shown(data['SignalArrayFormat'])}")
    if vectors < 1 or length < 2:
        raise FileFormatError(f"must contain vectors, got {vectors} of {length} samples")
    parts = {
        "SIGNAL": described["SignalArrayByteOffset"] + vectors * length * item,
        "PVP": described["PVPArrayByteOffset"] + vectors * data["NumBytesPVP"],
    }
    for block, end in parts.items():
        if end > header[f"{block}_BLOCK_SIZE"]:
            raise FileFormatError(
                f"is damaged: {vectors} vectors of {length} samples exceed its {block} block"
            )
    try:
        validate.memory("reading its signal", _BYTES * vectors * length)
    except ValueError as error:
        raise FileFormatError(f"is too large: {error}") from None


@dataclass(frozen=True, eq=False)
class _Collection:
    """Properties common to all vectors of a file.

    Positions in Earth-centred coordinates are converted to local ones: relative to `centre_m`,
    along the rows of `axes`, plus `origin_m`. `is_own` is True for files that clsas wrote.
    """

    domain: str
    sign: int
    centre_m: NDArray[np.float64]
    axes: NDArray[np.float64]
    origin_m: NDArray[np.float64]
    speed_m_s: float
    is_own: bool
    georeference: Georeference | None


def _collection(tree: Any) -> _Collection:
    """Return the collection that the XML describes, given its root."""
    whole, scene = tree["Global"], tree["SceneCoordinates"]
    if whole["SGN"] not in (-1, 1):
        raise FileFormatError(f"must have the phase sign (SGN) +1 or -1, got {whole['SGN']}")
    own = dict(tree["CollectionID"].findall("Parameter"))

    # Local x, y and z: those of a plane, else east, north and up.
    surface = scene["ReferenceSurface"]
    if "Planar" in surface:
        x, y = (_vector(surface["Planar"][name]) for name in ("uIAX", "uIAY"))
        axes = np.stack([x, y, np.cross(x, y)])
    else:
        latitude, longitude = np.radians(_vector(scene["IARP"]["LLH"])[:2])
        east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
        up = np.cos(latitude) * np.array([np.cos(longitude), np.sin(longitude), 0.0])
        up[2] = np.sin(latitude)
        axes = np.stack([east, np.cross(up, east), up])
    if not np.allclose(axes @ axes.T, np.eye(3), atol=1e-5):
        raise FileFormatError("must have orthogonal image area axes of length 1")

    domain = validate.one_of("its domain", whole["DomainType"], ("FX", "TOA"))
    centre_m, origin_m = _vector(scene["IARP"]["ECF"]), _vector(own.get(ORIGIN, "0 0 0").split())
    speed_m_s = validate.positive("its speed", float(own.get(SPEED, speed_of_light)), "m/s")
    georeference = None
    if PLACE in own:
        try:
            georeference = Georeference(**parse_json(own[PLACE].encode()))
        except (TypeError, ValueError) as error:
            raise FileFormatError(f"must have a georeference in {PLACE}: {error}") from None
    return _Collection(
        domain, whole["SGN"], centre_m, axes, origin_m, speed_m_s, SPEED in own, georeference
    )


def _vector(value: Any) -> NDArray[np.float64]:
    vector = np.asarray(value, dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise FileFormatError(f"must have vectors of three numbers, got {validate.shown(value)}")
    return vector


def _usable(path: Path, vectors: NDArray) -> NDArray[np.bool_]:
    """Return which vectors are complete and have a signal; warn of incomplete and repeated ones."""
    normal = np.ones(len(vectors), bool)
    if "SIGNAL" in (vectors.dtype.names or ()):
        normal = vectors["SIGNAL"] == 1
    complete = np.ones(len(vectors), bool)
    for name in ("TxPos", "RcvPos", "SRPPos"):
        complete &= np.isfinite(vectors[name]).all(axis=1)
    for name in ("SC0", "SCSS", "FX1", "FX2"):
        complete &= np.isfinite(vectors[name])
    usable = normal & complete
    lost = np.flatnonzero(normal & ~complete)
    if lost.size and usable.any():
        validate.warn(
            f"{path}: {lost.size} of {len(vectors)} vectors lack finite positions or frequencies "
            f"(first: vector {lost[0]}) and are left out"
        )
    late = np.flatnonzero(~(np.diff(vectors["TxTime"][usable]) > 0))
    if late.size:
        validate.warn(
            f"{path}: TxTime does not ascend after {late.size} of {usable.sum()} vectors (first "
            f"after vector {np.flatnonzero(usable)[late[0]]}), so pulses are repeated or out of "
            "order. They are in the order of the file"
        )
    return usable


def _look_direction(
    tree: Any, vectors: NDArray, collection: _Collection
) -> NDArray[np.float64] | None:
    """Return where the antennas look at every vector, in local coordinates; None if unknown.

    In files that clsas wrote, only the added parameter counts: those without it state the left side
    whatever the true one is. Otherwise, the antennas look horizontally to the side of the track
    that the file states. If transmitter and receiver look in different directions, that of both is
    unknown.
    """
    if LOOK in (vectors.dtype.names or ()):
        look = vectors[LOOK].astype(np.float64) @ collection.axes.T
        return look if np.isfinite(look).all() and look.any(axis=1).all() else None
    geometry = tree["ReferenceGeometry"]
    if collection.is_own:
        return None
    velocity = [vectors[name].astype(np.float64) @ collection.axes.T for name in _VELOCITIES]
    if "Monostatic" in geometry:
        sides = [geometry["Monostatic"]["SideOfTrack"]] * 2
    else:
        sides = [geometry["Bistatic"][name]["SideOfTrack"] for name in _PLATFORMS]
    looks = []
    for along, side in zip(velocity, sides, strict=True):
        left = unit_vectors(np.stack([-along[:, 1], along[:, 0], 0 * along[:, 0]], axis=1))
        looks.append(left if side == "L" else -left)
    if not np.all(np.einsum("ci,ci->c", *looks) > _ALIKE):  # also at rest
        return None
    return looks[0] + looks[1]


def _lines_of_toa(
    signal: NDArray[np.complex64],
    vectors: NDArray,
    speed_m_s: float,
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
    reference_m: NDArray[np.float64],
) -> RangeLines:
    """Return lines with one carrier and absolute ranges, from signals at the bands' middles."""
    step_s, start_s = (vectors[name].astype(np.float64) for name in ("SCSS", "SC0"))
    if np.ptp(step_s) * signal.shape[1] > 1e-3 * step_s[0]:
        raise FileFormatError("must have TOA samples at one step, got several (SCSS)")
    middle_hz = (vectors["FX1"].astype(np.float64) + vectors["FX2"]) / 2
    carrier_hz = math.fsum(middle_hz) / len(middle_hz)
    samples = np.empty_like(signal)
    number = np.arange(signal.shape[1])
    for row, line in enumerate(signal):
        cycles = (middle_hz[row] - carrier_hz) * (start_s[row] + number * step_s[0])
        cycles -= 2 * carrier_hz / speed_of_light * reference_m[row]
        samples[row] = line * turned(cycles)
    return RangeLines(
        samples,
        first_range_m=reference_m + speed_of_light / 2 * start_s,
        range_step_m=float(speed_of_light / 2 * step_s[0]),
        tx_m=tx_m,
        rx_m=rx_m,
        carrier_hz=carrier_hz * (speed_m_s / speed_of_light),
        sound_speed_m_s=speed_m_s,
    )


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
        signal[row] = line * turned(cycles)
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
    along = course(centres_m)
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
    own = {
        SPEED: repr(lines.sound_speed_m_s),
        ORIGIN: " ".join(repr(float(each)) for each in origin_m),
    }
    if lines.georeference is not None:
        own[PLACE] = json.dumps(asdict(lines.georeference))
    root["CollectionID"] = {
        "CollectorName": "clsas",
        "CoreName": "lines",
        "CollectType": "MONOSTATIC" if lines.is_monostatic else "BISTATIC",
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
    # The place of every parameter within a vector, in 64-bit words.
    assert vectors.dtype.fields is not None  # the type has names
    places: dict[str, Any] = {
        name: {"Offset": offset // 8, "Size": dtype.itemsize // 8, "dtype": dtype}
        for name, (dtype, offset, *_) in vectors.dtype.fields.items()
    }
    if LOOK in places:
        places["AddedPVP"] = [{"Name": LOOK, **places.pop(LOOK)}]
    root["PVP"] = places
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
