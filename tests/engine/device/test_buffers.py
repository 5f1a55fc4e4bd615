import dataclasses

import numpy as np
import pyopencl as cl
import pytest
from cases import burst, flat

from clsas.engine.data.image_error import relative_error_db
from clsas.engine.device import buffers as module
from clsas.engine.device.buffers import MARGIN, padded_length, upsample
from clsas.engine.device.device import open_device
from clsas.engine.signal.interpolation import PHASES, UPSAMPLING_TAPS, upsampler


def noise(channels, length):
    rng = np.random.default_rng(3)
    return rng.standard_normal((channels, length)) + 1j * rng.standard_normal((channels, length))


def even(frequency):
    return np.ones_like(frequency)


def upsampled(samples, spectrum, step, device, gain=even, most_db=-60):
    """Return complex lines from a device with their zeros, the resampling and the filters."""
    found = upsampler(spectrum, step, gain, most_db)
    resampling = found.resampling(samples.shape[1], 3, spectrum)
    device = open_device(device)
    pitch = padded_length(resampling)
    given = samples.astype(np.complex64)
    buffer = upsample(given, resampling, found, pitch, device)
    width = device.info.width
    lines = np.empty((len(samples), pitch, 2) if width == 1 else (len(samples), 2, pitch), "f4")
    cl.enqueue_copy(device.queue, lines, buffer)
    parts = np.moveaxis(lines, -1 if width == 1 else 1, 0)
    return parts[0] + 1j * parts[1], resampling, found


@pytest.mark.parametrize("centre", [0.0, 0.31, -0.48])
@pytest.mark.parametrize("step", [32, 27, 20, 5])
def test_upsampling_gives_the_closed_form(platform, centre, step):
    spectrum = dataclasses.replace(flat(0.8), centre=centre)
    samples = burst(np.arange(131), centre)[None]
    got, resampling, _ = upsampled(samples, spectrum, step, platform)
    assert resampling.ratio == PHASES / step
    assert resampling.centre_cycles_per_sample == pytest.approx(centre, abs=0.5 / resampling.period)
    inside = slice(MARGIN, MARGIN + resampling.length)
    index = (np.arange(resampling.length) + resampling.first) / resampling.ratio
    turn = np.exp(-2j * np.pi * resampling.centre_cycles_per_sample * index)
    assert relative_error_db(got[:, inside], (burst(index, centre) * turn)[None]) <= -60
    assert index[0] < 0
    assert index[-1] > 130
    outside = np.delete(got, np.arange(got.shape[1])[inside], axis=1)
    assert not outside.any()


@pytest.mark.slow
@pytest.mark.parametrize("most_db", [-40, -60, -80])
def test_the_error_is_as_predicted(device, most_db):
    """Against the sum of band-limited noise at exact places, away from the lines' ends."""
    rng, length = np.random.default_rng(0), 400
    frequency = rng.uniform(-0.4, 0.4, 1000)
    amplitude = noise(20, 1000)
    samples = amplitude @ np.exp(2j * np.pi * frequency[:, None] * np.arange(length))
    got, resampling, found = upsampled(samples, flat(0.8), 20, device, most_db=most_db)
    middle = np.arange(100, resampling.length - 100)
    index = (middle + resampling.first) / resampling.ratio
    wanted = amplitude @ np.exp(2j * np.pi * frequency[:, None] * index)
    error_db = relative_error_db(got[:, MARGIN + middle], wanted)
    assert found.error_db <= most_db
    assert abs(error_db - found.error_db) <= 1


def test_a_gain_shapes_the_spectrum(platform):
    def falling(frequency):
        return 1 / (1 + 4 * frequency**2)

    time = np.arange(300)
    for frequency in (0.0, 0.2, -0.37):
        wave = np.exp(2j * np.pi * frequency * time)[None]
        got, resampling, _ = upsampled(wave, flat(0.8), 24, platform, falling)
        middle = got[0, MARGIN + 150 : MARGIN + resampling.length - 150]
        np.testing.assert_allclose(np.abs(middle), falling(abs(frequency)), rtol=2e-3)


@pytest.mark.parametrize("length", [1, 2, 17, 1021])
def test_lines_of_any_length(platform, length):
    """The result is the same as within longer lines padded with zeros."""
    samples = noise(3, length)
    got, resampling, _ = upsampled(samples, flat(0.8), 21, platform)
    longer, _, _ = upsampled(np.pad(samples, ((0, 0), (0, 64))), flat(0.8), 21, platform)
    inside = slice(MARGIN, MARGIN + resampling.length)
    np.testing.assert_allclose(got[:, inside], longer[:, inside], atol=1e-5)


def test_lines_that_come_in_parts(platform, monkeypatch):
    samples = noise(23, 100)
    whole, _, _ = upsampled(samples, flat(0.8), 20, platform)
    monkeypatch.setattr(module, "GIVEN_BYTES", 4 * 100 * 8)
    parts, _, _ = upsampled(samples, flat(0.8), 20, platform)
    np.testing.assert_array_equal(whole, parts)


@pytest.mark.slow
def test_no_short_filter_upsamples_a_full_band():
    assert upsampler(flat(1.0), 20, even, -50) is None
    assert upsampler(flat(0.8), 20, even, -50).taps < upsampler(flat(0.9), 20, even, -50).taps


def test_the_longest_filter_serves_where_it_nearly_suffices():
    found = upsampler(flat(0.92), 20, even, -60, -50)
    assert found.taps == max(UPSAMPLING_TAPS)
    assert -60 < found.error_db <= -50
    assert upsampler(flat(0.92), 20, even, -60) is None
    assert upsampler(flat(0.92), 20, even, -60, found.error_db - 0.1) is None
    short = upsampler(flat(0.8), 20, even, -50, -20)
    assert short.taps == upsampler(flat(0.8), 20, even, -50).taps


def test_turning_is_exact_far_along_a_line(platform):
    """Whole cycles are removed before the phase is rounded to float32."""
    centre, length = 0.3141592, 40000
    spectrum = dataclasses.replace(flat(0.8), centre=centre)
    wave = np.exp(2j * np.pi * centre * np.arange(length))[None]
    got, resampling, _ = upsampled(wave, spectrum, 32, platform)
    middle = got[0, MARGIN + 100 : MARGIN + resampling.length - 100]
    slow = np.exp(
        2j * np.pi * (centre - resampling.centre_cycles_per_sample) * np.arange(len(middle))
    )
    turned = middle / slow
    assert np.abs(turned - turned.mean()).max() <= 1e-3
