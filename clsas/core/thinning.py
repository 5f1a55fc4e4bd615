"""Profiles of fewer depths with the same travel times, for casts of thousands of depths."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from clsas.core.sound_speed import SoundSpeed

FEW = 64
"""Number of depths up to which a profile stays as it is. The time of rays grows with the depths."""

VERTICAL_ERROR_S = 2e-10
"""Largest error of vertical travel times, seconds: 0.0003 mm. For a ray of slope angle a it is at
most twice as much over sin(a), 2e-9 s at 11 degrees: 1/800 of a wavelength at 600 kHz."""

_WORTH = 0.5  # share of the depths beyond which fewer are not worth the search
_MOST = 400  # depths of a thinned profile; the time of a fit has their square


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
    piece = np.searchsorted(kept, np.arange(len(depth)), side="right").clip(1, len(kept) - 1) - 1
    share = (depth - depth[kept[piece]]) / (depth[kept[piece + 1]] - depth[kept[piece]])
    hats = np.zeros((len(depth), len(kept)))
    rows = np.arange(len(depth))
    hats[rows, piece], hats[rows, piece + 1] = 1 - share, share
    start = speed[kept]
    wanted = _integral(depth, (speed - hats @ start)[:, None])[:, 0]
    basis = _integral(depth, hats)
    change = np.linalg.lstsq(basis, wanted, rcond=None)[0]
    fitted, error = start + change, wanted - basis @ change
    away = speed - hats @ fitted
    below = error[:-1] + np.diff(depth) * (3 * away[:-1] + away[1:]) / 8
    error[:-1] = np.maximum(np.abs(error[:-1]), np.abs(below))
    return fitted, error


def _integral(depth: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the integrals of columns of values from the first depth down to every other."""
    pieces = np.diff(depth)[:, None] * (values[:-1] + values[1:]) / 2
    return np.concatenate([np.zeros((1, values.shape[1])), pieces.cumsum(axis=0)])
