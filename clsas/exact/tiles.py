"""Pixels as work for a device: tiles of a plane, or groups of nearby points.

Either way the pixels form parts, each with a centre. Ranges and phases are referred, in float64, to
the centres; within a part the device computes differences in float32.
"""

from __future__ import annotations

import functools
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

GEOMETRY_ERROR = 3.2e-5
"""Relative rms error that the geometry's rounding and expansion may add: -90 dB."""

ROUNDING = 2.2e-7
"""Rms error of a phase, radians, per cycle over a part's radius: measured, of many channels."""

_ONE_CHANNEL = 5.0  # relative excess of the error power of a single channel, at worst
_FEW_CHANNELS = 32  # of more, errors average to within a decibel of the mean

_SIDES = (64, 32, 16)
_AT_ONCE = 1024  # groups: what stays in a cache


@dataclass(frozen=True, eq=False)
class Tiles:
    """A plane cut into tiles of side x side pixels, padded to whole ones.

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
        """Columns of tiles: how many parts must be computed together."""
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
        """Rms distance of the grid's pixels from their tiles' centres, relative to whole tiles'.

        A grid that is smaller than a tile lies in its corner, where float32 rounds most.
        """
        found_m2 = whole_m2 = 0.0
        for count, step_m in zip(
            self.grid.shape, (self.grid.row_step_m, self.grid.column_step_m), strict=True
        ):
            offset = np.arange(count) % self.side - (self.side - 1) / 2
            found_m2 += np.mean(offset**2) * float(step_m @ step_m)
            whole_m2 += (self.side**2 - 1) / 12 * float(step_m @ step_m)
        return math.sqrt(found_m2 / whole_m2) if whole_m2 else 1.0

    @property
    def block_radius_m(self) -> float:
        """Largest distance of a pixel from the centre of its work-item's block."""
        return _radius_m(self.grid, *BLOCKS[self.width])

    def one_cubic_error(self, beam: BeamWindow, nearest_m: float, wavelength_m: float) -> float:
        """Return the rms error of a beam's weights if one cubic serves a whole work-item.

        No pixel is nearer than `nearest_m`. The sine in it is taken as bilinear, too.
        """
        rows, columns = BLOCKS[self.width]
        reach = min(_radius_m(self.grid, STACK * rows, columns) / nearest_m, 2.0)
        return math.hypot(beam.block_error(reach), beam.plane_error(reach, wavelength_m))

    @property
    def lookup_radius_m(self) -> float:
        """Largest distance of a pixel from where the samples of its block are looked up about."""
        return self._around(1)

    def windows(self, most_m: float) -> int:
        """Return for how many parts of a work-item samples are looked up, 0 if not even for blocks.

        No pixel is further than `most_m` from where they are looked up about.
        """
        parts = (n for n in (1, 2, STACK) if self._around(STACK // n) <= most_m)
        return next(parts, 0)

    def _around(self, blocks: int) -> float:
        # The column in their middle is half a pixel beside it.
        rows, columns = BLOCKS[self.width]
        return _radius_m(self.grid, blocks * rows, columns + 1)

    def nearest_m(self, places_m: NDArray[np.float64]) -> float:
        """Return the distance between places [n, 3] and centres of tiles, or a little less."""
        grid, counts = self.grid, (self.down - 1, self.across - 1)
        sides_m = [
            n * self.side * s
            for n, s in zip(counts, (grid.row_step_m, grid.column_step_m), strict=True)
        ]
        lengths_m = [np.linalg.norm(side) for side in sides_m]
        if abs(sides_m[0] @ sides_m[1]) > 1e-9 * lengths_m[0] * lengths_m[1]:
            return float(KDTree(places_m).query(self.centres_m(slice(None)))[0].min())
        # Of the rectangle on whose lattice the centres lie.
        way_m = places_m - self.centres_m(slice(0, 1))
        for side, length in zip(sides_m, lengths_m, strict=True):
            along = np.clip(way_m @ side / max(length, 1e-150) ** 2, 0, 1)
            way_m = way_m - along[:, None] * side
        return float(np.linalg.norm(way_m, axis=1).min())

    def centres_m(self, parts: slice) -> NDArray[np.float64]:
        """Return the centres of some tiles, counted row by row, float64 [parts, 3]."""
        down, across = np.divmod(np.arange(self.parts)[parts, None], self.across)
        middle = (self.side - 1) / 2
        return (
            self.grid.origin_m
            + (down * self.side + middle) * self.grid.row_step_m
            + (across * self.side + middle) * self.grid.column_step_m
        )

    def boxes(self, parts: slice) -> Boxes:
        """Return the boxes around the pixel centres of some tiles."""
        steps_m = np.stack([self.grid.row_step_m, self.grid.column_step_m])
        return Boxes.equal(self.centres_m(parts), (self.side - 1) / 2 * steps_m)

    def collect(self, pixels: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Return the image of pixels [parts * part_pixels], rows of the padded plane."""
        padded = pixels.reshape(self.down * self.side, self.across * self.side)
        rows, columns = self.grid.shape
        return np.ascontiguousarray(padded[:rows, :columns])


@dataclass(frozen=True, eq=False)
class Groups:
    """Points in groups of STACK blocks.

    Attributes
    ----------
    grid : Grid
        The points.
    index : int64 [parts, part_pixels]
        Which pixel each slot computes, flat; a pixel may stand in several slots to fill a group.
    centre_m : float64 [parts, 3]
        What offsets are from, near a group's points.
    offset_m : float32 [parts, part_pixels, 3]
        Positions from the centre.
    width : int
        Float lanes per work-item.
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
        """Slots of a group."""
        return self.index.shape[1]

    @functools.cached_property
    def radius_m(self) -> float:
        """Largest distance of a pixel from its group's centre."""
        return _longest(self.offset_m)

    @functools.cached_property
    def block_radius_m(self) -> float:
        """Largest distance of a pixel from the one in the middle of its work-item's block."""
        blocks = self.offset_m.reshape(-1, self.width, 3)
        rows, columns = BLOCKS[self.width]
        middle = (rows - 1) // 2 * columns + (columns - 1) // 2  # MIDDLE in cl/pixels.h
        return _longest(blocks - blocks[:, middle, None])

    @property
    def lookup_radius_m(self) -> float:
        """Largest distance of a pixel from where the samples of its block are looked up about."""
        return self.block_radius_m

    def windows(self, most_m: float) -> int:
        """Return for how many parts of a group samples are looked up, 0 if not even for blocks.

        No pixel is further than `most_m` from where they are looked up about: of a whole group from
        its centre, else of a block from the pixel in its middle.
        """
        if self.radius_m <= most_m:
            return 1
        return STACK if self.block_radius_m <= most_m else 0

    def one_cubic_error(self, beam: BeamWindow, nearest_m: float, wavelength_m: float) -> float:
        """Return the rms error of a beam's weights if one cubic serves all points of a block.

        None is nearer than `nearest_m`.
        """
        return beam.block_error(min(self.block_radius_m / nearest_m, 2.0))

    def nearest_m(self, places_m: NDArray[np.float64]) -> float:
        """Return the least distance between places [n, 3] and centres of groups."""
        return float(KDTree(places_m).query(self.centre_m)[0].min())

    def centres_m(self, parts: slice) -> NDArray[np.float64]:
        """Return the centres of some groups, float64 [parts, 3]."""
        return self.centre_m[parts]

    def boxes(self, parts: slice) -> Boxes:
        """Return boxes around the pixels and the centres of some groups.

        Their sides lie along the grid's rows and columns, or along the coordinate axes for points.
        """
        axes, half_m = self._box
        return Boxes(self.centre_m[parts], axes, half_m[parts])

    @functools.cached_property
    def _box(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Directions of the boxes' sides, [axes, 3], and half their lengths, [parts, axes]."""
        axes = np.eye(3)
        if self.grid.points_m is None:
            steps_m = [self.grid.column_step_m, self.grid.row_step_m, *axes[2:]]
            axes = np.linalg.qr(np.stack(steps_m[: 2 if self.grid.is_planar else 3], axis=1))[0].T
        extent_m = np.abs(self.offset_m.reshape(-1, 3) @ axes.T.astype(np.float32))
        half_m = extent_m.reshape(self.parts, -1, len(axes)).max(axis=1).astype(np.float64)
        return axes, 1.00001 * half_m  # more than float32 rounds off

    def collect(self, pixels: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Return the image of pixels [parts * part_pixels]."""
        image = np.empty(self.grid.size, np.complex64)
        image[self.index.ravel()] = pixels
        return image.reshape(self.grid.shape)


@dataclass(frozen=True, eq=False)
class GroupsEstimate:
    """Groups before they are made: as if all were full, and as wide as float32 allows.

    Attributes
    ----------
    grid : Grid
        The points.
    part_pixels : int
        Slots of a group.
    radius_m : float
        Largest distance of a pixel from its group's centre.
    lookup_radius_m : float
        Unknown, and taken as none.
    """

    grid: Grid
    part_pixels: int
    radius_m: float
    lookup_radius_m: float = 0.0
    across: int = 1

    @property
    def parts(self) -> int:
        """Number of groups."""
        return -(-self.grid.size // self.part_pixels)


def allowed(accuracy_db: float) -> float:
    """Return what the geometry may add to an image's error: 6 % of its power, -90 dB at least."""
    return max(GEOMETRY_ERROR, 10 ** ((accuracy_db - 12) / 20))


def lay_out(
    grid: Grid,
    antennas_m: NDArray[np.float64],
    cycles_per_m: float,
    width: int,
    *,
    error: float = GEOMETRY_ERROR,
    speed_ratio: float = 0.0,
    beam: BeamWindow | None = None,
    fullness: float = 1.0,
    longest_m: float | None = None,
) -> Tiles | Groups | GroupsEstimate:
    """Return how to divide a grid so that the geometry's share of the error stays small.

    That is below -90 dB in tiles, if there are such; else in tiles within `error`; else in groups.

    Parameters
    ----------
    grid : Grid
        The pixels.
    antennas_m : float64 [n, 3]
        Every transmitter and receiver position.
    cycles_per_m : float
        Phase per metre of range, cycles: two over the wavelength.
    width : int
        Float lanes per work-item.
    error : float
        Relative rms error that the geometry may add; see `allowed`.
    speed_ratio : float
        Speed of the fastest receiver over that of sound.
    beam : BeamWindow, optional
        Weights of the channels.
    fullness : float
        Of the beam, by what it sees of the pixels: `BeamWindow.fullness`. Errors of weights must be
        as much smaller.
    longest_m : float, optional
        Length of the lines. With it groups are estimated in place of made.

    Notes
    -----
    A tile is expanded to third order, so that its largest error is that of the fourth:
    r^4/(8 R^3) at most, r its half diagonal and R the distance of the nearest antenna. The rms
    over a tile's pixels and directions is 0.15 of it. What receivers' motion does to the third
    order is left out too, 0.2 of r^3/R^2 times the speed ratio. With a window the aspect angle's
    sine is expanded to third order too, to a millionth of the window's width (float32 holds no less
    than 1e-7), and a block, where the window is a cubic, must be small against it. Where even the
    smallest tile is too large, near the antennas, and off a plane, pixels go into groups, which
    expand nothing.
    """
    found = tiles(
        grid,
        antennas_m,
        cycles_per_m,
        width,
        error=error,
        speed_ratio=speed_ratio,
        beam=beam,
        fullness=fullness,
    )
    if found is not None:
        return found
    radius_m = largest_radius_m(cycles_per_m, len(antennas_m))
    if longest_m is not None:
        return GroupsEstimate(grid, STACK * width, min(radius_m, longest_m))
    return _group(grid, radius_m, width)


def tiles(
    grid: Grid,
    antennas_m: NDArray[np.float64],
    cycles_per_m: float,
    width: int,
    *,
    error: float = GEOMETRY_ERROR,
    speed_ratio: float = 0.0,
    beam: BeamWindow | None = None,
    fullness: float = 1.0,
) -> Tiles | None:
    """Return the tiles that `lay_out` makes, None where it makes groups."""
    if not grid.is_planar:
        return None
    window_sine = np.inf if beam is None else np.ptp(np.clip(beam.limits, -1, 1))
    tried = []
    for side in _SIDES:
        shape = Tiles(grid, side, width)
        nearest = max(shape.nearest_m(antennas_m), 1e-30)
        remainder_m = 0.15 * shape.radius_m**4 / (8 * nearest**3)
        remainder_m += 0.2 * speed_ratio * shape.radius_m**3 / nearest**2
        rounding = rounding_error(len(antennas_m)) * cycles_per_m * shape.radius_m
        rounding *= shape.eccentricity
        phase_error = np.hypot(2 * np.pi * cycles_per_m * remainder_m, rounding)
        block_error = 0.0
        if beam is not None:
            block_error = beam.block_error(shape.block_radius_m / nearest) / fullness
        sine_error = 0.1 * (shape.radius_m / nearest) ** 4
        tried.append((shape, max(phase_error, block_error), sine_error))
    # Where the finest takes groups, tiles as fine as is wanted are much faster.
    for most in (GEOMETRY_ERROR, error):
        most_sine = max(max(1e-6, (most * fullness) ** 2) * window_sine, 1e-7)
        for shape, shape_error, sine_error in tried:
            if shape_error <= most and sine_error <= most_sine:
                return shape
    return None


def rounding_error(channels: int) -> float:
    """Rms error of a phase, radians, per cycle over a part's radius.

    Coefficients are rounded once per part and channel, so that the error of one channel depends on
    how it lies to the part; that of many averages out.
    """
    excess = _ONE_CHANNEL / channels if channels <= _FEW_CHANNELS else 0.0
    return ROUNDING * math.sqrt(1 + excess)


def largest_radius_m(cycles_per_m: float, channels: int) -> float:
    """Largest distance of a pixel from its group's centre that float32 allows."""
    with np.errstate(divide="ignore"):
        return GEOMETRY_ERROR / rounding_error(channels) / np.float64(cycles_per_m)


def _group(grid: Grid, largest_radius_m: float, width: int) -> Groups:
    """Return groups whose pixels lie within a radius of their centre."""
    positions = grid.positions_m().reshape(-1, 3)
    size = STACK * width
    rest = _neighbours(grid, positions, width)
    # Runs of neighbours; those that are too wide are halved until they fit or hold one point.
    index = []
    length = size
    while len(rest):
        runs = np.append(rest, np.repeat(rest[-1:], -len(rest) % length)).reshape(-1, length)
        extent = np.ptp(positions[runs], axis=1)
        fits = (np.linalg.norm(extent, axis=1) <= 2 * largest_radius_m) | (length == 1)
        index.append(np.pad(runs[fits], ((0, 0), (0, size - length)), mode="edge"))
        rest = runs[~fits].ravel()
        length //= 2
    index = np.concatenate(index)
    centre = (positions[index].min(axis=1) + positions[index].max(axis=1)) / 2
    offset = (positions[index] - centre[:, None]).astype(np.float32)
    return Groups(grid, index, centre, offset, width)


def groups_within(
    grid: Grid,
    part: NDArray[np.int64],
    place: NDArray[np.int64],
    middle_m: NDArray[np.float64],
    width: int,
) -> tuple[Groups, NDArray[np.int64]]:
    """Return groups of points that lie within one part each, about whose middle they are.

    Parameters
    ----------
    part, place : int64 [pixels]
        What holds each pixel, and numbers that near ones in it have alike.
    middle_m : float64 [parts, 3]

    Returns
    -------
    groups : Groups
    part : int64 [groups]
        What holds each, ascending.
    """
    size = STACK * width
    order = np.argsort(part * (place.max() + 1) + place)
    held = np.bincount(part, minlength=len(middle_m))
    counts = -(-held // size)
    of_group = np.repeat(np.arange(len(middle_m)), counts)
    first = (np.arange(len(of_group)) - (np.cumsum(counts) - counts)[of_group]) * size
    last = held[of_group] - 1
    before = (np.cumsum(held) - held)[of_group]
    index = np.empty((len(of_group), size), np.int64)
    centre_m, offset_m = middle_m[of_group], np.empty((*index.shape, 3), np.float32)
    for start in range(0, len(index), _AT_ONCE):
        some = slice(start, start + _AT_ONCE)
        # The last point of a part fills up its last group.
        slots = np.minimum(first[some, None] + np.arange(size), last[some, None])
        index[some] = order[before[some, None] + slots]
        offset_m[some] = grid.at(index[some]) - centre_m[some, None]
    return Groups(grid, index, centre_m, offset_m, width), of_group


def _neighbours(grid: Grid, positions: NDArray[np.float64], width: int) -> NDArray[np.int64]:
    """Return every pixel's flat index, near ones after each other; edge pixels may come twice."""
    if grid.points_m is not None:
        return KDTree(positions, leafsize=STACK * width).indices
    rows, columns = BLOCKS[width]
    rows *= STACK
    index = np.arange(grid.size).reshape(grid.shape)
    index = np.pad(index, [(0, -grid.shape[0] % rows), (0, -grid.shape[1] % columns)], mode="edge")
    down, across = index.shape[0] // rows, index.shape[1] // columns
    return index.reshape(down, rows, across, columns).swapaxes(1, 2).ravel()


def _longest(vectors: NDArray[np.floating]) -> float:
    """Return the length of the longest of vectors [..., 3]."""
    return float(np.sqrt(np.einsum("...i,...i->...", vectors, vectors).max()))


def _radius_m(grid: Grid, rows: int, columns: int) -> float:
    """Return the largest distance of a pixel from the centre of rows x columns of them, metres."""
    down, across = (rows - 1) / 2 * grid.row_step_m, (columns - 1) / 2 * grid.column_step_m
    return float(max(np.linalg.norm(down + across), np.linalg.norm(down - across)))
