"""Coverage: whether the beam and the range of any line reach a grid, and a warning if not."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, antennas_of, some_channels, steepest
from clsas.engine.data.visibility import BeamTrack, Boxes, sines

# Channels, and pixels along either side of the grid, in the quick test, which finds that nearly
# every grid is covered.
_SAMPLED_CHANNELS = 64
_SAMPLED_PIXELS = 16
_BLOCKS = 8  # along either side of the grid; smaller blocks would find smaller gaps
_TAPS = 8  # samples by which an interpolated line extends beyond its ends

_Span = tuple[float, float]  # nearest and farthest range, metres


class UnreachedWarning(validate.ClsasWarning):
    """Warning that no line contributes to any pixel, so that the image is zero."""


def reaches(
    lines: RangeLines, grid: Grid, beam: BeamWindow | None, along: NDArray[np.float64] | None
) -> bool:
    """Return False only if certainly no pixel lies in the beam and within the range of any line.

    `along` contains the unit directions of the track, [channels, 3]; it is None without a beam.
    """
    if _reached_at_points(lines, grid, beam, along):
        return True
    return _reached_in_boxes(lines, *_boxes(grid), beam, along)


def _reached_at_points(
    lines: RangeLines, grid: Grid, beam: BeamWindow | None, along: NDArray[np.float64] | None
) -> bool:
    """Return True if any sampled channel receives from any sampled pixel: the quick test."""
    some = some_channels(lines.channels, _SAMPLED_CHANNELS)
    points_m = grid.spread(_SAMPLED_PIXELS)
    range_m = _ranges_m(lines, points_m, some)
    inside = (range_m >= lines.first_range_m[some]) & (range_m <= lines.last_range_m[some])
    if beam is not None and along is not None:
        low, high = beam.limits
        sine = sines(points_m, lines.phase_centres_m[some], along[some]).T
        inside &= (sine > low) & (sine < high)
    return bool(inside.any())


def _reached_in_boxes(
    lines: RangeLines,
    centres_m: NDArray[np.float64],
    half_m: NDArray[np.float64],
    beam: BeamWindow | None,
    along: NDArray[np.float64] | None,
) -> bool:
    """Return False only if certainly no channel receives from any box: the full test.

    `centres_m` are the centres of the boxes, and `half_m` half their sides along x, y and z,
    [boxes, 3].
    """
    beyond_m = _TAPS * lines.range_step_m
    track = None
    if beam is not None and along is not None:
        track = BeamTrack(beam.limits, lines.phase_centres_m, along)
    for centre_m, sides_m in zip(centres_m, half_m, strict=True):
        range_m = pairwise_range_m(
            centre_m[None], lines.tx_m, lines.rx_m, lines.rx_velocity_m_s, lines.sound_speed_m_s
        )[0]
        radius_m = np.linalg.norm(sides_m) * steepest(lines) + beyond_m
        reached = range_m + radius_m >= lines.first_range_m
        reached &= range_m - radius_m <= lines.last_range_m
        if track is not None and reached.any():
            reached &= track.touching(Boxes.equal(centre_m[None], np.diag(sides_m)))[0]
        if reached.any():
            return True
    return False


def _boxes(grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return centres and half sides, [boxes, 3], of boxes that contain all pixels of a grid."""
    parts = [
        [slice(first, last) for first, last in itertools.pairwise(_cuts(count))]
        for count in grid.shape[:2]
    ]
    ends_m = []
    for part in itertools.product(*parts):
        block = grid.window(*part)
        if block.is_planar:
            block = block.window(*(slice(None, None, max(n - 1, 1)) for n in block.shape))
        positions_m = block.positions_m().reshape(-1, 3)
        ends_m.append((positions_m.min(axis=0), positions_m.max(axis=0)))
    low_m, high_m = np.array(ends_m).swapaxes(0, 1)
    return (low_m + high_m) / 2, (high_m - low_m) / 2


def _cuts(count: int) -> NDArray[np.int64]:
    """Return the edges that divide a side of a grid into blocks."""
    return np.unique(np.linspace(0, count, min(count, _BLOCKS) + 1).astype(np.int64))


def warn_unreached(
    lines: RangeLines,
    grid: Grid,
    beam: BeamWindow | None,
    along: NDArray[np.float64] | None,
    lines_m: _Span | None = None,
) -> None:
    """Warn that no line contributes to a grid; name the distances and the likely cause.

    Lines that are all zero cause no warning. `lines_m` is the nearest and the farthest range of
    lines that are geometry without samples.
    """
    if lines_m is None:
        if not lines.samples.any():
            return
        lines_m = float(lines.first_range_m.min()), float(lines.last_range_m.max())
    some = some_channels(lines.channels, _SAMPLED_CHANNELS)
    points_m = grid.spread(_SAMPLED_PIXELS)
    range_m = _ranges_m(lines, points_m, some)
    where = (
        f"the lines span {lines_m[0]:.6g} to {lines_m[1]:.6g} m, the grid lies at "
        f"{range_m.min():.6g} to {range_m.max():.6g} m"
    )
    if beam is not None and along is not None:
        sine = sines(points_m, lines.phase_centres_m[some], along[some])
        low, high = np.degrees(np.arcsin(np.clip([sine.min(), sine.max()], -1, 1)))
        first, last = np.degrees(beam.limits_rad)
        where = (
            f"the beam spans {first:.4g} to {last:.4g} degrees, the grid lies at {low:.4g} to "
            f"{high:.4g} degrees; {where}"
        )
    within = "any line's range" if beam is None else "the beam and the range of any line"
    validate.warn(
        f"no pixel of the grid lies within {within}, so the image is zero: {where}. "
        f"{_likely_cause(lines, points_m, some, lines_m)}",
        UnreachedWarning,
    )


def _ranges_m(
    lines: RangeLines, points_m: NDArray[np.float64], some: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the ranges of points from some channels, [points, channels]."""
    return pairwise_range_m(points_m, *antennas_of(lines, some))


def _likely_cause(
    lines: RangeLines, points_m: NDArray[np.float64], some: NDArray[np.int64], lines_m: _Span
) -> str:
    """Return the probable mistake, found by assuming that the grid is in other units."""

    def fits(factor: float) -> bool:
        range_m = _ranges_m(lines, factor * points_m, some)
        return bool(((range_m >= lines_m[0]) & (range_m <= lines_m[1])).any())

    if fits(1.0):
        return "Check the width and squint of the beam, and the grid's position along the track"
    for factor, unit in ((1e3, "km"), (1e-3, "mm")):
        if fits(factor):
            return f"The grid would be reached if it were in {unit}: lengths must be given in m"
    return "Check the grid, the positions of the antennas and first_range_m, all in m"
