"""Tables of rays from one height to many, for scenes with many points."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from clsas.engine.data.sound_speed import SoundSpeed, check_reaches
from clsas.engine.water.rays import Rays, rays
from clsas.engine.water.thinning import thinned

_DISTANCES, _HEIGHTS = 8, 4  # entries of the first attempt at a table; each further doubles both
_ATTEMPTS = 4
_LEFT_OUT = 0.05  # share of the error that small coefficients may cause which are left out
_READ_AT_ONCE = 1 << 12  # points that are read together; they fit into a cache
_ROUNDED = 8  # parts of an extent to which its limits are rounded, so that tables serve again
TABLE_ERROR_S = 2e-12
"""Largest error of tabulated times, seconds: 1e-5 radians at 800 kHz."""
TABLE_ERROR = 1e-8
"""Largest error of all other quantities: for elements of 30 wavelengths, 1e-6 of their pattern."""

Extent = tuple[float, float]


class Accuracy(NamedTuple):
    """Largest errors of tabulated times, seconds, and of all other quantities."""

    time_s: float = TABLE_ERROR_S
    other: float = TABLE_ERROR


USUAL = Accuracy()


class Quantity(Enum):
    """Quantity of the rays from an antenna to points, as a table contains it.

    All but the time are relative to the straight path, whose length is R: they hardly vary, and are
    1 or 0 in homogeneous water. The direction of a ray is that in which it leaves the antenna;
    multiply the horizontal components of the straight direction by `LEVEL`, and add `LIFT` to the
    vertical one. `LEVEL_THERE` and `LIFT_THERE` give the direction in which it arrives.

    The squares of the mean slowness, (time/R)^2, and of the spreading, (L/R)^2, are tabulated.
    """

    TIME = auto()
    LEVEL = auto()
    LIFT = auto()
    SPREADING = auto()
    LEVEL_THERE = auto()
    LIFT_THERE = auto()


Q = Quantity
TIMES: tuple[Quantity, ...] = (Q.TIME,)


def quantity_of(
    quantity: Quantity,
    found: Rays,
    profile: SoundSpeed,
    horizontal_m: NDArray[np.float64],
    antenna_z_m: NDArray[np.float64] | float,
    z_m: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return a quantity of rays; all arguments broadcast. Without a ray it is NaN."""
    values = _existing(quantity, found, profile, horizontal_m, antenna_z_m, z_m)
    return np.where(found.exists, values, np.nan)


def _existing(
    quantity: Quantity,
    found: Rays,
    profile: SoundSpeed,
    horizontal_m: NDArray[np.float64],
    antenna_z_m: NDArray[np.float64] | float,
    z_m: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return a quantity of rays as far as they exist."""
    if quantity is Q.TIME:
        return found.time_s
    rise_m = z_m - antenna_z_m
    length_m = np.hypot(horizontal_m, rise_m)
    with np.errstate(divide="ignore", invalid="ignore"):
        if quantity is Q.SPREADING:
            return np.where(length_m > 0, found.spreading_m / length_m, 1.0)
        there = quantity in (Q.LEVEL_THERE, Q.LIFT_THERE)
        speed_m_s = thinned(profile).at(np.asarray(z_m if there else antenna_z_m))
        if quantity in (Q.LIFT, Q.LIFT_THERE):
            slope = found.other_slope_s_m if there else -found.one_slope_s_m
            return np.where(length_m > 0, slope * speed_m_s - rise_m / length_m, 0.0)
        # A vertical ray has a slowness of 0; the ratio has a limit.
        beside_m = np.maximum(horizontal_m, 1e-9 * np.abs(rise_m))
        level = found.slowness_s_m * speed_m_s * length_m / beside_m
        return np.where(length_m > 0, level, 1.0)


@dataclass(frozen=True, eq=False)
class RayTable:
    """Quantities of rays from one height to many, interpolated from a table.

    Chebyshev polynomials interpolate every quantity, one for each layer.

    Attributes
    ----------
    antenna_z_m : float
    edges_z_m : float64 [layers + 1]
        Ascending heights between which one polynomial is used.
    horizontal_m : (float, float)
        Smallest and largest distance.
    quantities : tuple of Quantity
    coefficients : tuple of tuple of float64 [distances, heights]
        Coefficients of the products of Chebyshev polynomials, of every layer and quantity.
    """

    antenna_z_m: float
    edges_z_m: NDArray[np.float64]
    horizontal_m: Extent
    quantities: tuple[Quantity, ...]
    coefficients: tuple[tuple[NDArray[np.float64], ...], ...]

    @classmethod
    def of(
        cls,
        profile: SoundSpeed,
        antenna_z_m: float,
        horizontal_m: Extent,
        z_m: Extent,
        *,
        quantities: tuple[Quantity, ...] = TIMES,
        accuracy: Accuracy = USUAL,
    ) -> RayTable | None:
        """Return a table for distances and heights between limits.

        The result is None if there are shadow zones between these limits, or if the rays are not
        smooth enough for a table; `rays` must then be called itself.
        """
        check_reaches(profile, np.array([antenna_z_m, *z_m]))
        low, high = z_m
        kinks = [*thinned(profile).z_m, antenna_z_m]
        edges = np.unique([low, *(z for z in kinks if low < z < high), high])
        edges = edges if len(edges) > 1 else np.repeat(edges, 2)
        found = []
        for heights in pairwise(map(float, edges)):
            layer = _layer(profile, antenna_z_m, horizontal_m, heights, quantities, accuracy)
            if layer is None:
                return None
            found.append(layer)
        return cls(antenna_z_m, edges, horizontal_m, quantities, tuple(found))

    def times(
        self, horizontal_m: NDArray[np.float64], z_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the travel times to distances and heights within the table, seconds, [n]."""
        return self.read(horizontal_m, z_m)[self.quantities.index(Q.TIME)]

    def read(
        self, horizontal_m: NDArray[np.float64], z_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the quantities of rays to distances and heights within the table.

        The result has the shape [quantities, n].
        """
        read = np.empty((len(self.quantities), len(horizontal_m)))
        for first in range(0, len(horizontal_m), _READ_AT_ONCE):
            some = slice(first, first + _READ_AT_ONCE)
            self._read_some(horizontal_m[some], z_m[some], read[:, some])
        return read

    def _read_some(
        self, horizontal: NDArray[np.float64], z: NDArray[np.float64], read: NDArray[np.float64]
    ) -> None:
        if len(self.coefficients) == 1:
            self._interpolate(0, horizontal, z, read)
        else:
            layer = np.searchsorted(self.edges_z_m[1:-1], z)
            for index in np.unique(layer):
                here = np.flatnonzero(layer == index)
                values = np.empty((len(read), len(here)))
                self._interpolate(index, horizontal[here], z[here], values)
                read[:, here] = values
        for quantity, values in zip(self.quantities, read, strict=True):
            if quantity is Q.TIME:
                values *= horizontal**2 + (z - self.antenna_z_m) ** 2
            if quantity in (Q.TIME, Q.SPREADING):
                np.sqrt(np.maximum(values, 0.0, out=values), out=values)

    def _interpolate(
        self,
        index: int,
        horizontal: NDArray[np.float64],
        z: NDArray[np.float64],
        values: NDArray[np.float64],
    ) -> None:
        """Write what is tabulated, at positions in one layer, to values [quantities, n]."""
        coefficients = self.coefficients[index]
        heights = self.edges_z_m[index], self.edges_z_m[index + 1]
        most = np.max([each.shape for each in coefficients], axis=0)
        along = _polynomials(_scaled(horizontal, self.horizontal_m), most[0])
        up = _polynomials(_scaled(z, heights), most[1])
        for row, each in zip(values, coefficients, strict=True):
            parts = each.T @ along[: each.shape[0]]
            np.einsum("jn,jn->n", parts, up[: each.shape[1]], out=row)


def table_around(
    profile: SoundSpeed,
    antenna_z_m: float,
    horizontal_m: NDArray[np.float64],
    z_m: NDArray[np.float64],
    quantities: tuple[Quantity, ...] = TIMES,
    accuracy: Accuracy = USUAL,
) -> RayTable | None:
    """Return a table that contains some positions, or None; see `RayTable.of`.

    Its limits are rounded, so that it can serve again for positions in nearly the same place. They
    are exact if there are shadow zones beyond the positions.
    """
    lowest, highest = float(profile.z_m[-1]), float(profile.z_m[0])
    exact = [(float(each.min()), float(each.max())) for each in (horizontal_m, z_m)]
    rounded = [
        _rounded(*limits, most)
        for limits, most in zip(exact, ((0.0, np.inf), (lowest, highest)), strict=True)
    ]
    for far, heights in (rounded, exact):
        table = _kept_table(profile, antenna_z_m, far, heights, quantities, accuracy)
        if table is not None:
            return table
    return None


@lru_cache(maxsize=64)
def _kept_table(
    profile: SoundSpeed,
    antenna_z_m: float,
    horizontal_m: Extent,
    z_m: Extent,
    quantities: tuple[Quantity, ...],
    accuracy: Accuracy,
) -> RayTable | None:
    return RayTable.of(
        profile, antenna_z_m, horizontal_m, z_m, quantities=quantities, accuracy=accuracy
    )


def _rounded(low: float, high: float, limits: Extent) -> Extent:
    """Return limits rounded outwards, unless they are equal."""
    if high == low:
        return low, high
    step = 2.0 ** np.ceil(np.log2((high - low) / _ROUNDED))
    rounded = float(np.floor(low / step) * step), float(np.ceil(high / step) * step)
    return min(max(rounded[0], limits[0]), low), max(min(rounded[1], limits[1]), high)


def _polynomials(scaled: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return the first Chebyshev polynomials of some values, [count, n]."""
    found = np.empty((count, len(scaled)))
    found[0] = 1.0
    if count > 1:
        found[1] = scaled
    twice = 2 * scaled
    for order in range(2, count):
        np.multiply(twice, found[order - 1], out=found[order])
        found[order] -= found[order - 2]
    return found


def _scaled(values: NDArray[np.float64], limits: Extent) -> NDArray[np.float64]:
    """Return values scaled so that the limits become -1 and 1; 0 without an extent."""
    low, high = limits
    if high == low:
        return np.zeros_like(values)
    return (2 * values - (low + high)) / (high - low)


def _layer(
    profile: SoundSpeed,
    antenna_z: float,
    horizontal: Extent,
    heights: Extent,
    quantities: tuple[Quantity, ...],
    accuracy: Accuracy,
) -> tuple[NDArray[np.float64], ...] | None:
    """Return the coefficients of one layer, by quantity.

    It is None if there are shadow zones, or the largest table is not accurate enough.
    """

    def values(distance: NDArray, z: NDArray) -> NDArray[np.float64] | None:
        """Return the quantities of rays, [quantities, distances, heights], or None."""
        distance, z = distance[:, None], z[None]
        found = rays(profile, distance, antenna_z, z)
        if not found.exists.all():
            return None
        return np.stack([
            quantity_of(each, found, profile, distance, antenna_z, z) for each in quantities
        ])  # fmt: skip

    def within(limits: Extent, scaled: NDArray[np.float64]) -> NDArray[np.float64]:
        low, high = limits
        return np.clip((low + high + (high - low) * scaled) / 2, low, high)

    allowed = [accuracy.time_s if each is Q.TIME else accuracy.other for each in quantities]
    both = horizontal, heights
    for attempt in range(_ATTEMPTS):
        counts = [
            1 if limits[1] == limits[0] else count << attempt
            for limits, count in zip(both, (_DISTANCES, _HEIGHTS), strict=True)
        ]
        nodes = [chebyshev.chebpts1(count) for count in counts]
        at = [within(*each) for each in zip(both, nodes, strict=True)]
        entries = values(*at)
        if entries is None:
            return None
        length = np.hypot(at[0][:, None], at[1] - antenna_z)
        table = tuple(
            _coefficients(*_tabulated(quantity, each, length, error), nodes)
            for quantity, each, error in zip(quantities, entries, allowed, strict=True)
        )
        checked = [
            within(limits, np.linspace(-1, 1, 2 * count + 1))
            for limits, count in zip(both, counts, strict=True)
        ]
        truth = values(*checked)
        if truth is None:
            return None
        distance, z = (each.ravel() for each in np.meshgrid(*checked, indexing="ij"))
        made = RayTable(antenna_z, np.array(heights), horizontal, quantities, (table,))
        errors = np.abs(made.read(distance, z) - truth.reshape(len(quantities), -1)).max(axis=1)
        if np.all(errors <= allowed):
            return table
    return None


def _tabulated(
    quantity: Quantity, values: NDArray, length: NDArray, error: float
) -> tuple[NDArray[np.float64], float]:
    """Return what is tabulated of a quantity, and the error that it may have."""
    if quantity is Q.TIME:
        values, error = values / length, error / float(length.max())
    elif quantity is not Q.SPREADING:
        return values, error
    return values**2, 2 * float(values.min()) * error


def _coefficients(
    values: NDArray[np.float64], error: float, nodes: list[NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Return coefficients of values at Chebyshev nodes, without those that are negligible."""
    for axis, node in enumerate(nodes):
        transform = chebyshev.chebvander(node, len(node) - 1).T * 2 / len(node)
        transform[0] /= 2
        values = np.moveaxis(np.tensordot(transform, values, (1, axis)), 0, axis)
    for axis in range(2):
        beyond = np.abs(values).sum(axis=1 - axis)[::-1].cumsum()[::-1]
        count = max(int(np.count_nonzero(beyond > _LEFT_OUT * error)), 1)
        values = values[:count] if axis == 0 else values[:, :count]
    return np.ascontiguousarray(values)
