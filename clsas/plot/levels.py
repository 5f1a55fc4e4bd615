"""Pictures of images and range lines, as levels in dB."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from html import escape
from io import BytesIO
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.decibels import DYNAMIC_RANGE, DYNAMIC_RANGE_DB, REFERENCE, level_db
from clsas.engine.data.declared import Number, Other, Span, check_fields
from clsas.engine.data.extras import is_installed
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.plot.canvas import (
    axis_label,
    drawable,
    figure_class,
    length_unit,
    new_figure,
    plain_ticks,
    with_palette,
)
from clsas.plot.colours import COLOUR_MAP, colour_map
from clsas.plot.map_marks import draw_north, draw_scale_bar

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PathCollection
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

FLAT = 0.4
"""Height relative to width, below which the colour bar is drawn below an image."""

_MOST_PIXELS = 1500  # pixels drawn along an axis; pictures have fewer dots
_SAME_DB = 1e-3  # largest difference of levels that may come from rounding
_COUNTED = 1 << 22  # most pixels from which percentiles are computed
_WIDTH_IN = 7.0  # width of figures; about the height of those that are higher than wide
_PREVIEW_IN, _PREVIEW_DPI = 4.5, 96.0  # for 10 to 100 kB in a notebook
_PREVIEW_LEVELS, _PREVIEW_GREYS = 208, 48  # 0.3 dB each over 60 dB, and 48 for letters


@dataclass(frozen=True)
class Scale:
    """Levels and colours of a picture. The fields are arguments of `image`."""

    dynamic_range_db: Annotated[float | None, DYNAMIC_RANGE] = None
    percentiles: Annotated[
        tuple[float, float] | None,
        Span(
            "%",
            least=0.0,
            most=100.0,
            help="Let the colours span these percentiles of the levels instead.",
        ),
    ] = None
    reference: Annotated[float | None, REFERENCE] = None
    colour_map: Annotated[
        Any,
        Other(
            lambda _, name: name,  # checked when it is used, which needs Matplotlib
            help="Colours of the picture: sonar (black, copper, cream), gray, cividis or any other "
            "colour map of Matplotlib.",
        ),
    ] = COLOUR_MAP

    def __post_init__(self) -> None:
        """Check and convert all fields but the colours."""
        check_fields(self)
        if self.percentiles is not None and self.dynamic_range_db is not None:
            raise ArgumentError("percentiles", "be left out if `dynamic_range_db` is given")

    @property
    def label(self) -> str:
        """Label of the colour bar."""
        if self.reference is None:
            return "Amplitude (dB re max)"
        return f"Amplitude (dB re {self.reference:g})"

    def limits(self, level: NDArray[np.float32]) -> tuple[float, float]:
        """Return the levels of the first and of the last colour, in dB."""
        if self.percentiles is None:
            return -(self.dynamic_range_db or DYNAMIC_RANGE_DB), 0.0
        some = level.ravel()[:: -(-level.size // _COUNTED)]
        some = some[np.isfinite(some)]
        if not some.size:
            return -DYNAMIC_RANGE_DB, 0.0
        low, high = np.percentile(some, self.percentiles).tolist()
        return min(low, high - 1.0), high  # colours need a range even if all pixels are equal


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
    some = np.abs(flat[:: -(-flat.size // _COUNTED)])
    some = some[some > 0]
    return float(np.percentile(some, percentile)) if some.size else None


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
        (`volume` draws those of a box), or `north_arrow` is set for an image without a georeference
        or on a vertical plane.

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
    }.items():  # fmt: skip
        validate.flag(name, flag)
    title = drawable("title", title)
    figure_class()  # raises if matplotlib is missing
    from matplotlib.axes import Axes

    if axes is None:
        from matplotlib import pyplot

        axes = pyplot.figure(figsize=_size_in(image), layout="compressed").subplots()
    validate.instance("axes", axes, Axes)
    across, upward = image.grid.sides
    factor, unit = length_unit(max(float(np.abs(s.places_m).max()) for s in (across, upward)))
    places = factor * across.places_m, factor * upward.places_m
    extent = (*edges(*places), *edges(*reversed(places)))
    flat = height_per_width(image) < FLAT
    side = ("bottom" if flat else "right") if colour_bar else None
    draw_levels(axes, image.db(reference=reference), extent, scale, side)
    xlabel, ylabel = (
        axis_label(axis.name, unit, place=image.georeference) for axis in (across, upward)
    )
    axes.set(xlabel=xlabel, ylabel=ylabel, title=title)
    axes.set_aspect("equal" if min(image.shape) > 1 else "auto")
    if north_arrow:
        draw_north(axes, image.grid)
    if scale_bar:
        draw_scale_bar(axes, 1 / factor)
    return axes


def image_db(image: Image, *, title: str = "", **options: Any) -> Figure:
    """Draw the amplitude of an image in dB, in a figure that belongs to no window.

    Parameters
    ----------
    image, title
        As for `image`.
    **options
        Further arguments of `image`: `dynamic_range_db`, `percentiles`, `reference`, `colour_map`,
        `colour_bar`, `north_arrow` and `scale_bar`.

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
    picture = base64.b64encode(with_palette(drawn, palette)).decode()
    return f'<div><img alt="Amplitude in dB" src="data:image/png;base64,{picture}">{text}</div>'


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
    amplitude, first_m, last_m = aligned(lines.samples, lines.first_range_m, lines.range_step_m)
    extent = (-0.5, lines.channels - 0.5, first_m, last_m)
    figure = new_figure(_WIDTH_IN, 6.0)
    axes = figure.subplots()
    draw_levels(axes, level_db(amplitude, reference), extent, scale)
    axes.set(xlabel="Channel", ylabel="Range (m)", title=title, aspect="auto")
    return figure


def draw_levels(
    axes: Axes,
    level: NDArray[np.float32],
    extent: tuple[float, float, float, float],
    scale: Scale,
    bar: str | None = "right",
) -> AxesImage:
    """Draw levels [upward, across] in dB over `extent` (left, right, bottom, top).

    The colour bar is drawn on the side `bar` of the axes, "right" or "bottom"; None draws none.
    """
    low, high = scale.limits(level)
    drawn = axes.imshow(
        np.maximum(_greatest(level), low),
        cmap=colour_map(scale.colour_map),
        vmin=low,
        vmax=high,
        origin="lower",
        extent=extent,
    )
    axes.set(xlim=sorted(extent[:2]), ylim=sorted(extent[2:]))
    plain_ticks(axes)
    if bar is not None:
        slim = max(abs((extent[3] - extent[2]) / (extent[1] - extent[0])), 1.0)
        beside = {"fraction": min(0.1 * slim, 0.9), "pad": min(0.02 * slim, 0.4)}
        share = {"shrink": 0.8} if bar == "bottom" else beside
        add_colour_bar(drawn, scale, level, ax=axes, location=bar, aspect=30, **share)
    return drawn


def add_colour_bar(
    drawn: AxesImage | PathCollection, scale: Scale, level: NDArray[np.float32], **where: Any
) -> None:
    """Draw a colour bar. An end is pointed if there are levels beyond it."""
    pointed = {(True, True): "both", (True, False): "min", (False, True): "max"}
    low, high = drawn.get_clim()
    ends = bool(level.min() < low - _SAME_DB), bool(level.max() > high + _SAME_DB)
    extend = pointed.get(ends, "neither")
    figure: Any = drawn.get_figure()
    figure.colorbar(drawn, extend=extend, **{"label": scale.label, **where})


def edges(axis: NDArray, other: NDArray) -> tuple[float, float]:
    """Return the outer edges of the pixels along an axis.

    A single pixel is as wide as those of the other axis.
    """
    step = next((a[1] - a[0] for a in (axis, other) if len(a) > 1), 1.0)
    return axis[0] - step / 2, axis[-1] + step / 2


def _greatest(level: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the largest level of pixels that share a dot, since a mean would hide points."""
    for axis in (0, 1):
        count = level.shape[axis]
        first = np.linspace(0, count, min(count, _MOST_PIXELS), endpoint=False).astype(int)
        level = np.maximum.reduceat(level, first, axis)
    return level


def _size_in(image: Image, width_in: float = _WIDTH_IN) -> tuple[float, float]:
    """Return the size of a figure in inches that an image and its labels fill."""
    high = height_per_width(image)
    if high < FLAT:  # with the colour bar below
        return width_in, max((width_in - 1.2) * high, 0.5) + 1.7
    axes_in = min(width_in - 1.9, width_in / high)
    return axes_in + 1.9, axes_in * high + 0.9


def height_per_width(image: Image) -> float:
    """Return the height of an image relative to its width; 0.75 for single lines and points."""
    if image.grid.points_m is not None or min(image.shape) == 1:
        return 0.75
    across_m, upward_m = (abs(s.step_m) * len(s.places_m) for s in image.grid.sides)
    return upward_m / across_m


def aligned(
    samples: NDArray, first: NDArray[np.float64], step: float
) -> tuple[NDArray[np.float32], float, float]:
    """Return amplitudes [range or time, channel] on one axis, and that axis's outer edges.

    Parameters
    ----------
    samples : ndarray, [channels, length]
    first : ndarray, [channels]
        Range or time of the first sample of every channel.
    step : float
        Range or time between samples.
    """
    channels, length = samples.shape
    start = np.rint((first - first.min()) / step).astype(int)
    rows = int(start.max()) + length
    validate.memory("the picture", 12 * rows * channels)  # amplitudes, and levels with a copy
    amplitude = np.zeros((rows, channels), np.float32)
    for channel, (at, each) in enumerate(zip(start, samples, strict=True)):
        amplitude[at : at + length, channel] = np.abs(each)
    return amplitude, first.min() - step / 2, first.min() + (rows - 0.5) * step
