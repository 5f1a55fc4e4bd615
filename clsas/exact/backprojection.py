"""Exact backprojection: every channel summed into every pixel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from clsas.core import validate
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.lines import RangeLines
from clsas.exact.checks import check_accumulate, check_numbers
from clsas.exact.decision import decide
from clsas.exact.preparation import Preparation
from clsas.exact.run import execute
from clsas.opencl.device import Device, open_device
from clsas.signal.ambiguity import ambiguity
from clsas.signal.spectrum import measure_spectrum
from clsas.sonar.beam import BeamWindow
from clsas.sonar.simplify import Model, simplify

BEST_ACCURACY_DB = -85.0
"""The best accuracy that may be asked for: what float32 allows."""
ACCURACY_DB = -60.0
"""What is taken where no accuracy is asked for."""


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
        Wanted relative rms error against the ideal sum, dB, from -85 to below 0. It decides how
        the lines are interpolated, from their own spectrum.
    taps : 2, 4, 6 or 8, optional
        Samples per interpolation (2 is linear), instead of the fastest choice.
    upsampling : float, optional
        By how much lines are upsampled before interpolation, instead of the fastest choice. With
        `taps` too, `accuracy_db` plays no part.
    beam : BeamWindow, optional
        Weights of the channels by aspect angle; what a channel does not see costs nothing. Without
        one every channel weighs 1 everywhere.
    accumulate : Image, optional
        Image on the same grid that this one is added to, so that data may arrive in pieces.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    Image
        complex64, phase-preserving.

    Raises
    ------
    TypeError, ValueError
        If an argument is not what is allowed, `accumulate` is on another grid or beside a beam
        that normalises, the beam's track cannot be told from the lines, receivers move
        faster than 0.05 sound speeds, or numbers are so large or small that float32 sums or
        float64 phases could not hold them.
    DeviceError
        If there is no such device.

    Warns
    -----
    ClsasWarning
        If no pixel lies within any line's range, or the beam, so that the lines add nothing; or if
        `accuracy_db` may be missed because lines do not fade towards ends that the grid reaches, or
        because the lines' band fills all that is sampled.

    Notes
    -----
    I(x) = sum_i s_i(rho_i(x)) exp(+j 2 k rho_i(x)), with rho half the path from transmitter to
    pixel to receiver and k = 2 pi carrier/c. The lines are taken as band-limited about their
    spectral centre and as zero beyond their ends: a pixel outside a line's range (by more than
    the taps of one interpolation) gets nothing from it. Where a line does not fade towards an end,
    what pixels next to it get depends on the taps, and the image there on `accuracy_db`.

    Motion during flight, the distance between transmitter and receiver and a grid's relief are left
    out where the error that this adds lies far below `accuracy_db` (docs/assess.md).

    With a beam each term is multiplied by its weight. With or without one a pixel behind the
    antennas, at the range of one before them, is its mirror image. Ranges and phases are referred
    in float64 to centres near the pixels; the device sees float32 differences only.
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
    """Decide how `backproject` forms an image; parameters and errors are its.

    Effects far below `accuracy_db` are left out unless `full_model` is set, or the interpolator is
    fixed so that `accuracy_db` plays no part.
    """
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    validate.memory("grid", 8 * grid.size)
    accuracy_db = validate.number(
        "accuracy_db", accuracy_db, "dB", least=BEST_ACCURACY_DB, below=0.0
    )
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    check_numbers(lines, beam)
    fixed = taps is not None and upsampling is not None  # then accuracy_db plays no part
    given_grid = grid
    model = Model(lines, grid, beam)
    if not (fixed or full_model):
        model = simplify(lines, grid, beam, accuracy_db)
    lines, grid, beam = model.lines, model.grid, model.beam
    along = None if beam is None else beam.directions(lines)
    device = open_device(device)
    spectrum = measure_spectrum(lines, grid)
    left_open = ambiguity(lines, grid, spectrum, beam, along)
    decision = decide(
        lines,
        grid,
        device=device,
        accuracy_db=accuracy_db,
        spectrum=spectrum,
        left_open=left_open,
        beam=beam,
        along=along,
        taps=taps,
        upsampling=upsampling,
        left_out_error=model.error,
    )
    return Preparation(
        device,
        lines,
        grid,
        **vars(decision),
        beam=beam,
        along=along,
        wanted_db=0.0 if fixed else accuracy_db,
        ambiguity=left_open,
        given_grid=given_grid,
        left_out=model.left_out,
        left_out_error=model.error,
    )


def form_exactly(
    lines: RangeLines,
    grid: Grid,
    *,
    progress: Callable[[int, int], None] | None = None,
    warned: bool = False,
    **wish: Any,
) -> Image:
    """Form an image as `backproject` does, without its warnings of what the lines leave open.

    `warned` is whether an image of zeros has been warned of too.
    """
    return execute(prepare(lines, grid, **wish), progress=progress, warned=warned)
