"""Exact rays between sonar and scene: delays, directions and spreading, by tables."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.sound_speed import SoundSpeed
from clsas.engine.data.track import Channels
from clsas.engine.data.validate import ArgumentError
from clsas.engine.water.ray_tables import (
    TIMES,
    USUAL,
    Accuracy,
    Q,
    Quantity,
    quantity_of,
    table_around,
)
from clsas.engine.water.rays import rays, shadow
from clsas.simulation.legs import Bend, Legs

# Points of a block from which on a table is faster. It takes as long as some thousand rays.
_WORTH_A_TABLE = 4096
_OF_SIGHT = Accuracy(2e-9, 1e-5)  # of sightlines
_FLIGHT_STEPS = 4  # each multiplies the error of a moving receiver's delay by v/c
_TINY_M = 1e-300  # distance that stands for 0, which callers refuse

MOST_FOCUS = 10 ** (10 / 20)
"""Largest amplitude relative to that of a straight path. Ray theory has no limit at caustics; waves
of 100 kHz have one at 10 to 15 dB."""


class _Leg(NamedTuple):
    """Rays from one antenna: travel times, lengths of straight paths, and directions."""

    time_s: NDArray[np.float64]
    length_m: NDArray[np.float64]
    bend: Bend


@dataclass(frozen=True, eq=False)
class BlockRays:
    """Rays to a block of points from channels near each other.

    Attributes
    ----------
    profile : SoundSpeed
    points_m : float64 [points, 3]
        Positions relative to an origin, along any axes.
    z_m : float64 [points]
        Heights of the points in the coordinates of the profile.
    quantities : tuple of Quantity
        What is needed of the rays: the time, and for `Bend` its direction and spreading. What is
        not needed is that of straight paths.
    error : float
        Relative error that the sum over these points may have.
    """

    profile: SoundSpeed
    points_m: NDArray[np.float64]
    z_m: NDArray[np.float64]
    quantities: tuple[Quantity, ...] = TIMES
    error: float = 0.0
    _latest: dict[bytes, _Leg] = field(default_factory=dict)

    def legs(self, elements: Channels, tx_z_m: float, rx_z_m: float, rx_climb_m_s: float) -> Legs:
        """Return the rays to all points for one channel.

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
        out = self._outward(elements.tx_m, tx_z_m)
        if elements.rx_velocity_m_s is None:
            if np.array_equal(elements.tx_m, elements.rx_m):
                return _legs(out, out)
            back = self._leg(self.points_m - elements.rx_m, rx_z_m, self.quantities)
            return _legs(out, back)
        back = out
        offset_m = self.points_m - elements.rx_m
        for quantities in (*[TIMES] * (_FLIGHT_STEPS - 1), self.quantities):
            delay = out.time_s + back.time_s
            moved_m = offset_m - elements.rx_velocity_m_s * delay[:, None]
            back = self._leg(moved_m, rx_z_m + rx_climb_m_s * delay, quantities)
        return _legs(out, back)

    @property
    def _accuracy(self) -> Accuracy:
        """Accuracy of tables: phases to a tenth of the error at 800 kHz, directions to less."""
        return Accuracy(
            USUAL.time_s * max(1.0, 1e4 * self.error), USUAL.other * max(1.0, 1e5 * self.error)
        )

    def _outward(self, tx_m: NDArray[np.float64], z_m: float) -> _Leg:
        """Return the leg from a transmitter, which the channels of a ping usually share."""
        key = tx_m.tobytes()
        found = self._latest.get(key)
        if found is None:
            found = self._leg(self.points_m - tx_m, z_m, self.quantities)
            self._latest.clear()
            self._latest[key] = found
        return found

    def _leg(
        self,
        offset_m: NDArray[np.float64],
        antenna_z_m: NDArray[np.float64] | float,
        quantities: tuple[Quantity, ...],
    ) -> _Leg:
        """Return the rays over some offsets.

        The antenna may have another height for every point.
        """
        rise_m = self.z_m - antenna_z_m
        square = np.einsum("ni,ni->n", offset_m, offset_m)
        length_m = np.maximum(np.sqrt(square), _TINY_M)
        distance_m = np.sqrt(np.maximum(square - rise_m**2, 0.0))
        found = values_of(
            self.profile, distance_m, antenna_z_m, self.z_m, quantities, self._accuracy
        )
        values = dict(zip(quantities, found, strict=True))
        time_s = values[Q.TIME]
        if np.isnan(time_s).any():
            self._refuse(distance_m, antenna_z_m, time_s)
        spreading_m, level_1_m, lift = length_m, 1 / length_m, np.zeros_like(length_m)
        focused = False
        if Q.SPREADING in values:
            spreading_m = length_m * np.maximum(values[Q.SPREADING], 1 / MOST_FOCUS)
            focused = bool(values[Q.SPREADING].min() < 1 / MOST_FOCUS)
        if Q.LEVEL in values:
            lift = values[Q.LIFT] + (1 - values[Q.LEVEL]) * rise_m * level_1_m
            level_1_m = level_1_m * values[Q.LEVEL]
        speed_m_s = float(self.profile.at(np.mean(antenna_z_m)))
        return _Leg(time_s, length_m, Bend(level_1_m, lift, spreading_m, speed_m_s, focused))

    def _refuse(
        self,
        distance_m: NDArray[np.float64],
        antenna_z_m: NDArray[np.float64] | float,
        time_s: NDArray[np.float64],
    ) -> None:
        dark = np.flatnonzero(np.isnan(time_s))
        nearest = int(dark[distance_m[dark].argmin()])
        at_z = float(np.broadcast_to(antenna_z_m, distance_m.shape)[nearest])
        place = float(distance_m[nearest]), at_z, float(self.z_m[nearest])
        why = shadow(self.profile, *place)
        raise ArgumentError("scene", "have no point without a ray", hint=why)


def _legs(out: _Leg, back: _Leg) -> Legs:
    delay_s = out.time_s + back.time_s
    return Legs(delay_s, out.length_m, back.length_m, (out.bend, back.bend))


@dataclass(frozen=True)
class Sightlines:
    """Rays by which a sonar sees a seabed.

    Attributes
    ----------
    profile : SoundSpeed
    eye_z_m : float
        Height of the sonar.
    """

    profile: SoundSpeed
    eye_z_m: float

    @property
    def speed_m_s(self) -> float:
        """Sound speed at the sonar."""
        return float(self.profile.at(self.eye_z_m))

    def departures(
        self, offsets_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the directions in which rays leave the sonar, and how much larger things look.

        Parameters
        ----------
        offsets_m : float64 [points, 3]
            Points relative to the sonar.

        Returns
        -------
        directions : float64 [points, 3]
            Unit vectors, straight to points without a ray.
        magnification : float64 [points]
            Angle between neighbouring rays relative to that of straight paths, at least 1.
        """
        length_m = np.maximum(np.linalg.norm(offsets_m, axis=1), np.finfo(float).tiny)
        level, lift, spreading = self._values(
            np.hypot(offsets_m[:, 0], offsets_m[:, 1]), offsets_m[:, 2],
            (Q.LEVEL, Q.LIFT, Q.SPREADING),
        )  # fmt: skip
        dark = np.isnan(lift)
        level[dark], lift[dark], spreading[dark] = 1.0, 0.0, 1.0
        directions = offsets_m / length_m[:, None]
        directions[:, :2] *= level[:, None]
        directions[:, 2] += lift
        return directions, np.clip(spreading, 1 / MOST_FOCUS, 1.0) ** -2

    def arrivals(
        self, offsets_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Return the directions in which rays arrive at points, and the elevations they leave at.

        Parameters
        ----------
        offsets_m : float64 [3, points]
            Points relative to the sonar.

        Returns
        -------
        directions : float32 [3, points]
            Unit vectors, straight to points without a ray.
        elevations : float64 [points]
            As for `elevations`.
        """
        ground_m = np.sqrt(offsets_m[0] ** 2 + offsets_m[1] ** 2)
        level, lift, leaving = self._values(
            ground_m, offsets_m[2], (Q.LEVEL_THERE, Q.LIFT_THERE, Q.LIFT)
        )
        dark = np.isnan(lift)
        level[dark], lift[dark] = 1.0, 0.0
        length_m = np.maximum(np.sqrt(ground_m**2 + offsets_m[2] ** 2), _TINY_M)
        straight = offsets_m[2] / length_m
        level /= length_m
        lift += straight
        directions = np.stack([level * offsets_m[0], level * offsets_m[1], lift])
        return directions.astype(np.float32), straight + leaving

    def elevations(
        self, ground_m: NDArray[np.float64], rise_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the sines of the elevation at which rays leave the sonar, [points].

        At one horizontal distance they grow with the height, so that rays pass above whatever has a
        smaller elevation. Without a ray they are NaN.
        """
        (lift,) = self._values(ground_m, rise_m, (Q.LIFT,))
        return lift + rise_m / np.maximum(np.sqrt(ground_m**2 + rise_m**2), _TINY_M)

    def _values(
        self,
        ground_m: NDArray[np.float64],
        rise_m: NDArray[np.float64],
        quantities: tuple[Quantity, ...],
    ) -> NDArray[np.float64]:
        return values_of(
            self.profile, ground_m, self.eye_z_m, self.eye_z_m + rise_m, quantities, _OF_SIGHT
        )


def values_of(
    profile: SoundSpeed,
    distance_m: NDArray[np.float64],
    antenna_z_m: NDArray[np.float64] | float,
    z_m: NDArray[np.float64],
    quantities: tuple[Quantity, ...],
    accuracy: Accuracy = USUAL,
) -> NDArray[np.float64]:
    """Return quantities of rays, [quantities, points]; they are NaN without a ray.

    The antenna may have another height for every point. For many points, tables for the lowest and
    the highest are used: over the centimetres of a climb, quantities are linear in the height.
    """
    if len(distance_m) >= _WORTH_A_TABLE:
        ends = sorted({float(np.min(antenna_z_m)), float(np.max(antenna_z_m))})
        tables = [table_around(profile, z, distance_m, z_m, quantities, accuracy) for z in ends]
        read = [table.read(distance_m, z_m) for table in tables if table is not None]
        if len(read) == len(ends) == 1:
            return read[0]
        if len(read) == len(ends):
            share = (antenna_z_m - ends[0]) / (ends[1] - ends[0])
            return (1 - share) * read[0] + share * read[1]
    found = rays(profile, distance_m, antenna_z_m, z_m)
    return np.stack([
        quantity_of(each, found, profile, distance_m, antenna_z_m, z_m) for each in quantities
    ])  # fmt: skip
