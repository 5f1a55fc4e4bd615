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

Every error is computed from exact rays, at sample pixels and channels.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import numpy as np

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import in_db, power
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.simplify import SHARE
from clsas.engine.data.sound_speed import check_reaches
from clsas.engine.water.apparent_antennas import Change
from clsas.engine.water.apparent_beam import apparent_beam
from clsas.engine.water.apparent_pixels import apparent_grid
from clsas.engine.water.ray_corrections import Corrections
from clsas.engine.water.ray_delays import RaySample, at_speed

_MOST_KEPT_BYTES = 256 << 20  # of the samples of lines whose conversion is kept
_CORRECTED = 1 / 4  # of the allowed error power, above which ranges are corrected
_LEVEL_M = 1e-6  # relief of a grid that counts as level


@dataclass(frozen=True, eq=False)
class Homogeneous:
    """Homogeneous water that takes the place of a profile for one geometry.

    Attributes
    ----------
    grid : Grid
        Pixels, at apparent positions if they do not lie on a level plane.
    beam : BeamWindow or None
        Beam whose weights are those of the rays' directions at the antennas.
    change : Change or None
        Apparent antennas and the changes of range axes; None without a profile, or if no pixel is
        visible.
    error : float
        Upper bound of the relative error power of images.
    corrections : Corrections or None
        Ranges that apparent antennas lack, for groups of pixels; None where they are accurate
        enough.
    """

    grid: Grid
    beam: BeamWindow | None = None
    change: Change | None = None
    error: float = 0.0
    corrections: Corrections | None = None
    _converted: WeakKeyDictionary[RangeLines, RangeLines] = field(
        default_factory=WeakKeyDictionary, repr=False
    )

    def lines(self, lines: RangeLines) -> RangeLines:
        """Return lines of the geometry in homogeneous water, unchanged without a profile.

        Lines of up to 256 MiB are converted once, for planning and for imaging, and kept as long as
        they exist.
        """
        if lines.sound_speed is None:
            return lines
        if self.change is None:  # at any speed of the profile, nothing is visible
            return at_speed(lines, float(lines.sound_speed.speed_m_s[0]))
        known = self._converted.get(lines)
        if known is None:
            known = self.change.lines(lines)
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
        Allowed relative rms error of the image, dB. Pixels are moved, and ranges corrected, only
        where the error without it would take a share of its power. With None, both are always done.
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
        return Homogeneous(grid, beam)
    allowed = 0.0 if allowed_db is None else power(allowed_db)
    apparent, corrections = grid, None
    change = Change.of(lines, sample, allowed_db, sample.middle_m)
    error = change.error(sample, sample.points_m)

    if error > SHARE * allowed and high[2] - low[2] > _LEVEL_M:
        for_relief = Change.of(lines, sample, allowed_db, sample.middles_m(lines))
        moved = apparent_grid(grid, lines, sample, for_relief)
        left = for_relief.error(sample, moved.at(sample.pixels))
        if left < error:
            change, apparent, error = for_relief, moved, left

    if corrected and error > _CORRECTED * allowed:
        points = apparent  # only groups of points have corrections
        if points.points_m is None:
            points = Grid.points(points.positions_m(), georeference=points.georeference)
        found = Corrections.between(lines, beam, sample, change, (grid, points))
        left = found.error(sample)
        if left < error:
            corrections, apparent, error = found, points, left

    error, of_steps = error + change.resampling_error, 0.0
    if beam is not None:
        straight = change.antennas(sample.lines, sample.channels)
        beam, of_weights, of_steps = apparent_beam(
            beam, lines, sample, straight, apparent.at(sample.pixels)
        )
        error += of_weights
    if allowed and error > allowed / 2:
        validate.warn(
            f"refraction alone causes an error of up to {in_db(error):.0f} dB in some pixels, "
            f"which leaves little of the requested {allowed_db:.3g} dB, or nothing, to the rest: "
            "request less, or use smaller pixels or a mosaic"
        )
    # Where a window's steps lie elsewhere, the image is as good as the intended one: no reason to
    # warn, although it is an error.
    return Homogeneous(apparent, beam, change, error + of_steps, corrections)
