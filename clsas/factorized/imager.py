"""Factorized images of any samples of one geometry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from clsas.aperture.mean_track import MeanTrack
from clsas.core.grid import Grid
from clsas.core.image import Image, holds_any
from clsas.core.lines import RangeLines
from clsas.exact.checks import check_numbers
from clsas.factorized.run import Run
from clsas.factorized.sectors import Roots
from clsas.factorized.surface import Surface
from clsas.opencl.device import Device, aligned
from clsas.plans.plan import Plan
from clsas.signal.refraction import Homogeneous, homogeneous
from clsas.sonar.coverage import reaches, warn_unreached
from clsas.sonar.simplify import Model, leave_out


@dataclass(frozen=True, eq=False)
class Known:
    """Results of planning that images need again. A missing one is computed when it is needed.

    Attributes
    ----------
    model : Model or None
        The scene without the effects that the plan leaves out.
    track : MeanTrack or None
        Its mean track, of the shape that the factorization has.
    surface : Surface or None
        The surface of its grid.
    water : Homogeneous or None
        Homogeneous water of the scene.
    """

    model: Model | None = None
    track: MeanTrack | None = None
    surface: Surface | None = None
    water: Homogeneous | None = None


NOTHING = Known()
"""What is known of a plan that was read, or made for lines that hardly differ."""


class FactorizedImager:
    """An imager that forms factorized images by a plan, of lines with one geometry.

    Parameters
    ----------
    lines : RangeLines
        Lines with that geometry. Their samples have no effect.
    grid : Grid
    plan : Plan
        A plan with a factorization, made for this geometry or for one that differs very little.
    device : Device
    known : Known
        Results of planning for the same lines and grid.
    warned : bool
        True if the user has already been warned that no line contributes to the image.
    """

    def __init__(
        self,
        lines: RangeLines,
        grid: Grid,
        plan: Plan,
        device: Device,
        *,
        known: Known = NOTHING,
        warned: bool = False,
    ) -> None:
        self._water = known.water or homogeneous(lines, grid, plan.beam, plan.tolerance_db)
        model = known.model or leave_out(
            self._water.lines(lines), self._water.grid, self._water.beam, plan.left_out
        )
        self.grid, self.plan, self.device = grid, plan, device.for_stages()
        self._model, self._warned = model, warned
        self._along = None if model.beam is None else model.beam.directions(model.lines)
        self._reached = reaches(model.lines, model.grid, model.beam, self._along)
        self._roots = Roots(
            model.lines,
            model.grid,
            plan.factorization,
            model.beam,
            track=known.track,
            surface=known.surface,
            corrections=self._water.corrections,
        )

    def form(self, lines: RangeLines, progress: Callable[[int, int], None] | None = None) -> Image:
        """Return the image of lines with the same geometry.

        Parameters
        ----------
        lines : RangeLines
        progress : callable, optional
            Called as progress(pixels done, pixels).
        """
        model, grid = self._model, self.grid
        lines = self._water.lines(lines)
        if self.plan.left_out:
            lines = replace(model.lines, samples=lines.samples)
        largest = check_numbers(lines, model.beam)
        if not self._reached:
            self._warn_unreached(lines)
            return Image(np.zeros(grid.shape, np.complex64), grid)
        pixels, done = aligned(np.empty, grid.shape, np.complex64), 0
        try:
            run = Run(lines, self.plan, self._roots, self.device, pixels, largest)
            for formed in run.parts():
                done += formed
                if progress is not None:
                    progress(done, grid.size)
        finally:
            self.device.finish()  # an interrupted run leaves nothing in use
        if not holds_any(pixels):
            self._warn_unreached(lines)
        return Image(pixels, grid)

    def _warn_unreached(self, lines: RangeLines) -> None:
        """Warn once that no line contributes to the image."""
        if not self._warned:
            self._warned = True
            warn_unreached(lines, self._model.grid, self._model.beam, self._along)
