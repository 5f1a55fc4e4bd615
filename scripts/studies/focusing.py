"""Autofocus of lines whose true track it does not know."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, wavelength_m
from clsas.engine.data.system import Pulse, Sonar
from clsas.engine.data.track import Track
from clsas.engine.device.device import Device
from clsas.engine.forming import form_exactly
from clsas.engine.imaging import factorize
from clsas.engine.signal.compression import compress
from clsas.files.phase_histories import read_phase_history
from clsas.navigation.autofocus import IMAGE_TOLERANCE_DB, Autofocus, autofocus
from clsas.navigation.responses import Passage
from clsas.simulation.scenes import PointTargets
from clsas.simulation.simulator import simulate
from studies.navigating import detrended, said_to_be_on

WAVELENGTH_M = 0.015
PINGS, STEP_M = 400, 0.02
GRID = Grid.plane(x=(1.5, 6.5, 320), y=(18.0, 21.0, 220))
LARGE_PINGS, LARGE_GRID = 1500, Grid.plane(x=(1.5, 28.5, 1000), y=(18.0, 27.0, 1000))
SONAR = Sonar(Pulse(100e3, 30e3, 1e-3), np.zeros((1, 3)), tx_length_m=0.06, rx_length_m=0.06)

_SMOOTHED = 12  # pings: standard deviation of the Gaussian that smooths residuals
_REPEATS = 5  # runs in turns, of which the fastest counts


def smooth_m(
    rms_m: float, seed: int = 0, *, pings: int = PINGS, correlated: float = 75
) -> NDArray[np.float64]:
    """Return displacements that vary over some pings, without mean and trend.

    Images do not depend on the latter.
    """
    noise = np.random.default_rng(seed).standard_normal(pings + 1000)
    return _scaled(detrended(gaussian_filter1d(noise, correlated)[500 : 500 + pings]), rms_m)


def white_m(rms_m: float, seed: int = 1, *, pings: int = PINGS) -> NDArray[np.float64]:
    """Return displacements that are independent from ping to ping."""
    return _scaled(np.random.default_rng(seed).standard_normal(pings), rms_m)


def _scaled(values: NDArray[np.float64], rms: float) -> NDArray[np.float64]:
    return values * (rms / np.std(values)) if rms else np.zeros_like(values)


def points(seed: int = 0, *, count: int = 60, grid: Grid = GRID) -> PointTargets:
    """Return isolated points on a grid."""
    random = np.random.default_rng(seed)
    x_m, y_m = grid.axes_m
    at = np.stack(
        [
            random.uniform(x_m[0] + 0.3, x_m[-1] - 0.3, count),
            random.uniform(y_m[0] + 0.2, y_m[-1] - 0.2, count),
            np.zeros(count),
        ],
        axis=1,
    )
    level = random.uniform(0.3, 1, count)
    return PointTargets(at, level * np.exp(2j * np.pi * random.random(count)))


def speckle(bright: int, seed: int = 0) -> PointTargets:
    """Return speckle of fully developed density, with some bright points or none."""
    random = np.random.default_rng(seed)
    count = 12000
    at = np.stack(
        [random.uniform(-2, 10, count), random.uniform(17.7, 21.3, count), np.zeros(count)], axis=1
    )
    level = 0.02 * (random.standard_normal(count) + 1j * random.standard_normal(count))
    level[:bright] = np.exp(2j * np.pi * random.random(bright))
    at[:bright, 0] = random.uniform(2, 6, bright)
    at[:bright, 1] = random.uniform(18.2, 20.8, bright)
    return PointTargets(at, level)


def recorded(scene: PointTargets, sway_m: NDArray[np.float64]) -> tuple[RangeLines, RangeLines]:
    """Return lines from a swaying track, with its true positions and with those of navigation."""
    course = (0, 0, 0), (STEP_M, 0, 0), len(sway_m), 1.0
    track = Track.straight(*course, sway_m=sway_m)
    far_m = max(22.5, float(scene.positions_m[:, 1].max()) + 1)
    true = compress(simulate(SONAR, track, scene, range_m=(17.2, far_m)))
    return true, said_to_be_on(true, SONAR, Track.straight(*course))


def peak_db(
    lines: RangeLines,
    true: RangeLines,
    device: Device | str | None = None,
    *,
    grid: Grid = GRID,
) -> float:
    """Return the peak of an image of lines over that of the true lines, dB."""
    image, ideal = (
        np.abs(factorize(each, grid, -40.0, device=device).pixels).max() for each in (lines, true)
    )
    return float(20 * np.log10(image / ideal))


def residual_m(error_m: NDArray[np.float64], smoothed: float = 0) -> float:
    """Return the rms residual sway, metres: the largest over any 400 pings.

    A response stays in the beam for that many pings. Their mean and trend are removed.

    Parameters
    ----------
    error_m : float64 [pings]
        Residual sway.
    smoothed : float
        Standard deviation in pings of a Gaussian that smooths the residual first, or 0.
    """
    worst_m = 0.0
    for first in range(0, max(len(error_m) - PINGS, 0) + 1, PINGS // 4):
        left_m = detrended(error_m[first : first + PINGS])
        left_m = gaussian_filter1d(left_m, smoothed) if smoothed else left_m
        worst_m = max(worst_m, float(np.std(left_m)))
    return worst_m


def smooth_residual_m(error_m: NDArray[np.float64]) -> float:
    """Return the rms of the smooth part of a residual sway [pings], metres."""
    return residual_m(error_m, _SMOOTHED)


@dataclass(frozen=True)
class Scene:
    """A scene and a sway.

    Attributes
    ----------
    bright : int or None
        Number of bright points in speckle; None for isolated points.
    smooth, white : float
        Rms sway, in wavelengths, that varies over some metres and from ping to ping.
    seed : int
        Seed of the smooth sway.
    points : int
        Number of isolated points.
    grid : Grid
    pings : int
    """

    bright: int | None
    smooth: float
    white: float
    seed: int = 0
    points: int = 60
    grid: Grid = GRID
    pings: int = PINGS

    @property
    def targets(self) -> PointTargets:
        """Points of the scene."""
        if self.bright is None:
            return points(count=self.points, grid=self.grid)
        return speckle(self.bright)

    @property
    def sway_m(self) -> NDArray[np.float64]:
        """Sway of every ping, metres."""
        smooth = smooth_m(self.smooth * WAVELENGTH_M, self.seed, pings=self.pings)
        return smooth + white_m(self.white * WAVELENGTH_M, pings=self.pings)


SCENES = {
    "points-in-focus": Scene(None, 0, 0),
    "points-smooth": Scene(None, 0.3, 0),
    "points-beyond-resolution": Scene(None, 2, 0),
    "points-smooth-and-white": Scene(None, 2, 0.05),
    "points-white": Scene(None, 0, 0.1),
    "speckle-smooth": Scene(20, 2, 0, seed=4),
    "large": Scene(None, 2, 0.05, points=400, grid=LARGE_GRID, pings=LARGE_PINGS),
}
COLUMNS = (
    "scene",
    "sway, wavelengths",
    "before, dB",
    "after, dB",
    "residual, wavelengths",
    "its smooth part",
    "time in images",
)


def rows(devices: Iterable[str]) -> Iterator[list[str]]:
    """Yield rows of peaks before and after autofocus, residual sway, and processor time."""
    for device in devices:
        for name, scene in SCENES.items():
            sway_m = scene.sway_m
            true, given = recorded(scene.targets, sway_m)
            found, images = _timed(given, scene.grid, device)
            left_m = found.correction_m[:, 1] - sway_m
            left = residual_m(left_m) / WAVELENGTH_M
            yield [
                f"{name}, {device}",
                f"{scene.smooth:g} smooth, {scene.white:g} white",
                f"{peak_db(given, true, device, grid=scene.grid):.2f}",
                f"{peak_db(found.lines, true, device, grid=scene.grid):.2f}",
                f"{left:.4f}",
                f"{smooth_residual_m(left_m) / WAVELENGTH_M:.4f}",
                f"{images:.1f}",
            ]


def _timed(lines: RangeLines, grid: Grid, device: str) -> tuple[Autofocus, float]:
    """Return the result of autofocus, and its least processor time over that of an image."""

    def image() -> None:
        factorize(lines, grid, IMAGE_TOLERANCE_DB, device=device)

    found = autofocus(lines, grid, device=device)
    work = image, partial(autofocus, lines, grid, device=device)
    seconds = np.min([[_seconds(each) for each in work] for _ in range(_REPEATS)], axis=0)
    return found, float(seconds[1] / seconds[0])


def _seconds(work: Callable[[], object]) -> float:
    start_s = time.process_time()
    work()
    return time.process_time() - start_s


RADAR_GRID = Grid.plane(x=(-37.0, 37.0, 500), y=(-37.0, 37.0, 500))
RADAR_ERRORS = (0.0, 0.0), (0.3, 0.0), (2.0, 0.0), (0.0, 0.1), (1.0, 0.05)
"""Sway added to a recorded pass, wavelengths rms: smooth, and from ping to ping."""
RADAR_COLUMNS = ("sway, wavelengths", "before, dB", "after, dB", "sharpness", "time in images")

_REFLECTOR = Grid.plane(
    x=(-17.6, -13.6, 161), y=(19.6, 23.6, 161)
)  # around the brightest reflector
_CORRELATED_PULSES = 15  # pulses over which the smooth sway varies


def radar_pass(path: str | os.PathLike) -> RangeLines:
    """Return one degree of the recorded radar pass (docs/recorded-data.md)."""
    return read_phase_history(path, window="hamming").tapered_ends(1.0)


def swaying(lines: RangeLines, smooth: float, white: float) -> RangeLines:
    """Return lines with a sway, in wavelengths rms, added to their positions."""
    wave_m = wavelength_m(lines)
    passage = Passage.of(lines, ("sway",), wave_m)
    sway_m = smooth_m(smooth * wave_m, pings=passage.pings, correlated=_CORRELATED_PULSES)
    sway_m = sway_m + white_m(white * wave_m, pings=passage.pings)
    vectors_m = passage.vectors_m(sway_m[None])
    return replace(lines, tx_m=lines.tx_m + vectors_m, rx_m=lines.rx_m + vectors_m)


def reflector_db(lines: RangeLines, device: Device | str | None = None) -> float:
    """Return the level of the brightest reflector of the recording, dB."""
    image = form_exactly(lines, _REFLECTOR, device=device, accuracy_db=-50)
    return float(20 * np.log10(np.abs(image.pixels).max()))


def radar_rows(path: str | os.PathLike, devices: Iterable[str]) -> Iterator[list[str]]:
    """Yield rows of the reflector's peak over that with the given track, before and after."""
    lines = radar_pass(path)
    for device, (smooth, white) in itertools.product(devices, RADAR_ERRORS):
        given, given_db = swaying(lines, smooth, white), reflector_db(lines, device)
        found, images = _timed(given, RADAR_GRID, device)
        yield [
            f"{smooth:g} smooth, {white:g} white; {device}",
            f"{reflector_db(given, device) - given_db:.2f}",
            f"{reflector_db(found.lines, device) - given_db:+.2f}",
            f"{found.sharpness_before:.0f} to {found.sharpness_after:.0f}",
            f"{images:.1f}",
        ]
