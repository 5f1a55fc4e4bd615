"""Search for the fastest tree of subimages whose filters are accurate enough.

For every size of roots, number of stages and choice of filters, the fastest division down to the
leaves is a shortest path over the sizes of subimages (dynamic programming). Roots are tried in the
order of a lower bound of their time, until none of the others can be faster.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from clsas.aperture.filters import (
    ALIGN_TAPS,
    APERTURE_TAPS,
    LONGEST_UPSAMPLING_SHARE,
    FilterRates,
    choose,
)
from clsas.core.decibels import in_db, power
from clsas.factorized.buffers import LEAST_BATCH
from clsas.opencl.buffers import GUARD
from clsas.opencl.device import Device
from clsas.planning.aperture_phases import AperturePhases
from clsas.planning.channels import references
from clsas.planning.costs import Costs
from clsas.planning.sizes import Division, Sizes, all_sizes
from clsas.planning.stretches import aligned_spectrum
from clsas.planning.subimages import Side
from clsas.planning.visibility_model import VisibilityModel
from clsas.planning.work import adding_in_rows, backprojecting_leaves, combining, upsampling
from clsas.plans.predictions import Work
from clsas.signal.interpolation import PHASES, upsampler
from clsas.signal.spectrum import Spectrum

OVERHANG = 1.5
"""Factor of the taps that extend past an aperture's ends in trees of several stages. The taps of
the previous stage count half, because subimages are half as long."""
MOST_STAGES = 5
"""Largest number of stages of a tree. More stages add errors without saving work."""
# Share of the filters' error power that the expansion of ranges in leaves may add. With half of it,
# some grids close to the track have no leaf and are imaged exactly; twice: up to 6 % faster.
_LEAF_SHARE = 0.25
_SPARE_SAMPLES = 16  # of a line, for filters and padding; twice changes times by 3 % at most


@dataclass(frozen=True)
class Allowed:
    """Taps of filters and numbers of stages that a search may choose from."""

    align_taps: tuple[int, ...] = ALIGN_TAPS
    aperture_taps: tuple[int, ...] = APERTURE_TAPS
    stages: tuple[int, ...] = tuple(range(1, MOST_STAGES + 1))


@dataclass(frozen=True)
class Tree:
    """Sizes of subimages from the roots to the leaves, and taps of the filters between them."""

    sides: tuple[Side, ...]
    align_taps: int
    aperture_taps: int
    dimensions: int = 1

    def filters(self, spectrum: Spectrum, filters_db: float) -> FilterRates | None:
        """Return filters whose errors add up to at most `filters_db`; None if there are none."""
        stages = len(self.sides)
        return choose(
            spectrum, self.align_taps, self.aperture_taps, stages, filters_db, self.dimensions
        )


@dataclass(frozen=True, eq=False)
class Options:
    """Choices of filters and numbers of stages, and the times of operations with each.

    Attributes
    ----------
    choices : list of FilterRates, [options]
    stages : int64 [options]
        Numbers of stages, never increasing.
    density, ends : float64 [options, 1, 1]
        Virtual channels per cycle of phase, and their number without any phase: see
        `AperturePhases.virtual_channels`.
    channel_s : float64 [options, sizes]
        Time per channel of all subimages of a size, in stages after the first.
    subimages_s : float64 [sizes]
        Time of these subimages that does not depend on channels.
    leaves_s : float64 [options, sizes]
        Time per virtual channel of all leaves of a size; infinite if leaves cannot have this size.
    roots_s : float64 [options, sizes]
        Time of the first stage with roots of a size, and of all work that does not depend on the
        division.
    leaf_beam_cycles : float64 [sizes]
        Phase cycles that the beam's weights add to those of a leaf.
    rows : float64 [options, 1]
        Rows of virtual channels of a sheet without any phase across it.
    leaf_beam_rows : float
        Phase cycles across a sheet that the beam's weights add to those of a leaf.
    row_lines_s : float64 [options, sizes]
        Time per virtual channel of a sheet, for all subimages of a size: see `adding_in_rows`.
    """

    choices: list[FilterRates]
    stages: NDArray[np.int64]
    density: NDArray[np.float64]
    ends: NDArray[np.float64]
    channel_s: NDArray[np.float64]
    subimages_s: NDArray[np.float64]
    leaves_s: NDArray[np.float64]
    roots_s: NDArray[np.float64]
    leaf_beam_cycles: NDArray[np.float64]
    rows: NDArray[np.float64]
    leaf_beam_rows: float
    row_lines_s: NDArray[np.float64]

    def times(self, division: Division, some: NDArray[np.int64]) -> Times:
        """Return the times of trees of some of the options, [m], in a root."""
        if division.across is None:
            return self._times_on_curve(division, some)
        return self._times_on_sheet(division, division.across, some)

    def _times_on_curve(self, division: Division, some: NDArray[np.int64]) -> Times:
        """Return the times where virtual channels lie on a curve, or on strips."""
        density, ends = self.density[some], self.ends[some]
        # A child uses the channels of its parent whose beam touches it.
        used = density * division.cycles
        used += ends
        columns = density[..., 0] * self._leaf_cycles(division) + ends[..., 0]
        return Times(
            stages=self.stages[some],
            step_s=self._step_s(division, some, used),
            forming_s=np.zeros((len(some), 1)),
            leaves_s=columns * self.leaves_s[some][:, division.index],
        )

    def _times_on_sheet(
        self, division: Division, across: NDArray[np.float64], some: NDArray[np.int64]
    ) -> Times:
        """Return the times where virtual channels lie in columns and rows of a sheet."""
        density, ends = self.density[some], self.ends[some]
        rows = density[..., 0] * across + self.rows[some]
        used = density * division.cycles
        used += ends
        used *= rows[:, None]
        leaf_columns = density[..., 0] * self._leaf_cycles(division) + ends[..., 0]
        leaf_rows = rows + density[..., 0] * self.leaf_beam_rows
        columns = density[..., 0] * np.diag(division.cycles) + ends[..., 0]
        forming_s = columns * rows * self.row_lines_s[some][:, division.index]
        leaves_s = leaf_columns * leaf_rows * self.leaves_s[some][:, division.index]
        return Times(
            stages=self.stages[some],
            step_s=self._step_s(division, some, used),
            forming_s=forming_s,
            leaves_s=leaves_s + forming_s,
        )

    def _leaf_cycles(self, division: Division) -> NDArray[np.float64]:
        """Return the phase of leaves along the aperture, with that of the beam's weights."""
        return np.diag(division.cycles) + self.leaf_beam_cycles[division.index]

    def _step_s(
        self, division: Division, some: NDArray[np.int64], used: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return `Times.step_s`, in place of the channels that children use, [m, n, n]."""
        used *= self.channel_s[some][:, division.index, None]
        used += self.subimages_s[division.index, None]
        used += division.divisible_s
        return used

    def path(self, division: Division, option: int, root: int) -> list[int]:
        """Return the sizes of the fastest tree from a root, as indices into `Sizes`."""
        times = self.times(division, np.array([option]))
        path = [int(np.searchsorted(division.index, root))]
        for onward_s in times.onward_s()[-2::-1]:
            path.append(int((times.step_s[0, :, path[-1]] + onward_s[0]).argmin()))
        return [int(division.index[each]) for each in path]


@dataclass(frozen=True, eq=False)
class Times:
    """Times of trees within a root of some options, [m], and subimages of some sizes, [n].

    Attributes
    ----------
    stages : int64 [m]
        Never increasing.
    step_s : float64 [m, n, n]
        Combining the channels of all parents of size j for their children of size i; infinite
        where these do not divide those.
    forming_s : float64 [m, n] or [m, 1]
        Adding to the virtual channels of all subimages of a size row by row; 0 on a curve.
    leaves_s : float64 [m, n]
        `forming_s` and the backprojection of all leaves of a size; infinite where subimages of this
        size cannot be leaves.
    """

    stages: NDArray[np.int64]
    step_s: NDArray[np.float64]
    forming_s: NDArray[np.float64]
    leaves_s: NDArray[np.float64]

    def onward_s(self) -> list[NDArray[np.float64]]:
        """Return the least time from subimages of every size to their pixels, float64 [m, n] each.

        The first array is for one stage left, in which the subimages are leaves; the last is for
        the roots, with all the stages of each option.

        Notes
        -----
        With n stages left, subimages of size j take at least ::

            T_1(j) = forming_s(j) + backprojection(j) = leaves_s(j)
            T_n(j) = forming_s(j) + min over i of [step_s(i, j) + T_(n-1)(i)],  n = 2, 3, ...

        where i are the sizes into which they may divide (dynamic programming: Bellman, 1957). An
        option of fewer than n stages keeps its last value.

        References
        ----------
        R. Bellman, "Dynamic Programming", Princeton University Press, 1957.
        """
        onward_s = self.leaves_s
        by_stages = [onward_s]
        for left in range(2, int(self.stages.max()) + 1):
            more = int(np.count_nonzero(self.stages >= left))
            onward_s = onward_s.copy()
            onward_s[:more] = (self.step_s[:more] + onward_s[:more, :, None]).min(axis=1)
            onward_s[:more] += self.forming_s[:more]
            by_stages.append(onward_s)
        return by_stages


def all_options(
    sizes: Sizes,
    filters_db: float,
    leaf_pixels: int,
    beam_cycles: float,
    costs: Costs,
    allowed: Allowed,
) -> Options | None:
    """Return all options whose filters are as accurate as `filters_db`; None if there are none."""
    model, counts, channels = sizes.model, sizes.counts, sizes.model.lines.channels
    choices, stages, dimensions = [], [], 1 + model.track.is_sheet
    aligned = aligned_spectrum(model)
    most_first = sorted(allowed.stages, reverse=True)
    for number, align, aperture in product(most_first, allowed.align_taps, allowed.aperture_taps):
        choice = choose(aligned, align, aperture, number, filters_db, dimensions)
        if choice is not None:
            choices.append(choice)
            stages.append(number)
    if not choices:
        return None
    numbers = [(c.upsampling, c.final_taps, c.stage_taps) for c in choices]
    rate, final_taps, taps = np.array(numbers).T[..., None]
    samples = 2 * sizes.half_range_extent_m * rate / model.lines.range_step_m
    samples += final_taps + _SPARE_SAMPLES
    roots = combining(counts * sizes.visible_share * channels, samples, taps, given=True)
    batches = np.maximum(counts / LEAST_BATCH, 1.0) * np.array(stages)[:, None]
    roots += Work(reference=counts * references(model), subimage=counts, batch=batches)
    most_db = filters_db + in_db(LONGEST_UPSAMPLING_SHARE)
    filtered = upsampler(model.spectrum, PHASES // 2, np.ones_like, most_db) is not None
    roots += upsampling(model.lines.samples.size * rate, filtered=filtered)
    tiled, weighted = model.surface.is_plane, model.beam is not None
    pixels = sizes.padded_pixels
    leaves_s = {
        n: costs.seconds(backprojecting_leaves(counts, pixels, n, tiled=tiled, weighted=weighted))
        for n in {choice.final_taps for choice in choices}
    }
    leaf = sizes.leaf_error <= _LEAF_SHARE * power(filters_db)
    leaf &= np.prod(sizes.sides, axis=1) >= leaf_pixels
    density = np.array([2 * choice.oversampling for choice in choices])
    # In trees of several stages, filters extend past the ends as if they had more taps.
    further = np.where(np.array(stages) > 1, OVERHANG, 1.0)
    aperture_taps = further * [choice.aperture_taps for choice in choices]
    return Options(
        choices,
        np.array(stages),
        density[:, None, None],
        np.array(AperturePhases(model).virtual_channels(aperture_taps, 0.0, 0.0))[:, None, None],
        channel_s=np.asarray(costs.seconds(combining(counts, samples, taps, given=False))),
        subimages_s=np.asarray(costs.seconds(Work(subimage=counts))),
        leaves_s=np.where(leaf, np.array([leaves_s[c.final_taps] for c in choices]), np.inf),
        roots_s=np.asarray(costs.seconds(roots)),
        leaf_beam_cycles=beam_cycles * sizes.beam_cycles,
        rows=aperture_taps[:, None],
        leaf_beam_rows=beam_cycles * sizes.beam_cycles_across,
        row_lines_s=np.asarray(
            costs.seconds(adding_in_rows(counts, samples + 2 * GUARD, aperture_taps[:, None]))
        ),
    )


def search(
    model: VisibilityModel,
    filters_db: float,
    most: Side,
    leaf_pixels: int,
    beam_cycles: float,
    device: Device,
    costs: Costs,
    allowed: Allowed,
) -> Tree | None:
    """Return the fastest tree whose filters are, together, as accurate as `filters_db`.

    Return None if there is no such tree whose roots have at most `most` rows and columns, and whose
    leaves have at least `leaf_pixels` pixels.
    """
    sizes = all_sizes(model, most, device)
    options = all_options(sizes, filters_db, leaf_pixels, beam_cycles, costs, allowed)
    if options is None or not sizes.pairs:
        return None
    # The phase rate is lowest at a root's centre, so that these are lower bounds.
    every = np.arange(len(options.choices))
    bound_s = options.roots_s + options.times(sizes.anywhere, every).onward_s()[-1]
    least_s = bound_s.min(axis=0)
    best_s, best = math.inf, (0, 0)
    for root in map(int, np.argsort(least_s, kind="stable")):
        if least_s[root] >= best_s:
            break
        division = sizes.in_root(root)
        some = np.flatnonzero(bound_s[:, root] < best_s)
        size = int(np.searchsorted(division.index, root))
        onward_s = options.times(division, some).onward_s()[-1][:, size]
        cost_s = options.roots_s[some, root] + onward_s
        fastest = int(cost_s.argmin())
        if cost_s[fastest] < best_s:
            best_s, best = float(cost_s[fastest]), (int(some[fastest]), root)
    if best_s == math.inf:
        return None
    option, root = best
    path = options.path(sizes.in_root(root), option, root)
    choice = options.choices[option]
    sides = tuple(sizes.pairs[i] for i in path)
    return Tree(sides, choice.align_taps, choice.aperture_taps, choice.dimensions)
