"""Division of a mosaic into patches, which are stored, and into blocks, which are formed."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from clsas.engine.data import validate
from clsas.engine.data.grid import Grid
from clsas.engine.data.validate import ArgumentError, ArgumentTypeError
from clsas.mosaics.document import PatchIndex
from clsas.mosaics.levels import aligned_side, factors_of


class PatchWindow(NamedTuple):
    """Pixels of a mosaic that belong to a patch."""

    grid: Grid
    row: int
    column: int
    rows: slice
    columns: slice


@dataclass(frozen=True, eq=False)
class Layout:
    """A grid divided into patches, or into blocks of them.

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

    def grouped(
        self, indices: Iterable[PatchIndex], block_shape: tuple[int, int]
    ) -> dict[PatchIndex, list[PatchIndex]]:
        """Return patches, row by row, by the index of the block that contains them."""
        found: dict[PatchIndex, list[PatchIndex]] = {}
        for index in indices:
            row, column = (
                number * side // of_block
                for number, side, of_block in zip(index, self.patch_shape, block_shape, strict=True)
            )
            found.setdefault((row, column), []).append(index)
        return {block: sorted(patches) for block, patches in found.items()}


@dataclass(frozen=True, eq=False)
class Block:
    """Rectangle of neighbouring patches that are formed together.

    Attributes
    ----------
    grid : Grid
        Pixels of the block.
    rows, columns : slice
        Where they lie in the mosaic.
    patch_shape : (rows, columns)
        Number of pixels of a patch.
    wanted : sequence of (row, column)
        Patches to return and to store. The others are finished already.
    """

    grid: Grid
    rows: slice
    columns: slice
    patch_shape: tuple[int, int]
    wanted: Sequence[PatchIndex]

    def patches(self) -> Iterator[tuple[PatchWindow, tuple[slice, slice]]]:
        """Yield every patch, wanted or not, and where it lies in the block."""
        layout, corner = Layout(self.grid, self.patch_shape), (self.rows.start, self.columns.start)
        for index in layout.indices():
            window = layout.window(index)
            inside = window.rows, window.columns
            row, column = (
                first // side + number
                for first, side, number in zip(corner, self.patch_shape, index, strict=True)
            )
            rows, columns = (
                slice(first + part.start, first + part.stop)
                for first, part in zip(corner, inside, strict=True)
            )
            yield PatchWindow(window.grid, row, column, rows, columns), inside

    def __str__(self) -> str:
        """Return which patches these are, in words."""
        names = [f"{window.row},{window.column}" for window, _ in self.patches()]
        return f"patch {names[0]}" if len(names) == 1 else f"patches {names[0]} to {names[-1]}"


def with_margin(
    window: PatchWindow, margin: tuple[int, int], shape: tuple[int, ...]
) -> tuple[slice, slice, tuple[slice, slice]]:
    """Return a patch with so many pixels beyond each side, as far as a mosaic of a shape reaches.

    Returns
    -------
    rows, columns : slice
        Its pixels in the mosaic.
    inside : (rows, columns)
        Where the patch lies in it.
    """
    outer, inner = [], []
    for part, side, count in zip((window.rows, window.columns), margin, shape, strict=True):
        begin = max(part.start - side, 0)
        outer.append(slice(begin, min(part.stop + side, count)))
        inner.append(slice(part.start - begin, part.stop - begin))
    return outer[0], outer[1], (inner[0], inner[1])


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
    return aligned_shape(grid.shape, counts)


def aligned_shape(shape: tuple[int, ...], counts: Sequence[int]) -> tuple[int, int]:
    """Return the pixels of a patch, given the number of patches along each axis.

    They are rounded up so that as many levels as possible end at the borders of patches.
    """
    coarsest = factors_of(shape)[-1]
    rows, columns = (
        aligned_side(math.ceil(pixels / count), count, pixels, coarsest)
        for pixels, count in zip(shape, counts, strict=True)
    )
    return rows, columns
