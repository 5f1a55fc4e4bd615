"""Geometry of overlapping pings: the array, its displacements, and pairs of channels.

Channels of consecutive pings that share a phase centre see the same part of the seabed along the
same rays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from clsas.engine.data.geometry import bistatic_range_m
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError

_MOST_APART = 0.5
"""Largest distance along the array, in spacings of the array, at which two phase centres are
paired. No channel within an overlap is farther than this from the nearest one of the other ping."""
_CANCELLED = 1e-6  # length of the sum of two unit vectors below which they count as opposite


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


@dataclass(frozen=True, eq=False)
class Swath:
    """Part of the seabed that is measured, divided into windows of range.

    Attributes
    ----------
    edges_m : float64 [windows + 1]
        Ranges between windows, and at both ends.
    side : int
        1 if the seabed lies to port, -1 if it lies to starboard.
    seabed_z_m : float or None
        Height of the seabed. With None, all rays are horizontal.
    element_length_m : (transmitter, receiver) or None
        Lengths of the elements, whose beam weighs the directions. With None, the beam counts as
        narrow.
    """

    edges_m: NDArray[np.float64]
    side: int = 1
    seabed_z_m: float | None = None
    element_length_m: tuple[float, float] | None = None

    @property
    def middles_m(self) -> NDArray[np.float64]:
        """Ranges in the middle of the windows, [windows]."""
        return (self.edges_m[1:] + self.edges_m[:-1]) / 2

    def slopes(
        self, height_m: NDArray[np.float64], range_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the horizontal and vertical parts of unit rays that end on the seabed.

        `height_m` is the height of their origins. A ray that is too short to reach the seabed
        points straight down.
        """
        if self.seabed_z_m is None:
            return np.ones_like(range_m), np.zeros_like(range_m)
        down = np.clip((height_m - self.seabed_z_m) / range_m, -1.0, 1.0)
        return np.sqrt(1 - down**2), -down


@dataclass(frozen=True, eq=False)
class PairGeometry:
    """Geometry of the channel pairs of an overlap, and of the rays from them to the seabed.

    Attributes
    ----------
    lines : RangeLines
        Lines with the positions to test.
    pairs : Overlap
    swath : Swath
    headings : float64 [2, 3]
        Forward unit vectors of the array at both pings.
    centre_m : float64 [pairs, 3]
        Mean phase centres of both channels of every pair.
    forward, outward : float64 [3]
        Horizontal unit vectors along the array, the mean of both pings, and to the seabed.
    """

    lines: RangeLines
    pairs: Overlap
    swath: Swath
    headings: NDArray[np.float64]
    centre_m: NDArray[np.float64]
    forward: NDArray[np.float64]
    outward: NDArray[np.float64]

    @classmethod
    def of(cls, lines: RangeLines, array: Array, pairs: Overlap, swath: Swath) -> PairGeometry:
        """Return the geometry of pairs at the positions of `lines`, whose array is `array`."""
        centre_m = (lines.phase_centres_m[pairs.first] + lines.phase_centres_m[pairs.second]) / 2
        ping = int(np.searchsorted(array.starts, pairs.first[0], "right")) - 1
        headings = array.forward[ping : ping + 2]
        forward = headings[0] + headings[1]
        length = float(np.linalg.norm(forward))
        # The headings cancel where the track turns back from one ping to the next.
        forward = forward / length if length > _CANCELLED else headings[0]
        outward = swath.side * np.array([-forward[1], forward[0], 0.0])
        return cls(lines, pairs, swath, headings, centre_m, forward, outward)

    def rays(self, range_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return unit vectors from the phase centres to the seabed, [pairs, ranges, 3]."""
        across, up = self.swath.slopes(self.centre_m[:, 2:], range_m)
        shape = len(self.centre_m), len(range_m)
        rays = np.broadcast_to(across, shape)[..., None] * self.outward
        rays[..., 2] += up
        return rays

    def ranges_m(
        self, channels: NDArray[np.int64], points_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the ranges of points, [channels or 1, n, 3], in channels, [channels, n]."""
        lines, velocity = self.lines, self.lines.rx_velocity_m_s
        return bistatic_range_m(
            points_m,
            lines.tx_m[channels, None],
            lines.rx_m[channels, None],
            None if velocity is None else velocity[channels, None],
            lines.sound_speed_m_s,
        )
