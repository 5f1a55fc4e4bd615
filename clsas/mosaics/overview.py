"""Overviews: large images at fewer pixels, which are read part by part."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clsas.core.grid import Grid
from clsas.core.image import Image


def reduced(
    grid: Grid,
    patch_shape: tuple[int, int],
    read: Callable[[slice, slice], NDArray[np.complex64]],
    most: int,
) -> Image:
    """Return an image at fewer pixels, each with the mean power of those it covers.

    Parameters
    ----------
    grid : Grid
        Grid of the image.
    patch_shape : (rows, columns)
        Approximate number of pixels that are read together.
    read : callable
        Called with slices of rows and columns; returns their pixels, complex64 [rows, columns].
    most : int
        Largest number of pixels along the longer side of the overview.
    """
    height, width = patch_shape
    step = math.ceil(max(grid.shape) / most)
    shape = tuple(n // step or 1 for n in grid.shape)
    step = [min(step, n) for n in grid.shape]
    power = np.zeros(shape)
    # Read whole pixels of the overview, and about whole patches, at a time.
    band, run = max(height // step[0], 1), max(width // step[1], 1)
    for first in range(0, shape[0], band):
        last = min(first + band, shape[0])
        for start in range(0, shape[1], run):
            stop = min(start + run, shape[1])
            rows, columns = (
                slice(a * n, b * n) for a, b, n in ((first, last, step[0]), (start, stop, step[1]))
            )
            blocks = np.abs(read(rows, columns)) ** 2
            blocks = blocks.reshape(last - first, step[0], stop - start, step[1])
            power[first:last, start:stop] = blocks.mean(axis=(1, 3))
    middle = sum(
        (n - 1) / 2 * each
        for n, each in zip(step, (grid.row_step_m, grid.column_step_m), strict=True)
    )
    coarse = Grid.oriented(
        grid.origin_m + middle, grid.row_step_m * step[0], grid.column_step_m * step[1], shape
    )
    return Image(np.sqrt(power).astype(np.complex64), coarse)
