"""Peaks between samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def parabola_peak(before: NDArray, at: NDArray, after: NDArray) -> NDArray:
    """Return where parabolas through three samples peak, in steps from the middle sample.

    It is 0 where the samples have no maximum.
    """
    bend = before - 2 * at + after
    return np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, 1.0), 0.0)
