"""Random apertures: where channels lie, which way their platform heads, and where the image is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from clsas.selftest.extremes import along_x

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Aperture:
    """Channels about the origin, and where their image lies.

    Attributes
    ----------
    position_m, along : float64 [channels, 3]
        Positions, and unit vectors of the platform's heading there.
    range_m : float
        Distance of the image, at y > 0; of an aperture that looks inside, its radius.
    depth_m : float
        Of the image below an aperture that looks inside.
    looks_inside : bool
        True if the image is in the middle of the aperture.
    """

    position_m: Floats
    along: Floats
    range_m: float
    depth_m: float = 0.0
    looks_inside: bool = False

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.position_m)

    @property
    def length_m(self) -> float:
        """Length of the diagonal of the box that holds the channels."""
        return float(np.linalg.norm(np.ptp(self.position_m, axis=0)))


def log_uniform(rng: Generator, low: float, high: float) -> float:
    """Return a number whose logarithm is spread evenly."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def aperture(
    rng: Generator, shape: str, channels: int, spacing_m: float, wave_m: float
) -> Aperture:
    """Return an aperture of about as many channels; `wave_m` is the scale of their jitter."""
    return _SHAPES[shape](rng, channels, spacing_m, wave_m)


def _straight(rng: Generator, n: int, spacing_m: float, wave_m: float) -> Aperture:
    range_m = n * spacing_m * log_uniform(rng, 0.5, 4)
    return Aperture(along_x(n, spacing_m), np.tile([1.0, 0, 0], (n, 1)), range_m)


def _jittered(rng: Generator, n: int, spacing_m: float, wave_m: float) -> Aperture:
    """A straight track with sway and heave of up to some wavelengths, and uneven pings."""
    straight = _straight(rng, n, spacing_m, wave_m)
    position_m = straight.position_m.copy()
    position_m[:, 0] += spacing_m * rng.uniform(-0.3, 0.3, n)
    u = np.linspace(0, 1, n)[:, None]
    sway_m = wave_m * log_uniform(rng, 0.1, 10)
    for cycles in range(1, 4):
        phase = rng.uniform(0, 1, 2)
        position_m[:, 1:] += sway_m / cycles * np.sin(2 * np.pi * (cycles * u + phase))
    position_m[:, 1:] += wave_m * log_uniform(rng, 0.01, 0.5) * rng.normal(size=(n, 2))
    return Aperture(position_m, straight.along, straight.range_m)


def _heaving(rng: Generator, n: int, spacing_m: float, wave_m: float) -> Aperture:
    """A straight track with a heave of up to a tenth of the range, along waves or at random."""
    straight = _straight(rng, n, spacing_m, wave_m)
    position_m = straight.position_m.copy()
    waves = np.sin(2 * np.pi * (log_uniform(rng, 0.5, 10) * np.linspace(0, 1, n) + rng.random()))
    heave_m = straight.range_m * log_uniform(rng, 0.002, 0.05)
    position_m[:, 2] += heave_m * (waves if rng.random() < 0.7 else rng.uniform(-1, 1, n))
    return Aperture(position_m, straight.along, straight.range_m)


def _curved(rng: Generator, n: int, spacing_m: float, wave_m: float) -> Aperture:
    turn = rng.uniform(0.2, 2.0) * rng.choice([-1, 1])
    angle = np.linspace(-turn / 2, turn / 2, n)
    length_m = n * spacing_m
    position_m = length_m / turn * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], 1)
    position_m[:, 2] += rng.uniform(0, 0.05) * length_m * np.linspace(-1, 1, n) ** 2
    along = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    return Aperture(position_m, along, length_m * log_uniform(rng, 0.5, 4))


def _ring(rng: Generator, n: int, spacing_m: float, wave_m: float) -> Aperture:
    turns = int(rng.choice([1, 2, 5, 10]))
    around = max(n // turns, 24)
    angle = np.tile(2 * np.pi * np.arange(around) / around, turns)
    radius_m = around * spacing_m / (2 * np.pi)
    up = np.repeat(np.arange(turns), around) * rng.uniform(0.02, 0.1)
    return _round(rng, angle, radius_m, up, wave_m)


def _arc(rng: Generator, n: int, spacing_m: float, wave_m: float) -> Aperture:
    turns = int(rng.choice([1, 2, 5]))
    around = max(n // turns, 24)
    width = rng.uniform(1, 6)
    angle = np.tile(np.linspace(-width / 2, width / 2, around) - np.pi / 2, turns)
    up = np.repeat(np.arange(turns), around) * rng.uniform(0.02, 0.1)
    return _round(rng, angle, around * spacing_m / width, up, wave_m)


def _helix(rng: Generator, n: int, spacing_m: float, wave_m: float) -> Aperture:
    turns = rng.uniform(2, 8)
    angle = np.linspace(0, 2 * np.pi * turns, n)
    radius_m = n * spacing_m / (2 * np.pi * turns)
    up = np.linspace(0, turns * log_uniform(rng, 0.02, 0.2), n)
    return _round(rng, angle, radius_m, up, wave_m)


def _round(rng: Generator, angle: Floats, radius_m: float, up: Floats, wave_m: float) -> Aperture:
    """Return channels around the vertical, `up` in radii; half of such apertures are smooth."""
    off_m = wave_m * rng.choice([0, log_uniform(rng, 0.01, 3)])
    radius = radius_m + off_m * rng.normal(size=len(angle))
    position_m = np.stack([radius * np.cos(angle), radius * np.sin(angle), radius_m * up], 1)
    along = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], 1)
    return Aperture(position_m, along, radius_m, radius_m * rng.uniform(0, 2), looks_inside=True)


def _raster(rng: Generator, n: int, spacing_m: float, wave_m: float) -> Aperture:
    """Rows above each other, to and fro or always forth."""
    rows = int(rng.integers(4, 16))
    columns = n // rows
    way = np.where(np.arange(rows) % 2, rng.choice([1, -1]), 1)[:, None]
    x_m = way * (np.arange(columns) - (columns - 1) / 2) * spacing_m
    z_m = np.repeat((np.arange(rows) - (rows - 1) / 2) * spacing_m, columns)
    position_m = np.stack([x_m.ravel(), 0 * z_m, z_m], 1)
    position_m += wave_m * log_uniform(rng, 0.005, 0.5) * rng.normal(size=position_m.shape)
    heading = np.repeat(way.ravel(), columns).astype(float)
    along = np.stack([heading, 0 * heading, 0 * heading], 1)
    return Aperture(position_m, along, columns * spacing_m * log_uniform(rng, 0.7, 4))


def _planar(rng: Generator, n: int, spacing_m: float, wave_m: float) -> Aperture:
    """Channels anywhere in an upright square."""
    side = int(np.sqrt(n))
    width_m = side * spacing_m
    along_m, up_m = width_m * rng.uniform(-0.5, 0.5, (2, side * side))
    off_m = wave_m * log_uniform(rng, 0.005, 0.5) * rng.normal(size=side * side)
    position_m = np.stack([along_m, off_m, up_m], 1)
    along = np.tile([1.0, 0, 0], (side * side, 1))
    return Aperture(position_m, along, width_m * log_uniform(rng, 0.7, 4))


def _headings(rng: Generator, n: int, spacing_m: float, wave_m: float) -> Aperture:
    """Passes beside the image, on random headings."""
    passes = int(rng.integers(2, 5))
    each = n // passes
    length_m = each * spacing_m
    heading = np.repeat(rng.uniform(0, 2 * np.pi, passes), each)
    off_m = np.repeat(length_m * rng.uniform(0.1, 0.6, passes), each)
    ahead = np.stack([np.cos(heading), np.sin(heading), 0 * heading], 1)
    aside = np.stack([np.sin(heading), -np.cos(heading), 0 * heading], 1)
    x_m = np.tile(along_x(each, spacing_m)[:, 0], passes)
    position_m = x_m[:, None] * ahead + off_m[:, None] * aside
    depth_m = length_m * rng.uniform(0.05, 0.6)
    return Aperture(position_m, ahead, length_m / 2, depth_m, looks_inside=True)


def _star(rng: Generator, n: int, spacing_m: float, wave_m: float) -> Aperture:
    """Passes that cross above the image."""
    passes = int(rng.integers(3, 7))
    each = max(n // passes, 33)
    heading = np.repeat(np.pi * np.arange(passes) / passes, each)
    ahead = np.stack([np.cos(heading), np.sin(heading), 0 * heading], 1)
    x_m = np.tile(along_x(each, spacing_m)[:, 0], passes)
    range_m = each * spacing_m * rng.uniform(0.1, 0.6)
    return Aperture(x_m[:, None] * ahead, ahead, range_m, range_m, looks_inside=True)


_SHAPES: dict[str, Callable[[Generator, int, float, float], Aperture]] = {
    "straight": _straight,
    "jittered": _jittered,
    "heaving": _heaving,
    "curved": _curved,
    "ring": _ring,
    "arc": _arc,
    "helix": _helix,
    "raster": _raster,
    "planar": _planar,
    "headings": _headings,
    "star": _star,
}
