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

What a scene's points are is asked anew for every few channels of a ping (`_Paths.look`): all of
some point targets, of a seabed only what is lit and within the beam. A scene that allows its
echoes an error is summed only as exactly as that, in single precision where it suffices.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, reduce
from typing import Any, NamedTuple

import finufft
import numpy as np
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from clsas.core import validate
from clsas.core.fourier import EDGE_PRODUCT, smooth_edge
from clsas.core.geometry import legs_m
from clsas.core.lines import RangeLines
from clsas.core.threads import in_threads
from clsas.signal.compression import Window, compress
from clsas.signal.compression import check_options as check_compression
from clsas.signal.echoes import Echoes
from clsas.simulation.scenes import PointTargets, Seabed, View
from clsas.sonar.system import PASSBAND, Sonar, element_pattern
from clsas.sonar.track import Channels, Pointing, Track, channels

Scene = PointTargets | Seabed | tuple[PointTargets | Seabed, ...]
Progress = Callable[[int, int], None] | None

# Samples for which the receiver's filter rings before and after an echo.
_RINGING = math.ceil(EDGE_PRODUCT / ((1 - PASSBAND) / 2))
# Relative errors of the sum over points and of the patterns' expansion.
_SUM_ERROR = 1e-9
_PATTERN_ERROR = 1e-6
# Points worked on at once without and with all terms of their patterns: few enough for caches, so
# many that their sum costs more than its FFT.
_BLOCK = 1 << 17
_BEAM_BLOCK = 1 << 15
# Channels of a ping that share one look at the scene; the Notes of `simulate` say what that costs.
_LOOK = 8
# Nearer to an element than this a point has no direction.
_TOUCHING_M = 1e-9
_NO_ECHO = "no echo falls within the receive window, from where elements look: every sample is zero"


def simulate(
    sonar: Sonar,
    track: Track,
    scene: Scene,
    *,
    pointing: Pointing | None = None,
    spreading: bool = False,
    motion_in_flight: bool = False,
    element_pattern: bool = True,
    phase_centres: bool = False,
    range_m: tuple[float, float] | None = None,
    snr_db: float | None = None,
    seed: int = 0,
    workers: int | None = None,
    progress: Progress = None,
) -> Echoes:
    """Return the echoes that a sonar on a track receives from a scene.

    Parameters
    ----------
    sonar, track
        What transmits and where it goes. Element patterns (THESIS [9]-[12]) apply where the
        sonar's elements have sizes; such elements are baffled: nothing is transmitted to or
        received from behind the plane of their face.
    scene : PointTargets, Seabed, or tuple of them
        What reflects; the echoes of several add. Point targets are neither shadowed nor left out.
    pointing : Pointing, optional
        Where the elements look; broadside unless given. Only for a sonar with element sizes.
    spreading : bool
        Divide each echo by the path lengths in metres, 1/(R_tx R_rx) (THESIS [8]).
    motion_in_flight : bool
        Let the receivers move at the track's velocity while the sound travels. Otherwise the
        platform stops and hops.
    element_pattern : bool
        Apply the patterns of elements that have sizes; without them every element is taken as
        omnidirectional, and nothing is baffled.
    phase_centres : bool
        Put transmitter and receiver of every channel where their phase centre is: the echoes of a
        monostatic sonar with as many channels.
    range_m : (near, far), optional
        Receive window: from the delay of range `near` to that of `far` plus the pulse's duration
        (THESIS [22], [23]), the same for every channel. What falls outside is cut. Unless given,
        each channel's window starts just before its first echo (of a seabed: before the nearest
        part of it within the beam) and all are long enough for every echo.
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
        to set the noise by, or the echoes, or the patterns of very long elements, do not fit
        into memory.

    Warns
    -----
    ClsasWarning
        If no echo at all falls into the receive window.

    Notes
    -----
    What a seabed shows is found once per eight channels of a ping, as seen from the middle between
    their transmitter and their receivers' mean. For an element that lies e beside that middle, the
    edge of a shadow at distance d behind what casts it, that at distance r, is out by e d/r.
    """
    validate.instance("sonar", sonar, Sonar)
    validate.instance("track", track, Track)
    validate.progress(progress)
    check_options(
        pointing=pointing, spreading=spreading, motion_in_flight=motion_in_flight,
        element_pattern=element_pattern, phase_centres=phase_centres,
        range_m=range_m, snr_db=snr_db, seed=seed,
    )  # fmt: skip
    check_size(sonar, track, range_m)
    parts = _parts(scene)
    beams = None
    if not sonar.is_omnidirectional and element_pattern:
        beams = _Beams(sonar, (pointing or Pointing.broadside()).axes(track))
    elif pointing is not None:
        why = "the sonar's elements have no sizes" if element_pattern else "element_pattern is off"
        raise ValueError(f"pointing has nothing to act on: {why}")
    pulse, rate, sound = sonar.pulse, sonar.sample_rate_hz, sonar.sound_speed_m_s
    geometry = channels(sonar, track, motion_in_flight=motion_in_flight)
    if phase_centres:
        middle_m = (geometry.tx_m + geometry.rx_m) / 2
        geometry = geometry._replace(tx_m=middle_m, rx_m=middle_m)
    paths = _Paths(parts, geometry, sound, spreading, beams, sonar.receivers)
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
    element_pattern: bool = True,
    phase_centres: bool = False,
    range_m: ArrayLike | None = None,
    snr_db: float | None = None,
    seed: int = 0,
) -> None:
    """Raise TypeError or ValueError unless `simulate` takes these for some survey."""
    validate.instance("pointing", pointing, Pointing, type(None))
    validate.instance("spreading", spreading, bool)
    validate.instance("motion_in_flight", motion_in_flight, bool)
    validate.instance("element_pattern", element_pattern, bool)
    validate.instance("phase_centres", phase_centres, bool)
    if range_m is not None:
        near, far = validate.array("range_m", range_m, np.float64, (2,))
        if not 0 <= near < far:
            raise ValueError(f"range_m must be 0 <= near < far in m, got ({near:g}, {far:g})")
    if snr_db is not None:
        validate.number("snr_db", snr_db, "dB", least=-200.0, most=300.0)
    validate.count("seed", seed, least=0)


def check_size(sonar: Sonar, track: Track, range_m: ArrayLike | None = None) -> None:
    """Raise ValueError where even the shortest echoes of a survey do not fit into memory.

    This needs neither the channels' positions nor a scene, so it is quick for any survey.
    """
    name, samples = "sonar and track", 2.0 * _RINGING
    if range_m is not None:
        near, far = map(float, np.asarray(range_m))
        name, samples = "range_m", 2 * (far - near) / sonar.sound_speed_m_s * sonar.sample_rate_hz
    samples += sonar.pulse.duration_s * sonar.sample_rate_hz
    validate.memory(name, 8 * track.pings * sonar.receivers * samples)


def simulate_lines(
    tx_m: ArrayLike,
    rx_m: ArrayLike,
    scene: Scene,
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
    scene : PointTargets, Seabed, or tuple of them
        The points, as for `simulate`; a seabed's visibility is found for every channel.
    carrier_hz, bandwidth_hz : float
        Centre and width of the band.
    window, oversampling
        As for `clsas.compress`; the range step is exactly c/(2 oversampling bandwidth).
    sound_speed_m_s : float
        Speed of sound.
    first_range_m : array_like, [channels] or scalar, optional
        Range of each line's first sample, metres; with `length`. Unless given, the lines hold
        every point with 90 samples or more to spare.
    length : int, optional
        Samples of every line; with `first_range_m`.
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
    validate.progress(progress)
    parts = _parts(scene)
    sound = validate.positive("sound_speed_m_s", sound_speed_m_s, "m/s")
    paths = _Paths(parts, _channels(tx_m, rx_m, rx_velocity_m_s), sound)
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

    @property
    def elements(self) -> list[tuple[float, int, int]]:
        """Of every pattern the element's size, its end of the path, and its axis."""
        sonar = self.sonar
        sizes = (
            (sonar.tx_length_m, 0, 0),
            (sonar.rx_length_m, 1, 0),
            (sonar.tx_height_m, 0, 2),
            (sonar.rx_height_m, 1, 2),
        )
        return [(size, end, axis) for size, end, axis in sizes if size is not None]

    def bound(self, ping: int, directions: NDArray, slack: NDArray | float) -> NDArray:
        """Return an upper bound of the two-way pattern; see `clsas.simulation.scenes.View`."""
        pulse = self.sonar.pulse
        lowest = max(pulse.carrier_hz - pulse.bandwidth_hz / 2, 0.0) / self.sonar.sound_speed_m_s
        components = directions @ self.axes[ping].T
        gain = np.where(components[:, 1] > -slack, 1.0, 0.0)
        for size, _, axis in self.elements:
            sine = np.maximum(np.abs(components[:, axis]) - slack, 0.0)
            gain /= np.maximum(np.pi * size * lowest * sine, 1.0)
        return gain

    def sines(
        self, points: NDArray, elements: Channels, out: NDArray, back: NDArray
    ) -> tuple[NDArray[np.bool_], list[NDArray]]:
        """Return which points are before the elements' faces, and the sines for `elements`.

        All positions are in the elements' axes: from tx at transmission, and from rx at reception.
        """
        tx, rx, velocity = elements
        heard = rx[:, None]
        if velocity is not None:
            heard = heard + velocity[:, None] * ((out + back) / self.sonar.sound_speed_m_s)
        ends = ((tx[:, None], out), (heard, back))
        faced = (points[:, 1] > tx[1]) & (points[:, 1] > heard[1])
        return faced, [
            (points[:, axis] - ends[end][0][axis]) / ends[end][1] for _, end, axis in self.elements
        ]

    def gains(
        self, sines: list[NDArray], error: float, dtype: type[np.floating], modes: int
    ) -> NDArray[np.float32]:
        """Return the two-way pattern [terms, points] at `_nodes(terms)` of the sampled band.

        `sines` are those of `elements`. Interpolated, the pattern is right to `error` at every
        frequency, half of which is left for rounding to single precision. With a_i = pi L_i
        sine_i/c, sinc(a_i f) has derivatives of order k below a_i^k min(1/(k + 1), 2/(a_i f)), and
        the product of the patterns those of order Q below

            (sum_i a_i)^Q min(1/(Q + 1), prod_i min(1, 2/(a_i f_least))),

        so that over a band of +-h hertz Q nodes leave at most 2 (h/2)^Q/Q! times that.

        Raises
        ------
        ValueError
            If elements are so long that the pattern, and its sum's spectrum at `modes`
            frequencies, do not fit into memory.
        """
        sonar = self.sonar
        half_band = sonar.sample_rate_hz / 2
        slopes = [
            np.abs(sine) * (np.pi * size / sonar.sound_speed_m_s)
            for (size, _, _), sine in zip(self.elements, sines, strict=True)
        ]
        reach = reduce(np.add, slopes) * (half_band / 2)
        lowest = max(sonar.pulse.carrier_hz - half_band, 0.0)
        level: NDArray | float = 2.0
        for slope in slopes:
            level = level / np.maximum(slope * (lowest / 2), 1.0)
        # Stirling: with this many terms (reach e/Q)^Q has fallen below the error.
        most = math.e * float(np.max(reach)) - math.log(error / 4)
        validate.memory("the sonar's element lengths", 8 * most * (most + len(reach) + 2 * modes))
        terms = _terms(reach, level, error / 2)
        frequency = (sonar.pulse.carrier_hz + _nodes(terms) * half_band)[:, None].astype(dtype)
        patterns = (
            element_pattern(size, sine, frequency, sonar.sound_speed_m_s, np.float32)
            for (size, _, _), sine in zip(self.elements, sines, strict=True)
        )
        return reduce(np.multiply, patterns)


def _terms(reach: NDArray, level: NDArray | float, error: float) -> int:
    """Return the least Q with reach^Q/Q! min(2/(Q + 1), level) <= `error` everywhere."""
    with np.errstate(divide="ignore"):
        slope, cap = np.log(reach), np.log(level)
    # Logarithms: the powers of a long element overflow before Q! catches up.
    terms, power = 1, slope
    while np.max(power + np.minimum(cap, math.log(2 / (terms + 1)))) > math.log(error):
        terms += 1
        power = power + (slope - math.log(terms))
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


class _Look(NamedTuple):
    """Some of the points that some channels of one ping see.

    Positions are relative to the view's and turned into the elements' axes, float64 [points, 3],
    each coordinate contiguous.
    """

    points_m: NDArray[np.float64]
    amplitudes: NDArray
    error: float


@dataclass(frozen=True)
class _Paths:
    """The scene as every channel sees it."""

    parts: tuple[PointTargets | Seabed, ...]
    geometry: Channels
    sound_speed_m_s: float
    spreading: bool = False
    beams: _Beams | None = None
    receivers: int = 1

    @property
    def channels(self) -> int:
        return len(self.geometry.tx_m)

    @property
    def together(self) -> list[range]:
        """The channels that look together."""
        return [
            range(first, min(first + _LOOK, ping + self.receivers))
            for ping in range(0, self.channels, self.receivers)
            for first in range(ping, ping + self.receivers, _LOOK)
        ]

    def elements(self, channel: int) -> Channels:
        tx, rx, velocity = self.geometry
        return Channels(tx[channel], rx[channel], None if velocity is None else velocity[channel])

    def view(self, some: range) -> View:
        """Return where channels of one ping look from."""
        tx, rx, velocity = self.geometry
        tx, rx = tx[some], rx[some]
        middle = (tx.mean(axis=0) + rx.mean(axis=0)) / 2
        if self.beams is None:
            return View(middle)
        reach = max(np.linalg.norm(end - middle, axis=1).max() for end in (tx, rx))
        ping = some[0] // self.receivers
        # How far the receivers' motion while the sound travels turns the way back.
        turn = 0.0
        if velocity is not None:
            turn = 2 * float(np.linalg.norm(velocity[some[0]])) / self.sound_speed_m_s
        beams = self.beams

        def gain(directions: NDArray, slack: NDArray | float) -> NDArray:
            return beams.bound(ping, directions, slack + turn)

        return View(middle, reach, gain)

    def look(self, some: range) -> tuple[list[Channels], Iterator[_Look]]:
        """Return channels of one ping, and block by block what they see, in the same axes."""
        view, beams = self.view(some), self.beams
        axes = np.eye(3) if beams is None else beams.axes[some[0] // self.receivers]
        size = _BLOCK if beams is None else _BEAM_BLOCK

        def local(channel: int) -> Channels:
            tx, rx, velocity = self.elements(channel)
            velocity = None if velocity is None else axes @ velocity
            return Channels(axes @ (tx - view.position_m), axes @ (rx - view.position_m), velocity)

        def looks() -> Iterator[_Look]:
            for part in self.parts:
                positions, amplitudes = part.seen(view)
                for first in range(0, len(positions), size):
                    block = slice(first, first + size)
                    offsets = np.ascontiguousarray((positions[block] - view.position_m).T)
                    yield _Look((axes @ offsets).T, amplitudes[block], part.error)

        return [local(channel) for channel in some], looks()

    def delay_limits_s(self, workers: int | None) -> NDArray:
        """Return the shortest and the longest delay of every channel, [2, channels]."""
        velocity = self.geometry.rx_velocity_m_s
        speed = 0.0 if velocity is None else float(np.linalg.norm(velocity, axis=1).max())
        # What one metre adds to a path at most: twice that, and what the receiver moves meanwhile.
        per_metre = 2 / max(1 - speed / self.sound_speed_m_s, 1e-3)

        def limits(some: range) -> list[tuple[float, float]]:
            view = self.view(some)
            spheres = [part.spheres(view) for part in self.parts]

            def lengths(channel: int) -> Iterator[tuple[float, float]]:
                for centres, radii in spheres:
                    out, back = legs_m(centres, *self.elements(channel), self.sound_speed_m_s)
                    margin = per_metre * radii
                    yield np.min(out + back - margin), np.max(out + back + margin)

            both = [zip(*lengths(channel), strict=True) for channel in some]
            return [(min(nearest), max(farthest)) for nearest, farthest in both]

        found = np.array(
            [ends for some in in_threads(limits, self.together, workers) for ends in some]
        )
        return np.maximum(found.T, 0.0) / self.sound_speed_m_s


def _parts(scene: Scene) -> tuple[PointTargets | Seabed, ...]:
    """Return what the scene is made of, points in such numbers as are worked on at once."""
    given: Any = scene if isinstance(scene, tuple) and scene else (scene,)
    parts: list[PointTargets | Seabed] = []
    for part in given:
        validate.instance("scene", part, PointTargets, Seabed)
    for part in given:
        # Asking for its points makes a seabed draw them, here once rather than in every thread.
        if part.points <= _BLOCK or isinstance(part, Seabed):
            parts.append(part)
            continue
        for first in range(0, part.points, _BLOCK):
            block = slice(first, first + _BLOCK)
            parts.append(PointTargets(part.positions_m[block], part.amplitudes[block]))
    return tuple(parts)


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

    def add(total: NDArray, channel: int, elements: Channels, look: _Look) -> None:
        """Add the transfer functions of some points."""
        points, amplitudes = look.points_m, look.amplitudes
        out, back = legs_m(points, *elements, paths.sound_speed_m_s)
        delay = (out + back) / paths.sound_speed_m_s
        kept = (delay >= kept_s[0][channel]) & (delay <= kept_s[1][channel])
        if not kept.any():
            return
        if not kept.all():
            points, amplitudes, out, back, delay = (
                part[kept] for part in (points, amplitudes, out, back, delay)
            )
        if (paths.spreading or paths.beams) and min(out.min(), back.min()) < _TOUCHING_M:
            raise ValueError(
                f"scene must have no point on an element with spreading or element patterns, "
                f"got one on an element of channel {channel}"
            )
        sines: list[NDArray] = []
        if paths.beams is not None:
            faced, sines = paths.beams.sines(points, elements, out, back)
            if not faced.any():
                return
            if not faced.all():
                amplitudes, out, back, delay, *sines = (
                    part[faced] for part in (amplitudes, out, back, delay, *sines)
                )
        # Rounding of an angle a to float32, a/2^25 at most, is phase at `modes`/2.
        single = look.error >= 1e-7 * modes
        real = np.float32 if single else np.float64
        cycles = carrier_hz * delay
        phase = (-2 * np.pi * (cycles - np.rint(cycles))).astype(real)
        strengths: NDArray = np.empty(len(phase), np.complex64 if single else np.complex128)
        strengths.real, strengths.imag = np.cos(phase), np.sin(phase)
        strengths *= amplitudes
        if paths.spreading:
            strengths /= out * back
        turns = rate_hz / modes * (delay - start_s[channel])
        angles = (2 * np.pi * (turns - np.rint(turns))).astype(real)
        accuracy = max(_SUM_ERROR, look.error / 10)
        if paths.beams is None:
            total += _sum(angles, strengths, modes, accuracy)
            return
        sines = [sine.astype(real) for sine in sines]
        gains = paths.beams.gains(sines, max(_PATTERN_ERROR, look.error), real, modes)
        sums = _sum(angles, strengths * gains, modes, accuracy).reshape(len(gains), modes)
        total += np.sum(_interpolation(len(gains), modes) * sums, axis=0)

    def echoes(some: range) -> list[NDArray[np.complex64]]:
        totals = np.zeros((len(some), modes), np.complex128)
        elements, looks = paths.look(some)
        for look in looks:
            for total, channel, ends in zip(totals, some, elements, strict=True):
                add(total, channel, ends, look)
        return [fft.ifft(total * transfer)[:length].astype(np.complex64) for total in totals]

    samples = np.empty((paths.channels, length), np.complex64)
    together = paths.together
    for some, lines in zip(together, in_threads(echoes, together, workers), strict=True):
        for channel, line in zip(some, lines, strict=True):
            samples[channel] = line
            if progress is not None:
                progress(channel + 1, paths.channels)
    if not samples.any():
        validate.warn(_NO_ECHO)
    return samples


def _sum(angles: NDArray, strengths: NDArray, modes: int, error: float) -> NDArray:
    """Return sum_s strengths_s exp(-j k angle_s) for the FFT's frequencies k."""
    # The frequencies' grid fits into caches, so sorting the points would only cost.
    return finufft.nufft1d1(
        angles, strengths, modes, eps=error, isign=-1, modeord=1, nthreads=1, spread_sort=0
    )


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
        raise ValueError(f"snr_db needs an echo to refer to: {_NO_ECHO}")
    # The deviation of each of the two parts.
    deviation = np.float32(peak * 10 ** (-snr_db / 20) / np.sqrt(2))
    random = np.random.default_rng(seed)
    for line in samples:
        parts = random.standard_normal((len(line), 2), dtype=np.float32)
        line += deviation * parts.view(np.complex64)[:, 0]
