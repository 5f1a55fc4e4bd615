"""Non-uniform sums against direct ones."""

import numpy as np
import pytest

from clsas.engine.data.fourier import fourier_series, gridding, gridding_gain, spread, taps_for


@pytest.mark.parametrize("oversampling", [1.25, 1.5, 2.0])
@pytest.mark.parametrize("error_db", [-30, -80, -140, -220])
def test_gridding_interpolates_and_spreads_within_its_error(error_db, oversampling):
    """Cycles at all frequencies of the band, at places beyond both ends of the period of 64."""
    rng = np.random.default_rng(0)
    taps = taps_for(error_db, oversampling)
    most = int(32 / oversampling)
    frequency = np.arange(-most, most + 1) / 64
    places = rng.uniform(-64, 128, 300)
    gain = gridding_gain(frequency, taps, oversampling)
    cycles = np.exp(2j * np.pi * np.multiply.outer(np.arange(64), frequency))
    wanted = np.exp(2j * np.pi * np.multiply.outer(places, frequency))
    found = gridding(places, 64, taps, oversampling) @ cycles / gain
    assert 10 * np.log10(np.mean(np.abs(found - wanted) ** 2)) <= error_db
    values = rng.normal(size=(300, 2)) @ [1, 1j]
    found = cycles.conj().T @ spread(values, places, 64, taps, oversampling) / gain
    wanted = wanted.conj().T @ values
    bound = 10 ** (error_db / 20) * np.sqrt(300)
    assert np.linalg.norm(found - wanted) <= bound * np.linalg.norm(values)


@pytest.mark.parametrize("count", [1, 2, 77, 500])
def test_a_series_is_the_direct_sum(count):
    rng = np.random.default_rng(0)
    coefficients = rng.normal(size=(count, 2)) @ [1, 1j]
    cycles = np.concatenate([[0, 0.5, -0.5, 1e3], rng.uniform(-3, 3, 100)])
    turns = np.multiply.outer(cycles, np.arange(count)) % 1  # of large phases, sines are inexact
    wanted = np.exp(2j * np.pi * turns) @ coefficients
    found = fourier_series(coefficients, cycles)
    assert np.abs(found - wanted).max() <= 1e-11 * np.abs(wanted).max()
