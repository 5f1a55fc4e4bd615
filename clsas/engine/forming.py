"""Forming images: the only place where the image of a scene is formed, exactly or factorized."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image, holds_any
from clsas.engine.data.lines import RangeLines
from clsas.engine.device.device import Device, open_device
from clsas.engine.exact.decide import ACCURACY_DB, Decision, decide
from clsas.engine.exact.run import ExactImager
from clsas.engine.factorized.plan import ExactImage, Plan
from clsas.engine.factorized.stages import FactorizedImager
from clsas.engine.factorized.track import MeanTrack
from clsas.engine.scene import Scene, check_numbers

Progress = Callable[[int, int], None]
"""Called as progress(done, total)."""


class SceneImager:
    """Imager of any samples of one scene, without checks of their geometry.

    Parameters
    ----------
    scene : Scene
    plan : Plan or ExactImage
        How to form the image. Of a plan for an exact image, only the method matters.
    device : Device
    track : MeanTrack, optional
        The mean track of a factorization, if planning has found it.
    warned : bool
        True if the user need not be warned that no line adds anything to the image.
    keep : bool
        Whether references of exact images are kept for the next one.
    decision : Decision, optional
        How an exact image is formed, if that is known.

    Attributes
    ----------
    decision : Decision or None
        How an exact image is formed; None for a factorized one.
    """

    def __init__(
        self,
        scene: Scene,
        plan: Plan | ExactImage,
        device: Device,
        *,
        track: MeanTrack | None = None,
        warned: bool = False,
        keep: bool = True,
        decision: Decision | None = None,
    ) -> None:
        self.scene, self.device, self._warned = scene, device, warned
        self.decision = decision
        method = plan.method if isinstance(plan, Plan) else plan
        if isinstance(method, ExactImage):
            self.decision = decision or decide(
                scene, device, method.accuracy_db, taps=method.taps, upsampling=method.upsampling
            )
            self._exact = ExactImager(scene, self.decision, device, keep=keep)
        else:
            assert isinstance(plan, Plan)
            self._factorized = FactorizedImager(scene, plan, device, track)

    def form(self, lines: RangeLines, progress: Progress | None = None) -> Image:
        """Return the image of lines of the scene's geometry.

        Parameters
        ----------
        lines : RangeLines
            As they were given, not as they are imaged.
        progress : callable, optional
            Called as progress(done, total).
        """
        scene, largest = self.scene, self.scene.largest_sample
        if lines is not scene.given_lines:
            lines = scene.with_samples(lines)
            largest = check_numbers(lines, scene.beam)
        else:
            lines = scene.lines
        pixels = np.zeros(scene.grid.shape, np.complex64)
        if scene.is_reached:
            try:
                if self.decision is not None:
                    pixels = self._exact.form(lines, progress)
                else:
                    pixels = self._factorized.form(lines, largest, progress)
            finally:
                self.device.finish()  # an interrupted run leaves nothing in use
        if not self._warned and not holds_any(pixels):
            self._warned = True
            scene.warn_unreached(lines)
        return Image(pixels.reshape(scene.given_grid.shape), scene.given_grid)


def form(
    scene: Scene,
    plan: Plan | ExactImage,
    device: Device,
    *,
    track: MeanTrack | None = None,
    warned: bool = False,
    progress: Progress | None = None,
) -> Image:
    """Return the image of a scene, by a plan or exactly; the parameters are those of `SceneImager`.

    Every image is formed here or by `SceneImager`, which forms several of one geometry.
    """
    imager = SceneImager(scene, plan, device, track=track, warned=warned, keep=False)
    return imager.form(scene.given_lines, progress)


def form_exactly(
    lines: RangeLines,
    grid: Grid,
    *,
    accuracy_db: float = ACCURACY_DB,
    beam: BeamWindow | None = None,
    device: Device | str | int | None = None,
    progress: Progress | None = None,
) -> Image:
    """Return the image of `clsas.backproject`, without its checks and warnings."""
    scene = Scene.of(lines, grid, beam, accuracy_db)
    return form(scene, ExactImage(accuracy_db), open_device(device), progress=progress)


def scene_of_plan(lines: RangeLines, grid: Grid, plan: Plan) -> Scene:
    """Return the scene of lines and a grid for which a plan was made."""
    return Scene.of(lines, grid, plan.beam, plan.tolerance_db, left_out=plan.left_out)
