"""Pictures of the geometry of a survey: antennas, and the outline of the grid."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.engine.signal.echoes import Echoes
from clsas.plot.canvas import axis_label, length_unit, new_figure, plain_ticks

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def geometry(lines: RangeLines | Echoes, grid: Grid | None = None) -> Figure:
    """Draw the positions of transmitters and receivers, and the outline of a grid.

    The view is from above, over x and y. For a vertical grid along x or y it is from the side.

    Parameters
    ----------
    lines : RangeLines or Echoes
        Data with the positions `tx_m` and `rx_m`.
    grid : Grid, optional
        Grid of an image. If it has arbitrary points, all of them are drawn.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError
        If `lines` or `grid` has another type.

    Examples
    --------
    >>> import clsas
    >>> import numpy as np
    >>> tx_m = np.outer(np.arange(8), [0.02, 0, 0])
    >>> point = clsas.PointTargets([[0.1, 20.0, 0.0]], [1.0])
    >>> lines = clsas.simulate_lines(tx_m, tx_m, point, carrier_hz=100e3, bandwidth_hz=20e3)
    >>> figure = clsas.plot.geometry(lines, clsas.Grid.plane((0.0, 0.2, 21), (19.0, 21.0, 21)))
    >>> [line.get_label() for line in figure.axes[0].get_lines()]
    ['Receiver (8 positions)', 'Transmitter (8 positions)', 'Grid 21 × 21']
    """
    validate.instance("lines", lines, RangeLines, Echoes)
    if grid is not None:
        validate.instance("grid", grid, Grid)
    shown = _coordinates(grid)
    # Units are metres unless the whole geometry is small.
    ends_m = [lines.rx_m, lines.tx_m] + ([] if grid is None else [outline(grid)[0]])
    scale, unit = length_unit(max(float(np.abs(each[:, shown]).max()) for each in ends_m))
    figure = new_figure(7.0, 6.0)
    axes = figure.subplots()
    for name, position_m, marker in (
        ("Receiver", lines.rx_m, "."),
        ("Transmitter", lines.tx_m, "x"),
    ):
        places = np.unique(position_m[:, shown].round(6), axis=0)  # micrometres
        axes.plot(
            *(scale * places.T), marker, markersize=5, label=f"{name} ({len(places)} positions)"
        )
    if grid is not None:
        outline_m, style = outline(grid)
        axes.plot(
            *(scale * outline_m[:, shown].T),
            style,
            linewidth=1.5,
            markersize=2,
            label="Grid " + " × ".join(map(str, grid.shape)),
        )
    place = lines.georeference or (None if grid is None else grid.georeference)
    xlabel, ylabel = (axis_label("xyz"[index], unit, place=place) for index in shown)
    axes.set(xlabel=xlabel, ylabel=ylabel, aspect="equal")
    axes.set_adjustable("datalim")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=3, fontsize="small")
    plain_ticks(axes)
    return figure


def _coordinates(grid: Grid | None) -> list[int]:
    """Return the indices of the coordinates that the view shows across and upward."""
    if grid is not None and grid.points_m is None and min(grid.shape) > 1:
        names = "".join(sorted(side.name for side in grid.sides))
        if names in ("xz", "yz"):
            return ["xyz".index(name) for name in names]
    return [0, 1]


def outline(grid: Grid) -> tuple[NDArray, str]:
    """Return the corners of a grid, or all its points, [n, 3], and the style to draw them."""
    if grid.points_m is not None:
        return grid.points_m.reshape(-1, 3), "."
    down, right = (count - 1 for count in grid.shape)
    corners = np.array([[0, 0], [0, right], [down, right], [down, 0], [0, 0]])
    return grid.origin_m + corners @ [grid.row_step_m, grid.column_step_m], "-"
