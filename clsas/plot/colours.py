"""Colour maps of pictures: those of matplotlib, and one with the colours of sonar displays."""

from __future__ import annotations

from typing import TYPE_CHECKING

from clsas.engine.data import validate
from clsas.engine.data.extras import needed
from clsas.engine.data.validate import ArgumentError, ArgumentTypeError

if TYPE_CHECKING:
    from matplotlib.colors import Colormap

COLOUR_MAP = "inferno"
"""Default colour map, which is perceptually even from black to pale yellow."""

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
