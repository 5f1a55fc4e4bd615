"""Local planes fitted to the phase that is left when both banks are imaged on a relief.

Let z = a b* be the product of two images on a relief of height h, and M the change of height per
radian of phase. In a window around a pixel, the true height of pixel i is modelled as a plane,

    h_i + M arg z_i = c_0 + c_1 r_i + c_2 s_i,

with r and s the rows and columns from the middle. Linearised about the phase of sum z, the weighted
least squares with weights Re(z_i exp(-j arg sum z)) is one Gauss-Newton step towards the maximum of
the likelihood: a linear regression. Its sums are those of z times powers of r and s, which are
computed for all windows at once. The plane is fitted to the height itself and not to the
correction: repeated corrections would otherwise undo the averaging of the window, and the noise
would grow from pass to pass.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsas.interferometry.coherence import Moments, Window
from clsas.interferometry.strips import in_strips

_RIDGE = 1e-4  # of the variance of rows and columns; keeps windows with little power solvable
_LEAST_DETERMINANT = 1e-3  # relative to that of an evenly filled window


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
    images: tuple[NDArray[np.complex64], NDArray[np.complex64]],
    height_m: NDArray[np.float64],
    m_per_rad: NDArray[np.float64],
    window: Window,
) -> Planes:
    """Return the planes that two images on a relief show.

    Parameters
    ----------
    images : two complex64 [rows, columns]
    height_m : float64 [rows, columns]
        The relief.
    m_per_rad : float64 [rows, columns]
        Change M of the height per radian of phase.
    window : Window
    """
    return in_strips(partial(_fit, window=window), (*images, height_m, m_per_rad), window)


def _fit(
    a: NDArray[np.complex64],
    b: NDArray[np.complex64],
    height_m: NDArray[np.float64],
    m_per_rad: NDArray[np.float64],
    *,
    window: Window,
) -> Planes:
    """Return the planes of some rows."""
    moments = Moments.of(a, b, window)
    magnitude = np.abs(moments.cross)
    lit = magnitude > 1e-12 * magnitude.max(initial=0.0)
    mean = np.where(lit, moments.cross, 1) / np.where(lit, magnitude, 1)
    product = a.astype(np.complex128) * b.conj()
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
