import numpy as np
import pytest
from scipy.constants import speed_of_light

import clsas
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.signal.phase_history import from_phase_history

POINT_M = np.array([3.0, -4.0, 0.5])
AMPLITUDE = 0.6 - 0.3j
COUNT = 300


def collection(bistatic=False, own_steps=False, pulses=64):
    """Positions, frequencies and reference ranges of a curved pass; steps and starts may vary."""
    angle = np.linspace(-0.02, 0.02, pulses)
    tx_m = 5000 * np.stack([np.sin(angle), -np.cos(angle), 0.7 + 0.01 * angle], axis=1)
    rx_m = tx_m + [0, 800.0, -900.0] if bistatic else tx_m
    vary = angle / angle.max() if own_steps else np.zeros(pulses)
    first_hz, step_hz = 9.3e9 * (1 + 0.004 * vary), 1.5e6 * (1 + 0.004 * vary)
    reference_m = (np.linalg.norm(tx_m, axis=1) + np.linalg.norm(rx_m, axis=1)) / 2 + 0.37
    return tx_m, rx_m, first_hz, step_hz, reference_m


def history(tx_m, rx_m, first_hz, step_hz, reference_m, sign=-1):
    """The phase history of one point, in closed form."""
    range_m = (np.linalg.norm(POINT_M - tx_m, axis=1) + np.linalg.norm(POINT_M - rx_m, axis=1)) / 2
    frequency = first_hz[:, None] + np.arange(COUNT) * step_hz[:, None]
    cycles = 2 / speed_of_light * frequency * (range_m - reference_m)[:, None]
    return AMPLITUDE * np.exp(sign * 2j * np.pi * cycles), range_m


def lines_of(parts, sign=-1, **options):
    tx_m, rx_m, first_hz, step_hz, reference_m = parts
    return from_phase_history(
        history(*parts, sign)[0],
        first_frequency_hz=first_hz,
        frequency_step_hz=step_hz,
        reference_range_m=reference_m,
        tx_m=tx_m,
        rx_m=rx_m,
        sound_speed_m_s=speed_of_light,
        sign=sign,
        **options,
    )


@pytest.mark.parametrize("own_steps", [False, True], ids=["one step", "own steps"])
@pytest.mark.parametrize("window", ["none", "hamming", ("kaiser", 6.0)], ids=str)
def test_the_window_spans_the_band_and_what_is_outside_is_left_out(window, own_steps):
    """The same lines come from the samples of the band alone."""
    parts = tx_m, rx_m, first_hz, step_hz, reference_m = collection(own_steps=own_steps, pulses=4)
    below, inside = 60, 201  # the band is not in the middle of the samples
    noisy = history(*parts)[0]
    noise = np.random.default_rng(1).normal(size=(*noisy.shape, 2)) @ [1, 1j]
    outside = np.ones(COUNT, bool)
    outside[below : below + inside] = False
    noisy[:, outside] += 10 * noise[:, outside]
    low_hz = first_hz + below * step_hz
    band_hz = np.stack([low_hz, low_hz + (inside - 1) * step_hz], axis=1)
    common = dict(
        frequency_step_hz=step_hz, reference_range_m=reference_m, tx_m=tx_m, rx_m=rx_m,
        sound_speed_m_s=speed_of_light, window=window,
    )  # fmt: skip
    found = from_phase_history(noisy, first_frequency_hz=first_hz, band_hz=band_hz, **common)
    wanted = from_phase_history(
        noisy[:, ~outside], first_frequency_hz=low_hz, oversampling=2 * COUNT / inside, **common
    )
    assert found.carrier_hz == pytest.approx(wanted.carrier_hz, rel=1e-12)
    assert found.samples.shape == wanted.samples.shape
    np.testing.assert_allclose(found.samples, wanted.samples, atol=2e-6)


@pytest.mark.parametrize(
    "band_hz", [(9.9e9, 9.4e9), (9.4e9, 9.4005e9), (8e9, 8.5e9), (9.4, 9.6), (np.nan, 9.5e9)]
)
def test_a_band_must_contain_frequencies_of_the_samples(band_hz):
    with pytest.raises(ValueError, match="band_hz"):
        lines_of(collection(), band_hz=band_hz)


@pytest.mark.slow
@pytest.mark.parametrize("own_steps", [False, True], ids=["one step", "own steps"])
@pytest.mark.parametrize("bistatic", [False, True], ids=["monostatic", "bistatic"])
def test_a_point_is_a_pulse_at_its_range_with_the_phase_of_the_carrier(bistatic, own_steps):
    parts = collection(bistatic, own_steps)
    lines = lines_of(parts)
    _, _, first_hz, step_hz, _ = parts
    range_m = history(*parts)[1]
    offset_m = lines.first_range_m[:, None] + np.arange(lines.length) * lines.range_step_m
    offset_m -= range_m[:, None]
    frequency = first_hz[:, None] + np.arange(COUNT) * step_hz[:, None] - lines.carrier_hz
    pulse = np.stack(
        [np.exp(4j * np.pi / speed_of_light * np.outer(d, f)).mean(axis=1)
         for d, f in zip(offset_m, frequency, strict=True)]
    )  # fmt: skip
    phase = np.exp(-2j * lines.wavenumber_rad_m * range_m)[:, None]
    assert np.abs(lines.samples - AMPLITUDE * pulse * phase).max() < 2e-6


@pytest.mark.parametrize("own_steps", [False, True], ids=["one step", "own steps"])
def test_a_point_focuses_where_it_is(own_steps):
    parts = collection(own_steps=own_steps)
    lines = lines_of(parts, window="hamming").tapered_ends(1.0)
    grid = clsas.Grid.plane(
        x=(POINT_M[0] - 2, POINT_M[0] + 2, 81), y=(POINT_M[1] - 2, POINT_M[1] + 2, 81), z=POINT_M[2]
    )
    image = clsas.backproject(lines, grid, accuracy_db=-60)
    row, column = np.unravel_index(np.abs(image.pixels).argmax(), grid.shape)
    assert (row, column) == (40, 40)
    assert image.pixels[40, 40] == pytest.approx(AMPLITUDE * lines.channels, rel=2e-3)


def test_the_other_sign_gives_the_conjugate_amplitude():
    ours, other = (lines_of(collection(), sign) for sign in (-1, 1))
    turn = np.conj(AMPLITUDE) / AMPLITUDE
    np.testing.assert_allclose(other.samples, ours.samples * turn, atol=1e-6)


def test_oversampling_only_interpolates():
    sparse, dense = (lines_of(collection(), oversampling=n) for n in (1.0, 2.0))
    assert (sparse.length, dense.length) == (300, 600)
    np.testing.assert_allclose(dense.samples[:, ::2], sparse.samples, atol=1e-6)
    assert dense.range_step_m == sparse.range_step_m / 2


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (
            {"first_frequency_hz": 9.3},
            "`first_frequency_hz` is 9.3 Hz, less than 1/100 of the band",
        ),
        ({"reference_range_m": -10.0}, "`reference_range_m` is negative, -10 m at least"),
    ],
)
def test_slips_that_are_possible_are_a_warning(wrong, said):
    usual = {"first_frequency_hz": 9.3e9, "frequency_step_hz": 1e6, "reference_range_m": 10.0}
    samples, at = np.ones((3, 4), complex), np.zeros((3, 3))
    options = {"tx_m": at, "rx_m": at, "sound_speed_m_s": speed_of_light}
    from_phase_history(samples, **usual, **options)  # warnings are errors here
    with pytest.warns(ClsasWarning, match=said):
        lines = from_phase_history(samples, **usual | wrong, **options)
    assert lines.channels == 3


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"samples": np.ones((3, 1), complex)}, "at least 2 frequencies, got 1"),
        ({"samples": np.ones((3, 4))}, "samples must be complex"),
        ({"sign": 0}, "sign must be one of -1, 1, got 0"),
        ({"sign": 1.5}, "sign must be one of -1, 1, got 1.5"),
        ({"frequency_step_hz": -1e6}, "frequency_step_hz must be finite and > 0 Hz, got -1e\\+06"),
        (
            {"first_frequency_hz": [1e9, 0, 1e9]},
            "first_frequency_hz must be finite and > 0 Hz, got 0",
        ),
        ({"reference_range_m": [1.0, 2.0]}, "reference_range_m must have shape"),
        ({"reference_range_m": np.nan}, "reference_range_m must be finite"),
        ({"oversampling": 0.5}, "oversampling must be finite and >= 1"),
        ({"oversampling": 1e12}, "oversampling must be finite and >= 1 and <= 10000"),
        ({"window": "nonsense"}, "window must be 'none' or"),
        ({"sound_speed_m_s": 0}, "sound_speed_m_s must be"),
        (
            {"first_frequency_hz": 1e300},
            "first_frequency_hz must be finite and <= 1e.15 Hz, got 1e.300",
        ),
        ({"first_frequency_hz": -1e9}, "first_frequency_hz must be finite and > 0 Hz, got -1e"),
        ({"first_frequency_hz": np.nan}, "first_frequency_hz must be finite"),
        (
            {"frequency_step_hz": 1e300},
            "frequency_step_hz must be finite and <= 1e.15 Hz, got 1e.300",
        ),
        ({"frequency_step_hz": 1e308}, "frequency_step_hz must be finite and <= 1e.15 Hz"),
        ({"frequency_step_hz": 1e-300}, "make at most .* cycles, .* over"),
        ({"frequency_step_hz": np.nan}, "frequency_step_hz must be finite"),
        ({"reference_range_m": 1e300}, "make at most .* cycles, .* over 1e.300 m"),
        ({"sound_speed_m_s": 1e-300}, "make at most .* cycles, .* over"),
        ({"sound_speed_m_s": 1e300}, "sound_speed_m_s must be .* <= 3e.08 m/s, got 1e.300"),
    ],
)
def test_wrong_arguments_are_named(wrong, said):
    right = {
        "samples": np.ones((3, 4), complex),
        "first_frequency_hz": 1e9,
        "frequency_step_hz": 1e6,
        "reference_range_m": 100.0,
        "tx_m": np.zeros((3, 3)),
        "rx_m": np.zeros((3, 3)),
        "sound_speed_m_s": speed_of_light,
    } | wrong
    with pytest.raises((TypeError, ValueError), match=said):
        from_phase_history(right.pop("samples"), **right)
