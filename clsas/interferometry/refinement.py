"""Heights from the phase that is left between two images on a relief.

Let z = a b* be the product of two images on a relief of height h, and M the change of height per
radian of phase. In a window around a pixel, the true height of pixel i is modelled as a plane,

    h_i + M arg z_i = c_0 + c_1 r_i + c_2 s_i,

with r and s the rows and columns from the middle. Linearised about the phase of sum z, the weighted
least squares with weights Re(z_i exp(-j arg sum z)) is one Gauss-Newton step towards the maximum of
the likelihood: a linear regression. Its sums are those of z times powers of r and s, which are
computed for all windows at once. The plane is fitted to the height itself and not to the
correction: repeated corrections would otherwise undo the averaging of the window, and the noise
would grow from pass to pass.

Passes over new images of the corrected relief end when corrections are below the deviation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from clsas.engine.data.decibels import DEVIATION_PER_MEDIAN
from clsas.engine.data.grid import Grid
from clsas.engine.data.threads import in_threads
from clsas.interferometry.baseline import Lattice
from clsas.interferometry.coherence import (
    Moments,
    Window,
    debiased,
    noise_coherence,
    phase_sd_rad,
)

PASSES = 6
"""Most passes. Two or three are usual."""

# Rms correction of the last pass, in standard deviations. Another one would correct a hundredth of
# that.
_CONVERGED = 1.0
# Last correction of a pixel, in deviations, from which on it is not valid: its window reaches to
# where the relief is unknown, and contains echoes of another height.
_UNSETTLED = 3.0
_CREDIBLE = 0.25  # largest credible correction of the sweep, in heights of ambiguity; arbitrary
_FALSE_ALARM = 1e-3  # share of incoherent windows that exceed the threshold of coherence
# Rms distance of the relief from the plane of a window, in deviations. Noise of the heights makes
# 0.1 % of the windows of level seabeds rougher; those across steps are rougher by far. A parabola
# displaces the height in the middle by about as much as it makes the window rough. Half the value
# masks a fifth of simulated dunes, twice the value adds less than 1 % to the valid pixels.
_MOST_ROUGHNESS = 3.0
_LINEAR_RAD = 0.15  # roughness as a phase, up to which the fit of a plane is almost linear
# Variance in the middle of a window relative to that of an evenly lit one. It is 4 at the edge of a
# shadow, beyond which a plane would be extrapolated.
_MOST_GROWTH = 3.0
# Displacements by curvature are averaged over windows so much larger. Without curvature, the noise
# of level seabeds then adds 0.7 % to the deviation; with half the value, 1.4 %.
_BENDING = 2.0
# Mean square of `Planes.bend_m` on level seabeds, in variances of the height: 0.23 to 0.25 on the
# slopes of tests/interferometry. Evenly lit windows would have 0.32.
_BEND_NOISE = 0.25
_LEAST_FORESHORTENING = 0.2  # steeper slopes towards the sonar count as layover
_RIDGE = 1e-4  # of the variance of rows and columns; keeps windows with little power solvable
_LEAST_DETERMINANT = 1e-3  # relative to that of an evenly filled window
# Rows of a strip, and windows of rows. Half and twice as many take the same time.
_ROWS, _WINDOWS = 64, 4


@dataclass(frozen=True, eq=False)
class View:
    """How two banks see places above a plane, and which heights are valid.

    Looks are those of a window on a level surface. They must not be measured on a relief: its small
    errors shift the phase of neighbouring pixels, which then seem uncorrelated.
    """

    grid: Grid
    sights: Lattice
    window: Window
    looks: float
    least_coherence: float
    ambiguity_m: float


@dataclass(frozen=True, eq=False)
class Refined:
    """Heights above a plane, [rows, columns] each, after the last pass.

    Attributes
    ----------
    offset_m, sd_m, coherence, looks, m_per_rad : float64
    valid : bool
    usable : bool
        Pixels whose heights make up the relief of another pass.
    slope_m : float64 [2, rows, columns]
        Slopes of the heights, metres per row and per column.
    correction : float
        Rms of the last correction, in standard deviations.
    """

    offset_m: NDArray[np.float64]
    sd_m: NDArray[np.float64]
    coherence: NDArray[np.float64]
    looks: NDArray[np.float64]
    m_per_rad: NDArray[np.float64]
    valid: NDArray[np.bool_]
    usable: NDArray[np.bool_]
    slope_m: NDArray[np.float64]
    correction: float

    @property
    def converged(self) -> bool:
        """True if the last correction is well below the deviation."""
        return self.correction <= _CONVERGED

    @property
    def relief_m(self) -> NDArray[np.float64]:
        """The heights, or the nearest usable ones."""
        return filled(self.offset_m, self.usable)

    def in_pixels(self, side: int, shape: tuple[int, int]) -> Self:
        """Return the heights of pixels, from those of blocks of `side` x `side` pixels."""
        if side == 1:
            return self
        row, column = ((np.arange(n) % side - (side - 1) / 2) / side for n in shape)
        found: dict[str, Any] = {
            name: enlarged(value, side, shape)
            for name, value in vars(self).items()
            if np.ndim(value)
        }
        found["offset_m"] += found["slope_m"][0] * row[:, None] + found["slope_m"][1] * column
        return replace(self, **found)


def enlarged(values: NDArray, side: int, shape: tuple[int, int]) -> NDArray:
    """Return the values of pixels, which are those of their blocks of `side` x `side` pixels."""
    down = np.repeat(values, side, axis=-2)[..., : shape[0], :]
    return np.repeat(down, side, axis=-1)[..., : shape[1]]


def refine(
    products_at: Callable[[NDArray[np.float64]], Moments],
    relief_m: NDArray[np.float64],
    known: NDArray[np.bool_],
    view: View,
    progress: Callable[[int], None] = lambda done: None,
) -> Refined:
    """Return heights, starting from those of a relief above the plane of a view.

    Products of both images on a relief, pixel by pixel or block by block, come from a function. A
    pixel is known if the relief shows its height, or windows decide by themselves.
    """
    window, shape = view.window, relief_m.shape
    # A slope that faces the sonar is imaged with more pixels per independent sample.
    _, level = sensitivity(view, float(relief_m.mean()), np.zeros((2, 1, 1)))
    level_growth = edge_growth(window, shape)
    looks_on_plane = view.looks * window.fullness(shape) / level
    first_m, slope_m = relief_m, np.array(np.gradient(relief_m))
    for done in range(1, PASSES + 1):
        rad_m, facing = sensitivity(view, relief_m, slope_m)
        planes = fit_planes(products_at(relief_m), relief_m, -1 / rad_m, window)
        seen = looks_on_plane * np.maximum(facing, _LEAST_FORESHORTENING)
        coherence = debiased(planes.coherence, seen)
        sd_m = phase_sd_rad(coherence, seen / planes.growth) / np.abs(rad_m)
        valid = known & (facing > _LEAST_FORESHORTENING)
        valid &= coherence >= np.maximum(view.least_coherence, noise_coherence(seen, _FALSE_ALARM))
        valid &= np.abs(planes.height_m - first_m) < _CREDIBLE * view.ambiguity_m
        valid &= planes.growth < _MOST_GROWTH * level_growth
        # Without noise, the sweep's heights are rougher than the deviation. Filling their windows
        # would make steps, which make the neighbours rough in turn.
        smooth_m = _MOST_ROUGHNESS * sd_m
        usable = valid & (planes.roughness_m < np.maximum(smooth_m, _LINEAR_RAD / np.abs(rad_m)))
        valid &= planes.roughness_m < smooth_m
        change = np.abs(planes.height_m - relief_m) / sd_m
        # The median is not affected by the few pixels beside steps of the relief.
        median = float(np.median(change[valid])) if valid.any() else 0.0
        correction = DEVIATION_PER_MEDIAN * median
        settled = valid & (change < _UNSETTLED)
        whole_sd_m = np.hypot(sd_m, displacement_m(planes.bend_m, sd_m, settled, window))
        slope_m = np.stack([planes.row_slope_m, planes.column_slope_m])
        found = Refined(
            planes.height_m, whole_sd_m, coherence, seen, -1 / rad_m, settled, usable, slope_m,
            correction,
        )  # fmt: skip
        progress(done)
        if found.converged:
            break
        relief_m = found.relief_m
    return found


def sensitivity(
    view: View, offset_m: NDArray[np.float64] | float, slope_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the change of phase per metre of height error, rad/m, and the foreshortening.

    Heights above the plane, and their slopes per row and column, broadcast to [rows, columns].
    """
    _, row_step_m, column_step_m = view.grid.vectors_m
    rows, columns = map(np.arange, view.grid.shape)
    rad_m, row_tangent, column_tangent = view.sights.over(rows, columns, offset_m)[:3]
    facing = 1 - (slope_m[0] + row_step_m[2]) * row_tangent
    facing -= (slope_m[1] + column_step_m[2]) * column_tangent
    return rad_m / np.maximum(facing, _LEAST_FORESHORTENING), facing


def displacement_m(
    bend_m: NDArray[np.float64],
    noise_m: NDArray[np.float64],
    valid: NDArray[np.bool_],
    window: Window,
) -> NDArray[np.float64]:
    """Return the rms displacement of heights by the curvature of the seabed within windows, metres.

    A plane displaces the middle of a curved window, and does so again if it is fitted to the
    heights that were found. That second displacement, `Planes.bend_m`, estimates the first one
    (Tukey 1977). Its mean square around every valid pixel, less that of noise, is the square of the
    result.
    """
    excess = np.where(valid, bend_m**2 - _BEND_NOISE * noise_m**2, 0.0)
    around = window.scaled(_BENDING)
    share = around.sums(valid.astype(float))
    return np.sqrt(np.maximum(around.sums(excess), 0.0) / np.maximum(share, 1.0))


def filled(values: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return values in which unknown ones are those of the nearest known pixel, or 0 if none is."""
    if known.all():
        return values
    if not known.any():
        return np.zeros_like(values)
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return values[tuple(nearest)]


class Planes(NamedTuple):
    """Planes in windows around every pixel, [rows, columns] each.

    Attributes
    ----------
    height_m : float64
        Height in the middle of the window.
    row_slope_m, column_slope_m : float64
        Slopes, metres per row and per column.
    coherence : float64
        Magnitude of the sample coherence.
    growth : float64
        Variance of the height in the middle, relative to that of a windowed mean.
    roughness_m : float64
        Rms distance of the relief from the plane.
    bend_m : float64
        Height in the middle of a plane fitted to the relief itself, above the relief.
    """

    height_m: NDArray[np.float64]
    row_slope_m: NDArray[np.float64]
    column_slope_m: NDArray[np.float64]
    coherence: NDArray[np.float64]
    growth: NDArray[np.float64]
    roughness_m: NDArray[np.float64]
    bend_m: NDArray[np.float64]


def fit_planes(
    products: Moments,
    height_m: NDArray[np.float64],
    m_per_rad: NDArray[np.float64],
    window: Window,
) -> Planes:
    """Return the planes that the products of two images on a relief show.

    A radian of phase changes the height by `m_per_rad`, [rows, columns].
    """
    return _in_strips(partial(_fit, window=window), (*products, height_m, m_per_rad), window)


def _fit(
    cross: NDArray[np.complexfloating],
    power_a: NDArray[np.floating],
    power_b: NDArray[np.floating],
    height_m: NDArray[np.float64],
    m_per_rad: NDArray[np.float64],
    *,
    window: Window,
) -> Planes:
    """Return the planes of some rows."""
    moments = Moments(cross, power_a, power_b).within(window)
    magnitude = np.abs(moments.cross)
    lit = magnitude > 1e-12 * magnitude.max(initial=0.0)
    mean = np.where(lit, moments.cross, 1) / np.where(lit, magnitude, 1)
    product = cross.astype(np.complex128)
    # Multiplied by this phase, sums have weights as real parts, and weights times phases relative
    # to the mean as imaginary parts. Division by the sum of weights makes them means.
    scale = mean.conj() / np.where(lit, magnitude, 1)
    row, column = np.ogrid[tuple(map(slice, product.shape))]
    column = column - product.shape[1] // 2  # smaller squares have smaller rounding errors

    def means(values: NDArray) -> NDArray[np.complex128]:
        return scale * window.sums(product * values)

    of_row, of_column, of_height = means(row), means(column), means(height_m).real
    r, s = of_row.real, of_column.real
    spread = [max((side**2 - 1) / 12, 1e-6) for side in window.sides]
    rr = means(row**2).real - r**2 + _RIDGE * spread[0]
    ss = means(column**2).real - s**2 + _RIDGE * spread[1]
    rs = means(row * column).real - r * s
    determinant = rr * ss - rs**2
    solvable = lit & (determinant > _LEAST_DETERMINANT * spread[0] * spread[1])
    determinant[~solvable] = 1
    rh = means(row * height_m).real - r * of_height
    sh = means(column * height_m).real - s * of_height
    ry, sy = rh + m_per_rad * of_row.imag, sh + m_per_rad * of_column.imag
    row_slope_m = (ry * ss - sy * rs) / determinant
    column_slope_m = (sy * rr - ry * rs) / determinant
    r, s = r - row, s - column  # from the middle
    change_m = m_per_rad * np.angle(mean)
    middle_m = of_height + change_m - row_slope_m * r - column_slope_m * s
    bend_m = of_height - height_m
    bend_m -= (r * (rh * ss - sh * rs) + s * (sh * rr - rh * rs)) / determinant
    growth = 1 + (r**2 * ss - 2 * r * s * rs + s**2 * rr) / determinant
    squared = means(height_m**2).real - of_height**2 + change_m**2
    squared += row_slope_m * (row_slope_m * rr + 2 * column_slope_m * rs - 2 * rh)
    squared += column_slope_m * (column_slope_m * ss - 2 * sh)
    return Planes(
        np.where(solvable, middle_m, height_m),
        np.where(solvable, row_slope_m, 0.0),
        np.where(solvable, column_slope_m, 0.0),
        np.where(solvable, np.abs(moments.coherence), 0.0),
        np.where(solvable, np.maximum(growth, 1.0), 1.0),
        np.where(solvable, np.sqrt(np.maximum(squared, 0.0)), 0.0),
        np.where(solvable, bend_m, 0.0),
    )


def edge_growth(window: Window, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the `growth` of evenly lit windows, which is more than 1 at the edges of an image."""
    excess = []
    for n, side in zip(shape, window.sides, strict=True):
        first = np.maximum(np.arange(n) - side // 2, 0)
        last = np.minimum(np.arange(n) + side // 2, n - 1)
        variance = np.maximum(((last - first + 1) ** 2 - 1) / 12, 1e-6)
        excess.append(((first + last) / 2 - np.arange(n)) ** 2 / variance)
    return 1 + excess[0][:, None] + excess[1][None, :]


def _in_strips(
    function: Callable[..., Planes], arrays: tuple[NDArray, ...], window: Window
) -> Planes:
    """Return what a function of windows around every pixel returns, strip by strip in threads."""
    rows, margin = len(arrays[0]), window.rows // 2
    height = max(_ROWS, _WINDOWS * window.rows)

    def strip(first: int) -> Planes:
        last = min(first + height, rows)
        begin, end = max(first - margin, 0), min(last + margin, rows)
        found = function(*(each[begin:end] for each in arrays))
        return Planes(*(each[first - begin : last - begin] for each in found))

    parts = list(in_threads(strip, range(0, rows, height)))
    return Planes(*(np.concatenate(each) for each in zip(*parts, strict=True)))
