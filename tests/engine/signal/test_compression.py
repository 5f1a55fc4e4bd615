import importlib
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal
from scipy.optimize import minimize_scalar
from tiers import thinned

from clsas.engine.data.geometry import bistatic_range_m
from clsas.engine.data.system import Pulse, Sonar
from clsas.engine.data.track import Track
from clsas.engine.signal.compression import compress
from clsas.engine.signal.echoes import Echoes
from clsas.simulation.scenes import PointTargets
from clsas.simulation.simulator import simulate

compression = importlib.import_module("clsas.engine.signal.compression")
C = 1500.0
CARRIER = 1e6
BAND = 100e3
ONE_PING = Track([[0, 0, 0]], [0.0])
PULSES = {
    "up": Pulse(CARRIER, BAND, 1e-3),
    "down": Pulse(CARRIER, BAND, 1e-3, "down"),
    "tapered": Pulse(CARRIER, BAND, 2e-3, taper=0.3),
    "barker": Pulse.phase_code(CARRIER, 13 / BAND),
}


def db(value, reference=1.0):
    return 20 * np.log10(np.max(np.abs(value)) / np.max(np.abs(reference)))


def echoes_of(pulse, positions, amplitudes=1.0, **options):
    sonar = Sonar(pulse, [[0.3, 0, 0]])
    return simulate(sonar, ONE_PING, PointTargets(positions, amplitudes), **options)


def ranges(lines):
    return lines.first_range_m[:, None] + lines.range_step_m * np.arange(lines.length)


def response(pulse, window, delay):
    """Return the compressed point response, integral W |P|^2, by a fine sum and no FFT."""
    f = (np.arange(20000) + 0.5) / 20000 * BAND - BAND / 2
    power = np.abs(pulse.spectrum(f)) ** 2
    if window == "hamming":
        power *= 0.54 + 0.46 * np.cos(2 * np.pi * f / BAND)
    return np.exp(2j * np.pi * np.multiply.outer(delay, f)) @ power / power.sum()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "oversampling", "window"), thinned(PULSES, [1.0, 1.3, 3.0], ["none", "hamming"])
)
def test_compressed_line_is_the_closed_form(name, oversampling, window):
    pulse = PULSES[name]
    amplitude = 0.7 - 0.4j
    echoes = echoes_of(pulse, [[0.1, 40.0, 0]], amplitude, range_m=(38, 43))
    lines = compress(echoes, window=window, oversampling=oversampling)
    rho = bistatic_range_m([0.1, 40.0, 0], echoes.tx_m, echoes.rx_m)[0]
    delay = 2 / C * (ranges(lines)[0] - rho)
    expected = amplitude * response(pulse, window, delay)
    expected *= np.exp(-2j * lines.wavenumber_rad_m * rho)
    assert db(lines.samples[0] - expected) < -100
    assert lines.first_range_m[0] == pytest.approx(38.0, abs=1e-12)
    assert lines.last_range_m[0] == pytest.approx(43.0, abs=C / 2 / echoes.sample_rate_hz)
    assert lines.range_step_m == pytest.approx(C / (2 * oversampling * BAND), rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "window"), thinned(PULSES, ["hamming", "none"]))
def test_equalized_line_is_the_closed_form(name, window):
    """The band is that of the window, up to what keeps noise low where the pulse is weak."""
    pulse, delay = PULSES[name], np.arange(-40, 40) / (2 * BAND)
    echoes = echoes_of(pulse, [[0.1, 40.0, 0]], 0.7 - 0.4j, range_m=(38, 43))
    lines = compress(echoes, window=window, oversampling=2.0, equalize=True)
    rho = bistatic_range_m([0.1, 40.0, 0], echoes.tx_m, echoes.rx_m)[0]
    delay = 2 / C * (ranges(lines)[0] - rho)
    f = (np.arange(8000) + 0.5) / 8000 * BAND - BAND / 2
    power = np.abs(pulse.spectrum(f)) ** 2
    shape = power / (power + 0.01 * power.mean())
    if window == "hamming":
        shape *= 0.54 + 0.46 * np.cos(2 * np.pi * f / BAND)
    expected = np.exp(2j * np.pi * np.multiply.outer(delay, f)) @ shape / shape.sum()
    expected = (0.7 - 0.4j) * expected * np.exp(-2j * lines.wavenumber_rad_m * rho)
    assert db(lines.samples[0] - expected) < -90


@pytest.mark.parametrize("name", ["up", "down"])
def test_equalized_chirps_have_no_distant_side_lobes(name):
    """Ripples of the spectrum make paired echoes, up to half a pulse away from bright ones."""
    pulse = PULSES[name]
    echoes = echoes_of(pulse, [[0.1, 40.0, 0]], range_m=(38, 43))
    lobes_db = []
    for equalize in (False, True):
        lines = compress(echoes, window="hamming", equalize=equalize)
        distance_m = np.abs(ranges(lines)[0] - 40.0)
        # Half a pulse is 0.375 m here.
        some = (distance_m > 0.15) & (distance_m < 0.45)
        lobes_db.append(db(lines.samples[0][some]))
    assert lobes_db[0] > -45
    assert lobes_db[1] < lobes_db[0] - 6


def test_a_flat_band_is_not_equalized():
    echoes = echoes_of(PULSES["up"], [[0.1, 40.0, 0]], range_m=(38, 43))
    echoes = replace(echoes, pulse=None)
    flat, same = (compress(echoes, bandwidth_hz=BAND, equalize=each) for each in (False, True))
    np.testing.assert_array_equal(flat.samples, same.samples)
    with pytest.raises(TypeError, match="equalize"):
        compress(echoes, bandwidth_hz=BAND, equalize="yes")


@pytest.mark.slow
@pytest.mark.parametrize("name", PULSES)
def test_peak_is_at_the_range_with_amplitude_and_phase(name):
    """The peak between samples is found by band-limited interpolation of the line."""
    amplitude = 2.0 * np.exp(0.3j)
    for y in (40.0, 40.0013, 40.0031):
        echoes = echoes_of(PULSES[name], [[0, y, 0]], amplitude, range_m=(30, 50))
        lines = compress(echoes, oversampling=2.0)
        rho = bistatic_range_m([0, y, 0], echoes.tx_m, echoes.rx_m)[0]
        step = lines.range_step_m

        def value(r, lines=lines):
            return lines.samples[0] @ np.sinc((r - ranges(lines)[0]) / lines.range_step_m)

        found = minimize_scalar(
            lambda r, value=value: -abs(value(r)),
            bounds=(rho - step, rho + step),
            method="bounded",
            options={"xatol": 1e-6 * step},
        )
        assert abs(found.x - rho) < 1e-3 * step
        assert value(rho) * np.exp(2j * lines.wavenumber_rad_m * rho) == pytest.approx(
            amplitude, abs=1e-3
        )


def side_lobe_db(lines):
    level = np.abs(lines.samples[0])
    peak = level.argmax()
    null = peak + np.argmax(np.diff(level[peak:]) > 0)
    return db(level[null:], level[peak])


@pytest.mark.slow
def test_side_lobes():
    pulse = Pulse(CARRIER, BAND, 20e-3)  # 2000 cycles: its spectrum is nearly flat
    echoes = echoes_of(pulse, [[0, 40, 0]], range_m=(35, 45))
    assert side_lobe_db(compress(echoes, oversampling=16)) == pytest.approx(-13.26, abs=0.05)
    hamming = side_lobe_db(compress(echoes, window="hamming", oversampling=16))
    assert hamming == pytest.approx(-42.7, abs=0.5)
    taylor = side_lobe_db(compress(echoes, window="taylor", oversampling=16))
    assert taylor == pytest.approx(-30, abs=0.6)
    kaiser = side_lobe_db(compress(echoes, window=["kaiser", 8.0], oversampling=16))
    assert kaiser < -45


def test_barker_side_lobes_are_the_codes():
    """Over a wide band the response is the code's autocorrelation: 13 to 1."""
    sonar = Sonar(PULSES["barker"], [[0, 0, 0]], sample_rate_hz=2e6)
    echoes = simulate(sonar, ONE_PING, PointTargets([[0, 40, 0]]), range_m=(39, 41))
    lines = compress(echoes, bandwidth_hz=1.6e6, oversampling=2)
    chips = np.abs(ranges(lines)[0] - 40) / (C / 2 / BAND)
    away = (chips > 1.1) & (chips < 13)
    assert db(lines.samples[0, away]) == pytest.approx(-20 * np.log10(13), abs=0.1)


@pytest.mark.slow
def test_energy():
    """A flat band's response has the energy of its sinc: c/(2 B) in range, any oversampling."""
    echoes = echoes_of(Pulse(CARRIER, BAND, 20e-3), [[0, 40, 0]], range_m=(20, 60))
    for oversampling in (1.0, 1.5, 4.0):
        lines = compress(echoes, oversampling=oversampling)
        energy = np.sum(np.abs(lines.samples) ** 2) * lines.range_step_m
        assert energy == pytest.approx(C / (2 * BAND), rel=0.01)


def test_noise_gain_is_that_of_a_matched_filter():
    """White noise of power 1 per sample leaves 1/(fs integral |P|^2) at the peak's scale."""
    pulse = PULSES["up"]
    rng = np.random.default_rng(2)
    rate, n = 200e3, 40000
    noise = (rng.standard_normal((4, n)) + 1j * rng.standard_normal((4, n))) / np.sqrt(2)
    echoes = Echoes(noise, 0.0, rate, CARRIER, [0, 0, 0], [0, 0, 0], C, pulse)
    lines = compress(echoes)
    f = (np.arange(20000) + 0.5) / 20000 * BAND - BAND / 2
    energy = np.mean(np.abs(pulse.spectrum(f)) ** 2) * BAND
    power = np.mean(np.abs(lines.samples) ** 2)
    assert power == pytest.approx(1 / (rate * energy), rel=0.03)


@pytest.mark.slow
def test_nothing_wraps():
    """A strong echo at either end of the window leaves only its own side lobes at the other."""
    pulse = PULSES["up"]
    for y in (20.0, 59.9):
        echoes = echoes_of(pulse, [[0.15, y, 0]], 1000.0, range_m=(19, 61))
        lines = compress(echoes, window="hann", oversampling=1.5)
        far = np.abs(ranges(lines)[0] - y) > 30
        assert far.any()
        assert db(lines.samples[0, far], 1000.0) < -100


def passband(pulse, delays, amplitudes, rate, length, start=0.0):
    """Real signal on its carrier: Re sum A p(t - tau) exp(j 2 pi fc (t - tau))."""
    t = start + np.arange(length) / rate
    total = np.zeros(length)
    for tau, amplitude in zip(delays, amplitudes, strict=True):
        carrier = np.exp(2j * np.pi * pulse.carrier_hz * (t - tau))
        total += np.real(amplitude * pulse.envelope(t - tau) * carrier)
    return total


def test_real_passband_gives_the_same_lines_as_baseband():
    pulse = Pulse(100e3, 30e3, 2e-3, taper=1.0)
    delays, amplitudes, rate, start = [0.02, 0.0214], [1.0, 0.5j], 320e3, 0.0187
    real = passband(pulse, delays, amplitudes, rate, 2500, start)
    geometry = (rate, 100e3, [0, 0, 0], [0, 0, 0], C, pulse)
    recorded = Echoes(real[None].astype(np.float32), start, *geometry)
    assert recorded.is_passband
    # Baseband in the usual way: Hilbert's analytic signal, mixed down.
    t = start + np.arange(2500) / rate
    mixed = signal.hilbert(real) * np.exp(-2j * np.pi * 100e3 * t)
    basebanded = Echoes(mixed[None], start, *geometry)
    assert not basebanded.is_passband
    lines, expected = compress(recorded), compress(basebanded)
    assert db(lines.samples - expected.samples) < -100
    rho = C / 2 * np.array(delays)
    phases = np.exp(-2j * lines.wavenumber_rad_m * rho) * amplitudes
    found = [lines.samples[0, np.argmin(np.abs(ranges(lines)[0] - r))] for r in rho]
    np.testing.assert_allclose(np.angle(found / phases), 0, atol=0.05)
    np.testing.assert_allclose(np.abs(found), np.abs(amplitudes), rtol=0.05)


def test_echoes_without_a_pulse_are_only_filtered():
    """Tones in the band pass unchanged, and others vanish."""
    rate, n = 400e3, 4000
    t = 0.01 + np.arange(n) / rate
    tones = np.exp(2j * np.pi * np.array([[20e3], [-45e3], [60e3]]) * t)
    echoes = Echoes(tones, 0.01, rate, CARRIER, [0, 0, 0], [0, 0, 0], C)
    lines = compress(echoes, bandwidth_hz=BAND, oversampling=2)
    time = 2 / C * ranges(lines)[0]
    inner = slice(200, -200)
    np.testing.assert_allclose(
        lines.samples[0, inner], np.exp(2j * np.pi * 20e3 * time)[inner], atol=0.02
    )
    np.testing.assert_allclose(
        lines.samples[1, inner], np.exp(-2j * np.pi * 45e3 * time)[inner], atol=0.05
    )
    np.testing.assert_allclose(lines.samples[2, inner], 0, atol=0.05)


def test_sampling_below_and_at_the_bandwidth():
    """Critically sampled echoes can be compressed, without a guard band for the filter."""
    rate, n = BAND, 600
    t = np.arange(n) / rate
    echoes = Echoes(
        np.sinc(BAND * (t - 3.0021e-3))[None] + 0j, 0, rate, CARRIER, [0, 0, 0], [0, 0, 0], C
    )
    lines = compress(echoes, bandwidth_hz=BAND, oversampling=3)
    time = 2 / C * ranges(lines)[0]
    near = np.abs(time - 3.0021e-3) < 1e-3
    np.testing.assert_allclose(
        lines.samples[0, near], np.sinc(BAND * (time[near] - 3.0021e-3)), atol=2e-3
    )


@pytest.mark.parametrize("cycles", [0.1, 0.3, 1.0, 3.0, 11.0, 30.0])
@pytest.mark.parametrize("length", [1, 7, 500])
def test_narrow_bands_are_the_direct_convolution(length, cycles, monkeypatch):
    """Bands of few cycles over the recording give exact lines, with a bounded padding."""
    rate = 200e3
    band = min(cycles * rate / length, rate)
    rng = np.random.default_rng(length)
    samples = rng.standard_normal((1, length)) + 1j * rng.standard_normal((1, length))
    echoes = Echoes(samples, 0.0, rate, CARRIER, [0, 0, 0], [0, 0, 0], C)
    padded = []
    fft = compression.fft.fft
    monkeypatch.setattr(
        compression.fft, "fft", lambda x, *n, **more: padded.extend(n) or fft(x, *n, **more)
    )
    lines = compress(echoes, bandwidth_hz=band, oversampling=2)
    assert max(padded) < 32 * length + 64
    delay = (2 / C * ranges(lines)[0])[:, None] - np.arange(length) / rate
    expected = band / rate * np.sinc(band * delay) @ samples[0]
    assert db(lines.samples[0] - expected, expected) < -110


@pytest.mark.parametrize("rate_over_band", [9950.0503, 99012.345])
def test_awkward_ratios_of_rates_do_not_lengthen_transforms(rate_over_band, monkeypatch):
    """The ratio is a fraction accurate to 1e-6, and not a more accurate one of larger numbers."""
    echoes = Echoes(np.ones((1, 10000), complex), 0, 200e3, CARRIER, [0, 0, 0], [0, 0, 0], C)
    padded = []
    fft = compression.fft.fft
    monkeypatch.setattr(
        compression.fft, "fft", lambda x, *n, **more: padded.extend(n) or fft(x, *n, **more)
    )
    lines = compress(echoes, bandwidth_hz=200e3 / rate_over_band, oversampling=1)
    assert max(padded) < 1.1e6
    assert lines.range_step_m == pytest.approx(C / 2 / 200e3 * rate_over_band, rel=1e-6)


def test_channels_in_blocks_progress_and_fields(monkeypatch):
    sonar = Sonar(PULSES["up"], [[0.3, 0, 0], [-0.3, 0, 0]])
    track = Track.straight([0, 0, 0], [1, 0, 0], 3, 0.1)
    echoes = simulate(sonar, track, PointTargets([[0, 40, 0]]), motion_in_flight=True)
    whole = compress(echoes)
    calls = []
    monkeypatch.setattr(compression, "FFT_BLOCK", 1)
    parts = compress(echoes, progress=lambda *done: calls.append(done))
    assert calls == [(i + 1, 6) for i in range(6)]
    np.testing.assert_array_equal(whole.samples, parts.samples)
    np.testing.assert_allclose(whole.first_range_m, C / 2 * echoes.start_time_s)
    for name in ("tx_m", "rx_m", "rx_velocity_m_s"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(echoes, name))
    assert (whole.carrier_hz, whole.sound_speed_m_s) == (CARRIER, C)


# Bad input

GOOD = Echoes(np.zeros((2, 900), complex), 0.0, 200e3, CARRIER, [0, 0, 0], [0, 0, 0], C)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (
            {"oversampling": 0.5},
            ValueError,
            "oversampling must be finite and >= 1 and <= 10000, got 0.5",
        ),
        ({"window": "square"}, ValueError, "window must be 'none' or .* got 'square'"),
        ({"window": "kaiser"}, ValueError, "window must be 'none' or .* got 'kaiser'"),
        ({"window": None}, ValueError, "window must be 'none' or .* got None"),
        ({"window": ()}, ValueError, r"window must be 'none' or .* got \(\)"),
        ({"echoes": None}, TypeError, "echoes must be of type Echoes, got NoneType"),
        ({"progress": 1}, TypeError, "progress must be a function or None, got 1"),
        ({"oversampling": 1e12}, ValueError, "oversampling must be finite and >= 1 and <= 10000"),
        (
            {"bandwidth_hz": 1e-300},
            ValueError,
            r"bandwidth_hz must be at least 22.22 Hz, a tenth over .* \(0.0045 s\), got 1e-300 Hz",
        ),
        ({"bandwidth_hz": 22}, ValueError, "bandwidth_hz must be at least 22.22 Hz, .* got 22 Hz"),
        ({"bandwidth_hz": 300e3}, ValueError, "bandwidth_hz must be .* <= 200000 Hz, got 300000"),
        ({"bandwidth_hz": 0}, ValueError, "bandwidth_hz must be finite and > 0 .*, got 0"),
        ({"bandwidth_hz": None}, ValueError, "bandwidth_hz must be given for echoes without"),
    ],
)
def test_bad_arguments(arguments, error, message):
    with pytest.raises(error, match=message):
        compress(**{"echoes": GOOD, "bandwidth_hz": BAND, **arguments})


def test_recording_shorter_than_the_pulse():
    echoes = replace(GOOD, pulse=Pulse(CARRIER, BAND, 5e-3))
    with pytest.raises(ValueError, match=r"longer than the pulse \(0.005 s\), got 0.004495 s"):
        compress(echoes)


def test_real_echoes_need_their_band_inside_what_was_sampled():
    real = replace(GOOD, samples=np.zeros((2, 900), np.float32))
    with pytest.raises(
        ValueError, match=r"carrier_hz must be between 0 and .* 100000 Hz, for real echoes, got 1e"
    ):
        compress(real, bandwidth_hz=BAND)
    with pytest.raises(ValueError, match=r"bandwidth_hz must be .* <= 40000 Hz, got 50000"):
        compress(replace(real, carrier_hz=80e3), bandwidth_hz=50e3)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"samples": np.zeros(5)}, ValueError, r"samples must have shape \(any, any\)"),
        ({"samples": np.zeros((2, 0))}, ValueError, "samples must have shape .* no empty axis"),
        ({"samples": [[1, np.nan]] * 2}, ValueError, "samples must be finite, got 2 NaN"),
        ({"samples": [["a"]]}, TypeError, "samples must be real or complex numbers"),
        ({"start_time_s": [0, 1, 2]}, ValueError, r"start_time_s must have shape \(2\)"),
        ({"sample_rate_hz": 0}, ValueError, "sample_rate_hz must be finite and > 0 Hz, got 0"),
        ({"carrier_hz": -1}, ValueError, "carrier_hz must be finite and >= 0 Hz, got -1"),
        ({"tx_m": np.zeros((3, 3))}, ValueError, r"tx_m must have shape \(2, 3\)"),
        ({"rx_velocity_m_s": [np.inf, 0, 0]}, ValueError, "rx_velocity_m_s must be finite"),
        ({"sound_speed_m_s": -1}, ValueError, "sound_speed_m_s must be finite and > 0 m/s"),
        ({"pulse": "chirp"}, TypeError, "pulse must be of type Pulse, got str"),
        ({"pulse": Pulse(2e6, 1e5, 1e-3)}, ValueError, r"the pulse's 2e\+06 Hz, got 1e\+06 Hz"),
    ],
)
def test_bad_echoes(arguments, error, message):
    with pytest.raises(error, match=message):
        replace(GOOD, **arguments)


def test_echoes_keep_the_callers_array_writable():
    samples = np.zeros((2, 900), np.complex64)
    echoes = replace(GOOD, samples=samples)
    assert not echoes.samples.flags.writeable
    samples[0, 0] = 1


def test_numbers_of_any_width():
    narrow = compress(GOOD, bandwidth_hz=np.float32(BAND), oversampling=np.float32(2))
    wide = compress(GOOD, bandwidth_hz=BAND, oversampling=2.0)
    np.testing.assert_array_equal(narrow.samples, wide.samples)
