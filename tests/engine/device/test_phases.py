import numpy as np
import pytest

from clsas.engine.device import phases


@pytest.mark.parametrize("terms", phases.TERMS)
def test_polynomials_are_sine_and_cosine(terms):
    r = np.random.default_rng(terms).uniform(-0.5, 0.5, 20000)
    sine, cosine = (np.polyval(each.astype(np.float64), r**2) for each in phases.polynomials(terms))
    off = cosine + 1j * r * sine - np.exp(2j * np.pi * r)
    rms = np.sqrt(np.mean(np.abs(off) ** 2))
    assert rms == pytest.approx(phases.error(terms), rel=0.1)
    assert np.abs(off).max() <= 5 * rms


@pytest.mark.parametrize("most", [phases.FACTORIZED_SHARE, phases.EXACT_SHARE])
def test_an_image_has_as_many_terms_as_it_needs(most):
    for error_db in np.arange(-85, -1):
        terms = phases.terms_within(error_db, most)
        share = (phases.error(terms) / 10 ** (error_db / 20)) ** 2
        assert share <= most
        fewer = [n for n in phases.TERMS if n < terms]
        assert all(phases.error(n) ** 2 > most * 10 ** (error_db / 10) for n in fewer)
