"""Sampling limits of a survey, phase centres and far field.

Equations in brackets are those of the thesis (Ødegaard 2004), [22]-[34].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.core import validate
from clsas.core.geometry import bistatic_range_m
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.core.wavelengths import wavelength_m as carrier_wavelength_m
from clsas.sonar.beam import BeamWindow
from clsas.sonar.system import Sonar
from clsas.sonar.track import Track, channels

_SLACK = 0.01  # relative; a sway of centimetres changes the spacing a little


@dataclass(frozen=True)
class Finding:
    """Something that is wrong with a survey or a recording.

    Parameters
    ----------
    name : str
        Which check found it, such as "along_track_spacing", "ping_rate" or "dead_channels".
    message : str
        Explanation with the numbers and their units.
    value, limit : float
        What was found and what is allowed, in the unit of the message.
    remedy : str
        What to do about it.
    where : tuple of int
        Pings or channels that it is about, from 0; the message says which of the two.
    """

    name: str
    message: str
    value: float
    limit: float
    remedy: str = ""
    where: tuple[int, ...] = ()


def check_sampling(
    sonar: Sonar | RangeLines,
    track: Track | Grid | None = None,
    grid: Grid | None = None,
    *,
    beam: BeamWindow | None = None,
    element_length_m: float | None = None,
    wavelength_m: float | None = None,
) -> list[Finding]:
    """Return the sampling limits that a survey of a grid violates.

    Called as `check_sampling(sonar, track, grid)` before a survey, and as
    `check_sampling(lines, grid)` for range lines, whose sonar and track need not be known.

    The spacing of the phase centres along the track may exceed half an element by at most 1 %
    [27], [31]. For elements without a length the limit keeps the grating lobes of every target
    off the grid and out of the beam, whichever is narrower. The ping rate must leave time for the
    last echo from the grid [24]; range lines do not tell it.

    Parameters
    ----------
    sonar : Sonar or RangeLines
    track : Track
        Left out with range lines.
    grid : Grid
        Grid of the image. With range lines and a beam or an element length it may be left out.
    beam : BeamWindow, optional
        Beam of the image: echoes from outside it add nothing.
    element_length_m : float, optional
        Length of the elements, metres; by default that of the sonar.
    wavelength_m : float, optional
        Wavelength, metres; by default that of the carrier. Needed for lines that still have their
        carrier.

    Returns
    -------
    list of Finding
        Empty if no limit is violated.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is outside its limits, or lines without `carrier_hz`
        come without a wavelength.
    """
    if isinstance(sonar, RangeLines):
        if track is not None and grid is not None:
            raise TypeError(
                "track must be left out with range lines, which have their own: "
                f"check_sampling(lines, grid); got {type(track).__name__}"
            )
        grid, track = track if grid is None else grid, None  # type: ignore[assignment]
        if grid is None and beam is None and element_length_m is None:
            raise ValueError("one of grid, beam and element_length_m must be given with lines")
    else:
        if not isinstance(sonar, Sonar):
            raise TypeError(
                f"sonar must be of type Sonar, got {type(sonar).__name__}; RangeLines may stand in "
                "its place: check_sampling(lines, grid)"
            )
        validate.instance("track", track, Track)
        validate.instance("grid", grid, Grid)
    corners = None
    if grid is not None:
        validate.instance("grid", grid, Grid)
        corners = _corners_m(grid)
    tx, rx = _antennas_m(sonar, track)
    limit = _spacing_limit(sonar, beam, element_length_m, wavelength_m)
    ranges = None if corners is None else bistatic_range_m(corners[:, None], tx, rx)
    found = _check_spacing(limit, phase_centres_m(tx, rx), corners, ranges)
    if isinstance(sonar, Sonar) and isinstance(track, Track) and ranges is not None:
        found += _check_ping_rate(sonar, track, ranges)
    return found


def _antennas_m(survey: Sonar | RangeLines, track: Track | Grid | None) -> tuple[NDArray, NDArray]:
    """Return positions of transmitters and receivers, [channels, 3]."""
    if isinstance(survey, RangeLines):
        return survey.tx_m, survey.rx_m
    assert isinstance(track, Track)  # for type checkers
    tx, rx, _ = channels(survey, track)
    return tx, rx


@dataclass(frozen=True)
class _SpacingLimit:
    """Largest spacing of phase centres by elements or beam, and the wavelength."""

    wavelength_m: float
    spacing_m: float = np.inf
    meaning: str = ""


def _spacing_limit(
    survey: Sonar | RangeLines,
    beam: BeamWindow | None,
    element_length_m: float | None,
    wavelength_m: float | None,
) -> _SpacingLimit:
    """Return the limit of elements or, where their length is not known, of the beam."""
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    if wavelength_m is not None:
        wavelength = validate.positive("wavelength_m", wavelength_m, "m")
    elif isinstance(survey, Sonar):
        wavelength = survey.wavelength_m
    elif survey.carrier_hz:
        wavelength = carrier_wavelength_m(survey)
    else:
        raise ValueError("wavelength_m must be given for lines with carrier_hz 0")
    if element_length_m is None and isinstance(survey, Sonar):
        element_length_m = survey.element_length_m
    if element_length_m is not None:
        length = validate.positive("element_length_m", element_length_m, "m")
        meaning = f"half the element length of {length:.4g} m"
        return _SpacingLimit(wavelength, length / 2, meaning)
    if beam is not None:
        low, high = np.sin(np.radians(beam.squint_deg + np.array([-0.5, 0.5]) * beam.width_deg))
        meaning = f"what keeps grating lobes out of the beam of {beam.width_deg:.4g} degrees"
        return _SpacingLimit(wavelength, wavelength / (2 * float(high - low)), meaning)
    return _SpacingLimit(wavelength)


def _check_spacing(
    known: _SpacingLimit, centres: NDArray, corners: NDArray | None, ranges: NDArray | None
) -> list[Finding]:
    course = _course(centres)
    gaps = np.diff(np.sort(centres @ course))
    spacing = float(gaps.max(initial=0.0))
    limit, meaning = known.spacing_m, known.meaning
    if corners is not None and not meaning.startswith("half"):
        way = corners[:, None] - centres
        distance = np.linalg.norm(way, axis=-1)
        sine = np.divide(way @ course, distance, out=np.zeros_like(distance), where=distance > 0)
        spread = float(np.ptp(sine, axis=0).max())
        of_grid = known.wavelength_m / (2 * spread) if spread else np.inf
        if of_grid > limit or not meaning:
            limit, meaning = of_grid, "what keeps grating lobes off the grid"
    # With a sway of centimetres the principal direction deviates a little from the course.
    if spacing <= limit * (1 + _SLACK):
        return []
    where = ""
    if ranges is not None:
        near, far = ranges.min(), ranges.max()
        lobes = [grating_lobe_m(known.wavelength_m, spacing, distance) for distance in (near, far)]
        where = (
            f": grating lobes {lobes[0]:.4g} m to {lobes[1]:.4g} m beside every "
            f"target (at the ranges of the grid's corners, {near:.4g} m to {far:.4g} m)"
        )
    return [
        Finding(
            "along_track_spacing",
            f"phase centres are up to {spacing:.4g} m apart along the track, more than {limit:.4g} "
            f"m, {meaning}{where}",
            spacing,
            limit,
            "survey more slowly, ping faster or use a narrower beam; of lines as they are, image "
            "with a beam (beam=clsas.BeamWindow) that leaves grating lobes out",
        )
    ]


def _check_ping_rate(sonar: Sonar, track: Track, ranges: NDArray) -> list[Finding]:
    if track.pings == 1:
        return []
    far = float(ranges.max())
    _, last = receive_interval_s(far, far, sonar.pulse.duration_s, sonar.sound_speed_m_s)
    rate = float(1 / np.diff(track.time_s).min())
    if rate * last <= 1 + 1e-6:
        return []
    return [
        Finding(
            "ping_rate",
            f"the ping rate of {rate:.4g} Hz is above {1 / last:.4g} Hz: the last echo, from "
            f"{far:.4g} m, ends {last:.4g} s after its ping, when the next one has been sent",
            rate,
            1 / last,
            "ping more slowly, or image a smaller range",
        )
    ]


def phase_centres_m(tx_m: ArrayLike, rx_m: ArrayLike) -> NDArray[np.float64]:
    """Return the points midway between transmitters and receivers, [..., 3]; equation [32].

    [32] is u = u_p + (u_rx - u_tx)/2. This is the midpoint if u_p is the transmitter's position and
    u_rx, u_tx are positions on the platform.
    """
    tx = validate.array("tx_m", np.atleast_2d(tx_m), np.float64, (None, 3))
    rx = validate.array("rx_m", np.atleast_2d(rx_m), np.float64, (None, 3))
    return (tx + rx) / 2


def receive_interval_s(
    near_m: float, far_m: float, duration_s: float, sound_speed_m_s: float = 1500.0
) -> tuple[float, float]:
    """Return the times at which the first echo starts and the last one ends; [22], [23]."""
    near = validate.number("near_m", near_m, "m", least=0.0)
    far = validate.number("far_m", far_m, "m", least=near)
    duration = validate.number("duration_s", duration_s, "s", least=0.0)
    sound = validate.positive("sound_speed_m_s", sound_speed_m_s, "m/s")
    return 2 * near / sound, 2 * far / sound + duration


def grating_lobe_m(wavelength_m: float, spacing_m: float, range_m: float) -> float:
    """Return the distance along the track from a target to its first grating lobe.

    The two-way phase of phase centres d apart repeats at sin theta = lambda/(2 d). At range R this
    is R lambda/(2 d) along the track [26].
    """
    wavelength = validate.positive("wavelength_m", wavelength_m, "m")
    spacing = validate.positive("spacing_m", spacing_m, "m")
    return validate.positive("range_m", range_m, "m") * wavelength / (2 * spacing)


def _course(centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit vector along which the phase centres spread most."""
    return np.linalg.svd(centres - centres.mean(axis=0), full_matrices=False)[2][0]


def _corners_m(grid: Grid) -> NDArray[np.float64]:
    """Corners [n, 3] of a plane, or of the box around any other grid."""
    if grid.is_planar:
        ends = (slice(None, None, max(1, count - 1)) for count in grid.shape)
        return grid.positions_m(*ends).reshape(-1, 3)
    points = grid.positions_m().reshape(-1, 3)
    return np.stack(
        np.meshgrid(*np.stack([points.min(axis=0), points.max(axis=0)], axis=1)), axis=-1
    ).reshape(-1, 3)
