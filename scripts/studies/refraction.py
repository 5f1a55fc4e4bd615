"""Errors that a profile of the sound speed leaves in images, from exact rays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

import clsas
from clsas.engine.data.decibels import in_db
from clsas.engine.water.refraction import homogeneous

COLUMNS = (
    "band, range",
    "sound speed",
    "seabed",
    "apparent antennas dB",
    "corrected dB",
)
EXTENT_M = 50.0  # of the grid, along the track and in range
_SPEED_M_S, _CHANNELS, _WAVE_M = 1500.0, 120, 25.0


@dataclass(frozen=True)
class Scene:
    """A sonar above the seabed, in a profile.

    Attributes
    ----------
    carrier_hz : float
    range_m, aperture_m, pixel_m : float
    sonar_m, seabed_m : float
        Depths.
    water : str
        What is said of the sound speed.
    depth_m, speed_m_s : tuple of float
        The profile.
    """

    carrier_hz: float
    range_m: float
    aperture_m: float
    pixel_m: float
    sonar_m: float
    seabed_m: float
    water: str
    depth_m: tuple[float, ...]
    speed_m_s: tuple[float, ...]

    @property
    def name(self) -> str:
        """Band and range."""
        return f"{self.carrier_hz / 1e3:g} kHz, {self.range_m:g} m"

    def grid(self, relief_m: float) -> clsas.Grid:
        """Return a square grid whose heights are waves, oblique to the track."""
        middle_m = np.sqrt(self.range_m**2 - (self.seabed_m - self.sonar_m) ** 2)
        half_m, count = EXTENT_M / 2, round(EXTENT_M / self.pixel_m)
        ends_m = middle_m - half_m, middle_m + half_m
        grid = clsas.Grid.plane((-half_m, half_m, count), (*ends_m, count), -self.seabed_m)
        if not relief_m:
            return grid
        x, y = (each.reshape(shape) for each, shape in zip(grid.axes_m, ((1, -1), (-1, 1)),
                                                           strict=True))  # fmt: skip
        phase = 2 * np.pi * (0.87 * x + 0.5 * y) / _WAVE_M
        return grid.with_height(relief_m * np.sin(phase))

    def lines(self, *, moving: bool) -> clsas.RangeLines:
        """Return lines of zeros, of single elements or of an array that moves."""
        along = np.linspace(-0.5, 0.5, _CHANNELS) * self.aperture_m
        if moving:
            along = np.repeat(along[::8], 8)
        tx_m = np.stack([along, 0 * along, 0 * along - self.sonar_m], axis=1)
        rx_m = tx_m.copy()
        if moving:
            rx_m[:, 0] += np.tile(np.linspace(0.1, 1.3, 8), _CHANNELS // 8)
        step_m = _SPEED_M_S / (0.64 * self.carrier_hz)
        first_m = max(self.range_m - EXTENT_M, step_m)
        length = round((self.range_m + EXTENT_M - first_m) / step_m)
        return clsas.RangeLines(
            np.zeros((_CHANNELS, length), np.complex64), first_m, step_m, tx_m, rx_m,
            self.carrier_hz, _SPEED_M_S, rx_velocity_m_s=[1.8, 0.0, 0.0] if moving else None,
            sound_speed=clsas.SoundSpeed(np.array(self.depth_m), np.array(self.speed_m_s)),
        )  # fmt: skip


def _gradient(per_s: float) -> tuple[str, tuple[float, ...], tuple[float, ...]]:
    return f"{per_s:+g} m/s per metre", (0.0, 80.0), (1480.0, 1480.0 + 80 * per_s)


_THERMOCLINE = (
    "thermocline of 10 m/s", (0.0, 14.0, 17.0, 80.0), (1505.0, 1505.0, 1495.0, 1495.5)
)  # fmt: skip
SCENES = [
    Scene(60e3, 300, 60, 0.08, 5, 45, *_gradient(-1.0)),
    Scene(60e3, 300, 60, 0.08, 5, 45, *_THERMOCLINE),
    Scene(100e3, 150, 25, 0.05, 10, 22, *_gradient(0.5)),
    Scene(300e3, 60, 5, 0.02, 10, 22, *_gradient(-1.0)),
    Scene(300e3, 60, 5, 0.02, 10, 22, *_THERMOCLINE),
]
_RELIEFS_M = (0.5, 2.0, 5.0)


def rows() -> Iterator[list[str]]:
    """Yield the errors of all scenes, over waves and for arrays that move."""
    for scene in SCENES:
        cases = [(f"waves of ±{relief_m:g} m", relief_m, False) for relief_m in _RELIEFS_M]
        for seabed, relief_m, moving in [("level, moving array", 0.0, True), *cases]:
            lines, grid = scene.lines(moving=moving), scene.grid(relief_m)
            alone, corrected = (
                homogeneous(lines, grid, None, None, corrected=each) for each in (False, True)
            )
            errors = (f"{in_db(each.error):.0f}" for each in (alone, corrected))
            yield [scene.name, scene.water, seabed, *errors]
