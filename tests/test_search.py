import math

import numpy as np
import pytest
from test_factorize import BEAMS, around, over

from clsas import search
from clsas.costs import Costs
from clsas.device import open_device
from clsas.search import Allowed
from clsas.view import View


def everything_tried(view, filters_db, most, leaf_pixels, beam_cycles, device, costs, allowed):
    """The least cost of all roots and options."""
    sizes = search._sizes(view, device, filters_db, leaf_pixels, beam_cycles)
    best = math.inf
    for option in search._options(sizes, filters_db, costs, allowed):
        for root in np.flatnonzero((sizes.sides <= most).all(axis=1)):
            within, turns = sizes.in_root(root)
            onward_ns, _ = search._onward(sizes, option, within, turns)
            cost_ns = option.roots_ns(sizes, costs)[root] + onward_ns[np.searchsorted(within, root)]
            best = min(best, cost_ns)
    return best


@pytest.fixture(scope="module", params=[None, BEAMS[0]], ids=["wide", "beam"])
def view(request):
    grid = around(0, 40, shape=(500, 700))
    return View(over(grid)[0], grid, request.param)


@pytest.mark.parametrize("filters_db", [-20.0, -55.0])
@pytest.mark.parametrize("costs", [Costs(), Costs(leaf_ns=50.0), Costs(reference_ns=1e5)])
def test_nothing_is_faster_than_what_is_found(view, filters_db, costs, monkeypatch):
    arguments = (view, filters_db, (512, 512), 1, 0.5, open_device(), costs, Allowed())
    found_ns = []
    onward = search._onward

    def noted(sizes, option, within, turns):
        result = onward(sizes, option, within, turns)
        if len(within) < len(sizes.sides):
            root = within[-1]
            found_ns.append(option.roots_ns(sizes, costs)[root] + result[0][-1])
        return result

    least_ns = everything_tried(*arguments)
    monkeypatch.setattr(search, "_onward", noted)
    tree = search.search(*arguments)
    assert tree is not None
    assert min(found_ns) == pytest.approx(least_ns, rel=1e-9)


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
