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
    power. That there are only some adds to correlations as if phases were random, which is taken
    out; N is at most a third too large for that, up to 60.
    """
    if not energy.any():
        return float(_POINTS)
    points_m = grid.spread(max(round(_POINTS ** (1 / len(grid.shape))), 1))
    number = np.arange(_TERMS)
    held = np.cumsum(energy / energy.max())
    some = np.searchsorted(held, (number + 0.5) / _TERMS * held[-1])
    away = 2 * (number * GOLDEN % 1) - 1
    share = np.cumsum(spectrum.share)
    frequency = np.copysign(np.interp(np.abs(away), share / share[-1], spectrum.frequency), away)
    cycles_per_m = cycles_per_m_at(lines, spectrum.centre + frequency)
    turns = cycles_per_m * pairwise_range_m(points_m, *antennas_of(lines, some))
    terms = np.exp(2j * np.pi * (turns - np.rint(turns)))
    if beam is not None and along is not None:
        sine = sines(points_m, lines.phase_centres_m[some], along[some]).T
        terms *= beam.weights(sine, wavelength_m(lines))
    power_of_terms = np.sum(np.abs(terms) ** 2, axis=0)
    total = float(power_of_terms.sum())
    if not total:
        return float(_POINTS)
    terms = (terms / np.sqrt(total)).astype(np.complex64)
    alike = float(np.sum(np.abs(terms @ terms.conj().T) ** 2))
    by_few = float(np.sum((power_of_terms / total) ** 2))
    return 1 / float(np.clip((alike - by_few) / (1 - by_few), 1 / _POINTS, 1.0))
