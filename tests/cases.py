"""Lines and grids that several test modules image, each with the physics of one use."""

from functools import cache, partial

import numpy as np
from exactly import execute, prepare, same_interpolator

from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.lines import RangeLines
from clsas.engine.signal.spectrum import Spectrum
from clsas.selftest.reference import ideal

SPARE = 160  # samples of a line beyond what a grid needs, at each end
TAPER = 100  # of them, over how many a line fades


def noise(channels, length, *, occupied=0.8, centre=0.0, seed=0):
    """Band-limited complex noise, [channels, length], that fades at both ends.

    `occupied` and `centre` are the width and the middle of its flat band, cycles per sample.
    """
    rng = np.random.default_rng(seed)
    spectrum = rng.normal(size=(channels, 2 * length, 2)) @ [1, 1j]
    distance = np.abs((np.fft.fftfreq(2 * length) - centre + 0.5) % 1 - 0.5)
    spectrum[:, distance > occupied / 2] = 0
    fade = 0.5 - 0.5 * np.cos(np.pi * (np.arange(TAPER) + 0.5) / TAPER)
    envelope = np.ones(length)
    envelope[:TAPER] = fade
    envelope[-TAPER:] = fade[::-1]
    return np.sqrt(length) * np.fft.ifft(spectrum, axis=1)[:, :length] * envelope


def lines_over(
    grid, tx, rx=None, *, carrier_hz, step_m, speed=1500.0, velocity=None, own_start=False, **band
):
    """Noise in every channel, at every range that a grid's pixels have.

    With `own_start` each channel begins at its own nearest pixel, and a part of a step from it.
    """
    rx = tx if rx is None else rx
    positions = grid.positions_m().reshape(-1, 3)
    positions = positions[:: max(len(positions) // 500, 1)]
    range_m = pairwise_range_m(positions, tx, rx, velocity, speed)
    first, last = range_m.min(axis=0), range_m.max(axis=0)
    if own_start:
        first = first + step_m * np.random.default_rng(5).uniform(-0.5, 0.5, len(tx))
    else:
        first = np.full(len(tx), first.min())
    length = int(np.ceil((last - first).max() / step_m)) + 2 * SPARE
    samples = noise(len(tx), length, **band)
    return RangeLines(samples, first - SPARE * step_m, step_m, tx, rx, carrier_hz, speed, velocity)


def along_x(channels, spacing_m, y=0.0, z=0.0):
    x = (np.arange(channels) - (channels - 1) / 2) * spacing_m
    return np.stack([x, np.full(channels, y), np.full(channels, z)], axis=1)


def beside(positions_m, *offset_m):
    """Positions moved by (x, y, z)."""
    return positions_m + np.array(offset_m)


# Chapter 5 of the thesis: 1 MHz, 100 kHz, 640 channels over 5.28 m; lines at 1.25 times the
# bandwidth.
CARRIER, STEP, PITCH = 1e6, 0.006, 4.9e-3
APERTURE = along_x(640, 8.25e-3)
thesis_lines = partial(lines_over, carrier_hz=CARRIER, step_m=STEP)


def patch(x, y, columns=40, rows=33, pitch=PITCH, z=0.0):
    """A small plane that begins at (x, y)."""
    return Grid.plane((x, x + (columns - 1) * pitch, columns), (y, y + (rows - 1) * pitch, rows), z)


def thesis():
    grid = Grid.plane((2.4, 2.4 + 15 * PITCH, 16), (40, 45, 1021))
    return thesis_lines(grid, APERTURE), grid


def bistatic():
    """One transmitter for each ping of 8 receivers, apart in all directions."""
    tx = beside(np.repeat(APERTURE[::8], 8, axis=0), 0.3, 0.1, -0.2)
    grid = patch(1.3, 42)
    return thesis_lines(grid, tx, APERTURE), grid


def moving():
    """Receivers that move forwards, sideways and up, at up to 10 m/s."""
    velocity = np.random.default_rng(2).uniform(-5.5, 5.5, APERTURE.shape)
    grid = patch(1.3, 42)
    return thesis_lines(grid, APERTURE, beside(APERTURE, 0.05, 0, 0.02), velocity=velocity), grid


def height_map():
    rng = np.random.default_rng(3)
    grid = patch(1.3, 42, z=-9.0).with_height(rng.normal(0, 0.2, (33, 40)))
    return thesis_lines(grid, APERTURE), grid


def moving_over_height_map():
    grid = patch(1.3, 42, z=-9.0).with_height(np.linspace(-1, 1, 33 * 40).reshape(33, 40) ** 3)
    return thesis_lines(
        grid, APERTURE, beside(APERTURE, 0.1, 0, 0), velocity=[[8.0, -3, 1]] * 640
    ), grid


def oriented():
    """A steep plane whose rows and columns are not perpendicular."""
    grid = Grid.oriented([1, 41, -5], [0.001, 0.004, 0.003], [0.004, 0.0025, -0.001], (33, 40))
    return thesis_lines(grid, APERTURE), grid


def points():
    """Points anywhere in a volume, and one of them many times."""
    rng = np.random.default_rng(4)
    scattered = rng.uniform([-3, 38, -12], [3, 46, -2], (400, 3))
    grid = Grid.points(np.concatenate([scattered, scattered[:1].repeat(50, axis=0)]))
    return thesis_lines(grid, APERTURE), grid


def own_starts():
    grid = patch(2.2, 41)
    track = APERTURE + np.random.default_rng(6).normal(0, 0.1, APERTURE.shape)
    return thesis_lines(grid, track, own_start=True), grid


def off_centre():
    """A one-sided band: analytic lines whose energy lies between 0.05 and 0.85 cycles."""
    grid = patch(1.3, 42)
    return thesis_lines(grid, APERTURE, centre=0.45), grid


def with_carrier():
    """Lines that still carry their carrier: 30 kHz, sampled at 100 kHz."""
    grid = patch(1.3, 42, pitch=0.01)
    band = {"occupied": 0.3, "centre": 0.3}
    return lines_over(grid, APERTURE[::8], carrier_hz=0.0, step_m=0.0075, **band), grid


ORDINARY = (
    thesis,
    bistatic,
    moving,
    height_map,
    moving_over_height_map,
    oriented,
    points,
    own_starts,
    off_centre,
    with_carrier,
)


@cache
def made(case):
    """The lines and the grid of a case, made once."""
    return case()


@cache
def pixels_of(case, count=200):
    """Pixels of a case chosen at random, flat, and where they lie."""
    grid = made(case)[1]
    chosen = np.random.default_rng(0).permutation(grid.size)[:count]
    return chosen, grid.positions_m().reshape(-1, 3)[chosen]


@cache
def ideal_of(case):
    """What those pixels should be."""
    return ideal(made(case)[0], pixels_of(case)[1])


@cache
def interpolated_of(case, taps, upsampling):
    """What those pixels should be with a given interpolator."""
    preparation = prepare(*made(case), taps=taps, upsampling=upsampling)
    return same_interpolator(preparation, pixels_of(case)[1])


def rounding_error_db(case, device, *, taps=6, upsampling=3.0):
    """Error of those pixels against the same interpolator in float64."""
    image = execute(prepare(*made(case), device=device, taps=taps, upsampling=upsampling))
    pixels = image.pixels.ravel()[pixels_of(case)[0]]
    return relative_error_db(pixels, interpolated_of(case, taps, upsampling))


def true_error_db(case, image):
    """Error of those pixels against the ideal sum."""
    return relative_error_db(image.pixels.ravel()[pixels_of(case)[0]], ideal_of(case))


def flat(occupied, centre=0.0):
    """Spectrum of a flat band of a given width, cycles per sample."""
    frequency = (np.arange(200) + 0.5) / 400
    power = (frequency < occupied / 2).astype(float)
    return Spectrum(centre, frequency, power / power.sum())


def burst(index, centre):
    """A Gaussian burst of 8 samples about sample 60, its energy about a frequency."""
    return np.exp(-(((index - 60) / 8) ** 2) + 2j * np.pi * centre * (index - 60))


def track_lines(tx, rx=None, velocity=None):
    """Lines of one sample from antennas [channels, 3], of which only the geometry matters."""
    rx = tx if rx is None else rx
    return RangeLines(np.ones((len(tx), 1), complex), 1.0, 1.0, tx, rx, 1e5, 1500.0, velocity)


def lattice(seabed):
    """Points of a seabed's lattice on its surface, [rows, columns, 3]."""
    rows, columns = seabed.heights_m.shape
    x, y = np.meshgrid(np.linspace(*seabed.x_m, columns), np.linspace(*seabed.y_m, rows))
    return np.stack([x, y, seabed.heights_m], axis=-1)


def bright_where_coverage_ends(x_m, *, seabed=0):
    """Echoes of points about x_m and of a seabed; beyond 3 m only the track's end sees them."""
    random = np.random.default_rng(7)
    track, cycles_per_m, step_m = along_x(300, 0.02), 2 * 30e3 / 1500, 0.06
    near = random.uniform([x_m - 0.3, 8.3, 0], [x_m + 0.3, 10.7, 0], (40, 3))
    anywhere = random.uniform([-6, 8, 0], [6, 11, 0], (seabed, 3))
    amplitude = random.normal(size=(40 + seabed, 2)) @ [1, 1j]
    amplitude[40:] *= 0.1
    points_m = np.concatenate([near, anywhere])
    range_m = np.linalg.norm(points_m - track[:, None], axis=2)
    amplitude = amplitude * np.exp(-2j * np.pi * (cycles_per_m * range_m % 1))
    at_m = 4.0 + step_m * np.arange(200)
    away = (at_m[:, None, None] - range_m) * 10
    samples = np.einsum("rcp,cp->cr", np.sinc(away) * np.exp(-(away**2) / 128), amplitude)
    grid = Grid.plane((-6, 6, 640), (8, 11, 160))
    return RangeLines(samples, 4.0, step_m, track, track, 30e3, 1500.0), grid
