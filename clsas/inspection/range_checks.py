"""Checks of a recording's ranges against a grid: parts that no line reaches, slips of units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.core.geometry import pairwise_range_m
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines, some_channels
from clsas.sonar.sampling import Finding

_UNSEEN = 0.01  # share of pixels beyond all lines, above which it is reported
_TOO_EARLY = 0.25
"""Share of the power at ranges that no place has, above which it is reported. A first range wrong
by a quarter of the line brings more. In a full matrix capture with surface waves, which arrive
along the array before any echo, it is 0.12."""
_POINTS = 16  # of the grid sampled along either side
_FARTHEST = 1e4
"""First range over the length of a line, above which a unit is wrong; satellites have 100."""
_SLIPPED = 0.25  # share of the grid beyond the lines, from which a slip is looked for
_EXPLAINED = 0.5  # of what lies beyond the lines, at least, by a slip
_LONGEST = 30.0  # lines over the farthest range of a grid; longer ones reach any grid
_ALIKE = 0.05  # share of the grid by which slips may differ and explain it equally well


def check_ranges(lines: RangeLines, grid: Grid | None) -> list[Finding]:
    """Return ranges that cannot be, or do not meet the grid."""
    extent_m = max(lines.length - 1, 1) * lines.range_step_m
    first_m, last_m = float(lines.first_range_m.min()), float(lines.last_range_m.max())
    if last_m <= 0 or np.abs(lines.first_range_m).min() > _FARTHEST * extent_m:
        return [
            Finding(
                "range_offset",
                f"lines begin at {first_m:.6g} m and end at {last_m:.6g} m, and are "
                f"{extent_m:.4g} m long",
                first_m,
                _FARTHEST * extent_m if last_m > 0 else 0.0,
                "check the time of the first sample: in seconds, not in samples; "
                "first_range_m is half the sound speed times it",
            )
        ]
    early = _check_early(lines)
    return early if grid is None else early + _check_grid(lines, grid)


def _check_early(lines: RangeLines) -> list[Finding]:
    """Return echoes at ranges that no place has: shorter than between transmitter and receiver."""
    part = lines.select(some_channels(lines.channels))
    least_m = np.linalg.norm(part.tx_m - part.rx_m, axis=1) / 2
    count = np.ceil((least_m - part.first_range_m) / part.range_step_m)
    power = np.abs(part.samples / (np.abs(part.samples).max() or np.float32(1))) ** 2
    early = np.arange(part.length) < count[:, None]
    share = float(power[early].sum(dtype=np.float64) / (power.sum(dtype=np.float64) or 1.0))
    if share <= _TOO_EARLY:
        return []
    return [
        Finding(
            "range_offset",
            f"{100 * share:.3g} % of the lines' power lies at ranges that no place has, of less "
            f"than half the distance from transmitter to receiver, up to {least_m.max():.4g} m: "
            f"lines begin at {lines.first_range_m.min():.4g} m",
            share,
            _TOO_EARLY,
            "check the time of the first sample, and units of positions and ranges; periodic lines "
            "of phase histories may have echoes from beyond their far end there",
        )
    ]


def _check_grid(lines: RangeLines, grid: Grid) -> list[Finding]:
    """Return parts of a grid that no line reaches."""
    first_m, last_m = float(lines.first_range_m.min()), float(lines.last_range_m.max())
    share = _NO_SLIP.covered(lines, grid)
    if share >= 1 - _UNSEEN:
        return []
    range_m = _ranges_m(lines, grid)
    near_m, far_m = float(range_m.min()), float(range_m.max())
    words = (
        f"{100 * (1 - share):.3g} % of the grid lies beyond all lines: it has ranges from "
        f"{near_m:.4g} m to {far_m:.4g} m, lines have {first_m:.4g} m to {last_m:.4g} m"
    )
    remedy = "choose another grid, or check the time of the first sample and the sound speed"
    low_m, high_m = grid.bounds_m
    if near_m <= float(np.linalg.norm(high_m - low_m)) / _POINTS:
        remedy = "choose another grid: the track leads through this one"
    elif 1 - share > _SLIPPED and (slip := _slip(lines, grid, share)):
        remedy = f"the grid would lie within the lines if {slip}: check units"
    return [Finding("grid_outside", words, 1 - share, _UNSEEN, remedy)]


def _ranges_m(lines: RangeLines, grid: Grid, position_scale: float = 1.0) -> NDArray[np.float64]:
    """Return the ranges of sampled pixels, [pixels, channels]."""
    part = lines.select(some_channels(lines.channels))
    points_m = grid.spread(_POINTS).reshape(-1, 3)
    return pairwise_range_m(points_m, position_scale * part.tx_m, position_scale * part.rx_m)


@dataclass(frozen=True)
class _Slip:
    """A slip of time or units, and the factors that undo it."""

    words: str
    first: float = 1.0
    step: float = 1.0
    positions: float = 1.0

    def covered(self, lines: RangeLines, grid: Grid) -> float:
        """Return the share of the grid that any line reaches without the slip."""
        part = lines.select(some_channels(lines.channels))
        first_m = self.first * part.first_range_m
        last_m = first_m + (lines.length - 1) * self.step * lines.range_step_m
        range_m = _ranges_m(lines, grid, self.positions)
        return float(((range_m >= first_m) & (range_m <= last_m)).any(axis=1).mean())


_NO_SLIP = _Slip("")


def _slips(step_m: float, sound_speed_m_s: float) -> list[_Slip]:
    """Return slips, the commonest first."""
    half_speed = sound_speed_m_s / 2
    return [
        _Slip("first_range_m, now a time in seconds, were half the sound speed times it",
              first=half_speed),
        _Slip("the time of the first sample, now in milliseconds, were in seconds", first=1e-3),
        _Slip("first_range_m, now in samples, were in metres", first=step_m),
        _Slip("the time of the first sample, now in samples, were in seconds",
              first=step_m / half_speed),
        _Slip("ranges, now as if millimetres were metres, were 1000 times smaller", 1e-3, 1e-3),
        _Slip("ranges, now as if kilometres were metres, were 1000 times larger", 1e3, 1e3),
        _Slip("ranges were half the two-way path", 0.5, 0.5),
        _Slip("positions, now in millimetres, were in metres", positions=1e-3),
        _Slip("positions, now in kilometres, were in metres", positions=1e3),
    ]  # fmt: skip


def _slip(lines: RangeLines, grid: Grid, share: float) -> str:
    """Return the slip that best explains what lies beyond the lines, or "".

    Of those that explain it equally well it is one that leaves the lines shorter, then the
    commonest: long lines reach any grid.
    """
    most_m = _LONGEST * float(_ranges_m(lines, grid).max())
    slips = [
        slip
        for slip in _slips(lines.range_step_m, lines.sound_speed_m_s)
        if slip.step * lines.range_step_m * lines.length <= most_m
    ]
    shares = {slip: slip.covered(lines, grid) for slip in slips}
    most = max(shares.values(), default=0.0)
    if most < share + _EXPLAINED * (1 - share):
        return ""
    return min((slip for slip in slips if shares[slip] >= most - _ALIKE), key=_step_of).words


def _step_of(slip: _Slip) -> float:
    return slip.step
