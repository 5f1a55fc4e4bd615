"""Arguments of full matrix captures; `tests/files/test_matlab_recordings.py` images them."""

import numpy as np
import pytest

import clsas

RIGHT = {
    "samples": np.random.default_rng(0).standard_normal((2, 2, 64)),
    "elements_m": [[0, 0, 0], [3e-4, 0, 0]],
    "sample_rate_hz": 25e6,
    "carrier_hz": 5e6,
    "sound_speed_m_s": 6320.0,
}


def test_a_carrier_above_a_quarter_of_the_rate_needs_a_band():
    lines = clsas.from_full_matrix(**(RIGHT | {"carrier_hz": 9e6, "bandwidth_hz": 6e6}))
    assert lines.carrier_hz == 9e6


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"carrier_hz": 12.5e6}, r"carrier_hz must be .* > 0 and < 1\.25e\+07 Hz, got 1\.25e\+07"),
        ({"carrier_hz": 30e6}, r"carrier_hz must be .* got 3e\+07"),
        (
            {"carrier_hz": 9e6},
            r"carrier_hz must be at most a quarter of the sample rate, 6\.25e\+06 Hz, .* "
            r"got 9e\+06 Hz: give `bandwidth_hz`, at most 7e\+06 Hz",
        ),
        ({"carrier_hz": 9e6, "bandwidth_hz": 8e6}, "bandwidth_hz must be .*<= 7e"),
        ({"carrier_hz": 0}, "carrier_hz must be"),
        ({"carrier_hz": -5e6}, "carrier_hz must be"),
        ({"carrier_hz": np.nan}, "carrier_hz must be finite"),
        ({"carrier_hz": 1e300}, "carrier_hz must be"),
        ({"sample_rate_hz": 1e301}, r"sample_rate_hz must be .* <= 1e\+15 Hz, got 1e\+301"),
        ({"sample_rate_hz": np.inf}, "sample_rate_hz must be finite"),
        ({"sample_rate_hz": -1.0}, r"sample_rate_hz must be .* > 0 .* Hz, got -1"),
        ({"start_time_s": 1e300}, "make at most .* cycles, .* over"),
        ({"start_time_s": np.nan}, "start_time_s must be finite"),
        ({"sound_speed_m_s": 0.0}, "sound_speed_m_s must be"),
        ({"sound_speed_m_s": 1e300}, r"sound_speed_m_s must be .* <= 3e\+08 m/s, got 1e\+300"),
        ({"bandwidth_hz": 1e300}, "bandwidth_hz must be"),
        ({"elements_m": [[0, 0, np.nan], [1, 0, 0]]}, r"elements_m must be finite, .* \[0, 2\]"),
        ({"samples": np.full((2, 2, 64), 1e300)}, "samples must have a largest value"),
    ],
)
def test_wrong_arguments_are_named(wrong, said):
    with pytest.raises((TypeError, ValueError), match=said):
        clsas.from_full_matrix(**(RIGHT | wrong))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"carrier_hz": 50}, r"carrier_hz must be at least 1\.953e\+04 Hz .* got 50 Hz"),
        ({"carrier_hz": 19e3}, r"carrier_hz must be at least 1\.953e\+04 Hz .* got 19000 Hz"),
        ({"bandwidth_hz": 1e-3}, r"bandwidth_hz must be at least 3\.906e\+04 Hz, .* got 0\.001 Hz"),
    ],
)
def test_a_band_too_narrow_for_the_samples_is_refused(wrong, said):
    """64 samples at 25 MHz last 2.56 us. Of 50 Hz, filters would have 10 million times as many."""
    with pytest.raises(ValueError, match=said):
        clsas.from_full_matrix(**(RIGHT | wrong))
