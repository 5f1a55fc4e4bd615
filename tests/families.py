"""Random scenes by family, each with a float64 sum that shares nothing with clsas.

A scene is drawn from a family and a seed. Its echoes are analytic points or band-limited noise; the
ideal image is known at some pixels: at random ones, and around the points. From the library a scene
uses only the containers `RangeLines`, `Grid` and `BeamWindow`, and the oracle.

Lengths are drawn in wavelengths of the middle of the band. Pixels may be farther apart than the
resolution: only errors matter here, and they do not depend on it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from apertures import Aperture, Floats, aperture, log_uniform
from numpy.random import Generator
from numpy.typing import NDArray
from rays import rays
from sums import SPEED_M_S, BentChannels, Both, Channels, Echoes, Noise, Points, Sampling, weights

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.sound_speed import STEEPEST_PER_S, SoundSpeed
from clsas.selftest import oracle

SAMPLED = 70  # random pixels at which the ideal image is known, besides those around the points
_AT_ONCE = 256  # which bounds memory
AROUND = 6  # pixels around every point, besides the one where it is


@dataclass(frozen=True, eq=False)
class Scene:
    """Lines, a grid and a beam, and the ideal image at some pixels.

    Attributes
    ----------
    words : str
        What was drawn.
    pixels : int64 [n]
        Flat numbers of the pixels at which the image is known.
    ideal : complex128 [n]
        Ideal image there.
    """

    words: str
    lines: RangeLines
    grid: Grid
    beam: BeamWindow | None
    pixels: NDArray[np.int64]
    ideal: NDArray[np.complex128]

    @property
    def is_dark(self) -> bool:
        """True if no channel contributes to any of the known pixels."""
        return not np.any(self.ideal)

    def error_db(self, pixels: NDArray) -> float:
        """Return the relative rms error of an image at the known pixels, dB."""
        return oracle.error_db(np.ravel(pixels)[self.pixels], self.ideal)


@dataclass(frozen=True)
class Family:
    """What scenes of a family are made of: each part is drawn from its choices."""

    band: tuple[float, float] = (0.08, 0.6)  # of the carrier
    on_carrier: float = 0.2  # probability that lines keep their carrier
    spacing: tuple[float, float] = (0.3, 3.0)  # of channels, wavelengths
    aperture: tuple[str, ...] = ("straight", "jittered", "curved")
    antennas: tuple[str, ...] = ("monostatic",)
    velocity: tuple[str, ...] = ("at rest",)
    beam: tuple[str, ...] = ("no beam",)
    gains: tuple[str, ...] = ("equal gains",)
    grid: tuple[str, ...] = ("plane", "plane", "tilted")
    echoes: tuple[str, ...] = ("points", "points", "noise")
    water: tuple[str, ...] = ("one speed",)
    occupied: tuple[str, ...] = ("whole band",)


DENSE = ("ring", "arc", "helix", "raster", "planar", "headings", "star")
EVERY_APERTURE = ("straight", "jittered", "curved", *DENSE)
APART = ("beside", "fixed tx", "fixed rx", "array")
BEAMS = ("hann", "hamming", "tukey", "rectangular")
ROUNDED_SINE = 1e-5  # bound on what a device rounds of the sine of an aspect angle
CLOSE = (0.2, 1.0)  # so that many channels see a pixel through a beam
WIDE = (3.0, 30.0)  # so that ranges are tens to hundreds of metres
PROFILES = ("gradient", "thermocline", "layers")
UNEVEN = ("loud off the track", "log-normal", "40 dB")

FAMILIES = {
    "plain": Family(),
    "bands": Family(band=(0.005, 1.9), on_carrier=0.4),
    "apart": Family(antennas=APART),
    "apart, narrow": Family(band=(0.005, 0.1), antennas=APART),
    "moving": Family(band=(0.005, 0.3), velocity=("even", "uneven"), antennas=("near", *APART)),
    "rings": Family(on_carrier=0.6, aperture=("ring", "arc", "helix")),
    "dense": Family(aperture=DENSE),
    "dense, narrow, apart": Family(band=(0.005, 0.1), aperture=DENSE, antennas=APART),
    "headings with beam": Family(
        aperture=("headings", "star", "curved"), beam=BEAMS, spacing=CLOSE
    ),
    "dense with beam": Family(
        aperture=("ring", "arc", "helix", "raster", "planar"), beam=BEAMS, spacing=CLOSE
    ),
    "beams": Family(aperture=("straight", "jittered"), beam=BEAMS, spacing=CLOSE),
    "beam's edge": Family(
        aperture=("straight", "jittered"), beam=BEAMS, spacing=CLOSE,
        echoes=("points at the edge",),
    ),
    "dark under a beam": Family(
        aperture=("straight", "jittered", "headings"), beam=BEAMS, spacing=CLOSE,
        echoes=("points outside",),
    ),
    "echoes from beside the grid": Family(spacing=CLOSE, echoes=("points beside the grid",)),
    "echoes from beside grid and beam": Family(
        beam=BEAMS, spacing=CLOSE, echoes=("points beside the grid",)
    ),
    "gaps in the band": Family(
        on_carrier=0.0, echoes=("points",), occupied=("two sub-bands", "hopping")
    ),
    "gains": Family(gains=UNEVEN),
    "gains, dense": Family(aperture=DENSE, gains=UNEVEN),
    "reliefs and points": Family(grid=("relief", "points")),
    "reliefs and points with beam": Family(
        aperture=EVERY_APERTURE, beam=BEAMS, spacing=CLOSE, grid=("relief", "points")
    ),
    "profiles": Family(
        spacing=WIDE, grid=("plane",), water=PROFILES, velocity=("at rest", "at rest", "even"),
        antennas=("monostatic", "near"),
    ),
    "profiles with beam": Family(
        spacing=WIDE, grid=("plane",), water=PROFILES, beam=("hann", "tukey"),
    ),
    "profiles and reliefs": Family(
        spacing=WIDE, grid=("relief", "points"), water=PROFILES, antennas=("monostatic", "near"),
    ),
    "profiles with heave and motion": Family(
        band=(0.005, 0.3), spacing=WIDE, aperture=("heaving",), antennas=("monostatic", "near"),
        velocity=("at rest", "even"), grid=("plane", "from close to far"), water=PROFILES,
    ),
    "anything": Family(
        band=(0.005, 1.9),
        on_carrier=0.3,
        aperture=EVERY_APERTURE,
        antennas=("monostatic", "near", *APART),
        velocity=("at rest", "at rest", "even", "uneven"),
        beam=("no beam", *BEAMS),
        gains=("equal gains", "equal gains", *UNEVEN),
        grid=("plane", "tilted", "relief", "points"),
        echoes=("points", "noise", "points at the edge"),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class _Parts:
    """One of the choices of a family for each part."""

    aperture: str
    antennas: str
    velocity: str
    beam: str
    gains: str
    grid: str
    echoes: str
    water: str
    occupied: str

    @classmethod
    def of(cls, rng: Generator, family: Family) -> _Parts:
        names = [part.name for part in dataclasses.fields(cls)]
        choices = [getattr(family, name) for name in names]
        return cls(*(each[rng.integers(len(each))] for each in choices))


def draw(name: str, seed: int, sampled: int = SAMPLED) -> Scene:
    """Return a random scene of a family, whose ideal image is known at `sampled` random pixels."""
    family = FAMILIES[name]
    rng = np.random.default_rng([seed, *name.encode()])  # families differ in what a seed draws
    parts = _Parts.of(rng, family)
    is_bent = parts.water != "one speed"
    carrier_hz = log_uniform(rng, *((6e4, 3e5) if is_bent else (2e4, 1e6)))
    fraction = log_uniform(rng, *family.band)
    wave_m = SPEED_M_S / carrier_hz
    spacing_m = wave_m * log_uniform(rng, *family.spacing)
    around = aperture(rng, parts.aperture, int(rng.integers(100, 600)), spacing_m, wave_m)
    channels = _channels(rng, parts, around, wave_m)
    grid, pixels_m = _pixels(rng, parts.grid, around, wave_m, (0.15 if is_bent else 0, 0.5))
    if is_bent:
        channels = _in_water(rng, parts.water, channels, pixels_m, wave_m)
    beam = _beam(rng, parts.beam, channels, pixels_m)
    on_carrier = bool(rng.random() < family.on_carrier and fraction > 0.05)
    sampling = _sampling(rng, carrier_hz, fraction, on_carrier)
    if parts.occupied != "whole band":  # otherwise it is not known what lies within the band
        sampling = dataclasses.replace(sampling, mixed=sampling.centre)
    echoes, near = _echoes(rng, parts.echoes, channels, sampling, pixels_m, beam, wave_m)
    if parts.occupied != "whole band":
        echoes = _with_a_gap(rng, parts.occupied, echoes)
    lines = RangeLines(
        echoes.samples(), echoes.first_m, sampling.step_m, channels.tx_m, channels.rx_m,
        sampling.mixed * SPEED_M_S / 2, SPEED_M_S, channels.velocity_m_s,
        sound_speed=_profile(channels),
    )  # fmt: skip
    some = rng.choice(len(pixels_m), min(sampled, len(pixels_m)), replace=False)
    some = np.unique(np.append(some, near))
    if beam is not None and beam.jumps:
        # Rounding decides whether a channel counts whose beam ends at a pixel.
        sine = channels.sines(pixels_m[some])[..., None]
        apart = np.abs(sine - beam.limits).min(axis=(0, 2))
        some = some[apart > ROUNDED_SINE] if (apart > ROUNDED_SINE).any() else some
    ideal = np.zeros(len(some), np.complex128)
    for first in range(0, len(some), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        values = echoes.received(channels.ranges_m(pixels_m[some[part]]))
        if beam is not None:
            values *= weights(beam, channels.sines(pixels_m[some[part]]))
        ideal[part] = values.sum(axis=0)
    said = [
        *dataclasses.astuple(parts),
        f"band {fraction:.1%} of {carrier_hz / 1e3:.0f} kHz{', on carrier' * on_carrier}",
        f"{lines.channels} channels of {lines.length} samples",
        f"{'x'.join(map(str, grid.shape))} pixels",
    ]
    if isinstance(channels, BentChannels):
        speeds, reach_m = channels.speed_m_s, np.ptp(channels.depth_m)
        said.append(f"{speeds[0]:.1f} to {speeds[-1]:.1f} m/s over {reach_m:.0f} m")
        said.append(f"range {around.range_m:.0f} m")
    if beam is not None:
        said.append(f"beam {beam.width_deg:.0f} deg, squint {beam.squint_deg:.0f}")
        said.append("normalised" * beam.normalise)
    words = ", ".join(each for each in said if each and each not in _ORDINARY)
    return Scene(words, lines, grid, beam, some, ideal)


_ORDINARY = ("monostatic", "at rest", "no beam", "equal gains", "one speed", "whole band")


def _channels(rng: Generator, parts: _Parts, around: Aperture, wave_m: float) -> Channels:
    """Return the antennas of an aperture, and their gains."""
    tx_m, rx_m = _antennas(rng, parts.antennas, around)
    n, gain = around.channels, np.ones(around.channels)
    if parts.gains == "log-normal":
        gain = 10 ** (rng.uniform(5, 15) * rng.normal(size=n) / 20)
    elif parts.gains == "40 dB":
        gain = 10 ** (rng.uniform(-40, 0, n) / 20)
    elif parts.gains == "loud off the track":
        loud = rng.integers(n)
        gain[loud] = 10 ** (rng.uniform(15, 45) / 20)
        off_m = _direction(rng) * wave_m * rng.uniform(0.2, 3)
        tx_m, rx_m = tx_m.copy(), rx_m.copy()
        tx_m[loud] += off_m
        rx_m[loud] += off_m
    return Channels(tx_m, rx_m, _velocity(rng, parts.velocity, n), gain, around.along)


def _antennas(rng: Generator, kind: str, around: Aperture) -> tuple[Floats, Floats]:
    """Return transmitters and receivers, up to a quarter of the range apart."""
    centre_m = around.position_m
    if kind == "monostatic":
        return centre_m, centre_m
    near, far = (0.001, 0.01) if kind == "near" else (0.01, 0.25)
    apart_m = _direction(rng) * around.range_m * log_uniform(rng, near, far)
    if kind == "array":  # pings of eight receivers
        return centre_m[np.arange(len(centre_m)) // 8 * 8] + apart_m, centre_m
    if kind.startswith("fixed"):
        fixed_m = np.tile(centre_m.mean(axis=0) + apart_m, (len(centre_m), 1))
        return (fixed_m, centre_m) if kind == "fixed tx" else (centre_m, fixed_m)
    return centre_m, centre_m + apart_m


def _in_water(
    rng: Generator, kind: str, channels: Channels, pixels_m: Floats, wave_m: float
) -> BentChannels:
    """Return channels in water in which rays fall from all antennas to all pixels."""
    antennas_m = np.concatenate([channels.tx_m, channels.rx_m])
    if channels.velocity_m_s is not None:  # where receivers are when the last echo arrives
        reach_m = np.linalg.norm(pixels_m[None] - antennas_m[::7, None], axis=-1).max()
        flight_s = 2.2 * reach_m / SPEED_M_S
        antennas_m = np.concatenate([antennas_m, channels.rx_m + flight_s * channels.velocity_m_s])
    room_m = 10 * wave_m + 1.0
    top, bottom = antennas_m[:, 2].max() + room_m, pixels_m[:, 2].min() - room_m
    highest, lowest = float(pixels_m[:, 2].max()), float(antennas_m[:, 2].min())
    share = {
        "gradient": np.array([0.0, 1.0]),
        "thermocline": np.cumsum([0.0, rng.uniform(0.1, 0.6), rng.uniform(0.02, 0.2), 1.0]),
        "layers": np.append(0.0, np.sort(rng.uniform(0.05, 0.95, 3))),
    }[kind]
    share[-1] = 1.0
    change = rng.normal(size=len(share)).cumsum()
    if kind == "gradient":
        change = rng.choice([-1.0, 1.0]) * share
    elif kind == "thermocline":
        change = np.array([0.0, 0.0, -1.0, -1.0 + 0.05 * rng.normal()])
    change *= rng.uniform(0.1, 1.0) * min(top - bottom, 30.0) / np.ptp(change)
    steepest_per_s = np.max(np.abs(np.diff(change) / np.diff(share * (top - bottom))))
    change *= min(1.0, STEEPEST_PER_S / (1.01 * steepest_per_s))  # as profiles allow
    surface_z_m = top + rng.uniform(0, 10)
    depth_m = surface_z_m - top + share * (top - bottom)
    found = BentChannels(
        **vars(channels), depth_m=depth_m, speed_m_s=1490 + change, surface_z_m=surface_z_m
    )
    far_m = 1.1 * np.linalg.norm(pixels_m[None, ::7, :2] - antennas_m[::7, None, :2], axis=-1).max()
    ends = surface_z_m - np.array([lowest, highest + room_m])
    # Weaker changes until rays fall all the way between the heights that are nearest each other.
    for _ in range(12):
        if np.isfinite(rays(depth_m, found.speed_m_s, far_m, *ends)[0]):
            return found
        change = change / 2
        found = dataclasses.replace(found, speed_m_s=1490 + change)
    return dataclasses.replace(found, speed_m_s=np.full(len(share), 1490.0))


def _profile(channels: Channels) -> SoundSpeed | None:
    if not isinstance(channels, BentChannels):
        return None
    return SoundSpeed(channels.depth_m, channels.speed_m_s, channels.surface_z_m)


def _velocity(rng: Generator, kind: str, channels: int) -> Floats | None:
    """Return velocities of the receivers, or None."""
    if kind == "at rest":
        return None
    velocity_m_s = np.tile(_direction(rng) * rng.uniform(1, 8), (channels, 1))
    if kind == "uneven":
        velocity_m_s += log_uniform(rng, 0.3, 5) * rng.normal(size=(channels, 3))
    return velocity_m_s


def _direction(rng: Generator) -> Floats:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def _pixels(
    rng: Generator, kind: str, around: Aperture, wave_m: float, falls: tuple[float, float]
) -> tuple[Grid, Floats]:
    """Return a grid and where its pixels lie, [n, 3].

    `falls` are the least and the largest angle below the horizontal in which the grid is seen.
    """
    if around.looks_inside:
        centre_m = np.append(rng.uniform(-0.3, 0.3, 2) * around.range_m, -around.depth_m)
    else:
        along_m, down = rng.uniform(-0.3, 0.3) * around.length_m, rng.uniform(*falls)
        away_m = around.range_m * np.array([np.cos(down), -np.sin(down)])
        centre_m = np.append(along_m, away_m)
    rows, columns = (int(log_uniform(rng, 48, 260)) for _ in range(2))
    extent_m = around.range_m * log_uniform(rng, 0.05, 0.4)
    if rng.random() < 0.7:  # as images are: the aperture resolves about a pixel
        resolved_m = wave_m * max(around.range_m / (2 * around.length_m), 0.25)
        fine_m = resolved_m * log_uniform(rng, 0.15, 2) * (rows * columns) ** 0.5
        extent_m = min(extent_m, fine_m)
    aspect = log_uniform(rng, 0.4, 2.5)
    sides_m = extent_m * aspect**0.5, extent_m / aspect**0.5
    if kind == "from close to far":
        near_m = rng.uniform(0.5, 2) * -centre_m[2]
        sides_m = sides_m[0], abs(centre_m[1] - near_m)
        centre_m[1] = (centre_m[1] + near_m) / 2
    if kind == "points":
        count = int(rng.integers(300, 3000))
        thick_m = extent_m * rng.choice([0.01, 0.3])
        points_m = centre_m + rng.uniform(-0.5, 0.5, (count, 3)) * [*sides_m, thick_m]
        return Grid.points(points_m), points_m
    axes = np.eye(3)[:2]
    if kind == "tilted":
        axes = np.linalg.qr(rng.normal(size=(3, 3)))[0][:2]
    right_m, down_m = axes[0] * sides_m[0] / columns, axes[1] * sides_m[1] / rows
    origin_m = centre_m - right_m * (columns - 1) / 2 - down_m * (rows - 1) / 2
    grid = Grid.oriented(origin_m, down_m, right_m, (rows, columns))
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    places_m = origin_m + i[..., None] * down_m + j[..., None] * right_m
    if kind == "relief":
        height_m = _relief_m(rng, i / rows, j / columns, extent_m)
        grid = grid.with_height(height_m)
        places_m[..., 2] += height_m
    return grid, places_m.reshape(-1, 3)


def _relief_m(rng: Generator, down: Floats, across: Floats, extent_m: float) -> Floats:
    """Return waves, and some roughness."""
    most_m = log_uniform(rng, 0.01, 0.3) * extent_m
    cycles = rng.uniform(0.3, 3, 2)
    waves = np.sin(2 * np.pi * (cycles[0] * down + cycles[1] * across + rng.random()))
    return most_m * (waves + 0.02 * rng.normal(size=waves.shape))


def _beam(rng: Generator, shape: str, channels: Channels, pixels_m: Floats) -> BeamWindow | None:
    """Return a beam that sees all of the grid, parts of it, or its edges."""
    if shape == "no beam":
        return None
    width_deg = log_uniform(rng, 8, 120)
    # Half of the beams look from some channel towards some pixel, the others to broadside.
    pixel_m = pixels_m[rng.integers(len(pixels_m))][None]
    sine = channels.sines(pixel_m)[rng.integers(len(channels.gain)), 0]
    room_deg = 90 - width_deg / 2
    squint_deg = np.clip(np.degrees(np.arcsin(sine)), -room_deg, room_deg) * rng.choice([0, 1])
    along = channels.along
    if (along == along[0]).all():
        along = along[0]
    normalise = bool(rng.random() < 0.2)
    return BeamWindow(width_deg, shape, squint_deg, along=along, normalise=normalise)


def _sampling(rng: Generator, carrier_hz: float, fraction: float, on_carrier: bool) -> Sampling:
    """Return how lines of a band are sampled: complex samples hold 1 / step_m."""
    centre = 2 / SPEED_M_S * carrier_hz
    width = centre * fraction
    if on_carrier:
        return Sampling(
            centre, width, 0.0, 0.5 / (centre + width / 2) / log_uniform(rng, 1.05, 1.6)
        )
    mixed = centre + width * rng.choice([0, rng.uniform(-0.3, 0.3)])
    return Sampling(centre, width, mixed, 1 / (width * rng.uniform(1.15, 2.2)))


def _echoes(
    rng: Generator,
    kind: str,
    channels: Channels,
    sampling: Sampling,
    pixels_m: Floats,
    beam: BeamWindow | None,
    wave_m: float,
) -> tuple[Echoes, NDArray[np.int64]]:
    """Return what is received, and the numbers of pixels around points."""
    range_m = channels.ranges_m(pixels_m[:: max(len(pixels_m) // 300, 1)])
    span_m = float(range_m.min()), float(range_m.max())
    if kind == "noise":
        return Noise.of(rng, channels, sampling, span_m), np.zeros(0, np.int64)
    count = int(log_uniform(rng, 2, 16))
    likely = _wanted(rng, kind, channels, pixels_m, beam)
    chosen = rng.choice(len(pixels_m), count, p=likely / likely.sum())
    # Points are off the pixels, as they are in life.
    points_m = pixels_m[chosen] + 0.3 * wave_m * rng.normal(size=(count, 3))
    amplitude = rng.normal(size=(count, 2)) @ [1, 1j]
    if kind == "points beside the grid":
        amplitude *= 10 ** (rng.uniform(-70, -25) / 20)
        beside_m = _beside(rng, channels, points_m[: rng.integers(1, 4)])
        points_m = np.concatenate([points_m, beside_m])
        amplitude = np.append(amplitude, rng.normal(size=(len(beside_m), 2)) @ [1, 1j])
    tilt_db = float(rng.choice([0, 0, 10]))
    # Coarse pixels beside a point hold side lobes only: the brightest must be among the known.
    around = chosen[:, None] + rng.integers(-3, 4, (count, AROUND))
    near = np.append(chosen, np.clip(around, 0, len(pixels_m) - 1))
    return Points.of(channels, sampling, points_m, amplitude, tilt_db, span_m), near


def _beside(rng: Generator, channels: Channels, points_m: Floats) -> Floats:
    """Return points turned about the middle of the channels: at their ranges, but elsewhere."""
    middle_m = channels.centres_m.mean(axis=0)
    away_m = points_m - middle_m
    axis = np.cross(away_m[0], channels.along.mean(axis=0))
    axis /= np.linalg.norm(axis)
    turn = rng.choice([-1, 1]) * np.radians(log_uniform(rng, 5, 60))
    across = np.cross(axis, away_m)
    level = np.outer(away_m @ axis, axis)  # Rodrigues' formula
    return middle_m + np.cos(turn) * (away_m - level) + np.sin(turn) * across + level


def _with_a_gap(rng: Generator, kind: str, echoes: Points) -> Points | Both:
    """Return echoes in two parts of the band: both in all channels, or a few in another."""
    whole = echoes.sampling
    width = whole.width * rng.uniform(0.1, 0.3)
    low, high = (
        dataclasses.replace(
            whole, centre=whole.centre + side * (whole.width - width) / 2, width=width
        )
        for side in (-1, 1)
    )
    if kind == "two sub-bands":
        return Both(echoes.within(low), echoes.within(high))
    few = rng.random(len(echoes.channels.gain)) < rng.choice([0.02, 0.5])
    return Both(echoes.within(low, ~few), echoes.within(high, few))


def _wanted(
    rng: Generator, kind: str, channels: Channels, pixels_m: Floats, beam: BeamWindow | None
) -> Floats:
    """Return 1 for pixels where points may be, [pixels]: anywhere, or where the beam ends."""
    anywhere = np.ones(len(pixels_m))
    if beam is None or kind in ("points", "points beside the grid"):
        return anywhere
    some = np.unique(rng.integers(0, len(channels.gain), 40))
    sines = channels.select(some).sines(pixels_m)
    sums = weights(beam, sines, normalise=False).mean(axis=0)
    lit = (sums > 0) & (sums < 0.05 * sums.max())
    wanted = lit if kind == "points at the edge" else sums == 0
    return wanted.astype(float) if wanted.any() else anywhere
