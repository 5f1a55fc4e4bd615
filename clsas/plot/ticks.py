"""Ticks whose labels fit: imported with matplotlib, when a picture is drawn."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import rcParams, ticker
from matplotlib.font_manager import FontProperties
from numpy.typing import NDArray

_MOST_BINS = 8
_DIGIT_EM = 0.66  # width of a digit, amply
_GAP_EM = 0.8  # between two labels


class FittingLocator(ticker.MaxNLocator):
    """At most 9 ticks at round numbers, and no more than have room for their labels, one at least.

    The number follows the size of the axes when they are drawn, so it stays right when a figure
    is resized.
    """

    def __init__(self) -> None:
        super().__init__(nbins=_MOST_BINS, steps=(1, 2, 2.5, 5, 10))

    def tick_values(self, vmin: float, vmax: float) -> Any:
        """Return the places of the ticks between two ends of an axis."""
        for bins in range(_MOST_BINS, 0, -1):
            self.set_params(nbins=bins)
            places = np.asarray(super().tick_values(vmin, vmax))
            if self._fit(places, vmin, vmax):
                return places
        low, high = sorted((vmin, vmax))
        inside = places[(places >= low) & (places <= high)]
        return inside[:1]

    def _fit(self, places: NDArray[np.float64], vmin: float, vmax: float) -> bool:
        """Return whether labels at some places lie beside each other."""
        if len(places) < 2:
            return True
        axis: Any = self.axis
        figure, box = axis.axes.get_figure(root=True), axis.axes.get_window_extent()
        usual: Any = rcParams
        size = usual[f"{axis.axis_name}tick.labelsize"]
        size = axis.get_tick_params().get("labelsize", size)
        em = FontProperties(size=size).get_size_in_points()
        pitch = abs(places[1] - places[0]) / abs(vmax - vmin) * 72 / figure.dpi
        if axis.axis_name != "x":
            return pitch * box.height >= (1 + _GAP_EM) * em
        longest = max(map(len, axis.get_major_formatter().format_ticks(places)))
        return pitch * box.width >= (longest * _DIGIT_EM + _GAP_EM) * em
