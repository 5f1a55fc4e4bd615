"""Pictures of measures and predictions: cuts through a point, time over error, and plans."""

from __future__ import annotations

import textwrap
from dataclasses import asdict
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from clsas.engine.data import validate
from clsas.engine.data.decibels import in_db
from clsas.engine.factorized.plan import Plan
from clsas.measures.quality import PointResponse
from clsas.measures.tradeoff import Tradeoff
from clsas.plot.canvas import axis_label, drawable, length_unit, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Annotation

_DISTANCES = (10, 18, 28, 40, 54, 70, 88, 108)  # points from marks to labels, tried in turn
_ANGLES_DEG = (-45, 45, -90, 90, -20, 20, -135, 135, 180)
_SHOWN_DB = 40.0  # causes of errors that are weaker than the whole by more are left out
_LEAST_SHARE = 1e-3  # of the time, below which what stages do not explain is left out
_TITLE = 110  # characters of a line


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
        scale, unit = length_unit(cut.resolution_m)
        figures = (
            f"resolution {scale * cut.resolution_m:.4g} {unit} (−3 dB)\n"
            "PSLR nearest {:.1f}, {:.1f} dB\n".format(*cut.pslr_nearest_db)
            + "PSLR highest {:.1f}, {:.1f} dB\n".format(*cut.pslr_db)
            + "ISLR {:.1f} dB ({} + {} lobes)".format(cut.islr_db, *cut.lobes)
        )
        scale, unit = length_unit(cut.resolution_m * resolutions)
        axes.plot(scale * cut.offset_m, cut.level_db, linewidth=1.0, label=figures)
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
        if method == "study":
            continue
        line = {"arrowstyle": "-", "color": color, "linewidth": 0.5, "alpha": 0.6, "shrinkB": 3}
        labels += [
            axes.annotate(
                row.label, (row.error_db, row.seconds), (0, 0), textcoords="offset points",
                ha="center", va="center", fontsize="x-small", color=color, arrowprops=line,
            )
            for row in rows
        ]  # fmt: skip
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


def plan(plan: Plan, *, title: str = "") -> Figure:
    """Draw the predicted time of a plan, stage by stage, and the causes of its predicted error.

    Parameters
    ----------
    plan : Plan
    title : str
        Beginning of the title; the plan in a line follows.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError, ValueError
        If `plan` is not a Plan, or `title` cannot be drawn.
    """
    validate.instance("plan", plan, Plan)
    title = drawable("title", title)
    if plan.is_exact:
        times_s = {"exact backprojection": plan.predicted_seconds}
    else:
        names = [*(f"stage {number}" for number in range(1, len(plan.stages))), "leaves"]
        times_s = {
            f"{name}: {stage.subimages} of {stage.rows} × {stage.columns} pixels": stage.seconds
            for name, stage in zip(names, plan.stages, strict=True)
        }
        others_s = plan.predicted_seconds - sum(times_s.values())
        if others_s > _LEAST_SHARE * plan.predicted_seconds:
            times_s["upsampling, geometry and calls"] = others_s
    least_db = plan.errors.total_db - _SHOWN_DB
    errors_db = {
        name.replace("_", " "): in_db(power)
        for name, power in sorted(asdict(plan.errors).items(), key=lambda cause: -cause[1])
        if power > 0 and in_db(power) > least_db
    }
    figure = new_figure(10.0, 1.6 + 0.32 * max(len(times_s), len(errors_db), 4))
    left, right = figure.subplots(1, 2)

    scale, unit = (1.0, "s") if sum(times_s.values()) >= 1 else (1e3, "ms")
    bars = left.barh(list(times_s), [scale * time_s for time_s in times_s.values()])
    left.bar_label(bars, fmt="%.3g", padding=3, fontsize="small")
    left.invert_yaxis()  # the first stage on top
    left.margins(x=0.15)
    left.set(xlabel=f"Predicted time ({unit})", title="Time by stage")
    left.tick_params(axis="y", labelsize="small")

    total_db = plan.predicted_error_db
    floor_db = min([total_db, *errors_db.values()]) - 5.0
    widths = [error_db - floor_db for error_db in errors_db.values()]
    bars = right.barh(list(errors_db), widths, left=floor_db, color="tab:orange")
    labels = right.bar_label(
        bars, [f"{error_db:.1f}" for error_db in errors_db.values()], padding=3, fontsize="small"
    )
    for label in labels:  # readable where a line crosses it
        label.set_bbox({"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5})
    right.axvline(total_db, color="black", linewidth=1.0, label=f"predicted {total_db:.1f} dB")
    right_db = total_db
    if plan.tolerance_db is not None:
        right_db = max(right_db, plan.tolerance_db)
        right.axvline(plan.tolerance_db, color="tab:red", linestyle="--", linewidth=1.0,
                     label=f"tolerance {plan.tolerance_db:.4g} dB")  # fmt: skip
    right.invert_yaxis()
    right.set(
        xlim=(floor_db, right_db + 0.15 * (right_db - floor_db)),
        xlabel="Relative rms error against the exact image (dB)",
        title="Error by cause: powers add up",
    )
    right.tick_params(axis="y", labelsize="small")
    right.legend(loc="lower right", fontsize="small")
    headline = textwrap.wrap(plan.describe().splitlines()[0], _TITLE)
    figure.suptitle("\n".join(filter(None, (title, *headline))), fontsize="medium")
    return figure
