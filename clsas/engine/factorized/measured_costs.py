"""Costs of a device: defaults, scaled by a measurement of 0.3 to 0.6 s, and stored in a cache.

Devices differ mostly in the speed of each kernel, and hosts in their speed as a whole. Costs of the
same kernel keep their default proportions. Three small images are therefore enough to determine a
factor for each group of costs: an exact one on a plane, an exact one off it, and a factorized one.
"""

from __future__ import annotations

import functools
import json
import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import UTC, datetime
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from clsas.engine.data import reading, validate
from clsas.engine.data.atomic import replacing
from clsas.engine.data.cache import cache_folder, private_folder, trusted_cache
from clsas.engine.data.decibels import power
from clsas.engine.data.digests import is_intact, with_digest
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.version import __version__
from clsas.engine.device.buffers import padded_length, upsampled_lines
from clsas.engine.device.device import Device, DeviceInfo
from clsas.engine.factorized.candidates import Conditions, fastest_plan
from clsas.engine.factorized.costs import (
    Costs,
    ExactPrediction,
    KnownCosts,
    defaults,
    predict_exact,
)
from clsas.engine.factorized.plan import Plan, Work
from clsas.engine.factorized.sampled import SampledRoots, SampledScene
from clsas.engine.factorized.search import Choices
from clsas.engine.forming import form, form_exactly, scene_of_plan
from clsas.engine.scene import Scene
from clsas.engine.signal import interpolation
from clsas.engine.signal.interpolation import Resampling

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
_CHOICES = Choices(align_taps=(4,), aperture_taps=(6,), stages=(2,))
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
        return _scaled_once(device, path())


@functools.cache
def _scaled_once(device: Device, path: Path) -> KnownCosts:
    """Return the default costs scaled to a device, and store them in the file `path`."""
    costs = measure(device).of(defaults(device))
    try:
        save(device, costs)
    except OSError as error:
        validate.warn(
            f"costs measured on {device.info.label} cannot be stored, so that every process "
            f"measures them again, which takes {_BUDGET_S:g} to {2 * _BUDGET_S:g} s: {error}"
        )
        return KnownCosts(costs, "scaled")
    return load(device)


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
    found = images.scale(defaults(device), images.transform_s(info.width))
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
    sampled = SampledScene.of(scene, power(_TOLERANCE_DB))
    assert sampled is not None
    conditions = Conditions(
        _TOLERANCE_DB,
        predict_exact(scene, _TOLERANCE_DB, device),
        device.for_stages(),
        _PLANNED_WITH,
        device.info.usable_bytes,
    )
    found = fastest_plan(SampledRoots.of(sampled, None), conditions, math.inf, _CHOICES).plan
    assert found is not None  # the scene is made so
    # A kernel takes twice as long if it is the first to touch a buffer, which matters less in large
    # images, of many batches.
    method = replace(found.factorization, roots_at_once=_ROOTS, roots_prepared=8 * _ROOTS)
    found = replace(found, method=method)
    factorized = planned_image(device, lines, grid, found)
    resampling = interpolation.resampling(lines.length, found.factorization.final, scene.spectrum)
    images = _Images(exact, points, factorized, lines, resampling)
    for image in images.timed:
        image.run(device)  # builds the kernels, which their own times do not include
    return images, sum(image.seconds[0] for image in images.timed)


def _seconds(act: Callable[[], object]) -> float:
    """Return the time that a call takes."""
    start = time.perf_counter()
    act()
    return time.perf_counter() - start


# Images that are timed

_SOUND_M_S = 1500.0
_CARRIER_HZ, _SAMPLE_RATE_HZ, _BAND = 120e3, 37.5e3, 0.8
"""Carrier, sample rate, and the share of the sampled band that the lines fill."""
_NEAREST_M, _TRACK_M, _PIXEL_M = 40.0, 20.0, 0.02
_MARGIN_M = 1.0  # of range, on either side of the grid
_RELIEF_M = 0.5  # of dunes as long as a quarter of the grid; too large for any plan to leave out
_REPEATED = 0.1  # largest relative difference of times that count as equal
EXACT_DB = -50.0
"""Accuracy of the exact images."""


@dataclass(frozen=True, eq=False)
class TimedImage:
    """An image to be timed, with its prediction and its times.

    Attributes
    ----------
    form : callable
        Forms the image.
    expected : Plan or ExactPrediction
        Prediction of the image.
    seconds : list of float
        Times of the runs.
    kernels : list of dict
        Times of the kernels by name, run by run.
    """

    form: Callable[[], object]
    expected: Plan | ExactPrediction
    seconds: list[float] = field(default_factory=list)
    kernels: list[dict[str, float]] = field(default_factory=list)

    def run(self, device: Device) -> None:
        """Form the image once more, and record the times of the run and of its kernels."""
        with device.profile() as times:
            start = time.perf_counter()
            self.form()
            self.seconds.append(time.perf_counter() - start)
        self.kernels.append({name: each.total_s for name, each in times.items()})

    @property
    def in_stages(self) -> float:
        """Least time of the stages' kernels, seconds."""
        return self.in_kernels("stage")

    @property
    def in_pixels(self) -> float:
        """Least time of the backprojecting kernels, seconds."""
        return self.in_kernels("backproject_tiles", "backproject_points")

    def in_kernels(self, *names: str) -> float:
        """Return the least time of some kernels in a run, seconds."""
        return min(sum(each.get(name, 0.0) for name in names) for each in self.kernels)

    @property
    def in_host(self) -> float:
        """Least time of a run without its kernels, seconds."""
        runs = zip(self.seconds, self.kernels, strict=True)
        return min(seconds - sum(kernels.values()) for seconds, kernels in runs)

    @property
    def repeats(self) -> bool:
        """True if the kernels take the same time, in all, in the two shortest of several runs."""
        shortest_s, next_s = sorted(sum(each.values()) for each in self.kernels)[:2]
        return next_s < (1 + _REPEATED) * shortest_s

    def work(self, names: Sequence[str]) -> list[float]:
        """Return the amounts of work to which costs of some names apply."""
        work: Work = self.expected.work
        return [float(getattr(work, name.removesuffix("_ns"))) for name in names]

    def predicted_s(self, costs: Costs, names: Sequence[str]) -> float:
        """Return the time that costs of some names predict, seconds."""
        amounts = zip(names, self.work(names), strict=True)
        return 1e-9 * sum(getattr(costs, name) * amount for name, amount in amounts)


def square(pixels: int) -> Grid:
    """Return a square grid beside the track of `noise`."""
    half_m = _PIXEL_M * pixels / 2
    return Grid.plane((-half_m, half_m, pixels), (_NEAREST_M, _NEAREST_M + 2 * half_m, pixels))


def noise(channels: int, pixels: int) -> tuple[RangeLines, Grid]:
    """Return lines of noise from a straight track, and a square grid beside it.

    Times do not depend on samples, and noise takes a hundredth of the time of a simulation. The
    noise fades towards the ends of the lines.
    """
    random = np.random.default_rng(0)
    half_m = _PIXEL_M * pixels / 2
    tx_m = np.zeros((channels, 3))
    tx_m[:, 0] = (np.arange(channels) - (channels - 1) / 2) * (_TRACK_M / channels)
    farthest_m = math.hypot(_NEAREST_M + 2 * half_m, half_m + _TRACK_M / 2)
    step_m = _SOUND_M_S / (2 * _SAMPLE_RATE_HZ)
    length = math.ceil((farthest_m - _NEAREST_M + 2 * _MARGIN_M) / step_m)
    spectrum = random.standard_normal((channels, length, 2)) @ [1, 1j]
    spectrum[:, np.abs(np.fft.fftfreq(length)) > _BAND / 2] = 0
    samples = np.fft.ifft(spectrum) * np.hanning(length)
    lines = RangeLines(
        samples,
        first_range_m=_NEAREST_M - _MARGIN_M,
        range_step_m=step_m,
        tx_m=tx_m,
        rx_m=tx_m,
        carrier_hz=_CARRIER_HZ,
        sound_speed_m_s=_SOUND_M_S,
    )
    return lines, square(pixels)


def with_relief(grid: Grid) -> Grid:
    """Return a plane raised by dunes, whose pixels form groups instead of tiles."""
    rows, columns = (np.sin(np.linspace(0, 8 * np.pi, count)) for count in grid.shape)
    return grid.with_height(_RELIEF_M / 2 * rows[:, None] * columns)


def exact_image(device: Device, lines: RangeLines, grid: Grid) -> TimedImage:
    """Return an exact image to be timed."""
    expected = predict_exact(Scene.of(lines, grid, None, None), EXACT_DB, device)
    exactly = partial(form_exactly, lines, grid, device=device, accuracy_db=EXACT_DB)
    return TimedImage(exactly, expected)


def planned_image(device: Device, lines: RangeLines, grid: Grid, chosen: Plan) -> TimedImage:
    """Return an image by a plan to be timed as a first one: nothing is kept from run to run."""
    return TimedImage(lambda: form(scene_of_plan(lines, grid, chosen), chosen, device), chosen)


# The user's cache


def path() -> Path:
    """Return the path of the file of measured costs."""
    return cache_folder() / "costs.json"


def load(device: Device | DeviceInfo) -> KnownCosts:
    """Return the stored costs of a device and its driver, or else `defaults`.

    Warns
    -----
    ClsasWarning
        If the file of costs cannot be read or does not contain costs, or other users can write to
        the cache folder.
    """
    info = device.info if isinstance(device, Device) else device
    default = KnownCosts(defaults(info), "default")
    try:
        table = _tables().get(key(info))
        return default if table is None else _known(table)
    except (OSError, ValueError, KeyError, TypeError) as error:
        validate.warn(f"costs stored in {path()} are ignored: {_reason(error)}")
        return default


def save(device: Device, costs: Costs) -> Path:
    """Store the costs of a device that were scaled to it, and return the path of the file.

    The file is replaced as a whole, so that another process reads either the old or the new one.

    Raises
    ------
    OSError
        If the user's cache folder cannot be written, or other users can write to it.
    """
    file = private_folder() / path().name
    try:
        stored = _tables()
    except (OSError, ValueError):
        stored = {}  # whoever reads the file is warned
    measured = datetime.now(UTC).isoformat(timespec="seconds")
    table = {"source": "scaled", "measured": measured, "costs": asdict(costs)}
    stored[key(device.info)] = with_digest(table)
    with replacing(file) as temporary:
        temporary.write_text(json.dumps(stored, indent=1))
    return file


def key(info: DeviceInfo) -> str:
    """Return the key of stored costs: device, driver, cores, how kernels are built, and version."""
    lookup = ", permuting" if info.permute else ""
    return (
        f"{info.label}, {info.driver}, {info.compute_units} compute units, {info.width} lanes"
        f"{lookup}, clsas {__version__}"
    )


def _tables() -> dict[str, Any]:
    """Return the stored tables by key; raise OSError or ValueError if the file has none."""
    try:
        stored = reading.parse_json(reading.read_bytes(trusted_cache() / path().name))
    except (FileNotFoundError, NotADirectoryError):
        return {}
    if not isinstance(stored, dict):
        raise ValueError(f"it must hold tables by device, got {validate.shown(stored)}")
    return stored


def _known(table: dict[str, Any]) -> KnownCosts:
    """Return costs from their stored table; raise an error if `save` did not write it."""
    names = [field.name for field in fields(Costs)]
    costs = {name: validate.number(name, table["costs"][name], "ns") for name in names}
    if table["source"] != "scaled" or not table["measured"]:
        raise ValueError("costs must be scaled, at a time")
    if not is_intact(table):
        raise ValueError("costs do not match their digest")
    return KnownCosts(Costs(**costs), "scaled", table["measured"])


def _reason(error: Exception) -> str:
    return f"{error} is missing" if isinstance(error, KeyError) else str(error)
