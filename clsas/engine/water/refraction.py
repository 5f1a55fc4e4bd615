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
- What is still missing is added to the ranges of groups of pixels, see
  `ray_corrections`. Relief of metres needs it, and so do arrays that are long or move.

Where straight rays of the mean speed are accurate enough, they are used, and samples stay as they
are. Every error is computed from exact rays, at sample pixels and channels.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import in_db, power
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.simplify import REFRACTION, SHARE
from clsas.engine.data.sound_speed import check_reaches
from clsas.engine.water.apparent_antennas import Change
from clsas.engine.water.apparent_beam import apparent_beam
from clsas.engine.water.apparent_pixels import apparent_grid
from clsas.engine.water.ray_corrections import Corrections
from clsas.engine.water.ray_delays import RaySample, at_speed, straight_m

_MOST_KEPT_BYTES = 256 << 20  # of the samples of lines whose conversion is kept
_CORRECTED = 1 / 4  # of the allowed error power, above which ranges are corrected
_LEVEL_M = 1e-6  # relief of a grid that counts as level


@dataclass(frozen=True, eq=False)
class StraightRays:
    """Straight rays of the mean speed, and their errors at the visible pixels of a sample.

    Attributes
    ----------
    sound_speed_m_s : float
        Mean speed: that with which they fit the delays along exact rays best.
    error : float
        Squared phase error of the worst pixel, rad^2.
    away_s : float64 [pairs]
        Errors of the delays.
    """

    sound_speed_m_s: float
    error: float
    away_s: NDArray[np.float64]

    @classmethod
    def of(cls, sample: RaySample) -> StraightRays:
        """Return the straight rays that fit a sample best."""
        lines = at_speed(sample.lines, sample.mean_speed_m_s())
        range_m = straight_m(lines, sample.points_m)
        away_s = (2 * range_m / lines.sound_speed_m_s - sample.delay_s)[sample.visible]
        return cls(lines.sound_speed_m_s, sample.error(lines, range_m), away_s)

    @property
    def rms_s(self) -> float:
        """Rms error of the delays, seconds."""
        return float(np.sqrt(np.mean(self.away_s**2)))

    @property
    def most_s(self) -> float:
        """Largest error of the delays, seconds."""
        return float(np.abs(self.away_s).max())

    def image_error(self, frequency_hz: float) -> float:
        """Return the relative error power of an image at one frequency."""
        return float(np.mean(4 * np.sin(np.pi * frequency_hz * self.away_s) ** 2))


@dataclass(frozen=True, eq=False)
class Homogeneous:
    """Homogeneous water that takes the place of a profile for one geometry.

    Attributes
    ----------
    grid : Grid
        Pixels, at apparent positions if they do not lie on a level plane.
    beam : BeamWindow or None
        Beam whose weights are those of the rays' directions at the antennas.
    sound_speed_m_s : float
        Speed of the homogeneous water; 0 if the lines have no profile.
    change : Change or None
        Apparent antennas and the changes of range axes; None for straight rays of the mean speed.
    error : float
        Upper bound of the relative error power of images.
    straight : StraightRays or None
        Straight rays of the mean speed and their errors; None without a profile.
    corrections : Corrections or None
        Ranges that apparent antennas lack, for groups of pixels; None where they are accurate
        enough.
    """

    grid: Grid
    beam: BeamWindow | None = None
    sound_speed_m_s: float = 0.0
    change: Change | None = None
    error: float = 0.0
    straight: StraightRays | None = None
    corrections: Corrections | None = None
    _converted: WeakKeyDictionary[RangeLines, RangeLines] = field(
        default_factory=WeakKeyDictionary, repr=False
    )

    @property
    def left_out(self) -> tuple[str, ...]:
        """`REFRACTION` if straight rays are accurate enough."""
        return (REFRACTION,) if self.sound_speed_m_s and self.change is None else ()

    def lines(self, lines: RangeLines) -> RangeLines:
        """Return lines of the geometry in homogeneous water, unchanged without a profile.

        Lines of up to 256 MiB are converted once, for planning and for imaging, and kept as long as
        they exist.
        """
        if lines.sound_speed is None:
            return lines
        if self.change is None:
            return at_speed(lines, self.sound_speed_m_s)
        known = self._converted.get(lines)
        if known is None:
            known = self.change.lines(lines, self.sound_speed_m_s)
            if lines.samples.nbytes <= _MOST_KEPT_BYTES:
                self._converted[lines] = known
        return known


def homogeneous(
    lines: RangeLines,
    grid: Grid,
    beam: BeamWindow | None,
    allowed_db: float | None,
    *,
    corrected: bool = True,
) -> Homogeneous:
    """Return the homogeneous water in which to image lines with a profile.

    Parameters
    ----------
    lines : RangeLines
    grid : Grid
    beam : BeamWindow or None
    allowed_db : float or None
        Allowed relative rms error of the image, dB. Straight rays are used if they err by a small
        share of its power, or less than apparent antennas. With None, there are apparent antennas.
    corrected : bool
        Whether the image will have the `corrections`. The pixels of a level grid may then be given
        as points.

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
        return Homogeneous(grid, beam)
    low, high = grid.bounds_m
    check_reaches(profile, np.array([low[2], high[2]]), "the grid's pixels")
    sample = RaySample.of(lines, grid, beam)
    if not sample.visible.any():
        middle = profile.mean_m_s(float(lines.tx_m[0, 2]), float((low[2] + high[2]) / 2))
        return Homogeneous(grid, beam, middle)
    straight = StraightRays.of(sample)
    plain = Homogeneous(grid, beam, straight.sound_speed_m_s, None, straight.error, straight)
    allowed = 0.0 if allowed_db is None else power(allowed_db)
    if straight.error <= SHARE * allowed:
        found, of_steps = _with_beam(plain, lines, sample)
        return replace(found, error=found.error + of_steps)
    change = Change.of(lines, sample, allowed_db, sample.middle_m)
    best = Homogeneous(grid, beam, change.sound_speed_m_s, change, change.error(sample), straight)
    if best.error > SHARE * allowed and not _is_level(grid):
        change = Change.of(lines, sample, allowed_db, sample.middles_m(lines))
        moved = apparent_grid(grid, lines, sample, change)
        error = change.error(sample, moved.at(sample.pixels))
        if error < best.error:
            best = replace(best, grid=moved, change=change, error=error)
    if corrected and best.error > _CORRECTED * allowed:
        best = _corrected(best, lines, grid, sample)
    best = replace(best, error=best.error + power(change.accuracy_db))
    # In water of nearly one speed, moving receivers may err more at their apparent positions.
    if allowed and plain.error <= best.error:
        best = plain
    best, of_steps = _with_beam(best, lines, sample)
    if allowed and best.error > allowed / 2:
        validate.warn(
            f"refraction alone causes an error of up to {in_db(best.error):.0f} dB in some pixels, "
            f"which leaves little of the requested {allowed_db:.3g} dB, or nothing, to the rest: "
            "request less, or use smaller pixels or a mosaic"
        )
    return replace(best, error=best.error + of_steps)


def _corrected(water: Homogeneous, lines: RangeLines, grid: Grid, sample: RaySample) -> Homogeneous:
    """Return homogeneous water with corrections, if they reduce the error.

    Its pixels are then points, because only groups of points have corrections.
    """
    assert water.change is not None
    points = water.grid
    if points.points_m is None:
        points = Grid.points(points.positions_m(), georeference=points.georeference)
    corrections = Corrections.between(lines, water.beam, sample, water.change, (grid, points))
    error = corrections.error(sample)
    if error >= water.error:
        return water
    return replace(water, grid=points, corrections=corrections, error=error)


def _is_level(grid: Grid) -> bool:
    low, high = grid.bounds_m
    return bool(high[2] - low[2] <= _LEVEL_M)


def _with_beam(
    water: Homogeneous, lines: RangeLines, sample: RaySample
) -> tuple[Homogeneous, float]:
    """Return homogeneous water with the apparent beam and its error, and the error of steps.

    Steps at the ends of a window lie elsewhere. The image is then as good as the intended one,
    which is why this error, unlike all others, is no reason to warn.
    """
    if water.beam is None:
        return water, 0.0
    if water.change is None:
        straight = at_speed(sample.lines, water.sound_speed_m_s)
    else:
        straight = water.change.antennas(sample.lines, sample.channels)
    points_m = water.grid.at(sample.pixels)
    beam, error, of_steps = apparent_beam(water.beam, lines, sample, straight, points_m)
    return replace(water, beam=beam, error=water.error + error), of_steps
