"""Pictures of volumes: maximum projections and slices along x, y and z."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.validate import ArgumentError
from clsas.plot.canvas import axis_label, drawable, figure_class, length_unit
from clsas.plot.levels import Scale, add_colour_bar, draw_levels, edges

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

KINDS = ("maximum", "slices")
_VIEWS = (("x", "y", "z"), ("z", "y", "x"), ("x", "z", "y"))  # across, upward, line of sight
_IN, _LEAST_IN = 6.0, 0.8  # total width of two views, and least size of a view
_LEFT, _BOTTOM, _GAP, _RIGHT, _TOP = 0.9, 0.6, 0.4, 1.3, 0.7  # margins of the views in inches
_TOLERANCE = 1e-3  # largest deviation of a point from the regular box, in steps


@dataclass(frozen=True, eq=False)
class _Box:
    """Levels on a regular box of points.

    Parameters
    ----------
    level : ndarray, [z, y, x]
    places_m : dict of ndarray
        Coordinates along "x", "y" and "z".
    """

    level: NDArray[np.float32]
    places_m: dict[str, NDArray[np.float64]]

    def view(self, across: str, upward: str, along: str, index: int | None) -> NDArray[np.float32]:
        """Return a slice at an index of `along`, or the maximum over it, [upward, across]."""
        axis = "zyx".index(along)
        flat = self.level.max(axis=axis) if index is None else np.take(self.level, index, axis)
        left = "zyx".replace(along, "")
        return flat if left == upward + across else flat.T


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
    box = _box_of(image, scale.reference)
    indices = _nearest(box, at) if kind == "slices" else None
    factor, unit = length_unit(max(float(np.abs(p).max()) for p in box.places_m.values()))
    low, high = scale.limits(box.level)
    fixed = Scale(reference=scale.reference, colour_map=scale.colour_map)
    figure, panels, beside = _panels(box)
    for panel, (across, upward, along) in zip(panels, _VIEWS, strict=True):
        place = None if indices is None else indices[along]
        views = factor * box.places_m[across], factor * box.places_m[upward]
        extent = (*edges(*views), *edges(*reversed(views)))
        level = box.view(across, upward, along, place)
        drawn = draw_levels(panel, level, extent, fixed, bar=None)
        drawn.set_clim(low, high)
        what = f"Maximum over {along}"
        if place is not None:
            what = f"{along} = {factor * box.places_m[along][place]:.6g} {unit}"
        panel.set_title(what, fontsize="medium")
        panel.set_aspect("equal")
        if indices is not None:
            line: Any = {"color": "white", "linewidth": 0.6, "alpha": 0.7, "linestyle": "--"}
            panel.axvline(views[0][indices[across]], **line)
            panel.axhline(views[1][indices[upward]], **line)
    top, side, front = panels
    x, y, z = (axis_label(name, unit, place=image.georeference) for name in "xyz")
    top.set_ylabel(y)
    side.set_xlabel(z)
    front.set(xlabel=x, ylabel=z)
    top.tick_params(labelbottom=False)  # the views below and to the left have these labels
    side.tick_params(labelleft=False)
    add_colour_bar(drawn, scale, box.level, cax=beside)
    figure.suptitle(title)
    return figure


def _panels(box: _Box) -> tuple[Figure, list[Axes], Axes]:
    """Return a figure with the axes of the views from above, side and front, and the colour bar.

    All views have the same scale, except that flat views are enlarged.
    """
    lengths_m = {
        name: float(np.ptp(place)) * len(place) / max(len(place) - 1, 1)
        for name, place in box.places_m.items()
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


def _box_of(image: Image, reference: float | None) -> _Box:
    """Return a volume with axes in the order [z, y, x] and all coordinates ascending.

    Raise ValueError if its points are not a regular box.
    """
    places_m = _sides_m(image.grid)
    order = list(places_m)  # the coordinate that changes along each axis of the points
    level = image.db(reference=reference).transpose([order.index(name) for name in "zyx"])
    turned = {name: slice(None, None, -1 if p[-1] < p[0] else 1) for name, p in places_m.items()}
    level = level[tuple(turned[name] for name in "zyx")]
    return _Box(level, {name: p[turned[name]] for name, p in places_m.items()})


def _sides_m(grid: Grid) -> dict[str, NDArray[np.float64]]:
    """Return the coordinates along the axes of a regular box of points, by their names.

    Raise ValueError if the points are not a regular box.
    """
    wanted = "be on points [n, m, k, 3] that form a regular box along x, y and z"
    points_m = grid.points_m
    if points_m is None or points_m.ndim != 4:
        kind = "a plane or height map" if points_m is None else "points"
        raise ArgumentError("image", wanted, f"{kind} of shape {grid.shape}")
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
    return places_m


def _nearest(box: _Box, at: Sequence[float] | None) -> dict[str, int]:
    """Return the indices of the pixel nearest to a position, or of the brightest, by coordinate."""
    if at is None:
        brightest = np.unravel_index(box.level.argmax(), box.level.shape)
        return {name: int(index) for name, index in zip("zyx", brightest, strict=True)}
    place_m = validate.array("at", at, np.float64, (3,))
    found = {}
    for name, value in zip("xyz", place_m, strict=True):
        places = box.places_m[name]
        step = np.ptp(places) / max(len(places) - 1, 1)
        if not places[0] - step / 2 <= value <= places[-1] + step / 2:
            allowed = f"lie in the volume, {name} from {places[0]:g} to {places[-1]:g} m"
            raise ArgumentError("at", allowed, f"{value:g} m")
        found[name] = int(np.abs(places - value).argmin())
    return found
