"""Doubts about the cycles of the phase between two banks, which a measurement of heights reports.

The phase cannot show that the seabed lies outside the search, but the magnitude of the coherence
falls with the distance from the seabed. Averaged over an image, it does so clearly, even within a
sixth of a cycle.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from clsas.engine.data import validate
from clsas.engine.data.grid import Grid
from clsas.interferometry.coherence import Window
from clsas.interferometry.sweep import Sweep

BEYOND = {"lower": "below", "upper": "above"}
"""Where the seabed seems to lie if the banks agree best at an end of the search."""


class Doubts(NamedTuple):
    """Signs that cycles of the phase may be wrong.

    Attributes
    ----------
    end : {"lower", "upper"} or None
        End of the search at which the banks agree best.
    large_m : float or None
        Side of the windows that decide between cycles, metres, if the grid is smaller.
    ambiguity_m : float
        Height of ambiguity.
    """

    end: str | None
    large_m: float | None
    ambiguity_m: float

    def warn(self) -> None:
        """Warn of each."""
        if self.large_m is not None:
            validate.warn(
                f"`grid` is smaller than the windows of {self.large_m:.2g} m that tell heights "
                f"apart which differ by the height of ambiguity, {self.ambiguity_m:.3g} m, where "
                "the coherence is low: make the grid larger or `search_m` smaller"
            )
        if self.end is not None:
            beyond = BEYOND[self.end]
            validate.warn(
                f"`search_m` may not contain the seabed: the banks agree best at its {self.end} "
                f"end, so that most of the seabed seems to lie {beyond} it. Heights may be wrong "
                f"by multiples of the height of ambiguity, {self.ambiguity_m:.3g} m: search "
                f"farther {beyond}"
            )


def larger_m(grid: Grid, large: Window) -> float | None:
    """Return the side of windows that decide between cycles, m, if they are larger than a grid."""
    if large.rows <= grid.shape[0] and large.columns <= grid.shape[1]:
        return None
    return large.rows * float(np.linalg.norm(grid.vectors_m[1]))


def end_of(found: Sweep) -> str | None:
    """Return the end of the search at which the banks agree best; one height beyond was imaged."""
    best = int(found.profile.argmax())
    if 0 < best < len(found.profile) - 1:
        return None
    return "lower" if best == 0 else "upper"
