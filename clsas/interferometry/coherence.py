"""Complex coherence of two images in windows, its effective number of looks, and its phase noise.

A window of n pixels contains fewer than n independent samples of speckle, because neighbouring
pixels of a well-sampled image are correlated. With the autocorrelation rho of the speckle, the
effective number of looks L of a window with n pixels is

    1/L = sum_ij |rho(x_i - x_j)|^2 / n^2,

the variance of a windowed mean of products of circular Gaussian images relative to that of one
product. The phase of a coherence g then has the variance

    sigma^2 = (1 - g^2) / (2 L g^2)

(Rodriguez and Martin 1992).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import maximum_filter, uniform_filter1d

from clsas.engine.data.grid import Grid

Images = tuple[NDArray[np.complex64], NDArray[np.complex64]]
"""Pixels of the images of both banks, [rows, columns]."""

UNIFORM_SD_RAD = math.pi / math.sqrt(3)
"""Standard deviation of a phase that is uniform over a cycle, as without any coherence."""

LEAST_LOOKS = 4.0
"""Fewest looks from which a coherence is estimated. That of a single look is always 1."""

# Sides of the tiles that measure the autocorrelation, in windows. Within a tile the seabed should
# have one slope, because slopes change the spatial frequency of the speckle. Tiles of one window
# measure the longest lags from one pair of pixels.
_TILE = 2
_MOST_PIXELS = 1 << 17  # in tiles spread over an image, which measure looks to about 1 %


@dataclass(frozen=True)
class Window:
    """Rectangle of pixels around every pixel, with an odd number of rows and columns."""

    rows: int
    columns: int

    @classmethod
    def of(cls, grid: Grid, window_m: float) -> Self:
        """Return the window of about `window_m` along either side, but at least one pixel."""
        _, *steps_m = grid.vectors_m
        rows, columns = (
            1 if n == 1 else 2 * round((window_m / float(np.linalg.norm(step)) - 1) / 2) + 1
            for step, n in zip(steps_m, grid.shape, strict=True)
        )
        return cls(max(rows, 1), max(columns, 1))

    @property
    def sides(self) -> tuple[int, int]:
        """Number of rows and columns."""
        return self.rows, self.columns

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return self.rows * self.columns

    def scaled(self, factor: float) -> Self:
        """Return a window whose sides are larger by a factor, but at least as large."""
        return type(self)(*(max(2 * math.ceil((factor * n - 1) / 2) + 1, n) for n in self.sides))

    def sums(self, values: NDArray) -> NDArray:
        """Return sums over the window around every pixel of the last two axes.

        Pixels beyond the edges count as zero.
        """
        half, rows = self.rows // 2, values.shape[-2]
        down = np.empty(values.shape, np.result_type(values, np.float64))
        total = values[..., :half, :].sum(axis=-2, dtype=down.dtype)
        for row in range(rows):
            if row + half < rows:
                total += values[..., row + half, :]
            if row > half:
                total -= values[..., row - half - 1, :]
            down[..., row, :] = total
        return uniform_filter1d(down, self.columns, axis=-1, mode="constant") * self.columns

    def any_of(self, values: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return whether any value in the window around every pixel is true."""
        return np.asarray(maximum_filter(values, self.sides, mode="constant"))

    def fullness(self, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """Return the share of the window around every pixel that lies within an image."""
        down, across = (
            np.convolve(np.ones(n), np.full(side, 1 / side))[side // 2 :][:n]
            for n, side in zip(shape, self.sides, strict=True)
        )
        return np.outer(down, across)


class Moments(NamedTuple):
    """Sums of the products of two images, [rows, columns] each.

    Attributes
    ----------
    cross : complex
        Sum of a b*.
    power_a, power_b : float
        Sums of |a|^2 and |b|^2.
    """

    cross: NDArray[np.complexfloating]
    power_a: NDArray[np.floating]
    power_b: NDArray[np.floating]

    @classmethod
    def multilooked(cls, a: NDArray, b: NDArray, side: int) -> Self:
        """Return the sums over blocks of `side` x `side` pixels; the last ones may be smaller."""
        products = a * b.conj(), a.real**2 + a.imag**2, b.real**2 + b.imag**2
        return cls(*(block_sums(each, side) for each in products))

    @classmethod
    def of(cls, a: NDArray[np.complex64], b: NDArray[np.complex64], window: Window) -> Self:
        """Return the sums over the window around every pixel."""
        return cls.multilooked(a, b, 1).within(window)

    def within(self, window: Window) -> Self:
        """Return the sums over the window around every one of these."""
        real, imaginary, *powers = window.sums(
            np.stack([self.cross.real, self.cross.imag, self.power_a, self.power_b])
        )
        return type(self)(real + 1j * imaginary, *powers)

    @property
    def coherence(self) -> NDArray[np.complexfloating]:
        """Complex coherence of the samples, 0 where an image is 0."""
        # Running sums leave rounding errors where a window contains only zeros.
        power = np.sqrt(np.maximum(self.power_a, 0)) * np.sqrt(np.maximum(self.power_b, 0))
        found = np.zeros_like(self.cross)
        np.divide(self.cross, power, out=found, where=power > 1e-12 * power.max(initial=0.0))
        found /= np.maximum(np.abs(found), 1)
        return found


def block_sums(values: NDArray, side: int) -> NDArray:
    """Return the sums over blocks of `side` x `side` pixels; the last ones may be smaller."""
    for axis in (0, 1) if side > 1 else ():
        values = np.moveaxis(values, axis, 0)
        sums = values[::side].copy()
        for first in range(1, side):
            part = values[first::side]
            sums[: len(part)] += part
        values = np.moveaxis(sums, 0, axis)
    return values


def effective_looks(images: tuple[NDArray, ...], window: Window) -> float:
    """Return the effective number of looks of a window, measured in images of speckle.

    The squared autocorrelation is averaged over tiles. A sample autocorrelation of n pairs of
    pixels exceeds the true one by sum |rho|^2 / n in the mean square, or by 1 if all pixels are
    correlated. That is taken into account, for the power too.
    """
    sides = [min(_TILE * side, n) for side, n in zip(window.sides, images[0].shape, strict=True)]
    lags = [np.arange(1 - min(n, m), min(n, m)) for n, m in zip(window.sides, sides, strict=True)]
    squared, power = np.zeros([len(lag) for lag in lags]), 0.0
    for image in images:
        tiles = _tiles(image, *sides)
        spectra = fft.fft2(tiles, [2 * side for side in sides])
        correlation = fft.ifft2(np.abs(spectra) ** 2)[:, lags[0][:, None], lags[1]]
        squared += np.sum(np.abs(correlation) ** 2, axis=0)
        power += float(np.sum(np.abs(correlation[:, len(lags[0]) // 2, len(lags[1]) // 2]) ** 2))
    if power == 0:
        return 1.0
    pairs, weights = (
        np.outer(*(1 - np.abs(lag) / n for lag, n in zip(lags, lengths, strict=True)))
        for lengths in (sides, window.sides)
    )
    correlated = float(np.sum(weights * squared / pairs**2)) / power
    return window.pixels / _correlated_area(correlated, weights, pairs * math.prod(sides))


def _correlated_area(
    measured: float, weights: NDArray[np.float64], pairs: NDArray[np.float64]
) -> float:
    """Return sum |rho|^2 in pixels, 1 to that of a window, from the sum that was measured.

    `pairs` of pixels contribute to each lag; most of them to the power, whose square exceeds that
    of the true power in the same way.
    """
    least, most = 1.0, float(weights.sum())
    for _ in range(50):
        area = (least + most) / 2
        expected = area + float(np.sum(weights * np.minimum(area / pairs, 1)))
        if expected < measured * (1 + min(area / float(pairs.max()), 1)):
            least = area
        else:
            most = area
    return most


def _tiles(image: NDArray, rows: int, columns: int) -> NDArray[np.complex64]:
    """Return whole tiles that fit into an image, [tiles, rows, columns]."""
    down, across = image.shape[0] // rows, image.shape[1] // columns
    whole = image[: down * rows, : across * columns].reshape(down, rows, across, columns)
    count = min(max(_MOST_PIXELS // (rows * columns), 1), down * across)
    some = np.unique(np.linspace(0, down * across - 1, count).round())
    return whole.swapaxes(1, 2)[np.unravel_index(some.astype(int), (down, across))]


def debiased(coherence: NDArray, looks: NDArray | float) -> NDArray[np.float64]:
    """Return the magnitude of a sample coherence without the bias of finitely many looks.

    The squared sample coherence has the mean g^2 + (1 - g^2)^2/L for many looks (Touzi et al.
    1999). The result is 0 where the sample coherence is at most that of noise.
    """
    squared = np.abs(coherence) ** 2
    looks = np.maximum(looks, LEAST_LOOKS)
    # q^2/L + (1 - 2/L) q + 1/L = squared, for q = g^2
    linear = 1 - 2 / looks
    root = np.sqrt(np.maximum(linear**2 - 4 / looks * (1 / looks - squared), 0))
    return np.sqrt(np.clip(2 * (squared - 1 / looks) / (linear + root), 0, 1))


def phase_sd_rad(coherence: NDArray, looks: NDArray | float) -> NDArray[np.float64]:
    """Return the deviation of the phase of a coherence, at most that of a uniform phase."""
    squared = np.maximum(np.asarray(coherence, np.float64) ** 2, 1e-12)
    variance = np.maximum(1 - squared, 0) / (2 * squared * np.maximum(looks, 1))
    return np.minimum(np.sqrt(variance), UNIFORM_SD_RAD)


def noise_coherence(looks: NDArray | float, probability: float) -> NDArray[np.float64]:
    """Return the sample coherence that incoherent images exceed with a probability.

    With L looks the squared coherence exceeds t with the probability (1 - t)^(L - 1) (Touzi et al.
    1999).
    """
    return np.sqrt(1 - probability ** (1 / np.maximum(np.asarray(looks) - 1, 1e-9)))
