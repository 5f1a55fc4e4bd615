import numpy as np
import pytest

from clsas.interferometry.coherence import Window
from clsas.interferometry.refinement import displacement_m

WINDOW = Window(9, 7)


def test_displacements_of_curved_windows_are_found_below_noise():
    random = np.random.default_rng(1)
    shape = (120, 100)
    noise_m = np.full(shape, 0.01)
    valid = random.random(shape) < 0.8
    of_noise_m = 0.005 * random.standard_normal(shape)  # half a deviation, as on level seabeds
    found_m = displacement_m(of_noise_m + 0.008, noise_m, valid, WINDOW)
    assert np.median(found_m) == pytest.approx(0.008, rel=0.05)
    assert np.mean(found_m**2) == pytest.approx(0.008**2, rel=0.1)
    level_m = displacement_m(of_noise_m, noise_m, valid, WINDOW)
    assert np.sqrt(np.mean(level_m**2)) < 0.002  # 2 % of the deviation, if its square is added


def test_pixels_that_are_not_valid_displace_nothing():
    noise_m = np.full((30, 30), 0.01)
    bend_m = np.full((30, 30), 5.0)
    nowhere = np.zeros((30, 30), bool)
    assert not displacement_m(bend_m, noise_m, nowhere, WINDOW).any()
