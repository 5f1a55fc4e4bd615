"""Phase and roll that explain how heights differ from those expected, if they show them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.validate import ArgumentError
from clsas.interferometry.comparisons import Comparison
from clsas.interferometry.error_fit import Equations, Fit, fitted

MOST_SD_RAD = 0.5
"""Largest standard deviation of an error that is observable, as a phase: a plain choice."""

# Deviation of an error relative to what it would be if the others were known. The errors of the
# model, some milliradians that vary over the swath, grow by as much.
_MOST_AMPLIFICATION = 30.0


@dataclass(frozen=True, eq=False)
class Estimate:
    """A phase, a roll or both.

    Attributes
    ----------
    columns : list of int
        Which were estimated: 0 for the phase, 1 for the roll.
    values, covariance : float64 [2], [2, 2]
        Both errors, 0 where they were not estimated.
    absorbed : float
        Phase that an estimate of the phase alone would absorb per radian of roll.
    fit : Fit
    """

    columns: list[int]
    values: NDArray[np.float64]
    covariance: NDArray[np.float64]
    absorbed: float
    fit: Fit


def estimated(comparison: Comparison, unknowns: tuple[str, ...], given: str) -> Estimate:
    """Return the errors of phase and roll; those that are not observable are left out."""
    columns = list(dict.fromkeys(int(name == "roll") for name in unknowns))
    while True:
        fit = _fit(comparison, columns)
        if fit is None:
            raise _incomparable(comparison, given)
        if _is_observable(fit.covariance, columns, comparison.roll_rad):
            break
        if len(columns) == 1:
            raise _unobservable(fit, unknowns, columns[0], comparison)
        columns = columns[:-1]
    both = comparison.equations_at(_embedded(fit.values, columns))
    phase, roll = (both.per_unknown_m[fit.used] / both.sd_m[fit.used, None]).T
    absorbed = float(phase @ roll / (phase @ phase)) if 0 in columns else 0.0
    spread = np.eye(2)[:, columns]
    return Estimate(columns, spread @ fit.values, spread @ fit.covariance @ spread.T, absorbed, fit)


def _fit(comparison: Comparison, columns: list[int]) -> Fit | None:
    def equations_at(values: NDArray[np.float64]) -> Equations:
        full = comparison.equations_at(_embedded(values, columns))
        return full._replace(per_unknown_m=full.per_unknown_m[:, columns])

    return fitted(equations_at, len(columns), comparison.places)


def _embedded(values: NDArray[np.float64], columns: list[int]) -> NDArray[np.float64]:
    full = np.zeros(2)
    full[columns] = values
    return full


def _is_observable(covariance: NDArray[np.float64], columns: list[int], roll_rad: float) -> bool:
    """Return whether all estimates are accurate, and not because errors of several cancel."""
    if not np.isfinite(covariance).all():
        return False
    scale = np.array([1.0, roll_rad])[columns]
    sd_rad = scale * np.sqrt(np.diag(covariance))
    amplification = np.sqrt(np.diag(covariance) * np.diag(np.linalg.inv(covariance)))
    return bool((sd_rad <= MOST_SD_RAD).all() and (amplification <= _MOST_AMPLIFICATION).all())


def _incomparable(comparison: Comparison, given: str) -> ArgumentError:
    equations = comparison.equations_at(np.zeros(2))
    some = equations.usable
    if not some.any():
        allowed = "share places with the valid heights"
        return ArgumentError(given, allowed, hint=f"no valid height lies at {comparison.what}")
    typical_m = float(np.median(np.abs(equations.residual_m[some])))
    return ArgumentError(
        given,
        "lie close enough to the heights for errors of the pair to explain the difference",
        f"{typical_m:.3g} m",
        "or give more places, since the estimate from these does not settle",
    )


def _unobservable(
    fit: Fit, unknowns: tuple[str, ...], column: int, comparison: Comparison
) -> ArgumentError:
    name = next(each for each in unknowns if (each == "roll") == bool(column))
    sd_rad = float(np.sqrt(fit.covariance[0, 0])) * (comparison.roll_rad if column else 1.0)
    return ArgumentError(
        "unknowns",
        f"be observable from these heights, with a standard deviation up to {MOST_SD_RAD:g} rad of "
        "phase",
        f"{name} with {sd_rad:.2g} rad",
        "more places or a smaller `known_sd_m` show it, or two tracks at different ranges",
    )
