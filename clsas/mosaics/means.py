"""Means over blocks of pixels, of those that received something.

This one rule makes levels of mosaics, overviews of maps and tiles of the viewer: pixels that
nothing reached are no data, and leave edges and seams as bright as the seabed beside them.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray


def block_sums(values: NDArray, down: int = 2, across: int = 2) -> NDArray:
    """Return sums over blocks of `down` x `across` pixels; fewer at the ends of other sides."""
    missing = [(0, -count % by) for count, by in zip(values.shape, (down, across), strict=True)]
    whole = np.pad(values, missing) if any(end for _, end in missing) else values
    total = whole[::down, ::across].copy()
    for row, column in itertools.islice(itertools.product(range(down), range(across)), 1, None):
        total += whole[row::down, column::across]
    return total


def block_means(
    values: NDArray, weights: NDArray, down: int = 2, across: int = 2, *, empty: float = 0.0
) -> NDArray:
    """Return means over blocks of `down` x `across` pixels, in the precision of the values.

    Parameters
    ----------
    values : float or complex [rows, columns]
    weights : bool or float [rows, columns]
        Weight of each pixel; 0 where nothing was received, whatever the value.
    down, across : int
        Rows and columns of a block. Those at the ends of other sides have fewer.
    empty : float
        Mean of a block without weight.
    """
    weights = weights.astype(values.real.dtype)
    weighed = weights * values
    weighed[weights == 0] = 0  # whatever the value is
    total = block_sums(weighed, down, across)
    count = block_sums(weights, down, across)
    return np.divide(total, count, out=np.full_like(total, empty), where=count > 0)
