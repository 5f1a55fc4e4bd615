"""Images that are timed to measure the costs of work on a device."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.forming import form, form_exactly, scene_of_plan
from clsas.opencl.device import Device
from clsas.planning.costs import Costs
from clsas.planning.exact_image import Exact, expect
from clsas.plans.plan import Plan
from clsas.plans.predictions import Work
from clsas.scene import Scene

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
    expected : Plan or Exact
        Prediction of the image.
    seconds : list of float
        Times of the runs.
    kernels : list of dict
        Times of the kernels by name, run by run.
    """

    form: Callable[[], object]
    expected: Plan | Exact
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
    expected = expect(Scene.of(lines, grid, None, None), EXACT_DB, device, None)
    exactly = partial(form_exactly, lines, grid, device=device, accuracy_db=EXACT_DB)
    return TimedImage(exactly, expected)


def planned_image(device: Device, lines: RangeLines, grid: Grid, chosen: Plan) -> TimedImage:
    """Return an image by a plan to be timed as a first one: nothing is kept from run to run."""
    return TimedImage(lambda: form(scene_of_plan(lines, grid, chosen), chosen, device), chosen)
