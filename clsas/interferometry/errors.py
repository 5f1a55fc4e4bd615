"""The exception for banks and grids that do not show heights."""

from __future__ import annotations


class UnmeasurableError(ValueError):
    """Two banks do not show the heights of a grid, as the message explains."""
