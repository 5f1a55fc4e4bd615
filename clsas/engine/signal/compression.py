"""Pulse compression: matched filter, basebanding, band window and resampling.

Equations in brackets are those of the thesis (Ødegaard 2004).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.interpolate import CubicSpline

from clsas.engine.data import validate
from clsas.engine.data.declared import Flag, Number, Other, check_declared
from clsas.engine.data.fourier import EDGE_PRODUCT, FFT_BLOCK, fourier_integral, smooth_edge, turned
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.system import Pulse
from clsas.engine.data.threads import cores
from clsas.engine.data.validate import ArgumentError
from clsas.engine.signal.echoes import Echoes
from clsas.engine.signal.replica import Replica

Window = str | float | tuple

OVERSAMPLING = Number(least=1.0, most=1e4, help="Samples of the lines per bandwidth.")
"""Declares the oversampling of lines. Its limit is arbitrary, far beyond what improves them."""

# Width, in bandwidths, of the edges that the band of the filter gets when the filter is truncated.
# They are wider if the filter would otherwise need a padding longer than this many recordings.
_BAND_EDGE = 0.1
_MOST_PADDING = 8
# Least product of bandwidth and duration of a recording. Below it, lines have one or two samples
# and lie within a tenth of a resolution cell. At half the value, the padding is twice as long.
_LEAST_PRODUCT = 0.1
# Power added to that of the pulse before the division by it, relative to the mean over the band.
# Codes need it, whose spectra have zeros. For a chirp of 150 cycles, values from 1e-4 to 0.1 give
# the same side lobes and noise to 0.1 dB.
_LEAST_POWER = 0.01
_PER_RIPPLE = 8  # frequencies per 1/T that measure the mean; arbitrary
# Model of the memory in use, fitted to measured peaks of 0.3 to 2 GiB, which it predicts to 30 %.
_FFT_LINES = 3  # twiddle factors and work area of an FFT, in lines of the transform's length
_BYTES_MIXED = 64  # per sample that is mixed to baseband
_BYTES_FILTERED = 160  # per frequency of the filter


def compress(
    echoes: Echoes,
    *,
    window: Annotated[Window, WINDOW] = "none",
    oversampling: Annotated[float, OVERSAMPLING] = 2.0,
    bandwidth_hz: float | None = None,
    replica: Replica | None = None,
    equalize: Annotated[
        bool,
        Flag("Remove the ripples of the pulse's spectrum, and the range side lobes they cause."),
    ] = False,
    progress: Callable[[int, int], None] | None = None,
) -> RangeLines:
    """Return the range lines of echoes, compressed by a matched filter or an equalizing one.

    Parameters
    ----------
    echoes : Echoes
        Complex baseband, or real passband, which is converted to the analytic signal and mixed to
        baseband.
    window : str, float or tuple
        Window over the band: "none", or a window of `scipy.signal.get_window`, such as "hamming",
        "taylor" or ("kaiser", 6.0).
    oversampling : float
        Sample rate of the lines over the bandwidth, 1 to 10 000. It is approximated to 1e-6 by a
        ratio of whole numbers, for which `range_step_m` of the result is exact.
    bandwidth_hz : float, optional
        Width of the band that is kept, centred on the carrier, hertz. The default is that of the
        pulse. It is required without a pulse, must lie within the sampled band of a replica, and
        must be at least 0.1 over the duration of the recording.
    replica : Replica, optional
        Measured pulse, which the matched filter uses instead of the nominal one of `echoes`.
    equalize : bool
        If True, remove the ripples of the pulse's spectrum, so that only the window shapes the
        band. With a matched filter, ripples of a chirp of the duration T cause side lobes up to
        c T/4 and more from bright echoes: 41 dB below them with 150 cycles (bandwidth times T) and
        a Hamming window. Equalized, they are 48 dB below, and the noise rises by 0.01 dB; without a
        window, it rises by 0.3 dB, and the side lobes of the band's edges remain.
    progress : callable, optional
        Called as progress(channels done, channels).

    Returns
    -------
    RangeLines
        Lines from the range of each channel's first sample to the last range whose pulse was
        recorded completely. A point of amplitude A has a peak of A with the phase
        exp(-j 2 pi fc tau) = exp(-j 2 k rho).

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is outside its limits, the band is not within the
        sampled band or too narrow for the recording, the recording is not longer than the pulse, or
        the lines do not fit into memory.

    See Also
    --------
    simulate : Echoes of a scene.
    from_full_matrix, from_phase_history : Range lines of other recordings.

    Notes
    -----
    The lines are y(t) = sum_n x(t_n) h(t - t_n)/fs, with

        h(t) = integral over the band of W(f) P*(f) exp(j 2 pi f t) df / integral of W |P|^2

    (Ødegaard 2004, equations [17] and [37]). P is the spectrum of the pulse or of the samples of
    the replica, and flat without a pulse. If the band is equalized, W is the window divided by
    |P|^2 + 0.01 mean |P|^2, where the second term, 20 dB below the mean over the band, keeps noise
    low where the pulse is weak. The sharp ends of the band make h infinitely long. The
    part of h that is as long as the recording is left unchanged, and the rest fades smoothly within
    the padding. The result is therefore exactly the linear convolution, without wrap-around.

    Examples
    --------
    An echo from 15 m, whose peak lies at sample 15 m / 12.5 mm of the line:

    >>> import clsas
    >>> import numpy as np
    >>> pulse = clsas.Pulse(carrier_hz=100e3, bandwidth_hz=30e3, duration_s=1e-3)
    >>> time_s = np.arange(2000) / 60e3
    >>> samples = pulse.envelope(time_s - 0.02)[None]
    >>> echoes = clsas.Echoes(samples, 0.0, 60e3, 100e3, [0, 0, 0], [0, 0, 0], 1500.0, pulse)
    >>> lines = clsas.compress(echoes, window="hamming")
    >>> peak = np.abs(lines.samples[0]).argmax()
    >>> f"peak at {lines.first_range_m[0] + peak * lines.range_step_m:.2f} m"
    'peak at 15.00 m'
    """
    validate.instance("echoes", echoes, Echoes)
    validate.progress(progress)
    options = {"window": window, "oversampling": oversampling, "equalize": equalize}
    check_declared(compress, options)
    if replica is not None:
        validate.instance("replica", replica, Replica)
    pulse, rate = replica or echoes.pulse, echoes.sample_rate_hz
    band = _band(echoes, bandwidth_hz, replica)
    weights = band_window(window, band)
    if equalize and pulse is not None:
        weights = _equalized(weights, pulse, band)
    duration = 0.0 if pulse is None else pulse.duration_s
    whole = echoes.length - 1 - duration * rate
    if whole < 0:
        given = f"{(echoes.length - 1) / rate:g} s"
        raise ArgumentError("echoes", f"be longer than the pulse ({duration:g} s)", given)

    edge = max(_BAND_EDGE * band, EDGE_PRODUCT * rate / (_MOST_PADDING * echoes.length))
    fade = EDGE_PRODUCT * rate / edge
    wanted = float(oversampling) * band / rate
    budget, cause = validate.Budget(), "oversampling" if wanted > 1 else "bandwidth_hz"
    budget.take(cause, 8 * echoes.channels * whole * wanted)
    # One padded channel before and after resampling. Their lengths may not fit into integers, so
    # this is checked before they are computed.
    budget.take(cause, 0, passing_bytes=32 * (echoes.length + fade) * (1 + wanted))
    ratio = _fraction(wanted)
    units = fft.next_fast_len(math.ceil(2 * (echoes.length + fade) / ratio.denominator))
    padded, resampled = units * ratio.denominator, units * ratio.numerator
    length = int(whole * ratio + 1e-9) + 1

    outermost = math.ceil((0.5 * band + edge) * padded / rate)
    # If the edges of the filter do not fit, compute more points, and keep one of `every`.
    every = -(-(2 * outermost + 1) // resampled)
    rows = min(max(1, FFT_BLOCK // max(padded, every * resampled)), echoes.channels)
    in_work = 16 * (rows + _FFT_LINES) * (padded + every * resampled)
    in_work += _BYTES_MIXED * rows * echoes.length + _BYTES_FILTERED * 2 * outermost
    budget.take(cause, 0, passing_bytes=in_work)
    bins = np.arange(-outermost, outermost + 1)
    response = _filter_response(
        pulse, band, edge, weights, bins, padded / rate, echoes.length / rate
    )
    response *= every * resampled / padded

    samples = np.empty((echoes.channels, length), np.complex64)
    for first in range(0, echoes.channels, rows):
        block = slice(first, first + rows)
        spectrum = fft.fft(_baseband(echoes, block), padded, workers=cores())
        lines = np.zeros((len(spectrum), every * resampled), np.complex128)
        lines[:, bins] = spectrum[:, bins % padded] * response
        lines = fft.ifft(lines, workers=cores(), overwrite_x=True)
        samples[block] = lines[:, : every * length : every]
        if progress is not None:
            progress(min(first + rows, echoes.channels), echoes.channels)

    return RangeLines(
        samples,
        first_range_m=echoes.sound_speed_m_s / 2 * echoes.start_time_s,
        range_step_m=echoes.sound_speed_m_s / (2 * rate) / float(ratio),
        tx_m=echoes.tx_m,
        rx_m=echoes.rx_m,
        carrier_hz=echoes.carrier_hz,
        sound_speed_m_s=echoes.sound_speed_m_s,
        rx_velocity_m_s=echoes.rx_velocity_m_s,
        look_direction=echoes.look_direction,
        georeference=echoes.georeference,
        bank_numbers=echoes.bank_numbers,
        sound_speed=echoes.sound_speed,
    )


def _checked_window(name: str, window: Window) -> Window:
    """Return a window if SciPy has it; a list, as TOML has them, becomes a tuple."""
    band_window(window, 1.0)
    return tuple(window) if isinstance(window, list) else window


WINDOW = Other(_checked_window, help="Window over the band, such as hamming or taylor.")
"""Declares the window over the band of lines."""


def band_window(
    window: Window, bandwidth_hz: float
) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Return a window as a function of frequency from -bandwidth/2 to bandwidth/2.

    Parameters
    ----------
    window : str, float or tuple
        "none", or a window of `scipy.signal.get_window`. Its 4097 symmetric samples are
        interpolated by cubic splines.
    bandwidth_hz : float
        Width of the band, hertz.

    Raises
    ------
    ValueError
        If SciPy has no such window, or it is not finite.
    """
    if isinstance(window, str) and window == "none":
        return np.ones_like
    from scipy.signal import get_window  # slow to import

    window = tuple(window) if isinstance(window, list) else window
    count = 4097
    try:
        if not isinstance(window, (str, tuple)):  # SciPy would accept True as a number
            window = validate.number("it", window)
        values = get_window(window, count, fftbins=False)
    except (ValueError, TypeError, IndexError) as error:
        allowed = "be 'none' or a window of SciPy, such as 'hamming', 'hann' or 'taylor'"
        given = validate.shown(window)
        raise ArgumentError("window", allowed, given, str(error)) from None
    values = validate.array("window", values, np.float64, (count,))
    nodes = np.linspace(-bandwidth_hz / 2, bandwidth_hz / 2, count)
    if not np.diff(nodes).min() > 0:
        raise ArgumentError("bandwidth_hz", "be wider for a window", f"{bandwidth_hz:g} Hz")
    return CubicSpline(nodes, values)


def _band(echoes: Echoes, bandwidth_hz: float | None, replica: Replica | None) -> float:
    if bandwidth_hz is None:
        if echoes.pulse is None:
            raise ArgumentError("bandwidth_hz", "be given for echoes without a pulse")
        bandwidth_hz = echoes.pulse.bandwidth_hz
    limit = echoes.sample_rate_hz
    if echoes.is_passband:
        limit = min(2 * echoes.carrier_hz, limit - 2 * echoes.carrier_hz)
        if limit <= 0:
            half = f"half the sample rate, {echoes.sample_rate_hz / 2:g} Hz"
            allowed = f"be between 0 and {half}, for real echoes"
            raise ArgumentError("carrier_hz", allowed, f"{echoes.carrier_hz:g} Hz")
    if replica is not None:
        limit = min(limit, replica.sample_rate_hz)
    band = validate.number("bandwidth_hz", bandwidth_hz, "Hz", above=0.0, most=limit)
    least = least_bandwidth_hz(echoes.length, echoes.sample_rate_hz)
    if band < least:
        raise ArgumentError(
            "bandwidth_hz",
            f"be at least {least:.4g} Hz, a tenth over the duration of the recording "
            f"({echoes.length / echoes.sample_rate_hz:.4g} s)",
            f"{band:g} Hz",
        )
    return band


def least_bandwidth_hz(length: int, sample_rate_hz: float) -> float:
    """Return the narrowest band to which recordings of `length` samples can be compressed."""
    return _LEAST_PRODUCT * sample_rate_hz / length


def _fraction(ratio: float) -> Fraction:
    """Return a fraction of small whole numbers that approximates a ratio to 1e-6."""
    if ratio > 1:
        return Fraction(ratio).limit_denominator(1000)
    # A transform has at least as many points as the numerator, which is about 1e6 at most.
    return 1 / Fraction(1 / ratio).limit_denominator(min(max(1, int(1e6 * ratio)), 1000))


def _equalized(
    weights: Callable[[NDArray], NDArray], pulse: Pulse | Replica, band: float
) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Return weights over the band, divided by the power spectrum of the pulse."""

    def power(frequency: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.abs(pulse.spectrum(frequency)) ** 2

    points = _PER_RIPPLE * math.ceil(band * pulse.duration_s + 1)
    floor = _LEAST_POWER * float(power(band * ((np.arange(points) + 0.5) / points - 0.5)).mean())

    def equalized(frequency: NDArray[np.float64]) -> NDArray[np.float64]:
        # Without any power the filter is 0, and refused.
        return weights(frequency) / np.maximum(power(frequency) + floor, np.finfo(float).tiny)

    return equalized


def _filter_response(
    pulse: Pulse | Replica | None,
    band: float,
    edge: float,
    weights: Callable[[NDArray], NDArray],
    bins: NDArray[np.int_],
    period_s: float,
    reach_s: float,
) -> NDArray[np.complex128]:
    """Return the transfer function at bins/period of the filter that fades beyond +-reach."""

    def spectrum(frequency: NDArray) -> NDArray:
        return np.full(len(frequency), 1 / band) if pulse is None else pulse.spectrum(frequency)

    def matched(frequency: NDArray) -> NDArray:
        return weights(frequency) * spectrum(frequency).conj()

    def energy(frequency: NDArray) -> NDArray:
        return weights(frequency) * np.abs(spectrum(frequency)) ** 2

    edges = [-band / 2, band / 2]
    # The phase of P changes with frequency at most at the rate of its duration. Windows have a few
    # cycles over the band.
    rate = 8 / band + (0.0 if pulse is None else pulse.duration_s)
    points = fft.next_fast_len(math.ceil((1.05 * band + 2 * edge) * period_s))
    lag = fft.fftfreq(points) * period_s
    impulse = fourier_integral(matched, edges, lag, sign=1, rate=rate)
    total = fourier_integral(energy, edges, 0.0, sign=1, rate=rate).real
    if not total > 0:
        raise ArgumentError("replica", "have energy within `bandwidth_hz`", "none")
    impulse /= total
    impulse *= smooth_edge((np.abs(lag) - reach_s) / (period_s / 2 - reach_s))
    return fft.fft(impulse)[bins % points] * (period_s / points)


def _baseband(echoes: Echoes, block: slice) -> NDArray:
    """Return the complex baseband samples of some channels.

    Real samples are mixed down and doubled. The band filter then removes the image at twice the
    carrier, which leaves the baseband of the analytic signal.
    """
    samples = echoes.samples[block]
    if not echoes.is_passband:
        return samples.astype(np.complex128)
    time = echoes.start_time_s[block, None] + np.arange(echoes.length) / echoes.sample_rate_hz
    return 2 * samples * turned(-echoes.carrier_hz * time)
