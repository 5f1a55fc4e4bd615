"""Formers of images by a plan, exact or factorized."""

from __future__ import annotations

from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.exact.backprojection import prepare
from clsas.exact.run import ExactImager
from clsas.factorized.imager import NOTHING, FactorizedImager, Known
from clsas.opencl.device import Device
from clsas.plans.factorization import ExactImage
from clsas.plans.plan import Plan

Former = ExactImager | FactorizedImager
"""Object that forms images of any samples of one geometry, without checks."""


def former(
    lines: RangeLines,
    grid: Grid,
    plan: Plan,
    device: Device,
    *,
    known: Known = NOTHING,
    warned: bool = False,
) -> Former:
    """Return the former of images by a plan. It neither checks lines nor warns of ambiguous ones.

    Parameters
    ----------
    lines, grid, plan, device
        The plan may have been made for lines whose channels lie slightly beside these.
    known : Known
        Results of planning for the same lines and grid.
    warned : bool
        True if the user has already been warned that no line adds anything to the image.
    """
    if isinstance(plan.method, ExactImage):
        accuracy_db = plan.method.accuracy_db
        preparation = prepare(
            lines, grid, accuracy_db=accuracy_db, beam=plan.beam, device=device, water=known.water
        )
        return ExactImager(preparation, warned=warned)
    return FactorizedImager(lines, grid, plan, device, known=known, warned=warned)
