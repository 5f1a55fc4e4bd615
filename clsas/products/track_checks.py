"""Checks of a recording's track and ranges: halts, gaps, turns, spacing, slips of units."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from clsas.core.geometry import pairwise_range_m
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines, some_channels
from clsas.core.pings import STILL, Transmissions
from clsas.products.inspection_result import runs
from clsas.sonar.beam import BeamWindow
from clsas.sonar.sampling import Finding, check_sampling

GAP = 1.75
"""Advance over that of the pings around it, above which pings are missing: one missing is 2."""
_AROUND = 31  # steps whose median is the usual advance about a place
_UNSEEN = 0.01  # share of pixels beyond all lines, above which it is reported
_POINTS = 16  # of the grid sampled along either side
_FARTHEST = (
    1e4  # first range over the length of a line, above which a unit is wrong; satellites: 100
)
_BEYOND_UNITS = 0.5  # of the grid inside the lines, with which a slip of units explains them


def check_track(pings: Transmissions, last_range_m: float) -> list[Finding]:
    """Return halts, gaps and turns of a track."""
    if pings.count < 2:
        return []
    usual_m = pings.usual_step_m
    if not usual_m:
        return [
            Finding(
                "still_pings",
                f"all {pings.count} pings were taken at one place: there is no aperture",
                float(pings.count),
                0.0,
                "check the positions; they may be missing from the recording",
            )
        ]
    found = _check_halts(pings) + _check_gaps(pings) + _check_order(pings)
    if usual_m > last_range_m > 0:
        found.append(
            Finding(
                "advance",
                f"pings are {usual_m:.4g} m apart, more than the last range of "
                f"{last_range_m:.4g} m",
                usual_m,
                last_range_m,
                "check units: positions and ranges in metres",
            )
        )
    return found


def _check_halts(pings: Transmissions) -> list[Finding]:
    still = np.flatnonzero(~pings.advancing())
    if not still.size:
        return []
    return [
        Finding(
            "still_pings",
            f"{still.size} of {pings.count} pings were taken standing still: they advance by "
            f"less than {STILL:g} of the usual {pings.usual_step_m:.4g} m. What they show alike "
            "adds up and hides the scene",
            float(still.size),
            0.0,
            "lines.without_still_pings(), or clsas convert --without-still-pings FILE OUTPUT",
            tuple(still.tolist()),
        )
    ]


def _check_gaps(pings: Transmissions) -> list[Finding]:
    numbers = np.flatnonzero(pings.advancing())
    if len(numbers) < 3:
        return []
    gaps, steps_m, around_m = _gaps(pings.centres_m[numbers])
    if not gaps.size:
        return []
    widest, several = gaps[np.argmax(steps_m[gaps])], "s" * (gaps.size > 1)
    return [
        Finding(
            "gaps",
            f"{gaps.size} gap{several} in the track, after ping{several} {runs(numbers[gaps])}: "
            f"the widest is {steps_m[widest]:.4g} m, where {around_m[widest]:.4g} m are usual",
            float(steps_m[widest]),
            float(GAP * around_m[widest]),
            "targets beside a gap blur and get grating lobes: image the parts one by one, or "
            "look for lost pings in the recorder",
            tuple(numbers[gaps].tolist()),
        )
    ]


def _check_order(pings: Transmissions) -> list[Finding]:
    turns = pings.turns
    if not turns.size:
        return []
    return [
        Finding(
            "order",
            f"the track turns back {turns.size} time{'s' * (turns.size > 1)}, first after ping "
            f"{turns[0]}: pings are out of order, or positions are noisy",
            float(turns.size),
            0.0,
            "sort the pings by time: lines.select(order); image passes to and fro one by one",
            tuple(turns.tolist()),
        )
    ]


def _gaps(
    centres_m: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the pings after which there are gaps, all steps, and the usual step around each."""
    steps_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1)
    around_m = median_filter(steps_m, size=min(_AROUND, len(steps_m)), mode="nearest")
    return np.flatnonzero(steps_m > GAP * around_m), steps_m, around_m


def check_spacing(
    lines: RangeLines,
    grid: Grid | None,
    *,
    beam: BeamWindow | None,
    element_length_m: float | None,
    wavelength_m: float,
) -> list[Finding]:
    """Return a spacing beyond the limits of sampling, on the longest leg between gaps."""
    if grid is None and beam is None and element_length_m is None:
        return []
    pings = Transmissions.of(lines)
    gaps = _gaps(pings.centres_m)[0] if pings.count > 2 else np.zeros(0, np.int64)
    edges = [0, *(gaps + 1).tolist(), pings.count]
    longest = int(np.argmax(np.diff(edges)))
    leg = slice(int(pings.starts[edges[longest]]), int(pings.starts[edges[longest + 1]]))
    return check_sampling(
        lines.select(leg), grid, beam=beam, element_length_m=element_length_m,
        wavelength_m=wavelength_m,
    )  # fmt: skip


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
    if grid is None:
        return []
    share = _covered(lines, grid)
    if share >= 1 - _UNSEEN:
        return []
    range_m = _ranges_m(lines, grid)
    near_m, far_m = float(range_m.min()), float(range_m.max())
    words = (
        f"{100 * (1 - share):.3g} % of the grid lies beyond all lines: it has ranges from "
        f"{near_m:.4g} m to {far_m:.4g} m, lines have {first_m:.4g} m to {last_m:.4g} m"
    )
    remedy = "choose another grid, or check the time of the first sample and the sound speed"
    if not share and (slip := _slip(lines, grid)):
        remedy = f"the grid would lie within the lines if {slip}: check units"
    return [Finding("grid_outside", words, 1 - share, _UNSEEN, remedy)]


def _ranges_m(lines: RangeLines, grid: Grid, position_scale: float = 1.0) -> NDArray[np.float64]:
    """Ranges of sampled pixels, [pixels, channels]."""
    part = lines.select(some_channels(lines.channels))
    points_m = grid.spread(_POINTS).reshape(-1, 3)
    tx_m, rx_m = position_scale * part.tx_m, position_scale * part.rx_m
    return pairwise_range_m(points_m, tx_m, rx_m)


def _covered(
    lines: RangeLines,
    grid: Grid,
    first_scale: float = 1.0,
    step_scale: float = 1.0,
    position_scale: float = 1.0,
) -> float:
    """Share of the grid that any line reaches, with first ranges, steps and positions scaled."""
    part = lines.select(some_channels(lines.channels))
    first_m = first_scale * part.first_range_m
    last_m = first_m + (lines.length - 1) * step_scale * lines.range_step_m
    range_m = _ranges_m(lines, grid, position_scale)
    return float(((range_m >= first_m) & (range_m <= last_m)).any(axis=1).mean())


def _slip(lines: RangeLines, grid: Grid) -> str:
    """Return the slip of time or units that best explains a grid beyond all lines, or ""."""
    step_m, speed = lines.range_step_m, lines.sound_speed_m_s
    slips = {
        "ranges, now as if millimetres were metres, were 1000 times smaller": (1e-3, 1e-3, 1.0),
        "ranges, now as if kilometres were metres, were 1000 times larger": (1e3, 1e3, 1.0),
        "first_range_m, now in samples, were in metres": (step_m, 1.0, 1.0),
        "the time of the first sample, now in samples, were in seconds":
            (2 * step_m / speed, 1.0, 1.0),
        "the time of the first sample, now in milliseconds, were in seconds": (1e-3, 1.0, 1.0),
        "ranges were half the two-way path": (0.5, 0.5, 1.0),
        "positions, now in millimetres, were in metres": (1.0, 1.0, 1e-3),
        "positions, now in kilometres, were in metres": (1.0, 1.0, 1e3),
    }  # fmt: skip
    shares = {name: _covered(lines, grid, *scales) for name, scales in slips.items()}
    best = max(shares, key=shares.__getitem__)
    return best if shares[best] >= _BEYOND_UNITS else ""
