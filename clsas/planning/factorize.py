"""Factorized images: planned unless a plan is given, then formed."""

from __future__ import annotations

from collections.abc import Callable

from clsas.core import validate
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.lines import RangeLines
from clsas.opencl.device import Device
from clsas.planning.imager import Imager
from clsas.planning.request import BEST_TOLERANCE_DB, WORST_TOLERANCE_DB
from clsas.plans.plan import Plan
from clsas.sonar.beam import BeamWindow


def factorize(
    lines: RangeLines,
    grid: Grid,
    plan_or_tolerance: Plan | float,
    *,
    beam: BeamWindow | None = None,
    device: Device | str | int | None = None,
    accumulate: Image | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Image:
    """Form the image of range lines fast, to a tolerance.

    Parameters
    ----------
    lines : RangeLines
        Any number of channels, monostatic, bistatic or moving.
    grid : Grid
        Any number of pixels: a plane, a height map or arbitrary points.
    plan_or_tolerance : Plan or float
        A plan made by `clsas.plan` for these lines and this grid, or the relative rms error
        wanted against the exact image, dB, from -75 to -10.
    beam : BeamWindow, optional
        Weights of the channels; a plan holds its own.
    device : Device, str or int, optional
        See `clsas.opencl.device.choose`.
    accumulate : Image, optional
        Image on the same grid that this one is added to, so that data may arrive in pieces. The
        tolerance is of this image alone.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    Image
        complex64, phase-preserving.

    Raises
    ------
    TypeError, ValueError
        If an argument is not what is allowed, the plan was made for other lines or another grid,
        `beam` is given beside a plan, or `accumulate` is on another grid or beside a beam that
        normalises.
    DeviceError
        If there is no such device.

    Warns
    -----
    ClsasWarning
        If a plan was made for lines of another band, lines cannot be held in half precision as
        planned, no channel sees anything of the grid, or as `clsas.plan` does.

    Notes
    -----
    Aligned on a subimage's centre c, channel n's steering function exp(j 2 k (rho_n(x) - rho_n(c)))
    varies slowly along the track, and is interpolated from those of fewer, virtual channels:
    f_n ~ sum_m a_nm f_m. Hence sum_n s_n f_n ~ sum_m (sum_n a_nm s_n) f_m: the virtual channels'
    lines are weighted sums of aligned lines, and so on from stage to stage. A plan may hold these
    lines in half precision; sums are single.

    `clsas.Imager` forms several images of the same geometry in less time.
    """
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    validate.progress(progress)
    if isinstance(plan_or_tolerance, Plan):
        imager = Imager(lines, grid, plan_or_tolerance, beam=beam, device=device)
        return imager(lines, accumulate=accumulate, progress=progress)
    if isinstance(plan_or_tolerance, str):
        got = validate.shown(plan_or_tolerance)
        raise TypeError(
            f"plan_or_tolerance must be a Plan (Plan.from_json reads texts) or dB, got {got}"
        )
    tolerance_db = validate.number(
        "plan_or_tolerance",
        plan_or_tolerance,
        "dB",
        least=BEST_TOLERANCE_DB,
        most=WORST_TOLERANCE_DB,
    )
    imager = Imager(lines, grid, tolerance_db=tolerance_db, beam=beam, device=device)
    return imager(lines, accumulate=accumulate, progress=progress)
