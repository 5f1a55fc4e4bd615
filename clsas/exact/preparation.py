"""Everything decided about an exact image before the device starts."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clsas.core.decibels import in_db, power
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.exact.tiles import Groups, Tiles
from clsas.opencl.device import Device
from clsas.signal.ambiguity import Ambiguity
from clsas.signal.interpolation import Interpolator, Resampling
from clsas.sonar.beam import BeamWindow


@dataclass(frozen=True, eq=False)
class Preparation:
    """Everything decided before the device starts."""

    device: Device
    lines: RangeLines
    grid: Grid
    layout: Tiles | Groups
    interpolator: Interpolator
    resampling: Resampling
    phase_terms: int
    """Of the polynomials for sine and cosine."""
    beam: BeamWindow | None = None
    along: NDArray[np.float64] | None = None
    """The track's unit direction for every channel, [channels, 3]; None without a beam."""
    one_cubic: bool = False
    """Whether one cubic of the beam's weights serves a work-item of a tile, a block of points."""
    wanted_db: float = 0.0
    """What the image may err by; with a fixed interpolator anything."""
    ambiguity: Ambiguity = field(default_factory=Ambiguity)
    """Errors that the lines themselves leave open."""
    given_grid: Grid | None = None
    """The grid asked for, where `grid` leaves out its relief."""
    left_out: tuple[str, ...] = ()
    """Effects that `lines` and `grid` do without: see `clsas.sonar.simplify`."""
    left_out_error: float = 0.0
    """The power of the error that this adds."""

    @property
    def predicted_error_db(self) -> float:
        """Relative rms error, dB: of interpolation, what lines leave open and what is left out."""
        error = power(self.interpolator.error_db) + self.ambiguity.error_power
        return in_db(error + self.left_out_error)

    def warn_of_ambiguity(self) -> None:
        """Warn where the lines themselves may keep the image from the accuracy asked for."""
        self.ambiguity.warn("accuracy_db", self.wanted_db)

    @property
    def samples_per_m(self) -> float:
        """Upsampled samples per metre of range."""
        return self.resampling.samples_per_m(self.lines)

    @property
    def cycles_per_m(self) -> float:
        """Phase to restore per metre of range, cycles: of the lines' spectral centre."""
        return self.resampling.cycles_per_m(self.lines)
