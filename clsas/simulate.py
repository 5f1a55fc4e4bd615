"""From sonar, track and scene to raw echoes, exactly, in the frequency domain.

What is recorded is the pulse, delayed, through the receiver's anti-alias filter G, which passes
|f| <= 0.4 sample rates untouched and falls as an integrated Gaussian to nothing at half the rate:

    X_i(f) = P(f) G(f) sum_s a_is(f) exp(-j 2 pi (f + fc) tau_is),

with a_is the amplitude times, where asked for, 1/(R_tx R_rx) and the element patterns at
frequency f + fc. No delay is rounded. G rings for 90 samples only (to -145 dB), so an echo ends,
and a receive window that cuts it holds exactly the part inside. A pulse with nothing beyond
0.4 sample rates is not changed by G.

The sum is a type-1 non-uniform FFT per channel (finufft). An element pattern depends on point and
frequency together; it is interpolated through Chebyshev nodes in frequency, whose number
follows from a bound on the remainder.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, reduce

import finufft
import numpy as np
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from clsas import validate
from clsas.compress import Window, compress
from clsas.compress import check_options as check_compression
from clsas.echoes import Echoes
from clsas.geometry import legs_m
from clsas.lines import RangeLines
from clsas.scene import PointTargets
from clsas.sonar import PASSBAND, Sonar, element_pattern
from clsas.spectral import EDGE_PRODUCT, smooth_edge
from clsas.track import Channels, Pointing, Track, channels

Progress = Callable[[int, int], None] | None

# Samples for which the receiver's filter rings before and after an echo.
_RINGING = math.ceil(EDGE_PRODUCT / ((1 - PASSBAND) / 2))
# Relative errors of the sum over points and of the patterns' expansion.
_SUM_ERROR = 1e-9
_PATTERN_ERROR = 1e-6
# Points worked on at once, and of these with all terms of their patterns: few enough for caches,
# so many that their sum costs more than its FFT.
_BLOCK = 1 << 17
_BEAM_BLOCK = 1 << 14


def simulate(
    sonar: Sonar,
    track: Track,
    scene: PointTargets,
    *,
    pointing: Pointing | None = None,
    spreading: bool = False,
    motion_in_flight: bool = False,
    range_m: tuple[float, float] | None = None,
    snr_db: float | None = None,
    seed: int = 0,
    workers: int | None = None,
    progress: Progress = None,
) -> Echoes:
    """Return the echoes that a sonar on a track receives from a scene.

    Parameters
    ----------
    sonar, track, scene
        What transmits, where it goes, what reflects. Element patterns (THESIS [9]-[12]) apply
        where the sonar's elements have sizes; such elements are baffled: nothing is transmitted to
        or received from behind the plane of their face.
    pointing : Pointing, optional
        Where the elements look; broadside unless given. Only for a sonar with element sizes.
    spreading : bool
        Divide each echo by the path lengths in metres, 1/(R_tx R_rx) (THESIS [8]).
    motion_in_flight : bool
        Let the receivers move at the track's velocity while the sound travels. Otherwise the
        platform stops and hops.
    range_m : (near, far), optional
        Receive window: from the delay of range `near` to that of `far` plus the pulse's duration
        (THESIS [22], [23]), the same for every channel. What falls outside is cut. Unless given,
        each channel's window starts just before its first echo and all are long enough for
        every echo.
    snr_db : float, optional
        Add complex white Gaussian noise: the power of the strongest noise-free sample of all
        channels over the noise's mean power per sample, before compression; -200 to 300 dB.
    seed : int
        Seeds the noise, at least 0; the same seed gives the same noise.
    workers : int, optional
        Threads; as many as there are cores unless given.
    progress : callable, optional
        Called as progress(channels done, channels).

    Returns
    -------
    Echoes
        Complex baseband.

    Raises
    ------
    TypeError, ValueError
        If an argument is of another type or outside its limits, `pointing` has nothing to act on,
        a point lies on an element while spreading or patterns are asked for, no echo is received
        to set the noise by, or the echoes do not fit into memory.

    Warns
    -----
    ClsasWarning
        If no echo at all falls into the receive window.
    """
    validate.instance("sonar", sonar, Sonar)
    validate.instance("track", track, Track)
    validate.instance("scene", scene, PointTargets)
    validate.progress(progress)
    check_options(
        pointing=pointing, spreading=spreading, motion_in_flight=motion_in_flight,
        range_m=range_m, snr_db=snr_db, seed=seed,
    )  # fmt: skip
    beams = None
    if not sonar.is_omnidirectional:
        beams = _Beams(sonar, (pointing or Pointing.broadside()).axes(track))
    elif pointing is not None:
        raise ValueError("pointing has nothing to act on: the sonar's elements have no sizes")
    pulse, rate, sound = sonar.pulse, sonar.sample_rate_hz, sonar.sound_speed_m_s
    geometry = channels(sonar, track, motion_in_flight=motion_in_flight)
    paths = _Paths(scene, geometry, sound, spreading, beams)
    ringing = _RINGING / rate
    if range_m is None:
        nearest, farthest = paths.delay_limits_s(workers)
        start = nearest - ringing
        longest = np.max(farthest + ringing - start)
    else:
        near, far = map(float, range_m)
        start = np.full(paths.channels, 2 * near / sound)
        longest = 2 * (far - near) / sound
    duration = longest + pulse.duration_s
    validate.memory(
        "track and scene" if range_m is None else "range_m", 8 * paths.channels * duration * rate
    )
    length = math.ceil(duration * rate) + 1

    samples = _record(
        paths,
        pulse.spectrum,
        pulse.carrier_hz,
        rate,
        start,
        length,
        # Every echo of which a part may lie in the window.
        kept_s=(start - pulse.duration_s - ringing, start + length / rate + ringing),
        tail=math.ceil(pulse.duration_s * rate) + 2 * _RINGING,
        workers=workers,
        progress=progress,
    )
    if snr_db is not None:
        _add_noise(samples, float(snr_db), seed)
    return Echoes(
        samples, start, rate, pulse.carrier_hz, geometry.tx_m, geometry.rx_m, sound, pulse,
        geometry.rx_velocity_m_s,
    )  # fmt: skip


def check_options(
    *,
    pointing: Pointing | None = None,
    spreading: bool = False,
    motion_in_flight: bool = False,
    range_m: ArrayLike | None = None,
    snr_db: float | None = None,
    seed: int = 0,
) -> None:
    """Raise TypeError or ValueError unless `simulate` takes these for some survey."""
    validate.instance("pointing", pointing, Pointing, type(None))
    validate.instance("spreading", spreading, bool)
    validate.instance("motion_in_flight", motion_in_flight, bool)
    if range_m is not None:
        near, far = validate.array("range_m", range_m, np.float64, (2,))
        if not 0 <= near < far:
            raise ValueError(f"range_m must be 0 <= near < far in m, got ({near:g}, {far:g})")
    if snr_db is not None:
        validate.number("snr_db", snr_db, "dB", least=-200.0, most=300.0)
    validate.count("seed", seed, least=0)


def simulate_lines(
    tx_m: ArrayLike,
    rx_m: ArrayLike,
    scene: PointTargets,
    *,
    carrier_hz: float,
    bandwidth_hz: float,
    window: Window = "none",
    oversampling: float = 2.0,
    sound_speed_m_s: float = 1500.0,
    first_range_m: ArrayLike | None = None,
    length: int | None = None,
    rx_velocity_m_s: ArrayLike | None = None,
    workers: int | None = None,
    progress: Progress = None,
) -> RangeLines:
    """Return range lines of a scene directly, without a pulse, echoes or beams.

    This is the linear operator from amplitudes a_s to compressed lines,

        s_i(n) = sum_s a_s p(r_n - rho_is) exp(-j 2 k rho_is),

    where p is the response of the windowed band with p(0) = 1, sinc(2 B r/c) for window "none",
    and the sum is over the points whose range lies within the line.

    Parameters
    ----------
    tx_m, rx_m : array_like, [channels, 3] or [3]
        Transmitter and receiver position of each channel.
    scene : PointTargets
        The points.
    carrier_hz, bandwidth_hz : float
        Centre and width of the band.
    window, oversampling
        As for `clsas.compress`; the range step is exactly c/(2 oversampling bandwidth).
    sound_speed_m_s : float
        Speed of sound.
    first_range_m : array_like, [channels] or scalar, optional
    length : int, optional
        Range of each line's first sample and number of samples. Both or neither: unless given,
        the lines hold every point with 90 samples or more to spare.
    rx_velocity_m_s : array_like, [channels, 3] or [3], optional
        Receivers' velocity during flight; None is stop-and-hop.
    workers, progress
        As for `simulate`.

    Returns
    -------
    RangeLines

    Raises
    ------
    TypeError, ValueError
        If an argument is of another type or outside its limits, shapes disagree, or the lines do
        not fit into memory.

    Warns
    -----
    ClsasWarning
        If no point's range lies within a line.
    """
    carrier = validate.number("carrier_hz", carrier_hz, "Hz", least=0.0)
    band = validate.positive("bandwidth_hz", bandwidth_hz, "Hz")
    check_compression(window=window, oversampling=oversampling)
    validate.instance("scene", scene, PointTargets)
    validate.progress(progress)
    sound = validate.positive("sound_speed_m_s", sound_speed_m_s, "m/s")
    paths = _Paths(scene, _channels(tx_m, rx_m, rx_velocity_m_s), sound)
    if (first_range_m is None) != (length is None):
        raise ValueError("first_range_m and length must be given together or not at all")
    # The receiver's filter needs room outside the band.
    every = 1 if oversampling * PASSBAND >= 1 else 2
    rate = every * float(oversampling) * band
    step = every / rate
    if first_range_m is None or length is None:
        nearest, farthest = paths.delay_limits_s(workers)
        nearest, farthest = nearest - _RINGING * step, farthest + _RINGING * step
        samples_wanted = np.max(farthest - nearest) / step
        validate.memory("oversampling", 8 * every * paths.channels * samples_wanted)
        length = math.ceil(samples_wanted) + 1
    else:
        first = validate.array(
            "first_range_m", first_range_m, np.float64, (paths.channels,), broadcast=True
        )
        length = validate.count("length", length)
        validate.memory("length", 8 * every * paths.channels * length)
        nearest = 2 * first / sound
        farthest = nearest + (length - 1) * step

    start = nearest - _RINGING * step
    samples = _record(
        paths,
        lambda frequency: np.full(len(frequency), 1 / band),
        carrier,
        rate,
        start,
        every * (length + 2 * _RINGING),
        kept_s=(nearest, farthest),
        tail=0,
        workers=workers,
        progress=progress,
    )
    geometry = paths.geometry
    echoes = Echoes(
        samples, start, rate, carrier, geometry.tx_m, geometry.rx_m, sound, None,
        geometry.rx_velocity_m_s,
    )  # fmt: skip
    lines = compress(echoes, window=window, oversampling=oversampling, bandwidth_hz=band)
    return replace(
        lines,
        samples=lines.samples[:, _RINGING : _RINGING + length],
        first_range_m=sound / 2 * nearest,
    )


@dataclass(frozen=True)
class _Beams:
    """Element patterns, expanded in frequency, and the axes they are measured from per ping."""

    sonar: Sonar
    axes: NDArray[np.float64]

    def gains(
        self,
        channel: int,
        tx_way: NDArray[np.float64],
        rx_way: NDArray[np.float64],
    ) -> Iterator[tuple[NDArray[np.intp], NDArray[np.float32]]]:
        """Yield indices of points and their two-way pattern [terms, points] at `_nodes(terms)`.

        The nodes are those of the sampled band. Points behind an element's face are left out; the
        others come in order of how much their pattern varies, so that most need few terms.

        Interpolated, a pattern is right to `_PATTERN_ERROR` at every frequency, half of which is
        left for rounding to single precision: with b the sum of sizes times their sines over the
        sound speed, the product of sincs has derivatives of order Q below (pi b)^Q / (Q + 1), so
        that over a band of +-h hertz Q nodes leave at most 2 (pi b h/2)^Q / (Q + 1)!.
        """
        sonar = self.sonar
        along, axis, up = self.axes[channel // sonar.receivers]
        factors = (
            (sonar.tx_length_m, tx_way, along),
            (sonar.rx_length_m, rx_way, along),
            (sonar.tx_height_m, tx_way, up),
            (sonar.rx_height_m, rx_way, up),
        )
        sizes = [(size, way @ vector) for size, way, vector in factors if size is not None]
        faced = np.flatnonzero((tx_way @ axis > 0) & (rx_way @ axis > 0))
        extent = sum(size * np.abs(sine[faced]) for size, sine in sizes)
        order = np.argsort(extent)
        for first in range(0, len(order), _BEAM_BLOCK):
            chosen = order[first : first + _BEAM_BLOCK]
            some = faced[chosen]
            nodes = _nodes(_terms(sonar, extent[chosen[-1]])) * sonar.sample_rate_hz / 2
            frequency = sonar.pulse.carrier_hz + nodes[:, None]
            patterns = (
                element_pattern(size, sine[some], frequency, sonar.sound_speed_m_s, np.float32)
                for size, sine in sizes
            )
            yield some, reduce(np.multiply, patterns)


def _terms(sonar: Sonar, extent_m: float) -> int:
    """Return the least Q with 2 (pi b h/2)^Q / (Q + 1)! <= `_PATTERN_ERROR`/2; see `gains`."""
    reach = np.pi * extent_m / sonar.sound_speed_m_s * sonar.sample_rate_hz / 4
    terms, remainder = 1, reach
    while remainder > _PATTERN_ERROR / 2:
        terms += 1
        remainder *= reach / (terms + 1)
    return terms


def _nodes(terms: int) -> NDArray[np.float64]:
    """Return Chebyshev's nodes on -1..1."""
    return np.cos(np.pi * (np.arange(terms) + 0.5) / terms)


@lru_cache(maxsize=32)
def _interpolation(terms: int, modes: int) -> NDArray:
    """Return the matrix [terms, modes] from values at `_nodes` to FFT frequencies -1..1."""
    to_coefficients = chebvander(_nodes(terms), terms - 1) * (2 / terms)
    to_coefficients[:, 0] /= 2
    return to_coefficients @ chebvander(2 * fft.fftfreq(modes), terms - 1).T


@dataclass(frozen=True)
class _Paths:
    """The scene as every channel sees it."""

    scene: PointTargets
    geometry: Channels
    sound_speed_m_s: float
    spreading: bool = False
    beams: _Beams | None = None

    @property
    def channels(self) -> int:
        return len(self.geometry.tx_m)

    def elements(self, channel: int) -> Channels:
        tx, rx, velocity = self.geometry
        return Channels(tx[channel], rx[channel], None if velocity is None else velocity[channel])

    def legs(self, channel: int) -> Iterator[tuple[NDArray, ...]]:
        """Yield positions, amplitudes, outward and inward legs, some points at a time."""
        elements = self.elements(channel)
        for first in range(0, self.scene.points, _BLOCK):
            points = self.scene.positions_m[first : first + _BLOCK]
            amplitudes = self.scene.amplitudes[first : first + _BLOCK]
            yield points, amplitudes, *legs_m(points, *elements, self.sound_speed_m_s)

    def delay_limits_s(self, workers: int | None) -> NDArray:
        """Return the shortest and the longest delay of every channel, [2, channels]."""

        def limits(channel: int) -> tuple[float, float]:
            lengths = [out + back for _, _, out, back in self.legs(channel)]
            return min(map(np.min, lengths)), max(map(np.max, lengths))

        found = np.array(list(_in_threads(limits, self.channels, workers)))
        return found.T / self.sound_speed_m_s

    def directions(
        self, channel: int, points: NDArray, out: NDArray, back: NDArray
    ) -> tuple[NDArray, NDArray]:
        """Return unit vectors to the points, from tx at transmission and rx at reception."""
        tx, rx, velocity = self.elements(channel)
        if velocity is not None:
            rx = rx + velocity * ((out + back) / self.sound_speed_m_s)[:, None]
        return (points - tx) / out[:, None], (points - rx) / back[:, None]


def _record(
    paths: _Paths,
    spectrum: Callable[[NDArray], NDArray],
    carrier_hz: float,
    rate_hz: float,
    start_s: NDArray[np.float64],
    length: int,
    *,
    kept_s: tuple[NDArray[np.float64], NDArray[np.float64]],
    tail: int,
    workers: int | None,
    progress: Progress,
) -> NDArray[np.complex64]:
    """Return the receive windows [channels, length], each from its start, of the kept delays.

    `tail` samples are padded, so that an echo that leaves the window does not enter it again.
    """
    modes = fft.next_fast_len(length + tail)
    frequency = fft.fftfreq(modes, 1 / rate_hz)
    beyond = (2 * np.abs(frequency) / rate_hz - PASSBAND) / (1 - PASSBAND)
    # The FFT's sum stands for an integral over frequency, hence the rate.
    transfer = rate_hz * spectrum(frequency) * smooth_edge(beyond)

    def echo(channel: int) -> NDArray[np.complex64]:
        total = np.zeros(modes, np.complex128)
        for block in paths.legs(channel):
            delay = (block[2] + block[3]) / paths.sound_speed_m_s
            kept = (delay >= kept_s[0][channel]) & (delay <= kept_s[1][channel])
            if not kept.any():
                continue
            if not kept.all():
                block, delay = tuple(part[kept] for part in block), delay[kept]
            points, amplitudes, out, back = block
            cycles = carrier_hz * delay
            strengths = amplitudes * np.exp(-2j * np.pi * (cycles - np.rint(cycles)))
            if (paths.spreading or paths.beams) and not (out.all() and back.all()):
                raise ValueError(
                    f"scene must have no point on an element with spreading or element patterns, "
                    f"got one on an element of channel {channel}"
                )
            if paths.spreading:
                strengths /= out * back
            angles = 2 * np.pi * rate_hz / modes * (delay - start_s[channel])
            if paths.beams is None:
                total += _sum(angles, strengths, modes)
                continue
            ways = paths.directions(channel, points, out, back)
            for some, gains in paths.beams.gains(channel, *ways):
                sums = _sum(angles[some], strengths[some] * gains, modes)
                sums = sums.reshape(len(gains), modes)
                total += np.sum(_interpolation(len(gains), modes) * sums, axis=0)
        return fft.ifft(total * transfer)[:length].astype(np.complex64)

    samples = np.empty((paths.channels, length), np.complex64)
    for channel, line in enumerate(_in_threads(echo, paths.channels, workers)):
        samples[channel] = line
        if progress is not None:
            progress(channel + 1, paths.channels)
    if not samples.any():
        validate.warn("no echo falls within the receive window: every sample is zero")
    return samples


def _sum(angles: NDArray, strengths: NDArray, modes: int) -> NDArray[np.complex128]:
    """Return sum_s strengths_s exp(-j k angle_s) for the FFT's frequencies k."""
    return finufft.nufft1d1(
        angles, strengths, modes, eps=_SUM_ERROR, isign=-1, modeord=1, nthreads=1
    )


def _in_threads(function: Callable, count: int, workers: int | None) -> Iterator:
    """Yield function(0), ..., function(count - 1), computed by threads; stop early if closed."""
    if workers is not None:
        workers = validate.count("workers", workers)
    pool = ThreadPoolExecutor(workers or os.cpu_count())
    try:
        yield from pool.map(function, range(count))
    finally:
        pool.shutdown(cancel_futures=True)


def _channels(tx_m: ArrayLike, rx_m: ArrayLike, rx_velocity_m_s: ArrayLike | None) -> Channels:
    """Return checked positions, a single one stretched to every channel."""
    given = (tx_m, rx_m) if rx_velocity_m_s is None else (tx_m, rx_m, rx_velocity_m_s)
    count = max(len(np.atleast_2d(part)) for part in given)
    tx, rx, *velocity = (
        validate.array(name, part, np.float64, (count, 3), broadcast=True)
        for name, part in zip(Channels._fields, given, strict=False)
    )
    return Channels(tx, rx, velocity[0] if velocity else None)


def _add_noise(samples: NDArray[np.complex64], snr_db: float, seed: int) -> None:
    peak = np.max([np.abs(line).max() for line in samples])
    if peak == 0:
        raise ValueError("snr_db needs an echo to refer to, but every sample is zero")
    # The deviation of each of the two parts.
    deviation = np.float32(peak * 10 ** (-snr_db / 20) / np.sqrt(2))
    random = np.random.default_rng(seed)
    for line in samples:
        parts = random.standard_normal((len(line), 2), dtype=np.float32)
        line += deviation * parts.view(np.complex64)[:, 0]
