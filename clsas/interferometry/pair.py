"""The two banks of a sonar, and their images on one grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.opencl.device import Device
from clsas.planning.imager import Imager
from clsas.sonar.beam import BeamWindow


@dataclass(frozen=True, eq=False)
class Pair:
    """Range lines of two banks, and how their images are formed.

    Attributes
    ----------
    a, b : RangeLines
    tolerance_db, accuracy_db : float or None
        Error of the images, as for `clsas.Imager`; one of them is None.
    beam : BeamWindow or None
    device : Device
    """

    a: RangeLines
    b: RangeLines
    tolerance_db: float | None
    accuracy_db: float | None
    beam: BeamWindow | None
    device: Device

    def images(self, grid: Grid) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
        """Return the pixels of both banks' images."""
        first, second = (
            Imager(
                lines, grid, tolerance_db=self.tolerance_db, accuracy_db=self.accuracy_db,
                beam=self.beam, device=self.device,
            )(lines).pixels
            for lines in (self.a, self.b)
        )  # fmt: skip
        return first, second
