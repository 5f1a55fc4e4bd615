"""Groups: pixels anywhere, gathered with their neighbours about common centres.

Ranges and phases of a centre are computed in float64; the device computes the pixels' differences
from it in float32, without expanding them.
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

_GROUPS_AT_ONCE = 1024  # stays in a core's cache
_MORE_THAN_ROUNDING = 1.00001  # of float32 offsets


@dataclass(frozen=True, eq=False)
class Groups:
    """Pixels in groups of STACK blocks.

    Attributes
    ----------
    grid : Grid
        The pixels.
    index : int64 [parts, part_pixels]
        Flat number of each group's pixels. A pixel may stand several times to fill a group.
    centre_m : float64 [parts, 3]
        Origin of the offsets, near a group's pixels.
    offset_m : float32 [parts, part_pixels, 3]
        Positions from the centre.
    width : int
        Float lanes per work-item.
    across : int
        Groups that have to be in the same band of the image: any one.
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
        """Padded pixels of a group."""
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
        """Return how many windows a group looks samples up in; 0 if even blocks are too large.

        No pixel is farther than `most_m` from the point about which its window lies. That is the
        centre of a whole group, or the middle pixel of a block.
        """
        if self.radius_m <= most_m:
            return 1
        return STACK if self.block_radius_m <= most_m else 0

    def one_cubic_error(self, beam: BeamWindow, nearest_m: float, wavelength_m: float) -> float:
        """Return the rms error of a beam's weights if one cubic serves all pixels of a block.

        `nearest_m` is the least distance of a pixel from the phase centres. The wavelength plays
        no part, since every pixel has its own sine.
        """
        return beam.block_error(min(self.block_radius_m / nearest_m, 2.0))

    def nearest_m(self, antennas_m: NDArray[np.float64]) -> float:
        """Return the least distance between antennas [n, 3] and group centres."""
        return float(KDTree(antennas_m).query(self.centre_m)[0].min())

    def centres_m(self, parts: slice) -> NDArray[np.float64]:
        """Return the centres of some groups, float64 [parts, 3]."""
        return self.centre_m[parts]

    def boxes(self, parts: slice) -> Boxes:
        """Return boxes around the centres and pixels of some groups."""
        axes, half_m = self._extents
        return Boxes(self.centre_m[parts], axes, half_m[parts])

    @functools.cached_property
    def _extents(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Directions of the boxes' sides, [axes, 3], and half their lengths, [parts, axes].

        Points are gathered along the coordinate axes, all others along rows and columns.
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
    """Groups before they are gathered, as if all were full and as wide as float32 allows.

    Attributes
    ----------
    grid : Grid
        The pixels.
    part_pixels : int
        Padded pixels of a group.
    radius_m : float
        Largest distance of a pixel from its group's centre.
    assumed_windows : int
        See `windows`: how far apart the pixels of a block lie is not known yet.
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
        """Return the windows assumed, whatever pixels may be apart."""
        return self.assumed_windows


def gather(grid: Grid, largest_radius_m: float, width: int) -> Groups:
    """Return groups whose pixels lie within a radius of their centre."""
    position_m = grid.positions_m().reshape(-1, 3)
    size = item_pixels(width)
    rest = _neighbours(grid, position_m, width)
    # Runs of neighbours that are too wide are halved until they fit or hold one pixel.
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
    """Return groups of pixels that each lie within one part, about the middle of that part.

    Parameters
    ----------
    part : int64 [pixels]
        Number of the part that holds each pixel.
    rank : int64 [pixels]
        Order of the pixels within a part, in which near pixels follow each other.
    middle_m : float64 [parts, 3]

    Returns
    -------
    groups : Groups
    part : int64 [groups]
        Number of the part that holds each group, ascending.
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
        # The last pixel of a part fills up the part's last group.
        member = np.minimum(first[some, None] + np.arange(size), last[some, None])
        index[some] = order[before[some, None] + member]
        offset_m[some] = grid.at(index[some]) - centre_m[some, None]
    return Groups(grid, index, centre_m, offset_m, width), of_group


def _neighbours(grid: Grid, position_m: NDArray[np.float64], width: int) -> NDArray[np.int64]:
    """Return every pixel's flat index, neighbours in sequence; edge pixels may stand twice."""
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
