"""Pictures of images on points: volumes on regular boxes, and points at any positions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.image import Image
from clsas.engine.data.validate import ArgumentError
from clsas.plot.canvas import (
    COLOUR_MAP,
    Scale,
    add_colour_bar,
    axis_label,
    draw_levels,
    drawable,
    edges,
    figure_class,
    length_unit,
    new_figure,
    plain_ticks,
)
from clsas.plot.canvas import colour_map as checked_colour_map

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

KINDS = ("maximum", "slices")

_VIEWS = (("x", "y", "z"), ("z", "y", "x"), ("x", "z", "y"))  # across, upward, line of sight
_IN, _LEAST_IN = 6.0, 0.8  # total width of two views, and least size of a view
_LEFT, _BOTTOM, _GAP, _RIGHT, _TOP = 0.9, 0.6, 0.4, 1.3, 0.7  # margins of the views in inches
_TOLERANCE = 1e-3  # largest deviation of a point from the regular box, in steps
_MOST_POINTS = 200_000  # drawn: the strongest of more; a picture has about as many dots
_DOTS = 400_000.0  # square points of a picture's axes, shared by all points


def volume(
    image: Image,
    *,
    kind: str = "maximum",
    at: Sequence[float] | None = None,
    title: str = "",
    **options: Any,
) -> Figure:
    """Draw a volume from above, from the side and from the front, in dB over metres.

    Parameters
    ----------
    image : Image
        Image on points [n, m, k, 3] that form a regular box. Its sides lie along x, y and z, in any
        order, for example::

            z, y, x = np.meshgrid(z_m, y_m, x_m, indexing="ij")
            grid = clsas.Grid.points(np.stack([x, y, z], axis=-1))

    kind : str
        "maximum" draws the largest amplitude along the line of sight. "slices" draws three planes
        through a point, with dashed lines at their positions.
    at : (x, y, z), optional
        Point of "slices" in metres, which is rounded to the nearest pixel. By default the brightest
        pixel.
    title : str
        Title above the views.
    **options
        `dynamic_range_db`, `percentiles`, `reference` and `colour_map` of `clsas.plot.image`. All
        views have the same scale.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError, ValueError
        If an argument has the wrong type or is out of bounds, the image is not on such a box, or
        `at` lies outside it.
    """
    validate.instance("image", image, Image)
    kind = validate.one_of("kind", kind, KINDS)
    title = drawable("title", title)
    scale = Scale(**options)
    if at is not None and kind != "slices":
        raise ArgumentError("at", f"be left out with `kind={kind!r}`, since only slices have one")
    level, places_m = _box(image, scale.reference)
    indices = _indices(level, places_m, at) if kind == "slices" else None
    factor, unit = length_unit(max(float(np.abs(p).max()) for p in places_m.values()))
    limits = scale.limits(level)
    figure, panels, beside = _panels(places_m)
    for panel, (across, upward, along) in zip(panels, _VIEWS, strict=True):
        sight = "zyx".index(along)
        if indices is None:
            view, what = level.max(axis=sight), f"Maximum over {along}"
        else:
            view = np.take(level, indices[along], sight)
            what = f"{along} = {factor * places_m[along][indices[along]]:.6g} {unit}"
        if "zyx".index(across) < "zyx".index(upward):
            view = view.T  # [upward, across]
        right, up = factor * places_m[across], factor * places_m[upward]
        extent = (*edges(right, up), *edges(up, right))
        drawn = draw_levels(panel, view, extent, scale, bar=None, limits=limits)
        panel.set_title(what, fontsize="medium")
        panel.set_aspect("equal")
        if indices is not None:
            line: Any = {"color": "white", "linewidth": 0.6, "alpha": 0.7, "linestyle": "--"}
            panel.axvline(right[indices[across]], **line)
            panel.axhline(up[indices[upward]], **line)
    top, side, front = panels
    x, y, z = (axis_label(name, unit, place=image.georeference) for name in "xyz")
    top.set_ylabel(y)
    side.set_xlabel(z)
    front.set(xlabel=x, ylabel=z)
    top.tick_params(labelbottom=False)  # the views below and to the left have these labels
    side.tick_params(labelleft=False)
    add_colour_bar(drawn, scale, level, cax=beside)
    figure.suptitle(title)
    return figure


def _box(
    image: Image, reference: float | None
) -> tuple[NDArray[np.float32], dict[str, NDArray[np.float64]]]:
    """Return the levels of a volume [z, y, x], and the coordinates along "x", "y" and "z".

    All coordinates ascend. Raise ValueError if the points are not a regular box.
    """
    wanted = "be on points [n, m, k, 3] that form a regular box along x, y and z"
    points_m = image.grid.points_m
    if points_m is None or points_m.ndim != 4:
        kind = "a plane or height map" if points_m is None else "points"
        raise ArgumentError("image", wanted, f"{kind} of shape {image.grid.shape}")
    lines_m = points_m[:, 0, 0], points_m[0, :, 0], points_m[0, 0, :]
    changes_m = np.array([np.abs(line[-1] - line[0]) for line in lines_m])
    free, order = {0, 1, 2}, [0, 1, 2]
    # Axes with a single point come last, and take the coordinates that are left.
    for axis in np.argsort([-len(line) for line in lines_m], kind="stable"):
        order[axis] = max(free, key=lambda c: (changes_m[axis, c], c))
        free.remove(order[axis])
    places_m = {"xyz"[c]: line[:, c] for c, line in zip(order, lines_m, strict=True)}
    steps_m = [abs(p[-1] - p[0]) / (len(p) - 1) for p in places_m.values() if len(p) > 1]
    room_m = _TOLERANCE * min(steps_m, default=1.0)
    for axis, (c, place_m) in enumerate(zip(order, places_m.values(), strict=True)):
        even_m = np.linspace(place_m[0], place_m[-1], len(place_m))
        shape = [-1 if other == axis else 1 for other in range(3)]
        off_m = np.abs(points_m[..., c] - even_m.reshape(shape)).max()
        if off_m > room_m or (len(place_m) > 1 and place_m[0] == place_m[-1]):
            given = f"points up to {off_m:.3g} m off it along {'xyz'[c]}"
            raise ArgumentError("image", wanted, given)
    # Turn the axes, which lie in the order of `places_m`, into that of z, y and x, all ascending.
    names = list(places_m)
    level = image.db(reference=reference).transpose([names.index(name) for name in "zyx"])
    turned = {name: slice(None, None, -1 if p[-1] < p[0] else 1) for name, p in places_m.items()}
    level = level[tuple(turned[name] for name in "zyx")]
    return level, {name: p[turned[name]] for name, p in places_m.items()}


def _indices(
    level: NDArray[np.float32],
    places_m: dict[str, NDArray[np.float64]],
    at: Sequence[float] | None,
) -> dict[str, int]:
    """Return the indices of the pixel nearest to a position, or of the brightest, by coordinate."""
    if at is None:
        brightest = np.unravel_index(level.argmax(), level.shape)
        return {name: int(index) for name, index in zip("zyx", brightest, strict=True)}
    at_m = validate.array("at", at, np.float64, (3,))
    found = {}
    for name, value in zip("xyz", at_m, strict=True):
        places = places_m[name]
        step = np.ptp(places) / max(len(places) - 1, 1)
        if not places[0] - step / 2 <= value <= places[-1] + step / 2:
            allowed = f"lie in the volume, {name} from {places[0]:g} to {places[-1]:g} m"
            raise ArgumentError("at", allowed, f"{value:g} m")
        found[name] = int(np.abs(places - value).argmin())
    return found


def _panels(places_m: dict[str, NDArray[np.float64]]) -> tuple[Figure, list[Axes], Axes]:
    """Return a figure with the axes of the views from above, side and front, and the colour bar.

    All views have the same scale, except that flat views are enlarged.
    """
    lengths_m = {
        name: float(np.ptp(place)) * len(place) / max(len(place) - 1, 1)
        for name, place in places_m.items()
    }
    longest_m = max(lengths_m["x"], lengths_m["y"]) + lengths_m["z"] or 1.0
    x, y, z = (max(_IN * lengths_m[name] / longest_m, _LEAST_IN) for name in "xyz")
    width, height = _LEFT + x + _GAP + z + _RIGHT, _BOTTOM + z + _GAP + y + _TOP
    figure = figure_class()(figsize=(width, height))

    def axes(left: float, bottom: float, wide: float, high: float) -> Axes:
        return figure.add_axes((left / width, bottom / height, wide / width, high / height))

    upper, right = _BOTTOM + z + _GAP, _LEFT + x + _GAP
    views = [axes(_LEFT, upper, x, y), axes(right, upper, z, y), axes(_LEFT, _BOTTOM, x, z)]
    return figure, views, axes(right + z + 0.3, _BOTTOM, 0.18, z + _GAP + y)


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
