"""Tables of travel times along rays, for scenes with many points."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from clsas.core.rays import rays
from clsas.core.sound_speed import SoundSpeed, check_reaches
from clsas.core.thinning import thinned

_DISTANCES, _HEIGHTS = 8, 4  # entries of the first attempt at a table; each further doubles both
_ATTEMPTS = 4
_READ_AT_ONCE = 1 << 12  # times that are read together; they fit into a cache
TABLE_ERROR_S = 2e-12
"""Largest error of tabulated times, seconds: 1e-5 radians at 800 kHz."""


@dataclass(frozen=True, eq=False)
class RayTable:
    """Travel times from one height to many, interpolated from a table.

    The table contains the square of the mean slowness, t^2/(D^2 + H^2) with distance D and height
    difference H, which hardly varies. Chebyshev polynomials interpolate it, one for each layer.

    Attributes
    ----------
    antenna_z_m : float
    edges_z_m : float64 [layers + 1]
        Ascending heights between which one polynomial is used.
    horizontal_m : (float, float)
        Smallest and largest distance.
    coefficients : tuple of float64 [distances, heights]
        Coefficients of the products of Chebyshev polynomials of every layer.
    error_s : float
        Largest error found between the entries, seconds.
    """

    antenna_z_m: float
    edges_z_m: NDArray[np.float64]
    horizontal_m: tuple[float, float]
    coefficients: tuple[NDArray[np.float64], ...]
    error_s: float

    @classmethod
    def of(
        cls,
        profile: SoundSpeed,
        antenna_z_m: float,
        horizontal_m: tuple[float, float],
        z_m: tuple[float, float],
    ) -> RayTable | None:
        """Return a table for distances and heights between limits.

        It is None if there are shadow zones between these limits, or if the times are not smooth
        enough for a table; `rays` must then be called itself.
        """
        check_reaches(profile, np.array([antenna_z_m, *z_m]))
        low, high = z_m
        kinks = [*thinned(profile).z_m, antenna_z_m]
        edges = np.unique([low, *(z for z in kinks if low < z < high), high])
        edges = edges if len(edges) > 1 else np.repeat(edges, 2)
        found = []
        for heights in pairwise(map(float, edges)):
            layer = _layer(profile, antenna_z_m, horizontal_m, heights)
            if layer is None:
                return None
            found.append(layer)
        coefficients, errors = zip(*found, strict=True)
        return cls(antenna_z_m, edges, horizontal_m, coefficients, max(errors))

    def times(
        self, horizontal_m: NDArray[np.float64], z_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the travel times to distances and heights within the table, seconds, [n]."""
        time = np.empty(horizontal_m.shape)
        for first in range(0, len(time), _READ_AT_ONCE):
            some = slice(first, first + _READ_AT_ONCE)
            time[some] = self._some_times(horizontal_m[some], z_m[some])
        return time

    def _some_times(
        self, horizontal: NDArray[np.float64], z: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        if len(self.coefficients) == 1:
            square = self._squares(0, horizontal, z)
        else:
            square = np.empty(len(z))
            layer = np.searchsorted(self.edges_z_m[1:-1], z)
            for index in np.unique(layer):
                here = layer == index
                square[here] = self._squares(index, horizontal[here], z[here])
        return np.sqrt(square * (horizontal**2 + (z - self.antenna_z_m) ** 2))

    def _squares(
        self, index: int, horizontal: NDArray[np.float64], z: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the squares of the mean slowness to positions in one layer, [n]."""
        coefficients = self.coefficients[index]
        heights = self.edges_z_m[index], self.edges_z_m[index + 1]
        along, up = (
            chebyshev.chebvander(_scaled(values, limits), count - 1)
            for values, limits, count in zip(
                (horizontal, z), (self.horizontal_m, heights), coefficients.shape, strict=True
            )
        )
        return np.einsum("nj,nj->n", along @ coefficients, up)


def _scaled(values: NDArray[np.float64], limits: tuple[float, float]) -> NDArray[np.float64]:
    """Return values scaled so that the limits become -1 and 1; 0 without an extent."""
    low, high = limits
    if high == low:
        return np.zeros_like(values)
    return (2 * values - (low + high)) / (high - low)


def _layer(
    profile: SoundSpeed,
    antenna_z: float,
    horizontal: tuple[float, float],
    heights: tuple[float, float],
) -> tuple[NDArray[np.float64], float] | None:
    """Return the coefficients of one layer and the largest error of times, seconds.

    It is None if there are shadow zones, or the largest table is not accurate enough.
    """

    def squares(distance: NDArray, z: NDArray) -> NDArray[np.float64] | None:
        found = rays(profile, distance[:, None], antenna_z, z)
        path2 = distance[:, None] ** 2 + (z - antenna_z) ** 2
        at_antenna = np.full(path2.shape, 1 / float(profile.at(antenna_z)) ** 2)
        if not found.exists.all():
            return None
        return np.divide(found.time_s**2, path2, out=at_antenna, where=path2 > 0)

    def within(limits: tuple[float, float], scaled: NDArray[np.float64]) -> NDArray[np.float64]:
        low, high = limits
        return np.clip((low + high + (high - low) * scaled) / 2, low, high)

    for attempt in range(_ATTEMPTS):
        counts = [
            1 if limits[1] == limits[0] else count << attempt
            for limits, count in ((horizontal, _DISTANCES), (heights, _HEIGHTS))
        ]
        nodes = [chebyshev.chebpts1(count) for count in counts]
        table = squares(*(within(*each) for each in zip((horizontal, heights), nodes, strict=True)))
        if table is None:
            return None
        for axis, (node, count) in enumerate(zip(nodes, counts, strict=True)):
            transform = chebyshev.chebvander(node, count - 1).T * 2 / count
            transform[0] /= 2
            table = np.moveaxis(np.tensordot(transform, table, (1, axis)), 0, axis)
        found = RayTable(antenna_z, np.array(heights), horizontal, (table,), 0.0)
        checked = [
            within(limits, np.linspace(-1, 1, 2 * count + 1))
            for limits, count in zip((horizontal, heights), counts, strict=True)
        ]
        truth = rays(profile, checked[0][:, None], antenna_z, checked[1])
        if not truth.exists.all():
            return None
        distance, z = (each.ravel() for each in np.meshgrid(*checked, indexing="ij"))
        error_s = float(np.abs(found.times(distance, z) - truth.time_s.ravel()).max())
        if error_s <= TABLE_ERROR_S:
            return table, error_s
    return None
