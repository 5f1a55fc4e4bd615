import numpy as np
import pytest
from factorizing import around

from clsas.engine.data.grid import Grid
from clsas.engine.data.surface import LEAST_SIDE, surface_of

SIDES = ((16, 4), (32, 8), (32, 64), (128, 128))


def waves(shape=(150, 90)):
    row, column = np.indices(shape)
    grid = around(3, 40, shape=shape)
    return grid.with_height(0.02 * row - 0.01 * column + 0.3 * np.sin(row / 8) * np.cos(column / 6))


def cloud():
    """Points that leave most of the plane empty."""
    rng = np.random.default_rng(1)
    points_m = np.concatenate([rng.normal(0, 0.3, (500, 3)), rng.normal(2, 0.5, (900, 3))])
    return Grid.points(points_m + [0, 40, 0])


def steep():
    return Grid.points(waves().positions_m()[..., [0, 2, 1]])


GRIDS = {"heights": waves(), "points": cloud(), "an upright plane": steep()}


def members(surface, side):
    """Pixels of each subimage, by its first cell."""
    row, column = np.divmod(surface.cell, surface.plane.shape[1])
    corner = np.stack([row // side[0] * side[0], column // side[1] * side[1]], axis=1)
    for each in np.unique(corner, axis=0):
        yield each, np.flatnonzero((corner == each).all(axis=1))


def parts(surface, position_m):
    """Components of positions along each of the steps."""
    return np.linalg.solve(surface.steps_m.T, position_m.T).T


@pytest.mark.parametrize("grid", GRIDS.values(), ids=GRIDS)
def test_pixels_lie_over_their_cells(grid):
    surface = surface_of(grid)
    at = parts(surface, grid.positions_m().reshape(-1, 3) - surface.plane.origin_m)
    cell = np.stack(np.divmod(surface.cell, surface.plane.shape[1]), axis=1)
    assert np.abs(at[:, :2] - cell).max() <= 0.5 + 1e-6
    np.testing.assert_allclose(at[:, 2], surface.off_m, atol=1e-9)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("grid", GRIDS.values(), ids=GRIDS)
def test_boxes_hold_their_pixels(grid, side):
    surface = surface_of(grid)
    position_m, held = grid.positions_m().reshape(-1, 3), 0
    root = (2 * side[0], 2 * side[1])
    for corner, pixels in members(surface, side):
        middle_m = surface.middles_m(side, corner)
        away = parts(surface, position_m[pixels] - middle_m)
        extents = surface.extents_in(side, root, corner[None] // root * root)[0]
        assert (np.abs(away) <= extents / 2 + 1e-6).all()
        assert np.linalg.norm(position_m[pixels] - middle_m, axis=1).max() <= (
            surface.radius_m(side) * (1 + 1e-9)
        )
        assert surface.holds(side, corner)
        held += len(pixels)
    assert held == grid.size == surface.counts(side).sum()


def test_relief_is_what_is_left_of_a_slope():
    grid = around(3, 40, shape=(64, 64))
    row, column = np.indices(grid.shape)
    surface = surface_of(grid.with_height(0.3 * row - 0.2 * column + 7))
    assert surface.relief_m((64, 64)).max() <= 1e-9
    height_m = surface.plane.positions_m()[..., 2]
    np.testing.assert_allclose(height_m, 0.3 * row - 0.2 * column + 7, atol=1e-9)


def test_the_most_relief_in_a_root():
    surface = surface_of(waves())
    small, of_roots = surface.relief_m((32, 16)), surface.relief_m((32, 16), (64, 32))
    assert of_roots[1, 0] == small[2:4, :2].max()
    assert of_roots[2, 2] == small[4, 4:6].max()  # there is nothing past the ends
    assert (surface.relief_m((64, 32)) >= of_roots).all()


def test_subimages_without_pixels_hold_none():
    surface = surface_of(cloud())
    counts = surface.counts(LEAST_SIDE)
    corners = np.argwhere(counts == 0) * LEAST_SIDE
    assert len(corners) > 0.1 * counts.size
    assert not surface.holds(LEAST_SIDE, corners).any()
    assert np.isfinite(surface.middles_m(LEAST_SIDE, corners)).all()
    beyond = np.array([[4096, 0], [0, 4096]])
    assert not surface.holds(LEAST_SIDE, beyond).any()


@pytest.mark.parametrize(
    "points_m",
    [
        np.zeros((7, 3)),
        [[1.0, 2, 3]],
        np.outer(np.linspace(0, 1, 50), [1, 2, 3]),
        np.outer(np.linspace(0, 1, 50), [0, 0, 1]) + 1e7,
    ],
    ids=["one place", "one point", "a row", "upright and far off"],
)
def test_points_that_span_no_plane(points_m):
    surface = surface_of(Grid.points(points_m))
    assert np.isfinite(surface.steps_m).all()
    assert surface.counts(LEAST_SIDE).sum() == len(points_m)
    assert max(surface.plane.shape) <= 2 * len(points_m)


def test_a_plane_is_its_own_cells():
    grid = around(3, 40, shape=(100, 70))
    surface = surface_of(grid)
    assert surface.is_plane
    assert surface.plane is grid
    assert surface.counts((32, 16)).sum() == grid.size
    assert surface.counts((32, 16))[-1, -1] == 4 * 6
    np.testing.assert_array_equal(surface.extents((32, 16), 5.0), [32, 16])
