"""Fixed cost of a patch: mosaics of many patches of hardly any work."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

import clsas
from clsas.mosaics.patches import Layout

SIDE = 32  # pixels of a patch
COUNTS = (8, 16, 32, 64, 100)  # patches along each side
ACCURACY_DB = -40.0
COLUMNS = ["patches", "ms per patch in a store", "without a store", "of images alone"]
Row = list[object]


def rows() -> list[Row]:
    """Return the times of mosaics of 64 to 10 000 patches, and of images of such patches alone."""
    track_m = np.stack([np.linspace(-2, 2, 17), np.zeros(17), np.zeros(17)], axis=1)
    lines = clsas.simulate_lines(
        track_m, track_m, clsas.PointTargets([[0.0, 20.0, 0.0]]),
        carrier_hz=30e3, bandwidth_hz=10e3, oversampling=1.5,
    )  # fmt: skip
    list(mosaic(lines, COUNTS[0], None))  # compiles kernels
    found: list[Row] = []
    for count in COUNTS:
        with tempfile.TemporaryDirectory() as folder:
            stored = per_patch_ms(mosaic(lines, count, Path(folder) / "a.zarr"))
        formed = mosaic(lines, count, None)
        found.append([count**2, stored, per_patch_ms(formed), alone_ms(lines, formed)])
    return [[count, *(f"{each:.1f}" for each in times)] for count, *times in found]


def mosaic(lines: clsas.RangeLines, count: int, store: Path | None) -> clsas.Mosaic:
    """Return a mosaic of count x count patches, still to be formed."""
    grid = clsas.Grid.plane((-1, 1, SIDE * count), (19, 21, SIDE * count))
    return clsas.mosaic(lines, grid, store, patches=(count, count), accuracy_db=ACCURACY_DB)


def per_patch_ms(formed: clsas.Mosaic) -> float:
    """Form a mosaic; return the time per patch."""
    start = time.perf_counter()
    for _ in formed:
        pass
    return 1e3 * (time.perf_counter() - start) / len(formed)


def alone_ms(lines: clsas.RangeLines, formed: clsas.Mosaic) -> float:
    """Return the median time of images of some of the patches."""
    layout = Layout(formed.grid, formed.patch_shape)
    indices = list(layout.indices())
    times = []
    for index in indices[:: max(len(indices) // 200, 1)]:
        start = time.perf_counter()
        clsas.backproject(lines, layout.window(index).grid, accuracy_db=ACCURACY_DB)
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))
