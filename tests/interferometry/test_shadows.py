import numpy as np
import pytest

from clsas.engine.data.grid import Grid
from clsas.interferometry.baseline import Lattice
from clsas.interferometry.coherence import Window
from clsas.interferometry.shadows import in_shadow

GRID = Grid.plane((0, 2.9, 30), (30, 39.9, 100))
WINDOW = Window(5, 5)
DEPRESSION = 0.5  # tangent of the angle


def sights(towards_rows=1.0):
    """Curves of equal range with one tangent everywhere, in pixels of 0.1 m per metre of rise."""
    values = np.empty((2, 2, 2, 3))
    values[:] = 3.0, 10 * DEPRESSION * towards_rows, 0.0
    return Lattice(np.array([0.0, 99]), np.array([0.0, 29]), np.array([-5.0, 5]), values)


def shadow(height_m, valid=None, sd_m=0.01, **options):
    valid = np.ones(height_m.shape, bool) if valid is None else valid
    return in_shadow(
        GRID, height_m, np.full(height_m.shape, sd_m), valid, sights(**options), WINDOW
    )


def wall(rows=slice(20, 30), columns=slice(5, 25)):
    height_m = np.zeros(GRID.shape)
    height_m[rows, columns] = 2.0
    return height_m


def test_a_wall_hides_what_is_behind_it():
    hidden = shadow(wall())
    # The middle of the last whole window on the wall is in row 27, and 2 m high: 4 m of shadow.
    length = hidden[:, 15].sum()
    assert hidden[30:60, 15].all()
    assert length == pytest.approx(67 - 30, abs=3)
    assert not hidden[:30].any()
    assert not hidden[:, :5].any()


def test_pixels_without_heights_do_not_light_their_neighbours():
    valid = np.ones(GRID.shape, bool)
    valid[30:60] = np.random.default_rng(1).random((30, GRID.shape[1])) < 0.5
    behind = np.zeros(GRID.shape, bool)
    behind[30:60, 8:22] = True
    assert shadow(wall(), valid)[behind & valid].all()


def test_sonars_on_the_other_side_see_the_other_shadow():
    hidden = shadow(wall(rows=slice(60, 70)), towards_rows=-1.0)
    assert hidden[35:60, 15].all()
    assert not hidden[70:].any()


def test_uncertain_heights_hide_nothing():
    assert not shadow(wall(), sd_m=0.5).any()


def test_invalid_and_single_pixels_hide_nothing():
    valid = np.ones(GRID.shape, bool)
    valid[20:30] = False
    assert not shadow(wall(), valid).any()
    assert not shadow(wall(rows=slice(20, 23))).any()  # smaller than a window
    assert not shadow(wall(), np.zeros(GRID.shape, bool)).any()


def test_gentle_slopes_hide_nothing():
    row = np.arange(100.0)[:, None] + np.zeros(30)
    assert not shadow(-0.1 * 0.9 * DEPRESSION * row).any()
    assert shadow(-0.1 * 1.5 * DEPRESSION * row)[30:-5, 5:-5].all()
