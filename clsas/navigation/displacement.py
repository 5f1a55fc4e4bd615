"""Displacement of an array between two pings, from the correlation of pairs of channels.

The envelope of the correlation determines the displacement to within a wavelength, and a straight
line through the phases along the array determines sway and yaw precisely. The coherence of
neighbouring channels determines the advance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.navigation.checks import parabola_peak
from clsas.navigation.correlation import Correlation, Correlator, Window
from clsas.navigation.overlap import PairGeometry

_YAWS = np.linspace(-0.2, 0.2, 81)  # yaws between pings that the first pass tries, rad
_FINE = 16  # points per sample at which the peak of the envelope is searched
# Standard deviation of yaw over that for independent pairs. With 1, `scripts/bench navigation` has
# 89 to 94 % of the errors within the 95 % intervals.
_SHARED = 1.1
# Phase error of a pair by filters and interpolation, a choice. Without it, sway errors of coarse
# arrays over even speckle without noise exceed three times the reported standard deviation.
_EXACT_RAD = 2e-3
_BLOCK_CELLS = 8.0  # independent samples in a block: neighbouring blocks share few echoes

_LEAST_SQUARE = 1e-4  # lower limit of squared coherences
# Squared coherence of neighbouring channels, over that of the pairs, below which no advance is
# measured: side lobes would decide.
_LEAST_SHARE = 0.05


@dataclass(frozen=True)
class Displacement:
    """Displacement of an array between two pings, relative to its navigation.

    Attributes
    ----------
    sway_m, yaw_rad : float
        Displacement to port at the middle of the overlap, and turn from forward to port.
    covariance : float64 [2, 2]
        Covariance of sway and yaw.
    coherence : float64 [windows]
        Mean over the pairs.
    misfit : float
        Mean square of the residual phases over the variance that their coherence predicts. The
        expectation is 1.
    scatter : float64 [blocks]
        Contributions of the echoes in each block of range to the yaw, or to the sway if yaw is not
        measured, relative to the fit. Blocks are parts of the windows.
    echoes : float
        Number of independent samples that contain echoes.
    lasting : float
        Share of the variance that is due to having fewer echoes than speckle has. This part lasts
        from ping to ping.
    """

    sway_m: float
    yaw_rad: float
    covariance: NDArray[np.float64]
    coherence: NDArray[np.float64]
    misfit: float
    scatter: NDArray[np.float64]
    echoes: float
    lasting: float


def displacement(found: Correlation, *, first: bool, yaw: bool) -> Displacement:
    """Return the displacement that best explains a correlation.

    Parameters
    ----------
    found : Correlation
    first : bool
        Whether to try yaws of up to 0.2 rad, or up to the largest one that is unambiguous for the
        spacing of the channels.
    yaw : bool
        Whether to measure yaw. If not, the line has no slope.
    """
    aligned = found.aligned
    turns = 2 * np.pi * found.cycles_per_m * found.sensitivity
    along_m = found.pairs.along_m[:, None]
    steer = turns * along_m

    # The yaw that maximises the power of the pairs' sum, and the peak of its envelope over the
    # lags, determine the displacement to within a wavelength.
    slope = _coarse_yaw(found, steer) if first and yaw else 0.0
    summed = np.einsum("kwm,kw->wm", found.values, np.exp(1j * steer * slope))
    sensitivity = np.mean(found.sensitivity)
    sway_m = -_peak_m(summed, found.lags_m) / float(sensitivity)
    lag = int(np.argmin(np.abs(found.lags_m + sway_m * sensitivity)))

    # Phases relative to that are unwrapped about their mean. The mean comes first, and as a sum of
    # complex values, because single phases may be anywhere.
    relative = found.values[:, :, lag] * np.exp(1j * turns * (sway_m + slope * along_m))
    mean = np.angle(np.sum(relative))
    phase = np.angle(np.exp(1j * (np.angle(relative) - mean))) + mean

    # After alignment, each direction keeps a small phase of its own. Over speckle, these phases
    # lower the coherence of the pings and average out like noise. A few echoes come from few
    # directions: they stay coherent, and the mean over an even seabed does not describe them.
    coherence = np.sqrt(np.mean(found.coherence[:, :, lag] ** 2, axis=0))
    of_few = np.zeros_like(found.echoes)
    if aligned is not None:
        square = aligned.coherence**2
        fewer = 1 / np.clip(found.echoes, 1.0, found.independent) - 1 / found.independent
        of_few = (1 - square) / (2 * square) * fewer
    variance = _phase_variance(coherence, found.independent) + of_few
    lasting = float(np.average(of_few / variance, weights=1 / variance))

    # A straight line along the array is fitted by weighted least squares. Its unknowns are sway
    # and, if it is measured, yaw. `gain` is their change per phase.
    design = np.stack([-turns, -steer] if yaw else [-turns], axis=-1)
    inverse = np.linalg.inv(np.einsum("w,kwa,kwb->ab", 1 / variance, design, design))
    solution = inverse @ np.einsum("w,kwa,kw->a", 1 / variance, design, phase)
    residual = phase - design @ solution
    gain = np.einsum("ab,kwb,w->akw", inverse, design, 1 / variance)

    # Filtered channels share errors. `spread` is the covariance of the right-hand side.
    spread = np.zeros_like(inverse)
    for window, each in enumerate(coherence):
        shared = np.eye(len(design)) if aligned is None else aligned.phase_correlation(each)
        spread += design[:, window].T @ shared @ design[:, window] / variance[window]
    expected = phase.size - float(np.trace(inverse @ spread))
    scale = [1.0, _SHARED][: len(solution)]
    covariance = inverse @ spread @ inverse * np.outer(scale, scale)
    # More windows do not make the model of the array more exact.
    level = design.mean(axis=1)
    covariance += _EXACT_RAD**2 * np.linalg.inv(level.T @ level)
    if aligned is not None:
        # If there are few echoes, all of them may come from the middle of the beam.
        apart = np.einsum("akw,k->a", gain, aligned.middle_rad)
        covariance += lasting * np.outer(apart, apart)
    of_both = np.zeros((2, 2))
    of_both[: len(solution), : len(solution)] = covariance
    return Displacement(
        sway_m=sway_m + float(solution[0]),
        yaw_rad=slope + (float(solution[1]) if yaw else 0.0),
        covariance=of_both,
        coherence=coherence,
        misfit=float(np.sum(residual**2 / variance) / max(expected, 1.0)),
        scatter=_scatter(found, lag, phase - residual, gain[-1]),
        echoes=float(found.echoes.sum()),
        lasting=lasting,
    )


def _coarse_yaw(found: Correlation, steer: NDArray[np.float64]) -> float:
    """Return the yaw that maximises the power of the pairs' sum, `steer` being phase per yaw.

    It is tried up to where phases of neighbouring pairs differ by half a cycle. Larger yaws produce
    the same phases as smaller ones, like grating lobes.
    """
    most = 0.5 / max(abs(found.cycles_per_m) * found.pairs.spacing_m, 1e-9)
    yaws = _YAWS[np.abs(_YAWS) <= most]
    power = [
        np.sum(np.abs(np.einsum("kwm,kw->wm", found.values, np.exp(1j * steer * each))) ** 2)
        for each in yaws
    ]
    return float(yaws[int(np.argmax(power))])


def _peak_m(summed: NDArray[np.complex128], lags_m: NDArray[np.float64]) -> float:
    """Return the lag of the peak of the envelope, interpolated between samples."""
    step_m = lags_m[1] - lags_m[0]
    peak = int(np.argmax(np.sum(np.abs(summed) ** 2, axis=0)))
    fine_m = lags_m[peak] + step_m * np.linspace(-1, 1, 2 * _FINE + 1)
    between = np.sinc((fine_m[:, None] - lags_m) / step_m)
    power = np.sum(np.abs(summed @ between.T) ** 2, axis=0)
    best = int(np.clip(np.argmax(power), 1, len(power) - 2))
    shift = parabola_peak(*power[best - 1 : best + 2])
    return float(fine_m[best] + np.clip(shift, -1, 1) * step_m / _FINE)


def _phase_variance(
    coherence: NDArray[np.float64], independent: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the variance of the phase of a correlation, rad^2.

    It is (1 - g^2)/(2 L g^2) for a coherence g over L independent samples. `coherence` is the
    sample coherence, which is 1/sqrt(L) for noise alone.
    """
    square = np.clip((independent * coherence**2 - 1) / (independent - 1), 1e-6, 1 - 1e-9)
    return (1 - square) / (2 * independent * square)


def _scatter(
    found: Correlation, lag: int, fitted: NDArray[np.float64], gain: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the contribution of each block of range to a displacement, [blocks].

    The sum of the contributions is about 0. `fitted` are the phases of the fit and `gain` is the
    displacement per phase, both [pairs, windows].
    """
    shift = round(float(found.lags_m[lag] / (found.lags_m[1] - found.lags_m[0])))
    added = []
    for number, (window, count) in enumerate(zip(found.windows, found.independent, strict=True)):
        products = block_products(window, shift, float(count))
        turned = (products * np.exp(-1j * fitted[:, number, None])).imag
        total = np.maximum(np.abs(found.values[:, number, lag]), 1e-300)
        added.append((gain[:, number] / total) @ turned)
    return np.concatenate(added)


def block_products(window: Window, lag: int, independent: float) -> NDArray[np.complex128]:
    """Return the correlation of all pairs at a lag in samples, block by block, [pairs, blocks]."""
    one, other = window
    count = one.shape[1]
    blocks = max(math.floor(independent / _BLOCK_CELLS), 1)
    first, stop = max(0, -lag), min(count, count - lag)
    product = np.zeros_like(one)
    product[:, first:stop] = one[:, first:stop] * other[:, first + lag : stop + lag].conj()
    starts = np.arange(blocks) * count // blocks
    return np.asarray(np.add.reduceat(product, starts, axis=1))


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
    _, windows, aligned = correlator.windows(geometry, half_width)
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
