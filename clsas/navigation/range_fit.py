"""Least-squares fit of time offset, sound speed and lever arm to ranges of known points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from clsas.navigation.range_model import Model
from clsas.navigation.reflector_search import HALF_CELLS, found, noise_power
from clsas.navigation.reflectors import Reader, Responses

MOST_CONDITION = 1e4
"""Condition number of the normal matrix, of columns scaled to 1, up to which unknowns are told
apart. At this limit they are 50 times less certain together than each alone; errors of the track
and of the points' positions grow as much."""

_MOST_TURN_RAD = 0.8  # standard deviation of a phase's prediction, up to which it is followed
_LEAST_AGREEMENT = 0.7  # of the phases of a reflector: a residual of 0.85 rad rms
_OUTLIER = 4.0  # standard deviations
_ROUNDS = 4  # of measuring around the model and fitting it, and of errors beside the noise
_SETTLED = 1e-3  # resolution cells by which a fit moves expected ranges in the end


@dataclass(frozen=True, eq=False)
class Fit:
    """Corrections that explain the measured ranges best.

    Attributes
    ----------
    state : float64 [5]
        Corrections; 0 where they were held.
    free : tuple of int
        Numbers of the unknowns that were solved for.
    covariance : float64 [free, free]
    residual_m : float64 [channels, points]
        Measured range less the model's; NaN where a reflector was not seen.
    phases : bool [points]
        Whether the phases of a reflector were used, and residuals are theirs.
    misfit_m : float
        Rms error of track, points or model beside the noise.
    """

    state: NDArray[np.float64]
    free: tuple[int, ...]
    covariance: NDArray[np.float64]
    residual_m: NDArray[np.float64]
    phases: NDArray[np.bool_]
    misfit_m: float


@dataclass(frozen=True)
class Alike:
    """Unknowns that the geometry does not tell apart, and the one that is held for that reason."""

    unknowns: tuple[int, ...]
    held: int
    condition: float


def fitted(
    model: Model,
    reader: Reader,
    free: tuple[int, ...],
    search_m: float,
    step: Callable[[], None],
) -> tuple[Fit, list[Alike], Responses]:
    """Return the fit, the unknowns that were held, and the responses; `step` is called 4 times."""
    state = found(model, reader, free, search_m)
    step()
    noise = noise_power(model, reader, state, search_m)
    # As if all ranges were equally certain: errors of track and points do not fall with noise.
    seen = _measured(model, reader, state, noise).seen
    slopes = model.gradient(state)[list(free)][:, seen]
    kept, alike = tell_apart(slopes @ slopes.T, free)
    start = state if kept == free else found(model, reader, kept, search_m)
    step()
    for phases in (True, False):
        fit, responses = _settled(model, reader, kept, start, noise, phases)
        if fit is not None:
            break
    assert fit is not None  # without phases there always is one
    return fit, alike, responses


def tell_apart(
    normal: NDArray[np.float64], free: tuple[int, ...]
) -> tuple[tuple[int, ...], list[Alike]]:
    """Return the unknowns that can be solved for, and for each other one what it is like.

    While the normal matrix is ill-conditioned, the last of the unknowns that make up its weakest
    direction is held.
    """
    kept, alike = list(range(len(free))), []
    while kept:
        part = normal[np.ix_(kept, kept)]
        scale = np.sqrt(np.maximum(np.diag(part), 1e-300))
        values, vectors = np.linalg.eigh(part / np.outer(scale, scale))
        condition = float(values[-1] / max(values[0], 1e-300))
        if condition <= MOST_CONDITION:
            break
        involved = np.flatnonzero(np.abs(vectors[:, 0]) >= 0.5 * np.abs(vectors[:, 0]).max())
        held = kept[int(involved[-1])]
        alike.append(Alike(tuple(free[kept[n]] for n in involved), free[held], condition))
        kept.remove(held)
    return tuple(free[n] for n in kept), alike


def _measured(
    model: Model, reader: Reader, state: NDArray[np.float64], noise: NDArray[np.float64]
) -> Responses:
    return reader.responses(model.range_m(state), noise, HALF_CELLS * reader.cell_m)


def _settled(
    model: Model,
    reader: Reader,
    free: tuple[int, ...],
    state: NDArray[np.float64],
    noise: NDArray[np.float64],
    phases: bool,
) -> tuple[Fit | None, Responses]:
    """Return the fit around a state, or None if phases cannot be followed."""
    followed = np.zeros(len(model.points_m), bool)
    equations, fit = _converged(model, reader, free, state, noise, followed)
    if not phases:
        return fit, equations.responses
    followed = equations.can_be_followed(fit)
    while followed.any():
        equations, fit = _converged(model, reader, free, fit.state, noise, followed)
        agreed = followed & (equations.agreement(fit) >= _LEAST_AGREEMENT)
        if (agreed == followed).all():
            return fit, equations.responses
        followed = agreed
    return None, equations.responses


def _converged(
    model: Model,
    reader: Reader,
    free: tuple[int, ...],
    state: NDArray[np.float64],
    noise: NDArray[np.float64],
    followed: NDArray[np.bool_],
) -> tuple[_Equations, Fit]:
    """Measure around the model and fit it, until the expected ranges settle."""
    for _ in range(_ROUNDS):
        responses = _measured(model, reader, state, noise)
        equations = _Equations(model, reader, responses, state, free, followed)
        fit = equations.solved()
        state = fit.state
        if np.abs(model.range_m(state) - equations.expected_m).max() <= _SETTLED * reader.cell_m:
            break
    return equations, fit


class _Equations:
    """Ranges and phases measured around a state, and what they say about the unknowns.

    The phases of a reflector have its own phase in common, which is taken from their mean.
    """

    def __init__(
        self,
        model: Model,
        reader: Reader,
        responses: Responses,
        state: NDArray[np.float64],
        free: tuple[int, ...],
        followed: NDArray[np.bool_],
    ) -> None:
        self.model, self.state, self.free = model, state, free
        self.turn = 2 * np.pi * reader.cycles_per_m
        self.responses, self.followed = responses, followed
        self.expected_m = model.range_m(state)
        self.use = responses.seen.copy()

    def solved(self) -> Fit:
        """Return the solution, with errors beside the noise as large as the residuals tell."""
        misfit_m, state = 0.0, self.state
        for number in range(_ROUNDS):
            state = self._least_squares(misfit_m)
            ranges, phases = self._residuals(state)
            misfit_m = self._misfit_m(ranges, phases)
            if number == 0:
                self._leave_out(ranges, phases, misfit_m)
        chi2, freedom = self._chi2(ranges, phases, misfit_m)
        scale = chi2 / freedom if freedom > 0 else 1.0
        residual_m = np.where(self.followed, phases / self.turn, ranges)
        return Fit(
            state=state,
            free=self.free,
            covariance=np.asarray(scale * np.linalg.pinv(self.normal(misfit_m)), np.float64),
            residual_m=np.where(self.use, residual_m, np.nan),
            phases=self.followed,
            misfit_m=misfit_m,
        )

    def normal(self, misfit_m: float) -> NDArray[np.float64]:
        """Return the normal matrix, [free, free]."""
        slopes = self._slopes(self.state, misfit_m)
        return slopes.T @ slopes

    def can_be_followed(self, fit: Fit) -> NDArray[np.bool_]:
        """Return for which reflectors the fit predicts phases to a fraction of a cycle."""
        slopes = self._varying(self.model.gradient(fit.state)[list(self.free)], 0.0)
        slopes *= self.turn
        variance = np.einsum("ucp,uv,vcp->cp", slopes, fit.covariance, slopes)
        worst = np.max(np.where(self.use, variance, 0.0), axis=0)
        return (worst <= _MOST_TURN_RAD**2) & (self.use.sum(axis=0) > 1)

    def agreement(self, fit: Fit) -> NDArray[np.float64]:
        """Return how far the phases of every reflector agree, 0 to 1."""
        _, phases = self._residuals(fit.state)
        total = np.abs(np.sum(np.where(self.use, np.exp(1j * phases), 0), axis=0))
        return total / np.maximum(self.use.sum(axis=0), 1)

    def _deviations(self, misfit_m: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return standard deviations of ranges (m) and phases (rad), [channels, points]."""
        ranges = np.hypot(self.responses.error_sd_m, misfit_m)
        return ranges, np.hypot(self.responses.phase_sd_rad, self.turn * misfit_m)

    def _varying(self, values: NDArray, misfit_m: float) -> NDArray:
        """Return values less their weighted mean over the channels that see a reflector."""
        _, deviation = self._deviations(misfit_m)
        weight = self.use / deviation**2
        mean = np.sum(weight * values, axis=-2) / np.maximum(weight.sum(axis=0), 1e-300)
        return values - mean[..., None, :]

    def _residuals(
        self, state: NDArray[np.float64], misfit_m: float = 0.0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return residuals of ranges (m) and of phases (rad, by the sign of ranges)."""
        moved_m = self.model.range_m(state) - self.expected_m
        phase = self.responses.phase_rad + self.turn * moved_m
        _, deviation = self._deviations(misfit_m)
        own = np.angle(np.sum(self.use * np.exp(1j * phase) / deviation**2, axis=0))
        rest = np.angle(np.exp(1j * (phase - own)))
        return self.responses.error_m - moved_m, -self._varying(rest, misfit_m)

    def _least_squares(self, misfit_m: float) -> NDArray[np.float64]:
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
        """Return weighted derivatives of ranges and phases, [measurements, free]."""
        gradient = self.model.gradient(state)[list(self.free)]
        varying = self.turn * self._varying(gradient, misfit_m)
        columns = [
            self._weighted((one, other), misfit_m)
            for one, other in zip(gradient, varying, strict=True)
        ]
        return np.stack(columns, axis=-1) if columns else np.zeros((0, 0))

    def _weighted(
        self, both: tuple[NDArray[np.float64], NDArray[np.float64]], misfit_m: float
    ) -> NDArray[np.float64]:
        """Return what is used of ranges and phases, over their standard deviations, as one row."""
        of_range, of_phase = self._deviations(misfit_m)
        followed = self.use & self.followed
        return np.concatenate([(both[0] / of_range)[self.use], (both[1] / of_phase)[followed]])

    def _chi2(
        self, ranges: NDArray[np.float64], phases: NDArray[np.float64], misfit_m: float
    ) -> tuple[float, int]:
        """Return the sum of squared residuals over their variances, and the degrees of freedom."""
        values = self._weighted((ranges, phases), misfit_m)
        unknowns = len(self.free) + int((self.use & self.followed).any(axis=0).sum())
        return float(values @ values), len(values) - unknowns

    def _misfit_m(self, ranges: NDArray[np.float64], phases: NDArray[np.float64]) -> float:
        """Return the rms error beside the noise that explains the residuals.

        Every reflector has it, so that a loud one does not outweigh the others by more than its
        ranges are right.
        """
        if self._chi2(ranges, phases, 0.0)[0] <= max(self._chi2(ranges, phases, 0.0)[1], 0):
            return 0.0
        low_m, high_m = 0.0, float(np.abs(ranges[self.use]).max()) + 1e-12
        for _ in range(50):
            middle_m = (low_m + high_m) / 2
            chi2, freedom = self._chi2(ranges, phases, middle_m)
            low_m, high_m = (middle_m, high_m) if chi2 > freedom else (low_m, middle_m)
        return high_m

    def _leave_out(
        self, ranges: NDArray[np.float64], phases: NDArray[np.float64], misfit_m: float
    ) -> None:
        """Leave out what does not belong to its reflector."""
        of_range, of_phase = self._deviations(misfit_m)
        self.use &= np.abs(ranges) <= _OUTLIER * of_range
        self.use &= ~self.followed | (np.abs(phases) <= _OUTLIER * of_phase)
