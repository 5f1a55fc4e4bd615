"""Geometry of the channel pairs of an overlap, and of the rays from them to the seabed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.geometry import bistatic_range_m
from clsas.engine.data.lines import RangeLines
from clsas.navigation.overlap import Array, Overlap
from clsas.navigation.swath import Swath

_CANCELLED = 1e-6  # length of the sum of two unit vectors below which they count as opposite


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
