"""Sources of exports: images in memory, and stores of mosaics, read window by window."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.core.georeference import Georeference
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.mosaics.documents import read_document
from clsas.mosaics.record import PatchIndex, Record
from clsas.mosaics.store import Store

_WINDOW = 2048  # rows and columns that are read at once: 32 MiB of pixels; a plain choice


@dataclass(frozen=True, eq=False)
class Source:
    """An image that is read window by window.

    Attributes
    ----------
    grid : Grid
        Grid of all pixels, with the georeference of the export.
    image : Image or None
    store : Store or None
        One of both has the pixels.
    records : dict
        Records of the patches of the store when the export began.
    """

    grid: Grid
    image: Image | None
    store: Store | None
    records: dict[PatchIndex, Record]

    @classmethod
    def of(cls, source: Image | Store, georeference: Georeference | None) -> Source:
        """Return the source of an image or a store.

        Raises
        ------
        ValueError
            If the georeference differs from that of the source, or a store is damaged or not
            finished.
        """
        grid, records = source.grid, {}
        if isinstance(source, Store):
            records = source.records()
            rows, columns = (
                math.ceil(n / m) for n, m in zip(grid.shape, _patch_shape(source), strict=True)
            )
            if len(records) < rows * columns:
                raise ValueError(
                    f"source must be finished, but {len(records)} of the {rows * columns} patches "
                    f"of {source.path} are, without damage: run clsas mosaic again with the same "
                    "inputs, which forms the others"
                )
        grid = placed(grid, georeference)
        if isinstance(source, Store):
            return cls(grid, None, source, records)
        return cls(grid, source, None, records)

    @property
    def inputs(self) -> dict[str, Any]:
        """Inputs of the store's mosaic; empty for an image."""
        return {} if self.store is None else read_document(self.store.path)["inputs"]

    def windows(self) -> Iterator[tuple[slice, slice]]:
        """Yield windows that cover the image. Those of a store are whole patches."""
        rows, columns = self.grid.shape
        height, width = (_WINDOW, _WINDOW) if self.store is None else _patch_shape(self.store)
        yield from windows_of((rows, columns), (height, width))

    def read(self, rows: slice, columns: slice) -> NDArray[np.complex64]:
        """Return the pixels of a window, complex64 [rows, columns]."""
        if self.image is not None:
            return self.image.pixels[rows, columns]
        assert self.store is not None
        return self.store.read(rows, columns)

    def check_unchanged(self) -> None:
        """Raise ValueError if patches of the store were formed again since the export began."""
        if self.store is not None and self.store.records() != self.records:
            raise ValueError(
                f"source must not change, but patches of {self.store.path} were formed again "
                "during the export: repeat it when the mosaic is finished"
            )


def placed(grid: Grid, georeference: Georeference | None) -> Grid:
    """Return a grid with a georeference, if one is given.

    Raises
    ------
    ValueError
        If the grid has another one.
    """
    if georeference is None:
        return grid
    if grid.georeference not in (None, georeference):
        raise ValueError(
            f"georeference must be left out, since the source has one: {grid.georeference}"
        )
    return replace(grid, georeference=georeference)


def _patch_shape(store: Store) -> tuple[int, int]:
    shape = store.patch_shape
    assert shape is not None  # the store exists
    return shape


def windows_of(
    shape: tuple[int, int], sides: tuple[int, int] = (_WINDOW, _WINDOW)
) -> Iterator[tuple[slice, slice]]:
    """Yield windows of given sides that cover an array, row by row."""
    for top in range(0, shape[0], sides[0]):
        for left in range(0, shape[1], sides[1]):
            yield (
                slice(top, min(top + sides[0], shape[0])),
                slice(left, min(left + sides[1], shape[1])),
            )
