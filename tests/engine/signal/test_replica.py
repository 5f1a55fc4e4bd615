import numpy as np
import pytest

import clsas
from clsas.engine.signal.replica import Replica

PULSE = clsas.Pulse(100e3, 20e3, 2e-3)
RATE = 160e3


def measured(distort=None):
    """A pulse sampled as a tank measures it, band-limited, with a distortion over frequency."""
    length = 1024
    frequency = np.fft.fftfreq(length, 1 / RATE)
    spectrum = PULSE.spectrum(frequency) * (np.abs(frequency) < 40e3)
    delay_s = 1e-3  # before the pulse begins, so that its band-limited edges are there
    spectrum = spectrum * np.exp(-2j * np.pi * frequency * delay_s)
    if distort is not None:
        spectrum = spectrum * distort(frequency)
    return np.fft.ifft(spectrum) * RATE


def echoes_of(samples, delay_s=0.02, amplitude=0.7 - 0.2j, rate=80e3):
    """An echo of a replica that is sampled at a lower rate, in one line."""
    replica = Replica(samples, RATE)
    length = 4096
    frequency = np.fft.fftfreq(length, 1 / rate)
    spectrum = replica.spectrum(frequency) * np.exp(-2j * np.pi * frequency * delay_s)
    line = amplitude * np.fft.ifft(spectrum) * rate * np.exp(-2j * np.pi * 100e3 * delay_s)
    return clsas.Echoes(line[None], 0.0, rate, 100e3, [0, 0, 0], [0, 0, 0], 1500.0, pulse=PULSE)


def test_the_spectrum_is_the_sum_over_the_samples():
    samples = np.random.default_rng(0).normal(size=(2, 77)).T @ [1, 1j]
    frequency = np.array([-8e4, -123.4, 0.0, 5e3, 79e3])
    time = np.arange(77) / RATE
    expected = np.exp(-2j * np.pi * np.outer(frequency, time)) @ samples / RATE
    np.testing.assert_allclose(Replica(samples, RATE).spectrum(frequency), expected, rtol=1e-9)


def distortion(frequency):
    """A transducer: two resonances' slope in amplitude, and phase of the third order."""
    u = frequency / 10e3
    return (1 + 0.5 * u) * np.exp(1j * (4 * u**2 + 3 * u**3))


def test_a_measured_replica_compresses_what_the_nominal_pulse_does_not():
    replica = Replica(measured(distortion), RATE)
    echoes = echoes_of(replica.samples)
    matched = clsas.compress(echoes, replica=replica, oversampling=8.0)
    peak = np.abs(matched.samples[0]).argmax()
    # The echo of A at the delay tau is A at c tau/2 with the phase of the carrier.
    range_m = matched.first_range_m[0] + peak * matched.range_step_m
    assert range_m == pytest.approx(750 * 0.02, abs=matched.range_step_m)
    phase = np.exp(-2j * matched.wavenumber_rad_m * 750 * 0.02)
    assert matched.samples[0, peak] == pytest.approx((0.7 - 0.2j) * phase, rel=0.01)
    nominal = clsas.compress(echoes, oversampling=8.0)

    def sharpness(lines):
        power = np.abs(lines.samples[0]) ** 2
        return power.max() / power.sum()

    assert sharpness(matched) > 1.2 * sharpness(nominal)


def test_a_replica_of_the_nominal_pulse_gives_the_lines_of_the_pulse():
    sonar = clsas.Sonar(PULSE, [[0.1, 0, 0]])
    track = clsas.Track([[0, 0, 0]], [0.0])
    echoes = clsas.simulate(sonar, track, clsas.PointTargets([[0, 15, 0]]))
    fine = 4e6
    samples = PULSE.envelope(np.arange(int(PULSE.duration_s * fine) + 1) / fine)
    samples[[0, -1]] /= 2  # the trapezoidal rule
    ours, theirs = (clsas.compress(echoes, replica=r) for r in (None, Replica(samples, fine)))
    assert np.abs(ours.samples - theirs.samples).max() < 1e-4
    assert ours.first_range_m == theirs.first_range_m


@pytest.mark.parametrize(
    ("samples", "rate", "said"),
    [
        ([1.0, 2.0], 1e3, "samples must be complex.*got real ones: form the analytic signal"),
        (np.arange(3), 1e3, "multiply it by exp"),
        ([1j], 1e3, "samples must be at least 2"),
        ([0j, 0j], 1e3, "not all zero"),
        ([1j, np.nan], 1e3, "samples must be finite"),
        ([1j, 1], 0, "sample_rate_hz must be"),
    ],
)
def test_replicas_are_checked(samples, rate, said):
    with pytest.raises((TypeError, ValueError), match=said):
        Replica(samples, rate)


def test_a_band_beyond_that_of_the_replica_is_refused():
    echoes = echoes_of(measured())
    with pytest.raises(ValueError, match="bandwidth_hz must be finite and > 0 and <= 10000 Hz"):
        clsas.compress(echoes, replica=Replica([1j, 1], 10e3))
    with pytest.raises(TypeError, match="replica must be of type Replica, got ndarray"):
        clsas.compress(echoes, replica=measured())
