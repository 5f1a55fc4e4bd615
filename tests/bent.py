"""Travel times along rays by quadrature, which share nothing with the library's closed forms."""

from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline

NODES, WEIGHTS = np.polynomial.legendre.leggauss(48)


def travel_times(depth_m, speed_m_s, upper_m, lower_m, farthest_m, count=6000):
    """Function of the horizontal distance: time between two depths, by Snell's law and quadrature.

    The angle at the fastest place is the parameter. The slope of time over distance is the
    horizontal slowness, so that a Hermite spline through the pairs is accurate to rounding.
    """
    edges = [upper_m, *(d for d in depth_m if upper_m < d < lower_m), lower_m]
    depth = np.concatenate([(a + b + (b - a) * NODES) / 2 for a, b in pairwise(edges)])
    weight = np.concatenate([(b - a) * WEIGHTS / 2 for a, b in pairwise(edges)])
    speed = np.interp(depth, depth_m, speed_m_s)
    ends = np.interp(edges, depth_m, speed_m_s)
    height, fastest = lower_m - upper_m, ends.max()
    tangent = np.concatenate([[0.0], np.geomspace(1e-3, 30 * farthest_m / height, count)])
    slowness = tangent / np.sqrt(1 + tangent**2) / fastest
    sine = np.sqrt(1 - (slowness[:, None] * speed) ** 2)
    distance = (slowness[:, None] * speed / sine) @ weight
    time = (1 / (speed * sine)) @ weight
    kept = np.concatenate([[True], np.diff(distance) > 0])
    assert distance[kept][-1] > farthest_m, "shadow, or rays too near the horizontal"
    return CubicHermiteSpline(distance[kept], time[kept], slowness[kept])


def shot(depth_m, speed_m_s, from_m, angle_rad, distance_m):
    """Depth and time of a ray at some distance, from the equations of motion.

    The ray starts at depth `from_m` with an angle below the horizontal.
    """
    steepness = np.diff(speed_m_s) / np.diff(depth_m)

    def motion(_, state):
        depth, angle = state[:2]
        speed = np.interp(depth, depth_m, speed_m_s)
        layer = np.clip(np.searchsorted(depth_m, depth) - 1, 0, len(steepness) - 1)
        # Over the horizontal distance: dz = tan, d(angle) = -c'/c, dt = 1/(c cos).
        return [np.tan(angle), -steepness[layer] / speed, 1 / (speed * np.cos(angle))]

    found = solve_ivp(
        motion, (0, distance_m), [from_m, angle_rad, 0.0], rtol=1e-11, atol=1e-12, max_step=0.05
    )
    return found.y[0, -1], found.y[2, -1]


def ranges_m(times, points_m, antennas_m, speed_m_s=1500.0):
    """Monostatic ranges [antennas, points] of points and antennas at one height each."""
    offset_m = points_m[None, :, :2] - antennas_m[:, None, :2]
    return speed_m_s * times(np.hypot(offset_m[..., 0], offset_m[..., 1]))
