"""The front door: plans, factorized and exact images, and imagers of many images.

An image is formed in three steps. `Scene.of` makes lines, grid and beam ready. A plan is searched,
unless it is given or the image is to be exact. `form` then forms the image, exactly or by the
factorization of the plan.
"""

from __future__ import annotations

import time
import weakref
from collections.abc import Callable, Sequence
from functools import partial
from types import TracebackType
from typing import Annotated

from clsas.engine.data import reprs, validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import in_db, power
from clsas.engine.data.declared import check_declared
from clsas.engine.data.digests import lines_digest
from clsas.engine.data.georeference import placed
from clsas.engine.data.grid import Grid, check_one_grid, one_placed
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError, ArgumentTypeError
from clsas.engine.device.device import Device, open_device
from clsas.engine.exact.decide import ACCURACY, ACCURACY_DB, BEST_ACCURACY_DB
from clsas.engine.factorized.costs import Costs
from clsas.engine.factorized.plan import ExactImage, Plan
from clsas.engine.factorized.planner import TOLERANCE, Request, planned
from clsas.engine.forming import Progress, SceneImager, form, scene_of_plan
from clsas.engine.promise import (
    CERTIFICATE,
    ON_MISS,
    FormAgain,
    certified,
    is_wanted,
)
from clsas.engine.scene import Scene
from clsas.engine.signal.spectrum import (
    FEW_CHANNELS,
    MEASURED_CHANNELS,
    OUTSIDE,
    occupied_band,
    power_outside,
)

_SAME = {"carrier_hz": 0.01, "sound_speed_m_s": 0.01, "range_step_m": 0.01, "length": 0.0}
"""Largest relative differences of lines that one imager may image: filters depend on these."""


def plan(
    lines: RangeLines,
    grid: Grid,
    *,
    tolerance_db: float | None = None,
    tolerance_wavelengths: float | None = None,
    stages: Sequence[tuple[int, int]] | None = None,
    beam: BeamWindow | None = None,
    device: Device | str | int | None = None,
    memory_bytes: int | None = None,
    costs: Costs | None = None,
    taps: tuple[int, int] | None = None,
    depth: int | None = None,
    full_model: bool = False,
) -> Plan:
    """Return the plan of the fastest image within a tolerance.

    Exactly one of `tolerance_db`, `tolerance_wavelengths` and `stages` must be given.

    Parameters
    ----------
    lines : RangeLines
        Lines to image. Only the spectrum of their samples, and how far they fade towards the ends
        of the lines, influence the plan.
    grid : Grid
        Pixels of the image.
    tolerance_db : float, optional
        Largest relative rms error against the exact image, dB, from -85 to -10.
    tolerance_wavelengths : float, optional
        The same tolerance as a range error, in wavelengths of the carrier; see Notes.
    stages : sequence of (QR, QI), optional
        Form the image by the thesis's method, with nearest beams and linear interpolation in range
        [2]_. Every stage sums QR neighbouring lines and divides subimages by QI along either side;
        the last subimages are backprojected. An empty sequence is plain backprojection.
    beam : BeamWindow, optional
        Weights of the channels by aspect angle.
    device : Device, str or int, optional
        Device that forms the image; see `clsas.engine.device.device.choose`.
    memory_bytes : int, optional
        Device memory that may be used. The default is half of the device's memory, or as much as
        plain backprojection needs.
    costs : Costs, optional
        Costs of each kind of work, instead of those stored for the device. If none are stored, the
        first search for a factorization measures how fast the device is, for 0.3 to 0.6 s, scales
        the default costs and stores them.
    taps : (range, aperture), optional
        For studies, with a tolerance: number of taps of the filters in range and along the
        aperture, 4, 6 or 8 each, instead of the fastest.
    depth : int, optional
        For studies, with a tolerance: number of stages, 1 to 5, instead of the fastest.
    full_model : bool
        For studies: model every effect, including those whose error lies far below the tolerance.

    Returns
    -------
    Plan
        How the image is formed, with its predicted error, time and memory. The plan is that of an
        exact image if no factorization is faster: close to the aperture, with few channels or
        pixels, or with much relief.

    Raises
    ------
    TypeError, ValueError
        If an argument is not allowed, or no plan fits the memory. In the latter case the message
        states how much memory is needed.
    DeviceError
        If the device does not exist.

    Warns
    -----
    ClsasWarning
        If the image may miss the tolerance, because the grid reaches ends of lines that do not
        fade, or because the lines' band fills the whole sampled band; if no pixel lies within the
        range of any line and the beam, so that the image will be zero; if pixels lie behind the
        elements, where they can only show mirror images; if lines, grid or beam cannot be
        right, such as positions in millimetres; or if the costs stored for the device
        cannot be read, or measured ones cannot be stored.

    See Also
    --------
    factorize : Form the image by a plan.
    Imager : Form several images by a plan.
    backproject : Form the exact image.

    Notes
    -----
    A factorized image divides the grid into subimages within subimages, and combines the channels
    of each into fewer, virtual ones, stage by stage [1]_. The search tries numbers of stages, taps
    of filters, and sizes of subimages, each of which is twice as large as the one before it. It
    predicts the time of each factorization from counts of its operations, and the error from the
    sum of the powers of independent contributions (`Plan.errors`). The plan is the fastest
    factorization whose predicted error, with a margin for the scatter of measured ones, is within
    the tolerance.

    Range errors that are spread evenly between minus and plus w wavelengths turn phases by up to
    4 pi w. The relative rms error is therefore 4 pi w/sqrt(3), and ::

        tolerance_db = 20 log10(4 pi tolerance_wavelengths/sqrt(3))

    References
    ----------
    .. [1] Ulander, Hellsten, Stenström, "Synthetic-aperture radar processing using fast factorized
       back-projection", IEEE Transactions on Aerospace and Electronic Systems 39(3), 2003.
    .. [2] Ødegaard, "Fast time domain beamforming for synthetic aperture sonar", thesis,
       University of Oslo, 2004, chapter 4.

    Examples
    --------
    The planner decides whether a factorization is faster than the exact image. A small image is
    exact:

    >>> import clsas
    >>> import numpy as np
    >>> tx_m = np.outer(np.arange(64), [0.02, 0, 0])
    >>> point = clsas.PointTargets([[0.6, 20.0, 0.0]], [1.0])
    >>> lines = clsas.simulate_lines(tx_m, tx_m, point, carrier_hz=100e3, bandwidth_hz=20e3)
    >>> grid = clsas.Grid.plane((0.4, 0.8, 32), (19.8, 20.2, 32))
    >>> plan = clsas.plan(lines, grid, tolerance_db=-40)
    >>> plan.is_exact
    True

    Given a number of stages, it returns the fastest factorization that has them:

    >>> plan = clsas.plan(lines, grid, tolerance_db=-40, depth=1)
    >>> plan.is_exact, len(plan.sides)
    (False, 1)
    >>> plan.predicted_error_db <= -40
    True
    """
    request = Request(
        lines,
        grid,
        tolerance_db=tolerance_db,
        tolerance_wavelengths=tolerance_wavelengths,
        stages=stages,
        beam=beam,
        memory_bytes=memory_bytes,
        costs=costs,
        taps=taps,
        depth=depth,
        full_model=full_model,
    )
    _, found, _ = planned(request, open_device(device))
    return found


def factorize(
    lines: RangeLines,
    grid: Grid,
    plan_or_tolerance: Plan | float,
    *,
    beam: BeamWindow | None = None,
    device: Device | str | int | None = None,
    certificate: Annotated[bool | None, CERTIFICATE] = None,
    on_miss: Annotated[str, ON_MISS] = "refine",
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
        error against the exact image, dB, from -85 to -10. With a tolerance, the image is planned
        first.
    beam : BeamWindow, optional
        Weights of the channels by aspect angle. Must be left out with a plan, which contains its
        own.
    device : Device, str or int, optional
        See `clsas.engine.device.device.choose`.
    certificate : bool, optional
        Whether the error of the image is measured, as by `clsas.certify`. By default, it is
        measured if the image is formed to a tolerance in dB, and planning and forming it take 0.1 s
        or more.
    on_miss : {"refine", "warn", "raise"}
        What to do if the measured error exceeds the tolerance beyond doubt: form the image again by
        a better plan, and then exactly, with a warning; warn; or raise ToleranceError.
    accumulate : Image, optional
        Image on the same grid to which this one is added, so that data may arrive in pieces. The
        tolerance applies to the new image alone, and `Image.formed` of the sum is None.
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
    ToleranceError
        If the image misses its tolerance, and `on_miss` is "raise".

    Warns
    -----
    ClsasWarning
        If the image missed its tolerance; if the lines have power outside the band that the plan
        was made for, or are too large for the half precision that it chose; if no line adds
        anything to the image; and, with a tolerance, for the reasons of `clsas.plan`.

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
    if isinstance(plan_or_tolerance, str):
        given, hint = validate.shown(plan_or_tolerance), "`Plan.from_json` reads texts"
        raise ArgumentTypeError("plan_or_tolerance", "be a Plan or dB", given, hint)
    if isinstance(plan_or_tolerance, Plan):
        imager = Imager(lines, grid, plan_or_tolerance, beam=beam, device=device)
    else:
        validate.instance("lines", lines, RangeLines)
        validate.instance("grid", grid, Grid)
        validate.progress(progress)
        tolerance_db = TOLERANCE.check("plan_or_tolerance", plan_or_tolerance)
        imager = Imager(lines, grid, tolerance_db=tolerance_db, beam=beam, device=device)
    return imager(
        lines, certificate=certificate, on_miss=on_miss, accumulate=accumulate, progress=progress
    )


def backproject(
    lines: RangeLines,
    grid: Grid,
    *,
    device: Device | str | int | None = None,
    accuracy_db: float = ACCURACY_DB,
    taps: int | None = None,
    upsampling: float | None = None,
    beam: BeamWindow | None = None,
    certificate: Annotated[bool | None, CERTIFICATE] = None,
    on_miss: Annotated[str, ON_MISS] = "refine",
    accumulate: Image | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Image:
    """Return the exact image of range lines on a grid, formed by backprojection.

    Parameters
    ----------
    lines : RangeLines
        Lines of any number of channels, which may be monostatic, bistatic or moving.
    grid : Grid
        Any number of pixels on a plane, on a height map or at arbitrary points.
    device : Device, str or int, optional
        OpenCL device: an index of `list_devices`, a kind ("gpu", "cpu"), or part of a platform or
        name. The default is the environment variable CLSAS_DEVICE, then the first GPU, then the
        CPU with the widest vectors.
    accuracy_db : float
        Allowed relative rms error against the ideal sum, dB, from -85 to below 0. Together with the
        spectrum of the lines it determines how they are interpolated.
    taps : 2, 4, 6 or 8, optional
        Samples per interpolation (2 is linear). By default the fastest number is chosen.
    upsampling : float, optional
        Factor by which lines are upsampled before interpolation, 1 to 64. By default the fastest
        factor is chosen. If both `taps` and `upsampling` are given, `accuracy_db` has no effect.
    beam : BeamWindow, optional
        Weights of the channels by aspect angle. Pixels outside the beam of a channel take no time.
        Without a beam every channel has the weight 1 everywhere.
    certificate : bool, optional
        Whether the error of the image is measured, as by `clsas.certify`. By default, it is
        measured if the image takes 0.1 s or more, and not both `taps` and `upsampling` are given.
    on_miss : {"refine", "warn", "raise"}
        What to do if the measured error exceeds `accuracy_db` beyond doubt: form the image again
        to a tighter accuracy, with a warning; warn; or raise ToleranceError.
    accumulate : Image, optional
        Image on the same grid to which this one is added, so that data may arrive in pieces.
        `Image.formed` of the sum is None.
    progress : callable, optional
        Called as progress(done, total), counted in pairs of a part of the image and a channel.

    Returns
    -------
    Image
        Complex image that preserves phase.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is out of range, `accumulate` is on another grid or is
        given with a normalising beam, the track of the beam cannot be found from the lines,
        lines and grid have different georeferences, receivers move faster than 0.05 times the sound
        speed, or numbers are too large or too small for float32 sums or float64 phases.
    DeviceError
        If there is no such device.
    ToleranceError
        If the error exceeds `accuracy_db`, and `on_miss` is "raise".

    Warns
    -----
    ClsasWarning
        If the measured error exceeds `accuracy_db`. If no pixel lies in the beam and within the
        range of any line, so that the image is zero. If pixels lie behind the elements, where they
        can only show mirror images. If lines, grid or beam cannot be right, such as positions in
        millimetres. If the image may miss `accuracy_db`, because the grid reaches ends of lines
        that do not fade, or because the band of the lines fills the whole sampled band.

    See Also
    --------
    plan, factorize : Much faster images of a chosen accuracy.
    wavenumber : Images of straight tracks in the frequency domain.

    Notes
    -----
    The image is I(x) = sum_i w_i(x) s_i(rho_i(x)) exp(+j 2 k rho_i(x)), where rho is half the path
    from transmitter to pixel to receiver, k = 2 pi carrier/c, and w are the weights of the beam (1
    without a beam) [1]_ [2]_.

    Lines are assumed to be band-limited about their spectral centre, and zero beyond their ends. A
    line contributes to pixels outside its range only within the taps of the interpolation. Where a
    line does not fade towards an end, the pixels there depend on the taps, and thus on
    `accuracy_db`.

    Motion during flight, the distance between transmitter and receiver, and the relief of a grid
    are left out if the resulting error is far below `accuracy_db` (docs/assess.md).

    With or without a beam, a pixel behind the antennas is the mirror image of the pixel at the same
    range in front of them. The host computes ranges and phases of centres near the pixels in
    float64. The device computes differences from them in float32.

    References
    ----------
    .. [1] McCorkle, Rofheart, "An order N^2 log(N) backprojector algorithm for focusing wide-angle
       wide-bandwidth arbitrary-motion synthetic aperture radar", SPIE 2747, 1996.
    .. [2] Ødegaard, "Fast time domain beamforming for synthetic aperture sonar", thesis,
       University of Oslo, 2004.

    Examples
    --------
    The image of a point, from a track of 4 m:

    >>> import clsas
    >>> import numpy as np
    >>> tx_m = np.stack([np.linspace(-2, 2, 41), np.zeros(41), np.zeros(41)], axis=1)
    >>> point = clsas.PointTargets([[0, 40, 0]])
    >>> lines = clsas.simulate_lines(tx_m, tx_m, point, carrier_hz=100e3, bandwidth_hz=30e3)
    >>> grid = clsas.Grid.plane(x=(-1, 1, 41), y=(39.8, 40.2, 41))
    >>> image = clsas.backproject(lines, grid)
    >>> print(*np.unravel_index(np.abs(image.pixels).argmax(), image.shape))  # row, column
    20 20
    """
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    validate.memory("grid", 8 * grid.size)
    validate.progress(progress)
    accuracy_db = ACCURACY.check("accuracy_db", accuracy_db)
    asked = check_declared(backproject, {"certificate": certificate, "on_miss": on_miss})
    is_fixed = taps is not None and upsampling is not None
    device, started = open_device(device), time.perf_counter()
    scene = Scene.of(lines, grid, beam, None if is_fixed else accuracy_db)
    if accumulate is not None:
        check_accumulate(accumulate, scene.given_grid, beam)
    scene.warn("accuracy_db", 0.0 if is_fixed else accuracy_db)
    method = ExactImage(accuracy_db, taps=taps, upsampling=upsampling)
    image = form(scene, method, device, progress=progress)

    def again(better_db: float) -> Image:
        imager = _better_exact(lines, grid, beam, device, better_db, accuracy_db, keep=False)
        return imager.form(lines, progress)

    ways = () if is_fixed or accuracy_db <= BEST_ACCURACY_DB else (again,)
    image = _certified(image, lines, device, started, not is_fixed, ways, **asked)
    return _added(image, accumulate)


class Imager:
    """Any number of images on one grid, exact or factorized, planned once.

    Everything that does not depend on the samples is computed once, as long as the antennas stay
    where they are. Exactly one of `plan`, `tolerance_db` and `accuracy_db` must be given.

    Parameters
    ----------
    lines : RangeLines
        Lines to image. Lines that are imaged later may have other samples of about the same band,
        and antennas or first ranges that differ a little: those of another bank, of the next pass,
        or of a corrected track.
    grid : Grid
        Pixels of the images.
    plan : Plan, optional
        A plan that `clsas.plan` made for these lines and this grid.
    tolerance_db : float, optional
        Largest relative rms error against the exact image, dB, from -85 to -10. The fastest images
        within it are then planned, as by `clsas.plan`.
    accuracy_db : float, optional
        Largest relative rms error against the ideal sum, dB, from -85 to below 0. The images are
        then exact, as those of `clsas.backproject`.
    beam : BeamWindow, optional
        Weights of the channels by aspect angle. Must be left out with a plan, which contains its
        own.
    device : Device, str or int, optional
        See `clsas.engine.device.device.choose`.

    Attributes
    ----------
    plan : Plan or None
        How the images are formed. After a miss, it is another plan, possibly for a tighter
        tolerance. None if images are exact because `accuracy_db` was given, or an image by a better
        plan missed the tolerance, too.
    grid : Grid
    beam : BeamWindow or None
    device : Device

    Raises
    ------
    TypeError, ValueError
        If an argument is not allowed, the plan was made for other lines or another grid, or `beam`
        is given with a plan.
    DeviceError
        If the device does not exist.

    Warns
    -----
    ClsasWarning
        For the reasons of `clsas.plan` or `clsas.backproject`, once for all images.

    See Also
    --------
    factorize : Form a single image by a plan or to a tolerance.
    backproject : Form a single exact image.

    Notes
    -----
    Between images, the imager keeps the geometry of a factorization, or the references of an exact
    image, in up to 256 MiB of host memory, and the lines that it was made from. `close`, or the
    end of a ``with`` block, frees both.
    Threads must not share an imager.

    A plan holds for antennas that differ a little, because subimages and filters stay accurate
    enough. How much they may differ is not predicted. Instead, the error of the first image of such
    lines is measured, and if it misses the tolerance, the image is planned again. A measurement at
    some pixels may miss an error of a few channels or pixels.

    Examples
    --------
    Two images of the same geometry, of a point that echoes half as much the second time:

    >>> import clsas
    >>> import numpy as np
    >>> tx_m = np.outer(np.arange(64), [0.02, 0, 0])
    >>> first, second = (
    ...     clsas.simulate_lines(
    ...         tx_m, tx_m, clsas.PointTargets([[0.6, 20.0, 0.0]], [amplitude]),
    ...         carrier_hz=100e3, bandwidth_hz=20e3,
    ...     )
    ...     for amplitude in (1.0, 0.5)
    ... )
    >>> grid = clsas.Grid.plane((0.4, 0.8, 32), (19.8, 20.2, 32))
    >>> with clsas.Imager(first, grid, accuracy_db=-40) as imager:
    ...     images = [imager(first), imager(second)]
    >>> peaks = [abs(image.pixels).max() for image in images]
    >>> bool(np.isclose(peaks[1], 0.5 * peaks[0]))
    True
    """

    def __init__(
        self,
        lines: RangeLines,
        grid: Grid,
        plan: Plan | None = None,
        *,
        tolerance_db: float | None = None,
        accuracy_db: float | None = None,
        beam: BeamWindow | None = None,
        device: Device | str | int | None = None,
    ) -> None:
        validate.instance("lines", lines, RangeLines)
        validate.instance("grid", grid, Grid)
        if beam is not None:
            validate.instance("beam", beam, BeamWindow)
        given = [plan, tolerance_db, accuracy_db]
        if sum(value is not None for value in given) != 1:
            raise ArgumentError(
                "plan",
                "be given, or one of `tolerance_db` and `accuracy_db`, and only one",
                ", ".join(map(validate.shown, given)),
            )
        validate.memory("grid", 8 * grid.size)
        self.device, started = open_device(device), time.perf_counter()
        method: Plan | ExactImage
        track, warned = None, False
        if plan is not None:
            validate.instance("plan", plan, Plan)
            if beam is not None:
                raise ArgumentError("beam", "be left out with a plan, which contains its own")
            plan.check(lines, placed(lines, grid))
            method, beam = plan, plan.beam
            scene = scene_of_plan(lines, grid, plan)
        elif tolerance_db is not None:
            request = Request(lines, grid, tolerance_db=tolerance_db, beam=beam)
            scene, plan, track = planned(request, self.device)
            method, warned = plan, not scene.is_reached
        else:
            assert accuracy_db is not None
            accuracy_db = ACCURACY.check("accuracy_db", accuracy_db)
            scene = Scene.of(lines, grid, beam, accuracy_db)
            scene.warn("accuracy_db", accuracy_db)
            method = ExactImage(accuracy_db)
        self.grid, self.plan, self.beam = scene.given_grid, plan, beam
        self._tolerance_db = accuracy_db if plan is None else plan.tolerance_db
        self._imager: SceneImager | None = SceneImager(
            scene, method, self.device, track=track, warned=warned
        )
        self._lines_digest = plan.lines_digest if plan else lines_digest(lines)
        self._warned_of_band = False
        self._checked = weakref.ref(lines)
        if plan is not None and tolerance_db is None and not plan.is_exact:
            self._check_band(lines)
        # Whether the next image is certified by default, if it takes long enough
        self._is_next_certified = tolerance_db is not None or accuracy_db is not None
        # Whether the plan was made for other antennas, and no image of these has met the tolerance
        self._is_unproven = False
        self._planning_s = time.perf_counter() - started

    def __call__(
        self,
        lines: RangeLines,
        *,
        certificate: Annotated[bool | None, CERTIFICATE] = None,
        on_miss: Annotated[str, ON_MISS] = "refine",
        accumulate: Image | None = None,
        progress: Progress | None = None,
    ) -> Image:
        """Return the image of lines on the imager's grid.

        Parameters
        ----------
        lines : RangeLines
            With the number of samples of those that the imager was made for, and within 1 % of
            their carrier, sound speed and range step.
        certificate : bool, optional
            Whether the error of the image is measured, as by `clsas.certify`. By default,
            that of the first image is measured, if the imager was not made from a plan, and
            planning and forming the image take 0.1 s or more. If the lines have other antennas than
            those that the plan was made for, the errors of factorized images are measured, whatever
            their time, until one meets the tolerance.
        on_miss : {"refine", "warn", "raise"}
            What to do if the measured error exceeds the tolerance beyond doubt: form the image
            again by a better plan, and then exactly, with a warning; warn; or raise ToleranceError.
            The imager forms later images by the better plan, or exactly.
        accumulate : Image, optional
            Image on the same grid to which this one is added, so that data may arrive in pieces.
            `Image.formed` of the sum is None.
        progress : callable, optional
            Called as progress(done, total).

        Returns
        -------
        Image
            complex64, phase-preserving.

        Raises
        ------
        TypeError, ValueError
            If an argument is not allowed, the lines have another carrier, sound speed, range step
            or number of samples, or the imager was closed.
        ToleranceError
            If the image misses its tolerance, and `on_miss` is "raise".

        Warns
        -----
        ClsasWarning
            If the image missed its tolerance; if the lines have power outside the band that the
            imager was made for, so that the error may be larger; or if no line adds anything to the
            image.
        """
        validate.instance("lines", lines, RangeLines)
        asked = check_declared(Imager.__call__, {"certificate": certificate, "on_miss": on_miss})
        validate.progress(progress)
        placed(lines, self.grid)  # raises if the georeferences differ
        if self._imager is None:
            raise ValueError("the imager was closed; make another one")
        if accumulate is not None:
            check_accumulate(accumulate, self.grid, self.beam)
        started = time.perf_counter() - self._planning_s
        if self._checked() is not lines:
            digest = lines_digest(lines)
            if digest != self._lines_digest:
                self._move_to(lines, digest)
            self._check_band(lines)
            self._checked = weakref.ref(lines)
        image = self._imager.form(lines, progress)
        self._planning_s = 0.0
        by_default, self._is_next_certified = self._is_next_certified, False
        again, exactly = (
            partial(each, lines, progress) for each in (self._form_again, self._exactly)
        )
        ways: tuple[FormAgain, ...] = again, exactly
        if self._imager.decision is not None:
            is_best = (self._tolerance_db or 0.0) <= BEST_ACCURACY_DB
            ways = () if is_best else (exactly,)
        elif self._is_unproven and self._tolerance_db is not None:
            tolerance_db = self._tolerance_db
            if certificate is None:  # whatever its time
                asked["certificate"] = True
            # Another plan for these antennas need not be better than the tolerance.
            ways = lambda _: again(tolerance_db), again, exactly
        image = _certified(image, lines, self.device, started, by_default, ways, **asked)
        assert image.formed is not None
        measured = image.formed.certificate
        if measured is not None and self._tolerance_db is not None:
            self._is_unproven &= measured.verdict(self._tolerance_db) != "met"
        return _added(image, accumulate)

    def _move_to(self, lines: RangeLines, digest: str) -> None:
        """Make ready for lines with other antennas or first ranges, by the same plan."""
        assert self._imager is not None
        for name, share in _SAME.items():
            given, first = getattr(lines, name), getattr(self._imager.scene.given_lines, name)
            if abs(given - first) > share * abs(first):
                allowed = f"stay within {share:.0%} of {first:g}" if share else f"stay {first:g}"
                hint = "make another `Imager` for these lines"
                raise ArgumentError(f"{name} of lines", allowed, f"{given:g}", hint)
        plan = self._imager.plan
        allowed_db = plan.tolerance_db if isinstance(plan, Plan) else plan.accuracy_db
        scene = Scene.of(lines, self.grid, self.beam, allowed_db)
        imager = SceneImager(scene, plan, self.device, tolerance_db=self._tolerance_db)
        if not imager.suits_track and self._tolerance_db is not None:
            imager = self._planned_again(lines, self._tolerance_db)
        else:
            self._is_unproven = imager.decision is None
        self._imager, self._lines_digest, self._warned_of_band = imager, digest, False

    def _form_again(
        self, lines: RangeLines, progress: Progress | None, tolerance_db: float
    ) -> Image:
        """Return the image by a plan for another tolerance, which replaces that of the imager."""
        self._imager = self._planned_again(lines, tolerance_db)
        return self._imager.form(lines, progress)

    def _planned_again(self, lines: RangeLines, tolerance_db: float) -> SceneImager:
        """Return what forms images by a plan for these lines, which replaces that of the imager."""
        tolerance_db = max(tolerance_db, BEST_ACCURACY_DB)
        request = Request(lines, self.grid, tolerance_db=tolerance_db, beam=self.beam)
        scene, plan, track = planned(request, self.device, doubts=False)
        self.plan, self._is_unproven = plan, False
        return SceneImager(
            scene, plan, self.device, track=track, warned=True, tolerance_db=self._tolerance_db
        )

    def _exactly(self, lines: RangeLines, progress: Progress | None, accuracy_db: float) -> Image:
        """Return the exact image; the imager forms the next ones exactly, too."""
        self.plan = None
        self._imager = _better_exact(
            lines, self.grid, self.beam, self.device, accuracy_db, self._tolerance_db
        )
        return self._imager.form(lines, progress)

    def _check_band(self, lines: RangeLines) -> None:
        """Warn once if lines have power outside the band that the imager was made for."""
        assert self._imager is not None
        allowed_db = self._tolerance_db
        if self.plan is not None and not self.plan.is_exact:
            band = self.plan.factorization.band
        else:
            spectrum = self._imager.scene.spectrum
            band = occupied_band(spectrum, OUTSIDE * power(allowed_db or 0.0))
        if band is None or allowed_db is None or self._warned_of_band:
            return
        for channels in (FEW_CHANNELS, MEASURED_CHANNELS):
            outside_db = in_db(power_outside(lines, *band, channels))
            if outside_db <= allowed_db:
                return
        if lines.samples.any():
            validate.warn(
                f"the lines have {outside_db:.0f} dB of their power outside the band that the "
                f"images are made for, so the error may exceed {allowed_db:g} dB: make another "
                "plan or `clsas.Imager` from these lines"
            )
            self._warned_of_band = True

    def close(self) -> None:
        """Free the memory that is kept between images. No image can be formed afterwards."""
        self._imager = None

    def __enter__(self) -> Imager:
        """Return the imager."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the imager."""
        self.close()

    def __repr__(self) -> str:
        """Return the grid, the method and the device."""
        how = "exact" if self.plan is None else repr(self.plan)
        return reprs.summary(self, reprs.by(self.grid.shape), how, self.device.info.label)


def _better_exact(
    lines: RangeLines,
    grid: Grid,
    beam: BeamWindow | None,
    device: Device,
    accuracy_db: float,
    requested_db: float | None,
    *,
    keep: bool = True,
) -> SceneImager:
    """Return an imager of exact images, to an accuracy tightened from the one requested."""
    accuracy_db = max(accuracy_db, BEST_ACCURACY_DB)
    scene, method = Scene.of(lines, grid, beam, accuracy_db), ExactImage(accuracy_db)
    return SceneImager(scene, method, device, warned=True, keep=keep, tolerance_db=requested_db)


def _certified(
    image: Image,
    lines: RangeLines,
    device: Device,
    started: float,
    by_default: bool,
    again: Sequence[FormAgain] = (),
    *,
    certificate: bool | None,
    on_miss: str,
) -> Image:
    """Return an image that was begun at a time, with its certificate if it is to have one."""
    seconds = time.perf_counter() - started
    if not is_wanted(certificate, seconds, by_default=by_default):
        return image
    return certified(image, lines, device, seconds, on_miss, again)


def check_accumulate(image: Image, grid: Grid, beam: BeamWindow | None) -> None:
    """Raise an error if the image on a grid cannot be added to the image `accumulate`."""
    validate.instance("accumulate", image, Image)
    check_one_grid("accumulate and grid", image.grid, grid)
    if beam is not None and beam.normalise:
        hint = "normalised images are means and cannot be added"
        raise ArgumentError("accumulate", "be None with a beam that normalises", hint=hint)


def _added(image: Image, accumulate: Image | None) -> Image:
    """Return an image to which another one on the same grid is added."""
    if accumulate is None:
        return image
    return Image(image.pixels + accumulate.pixels, one_placed(image.grid, accumulate.grid))
