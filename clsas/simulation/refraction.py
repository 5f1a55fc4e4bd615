"""Paths between sonar and scene, straight or along exact rays: delays, directions, spreading.

Rays to many points are read from tables.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.decibels import amplitude
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

# Points of a block from which on a table is faster. It takes as long as some thousand rays.
_WORTH_A_TABLE = 4096
_OF_SIGHT = Accuracy(2e-9, 1e-5)  # of sightlines
# Each multiplies the error of a moving receiver's delay by v/c. The imagers, which simulated lines
# test, have a number of their own.
_FLIGHT_STEPS = 4
_TINY_M = 1e-300  # distance that stands for 0, which callers refuse

MOST_FOCUS = amplitude(10)
"""Largest amplitude relative to that of a straight path. Ray theory has no limit at caustics; waves
of 100 kHz have one at 10 to 15 dB."""


class Bend(NamedTuple):
    """How rays leave an antenna, compared with straight paths, float64 [points] each.

    Attributes
    ----------
    level_1_m : ndarray
        Factor by which the offset of a point, along any axis, becomes the component of the ray's
        direction: 1 over the distance in homogeneous water.
    lift : ndarray
        Added to this component, times the component of the axis that points up.
    spreading_m : ndarray
        Length whose inverse is the amplitude; see `clsas.engine.water.rays.Rays`.
    speed_m_s : float
        Sound speed at the antenna.
    focused : bool
        True if the amplitude was limited near a caustic.
    """

    level_1_m: NDArray[np.float64]
    lift: NDArray[np.float64]
    spreading_m: NDArray[np.float64]
    speed_m_s: float
    focused: bool = False

    def at(self, kept: NDArray[np.bool_]) -> Bend:
        """Return the rays to some of the points."""
        return self._replace(
            level_1_m=self.level_1_m[kept],
            lift=self.lift[kept],
            spreading_m=self.spreading_m[kept],
        )


class Legs(NamedTuple):
    """Paths from a transmitter to points and back to a receiver, float64 [points] each.

    Attributes
    ----------
    delay_s : ndarray
        Two-way delays.
    out_m, back_m : ndarray
        Lengths of straight paths; `back_m` ends at the receiver's position when the echo arrives.
    bends : (Bend, Bend) or None
        How rays leave transmitter and receiver; None if they are straight.
    """

    delay_s: NDArray[np.float64]
    out_m: NDArray[np.float64]
    back_m: NDArray[np.float64]
    bends: tuple[Bend, Bend] | None = None

    @property
    def spreading_m2(self) -> NDArray[np.float64]:
        """Product of the lengths by which amplitudes fall on both ways."""
        if self.bends is None:
            return self.out_m * self.back_m
        return self.bends[0].spreading_m * self.bends[1].spreading_m

    @property
    def focused(self) -> bool:
        """True if an amplitude was limited near a caustic."""
        return self.bends is not None and any(bend.focused for bend in self.bends)

    def at(self, kept: NDArray[np.bool_]) -> Legs:
        """Return the paths of some of the points."""
        bends = self.bends and (self.bends[0].at(kept), self.bends[1].at(kept))
        return Legs(self.delay_s[kept], self.out_m[kept], self.back_m[kept], bends)


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
    _latest: dict[bytes, tuple[NDArray[np.float64], NDArray[np.float64], Bend]] = field(
        default_factory=dict
    )

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
        key = elements.tx_m.tobytes()
        if key not in self._latest:  # the channels of a ping usually share their transmitter
            out = self._rays(self.points_m - elements.tx_m, tx_z_m, self.quantities)
            self._latest.clear()
            self._latest[key] = out
        out_s, out_m, leaving = self._latest[key]

        back_s, back_m, arriving = out_s, out_m, leaving
        offset_m, velocity_m_s = self.points_m - elements.rx_m, elements.rx_velocity_m_s
        if velocity_m_s is not None:
            for quantities in (*[TIMES] * (_FLIGHT_STEPS - 1), self.quantities):
                delay_s = out_s + back_s
                moved_m = offset_m - velocity_m_s * delay_s[:, None]
                height_m = rx_z_m + rx_climb_m_s * delay_s
                back_s, back_m, arriving = self._rays(moved_m, height_m, quantities)
        elif not np.array_equal(elements.tx_m, elements.rx_m):
            back_s, back_m, arriving = self._rays(offset_m, rx_z_m, self.quantities)
        return Legs(out_s + back_s, out_m, back_m, (leaving, arriving))

    def _rays(
        self,
        offset_m: NDArray[np.float64],
        antenna_z_m: NDArray[np.float64] | float,
        quantities: tuple[Quantity, ...],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], Bend]:
        """Return travel times over some offsets, lengths of straight paths, and directions.

        The antenna may have another height for every point.
        """
        rise_m = self.z_m - antenna_z_m
        square = np.einsum("ni,ni->n", offset_m, offset_m)
        length_m = np.maximum(np.sqrt(square), _TINY_M)
        distance_m = np.sqrt(np.maximum(square - rise_m**2, 0.0))
        # Phases to a tenth of the error at 800 kHz, directions to less.
        accuracy = Accuracy(
            USUAL.time_s * max(1.0, 1e4 * self.error), USUAL.other * max(1.0, 1e5 * self.error)
        )
        found = values_of(self.profile, distance_m, antenna_z_m, self.z_m, quantities, accuracy)
        values = dict(zip(quantities, found, strict=True))
        time_s = values[Q.TIME]
        dark = np.flatnonzero(np.isnan(time_s))
        if dark.size:
            nearest = int(dark[distance_m[dark].argmin()])
            at_z = float(np.broadcast_to(antenna_z_m, distance_m.shape)[nearest])
            why = shadow(self.profile, float(distance_m[nearest]), at_z, float(self.z_m[nearest]))
            raise ArgumentError("scene", "have no point without a ray", hint=why)

        spreading_m, level_1_m, lift = length_m, 1 / length_m, np.zeros_like(length_m)
        focused = False
        if Q.SPREADING in values:
            spreading_m = length_m * np.maximum(values[Q.SPREADING], 1 / MOST_FOCUS)
            focused = bool(values[Q.SPREADING].min() < 1 / MOST_FOCUS)
        if Q.LEVEL in values:
            lift = values[Q.LIFT] + (1 - values[Q.LEVEL]) * rise_m * level_1_m
            level_1_m = level_1_m * values[Q.LEVEL]
        speed_m_s = float(self.profile.at(np.mean(antenna_z_m)))
        return time_s, length_m, Bend(level_1_m, lift, spreading_m, speed_m_s, focused)


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
