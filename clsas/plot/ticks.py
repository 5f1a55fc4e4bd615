"""Ticks whose labels fit. This module imports matplotlib, so it is imported late."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import rcParams, ticker
from matplotlib.font_manager import FontProperties
from numpy.typing import NDArray

_MOST_BINS = 8
_DIGIT_EM = 0.66  # width of a digit in em, rounded up
_GAP_EM = 0.8  # least distance of two labels in em


class FittingLocator(ticker.MaxNLocator):
    """Locator of 1 to 9 ticks at round numbers, as many as have room for their labels.

    The number depends on the size of the axes at the time they are drawn, so that it also suits
    resized figures.
    """

    def __init__(self) -> None:
        super().__init__(nbins=_MOST_BINS, steps=(1, 2, 2.5, 5, 10))

    def tick_values(self, vmin: float, vmax: float) -> Any:
        """Return the coordinates of the ticks between the ends of an axis."""
        for bins in range(_MOST_BINS, 0, -1):
            self.set_params(nbins=bins)
            places = np.asarray(super().tick_values(vmin, vmax))
            if self._fit(places, vmin, vmax):
                return places
        low, high = sorted((vmin, vmax))
        inside = places[(places >= low) & (places <= high)]
        return inside[:1]

    def _fit(self, places: NDArray[np.float64], vmin: float, vmax: float) -> bool:
        """Return True if labels at some coordinates do not overlap."""
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
