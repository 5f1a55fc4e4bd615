"""Pictures: images, point responses, geometry and range lines.

Every function returns a `matplotlib.figure.Figure` that belongs to no window and no global state;
`save_png` writes it, and notebooks show it.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsas.core import validate
from clsas.core.atomic import replacing
from clsas.core.extras import install_command
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.lines import RangeLines
from clsas.products.quality import Cut, PointResponse
from clsas.signal.echoes import Echoes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from clsas.products.tradeoff import Row, Tradeoff

_LONG_NAMES = {"x": "x (along track)", "y": "y (across track)", "z": "z (up)"}
_MOST_PIXELS = 1500  # along an axis: more than a picture shows


def image_db(
    image: Image,
    *,
    dynamic_range_db: float = 60.0,
    reference: float | None = None,
    title: str = "",
) -> Figure:
    """Draw the amplitude of an image in dB over metres.

    Parameters
    ----------
    image : Image
        On a plane of any direction or a height map. The axes are the coordinates that columns and
        rows run along (x and y, or x and z of a plane in depth), else distances along them; in
        millimetres where all of them are less than 0.5 m, else in metres. Columns and rows are
        drawn at right angles also where they are not.
    dynamic_range_db : float
        What is so far below the reference, or more, is black.
    reference : float, optional
        Amplitude of 0 dB (white); the image's greatest unless given.
    title : str
        Put above.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError, ValueError
        If an argument is of a wrong kind or not positive, or the image is one of arbitrary points.
    """
    validate.instance("image", image, Image)
    if image.grid.points_m is not None:
        raise ValueError("image must be on a plane or height map to be drawn, got points")
    sides = image.grid.sides
    scale, unit = _scale(max(float(np.abs(side.places_m).max()) for side in sides))
    across, upward = (scale * side.places_m for side in sides)
    figure, axes = _draw_levels(
        np.abs(image.pixels),
        (*_edges(across, upward), *_edges(upward, across)),
        dynamic_range_db,
        reference,
    )
    axes.set(xlabel=f"{sides[0].name} ({unit})", ylabel=f"{sides[1].name} ({unit})", title=title)
    axes.set_aspect("equal" if min(image.grid.shape) > 1 else "auto")
    return figure


def cuts(response: PointResponse, *, floor_db: float = -60.0, resolutions: float = 12.0) -> Figure:
    """Draw the cuts through a point along columns and rows, with the measured figures.

    Parameters
    ----------
    response : PointResponse
        From `clsas.products.quality.measure_point`.
    floor_db : float
        Lower end of the level axis, dB.
    resolutions : float
        How many resolutions of the point the distance axis shows on each side.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError, ValueError
        If an argument is of a wrong kind, `floor_db` not negative or `resolutions` not positive.
    """
    validate.instance("response", response, PointResponse)
    validate.number("floor_db", floor_db, "dB", below=0.0)
    validate.positive("resolutions", resolutions)
    figure = _figure(7.0, 7.0)
    axes_of_both = figure.subplots(2)
    for axes, cut in zip(axes_of_both, (response.azimuth, response.range), strict=True):
        scale, unit = _scale(cut.resolution_m * resolutions)
        axes.plot(scale * cut.offset_m, cut.level_db, linewidth=1.0, label=_figures_of(cut))
        reach = scale * resolutions * cut.resolution_m
        axes.set(
            xlim=(max(-reach, scale * cut.offset_m[0]), min(reach, scale * cut.offset_m[-1])),
            ylim=(floor_db, 3),
            xlabel=f"{_LONG_NAMES.get(cut.axis, cut.axis)} from the peak ({unit})",
            ylabel="level (dB)",
        )
        axes.grid(alpha=0.3)
        axes.legend(loc="upper right", fontsize="small", handlelength=0)
    axes_of_both[0].set_title(
        f"point at x = {response.x_m:.4f} m, y = {response.y_m:.4f} m, z = {response.z_m:.4f} m"
    )
    return figure


def geometry(lines: RangeLines | Echoes, grid: Grid | None = None) -> Figure:
    """Draw where transmitters and receivers were, and the grid's outline.

    A view from above, x and y; of a grid in depth along x or y, a view from its side.

    Parameters
    ----------
    lines : RangeLines or Echoes
        Whose `tx_m` and `rx_m` are drawn.
    grid : Grid, optional
        What is imaged: its outline, or every point.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError
        If `lines` or `grid` is of another type.
    """
    validate.instance("lines", lines, RangeLines, Echoes)
    if grid is not None:
        validate.instance("grid", grid, Grid)
    shown = _coordinates(grid)
    # Metres, but for what is small altogether.
    ends_m = [lines.rx_m, lines.tx_m] + ([] if grid is None else [_outline(grid)[0]])
    scale, unit = _scale(max(float(np.abs(each[:, shown]).max()) for each in ends_m))
    figure = _figure(7.0, 6.0)
    axes = figure.subplots()
    for name, position_m, marker in (
        ("receiver", lines.rx_m, "."),
        ("transmitter", lines.tx_m, "x"),
    ):
        places = np.unique(position_m[:, shown].round(6), axis=0)  # micrometres
        axes.plot(*(scale * places.T), marker, markersize=5, label=f"{name} ({len(places)} places)")
    if grid is not None:
        outline_m, style = _outline(grid)
        axes.plot(
            *(scale * outline_m[:, shown].T),
            style,
            linewidth=1.5,
            markersize=2,
            label="grid " + " × ".join(map(str, grid.shape)),
        )
    across, upward = ("xyz"[coordinate] for coordinate in shown)
    axes.set(xlabel=f"{across} ({unit})", ylabel=f"{upward} ({unit})", aspect="equal")
    axes.set_adjustable("datalim")
    axes.grid(alpha=0.3)
    axes.legend(loc="best", fontsize="small")
    _plain_ticks(axes)
    return figure


def range_lines(lines: RangeLines, *, dynamic_range_db: float = 60.0, title: str = "") -> Figure:
    """Draw the amplitude of range lines in dB: channels across, range upward.

    Parameters
    ----------
    lines : RangeLines
        What to draw. Lines that start elsewhere than others are shown where they lie.
    dynamic_range_db : float
        What is so far below the greatest sample, or more, is black.
    title : str
        Put above.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError, ValueError
        If an argument is of a wrong kind, or the dynamic range is not positive.
    """
    validate.instance("lines", lines, RangeLines)
    amplitude, first_m, last_m = _aligned(lines)
    extent = (-0.5, lines.channels - 0.5, first_m, last_m)
    figure, axes = _draw_levels(amplitude, extent, dynamic_range_db, None)
    axes.set(xlabel="channel", ylabel="range (m)", title=title, aspect="auto")
    return figure


def tradeoff(measured: Tradeoff, *, title: str = "") -> Figure:
    """Draw the time of every image over its error, and what was predicted of it.

    Parameters
    ----------
    measured : Tradeoff
        From `clsas.tradeoff`.
    title : str
        Put above, before the sizes and the device.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError
        If `measured` is of another type.
    """
    if not hasattr(measured, "front"):
        raise TypeError(f"measured must be of type Tradeoff, got {validate.shown(measured)}")
    figure = _figure(7.0, 5.0)
    from matplotlib import ticker

    axes = figure.subplots()
    front = [(row.error_db, row.seconds) for row in measured.front]
    axes.plot(*zip(*front, strict=True), color="0.7", linewidth=1.5, zorder=1, label="Pareto front")
    for method, color, marker, label in (
        ("study", "0.75", ".", "the same with other taps and stages"),
        ("tolerance", "tab:blue", "o", "to a tolerance"),
        ("stages", "tab:orange", "s", "thesis's method: stages of QR x QI"),
        ("exact", "black", "D", "exact"),
    ):
        rows = [row for row in measured.rows if row.method == method]
        for row in rows:
            errors_db = row.error_db, row.predicted_error_db
            seconds = row.seconds, row.predicted_seconds
            axes.plot(errors_db, seconds, ":", color=color, linewidth=0.8, alpha=0.5)
            axes.plot(errors_db[1:], seconds[1:], marker, color=color, fillstyle="none")
            axes.plot(errors_db[:1], seconds[:1], marker, color=color, label=label)
            label = ""  # one entry in the legend
        if method != "study":
            _label_beside(axes, rows, color)
    axes.plot([], [], "o", color="0.5", fillstyle="none", label="predicted (hollow)")
    axes.set(
        yscale="log",
        xlabel="relative rms error against the exact image (dB)",
        ylabel="time of the image (s)",
    )
    axes.yaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(ticker.StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(ticker.NullFormatter())
    axes.margins(x=0.08)
    axes.invert_xaxis()  # the better the further right
    sizes = f"{measured.channels} lines, {' x '.join(map(str, measured.pixels))} pixels"
    axes.set_title(
        ", ".join(filter(None, (title, sizes))) + f"\n{measured.device}", fontsize="small"
    )
    axes.grid(alpha=0.3)
    axes.legend(loc="best", fontsize="small")
    return figure


def save_png(figure: Figure, path: str | os.PathLike, *, dpi: float = 150.0) -> None:
    """Write a figure as PNG, replacing a file of that name at once or not at all.

    Other formats are the figure's own: `figure.savefig("image.pdf")`.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError, ValueError
        If `figure` is not a Figure, `path` ends in another suffix than .png, or `dpi` (pixels per
        inch) is not a positive number.
    OSError
        If the folder does not exist or the file cannot be written.
    """
    validate.instance("figure", figure, _figure_class())
    validate.positive("dpi", dpi, "pixels per inch")
    validate.suffix("path", validate.path("path", path), ".png")
    with replacing(path) as temporary:
        # What the layout leaves outside, as labels beside square axes, is drawn too.
        figure.savefig(temporary, format="png", dpi=dpi, bbox_inches="tight")


def _label_beside(axes: Axes, rows: list[Row], color: str) -> None:
    """Label points: to their lower right, those of stages, which lie close, in a column."""
    column_db, lowest_s = min((row.error_db for row in rows), default=0.0) - 5, 0.0
    for row in sorted(rows, key=lambda row: row.seconds):
        style = {"fontsize": "x-small", "color": color}
        place = row.error_db, row.seconds
        if row.method != "stages":
            axes.annotate(row.label, place, (6, -9), textcoords="offset points", **style)
            continue
        lowest_s = max(row.seconds, 1.1 * lowest_s)
        line = {"arrowstyle": "-", "color": color, "linewidth": 0.5, "alpha": 0.6}
        axes.annotate(
            row.label, place, (column_db, lowest_s), va="center", arrowprops=line, **style
        )


def _figure_class() -> type[Figure]:
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ImportError(f"pictures need matplotlib: {install_command('plot')}") from None
    return Figure


def _figure(width_in: float, height_in: float) -> Figure:
    return _figure_class()(figsize=(width_in, height_in), layout="constrained")


def _draw_levels(
    amplitude: NDArray,
    extent: tuple[float, float, float, float],
    dynamic_range_db: float,
    reference: float | None,
) -> tuple[Figure, Axes]:
    """Draw amplitudes [upward, across] in dB over `extent` (left, right, bottom, top)."""
    validate.positive("dynamic_range_db", dynamic_range_db, "dB")
    label = "amplitude over the greatest (dB)"
    if reference is not None:
        label = f"amplitude over {validate.positive('reference', reference):g} (dB)"
    figure = _figure(7.0, 6.0)
    axes = figure.subplots()
    # The greatest of the pixels that share a dot: a mean would hide a point among many.
    for axis in (0, 1):
        count = amplitude.shape[axis]
        first = np.linspace(0, count, min(count, _MOST_PIXELS), endpoint=False).astype(int)
        amplitude = np.maximum.reduceat(amplitude, first, axis)
    reference = reference or float(amplitude.max()) or 1.0
    floor = 10 ** (-dynamic_range_db / 20)
    drawn = axes.imshow(
        20 * np.log10(np.maximum(amplitude / reference, floor)),
        cmap="inferno",
        vmin=-dynamic_range_db,
        vmax=0,
        origin="lower",
        extent=extent,
    )
    axes.set(xlim=sorted(extent[:2]), ylim=sorted(extent[2:]))
    _plain_ticks(axes)
    figure.colorbar(drawn, ax=axes, label=label, shrink=0.8)
    return figure, axes


def _plain_ticks(axes: Axes) -> None:
    """Write coordinates in full, however far the origin is, and few enough to fit."""
    axes.ticklabel_format(style="plain", useOffset=False)
    axes.locator_params(nbins=6)


def _edges(axis: NDArray, other: NDArray) -> tuple[float, float]:
    """Return the outer edges of the pixels of an axis; a single one is as wide as the other's."""
    step = next((a[1] - a[0] for a in (axis, other) if len(a) > 1), 1.0)
    return axis[0] - step / 2, axis[-1] + step / 2


def _coordinates(grid: Grid | None) -> list[int]:
    """Return which two coordinates a view of the geometry shows, across and upward."""
    if grid is not None and grid.points_m is None and min(grid.shape) > 1:
        names = "".join(sorted(side.name for side in grid.sides))
        if names in ("xz", "yz"):
            return ["xyz".index(name) for name in names]
    return [0, 1]


def _outline(grid: Grid) -> tuple[NDArray, str]:
    """Return the places to draw for a grid, [n, 3], and how."""
    if grid.points_m is not None:
        return grid.points_m.reshape(-1, 3), "."
    down, right = (count - 1 for count in grid.shape)
    corners = np.array([[0, 0], [0, right], [down, right], [down, 0], [0, 0]])
    return grid.origin_m + corners @ [grid.row_step_m, grid.column_step_m], "-"


def _aligned(lines: RangeLines) -> tuple[NDArray, float, float]:
    """Return amplitudes [range, channel] on one range axis, and that axis's outer edges."""
    first_m, step_m = lines.first_range_m.min(), lines.range_step_m
    start = np.rint((lines.first_range_m - first_m) / step_m).astype(int)
    amplitude = np.zeros((start.max() + lines.length, lines.channels), np.float32)
    for channel, (at, samples) in enumerate(zip(start, lines.samples, strict=True)):
        amplitude[at : at + lines.length, channel] = np.abs(samples)
    return amplitude, first_m - step_m / 2, first_m + (len(amplitude) - 0.5) * step_m


def _scale(length_m: float) -> tuple[float, str]:
    return (1e3, "mm") if length_m < 0.5 else (1.0, "m")


def _figures_of(cut: Cut) -> str:
    """Return what was measured on a cut, one figure a line."""
    scale, unit = _scale(cut.resolution_m)
    return (
        f"resolution {scale * cut.resolution_m:.4g} {unit} (−3 dB)\n"
        "PSLR nearest {:.1f}, {:.1f} dB\n".format(*cut.pslr_nearest_db)
        + "PSLR highest {:.1f}, {:.1f} dB\n".format(*cut.pslr_db)
        + "ISLR {:.1f} dB ({} + {} lobes)".format(cut.islr_db, *cut.lobes)
    )
