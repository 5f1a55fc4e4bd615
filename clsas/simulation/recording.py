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

Visibility is determined once for a group of neighbouring channels of a ping. Point targets are
always visible. Scatterers of a seabed are visible if they are lit and within the beam.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from clsas.engine.data import validate
from clsas.engine.data.fourier import EDGE_PRODUCT, gridding_gain, smooth_edge, spread, taps_for
from clsas.engine.data.geometry import legs_m
from clsas.engine.data.sound_speed import SoundSpeed
from clsas.engine.data.system import PASSBAND
from clsas.engine.data.threads import in_threads
from clsas.engine.data.track import Channels
from clsas.engine.data.validate import ArgumentError
from clsas.engine.water.ray_tables import TIMES, Q, Quantity
from clsas.simulation.patterns import ElementPatterns, interpolation_matrix
from clsas.simulation.refraction import MOST_FOCUS, BlockRays, Legs, Sightlines
from clsas.simulation.scenes import Observer, PointTargets, Scene, Seabed

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
# Points of a block without and with element patterns. Blocks fit into the caches of a processor,
# but are large enough that summing them takes longer than the FFT.
_BLOCK = 1 << 17
_PATTERN_BLOCK = 1 << 15
# Channels of a ping whose visibility is determined together. The Notes of `simulate` give the
# resulting error.
_GROUP = 8


def scene_parts(scene: Scene) -> tuple[PointTargets | Seabed, ...]:
    """Return the parts of a scene, with point targets divided into blocks.

    Raises
    ------
    TypeError
        If the scene is neither PointTargets nor Seabed nor a tuple of them.
    """
    given: Any = scene if isinstance(scene, tuple) and scene else (scene,)
    parts: list[PointTargets | Seabed] = []
    for part in given:
        validate.instance("scene", part, PointTargets, Seabed)
    for part in given:
        # `points` makes a seabed draw its scatterers here, once, and not in every thread.
        if part.points <= _BLOCK or isinstance(part, Seabed):
            parts.append(part)
            continue
        for first in range(0, part.points, _BLOCK):
            block = slice(first, first + _BLOCK)
            parts.append(PointTargets(part.positions_m[block], part.amplitudes[block]))
    return tuple(parts)


@dataclass(frozen=True)
class Paths:
    """Scene and positions of all channels.

    Attributes
    ----------
    parts : tuple of PointTargets or Seabed
        Parts of the scene, from `scene_parts`.
    geometry : Channels
    sound_speed_m_s : float
    spreading : bool
        True if amplitudes fall as 1/(R_tx R_rx).
    patterns : ElementPatterns or None
        None if every element is omnidirectional.
    receivers : int
        Number of channels of a ping.
    sound_speed : SoundSpeed or None
        Profile along whose rays sound travels; None for a constant speed.
    """

    parts: tuple[PointTargets | Seabed, ...]
    geometry: Channels
    sound_speed_m_s: float
    spreading: bool = False
    patterns: ElementPatterns | None = None
    receivers: int = 1
    sound_speed: SoundSpeed | None = None

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.geometry.tx_m)

    @property
    def groups(self) -> list[range]:
        """Channels whose visibility is determined together."""
        return [
            range(first, min(first + _GROUP, ping + self.receivers))
            for ping in range(0, self.channels, self.receivers)
            for first in range(ping, ping + self.receivers, _GROUP)
        ]

    def elements(self, channel: int) -> Channels:
        """Return the positions of one channel, [3] each."""
        tx, rx, velocity = self.geometry
        return Channels(tx[channel], rx[channel], None if velocity is None else velocity[channel])

    def observer(self, group: range) -> Observer:
        """Return the observer that represents a group of channels."""
        tx, rx, velocity = self.geometry
        tx, rx = tx[group], rx[group]
        middle = (tx.mean(axis=0) + rx.mean(axis=0)) / 2
        patterns = self.patterns
        profile = self.sound_speed
        bent = None if profile is None else Sightlines(profile, float(middle[2]))
        if patterns is None:
            return Observer(middle, sightlines=bent)
        radius = max(np.linalg.norm(end - middle, axis=1).max() for end in (tx, rx))
        ping = group[0] // self.receivers
        # Receivers move while the sound travels, which turns the direction of the return path.
        turn = 0.0
        if velocity is not None:
            turn = 2 * float(np.linalg.norm(velocity[group[0]])) / self.sound_speed_m_s

        shorter = 1.0 if bent is None else self.sound_speed_m_s / bent.speed_m_s

        def gain(directions: NDArray, slack: NDArray | float) -> NDArray:
            return patterns.bound(ping, shorter * directions, shorter * (slack + turn))

        return Observer(middle, radius, gain, bent)

    def delay_limits_s(self, workers: int | None) -> NDArray:
        """Return the shortest and the longest delay of every channel, float64 [2, channels]."""
        velocity = self.geometry.rx_velocity_m_s
        speed = 0.0 if velocity is None else float(np.linalg.norm(velocity, axis=1).max())
        # If a point moves away by one metre, the path becomes longer by two metres, and by the
        # distance that the receiver moves in the meantime.
        per_metre = 2 / max(1 - speed / self.sound_speed_m_s, 1e-3)

        def limits(group: range) -> list[tuple[float, float]]:
            observer = self.observer(group)
            spheres = [part.spheres(observer) for part in self.parts]
            ends = []
            for channel in group:
                shortest, longest = np.inf, -np.inf
                for centres, radii in spheres:
                    out, back = legs_m(centres, *self.elements(channel), self.sound_speed_m_s)
                    margin = per_metre * radii
                    shortest = min(shortest, float(np.min(out + back - margin)))
                    longest = max(longest, float(np.max(out + back + margin)))
                ends.append((shortest, longest))
            return ends

        found = np.array(
            [ends for group in in_threads(limits, self.groups, workers) for ends in group]
        )
        lengths = np.maximum(found.T, 0.0)
        if self.sound_speed is None:
            return lengths / self.sound_speed_m_s
        fastest, slowest = self.sound_speed.speed_m_s.max(), self.sound_speed.speed_m_s.min()
        return lengths / np.array([[fastest], [slowest]])


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
        observer, focused = paths.observer(group), False
        axes = np.eye(3)
        if paths.patterns is not None:
            axes = paths.patterns.axes[group[0] // paths.receivers]
        elements = []  # relative to the observer, along the axes
        for channel in group:
            tx, rx, velocity = paths.elements(channel)
            velocity = None if velocity is None else axes @ velocity
            elements.append(
                Channels(
                    axes @ (tx - observer.position_m), axes @ (rx - observer.position_m), velocity
                )
            )
        totals = np.zeros((len(group), modes), np.complex128)
        for block in _blocks(paths, observer, axes):
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


class _PointBlock(NamedTuple):
    """Block of points that a group of channels receives from.

    Attributes
    ----------
    points_m : float64 [points, 3]
        Positions relative to the observer, along the axes of the elements. Each coordinate is
        contiguous in memory.
    amplitudes : float or complex [points]
    error : float
        Relative error that the sum over these points may have.
    up : float64 [3]
        Direction of the vertical.
    rays : BlockRays or None
        Rays in a profile of the sound speed; None without one.
    """

    points_m: NDArray[np.float64]
    amplitudes: NDArray
    error: float
    up: NDArray[np.float64]
    rays: BlockRays | None = None


def _blocks(paths: Paths, observer: Observer, axes: NDArray[np.float64]) -> Iterator[_PointBlock]:
    """Yield the points that are visible to an observer, block by block."""
    quantities: tuple[Quantity, ...] = TIMES
    if paths.patterns is not None:
        quantities += (Q.LEVEL, Q.LIFT)
    if paths.spreading:
        quantities += (Q.SPREADING,)
    size = _BLOCK if paths.patterns is None else _PATTERN_BLOCK
    for part in paths.parts:
        positions_m, amplitudes = part.visible(observer)
        for first in range(0, len(positions_m), size):
            block = slice(first, first + size)
            offsets_m = np.ascontiguousarray((positions_m[block] - observer.position_m).T)
            points_m = (axes @ offsets_m).T
            rays = None
            if paths.sound_speed is not None:
                z_m = positions_m[block, 2]
                rays = BlockRays(paths.sound_speed, points_m, z_m, quantities, part.error)
            yield _PointBlock(points_m, amplitudes[block], part.error, axes[:, 2], rays)


def _add(
    total: NDArray[np.complex128],
    paths: Paths,
    carrier_hz: float,
    windows: ReceiveWindows,
    channel: int,
    elements: Channels,
    block: _PointBlock,
) -> bool:
    """Add the transfer functions of a block of points to those of one channel, [modes].

    The result is True if amplitudes were limited near a caustic.
    """
    modes, patterns = len(total), paths.patterns
    points, amplitudes = block.points_m, block.amplitudes
    if block.rays is None:
        out_m, back_m = legs_m(points, *elements, paths.sound_speed_m_s)
        legs = Legs((out_m + back_m) / paths.sound_speed_m_s, out_m, back_m)
    else:
        tx, rx, velocity = paths.elements(channel)
        climb_m_s = 0.0 if velocity is None else float(velocity[2])
        legs = block.rays.legs(elements, float(tx[2]), float(rx[2]), climb_m_s)
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
