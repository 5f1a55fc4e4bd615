import math
from itertools import pairwise, product

import numpy as np
import pytest
from exactly import sampled
from factorizing import BEAMS, around, over

from clsas.engine.data.grid import Grid
from clsas.engine.device.device import open_device
from clsas.engine.factorized import search
from clsas.engine.factorized.costs import Costs
from clsas.engine.factorized.search import Choices, all_sizes, ladder


def priced(sizes, filters_db, leaf_pixels, beam_cycles, costs, allowed):
    """All sizes, and the options with the times of their operations."""
    return sizes, search.all_options(sizes, filters_db, leaf_pixels, beam_cycles, costs, allowed)


def everything_tried(*arguments):
    """The least cost of all roots and options."""
    sizes, options = priced(*arguments)
    best = math.inf
    for option in range(len(options.choices)):
        for root in range(len(sizes.pairs)):
            division = sizes.in_root(root)
            onward_s = options.times(division, np.array([option])).onward_s()[-1]
            size = np.searchsorted(division.index, root)
            best = min(best, options.roots_s[option, root] + onward_s[0, size])
    return best


@pytest.fixture(scope="module", params=[None, BEAMS[0]], ids=["wide", "beam"])
def sizes(request):
    grid = around(0, 40, shape=(500, 700))
    roots = sampled(over(grid)[0], grid, request.param)
    return all_sizes(roots, ladder(roots), open_device())


def cost_of(tree, sizes, filters_db, leaf_pixels, beam_cycles, costs, allowed):
    """The time of a tree, summed stage by stage."""
    taps = (tree.align_taps,), (tree.aperture_taps,)
    allowed = Choices(*taps, stages=(len(tree.sides),))
    sizes, options = priced(sizes, filters_db, leaf_pixels, beam_cycles, costs, allowed)
    (choice,) = options.choices
    path = [sizes.pairs.index(side) for side in tree.sides]
    division = sizes.in_root(path[0])
    cycles, number = division.cycles, {int(size): n for n, size in enumerate(division.index)}

    taps_past_ends = choice.aperture_taps * (search.OVERHANG if len(path) > 1 else 1)

    def channels(phase_cycles):
        return sizes.roots.virtual_channels(taps_past_ends, 2 * choice.oversampling, phase_cycles)

    total = options.roots_s[0, path[0]]
    for parent, child in pairwise(path):
        used = channels(cycles[number[child], number[parent]])
        total += used * options.channel_s[0, child] + options.subimages_s[child]
    leaf = path[-1]
    of_leaf = cycles[number[leaf], number[leaf]] + beam_cycles * sizes.beam_cycles[leaf]
    return total + channels(of_leaf) * options.leaves_s[0, leaf]


@pytest.mark.slow
@pytest.mark.parametrize("filters_db", [-20.0, -55.0])
@pytest.mark.parametrize("costs", [Costs(), Costs(leaf_ns=50.0), Costs(reference_ns=1e5)])
def test_nothing_is_faster_than_what_is_found(sizes, filters_db, costs):
    arguments = (sizes, filters_db, 1, 0.5, costs, Choices())
    tree = search.search(*arguments)
    assert cost_of(tree, *arguments) == pytest.approx(everything_tried(*arguments), rel=1e-9)


def test_leaves_are_as_large_as_asked(sizes):
    for pixels in (1, 512, 4096):
        tree = search.search(sizes, -40.0, pixels, 0.5, Costs(), Choices())
        assert math.prod(tree.sides[-1]) >= pixels


def test_without_any_size_that_fits_there_is_none(sizes):
    assert search.search(sizes, -40.0, 10**9, 0.5, Costs(), Choices()) is None


def test_a_ladder_of_sizes_is_as_long_in_range_as_it_is_along_the_track(sizes):
    """Each size is divided by those before it; a grid with exchanged axes has exchanged sides."""
    found = sizes.pairs
    for smaller, larger in pairwise(found):
        assert sorted((larger[0] // smaller[0], larger[1] // smaller[1])) == [1, 2]
    assert found[0] == (16, 4)
    assert found[-1] == (512, 1024)
    grid = sizes.roots.sampled.scene.grid
    mirrored = Grid.oriented(grid.vectors_m[0], *grid.vectors_m[:0:-1], grid.shape[::-1])
    roots = sampled(sizes.roots.sampled.scene.given_lines, mirrored, sizes.roots.sampled.scene.beam)
    exchanged = {(columns, rows) for rows, columns in ladder(roots)}
    large = {side for side in found if min(side) >= 32}
    assert len(large & exchanged) >= len(large) - 1


@pytest.mark.parametrize("is_sheet", [False, True])
def test_the_recurrence_finds_the_least_of_all_divisions(is_sheet):
    """Of 4 sizes in 1 to 3 stages; each size divides into those before it."""
    rng, sizes, stages = np.random.default_rng(0), 4, np.array([3, 2, 1])
    step_s = rng.random((3, sizes, sizes)) + np.where(np.tri(sizes, dtype=bool), np.inf, 0.0)
    forming_s = rng.random((3, sizes)) if is_sheet else np.zeros((3, 1))
    leaves_s = rng.random((3, sizes)) + forming_s
    found = search.Times(stages, step_s, forming_s, leaves_s).onward_s()[-1]
    formed_s = np.broadcast_to(forming_s, leaves_s.shape)
    for option, root in product(range(3), range(sizes)):
        least = math.inf
        for path in product(range(sizes), repeat=int(stages[option]) - 1):
            path = (root, *path)
            total = leaves_s[option, path[-1]] + formed_s[option, list(path[:-1])].sum()
            total += sum(step_s[option, child, parent] for parent, child in pairwise(path))
            least = min(least, total)
        assert found[option, root] == pytest.approx(least)
