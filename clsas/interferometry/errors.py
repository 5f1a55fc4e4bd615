"""The error of banks and grids that allow no heights."""

from __future__ import annotations


class UnmeasurableError(ValueError):
    """Two banks do not show the heights of a grid, as the message explains."""
