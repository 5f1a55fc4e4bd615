"""Ranges at which channels receive known reflectors, by envelope and by phase."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from clsas.core.wavelengths import cycles_per_m_at
from clsas.signal.readout import Readout

LEAST_SNR = 10.0
"""Power of a response over the noise around it, from which on it is used: 10 dB. Noise alone
exceeds that once in 20 000 samples."""

_MOST_SNR = 1e7  # lines are read to -70 dB
_READ_AT_ONCE = 1 << 21  # samples: bounds the memory
_LEAST_AMPLITUDE = 0.1  # of a reflector's largest; side lobes of elements are weaker
_LARGE = 0.9  # quantile of amplitudes that counts as the largest: single lines may be louder
_STEPS = 8  # points per resolution cell at which the envelope is read


@dataclass(frozen=True, eq=False)
class Responses:
    """Responses of reflectors near the ranges where a model expects them.

    Attributes
    ----------
    error_m : float64 [channels, points]
        Range of the envelope's peak less the expected one.
    phase_rad : float64 [channels, points]
        Phase at the expected range: that of the reflector, less what the error turns it by.
    snr : float64 [channels, points]
        Power of the peak over the noise around it.
    seen : bool [channels, points]
        Whether the response stands out.
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
        """Standard deviation of `error_m` by noise, [channels, points].

        1/(2 pi b sqrt(2 snr)) for an rms bandwidth b, the Cramer-Rao bound of a delay.
        """
        return 1 / (2 * np.pi * self.bandwidth_per_m * np.sqrt(2 * self.snr))

    @property
    def phase_sd_rad(self) -> NDArray[np.float64]:
        """Standard deviation of `phase_rad` by noise, 1/sqrt(2 snr), [channels, points]."""
        return 1 / np.sqrt(2 * self.snr)


@dataclass(frozen=True, eq=False)
class Reader:
    """Lines that are read around expected ranges.

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
        lines, spectrum = readout.lines, readout.spectrum
        cell_m = lines.range_step_m * min(max(spectrum.oversampling, 1.0), 64.0)
        return cls(readout, cell_m, float(cycles_per_m_at(lines, spectrum.centre)))

    def noise(
        self, channels: NDArray[np.int64], range_m: NDArray[np.float64], half_m: float
    ) -> NDArray[np.float64]:
        """Return the mean power of noise around expected ranges, [points].

        The median over channels and ranges, which a response in a few cells hardly changes.
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
        """Return where the largest echo around expected ranges lies, and its power.

        Both are [channels, points]. Powers are means over `blur` neighbouring channels: a response
        moves little from one to the next, and noise averages out.
        """
        offsets_m = self._offsets_m(half_m)
        power = np.abs(self._read(channels, range_m, offsets_m)) ** 2
        power = uniform_filter1d(power, max(blur, 1), axis=0, mode="nearest")
        return offsets_m[np.argmax(power, axis=2)], power.max(axis=2)

    def responses(
        self, range_m: NDArray[np.float64], noise: NDArray[np.float64], half_m: float
    ) -> Responses:
        """Return the responses of all channels within `half_m` of expected ranges."""
        channels = np.arange(len(range_m))
        offsets_m = self._offsets_m(half_m)
        error_m, peak, phase = (np.empty(range_m.shape) for _ in range(3))
        bend = np.empty(range_m.shape)
        at_once = max(_READ_AT_ONCE // (range_m.shape[1] * len(offsets_m)), 1)
        for first in range(0, len(range_m), at_once):
            some = slice(first, first + at_once)
            values = self._read(channels[some], range_m[some], offsets_m)
            phase[some] = np.angle(values[..., len(offsets_m) // 2])
            error_m[some], peak[some], bend[some] = _vertex(np.abs(values) ** 2, offsets_m)
        snr = peak / np.maximum(noise, 1e-300)
        large = np.quantile(peak, _LARGE, axis=0)
        seen = (snr >= LEAST_SNR) & (peak >= _LEAST_AMPLITUDE**2 * large) & (bend > 0)
        # |p|^2 falls as 1 - (2 pi b)^2 r^2 from its peak.
        mean = np.sum(np.where(seen, bend, 0), axis=0) / np.maximum(
            np.sum(np.where(seen, peak, 0), axis=0), 1e-300
        )
        least = 0.01 / self.cell_m  # cycles per metre: far below a band of this resolution
        bandwidth = np.maximum(np.sqrt(mean) / (2 * np.pi), least)
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
        """Return values in phase with a point at every range, [channels, points, offsets]."""
        at_m = (range_m[..., None] + offsets_m).reshape(len(channels), -1)
        turns = self.readout.lines.carrier_cycles_per_m * at_m
        values = self.readout.read(channels, at_m) * np.exp(2j * np.pi * (turns - np.rint(turns)))
        return values.reshape(*range_m.shape, len(offsets_m))


def _vertex(
    power: NDArray[np.float64], offsets_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return where powers are largest, by a parabola; the power there, and its fall per m^2.

    A peak at an end of the offsets has no fall: it belongs to something outside.
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
