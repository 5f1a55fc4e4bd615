"""Pixels in the shadow of the relief itself.

A shadow is dark, but not empty: side lobes and ambiguities of bright places fill it, and are as
coherent as those places. Heights that they show in a shadow contradict the relief, since the line
of sight to them passes through the seabed that casts the shadow.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from clsas.core.grid import Grid
from clsas.interferometry.baseline import Lattice
from clsas.interferometry.coherence import Window

_CERTAIN = 3.0  # deviations of both heights by which a line of sight must pass below; arbitrary
_LEAST_SLOPE = 1e-3  # of a line of sight; shadows of lines that are more level have no end


def in_shadow(
    grid: Grid,
    offset_m: NDArray[np.float64],
    sd_m: NDArray[np.float64],
    valid: NDArray[np.bool_],
    sights: Lattice,
    window: Window,
) -> NDArray[np.bool_]:
    """Return which valid pixels of a relief are hidden by others, [rows, columns].

    The tangent t of the curves of equal range points away from the sonar, and its length is the
    tangent of the angle of depression: towards the sonar, the line of sight rises by that much per
    metre of ground. A pixel is hidden if it passes below the relief there.

    Parameters
    ----------
    grid : Grid
        The plane.
    offset_m, sd_m : float64 [rows, columns]
        Heights above it, and their deviations.
    valid : bool [rows, columns]
        Pixels with a height. Those around which they fill a window hide others.
    sights : Lattice
        K and the tangent, from `sight_lattice`.
    window : Window
    """
    height_m = grid.positions_m()[..., 2] + offset_m
    at_least_m = np.where(valid, height_m - _CERTAIN * sd_m, -np.inf)
    roof_m = minimum_filter(at_least_m, window.sides, mode="constant", cval=-np.inf)
    at_most_m = height_m + _CERTAIN * sd_m
    place = np.array(np.nonzero(valid & (at_most_m < roof_m.max())))
    _, *steps_m = grid.vectors_m
    rows, columns = map(np.arange, grid.shape)
    tangent = sights.over(rows, columns, offset_m)[1:, place[0], place[1]]  # pixels per rise
    slope = np.linalg.norm(np.array(steps_m)[:, :2].T @ tangent, axis=0)
    steep = slope > _LEAST_SLOPE
    place, tangent, slope = place[:, steep], tangent[:, steep], slope[steep]
    line_m = at_most_m[tuple(place)]
    towards = -tangent / slope  # pixels per metre of ground
    stride_m = min(
        side * float(np.linalg.norm(step)) / 2
        for side, step in zip(window.sides, steps_m, strict=True)
    )
    hidden = np.zeros(valid.shape, bool)
    ground_m = 0.0
    while place.size:
        ground_m += stride_m
        at = np.rint(place + ground_m * towards).astype(int)
        within = (at >= 0).all(axis=0) & (at < np.array(grid.shape)[:, None]).all(axis=0)
        left = within & (line_m + ground_m * slope < roof_m.max()) & ~hidden[tuple(place)]
        place, towards, line_m, slope, at = (
            each[..., left] for each in (place, towards, line_m, slope, at)
        )
        hidden[tuple(place)] = line_m + ground_m * slope < roof_m[tuple(at)]
    return hidden
