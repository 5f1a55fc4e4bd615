"""Orientation of rasters: images turned by quarters, so that they look like a map.

Programs for maps expect the first row in the north and the first column in the west, and some
ignore other orders. Turning by quarters and mirroring rows moves no pixel off the grid.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.grid import Grid
from clsas.maps.map_grids import Affine

_SAME = 1e-9  # smallest gain for which a raster is turned, far above rounding


@dataclass(frozen=True)
class Orientation:
    """An image's rows and columns in the order of its raster.

    Attributes
    ----------
    shape : (rows, columns)
        Shape of the raster.
    affine : tuple of float
        Transform from columns and rows of the raster to easting and northing.
    transposed : bool
        True if rows of the image are columns of the raster.
    rows_reversed, columns_reversed : bool
        True if rows or columns of the raster, after transposition, are in reverse order.
    """

    shape: tuple[int, int]
    affine: Affine
    transposed: bool = False
    rows_reversed: bool = False
    columns_reversed: bool = False

    @classmethod
    def of(cls, shape: tuple[int, int], affine: Affine) -> Orientation:
        """Return the orientation closest to north-up of an image with a shape and a transform.

        The raster is never mirrored.
        """
        turned = (
            _turned(shape, affine, *flags) for flags in itertools.product((False, True), repeat=3)
        )
        best, best_score = None, -math.inf
        for each in turned:
            a, b, _, d, e, _ = each.affine
            if a * e - b * d > 0:
                continue  # mirrored
            score = a / math.hypot(a, d) - e / math.hypot(b, e)
            if score > best_score + _SAME:
                best, best_score = each, score
        assert best is not None  # one of the eight is not mirrored
        return best

    @property
    def is_north_up(self) -> bool:
        """True if rows of the raster run east and columns south."""
        return self.affine[1] == 0 and self.affine[3] == 0

    def window(self, rows: slice, columns: slice) -> tuple[slice, slice]:
        """Return the rows and columns of the raster that show a window of the image."""
        parts = (columns, rows) if self.transposed else (rows, columns)
        down, across = (
            slice(n - part.stop, n - part.start) if is_reversed else part
            for part, n, is_reversed in zip(
                parts, self.shape, (self.rows_reversed, self.columns_reversed), strict=True
            )
        )
        return down, across

    def vectors_m(self, grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the position of the raster's first pixel, [3], and its steps, metres.

        The steps, float64 [2, 3], lead from row to row and from column to column.
        """
        first_m, *given_m = grid.vectors_m
        steps_m = np.stack(given_m[::-1] if self.transposed else given_m)
        for axis, is_reversed in enumerate((self.rows_reversed, self.columns_reversed)):
            if is_reversed:
                first_m = first_m + (self.shape[axis] - 1) * steps_m[axis]
                steps_m[axis] = -steps_m[axis]
        return first_m, steps_m

    def turned(self, pixels: NDArray) -> NDArray:
        """Return a window of the image as the raster shows it, without copying."""
        turned = pixels.T if self.transposed else pixels
        return turned[:: -1 if self.rows_reversed else 1, :: -1 if self.columns_reversed else 1]


def _turned(
    shape: tuple[int, int], affine: Affine, transposed: bool, rows: bool, columns: bool
) -> Orientation:
    """Return the orientation with some flags."""
    a, b, c, d, e, f = affine
    down, across = shape
    if transposed:
        a, b, d, e, down, across = b, a, e, d, across, down
    if rows:
        b, c, e, f = -b, c + down * b, -e, f + down * e
    if columns:
        a, c, d, f = -a, c + across * a, -d, f + across * d
    # Adding 0 turns -0 into 0.
    return Orientation(
        (down, across), (a + 0.0, b + 0.0, c, d + 0.0, e + 0.0, f), transposed, rows, columns
    )
