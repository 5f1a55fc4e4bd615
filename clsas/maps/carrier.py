"""The local carrier of a complex image: the phase that is left in its pixels.

Around a pixel x, an image contains the spatial frequencies K dr_i/dx, where r_i is the range of
channel i, whose beam covers the pixel, and K the two-way phase per metre in the band of the lines.
Pixels may be far larger than the wavelength, so that these frequencies alias. They fill only a part
of the sampled band. The carrier is a smooth phase whose gradient follows the middle of that part:
without it, the image is one around 0 Hz, which can be interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from clsas.engine.data.validate import ArgumentError
from clsas.maps.collection import Collection

# Highest total order of the polynomial, and pixels along either side of the raster to which it is
# fitted. On a swath from 5 m to 90 m beside a track 10 m above it, the band after order 4 is wider
# than after order 8 by a fifth; orders 8 and 16, and 17 and 33 pixels, agree to 1 %.
_ORDER, _PIXELS = 8, 17


@dataclass(frozen=True, eq=False)
class Carrier:
    """A phase over the rows and columns of a raster.

    Attributes
    ----------
    shape : (rows, columns)
        Shape of the raster.
    coefficients : float64 [orders + 1, orders + 1]
        Chebyshev coefficients of the phase, cycles, over rows and columns, whose centres lie from
        -1 to 1. The total order is at most that of each axis, so that the phase along other axes is
        a polynomial of the same order.
    half_band : float64 [2]
        Largest distance of the image's frequencies from the carrier along rows and columns, cycles
        per pixel.
    """

    shape: tuple[int, int]
    coefficients: NDArray[np.float64]
    half_band: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        collection: Collection,
        shape: tuple[int, int],
        first_m: NDArray[np.float64],
        steps_m: NDArray[np.float64],
    ) -> Carrier:
        """Return the carrier of an image.

        Parameters
        ----------
        collection : Collection
            Its lines, and the beam that formed it.
        shape : (rows, columns)
            Shape of the raster: at least 2 rows and columns.
        first_m : float64 [3]
            Position of its first pixel.
        steps_m : float64 [2, 3]
            Steps from row to row and from column to column.

        Raises
        ------
        ValueError
            If no line reaches the image.
        """
        sides = (np.linspace(0, n - 1, _PIXELS) for n in shape)
        index = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)
        places, supports = [], []
        for place in index:
            channels, _, changes_m = collection.contributions(first_m + place @ steps_m, steps_m)
            if len(channels):
                places.append(place)
                supports.append(collection.support(changes_m))
        if not places:
            raise ArgumentError("lines", "reach the image within the beam, but none does")
        support = np.array(supports)  # [places, axes, lowest and highest]
        slopes, used = _slopes(np.array(places), shape)
        solved = np.linalg.lstsq(slopes, support.mean(axis=2).T.ravel(), rcond=None)[0]
        coefficients = np.zeros((_ORDER + 1, _ORDER + 1))
        coefficients[used] = solved
        gradient = (slopes @ solved).reshape(2, -1).T[..., None]
        return cls(shape, coefficients, np.abs(support - gradient).max(axis=(0, 2)))

    def without(
        self, pixels: NDArray, first: NDArray[np.float64] | tuple[int, int]
    ) -> NDArray[np.complex128]:
        """Return a window of the image without the carrier; `first` is its first row and column."""
        return pixels * _turns(-self._cycles(np.eye(2), np.array(first), pixels.shape))

    def turns(
        self, matrix: NDArray[np.float64], first: NDArray[np.float64], shape: tuple[int, int]
    ) -> NDArray[np.complex128]:
        """Return the phase factor of the carrier at places on a lattice, [rows, columns].

        Parameters
        ----------
        matrix : float64 [2, 2]
            Steps of row and column of the raster (first axis) per row and column of the lattice.
        first : float64 [2]
            Row and column of the raster at the lattice's first place.
        shape : (rows, columns)
            Shape of the lattice.
        """
        return _turns(self._cycles(matrix, first, shape))

    def _cycles(
        self, matrix: NDArray[np.float64], first: NDArray[np.float64], shape: tuple[int, ...]
    ) -> NDArray[np.float64]:
        """Return the phase at places on a lattice: a polynomial over its rows and columns."""
        nodes = chebyshev.chebpts1(_ORDER + 1)
        down, across = ((nodes + 1) / 2 * (n - 1) for n in shape)
        places = first[:, None, None] + np.stack(
            [np.add.outer(matrix[axis, 0] * down, matrix[axis, 1] * across) for axis in (0, 1)]
        )
        row, column = (2 * at / (n - 1) - 1 for at, n in zip(places, self.shape, strict=True))
        inverse = np.linalg.inv(chebyshev.chebvander(nodes, _ORDER))
        found = inverse @ chebyshev.chebval2d(row, column, self.coefficients) @ inverse.T
        rows, columns = (chebyshev.chebvander(np.linspace(-1, 1, n), _ORDER) for n in shape)
        return np.asarray(rows @ found @ columns.T)


def _slopes(
    places: NDArray[np.float64], shape: tuple[int, int]
) -> tuple[NDArray[np.float64], tuple[NDArray[np.int64], ...]]:
    """Return the matrix from coefficients to slopes, and the coefficients that have a column.

    Its rows are the slopes along rows at all places, and then those along columns, cycles per
    pixel. The constant has no slope.
    """
    orders = np.add.outer(np.arange(_ORDER + 1), np.arange(_ORDER + 1))
    used = np.nonzero((orders > 0) & (orders <= _ORDER))
    each = np.eye(_ORDER + 1)
    parts = []
    for axis in (0, 1):
        factors = []
        for other, n in enumerate(shape):
            at = 2 * places[:, other] / (n - 1) - 1
            series = chebyshev.chebder(each) * 2 / (n - 1) if other == axis else each
            factors.append(chebyshev.chebval(at, series).T[:, used[other]])
        parts.append(factors[0] * factors[1])
    return np.concatenate(parts), used


def _turns(cycles: NDArray[np.float64]) -> NDArray[np.complex128]:
    return np.exp(2j * np.pi * (cycles % 1.0))
