"""Agreement of range lines with an image in their spatial frequencies.

An image has no record of its lines. Around a pixel, lines and beam determine which spatial
frequencies the image contains, and how much power each has.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from clsas.maps.collection import Collection

LEAST_AGREEMENT = 0.9
"""Smallest agreement of lines with their image. The lines of an image agreed by 0.98 to 1.00, and
by 0.80 to 0.87 without its beam. With carriers of 0.9 to 3 times the right one it was 0.04 to 0.80,
and up to 0.92 for pixels three wavelengths apart, in which most frequencies alias. Tracks some
metres beside the right one have nearly the same frequencies (0.93 to 0.99)."""

_BLOCK = 64  # pixels along either side of the blocks whose spectrum is compared: a plain choice
_BLOCKS = 5  # of them along either side of the image: a plain choice


def agreement(
    collection: Collection,
    shape: tuple[int, int],
    first_m: NDArray[np.float64],
    steps_m: NDArray[np.float64],
    read: Callable[[slice, slice], NDArray[np.complex64]],
) -> float:
    """Return how well the spectrum of an image agrees with that of lines, from 0 to 1.

    Spectra of blocks, along rows and along columns, are compared with those that lines and beam
    predict, by the Bhattacharyya coefficient. Blocks count by their power.

    Parameters
    ----------
    collection : Collection
        The lines, and the beam.
    shape : (rows, columns)
        Shape of the image.
    first_m : float64 [3]
        Position of its first pixel.
    steps_m : float64 [2, 3]
        Steps from row to row and from column to column.
    read : callable
        Called as read(rows, columns); returns a window of the image.
    """
    sides = [min(_BLOCK, n) for n in shape]
    windows = [np.hanning(side + 2)[1:-1] for side in sides]
    starts = [
        np.linspace(0, n - side, _BLOCKS, dtype=int) for n, side in zip(shape, sides, strict=True)
    ]
    agreed = total = 0.0
    for first in product(*starts):
        rows, columns = (slice(at, at + side) for at, side in zip(first, sides, strict=True))
        power = np.abs(scipy.fft.fft2(read(rows, columns) * np.outer(*windows))) ** 2
        if not power.any():
            continue
        middle_m = first_m + (np.array(first) + np.array(sides) / 2) @ steps_m
        channels, weights, changes_m = collection.contributions(middle_m, steps_m)
        weight = float(power.sum())
        total += weight
        if not len(channels):
            continue
        received = np.multiply.outer(weights**2, collection.amplitude**2)
        for axis, window in enumerate(windows):
            cycles = np.multiply.outer(changes_m[axis], collection.cycles_per_m)
            expected = _marginal(cycles, received, window)
            found = power.sum(axis=1 - axis) / weight
            agreed += weight / 2 * float(np.sqrt(found * expected).sum())
    return agreed / total if total else 1.0


def _marginal(
    cycles: NDArray[np.float64], power: NDArray[np.float64], window: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the share of every bin of an FFT in power at some frequencies, with the window."""
    n = len(window)
    bins = np.rint(cycles * n).astype(np.int64) % n
    share = np.bincount(bins.ravel(), power.ravel(), n)
    leakage = np.abs(scipy.fft.fft(window)) ** 2
    spread = scipy.fft.ifft(scipy.fft.fft(share) * scipy.fft.fft(leakage)).real.clip(0)
    return spread / spread.sum()
