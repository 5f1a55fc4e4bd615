"""Direction of the track at every channel, from the channels' phase centres."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from clsas.engine.data.lines import RangeLines

MOST_TRACK_PINGS = 101
"""Most pings over which the track's direction is smoothed by default."""

_SMOOTHED_SHARE = 4  # by default a cubic is fitted to a quarter of the pings
_NEW_LEG = 10.0  # step between pings, in median steps, from which on a new leg of the track begins
_SHORTEST_LEG = 5  # pings: those that a cubic needs, and one more
_JUMPS = 0.05  # share of steps to other places from which on pings are out of order; of legs of 20
_WINDING = 4.0  # length of a track over its extent up to which the order is not questioned
_MOST_SORTED = 20_000  # pings, which take 2 s


def track_directions(lines: RangeLines, pings: int | None = None) -> NDArray[np.float64]:
    """Return the unit direction of the track at every channel, float64 [channels, 3].

    Local cubics are fitted to the mean phase centres of the pings by least squares (Savitzky and
    Golay 1964). Their tangents are interpolated to each channel. Legs of a track that are far apart
    are smoothed separately. Channels may be in any order: if pings jump, each follows the nearest
    one, in the direction in which most of them advance.

    Parameters
    ----------
    lines : RangeLines
    pings : int, optional
        Number of pings that each fit spans. The default is a quarter of all pings, between 5 and
        101.

    Raises
    ------
    ValueError
        If there is only one ping, or the platform stands still.
    """
    if (order := _along_track(lines)) is not None:
        found = np.empty((lines.channels, 3))
        found[order] = _directions(lines.without_samples().select(order), pings)
        return found
    return _directions(lines, pings)


def _directions(lines: RangeLines, pings: int | None) -> NDArray[np.float64]:
    """Return the direction of the track at every channel, whose order follows the track."""
    channels_m = lines.phase_centres_m
    count = len(lines.ping_starts)
    if count < 2:
        raise ValueError(
            f"along must be given: {lines.channels} channels with one transmitter position have "
            f"no track"
        )
    centres_m = lines.ping_centres_m
    span = pings or min(max(count // _SMOOTHED_SHARE, 5), MOST_TRACK_PINGS)
    tangent = np.concatenate([_tangents(leg_m, span) for leg_m in _legs(centres_m)])
    speed = np.linalg.norm(tangent, axis=1)
    extent_m = np.linalg.norm(np.ptp(centres_m, axis=0))
    if not speed.min() > 1e-3 * extent_m / count:
        raise ValueError(
            "along must be given: the phase centres of the lines stand still around ping "
            f"{speed.argmin()}; lines.without_still_pings() drops such pings"
        )
    tangent /= speed[:, None]
    # The front channels of a long array lie where the middle of later pings will be.
    ping = lines.ping_numbers
    steps_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1)
    travelled_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    ahead_m = channels_m - centres_m[ping]
    at_m = travelled_m[ping] + np.einsum("ci,ci->c", ahead_m, tangent[ping])
    found = np.stack([np.interp(at_m, travelled_m, each) for each in tangent.T], axis=-1)
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def _along_track(lines: RangeLines) -> NDArray[np.int64] | None:
    """Return the order in which channels follow the track; None if theirs does."""
    centres_m = lines.ping_centres_m
    steps_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1)
    if steps_m.sum() <= _WINDING * np.linalg.norm(np.ptp(centres_m, axis=0)):
        return None
    pings_m, ping = np.unique(lines.tx_m, axis=0, return_inverse=True)
    if not 2 * _SHORTEST_LEG < len(pings_m) <= _MOST_SORTED:
        return None
    ping = ping.ravel()
    from scipy.spatial import cKDTree  # slow to import

    apart_m = np.median(cKDTree(pings_m).query(pings_m, k=2)[0][:, 1])
    if np.mean(steps_m > _NEW_LEG * apart_m) <= _JUMPS:
        return None
    rank = np.empty(len(pings_m), np.int64)
    left_m = pings_m.copy()
    at = int(np.argmax(np.linalg.norm(pings_m - pings_m.mean(axis=0), axis=1)))  # an end
    for number in range(len(pings_m)):
        rank[at] = number
        here_m, left_m[at] = pings_m[at], np.inf
        at = int(np.argmin(np.sum((left_m - here_m) ** 2, axis=1)))
    if np.count_nonzero(np.diff(rank[ping]) < 0) > np.count_nonzero(np.diff(rank[ping]) > 0):
        rank = rank.max() - rank
    return np.argsort(rank[ping], kind="stable")


def _legs(centres_m: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the phase centres of the pings, [n, 3], split where the track jumps."""
    steps_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1)
    median_m = np.median(steps_m)
    starts = [0]
    for start in np.flatnonzero(steps_m > _NEW_LEG * median_m) + 1 if median_m else ():
        if min(start - starts[-1], len(centres_m) - start) >= _SHORTEST_LEG:
            starts.append(int(start))
    return np.split(centres_m, starts[1:])


def _tangents(centres_m: NDArray[np.float64], pings: int) -> NDArray[np.float64]:
    """Return the tangents of local cubics through `pings` pings of one leg, [n, 3]."""
    count = len(centres_m)
    # The filter needs an odd number of pings, and a cubic at least four.
    window = min(2 * (pings // 2) + 1, count - 1 + count % 2)
    if window < 2:
        return np.diff(centres_m, axis=0).repeat(2, axis=0)
    # scipy.signal has this filter, but importing it takes longer than planning most images.
    half = window // 2
    powers = np.vander(np.arange(-half, half + 1), min(3, window - 1) + 1, increasing=True)
    fit = np.linalg.pinv(powers.astype(np.float64))  # coefficients of the cubic, from positions
    tangents = correlate1d(centres_m, fit[1], axis=0)
    # The first and the last cubic are also used for the pings before and after their middle.
    orders = np.arange(powers.shape[1])
    slopes = orders[1:] * np.vander(np.arange(-half, half + 1), len(orders) - 1, increasing=True)
    tangents[: half + 1] = slopes[: half + 1] @ (fit @ centres_m[:window])[1:]
    tangents[-half - 1 :] = slopes[half:] @ (fit @ centres_m[-window:])[1:]
    return tangents
