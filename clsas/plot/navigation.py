"""Pictures of corrected tracks: corrections with their intervals, coherence and sharpness."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.validate import ArgumentError
from clsas.navigation.autofocus import Autofocus
from clsas.navigation.micronavigation import Micronavigation
from clsas.plot.canvas import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_INTERVAL = 1.96  # standard deviations on each side that make 95 %
_LEAST_SHOWN = 1e-9  # corrections that never exceed this, in metres or radians, are not drawn


def corrections(found: Micronavigation | Autofocus) -> Figure:
    """Draw the corrections of a track ping by ping, with their 95 % intervals.

    Parameters
    ----------
    found : Micronavigation or Autofocus
        Result with the corrections. Micronavigation has two intervals. That of the whole track
        includes its unknown start and heading; that of its shape does not, and is the one that the
        sharpness of an image depends on. The interval of autofocus is that of the changes from ping
        to ping.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError
        If `found` has another type.
    """
    validate.instance("found", found, Micronavigation, Autofocus)
    # Name, unit, values, and their intervals: standard deviations, label and colour.
    curves: list[tuple[str, str, NDArray, list[tuple[NDArray, str, str]]]]
    if isinstance(found, Micronavigation):
        curves = [
            ("Sway", "mm", 1e3 * found.sway_m, [
                (1e3 * found.sway_sd_m, "whole track", "tab:gray"),
                (1e3 * found.shape_sd_m, "its shape", "tab:blue"),
            ]),
            ("Yaw", "mrad", 1e3 * found.yaw_rad, [(1e3 * found.yaw_sd_rad, "", "tab:gray")]),
            ("Surge", "mm", 1e3 * found.surge_m, [(1e3 * found.surge_sd_m, "", "tab:gray")]),
        ]  # fmt: skip
    else:
        starts = found.lines.ping_starts
        correction = 1e3 * found.correction_m[starts]
        interval = (1e3 * found.correction_sd_m[starts], "", "tab:blue")
        curves = [
            (f"Along {name}", "mm", correction[:, axis], [interval])
            for axis, name in enumerate("xyz")
        ]
    moved = [each for each in curves if np.abs(each[2]).max() > 1e3 * _LEAST_SHOWN]
    curves = moved or curves[:1]

    figure = new_figure(9.0, 1.2 + 1.8 * len(curves))
    panels: NDArray[Any] = figure.subplots(
        len(curves), 2, sharex=True, squeeze=False, width_ratios=(2, 1)
    )
    for (values, widths), (name, unit, value, intervals) in zip(panels, curves, strict=True):
        ping = np.arange(len(value))
        values.plot(ping, value, linewidth=1.0)
        reach = max(float(np.ptp(value)), 1e-6)
        for deviation, label, colour in intervals:
            width = _INTERVAL * deviation
            if not (np.isfinite(width) & (width > 0)).any():
                continue
            if width[np.isfinite(width)].max() < reach:  # wider intervals would fill the panel
                values.fill_between(
                    ping, value - width, value + width, alpha=0.4, linewidth=0, color=colour
                )
            widths.semilogy(ping, width, color=colour, linewidth=1.0, label=label)
        values.set(
            ylabel=f"{name} ({unit})", xlim=(0, max(len(value) - 1, 1)),
            ylim=(float(value.min()) - 0.3 * reach, float(value.max()) + 0.3 * reach),
        )  # fmt: skip
        widths.set_ylabel(f"± ({unit})")
        _show_decades(widths)
        for axes in (values, widths):
            axes.grid(alpha=0.3)
        if len(intervals) > 1 and widths.get_legend_handles_labels()[0]:
            widths.legend(fontsize="small")
    for axes in panels[-1]:
        axes.set_xlabel("Ping")
    panels[0, 1].set_title("95 % interval", fontsize="medium")
    return figure


def _show_decades(axes: Axes) -> None:
    """Let a logarithmic axis begin and end at powers of ten, shown as plain numbers."""
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    drawn = [np.asarray(line.get_ydata()) for line in axes.lines]
    shown = np.concatenate([each[np.isfinite(each) & (each > 0)] for each in drawn] or [[]])
    if not shown.size:
        return
    low, high = np.floor(np.log10(shown.min())), np.ceil(np.log10(shown.max()))
    axes.set_ylim(10.0**low, 10.0 ** max(high, low + 1))
    axes.yaxis.set_major_locator(LogLocator(numticks=6))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))


def coherence(found: Micronavigation, *, range_m: tuple[float, float] | None = None) -> Figure:
    """Draw the coherence of consecutive pings over ping and range.

    Parameters
    ----------
    found : Micronavigation
    range_m : (near, far), optional
        The argument `range_m` of `micronavigate`: range windows fill this interval. By default
        windows are as wide as their distance, and a single one reaches as far as the lines.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError, ValueError
        If `found` has another type, or `range_m` is not in ascending order.
    """
    validate.instance("found", found, Micronavigation)
    # Windows are equally wide.
    middles_m, windows = found.range_m, len(found.range_m)
    if range_m is not None:
        near_m, far_m = validate.array("range_m", range_m, np.float64, (2,))
        if not near_m < far_m:
            raise ArgumentError("range_m", "be near < far in m", (float(near_m), float(far_m)))
    elif windows > 1:
        half_m = float(middles_m[1] - middles_m[0]) / 2
        near_m, far_m = middles_m[0] - half_m, middles_m[-1] + half_m
    else:
        first_m, last_m = found.lines.first_range_m.max(), found.lines.last_range_m.min()
        half_m = float(min(middles_m[0] - first_m, last_m - middles_m[0]))
        near_m, far_m = middles_m[0] - half_m, middles_m[0] + half_m
    edges_m = np.linspace(near_m, far_m, windows + 1)

    values = found.coherence
    figure = new_figure(7.0, 4.0)
    beside, axes = figure.subplots(1, 2, sharey=True, width_ratios=(1, 3))
    drawn = axes.imshow(
        values.T, origin="lower", aspect="auto", vmin=0, vmax=1, cmap="cividis",
        extent=(-0.5, len(values) - 0.5, edges_m[0], edges_m[-1]), interpolation="nearest",
    )  # fmt: skip
    axes.set(xlabel="Ping (with the next one)")
    median, *spread = (np.quantile(values, share, axis=0) for share in (0.5, 0.1, 0.9))
    for low, high, near_m, far_m in zip(*spread, edges_m, edges_m[1:], strict=False):
        beside.fill_betweenx((near_m, far_m), low, high, alpha=0.3, linewidth=0, color="tab:blue")
    beside.fill_betweenx([], [], [], alpha=0.3, color="tab:blue", label="10 to 90 %")
    beside.stairs(median, edges_m, orientation="horizontal", baseline=None, label="median")
    beside.set(
        xlim=(0, 1.02), ylim=(edges_m[0], edges_m[-1]), xlabel="Coherence", ylabel="Range (m)"
    )
    beside.grid(alpha=0.3)
    beside.legend(loc="lower left", fontsize="small")
    figure.colorbar(drawn, label="Coherence")
    return figure


def sharpness(found: Autofocus) -> Figure:
    """Draw the sharpness of the image after every step of autofocus.

    Parameters
    ----------
    found : Autofocus

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError
        If `found` has another type.
    """
    validate.instance("found", found, Autofocus)
    names = ["before", *(name for name, _ in found.sharpness)]
    values = np.array([found.sharpness_before, *(value for _, value in found.sharpness)])
    kept = np.concatenate([[True], values[1:] > np.maximum.accumulate(values)[:-1]])
    figure = new_figure(7.0, 5.0)
    axes = figure.subplots()
    step = np.arange(len(values))
    axes.plot(step, np.maximum.accumulate(values), color="0.7", linewidth=1.0, zorder=1)
    axes.plot(step[kept], values[kept], "o", label="kept")
    if not kept.all():
        axes.plot(step[~kept], values[~kept], "o", fillstyle="none", label="tried, and left out")
    axes.set(ylabel="Sharpness (speckle has 2)")
    axes.set_xticks(step, names, rotation=45, ha="right")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", fontsize="small")
    return figure
