"""Errors and amplitudes in decibels; the power of errors adds. Deviations from medians."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.declared import Number

DYNAMIC_RANGE_DB = 60.0
"""Default dynamic range of a picture, in dB below the reference."""
DYNAMIC_RANGE = Number(
    "dB",
    above=0.0,
    most=2000.0,
    help="Dynamic range of the picture.",
    default=f"{DYNAMIC_RANGE_DB:g}",
)
"""Declares the dynamic range of a picture, which float32 amplitudes can span."""
REFERENCE = Number(above=0.0, help="Amplitude of 0 dB.", default="1 for db, otherwise the largest")
"""Declares the amplitude to which levels are relative."""

DEVIATION_PER_MEDIAN = 1.482602
"""Standard deviation over the median magnitude of normal errors."""

NO_ERROR_DB = -300.0
"""Level of a power of 0."""
_FLOOR = 1e-30  # the same as a power
_Number = TypeVar("_Number", float, NDArray[np.float64])


def power(error_db: float) -> float:
    """Return the power of a relative rms error."""
    return 10 ** (error_db / 10)


def amplitude(level_db: float) -> float:
    """Return the amplitude of a level."""
    return 10 ** (level_db / 20)


def in_db(power: _Number) -> _Number:
    """Return a relative rms error, or a level, from its power; at least -300 dB."""
    if isinstance(power, np.ndarray):
        return 10 * np.log10(np.maximum(power, _FLOOR))
    return 10 * math.log10(max(power, _FLOOR))


def largest_amplitude(values: NDArray) -> float:
    """Return the largest amplitude of real or complex values, even if it exceeds float32."""
    scale, amplitude = _scaled_amplitude(values)
    return scale * float(amplitude.max())


def level_db(values: NDArray, reference: float | None = None) -> NDArray[np.float32]:
    """Return amplitudes relative to a reference in dB, minus infinity where they are 0.

    Parameters
    ----------
    values : ndarray, real or complex
    reference : float, optional
        Amplitude of 0 dB. The default is the largest amplitude of the values.

    Raises
    ------
    TypeError, ValueError
        If `reference` is not a positive number.
    """
    if reference is not None:
        reference = validate.positive("reference", reference)
    scale, amplitude = _scaled_amplitude(values)
    if not scale:
        return np.full(amplitude.shape, -np.inf, np.float32)
    if reference is None:
        unit_db = 20 * math.log10(float(amplitude.max()))
    else:  # the quotient of two extreme numbers may overflow
        unit_db = 20 * (math.log10(reference) - math.log10(scale))
    with np.errstate(divide="ignore"):
        level = np.log10(amplitude, out=amplitude)
    level *= np.float32(20)
    level -= np.float32(unit_db)
    return level


def _scaled_amplitude(values: NDArray) -> tuple[float, NDArray[np.float32]]:
    """Return a scale and the amplitudes divided by it, so that no square over- or underflows."""
    parts = np.ascontiguousarray(values)
    if parts.dtype.kind == "c":
        parts = parts.view(parts.real.dtype)
    scale = max(float(parts.max()), -float(parts.min()))
    if not scale:
        return 0.0, np.zeros(values.shape, np.float32)
    scaled = np.divide(parts, parts.dtype.type(scale)).view(values.dtype)
    return scale, np.abs(scaled).astype(np.float32, copy=False)
