"""Pairs of channels in consecutive pings that share a phase centre."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError

_MOST_APART = 0.5
"""Largest distance along the array, in spacings of the array, at which two phase centres are
paired. No channel within an overlap is farther than this from the nearest one of the other ping."""


@dataclass(frozen=True, eq=False)
class Array:
    """Phase centres of the receivers, ping by ping.

    Attributes
    ----------
    starts : int64 [pings + 1]
        First channel of every ping, and the number of channels as the last entry.
    reference_m : float64 [pings, 3]
        Mean phase centre of every ping, about which the platform turns.
    forward : float64 [pings, 3]
        Horizontal unit vectors along the array, in the direction in which it advances. For an array
        at rest, they point from its first receiver to its last.
    port : float64 [pings, 3]
        Horizontal unit vectors to port.
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
        """Return the array that recorded some range lines.

        Raises
        ------
        ValueError
            If there are fewer than two pings, if a ping has fewer than two receivers, or if the
            receivers of a ping have no horizontal extent.
        """
        starts = np.append(lines.ping_starts, lines.channels)
        counts = np.diff(starts)
        if len(counts) < 2:
            got = "one (all channels share one transmitter position)"
            raise ArgumentError("lines", "have at least 2 pings", got)
        if counts.min() < 2:
            raise ArgumentError(
                "lines",
                "have at least 2 receivers in every ping",
                f"{counts.min()} in ping {counts.argmin()}",
                "without overlapping phase centres, use `clsas.autofocus`",
            )
        centres_m = lines.phase_centres_m
        reference_m = lines.ping_centres_m
        forward = centres_m[starts[1:] - 1] - centres_m[starts[:-1]]
        forward[:, 2] = 0.0
        length_m = np.linalg.norm(forward, axis=1)
        if length_m.min() <= 0:
            raise ArgumentError(
                "lines",
                "have receivers at different horizontal positions in every ping",
                f"a horizontal extent of 0 m in ping {length_m.argmin()}",
            )
        forward /= length_m[:, None]
        # Receivers may be numbered from either end, so the advance decides which way is forward.
        advance_m = np.gradient(reference_m, axis=0)
        forward[np.einsum("pi,pi->p", forward, advance_m) < 0] *= -1
        port = np.stack([-forward[:, 1], forward[:, 0], np.zeros(len(forward))], axis=1)
        along_m = np.einsum("ci,ci->c", centres_m, np.repeat(forward, counts, axis=0))
        same_ping = np.ones(len(along_m) - 1, bool)
        same_ping[starts[1:-1] - 1] = False
        spacing_m = float(np.median(np.abs(np.diff(along_m)[same_ping])))
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
    """Pairs of channels of a ping and of the next one that nearly share a phase centre.

    Attributes
    ----------
    first, second : int64 [pairs]
        Channels of the ping, and of the next one.
    along_m : float64 [pairs]
        Positions of the phase centres along the array, relative to the middle of the overlap.
    pivot_m : float64 [3]
        Middle of the overlap.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    along_m: NDArray[np.float64]
    pivot_m: NDArray[np.float64]

    @property
    def pairs(self) -> int:
        """Number of pairs of channels."""
        return len(self.first)

    @property
    def spacing_m(self) -> float:
        """Median distance between neighbouring pairs along the array; 0 for a single pair."""
        steps_m = np.diff(np.sort(self.along_m))
        return float(np.median(steps_m)) if len(steps_m) else 0.0


def overlap(lines: RangeLines, array: Array, ping: int, usable: NDArray[np.bool_]) -> Overlap:
    """Return the overlap of a ping with the next one, of those channels that are `usable`."""
    centres_m, forward = lines.phase_centres_m, array.forward[ping]
    here, there = (each[usable[each]] for each in (array.channels(ping), array.channels(ping + 1)))
    origin_m = array.reference_m[ping]
    if min(len(here), len(there)) < 2:
        none = np.zeros(0, np.int64)
        return Overlap(none, none, np.zeros(0), origin_m)
    at_m, at_next_m = ((centres_m[each] - origin_m) @ forward for each in (here, there))
    order = np.argsort(at_next_m, kind="stable")
    sorted_m = at_next_m[order]
    after = np.clip(np.searchsorted(sorted_m, at_m), 1, len(sorted_m) - 1)
    nearest = after - (at_m - sorted_m[after - 1] < sorted_m[after] - at_m)
    apart_m = np.abs(sorted_m[nearest] - at_m)
    paired = np.flatnonzero(apart_m <= _MOST_APART * array.spacing_m * (1 + 1e-6))
    # If two channels have the same nearest partner, the nearer of them keeps it.
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
    """Return lines whose array is displaced to port and forward, and turned, ping by ping.

    The lines may have more channels than the array in each ping, such as those of other banks. All
    turn about a vertical axis through the array's mean phase centre. Positive yaw turns them from
    forward to port.
    """
    ping = lines.ping_numbers
    turn = Rotation.from_rotvec(np.outer(yaw_rad, [0.0, 0.0, 1.0]))
    shift_m = (sway_m[:, None] * array.port + surge_m[:, None] * array.forward)[ping]
    reference_m = array.reference_m[ping]
    tx_m, rx_m = (
        turn[ping].apply(each - reference_m) + reference_m + shift_m
        for each in (lines.tx_m, lines.rx_m)
    )
    look = lines.look_direction
    if look is not None:
        look = turn[ping].apply(look.copy())  # SciPy takes no read-only arrays
    return replace(lines, tx_m=tx_m, rx_m=rx_m, look_direction=look)
