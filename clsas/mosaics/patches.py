"""Division of a mosaic into patches, and the choice of their size."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, Self

from clsas.engine.data import validate
from clsas.engine.data.grid import Grid
from clsas.engine.data.validate import ArgumentError, ArgumentTypeError
from clsas.mosaics.levels import aligned_side, factors_of
from clsas.mosaics.record import PatchIndex
from clsas.mosaics.visibility import SurveyVisibility

_LARGEST_SIDE = 4096  # pixels; such a patch takes seconds, and larger ones gain nothing
_SMALLEST_SIDE = 128  # pixels; reading and planning smaller patches takes longer than imaging


class PatchWindow(NamedTuple):
    """Pixels of a mosaic that belong to a patch."""

    grid: Grid
    row: int
    column: int
    rows: slice
    columns: slice


@dataclass(frozen=True, eq=False)
class Layout:
    """A grid divided into patches.

    Attributes
    ----------
    grid : Grid
        Grid of the whole mosaic.
    patch_shape : (rows, columns)
        Number of pixels of a patch; the last patches along each axis may be smaller.
    """

    grid: Grid
    patch_shape: tuple[int, int]

    @property
    def shape(self) -> tuple[int, int]:
        """Number of patches along rows and columns."""
        rows, columns = (
            math.ceil(n / m) for n, m in zip(self.grid.shape, self.patch_shape, strict=True)
        )
        return rows, columns

    def __len__(self) -> int:
        """Return the number of patches."""
        return math.prod(self.shape)

    def window(self, index: PatchIndex) -> PatchWindow:
        """Return the pixels of a patch."""
        rows, columns = (
            slice(i * side, min((i + 1) * side, most))
            for i, side, most in zip(index, self.patch_shape, self.grid.shape, strict=True)
        )
        return PatchWindow(self.grid.window(rows, columns), *index, rows, columns)

    def indices(self) -> Iterator[PatchIndex]:
        """Yield the indices of all patches, row by row."""
        rows, columns = self.shape
        return itertools.product(range(rows), range(columns))


@dataclass(frozen=True, eq=False)
class Wide:
    """A patch with a margin, as far as the grid of the mosaic reaches.

    Attributes
    ----------
    rows, columns : slice
        Its pixels in the mosaic.
    inside : (rows, columns)
        Where the patch lies in it.
    """

    rows: slice
    columns: slice
    inside: tuple[slice, slice]

    @classmethod
    def of(cls, window: PatchWindow, margin: tuple[int, int], shape: tuple[int, ...]) -> Self:
        """Return a patch with so many rows and columns beyond each side."""
        outer, inner = [], []
        for part, side, count in zip((window.rows, window.columns), margin, shape, strict=True):
            begin = max(part.start - side, 0)
            outer.append(slice(begin, min(part.stop + side, count)))
            inner.append(slice(part.start - begin, part.stop - begin))
        return cls(outer[0], outer[1], (inner[0], inner[1]))


def host_bytes(channels: int, length: int, pixels: int) -> int:
    """Return the bytes for the lines and pixels of a patch, each with one working copy."""
    return 2 * 8 * (channels * length + pixels)


def choose_patch_shape(
    visibility: SurveyVisibility, grid: Grid, memory_bytes: int
) -> tuple[int, int]:
    """Return the number of pixels of the largest patches that are predicted to fit into memory.

    Raises
    ------
    ValueError
        If not even the smallest patches fit.
    """
    side = _LARGEST_SIDE
    coarsest = factors_of(grid.shape)[-1]
    needed = 0
    while side >= _SMALLEST_SIDE:
        # Make the patches as equal as possible, and levels end at their borders.
        height, width = (
            aligned_side(math.ceil(n / math.ceil(n / side)), math.ceil(n / side), n, coarsest)
            for n in grid.shape
        )
        most = 0
        for row in (0, grid.shape[0] - 1):
            top, left = row // height * height, grid.shape[1] // 2 // width * width
            window = grid.window(slice(top, top + height), slice(left, left + width))
            visible = visibility.channels(window)
            if visible.any():
                count, length = visibility.survey.extent(visible, *visibility.ranges_m(window))
                most = max(most, count * length)
        # Upsampled lines and stages on the device take about one and a half times the lines.
        needed = host_bytes(1, most, height * width) + 12 * most + (64 << 20)
        if needed <= memory_bytes:
            return height, width
        side //= 2
    raise ArgumentError(
        "memory_bytes",
        f"be at least {needed / 2**20:.0f} MiB for the smallest patches, of {height} x {width} "
        "pixels",
        f"{memory_bytes / 2**20:.3g} MiB",
        "raise it or give `patches`",
    )


def patch_shape_of(patches: tuple[int, int], grid: Grid) -> tuple[int, int]:
    """Return the number of pixels of a patch, given the number of patches along each axis.

    Raises
    ------
    TypeError, ValueError
        If `patches` are not two whole numbers, or some patches would be empty.
    """
    meaning = "(rows, columns) of patches"
    try:
        given = validate.entries("patches", patches, meaning)
        counts = tuple(validate.count("every entry of patches", n) for n in given)
    except TypeError:
        raise ArgumentTypeError("patches", f"be {meaning}", repr(patches)) from None
    if len(counts) != 2:
        raise ArgumentError("patches", f"be {meaning}", repr(patches))
    shape = []
    for count, pixels in zip(counts, grid.shape, strict=True):
        side = math.ceil(pixels / count)
        if math.ceil(pixels / side) != count:
            fewer = math.ceil(pixels / side)
            raise ArgumentError(
                "patches",
                "all have pixels",
                f"{count} patches of {side} for {pixels} pixels",
                f"{fewer} are enough",
            )
        shape.append(aligned_side(side, count, pixels, factors_of(grid.shape)[-1]))
    return shape[0], shape[1]
