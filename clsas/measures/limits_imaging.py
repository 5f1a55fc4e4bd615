"""Results of `clsas.limits` on the image: resolution, near field and phase centres.

Each function yields results, or the names of results and why they cannot be given. Equations in
brackets are those of the thesis (Ødegaard 2004); `clsas.limits` explains them.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from clsas.inspection.sampling import SLACK
from clsas.measures.limits_common import (
    CURVED,
    NO_ELEMENT,
    NO_GRID,
    NO_PINGS,
    NO_PLANE,
    NO_RANGE,
    UNSEEN,
    Result,
    result,
)
from clsas.measures.limits_geometry import Survey
from clsas.measures.limits_result import shown
from clsas.measures.resolution import range_width_m

_SHARE = 8  # an eighth of a wavelength: the error of a path that [34] allows


def resolution(survey: Survey) -> Iterator[Result]:
    """Yield the resolution in range and azimuth, and whether the pixels sample it."""
    sonar = survey.sonar
    range_width = range_width_m(sonar, survey.window)
    yield result(
        "range_resolution_m", sonar.sound_speed_m_s / 2 / sonar.pulse.bandwidth_hz,
        "[4]", "Resolution in range that the bandwidth of the pulse allows.",
    )  # fmt: skip
    yield result(
        "range_width_m", range_width, "[17], [21]",
        "Width of a point in range at -3 dB, with the spectrum of the pulse and the window.",
    )  # fmt: skip
    if survey.element_m is None:
        yield "azimuth_resolution_m", NO_ELEMENT
    else:
        yield result(
            "azimuth_resolution_m", survey.element_m / 2, "[3]",
            "Resolution along the track that the length of the elements allows, at any range.",
        )  # fmt: skip
    width_m = survey.width_m
    straight = survey.is_straight
    if not straight or width_m is None:
        why = NO_RANGE if survey.point_m is None else NO_PINGS if survey.view is None else UNSEEN
        yield "azimuth_width_m aperture_m azimuth_pixel_m", CURVED if not straight else why
    else:
        yield result(
            "azimuth_width_m", width_m, "[21]",
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
    yield result(
        "aperture_m", survey.aperture_m, "[2], [3]",
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
        yield "range_pixel_m azimuth_pixel_m", NO_GRID
        return
    if survey.grid.points_m is not None:
        yield "range_pixel_m azimuth_pixel_m", NO_PLANE
        return
    steps_m = np.stack(survey.grid.vectors_m[1:])[np.array(survey.grid.shape) > 1]
    way_m = survey.point_m - survey.centres_m[len(survey.centres_m) // 2]
    way_m = way_m - (way_m @ survey.along) * survey.along
    towards = way_m / (np.linalg.norm(way_m) or 1.0)
    consequence = "Targets between pixels lose amplitude, or are missed: use more pixels"
    for name, direction, width_m in (
        ("range_pixel_m", towards, range_width),
        ("azimuth_pixel_m", survey.along, azimuth_width),
    ):
        if width_m is None:
            continue  # another result is missing for the same reason
        step_m = float(np.abs(steps_m @ direction).max(initial=0.0))
        yield result(
            name, step_m, "[21]",
            "Distance between pixels in this direction; the limit is the width of a point.",
            most=width_m, consequence=consequence,
        )  # fmt: skip


def approximations(survey: Survey) -> Iterator[Result]:
    """Yield where the far field begins, and the errors of phase centres."""
    wavelength_m = survey.sonar.wavelength_m
    array_m = float(np.ptp(survey.sonar.rx_m, axis=0).max())
    if array_m:
        yield result(
            "array_far_field_m", array_m**2 / wavelength_m, "[34]",
            "Wavefronts over the receivers are plane to an eighth of a wavelength from here on.",
        )  # fmt: skip
    else:
        yield "array_far_field_m", "requires several receivers"
    if survey.view is None or not survey.is_straight or not survey.view.weights.any():
        why = NO_RANGE if survey.point_m is None else NO_PINGS if survey.view is None else UNSEEN
        yield "aperture_far_field_m", why if survey.is_straight else CURVED
    else:
        assert survey.distance_m is not None
        is_near = survey.distance_m < (far_m := 2 * survey.aperture_m**2 / wavelength_m)
        yield result(
            "aperture_far_field_m", far_m, "[34]",
            f"The same for the synthetic aperture; the grid lies in its {'near' * is_near}"
            f"{'far' * (not is_near)} field{', so images must be focused' * is_near}.",
        )  # fmt: skip
    yield from _phase_centres(survey)


def _phase_centres(survey: Survey) -> Iterator[Result]:
    """Yield the errors of replacing transmitter and receiver by their phase centre."""
    names = "phase_centre_shift_m phase_centre_error_m"
    sonar = survey.sonar
    if survey.extents_m is None or survey.beam_sines is None:
        yield names, NO_RANGE
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
    yield result(
        "phase_centre_shift_m", largest_m**2 / (4 * near_m), "[33]",
        f"Antennas {apart} apart lengthen the way to {near} and back by this; a delay corrects it.",
    )  # fmt: skip
    error_m = float(np.abs(lengthwise_m).max()) ** 2 * (most - least) / (4 * near_m)
    yield result(
        "phase_centre_error_m", error_m, "[33]",
        "Part of this that varies over the beam; the limit is an eighth of a wavelength.",
        most=limit_m,
        consequence="Image with transmitters and receivers at their own positions, as clsas does",
    )  # fmt: skip
