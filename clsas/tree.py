"""The tree of a factorized image: subimages within subimages, and the virtual channels of each."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from clsas.aperture import MeanTrack, turned
from clsas.grid import Grid
from clsas.interpolation import Interpolator
from clsas.window import BeamWindow, touches_rectangles

_EVEN_NODES = 2.5  # over how many nodes their spacing is smoothed, rms
_LEAST_RATE = 0.3  # of the mean over the track
_LEAST_NODES = 2.0  # between the track's ends
_COARSER = 2  # of the track's samples those at which it is decided what they see


@dataclass(frozen=True, eq=False)
class Nodes:
    """Virtual channels shared by all subimages of one stage within each of some roots.

    Attributes
    ----------
    place : float64 [roots, nodes]
        On the mean track.
    position_m : float64 [roots, nodes, 3]
    order : int64 [roots, channels]
        The channels of the stage before in the order of `base`.
    base : int64 [roots, channels]
        First node that each of these contributes to, never decreasing.
    weights : float64 [roots, channels, taps]
        What it contributes to that node and those after it.
    """

    place: NDArray[np.float64]
    position_m: NDArray[np.float64]
    order: NDArray[np.int64]
    base: NDArray[np.int64]
    weights: NDArray[np.float64]

    @property
    def taps(self) -> int:
        """Nodes that a channel contributes to."""
        return self.weights.shape[-1]


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
    order = np.argsort(turns, axis=1, kind="stable")
    turns = np.take_along_axis(turns, order, axis=1)
    lower = np.floor(turns)
    base = lower.astype(np.int64) - (taps // 2 - 1)
    weights = aperture.weights(turns - lower - 0.5)
    wanted = origin + np.arange(base.max() + taps)
    nodes = np.stack([np.interp(w, c, track.samples) for w, c in zip(wanted, cycles, strict=True)])
    return Nodes(nodes, track.positions_m(nodes), order, base, weights)


def _even(track: MeanTrack, rate: NDArray[np.float64], density: float) -> NDArray[np.float64]:
    """Return rates that change little over the taps of a filter, [roots, samples].

    Steering functions are band-limited between nodes only where their spacing hardly changes:
    the rates' logarithms are smoothed over some nodes. Where nothing is seen (a rate of 0), beyond
    the track's ends and where nearly nothing turns, nodes go on much as they are beside.
    """
    on_track = np.flatnonzero(np.abs(track.samples - 0.5) <= 0.5)
    result = np.empty_like(rate)
    for root, each in enumerate(rate):
        seen = on_track[each[on_track] > 0]
        if not seen.size:
            result[root] = 1.0
            continue
        inside = np.interp(on_track, seen, each[seen])
        inside = np.maximum(inside, max(_LEAST_RATE * inside.mean(), _LEAST_NODES / density))
        nodes_per_sample = density * inside.mean() / (len(on_track) - 1)
        smooth = gaussian_filter1d(np.log(inside), _EVEN_NODES / nodes_per_sample, mode="nearest")
        result[root] = np.exp(np.interp(np.arange(len(each)), on_track, smooth))
    return result


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
        np.ones((roots, channels, 1)),
    )


@dataclass(frozen=True)
class Division:
    """A grid divided into subimages of several sizes, each size within the one before.

    Attributes
    ----------
    grid : Grid
    sides : tuple of (rows, columns)
        Pixels along a subimage's sides, from the roots to the leaves; each divides the one before.
    """

    grid: Grid
    sides: tuple[tuple[int, int], ...]

    @property
    def roots(self) -> NDArray[np.int64]:
        """First row and column of every root, [roots, 2], column by column."""
        rows, columns = (
            np.arange(0, n, side) for n, side in zip(self.grid.shape, self.sides[0], strict=True)
        )
        across, down = np.meshgrid(columns, rows, indexing="ij")
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
        """Return the middles of subimages that begin at some pixels, [..., 3]."""
        middle = corners + (np.array(self.sides[level]) - 1) / 2
        return (
            self.grid.origin_m
            + middle[..., :1] * self.grid.row_step_m
            + middle[..., 1:] * self.grid.column_step_m
        )

    def parents(self, level: int) -> NDArray[np.int64]:
        """Return which subimage of the size before holds each, within a root, [subimages]."""
        down, across = self._divided(0, level)
        rows, columns = self._divided(level - 1, level)
        row, column = np.divmod(np.arange(down * across), across)
        return row // rows * (across // columns) + column // columns

    def radius_m(self, level: int) -> float:
        """Half a subimage's longer diagonal."""
        rows, columns = self.sides[level]
        down, across = rows * self.grid.row_step_m, columns * self.grid.column_step_m
        return max(np.linalg.norm(down + across), np.linalg.norm(down - across)) / 2

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
    sight = points_m[:, None] - track.positions_m(track.samples)
    sight /= np.maximum(np.linalg.norm(sight, axis=-1, keepdims=True), 1e-9)
    sine = np.einsum("psi,si->ps", sight, along)
    return np.abs(np.gradient(sine, track.samples, axis=1)) / beam.edge


def seen_from(
    beam: BeamWindow | None,
    track: MeanTrack,
    along: NDArray[np.float64] | None,
    centres_m: NDArray[np.float64],
    half_m: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return from where to where on the track rectangles are seen, two arrays [...].

    Infinite where they are seen from the track's ends; -inf and -inf where from nowhere.

    Parameters
    ----------
    along : float64 [samples, 3]
        The track's direction at `track.samples`; not needed without a beam.
    centres_m : float64 [..., 3]
    half_m : float64 [2, 3]
        Half the sides, as vectors.
    """
    shape = centres_m.shape[:-1]
    if beam is None:
        return np.full(shape, -np.inf), np.full(shape, np.inf)
    samples = track.samples
    on_track = np.flatnonzero(np.abs(samples - 0.5) <= 0.5)[::_COARSER]
    places = samples[on_track]
    position_m = track.positions_m(places)
    origin_m = position_m[0]
    seen = touches_rectangles(
        beam, centres_m.reshape(-1, 3) - origin_m, half_m, position_m - origin_m, along[on_track]
    )
    first, last = seen.argmax(axis=1), seen.shape[1] - 1 - seen[:, ::-1].argmax(axis=1)
    # The edge lies between two samples.
    edges = np.concatenate([[-np.inf], places[1:-1], [np.inf]])
    begin, end = edges[np.maximum(first - 1, 0)], edges[np.minimum(last + 1, len(places) - 1)]
    never = ~seen.any(axis=1)
    begin[never] = end[never] = -np.inf
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
    seen: tuple[NDArray[np.float64], NDArray[np.float64]],
    inside: NDArray[np.bool_],
) -> list[Ranges]:
    """Return what every subimage needs, stage by stage, so that the leaves have all they need.

    Parameters
    ----------
    nodes : list of Nodes
        Per stage.
    seen : two float64 [roots, leaves]
        From where to where on the track a leaf is seen.
    inside : bool [roots, leaves]
        Whether it holds a pixel of the grid.
    """
    count = nodes[-1].place.shape[1]
    first = _rowwise(nodes[-1].place, seen[0], "right") - 1
    last = _rowwise(nodes[-1].place, seen[1], "left") + 1
    first, last = np.clip(first, 0, count), np.clip(last, 0, count)
    empty = ~inside | (last <= first) | (seen[1] <= seen[0])
    result = []
    for level in reversed(range(len(nodes))):
        base, taps = nodes[level].base, nodes[level].taps
        begin = _rowwise(base, first - taps + 1, "left")
        end = _rowwise(base, last, "left")
        for array in (first, last, begin, end):
            array[empty] = 0
        result.append(Ranges(first, last, begin, end))
        if level:
            parents = division.parents(level)
            shape = (len(first), division.per_root(level - 1))
            first = np.full(shape, np.iinfo(np.int64).max)
            last = np.zeros(shape, np.int64)
            for root in range(len(begin)):
                used = ~empty[root]
                np.minimum.at(first[root], parents[used], begin[root, used])
                np.maximum.at(last[root], parents[used], end[root, used])
            empty = last <= first
    return result[::-1]


def _rowwise(
    rows: NDArray[np.float64], values: NDArray[np.float64], side: str
) -> NDArray[np.int64]:
    """Return np.searchsorted of every row."""
    return np.stack(
        [np.searchsorted(row, value, side) for row, value in zip(rows, values, strict=True)]
    )
