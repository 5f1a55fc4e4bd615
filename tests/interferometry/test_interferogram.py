import numpy as np
import pytest

from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.validate import ClsasWarning
from clsas.interferometry.interferogram import Interferogram, interferogram

GRID = Grid.plane((0, 1.99, 200), (30, 31.99, 200))


def images(random, coherence, phase_rad, grid=GRID):
    first, second = random.standard_normal((2, *grid.shape, 2)) @ [1, 1j]
    second = coherence * first + np.sqrt(1 - coherence**2) * second
    return Image(first * np.exp(1j * phase_rad), grid), Image(second, grid)


def test_phase_has_the_deviation_that_is_reported():
    a, b = images(np.random.default_rng(1), 0.8, 2.5)
    found = interferogram(a, b, window_m=0.07)
    apart = (slice(3, -3, 7),) * 2  # windows that share no pixel
    error = np.angle(np.exp(1j * (found.phase_rad[apart] - 2.5))) / found.phase_sd_rad[apart]
    assert np.std(error) == pytest.approx(1, abs=0.1)
    assert np.median(found.coherence) == pytest.approx(0.8, abs=0.02)
    assert np.median(found.looks) == pytest.approx(49, rel=0.05)


def test_windows_at_the_edges_have_fewer_looks():
    a, b = images(np.random.default_rng(2), 0.8, 0.0)
    looks = interferogram(a, b, window_m=0.07).looks
    assert looks[0, 0] == pytest.approx(looks[100, 100] * (4 / 7) ** 2)


def test_height_maps_are_images_like_others():
    raised = GRID.with_height(np.full(GRID.shape, 0.5))
    a, b = images(np.random.default_rng(3), 0.9, 1.0, raised)
    found = interferogram(a, b, window_m=0.1)
    assert found.grid is raised
    assert np.median(found.phase_rad) == pytest.approx(1.0, abs=0.02)


def test_repr_and_types():
    found = interferogram(*images(np.random.default_rng(4), 0.9, 1.0), window_m=0.1)
    assert "200 x 200 pixels, median coherence 0.90, windows of 0.1 m" in repr(found)
    assert found.phase_rad.dtype == found.looks.dtype == np.float32
    assert not found.coherence.flags.writeable


def test_images_without_echoes_have_an_unknown_phase():
    a, _ = images(np.random.default_rng(5), 0.9, 1.0)
    found = interferogram(a, Image(np.zeros(GRID.shape, complex), GRID), window_m=0.1)
    assert not found.coherence.any()
    assert found.phase_sd_rad == pytest.approx(np.pi / np.sqrt(3))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda a, b: (a, Image(b.pixels, Grid.plane((0, 2, 200), (30, 32, 200)))), "on one grid"),
        (lambda a, b: (a, Image(b.pixels[:9], GRID.window(slice(9)))), "shapes"),
        (lambda a, b: (Image(a.pixels, Grid.points(GRID.positions_m())), b), "arbitrary points"),
    ],
)
def test_images_on_other_grids_are_refused(change, match):
    with pytest.raises(ValueError, match=match):
        interferogram(*change(*images(np.random.default_rng(6), 0.9, 1.0)), window_m=0.1)


def test_windows_of_a_single_row_are_rows():
    row = GRID.window(slice(1))
    found = interferogram(*images(np.random.default_rng(8), 0.9, 1.0, row), window_m=0.21)
    assert np.median(found.looks) == pytest.approx(21, rel=0.3)
    assert np.median(found.phase_rad) == pytest.approx(1.0, abs=0.1)
    pixel = GRID.window(slice(1), slice(1))
    with pytest.raises(ValueError, match="more than one pixel"):
        interferogram(*images(np.random.default_rng(8), 0.9, 1.0, pixel), window_m=0.21)


def test_windows_nearly_as_large_as_the_images_warn():
    a, b = images(np.random.default_rng(9), 0.9, 1.0, GRID.window(slice(30), slice(60)))
    with pytest.warns(ClsasWarning, match="two thirds.*got 70 %"):
        interferogram(a, b, window_m=0.21)
    interferogram(a, b, window_m=0.19)  # 63 %; warnings are errors


def test_windows_that_cannot_be_are_refused():
    a, b = images(np.random.default_rng(7), 0.9, 1.0)
    with pytest.raises(ValueError, match="window_m must contain at least 4 independent samples"):
        interferogram(a, b, window_m=0.01)
    with pytest.raises(ValueError, match=r"window_m must be .* <= 2 m"):
        interferogram(a, b, window_m=5.0)
    with pytest.raises(TypeError, match="a must be of type Image"):
        interferogram(a.pixels, b, window_m=0.1)


def test_fields_are_checked():
    one = np.ones(GRID.shape)
    with pytest.raises(ValueError, match="coherence must be finite"):
        Interferogram(one, one * np.nan, one, one, GRID, 0.1)
    with pytest.raises(ValueError, match="looks must have shape"):
        Interferogram(one, one, one[:5], one, GRID, 0.1)
