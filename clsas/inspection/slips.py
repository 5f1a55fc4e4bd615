"""Slips of units and time: which one would explain that a grid lies beyond the range lines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, some_channels

POINTS = 16
"""Grid points sampled along either side."""
_EXPLAINED = 0.5  # least share of the uncovered grid that a slip must explain
_LONGEST = 30.0
"""Length of corrected lines relative to the farthest range of the grid, at most. Longer lines would
cover any grid."""
_ALIKE = 0.05  # slips that differ by less than this share of the grid explain it equally well


@dataclass(frozen=True)
class Slip:
    """A slip of units or time, and the factors that correct it.

    Attributes
    ----------
    words : str
        What seems to be wrong.
    first, step, positions : float
        Factors of first ranges, range step and positions.
    """

    words: str
    first: float = 1.0
    step: float = 1.0
    positions: float = 1.0


_NONE = Slip("")


def _slips(step_m: float, sound_speed_m_s: float) -> list[Slip]:
    """Return the slips that are considered, the most common first."""
    half_speed = sound_speed_m_s / 2
    return [
        Slip("`first_range_m` seems to be a time in seconds, not half the sound speed times it",
             first=half_speed),
        Slip("the time of the first sample seems to be in milliseconds, not in seconds",
             first=1e-3),
        Slip("`first_range_m` seems to be in samples, not in metres", first=step_m),
        Slip("the time of the first sample seems to be in samples, not in seconds",
             first=step_m / half_speed),
        Slip("ranges seem to be in millimetres, not in metres", 1e-3, 1e-3),
        Slip("ranges seem to be in kilometres, not in metres", 1e3, 1e3),
        Slip("ranges seem to be the two-way path, not half of it", 0.5, 0.5),
        Slip("positions seem to be in millimetres, not in metres", positions=1e-3),
        Slip("positions seem to be in kilometres, not in metres", positions=1e3),
    ]  # fmt: skip


def ranges_m(lines: RangeLines, grid: Grid, position_scale: float = 1.0) -> NDArray[np.float64]:
    """Return the ranges of sampled pixels and channels, [pixels, channels]."""
    part = lines.select(some_channels(lines.channels))
    points_m = grid.spread(POINTS).reshape(-1, 3)
    return pairwise_range_m(points_m, position_scale * part.tx_m, position_scale * part.rx_m)


def covered(lines: RangeLines, grid: Grid, slip: Slip = _NONE) -> float:
    """Return the share of a grid that some line reaches once a slip is corrected."""
    part = lines.select(some_channels(lines.channels))
    first_m = slip.first * part.first_range_m
    last_m = first_m + (lines.length - 1) * slip.step * lines.range_step_m
    range_m = ranges_m(lines, grid, slip.positions)
    return float(((range_m >= first_m) & (range_m <= last_m)).any(axis=1).mean())


def likely_slip(lines: RangeLines, grid: Grid, share: float) -> tuple[Slip, float] | None:
    """Return the slip that best explains why lines cover only a share of a grid, or None.

    With it comes the share that the corrected lines cover. Among slips that explain it equally
    well, those that leave the lines shortest come first, since long lines reach any grid; among
    these, the most common.
    """
    most_m = _LONGEST * float(ranges_m(lines, grid).max())
    shares = {
        slip: covered(lines, grid, slip)
        for slip in _slips(lines.range_step_m, lines.sound_speed_m_s)
        if slip.step * lines.range_step_m * lines.length <= most_m
    }
    most = max(shares.values(), default=0.0)
    if most < share + _EXPLAINED * (1 - share):
        return None
    return min(
        (each for each in shares.items() if each[1] >= most - _ALIKE), key=lambda each: each[0].step
    )
