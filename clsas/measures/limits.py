"""Limits of a survey by the formulas of chapter 2 of the thesis (Ødegaard 2004).

Below `limits`, each function yields the results of one subject, or the names of results and why
they cannot be given. Equations in brackets are those of the thesis; `limits` explains them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from clsas.engine.data import reprs, validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.reprs import Report, Table
from clsas.engine.data.system import Sonar
from clsas.engine.data.track import Pointing, Track, channels
from clsas.engine.signal.compression import Window
from clsas.inspection.sampling import (
    ROUNDING,
    SLACK,
    corners_of,
    measure_spacing,
    receive_interval_s,
)
from clsas.measures.elevation import phase_per_height
from clsas.measures.resolution import Survey, range_width_m

LABELS = {
    "first_echo_s": "first echo",
    "last_echo_s": "last echo",
    "ping_rate_hz": "ping rate",
    "unambiguous_range_m": "unambiguous range",
    "swath_m": "swath",
    "recorded_from_m": "recorded from",
    "recorded_to_m": "recorded to",
    "sample_rate_hz": "sample rate",
    "advance_m": "distance per ping",
    "overlap": "overlap of pings",
    "speed_m_s": "speed",
    "greatest_speed_m_s": "greatest speed",
    "phase_centre_spacing_m": "phase-centre spacing",
    "doppler_bandwidth_hz": "Doppler bandwidth",
    "grating_lobe_m": "grating lobes",
    "grating_lobe_db": "grating-lobe level",
    "ping_lobe_m": "ping lobes",
    "ping_lobe_db": "ping-lobe level",
    "range_resolution_m": "range (c/2B)",
    "range_width_m": "range (-3 dB)",
    "azimuth_resolution_m": "azimuth (L/2)",
    "azimuth_width_m": "azimuth (-3 dB)",
    "aperture_m": "synthetic aperture",
    "range_pixel_m": "pixels in range",
    "azimuth_pixel_m": "pixels in azimuth",
    "array_far_field_m": "far field of the array",
    "aperture_far_field_m": "far field of the aperture",
    "phase_centre_shift_m": "phase-centre path",
    "phase_centre_error_m": "phase-centre error",
    "baseline_m": "baseline of the banks",
    "ambiguity_near_m": "height of ambiguity, near",
    "ambiguity_far_m": "height of ambiguity, far",
}
"""Words for the name of every result, in their order. The last three require several banks."""

_Missing = tuple[str, str]
"""Names of results, separated by spaces, and why they cannot be given."""

_UNITS = {"_m_s": "m/s", "_hz": "Hz", "_db": "dB", "_m": "m", "_s": "s"}

_NO_PINGS = "requires a track of two or more pings at different positions"
_NO_INTERVAL = "requires a track of two or more pings"
_NO_RANGE = "requires a track and a grid, or the recorded range"
_NO_RECORD = "requires the recorded range; without it, every echo is recorded"
_NO_GRID = "requires a track and a grid"
_NO_PLANE = "requires a grid on a plane; this one consists of points"
_NO_ELEMENT = "requires the length of the elements, which are omnidirectional"
_NO_ARRAY = "requires several receivers along the track"
_NO_STEP = "requires several receivers along the track, or the length of the elements"
_NO_CENTRES = "requires several phase centres: a track, or several receivers"
_NO_LOBES = "requires lobes; these would lie beyond end-fire"
_CURVED = "requires a straight track; this one is curved, or turns back"
_UNSEEN = "requires an aperture: several places from which the beam covers the middle"


def limits(
    sonar: Sonar,
    track: Track | None = None,
    grid: Grid | None = None,
    *,
    beam: BeamWindow | None = None,
    range_m: Sequence[float] | None = None,
    window: Window = "none",
    pointing: Pointing | None = None,
    element_pattern: bool = True,
    motion_in_flight: bool = False,
) -> Limits:
    """Return the limits of a survey: ping rate, sampling, resolution, grating lobes, swath, speed.

    The more of the survey is known, the more results there are. The others are listed in
    `Limits.missing`, with what they require.

    Parameters
    ----------
    sonar : Sonar
        The sonar, with the speed of sound. Of several receiver banks, all results but those on
        heights are for the first one, since each bank forms an image of its own.
    track : Track, optional
        Its track.
    grid : Grid, optional
        Pixels of the image.
    beam : BeamWindow, optional
        Weights of the channels in the image. Only channels within the beam count.
    range_m : (float, float), optional
        Nearest and farthest range that are recorded, metres. Without a grid, or without a track,
        they take the place of the grid's ranges.
    window
        Window of the pulse compression, as for `clsas.compress`.
    pointing : Pointing, optional
        Directions of the elements; by default to broadside.
    element_pattern : bool
        False if the elements are to be taken as omnidirectional.
    motion_in_flight : bool
        True if receivers move while the sound travels, which changes the error of phase centres.

    Returns
    -------
    Limits
        Named results, each with its value, unit, limit and equation.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is outside its limits.

    See Also
    --------
    check_sampling : Findings of a survey that exceeds its sampling limits.
    assess : Effects that an image needs, by the error without each of them.

    Notes
    -----
    Results "in the middle" apply to the pixel in the middle of the grid. Without a grid or a track,
    they apply to a point abeam of the middle of the track, in the middle of the recorded ranges.

    The first echo arrives after 2 Rmin/c [22], and the last ends at Tf = 2 Rmax/c + tau [23]. Pings
    may follow at a rate of 1/Tf [24]. The complex sample rate must be at least the bandwidth [25].

    Phase centres of elements of length L may be L/2 apart [27], [29]. With this spacing, the
    platform of a single receiver may advance by L/2 per ping [31], and that of an array by the
    extent of its phase centres. The fastest speed is this advance times the ping rate [30].

    Phase centres d apart cause grating lobes at the distance R lambda/(2 d) from a target [26]. The
    resolution is c/(2 B) in range [4] and L/2 in azimuth [3]. The widths are those of the Fourier
    transforms of the spectra of the survey in range and azimuth [21].

    The paths of a transmitter and a receiver that are D apart are D^2 cos^2(theta)/(4 R) longer
    than twice the path from their phase centre. D^2/(4 R) is common to all directions. The rest
    varies over the beamwidth Omega by D^2 sin^2(Omega/2)/(4 R), which must be far below a
    wavelength. This is [33] if its last symbol is the range; the thesis calls it the distance from
    phase centre to receiver. The limit here is an eighth of a wavelength, as in [34].

    Wavefronts over an array are plane to an eighth of a wavelength beyond 4 u^2/lambda [34], where
    u is half the length of the array. For a synthetic aperture, the way out curves like the way
    back, so the distance is twice as large.

    The phase between the images of two banks shows heights. The height of ambiguity shifts it by a
    cycle, at constant range. It is lambda R/B for a vertical baseline B at the range R.

    References
    ----------
    Ødegaard, "Fast time domain beamforming for synthetic aperture sonar", thesis, University of
    Oslo, 2004: chapter 2, equations in brackets.

    Examples
    --------
    The wide-beam case of the thesis. Its platform advances by half the array per ping, which leaves
    no gap. Its phase centres are a little farther apart than half an element:

    >>> import clsas
    >>> sonar = clsas.Sonar.thesis_wide_beam()
    >>> track = clsas.Track.straight([-2.376, 0, 0], [2, 0, 0], pings=10, ping_interval_s=0.264)
    >>> grid = clsas.Grid.plane(x=(-2.5, 2.5, 1024), y=(40, 45, 1024))
    >>> found = clsas.limits(sonar, track, grid)
    >>> found.exceeded
    ('phase_centre_spacing_m', 'doppler_bandwidth_hz')
    >>> advance = found["advance_m"]
    >>> print(f"{advance.value:.3f} m, at {advance.side} {advance.limit:.3f} m {advance.equation}")
    0.528 m, at most 0.528 m [31]
    """
    validate.instance("sonar", sonar, Sonar)
    survey = Survey(
        sonar.bank(0), track, grid, beam, range_m, window, pointing, element_pattern,
        motion_in_flight,
    )  # fmt: skip
    subjects = {
        "Range and ping interval": _ping_interval(survey),
        "Sampling along the track, and speed": chain(_advance(survey), _spacing(survey)),
        "Grating lobes": _grating_lobes(survey),
        "Resolution": _resolution(survey),
        "Near field and phase centres": chain(_far_fields(survey), _phase_centres(survey)),
        "Heights": _heights(survey, sonar),
    }
    results: list[Limit] = []
    missing: dict[str, str] = {}
    for subject, found in subjects.items():
        for each in found:
            if isinstance(each, Limit):
                results.append(replace(each, subject=subject))
            else:
                names, reason = each
                for name in names.split():
                    missing.setdefault(name, reason)
    return Limits(tuple(results), missing)


def _result(
    name: str,
    value: float,
    equation: str,
    meaning: str,
    *,
    most: float | None = None,
    least: float | None = None,
    slack: float = ROUNDING,
    consequence: str = "",
) -> Limit:
    """Return a result, whose unit is that of its name. `most` or `least` is its limit."""
    unit = next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")
    limit, side, kept = None, "", None
    if most is not None:
        limit, side, kept = most, "most", value <= most * (1 + slack)
    elif least is not None:
        limit, side, kept = least, "least", value >= least * (1 - slack)
    label = LABELS[name]
    return Limit(
        name, "", label, float(value), unit, limit, side, kept, equation, meaning, consequence
    )


def _ping_interval(survey: Survey) -> Iterator[Limit | _Missing]:
    """Yield the results on time: echoes, ping rate, unambiguous and recorded range, samples."""
    sonar, interval_s = survey.sonar, survey.interval_s
    pulse_s, sound_m_s = sonar.pulse.duration_s, sonar.sound_speed_m_s
    far_m = None
    if survey.extents_m is None:
        yield "first_echo_s last_echo_s ping_rate_hz swath_m", _NO_RANGE
    else:
        near_m, far_m = survey.extents_m
        first_s, last_s = receive_interval_s(near_m, far_m, pulse_s, sound_m_s)
        near, far = _shown(near_m, "m"), _shown(far_m, "m")
        yield _result(
            "first_echo_s", first_s, "[22]",
            f"Time from a ping to its first echo, from {near}.",
        )  # fmt: skip
        yield _result(
            "last_echo_s", last_s, "[23], [24]",
            f"Time from a ping to the end of its last echo, from {far}; the next ping may follow.",
            most=interval_s,
            consequence="The last echoes arrive together with the first of the next ping: ping "
            "more slowly, or image a smaller range",
        )  # fmt: skip
        if interval_s is None:
            yield "ping_rate_hz", _NO_INTERVAL
        else:
            yield _result(
                "ping_rate_hz", 1 / interval_s, "[24], [30]",
                "Pings at the limit follow as soon as the last echo has ended.",
                most=1 / last_s,
                consequence="This is the same limit as that of the last echo",
            )  # fmt: skip

    clear_m = None if interval_s is None else (interval_s - pulse_s) * sound_m_s / 2
    if clear_m is None:
        yield "unambiguous_range_m swath_m", _NO_INTERVAL
    elif clear_m <= 0:
        yield "unambiguous_range_m swath_m", "requires pings longer apart than the pulse lasts"
    else:
        yield _result(
            "unambiguous_range_m", clear_m, "[23], [24]",
            "Echoes from farther away end after the next ping, and look like nearer ones.",
            least=far_m,
            consequence="Echoes from farther away appear as ghosts at short range, in the line of "
            "the next ping",
        )  # fmt: skip
        if far_m is not None:
            yield _result(
                "swath_m", far_m - near_m, "[22]-[24]",
                f"Ranges from {near} to {far}; the limit is what fits the ping interval.",
                most=max(clear_m - near_m, 0.0),
                consequence="The ping interval is too short for this swath",
            )  # fmt: skip

    if survey.range_m is None:
        yield "recorded_from_m recorded_to_m", _NO_RECORD
    else:
        nearest_m, farthest_m = survey.grid_extents_m or (None, None)
        consequence = "Some channels record no echo from the {} pixels: record more, or image less"
        yield _result(
            "recorded_from_m", survey.range_m[0], "[22]",
            "Nearest range that is recorded; the limit is the nearest range of the grid.",
            most=nearest_m, consequence=consequence.format("nearest"),
        )  # fmt: skip
        yield _result(
            "recorded_to_m", survey.range_m[1], "[23]",
            "Farthest range that is recorded; the limit is the farthest range of the grid.",
            least=farthest_m, consequence=consequence.format("farthest"),
        )  # fmt: skip

    yield _result(
        "sample_rate_hz", sonar.sample_rate_hz, "[25]",
        "Complex samples per second of an echo; the limit is the bandwidth of the pulse.",
        least=sonar.pulse.bandwidth_hz,
        consequence="Echoes are undersampled",
    )  # fmt: skip


def _advance(survey: Survey) -> Iterator[Limit | _Missing]:
    """Yield the results on the advance from ping to ping, and on the speed."""
    sonar, array_m, interval_s = survey.sonar, survey.array_m, survey.interval_s
    whose = "half the array" if survey.is_array else "half an element"
    if not survey.is_straight:
        yield "advance_m overlap speed_m_s greatest_speed_m_s", _CURVED
        return
    if not survey.is_moving:
        yield "advance_m overlap speed_m_s", _NO_PINGS
    elif array_m is None:
        yield "advance_m overlap speed_m_s", _NO_STEP
    else:
        assert interval_s is not None
        step_m = float(survey.steps_m.max())
        yield _result(
            "advance_m", step_m, "[31]",
            f"Largest advance of the platform between pings; the limit is {whose}.",
            most=array_m, slack=SLACK,
            consequence="The phase centres of consecutive pings leave gaps: survey more slowly, "
            "or ping faster",
        )  # fmt: skip
        if survey.is_array:
            overlap = array_m / step_m
            repeated = sonar.receivers * max(1 - 1 / overlap, 0.0)
            remedy = " clsas.density_compensated gives them half the weight."
            yield _result(
                "overlap", overlap, "[31]",
                f"Half the array over the distance per ping: the next ping repeats {repeated:.3g} "
                f"of {sonar.receivers} phase centres.{remedy if repeated >= 0.5 else ''}",
                least=1.0, slack=SLACK,
                consequence="This is the same limit as that of the distance per ping",
            )  # fmt: skip
        else:
            yield "overlap", _NO_ARRAY
        yield _result(
            "speed_m_s", survey.speed_m_s, "[30], [31]",
            f"Speed along the track; at the limit, every ping advances by {whose}.",
            most=array_m / interval_s, slack=SLACK,
            consequence="This is the same limit as that of the distance per ping",
        )  # fmt: skip
    if survey.extents_m is None:
        yield "greatest_speed_m_s", _NO_RANGE
    elif array_m is None:
        yield "greatest_speed_m_s", _NO_STEP
    else:
        far_m = survey.extents_m[1]
        _, last_s = receive_interval_s(far_m, far_m, sonar.pulse.duration_s, sonar.sound_speed_m_s)
        yield _result(
            "greatest_speed_m_s", array_m / last_s, "[30]",
            f"Speed up to which a survey to {_shown(far_m, 'm')} can be sampled, at the highest "
            "ping rate.",
        )  # fmt: skip


def _spacing(survey: Survey) -> Iterator[Limit | _Missing]:
    """Yield the spacing of the phase centres, and the Doppler bandwidth that it must sample."""
    names = "phase_centre_spacing_m doppler_bandwidth_hz"
    if not survey.is_straight:
        yield names, _CURVED
        return
    corners_m = None
    if survey.grid is not None and survey.track is not None:
        corners_m = corners_of(survey.grid)
    found = measure_spacing(survey.sonar, survey.centres_m, corners_m, beam=survey.beam)
    if not found.spacing_m:
        yield names, _NO_CENTRES
        return
    if not math.isfinite(found.limit_m):
        yield names, "requires the length of the elements, a beam, or a grid with a track"
        return

    reason = found.reason.strip(", ")
    at_limit = f"the limit is {reason}" if found.reason[0] == "," else f"the limit serves {reason}"
    consequence = "Targets get ghosts along the track: use a slower survey or a narrower beam"
    from_pings = found.spacing_m > survey.pitch_m * (1 + SLACK)
    lobe_m = survey.ping_lobe_m if from_pings else survey.lobe_m
    if lobe_m is not None:
        many = "at multiples of " if from_pings else ""
        consequence = f"Expect grating lobes {many}{_shown(lobe_m, 'm')} to either side of a target"
        level_db = survey.ping_lobe_db if from_pings else survey.lobe_db
        if level_db is not None:
            consequence += f", {'the first ' * from_pings}{-level_db:.0f} dB below it"
    yield _result(
        "phase_centre_spacing_m", found.spacing_m, "[27], [29]",
        f"Largest gap between phase centres along the track; {at_limit}.",
        most=found.limit_m, slack=SLACK, consequence=consequence,
    )  # fmt: skip

    element_m = survey.sonar.element_length_m
    if element_m is None:
        yield "doppler_bandwidth_hz", _NO_ELEMENT
    elif not survey.is_moving:
        yield "doppler_bandwidth_hz", _NO_PINGS
    else:
        yield _result(
            "doppler_bandwidth_hz", 2 * survey.speed_m_s / element_m, "[28], [29]",
            "Band over which motion spreads an echo; the limit is the rate of phase centres.",
            most=survey.speed_m_s / found.spacing_m, slack=SLACK,
            consequence="This is the same limit as that of the phase-centre spacing",
        )  # fmt: skip


def _grating_lobes(survey: Survey) -> Iterator[Limit | _Missing]:
    """Yield where grating lobes lie, and their level: those of the phase centres, then of pings."""
    distance_m, lobe_m = survey.distance_m, survey.lobe_m
    if distance_m is None or not survey.is_straight:
        why = _NO_RANGE if distance_m is None else _CURVED
        yield "grating_lobe_m grating_lobe_db ping_lobe_m ping_lobe_db", why
        return
    if lobe_m is None:
        yield "grating_lobe_m grating_lobe_db", _NO_CENTRES
    else:
        where = ""
        if lobe_m > distance_m:
            where = "; this is beyond end-fire, so there is none"
        elif survey.grid is not None and survey.track is not None:
            extent_m = float(np.ptp(corners_of(survey.grid) @ survey.along))
            which = "all" if lobe_m <= extent_m / 2 else "some"
            where = f"; on the grid for {which} targets" if lobe_m <= extent_m else "; off the grid"
        yield _result(
            "grating_lobe_m", lobe_m, "[26]",
            "First lobe along the track from a target in the middle, at "
            f"{_shown(distance_m, 'm')}{where}.",
        )  # fmt: skip
        if lobe_m > distance_m:
            yield "grating_lobe_db", _NO_LOBES
        elif survey.lobe_db is None:
            yield "grating_lobe_db", _UNSEEN if survey.is_moving else _NO_PINGS
        else:
            yield _result(
                "grating_lobe_db", survey.lobe_db, "[26]",
                "Highest amplitude of these lobes relative to the target, in an exact image.",
            )  # fmt: skip

    if survey.ping_lobe_m is None:
        yield "ping_lobe_m ping_lobe_db", _NO_ARRAY if survey.is_moving else _NO_PINGS
        return
    yield _result(
        "ping_lobe_m", survey.ping_lobe_m, "[26]",
        "Gaps and errors that repeat with every ping cause lobes at multiples of this.",
    )  # fmt: skip
    if survey.ping_lobe_db is None:
        yield "ping_lobe_db", _UNSEEN if survey.width_m is None else _NO_LOBES
    else:
        yield _result(
            "ping_lobe_db", survey.ping_lobe_db, "[26]",
            "Highest amplitude at the first; a side lobe, unless pings leave gaps or overlap.",
        )  # fmt: skip


def _resolution(survey: Survey) -> Iterator[Limit | _Missing]:
    """Yield the resolution in range and azimuth, and whether the pixels sample it."""
    sonar, grid, element_m = survey.sonar, survey.grid, survey.sonar.element_length_m
    range_width = range_width_m(sonar, survey.window)
    yield _result(
        "range_resolution_m", sonar.sound_speed_m_s / 2 / sonar.pulse.bandwidth_hz,
        "[4]", "Resolution in range that the bandwidth of the pulse allows.",
    )  # fmt: skip
    yield _result(
        "range_width_m", range_width, "[17], [21]",
        "Width of a point in range at -3 dB, with the spectrum of the pulse and the window.",
    )  # fmt: skip
    if element_m is None:
        yield "azimuth_resolution_m", _NO_ELEMENT
    else:
        yield _result(
            "azimuth_resolution_m", element_m / 2, "[3]",
            "Resolution along the track that the length of the elements allows, at any range.",
        )  # fmt: skip

    azimuth_width = survey.width_m if survey.is_straight else None
    if azimuth_width is None:
        yield "azimuth_width_m aperture_m azimuth_pixel_m", _why_no_aperture(survey)
    else:
        assert survey.distance_m is not None
        yield _result(
            "azimuth_width_m", azimuth_width, "[21]",
            "Width of a point in the middle at -3 dB, with the track, elements and beam given.",
        )  # fmt: skip
        full_m, spans = None, ""
        if element_m is not None:
            full_m = survey.distance_m * sonar.wavelength_m / element_m
            spans = "; an element's beam spans the limit there"
        yield _result(
            "aperture_m", survey.aperture_m, "[2], [3]",
            f"Track that contributes to a pixel in the middle{spans}.",
            least=full_m, slack=SLACK,
            consequence="The resolution along the track is coarser than half an element: use a "
            "longer track or a wider beam",
        )  # fmt: skip

    if grid is None or survey.track is None or survey.point_m is None:
        yield "range_pixel_m azimuth_pixel_m", _NO_GRID
        return
    if grid.points_m is not None:
        yield "range_pixel_m azimuth_pixel_m", _NO_PLANE
        return
    steps_m = np.stack(grid.vectors_m[1:])[np.array(grid.shape) > 1]
    way_m = survey.point_m - survey.centres_m[len(survey.centres_m) // 2]
    way_m = way_m - (way_m @ survey.along) * survey.along
    towards = way_m / (np.linalg.norm(way_m) or 1.0)
    for name, direction, width_m in (
        ("range_pixel_m", towards, range_width),
        ("azimuth_pixel_m", survey.along, azimuth_width),
    ):
        if width_m is None:
            continue  # another result is missing for the same reason
        yield _result(
            name, float(np.abs(steps_m @ direction).max(initial=0.0)), "[21]",
            "Distance between pixels in this direction; the limit is the width of a point.",
            most=width_m,
            consequence="Targets between pixels lose amplitude, or are missed: use more pixels",
        )  # fmt: skip


def _why_no_aperture(survey: Survey) -> str:
    """Return why no synthetic aperture of the middle is known."""
    if not survey.is_straight:
        return _CURVED
    if survey.point_m is None:
        return _NO_RANGE
    return _UNSEEN if survey.has_aperture else _NO_PINGS


def _far_fields(survey: Survey) -> Iterator[Limit | _Missing]:
    """Yield where the far field begins: that of the receivers, and that of the aperture."""
    wavelength_m = survey.sonar.wavelength_m
    array_m = float(np.ptp(survey.sonar.rx_m, axis=0).max())
    if array_m:
        yield _result(
            "array_far_field_m", array_m**2 / wavelength_m, "[34]",
            "Wavefronts over the receivers are plane to an eighth of a wavelength from here on.",
        )  # fmt: skip
    else:
        yield "array_far_field_m", "requires several receivers"
    if not survey.has_aperture or not survey.is_straight or not survey.weights.any():
        yield "aperture_far_field_m", _why_no_aperture(survey)
        return
    assert survey.distance_m is not None
    far_m = 2 * survey.aperture_m**2 / wavelength_m
    field = "far field"
    if survey.distance_m < far_m:
        field = "near field, so images must be focused"
    yield _result(
        "aperture_far_field_m", far_m, "[34]",
        f"The same for the synthetic aperture; the grid lies in its {field}.",
    )  # fmt: skip


def _phase_centres(survey: Survey) -> Iterator[Limit | _Missing]:
    """Yield the errors of replacing transmitter and receiver by their phase centre."""
    names = "phase_centre_shift_m phase_centre_error_m"
    sonar = survey.sonar
    if survey.extents_m is None or survey.beam_sines is None:
        yield names, _NO_RANGE
        return
    near_m = survey.extents_m[0]
    apart_m = sonar.rx_m - sonar.tx_m
    lengthwise_m = apart_m[:, 0]
    if survey.motion_in_flight and survey.track is not None:
        speed_m_s = float(np.linalg.norm(survey.track.velocity_m_s, axis=1).max())
        lengthwise_m = lengthwise_m + 2 * near_m / sonar.sound_speed_m_s * speed_m_s
    largest_m = float(np.sqrt(lengthwise_m**2 + np.sum(apart_m[:, 1:] ** 2, axis=1)).max())
    if not largest_m:
        yield names, "requires a receiver apart from the transmitter"
        return
    if not near_m:
        yield names, "requires a nearest range above 0 m"
        return
    apart, near = _shown(largest_m, "m"), _shown(near_m, "m")
    yield _result(
        "phase_centre_shift_m", largest_m**2 / (4 * near_m), "[33]",
        f"Antennas {apart} apart lengthen the way to {near} and back by this; a delay corrects it.",
    )  # fmt: skip
    low, high = survey.beam_sines
    most = max(low**2, high**2)
    least = 0.0 if low <= 0 <= high else min(low**2, high**2)
    yield _result(
        "phase_centre_error_m",
        float(np.abs(lengthwise_m).max()) ** 2 * (most - least) / (4 * near_m), "[33]",
        "Part of this that varies over the beam; the limit is an eighth of a wavelength.",
        most=sonar.wavelength_m / 8,
        consequence="Image with transmitters and receivers at their own positions, as clsas does",
    )  # fmt: skip


def _heights(survey: Survey, sonar: Sonar) -> Iterator[Limit | _Missing]:
    """Yield the baseline of the outermost banks, and the heights that shift phases by a cycle.

    The receivers of a bank are represented by their mean, and the track by its pings. A sonar with
    one bank has no such results.
    """
    if sonar.banks == 1:
        return
    banks_m = [sonar.bank(number).rx_m.mean(axis=0) for number in range(sonar.banks)]
    low_m, high_m = min(banks_m, key=lambda m: m[2]), max(banks_m, key=lambda m: m[2])
    yield _result(
        "baseline_m", float(np.linalg.norm(high_m - low_m)), "",
        f"Distance between the lowest and the highest of {sonar.banks} receiver banks.",
    )  # fmt: skip
    if survey.track is None or survey.grid is None:
        yield "ambiguity_near_m ambiguity_far_m", _NO_GRID
        return

    # The ping that passes closest sees each point.
    points_m = survey.grid.spread()
    outermost = Sonar(sonar.pulse, np.stack([low_m, high_m]), tx_m=sonar.tx_m)
    tx_m, rx_m, _ = channels(outermost, survey.track)
    tx_m, rx_m = tx_m[::2], rx_m.reshape(-1, 2, 3)
    range_m = np.linalg.norm(points_m[:, None] - tx_m, axis=-1)
    closest, range_m = range_m.argmin(axis=1), range_m.min(axis=1)
    turns = phase_per_height(
        points_m, tx_m[closest], rx_m[closest, 0], rx_m[closest, 1], sonar.wavelength_m
    )
    with np.errstate(divide="ignore"):
        ambiguity_m = 2 * np.pi / np.abs(turns)
    for name, at in (("near", int(range_m.argmin())), ("far", int(range_m.argmax()))):
        if not math.isfinite(ambiguity_m[at]):
            yield f"ambiguity_{name}_m", "requires a baseline across the line of sight"
            continue
        yield _result(
            f"ambiguity_{name}_m", float(ambiguity_m[at]), "",
            "Height that shifts the phase between the banks by a cycle, at "
            f"{_shown(range_m[at], 'm')}.",
        )  # fmt: skip


@dataclass(frozen=True)
class Limit:
    """A result of `limits`: a number that describes a survey, and the limit that it should keep.

    Attributes
    ----------
    name : str
        Name with the unit, such as "advance_m".
    subject : str
        Heading under which the result is listed, such as "Along the track".
    label : str
        Name in words, such as "distance per ping".
    value : float
        Value in SI units or decibels.
    unit : str
        Unit of value and limit; empty for a ratio.
    limit : float or None
        Limit that the value should keep; None if there is none.
    side : str
        "most" if the value may be at most the limit, "least" if it must be at least the limit,
        empty if there is no limit.
    kept : bool or None
        True if the value keeps its limit; None if there is none.
    equation : str
        Numbers of the equations of Ødegaard (2004), in brackets.
    meaning : str
        What the number means, in one sentence.
    consequence : str
        What happens if the limit is not kept, and what to do; empty if there is no limit.

    See Also
    --------
    limits : Function that returns it, with an example.
    """

    name: str
    subject: str
    label: str
    value: float
    unit: str
    limit: float | None
    side: str
    kept: bool | None
    equation: str
    meaning: str
    consequence: str = ""

    __repr__ = reprs.of_fields


@dataclass(frozen=True)
class Limits:
    """Limits of a survey, as returned by `limits`.

    Attributes
    ----------
    results : tuple of Limit
        All results; ``limits[name]`` is the one with a name.
    missing : dict
        Names of the results that cannot be given, each with the reason.

    See Also
    --------
    limits : Function that returns it, with an example.
    """

    results: tuple[Limit, ...]
    missing: dict[str, str]

    def __repr__(self) -> str:
        """Return a summary: how many results there are, and which limits are exceeded."""
        return reprs.summary(
            self,
            f"{len(self.results)} results",
            f"limits not kept: {', '.join(self.exceeded) or 'none'}",
            f"{len(self.missing)} results missing" if self.missing else None,
        )

    def _repr_html_(self) -> str:
        headings = ("result", "value", "limit", "kept", "equation", "meaning")
        rows = [(*_cells(each), each.meaning) for each in self.results]
        return Report([Table(headings, rows, align="left"), *self._remarks()]).html()

    def __getitem__(self, name: str) -> Limit:
        """Return the result with a name; raise KeyError, with the reason, if there is none."""
        for each in self.results:
            if each.name == name:
                return each
        if name in self.missing:
            raise KeyError(f"{name}: {self.missing[name]}")
        raise KeyError(name)

    @property
    def exceeded(self) -> tuple[str, ...]:
        """Names of the results that do not keep their limits."""
        return tuple(each.name for each in self.results if each.kept is False)

    def describe(self) -> str:
        """Return the results as text: a table, with the meaning of each number below it."""
        headings = ("result", "value", "limit", "kept", "equation")
        table = Table(headings, [_cells(each) for each in self.results], align="left")
        heading, *rows = table.lines()
        lines = [f"  {heading}"] if rows else []
        subject = None
        for each, row in zip(self.results, rows, strict=True):
            if each.subject != subject:
                subject = each.subject
                lines += ["", subject]
            lines += [f"  {row}", f"    {each.meaning}"]
        return "\n".join([*lines, "", *self._remarks()]).strip()

    def _remarks(self) -> list[str]:
        """Return which limits are not kept, and what is missing, one sentence per line."""
        checked = [each for each in self.results if each.kept is not None]
        broken = [each for each in checked if not each.kept]
        if not checked:
            lines = ["No limit could be checked."]
        elif not broken:
            lines = [f"All limits that could be checked are kept ({len(checked)})."]
        else:
            are = "is" if len(broken) == 1 else "are"
            lines = [f"{len(broken)} of {len(checked)} limits {are} not kept:"]
        for each in broken:
            assert each.limit is not None
            value, limit = _shown(each.value, each.unit), _shown(each.limit, each.unit)
            excess = f"{value} is not at {each.side} {limit}"
            if each.unit and each.limit > 0 and each.value > 0:
                ratio = each.value / each.limit
                how = f"{abs(ratio - 1):.0%} {'above' if ratio > 1 else 'below'}"
                if ratio >= 2:
                    how = f"{ratio:.3g} times"
                excess = f"{value} is {how} the limit of {limit}"
            lines.append(f"  {each.label}: {excess}. {each.consequence}.")
        reasons: dict[str, list[str]] = {}
        for name, reason in self.missing.items():
            reasons.setdefault(reason, []).append(LABELS[name])
        if reasons:
            lines.append("Not given:")
        lines += [f"  {', '.join(names)}: {reason}" for reason, names in reasons.items()]
        return lines


def _cells(each: Limit) -> tuple[str, ...]:
    """Return what a row of the table shows."""
    limit = "-" if each.limit is None else f"at {each.side} {_shown(each.limit, each.unit)}"
    kept = {True: "yes", False: "NO", None: "-"}[each.kept]
    return each.label, _shown(each.value, each.unit), limit, kept, each.equation


def _shown(value: float, unit: str) -> str:
    """Return a value with its unit, to four significant digits."""
    if unit == "dB":
        return f"{value:.1f} dB"
    if unit == "m" and abs(value) >= 10e3:
        return f"{value / 1e3:.4g} km"
    return reprs.measured(value, unit)
