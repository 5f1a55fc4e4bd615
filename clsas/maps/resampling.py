"""Resampling of bands on grids whose rows and columns are the axes of the map."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from clsas.engine.data.validate import ArgumentError
from clsas.maps.bands import Band
from clsas.maps.map_grids import Affine, cover

_CORNERS = ((0, 0), (0, 1), (1, 0), (1, 1))
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
    left, bottom, rows, columns = cover(shape, affine, pixel_m)
    return (rows, columns), (
        *(pixel_m, 0.0, left * pixel_m),
        *(0.0, -pixel_m, (bottom + rows) * pixel_m),
    )


def steps_m(affine: Affine) -> tuple[float, float]:
    """Return the distances between rows and between columns of a raster, metres."""
    a, b, _, d, e, _ = affine
    return math.hypot(b, e), math.hypot(a, d)


def averaged(affine: Affine, onto: Affine) -> int:
    """Return how many pixels a pixel of a new raster spans along either side, rounded up.

    Raises
    ------
    ValueError
        If they are more than 16.
    """
    finest = min(steps_m(affine))
    count = max(math.ceil(max(steps_m(onto)) / finest - 1e-6), 1)
    if count > _MOST_AVERAGED:
        raise ArgumentError(
            "pixel_m",
            f"be at most {_MOST_AVERAGED} times the distance of the pixels, "
            f"{_MOST_AVERAGED * finest:g} m",
            f"{max(steps_m(onto)):g} m",
        )
    return count


def lattice(
    affine: Affine, onto: Affine, first: tuple[int, int], count: int = 1
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where samples of a new raster lie in a given one.

    Parameters
    ----------
    affine, onto : tuple of float
        Transforms of the given raster and of the new one.
    first : (row, column)
        Pixel of the new raster with the first sample.
    count : int
        Samples per pixel along either side.

    Returns
    -------
    matrix : float64 [2, 2]
        Steps of row and column of the given raster (first axis) from sample to sample down and
        across.
    offset : float64 [2]
        Row and column of the first sample. They count from the centre of the first pixel.
    """
    a, b, c, d, e, f = affine
    p, q, r, s, t, u = onto
    forward = np.array([[a, b, c], [d, e, f], [0, 0, 1]])
    to = np.linalg.inv(forward) @ np.array([[p, q, r], [s, t, u], [0, 0, 1]])
    # Sample s of a row lies at row + (s + 0.5)/count.
    centre = np.array([first[1], first[0]]) + 0.5 / count
    column, row = to[:2, :2] @ centre + to[:2, 2] - 0.5
    matrix = np.array([[to[1, 1], to[1, 0]], [to[0, 1], to[0, 0]]]) / count
    return matrix, np.array([row, column])


class Resampling:
    """Numbers of a raster at the pixels of another one, by interpolation.

    Powers of amplitudes, and other numbers themselves, are interpolated bilinearly between pixels
    that have data. New pixels that are larger than the old ones are means of several interpolated
    numbers.

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
        self._shape, self._affine, self._onto = shape, affine, onto
        self._averaged = averaged(affine, onto)

    def at(
        self,
        rows: slice,
        columns: slice,
        band: Band,
        read: Callable[[slice, slice], NDArray[np.float32]],
    ) -> NDArray[np.float32]:
        """Return a window of the new raster, [rows, columns].

        Parameters
        ----------
        rows, columns : slice
        band : Band
            The band of the numbers, which says how they are averaged.
        read : callable
            Called as read(rows, columns); returns a window of the given raster.
        """
        count = self._averaged
        matrix, offset = lattice(self._affine, self._onto, (rows.start, columns.start), count)
        shape = (rows.stop - rows.start) * count, (columns.stop - columns.start) * count
        inside = self._inside(matrix, offset, shape)
        if inside is not None and not inside.any():
            return np.full((shape[0] // count, shape[1] // count), band.no_data, np.float32)
        corners = offset + [matrix @ [i * (shape[0] - 1), j * (shape[1] - 1)] for i, j in _CORNERS]
        parts = [
            slice(max(math.floor(low), 0), min(math.ceil(high) + 1, most))
            for low, high, most in zip(
                corners.min(axis=0), corners.max(axis=0), self._shape, strict=True
            )
        ]
        # Samples within half a pixel of the border may lie beyond the outermost centres.
        parts = [
            slice(min(part.start, most - 1), max(part.stop, 1))
            for part, most in zip(parts, self._shape, strict=True)
        ]
        summands, known = band.summands(read(*parts))
        first = np.array([part.start for part in parts])

        def interpolated(given: NDArray[np.float64]) -> NDArray[np.float64]:
            return ndimage.affine_transform(
                given, matrix, offset - first, shape, order=1, mode="nearest"
            )

        total = interpolated(summands)
        weight = np.ones(shape) if known.all() else interpolated(known.astype(np.float64))
        if inside is not None:
            total *= inside
            weight *= inside
        blocks = shape[0] // count, count, shape[1] // count, count
        total, weight = (each.reshape(blocks).sum(axis=(1, 3)) for each in (total, weight))
        return band.mean(total, weight, count**2 / 2)  # at least half of the pixel

    def _inside(
        self, matrix: NDArray[np.float64], offset: NDArray[np.float64], shape: tuple[int, int]
    ) -> NDArray[np.bool_] | None:
        """Return which samples lie on pixels of the given raster; None if all do."""
        ends = offset + [matrix @ [i * (shape[0] - 1), j * (shape[1] - 1)] for i, j in _CORNERS]
        most = np.array(self._shape) - 0.5
        if (ends >= -0.5).all() and (ends <= most).all():
            return None
        if (ends.max(axis=0) < -0.5).any() or (ends.min(axis=0) > most).any():
            return np.zeros(shape, bool)
        down, across = np.ogrid[: shape[0], : shape[1]]
        inside = np.ones(shape, bool)
        for axis in (0, 1):
            place = offset[axis] + matrix[axis, 0] * down + matrix[axis, 1] * across
            inside &= (place >= -0.5) & (place <= most[axis])
        return inside
