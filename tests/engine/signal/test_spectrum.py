import warnings

import numpy as np
import pytest
from cases import noise

from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, band_wavelength_m
from clsas.engine.signal.spectrum import measure_spectrum
from clsas.selftest.reference import ideal

GRID = Grid.plane((-0.1, 0.1, 3), (15, 15.2, 3))


def lines_of(samples):
    return RangeLines(samples, 10.0, 0.01, [0, 0, 0], [0, 0, 0], 1e5, 1500.0)


@pytest.mark.parametrize("centre", [-0.45, -0.2, 0.0, 0.3, 0.49])
@pytest.mark.parametrize("occupied", [0.1, 0.6])
def test_the_spectrum_is_measured_about_its_centre(centre, occupied):
    lines = lines_of(noise(40, 500, occupied=occupied, centre=centre))
    spectrum = measure_spectrum(lines)
    assert spectrum.centre == pytest.approx(centre, abs=0.01)
    assert spectrum.power.sum() == pytest.approx(1, abs=1e-12)
    inside = spectrum.frequency < occupied / 2
    level = spectrum.power[inside]
    assert level.sum() > 0.97
    assert level[1:-2].std() < 0.2 * level.mean()


@pytest.mark.parametrize("mixed_hz", [0.0, 1.0, 20e3, 30e3])
def test_the_wavelength_is_that_of_the_band_whatever_was_mixed_out(mixed_hz):
    """The band lies at 30 kHz and is sampled at 75 kHz."""
    range_m = 10.0 + 0.01 * np.arange(500)
    turns = np.exp(-4j * np.pi * mixed_hz / 1500.0 * range_m)
    samples = noise(20, 500, occupied=0.2, centre=0.4) * turns
    lines = RangeLines(samples, 10.0, 0.01, [0, 0, 0], [0, 0, 0], mixed_hz, 1500.0)
    found_m = band_wavelength_m(lines, measure_spectrum(lines).centre)
    assert found_m == pytest.approx(1500 / 30e3, rel=0.02)


def test_lines_about_0_hz_have_the_wavelength_of_the_highest_frequency_sampled():
    lines = RangeLines(np.ones((1, 50), complex), 10.0, 0.01, [0, 0, 0], [0, 0, 0], 0.0, 1500.0)
    assert band_wavelength_m(lines, 1e-4) == pytest.approx(0.04)


def test_lines_of_zeros_have_a_spectrum():
    spectrum = measure_spectrum(lines_of(np.zeros((2, 50), complex)))
    assert -0.5 <= spectrum.centre <= 0.5
    np.testing.assert_allclose(spectrum.power.reshape(8, -1).sum(axis=1), 1 / 8, rtol=0.3)


@pytest.mark.parametrize("scale", [1e-35, 1e-20, 1e18, 1e30])
def test_the_spectrum_does_not_depend_on_the_unit(scale):
    samples = noise(3, 300, centre=0.2)
    spectrum, scaled = (measure_spectrum(lines_of(a * samples)) for a in (1.0, scale))
    assert scaled.centre == pytest.approx(spectrum.centre, abs=1e-4)
    np.testing.assert_allclose(scaled.power, spectrum.power, atol=1e-5)


@pytest.mark.parametrize(
    "filled", [slice(None, 500, 10), slice(1, None, 4), slice(3, None, 8), slice(777, 778)]
)
def test_the_spectrum_is_that_of_the_channels_which_hold_anything(filled):
    """Dead elements of an array may lie in regular steps."""
    samples = np.zeros((1000, 100), complex)
    samples[filled] = noise(len(samples[filled]), 200, occupied=0.4, centre=0.25)[:, 50:150]
    assert measure_spectrum(lines_of(samples)).centre == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize("occupied", [0.5, 0.9])
@pytest.mark.parametrize("tilt_db", [0, 20, -20])
@pytest.mark.parametrize("noise_db", [-200, -30])
def test_the_centre_is_the_middle_of_the_occupied_band(occupied, tilt_db, noise_db):
    """Tilt and noise do not matter, so that the guard band is equally wide on both sides."""
    rng = np.random.default_rng(3)
    frequency = np.fft.fftfreq(2000)
    gain = 10 ** (tilt_db / 20 * frequency / occupied) * (np.abs(frequency) < occupied / 2)
    samples = np.fft.ifft(gain * (rng.normal(size=(20, 2000, 2)) @ [1, 1j]))
    level = 10 ** (noise_db / 20) * np.sqrt(np.mean(np.abs(samples) ** 2) / 2)
    samples += level * (rng.normal(size=(20, 2000, 2)) @ [1, 1j])
    spectrum = measure_spectrum(lines_of(samples * np.exp(2j * np.pi * 0.3 * np.arange(2000))))
    assert spectrum.centre == pytest.approx(0.3, abs=0.01)
    assert spectrum.oversampling == pytest.approx(1 / occupied, rel=0.03)


def bands(*parts, channels=40, seed=3):
    """Noise in bands, each given by its centre, its width and the channels that have it."""
    rng = np.random.default_rng(seed)
    frequency = np.fft.fftfreq(2000)
    samples = np.zeros((channels, 2000), complex)
    for centre, width, some in parts:
        inside = np.abs((frequency - centre + 0.5) % 1 - 0.5) < width / 2
        noise = rng.normal(size=(channels, 2000, 2)) @ [1, 1j]
        samples[some] += np.fft.ifft(inside * noise)[some]
    return lines_of(samples)


ALL = slice(None)


@pytest.mark.parametrize(
    ("parts", "centre", "width"),
    [
        ([(-0.32, 0.12, ALL), (0.32, 0.12, ALL)], 0.0, 0.76),
        ([(-0.3, 0.1, ALL), (0.42, 0.1, ALL)], 0.06, 0.82),
        ([(-0.4, 0.05, ALL), (0.0, 0.05, ALL), (0.4, 0.05, ALL)], 0.0, 0.85),
        ([(-0.32, 0.12, ALL), (0.32, 0.12, [7])], 0.0, 0.76),
        ([(0.1, 0.1, ALL), (0.4, 0.1, ALL)], 0.25, 0.4),
    ],
    ids=["two bands", "uneven", "three", "one channel in another", "on one side"],
)
def test_gaps_belong_to_the_band_where_half_the_sample_rate_is_quiet(parts, centre, width):
    lines = bands(*parts)
    spectrum = measure_spectrum(lines, GRID)
    assert spectrum.centre == pytest.approx(centre, abs=0.01)
    assert 1 / spectrum.oversampling == pytest.approx(width, abs=0.01)


@pytest.mark.parametrize(
    ("parts", "centre", "says"),
    [
        ([(0.5, 0.3, ALL)], -0.5, False),
        ([(0.4, 0.16, ALL), (-0.41, 0.16, ALL)], 0.495, False),
        ([(0.4, 0.24, ALL), (-0.2, 0.1, ALL)], -0.435, True),
        ([(0.5, 0.1, ALL), (0.0, 0.1, ALL)], None, True),
    ],
    ids=["no gap", "a narrow gap", "a gap half as wide", "two gaps alike"],
)
def test_a_band_that_wraps_is_unwrapped_unless_two_gaps_compete(parts, centre, says):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        spectrum = measure_spectrum(bands(*parts), GRID)
    assert bool(caught) == says
    assert all(
        "the band of the lines wraps around half the sample rate" in str(c.message) for c in caught
    )
    if centre is not None:
        assert abs((spectrum.centre - centre + 0.5) % 1 - 0.5) < 0.015


@pytest.mark.slow
def test_a_common_offset_weighs_as_in_the_image():
    """The offset adds up in phase over the image, while echoes from everywhere do not."""
    x_m = 0.02 * np.arange(200)
    track = np.column_stack([x_m, 0 * x_m, 0 * x_m])
    band = noise(200, 1000, occupied=0.1, centre=0.35)
    band /= np.sqrt(np.mean(np.abs(band) ** 2))
    # A little below 0 Hz too, so that nothing else lies as far from the centre as 0 Hz.
    band += 0.1 * noise(200, 1000, occupied=0.02, centre=-0.2, seed=1)
    offset = np.full(band.shape, np.sqrt(1e-3), complex)
    grid = Grid.plane((1.5, 2.5, 20), (12.0, 13.0, 20))

    def share_at_zero(samples, *grids):
        lines = RangeLines(samples, 10.0, 0.005, track, track, 0.0, 1500.0)
        spectrum = measure_spectrum(lines, *grids)
        assert 1 - 1e-9 <= spectrum.power.sum() <= 2
        near = np.abs(spectrum.frequency - abs(spectrum.centre)) < 0.02
        return spectrum.power[near].sum(), ideal(lines, grid.positions_m())

    alone, _ = share_at_zero(band + offset)
    weighed, image = share_at_zero(band + offset, grid)
    _, of_offset = share_at_zero(offset, grid)
    in_image = np.linalg.norm(of_offset) ** 2 / np.linalg.norm(image) ** 2
    assert alone == pytest.approx(1e-3, rel=0.2)
    assert in_image > 50 * alone
    assert weighed == pytest.approx(in_image, rel=0.3)
    # Offsets that differ from channel to channel do not add up.
    turns = np.exp(2j * np.pi * np.random.default_rng(0).uniform(size=(200, 1)))
    scattered, _ = share_at_zero(band + offset * turns, grid)
    assert scattered < 3e-3
