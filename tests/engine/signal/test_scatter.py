"""The number of independent pixels of noise images, and the scatter of their power."""

import dataclasses

import numpy as np
import pytest

from clsas.engine.data.beam import BeamWindow, normalising
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.visibility import sines
from clsas.engine.signal.ambiguity import independent_pixels, scatter
from clsas.engine.signal.spectrum import Spectrum

STEP_M, WAVELENGTH_M, SPEED_M_S = 0.1, 0.15, 1500.0
CARRIER_HZ = SPEED_M_S / WAVELENGTH_M
FIRST_M, LENGTH = 20.0, 200
BAND = 0.6  # cycles per sample


def flat():
    """The spectrum of lines whose power is even over a band."""
    frequency = (np.arange(128) + 0.5) / 256
    power = np.where(frequency < BAND / 2, 1.0, 0.0)
    return Spectrum(0.0, frequency, power / power.sum(), 1 / BAND)


def lines_at(position_m):
    samples = np.ones((len(position_m), LENGTH), np.complex64)
    return RangeLines(samples, FIRST_M, STEP_M, position_m, position_m, CARRIER_HZ, SPEED_M_S)


def straight(channels, length_m):
    position_m = np.zeros((channels, 3))
    position_m[:, 0] = np.linspace(-length_m / 2, length_m / 2, channels)
    return lines_at(position_m)


def grid(width_m, depth_m, *, count=48):
    x = (-width_m / 2, width_m / 2, count)
    return Grid.plane(x, (30 - depth_m / 2, 30 + depth_m / 2, count))


def relative_variance(lines, grid, amplitude, rng, *, draws=600):
    """Return the variance over the squared mean of the mean power of noise images."""
    frequency = np.linspace(-BAND / 2, BAND / 2, 24)
    points_m = grid.spread(40)
    range_m = np.linalg.norm(points_m[:, None] - lines.tx_m, axis=-1)
    turns = range_m[..., None] * (2 / WAVELENGTH_M + frequency / STEP_M)
    steering = (amplitude[..., None] * np.exp(2j * np.pi * turns)).reshape(len(points_m), -1)
    noise = rng.normal(size=(2, steering.shape[1], draws))
    power = np.mean(np.abs(steering @ (noise[0] + 1j * noise[1])) ** 2, axis=0)
    return power.var() / power.mean() ** 2


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("channels", "length_m", "size_m"),
    [(1, 0.0, (1.0, 0.6)), (60, 4.0, (0.5, 0.2)), (60, 4.0, (2.0, 0.4)), (200, 6.0, (3.0, 0.8))],
)
def test_the_power_of_images_of_noise_varies_by_the_independent_pixels(channels, length_m, size_m):
    lines, image = straight(channels, length_m), grid(*size_m)
    even = np.ones(channels)
    found = independent_pixels(lines, image, flat(), even, None, None)
    measured = relative_variance(lines, image, even, np.random.default_rng(3))
    assert found == pytest.approx(1 / measured, rel=0.35)


def test_a_loud_channel_leaves_only_its_own_cells_in_range():
    lines, image = straight(60, 4.0), grid(2.0, 0.4)
    energy = np.ones(60)
    energy[17] = 1e6
    alone = independent_pixels(lines.select([17]), image, flat(), energy[[17]], None, None)
    found = independent_pixels(lines, image, flat(), energy, None, None)
    assert found == pytest.approx(alone, rel=0.05)
    even = independent_pixels(lines, image, flat(), np.ones(60), None, None)
    assert found < 0.3 * even


@pytest.mark.slow
@pytest.mark.parametrize("width_deg", [0.4, 1.5, 4.0, 60.0])
def test_beams_change_which_pixels_are_independent(width_deg):
    lines, image, beam = straight(60, 4.0), grid(1.0, 0.4), BeamWindow(width_deg, "hann")
    along = np.tile([1.0, 0.0, 0.0], (60, 1))
    found = independent_pixels(lines, image, flat(), np.ones(60), beam, along)
    sine = sines(image.spread(40), lines.phase_centres_m, along).T
    weights = beam.weights(sine, WAVELENGTH_M)
    measured = relative_variance(lines, image, weights, np.random.default_rng(5))
    assert found == pytest.approx(1 / measured, rel=0.35)


@pytest.mark.slow
def test_beams_that_normalise_change_which_pixels_count():
    lines, image = straight(60, 4.0), grid(6.0, 0.4)
    beam = BeamWindow(6.0, "hann", normalise=True)
    along = np.tile([1.0, 0.0, 0.0], (60, 1))
    found = independent_pixels(lines, image, flat(), np.ones(60), beam, along)
    weights = beam.weights(sines(image.spread(40), lines.phase_centres_m, along).T, WAVELENGTH_M)
    weights *= normalising(weights.sum(axis=1, keepdims=True), lines.channels)
    measured = relative_variance(lines, image, weights, np.random.default_rng(7))
    assert found == pytest.approx(1 / measured, rel=0.35)


def test_pixels_that_no_line_reaches_do_not_count():
    image = grid(0.5, 8.0)
    whole, short = straight(60, 4.0), straight(60, 4.0)
    short = dataclasses.replace(short, samples=short.samples[:, :82])  # the near quarter
    near = Grid.plane((-0.25, 0.25, 48), (26.0, 28.2, 48))
    even = np.ones(60)
    found = independent_pixels(short, image, flat(), even, None, None)
    alone = independent_pixels(whole, near, flat(), even, None, None)
    assert found == pytest.approx(alone, rel=0.35)


@pytest.mark.parametrize("loud", [1.0, 1e3, 1e8])
def test_a_loud_channel_that_the_beam_does_not_pass_does_not_count(loud):
    lines, image = straight(600, 30.0), grid(0.3, 0.1, count=8)
    along = np.tile([1.0, 0.0, 0.0], (600, 1))
    energy = np.ones(600)
    energy[0] = loud
    found = independent_pixels(lines, image, flat(), energy, BeamWindow(10.0, "hann"), along)
    even = independent_pixels(lines, image, flat(), np.ones(600), BeamWindow(10.0, "hann"), along)
    assert found == pytest.approx(even, rel=0.2)


def test_the_shape_of_a_grid_plays_no_part():
    lines = straight(60, 4.0)
    random = np.random.default_rng(11)
    points_m = random.uniform([-1, 29.8, 0], [1, 30.2, 0], (2000, 3))
    found = [
        independent_pixels(
            lines, Grid.points(points_m.reshape(*shape, 3)), flat(), np.ones(60), None, None
        )
        for shape in [(2000,), (2000, 1), (20, 10, 10), (1, 1, 1, 2000)]
    ]
    assert found == pytest.approx([found[0]] * 4, rel=0.01)
    row = Grid.plane((-40.0, 40.0, 4096), (30.0, 30.0, 1))
    assert scatter(independent_pixels(lines, row, flat(), np.ones(60), None, None)) < 1.2


def test_one_pixel_scatters_most_and_large_images_do_not():
    lines = straight(300, 30.0)
    one = Grid.points([[0.0, 30.0, 0.0]])
    arguments = flat(), np.ones(300), None, None
    assert independent_pixels(lines, one, *arguments) == 1
    assert scatter(independent_pixels(lines, one, *arguments)) > 10
    large = grid(20.0, 20.0, count=400)
    assert scatter(independent_pixels(lines, large, *arguments)) == 1


def test_silent_lines_and_beams_that_see_nothing_do_not_scatter():
    lines, image = straight(60, 4.0), grid(1.0, 0.4)
    assert scatter(independent_pixels(lines, image, flat(), np.zeros(60), None, None)) == 1
    along = np.tile([1.0, 0.0, 0.0], (60, 1))
    away = BeamWindow(10.0, "hann", 70.0)
    assert scatter(independent_pixels(lines, image, flat(), np.ones(60), away, along)) == 1
