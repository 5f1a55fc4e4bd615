"""The fastest tree of subimages whose filters err by no more than allowed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np

from clsas.costs import Costs
from clsas.device import Device
from clsas.errors import leaf_error, power, root_error
from clsas.filters import ALIGN_TAPS, APERTURE_TAPS, Choice, choose
from clsas.interpolation import Spectrum
from clsas.view import View

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

    def filters(self, spectrum: Spectrum, filters_db: float) -> Choice | None:
        """Return filters whose errors together are no more than `filters_db`; None without any."""
        return choose(spectrum, self.align_taps, self.aperture_taps, len(self.sides), filters_db)


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

    For every number of stages and choice of filters, the fastest way from the whole grid to the
    leaves is a shortest path over the sizes that subimages may have.
    """
    lines, grid = view.lines, view.grid
    rows, columns = (
        [side for side in sides if side < 2 * max(n, min(sides))]
        for sides, n in zip((_ROWS, _COLUMNS), grid.shape, strict=True)
    )
    pairs = list(product(rows, columns))
    sides = np.array(pairs)
    counts = np.prod(-(-np.array(grid.shape) // sides), axis=1)
    pixels = np.prod(sides, axis=1)
    share = np.array([view.share_seen(side) for side in pairs])
    divides = (sides[:, None] % sides == 0).all(axis=-1) & (sides[:, None] != sides).any(axis=-1)
    too_curved = leaf_error(view, sides, device) > 0.25 * power(filters_db)
    reach_m = np.array([view.reach_m(side) for side in pairs])
    for_beam = np.zeros(len(sides))  # cycles of its edges, while a subimage is seen
    if view.beam is not None:
        for_beam[:] = [view.cycles(view.beam_rates, view.seen(side)) for side in pairs]

    def last_ns(index: np.ndarray, choice: Choice, turns: np.ndarray) -> np.ndarray:
        """Return the cost of backprojecting leaves, of sizes and phases' turns [n]."""
        aperture = choice.aperture_taps, 2 * choice.density
        channels = view.channels(*aperture, turns + beam_cycles * for_beam[index])
        beam = view.beam is not None
        cost_ns = costs.leaf_line_ns(pixels[index], choice.final_taps, beam=beam)
        barred = too_curved[index] | (pixels[index] < leaf_pixels)
        return np.where(barred, np.inf, counts[index] * cost_ns * channels)

    # In a root phases turn no less than in the middle of it.
    least_turns = np.sum(view.cycles_in_root((0, 0), pairs) * sides, axis=1)
    everything = np.arange(len(sides))
    choices: list[tuple[int, Choice, np.ndarray, float, np.ndarray]] = []
    for stages, *taps in product(allowed.stages, allowed.align_taps, allowed.aperture_taps):
        choice = choose(view.spectrum, *taps, stages, filters_db)
        if choice is None:
            continue
        samples = 2 * reach_m * choice.rate / lines.range_step_m + choice.final_taps + 16
        per_channel = counts * costs.line_ns(samples, sum(taps))
        once = costs.upsampled_sample_ns * lines.samples.size * choice.rate
        once += stages * costs.batch_ns
        least = last_ns(everything, choice, least_turns)
        choices.append((stages, choice, per_channel, once, least))
    best = math.inf, None, []
    roots = np.flatnonzero((sides <= most).all(axis=1))
    for root in roots[np.argsort(-pixels[roots], kind="stable")]:  # those that cost less first
        within = np.flatnonzero((sides[root] % sides == 0).all(axis=1))
        cycles = None
        for stages, choice, per_channel, once, least in choices:
            first = share[root] * per_channel[root] + counts[root] * costs.reference_ns
            first = lines.channels * first + once
            if first + least[within].min() >= best[0]:
                continue
            if cycles is None:
                # While a subimage of size i is seen, of phases that turn as for size j.
                cycles = view.cycles_in_root(pairs[root], [pairs[i] for i in within])
                cycles = cycles @ sides[within].T
            # Channels of a parent of size j that a child of size i uses.
            used = view.channels(choice.aperture_taps, 2 * choice.density, cycles)
            step = np.where(divides[np.ix_(within, within)].T, used, np.inf)
            step *= per_channel[within, None]
            last = last_ns(within, choice, np.diag(cycles))
            total = np.where(within == root, first, np.inf)
            path = []
            for _ in range(stages - 1):
                through = total + step
                path.append(through.argmin(axis=1))
                total = through.min(axis=1)
            leaf = int((total + last).argmin())
            if (total + last)[leaf] < best[0]:
                chain = [leaf]
                for parents in reversed(path):
                    chain.append(int(parents[chain[-1]]))
                best = (total + last)[leaf], choice, within[chain[::-1]]
    _, choice, chain = best
    if choice is None:
        return None
    return Tree(tuple(pairs[i] for i in chain), choice.align_taps, choice.aperture_taps)


def root_limits(view: View, allowed: float) -> tuple[int, int] | None:
    """Return the largest rows and columns of roots that keep their errors within a power.

    None where there are none.
    """
    rows, columns = (
        min((side for side in sides if side >= n), default=sides[-1])
        for sides, n in zip((_ROWS, _COLUMNS), view.grid.shape, strict=True)
    )
    while root_error(view, (rows, columns)) > allowed:
        smaller = [(rows // 2, columns), (rows, columns // 2)]
        smaller = [side for side in smaller if side[0] >= _ROWS[0] and side[1] >= _COLUMNS[0]]
        if not smaller:
            return None
        rows, columns = min(smaller, key=partial(root_error, view))
    return rows, columns
