"""What an image can do without: effects whose error lies far below what is asked for.

Modelling an effect costs time for every pixel and channel. Before an image is formed, `simplify`
looks for a simpler model of the same geometry that no pixel can tell from the full one:

- one antenna at rest in place of a transmitter and a receiver, or of a receiver in motion. Each
  channel gets the position whose ranges to the grid are closest, by least squares: its phase
  centre, moved by what is common to all pixels;
- a plane in place of a grid whose relief is next to none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from clsas.core.decibels import power
from clsas.core.geometry import pairwise_range_m
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines, some_channels
from clsas.sonar.beam import BeamWindow, sines

MOTION = "motion during flight"
APART = "transmitter and receiver apart"
RELIEF = "relief of the grid"
EFFECTS = (MOTION, APART, RELIEF)

SHARE = 1 / 20
"""Of the power of the error allowed: what all that is left out may add."""

LEAST_PIXELS = 1 << 18
"""Of an image worth a fit of antennas. With 640 moving receivers the fit takes 5 ms of processor
time and saves 10 % of the exact image; of 65 000 pixels that is less than the fit takes."""

_POINTS = 5  # along either side of a grid, where the antennas of all channels are fitted
_CHECKED_POINTS = 20  # along either side, where some channels are checked, before all are fitted
_CHECKED_CHANNELS = 32  # spread evenly; those furthest apart, and the fastest, are checked besides
_LEAST_STEPS = 2.0  # least range, in steps between points: closer by, ranges bend between them
_BEYOND_BEAM = 0.75  # of a step between points: half the diagonal, so that no pixel is passed over
_RIDGE = 1e-6  # keeps positions still along directions in which no pixel tells them apart
_ITERATIONS = 2  # of least squares: a third gains nothing
_CHANNELS_AT_ONCE = 4096
_ROWS_AT_ONCE = 256  # of a grid
_WEIGHTS = 1024  # at which a beam's slope is evaluated


@dataclass(frozen=True, eq=False)
class Model:
    """Lines, grid and beam as an image is formed of them, and what that leaves out.

    Attributes
    ----------
    lines : RangeLines
        Those given, or the same samples with simpler antennas.
    grid : Grid
        That given, or the plane in its place: of the same shape.
    beam : BeamWindow or None
        That given; with the track's directions where antennas were moved, since these hide it.
    left_out : tuple of str
        `MOTION`, `APART` and `RELIEF`.
    error : float
        Power of the error that this adds, at most, over that of the image.
    """

    lines: RangeLines
    grid: Grid
    beam: BeamWindow | None
    left_out: tuple[str, ...] = ()
    error: float = 0.0


def simplify(
    lines: RangeLines, grid: Grid, beam: BeamWindow | None, allowed_db: float | None
) -> Model:
    """Return the simplest model whose error is a small share of that allowed.

    Parameters
    ----------
    lines, grid, beam
        The full model.
    allowed_db : float or None
        Relative rms error allowed of the image, dB; with None nothing is left out.

    Notes
    -----
    A range that differs by d turns the phase by 2 pi f d, with f the highest frequency that a
    sampled band may hold in cycles per metre of range, wherever its middle lies. Not the mean of
    that counts but its maximum: for every channel at points all over the grid, its corners among
    them, and for some channels at many more points. All of a grid's relief is looked at. Nothing
    is left out of antennas where pixels come as near to them as these points to each other. The
    amplitudes of both effects together stay within `SHARE` of the power of the error allowed.
    """
    full = Model(lines, grid, beam)
    apart = not np.array_equal(lines.tx_m, lines.rx_m)
    flat = grid.is_planar or len(grid.shape) != 2
    if allowed_db is None or (flat and not apart and lines.rx_velocity_m_s is None):
        return full
    highest = lines.carrier_cycles_per_m + 1 / lines.range_step_m
    most = math.sqrt(SHARE * power(allowed_db))
    if not flat and (apart or lines.rx_velocity_m_s is not None):
        most /= 2  # their amplitudes add up
    model, amplitude = full, 0.0
    if grid.size >= LEAST_PIXELS:
        for effects in _wishes(lines):
            if fitted := _fitted(lines, grid, beam, effects, highest, most):
                simpler, amplitude = fitted
                model = Model(simpler, grid, _with_directions(beam, lines), effects)
                break
    if not flat:
        found = 2 * np.pi * highest * _relief_m(lines, grid, most / (2 * np.pi * highest))
        if found <= most and _plane(grid) is not None:
            amplitude += found
            plane = leave_out(lines, grid, beam, (RELIEF,)).grid
            model = replace(model, grid=plane, left_out=(*model.left_out, RELIEF))
    return replace(model, error=amplitude**2) if model.left_out else full


def leave_out(
    lines: RangeLines, grid: Grid, beam: BeamWindow | None, effects: tuple[str, ...]
) -> Model:
    """Return the model without some effects, whatever error that adds."""
    if MOTION in effects or APART in effects:
        points_m = grid.spread(_POINTS)
        along = None if beam is None else beam.directions(lines)
        tx_m, rx_m = np.empty_like(lines.tx_m), np.empty_like(lines.rx_m)
        for first in range(0, lines.channels, _CHANNELS_AT_ONCE):
            block = slice(first, first + _CHANNELS_AT_ONCE)
            of_block = None if along is None else along[block]
            seen = _Seen.of(lines.select(block), beam, of_block, points_m)
            tx_m[block], rx_m[block] = seen.antennas_m(effects)
        beam = _with_directions(beam, lines)
        lines = replace(lines, tx_m=tx_m, rx_m=rx_m, rx_velocity_m_s=None)
    if RELIEF in effects:
        grid = _plane(grid) or grid
    return Model(lines, grid, beam, effects)


def relief_of(grid: Grid) -> NDArray[np.float64]:
    """Return the largest distance of a pixel from the plane in place of a grid, [3], metres."""
    corner, rows, columns = _lattice(grid)
    largest = np.zeros(3)
    for first in range(0, grid.shape[0], _ROWS_AT_ONCE):
        some = slice(first, first + _ROWS_AT_ONCE)
        row = np.arange(grid.shape[0])[some, None]
        for axis, values in _coordinates(grid):
            fitted = corner[axis] + row * rows[axis] + np.arange(grid.shape[1]) * columns[axis]
            largest[axis] = max(largest[axis], float(np.abs(values[some] - fitted).max()))
    return largest


def _wishes(lines: RangeLines) -> list[tuple[str, ...]]:
    """Return what antennas may do without, the most first."""
    moving = (MOTION,) if lines.rx_velocity_m_s is not None else ()
    if np.array_equal(lines.tx_m, lines.rx_m):
        # A receiver that moves away from its transmitter and is put at rest is apart from it.
        return [moving] if moving else []
    return [(*moving, APART), moving] if moving else [(APART,)]


@dataclass(frozen=True, eq=False)
class _Seen:
    """How channels see points: ranges [points, channels] of the full model, and which points.

    `step_m` is how far the points lie apart. With a beam, points count as seen that have a pixel
    around them in it.
    """

    lines: RangeLines
    beam: BeamWindow | None
    along: NDArray[np.float64] | None
    points_m: NDArray[np.float64]
    step_m: float
    range_m: NDArray[np.float64]
    seen: NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        lines: RangeLines,
        beam: BeamWindow | None,
        along: NDArray[np.float64] | None,
        points_m: NDArray[np.float64],
    ) -> _Seen:
        """Return how channels, whose track has some directions if there is a beam, see points."""
        antennas = lines.tx_m, lines.rx_m, lines.rx_velocity_m_s, lines.sound_speed_m_s
        range_m = pairwise_range_m(points_m, *antennas)
        step_m = float(np.ptp(points_m, axis=0).max() / max(math.sqrt(len(points_m)) - 1, 1.0))
        seen = np.ones(range_m.shape, bool)
        if beam is not None and along is not None:
            around = _BEYOND_BEAM * step_m / np.maximum(range_m, 1e-30)
            sine = sines(points_m, lines.phase_centres_m, along).T
            seen = (sine > beam.limits[0] - around) & (sine < beam.limits[1] + around)
        return cls(lines, beam, along, points_m, step_m, range_m, seen)

    def antennas_m(
        self, effects: tuple[str, ...]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return transmitters and receivers at rest that do without some effects, [channels, 3].

        They are one where these are no longer apart; otherwise the transmitter stays.
        """
        lines = self.lines
        if APART in effects or np.array_equal(lines.tx_m, lines.rx_m):
            antenna_m = _closest(self.points_m, self.range_m, self.seen, lines.phase_centres_m)
            return antenna_m, antenna_m
        back_m = 2 * self.range_m - cdist(self.points_m, lines.tx_m)
        return lines.tx_m, _closest(self.points_m, back_m, self.seen, lines.rx_m)

    def errors(self, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]) -> tuple[float, float]:
        """Return by how much ranges, in metres, and sines of aspect angles differ at most."""
        away_m = pairwise_range_m(self.points_m, tx_m, rx_m) - self.range_m
        largest_m = float(np.abs(away_m).max(where=self.seen, initial=0.0))
        if self.beam is None or self.along is None:
            return largest_m, 0.0
        one, other = (
            sines(self.points_m, centres_m, self.along).T
            for centres_m in (self.lines.phase_centres_m, (tx_m + rx_m) / 2)
        )
        return largest_m, float(np.abs(one - other).max(where=self.seen, initial=0.0))


def _fitted(
    lines: RangeLines,
    grid: Grid,
    beam: BeamWindow | None,
    effects: tuple[str, ...],
    highest: float,
    most: float,
) -> tuple[RangeLines, float] | None:
    """Return lines with simpler antennas and the amplitude of their error, None where above `most`.

    Some channels are looked at first: for most geometries that is the end of it.
    """
    along = None if beam is None else beam.directions(lines)
    points_m, dense_m = grid.spread(_POINTS), grid.spread(_CHECKED_POINTS)
    fullness = 1.0
    if beam is not None and along is not None:
        some = some_channels(lines.channels, 4 * _CHECKED_CHANNELS)
        sine = sines(dense_m, lines.phase_centres_m[some], along[some])
        fullness = beam.fullness(sine, _wavelength_m(lines), len(some) / lines.channels)

    def amplitude(away_m: float, sine: float) -> float:
        weights = 0.0 if beam is None else math.sqrt(_shifted(beam, sine, lines)) / fullness
        return 2 * np.pi * highest * away_m + weights

    def seen(some: NDArray[np.int64] | slice, at_m: NDArray[np.float64]) -> _Seen:
        return _Seen.of(lines.select(some), beam, None if along is None else along[some], at_m)

    some = _some(lines)
    dense = seen(some, dense_m)
    antennas_m = seen(some, points_m).antennas_m(effects)
    if dense.range_m.min(where=dense.seen, initial=math.inf) < _LEAST_STEPS * dense.step_m:
        return None
    largest = amplitude(*dense.errors(*antennas_m))
    tx_m, rx_m = np.empty_like(lines.tx_m), np.empty_like(lines.rx_m)
    for first in range(0, lines.channels, _CHANNELS_AT_ONCE):
        if largest > most:
            return None
        block = slice(first, first + _CHANNELS_AT_ONCE)
        coarse = seen(block, points_m)
        tx_m[block], rx_m[block] = coarse.antennas_m(effects)
        largest = max(largest, amplitude(*coarse.errors(tx_m[block], rx_m[block])))
    if largest > most:
        return None
    return replace(lines, tx_m=tx_m, rx_m=rx_m, rx_velocity_m_s=None), largest


def _some(lines: RangeLines) -> NDArray[np.int64]:
    """Return some channels: evenly, the ends of the track, the furthest apart and the fastest."""
    distance_m = np.linalg.norm(lines.rx_m - lines.tx_m, axis=1)
    extreme = [0, lines.channels - 1, int(distance_m.argmax())]
    if lines.rx_velocity_m_s is not None:
        extreme.append(int(np.linalg.norm(lines.rx_velocity_m_s, axis=1).argmax()))
    return np.union1d(some_channels(lines.channels, _CHECKED_CHANNELS), extreme)


def _closest(
    points_m: NDArray[np.float64],
    range_m: NDArray[np.float64],
    seen: NDArray[np.bool_],
    start_m: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the positions whose distances from points are closest to some, [channels, 3].

    By least squares over the points seen [points, channels], from where they start.
    """
    position_m = start_m.T.copy()
    weights = seen.astype(np.float64)
    ridge = _RIDGE * np.maximum(weights.sum(axis=0), 1.0)
    for _ in range(_ITERATIONS):
        way = [point[:, None] - each for point, each in zip(points_m.T, position_m, strict=True)]
        distance_m = np.sqrt(sum(each * each for each in way))
        over = weights / np.maximum(distance_m, 1e-30)
        unit = [each * over for each in way]
        away_m = distance_m - range_m
        normal = np.empty((len(start_m), 3, 3))
        for i, j in combinations_with_replacement(range(3), 2):
            normal[:, i, j] = normal[:, j, i] = (unit[i] * unit[j]).sum(axis=0)
        normal[:, range(3), range(3)] += ridge[:, None]
        wanted = np.stack([(each * away_m).sum(axis=0) for each in unit], axis=-1)
        position_m += np.linalg.solve(normal, wanted[..., None])[..., 0].T
    return np.ascontiguousarray(position_m.T)


def _shifted(beam: BeamWindow, shift: float, lines: RangeLines) -> float:
    """Return the power of the error of a beam's weights whose sines are shifted."""
    low, high = np.clip(beam.limits, -1, 1)
    sine = np.linspace(low, high, _WEIGHTS + 2)[1:-1]
    weights = beam.weights(sine, _wavelength_m(lines))
    smooth = np.mean((np.gradient(weights, sine) * shift) ** 2)
    jumps = (weights[0] ** 2 + weights[-1] ** 2) * abs(shift) / (high - low)
    return float((smooth + jumps) / np.mean(weights**2))


def _wavelength_m(lines: RangeLines) -> float:
    return lines.sound_speed_m_s / lines.carrier_hz if lines.carrier_hz else math.inf


def _with_directions(beam: BeamWindow | None, lines: RangeLines) -> BeamWindow | None:
    """Return a beam with the directions of the track that lines have."""
    return None if beam is None else replace(beam, along=beam.directions(lines))


def _relief_m(lines: RangeLines, grid: Grid, most_m: float) -> float:
    """Return by how much ranges differ at most without a grid's relief; infinite if by much.

    Heights count by how steeply channels look down on them.
    """
    points_m = grid.spread(_CHECKED_POINTS)
    some = _some(lines)
    share = np.ones(3)
    if grid.height_m is not None:
        steepest = 0.0
        for ends_m in (lines.tx_m[some], lines.rx_m[some]):
            down_m = np.abs(points_m[:, None, 2] - ends_m[:, 2])
            steepest = max(
                steepest, float((down_m / np.maximum(cdist(points_m, ends_m), 1e-30)).max())
            )
        share[2] = min(1.1 * steepest + 1e-3, 1.0)  # pixels between the points
    # A part of the pixels tells most grids with relief.
    few = grid.window(*(slice(None, None, max(n // 32, 1)) for n in grid.shape))
    if np.linalg.norm(share * relief_of(few)) > 4 * most_m:
        return math.inf
    return float(np.linalg.norm(share * relief_of(grid)))


def _coordinates(grid: Grid) -> list[tuple[int, NDArray[np.float64]]]:
    """Return the coordinates of pixels that need not lie on a plane, [rows, columns] each."""
    if grid.height_m is not None:
        return [(2, grid.height_m)]
    assert grid.points_m is not None
    points_m = grid.points_m
    return [(axis, points_m[..., axis]) for axis in range(3)]


def _lattice(grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return corner and steps of the plane that fits a grid's coordinates best, [3] each.

    Of a height map they are on top of the plane below it. Over regular rows and columns either
    slope is found by itself.
    """
    corner, steps = np.zeros(3), np.zeros((2, 3))
    for axis, values in _coordinates(grid):
        corner[axis] = values.mean()
        for side, n in enumerate(grid.shape):
            place = np.arange(n) - (n - 1) / 2
            steps[side, axis] = place @ values.mean(axis=1 - side) / max(place @ place, 1.0)
            corner[axis] -= steps[side, axis] * (n - 1) / 2
    return corner, steps[0], steps[1]


def _plane(grid: Grid) -> Grid | None:
    """Return the plane that fits a grid best; None where its pixels would coincide."""
    corner, rows, columns = _lattice(grid)
    if grid.height_m is not None:
        origin_m, row_step_m, column_step_m = grid.vectors_m
        corner, rows, columns = corner + origin_m, rows + row_step_m, columns + column_step_m
    try:
        return Grid(corner, rows, columns, grid.shape)
    except ValueError:  # points that lie in a line, or one on another
        return None
