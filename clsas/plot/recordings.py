"""Pictures of recordings: range lines, echoes, the geometry of a survey, and inspections."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.decibels import in_db, level_db
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.pings import Transmissions
from clsas.engine.signal.echoes import Echoes
from clsas.engine.signal.spectrum import power_spectrum
from clsas.inspection.inspection import Inspection
from clsas.plot.canvas import (
    COLOUR_MAP,
    MOST_PIXELS,
    Scale,
    axis_label,
    draw_levels,
    drawable,
    length_unit,
    new_figure,
    plain_ticks,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

_MOST_ROWS = 800  # drawn; pictures have fewer dots
_LEVELS_DB = 30.0, 80.0  # least and largest dynamic range of the levels of inspected lines
_SPECTRUM_DB = 80.0  # level below the strongest frequency at which the axis ends
_PREFIXES = ((1e9, "GHz"), (1e6, "MHz"), (1e3, "kHz"))


def range_lines(
    lines: RangeLines,
    *,
    dynamic_range_db: float | None = None,
    percentiles: tuple[float, float] | None = None,
    reference: float | None = None,
    colour_map: str | Colormap = COLOUR_MAP,
    title: str = "",
) -> Figure:
    """Draw the amplitude of range lines in dB over channel and range.

    Parameters
    ----------
    lines : RangeLines
        Lines to draw; each is drawn at its own ranges.
    dynamic_range_db, percentiles, reference, colour_map, title
        As for `image`. By default, levels are relative to the largest sample.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError, ValueError
        If an argument has the wrong type or is out of bounds.
    """
    validate.instance("lines", lines, RangeLines)
    scale = Scale(dynamic_range_db, percentiles, reference, colour_map)
    title = drawable("title", title)
    amplitude, first_m, last_m = _aligned(lines.samples, lines.first_range_m, lines.range_step_m)
    extent = (-0.5, lines.channels - 0.5, first_m, last_m)
    figure = new_figure(7.0, 6.0)
    axes = figure.subplots()
    draw_levels(axes, level_db(amplitude, reference), extent, scale)
    axes.set(xlabel="Channel", ylabel="Range (m)", title=title, aspect="auto")
    return figure


def echoes(
    echoes: Echoes,
    *,
    dynamic_range_db: float | None = None,
    percentiles: tuple[float, float] | None = None,
    reference: float | None = None,
    colour_map: str | Colormap = COLOUR_MAP,
    title: str = "",
) -> Figure:
    """Draw the amplitude of echoes in dB: channels across, time after transmission upward.

    Parameters
    ----------
    echoes : Echoes
        Echoes before compression. Of real samples, the magnitude is drawn.
    dynamic_range_db, percentiles, reference, colour_map, title
        As for `image`.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError, ValueError
        If an argument is of a wrong kind or outside its limits.
    """
    validate.instance("echoes", echoes, Echoes)
    scale = Scale(dynamic_range_db, percentiles, reference, colour_map)
    title = drawable("title", title)
    amplitude, first_s, last_s = _aligned(
        echoes.samples, echoes.start_time_s, 1 / echoes.sample_rate_hz
    )
    factor, unit = (1e3, "ms") if last_s < 1 else (1.0, "s")
    extent = (-0.5, echoes.channels - 0.5, factor * first_s, factor * last_s)
    figure = new_figure(7.0, 6.0)
    axes = figure.subplots()
    draw_levels(axes, level_db(amplitude, reference), extent, scale)
    axes.set(
        xlabel="Channel", ylabel=f"Time after transmission ({unit})", title=title, aspect="auto"
    )
    return figure


def _aligned(
    samples: NDArray, first: NDArray[np.float64], step: float
) -> tuple[NDArray[np.float32], float, float]:
    """Return amplitudes [range or time, channel] on one axis, and that axis's outer edges."""
    channels, length = samples.shape
    start = np.rint((first - first.min()) / step).astype(int)
    rows = int(start.max()) + length
    validate.memory("the picture", 12 * rows * channels)  # amplitudes, and levels with a copy
    amplitude = np.zeros((rows, channels), np.float32)
    for channel, (at, each) in enumerate(zip(start, samples, strict=True)):
        amplitude[at : at + length, channel] = np.abs(each)
    return amplitude, first.min() - step / 2, first.min() + (rows - 0.5) * step


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
    shown = [0, 1]  # the coordinates across and upward
    if grid is not None and grid.points_m is None and min(grid.shape) > 1:
        names = "".join(sorted(side.name for side in grid.sides))
        if names in ("xz", "yz"):
            shown = ["xyz".index(name) for name in names]
    # Units are metres unless the whole geometry is small.
    ends_m = [lines.rx_m, lines.tx_m] + ([] if grid is None else [_outline(grid)[0]])
    scale, unit = length_unit(max(float(np.abs(each[:, shown]).max()) for each in ends_m))
    figure = new_figure(7.0, 6.0)
    axes = figure.subplots()
    for name, antenna_m, marker in (
        ("Receiver", lines.rx_m, "."),
        ("Transmitter", lines.tx_m, "x"),
    ):
        places = scale * np.unique(antenna_m[:, shown].round(6), axis=0)  # micrometres
        label = f"{name} ({len(places)} positions)"
        axes.plot(*places.T, marker, markersize=5, label=label)
    if grid is not None:
        outline_m, style = _outline(grid)
        label = "Grid " + " × ".join(map(str, grid.shape))
        places = scale * outline_m[:, shown]
        axes.plot(*places.T, style, linewidth=1.5, markersize=2, label=label)
    place = lines.georeference or (None if grid is None else grid.georeference)
    xlabel, ylabel = (axis_label("xyz"[index], unit, place=place) for index in shown)
    axes.set(xlabel=xlabel, ylabel=ylabel, aspect="equal")
    axes.set_adjustable("datalim")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=3, fontsize="small")
    plain_ticks(axes)
    return figure


def _outline(grid: Grid) -> tuple[NDArray, str]:
    """Return the corners of a grid, or all its points, [n, 3], and the style to draw them."""
    if grid.points_m is not None:
        return grid.points_m.reshape(-1, 3), "."
    down, right = (count - 1 for count in grid.shape)
    corners = np.array([[0, 0], [0, right], [down, right], [down, 0], [0, 0]])
    return grid.origin_m + corners @ [grid.row_step_m, grid.column_step_m], "-"


def inspection(found: Inspection, grid: Grid | None = None) -> Figure:
    """Draw an inspected recording: levels of its lines, their spectrum, and the track.

    The track is drawn twice: as the advance from ping to ping, and from above. Dead and clipped
    channels and pings taken standing still are marked on the levels, halts and gaps on the track.

    Parameters
    ----------
    found : Inspection
        Result of `clsas.inspect`.
    grid : Grid, optional
        Grid whose outline is drawn beside the track.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError
        If an argument has another type.
    """
    validate.instance("found", found, Inspection)
    if grid is not None:
        validate.instance("grid", grid, Grid)
    figure = new_figure(13.0, 9.0)
    places = figure.add_gridspec(2, 3, height_ratios=(3, 2))
    pings = Transmissions.of(found.lines.tx_m, found.lines.rx_m)
    _draw_lines(figure.add_subplot(places[0, :]), found, pings)
    _draw_spectrum(figure.add_subplot(places[1, 0]), found)
    _draw_steps(figure.add_subplot(places[1, 1]), found, pings)
    _draw_track(figure.add_subplot(places[1, 2]), found, pings, grid)
    names = ", ".join(each.name.replace("_", " ") for each in found.findings)
    figure.suptitle(f"Found: {names}" if names else "No defects found", fontsize=11)
    return figure


def _draw_lines(axes: Axes, found: Inspection, pings: Transmissions) -> None:
    lines = found.lines
    amplitude, first_m, last_m = _pooled(lines)
    scale, unit = length_unit(max(abs(first_m), abs(last_m)))
    extent = (-0.5, lines.channels - 0.5, scale * first_m, scale * last_m)
    level = level_db(amplitude)
    faintest = -float(np.percentile(np.maximum(level, -_LEVELS_DB[1]), 2))
    draw_levels(axes, level, extent, Scale(dynamic_range_db=max(faintest, _LEVELS_DB[0])))
    axes.set(
        xlabel=f"Channel (of {found.pings} pings)", ylabel=f"Range ({unit})", aspect="auto",
        title="Levels of the lines",
    )  # fmt: skip
    marks = (
        ("still_pings", "tab:red", "taken standing still"),
        ("dead_channels", "tab:cyan", "dead"),
        ("clipped_channels", "tab:green", "clipped"),
    )
    for row, (name, colour, label) in enumerate(marks):
        if name not in found:
            continue
        where = np.array(found[name].where, np.int64)
        if name == "still_pings":
            still = np.zeros(pings.count, bool)
            still[where] = True
            where = pings.channels(still)
        axes.plot(
            where, np.full(len(where), 0.985 - 0.03 * row), "|", color=colour, markersize=9,
            transform=axes.get_xaxis_transform(), label=f"{label} ({len(where)})",
        )  # fmt: skip
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="lower right", fontsize="small", framealpha=0.9, markerscale=1.5)


def _pooled(lines: RangeLines) -> tuple[NDArray[np.float32], float, float]:
    """Return the largest amplitudes of fewer ranges and channels, and the ends of the ranges.

    The result is [range, channel]. Ranges outside those of nearly all lines are left out, since
    single lines with wrong ranges would hide the rest.
    """
    first_m, step_m = lines.first_range_m, lines.range_step_m
    low_m = float(np.quantile(first_m, 0.01)) - step_m / 2
    high_m = float(np.quantile(lines.last_range_m, 0.99)) + step_m / 2
    if not high_m > low_m:
        low_m, high_m = float(first_m.min()), float(lines.last_range_m.max()) + step_m
    rows = int(np.clip((high_m - low_m) / step_m, 1, _MOST_ROWS))
    columns = min(lines.channels, MOST_PIXELS)
    column = np.arange(lines.channels) * columns // lines.channels
    result = np.zeros((rows, columns), np.float32)
    for channel in range(lines.channels):
        range_m = first_m[channel] + np.arange(lines.length) * step_m
        row = np.floor((range_m - low_m) / (high_m - low_m) * rows).astype(np.int64)
        inside = slice(*np.searchsorted(row, [0, rows]))
        if row[inside].size:
            starts = np.flatnonzero(np.diff(row[inside], prepend=-1))
            amplitude = np.maximum.reduceat(np.abs(lines.samples[channel, inside]), starts)
            at = row[inside][starts], column[channel]
            result[at] = np.maximum(result[at], amplitude)
    return result, low_m, high_m


def _draw_spectrum(axes: Axes, found: Inspection) -> None:
    lines = found.lines
    frequency, power = power_spectrum(lines)
    rate_hz = lines.sound_speed_m_s / (2 * lines.range_step_m)
    low_hz, high_hz = found.band_hz
    # The band is drawn in one piece even if it lies across the edge of the sampled frequencies.
    middle = ((low_hz + high_hz) / 2 - lines.carrier_hz) / rate_hz
    frequency = middle + (frequency - middle + 0.5) % 1.0 - 0.5
    order = np.argsort(frequency)
    at_hz = lines.carrier_hz + rate_hz * frequency[order]
    level = in_db(power[order] / power.max())
    scale, unit = next((each for each in _PREFIXES if np.abs(at_hz).max() >= each[0]), (1.0, "Hz"))
    axes.plot(at_hz / scale, level, linewidth=0.8)
    axes.axvspan(
        low_hz / scale, high_hz / scale, alpha=0.15, color="tab:orange", label="Band found"
    )
    if lines.carrier_hz:
        axes.axvline(lines.carrier_hz / scale, color="0.4", linestyle=":", label="Carrier")
    axes.set(
        xlabel=f"Frequency ({unit})", ylabel="Power (dB re max)", ylim=(-_SPECTRUM_DB, 3),
        title="Mean spectrum",
    )  # fmt: skip
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small", loc="lower center")
    plain_ticks(axes)


def _draw_steps(axes: Axes, found: Inspection, pings: Transmissions) -> None:
    steps_m = pings.steps_m
    largest_m = float(steps_m.max(initial=0.0))
    scale, unit = length_unit(largest_m)
    number = np.arange(1, len(steps_m) + 1)
    axes.plot(number, scale * steps_m, ".", markersize=3, color="0.3")
    for name, colour, label, later in (
        ("still_pings", "tab:red", "Standing still", 0),
        ("gaps", "tab:orange", "Gaps", 1),
        ("order", "tab:purple", "Turns back", 1),
    ):
        if name in found:
            # Halts are listed by the ping that does not advance, gaps by the ping before them.
            at = np.array(found[name].where, np.int64) + later
            at = at[(at > 0) & (at <= len(steps_m))]
            axes.plot(at, scale * steps_m[at - 1], "o", color=colour, fillstyle="none",
                      markersize=6, label=f"{label} ({len(at)})")  # fmt: skip
    axes.set(xlabel="Ping", ylabel=f"Advance ({unit})", title="Advance from the previous ping")
    if largest_m:
        axes.set_ylim(-0.05 * scale * largest_m, 1.1 * scale * largest_m)
    axes.grid(alpha=0.3)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize="small", loc="best")
    plain_ticks(axes)


def _draw_track(axes: Axes, found: Inspection, pings: Transmissions, grid: Grid | None) -> None:
    shown = pings.centres_m[:, :2]
    outline = None if grid is None else _outline(grid)
    ends_m = [shown] if outline is None else [shown, outline[0][:, :2]]
    scale, unit = length_unit(max(float(np.abs(each).max()) for each in ends_m))
    axes.plot(*(scale * shown.T), ".-", markersize=3, linewidth=0.5, color="0.3", label="Pings")
    still = np.array(found["still_pings"].where if "still_pings" in found else (), np.int64)
    if still.size:
        axes.plot(*(scale * shown[still].T), "o", color="tab:red", fillstyle="none", markersize=7,
                  label=f"Standing still ({still.size})")  # fmt: skip
    if "dead_channels" in found:
        starts = np.searchsorted(pings.starts, found["dead_channels"].where, side="right") - 1
        dead = np.unique(starts)
        axes.plot(*(scale * shown[dead].T), "x", color="tab:cyan", markersize=5,
                  label=f"With dead channels ({dead.size})")  # fmt: skip
    if "gaps" in found:
        moving = np.flatnonzero(pings.advancing())
        for index, gap in enumerate(found["gaps"].where):
            after = moving[np.searchsorted(moving, gap) + 1]
            axes.plot(*(scale * shown[[gap, after]].T), color="tab:orange", linewidth=3,
                      label="" if index else f"Gaps ({len(found['gaps'].where)})")  # fmt: skip
    if outline is not None:
        places_m, style = outline
        axes.plot(*(scale * places_m[:, :2].T), style, linewidth=1.5, markersize=2, label="Grid")
    place = None if grid is None else grid.georeference
    xlabel, ylabel = (axis_label(name, unit, place=place) for name in "xy")
    axes.set(xlabel=xlabel, ylabel=ylabel, title="Track from above")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small", loc="best")
    plain_ticks(axes)
