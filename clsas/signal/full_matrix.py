"""Range lines of a full matrix capture: every element transmits, all receive."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from clsas.core import validate
from clsas.core.lines import RangeLines
from clsas.signal.compression import Window, compress
from clsas.signal.echoes import Echoes


def from_full_matrix(
    samples: ArrayLike,
    elements_m: ArrayLike,
    *,
    sample_rate_hz: float,
    carrier_hz: float,
    sound_speed_m_s: float,
    start_time_s: float = 0.0,
    pairs: tuple[ArrayLike, ArrayLike] | None = None,
    bandwidth_hz: float | None = None,
    window: Window = "hann",
    oversampling: float = 2.0,
) -> RangeLines:
    """Return range lines of an array whose elements transmit in turn.

    Parameters
    ----------
    samples : array_like of float, [tx, rx, time] or [pairs, time]
        Real samples on their carrier.
    elements_m : array_like of float, [elements, 3]
        Positions of the elements.
    sample_rate_hz : float
        Samples per second.
    carrier_hz : float
        Centre frequency of the elements.
    sound_speed_m_s : float
        Speed of the waves in the material.
    start_time_s : float
        Time of the first sample after transmission began.
    pairs : pair of array_like of int, [pairs], optional
        Transmitting and receiving element of every line, from 0, for samples [pairs, time].
    bandwidth_hz, window, oversampling
        As in `compress`, without a pulse: pulses of an array are short. The band is twice the
        carrier by default, and the window is zero at both of its ends. It removes constants.

    Returns
    -------
    RangeLines
        One line per pair, in the order of the samples. A pair of two elements whose reverse is not
        among the pairs counts twice, since it stands for its reverse by reciprocity.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or shape or is outside its limits, or a pair names an
        element that does not exist or is there twice.
    """
    elements_m = validate.array("elements_m", elements_m, np.float64, (None, 3))
    count = len(elements_m)
    if pairs is None:
        samples = validate.array("samples", samples, np.float32, (count, count, None))
        tx, rx = np.indices((count, count)).reshape(2, -1)
        samples = samples.reshape(count * count, -1)
    else:
        samples = validate.array("samples", samples, np.float32, (None, None))
        both = validate.entries("pairs", pairs, "transmitting and receiving elements")
        if len(both) != 2:
            raise ValueError(f"pairs must be two arrays of elements, got {len(both)}")
        tx, rx = (_elements(each, len(samples), count) for each in both)
    rate_hz = validate.number(
        "sample_rate_hz", sample_rate_hz, "Hz", above=0.0, most=validate.MOST_HZ
    )
    speed = validate.number(
        "sound_speed_m_s", sound_speed_m_s, "m/s", above=0.0, most=validate.MOST_M_S
    )
    start_s = validate.number("start_time_s", start_time_s, "s")
    carrier_hz = validate.number("carrier_hz", carrier_hz, "Hz", above=0.0, below=rate_hz / 2)
    if bandwidth_hz is None and carrier_hz > rate_hz / 4:
        raise ValueError(
            f"carrier_hz must be at most a quarter of the sample rate, {rate_hz / 4:g} Hz, for a "
            f"band of twice the carrier, got {carrier_hz:g} Hz: give bandwidth_hz, at most "
            f"{rate_hz - 2 * carrier_hz:g} Hz"
        )
    last_s = abs(start_s) + samples.shape[-1] / rate_hz
    validate.phase(carrier_hz, speed, speed / 2 * last_s)
    numbers = tx * count + rx
    if len(np.unique(numbers)) < len(numbers):
        raise ValueError(f"pairs must differ, got {len(np.unique(numbers))} of {len(numbers)}")
    alone = (tx != rx) & ~np.isin(rx * count + tx, numbers)
    lines = compress(
        Echoes(
            samples,
            start_time_s=start_s,
            sample_rate_hz=rate_hz,
            carrier_hz=carrier_hz,
            tx_m=elements_m[tx],
            rx_m=elements_m[rx],
            sound_speed_m_s=speed,
        ),
        window=window,
        oversampling=oversampling,
        bandwidth_hz=2 * carrier_hz if bandwidth_hz is None else bandwidth_hz,
    )
    return lines.weighted(np.where(alone, 2.0, 1.0)) if alone.any() else lines


def _elements(given: ArrayLike, length: int, count: int) -> np.ndarray:
    numbers = validate.indices("every entry of pairs", given, count)
    if numbers.shape != (length,):
        raise ValueError(
            f"pairs must be whole numbers, one per line ({length}), got shape {numbers.shape}"
        )
    return numbers
