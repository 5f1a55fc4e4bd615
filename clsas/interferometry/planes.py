"""Local planes fitted to the phase that is left when both banks are imaged on a relief.

Let z = a b* be the product of two images on a relief of height h, and M the change of height per
radian of phase. In a window around a pixel, the true height of pixel i is modelled as a plane,

    h_i + M arg z_i = c_0 + c_1 r_i + c_2 s_i,

with r and s the rows and columns from the middle. Linearised about the phase of sum z, the weighted
least squares with weights Re(z_i exp(-j arg sum z)) is one Gauss-Newton step towards the maximum of
the likelihood. Its sums are those of z times powers of r and s, which are computed for all windows
at once. The plane is fitted to the height itself and not to the correction: repeated corrections
would otherwise undo the averaging of the window, and the noise would grow from pass to pass.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsas.interferometry.coherence import Moments, Window

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
    """

    height_m: NDArray[np.float64]
    row_slope_m: NDArray[np.float64]
    column_slope_m: NDArray[np.float64]
    coherence: NDArray[np.float64]
    growth: NDArray[np.float64]
    roughness_m: NDArray[np.float64]


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
    moments = Moments.of(*images, window)
    magnitude = np.abs(moments.cross)
    lit = magnitude > 1e-12 * magnitude.max(initial=0.0)
    mean = np.where(lit, moments.cross, 1) / np.where(lit, magnitude, 1)
    product = images[0].astype(np.complex128) * images[1].conj()
    # Multiplied by this phase, sums have weights as real parts, and weights times phases relative
    # to the mean as imaginary parts. Division by the sum of weights makes them means.
    scale = mean.conj() / np.where(lit, magnitude, 1)
    s = _CentredSums(product, scale, window)
    turned = m_per_rad * np.angle(mean)

    def right(of_phase: NDArray, of_height: NDArray) -> NDArray:
        return of_height.real + turned * of_phase.real + m_per_rad * of_phase.imag

    h = _CentredSums(product * height_m, scale, window, second=False)
    wanted = np.stack([right(s.one, h.one), right(s.r, h.r), right(s.s, h.s)], axis=-1)
    of_height = np.stack([h.one.real, h.r.real, h.s.real], axis=-1)
    squared = (scale * window.sums(product * height_m**2)).real
    spread = [max((side**2 - 1) / 12, 1e-6) for side in window.sides]
    normal = np.empty((*product.shape, 3, 3))
    normal[..., 0, 0] = s.one.real
    normal[..., 0, 1] = normal[..., 1, 0] = s.r.real
    normal[..., 0, 2] = normal[..., 2, 0] = s.s.real
    normal[..., 1, 2] = normal[..., 2, 1] = s.rs.real
    normal[..., 1, 1] = s.rr.real + _RIDGE * spread[0]
    normal[..., 2, 2] = s.ss.real + _RIDGE * spread[1]
    solvable = lit & (np.linalg.det(normal) > _LEAST_DETERMINANT * spread[0] * spread[1])
    normal[~solvable] = np.eye(3)
    inverse = np.linalg.inv(normal)
    found = np.einsum("...ij,...j->...i", inverse, wanted)
    squared -= np.einsum("...i,...i", found, 2 * of_height)
    squared += np.einsum("...i,...ij,...j", found, normal, found)
    return Planes(
        np.where(solvable, found[..., 0], height_m),
        np.where(solvable, found[..., 1], 0.0),
        np.where(solvable, found[..., 2], 0.0),
        np.where(solvable, np.abs(moments.coherence), 0.0),
        np.where(solvable, np.maximum(inverse[..., 0, 0], 1.0), 1.0),
        np.where(solvable, np.sqrt(np.maximum(squared, 0.0)), 0.0),
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


class _CentredSums:
    """Sums over windows of values times powers of the rows r and columns s from the middle."""

    def __init__(
        self, values: NDArray, scale: NDArray, window: Window, second: bool = True
    ) -> None:
        row, column = (np.arange(float(n)) for n in values.shape)
        row, column = row[:, None], column[None, :]
        one, r, s = (scale * window.sums(each) for each in (values, values * row, values * column))
        self.one, self.r, self.s = one, r - row * one, s - column * one
        if second:
            rr, rs, ss = (
                scale * window.sums(values * each) for each in (row**2, row * column, column**2)
            )
            self.rr = rr - 2 * row * r + row**2 * one
            self.rs = rs - row * s - column * r + row * column * one
            self.ss = ss - 2 * column * s + column**2 * one
