"""The results of `clsas.limits`: one function for each subject, and the table of all.

Each yields results from a `Survey`, or the names of results and why they cannot be given. Equations
in brackets are those of the thesis (Ødegaard 2004); `clsas.limits` explains them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from clsas.measures.limits_geometry import Survey
from clsas.measures.limits_result import Limit, shown
from clsas.measures.resolution import range_width_m
from clsas.sonar.sampling import (
    SLACK,
    corners_of,
    grating_lobe_m,
    measure_spacing,
    receive_interval_s,
)

Result = Limit | tuple[str, str]
"""A result, or the names of results (separated by spaces) and why they cannot be given."""

_ROUNDING = 1e-6  # relative excess of a limit that rounding explains
_SHARE = 8  # an eighth of a wavelength: the error of a path that [34] allows
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
_CURVED = "requires a straight track; this one is curved, or turns back"
_UNSEEN = "requires an aperture: several places from which the beam covers the middle"


def _result(
    name: str,
    label: str,
    value: float,
    equation: str,
    meaning: str,
    *,
    most: float | None = None,
    least: float | None = None,
    slack: float = _ROUNDING,
    consequence: str = "",
) -> Limit:
    """Return a result, whose unit is that of its name. `most` or `least` is its limit."""
    unit = next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")
    limit, side, kept = None, "", None
    if most is not None:
        limit, side, kept = most, "most", value <= most * (1 + slack)
    elif least is not None:
        limit, side, kept = least, "least", value >= least * (1 - slack)
    return Limit(
        name, "", label, float(value), unit, limit, side, kept, equation, meaning, consequence
    )


def _ping_interval(survey: Survey) -> Iterator[Result]:
    """Yield the results on time: echoes, ping rate, and unambiguous range."""
    sonar, interval_s = survey.sonar, survey.interval_s
    pulse_s, sound_m_s = sonar.pulse.duration_s, sonar.sound_speed_m_s
    clear_m = None if interval_s is None else (interval_s - pulse_s) * sound_m_s / 2
    if survey.extents_m is None:
        yield "first_echo_s last_echo_s ping_rate_hz swath_m", _NO_RANGE
        far_m = None
    else:
        near_m, far_m = survey.extents_m
        first_s, last_s = receive_interval_s(near_m, far_m, pulse_s, sound_m_s)
        near, far = shown(near_m, "m"), shown(far_m, "m")
        yield _result(
            "first_echo_s", "first echo", first_s, "[22]",
            f"Time from a ping to its first echo, from {near}.",
        )  # fmt: skip
        yield _result(
            "last_echo_s", "last echo", last_s, "[23], [24]",
            f"Time from a ping to the end of its last echo, from {far}; the next ping may follow.",
            most=interval_s,
            consequence="The last echoes arrive together with the first of the next ping: ping "
            "more slowly, or image a smaller range",
        )  # fmt: skip
        if interval_s is None:
            yield "ping_rate_hz", _NO_INTERVAL
        else:
            yield _result(
                "ping_rate_hz", "ping rate", 1 / interval_s, "[24], [30]",
                "Pings at the limit follow as soon as the last echo has ended.",
                most=1 / last_s,
                consequence="This is the same limit as that of the last echo",
            )  # fmt: skip
    if clear_m is None:
        yield "unambiguous_range_m swath_m", _NO_INTERVAL
    elif clear_m <= 0:
        yield "unambiguous_range_m swath_m", "requires pings longer apart than the pulse lasts"
    else:
        yield _result(
            "unambiguous_range_m", "unambiguous range", clear_m, "[23], [24]",
            "Echoes from farther away end after the next ping, and look like nearer ones.",
            least=far_m,
            consequence="The range beyond shows ghosts of the next ping's echoes",
        )  # fmt: skip
        if survey.extents_m is not None:
            near_m, far_m = survey.extents_m
            yield _result(
                "swath_m", "swath", far_m - near_m, "[22]-[24]",
                f"Ranges from {near} to {far}; the ping interval leaves the limit from there.",
                most=max(clear_m - near_m, 0.0),
                consequence="The ping interval is too short for this swath",
            )  # fmt: skip
    yield from _recorded(survey)
    yield _result(
        "sample_rate_hz", "sample rate", sonar.sample_rate_hz, "[25]",
        "Complex samples per second of an echo; the limit is the bandwidth of the pulse.",
        least=sonar.pulse.bandwidth_hz,
        consequence="Echoes are undersampled",
    )  # fmt: skip


def _recorded(survey: Survey) -> Iterator[Result]:
    """Yield whether the recorded ranges contain the grid."""
    if survey.range_m is None:
        yield "recorded_from_m recorded_to_m", _NO_RECORD
        return
    from_m, to_m = survey.range_m
    near_m, far_m = survey.grid_extents_m or (None, None)
    consequence = "Some channels do not receive the pixels beyond: record more, or image less"
    yield _result(
        "recorded_from_m", "recorded from", from_m, "[22]",
        "Nearest range that is recorded; the limit is the nearest range of the grid.",
        most=near_m, consequence=consequence,
    )  # fmt: skip
    yield _result(
        "recorded_to_m", "recorded to", to_m, "[23]",
        "Farthest range that is recorded; the limit is the farthest range of the grid.",
        least=far_m, consequence=consequence,
    )  # fmt: skip


def _along_track(survey: Survey) -> Iterator[Result]:
    """Yield the results on the sampling along the track, and on the speed."""
    sonar, array_m, interval_s = survey.sonar, survey.array_m, survey.interval_s
    whose = "half the array" if survey.is_array else "half an element"
    if not survey.is_straight:
        yield (
            "advance_m overlap speed_m_s greatest_speed_m_s phase_centre_spacing_m "
            "doppler_bandwidth_hz",
            _CURVED,
        )
        return
    if not survey.is_moving:
        yield "advance_m overlap speed_m_s", _NO_PINGS
    elif array_m is None:
        yield "advance_m overlap speed_m_s", _NO_STEP
    else:
        assert survey.track is not None
        assert interval_s is not None
        step_m = float(survey.steps_m.max())
        yield _result(
            "advance_m", "distance per ping", step_m, "[31]",
            f"Largest advance of the platform between pings; the limit is {whose}.",
            most=array_m, slack=SLACK,
            consequence="The phase centres of consecutive pings leave gaps: survey more slowly, "
            "or ping faster",
        )  # fmt: skip
        if survey.is_array:
            yield _overlap(survey, array_m / step_m)
        else:
            yield "overlap", _NO_ARRAY
        speed_m_s = float((survey.steps_m / np.diff(survey.track.time_s)).max())
        yield _result(
            "speed_m_s", "speed", speed_m_s, "[30], [31]",
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
            "greatest_speed_m_s", "greatest speed", array_m / last_s, "[30]",
            f"Speed up to which a survey to {shown(far_m, 'm')} can be sampled, at the highest "
            "ping rate.",
        )  # fmt: skip
    yield from _spacing(survey)


def _overlap(survey: Survey, overlap: float) -> Limit:
    """Return the overlap of consecutive pings of an array."""
    shared = survey.sonar.receivers * max(1 - 1 / overlap, 0.0)
    return _result(
        "overlap", "overlap of pings", overlap, "[31]",
        f"Half the array over the distance per ping: the next ping repeats {shared:.3g} of "
        f"{survey.sonar.receivers} phase centres.",
        least=1.0, slack=SLACK,
        consequence="This is the same limit as that of the distance per ping",
    )  # fmt: skip


def _spacing(survey: Survey) -> Iterator[Result]:
    """Yield the spacing of the phase centres, and the Doppler bandwidth that it must sample."""
    sonar, names = survey.sonar, "phase_centre_spacing_m doppler_bandwidth_hz"
    if not survey.spacing_m:
        yield names, _NO_CENTRES
        return
    corners_m = None
    if survey.grid is not None and survey.track is not None:
        corners_m = corners_of(survey.grid)
    found = measure_spacing(sonar, survey.centres_m, corners_m, beam=survey.beam)
    if not math.isfinite(found.limit_m):
        yield names, "requires the length of the elements, a beam, or a grid with a track"
        return
    reason = found.reason.strip(", ")
    at_limit = f"the limit is {reason}" if found.reason[0] == "," else f"limited {reason}"
    consequence = "Targets get ghosts along the track: use a slower survey or a narrower beam"
    if survey.lobe_m is not None:
        consequence = f"Expect grating lobes {shown(survey.lobe_m, 'm')} to either side of a target"
        if survey.lobe_db is not None:
            consequence += f", {-survey.lobe_db:.0f} dB below it"
    yield _result(
        "phase_centre_spacing_m", "phase-centre spacing", found.spacing_m, "[27], [29]",
        f"Largest gap between phase centres along the track; {at_limit}.",
        most=found.limit_m, slack=SLACK, consequence=consequence,
    )  # fmt: skip
    if survey.element_m is None:
        yield "doppler_bandwidth_hz", _NO_ELEMENT
    elif not survey.is_moving:
        yield "doppler_bandwidth_hz", _NO_PINGS
    else:
        assert survey.track is not None
        speed_m_s = float((survey.steps_m / np.diff(survey.track.time_s)).max())
        yield _result(
            "doppler_bandwidth_hz", "Doppler bandwidth", 2 * speed_m_s / survey.element_m,
            "[28], [29]",
            "Band over which motion spreads an echo; the limit is the rate of phase centres.",
            most=speed_m_s / found.spacing_m, slack=SLACK,
            consequence="This is the same limit as that of the phase-centre spacing",
        )  # fmt: skip


def _grating_lobes(survey: Survey) -> Iterator[Result]:
    """Yield where grating lobes lie, and their level."""
    names = "grating_lobe_m grating_lobe_db ping_lobe_m"
    if survey.distance_m is None:
        yield names, _NO_RANGE
        return
    if not survey.is_straight:
        yield names, _CURVED
        return
    wavelength_m, distance_m = survey.sonar.wavelength_m, survey.distance_m
    where = f"in the middle, at {shown(distance_m, 'm')}"
    if (lobe_m := survey.lobe_m) is None:
        yield names, _NO_CENTRES
        return
    off_grid = ""
    if lobe_m > distance_m:
        off_grid = "; this is beyond end-fire, so there is none"
    elif survey.grid_extents_m is not None:
        assert survey.grid is not None
        extent_m = float(np.ptp(corners_of(survey.grid) @ survey.along))
        off_grid = "; off the grid"
        if lobe_m <= extent_m:
            off_grid = "; on the grid for some targets"
            if lobe_m <= extent_m / 2:
                off_grid = "; on the grid for all targets"
    yield _result(
        "grating_lobe_m", "grating lobes", lobe_m, "[26]",
        f"First lobe along the track from a target {where}{off_grid}.",
    )  # fmt: skip
    if lobe_m > distance_m:
        yield "grating_lobe_db", "requires grating lobes; there are none"
    elif survey.lobe_db is None:
        yield "grating_lobe_db", _NO_PINGS if not survey.is_moving else _UNSEEN
    else:
        yield _result(
            "grating_lobe_db", "level of these lobes", survey.lobe_db, "[26]",
            "Highest amplitude of these lobes relative to the target, in an exact image.",
        )  # fmt: skip
    step_m = float(survey.steps_m.max()) if survey.is_moving else 0.0
    if not survey.is_moving or survey.sonar.receivers == 1:
        yield "ping_lobe_m", _NO_PINGS if not survey.is_moving else _NO_ARRAY
    else:
        yield _result(
            "ping_lobe_m", "lobes of pings", grating_lobe_m(wavelength_m, step_m, distance_m),
            "[26]",
            "Gaps and errors that repeat with every ping cause lobes at multiples of this.",
        )  # fmt: skip


def _resolution(survey: Survey) -> Iterator[Result]:
    """Yield the resolution in range and azimuth, and whether the pixels sample it."""
    sonar = survey.sonar
    range_width = range_width_m(sonar, survey.window)
    yield _result(
        "range_resolution_m", "range, c/2B", sonar.sound_speed_m_s / 2 / sonar.pulse.bandwidth_hz,
        "[4]", "Resolution in range that the bandwidth of the pulse allows.",
    )  # fmt: skip
    yield _result(
        "range_width_m", "range, width", range_width, "[17], [21]",
        "Width of a point in range at -3 dB, with the spectrum of the pulse and the window.",
    )  # fmt: skip
    if survey.element_m is None:
        yield "azimuth_resolution_m", _NO_ELEMENT
    else:
        yield _result(
            "azimuth_resolution_m", "azimuth, L/2", survey.element_m / 2, "[3]",
            "Resolution along the track that the length of the elements allows, at any range.",
        )  # fmt: skip
    width_m = survey.width_m
    straight = survey.is_straight
    if not straight or width_m is None:
        why = _NO_RANGE if survey.point_m is None else _NO_PINGS if survey.view is None else _UNSEEN
        yield "azimuth_width_m aperture_m azimuth_pixel_m", _CURVED if not straight else why
    else:
        yield _result(
            "azimuth_width_m", "azimuth, width", width_m, "[21]",
            "Width of a point in the middle at -3 dB, with the track, elements and beam given.",
        )  # fmt: skip
        yield from _aperture(survey)
    yield from _pixels(survey, range_width, width_m if straight else None)


def _aperture(survey: Survey) -> Iterator[Result]:
    """Yield the length of the synthetic aperture, and whether it exhausts the elements' beam."""
    assert survey.distance_m is not None
    assert survey.view is not None
    full_m = None
    if survey.element_m is not None:
        full_m = survey.distance_m * survey.sonar.wavelength_m / survey.element_m
    yield _result(
        "aperture_m", "synthetic aperture", survey.aperture_m, "[2], [3]",
        "Track that contributes to a pixel in the middle; an element's beam spans the limit there."
        if full_m is not None
        else "Track that contributes to a pixel in the middle.",
        least=full_m, slack=SLACK,
        consequence="The resolution along the track is coarser than half an element: use a longer "
        "track or a wider beam",
    )  # fmt: skip


def _pixels(survey: Survey, range_width: float, azimuth_width: float | None) -> Iterator[Result]:
    """Yield the steps of the pixels, and whether they are smaller than a point's response."""
    if survey.grid is None or survey.track is None or survey.point_m is None:
        yield "range_pixel_m azimuth_pixel_m", _NO_GRID
        return
    if survey.grid.points_m is not None:
        yield "range_pixel_m azimuth_pixel_m", _NO_PLANE
        return
    steps_m = np.stack(survey.grid.vectors_m[1:])[np.array(survey.grid.shape) > 1]
    way_m = survey.point_m - survey.centres_m[len(survey.centres_m) // 2]
    way_m = way_m - (way_m @ survey.along) * survey.along
    towards = way_m / (np.linalg.norm(way_m) or 1.0)
    consequence = "Targets between pixels lose amplitude, or are missed: use more pixels"
    for name, label, direction, width_m in (
        ("range_pixel_m", "pixels in range", towards, range_width),
        ("azimuth_pixel_m", "pixels in azimuth", survey.along, azimuth_width),
    ):
        if width_m is None:
            continue  # another result is missing for the same reason
        step_m = float(np.abs(steps_m @ direction).max(initial=0.0))
        yield _result(
            name, label, step_m, "[21]",
            "Distance between pixels in this direction; the limit is the width of a point.",
            most=width_m, consequence=consequence,
        )  # fmt: skip


def _approximations(survey: Survey) -> Iterator[Result]:
    """Yield where the far field begins, and the errors of phase centres."""
    wavelength_m = survey.sonar.wavelength_m
    array_m = float(np.ptp(survey.sonar.rx_m, axis=0).max())
    if array_m:
        yield _result(
            "array_far_field_m", "far field of the array", array_m**2 / wavelength_m, "[34]",
            "Wavefronts over the receivers are plane to an eighth of a wavelength from here on.",
        )  # fmt: skip
    else:
        yield "array_far_field_m", "requires several receivers"
    if survey.view is None or not survey.is_straight or not survey.view.weights.any():
        why = _NO_RANGE if survey.point_m is None else _NO_PINGS if survey.view is None else _UNSEEN
        yield "aperture_far_field_m", why if survey.is_straight else _CURVED
    else:
        assert survey.distance_m is not None
        is_near = survey.distance_m < (far_m := 2 * survey.aperture_m**2 / wavelength_m)
        yield _result(
            "aperture_far_field_m", "far field of the aperture", far_m, "[34]",
            f"The same for the synthetic aperture; the grid lies in its {'near' * is_near}"
            f"{'far' * (not is_near)} field{', so images must be focused' * is_near}.",
        )  # fmt: skip
    yield from _phase_centres(survey)


def _phase_centres(survey: Survey) -> Iterator[Result]:
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
    low, high = survey.beam_sines
    most = max(low**2, high**2)
    least = 0.0 if low <= 0 <= high else min(low**2, high**2)
    limit_m = sonar.wavelength_m / _SHARE
    apart, near = shown(largest_m, "m"), shown(near_m, "m")
    yield _result(
        "phase_centre_shift_m", "phase centres, path", largest_m**2 / (4 * near_m), "[33]",
        f"Antennas {apart} apart lengthen the way to {near} and back by this; a delay corrects it.",
    )  # fmt: skip
    error_m = float(np.abs(lengthwise_m).max()) ** 2 * (most - least) / (4 * near_m)
    yield _result(
        "phase_centre_error_m", "phase centres, error", error_m, "[33]",
        "Part of this that varies over the beam; the limit is an eighth of a wavelength.",
        most=limit_m,
        consequence="Image with transmitters and receivers at their own positions, as clsas does",
    )  # fmt: skip


SUBJECTS: dict[str, Callable[[Survey], Iterator[Result]]] = {
    "Range and ping interval": _ping_interval,
    "Sampling along the track, and speed": _along_track,
    "Grating lobes": _grating_lobes,
    "Resolution": _resolution,
    "Near field and phase centres": _approximations,
}
"""The function of each subject, in the order of the results."""
