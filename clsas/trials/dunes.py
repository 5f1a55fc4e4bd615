"""Case of heights: dunes seen by two banks of receivers, 28 m away and 12 m below them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.simulation.scenes import Observer, PointTargets, Seabed
from clsas.simulation.simulator import simulate_lines

SEARCH_M = (-3.0, 3.0)
"""Heights to search: 20 at six per height of ambiguity."""

_PIXEL_M, _NEAR_M, _ALTITUDE_M, _BASELINE_M = 0.01, 28.0, 12.0, 0.25
_CARRIER_HZ, _BAND_HZ = 100e3, 30e3
_PINGS, _APERTURE_M = 1000, 10.0  # 1 cm apart, so that no grating lobes fall into the scene
_MARGIN_M, _SPACING_M, _DENSITY_M2 = 1.0, 0.04, 500.0


def grid(pixels: int) -> Grid:
    """Return a plane below the middle of the dunes with `pixels` of 1 cm along either side."""
    half_m = pixels * _PIXEL_M / 2
    return Grid.plane((-half_m, half_m, pixels), (_NEAR_M, _NEAR_M + 2 * half_m, pixels))


def relief_m(x_m: NDArray[np.float64], y_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the height of the dunes, which lie on a gentle slope, metres."""
    return 0.1 * (y_m - _NEAR_M - 2.5) + 0.15 * np.sin(2 * np.pi * (y_m + 0.4 * x_m) / 4)


def banks(pixels: int) -> tuple[RangeLines, RangeLines]:
    """Return the range lines of both banks, 0.25 m apart, for a grid of `pixels` along a side."""
    low_m, high_m = grid(pixels).bounds_m
    x_m, y_m = (
        np.arange(low_m[axis] - _MARGIN_M, high_m[axis] + _MARGIN_M, _SPACING_M) for axis in (0, 1)
    )
    heights_m = relief_m(*np.meshgrid(x_m, y_m))
    ends = (x_m[0], x_m[-1]), (y_m[0], y_m[-1])
    seabed = Seabed(*ends, heights_m, density_m2=_DENSITY_M2)
    points = PointTargets(*seabed.visible(Observer(np.array([0.0, 0.0, _ALTITUDE_M]))))
    along_m = np.linspace(-0.5, 0.5, _PINGS) * _APERTURE_M
    tx_m = np.outer(along_m, [1, 0, 0]) + [0, 0, _ALTITUDE_M]
    lower, upper = (
        simulate_lines(
            tx_m, tx_m + [0, 0, up_m], points, carrier_hz=_CARRIER_HZ, bandwidth_hz=_BAND_HZ,
            window="hamming",
        )
        for up_m in (0.0, _BASELINE_M)
    )  # fmt: skip
    return lower, upper
