"""Inputs of a measurement of heights, with the geometry that follows from them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.grid import Grid, without_heights
from clsas.interferometry.baseline import Baseline
from clsas.interferometry.pair import Pair


@dataclass(frozen=True, eq=False)
class Task:
    """Two banks, a grid, and the heights above it at which the seabed may lie.

    Attributes
    ----------
    pair : Pair
    grid : Grid
        A plane, or a height map from which the search starts.
    search_m : (lowest, highest)
        Heights above the pixels of the grid.
    least_coherence : float
        Smallest coherence of a valid height.
    baseline : Baseline
        How the banks see the grid.
    relative_band : float
        Bandwidth over the frequency in its middle.
    ambiguity_m : float
        Height of ambiguity.
    """

    pair: Pair
    grid: Grid
    search_m: tuple[float, float]
    least_coherence: float
    baseline: Baseline
    relative_band: float
    ambiguity_m: float

    @property
    def plane(self) -> Grid:
        """The plane above which heights are measured."""
        return without_heights(self.grid)

    @property
    def start_m(self) -> NDArray[np.float64]:
        """Heights of the grid above its plane, [rows, columns]."""
        return np.zeros(self.grid.shape) if self.grid.height_m is None else self.grid.height_m

    @property
    def level_m(self) -> float:
        """Mean of `start_m`."""
        return float(self.start_m.mean())

    @property
    def level(self) -> Grid:
        """The plane raised by `level_m`, without the slopes of a height map."""
        origin_m, _, _ = self.grid.vectors_m
        return replace(self.plane, origin_m=origin_m + [0.0, 0.0, self.level_m])
