"""How to form an image at a tolerance: how to divide it, and which filters to use."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from clsas import interpolation, validate
from clsas.grid import Grid
from clsas.interpolation import Interpolator, Resampling, Spectrum
from clsas.lines import RangeLines

BEST_TOLERANCE_DB = -60.0
"""The tightest tolerance that may be asked for."""

_FACTORS = (2, 4, 8)
_MOST_STAGES = 4
_LEAF_SIDES = (16, 32, 64)
_MOST_ROOT_SIDE = 1024

# Nanoseconds on a 2-core AVX-512 CPU with PoCL: per aligned sample and tap, per combined sample and
# tap, per pixel and virtual channel, per (subimage, channel) on the host.
_ALIGN_NS, _COMBINE_NS, _BACKPROJECT_NS, _HOST_NS = 0.16, 0.11, 0.6, 80.0


@dataclass(frozen=True, eq=False)
class Plan:
    """A factorized image, decided before the device starts.

    A root subimage is formed from the lines themselves; each stage divides the subimages of the one
    before and combines their channels into fewer, virtual ones; the last stage's are backprojected.

    Attributes
    ----------
    tolerance_db : float
        Relative rms error asked for.
    sides : tuple of int
        Pixels along a subimage's side, stage by stage.
    nodes : tuple of int
        Expected virtual channels of a subimage, stage by stage.
    align, aperture, final : Interpolator
        Filters in range, of the aperture (its `upsampling` is the density of virtual channels over
        the least), and in range for the last stage.
    resampling : Resampling
        How the lines are upsampled first.
    seconds : float
        Expected time, on a 2-core AVX-512 CPU.
    """

    tolerance_db: float
    sides: tuple[int, ...]
    nodes: tuple[int, ...]
    align: Interpolator
    aperture: Interpolator
    final: Interpolator
    resampling: Resampling
    highest_cycles_per_m: float
    seconds: float

    @property
    def predicted_error_db(self) -> float:
        """Expected relative rms error: every interpolation's, added in power."""
        stages = len(self.sides)
        power = stages * (_power(self.align) + _power(self.aperture)) + _power(self.final)
        return 10 * math.log10(power)


def plan(lines: RangeLines, grid: Grid, *, tolerance_db: float) -> Plan:
    """Choose the fastest way to an image of a given error.

    Parameters
    ----------
    lines : RangeLines
        What to image.
    grid : Grid
        A plane.
    tolerance_db : float
        Wanted relative rms error against the exact image, dB, from -60 to -10.

    Raises
    ------
    TypeError, ValueError
        If an argument is not what is allowed.
    """
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    if lines.rx_velocity_m_s is not None:
        raise ValueError("lines must have no rx_velocity_m_s; clsas.backproject images them")
    if not grid.is_planar:
        raise ValueError("grid must be a plane; clsas.backproject images height maps and points")
    tolerance_db = validate.number(
        "tolerance_db", tolerance_db, "dB", least=BEST_TOLERANCE_DB, most=-10.0
    )
    spectrum = interpolation.measure_spectrum(lines)
    occupied = spectrum.frequency[np.cumsum(spectrum.power) < 1 - 1e-6]
    highest = (
        abs(lines.carrier_cycles_per_m + spectrum.centre / lines.range_step_m)
        + (occupied[-1] if len(occupied) else 0.5) / lines.range_step_m
    )
    largest = 2 ** math.ceil(math.log2(max(*grid.shape, min(_LEAF_SIDES))))
    best = None
    for leaf in _LEAF_SIDES:
        for stages in range(1, _MOST_STAGES + 1):
            filters = _filters(tolerance_db, stages, spectrum)
            for factors in product(_FACTORS, repeat=stages - 1):
                sides = tuple(leaf * math.prod(factors[i:]) for i in range(stages))
                if sides[0] > min(largest, _MOST_ROOT_SIDE):
                    continue
                nodes, seconds = _cost(lines, grid, sides, filters, highest)
                if best is None or seconds < best[0]:
                    best = seconds, sides, nodes, filters
    seconds, sides, nodes, filters = best
    resampling = interpolation.resampling(lines.length, filters[0], spectrum)
    return Plan(tolerance_db, sides, nodes, *filters, resampling, highest, seconds)


def aperture_coordinate(
    grid: Grid, side: int, cycles_per_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return angles in the grid's plane and how many cycles steering functions have turned.

    Seen from a subimage's centre under the angle psi, the range difference of its pixel at (x, y)
    changes by at most (hx |sin psi| + hy |cos psi|) per radian, with hx, hy half its sides; the
    phase by that times `cycles_per_m`. In the integral of that rate every steering function of
    the subimage is band-limited to one cycle per unit, whatever the track.

    Returns
    -------
    angle, cycles : float64 [n]
        From -pi to 2 pi, and the integral.
    """
    angle = np.linspace(-np.pi, 2 * np.pi, 3 * 4096 + 1)
    half_x = side / 2 * np.linalg.norm(grid.column_step_m)
    half_y = side / 2 * np.linalg.norm(grid.row_step_m)
    rate = cycles_per_m * (half_x * np.abs(np.sin(angle)) + half_y * np.abs(np.cos(angle)))
    step = angle[1] - angle[0]
    return angle, np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * step)])


def half_lengths(
    grid: Grid,
    sides: tuple[int, ...],
    align: Interpolator,
    final: Interpolator,
    samples_per_m: float,
) -> list[int]:
    """Return the samples to either side of a centre that a line of each stage needs.

    They hold the subimage's diagonal and the taps of the filters to come.
    """
    diagonal_m = np.hypot(np.linalg.norm(grid.column_step_m), np.linalg.norm(grid.row_step_m))
    return [
        math.ceil(side / 2 * diagonal_m * samples_per_m)
        + (len(sides) - 1 - stage) * (align.taps // 2 + 1)
        + final.taps
        for stage, side in enumerate(sides)
    ]


def direction_angles(
    grid: Grid,
    centres_m: NDArray[np.float64],
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Return the angles in the grid's plane under which centres see channels.

    A bistatic channel lies where the sum of the unit vectors to its ends points. Angles are
    continued so that channels on one side of a centre are not torn apart.

    Parameters
    ----------
    centres_m : float64 [n, 3]
    tx_m, rx_m : float64 [channels, 3]
        `rx_m` is `tx_m` unless given.

    Returns
    -------
    float64 [n, channels]
        Radians from the direction of the grid's columns, in [-pi, 2 pi).
    """
    along = grid.column_step_m / np.linalg.norm(grid.column_step_m)
    across = grid.row_step_m - (grid.row_step_m @ along) * along
    across /= np.linalg.norm(across)
    plane = np.stack([along, across], axis=1)

    sight = tx_m - centres_m[:, None]
    if rx_m is not None:
        back = rx_m - centres_m[:, None]
        sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
        sight += back / np.linalg.norm(back, axis=-1, keepdims=True)
    sight = sight @ plane
    angle = np.arctan2(sight[..., 1], sight[..., 0])
    torn = np.ptp(angle, axis=1) > np.pi
    angle[torn] %= 2 * np.pi
    return angle


def _filters(
    tolerance_db: float, stages: int, spectrum: Spectrum
) -> tuple[Interpolator, Interpolator, Interpolator]:
    """Return the cheapest filters whose errors stay together 3 dB below the tolerance.

    The margin is for what their sum leaves out: curvature within a subimage, and motion off the
    mean track.
    """
    each_db = tolerance_db - 3.0 - 10 * math.log10(2 * stages + 1)
    flat = Spectrum(0.0, (np.arange(128) + 0.5) / 256, np.full(128, 1 / 128))

    def first(candidates: Iterable[Interpolator]) -> Interpolator | None:
        return next((c for c in candidates if c.error_db <= each_db), None)

    def in_range(taps: tuple[int, ...], rates: tuple[float, ...]) -> Interpolator | None:
        return first(interpolation.design(t, r, spectrum) for r in rates for t in taps)

    align = in_range((8,), interpolation.UPSAMPLINGS)
    rate = (align.upsampling,)
    densities = np.arange(1.2, 5.0, 0.1)
    apertures = [first(interpolation.design(t, d, flat) for d in densities) for t in (4, 6, 8)]
    aperture = min(filter(None, apertures), key=lambda c: c.upsampling * (1 + c.taps / 24))
    return in_range((4, 6, 8), rate), aperture, in_range((2, 4, 6, 8), rate)


def _cost(
    lines: RangeLines,
    grid: Grid,
    sides: tuple[int, ...],
    filters: tuple[Interpolator, Interpolator, Interpolator],
    cycles_per_m: float,
) -> tuple[tuple[int, ...], float]:
    """Return the virtual channels of every stage and the seconds that a plan would take."""
    align, aperture, final = filters
    samples_per_m = align.upsampling / lines.range_step_m
    rows, columns = grid.shape
    places = np.array(list(product((0.1, 0.5, 0.9), repeat=2))) * grid.shape
    centres = grid.origin_m + places @ np.stack([grid.row_step_m, grid.column_step_m])
    angles = direction_angles(grid, centres, lines.tx_m, lines.rx_m)
    spans = np.stack([angles.min(axis=1), angles.max(axis=1)])
    channels, nanoseconds, nodes = lines.channels, 0.0, []
    lengths = half_lengths(grid, sides, align, final, samples_per_m)
    for side, half in zip(sides, lengths, strict=True):
        children = -(-rows // side) * -(-columns // side)
        samples = 2 * half + 16
        per_sample = _ALIGN_NS * align.taps + _COMBINE_NS * aperture.taps
        nanoseconds += children * channels * (samples * per_sample + _HOST_NS)
        turned = np.diff(np.interp(spans, *aperture_coordinate(grid, side, cycles_per_m)), axis=0)
        channels = int(turned.mean() * 2 * aperture.upsampling) + aperture.taps + 1
        nodes.append(channels)
    nanoseconds += grid.size * channels * _BACKPROJECT_NS * final.taps / 4
    return tuple(nodes), 1e-9 * nanoseconds


def _power(interpolator: Interpolator) -> float:
    return 10 ** (interpolator.error_db / 10)
