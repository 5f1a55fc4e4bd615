"""Sources of exports: images and heights in memory, and stores of mosaics, read by windows.

`bands_of` returns what a raster shows of a source, also window by window.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.certificate import Certificate
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.validate import ArgumentError
from clsas.interferometry.result import Heights
from clsas.mosaics.document import MosaicCertificate, PatchIndex, Record
from clsas.mosaics.store import Store

_WINDOW = 2048  # rows and columns that are read at once: 32 MiB of pixels; a plain choice


@dataclass(frozen=True, eq=False)
class Source:
    """An image that is read window by window, or heights.

    Attributes
    ----------
    grid : Grid
        Grid of all pixels, with the georeference of the export.
    image : Image or None
    store : Store or None
        One of both has the pixels.
    records : dict
        Records of the patches of the store when the export began.
    heights : Heights or None
        Heights in memory, if they are exported; `image` is then the image on their relief.
    """

    grid: Grid
    image: Image | None
    store: Store | None
    records: dict[PatchIndex, Record]
    heights: Heights | None = None

    @classmethod
    def of(cls, source: Image | Store | Heights, georeference: Georeference | None) -> Source:
        """Return the source of what is exported, with a georeference if one is given.

        Raises
        ------
        ValueError
            If the source has another georeference, or a store is damaged.
        """
        heights = source if isinstance(source, Heights) else None
        found = source.image if isinstance(source, Heights) else source
        grid = found.grid
        if georeference is not None:
            if grid.georeference not in (None, georeference):
                allowed = f"be left out, since the source has one: {grid.georeference}"
                raise ArgumentError("georeference", allowed)
            grid = replace(grid, georeference=georeference)
        if isinstance(found, Store):
            return cls(grid, None, found, found.records())
        return cls(grid, found, None, {}, heights)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = self.grid.shape
        return rows, columns

    @property
    def window_shape(self) -> tuple[int, int]:
        """Rows and columns that are read at once: those of a patch for a store."""
        if self.store is None:
            return _WINDOW, _WINDOW
        shape = self.store.patch_shape
        assert shape is not None  # the store exists
        return shape

    @property
    def counts(self) -> tuple[int, int]:
        """Number of windows along rows and columns."""
        rows, columns = (
            math.ceil(n / side) for n, side in zip(self.shape, self.window_shape, strict=True)
        )
        return rows, columns

    @property
    def inputs(self) -> dict[str, Any]:
        """Inputs of the store's mosaic; empty for an image."""
        return {} if self.store is None else self.store.document.inputs

    @property
    def certificate(self) -> Certificate | None:
        """Measured error of the image, or of the whole mosaic."""
        if self.image is not None:
            return None if self.image.formed is None else self.image.formed.certificate
        measured = MosaicCertificate.of(self.records)
        return None if measured is None else measured.of_all

    def windows(self) -> Iterator[tuple[slice, slice]]:
        """Yield windows that cover the image. Those of a store are whole patches."""
        yield from windows_of(self.shape, self.window_shape)

    def read(self, rows: slice, columns: slice) -> NDArray[np.complex64]:
        """Return the pixels of a window, complex64 [rows, columns]."""
        if self.image is not None:
            return self.image.pixels[rows, columns]
        assert self.store is not None
        return self.store.read(rows, columns)

    @property
    def has_heights(self) -> bool:
        """True if heights are exported, from memory or from a store."""
        return self.heights is not None or (self.store is not None and bool(self.store.layers))

    @property
    def window_m(self) -> float | None:
        """Side of the windows of the heights, metres; None for images."""
        return self.inputs.get("window_m") if self.heights is None else self.heights.window_m

    def read_layer(self, name: str, rows: slice, columns: slice) -> NDArray[np.floating]:
        """Return a window of what `Heights` has by a name, NaN outside the mask."""
        if self.heights is not None:
            mask = self.heights.mask[rows, columns]
            return np.where(mask, getattr(self.heights, name)[rows, columns], np.nan)
        assert self.store is not None
        values = self.store.read_layer(name, rows, columns)
        if name == "height_m":
            return values
        return np.where(np.isnan(self.store.read_layer("height_m", rows, columns)), np.nan, values)

    def check_finished(self, name: str = "source") -> None:
        """Raise ValueError if patches of the store `name` are missing or damaged."""
        if self.store is None:
            return
        patches = math.prod(self.counts)
        if len(self.records) < patches:
            raise ArgumentError(
                name,
                f"be finished, but {len(self.records)} of the {patches} patches of "
                f"{self.store.path} are, without damage",
                hint="run `clsas.mosaic` again with the same inputs, which forms the others",
            )

    def check_unchanged(self, name: str = "source") -> None:
        """Raise ValueError if patches of the store `name` were formed since the export began."""
        if self.store is not None and self.store.records() != self.records:
            raise ArgumentError(
                name,
                f"not change while it is exported, but patches of {self.store.path} were formed "
                "meanwhile",
                hint="repeat the export when the mosaic is finished",
            )


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


@dataclass(frozen=True, eq=False)
class Band:
    """Numbers of the pixels of a grid, which are read window by window.

    Attributes
    ----------
    name : str
        What the numbers are, such as "Height".
    unit : str
        Their unit; "" for numbers without one, and for amplitudes.
    kind : str
        Their kind, which says how they are averaged: see `clsas.mosaics.pyramid.block_means`.
        Complex pixels are "amplitude", too, since overviews show that.
    read : callable
        Called as read(rows, columns) with two slices; returns the numbers of a window of the grid.
    """

    name: str
    unit: str
    kind: str
    read: Callable[[slice, slice], NDArray]


def bands_of(source: Source, kind: str) -> tuple[Band, ...]:
    """Return the bands of a raster that shows a source.

    Parameters
    ----------
    source : Source
        An image on a plane or height map, a mosaic, or heights.
    kind : str
        Kind of the pixels of an image: "db", "complex" or "8bit". 8-bit levels stand alone, without
        the heights of a height map. Heights have no amplitude.
    """
    grid = source.grid
    origin_m, *steps_m = grid.vectors_m
    place = grid.georeference
    first_m = (origin_m if place is None else place.to_map(origin_m))[2]
    down_m, right_m = (step[2] * np.arange(n) for step, n in zip(steps_m, grid.shape, strict=True))

    def height_m(rows: slice, columns: slice) -> NDArray[np.float64]:
        """Return heights on the vertical axis of the map: those above the plane, and the plane."""
        if source.has_heights:
            above_m = source.read_layer("height_m", rows, columns)
        else:
            assert grid.height_m is not None  # it is read only if there are heights
            above_m = grid.height_m[rows, columns]
        return first_m + np.add.outer(down_m[rows], right_m[columns]) + above_m

    def amplitude(rows: slice, columns: slice) -> NDArray[np.float32]:
        return np.abs(source.read(rows, columns))

    height = Band("Height", "m", "height_m", height_m)
    if source.has_heights:
        return (
            height,
            Band("Standard deviation", "m", "sd_m", partial(source.read_layer, "sd_m")),
            Band("Coherence", "", "coherence", partial(source.read_layer, "coherence")),
        )
    pixels = Band("Amplitude", "", "amplitude", source.read if kind == "complex" else amplitude)
    return (pixels,) if grid.height_m is None or kind == "8bit" else (pixels, height)
