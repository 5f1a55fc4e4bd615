"""Pictures of corrected tracks: corrections with their intervals, coherence, sharpness."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsas.core import validate
from clsas.core.image import Image
from clsas.navigation.autofocus import Autofocus
from clsas.navigation.micronavigation import Micronavigation
from clsas.products.plot.canvas import new_figure
from clsas.products.plot.levels import image as draw_image

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_INTERVAL = 1.96  # standard deviations to either side: 95 %
_LEAST_SHOWN = 1e-9  # metres and radians: what is smaller everywhere is not drawn


def corrections(found: Micronavigation | Autofocus) -> Figure:
    """Draw the corrections of a track ping by ping, with their 95 % intervals.

    Parameters
    ----------
    found : Micronavigation or Autofocus
        The interval of micronavigation includes what is unknown of the track's start and heading.
        That of autofocus is the one of the changes from ping to ping, about the correction.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError
        If `found` is of another type.
    """
    validate.instance("found", found, Micronavigation, Autofocus)
    curves = _curves(found)
    figure = new_figure(7.0, 1.0 + 1.9 * len(curves))
    panels = np.atleast_1d(figure.subplots(len(curves), sharex=True))
    for axes, (label, value, deviation) in zip(panels, curves, strict=True):
        ping = np.arange(len(value))
        width = np.where(np.isfinite(deviation), _INTERVAL * deviation, np.nan)
        if np.isfinite(width).any():
            axes.fill_between(
                ping, value - width, value + width, alpha=0.3, linewidth=0, label="95 % interval"
            )
        axes.plot(ping, value, linewidth=1.0)
        axes.set(ylabel=label, xlim=(0, max(len(value) - 1, 1)))
        axes.grid(alpha=0.3)
    panels[-1].set_xlabel("Ping")
    if panels[0].get_legend_handles_labels()[0]:
        panels[0].legend(loc="upper right", fontsize="small")
    return figure


def coherence(found: Micronavigation) -> Figure:
    """Draw the coherence of consecutive pings over range.

    Parameters
    ----------
    found : Micronavigation

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError
        If `found` is of another type.
    """
    validate.instance("found", found, Micronavigation)
    values, range_m = found.coherence, found.range_m
    step_m = float(np.median(np.diff(range_m))) if len(range_m) > 1 else 1.0
    low_m, high_m = range_m[0] - step_m / 2, range_m[-1] + step_m / 2
    figure = new_figure(7.0, 4.0)
    beside, axes = figure.subplots(1, 2, sharey=True, width_ratios=(1, 3))
    drawn = axes.imshow(
        values.T, origin="lower", aspect="auto", vmin=0, vmax=1, cmap="cividis",
        extent=(-0.5, len(values) - 0.5, low_m, high_m), interpolation="nearest",
    )  # fmt: skip
    axes.set(xlabel="Ping, and the next one")
    median, *spread = (np.quantile(values, share, axis=0) for share in (0.5, 0.1, 0.9))
    beside.fill_betweenx(range_m, *spread, alpha=0.3, linewidth=0, label="10 to 90 %")
    beside.plot(median, range_m, marker=".", linewidth=1.0, label="median")
    beside.set(xlim=(0, 1), ylim=(low_m, high_m), xlabel="Coherence", ylabel="Range (m)")
    beside.grid(alpha=0.3)
    beside.legend(loc="lower left", fontsize="small")
    figure.colorbar(drawn, label="Coherence")
    return figure


def sharpness(found: Autofocus) -> Figure:
    """Draw the sharpness of the image after every step of an autofocus.

    Parameters
    ----------
    found : Autofocus

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError
        If `found` is of another type.
    """
    validate.instance("found", found, Autofocus)
    names = ["before", *(name for name, _ in found.sharpness)]
    values = np.array([found.sharpness_before, *(value for _, value in found.sharpness)])
    kept = np.concatenate([[True], values[1:] > np.maximum.accumulate(values)[:-1]])
    figure = new_figure(7.0, 4.0)
    axes = figure.subplots()
    step = np.arange(len(values))
    axes.plot(step, np.maximum.accumulate(values), color="0.7", linewidth=1.0, zorder=1)
    axes.plot(step[kept], values[kept], "o", label="kept")
    if not kept.all():
        axes.plot(step[~kept], values[~kept], "o", fillstyle="none", label="tried, and left out")
    axes.set(ylabel="Sharpness (mean squared intensity over squared mean)")
    axes.set_xticks(step, names, rotation=45, ha="right")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", fontsize="small")
    return figure


def before_and_after(before: Image, after: Image, **options: Any) -> Figure:
    """Draw an image before and after its track was corrected, with one scale of levels.

    Parameters
    ----------
    before, after : Image
        Images on one grid.
    **options
        Further arguments of `image`: `dynamic_range_db`, `percentiles`, `colour_map`.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError, ValueError
        If an argument is of a wrong kind, or the images differ in shape.
    """
    validate.instance("before", before, Image)
    validate.instance("after", after, Image)
    if before.shape != after.shape:
        raise ValueError(f"after must have the pixels of before, {before.shape}, got {after.shape}")
    largest = max(float(np.abs(each.pixels).max()) for each in (before, after)) or 1.0
    figure = new_figure(11.0, 5.0, layout="compressed")
    panels: NDArray[Any] = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, image, title in zip(panels, (before, after), ("Before", "After"), strict=True):
        peak_db = 20 * np.log10(max(float(np.abs(image.pixels).max()) / largest, 1e-12))
        draw_image(
            image, axes, reference=largest, colour_bar=axes is panels[-1],
            title=f"{title}: peak {peak_db:.1f} dB", **options,
        )  # fmt: skip
    _label_bar(panels)
    return figure


def _label_bar(panels: NDArray[Any]) -> None:
    """Say what 0 dB is: the larger peak of both images."""
    figure = panels[0].get_figure(root=True)
    panels[-1].set_ylabel("")
    for axes in figure.axes:
        if axes not in panels:
            axes.set_ylabel("Amplitude (dB re larger peak)")


def _curves(
    found: Micronavigation | Autofocus,
) -> list[tuple[str, NDArray[np.float64], NDArray[np.float64]]]:
    """Return label, value and standard deviation of all that was corrected, ping by ping."""
    if isinstance(found, Micronavigation):
        every = [
            ("Sway (mm)", 1e3 * found.sway_m, 1e3 * found.sway_sd_m),
            ("Yaw (mrad)", 1e3 * found.yaw_rad, 1e3 * found.yaw_sd_rad),
            ("Surge (mm)", 1e3 * found.surge_m, 1e3 * found.surge_sd_m),
        ]
    else:
        starts = found.lines.ping_starts
        deviation = 1e3 * found.correction_sd_m[starts]
        every = [
            (f"{name} (mm)", 1e3 * found.correction_m[starts, axis], deviation)
            for axis, name in enumerate(("Along x", "Along y", "Along z"))
        ]
    moved = [each for each in every if np.abs(each[1]).max() > 1e3 * _LEAST_SHOWN]
    return moved or every[:1]
