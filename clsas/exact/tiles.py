"""Tiles: square parts of a plane, whose pixels share one centre.

Ranges and phases of the centre are computed in float64; the device computes the pixels' differences
from it in float32.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from clsas.core.grid import Grid
from clsas.sonar.beam import BeamWindow
from clsas.sonar.visibility import Boxes

STACK = 4
"""Blocks per work-item, one below the other (cl/pixels.h)."""

BLOCKS = {16: (4, 4), 8: (2, 4), 4: (2, 2), 1: (1, 1)}
"""Rows and columns of a block, by float lanes."""

_LARGEST_ANGLE = 2.0  # of a block at its distance; error bounds of weights saturate beyond it


@dataclass(frozen=True, eq=False)
class Tiles:
    """A plane cut into tiles of side x side pixels, padded to whole tiles.

    Attributes
    ----------
    grid : Grid
        The plane.
    side : int
        Pixels along a tile's side.
    width : int
        Float lanes per work-item.
    """

    grid: Grid
    side: int
    width: int

    @property
    def down(self) -> int:
        """Rows of tiles."""
        return -(-self.grid.shape[0] // self.side)

    @property
    def across(self) -> int:
        """Columns of tiles. Bands of the image are whole rows of tiles."""
        return -(-self.grid.shape[1] // self.side)

    @property
    def parts(self) -> int:
        """Number of tiles."""
        return self.down * self.across

    @property
    def part_pixels(self) -> int:
        """Pixels of a tile."""
        return self.side**2

    @property
    def radius_m(self) -> float:
        """Largest distance of a pixel from its tile's centre."""
        return _radius_m(self.grid, self.side, self.side)

    @property
    def eccentricity(self) -> float:
        """Rms distance of the grid's pixels from their tiles' centres, relative to whole tiles.

        A grid smaller than a tile lies in the tile's corner, where float32 rounds most.
        """
        found_m2 = whole_m2 = 0.0
        for count, step_m in zip(self.grid.shape, self.grid.vectors_m[1:], strict=True):
            offset = np.arange(count) % self.side - (self.side - 1) / 2
            found_m2 += float(np.mean(offset**2)) * float(step_m @ step_m)
            whole_m2 += (self.side**2 - 1) / 12 * float(step_m @ step_m)
        return math.sqrt(found_m2 / whole_m2) if whole_m2 else 1.0

    @property
    def block_radius_m(self) -> float:
        """Largest distance of a pixel from the centre of its work-item's block."""
        return _radius_m(self.grid, *BLOCKS[self.width])

    def one_cubic_error(self, beam: BeamWindow, nearest_m: float, wavelength_m: float) -> float:
        """Return the rms error of a beam's weights if one cubic serves a whole work-item.

        The sine of the aspect angle is then taken as bilinear over the work-item, too.

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

    @property
    def lookup_radius_m(self) -> float:
        """Largest distance of a pixel from the point about which its block looks samples up."""
        return self._lookup_radius_m(1)

    def windows(self, most_m: float) -> int:
        """Return how many windows a work-item looks samples up in; 0 if even blocks are too large.

        No pixel is farther than `most_m` from the point about which its window lies.
        """
        counts = (n for n in (1, 2, STACK) if self._lookup_radius_m(STACK // n) <= most_m)
        return next(counts, 0)

    def _lookup_radius_m(self, blocks: int) -> float:
        """Return `lookup_radius_m` for windows that some blocks of a work-item share."""
        # A window lies about the column left of the blocks' middle: half a pixel beside it.
        rows, columns = BLOCKS[self.width]
        return _radius_m(self.grid, blocks * rows, columns + 1)

    def nearest_m(self, antennas_m: NDArray[np.float64]) -> float:
        """Return a lower bound of the distance between antennas [n, 3] and tile centres."""
        counts = (self.down - 1, self.across - 1)
        sides_m = [
            n * self.side * step_m
            for n, step_m in zip(counts, self.grid.vectors_m[1:], strict=True)
        ]
        lengths_m = [float(np.linalg.norm(side)) for side in sides_m]
        if abs(sides_m[0] @ sides_m[1]) > 1e-9 * lengths_m[0] * lengths_m[1]:
            return float(KDTree(antennas_m).query(self.centres_m(slice(None)))[0].min())
        # The distance of the rectangle around the centres is a lower bound, and quickly found.
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
        """Return the image from rows of the padded plane, [parts * part_pixels]."""
        padded = pixels.reshape(self.down * self.side, self.across * self.side)
        rows, columns = self.grid.shape
        return np.ascontiguousarray(padded[:rows, :columns])


def _radius_m(grid: Grid, rows: int, columns: int) -> float:
    """Return the largest distance of a pixel from the centre of rows x columns pixels, metres."""
    _, row_step_m, column_step_m = grid.vectors_m
    down, across = (rows - 1) / 2 * row_step_m, (columns - 1) / 2 * column_step_m
    return float(max(np.linalg.norm(down + across), np.linalg.norm(down - across)))
