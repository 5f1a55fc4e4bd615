"""Least-squares fit of time offset, sound speed and lever arm to the ranges of known points.

A search for the largest echoes near the points yields corrections to about a range cell. Responses
are then measured around the ranges that these corrections predict, by envelope and by phase, and
all of them enter one fit. Measuring and fitting alternate until the predicted ranges settle.

The lines' own time axis and sound speed define the ranges. A point at the range rho from the
corrected positions is expected at (c0/c) rho - c0 dt/2, where c0 is the sound speed of the lines, c
the corrected one, and dt the time that must be added to the lines.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.optimize import least_squares

from clsas.engine.data.fourier import turned
from clsas.engine.data.geometry import pairwise_range_m, unit_vectors
from clsas.engine.data.lines import RangeLines, cycles_per_m_at, some_channels
from clsas.engine.signal.interpolation import Readout
from clsas.navigation.checks import range_cell_m

UNKNOWNS = ("time_offset", "sound_speed", "forward", "port", "up")

MOST_CONDITION = 1e4
"""Largest condition number of the normal matrix, with columns scaled to 1, at which unknowns count
as distinguishable. At this limit, their standard deviations are 50 times as large together as each
alone, and errors of the track and of the points' positions grow as much."""

LEAST_SNR = 10.0
"""Power of a response over that of the noise around it, from which it is used (10 dB). Noise alone
exceeds it once in 20 000 samples."""

# The search.
_SEARCHED_CHANNELS = 1024  # channels in which responses are searched; half as many suffice
_BLURRED = 1 / 32  # share of these channels over which powers are averaged in a wide search
_WIDE_CELLS = 8.0  # half width above which a search counts as wide, range cells
_NARROWER = 4.0  # factor by which each search is narrower than the last
_HALF_CELLS = 2.0  # half width of the last search, and within which responses are measured

# The responses.
_STEPS = 8  # points per range cell at which the envelope is read
_READ_AT_ONCE = 1 << 21  # samples read together, which bounds the memory
# Smallest amplitude of a response, relative to the largest ones of its reflector. Side lobes of
# elements are weaker.
_LEAST_AMPLITUDE = 0.1
_LARGE = 0.9  # quantile of the powers that counts as the largest, as single lines may be louder
_MOST_SNR = 1e7  # because lines are read to -70 dB

# The fit.
# Largest standard deviation of a predicted phase with which a reflector's phases are used.
_MOST_TURN_RAD = 0.8
# Smallest agreement of the phases of a reflector. 0.7 is a residual of 0.85 rad rms.
_LEAST_AGREEMENT = 0.7
_OUTLIER = 4.0  # residual above which a response is left out, standard deviations
_ROUNDS = 4  # most alternations of measuring and fitting, and of fitting and estimating the misfit
_SETTLED = 1e-3  # change of the expected ranges that ends the alternations, range cells


@dataclass(frozen=True, eq=False)
class Fit:
    """Corrections that best explain the measured ranges.

    Attributes
    ----------
    state : float64 [5]
        Corrections; 0 for unknowns that were held.
    free : tuple of int
        Numbers of the unknowns that were solved for.
    covariance : float64 [free, free]
    residual_m : float64 [channels, points]
        Measured range minus the model's; NaN where a reflector was not seen.
    phases : bool [points]
        Whether the phases of a reflector were used. Its residuals are then those of the phases.
    misfit_m : float
        Rms error of track, points or model, in addition to the noise.
    """

    state: NDArray[np.float64]
    free: tuple[int, ...]
    covariance: NDArray[np.float64]
    residual_m: NDArray[np.float64]
    phases: NDArray[np.bool_]
    misfit_m: float


@dataclass(frozen=True)
class Ambiguity:
    """Unknowns that the geometry does not distinguish, and the one that is held because of that."""

    unknowns: tuple[int, ...]
    held: int
    condition: float


def fitted(
    reflectors: Reflectors, free: tuple[int, ...], search_m: float, step: Callable[[], None]
) -> tuple[Fit, list[Ambiguity], float]:
    """Return the fit, the unknowns that were held, and the largest signal-to-noise ratio.

    `free` are the numbers of the unknowns, and `step` is called 3 times.
    """
    state = _searched(reflectors, free, search_m)
    step()

    # As long as the normal matrix is ill-conditioned, the last one of the unknowns that make up its
    # weakest direction is held. All ranges count equally here, because errors of track and points
    # do not depend on noise.
    noise = _noise(reflectors, state, search_m)
    slopes = reflectors.gradient(state)[list(free)][:, _measured(reflectors, state, noise).seen]
    normal = slopes @ slopes.T
    kept, ambiguities = list(range(len(free))), []
    while kept:
        part = normal[np.ix_(kept, kept)]
        scale = np.sqrt(np.maximum(np.diag(part), 1e-300))
        values, vectors = np.linalg.eigh(part / np.outer(scale, scale))
        condition = float(values[-1] / max(values[0], 1e-300))
        if condition <= MOST_CONDITION:
            break
        involved = np.flatnonzero(np.abs(vectors[:, 0]) >= 0.5 * np.abs(vectors[:, 0]).max())
        held = kept[int(involved[-1])]
        unknowns = tuple(free[kept[n]] for n in involved)
        ambiguities.append(Ambiguity(unknowns, free[held], condition))
        kept.remove(held)
    if ambiguities:
        free = tuple(free[n] for n in kept)
        state = _searched(reflectors, free, search_m)
    step()

    # Phases are used if the fit of the envelopes predicts them to a fraction of a cycle, and if
    # they agree with the others of their reflector. Without such phases, that fit is the result.
    none = np.zeros(len(reflectors.points_m), bool)
    equations, fit = _converged(reflectors, free, noise, state, none)
    result, largest_snr = fit, float(equations.responses.snr.max())
    followed = equations.can_be_followed(fit)
    while followed.any():
        equations, fit = _converged(reflectors, free, noise, fit.state, followed)
        agreed = followed & (equations.agreement(fit) >= _LEAST_AGREEMENT)
        if (agreed == followed).all():
            result, largest_snr = fit, float(equations.responses.snr.max())
            break
        followed = agreed
    step()
    return result, ambiguities, largest_snr


@dataclass(frozen=True, eq=False)
class Reflectors:
    """Known points as range lines contain them.

    Their ranges are functions of a state: the corrections of `UNKNOWNS`, float64 [5].

    Attributes
    ----------
    readout : Readout
    points_m : float64 [points, 3]
    axes : float64 [3, channels, 3]
        Unit vectors forward, to port and up.
    """

    readout: Readout
    points_m: NDArray[np.float64]
    axes: NDArray[np.float64]

    @property
    def lines(self) -> RangeLines:
        """Lines that were given."""
        return self.readout.lines

    @cached_property
    def cell_m(self) -> float:
        """Range resolution."""
        return range_cell_m(self.readout)

    def corrected(self, state: NDArray[np.float64]) -> RangeLines:
        """Return the lines with the corrections applied."""
        lines = self.lines
        speed_m_s = lines.sound_speed_m_s + float(state[1])
        ratio = speed_m_s / lines.sound_speed_m_s
        shift_m = np.einsum("u,uci->ci", state[2:], self.axes)
        first_m = lines.first_range_m + lines.sound_speed_m_s / 2 * state[0]
        return replace(
            lines,
            first_range_m=ratio * first_m,
            range_step_m=ratio * lines.range_step_m,
            tx_m=lines.tx_m + shift_m,
            rx_m=lines.rx_m + shift_m,
            sound_speed_m_s=speed_m_s,
        )

    def range_m(
        self, state: NDArray[np.float64], channels: NDArray[np.int64] | slice = slice(None)
    ) -> NDArray[np.float64]:
        """Return the expected ranges on the lines' own axis, [channels, points]."""
        lines, speed_m_s = self.lines, self.lines.sound_speed_m_s + float(state[1])
        shift_m = np.einsum("u,uci->ci", state[2:], self.axes[:, channels])
        velocity = lines.rx_velocity_m_s
        path_m = pairwise_range_m(
            self.points_m,
            lines.tx_m[channels] + shift_m,
            lines.rx_m[channels] + shift_m,
            None if velocity is None else velocity[channels],
            speed_m_s,
        ).T
        return lines.sound_speed_m_s * (path_m / speed_m_s - state[0] / 2)

    def gradient(
        self, state: NDArray[np.float64], channels: NDArray[np.int64] | slice = slice(None)
    ) -> NDArray[np.float64]:
        """Return the derivatives of `range_m`, [5, channels, points]."""
        lines, speed_m_s = self.lines, self.lines.sound_speed_m_s + float(state[1])
        axes = self.axes[:, channels]
        shift_m = np.einsum("u,uci->ci", state[2:], axes)
        ray = np.zeros((axes.shape[1], len(self.points_m), 3))
        for antenna_m in (lines.tx_m, lines.rx_m):
            ray += unit_vectors(self.points_m - (antenna_m[channels] + shift_m)[:, None]) / 2
        by_speed = -self.range_m(state, channels) / speed_m_s
        by_speed -= lines.sound_speed_m_s * state[0] / (2 * speed_m_s)
        by_time = np.full_like(by_speed, -lines.sound_speed_m_s / 2)
        by_lever = -np.einsum("ucj,cpj->ucp", axes, ray) * lines.sound_speed_m_s / speed_m_s
        return np.stack([by_time, by_speed, *by_lever])

    def offsets_m(self, half_m: float) -> NDArray[np.float64]:
        """Return offsets from -half_m to half_m at which lines are read, with 0 in the middle."""
        count = max(math.ceil(half_m / self.cell_m * _STEPS), 2)
        return self.cell_m / _STEPS * np.arange(-count, count + 1, dtype=np.float64)

    def read(
        self,
        channels: NDArray[np.int64],
        range_m: NDArray[np.float64],
        offsets_m: NDArray[np.float64],
    ) -> NDArray[np.complex128]:
        """Return values around ranges, [channels, points, offsets], without the path's phase."""
        at_m = (range_m[..., None] + offsets_m).reshape(len(channels), -1)
        turn = turned(self.lines.carrier_cycles_per_m * at_m)
        values = self.readout.read(channels, at_m) * turn
        return values.reshape(*range_m.shape, len(offsets_m))


def _noise(
    reflectors: Reflectors, state: NDArray[np.float64], search_m: float
) -> NDArray[np.float64]:
    """Return the mean power of the noise around the expected ranges, [points].

    It is estimated from the median over channels and ranges, which a response in a few range cells
    hardly changes.
    """
    channels = some_channels(reflectors.lines.channels, _SEARCHED_CHANNELS)
    offsets_m = reflectors.offsets_m(max(search_m, _WIDE_CELLS * reflectors.cell_m))
    range_m = reflectors.range_m(state, channels)
    power = np.abs(reflectors.read(channels, range_m, offsets_m)) ** 2
    power[power == 0] = np.nan  # beyond the ends of the lines
    with np.errstate(all="ignore"):
        median = np.nanmedian(power, axis=(0, 2)) if np.isfinite(power).any() else 0.0
    # The median of an exponential distribution is log 2 times its mean.
    mean = np.nan_to_num(np.broadcast_to(median, range_m.shape[1:])) / math.log(2)
    return np.asarray(mean, np.float64)


def _searched(
    reflectors: Reflectors, free: tuple[int, ...], search_m: float
) -> NDArray[np.float64]:
    """Return corrections to about a range cell, from the largest echoes near the points."""
    cell_m = reflectors.cell_m
    channels = some_channels(reflectors.lines.channels, _SEARCHED_CHANNELS)
    state, half_m = np.zeros(5), search_m
    usual = np.maximum(_noise(reflectors, state, search_m), 1e-300)
    while True:
        expected_m = reflectors.range_m(state, channels)
        offsets_m = reflectors.offsets_m(half_m)
        power = np.abs(reflectors.read(channels, expected_m, offsets_m)) ** 2
        # A response moves little between neighbouring channels, and noise averages out.
        wide = half_m > _WIDE_CELLS * cell_m
        blur = max(round(_BLURRED * len(channels)), 1) if wide else 1
        power = uniform_filter1d(power, blur, axis=0, mode="nearest")
        echoes_m = expected_m + offsets_m[np.argmax(power, axis=2)]
        # The weight of a reflector grows with its power, up to where it certainly exceeds noise.
        weight = np.clip(power.max(axis=2) / usual / LEAST_SNR, 0.0, 1.0)
        scale_m = half_m
        while True:
            state = _robust(reflectors, state, free, channels, echoes_m, weight, scale_m)
            if scale_m <= cell_m:
                break
            scale_m = max(scale_m / 2, cell_m)
        if half_m <= _HALF_CELLS * cell_m:
            return state
        half_m = max(half_m / _NARROWER, _HALF_CELLS * cell_m)


def _robust(
    reflectors: Reflectors,
    state: NDArray[np.float64],
    free: tuple[int, ...],
    channels: NDArray[np.int64],
    echoes_m: NDArray[np.float64],
    weight: NDArray[np.float64],
    scale_m: float,
) -> NDArray[np.float64]:
    """Return the state that explains most of the ranges of echoes to within `scale_m`.

    Unknowns are scaled to metres of range, and weakly attracted to zero, so that combinations that
    the ranges do not determine remain small.
    """
    index = list(free)
    if not index:
        return state
    unit = np.sqrt(np.mean(reflectors.gradient(state, channels)[index] ** 2, axis=(1, 2)))
    unit = np.maximum(unit, 1e-12)
    pull = 1e-3 / scale_m

    def at(x: NDArray[np.float64]) -> NDArray[np.float64]:
        found = state.copy()
        found[index] = x / unit
        return found

    def residuals(x: NDArray[np.float64]) -> NDArray[np.float64]:
        away_m = weight * (echoes_m - reflectors.range_m(at(x), channels))
        return np.concatenate([away_m.ravel() / scale_m, pull * x])

    def jacobian(x: NDArray[np.float64]) -> NDArray[np.float64]:
        slopes = reflectors.gradient(at(x), channels)[index] / unit[:, None, None]
        of_ranges = -(weight * slopes).reshape(len(index), -1).T / scale_m
        return np.concatenate([of_ranges, pull * np.eye(len(index))])

    solved = least_squares(residuals, state[index] * unit, jacobian, loss="cauchy")
    return at(solved.x)


@dataclass(frozen=True, eq=False)
class Responses:
    """Responses of reflectors near the ranges where a state expects them.

    Attributes
    ----------
    error_m : float64 [channels, points]
        Range of the peak of the envelope minus the expected range.
    phase_rad : float64 [channels, points]
        Phase at the expected range: that of the reflector, minus the phase of the range error.
    snr : float64 [channels, points]
        Power of the peak over that of the noise around it.
    seen : bool [channels, points]
        Whether the response exceeds the noise.
    bandwidth_per_m : float64 [points]
        Rms bandwidth of the responses, cycles per metre of range.
    """

    error_m: NDArray[np.float64]
    phase_rad: NDArray[np.float64]
    snr: NDArray[np.float64]
    seen: NDArray[np.bool_]
    bandwidth_per_m: NDArray[np.float64]


def _measured(
    reflectors: Reflectors, state: NDArray[np.float64], noise: NDArray[np.float64]
) -> Responses:
    """Return the responses of all channels near the ranges that a state predicts."""
    range_m = reflectors.range_m(state)
    channels = np.arange(len(range_m))
    offsets_m = reflectors.offsets_m(_HALF_CELLS * reflectors.cell_m)
    step_m = offsets_m[1] - offsets_m[0]
    error_m, peak, phase, bend = (np.empty(range_m.shape) for _ in range(4))
    at_once = max(_READ_AT_ONCE // (range_m.shape[1] * len(offsets_m)), 1)
    for first in range(0, len(range_m), at_once):
        some = slice(first, first + at_once)
        values = reflectors.read(channels[some], range_m[some], offsets_m)
        phase[some] = np.angle(values[..., len(offsets_m) // 2])
        # A parabola through three samples has the peak of the power, and its decrease per m^2.
        power = np.abs(values) ** 2
        best = np.argmax(power, axis=-1)
        inside = np.clip(best, 1, len(offsets_m) - 2)
        before, at, after = (
            np.take_along_axis(power, inside[..., None] + step, axis=-1)[..., 0]
            for step in (-1, 0, 1)
        )
        fall = np.maximum(2 * at - before - after, 1e-300)
        shift = np.clip((after - before) / (2 * fall), -1, 1)
        error_m[some] = offsets_m[inside] + shift * step_m
        peak[some] = at + (after - before) * shift / 4
        # A peak at either end belongs to an echo outside of the offsets.
        bend[some] = np.where(inside == best, fall / (2 * step_m**2), 0.0)
    snr = peak / np.maximum(noise, 1e-300)
    large = np.quantile(peak, _LARGE, axis=0)
    seen = (snr >= LEAST_SNR) & (peak >= _LEAST_AMPLITUDE**2 * large) & (bend > 0)
    # At a distance r from its peak, |p|^2 is 1 - (2 pi b)^2 r^2.
    total_peak = np.sum(np.where(seen, peak, 0), axis=0)
    mean_bend = np.sum(np.where(seen, bend, 0), axis=0) / np.maximum(total_peak, 1e-300)
    least = 0.01 / reflectors.cell_m  # cycles per metre, far below any band of this resolution
    bandwidth = np.maximum(np.sqrt(mean_bend) / (2 * np.pi), least)
    return Responses(error_m, phase, np.clip(snr, 1e-3, _MOST_SNR), seen, bandwidth)


def _converged(
    reflectors: Reflectors,
    free: tuple[int, ...],
    noise: NDArray[np.float64],
    state: NDArray[np.float64],
    followed: NDArray[np.bool_],
) -> tuple[_Equations, Fit]:
    """Alternate between measuring around the model and fitting it, until expected ranges settle.

    `followed` marks the reflectors whose phases are used.
    """
    for _ in range(_ROUNDS):
        responses = _measured(reflectors, state, noise)
        equations = _Equations(reflectors, free, responses, state, followed)
        fit = equations.solved()
        state = fit.state
        change_m = np.abs(reflectors.range_m(state) - equations.expected_m).max()
        if change_m <= _SETTLED * reflectors.cell_m:
            break
    return equations, fit


class _Equations:
    """Equations for the unknowns, from ranges and phases measured around a state.

    All phases of a reflector contain the unknown phase of the reflector itself, which is estimated
    from their mean. Arrays of [2, channels, points] contain ranges (m) and phases (rad).
    """

    def __init__(
        self,
        reflectors: Reflectors,
        free: tuple[int, ...],
        responses: Responses,
        state: NDArray[np.float64],
        followed: NDArray[np.bool_],
    ) -> None:
        self.reflectors, self.free, self.state = reflectors, free, state
        self.responses, self.followed = responses, followed
        self.expected_m = reflectors.range_m(state)
        self.use = responses.seen.copy()
        # Phase per metre of range at the middle of the band.
        centre = reflectors.readout.spectrum.centre
        self.turn = 2 * np.pi * float(cycles_per_m_at(reflectors.lines, centre))

    def solved(self) -> Fit:
        """Return the solution, with a misfit that explains the residuals beyond the noise.

        The misfit is the same for every reflector, so that a strong one does not outweigh the
        others by more than the accuracy of its ranges justifies.
        """
        misfit_m, state = 0.0, self.state
        for number in range(_ROUNDS):
            state = self._least_squares(misfit_m)
            residuals = self._residuals(state)
            misfit_m = self._misfit_m(residuals)
            if number == 0:
                # Outliers do not belong to their reflector.
                inside = np.abs(residuals) <= _OUTLIER * self._deviations(misfit_m)
                self.use &= inside[0] & (~self.followed | inside[1])
        chi2, freedom = self._chi2(residuals, misfit_m)
        scale = chi2 / freedom if freedom > 0 else 1.0
        slopes = self._slopes(self.state, misfit_m)
        residual_m = np.where(self.followed, residuals[1] / self.turn, residuals[0])
        return Fit(
            state=state,
            free=self.free,
            covariance=np.asarray(scale * np.linalg.pinv(slopes.T @ slopes), np.float64),
            residual_m=np.where(self.use, residual_m, np.nan),
            phases=self.followed,
            misfit_m=misfit_m,
        )

    def can_be_followed(self, fit: Fit) -> NDArray[np.bool_]:
        """Return for which reflectors the fit predicts phases well within a cycle, [points]."""
        slopes = self._varying(self.reflectors.gradient(fit.state)[list(self.free)], 0.0)
        slopes *= self.turn
        variance = np.einsum("ucp,uv,vcp->cp", slopes, fit.covariance, slopes)
        worst = np.max(np.where(self.use, variance, 0.0), axis=0)
        return (worst <= _MOST_TURN_RAD**2) & (self.use.sum(axis=0) > 1)

    def agreement(self, fit: Fit) -> NDArray[np.float64]:
        """Return how well the phases of each reflector agree, 0 to 1, [points]."""
        phases = self._residuals(fit.state)[1]
        total = np.abs(np.sum(np.where(self.use, np.exp(1j * phases), 0), axis=0))
        return total / np.maximum(self.use.sum(axis=0), 1)

    def _least_squares(self, misfit_m: float) -> NDArray[np.float64]:
        """Return the state that minimises the squared residuals over their variances."""
        index = list(self.free)
        if not index or not self.use.any():
            return self.state
        unit = np.maximum(np.linalg.norm(self._slopes(self.state, misfit_m), axis=0), 1e-300)

        def at(x: NDArray[np.float64]) -> NDArray[np.float64]:
            moved = self.state.copy()
            moved[index] += x / unit
            return moved

        def residuals(x: NDArray[np.float64]) -> NDArray[np.float64]:
            return self._weighted(self._residuals(at(x), misfit_m), misfit_m)

        def jacobian(x: NDArray[np.float64]) -> NDArray[np.float64]:
            return -self._slopes(at(x), misfit_m) / unit

        solved: Any = least_squares(residuals, np.zeros(len(index)), jacobian)
        return at(solved.x)

    def _residuals(self, state: NDArray[np.float64], misfit_m: float = 0.0) -> NDArray[np.float64]:
        """Return the residuals, [2, channels, points]. Those of phases have the sign of ranges."""
        moved_m = self.reflectors.range_m(state) - self.expected_m
        phase = self.responses.phase_rad + self.turn * moved_m
        deviation = self._deviations(misfit_m)[1]
        own = np.angle(np.sum(self.use * np.exp(1j * phase) / deviation**2, axis=0))
        rest = np.angle(np.exp(1j * (phase - own)))
        return np.stack([self.responses.error_m - moved_m, -self._varying(rest, misfit_m)])

    def _slopes(self, state: NDArray[np.float64], misfit_m: float) -> NDArray[np.float64]:
        """Return the weighted derivatives of ranges and phases, [measurements, free]."""
        gradient = self.reflectors.gradient(state)[list(self.free)]
        varying = self.turn * self._varying(gradient, misfit_m)
        return self._weighted(np.stack([gradient, varying], axis=1), misfit_m).T

    def _misfit_m(self, residuals: NDArray[np.float64]) -> float:
        """Return the rms error in addition to the noise that explains the residuals."""
        chi2, freedom = self._chi2(residuals, 0.0)
        if chi2 <= max(freedom, 0):
            return 0.0
        low_m, high_m = 0.0, float(np.abs(residuals[0][self.use]).max()) + 1e-12
        for _ in range(50):
            middle_m = (low_m + high_m) / 2
            chi2, freedom = self._chi2(residuals, middle_m)
            low_m, high_m = (middle_m, high_m) if chi2 > freedom else (low_m, middle_m)
        return high_m

    def _chi2(self, residuals: NDArray[np.float64], misfit_m: float) -> tuple[float, int]:
        """Return the sum of squared residuals over their variances, and the degrees of freedom."""
        values = self._weighted(residuals, misfit_m)
        unknowns = len(self.free) + int((self.use & self.followed).any(axis=0).sum())
        return float(values @ values), len(values) - unknowns

    def _weighted(self, values: NDArray[np.float64], misfit_m: float) -> NDArray[np.float64]:
        """Return values, [..., 2, channels, points], in use, over their standard deviations."""
        used = np.stack([self.use, self.use & self.followed])
        return (values / self._deviations(misfit_m))[..., used]

    def _varying(self, values: NDArray, misfit_m: float) -> NDArray:
        """Return values minus their weighted mean over the channels that see a reflector."""
        weight = self.use / self._deviations(misfit_m)[1] ** 2
        mean = np.sum(weight * values, axis=-2) / np.maximum(weight.sum(axis=0), 1e-300)
        return values - mean[..., None, :]

    def _deviations(self, misfit_m: float) -> NDArray[np.float64]:
        """Return the standard deviations for a misfit, [2, channels, points].

        The noise alone causes 1/(2 pi b sqrt(2 snr)) in the ranges, for an rms bandwidth b, and
        1/sqrt(2 snr) in the phases: the Cramer-Rao bounds.
        """
        phase_sd_rad = 1 / np.sqrt(2 * self.responses.snr)
        error_sd_m = phase_sd_rad / (2 * np.pi * self.responses.bandwidth_per_m)
        return np.stack(
            [np.hypot(error_sd_m, misfit_m), np.hypot(phase_sd_rad, self.turn * misfit_m)]
        )
