"""Pictures of interferograms and of heights."""

import dataclasses

import numpy as np
import pytest
from matplotlib.colors import Normalize

import clsas
from clsas import plot
from clsas.plot import interferometry
from clsas.plot.canvas import colour_map

GRID = clsas.Grid.plane((-1, 1, 81), (40, 42, 101))


def interferogram(phase_rad, grid=GRID):
    one = np.ones(grid.shape)
    return clsas.Interferogram(phase_rad, 0.8 * one, 40 * one, 0.1 * one, grid, window_m=0.2)


def heights(grid, height_m, mask):
    one = np.ones(grid.shape)
    image = clsas.Image(one.astype(complex), grid)
    return clsas.Heights(height_m, 0.01 * one, one, mask, 40 * one, one, image, window_m=0.2)


def fringes():
    x, y = np.meshgrid(*GRID.axes_m)
    return interferogram(np.angle(np.exp(1j * (8 * x + 0.01 * y))))


def hill():
    x, y = np.meshgrid(*GRID.axes_m)
    height_m = np.exp(-(x**2 + (y - 41) ** 2) / 0.1)
    mask = np.ones(GRID.shape, bool)
    mask[60:80, 30:50] = False
    return heights(GRID, height_m, mask)


def test_an_interferogram_is_drawn_in_cyclic_colours():
    figure = plot.interferogram(fringes(), title="Banks")
    phase, coherence = (axes.images[0] for axes in figure.axes[:2])
    np.testing.assert_allclose(phase.get_array(), fringes().phase_rad)
    assert phase.get_clim() == (-np.pi, np.pi)
    # Both ends of the colours are equal, and no colour in between is.
    ends = phase.get_cmap()([0.0, 1.0])
    np.testing.assert_allclose(ends[0], ends[1], atol=0.05)
    assert np.abs(phase.get_cmap()(0.5) - ends[0]).max() > 0.5
    # Neighbouring dots of opposite phase are not averaged.
    assert phase.get_interpolation() == "nearest"
    assert coherence.get_clim() == (0, 1)
    assert figure.axes[0].get_xlabel() == "Along-track (m)"
    assert figure.get_suptitle() == "Banks"
    assert phase.get_extent() == pytest.approx((-1.0125, 1.0125, 39.99, 42.01))


def test_heights_are_shaded_and_masked():
    found = hill()
    figure = plot.heights(found)
    height, deviation = figure.axes[:2]
    relief = height.images[-1].get_array()
    np.testing.assert_allclose(relief[~found.mask], np.tile(interferometry._MASKED, (400, 1)))
    assert "4.9 %" not in height.get_title()
    assert "5 % masked" in height.get_title()
    # The upper left of the hill faces the light.
    upper_left, lower_right = relief[54, 36].sum(), relief[46, 44].sum()
    assert upper_left > 1.3 * lower_right
    # Level ground has the colour of its height.
    np.testing.assert_allclose(relief[0, 0], colour_map("viridis")(0.0)[:3], atol=0.02)
    assert deviation.images[0].get_array().mask.sum() == (~found.mask).sum()
    np.testing.assert_allclose(deviation.images[0].get_array().compressed(), 10.0)


@pytest.mark.parametrize("x", [(-1, 1, 81), (1, -1, 81)])
@pytest.mark.parametrize("y", [(40, 42, 101), (42, 40, 101)])
def test_light_comes_from_the_upper_left_on_any_grid(x, y):
    """Grids whose rows or columns run backwards show the same picture."""
    grid = clsas.Grid.plane(x, y)
    at_x, at_y = np.meshgrid(*grid.axes_m)
    height_m = np.exp(-(at_x**2 + (at_y - 41) ** 2) / 0.1)
    figure = plot.heights(heights(grid, height_m, np.ones(grid.shape, bool)))
    drawn = figure.axes[0].images[-1]
    left, right, bottom, top = drawn.get_extent()
    relief = drawn.get_array()
    column_x = np.linspace(left, right, 2 * 81 + 1)[1::2]
    row_y = np.linspace(bottom, top, 2 * 101 + 1)[1::2]

    def brightness(x_m, y_m):
        return relief[np.abs(row_y - y_m).argmin(), np.abs(column_x - x_m).argmin()].sum()

    assert brightness(-0.1, 41.1) > 1.3 * brightness(0.1, 40.9)


def test_shading_of_a_plane_is_even_and_of_noise_is_finite():
    known = np.ones((30, 40), bool)
    colours = colour_map("viridis"), Normalize(0, 1)
    flat = interferometry._relief(np.full((30, 40), 0.5), known, (0.1, 0.1), *colours)
    np.testing.assert_allclose(flat, np.broadcast_to(colours[0](0.5)[:3], flat.shape))
    row = interferometry._relief(np.full((1, 40), 0.5), known[:1], (0.1, 0.1), *colours)
    np.testing.assert_allclose(row, flat[:1])
    noise = np.random.default_rng(0).uniform(0, 1, (30, 40))
    shaded = interferometry._relief(noise, known, (0.1, 0.1), *colours)
    assert shaded.min() >= 0
    assert shaded.max() <= 1


def test_large_results_are_thinned(monkeypatch):
    monkeypatch.setattr(interferometry, "MOST_PIXELS", 40)
    figure = plot.interferogram(fringes())
    assert figure.axes[0].images[0].get_array().shape == (34, 27)
    plot.heights(hill())


def test_wide_results_are_stacked():
    grid = clsas.Grid.plane((-10, 10, 201), (40, 42, 21))
    figure = plot.interferogram(interferogram(np.zeros(grid.shape), grid))
    upper, lower = (axes.get_position() for axes in figure.axes[:2])
    assert upper.y0 > lower.y0
    assert upper.x0 == pytest.approx(lower.x0, abs=0.05)


def test_wrong_results_are_refused():
    with pytest.raises(TypeError, match="interferogram must be of type Interferogram, got int"):
        plot.interferogram(3)
    with pytest.raises(TypeError, match="heights must be of type Heights, got Image"):
        plot.heights(hill().image)
    with pytest.raises(ValueError, match="at least one pixel that is not masked"):
        plot.heights(heights(GRID, np.zeros(GRID.shape), np.zeros(GRID.shape, bool)))
    with pytest.raises(ValueError, match="colour_map must be"):
        plot.heights(hill(), colour_map="rainbows")


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("sd_m", -0.01, "sd_m within the mask must be finite and >= 0 m, got -0.01"),
        ("coherence", 1.01, "coherence must be finite and >= 0 and <= 1, got 1.01"),
        ("looks", -1.0, "looks must be finite and >= 0, got -1"),
    ],
)
def test_impossible_results_are_refused(field, value, message):
    found = heights(GRID, np.zeros(GRID.shape), np.ones(GRID.shape, bool))
    values = getattr(found, field).copy()
    values[2, 3] = value
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(found, **{field: values})
