"""Heights in a store, read as `clsas.Heights`: a window, or an overview of fewer pixels."""

from __future__ import annotations

import itertools
import math
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.grid import Grid, without_heights
from clsas.engine.data.image import Image
from clsas.engine.data.validate import ArgumentError
from clsas.interferometry.refinement import filled
from clsas.interferometry.result import Heights
from clsas.mosaics.document import Document
from clsas.mosaics.levels import LAYERS, level_shape
from clsas.mosaics.pyramid import coarser

_READ = 2048  # pixels along a side that are read at once; a plain choice
_AMPLITUDE = "amplitude"
_BYTES = 100  # per pixel of `Heights`: eight numbers and their copies


class Store(Protocol):
    """What is read of a `clsas.Store`, which has these functions as methods."""

    @property
    def path(self) -> Path:
        """Folder of the store."""

    @property
    def document(self) -> Document:
        """What the mosaic was made with."""

    @property
    def grid(self) -> Grid:
        """Grid of the pixels."""

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the arrays of heights."""

    @property
    def levels(self) -> tuple[int, ...]:
        """Factors of the levels."""

    def read(self, rows: slice, columns: slice) -> NDArray[np.complex64]:
        """Return pixels."""

    def read_layer(
        self, name: str, rows: slice, columns: slice, *, factor: int = 1
    ) -> NDArray[np.float32]:
        """Return a part of a layer, or of its level."""

    def read_level(self, factor: int, rows: slice, columns: slice) -> NDArray[Any]:
        """Return amplitudes of a level."""


def check_heights(store: Store) -> None:
    """Raise ValueError if a store has no heights."""
    if not store.layers:
        raise ValueError(
            f"{store.path} must be a mosaic of heights, got one of images: `clsas.mosaic_heights` "
            "makes one of heights"
        )


def window_of(store: Store, rows: slice, columns: slice) -> Heights:
    """Return the heights in a window of a store; see `Store.heights`."""
    check_heights(store)
    plane = without_heights(store.grid.window(rows, columns))
    validate.memory("heights", _BYTES * plane.size)
    layers = {name: store.read_layer(name, rows, columns) for name in LAYERS}
    return _heights(plane, store.read(rows, columns), layers, _window_m(store))


def sampled(store: Store, per_window: int) -> Heights:
    """Return the heights of some pixels of every window; see `Store.sampled_heights`."""
    check_heights(store)
    assert store.document.window is not None  # the store has heights
    rows, columns = (
        slice(None, None, max(side // per_window, 1)) for side in store.document.window
    )
    return window_of(store, rows, columns)


def overview_of(store: Store, most: int, rows: slice, columns: slice) -> Heights:
    """Return the heights of a part of a store at fewer pixels; see `Store.overview_heights`."""
    check_heights(store)
    grid = store.grid
    part = without_heights(grid.window(rows, columns))
    first, last = [], []
    for name, given, count in zip(("rows", "columns"), (rows, columns), grid.shape, strict=True):
        pixels = range(count)[validate.selection(name, given, ascending=True)]
        if pixels.step != 1:
            raise ArgumentError(name, "have no step for an overview", str(pixels.step))
        first.append(pixels.start)
        last.append(pixels.stop)
    factor = 1
    while math.ceil(max(part.shape) / factor) > most:
        factor *= 2
    if factor == 1:
        return window_of(store, rows, columns)
    # A level serves if the part begins and ends with one of its pixels.
    finest = max(
        level
        for level in (1, *store.levels)
        if level <= factor
        and not any(start % level for start in first)
        and all(n % level == 0 or n == count for n, count in zip(last, grid.shape, strict=True))
    )
    shape = level_shape(part.shape, factor)
    found = {name: np.empty(shape, np.float32) for name in (*LAYERS, _AMPLITUDE)}
    side = max(_READ * finest // factor, 1)
    for top, left in itertools.product(range(0, shape[0], side), range(0, shape[1], side)):
        place = [
            slice(
                (begin + start * factor) // finest,
                -(-min(begin + (start + side) * factor, end) // finest),
            )
            for start, begin, end in zip((top, left), first, last, strict=True)
        ]
        block = _reduced(store, finest, factor, place[0], place[1])
        for name, values in block.items():
            found[name][top : top + side, left : left + side] = values
    amplitude = found.pop(_AMPLITUDE).astype(np.complex64)
    return _heights(_coarser(part, factor, shape), amplitude, found, _window_m(store))


def _reduced(
    store: Store, finest: int, factor: int, rows: slice, columns: slice
) -> dict[str, NDArray[np.float32]]:
    """Return layers and amplitude at a factor, from those of the level with the factor `finest`."""
    read = store.read if finest == 1 else partial(store.read_level, finest)
    values = {name: store.read_layer(name, rows, columns, factor=finest) for name in LAYERS}
    values[_AMPLITUDE] = np.abs(read(rows, columns))
    while finest < factor:
        finest *= 2
        down, across = map(np.ones, values[_AMPLITUDE].shape)
        values = coarser(values, finest, down, across, store.document.window)
    return values


def _heights(
    plane: Grid, pixels: NDArray, layers: dict[str, NDArray[np.float32]], window_m: float
) -> Heights:
    """Return heights of a plane's pixels, with the image on their relief."""
    values = {name: each.astype(np.float64) for name, each in layers.items()}
    mask = ~np.isnan(values["height_m"])
    # Patches that are not finished or not seen have neither coherence nor sensitivity.
    for name in ("coherence", "looks", "m_per_rad"):
        values[name] = np.nan_to_num(values[name])
    image = Image(pixels, plane.with_height(filled(values["height_m"], mask)))
    return Heights(**values, mask=mask, image=image, window_m=window_m)


def _coarser(plane: Grid, factor: int, shape: tuple[int, int]) -> Grid:
    """Return the grid of a level: its pixels lie in the middle of those that they cover."""
    origin_m, row_step_m, column_step_m = plane.vectors_m
    return Grid.oriented(
        origin_m + (factor - 1) / 2 * (row_step_m + column_step_m),
        factor * row_step_m,
        factor * column_step_m,
        shape,
        georeference=plane.georeference,
    )


def _window_m(store: Store) -> float:
    return float(store.document.inputs["window_m"])
