"""Frames of the viewer: how a plane of pixels lies on the screen, and where on Earth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from clsas.engine.data.grid import Grid
from clsas.maps.map_grids import completed_steps

_LEVEL = 0.5  # cosine between the normal of a plane and the vertical above which it is a map
_DEGREE = 5  # of polynomials for latitudes and longitudes
_NODES = 12  # along either side of the plane, where they are fitted
_GOOD_DEG = 1e-7  # largest error of latitudes and longitudes: 1 cm


@dataclass(frozen=True, eq=False)
class Frame:
    """Directions on the screen of a plane or height map.

    Attributes
    ----------
    right, up : ndarray of float64, shape [3]
        Perpendicular unit vectors in the plane, one of which is along its rows or columns.
    """

    right: NDArray[np.float64]
    up: NDArray[np.float64]

    @classmethod
    def of(cls, grid: Grid) -> Frame:
        """Return the frame of a plane or height map.

        A plane that is closer to horizontal is seen from above, so that it is never mirrored, and
        is turned by quarters until x points to the right as far as possible. Another plane is
        turned until z points up, and its other coordinate increases to the right.
        """
        row_step_m, column_step_m = steps_of(grid)
        along = _unit(column_step_m)
        across = _unit(row_step_m - (row_step_m @ along) * along)
        normal = np.cross(along, across)
        directions = [along, across, -along, -across]
        if abs(normal[2]) >= _LEVEL:
            right = max(directions, key=lambda direction: float(direction[0].round(9)))
            return cls(right, np.cross(normal * np.sign(normal[2]), right))
        up = max(directions, key=lambda direction: float(direction[2].round(9)))
        right = next(d for d in directions if abs(d @ up) < _LEVEL)
        return cls(right * np.sign(right[np.argmax(np.abs(right).round(9))]), up)

    def describe(self, grid: Grid) -> dict[str, list[list[float]] | list[float]]:
        """Return how pixels lie in space and on the screen, as the page reads it, metres.

        Positions on the screen are ``origin + row_step * row + column_step * column``, in metres
        along `right` and `up`.
        """
        steps_m = steps_of(grid)
        vectors = {"origin": grid.vectors_m[0], "row_step": steps_m[0], "column_step": steps_m[1]}
        axes = np.stack([self.right, self.up])
        return {
            "axes": axes.tolist(),
            **{name: vector.tolist() for name, vector in vectors.items()},
            **{f"screen_{name}": (axes @ vector).tolist() for name, vector in vectors.items()},
        }


def steps_of(grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the row step and the column step of a plane or height map, metres.

    A single row or column whose step is zero, or parallel to the other one, is as wide as the
    pixels of the other axis. A single pixel without steps has sides of 1 m.
    """
    _, row_step_m, column_step_m = grid.vectors_m
    rows, columns = grid.shape
    if not np.cross(row_step_m, column_step_m).any():
        row_step_m = row_step_m * (rows > 1 or columns == 1)
        column_step_m = column_step_m * (columns > 1)
    given_m = row_step_m, column_step_m
    length_m = max(float(np.linalg.norm(step)) for step in given_m) or 1.0
    row_step_m, column_step_m = completed_steps((rows, columns), row_step_m, column_step_m)
    # What is still missing is beside a vertical step, or there are no steps.
    row_step_m = row_step_m if row_step_m.any() else np.array([0.0, 1.0, 0.0])
    column_step_m = column_step_m if column_step_m.any() else np.array([1.0, 0.0, 0.0])
    return (
        row_step_m if given_m[0].any() else length_m * _unit(row_step_m),
        column_step_m if given_m[1].any() else length_m * _unit(column_step_m),
    )


def geographic_of(grid: Grid) -> Callable[[NDArray[np.float64]], NDArray[np.float64]] | None:
    """Return the function from positions to latitude and longitude; None if nothing is known.

    Positions are float64 [..., 3], metres. The result has latitude and longitude in degrees, and
    possibly more, along its last axis.
    """
    return None if grid.georeference is None else grid.georeference.to_geographic


def fitted_degrees(
    grid: Grid, to_geographic: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> dict[str, list[list[float]]] | None:
    """Return Chebyshev series of latitude and longitude over rows and columns.

    The page evaluates the series where the cursor is, without a library for map projections. Rows
    and columns from the first to the last pixel become arguments from -1 to 1; for a single one,
    these are its edges.

    Returns
    -------
    dict or None
        Coefficients [row][column] of "latitude" and "longitude", degrees. None if the series err
        by more than 1e-7 degrees (1 cm): close to a pole, or in scenes of 100 km at high latitudes.
    """
    nodes = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    row, column = np.meshgrid(nodes, nodes, indexing="ij")
    origin_m, (row_step_m, column_step_m) = grid.vectors_m[0], steps_of(grid)
    rows, columns = (
        (n - 1) / 2 + max(n - 1, 1) / 2 * at
        for n, at in zip(grid.shape, (row, column), strict=True)
    )
    positions_m = origin_m + rows[..., None] * row_step_m + columns[..., None] * column_step_m
    degrees = np.asarray(to_geographic(positions_m))[..., :2].reshape(-1, 2)
    # Longitudes may jump from 180 to -180; the page takes them back into these limits.
    degrees[:, 1] = degrees[0, 1] + (degrees[:, 1] - degrees[0, 1] + 180) % 360 - 180
    series = chebyshev.chebvander2d(row.ravel(), column.ravel(), [_DEGREE, _DEGREE])
    found, *_ = np.linalg.lstsq(series, degrees, rcond=None)
    if np.abs(series @ found - degrees).max() > _GOOD_DEG:
        return None
    shape = _DEGREE + 1, _DEGREE + 1
    return {
        name: found[:, index].reshape(shape).tolist()
        for index, name in enumerate(("latitude", "longitude"))
    }


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return vector / np.linalg.norm(vector)
