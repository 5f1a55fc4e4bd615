"""Factorized images of range lines, by a given plan or within a tolerance."""

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
    """Return the image of range lines, formed by fast factorized backprojection.

    Parameters
    ----------
    lines : RangeLines
        Any number of channels, monostatic, bistatic or moving.
    grid : Grid
        Any number of pixels: a plane, a height map or arbitrary points.
    plan_or_tolerance : Plan or float
        A plan that `clsas.plan` made for these lines and this grid, or the largest relative rms
        error against the exact image, dB, from -75 to -10. With a tolerance, the image is planned
        first.
    beam : BeamWindow, optional
        Weights of the channels by aspect angle. Must be left out with a plan, which contains its
        own.
    device : Device, str or int, optional
        See `clsas.opencl.device.choose`.
    accumulate : Image, optional
        Image on the same grid to which this one is added, so that data may arrive in pieces. The
        tolerance applies to the new image alone.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    Image
        complex64, phase-preserving.

    Raises
    ------
    TypeError, ValueError
        If an argument is not allowed, the plan was made for other lines or another grid, `beam` is
        given with a plan, or `accumulate` is on another grid or given with a beam that normalises.
    DeviceError
        If the device does not exist.

    Warns
    -----
    ClsasWarning
        If the lines have power outside the band that the plan was made for, or are too large for
        the half precision that it chose; if no line adds anything to the image; and, with a
        tolerance, for the reasons of `clsas.plan`.

    See Also
    --------
    plan : The fastest image within a tolerance, with its predicted error, time and memory.
    Imager : Form several images of the same geometry in less time.
    backproject : Form the exact image.

    Notes
    -----
    The exact image of a pixel x is the sum over channels n of s_n f_n(x), where s_n is the sample
    at the pixel's range and ``f_n(x) = exp(j 2 k rho_n(x))`` is the channel's steering function.
    If phases are taken relative to the centre c of a subimage,
    ``f_n(x) = exp(j 2 k (rho_n(x) - rho_n(c)))``, they vary slowly along the aperture within the
    subimage. The steering functions can then be interpolated from those of fewer, virtual channels
    m with coefficients a_nm ::

        f_n(x) = sum_m a_nm f_m(x)
        sum_n s_n f_n(x) = sum_m (sum_n a_nm s_n) f_m(x)

    Lines of the virtual channels are thus weighted sums of aligned lines. The next stage divides
    the subimage and combines its virtual channels in the same way [1]_; the thesis does so with the
    nearest beam instead of an interpolation [2]_. The last subimages are backprojected.

    A plan may store lines between stages in half precision. Sums are in single precision.

    References
    ----------
    .. [1] Ulander, Hellsten, Stenström, "Synthetic-aperture radar processing using fast factorized
       back-projection", IEEE Transactions on Aerospace and Electronic Systems 39(3), 2003.
    .. [2] Ødegaard, "Fast time domain beamforming for synthetic aperture sonar", thesis,
       University of Oslo, 2004.

    Examples
    --------
    The image is within the tolerance of the exact one:

    >>> import clsas
    >>> import numpy as np
    >>> tx_m = np.outer(np.arange(64), [0.02, 0, 0])
    >>> point = clsas.PointTargets([[0.6, 20.0, 0.0]], [1.0])
    >>> lines = clsas.simulate_lines(tx_m, tx_m, point, carrier_hz=100e3, bandwidth_hz=20e3)
    >>> grid = clsas.Grid.plane((0.4, 0.8, 32), (19.8, 20.2, 32))
    >>> plan = clsas.plan(lines, grid, tolerance_db=-40, depth=1)
    >>> image = clsas.factorize(lines, grid, plan)
    >>> exact = clsas.backproject(lines, grid, accuracy_db=-60)
    >>> clsas.relative_error_db(image, exact) <= -40
    True
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
