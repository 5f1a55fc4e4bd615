import dataclasses

import numpy as np
import pytest

from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.signal.echoes import Echoes

C = 1500.0
STEP_M = 0.01
RATE = C / (2 * STEP_M)  # 75 kHz


def make(**changes):
    rng = np.random.default_rng(1)
    fields = {
        "samples": rng.normal(size=(4, 6)) + 1j * rng.normal(size=(4, 6)),
        "first_range_m": [10.0, 11.0, 12.0, 13.0],
        "range_step_m": 0.25,
        "tx_m": rng.normal(size=(4, 3)),
        "rx_m": rng.normal(size=(4, 3)),
        "carrier_hz": 120e3,
        "sound_speed_m_s": 1500.0,
    }
    return RangeLines(**(fields | changes))


def test_types_and_shapes():
    lines = make()
    assert (lines.channels, lines.length) == (4, 6)
    assert lines.samples.dtype == np.complex64
    assert lines.samples.flags.c_contiguous
    assert lines.tx_m.dtype == lines.rx_m.dtype == lines.first_range_m.dtype == np.float64
    assert lines.rx_velocity_m_s is None
    assert lines.wavenumber_rad_m == pytest.approx(2 * np.pi / 0.0125, rel=1e-15)
    np.testing.assert_array_equal(lines.last_range_m, [11.25, 12.25, 13.25, 14.25])


def test_one_value_stands_for_every_channel():
    lines = make(first_range_m=5, tx_m=[1, 2, 3], rx_velocity_m_s=[2.0, 0, 0])
    np.testing.assert_array_equal(lines.first_range_m, [5.0] * 4)
    np.testing.assert_array_equal(lines.tx_m, [[1.0, 2, 3]] * 4)
    np.testing.assert_array_equal(lines.rx_velocity_m_s, [[2.0, 0, 0]] * 4)


def test_look_directions_become_unit_vectors_once():
    lines = make(look_direction=[0, 3, -4])
    np.testing.assert_allclose(lines.look_direction, [[0, 0.6, -0.8]] * 4, atol=1e-16)
    assert not lines.look_direction.flags.writeable
    again = dataclasses.replace(lines, carrier_hz=1e5)
    assert again.look_direction.tobytes() == lines.look_direction.tobytes()
    huge = make(look_direction=np.array([[1e300, 1e300, 0], [1e-300, 0, 0], [0, 0, 9], [1, 0, 0]]))
    np.testing.assert_allclose(np.linalg.norm(huge.look_direction, axis=1), 1)


def test_carrier_may_be_zero():
    assert make(carrier_hz=0).wavenumber_rad_m == 0


def test_non_contiguous_samples_are_converted():
    samples = np.asfortranarray(make().samples)
    lines = make(samples=samples)
    assert lines.samples.flags.c_contiguous
    np.testing.assert_array_equal(lines.samples, samples)


def test_it_cannot_be_changed():
    samples = np.ones((4, 6), np.complex64)
    lines = make(samples=samples)
    with pytest.raises(ValueError, match="read-only"):
        lines.samples[0, 0] = 0
    with pytest.raises(dataclasses.FrozenInstanceError):
        lines.carrier_hz = 1.0
    samples[0, 0] = 2  # the caller's array stays writeable


@pytest.mark.parametrize(
    "channels", [slice(1, 3), [1, 2], np.array([False, True, True, False]), np.array([1, 2])]
)
def test_select(channels):
    lines = make(rx_velocity_m_s=np.arange(12.0).reshape(4, 3), look_direction=np.eye(4, 3) + 1)
    some = lines.select(channels)
    for field in dataclasses.fields(lines):
        before, after = getattr(lines, field.name), getattr(some, field.name)
        np.testing.assert_array_equal(after, before[1:3] if np.ndim(before) else before)


def test_select_shares_the_samples_of_a_slice():
    lines = make()
    assert np.shares_memory(lines.select(slice(1, 3)).samples, lines.samples)


def test_select_keeps_the_axis_of_one_channel():
    assert make().select(2).samples.shape == (1, 6)


def test_select_refuses_nothing_and_beyond():
    with pytest.raises(ValueError, match="channels must select at least one line, got none"):
        make().select(slice(2, 2))
    with pytest.raises(ValueError, match="channels must select at least one line, got none"):
        make().select([])
    with pytest.raises(TypeError, match=r"channels must be a slice, whole .* got \[1\.5\]"):
        make().select([1.5])
    with pytest.raises(ValueError, match="channels must be from"):
        make().select([4])


def with_bad(shape, value):
    array = np.zeros(shape)
    array.flat[-1] = value
    return array


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"samples": np.ones((4, 6))}, TypeError, "samples must be complex.*no phase"),
        ({"samples": np.ones(6, complex)}, ValueError, "samples must have shape"),
        ({"samples": np.ones((0, 6), complex)}, ValueError, "samples.*no empty axis"),
        ({"samples": np.ones((4, 0), complex)}, ValueError, "samples.*no empty axis"),
        ({"samples": with_bad((4, 6), np.nan) + 0j}, ValueError, "samples must be finite"),
        ({"samples": with_bad((4, 6), np.inf) + 0j}, ValueError, "samples must be finite"),
        ({"samples": np.ones((3, 6), complex)}, ValueError, r"first_range_m.*\(3\).*\(4,\)"),
        ({"first_range_m": np.nan}, ValueError, "first_range_m must be finite"),
        ({"first_range_m": [1.0, 2.0]}, ValueError, "first_range_m must have shape"),
        ({"range_step_m": 0.0}, ValueError, "range_step_m must be finite and > 0 m, got 0"),
        ({"range_step_m": -0.1}, ValueError, "range_step_m"),
        ({"range_step_m": [0.1, 0.1]}, TypeError, "range_step_m must be one real number in m"),
        ({"tx_m": np.zeros((5, 3))}, ValueError, r"tx_m must have shape \(4, 3\)"),
        ({"rx_m": 0.0}, ValueError, r"rx_m must have shape \(4, 3\)"),
        ({"rx_m": with_bad((4, 3), np.inf)}, ValueError, "rx_m must be finite"),
        ({"tx_m": np.zeros((4, 3), complex)}, TypeError, "tx_m must be real"),
        ({"carrier_hz": -1.0}, ValueError, "carrier_hz must be finite and >= 0 Hz"),
        ({"carrier_hz": "1 MHz"}, TypeError, "carrier_hz must be one real number in Hz"),
        ({"sound_speed_m_s": 0}, ValueError, "sound_speed_m_s must be finite and > 0 m/s"),
        ({"sound_speed_m_s": np.nan}, ValueError, "sound_speed_m_s"),
        ({"rx_velocity_m_s": [1.0, 2.0]}, ValueError, "rx_velocity_m_s must have shape"),
        ({"rx_velocity_m_s": [0, 1500.0, 0]}, ValueError, "rx_velocity_m_s must be.* < 1500 m/s"),
        ({"look_direction": "port"}, TypeError, "look_direction must be real numbers"),
        ({"look_direction": [0.0, 1.0]}, ValueError, r"look_direction must have shape \(4, 3\)"),
        ({"look_direction": np.eye(4, 3)}, ValueError, "look_direction must not have .* length 0"),
    ],
)
def test_bad_input_is_named(changes, error, words):
    with pytest.raises(error, match=words):
        make(**changes)


def test_it_is_shown_in_one_line():
    text = repr(make())
    assert text.startswith("RangeLines(4 channels of ")
    assert len(text) < 200


def test_samples_that_float32_does_not_hold_are_refused():
    for scale in (1e-50, 1e50):
        samples = scale * np.ones((2, 3), np.complex128)
        with pytest.raises(
            ValueError, match=r"samples must have .* got 1e[+-]50: scale the values"
        ):
            RangeLines(samples, 1.0, 0.1, (0, 0, 0), (0, 0, 0), 1e5, 1500.0)
        with pytest.raises(ValueError, match="scale the values"):
            Echoes(samples, 0.0, 1e5, 1e5, (0, 0, 0), (0, 0, 0), 1500.0)
        with pytest.raises(ValueError, match="scale the values"):
            Echoes(samples.real, 0.0, 1e5, 1e5, (0, 0, 0), (0, 0, 0), 1500.0)
        with pytest.raises(ValueError, match="scale the values"):
            Image(samples, Grid.plane((0, 1, 3), (0, 1, 2)))


# Corrections of lines


def lines_of(samples, carrier_hz=0.0, tx_m=(0, 0, 0), first_range_m=0.0):
    return RangeLines(samples, first_range_m, STEP_M, tx_m, tx_m, carrier_hz, C)


def tone(frequency_hz, length=2000):
    """Return a tone of the recorded signal, as it appears in lines on their carrier."""
    return np.exp(2j * np.pi * frequency_hz * np.arange(length) / RATE)[None]


def level_db(samples):
    """Mean amplitude away from the ends, dB."""
    return 20 * np.log10(np.abs(samples[:, 500:-500]).mean() + 1e-12)


@pytest.mark.parametrize("carrier_hz", [0.0, 20e3])
def test_high_pass_keeps_what_lies_above_and_removes_what_lies_below(carrier_hz):
    for frequency_hz, expected_db in ((10e3, 0), (5e3, 0), (2.4e3, -120), (0, -120), (-1e3, -120)):
        lines = lines_of(tone(frequency_hz - carrier_hz), carrier_hz)
        found_db = level_db(lines.high_passed(5e3).samples)
        assert found_db == pytest.approx(expected_db, abs=0.01) or found_db <= expected_db


def test_high_pass_does_not_shift_an_echo():
    pulse = np.exp(-(((np.arange(2000) - 900.3) / 6) ** 2)) * tone(15e3)[0]
    lines = lines_of(pulse[None] + 0.3)
    cleaned = lines.high_passed(4e3).samples[0]
    middle = slice(500, -500)  # the ends of a constant are not a constant
    np.testing.assert_allclose(cleaned[middle], pulse[middle], atol=1e-4)


@pytest.mark.parametrize(
    ("cutoff_hz", "said"),
    [
        (0, "> 0"),
        (80e3, "< 75000"),
        (10, "at least one cycle per line, 37.5 Hz"),
        (np.nan, "finite"),
    ],
)
def test_high_pass_refuses_cutoffs_outside_the_band(cutoff_hz, said):
    with pytest.raises(ValueError, match=said):
        lines_of(tone(1e3)).high_passed(cutoff_hz)


def test_high_pass_says_where_the_band_of_basebanded_lines_begins():
    with pytest.raises(ValueError, match=r"cutoff_hz must be finite and > 62500"):
        lines_of(tone(1e3), carrier_hz=100e3).high_passed(50e3)


def test_tapers_fade_the_ends_and_leave_the_middle():
    lines = lines_of(np.full((2, 101), 2 + 1j)).tapered_ends(0.2)
    np.testing.assert_allclose(lines.samples[:, [0, -1]], 0, atol=1e-7)
    np.testing.assert_allclose(lines.samples[:, [10, -11]], (2 + 1j) / 2, rtol=1e-6)
    np.testing.assert_array_equal(lines.samples[:, 20:81], 2 + 1j)


@pytest.mark.parametrize("length_m", [0, -1, 0.51, np.inf])
def test_tapers_longer_than_half_a_line_are_refused(length_m):
    with pytest.raises(ValueError, match=r"length_m must be finite and > 0 and <= 0\.5 m"):
        lines_of(np.ones((1, 101), complex)).tapered_ends(length_m)


def survey(pings=40, receivers=2, length=300):
    """Return echoes that move through the lines, and a background for each receiver."""
    random = np.random.default_rng(5)
    background = random.normal(size=(receivers, length)) + 1j * random.normal(
        size=(receivers, length)
    )
    echoes = np.zeros((pings, receivers, length), complex)
    for ping in range(pings):
        echoes[ping, :, 50 + 5 * ping] = 10
    tx_m = np.repeat(
        np.stack([np.arange(pings), 0 * np.arange(pings), 0 * np.arange(pings)], 1), 2, 0
    )
    both = (echoes + background).reshape(-1, length)
    return lines_of(both, 20e3, tx_m), echoes.reshape(-1, length)


def test_the_mean_takes_a_share_of_the_echoes_and_the_median_none():
    lines, echoes = survey()
    left = lines.without_background().samples - echoes
    assert np.abs(left).max() == pytest.approx(10 / 40, rel=1e-4)
    left = lines.without_background("median").samples - echoes
    assert np.abs(left).max() < 1e-5


def test_pings_that_stand_still_need_the_number_of_receivers():
    lines, echoes = survey()
    still = lines_of(lines.samples, 20e3)
    with pytest.raises(ValueError, match=r"receivers must divide .* at least 2 pings, got 80 rec"):
        still.without_background()
    left = still.without_background("median", receivers=2).samples - echoes
    assert np.abs(left).max() < 1e-5


def test_backgrounds_at_different_delays_are_refused():
    lines, _ = survey()
    moved = lines_of(lines.samples, 20e3, lines.tx_m, np.arange(80) * 1e-4)
    with pytest.raises(ValueError, match=r"ranges that differ by up to 0\.0078 m"):
        moved.without_background()


def test_pings_of_different_receivers_are_refused():
    lines, _ = survey()
    with pytest.raises(ValueError, match="from 1 to 2 channels"):
        lines.select(slice(1, None)).without_background()
    with pytest.raises(ValueError, match="statistic must be one of 'mean', 'median', got 'mode'"):
        lines.without_background("mode")


@pytest.mark.parametrize("weights", [[1.0, 0.0, -2.0], [1, 1j, 0.5 - 0.5j], [1, 2, 3]])
def test_weights_multiply_their_channels(weights):
    samples = np.array([[1 + 1j, 2], [3, 4j], [5, 6]])
    weighted = lines_of(samples).weighted(weights)
    np.testing.assert_allclose(weighted.samples, samples * np.array(weights)[:, None], rtol=1e-6)


@pytest.mark.parametrize("weights", [[1e300, 1, 1], [1e300j, 1, 1], [3e38, 1, 1], [1e-300] * 3])
def test_weights_that_overflow_are_refused(weights):
    with pytest.raises(ValueError, match=r"weights must (have a largest value|keep the samples)"):
        lines_of(np.full((3, 2), 2 + 0j)).weighted(weights)


@pytest.mark.parametrize("weights", [[1.0, 2.0], [np.nan, 1, 1], 3.0, ["a", "b", "c"]])
def test_weights_must_be_numbers_one_per_channel(weights):
    with pytest.raises((TypeError, ValueError), match="weights must"):
        lines_of(np.ones((3, 2), complex)).weighted(weights)
