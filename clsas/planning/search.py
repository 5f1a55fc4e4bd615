"""The fastest tree of subimages whose filters err by no more than allowed."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from clsas.core.decibels import in_db, power
from clsas.factorized.estimates import Work, backprojecting_leaves, combining, upsampling
from clsas.factorized.filters import (
    ALIGN_TAPS,
    APERTURE_TAPS,
    UPSAMPLING_SHARE,
    FilterRates,
    choose,
)
from clsas.factorized.plan import LEAST_BATCH
from clsas.opencl.device import Device
from clsas.planning.costs import Costs
from clsas.planning.errors import leaf_error, root_error
from clsas.planning.view import View
from clsas.signal.interpolation import PHASES, upsampler
from clsas.signal.spectrum import Spectrum

_ROWS = (16, 32, 64, 128, 256, 512, 1024, 2048)  # of subimages
_COLUMNS = (4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048)
MOST_STAGES = 5


@dataclass(frozen=True)
class Allowed:
    """Taps of filters and numbers of stages that a search may choose from."""

    align_taps: tuple[int, ...] = ALIGN_TAPS
    aperture_taps: tuple[int, ...] = APERTURE_TAPS
    stages: tuple[int, ...] = tuple(range(1, MOST_STAGES + 1))


@dataclass(frozen=True)
class Tree:
    """Sizes of subimages, and taps of the filters between them."""

    sides: tuple[tuple[int, int], ...]
    align_taps: int
    aperture_taps: int

    def filters(self, spectrum: Spectrum, filters_db: float) -> FilterRates | None:
        """Return filters whose errors together are no more than `filters_db`; None without any."""
        return choose(spectrum, self.align_taps, self.aperture_taps, len(self.sides), filters_db)


@dataclass(frozen=True, eq=False)
class _Sizes:
    """Subimages of every size, [sizes] each.

    Attributes
    ----------
    view : View
    sides : int [sizes, 2]
        Rows and columns.
    counts : int
        Number that hold a pixel.
    slots : float
        Mean number of pixels, padded to whole work-items.
    share : float
        Share of the channels that see any of one.
    reach_m : float
        Largest difference in range between a pixel and the centre.
    beam_turns : float
        Cycles of the beam's weights that virtual channels of a leaf must follow.
    leaf : bool
        True where leaves may have this size.
    """

    view: View
    sides: NDArray[np.int64]
    counts: NDArray[np.int64]
    slots: NDArray[np.float64]
    share: NDArray[np.float64]
    reach_m: NDArray[np.float64]
    beam_turns: NDArray[np.float64]
    leaf: NDArray[np.bool_]

    @functools.cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """`sides` as pairs of int."""
        return [(int(rows), int(columns)) for rows, columns in self.sides]

    @functools.cached_property
    def inside(self) -> NDArray[np.bool_]:
        """True where subimages of one size divide into those of another, [sizes, sizes]."""
        return (self.sides[:, None] % self.sides == 0).all(axis=-1)

    def cycles(
        self, root: tuple[int, int], within: NDArray[np.int64] | slice = slice(None)
    ) -> NDArray[np.float64]:
        """Return the cycles that phases turn by in a root.

        Entry [i, j]: while a subimage of size i is seen, the phases of one of size j.
        """
        sides = [tuple(side) for side in self.sides[within].tolist()]
        extents = [self.view.extents(side, root=root if any(root) else None) for side in sides]
        return self.view.cycles_in_root(root, sides) @ np.stack(extents).T

    def in_root(self, root: int) -> _Within:
        """Return the sizes that divide a root."""
        within = np.flatnonzero(self.inside[root])
        return _Within.of(self, within, self.cycles(self.pairs[root], within))


@dataclass(frozen=True, eq=False)
class _Within:
    """The sizes that divide a root.

    Attributes
    ----------
    sizes : int [n]
        Their indices.
    turns, of_leaf : float [n, n], [n]
        Cycles of a parent of size j that a child of size i uses; and those of leaves.
    step_s : float [n, n]
        0 where a parent of size j may divide into children of size i, else infinite.
    """

    sizes: NDArray[np.int64]
    turns: NDArray[np.float64]
    of_leaf: NDArray[np.float64]
    step_s: NDArray[np.float64]

    @classmethod
    def of(cls, sizes: _Sizes, within: NDArray[np.int64], turns: NDArray[np.float64]) -> _Within:
        smaller = sizes.inside[np.ix_(within, within)].T & (within[:, None] != within)
        of_leaf = np.diag(turns) + sizes.beam_turns[within]
        return cls(within, turns, of_leaf, np.where(smaller, 0.0, np.inf))


def _sizes(
    view: View, device: Device, filters_db: float, leaf_pixels: int, beam_cycles: float
) -> _Sizes:
    """Return all sizes of subimages that a grid may be divided into."""
    rows, columns = (
        [side for side in sides if side < 2 * max(n, min(sides))]
        for sides, n in zip((_ROWS, _COLUMNS), view.surface.plane.shape, strict=True)
    )
    pairs = list(product(rows, columns))
    sides = np.array(pairs)
    beam_turns = np.zeros(len(sides))
    if view.beam is not None:
        beam_turns[:] = [view.cycles(view.beam_rates, view.seen(side)) for side in pairs]
    curved = leaf_error(view, sides, device) > 0.25 * power(filters_db)
    return _Sizes(
        view,
        sides,
        counts=np.array([view.subimages(side) for side in pairs]),
        slots=np.array([view.slots(side, device.info.width) for side in pairs]),
        share=np.array([view.share_seen(side) for side in pairs]),
        reach_m=np.array([view.reach_m(side) for side in pairs]),
        beam_turns=beam_cycles * beam_turns,
        leaf=~curved & (np.prod(sides, axis=1) >= leaf_pixels),
    )


@dataclass(frozen=True, eq=False)
class _Option:
    """Filters for a number of stages, and the time that things take with them.

    Attributes
    ----------
    choice : FilterRates
    stages : int
    channel_s : float [sizes]
        Of every channel of all subimages of a size, in stages after the first.
    subimages_s : float [sizes]
        Of these subimages besides.
    leaves_s : float [sizes]
        Of every virtual channel of all leaves of a size; infinite where leaves may not have it.
    roots_s : float [sizes]
        Of the first stage with roots of a size, and of all that does not depend on the division.
    """

    choice: FilterRates
    stages: int
    channel_s: NDArray[np.float64]
    subimages_s: NDArray[np.float64]
    leaves_s: NDArray[np.float64]
    roots_s: NDArray[np.float64]

    def channels(self, view: View, turns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the virtual channels of subimages whose phases turn by so many cycles."""
        return view.channels(self.choice.aperture_taps, 2 * self.choice.oversampling, turns)


def _options(sizes: _Sizes, filters_db: float, costs: Costs, allowed: Allowed) -> list[_Option]:
    """Return all choices of filters, and the time that things take with each."""
    view, options = sizes.view, []
    counts, channels = sizes.counts, view.lines.channels
    batches = np.maximum(counts / LEAST_BATCH, 1.0)
    most_db = filters_db + in_db(UPSAMPLING_SHARE)
    filtered = upsampler(view.spectrum, PHASES // 2, np.ones_like, most_db) is not None
    tiled, weighted = view.surface.is_plane, view.beam is not None
    for stages, *taps in product(allowed.stages, allowed.align_taps, allowed.aperture_taps):
        choice = choose(view.spectrum, *taps, stages, filters_db)
        if choice is None:
            continue
        samples = 2 * sizes.reach_m * choice.upsampling / view.lines.range_step_m
        samples += choice.final_taps + 16
        leaves = backprojecting_leaves(
            counts, sizes.slots, choice.final_taps, tiled=tiled, weighted=weighted
        )
        of_roots = combining(counts * sizes.share * channels, samples, sum(taps), given=True)
        of_roots += Work(reference=counts * channels, subimage=counts, batch=batches * stages)
        of_roots += upsampling(view.lines.samples.size * choice.upsampling, filtered=filtered)
        options.append(
            _Option(
                choice,
                stages,
                channel_s=costs.seconds(combining(counts, samples, sum(taps), given=False)),
                subimages_s=costs.seconds(Work(subimage=counts)),
                leaves_s=np.where(sizes.leaf, costs.seconds(leaves), np.inf),
                roots_s=costs.seconds(of_roots),
            )
        )
    return options


def search(
    view: View,
    filters_db: float,
    most: tuple[int, int],
    leaf_pixels: int,
    beam_cycles: float,
    device: Device,
    costs: Costs,
    allowed: Allowed,
) -> Tree | None:
    """Return the fastest tree whose filters err by no more than `filters_db` together.

    None where there is none with roots of `most` rows and columns and leaves of `leaf_pixels` at
    least.

    For every root, number of stages and choice of filters, the fastest way to the leaves is a
    shortest path over the sizes that subimages may have. Those are tried first that could be
    fastest, until none of the others can be.
    """
    sizes = _sizes(view, device, filters_db, leaf_pixels, beam_cycles)
    options = _options(sizes, filters_db, costs, allowed)
    roots = np.flatnonzero((sizes.sides <= most).all(axis=1))
    if not options or not roots.size:
        return None
    # In a root phases turn no less than in the middle of it.
    anywhere = _Within.of(sizes, np.arange(len(sizes.sides)), sizes.cycles((0, 0)))
    roots_s = np.array([option.roots_s for option in options])
    least_s = np.array([_onward(view, option, anywhere)[0] for option in options])
    least_s = (roots_s + least_s)[:, roots]
    in_root = functools.cache(sizes.in_root)
    best_s, best = math.inf, None
    for place in np.argsort(least_s, axis=None, kind="stable"):
        if least_s.flat[place] >= best_s:
            break
        index, root = place // len(roots), int(roots[place % len(roots)])
        within = in_root(root)
        onward_s, children = _onward(view, options[index], within)
        size = int(np.searchsorted(within.sizes, root))
        cost_s = roots_s[index, root] + onward_s[size]
        if cost_s < best_s:
            path = [size]
            for each in children:
                path.append(int(each[path[-1]]))
            choice = options[index].choice
            sides = tuple(sizes.pairs[within.sizes[size]] for size in path)
            best_s, best = cost_s, Tree(sides, choice.align_taps, choice.aperture_taps)
    return best


def _onward(
    view: View, option: _Option, within: _Within
) -> tuple[NDArray[np.float64], list[NDArray[np.int64]]]:
    """Return the seconds from subimages of each size to pixels, in the stages left.

    Beside it, stage by stage, the best size of children (an index into `within.sizes`).
    """
    # To a child of size i from a parent of size j: the channels of the parent that it uses.
    step_s = option.channels(view, within.turns)
    step_s *= option.channel_s[within.sizes, None]
    step_s += option.subimages_s[within.sizes, None]
    step_s += within.step_s
    onward_s = option.channels(view, within.of_leaf) * option.leaves_s[within.sizes]
    children = []
    for _ in range(option.stages - 1):
        through_s = step_s + onward_s[:, None]
        children.append(best := through_s.argmin(axis=0))
        onward_s = through_s[best, np.arange(len(best))]
    return onward_s, children[::-1]


def root_limits(view: View, allowed: float) -> tuple[int, int] | None:
    """Return the largest rows and columns of roots that keep their errors within a power.

    None where there are none.
    """
    rows, columns = (
        min((side for side in sides if side >= n), default=sides[-1])
        for sides, n in zip((_ROWS, _COLUMNS), view.surface.plane.shape, strict=True)
    )
    while root_error(view, (rows, columns)) > allowed:
        smaller = [(rows // 2, columns), (rows, columns // 2)]
        smaller = [side for side in smaller if side[0] >= _ROWS[0] and side[1] >= _COLUMNS[0]]
        if not smaller:
            return None
        rows, columns = min(smaller, key=functools.partial(root_error, view))
    return rows, columns
