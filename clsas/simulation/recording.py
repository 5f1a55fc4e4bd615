"""Samples that every channel records: delayed pulses of the visible points, summed in frequency.

A channel records the delayed pulse P through the receiver's anti-alias filter G, which passes
|f| <= 0.4 sample rates unchanged and falls as an integrated Gaussian to zero at half the rate:

    X_i(f) = P(f) G(f) sum_s a_is(f) exp(-j 2 pi (f + fc) tau_is).

a_is is the amplitude, multiplied by 1/(R_tx R_rx) and by the element patterns at frequency f + fc
if these are requested (Ødegaard 2004, equations [8]-[12]). Delays are not rounded. G rings for only
90 samples (to -145 dB), so an echo has an end, and a receive window that cuts the echo keeps
exactly the part inside. A pulse without energy beyond 0.4 sample rates passes G unchanged.

The sum is one type-1 non-uniform FFT per channel. Scenes that tolerate an error of their
echoes are summed only to that accuracy, in single precision where that suffices.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from clsas.engine.data import validate
from clsas.engine.data.fourier import EDGE_PRODUCT, gridding_gain, smooth_edge, spread, taps_for
from clsas.engine.data.system import PASSBAND
from clsas.engine.data.threads import in_threads
from clsas.engine.data.track import Channels
from clsas.engine.data.validate import ArgumentError
from clsas.simulation.paths import Paths, PointBlock
from clsas.simulation.patterns import interpolation_matrix
from clsas.simulation.refraction import MOST_FOCUS

Progress = Callable[[int, int], None] | None

RINGING = math.ceil(EDGE_PRODUCT / ((1 - PASSBAND) / 2))
"""Samples for which the receiver's filter rings before and after an echo."""

NO_ECHO = (
    "no echo arrives within the receive window and in front of the elements, so every sample is "
    "zero"
)

FOCUSED = (
    "the sound speed focuses sound on points near a caustic, where ray theory has no limit: their "
    f"amplitudes are limited to {20 * math.log10(MOST_FOCUS):.0f} dB above those of straight paths"
)

_SUM_ERROR = 1e-9  # relative, of the non-uniform FFT
_OVERSAMPLING = 2.0  # of its grid; 1.5 needs more taps and takes as long
_SINGLE_ERROR = 1e-4  # from which float32 suffices, which rounds phases and sines to 1e-6
_PATTERN_ERROR = 1e-6  # of interpolated element patterns
_TOUCHING_M = 1e-9  # a point closer to an element than this has no direction


@dataclass(frozen=True)
class ReceiveWindows:
    """Times at which every channel records.

    Attributes
    ----------
    rate_hz : float
        Sample rate.
    start_s : float64 [channels]
        Time of the first sample.
    length : int
        Samples per channel.
    kept_s : (float64 [channels], float64 [channels])
        Shortest and longest delay of the points that are summed.
    tail : int
        Number of zeros after the window, which keep echoes that end later from wrapping around into
        it.
    """

    rate_hz: float
    start_s: NDArray[np.float64]
    length: int
    kept_s: tuple[NDArray[np.float64], NDArray[np.float64]]
    tail: int


def record(
    paths: Paths,
    spectrum: Callable[[NDArray], NDArray],
    carrier_hz: float,
    windows: ReceiveWindows,
    *,
    workers: int | None,
    progress: Progress,
) -> NDArray[np.complex64]:
    """Return the samples in the receive windows, complex64 [channels, length].

    Parameters
    ----------
    paths : Paths
    spectrum : callable
        The pulse's spectrum at frequencies relative to the carrier, in seconds.
    carrier_hz : float
    windows : ReceiveWindows
    workers, progress
        As for `clsas.simulate`.

    Raises
    ------
    ValueError
        If a point lies on an element while spreading or element patterns are applied.

    Warns
    -----
    ClsasWarning
        If every sample is zero, or amplitudes were limited near a caustic.
    """
    modes = fft.next_fast_len(windows.length + windows.tail)
    frequency = fft.fftfreq(modes, 1 / windows.rate_hz)
    beyond = (2 * np.abs(frequency) / windows.rate_hz - PASSBAND) / (1 - PASSBAND)
    # The sum of the FFT replaces an integral over frequency, hence the factor of the sample rate.
    transfer = windows.rate_hz * spectrum(frequency) * smooth_edge(beyond)

    def echoes(group: range) -> tuple[list[NDArray[np.complex64]], bool]:
        focused = False
        totals = np.zeros((len(group), modes), np.complex128)
        elements, blocks = paths.visible(group)
        for block in blocks:
            for total, channel, ends in zip(totals, group, elements, strict=True):
                focused |= _add(total, paths, carrier_hz, windows, channel, ends, block)
        return [
            fft.ifft(total * transfer)[: windows.length].astype(np.complex64) for total in totals
        ], focused

    samples = np.empty((paths.channels, windows.length), np.complex64)
    groups, focused = paths.groups, False
    for group, (lines, some) in zip(groups, in_threads(echoes, groups, workers), strict=True):
        focused |= some
        for channel, line in zip(group, lines, strict=True):
            samples[channel] = line
            if progress is not None:
                progress(channel + 1, paths.channels)
    if not samples.any():
        validate.warn(NO_ECHO)
    if focused:
        validate.warn(FOCUSED)
    return samples


def _add(
    total: NDArray[np.complex128],
    paths: Paths,
    carrier_hz: float,
    windows: ReceiveWindows,
    channel: int,
    elements: Channels,
    block: PointBlock,
) -> bool:
    """Add the transfer functions of a block of points to those of one channel, [modes].

    The result is True if amplitudes were limited near a caustic.
    """
    modes, patterns = len(total), paths.patterns
    points, amplitudes = block.points_m, block.amplitudes
    legs = paths.legs(channel, elements, block)
    kept = legs.delay_s >= windows.kept_s[0][channel]
    kept &= legs.delay_s <= windows.kept_s[1][channel]
    if not kept.any():
        return False
    if not kept.all():
        points, amplitudes, legs = points[kept], amplitudes[kept], legs.at(kept)
    touching = min(legs.out_m.min(), legs.back_m.min()) < _TOUCHING_M
    if (paths.spreading or patterns) and touching:
        raise ArgumentError(
            "scene",
            "have no point on an element with spreading or element patterns",
            f"one on an element of channel {channel}",
        )
    sines: list[NDArray] = []
    if patterns is not None:
        in_front, sines = patterns.sines(points, elements, legs, block.up)
        if not in_front.any():
            return False
        if not in_front.all():
            amplitudes, legs = amplitudes[in_front], legs.at(in_front)
            sines = [sine[in_front] for sine in sines]
    single = block.error >= _SINGLE_ERROR
    real = np.float32 if single else np.float64
    cycles = carrier_hz * legs.delay_s
    phase = (-2 * np.pi * (cycles - np.rint(cycles))).astype(real)
    strengths: NDArray = np.empty(len(phase), np.complex64 if single else np.complex128)
    strengths.real, strengths.imag = np.cos(phase), np.sin(phase)
    strengths *= amplitudes
    if paths.spreading:
        strengths /= legs.spreading_m2
    turns = windows.rate_hz / modes * (legs.delay_s - windows.start_s[channel])
    turns -= np.rint(turns)
    accuracy = max(_SUM_ERROR, block.error / 10)
    if patterns is None:
        total += _point_sum(turns, strengths, modes, accuracy)
        return legs.focused
    sines = [sine.astype(real) for sine in sines]
    gains = patterns.gains(sines, max(_PATTERN_ERROR, block.error), real, modes)
    sums = _point_sum(turns, strengths * gains, modes, accuracy).reshape(len(gains), modes)
    total += np.sum(interpolation_matrix(len(gains), modes) * sums, axis=0)
    return legs.focused


def _point_sum(turns: NDArray, strengths: NDArray, modes: int, error: float) -> NDArray:
    """Return sum_s strengths_s exp(-j 2 pi k turns_s) for the frequencies k of the FFT."""
    taps = taps_for(20 * math.log10(error), _OVERSAMPLING)
    length = fft.next_fast_len(math.ceil(_OVERSAMPLING * modes) + taps)
    grid = spread(strengths.T, turns * length, length, taps, _OVERSAMPLING)
    frequency = np.rint(fft.fftfreq(modes, 1 / modes)).astype(int)
    gain = gridding_gain(frequency / length, taps, _OVERSAMPLING)
    return fft.fft(grid.T, overwrite_x=True)[..., frequency % length] / gain
