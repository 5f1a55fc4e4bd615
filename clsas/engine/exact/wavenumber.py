"""Wavenumber imaging: exact images of straight tracks, formed in the frequency domain."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.coverage import reaches, warn_unreached
from clsas.engine.data.digests import samples_digest
from clsas.engine.data.fourier import (
    gridding,
    gridding_gain,
    gridding_weights,
    smooth_edge,
    taps_for,
    turned_single,
)
from clsas.engine.data.geometry import bistatic_range_m, course, pairwise_range_m
from clsas.engine.data.georeference import placed
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Formed, Image
from clsas.engine.data.lines import RangeLines, cycles_per_m_at, wavelength_m
from clsas.engine.data.threads import cores, in_threads
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.version import __version__
from clsas.engine.scene import check_numbers
from clsas.engine.signal.doubts import warn_before_imaging
from clsas.engine.signal.spectrum import measure_spectrum
from clsas.engine.water.refraction import homogeneous

ACCURACY_DB = -80.0
"""Error of the interpolations together, relative to the image."""

_STRAIGHT = 1e-3  # wavelengths, up to which errors of range cause no warning
_UNUSED = 1e-12  # share of the energy that may be left out
_STEEPEST_DEG = 85.0  # largest aspect angle, at which ranges are about ten times those at broadside
_MOST_TURN_DEG = 5.0  # largest angle between the rows of the grid and the track
_EDGE_ZONES = 6.0  # Fresnel zones over which an aperture without a beam fades out
_ANGLES, _SINES = 8192, 1 << 16  # angles and sines in a table of weights
# Padding against wrap-around: Fresnel zones along the track, and resolution cells in range.
_TAIL_ZONES, _TAIL_CELLS = 8.0, 64.0
_OVERSAMPLING = 1.5  # of everything that is interpolated
_POSITIONS = 1 << 14  # between two wavenumbers, at which weights are tabulated for -90 dB
_LINES_AT_ONCE, _MODES_AT_ONCE = 64, 64  # bound memory


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

    The image is the product of this transform and the spectrum of the lines, summed over k_y and
    k_x [1]_ [2]_ [3]_. In every term R is a separate factor, so that amplitudes are those of
    backprojection. The remaining difference is diffraction at the edges of the weights, which
    stationary phase neglects. It grows with the steepness of the edges, and is of the order
    (K R width^2)^(-5/4) for a Hann beam. Without a beam the term D, which is then
    3/(8 cos(theta)), is left out.

    Stolt's change of variables interpolates the spectrum from K to k_y. Channels are spread onto a
    regular track, and the image is interpolated at its rows and columns. These four interpolations,
    with the Kaiser-Bessel weights of [4]_, have an error of -80 dB together.

    References
    ----------
    .. [1] Stolt, "Migration by Fourier transform", Geophysics 43, 1978.
    .. [2] Cafforio, Prati, Rocca, "SAR data focusing using seismic migration techniques",
       IEEE Trans. Aerospace and Electronic Systems 27, 1991.
    .. [3] Soumekh, "Synthetic Aperture Radar Signal Processing", Wiley, 1999.
    .. [4] Keiner, Kunis, Potts, "Using NFFT 3", ACM Trans. Mathematical Software 36, 2009.

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
    workers = validate.count("workers", cores() if workers is None else workers)
    if not grid.is_planar:
        kind = "heights" if grid.points_m is None else "points"
        raise ArgumentError("grid", "be a plane with rows along the track", kind)
    check_numbers(lines, beam)
    formed = Formed(
        method="wavenumber",
        tolerance_db=None,
        plan="with motion compensation" if motion_compensation else "",
        predicted_error_db=None,
        beam=beam,
        left_out=(),
        device="host",
        version=__version__,
        lines_digest=samples_digest(lines),
    )
    if beam is not None and beam.normalise:
        raise ArgumentError("beam", "not normalise here", hint="use `clsas.backproject` for that")
    if lines.sound_speed is not None:
        water = homogeneous(lines, grid, beam, None, corrected=False)
        if not water.grid.is_planar:
            raise ArgumentError("grid", "be level for lines with a profile of the sound speed")
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
        return Image(np.zeros(grid.shape, np.complex64), grid, formed=formed)
    warn_before_imaging(lines, grid, beam)
    _warn_bent(lines, grid, track, aspects, band, motion_compensation)
    on_line = replace(track, along_m=track.along_m[visible], shift_m=track.shift_m[visible])
    pixels = migrate(lines.select(visible), on_line, aspects, band, ACCURACY_DB, workers)
    return Image(pixels, grid, formed=formed)


@dataclass(frozen=True, eq=False)
class StraightTrack:
    """The straight line that approximates the track, and the grid in its coordinates.

    Attributes
    ----------
    along_m : float64 [channels]
        Phase centres along the line, relative to their mean.
    shift_m : float64 [channels]
        True range minus the range from the line.
    off_m : float
        Largest distance of a phase centre from the line.
    row_range_m : float64 [rows]
        Distance of the rows of the grid from the line.
    pixel_along_m : float64 [rows, columns]
        Positions of the pixels along the line.
    """

    along_m: NDArray[np.float64]
    shift_m: NDArray[np.float64]
    off_m: float
    row_range_m: NDArray[np.float64]
    pixel_along_m: NDArray[np.float64]

    @property
    def ranges_m(self) -> tuple[float, float]:
        """Distance of the nearest and the farthest row from the line, metres."""
        return float(self.row_range_m.min()), float(self.row_range_m.max())

    def reach_m(self, low: float, high: float) -> tuple[float, float]:
        """Return the first and last position with a pixel at an aspect angle from low to high."""
        ahead_m = np.multiply.outer(np.tan([low, high]), self.ranges_m)
        corners_m = self.pixel_along_m[:: max(len(self.pixel_along_m) - 1, 1), [0, -1]]
        return corners_m.min() - ahead_m[1].max(), corners_m.max() - ahead_m[0].min()


@dataclass(frozen=True, eq=False)
class Aspects:
    """Weights of the spectrum over the aspect angle.

    Attributes
    ----------
    low, high : float
        Aspect angles beyond which the weights are 0, radians.
    terms : tuple of float32 [sines]
        Weights at equal steps of the sine from `low` to `high`: the factor of 1 and, with a beam,
        the factor of j/(K R).
    """

    low: float
    high: float
    terms: tuple[NDArray[np.float32], ...]


def band_of(lines: RangeLines) -> tuple[float, float]:
    """Return the two-way wavenumbers between which the lines have energy, rad/m."""
    spectrum = measure_spectrum(lines)
    used = np.flatnonzero(np.cumsum(spectrum.power[::-1])[::-1] > _UNUSED)[-1]
    half = float(spectrum.frequency[used] + spectrum.frequency[0])
    cycles_per_m = cycles_per_m_at(lines, spectrum.centre)
    validate.positive("the middle frequency of lines", cycles_per_m, "cycles/m")
    middle, half = 2 * np.pi * cycles_per_m, 2 * np.pi * half / lines.range_step_m
    return max(middle - half, 1e-9 * middle), middle + half


def straighten(
    lines: RangeLines, grid: Grid, beam: BeamWindow | None, compensated: bool
) -> StraightTrack:
    """Return the straight line along the grid's rows that approximates the track."""
    rows, columns = grid.shape
    tx_m, rx_m = lines.tx_m - lines.tx_m[0], lines.rx_m - lines.tx_m[0]
    origin_m, row_step_m, column_step_m = grid.vectors_m
    row_m = origin_m - lines.tx_m[0] + np.arange(rows)[:, None] * row_step_m
    centres_m = (tx_m + rx_m) / 2
    if lines.rx_velocity_m_s is not None:  # receivers move while the sound travels
        range_m = np.linalg.norm(row_m[rows // 2] - centres_m.mean(axis=0))
        centres_m = centres_m + lines.rx_velocity_m_s * range_m / lines.sound_speed_m_s
    middle_m = centres_m.mean(axis=0)
    offset_m = centres_m - middle_m

    # The line runs along the rows of the grid, which must run along the track and the beam.
    of_track = course(centres_m)
    if not np.ptp(offset_m @ of_track) > 0:
        raise ArgumentError("lines", "have phase centres at two positions or more", "one")
    direction = column_step_m if columns > 1 else of_track
    direction = direction / np.linalg.norm(direction)
    courses = {"track": of_track}
    if beam is not None:
        courses["beam's along"] = beam.directions(lines).mean(axis=0)
        direction = direction * np.copysign(1, direction @ courses["beam's along"])
    for name, other in courses.items():
        turn = math.acos(min(float(abs(other @ direction) / np.linalg.norm(other)), 1.0))
        name = f"the angle between the grid's rows and the {name}"
        validate.number(name, math.degrees(turn), "degrees", most=_MOST_TURN_DEG)

    along_m = offset_m @ direction
    off_m = offset_m - along_m[:, None] * direction
    row_m = row_m - middle_m
    row_along_m = row_m @ direction
    across_m = row_m - row_along_m[:, None] * direction

    # Ranges are exact for the middle row in the middle of the beam.
    squint = 0.0 if beam is None else math.radians(beam.squint_deg)
    aim_m = across_m[rows // 2]
    aim_m = aim_m + np.linalg.norm(aim_m) * math.tan(squint) * direction
    ignored_m = 0.0 if compensated else off_m
    ends_m = (tx_m - middle_m - ignored_m, rx_m - middle_m - ignored_m)
    motion = lines.rx_velocity_m_s, lines.sound_speed_m_s
    true_range_m = bistatic_range_m(along_m[:, None] * direction + aim_m, *ends_m, *motion)
    return StraightTrack(
        along_m,
        true_range_m - float(np.linalg.norm(aim_m)),
        float(np.linalg.norm(off_m, axis=1).max()),
        np.linalg.norm(across_m, axis=1),
        row_along_m[:, None] + np.arange(columns) * (column_step_m @ direction),
    )


def aspects_of(
    lines: RangeLines, track: StraightTrack, beam: BeamWindow | None, band: tuple[float, float]
) -> Aspects | None:
    """Return the weights over the aspect angles that occur, or None if no pixel is visible.

    Weights fall to zero smoothly beyond the angles of all pixels, where they do not matter.
    """
    near_m, far_m = track.ranges_m
    least_m = 4 * np.pi / sum(band) * 2
    validate.number("the distance of grid from the track", near_m, "m", least=least_m)
    begin_m, end_m = track.reach_m(0, 0)
    ahead_m = begin_m - track.along_m.max(), end_m - track.along_m.min()
    low = math.atan2(ahead_m[0], near_m if ahead_m[0] < 0 else far_m)
    high = math.atan2(ahead_m[1], near_m if ahead_m[1] > 0 else far_m)
    # A line has no echoes from beyond its end.
    first_m = float((lines.first_range_m - track.shift_m).min())
    last_m = max(float((lines.last_range_m - track.shift_m).max()), 1e-30)
    widest = math.acos(min(near_m / last_m, 1))
    low, high = max(low, -widest), min(high, widest)
    if near_m > last_m or low > high or far_m / math.cos(max(-low, high)) < first_m:
        return None
    zone = _zone_m(band, near_m) / near_m
    ends = low - (1 + _EDGE_ZONES) * zone, high + (1 + _EDGE_ZONES) * zone
    if beam is not None:
        ends = max(ends[0], beam.limits_rad[0]), min(ends[1], beam.limits_rad[1])
    if not ends[0] < ends[1]:
        return None
    steepest = math.degrees(max(-ends[0], ends[1]))
    name = "the aspect angle of grid, unless beam limits it,"
    validate.number(name, steepest, "degrees", most=_STEEPEST_DEG)

    # Angles are the middles of intervals, so that jumps at the ends of a beam stay outside.
    step = (ends[1] - ends[0]) / _ANGLES
    angle = ends[0] + step * (np.arange(_ANGLES) + 0.5)
    fade = smooth_edge(((angle - high) / zone - 1) / _EDGE_ZONES)
    fade *= smooth_edge(((low - angle) / zone - 1) / _EDGE_ZONES)
    terms = [fade]
    if beam is not None:
        weight = beam.weights(np.sin(angle), wavelength_m(lines))
        slope = np.gradient(weight, step)
        second = (np.gradient(slope, step) * np.cos(angle) + slope * np.sin(angle)) / 2
        second += 3 / 8 * weight / np.cos(angle)
        terms = [weight * fade, second * fade]
    first, last = np.sin(ends)
    sines = first + (last - first) * (np.arange(_SINES) + 0.5) / _SINES
    return Aspects(
        *ends, tuple(np.interp(sines, np.sin(angle), each).astype(np.float32) for each in terms)
    )


def _zone_m(band: tuple[float, float], range_m: float) -> float:
    """Return the length of a Fresnel zone at a range, metres."""
    return math.sqrt(4 * np.pi / sum(band) * range_m)


def _warn_bent(
    lines: RangeLines,
    grid: Grid,
    track: StraightTrack,
    aspects: Aspects,
    band: tuple[float, float],
    compensated: bool,
) -> None:
    """Warn if the track is not a straight line, with the range errors at the grid's corners."""
    wavelength_m = 8 * np.pi / sum(band)
    corners = [slice(None, None, max(count - 1, 1)) for count in grid.shape]
    ahead_m = track.pixel_along_m[tuple(corners)][..., None] - track.along_m
    nominal_m = np.hypot(ahead_m, track.row_range_m[corners[0], None, None])
    motion = lines.rx_velocity_m_s, lines.sound_speed_m_s
    points_m = grid.positions_m(*corners).reshape(-1, 3)
    range_m = pairwise_range_m(points_m, lines.tx_m, lines.rx_m, *motion).reshape(nominal_m.shape)
    sine = ahead_m / nominal_m
    visible = (sine > math.sin(aspects.low)) & (sine < math.sin(aspects.high))
    error_m = float(np.abs(visible * (range_m - track.shift_m - nominal_m)).max())
    if max(error_m, track.off_m) <= _STRAIGHT * wavelength_m:
        return
    treated = "moved onto it for the middle range of the grid" if compensated else "left there"
    validate.warn(
        f"a wavenumber image assumes a straight monostatic track: phase centres up to "
        f"{track.off_m:.3g} m off a line along the grid's rows are {treated}, which leaves range "
        f"errors of up to {error_m:.3g} m ({error_m / wavelength_m:.2g} wavelengths) at the "
        f"grid's corners; the error of the image is not controlled"
    )


def migrate(
    lines: RangeLines,
    track: StraightTrack,
    aspects: Aspects,
    band: tuple[float, float],
    accuracy_db: float,
    workers: int,
) -> NDArray[np.complex64]:
    """Return the pixels of a wavenumber image, [rows, columns]."""
    near_m, far_m = track.ranges_m
    steepest = max(-aspects.low, aspects.high)
    tail_m = _TAIL_CELLS * 2 * np.pi / (band[1] - band[0])
    # Four interpolations add their errors.
    taps = taps_for(accuracy_db - 3, _OVERSAMPLING)

    # Samples that are closer or farther than every visible pixel fade out, and are left out.
    begin_m = lines.first_range_m - track.shift_m  # of every line
    keep_m = near_m - tail_m, far_m / math.cos(steepest) + tail_m
    first = max(math.floor((keep_m[0] - begin_m.max()) / lines.range_step_m), 0)
    last = math.ceil((keep_m[1] - begin_m.min()) / lines.range_step_m) + 1
    last = max(min(last, lines.length), first + 1)
    begin_m = begin_m + first * lines.range_step_m
    first_m, last_m = begin_m.min(), begin_m.max() + (last - first - 1) * lines.range_step_m
    centre_m = (first_m + last_m) / 2
    length = math.ceil(_OVERSAMPLING * ((last_m - first_m) / lines.range_step_m + 1)) + taps
    length = scipy.fft.next_fast_len(length)
    per_m = 2 * np.pi / (length * lines.range_step_m)  # between wavenumbers K

    # Wavenumbers K of the band, and those beside it that are needed for interpolation.
    cycles = (np.array(band) - 2 * lines.wavenumber_rad_m) / per_m
    cycles = np.arange(math.ceil(cycles[0]) - taps, math.floor(cycles[1]) + taps + 1)
    wave = 2 * lines.wavenumber_rad_m + per_m * cycles

    # Periods that keep echoes from wrapping around, and wavenumbers k_x along the track.
    reach_m = track.reach_m(aspects.low, aspects.high)
    period_m = max(track.along_m.max() - reach_m[0], reach_m[1] - track.along_m.min())
    period_m += _TAIL_ZONES * _zone_m(band, far_m)
    sine = math.sin(aspects.low), math.sin(aspects.high)
    extremes = np.multiply.outer(sine, band) * period_m / (2 * np.pi)
    modes = np.arange(math.floor(extremes[0].min()), math.ceil(extremes[1].max()) + 1)
    middle = int(modes[len(modes) // 2])
    fine = scipy.fft.next_fast_len(math.ceil(_OVERSAMPLING * len(modes)) + taps)
    gain = gridding_gain((modes - middle) / fine, taps, _OVERSAMPLING).astype(np.float32)
    depth_m = max(last_m - near_m, far_m - min(first_m, first_m * math.cos(steepest))) + tail_m
    rows, columns = track.pixel_along_m.shape
    size = (lines.channels + 2 * fine) * len(wave) + (len(modes) + 2 * fine + 2 * columns) * rows
    validate.memory("lines and grid", 8 * size)

    # Fourier transform of the lines along range, relative to the middle range.
    per_sample = (begin_m[:, None] - centre_m) / lines.range_step_m + np.arange(last - first)
    table = np.linspace(-0.5, 0.5, 4096)
    flat = 1 / gridding_gain(table / _OVERSAMPLING, taps, _OVERSAMPLING)
    spectra = np.empty((lines.channels, len(wave)), np.complex64)
    for start in range(0, lines.channels, _LINES_AT_ONCE):
        some = slice(start, start + _LINES_AT_ONCE)
        share = np.interp(per_sample[some] / length * _OVERSAMPLING, table, flat)
        range_m = centre_m + per_sample[some] * lines.range_step_m
        share *= smooth_edge((near_m - range_m) / tail_m) if first > 0 else 1
        share *= smooth_edge((range_m - keep_m[1]) / tail_m + 1) if last < lines.length else 1
        samples = lines.samples[some, first:last] * share.astype(np.float32)
        whole = scipy.fft.fft(samples, length, workers=workers)[:, cycles % length]
        turns = np.multiply.outer(centre_m - begin_m[some], per_m / (2 * np.pi) * cycles)
        turns += (lines.wavenumber_rad_m / np.pi * track.shift_m[some])[:, None]
        turns -= np.multiply.outer(track.along_m[some] / period_m, [middle])
        spectra[some] = whole * turned_single(turns)

    # Fourier transform along the track: channels are spread onto a regular track.
    onto = gridding(track.along_m * (fine / period_m), fine, taps, _OVERSAMPLING)
    spectrum = onto.T.astype(np.float32) @ spectra
    spectrum = scipy.fft.fft(spectrum, axis=0, overwrite_x=True, workers=workers)

    # Stolt's interpolation, and the inverse transform along range.
    position = (np.arange(_POSITIONS + 1) / _POSITIONS - taps / 2) + np.arange(taps)[:, None]
    kernel = gridding_weights(position, taps, _OVERSAMPLING).astype(np.float32)
    tables = [np.pad(each, 1) for each in aspects.terms]
    per_sine = len(aspects.terms[0]) / (sine[1] - sine[0])
    row_m = track.row_range_m - (near_m + far_m) / 2
    per_depth = 2 * np.pi / depth_m  # between wavenumbers k_y
    scale = math.sqrt(2 * np.pi) * np.exp(0.25j * np.pi) / (period_m * length) * per_depth / per_m

    def focus(first: int) -> NDArray[np.complex64]:
        """Return some modes at every row."""
        mode = modes[first : first + _MODES_AT_ONCE]
        some = spectrum[(mode - middle) % fine] / gain[first : first + len(mode), None]
        focused = np.zeros((len(mode), rows), np.complex64)
        along = 2 * np.pi / period_m * mode[:, None]
        inside = wave[taps:-taps]
        seen = (along >= sine[0] * inside) & (along <= sine[1] * inside)
        if not seen.any():
            return focused
        across = np.sqrt((inside**2 - along**2)[seen])
        lowest = max(math.floor(across.min() / per_depth), 1)
        highest = max(math.floor(across.max() / per_depth), lowest)
        across = per_depth * np.arange(lowest, highest + 1)
        k = np.sqrt(across**2 + along**2)
        place = np.clip((k - wave[0]) / per_m, taps, len(wave) - 1 - taps)
        left = np.ceil(place - taps / 2).astype(np.intp)
        at = np.rint((left - place + taps / 2) * _POSITIONS).astype(np.intp)
        left += len(wave) * np.arange(len(mode))[:, None]
        moved = np.zeros(k.shape, np.complex64)
        for tap in range(taps):
            moved += kernel[tap].take(at) * some.take(left + tap)
        turns = across * ((near_m + far_m) / 4 / np.pi)
        moved *= turned_single(turns - (k - 2 * lines.wavenumber_rad_m) * (centre_m / (2 * np.pi)))
        moved *= (k >= band[0]) & (k <= band[1])

        at = np.clip((along / k - sine[0]) * per_sine + 1, 0, len(tables[0]) - 1).astype(np.intp)
        count = scipy.fft.next_fast_len(math.ceil(_OVERSAMPLING * len(across)) + taps)
        places = np.arange(len(across)) - len(across) // 2
        strength = scale / np.sqrt(across)
        strength /= gridding_gain(places / count, taps, _OVERSAMPLING)
        onto = gridding(row_m * (count / depth_m), count, taps, _OVERSAMPLING).astype(np.float32)
        carrier = turned_single(across[len(across) // 2] / (2 * np.pi) * row_m)
        for power, term in enumerate(tables):
            part = np.zeros((len(mode), count), np.complex64)
            factor = strength.astype(np.complex64) if power == 0 else 1j * strength / k
            part[:, places % count] = moved * term.take(at) * factor
            image = onto @ scipy.fft.ifft(part, overwrite_x=True, norm="forward").T
            focused += (image.T * (carrier * track.row_range_m ** (0.5 - power))).astype(
                np.complex64
            )
        return focused

    starts = range(0, len(modes), _MODES_AT_ONCE)
    focused = np.concatenate(list(in_threads(focus, starts, workers)))

    # Inverse transform along the track, interpolated at the columns.
    along_m = track.pixel_along_m
    start_m = along_m[:, 0] - along_m[0, 0]
    if start_m.any():  # every row begins at its own position along the track
        focused *= turned_single(np.multiply.outer(modes / period_m, start_m))
    whole = np.zeros((fine, rows), np.complex64)
    whole[(modes - middle) % fine] = focused / gain[:, None]
    whole = scipy.fft.ifft(whole, axis=0, overwrite_x=True, norm="forward", workers=workers)
    onto = gridding(along_m[0] * (fine / period_m), fine, taps, _OVERSAMPLING).astype(np.float32)
    return (onto @ whole).T * turned_single(middle / period_m * along_m[0])
