"""Results of `clsas.limits` on the sampling: ping interval, track, speed and grating lobes.

Each function yields results, or the names of results and why they cannot be given. Equations in
brackets are those of the thesis (Ødegaard 2004); `clsas.limits` explains them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from clsas.inspection.sampling import (
    SLACK,
    corners_of,
    measure_spacing,
    receive_interval_s,
)
from clsas.measures.limits_common import (
    CURVED,
    NO_ARRAY,
    NO_CENTRES,
    NO_ELEMENT,
    NO_INTERVAL,
    NO_LOBES,
    NO_PINGS,
    NO_RANGE,
    NO_RECORD,
    NO_STEP,
    UNSEEN,
    Result,
    result,
)
from clsas.measures.limits_geometry import Survey
from clsas.measures.limits_result import Limit, shown


def ping_interval(survey: Survey) -> Iterator[Result]:
    """Yield the results on time: echoes, ping rate, and unambiguous range."""
    sonar, interval_s = survey.sonar, survey.interval_s
    pulse_s, sound_m_s = sonar.pulse.duration_s, sonar.sound_speed_m_s
    clear_m = None if interval_s is None else (interval_s - pulse_s) * sound_m_s / 2
    if survey.extents_m is None:
        yield "first_echo_s last_echo_s ping_rate_hz swath_m", NO_RANGE
        far_m = None
    else:
        near_m, far_m = survey.extents_m
        first_s, last_s = receive_interval_s(near_m, far_m, pulse_s, sound_m_s)
        near, far = shown(near_m, "m"), shown(far_m, "m")
        yield result(
            "first_echo_s", first_s, "[22]",
            f"Time from a ping to its first echo, from {near}.",
        )  # fmt: skip
        yield result(
            "last_echo_s", last_s, "[23], [24]",
            f"Time from a ping to the end of its last echo, from {far}; the next ping may follow.",
            most=interval_s,
            consequence="The last echoes arrive together with the first of the next ping: ping "
            "more slowly, or image a smaller range",
        )  # fmt: skip
        if interval_s is None:
            yield "ping_rate_hz", NO_INTERVAL
        else:
            yield result(
                "ping_rate_hz", 1 / interval_s, "[24], [30]",
                "Pings at the limit follow as soon as the last echo has ended.",
                most=1 / last_s,
                consequence="This is the same limit as that of the last echo",
            )  # fmt: skip
    if clear_m is None:
        yield "unambiguous_range_m swath_m", NO_INTERVAL
    elif clear_m <= 0:
        yield "unambiguous_range_m swath_m", "requires pings longer apart than the pulse lasts"
    else:
        yield result(
            "unambiguous_range_m", clear_m, "[23], [24]",
            "Echoes from farther away end after the next ping, and look like nearer ones.",
            least=far_m,
            consequence="Echoes from farther away appear as ghosts at short range, in the line of "
            "the next ping",
        )  # fmt: skip
        if survey.extents_m is not None:
            near_m, far_m = survey.extents_m
            yield result(
                "swath_m", far_m - near_m, "[22]-[24]",
                f"Ranges from {near} to {far}; the limit is what fits the ping interval.",
                most=max(clear_m - near_m, 0.0),
                consequence="The ping interval is too short for this swath",
            )  # fmt: skip
    yield from _recorded(survey)
    yield result(
        "sample_rate_hz", sonar.sample_rate_hz, "[25]",
        "Complex samples per second of an echo; the limit is the bandwidth of the pulse.",
        least=sonar.pulse.bandwidth_hz,
        consequence="Echoes are undersampled",
    )  # fmt: skip


def _recorded(survey: Survey) -> Iterator[Result]:
    """Yield whether the recorded ranges contain the grid."""
    if survey.range_m is None:
        yield "recorded_from_m recorded_to_m", NO_RECORD
        return
    from_m, to_m = survey.range_m
    near_m, far_m = survey.grid_extents_m or (None, None)
    consequence = "Some channels record no echo from the {} pixels: record more, or image less"
    yield result(
        "recorded_from_m", from_m, "[22]",
        "Nearest range that is recorded; the limit is the nearest range of the grid.",
        most=near_m, consequence=consequence.format("nearest"),
    )  # fmt: skip
    yield result(
        "recorded_to_m", to_m, "[23]",
        "Farthest range that is recorded; the limit is the farthest range of the grid.",
        least=far_m, consequence=consequence.format("farthest"),
    )  # fmt: skip


def along_track(survey: Survey) -> Iterator[Result]:
    """Yield the results on the sampling along the track, and on the speed."""
    sonar, array_m, interval_s = survey.sonar, survey.array_m, survey.interval_s
    whose = "half the array" if survey.is_array else "half an element"
    if not survey.is_straight:
        yield (
            "advance_m overlap speed_m_s greatest_speed_m_s phase_centre_spacing_m "
            "doppler_bandwidth_hz",
            CURVED,
        )
        return
    if not survey.is_moving:
        yield "advance_m overlap speed_m_s", NO_PINGS
    elif array_m is None:
        yield "advance_m overlap speed_m_s", NO_STEP
    else:
        assert survey.track is not None
        assert interval_s is not None
        step_m = float(survey.steps_m.max())
        yield result(
            "advance_m", step_m, "[31]",
            f"Largest advance of the platform between pings; the limit is {whose}.",
            most=array_m, slack=SLACK,
            consequence="The phase centres of consecutive pings leave gaps: survey more slowly, "
            "or ping faster",
        )  # fmt: skip
        if survey.is_array:
            yield _overlap(survey, array_m / step_m)
        else:
            yield "overlap", NO_ARRAY
        speed_m_s = float((survey.steps_m / np.diff(survey.track.time_s)).max())
        yield result(
            "speed_m_s", speed_m_s, "[30], [31]",
            f"Speed along the track; at the limit, every ping advances by {whose}.",
            most=array_m / interval_s, slack=SLACK,
            consequence="This is the same limit as that of the distance per ping",
        )  # fmt: skip
    if survey.extents_m is None:
        yield "greatest_speed_m_s", NO_RANGE
    elif array_m is None:
        yield "greatest_speed_m_s", NO_STEP
    else:
        far_m = survey.extents_m[1]
        _, last_s = receive_interval_s(far_m, far_m, sonar.pulse.duration_s, sonar.sound_speed_m_s)
        yield result(
            "greatest_speed_m_s", array_m / last_s, "[30]",
            f"Speed up to which a survey to {shown(far_m, 'm')} can be sampled, at the highest "
            "ping rate.",
        )  # fmt: skip
    yield from _spacing(survey)


def _overlap(survey: Survey, overlap: float) -> Limit:
    """Return the overlap of consecutive pings of an array."""
    shared = survey.sonar.receivers * max(1 - 1 / overlap, 0.0)
    remedy = " clsas.density_compensated gives them half the weight." if shared >= 0.5 else ""
    return result(
        "overlap", overlap, "[31]",
        f"Half the array over the distance per ping: the next ping repeats {shared:.3g} of "
        f"{survey.sonar.receivers} phase centres.{remedy}",
        least=1.0, slack=SLACK,
        consequence="This is the same limit as that of the distance per ping",
    )  # fmt: skip


def _spacing(survey: Survey) -> Iterator[Result]:
    """Yield the spacing of the phase centres, and the Doppler bandwidth that it must sample."""
    sonar, names = survey.sonar, "phase_centre_spacing_m doppler_bandwidth_hz"
    if not survey.spacing_m:
        yield names, NO_CENTRES
        return
    corners_m = None
    if survey.grid is not None and survey.track is not None:
        corners_m = corners_of(survey.grid)
    found = measure_spacing(sonar, survey.centres_m, corners_m, beam=survey.beam)
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
        consequence = f"Expect grating lobes {many}{shown(lobe_m, 'm')} to either side of a target"
        if (level_db := survey.lobe_db(lobe_m)) is not None:
            consequence += f", {'the first ' * from_pings}{-level_db:.0f} dB below it"
    yield result(
        "phase_centre_spacing_m", found.spacing_m, "[27], [29]",
        f"Largest gap between phase centres along the track; {at_limit}.",
        most=found.limit_m, slack=SLACK, consequence=consequence,
    )  # fmt: skip
    if survey.element_m is None:
        yield "doppler_bandwidth_hz", NO_ELEMENT
    elif not survey.is_moving:
        yield "doppler_bandwidth_hz", NO_PINGS
    else:
        assert survey.track is not None
        speed_m_s = float((survey.steps_m / np.diff(survey.track.time_s)).max())
        yield result(
            "doppler_bandwidth_hz", 2 * speed_m_s / survey.element_m,
            "[28], [29]",
            "Band over which motion spreads an echo; the limit is the rate of phase centres.",
            most=speed_m_s / found.spacing_m, slack=SLACK,
            consequence="This is the same limit as that of the phase-centre spacing",
        )  # fmt: skip


def grating_lobes(survey: Survey) -> Iterator[Result]:
    """Yield where grating lobes lie, and their level."""
    if survey.distance_m is None:
        yield "grating_lobe_m grating_lobe_db ping_lobe_m ping_lobe_db", NO_RANGE
    elif not survey.is_straight:
        yield "grating_lobe_m grating_lobe_db ping_lobe_m ping_lobe_db", CURVED
    else:
        yield from _element_lobes(survey, survey.distance_m)
        yield from _ping_lobes(survey)


def _element_lobes(survey: Survey, distance_m: float) -> Iterator[Result]:
    """Yield the lobes that follow from the regular spacing of the phase centres."""
    if (lobe_m := survey.lobe_m) is None:
        yield "grating_lobe_m grating_lobe_db", NO_CENTRES
        return
    where = ""
    if lobe_m > distance_m:
        where = "; this is beyond end-fire, so there is none"
    elif survey.grid_extents_m is not None:
        assert survey.grid is not None
        extent_m = float(np.ptp(corners_of(survey.grid) @ survey.along))
        which = "all" if lobe_m <= extent_m / 2 else "some"
        where = f"; on the grid for {which} targets" if lobe_m <= extent_m else "; off the grid"
    yield result(
        "grating_lobe_m", lobe_m, "[26]",
        f"First lobe along the track from a target in the middle, at {shown(distance_m, 'm')}"
        f"{where}.",
    )  # fmt: skip
    if lobe_m > distance_m:
        yield "grating_lobe_db", NO_LOBES
    elif (level_db := survey.lobe_db(lobe_m)) is None:
        yield "grating_lobe_db", NO_PINGS if not survey.is_moving else UNSEEN
    else:
        yield result(
            "grating_lobe_db", level_db, "[26]",
            "Highest amplitude of these lobes relative to the target, in an exact image.",
        )  # fmt: skip


def _ping_lobes(survey: Survey) -> Iterator[Result]:
    """Yield the lobes that follow from the distance between the pings of an array."""
    if (lobe_m := survey.ping_lobe_m) is None:
        yield "ping_lobe_m ping_lobe_db", NO_ARRAY if survey.is_moving else NO_PINGS
        return
    yield result(
        "ping_lobe_m", lobe_m, "[26]",
        "Gaps and errors that repeat with every ping cause lobes at multiples of this.",
    )  # fmt: skip
    if (level_db := survey.lobe_db(lobe_m)) is None:
        yield "ping_lobe_db", NO_LOBES if survey.width_m is not None else UNSEEN
    else:
        yield result(
            "ping_lobe_db", level_db, "[26]",
            "Highest amplitude at the first; a side lobe, unless pings leave gaps or overlap.",
        )  # fmt: skip
