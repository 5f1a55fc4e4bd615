"""Measurement of the costs of imaging on a device, from the times of a few images."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from itertools import product

import numpy as np
from scipy.optimize import nnls

from clsas.core import validate
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.opencl.device import Device, open_device
from clsas.planning import costs as stored
from clsas.planning import scaling
from clsas.planning.costs import Costs
from clsas.planning.exact_image import Exact
from clsas.planning.planner import plan
from clsas.planning.timed_images import (
    TimedImage,
    exact_image,
    planned_image,
    scene,
    with_relief,
)
from clsas.plans.plan import Plan
from clsas.sonar.beam import BeamWindow

_SIZES = ((500, 768), (1500, 512))
"""Channels, and pixels along either side, of the images that are formed exactly and factorized."""
_SMALL_SIZES = ((100, 128), (400, 256))
"""The same of images that are formed exactly only."""
_TOLERANCES_DB = (-25.0, -45.0, -60.0)
# With these costs the planner chooses shallow trees and deep ones, whose times differ enough to
# determine all costs.
_PLANNED_WITH = (Costs(pixel_ns=1e3, point_ns=1e3), Costs(pixel_ns=1e3, leaf_ns=10.0))
_WIDE = BeamWindow(120.0, "hann")  # touches every pixel from every channel

_ROUNDS = 4
"""Timed runs of every image; the fastest counts."""
_PRIOR = 0.3
"""Weight of a cost's relative deviation from the default, against relative misfits of times."""
_MOST_SCATTER = 0.2  # rms log ratio of the best times of even and odd runs; else not stored
_MOST_MISFIT = 0.35  # rms log ratio of predicted and measured times; else not stored

_HOST = (
    "call_ns",
    "upsampled_sample_ns",
    "filtered_sample_ns",
    "reference_ns",
    "batch_ns",
    "group_ns",
    "part_ns",
)
_STAGES = scaling.GROUPS["stages"]
_PIXELS = ("pixel_ns", "point_ns")


def calibrate(
    device: Device | str | int | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> Costs:
    """Return the measured costs of imaging on a device, and store them for `clsas.plan`.

    Parameters
    ----------
    device : Device, str or int, optional
        See `clsas.opencl.device.choose`.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    Costs
        Costs per unit of each kind of work: a non-negative least-squares fit to relative times of
        images of a built-in scene. The images are formed in turns, and the fastest run of each
        counts. Costs that these times do not determine keep the proportions of
        `clsas.planning.costs.defaults`.

    Raises
    ------
    DeviceError
        If the device does not exist.
    OSError
        If the user's cache directory cannot be written.

    Warns
    -----
    ClsasWarning
        If times scatter from run to run, or differ from those that the costs predict. The costs are
        then returned but not stored, and previously stored costs remain.
    """
    validate.progress(progress)
    device = open_device(device)
    images = _images(device)
    total = len(images) * (1 + _ROUNDS)
    for done in range(total):
        image = images[done % len(images)]
        if done < len(images):  # this builds the kernels
            image.form()
        else:
            image.run(device)
        if progress is not None:
            progress(done + 1, total)
    costs = _fitted(images, stored.defaults(device))
    scatter = _rms([image.scatter for image in images])
    misfit = _rms(
        [math.log(costs.seconds(image.expected.work) / min(image.seconds)) for image in images]
    )
    wrong = []
    if not scatter <= _MOST_SCATTER:
        wrong.append(f"times of the same image differ by {math.expm1(scatter):.0%} between runs")
    if not misfit <= _MOST_MISFIT:
        wrong.append(f"the costs miss the times measured by {math.expm1(misfit):.0%}")
    if wrong:
        validate.warn(
            f"measured costs are not stored: {' and '.join(wrong)}; calibrate again when the "
            "machine is idle"
        )
    else:
        stored.save(device, costs)
    return costs


def _images(device: Device) -> list[TimedImage]:
    """Return the images to be timed."""
    images = []

    def factorized(lines: RangeLines, grid: Grid, tolerance_db: float, planned_with: Costs) -> None:
        chosen = plan(lines, grid, tolerance_db=tolerance_db, device=device, costs=planned_with)
        if not chosen.is_exact:
            images.append(planned_image(device, lines, grid, chosen))

    for channels, pixels in _SIZES:
        lines, grid = scene(channels, pixels)
        images += [exact_image(device, lines, grid), exact_image(device, lines, grid, _WIDE)]
        for tolerance_db, planned_with in product(_TOLERANCES_DB, _PLANNED_WITH):
            factorized(lines, grid, tolerance_db, planned_with)
            if planned_with is _PLANNED_WITH[0]:
                factorized(lines, with_relief(grid), tolerance_db, planned_with)
    for channels, pixels in _SMALL_SIZES:
        lines, grid = scene(channels, pixels)
        images += [exact_image(device, lines, each) for each in (grid, with_relief(grid))]
    return images


def _fitted(images: list[TimedImage], usual: Costs) -> Costs:
    """Return costs fitted to the best times of images, with a prior of `usual` proportions."""
    plans = [image for image in images if isinstance(image.expected, Plan)]
    exact = [image for image in images if isinstance(image.expected, Exact)]
    tiled = [image for image in plans if image.tiled]

    def per_pixel(some: list[TimedImage]) -> float:
        return float(np.median([1e9 * image.in_pixels / _pixel_work(image) for image in some]))

    least_squares = partial(_least_squares, usual)
    leaves = least_squares(
        ("leaf_channel_ns", "leaf_ns"),
        [image.work(("leaf_channel_ns", "leaf_ns")) for image in tiled],
        [image.in_pixels for image in tiled],
    )
    # Lines of leaves off a plane take as long as those on a plane.
    of_points = [image for image in plans if not image.tiled]
    channel_s = 1e-9 * leaves["leaf_channel_ns"]
    points = least_squares(
        ("leaf_point_ns", "leaf_gathered_ns"),
        [image.work(("leaf_point_ns", "leaf_gathered_ns")) for image in of_points],
        [i.in_pixels - channel_s * sum(i.work(("leaf_channel_ns",))) for i in of_points],
    )
    pixel_ns = per_pixel([image for image in exact if image.tiled and not image.is_weighted])
    weighted = [image for image in exact if image.is_weighted]
    of_beam = [1e9 * image.in_pixels - pixel_ns * _pixel_work(image) for image in weighted]
    pairs = [float(image.expected.work.beam) for image in weighted]
    return Costs(
        **least_squares(
            _HOST, [image.work(_HOST) for image in images], [image.elsewhere for image in images]
        ),
        **least_squares(
            _STAGES,
            [image.work(_STAGES) for image in plans],
            [image.in_stages for image in plans],
        ),
        **leaves,
        **points,
        pixel_ns=pixel_ns,
        point_ns=per_pixel([i for i in exact if not i.tiled]),
        beam_ns=max(float(np.median(np.divide(of_beam, pairs))), 0.0),
    )


def _pixel_work(image: TimedImage) -> float:
    """Return pixels times channels of an exact image, weighted by the time relative to 4 taps."""
    return sum(image.work(_PIXELS))


def _least_squares(
    usual: Costs, names: tuple[str, ...], work: list[list[float]], seconds: list[float]
) -> dict[str, float]:
    """Return the costs in nanoseconds whose predictions are closest to `seconds`."""
    usual_ns = np.array([getattr(usual, name) for name in names])
    rows = 1e-9 * np.array(work) * usual_ns / np.maximum(seconds, 1e-6)[:, None]
    # The device's speed relative to the usual costs is the prior of every single cost.
    faster = 1 / np.exp(np.mean(np.log(rows.sum(axis=1))))
    rows = np.concatenate([rows * faster, _PRIOR * np.eye(len(names))])
    wanted = np.concatenate([np.ones(len(seconds)), np.full(len(names), _PRIOR)])
    solution = nnls(rows, wanted)[0]
    return dict(zip(names, (usual_ns * faster * solution).tolist(), strict=True))


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
