import numpy as np
import pytest

from clsas.engine.data.lines import RangeLines

C = 1500.0
STEP_M = 0.01
RATE = C / (2 * STEP_M)  # 75 kHz


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
    with pytest.raises(ValueError, match=r"differs by up to 0\.0078 m"):
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
