"""Overviews: large images at fewer pixels, read part by part."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.mosaics.means import block_means

_FINEST = 5  # pixels of a level along each side of an overview pixel, before a larger step is tried
_LARGER = 4 / 3  # largest step over the smallest, so that a coarser level can be read


class Reading(NamedTuple):
    """How the pixels of an image or of a level are read.

    Attributes
    ----------
    read : callable
        Called as read(rows, columns) with slices of the image's pixels; returns complex64 pixels,
        or the float32 amplitudes of a level's.
    factor : int
        Pixels of the image along each side of what `read` returns; 1 for the pixels themselves.
    patch_shape : (rows, columns)
        Approximate number of pixels that are read at once.
    """

    read: Callable[[slice, slice], NDArray[np.complex64] | NDArray[np.float32]]
    factor: int
    patch_shape: tuple[int, int]


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


def reduced(grid: Grid, reading: Reading, step: int) -> Image:
    """Return an image at fewer pixels, each with the mean power of those that it covers.

    Pixels that nothing reached do not count.

    Parameters
    ----------
    grid : Grid
        Grid of the image.
    reading : Reading
        How its pixels are read.
    step : int
        Pixels along each side of an overview pixel, a multiple of the factor of `reading`.
    """
    read, factor, (height, width) = reading
    rows, columns = grid.shape
    down, across = (
        min(step, rows),
        min(step, columns),
    )  # pixels per overview pixel
    shape = (rows // step or 1, columns // step or 1)
    power = np.zeros(shape)
    # Read blocks of whole overview pixels that are about as large as a patch.
    band, run = max(height // down, 1), max(width // across, 1)
    for first in range(0, shape[0], band):
        last = min(first + band, shape[0])
        for start in range(0, shape[1], run):
            stop = min(start + run, shape[1])
            pixels = read(slice(first * down, last * down), slice(start * across, stop * across))
            block = np.abs(pixels).astype(np.float64) ** 2
            power[first:last, start:stop] = block_means(
                block, block != 0, down // factor, across // factor
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
    return Image(np.sqrt(power).astype(np.complex64), coarse)
