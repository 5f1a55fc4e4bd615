"""Pictures of images and mosaics, in dB over metres."""

from __future__ import annotations

import base64
import math
import os
import textwrap
from collections.abc import Sequence
from html import escape
from io import BytesIO
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from clsas.engine.data import validate
from clsas.engine.data.declared import Number, check_declared
from clsas.engine.data.extras import is_installed
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image, prediction
from clsas.engine.data.reprs import quantity
from clsas.engine.data.validate import ArgumentError
from clsas.measures.quality import on_axes
from clsas.mosaics.levels import COARSEST_SIDE
from clsas.plot.canvas import (
    COLOUR_MAP,
    COUNTED,
    Scale,
    add_colour_bar,
    colour_map,
    draw_levels,
    drawable,
    figure_class,
    grid_extent,
    grid_unit,
    label_grid,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

    from clsas.mosaics.store import Store

_WIDTH_IN = 7.0  # width of figures; about the height of those that are higher than wide
_FLAT = 0.4  # height relative to width, below which the colour bar is drawn below an image
_PREVIEW_IN, _PREVIEW_DPI = 4.5, 96.0  # for 10 to 100 kB in a notebook
_PREVIEW_LEVELS, _PREVIEW_GREYS = 208, 48  # 0.3 dB each over 60 dB, and 48 for letters
_BAR = 0.25  # largest length of a scale bar relative to the width of the axes: a plain choice
_ARROW = 0.1  # length of the arrow relative to the shorter side: a plain choice
_LETTERS_PER_IN, _LEAST_LETTERS = 9, 40  # in a line of a caption, by the width of the figure
_HORIZONTAL = 1e-6  # least part of a step that must be horizontal
_LIGHT: Any = {"color": "white", "fontweight": "bold", "fontsize": "small"}
_PANEL_IN, _LEAST_PANEL_IN = 4.3, 1.7  # largest and smallest width of each of two images
_HIGHEST_IN = 8.0  # largest height of each of two images
_AROUND = 32  # pixels on either side of a position by default, along the coarser axis
_ROUNDING = 1e-6  # of a step, so that a pixel at the very end is drawn


def image(
    image: Image,
    axes: Axes | None = None,
    *,
    dynamic_range_db: float | None = None,
    percentiles: tuple[float, float] | None = None,
    reference: float | None = None,
    colour_map: str | Colormap = COLOUR_MAP,
    colour_bar: bool = True,
    north_arrow: bool = False,
    scale_bar: bool = False,
    caption: bool = False,
    title: str = "",
) -> Axes:
    """Draw the amplitude of an image in dB over metres or millimetres.

    Parameters
    ----------
    image : Image
        Image on a plane of any direction or a height map. The axes show the coordinates along
        columns and rows: x and y of a horizontal plane, x and z of a vertical one, and distances
        along columns and rows of other planes. If the georeference is a map projection, x is
        labelled as easting and y as northing. Units are millimetres if all coordinates are below
        0.5 m, otherwise metres. Columns and rows are always drawn at right angles.
    axes : matplotlib.axes.Axes, optional
        Axes to draw into; by default those of a new pyplot figure, which notebooks and
        `pyplot.show` display.
    dynamic_range_db : float, optional
        Level of the first colour below that of the last one, which is the reference; by default
        60 dB.
    percentiles : (low, high), optional
        Percentiles, from 0 to 100, that the colours span instead of `dynamic_range_db`. Pixels that
        are 0 do not count. With (1, 99.5), speckle is visible beside bright targets.
    reference : float, optional
        Amplitude that is 0 dB; by default the largest of the image.
    colour_map : str or matplotlib.colors.Colormap
        "sonar" (black, copper, cream), or a name that matplotlib knows. "inferno", "sonar",
        "cividis" and "gray" are perceptually even: equal steps in dB look equally large.
    colour_bar : bool
        True to draw the scale of levels beside the axes.
    north_arrow, scale_bar : bool
        True to draw an arrow to the north, which needs a georeference, and a bar of a round length.
    caption : bool
        True to write below the image how large its error is: as measured, or else as predicted.
    title : str
        Title above the axes.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError, ValueError
        If an argument has the wrong type or is out of bounds, the image has arbitrary points
        (`volume` draws those of a box), `north_arrow` is set for an image without a georeference or
        on a vertical plane, or `caption` for one whose error is not known.

    See Also
    --------
    image_db : Draw an image in a figure that belongs to no window.
    Image.plot : The same as a method.
    """
    validate.instance("image", image, Image)
    if image.grid.points_m is not None:
        raise ArgumentError("image", "be on a plane or height map to be drawn", "points")
    scale = Scale(dynamic_range_db, percentiles, reference, colour_map)
    for name, flag in {
        "colour_bar": colour_bar, "north_arrow": north_arrow, "scale_bar": scale_bar,
        "caption": caption,
    }.items():  # fmt: skip
        validate.flag(name, flag)
    title = drawable("title", title)
    figure_class()  # raises if matplotlib is missing
    from matplotlib.axes import Axes

    if axes is None:
        from matplotlib import pyplot

        axes = pyplot.figure(figsize=_size_in(image), layout="compressed").subplots()
    validate.instance("axes", axes, Axes)
    side = ("bottom" if _height_per_width(image) < _FLAT else "right") if colour_bar else None
    draw_levels(axes, image.db(reference=reference), grid_extent(image.grid), scale, side)
    label_grid(axes, image.grid)
    axes.set_title(title)
    if north_arrow:
        _draw_north(axes, image.grid)
    if scale_bar:
        _draw_scale_bar(axes, 1 / grid_unit(image.grid)[0])
    if caption:
        _write_caption(axes, image)
    return axes


def image_db(image: Image, *, title: str = "", **options: Any) -> Figure:
    """Draw the amplitude of an image in dB, in a figure that belongs to no window.

    Parameters
    ----------
    image, title
        As for `image`.
    **options
        Further arguments of `image`: `dynamic_range_db`, `percentiles`, `reference`, `colour_map`,
        `colour_bar`, `north_arrow`, `scale_bar` and `caption`.

    Raises
    ------
    ImportError, TypeError, ValueError
        As for `image`.

    Examples
    --------
    >>> import clsas
    >>> import numpy as np
    >>> grid = clsas.Grid.plane((0.0, 2.0, 21), (20.0, 21.0, 11))
    >>> figure = clsas.plot.image_db(clsas.Image(np.ones(grid.shape, complex), grid))
    >>> figure.axes[0].get_xlabel()
    'Along-track (m)'
    """
    validate.instance("image", image, Image)
    figure = new_figure(*_size_in(image), layout="compressed")
    _draw_image(image, figure.subplots(), title=title, **options)
    return figure


_draw_image = image  # for functions with an argument `image`


def image_html(image: Image) -> str:
    """Return an image as HTML for notebooks: a small picture and a summary.

    The picture is a PNG within the HTML. There is only the summary if matplotlib is not installed,
    or the image has arbitrary points.

    Raises
    ------
    TypeError
        If `image` is not an Image.
    """
    validate.instance("image", image, Image)
    text = f"<pre>{escape(repr(image))}</pre>"
    if image.grid.points_m is not None or not is_installed("matplotlib"):
        return text
    figure = new_figure(*_size_in(image, _PREVIEW_IN), layout="compressed")
    axes = _draw_image(image, figure.subplots())
    axes.get_images()[0].set_interpolation_stage("data")  # mixed colours are not in the palette
    drawn = BytesIO()
    figure.savefig(drawn, format="png", dpi=_PREVIEW_DPI, bbox_inches="tight")
    shades = np.linspace(0, 1, _PREVIEW_GREYS)[:, None].repeat(3, axis=1)
    colours = [colour_map(COLOUR_MAP)(np.linspace(0, 1, _PREVIEW_LEVELS))[:, :3], shades]
    palette = np.rint(255 * np.concatenate(colours)).astype(np.uint8)
    # The nearest colours of a palette keep colours of few pixels, unlike other ways to reduce them.
    from PIL import Image as Picture

    with Picture.open(drawn) as picture:
        pixels = np.asarray(picture.convert("RGB"))
    reduced = Picture.fromarray(KDTree(palette).query(pixels)[1].astype(np.uint8))
    reduced.putpalette(palette.tobytes())
    small = BytesIO()
    reduced.save(small, format="png", optimize=True)
    encoded = base64.b64encode(small.getvalue()).decode()
    return f'<div><img alt="Amplitude in dB" src="data:image/png;base64,{encoded}">{text}</div>'


def _write_caption(axes: Axes, image: Image) -> None:
    """Write the error of an image below its axes."""
    formed = image.formed
    if formed is None or (formed.certificate is None and formed.predicted_error_db is None):
        raise ArgumentError("caption", "be off for an image whose error is not known")
    text = prediction(formed.predicted_error_db)
    if formed.certificate is not None:
        text = formed.certificate.describe(formed.tolerance_db)
    # As a part of the label, whose width does not change the layout of narrow images.
    letters = max(int(_LETTERS_PER_IN * _size_in(image)[0]), _LEAST_LETTERS)
    lines = [axes.get_xlabel(), *textwrap.wrap(text.replace("-", "−"), letters)]
    axes.set_xlabel("\n".join(lines))


def _draw_north(axes: Axes, grid: Grid) -> None:
    """Draw an arrow into the upper right corner: to true north, or to the north of the map."""
    from matplotlib.patheffects import withStroke

    if grid.georeference is None:
        raise ArgumentError("north_arrow", "be off for an image without a georeference")
    north = (
        grid.georeference.from_map([0.0, 1.0, 0.0])[:2]
        - grid.georeference.from_map([0.0, 0.0, 0.0])[:2]
    )
    # Axes that show a coordinate ascend with it. Other axes show distances from the first pixel.
    shown = []
    for axis, step_m in zip(grid.sides, (grid.vectors_m[2], grid.vectors_m[1]), strict=True):
        if len(axis.name) == 1:
            step_m = np.eye(3)["xyz".index(axis.name)]
        length = math.hypot(*step_m[:2])
        if length <= _HORIZONTAL * np.linalg.norm(step_m):
            raise ArgumentError("north_arrow", "be off for a vertical image")
        shown.append(step_m[:2] / length)
    along = np.stack(shown) @ north  # to the right and up
    along /= np.hypot(*along)
    width, height = axes.get_window_extent().size
    size = _ARROW * min(width, height) / np.array([width, height])
    middle = 1 - 1.4 * size
    tip, tail = (tuple((middle + sign * along * size).tolist()) for sign in (1, -1))
    outline = [withStroke(linewidth=3, foreground="black")]
    drawn = axes.annotate(
        "N", tail, tip, xycoords="axes fraction",
        textcoords="axes fraction", ha="center", va="center", path_effects=outline,
        arrowprops={"arrowstyle": "<|-", "color": "white", "path_effects": outline}, **_LIGHT,
    )  # fmt: skip
    drawn.set_in_layout(False)


def _draw_scale_bar(axes: Axes, metres_per_unit: float) -> None:
    """Draw a bar of 1, 2 or 5 times a power of ten metres into the lower left corner of axes."""
    from matplotlib.patheffects import withStroke

    first, last = sorted(axes.get_xlim())
    bottom, top = sorted(axes.get_ylim())
    most_m = _BAR * (last - first) * metres_per_unit
    power = 10.0 ** math.floor(math.log10(most_m))
    length_m = max(factor for factor in (1, 2, 5) if factor * power <= most_m) * power
    length = length_m / metres_per_unit
    left, low = first + 0.04 * (last - first), bottom + 0.05 * (top - bottom)
    outline = [withStroke(linewidth=4, foreground="black")]
    bar: Any = {
        "color": "white",
        "linewidth": 2.5,
        "solid_capstyle": "butt",
        "path_effects": outline,
    }
    axes.plot([left, left + length], [low, low], **bar)
    axes.annotate(
        quantity(length_m, "m"), (left + length / 2, low), (0, 4), textcoords="offset points",
        ha="center", va="bottom", path_effects=outline, **_LIGHT,
    )  # fmt: skip


def _size_in(image: Image, width_in: float = _WIDTH_IN) -> tuple[float, float]:
    """Return the size of a figure in inches that an image and its labels fill."""
    high = _height_per_width(image)
    if high < _FLAT:  # with the colour bar below
        return width_in, max((width_in - 1.2) * high, 0.5) + 1.7
    axes_in = min(width_in - 1.9, width_in / high)
    return axes_in + 1.9, axes_in * high + 0.9


def _height_per_width(image: Image) -> float:
    """Return the height of an image relative to its width; 0.75 for single lines and points."""
    if image.grid.points_m is not None or min(image.shape) == 1:
        return 0.75
    across_m, upward_m = (abs(s.step_m) * len(s.places_m) for s in image.grid.sides)
    return upward_m / across_m


def mosaic(
    store: Store | str | os.PathLike,
    *,
    most: int = COARSEST_SIDE,
    borders: bool = False,
    **options: Any,
) -> Figure:
    """Draw an overview of a mosaic in dB over metres.

    Parameters
    ----------
    store : Store or path
        The mosaic on disk.
    most : int
        Most pixels along the longer side of the overview. Each is the rms of the pixels of the
        mosaic that it covers.
    borders : bool
        True to draw the borders of the patches.
    **options
        Further arguments of `clsas.plot.image_db`.

    Raises
    ------
    ImportError
        If matplotlib or Zarr is not installed.
    TypeError, ValueError
        If an argument has the wrong type or is out of bounds, the store is damaged, or the mosaic
        has arbitrary points.
    OSError
        If the store does not exist or cannot be read.
    """
    from clsas.mosaics.store import Store

    if not isinstance(store, Store):
        store = Store.opened(validate.path("store", store))
    validate.flag("borders", borders)
    most = validate.count("most", most)
    figure = image_db(store.overview(most), **options)
    if borders and store.patch_shape is not None:
        patch_borders(figure.axes[0], store.grid, store.patch_shape)
    return figure


def patch_borders(axes: Axes, grid: Grid, patch_shape: tuple[int, int]) -> None:
    """Draw the borders between patches into axes that show an image or overview of a grid.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
        Axes that `clsas.plot.image` drew into.
    grid : Grid
        Grid of the whole mosaic, such as `Mosaic.grid`.
    patch_shape : (rows, columns)
        Pixels of a patch, such as `Mosaic.patch_shape`.

    Raises
    ------
    TypeError, ValueError
        If `grid` is not a plane or height map, or a side of `patch_shape` is not a positive
        integer.
    """
    from matplotlib.axes import Axes

    validate.instance("axes", axes, Axes)
    validate.instance("grid", grid, Grid)
    across, upward = grid.sides
    factor, _ = grid_unit(grid)
    rows, columns = validate.sides("patch_shape", patch_shape)
    for side, every, draw in ((across, columns, axes.axvline), (upward, rows, axes.axhline)):
        for first in range(every, len(side.places_m), every):
            place = factor * (side.places_m[first] - side.step_m / 2)
            draw(place, color="white", linewidth=0.6, alpha=0.7)


def before_and_after(before: Image, after: Image, **options: Any) -> Figure:
    """Draw an image before and after the correction of its track, with a common scale of levels.

    Parameters
    ----------
    before, after : Image
        Images on the same grid.
    **options
        Further arguments of `image`: `dynamic_range_db`, `percentiles` and `colour_map`.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError, ValueError
        If an argument has the wrong type, or the images differ in shape.
    """
    for name, image in (("before", before), ("after", after)):
        validate.instance(name, image, Image)
        if image.grid.points_m is not None:
            raise ArgumentError(name, "be on a plane or height map to be drawn", "points")
    if before.shape != after.shape:
        raise ArgumentError(
            "after", f"have the pixels of `before`, {before.shape}", str(after.shape)
        )
    largest = max(float(np.abs(each.pixels).max()) for each in (before, after)) or 1.0
    scale = Scale(reference=largest, **options)
    high = _height_per_width(before)
    # Narrow images leave room for titles and labels beside each other.
    axes_in = min(_PANEL_IN, _HIGHEST_IN / high)
    narrow = axes_in < _LEAST_PANEL_IN
    between = "\n" if narrow else " "
    labels_in = 2.2 if high < _FLAT else 1.5
    size_in = 2 * max(axes_in, _LEAST_PANEL_IN) + 2.0, max(axes_in * high, 0.5) + labels_in
    figure = new_figure(*size_in, layout="constrained" if narrow else "compressed")
    panels: NDArray[Any] = figure.subplots(1, 2, sharex=True, sharey=True)
    levels = np.stack([each.db(reference=largest) for each in (before, after)])
    limits = scale.limits(levels)
    for axes, image, level, title in zip(
        panels, (before, after), levels, ("Before", "After"), strict=True
    ):
        draw_levels(axes, level, grid_extent(image.grid), scale, bar=None, limits=limits)
        label_grid(axes, image.grid)
        peak = float(np.abs(image.pixels).max()) / largest
        shown = f"peak {20 * np.log10(peak):.1f} dB".replace("-", "−") if peak else "image is zero"
        axes.set_title(f"{title}:{between}{shown}")
    panels[-1].set_ylabel("")
    add_colour_bar(
        panels[-1].images[0], scale, levels, label="Amplitude (dB re larger peak)",
        ax=panels, location="bottom" if high < _FLAT else "right", aspect=30,
    )  # fmt: skip
    return figure


def amplitude_at(
    values: NDArray,
    percentile: Annotated[
        float,
        Number(
            "%",
            above=0.0,
            most=100.0,
            help="Percentile of the amplitudes that are not 0 to draw at 0 dB.",
            default="100, the largest",
        ),
    ],
) -> float | None:
    """Return a percentile of the amplitudes that are not 0, or None if all are 0.

    Of very many values, some all over the array are taken.
    """
    flat = values.reshape(-1)
    some = np.abs(flat[:: -(-flat.size // COUNTED)])
    some = some[some > 0]
    return float(np.percentile(some, percentile)) if some.size else None


def window_around(
    grid: Grid,
    near: Sequence[float],
    extent_m: Annotated[
        float | None,
        Number(
            "m",
            above=0.0,
            help="The distance on either side that is drawn.",
            default=f"{_AROUND} pixels",
        ),
    ] = None,
) -> tuple[slice, slice]:
    """Return the rows and columns of a grid within a distance of a position.

    Parameters
    ----------
    grid : Grid
        A plane or height map.
    near : (float, float) or (float, float, float)
        Coordinates on the axes of the grid, along columns and rows, or a position x, y, z; metres.
    extent_m : float, optional
        Distance on either side of it, metres; 32 pixels by default.

    Raises
    ------
    TypeError, ValueError
        If `near` lies outside the grid or is not two or three numbers, or `extent_m` is not
        positive.
    """
    axes = grid.sides
    place_m = on_axes(grid, axes, near)
    if extent_m is None:
        extent_m = _AROUND * max(abs(axis.step_m) for axis in axes) or 1.0
    check_declared(window_around, {"extent_m": extent_m})
    parts = []
    for axis, at_m in zip(axes, place_m, strict=True):
        distance_m = np.abs(axis.places_m - at_m)
        nearest = int(distance_m.argmin())
        ends_m = sorted((axis.places_m[0], axis.places_m[-1]))
        step_m = abs(axis.step_m)
        if not ends_m[0] - step_m / 2 <= at_m <= ends_m[1] + step_m / 2:
            allowed = f"be inside the image, {axis.name} from {ends_m[0]:g} to {ends_m[1]:g} m"
            raise ArgumentError("near", allowed, f"{at_m:g} m")
        inside = np.flatnonzero(distance_m <= extent_m + _ROUNDING * step_m)
        first, last = (inside[0], inside[-1]) if len(inside) else (nearest, nearest)
        parts.append(slice(int(first), int(last) + 1))
    columns, rows = parts
    return rows, columns
