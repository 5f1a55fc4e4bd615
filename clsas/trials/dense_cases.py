"""Benchmark cases with dense apertures, and of a volume."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.simulation.scenes import PointTargets
from clsas.simulation.simulator import simulate_lines

_AIR_M_S, _WATER_M_S = 343.0, 1500.0


@dataclass(frozen=True)
class DenseCase:
    """Channels at any positions over a scene of random points.

    Attributes
    ----------
    track : callable
        Returns the monostatic phase centres, float64 [channels, 3].
    carrier_hz, bandwidth_hz, sound_speed_m_s : float
        Band of the range lines, without a window, sampled at 1.25 bandwidths.
    target_m : (x, y, z)
        Sides of the box around the origin in which the points lie.
    image_m : float
        Side of the image.
    pixels : int
        Pixels along either side.
    slices : int
        Number of images at different heights, from the lowest point of the target to the highest.
    points : int
        Number of points, to which the simulation time is proportional.
    """

    track: Callable[[], NDArray[np.float64]]
    carrier_hz: float
    bandwidth_hz: float
    sound_speed_m_s: float
    target_m: tuple[float, float, float]
    image_m: float
    pixels: int
    slices: int = 1
    points: int = 1000

    beam: ClassVar[BeamWindow | None] = None
    """No beam: every channel contributes to every pixel."""

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.track())

    @property
    def grid(self) -> Grid:
        """Grid of the image: a plane, or the points of a volume."""
        extent = -self.image_m / 2, self.image_m / 2, self.pixels
        if self.slices == 1:
            return Grid.plane(extent, extent, 0.0)
        across_m = np.linspace(*extent)
        height_m = np.linspace(-self.target_m[2] / 2, self.target_m[2] / 2, self.slices)
        z, y, x = np.meshgrid(height_m, across_m, across_m, indexing="ij")
        return Grid.points(np.stack([x, y, z], axis=-1))

    def lines(self, seed: int = 1) -> RangeLines:
        """Return range lines of random points, with complex amplitudes."""
        random = np.random.default_rng(seed)
        positions_m = random.uniform(-0.5, 0.5, (self.points, 3)) * self.target_m
        amplitudes = random.standard_normal(self.points) + 1j * random.standard_normal(self.points)
        track_m = self.track()
        return simulate_lines(
            track_m,
            track_m,
            PointTargets(positions_m, amplitudes),
            carrier_hz=self.carrier_hz,
            bandwidth_hz=self.bandwidth_hz,
            sound_speed_m_s=self.sound_speed_m_s,
            oversampling=1.25,
        )


def helix(
    turns: int, per_turn: int, radius_m: float, lowest_m: float, rise_m: float
) -> NDArray[np.float64]:
    """Return positions on a helix about the vertical axis, [channels, 3].

    Parameters
    ----------
    turns, per_turn : int
        Number of turns, and of positions in each.
    radius_m, lowest_m, rise_m : float
        Radius, height of the first position, and rise of each turn.
    """
    turn = np.arange(turns * per_turn) / per_turn
    angle = 2 * np.pi * turn
    circle_m = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.column_stack([circle_m, lowest_m + rise_m * turn])


def passes(count: int, per_pass: int, spacing_m: float) -> NDArray[np.float64]:
    """Return positions on straight passes beside the origin, [channels, 3].

    The passes have 3 headings, 4 heights and different distances from the origin.
    """
    along_m = (np.arange(per_pass) - (per_pass - 1) / 2) * spacing_m
    found = []
    for number in range(count):
        heading = np.radians(60.0 * (number % 3))
        ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
        aside = np.array([np.sin(heading), -np.cos(heading), 0.0])
        beside_m = (40.0 + 0.7 * number) * aside + [0, 0, 10.0 + 2.0 * (number % 4)]
        found.append(along_m[:, None] * ahead + beside_m)
    return np.concatenate(found)


def _in_air(pixels: int) -> DenseCase:
    track = partial(helix, 150, 360, 0.83, 0.09, 5e-3)
    return DenseCase(track, 20e3, 20e3, _AIR_M_S, (0.24, 0.24, 0.0), 0.24, pixels)


DENSE_CASES = {
    # 150 turns of 360 pings in air, around a target of 0.24 m.
    "ffbp-helix": _in_air(150),
    "ffbp-helix-fine": _in_air(600),
    "ffbp-passes": DenseCase(
        partial(passes, 20, 800, 0.015),
        120e3, 30e3, _WATER_M_S, (10.0, 10.0, 0.0), 10.0, 1024, points=100,
    ),
    "ffbp-volume": DenseCase(
        partial(helix, 1, 4096, 15.0, 8.0, 0.0),
        120e3, 30e3, _WATER_M_S, (1.28, 1.28, 0.64), 1.27, 128, slices=64,
    ),
}  # fmt: skip
"""Cases of factorized imaging."""
