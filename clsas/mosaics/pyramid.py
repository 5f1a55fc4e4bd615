"""Arithmetic of levels: means of power, of complex pixels and of layers over blocks of pixels.

A pixel of a level is the mean of the 2 x 2 pixels of the level before that received something, each
weighed by the number of pixels of the mosaic that it covers. Sums are in double precision, so that
neither the power of small amplitudes nor that of large ones leaves the range of numbers. Stored is
the root of the mean power, which has the range of the pixels.

Layers are means of the pixels that have a value, level by level. A deviation is that of the mean of
the heights. Heights of neighbouring pixels share most of their windows: those that are d pixels
apart along an axis have the correlation 1 - d/w with w pixels in the window. The mean of s pixels
of variance v along an axis then has the variance

    v c(s),   c(s) = sum_ij max(1 - |i - j|/w, 0) / s^2.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from clsas.mosaics.levels import IN_DB, PixelArray
from clsas.mosaics.means import block_means

Real = TypeVar("Real", np.float32, np.float64)

_BAND = 256  # rows that are reduced at once: a plain choice, which keeps copies small


class Level(NamedTuple):
    """Values of a level, or of a part of it."""

    amplitude: NDArray[np.float32]
    """Root of the mean power."""
    pixels: NDArray[np.complex64]
    """Mean of the complex pixels."""
    layers: Mapping[str, NDArray[np.float32]] = MappingProxyType({})
    """Means of the layers, by name."""

    def values_of(self, array: PixelArray) -> NDArray[np.float32] | NDArray[np.complex64]:
        """Return the values of an array of the level."""
        if array.kind in self.layers:
            return self.layers[array.kind]
        if array.name == IN_DB:
            return _in_db(self.amplitude)
        return self.pixels if array.kind == "pixels" else self.amplitude


def levels(pixels: NDArray[np.complex64], factors: tuple[int, ...]) -> dict[int, Level]:
    """Return the levels of a patch.

    Parameters
    ----------
    pixels : complex64 [rows, columns]
    factors : tuple of int
        1, 2, 4 and so on, ascending. Their blocks begin at the first pixel; the last blocks may
        extend beyond the pixels, and are then the mean of those that there are.
    """
    if not factors:
        return {}
    bands: dict[int, list[Level]] = {factor: [] for factor in factors}
    height = factors[-1] * max(_BAND // factors[-1], 1)
    for first in range(0, len(pixels), height):
        band = pixels[first : first + height]
        level = Level(np.abs(band), band)
        for factor in (1 << power for power in range(factors[-1].bit_length())):
            if factor > 1:
                rows, columns = (
                    covered(0, of_level, factor // 2, of_band)
                    for of_level, of_band in zip(level.amplitude.shape, band.shape, strict=True)
                )
                level = coarser(level, rows, columns)
            if factor in bands:
                bands[factor].append(level)
    return {
        factor: Level(
            np.concatenate([each.amplitude for each in found]),
            np.concatenate([each.pixels for each in found]),
        )
        for factor, found in bands.items()
    }


def layer_levels(
    layers: Mapping[str, NDArray[np.float32]],
    factors: tuple[int, ...],
    window: tuple[int, int] | None,
) -> dict[int, dict[str, NDArray[np.float32]]]:
    """Return the layers of a patch and of its levels, by factor and name.

    Parameters
    ----------
    layers : dict of str to float32 [rows, columns]
    factors : tuple of int
        1, 2, 4 and so on, as for `levels`; with 1 or without.
    window : (rows, columns)
        Pixels of the window behind each height; None without layers.
    """
    found, factor = {1: dict(layers)}, 1
    while factor < max(factors, default=1):
        factor *= 2
        found[factor] = coarser_layers(found[factor // 2], factor, window)
    return found


def coarser_layers(
    layers: Mapping[str, NDArray[np.float32]], factor: int, window: tuple[int, int] | None
) -> dict[str, NDArray[np.float32]]:
    """Return the layers of the level with a factor from those with half of it."""
    found = {}
    for name, values in layers.items():
        if name == "sd_m":
            assert window is not None  # of the heights with these deviations
            less = deviation_ratio(factor, window) / deviation_ratio(factor // 2, window)
            found[name] = np.float32(less) * np.sqrt(mean_of_four(np.square(values)))
        else:
            found[name] = mean_of_four(values)
    return found


def deviation_ratio(side: int, window: tuple[int, int]) -> float:
    """Return the deviation of the mean of side x side heights relative to that of one of them."""
    return float(np.sqrt(np.prod([_mean_correlation(side, n) for n in window])))


def _mean_correlation(count: int, window: int) -> float:
    """Return the mean correlation of all pairs of pixels in a row of `count` of them."""
    apart = np.arange(1, count)
    return (count + 2 * float(np.sum((count - apart) * np.maximum(1 - apart / window, 0)))) / (
        count**2
    )


def mean_of_four(values: NDArray[Real]) -> NDArray[Real]:
    """Return means of 2 x 2 pixels, of those that are not NaN; NaN if all are."""
    mean = block_means(values.astype(np.float64), ~np.isnan(values), empty=np.nan)
    return mean.astype(values.dtype)


def coarser(level: Level, rows: NDArray[np.float64], columns: NDArray[np.float64]) -> Level:
    """Return the next level.

    Parameters
    ----------
    level : Level
        A part of a level that begins at an even pixel along both axes.
    rows, columns : float64
        Number of pixels of the mosaic that its pixels cover, along both axes.
    """
    weights = np.multiply.outer(rows, columns) * (level.amplitude != 0)
    power = block_means(np.square(level.amplitude, dtype=np.float64), weights)
    pixels = block_means(level.pixels.astype(np.complex128), weights)
    return Level(np.sqrt(power).astype(np.float32), pixels.astype(np.complex64))


def _in_db(amplitude: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return amplitudes in dB, NaN where they are zero."""
    level = np.full(amplitude.shape, np.nan, np.float32)
    np.log10(amplitude, out=level, where=amplitude > 0)
    level *= 20
    return level


def covered(first: int, count: int, factor: int, pixels: int) -> NDArray[np.float64]:
    """Return how many pixels of the mosaic the pixels of a level cover along an axis.

    Parameters
    ----------
    first, count : int
        The pixels of the level.
    factor : int
        Factor of the level.
    pixels : int
        Pixels of the mosaic along the axis.
    """
    starts = factor * np.arange(first, first + count)
    return np.minimum(factor, pixels - starts).astype(np.float64)
