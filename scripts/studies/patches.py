"""What it costs to store an image in patches: mosaics against images in one piece, in turns."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.fft

import clsas

ROUNDS = 5  # medians are reported
STEP_M = 0.02  # of samples and pixels
NEAREST_M = 30.0
COLUMNS = ["image", "patches", "mosaic, s", "in a store, s", "image in one piece, s", "ratios"]
Row = list[object]


def rows() -> list[Row]:
    """Return the times of mosaics and of images, and the ratios of the former to the latter."""
    lines, beam = noise(2000, 40.0, 24.0), clsas.BeamWindow(20.0, "hann")
    long, narrow = noise(2000, 40.0, 90.0), clsas.BeamWindow(5.0, "hann")
    return [
        row("1024 x 1024, 20 degrees", lines, plane(1024, 1024), (8, 8), beam, -40),
        row("4096 x 1024, 20 degrees", long, plane(4096, 1024), None, beam, -40),
        row("4096 x 1024, 5 degrees", long, plane(4096, 1024), None, narrow, -40),
        row("1024 x 8192, 5 degrees", lines, plane(1024, 8192), None, narrow, -40),
        row("128 x 128, exact", lines, plane(128, 128), (1, 1), None, -60, exactly=True),
        row("1024 x 1024, exact", lines, plane(1024, 1024), (8, 8), beam, -60, exactly=True),
    ]


def row(
    name: str,
    lines: clsas.RangeLines,
    grid: clsas.Grid,
    patches: tuple[int, int] | None,
    beam: clsas.BeamWindow | None,
    error_db: float,
    *,
    exactly: bool = False,
) -> Row:
    """Measure one image; return its row of the table."""

    def mosaic(store: Path | None = None) -> clsas.Mosaic:
        request: dict[str, Any] = {"accuracy_db" if exactly else "tolerance_db": error_db}
        return clsas.mosaic(lines, grid, store, patches=patches, beam=beam, **request)

    def stored() -> None:
        with tempfile.TemporaryDirectory() as folder:
            for _ in mosaic(Path(folder) / "a.zarr"):
                pass

    def at_once() -> clsas.Image:
        if exactly:
            return clsas.backproject(lines, grid, accuracy_db=error_db, beam=beam)
        return clsas.factorize(lines, grid, error_db, beam=beam)

    times = in_turns([lambda: mosaic().image(), stored, at_once])
    ratios = " and ".join(f"{each / times[-1]:.2f}" for each in times[:-1])
    shape = " x ".join(map(str, mosaic().shape))
    return [name, shape, *(f"{each:.3f}" for each in times), ratios]


def in_turns(methods: list[Callable[[], object]]) -> list[float]:
    """Return the median times of some functions, seconds, called in turns."""
    for each in methods:
        each()  # compiles kernels
    times: list[list[float]] = [[] for _ in methods]
    for _ in range(ROUNDS):
        for method, found in zip(methods, times, strict=True):
            start = time.perf_counter()
            method()
            found.append(time.perf_counter() - start)
    return [float(np.median(each)) for each in times]


def plane(rows: int, columns: int) -> clsas.Grid:
    """Return a plane in front of the middle of the track."""
    half_m = STEP_M * (columns - 1) / 2
    last_m = NEAREST_M + STEP_M * (rows - 1)
    return clsas.Grid.plane((-half_m, half_m, columns), (NEAREST_M, last_m, rows))


def noise(channels: int, track_m: float, swath_m: float) -> clsas.RangeLines:
    """Return lines of noise, at 1.5 times its bandwidth, from a straight track."""
    near_m = NEAREST_M - 2
    count = round(swath_m / STEP_M)
    random = np.random.default_rng(1)
    samples = random.standard_normal((channels, 2 * count), np.float32).view(np.complex64)
    spectrum = scipy.fft.fft(samples, axis=1, overwrite_x=True)
    spectrum[:, np.abs(scipy.fft.fftfreq(count)) > 1 / 3] = 0
    at_m = np.zeros((channels, 3))
    at_m[:, 0] = np.linspace(-track_m / 2, track_m / 2, channels)
    samples = scipy.fft.ifft(spectrum, axis=1, overwrite_x=True)
    return clsas.RangeLines(samples, near_m, STEP_M, at_m, at_m, 100e3, 1500.0)
