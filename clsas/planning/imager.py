"""Imager of any number of images of the same geometry, exact or by a plan."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from types import TracebackType

from clsas.core import reprs, validate
from clsas.core.decibels import in_db
from clsas.core.digests import lines_digest
from clsas.core.georeference import placed
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.lines import RangeLines
from clsas.exact.backprojection import prepare
from clsas.exact.checks import check_accumulate
from clsas.exact.run import ExactImager
from clsas.opencl.device import Device, open_device
from clsas.planning.former import Former, former
from clsas.planning.planner import planned
from clsas.planning.request import Request
from clsas.plans.plan import Plan
from clsas.signal.doubts import warn_before_imaging
from clsas.signal.spectrum import FEW_CHANNELS, MEASURED_CHANNELS, power_outside
from clsas.sonar.beam import BeamWindow

Progress = Callable[[int, int], None]


class Imager:
    """Any number of images of the same geometry, exact or factorized.

    Everything that does not depend on the samples is computed once. Exactly one of `plan`,
    `tolerance_db` and `accuracy_db` must be given.

    Parameters
    ----------
    lines : RangeLines
        Lines to image. Lines that are imaged later may have other samples of about the same band,
        but must have the same antennas, ranges and carrier.
    grid : Grid
        Pixels of the images.
    plan : Plan, optional
        A plan that `clsas.plan` made for these lines and this grid.
    tolerance_db : float, optional
        Largest relative rms error against the exact image, dB, from -75 to -10. The fastest images
        within it are then planned, as by `clsas.plan`.
    accuracy_db : float, optional
        Largest relative rms error against the ideal sum, dB, from -85 to below 0. The images are
        then exact, as those of `clsas.backproject`.
    beam : BeamWindow, optional
        Weights of the channels by aspect angle. Must be left out with a plan, which contains its
        own.
    device : Device, str or int, optional
        See `clsas.opencl.device.choose`.

    Attributes
    ----------
    plan : Plan or None
        How the images are formed; None if `accuracy_db` was given.
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
        given = [plan, tolerance_db, accuracy_db]
        if sum(value is not None for value in given) != 1:
            raise ValueError(
                "exactly one of plan, tolerance_db and accuracy_db must be given, got "
                + ", ".join(validate.shown(value) for value in given)
            )
        validate.memory("grid", 8 * grid.size)
        grid = placed(lines, grid)
        self.grid, self.plan, self.beam = grid, plan, beam
        self.device = open_device(device)
        self._former: Former | None
        if accuracy_db is not None:
            preparation = prepare(
                lines, grid, accuracy_db=accuracy_db, beam=beam, device=self.device
            )
            preparation.warn_of_ambiguity()
            self._former = ExactImager(preparation)
        elif plan is None:
            request = Request(lines, grid, tolerance_db=tolerance_db, beam=beam, device=self.device)
            found = planned(request)
            self.plan = found.plan
            self._former = former(
                lines, grid, found.plan, self.device, known=found.known, warned=True
            )
        else:
            validate.instance("plan", plan, Plan)
            if beam is not None:
                raise ValueError("beam must be left out with a plan, which contains its own")
            plan.check(lines, grid)
            self.beam = plan.beam
            self._former = former(lines, grid, plan, self.device)
        if plan is None:  # otherwise clsas.plan has warned
            warn_before_imaging(lines, grid, beam)
        self._lines_digest = self.plan.lines_digest if self.plan else lines_digest(lines)
        self._warned_of_band = False
        self._checked = weakref.ref(lines)
        if plan is not None and not plan.is_exact:
            self._check_band(lines)

    def __call__(
        self,
        lines: RangeLines,
        *,
        accumulate: Image | None = None,
        progress: Progress | None = None,
    ) -> Image:
        """Return the image of lines of the imager's geometry.

        Parameters
        ----------
        lines : RangeLines
        accumulate : Image, optional
            Image on the same grid to which this one is added, so that data may arrive in pieces.
        progress : callable, optional
            Called as progress(done, total).

        Returns
        -------
        Image
            complex64, phase-preserving.

        Raises
        ------
        TypeError, ValueError
            If an argument is not allowed, the lines have another geometry, or the imager was
            closed.

        Warns
        -----
        ClsasWarning
            If the lines have power outside the band that the imager was made for, so that the
            error may be larger; or if no line adds anything to the image.
        """
        validate.instance("lines", lines, RangeLines)
        validate.progress(progress)
        placed(lines, self.grid)  # raises if the georeferences differ
        if self._former is None:
            raise ValueError("the imager was closed; make another one")
        if accumulate is not None:
            check_accumulate(accumulate, self.grid, self.beam)
        if self._checked() is not lines:
            if lines_digest(lines) != self._lines_digest:
                raise ValueError(
                    "lines must have the antennas, ranges, carrier and number of samples of those "
                    "that the imager was made for; make another Imager for these"
                )
            self._check_band(lines)
            self._checked = weakref.ref(lines)
        image = self._former.form(lines, progress)
        if accumulate is None:
            return image
        return Image(image.pixels + accumulate.pixels, self.grid)

    def _check_band(self, lines: RangeLines) -> None:
        """Warn once if lines have power outside the band that the imager was made for."""
        band: tuple[float, float] | None
        allowed_db: float | None
        if isinstance(self._former, ExactImager):
            preparation = self._former.preparation
            band, allowed_db = preparation.band, preparation.requested_db
            if self.plan is not None:
                allowed_db = self.plan.tolerance_db
        else:
            assert self.plan is not None
            band, allowed_db = self.plan.factorization.band, self.plan.tolerance_db
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
                "plan or clsas.Imager from these lines"
            )
            self._warned_of_band = True

    def close(self) -> None:
        """Free the memory that is kept between images. No image can be formed afterwards."""
        self._former = None

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
