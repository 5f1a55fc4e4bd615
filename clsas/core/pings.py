"""Transmissions of range lines: where each was made, and which were made standing still.

`RangeLines.ping_starts` begins a ping where the transmitter moves. Transmissions also tell apart
pings that a platform takes at one place. Both are the same on a platform that never stands still.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsas.core import validate

if TYPE_CHECKING:
    from clsas.core.lines import RangeLines

STILL = 0.1
"""Share of the usual advance within which a platform counts as standing still."""
_LEAST_HALT = 5  # pings; noisy positions bring two or three together without any halt
_DISORDER = 0.03  # share of pings that turn back, above which steps tell nothing of halts and gaps
_UNEVEN = 0.25  # interquartile range of steps over their median, above which they are uneven
_LOCAL = 11  # steps averaged for the local course
_USUAL_QUANTILE = 0.95  # of steps: leaves out up to 5 % of gaps, and holds with 95 % standing still


@dataclass(frozen=True, eq=False)
class Transmissions:
    """Channels by transmission.

    A transmission ends where the transmitter's position changes, and also where its first
    receiver's position comes again: a platform that stands still repeats its positions.

    Attributes
    ----------
    starts : int64 [transmissions + 1]
        First channel of every transmission, and one past the last.
    centres_m : float64 [transmissions, 3]
        Mean phase centre of every transmission.
    places_m : float64 [transmissions, 3]
        Place of the platform: the phase centre, or the mean of the receivers where these advance
        more evenly, as with transmitters that alternate fore and aft.
    """

    starts: NDArray[np.int64]
    centres_m: NDArray[np.float64]
    places_m: NDArray[np.float64]

    @classmethod
    def of(cls, lines: RangeLines) -> Transmissions:
        """Return the transmissions of range lines."""
        first_rx_m = lines.rx_m[lines.ping_starts][lines.ping_numbers]
        starts = np.flatnonzero((lines.rx_m == first_rx_m).all(axis=1))
        centres_m = means(lines.phase_centres_m, starts)
        places_m = _more_even(centres_m, means(lines.rx_m, starts))
        return cls(np.append(starts, lines.channels), centres_m, places_m)

    @property
    def count(self) -> int:
        """Number of transmissions."""
        return len(self.centres_m)

    @property
    def receivers(self) -> NDArray[np.int64]:
        """Channels of every transmission."""
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
        """Return which transmissions are not made standing still.

        Parameters
        ----------
        least_m : float, optional
            Distance from the last one that advances, metres. By default `STILL` of the usual
            advance, and only five or more transmissions in a row count as a halt, or those that
            repeat the place of the one before: noisy positions bring single ones together.
        """
        if least_m is not None:
            return self._beyond(least_m)
        still = ~self._beyond(STILL * self.usual_step_m)
        edges = np.flatnonzero(np.diff(still, prepend=False, append=False)).reshape(-1, 2)
        for first, stop in edges[np.diff(edges, axis=1)[:, 0] + 1 < _LEAST_HALT]:
            # The halt begins with the transmission before, which counts as advancing.
            still[first:stop] = self.steps_m[first - 1 : stop - 1] == 0
        return ~still

    def _beyond(self, least_m: float) -> NDArray[np.bool_]:
        """Return which transmissions lie at least `least_m` from the last one that did."""
        kept = np.zeros(self.count, bool)
        last_m = None
        for number, place_m in enumerate(self.places_m.tolist()):
            if last_m is None or math.dist(place_m, last_m) >= least_m > 0:
                kept[number], last_m = True, place_m
        return kept

    @property
    def turns(self) -> NDArray[np.int64]:
        """Numbers of the transmissions after which the track leads against its local course."""
        from scipy.ndimage import uniform_filter1d  # slow to import

        numbers = np.flatnonzero(self._beyond(STILL * self.usual_step_m))
        moves_m = np.diff(self.places_m[numbers], axis=0)
        if len(moves_m) < 2:
            return np.zeros(0, np.int64)
        # The mean direction of a few steps: a track may turn, but not from one ping to the next.
        moves_m /= np.linalg.norm(moves_m, axis=1, keepdims=True)
        course = uniform_filter1d(moves_m, min(_LOCAL, len(moves_m)), axis=0)
        return numbers[np.flatnonzero(np.einsum("pi,pi->p", moves_m, course) < 0)]

    @property
    def disordered(self) -> bool:
        """True if more than 3 % of the transmissions turn back; steps then tell nothing of gaps."""
        return self.turns.size > _DISORDER * self.count

    def channels(self, some: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Return the channels of some transmissions, given as a mask."""
        return np.flatnonzero(np.repeat(some, self.receivers))


def without_still_pings(lines: RangeLines, least_advance_m: float | None) -> RangeLines:
    """Drop pings taken standing still; see `RangeLines.without_still_pings`."""
    if least_advance_m is not None:
        least_advance_m = validate.positive("least_advance_m", least_advance_m, "m")
    found = Transmissions.of(lines)
    kept = found.advancing(least_advance_m)
    if kept.sum() < min(2, found.count):
        near = (
            "are at one place"
            if least_advance_m is None
            else f"lie within least_advance_m = {least_advance_m:g} m"
        )
        raise ValueError(
            f"lines must be of a platform that moves: of {found.count} pings ({lines.channels} "
            f"lines) only the first would stay, for all {near}. Check the positions"
        )
    return lines if kept.all() else lines.select(found.channels(kept))


def means(values: NDArray[np.float64], starts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the means of vectors [channels, 3] over pings that start at some channels."""
    counts = np.diff(np.append(starts, len(values)))
    return np.add.reduceat(values, starts, axis=0) / counts[:, None]


def _more_even(centres_m: NDArray[np.float64], rx_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the phase centres, or the receivers' means if only these advance evenly."""
    uneven, of_rx = _unevenness(centres_m), _unevenness(rx_m)
    return rx_m if uneven > _UNEVEN and of_rx < _UNEVEN / 2 else centres_m


def _unevenness(places_m: NDArray[np.float64]) -> float:
    """Return the interquartile range of steps over their median."""
    steps_m = _steps_m(places_m)
    low_m, usual_m, high_m = np.quantile(steps_m, (0.25, 0.5, 0.75)) if steps_m.size else (0, 0, 0)
    return float(high_m - low_m) / float(usual_m) if usual_m else math.inf


def _steps_m(places_m: NDArray[np.float64]) -> NDArray[np.float64]:
    steps_m: NDArray[np.float64] = np.linalg.norm(np.diff(places_m, axis=0), axis=1)
    return steps_m
