"""Parts of images around a position, for pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np

from clsas.engine.data.declared import Number, check_declared
from clsas.engine.data.grid import Grid
from clsas.engine.data.validate import ArgumentError
from clsas.measures.quality import on_axes

_AROUND = 32  # pixels on either side by default, along the coarser axis
_ROUNDING = 1e-6  # of a step, so that a pixel at the very end is drawn


def window_around(
    grid: Grid,
    near: Sequence[float],
    extent_m: Annotated[
        float | None,
        Number(
            "m",
            above=0.0,
            help="The distance on either side that is drawn.",
            default="32 pixels",
        ),
    ] = None,
) -> tuple[slice, slice]:
    """Return the rows and columns of a grid within a distance of a position.

    Parameters
    ----------
    grid : Grid
        A plane or height map.
    near : (float, float) or (float, float, float)
        Coordinates on the axes of the grid, along columns and rows, or a position x, y, z; metres.
    extent_m : float, optional
        Distance on either side of it, metres; 32 pixels by default.

    Raises
    ------
    TypeError, ValueError
        If `near` lies outside the grid or is not two or three numbers, or `extent_m` is not
        positive.
    """
    axes = grid.sides
    place_m = on_axes(grid, axes, near)
    if extent_m is None:
        extent_m = _AROUND * max(abs(axis.step_m) for axis in axes) or 1.0
    check_declared(window_around, {"extent_m": extent_m})
    parts = []
    for axis, at_m in zip(axes, place_m, strict=True):
        distance_m = np.abs(axis.places_m - at_m)
        nearest = int(distance_m.argmin())
        ends_m = sorted((axis.places_m[0], axis.places_m[-1]))
        step_m = abs(axis.step_m)
        if not ends_m[0] - step_m / 2 <= at_m <= ends_m[1] + step_m / 2:
            allowed = f"be inside the image, {axis.name} from {ends_m[0]:g} to {ends_m[1]:g} m"
            raise ArgumentError("near", allowed, f"{at_m:g} m")
        inside = np.flatnonzero(distance_m <= extent_m + _ROUNDING * step_m)
        first, last = (inside[0], inside[-1]) if len(inside) else (nearest, nearest)
        parts.append(slice(int(first), int(last) + 1))
    columns, rows = parts
    return rows, columns
