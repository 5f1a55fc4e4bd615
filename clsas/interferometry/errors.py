"""The exception for banks and grids that do not show heights."""

from __future__ import annotations

from clsas.engine.data.validate import ArgumentError


class UnmeasurableError(ArgumentError):
    """Two banks do not show the heights of a grid, as the message explains."""
