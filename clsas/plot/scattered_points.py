"""Pictures of images on arbitrary points."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from clsas.engine.data import validate
from clsas.engine.data.image import Image
from clsas.engine.data.validate import ArgumentError
from clsas.plot.canvas import axis_label, drawable, length_unit, new_figure, plain_ticks
from clsas.plot.colours import COLOUR_MAP
from clsas.plot.colours import colour_map as checked_colour_map
from clsas.plot.levels import Scale, add_colour_bar

if TYPE_CHECKING:
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

_MOST_POINTS = 200_000  # drawn: the strongest of more; a picture has about as many dots
_DOTS = 400_000.0  # square points of a picture's axes, shared by all points


def points(
    image: Image,
    *,
    dynamic_range_db: float | None = None,
    percentiles: tuple[float, float] | None = None,
    reference: float | None = None,
    colour_map: str | Colormap = COLOUR_MAP,
    title: str = "",
) -> Figure:
    """Draw an image on arbitrary points in dB over metres, seen along its shortest coordinate.

    The view is from above, x and y, unless the points extend farther in z than in x or y. Strong
    points are drawn over weak ones; of more than 200 000 points the strongest are drawn.

    Parameters
    ----------
    image : Image
        Image on points. `volume` draws those of a regular box, and `image` planes and height maps.
    dynamic_range_db, percentiles, reference, colour_map, title
        As for `image`.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError, ValueError
        If an argument is of a wrong kind or outside its limits, or the image is not on points.
    """
    validate.instance("image", image, Image)
    if image.grid.points_m is None:
        raise ArgumentError("image", "be on points", "one on a plane or height map")
    scale = Scale(dynamic_range_db, percentiles, reference, colour_map)
    title = drawable("title", title)
    level = image.db(reference=reference).ravel()
    low, high = scale.limits(level)
    order = np.argsort(level)[-_MOST_POINTS:]
    places_m = image.grid.points_m.reshape(-1, 3)[order]
    extents_m = np.ptp(places_m, axis=0)
    hidden = 2 if extents_m[2] <= extents_m[:2].min() else int(extents_m[:2].argmin())
    across, upward = (name for index, name in enumerate("xyz") if index != hidden)
    shown_m = places_m[:, ["xyz".index(across), "xyz".index(upward)]]
    factor, unit = length_unit(float(np.abs(shown_m).max()))
    colours = checked_colour_map(colour_map)
    figure = new_figure(7.0, 6.0)
    axes = figure.subplots()
    drawn = axes.scatter(
        factor * shown_m[:, 0], factor * shown_m[:, 1],
        c=np.maximum(level[order], low), vmin=low, vmax=high, cmap=colours,
        s=float(np.clip(_DOTS / len(order), 0.5, 30.0)), linewidths=0, rasterized=True,
    )  # fmt: skip
    axes.set_facecolor(colours(0.0))
    xlabel, ylabel = (axis_label(name, unit, place=image.georeference) for name in (across, upward))
    axes.set(xlabel=xlabel, ylabel=ylabel, title=title)
    axes.set_aspect("equal", adjustable="datalim")
    plain_ticks(axes)
    add_colour_bar(drawn, scale, level, ax=axes)
    return figure
