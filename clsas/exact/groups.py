"""Groups: pixels at any positions, gathered with their neighbours around common centres.

Ranges and phases of a centre are computed in float64. The device computes the differences of the
pixels from it in float32, without expanding them.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from clsas.core.grid import Grid
from clsas.exact.tiles import BLOCKS, STACK, item_pixels
from clsas.sonar.beam import BeamWindow
from clsas.sonar.visibility import Boxes

_GROUPS_AT_ONCE = 1024  # groups whose offsets stay in a core's cache
_MORE_THAN_ROUNDING = 1.00001  # factor that covers the rounding of float32 offsets


@dataclass(frozen=True, eq=False)
class Groups:
    """Pixels in groups of `STACK` blocks, one group per work-item.

    Attributes
    ----------
    grid : Grid
        The pixels.
    index : int64 [parts, part_pixels]
        Flat indices of the pixels of each group. To fill a group, pixels are repeated.
    centre_m : float64 [parts, 3]
        Origin of the offsets, near the pixels of a group.
    offset_m : float32 [parts, part_pixels, 3]
        Positions relative to the centre.
    width : int
        Float lanes per work-item.
    across : int
        Number of groups that must be in the same band of the image: 1.
    """

    grid: Grid
    index: NDArray[np.int64]
    centre_m: NDArray[np.float64]
    offset_m: NDArray[np.float32]
    width: int
    across: int = 1

    @property
    def parts(self) -> int:
        """Number of groups."""
        return len(self.index)

    @property
    def part_pixels(self) -> int:
        """Number of pixels of a group, including repeated ones."""
        return self.index.shape[1]

    @functools.cached_property
    def radius_m(self) -> float:
        """Largest distance of a pixel from its group's centre."""
        return _longest(self.offset_m)

    @functools.cached_property
    def block_radius_m(self) -> float:
        """Largest distance of a pixel from the middle pixel of its work-item's block."""
        blocks = self.offset_m.reshape(-1, self.width, 3)
        rows, columns = BLOCKS[self.width]
        middle = (rows - 1) // 2 * columns + (columns - 1) // 2  # MIDDLE in cl/pixels.h
        return _longest(blocks - blocks[:, middle, None])

    def windows(self, most_m: float) -> int:
        """Return the number of windows in which a group looks up samples; 0 if blocks are too wide.

        No pixel is farther than `most_m` from the point around which its window lies. With one
        window this is the centre of the group, otherwise the middle pixel of each block.
        """
        if self.radius_m <= most_m:
            return 1
        return STACK if self.block_radius_m <= most_m else 0

    def one_cubic_error(self, beam: BeamWindow, nearest_m: float, wavelength_m: float) -> float:
        """Return the rms error of beam weights if one cubic is used for all pixels of a block.

        `nearest_m` is the least distance of a pixel from the phase centres. The wavelength has no
        effect, because the sine is computed for every pixel.
        """
        return beam.block_error(min(self.block_radius_m / nearest_m, 2.0))

    def nearest_m(self, antennas_m: NDArray[np.float64]) -> float:
        """Return the least distance between antennas [n, 3] and group centres."""
        return float(KDTree(antennas_m).query(self.centre_m)[0].min())

    def centres_m(self, parts: slice) -> NDArray[np.float64]:
        """Return the centres of some groups, float64 [parts, 3]."""
        return self.centre_m[parts]

    def middle_pixels(self, parts: slice) -> NDArray[np.int64]:
        """Return the index of one pixel of each of some groups, near its middle, [parts]."""
        return self.index[parts, self.part_pixels // 2]

    def boxes(self, parts: slice) -> Boxes:
        """Return boxes that contain the centres and pixels of some groups."""
        axes, half_m = self._extents
        return Boxes(self.centre_m[parts], axes, half_m[parts])

    @functools.cached_property
    def _extents(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Directions of the sides of the boxes, [axes, 3], and half their lengths, [parts, axes].

        The sides are parallel to the coordinate axes for points, and to rows and columns otherwise.
        """
        axes = np.eye(3)
        if self.grid.points_m is None:
            _, row_step_m, column_step_m = self.grid.vectors_m
            steps_m = [column_step_m, row_step_m, axes[2]]
            count = 2 if self.grid.is_planar else 3
            axes = np.linalg.qr(np.stack(steps_m[:count], axis=1))[0].T
        extent_m = np.abs(self.offset_m.reshape(-1, 3) @ axes.T.astype(np.float32))
        half_m = extent_m.reshape(self.parts, -1, len(axes)).max(axis=1)
        return axes, _MORE_THAN_ROUNDING * half_m.astype(np.float64)

    def collect(self, pixels: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Return the image from pixels [parts * part_pixels]."""
        image = np.empty(self.grid.size, np.complex64)
        image[self.index.ravel()] = pixels
        return image.reshape(self.grid.shape)


@dataclass(frozen=True, eq=False)
class GroupsEstimate:
    """Estimate of groups before they are gathered: all are full and as wide as float32 allows.

    Attributes
    ----------
    grid : Grid
        The pixels.
    part_pixels : int
        Number of pixels of a group.
    radius_m : float
        Largest distance of a pixel from the centre of its group.
    assumed_windows : int
        Number of `windows`, assumed because the extents of blocks are not known yet.
    """

    grid: Grid
    part_pixels: int
    radius_m: float
    assumed_windows: int = 1
    across: int = 1

    @property
    def parts(self) -> int:
        """Number of groups."""
        return -(-self.grid.size // self.part_pixels)

    def windows(self, most_m: float) -> int:
        """Return the assumed number of windows, whatever the extents of blocks."""
        return self.assumed_windows


def gather(grid: Grid, largest_radius_m: float, width: int) -> Groups:
    """Return groups in which no pixel is farther than a given radius from the centre."""
    position_m = grid.positions_m().reshape(-1, 3)
    size = item_pixels(width)
    rest = _neighbours(grid, position_m, width)
    # Runs of neighbours that are too wide are halved until they fit, or consist of one pixel.
    found = []
    length = size
    while len(rest):
        runs = np.append(rest, np.repeat(rest[-1:], -len(rest) % length)).reshape(-1, length)
        extent_m = np.ptp(position_m[runs], axis=1)
        fits = (np.linalg.norm(extent_m, axis=1) <= 2 * largest_radius_m) | (length == 1)
        found.append(np.pad(runs[fits], ((0, 0), (0, size - length)), mode="edge"))
        rest = runs[~fits].ravel()
        length //= 2
    index = np.concatenate(found)
    centre_m = (position_m[index].min(axis=1) + position_m[index].max(axis=1)) / 2
    offset_m = (position_m[index] - centre_m[:, None]).astype(np.float32)
    return Groups(grid, index, centre_m, offset_m, width)


def groups_within(
    grid: Grid,
    part: NDArray[np.int64],
    rank: NDArray[np.int64],
    middle_m: NDArray[np.float64],
    width: int,
) -> tuple[Groups, NDArray[np.int64]]:
    """Return groups of pixels that each lie within one part, with the middle of that part.

    Parameters
    ----------
    grid : Grid
    part : int64 [pixels]
        Number of the part that contains each pixel.
    rank : int64 [pixels]
        Order of the pixels within a part, in which neighbours follow each other.
    middle_m : float64 [parts, 3]
        Middle of each part.
    width : int
        Float lanes per work-item.

    Returns
    -------
    groups : Groups
    part : int64 [groups]
        Number of the part that contains each group, ascending.
    """
    size = item_pixels(width)
    order = np.argsort(part * (rank.max() + 1) + rank)
    held = np.bincount(part, minlength=len(middle_m))
    counts = -(-held // size)
    of_group = np.repeat(np.arange(len(middle_m)), counts)
    first = (np.arange(len(of_group)) - (np.cumsum(counts) - counts)[of_group]) * size
    last = held[of_group] - 1
    before = (np.cumsum(held) - held)[of_group]
    index = np.empty((len(of_group), size), np.int64)
    centre_m, offset_m = middle_m[of_group], np.empty((*index.shape, 3), np.float32)
    for start in range(0, len(index), _GROUPS_AT_ONCE):
        some = slice(start, start + _GROUPS_AT_ONCE)
        # The last pixel of a part is repeated to fill the last group of the part.
        member = np.minimum(first[some, None] + np.arange(size), last[some, None])
        index[some] = order[before[some, None] + member]
        offset_m[some] = grid.at(index[some]) - centre_m[some, None]
    return Groups(grid, index, centre_m, offset_m, width), of_group


def _neighbours(grid: Grid, position_m: NDArray[np.float64], width: int) -> NDArray[np.int64]:
    """Return the flat indices of all pixels, neighbours in sequence; edge pixels may repeat."""
    if grid.points_m is not None:
        return KDTree(position_m, leafsize=item_pixels(width)).indices
    rows, columns = BLOCKS[width]
    rows *= STACK
    index = np.arange(grid.size).reshape(grid.shape)
    index = np.pad(index, [(0, -grid.shape[0] % rows), (0, -grid.shape[1] % columns)], mode="edge")
    down, across = index.shape[0] // rows, index.shape[1] // columns
    return index.reshape(down, rows, across, columns).swapaxes(1, 2).ravel()


def _longest(vectors: NDArray[np.floating]) -> float:
    """Return the length of the longest of vectors [..., 3]."""
    return float(np.sqrt(np.einsum("...i,...i->...", vectors, vectors).max()))
