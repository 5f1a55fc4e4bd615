import math
from itertools import pairwise

import numpy as np
import pytest
from factorizing import BEAMS, around, over

from clsas.opencl.device import open_device
from clsas.planning import search
from clsas.planning.costs import Costs
from clsas.planning.search import Allowed
from clsas.planning.visibility_model import VisibilityModel


def everything_tried(view, filters_db, most, leaf_pixels, beam_cycles, device, costs, allowed):
    """The least cost of all roots and options."""
    sizes = search._sizes(view, device, filters_db, leaf_pixels, beam_cycles)
    best = math.inf
    for option in search._options(sizes, filters_db, costs, allowed):
        for root in np.flatnonzero((sizes.sides <= most).all(axis=1)):
            within = sizes.in_root(root)
            onward_s, _ = search._onward(view, option, within)
            place = np.searchsorted(within.sizes, root)
            best = min(best, option.roots_s[root] + onward_s[place])
    return best


@pytest.fixture(scope="module", params=[None, BEAMS[0]], ids=["wide", "beam"])
def view(request):
    grid = around(0, 40, shape=(500, 700))
    return VisibilityModel(over(grid)[0], grid, request.param)


def cost_of(tree, view, filters_db, most, leaf_pixels, beam_cycles, device, costs, allowed):
    """What a tree costs, stage by stage."""
    sizes = search._sizes(view, device, filters_db, leaf_pixels, beam_cycles)
    taps = (tree.align_taps,), (tree.aperture_taps,)
    allowed = Allowed(*taps, stages=(len(tree.sides),))
    (option,) = search._options(sizes, filters_db, costs, allowed)
    path = [sizes.pairs.index(side) for side in tree.sides]
    within = sizes.in_root(path[0])
    turns, place = within.turns, {int(size): index for index, size in enumerate(within.sizes)}
    total = option.roots_s[path[0]]
    for parent, child in pairwise(path):
        used = option.channels(view, turns[place[child], place[parent]])
        total += used * option.channel_s[child] + option.subimages_s[child]
    leaf = path[-1]
    turned = turns[place[leaf], place[leaf]] + sizes.beam_turns[leaf]
    return total + option.channels(view, turned) * option.leaves_s[leaf]


@pytest.mark.slow
@pytest.mark.parametrize("filters_db", [-20.0, -55.0])
@pytest.mark.parametrize("costs", [Costs(), Costs(leaf_ns=50.0), Costs(reference_ns=1e5)])
def test_nothing_is_faster_than_what_is_found(view, filters_db, costs):
    arguments = (view, filters_db, (512, 512), 1, 0.5, open_device(), costs, Allowed())
    tree = search.search(*arguments)
    assert cost_of(tree, *arguments) == pytest.approx(everything_tried(*arguments), rel=1e-9)


def test_leaves_are_as_large_as_asked(view):
    for pixels in (1, 512, 4096):
        tree = search.search(
            view, -40.0, (512, 512), pixels, 0.5, open_device(), Costs(), Allowed()
        )
        assert math.prod(tree.sides[-1]) >= pixels


def test_without_any_size_that_fits_there_is_none(view):
    arguments = (0.5, open_device(), Costs(), Allowed())
    assert search.search(view, -40.0, (8, 2), 1, *arguments) is None
    assert search.search(view, -40.0, (512, 512), 10**9, *arguments) is None
