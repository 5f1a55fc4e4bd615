"""Factorized images of any samples of one scene."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clsas.aperture.mean_track import MeanTrack
from clsas.core.lines import RangeLines
from clsas.factorized.run import Run
from clsas.factorized.sectors import Roots
from clsas.opencl.device import Device, aligned
from clsas.plans.plan import Plan
from clsas.scene import Scene


class FactorizedImager:
    """Imager that forms factorized images of any samples of a scene.

    Parameters
    ----------
    scene : Scene
    plan : Plan
        A plan with a factorization, made for this geometry or for one that differs very little.
    device : Device
    track : MeanTrack, optional
        The mean track, of the shape that the factorization has, if planning has found it.
    """

    def __init__(
        self, scene: Scene, plan: Plan, device: Device, track: MeanTrack | None = None
    ) -> None:
        self.plan, self.device, self._shape = plan, device.for_stages(), scene.grid.shape
        self._roots = Roots(scene, plan.factorization, track)

    def form(
        self,
        lines: RangeLines,
        largest: float,
        progress: Callable[[int, int], None] | None = None,
    ) -> NDArray[np.complex64]:
        """Return the pixels of the image of lines of the scene, as they are imaged.

        Parameters
        ----------
        lines : RangeLines
        largest : float
            Largest magnitude of a sample.
        progress : callable, optional
            Called as progress(pixels done, pixels).
        """
        pixels, done = aligned(np.empty, self._shape, np.complex64), 0
        run = Run(lines, self.plan, self._roots, self.device, pixels, largest)
        for formed in run.parts():
            done += formed
            if progress is not None:
                progress(done, pixels.size)
        return pixels
