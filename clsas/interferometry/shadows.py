"""Pixels in the shadow of the relief itself.

A shadow is dark, but not empty: side lobes and ambiguities of bright places fill it, and are as
coherent as those places. Heights that they show in a shadow contradict the relief, since the line
of sight to them passes through the seabed that casts the shadow.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

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
    at_most_m = np.where(valid, height_m + _CERTAIN * sd_m, np.inf)
    roof_m = minimum_filter(at_least_m, window.sides, mode="constant", cval=-np.inf)
    _, *steps_m = grid.vectors_m
    horizontal_m = np.array(steps_m)[:, :2].T
    stride_m = min(
        side * float(np.linalg.norm(step)) / 2
        for side, step in zip(window.sides, steps_m, strict=True)
    )

    def hidden(
        place: NDArray[np.int64], line_m: NDArray[np.float64], every: int, roof_m: NDArray
    ) -> NDArray[np.bool_]:
        """Return which places, in blocks of `every` x `every` pixels, lie below a roof."""
        towards = -tangent[:, place[0] * every, place[1] * every]
        slope = np.linalg.norm(horizontal_m @ towards, axis=0)
        towards /= np.maximum(slope, _LEAST_SLOPE) * every
        found = np.zeros(len(line_m), bool)
        rays, ground_m = np.flatnonzero(slope > _LEAST_SLOPE), 0.0
        while rays.size:
            ground_m += stride_m
            at = np.rint(place[:, rays] + ground_m * towards[:, rays]).astype(int)
            raised_m = line_m[rays] + ground_m * slope[rays]
            left = (at >= 0).all(axis=0) & (at < np.array(roof_m.shape)[:, None]).all(axis=0)
            left &= raised_m < roof_m.max()
            rays, at, raised_m = rays[left], at[:, left], raised_m[left]
            found[rays] = below = raised_m < roof_m[tuple(at)]
            rays = rays[~below]
        return found

    rows, columns = grid.shape
    tangent = sights.over(np.arange(rows), np.arange(columns), offset_m)[1:]  # pixels per rise
    # Most windows are not even hidden if their lowest pixel sees the highest roof around.
    every = max(min(window.sides) // 2, 1)
    some = slice(None, None, every)
    lowest_m = minimum_filter(at_most_m, window.sides, mode="constant", cval=np.inf)[some, some]
    highest_m = maximum_filter(roof_m, window.sides, mode="constant", cval=-np.inf)[some, some]
    blocks = np.indices(lowest_m.shape).reshape(2, -1)
    may_be = hidden(blocks, lowest_m.ravel(), every, highest_m).reshape(lowest_m.shape)
    may_be = may_be.repeat(every, axis=0)[:rows].repeat(every, axis=1)[:, :columns]
    place = np.array(np.nonzero(valid & may_be))
    found = np.zeros(valid.shape, bool)
    found[tuple(place)] = hidden(place, at_most_m[tuple(place)], 1, roof_m)
    return found
