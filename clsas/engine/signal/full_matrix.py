"""Range lines of a full matrix capture, in which every element transmits and all receive."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from clsas.engine.data import validate
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.engine.signal.compression import Window, compress, least_bandwidth_hz
from clsas.engine.signal.echoes import Echoes


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
        Positions of the elements, metres.
    sample_rate_hz : float
        Sample rate, hertz.
    carrier_hz : float
        Centre frequency of the elements, hertz.
    sound_speed_m_s : float
        Speed of the waves in the material, metres per second.
    start_time_s : float
        Time of the first sample after the start of transmission, seconds.
    pairs : pair of array_like of int, [pairs], optional
        Numbers, from 0, of the transmitting and the receiving element of every line, for samples of
        shape [pairs, time].
    bandwidth_hz, window, oversampling
        As for `compress`. No pulse is needed, because the pulses of such arrays are short. The
        default band is twice the carrier, and the default window is zero at both ends of it, which
        removes constants.

    Returns
    -------
    RangeLines
        One line per pair, in the order of the samples. A pair whose reverse is not among the pairs
        counts twice, because by reciprocity it also represents its reverse.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or shape or is outside its limits, a pair names an element
        that does not exist, or a pair occurs twice.

    See Also
    --------
    read_full_matrix : Reader of captures in MATLAB files.

    Examples
    --------
    An array of 4 elements, 0.3 mm apart, at 5 MHz:

    >>> import clsas
    >>> import numpy as np
    >>> elements_m = 0.3e-3 * np.array([[n, 0, 0] for n in range(4)])
    >>> lines = clsas.from_full_matrix(
    ...     np.zeros((4, 4, 400)), elements_m,
    ...     sample_rate_hz=50e6, carrier_hz=5e6, sound_speed_m_s=6300.0,
    ... )
    >>> lines.samples.shape, f"{1e3 * lines.last_range_m[0]:.2f} mm"
    ((16, 160), '25.04 mm')
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
            raise ArgumentError("pairs", "be two arrays of elements", len(both))
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
        raise ArgumentError(
            "carrier_hz",
            f"be at most a quarter of the sample rate, {rate_hz / 4:g} Hz, for a band of twice the "
            "carrier",
            f"{carrier_hz:g} Hz",
            f"give `bandwidth_hz`, at most {rate_hz - 2 * carrier_hz:g} Hz",
        )
    least = least_bandwidth_hz(samples.shape[-1], rate_hz)
    if bandwidth_hz is None and 2 * carrier_hz < least:
        raise ArgumentError(
            "carrier_hz",
            f"be at least {least / 2:.4g} Hz for a band of twice the carrier and samples of "
            f"{samples.shape[-1] / rate_hz:.4g} s",
            f"{carrier_hz:g} Hz",
        )
    last_s = abs(start_s) + samples.shape[-1] / rate_hz
    validate.phase(carrier_hz, speed, speed / 2 * last_s)
    numbers = tx * count + rx
    if (kinds := len(np.unique(numbers))) < len(numbers):
        given = f"{kinds} different ones of {len(numbers)}"
        raise ArgumentError("pairs", "differ from each other", given)
    alone = (tx != rx) & ~np.isin(rx * count + tx, numbers)
    lines = compress(
        Echoes(
            samples,
            start_time_s=np.array(start_s),
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
        allowed = f"be whole numbers, one per line ({length})"
        raise ArgumentError("pairs", allowed, f"shape {numbers.shape}")
    return numbers
