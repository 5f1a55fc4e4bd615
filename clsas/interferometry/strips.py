"""Windowed computations in strips of rows, which fit caches and run in several threads."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.threads import in_threads
from clsas.interferometry.coherence import Window

# Rows of a strip, and windows of rows. Half and twice as many take the same time.
_ROWS, _WINDOWS = 64, 4

Results = TypeVar("Results", bound=tuple[NDArray, ...])


def in_strips(
    function: Callable[..., Results], arrays: tuple[NDArray, ...], window: Window
) -> Results:
    """Return the results of a function of windows around every pixel.

    Parameters
    ----------
    function : callable
        Takes the arrays, some rows of them, and returns a named tuple of arrays of the same shape.
        A result depends on the pixels within half a window.
    arrays : arrays [rows, columns]
    window : Window
    """
    rows, margin = len(arrays[0]), window.rows // 2
    height = max(_ROWS, _WINDOWS * window.rows)

    def strip(first: int) -> Results:
        last = min(first + height, rows)
        begin, end = max(first - margin, 0), min(last + margin, rows)
        found = function(*(each[begin:end] for each in arrays))
        return type(found)(*(each[first - begin : last - begin] for each in found))

    parts = list(in_threads(strip, range(0, rows, height)))
    return type(parts[0])(*(np.concatenate(each) for each in zip(*parts, strict=True)))
