"""Results of `clsas.limits` on heights from two receiver banks: baseline and ambiguity."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.grid import Grid
from clsas.engine.data.system import Sonar
from clsas.engine.data.track import Track, channels
from clsas.measures.elevation import sight_along
from clsas.measures.limits_common import NO_GRID, Result, result
from clsas.measures.limits_geometry import Survey
from clsas.measures.limits_result import shown

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

    The ping that passes closest sees each point.
    """
    points_m = grid.spread(_POINTS)
    rx_m = np.stack([low_m, high_m])
    tx_m, rx_m, _ = channels(Sonar(sonar.pulse, rx_m, tx_m=sonar.tx_m), track)
    tx_m, rx_m = tx_m[::2], rx_m.reshape(-1, 2, 3)
    range_m = np.linalg.norm(points_m[:, None] - tx_m, axis=-1)
    closest = range_m.argmin(axis=1)
    turns = phase_per_height(
        points_m, tx_m[closest], rx_m[closest, 0], rx_m[closest, 1], sonar.wavelength_m
    )
    with np.errstate(divide="ignore"):
        return range_m.min(axis=1), 2 * np.pi / np.abs(turns)


def phase_per_height(
    points_m: NDArray[np.float64],
    tx_m: NDArray[np.float64],
    low_m: NDArray[np.float64],
    high_m: NDArray[np.float64],
    wavelength_m: float,
) -> NDArray[np.float64]:
    """Return how fast the phase between two receivers changes with height, rad/m, [points].

    The track is taken to pass at right angles to the vertical plane through the transmitter and
    the point.

    Parameters
    ----------
    points_m, tx_m, low_m, high_m : float64 [points, 3]
        Points, and the transmitter and the receivers that see each of them.
    wavelength_m : float
    """
    ways_m = [points_m - each_m for each_m in (tx_m, low_m, high_m)]
    w, u, v = (way_m / np.linalg.norm(way_m, axis=1, keepdims=True) for way_m in ways_m)
    along = np.cross(ways_m[0], [0.0, 0.0, 1.0])
    return sight_along(along, (2 * w + u + v) / 4, (v - u) / 2, 4 * np.pi / wavelength_m).rad_m
