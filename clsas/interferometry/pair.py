"""The two banks of a sonar, and their images on one grid."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.certificate import Certificate
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.device.device import Device
from clsas.engine.imaging import Imager
from clsas.engine.promise import is_wanted, measured_or_reason
from clsas.engine.water.refraction import homogeneous
from clsas.interferometry.coherence import Images


class PairImages(NamedTuple):
    """Images of both banks on one grid, what formed them, and their time."""

    first: Image
    second: Image
    imager: Imager
    seconds: float

    @property
    def pixels(self) -> Images:
        """The pixels of both."""
        return self.first.pixels, self.second.pixels


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

    def images(self, grid: Grid) -> PairImages:
        """Return the images of both banks, formed by one plan."""
        started = time.perf_counter()
        imager = Imager(
            self.a, grid, tolerance_db=self.tolerance_db, accuracy_db=self.accuracy_db,
            beam=self.beam, device=self.device,
        )  # fmt: skip
        first, second = (imager(lines, certificate=False) for lines in (self.a, self.b))
        return PairImages(first, second, imager, time.perf_counter() - started)

    def certificate(self, images: PairImages) -> tuple[Certificate | None, str]:
        """Return the larger measured error of both images, or None and why it is not known.

        The reason is "" if both took less time than images that are certified.
        """
        if not is_wanted(None, images.seconds):
            return None, ""
        found = []
        for image, lines in ((images.first, self.a), (images.second, self.b)):
            each, reason = measured_or_reason(
                image, lines, self.device, images.seconds / 2, self.tolerance_db
            )
            if each is None:
                return None, reason
            found.append(each)
        return max(found, key=lambda each: each.error), ""

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
