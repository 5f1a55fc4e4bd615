"""Search for the fastest tree of subimages whose filters are accurate enough.

For every size of roots, number of stages and choice of filters, the fastest division down to the
leaves is a shortest path over the sizes of subimages (dynamic programming). Roots are tried in the
order of a lower bound of their time, until none of the others can be faster.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.decibels import in_db, power
from clsas.engine.data.geometry import unit_vectors
from clsas.engine.data.surface import LEAST_SIDE
from clsas.engine.device.buffers import GUARD
from clsas.engine.device.device import Device
from clsas.engine.factorized.buffers import LEAST_BATCH
from clsas.engine.factorized.costs import (
    Costs,
    adding_in_rows,
    backprojecting_leaves,
    combining,
    references,
    upsampling,
)
from clsas.engine.factorized.errors import leaf_error
from clsas.engine.factorized.filters import (
    ALIGN_TAPS,
    APERTURE_TAPS,
    LONGEST_UPSAMPLING_SHARE,
    FilterRates,
    choose,
)
from clsas.engine.factorized.plan import Work
from clsas.engine.factorized.sampled import (
    INNER_POINTS,
    SampledRoots,
    Side,
    mean_over_points,
    trapezoidal_weights,
)
from clsas.engine.signal.interpolation import PHASES, upsampler
from clsas.engine.signal.spectrum import Spectrum

OVERHANG = 1.5
"""Factor of the taps that extend past an aperture's ends in trees of several stages. The taps of
the previous stage count half, because subimages are half as long."""
MOST_STAGES = 5
"""Largest number of stages of a tree. More stages add errors without saving work."""

_MOST_SIDE = 2048  # rows or columns of a root
_MOST_OVERHANG = 1.1  # rows or columns of roots over those of the image that they fit
# What trees usually have: virtual channels per cycle and past the ends, upsampling, and samples
# that take as long to combine as all else that is done for a line. Half: trees take 2 % longer.
_USUAL_DENSITY, _USUAL_ENDS, _USUAL_UPSAMPLING, _USUAL_SPARE = 3.0, 5.0, 1.6, 96.0
_EVERY = 8  # of the samples of the track that is searched with; a fourth chose the same trees
# Share of the filters' error power that the expansion of ranges in leaves may add. With half of it,
# some grids close to the track have no leaf and are imaged exactly; twice: up to 6 % faster.
_LEAF_SHARE = 0.25
_SPARE_SAMPLES = 16  # of a line, for filters and padding; twice changes times by 3 % at most


@dataclass(frozen=True)
class Choices:
    """Taps of filters and numbers of stages that a search may choose from."""

    align_taps: tuple[int, ...] = ALIGN_TAPS
    aperture_taps: tuple[int, ...] = APERTURE_TAPS
    stages: tuple[int, ...] = tuple(range(1, MOST_STAGES + 1))


@dataclass(frozen=True)
class Division:
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


def search(
    sizes: Sizes,
    filters_db: float,
    leaf_pixels: int,
    beam_cycles: float,
    costs: Costs,
    choices: Choices,
) -> Division | None:
    """Return the fastest tree whose filters are, together, as accurate as `filters_db`.

    Return None if there is no such tree whose leaves have at least `leaf_pixels` pixels.
    """
    options = all_options(sizes, filters_db, leaf_pixels, beam_cycles, costs, choices)
    if options is None:
        return None
    # The phase rate is lowest at a root's centre, so that these are lower bounds.
    every = np.arange(len(options.choices))
    bound_s = options.roots_s + options.times(sizes.anywhere, every).onward_s()[-1]
    least_s = bound_s.min(axis=0)
    best_s, best = math.inf, (0, 0)
    for root in map(int, np.argsort(least_s, kind="stable")):
        if least_s[root] >= best_s:
            break
        inside = sizes.in_root(root)
        some = np.flatnonzero(bound_s[:, root] < best_s)
        size = int(np.searchsorted(inside.index, root))
        onward_s = options.times(inside, some).onward_s()[-1][:, size]
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
    return Division(sides, choice.align_taps, choice.aperture_taps, choice.dimensions)


# Sizes of subimages


@dataclass(frozen=True, eq=False)
class SizesInRoot:
    """Sizes of the subimages into which a root may be divided, with their phases.

    Attributes
    ----------
    index : int64 [n]
        Indices into `Sizes`.
    cycles : float64 [n, n]
        Phase cycles of a parent of size j, accumulated where a child of size i is visible.
    divisible_s : float64 [n, n]
        0 where a parent of size j may divide into children of size i, else infinite.
    across : float64 [n] or None
        Phase cycles of subimages across a sheet; None without a sheet.
    """

    index: NDArray[np.int64]
    cycles: NDArray[np.float64]
    divisible_s: NDArray[np.float64]
    across: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class Sizes:
    """Subimages of every size that the search considers, [sizes] each.

    Attributes
    ----------
    roots : SampledRoots
        The sample points, without a size of roots.
    pairs : tuple of (rows, columns)
        The sizes.
    counts : float64
        Number of subimages that contain a pixel.
    padded_pixels : float64
        Mean pixel count of a subimage, padded to whole work-items.
    visible_share : float64
        Mean fraction of the channels whose beam touches a subimage.
    half_range_extent_m : float64
        Largest difference in range between a pixel and the centre.
    beam_cycles : float64
        Phase cycles that the beam's weights add along the visible aperture.
    leaf_error : float64
        Error power that expanding a leaf of this size adds.
    beam_cycles_across : float
        Phase cycles that the beam's weights add across a sheet.
    """

    roots: SampledRoots
    pairs: tuple[Side, ...]
    counts: NDArray[np.float64]
    padded_pixels: NDArray[np.float64]
    visible_share: NDArray[np.float64]
    half_range_extent_m: NDArray[np.float64]
    beam_cycles: NDArray[np.float64]
    leaf_error: NDArray[np.float64]
    beam_cycles_across: float = 0.0
    _in_roots: dict[int, SizesInRoot] = field(default_factory=dict, init=False)

    @functools.cached_property
    def sides(self) -> NDArray[np.int64]:
        """`pairs` as an array, [sizes, 2]."""
        return np.array(self.pairs, np.int64)

    @functools.cached_property
    def divides(self) -> NDArray[np.bool_]:
        """True where subimages of one size divide into those of another, [sizes, sizes]."""
        return (self.sides[:, None] % self.sides == 0).all(axis=-1)

    @functools.cached_property
    def anywhere(self) -> SizesInRoot:
        """All sizes, with the phases at the sample points: lower bounds of those in a root."""
        return self._within(self.roots, np.arange(len(self.sides)))

    def in_root(self, root: int) -> SizesInRoot:
        """Return the sizes that divide a root, with the largest phases in it."""
        if root not in self._in_roots:
            within = self.roots.within(self.pairs[root])
            self._in_roots[root] = self._within(within, np.flatnonzero(self.divides[root]))
        return self._in_roots[root]

    @functools.cached_property
    def _spacing(self) -> NDArray[np.float64]:
        """Weights of track samples at inner points, 0 where a size is invisible, [sizes, n]."""
        visible = self.roots.visible_by_size(self.pairs)[:, INNER_POINTS, ::_EVERY]
        samples = self.roots.sampled.track.samples[::_EVERY]
        spacing = trapezoidal_weights(samples) / len(INNER_POINTS)
        return (visible * spacing).reshape(len(self.pairs), -1)

    def _within(self, roots: SampledRoots, index: NDArray[np.int64]) -> SizesInRoot:
        """Return some sizes, with the phases of subimages in roots of a size."""
        sampled = self.roots.sampled
        if sampled.scene.surface.is_plane:
            extents = self.sides[index].astype(np.float64)
        else:
            extents = np.stack([roots.extents(self.pairs[i]) for i in index])
        rates, across = roots.coarse_rates(_EVERY)
        cycles = (self._spacing @ rates.reshape(len(rates), -1).T)[index] @ extents.T
        cycles_across = None
        if across is not None:
            line = sampled.track.line_across(0.5)
            weights = trapezoidal_weights(line.samples[::_EVERY]) * line.on_track[::_EVERY]
            cycles_across = extents @ (across @ weights).mean(axis=1)
        smaller = self.divides[np.ix_(index, index)].T & (index[:, None] != index)
        return SizesInRoot(index, cycles, np.where(smaller, 0.0, np.inf), cycles_across)


def all_sizes(roots: SampledRoots, pairs: Sequence[Side], device: Device) -> Sizes:
    """Return the subimages of some sizes."""
    sampled, sides = roots.sampled, np.array(pairs, np.int64)
    visible = roots.visible_by_size(pairs)
    share = mean_over_points(visible.sum(axis=-1)) / np.count_nonzero(sampled.track.on_track)
    beam_cycles, across = np.zeros(len(sides)), 0.0
    if sampled.scene.beam is not None:
        rates = roots.beam_rates * sampled.spacing
        beam_cycles = mean_over_points(np.einsum("nps,ps->np", visible, rates))
        across = roots.beam_cycles_across()
    return Sizes(
        roots,
        tuple(pairs),
        counts=np.array([float(sampled.count(side)) for side in pairs]),
        padded_pixels=np.array([sampled.padded_pixels(side, device.info.width) for side in pairs]),
        visible_share=share,
        half_range_extent_m=half_range_extents_m(roots, pairs),
        beam_cycles=beam_cycles,
        leaf_error=leaf_error(roots, sides, device),
        beam_cycles_across=across,
    )


# The ladder of sizes


def ladder(roots: SampledRoots) -> list[Side]:
    """Return the sizes of subimages to choose from, ascending.

    Those of a curve are a ladder. The first is a work-item. Each other has twice the rows or the
    columns of the one before it: the axis is doubled with which the lines of all subimages have
    fewer samples. The last contains the image, or is as large as roots may be. Trees of a ladder
    take up to 8 % longer than the fastest of any sizes, and are found ten times faster.

    Every channel of a dense aperture is aligned for every root, so that roots should fit the image.
    There, all combinations of powers of two and of such sides are tried.
    """
    shape = roots.sampled.scene.surface.plane.shape
    if roots.sampled.track.is_dense:
        rows, columns = (_sides(*axis) for axis in zip(shape, LEAST_SIDE, strict=True))
        return sorted(product(rows, columns), key=math.prod)
    samples = _samples_per_pixel(roots)
    rungs = [LEAST_SIDE]
    while True:
        last = rungs[-1]
        larger = [
            side
            for axis, side in enumerate(((2 * last[0], last[1]), (last[0], 2 * last[1])))
            if last[axis] < shape[axis] and side[axis] <= _MOST_SIDE
        ]
        if not larger:
            return rungs
        rungs.append(min(larger, key=samples))


def _sides(pixels: int, least: int) -> set[int]:
    """Return numbers of rows or columns: powers of two, and those that fit one axis of an image."""
    sides = {least}
    while max(sides) < min(pixels, _MOST_SIDE):
        sides.add(2 * max(sides))
    for parts in (1, 2, 4):
        part = least * math.ceil(pixels / (least * parts))
        if part * parts <= _MOST_OVERHANG * max(pixels, least):
            sides |= {part * 2**k for k in range(parts.bit_length())}
    return sides


def _samples_per_pixel(roots: SampledRoots) -> Callable[[Side], float]:
    """Return a function of a size: samples of all lines of a subimage, over its pixels."""
    sampled, steps_m = roots.sampled, roots.sampled.scene.surface.steps_m[:2]
    small = roots.visible(roots.small)
    rates, _ = roots.coarse_rates(_EVERY)
    spacing = trapezoidal_weights(sampled.track.samples[::_EVERY])
    cycles = (rates[:2] * small[INNER_POINTS, ::_EVERY] @ spacing).mean(axis=1)
    seen = small if small.any() else np.ones_like(small)
    extent_m = np.abs(sampled.sight[seen] @ steps_m.T).mean(axis=0)
    per_m = _USUAL_UPSAMPLING / sampled.scene.lines.range_step_m

    def samples(side: Side) -> float:
        lines = _USUAL_DENSITY * float(cycles @ side) + _USUAL_ENDS
        return lines * (per_m * float(extent_m @ side) + _USUAL_SPARE) / math.prod(side)

    return samples


def largest_root(sides: Sequence[Side], error: Callable[[Side], float], allowed: float) -> int:
    """Return the number of the largest size whose error as a root is within `allowed`; else -1."""
    for number in reversed(range(len(sides))):
        if error(sides[number]) <= allowed:
            return number
    return -1


def half_range_extents_m(roots: SampledRoots, sides: Sequence[Side]) -> NDArray[np.float64]:
    """Return the largest difference in range between a pixel and its subimage's centre, [sizes].

    It is the projection of the sides onto the line of sight, plus the curvature of the wavefront in
    subimages close to the track.
    """
    sampled, steps_m = roots.sampled, roots.sampled.scene.surface.steps_m
    boxes = np.stack([sampled.extents(side, side, most=True) for side in sides])
    corners = np.array(list(product((-0.5, 0.5), repeat=len(steps_m))))
    radius_m = np.linalg.norm((boxes[:, None] * corners) @ steps_m, axis=-1).max(axis=1)
    bend_m = radius_m**2 / (2 * np.maximum(sampled.nearest_m, radius_m))
    # The largest change of range per row, column and metre of relief, [axes].
    visible, slopes = roots.visible(roots.small), np.abs(sampled.sight @ steps_m.T)
    if sampled.track.is_sheet:
        edges = [sampled.track.line_along(across) for across in (0.0, 1.0)]
        edges_m = np.concatenate([each.sampled_m[0] for each in edges])
        sight = unit_vectors(sampled.points_m[:, None] - edges_m)
        more = np.abs(sight @ steps_m.T)[:, np.tile(sampled.track.on_track, 2)]
        slope = 1.02 * np.maximum(slopes[visible].max(axis=0), more.max(axis=(0, 1)))
    else:
        slopes = slopes[visible] if visible.any() else slopes.reshape(-1, slopes.shape[-1])
        slope = 1.02 * slopes.max(axis=0)
    return np.minimum(boxes @ slope / 2 + bend_m, radius_m)


# Times of all trees


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
        `SampledRoots.virtual_channels`.
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

    def times(self, inside: SizesInRoot, some: NDArray[np.int64]) -> Times:
        """Return the times of trees of some of the options, [m], in a root."""
        density, ends, index = self.density[some], self.ends[some], inside.index
        # A child uses the channels of its parent whose beam touches it.
        used = density * inside.cycles
        used += ends
        own_cycles = np.diag(inside.cycles)
        leaf_cycles = own_cycles + self.leaf_beam_cycles[index]
        leaf_channels = density[..., 0] * leaf_cycles + ends[..., 0]
        forming_s = np.zeros((len(some), 1))
        if inside.across is not None:  # virtual channels lie in columns and rows of a sheet
            rows = density[..., 0] * inside.across + self.rows[some]
            used *= rows[:, None]
            leaf_channels = leaf_channels * (rows + density[..., 0] * self.leaf_beam_rows)
            columns = density[..., 0] * own_cycles + ends[..., 0]
            forming_s = columns * rows * self.row_lines_s[some][:, index]
        used *= self.channel_s[some][:, index, None]
        used += self.subimages_s[index, None]
        used += inside.divisible_s
        return Times(
            stages=self.stages[some],
            step_s=used,
            forming_s=forming_s,
            leaves_s=leaf_channels * self.leaves_s[some][:, index] + forming_s,
        )

    def path(self, inside: SizesInRoot, option: int, root: int) -> list[int]:
        """Return the sizes of the fastest tree from a root, as indices into `Sizes`."""
        times = self.times(inside, np.array([option]))
        path = [int(np.searchsorted(inside.index, root))]
        for onward_s in times.onward_s()[-2::-1]:
            path.append(int((times.step_s[0, :, path[-1]] + onward_s[0]).argmin()))
        return [int(inside.index[each]) for each in path]


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
    choices: Choices,
) -> Options | None:
    """Return all options whose filters are as accurate as `filters_db`; None if there are none."""
    roots, counts = sizes.roots, sizes.counts
    scene, track = roots.sampled.scene, roots.sampled.track
    lines, spectrum = scene.lines, scene.spectrum
    rates, stages, dimensions = [], [], 1 + track.is_sheet
    aligned = roots.stretch.spectrum(spectrum)
    most_first = sorted(choices.stages, reverse=True)
    for number, align, aperture in product(most_first, choices.align_taps, choices.aperture_taps):
        choice = choose(aligned, align, aperture, number, filters_db, dimensions)
        if choice is not None:
            rates.append(choice)
            stages.append(number)
    if not rates:
        return None
    numbers = [(c.upsampling, c.final_taps, c.stage_taps) for c in rates]
    rate, final_taps, taps = np.array(numbers).T[..., None]
    samples = 2 * sizes.half_range_extent_m * rate / lines.range_step_m
    samples += final_taps + _SPARE_SAMPLES
    first_stage = combining(
        counts * sizes.visible_share * lines.channels, samples, taps, given=True
    )
    batches = np.maximum(counts / LEAST_BATCH, 1.0) * np.array(stages)[:, None]
    first_stage += Work(reference=counts * references(roots), subimage=counts, batch=batches)
    most_db = filters_db + in_db(LONGEST_UPSAMPLING_SHARE)
    filtered = upsampler(spectrum, PHASES // 2, np.ones_like, most_db) is not None
    first_stage += upsampling(lines.samples.size * rate, filtered=filtered)
    tiled, weighted = scene.surface.is_plane, scene.beam is not None
    pixels = sizes.padded_pixels
    leaves_s = {
        n: costs.seconds(backprojecting_leaves(counts, pixels, n, tiled=tiled, weighted=weighted))
        for n in {choice.final_taps for choice in rates}
    }
    leaf = sizes.leaf_error <= _LEAF_SHARE * power(filters_db)
    leaf &= np.prod(sizes.sides, axis=1) >= leaf_pixels
    density = np.array([2 * choice.oversampling for choice in rates])
    # In trees of several stages, filters extend past the ends as if they had more taps.
    further = np.where(np.array(stages) > 1, OVERHANG, 1.0)
    aperture_taps = further * [choice.aperture_taps for choice in rates]
    return Options(
        rates,
        np.array(stages),
        density[:, None, None],
        np.array(roots.virtual_channels(aperture_taps, 0.0, 0.0))[:, None, None],
        channel_s=np.asarray(costs.seconds(combining(counts, samples, taps, given=False))),
        subimages_s=np.asarray(costs.seconds(Work(subimage=counts))),
        leaves_s=np.where(leaf, np.array([leaves_s[c.final_taps] for c in rates]), np.inf),
        roots_s=np.asarray(costs.seconds(first_stage)),
        leaf_beam_cycles=beam_cycles * sizes.beam_cycles,
        rows=aperture_taps[:, None],
        leaf_beam_rows=beam_cycles * sizes.beam_cycles_across,
        row_lines_s=np.asarray(
            costs.seconds(adding_in_rows(counts, samples + 2 * GUARD, aperture_taps[:, None]))
        ),
    )
