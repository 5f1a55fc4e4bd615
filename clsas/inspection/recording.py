"""A recording and its measures, as the checks of an inspection receive them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.signal.windows import hann

from clsas.engine.data import decibels
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, banks_of, some_channels, wavelength_between_m
from clsas.engine.data.pings import Transmissions
from clsas.engine.device.device import Device
from clsas.engine.signal.echoes import Echoes
from clsas.engine.signal.spectrum import Spectrum, measure_spectrum
from clsas.inspection.phase_sign import phase_sign
from clsas.inspection.result import PhaseSign

LEAST_CLIPPED = 8
"""Fewest samples at its largest level that make a channel count as clipped. Echoes have one or
two."""
_SAME_LEVEL = 1e-5
"""Relative difference up to which two levels count as equal, to allow for rounding. Within 1e-3 of
the largest level, the beats of overlapping chirps have a dozen samples."""
_CLIPPED_OVER_NEXT = 5.0
"""Least ratio of the samples at a ceiling to those at the next lower level. Peaks of echoes have
ratios of 1 to 3."""
CONSTANT_DB = -40.0
"""Power of a constant relative to the echoes above which it is reported. In an image of N channels,
the power of a constant grows N times as much as that of echoes."""
_BESIDE = 8  # frequencies on either side of a constant that it is compared with
LEAST_COUNT = 4 * _BESIDE  # samples or pings in which a constant can be measured
_MAIN_LOBE = 2  # frequencies on either side of a constant that a Hann window fills
_SPIKE = 2.0  # least power of a constant relative to the largest beside it; speckle reaches 1.2
_EQUAL_RANGE = 1e-3  # steps by which the first ranges of pings may differ
_BLOCK = 1 << 22  # samples processed at a time


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording, its measures, and what is known of the image to come.

    Attributes
    ----------
    recorded : RangeLines or Echoes
        The data as given.
    lines : RangeLines
        The given lines, or the echoes after compression.
    grid, beam, element_length_m, device
        As for `inspect`.
    """

    recorded: RangeLines | Echoes
    lines: RangeLines
    grid: Grid | None
    beam: BeamWindow | None
    element_length_m: float | None
    device: Device | None

    @cached_property
    def pings(self) -> Transmissions:
        """Pings of the lines."""
        return Transmissions.of(self.lines.tx_m, self.lines.rx_m)

    @cached_property
    def moving(self) -> RangeLines:
        """Lines of the pings during which the platform advances, or all lines if it never does.

        A halt of hundreds of equal pings would outweigh the rest of the track.
        """
        advancing = self.pings.advancing()
        if not self.pings.usual_step_m or advancing.all():
            return self.lines
        return self.lines.select(self.pings.channels(advancing))

    @cached_property
    def moving_pings(self) -> Transmissions:
        """Pings of the moving lines."""
        return (
            self.pings
            if self.moving is self.lines
            else Transmissions.of(self.moving.tx_m, self.moving.rx_m)
        )

    @property
    def receivers(self) -> int | None:
        """Channels per ping if all pings have the same number, else None."""
        counts = self.pings.receivers
        return None if np.ptp(counts) else int(counts[0])

    @property
    def receivers_per_bank(self) -> int | None:
        """Channels per ping and bank if all pings have the same number, else None."""
        return None if self.receivers is None else self.receivers // self.lines.banks

    @cached_property
    def spectrum(self) -> Spectrum:
        """Mean power spectrum of the moving lines."""
        return measure_spectrum(self.moving)

    @property
    def rate_hz(self) -> float:
        """Sample rate of the lines."""
        return self.lines.sound_speed_m_s / (2 * self.lines.range_step_m)

    @property
    def band_hz(self) -> tuple[float, float]:
        """Lower and upper end of the occupied band."""
        middle_hz = self.lines.carrier_hz + self.spectrum.centre * self.rate_hz
        half_hz = self.rate_hz / max(self.spectrum.oversampling, 1.0) / 2
        return middle_hz - half_hz, middle_hz + half_hz

    @property
    def wavelength_m(self) -> float:
        """Wavelength at the mean magnitude of the frequencies of the band.

        That is the middle of the band unless it reaches below 0 Hz. The middle of such a band is
        arbitrary: it may be 0 Hz, where the wavelength is infinite.
        """
        return wavelength_between_m(self.lines, *self.band_hz)

    @cached_property
    def levels(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Power and clipped samples of every channel, [channels] each; see `levels_of`.

        They are those of the data as recorded: compression spreads clipped samples over a line.
        """
        is_echoes = isinstance(self.recorded, Echoes)
        return levels_of(self.recorded.samples, magnitudes=not is_echoes)

    @cached_property
    def background(self) -> float:
        """Share of the power that is the same in all moving pings.

        It is 0 if there are too few pings, or the lines of a receiver begin at different ranges.
        """
        lines, pings = self.moving, self.moving_pings
        if pings.count < LEAST_COUNT or np.ptp(pings.receivers):
            return 0.0
        shape = pings.count, int(pings.receivers[0])
        first_m = lines.first_range_m.reshape(shape)
        if np.ptp(first_m, axis=0).max() > _EQUAL_RANGE * lines.range_step_m:
            return 0.0
        samples = lines.samples.reshape(*shape, lines.length)
        some = some_channels(shape[1], 8)
        return float(np.mean([constant_share(samples[:, receiver], 0.0) for receiver in some]))

    @cached_property
    def sign(self) -> tuple[PhaseSign | None, str]:
        """Comparison of both signs of the phase; see `phase_sign`."""
        # Of the first bank, since those of several may cancel in an image.
        lines = self.moving.bank(banks_of(self.moving.bank_numbers)[0])
        if self.background > decibels.power(CONSTANT_DB):
            # It is equally bright in every ping, and would be taken for the brightest echoes.
            lines = lines.without_background("median", receivers=self.receivers_per_bank)
        cell_m = lines.range_step_m * max(self.spectrum.oversampling, 1.0)
        return phase_sign(lines, self.grid, self.wavelength_m, cell_m, self.device)


def levels_of(samples: NDArray, magnitudes: bool) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the power and the number of clipped samples of every channel.

    The power is the variance, relative to the squared magnitude of the largest sample of all.
    Clipped samples lie at the largest level of a channel; their number is 0 if it is no more than
    echoes have there. Real and imaginary parts may be clipped and, with `magnitudes`, magnitudes
    too.
    """
    scale = max(float(np.abs(block).max()) for block in _blocks(samples)) or 1.0
    precision = np.complex128 if np.iscomplexobj(samples) else np.float64
    power, clipped = [], []
    for block in _blocks(samples):
        scaled = block / np.float32(scale)
        if scaled.shape[1] == 1:  # a single sample has no variance
            scaled = np.concatenate([scaled, -scaled], axis=1)
        power.append(scaled.var(axis=1, dtype=precision).real)
        count = _clipped_samples(np.maximum(np.abs(scaled.real), np.abs(scaled.imag)))
        if magnitudes:
            count = np.maximum(count, _clipped_samples(np.abs(scaled)))
        clipped.append(count)
    return np.concatenate(power), np.concatenate(clipped)


def _blocks(samples: NDArray) -> Iterator[NDArray]:
    rows = max(1, _BLOCK // samples.shape[1])
    for first in range(0, len(samples), rows):
        yield samples[first : first + rows]


def _clipped_samples(level: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return how many samples of each channel lie at its largest level, or 0 without clipping."""
    largest = level.max(axis=1, keepdims=True)
    at_top = level >= (1 - _SAME_LEVEL) * largest
    counts = at_top.sum(axis=1) * (largest[:, 0] > 0)
    counts[counts < LEAST_CLIPPED] = 0
    for channel in np.flatnonzero(counts):
        lower = level[channel][~at_top[channel]]
        margin = _SAME_LEVEL * largest[channel, 0]
        beside = int((lower >= lower.max() - margin).sum()) if lower.size and lower.any() else 0
        if counts[channel] < _CLIPPED_OVER_NEXT * beside:
            counts[channel] = 0
    return counts


def constant_share(samples: NDArray, frequency: float) -> float:
    """Return the share of the power of columns at a single frequency, in cycles per sample.

    Echoes have power at this frequency as well, so only what exceeds the power at the frequencies
    beside it counts. The share is 0 unless the frequency stands out like a spectral line.
    """
    count = len(samples)
    window = hann(count, sym=False)
    offsets = np.arange(-_BESIDE, _BESIDE + 1)
    turns = np.exp(-2j * np.pi * np.outer(frequency + offsets / count, np.arange(count))) * window
    largest = float(np.abs(samples).max()) or 1.0
    power, total = np.zeros(len(offsets)), 0.0
    columns = max(1, _BLOCK // count)
    for first in range(0, samples.shape[1], columns):
        block = samples[:, first : first + columns] / np.float32(largest)
        power += (np.abs(turns.astype(np.complex64) @ block) ** 2).sum(axis=1, dtype=np.float64)
        total += float((np.abs(block) ** 2).sum(dtype=np.float64)) / count
    others = power[np.abs(offsets) > _MAIN_LOBE]
    beside, at = float(np.median(others)), float(power[_BESIDE])
    if not total or at <= _SPIKE * float(others.max()):
        return 0.0
    return (at - beside) / float(window.sum()) ** 2 / total
