"""Sound speed that varies with depth, measured or from temperature and salinity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.validate import ArgumentError

USUAL_M_S = 1500.0
"""Sound speed if none is given, which is about that of the sea."""
SLOWEST_M_S, FASTEST_M_S = 1300.0, 1800.0
"""Slowest and fastest sound in water: fresh water near freezing has 1402 m/s, hot brines of the
Red Sea more than 1700 m/s."""

STEEPEST_PER_S = 60.0
"""Largest change of speed with depth, m/s per metre. Fresh water above sea water, within a metre,
changes it by 40 m/s."""

_FEET_M = 0.3048
_DEEPEST_M = 12e3  # somewhat deeper than the deepest trench


@dataclass(frozen=True, eq=False)
class SoundSpeed:
    """Profile of the sound speed, piecewise linear in depth.

    Parameters
    ----------
    depth_m : array_like of float, shape [n]
        Depths below the surface, positive down, in ascending order, metres. At least two.
    speed_m_s : array_like of float, shape [n]
        Sound speed at each depth, metres per second. Between depths it is linear.
    surface_z_m : float
        Height z of the surface in the coordinates of the antennas and pixels, metres: z is
        surface_z_m minus depth. The default 0 puts the surface at z = 0.

    Raises
    ------
    TypeError, ValueError
        If an argument is not an array of finite numbers, the depths do not ascend, a depth is
        negative or below 12 km, a speed is not one of water (feet or kilometres per second are
        recognised), or the speed jumps by more than 60 m/s per metre.

    See Also
    --------
    read_sound_speed : Profile in a CSV file.

    Notes
    -----
    Nothing is extrapolated. A profile has to include the depths of the sonar and of the pixels,
    and those above the sonar to which rays rise on their way.

    Examples
    --------
    A mixed layer above a thermocline of 10 m/s:

    >>> import clsas
    >>> profile = clsas.SoundSpeed([0, 10, 13, 40], [1500, 1500, 1490, 1490.4])
    >>> profile
    SoundSpeed(4 depths, 0 to 40 m, 1490 to 1500 m/s)
    >>> print(profile.at(-11.5), f"{profile.mean_m_s(-5, -25):.2f}")
    1495.0 1493.29
    """

    depth_m: NDArray[np.float64]
    speed_m_s: NDArray[np.float64]
    surface_z_m: float = 0.0

    def __post_init__(self) -> None:
        """Check every field and convert it."""
        depth = validate.array("depth_m", self.depth_m, np.float64, (None,))
        speed = validate.array("speed_m_s", self.speed_m_s, np.float64, (len(depth),))
        surface = validate.number(
            "surface_z_m", self.surface_z_m, "m", least=-validate.FARTHEST_M,
            most=validate.FARTHEST_M,
        )  # fmt: skip
        _check_depths(depth)
        _check_speeds(depth, speed)
        for name, value in (("depth_m", depth), ("speed_m_s", speed), ("surface_z_m", surface)):
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        """Return the extents in depth and speed."""
        return reprs.summary(
            self,
            f"{len(self.depth_m)} depths",
            reprs.span(float(self.depth_m[0]), float(self.depth_m[-1]), "m"),
            reprs.span(float(self.speed_m_s.min()), float(self.speed_m_s.max()), "m/s"),
            f"surface at z {self.surface_z_m:g} m" if self.surface_z_m else None,
        )

    def __eq__(self, other: object) -> bool:
        """Return whether another profile has the same depths, speeds and surface."""
        if not isinstance(other, SoundSpeed):
            return NotImplemented
        return (
            np.array_equal(self.depth_m, other.depth_m)
            and np.array_equal(self.speed_m_s, other.speed_m_s)
            and self.surface_z_m == other.surface_z_m
        )

    def __hash__(self) -> int:
        """Return a hash that agrees with ``==``."""
        return hash((self.depth_m.tobytes(), self.speed_m_s.tobytes(), self.surface_z_m))

    @classmethod
    def from_temperature(
        cls,
        depth_m: ArrayLike,
        temperature_c: ArrayLike,
        salinity: ArrayLike,
        *,
        surface_z_m: float = 0.0,
    ) -> Self:
        """Return the profile of measured temperatures and salinities, by Mackenzie's formula.

        Parameters
        ----------
        depth_m : array_like of float, shape [n]
            As for `SoundSpeed`, at most 8000 m.
        temperature_c : array_like of float, shape [n] or a number
            Temperature, degrees Celsius, -2 to 30.
        salinity : array_like of float, shape [n] or a number
            Practical salinity, 25 to 40.
        surface_z_m : float
            As for `SoundSpeed`.

        Raises
        ------
        TypeError, ValueError
            If a value is outside these limits, and as for `SoundSpeed`. Other waters need
            `from_teos10`.

        Notes
        -----
        With temperature T, salinity S and depth D,

            c = 1448.96 + 4.591 T - 0.05304 T^2 + 2.374e-4 T^3 + 1.340 (S - 35) + 0.0163 D
                + 1.675e-7 D^2 - 0.01025 T (S - 35) - 7.139e-13 T D^3,

        whose standard error is 0.07 m/s from 2 to 30 degrees [1]_.

        References
        ----------
        .. [1] Mackenzie, "Nine-term equation for sound speed in the oceans", Journal of the
           Acoustical Society of America 70(3), 1981.

        Examples
        --------
        >>> import clsas
        >>> profile = clsas.SoundSpeed.from_temperature([0, 1000], [25, 25], 35)
        >>> print(f"{profile.speed_m_s[1]:.3f} m/s")
        1550.744 m/s
        """
        depth, temperature, salinity = _measured(depth_m, temperature_c, salinity)
        for name, values, unit, least, most in (
            ("depth_m", depth, "m", 0.0, 8000.0),
            ("temperature_c", temperature, "degrees C", -2.0, 30.0),
            ("salinity", salinity, "", 25.0, 40.0),
        ):
            for value in (values.min(), values.max()):
                validate.number(name, value, unit, least=least, most=most)
        t, s, d = temperature, salinity - 35, depth
        speed = 1448.96 + t * (4.591 + t * (-5.304e-2 + 2.374e-4 * t)) + 1.340 * s
        speed += d * (1.630e-2 + 1.675e-7 * d) - 1.025e-2 * t * s - 7.139e-13 * t * d**3
        return cls(depth, speed, surface_z_m)

    @classmethod
    def from_teos10(
        cls,
        depth_m: ArrayLike,
        temperature_c: ArrayLike,
        salinity: ArrayLike,
        *,
        longitude_deg: float,
        latitude_deg: float,
        surface_z_m: float = 0.0,
    ) -> Self:
        """Return the profile of measured temperatures and salinities, by TEOS-10.

        This is the equation of state of sea water, from the package gsw [1]_. It applies to
        brackish and fresh water too.

        Parameters
        ----------
        depth_m, temperature_c, salinity, surface_z_m
            As for `from_temperature`. The temperature is that in place, on the scale ITS-90.
        longitude_deg, latitude_deg : float
            Place of the measurement, degrees.

        Raises
        ------
        ImportError
            If gsw is not installed.
        TypeError, ValueError
            If a temperature is outside -2 to 40 degrees, a salinity outside 0 to 42, a coordinate
            is outside its limits, and as for `SoundSpeed`.

        References
        ----------
        .. [1] McDougall, Barker, "Getting started with TEOS-10 and the Gibbs Seawater (GSW)
           Oceanographic Toolbox", SCOR/IAPSO WG127, 2011.
        """
        import clsas.simulation

        depth, temperature, salinity = _measured(depth_m, temperature_c, salinity)
        for name, values, unit, least, most in (
            ("depth_m", depth, "m", 0.0, _DEEPEST_M),
            ("temperature_c", temperature, "degrees C", -2.0, 40.0),
            ("salinity", salinity, "", 0.0, 42.0),
        ):
            for value in (values.min(), values.max()):
                validate.number(name, value, unit, least=least, most=most)
        longitude = validate.number(
            "longitude_deg", longitude_deg, "degrees", least=-180.0, most=360.0
        )
        latitude = validate.number("latitude_deg", latitude_deg, "degrees", least=-90.0, most=90.0)
        place = longitude, latitude
        speed = clsas.simulation.teos10_speed_m_s(depth, temperature, salinity, *place)
        return cls(depth, speed, surface_z_m)

    @property
    def z_m(self) -> NDArray[np.float64]:
        """Heights of the depths, metres, descending, shape [n]."""
        return self.surface_z_m - self.depth_m

    def at(self, z_m: ArrayLike) -> NDArray[np.float64]:
        """Return the sound speed at heights z, metres per second, in the shape of `z_m`.

        Raises
        ------
        TypeError, ValueError
            If the heights are not numbers, or one is outside the profile.
        """
        z = validate.array("z_m", z_m, np.float64, None)
        check_reaches(self, z)
        return np.interp(self.surface_z_m - z, self.depth_m, self.speed_m_s)

    def mean_m_s(self, one_z_m: float, other_z_m: float) -> float:
        """Return the mean sound speed between two heights, metres per second.

        It is the harmonic mean over depth: the speed at which sound takes the same time on a
        straight path between these heights, whatever its slope.

        Raises
        ------
        TypeError, ValueError
            If a height is not a number, or is outside the profile.
        """
        one = validate.number("one_z_m", one_z_m, "m")
        other = validate.number("other_z_m", other_z_m, "m")
        check_reaches(self, one, "`one_z_m`")
        check_reaches(self, other, "`other_z_m`")
        top, bottom = max(one, other), min(one, other)
        ends = np.array([top, bottom])
        speeds = self.at(ends)
        if top == bottom:
            return float(speeds[0])
        z = self.z_m
        inside = (z < top) & (z > bottom)
        depth = np.concatenate([[-top], -z[inside], [-bottom]])
        speed = np.concatenate([speeds[:1], self.speed_m_s[inside], speeds[1:]])
        slower, faster = np.minimum(speed[:-1], speed[1:]), np.maximum(speed[:-1], speed[1:])
        relative = (faster - slower) / slower
        # The integral of 1/c over a linear piece is thickness ln(c2/c1)/(c2 - c1).
        share = np.divide(
            np.log1p(relative), relative, out=np.ones_like(relative), where=relative > 0
        )
        return float((top - bottom) / np.sum(np.diff(depth) / slower * share))


def range_bounds_m(
    profile: SoundSpeed, near_m: NDArray[np.float64], far_m: NDArray[np.float64], speed_m_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return bounds of ranges in a profile from those in water of the speed by which they count."""
    fastest, slowest = profile.speed_m_s.max(), profile.speed_m_s.min()
    return near_m * (speed_m_s / fastest), far_m * (speed_m_s / slowest)


def check_reaches(profile: SoundSpeed, z_m: ArrayLike, name: str = "`z_m`") -> None:
    """Raise ValueError if heights of antennas or pixels lie outside a profile."""
    z = np.asarray(z_m, np.float64)
    if not z.size:
        return
    depth = profile.surface_z_m - np.array([z.max(), z.min()])
    first, last = float(profile.depth_m[0]), float(profile.depth_m[-1])
    slack = 1e-9 * max(1.0, abs(profile.surface_z_m), last)
    if depth[0] >= first - slack and depth[1] <= last + slack:
        return
    # The deepest ocean is 11 km deep, so depths in kilometres end below 12.
    is_km = last <= _DEEPEST_M / 1e3 and last < depth[1] <= 1e3 * last
    advice = "; if its depths are kilometres, multiply them by 1000" if is_km else ""
    raise ArgumentError(
        "sound_speed",
        f"include the depths of {name}, {depth[0]:g} to {depth[1]:g} m",
        f"a profile from {first:g} to {last:g} m (depth is `surface_z_m` = "
        f"{profile.surface_z_m:g} m minus z)",
        f"extend the profile, or correct `surface_z_m`{advice}",
    )


def _measured(*arguments: ArrayLike) -> tuple[NDArray[np.float64], ...]:
    """Return depths, temperatures and salinities as arrays of one length."""
    names = ("depth_m", "temperature_c", "salinity")
    depth = validate.array(names[0], arguments[0], np.float64, (None,))
    others = []
    for name, value in zip(names[1:], arguments[1:], strict=True):
        given = validate.array(name, value, np.float64, None)
        everywhere = np.broadcast_to(given, depth.shape) if given.ndim == 0 else given
        others.append(validate.array(name, everywhere, np.float64, depth.shape))
    return depth, *others


def _check_depths(depth: NDArray[np.float64]) -> None:
    if len(depth) < 2:
        hint = "a constant speed is `sound_speed_m_s`"
        raise ArgumentError("depth_m", "have at least 2 depths", "1", hint)
    if not np.all(np.diff(depth) > 0):
        at = int(np.argmin(np.diff(depth) > 0))
        got = f"{depth[at + 1]:g} m after {depth[at]:g} m"
        raise ArgumentError("depth_m", "ascend (positive down)", got)
    for value in (depth[0], depth[-1]):
        validate.number("depth_m", value, "m", least=0.0, most=_DEEPEST_M)


def _check_speeds(depth: NDArray[np.float64], speed: NDArray[np.float64]) -> None:
    low, high = float(speed.min()), float(speed.max())
    if low < SLOWEST_M_S or high > FASTEST_M_S:
        advice = ""
        for unit, metres in (("feet per second", _FEET_M), ("kilometres per second", 1e3)):
            if low * metres >= SLOWEST_M_S and high * metres <= FASTEST_M_S:
                advice = f"these look like {unit}, multiply them by {metres:g}"
        allowed = f"be that of water, {SLOWEST_M_S:g} to {FASTEST_M_S:g} m/s"
        raise ArgumentError("speed_m_s", allowed, f"{low:g} to {high:g} m/s", advice)
    steepness = np.abs(np.diff(speed)) / np.diff(depth)
    at = int(steepness.argmax())
    if steepness[at] > STEEPEST_PER_S:
        raise ArgumentError(
            "speed_m_s",
            f"change by at most {STEEPEST_PER_S:g} m/s per metre of `depth_m`",
            f"{speed[at]:g} m/s at {depth[at]:g} m and {speed[at + 1]:g} m/s at "
            f"{depth[at + 1]:g} m",
            "remove the outlier",
        )
