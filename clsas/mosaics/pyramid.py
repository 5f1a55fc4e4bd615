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

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.mosaics.levels import IN_DB
from clsas.mosaics.means import block_means

Values = dict[str, NDArray[Any]]
"""Values of a level or of a part of it, by kind.

"pixels", the mean of the complex pixels; "amplitude", the root of their mean power; and layers.
"""

_BAND = 256  # rows that are reduced at once: a plain choice, which keeps copies small


def pyramid(
    finest: Values, factors: Sequence[int], window: tuple[int, int] | None
) -> dict[int, Values]:
    """Return a patch and its levels, by factor.

    Parameters
    ----------
    finest : dict of str to array [rows, columns]
    factors : sequence of int
        2, 4 and so on, ascending; with 1 or without. Blocks begin at the first pixel; the last ones
        may extend beyond the pixels, and are then the mean of those that there are.
    window : (rows, columns) or None
        Pixels of the window behind each height, if there are heights.
    """
    levels, factor = {1: finest}, 1
    shape = finest["amplitude"].shape
    while factor < max(factors, default=1):
        finer, factor = levels[factor], 2 * factor
        sides = zip(finer["amplitude"].shape, shape, strict=True)
        rows, columns = (covered(0, count, factor // 2, pixels) for count, pixels in sides)
        levels[factor] = coarser(finer, factor, rows, columns, window)
    return levels


def coarser(
    finer: Values,
    factor: int,
    rows: NDArray[np.float64],
    columns: NDArray[np.float64],
    window: tuple[int, int] | None,
) -> Values:
    """Return values of the level with a factor from those with half of it.

    Parameters
    ----------
    finer : dict of str to array [rows, columns]
        A part of a level that begins at an even pixel along both axes.
    factor : int
    rows, columns : float64
        Number of pixels of the mosaic that its pixels cover, along both axes.
    window : (rows, columns) or None
        Pixels of the window behind each height, if there are heights.
    """
    amplitude = finer["amplitude"]
    shape = [-(-count // 2) for count in amplitude.shape]
    found = {kind: np.empty(shape, values.dtype) for kind, values in finer.items()}
    for first in range(0, len(amplitude), _BAND):
        part = slice(first, first + _BAND)
        weights = np.multiply.outer(rows[part], columns) * (amplitude[part] != 0)
        for kind, values in finer.items():
            mean = _mean(kind, values[part], weights)
            if kind == "sd_m":
                assert window is not None  # of the heights with these deviations
                mean *= deviation_ratio(factor, window) / deviation_ratio(factor // 2, window)
            found[kind][first // 2 : (first + _BAND) // 2] = mean
    return found


def _mean(kind: str, values: NDArray, weights: NDArray[np.float64]) -> NDArray:
    """Return means of 2 x 2 pixels in double precision."""
    if kind == "pixels":
        return block_means(values.astype(np.complex128), weights)
    if kind == "amplitude":
        return np.sqrt(block_means(np.square(values, dtype=np.float64), weights))
    double = np.square(values, dtype=np.float64) if kind == "sd_m" else values.astype(np.float64)
    mean = block_means(double, ~np.isnan(values), empty=np.nan)
    return np.sqrt(mean) if kind == "sd_m" else mean


def deviation_ratio(side: int, window: tuple[int, int]) -> float:
    """Return the deviation of the mean of side x side heights relative to that of one of them."""
    return float(np.sqrt(np.prod([_mean_correlation(side, n) for n in window])))


def _mean_correlation(count: int, window: int) -> float:
    """Return the mean correlation of all pairs of pixels in a row of `count` of them."""
    apart = np.arange(1, count)
    return (count + 2 * float(np.sum((count - apart) * np.maximum(1 - apart / window, 0)))) / (
        count**2
    )


def values_of(level: Values, kind: str) -> NDArray[Any]:
    """Return the values of a level of a kind, which may be `IN_DB`."""
    return _decibels(level["amplitude"]) if kind == IN_DB else level[kind]


def _decibels(amplitude: NDArray[np.float32]) -> NDArray[np.float32]:
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
