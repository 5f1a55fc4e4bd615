"""Acoustic paths: the points of a scene that are visible to every channel, block by block.

Visibility is determined once for a group of neighbouring channels of a ping. Point targets are
always visible. Scatterers of a seabed are visible if they are lit and within the beam.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.geometry import legs_m
from clsas.engine.data.sound_speed import SoundSpeed
from clsas.engine.data.threads import in_threads
from clsas.engine.data.track import Channels
from clsas.engine.water.ray_tables import TIMES, Q, Quantity
from clsas.simulation.legs import Legs
from clsas.simulation.patterns import ElementPatterns
from clsas.simulation.refraction import BlockRays, Sightlines
from clsas.simulation.scenes import Observer, PointTargets, Scene, Seabed

# Points of a block without and with element patterns. Blocks fit into the caches of a processor,
# but are large enough that summing them takes longer than the FFT.
_BLOCK = 1 << 17
_PATTERN_BLOCK = 1 << 15
# Channels of a ping whose visibility is determined together. The Notes of `simulate` give the
# resulting error.
_GROUP = 8


class PointBlock(NamedTuple):
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

    def visible(self, group: range) -> tuple[list[Channels], Iterator[PointBlock]]:
        """Return the positions of the channels of a group, and the visible points block by block.

        Both are relative to the observer and along the axes of the elements.
        """
        observer, patterns = self.observer(group), self.patterns
        quantities: tuple[Quantity, ...] = TIMES
        if patterns is not None:
            quantities += (Q.LEVEL, Q.LIFT)
        if self.spreading:
            quantities += (Q.SPREADING,)
        axes = np.eye(3) if patterns is None else patterns.axes[group[0] // self.receivers]
        size = _BLOCK if patterns is None else _PATTERN_BLOCK
        origin_m = observer.position_m

        def local(channel: int) -> Channels:
            tx, rx, velocity = self.elements(channel)
            velocity = None if velocity is None else axes @ velocity
            return Channels(axes @ (tx - origin_m), axes @ (rx - origin_m), velocity)

        def blocks() -> Iterator[PointBlock]:
            for part in self.parts:
                positions, amplitudes = part.visible(observer)
                for first in range(0, len(positions), size):
                    block = slice(first, first + size)
                    offsets = np.ascontiguousarray((positions[block] - origin_m).T)
                    points_m = (axes @ offsets).T
                    rays = None
                    if self.sound_speed is not None:
                        z_m = positions[block, 2]
                        rays = BlockRays(self.sound_speed, points_m, z_m, quantities, part.error)
                    yield PointBlock(points_m, amplitudes[block], part.error, axes[:, 2], rays)

        return [local(channel) for channel in group], blocks()

    def legs(self, channel: int, elements: Channels, block: PointBlock) -> Legs:
        """Return the paths between a block of points and the elements of a channel."""
        if block.rays is None:
            out, back = legs_m(block.points_m, *elements, self.sound_speed_m_s)
            return Legs((out + back) / self.sound_speed_m_s, out, back)
        tx, rx, velocity = self.elements(channel)
        climb_m_s = 0.0 if velocity is None else float(velocity[2])
        return block.rays.legs(elements, float(tx[2]), float(rx[2]), climb_m_s)

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

            def lengths(channel: int) -> Iterator[tuple[float, float]]:
                for centres, radii in spheres:
                    out, back = legs_m(centres, *self.elements(channel), self.sound_speed_m_s)
                    margin = per_metre * radii
                    yield np.min(out + back - margin), np.max(out + back + margin)

            both = [zip(*lengths(channel), strict=True) for channel in group]
            return [(min(nearest), max(farthest)) for nearest, farthest in both]

        found = np.array(
            [ends for group in in_threads(limits, self.groups, workers) for ends in group]
        )
        lengths = np.maximum(found.T, 0.0)
        if self.sound_speed is None:
            return lengths / self.sound_speed_m_s
        fastest, slowest = self.sound_speed.speed_m_s.max(), self.sound_speed.speed_m_s.min()
        return lengths / np.array([[fastest], [slowest]])


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
