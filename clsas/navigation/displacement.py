"""Displacement of an array between two pings, from pairs of channels that share a phase centre.

Both channels of a pair receive the same speckle. Each is read along a ray from the common phase
centre, at the ranges of its own transmitter and receiver to the points of the ray. This removes the
effects of range migration, separate transmitters and motion during flight. The difference that
remains is the change in range of an array that is displaced from its navigated position (Bellettini
and Pinto 2002).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from clsas.core.conditioning import are_dead
from clsas.core.lines import RangeLines
from clsas.navigation.directions import Alignment, alignment
from clsas.navigation.echoes import (
    Window,
    block_products,
    independent_echoes,
    phase_variance,
    strongest,
    without_highlights,
)
from clsas.navigation.overlap import Overlap
from clsas.navigation.pair_geometry import PairGeometry
from clsas.navigation.peaks import parabola_peak
from clsas.navigation.swath import Swath
from clsas.signal.readout import Readout
from clsas.signal.spectrum import cycles_per_m_at

_YAWS = np.linspace(-0.2, 0.2, 81)  # yaws between pings that the first pass tries, rad
_FINE = 16  # points per sample at which the peak of the envelope is searched
_FREQUENCIES = 9  # in either half of the band, each representing an equal share of the power
# Standard deviation of yaw over that for independent pairs. With 1, `scripts/bench navigation` has
# 89 to 94 % of the errors within the 95 % intervals.
_SHARED = 1.1
# Phase error of a pair by filters and interpolation, a choice. Without it, sway errors of coarse
# arrays over even speckle without noise exceed three times the reported standard deviation.
_EXACT_RAD = 2e-3
_SPECKLE_LAGS = 64  # samples over which speckle may be correlated in range


@dataclass(frozen=True, eq=False)
class Correlation:
    """Correlation of channel pairs at lags of range.

    Attributes
    ----------
    values : complex128 [pairs, windows, lags]
        Cross-correlation. Its phase is 0 if the array lies at its navigated position.
    coherence : float64 [pairs, windows, lags]
        Magnitude of `values` over the geometric mean of the energies of both channels.
    lags_m : float64 [lags]
    cycles_per_m : float
        Phase per metre of range.
    sensitivity : float64 [pairs, windows]
        Decrease in range per metre of sway.
    pairs : Overlap
    independent : float64 [windows]
        Number of independent samples of speckle in a window.
    echoes : float64 [windows]
        Number of independent samples that contain echoes of their own.
    windows : list of Window
        The samples that were correlated.
    aligned : Alignment or None
        Filters that were applied to the channels, if any.
    """

    values: NDArray[np.complex128]
    coherence: NDArray[np.float64]
    lags_m: NDArray[np.float64]
    cycles_per_m: float
    sensitivity: NDArray[np.float64]
    pairs: Overlap
    independent: NDArray[np.float64]
    echoes: NDArray[np.float64]
    windows: list[Window]
    aligned: Alignment | None


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


class Correlator:
    """Range lines that are read along rays and correlated pair by pair."""

    def __init__(self, lines: RangeLines, swath: Swath) -> None:
        self.readout, self.swath = Readout.of(lines), swath
        self.spectrum = spectrum = self.readout.spectrum
        self.cycles_per_m = float(cycles_per_m_at(lines, spectrum.centre))
        self.step_m = lines.range_step_m
        counts = np.maximum(np.diff(swath.edges_m) / self.step_m, 1.0)
        self.samples = counts.astype(np.int64)

    @cached_property
    def live(self) -> NDArray[np.bool_]:
        """False for channels that are dead compared with the others of their ping, [channels].

        Channels of a ping without any echo are live: their pairs are not coherent.
        """
        lines = self.readout.lines
        samples = lines.samples
        power = np.einsum("cs,cs->c", samples, samples.conj(), dtype=np.complex128).real
        usual = np.array([np.median(each) for each in np.split(power, lines.ping_starts[1:])])
        return ~(are_dead(power, usual[lines.ping_numbers]) & (usual[lines.ping_numbers] > 0))

    @cached_property
    def independent(self) -> NDArray[np.float64]:
        """Number of independent samples of speckle in each window, [windows].

        It is N^2 over the sum of the squared correlations of all pairs of its N samples.
        """
        lags = np.arange(-_SPECKLE_LAGS, _SPECKLE_LAGS + 1)
        turns = np.cos(2 * np.pi * np.outer(lags, self.spectrum.frequency))
        correlated = (turns @ self.spectrum.share) ** 2
        return np.array(
            [
                n / float(np.sum(correlated * np.maximum(1 - np.abs(lags) / n, 0.0)))
                for n in self.samples
            ]
        )

    def correlate(self, geometry: PairGeometry, most_m: float, half_width: float) -> Correlation:
        """Return the correlation of pairs at lags of up to `most_m`; see `windows`."""
        most = max(math.ceil(most_m / self.step_m), 1)
        received, aligned = self._received(geometry, half_width)
        windows = _weighed(received, aligned)
        values, coherence = [], []
        for (one, other), n in zip(windows, self.samples, strict=True):
            length = scipy.fft.next_fast_len(int(n) + most)
            of_one, of_other = (scipy.fft.fft(each, length, axis=1) for each in (one, other))
            lagged = scipy.fft.ifft(of_one.conj() * of_other, axis=1).conj()
            lagged = np.concatenate([lagged[:, length - most :], lagged[:, : most + 1]], axis=1)
            energy = np.sqrt(np.sum(np.abs(one) ** 2, axis=1) * np.sum(np.abs(other) ** 2, axis=1))
            values.append(lagged)
            coherence.append(np.abs(lagged) / np.maximum(energy[:, None], 1e-300))
        return Correlation(
            values=np.stack(values, axis=1),
            coherence=np.stack(coherence, axis=1),
            lags_m=self.step_m * np.arange(-most, most + 1, dtype=np.float64),
            cycles_per_m=self.cycles_per_m,
            sensitivity=self._sensitivity(geometry, aligned),
            pairs=geometry.pairs,
            independent=self.independent,
            echoes=self._echoes(received, windows),
            windows=windows,
            aligned=aligned,
        )

    def windows(
        self, geometry: PairGeometry, half_width: float
    ) -> tuple[list[Window], Alignment | None]:
        """Return both channels of all pairs by window of range, and the filters applied to them.

        Parameters
        ----------
        geometry : PairGeometry
            Its lines have the samples of the correlator's lines, and the positions to test.
        half_width : float
            See `alignment`. If the swath has no element lengths, the beam counts as narrow: all
            echoes are taken as coming from broadside, and no filters are applied. Otherwise strong
            echoes are weakened.
        """
        received, aligned = self._received(geometry, half_width)
        return _weighed(received, aligned), aligned

    def _received(
        self, geometry: PairGeometry, half_width: float
    ) -> tuple[list[Window], Alignment | None]:
        """Return the same as `windows`, but without weakening strong echoes."""
        range_m = np.concatenate(
            [
                low + self.step_m * np.arange(n)
                for low, n in zip(self.swath.edges_m[:-1], self.samples, strict=True)
            ]
        )
        first, second = (
            self._along_rays(geometry, each, range_m)
            for each in (geometry.pairs.first, geometry.pairs.second)
        )
        ends = np.cumsum(self.samples)[:-1]
        if self.swath.element_length_m is None:
            return _split(first, second, ends), None
        aligned = alignment(geometry, self._band(), half_width)
        first, second = aligned.apply((first, second), range_m, self.cycles_per_m)
        return _split(first, second, ends), aligned

    def _echoes(self, received: list[Window], windows: list[Window]) -> NDArray[np.float64]:
        """Return the number of independent samples with echoes of their own, [windows]."""
        largest = strongest(received)
        each = zip(received, windows, self.independent.tolist(), strict=True)
        return np.array([independent_echoes(*some, largest) for some in each])

    def _sensitivity(
        self, geometry: PairGeometry, aligned: Alignment | None
    ) -> NDArray[np.float64]:
        """Return the decrease in range per metre of sway, [pairs, windows]."""
        middles_m = self.swath.middles_m
        if aligned is not None:
            return aligned.sensitivity.T @ aligned.weights(middles_m)
        return self.swath.side * geometry.rays(middles_m) @ geometry.outward

    def _along_rays(
        self, geometry: PairGeometry, channels: NDArray[np.int64], range_m: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        """Return channels at points of the rays from the phase centres, [channels, ranges].

        The phase of an echo is that of its distance along the ray.
        """
        points_m = geometry.centre_m[:, None] + range_m[:, None] * geometry.rays(range_m)
        path_m = geometry.ranges_m(channels, points_m)
        carrier = geometry.lines.carrier_cycles_per_m
        turns = carrier * path_m - self.cycles_per_m * range_m
        values = self.readout.read(channels, path_m).astype(np.complex128)
        return values * np.exp(2j * np.pi * (turns - np.rint(turns)))

    def _band(self) -> NDArray[np.float64]:
        """Return phases per metre at frequencies that represent equal shares of the power."""
        quantiles = (np.arange(_FREQUENCIES) + 0.5) / _FREQUENCIES
        share = np.cumsum(self.spectrum.share)
        away = np.interp(quantiles, share / share[-1], self.spectrum.frequency) / self.step_m
        return np.concatenate([self.cycles_per_m - away[::-1], self.cycles_per_m + away])


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
    line = _Line.through(phase, variance, np.stack([-turns, -steer][: 1 + yaw], axis=-1))
    spread = line.spread(coherence, found.aligned)
    expected = phase.size - float(np.trace(line.inverse @ spread))
    lasting = float(np.average(of_few / variance, weights=1 / variance))
    covariance = np.zeros((2, 2))
    covariance[: 1 + yaw, : 1 + yaw] = line.covariance(spread, lasting, found.aligned)
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


def _weighed(received: list[Window], aligned: Alignment | None) -> list[Window]:
    """Return windows with strong echoes weakened if the whole beam counts."""
    if aligned is None:
        return received
    largest = strongest(received)
    return [without_highlights(each, largest) for each in received]


def _split(
    first: NDArray[np.complex128], second: NDArray[np.complex128], ends: NDArray[np.int64]
) -> list[Window]:
    """Return the channels of both pings by window."""
    parts = np.split(first, ends, axis=1), np.split(second, ends, axis=1)
    return list(zip(*parts, strict=True))


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
