"""Result of autofocus."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reprs
from clsas.engine.data.lines import RangeLines


@dataclass(frozen=True, eq=False)
class Autofocus:
    """Result of autofocus.

    Attributes
    ----------
    lines : RangeLines
        The given lines with corrected positions.
    correction_m : float64 [channels, 3]
        Displacement that was added to transmitters and receivers.
    correction_sd_m : float64 [channels]
        Standard deviation of the change of the correction from ping to ping. A shift and a linear
        trend of the track cannot be observed, and remain as they were.
    sharpness_before, sharpness_after : float
        Mean squared intensity of the image over its squared mean intensity. It is 2 for speckle,
        and larger for sharper images.
    sharpness : tuple of (step, float)
        Sharpness after each step that was tried.
    focused : bool
        False if the scene has no responses to focus on, or if the platform stood still. The lines
        are then unchanged.

    See Also
    --------
    autofocus : Function that returns this result.
    """

    lines: RangeLines
    correction_m: NDArray[np.float64]
    correction_sd_m: NDArray[np.float64]
    sharpness_before: float
    sharpness_after: float
    sharpness: tuple[tuple[str, float], ...]
    focused: bool

    def __repr__(self) -> str:
        """Return the rms correction and the sharpness before and after."""
        rms_m = float(np.sqrt(np.mean(np.sum(self.correction_m**2, axis=1))))
        return reprs.summary(
            self,
            f"correction {reprs.quantity(rms_m, 'm')} rms",
            f"sharpness {self.sharpness_before:.3g} to {self.sharpness_after:.3g}",
            None if self.focused else "not focused",
        )
