"""North arrow and scale bar on pictures of images."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from clsas.engine.data.grid import Grid
from clsas.engine.data.reprs import quantity
from clsas.engine.data.validate import ArgumentError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BAR = 0.25  # largest length of a scale bar relative to the width of the axes: a plain choice
_ARROW = 0.1  # length of the arrow relative to the shorter side: a plain choice
_HORIZONTAL = 1e-6  # least part of a step that must be horizontal
_LIGHT: Any = {"color": "white", "fontweight": "bold", "fontsize": "small"}


def draw_north(axes: Axes, grid: Grid) -> None:
    """Draw an arrow to the north into the upper right corner of axes that show an image on a grid.

    North is true north at the origin of a local georeference, and the north of the map otherwise.

    Raises
    ------
    ValueError
        If the grid has no georeference, or is vertical.
    """
    from matplotlib.patheffects import withStroke

    if grid.georeference is None:
        raise ArgumentError("north_arrow", "be off for an image without a georeference")
    north = (
        grid.georeference.from_map([0.0, 1.0, 0.0])[:2]
        - grid.georeference.from_map([0.0, 0.0, 0.0])[:2]
    )
    right, up = (_direction(grid, side) for side in (0, 1))
    along = np.array([north @ right, north @ up])
    along /= np.hypot(*along)
    width, height = axes.get_window_extent().size
    size = _ARROW * min(width, height) / np.array([width, height])
    middle = 1 - 1.4 * size
    tip, tail = (tuple((middle + sign * along * size).tolist()) for sign in (1, -1))
    outline = [withStroke(linewidth=3, foreground="black")]
    drawn = axes.annotate(
        "N", tail, tip, xycoords="axes fraction",
        textcoords="axes fraction", ha="center", va="center", path_effects=outline,
        arrowprops={"arrowstyle": "<|-", "color": "white", "path_effects": outline}, **_LIGHT,
    )  # fmt: skip
    drawn.set_in_layout(False)


def draw_scale_bar(axes: Axes, metres_per_unit: float) -> None:
    """Draw a bar of a round length into the lower left corner of axes.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
    metres_per_unit : float
        Length of a unit of the axes, metres.
    """
    from matplotlib.patheffects import withStroke

    first, last = sorted(axes.get_xlim())
    bottom, top = sorted(axes.get_ylim())
    length_m = _round_length(_BAR * (last - first) * metres_per_unit)
    length = length_m / metres_per_unit
    left, low = first + 0.04 * (last - first), bottom + 0.05 * (top - bottom)
    outline = [withStroke(linewidth=4, foreground="black")]
    bar: Any = {
        "color": "white",
        "linewidth": 2.5,
        "solid_capstyle": "butt",
        "path_effects": outline,
    }
    axes.plot([left, left + length], [low, low], **bar)
    axes.annotate(
        quantity(length_m, "m"), (left + length / 2, low), (0, 4), textcoords="offset points",
        ha="center", va="bottom", path_effects=outline, **_LIGHT,
    )  # fmt: skip


def _direction(grid: Grid, side: int) -> np.ndarray:
    """Return the horizontal unit vector that a picture shows to the right (0) or up (1).

    Axes that show a coordinate ascend with it. Other axes show distances from the first pixel.
    """
    axis = grid.sides[side]
    step_m = grid.vectors_m[2 - side]
    if len(axis.name) == 1:
        step_m = np.eye(3)["xyz".index(axis.name)]
    length = math.hypot(*step_m[:2])
    if length <= _HORIZONTAL * np.linalg.norm(step_m):
        raise ArgumentError("north_arrow", "be off for a vertical image")
    return step_m[:2] / length


def _round_length(most: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten up to a length."""
    power = 10.0 ** math.floor(math.log10(most))
    return max(factor for factor in (1, 2, 5) if factor * power <= most) * power
