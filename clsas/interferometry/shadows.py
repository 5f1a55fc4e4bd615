"""Pixels in the shadow of the relief itself.

A shadow is dark, but not empty: side lobes and ambiguities of bright places fill it, and are as
coherent as those places. Heights that they show in a shadow contradict the relief, since the line
of sight to them passes through the seabed that casts the shadow.

A relief that does not fit into memory is treated part by part. Only its skyline, the heights to
which it certainly rises, is needed beyond a part (`clsas.mosaics.relief_shadows`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from clsas.engine.data.grid import Grid
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
    relief = ReliefPart.of(grid, offset_m, sd_m, valid, sights, window)
    every = relief.every
    fine = Skyline.of(relief.roof_m)
    coarse = Skyline.of(relief.highest_m[::every, ::every])
    return relief.hidden_by(fine, coarse)


@dataclass(frozen=True, eq=False)
class Skyline:
    """Heights to which a relief certainly rises.

    Attributes
    ----------
    shape : (rows, columns)
        Places at which it is known.
    most_m : float
        The relief rises nowhere above it.
    at : callable
        Returns the heights at places, int64 [2, n], -inf where the relief is not known.
    """

    shape: tuple[int, ...]
    most_m: float
    at: Callable[[NDArray[np.int64]], NDArray[np.float64]]

    @classmethod
    def of(cls, roof_m: NDArray[np.float64]) -> Self:
        """Return the skyline of a relief in memory."""
        return cls(roof_m.shape, float(roof_m.max()), lambda place: roof_m[tuple(place)])


@dataclass(frozen=True, eq=False)
class ReliefPart:
    """Bounds of the heights of a relief, or of a part of it, z in metres, [rows, columns] each.

    Attributes
    ----------
    grid : Grid
        The plane below the part.
    offset_m : float64
        Heights above it.
    valid : bool
        Pixels with a height.
    most_m : float64
        No pixel is higher; inf where there is no height.
    roof_m : float64
        The relief rises at least so high in the window around every pixel; -inf where it is not
        known.
    lowest_m, highest_m : float64
        Least of `most_m`, and largest of `roof_m`, in the window around every pixel.
    sights : Lattice
    window : Window
    corner : (row, column)
        First pixel of the part in the whole relief.
    """

    grid: Grid
    offset_m: NDArray[np.float64]
    valid: NDArray[np.bool_]
    most_m: NDArray[np.float64]
    roof_m: NDArray[np.float64]
    lowest_m: NDArray[np.float64]
    highest_m: NDArray[np.float64]
    sights: Lattice
    window: Window
    corner: tuple[int, int] = (0, 0)

    @classmethod
    def of(
        cls,
        grid: Grid,
        offset_m: NDArray[np.float64],
        sd_m: NDArray[np.float64],
        valid: NDArray[np.bool_],
        sights: Lattice,
        window: Window,
        corner: tuple[int, int] = (0, 0),
    ) -> Self:
        """Return a part of a relief; see `in_shadow` for the parameters.

        Bounds of windows that extend beyond the part count only at the ends of the whole relief.
        """
        height_m = grid.positions_m()[..., 2] + offset_m
        at_least_m = np.where(valid, height_m - _CERTAIN * sd_m, -np.inf)
        most_m = np.where(valid, height_m + _CERTAIN * sd_m, np.inf)
        roof_m = minimum_filter(at_least_m, window.sides, mode="constant", cval=-np.inf)
        return cls(
            grid, offset_m, valid, most_m, roof_m,
            minimum_filter(most_m, window.sides, mode="constant", cval=np.inf),
            maximum_filter(roof_m, window.sides, mode="constant", cval=-np.inf),
            sights, window, corner,
        )  # fmt: skip

    @property
    def every(self) -> int:
        """Side of the blocks of pixels, which begin with the whole relief, that are tried first."""
        return max(min(self.window.sides) // 2, 1)

    def hidden_by(
        self, fine: Skyline, coarse: Skyline, inside: tuple[slice, slice] | None = None
    ) -> NDArray[np.bool_]:
        """Return which valid pixels are hidden, bool [rows, columns].

        The skylines are those of `roof_m` of the whole relief, and of `highest_m` at the first
        pixel of every block. Around the pixels that matter, by default all, a window and a block
        before them must belong to this part too, unless the relief begins there.
        """
        rows, columns = (
            np.arange(first, first + count)[part]
            for first, count, part in zip(
                self.corner, self.grid.shape, inside or 2 * (slice(None),), strict=True
            )
        )
        local = np.ix_(rows - self.corner[0], columns - self.corner[1])
        tangent = self.sights.over(local[0].ravel(), local[1].ravel(), self.offset_m[local])[1:3]
        # Most windows are not even hidden if their lowest pixel sees the highest roof around.
        of_rows, of_columns = (np.unique(each // self.every) for each in (rows, columns))
        first = np.ix_(
            of_rows * self.every - self.corner[0], of_columns * self.every - self.corner[1]
        )
        blocks = np.stack(np.meshgrid(of_rows, of_columns, indexing="ij")).reshape(2, -1)
        of_blocks = self.sights.over(first[0].ravel(), first[1].ravel(), self.offset_m[first])[1:3]
        may_be = self._below(
            coarse, blocks, self.lowest_m[first].ravel(), of_blocks.reshape(2, -1), self.every
        ).reshape(len(of_rows), len(of_columns))
        may_be = may_be[
            np.ix_(rows // self.every - of_rows[0], columns // self.every - of_columns[0])
        ]
        chosen = np.nonzero(self.valid[local] & may_be)
        place = np.array([rows[chosen[0]], columns[chosen[1]]])
        found = np.zeros(may_be.shape, bool)
        found[chosen] = self._below(
            fine, place, self.most_m[local][chosen], tangent[:, chosen[0], chosen[1]], 1
        )
        return found

    def _below(
        self,
        skyline: Skyline,
        place: NDArray[np.int64],
        line_m: NDArray[np.float64],
        tangent: NDArray[np.float64],
        every: int,
    ) -> NDArray[np.bool_]:
        """Return which lines of sight pass below a skyline.

        Lines begin at places, counted in blocks of `every` x `every` pixels, and heights, and move
        away from the sonar by a tangent, rows and columns per metre of rise.
        """
        _, *steps_m = self.grid.vectors_m
        horizontal_m = np.array(steps_m)[:, :2].T
        stride_m = min(
            side * float(np.linalg.norm(step)) / 2
            for side, step in zip(self.window.sides, steps_m, strict=True)
        )
        slope = np.linalg.norm(horizontal_m @ tangent, axis=0)
        towards = -tangent / (np.maximum(slope, _LEAST_SLOPE) * every)
        found = np.zeros(len(line_m), bool)
        rays, ground_m = np.flatnonzero(slope > _LEAST_SLOPE), 0.0
        while rays.size:
            ground_m += stride_m
            at = np.rint(place[:, rays] + ground_m * towards[:, rays]).astype(int)
            raised_m = line_m[rays] + ground_m * slope[rays]
            left = (at >= 0).all(axis=0) & (at < np.array(skyline.shape)[:, None]).all(axis=0)
            left &= raised_m < skyline.most_m
            rays, at, raised_m = rays[left], at[:, left], raised_m[left]
            found[rays] = below = raised_m < skyline.at(at)
            rays = rays[~below]
        return found
