"""Figures, axes in metres or millimetres, and files of pictures."""

from __future__ import annotations

import os
from io import BytesIO
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from clsas.engine.data import validate
from clsas.engine.data.atomic import replacing
from clsas.engine.data.extras import needed
from clsas.engine.data.validate import ArgumentError
from clsas.files.sidecars import remove_sidecars

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from clsas.engine.data.georeference import Georeference

SUFFIXES = (".png", ".pdf", ".svg")
"""Suffixes of the files that `save` writes."""
PNG_DPI = 150.0
"""Default pixels per inch of PNG files, for screens."""
PADDING_IN = 0.1
"""Margin around labels and axes in inches."""

_NAMES = {"x": "Along-track", "y": "Across-track", "z": "Height"}
_NAMES_ON_MAP = {"x": "Easting", "y": "Northing", "z": "Height"}
_LEAST_DPI, _MOST_DPI = 10.0, 10_000.0  # below 10, letters have no pixels
_VECTOR_DPI = 300.0  # for the images on a printed page
_SETTINGS: Any = {
    "pdf.fonttype": 42,  # TrueType: publishers refuse matplotlib's default, Type 3
    "svg.hashsalt": "clsas",  # the same picture gives the same file
}
_DATES = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}


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


def with_palette(png: BytesIO, palette: NDArray[np.uint8]) -> bytes:
    """Return a PNG whose pixels have the nearest of up to 256 colours, uint8 [colours, 3].

    Unlike with `with_fewer_colours`, colours of few pixels are kept.
    """
    from PIL import Image

    with Image.open(png) as picture:
        pixels = np.asarray(picture.convert("RGB"))
    nearest = KDTree(palette).query(pixels)[1].astype(np.uint8)
    reduced = Image.fromarray(nearest)
    reduced.putpalette(palette.tobytes())
    written = BytesIO()
    reduced.save(written, format="png", optimize=True)
    return written.getvalue()


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
    from clsas.plot.ticks import FittingLocator

    axes.ticklabel_format(style="plain", useOffset=False)
    axes.xaxis.set_major_locator(FittingLocator())
    axes.yaxis.set_major_locator(FittingLocator())
