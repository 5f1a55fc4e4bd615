"""Samples of range lines that an image needs: the others need not be upsampled.

A line that is cut off abruptly would ring. Where samples are left out, the line therefore continues
beyond those that pixels need, and fades so slowly that its spectrum stays within the sampled band.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from clsas.engine.data.grid import Grid, bounding_box
from clsas.engine.data.lines import RangeLines, reached_m
from clsas.engine.signal.spectrum import Spectrum

_BELOW_DB = 10.0  # error of a fade below the allowed one; measured errors do not change
_WORTH = 0.9  # of the samples of a line; for fewer left out, a copy of the lines does not pay


@dataclass(frozen=True, eq=False)
class Crop:
    """Samples of each line that are kept.

    Attributes
    ----------
    first : int64 [channels]
        First sample that is kept.
    length : int
        Number of samples that are kept.
    of_length : int
        Number of samples of the whole lines.
    fade : float32 [n]
        Factors of the first samples where a line is cut, ascending; reversed, those of the last.
    """

    first: NDArray[np.int64]
    length: int
    of_length: int
    fade: NDArray[np.float32]

    @classmethod
    def whole(cls, lines: RangeLines) -> Crop:
        """Return the crop that keeps all samples."""
        first = np.zeros(lines.channels, np.int64)
        return cls(first, lines.length, lines.length, np.zeros(0, np.float32))

    @classmethod
    def to_grid(cls, lines: RangeLines, grid: Grid, spectrum: Spectrum, error_db: float) -> Crop:
        """Return the crop that keeps what a grid needs, with an error far below `error_db`.

        Notes
        -----
        The step response of a Kaiser window of n samples has its transition within
        d = (A - 8) / (14.36 n) cycles per sample, beyond which its spectrum is A dB lower (Kaiser
        1974). Lines that fade by it do not alias if d is half the guard band.
        """
        attenuation_db = _BELOW_DB - error_db
        guard = 0.5 - 0.5 / spectrum.oversampling
        beta = 0.1102 * (attenuation_db - 8.7)
        samples = (attenuation_db - 8) / (14.36 * max(guard, 1 / lines.length))
        response = np.cumsum(np.kaiser(math.ceil(samples) + 1, beta))
        fade = (response[:-1] / response[-1]).astype(np.float32)

        near_m, far_m = reached_m(lines, *bounding_box(grid))
        near, far = (
            np.clip((each_m - lines.first_range_m) / lines.range_step_m, 0, lines.length - 1)
            for each_m in (near_m, far_m)
        )
        first = np.floor(near).astype(np.int64) - len(fade)
        length = int((np.ceil(far).astype(np.int64) + len(fade) + 1 - first).max())
        if length > _WORTH * lines.length:
            return cls.whole(lines)
        return cls(np.clip(first, 0, lines.length - length), length, lines.length, fade)

    def of(self, lines: RangeLines, channels: slice = slice(None)) -> RangeLines:
        """Return some of the lines, cropped."""
        if self.length == self.of_length:
            return lines.select(channels)
        first = self.first[channels]
        windows = sliding_window_view(lines.samples[channels], self.length, axis=1)
        samples = windows[np.arange(len(first)), first]
        begins, ends = first > 0, first < self.of_length - self.length
        samples[begins, : len(self.fade)] *= self.fade
        samples[ends, self.length - len(self.fade) :] *= self.fade[::-1]
        of_channels = {name: values[channels] for name, values in lines.per_channel.items()}
        of_channels["first_range_m"] = of_channels["first_range_m"] + first * lines.range_step_m
        return replace(lines, samples=samples, **of_channels)
