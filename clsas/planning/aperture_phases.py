"""Phases that subimages accumulate over the aperture, and the virtual channels they require."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.planning import phase_rates
from clsas.planning.sample_points import over_points, trapezoidal_weights
from clsas.planning.subimages import Side
from clsas.planning.visibility_model import VisibilityModel


@dataclass(frozen=True)
class AperturePhases:
    """Phases along the aperture and across a sheet: means over the sample points, or maxima.

    If the model has a root size, the phases are the largest within such roots.
    """

    model: VisibilityModel

    def subimage_phase_cycles(
        self, side: Side, visible: NDArray[np.bool_], *, most: bool = False
    ) -> float:
        """Return the cycles of the fastest phase in subimages of a size.

        The phase is accumulated along the visible part of the aperture, bool [points, samples].
        """
        extents = self.model.extents(side, most=most)
        return self._along(np.tensordot(extents, phase_rates.along(self.model), 1), visible, most)

    def beam_phase_cycles(self, visible: NDArray[np.bool_], *, most: bool = False) -> float:
        """Return the cycles that the beam's weights add along the visible aperture."""
        return self._along(phase_rates.of_beam_along(self.model), visible, most)

    def beam_phase_cycles_across(self, *, most: bool = False) -> float:
        """Return the cycles that the beam's weights add across a sheet; 0 without a sheet."""
        if not self.model.track.is_sheet:
            return 0.0
        return self._across(phase_rates.of_beam_across(self.model), most)

    def rows(
        self,
        side: Side,
        taps: float,
        density: float,
        beam_density: float = 0.0,
        *,
        most: bool = False,
    ) -> float:
        """Return the number of rows of virtual channels across a sheet; 1 without a sheet.

        `density` and `beam_density` are the rows per cycle of the phase, and per cycle of the
        beam's weights. `taps` are those of the filter, which extends past the edges.
        """
        if not self.model.track.is_sheet:
            return 1.0
        extents = self.model.extents(side, most=most)
        rates = density * np.tensordot(extents, phase_rates.across(self.model), 1)
        cycles = self._across(rates, most)
        if beam_density:
            cycles += beam_density * self.beam_phase_cycles_across(most=most)
        return cycles + taps

    def virtual_channels(self, taps: Any, density: float, phase_cycles: Any) -> Any:
        """Return the number of virtual channels of a subimage, from its phase in cycles.

        `taps` and `density`, in virtual channels per cycle, are those of the filter along the
        aperture, which extends past the track's ends. All arguments may be arrays.
        """
        strips, ends = self.model.track.strips, self.model.visible_track_ends
        return density * phase_cycles + strips + ends * (taps / 2 - 0.5)

    def _along(self, rates: NDArray[np.float64], visible: NDArray[np.bool_], most: bool) -> float:
        """Return the integral of rates, [points, samples], over the visible part of the track."""
        return over_points(np.where(visible, rates, 0.0) @ self.model.spacing, most)

    def _across(self, rates: NDArray[np.float64], most: bool) -> float:
        """Return the integral of rates, [points, samples], over a line across a sheet."""
        line = self.model.track.line_across(0.5)
        weights = np.where(line.on_track, trapezoidal_weights(line.samples), 0.0)
        return over_points(rates @ weights, most)
