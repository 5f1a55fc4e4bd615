"""Overviews: large images at fewer pixels, read part by part."""

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
    """Return an image at fewer pixels, each with the mean power of those that it covers.

    Parameters
    ----------
    grid : Grid
        Grid of the image.
    patch_shape : (rows, columns)
        Approximate number of pixels that are read at once.
    read : callable
        Called as read(rows, columns) with slices; returns their pixels, complex64 [rows, columns].
    most : int
        Largest number of pixels along the longer side of the overview.
    """
    height, width = patch_shape
    rows, columns = grid.shape
    step = math.ceil(max(rows, columns) / most)
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
            blocks = (np.abs(pixels) ** 2).reshape(last - first, down, stop - start, across)
            power[first:last, start:stop] = blocks.mean(axis=(1, 3))
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
