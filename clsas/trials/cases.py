"""Built-in cases of the benchmarks: simulated range lines, grids and beams."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.simulation.scenes import PointTargets
from clsas.simulation.simulator import simulate_lines
from clsas.trials.dense_cases import DENSE_CASES, DenseCase

_POINTS = 1000  # a plain choice; simulation time is proportional to it
_DUNES_M = 8.0  # length and width of a dune


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
            tx_m,
            tx_m,
            PointTargets(positions, amplitudes),
            carrier_hz=self.carrier_hz,
            bandwidth_hz=self.bandwidth_hz,
            oversampling=1.25,
        )


EXACT_CASES = {
    # Chapter 5 of the thesis (Ødegaard 2004), which does not state the bandwidth.
    "bp-thesis": Case(640, 8.25e-3, 1e6, 100e3, (-2.5, 2.5), (40.0, 45.0), 1024),
    "bp-2k": Case(2048, 15e-3, 120e3, 30e3, (-20.0, 20.0), (40.0, 80.0), 2048),
}
"""Cases of exact imaging."""

_BEAM = BeamWindow(20.0, "hann")

FFBP_2K = Case(2000, 15e-3, 120e3, 30e3, (-20.48, 20.46), (40.0, 80.0), 2048, _BEAM)
"""Square image of 4 million pixels, from about as many channels as it has rows."""

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
"""Cases of mosaics of the wreck (`clsas.trials.wreck`): pixels along each side, and the beam."""

HEIGHTS_CASES = {"heights-512": 512, "heights": 1024}
"""Cases of heights from two banks (`clsas.trials.dunes`): pixels along each side."""
