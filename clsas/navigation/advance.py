"""Advance of an array from a ping to the next, from the coherence of neighbouring channels."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from clsas.core.lines import RangeLines
from clsas.navigation.displacement import Correlator, Window
from clsas.navigation.overlap import Array, Overlap

_LEAST_SQUARE = 1e-4  # of a coherence
_LEAST_SHARE = 0.05  # of it that neighbours must have: with less, side lobes decide


def surge(
    correlator: Correlator, lines: RangeLines, array: Array, pairs: Overlap, directions: float
) -> tuple[float, float]:
    """Return how far an array advanced beyond what `lines` say, and its deviation, metres.

    Channels are correlated with those that share their phase centre, and with the next ones behind
    and ahead. A parabola through the logarithms of their coherence has its peak where the second
    ping's channels really are: near the peak the coherence of a beam is much like a Gaussian.
    Channels in one geometry share their speckle with the neighbours on either side, so that
    it hardly disturbs the comparison of both.
    """
    windows, frame, aligned = correlator.windows(lines, array, pairs, directions)
    order = np.argsort(pairs.along_m)
    steps_m = np.diff(pairs.along_m[order])
    spacing_m = array.spacing_m
    beside = np.flatnonzero(np.abs(steps_m - spacing_m) < 0.5 * spacing_m)
    if not len(beside):
        return 0.0, spacing_m  # too few channels overlap to tell
    apart_m = 0.0
    if aligned is None:
        between_m = lines.phase_centres_m[pairs.second] - lines.phase_centres_m[pairs.first]
        apart_m = float(np.mean(between_m @ frame.forward))
    here, there = order[beside], order[beside + 1]
    samples = correlator.independent
    squares = np.array(
        [
            _mean_square(windows, first, second, samples)
            for first, second in ((there, here), (order, order), (here, there))
        ]
    )
    if squares[1] < max(squares[0], squares[2]):
        return math.copysign(spacing_m, squares[0] - squares[2]) - apart_m, spacing_m
    before, at, after = 0.5 * np.log(squares)
    bend = before - 2 * at + after
    if bend >= 0 or min(squares[0], squares[2]) < _LEAST_SHARE * squares[1]:
        return 0.0, spacing_m  # neighbours of sparse arrays share no speckle
    count = float(samples.sum()) * len(beside)
    if aligned is not None:
        count /= float(np.mean(np.sum(aligned.shared(math.sqrt(squares[1])), axis=0)))
    variance = (1 - squares[1]) / (2 * count) * (1 / squares[0] + 1 / squares[2])
    deviation_m = spacing_m * 0.5 * math.sqrt(variance) / -bend
    return -spacing_m * 0.5 * (before - after) / bend - apart_m, deviation_m


def _mean_square(
    windows: list[Window],
    first: NDArray[np.int64],
    second: NDArray[np.int64],
    samples: NDArray[np.float64],
) -> float:
    """Return the mean square coherence of a ping's channels with some of the next ping's."""
    squares = []
    for (one, other), count in zip(windows, samples, strict=True):
        product = np.abs(np.sum(one[first] * other[second].conj(), axis=1)) ** 2
        energy = [
            np.sum(np.abs(one[first]) ** 2, axis=1),
            np.sum(np.abs(other[second]) ** 2, axis=1),
        ]
        # Noise alone has a square of one over the number of samples.
        squares.append(np.mean(product / np.maximum(energy[0] * energy[1], 1e-300)) - 1 / count)
    return float(np.clip(np.average(squares, weights=samples), _LEAST_SQUARE, 1 - 1e-9))
