"""Fewer pixels and fewer bits: levels of mosaics, overviews of maps, and tiles of the viewer.

All three follow one rule, `block_means`. A pixel of a level is the mean of the pixels of the level
before that have a value, each weighed by the number of pixels of the image that it covers. Pixels
that nothing reached have none, and leave edges and seams as bright as the seabed beside them.
Amplitudes are roots of mean power. Sums are in double precision, so that neither the power of small
amplitudes nor that of large ones leaves the range of numbers.

Deviations are roots of mean squares. A store reduces them to those of the mean of the heights.
Heights of neighbouring pixels share most of their windows: those that are d pixels apart along an
axis have the correlation 1 - d/w with w pixels in the window. The mean of s pixels of variance v
along an axis then has the variance

    v c(s),   c(s) = sum_ij max(1 - |i - j|/w, 0) / s^2.

The same amplitudes in dB (`decibels`) are in stores, GeoTIFF and netCDF, and the same 8-bit levels
(`eight_bits`) in GeoTIFF and in the viewer.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.mosaics.levels import IN_DB

Values = dict[str, NDArray[Any]]
"""Values of a level or of a part of it, by kind.

"pixels", the mean of the complex pixels; "amplitude", the root of their mean power; and layers.
"""

NOTHING = 0
"""8-bit level where nothing was received."""

BRIGHTEST = 255
"""8-bit level of the reference; every level below, down to 1, is one step of dB lower."""

SQUARED = ("amplitude", "sd_m")
"""Kinds of values whose squares are averaged."""

_BAND = 256  # rows that are reduced at once: a plain choice, which keeps copies small
_FINEST = 5  # pixels of a level along each side of an overview pixel, before a larger step is tried
_LARGER = 4 / 3  # largest step over the smallest, so that a coarser level can be read


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
        weights = np.multiply.outer(rows[part], columns)
        # Pixels that received something may cancel to 0.
        received = weights * (amplitude[part] != 0)
        for kind, values in finer.items():
            mean = block_means(kind, values[part], received if kind == "pixels" else weights)
            if kind == "sd_m":
                assert window is not None  # of the heights with these deviations
                mean *= deviation_ratio(factor, window) / deviation_ratio(factor // 2, window)
            found[kind][first // 2 : (first + _BAND) // 2] = mean
    return found


def block_means(
    kind: str,
    values: NDArray,
    weights: NDArray | float = 1.0,
    down: int = 2,
    across: int = 2,
    *,
    least: float = 0.0,
) -> NDArray:
    """Return means over blocks of `down` x `across` pixels, float64 or complex128.

    Parameters
    ----------
    kind : str
        "amplitude", whose mean is the root of the mean power, and which is 0 where nothing was
        received; "sd_m", whose mean is the root of the mean square; "pixels", complex ones; or the
        name of other numbers. All but amplitudes and pixels are NaN where there is no value.
    values : float or complex [rows, columns]
    weights : bool or float [rows, columns] or float
        Number of pixels of the image that each pixel covers; for "pixels", 0 where nothing was
        received.
    down, across : int
        Rows and columns of a block. Those at the ends of other sides have fewer.
    least : float
        Smallest weight, of pixels with a value, of a block that gets a value.
    """
    is_square = kind in SQUARED
    known = values != 0 if kind == "amplitude" else ~np.isnan(values)
    counted = np.multiply(weights, known, dtype=np.float64)
    double = values.astype(np.result_type(values, np.float64))
    if is_square:
        double *= double
    double *= counted
    if kind != "amplitude":  # which is 0 there already
        double[counted == 0] = 0  # whatever the value is
    total, weight = (_block_sums(each, down, across) for each in (double, counted))
    empty = 0.0 if kind in ("amplitude", "pixels") else np.nan
    mean = np.full_like(total, empty)
    np.divide(total, weight, out=mean, where=(weight > 0) & (weight >= least))
    return np.sqrt(mean) if is_square else mean


def _block_sums(values: NDArray, down: int, across: int) -> NDArray:
    missing = [(0, -count % by) for count, by in zip(values.shape, (down, across), strict=True)]
    whole = np.pad(values, missing) if any(end for _, end in missing) else values
    total = whole[::down, ::across].copy()
    for row, column in itertools.islice(itertools.product(range(down), range(across)), 1, None):
        total += whole[row::down, column::across]
    return total


def covered(first: int, count: int, factor: int, pixels: int) -> NDArray[np.float64]:
    """Return how many pixels of the image the pixels of a level cover along an axis.

    Parameters
    ----------
    first, count : int
        The pixels of the level.
    factor : int
        Factor of the level.
    pixels : int
        Pixels of the image along the axis.
    """
    starts = factor * np.arange(first, first + count)
    return np.minimum(factor, pixels - starts).astype(np.float64)


def deviation_ratio(side: int, window: tuple[int, int]) -> float:
    """Return the deviation of the mean of side x side heights relative to that of one of them."""
    apart = np.arange(1, side)
    # Mean correlation of all pairs of pixels along each axis.
    correlations = [
        (side + 2 * np.sum((side - apart) * np.maximum(1 - apart / count, 0))) / side**2
        for count in window
    ]
    return float(np.sqrt(np.prod(correlations)))


# Amplitudes in dB and in 8 bits


def decibels(amplitude: NDArray, reference: float = 1.0) -> NDArray[np.float64]:
    """Return amplitudes in dB relative to a reference, NaN where they are 0.

    Levels of a pixel do not depend on other pixels, however an image is divided.
    """
    level = np.full(amplitude.shape, np.nan)
    np.log10(amplitude, out=level, where=amplitude != 0, dtype=np.float64)
    level -= math.log10(reference)
    level *= 20
    return level


def eight_bits(amplitude: NDArray, reference: float, step_db: float) -> NDArray[np.uint8]:
    """Return amplitudes as 8-bit levels in steps of dB, from `BRIGHTEST` for the reference to 1.

    Fainter pixels have the level 1, and those that received nothing `NOTHING`.
    """
    level = decibels(amplitude, reference)
    level /= step_db
    np.rint(level, out=level)
    level += BRIGHTEST
    np.clip(level, 1, BRIGHTEST, out=level)
    level[np.isnan(level)] = NOTHING
    return level.astype(np.uint8)


def values_of(level: Values, kind: str) -> NDArray[Any]:
    """Return the values of a level of a kind, which may be `IN_DB`."""
    return decibels(level["amplitude"]).astype(np.float32) if kind == IN_DB else level[kind]


# Overviews of images, read part by part


def step_of(shape: tuple[int, ...], most: int, factors: Sequence[int]) -> tuple[int, int]:
    """Return the pixels along each side of an overview pixel, and the factor of the level to read.

    The factor divides the step. Where the smallest step would require a much finer level, a larger
    step is chosen.

    Parameters
    ----------
    shape : (rows, columns)
        Pixels of the image.
    most : int
        Largest number of pixels along the longer side of the overview.
    factors : sequence of int
        Factors of the levels that can be read.
    """
    least = math.ceil(max(shape) / most)
    if least > min(shape):  # an overview pixel extends beyond the image
        factors = ()
    steps = range(least, max(int(_LARGER * least), least) + 1) if factors else [least]

    def factor_of(step: int) -> int:
        return max((factor for factor in factors if step % factor == 0), default=1)

    def fineness(step: int) -> float:
        factor = factor_of(step)
        return step / factor if factor > 1 or step == 1 else math.inf

    step = next((s for s in steps if fineness(s) <= _FINEST), min(steps, key=fineness))
    return step, factor_of(step)


def reduced(
    grid: Grid,
    read: Callable[[slice, slice], NDArray[np.complex64] | NDArray[np.float32]],
    factor: int,
    patch_shape: tuple[int, ...],
    step: int,
) -> Image:
    """Return an image at fewer pixels, each with the mean power of those that it covers.

    Parameters
    ----------
    grid : Grid
        Grid of the image.
    read : callable
        Called as read(rows, columns) with slices of the image's pixels; returns complex64 pixels,
        or the float32 amplitudes of a level's.
    factor : int
        Pixels of the image along each side of what `read` returns; 1 for the pixels themselves.
    patch_shape : (rows, columns)
        Approximate number of pixels that are read at once.
    step : int
        Pixels along each side of an overview pixel, a multiple of `factor`.
    """
    down, across = (min(step, count) for count in grid.shape)
    shape = (grid.shape[0] // step or 1, grid.shape[1] // step or 1)
    amplitude = np.zeros(shape)
    # Read blocks of whole overview pixels that are about as large as a patch.
    band, run = max(patch_shape[0] // down, 1), max(patch_shape[1] // across, 1)
    for first in range(0, shape[0], band):
        last = min(first + band, shape[0])
        for start in range(0, shape[1], run):
            stop = min(start + run, shape[1])
            pixels = read(slice(first * down, last * down), slice(start * across, stop * across))
            amplitude[first:last, start:stop] = block_means(
                "amplitude", np.abs(pixels), 1.0, down // factor, across // factor
            )
    origin_m, row_step_m, column_step_m = grid.vectors_m
    middle_m = (down - 1) / 2 * row_step_m + (across - 1) / 2 * column_step_m
    coarse = Grid.oriented(
        origin_m + middle_m,
        row_step_m * down,
        column_step_m * across,
        shape,
        georeference=grid.georeference,
    )
    return Image(amplitude.astype(np.complex64), coarse)
