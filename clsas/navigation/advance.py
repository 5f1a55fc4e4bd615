"""Advance of an array between two pings, from the coherence of neighbouring channels."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from clsas.navigation.correlation import Correlator
from clsas.navigation.echoes import Window
from clsas.navigation.pair_geometry import PairGeometry

_LEAST_SQUARE = 1e-4  # lower limit of squared coherences
# Squared coherence of neighbouring channels, over that of the pairs, below which no advance is
# measured: side lobes would decide.
_LEAST_SHARE = 0.05


def surge(
    correlator: Correlator, geometry: PairGeometry, spacing_m: float, half_width: float
) -> tuple[float, float]:
    """Return how far an array advances beyond its positions, and the standard deviation, metres.

    Channels are correlated with the ones that share their phase centre, and with their neighbours
    behind and ahead, which are `spacing_m` away. A parabola through the logarithms of the three
    coherences peaks where the channels of the second ping really are, because the coherence of a
    beam is nearly Gaussian around its peak. Channels of one ping share speckle with their
    neighbours on both sides alike, which hardly affects the comparison.
    """
    windows, aligned = correlator.windows(geometry, half_width)
    pairs, lines = geometry.pairs, geometry.lines
    order = np.argsort(pairs.along_m)
    steps_m = np.diff(pairs.along_m[order])
    adjacent = np.flatnonzero(np.abs(steps_m - spacing_m) < 0.5 * spacing_m)
    if not len(adjacent):
        return 0.0, spacing_m  # too few channels overlap
    apart_m = 0.0
    if aligned is None:
        between_m = lines.phase_centres_m[pairs.second] - lines.phase_centres_m[pairs.first]
        apart_m = float(np.mean(between_m @ geometry.forward))
    behind, ahead = order[adjacent], order[adjacent + 1]
    samples = correlator.independent
    squares = np.array(
        [
            _mean_square(windows, first, second, samples)
            for first, second in ((ahead, behind), (order, order), (behind, ahead))
        ]
    )
    if squares[1] < max(squares[0], squares[2]):
        return math.copysign(spacing_m, squares[0] - squares[2]) - apart_m, spacing_m
    before, at, after = 0.5 * np.log(squares)
    bend = before - 2 * at + after
    if bend >= 0 or min(squares[0], squares[2]) < _LEAST_SHARE * squares[1]:
        return 0.0, spacing_m  # neighbours in sparse arrays have no speckle in common
    count = float(samples.sum()) * len(adjacent)
    if aligned is not None:
        shared = aligned.phase_correlation(math.sqrt(squares[1]))
        count /= float(np.mean(np.sum(shared, axis=0)))
    variance = (1 - squares[1]) / (2 * count) * (1 / squares[0] + 1 / squares[2])
    deviation_m = spacing_m * 0.5 * math.sqrt(variance) / -bend
    return -spacing_m * 0.5 * (before - after) / bend - apart_m, deviation_m


def _mean_square(
    windows: list[Window],
    first: NDArray[np.int64],
    second: NDArray[np.int64],
    samples: NDArray[np.float64],
) -> float:
    """Return the mean squared coherence of some channels of the first ping with some of the second.

    `samples` is the number of independent samples in each window.
    """
    squares = []
    for (one, other), count in zip(windows, samples, strict=True):
        product = np.abs(np.sum(one[first] * other[second].conj(), axis=1)) ** 2
        energy = [
            np.sum(np.abs(one[first]) ** 2, axis=1),
            np.sum(np.abs(other[second]) ** 2, axis=1),
        ]
        # Noise alone has a squared coherence of one over the number of samples.
        squares.append(np.mean(product / np.maximum(energy[0] * energy[1], 1e-300)) - 1 / count)
    return float(np.clip(np.average(squares, weights=samples), _LEAST_SQUARE, 1 - 1e-9))
