"""Forming images: the only place where the image of a scene is formed, exactly or factorized."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reprs
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.digests import samples_digest
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Formed, Image, holds_any
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.version import __version__
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
        Whether the geometry of a factorization, or references of exact images, are kept for the
        next image.
    decision : Decision, optional
        How an exact image is formed, if that is known.
    tolerance_db : float, optional
        Tolerance that was requested, if the image is formed to another one than its plan's.

    Attributes
    ----------
    plan : Plan or ExactImage
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
        tolerance_db: float | None = None,
    ) -> None:
        self.scene, self.device, self._warned = scene, device, warned
        self.plan, self.decision, self._tolerance_db = plan, decision, tolerance_db
        method = plan.method if isinstance(plan, Plan) else plan
        if isinstance(method, ExactImage):
            self.decision = decision or decide(
                scene, device, method.accuracy_db, taps=method.taps, upsampling=method.upsampling
            )
            self._exact = ExactImager(scene, self.decision, device, keep=keep)
        else:
            assert isinstance(plan, Plan)
            self._factorized = FactorizedImager(scene, plan, device, track, keep=keep)

    @property
    def suits_track(self) -> bool:
        """False if the antennas have no mean track of the shape that the plan needs."""
        return self.decision is not None or self._factorized.track is not None

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
        digest = samples_digest(lines)
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
        pixels = pixels.reshape(scene.given_grid.shape)
        return Image(pixels, scene.given_grid, formed=self._formed(pixels, digest))

    def _formed(self, pixels: NDArray[np.complex64], digest: str) -> Formed:
        """Return how pixels were formed; `digest` is that of their lines."""
        plan, scene = self.plan, self.scene
        if self._tolerance_db is not None:
            tolerance_db: float | None = self._tolerance_db
        elif isinstance(plan, Plan):
            tolerance_db = plan.tolerance_db
        else:
            is_fixed = plan.taps is not None and plan.upsampling is not None
            tolerance_db = None if is_fixed else plan.accuracy_db
        if self.decision is not None:
            words, error_db = self.decision.describe(), self.decision.error_db(scene)
        else:
            assert isinstance(plan, Plan)
            sides = ", ".join(map(reprs.by, plan.sides))
            words = f"subimages of {sides} pixels, {plan.factorization.describe()}"
            error_db = plan.predicted_error_db
        return Formed(
            method="factorized" if self.decision is None else "exact",
            tolerance_db=tolerance_db,
            plan=words,
            predicted_error_db=error_db if holds_any(pixels) else None,
            beam=scene.given_beam,
            left_out=scene.left_out,
            device=self.device.info.label,
            version=__version__,
            lines_digest=digest,
        )


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
