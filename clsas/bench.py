"""Benchmarks: how fast and how accurate imaging is on a device."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from clsas import reference, validate
from clsas.backproject import execute, prepare
from clsas.device import Device, open_device
from clsas.grid import Grid
from clsas.lines import RangeLines
from clsas.scene import PointTargets
from clsas.simulate import simulate_lines

_PIXELS = 300  # random pixels at which errors are measured
_POINTS = 1000


@dataclass(frozen=True)
class Case:
    """A straight track over a scene of random points.

    Attributes
    ----------
    channels : int
        Monostatic phase centres.
    spacing_m : float
        Distance between them.
    carrier_hz, bandwidth_hz : float
        Band of the range lines, windowed by nothing and sampled at 1.25 bandwidths.
    x_m, y_m : (first, last)
        Extent of the image.
    pixels : int
        Along either side.
    """

    channels: int
    spacing_m: float
    carrier_hz: float
    bandwidth_hz: float
    x_m: tuple[float, float]
    y_m: tuple[float, float]
    pixels: int

    @property
    def grid(self) -> Grid:
        """The image's grid."""
        return Grid.plane((*self.x_m, self.pixels), (*self.y_m, self.pixels))

    def lines(self, seed: int = 1) -> RangeLines:
        """Return range lines of random points of complex amplitude all over the image."""
        random = np.random.default_rng(seed)
        along = (np.arange(self.channels) - (self.channels - 1) / 2) * self.spacing_m
        tx_m = np.stack([along, np.zeros_like(along), np.zeros_like(along)], axis=1)
        positions = np.zeros((_POINTS, 3))
        positions[:, 0] = random.uniform(*self.x_m, _POINTS)
        positions[:, 1] = random.uniform(*self.y_m, _POINTS)
        amplitudes = random.standard_normal(_POINTS) + 1j * random.standard_normal(_POINTS)
        return simulate_lines(
            tx_m,
            tx_m,
            PointTargets(positions, amplitudes),
            carrier_hz=self.carrier_hz,
            bandwidth_hz=self.bandwidth_hz,
            oversampling=1.25,
        )


CASES = {
    # THESIS chapter 5; its bandwidth is not given.
    "bp-thesis": Case(640, 8.25e-3, 1e6, 100e3, (-2.5, 2.5), (40.0, 45.0), 1024),
    "bp-2k": Case(2048, 15e-3, 120e3, 30e3, (-20.0, 20.0), (40.0, 80.0), 2048),
}


def run(
    case: str,
    *,
    device: Device | str | int | None = None,
    accuracy_db: float = -50.0,
    repeats: int = 5,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Measure exact backprojection on a built-in case.

    Parameters
    ----------
    case : str
        One of `CASES`.
    device : Device, str or int, optional
        See `clsas.device.choose`.
    accuracy_db : float
        As for `clsas.backproject`.
    repeats : int
        Timed runs, after one that builds the kernels.
    progress : callable, optional
        Called as progress(runs done, runs).

    Returns
    -------
    dict
        What was measured, ready for JSON. `seconds` are of the whole call of `clsas.backproject`:
        choosing the interpolation, upsampling the lines, references, transfers, kernels and
        reading the image back. `gbp_per_s` is from their median; GBP are 1e9 pixel-channel pairs.
        `kernel_seconds` is the device's time in the backprojection kernel alone (least of the
        runs), `gflop_per_s` its arithmetic and `share_of_peak` that over what a loop of
        independent multiply-adds reaches on the device. `rounding_error_db` compares random
        pixels with a float64 sum by the same interpolation, `true_error_db` with the ideal sum of
        band-limited lines.
    """
    validate.one_of("case", case, tuple(CASES))
    device = open_device(device)
    lines, grid = CASES[case].lines(), CASES[case].grid
    seconds, kernel_seconds = [], []
    for repeat in range(repeats + 1):
        with device.profile() as times:
            start = time.perf_counter()
            preparation = prepare(lines, grid, device=device, accuracy_db=accuracy_db)
            image = execute(preparation)
            seconds.append(time.perf_counter() - start)
        kernel_seconds.append(times["backproject_tiles"].total_s)
        if progress is not None:
            progress(repeat + 1, repeats + 1)
    del seconds[0], kernel_seconds[0]
    pairs = lines.channels * grid.size
    flops = flops_per_pair(preparation.interpolator.taps) * pairs / min(kernel_seconds)
    return {
        "case": case,
        "device": device.info.label,
        "driver": device.info.driver,
        "channels": lines.channels,
        "pixels": list(grid.shape),
        "accuracy_db": accuracy_db,
        "taps": preparation.interpolator.taps,
        "upsampling": round(preparation.resampling.ratio, 3),
        "seconds": {
            "median": statistics.median(seconds),
            "min": min(seconds),
            "max": max(seconds),
            "included": "all of clsas.backproject, from choosing the interpolation to readback",
        },
        "gbp_per_s": pairs / statistics.median(seconds) / 1e9,
        "kernel_seconds": min(kernel_seconds),
        "kernel_gbp_per_s": pairs / min(kernel_seconds) / 1e9,
        "gflop_per_s": flops / 1e9,
        "share_of_peak": flops / peak_flops(device),
        "predicted_error_db": preparation.interpolator.error_db,
        "rounding_error_db": reference.sampled_error_db(
            image, partial(reference.same_interpolator, preparation), pixels=_PIXELS
        ),
        "true_error_db": reference.sampled_error_db(
            image, partial(reference.ideal, lines), pixels=_PIXELS
        ),
    }


def flops_per_pair(taps: int) -> int:
    """Return the floating-point operations of cl/backproject.cl per pixel and channel.

    Counted in its source: 13 for the position, 25 for sine and cosine, 8 to turn and add, and per
    pair of taps 4 (taps/2 - 1) + 4 for the weights and 8 to apply them.
    """
    pairs = taps // 2
    return 46 + pairs * (4 * (pairs - 1) + 12)


def peak_flops(device: Device) -> float:
    """Return the rate at which a device does independent multiply-adds, flop/s (cl/peak.cl)."""
    width = device.info.width
    items, steps = 1 << 14, 1 << 12
    kernel = device.kernel("peak", "peak", WIDTH=width)
    result = device.buffer(4 * items)
    with device.profile() as times:
        for _ in range(6):
            device.run(kernel, (items,), steps, 0.5, result)
    return items * steps * 16 * width * 2 / times["peak"].minimum_s
