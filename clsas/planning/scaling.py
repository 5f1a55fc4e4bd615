"""Costs of a device: defaults, scaled by a measurement of 0.3 to 0.6 s.

Devices differ mostly in the speed of each kernel, and hosts in their speed as a whole. Costs of the
same kernel keep their default proportions. Three small images are therefore enough to determine a
factor for each group of costs: an exact one on a plane, an exact one off it, and a factorized one.
"""

from __future__ import annotations

import functools
import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import cycle
from pathlib import Path

from clsas.core import validate
from clsas.core.decibels import power
from clsas.core.lines import RangeLines
from clsas.opencl.buffers import padded_length, upsampled_lines
from clsas.opencl.device import Device
from clsas.planning import costs as stored
from clsas.planning.costs import Costs, KnownCosts
from clsas.planning.exact_image import expect
from clsas.planning.fastest import fastest
from clsas.planning.prediction import Conditions
from clsas.planning.search import Allowed
from clsas.planning.timed_images import (
    TimedImage,
    exact_image,
    noise,
    planned_image,
    square,
    with_relief,
)
from clsas.planning.visibility_model import model_of
from clsas.scene import Scene
from clsas.signal import interpolation
from clsas.signal.interpolation import Resampling
from clsas.signal.spectrum import OUTSIDE

GROUPS = {
    "host": ("call_ns", "reference_ns", "batch_ns", "group_ns", "part_ns"),
    "transforms": ("upsampled_sample_ns",),
    "filters": ("filtered_sample_ns",),
    "stages": (
        "subimage_ns",
        "line_ns",
        "sample_ns",
        "sample_tap_ns",
        "single_sample_ns",
        "given_sample_ns",
    ),
    "leaves": ("leaf_channel_ns", "leaf_ns"),
    "pixels": ("pixel_ns", "beam_ns"),
    "points": ("point_ns", "leaf_point_ns", "leaf_gathered_ns"),
}
"""Costs that are scaled by the same factor, by field of `Scale`."""

_BUDGET_S = 0.3
"""Time of the measurement without building kernels; up to twice this if times do not repeat."""
# Time of the exact image's kernel: half of it is too short for a device to settle. Images are made
# larger if the kernel takes less than the second time.
_KERNEL_S, _LEAST_KERNEL_S = 0.01, 0.003
_LARGER = 3  # sides of the factorized image over those of the exact one: kernels take as long
_ROOTS = 2  # of a batch of the factorized image
_LEAST_S = 1e-6  # lower limit of times, so that factors are positive
_CHANNELS = 192
_LEAST_PIXELS, _MOST_PIXELS = 192, 1024  # along either side of the exact images
_TOLERANCE_DB = -45.0
_PLANNED_WITH = Costs(pixel_ns=1e3, point_ns=1e3)  # so that an image is factorized
_ALLOWED = Allowed(align_taps=(4,), aperture_taps=(6,), stages=(2,))
_measuring = threading.Lock()


@dataclass(frozen=True)
class Scale:
    """Factors by which a device and its host are slower than the default costs.

    Attributes
    ----------
    host, transforms : float
        Work of the host: everything but FFTs, and FFTs.
    filters, stages, leaves, pixels, points : float
        Kernels that upsample lines, that combine them in stages, that backproject leaves on a
        plane, exact images on a plane, and any image off a plane.
    """

    host: float
    transforms: float
    filters: float
    stages: float
    leaves: float
    pixels: float
    points: float

    def __post_init__(self) -> None:
        """Check every factor."""
        for each in fields(self):
            validate.positive(each.name, getattr(self, each.name))

    def over(self, other: Scale) -> Scale:
        """Return these factors divided by others."""
        return Scale(*(mine / vars(other)[name] for name, mine in vars(self).items()))

    def of(self, usual: Costs) -> Costs:
        """Return default costs scaled to the device."""
        return usual.times(
            {name: getattr(self, group) for group, names in GROUPS.items() for name in names}
        )


_SMALL = {
    16: Scale(0.78, 0.78, 0.8, 0.93, 0.95, 0.75, 0.85),
    8: Scale(1.0, 0.65, 1.3, 1.1, 1.1, 1.08, 0.6),
    1: Scale(1.0, 1.0, 1.0, 1.2, 1.2, 0.54, 2.15),
}
"""Times of these images relative to those of large ones, by lanes of a CPU: lines fit a cache, but
buffers are touched for the first time. Geometric means over the cases of `scripts/bench
predictions` on PoCL with AVX-512 and on Intel's runtime with AVX-512; for 8 lanes, PoCL on a
virtual Zen 4, whose scheduler slows short kernels by up to two: stages and leaves count halfway
between that and the kernels' processor times."""


def scaled(device: Device) -> KnownCosts:
    """Return the default costs scaled to a device, and store them.

    A process measures a device once, even if the costs cannot be stored. Other threads wait for the
    measurement.

    Warns
    -----
    ClsasWarning
        If the costs cannot be stored.
    """
    with _measuring:
        return _scaled_once(device, stored.path())


@functools.cache
def _scaled_once(device: Device, path: Path) -> KnownCosts:
    """Return the default costs scaled to a device, and store them in the file `path`."""
    costs = measure(device).of(stored.defaults(device))
    try:
        stored.save(device, costs)
    except OSError as error:
        validate.warn(
            f"costs measured on {device.info.label} cannot be stored, so that every process "
            f"measures them again, which takes {_BUDGET_S:g} to {2 * _BUDGET_S:g} s: {error}"
        )
        return KnownCosts(costs, "scaled")
    return stored.load(device)


def measure(device: Device) -> Scale:
    """Return the measured speed of a device and its host relative to the default costs.

    The measurement takes 0.3 to 0.6 s, and the time to build kernels. Images are larger on fast
    devices. They are formed in turns, and the fastest run of each counts. Images whose two fastest
    runs differ are timed for as long again, because a scheduler that keeps the threads of a short
    kernel on one core makes it take twice as long.
    """
    # The measurement has events of its own, so that profiles of the device do not include it.
    device = replace(device, _events=None)
    start = time.perf_counter()
    side = _LEAST_PIXELS
    images, building_s = _built(device, side)
    images.exact.run(device)  # in the first run, buffers had not been touched before
    if images.exact.in_pixels < _LEAST_KERNEL_S:
        larger = side * math.sqrt(_KERNEL_S / max(images.exact.in_pixels, _LEAST_S))
        images, again_s = _built(device, 64 * round(min(larger, _MOST_PIXELS) / 64))
        building_s += again_s
    end_s = start + building_s + _BUDGET_S
    _take_turns(images.timed, device, end_s)
    end_s = max(end_s, time.perf_counter()) + _BUDGET_S
    _take_turns([image for image in images.timed if not image.repeats], device, end_s)
    info = device.info
    found = images.scale(stored.defaults(device), images.transform_s(info.width))
    small = _SMALL.get(info.width) if info.kind == "cpu" else None
    return found if small is None else found.over(small)


def _take_turns(images: Sequence[TimedImage], device: Device, end_s: float) -> None:
    """Time images in turns, each at least twice, until the next run would end after `end_s`."""
    for image in cycle(images):
        everyone_twice = all(len(each.seconds) > 1 for each in images)
        if everyone_twice and time.perf_counter() + image.seconds[-1] > end_s:
            break
        image.run(device)


@dataclass(frozen=True, eq=False)
class _Images:
    """Images that are timed.

    Attributes
    ----------
    exact, points, factorized : TimedImage
        Exact images on a plane and off it, and a factorized one of three times the sides.
    lines : RangeLines
    resampling : Resampling
        How the exact images upsample the lines.
    """

    exact: TimedImage
    points: TimedImage
    factorized: TimedImage
    lines: RangeLines
    resampling: Resampling

    @property
    def timed(self) -> tuple[TimedImage, ...]:
        """All images, the one whose kernels scatter most first."""
        return self.factorized, self.exact, self.points

    def transform_s(self, width: int) -> float:
        """Return the time that the host needs to upsample the lines, seconds per sample."""
        samples, pitch = self.lines.samples, padded_length(self.resampling)
        seconds = min(
            _seconds(lambda: upsampled_lines(samples, self.resampling, width, 0, pitch))
            for _ in range(2)
        )
        return seconds / (len(samples) * self.resampling.length)

    def scale(self, usual: Costs, sample_s: float) -> Scale:
        """Return the factors by which times differ from those of the usual costs.

        `sample_s` is the time that the host needs per upsampled sample.
        """
        factorized, exact, points = self.timed
        transformed = sum(sum(image.work(GROUPS["transforms"])) for image in self.timed)
        host_s = sum(image.in_host for image in self.timed) - transformed * sample_s

        def slower(seconds: float, group: str, *images: TimedImage) -> float:
            usual_s = sum(image.predicted_s(usual, GROUPS[group]) for image in images)
            return max(seconds, _LEAST_S) / usual_s

        return Scale(
            host=slower(host_s, "host", *self.timed),
            transforms=1e9 * sample_s / usual.upsampled_sample_ns,
            filters=slower(factorized.in_kernels("upsample_lines"), "filters", factorized),
            stages=slower(factorized.in_stages, "stages", factorized),
            leaves=slower(factorized.in_pixels, "leaves", factorized),
            pixels=slower(exact.in_pixels, "pixels", exact),
            points=slower(points.in_pixels, "points", points),
        )


def _built(device: Device, side: int) -> tuple[_Images, float]:
    """Return images of `side` pixels along a side, formed once, and the time that this took."""
    lines, grid = noise(_CHANNELS, _LARGER * side)
    exact = exact_image(device, lines, square(side))
    points = exact_image(device, lines, with_relief(square(3 * side // 4)))
    scene = Scene.of(lines, grid, None, None)
    model = model_of(scene, OUTSIDE * power(_TOLERANCE_DB))
    assert model is not None
    room = device.info.memory_bytes // 2
    competing = expect(scene, _TOLERANCE_DB, device, model)
    conditions = Conditions(_TOLERANCE_DB, competing, device.for_stages(), _PLANNED_WITH, room)
    found = fastest(model, conditions, math.inf, _ALLOWED).plan
    assert found is not None  # the scene is made so
    # A kernel takes twice as long if it is the first to touch a buffer, which matters less in large
    # images, of many batches.
    method = replace(found.factorization, roots_at_once=_ROOTS, roots_prepared=8 * _ROOTS)
    found = replace(found, method=method)
    factorized = planned_image(device, lines, grid, found)
    resampling = interpolation.resampling(lines.length, found.factorization.final, model.spectrum)
    images = _Images(exact, points, factorized, lines, resampling)
    for image in images.timed:
        image.run(device)  # builds the kernels, which their own times do not include
    return images, sum(image.seconds[0] for image in images.timed)


def _seconds(act: Callable[[], object]) -> float:
    """Return the time that a call takes."""
    start = time.perf_counter()
    act()
    return time.perf_counter() - start
