"""Wavenumber imaging: exact images of straight tracks, formed in the frequency domain."""

from __future__ import annotations

import math
import os
from dataclasses import replace

import numpy as np

from clsas.core import validate
from clsas.core.geometry import pairwise_range_m
from clsas.core.georeference import placed
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.lines import RangeLines
from clsas.exact.migration import migrate
from clsas.exact.straight_track import Aspects, Band, StraightTrack, aspects_of, band_of, straighten
from clsas.scene import check_numbers
from clsas.signal.doubts import warn_before_imaging
from clsas.signal.refraction import homogeneous
from clsas.sonar.beam import BeamWindow
from clsas.sonar.coverage import reaches, warn_unreached

_STRAIGHT = 1e-3  # wavelengths, up to which errors of range cause no warning


def wavenumber(
    lines: RangeLines,
    grid: Grid,
    *,
    beam: BeamWindow | None = None,
    motion_compensation: bool = True,
    workers: int | None = None,
) -> Image:
    """Return the image of a straight track, formed in the wavenumber domain.

    Parameters
    ----------
    lines : RangeLines
        Channels in any order, at any spacing along a straight line. Tracks that are not straight,
        bistatic channels and moving receivers are approximated; see `motion_compensation`.
    grid : Grid
        Plane, horizontal or tilted, whose rows of pixels run along the track.
    beam : BeamWindow, optional
        As for `backproject`, but aspect angles are always measured from the straight line. Without
        a beam every channel has the weight 1.
    motion_compensation : bool
        If True, shift every range line as if its phase centre were moved onto a straight line
        along the rows of the grid. The shift is exact only for the middle of the grid's ranges and
        of the beam. If False, phase centres are treated as if they lay on the straight line.
    workers : int, optional
        Number of threads; by default as many as there are processors.

    Returns
    -------
    Image
        Complex image with the amplitudes and phases of `backproject`.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is out of range, the grid is not a plane (a level one
        for lines with a profile of the sound speed), its rows are
        at an angle of more than 5 degrees to the track, it is closer than a wavelength, all phase
        centres coincide, aspect angles exceed 85 degrees, the beam normalises, or arrays do not fit
        into memory.

    Warns
    -----
    ClsasWarning
        If the track is not straight and monostatic. The warning names the remaining range errors.
        If the lines do not contribute to the image, or pixels lie behind the elements, where they
        can only show mirror images. If lines, grid or beam cannot be right.

    See Also
    --------
    backproject : Exact images of any track.

    Notes
    -----
    For every two-way wavenumber K, the exact image is a convolution along the track with
    w(theta) exp(j K rho). By stationary phase, its Fourier transform at sin(theta) = k_x/K and the
    distance R from the track is

        sqrt(2 pi R) K k_y^(-3/2) [w + j D/(K R)] exp(j k_y R + j pi/4),   k_y^2 = K^2 - k_x^2,
        D = (w'' cos(theta) + w' sin(theta))/2 + 3 w/(8 cos(theta)).

    The image is the product of this transform and the spectrum of the lines, summed over K and k_x
    [1]_ [2]_ [3]_. In every term R is a separate factor, so that amplitudes are those of
    backprojection. The remaining difference is diffraction at the edges of the weights, which
    stationary phase neglects. It grows with the steepness of the edges, and is of the order
    (K R width^2)^(-5/4) for a Hann beam. Without a beam the term D, which is then 3/(8 cos(theta)),
    is left out.

    The sums over channels, K and k_x are non-uniform FFTs [4]_. An FFT of type 3 leads directly
    from the k_y of the spectrum to the R of the rows, with an error of 1e-7. It replaces Stolt's
    interpolation and the interpolation from slant range to ground range.

    References
    ----------
    .. [1] Stolt, "Migration by Fourier transform", Geophysics 43, 1978.
    .. [2] Cafforio, Prati, Rocca, "SAR data focusing using seismic migration techniques",
       IEEE Trans. Aerospace and Electronic Systems 27, 1991.
    .. [3] Soumekh, "Synthetic Aperture Radar Signal Processing", Wiley, 1999.
    .. [4] Barnett, Magland, af Klinteberg, "A parallel nonuniform fast Fourier transform library",
       SIAM J. Scientific Computing 41, 2019.

    Examples
    --------
    The image of a point, from a track of 4 m:

    >>> import clsas
    >>> import numpy as np
    >>> tx_m = np.stack([np.linspace(-2, 2, 41), np.zeros(41), np.zeros(41)], axis=1)
    >>> point = clsas.PointTargets([[0, 40, 0]])
    >>> lines = clsas.simulate_lines(tx_m, tx_m, point, carrier_hz=100e3, bandwidth_hz=30e3)
    >>> grid = clsas.Grid.plane(x=(-1, 1, 41), y=(39.8, 40.2, 41))
    >>> image = clsas.wavenumber(lines, grid)
    >>> print(*np.unravel_index(np.abs(image.pixels).argmax(), image.shape))  # row, column
    20 20
    """
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    grid = placed(lines, grid)
    validate.instance("beam", beam, BeamWindow, type(None))
    validate.flag("motion_compensation", motion_compensation)
    workers = validate.count("workers", (os.cpu_count() or 1) if workers is None else workers)
    if not grid.is_planar:
        kind = "heights" if grid.points_m is None else "points"
        raise ValueError(f"grid must be a plane with rows along the track, got {kind}")
    check_numbers(lines, beam)
    if beam is not None and beam.normalise:
        raise ValueError("beam must not normalise here; use clsas.backproject for that")
    if lines.sound_speed is not None:
        water = homogeneous(lines, grid, beam, None, corrected=False)
        if not water.grid.is_planar:
            raise ValueError("grid must be level for lines with a profile of the sound speed")
        lines, beam = water.lines(lines), water.beam
    band = band_of(lines)
    track = straighten(lines, grid, beam, motion_compensation)
    aspects = aspects_of(lines, track, beam, band)
    visible = np.zeros(lines.channels, bool)
    if aspects is not None:
        first_m, last_m = track.reach_m(aspects.low, aspects.high)
        visible = (track.along_m >= first_m) & (track.along_m <= last_m)
    if aspects is None or not visible.any() or not reaches(lines, grid, None, None):
        along = None if beam is None else beam.directions(lines)
        warn_unreached(lines, grid, beam, along)
        return Image(np.zeros(grid.shape, np.complex64), grid)
    warn_before_imaging(lines, grid, beam)
    _warn_bent(lines, grid, track, aspects, band, motion_compensation)
    on_line = replace(track, along_m=track.along_m[visible], shift_m=track.shift_m[visible])
    return Image(migrate(lines.select(visible), on_line, aspects, band, workers), grid)


def _warn_bent(
    lines: RangeLines,
    grid: Grid,
    track: StraightTrack,
    aspects: Aspects,
    band: Band,
    compensated: bool,
) -> None:
    """Warn if the track is not a straight line, with the range errors at the grid's corners."""
    corners = [slice(None, None, max(count - 1, 1)) for count in grid.shape]
    ahead_m = track.pixel_along_m[tuple(corners)][..., None] - track.along_m
    nominal_m = np.hypot(ahead_m, track.row_range_m[corners[0], None, None])
    motion = lines.rx_velocity_m_s, lines.sound_speed_m_s
    points_m = grid.positions_m(*corners).reshape(-1, 3)
    range_m = pairwise_range_m(points_m, lines.tx_m, lines.rx_m, *motion).reshape(nominal_m.shape)
    sine = ahead_m / nominal_m
    visible = (sine > math.sin(aspects.low)) & (sine < math.sin(aspects.high))
    error_m = float(np.abs(visible * (range_m - track.shift_m - nominal_m)).max())
    if max(error_m, track.off_m) <= _STRAIGHT * band.wavelength_m:
        return
    treated = "moved onto it for the middle range of the grid" if compensated else "left there"
    validate.warn(
        f"a wavenumber image assumes a straight monostatic track: phase centres up to "
        f"{track.off_m:.3g} m off a line along the grid's rows are {treated}, which leaves range "
        f"errors of up to {error_m:.3g} m ({error_m / band.wavelength_m:.2g} wavelengths) at the "
        f"grid's corners; the error of the image is not controlled"
    )
