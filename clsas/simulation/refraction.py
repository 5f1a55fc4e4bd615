"""Delays of many points along exact rays, by tables of travel times."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clsas.core.ray_tables import RayTable
from clsas.core.rays import rays, shadow
from clsas.core.sound_speed import SoundSpeed
from clsas.sonar.track import Channels

# Points of a block from which on a table is faster. It takes as long as some thousand rays.
_WORTH_A_TABLE = 4096
_MARGIN_M = 1.0  # by which a table reaches beyond the points, for the other channels of a group
_FLIGHT_STEPS = 4  # each multiplies the error of a moving receiver's delay by v/c


@dataclass(frozen=True, eq=False)
class BlockDelays:
    """Delays of a block of points for channels near each other.

    Attributes
    ----------
    profile : SoundSpeed
    points_m : float64 [points, 3]
        Positions relative to an origin, along any axes.
    z_m : float64 [points]
        Heights of the points in the coordinates of the profile.
    """

    profile: SoundSpeed
    points_m: NDArray[np.float64]
    z_m: NDArray[np.float64]
    _tables: dict[float, tuple[RayTable | None, float, float]] = field(default_factory=dict)

    def delays_s(
        self, elements: Channels, tx_z_m: float, rx_z_m: float, rx_climb_m_s: float
    ) -> NDArray[np.float64]:
        """Return the two-way delays of all points for one channel, seconds, [points].

        Parameters
        ----------
        elements : Channels
            Positions of the channel's elements, [3] each, relative to the origin and along the axes
            of the points.
        tx_z_m, rx_z_m : float
            Heights of the elements at transmission, in the coordinates of the profile.
        rx_climb_m_s : float
            Vertical velocity of the receiver.

        Raises
        ------
        ValueError
            If a point lies in a shadow zone.
        """
        out = self._times(self.points_m - elements.tx_m, tx_z_m)
        if elements.rx_velocity_m_s is None:
            if np.array_equal(elements.tx_m, elements.rx_m):
                return 2 * out
            return out + self._times(self.points_m - elements.rx_m, rx_z_m)
        delay = 2 * out
        offset_m = self.points_m - elements.rx_m
        for _ in range(_FLIGHT_STEPS):
            moved_m = offset_m - elements.rx_velocity_m_s * delay[:, None]
            climbed_m = rx_climb_m_s * delay
            low, high = rx_z_m + float(climbed_m.min()), rx_z_m + float(climbed_m.max())
            back = self._times(moved_m, low, rx_z_m + climbed_m)
            if high > low and len(back) >= _WORTH_A_TABLE:
                # Over the centimetres of a climb, times are linear in the height.
                upper = self._times(moved_m, high, rx_z_m + climbed_m)
                share = (rx_z_m + climbed_m - low) / (high - low)
                back = (1 - share) * back + share * upper
            delay = out + back
        return delay

    def _times(
        self,
        offset_m: NDArray[np.float64],
        antenna_z_m: float,
        antennas_z_m: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """Return the travel times over some offsets, [points].

        `antennas_z_m` are the heights for each point, if they differ; they determine the horizontal
        distances, and a table for `antenna_z_m` is used for many points.
        """
        heights_m = antenna_z_m if antennas_z_m is None else antennas_z_m
        square = np.einsum("ni,ni->n", offset_m, offset_m) - (self.z_m - heights_m) ** 2
        distance_m = np.sqrt(np.maximum(square, 0.0))
        if len(distance_m) >= _WORTH_A_TABLE:
            table = self._table(antenna_z_m, distance_m)
            if table is not None:
                return table.times(distance_m, self.z_m)
            heights_m = antenna_z_m
        found = rays(self.profile, distance_m, heights_m, self.z_m)
        if not found.exists.all():
            dark = np.flatnonzero(~found.exists)
            nearest = int(dark[distance_m[dark].argmin()])
            at_z = float(np.broadcast_to(heights_m, distance_m.shape)[nearest])
            place = float(distance_m[nearest]), at_z, float(self.z_m[nearest])
            why = shadow(self.profile, *place)
            raise ValueError(f"scene must have no point without a ray: {why}")
        return found.time_s

    def _table(self, antenna_z_m: float, distance_m: NDArray[np.float64]) -> RayTable | None:
        """Return the table for an antenna's height; None if the times do not allow one."""
        near, far = float(distance_m.min()), float(distance_m.max())
        table, least, most = self._tables.get(antenna_z_m, (None, np.inf, -np.inf))
        if near < least or far > most:
            least, most = max(near - _MARGIN_M, 0.0), far + _MARGIN_M
            heights = float(self.z_m.min()), float(self.z_m.max())
            table = RayTable.of(self.profile, antenna_z_m, (least, most), heights)
            self._tables[antenna_z_m] = table, least, most
        return table
