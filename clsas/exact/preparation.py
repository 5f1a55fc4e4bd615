"""Preparation: an exact image for which all decisions are made, before the device starts."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clsas.core.decibels import in_db, power
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.exact.groups import Groups
from clsas.exact.tiles import Tiles
from clsas.opencl.device import Device
from clsas.signal.ambiguity import Ambiguity
from clsas.signal.interpolation import Interpolator, Resampling
from clsas.signal.refraction import Homogeneous
from clsas.sonar.beam import BeamWindow


@dataclass(frozen=True, eq=False)
class Preparation:
    """Everything from which an exact image is formed.

    Attributes
    ----------
    device : Device
    lines : RangeLines
        Lines to image, without the effects that are left out.
    grid : Grid
        Pixels, without the relief if that is left out.
    layout : Tiles or Groups
        Parts into which the grid is divided.
    interpolator, resampling : Interpolator, Resampling
        Interpolation of range lines, and the upsampling before it.
    phase_terms : int
        Number of terms of the polynomials for sine and cosine.
    beam : BeamWindow or None
    along : float64 [channels, 3] or None
        Unit direction of the track at every channel; None without a beam.
    one_cubic : bool
        Whether one cubic of the beam's weights is used for all pixels of a work-item (tiles) or of
        a block (groups).
    requested_db : float
        Requested accuracy, dB. It is 0 with a fixed interpolator, with which any error is allowed.
    ambiguity : Ambiguity
        Errors that follow from the lines themselves.
    given_grid : Grid or None
        The requested grid, if its relief is left out in `grid`.
    left_out : tuple of str
        Effects that `lines` and `grid` leave out; see `clsas.sonar.simplify`.
    left_out_error : float
        Error power that the omissions add.
    is_reached : bool
        False if no line reaches any pixel. The image is then zero, and `layout` is that of a single
        pixel.
    band : (centre, half width)
        Band for which the interpolation is made, cycles per sample.
    water : Homogeneous or None
        Homogeneous water of `lines` and `grid`, to which lines with other samples are converted.
    """

    device: Device
    lines: RangeLines
    grid: Grid
    layout: Tiles | Groups
    interpolator: Interpolator
    resampling: Resampling
    phase_terms: int
    beam: BeamWindow | None = None
    along: NDArray[np.float64] | None = None
    one_cubic: bool = False
    requested_db: float = 0.0
    ambiguity: Ambiguity = field(default_factory=Ambiguity)
    given_grid: Grid | None = None
    left_out: tuple[str, ...] = ()
    left_out_error: float = 0.0
    is_reached: bool = True
    band: tuple[float, float] = (0.0, 0.5)
    water: Homogeneous | None = None

    @property
    def predicted_error_db(self) -> float:
        """Relative rms error, dB, of interpolation, ambiguous lines and effects left out."""
        of_passed = power(self.interpolator.error_db)
        error = of_passed / self.ambiguity.least_brightness + self.ambiguity.error_power
        return in_db(error + self.left_out_error)

    def warn_of_ambiguity(self) -> None:
        """Warn if the lines themselves may keep the image from meeting the requested accuracy."""
        self.ambiguity.warn("accuracy_db", self.requested_db)

    @property
    def samples_per_m(self) -> float:
        """Upsampled samples per metre of range."""
        return self.resampling.samples_per_m(self.lines)

    @property
    def cycles_per_m(self) -> float:
        """Phase to restore: that of the spectral centre of the lines, cycles per metre of range."""
        return self.resampling.cycles_per_m(self.lines)
