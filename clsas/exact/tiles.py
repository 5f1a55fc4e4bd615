"""Tiles: square parts of a plane, whose pixels share one centre.

Ranges and phases of the centre are computed in float64. The device computes the differences of the
pixels from it in float32.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from clsas.core.grid import Grid
from clsas.sonar.beam import BeamWindow
from clsas.sonar.visibility import Boxes

STACK = 4
"""Number of blocks of a work-item, which lie one below the other (cl/pixels.h)."""

BLOCKS = {16: (4, 4), 8: (2, 4), 4: (2, 2), 1: (1, 1)}
"""Rows and columns of a block by number of float lanes, with one pixel per lane."""


def item_pixels(width: int) -> int:
    """Return the number of pixels of a work-item: `STACK` blocks of one pixel per float lane."""
    return STACK * width


HELD = 16
"""Number of lanes with which windows stay in registers, so that blocks may share them
(cl/lookup.h). With fewer lanes, samples are loaded tap by tap."""

_LARGEST_ANGLE = 2.0  # largest ratio of a block's radius to its distance in bounds on weight errors


@dataclass(frozen=True, eq=False)
class Tiles:
    """Plane that is divided into tiles of side x side pixels, and padded to whole tiles.

    Attributes
    ----------
    grid : Grid
        The plane.
    side : int
        Pixels along the side of a tile.
    width : int
        Float lanes per work-item.
    cosines : (float, float)
        Upper bounds on the cosines between lines of sight and the grid axes, from row to row and
        from column to column; see `cosines_of`.
    """

    grid: Grid
    side: int
    width: int
    cosines: tuple[float, float] = (1.0, 1.0)

    @property
    def down(self) -> int:
        """Number of rows of tiles."""
        return -(-self.grid.shape[0] // self.side)

    @property
    def across(self) -> int:
        """Number of columns of tiles. Bands of the image are whole rows of tiles."""
        return -(-self.grid.shape[1] // self.side)

    @property
    def parts(self) -> int:
        """Number of tiles."""
        return self.down * self.across

    @property
    def part_pixels(self) -> int:
        """Number of pixels of a tile."""
        return self.side**2

    @property
    def radius_m(self) -> float:
        """Largest distance of a pixel from the centre of its tile, metres."""
        return _radius_m(self.grid, self.side, self.side)

    @property
    def eccentricity(self) -> float:
        """Rms distance of pixels from the centres of their tiles, relative to that of whole tiles.

        A grid smaller than a tile lies in a corner of the tile, where float32 rounds most.
        """
        found_m2 = whole_m2 = 0.0
        for count, step_m in zip(self.grid.shape, self.grid.vectors_m[1:], strict=True):
            offset = np.arange(count) % self.side - (self.side - 1) / 2
            found_m2 += float(np.mean(offset**2)) * float(step_m @ step_m)
            whole_m2 += (self.side**2 - 1) / 12 * float(step_m @ step_m)
        return math.sqrt(found_m2 / whole_m2) if whole_m2 else 1.0

    @property
    def block_radius_m(self) -> float:
        """Largest distance of a pixel from the centre of its block, metres."""
        return _radius_m(self.grid, *BLOCKS[self.width])

    def one_cubic_error(self, beam: BeamWindow, nearest_m: float, wavelength_m: float) -> float:
        """Return the rms error of beam weights if one cubic is used for a whole work-item.

        The sine of the aspect angle is then also interpolated bilinearly over the work-item.

        Parameters
        ----------
        beam : BeamWindow
        nearest_m : float
            Least distance of a pixel from the phase centres.
        wavelength_m : float
        """
        rows, columns = BLOCKS[self.width]
        angle = min(_radius_m(self.grid, STACK * rows, columns) / nearest_m, _LARGEST_ANGLE)
        return math.hypot(beam.block_error(angle), beam.plane_error(angle, wavelength_m))

    def windows(self, most_m: float) -> int:
        """Return the number of windows in which a work-item looks up samples; 0 if none suffices.

        With this number, the range of no pixel differs by more than `most_m` from that of the
        middle of the blocks that share its window.
        """
        counts = (1, 2, STACK) if self.width == HELD else (STACK,)
        return next((n for n in counts if self._range_change_m(STACK // n) <= most_m), 0)

    def _range_change_m(self, blocks: int) -> float:
        """Return the largest change of range from the middle of some blocks to their pixels.

        Range changes by the scalar product of the displacement and a unit vector u towards an
        antenna, or by the mean of two such products. The farthest pixel is displaced by c from
        column to column and by r from row to row. The largest c |u_c| + r |u_r| is found for u_c
        and u_r within their bounds.
        """
        rows, columns = BLOCKS[self.width]
        farthest_m = _radius_m(self.grid, blocks * rows, columns)
        if min(self.cosines) >= 1:
            return farthest_m
        lengths_m = [float(np.linalg.norm(step)) for step in self.grid.vectors_m[1:]]
        along_m = (blocks * rows - 1) / 2 * lengths_m[0], (columns - 1) / 2 * lengths_m[1]
        for (one_m, one), (other_m, other) in itertools.permutations(
            zip(along_m, self.cosines, strict=True)
        ):
            if one * farthest_m < one_m:
                return one * one_m + min(other, math.sqrt(1 - one**2)) * other_m
        return farthest_m

    def cosines_of(self, antennas_m: NDArray[np.float64]) -> tuple[float, float]:
        """Return upper bounds on the cosine between lines of sight and the two grid axes.

        The first bound is for the axis from row to row, the second for that from column to column.
        If the axes are not perpendicular, both are 1.
        """
        axes = self._axes()
        if axes is None:
            return 1.0, 1.0
        origin_m, *steps_m = self.grid.vectors_m
        lengths_m = [float(np.linalg.norm(step)) for step in steps_m]
        half_m = np.array([self.down, self.across]) * self.side / 2 * lengths_m
        middle_m = origin_m + (half_m - np.array(lengths_m) / 2) @ axes
        away_m = antennas_m - middle_m
        along_m = np.abs(away_m @ axes.T)  # [antennas, 2]
        height_m2 = np.maximum(np.sum(away_m**2, axis=1) - np.sum(along_m**2, axis=1), 0.0)
        nearest_m = np.maximum(along_m - half_m, 0.0)[:, ::-1]
        farthest_m = along_m + half_m
        distance_m = np.sqrt(farthest_m**2 + nearest_m**2 + height_m2[:, None])
        down, across = np.max(farthest_m / np.maximum(distance_m, 1e-150), axis=0)
        return float(down), float(across)

    def cosines_in_beam(self, beam: BeamWindow, along: NDArray[np.float64]) -> tuple[float, float]:
        """Return the bounds of `cosines_of` for lines of sight within a beam.

        Parameters
        ----------
        beam : BeamWindow
        along : float64 [n, 3]
            Unit directions of the track in order. Between two of them the track is assumed to turn
            on the shortest path.
        """
        axes = self._axes()
        if axes is None:
            return 1.0, 1.0
        step = float(np.linalg.norm(np.diff(along, axis=0), axis=1).max(initial=0.0))
        # Largest angle between a direction of the track and the nearer of its two neighbours.
        from_nearer = math.asin(min(step / 2, 1.0))
        aspect = math.asin(min(float(np.abs(beam.limits).max()), 1.0)) + from_nearer
        # Angle from an axis to the direction of the track, then from there to the nearest line of
        # sight in the beam.
        angle = np.arccos(np.clip(np.abs(along @ axes.T), 0.0, 1.0))
        off = np.maximum(math.pi / 2 - aspect - angle, 0.0).min(axis=0)
        down, across = np.cos(off)
        return float(down), float(across)

    def _axes(self) -> NDArray[np.float64] | None:
        """Return unit vectors from row to row and column to column; None unless perpendicular."""
        steps_m = np.stack(self.grid.vectors_m[1:])
        lengths_m = np.linalg.norm(steps_m, axis=1)
        if abs(steps_m[0] @ steps_m[1]) > 1e-9 * lengths_m.prod() or not lengths_m.all():
            return None
        return steps_m / lengths_m[:, None]

    def nearest_m(self, antennas_m: NDArray[np.float64]) -> float:
        """Return a lower bound on the distance between antennas [n, 3] and tile centres, metres."""
        counts = (self.down - 1, self.across - 1)
        sides_m = [
            n * self.side * step_m
            for n, step_m in zip(counts, self.grid.vectors_m[1:], strict=True)
        ]
        lengths_m = [float(np.linalg.norm(side)) for side in sides_m]
        if abs(sides_m[0] @ sides_m[1]) > 1e-9 * lengths_m[0] * lengths_m[1]:
            return float(KDTree(antennas_m).query(self.centres_m(slice(None)))[0].min())
        # The distance of the rectangle around the centres is a lower bound and quickly computed.
        offset_m = antennas_m - self.centres_m(slice(0, 1))
        for side, length in zip(sides_m, lengths_m, strict=True):
            along = np.clip(offset_m @ side / max(length, 1e-150) ** 2, 0, 1)
            offset_m = offset_m - along[:, None] * side
        return float(np.linalg.norm(offset_m, axis=1).min())

    def centres_m(self, parts: slice) -> NDArray[np.float64]:
        """Return the centres of some tiles, counted row by row, float64 [parts, 3]."""
        down, across = np.divmod(np.arange(self.parts)[parts, None], self.across)
        origin_m, row_step_m, column_step_m = self.grid.vectors_m
        middle = (self.side - 1) / 2
        return (
            origin_m
            + (down * self.side + middle) * row_step_m
            + (across * self.side + middle) * column_step_m
        )

    def boxes(self, parts: slice) -> Boxes:
        """Return the boxes around the pixels of some tiles."""
        half_m = (self.side - 1) / 2 * np.stack(self.grid.vectors_m[1:])
        return Boxes.equal(self.centres_m(parts), half_m)

    def collect(self, pixels: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Return the image from the pixels of the padded plane, [parts * part_pixels]."""
        padded = pixels.reshape(self.down * self.side, self.across * self.side)
        rows, columns = self.grid.shape
        return np.ascontiguousarray(padded[:rows, :columns])


def _radius_m(grid: Grid, rows: int, columns: int) -> float:
    """Return the largest distance of a pixel from the centre of rows x columns pixels, metres."""
    _, row_step_m, column_step_m = grid.vectors_m
    down, across = (rows - 1) / 2 * row_step_m, (columns - 1) / 2 * column_step_m
    return float(max(np.linalg.norm(down + across), np.linalg.norm(down - across)))
