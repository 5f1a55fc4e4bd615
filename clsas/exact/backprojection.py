"""Exact backprojection: every channel summed into every pixel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from clsas.core.decibels import power
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.lines import RangeLines
from clsas.exact.checks import check_accumulate, check_input
from clsas.exact.decision import decide
from clsas.exact.preparation import Preparation
from clsas.exact.run import execute
from clsas.opencl.device import Device, open_device
from clsas.signal.ambiguity import BEST_DB, ambiguity
from clsas.signal.spectrum import OUTSIDE, line_energy, measure_spectrum, occupied_band
from clsas.sonar.beam import BeamWindow
from clsas.sonar.coverage import reaches
from clsas.sonar.simplify import simplify

BEST_ACCURACY_DB = BEST_DB
"""The best accuracy that may be asked for; float32 allows no better."""
ACCURACY_DB = -60.0
"""The accuracy of exact images by default."""


def backproject(
    lines: RangeLines,
    grid: Grid,
    *,
    device: Device | str | int | None = None,
    accuracy_db: float = ACCURACY_DB,
    taps: int | None = None,
    upsampling: float | None = None,
    beam: BeamWindow | None = None,
    accumulate: Image | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Image:
    """Form the exact image of range lines on a grid.

    Parameters
    ----------
    lines : RangeLines
        Any number of channels, monostatic, bistatic or moving.
    grid : Grid
        Any number of pixels: a plane, a height map or arbitrary points.
    device : Device, str or int, optional
        See `clsas.opencl.device.choose`.
    accuracy_db : float
        Relative rms error allowed against the ideal sum, dB, from -85 to below 0. It decides how
        the lines are interpolated, from their own spectrum.
    taps : 2, 4, 6 or 8, optional
        Samples per interpolation (2 is linear), instead of the fastest choice.
    upsampling : float, optional
        Factor by which lines are upsampled before interpolation, instead of the fastest choice.
        With `taps` too, `accuracy_db` plays no part.
    beam : BeamWindow, optional
        Weights of the channels by aspect angle. Pixels outside a channel's beam cost nothing.
        Without a beam every channel weighs 1 everywhere.
    accumulate : Image, optional
        Image on the same grid to which this one is added, so that data may arrive in pieces.
    progress : callable, optional
        Called as progress(done, total), in pairs of parts of the image and channels.

    Returns
    -------
    Image
        complex64, phase-preserving.

    Raises
    ------
    TypeError, ValueError
        If an argument is of a wrong kind or out of range; `accumulate` is on another grid, or given
        with a normalising beam; the beam's track cannot be found from the lines; receivers move
        faster than 0.05 sound speeds; or numbers are too large or too small for float32 sums or
        float64 phases.
    DeviceError
        If there is no such device.

    Warns
    -----
    ClsasWarning
        If no pixel lies within the range of any line and the beam, so that the image is zero; or if
        the image may miss `accuracy_db`, because the grid reaches ends of lines that do not fade,
        or because the lines' band fills the whole sampled band.

    Notes
    -----
    I(x) = sum_i w_i(x) s_i(rho_i(x)) exp(+j 2 k rho_i(x)), with rho half the path from transmitter
    to pixel to receiver, k = 2 pi carrier/c, and w the beam's weights (1 without a beam) [1]_ [2]_.

    The lines are assumed to be band-limited about their spectral centre, and zero beyond their
    ends. A line adds nothing to a pixel outside its range, by more than the taps of one
    interpolation. Where a line does not fade towards an end, the pixels there depend on the taps,
    and so on `accuracy_db`.

    Motion during flight, the distance between transmitter and receiver and a grid's relief are left
    out where the error that this adds lies far below `accuracy_db` (docs/assess.md).

    A pixel behind the antennas is the mirror image of the one at the same range before them, with
    or without a beam. The host computes ranges and phases of centres near the pixels in float64;
    the device computes differences from them in float32.

    References
    ----------
    .. [1] McCorkle, Rofheart, "An order N^2 log(N) backprojector algorithm for focusing wide-angle
       wide-bandwidth arbitrary-motion synthetic aperture radar", SPIE 2747, 1996.
    .. [2] Ødegaard, "Fast time domain beamforming for synthetic aperture sonar", thesis,
       University of Oslo, 2004.
    """
    preparation = prepare(
        lines,
        grid,
        device=device,
        accuracy_db=accuracy_db,
        taps=taps,
        upsampling=upsampling,
        beam=beam,
    )
    if accumulate is not None:
        check_accumulate(accumulate, grid, beam)
    preparation.warn_of_ambiguity()
    image = execute(preparation, progress=progress)
    if accumulate is None:
        return image
    return Image(image.pixels + accumulate.pixels, grid)


def prepare(
    lines: RangeLines,
    grid: Grid,
    *,
    device: Device | str | int | None = None,
    accuracy_db: float = ACCURACY_DB,
    taps: int | None = None,
    upsampling: float | None = None,
    beam: BeamWindow | None = None,
    full_model: bool = False,
) -> Preparation:
    """Check the input of `backproject` and decide how to form the image.

    Parameters and errors are those of `backproject`. Effects far below `accuracy_db` are left out,
    unless `full_model` is set, or `taps` and `upsampling` are given so that `accuracy_db` plays no
    part.
    """
    accuracy_db = check_input(lines, grid, beam, accuracy_db, BEST_ACCURACY_DB)
    fixed = taps is not None and upsampling is not None
    model = simplify(lines, grid, beam, None if fixed or full_model else accuracy_db)
    along = None if model.beam is None else model.beam.directions(model.lines)
    device = open_device(device)
    energy = line_energy(model.lines.samples)
    spectrum = measure_spectrum(model.lines, model.grid, energy)
    left_open = ambiguity(model.lines, model.grid, spectrum, energy, model.beam, along)
    is_reached = reaches(model.lines, model.grid, model.beam, along)
    decision = decide(
        model.lines,
        # Nothing is formed: far away, all pixels would take long to lay out.
        model.grid if is_reached else Grid.points(model.grid.spread(1)),
        device=device,
        accuracy_db=accuracy_db,
        spectrum=spectrum,
        left_open=left_open,
        beam=model.beam,
        along=along,
        taps=taps,
        upsampling=upsampling,
        left_out_error=model.error,
    )
    return Preparation(
        device,
        model.lines,
        model.grid,
        **vars(decision),
        beam=model.beam,
        along=along,
        requested_db=0.0 if fixed else accuracy_db,
        ambiguity=left_open,
        given_grid=grid,
        left_out=model.left_out,
        left_out_error=model.error,
        is_reached=is_reached,
        band=occupied_band(spectrum, OUTSIDE * power(accuracy_db)),
    )


def form_exactly(
    lines: RangeLines,
    grid: Grid,
    *,
    progress: Callable[[int, int], None] | None = None,
    warned: bool = False,
    **request: Any,
) -> Image:
    """Form an image as `backproject` does, without its warnings of ambiguous lines.

    Parameters
    ----------
    lines, grid, progress
        As of `backproject`.
    warned : bool
        True if the user has been warned already that no line adds anything to the image.
    **request
        As of `prepare`.
    """
    return execute(prepare(lines, grid, **request), progress=progress, warned=warned)
