"""Sample points all over a grid; means over them, and integrals over samples of a curve."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.core.surface import LEAST_SIDE, Surface

_FRACTIONS = (0.02, 0.25, 0.5, 0.75, 0.98)  # of the rows and columns
_WEIGHTS = np.array([0.135, 0.24, 0.25, 0.24, 0.135])  # of these fractions in means over the grid
_POINT_WEIGHTS = np.outer(_WEIGHTS, _WEIGHTS).ravel() / _WEIGHTS.sum() ** 2

INNER_POINTS = np.arange(len(_FRACTIONS) ** 2).reshape(len(_FRACTIONS), -1)[1:-1, 1:-1].ravel()
"""Indices of the sample points that do not lie at the grid's edges."""


def sample_points_m(surface: Surface) -> NDArray[np.float64]:
    """Return 25 points all over a grid, also near its corners, [points, 3]."""
    return points_at_m(surface, _FRACTIONS)


def points_at_m(
    surface: Surface, fractions: Sequence[float] | NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return positions at some fractions of the rows and columns, [n, 3]."""
    index = np.stack(np.meshgrid(fractions, fractions, indexing="ij"), axis=-1).reshape(-1, 2)
    index = index * (np.array(surface.plane.shape) - 1)
    origin_m: Any = surface.plane.origin_m
    plane_m = origin_m + index @ surface.steps_m[:2]
    if surface.is_plane:
        return plane_m
    # Points lie as far off the plane as the pixels around them.
    around = (index // LEAST_SIDE * LEAST_SIDE).astype(np.int64)
    middle = around + (np.array(LEAST_SIDE) - 1) / 2
    off_m = surface.middles_m(LEAST_SIDE, around) - origin_m
    return plane_m + off_m - middle @ surface.steps_m[:2]


def mean_over_points(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return means over the grid of values at the sample points, [..., points]."""
    return values @ _POINT_WEIGHTS


def over_points(values: NDArray[np.float64], most: bool) -> float:
    """Return the largest of values at the sample points, or their mean over the grid."""
    return float(values.max() if most else mean_over_points(values))


def trapezoidal_weights(samples: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weights of samples in an integral over them (trapezoidal rule)."""
    halves = np.diff(samples) / 2
    return np.concatenate([halves, [0.0]]) + np.concatenate([[0.0], halves])
