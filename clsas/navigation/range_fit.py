"""Least-squares fit of time offset, sound speed and lever arm to ranges of known points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from clsas.navigation.range_model import Model
from clsas.navigation.reflector_search import HALF_CELLS, coarse_state, noise_power
from clsas.navigation.reflectors import Reader, Responses

MOST_CONDITION = 1e4
"""Largest condition number of the normal matrix, with columns scaled to 1, at which unknowns count
as distinguishable. At this limit, their standard deviations are 50 times as large together as each
alone, and errors of the track and of the points' positions grow as much."""

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
    model: Model,
    reader: Reader,
    free: tuple[int, ...],
    search_m: float,
    step: Callable[[], None],
) -> tuple[Fit, list[Ambiguity], Responses]:
    """Return the fit, the unknowns that were held, and the responses; `step` is called 3 times."""
    state = coarse_state(model, reader, free, search_m)
    step()
    noise = noise_power(model, reader, state, search_m)
    # All ranges count equally here, because errors of track and points do not depend on noise.
    seen = _Problem(model, reader, free, noise).measured(state).seen
    slopes = model.gradient(state)[list(free)][:, seen]
    kept, ambiguities = distinguishable(slopes @ slopes.T, free)
    start = state if kept == free else coarse_state(model, reader, kept, search_m)
    step()
    fit, responses = _settled(_Problem(model, reader, kept, noise), start)
    step()
    return fit, ambiguities, responses


def distinguishable(
    normal: NDArray[np.float64], free: tuple[int, ...]
) -> tuple[tuple[int, ...], list[Ambiguity]]:
    """Return the unknowns that can be solved for, and the ambiguity of each other one.

    As long as the normal matrix is ill-conditioned, the last one of the unknowns that make up its
    weakest direction is held.
    """
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
    return tuple(free[n] for n in kept), ambiguities


@dataclass(frozen=True, eq=False)
class _Problem:
    """Model, measurements and unknowns of a fit.

    Attributes
    ----------
    model : Model
    reader : Reader
    free : tuple of int
        Numbers of the unknowns.
    noise : float64 [points]
        Power of the noise around each reflector.
    """

    model: Model
    reader: Reader
    free: tuple[int, ...]
    noise: NDArray[np.float64]

    def measured(self, state: NDArray[np.float64]) -> Responses:
        """Return the responses near the ranges expected for a state."""
        half_m = HALF_CELLS * self.reader.cell_m
        return self.reader.responses(self.model.range_m(state), self.noise, half_m)


def _settled(problem: _Problem, state: NDArray[np.float64]) -> tuple[Fit, Responses]:
    """Return the fit around a state, using the phases of those reflectors where they are certain.

    A phase is certain if it is predicted to a fraction of a cycle and agrees with the others of its
    reflector. Without such reflectors, the fit uses envelopes alone.
    """
    none = np.zeros(len(problem.model.points_m), bool)
    of_envelopes, envelopes = _converged(problem, state, none)
    followed, fit = of_envelopes.can_be_followed(envelopes), envelopes
    while followed.any():
        equations, fit = _converged(problem, fit.state, followed)
        agreed = followed & (equations.agreement(fit) >= _LEAST_AGREEMENT)
        if (agreed == followed).all():
            return fit, equations.responses
        followed = agreed
    return envelopes, of_envelopes.responses


def _converged(
    problem: _Problem, state: NDArray[np.float64], followed: NDArray[np.bool_]
) -> tuple[_Equations, Fit]:
    """Alternate between measuring around the model and fitting it, until expected ranges settle.

    `followed` marks the reflectors whose phases are used.
    """
    for _ in range(_ROUNDS):
        equations = _Equations(problem, problem.measured(state), state, followed)
        fit = equations.solved()
        state = fit.state
        change_m = np.abs(problem.model.range_m(state) - equations.expected_m).max()
        if change_m <= _SETTLED * problem.reader.cell_m:
            break
    return equations, fit


@dataclass(frozen=True, eq=False)
class _Values:
    """Values for the ranges (m) and the phases (rad) of all responses, [channels, points] each."""

    ranges: NDArray[np.float64]
    phases: NDArray[np.float64]


class _Equations:
    """Equations for the unknowns, from ranges and phases measured around a state.

    All phases of a reflector contain the unknown phase of the reflector itself, which is estimated
    from their mean.
    """

    def __init__(
        self,
        problem: _Problem,
        responses: Responses,
        state: NDArray[np.float64],
        followed: NDArray[np.bool_],
    ) -> None:
        self.model, self.free, self.state = problem.model, problem.free, state
        self.turn = 2 * np.pi * problem.reader.cycles_per_m
        self.responses, self.followed = responses, followed
        self.expected_m = self.model.range_m(state)
        self.use = responses.seen.copy()

    def solved(self) -> Fit:
        """Return the solution, with a misfit that explains the residuals beyond the noise."""
        misfit_m, state = 0.0, self.state
        for number in range(_ROUNDS):
            state = self._least_squares(misfit_m)
            residuals = self._residuals(state)
            misfit_m = self._misfit_m(residuals)
            if number == 0:
                self._leave_out_outliers(residuals, misfit_m)
        chi2, freedom = self._chi2(residuals, misfit_m)
        scale = chi2 / freedom if freedom > 0 else 1.0
        slopes = self._slopes(self.state, misfit_m)
        residual_m = np.where(self.followed, residuals.phases / self.turn, residuals.ranges)
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
        slopes = self._varying(self.model.gradient(fit.state)[list(self.free)], 0.0)
        slopes *= self.turn
        variance = np.einsum("ucp,uv,vcp->cp", slopes, fit.covariance, slopes)
        worst = np.max(np.where(self.use, variance, 0.0), axis=0)
        return (worst <= _MOST_TURN_RAD**2) & (self.use.sum(axis=0) > 1)

    def agreement(self, fit: Fit) -> NDArray[np.float64]:
        """Return how well the phases of each reflector agree, 0 to 1, [points]."""
        phases = self._residuals(fit.state).phases
        total = np.abs(np.sum(np.where(self.use, np.exp(1j * phases), 0), axis=0))
        return total / np.maximum(self.use.sum(axis=0), 1)

    def _deviations(self, misfit_m: float) -> _Values:
        """Return the standard deviations for a misfit."""
        return _Values(
            np.hypot(self.responses.error_sd_m, misfit_m),
            np.hypot(self.responses.phase_sd_rad, self.turn * misfit_m),
        )

    def _varying(self, values: NDArray, misfit_m: float) -> NDArray:
        """Return values minus their weighted mean over the channels that see a reflector."""
        weight = self.use / self._deviations(misfit_m).phases ** 2
        mean = np.sum(weight * values, axis=-2) / np.maximum(weight.sum(axis=0), 1e-300)
        return values - mean[..., None, :]

    def _residuals(self, state: NDArray[np.float64], misfit_m: float = 0.0) -> _Values:
        """Return the residuals. Those of phases have the sign of the range."""
        moved_m = self.model.range_m(state) - self.expected_m
        phase = self.responses.phase_rad + self.turn * moved_m
        deviation = self._deviations(misfit_m).phases
        own = np.angle(np.sum(self.use * np.exp(1j * phase) / deviation**2, axis=0))
        rest = np.angle(np.exp(1j * (phase - own)))
        return _Values(self.responses.error_m - moved_m, -self._varying(rest, misfit_m))

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

    def _slopes(self, state: NDArray[np.float64], misfit_m: float) -> NDArray[np.float64]:
        """Return the weighted derivatives of ranges and phases, [measurements, free]."""
        gradient = self.model.gradient(state)[list(self.free)]
        varying = self.turn * self._varying(gradient, misfit_m)
        columns = [
            self._weighted(_Values(of_range, of_phase), misfit_m)
            for of_range, of_phase in zip(gradient, varying, strict=True)
        ]
        return np.stack(columns, axis=-1) if columns else np.zeros((0, 0))

    def _weighted(self, values: _Values, misfit_m: float) -> NDArray[np.float64]:
        """Return the values in use over their standard deviations, as one row."""
        deviations = self._deviations(misfit_m)
        followed = self.use & self.followed
        return np.concatenate(
            [
                (values.ranges / deviations.ranges)[self.use],
                (values.phases / deviations.phases)[followed],
            ]
        )

    def _chi2(self, residuals: _Values, misfit_m: float) -> tuple[float, int]:
        """Return the sum of squared residuals over their variances, and the degrees of freedom."""
        values = self._weighted(residuals, misfit_m)
        unknowns = len(self.free) + int((self.use & self.followed).any(axis=0).sum())
        return float(values @ values), len(values) - unknowns

    def _misfit_m(self, residuals: _Values) -> float:
        """Return the rms error in addition to the noise that explains the residuals.

        It is the same for every reflector, so that a strong one does not outweigh the others by
        more than the accuracy of its ranges justifies.
        """
        chi2, freedom = self._chi2(residuals, 0.0)
        if chi2 <= max(freedom, 0):
            return 0.0
        low_m, high_m = 0.0, float(np.abs(residuals.ranges[self.use]).max()) + 1e-12
        for _ in range(50):
            middle_m = (low_m + high_m) / 2
            chi2, freedom = self._chi2(residuals, middle_m)
            low_m, high_m = (middle_m, high_m) if chi2 > freedom else (low_m, middle_m)
        return high_m

    def _leave_out_outliers(self, residuals: _Values, misfit_m: float) -> None:
        """Leave out responses that do not belong to their reflector."""
        deviations = self._deviations(misfit_m)
        self.use &= np.abs(residuals.ranges) <= _OUTLIER * deviations.ranges
        self.use &= ~self.followed | (np.abs(residuals.phases) <= _OUTLIER * deviations.phases)
