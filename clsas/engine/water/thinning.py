"""Profiles of fewer depths with the same travel times, for casts of thousands of depths."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.sound_speed import SoundSpeed

FEW = 64
"""Number of depths up to which a profile stays as it is. The time of rays grows with the depths."""

VERTICAL_ERROR_S = 2e-10
"""Largest error of vertical travel times, seconds: 0.0003 mm. For a ray of slope angle a it is at
most twice as much over sin(a), 2e-9 s at 11 degrees: 1/800 of a wavelength at 600 kHz."""

_WORTH = 0.5  # share of the depths beyond which fewer are not worth the search
_MOST = 400  # depths of a thinned profile; the time of a fit has their cube


@lru_cache(maxsize=8)
def thinned(profile: SoundSpeed) -> SoundSpeed:
    """Return a profile of fewer depths with nearly the same travel times, or the profile itself.

    Parameters
    ----------
    profile : SoundSpeed

    Returns
    -------
    SoundSpeed
        Profile between the same depths, whose vertical travel times from its first depth to all
        others differ by at most `VERTICAL_ERROR_S`.

    Notes
    -----
    The time over a slope is the integral of c^-1/sin(a) over depth. Errors of the speed that
    alternate with depth, such as the noise of a probe, cancel there. Speeds at a few depths are
    therefore fitted so that the *integral* of their errors is small everywhere, by least squares.
    Where it is not, depths are added in the middle.
    """
    depth, speed = profile.depth_m, profile.speed_m_s
    if len(depth) <= FEW:
        return profile
    allowed = VERTICAL_ERROR_S * float(speed.min()) ** 2  # of the integral of errors, m^2/s
    kept = np.array([0, len(depth) - 1])
    while len(kept) <= min(_WORTH * len(depth), _MOST):
        fitted, error = _fitted(depth, speed, kept)
        wrong = np.abs(error) > allowed
        if not wrong.any():
            return _profile(depth[kept], fitted, profile)
        pieces = np.unique(np.searchsorted(kept, np.flatnonzero(wrong)).clip(1) - 1)
        middles = (kept[pieces] + kept[pieces + 1]) // 2
        more = np.union1d(kept, middles)
        if len(more) == len(kept):  # the wrong pieces cannot be divided, but those beside them
            more = np.union1d(kept, (kept[:-1] + kept[1:]) // 2)
        kept = more
    return profile


def vertical_errors_s(profile: SoundSpeed, z_m: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Return by how much thinning shortens travel times from the first depth to heights, [...]."""
    fewer = thinned(profile)
    away = 1 / profile.speed_m_s - 1 / np.interp(profile.depth_m, fewer.depth_m, fewer.speed_m_s)
    error_s = np.append(0.0, np.cumsum(np.diff(profile.depth_m) * (away[:-1] + away[1:]) / 2))
    return np.interp(profile.surface_z_m - z_m, profile.depth_m, error_s)


def _profile(
    depth: NDArray[np.float64], speed: NDArray[np.float64], given: SoundSpeed
) -> SoundSpeed:
    """Return the thinned profile, or the given one if fitted speeds are not those of water.

    At the ends of a steep layer they overshoot, and may change by more than a profile allows.
    """
    try:
        return SoundSpeed(depth, speed, given.surface_z_m)
    except ValueError:
        return given


def _fitted(
    depth: NDArray[np.float64], speed: NDArray[np.float64], kept: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return speeds at kept depths, and the integrals of their errors around every depth.

    Of a depth and the middle of the layer below it, the larger error counts.
    """
    start = speed[kept]
    away = speed - np.interp(depth, depth[kept], start)
    change = _least_squares(depth, _integral(depth, away), kept)
    fitted = start + change
    error = _integral(depth, away - np.interp(depth, depth[kept], change))
    away = speed - np.interp(depth, depth[kept], fitted)
    below = error[:-1] + np.diff(depth) * (3 * away[:-1] + away[1:]) / 8
    error[:-1] = np.maximum(np.abs(error[:-1]), np.abs(below))
    return fitted, error


def _least_squares(
    depth: NDArray[np.float64], wanted: NDArray[np.float64], kept: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return changes at kept depths whose integral fits some values best, [kept].

    At a depth d below the start of a piece of thickness h, the integral of changes from c to e is

        S + c (d - d^2/(2 h)) + e d^2/(2 h)

    with the integral S down to that start. However many depths a piece has, these are three
    unknowns: orthogonal transformations reduce its equations to as many.
    """
    edges = depth[kept]
    thickness = np.diff(edges)
    halves = np.zeros((len(kept), len(kept)))  # of the integral of every piece
    below = np.arange(1, len(kept))
    halves[below, below - 1] = halves[below, below] = thickness / 2
    of_starts = halves.cumsum(axis=0)
    equations, values = [], []
    for piece, (first, last) in enumerate(pairwise([0, *(kept[1:-1]), len(depth)])):
        d = depth[first:last] - edges[piece]
        later = d**2 / (2 * thickness[piece])
        rows = np.column_stack([np.ones_like(d), d - later, later, wanted[first:last]])
        reduced = np.asarray(np.linalg.qr(rows, mode="r"))[:3]
        equation = reduced[:, :1] * of_starts[piece]
        equation[:, piece : piece + 2] += reduced[:, 1:3]
        equations.append(equation)
        values.append(reduced[:, 3])
    return np.linalg.lstsq(np.concatenate(equations), np.concatenate(values), rcond=None)[0]


def _integral(depth: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the integrals of values from the first depth down to every other."""
    pieces = np.diff(depth) * (values[:-1] + values[1:]) / 2
    return np.append(0.0, pieces.cumsum())
