"""Inputs of a measurement of heights, with the geometry that follows from them."""

from __future__ import annotations

from dataclasses import dataclass

from clsas.core.grid import Grid
from clsas.interferometry.baseline import Baseline
from clsas.interferometry.pair import Pair


@dataclass(frozen=True, eq=False)
class Task:
    """Two banks, a plane, and the heights above it at which the seabed may lie.

    Attributes
    ----------
    pair : Pair
    grid : Grid
        The plane.
    search_m : (lowest, highest)
        Heights above the plane.
    least_coherence : float
        Smallest coherence of a valid height.
    baseline : Baseline
        How the banks see the plane.
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
