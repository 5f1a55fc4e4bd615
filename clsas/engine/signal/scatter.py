"""Scatter of the relative error of images with few resolution cells.

By chance, the power of such an image may be far below its expected value, and the power of its
errors far above. Their ratio is a ratio of two means over few independent values.
"""

from __future__ import annotations

import numpy as np
import scipy.special
from numpy.typing import NDArray

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import power
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import GOLDEN, RangeLines, antennas_of
from clsas.engine.data.visibility import sines
from clsas.engine.data.wavelengths import cycles_per_m_at, wavelength_m
from clsas.engine.signal.spectrum import Spectrum, representative_channels

_PIXELS = 256  # pixels sampled; with more independent pixels, the scatter is below `_SPARE_DB`
_CHANNELS = 256  # channels sampled in addition to the loudest; a beam passes some of them
_TERMS = (
    256  # terms sampled of the sums over channels and frequencies; twice as many change nothing
)
_KEPT = 0.995  # share of images that must meet their accuracy
_SPARE_DB = 1.0  # by which the errors of most images stay below their predictions
_LEAST_WEIGHT = 1e-3  # mean weight of channels down to which normalising beams amplify pixels


def scatter(independent: float) -> float:
    """Return the factor of relative error power that 99.5 % of noise images do not exceed.

    Parameters
    ----------
    independent : float
        Number of `independent_pixels` of the images.

    Notes
    -----
    The ratio of two mean powers over N independent complex Gaussian values has the F distribution
    of 2 N and 2 N degrees of freedom.
    """
    quantile = scipy.special.fdtri(2 * independent, 2 * independent, _KEPT)
    return max(float(quantile) / power(_SPARE_DB), 1.0)


def independent_pixels(
    lines: RangeLines,
    grid: Grid,
    spectrum: Spectrum,
    energy: NDArray[np.float64],
    beam: BeamWindow | None,
    along: NDArray[np.float64] | None,
) -> float:
    """Return the number of independent pixels of a noise image, from 1 to 256.

    Parameters
    ----------
    lines, grid, spectrum, beam, along
        As for `clsas.engine.signal.ambiguity.ambiguity`.
    energy : float64 [channels]
        Energy of every line, in any unit.

    Notes
    -----
    A pixel is a sum of many terms, one for every channel and frequency. N is the inverse of the
    mean squared correlation of two pixels, over all pairs. Terms are sampled in proportion to their
    power. Sums of so few terms are correlated by 1/`_TERMS` even if the phases are random. This is
    subtracted, which overestimates N by up to a third for N up to 60.
    """
    is_whole = grid.size <= _PIXELS
    number = np.arange(_PIXELS)
    points_m = grid.at(
        np.arange(grid.size) if is_whole else (number * GOLDEN % 1 * grid.size).astype(np.int64)
    )
    some, factor = representative_channels(lines, _CHANNELS, energy)
    weights = np.ones((len(points_m), len(some)))
    if beam is not None and along is not None:
        sine = sines(points_m, lines.phase_centres_m[some], along[some]).T
        weights = beam.weights(sine, wavelength_m(lines))
        if beam.normalise:
            weights /= np.maximum(weights.mean(axis=1, keepdims=True), _LEAST_WEIGHT)
    seen = np.mean(weights**2, axis=0)
    held = np.cumsum(seen * factor.astype(np.float64) ** 2 * (energy[some] / (energy.max() or 1.0)))
    if not held[-1]:
        return float(_PIXELS)
    term = np.arange(_TERMS)
    chosen = np.searchsorted(held, (term + 0.5) / _TERMS * held[-1])
    away = 2 * (term * GOLDEN % 1) - 1
    share = np.cumsum(spectrum.share)
    frequency = np.copysign(np.interp(np.abs(away), share / share[-1], spectrum.frequency), away)
    channels = some[chosen]
    range_m = pairwise_range_m(points_m, *antennas_of(lines, channels))
    turns = range_m * cycles_per_m_at(lines, spectrum.centre + frequency)
    terms = np.exp(2j * np.pi * (turns - np.rint(turns))).astype(np.complex64)
    sample = (range_m - lines.first_range_m[channels]) / lines.range_step_m
    is_reached = (sample > -1) & (sample < lines.length)
    terms *= is_reached * weights[:, chosen] / np.sqrt(_TERMS * seen[chosen])
    alike = np.abs(terms @ terms.conj().T) ** 2
    own = np.abs(terms).astype(np.float64) ** 2
    both = np.multiply.outer(own.sum(axis=1), own.sum(axis=1))
    if not is_whole:  # a pixel is not sampled twice
        np.fill_diagonal(alike, 0.0)
        np.fill_diagonal(both, 0.0)
    if not both.any():
        return float(_PIXELS)
    by_few = 1 / _TERMS
    mean = float(alike.sum(dtype=np.float64) / both.sum())
    return 1 / float(np.clip((mean - by_few) / (1 - by_few), 1 / _PIXELS, 1.0))
