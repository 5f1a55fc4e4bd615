"""Entropy and contrast of images against closed forms."""

import numpy as np
import pytest

from clsas.engine.data.contrast import contrast, entropy


def speckle(*shape):
    rng = np.random.default_rng(5)
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)


def test_entropy_and_contrast_of_closed_forms():
    flat = np.full((20, 30), 2 - 1j)
    assert entropy(flat) == pytest.approx(np.log(600), rel=1e-12)
    assert contrast(flat) == pytest.approx(0, abs=1e-12)
    one = np.zeros((20, 30))
    one[3, 4] = 7
    assert entropy(one) == 0
    assert contrast(one) == pytest.approx(np.sqrt(599))
    # Intensities of speckle are exponential: their u ln u has the mean 1 - Euler's constant.
    many = speckle(1000, 1000)
    assert contrast(many) == pytest.approx(1, abs=0.01)
    assert entropy(many) == pytest.approx(np.log(1e6) - 1 + np.euler_gamma, abs=0.01)


def test_entropy_and_contrast_do_not_depend_on_scale():
    image = speckle(50, 60)
    for measure in (entropy, contrast):
        assert measure(1e-170 * image) == pytest.approx(measure(image), rel=1e-12)
        with pytest.raises(ValueError, match="image must not be zero everywhere"):
            measure(0 * image)
