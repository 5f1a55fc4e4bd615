"""Scatter of an image's power about what is expected of it.

The power of an image of few resolution cells may by chance be far less than that of all channels
together, and errors far more: their ratio is that of two means over few independent values.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsas.core.decibels import power
from clsas.core.geometry import pairwise_range_m
from clsas.core.grid import Grid
from clsas.core.lines import GOLDEN, RangeLines, antennas_of, wavelength_m
from clsas.signal.spectrum import Spectrum, cycles_per_m_at
from clsas.sonar.beam import BeamWindow
from clsas.sonar.visibility import sines

_POINTS = 256  # sampled all over the grid: an image of more cells scatters by less than `_SPARE_DB`
_CHANNELS = 512  # sampled as often as they have power; a beam passes some of them
_TERMS = 256  # of the sums that pixels are; twice as many change nothing
_DEVIATIONS = 2.58  # of a normal distribution: 99.5 % of its values are smaller
_SPARE_DB = 1.0  # by which errors of most images fall short of their predictions


def scatter(
    lines: RangeLines,
    grid: Grid,
    spectrum: Spectrum,
    energy: NDArray[np.float64],
    beam: BeamWindow | None,
    along: NDArray[np.float64] | None,
) -> float:
    """Return a factor of relative error power that 99.5 % of images do not exceed.

    Parameters
    ----------
    lines, grid, spectrum
        What is imaged, and the spectrum of the lines.
    energy : float64 [channels]
        Energy of every line, in any unit.
    beam, along : BeamWindow and float64 [channels, 3], or None
        Weights of the channels, and the track's unit directions at these.

    Notes
    -----
    The logarithm of the ratio of two mean powers over N independent complex Gaussian values has
    about the variance 2/N.
    """
    count = independent_pixels(lines, grid, spectrum, energy, beam, along)
    factor = np.exp(_DEVIATIONS * np.sqrt(2 / count))
    return max(float(factor) / power(_SPARE_DB), 1.0)


def independent_pixels(
    lines: RangeLines,
    grid: Grid,
    spectrum: Spectrum,
    energy: NDArray[np.float64],
    beam: BeamWindow | None,
    along: NDArray[np.float64] | None,
) -> float:
    """Return how many pixels of an image of noise are independent, from 1 to `_POINTS`.

    Notes
    -----
    A pixel is a sum of many terms, each of a channel and a frequency. N is the inverse of the mean
    squared correlation of two pixels, over all pairs. Terms are sampled as often as they have
    power. As there are only some, they are correlated by 1/`_TERMS` even if phases are random: that
    is taken out, and makes N a third too large at most, up to 60.
    """
    if not energy.any():
        return float(_POINTS)
    points_m = grid.spread(max(round(_POINTS ** (1 / len(grid.shape))), 1))
    some = _quantiles(energy / energy.max(), _CHANNELS)
    weights = np.ones((len(points_m), len(some)))
    if beam is not None and along is not None:
        sine = sines(points_m, lines.phase_centres_m[some], along[some]).T
        weights = beam.weights(sine, wavelength_m(lines))
    seen = np.mean(weights**2, axis=0)
    if not seen.any():
        return float(_POINTS)
    chosen = _quantiles(seen, _TERMS)
    away = 2 * (np.arange(_TERMS) * GOLDEN % 1) - 1
    share = np.cumsum(spectrum.share)
    frequency = np.copysign(np.interp(np.abs(away), share / share[-1], spectrum.frequency), away)
    cycles_per_m = cycles_per_m_at(lines, spectrum.centre + frequency)
    turns = cycles_per_m * pairwise_range_m(points_m, *antennas_of(lines, some[chosen]))
    terms = np.exp(2j * np.pi * (turns - np.rint(turns)))
    terms *= weights[:, chosen] / np.sqrt(len(points_m) * _TERMS * seen[chosen])
    terms = terms.astype(np.complex64)
    alike = float(np.sum(np.abs(terms @ terms.conj().T) ** 2))
    by_few = 1 / _TERMS
    return 1 / float(np.clip((alike - by_few) / (1 - by_few), 1 / _POINTS, 1.0))


def _quantiles(weight: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Return `count` numbers, each as often as it has weight, in ascending order."""
    held = np.cumsum(weight)
    return np.searchsorted(held, (np.arange(count) + 0.5) / count * held[-1])
