"""Channels of consecutive pings that share phase centres."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from clsas.core.lines import RangeLines

_MOST_APART = 0.5
"""Distance along the array within which two phase centres count as one, in spacings of the array.
It is the largest that can occur within an overlap."""


@dataclass(frozen=True, eq=False)
class Array:
    """The receivers' phase centres, ping by ping.

    Attributes
    ----------
    starts : int64 [pings + 1]
        First channel of every ping, and one past the last.
    reference_m : float64 [pings, 3]
        Mean phase centre of every ping, about which the platform turns.
    forward : float64 [pings, 3]
        Horizontal unit vector along the array, in the direction in which it advances. An array at
        rest has the direction from its first receiver to its last.
    port : float64 [pings, 3]
        Horizontal unit vector to port.
    spacing_m : float
        Median distance between neighbouring phase centres.
    """

    starts: NDArray[np.int64]
    reference_m: NDArray[np.float64]
    forward: NDArray[np.float64]
    port: NDArray[np.float64]
    spacing_m: float

    @classmethod
    def of(cls, lines: RangeLines) -> Array:
        """Return the array of lines.

        Raises
        ------
        ValueError
            If there are fewer than two pings, or a ping of fewer than two receivers, or an array
            without horizontal extent.
        """
        starts = np.append(lines.ping_starts, lines.channels)
        counts = np.diff(starts)
        if len(counts) < 2:
            raise ValueError(
                "lines must hold at least 2 pings, got one (all channels share one transmitter "
                "position)"
            )
        if counts.min() < 2:
            raise ValueError(
                f"every ping of lines must have at least 2 receivers, got {counts.min()} in ping "
                f"{counts.argmin()}: without overlapping phase centres use clsas.autofocus"
            )
        centres_m = lines.phase_centres_m
        reference_m = lines.ping_centres_m
        forward = centres_m[starts[1:] - 1] - centres_m[starts[:-1]]
        forward[:, 2] = 0.0
        length_m = np.linalg.norm(forward, axis=1)
        if length_m.min() <= 0:
            raise ValueError(
                f"the receivers of a ping must extend horizontally, got none in ping "
                f"{length_m.argmin()}"
            )
        forward /= length_m[:, None]
        # Receivers may be numbered from either end: forward is where the array goes.
        advance_m = np.gradient(reference_m, axis=0)
        forward[np.einsum("pi,pi->p", forward, advance_m) < 0] *= -1
        port = np.stack([-forward[:, 1], forward[:, 0], np.zeros(len(forward))], axis=1)
        at_m = np.einsum("ci,ci->c", centres_m, np.repeat(forward, counts, axis=0))
        neighbours = np.ones(len(at_m) - 1, bool)
        neighbours[starts[1:-1] - 1] = False  # from a ping to the next
        spacing_m = float(np.median(np.abs(np.diff(at_m)[neighbours])))
        return cls(starts, reference_m, forward, port, spacing_m)

    @property
    def pings(self) -> int:
        """Number of pings."""
        return len(self.reference_m)

    def channels(self, ping: int) -> NDArray[np.int64]:
        """Return the channels of a ping."""
        return np.arange(self.starts[ping], self.starts[ping + 1])


@dataclass(frozen=True, eq=False)
class Overlap:
    """Channels of a ping and of the next with nearly one phase centre.

    Attributes
    ----------
    first, second : int64 [pairs]
        Channels of the ping, and of the next.
    along_m : float64 [pairs]
        Where their phase centres lie along the array, from the middle of the overlap.
    pivot_m : float64 [3]
        The middle of the overlap.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    along_m: NDArray[np.float64]
    pivot_m: NDArray[np.float64]

    @property
    def pairs(self) -> int:
        """Number of pairs of channels."""
        return len(self.first)


def overlap(
    lines: RangeLines, array: Array, ping: int, heard: NDArray[np.bool_] | None = None
) -> Overlap:
    """Return the overlap of a ping with the next, of the channels [channels] that are `heard`."""
    centres_m, forward = lines.phase_centres_m, array.forward[ping]
    here, there = array.channels(ping), array.channels(ping + 1)
    if heard is not None:
        here, there = here[heard[here]], there[heard[there]]
    if min(len(here), len(there)) < 2:
        none = np.zeros(0, np.int64)
        return Overlap(none, none, np.zeros(0), array.reference_m[ping])
    origin_m = array.reference_m[ping]
    at, at_next = ((centres_m[each] - origin_m) @ forward for each in (here, there))
    order = np.argsort(at_next, kind="stable")
    sorted_at = at_next[order]
    after = np.clip(np.searchsorted(sorted_at, at), 1, len(sorted_at) - 1)
    nearest = after - (at - sorted_at[after - 1] < sorted_at[after] - at)
    apart_m = np.abs(sorted_at[nearest] - at)
    paired = np.flatnonzero(apart_m <= _MOST_APART * array.spacing_m * (1 + 1e-6))
    # Of two channels that choose the same one, the nearer keeps it.
    paired = paired[np.argsort(apart_m[paired], kind="stable")]
    _, unique = np.unique(nearest[paired], return_index=True)
    paired = np.sort(paired[unique])
    first, second = here[paired], there[order[nearest[paired]]]
    middle_m = (centres_m[first] + centres_m[second]) / 2
    pivot_m = middle_m.mean(axis=0) if len(first) else origin_m
    return Overlap(first, second, (middle_m - pivot_m) @ forward, pivot_m)


def moved(
    lines: RangeLines,
    array: Array,
    sway_m: NDArray[np.float64],
    yaw_rad: NDArray[np.float64],
    surge_m: NDArray[np.float64],
) -> RangeLines:
    """Return lines whose array lies further to port and forward and is turned about z, by ping.

    The array turns about its mean phase centre, positive yaw from forward to port.
    """
    ping = np.repeat(np.arange(array.pings), np.diff(array.starts))
    turn = Rotation.from_rotvec(np.outer(yaw_rad, [0.0, 0.0, 1.0]))
    shift_m = (sway_m[:, None] * array.port + surge_m[:, None] * array.forward)[ping]
    reference_m = array.reference_m[ping]
    tx_m, rx_m = (
        turn[ping].apply(each - reference_m) + reference_m + shift_m
        for each in (lines.tx_m, lines.rx_m)
    )
    return replace(lines, tx_m=tx_m, rx_m=rx_m)
