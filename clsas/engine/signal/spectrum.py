"""Spectra of range lines: the occupied band, and the weight of its frequencies in an image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from clsas.engine.data import validate
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, cycles_per_m_at, some_channels

MEASURED_CHANNELS = 256
"""Channels sampled for a spectrum. With fewer, filters depend a little on the order of channels."""
FEW_CHANNELS = 32
"""Channels sampled for a quick estimate of the power outside a band."""
NEEDED_OVERSAMPLING = 1.05
"""Sample rate over occupied bandwidth above which a guard band separates the edges of the band."""
# Bins of a spectrum. Half as many change measured errors by 0.2 dB, twice as many by 0.1 dB.
_FREQUENCIES = 128
_FLOOR_WIDTH = 1 / 64  # cycles per sample; the quietest part of this width is taken as noise
_FLOOR_MARGIN = 2.0  # scatter of the mean of a few periodograms
_NOISE_LEFT = 0.1  # share of the noise power in peaks above that margin
OUTSIDE = 0.1
"""Share of the allowed error power that may come from outside the nominal band."""
# Shares of the signal power that may lie outside the band, in tails of windows and finite lines.
_OUTSIDE_BAND = (1e-8, 1e-6, 1e-4)
_COMPETING = 0.5  # width of a gap over that of the guard band from which on they may be mistaken
_CLOSING = 1 / 300  # cycles per sample around the point opposite the centre, which may alias
_COHERENT_CYCLES = 2.0  # phase over the aperture up to which common parts add coherently
_COHERENT_POINTS = 3  # sampled along either side of the grid; twice as many change nothing
# Number of the strongest coherent frequencies that are evaluated; half as many change nothing.
_COHERENT_FREQUENCIES = 256
_FEW_FREQUENCIES = 4.0  # errors of a single frequency have up to 5 times the predicted power
_LOUDEST = 16  # loudest channels, sampled as well because clicks occur in few lines
_SUMMABLE = (1e-20, 1e38)  # energies that float32 squares and sums without loss
_RESOLVED = 1024  # samples that resolve the edges of a band; shorter lines are padded
_LINES_TOGETHER = 8  # transformed together, so that they stay in the processor's caches


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Mean power spectrum of a set of lines, relative to its centre.

    Attributes
    ----------
    centre : float
        Centre of the occupied band, cycles per sample, in [-0.5, 0.5).
    frequency : float64 [n]
        Distance from the centre, cycles per sample, 0 to 0.5.
    power : float64 [n]
        Weight of errors at that distance, on both sides together. It is the share of the power of
        the lines or of the image, whichever is larger. The sum is 1 to 2.
    oversampling : float
        Sample rate over the width of the occupied band.
    aliasing : float
        Relative error power from aliasing, if the band fills the whole sampled band.
    line_power : float64 [n] or None
        Share of the power of the lines, if `power` includes that of the image.
    """

    centre: float
    frequency: NDArray[np.float64]
    power: NDArray[np.float64]
    oversampling: float = np.inf
    aliasing: float = 0.0
    line_power: NDArray[np.float64] | None = None

    @property
    def scatter(self) -> float:
        """Factor by which measured error power may exceed its mean, 1 to 5.

        It is largest if the power lies at few frequencies, where errors do not average out.
        """
        return 1 + _FEW_FREQUENCIES * float(np.sum(self.share**2))

    @property
    def share(self) -> NDArray[np.float64]:
        """Share of the power of the lines at every distance, float64 [n]; the sum is 1."""
        return self.power if self.line_power is None else self.line_power

    @property
    def as_bytes(self) -> tuple[bytes, bytes]:
        """Frequencies and power as bytes, by which results are remembered."""
        return self.frequency.tobytes(), self.power.tobytes()

    @property
    def bin_width(self) -> float:
        """Distance between frequencies, cycles per sample."""
        return float(self.frequency[1] - self.frequency[0])

    def shifted(self, shares: NDArray[np.float64]) -> Spectrum:
        """Return the spectrum after parts of the lines are shifted in frequency.

        Frequencies of the result may exceed half a cycle per sample.

        Parameters
        ----------
        shares : float64 [2 n + 1]
            Share of the power that is shifted by -n, ..., n times `bin_width`.
        """
        most = len(shares) // 2

        def widened(power: NDArray[np.float64]) -> NDArray[np.float64]:
            both_sides = np.convolve(np.concatenate([power[::-1], power]) / 2, shares)
            below, above = np.split(both_sides, 2)
            return below[::-1] + above

        more = self.frequency[-1] + self.bin_width * np.arange(1, most + 1)
        return replace(
            self,
            frequency=np.concatenate([self.frequency, more]),
            power=widened(self.power),
            line_power=None if self.line_power is None else widened(self.line_power),
        )


def measure_spectrum(
    lines: RangeLines, grid: Grid | None = None, energy: NDArray[np.float64] | None = None
) -> Spectrum:
    """Return the mean power spectrum of lines, relative to the middle of their occupied band.

    With a grid, frequencies that add up coherently in its image get the weight that they have
    there, and a warning is issued if the band cannot be told from its complement. `energy` is the
    `line_energy` of the lines, if it is known.
    """
    frequency, power, faded = _mean_power(lines, MEASURED_CHANNELS, energy)
    centre, width, left_out, gap = _occupied_band(frequency, faded)
    if grid is not None and gap:
        validate.warn(
            f"the band of the lines wraps around half the sample rate, and has a gap of {gap:.0%} "
            f"of the sample rate or more beside a guard band of {1 - width:.0%}. Which of them "
            "lies within the band is not known: if it is the wider one, the image is in error. Mix "
            "the middle of the band to 0 Hz"
        )
    distance = _distance(frequency, centre)
    share = _histogram(distance, power)
    if grid is not None:
        power = np.maximum(power, _image_power(lines, grid, frequency, power))
    return Spectrum(
        centre,
        (np.arange(_FREQUENCIES) + 0.5) / (2 * _FREQUENCIES),
        _histogram(distance, power),
        oversampling=1 / width,
        aliasing=left_out + _aliasing(distance, faded, width),
        line_power=share,
    )


def _mean_power(
    lines: RangeLines, most_channels: int, energy: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return frequencies, cycles per sample, and power shares of the lines and of faded lines.

    Lines that are faded towards both ends show the band without the leakage of cut lines. Those of
    up to `most_channels` representative channels are used.
    """
    index, factor = representative_channels(lines, most_channels, energy)
    samples = lines.samples if len(index) == lines.channels else lines.samples[index]
    largest = _largest_part(samples) or samples.real.dtype.type(1)
    padding = 1 if samples.shape[1] >= _RESOLVED else 2
    length = scipy.fft.next_fast_len(max(padding * samples.shape[1], 4))
    power, faded = np.zeros(length), np.zeros(length)
    parts = samples.view(samples.real.dtype)
    blocks = -(-len(parts) // _LINES_TOGETHER)
    for block, scale in zip(
        np.array_split(parts, blocks), np.array_split(factor, blocks), strict=True
    ):
        amplitude = scipy.fft.fft((block / largest * scale[:, None]).view(samples.dtype), length)
        # Apply a Hann window over the part of the FFT in which the lines lie.
        ends = amplitude[:, -padding:], amplitude[:, :padding]
        around = np.concatenate([ends[0], amplitude, ends[1]], axis=1)
        windowed = (around[:, : -2 * padding] + around[:, 2 * padding :]) * np.float32(-0.5)
        windowed += amplitude
        power += _column_power(amplitude)
        faded += _column_power(windowed)
    frequency = scipy.fft.fftfreq(length)
    if not power.any():
        power[:] = 1.0
    if not faded.any():
        faded = power
    return frequency, power / power.sum(), faded / faded.sum()


def _column_power(amplitude: NDArray[np.complexfloating]) -> NDArray[np.float64]:
    """Return the power of every column; the amplitudes are overwritten."""
    parts = amplitude.view(amplitude.real.dtype)
    squares = np.multiply(parts, parts, out=parts).sum(axis=0)
    return squares.astype(np.float64).reshape(-1, 2).sum(axis=1)


def _occupied_band(
    frequency: NDArray[np.float64], power: NDArray[np.float64]
) -> tuple[float, float, float, float]:
    """Return middle and width of the occupied band, cycles per sample, and the power outside.

    Frequencies farther than half a cycle per sample from the middle alias. If half the sample rate
    is quiet, the carrier was mixed out, and the band extends from the lowest to the highest
    frequency, whatever gaps it has. Otherwise it is the narrowest arc of the frequency circle that
    contains nearly all power above the noise floor. The opposite point then lies in the middle of
    the guard band, whatever the shape of the spectrum. The share of power outside is the smallest
    one for which there is a guard band.

    The last result is the width of another gap that might as well be the guard band, else 0.
    """
    count = len(power)
    smoothed = uniform_filter1d(power, max(round(_FLOOR_WIDTH * count), 1), mode="wrap")
    signal = np.maximum(power - _FLOOR_MARGIN * smoothed.min(), 0.0)
    if not signal.any():  # white: no arc is better than another
        return float(np.angle(power @ np.exp(2j * np.pi * frequency)) / (2 * np.pi)), 0.5, 0.0, 0.0
    held = np.append(0.0, np.cumsum(np.tile(signal, 2)))
    least, *_, most = _OUTSIDE_BAND
    noise = np.clip(_NOISE_LEFT * count * smoothed.min(), least, most)
    starts, half = np.arange(count), (count + 1) // 2  # the lowest frequency has the index `half`
    gap, widest = 0.0, count / NEEDED_OVERSAMPLING
    for outside in (noise, *(each for each in _OUTSIDE_BAND if each > noise)):
        ends = np.searchsorted(held, held[:count] + (1 - outside) * held[count])
        bins = ends - starts
        mixed = (bins <= widest) & (ends <= np.where(starts < half, half, half + count))
        if mixed.any():
            first = int(np.argmin(np.where(mixed, bins, count)))
            break
        first = int(np.argmin(bins))
        if bins[first] <= widest:
            length = int(_COMPETING * (count - bins[first]))
            within = held[first + length : ends[first] + 1] - held[first : ends[first] + 1 - length]
            if length and within.size and within.min() <= outside * held[count]:
                gap = length / count
            break
    middle = (first + (bins[first] - 1) / 2) / count
    left_out = 1 - (held[ends[first]] - held[first]) / held[count] if outside > noise else 0.0
    return float((middle + 0.5) % 1.0 - 0.5), float(bins[first] / count), max(left_out, 0.0), gap


def _distance(frequency: NDArray[np.float64], centre: float) -> NDArray[np.float64]:
    """Return the distance of frequencies from a centre, cycles per sample, 0 to 0.5."""
    return np.abs((frequency - centre + 0.5) % 1.0 - 0.5)


def _histogram(distance: NDArray[np.float64], power: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the power at the `frequency` of a `Spectrum`, divided between the two nearest bins.

    With all power in the nearest bin, a filter could fit that frequency and miss a narrow spectral
    line beside it.
    """
    position = np.clip(2 * _FREQUENCIES * distance - 0.5, 0, _FREQUENCIES - 1)
    lower = np.minimum(position.astype(np.int64), _FREQUENCIES - 2)
    above = power * (position - lower)
    # NumPy's type stubs do not know that weights make the result float64.
    found: Any = np.bincount(lower, power - above, _FREQUENCIES)
    return found + np.bincount(lower + 1, above, _FREQUENCIES)


def _image_power(
    lines: RangeLines, grid: Grid, frequency: NDArray[np.float64], power: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the share of the power of an image that each frequency of the lines contributes.

    Signals near 0 Hz that are common to all channels, such as a constant offset in lines on their
    carrier, add up coherently in the whole image. Their power grows with the square of the number
    of channels, while that of echoes from all over the scene grows with the number. The gain is
    measured by coherent summation of some channels at some pixels, and extrapolated to all
    channels.
    """
    some = some_channels(lines.channels)
    if len(some) < 2:
        return power
    part = lines.select(some)
    range_m = pairwise_range_m(
        grid.spread(_COHERENT_POINTS),
        part.tx_m,
        part.rx_m,
        part.rx_velocity_m_s,
        part.sound_speed_m_s,
    )
    phase_per_m = cycles_per_m_at(lines, frequency)
    spread_m = float(np.ptp(range_m, axis=1).max())
    coherent = np.flatnonzero(np.abs(phase_per_m) * spread_m < _COHERENT_CYCLES)
    if not coherent.size or coherent.size == len(power):
        return power
    strongest = np.argsort(power[coherent])[::-1][:_COHERENT_FREQUENCIES]
    coherent = coherent[strongest]
    # Spectra of the lines with phases relative to range 0.
    scale = _largest_part(part.samples) or 1.0
    turns = np.exp(-2j * np.pi * np.outer(np.arange(lines.length), frequency[coherent]))
    scaled = (part.samples.view(np.float32) / scale).view(np.complex64)
    spectra = scaled @ turns
    spectra *= np.exp(-2j * np.pi * np.outer(part.first_range_m, phase_per_m[coherent]))
    spectra *= np.exp(2j * np.pi * part.carrier_cycles_per_m * part.first_range_m)[:, None]
    steering = np.exp(2j * np.pi * range_m[..., None] * phase_per_m[coherent])
    summed = np.mean(np.abs(np.einsum("pcf,cf->pf", steering, spectra)) ** 2, axis=0)
    alone = np.sum(np.abs(spectra) ** 2, axis=0)
    gain = np.divide(summed, alone, out=np.ones_like(summed), where=alone > 0) - 1
    gain = 1 + gain * (lines.channels - 1) / (len(some) - 1)
    found = power.copy()
    found[coherent] *= np.maximum(gain, 0.0)
    return found / found.sum()


def _aliasing(distance: NDArray[np.float64], power: NDArray[np.float64], width: float) -> float:
    """Return the error power due to aliasing of the power opposite the centre, in a full band.

    Aliased power is missing on one side and wrong on the other, so it counts twice. With a guard
    band there is only noise, equal on both sides.
    """
    if width <= 1 / NEEDED_OVERSAMPLING:
        return 0.0
    closing = max(_CLOSING, 1.5 / len(power))
    return 2 * float(power[distance > 0.5 - closing].sum())


def middle_cycles_per_m(lines: RangeLines) -> float:
    """Return the two-way phase per metre of range in the middle of the occupied band, cycles."""
    return float(cycles_per_m_at(lines, measure_spectrum(lines).centre))


def power_spectrum(lines: RangeLines) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return frequencies, cycles per sample, ascending in [-0.5, 0.5), and their power shares.

    Lines are faded towards both ends, which removes the leakage of cut lines.
    """
    frequency, _, power = _mean_power(lines, MEASURED_CHANNELS)
    order = np.argsort(frequency)
    return frequency[order], power[order]


def occupied_band(spectrum: Spectrum, outside: float) -> tuple[float, float]:
    """Return centre and half width of the band that contains all but a share of the power."""
    bins = np.searchsorted(np.cumsum(spectrum.share), 1 - outside)
    return spectrum.centre, float(min((bins + 1) / (2 * len(spectrum.power)), 0.5))


def power_outside(lines: RangeLines, centre: float, half_width: float, most_channels: int) -> float:
    """Return the share of the power of sampled lines outside a band, given in cycles per sample."""
    frequency, power, _ = _mean_power(lines, most_channels)
    return float(power[_distance(frequency, centre) > half_width].sum())


def shares_of_bins(
    position: NDArray[np.float64], share: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the shares in the bins -n, ..., n, [2 n + 1].

    A share that lies between two bins is divided between them.

    Parameters
    ----------
    position, share : float64 [...]
        Positions in bins, which may be fractions, and the share at each.
    """
    most = int(np.ceil(np.abs(position).max()))
    from_first = position.ravel() + most
    lower = np.minimum(from_first.astype(np.int64), max(2 * most - 1, 0))
    above = share.ravel() * (from_first - lower)
    count = 2 * most + 1
    found: Any = np.bincount(lower, share.ravel() - above, count)
    return (found + np.bincount(lower + 1, above, count + 1)[:count]) / share.sum()


def representative_channels(
    lines: RangeLines, most: int, energy: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return up to `most` evenly spread channels and the loudest ones, and a factor for each.

    Multiplied by these factors, the channels have the power of all. `energy` is the `line_energy`
    of the lines, if it is known.
    """
    some = some_channels(lines.channels, most)
    if len(some) == lines.channels:
        return some, np.ones(lines.channels, np.float32)
    energy = line_energy(lines.samples) if energy is None else energy
    loudest = np.argpartition(energy, -_LOUDEST)[-_LOUDEST:]
    even = np.setdiff1d(some, loudest)
    rest, held = energy.sum() - energy[loudest].sum(), energy[even].sum()
    weight = np.sqrt(max(rest, 0.0) / held) if held > 0 else 0.0
    factor = np.append(np.full(len(even), weight), np.ones(len(loudest))).astype(np.float32)
    return np.append(even, loudest), factor


def line_energy(samples: NDArray[np.complex64]) -> NDArray[np.float64]:
    """Return the energy of every line, scaled if squares would leave the range of float32."""
    parts = samples.view(np.float32)
    with np.errstate(over="ignore"):
        energy = np.einsum("ij,ij->i", parts, parts)
    if not _SUMMABLE[0] < energy.max() < _SUMMABLE[1]:
        parts = parts / (_largest_part(samples) or 1.0)
        energy = np.einsum("ij,ij->i", parts, parts)
    return energy.astype(np.float64)


def _largest_part(samples: NDArray[np.complex64]) -> np.float32:
    """Return the largest magnitude of a real or imaginary part. Amplitudes could overflow."""
    parts = samples.view(samples.real.dtype)
    return max(parts.max(initial=0.0), -parts.min(initial=0.0))
