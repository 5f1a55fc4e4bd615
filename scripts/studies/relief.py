"""Time of heights from two banks, against that of one image, on speckle of a known relief."""

from __future__ import annotations

import statistics
import time

import numpy as np

import clsas
from clsas.interferometry.refinement import PASSES
from clsas.simulation.scenes import Observer

SIDES = (512, 1024)
PIXEL_M, NEAR_M, ALTITUDE_M, BASELINE_M = 0.01, 28.0, 12.0, 0.25
CARRIER_HZ, BAND_HZ = 100e3, 30e3
PINGS, APERTURE_M = 1000, 10.0  # 1 cm apart, so that no grating lobes fall into the scene
SEARCH_M = (-3.0, 3.0)  # 20 heights at six per height of ambiguity
DENSITY_M2 = 500.0
TOLERANCE_DB = -40.0
REPEATS = 5
COLUMNS = [
    "pixels", "image s", "sweep s", "refinement s", "heights over image", "valid %",
    "rms error mm", "rms deviation mm",
]  # fmt: skip
Row = list[object]


def rows(device: str) -> list[Row]:
    """Return times and errors for scenes of several sizes.

    The image is a factorized one of one bank on the plane, planned once. Heights include all plans.
    """
    return [_row(side, device) for side in SIDES]


def _row(side: int, device: str) -> Row:
    half_m = side * PIXEL_M / 2
    x_m, y_m = (-half_m, half_m), (NEAR_M, NEAR_M + 2 * half_m)
    grid = clsas.Grid.plane((*x_m, side), (*y_m, side))
    lower, upper = _banks(x_m, y_m)
    plan = clsas.plan(lower, grid, tolerance_db=TOLERANCE_DB, device=device)
    image_s = []
    with clsas.Imager(lower, grid, plan, device=device) as imager:
        for turn in range(REPEATS + 1):
            start = time.perf_counter()
            imager(lower)
            if turn:  # the first builds kernels
                image_s.append(time.perf_counter() - start)
    steps: list[tuple[int, int, float]] = []
    start = time.perf_counter()
    found = clsas.heights(
        lower, upper, grid, search_m=SEARCH_M, tolerance_db=TOLERANCE_DB, device=device,
        progress=lambda done, total: steps.append((done, total, time.perf_counter())),
    )  # fmt: skip
    end = time.perf_counter()
    swept = next(at for done, total, at in steps if done >= total - PASSES)
    error_m = (found.height_m - _relief(*np.meshgrid(*grid.axes_m)))[found.mask]
    one_s = statistics.median(image_s)
    return [
        f"{side} x {side}", f"{one_s:.3g}", f"{swept - start:.3g}", f"{end - swept:.3g}",
        f"{(end - start) / one_s:.0f}", f"{100 * found.mask.mean():.0f}",
        f"{1e3 * np.sqrt(np.mean(error_m**2)):.1f}",
        f"{1e3 * np.sqrt(np.mean(found.sd_m[found.mask] ** 2)):.1f}",
    ]  # fmt: skip


def _relief(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return dunes on a gentle slope, metres."""
    return 0.1 * (y - NEAR_M - 2.5) + 0.15 * np.sin(2 * np.pi * (y + 0.4 * x) / 4)


def _banks(x_m: tuple[float, float], y_m: tuple[float, float]) -> list[clsas.RangeLines]:
    """Return the lines of both banks."""
    x, y = (np.arange(first - 1.0, last + 1.0, 0.04) for first, last in (x_m, y_m))
    heights_m = _relief(*np.meshgrid(x, y))
    seabed = clsas.Seabed((x[0], x[-1]), (y[0], y[-1]), heights_m, density_m2=DENSITY_M2)
    points = clsas.PointTargets(*seabed.visible(Observer(np.array([0.0, 0.0, ALTITUDE_M]))))
    tx_m = np.outer(np.linspace(-0.5, 0.5, PINGS) * APERTURE_M, [1, 0, 0]) + [0, 0, ALTITUDE_M]
    return [
        clsas.simulate_lines(
            tx_m, tx_m + [0, 0, up_m], points, carrier_hz=CARRIER_HZ, bandwidth_hz=BAND_HZ,
            window="hamming",
        )
        for up_m in (0.0, BASELINE_M)
    ]  # fmt: skip
