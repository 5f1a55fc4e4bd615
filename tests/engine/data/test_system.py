import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import fresnel

from clsas.engine.data.system import BARKER_13, Pulse, Sonar, element_pattern, line_array
from clsas.engine.data.validate import ClsasWarning

CHIRP = Pulse(carrier_hz=1e6, bandwidth_hz=100e3, duration_s=1e-3)


def chirp_spectrum(frequency, bandwidth, duration, sign=1):
    """Closed form by Fresnel integrals, of a rectangular chirp that starts at t = 0."""
    rate = bandwidth / duration
    f = sign * np.asarray(frequency)
    low, high = (np.sqrt(2 * rate) * (end * duration / 2 - f / rate) for end in (-1, 1))
    (s0, c0), (s1, c1) = fresnel(low), fresnel(high)
    centred = np.exp(-1j * np.pi * f**2 / rate) * ((c1 - c0) + 1j * (s1 - s0)) / np.sqrt(2 * rate)
    centred = centred if sign > 0 else centred.conj()
    return centred * np.exp(-1j * np.pi * np.asarray(frequency) * duration)


@pytest.mark.parametrize(("code", "sign"), [("up", 1), ("down", -1)])
def test_chirp_spectrum_is_the_fresnel_closed_form(code, sign):
    f = np.linspace(-500e3, 500e3, 4001)
    expected = chirp_spectrum(f, 100e3, 1e-3, sign)
    found = Pulse(1e6, 100e3, 1e-3, code).spectrum(f)
    assert np.max(np.abs(found - expected)) < 1e-11 * np.max(np.abs(expected))


def test_phase_code_spectrum_is_that_of_its_chips():
    pulse = Pulse.phase_code(1e6, 130e-6)
    f = np.linspace(-300e3, 300e3, 1001)
    chip = pulse.duration_s / 13
    starts = chip * np.arange(13)
    expected = chip * np.sinc(f * chip) * np.exp(-1j * np.pi * f * chip)
    expected = expected * (np.exp(-2j * np.pi * f[:, None] * starts) @ np.array(BARKER_13))
    assert np.max(np.abs(pulse.spectrum(f) - expected)) < 1e-11 * pulse.duration_s
    assert pulse.bandwidth_hz == pytest.approx(100e3)


@pytest.mark.parametrize("taper", [0.1, 0.6, 1.0])
@pytest.mark.parametrize("code", ["up", BARKER_13])
def test_tapered_spectrum_is_the_integral_of_its_envelope(code, taper):
    pulse = Pulse(1e6, 13e3, 1e-3, code, taper)
    for f in (0.0, 2.3e3, -11e3):
        parts = [
            quad(
                lambda t, part=part, f=f: part(pulse.envelope(t) * np.exp(-2j * np.pi * f * t)),
                0,
                pulse.duration_s,
                limit=2000,
                epsabs=1e-14,
                epsrel=1e-10,
                points=np.linspace(0, pulse.duration_s, 14)[1:-1],
            )[0]
            for part in (np.real, np.imag)
        ]
        expected = complex(*parts)
        assert abs(pulse.spectrum(f) - expected) < 1e-9 * pulse.duration_s


def test_chirp_sweeps_its_band_in_the_named_direction():
    t = np.linspace(0, 1e-3, 20001)
    for code, sign in (("up", 1), ("down", -1)):
        phase = np.unwrap(np.angle(Pulse(1e6, 100e3, 1e-3, code).envelope(t)))
        frequency = np.gradient(phase, t) / (2 * np.pi)
        assert frequency[1] == pytest.approx(-50e3 * sign, abs=50)
        assert frequency[-2] == pytest.approx(50e3 * sign, abs=50)


def test_taper_is_a_tukey_window():
    from scipy.signal.windows import tukey

    pulse = Pulse(1e6, 100e3, 1e-3, "up", taper=0.4)
    envelope = np.abs(pulse.envelope(np.linspace(0, 1e-3, 1001)))
    np.testing.assert_allclose(envelope, tukey(1001, 0.4), atol=1e-9)
    assert np.all(pulse.envelope([-1e-9, 1.0001e-3]) == 0)


def test_element_pattern_first_null_and_half_angle():
    # L sin(theta) = lambda is the first null, and half of that gives 2/pi.
    sines = np.array([0.0, 0.05, 0.1])
    pattern = element_pattern(15e-3, sines, 1e6, 1500.0)
    np.testing.assert_allclose(pattern, [1, 2 / np.pi, 0], atol=1e-12)
    # Twice the frequency, half the beam.
    np.testing.assert_allclose(element_pattern(15e-3, 0.05, 2e6, 1500.0), 0, atol=1e-12)


def test_presets_are_the_thesis_systems():
    wide = Sonar.thesis_wide_beam()
    assert wide.wavelength_m == pytest.approx(1.5e-3)
    assert wide.receivers == 64
    assert wide.element_length_m == pytest.approx(15e-3)
    spacing = np.diff(wide.rx_m[:, 0])
    np.testing.assert_allclose(spacing / 2 * 640, 5.28)
    edgetech = Sonar.edgetech()
    assert edgetech.receivers == 6
    assert edgetech.wavelength_m == pytest.approx(12e-3)
    extent = np.ptp(edgetech.rx_m[:, 0]) + edgetech.rx_length_m
    assert extent == pytest.approx(1.2012)
    assert edgetech.element_length_m / 2 == pytest.approx(0.10, rel=2e-3)
    assert 1500 / (2 * edgetech.pulse.bandwidth_hz) == pytest.approx(0.05)
    sensotek = Sonar.sensotek()
    assert sensotek.receivers == 96
    assert sensotek.rx_length_m == pytest.approx(sensotek.wavelength_m)
    assert 1500 / (2 * sensotek.pulse.bandwidth_hz) == pytest.approx(0.02)


def test_sample_rate_defaults_to_twice_the_bandwidth():
    assert Sonar(CHIRP, [[0, 0, 0]]).sample_rate_hz == 200e3
    assert Sonar(CHIRP, [[0, 0, 0]], sample_rate_hz=125e3).sample_rate_hz == 125e3


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"carrier_hz": 0.0}, ValueError, "carrier_hz must be finite and > 0 Hz, got 0"),
        ({"bandwidth_hz": 3e6}, ValueError, r"bandwidth_hz must be .* <= 2e\+06 Hz, got 3e\+06"),
        ({"bandwidth_hz": np.nan}, ValueError, "bandwidth_hz must be finite"),
        ({"duration_s": -1.0}, ValueError, "duration_s must be finite and > 0 s, got -1"),
        ({"duration_s": "1 ms"}, TypeError, "duration_s must be one real number in s, got '1 ms'"),
        ({"taper": 1.5}, ValueError, "taper must be .* <= 1, got 1.5"),
        ({"code": "sideways"}, ValueError, "code must be one of 'up', 'down', got 'sideways'"),
        (
            {"code": (1, 0, -1)},
            ValueError,
            r"code must be .* chips of \+1 and -1, got \(1, 0, -1\)",
        ),
        ({"code": ()}, ValueError, r"code must be .* got \(\)"),
        ({"code": (1, -1)}, ValueError, "bandwidth_hz must be chips/duration = 2000 Hz .* got"),
    ],
)
def test_bad_pulse(arguments, error, message):
    good = {"carrier_hz": 1e6, "bandwidth_hz": 100e3, "duration_s": 1e-3}
    with pytest.raises(error, match=message):
        Pulse(**{**good, **arguments})


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"pulse": "chirp"}, TypeError, "pulse must be of type Pulse, got str"),
        ({"rx_m": [0, 0, 0]}, ValueError, r"rx_m must have shape \(any, 3\)"),
        ({"rx_m": np.zeros((0, 3))}, ValueError, "rx_m must have shape .* no empty axis"),
        ({"rx_m": [[0, np.nan, 0]]}, ValueError, "rx_m must be finite, got 1 NaN"),
        ({"tx_m": [1.0, 2.0]}, ValueError, r"tx_m must have shape \(3\)"),
        (
            {"sample_rate_hz": 110e3},
            ValueError,
            "sample_rate_hz must be .* >= 125000 Hz, got 110000",
        ),
        ({"sound_speed_m_s": 0}, ValueError, "sound_speed_m_s must be finite and > 0 m/s, got 0"),
        ({"rx_length_m": -0.1}, ValueError, "rx_length_m must be finite and > 0 m, got -0.1"),
        ({"tx_height_m": 0}, ValueError, "tx_height_m must be finite and > 0 m, got 0"),
    ],
)
def test_bad_sonar(arguments, error, message):
    with pytest.raises(error, match=message):
        Sonar(**{"pulse": CHIRP, "rx_m": [[0, 0, 0]], **arguments})


def test_bad_line_array():
    with pytest.raises(ValueError, match="receivers must be at least 1, got 0"):
        line_array(0, 0.1)
    with pytest.raises(ValueError, match="spacing_m must be finite and > 0 m, got 0"):
        line_array(4, 0.0)


def test_more_than_the_machine_holds_is_refused():
    with pytest.raises(ValueError, match=r"receivers must ask for at most .* GiB, .* got .* GiB"):
        line_array(10**13, 0.01)


def test_a_pulse_keeps_plain_numbers():
    given = {
        "carrier_hz": np.array(1e5),
        "bandwidth_hz": np.float16(2e4),
        "duration_s": np.array(1),
    }
    pulse = Pulse(**given, code="up", taper=np.float32(0.5))
    for name in ("carrier_hz", "bandwidth_hz", "duration_s", "taper"):
        assert type(getattr(pulse, name)) is float
    assert Pulse.phase_code(1e5, 1e-3, np.array([1, -1])).code == (1, -1)


@pytest.mark.parametrize(("duration_s", "bandwidth_hz"), [(2.0, 30e3), (1.0, 60e3), (20.0, 4e3)])
def test_durations_in_milliseconds_are_warned_of(duration_s, bandwidth_hz):
    with pytest.warns(ClsasWarning, match="in seconds, not in milliseconds"):
        Pulse(100e3, bandwidth_hz, duration_s)


def test_nothing_is_said_of_long_pulses_of_low_frequency_or_of_radar():
    for given in ((1e3, 500.0, 4.0), (100e3, 60e3, 20e-3), (9.6e9, 1.2e9, 50e-6)):
        Pulse(*given)
