"""Parts of a grid, whose pixels share one centre: tiles of a plane, and groups of points.

Ranges and phases of a centre are computed in float64, and the differences of its pixels from it on
the device, in float32. In tiles these differences are expanded about the centre; in groups they are
computed without an expansion.

A part is formed by work-items of `STACK` blocks each (cl/pixels.h). The lanes of a block pick their
samples from windows of a line (cl/lookup.h), which must be wide enough for the ranges of its
pixels.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, fastest
from clsas.engine.data.visibility import Boxes
from clsas.engine.device.device import Device

STACK = 4
"""Number of blocks of a work-item, which lie one below the other (cl/pixels.h)."""

BLOCKS = {16: (4, 4), 8: (2, 4), 4: (2, 2), 1: (1, 1)}
"""Rows and columns of a block by number of float lanes, with one pixel per lane."""

HELD = 16
"""Number of lanes with which windows stay in registers, so that blocks may share them
(cl/lookup.h). With fewer lanes, samples are loaded tap by tap."""

_LARGEST_ANGLE = 2.0  # largest ratio of a block's radius to its distance in bounds on weight errors
_PERPENDICULAR = 1e-9  # cosine of the angle of sides, up to which they count as perpendicular
_GROUPS_AT_ONCE = 1024  # groups whose offsets stay in a core's cache
_MORE_THAN_ROUNDING = 1.00001  # factor that covers the rounding of float32 offsets
_FLOAT32 = 0.05  # margin for the rounding of positions, samples

# Relative time of a pixel and channel, measured with PoCL, by the number of lanes and the number of
# vectors from which they pick; 0 vectors if each lane reads its own samples.
_LOOKUP_COSTS = {16: {2: 1.0, 0: 3.0}, 8: {1: 1.0, 2: 1.4, 0: 3.0}}


def item_pixels(width: int) -> int:
    """Return the number of pixels of a work-item: `STACK` blocks of one pixel per float lane."""
    return STACK * width


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

    # Extents and distances, from which errors of the geometry follow

    @property
    def radius_m(self) -> float:
        """Largest distance of a pixel from the centre of its tile, metres."""
        return _radius_m(self.grid, self.side, self.side)

    @property
    def block_radius_m(self) -> float:
        """Largest distance of a pixel from the centre of its block, metres."""
        return _radius_m(self.grid, *BLOCKS[self.width])

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

    def nearest_m(self, antennas_m: NDArray[np.float64]) -> float:
        """Return a lower bound on the distance between antennas [n, 3] and tile centres, metres."""
        counts = (self.down - 1, self.across - 1)
        sides_m = [
            n * self.side * step_m
            for n, step_m in zip(counts, self.grid.vectors_m[1:], strict=True)
        ]
        lengths_m = [float(np.linalg.norm(side)) for side in sides_m]
        if abs(sides_m[0] @ sides_m[1]) > _PERPENDICULAR * lengths_m[0] * lengths_m[1]:
            return float(KDTree(antennas_m).query(self.centres_m(slice(None)))[0].min())
        # The distance of the rectangle around the centres is a lower bound and quickly computed.
        offset_m = antennas_m - self.centres_m(slice(0, 1))
        for side, length in zip(sides_m, lengths_m, strict=True):
            along = np.clip(offset_m @ side / max(length, 1e-150) ** 2, 0, 1)
            offset_m = offset_m - along[:, None] * side
        return float(np.linalg.norm(offset_m, axis=1).min())

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

    # Windows, which may be narrower where no antenna lies in the direction of a grid axis

    def windows(self, most_m: float) -> int:
        """Return the number of windows in which a work-item looks up samples; 0 if none suffices.

        With this number, the range of no pixel differs by more than `most_m` from that of the
        middle of the blocks that share its window.
        """
        for count in (1, 2, STACK) if self.width == HELD else (STACK,):
            if self._range_change_m(STACK // count) <= most_m:
                return count
        return 0

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
        if abs(steps_m[0] @ steps_m[1]) > _PERPENDICULAR * lengths_m.prod() or not lengths_m.all():
            return None
        return steps_m / lengths_m[:, None]


def _radius_m(grid: Grid, rows: int, columns: int) -> float:
    """Return the largest distance of a pixel from the centre of rows x columns pixels, metres."""
    _, row_step_m, column_step_m = grid.vectors_m
    down, across = (rows - 1) / 2 * row_step_m, (columns - 1) / 2 * column_step_m
    return float(max(np.linalg.norm(down + across), np.linalg.norm(down - across)))


@dataclass(frozen=True, eq=False)
class Groups:
    """Pixels at any positions, in groups of `STACK` blocks, one group per work-item.

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

    # Extents and distances, from which errors of the geometry follow

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

    def nearest_m(self, antennas_m: NDArray[np.float64]) -> float:
        """Return the least distance between antennas [n, 3] and group centres."""
        return float(KDTree(antennas_m).query(self.centre_m)[0].min())

    def one_cubic_error(self, beam: BeamWindow, nearest_m: float, wavelength_m: float) -> float:
        """Return the rms error of beam weights if one cubic is used for all pixels of a block.

        `nearest_m` is the least distance of a pixel from the phase centres. The wavelength has no
        effect, because the sine is computed for every pixel.
        """
        return beam.block_error(min(self.block_radius_m / nearest_m, _LARGEST_ANGLE))

    def windows(self, most_m: float) -> int:
        """Return the number of windows in which a group looks up samples; 0 if blocks are too wide.

        No pixel is farther than `most_m` from the point around which its window lies. With one
        window this is the centre of the group, otherwise the middle pixel of each block.
        """
        if self.radius_m <= most_m:
            return 1
        return STACK if self.block_radius_m <= most_m else 0


def _longest(vectors: NDArray[np.floating]) -> float:
    """Return the length of the longest of vectors [..., 3]."""
    return float(np.sqrt(np.einsum("...i,...i->...", vectors, vectors).max()))


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
    # Put neighbours in sequence: the leaves of a tree, or stacks of blocks, the last ones filled up
    # with pixels at the edge.
    if grid.points_m is not None:
        rest = KDTree(position_m, leafsize=size).indices
    else:
        rows, columns = STACK * BLOCKS[width][0], BLOCKS[width][1]
        missing = [(0, -grid.shape[0] % rows), (0, -grid.shape[1] % columns)]
        pixel = np.pad(np.arange(grid.size).reshape(grid.shape), missing, mode="edge")
        down, across = pixel.shape[0] // rows, pixel.shape[1] // columns
        rest = pixel.reshape(down, rows, across, columns).swapaxes(1, 2).ravel()
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


def lookup_options(
    device: Device,
    layout: Tiles | Groups | GroupsEstimate,
    lines: RangeLines,
    samples_per_m: float,
    taps: int,
) -> dict[str, int]:
    """Return the build options of the lookup (cl/lookup.h).

    These are the fastest options with which every pixel finds its samples: in one vector if the
    positions of a block fit into it, else in two, else every lane for itself.
    """
    # Ranges to moving receivers change a little faster than the positions of pixels.
    metres = 1 / samples_per_m / (1 + 2 * fastest(lines))
    for vectors in filter(None, lookup_costs(device)):
        windows = layout.windows(lookup_room(vectors, taps, device.info.width) * metres)
        if windows:
            return {"PERMUTE": vectors, "WINDOWS": windows}
    return {"PERMUTE": 0, "WINDOWS": 1}


def lookup_costs(device: Device) -> dict[int, float]:
    """Return relative times per pixel and channel by number of vectors, the fastest first."""
    no_choice = {0: 1.0}
    return _LOOKUP_COSTS.get(device.info.width, no_choice) if device.info.permute else no_choice


def lookup_room(vectors: int, taps: int, width: int) -> float:
    """Return the largest allowed distance of a pixel's echo from the middle of its window, samples.

    With AVX-512, a window is two vectors with the samples of all taps. With AVX2 it contains the
    samples of one tap. Rounding positions to whole samples takes half a sample.
    """
    positions = 2 * width - taps + 1 if width == HELD else vectors * width
    return (positions - 1) / 2 - _FLOAT32
