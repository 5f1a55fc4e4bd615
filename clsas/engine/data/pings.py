"""Pings: which channels were received from one transmission, and whether the platform moved.

Range lines have positions but no times, so pings follow from the positions. Consecutive channels
with one transmitter position are a ping (`ping_starts`). A platform that stands still transmits
several times from one position. `Transmissions` are pings where that matters: a ping also begins
where the first receiver's position comes again. Both agree for a platform that never stands still.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.geometry import unit_vectors

STILL = 0.1
"""Share of the usual advance within which a platform counts as standing still."""
PASS_JUMP = 8.0
"""Step over the median step from which on another pass, or leg, of the track begins."""
COURSE_STEPS = 11
"""Steps that are averaged to find the local course."""
# Pings of the shortest halt. Noise in positions brings two or three pings together without a halt.
_LEAST_HALT = 5
# Share of pings after which the track turns back. If it is larger, the pings are out of order, and
# the steps between them show neither halts nor gaps.
_DISORDER = 0.03
_UNEVEN = 0.25  # interquartile range of steps over their median, above which they are uneven
# Quantile of the steps that represents a step of a moving platform. Up to 5 % of the steps may be
# gaps, and up to 95 % may be taken standing still.
_USUAL_QUANTILE = 0.95


def ping_starts(tx_m: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the first channel of every ping, [pings].

    Consecutive channels with one transmitter position, `tx_m` [channels, 3], are a ping.
    """
    return np.flatnonzero(np.append(True, (np.diff(tx_m, axis=0) != 0).any(axis=1)))


def channels_per_ping(starts: NDArray[np.int64], channels: int) -> NDArray[np.int64]:
    """Return the number of channels of every ping, given the first channels and their number."""
    return np.diff(np.append(starts, channels))


def ping_numbers(starts: NDArray[np.int64], channels: int) -> NDArray[np.int64]:
    """Return the number of every channel's ping, [channels]."""
    return np.repeat(np.arange(len(starts)), channels_per_ping(starts, channels))


@dataclass(frozen=True, eq=False)
class Transmissions:
    """Pings of range lines, where several may have been transmitted from one position.

    Attributes
    ----------
    starts : int64 [transmissions + 1]
        First channel of every transmission, followed by the number of channels.
    centres_m : float64 [transmissions, 3]
        Mean phase centre of every transmission, metres.
    places_m : float64 [transmissions, 3]
        Position of the platform, metres. It is the mean phase centre, or the mean receiver position
        where the receivers advance more evenly, as with transmitters that alternate fore and aft.
    """

    starts: NDArray[np.int64]
    centres_m: NDArray[np.float64]
    places_m: NDArray[np.float64]

    @classmethod
    def of(cls, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]) -> Transmissions:
        """Return the transmissions, from the positions of the channels' antennas, [channels, 3].

        Among the channels with one transmitter position, a transmission begins wherever the
        position of the first receiver comes again.
        """
        of_position = ping_starts(tx_m)
        first_rx_m = rx_m[of_position][ping_numbers(of_position, len(tx_m))]
        starts = np.flatnonzero((rx_m == first_rx_m).all(axis=1))
        centres_m, mean_rx_m = means((tx_m + rx_m) / 2, starts), means(rx_m, starts)
        alternating = _unevenness(centres_m) > _UNEVEN and _unevenness(mean_rx_m) < _UNEVEN / 2
        places_m = mean_rx_m if alternating else centres_m
        return cls(np.append(starts, len(tx_m)), centres_m, places_m)

    @property
    def count(self) -> int:
        """Number of transmissions."""
        return len(self.centres_m)

    @property
    def receivers(self) -> NDArray[np.int64]:
        """Number of channels of every transmission."""
        return np.diff(self.starts)

    @property
    def steps_m(self) -> NDArray[np.float64]:
        """Distance from every transmission to the next, metres."""
        return _steps_m(self.places_m)

    @property
    def usual_step_m(self) -> float:
        """Median advance while the platform moves, metres; 0 if it never does."""
        steps_m = self.steps_m[self.steps_m > 0]
        if not steps_m.size:
            return 0.0
        most_m = np.quantile(steps_m, _USUAL_QUANTILE, method="lower")
        return float(np.median(steps_m[steps_m >= STILL * most_m]))

    def advancing(self, least_m: float | None = None) -> NDArray[np.bool_]:
        """Return a mask of the transmissions that were not made standing still.

        Parameters
        ----------
        least_m : float, optional
            Least distance from the previous transmission in the mask, metres. By default it is
            `STILL` times the usual advance. Because noise in positions brings single transmissions
            together, the default drops only runs of five or more, and those that repeat the
            position of the one before exactly.
        """
        if least_m is not None:
            return self._beyond(least_m)
        still = ~self._beyond(STILL * self.usual_step_m)
        edges = np.flatnonzero(np.diff(still, prepend=False, append=False)).reshape(-1, 2)
        for first, stop in edges[np.diff(edges, axis=1)[:, 0] + 1 < _LEAST_HALT]:
            # The halt begins with the transmission before, which still counts as advancing.
            still[first:stop] = self.steps_m[first - 1 : stop - 1] == 0
        return ~still

    def _beyond(self, least_m: float) -> NDArray[np.bool_]:
        """Return a mask of transmissions, each at least `least_m` from the previous one in it."""
        kept = np.zeros(self.count, bool)
        last_m = None
        for number, place_m in enumerate(self.places_m.tolist()):
            if last_m is None or math.dist(place_m, last_m) >= least_m > 0:
                kept[number], last_m = True, place_m
        return kept

    @property
    def turns(self) -> NDArray[np.int64]:
        """Numbers of the transmissions after which the track turns back on its local course."""
        from scipy.ndimage import uniform_filter1d  # slow to import

        numbers = np.flatnonzero(self._beyond(STILL * self.usual_step_m))
        moves = unit_vectors(np.diff(self.places_m[numbers], axis=0))
        if len(moves) < 2:
            return np.zeros(0, np.int64)
        # The local course is the mean direction of a few steps. A track may turn over many pings,
        # but not from one ping to the next.
        course = uniform_filter1d(moves, min(COURSE_STEPS, len(moves)), axis=0)
        return numbers[np.flatnonzero(np.einsum("pi,pi->p", moves, course) < 0)]

    @property
    def disordered(self) -> bool:
        """True if the track turns back after more than 3 % of the transmissions.

        The pings are then out of order, and steps between them do not show gaps.
        """
        return self.turns.size > _DISORDER * self.count

    def channels(self, some: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Return the channels of the transmissions in a mask."""
        return np.flatnonzero(np.repeat(some, self.receivers))


def means(values: NDArray[np.float64], starts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the mean over every ping of vectors [channels, 3], given the pings' first channels."""
    counts = channels_per_ping(starts, len(values))
    return np.add.reduceat(values, starts, axis=0) / counts[:, None]


def _unevenness(places_m: NDArray[np.float64]) -> float:
    """Return the interquartile range of steps over their median."""
    steps_m = _steps_m(places_m)
    low_m, usual_m, high_m = np.quantile(steps_m, (0.25, 0.5, 0.75)) if steps_m.size else (0, 0, 0)
    return float(high_m - low_m) / float(usual_m) if usual_m else math.inf


def _steps_m(places_m: NDArray[np.float64]) -> NDArray[np.float64]:
    steps_m: NDArray[np.float64] = np.linalg.norm(np.diff(places_m, axis=0), axis=1)
    return steps_m
