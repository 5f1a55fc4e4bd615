"""Heights on a regular lattice, and the points on and above them that are in view of a sonar."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from clsas.engine.data import validate

Elevations = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


class BentRays(NamedTuple):
    """Elevations at which bent rays leave a position.

    An elevation is any measure that is the same along a ray, and grows with the height. It is NaN
    without a ray: such points count as lit, and cast no shadows.

    Attributes
    ----------
    of_points : float64 [points]
        Elevations to the points in question.
    towards : callable
        towards(ground_m [n], rise_m [n]) returns the elevations to other points, at horizontal
        distances and relative heights.
    """

    of_points: NDArray[np.float64]
    towards: Elevations


_CLEAR = -1e30  # height beyond the lattice, where nothing casts shadows


@dataclass(frozen=True, eq=False)
class HeightField:
    """Heights at the points of a regular lattice, linear in between.

    Attributes
    ----------
    x_m, y_m : (first, last)
        Positions of the first and last column and row, ascending.
    heights_m : float64 [rows, columns]
    """

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    heights_m: NDArray[np.float64]

    @property
    def steps_m(self) -> tuple[float, float]:
        """Distance between columns and between rows, metres."""
        rows, columns = self.heights_m.shape
        return (self.x_m[1] - self.x_m[0]) / (columns - 1), (self.y_m[1] - self.y_m[0]) / (rows - 1)

    @property
    def cell_areas_m2(self) -> NDArray[np.float64]:
        """Surface area of every cell between four lattice points, [rows - 1, columns - 1]."""
        dx, dy = self.steps_m
        h = self.heights_m
        along_x = (h[:-1, 1:] - h[:-1, :-1] + h[1:, 1:] - h[1:, :-1]) / (2 * dx)
        along_y = (h[1:, :-1] - h[:-1, :-1] + h[1:, 1:] - h[:-1, 1:]) / (2 * dy)
        return dx * dy * np.sqrt(1 + along_x**2 + along_y**2)

    def height_m(self, x_m: ArrayLike, y_m: ArrayLike) -> NDArray[np.float64]:
        """Return the heights at positions, which broadcast. Beyond the lattice they are NaN."""
        x, y = np.broadcast_arrays(np.asarray(x_m, np.float64), np.asarray(y_m, np.float64))
        dx, dy = self.steps_m
        where = [((y - self.y_m[0]) / dy).ravel(), ((x - self.x_m[0]) / dx).ravel()]
        heights = map_coordinates(self.heights_m, where, order=1, mode="constant", cval=np.nan)
        return heights.reshape(x.shape)

    def lit(
        self,
        offsets_m: NDArray[np.float64],
        eye_m: NDArray[np.float64],
        bent: BentRays | None = None,
    ) -> NDArray[np.bool_]:
        """Return a mask of the points with a clear line of sight to a position, bool [points].

        A polar fan of rays surrounds the position. A point is lit if its elevation is not below the
        largest elevation on the nearest ray, up to one or two lattice steps before the point.

        Parameters
        ----------
        offsets_m : float64 [3, points]
            Points relative to the position.
        eye_m : float64 [3]
            The position.
        bent : BentRays, optional
            Elevations of the rays; by default they are straight.
        """
        x, y, z = offsets_m
        lowest = eye_m[2] + min(z.min(initial=0.0), 0.0)
        if not x.size or (lowest >= self._level_m and not self._relative_heights.any()):
            return np.ones(x.size, bool)
        step = min(self.steps_m)
        # Azimuth is measured from the direction to the middle of the lattice. Then no ray to a
        # lattice on one side of the sonar is at +-180 degrees.
        centre = np.arctan2(sum(self.y_m) / 2 - eye_m[1], sum(self.x_m) / 2 - eye_m[0])
        cosine, sine = np.cos(centre), np.sin(centre)
        ground = np.sqrt(x**2 + y**2)
        azimuth = np.arctan2(cosine * y - sine * x, cosine * x + sine * y)
        # The rays must not depend on the points. Otherwise whether a point is lit would depend on
        # the other points.
        away = np.abs([np.subtract(self.x_m, eye_m[0]), np.subtract(self.y_m, eye_m[1])])
        ray_step = step / max(np.hypot(*away.max(axis=1)), step)
        first_ray = np.floor(azimuth.min() / ray_step)
        ray = np.rint(azimuth / ray_step - first_ray).astype(np.intp)
        angles = centre + ray_step * (first_ray + np.arange(ray.max() + 1))
        nearest = max(_distance(eye_m[0], self.x_m), _distance(eye_m[1], self.y_m), step)
        # Nothing beyond the lattice casts shadows.
        last = np.ceil((np.hypot(*away.max(axis=1)) - nearest) / step) + 2
        before = np.floor(np.minimum((ground - nearest) / step, last)).astype(np.intp) - 1
        ranges = nearest + step * np.arange(max(before.max(), 0) + 1)

        validate.memory("heights_m", 40 * len(angles) * len(ranges))
        dx, dy = self.steps_m
        columns = (np.cos(angles)[:, None] * ranges + (eye_m[0] - self.x_m[0])) / dx
        rows = (np.sin(angles)[:, None] * ranges + (eye_m[1] - self.y_m[0])) / dy
        fan = map_coordinates(
            self._relative_heights,
            [rows, columns],
            np.float32,
            order=1,
            mode="constant",
            cval=_CLEAR,
        )
        fan -= np.float32(eye_m[2] - self._level_m)
        if bent is None:
            fan /= ranges.astype(np.float32)
            elevation = z / np.maximum(ground, np.finfo(float).tiny)
        else:
            fan = self._elevations(fan, ranges, bent.towards)
            elevation = np.nan_to_num(bent.of_points, nan=np.inf)
        highest = np.maximum.accumulate(fan, axis=1)
        return (before < 0) | (elevation >= highest[ray, np.maximum(before, 0)])

    def _elevations(
        self, fan: NDArray[np.float32], ranges: NDArray[np.float64], towards: Elevations
    ) -> NDArray[np.float32]:
        """Return the elevations of bent rays to relative heights, [rays, ranges]."""
        covered = fan > _CLEAR / 2
        found = np.full(fan.shape, np.float32(_CLEAR))
        along = np.broadcast_to(ranges, fan.shape)[covered]
        found[covered] = np.nan_to_num(towards(along, fan[covered].astype(float)), nan=_CLEAR)
        return found

    @property
    def _level_m(self) -> float:
        """Lowest height, to which `_relative_heights` refer."""
        return float(self.heights_m.min())

    @cached_property
    def _relative_heights(self) -> NDArray[np.float32]:
        """Heights above the lowest one, so that single precision resolves them."""
        return (self.heights_m - self._level_m).astype(np.float32)


def _distance(x: float, interval: tuple[float, float]) -> float:
    return max(interval[0] - x, x - interval[1], 0.0)
