"""The tree of a factorized image: subimages within subimages, and the channels that each needs.

Factorized backprojection is fast because subimages form a tree, along which subapertures merge from
stage to stage (McCorkle and Rofheart 1996; Yegulalp 1999; Ulander, Hellsten and Stenström 2003).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from clsas.aperture.virtual_channels import ChannelRanges, VirtualChannels
from clsas.core.surface import Surface


@dataclass(frozen=True)
class Division:
    """A surface divided into subimages of several sizes, each size within the one before.

    Attributes
    ----------
    surface : Surface
    sides : tuple of (rows, columns)
        Sizes of subimages in cells, from the roots to the leaves. Each divides the one before.
    """

    surface: Surface
    sides: tuple[tuple[int, int], ...]

    @property
    def roots(self) -> NDArray[np.int64]:
        """First row and column of each root, [roots, 2], row by row.

        The rows of most grids are along the track, so that successive roots use the same samples.
        """
        rows, columns = (
            np.arange(0, n, side)
            for n, side in zip(self.surface.plane.shape, self.sides[0], strict=True)
        )
        down, across = np.meshgrid(rows, columns, indexing="ij")
        return np.stack([down.ravel(), across.ravel()], axis=1)

    def per_root(self, level: int) -> int:
        """Return the number of subimages of a level within a root."""
        return math.prod(self._divided(0, level))

    def corners(self, level: int, roots: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return first rows and columns of the subimages of a level within some roots.

        The result is [roots, subimages, 2], with the subimages of a root in row order.
        """
        down, across = self._divided(0, level)
        inside: NDArray[np.int64] = np.stack(np.divmod(np.arange(down * across), across), axis=1)
        return roots[:, None] + inside * self.sides[level]

    def centres_m(self, level: int, corners: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the middles of subimages whose first cells are `corners`, [..., 3]."""
        return self.surface.middles_m(self.sides[level], corners)

    def parents(self, level: int) -> NDArray[np.int64]:
        """Return the number of each subimage's parent on the level before, [subimages]."""
        down, across = self._divided(0, level)
        rows, columns = self._divided(level - 1, level)
        row, column = np.divmod(np.arange(down * across), across)
        return row // rows * (across // columns) + column // columns

    def by_parent(self, level: int, values: NDArray) -> NDArray:
        """Return values [roots, subimages], sorted by the parents of subimages.

        The result is [roots, parents, subimages of each parent].
        """
        down, across = self._divided(0, level - 1)
        rows, columns = self._divided(level - 1, level)
        split = values.reshape(len(values), down, rows, across, columns).swapaxes(2, 3)
        return split.reshape(len(values), down * across, rows * columns)

    def _divided(self, level: int, later: int) -> tuple[int, int]:
        """Return the rows and columns of a later level's subimages within a subimage of a level."""
        (rows, columns), (less_rows, less_columns) = self.sides[level], self.sides[later]
        return rows // less_rows, columns // less_columns


def channel_ranges(
    division: Division,
    virtual: list[VirtualChannels],
    coordinate: NDArray[np.float64],
    visible: tuple[NDArray[np.float64], NDArray[np.float64]],
    inside: NDArray[np.bool_],
) -> list[ChannelRanges]:
    """Return the channels that each subimage needs, stage by stage.

    Multiplied by the beam's weights, a steering function is 0 outside the stretch of the track from
    which the subimage is visible. Channels and virtual channels outside it are omitted, even if the
    taps of a filter extend to them.

    Parameters
    ----------
    division : Division
    virtual : list of VirtualChannels
        Virtual channels, stage by stage.
    coordinate : float64 [roots, channels]
        Apparent aperture coordinates of the raw channels.
    visible : two float64 [roots, leaves]
        Aperture coordinates between which each leaf is visible.
    inside : bool [roots, leaves]
        True for leaves that contain a pixel.
    """
    coordinates = [virtual[0].ordered(coordinate), *(each.coordinate for each in virtual)]
    # Trailing virtual channels to which no channel contributes are empty.
    counts = [np.full((len(coordinate), 1), coordinate.shape[1])]
    for each in virtual:
        counts.append(np.take_along_axis(each.base, counts[-1] - 1, axis=1) + each.taps)
    empty = ~inside | (visible[1] <= visible[0])
    start, stop = np.where(empty, np.inf, visible[0]), np.where(empty, -np.inf, visible[1])
    result = []
    for level in reversed(range(len(virtual))):
        begin, end = _between(coordinates[level], counts[level], start, stop, level > 0)
        first, last = _between(coordinates[level + 1], counts[level + 1], start, stop, True)
        ranges = ChannelRanges(first, last, begin, end)
        _clear(ranges, (end <= begin) | (last <= first) | (stop < start))
        result.append(ranges)
        if level:
            start = division.by_parent(level, start).min(axis=-1)
            stop = division.by_parent(level, stop).max(axis=-1)
    result = result[::-1]
    for level in range(1, len(virtual)):
        # Parents that are visible only from a gap of the track have no virtual channels.
        parent = result[level - 1]
        _clear(result[level], (parent.last <= parent.first)[:, division.parents(level)])
    return result


def _clear(ranges: ChannelRanges, empty: NDArray[np.bool_]) -> None:
    """Make the ranges of some subimages empty."""
    for array in (ranges.first, ranges.last, ranges.begin, ranges.end):
        array[empty] = 0


def _between(
    coordinates: NDArray[np.float64],
    counts: NDArray[np.int64],
    start: NDArray[np.float64],
    stop: NDArray[np.float64],
    nearest: bool,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first of ascending coordinates from start to stop, and the one after the last.

    With `nearest`, a stretch that lies between two coordinates gets both of them.
    """
    first, last = _rowwise(coordinates, start, "left"), _rowwise(coordinates, stop, "right")
    if nearest:
        between = last <= first
        first, last = first - between, last + between
    return np.clip(first, 0, counts), np.clip(last, 0, counts)


def _rowwise(
    rows: NDArray[np.float64], values: NDArray[np.float64], side: Literal["left", "right"]
) -> NDArray[np.int64]:
    """Return `np.searchsorted` row by row, of values [rows, values] in ascending rows [rows, n]."""
    # A single search serves all rows, which are shifted apart and concatenated.
    least, most = rows[:, 0].min(), rows[:, -1].max()
    apart = np.arange(len(rows))[:, None] * (most - least + 2)
    values = np.clip(values, least - 1, most + 1)
    found = np.searchsorted((rows + apart).ravel(), (values + apart).ravel(), side)
    before = np.arange(len(rows))[:, None] * rows.shape[1]
    return found.reshape(values.shape) - before
