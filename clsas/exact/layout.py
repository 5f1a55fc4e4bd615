"""The division of a grid into tiles or groups that keeps the geometry's error small."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clsas.core.grid import Grid
from clsas.exact.groups import Groups, GroupsEstimate, gather
from clsas.exact.tiles import Tiles, item_pixels
from clsas.sonar.beam import BeamWindow

GEOMETRY_ERROR = 3.2e-5
"""Relative rms error that rounding and expanding the geometry may always add: -90 dB."""

ROUNDING = 2.2e-7
"""Rms error of a phase, radians, per cycle over a part's radius: measured, of many channels."""

_ONE_CHANNEL = 5.0  # relative excess of the error power of a single channel, at worst
_FEW_CHANNELS = 32  # with more channels, errors average to within a decibel of the mean

_SIDES = (64, 32, 16)  # pixels, of tiles
_FOURTH_ORDER = 0.15 / 8  # rms remainder of a range, over r^4/R^3
_MOTION = 0.2  # rms remainder of a range for a moving receiver, over v/c r^3/R^2
_SINE_REMAINDER = 0.1  # of a sine that is expanded to third order, over (r/R)^4
_SINE_ERROR = 1e-6  # of the beam's width, that a sine may always err by
_SINE_ROUNDING = 1e-7  # of a sine in float32


@dataclass(frozen=True, eq=False)
class Conditions:
    """The scene and the accuracy for which a grid is laid out.

    Attributes
    ----------
    antennas_m : float64 [n, 3]
        Every transmitter and receiver position; with a beam the phase centres, too.
    cycles_per_m : float
        Phase per metre of range, cycles: two over the wavelength.
    width : int
        Float lanes per work-item.
    error : float
        Relative rms error that the geometry may add; see `allowed`.
    speed_ratio : float
        Speed of the fastest receiver over that of sound.
    beam : BeamWindow or None
        Weights of the channels.
    fullness : float
        `BeamWindow.fullness` over the grid, by which errors of the weights must be smaller.
    """

    antennas_m: NDArray[np.float64]
    cycles_per_m: float
    width: int
    error: float = GEOMETRY_ERROR
    speed_ratio: float = 0.0
    beam: BeamWindow | None = None
    fullness: float = 1.0

    @property
    def largest_radius_m(self) -> float:
        """Largest distance of a pixel from its group's centre that float32 allows."""
        with np.errstate(divide="ignore"):
            rounding = rounding_error(len(self.antennas_m))
            return float(GEOMETRY_ERROR / rounding / np.float64(self.cycles_per_m))

    def errors(self, tiles: Tiles) -> tuple[float, float]:
        """Return the rms errors that tiles add: to pixels, and to the sine of aspect angles."""
        radius_m = tiles.radius_m
        nearest_m = max(tiles.nearest_m(self.antennas_m), 1e-30)
        remainder_m = _FOURTH_ORDER * radius_m**4 / nearest_m**3
        remainder_m += _MOTION * self.speed_ratio * radius_m**3 / nearest_m**2
        rounding = rounding_error(len(self.antennas_m)) * self.cycles_per_m * radius_m
        rounding *= tiles.eccentricity
        phase_error = math.hypot(2 * math.pi * self.cycles_per_m * remainder_m, rounding)
        block_error = 0.0
        if self.beam is not None:
            block_error = self.beam.block_error(tiles.block_radius_m / nearest_m) / self.fullness
        return max(phase_error, block_error), _SINE_REMAINDER * (radius_m / nearest_m) ** 4

    def allowed_sine_error(self, error: float) -> float:
        """Return the error of a sine with which a beam's weights keep an error."""
        if self.beam is None:
            return math.inf
        of_width = max(_SINE_ERROR, (error * self.fullness) ** 2)
        return max(of_width * float(np.ptp(np.clip(self.beam.limits, -1, 1))), _SINE_ROUNDING)


def allowed(accuracy_db: float) -> float:
    """Return the error that the geometry may add to an image of some accuracy.

    That is 6 % of the image's error power, but at least -90 dB.
    """
    return max(GEOMETRY_ERROR, 10 ** ((accuracy_db - 12) / 20))


def lay_out(grid: Grid, conditions: Conditions) -> Tiles | Groups:
    """Divide a grid so that the geometry's share of the error stays small.

    Where tiles below -90 dB exist, the largest of them are taken; else the largest tiles within
    the error allowed; else groups.

    Notes
    -----
    A tile's ranges are expanded to third order about its centre. The remainder is at most
    r^4/(8 R^3), with r the tile's half diagonal and R the distance of the nearest antenna; its rms
    over pixels and directions is 0.15 of that. The third order leaves out the receivers' motion:
    0.2 of r^3/R^2 times the speed ratio. With a beam the sine of the aspect angle is expanded to
    third order, too. It may err by a millionth of the beam's width, or by the square of the
    error allowed if that is more; float32 holds no less than 1e-7. A block, over which the weights
    are a cubic, must be small against the beam's edge.

    Groups expand nothing. They are taken where even the smallest tile is too large, near the
    antennas, and for pixels off a plane.
    """
    found = fitting_tiles(grid, conditions)
    return gather(grid, conditions.largest_radius_m, conditions.width) if found is None else found


def estimate_layout(
    grid: Grid, conditions: Conditions, longest_m: float, windows: int
) -> Tiles | GroupsEstimate:
    """Return the tiles of `lay_out`, or an estimate of its groups, which take long to gather.

    Groups are assumed to be no wider than `longest_m`, the length of the lines, and to look samples
    up in so many `windows`.
    """
    found = fitting_tiles(grid, conditions)
    if found is not None:
        return found
    radius_m = min(conditions.largest_radius_m, longest_m)
    return GroupsEstimate(grid, item_pixels(conditions.width), radius_m, windows)


def fitting_tiles(grid: Grid, conditions: Conditions) -> Tiles | None:
    """Return the tiles of `lay_out`, or None where it makes groups."""
    if not grid.is_planar:
        return None
    candidates = [Tiles(grid, side, conditions.width) for side in _SIDES]
    errors = [conditions.errors(tiles) for tiles in candidates]
    # Tiles just fine enough for the error allowed are much faster than groups.
    for most in (GEOMETRY_ERROR, conditions.error):
        most_sine = conditions.allowed_sine_error(most)
        for tiles, (error, sine_error) in zip(candidates, errors, strict=True):
            if error <= most and sine_error <= most_sine:
                return replace(tiles, cosines=tiles.cosines_of(conditions.antennas_m))
    return None


def rounding_error(channels: int) -> float:
    """Rms error of a phase, radians, per cycle over a part's radius.

    Coefficients are rounded once per part and channel. The error of one channel depends on its
    direction from the part; that of many channels averages out.
    """
    excess = _ONE_CHANNEL / channels if channels <= _FEW_CHANNELS else 0.0
    return ROUNDING * math.sqrt(1 + excess)
