"""The two banks of a sonar, and their images on one grid."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.certificate import Certificate
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.device.device import Device
from clsas.engine.imaging import Imager
from clsas.engine.promise import is_wanted, measured_if_possible
from clsas.engine.water.refraction import homogeneous
from clsas.interferometry.coherence import Images


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

    def images(self, grid: Grid) -> Images:
        """Return the pixels of both banks' images."""
        return self.image(self.a, grid).pixels, self.image(self.b, grid).pixels

    def image(self, lines: RangeLines, grid: Grid) -> Image:
        """Return the image of one of the banks."""
        imager = Imager(
            lines, grid, tolerance_db=self.tolerance_db, accuracy_db=self.accuracy_db,
            beam=self.beam, device=self.device,
        )  # fmt: skip
        return imager(lines, certificate=False)

    def certificate(self, a: Image, b: Image, seconds: float) -> Certificate | None:
        """Return the measured error of that bank's image which errs more.

        It is None if both took less time than images that are certified, or if that of a bank
        cannot be measured.
        """
        if not is_wanted(None, seconds):
            return None
        found = []
        for image, lines in ((a, self.a), (b, self.b)):
            each = measured_if_possible(image, lines, self.device, seconds / 2, self.tolerance_db)
            if each is None:
                return None
            found.append(each)
        return max(found, key=lambda each: each.error)

    def straightened(self, grid: Grid) -> Pair:
        """Return the pair in homogeneous water, unchanged without a profile of the sound speed.

        Delays are those of exact rays on a level plane through the middle of the grid, and echoes
        come from the right direction. A metre above or below, heights err by some millimetres.
        """
        if self.a.sound_speed is None and self.b.sound_speed is None:
            return self
        level_only = np.array([1.0, 1.0, 0.0])
        origin_m, row_step_m, column_step_m = grid.vectors_m
        low_m, high_m = grid.bounds_m
        level = Grid.oriented(
            origin_m * level_only + [0, 0, (low_m[2] + high_m[2]) / 2],
            row_step_m * level_only,
            column_step_m * level_only,
            (grid.shape[0], grid.shape[1]),
            georeference=grid.georeference,
        )
        first, second = (
            homogeneous(lines, level, self.beam, None, corrected=False).lines(lines)
            for lines in (self.a, self.b)
        )
        return replace(self, a=first, b=second)
