"""Division of a grid into tiles or groups whose geometry has a small error."""

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
"""Rms error of a phase, radians, per cycle over the radius of a part. Measured with many
channels."""

_ONE_CHANNEL = 5.0  # largest relative excess of the error power with a single channel
_FEW_CHANNELS = 32  # with more channels, errors average to within a decibel of the mean

_SIDES = (64, 32, 16)  # sides of tiles, pixels
_FOURTH_ORDER = 0.15 / 8  # rms remainder of an expanded range, over r^4/R^3
_MOTION = 0.2  # rms remainder of the range to a moving receiver, over v/c r^3/R^2
_SINE_REMAINDER = 0.1  # remainder of a sine that is expanded to third order, over (r/R)^4
_SINE_ERROR = 1e-6  # error of a sine that is always allowed, as a share of the beam's width
_SINE_ROUNDING = 1e-7  # rounding error of a sine in float32


@dataclass(frozen=True, eq=False)
class Conditions:
    """Scene and accuracy for which a grid is laid out.

    Attributes
    ----------
    antennas_m : float64 [n, 3]
        All transmitter and receiver positions and, with a beam, the phase centres.
    cycles_per_m : float
        Phase per metre of range, cycles: two over the wavelength.
    width : int
        Float lanes per work-item.
    error : float
        Relative rms error that the geometry may add; see `allowed`.
    speed_ratio : float
        Speed of the fastest receiver over the sound speed.
    beam : BeamWindow or None
        Weights of the channels.
    fullness : float
        `BeamWindow.fullness` over the grid. Allowed errors of the weights are multiplied by it.
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
        """Largest distance of a pixel from the centre of its group that float32 allows, metres."""
        with np.errstate(divide="ignore"):
            rounding = rounding_error(len(self.antennas_m))
            return float(GEOMETRY_ERROR / rounding / np.float64(self.cycles_per_m))

    def errors(self, tiles: Tiles) -> tuple[float, float]:
        """Return the rms errors of pixels, and of the sines of aspect angles, due to tiles."""
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
        """Return the error of a sine up to which the weights of a beam keep within an error."""
        if self.beam is None:
            return math.inf
        of_width = max(_SINE_ERROR, (error * self.fullness) ** 2)
        return max(of_width * float(np.ptp(np.clip(self.beam.limits, -1, 1))), _SINE_ROUNDING)


def allowed(accuracy_db: float) -> float:
    """Return the error that the geometry may add to an image of a given accuracy.

    This is 6 % of the error power of the image, but at least -90 dB.
    """
    return max(GEOMETRY_ERROR, 10 ** ((accuracy_db - 12) / 20))


def lay_out(grid: Grid, conditions: Conditions) -> Tiles | Groups:
    """Divide a grid into parts, so that the geometry's share of the error stays small.

    If there are tiles with errors below -90 dB, the largest of them are used. Otherwise the largest
    tiles within the allowed error are used, and if there are none, groups.

    Notes
    -----
    Ranges of a tile are expanded to third order about its centre. The remainder is at most
    r^4/(8 R^3), where r is half the diagonal of the tile and R the distance of the nearest antenna.
    Its rms over pixels and directions is 0.15 of that. The third order neglects the motion of
    receivers, which adds 0.2 r^3/R^2 times the speed ratio. With a beam, the sine of the aspect
    angle is also expanded to third order. Its error may be a millionth of the beam's width, or the
    square of the allowed error if that is larger, but never less than the 1e-7 of float32. A block,
    over which one cubic represents the weights, must be small compared with the beam's edge.

    Groups need no expansion. They are used near the antennas, where even the smallest tile is too
    large, and for pixels off a plane.
    """
    found = fitting_tiles(grid, conditions)
    return gather(grid, conditions.largest_radius_m, conditions.width) if found is None else found


def estimate_layout(
    grid: Grid, conditions: Conditions, longest_m: float, windows: int
) -> Tiles | GroupsEstimate:
    """Return the tiles of `lay_out`, or an estimate of its groups, which take long to gather.

    Groups are assumed to be no wider than `longest_m`, the length of the lines, and to look up
    samples in the given number of `windows`.
    """
    found = fitting_tiles(grid, conditions)
    if found is not None:
        return found
    radius_m = min(conditions.largest_radius_m, longest_m)
    return GroupsEstimate(grid, item_pixels(conditions.width), radius_m, windows)


def fitting_tiles(grid: Grid, conditions: Conditions) -> Tiles | None:
    """Return the tiles of `lay_out`, or None if it would make groups."""
    if not grid.is_planar:
        return None
    candidates = [Tiles(grid, side, conditions.width) for side in _SIDES]
    errors = [conditions.errors(tiles) for tiles in candidates]
    # Tiles that are just fine enough for the allowed error are still much faster than groups.
    for most in (GEOMETRY_ERROR, conditions.error):
        most_sine = conditions.allowed_sine_error(most)
        for tiles, (error, sine_error) in zip(candidates, errors, strict=True):
            if error <= most and sine_error <= most_sine:
                return replace(tiles, cosines=tiles.cosines_of(conditions.antennas_m))
    return None


def rounding_error(channels: int) -> float:
    """Return the rms error of a phase, radians, per cycle over the radius of a part.

    Coefficients are rounded once per part and channel. The error of a single channel depends on its
    direction from the part. The errors of many channels average out.
    """
    excess = _ONE_CHANNEL / channels if channels <= _FEW_CHANNELS else 0.0
    return ROUNDING * math.sqrt(1 + excess)
