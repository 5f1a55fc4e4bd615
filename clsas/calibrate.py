"""Measuring what the parts of imaging cost on a device."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from itertools import product

import numpy as np
from scipy.optimize import nnls

from clsas import costs as stored
from clsas import interpolation, validate
from clsas.backproject import execute, prepare
from clsas.costs import Costs
from clsas.device import Device, open_device
from clsas.factorize import factorize
from clsas.grid import Grid
from clsas.lines import RangeLines
from clsas.planner import plan
from clsas.scene import PointTargets
from clsas.simulate import simulate_lines

_TOLERANCES_DB = (-25.0, -45.0, -60.0)
# Plans differ with what they are told that things cost: these have shallow trees and deep ones.
_TOLD = (Costs(pixel_ns=1e3), Costs(pixel_ns=1e3, leaf_ns=10.0))
_REPEATS = 3


def calibrate(
    device: Device | str | int | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> Costs:
    """Measure what imaging costs on a device, and store it for `clsas.plan`.

    Parameters
    ----------
    device : Device, str or int, optional
        See `clsas.device.choose`.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    Costs
        None below zero, fitted with least relative squares to the times of some images of a
        built-in scene, the least of three runs each.

    Raises
    ------
    DeviceError
        If there is no such device.
    OSError
        If the user's cache directory cannot be written.
    """
    validate.progress(progress)
    device = open_device(device)
    plans = list(product(_TOLERANCES_DB, _TOLD))
    sizes = ((500, 768), (1500, 512))
    total, done = len(sizes) * (len(plans) + 1), 0
    rows: list[tuple[np.ndarray, float]] = []
    host: list[tuple[np.ndarray, float]] = []
    pixel_ns, leaf_ns = [], []
    for channels, pixels in sizes:
        lines, grid = _scene(channels, pixels)
        preparation = prepare(lines, grid, device=device, accuracy_db=-50.0)
        seconds, _ = _timed(device, partial(execute, preparation))
        pairs = lines.channels * grid.size * interpolation.COST[preparation.interpolator.taps]
        pixel_ns.append(1e9 * seconds["backproject_tiles"] / pairs)
        for tolerance_db, told in plans:
            chosen = plan(lines, grid, tolerance_db=tolerance_db, device=device, costs=told)
            done += 1
            if progress is not None:
                progress(done, total)
            if chosen.is_exact:
                continue
            image = partial(factorize, lines, grid, chosen, device=device)
            seconds, wall = _timed(device, image)
            in_stages, at_end = seconds["stage"], seconds["backproject_tiles"]
            *stages, last = chosen.stages
            operations = sum(s.operations for s in stages)
            taps = chosen.align.taps + chosen.aperture.taps
            of_channels = sum(s.operations / s.samples for s in stages)
            rows.append((np.array([of_channels, operations, operations * taps]), in_stages))
            leaf_ns.append(1e9 * at_end / last.operations / interpolation.COST[chosen.final.taps])
            batches = -(-stages[0].subimages // chosen.roots_at_once)
            work = [
                lines.channels * chosen.resampling.length,
                stages[0].subimages * lines.channels,
                batches * len(stages),
            ]
            host.append((np.array(work, float), max(wall - in_stages - at_end, 0.0)))
        done += 1
        if progress is not None:
            progress(done, total)
    channel_ns, sample_ns, sample_tap_ns = _fitted(rows)
    upsampled_sample_ns, reference_ns, batch_ns = _fitted(host)
    costs = Costs(
        upsampled_sample_ns=upsampled_sample_ns,
        reference_ns=reference_ns,
        batch_ns=batch_ns,
        channel_ns=channel_ns,
        sample_ns=sample_ns,
        sample_tap_ns=sample_tap_ns,
        leaf_ns=float(np.median(leaf_ns)),
        pixel_ns=float(np.median(pixel_ns)),
    )
    stored.save(device, costs)
    return costs


def _scene(channels: int, pixels: int) -> tuple[RangeLines, Grid]:
    """Return lines of random points at 120 kHz and a grid over them, from 40 m."""
    random = np.random.default_rng(0)
    grid = Grid.plane((-8.0, 8.0, pixels), (40.0, 56.0, pixels))
    along = (np.arange(channels) - (channels - 1) / 2) * (20.0 / channels)
    tx_m = np.stack([along, 0 * along, 0 * along], axis=1)
    positions_m = random.uniform([-8, 40, 0], [8, 56, 0], (100, 3))
    lines = simulate_lines(
        tx_m,
        tx_m,
        PointTargets(positions_m, random.standard_normal(100)),
        carrier_hz=120e3,
        bandwidth_hz=30e3,
        oversampling=1.25,
    )
    return lines, grid


def _timed(device: Device, run: Callable[[], object]) -> tuple[dict[str, float], float]:
    """Return the least seconds in every kernel, and of the whole, after a run that builds them."""
    run()
    kernels: dict[str, float] = {}
    wholes = []
    for _ in range(_REPEATS):
        with device.profile() as times:
            start = time.perf_counter()
            run()
            wholes.append(time.perf_counter() - start)
        for name, each in times.items():
            kernels[name] = min(each.total_s, kernels.get(name, math.inf))
    return kernels, min(wholes)


def _fitted(rows: list[tuple[np.ndarray, float]]) -> list[float]:
    """Return the costs, nanoseconds, of least relative error: work times costs is seconds."""
    work, seconds = (np.array(column, float) for column in zip(*rows, strict=True))
    weight = 1 / np.maximum(seconds, 1e-6)
    scale = (work * weight[:, None]).max(axis=0)
    solution = nnls(work * weight[:, None] / scale, seconds * weight)[0]
    return [float(x) for x in 1e9 * solution / scale]
