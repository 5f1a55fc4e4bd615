"""What the figures share: colours, boxes, arrows, and SVG files that are the same every time."""

from __future__ import annotations

import matplotlib

matplotlib.use("agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

INK, BLUE, TEAL, ORANGE, RED, PALE = (
    "#22303c",
    "#2f6f9f",
    "#2a9d8f",
    "#e08e2b",
    "#c0443c",
    "#eef3f6",
)

plt.rcParams.update(
    {
        "svg.hashsalt": "clsas",
        "font.size": 10,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "text.color": INK,
        "axes.labelcolor": INK,
        "figure.constrained_layout.use": True,
    }
)


def canvas(width_in: float, height_in: float) -> tuple[Figure, Axes]:
    """Return a figure with one axes of inches, without ticks."""
    figure, axes = plt.subplots(figsize=(width_in, height_in), layout="none")
    figure.subplots_adjust(0, 0, 1, 1)
    axes.set(xlim=(0, width_in), ylim=(0, height_in))
    axes.axis("off")
    return figure, axes


def box(
    axes: Axes,
    corner: tuple[float, float],
    size: tuple[float, float],
    title: str,
    text: str = "",
    *,
    colour: str = BLUE,
    code: bool = False,
) -> None:
    """Draw a box with a title and, below it, smaller text."""
    (x, y), (width, height) = corner, size
    axes.add_patch(
        matplotlib.patches.FancyBboxPatch(
            (x, y),
            width,
            height,
            boxstyle="round,pad=0,rounding_size=0.08",
            fc=PALE,
            ec=colour,
            lw=1.5,
        )
    )
    family = "monospace" if code else "sans-serif"
    middle = x + width / 2
    if text:
        axes.text(
            middle, y + height - 0.1, title, ha="center", va="top", weight="bold", family=family
        )
        axes.text(
            middle, y + height - 0.36, text, ha="center", va="top", size=8.5, linespacing=1.35
        )
    else:
        axes.text(
            middle, y + height / 2, title, ha="center", va="center", weight="bold", family=family
        )


def arrow(
    axes: Axes,
    start: tuple[float, float],
    end: tuple[float, float],
    label: str = "",
    *,
    colour: str = INK,
    style: str = "-|>",
    offset: tuple[float, float] = (0.0, 0.08),
) -> None:
    """Draw an arrow with a label beside its middle."""
    axes.annotate("", end, start, arrowprops={"arrowstyle": style, "color": colour, "lw": 1.4})
    if label:
        x, y = (start[0] + end[0]) / 2 + offset[0], (start[1] + end[1]) / 2 + offset[1]
        axes.text(x, y, label, ha="center", va="bottom", size=8.5, family="monospace", color=colour)


def save(figure: Figure, name: str) -> None:
    """Write a figure into the present folder, without the date."""
    if name.endswith(".svg"):
        figure.savefig(name, metadata={"Date": None})
    else:
        figure.savefig(name, dpi=100)
