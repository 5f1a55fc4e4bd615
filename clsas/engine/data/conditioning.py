"""Conditioning of range lines: high-pass filter, tapered ends, background and weights.

These are the implementations of the methods of `RangeLines`, whose docstrings describe them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from clsas.engine.data import decibels, pings, validate
from clsas.engine.data.fourier import EDGE_PRODUCT, smooth_edge

if TYPE_CHECKING:
    from clsas.engine.data.lines import RangeLines

_BLOCK = 1 << 22  # complex128 samples of the channels that are filtered together
# Steps by which the first ranges of pings may differ. The resulting error is -50 dB.
_EQUAL_RANGE = 1e-3
STATISTICS = ("mean", "median")
DEAD_DB = -20.0
"""Power relative to the usual channel up to which a channel counts as dead. At -10 dB, channels at
the ends of a track would also count as dead, because targets leave the beam there."""


def are_dead(power: NDArray[np.float64], usual: NDArray[np.float64] | float) -> NDArray[np.bool_]:
    """Return a mask of the channels without a signal, from their power and the usual power."""
    return power <= usual * decibels.power(DEAD_DB)


def high_passed(lines: RangeLines, cutoff_hz: float, name: str = "cutoff_hz") -> RangeLines:
    """Remove frequencies below a cutoff; see `RangeLines.high_passed`.

    Messages call the cutoff by `name`.
    """
    rate = lines.sound_speed_m_s / (2 * lines.range_step_m)
    lowest = max(0.0, lines.carrier_hz - rate / 2)
    cutoff = validate.positive(name, cutoff_hz, "Hz")
    if cutoff <= lowest:
        raise ValueError(
            f"{name} must be finite and > {lowest:g} and < {lowest + rate:g} Hz, got {cutoff:g}: "
            f"lines on a carrier of {lines.carrier_hz:g} Hz contain nothing below {lowest:g} Hz"
        )
    validate.number(name, cutoff, "Hz", above=lowest, below=lowest + rate)
    if cutoff * lines.length < rate:
        raise ValueError(
            f"{name} must be at least one cycle per line, {rate / lines.length:g} Hz, "
            f"got {cutoff:g} Hz"
        )
    # The edge begins at half the cutoff, or at the lowest frequency of the band if that is higher.
    width = min(cutoff / 2, cutoff - lowest)
    padded = fft.next_fast_len(lines.length + int(np.ceil(EDGE_PRODUCT * rate / width)))
    validate.memory("the padding for cutoff_hz", 16 * padded)
    frequency = np.abs(lines.carrier_hz + fft.fftfreq(padded, 1 / rate))
    response = smooth_edge((cutoff - frequency) / width)
    samples = np.empty_like(lines.samples)
    rows = max(1, _BLOCK // padded)
    for first in range(0, lines.channels, rows):
        block = slice(first, first + rows)
        spectrum = fft.fft(lines.samples[block].astype(np.complex128), padded, workers=-1)
        filtered = fft.ifft(spectrum * response, workers=-1, overwrite_x=True)
        samples[block] = filtered[:, : lines.length]
    return replace(lines, samples=samples)


def tapered_ends(lines: RangeLines, length_m: float, name: str = "length_m") -> RangeLines:
    """Fade both ends of every line to zero; see `RangeLines.tapered_ends`.

    Messages call the length by `name`.
    """
    half = (lines.length - 1) * lines.range_step_m / 2
    length = validate.number(name, length_m, "m", above=0.0, most=half)
    from_end = np.arange(lines.length) * lines.range_step_m
    from_end = np.minimum(from_end, from_end[::-1])
    taper = np.sin(np.pi / 2 * np.minimum(from_end / length, 1)) ** 2
    return replace(lines, samples=lines.samples * taper.astype(np.float32))


def without_background(lines: RangeLines, statistic: str, receivers: int | None) -> RangeLines:
    """Subtract what all pings have in common; see `RangeLines.without_background`."""
    statistic = validate.one_of("statistic", statistic, STATISTICS)
    count = _receivers(lines) if receivers is None else validate.count("receivers", receivers)
    number, rest = divmod(lines.channels, count)
    if rest or number < 2:
        raise ValueError(
            "receivers must divide the channels into at least 2 pings, "
            f"got {count} receivers and {lines.channels} channels"
        )
    first_m = lines.first_range_m.reshape(number, count)
    spread_m = float(np.ptp(first_m, axis=0).max())
    if spread_m > _EQUAL_RANGE * lines.range_step_m:
        raise ValueError(
            "first_range_m of a receiver must be the same in all pings, because a background lies "
            f"at one delay; it differs by up to {spread_m:g} m"
        )
    samples = np.array(lines.samples).reshape(number, count, lines.length)
    for receiver in range(count):
        own = samples[:, receiver]
        if statistic == "mean":
            background = own.mean(axis=0, dtype=np.complex128)
        else:
            background = np.median(own.real, axis=0) + 1j * np.median(own.imag, axis=0)
        own -= background.astype(np.complex64)
    return replace(lines, samples=samples.reshape(lines.samples.shape))


def weighted(lines: RangeLines, weights: ArrayLike) -> RangeLines:
    """Multiply every channel by its weight; see `RangeLines.weighted`."""
    factors = validate.real_or_complex("weights", weights, np.complex64, (lines.channels,))
    with np.errstate(over="ignore", invalid="ignore"):
        samples = lines.samples * factors[:, None]
    if not np.isfinite(samples).all():
        largest = float(np.abs(factors).max())
        raise ValueError(
            f"weights must keep the samples within float32, up to {np.finfo(np.float32).max:.2g}, "
            f"got weights up to {largest:.3g}"
        )
    return replace(lines, samples=samples)


def _receivers(lines: RangeLines) -> int:
    """Return the channels per ping, which must be the same for all pings."""
    counts = pings.channels_per_ping(lines.ping_starts, lines.channels)
    if np.ptp(counts):
        raise ValueError(
            "receivers must be given, because pings (consecutive channels with one tx position) "
            f"have from {counts.min()} to {counts.max()} channels"
        )
    return int(counts[0])
