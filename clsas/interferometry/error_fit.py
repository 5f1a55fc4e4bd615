"""Robust least squares for a few unknowns, from many heights whose errors are correlated.

Windows of neighbouring heights overlap, so their errors are not independent. The correlation of
the errors of two heights is the share of its window that each has in common with the other, and
the covariance of the unknowns x = (A'WA)^-1 A'W y is (A'WA)^-1 A'W C W A (A'WA)^-1 with the
covariance C of the heights. Errors that all windows have in common add to it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.decibels import DEVIATION_PER_MEDIAN
from clsas.interferometry.coherence import Window

_ROUNDS = 30  # of each iteration; a handful is usual
_OUTLIER = 4.0  # deviations; Gaussian errors exceed it at one place in 16 000
_SETTLED = 0.02  # rms last change of the modelled heights, in their deviations
# Errors of heights that change slowly over the swath, in deviations: the mean error on simulated
# dunes. Unlike noise, they do not average out.
_SYSTEMATIC = 0.05
_LEAST_RESIDUAL = 0.1  # deviations; smaller residuals have no larger weight in a sum of magnitudes


class Equations(NamedTuple):
    """Differences of heights that errors of the pair explain, NaN where a height is not known.

    Attributes
    ----------
    residual_m : float64 [n]
        Heights, corrected by the present values of the unknowns, minus those that are expected.
    per_unknown_m : float64 [n, unknowns]
        Their changes per unit of every unknown.
    sd_m : float64 [n]
        Their standard deviations.
    """

    residual_m: NDArray[np.float64]
    per_unknown_m: NDArray[np.float64]
    sd_m: NDArray[np.float64]

    @property
    def usable(self) -> NDArray[np.bool_]:
        """True where all numbers are finite, [n]."""
        finite = np.isfinite(self.residual_m) & np.isfinite(self.sd_m) & (self.sd_m > 0)
        return finite & np.isfinite(self.per_unknown_m).all(axis=1)


class Places(NamedTuple):
    """Pixels at which heights are compared, and the windows behind the heights.

    Attributes
    ----------
    row, column : int64 [n]
    shape : (rows, columns)
        Shape of the grid.
    window : Window
    """

    row: NDArray[np.int64]
    column: NDArray[np.int64]
    shape: tuple[int, ...]
    window: Window

    def correlated(
        self, some: NDArray[np.bool_], weights: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return sum_ij w_i rho_ij w_j over some places for weights w, [n, k], as [k, k]."""
        rasters = np.zeros((weights.shape[1], *self.shape))
        for raster, weight in zip(rasters, weights.T, strict=True):
            np.add.at(raster, (self.row[some], self.column[some]), weight[some])
        # A window summed over a window is the number of pixels that two windows share.
        shared = self.window.sums(self.window.sums(rasters)) / self.window.pixels
        return np.einsum("irc,jrc->ij", rasters, shared)


@dataclass(frozen=True, eq=False)
class Fit:
    """Unknowns that were fitted.

    Attributes
    ----------
    values : float64 [unknowns]
    covariance : float64 [unknowns, unknowns]
        Infinite if the unknowns cannot be told apart at all.
    equations : Equations
        Those at the values.
    used : bool [n]
        Places that were used: neither unknown nor outliers.
    samples : float
        Effective number of independent heights.
    misfit : float
        Rms residual in standard deviations.
    """

    values: NDArray[np.float64]
    covariance: NDArray[np.float64]
    equations: Equations
    used: NDArray[np.bool_]
    samples: float
    misfit: float

    @property
    def residual_m(self) -> float:
        """Rms residual, metres."""
        return float(np.sqrt(np.mean(self.equations.residual_m[self.used] ** 2)))


def fitted(
    equations_at: Callable[[NDArray[np.float64]], Equations], unknowns: int, places: Places
) -> Fit | None:
    """Return the unknowns that bring heights closest to those expected, without outliers.

    None if no height is known, if none is left of those used, or if the values do not settle.
    """
    values = np.zeros(unknowns)
    for _ in range(_ROUNDS):
        equations = equations_at(values)
        if not equations.usable.any():
            return None
        step, used = _robust_step(equations)
        values = values + step
        change = (equations.per_unknown_m[used] @ step) / equations.sd_m[used]
        if np.sqrt(np.mean(change**2)) < _SETTLED:
            settled = equations_at(values)
            kept = used & settled.usable
            return _described(values, settled, kept, places) if kept.any() else None
    return None


def _robust_step(equations: Equations) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the change of the unknowns, and which places are no outliers.

    It begins with the least sum of magnitudes, which a minority of wrong heights hardly changes.
    """
    usable = equations.usable
    sd_m = equations.sd_m[usable]
    design = -equations.per_unknown_m[usable] / sd_m[:, None]
    wanted = equations.residual_m[usable] / sd_m
    root = np.ones(len(wanted))
    for _ in range(_ROUNDS):
        step = _least_squares(design * root[:, None], wanted * root)
        root = 1 / np.sqrt(np.maximum(np.abs(wanted - design @ step), _LEAST_RESIDUAL))
    inside = np.ones(len(wanted), bool)
    for _ in range(_ROUNDS):
        before, distance = inside, np.abs(wanted - design @ step)
        inside = distance <= _OUTLIER * max(DEVIATION_PER_MEDIAN * float(np.median(distance)), 1.0)
        step = _least_squares(design[inside], wanted[inside])
        if np.array_equal(inside, before):
            break
    used = np.zeros_like(usable)
    used[np.flatnonzero(usable)[inside]] = True
    return step, used


def _least_squares(design: NDArray[np.float64], wanted: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.lstsq(design, wanted, rcond=None)[0], np.float64)


def _described(
    values: NDArray[np.float64],
    equations: Equations,
    used: NDArray[np.bool_],
    places: Places,
) -> Fit:
    """Return the fit with its deviations, which are scaled by the misfit where it exceeds 1."""
    residual = equations.residual_m[used] / equations.sd_m[used]
    count = int(used.sum())
    samples = count**2 / float(places.correlated(used, np.ones((len(used), 1)))[0, 0])
    left = samples - len(values)
    misfit = float(np.sqrt(np.mean(residual**2)))
    if left > 1:
        misfit *= np.sqrt(samples / left)
    scaled = np.zeros_like(equations.per_unknown_m)
    scaled[used] = equations.per_unknown_m[used] / equations.sd_m[used, None]
    normal = scaled.T @ scaled
    size = np.sqrt(np.diag(normal))
    covariance = np.full_like(normal, np.inf)
    if size.all() and np.linalg.cond(normal / np.outer(size, size)) < 1e12:
        inverse = np.linalg.inv(normal)
        covariance = inverse @ places.correlated(used, scaled) @ inverse
        covariance *= max(misfit, 1.0) ** 2 if left > 1 else 1.0
        covariance += _SYSTEMATIC**2 * count * inverse
    return Fit(values, covariance, equations, used, samples, misfit)
