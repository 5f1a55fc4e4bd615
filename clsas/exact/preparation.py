"""Preparation: an exact image with all decisions made, before the device starts."""

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
from clsas.sonar.beam import BeamWindow


@dataclass(frozen=True, eq=False)
class Preparation:
    """An exact image that is ready to be formed.

    Attributes
    ----------
    device : Device
    lines : RangeLines
        The lines to image, without the effects that are left out.
    grid : Grid
        The pixels, without the relief if that is left out.
    layout : Tiles or Groups
        The parts into which the grid is divided.
    interpolator, resampling : Interpolator, Resampling
        The interpolation of range lines, and their upsampling before it.
    phase_terms : int
        Terms of the polynomials for sine and cosine.
    beam : BeamWindow or None
    along : float64 [channels, 3] or None
        The track's unit direction at every channel; None without a beam.
    one_cubic : bool
        Whether one cubic of the beam's weights serves a work-item of a tile, or a block of points.
    requested_db : float
        Accuracy asked for. It is 0 dB with a fixed interpolator: any error is allowed.
    ambiguity : Ambiguity
        Errors that the lines themselves leave open.
    given_grid : Grid or None
        The grid asked for, where `grid` leaves out its relief.
    left_out : tuple of str
        Effects that `lines` and `grid` leave out: see `clsas.sonar.simplify`.
    left_out_error : float
        Error power that this adds.
    is_reached : bool
        False if no line reaches any pixel: the image is zero, and `layout` that of a single pixel.
    band : (centre, half width)
        Band, in cycles per sample, that the interpolation is made for.
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

    @property
    def predicted_error_db(self) -> float:
        """Relative rms error, dB, of interpolation, ambiguous lines and effects left out."""
        of_passed = power(self.interpolator.error_db)
        error = of_passed / self.ambiguity.least_brightness + self.ambiguity.error_power
        return in_db(error + self.left_out_error)

    def warn_of_ambiguity(self) -> None:
        """Warn if the lines themselves may keep the image from the accuracy asked for."""
        self.ambiguity.warn("accuracy_db", self.requested_db)

    @property
    def samples_per_m(self) -> float:
        """Upsampled samples per metre of range."""
        return self.resampling.samples_per_m(self.lines)

    @property
    def cycles_per_m(self) -> float:
        """Phase to restore, cycles per metre of range: that of the lines' spectral centre."""
        return self.resampling.cycles_per_m(self.lines)
