"""Wavenumber image of a straight track: what backprojection does, in the frequency domain."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace

import finufft
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from clsas.core import validate
from clsas.core.fourier import smooth_edge
from clsas.core.geometry import bistatic_range_m, pairwise_range_m
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.lines import RangeLines, wavelength_m
from clsas.core.threads import in_threads
from clsas.exact.checks import check_numbers
from clsas.signal.spectrum import measure_spectrum
from clsas.sonar.beam import BeamWindow
from clsas.sonar.coverage import warn_unseen

_SUM_ERROR = 1e-7  # of the non-uniform FFTs: what complex64 holds
_UNUSED = 1e-12  # share of the energy that may be left out
_STEEPEST_DEG = 85.0  # where ranges are ten times those at broadside
_MOST_TURN_DEG = 5.0
_EDGE_ZONES = 6.0  # Fresnel zones over which an aperture without a beam ends
_TAIL_ZONES, _TAIL_SAMPLES = 8.0, 64  # against wrap-around, beyond what is seen
_ANGLES = 8192  # of tables of weights
_STRAIGHT = 1e-3  # wavelengths: smaller errors need no warning
_LINES_AT_ONCE = 64


@dataclass(frozen=True, eq=False)
class _Track:
    """The line that stands for the track, and the grid as seen from it.

    Metres along the line count from the middle of the phase centres.
    """

    along_m: NDArray[np.float64]  # [channels]
    shift_m: NDArray[np.float64]  # [channels]: by how much ranges are longer than from the line
    off_m: float  # how far phase centres lie off the line
    row_range_m: NDArray[np.float64]  # [rows]
    pixel_along_m: NDArray[np.float64]  # [rows, columns]

    @property
    def ranges_m(self) -> tuple[float, float]:
        """Ranges of the nearest and the farthest row."""
        return float(self.row_range_m.min()), float(self.row_range_m.max())

    def reach_m(self, low: float, high: float) -> tuple[float, float]:
        """Along the line, between which places some pixel is seen at angles low to high."""
        ahead_m = np.multiply.outer(np.tan([low, high]), self.ranges_m)
        corners_m = self.pixel_along_m[:: max(len(self.pixel_along_m) - 1, 1), [0, -1]]
        return corners_m.min() - ahead_m[1].max(), corners_m.max() - ahead_m[0].min()


@dataclass(frozen=True, eq=False)
class _Band:
    """Where the lines have energy: cycles per sample about a centre, off the carrier, rad/m."""

    carrier: float
    centre_cycles: float
    half_cycles: float
    wavelength_m: float

    def zone_m(self, range_m: float) -> float:
        """Return the length of a Fresnel zone."""
        return math.sqrt(self.wavelength_m * range_m / 2)


@dataclass(frozen=True, eq=False)
class _Aspects:
    """What the spectrum weighs at the sines of aspect angles, and where that ends, radians."""

    low: float
    high: float
    sine: NDArray[np.float64]
    terms: tuple[NDArray[np.float64], ...]  # factors of 1, and with a beam of j/(K R)


def wavenumber(
    lines: RangeLines,
    grid: Grid,
    *,
    beam: BeamWindow | None = None,
    motion_compensation: bool = True,
    workers: int | None = None,
) -> Image:
    """Form the image of a straight track in the wavenumber domain.

    Parameters
    ----------
    lines : RangeLines
        Channels in any order, at any spacing along a straight line. Tracks that are not straight,
        bistatic channels and receivers that move are approximated, see `motion_compensation`.
    grid : Grid
        A plane, horizontal or tilted, whose rows of pixels run along the track.
    beam : BeamWindow, optional
        As for `clsas.backproject`, but angles are always from the line. Without one every channel
        weighs 1.
    motion_compensation : bool
        Whether every line is shifted in range by its phase centre's distance from a line along
        the grid's rows, as seen from the middle of the grid's ranges and of the beam: exact there
        only. If not, phase centres are taken as if they were on the line.
    workers : int, optional
        Threads; one for each processor unless given.

    Returns
    -------
    Image
        complex64, with the amplitudes and phases of `clsas.backproject`.

    Raises
    ------
    TypeError, ValueError
        If an argument is not what is allowed: a grid that is not a plane, is turned from the track
        by more than 5 degrees or nearer than a wavelength; phase centres that all coincide; aspect
        angles beyond 85 degrees; a beam that normalises; or arrays that do not fit into memory.

    Warns
    -----
    ClsasWarning
        If the track is not straight and monostatic, with the range errors that remain; or if the
        lines add nothing to the image.

    Notes
    -----
    For every two-way wavenumber K the exact image is a convolution along the track with
    w(theta) exp(j K rho), whose transform is, at sin(theta) = k_x/K and the distance R from the
    track, by stationary phase

        sqrt(2 pi R) K k_y^(-3/2) [w + j D/(K R)] exp(j k_y R + j pi/4),   k_y^2 = K^2 - k_x^2,
        D = (w'' cos(theta) + w' sin(theta))/2 + 3 w/(8 cos(theta)).

    Times the lines' spectrum and summed over K and k_x this is the image [1]_ [2]_ [3]_. R stands
    apart from K and k_x in every term, so that amplitudes are those of backprojection. What
    remains are the window's edges, here not diffracted: the steeper the more, and for a Hann
    window of the order (K R width^2)^(-5/4). D is left out without a beam: it is
    3/(8 cos(theta)).

    The sums over channels, K and k_x are non-uniform FFTs [4]_. One of type 3 goes straight from
    the k_y, where the spectrum is, to the R, where rows are: Stolt's interpolation and the one from
    slant to ground range at once, to 1e-7.

    References
    ----------
    .. [1] Stolt, "Migration by Fourier transform", Geophysics 43, 1978.
    .. [2] Cafforio, Prati, Rocca, "SAR data focusing using seismic migration techniques",
       IEEE Trans. Aerospace and Electronic Systems 27, 1991.
    .. [3] Soumekh, "Synthetic Aperture Radar Signal Processing", Wiley, 1999.
    .. [4] Barnett, Magland, af Klinteberg, "A parallel nonuniform fast Fourier transform library",
       SIAM J. Scientific Computing 41, 2019.
    """
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    validate.instance("beam", beam, BeamWindow, type(None))
    validate.instance("motion_compensation", motion_compensation, bool)
    workers = validate.count("workers", os.cpu_count() if workers is None else workers)
    if not grid.is_planar:
        kind = "heights" if grid.points_m is None else "points"
        raise ValueError(f"grid must be a plane with rows along the track, got {kind}")
    check_numbers(lines, beam)
    if beam is not None and beam.normalise:
        raise ValueError("beam must not normalise: sums of weights are clsas.backproject's")
    band = _band(lines)
    track = _straighten(lines, grid, beam, motion_compensation)
    aspects = _aspects(lines, track, beam, band)
    seen = np.zeros(lines.channels, bool)
    if aspects is not None:
        first_m, last_m = track.reach_m(aspects.low, aspects.high)
        seen = (track.along_m >= first_m) & (track.along_m <= last_m)
    if not seen.any():
        along = None if beam is None else beam.directions(lines)
        some = (slice(None, None, max(count // 32, 1)) for count in grid.shape)
        warn_unseen(lines, grid.positions_m(*some).reshape(-1, 3), beam, along)
        return Image(np.zeros(grid.shape, np.complex64), grid)
    _warn_bent(lines, grid, track, aspects, band, motion_compensation)
    on_line = replace(track, along_m=track.along_m[seen], shift_m=track.shift_m[seen])
    return Image(_form(lines.select(seen), on_line, aspects, band, workers), grid)


def _band(lines: RangeLines) -> _Band:
    """Return where the lines have energy."""
    spectrum = measure_spectrum(lines)
    used = np.flatnonzero(np.cumsum(spectrum.power[::-1])[::-1] > _UNUSED)[-1]
    half = float(spectrum.frequency[used] + spectrum.frequency[0])
    cycles_per_m = lines.carrier_cycles_per_m + spectrum.centre / lines.range_step_m
    validate.positive("the middle frequency of lines", cycles_per_m, "cycles/m")
    return _Band(2 * lines.wavenumber_rad_m, spectrum.centre, half, 2 / cycles_per_m)


def _straighten(
    lines: RangeLines, grid: Grid, beam: BeamWindow | None, compensated: bool
) -> _Track:
    """Return the line along the grid's rows that stands for the track."""
    rows, columns = grid.shape
    tx_m, rx_m = lines.tx_m - lines.tx_m[0], lines.rx_m - lines.tx_m[0]
    row_m = grid.origin_m - lines.tx_m[0] + np.arange(rows)[:, None] * grid.row_step_m
    centres_m = (tx_m + rx_m) / 2
    if lines.rx_velocity_m_s is not None:  # receivers fly on during the two-way path
        range_m = np.linalg.norm(row_m[rows // 2] - centres_m.mean(axis=0))
        centres_m = centres_m + lines.rx_velocity_m_s * range_m / lines.sound_speed_m_s
    middle_m = centres_m.mean(axis=0)
    away_m = centres_m - middle_m
    course = np.linalg.svd(away_m, full_matrices=False)[2][0]
    if not np.ptp(away_m @ course) > 0:
        raise ValueError("lines must have phase centres at two places or more, got one")
    step_m = grid.column_step_m if columns > 1 else course
    direction = step_m / np.linalg.norm(step_m)
    courses = {"track": course}
    if beam is not None:
        courses["beam's along"] = beam.directions(lines).mean(axis=0)
        direction = direction * np.copysign(1, direction @ courses["beam's along"])
    for name, way in courses.items():
        turn = math.acos(min(abs(way @ direction) / np.linalg.norm(way), 1))
        name = f"the angle of grid's rows to the {name}"
        validate.number(name, math.degrees(turn), "degrees", most=_MOST_TURN_DEG)

    along_m = away_m @ direction
    off_m = away_m - along_m[:, None] * direction
    row_m = row_m - middle_m
    row_along_m = row_m @ direction
    across_m = row_m - row_along_m[:, None] * direction
    squint = 0.0 if beam is None else math.radians(beam.squint_deg)
    aim_m = across_m[rows // 2]
    aim_m = aim_m + np.linalg.norm(aim_m) * math.tan(squint) * direction
    ends_m = (end - middle_m - (0.0 if compensated else off_m) for end in (tx_m, rx_m))
    points_m = along_m[:, None] * direction + aim_m
    range_m = bistatic_range_m(points_m, *ends_m, lines.rx_velocity_m_s, lines.sound_speed_m_s)
    return _Track(
        along_m,
        range_m - np.linalg.norm(aim_m),
        float(np.linalg.norm(off_m, axis=1).max()),
        np.linalg.norm(across_m, axis=1),
        row_along_m[:, None] + np.arange(columns) * (grid.column_step_m @ direction),
    )


def _aspects(
    lines: RangeLines, track: _Track, beam: BeamWindow | None, band: _Band
) -> _Aspects | None:
    """Return the weights over the angles at which channels see pixels, None if there are none.

    Beyond what any channel sees they fall off smoothly, where they do not matter.
    """
    near_m, far_m = track.ranges_m
    validate.number("the distance of grid from the track", near_m, "m", least=band.wavelength_m)
    begin_m, end_m = track.reach_m(0, 0)
    ahead_m = begin_m - track.along_m.max(), end_m - track.along_m.min()
    low = math.atan2(ahead_m[0], near_m if ahead_m[0] < 0 else far_m)
    high = math.atan2(ahead_m[1], near_m if ahead_m[1] > 0 else far_m)
    # Nor does a line hold what is farther than its end.
    first_m = float((lines.first_range_m - track.shift_m).min())
    last_m = max(float((lines.last_range_m - track.shift_m).max()), 1e-30)
    widest = math.acos(min(near_m / last_m, 1))
    low, high = max(low, -widest), min(high, widest)
    if near_m > last_m or low > high or far_m / math.cos(max(-low, high)) < first_m:
        return None
    zone = band.zone_m(near_m) / near_m
    ends = low - (1 + _EDGE_ZONES) * zone, high + (1 + _EDGE_ZONES) * zone
    if beam is not None:
        ends = max(ends[0], beam.limits_rad[0]), min(ends[1], beam.limits_rad[1])
    if not ends[0] < ends[1]:
        return None
    steepest = math.degrees(max(-ends[0], ends[1]))
    name = "the aspect angle of grid, unless beam limits it,"
    validate.number(name, steepest, "degrees", most=_STEEPEST_DEG)
    # The middles of intervals: jumps at the ends of a window stay outside.
    step = (ends[1] - ends[0]) / _ANGLES
    angle = ends[0] + step * (np.arange(_ANGLES) + 0.5)
    fade = smooth_edge(((angle - high) / zone - 1) / _EDGE_ZONES)
    fade *= smooth_edge(((low - angle) / zone - 1) / _EDGE_ZONES)
    if beam is None:
        return _Aspects(*ends, np.sin(angle), (fade,))
    weight = beam.weights(np.sin(angle), wavelength_m(lines))
    slope = np.gradient(weight, step)
    second = (np.gradient(slope, step) * np.cos(angle) + slope * np.sin(angle)) / 2
    second += 3 / 8 * weight / np.cos(angle)
    return _Aspects(*ends, np.sin(angle), (weight * fade, second * fade))


def _warn_bent(
    lines: RangeLines, grid: Grid, track: _Track, aspects: _Aspects, band: _Band, compensated: bool
) -> None:
    """Warn of lines that are not those of the line, by their errors at the grid's corners."""
    corners = [slice(None, None, max(count - 1, 1)) for count in grid.shape]
    ahead_m = track.pixel_along_m[tuple(corners)][..., None] - track.along_m
    nominal_m = np.hypot(ahead_m, track.row_range_m[corners[0], None, None])
    motion = lines.rx_velocity_m_s, lines.sound_speed_m_s
    points_m = grid.positions_m(*corners).reshape(-1, 3)
    range_m = pairwise_range_m(points_m, lines.tx_m, lines.rx_m, *motion).reshape(nominal_m.shape)
    sine = ahead_m / nominal_m
    seen = (sine > math.sin(aspects.low)) & (sine < math.sin(aspects.high))
    error_m = float(np.abs(seen * (range_m - track.shift_m - nominal_m)).max())
    if max(error_m, track.off_m) <= _STRAIGHT * band.wavelength_m:
        return
    treated = "moved onto it for the middle range of the grid" if compensated else "left there"
    validate.warn(
        f"a wavenumber image is that of a straight monostatic track: phase centres up to "
        f"{track.off_m:.3g} m off a line along the grid's rows are {treated}, which leaves range "
        f"errors of up to {error_m:.3g} m ({error_m / band.wavelength_m:.2g} wavelengths) at the "
        f"grid's corners; what the image errs by is not controlled"
    )


def _form(
    lines: RangeLines, track: _Track, aspects: _Aspects, band: _Band, workers: int
) -> NDArray[np.complex128]:
    """Return the pixels [rows, columns]."""
    near_m, far_m = track.ranges_m
    rows, columns = track.pixel_along_m.shape
    # Periods in range and along the track so long that nothing wraps around onto a pixel.
    first_m, last_m = lines.first_range_m - track.shift_m, lines.last_range_m - track.shift_m
    farthest_m = far_m / math.cos(max(-aspects.low, aspects.high))
    length = (max(last_m.max(), farthest_m) - min(first_m.min(), near_m)) / lines.range_step_m
    length = scipy.fft.next_fast_len(math.ceil(length) + _TAIL_SAMPLES)
    first_m, last_m = track.reach_m(aspects.low, aspects.high)
    period_m = max(track.along_m.max() - first_m, last_m - track.along_m.min())
    period_m += _TAIL_ZONES * band.zone_m(far_m)

    cycles = np.arange(length) + math.ceil((band.centre_cycles - 0.5) * length)
    cycles = cycles[np.abs(cycles / length - band.centre_cycles) <= band.half_cycles]
    wave = band.carrier + 2 * np.pi / (length * lines.range_step_m) * cycles
    cycles, wave = cycles[wave > 0], wave[wave > 0]
    low, high = math.sin(aspects.low), math.sin(aspects.high)
    per_m = 2 * np.pi / period_m
    extremes = np.multiply.outer([low, high], wave[[0, -1]]) / per_m
    lowest, highest = math.floor(extremes[0].min()), math.ceil(extremes[1].max())
    size = (lines.channels + 3 * (highest - lowest)) * len(wave)
    size += (2 * (highest - lowest) + 3 * columns) * rows
    validate.memory("lines and grid", 16 * size)
    modes = np.arange(lowest, highest + 1)

    spectra = np.empty((len(wave), lines.channels), np.complex128)
    for first in range(0, lines.channels, _LINES_AT_ONCE):
        some = slice(first, first + _LINES_AT_ONCE)
        whole = scipy.fft.fft(lines.samples[some].astype(np.complex128), length, workers=workers)
        phase = np.multiply.outer(wave, track.shift_m[some])
        phase -= np.multiply.outer(wave - band.carrier, lines.first_range_m[some])
        spectra[:, some] = whole[:, cycles % length].T * np.exp(1j * phase)
    middle = modes[len(modes) // 2]  # finufft's modes are about 0
    options = {"eps": _SUM_ERROR, "nthreads": 1}
    angle = per_m * track.along_m
    spectra *= np.exp(-1j * middle * angle)
    spectrum = finufft.nufft1d1(angle, spectra, len(modes), isign=-1, **options)
    spectrum = spectrum.reshape(len(wave), len(modes))
    scale = math.sqrt(2 * np.pi) * np.exp(0.25j * np.pi) / (period_m * length)

    def focus(mode: int) -> NDArray[np.complex128]:
        """Return one wavenumber along the track, at every row."""
        along = per_m * modes[mode]
        seen = (along > low * wave) & (along < high * wave)
        if not seen.any():
            return np.zeros(rows, np.complex128)
        k = wave[seen]
        across = np.sqrt((k - along) * (k + along))
        strength = scale * k / across**1.5 * spectrum[seen, mode]
        weights = (np.interp(along / k, aspects.sine, term) for term in aspects.terms)
        strengths = np.stack([(1j / k) ** i * w * strength for i, w in enumerate(weights)])
        focused = finufft.nufft1d3(
            across, strengths, track.row_range_m, isign=1, eps=_SUM_ERROR, nthreads=1
        ).reshape(-1, rows)
        return sum(part * track.row_range_m ** (0.5 - i) for i, part in enumerate(focused))

    focused = np.stack(list(in_threads(focus, range(len(modes)), workers)), axis=1)
    start_m = track.pixel_along_m[:, 0] - track.pixel_along_m[0, 0]
    if start_m.any():  # every row begins at its own place along the track
        focused *= np.exp(1j * per_m * np.multiply.outer(start_m, modes))
    angle = per_m * track.pixel_along_m[0]
    pixels = finufft.nufft1d2(angle, focused, isign=1, **options).reshape(rows, columns)
    return pixels * np.exp(1j * middle * angle)
