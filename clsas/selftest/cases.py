"""Built-in cases of the benchmarks: simulated range lines, grids and beams.

The wreck has a module of its own, `clsas.selftest.wreck`.
"""

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
from clsas.simulation.scenes import Observer, PointTargets, Seabed
from clsas.simulation.simulator import simulate_lines

_POINTS = 1000  # a plain choice; simulation time is proportional to it
_DUNES_M = 8.0  # length and width of a dune
_AIR_M_S, _WATER_M_S = 343.0, 1500.0


@dataclass(frozen=True)
class Case:
    """A straight track over a scene of random points.

    Attributes
    ----------
    channels : int
        Monostatic phase centres.
    spacing_m : float
        Distance between the phase centres.
    carrier_hz, bandwidth_hz : float
        Band of the range lines, without a window, sampled at 1.25 bandwidths.
    x_m, y_m : (first, last)
        Extent of the image.
    pixels : int
        Pixels along either side.
    beam : BeamWindow, optional
        Weights of the channels.
    depth_m, relief_m : float
        Depth below the track of the plane in which points and pixels lie, and height of the dunes
        on it from trough to crest. Dunes are 8 m long and wide.
    """

    channels: int
    spacing_m: float
    carrier_hz: float
    bandwidth_hz: float
    x_m: tuple[float, float]
    y_m: tuple[float, float]
    pixels: int
    beam: BeamWindow | None = None
    depth_m: float = 0.0
    relief_m: float = 0.0

    @property
    def grid(self) -> Grid:
        """Grid of the image."""
        plane = Grid.plane((*self.x_m, self.pixels), (*self.y_m, self.pixels), -self.depth_m)
        if not self.relief_m:
            return plane
        x_m, y_m = plane.axes_m
        return plane.with_height(self._height_m(x_m, y_m[:, None]))

    def _height_m(self, x_m: NDArray[np.float64], y_m: NDArray[np.float64]) -> NDArray[np.float64]:
        dunes = np.sin(2 * np.pi * x_m / _DUNES_M) * np.sin(2 * np.pi * y_m / _DUNES_M)
        return self.relief_m / 2 * dunes

    def lines(self, seed: int = 1) -> RangeLines:
        """Return range lines of random points in the area of the image, with complex amplitudes."""
        random = np.random.default_rng(seed)
        along = (np.arange(self.channels) - (self.channels - 1) / 2) * self.spacing_m
        tx_m = np.stack([along, np.zeros_like(along), np.zeros_like(along)], axis=1)
        positions = np.zeros((_POINTS, 3))
        positions[:, 0] = random.uniform(*self.x_m, _POINTS)
        positions[:, 1] = random.uniform(*self.y_m, _POINTS)
        positions[:, 2] = self._height_m(*positions[:, :2].T) - self.depth_m
        amplitudes = random.standard_normal(_POINTS) + 1j * random.standard_normal(_POINTS)
        return simulate_lines(
            tx_m, tx_m, PointTargets(positions, amplitudes), carrier_hz=self.carrier_hz,
            bandwidth_hz=self.bandwidth_hz, oversampling=1.25,
        )  # fmt: skip


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
            track_m, track_m, PointTargets(positions_m, amplitudes), carrier_hz=self.carrier_hz,
            bandwidth_hz=self.bandwidth_hz, sound_speed_m_s=self.sound_speed_m_s, oversampling=1.25,
        )  # fmt: skip


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


@dataclass(frozen=True)
class Dunes:
    """Dunes seen by two banks of receivers 0.25 m apart, 28 m away and 12 m below them.

    Attributes
    ----------
    pixels : int
        Pixels of 1 cm along either side.
    search_m : (lowest, highest)
        Heights to search; by default 20 at six per height of ambiguity.
    """

    pixels: int
    search_m: tuple[float, float] = (-3.0, 3.0)

    near_m: ClassVar[float] = 28.0
    """Ground range at which the dunes begin."""

    @property
    def grid(self) -> Grid:
        """Plane below the middle of the dunes."""
        side_m = self.pixels * 0.01
        x_m, y_m = (-side_m / 2, side_m / 2), (self.near_m, self.near_m + side_m)
        return Grid.plane((*x_m, self.pixels), (*y_m, self.pixels))

    def height_m(self, x_m: NDArray[np.float64], y_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height of the dunes, which lie on a gentle slope."""
        waves = np.sin(2 * np.pi * (y_m + 0.4 * x_m) / 4)
        return 0.1 * (y_m - self.near_m - 2.5) + 0.15 * waves

    def banks(self) -> tuple[RangeLines, RangeLines]:
        """Return the range lines of the lower and of the upper bank."""
        altitude_m, margin_m, spacing_m = 12.0, 1.0, 0.04
        low_m, high_m = self.grid.bounds_m
        x_m, y_m = (
            np.arange(low_m[axis] - margin_m, high_m[axis] + margin_m, spacing_m) for axis in (0, 1)
        )
        ends = (x_m[0], x_m[-1]), (y_m[0], y_m[-1])
        seabed = Seabed(*ends, self.height_m(*np.meshgrid(x_m, y_m)), density_m2=500.0)
        points = PointTargets(*seabed.visible(Observer(np.array([0.0, 0.0, altitude_m]))))
        # Pings are 1 cm apart, so that no grating lobes fall into the scene.
        tx_m = np.outer(np.linspace(-5, 5, 1000), [1, 0, 0]) + [0, 0, altitude_m]
        lower, upper = (
            simulate_lines(
                tx_m, tx_m + [0, 0, up_m], points, carrier_hz=100e3, bandwidth_hz=30e3,
                window="hamming",
            )
            for up_m in (0.0, 0.25)
        )  # fmt: skip
        return lower, upper


EXACT_CASES = {
    # Chapter 5 of the thesis (Ødegaard 2004), which does not state the bandwidth.
    "bp-thesis": Case(640, 8.25e-3, 1e6, 100e3, (-2.5, 2.5), (40.0, 45.0), 1024),
    "bp-2k": Case(2048, 15e-3, 120e3, 30e3, (-20.0, 20.0), (40.0, 80.0), 2048),
}
"""Cases of exact imaging."""

_BEAM = BeamWindow(20.0, "hann")

FFBP_2K = Case(2000, 15e-3, 120e3, 30e3, (-20.48, 20.46), (40.0, 80.0), 2048, _BEAM)
"""Square image of 4 million pixels, from about as many channels as it has rows."""

DENSE_CASES = {
    # 150 turns of 360 pings in air, around a target of 0.24 m.
    "ffbp-helix": DenseCase(
        partial(helix, 150, 360, 0.83, 0.09, 5e-3),
        20e3, 20e3, _AIR_M_S, (0.24, 0.24, 0.0), 0.24, 150,
    ),
    "ffbp-helix-fine": DenseCase(
        partial(helix, 150, 360, 0.83, 0.09, 5e-3),
        20e3, 20e3, _AIR_M_S, (0.24, 0.24, 0.0), 0.24, 600,
    ),
    "ffbp-passes": DenseCase(
        partial(passes, 20, 800, 0.015),
        120e3, 30e3, _WATER_M_S, (10.0, 10.0, 0.0), 10.0, 1024, points=100,
    ),
    "ffbp-volume": DenseCase(
        partial(helix, 1, 4096, 15.0, 8.0, 0.0),
        120e3, 30e3, _WATER_M_S, (1.28, 1.28, 0.64), 1.27, 128, slices=64,
    ),
}  # fmt: skip
"""Cases of factorized imaging with dense apertures, and of a volume."""

FACTORIZED_CASES: dict[str, Case | DenseCase] = {
    "ffbp-thesis": EXACT_CASES["bp-thesis"],
    "ffbp-2k": FFBP_2K,
    "ffbp-relief": Case(
        channels=2000,
        spacing_m=15e-3,
        carrier_hz=120e3,
        bandwidth_hz=30e3,
        x_m=(-20.48, 20.46),
        y_m=(40.0, 80.0),
        pixels=2048,
        beam=_BEAM,
        depth_m=20.0,
        relief_m=1.0,
    ),
    # The pixel and channel spacing of ffbp-2k, with a longer track and larger ranges.
    "ffbp-8k": Case(8192, 15e-3, 120e3, 30e3, (-40.96, 40.94), (40.0, 121.9), 4096, _BEAM),
    **DENSE_CASES,
}
"""Cases of factorized imaging."""

MOSAIC_CASES = {"mosaic-wreck": (4096, BeamWindow(5.0, "hann"))}
"""Cases of mosaics of the wreck (`clsas.selftest.wreck`): pixels along each side, and the beam."""

HEIGHTS_CASES = {"heights-512": Dunes(512), "heights": Dunes(1024)}
"""Cases of heights from two banks."""
