"""Exact backprojection: every channel summed into every pixel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from clsas.core.decibels import power
from clsas.core.georeference import placed
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.lines import RangeLines
from clsas.exact.checks import check_accumulate, check_input
from clsas.exact.decision import decide
from clsas.exact.preparation import Preparation
from clsas.exact.run import execute
from clsas.opencl.device import Device, open_device
from clsas.signal.ambiguity import BEST_DB, ambiguity
from clsas.signal.doubts import warn_before_imaging
from clsas.signal.refraction import Homogeneous, homogeneous
from clsas.signal.spectrum import OUTSIDE, line_energy, measure_spectrum, occupied_band
from clsas.sonar.beam import BeamWindow
from clsas.sonar.coverage import reaches
from clsas.sonar.simplify import simplify

BEST_ACCURACY_DB = BEST_DB
"""Best accuracy that may be requested; float32 does not allow a better one."""
ACCURACY_DB = -60.0
"""Accuracy of exact images by default."""


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
    accumulate : Image, optional
        Image on the same grid to which this one is added, so that data may arrive in pieces.
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

    Warns
    -----
    ClsasWarning
        If no pixel lies in the beam and within the range of any line, so that the image is zero. If
        pixels lie behind the elements, where they can only show mirror images. If lines, grid or
        beam cannot be right, such as positions in millimetres. If the image may miss `accuracy_db`,
        because the grid reaches ends of lines that do not fade, or because the band of the lines
        fills the whole sampled band.

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
        check_accumulate(accumulate, placed(lines, grid), beam)
    warn_before_imaging(lines, grid, beam)
    preparation.warn_of_ambiguity()
    image = execute(preparation, progress=progress)
    if accumulate is None:
        return image
    return Image(image.pixels + accumulate.pixels, image.grid)


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
    water: Homogeneous | None = None,
) -> Preparation:
    """Check the input of `backproject` and decide how to form the image.

    Parameters and errors are those of `backproject`. Effects far below `accuracy_db` are left out
    unless `full_model` is set, or `taps` and `upsampling` are both given, so that `accuracy_db` has
    no effect. `water` is the homogeneous water of the scene if planning has found it, and warned of
    its error.
    """
    accuracy_db = check_input(lines, grid, beam, accuracy_db, BEST_ACCURACY_DB)
    grid = placed(lines, grid)
    fixed = taps is not None and upsampling is not None
    allowed_db = None if fixed or full_model else accuracy_db
    water = water or homogeneous(lines, grid, beam, allowed_db)
    corrected = water.corrections is not None
    scene = water.lines(lines), water.grid, water.beam
    model = simplify(*scene, allowed_db, keeps_points=corrected)
    along = None if model.beam is None else model.beam.directions(model.lines)
    device = open_device(device)
    energy = line_energy(model.lines.samples)
    spectrum = measure_spectrum(model.lines, model.grid, energy)
    left_open = ambiguity(model.lines, model.grid, spectrum, energy, model.beam, along)
    is_reached = reaches(model.lines, model.grid, model.beam, along)
    decision = decide(
        model.lines,
        # If no line reaches the grid nothing is formed, but laying out distant pixels would take
        # long.
        model.grid if is_reached else Grid.points(model.grid.spread(1)),
        device=device,
        accuracy_db=accuracy_db,
        spectrum=spectrum,
        left_open=left_open,
        beam=model.beam,
        along=along,
        taps=taps,
        upsampling=upsampling,
        left_out_error=model.error + water.error,
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
        left_out=(*model.left_out, *water.left_out),
        left_out_error=model.error + water.error,
        is_reached=is_reached,
        band=occupied_band(spectrum, OUTSIDE * power(accuracy_db)),
        water=water,
    )


def form_exactly(
    lines: RangeLines,
    grid: Grid,
    *,
    progress: Callable[[int, int], None] | None = None,
    warned: bool = False,
    **request: Any,
) -> Image:
    """Return the image of `backproject`, without its warnings about ambiguous lines.

    Parameters
    ----------
    lines, grid, progress
        As for `backproject`.
    warned : bool
        True if the user has already been warned that no line contributes to the image.
    **request
        As for `prepare`.
    """
    return execute(prepare(lines, grid, **request), progress=progress, warned=warned)
