"""Times of levels of a mosaic: writing and reading them, and pictures with and without them."""

from __future__ import annotations

import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np

import clsas
from clsas.engine.data.digests import grid_digest
from clsas.engine.data.grid import Grid
from clsas.mosaics.document import Record
from clsas.mosaics.levels import Levels, levels_of
from clsas.mosaics.patches import Layout, PatchWindow, patch_shape_of
from clsas.mosaics.pyramid import pyramid

SIDE, PATCHES = 20_000, (5, 5)
OVERVIEW = 1000  # pixels a side
COLUMNS = ["what", "seconds", "processor seconds", "peak memory, MiB"]
Row = list[object]


def rows() -> list[Row]:
    """Return the times for a mosaic of speckle, of 20 000 x 20 000 pixels in 5 x 5 patches.

    The peak memory is that of the process since its start.
    """
    grid = Grid.plane((0, 0.02 * (SIDE - 1), SIDE), (50, 50 + 0.02 * (SIDE - 1), SIDE))
    patch_shape = patch_shape_of(PATCHES, grid)
    layout = Layout(grid, patch_shape)
    windows = [layout.window(index) for index in np.ndindex(layout.shape)]
    factors = levels_of(grid.shape, patch_shape).of_patches
    with tempfile.TemporaryDirectory() as folder:
        old, new = Path(folder) / "old.zarr", Path(folder) / "new.zarr"
        found = [measured("computing the levels of a patch", computing(windows[0], factors))]
        found.append(measured("writing 25 patches and their levels", writing(new, grid, windows)))
        # Without levels and with one chunk for each patch.
        with (
            mock.patch("clsas.mosaics.levels.CHUNK_SIDE", SIDE),
            mock.patch("clsas.mosaics.document.levels_of", return_value=Levels(())),
            mock.patch("clsas.mosaics.levels.levels_of", return_value=Levels(())),
        ):
            found.append(measured("writing 25 patches alone", writing(old, grid, windows)))
            without = clsas.Store.opened(old)
            from_pixels = measured("overview from the pixels", lambda: without.overview(OVERVIEW))
        store = clsas.Store.opened(new)
        for _ in range(3):
            store.overview(OVERVIEW)
        found.append(measured("overview from a level", lambda: store.overview(OVERVIEW)))
        found.append(from_pixels)
    return found


def measured(what: str, work: Callable[[], object]) -> Row:
    """Do some work; return its name, its seconds and the peak memory of the process."""
    start, busy = time.perf_counter(), time.process_time()
    work()
    seconds, busy = time.perf_counter() - start, time.process_time() - busy
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return [what, f"{seconds:.2f}", f"{busy:.2f}", f"{peak:.0f}"]


def computing(window: PatchWindow, factors: tuple[int, ...]) -> Callable[[], object]:
    """Return a function that computes the levels of a patch."""
    pixels = speckle(window)
    finest = {"pixels": pixels, "amplitude": np.abs(pixels)}
    return lambda: pyramid(finest, factors, None)


def writing(path: Path, grid: Grid, windows: list[PatchWindow]) -> Callable[[], object]:
    """Return a function that writes the patches of a store, each with the same pixels."""
    store, record = clsas.Store.at(path), Record(1, 1, has_pixels=True)
    inputs = {"parts": [], "pixels": list(grid.shape), "grid": grid_digest(grid)}
    shape = windows[0].grid.shape
    store.begin(inputs, grid, (shape[0], shape[1]))
    pixels = speckle(windows[0])

    def write() -> None:
        for window in windows:
            place = window.row, window.column, window.rows, window.columns
            store.write(*place, pixels, record)

    return write


def speckle(window: PatchWindow) -> np.ndarray:
    """Return random pixels of a patch."""
    rows, columns = window.grid.shape
    random = np.random.default_rng(1)
    return random.standard_normal((rows, 2 * columns), np.float32).view(np.complex64)
