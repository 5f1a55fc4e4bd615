"""Displacement of an array between two pings, from the correlation of pairs of channels.

The envelope of the correlation determines the displacement to within a wavelength, and a straight
line through the phases along the array determines sway and yaw precisely.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.navigation.correlation import Correlation
from clsas.navigation.directions import Alignment
from clsas.navigation.echoes import block_products, phase_variance
from clsas.navigation.peaks import parabola_peak

_YAWS = np.linspace(-0.2, 0.2, 81)  # yaws between pings that the first pass tries, rad
_FINE = 16  # points per sample at which the peak of the envelope is searched
# Standard deviation of yaw over that for independent pairs. With 1, `scripts/bench navigation` has
# 89 to 94 % of the errors within the 95 % intervals.
_SHARED = 1.1
# Phase error of a pair by filters and interpolation, a choice. Without it, sway errors of coarse
# arrays over even speckle without noise exceed three times the reported standard deviation.
_EXACT_RAD = 2e-3


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

    The peak of the envelope over the lags determines the displacement to within a wavelength. A
    straight line fitted to the phases along the array determines it precisely.

    Parameters
    ----------
    found : Correlation
    first : bool
        Whether to try yaws of up to 0.2 rad, or up to the largest one that is unambiguous for the
        spacing of the channels.
    yaw : bool
        Whether to measure yaw. If not, the line has no slope.
    """
    turns = 2 * np.pi * found.cycles_per_m * found.sensitivity
    along_m = found.pairs.along_m[:, None]
    steer = turns * along_m
    slope = _coarse_yaw(found, steer) if first and yaw else 0.0
    summed = np.einsum("kwm,kw->wm", found.values, np.exp(1j * steer * slope))
    sensitivity = np.mean(found.sensitivity)
    sway_m = -_peak_m(summed, found.lags_m) / float(sensitivity)
    lag = int(np.argmin(np.abs(found.lags_m + sway_m * sensitivity)))
    phase = _phases(found.values[:, :, lag], -turns * (sway_m + slope * along_m))
    coherence = np.sqrt(np.mean(found.coherence[:, :, lag] ** 2, axis=0))
    of_few = _variance_of_few_echoes(found)
    variance = phase_variance(coherence, found.independent) + of_few
    columns = [-turns, -steer] if yaw else [-turns]
    line = _Line.through(phase, variance, np.stack(columns, axis=-1))
    spread = line.spread(coherence, found.aligned)
    expected = phase.size - float(np.trace(line.inverse @ spread))
    lasting = float(np.average(of_few / variance, weights=1 / variance))
    covariance = np.zeros((2, 2))
    covariance[: len(columns), : len(columns)] = line.covariance(spread, lasting, found.aligned)
    return Displacement(
        sway_m=sway_m + float(line.solution[0]),
        yaw_rad=slope + (float(line.solution[1]) if yaw else 0.0),
        covariance=covariance,
        coherence=coherence,
        misfit=float(np.sum(line.residual**2 / variance) / max(expected, 1.0)),
        scatter=_scatter(found, lag, phase - line.residual, line.gain[-1]),
        echoes=float(found.echoes.sum()),
        lasting=lasting,
    )


@dataclass(frozen=True, eq=False)
class _Line:
    """Straight line fitted to phases along the array by weighted least squares.

    Attributes
    ----------
    design : float64 [pairs, windows, unknowns]
        Phase per metre of sway and, with two unknowns, per radian of yaw.
    variance : float64 [windows]
        Variances of the phases.
    inverse : float64 [unknowns, unknowns]
        Inverse of the normal matrix.
    solution : float64 [unknowns]
    residual : float64 [pairs, windows]
    """

    design: NDArray[np.float64]
    variance: NDArray[np.float64]
    inverse: NDArray[np.float64]
    solution: NDArray[np.float64]
    residual: NDArray[np.float64]

    @classmethod
    def through(
        cls,
        phase: NDArray[np.float64],
        variance: NDArray[np.float64],
        design: NDArray[np.float64],
    ) -> _Line:
        """Return the line through phases, [pairs, windows]."""
        inverse = np.linalg.inv(np.einsum("w,kwa,kwb->ab", 1 / variance, design, design))
        solution = inverse @ np.einsum("w,kwa,kw->a", 1 / variance, design, phase)
        return cls(design, variance, inverse, solution, phase - design @ solution)

    @property
    def gain(self) -> NDArray[np.float64]:
        """Change of the solution per phase, [unknowns, pairs, windows]."""
        return np.einsum("ab,kwb,w->akw", self.inverse, self.design, 1 / self.variance)

    def spread(
        self, coherence: NDArray[np.float64], aligned: Alignment | None
    ) -> NDArray[np.float64]:
        """Return the covariance of the right-hand side, with the errors that pairs share.

        `coherence` is [windows].
        """
        spread = np.zeros_like(self.inverse)
        for window, each in enumerate(coherence):
            shared = (
                np.eye(len(self.design)) if aligned is None else aligned.phase_correlation(each)
            )
            at = self.design[:, window]
            spread += at.T @ shared @ at / self.variance[window]
        return spread

    def covariance(
        self, spread: NDArray[np.float64], lasting: float, aligned: Alignment | None
    ) -> NDArray[np.float64]:
        """Return the covariance of the solution, [unknowns, unknowns]."""
        covariance = self.inverse @ spread @ self.inverse
        scale = [1.0, _SHARED][: len(covariance)]
        covariance *= np.outer(scale, scale)
        # More windows do not make the model of the array more exact.
        level = self.design.mean(axis=1)
        covariance += _EXACT_RAD**2 * np.linalg.inv(level.T @ level)
        if aligned is not None:
            # If there are few echoes, all of them may come from the middle of the beam.
            apart = np.einsum("akw,k->a", self.gain, aligned.middle_rad)
            covariance += lasting * np.outer(apart, apart)
        return covariance


def _coarse_yaw(found: Correlation, steer: NDArray[np.float64]) -> float:
    """Return the yaw that maximises the power of the pairs' sum, `steer` being phase per yaw."""
    yaws = _YAWS[np.abs(_YAWS) <= _unambiguous_yaw(found)]
    power = [
        np.sum(np.abs(np.einsum("kwm,kw->wm", found.values, np.exp(1j * steer * each))) ** 2)
        for each in yaws
    ]
    return float(yaws[int(np.argmax(power))])


def _unambiguous_yaw(found: Correlation) -> float:
    """Return the yaw up to which phases of neighbouring pairs differ by less than half a cycle.

    Larger yaws produce the same phases as smaller ones, like grating lobes.
    """
    return 0.5 / max(abs(found.cycles_per_m) * found.pairs.spacing_m, 1e-9)


def _phases(values: NDArray[np.complex128], model: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the phases of correlations relative to a model, unwrapped about their mean."""
    relative = values * np.exp(-1j * model)
    # The mean comes first, and as a sum of complex values, because single phases may be anywhere.
    mean = np.angle(np.sum(relative))
    return np.angle(np.exp(1j * (np.angle(relative) - mean))) + mean


def _variance_of_few_echoes(found: Correlation) -> NDArray[np.float64]:
    """Return the phase variance that is due to having fewer echoes than speckle has, [windows].

    After alignment, each direction keeps a small phase of its own. Over speckle, these phases lower
    the coherence of the pings and average out like noise. A few echoes come from few directions:
    they stay coherent, and the mean over an even seabed does not describe them.
    """
    if found.aligned is None:
        return np.zeros_like(found.echoes)
    square = found.aligned.coherence**2
    fewer = 1 / np.clip(found.echoes, 1.0, found.independent) - 1 / found.independent
    return np.asarray((1 - square) / (2 * square) * fewer)


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
