"""Wavenumber images without interpolation: the sums by non-uniform FFTs, in float64."""

import math

import finufft
import numpy as np
import scipy.fft

from clsas.engine.exact.wavenumber import aspects_of, band_of, straighten

_ACCURACY = {"eps": 1e-9, "nthreads": 1}
_TAIL_ZONES, _TAIL_M = 8.0, 4.0  # padding against wrap-around along the track, and in range


def wavenumber_sum(lines, grid, beam=None, motion_compensation=True):
    """Return the pixels that `clsas.wavenumber` approximates, complex128 [rows, columns].

    Every sum over channels, wavenumbers K and modes along the track is computed as it is written in
    the notes of that function. The spectrum is summed over K, without a change of variables.
    """
    band = band_of(lines)
    track = straighten(lines, grid, beam, motion_compensation)
    aspects = aspects_of(lines, track, beam, band)
    low, high = math.sin(aspects.low), math.sin(aspects.high)
    near_m, far_m = track.ranges_m
    begin_m, end_m = track.reach_m(aspects.low, aspects.high)
    visible = (track.along_m >= begin_m) & (track.along_m <= end_m)
    lines, along_m, shift_m = lines.select(visible), track.along_m[visible], track.shift_m[visible]

    # Padded lines and their wavenumbers K, the period along the track and its modes.
    first_m, last_m = lines.first_range_m - shift_m, lines.last_range_m - shift_m
    farthest_m = far_m / math.cos(max(-aspects.low, aspects.high))
    padded_m = max(last_m.max(), farthest_m) - min(first_m.min(), near_m) + _TAIL_M
    length = scipy.fft.next_fast_len(math.ceil(padded_m / lines.range_step_m))
    carrier = 2 * lines.wavenumber_rad_m
    per_m = 2 * np.pi / (length * lines.range_step_m)
    cycles = (np.array(band) - carrier) / per_m
    cycles = np.arange(math.ceil(cycles[0]), math.floor(cycles[1]) + 1)
    wave = carrier + per_m * cycles
    period_m = max(along_m.max() - begin_m, end_m - along_m.min())
    period_m += _TAIL_ZONES * math.sqrt(4 * np.pi / sum(band) * far_m)
    extremes = np.multiply.outer([low, high], band) * period_m / (2 * np.pi)
    modes = np.arange(math.floor(extremes[0].min()), math.ceil(extremes[1].max()) + 1)
    middle = modes[len(modes) // 2]  # finufft counts modes from here

    # The spectrum of the lines, [K, modes].
    spectra = scipy.fft.fft(lines.samples.astype(np.complex128), length)[:, cycles % length].T
    phase = np.multiply.outer(wave, shift_m)
    spectra *= np.exp(1j * (phase - np.multiply.outer(wave - carrier, lines.first_range_m)))
    angle = 2 * np.pi / period_m * along_m
    spectra *= np.exp(-1j * middle * angle)
    spectrum = finufft.nufft1d1(angle, spectra, len(modes), isign=-1, **_ACCURACY)

    # Every mode at the rows.
    focused = np.zeros((len(track.row_range_m), len(modes)), np.complex128)
    scale = math.sqrt(2 * np.pi) * np.exp(0.25j * np.pi) / (period_m * length)
    sines = low + (high - low) * (np.arange(len(aspects.terms[0])) + 0.5) / len(aspects.terms[0])
    for number, mode in enumerate(modes):
        along = 2 * np.pi / period_m * mode
        seen = (along > low * wave) & (along < high * wave)
        if not seen.any():
            continue
        k = wave[seen]
        across = np.sqrt((k - along) * (k + along))
        strength = scale * k / across**1.5 * spectrum[seen, number]
        for power, term in enumerate(aspects.terms):
            weighted = (1j / k) ** power * np.interp(along / k, sines, term) * strength
            part = finufft.nufft1d3(across, weighted, track.row_range_m, isign=1, **_ACCURACY)
            focused[:, number] += part * track.row_range_m ** (0.5 - power)

    # The modes at the columns.
    start_m = track.pixel_along_m[:, 0] - track.pixel_along_m[0, 0]
    focused *= np.exp(2j * np.pi / period_m * np.multiply.outer(start_m, modes))
    angle = 2 * np.pi / period_m * track.pixel_along_m[0]
    pixels = finufft.nufft1d2(angle, focused, isign=1, **_ACCURACY)
    return pixels.reshape(grid.shape) * np.exp(1j * middle * angle)
