"""Robust fits of few unknowns to many correlated heights, on synthetic ones."""

import numpy as np
import pytest

from clsas.interferometry.coherence import Window
from clsas.interferometry.error_fit import Equations, Places, fitted

SHAPE = 90, 45
WINDOW = Window(9, 9)
TRUE = np.array([0.4, -0.2])


def heights(random, sd_m=0.01):
    """Noise with a deviation of sd_m that is correlated as by overlapping windows."""
    white = random.standard_normal((SHAPE[0] + 16, SHAPE[1] + 16))
    return sd_m * 9 * (WINDOW.sums(white) / WINDOW.pixels)[8:-8, 8:-8]


def fit(noise_m, every=3, unknowns=2, wrong=None):
    row, column = (each.ravel() for each in np.mgrid[0 : SHAPE[0] : every, 0 : SHAPE[1] : every])
    columns = np.column_stack([np.ones(len(row)), row / SHAPE[0]])[:, :unknowns]
    measured_m = -columns @ TRUE[:unknowns] + noise_m[row, column]
    if wrong is not None:
        measured_m[wrong[row, column]] += 0.5

    def equations_at(values):
        return Equations(measured_m + columns @ values, columns, np.full(len(row), 0.01))

    return fitted(equations_at, unknowns, Places(row, column, SHAPE, WINDOW))


@pytest.mark.slow
def test_deviations_match_the_scatter():
    random = np.random.default_rng(1)
    fits = [fit(heights(random)) for _ in range(300)]
    errors = np.array([each.values - TRUE for each in fits])
    reported = np.sqrt(np.mean([np.diag(each.covariance) for each in fits], axis=0))
    # 300 samples determine a deviation to 4 %.
    assert errors.std(axis=0) / reported == pytest.approx([1, 1], abs=0.12)
    expected = SHAPE[0] * SHAPE[1] / WINDOW.pixels
    assert np.mean([each.samples for each in fits]) == pytest.approx(expected, rel=0.3)


def test_more_pixels_of_the_same_windows_tell_nothing_more():
    noise_m = heights(np.random.default_rng(2))
    coarse, fine = (fit(noise_m, every).covariance for every in (3, 1))
    assert np.diag(fine) == pytest.approx(np.diag(coarse), rel=0.15)


def test_a_third_of_outliers_does_not_matter():
    random = np.random.default_rng(3)
    wrong = np.zeros(SHAPE, bool)
    wrong[:, :15] = True
    found = fit(heights(random), wrong=wrong)
    assert found.used.mean() == pytest.approx(2 / 3, abs=0.02)
    assert np.all(np.abs(found.values - TRUE) < 3 * np.sqrt(np.diag(found.covariance)))


def test_places_that_the_last_step_makes_unusable_are_no_fit():
    row = column = np.arange(3)
    columns = np.ones((3, 1))

    def equations_at(values):
        residual_m = np.where(values[0] == 0, 1e-4, np.nan) * np.ones(3)
        return Equations(residual_m, columns, np.full(3, 0.01))

    assert fitted(equations_at, 1, Places(row, column, SHAPE, WINDOW)) is None


def test_a_misfit_enlarges_deviations():
    noise_m = heights(np.random.default_rng(4))
    good, bad = (fit(factor * noise_m) for factor in (1, 3))
    assert bad.misfit == pytest.approx(3 * good.misfit, rel=0.05)
    ratio = np.diag(bad.covariance) / np.diag(good.covariance)
    assert np.all(ratio > 6)


def test_no_known_height_is_no_fit():
    assert fit(np.full(SHAPE, np.nan)) is None
