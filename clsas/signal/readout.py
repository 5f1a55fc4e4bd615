"""Range lines read at any range, on the host."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.core.lines import RangeLines
from clsas.signal.interpolation import Interpolator, Resampling, choose, resampling
from clsas.signal.spectrum import measure_spectrum

ACCURACY_DB = -70.0
"""Default relative rms error of what is read."""


@dataclass(frozen=True, eq=False)
class Readout:
    """Lines, and how they are interpolated.

    Attributes
    ----------
    lines : RangeLines
    interpolator : Interpolator
    resampling : Resampling
    """

    lines: RangeLines
    interpolator: Interpolator
    resampling: Resampling

    @classmethod
    def of(cls, lines: RangeLines, accuracy_db: float = ACCURACY_DB) -> Readout:
        """Return lines with the fastest interpolator of an accuracy, dB."""
        spectrum = measure_spectrum(lines)
        interpolator = choose(spectrum, accuracy_db)
        return cls(lines, interpolator, resampling(lines.length, interpolator, spectrum))

    def read(
        self, channels: NDArray[np.int64], range_m: NDArray[np.float64]
    ) -> NDArray[np.complex64]:
        """Return the lines of some channels at ranges of their own, 0 beyond their ends.

        Parameters
        ----------
        channels : int64 [n]
        range_m : float64 [n, m]

        Returns
        -------
        complex64 [n, m]
            Values as the samples have them, without their carrier.
        """
        lines, resampling = self.lines, self.resampling
        upsampled = resampling.apply(lines.samples[channels])
        index = (range_m - lines.first_range_m[channels, None]) / lines.range_step_m
        within = (index >= 0) & (index <= lines.length - 1)
        index += resampling.lead
        position = index * resampling.ratio - resampling.first
        lower = np.floor(position)
        taps = self.interpolator.taps
        weights = self.interpolator.weights(position - lower - 0.5).astype(np.float32)
        first = lower.astype(np.int64) + 1 - taps // 2
        first = np.clip(first, 0, resampling.length - taps)
        total = np.zeros(range_m.shape, np.complex64)
        for tap in range(taps):
            total += weights[..., tap] * np.take_along_axis(upsampled, first + tap, axis=1)
        turns = resampling.centre_cycles_per_sample * index
        total *= np.exp(2j * np.pi * (turns - np.rint(turns)))
        total[~within] = 0
        return total
