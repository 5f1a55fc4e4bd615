"""Interpolation of range lines at any range, on the host."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.lines import RangeLines
from clsas.engine.signal.interpolation import Interpolator, Resampling, choose, resampling
from clsas.engine.signal.spectrum import Spectrum, measure_spectrum

_Complex = TypeVar("_Complex", np.complex64, np.complex128)

ACCURACY_DB = -70.0
"""Relative rms error of the values by default, dB."""
# Upsampled lines of up to so many bytes are kept, because they are read many times. Larger ones are
# upsampled again for every reading.
_MOST_KEPT = 1 << 29
_UPSAMPLED_AT_ONCE = 256  # lines; bounds the memory of their FFTs


@dataclass(frozen=True, eq=False)
class Readout:
    """Range lines with the filter that interpolates them.

    Attributes
    ----------
    lines : RangeLines
    spectrum : Spectrum
    interpolator : Interpolator
    resampling : Resampling
    """

    lines: RangeLines
    spectrum: Spectrum
    interpolator: Interpolator
    resampling: Resampling

    @classmethod
    def of(cls, lines: RangeLines, accuracy_db: float = ACCURACY_DB) -> Readout:
        """Return the readout of lines with the fastest interpolator for an accuracy, dB."""
        spectrum = measure_spectrum(lines)
        interpolator = choose(spectrum, accuracy_db)
        of_filter = resampling(lines.length, interpolator, spectrum)
        return cls(lines, spectrum, interpolator, of_filter)

    def read(
        self, channels: NDArray[np.int64], range_m: NDArray[np.float64]
    ) -> NDArray[np.complex64]:
        """Return the lines of some channels, each at its own ranges; 0 beyond their ends.

        Parameters
        ----------
        channels : int64 [n]
        range_m : float64 [n, m]

        Returns
        -------
        complex64 [n, m]
            Interpolated samples. The carrier that was mixed out is not restored.
        """
        lines = self.lines
        index = (range_m - lines.first_range_m[channels, None]) / lines.range_step_m
        kept = self._upsampled
        some = self.resampling.apply(lines.samples[channels]) if kept is None else kept[channels]
        values = between(some, index, self.interpolator, self.resampling)
        values[(index < 0) | (index > lines.length - 1)] = 0
        return values

    @cached_property
    def _upsampled(self) -> NDArray[np.complex64] | None:
        """All lines, upsampled; None if they are too large to be kept."""
        lines = self.lines
        if 8 * lines.channels * self.resampling.length > _MOST_KEPT:
            return None
        kept = np.empty((lines.channels, self.resampling.length), np.complex64)
        for first in range(0, lines.channels, _UPSAMPLED_AT_ONCE):
            some = slice(first, first + _UPSAMPLED_AT_ONCE)
            kept[some] = self.resampling.apply(lines.samples[some])
        return kept


def interpolated(
    samples: NDArray[_Complex],
    index: NDArray[np.float64],
    interpolator: Interpolator,
    resampling: Resampling,
) -> NDArray[_Complex]:
    """Return lines between their samples, in the lines' own precision.

    Parameters
    ----------
    samples : complex [n, length]
    index : float64 [n, m]
        Positions in samples. Beyond its ends a line falls to zero within the taps of the filter.
    interpolator, resampling : Interpolator, Resampling
    """
    upsampled = cast("NDArray[_Complex]", resampling.apply(samples))
    return between(upsampled, index, interpolator, resampling)


def between(
    upsampled: NDArray[_Complex],
    index: NDArray[np.float64],
    interpolator: Interpolator,
    resampling: Resampling,
) -> NDArray[_Complex]:
    """Return lines between their samples, like `interpolated`, from lines already upsampled."""
    index = index + resampling.lead
    position = index * resampling.ratio - resampling.first
    lower = np.floor(position)
    weights = interpolator.weights(position - lower - 0.5).astype(upsampled.real.dtype)
    first = lower.astype(np.int64) + 1 - interpolator.taps // 2
    total = np.zeros(index.shape, upsampled.dtype)
    last = resampling.length - 1
    ends = first.min(initial=0) < 0 or first.max(initial=0) + interpolator.taps - 1 > last
    lines = resampling.length * np.arange(len(upsampled))[:, None]
    flat = np.ascontiguousarray(upsampled).reshape(-1)
    for tap in range(interpolator.taps):
        at = first + tap
        weight = weights[..., tap]
        if ends:
            weight = weight * ((at >= 0) & (at <= last))
            at = np.clip(at, 0, last)
        total += weight * flat[lines + at]
    if resampling.shift:
        turns = resampling.centre_cycles_per_sample * index
        total *= np.exp(2j * np.pi * (turns - np.rint(turns)))
    return total
