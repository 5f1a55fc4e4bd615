"""Pictures of what two receiver banks show: interferograms, and heights as shaded relief."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from clsas.engine.data import validate
from clsas.engine.data.grid import Grid
from clsas.engine.data.validate import ArgumentError
from clsas.interferometry.interferogram import Interferogram
from clsas.interferometry.result import Heights
from clsas.plot.canvas import (
    MOST_PIXELS,
    drawable,
    grid_extent,
    label_grid,
    new_figure,
    plain_ticks,
)
from clsas.plot.canvas import colour_map as checked_colour_map

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

_PANEL_IN = 5.0  # longer side of a panel
_LEAST_IN = 1.2  # shorter side of a panel, so that its labels fit
_LABELS_IN = 1.3, 0.9  # room for the labels and the colour bar of a panel, across and upward
_MASKED = (0.72, 0.72, 0.72)  # light grey, which none of the colour maps has
_LIGHT_DEG = 315.0, 45.0  # from the upper left, as on maps, and 45 degrees above the horizon
_SLOPE = 0.95  # share of the slopes that are drawn as gentler than 45 degrees
_DARKEST = 0.3  # brightness of slopes that face away from the light, relative to level ground
_WHITEST = 0.5  # share of white in the colours of slopes that face the light
_HIGHEST = 0.98  # share of the deviations within the colours


def interferogram(interferogram: Interferogram, *, title: str = "") -> Figure:
    """Draw the phase of an interferogram in cyclic colours, and its coherence beside it.

    Parameters
    ----------
    interferogram : Interferogram
        Phase (radians) and coherence of two images on a plane or height map.
    title : str
        Title of the figure.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError
        If an argument has the wrong type.
    """
    validate.instance("interferogram", interferogram, Interferogram)
    grid = interferogram.grid
    title = drawable("title", title)
    figure, (left, right) = _panels(grid, title)
    phase = _draw(
        left, grid, _thinned(interferogram.phase_rad), "twilight_shifted", (-np.pi, np.pi)
    )
    bar = figure.colorbar(phase, ax=left, label="Phase (rad)")
    bar.set_ticks([-np.pi, -np.pi / 2, 0, np.pi / 2, np.pi], labels=["-π", "-π/2", "0", "π/2", "π"])
    shown = _draw(right, grid, _thinned(interferogram.coherence), "gray", (0.0, 1.0))
    figure.colorbar(shown, ax=right, label="Coherence")
    left.set_title("Phase")
    right.set_title("Coherence")
    return figure


def heights(heights: Heights, *, colour_map: str | Colormap = "viridis", title: str = "") -> Figure:
    """Draw heights as coloured relief with shading, and their standard deviation beside it.

    The light comes from the upper left. Slopes are exaggerated so that 95 % of them seem gentler
    than 45 degrees. Pixels without a height are grey.

    Parameters
    ----------
    heights : Heights
        Heights and standard deviations (metres) on the grid of an image, and a mask, which is True
        where there is a height.
    colour_map : str or matplotlib.colors.Colormap
        Colours of the heights, as for `image`.
    title : str
        Title of the figure.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError, ValueError
        If an argument has the wrong type, or no pixel has a height.
    """
    validate.instance("heights", heights, Heights)
    grid, known = heights.image.grid, heights.mask
    if not known.any():
        raise ArgumentError("heights", "have at least one pixel that is not masked")
    height_m, sd_m = (np.where(known, each, 0.0) for each in (heights.height_m, heights.sd_m))
    title = drawable("title", title)
    chosen = checked_colour_map(colour_map)
    figure, (left, right) = _panels(grid, title)
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    colours = ScalarMappable(Normalize(height_m[known].min(), height_m[known].max()), chosen)
    across, upward = grid.sides
    every = [_every(count) for count in grid.shape]
    steps_m = every[0] * upward.step_m, every[1] * across.step_m
    relief = _relief(_thinned(height_m), _thinned(known), steps_m, chosen, colours.norm)
    _draw(left, grid, relief)
    figure.colorbar(colours, ax=left, label="Height (m)")
    share = 1 - float(known.mean())
    left.set_title(f"Height; {100 * share:.0f} % masked (grey)" if share else "Height")
    most_m = float(np.quantile(sd_m[known], _HIGHEST)) or 1.0
    deviation_mm = _thinned(np.ma.masked_array(1e3 * sd_m, ~known))
    shown = _draw(right, grid, deviation_mm, "magma", (0.0, 1e3 * most_m))
    right.set_facecolor(_MASKED)
    extend = "max" if sd_m[known].max() > most_m else "neither"
    figure.colorbar(shown, ax=right, label="Deviation (mm)", extend=extend)
    right.set_title("Standard deviation")
    return figure


def _panels(grid: Grid, title: str) -> tuple[Figure, NDArray]:
    """Return a figure and its two axes: beside each other, or above each other if they are wide."""
    across, upward = grid.sides
    high = abs(upward.step_m) * len(upward.places_m)
    wide = abs(across.step_m) * len(across.places_m)
    longest = max(high, wide)
    width_in = max(_PANEL_IN * wide / longest, _LEAST_IN) + _LABELS_IN[0]
    height_in = max(_PANEL_IN * high / longest, _LEAST_IN) + _LABELS_IN[1]
    stacked = width_in > 1.5 * height_in
    columns, rows = (1, 2) if stacked else (2, 1)
    figure = new_figure(columns * width_in, rows * height_in, layout="compressed")
    if title:
        figure.suptitle(title)
    return figure, figure.subplots(rows, columns)


def _draw(
    axes: Axes,
    grid: Grid,
    values: NDArray,
    chosen: str | None = None,
    limits: tuple[float, float] = (0.0, 1.0),
) -> AxesImage:
    """Draw thinned values or colours over metres or millimetres."""
    extent = grid_extent(grid)
    drawn = axes.imshow(
        values, cmap=chosen, vmin=limits[0], vmax=limits[1],
        origin="lower", extent=extent, interpolation="nearest",
    )  # fmt: skip
    axes.set(xlim=sorted(extent[:2]), ylim=sorted(extent[2:]))
    plain_ticks(axes)
    label_grid(axes, grid)
    return drawn


def _every(count: int) -> int:
    """Return how many pixels share a dot."""
    return max(-(-count // MOST_PIXELS), 1)


def _thinned(values: NDArray) -> NDArray:
    """Return some of the pixels of a large array: means would mix phases, and cross steps."""
    return values[:: _every(values.shape[0]), :: _every(values.shape[1])]


def _relief(
    height_m: NDArray, known: NDArray, steps_m: tuple[float, float], chosen: Any, norm: Any
) -> NDArray[np.float64]:
    """Return colours [rows, columns, 3] of heights with hillshade; grey where none is known.

    Slopes are those of the nearest known heights. `steps_m` are the distances between rows, upward
    on the picture, and between columns, to the right; they may be negative.
    """
    if not known.all():
        nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
        height_m = height_m[tuple(nearest)]
    # A single row or column has no slope across it.
    upward, across = (
        np.gradient(height_m, step_m, axis=axis) if height_m.shape[axis] > 1 else 0 * height_m
        for axis, step_m in enumerate(steps_m)
    )
    steepest = float(np.quantile(np.hypot(upward, across)[known], _SLOPE))
    if steepest > 0:
        upward, across = upward / steepest, across / steepest
    azimuth, elevation = np.radians(_LIGHT_DEG)
    light = np.array(
        [math.sin(azimuth) * math.cos(elevation), math.cos(azimuth) * math.cos(elevation),
         math.sin(elevation)]
    )  # fmt: skip
    facing = (light[2] - light[0] * across - light[1] * upward) / np.sqrt(1 + across**2 + upward**2)
    # Level ground keeps its colour.
    dark = _DARKEST + (1 - _DARKEST) * np.clip(facing / light[2], 0, 1)
    white = _WHITEST * np.clip((facing - light[2]) / (1 - light[2]), 0, 1)
    shaded: NDArray[np.float64] = chosen(norm(height_m))[..., :3] * dark[..., None]
    shaded += (1 - shaded) * white[..., None]
    shaded[~known] = _MASKED
    return shaded
