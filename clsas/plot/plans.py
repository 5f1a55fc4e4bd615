"""Pictures of plans: predicted time by stage, and predicted error by cause."""

from __future__ import annotations

import textwrap
from dataclasses import asdict
from typing import TYPE_CHECKING

from clsas.engine.data import validate
from clsas.engine.data.decibels import in_db
from clsas.engine.factorized.plan import Plan
from clsas.plot.canvas import drawable, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SHOWN_DB = 40.0  # causes fainter than the whole error by more are left out
_LEAST_SHARE = 1e-3  # of the time, below which what stages do not explain is left out
_TITLE = 110  # characters of a line


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
    times_s, errors_db = _times(plan), _errors(plan)
    figure = new_figure(10.0, 1.6 + 0.32 * max(len(times_s), len(errors_db), 4))
    left, right = figure.subplots(1, 2)
    _draw_times(left, times_s)
    _draw_errors(right, plan, errors_db)
    headline = textwrap.wrap(plan.describe().splitlines()[0], _TITLE)
    figure.suptitle("\n".join(filter(None, (title, *headline))), fontsize="medium")
    return figure


def _times(plan: Plan) -> dict[str, float]:
    """Return the predicted seconds of each stage, and of all else, by label."""
    if plan.is_exact:
        return {"exact backprojection": plan.predicted_seconds}
    names = [*(f"stage {number}" for number in range(1, len(plan.stages))), "leaves"]
    times_s = {
        f"{name}: {stage.subimages} of {stage.rows} × {stage.columns} pixels": stage.seconds
        for name, stage in zip(names, plan.stages, strict=True)
    }
    others_s = plan.predicted_seconds - sum(times_s.values())
    if others_s > _LEAST_SHARE * plan.predicted_seconds:
        times_s["upsampling, geometry and calls"] = others_s
    return times_s


def _errors(plan: Plan) -> dict[str, float]:
    """Return the contributions to the predicted error that matter, dB, the largest first."""
    powers = {name.replace("_", " "): power for name, power in asdict(plan.errors).items()}
    least_db = plan.errors.total_db - _SHOWN_DB
    errors_db = {name: float(in_db(power)) for name, power in powers.items() if power > 0}
    ordered = sorted(errors_db.items(), key=lambda item: -item[1])
    return {name: error_db for name, error_db in ordered if error_db > least_db}


def _draw_times(axes: Axes, times_s: dict[str, float]) -> None:
    scale, unit = (1.0, "s") if sum(times_s.values()) >= 1 else (1e3, "ms")
    bars = axes.barh(list(times_s), [scale * time_s for time_s in times_s.values()])
    axes.bar_label(bars, fmt="%.3g", padding=3, fontsize="small")
    axes.invert_yaxis()  # the first stage on top
    axes.margins(x=0.15)
    axes.set(xlabel=f"Predicted time ({unit})", title="Time by stage")
    axes.tick_params(axis="y", labelsize="small")


def _draw_errors(axes: Axes, plan: Plan, errors_db: dict[str, float]) -> None:
    total_db = plan.predicted_error_db
    floor_db = min([total_db, *errors_db.values()]) - 5.0
    widths = [error_db - floor_db for error_db in errors_db.values()]
    bars = axes.barh(list(errors_db), widths, left=floor_db, color="tab:orange")
    labels = axes.bar_label(
        bars, [f"{error_db:.1f}" for error_db in errors_db.values()], padding=3, fontsize="small"
    )
    for label in labels:  # readable where a line crosses it
        label.set_bbox({"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5})
    axes.axvline(total_db, color="black", linewidth=1.0, label=f"predicted {total_db:.1f} dB")
    right_db = total_db
    if plan.tolerance_db is not None:
        right_db = max(right_db, plan.tolerance_db)
        axes.axvline(plan.tolerance_db, color="tab:red", linestyle="--", linewidth=1.0,
                     label=f"tolerance {plan.tolerance_db:.4g} dB")  # fmt: skip
    axes.invert_yaxis()
    axes.set(
        xlim=(floor_db, right_db + 0.15 * (right_db - floor_db)),
        xlabel="Relative rms error against the exact image (dB)",
        title="Error by cause: powers add up",
    )
    axes.tick_params(axis="y", labelsize="small")
    axes.legend(loc="lower right", fontsize="small")
