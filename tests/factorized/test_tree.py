import numpy as np
import pytest
from cases import along_x
from factorizing import BEAMS, EXACT_IS_SLOW, around, over

from clsas.core.image_error import relative_error_db
from clsas.core.surface import surface_of
from clsas.factorized import tree
from clsas.factorized.tree import Tree, channel_ranges
from clsas.imaging import backproject, factorize, plan

# Subimages


SIDES = ((64, 48), (32, 16), (16, 4))


@pytest.mark.parametrize("shape", [(1, 1), (64, 48), (65, 49), (200, 100)])
def test_roots_hold_every_pixel_once(shape):
    subimages = Tree(surface_of(around(0, 40, shape=shape)), SIDES)
    count = np.zeros((384, 384), int)
    for row, column in subimages.roots:
        count[row : row + 64, column : column + 48] += 1
    assert (count[: shape[0], : shape[1]] == 1).all()
    assert all(row < shape[0] and column < shape[1] for row, column in subimages.roots)


@pytest.mark.parametrize("level", [1, 2])
def test_subimages_fill_their_parents(level):
    subimages = Tree(surface_of(around(0, 40, shape=(150, 100))), SIDES)
    parents = subimages.corners(level - 1, subimages.roots)
    children = subimages.corners(level, subimages.roots)
    inside = children - parents[:, subimages.parents(level)]
    assert (inside >= 0).all()
    assert (inside + SIDES[level] <= SIDES[level - 1]).all()
    for root in children:
        assert len({tuple(corner) for corner in root}) == subimages.per_root(level)


def test_a_centre_is_the_mean_of_pixels():
    grid = around(3, 40, shape=(150, 100))
    surface = surface_of(grid)
    subimages = Tree(surface, SIDES)
    corners = subimages.corners(1, subimages.roots[:1])
    positions_m = grid.positions_m()
    for (row, column), centre_m in zip(corners[0], subimages.centres_m(1, corners)[0], strict=True):
        pixels_m = positions_m[row : row + 32, column : column + 16].reshape(-1, 3)
        np.testing.assert_allclose(centre_m, pixels_m.mean(axis=0), atol=1e-12)
        assert np.linalg.norm(pixels_m - centre_m, axis=1).max() <= surface.radius_m(SIDES[1])


# Channels that subimages need


def with_all_channels(lines, grid, chosen):
    """Return an image whose subimages combine all channels and have all virtual channels."""
    formed, needed = [], []

    def widened(subimages, virtual, coordinate, visible, inside):
        everywhere = np.full_like(visible[0], -np.inf), np.full_like(visible[1], np.inf)
        every_leaf = np.ones_like(inside)
        found = channel_ranges(subimages, virtual, coordinate, everywhere, every_leaf)
        usual = channel_ranges(subimages, virtual, coordinate, visible, inside)
        for counts, ranges in ((formed, found), (needed, usual)):
            counts += [(each.last - each.first).sum() for each in ranges]
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tree, "channel_ranges", widened)
        image = factorize(lines, grid, chosen)
    assert sum(formed) > sum(needed) > 0
    return image


@pytest.mark.slow
@pytest.mark.parametrize("beam", BEAMS, ids=["hann", "wide", "squint"])
def test_leaves_have_all_the_virtual_channels_they_need(beam):
    """Channels outside a beam have no weight, so that the image is as good without them."""
    grid = around(0, 12, pixel_m=(0.015, 0.05), shape=(130, 150))
    lines, _ = over(grid, along_x(700, 0.012))
    chosen = plan(lines, grid, tolerance_db=-45, beam=beam, costs=EXACT_IS_SLOW)
    assert not chosen.is_exact
    whole = with_all_channels(lines, grid, chosen)
    exact = backproject(lines, grid, accuracy_db=-85, beam=beam)
    assert relative_error_db(whole, exact) <= -45
    image = factorize(lines, grid, chosen)
    assert not np.array_equal(image.pixels, whole.pixels)
    assert relative_error_db(image, exact) <= relative_error_db(whole, exact) + 0.5


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(33, 65), (70, 129)])
def test_subimages_beyond_the_grid_are_not_missed(shape):
    grid = around(0, 40, shape=shape)
    lines, _ = over(grid)
    chosen = plan(lines, grid, tolerance_db=-45, costs=EXACT_IS_SLOW)
    assert not chosen.is_exact
    whole = with_all_channels(lines, grid, chosen)
    assert relative_error_db(factorize(lines, grid, chosen), whole) <= -110
