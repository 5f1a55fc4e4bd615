"""The tree of a factorized image: subimages within subimages, and the virtual channels of each."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from clsas.factorized.aperture import MeanTrack, turned
from clsas.factorized.surface import Surface
from clsas.signal.interpolation import Interpolator
from clsas.sonar.beam import BeamWindow
from clsas.sonar.visibility import Visibility, touches_boxes

_EVEN_NODES = 2.5  # over how many nodes their spacing is smoothed, rms
_LEAST_RATE = 0.3  # of the mean over the track
_LEAST_NODES = 2.0  # between the track's ends
_COARSER = 2  # of the track's samples those at which it is decided what they see
_RUN = 8  # of these, tried together
_LESS = 0.2  # of the way between two: a margin for what lies between


@dataclass(frozen=True, eq=False)
class Nodes:
    """Virtual channels shared by all subimages of one stage within each of some roots.

    Attributes
    ----------
    place : float64 [roots, nodes]
        On the mean track.
    position_m : float64 [roots, nodes, 3]
    order : int64 [roots, channels] or None
        The channels of the stage before in the order of `base`; None where they come in it.
    base : int64 [roots, channels]
        First node that each of these contributes to, never decreasing.
    between : float64 [roots, channels]
        Where it lies from the middle of the nodes that it contributes to, -0.5 to 0.5 nodes.
    aperture : Interpolator or None
        What it contributes to them; None where it is added to one.
    """

    place: NDArray[np.float64]
    position_m: NDArray[np.float64]
    order: NDArray[np.int64] | None
    base: NDArray[np.int64]
    between: NDArray[np.float64]
    aperture: Interpolator | None

    @property
    def taps(self) -> int:
        """Nodes that a channel contributes to."""
        return 1 if self.aperture is None else self.aperture.taps

    @property
    def weights(self) -> NDArray[np.float64]:
        """What channels contribute to their nodes, from `base` on, [roots, channels, taps]."""
        if self.aperture is None:
            return np.ones((*self.base.shape, 1))
        return self.aperture.weights(self.between)

    def ordered(self, values: NDArray) -> NDArray:
        """Return what there is of every channel, [roots, channels], in the order of `base`."""
        return values if self.order is None else np.take_along_axis(values, self.order, axis=1)


def interpolated_nodes(
    track: MeanTrack,
    rate: NDArray[np.float64],
    place: NDArray[np.float64],
    aperture: Interpolator,
) -> Nodes:
    """Return nodes so dense that steering functions are interpolated well between them.

    They lie at equal steps of the phase's turns: in that coordinate every steering function is
    band-limited to one cycle per unit, whatever the track.

    Parameters
    ----------
    rate : float64 [roots, samples]
        Fastest turn of a phase, cycles per unit of the track's parameter, at `track.samples`.
    place : float64 [roots, channels]
        Where the channels appear on the track.
    aperture : Interpolator
        Its `upsampling` is the density of nodes over the least.
    """
    taps, density = aperture.taps, 2 * aperture.upsampling
    cycles = density * turned(track, _even(track, rate, density))
    turns = np.stack([np.interp(p, track.samples, c) for p, c in zip(place, cycles, strict=True)])
    turns -= (origin := np.floor(turns.min(axis=1, keepdims=True)) - (taps // 2 - 1))
    order = None
    if (np.diff(turns) < 0).any():
        order = np.argsort(turns, axis=1, kind="stable")
        turns = np.take_along_axis(turns, order, axis=1)
    lower = np.floor(turns)
    base = lower.astype(np.int64) - (taps // 2 - 1)
    wanted = origin + np.arange(base.max() + taps)
    nodes = np.stack([np.interp(w, c, track.samples) for w, c in zip(wanted, cycles, strict=True)])
    return Nodes(nodes, track.positions_m(nodes), order, base, turns - lower - 0.5, aperture)


def _even(track: MeanTrack, rate: NDArray[np.float64], density: float) -> NDArray[np.float64]:
    """Return rates that change little over the taps of a filter, [roots, samples].

    Steering functions are band-limited between nodes only where their spacing hardly changes:
    the rates' logarithms are smoothed over some nodes. Where nothing is seen (a rate of 0), beyond
    the track's ends and where nearly nothing turns, nodes go on much as they are beside.
    """
    on_track = np.flatnonzero(np.abs(track.samples - 0.5) <= 0.5)
    inside = rate[:, on_track]
    for root in np.flatnonzero((inside <= 0).any(axis=1)):
        seen = np.flatnonzero(inside[root] > 0)
        every = np.arange(len(on_track))
        inside[root] = np.interp(every, seen, inside[root, seen]) if seen.size else 1.0
    mean = inside.mean(axis=1, keepdims=True)
    inside = np.maximum(inside, np.maximum(_LEAST_RATE * mean, _LEAST_NODES / density))
    nodes_per_sample = density * inside.mean(axis=1) / (len(on_track) - 1)
    # Roots of much the same width are smoothed in one go.
    width = np.ceil(2 * np.log2(_EVEN_NODES / nodes_per_sample)).astype(int)
    inside = np.log(inside, out=inside)
    for each in np.unique(width):
        mine = width == each
        inside[mine] = gaussian_filter1d(inside[mine], 2 ** (each / 2), mode="nearest")
    nearest = np.clip(np.arange(rate.shape[1]) - on_track[0], 0, len(on_track) - 1)
    return np.exp(inside, out=inside)[:, nearest]


def nearest_nodes(
    place: NDArray[np.float64], position_m: NDArray[np.float64], factor: int
) -> Nodes:
    """Return nodes as THESIS [43] has them: means of `factor` neighbours, which are summed.

    Parameters
    ----------
    place : float64 [roots, channels]
    position_m : float64 [roots, channels, 3]
    """
    roots, channels = place.shape
    order = np.argsort(place, axis=1, kind="stable")
    starts = np.arange(0, channels, factor)
    counts = np.diff(np.append(starts, channels))
    sorted_place = np.take_along_axis(place, order, axis=1)
    sorted_m = np.take_along_axis(position_m, order[..., None], axis=1)
    base = np.broadcast_to(np.arange(channels) // factor, (roots, channels))
    return Nodes(
        np.add.reduceat(sorted_place, starts, axis=1) / counts,
        np.add.reduceat(sorted_m, starts, axis=1) / counts[:, None],
        order,
        base,
        np.zeros((roots, channels)),
        None,
    )


@dataclass(frozen=True)
class Division:
    """A surface divided into subimages of several sizes, each size within the one before.

    Attributes
    ----------
    surface : Surface
    sides : tuple of (rows, columns)
        Cells along a subimage's sides, from the roots to the leaves; each divides the one before.
    """

    surface: Surface
    sides: tuple[tuple[int, int], ...]

    @property
    def roots(self) -> NDArray[np.int64]:
        """First row and column of every root, [roots, 2], row by row.

        Most grids have their rows along the track: these roots share the samples of lines.
        """
        rows, columns = (
            np.arange(0, n, side)
            for n, side in zip(self.surface.plane.shape, self.sides[0], strict=True)
        )
        down, across = np.meshgrid(rows, columns, indexing="ij")
        return np.stack([down.ravel(), across.ravel()], axis=1)

    def per_root(self, level: int) -> int:
        """Return how many subimages of a size a root holds."""
        return math.prod(self._divided(0, level))

    def corners(self, level: int, roots: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return first rows and columns of the subimages within some roots.

        They come row by row, [roots, subimages, 2].
        """
        down, across = self._divided(0, level)
        inside = np.stack(np.divmod(np.arange(down * across), across), axis=1)
        return roots[:, None] + inside * self.sides[level]

    def centres_m(self, level: int, corners: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the middles of subimages that begin at some cells, [..., 3]."""
        return self.surface.middles_m(self.sides[level], corners)

    def parents(self, level: int) -> NDArray[np.int64]:
        """Return which subimage of the size before holds each, within a root, [subimages]."""
        down, across = self._divided(0, level)
        rows, columns = self._divided(level - 1, level)
        row, column = np.divmod(np.arange(down * across), across)
        return row // rows * (across // columns) + column // columns

    def by_parent(self, level: int, values: NDArray) -> NDArray:
        """Return what there is of every subimage of a size, [roots, subimages], by their parents.

        That is [roots, parents, subimages of each].
        """
        down, across = self._divided(0, level - 1)
        rows, columns = self._divided(level - 1, level)
        split = values.reshape(len(values), down, rows, across, columns).swapaxes(2, 3)
        return split.reshape(len(values), down * across, rows * columns)

    def _divided(self, level: int, later: int) -> tuple[int, int]:
        """Return into how many rows and columns of smaller subimages one of a level is divided."""
        (rows, columns), (less_rows, less_columns) = self.sides[level], self.sides[later]
        return rows // less_rows, columns // less_columns


def beam_directions(
    along: NDArray[np.float64], track: MeanTrack, place: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return unit directions at some parameters, [..., 3], from those of the channels [n, 3]."""
    order = np.argsort(track.place, kind="stable")
    return interpolated_directions(track.place[order], along[order], place)


def interpolated_directions(
    given: NDArray[np.float64], along: NDArray[np.float64], place: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return unit directions at some parameters, [..., 3], from `along` at ascending `given`."""
    between = np.stack([np.interp(place, given, axis) for axis in along.T], axis=-1)
    return between / np.linalg.norm(between, axis=-1, keepdims=True)


def beam_rate(
    beam: BeamWindow, track: MeanTrack, along: NDArray[np.float64], points_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return how fast a beam's weights change along the track, as a rate of phases.

    That is [points, samples]: nodes must be dense enough for the weights too, with a cycle over an
    edge of the window. `along` is the track's direction at `track.samples`.
    """
    sight = points_m[:, None] - track.sampled_m[0]
    sight /= np.maximum(np.linalg.norm(sight, axis=-1, keepdims=True), 1e-9)
    sine = np.einsum("psi,si->ps", sight, along)
    return np.abs(np.gradient(sine, track.samples, axis=1)) / beam.edge


def seen_from(
    limits: tuple[float, float] | None,
    track: MeanTrack,
    along: NDArray[np.float64] | None,
    centres_m: NDArray[np.float64],
    half_m: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return from where to where on the track boxes are seen, two arrays [...].

    Infinite where they are seen from the track's ends; -inf and -inf where from nowhere.

    Parameters
    ----------
    limits : (low, high), optional
        Sines of the aspect angle between which anything is seen; without them everything is.
    along : float64 [samples, 3]
        The track's direction at `track.samples`; not needed without limits.
    centres_m : float64 [..., 3]
    half_m : float64 [axes, 3]
        Half their sides, as vectors.
    """
    shape = centres_m.shape[:-1]
    if limits is None:
        return np.full(shape, -np.inf), np.full(shape, np.inf)
    samples = track.samples
    on_track = np.flatnonzero(np.abs(samples - 0.5) <= 0.5)[::_COARSER]
    places, along = samples[on_track], along[on_track]
    position_m = track.sampled_m[0][on_track]
    origin_m = position_m[0]
    position_m, centres_m = position_m - origin_m, centres_m.reshape(-1, 3) - origin_m
    # Runs of places first, each the one in its middle with what is around it; then single ones.
    starts, run = np.arange(0, len(places), _RUN), np.arange(len(places)) // _RUN
    middle = np.minimum(starts + _RUN // 2, len(places) - 1)
    around_m, spread = (
        np.maximum.reduceat(np.linalg.norm(values - values[middle[run]], axis=1), starts)
        for values in (position_m, along)
    )
    seen = touches_boxes(
        limits, centres_m, half_m, position_m[middle], along[middle], around_m, spread
    )
    ever = seen.any(axis=1)
    of_first, of_last = seen.argmax(axis=1), len(starts) - 1 - seen[:, ::-1].argmax(axis=1)
    bounds = np.concatenate([[-np.inf], places[1:-1], [np.inf]])
    widest = (
        bounds[np.maximum(_RUN * of_first - 1, 0)],
        bounds[np.minimum(_RUN * (of_last + 1), len(places) - 1)],
    )
    begin, end = np.full(len(ever), np.inf), np.full(len(ever), -np.inf)
    halves, inward = np.ones(len(half_m)), np.arange(-1, _RUN + 1)
    for edge, outermost, at, last, step in (
        (begin, widest[0], of_first.copy(), of_last, 1),
        (end, widest[1], of_last.copy(), of_first, -1),
    ):
        some = np.flatnonzero(ever)
        while some.size:
            # With the places beside them; at the track's ends that is their first or last one.
            index = _RUN * at[some, None] + (inward if step > 0 else _RUN - 1 - inward)
            index = np.clip(index, 0, len(places) - 1)
            visibility = Visibility.of(centres_m[some], half_m, position_m, along, index)
            inside_by = visibility.overlap(limits, halves)
            inside = inside_by[:, :-1] > 0
            whole = some[inside[:, 0]]
            edge[whole] = outermost[whole]
            # Between two places it changes nearly evenly, unless it has its most there.
            found = np.flatnonzero(inside.any(axis=1) & ~inside[:, 0])
            inner = inside[found].argmax(axis=1)
            before, after, later = (inside_by[found, inner + n] for n in (-1, 0, 1))
            share = np.where(later > after, before / (before - after) - _LESS, 0.0).clip(0)
            before, after = places[index[found, inner - 1]], places[index[found, inner]]
            edge[some[found]] = before + share * (after - before)
            # On to the next run, if there is one.
            some = some[~inside.any(axis=1) & (at[some] != last[some])]
            at[some] += step
    # What no single place sees may be seen from between them.
    between = begin > end
    begin[between], end[between] = widest[0][between], widest[1][between]
    begin[~ever] = end[~ever] = -np.inf
    return begin.reshape(shape), end.reshape(shape)


@dataclass(frozen=True, eq=False)
class Ranges:
    """Which nodes each subimage of a stage has, and which channels of the stage before it uses.

    All int64 [roots, subimages]; `last` and `end` are one past. Empty where nothing is seen.
    """

    first: NDArray[np.int64]
    last: NDArray[np.int64]
    begin: NDArray[np.int64]
    end: NDArray[np.int64]


def ranges(
    division: Division,
    nodes: list[Nodes],
    place: NDArray[np.float64],
    seen: tuple[NDArray[np.float64], NDArray[np.float64]],
    inside: NDArray[np.bool_],
) -> list[Ranges]:
    """Return what every subimage needs, stage by stage.

    Weighted by the beam a steering function is 0 where the subimage is not seen from, on nodes and
    channels alike: they have no part in it, though a filter's taps reach them.

    Parameters
    ----------
    nodes : list of Nodes
        Per stage.
    place : float64 [roots, channels]
        Of the raw channels on the track.
    seen : two float64 [roots, leaves]
        From where to where on the track a leaf is seen.
    inside : bool [roots, leaves]
        Whether it holds a pixel.
    """
    places = [nodes[0].ordered(place), *(each.place for each in nodes)]
    # Beyond what channels contribute to there are nodes that hold nothing.
    counts = [np.full((len(place), 1), place.shape[1])]
    for each in nodes:
        counts.append(np.take_along_axis(each.base, counts[-1] - 1, axis=1) + each.taps)
    empty = ~inside | (seen[1] <= seen[0])
    start, stop = np.where(empty, np.inf, seen[0]), np.where(empty, -np.inf, seen[1])
    result = []
    for level in reversed(range(len(nodes))):
        begin, end = _between(places[level], counts[level], start, stop, level > 0)
        first, last = _between(places[level + 1], counts[level + 1], start, stop, True)
        empty = (end <= begin) | (last <= first) | (stop < start)
        for array in (first, last, begin, end):
            array[empty] = 0
        result.append(Ranges(first, last, begin, end))
        if level:
            start = division.by_parent(level, start).min(axis=-1)
            stop = division.by_parent(level, stop).max(axis=-1)
    result = result[::-1]
    for level in range(1, len(nodes)):
        # A track may have gaps, where virtual channels hold nothing.
        parent, need = result[level - 1], result[level]
        empty = (parent.last <= parent.first)[:, division.parents(level)]
        for array in (need.first, need.last, need.begin, need.end):
            array[empty] = 0
    return result


def _between(
    places: NDArray[np.float64],
    counts: NDArray[np.int64],
    start: NDArray[np.float64],
    stop: NDArray[np.float64],
    nearest: bool,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return which of ascending places lie between others, first and one past the last.

    Where none does these are, with `nearest`, the two beside.
    """
    first, last = _rowwise(places, start, "left"), _rowwise(places, stop, "right")
    if nearest:
        between = last <= first
        first, last = first - between, last + between
    return np.clip(first, 0, counts), np.clip(last, 0, counts)


def _rowwise(
    rows: NDArray[np.float64], values: NDArray[np.float64], side: str
) -> NDArray[np.int64]:
    """Return np.searchsorted of every row, [rows, n] and [rows, values]."""
    # All rows at once: one after the other, moved apart.
    least, most = rows[:, 0].min(), rows[:, -1].max()
    apart = np.arange(len(rows))[:, None] * (most - least + 2)
    values = np.clip(values, least - 1, most + 1)
    found = np.searchsorted((rows + apart).ravel(), (values + apart).ravel(), side)
    return found.reshape(values.shape) - np.arange(len(rows))[:, None] * rows.shape[1]
