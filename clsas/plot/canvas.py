"""What pictures share: figures and their files, axes in metres, scales of levels, and colours."""

from __future__ import annotations

import os
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.atomic import replacing
from clsas.engine.data.decibels import DYNAMIC_RANGE, DYNAMIC_RANGE_DB, REFERENCE
from clsas.engine.data.declared import Other, Span, check_fields
from clsas.engine.data.extras import needed
from clsas.engine.data.grid import Grid
from clsas.engine.data.validate import ArgumentError, ArgumentTypeError
from clsas.files.sidecars import remove_sidecars

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PathCollection
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

    from clsas.engine.data.georeference import Georeference

SUFFIXES = (".png", ".pdf", ".svg")
"""Suffixes of the files that `save` writes."""
PNG_DPI = 150.0
"""Default pixels per inch of PNG files, for screens."""
PADDING_IN = 0.1
"""Margin around labels and axes in inches."""
COLOUR_MAP = "inferno"
"""Default colour map, which is perceptually even from black to pale yellow."""
MOST_PIXELS = 1500
"""Most pixels drawn along an axis; pictures have fewer dots."""
COUNTED = 1 << 22
"""Most values from which percentiles are computed."""

_NAMES = {"x": "Along-track", "y": "Across-track", "z": "Height"}
_NAMES_ON_MAP = {"x": "Easting", "y": "Northing", "z": "Height"}
_LEAST_DPI, _MOST_DPI = 10.0, 10_000.0  # below 10, letters have no pixels
_VECTOR_DPI = 300.0  # for the images on a printed page
_SETTINGS: Any = {
    "pdf.fonttype": 42,  # TrueType: publishers refuse matplotlib's default, Type 3
    "svg.hashsalt": "clsas",  # the same picture gives the same file
}
_DATES = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}
_SAME_DB = 1e-3  # largest difference of levels that may come from rounding

# From black over copper to cream, as sidescan displays show sand. The colours lie at equal
# distances on a curve through CIELAB, with lightness from 1 to 96, hue from 50 to 88 degrees and
# chroma 42 sin(pi t)(1 - t/4) + 8 t^4, so that equal steps in dB look equally large. Differences
# between neighbouring colours (CIE76) are 0.8 to 1.3 times their mean. For matplotlib's "copper"
# they are 0.65 to 1.5 times the mean, and for "inferno" 0.5 to 1.7 times.
_SONAR = (
    "#040404", "#1b1008", "#29180d", "#381f11", "#482813", "#593317", "#6b401c", "#7e5025",
    "#916131", "#a27542", "#b28856", "#bf9b6c", "#ccad82", "#d7be9a", "#e3cfb2", "#eee1cb",
    "#fbf3e4",
)  # fmt: skip


def save(figure: Figure, path: str | os.PathLike, *, dpi: float | None = None) -> None:
    """Write a figure as PNG, PDF or SVG. An existing file is replaced in one step.

    Files beside it that put the old picture on a map (.pgw, .aux.xml) are removed.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
    path : path-like
        File to write. Its suffix determines the format: .png, .pdf or .svg; PNG without a suffix.
    dpi : float, optional
        Pixels per inch, by default 150 for PNG and 300 for PDF and SVG. In PDF and SVG this applies
        only to images: lines and labels have no pixels.

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    TypeError, ValueError
        If `figure` is not a Figure, `path` has another suffix, or `dpi` is not a number from 10 to
        10 000.
    OSError
        If the folder does not exist or the file cannot be written.
    """
    validate.instance("figure", figure, figure_class())
    path = validate.path("path", path)
    validate.suffix("path", path, *SUFFIXES)
    kind = path.suffix.lower().removeprefix(".") or "png"
    if dpi is None:
        dpi = PNG_DPI if kind == "png" else _VECTOR_DPI
    dpi = validate.number("dpi", dpi, "pixels per inch", least=_LEAST_DPI, most=_MOST_DPI)
    import matplotlib as mpl

    options: Any = {"metadata": _DATES[kind]} if kind in _DATES else {}
    drawn = BytesIO()  # if a file cannot grow, Matplotlib's writer of PDF hides the reason
    with mpl.rc_context(_SETTINGS):
        # "tight" includes labels that the layout leaves outside, such as those of square axes.
        figure.savefig(
            drawn, format=kind, dpi=dpi, bbox_inches="tight", pad_inches=PADDING_IN, **options
        )
    with replacing(path) as temporary:
        temporary.write_bytes(drawn.getbuffer())
    remove_sidecars(path)


def save_png(figure: Figure, path: str | os.PathLike, *, dpi: float | None = None) -> None:
    """Write a figure as PNG; `save` also writes PDF and SVG.

    Raises
    ------
    ImportError, TypeError, OSError
        As for `save`.
    ValueError
        If `path` has another suffix than .png, or `dpi` is not a number from 10 to 10 000.
    """
    validate.instance("figure", figure, figure_class())
    validate.suffix("path", validate.path("path", path), ".png")
    save(figure, path, dpi=dpi)


def figure_class() -> type[Figure]:
    """Return matplotlib's class of figures.

    Raises
    ------
    ImportError
        If matplotlib is not installed; the message says how to install it.
    """
    with needed("pictures"):
        from matplotlib.figure import Figure
    return Figure


def new_figure(
    width_in: float, height_in: float, layout: Literal["constrained", "compressed"] = "constrained"
) -> Figure:
    """Return a figure that belongs to no window."""
    return figure_class()(figsize=(width_in, height_in), layout=layout)


def length_unit(length_m: float) -> tuple[float, str]:
    """Return the factor and unit in which lengths are shown: millimetres if below half a metre."""
    return (1e3, "mm") if length_m < 0.5 else (1.0, "m")


def axis_label(name: str, unit: str, of: str = "", place: Georeference | None = None) -> str:
    """Return the label of an axis, such as "Along-track (m)".

    Parameters
    ----------
    name : str
        Name of a `clsas.engine.data.grid.Axis`: "x", "y" or "z", "along columns" or "along rows".
    unit : str
    of : str
        Words for the origin, as in "Along-track from the peak (mm)".
    place : Georeference, optional
        Where the axes lie on Earth; x and y of a map projection are easting and northing.
    """
    names = _NAMES_ON_MAP if place is not None and place.is_projected else _NAMES
    return " ".join(filter(None, (names.get(name, f"Distance {name}"), of, f"({unit})")))


def drawable(name: str, value: object) -> str:
    """Return a text that matplotlib can draw; raise TypeError or ValueError for others.

    Text between dollar signs must be valid mathematics, and control characters have no glyphs.
    """
    with needed("pictures"):
        from matplotlib import cbook
        from matplotlib.mathtext import MathTextParser

    given = validate.text(name, value)
    if cbook.is_math_text(given):
        try:
            MathTextParser("path").parse(given)
        except ValueError as error:
            reason = str(error).splitlines()[-1]
            raise ArgumentError(name, "be text or valid mathematics", hint=reason) from None
    return given


def plain_ticks(axes: Axes) -> None:
    """Let axes show whole coordinates, however far the origin is, and only as many as fit."""
    # The locator is a subclass of matplotlib's, which is imported late.
    from clsas.plot.ticks import FittingLocator

    axes.ticklabel_format(style="plain", useOffset=False)
    axes.xaxis.set_major_locator(FittingLocator())
    axes.yaxis.set_major_locator(FittingLocator())


def grid_unit(grid: Grid) -> tuple[float, str]:
    """Return the factor and unit in which the coordinates of a plane or height map are shown."""
    return length_unit(max(float(np.abs(side.places_m).max()) for side in grid.sides))


def grid_extent(grid: Grid) -> tuple[float, float, float, float]:
    """Return the outer edges of the pixels of a grid on a picture: left, right, bottom, top."""
    factor, _ = grid_unit(grid)
    across, upward = (factor * side.places_m for side in grid.sides)
    return (*edges(across, upward), *edges(upward, across))


def label_grid(axes: Axes, grid: Grid) -> None:
    """Label axes with the coordinates of a grid, whose pixels are drawn in their true shape."""
    _, unit = grid_unit(grid)
    xlabel, ylabel = (axis_label(side.name, unit, place=grid.georeference) for side in grid.sides)
    axes.set(xlabel=xlabel, ylabel=ylabel, aspect="equal" if min(grid.shape) > 1 else "auto")


def edges(axis: NDArray, other: NDArray) -> tuple[float, float]:
    """Return the outer edges of the pixels along an axis.

    A single pixel is as wide as those of the other axis.
    """
    step = next((a[1] - a[0] for a in (axis, other) if len(a) > 1), 1.0)
    return axis[0] - step / 2, axis[-1] + step / 2


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
        some = level.ravel()[:: -(-level.size // COUNTED)]
        some = some[np.isfinite(some)]
        if not some.size:
            return -DYNAMIC_RANGE_DB, 0.0
        low, high = np.percentile(some, self.percentiles).tolist()
        return min(low, high - 1.0), high  # colours need a range even if all pixels are equal


def draw_levels(
    axes: Axes,
    level: NDArray[np.float32],
    extent: tuple[float, float, float, float],
    scale: Scale,
    bar: str | None = "right",
    limits: tuple[float, float] | None = None,
) -> AxesImage:
    """Draw levels [upward, across] in dB over `extent` (left, right, bottom, top).

    The colour bar is drawn on the side `bar` of the axes, "right" or "bottom"; None draws none.
    `limits` are the levels of the first and the last colour, by default those of the scale.
    """
    low, high = limits or scale.limits(level)
    greatest = level  # of the pixels that share a dot, since a mean would hide points
    for axis in (0, 1):
        count = level.shape[axis]
        first = np.linspace(0, count, min(count, MOST_PIXELS), endpoint=False).astype(int)
        greatest = np.maximum.reduceat(greatest, first, axis)
    drawn = axes.imshow(
        np.maximum(greatest, low),
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


def colour_map(name: str | Colormap) -> Colormap:
    """Return a colour map.

    Parameters
    ----------
    name : str or matplotlib.colors.Colormap
        "sonar" (black, copper, cream; perceptually even), a name that matplotlib knows, such as
        "inferno", "gray" or "cividis", or a colour map.

    Raises
    ------
    TypeError, ValueError
        If `name` is neither a known name nor a colour map.
    """
    with needed("pictures"):
        from matplotlib import colormaps
        from matplotlib.colors import Colormap, LinearSegmentedColormap

    if isinstance(name, Colormap):
        return name
    if not isinstance(name, str):
        raise ArgumentTypeError("colour_map", "be a name or a `Colormap`", validate.shown(name))
    if name == "sonar":
        return LinearSegmentedColormap.from_list("sonar", _SONAR, 256)
    if name not in colormaps:
        raise ArgumentError(
            "colour_map",
            "be 'sonar' or one of matplotlib's, such as 'inferno', 'gray', 'copper' or 'cividis'",
            validate.shown(name),
        )
    return colormaps[name]
