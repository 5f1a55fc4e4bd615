"""Pictures of curves: cuts through a point response, and time over error."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from clsas.engine.data import validate
from clsas.measures.cuts import Cut
from clsas.measures.quality import PointResponse
from clsas.measures.tradeoff_result import Row, Tradeoff
from clsas.plot.canvas import axis_label, drawable, length_unit, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Annotation

_DISTANCES = (10, 18, 28, 40, 54, 70, 88, 108)  # points from marks to labels, tried in turn
_ANGLES_DEG = (-45, 45, -90, 90, -20, 20, -135, 135, 180)


def cuts(response: PointResponse, *, floor_db: float = -60.0, resolutions: float = 12.0) -> Figure:
    """Draw the cuts through a point along columns and rows, with resolutions and side lobes.

    Parameters
    ----------
    response : PointResponse
        Response that `clsas.measure_point` returned.
    floor_db : float
        Lower end of the axis of levels, in dB.
    resolutions : float
        Largest distance from the peak that is shown, in resolutions of the point.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError, ValueError
        If an argument has the wrong type, `floor_db` is not negative, or `resolutions` is not
        positive.

    Examples
    --------
    >>> import clsas
    >>> import numpy as np
    >>> grid = clsas.Grid.plane(x=(0.0, 2.0, 201), y=(40.0, 41.5, 151))
    >>> x, y = grid.axes_m
    >>> pixels = np.outer(np.sinc((y - 40.6) / 0.04), np.sinc((x - 0.8) / 0.02)) + 0j
    >>> figure = clsas.plot.cuts(clsas.measure_point(clsas.Image(pixels, grid), (0.8, 40.6)))
    >>> [axes.get_xlabel() for axes in figure.axes]
    ['Along-track from the peak (mm)', 'Across-track from the peak (mm)']
    """
    validate.instance("response", response, PointResponse)
    floor_db = validate.number("floor_db", floor_db, "dB", below=0.0)
    resolutions = validate.positive("resolutions", resolutions)
    figure = new_figure(7.0, 7.0)
    axes_of_both = figure.subplots(2)
    for axes, cut in zip(axes_of_both, (response.azimuth, response.range), strict=True):
        scale, unit = length_unit(cut.resolution_m * resolutions)
        axes.plot(scale * cut.offset_m, cut.level_db, linewidth=1.0, label=_figures_of(cut))
        reach = scale * resolutions * cut.resolution_m
        axes.set(
            xlim=(max(-reach, scale * cut.offset_m[0]), min(reach, scale * cut.offset_m[-1])),
            ylim=(floor_db, 3),
            xlabel=axis_label(cut.axis, unit, "from the peak", response.georeference),
            ylabel="Amplitude (dB re peak)",
        )
        axes.grid(alpha=0.3)
        axes.legend(loc="upper right", fontsize="small", handlelength=0)
    axes_of_both[0].set_title(
        f"Point at x = {response.x_m:.4f} m, y = {response.y_m:.4f} m, z = {response.z_m:.4f} m"
    )
    return figure


def tradeoff(measured: Tradeoff, *, title: str = "") -> Figure:
    """Draw the measured and predicted time of every image over its error.

    Parameters
    ----------
    measured : Tradeoff
        Result of `clsas.tradeoff`.
    title : str
        Beginning of the title; sizes and device follow.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError, ValueError
        If an argument has the wrong type, or `title` cannot be drawn.
    """
    validate.instance("measured", measured, Tradeoff)
    title = drawable("title", title)
    figure = new_figure(7.0, 6.0)
    from matplotlib import ticker

    axes = figure.subplots()
    labels: list[Annotation] = []
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
            label = ""  # only the first one has an entry in the legend
        if method != "study":
            labels += _labels(axes, rows, color)
    axes.plot([], [], "o", color="0.5", fillstyle="none", label="predicted (hollow)")
    axes.set(
        yscale="log",
        xlabel="Relative rms error against the exact image (dB)",
        ylabel="Imaging time (s)",
    )
    axes.yaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(ticker.StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(ticker.NullFormatter())
    axes.margins(x=0.08)
    axes.invert_xaxis()  # smaller errors to the right
    sizes = f"{measured.channels} lines, {' x '.join(map(str, measured.pixels))} pixels"
    axes.set_title(
        ", ".join(filter(None, (title, sizes))) + f"\n{measured.device}", fontsize="small"
    )
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=3, fontsize="small")
    _spread(axes, labels)
    return figure


def _labels(axes: Axes, rows: list[Row], color: str) -> list[Annotation]:
    """Return labels at the marks of rows; `_spread` moves them apart."""
    line = {"arrowstyle": "-", "color": color, "linewidth": 0.5, "alpha": 0.6, "shrinkB": 3}
    return [
        axes.annotate(
            row.label,
            (row.error_db, row.seconds),
            (0, 0),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize="x-small",
            color=color,
            arrowprops=line,
        )
        for row in rows
    ]


def _spread(axes: Axes, labels: list[Annotation]) -> None:
    """Move labels away from each other, from all points and from the edges of the axes.

    Each label takes the nearest free position, in the order given. If there is none, it stays at
    the last position tried.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.text import Text
    from matplotlib.transforms import Bbox

    figure: Any = axes.get_figure(root=True)
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw_without_rendering()  # to place the axes
    point, inside = figure.dpi / 72, axes.get_window_extent()
    marks = [
        place for line in axes.get_lines() if line.get_marker() not in ("None", "none", None)
        for place in line.get_transform().transform(line.get_xydata())
    ]  # fmt: skip
    taken = [Bbox.from_extents(x - 3 * point, y - 3 * point, x + 3 * point, y + 3 * point)
             for x, y in marks]  # fmt: skip
    for label in labels:
        for distance, angle in product(_DISTANCES, _ANGLES_DEG):
            away = np.array([1.6 * np.cos(np.radians(angle)), np.sin(np.radians(angle))])
            label.set_position(tuple(distance * away))
            label.update_positions(renderer)
            box = Text.get_window_extent(label, renderer).padded(point)  # without its arrow
            fits = inside.containsx(box.x0) and inside.containsx(box.x1)
            fits = fits and inside.containsy(box.y0) and inside.containsy(box.y1)
            if fits and not box.count_overlaps(taken):
                break
        taken.append(box)


def _figures_of(cut: Cut) -> str:
    """Return resolution and side lobes of a cut, one per line."""
    scale, unit = length_unit(cut.resolution_m)
    return (
        f"resolution {scale * cut.resolution_m:.4g} {unit} (−3 dB)\n"
        "PSLR nearest {:.1f}, {:.1f} dB\n".format(*cut.pslr_nearest_db)
        + "PSLR highest {:.1f}, {:.1f} dB\n".format(*cut.pslr_db)
        + "ISLR {:.1f} dB ({} + {} lobes)".format(cut.islr_db, *cut.lobes)
    )
