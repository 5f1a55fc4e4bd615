"""Displacement of an array from a ping to the next, from channels that share phase centres.

Both channels of a pair receive the same speckle. Each is read along one ray from their phase
centre, at the ranges that its own transmitter and receiver have to the points of the ray: range
migration, separate transmitters and motion during flight are then gone. What is left is the change
in range by an array that does not lie where its navigation says (Bellettini and Pinto 2002).
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
from clsas.core.wavelengths import cycles_per_m_at
from clsas.navigation.directions import Alignment, Frame, alignment, ranges_m
from clsas.navigation.echoes import (
    Window,
    block_products,
    independent_echoes,
    phase_variance,
    strongest,
    without_highlights,
)
from clsas.navigation.overlap import Array, Overlap
from clsas.navigation.swath import Swath
from clsas.signal.readout import Readout

_CANCELLED = 1e-6  # length of the sum of two unit vectors, up to which they are opposite
_SLOPES = np.linspace(-0.2, 0.2, 81)  # yaw between pings that is tried first, rad
_FINE = 16  # points per sample at which the envelope's peak is looked for
_FREQUENCIES = 9  # of either half of the band, which stand for equal shares of the power
# Standard deviation of yaw over that of independent pairs, by `scripts/bench navigation`: 1 covers
# 0.89 to 0.94 of errors by 95 % intervals.
_SHARED = 1.1
# Error of a pair's phase by filters and interpolation, chosen: without it three times the told
# deviation fell short of the sway of coarse arrays over even speckle without noise.
_EXACT_RAD = 2e-3
_SPECKLE_LAGS = 64  # samples over which speckle may be correlated in range


@dataclass(frozen=True, eq=False)
class Correlation:
    """Correlation of channel pairs at lags of range.

    Attributes
    ----------
    values : complex128 [pairs, windows, lags]
        Cross-correlation; its phase is 0 for arrays that lie where they are said to.
    coherence : float64 [pairs, windows, lags]
        Its magnitude over the geometric mean of both energies.
    lags_m : float64 [lags]
    cycles_per_m : float
        Phase per metre of range.
    sensitivity : float64 [pairs, windows]
        Decrease in range per metre of sway.
    along_m : float64 [pairs]
        See `Overlap`.
    independent : float64 [windows]
        Number of independent samples of speckle in a window.
    echoes : float64 [windows]
        Number of these that hold echoes of their own.
    windows : list of Window
        What was correlated.
    aligned : Alignment or None
        Filters that channels went through; None as they were received.
    """

    values: NDArray[np.complex128]
    coherence: NDArray[np.float64]
    lags_m: NDArray[np.float64]
    cycles_per_m: float
    sensitivity: NDArray[np.float64]
    along_m: NDArray[np.float64]
    independent: NDArray[np.float64]
    echoes: NDArray[np.float64]
    windows: list[Window]
    aligned: Alignment | None = None


@dataclass(frozen=True)
class Displacement:
    """Displacement of an array between two pings, beside what its navigation says.

    Attributes
    ----------
    sway_m, yaw_rad : float
        At the middle of the overlap, to port; and turn from forward to port.
    covariance : float64 [2, 2]
        Of both.
    coherence : float64 [windows]
        Mean over the pairs.
    misfit : float
        Mean square of the residual phases over what their coherence explains; 1 is expected.
    scatter : float64 [blocks]
        What the echoes of every block of range say beyond this: of yaw, or of sway where there is
        no yaw. Blocks are parts of the windows.
    echoes : float
        Number of independent samples that hold echoes.
    lasting : float
        Share of the variance that fewer echoes than those of speckle make: they last.
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
    """Lines, read along rays and correlated pair by pair."""

    def __init__(self, lines: RangeLines, swath: Swath) -> None:
        self.readout, self.swath = Readout.of(lines), swath
        self.spectrum = spectrum = self.readout.spectrum
        self.cycles_per_m = float(cycles_per_m_at(lines, spectrum.centre))
        self.step_m = lines.range_step_m
        counts = np.maximum(np.diff(swath.edges_m) / self.step_m, 1.0)
        self.samples = counts.astype(np.int64)

    @cached_property
    def heard(self) -> NDArray[np.bool_]:
        """False for channels that are dead beside the others of their ping, [channels].

        A ping without any echo is not: its pairs are not coherent.
        """
        lines = self.readout.lines
        samples = lines.samples
        power = np.einsum("cs,cs->c", samples, samples.conj(), dtype=np.complex128).real
        usual = np.array([np.median(each) for each in np.split(power, lines.ping_starts[1:])])
        return ~(are_dead(power, usual[lines.ping_numbers]) & (usual[lines.ping_numbers] > 0))

    @cached_property
    def independent(self) -> NDArray[np.float64]:
        """Independent samples of speckle per window: N^2 over the sum of squared correlations."""
        lags = np.arange(-_SPECKLE_LAGS, _SPECKLE_LAGS + 1)
        turns = np.cos(2 * np.pi * np.outer(lags, self.spectrum.frequency))
        correlated = (turns @ self.spectrum.share) ** 2
        return np.array(
            [
                n / float(np.sum(correlated * np.maximum(1 - np.abs(lags) / n, 0.0)))
                for n in self.samples
            ]
        )

    def correlate(
        self,
        lines: RangeLines,
        array: Array,
        pairs: Overlap,
        most_m: float,
        directions: float,
    ) -> Correlation:
        """Return the correlation of pairs at lags of up to `most_m`. See `windows`."""
        most = max(math.ceil(most_m / self.step_m), 1)
        received, frame, aligned = self._received(lines, array, pairs, directions)
        windows = _weighed(received, aligned)
        echoes = self._echoes(received, windows)
        values, coherence = [], []
        for (one, other), n in zip(windows, self.samples, strict=True):
            length = scipy.fft.next_fast_len(int(n) + most)
            spectra = (scipy.fft.fft(each, length, axis=1) for each in (one, other))
            of_one, of_other = spectra
            lagged = scipy.fft.ifft(of_one.conj() * of_other, axis=1).conj()
            lagged = np.concatenate([lagged[:, length - most :], lagged[:, : most + 1]], axis=1)
            energy = np.sqrt(np.sum(np.abs(one) ** 2, axis=1) * np.sum(np.abs(other) ** 2, axis=1))[
                :, None
            ]
            values.append(lagged)
            coherence.append(np.abs(lagged) / np.maximum(energy, 1e-300))
        return Correlation(
            np.stack(values, axis=1),
            np.stack(coherence, axis=1),
            self.step_m * np.arange(-most, most + 1, dtype=np.float64),
            self.cycles_per_m,
            self._sensitivity(frame, aligned),
            pairs.along_m,
            self.independent,
            echoes,
            windows,
            aligned,
        )

    def windows(
        self, lines: RangeLines, array: Array, pairs: Overlap, directions: float
    ) -> tuple[list[Window], Frame, Alignment | None]:
        """Return both channels of all pairs by window of range, and how they were aligned.

        `lines` has the samples that the correlator was made for, and the positions to test.
        `directions` is the half width of `alignment`. Where the beam is narrow, all echoes are
        aligned as those from broadside; else strong ones are weakened.
        """
        received, frame, aligned = self._received(lines, array, pairs, directions)
        return _weighed(received, aligned), frame, aligned

    def _received(
        self, lines: RangeLines, array: Array, pairs: Overlap, directions: float
    ) -> tuple[list[Window], Frame, Alignment | None]:
        """Return what `windows` does, with echoes as strong as they are."""
        swath, frame = self.swath, self._frame(lines, array, pairs)
        range_m = np.concatenate(
            [
                low + self.step_m * np.arange(n)
                for low, n in zip(swath.edges_m[:-1], self.samples, strict=True)
            ]
        )
        first, second = (
            self._along_rays(lines, each, frame, range_m) for each in (pairs.first, pairs.second)
        )
        ends = np.cumsum(self.samples)[:-1]
        if swath.element_length_m is None:
            return _split(first, second, ends), frame, None
        aligned = alignment(lines, array, pairs, frame, swath, self._band(), directions)
        first, second = aligned.apply((first, second), range_m, self.cycles_per_m)
        return _split(first, second, ends), frame, aligned

    def _echoes(self, received: list[Window], windows: list[Window]) -> NDArray[np.float64]:
        """Return the number of independent samples that hold echoes of their own, [windows]."""
        largest = strongest(received)
        each = zip(received, windows, self.independent.tolist(), strict=True)
        return np.array([independent_echoes(*some, largest) for some in each])

    def _frame(self, lines: RangeLines, array: Array, pairs: Overlap) -> Frame:
        centre_m = (lines.phase_centres_m[pairs.first] + lines.phase_centres_m[pairs.second]) / 2
        ping = int(np.searchsorted(array.starts, pairs.first[0], "right")) - 1
        forward = array.forward[ping] + array.forward[ping + 1]
        both = float(np.linalg.norm(forward))
        # They cancel where the track turns back from one ping to the next.
        forward = forward / both if both > _CANCELLED else array.forward[ping]
        outward = self.swath.side * np.array([-forward[1], forward[0], 0.0])
        return Frame(centre_m, forward, outward)

    def _sensitivity(self, frame: Frame, aligned: Alignment | None) -> NDArray[np.float64]:
        middles_m = self.swath.middles_m
        if aligned is not None:
            return aligned.sensitivity.T @ aligned.shares(middles_m)
        return self.swath.side * frame.rays(self.swath, middles_m) @ frame.outward

    def _along_rays(
        self,
        lines: RangeLines,
        channels: NDArray[np.int64],
        frame: Frame,
        range_m: NDArray[np.float64],
    ) -> NDArray[np.complex128]:
        """Return channels at the points of rays from their phase centres, [channels, ranges].

        The phase of an echo is that of its distance along the ray.
        """
        points_m = frame.centre_m[:, None] + range_m[:, None] * frame.rays(self.swath, range_m)
        path_m = ranges_m(lines, channels, points_m)
        turns = lines.carrier_cycles_per_m * path_m - self.cycles_per_m * range_m
        values = self.readout.read(channels, path_m).astype(np.complex128)
        return values * np.exp(2j * np.pi * (turns - np.rint(turns)))

    def _band(self) -> NDArray[np.float64]:
        """Return phases per metre at frequencies that stand for equal shares of the power."""
        if self.swath.element_length_m is None:
            return np.array([self.cycles_per_m])
        at = (np.arange(_FREQUENCIES) + 0.5) / _FREQUENCIES
        share = np.cumsum(self.spectrum.share)
        away = np.interp(at, share / share[-1], self.spectrum.frequency) / self.step_m
        return np.concatenate([self.cycles_per_m - away[::-1], self.cycles_per_m + away])


def displacement(found: Correlation, *, first: bool, yaw: bool) -> Displacement:
    """Return the displacement that explains a correlation best.

    The envelope's peak over lags decides between whole wavelengths; phases, fitted by a straight
    line along the array, do the rest. `first` also tries yaw of up to 0.2 rad, or as much as the
    spacing of the channels tells. Without `yaw` the array does not turn: the line is level.
    """
    turns = 2 * np.pi * found.cycles_per_m * found.sensitivity
    slope = 0.0
    steer = turns * found.along_m[:, None]
    if first and yaw:
        slopes = _SLOPES[np.abs(_SLOPES) <= _unambiguous_slope(found)]
        power = [
            np.sum(np.abs(np.einsum("kwm,kw->wm", found.values, np.exp(1j * steer * each))) ** 2)
            for each in slopes
        ]
        slope = float(slopes[int(np.argmax(power))])
    summed = np.einsum("kwm,kw->wm", found.values, np.exp(1j * steer * slope))
    sway_m = -_peak_m(summed, found.lags_m) / float(np.mean(found.sensitivity))
    lag = int(np.argmin(np.abs(found.lags_m + sway_m * np.mean(found.sensitivity))))
    model = -turns * (sway_m + slope * found.along_m[:, None])
    phase = np.angle(found.values[:, :, lag] * np.exp(-1j * model))
    # The mean is taken on the circle first: single phases may be anywhere.
    mean = np.angle(np.sum(found.values[:, :, lag] * np.exp(-1j * model)))
    phase = np.angle(np.exp(1j * (phase - mean))) + mean
    coherence = np.sqrt(np.mean(found.coherence[:, :, lag] ** 2, axis=0))
    of_few = _of_few_echoes(found)
    variance = phase_variance(coherence, found.independent) + of_few
    design = np.stack([-turns, -steer] if yaw else [-turns], axis=-1)
    normal = np.einsum("w,kwa,kwb->ab", 1 / variance, design, design)
    inverse = np.linalg.inv(normal)
    solution = np.zeros(2)
    unknowns = len(normal)
    solution[:unknowns] = inverse @ np.einsum("w,kwa,kw->a", 1 / variance, design, phase)
    residual = phase - design @ solution[:unknowns]
    covariance = np.zeros((2, 2))
    spread = np.zeros_like(normal)
    for window, each in enumerate(coherence):
        shared = np.eye(len(phase)) if found.aligned is None else found.aligned.shared(each)
        at = design[:, window]
        spread += at.T @ shared @ at / variance[window]
    covariance[:unknowns, :unknowns] = inverse @ spread @ inverse
    expected = phase.size - float(np.trace(inverse @ spread))
    misfit = float(np.sum(residual**2 / variance) / max(expected, 1.0))
    covariance *= np.outer([1.0, _SHARED], [1.0, _SHARED])
    # More windows do not make the model of the array more exact.
    level = design.mean(axis=1)
    covariance[:unknowns, :unknowns] += _EXACT_RAD**2 * np.linalg.inv(level.T @ level)
    gain = np.einsum("ab,kwb,w->akw", inverse, design, 1 / variance)
    lasting = float(np.average(of_few / variance, weights=1 / variance))
    if found.aligned is not None:
        # Few echoes may all come from the middle of the beam.
        apart = np.einsum("akw,k->a", gain, found.aligned.uneven_rad)
        covariance[:unknowns, :unknowns] += lasting * np.outer(apart, apart)
    return Displacement(
        sway_m + float(solution[0]),
        slope + float(solution[1]),
        covariance,
        coherence,
        misfit,
        _scatter(found, lag, phase - residual, gain[-1]),
        float(found.echoes.sum()),
        lasting,
    )


def _of_few_echoes(found: Correlation) -> NDArray[np.float64]:
    """Return the variance of phases because echoes are fewer than those of speckle, [windows].

    Every direction keeps a phase of its own. Those of speckle make pings less coherent, and average
    out as noise does. Few echoes come from few directions: they stay coherent, and what is expected
    of an even seabed is wrong for them.
    """
    if found.aligned is None:
        return np.zeros_like(found.echoes)
    square = found.aligned.coherence**2
    fewer = 1 / np.clip(found.echoes, 1.0, found.independent) - 1 / found.independent
    return np.asarray((1 - square) / (2 * square) * fewer)


def _scatter(
    found: Correlation, lag: int, fitted: NDArray[np.float64], gain: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return what blocks of range add to a displacement, [blocks]; their sum is about 0.

    `fitted` and `gain` are the phases of the fit, and the displacement per phase, [pairs, windows].
    """
    shift = round(float(found.lags_m[lag] / (found.lags_m[1] - found.lags_m[0])))
    added = []
    for number, (window, count) in enumerate(zip(found.windows, found.independent, strict=True)):
        products = block_products(window, shift, float(count))
        turned = (products * np.exp(-1j * fitted[:, number, None])).imag
        total = np.maximum(np.abs(found.values[:, number, lag]), 1e-300)
        added.append((gain[:, number] / total) @ turned)
    return np.concatenate(added)


def _unambiguous_slope(found: Correlation) -> float:
    """Return the yaw up to which phases of neighbouring pairs differ by less than half a cycle.

    Beyond it the array's pairs see grating lobes: the same phases as of a smaller yaw.
    """
    steps_m = np.diff(np.sort(found.along_m))
    apart_m = float(np.median(steps_m)) if len(steps_m) else 0.0
    return 0.5 / max(abs(found.cycles_per_m) * apart_m, 1e-9)


def _weighed(received: list[Window], aligned: Alignment | None) -> list[Window]:
    """Return windows with strong echoes weakened, where echoes of all directions count."""
    if aligned is None:
        return received
    largest = strongest(received)
    return [without_highlights(each, largest) for each in received]


def _split(
    first: NDArray[np.complex128], second: NDArray[np.complex128], ends: NDArray[np.int64]
) -> list[Window]:
    """Return both channels by window."""
    parts = np.split(first, ends, axis=1), np.split(second, ends, axis=1)
    return list(zip(*parts, strict=True))


def _peak_m(summed: NDArray[np.complex128], lags_m: NDArray[np.float64]) -> float:
    """Return the lag of the envelope's peak, interpolated between samples."""
    step_m = lags_m[1] - lags_m[0]
    peak = int(np.argmax(np.sum(np.abs(summed) ** 2, axis=0)))
    fine_m = lags_m[peak] + step_m * np.linspace(-1, 1, 2 * _FINE + 1)
    between = np.sinc((fine_m[:, None] - lags_m) / step_m)
    power = np.sum(np.abs(summed @ between.T) ** 2, axis=0)
    best = int(np.clip(np.argmax(power), 1, len(power) - 2))
    before, at, after = power[best - 1 : best + 2]
    bend = before - 2 * at + after
    shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return float(fine_m[best] + np.clip(shift, -1, 1) * step_m / _FINE)
