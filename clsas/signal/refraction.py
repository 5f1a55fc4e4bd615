"""Homogeneous water in place of a profile: lines and grids that any imager images correctly.

The two-way delay of a pixel depends on its horizontal distance D from the antennas and on three
heights. For one channel above a level seabed, it is therefore a function of D alone, and so is the
range in homogeneous water. `homogeneous` makes use of this:

- An *apparent antenna* takes the place of every antenna. It lies straight above or below it, on the
  tangent of the ray at the seabed, so that echoes come from the right direction. The speed is that
  at the seabed.
- The range axis of every line is changed by a smooth function, so that the delay is right at every
  distance. At the middle of the grid this is a shift. The samples are interpolated once.
- On a grid that is not level, pixels get *apparent positions*, a few millimetres to centimetres
  beside their own.

On level grids the remaining error is that of the bistatic geometry, usually far below -80 dB.
Where straight rays of the mean speed are accurate enough, they are used, and samples stay as they
are. Every error is computed from exact rays, at sample pixels and channels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from clsas.core import validate
from clsas.core.decibels import in_db, power
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.signal.apparent_antennas import Change
from clsas.signal.apparent_pixels import apparent_grid
from clsas.signal.ray_delays import POINTS, RaySample, at_speed, straight_m
from clsas.sonar.beam import BeamWindow
from clsas.sonar.simplify import REFRACTION, SHARE

_LEVEL_M = 1e-6  # relief of a grid that counts as level


@dataclass(frozen=True, eq=False)
class Homogeneous:
    """Homogeneous water that takes the place of a profile for one geometry.

    Attributes
    ----------
    grid : Grid
        Pixels, at apparent positions if they do not lie on a level plane.
    sound_speed_m_s : float
        Speed of the homogeneous water; 0 if the lines have no profile.
    change : Change or None
        Apparent antennas and the changes of range axes; None for straight rays of the mean speed.
    error : float
        Upper bound of the relative error power of images.
    mean_error : float
        The same for straight rays of the mean speed.
    """

    grid: Grid
    sound_speed_m_s: float = 0.0
    change: Change | None = None
    error: float = 0.0
    mean_error: float = 0.0

    @property
    def left_out(self) -> tuple[str, ...]:
        """`REFRACTION` if straight rays are accurate enough."""
        return (REFRACTION,) if self.sound_speed_m_s and self.change is None else ()

    def lines(self, lines: RangeLines) -> RangeLines:
        """Return lines of the geometry in homogeneous water, unchanged without a profile."""
        if lines.sound_speed is None:
            return lines
        if self.change is None:
            return at_speed(lines, self.sound_speed_m_s)
        return self.change.lines(lines, self.sound_speed_m_s)


def homogeneous(
    lines: RangeLines, grid: Grid, beam: BeamWindow | None, allowed_db: float | None
) -> Homogeneous:
    """Return the homogeneous water in which to image lines with a profile.

    Parameters
    ----------
    lines : RangeLines
    grid : Grid
    beam : BeamWindow or None
    allowed_db : float or None
        Allowed relative rms error of the image, dB. With None, or if straight rays are not within
        a small share of its power, there are apparent antennas.

    Raises
    ------
    ValueError
        If the profile does not reach an antenna or a pixel, or a pixel lies in a shadow zone of a
        channel that should receive from it.

    Warns
    -----
    ClsasWarning
        If refraction alone causes more than half of the allowed error power.

    Notes
    -----
    The error is that of the worst sample pixel, at the highest frequency of the sampled band.
    """
    profile = lines.sound_speed
    if profile is None:
        return Homogeneous(grid)
    low, high = grid.bounds_m
    profile.check_reaches(np.array([low[2], high[2]]), "the grid's pixels")
    sample = RaySample.of(lines, grid, beam)
    if not sample.visible.any():
        middle = profile.mean_m_s(float(lines.tx_m[0, 2]), float((low[2] + high[2]) / 2))
        return Homogeneous(grid, middle)
    mean_m_s = sample.mean_speed_m_s()
    mean_error = _mean_error(sample, mean_m_s)
    allowed = 0.0 if allowed_db is None else power(allowed_db)
    if mean_error <= SHARE * allowed:
        return Homogeneous(grid, mean_m_s, None, mean_error, mean_error)
    change = Change.of(lines, sample, allowed_db, sample.middle_m)
    best = Homogeneous(grid, change.sound_speed_m_s, change, change.error(sample), mean_error)
    if best.error > SHARE * allowed and not _is_level(grid):
        change = Change.of(lines, sample, allowed_db, sample.middles_m(lines))
        moved = apparent_grid(grid, lines, sample, change)
        error = change.error(sample, moved.spread(POINTS))
        if error < best.error:
            best = replace(best, grid=moved, change=change, error=error)
    best = replace(best, error=best.error + power(change.accuracy_db))
    if allowed and best.error > allowed / 2:
        validate.warn(
            f"refraction leaves an error of up to {in_db(best.error):.0f} dB, and "
            f"{allowed_db:.3g} dB are requested: form the image in parts, as clsas.mosaic does"
        )
    return best


def _mean_error(sample: RaySample, sound_speed_m_s: float) -> float:
    """Return the squared phase error of the worst pixel with straight rays of one speed, rad^2."""
    lines = at_speed(sample.lines, sound_speed_m_s)
    return sample.error(lines, straight_m(lines, sample.points_m))


def _is_level(grid: Grid) -> bool:
    low, high = grid.bounds_m
    return bool(high[2] - low[2] <= _LEVEL_M)
