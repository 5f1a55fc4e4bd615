"""Wavelengths of range lines.

Lines have two wavelengths. Element patterns, and beams that correct for them, use the wavelength of
the carrier, `wavelength_m`; it is infinite for lines that still have their carrier. Lengths such as
a track error or the spacing of channels are compared with the wavelength in the middle of the
occupied band, `band_wavelength_m`, which does not depend on what was mixed out.
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.lines import RangeLines

Number = TypeVar("Number", float, NDArray[np.float64])
_LEAST_CYCLES = 0.02  # per sample, at the middle of a band that shows the carrier


def wavelength_m(lines: RangeLines) -> float:
    """Return the wavelength of the carrier, metres; infinite for lines without a carrier."""
    return lines.sound_speed_m_s / lines.carrier_hz if lines.carrier_hz else math.inf


def band_wavelength_m(lines: RangeLines, centre: float) -> float:
    """Return the wavelength in the middle of the band that lines occupy, metres.

    Lines whose band lies about 0 Hz do not show their carrier. Their wavelength is that of the
    highest frequency sampled.

    Parameters
    ----------
    lines : RangeLines
    centre : float
        Middle of the band, cycles per sample: `Spectrum.centre`, or that of a plan's lines.
    """
    if is_about_zero(lines, centre):
        return 4 * lines.range_step_m
    return 2 / abs(cycles_per_m_at(lines, centre))


def wavelength_between_m(lines: RangeLines, low_hz: float, high_hz: float) -> float:
    """Return the wavelength at the mean frequency of a band, metres.

    All frequencies count as positive. The mean is that of the ends, unless the band reaches below
    0 Hz: the middle of such a band is arbitrary, and the wavelength there could be infinite.

    Parameters
    ----------
    lines : RangeLines
    low_hz, high_hz : float
        Ends of the band in the recorded signal, before `carrier_hz` was mixed out.
    """
    if low_hz * high_hz >= 0:
        mean_hz = abs(low_hz + high_hz) / 2
    else:
        mean_hz = (low_hz**2 + high_hz**2) / (2 * (high_hz - low_hz))
    return lines.sound_speed_m_s / mean_hz


def is_about_zero(lines: RangeLines, centre: float) -> bool:
    """Return whether a band lies so close to 0 Hz that it does not show the lines' carrier."""
    return abs(cycles_per_m_at(lines, centre)) * lines.range_step_m <= _LEAST_CYCLES


def cycles_per_m_at(lines: RangeLines, frequency: Number) -> Number:
    """Return the two-way phase per metre of range, cycles.

    Parameters
    ----------
    lines : RangeLines
    frequency : float or float64 array
        Frequency in the samples, cycles per sample.
    """
    return lines.carrier_cycles_per_m + frequency / lines.range_step_m
