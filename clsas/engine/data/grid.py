"""Grids of pixels: a plane, a plane with heights, or arbitrary points."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.declared import Number, Other
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.validate import ArgumentError, ArgumentTypeError

SAMPLED_PIXELS = 16
"""Sample points along either side of a grid that represent it, unless stated otherwise."""
_ALL = slice(None)
_PARALLEL = 1e-12  # sine of the angle between parallel steps; float64 rounds to 1e-16


class Axis(NamedTuple):
    """One side of a plane: the name of its coordinate, and the pixels' positions along it.

    Attributes
    ----------
    name : str
        "x", "y" or "z" if the side is parallel to that coordinate axis, otherwise "along columns"
        or "along rows".
    places_m : ndarray of float64
        The coordinate of every column (or row), metres. If the side is parallel to no coordinate
        axis, it is the distance from the first column (or row).
    """

    name: str
    places_m: NDArray[np.float64]

    @property
    def step_m(self) -> float:
        """Distance between pixels, metres; negative if the coordinate decreases."""
        return float(self.places_m[-1] - self.places_m[0]) / max(len(self.places_m) - 1, 1)


@dataclass(frozen=True, eq=False)
class Grid:
    """Positions of the pixels of an image, metres (x along-track, y across-track, z up).

    Create grids with `Grid.plane`, `Grid.oriented` or `Grid.points`. On a plane,
    pixel [row, column] lies at

        origin_m + row row_step_m + column column_step_m (+ height_m[row, column] along z).

    All coordinates are float64, which resolves UTM-sized coordinates (1e7 m) to nanometres. Those
    beyond 1e9 m raise ValueError. Arrays that need no conversion are not copied, so do not write
    into them afterwards.

    Attributes
    ----------
    origin_m, row_step_m, column_step_m : ndarray of float64, shape [3], or None
        Position of pixel [0, 0] and the steps to the next row and column; None for points.
    shape : tuple of int
        Shape of the image: (rows, columns), or that of the points.
    height_m : ndarray of float64, shape [rows, columns], or None
        Height of every pixel above the plane, added to z.
    points_m : ndarray of float64, shape [*shape, 3], or None
        Arbitrary positions; None for a plane or height map.
    georeference : Georeference or None
        Where the coordinates lie on Earth; None if unknown. Images on the grid have it too.

    Examples
    --------
    A plane of 3 by 5 pixels, 0.5 m apart:

    >>> import clsas
    >>> grid = clsas.Grid.plane(x=(-1, 1, 5), y=(40, 41, 3))
    >>> grid
    Grid(3 x 5 pixels, x -1 to 1 m, y 40 to 41 m, z 0 m)
    >>> grid.positions_m()[1, 2]
    array([ 0. , 40.5,  0. ])
    """

    origin_m: NDArray[np.float64] | None
    row_step_m: NDArray[np.float64] | None
    column_step_m: NDArray[np.float64] | None
    shape: tuple[int, ...]
    height_m: NDArray[np.float64] | None = None
    points_m: NDArray[np.float64] | None = None
    georeference: Georeference | None = None

    def __post_init__(self) -> None:
        """Check every field and convert it."""

        def put(name: str, shape: tuple[int, ...]) -> None:
            value = validate.array(name, getattr(self, name), np.float64, shape)
            object.__setattr__(self, name, value)

        validate.instance("georeference", self.georeference, Georeference, type(None))
        counts = validate.entries("shape", self.shape, "whole numbers of pixels per axis")
        try:
            shape = tuple(validate.count("every entry of shape", n) for n in counts)
        except TypeError:
            raise ArgumentTypeError(
                "shape", "be whole numbers of pixels per axis", validate.shown(self.shape)
            ) from None
        validate.memory("shape", 8 * max(shape, default=0))
        object.__setattr__(self, "shape", shape)

        plane = ("origin_m", "row_step_m", "column_step_m")
        if self.points_m is not None:
            if any(getattr(self, name) is not None for name in (*plane, "height_m")):
                raise ArgumentError("points_m", "stand alone, without a plane or heights")
            put("points_m", (*shape, 3))
            self._check_bounds("points_m")
            return
        if len(shape) != 2:
            raise ArgumentError("shape", "be (rows, columns) for a plane", str(shape))
        for name in plane:
            put(name, (3,))
        _check_steps(*self.vectors_m[1:], shape)
        if self.height_m is not None:
            put("height_m", shape)
        self._check_bounds(", ".join(plane) + ", height_m" * (self.height_m is not None))

    def _check_bounds(self, names: str) -> None:
        """Raise ValueError if fields of some names put a pixel too far from the origin."""
        with np.errstate(over="ignore", invalid="ignore"):
            farthest_m = float(np.abs(self.bounds_m).max())
        if not farthest_m <= validate.FARTHEST_M:
            raise ArgumentError(
                names,
                f"put all pixels within {validate.FARTHEST_M:g} m of the origin along each axis",
                f"one at {farthest_m:g} m",
            )

    def __repr__(self) -> str:
        """Return the shape and the extents of the pixels in x, y and z."""
        place = self.georeference
        return reprs.summary(
            self,
            f"{reprs.by(self.shape)} pixels",
            reprs.extents(*self.bounds_m),
            None if place is None else str(place),
        )

    @classmethod
    def plane(
        cls,
        x: Annotated[tuple[float, float, int], AXIS],
        y: Annotated[tuple[float, float, int], AXIS],
        z: Annotated[float, Number("m", help="Height of the plane.")] = 0.0,
        *,
        georeference: Georeference | None = None,
    ) -> Self:
        """Return a horizontal plane whose columns run along x and whose rows run along y.

        Parameters
        ----------
        x, y : (start, stop, count)
            Centres of the first and the last pixel, metres, and the number of pixels, as for
            `numpy.linspace`. With one pixel, `start` and `stop` must be equal.
        z : float
            Height of the plane, metres.
        georeference : Georeference, optional
            Where the coordinates lie on Earth.

        Raises
        ------
        TypeError, ValueError
            If an axis is not (start, stop, count) with finite ends, has several pixels between
            equal ends, or one pixel and different ends.
        """
        x_start, x_step, columns = _axis("x", x)
        y_start, y_step, rows = _axis("y", y)
        origin = [x_start, y_start, _coordinate("z", z)]
        steps = [0, y_step, 0], [x_step, 0, 0]
        return cls.oriented(origin, *steps, (rows, columns), georeference=georeference)

    @classmethod
    def oriented(
        cls,
        origin_m: ArrayLike,
        row_step_m: ArrayLike,
        column_step_m: ArrayLike,
        shape: tuple[int, int],
        *,
        georeference: Georeference | None = None,
    ) -> Self:
        """Return a plane of any orientation.

        Parameters
        ----------
        origin_m : array_like, shape [3]
            Position of pixel [0, 0], metres.
        row_step_m, column_step_m : array_like, shape [3]
            Steps to the next row and to the next column, metres. They need not be perpendicular.
        shape : (rows, columns)
            Number of pixels.
        georeference : Georeference, optional
            Where the coordinates lie on Earth.

        Raises
        ------
        TypeError, ValueError
            If an argument has the wrong type or shape or is not finite, or if pixels would
            coincide because steps are zero or parallel.
        """
        return cls(
            origin_m,  # type: ignore[arg-type]
            row_step_m,  # type: ignore[arg-type]
            column_step_m,  # type: ignore[arg-type]
            shape,
            georeference=georeference,
        )

    @classmethod
    def points(cls, points_m: ArrayLike, *, georeference: Georeference | None = None) -> Self:
        """Return a grid of pixels at arbitrary positions.

        Parameters
        ----------
        points_m : array_like, shape [..., 3]
            Positions, metres. The image has the shape of the leading axes.
        georeference : Georeference, optional
            Where the coordinates lie on Earth.

        Raises
        ------
        TypeError, ValueError
            If the points are not finite real numbers, there are none, or the last axis does not
            have length 3.
        """
        given = validate.array("points_m", points_m, np.float64, None)
        shape = (*(None,) * max(given.ndim - 1, 1), 3)
        checked = validate.array("points_m", given, np.float64, shape)
        points = checked, georeference
        return cls(None, None, None, checked.shape[:-1], None, *points)

    def with_height(self, height_m: ArrayLike) -> Self:
        """Return this plane raised by heights.

        Parameters
        ----------
        height_m : array_like, shape [rows, columns]
            Heights above the plane, metres along z.

        Raises
        ------
        ValueError
            If the grid is not a plane, or the heights do not have its shape or are not finite.
        """
        if not self.is_planar:
            got = "points" if self.points_m is not None else "a grid with heights"
            raise ArgumentError("height_m", "be added to a plane without heights", got)
        height_m = validate.array("height_m", height_m, np.float64, self.shape)
        return replace(self, height_m=height_m)

    @property
    def bounds_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest x, y and z of a box that contains all pixels, metres, [3] each."""
        if self.points_m is not None:
            places_m = self.points_m.reshape(-1, 3)
            return places_m.min(axis=0), places_m.max(axis=0)
        origin_m, *steps_m = self.vectors_m
        down_m, right_m = (step * (n - 1) for step, n in zip(steps_m, self.shape, strict=True))
        corners_m = origin_m + np.stack([0 * down_m, down_m, right_m, down_m + right_m])
        low_m, high_m = corners_m.min(axis=0), corners_m.max(axis=0)
        if self.height_m is not None:
            low_m[2] += self.height_m.min()
            high_m[2] += self.height_m.max()
        return low_m, high_m

    @property
    def is_planar(self) -> bool:
        """True if the pixels lie on a plane, in equal steps."""
        return self.points_m is None and self.height_m is None

    @property
    def size(self) -> int:
        """Number of pixels."""
        return math.prod(self.shape)

    @property
    def vectors_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Origin, row step and column step of a plane or height map, metres.

        Raises
        ------
        ValueError
            If the grid consists of arbitrary points.
        """
        if self.origin_m is None or self.row_step_m is None or self.column_step_m is None:
            raise ArgumentError("grid", "be a plane or height map to have steps", "points")
        return self.origin_m, self.row_step_m, self.column_step_m

    @property
    def has_axes(self) -> bool:
        """True if columns run along x and rows along y; the grid then has `axes_m`."""
        if self.points_m is not None:
            return False
        _, row_step_m, column_step_m = self.vectors_m
        return not (np.any(column_step_m[1:]) or np.any(row_step_m[[0, 2]]))

    @property
    def axes_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The x of every column and the y of every row, metres.

        Raises
        ------
        ValueError
            Unless columns run along x and rows along y (`has_axes`).
        """
        if not self.has_axes:
            raise ArgumentError("grid", "have columns along x and rows along y to have `axes_m`")
        rows, columns = self.shape
        origin_m, row_step_m, column_step_m = self.vectors_m
        return (
            origin_m[0] + np.arange(columns) * column_step_m[0],
            origin_m[1] + np.arange(rows) * row_step_m[1],
        )

    @property
    def sides(self) -> tuple[Axis, Axis]:
        """The axes of a plane or height map, along its columns and along its rows.

        Raises
        ------
        ValueError
            If the grid consists of arbitrary points.
        """
        if self.points_m is not None:
            raise ArgumentError("grid", "be a plane or height map to have axes", "points")
        rows, columns = self.shape
        _, row_step_m, column_step_m = self.vectors_m
        across = self._side("along columns", column_step_m, columns, free="xyz")
        taken = across.name if len(across.name) == 1 else ""
        free = [name for name in "yxz" if name != taken]
        return across, self._side("along rows", row_step_m, rows, free="".join(free))

    def _side(self, name: str, step_m: NDArray[np.float64], count: int, free: str) -> Axis:
        """Return the axis of one side. If its step is zero, take the first `free` coordinate."""
        along = np.flatnonzero(np.abs(step_m) > _PARALLEL * np.abs(step_m).max())
        if len(along) > 1:
            return Axis(name, np.arange(count) * np.float64(np.linalg.norm(step_m)))
        index = along[0] if len(along) else "xyz".index(free[0])
        first_m = self.vectors_m[0][index]
        return Axis("xyz"[index], first_m + np.arange(count) * step_m[index])

    def positions_m(self, rows: slice = _ALL, columns: slice = _ALL) -> NDArray[np.float64]:
        """Return the positions of the pixels, float64 [..., 3], metres.

        Parameters
        ----------
        rows, columns : slice
            Rows and columns to return. For arbitrary points these are the first two axes.

        Raises
        ------
        TypeError, ValueError
            If `rows` or `columns` is not a slice of whole numbers.
        """
        validate.selection("rows", rows)
        validate.selection("columns", columns)
        if self.points_m is not None:
            return self.points_m[self._index(rows, columns)].copy()
        origin_m, row_step_m, column_step_m = self.vectors_m
        row = np.arange(self.shape[0])[rows, None, None]
        column = np.arange(self.shape[1])[None, columns, None]
        positions = origin_m + row * row_step_m + column * column_step_m
        if self.height_m is not None:
            positions[..., 2] += self.height_m[rows, columns]
        return positions

    def at(self, index: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the positions of pixels given by row-major indices, float64 [..., 3], metres.

        Raises
        ------
        TypeError, ValueError
            If the indices are not whole numbers from 0 to `size` - 1.
        """
        index = validate.indices("index", index, self.size)
        if self.points_m is not None:
            return self.points_m.reshape(-1, 3)[index]
        origin_m, row_step_m, column_step_m = self.vectors_m
        row, column = np.divmod(index[..., None], self.shape[1])
        positions = origin_m + row * row_step_m + column * column_step_m
        if self.height_m is not None:
            positions[..., 2] += self.height_m.reshape(-1)[index]
        return positions

    def spread(self, most: int = SAMPLED_PIXELS) -> NDArray[np.float64]:
        """Return the positions of sample points all over the grid, edges included, [n, 3].

        There are up to `most` sample points along either side.

        Raises
        ------
        TypeError, ValueError
            If `most` is not a whole number of at least 1.
        """
        return self.at(spread_indices(self, most))

    def window(self, rows: slice = _ALL, columns: slice = _ALL) -> Self:
        """Return the grid of some rows and columns. For points these are the first two axes.

        The pixels lie at `positions_m(rows, columns)` of this grid. The first one does so bit for
        bit, the others of a plane to the last bit of a float64 coordinate. The pixels of an image
        on the window are `image.pixels[rows, columns]`.

        Raises
        ------
        TypeError
            If `rows` or `columns` is not a slice of whole numbers.
        ValueError
            If nothing is selected.
        """
        validate.selection("rows", rows)
        validate.selection("columns", columns)
        if self.points_m is not None:
            some_m = self.points_m[self._index(rows, columns)]
            return self.points(some_m, georeference=self.georeference)
        row, column = (range(n)[s] for n, s in zip(self.shape, (rows, columns), strict=True))
        if not row or not column:
            name, empty = ("columns", columns) if row else ("rows", rows)
            raise ArgumentError(name, "select a pixel", str(empty))
        if (row, column) == tuple(map(range, self.shape)):
            return self
        origin_m, row_step_m, column_step_m = self.vectors_m
        return type(self)(
            origin_m + row[0] * row_step_m + column[0] * column_step_m,
            row_step_m * row.step,
            column_step_m * column.step,
            (len(row), len(column)),
            height_m=None if self.height_m is None else self.height_m[rows, columns],
            georeference=self.georeference,
        )

    def _index(self, rows: slice, columns: slice) -> tuple[slice, ...]:
        """Return the index of rows and columns of points, which may have only one axis."""
        if len(self.shape) > 1:
            return rows, columns
        if columns != _ALL:
            raise ArgumentError("columns", f"be left out for points of shape {self.shape}")
        return (rows,)


def spread_indices(grid: Grid, most: int) -> NDArray[np.int64]:
    """Return the row-major indices of the sample points of `Grid.spread`, [n]."""
    most = validate.count("most", most)
    indices = [
        np.unique(np.linspace(0, n - 1, min(most, n)).round().astype(int)) for n in grid.shape
    ]
    return np.ravel_multi_index(np.ix_(*indices), grid.shape).ravel()


def _coordinate(name: str, value: float) -> float:
    """Return a coordinate in metres; raises TypeError or ValueError."""
    return validate.number(name, value, "m", least=-validate.FARTHEST_M, most=validate.FARTHEST_M)


def _checked_axis(name: str, axis: tuple[float, float, int]) -> tuple[float, float, int]:
    """Return an axis if it is (start, stop, count)."""
    _axis(name, axis)
    return axis


AXIS = Other(
    _checked_axis, unit="m", help="First and last pixel centre, and number of pixels, of this axis."
)
"""Declares an axis of a horizontal plane."""


def _axis(name: str, axis: tuple[float, float, int]) -> tuple[float, float, int]:
    """Return start, step and count of a (start, stop, count) axis."""
    try:
        start, stop, count = axis
    except (TypeError, ValueError):
        raise ArgumentTypeError(name, "be (start m, stop m, count)", validate.shown(axis)) from None
    start, stop = _coordinate(f"{name} start", start), _coordinate(f"{name} stop", stop)
    count = validate.count(f"{name} count", count)
    validate.memory(f"{name} count", 8 * count)
    if count == 1:
        if start != stop:
            allowed = "start and stop at one position for 1 pixel"
            raise ArgumentError(name, allowed, f"{start} m to {stop} m")
        return start, 0.0, count
    step = (stop - start) / (count - 1)
    if step == 0:
        allowed = "start and stop at different positions"
        raise ArgumentError(name, allowed, f"{count} pixels from {start} m to {stop} m")
    return start, step, count


def _check_steps(
    row_step_m: NDArray[np.float64], column_step_m: NDArray[np.float64], shape: tuple[int, ...]
) -> None:
    """Raise ValueError if the steps put two pixels of a plane at the same position."""
    steps = {"row_step_m": row_step_m, "column_step_m": column_step_m}
    for (name, step), count in zip(steps.items(), shape, strict=True):
        if count > 1 and not step.any():
            raise ArgumentError(name, "not be zero m", f"{step} for {count} pixels")
    if min(shape) == 1:
        return
    # Compare directions, because steps may have any length.
    directions = (step / np.abs(step).max() for step in steps.values())
    sine = np.linalg.norm(np.cross(*(d / np.linalg.norm(d) for d in directions)))
    if sine < _PARALLEL:
        allowed = f"not be parallel to `column_step_m`, {column_step_m} m"
        raise ArgumentError("row_step_m", allowed, f"{row_step_m} m")


def bounding_box(grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the centre of a box around a grid, and half its edges as vectors [n, 3], metres."""
    if grid.points_m is not None:
        low, high = grid.bounds_m
        return (low + high) / 2, np.diag((high - low) / 2)
    rows, columns = grid.shape
    origin_m, row_step_m, column_step_m = grid.vectors_m
    half_m = np.array([row_step_m * (rows - 1), column_step_m * (columns - 1)]) / 2
    centre_m = origin_m + half_m.sum(axis=0)
    if grid.height_m is None:
        return centre_m, half_m
    low, high = grid.height_m.min(), grid.height_m.max()
    up = np.array([0.0, 0.0, 1.0])
    return centre_m + up * (low + high) / 2, np.concatenate([half_m, [up * (high - low) / 2]])


def without_heights(grid: Grid) -> Grid:
    """Return the plane of a height map, or the grid itself if it has no heights."""
    return replace(grid, height_m=None)


def check_one_grid(names: str, grid: Grid, other: Grid) -> Grid:
    """Return `one_placed` of two grids.

    Raise ValueError unless both have the same pixel positions, up to rounding.
    """
    if grid is other:
        return grid
    allowed = "lie on one grid"
    if grid.shape != other.shape:
        raise ArgumentError(names, allowed, f"shapes {grid.shape} and {other.shape}")
    places = grid.georeference, other.georeference
    if None not in places and places[0] != places[1]:
        got = "georeferences {} and {}".format(*places)
        raise ArgumentError(names, allowed, got, "form both with the same one")
    part = [_ALL] * 2
    if grid.is_planar and other.is_planar:
        part = [slice(None, None, max(count - 1, 1)) for count in grid.shape]  # the corners
    positions_m = other.positions_m(*part)
    apart_m = np.abs(grid.positions_m(*part) - positions_m).max()
    if apart_m > 1e-9 + 1e-14 * np.abs(positions_m).max():
        got = f"pixel positions that differ by up to {apart_m:g} m"
        raise ArgumentError(names, allowed, got)
    return one_placed(grid, other)


def one_placed(grid: Grid, other: Grid) -> Grid:
    """Return the first of two grids, or the other one if only that has a georeference."""
    return other if grid.georeference is None else grid
