"""Range lines from samples over frequency, such as phase histories of dechirped pulses."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from clsas.engine.data import validate
from clsas.engine.data.fourier import FFT_BLOCK, fourier_series, turned
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.threads import cores
from clsas.engine.data.validate import ArgumentError
from clsas.engine.signal.compression import OVERSAMPLING, Window, band_window

_LEAST_OF_BAND = 1e-2
"""Lowest frequency over the width of the band, below which a unit is probably wrong. The ratio is
0.03 for radars that look into the ground, and 1e-9 of the right one for GHz mistaken for Hz."""
# Phase error, cycles, at the ends of a line up to which one common frequency step is used. The
# error of the image is then -104 dB.
_EQUAL_STEPS = 1e-6
_SUM_ERROR_DB = -180.0  # of sums over frequencies with steps of their own


def from_phase_history(
    samples: ArrayLike,
    *,
    first_frequency_hz: ArrayLike,
    frequency_step_hz: ArrayLike,
    reference_range_m: ArrayLike,
    tx_m: ArrayLike,
    rx_m: ArrayLike,
    sound_speed_m_s: float,
    band_hz: ArrayLike | None = None,
    window: Window = "none",
    oversampling: float = 2.0,
    sign: int = -1,
) -> RangeLines:
    """Return range lines of samples over frequency, such as those of motion-compensated radar.

    A point of amplitude A at range rho gives A exp(sign j 4 pi f (rho - r0)/c) at the frequency f.
    Range and phase are both relative to r0, the reference range of the channel.

    Parameters
    ----------
    samples : array_like of complex, [channels, frequencies]
        Frequency response of every channel, with at least 2 frequencies.
    first_frequency_hz, frequency_step_hz : float or array_like, [channels]
        Frequency of the first sample, as transmitted, and the step between samples, hertz. One
        number applies to all channels.
    reference_range_m : float or array_like, [channels]
        Reference range r0 (half the two-way path) of each channel, metres; 0 if phases are
        absolute.
    tx_m, rx_m : array_like, [channels, 3] or [3]
        Transmitter and receiver positions, metres.
    sound_speed_m_s : float
        Speed of the waves, metres per second; 299 792 458 m/s for radar.
    band_hz : array_like, [2] or [channels, 2], optional
        Lowest and highest frequency of the pulse, hertz. Samples outside contain only noise, and
        are left out. By default the pulse has all frequencies.
    window : str, float or tuple
        Window over the band: "none", or a window of `scipy.signal.get_window`.
    oversampling : float
        Number of samples per line over number of frequencies, 1 to 10 000. The spectrum is padded
        with zeros.
    sign : {-1, +1}
        Sign of the phase in `samples` as range grows.

    Returns
    -------
    RangeLines
        Lines of one period c/(2 step), centred on the reference range. Their carrier is the mean
        of the bands' centres. Amplitudes are those of the samples. With a sign of +1 the samples
        are conjugated, so that A becomes its conjugate.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or shape, is not finite or outside its limits, or the
        lines do not fit into memory.

    Warns
    -----
    ClsasWarning
        If the lowest frequency is less than a hundredth of the band, or a reference range is
        negative.

    Notes
    -----
    With the carrier fc, and weights w of each channel with the sum 1, the lines are

        s(r) = exp(-j 4 pi fc r0/c) sum_m w_m S_m exp(j 4 pi (f_m - fc)(r - r0)/c),

    so that a point gives A p(r - rho) exp(-j 2 k rho), k = 2 pi fc/c. Phases of reference ranges
    are computed in float64. A line is periodic: echoes from beyond one end appear at the other.
    `RangeLines.tapered_ends` fades the ends, where lines cannot be interpolated well.

    Examples
    --------
    64 frequencies, 1 MHz apart, make lines of 150 m, here centred on a range of 1 km:

    >>> import clsas
    >>> import numpy as np
    >>> lines = clsas.from_phase_history(
    ...     np.ones((2, 64), complex), first_frequency_hz=9.5e9, frequency_step_hz=1e6,
    ...     reference_range_m=1000.0, tx_m=[0, 0, 1000], rx_m=[0, 0, 1000],
    ...     sound_speed_m_s=299_792_458,
    ... )
    >>> lines.samples.shape, f"{lines.first_range_m[0]:.1f} to {lines.last_range_m[0]:.1f} m"
    ((2, 128), '925.1 to 1073.8 m')
    """
    samples = validate.array("samples", samples, np.complex64, (None, None))
    channels, count = samples.shape
    if count < 2:
        raise ArgumentError("samples", "have at least 2 frequencies", count)
    sign = validate.one_of("sign", sign, (-1, 1))
    oversampling = OVERSAMPLING.check("oversampling", oversampling)
    speed = validate.number(
        "sound_speed_m_s", sound_speed_m_s, "m/s", above=0.0, most=validate.MOST_M_S
    )
    first_hz = _frequencies("first_frequency_hz", first_frequency_hz, channels)
    step_hz = _frequencies("frequency_step_hz", frequency_step_hz, channels)
    reference_m = validate.array(
        "reference_range_m", reference_range_m, np.float64, (channels,), broadcast=True
    )
    weigh = band_window(window, 1.0)
    band_hz = _bands(band_hz, first_hz, step_hz, count)
    validate.memory("oversampling", 8 * channels * oversampling * count)
    length = fft.next_fast_len(math.ceil(oversampling * count))
    equal = np.ptp(step_hz) * count <= _EQUAL_STEPS * step_hz.min()
    # The longest line that is not longer than the period of any channel.
    range_step_m = float(speed / (2 * length * step_hz.max()))
    offset_m = (np.arange(length) - length // 2) * range_step_m
    carrier_hz = float(np.mean(band_hz))
    farthest_m = float(np.abs(reference_m).max() - offset_m[0])
    validate.phase(carrier_hz, speed, farthest_m)
    _warn_of_slips(first_hz, step_hz * (count - 1), reference_m)
    centre = (band_hz.mean(axis=1) - first_hz) / step_hz
    width = np.ptp(band_hz, axis=1) / step_hz

    lines = np.empty((channels, length), np.complex64)
    rows = max(1, FFT_BLOCK // length)
    for first in range(0, channels, rows):
        block = slice(first, first + rows)
        spectrum = samples[block].astype(np.complex128)
        place = (np.arange(count) - centre[block, None]) / width[block, None]
        weights = np.where(np.abs(place) <= 0.5 + 1e-9, weigh(np.clip(place, -0.5, 0.5)), 0.0)
        total = weights.sum(axis=1, keepdims=True)
        if not np.abs(total).min() > 0:
            given = validate.shown(window)
            raise ArgumentError("window", "have a sum other than 0", given)
        spectrum = (spectrum if sign == -1 else spectrum.conj()) * (weights / total)
        if equal:
            part = fft.fftshift(length * fft.ifft(spectrum, length, workers=cores()), axes=1)
        else:
            part = _at_own_steps(spectrum, step_hz[block] / step_hz.max(), length)
        cycles = np.multiply.outer(2 * (first_hz[block] - carrier_hz) / speed, offset_m)
        cycles -= (2 * carrier_hz / speed * reference_m[block])[:, None]
        lines[block] = part * turned(cycles)
    return RangeLines(
        lines,
        first_range_m=reference_m + offset_m[0],
        range_step_m=range_step_m,
        tx_m=tx_m,
        rx_m=rx_m,
        carrier_hz=carrier_hz,
        sound_speed_m_s=speed,
    )


def _warn_of_slips(
    first_hz: NDArray[np.float64], band_hz: NDArray[np.float64], reference_m: NDArray[np.float64]
) -> None:
    """Warn of frequencies and ranges that are possible but hardly ever intended."""
    low = int(np.argmin(first_hz / band_hz))
    if first_hz[low] < _LEAST_OF_BAND * band_hz[low]:
        validate.warn(
            f"`first_frequency_hz` is {first_hz[low]:g} Hz, less than 1/{1 / _LEAST_OF_BAND:g} of "
            f"the band of {band_hz[low]:g} Hz: is it in Hz (not GHz), as transmitted (not after "
            "mixing)?"
        )
    if reference_m.min() < 0:
        validate.warn(
            f"`reference_range_m` is negative, {reference_m.min():g} m at least: ranges are at "
            "least half the distance from transmitter to receiver"
        )


def _bands(
    band_hz: ArrayLike | None,
    first_hz: NDArray[np.float64],
    step_hz: NDArray[np.float64],
    count: int,
) -> NDArray[np.float64]:
    """Return the lowest and highest frequency of every channel's pulse among the samples."""
    sampled_hz = np.stack([first_hz, first_hz + (count - 1) * step_hz], axis=1)
    if band_hz is None:
        return sampled_hz
    given = validate.array("band_hz", band_hz, np.float64, (len(first_hz), 2), broadcast=True)
    band = np.clip(given, sampled_hz[:, :1], sampled_hz[:, 1:])
    narrow = np.flatnonzero(~(np.diff(band)[:, 0] >= step_hz))
    if narrow.size:
        low, high = given[narrow[0]]
        raise ArgumentError(
            "band_hz",
            "ascend and contain at least 2 sampled frequencies of every channel",
            f"{low:g} to {high:g} Hz for channel {narrow[0]}, sampled from "
            f"{sampled_hz[narrow[0], 0]:g} to {sampled_hz[narrow[0], 1]:g} Hz",
        )
    return band


def _frequencies(name: str, value: ArrayLike, channels: int) -> NDArray[np.float64]:
    """Return one frequency per channel, each greater than 0."""
    array = validate.array(name, value, np.float64, (channels,), broadcast=True)
    validate.number(name, array.min(), "Hz", above=0.0)
    validate.number(name, array.max(), "Hz", most=validate.MOST_HZ)
    return array


def _at_own_steps(
    spectrum: NDArray[np.complex128], ratio: NDArray[np.float64], length: int
) -> NDArray[np.complex128]:
    """Return the sum over m of S_m exp(j 2 pi m n ratio/length), n from -length/2, per channel."""
    cycles = (np.arange(length) - length // 2) / length
    rows = zip(spectrum, ratio, strict=True)
    return np.stack([fourier_series(line, scale * cycles, _SUM_ERROR_DB) for line, scale in rows])
