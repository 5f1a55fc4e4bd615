"""Pictures of echoes before pulse compression."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from clsas.engine.data import validate
from clsas.engine.data.decibels import level_db
from clsas.engine.signal.echoes import Echoes
from clsas.plot.canvas import drawable, new_figure
from clsas.plot.colours import COLOUR_MAP
from clsas.plot.levels import Scale, aligned, draw_levels

if TYPE_CHECKING:
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure


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
    amplitude, first_s, last_s = aligned(
        echoes.samples, echoes.start_time_s, 1 / echoes.sample_rate_hz
    )
    factor, unit = (1e3, "ms") if last_s < 1 else (1.0, "s")
    extent = (-0.5, echoes.channels - 0.5, factor * first_s, factor * last_s)
    figure = new_figure(7.0, 6.0)
    axes = figure.subplots()
    draw_levels(axes, np.asarray(level_db(amplitude, reference)), extent, scale)
    axes.set(
        xlabel="Channel", ylabel=f"Time after transmission ({unit})", title=title, aspect="auto"
    )
    return figure
