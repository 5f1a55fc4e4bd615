"""The swath: rays to the seabed, and windows of range."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Swath:
    """Part of the seabed that is measured, in windows of range.

    Attributes
    ----------
    edges_m : float64 [windows + 1]
        Ranges between windows.
    side : int
        1 where the seabed lies to port, -1 to starboard.
    seabed_z_m : float or None
        Height of the seabed; None takes every ray as horizontal.
    element_length_m : (transmitter, receiver) or None
        Lengths of the elements, whose beam weighs directions; None takes the beam as narrow.
    """

    edges_m: NDArray[np.float64]
    side: int = 1
    seabed_z_m: float | None = None
    element_length_m: tuple[float, float] | None = None

    @property
    def windows(self) -> int:
        """Number of windows."""
        return len(self.edges_m) - 1

    @property
    def middles_m(self) -> NDArray[np.float64]:
        """Ranges in the middle of the windows, [windows]."""
        return (self.edges_m[1:] + self.edges_m[:-1]) / 2

    def slopes(
        self, height_m: NDArray[np.float64], range_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the horizontal and vertical parts of unit rays that end on the seabed.

        `height_m` is that of where rays begin. Rays shorter than their height point straight down.
        """
        if self.seabed_z_m is None:
            return np.ones_like(range_m), np.zeros_like(range_m)
        down = np.clip((height_m - self.seabed_z_m) / range_m, -1.0, 1.0)
        return np.sqrt(1 - down**2), -down
