"""Strips of rows give what all rows give."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, uniform_filter

from clsas.interferometry.coherence import Window
from clsas.interferometry.strips import in_strips


class Windowed(NamedTuple):
    mean: np.ndarray
    largest: np.ndarray


@pytest.mark.parametrize("rows", [1, 64, 200, 331])
@pytest.mark.parametrize("window", [Window(1, 1), Window(9, 3), Window(41, 5)])
def test_strips_have_no_seams(window, rows):
    values = np.random.default_rng(1).normal(size=(rows, 6))

    def windowed(some):
        return Windowed(uniform_filter(some, window.sides), maximum_filter(some, window.sides))

    found = in_strips(windowed, (values,), window)
    np.testing.assert_allclose(found.mean, windowed(values).mean, atol=1e-12)
    np.testing.assert_array_equal(found.largest, windowed(values).largest)
