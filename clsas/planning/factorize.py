"""Factorized images: planned unless a plan is given, then formed."""

from __future__ import annotations

import weakref
from collections.abc import Callable

from clsas.core import validate
from clsas.core.decibels import in_db
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.lines import RangeLines
from clsas.exact.checks import check_accumulate
from clsas.factorized.left_out import without_left_out
from clsas.factorized.plan import Plan
from clsas.factorized.run import form
from clsas.opencl.device import Device, open_device
from clsas.planning.planner import BEST_TOLERANCE_DB, WORST_TOLERANCE_DB, plan
from clsas.signal.spectrum import FEW_CHANNELS, MEASURED_CHANNELS, power_outside
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

    A plan keeps the geometry of its first image, in `Plan.kept`, for the images after it.
    """
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    validate.memory("grid", 8 * grid.size)
    validate.progress(progress)
    device = open_device(device)
    if not isinstance(plan_or_tolerance, Plan):
        if isinstance(plan_or_tolerance, str):
            got = validate.shown(plan_or_tolerance)
            raise TypeError(
                f"plan_or_tolerance must be a Plan (Plan.from_json reads texts) or dB, got {got}"
            )
        validate.number(
            "plan_or_tolerance",
            plan_or_tolerance,
            "dB",
            least=BEST_TOLERANCE_DB,
            most=WORST_TOLERANCE_DB,
        )
        chosen = plan(lines, grid, tolerance_db=plan_or_tolerance, beam=beam, device=device)
    elif beam is not None:
        raise ValueError("beam must be left out with a plan, which holds its own")
    else:
        chosen = plan_or_tolerance
        chosen.check(lines, grid)
        _check_band(lines, chosen)
    if accumulate is not None:
        check_accumulate(accumulate, grid, chosen.beam)
    if chosen.left_out:
        image = Image(form(*without_left_out(chosen, lines, grid), device, progress).pixels, grid)
    else:
        image = form(lines, grid, chosen, device, progress)
    return image if accumulate is None else Image(image.pixels + accumulate.pixels, grid)


def _check_band(lines: RangeLines, chosen: Plan) -> None:
    """Warn where a plan was made for lines of another band."""
    known, band, tolerance_db = chosen.kept.get("lines"), chosen.image.band, chosen.tolerance_db
    if band is None or tolerance_db is None or (known is not None and known() is lines):
        return
    for channels in (FEW_CHANNELS, MEASURED_CHANNELS):
        outside_db = in_db(power_outside(lines, *band, channels))
        if outside_db <= tolerance_db:
            chosen.kept["lines"] = weakref.ref(lines)
            return
    if lines.samples.any():
        validate.warn(
            f"the lines hold {outside_db:.0f} dB of their power outside the band that the plan was "
            f"made for, so that the error may be more than {tolerance_db:g} dB: plan anew "
            "with clsas.plan"
        )
