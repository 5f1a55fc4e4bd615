"""Errors in decibels, and their power, which adds."""

from __future__ import annotations

import math


def power(error_db: float) -> float:
    """Return the power of a relative rms error."""
    return 10 ** (error_db / 10)


def in_db(power: float) -> float:
    """Return a relative rms error from its power."""
    return 10 * math.log10(max(power, 1e-30))
