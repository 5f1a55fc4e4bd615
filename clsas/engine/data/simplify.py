"""Simplification of a geometry: effects far below the requested accuracy are left out.

Modelling an effect costs time for every pixel and channel. Before an image is formed, `simplify`
makes these replacements if the error permits:

- A transmitter and a receiver, or a moving receiver, become one antenna at rest. Its position is a
  least-squares fit of the ranges to the grid, close to the phase centre.
- A grid with negligible relief becomes a plane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import power
from clsas.engine.data.geometry import SAME_PLACE_M, pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, some_channels, wavelength_m
from clsas.engine.data.visibility import is_within, sines

MOTION = "motion during flight"
APART = "transmitter and receiver apart"
RELIEF = "relief of the grid"
EFFECTS = (MOTION, APART, RELIEF)

SHARE = 1 / 20
"""Share of the allowed error power that all omitted effects together may add."""

LEAST_PIXELS = 1 << 18
"""Number of pixels of the smallest image for which antennas are fitted. With 640 moving receivers
the fit takes 5 ms of processor time and saves 10 % of the time of an exact image. For 65 000 pixels
it saves less time than it takes."""

_POINTS = 5  # sample points along either side of the grid, to which all antennas are fitted
_CHECKED_POINTS = 20  # sample points along either side, at which some channels are checked first
# Evenly spread channels that are checked first, together with the ends of the track, the widest
# separation and the fastest receiver.
_CHECKED_CHANNELS = 32
# Least range over the spacing of sample points. At closer range, ranges bend between the points.
_LEAST_STEPS = 2.0
# Distance from the beam, in spacings of sample points, up to which a sample point is checked. It is
# half the diagonal between sample points, so that no pixel in the beam is missed.
_BEYOND_BEAM = 0.75
_RIDGE = 1e-6  # keeps antennas in place along directions that the ranges do not determine
_ITERATIONS = 2  # of the least-squares fit; a third one changed nothing
_CHANNELS_AT_ONCE = 4096  # bounds memory
_ROWS_AT_ONCE = 256  # of a grid; bounds memory
_WEIGHTS = 1024  # sines at which the slope of beam weights is evaluated


@dataclass(frozen=True, eq=False)
class Model:
    """Lines, grid and beam from which an image is formed, and the effects that they leave out.

    Attributes
    ----------
    lines : RangeLines
        The given lines, with simpler antennas where antennas were fitted.
    grid : Grid
        The given grid, or a plane of the same shape.
    beam : BeamWindow or None
        The given beam. If antennas were fitted, it has the directions of the original track.
    left_out : tuple of str
        Omitted effects: some of `MOTION`, `APART` and `RELIEF`.
    error : float
        Upper bound of the relative error power that the omissions add.
    """

    lines: RangeLines
    grid: Grid
    beam: BeamWindow | None
    left_out: tuple[str, ...] = ()
    error: float = 0.0


def simplify(
    lines: RangeLines,
    grid: Grid,
    beam: BeamWindow | None,
    allowed_db: float | None,
    *,
    keeps_points: bool = False,
) -> Model:
    """Return the simplest model whose error is a small share of the allowed error.

    Parameters
    ----------
    lines, grid, beam
        The full model.
    allowed_db : float or None
        Allowed relative rms error of the image, dB. With None nothing is left out.
    keeps_points : bool
        Whether the relief stays, however small, so that points remain points.

    Notes
    -----
    A range error d changes the phase by 2 pi f d, where f is the highest frequency in the sampled
    band in cycles per metre of range. The bound uses the largest range error of every channel at
    sample points all over the grid, corners included, and of some channels at many more points. The
    relief is checked at all pixels. Antennas are not simplified if pixels lie within two spacings
    of the sample points from them. The error amplitudes of all effects are added. The power of
    their sum stays within `SHARE` of the allowed error power.
    """
    full = Model(lines, grid, beam)
    flat = grid.is_planar or len(grid.shape) != 2
    if allowed_db is None or (flat and not lines.paths_differ):
        return full
    highest = lines.highest_cycles_per_m
    most = math.sqrt(SHARE * power(allowed_db))
    if not flat and lines.paths_differ:
        most /= 2  # because the amplitudes of antennas and relief add up
    model, amplitude = full, 0.0
    if grid.size >= LEAST_PIXELS:
        for effects in _removable(lines):
            if fitted := _fitted(lines, grid, beam, effects, highest, most):
                simpler, amplitude = fitted
                model = Model(simpler, grid, _with_directions(beam, lines), effects)
                break
    if not flat and not keeps_points:
        found = 2 * np.pi * highest * _relief_m(lines, grid, most / (2 * np.pi * highest))
        if found <= most and _plane(grid) is not None:
            amplitude += found
            plane = leave_out(lines, grid, beam, (RELIEF,)).grid
            model = replace(model, grid=plane, left_out=(*model.left_out, RELIEF))
    return replace(model, error=amplitude**2) if model.left_out else full


def leave_out(
    lines: RangeLines, grid: Grid, beam: BeamWindow | None, effects: tuple[str, ...]
) -> Model:
    """Return the model without some effects, whatever the error."""
    if MOTION in effects or APART in effects:
        points_m = grid.spread(_POINTS)
        along = None if beam is None else beam.directions(lines)
        tx_m, rx_m = np.empty_like(lines.tx_m), np.empty_like(lines.rx_m)
        for first in range(0, lines.channels, _CHANNELS_AT_ONCE):
            block = slice(first, first + _CHANNELS_AT_ONCE)
            of_block = None if along is None else along[block]
            geometry = _SampledRanges.of(lines.select(block), beam, of_block, points_m)
            tx_m[block], rx_m[block] = geometry.antennas_m(effects)
        beam = _with_directions(beam, lines)
        lines = replace(lines, tx_m=tx_m, rx_m=rx_m, rx_velocity_m_s=None)
    if RELIEF in effects:
        grid = _plane(grid) or grid
    return Model(lines, grid, beam, effects)


def relief_of(grid: Grid) -> NDArray[np.float64]:
    """Return the largest deviation of pixels from the plane fitted to a grid, [3], metres."""
    corner, rows, columns = _lattice(grid)
    largest = np.zeros(3)
    for first in range(0, grid.shape[0], _ROWS_AT_ONCE):
        some = slice(first, first + _ROWS_AT_ONCE)
        row = np.arange(grid.shape[0])[some, None]
        for axis, values in _coordinates(grid):
            fitted = corner[axis] + row * rows[axis] + np.arange(grid.shape[1]) * columns[axis]
            largest[axis] = max(largest[axis], float(np.abs(values[some] - fitted).max()))
    return largest


def _removable(lines: RangeLines) -> list[tuple[str, ...]]:
    """Return the sets of antenna effects that may be left out, the simplest model first."""
    moving = (MOTION,) if lines.rx_velocity_m_s is not None else ()
    if lines.is_monostatic:
        # The position at rest fitted to a moving receiver differs from that of its transmitter.
        return [moving] if moving else []
    return [(*moving, APART), moving] if moving else [(APART,)]


@dataclass(frozen=True, eq=False)
class _SampledRanges:
    """Ranges of some channels to sample points of a grid in the full model, [points, channels].

    `step_m` is the spacing of the points. `visible` is True for points with a pixel around them
    that may lie in the beam.
    """

    lines: RangeLines
    beam: BeamWindow | None
    along: NDArray[np.float64] | None
    points_m: NDArray[np.float64]
    step_m: float
    range_m: NDArray[np.float64]
    visible: NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        lines: RangeLines,
        beam: BeamWindow | None,
        along: NDArray[np.float64] | None,
        points_m: NDArray[np.float64],
    ) -> _SampledRanges:
        """Return the ranges; `along` are the unit directions of the track, None without a beam."""
        antennas = lines.tx_m, lines.rx_m, lines.rx_velocity_m_s, lines.sound_speed_m_s
        range_m = pairwise_range_m(points_m, *antennas)
        step_m = float(np.ptp(points_m, axis=0).max() / max(math.sqrt(len(points_m)) - 1, 1.0))
        visible = np.ones(range_m.shape, bool)
        if beam is not None and along is not None:
            around = _BEYOND_BEAM * step_m / np.maximum(range_m, SAME_PLACE_M)
            sine = sines(points_m, lines.phase_centres_m, along).T
            visible = is_within(sine, beam.limits, around)
        return cls(lines, beam, along, points_m, step_m, range_m, visible)

    def antennas_m(
        self, effects: tuple[str, ...]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return transmitters and receivers at rest, fitted without some effects, [channels, 3].

        If `effects` include `APART`, both are one antenna. Otherwise the transmitter stays.
        """
        lines = self.lines
        if APART in effects or lines.is_monostatic:
            antenna_m = _fit_positions(
                self.points_m, self.range_m, self.visible, lines.phase_centres_m
            )
            return antenna_m, antenna_m
        back_m = 2 * self.range_m - cdist(self.points_m, lines.tx_m)
        return lines.tx_m, _fit_positions(self.points_m, back_m, self.visible, lines.rx_m)

    def errors(self, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]) -> tuple[float, float]:
        """Return the largest errors of ranges, metres, and of aspect sines with other antennas."""
        error_m = pairwise_range_m(self.points_m, tx_m, rx_m) - self.range_m
        largest_m = float(np.abs(error_m).max(where=self.visible, initial=0.0))
        if self.beam is None or self.along is None:
            return largest_m, 0.0
        one, other = (
            sines(self.points_m, centres_m, self.along).T
            for centres_m in (self.lines.phase_centres_m, (tx_m + rx_m) / 2)
        )
        return largest_m, float(np.abs(one - other).max(where=self.visible, initial=0.0))


def _fitted(
    lines: RangeLines,
    grid: Grid,
    beam: BeamWindow | None,
    effects: tuple[str, ...],
    highest: float,
    most: float,
) -> tuple[RangeLines, float] | None:
    """Return lines with simpler antennas and their error amplitude; None if it exceeds `most`.

    Some channels are checked first, which rules out most geometries quickly.
    """
    along = None if beam is None else beam.directions(lines)
    points_m, dense_m = grid.spread(_POINTS), grid.spread(_CHECKED_POINTS)
    fullness = 1.0
    if beam is not None and along is not None:
        some = some_channels(lines.channels, 4 * _CHECKED_CHANNELS)
        sine = sines(dense_m, lines.phase_centres_m[some], along[some])
        fullness = beam.fullness(sine, wavelength_m(lines), len(some) / lines.channels)

    def amplitude(range_m: float, sine: float) -> float:
        weights = 0.0 if beam is None else math.sqrt(shift_error(beam, sine, lines)) / fullness
        return 2 * np.pi * highest * range_m + weights

    def sampled(some: NDArray[np.int64] | slice, at_m: NDArray[np.float64]) -> _SampledRanges:
        of_some = None if along is None else along[some]
        return _SampledRanges.of(lines.select(some), beam, of_some, at_m)

    some = _checked_channels(lines)
    dense = sampled(some, dense_m)
    antennas_m = sampled(some, points_m).antennas_m(effects)
    if dense.range_m.min(where=dense.visible, initial=math.inf) < _LEAST_STEPS * dense.step_m:
        return None
    largest = amplitude(*dense.errors(*antennas_m))
    tx_m, rx_m = np.empty_like(lines.tx_m), np.empty_like(lines.rx_m)
    for first in range(0, lines.channels, _CHANNELS_AT_ONCE):
        if largest > most:
            return None
        block = slice(first, first + _CHANNELS_AT_ONCE)
        coarse = sampled(block, points_m)
        tx_m[block], rx_m[block] = coarse.antennas_m(effects)
        largest = max(largest, amplitude(*coarse.errors(tx_m[block], rx_m[block])))
    if largest > most:
        return None
    return replace(lines, tx_m=tx_m, rx_m=rx_m, rx_velocity_m_s=None), largest


def _checked_channels(lines: RangeLines) -> NDArray[np.int64]:
    """Return channels to check: evenly spread, the ends, the widest separation, the fastest."""
    distance_m = np.linalg.norm(lines.rx_m - lines.tx_m, axis=1)
    extreme = [0, lines.channels - 1, int(distance_m.argmax())]
    if lines.rx_velocity_m_s is not None:
        extreme.append(int(np.linalg.norm(lines.rx_velocity_m_s, axis=1).argmax()))
    return np.union1d(some_channels(lines.channels, _CHECKED_CHANNELS), extreme)


def _fit_positions(
    points_m: NDArray[np.float64],
    range_m: NDArray[np.float64],
    visible: NDArray[np.bool_],
    start_m: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return positions whose distances from points fit ranges by least squares, [channels, 3].

    Gauss-Newton iterations start from `start_m` and use the visible points, [points, channels].
    """
    position_m = start_m.T.copy()
    weights = visible.astype(np.float64)
    ridge = _RIDGE * np.maximum(weights.sum(axis=0), 1.0)
    for _ in range(_ITERATIONS):
        offset = [point[:, None] - each for point, each in zip(points_m.T, position_m, strict=True)]
        distance_m = np.sqrt(sum(each * each for each in offset))
        over = weights / np.maximum(distance_m, SAME_PLACE_M)
        unit = [each * over for each in offset]
        residual_m = distance_m - range_m
        normal = np.empty((len(start_m), 3, 3))
        for i, j in combinations_with_replacement(range(3), 2):
            normal[:, i, j] = normal[:, j, i] = (unit[i] * unit[j]).sum(axis=0)
        normal[:, range(3), range(3)] += ridge[:, None]
        right = np.stack([(each * residual_m).sum(axis=0) for each in unit], axis=-1)
        position_m += np.linalg.solve(normal, right[..., None])[..., 0].T
    return np.ascontiguousarray(position_m.T)


def shift_error(beam: BeamWindow, shift: float, lines: RangeLines) -> float:
    """Return the relative error power of beam weights whose sines are shifted."""
    low, high = np.clip(beam.limits, -1, 1)
    sine = np.linspace(low, high, _WEIGHTS + 2)[1:-1]
    weights = beam.weights(sine, wavelength_m(lines))
    smooth = np.mean((np.gradient(weights, sine) * shift) ** 2)
    jumps = (weights[0] ** 2 + weights[-1] ** 2) * abs(shift) / (high - low)
    return float((smooth + jumps) / np.mean(weights**2))


def _with_directions(beam: BeamWindow | None, lines: RangeLines) -> BeamWindow | None:
    """Return a beam with the track directions of the lines."""
    return None if beam is None else replace(beam, along=beam.directions(lines))


def _relief_m(lines: RangeLines, grid: Grid, most_m: float) -> float:
    """Return the largest range error without relief; infinity if it is far above `most_m`.

    Heights change ranges by the sine of the depression angle.
    """
    points_m = grid.spread(_CHECKED_POINTS)
    some = _checked_channels(lines)
    share = np.ones(3)
    if grid.height_m is not None:
        steepest = 0.0
        for ends_m in (lines.tx_m[some], lines.rx_m[some]):
            down_m = np.abs(points_m[:, None, 2] - ends_m[:, 2])
            steepest = max(
                steepest, float((down_m / np.maximum(cdist(points_m, ends_m), SAME_PLACE_M)).max())
            )
        share[2] = min(1.1 * steepest + 1e-3, 1.0)  # with a margin for pixels between the points
    # A few pixels are enough to rule out most grids with relief.
    few = grid.window(*(slice(None, None, max(n // 32, 1)) for n in grid.shape))
    if np.linalg.norm(share * relief_of(few)) > 4 * most_m:
        return math.inf
    return float(np.linalg.norm(share * relief_of(grid)))


def _coordinates(grid: Grid) -> list[tuple[int, NDArray[np.float64]]]:
    """Return axes and coordinates of pixels that may lie off a plane, [rows, columns] each."""
    if grid.height_m is not None:
        return [(2, grid.height_m)]
    assert grid.points_m is not None
    points_m = grid.points_m
    return [(axis, points_m[..., axis]) for axis in range(3)]


def _lattice(grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return corner and steps of the plane fitted to a grid by least squares, [3] each.

    For a height map they add to the vectors of the plane below it. Because rows and columns are
    regular, the two slopes are independent of each other.
    """
    corner, steps = np.zeros(3), np.zeros((2, 3))
    for axis, values in _coordinates(grid):
        corner[axis] = values.mean()
        for side, n in enumerate(grid.shape):
            centred = np.arange(n) - (n - 1) / 2
            steps[side, axis] = centred @ values.mean(axis=1 - side) / max(centred @ centred, 1.0)
            corner[axis] -= steps[side, axis] * (n - 1) / 2
    return corner, steps[0], steps[1]


def _plane(grid: Grid) -> Grid | None:
    """Return the plane fitted to a grid, or None if its pixels would coincide."""
    corner, rows, columns = _lattice(grid)
    if grid.height_m is not None:
        origin_m, row_step_m, column_step_m = grid.vectors_m
        corner, rows, columns = corner + origin_m, rows + row_step_m, columns + column_step_m
    try:
        return Grid(corner, rows, columns, grid.shape)
    except ValueError:  # points on one line, or at one position
        return None
