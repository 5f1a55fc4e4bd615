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
from clsas.sonar.visibility import BeamTrack, Boxes

_EVEN_NODES = 2.5  # over how many nodes their spacing is smoothed, rms
_LEAST_RATE = 0.3  # of the mean over the track
_LEAST_NODES = 2.0  # between the track's ends
_COARSER = 2  # of the track's samples those at which it is decided what they see
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
    on_track = np.flatnonzero(np.abs(track.samples - 0.5) <= 0.5)[::_COARSER]
    places = track.samples[on_track]
    beam = BeamTrack(limits, track.sampled_m[0][on_track], along[on_track])
    boxes = Boxes.equal(centres_m.reshape(-1, 3), half_m)
    spans = beam.spans(boxes)
    begin, end = np.full(len(boxes), -np.inf), np.full(len(boxes), -np.inf)
    # What no single sample sees may be seen from between samples.
    bounds = np.concatenate([[-np.inf], places[1:-1], [np.inf]])
    ever = spans.earliest <= spans.latest
    begin[ever] = bounds[np.maximum(spans.earliest[ever] - 1, 0)]
    end[ever] = bounds[np.minimum(spans.latest[ever] + 1, len(places) - 1)]
    found = np.flatnonzero(spans.first <= spans.last)
    for edge, outermost, outward in ((begin, spans.first[found], -1), (end, spans.last[found], 1)):
        edge[found] = _crossing(beam, places, boxes[found], outermost, outward)
    return begin.reshape(shape), end.reshape(shape)


def _crossing(
    beam: BeamTrack,
    places: NDArray[np.float64],
    boxes: Boxes,
    outermost: NDArray[np.int64],
    outward: int,
) -> NDArray[np.float64]:
    """Return where the beam begins to touch each box, beyond its outermost sample, [boxes]."""
    beyond = (outermost == 0) if outward < 0 else (outermost == len(places) - 1)
    index = outermost[:, None] + outward * np.array([1, 0, -1])
    index = index.clip(0, len(places) - 1)
    outside, inside, further = beam.depth(boxes, index).T
    # The depth changes nearly evenly between two samples, unless it is largest there.
    even = (further > inside) & (outside <= 0)
    share = np.divide(outside, outside - inside, out=np.full(len(boxes), _LESS), where=even)
    share = (share - _LESS).clip(0)
    crossing = places[index[:, 0]] + share * (places[outermost] - places[index[:, 0]])
    return np.where(beyond, outward * np.inf, crossing)


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
