"""Rays in water whose sound speed varies with depth: travel times between two positions.

In a layer in which the speed c is linear in depth, a ray is an arc of a circle. Its horizontal
slowness p = cos(angle)/c is the same in all layers (Snell's law). With w = sqrt(1 - p^2 c^2), the
sine of its angle, and the speeds a and b at the ends of a piece of thickness h,

    X = p h (a + b)/(w_a + w_b)                                    (horizontal distance)
    t = S atanh(g S)/(g S),   g = (b - a)/h,                       (travel time)
    S = h (a + b)(1 + w_a w_b)/((w_a + w_b)(a^2 + b^2 - p^2 a^2 b^2)).

These are the usual formulas of arcs [1]_, rearranged so that no difference of nearly equal
numbers remains, and that g = 0 is no exception. With C the largest speed on the way and
v = 1/(p C)^2 - 1, X falls as v grows, and 1/X^2 is almost linear in v: a few steps of Newton's
method find the ray. Its time, taken as sum(t) + p (D - X) for the distance D, is stationary in p
(Fermat), so that it is accurate to rounding.

The energy between neighbouring rays spreads out: the amplitude falls as 1/L, with

    L^2 = D |dD/dp| w_1 w_2/(p c_1 c_2)

for the speeds c and sines w at the two ends ([1]_, section 3.3.5). Sound takes the same loss both
ways, and in homogeneous water L is the length of the path. In a linear gradient g it is
sqrt(c_1 c_2) sinh(g t)/g. At caustics, where neighbouring rays cross, L is 0.

.. [1] Jensen, Kuperman, Porter, Schmidt, "Computational Ocean Acoustics", 2nd edition, Springer,
   2011, section 3.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data.sound_speed import SoundSpeed, check_reaches
from clsas.engine.water.thinning import thinned

_STEPS = 60  # of Newton's method, at most; 3 to 8 are usual
_CLOSE = 1e-14  # relative error of the distance at which a ray counts as found
_VERTICAL = 1e-9  # least horizontal distance over height, for which a time differs by 1e-18
_TURNS = 32  # depths per layer at which turning rays are tried before they are refined
_HALVINGS = 50  # of the interval between two of them
_LEVEL = 1e-100  # sine of angles that stands for 0, so that limits need no formula of their own
_AT_ONCE = 1 << 15  # rays that are computed together; bounds memory
_PIECES_AT_ONCE = 1 << 22  # of rays, one per layer; bounds memory for profiles of many depths
_TURNING_AT_ONCE = 1 << 9


@dataclass(frozen=True, eq=False)
class Rays:
    """Direct rays between pairs of positions; all arrays have one shape.

    Attributes
    ----------
    time_s : float64
        Travel time; infinite where there is no ray.
    slowness_s_m : float64
        Horizontal slowness: the change of the travel time per metre of horizontal distance.
    one_slope_s_m, other_slope_s_m : float64
        Change of the travel time per metre that one (the other) end moves up.
    spreading_m : float64
        Length whose inverse is the amplitude relative to that at 1 m: the distance in homogeneous
        water, 0 at caustics.
    exists : bool
        False in shadow zones.
    """

    time_s: NDArray[np.float64]
    slowness_s_m: NDArray[np.float64]
    one_slope_s_m: NDArray[np.float64]
    other_slope_s_m: NDArray[np.float64]
    spreading_m: NDArray[np.float64]
    exists: NDArray[np.bool_]


def rays(
    profile: SoundSpeed, horizontal_m: ArrayLike, one_z_m: ArrayLike, other_z_m: ArrayLike
) -> Rays:
    """Return the direct rays between pairs of positions.

    Parameters
    ----------
    profile : SoundSpeed
    horizontal_m : array_like of float
        Horizontal distances of the two positions, metres.
    one_z_m, other_z_m : array_like of float
        Heights of the two positions, metres; all three arguments broadcast.

    Returns
    -------
    Rays

    Raises
    ------
    ValueError
        If a height is outside the profile.

    Notes
    -----
    A direct ray neither passes below the deeper of its ends, where the seabed is, nor meets the
    surface. Where no ray rises or falls all the way, one that first rises above both ends and turns
    is taken; if there are several, the first to arrive.

    Profiles of more than 64 depths are thinned; see `clsas.engine.water.thinning`.
    """
    distance, one, other = np.broadcast_arrays(
        *(np.asarray(each, np.float64) for each in (horizontal_m, one_z_m, other_z_m))
    )
    for z in (one, other):
        check_reaches(profile, z)
    profile = thinned(profile)
    found = np.empty((6, distance.size))
    flat = [np.ravel(each) for each in (distance, one, other)]
    at_once = max(min(_AT_ONCE, _PIECES_AT_ONCE // len(profile.depth_m)), 1)
    for first in range(0, distance.size, at_once):
        some = slice(first, first + at_once)
        found[:, some] = _some_rays(profile, *(each[some] for each in flat))
    time, slowness, of_one, of_other, spreading, exists = found.reshape(6, *distance.shape)
    return Rays(time, slowness, of_one, of_other, spreading, exists > 0)


def farthest_m(profile: SoundSpeed, one_z_m: float, other_z_m: float) -> float:
    """Return the horizontal distance up to which direct rays connect two heights, metres.

    It is infinite if there is no shadow zone within 100 km, and accurate to a centimetre.
    """
    lit, dark = 0.0, 1e5
    if rays(profile, dark, one_z_m, other_z_m).exists:
        return float("inf")
    while dark - lit > 0.01:
        middle = (lit + dark) / 2
        if rays(profile, middle, one_z_m, other_z_m).exists:
            lit = middle
        else:
            dark = middle
    return lit


def shadow(profile: SoundSpeed, horizontal_m: float, one_z_m: float, other_z_m: float) -> str:
    """Return the explanation that no direct ray connects two positions."""
    reach = farthest_m(profile, one_z_m, other_z_m)
    depths = (profile.surface_z_m - np.array([one_z_m, other_z_m])).round(2)
    return (
        f"no direct ray connects depths of {depths[0]:g} m and {depths[1]:g} m over "
        f"{horizontal_m:.1f} m: the sound speed bends rays away beyond {reach:.1f} m, a shadow "
        "zone. Use only nearer ranges, or check `sound_speed`"
    )


@dataclass(frozen=True, eq=False)
class _Way:
    """Pieces of the way from one depth down to another, [layers, rays].

    Attributes
    ----------
    thickness, above, below : float64 [layers, rays]
        Thickness of every piece, and the speeds at its upper and lower end.
    fastest : float64 [rays]
        Largest speed on the way.
    """

    thickness: NDArray[np.float64]
    above: NDArray[np.float64]
    below: NDArray[np.float64]
    fastest: NDArray[np.float64]

    @classmethod
    def between(
        cls, profile: SoundSpeed, upper: NDArray[np.float64], lower: NDArray[np.float64]
    ) -> _Way:
        """Return the way between depths, `upper` above `lower`, [rays] each."""
        edges, speeds = profile.depth_m[:, None], profile.speed_m_s[:, None]
        steepness = np.diff(speeds, axis=0) / np.diff(edges, axis=0)
        start = np.clip(upper, edges[:-1], edges[1:])
        stop = np.clip(lower, edges[:-1], edges[1:])
        thickness = np.maximum(stop - start, 0.0)
        above = speeds[:-1] + steepness * (start - edges[:-1])
        below = speeds[:-1] + steepness * (stop - edges[:-1])
        crossed = thickness > 0
        at_top = np.interp(upper, profile.depth_m, profile.speed_m_s)
        above, below = (np.where(crossed, each, at_top) for each in (above, below))
        fastest = np.maximum(above.max(axis=0), below.max(axis=0))
        return cls(thickness, above, below, fastest)

    @cached_property
    def _excess(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The excess at the upper and lower end of every piece."""
        return self.excess(self.above), self.excess(self.below)

    def excess(self, speed: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return 1 - (c/C)^2 for speeds c, with C the largest speed."""
        return (self.fastest - speed) * (self.fastest + speed) / self.fastest**2

    def distance(self, v: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the horizontal distance for v = 1/(p C)^2 - 1, and its derivative, [rays]."""
        above, below = (np.sqrt(v + excess) for excess in self._excess)
        with np.errstate(divide="ignore", invalid="ignore"):
            pieces = self.thickness * (self.above + self.below) / self.fastest / (above + below)
            pieces = np.where(self.thickness > 0, pieces, 0.0)
            slopes = np.where(self.thickness > 0, -pieces / (2 * above * below), 0.0)
        return pieces.sum(axis=0), slopes.sum(axis=0)

    def turned_slope(self, layer: int) -> NDArray[np.float64]:
        """Return dD/dp of the way below the depth in a layer at which a ray turns, [rays].

        The piece of that layer is w_b/(p |g|), which becomes shorter as p grows.
        """
        above, below = (np.maximum(np.sqrt(excess), _LEVEL) for excess in self._excess)
        pieces = self.thickness * (self.above + self.below) / (above + below)
        above[layer] = -below[layer]
        return np.sum(pieces / (above * below), axis=0)

    def time(self, v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the travel time of the ray with v = 1/(p C)^2 - 1, [rays]."""
        above, below = (np.sqrt((v + excess) / (1 + v)) for excess in self._excess)
        a, b, slowness2 = self.above, self.below, 1 / (self.fastest**2 * (1 + v))
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = (a + b) * (1 + above * below) / (above + below)
            scale /= a**2 + b**2 - slowness2 * a**2 * b**2
            turned = scale * (b - a)  # g S
            turned = np.where(self.thickness > 0, turned, 0.0)
            factor = np.where(turned != 0, np.arctanh(turned) / turned, 1.0)
            pieces = np.where(self.thickness > 0, self.thickness * scale * factor, 0.0)
        return pieces.sum(axis=0)


def _some_rays(
    profile: SoundSpeed,
    distance: NDArray[np.float64],
    one_z: NDArray[np.float64],
    other_z: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return what `Rays` contain, with 1 where there is a ray, [6, rays]."""
    one, other = profile.surface_z_m - one_z, profile.surface_z_m - other_z
    limits = profile.depth_m[0], profile.depth_m[-1]
    upper, lower = (np.clip(pick(one, other), *limits) for pick in (np.minimum, np.maximum))
    way = _Way.between(profile, upper, lower)
    height = way.thickness.sum(axis=0)
    distance = np.maximum(distance, _VERTICAL * height)
    v = _found_v(way, height, distance)
    at_ends = [np.interp(depth, profile.depth_m, profile.speed_m_s) for depth in (upper, lower)]
    with np.errstate(invalid="ignore"):
        slowness = 1 / (way.fastest * np.sqrt(1 + v))
        covered, per_v = way.distance(np.maximum(v, _LEVEL**2))
        time = way.time(v) + slowness * (distance - covered)
        spread = -2 * (way.fastest * (1 + v)) ** 2 * per_v  # dD/dp/p
    level = height == 0
    if level.any():
        straight = level & _constant_at(profile, upper)
        slowness[straight] = 1 / at_ends[0][straight]
        time[straight] = (distance * slowness)[straight]
        v[straight] = 0.0
        same = level & (distance == 0)
        time[same], v[same] = 0.0, 0.0
        slowness[same] = 0.0
    turns = np.zeros(len(v), bool)
    missing = np.flatnonzero(np.isnan(v))
    at_once = max(min(_TURNING_AT_ONCE, _PIECES_AT_ONCE // len(profile.depth_m)), 1)
    for first in range(0, len(missing), at_once):
        some = missing[first : first + at_once]
        slowness[some], time[some], spread[some] = _turning(
            profile, distance[some], upper[some], lower[some]
        )
        turns[some] = np.isfinite(time[some])
    exists = ~np.isnan(v) | turns
    steep = []
    for speed in at_ends:
        sine = np.sqrt((np.maximum(v, _LEVEL**2) + way.excess(speed)) / (1 + v))
        cosine = np.minimum(slowness[turns] * speed[turns], 1.0)
        sine[turns] = np.sqrt((1 - cosine) * (1 + cosine))
        steep.append(sine / speed)
    spreading = np.sqrt(distance * np.abs(spread) * steep[0] * steep[1])
    spreading[level & ~turns] = distance[level & ~turns]
    at_upper, at_lower = np.where(turns, -steep[0], steep[0]), -steep[1]
    slopes = [
        np.where(one <= other, at_upper, at_lower), np.where(one <= other, at_lower, at_upper),
    ]  # fmt: skip
    found = np.stack([time, slowness, *slopes, spreading, exists.astype(np.float64)])
    found[0, ~exists] = np.inf
    found[1:5, ~exists] = 0.0
    return found


def _found_v(
    way: _Way, height: NDArray[np.float64], distance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return v of the rays that do not turn and cover some distances; NaN where there is none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        limit, _ = way.distance(np.zeros_like(distance))
        limit = np.where(np.isnan(limit), np.inf, limit)
        found = np.where((distance <= limit) & (height > 0), (height / distance) ** 2, np.nan)
    left = np.flatnonzero(~np.isnan(found))
    low, high = np.zeros(len(found)), found.copy()
    for _ in range(_STEPS):
        if not left.size:
            break
        part = _Way(way.thickness[:, left], way.above[:, left], way.below[:, left],
                    way.fastest[left])  # fmt: skip
        v, wanted = found[left], distance[left]
        reached, slope = part.distance(v)
        high[left] = np.where(reached <= wanted, np.minimum(high[left], v), high[left])
        low[left] = np.where(reached >= wanted, np.maximum(low[left], v), low[left])
        with np.errstate(divide="ignore", invalid="ignore"):
            step = (reached**3 / wanted**2 - reached) / (-2 * slope)
        newer = v + step
        outside = ~((newer >= low[left]) & (newer <= high[left]))
        newer = np.where(outside, (low[left] + high[left]) / 2, newer)
        done = np.abs(reached - wanted) <= _CLOSE * wanted
        found[left] = np.where(done, v, newer)
        left = left[~done & (newer != v)]
    return found


def _constant_at(profile: SoundSpeed, depth: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether depths lie in a layer of constant speed, or on its edge."""
    flat = np.flatnonzero(np.diff(profile.speed_m_s) == 0)
    starts, stops = profile.depth_m[flat], profile.depth_m[flat + 1]
    return np.any((depth[:, None] >= starts) & (depth[:, None] <= stops), axis=1)


def _turning(
    profile: SoundSpeed,
    distance: NDArray[np.float64],
    upper: NDArray[np.float64],
    lower: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return slowness p, time and dD/dp/p of rays that rise above both ends.

    Times are infinite where there is none.

    A ray turns at the depth where the speed is 1/p, if it is slower everywhere below.
    """
    best_time = np.full(len(distance), np.inf)
    best_slowness, best_spread = np.zeros((2, len(distance)))
    edges, speeds = profile.depth_m, profile.speed_m_s
    fraction = np.linspace(0, 1, _TURNS + 1)[:, None]
    for layer in np.flatnonzero(np.diff(speeds) < 0):
        top, bottom = edges[layer], np.minimum(edges[layer + 1], upper)
        reach = np.maximum(bottom - top, 0.0)

        def turned(
            share: NDArray[np.float64], some: NDArray[np.int64], reach=reach, bottom=bottom
        ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], list[_Way]]:
            """Return distance, time, slowness and ways for turns at some share of the layer."""
            # The distance has a square root at the start of the layer, hence the square.
            depth = bottom[some] - reach[some] * share**2
            speed = np.interp(depth, edges, speeds)
            parts = [_Way.between(profile, depth, end[some]) for end in (upper, lower)]
            allowed = np.all([part.fastest <= speed for part in parts], axis=0) & (share > 0)
            parts = [_Way(p.thickness, p.above, p.below, np.maximum(p.fastest, speed))
                     for p in parts]  # fmt: skip
            nothing = np.zeros(len(depth))
            covered = sum(part.distance(nothing)[0] for part in parts)
            time = sum(part.time(nothing) for part in parts)
            slowness = 1 / speed
            time = time + slowness * (distance[some] - covered)
            return np.where(allowed, covered, np.nan), time, slowness, parts

        everything = np.flatnonzero(reach > 0)
        if not everything.size:
            continue
        covered = np.stack([turned(np.full(len(everything), s[0]), everything)[0]
                            for s in fraction])  # fmt: skip
        beyond = covered - distance[everything]
        # At the start of the layer above the upper end the turning ray is the direct one.
        starts = (edges[layer + 1] >= upper)[everything]
        direct = _Way.between(profile, upper[everything], lower[everything])
        limit = direct.distance(np.zeros(len(everything)))[0]
        shallow = np.interp(upper[everything], edges, speeds) >= direct.fastest
        beyond[0] = np.where(starts & shallow, limit - distance[everything], np.nan)
        with np.errstate(invalid="ignore"):
            crossed = beyond[:-1] * beyond[1:] <= 0
        step, ray = np.nonzero(crossed)
        some, low, high = everything[ray], fraction[step, 0], fraction[step + 1, 0]
        sign = np.where(beyond[step + 1, ray] < 0, -1.0, 1.0)
        for _ in range(_HALVINGS if some.size else 0):
            middle = (low + high) / 2
            is_beyond = sign * (turned(middle, some)[0] - distance[some]) > 0
            low, high = np.where(is_beyond, low, middle), np.where(is_beyond, middle, high)
        _, time, slowness, parts = turned(high, some)
        spread = np.sum([part.turned_slope(int(layer)) for part in parts], axis=0) / slowness
        order = np.argsort(-time)  # so that the first to arrive is kept
        earlier = order[time[order] < best_time[some[order]]]
        best_time[some[earlier]], best_slowness[some[earlier]] = time[earlier], slowness[earlier]
        best_spread[some[earlier]] = spread[earlier]
    return best_slowness, best_time, best_spread
