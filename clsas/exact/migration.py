"""Migration: the sums of a wavenumber image, computed by non-uniform FFTs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import finufft
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from clsas.core import validate
from clsas.core.lines import RangeLines
from clsas.core.threads import in_threads
from clsas.exact.straight_track import Aspects, Band, StraightTrack

_FINUFFT = {"eps": 1e-7, "nthreads": 1}  # as accurate as complex64
# Padding against wrap-around beyond the visible pixels: Fresnel zones along the track, and samples.
_TAIL_ZONES, _TAIL_SAMPLES = 8.0, 64
_LINES_AT_ONCE = 64  # bounds memory


@dataclass(frozen=True, eq=False)
class _Waves:
    """Wavenumbers of the image: two-way wavenumbers of the band, and modes along the track.

    Attributes
    ----------
    length : int
        Samples of a padded range line.
    cycles : int64 [n]
        Frequencies within the band, cycles per padded line.
    wave : float64 [n]
        Two-way wavenumbers K at these frequencies, rad/m.
    period_m : float
        Period along the track, metres.
    modes : int64 [m]
        Cycles per period along the track.
    """

    length: int
    cycles: NDArray[np.int64]
    wave: NDArray[np.float64]
    period_m: float
    modes: NDArray[np.int64]

    @property
    def per_m(self) -> float:
        """Wavenumber along the track of one mode, rad/m."""
        return 2 * np.pi / self.period_m


def _waves(lines: RangeLines, track: StraightTrack, aspects: Aspects, band: Band) -> _Waves:
    """Return the wavenumbers of an image, with periods that keep echoes from wrapping around."""
    near_m, far_m = track.ranges_m
    first_m, last_m = lines.first_range_m - track.shift_m, lines.last_range_m - track.shift_m
    farthest_m = far_m / math.cos(max(-aspects.low, aspects.high))
    samples = (max(last_m.max(), farthest_m) - min(first_m.min(), near_m)) / lines.range_step_m
    length = scipy.fft.next_fast_len(math.ceil(samples) + _TAIL_SAMPLES)
    begin_m, end_m = track.reach_m(aspects.low, aspects.high)
    period_m = max(track.along_m.max() - begin_m, end_m - track.along_m.min())
    period_m += _TAIL_ZONES * band.zone_m(far_m)

    cycles = np.arange(length) + math.ceil((band.centre_cycles - 0.5) * length)
    cycles = cycles[np.abs(cycles / length - band.centre_cycles) <= band.half_cycles]
    wave = band.carrier + 2 * np.pi / (length * lines.range_step_m) * cycles
    cycles, wave = cycles[wave > 0], wave[wave > 0]
    sine = [math.sin(aspects.low), math.sin(aspects.high)]
    extremes = np.multiply.outer(sine, wave[[0, -1]]) / (2 * np.pi / period_m)
    lowest, highest = math.floor(extremes[0].min()), math.ceil(extremes[1].max())
    return _Waves(length, cycles, wave, period_m, np.arange(lowest, highest + 1))


def migrate(
    lines: RangeLines, track: StraightTrack, aspects: Aspects, band: Band, workers: int
) -> NDArray[np.complex128]:
    """Return the pixels of a wavenumber image, [rows, columns]."""
    waves = _waves(lines, track, aspects, band)
    rows, columns = track.pixel_along_m.shape
    span = len(waves.modes) - 1
    size = (lines.channels + 3 * span) * len(waves.wave) + (2 * span + 3 * columns) * rows
    validate.memory("lines and grid", 16 * size)
    spectrum = _spectrum(lines, track, waves, band, workers)
    focused = _focus(spectrum, track, aspects, waves, workers)

    per_m, middle = waves.per_m, _middle(waves.modes)
    start_m = track.pixel_along_m[:, 0] - track.pixel_along_m[0, 0]
    if start_m.any():  # every row begins at its own position along the track
        focused *= np.exp(1j * per_m * np.multiply.outer(start_m, waves.modes))
    angle = per_m * track.pixel_along_m[0]
    pixels = finufft.nufft1d2(angle, focused, isign=1, **_FINUFFT).reshape(rows, columns)
    return pixels * np.exp(1j * middle * angle)


def _middle(modes: NDArray[np.int64]) -> np.int64:
    """Return the middle mode, by which finufft's modes, which lie around 0, are shifted."""
    return modes[len(modes) // 2]


def _spectrum(
    lines: RangeLines, track: StraightTrack, waves: _Waves, band: Band, workers: int
) -> NDArray[np.complex128]:
    """Return the spectrum of the lines over wavenumbers K and modes along the track, [n, m]."""
    spectra = np.empty((len(waves.wave), lines.channels), np.complex128)
    for first in range(0, lines.channels, _LINES_AT_ONCE):
        some = slice(first, first + _LINES_AT_ONCE)
        samples = lines.samples[some].astype(np.complex128)
        whole = scipy.fft.fft(samples, waves.length, workers=workers)
        phase = np.multiply.outer(waves.wave, track.shift_m[some])
        phase -= np.multiply.outer(waves.wave - band.carrier, lines.first_range_m[some])
        spectra[:, some] = whole[:, waves.cycles % waves.length].T * np.exp(1j * phase)
    angle = waves.per_m * track.along_m
    spectra *= np.exp(-1j * _middle(waves.modes) * angle)
    spectrum = finufft.nufft1d1(angle, spectra, len(waves.modes), isign=-1, **_FINUFFT)
    return spectrum.reshape(len(waves.wave), len(waves.modes))


def _focus(
    spectrum: NDArray[np.complex128],
    track: StraightTrack,
    aspects: Aspects,
    waves: _Waves,
    workers: int,
) -> NDArray[np.complex128]:
    """Return the image over rows and modes along the track, [rows, m]."""
    low, high = math.sin(aspects.low), math.sin(aspects.high)
    scale = math.sqrt(2 * np.pi) * np.exp(0.25j * np.pi) / (waves.period_m * waves.length)

    def focus(mode: int) -> NDArray[np.complex128]:
        """Return one mode at every row."""
        along = waves.per_m * waves.modes[mode]
        visible = (along > low * waves.wave) & (along < high * waves.wave)
        if not visible.any():
            return np.zeros(len(track.row_range_m), np.complex128)
        k = waves.wave[visible]
        across = np.sqrt((k - along) * (k + along))
        strength = scale * k / across**1.5 * spectrum[visible, mode]
        weights = (np.interp(along / k, aspects.sine, term) for term in aspects.terms)
        strengths = np.stack([(1j / k) ** i * w * strength for i, w in enumerate(weights)])
        parts = finufft.nufft1d3(across, strengths, track.row_range_m, isign=1, **_FINUFFT)
        parts = parts.reshape(-1, len(track.row_range_m))
        return sum(part * track.row_range_m ** (0.5 - i) for i, part in enumerate(parts))

    return np.stack(list(in_threads(focus, range(len(waves.modes)), workers)), axis=1)
