import numpy as np
import pytest

from clsas.interferometry.coherence import Moments, Window
from clsas.interferometry.refinement import displacement_m, edge_growth, fit_planes

WINDOW = Window(9, 7)
M_PER_RAD = -0.3


def images(relief_m, assumed_m, random=None):
    """Speckle on a relief, imaged on an assumed one."""
    random = np.random.default_rng(1) if random is None else random
    first = (random.standard_normal((*relief_m.shape, 2)) @ [1, 1j]).astype(np.complex64)
    phase_rad = (relief_m - assumed_m) / M_PER_RAD
    return (first * np.exp(1j * phase_rad)).astype(np.complex64), first


def products(relief_m, assumed_m):
    return Moments.multilooked(*images(relief_m, assumed_m), 1)


def lattice():
    return np.meshgrid(np.arange(60.0), np.arange(50.0), indexing="ij")


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


def test_slopes_do_not_displace_heights():
    row, column = lattice()
    relief_m = 0.01 * row - 0.005 * column
    assumed_m = np.zeros(relief_m.shape) + 0.1
    scale = np.full(relief_m.shape, M_PER_RAD)
    # Weights of speckle are not symmetric: a mean over the window errs where a plane does not.
    for _ in range(3):
        found = fit_planes(products(relief_m, assumed_m), assumed_m, scale, WINDOW)
        assumed_m = found.height_m
    inside = (slice(5, -5),) * 2
    assert found.height_m[inside] == pytest.approx(relief_m[inside], abs=1e-3)
    assert found.row_slope_m[inside] == pytest.approx(0.01, abs=1e-3)
    assert found.column_slope_m[inside] == pytest.approx(-0.005, abs=1e-3)
    assert found.coherence[inside] == pytest.approx(1, abs=1e-3)


def test_known_reliefs_are_fixed_points():
    row, column = lattice()
    relief_m = 0.3 + 0.02 * row + 0 * column
    scale = np.full(relief_m.shape, M_PER_RAD)
    found = fit_planes(products(relief_m, relief_m), relief_m, scale, WINDOW)
    inside = (slice(5, -5),) * 2
    assert found.height_m[inside] == pytest.approx(relief_m[inside], abs=1e-3)
    assert found.roughness_m[inside].max() < 2e-3


def test_windows_across_a_step_are_rough():
    row, _ = lattice()
    relief_m = 0.5 * (row > 30)
    scale = np.full(relief_m.shape, M_PER_RAD)
    found = fit_planes(products(relief_m, relief_m), relief_m, scale, WINDOW)
    assert found.roughness_m[30, 10:-10].min() > 0.1
    assert found.roughness_m[10, 10:-10].max() < 1e-6


def test_planes_displace_curved_reliefs():
    row, column = lattice()
    relief_m = 1e-3 * (row - 30) ** 2 + 0.01 * column
    scale = np.full(relief_m.shape, M_PER_RAD)
    found = fit_planes(products(relief_m, relief_m), relief_m, scale, WINDOW)
    inside = (slice(5, -5),) * 2
    displaced_m = 1e-3 * (9**2 - 1) / 12  # mean square of 9 rows from the middle
    assert np.median(found.bend_m[inside]) == pytest.approx(displaced_m, rel=0.1)
    assert np.median((found.height_m - relief_m)[inside]) == pytest.approx(displaced_m, rel=0.1)
    level = fit_planes(products(relief_m, relief_m), 0.01 * column, scale, WINDOW)
    assert np.abs(level.bend_m[inside]).max() < 1e-3 * displaced_m


def test_growth_is_that_of_lit_pixels():
    random = np.random.default_rng(2)
    row, _ = lattice()
    flat_m = np.zeros(row.shape)
    scale = np.full(row.shape, M_PER_RAD)
    first, second = images(flat_m, flat_m, random)
    first[30:], second[30:] = 0, 0
    found = fit_planes(Moments.multilooked(first, second, 1), flat_m, scale, WINDOW)
    level = edge_growth(WINDOW, row.shape)
    assert level[20, 20] == 1
    # 5 of 9 rows are lit. Their mean is 2 rows from the middle, and their variance is 2.
    assert level[0, 20] == pytest.approx(1 + 2**2 / 2)
    assert np.median(found.growth[29, 10:-10]) == pytest.approx(level[0, 20], rel=0.3)
    assert np.median(found.growth[20, 10:-10]) < 1.2


def test_images_without_echoes_leave_the_relief():
    nothing = np.zeros((20, 20), np.complex64)
    relief_m = np.full((20, 20), 0.7)
    found = fit_planes(Moments.multilooked(nothing, nothing, 1), relief_m, relief_m, WINDOW)
    assert found.height_m == pytest.approx(0.7)
    assert not found.coherence.any()


@pytest.mark.parametrize("window", [Window(3, 3), Window(9, 3), Window(41, 5)])
def test_planes_depend_on_their_own_windows_only(window):
    """The strips in which they are computed have no seams."""
    random = np.random.default_rng(3)
    relief_m = 0.05 * random.standard_normal((400, 12))
    scale = np.full(relief_m.shape, M_PER_RAD)
    first, second = images(relief_m, 0 * relief_m, random)
    whole = fit_planes(Moments.multilooked(first, second, 1), 0 * relief_m, scale, window)
    some, inside = slice(90, 290), slice(window.rows // 2, -(window.rows // 2))
    part = fit_planes(
        Moments.multilooked(first[some], second[some], 1), 0 * relief_m[some], scale[some], window
    )
    for one, other in zip(whole, part, strict=True):
        np.testing.assert_allclose(one[some][inside], other[inside], rtol=1e-6, atol=1e-9)
