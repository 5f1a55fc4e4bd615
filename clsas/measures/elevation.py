"""How the phase between two receivers changes with height.

An echo tells its range, not its height. A point that rises while its range and its position along
the track stay the same moves along a circle about the track. The tangent of that circle is
perpendicular to the track and to the gradient of the range.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.geometry import unit_vectors

_LEAST_RISE = 1e-3  # of the tangent; directly below a track, no scatterer changes its height


class Sight(NamedTuple):
    """How two receivers, or two banks of them, see some points.

    Attributes
    ----------
    rad_m : float64 [points]
        Change K of the phase per metre of height along the curves of equal range; 0 where the
        curve does not rise.
    tangent : float64 [points, 2]
        x and y of the curve's tangent, per metre of rise.
    """

    rad_m: NDArray[np.float64]
    tangent: NDArray[np.float64]


def sight_along(
    along: NDArray[np.float64],
    mean: NDArray[np.float64],
    difference: NDArray[np.float64],
    rad_per_m: float,
) -> Sight:
    """Return how points are seen, from the gradients of their ranges.

    Parameters
    ----------
    along : float64 [points, 3]
        Direction of the track.
    mean, difference : float64 [points, 3]
        Gradients of the mean of the two ranges, and of the first range minus the second.
    rad_per_m : float
        Two-way phase per metre of range.
    """
    tangent = np.cross(along, mean)
    rise = tangent[:, 2]
    rises = np.abs(rise) > _LEAST_RISE * np.linalg.norm(tangent, axis=1)
    tangent = np.where(rises[:, None], tangent / np.where(rises, rise, 1)[:, None], 0)
    return Sight(rad_per_m * np.einsum("pi,pi->p", difference, tangent), tangent[:, :2])


def phase_per_height(
    points_m: NDArray[np.float64],
    tx_m: NDArray[np.float64],
    low_m: NDArray[np.float64],
    high_m: NDArray[np.float64],
    wavelength_m: float,
) -> NDArray[np.float64]:
    """Return how fast the phase between two receivers changes with height, rad/m, [points].

    The track is taken to pass at right angles to the vertical plane through the transmitter and
    the point.

    Parameters
    ----------
    points_m, tx_m, low_m, high_m : float64 [points, 3]
        Points, and the transmitter and the receivers that see each of them.
    wavelength_m : float
    """
    ways_m = [points_m - each_m for each_m in (tx_m, low_m, high_m)]
    w, u, v = map(unit_vectors, ways_m)
    along = np.cross(ways_m[0], [0.0, 0.0, 1.0])
    return sight_along(along, (2 * w + u + v) / 4, (v - u) / 2, 4 * np.pi / wavelength_m).rad_m
