"""Tracks: poses of the platform, positions of the channels, and directions of the beam.

At the end are the checks of a track's fixes: what cannot be right in them is reported as findings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from clsas.engine.data import reprs, validate
from clsas.engine.data.findings import Finding, warn_of
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.reprs import measured
from clsas.engine.data.system import Sonar
from clsas.engine.data.validate import ArgumentError

LEAST_FIXES = 16
"""Fewest positions that show what is usual: a plain choice."""

MOST_HELD = 0.2
"""Share of pings at a position that occurred before, above which fixes are held. Closed tracks
repeat one position, and fixes held over two pings half of all. A halt of one ping in five raises
what it sees by 2 dB."""

# Speed between two fixes over the usual one. Noise that hides the motion entirely reaches 7, since
# the median distance is then that of the noise. Wrong fixes reach thousands.
_FASTER = 10.0
_WHOLE = 1e-6  # by which multiples of a step may differ from whole numbers
_REGULAR = 0.9  # share of equal steps, above which a track is one of equal steps with lost pings

Motion = float | ArrayLike | Callable[[NDArray[np.float64]], ArrayLike]


@dataclass(frozen=True, eq=False)
class Track:
    """Pose of the platform at every ping.

    World coordinates are x along-track, y across-track, z up. In the frame of the platform x is
    forward, y to port, z up. Yaw about z, then pitch about the turned y, then roll about the turned
    x (intrinsic z-y'-x'') rotate this frame into the world. All rotations are right-handed:
    positive yaw turns the bow to port, positive pitch lowers the bow, positive roll lifts the port
    side.

    Parameters
    ----------
    positions_m : array_like, [pings, 3]
        Position of the platform's origin at transmission, metres.
    time_s : array_like, [pings]
        Time of each transmission, seconds, strictly ascending.
    velocity_m_s : array_like, [pings, 3] or [3]
        Velocity of the platform while the sound of each ping travels, metres per second; zero by
        default. It is used only with motion during flight.
    yaw_rad, pitch_rad, roll_rad : array_like, [pings] or scalar
        Attitude, radians; zero by default.
    georeference : Georeference, optional
        Where the coordinates lie on Earth. Echoes that are simulated on the track have it too.

    Raises
    ------
    TypeError, ValueError
        If an array has the wrong type or shape or is not finite, or the times do not ascend.

    Examples
    --------
    A straight course at 2 m/s with 10 pings, and a sway of 2 cm:

    >>> import clsas
    >>> import numpy as np
    >>> clsas.Track.straight(
    ...     [0, 0, 0], [2, 0, 0], pings=10, ping_interval_s=0.25,
    ...     sway_m=lambda time_s: 0.02 * np.sin(time_s),
    ... )
    Track(10 pings in 2.25 s, x 0 to 4.5 m, y 0 to 0.01995 m, z 0 m)
    """

    positions_m: NDArray[np.float64]
    time_s: NDArray[np.float64]
    velocity_m_s: NDArray[np.float64] = (0.0, 0.0, 0.0)  # type: ignore[assignment]
    yaw_rad: NDArray[np.float64] = 0.0  # type: ignore[assignment]
    pitch_rad: NDArray[np.float64] = 0.0  # type: ignore[assignment]
    roll_rad: NDArray[np.float64] = 0.0  # type: ignore[assignment]
    georeference: Georeference | None = None

    def __post_init__(self) -> None:
        """Check every field and convert it."""

        def put(name: str, shape: tuple[int | None, ...], *, broadcast: bool = False) -> None:
            value = getattr(self, name)
            value = validate.array(name, value, np.float64, shape, broadcast=broadcast)
            object.__setattr__(self, name, value)

        validate.instance("georeference", self.georeference, Georeference, type(None))
        put("positions_m", (None, 3))
        put("time_s", (self.pings,))
        put("velocity_m_s", (self.pings, 3), broadcast=True)
        for name in ("yaw_rad", "pitch_rad", "roll_rad"):
            put(name, (self.pings,), broadcast=True)
        step_s = np.diff(self.time_s)
        if step_s.min(initial=np.inf) <= 0:
            wrong = np.flatnonzero(step_s <= 0)
            how = "repeated" if step_s[wrong[0]] == 0 else "out of order"
            raise ArgumentError(
                "time_s",
                "ascend strictly",
                f"a step of {step_s[wrong[0]]:g} s from ping {wrong[0]} to the next ({how}; "
                f"{len(wrong)} such steps)",
                "sort pings by time and drop repeated ones",
            )
        for name, most in (("yaw_rad", 2 * np.pi), ("pitch_rad", np.pi / 2), ("roll_rad", np.pi)):
            angles = np.abs(getattr(self, name))
            # Yaw may count several turns, but then it begins with the first.
            found = float(angles.min() if name == "yaw_rad" else angles.max())
            if found > most * (1 + 1e-6):
                validate.warn(
                    f"`{name}` is {found:.4g} rad, more than {np.degrees(most):.0f} degrees. If it "
                    "is in degrees, convert it with `numpy.radians`"
                )

    @property
    def pings(self) -> int:
        """Number of pings."""
        return len(self.positions_m)

    def __repr__(self) -> str:
        """Return the number of pings, their duration and their extents."""
        place_m = self.positions_m
        time_s = float(self.time_s[-1] - self.time_s[0])
        return reprs.summary(
            self,
            f"{self.pings} ping{'s' * (self.pings > 1)} in {reprs.quantity(time_s, 's')}",
            reprs.extents(place_m.min(axis=0), place_m.max(axis=0)),
        )

    @property
    def rotations(self) -> Rotation:
        """Rotation from the platform's frame to the world at every ping."""
        angles = np.stack([self.yaw_rad, self.pitch_rad, self.roll_rad], axis=1)
        return Rotation.from_euler("ZYX", angles)

    @classmethod
    def straight(
        cls,
        start_m: ArrayLike,
        velocity_m_s: ArrayLike,
        pings: int,
        ping_interval_s: float,
        *,
        surge_m: Motion = 0.0,
        sway_m: Motion = 0.0,
        heave_m: Motion = 0.0,
        yaw_rad: Motion = 0.0,
        pitch_rad: Motion = 0.0,
        roll_rad: Motion = 0.0,
    ) -> Track:
        """Return a straight course at constant speed, with motion added to it.

        Parameters
        ----------
        start_m : array_like, [3]
            Position at the first ping, at time 0, without the added motion, metres.
        velocity_m_s : array_like, [3]
            Velocity along the course, metres per second. The heading is its horizontal direction,
            or x if the horizontal velocity is zero.
        pings : int
            Number of pings.
        ping_interval_s : float
            Time between pings, seconds.
        surge_m, sway_m, heave_m : number, array_like [pings], or function
            Displacement forward along the heading, to port, and up, metres. A function takes the
            times, float64 [pings], and returns the displacements. Their time derivative (central
            differences) is added to the velocity of the track.
        yaw_rad, pitch_rad, roll_rad : number, array_like [pings], or function
            Attitude relative to the level heading, radians.

        Raises
        ------
        TypeError, ValueError
            If a value has the wrong type or shape, is not finite, or is outside its limits.
        """
        start = validate.array("start_m", start_m, np.float64, (3,))
        velocity = validate.array("velocity_m_s", velocity_m_s, np.float64, (3,))
        pings = validate.count("pings", pings)
        validate.memory("pings", 80 * pings)  # ten numbers per ping: pose, time and velocity
        interval = validate.positive("ping_interval_s", ping_interval_s, "s")
        time = interval * np.arange(pings, dtype=np.float64)
        heading = np.arctan2(velocity[1], velocity[0])
        directions = Rotation.from_euler("Z", heading).as_matrix().T
        positions = start + velocity * time[:, None]
        velocities = np.tile(velocity, (pings, 1))
        moves = {"surge_m": surge_m, "sway_m": sway_m, "heave_m": heave_m}
        for direction, (name, motion) in zip(directions, moves.items(), strict=True):
            positions += _at(name, motion, time)[:, None] * direction
            velocities += _rate(name, motion, time, interval)[:, None] * direction
        return cls(
            positions,
            time,
            velocities,
            heading + _at("yaw_rad", yaw_rad, time),
            _at("pitch_rad", pitch_rad, time),
            _at("roll_rad", roll_rad, time),
        )

    @classmethod
    def from_geographic(
        cls,
        latitude_deg: ArrayLike,
        longitude_deg: ArrayLike,
        height_m: ArrayLike,
        heading_deg: ArrayLike,
        time_s: ArrayLike,
        *,
        pitch_deg: ArrayLike = 0.0,
        roll_deg: ArrayLike = 0.0,
        georeference: Georeference | None = None,
    ) -> Track:
        """Return the track of a platform whose latitudes and longitudes are known.

        Parameters
        ----------
        latitude_deg, longitude_deg : array_like, [pings]
            Geodetic latitudes and longitudes (WGS 84), degrees.
        height_m : array_like, [pings] or scalar
            Heights above the WGS 84 ellipsoid, or the vertical datum of `georeference`, metres;
            negative below it.
        heading_deg : array_like, [pings] or scalar
            Headings, degrees clockwise from true north, -360 to 360.
        time_s : array_like, [pings]
            Time of each transmission, seconds, strictly ascending.
        pitch_deg, roll_deg : array_like, [pings] or scalar
            Attitude as navigation systems report it, degrees: positive pitch raises the bow,
            positive roll raises the port side. `Track` itself counts pitch the other way.
        georeference : Georeference, optional
            Frame of the track. By default it is local: the origin is the mean position, and the x
            axis has the mean heading, or the first one if headings have no common direction.

        Returns
        -------
        Track
            Track with its georeference. Its velocity is the derivative of the positions.

        Raises
        ------
        TypeError, ValueError
            If an array has the wrong type or shape, a value is outside its limits, latitude and
            longitude are probably swapped, or headings are probably in radians, since only then do
            they agree with the course.
        ImportError
            If pyproj is not installed (extra `maps`).

        Warns
        -----
        ClsasWarning
            If fixes cannot be right: the track jumps, one fix is held over several pings, or
            angles are rounded to float32.

        Notes
        -----
        Heights become z without regard to the curvature of the Earth, which drops by 8 mm within
        320 m of a position.

        Examples
        --------
        >>> import clsas
        >>> clsas.Track.from_geographic(
        ...     [60.39, 60.3901], [5.32, 5.32], height_m=-20.0, heading_deg=0.0, time_s=[0, 5]
        ... ).georeference
        Georeference(latitude 60.39005 deg, longitude 5.32 deg, height -20 m, heading 0 deg)
        """
        import clsas.maps

        positions, yaw_rad, frame = clsas.maps.geographic_poses(
            latitude_deg, longitude_deg, height_m, heading_deg, georeference
        )
        pings = len(positions)
        pitch, roll = (
            np.radians(validate.array(name, value, np.float64, (pings,), broadcast=True))
            for name, value in (("pitch_deg", pitch_deg), ("roll_deg", roll_deg))
        )
        still = np.zeros(3)
        track = cls(positions, time_s, still, yaw_rad, -pitch, roll, frame)  # type: ignore[arg-type]
        degrees = np.stack([np.asarray(each, float) for each in (latitude_deg, longitude_deg)], 1)
        warn_of(doubts_of_track(positions, track.time_s, degrees))
        if pings == 1:
            return track
        return replace(track, velocity_m_s=np.gradient(positions, track.time_s, axis=0))


class Channels(NamedTuple):
    """Antenna positions of every channel, float64 [channels, 3], in ping-major order."""

    tx_m: NDArray[np.float64]
    rx_m: NDArray[np.float64]
    rx_velocity_m_s: NDArray[np.float64] | None

    def __repr__(self) -> str:
        """Return the number of channels and the extents of the receivers."""
        return reprs.summary(
            self,
            f"{len(self.rx_m)} channels",
            f"receivers at {reprs.extents(self.rx_m.min(axis=0), self.rx_m.max(axis=0))}",
        )


def channels(sonar: Sonar, track: Track, *, motion_in_flight: bool = False) -> Channels:
    """Return the position of every channel's transmitter and receiver at transmission.

    Parameters
    ----------
    sonar : Sonar
        Sonar with its elements on the platform.
    track : Track
        Poses of the platform.
    motion_in_flight : bool
        If True, also return the velocity of the receivers. This is the velocity of the platform.
        Rotation while the sound travels is neglected.

    Returns
    -------
    Channels
        Named tuple of `tx_m`, `rx_m` and `rx_velocity_m_s`, float64 [channels, 3] each. The
        velocity is None without motion in flight. The number of a channel is
        ping * receivers + receiver.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type, or the channels do not fit into memory.

    See Also
    --------
    Sonar.channel_banks : Receiver banks of these channels.

    Examples
    --------
    >>> import clsas
    >>> pulse = clsas.Pulse(carrier_hz=100e3, bandwidth_hz=20e3, duration_s=1e-3)
    >>> sonar = clsas.Sonar(pulse, rx_m=[[-0.1, 0, 0], [0.1, 0, 0]])
    >>> track = clsas.Track.straight([0, 0, 0], [2, 0, 0], pings=10, ping_interval_s=0.1)
    >>> clsas.channels(sonar, track)
    Channels(20 channels, receivers at x -0.1 to 1.9 m, y 0 m, z 0 m)
    """
    validate.instance("sonar", sonar, Sonar)
    validate.instance("track", track, Track)
    motion_in_flight = validate.flag("motion_in_flight", motion_in_flight)
    # Nine numbers per channel, and the ranges to some points, which every caller computes.
    validate.memory("sonar and track", 300 * track.pings * sonar.receivers)
    turn = track.rotations.as_matrix()
    tx = track.positions_m + turn @ sonar.tx_m
    rx = track.positions_m[:, None] + sonar.rx_m @ turn.transpose(0, 2, 1)
    each = sonar.receivers
    velocity = np.repeat(track.velocity_m_s, each, axis=0) if motion_in_flight else None
    return Channels(np.repeat(tx, each, axis=0), rx.reshape(-1, 3), velocity)


@dataclass(frozen=True)
class Pointing:
    """Direction of the beam axis, to which element patterns refer.

    Create one with `broadside`, `squint`, `scan` or `spot`. Elements turn as a whole with their
    beam.

    Parameters
    ----------
    squint_rad : tuple of float
        Angles forward of broadside (port), radians, one per ping. They repeat if there are more
        pings.
    depression_rad : float
        Angle of the axis below the platform's horizontal plane, radians.
    spot_m : tuple of three floats, optional
        World position at which the axis points, metres, instead of the angles.

    Raises
    ------
    TypeError, ValueError
        If a value has the wrong type or shape, or is not finite.

    Examples
    --------
    >>> import clsas
    >>> clsas.Pointing.squint(0.1, depression_rad=0.3)
    Pointing(squint (0.1) rad, depression 0.3 rad)
    """

    squint_rad: tuple[float, ...] = (0.0,)
    depression_rad: float = 0.0
    spot_m: tuple[float, float, float] | None = None

    __repr__ = reprs.of_fields

    def __post_init__(self) -> None:
        """Check every field and convert it."""
        squint = validate.array("squint_rad", self.squint_rad, np.float64, (None,))
        object.__setattr__(self, "squint_rad", tuple(squint.tolist()))
        depression = validate.number("depression_rad", self.depression_rad, "rad")
        object.__setattr__(self, "depression_rad", depression)
        if self.spot_m is not None:
            spot = validate.array("spot_m", self.spot_m, np.float64, (3,))
            object.__setattr__(self, "spot_m", tuple(spot.tolist()))

    @classmethod
    def broadside(cls, *, depression_rad: float = 0.0) -> Pointing:
        """Return a beam that points to port, perpendicular to the platform."""
        return cls(depression_rad=depression_rad)

    @classmethod
    def squint(cls, angle_rad: float, *, depression_rad: float = 0.0) -> Pointing:
        """Return a beam that points forward of broadside by an angle (aft if negative)."""
        return cls((validate.number("angle_rad", angle_rad, "rad"),), depression_rad)

    @classmethod
    def scan(cls, angles_rad: ArrayLike, *, depression_rad: float = 0.0) -> Pointing:
        """Return a beam that steps through angles forward of broadside, one per ping, in turn."""
        angles = validate.array("angles_rad", angles_rad, np.float64, None)
        return cls(tuple(np.atleast_1d(angles).tolist()), depression_rad)

    @classmethod
    def spot(cls, point_m: ArrayLike) -> Pointing:
        """Return a beam that points at a fixed position in the world (spotlight)."""
        point = validate.array("point_m", point_m, np.float64, (3,))
        return cls(spot_m=tuple(point.tolist()))

    def axes(self, track: Track) -> NDArray[np.float64]:
        """Return the unit vectors of the elements in the world at every ping.

        Returns
        -------
        float64 array, [pings, 3 vectors, 3]
            Direction of the element's length, its beam axis, and the direction of its height.

        Raises
        ------
        TypeError
            If `track` is not a Track.
        ValueError
            If the spot lies straight ahead or astern, where the direction of the element's length
            is undefined.
        """
        validate.instance("track", track, Track)
        if self.spot_m is None:
            squint = np.resize(self.squint_rad, track.pings)
            # Squint turns x and y clockwise seen from above; depression then tips the beam down.
            beam = Rotation.from_euler(
                "ZX", np.stack([-squint, np.full(track.pings, -self.depression_rad)], axis=1)
            )
            return (track.rotations * beam).as_matrix().transpose(0, 2, 1)
        beam = np.asarray(self.spot_m) - track.positions_m
        distance = np.linalg.norm(beam, axis=1, keepdims=True)
        forward = track.rotations.as_matrix()[:, :, 0]
        along = forward * distance**2 - beam * np.sum(forward * beam, axis=1, keepdims=True)
        length = np.linalg.norm(along, axis=1, keepdims=True)
        blind = np.flatnonzero(length <= 1e-9 * distance**2)
        if blind.size:
            raise ArgumentError(
                "spot_m",
                "not lie straight ahead or astern of the platform",
                f"{self.spot_m} m at ping {blind[0]}",
            )
        along, beam = along / length, beam / distance
        return np.stack([along, beam, np.cross(along, beam)], axis=1)


def _at(name: str, motion: Motion, time: NDArray[np.float64]) -> NDArray[np.float64]:
    value = motion(time) if callable(motion) else motion
    return validate.array(name, value, np.float64, time.shape, broadcast=True)


def _rate(
    name: str, motion: Motion, time: NDArray[np.float64], interval: float
) -> NDArray[np.float64]:
    """Return the time derivative: local for a function, between pings for an array."""
    if callable(motion):
        step = 1e-3 * interval
        return (_at(name, motion, time + step) - _at(name, motion, time - step)) / (2 * step)
    if len(time) == 1:
        return np.zeros(1)
    return np.gradient(_at(name, motion, time), interval)


def doubts_of_track(
    positions_m: NDArray[np.float64],
    time_s: NDArray[np.float64],
    degrees: NDArray[np.float64] | None = None,
) -> Iterator[Finding]:
    """Yield what cannot be right in a track, from one fix per ping, in the order of time.

    `degrees` are the latitudes and longitudes of which the positions were made, [pings, 2].
    """
    count = len(positions_m)
    if count < LEAST_FIXES:
        return
    steps_m = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    speed_m_s, moves = steps_m / np.diff(time_s), steps_m > 0
    if moves.any():
        usual_m_s = float(np.median(speed_m_s[moves]))
        fast = np.flatnonzero(speed_m_s > _FASTER * usual_m_s)
        if fast.size:
            worst = int(np.argmax(speed_m_s))
            cause = "probably wrong fixes"
            if degrees is not None and (zero := np.flatnonzero(~degrees.any(axis=1))).size:
                cause = (
                    f"ping {zero[0]} is at latitude 0, longitude 0, as receivers report without a "
                    "fix. It also moves the origin of the track, the mean position"
                )
            yield Finding(
                "jumps",
                f"the track jumps at {fast.size} of {count - 1} steps, by up to "
                f"{measured(steps_m[worst], 'm')} after ping {worst}: a "
                f"speed of {speed_m_s[worst]:.4g} m/s, where {usual_m_s:.3g} m/s is usual; {cause}",
                float(speed_m_s[worst]),
                _FASTER * usual_m_s,
                "leave these fixes out, and interpolate the navigation over them",
                tuple(fast.tolist()),
            )
    held = int(np.count_nonzero(~moves))
    if held > MOST_HELD * count and moves.any():
        yield held_fixes(f"{held} of {count} pings", held / count)
    if degrees is not None and (degrees == degrees.astype(np.float32)).all():
        step, how = max(rounded_to(each, 1e-6) for each in degrees.T)
        if step:
            yield Finding(
                "coarse_fixes",
                f"latitudes and longitudes are rounded to {step:.2g} degrees, "
                f"{measured(111e3 * step, 'm', 2)} on the ground{how}",
                step,
                1e-6,
                "keep latitudes and longitudes in float64",
            )


def held_fixes(count: str, share: float) -> Finding:
    """Return that a share of pings or channels, counted in words, repeat a position."""
    return Finding(
        "held_fixes",
        f"{count} have exactly the position of another one: either the navigation has fewer fixes "
        "than there are pings, and each was held over several, or the platform stood still",
        share,
        MOST_HELD,
        "interpolate the navigation at the times of the pings, or leave out pings taken standing "
        "still with `lines.without_still_pings()`",
    )


def rounded_to(
    values: NDArray[np.float64], least: float, decimals: tuple[float, ...] = ()
) -> tuple[float, str]:
    """Return the step above `least` to which coordinates were rounded, and how; 0 if there is none.

    Equal steps are no rounding, even where pings were lost: a rail or a simulation has them.
    """
    unique, counts = np.unique(values, return_counts=True)
    if len(unique) < LEAST_FIXES or 4 * len(unique) * counts.min() < len(values):
        return 0.0, ""  # a coordinate that hardly changes
    single = float(np.spacing(np.float32(np.abs(values).max())))
    for step in (single, *decimals):
        numbers = (unique - unique[0]) / step  # also multiples if a lever arm was added
        if step <= least or np.abs(numbers - np.rint(numbers)).max() > _WHOLE:
            continue
        steps = np.diff(np.rint(numbers))
        kinds, of_kind = np.unique(steps.astype(np.int64), return_counts=True)
        if np.gcd.reduce(kinds) > 1 and not np.ptp(counts):
            return 0.0, ""  # equal steps, some of which are lost
        if step == single:
            if len(kinds) > 1 or np.ptp(counts):
                return single, ", as single precision (float32) does with numbers of this size"
        elif of_kind.max() < _REGULAR * len(steps):
            return step, ""
    return 0.0, ""
