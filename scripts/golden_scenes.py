"""Scenes of `scripts/golden`: their lines, grids and beams, and their images in float64.

Of the library a scene uses only what users use, `clsas.X`. The float64 images share nothing with
the imagers: lines are sums of complex tones, so their value at any range is known, and ranges and
weights follow from their definitions. Only the weights of some windows come from
`BeamWindow.weights`.

All data are the same on every machine. Random numbers come from NumPy's streams, and positions and
samples are rounded to multiples of 2^-20, because sines and sums may differ in their last bits.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

import clsas

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

SPEED_M_S = 1500.0
KNOWN = 48  # pixels of a scene at which the float64 image is computed
_QUANTUM = 2.0**-20
_SPARE = 120  # samples of a line beyond the ranges of the grid, at each end
_FADE = 80  # of them, over how many a line fades
_TONES = 32  # tones whose phases are powers of each other, in float64 sums


@dataclass(frozen=True, eq=False)
class Scene:
    """Lines, a grid and a beam, and the ideal image at some pixels.

    Attributes
    ----------
    pixels : int64 [n]
        Flat numbers of the pixels at which the ideal image is known; empty if it is not.
    ideal : complex128 [n]
        Ideal image there.
    """

    lines: clsas.RangeLines
    grid: clsas.Grid
    beam: clsas.BeamWindow | None
    pixels: NDArray[np.int64]
    ideal: Complex

    def error_db(self, image: clsas.Image) -> float:
        """Return the relative rms error of an image at the known pixels, dB."""
        error = np.ravel(image.pixels)[self.pixels].astype(np.complex128) - self.ideal
        return float(20 * np.log10(np.linalg.norm(error) / np.linalg.norm(self.ideal) + 1e-30))


def scene(
    grid: clsas.Grid,
    tx_m: ArrayLike,
    rx_m: ArrayLike | None = None,
    *,
    carrier_hz: float = 120e3,
    band: float = 0.2,
    sampled: float = 1.25,
    centre: float = 0.0,
    on_carrier: bool = False,
    velocity_m_s: ArrayLike | None = None,
    beam: clsas.BeamWindow | None = None,
    gains: ArrayLike = 1.0,
    own_starts: bool = False,
    cut_off: int = 0,
    gradient_per_s: float | None = None,
    look_direction: ArrayLike | None = None,
    seed: int = 0,
) -> Scene:
    """Return a scene with noise in every channel, at all ranges of a grid.

    Parameters
    ----------
    grid : Grid
    tx_m, rx_m : array_like, [channels, 3]
        Antennas; by default monostatic.
    carrier_hz, band : float
        Middle of the band, and its width as a share of that.
    sampled : float
        Sample rate over bandwidth.
    centre : float
        Middle of the band after mixing, cycles per sample.
    on_carrier : bool
        True for lines that keep their carrier.
    velocity_m_s : array_like, optional
        Velocity of the receivers during flight.
    beam : BeamWindow, optional
        With `along`, if the track is not parallel to x.
    gains : array_like
        Of the channels.
    own_starts : bool
        True if lines begin at different ranges.
    cut_off : int
        Samples that are missing at the ends of the lines, which then do not fade.
    gradient_per_s : float, optional
        Growth of the sound speed with depth, in water whose surface is at z = 0.
    look_direction : array_like, optional
        Direction in which elements look.
    seed : int
    """
    tx, rx = (rounded(tx_m if each is None else each) for each in (tx_m, rx_m))
    velocity = None if velocity_m_s is None else rounded(velocity_m_s) + np.zeros(tx.shape)
    rng = np.random.default_rng(seed)
    profile = None
    if gradient_per_s is not None:
        deepest_m = 1 - min(grid.bounds_m[0][2], tx[:, 2].min(), rx[:, 2].min())
        speeds = [SPEED_M_S, SPEED_M_S + gradient_per_s * deepest_m]
        profile = clsas.SoundSpeed([0.0, deepest_m], speeds, 0.0)

    def ranges_m(points: Floats) -> Floats:
        if gradient_per_s is None:
            return _ranges_m(points, tx, rx, velocity)
        legs = (_delays_s(points, each, gradient_per_s) for each in (tx, rx))
        return SPEED_M_S / 2 * sum(legs)

    # Lines that hold all ranges of the grid.
    positions_m = grid.positions_m().reshape(-1, 3)
    some = positions_m[:: max(len(positions_m) // 300, 1)]
    range_m = ranges_m(np.concatenate([some, positions_m[-1:]]))
    cycles_per_m = 2 * carrier_hz / SPEED_M_S
    if on_carrier:
        step_m, centre = rounded(0.4 / (cycles_per_m * (1 + band / 2))), 0.0
    else:
        step_m = rounded(1 / (sampled * band * cycles_per_m))
    first_m, last_m = range_m.min(axis=0), range_m.max(axis=0)
    if own_starts:
        first_m = first_m + step_m * rng.uniform(-0.5, 0.5, len(tx))
    else:
        first_m = np.full(len(tx), first_m.min())
    first_m = rounded(first_m - _SPARE * step_m)
    length = int(np.ceil((last_m - first_m).max() / step_m)) + _SPARE

    # Tones of random amplitude, whose frequencies are multiples of the inverse length.
    mixed = 0.0 if on_carrier else cycles_per_m
    middle = cycles_per_m * step_m if on_carrier else centre
    half = 0.475 * band * cycles_per_m * step_m
    lowest, count = int(np.ceil((middle - half) * length)), int(2 * half * length)
    tones = rng.normal(size=(len(tx), count, 2)) @ [1, 1j]
    tones *= np.broadcast_to(np.sqrt(0.5 / count) * np.asarray(gains), len(tx))[:, None]
    spectrum = np.zeros((len(tx), length), complex)
    spectrum[:, (lowest + np.arange(count)) % length] = tones
    samples = np.fft.ifft(spectrum, axis=1) * length
    fade = 0.5 - 0.5 * np.cos(np.pi * (np.arange(_FADE) + 0.5) / _FADE)
    samples[:, :_FADE] *= fade
    samples[:, length - _FADE :] *= fade[::-1]
    samples = rounded(samples.view(np.float64)).view(complex)
    kept = slice(cut_off, length - cut_off)
    lines = clsas.RangeLines(
        samples[:, kept].astype(np.complex64),
        first_m + cut_off * step_m,
        step_m,
        tx,
        rx,
        0.0 if on_carrier else carrier_hz,
        SPEED_M_S,
        velocity,
        look_direction=look_direction,
        sound_speed=profile,
    )

    # The ideal image at some pixels.
    pixels = rng.choice(grid.size, min(KNOWN, grid.size), replace=False)
    range_m = ranges_m(positions_m[pixels])
    turns = (range_m - first_m) / (length * step_m)
    values = _tones_at(turns, lowest, tones) * np.exp(2j * np.pi * np.mod(mixed * range_m, 1))
    if beam is not None:
        values *= _weights(beam, positions_m[pixels], (tx + rx) / 2, SPEED_M_S / carrier_hz)
    return Scene(lines, grid, beam, pixels, values.sum(axis=1))


def rounded(values: ArrayLike) -> Any:
    """Return values as multiples of 2^-20."""
    return np.round(np.asarray(values, np.float64) / _QUANTUM) * _QUANTUM


def _ranges_m(points: Floats, tx: Floats, rx: Floats, velocity: Floats | None) -> Floats:
    """Return half the paths over points, [points, channels].

    With q = x - tx, d = x - rx and R = |q|, the delay tau to a receiver that moves with v satisfies
    |d - v tau| = c tau - R. It is the root of (c^2 - v^2) tau^2 - 2 (c R - d.v) tau + R^2 - |d|^2
    for which c tau is not below R.
    """
    q, d = (points[:, None] - each for each in (tx, rx))
    out = np.linalg.norm(q, axis=-1)
    if velocity is None:
        return (out + np.linalg.norm(d, axis=-1)) / 2
    v = velocity / SPEED_M_S  # and tau in metres
    a = 1 - np.sum(v * v, axis=-1)
    b = out - np.sum(d * v, axis=-1)
    c = out**2 - np.sum(d * d, axis=-1)
    return (b + np.sqrt(b * b - a * c)) / a / 2


def _delays_s(points: Floats, antennas: Floats, gradient_per_s: float) -> Floats:
    """Return travel times where the speed is SPEED_M_S + g depth, [points, channels].

    Rays are arcs of circles, and g tau = arccosh(1 + g^2 distance^2/(2 c_1 c_2)).
    """
    square = np.sum((points[:, None] - antennas) ** 2, axis=-1)
    c_1, c_2 = (SPEED_M_S - gradient_per_s * each[:, 2] for each in (points, antennas))
    excess = gradient_per_s**2 * square / (2 * c_1[:, None] * c_2)
    # arccosh(1 + e) = log1p(e + sqrt(e (2 + e))) keeps its digits where e is small
    return np.log1p(excess + np.sqrt(excess * (2 + excess))) / abs(gradient_per_s)


def _tones_at(turns: Floats, lowest: int, tones: Complex) -> Complex:
    """Return sums of tones over a part of their period, [pixels, channels]."""
    channels, count = tones.shape
    blocks = -(-count // _TONES)
    padded = np.zeros((channels, blocks * _TONES), complex)
    padded[:, :count] = tones
    turned = 2j * np.pi * np.mod(turns, 1).T[..., None]  # [channels, pixels, 1]
    within = np.exp(turned * np.arange(_TONES))
    between = np.exp(turned * (lowest + _TONES * np.arange(blocks)))
    sums = within @ padded.reshape(channels, blocks, _TONES).transpose(0, 2, 1)
    return np.sum(sums * between, axis=-1).T


def _weights(
    beam: clsas.BeamWindow, points: Floats, centres: Floats, wavelength_m: float
) -> Floats:
    """Return the weights of a beam from their definition, [points, channels]."""
    towards = points[:, None] - centres
    along = np.array([1.0, 0, 0]) if beam.along is None else beam.along
    sines = np.sum(towards * along, axis=-1) / np.linalg.norm(towards, axis=-1)
    u = (np.degrees(np.arcsin(np.clip(sines, -1, 1))) - beam.squint_deg) / beam.width_deg
    if beam.shape == "rectangular":
        weights = np.ones(u.shape)
    elif beam.shape == "hann":
        weights = np.cos(np.pi * u) ** 2
    elif beam.shape == "hamming":
        weights = 0.54 + 0.46 * np.cos(2 * np.pi * u)
    elif beam.shape == "tukey":
        weights = np.sin(np.pi * np.clip((0.5 - np.abs(u)) / beam.taper, 0, 0.5)) ** 2
    else:
        weights = beam.weights(sines, wavelength_m)
    weights = np.where(np.abs(u) < 0.5, weights, 0.0)
    if beam.normalise:
        weights *= len(centres) / np.maximum(weights.sum(axis=1), 0.01)[:, None]
    return weights


# Tracks and grids


def along_x(channels: int, spacing_m: float, offset_m: Sequence[float] = (0, 0, 0)) -> Floats:
    """Return positions along x about an offset, [channels, 3]."""
    x_m = (np.arange(channels) - (channels - 1) / 2) * spacing_m
    return x_m[:, None] * [1.0, 0, 0] + np.asarray(offset_m, np.float64)


def around(
    x: float, y: float, shape: tuple[int, int], pixel_m: tuple[float, float], z: float = 0.0
) -> clsas.Grid:
    """Return a horizontal plane about (x, y); `pixel_m` are the steps of rows and columns."""
    down, right = rounded(pixel_m)
    corner = rounded([x - (shape[1] - 1) / 2 * right, y - (shape[0] - 1) / 2 * down, z])
    return clsas.Grid.oriented(corner, [0, down, 0], [right, 0, 0], shape)


def swaying(channels: int, spacing_m: float, sway_m: float) -> Floats:
    """Return positions along x that sway and heave."""
    turn = np.linspace(0, 3 * np.pi, channels)
    wave = np.stack([0 * turn, np.sin(turn), 0.5 * np.cos(turn)], axis=1)
    return along_x(channels, spacing_m) + sway_m * wave


def circle(turns: int, around: int, radius_m: float, first_m: float, pitch_m: float) -> Floats:
    """Return turns of a helix about the vertical."""
    n = np.arange(turns * around)
    angle = 2 * np.pi * n / around
    return np.stack(
        [radius_m * np.cos(angle), radius_m * np.sin(angle), first_m + pitch_m * n / around], 1
    )


def headings_of(tx_m: Floats) -> Floats:
    """Return headings around the vertical."""
    angle = np.arctan2(tx_m[:, 1], tx_m[:, 0])
    return rounded(np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1))


def raster() -> Floats:
    """Return 32 lines of 48 channels above each other's sides, to and fro."""
    row, column = np.mgrid[0:32, 0:48]
    column = np.where(row % 2, 47 - column, column)
    return (0.06 * np.stack([column - 23.5, row - 15.5, 100 + 0 * row], axis=-1)).reshape(-1, 3)


def planar() -> Floats:
    """Return channels anywhere in a plane, in any order."""
    rng = np.random.default_rng(7)
    return np.column_stack([rng.uniform(-1.5, 1.5, (1500, 2)), rng.normal(6, 1e-3, 1500)])


def spiral() -> Floats:
    """Return 30 turns in a plane."""
    share = np.sqrt(np.arange(1, 1501) / 1500)
    angle = 60 * np.pi * share
    return 1.5 * np.stack([share * np.cos(angle), share * np.sin(angle), 4 + 0 * share], axis=1)


def passes() -> tuple[Floats, Floats]:
    """Return 6 passes beside the origin on 3 headings and 3 heights, and their headings."""
    number = np.repeat(np.arange(6), 150)[:, None]
    turn = np.radians(60 * (number % 3))
    ahead = rounded(np.hstack([np.cos(turn), np.sin(turn), 0 * turn]))
    aside = np.hstack([np.sin(turn), -np.cos(turn), 0 * turn])
    up_m = 5 + 1.5 * (number % 3) * [0, 0, 1.0]
    along_m = np.tile(along_x(150, 0.04), (6, 1))[:, :1]
    return along_m * ahead + (20 + 0.4 * number) * aside + up_m * [0, 0, 1.0], ahead


def star() -> tuple[Floats, Floats]:
    """Return 4 passes that cross 12 m above the origin, and their headings."""
    turn = np.radians(45 * np.repeat(np.arange(4), 150))
    ahead = rounded(np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1))
    return np.tile(along_x(150, 0.03), (4, 1))[:, :1] * ahead + [0, 0, 12], ahead


def hills(grid: clsas.Grid, height_m: float) -> clsas.Grid:
    """Return a plane raised by dunes."""
    row, column = np.indices(grid.shape)
    waves = np.sin(row / 20) * np.cos(column / 30)
    return grid.with_height(rounded(height_m * (waves + 0.01 * row)))


def volume(count: int, low_m: Sequence[float], high_m: Sequence[float]) -> clsas.Grid:
    """Return points anywhere in a box, one of them many times."""
    points = rounded(np.random.default_rng(4).uniform(low_m, high_m, (count, 3)))
    return clsas.Grid.points(np.concatenate([points, points[:1].repeat(20, axis=0)]))


UTM_M = np.array([5e5, 6.1e6, -2000.0])  # an offset of coordinates

# Exact images: 160 channels at 300 kHz, 21 m away.
SHORT = {"carrier_hz": 300e3, "band": 0.1}
TRACK = along_x(160, 0.0125)
PLANE = around(0.3, 21, (33, 40), (0.006, 0.006))


def short(grid: clsas.Grid = PLANE, tx_m: Floats = TRACK, **options: Any) -> Scene:
    """Return a scene of an exact image."""
    return scene(grid, tx_m, **(SHORT | options))


def beam(shape: str, width_deg: float = 8.0, **options: Any) -> clsas.BeamWindow:
    """Return a beam along x."""
    return clsas.BeamWindow(width_deg, shape, along=options.pop("along", [1, 0, 0]), **options)


EXACT: dict[str, Callable[[], Scene]] = {
    "exact, plane": lambda: short(),
    "exact, 1 channel": lambda: short(tx_m=TRACK[:1]),
    "exact, 2 channels": lambda: short(tx_m=TRACK[[3, 90]]),
    "exact, 3000 channels": lambda: short(
        around(0.3, 21, (16, 12), (0.006, 0.006)), along_x(3000, 0.001)
    ),
    "exact, 1 pixel": lambda: short(around(0.3, 21, (1, 1), (0.006, 0.006))),
    "exact, 1 row": lambda: short(around(0.3, 21, (1, 257), (0.006, 0.006))),
    "exact, 1 column": lambda: short(around(0.3, 21, (131, 1), (0.006, 0.006))),
    "exact, 61 x 67 pixels": lambda: short(around(0.3, 21, (61, 67), (0.006, 0.006))),
    "exact, tall grid": lambda: short(around(1.2, 22, (701, 5), (0.006, 0.006))),
    "exact, tilted plane": lambda: short(
        clsas.Grid.oriented(
            [1, 21, -5], *rounded([[0.001, 0.004, 0.003], [0.004, 0.0025, -0.001]]), (33, 40)
        )
    ),
    "exact, bistatic": lambda: short(
        tx_m=np.repeat(TRACK[::8], 8, axis=0) + [0.3, 0.1, -0.2], rx_m=TRACK
    ),
    "exact, moving receivers": lambda: short(
        rx_m=TRACK + [0.05, 0, 0.02],
        velocity_m_s=np.random.default_rng(2).uniform(-5.5, 5.5, TRACK.shape),
    ),
    "exact, heights": lambda: short(hills(around(0.3, 21, (33, 40), (0.006, 0.006), -9), 0.2)),
    "exact, moving over heights": lambda: short(
        hills(around(0.3, 21, (33, 40), (0.006, 0.006), -9), 0.5), velocity_m_s=[8.0, -3, 1]
    ),
    "exact, points": lambda: short(volume(400, [-2, 18, -9], [2, 24, -2])),
    "exact, own starts": lambda: short(
        tx_m=TRACK + np.random.default_rng(6).normal(0, 0.1, TRACK.shape), own_starts=True
    ),
    "exact, off-centre band": lambda: short(centre=0.35, sampled=1.4),
    "exact, on carrier": lambda: scene(
        PLANE, TRACK[::4], carrier_hz=30e3, band=0.4, on_carrier=True
    ),
    "exact, UTM": lambda: short(
        clsas.Grid.oriented(
            UTM_M + [0, 21, 0], rounded([0, 0.006, 0]), rounded([0.006, 0, 0]), (33, 40)
        ),
        TRACK + UTM_M,
    ),
    "exact, large pixels far away": lambda: short(
        around(2, 700, (33, 40), (0.5, 0.5), -400), along_x(64, 2.0), carrier_hz=50e3, band=0.03
    ),
    "exact, loud channel": lambda: short(gains=np.where(np.arange(160) == 70, 30.0, 1.0)),
    "exact, rectangular beam": lambda: short(beam=beam("rectangular", 4)),
    "exact, Hann beam, squinted, normalised": lambda: short(
        beam=beam("hann", 5, squint_deg=2, normalise=True)
    ),
    "exact, Tukey beam over points": lambda: short(
        volume(300, [-2, 18, -9], [2, 24, -2]), beam=beam("tukey", 9, taper=0.3)
    ),
    "exact, Taylor beam": lambda: short(beam=beam("taylor", 5)),
    "exact, inverse beam": lambda: short(beam=beam("inverse", 6, element_length_m=0.03)),
    "exact, Hamming beam over heights": lambda: short(
        hills(around(0.3, 21, (33, 40), (0.006, 0.006), -9), 0.2), beam=beam("hamming", 6)
    ),
    "exact, beam beside the grid": lambda: short(beam=beam("hann", 5, squint_deg=30)),
    "exact, lines end in the grid": lambda: short(cut_off=_SPARE - 2),
    "exact, full band": lambda: short(sampled=0.97),
    "exact, behind the elements": lambda: short(look_direction=[0, -1, 0]),
    "exact, refraction": lambda: short(
        around(0.3, 21, (33, 40), (0.006, 0.006), -25), TRACK + [0, 0, -5], gradient_per_s=0.4
    ),
}
"""Exact images of these scenes, with given taps and with a given accuracy."""

LONG = along_x(400, 0.014)
WIDE = (0.015, 0.015)


def long(x: float = 0, y: float = 30, shape: tuple[int, int] = (150, 160), **options: Any) -> Scene:
    """Return a scene of a factorized image: 120 kHz, a plane 30 m away, 400 channels."""
    return scene(around(x, y, shape, WIDE), options.pop("tx_m", LONG), **options)


def bistatic(**options: Any) -> Scene:
    """Return pings of 6 receivers whose phase centres overlap."""
    tx = np.repeat(along_x(70, 0.07), 6, axis=0)
    return long(tx_m=tx, rx_m=tx + np.tile(along_x(6, 0.028), (70, 1)), **options)


def dense(tx_m: Floats, grid: clsas.Grid | None = None, **options: Any) -> Scene:
    """Return a dense aperture at 30 kHz above a plane."""
    below = around(0, 0, (96, 96), (0.02, 0.02)) if grid is None else grid
    return scene(below, tx_m, carrier_hz=options.pop("carrier_hz", 30e3), band=0.3, **options)


def helix() -> Floats:
    """Return 16 turns of 120 channels."""
    return circle(16, 120, 1.2, 0.3, 0.02)


FINE = around(0, 0, (96, 96), (0.004, 0.004))

FACTORIZED: dict[str, tuple[Callable[[], Scene], dict[str, Any]]] = {
    "straight, -30 dB": (long, {"tolerance_db": -30}),
    "straight, -50 dB": (long, {"tolerance_db": -50}),
    "straight, -65 dB": (long, {"tolerance_db": -65}),
    "straight, near, wide band": (
        lambda: scene(around(0, 10, (150, 160), (0.006, 0.0075)), along_x(500, 0.006), band=0.5),
        {"tolerance_db": -50},
    ),
    "swaying": (lambda: long(tx_m=swaying(400, 0.014, 0.1)), {"tolerance_db": -60}),
    "swaying while moving": (
        lambda: long(
            tx_m=swaying(400, 0.014, 0.1),
            velocity_m_s=np.array([2, 0, 0]) + 0.1 * swaying(400, 0, 1.0),
        ),
        {"tolerance_db": -50},
    ),
    "array": (bistatic, {"tolerance_db": -45}),
    "moving array": (lambda: bistatic(velocity_m_s=[2.0, 0, 0]), {"tolerance_db": -45}),
    "fixed transmitter": (
        lambda: long(tx_m=np.tile([[0.2, -0.3, 1.0]], (400, 1)), rx_m=LONG),
        {"tolerance_db": -45},
    ),
    "arc": (
        lambda: scene(
            around(1, 2, (150, 160), (0.006, 0.006)),
            np.stack(
                [
                    30 * np.sin(turn := np.radians(np.linspace(-25, 25, 400))),
                    -30 * np.cos(turn),
                    0 * turn + 5,
                ],
                axis=1,
            ),
        ),
        {"tolerance_db": -50},
    ),
    "gap in the track": (
        lambda: long(tx_m=LONG + np.sign(LONG) * [0.8, 0, 0]),
        {"tolerance_db": -50},
    ),
    "over heights": (
        lambda: scene(hills(around(0, 30, (150, 160), WIDE, -12), 0.2), LONG),
        {"tolerance_db": -50},
    ),
    "points in a volume": (
        lambda: scene(volume(4000, [-1, 29, -8.05], [1, 31, -7.95]), LONG),
        {"tolerance_db": -40},
    ),
    "tilted plane": (
        lambda: scene(
            clsas.Grid.oriented(
                [-1, 29, -6], *rounded([[0.002, 0.014, 0.006], [0.014, -0.003, 0.001]]), (150, 160)
            ),
            LONG,
        ),
        {"tolerance_db": -50},
    ),
    "odd sides": (lambda: long(shape=(127, 211)), {"tolerance_db": -50}),
    "UTM": (
        lambda: scene(
            clsas.Grid.oriented(
                UTM_M + [-1, 29, 0], rounded([0, 0.015, 0]), rounded([0.015, 0, 0]), (150, 160)
            ),
            LONG + UTM_M,
        ),
        {"tolerance_db": -50},
    ),
    "on carrier": (
        lambda: long(carrier_hz=30e3, band=0.5, on_carrier=True, tx_m=along_x(300, 0.025)),
        {"tolerance_db": -45},
    ),
    "off-centre band": (lambda: long(centre=0.3, sampled=1.5), {"tolerance_db": -50}),
    "own starts": (
        lambda: long(tx_m=swaying(400, 0.014, 0.3), own_starts=True),
        {"tolerance_db": -50},
    ),
    "uneven gains": (
        lambda: long(gains=10 ** np.random.default_rng(8).uniform(-1.5, 0, 400)),
        {"tolerance_db": -50},
    ),
    "rectangular beam": (lambda: long(beam=beam("rectangular", 9)), {"tolerance_db": -45}),
    "Hann beam": (lambda: long(beam=beam("hann", 9)), {"tolerance_db": -50}),
    "Hann beam, squinted, normalised": (
        lambda: long(beam=beam("hann", 9, squint_deg=3, normalise=True)),
        {"tolerance_db": -45},
    ),
    "refraction": (
        lambda: scene(
            around(0, 30, (128, 128), WIDE, -25),
            along_x(400, 0.014, [0, 0, -5]),
            gradient_per_s=0.3,
        ),
        {"tolerance_db": -45},
    ),
    "passes": (lambda: dense(passes()[0], carrier_hz=60e3), {"tolerance_db": -45}),
    "passes with a beam": (
        lambda: dense(passes()[0], carrier_hz=60e3, beam=beam("hann", 14, along=passes()[1])),
        {"tolerance_db": -40},
    ),
    "star with a beam": (
        lambda: dense(
            star()[0],
            carrier_hz=60e3,
            beam=beam("hann", 40, along=star()[1]),
        ),
        {"tolerance_db": -40},
    ),
    "helix": (lambda: dense(helix(), FINE), {"tolerance_db": -45}),
    "jittered helix": (
        lambda: dense(helix() + np.random.default_rng(3).normal(0, 2e-3, (1920, 3)), FINE),
        {"tolerance_db": -40},
    ),
    "helix with a beam": (
        lambda: dense(helix(), FINE, beam=beam("hann", 60, along=headings_of(helix()))),
        {"tolerance_db": -40},
    ),
    "moving helix": (lambda: dense(helix(), FINE, velocity_m_s=[1, 0.5, 0]), {"tolerance_db": -40}),
    "ring": (lambda: dense(circle(1, 600, 8.0, 3.0, 0.0), FINE), {"tolerance_db": -45}),
    "raster": (lambda: dense(raster()), {"tolerance_db": -45}),
    "bistatic raster over heights": (
        lambda: dense(
            raster(),
            hills(around(0, 0, (96, 96), (0.02, 0.02)), 0.1),
            rx_m=raster() + [0.02, 0.03, 0],
        ),
        {"tolerance_db": -40},
    ),
    "spiral": (lambda: dense(spiral()), {"tolerance_db": -45}),
    "planar": (lambda: dense(planar()), {"tolerance_db": -40}),
    "given depth and taps": (long, {"tolerance_db": -50, "depth": 1, "taps": (8, 6)}),
    "full model": (
        lambda: bistatic(velocity_m_s=[0.5, 0, 0]),
        {"tolerance_db": -30, "full_model": True},
    ),
    "little memory": (
        lambda: long(shape=(256, 256)),
        {"tolerance_db": -50, "memory_bytes": 3 << 20},
    ),
    "lines that end in the grid": (lambda: long(cut_off=_SPARE - 2), {"tolerance_db": -50}),
    "stages of the thesis": (long, {"stages": [(4, 4), (4, 4)]}),
    "3 channels": (lambda: short(tx_m=TRACK[:3]), {"tolerance_db": -50}),
    "left out effects": (
        lambda: long(rx_m=LONG + [0.0005, 0, 0], velocity_m_s=[1e-3, 0, 0]),
        {"tolerance_db": -30},
    ),
    "usual costs": (lambda: long(shape=(300, 320)), {"tolerance_db": -40}),
    "usual costs, small": (lambda: long(shape=(30, 20)), {"tolerance_db": -40}),
}
"""Factorized images of these scenes, and the arguments of `clsas.plan`."""


# Everything else: functions that add images and numbers to a record.


class Record(Protocol):
    """Collects what scenes form."""

    def image(
        self,
        name: str,
        image: clsas.Image,
        of: Scene | None = None,
        *,
        within_db: float | None = None,
    ) -> None:
        """Add an image, with its error if the ideal image is known, or else its mean power."""

    def number(self, name: str, value: float) -> None:
        """Add a number that machines share to three digits."""

    def array(self, name: str, values: ArrayLike) -> None:
        """Add values that are compared bit for bit."""


def imager(record: Record) -> None:
    """Form two images of the same geometry, and add the second to the first."""
    one, other = long(), long(seed=1)
    with clsas.Imager(one.lines, one.grid, tolerance_db=-50) as formed:
        first = formed(one.lines)
        record.image("first", first, one, within_db=-50)
        record.image("second", formed(other.lines), other, within_db=-50)
        record.image("sum", formed(other.lines, accumulate=first))
    with clsas.Imager(one.lines, one.grid, accuracy_db=-50) as formed:
        record.image("exact", formed(other.lines), other, within_db=-50)


def pieces(record: Record) -> None:
    """Form an exact image from two halves of the channels."""
    whole = short()
    half = clsas.backproject(whole.lines.select(slice(0, 80)), whole.grid, taps=6, upsampling=3.0)
    image = clsas.backproject(
        whole.lines.select(slice(80, None)), whole.grid, taps=6, upsampling=3.0, accumulate=half
    )
    record.image("image", image, whole)


def layers(record: Record) -> None:
    """Image water with a thermocline, exactly and factorized: rays have no simple formula."""
    given = scene(around(0, 30, (64, 64), WIDE, -25), along_x(300, 0.018, [0, 0, -5]))
    water = clsas.SoundSpeed([0, 8, 12, 40], [1505, 1503, 1492, 1490], 0.0)
    lines = dataclasses.replace(given.lines, sound_speed=water)
    record.image("exact", clsas.backproject(lines, given.grid, taps=6, upsampling=3.0))
    record.image("factorized", clsas.factorize(lines, given.grid, -45))


ALONE = {"memory_bytes": 64 << 20}  # too little for more than one patch at a time


def mosaic_in_memory(record: Record) -> None:
    """Form a mosaic of exact patches, and one of factorized patches."""
    given = long(shape=(140, 150), tx_m=LONG[:200])
    for how in ({"accuracy_db": -50}, {"tolerance_db": -45}):
        found = clsas.mosaic(given.lines, given.grid, patches=(2, 3), **ALONE, **how)
        (name, asked_db), *_ = how.items()
        record.image(name, found.image(), given, within_db=asked_db)


def mosaic_in_store(record: Record) -> None:
    """Form a mosaic with a beam in a store."""
    given = long(shape=(140, 150), tx_m=LONG[:200], beam=beam("hann", 9))
    with tempfile.TemporaryDirectory() as folder:
        found = clsas.mosaic(
            given.lines, given.grid, Path(folder) / "mosaic.zarr", beam=given.beam,
            patches=(2, 2), accuracy_db=-50, **ALONE,
        )  # fmt: skip
        record.image("image", found.image(), given, within_db=-50)
        record.number("patches", len(clsas.Store(Path(folder) / "mosaic.zarr").records()))


def _banks(places: int) -> tuple[clsas.RangeLines, clsas.RangeLines]:
    """Return lines of two banks over speckle 0.2 m above the plane of a grid."""
    random = np.random.default_rng(1)
    places_m = random.uniform([-0.6, 19.4, 0.2], [0.6, 21.2, 0.2], (places, 3))
    speckle = clsas.PointTargets(places_m, random.standard_normal((places, 2)) @ [1, 1j])
    tx_m = along_x(81, 0.05, [0, 0, 6])
    lower, upper = (
        clsas.simulate_lines(
            tx_m, tx_m + [0, 0, up_m], speckle, carrier_hz=100e3, bandwidth_hz=30e3
        )
        for up_m in (0.0, 0.2)
    )
    return lower, upper


def heights(record: Record) -> None:
    """Compute the heights of a flat seabed from two banks."""
    grid = around(0, 20.2, (33, 33), (0.025, 0.025))
    found = clsas.heights(*_banks(4000), grid, search_m=(-0.4, 0.6))
    record.array("heights", found.height_m)
    record.number("share of pixels", float(np.mean(found.mask)))
    record.number("median, m", float(np.median(found.height_m[found.mask])))
    record.number("coherence", float(np.median(found.coherence[found.mask])))
    record.number("rms, m", float(np.std(found.height_m[found.mask])))


def interferogram(record: Record) -> None:
    """Compute an interferogram of two banks."""
    grid = around(0, 20.2, (40, 40), (0.025, 0.025), 0.2)
    images = [clsas.backproject(each, grid, taps=6, upsampling=2.0) for each in _banks(4000)]
    found = clsas.interferogram(*images, window_m=0.15)
    record.array("phases", found.phase_rad)
    record.number("phase, rad", float(np.median(np.abs(found.phase_rad))))
    record.number("coherence", float(np.median(found.coherence)))


def wavenumber(record: Record) -> None:
    """Form an image in the frequency domain."""
    given = scene(
        around(0.3, 42, (40, 40), (0.03, 0.02)), along_x(240, 0.06), carrier_hz=100e3, band=0.1,
        beam=beam("hann", 16),
    )  # fmt: skip
    record.image("image", clsas.wavenumber(given.lines, given.grid, beam=given.beam), given)


def looks(record: Record) -> None:
    """Average looks of several beams, and parts of the band."""
    given = long(shape=(64, 64), beam=beam("hann", 9))
    lines, grid = given.lines, given.grid
    how = {"taps": 6, "upsampling": 2.0}
    beams = beam("rectangular", 9).divided(3)
    images = [clsas.backproject(lines, grid, beam=each, **how) for each in beams]
    record.image("of beams", clsas.multilook(images, window_m=0.05))
    bands = [clsas.backproject(each, grid, **how) for each in clsas.sub_bands(lines, 2)]
    record.image("of bands", clsas.multilook(bands))
    record.number("contrast", clsas.contrast(images[0]))


def compressed_pings(record: Record) -> None:
    """Simulate pings, compress them, and measure the image of a point."""
    pulse = clsas.Pulse(carrier_hz=100e3, bandwidth_hz=30e3, duration_s=1e-3)
    sonar = clsas.Sonar(pulse, [[0, 0, 0], [0.05, 0, 0]], tx_length_m=0.06, rx_length_m=0.06)
    track = clsas.Track.straight((-2, 0, 0), (0.1, 0, 0), 40, 1.0)
    points = clsas.PointTargets([[0.0, 10.5, 0.0], [0.3, 10.8, 0.0]], [1.0, 0.5j])
    echoes = clsas.simulate(sonar, track, points, range_m=(10, 12), motion_in_flight=True)
    lines = clsas.compress(echoes, window="hamming")
    record.array("lines", lines.samples)
    record.number("power of lines", float(np.sqrt(np.mean(np.abs(lines.samples) ** 2))))
    grid = around(0.1, 10.6, (80, 80), (0.01, 0.01))
    image = clsas.backproject(
        clsas.density_compensated(lines), grid, taps=6, upsampling=2.0,
        beam=clsas.BeamWindow.of_element(0.06, 0.015, "hann"),
    )  # fmt: skip
    record.image("image", image)
    point = clsas.measure_point(image, (0.0, 10.5))
    record.number("resolution along the track, m", point.azimuth.resolution_m)
    record.number("resolution across it, m", point.range.resolution_m)


def phase_history(record: Record) -> None:
    """Image a phase history and a record of frequencies, as radars record them."""
    rng = np.random.default_rng(3)
    tx_m = along_x(64, 0.02)
    frequency_hz = 100e3 + 300.0 * np.arange(64)
    range_m = np.linalg.norm(tx_m - rng.uniform([-0.3, 9.8, 0], [0.3, 10.2, 0], (5, 1, 3)), axis=2)
    turns = 2 * frequency_hz / SPEED_M_S * (range_m[..., None] - 10.0)
    lines = clsas.from_phase_history(
        np.exp(-2j * np.pi * turns).sum(axis=0), first_frequency_hz=100e3, frequency_step_hz=300.0,
        reference_range_m=10.0, tx_m=tx_m, rx_m=tx_m, sound_speed_m_s=SPEED_M_S, window="hann",
    )  # fmt: skip
    grid = around(0, 10, (50, 50), (0.02, 0.02))
    record.image("image", clsas.backproject(lines, grid, taps=6, upsampling=2.0))


def autofocus(record: Record) -> None:
    """Find the sway of a sonar from points."""
    rng = np.random.default_rng(0)
    xyz_m = rng.uniform([0.6, 9.5, 0], [2.4, 11, 0], (30, 3))
    true_m = swaying(120, 0.025, 0.003) + [1.5, 0, 0]
    lines = clsas.simulate_lines(
        true_m, true_m, clsas.PointTargets(xyz_m, np.ones(30)), carrier_hz=100e3,
        bandwidth_hz=30e3,
    )  # fmt: skip
    navigated_m = along_x(120, 0.025, [1.5, 0, 0])
    lines = dataclasses.replace(lines, tx_m=navigated_m, rx_m=navigated_m)
    grid = clsas.Grid.plane(x=(0.4, 2.6, 80), y=(9.3, 11.2, 100))
    found = clsas.autofocus(lines, grid)
    record.array("corrections", found.correction_m)
    record.number("gain of sharpness", found.sharpness_after / found.sharpness_before)
    record.number("correction, m", float(np.std(found.correction_m[:, 1])))


def micronavigation(record: Record) -> None:
    """Find the sway of an array from speckle."""
    pulse = clsas.Pulse(carrier_hz=100e3, bandwidth_hz=30e3, duration_s=1e-3)
    rx_m = [[0.015 * n, 0, 0] for n in range(16)]
    sonar = clsas.Sonar(pulse, rx_m, tx_length_m=0.03, rx_length_m=0.03)
    rng = np.random.default_rng(0)
    speckle = clsas.PointTargets(
        rng.uniform([-3, 9, 0], [3, 13, 0], (800, 3)), rng.standard_normal((800, 2)) @ [1, 1j]
    )
    course = (0, 0, 0), (0.045, 0, 0), 5, 1.0
    true = clsas.Track.straight(*course, sway_m=[0, 2e-3, 1e-3, 3e-3, 0])
    lines = clsas.compress(clsas.simulate(sonar, true, speckle, range_m=(9.5, 12.5)))
    navigated = clsas.channels(sonar, clsas.Track.straight(*course))
    lines = dataclasses.replace(lines, tx_m=navigated.tx_m, rx_m=navigated.rx_m)
    found = clsas.micronavigate(lines, range_m=(10, 12), element_length_m=0.03)
    record.array("sway", found.sway_steps_m)
    for number, step_m in enumerate(found.sway_steps_m):
        record.number(f"step {number}, mm", 1e3 * float(step_m))


OTHERS: dict[str, Callable[[Record], None]] = {
    "imager": imager,
    "pieces of an image": pieces,
    "layers of water": layers,
    "mosaic": mosaic_in_memory,
    "mosaic in a store": mosaic_in_store,
    "heights": heights,
    "interferogram": interferogram,
    "wavenumber image": wavenumber,
    "looks": looks,
    "compressed pings": compressed_pings,
    "phase history": phase_history,
    "autofocus": autofocus,
    "micronavigation": micronavigation,
}
"""Scenes that are not a single image."""

NAMES = (*EXACT, *FACTORIZED, *OTHERS)
"""All scenes, in the order in which they are formed."""
