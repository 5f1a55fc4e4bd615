"""Ranges at which channels receive known reflectors, by envelope and by phase."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from clsas.engine.data.lines import cycles_per_m_at
from clsas.engine.signal.interpolation import Readout
from clsas.navigation.checks import range_cell_m

LEAST_SNR = 10.0
"""Power of a response over that of the noise around it, from which it is used (10 dB). Noise alone
exceeds it once in 20 000 samples."""

_MOST_SNR = 1e7  # because lines are read to -70 dB
_READ_AT_ONCE = 1 << 21  # samples read together, which bounds the memory
# Smallest amplitude of a response, relative to the largest ones of its reflector. Side lobes of
# elements are weaker.
_LEAST_AMPLITUDE = 0.1
_LARGE = 0.9  # quantile of the powers that counts as the largest, as single lines may be louder
_STEPS = 8  # points per range cell at which the envelope is read


@dataclass(frozen=True, eq=False)
class Responses:
    """Responses of reflectors near the ranges where a model expects them.

    Attributes
    ----------
    error_m : float64 [channels, points]
        Range of the peak of the envelope minus the expected range.
    phase_rad : float64 [channels, points]
        Phase at the expected range: that of the reflector, minus the phase of the range error.
    snr : float64 [channels, points]
        Power of the peak over that of the noise around it.
    seen : bool [channels, points]
        Whether the response exceeds the noise.
    bandwidth_per_m : float64 [points]
        Rms bandwidth of the responses, cycles per metre of range.
    """

    error_m: NDArray[np.float64]
    phase_rad: NDArray[np.float64]
    snr: NDArray[np.float64]
    seen: NDArray[np.bool_]
    bandwidth_per_m: NDArray[np.float64]

    @property
    def error_sd_m(self) -> NDArray[np.float64]:
        """Standard deviation of `error_m` due to noise, [channels, points].

        It is 1/(2 pi b sqrt(2 snr)) for an rms bandwidth b, the Cramer-Rao bound of a delay.
        """
        return 1 / (2 * np.pi * self.bandwidth_per_m * np.sqrt(2 * self.snr))

    @property
    def phase_sd_rad(self) -> NDArray[np.float64]:
        """Standard deviation of `phase_rad` due to noise, 1/sqrt(2 snr), [channels, points]."""
        return 1 / np.sqrt(2 * self.snr)


@dataclass(frozen=True, eq=False)
class Reader:
    """Range lines that are read around expected ranges.

    Attributes
    ----------
    readout : Readout
    cell_m : float
        Range resolution.
    cycles_per_m : float
        Phase per metre of range at the middle of the band.
    """

    readout: Readout
    cell_m: float
    cycles_per_m: float

    @classmethod
    def of(cls, readout: Readout) -> Reader:
        """Return the reader of some lines."""
        cycles_per_m = float(cycles_per_m_at(readout.lines, readout.spectrum.centre))
        return cls(readout, range_cell_m(readout), cycles_per_m)

    def noise(
        self, channels: NDArray[np.int64], range_m: NDArray[np.float64], half_m: float
    ) -> NDArray[np.float64]:
        """Return the mean power of the noise around expected ranges, [points].

        It is estimated from the median over channels and ranges, which a response in a few range
        cells hardly changes.
        """
        power = np.abs(self._read(channels, range_m, self._offsets_m(half_m))) ** 2
        power[power == 0] = np.nan  # beyond the ends of the lines
        with np.errstate(all="ignore"):
            median = np.nanmedian(power, axis=(0, 2)) if np.isfinite(power).any() else 0.0
        # The median of an exponential distribution is log 2 times its mean.
        mean = np.nan_to_num(np.broadcast_to(median, range_m.shape[1:])) / math.log(2)
        return np.asarray(mean, np.float64)

    def errors_m(
        self,
        channels: NDArray[np.int64],
        range_m: NDArray[np.float64],
        half_m: float,
        blur: int,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the offset of the largest echo from each expected range, and its power.

        Both are [channels, points]. Powers are means over `blur` neighbouring channels: a response
        moves little between them, and noise averages out.
        """
        offsets_m = self._offsets_m(half_m)
        power = np.abs(self._read(channels, range_m, offsets_m)) ** 2
        power = uniform_filter1d(power, max(blur, 1), axis=0, mode="nearest")
        return offsets_m[np.argmax(power, axis=2)], power.max(axis=2)

    def responses(
        self, range_m: NDArray[np.float64], noise: NDArray[np.float64], half_m: float
    ) -> Responses:
        """Return the responses of all channels within `half_m` of the expected ranges."""
        channels = np.arange(len(range_m))
        offsets_m = self._offsets_m(half_m)
        error_m, peak, phase, bend = (np.empty(range_m.shape) for _ in range(4))
        at_once = max(_READ_AT_ONCE // (range_m.shape[1] * len(offsets_m)), 1)
        for first in range(0, len(range_m), at_once):
            some = slice(first, first + at_once)
            values = self._read(channels[some], range_m[some], offsets_m)
            phase[some] = np.angle(values[..., len(offsets_m) // 2])
            error_m[some], peak[some], bend[some] = _vertex(np.abs(values) ** 2, offsets_m)
        snr = peak / np.maximum(noise, 1e-300)
        large = np.quantile(peak, _LARGE, axis=0)
        seen = (snr >= LEAST_SNR) & (peak >= _LEAST_AMPLITUDE**2 * large) & (bend > 0)
        # At a distance r from its peak, |p|^2 is 1 - (2 pi b)^2 r^2.
        total_peak = np.sum(np.where(seen, peak, 0), axis=0)
        mean_bend = np.sum(np.where(seen, bend, 0), axis=0) / np.maximum(total_peak, 1e-300)
        least = 0.01 / self.cell_m  # cycles per metre, far below any band of this resolution
        bandwidth = np.maximum(np.sqrt(mean_bend) / (2 * np.pi), least)
        return Responses(error_m, phase, np.clip(snr, 1e-3, _MOST_SNR), seen, bandwidth)

    def _offsets_m(self, half_m: float) -> NDArray[np.float64]:
        """Return offsets from -half_m to half_m, with 0 in the middle."""
        count = max(math.ceil(half_m / self.cell_m * _STEPS), 2)
        return self.cell_m / _STEPS * np.arange(-count, count + 1, dtype=np.float64)

    def _read(
        self,
        channels: NDArray[np.int64],
        range_m: NDArray[np.float64],
        offsets_m: NDArray[np.float64],
    ) -> NDArray[np.complex128]:
        """Return values around each range, with the path's phase removed.

        They are [channels, points, offsets].
        """
        at_m = (range_m[..., None] + offsets_m).reshape(len(channels), -1)
        turns = self.readout.lines.carrier_cycles_per_m * at_m
        values = self.readout.read(channels, at_m) * np.exp(2j * np.pi * (turns - np.rint(turns)))
        return values.reshape(*range_m.shape, len(offsets_m))


def _vertex(
    power: NDArray[np.float64], offsets_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the offset of the largest power, that power, and its decrease per m^2.

    They follow from a parabola through three points. The decrease is 0 for a peak at either end of
    the offsets, which belongs to an echo outside of them.
    """
    best = np.argmax(power, axis=-1)
    inside = np.clip(best, 1, len(offsets_m) - 2)[..., None]
    before, at, after = (
        np.take_along_axis(power, inside + step, axis=-1)[..., 0] for step in (-1, 0, 1)
    )
    step_m = offsets_m[1] - offsets_m[0]
    bend = np.maximum(2 * at - before - after, 1e-300)
    shift = np.clip((after - before) / (2 * bend), -1, 1)
    peak = at + (after - before) * shift / 4
    fall = np.where(inside[..., 0] == best, bend / (2 * step_m**2), 0.0)
    return offsets_m[inside[..., 0]] + shift * step_m, peak, fall
