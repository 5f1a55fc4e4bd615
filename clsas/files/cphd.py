"""Compensated phase history data (CPHD, NGA.STND.0068) of radar, read by sarkit.

A vector of a CPHD channel becomes one line. Its signal is relative to the stabilization reference
point: a target whose delay exceeds that of the point by dt has a phase of SGN f dt cycles. In the
FX domain f is the frequency of the sample; in the TOA domain it is the middle of the band.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from clsas.engine.data import reading, validate
from clsas.engine.data.extras import needed
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.reading import parse_json
from clsas.engine.signal.compression import Window, check_options
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
    check_options(window=window, oversampling=oversampling)
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
            collection = _Collection.read(tree)
            kept = _usable(path, vectors)
            if not kept.any():
                raise FileFormatError(
                    "must contain vectors with a signal and complete positions, got none"
                )
            vectors, signal = vectors[kept], _complex(signal[kept])
            if "AmpSF" in (vectors.dtype.names or ()):
                signal *= vectors["AmpSF"].astype(np.float32)[:, None]
            if collection.sign == 1:
                np.conj(signal, out=signal)
            look = _look_direction(tree, vectors, collection)
    if collection.domain == "FX":
        with located(f"{path}:"):
            lines = _lines_of_fx(signal, vectors, collection, window, oversampling)
    else:
        with _defects(path):
            lines = _lines_of_toa(signal, vectors, collection)
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

    @classmethod
    def read(cls, tree: Any) -> _Collection:
        """Return the collection that the XML describes, given its root."""
        whole, scene = tree["Global"], tree["SceneCoordinates"]
        if whole["SGN"] not in (-1, 1):
            raise FileFormatError(f"must have the phase sign (SGN) +1 or -1, got {whole['SGN']}")
        own = dict(tree["CollectionID"].findall("Parameter"))
        axes = _axes(scene)
        if not np.allclose(axes @ axes.T, np.eye(3), atol=1e-5):
            raise FileFormatError("must have orthogonal image area axes of length 1")
        return cls(
            domain=validate.one_of("its domain", whole["DomainType"], ("FX", "TOA")),
            sign=whole["SGN"],
            centre_m=_vector(scene["IARP"]["ECF"]),
            axes=axes,
            origin_m=_vector(own.get(ORIGIN, "0 0 0").split()),
            speed_m_s=validate.positive("its speed", float(own.get(SPEED, speed_of_light)), "m/s"),
            is_own=SPEED in own,
            georeference=_georeference(own.get(PLACE)),
        )

    @property
    def frequency_scale(self) -> float:
        """Ratio of the true frequencies to those in the file."""
        return self.speed_m_s / speed_of_light

    def local_m(self, position_m: NDArray) -> NDArray[np.float64]:
        """Return positions in local coordinates."""
        return (position_m.astype(np.float64) - self.centre_m) @ self.axes.T + self.origin_m


def _georeference(text: str | None) -> Georeference | None:
    """Return the georeference in a parameter of the collection."""
    if text is None:
        return None
    try:
        return Georeference(**parse_json(text.encode()))
    except (TypeError, ValueError) as error:
        raise FileFormatError(f"must have a georeference in {PLACE}: {error}") from None


def _axes(scene: Any) -> NDArray[np.float64]:
    """Return unit vectors of local x, y and z: those of a plane, else east, north and up."""
    surface = scene["ReferenceSurface"]
    if "Planar" in surface:
        x, y = (_vector(surface["Planar"][name]) for name in ("uIAX", "uIAY"))
        return np.stack([x, y, np.cross(x, y)])
    latitude, longitude = np.radians(_vector(scene["IARP"]["LLH"])[:2])
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    up = np.cos(latitude) * np.array([np.cos(longitude), np.sin(longitude), 0.0])
    up[2] = np.sin(latitude)
    return np.stack([east, np.cross(up, east), up])


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
    looks = [_beside(*pair) for pair in zip(velocity, sides, strict=True)]
    if not np.all(np.einsum("ci,ci->c", *looks) > _ALIKE):  # also if one is NaN
        return None
    return looks[0] + looks[1]


def _beside(velocity: NDArray[np.float64], side: str) -> NDArray[np.float64]:
    """Return horizontal unit vectors to the left ("L") or right of velocities; NaN at rest."""
    aside = np.stack([-velocity[:, 1], velocity[:, 0], 0 * velocity[:, 0]], axis=1)
    with np.errstate(invalid="ignore"):
        aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    return aside if side == "L" else -aside


def _complex(signal: NDArray) -> NDArray[np.complex64]:
    if signal.dtype.names:
        return (signal["real"] + np.complex64(1j) * signal["imag"]).astype(np.complex64)
    return signal.astype(np.complex64)


def _geometry(vectors: NDArray, collection: _Collection) -> dict[str, Any]:
    """Return the positions of every vector, and its range to the reference point."""
    tx_m, rx_m, point_m = (
        collection.local_m(vectors[name]) for name in ("TxPos", "RcvPos", "SRPPos")
    )
    range_m = [np.linalg.norm(each - point_m, axis=1) for each in (tx_m, rx_m)]
    return {"tx_m": tx_m, "rx_m": rx_m, "reference_range_m": (range_m[0] + range_m[1]) / 2}


def _lines_of_fx(
    signal: NDArray[np.complex64],
    vectors: NDArray,
    collection: _Collection,
    window: Window,
    oversampling: float,
) -> RangeLines:
    scale = collection.frequency_scale
    sampled_hz = signal.shape[1] * vectors["SCSS"]
    occupied = float(np.max((vectors["FX2"] - vectors["FX1"]) / sampled_hz))
    return from_phase_history(
        signal,
        first_frequency_hz=scale * vectors["SC0"].astype(np.float64),
        frequency_step_hz=scale * vectors["SCSS"].astype(np.float64),
        **_geometry(vectors, collection),
        sound_speed_m_s=collection.speed_m_s,
        band_hz=scale * np.stack([vectors["FX1"], vectors["FX2"]], axis=1).astype(np.float64),
        window=window,
        oversampling=max(1.0, oversampling * min(1.0, occupied)),
    )


def _lines_of_toa(
    signal: NDArray[np.complex64], vectors: NDArray, collection: _Collection
) -> RangeLines:
    """Return lines with one carrier and absolute ranges, from signals at the bands' middles."""
    geometry = _geometry(vectors, collection)
    reference_m = geometry.pop("reference_range_m")
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
        samples[row] = line * np.exp(2j * np.pi * (cycles - np.rint(cycles)))
    return RangeLines(
        samples,
        first_range_m=reference_m + speed_of_light / 2 * start_s,
        range_step_m=float(speed_of_light / 2 * step_s[0]),
        **geometry,
        carrier_hz=carrier_hz * collection.frequency_scale,
        sound_speed_m_s=collection.speed_m_s,
    )
