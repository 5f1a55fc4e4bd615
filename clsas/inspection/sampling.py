"""Sampling limits of a survey: spacing of phase centres, and ping rate.

Equations in brackets are those of the thesis (Ødegaard 2004), [22]-[32].
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.findings import Finding
from clsas.engine.data.geometry import bistatic_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, banks_of
from clsas.engine.data.lines import wavelength_m as carrier_wavelength_m
from clsas.engine.data.system import Sonar
from clsas.engine.data.track import Track, channels
from clsas.engine.data.validate import ArgumentError, ArgumentTypeError

SLACK = 0.01
"""Relative excess of a spacing that is tolerated: a sway of centimetres changes it a little."""


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

    To check a survey before it is recorded, call `check_sampling(sonar, track, grid)`. To check
    range lines, call `check_sampling(lines, grid)`, which needs neither the sonar nor the track.

    Parameters
    ----------
    sonar : Sonar or RangeLines
        The sonar, or recorded range lines.
    track : Track
        Track of the sonar. Leave it out with range lines.
    grid : Grid
        Grid of the image. It may be left out for range lines with a beam or an element length.
    beam : BeamWindow, optional
        Beam of the image. Echoes from outside it do not contribute.
    element_length_m : float, optional
        Length of the elements, metres. The default is that of the sonar.
    wavelength_m : float, optional
        Wavelength, metres. The default is that of the carrier. Required for lines that are still on
        their carrier.

    Returns
    -------
    list of Finding
        Empty if no limit is violated.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is outside its limits, or if lines with a `carrier_hz`
        of 0 are given without a wavelength.

    See Also
    --------
    inspect : Checks of a recording, which include this one.

    Notes
    -----
    The spacing of the phase centres along the track may exceed half an element by at most 1 %
    [27], [31]. For elements without a length, the limit is the spacing that keeps the grating lobes
    of every target off the grid or out of the beam, whichever of the two spacings is wider. The
    ping rate must leave time for the last echo from the grid [24]. It is not checked for range
    lines, which have no times. Several receiver banks are checked one by one, since each forms an
    image of its own; the findings are those of the worst.

    References
    ----------
    Ødegaard, "Fast time domain beamforming for synthetic aperture sonar", thesis, University of
    Oslo, 2004: equations in brackets.

    Examples
    --------
    The phase centres of a sonar with 15 mm elements may be 7.5 mm apart. Those of the wide-beam
    sonar in the thesis are farther apart:

    >>> import clsas
    >>> sonar = clsas.Sonar.thesis_wide_beam()
    >>> track = clsas.Track.straight([0, 0, 0], [2.64, 0, 0], pings=10, ping_interval_s=0.2)
    >>> grid = clsas.Grid.plane(x=(0, 5, 64), y=(40, 45, 64))
    >>> finding, = clsas.check_sampling(sonar, track, grid)
    >>> f"{finding.name}: {1e3 * finding.value:.2f} mm, at most {1e3 * finding.limit:.2f} mm"
    'along_track_spacing: 8.25 mm, at most 7.50 mm'
    """
    if isinstance(sonar, RangeLines):
        if track is not None and grid is not None:
            allowed = "be left out with range lines, which have their own"
            got = type(track).__name__
            raise ArgumentTypeError("track", allowed, got, "call `check_sampling(lines, grid)`")
        grid, track = track if grid is None else grid, None  # type: ignore[assignment]
        if grid is None and beam is None and element_length_m is None:
            raise ArgumentError("grid", "be given with lines, or `beam` or `element_length_m`")
    else:
        validate.instance("sonar", sonar, Sonar, RangeLines)
        validate.instance("track", track, Track)
        validate.instance("grid", grid, Grid)
    if sonar.banks > 1:
        options: dict[str, Any] = {
            "beam": beam,
            "element_length_m": element_length_m,
            "wavelength_m": wavelength_m,
        }
        of_banks = [
            check_sampling(sonar.bank(number), track, grid, **options)
            for number in banks_of(sonar.bank_numbers)
        ]
        return _worst(of_banks)
    corners = None
    if grid is not None:
        validate.instance("grid", grid, Grid)
        corners = corners_of(grid)
    tx, rx = _antennas_m(sonar, track)
    spacing = measure_spacing(
        sonar,
        phase_centres_m(tx, rx),
        corners,
        beam=beam,
        element_length_m=element_length_m,
        wavelength_m=wavelength_m,
    )
    ranges = None if corners is None else bistatic_range_m(corners[:, None], tx, rx)
    found = _check_spacing(spacing, ranges)
    if isinstance(sonar, Sonar) and isinstance(track, Track) and ranges is not None:
        found += _check_ping_rate(sonar, track, ranges)
    return found


def _worst(of_banks: list[list[Finding]]) -> list[Finding]:
    """Return the finding of each name that exceeds its limit by most."""
    worst: dict[str, Finding] = {}
    for finding in itertools.chain.from_iterable(of_banks):
        known = worst.get(finding.name)
        if known is None or finding.value * known.limit > known.value * finding.limit:
            worst[finding.name] = finding
    return list(worst.values())


def _antennas_m(survey: Sonar | RangeLines, track: Track | Grid | None) -> tuple[NDArray, NDArray]:
    """Return positions of transmitters and receivers, [channels, 3]."""
    if isinstance(survey, RangeLines):
        return survey.tx_m, survey.rx_m
    assert isinstance(track, Track)  # for type checkers
    tx, rx, _ = channels(survey, track)
    return tx, rx


@dataclass(frozen=True)
class _SpacingLimit:
    """Wavelength, and the largest spacing of phase centres that the elements or the beam allow.

    `reason` completes the sentence "phase centres should be at most so far apart". It is empty if
    neither elements nor beam limit the spacing.
    """

    wavelength_m: float
    spacing_m: float = np.inf
    reason: str = ""
    of_element: bool = False


def _spacing_limit(
    survey: Sonar | RangeLines,
    beam: BeamWindow | None,
    element_length_m: float | None,
    wavelength_m: float | None,
) -> _SpacingLimit:
    """Return the limit set by the elements or, if their length is not known, by the beam."""
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    if wavelength_m is not None:
        wavelength = validate.positive("wavelength_m", wavelength_m, "m")
    elif isinstance(survey, Sonar):
        wavelength = survey.wavelength_m
    elif survey.carrier_hz:
        wavelength = carrier_wavelength_m(survey)
    else:
        raise ArgumentError("wavelength_m", "be given for lines with `carrier_hz` 0")
    if element_length_m is None and isinstance(survey, Sonar):
        element_length_m = survey.element_length_m
    if element_length_m is not None:
        length = validate.positive("element_length_m", element_length_m, "m")
        reason = f", half the element length of {reprs.measured(length, 'm')}"
        return _SpacingLimit(wavelength, length / 2, reason, of_element=True)
    if beam is not None:
        low, high = np.sin(np.radians(beam.squint_deg + np.array([-0.5, 0.5]) * beam.width_deg))
        reason = f" to keep grating lobes out of the beam of {beam.width_deg:.4g} degrees"
        return _SpacingLimit(wavelength, wavelength / (2 * float(high - low)), reason)
    return _SpacingLimit(wavelength)


@dataclass(frozen=True)
class Spacing:
    """Largest gap between neighbouring phase centres along the track, and the largest allowed.

    `reason` completes the sentence "phase centres should be at most so far apart".
    """

    wavelength_m: float
    spacing_m: float
    limit_m: float
    reason: str

    @property
    def is_kept(self) -> bool:
        """True if the gap exceeds the limit by no more than sway explains."""
        # With a sway of centimetres the principal direction differs a little from the course.
        return self.spacing_m <= self.limit_m * (1 + SLACK)


def measure_spacing(
    survey: Sonar | RangeLines,
    centres_m: NDArray[np.float64],
    corners_m: NDArray[np.float64] | None,
    *,
    beam: BeamWindow | None = None,
    element_length_m: float | None = None,
    wavelength_m: float | None = None,
) -> Spacing:
    """Return the spacing of phase centres, and its limit; see `check_sampling`.

    Parameters
    ----------
    survey, beam, element_length_m, wavelength_m
        As for `check_sampling`.
    centres_m : float64 [channels, 3]
    corners_m : float64 [corners, 3] or None
        Corners of the grid.
    """
    known = _spacing_limit(survey, beam, element_length_m, wavelength_m)
    along = course(centres_m)
    gaps = np.diff(np.sort(centres_m @ along))
    spacing = float(gaps.max(initial=0.0))
    limit, reason = known.spacing_m, known.reason
    if corners_m is not None and not known.of_element:
        way = corners_m[:, None] - centres_m
        distance = np.linalg.norm(way, axis=-1)
        sine = np.divide(way @ along, distance, out=np.zeros_like(distance), where=distance > 0)
        spread = float(np.ptp(sine, axis=0).max())
        of_grid = known.wavelength_m / (2 * spread) if spread else np.inf
        if of_grid > limit or not reason:
            limit, reason = of_grid, " to keep grating lobes off the grid"
    return Spacing(known.wavelength_m, spacing, limit, reason)


def _check_spacing(found: Spacing, ranges: NDArray | None) -> list[Finding]:
    if found.is_kept:
        return []
    spacing, limit, reason = found.spacing_m, found.limit_m, found.reason
    where = ""
    if ranges is not None:
        near, far = ranges.min(), ranges.max()
        lobes = [grating_lobe_m(found.wavelength_m, spacing, distance) for distance in (near, far)]
        where = (
            f". Expect grating lobes {lobes[0]:.4g} m to {lobes[1]:.4g} m beside every "
            f"target (at the ranges of the grid's corners, {near:.4g} m to {far:.4g} m)"
        )
    return [
        Finding(
            "along_track_spacing",
            f"phase centres are up to {reprs.measured(spacing, 'm')} apart along the track, but "
            f"should be at most {reprs.measured(limit, 'm')} apart{reason}{where}",
            spacing,
            limit,
            "survey more slowly, ping faster or use a narrower beam; for lines that are already "
            "recorded, image with a beam that leaves grating lobes out",
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
            f"{far:.4g} m, ends {last:.4g} s after its ping, when the next ping has already been "
            "sent",
            rate,
            1 / last,
            "ping more slowly, or image a smaller range",
        )
    ]


def phase_centres_m(tx_m: ArrayLike, rx_m: ArrayLike) -> NDArray[np.float64]:
    """Return the points midway between transmitters and receivers, [..., 3]; equation [32].

    Equation [32] is u = u_p + (u_rx - u_tx)/2. This is the midpoint if u_p is the position of the
    transmitter, and u_rx and u_tx are positions on the platform.
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

    The two-way phase of phase centres with the spacing d repeats at sin theta = lambda/(2 d). At
    range R this is R lambda/(2 d) along the track [26].
    """
    wavelength = validate.positive("wavelength_m", wavelength_m, "m")
    spacing = validate.positive("spacing_m", spacing_m, "m")
    return validate.positive("range_m", range_m, "m") * wavelength / (2 * spacing)


def course(centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit vector along which the phase centres extend farthest."""
    return np.linalg.svd(centres - centres.mean(axis=0), full_matrices=False)[2][0]


def corners_of(grid: Grid) -> NDArray[np.float64]:
    """Return the corners of a plane, or of the box around any other grid, [n, 3]."""
    if grid.is_planar:
        ends = (slice(None, None, max(1, count - 1)) for count in grid.shape)
        return grid.positions_m(*ends).reshape(-1, 3)
    points = grid.positions_m().reshape(-1, 3)
    return np.stack(
        np.meshgrid(*np.stack([points.min(axis=0), points.max(axis=0)], axis=1)), axis=-1
    ).reshape(-1, 3)
