"""Sampling limits of a survey: spacing of phase centres, and ping rate.

Equations in brackets are those of the thesis (Ødegaard 2004), [22]-[32].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.findings import Finding
from clsas.engine.data.geometry import bistatic_range_m, course
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, banks_of
from clsas.engine.data.lines import wavelength_m as carrier_wavelength_m
from clsas.engine.data.sound_speed import USUAL_M_S
from clsas.engine.data.system import Sonar
from clsas.engine.data.track import Track, channels
from clsas.engine.data.validate import ArgumentError, ArgumentTypeError

SLACK = 0.01
"""Relative excess of a spacing that is tolerated: a sway of centimetres changes it a little."""
ROUNDING = 1e-6
"""Relative excess of a limit that rounding explains."""


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
    if sonar.banks > 1:  # the finding of each name that exceeds its limit by most
        worst: dict[str, Finding] = {}
        for number in banks_of(sonar.bank_numbers):
            for finding in check_sampling(
                sonar.bank(number), track, grid, beam=beam,
                element_length_m=element_length_m, wavelength_m=wavelength_m,
            ):  # fmt: skip
                known = worst.get(finding.name)
                if known is None or finding.value * known.limit > known.value * finding.limit:
                    worst[finding.name] = finding
        return list(worst.values())

    corners_m = None
    if grid is not None:
        validate.instance("grid", grid, Grid)
        corners_m = corners_of(grid)
    if isinstance(sonar, RangeLines):
        tx_m, rx_m = sonar.tx_m, sonar.rx_m
    else:
        assert isinstance(track, Track)  # for type checkers
        tx_m, rx_m, _ = channels(sonar, track)
    spacing = measure_spacing(
        sonar, (tx_m + rx_m) / 2, corners_m, beam=beam,
        element_length_m=element_length_m, wavelength_m=wavelength_m,
    )  # fmt: skip
    near_m = far_m = 0.0  # of the grid; they are not used without one
    if corners_m is not None:
        range_m = bistatic_range_m(corners_m[:, None], tx_m, rx_m)
        near_m, far_m = float(range_m.min()), float(range_m.max())

    found: list[Finding] = []
    # With a sway of centimetres the principal direction differs a little from the course.
    if spacing.spacing_m > spacing.limit_m * (1 + SLACK):
        lobes = ""
        if corners_m is not None:
            first_m, last_m = (
                grating_lobe_m(spacing.wavelength_m, spacing.spacing_m, distance_m)
                for distance_m in (near_m, far_m)
            )
            lobes = (
                f". Expect grating lobes {first_m:.4g} m to {last_m:.4g} m beside every target "
                f"(at the ranges of the grid's corners, {near_m:.4g} m to {far_m:.4g} m)"
            )
        message = (
            f"phase centres are up to {reprs.measured(spacing.spacing_m, 'm')} apart along the "
            f"track, but should be at most {reprs.measured(spacing.limit_m, 'm')} apart"
            f"{spacing.reason}{lobes}"
        )
        remedy = (
            "survey more slowly, ping faster or use a narrower beam; for lines that are already "
            "recorded, image with a beam that leaves grating lobes out"
        )
        found.append(
            Finding("along_track_spacing", message, spacing.spacing_m, spacing.limit_m, remedy)
        )

    if isinstance(sonar, Sonar) and isinstance(track, Track) and track.pings > 1:
        _, last_s = receive_interval_s(far_m, far_m, sonar.pulse.duration_s, sonar.sound_speed_m_s)
        rate_hz = float(1 / np.diff(track.time_s).min())
        if rate_hz * last_s > 1 + ROUNDING:
            message = (
                f"the ping rate of {rate_hz:.4g} Hz is above {1 / last_s:.4g} Hz: the last echo, "
                f"from {far_m:.4g} m, ends {last_s:.4g} s after its ping, when the next ping has "
                "already been sent"
            )
            remedy = "ping more slowly, or image a smaller range"
            found.append(Finding("ping_rate", message, rate_hz, 1 / last_s, remedy))
    return found


@dataclass(frozen=True)
class Spacing:
    """Largest gap between neighbouring phase centres along the track, and the largest allowed.

    `reason` completes the sentence "phase centres should be at most so far apart". It is empty if
    nothing limits the spacing.
    """

    wavelength_m: float
    spacing_m: float
    limit_m: float
    reason: str


def measure_spacing(
    survey: Sonar | RangeLines,
    centres_m: NDArray[np.float64],
    corners_m: NDArray[np.float64] | None,
    *,
    beam: BeamWindow | None = None,
    element_length_m: float | None = None,
    wavelength_m: float | None = None,
) -> Spacing:
    """Return the spacing of phase centres [channels, 3], and its limit; see `check_sampling`.

    Elements limit it or, if their length is unknown, the beam and the corners of the grid.
    """
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    if wavelength_m is not None:
        wavelength_m = validate.positive("wavelength_m", wavelength_m, "m")
    elif isinstance(survey, Sonar):
        wavelength_m = survey.wavelength_m
    elif survey.carrier_hz:
        wavelength_m = carrier_wavelength_m(survey)
    else:
        raise ArgumentError("wavelength_m", "be given for lines with `carrier_hz` 0")

    along = course(centres_m)
    spacing_m = float(np.diff(np.sort(centres_m @ along)).max(initial=0.0))

    if element_length_m is None and isinstance(survey, Sonar):
        element_length_m = survey.element_length_m
    if element_length_m is not None:
        length_m = validate.positive("element_length_m", element_length_m, "m")
        reason = f", half the element length of {reprs.measured(length_m, 'm')}"
        return Spacing(wavelength_m, spacing_m, length_m / 2, reason)

    limit_m, reason = np.inf, ""
    if beam is not None:
        low, high = np.sin(np.radians(beam.squint_deg + np.array([-0.5, 0.5]) * beam.width_deg))
        limit_m = wavelength_m / (2 * float(high - low))
        reason = f" to keep grating lobes out of the beam of {beam.width_deg:.4g} degrees"
    if corners_m is not None:
        path_m = corners_m[:, None] - centres_m
        distance_m = np.linalg.norm(path_m, axis=-1)
        sine = np.divide(
            path_m @ along, distance_m, out=np.zeros_like(distance_m), where=distance_m > 0
        )
        spread = float(np.ptp(sine, axis=0).max())
        of_grid_m = wavelength_m / (2 * spread) if spread else np.inf
        if of_grid_m > limit_m or not reason:
            limit_m, reason = of_grid_m, " to keep grating lobes off the grid"
    return Spacing(wavelength_m, spacing_m, limit_m, reason)


def receive_interval_s(
    near_m: float, far_m: float, duration_s: float, sound_speed_m_s: float = USUAL_M_S
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


def corners_of(grid: Grid) -> NDArray[np.float64]:
    """Return the corners of a plane, or of the box around any other grid, [n, 3]."""
    if grid.is_planar:
        ends = (slice(None, None, max(1, count - 1)) for count in grid.shape)
        return grid.positions_m(*ends).reshape(-1, 3)
    points = grid.positions_m().reshape(-1, 3)
    return np.stack(
        np.meshgrid(*np.stack([points.min(axis=0), points.max(axis=0)], axis=1)), axis=-1
    ).reshape(-1, 3)
