"""Results of `clsas.limits` on heights from two receiver banks: baseline and ambiguity."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from clsas.core.grid import Grid
from clsas.measures.limits_common import NO_GRID, Result, result
from clsas.measures.limits_geometry import Survey
from clsas.measures.limits_result import shown
from clsas.sonar.system import Sonar
from clsas.sonar.track import Track, channels

_POINTS = 16  # grid points along either side that represent the grid


def heights(survey: Survey, sonar: Sonar) -> Iterator[Result]:
    """Yield the baseline of the outermost banks, and the heights that shift phases by a cycle.

    The receivers of a bank are represented by their mean, and the track by its pings. A sonar with
    one bank has no such results.
    """
    if sonar.banks == 1:
        return
    low_m, high_m = (sonar.bank(number).rx_m.mean(axis=0) for number in _outermost(sonar))
    yield result(
        "baseline_m", float(np.linalg.norm(high_m - low_m)), "",
        f"Distance between the lowest and the highest of {sonar.banks} receiver banks.",
    )  # fmt: skip
    if survey.track is None or survey.grid is None:
        yield "ambiguity_near_m ambiguity_far_m", NO_GRID
        return
    range_m, ambiguity_m = _ambiguities(sonar, survey.track, survey.grid, low_m, high_m)
    for name, at in (("near", int(range_m.argmin())), ("far", int(range_m.argmax()))):
        if not math.isfinite(ambiguity_m[at]):
            yield f"ambiguity_{name}_m", "requires a baseline across the line of sight"
            continue
        yield result(
            f"ambiguity_{name}_m", float(ambiguity_m[at]), "",
            "Height that shifts the phase between the banks by a cycle, at "
            f"{shown(range_m[at], 'm')}.",
        )  # fmt: skip


def _outermost(sonar: Sonar) -> tuple[int, int]:
    """Return the numbers of the lowest and of the highest bank."""
    heights_m = [float(sonar.bank(number).rx_m[:, 2].mean()) for number in range(sonar.banks)]
    return int(np.argmin(heights_m)), int(np.argmax(heights_m))


def _ambiguities(
    sonar: Sonar, track: Track, grid: Grid, low_m: NDArray[np.float64], high_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return ranges of grid points, metres, and their heights of ambiguity, [points] each.

    The phase between two images is 2 pi/wavelength times the difference of the paths to their
    receivers. Its change with the height of a point is the difference of the vertical components of
    the unit vectors from the receivers. The ping that passes closest sees each point.
    """
    points_m = grid.spread(_POINTS)
    slopes = []
    for receiver_m in (low_m, high_m):
        rx_m = channels(Sonar(sonar.pulse, receiver_m[None]), track).rx_m
        away_m = points_m[:, None] - rx_m
        distance_m = np.linalg.norm(away_m, axis=-1)
        closest = distance_m.argmin(axis=1)[:, None]
        nearest_m = np.take_along_axis(distance_m, closest, axis=1)[:, 0]
        slopes.append(np.take_along_axis(away_m[..., 2], closest, axis=1)[:, 0] / nearest_m)
    with np.errstate(divide="ignore"):
        return nearest_m, sonar.wavelength_m / np.abs(slopes[1] - slopes[0])
