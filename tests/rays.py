"""Travel times along rays, computed without clsas."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

_HALVINGS = 34  # of a factor of e in the slope of a ray; the time has the square of the error
_STEEPENINGS = 7  # each makes a ray e^2 times less steep
_STRAIGHT_PER_S = 1e-4  # gradient of the speed below which rays are straight, to 1e-12 of the time


def rays(
    depth_m: ArrayLike,
    speed_m_s: ArrayLike,
    distance_m: ArrayLike,
    one_depth_m: ArrayLike,
    other_depth_m: ArrayLike,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return travel times, and horizontal slownesses, of rays that fall all the way.

    Parameters
    ----------
    depth_m, speed_m_s : float64 [n]
        Profile of the sound speed, linear between its depths.
    distance_m, one_depth_m, other_depth_m : array_like of float
        Horizontal distances and depths of pairs of positions; they broadcast.

    Returns
    -------
    time_s, slowness_s_m : float64
        Both are NaN where the positions are level, or the ray would have to turn.

    Notes
    -----
    With w = sqrt(1 - (p c)^2), a layer of gradient g adds (w_1 - w_2)/(p g) to the distance, and
    ln(c_2 (1 + w_1)/(c_1 (1 + w_2)))/g to the time (Jensen, Kuperman, Porter, Schmidt 2011). The
    slowness p is bisected. By Fermat's principle its error hardly matters to the time.
    """
    edges, speeds = (np.asarray(each, np.float64) for each in (depth_m, speed_m_s))
    distance, one, other = np.broadcast_arrays(distance_m, one_depth_m, other_depth_m)
    upper, lower = (pick(one, other) for pick in (np.minimum, np.maximum))
    distance = np.maximum(distance, 1e-9 * (lower - upper))
    ends = [(np.clip(upper, a, b), np.clip(lower, a, b)) for a, b in pairwise(edges)]
    layers = [
        (bottom - top, *(np.interp(each, edges, speeds) for each in (top, bottom)))
        for top, bottom in ends
    ]
    with np.errstate(divide="ignore", invalid="ignore"):
        fastest = np.max([np.where(h > 0, np.maximum(a, b), 0) for h, a, b in layers], axis=0)
        # Rays are nowhere nearer the horizontal than at the fastest place.
        low = np.log(distance / (lower - upper))
        high = low + 1
        for _ in range(_STEEPENINGS):
            beyond = _fallen(layers, fastest, high)[1] < distance
            high = np.where(beyond, high + 2, high)
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            beyond = _fallen(layers, fastest, middle)[1] > distance
            low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
        time, reached, slowness = _fallen(layers, fastest, (low + high) / 2)
        found = np.abs(reached - distance) < 1e-6 * (distance + lower - upper)
        time = time + slowness * (distance - reached)
    return np.where(found, time, np.nan), np.where(found, slowness, np.nan)


def _fallen(
    layers: Sequence[tuple[NDArray[np.float64], ...]],
    fastest: NDArray[np.float64],
    steepness: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the times, distances and slownesses of rays through layers.

    `steepness` is the logarithm of the tangent of their angle from the vertical at the fastest
    place.
    """
    slowness = 1 / fastest / np.sqrt(1 + np.exp(-2 * steepness))
    time, distance = np.zeros(slowness.shape), np.zeros(slowness.shape)
    for thickness, above, below in layers:
        w_above, w_below = (
            np.sqrt(np.maximum(1 - (slowness * each) ** 2, 0)) for each in (above, below)
        )
        gradient = (below - above) / thickness
        bends = np.abs(gradient) > _STRAIGHT_PER_S
        mean, w = (above + below) / 2, (w_above + w_below) / 2
        bent_s = np.log(below * (1 + w_above) / (above * (1 + w_below))) / gradient
        bent_m = (w_above - w_below) / (slowness * gradient)
        crossed = thickness > 0
        time += np.where(crossed, np.where(bends, bent_s, thickness / (mean * w)), 0)
        distance += np.where(crossed, np.where(bends, bent_m, thickness * slowness * mean / w), 0)
    return time, distance, slowness
