"""Sampled pixels of subimages, over which errors are averaged."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clsas.planning.subimages import Side
from clsas.planning.visibility_model import VisibilityModel

SAMPLED_PIXELS = 16
"""Pixels sampled of every subimage. Half as many move predicted errors by 0.05 dB at most."""

SPREAD_POINTS = (0, 7, 14, 16, 23)
"""Of the model's 5 by 5 sample points, one in every row and column."""


def pixels_m(
    model: VisibilityModel, extents: NDArray[np.float64], point: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the centre of a subimage and sampled pixels, relative to the centre, [n + 1, 3].

    The second array, [n], contains a further number from 0 to 1 for each pixel, for example to
    choose its frequency. All numbers come from a Kronecker sequence (multiples of powers of an
    irrational number), which fills the subimage evenly. Every sample point has an interval of it.
    """
    dimensions = len(extents) + 1
    ratio = 1.0
    for _ in range(20):  # towards x^(dimensions + 1) = x + 1
        ratio = (1 + ratio) ** (1 / (dimensions + 1))
    index = point * SAMPLED_PIXELS + np.arange(SAMPLED_PIXELS)[:, None]
    numbers = (0.5 + index * ratio ** -np.arange(1.0, dimensions + 1)) % 1
    offsets_m = ((numbers[:, :-1] - 0.5) * extents) @ model.surface.steps_m
    return np.concatenate([np.zeros((1, 3)), offsets_m]), numbers[:, -1]


def mean_over_relief(
    model: VisibilityModel, side: Side, error: Callable[[NDArray[np.float64]], float]
) -> float:
    """Return the mean over the grid of an error that depends on the extents of subimages.

    The error is evaluated without relief and at the largest relief. It grows at least with the
    square of the relief, so that subimages of less relief are interpolated by the square.
    """
    surface = model.surface
    flat = error(surface.extents(side))
    relief_m = surface.relief_m(side, model.root)
    largest_m = float(relief_m.max())
    if largest_m <= 0:
        return flat
    share = np.average((relief_m / largest_m) ** 2, weights=surface.counts(model.root or side))
    return flat + max(error(surface.extents(side, largest_m)) - flat, 0.0) * float(share)
