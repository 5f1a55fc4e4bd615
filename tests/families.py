"""Random scenes by family, each with a float64 sum that shares nothing with clsas.

A scene is drawn from a family and a seed. Its echoes are analytic points or band-limited noise; the
ideal image is known at some pixels: at random ones, and around the points. From the library a scene
uses only the containers `RangeLines`, `Grid` and `BeamWindow`, and the oracle.

Lengths are drawn in wavelengths of the middle of the band. Pixels may be farther apart than the
resolution: only errors matter here, and they do not depend on it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import finufft
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.sonar.beam import BeamWindow
from clsas.trials import oracle

Floats = NDArray[np.float64]

SPEED_M_S = 1500.0
SAMPLED = 70  # random pixels at which the ideal image is known, besides those around the points
AROUND = 6  # pixels around every point
FLAT, EDGE = 0.8, 0.017  # of the band: its flat part, and the deviation of its Gaussian edges
FADED = 6.0  # standard deviations, after which a Gaussian is 1.5e-8
SPARE = 100  # samples of noise lines beyond the pixels, over half of which they fade
OMITTED_DB = -300.0  # images below this are empty


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

    band: tuple[float, float] = (0.08, 0.6)  # of the carrier, between which it is drawn
    on_carrier: float = 0.2  # probability
    spacing: tuple[float, float] = (0.3, 3.0)  # of channels, wavelengths
    aperture: tuple[str, ...] = ("straight", "jittered", "curved")
    antennas: tuple[str, ...] = ("monostatic",)
    velocity: tuple[str, ...] = ("none",)
    beam: tuple[str, ...] = ("none",)
    gains: tuple[str, ...] = ("equal",)
    grid: tuple[str, ...] = ("plane", "plane", "tilted")
    echoes: tuple[str, ...] = ("points", "points", "noise")


DENSE = ("ring", "arc", "helix", "raster", "planar", "headings", "star")
EVERY_APERTURE = ("straight", "jittered", "curved", *DENSE)
APART = ("beside", "fixed tx", "fixed rx", "array")
BEAMS = ("hann", "hamming", "tukey", "rectangular")
CLOSE = (0.2, 1.0)  # so that many channels see a pixel through a beam

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
        aperture=("straight", "jittered"), beam=BEAMS, spacing=CLOSE, echoes=("points at the edge",)
    ),
    "dark under a beam": Family(
        aperture=("straight", "jittered", "headings"),
        beam=BEAMS,
        spacing=CLOSE,
        echoes=("points outside",),
    ),
    "gains": Family(gains=("loud off the track", "log-normal", "40 dB")),
    "gains, dense": Family(aperture=DENSE, gains=("loud off the track", "log-normal", "40 dB")),
    "reliefs and points": Family(grid=("relief", "points")),
    "reliefs and points with beam": Family(
        aperture=EVERY_APERTURE, beam=BEAMS, spacing=CLOSE, grid=("relief", "points")
    ),
    "anything": Family(
        band=(0.005, 1.9),
        on_carrier=0.3,
        aperture=EVERY_APERTURE,
        antennas=("monostatic", "near", *APART),
        velocity=("none", "none", "even", "uneven"),
        beam=("none", *BEAMS),
        gains=("equal", "equal", "loud off the track", "log-normal", "40 dB"),
        grid=("plane", "tilted", "relief", "points"),
        echoes=("points", "noise", "points at the edge"),
    ),
}


def draw(family: str, seed: int) -> Scene:
    """Return a random scene of a family."""
    # Families draw different scenes from one seed.
    return _Draw(FAMILIES[family], np.random.default_rng([seed, *family.encode()])).scene()


@dataclass
class _Draw:
    """One scene that is being drawn. Lengths are in metres."""

    family: Family
    rng: Generator
    words: list[str] = field(default_factory=list)

    def scene(self) -> Scene:
        rng, family = self.rng, self.family
        self.carrier_hz = 10 ** rng.uniform(4.3, 6)
        self.wave_m = SPEED_M_S / self.carrier_hz
        self.fraction = self.between(*family.band)
        self.channels = int(rng.integers(100, 600))
        self.words.append(f"band {self.fraction:.1%} of {self.carrier_hz / 1e3:.0f} kHz")
        self.words.append(f"{self.channels} channels")
        tx_m, along = self.aperture(self.choose(family.aperture))
        self.channels = len(tx_m)
        self.length_m = float(np.linalg.norm(np.ptp(tx_m, axis=0)))
        tx_m, rx_m = self.antennas(self.choose(family.antennas), tx_m)
        velocity_m_s = self.velocity(self.choose(family.velocity))
        gains, tx_m, rx_m = self.gains(self.choose(family.gains), tx_m, rx_m)
        grid, pixels_m = self.pixels(self.choose(family.grid))
        beam = self.beam(self.choose(family.beam), along, pixels_m, (tx_m + rx_m) / 2)
        ranges_m = _Ranges(tx_m, rx_m, velocity_m_s)
        return self.received(
            self.choose(family.echoes), ranges_m, grid, pixels_m, beam, along, gains
        )

    def choose(self, choices: tuple[str, ...]) -> str:
        chosen = choices[self.rng.integers(len(choices))]
        if chosen not in ("none", "equal", "monostatic"):
            self.words.append(chosen)
        return chosen

    def between(self, low: float, high: float) -> float:
        """Return a number whose logarithm is spread evenly."""
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def direction(self) -> Floats:
        vector = self.rng.normal(size=3)
        return vector / np.linalg.norm(vector)

    # Apertures lie about the origin; the image lies at y > 0, or within them.

    def aperture(self, shape: str) -> tuple[Floats, Floats]:
        """Return positions and the direction of the platform there, [channels, 3] each."""
        n, spacing_m = self.channels, self.wave_m * self.between(*self.family.spacing)
        self.looks_inside = shape in ("ring", "helix", "star", "headings")
        self.depth_m = 0.0
        make: Callable = getattr(self, "_" + shape)
        return make(n, spacing_m)

    def _straight(self, n: int, spacing_m: float) -> tuple[Floats, Floats]:
        position_m = np.zeros((n, 3))
        position_m[:, 0] = (np.arange(n) - (n - 1) / 2) * spacing_m
        self.range_m = n * spacing_m * self.between(0.5, 4)
        return position_m, np.tile([1.0, 0, 0], (n, 1))

    def _jittered(self, n: int, spacing_m: float) -> tuple[Floats, Floats]:
        position_m, along = self._straight(n, spacing_m)
        position_m[:, 0] += spacing_m * self.rng.uniform(-0.3, 0.3, n)
        u = np.linspace(0, 1, n)[:, None]
        sway_m = self.wave_m * self.between(0.1, 10)
        for cycles in range(1, 4):
            phase = self.rng.uniform(0, 1, 2)
            position_m[:, 1:] += sway_m / cycles * np.sin(2 * np.pi * (cycles * u + phase))
        position_m[:, 1:] += self.wave_m * self.between(0.01, 0.5) * self.rng.normal(size=(n, 2))
        return position_m, along

    def _curved(self, n: int, spacing_m: float) -> tuple[Floats, Floats]:
        turn = self.rng.uniform(0.2, 2.0) * self.rng.choice([-1, 1])
        angle = np.linspace(-turn / 2, turn / 2, n)
        radius_m = n * spacing_m / turn
        self.range_m = n * spacing_m * self.between(0.5, 4)
        position_m = radius_m * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], 1)
        position_m[:, 2] += self.rng.uniform(0, 0.05) * n * spacing_m * np.linspace(-1, 1, n) ** 2
        return position_m, np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)

    def _ring(self, n: int, spacing_m: float) -> tuple[Floats, Floats]:
        turns = int(self.rng.choice([1, 2, 5, 10]))
        around = max(n // turns, 24)
        angle = np.tile(2 * np.pi * np.arange(around) / around, turns)
        radius_m = around * spacing_m / (2 * np.pi)
        z_m = np.repeat(np.arange(turns) * radius_m * self.rng.uniform(0.02, 0.1), around)
        self.range_m, self.depth_m = radius_m, radius_m * self.rng.uniform(0, 2)
        return self._round(angle, radius_m, z_m)

    def _arc(self, n: int, spacing_m: float) -> tuple[Floats, Floats]:
        turns = int(self.rng.choice([1, 2, 5]))
        around = max(n // turns, 24)
        width = self.rng.uniform(1, 6)
        angle = np.tile(np.linspace(-width / 2, width / 2, around) - np.pi / 2, turns)
        radius_m = around * spacing_m / width
        z_m = np.repeat(np.arange(turns) * radius_m * self.rng.uniform(0.02, 0.1), around)
        self.looks_inside = True
        self.range_m, self.depth_m = radius_m, radius_m * self.rng.uniform(0, 2)
        return self._round(angle, radius_m, z_m)

    def _helix(self, n: int, spacing_m: float) -> tuple[Floats, Floats]:
        turns = self.rng.uniform(2, 8)
        angle = np.linspace(0, 2 * np.pi * turns, n)
        radius_m = n * spacing_m / (2 * np.pi * turns)
        self.range_m, self.depth_m = radius_m, radius_m * self.rng.uniform(0, 2)
        z_m = np.linspace(0, radius_m * turns * self.between(0.02, 0.2), n)
        return self._round(angle, radius_m, z_m)

    def _round(self, angle: Floats, radius_m: float, z_m: Floats) -> tuple[Floats, Floats]:
        off_m = self.wave_m * self.rng.choice([0, self.between(0.01, 3)])
        radius = radius_m + off_m * self.rng.normal(size=len(angle))
        position_m = np.stack([radius * np.cos(angle), radius * np.sin(angle), z_m], 1)
        return position_m, np.stack([-np.sin(angle), np.cos(angle), 0 * angle], 1)

    def _raster(self, n: int, spacing_m: float) -> tuple[Floats, Floats]:
        rows = int(self.rng.integers(4, 16))
        columns = n // rows
        x = (np.arange(columns) - (columns - 1) / 2) * spacing_m
        way = self.rng.choice([1, -1])  # to and fro, or always forth
        x_m = np.concatenate([x * (way if row % 2 else 1) for row in range(rows)])
        heading = np.repeat([(way if row % 2 else 1) for row in range(rows)], columns)
        z_m = np.repeat((np.arange(rows) - (rows - 1) / 2) * spacing_m, columns)
        self.range_m = columns * spacing_m * self.between(0.7, 4)
        jitter_m = self.wave_m * self.between(0.005, 0.5) * self.rng.normal(size=(len(x_m), 3))
        along = np.stack([heading, 0 * heading, 0 * heading], 1).astype(float)
        return np.stack([x_m, 0 * x_m, z_m], 1) + jitter_m, along

    def _planar(self, n: int, spacing_m: float) -> tuple[Floats, Floats]:
        side = int(np.sqrt(n))
        along, up = self.rng.uniform(-0.5, 0.5, (2, side * side))
        position_m = side * spacing_m * np.stack([along, 0 * along, up], 1)
        position_m[:, 1] += self.wave_m * self.between(0.005, 0.5) * self.rng.normal(size=side**2)
        self.range_m = side * spacing_m * self.between(0.7, 4)
        return position_m, np.tile([1.0, 0, 0], (side**2, 1))

    def _headings(self, n: int, spacing_m: float) -> tuple[Floats, Floats]:
        passes = int(self.rng.integers(2, 5))
        each = n // passes
        x_m = (np.arange(each) - (each - 1) / 2) * spacing_m
        length_m = each * spacing_m
        positions, directions = [], []
        for _ in range(passes):
            heading = self.rng.uniform(0, 2 * np.pi)
            ahead = np.array([np.cos(heading), np.sin(heading), 0])
            aside = np.array([np.sin(heading), -np.cos(heading), 0])
            off_m = length_m * self.rng.uniform(0.1, 0.6)
            positions.append(x_m[:, None] * ahead + off_m * aside)
            directions.append(np.tile(ahead, (each, 1)))
        self.range_m, self.depth_m = length_m / 2, length_m * self.rng.uniform(0.05, 0.6)
        return np.concatenate(positions), np.concatenate(directions)

    def _star(self, n: int, spacing_m: float) -> tuple[Floats, Floats]:
        passes = int(self.rng.integers(3, 7))
        each = max(n // passes, 33)
        x_m = (np.arange(each) - (each - 1) / 2) * spacing_m
        heading = np.repeat(np.pi * np.arange(passes) / passes, each)
        ahead = np.stack([np.cos(heading), np.sin(heading), 0 * heading], 1)
        self.range_m = self.depth_m = each * spacing_m * self.rng.uniform(0.1, 0.6)
        return np.tile(x_m, passes)[:, None] * ahead, ahead

    def antennas(self, kind: str, centre_m: Floats) -> tuple[Floats, Floats]:
        """Return transmitters and receivers."""
        if kind == "monostatic":
            return centre_m, centre_m
        near, far = (0.001, 0.01) if kind == "near" else (0.01, 0.25)
        apart_m = self.direction() * self.range_m * self.between(near, far)
        if kind == "array":
            starts = np.arange(len(centre_m)) // 8 * 8
            return centre_m[starts] + apart_m, centre_m
        if kind.startswith("fixed"):
            fixed_m = np.tile(centre_m.mean(axis=0) + apart_m, (len(centre_m), 1))
            return (fixed_m, centre_m) if kind == "fixed tx" else (centre_m, fixed_m)
        return centre_m, centre_m + apart_m

    def velocity(self, kind: str) -> Floats | None:
        """Return velocities of the receivers, or None."""
        if kind == "none":
            return None
        velocity_m_s = self.direction() * self.rng.uniform(1, 8) + np.zeros((self.channels, 3))
        if kind == "uneven":
            velocity_m_s = velocity_m_s + self.between(0.3, 5) * self.rng.normal(
                size=(self.channels, 3)
            )
        return velocity_m_s

    def gains(self, kind: str, tx_m: Floats, rx_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Return gains of the channels, and the antennas: a loud channel may leave the track."""
        n = self.channels
        if kind == "log-normal":
            return 10 ** (self.rng.uniform(5, 15) * self.rng.normal(size=n) / 20), tx_m, rx_m
        if kind == "40 dB":
            return 10 ** (self.rng.uniform(-40, 0, n) / 20), tx_m, rx_m
        gains = np.ones(n)
        if kind == "loud off the track":
            loud = self.rng.integers(n)
            gains[loud] = 10 ** (self.rng.uniform(15, 45) / 20)
            off_m = self.direction() * self.wave_m * self.rng.uniform(0.2, 3)
            tx_m, rx_m = (np.array(each) for each in (tx_m, rx_m))
            tx_m[loud] += off_m
            rx_m[loud] += off_m
        return gains, tx_m, rx_m

    def pixels(self, kind: str) -> tuple[Grid, Floats]:
        """Return a grid and where its pixels lie, [n, 3]."""
        rng = self.rng
        if self.looks_inside:
            centre_m = np.append(rng.uniform(-0.3, 0.3, 2) * self.range_m, -self.depth_m)
            extent_m = self.range_m * self.between(0.08, 0.5)
        else:
            squint = rng.uniform(-0.3, 0.3) * self.length_m
            down = rng.uniform(0, 0.5)
            centre_m = np.array([squint, self.range_m * np.cos(down), -self.range_m * np.sin(down)])
            extent_m = self.range_m * self.between(0.05, 0.4)
        rows, columns = (int(self.between(48, 260)) for _ in range(2))
        aspect = self.between(0.4, 2.5)
        x_m, y_m = extent_m * aspect**0.5, extent_m / aspect**0.5
        if kind == "points":
            count = int(rng.integers(300, 3000))
            thick = rng.choice([0.01, 0.3])
            offset = rng.uniform(-0.5, 0.5, (count, 3)) * [x_m, y_m, extent_m * thick]
            return Grid.points(centre_m + offset), centre_m + offset
        axes = np.array([[1.0, 0, 0], [0, 1.0, 0]])
        if kind == "tilted":
            axes = np.linalg.qr(rng.normal(size=(3, 3)))[0][:2]
        right_m, down_m = axes[0] * x_m / columns, axes[1] * y_m / rows
        origin_m = centre_m - right_m * (columns - 1) / 2 - down_m * (rows - 1) / 2
        grid = Grid.oriented(origin_m, down_m, right_m, (rows, columns))
        i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
        place_m = origin_m + i[..., None] * down_m + j[..., None] * right_m
        if kind == "relief":
            steep = self.between(0.01, 0.3) * extent_m
            cycles, phase = rng.uniform(0.3, 3, 2), rng.uniform(0, 1, 2)
            height_m = steep * np.sin(
                2 * np.pi * (cycles[0] * i / rows + cycles[1] * j / columns + phase[0])
            )
            height_m += 0.02 * steep * rng.normal(size=height_m.shape)
            grid = grid.with_height(height_m)
            place_m[..., 2] += height_m
        return grid, place_m.reshape(-1, 3)

    def beam(
        self, kind: str, along: Floats, pixels_m: Floats, centre_m: Floats
    ) -> BeamWindow | None:
        """Return a beam that sees the whole of the grid, parts of it, or its edges."""
        if kind == "none":
            return None
        width = self.between(8, 120)
        # Towards some pixel from some channel, so that the beam sees something.
        seen = self.rng.integers(len(centre_m)), self.rng.integers(len(pixels_m))
        sine = _sines(along[seen[0]][None], pixels_m[seen[1]][None], centre_m[seen[0]][None])[0, 0]
        room = 90 - width / 2
        squint = np.clip(np.degrees(np.arcsin(sine)), -room, room) * self.rng.choice([0, 1])
        self.words[-1] += f" {width:.0f} deg, squint {squint:.0f}"
        given = along[0] if np.all(along == along[0]) else along
        normalise = bool(self.rng.random() < 0.2)
        if normalise:
            self.words[-1] += ", normalised"
        return BeamWindow(width, kind, squint_deg=squint, along=given, normalise=normalise)

    def received(
        self,
        kind: str,
        ranges_m: _Ranges,
        grid: Grid,
        pixels_m: Floats,
        beam: BeamWindow | None,
        along: Floats,
        gains: Floats,
    ) -> Scene:
        """Return the scene as it is received."""
        rng = self.rng
        centre, width = (2 / SPEED_M_S * hz for hz in (self.carrier_hz, self.band_hz))
        oversampling = rng.uniform(1.15, 2.2)
        on_carrier = rng.random() < self.family.on_carrier and self.fraction > 0.05
        if on_carrier:  # what is sampled includes the band
            highest = centre + width / 2
            step_m = 1 / (2 * highest * self.between(1.05, 1.6))
            mixed = 0.0
            self.words.append("on carrier")
        else:
            step_m = 1 / (width * oversampling)
            mixed = centre + width * rng.choice([0, rng.uniform(-0.3, 0.3)])
        some = rng.choice(len(pixels_m), min(SAMPLED, len(pixels_m)), replace=False)
        weights = np.ones((self.channels, 1))
        all_ranges = ranges_m(pixels_m[:: max(len(pixels_m) // 300, 1)])
        nearest_m, farthest_m = all_ranges.min(), all_ranges.max()
        if kind == "noise":
            margin_m = SPARE * step_m + 0.05 * (farthest_m - nearest_m)
            first_m = nearest_m - margin_m
            length = int((farthest_m - nearest_m + 2 * margin_m) / step_m) + 1
            noise = _Noise(rng, self.channels, length, centre, width * 0.95, mixed, step_m, gains)
            samples = noise.samples()
            at_m = ranges_m(pixels_m[some])
            values = noise.received(at_m - first_m, mixed * at_m)
        else:
            targets_m, near = self.targets(kind, pixels_m, beam, along, ranges_m)
            some = np.unique(np.append(some, near))
            amplitude = rng.normal(size=(len(targets_m), 2)) @ [1, 1j]
            of_targets_m = ranges_m(targets_m)
            bands = [
                oracle.Band(centre, FLAT * width, EDGE * width, tilt_db=rng.choice([0, 0, 10]))
            ]
            fade_m = FADED / (2 * np.pi * EDGE * width)
            first_m = min(nearest_m, of_targets_m.min()) - 1.02 * fade_m
            last_m = max(farthest_m, of_targets_m.max()) + 1.02 * fade_m
            length = int((last_m - first_m) / step_m) + 1
            samples = (
                _points(of_targets_m, amplitude, bands, first_m, step_m, length, mixed, fade_m)
                * gains[:, None]
            )
            at_m = ranges_m(pixels_m[some])
            echo = oracle.Echo(of_targets_m, amplitude * gains[:, None], bands)
            values = oracle.received([echo], at_m)
        if beam is not None:
            sines = _sines(along, pixels_m[some], (ranges_m.tx_m + ranges_m.rx_m) / 2)
            weights = _weights(beam, sines)
        lines = RangeLines(
            samples, first_m, step_m, ranges_m.tx_m, ranges_m.rx_m,
            mixed * SPEED_M_S / 2, SPEED_M_S, ranges_m.velocity_m_s,
        )  # fmt: skip
        ideal = np.sum(weights * values, axis=0)
        self.words.append(f"{length} samples, {'x'.join(map(str, grid.shape))} pixels")
        return Scene(", ".join(self.words), lines, grid, beam, some, ideal)

    @property
    def band_hz(self) -> float:
        """Width of the band; it ends above 0 Hz."""
        return self.fraction * self.carrier_hz

    def targets(
        self,
        kind: str,
        pixels_m: Floats,
        beam: BeamWindow | None,
        along: Floats,
        ranges_m: _Ranges,
    ) -> tuple[Floats, NDArray[np.int64]]:
        """Return points at pixels, and the numbers of pixels around them."""
        rng, count = self.rng, int(self.between(2, 16))
        likely = np.ones(len(pixels_m))
        if beam is not None and kind != "points":
            some = np.unique(rng.integers(0, len(along), 40))
            centre_m = (ranges_m.tx_m + ranges_m.rx_m)[some] / 2
            sums = _weights(beam, _sines(along[some], pixels_m, centre_m), bare=True).mean(axis=0)
            edge = (sums > 0) & (sums < 0.05 * max(sums.max(), 1e-9))
            wanted = edge if kind == "points at the edge" else sums == 0
            likely = np.where(wanted, 1.0, 0.0) if wanted.any() else likely
        chosen = rng.choice(len(pixels_m), count, p=likely / likely.sum())
        # Points are off the pixels, as they are in life.
        targets_m = pixels_m[chosen] + 0.3 * self.wave_m * rng.normal(size=(count, 3))
        step = rng.integers(-3, 4, (count, AROUND))
        near = np.clip(chosen[:, None] + step, 0, len(pixels_m) - 1)
        return targets_m, np.unique(near)


@dataclass(frozen=True, eq=False)
class _Ranges:
    """Half the paths from antennas over points, [channels, points]."""

    tx_m: Floats
    rx_m: Floats
    velocity_m_s: Floats | None

    def __call__(self, points_m: Floats) -> Floats:
        # |x - tx| + |x - rx - v tau| = c tau is a quadratic in tau. With q = x - tx, d = x - rx and
        # R = |q|, its larger root is the delay.
        q, d = (points_m[None] - each[:, None] for each in (self.tx_m, self.rx_m))
        out_m = np.linalg.norm(q, axis=-1)
        if self.velocity_m_s is None:
            return (out_m + np.linalg.norm(d, axis=-1)) / 2
        v = self.velocity_m_s[:, None] / SPEED_M_S
        a = 1 - np.sum(v * v, axis=-1)
        b = out_m - np.sum(d * v, axis=-1)
        c = out_m**2 - np.sum(d * d, axis=-1)
        return (b + np.sqrt(b * b - a * c)) / a / 2


def _points(
    range_m: Floats,
    amplitude: NDArray[np.complex128],
    bands: list[oracle.Band],
    first_m: float,
    step_m: float,
    length: int,
    mixed: float,
    fade_m: float,
) -> NDArray[np.complex128]:
    """Return range lines of points, [channels, length], evaluated where pulses have not faded."""
    samples = np.zeros((len(range_m), length), np.complex128)
    rows = np.arange(len(range_m))[:, None]
    reach = np.arange(int(2 * fade_m / step_m) + 2)
    for number, value in enumerate(amplitude):
        start = np.floor((range_m[:, number] - fade_m - first_m) / step_m).astype(int)
        index = np.clip(start, 0, length - len(reach))[:, None] + reach
        at_m = first_m + step_m * index
        pulse = oracle.pulse(at_m - range_m[:, number, None], bands)
        samples[rows, index] += value * pulse * np.exp(-2j * np.pi * np.mod(mixed * at_m, 1))
    return samples


class _Noise:
    """Noise in a band, periodic in range, that fades at both ends of the lines."""

    def __init__(
        self,
        rng: Generator,
        channels: int,
        length: int,
        centre: float,
        width: float,
        mixed: float,
        step_m: float,
        gains: Floats,
    ) -> None:
        self.length, self.step_m = length, step_m
        bins = length * step_m  # per cycle per metre
        first = int(np.ceil((centre - width / 2 - mixed) * bins))
        count = max(int((centre + width / 2 - mixed) * bins) - first, 1)
        self.first = first
        self.spectrum = rng.normal(size=(channels, count, 2)) @ [1, 1j] * gains[:, None]

    def samples(self) -> NDArray[np.complex128]:
        n = self.length
        full = np.zeros((len(self.spectrum), n), np.complex128)
        full[:, (self.first + np.arange(self.spectrum.shape[1])) % n] = self.spectrum
        fade = 0.5 - 0.5 * np.cos(np.pi * (np.arange(SPARE // 2) + 0.5) / (SPARE // 2))
        envelope = np.ones(n)
        envelope[: len(fade)], envelope[n - len(fade) :] = fade, fade[::-1]
        return np.fft.ifft(full, axis=1) * n * envelope

    def received(self, offset_m: Floats, turns: Floats) -> NDArray[np.complex128]:
        """Return what is received at some ranges from the first sample, with carrier restored."""
        at = 2 * np.pi * offset_m / (self.length * self.step_m)
        count = self.spectrum.shape[1]
        values = np.empty(offset_m.shape, np.complex128)
        for line, (where, modes) in enumerate(zip(at, self.spectrum, strict=True)):
            values[line] = finufft.nufft1d2(
                where % (2 * np.pi), modes, eps=1e-12, isign=1, nthreads=1
            )
        middle = self.first + count // 2  # finufft counts modes from -(count // 2)
        return values * np.exp(1j * middle * at) * np.exp(2j * np.pi * np.mod(turns, 1))


def _sines(along: Floats, points_m: Floats, centre_m: Floats) -> Floats:
    """Sines of the aspect angles at which channels see points, [channels, points]."""
    towards = points_m[None] - centre_m[:, None]
    return np.einsum("cpi,ci->cp", towards, along) / np.linalg.norm(towards, axis=-1)


def _weights(beam: BeamWindow, sines: Floats, *, bare: bool = False) -> Floats:
    """Return a beam's weights from their definition; `bare` without normalising."""
    u = (np.degrees(np.arcsin(np.clip(sines, -1, 1))) - beam.squint_deg) / beam.width_deg
    if beam.shape == "hann":
        inside = np.cos(np.pi * u) ** 2
    elif beam.shape == "hamming":
        inside = 0.54 + 0.46 * np.cos(2 * np.pi * u)
    elif beam.shape == "tukey":
        share = np.clip((0.5 - np.abs(u)) / beam.taper, 0, 0.5)
        inside = np.sin(np.pi * share) ** 2
    else:
        inside = np.ones_like(u)
    weights = np.where(np.abs(u) < 0.5, inside, 0.0)
    if beam.normalise and not bare:
        weights = weights * len(sines) / np.maximum(weights.sum(axis=0), 0.01)
    return weights
