"""Errors in dark parts of an image, relative to the level there."""

import numpy as np
import pytest

import clsas
from clsas.engine.data.image_error import darkest_pixels
from clsas.measures.quality import dark_level_db


def speckle(shape, seed=0):
    return np.random.default_rng(seed).normal(size=(*shape, 2)) @ [1, 1j]


@pytest.fixture
def shadowed():
    """Speckle with a shadow 30 dB deep over an eighth of it."""
    image = speckle((160, 160))
    image[40:120, 80:120] *= 10 ** (-30 / 20)
    return image


def test_a_shadow_is_dark_and_nulls_of_speckle_are_not(shadowed):
    chosen = darkest_pixels(shadowed, 0.1)
    assert np.count_nonzero(chosen) == 2560
    assert np.count_nonzero(chosen[40:120, 80:120]) == 2560
    assert dark_level_db(shadowed) == pytest.approx(-29.4, abs=0.3)
    assert dark_level_db(speckle((160, 160))) == pytest.approx(-0.8, abs=0.5)


def test_an_error_spread_over_the_image_is_as_much_larger_in_its_shadow(shadowed):
    given = shadowed + 0.01 * speckle(shadowed.shape, 1)
    whole_db = clsas.relative_error_db(given, shadowed)
    dark_db = clsas.relative_error_db(given, shadowed, darkest=0.1)
    assert dark_db - whole_db == pytest.approx(-dark_level_db(shadowed), abs=0.3)
    assert clsas.relative_error_db(given, shadowed, darkest=1.0) == pytest.approx(whole_db)


def test_errors_elsewhere_do_not_count(shadowed):
    given = shadowed.copy()
    given[:20] *= 2
    assert clsas.relative_error_db(given, shadowed, darkest=0.1) == -np.inf


def test_pixels_that_were_not_imaged_do_not_count(shadowed):
    shadowed[:, :30] = 0
    chosen = darkest_pixels(shadowed, 0.1)
    assert not chosen[:, :30].any()
    assert np.count_nonzero(chosen) == 2080


def test_points_count_one_by_one():
    image = np.array([5.0, 1, 4, 2, 3j])
    assert darkest_pixels(image, 0.4).tolist() == [False, True, False, True, False]
    assert dark_level_db(image, darkest=0.2) == pytest.approx(10 * np.log10(1 / 11))


@pytest.mark.parametrize("scale", [1e-200, 1e200])
def test_units_do_not_matter(shadowed, scale):
    assert dark_level_db(scale * shadowed) == pytest.approx(dark_level_db(shadowed))


@pytest.mark.parametrize("darkest", [0.0, -1.0, 1.1, np.nan])
def test_wrong_shares_are_refused(shadowed, darkest):
    with pytest.raises(ValueError, match="darkest must be"):
        clsas.relative_error_db(shadowed, shadowed, darkest=darkest)


def test_an_image_of_zeros_has_no_dark_part():
    with pytest.raises(ValueError, match="zero everywhere"):
        dark_level_db(np.zeros((3, 3), complex))
