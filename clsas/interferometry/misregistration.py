"""How far apart in range two banks show the same relief: a delay that their heights do not contain.

Heights absorb the phase between two banks in the middle of the band, whatever its cause. A delay
changes with frequency as heights do, and leaves nothing else. A phase phi that is the same at all
frequencies does not: on the relief that was found, the phase between the banks is
phi (1 - f/f0) at the frequency f, where f0 is the middle of the band. Its slope over two halves of
the band tells the phase apart from a delay.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from clsas.engine.data.lines import RangeLines, cycles_per_m_at, some_channels
from clsas.engine.signal.band_parts import sub_bands
from clsas.engine.signal.spectrum import measure_spectrum, middle_cycles_per_m
from clsas.interferometry.coherence import UNIFORM_SD_RAD, Window
from clsas.interferometry.pair import Pair
from clsas.interferometry.result import Heights

_LEAST_TILES = 3  # independent windows from which a deviation is estimated


class ConstantPhase(NamedTuple):
    """Phase of the second bank that is the same at all frequencies, and its deviation, radians."""

    phase_rad: float
    sd_rad: float


def constant_phase(pair: Pair, found: Heights) -> ConstantPhase:
    """Return the phase of b that no delay explains, from the slope of the phase over the band."""
    grid = found.image.grid
    sums, cycles_per_m = [], []
    for a, b in zip(sub_bands(pair.a, 2), sub_bands(pair.b, 2), strict=True):
        first, second = replace(pair, a=a, b=b).images(grid).pixels
        sums.append(_tile_sums(first, second, found))
        cycles_per_m.append(_mean_cycles_per_m(a))
    low, high = sums
    some = (low != 0) & (high != 0)
    if some.sum() < _LEAST_TILES:
        return ConstantPhase(0.0, np.inf)
    low, high = low[some], high[some]
    slope, sd = _phase_between(low, high)
    middle = middle_cycles_per_m(pair.a)
    per_slope = -middle / (cycles_per_m[1] - cycles_per_m[0])
    return ConstantPhase(slope * per_slope, sd * abs(per_slope))


def _tile_sums(
    first: NDArray[np.complex64], second: NDArray[np.complex64], found: Heights
) -> NDArray[np.complex128]:
    """Return the coherence of b and a in windows side by side, times their valid pixels, [n].

    Tiles of equal size count alike, however bright they are.
    """
    window = Window.of(found.image.grid, found.window_m)
    starts = [np.arange(0, n, side) for n, side in zip(found.mask.shape, window.sides, strict=True)]

    def summed(values: NDArray) -> NDArray:
        down = np.add.reduceat(np.where(found.mask, values, 0), starts[0], axis=0)
        return np.asarray(np.add.reduceat(down, starts[1], axis=1)).ravel()

    first, second = first.astype(np.complex128), second.astype(np.complex128)
    power = np.sqrt(summed(np.abs(first) ** 2) * summed(np.abs(second) ** 2))
    product = summed(second * first.conj()) * summed(np.ones(found.mask.shape))
    return np.divide(product, power, out=np.zeros_like(product), where=power > 0)


def _phase_between(
    low: NDArray[np.complex128], high: NDArray[np.complex128]
) -> tuple[float, float]:
    """Return the phase of the sum of `high` relative to that of `low`, and its deviation.

    The deviation is that of the jackknife over tiles (Efron and Stein 1981).
    """
    phase = float(np.angle(high.sum() * low.sum().conj()))
    left_out = np.angle((high.sum() - high) * (low.sum() - low).conj() * np.exp(-1j * phase))
    count = len(low)
    variance = (count - 1) / count * float(np.sum((left_out - left_out.mean()) ** 2))
    return phase, min(np.sqrt(variance), UNIFORM_SD_RAD)


def _mean_cycles_per_m(lines: RangeLines) -> float:
    """Return the two-way phase per metre of range, cycles, averaged over the power of lines."""
    some = lines.samples[some_channels(lines.channels)].astype(np.complex128)
    power = np.sum(np.abs(fft.fft(some)) ** 2, axis=0)
    centre = measure_spectrum(lines).centre
    distance = np.mod(fft.fftfreq(lines.length) - centre + 0.5, 1.0) - 0.5
    return float(cycles_per_m_at(lines, centre + float(np.average(distance, weights=power))))
