"""Resampling of amplitudes on grids whose rows and columns are the axes of the map."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clsas.maps.orientation import Affine

_MOST_AVERAGED = 16  # samples per pixel and axis; coarser pixels are refused


def north_up(
    shape: tuple[int, int], affine: Affine, pixel_m: float
) -> tuple[tuple[int, int], Affine]:
    """Return the shape and the transform of the smallest north-up raster that covers another one.

    Edges of its pixels are at whole multiples of their size, so that neighbouring maps fit.

    Parameters
    ----------
    shape : (rows, columns)
    affine : tuple of float
        Transform from columns and rows to easting and northing.
    pixel_m : float
        Size of the new pixels, metres.
    """
    a, b, c, d, e, f = affine
    rows, columns = shape
    corners = [(i * columns, j * rows) for i in (0, 1) for j in (0, 1)]
    east = [a * across + b * down + c for across, down in corners]
    north = [d * across + e * down + f for across, down in corners]
    # Rounding must not add a row or column of pixels that see nothing.
    left, bottom = (math.floor(min(each) / pixel_m + 1e-6) for each in (east, north))
    right, top = (math.ceil(max(each) / pixel_m - 1e-6) for each in (east, north))
    return (top - bottom, right - left), (
        *(pixel_m, 0.0, left * pixel_m),
        *(0.0, -pixel_m, top * pixel_m),
    )


def steps_m(affine: Affine) -> tuple[float, float]:
    """Return the distances between rows and between columns of a raster, metres."""
    a, b, _, d, e, _ = affine
    return math.hypot(b, e), math.hypot(a, d)


class Resampling:
    """Amplitudes of a raster at the pixels of another one, by interpolation of power.

    Power is interpolated bilinearly between pixels where something was received. New pixels that
    are larger than the old ones are means of several interpolated powers.

    Parameters
    ----------
    shape : (rows, columns)
        Shape of the given raster.
    affine : tuple of float
        Its transform.
    onto : tuple of float
        Transform of the new raster.
    """

    def __init__(self, shape: tuple[int, int], affine: Affine, onto: Affine) -> None:
        self._shape = shape
        a, b, c, d, e, f = affine
        forward = np.array([[a, b, c], [d, e, f], [0, 0, 1]])
        p, q, r, s, t, u = onto
        self._to_source = np.linalg.inv(forward) @ np.array([[p, q, r], [s, t, u], [0, 0, 1]])
        finest = min(steps_m(affine))
        self._averaged = max(math.ceil(max(steps_m(onto)) / finest - 1e-6), 1)
        if self._averaged > _MOST_AVERAGED:
            raise ValueError(
                f"pixel_m must be at most {_MOST_AVERAGED} times the distance of the pixels, "
                f"{_MOST_AVERAGED * finest:g} m, got {max(steps_m(onto)):g} m"
            )

    def at(
        self,
        rows: slice,
        columns: slice,
        read: Callable[[slice, slice], NDArray[np.float32]],
        *,
        of_power: bool = True,
    ) -> NDArray[np.float32]:
        """Return a window of the new raster, [rows, columns].

        Parameters
        ----------
        rows, columns : slice
        read : callable
            Called as read(rows, columns); returns a window of the given raster.
        of_power : bool
            True to interpolate the squares of amplitudes that are not 0; False to interpolate the
            values themselves, such as heights.
        """
        count = self._averaged
        within = (np.arange(count) + 0.5) / count
        down = (np.arange(rows.start, rows.stop)[:, None] + within).reshape(-1, 1)
        across = (np.arange(columns.start, columns.stop)[:, None] + within).reshape(1, -1)
        to = self._to_source
        column = to[0, 0] * across + to[0, 1] * down + to[0, 2] - 0.5
        row = to[1, 0] * across + to[1, 1] * down + to[1, 2] - 0.5
        inside = (row >= -0.5) & (row <= self._shape[0] - 0.5)
        inside &= (column >= -0.5) & (column <= self._shape[1] - 0.5)
        total = np.zeros(row.shape)
        weight = np.zeros(row.shape)
        if inside.any():
            self._add(row, column, inside, read, of_power, total, weight)
        shape = (rows.stop - rows.start, count, columns.stop - columns.start, count)
        total, weight = (each.reshape(shape).sum(axis=(1, 3)) for each in (total, weight))
        seen = weight >= count**2 / 2  # at least half of the pixel
        mean = np.divide(total, weight, out=np.zeros_like(total), where=seen)
        return (np.sqrt(mean) if of_power else mean).astype(np.float32)

    def _add(
        self,
        row: NDArray[np.float64],
        column: NDArray[np.float64],
        inside: NDArray[np.bool_],
        read: Callable[[slice, slice], NDArray[np.float32]],
        of_power: bool,
        total: NDArray[np.float64],
        weight: NDArray[np.float64],
    ) -> None:
        """Add the values and weights of the four nearest pixels."""
        parts, nearest = [], []
        for place, count in zip((row, column), self._shape, strict=True):
            first = np.clip(np.floor(place).astype(np.int64), 0, max(count - 2, 0))
            low, high = int(first[inside].min()), min(int(first[inside].max()) + 2, count)
            parts.append(slice(low, high))
            share = np.clip(place - first, 0.0, 1.0)
            # Beyond the outer centres, values are those of the outer pixels.
            nearest.append((np.clip(first - low, 0, high - low - 1), share, high - low - 1))
        values = read(*parts).astype(np.float64)
        received = np.ones(values.shape, bool)
        if of_power:
            received = values != 0
            values *= values
        (top, below, last_row), (left, right, last_column) = nearest
        for i in (0, 1):
            for j in (0, 1):
                at = np.minimum(top + i, last_row), np.minimum(left + j, last_column)
                share = (below if i else 1 - below) * (right if j else 1 - right) * inside
                share = share * received[at]
                total += share * values[at]
                weight += share
