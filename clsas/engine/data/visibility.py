"""Visibility: the channels, or positions on a track, whose beam touches points and boxes."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from clsas.engine.data.geometry import SAME_PLACE_M

_ANY_DIRECTION = 4.0  # larger than any difference of two sines
# Pairs of boxes and runs that are tested together. With half as many the search takes a tenth
# longer.
_PAIRS_AT_ONCE = 1 << 16


def sines(
    points_m: NDArray[np.float64],
    phase_centres_m: NDArray[np.float64],
    along: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the sine of every point's aspect angle at every channel, float64 [channels, points].

    The sine of a point at the phase centre itself is 0.

    Parameters
    ----------
    points_m : float64 [points, 3]
    phase_centres_m, along : float64 [channels, 3]
        Phase centres, and unit directions of the track there.
    """
    return _sines(points_m, phase_centres_m, along)[0].T


def is_within(
    sine: NDArray[np.float64],
    limits: tuple[float, float],
    beyond: float | NDArray[np.float64] = 0.0,
) -> NDArray[np.bool_]:
    """Return which sines of aspect angles lie in a beam, or outside it by less than `beyond`."""
    low, high = limits
    return (sine > low - beyond) & (sine < high + beyond)


def sine_width(limits: tuple[float, float]) -> float:
    """Return the width of a beam between limits that may lie beyond end-fire, at most 2."""
    low, high = (min(max(limit, -1.0), 1.0) for limit in limits)  # called hundreds of times
    return high - low


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes whose sides have the same directions.

    Attributes
    ----------
    centres_m : float64 [boxes, 3]
    axes_m : float64 [axes, 3]
        Directions of the sides.
    half : float64 [boxes, axes] or [1, axes]
        Half the length of the sides, as a multiple of the length of the axes.
    """

    centres_m: NDArray[np.float64]
    axes_m: NDArray[np.float64]
    half: NDArray[np.float64]

    @classmethod
    def equal(cls, centres_m: NDArray[np.float64], half_m: NDArray[np.float64]) -> Boxes:
        """Return boxes of one size; `half_m` contains half their sides as vectors, [axes, 3]."""
        return cls(centres_m, half_m, np.ones((1, len(half_m))))

    def __len__(self) -> int:
        """Return the number of boxes."""
        return len(self.centres_m)

    def __getitem__(self, some: slice | NDArray[np.int64]) -> Boxes:
        """Return some of the boxes."""
        half = self.half if len(self.half) == 1 else self.half[some]
        return Boxes(self.centres_m[some], self.axes_m, half)


@dataclass(frozen=True, eq=False)
class Visibility:
    """Aspect angles of points, and of boxes around them, at positions on a track.

    Attributes
    ----------
    sine, inverse_m : float64 [points, positions]
        Sine of the aspect angle of a point, and the inverse of its distance.
    axes_m : float64 [axes, 3]
        Directions of the boxes' sides.
    slopes : float64 [axes, points, positions]
        Magnitude of the sine's derivative along each axis.
    """

    sine: NDArray[np.float64]
    inverse_m: NDArray[np.float64]
    axes_m: NDArray[np.float64]
    slopes: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        points_m: NDArray[np.float64],
        axes_m: NDArray[np.float64],
        track_m: NDArray[np.float64],
        along: NDArray[np.float64],
    ) -> Visibility:
        """Return the visibility of points from positions on a track.

        Parameters
        ----------
        points_m : float64 [points, 3]
        axes_m : float64 [axes, 3]
        track_m, along : float64 [positions, 3]
            Positions on the track, and its unit directions there.
        """
        sine, distance_m = _sines(points_m, track_m, along)
        towards_m = (axes_m @ points_m.T)[..., None] - (axes_m @ track_m.T)[:, None]
        return cls._of(sine, distance_m, axes_m, towards_m, (axes_m @ along.T)[:, None])

    @classmethod
    def of_each(
        cls,
        points_m: NDArray[np.float64],
        axes_m: NDArray[np.float64],
        track_m: NDArray[np.float64],
        along: NDArray[np.float64],
        index: NDArray[np.int64],
    ) -> Visibility:
        """Return the visibility of points, each from its own positions.

        Parameters are those of `of`, and `index`, int64 [points, positions]: the numbers of the
        positions for each point.
        """
        of_positions = (track_m.T, along.T, axes_m @ track_m.T, axes_m @ along.T)
        gathered = np.take(np.concatenate(of_positions), index, axis=1)
        position, direction, from_m, turning = np.split(gathered, [3, 6, 6 + len(axes_m)])
        offset_m = np.subtract(points_m.T[..., None], position, out=position)
        sine = np.einsum("ipn,ipn->pn", offset_m, direction)
        distance_m = np.sqrt(np.einsum("ipn,ipn->pn", offset_m, offset_m))
        sine /= np.maximum(distance_m, SAME_PLACE_M)
        towards_m = np.subtract((axes_m @ points_m.T)[..., None], from_m, out=from_m)
        return cls._of(sine, distance_m, axes_m, towards_m, turning)

    @classmethod
    def _of(
        cls,
        sine: NDArray[np.float64],
        distance_m: NDArray[np.float64],
        axes_m: NDArray[np.float64],
        towards_m: NDArray[np.float64],
        along_axes: NDArray[np.float64],
    ) -> Visibility:
        """Return the visibility, given lines of sight and track directions along the axes."""
        inverse_m = 1 / np.maximum(distance_m, SAME_PLACE_M, out=distance_m)
        slopes = towards_m
        for slope, along in zip(slopes, along_axes, strict=True):
            slope *= inverse_m
            slope *= sine
            np.subtract(along, slope, out=slope)
            slope *= inverse_m
            np.abs(slope, out=slope)
        return cls(sine, inverse_m, axes_m, slopes)

    def overlap(
        self,
        limits: tuple[float, float],
        half: NDArray[np.float64],
        around_m: float | NDArray[np.float64] = 0.0,
        spread: float | NDArray[np.float64] = 0.0,
    ) -> NDArray[np.float64]:
        """Return the depth to which boxes around the points may reach into a beam.

        Parameters
        ----------
        limits : (low, high)
            Sines of the aspect angle at which the beam begins and ends.
        half : float64 [axes], [1, axes] or [points, axes]
            Half the sides of the boxes, as a multiple of the length of the axes.
        around_m, spread : float or float64 [positions]
            Bounds for the positions that each position represents: their distance from it, metres,
            and the length of the difference of their directions.

        Returns
        -------
        float64 [points, positions]
            Upper bound of the depth, in sine of the aspect angle. It is negative where no part of
            the box lies in the beam.
        """
        low, high = limits
        half = np.atleast_2d(half)
        radius_m = np.linalg.norm(np.abs(half) @ np.abs(self.axes_m), axis=1)
        wide = radius_m[:, None] * self.inverse_m
        reach = wide * wide
        for each, slope in zip(half.T, self.slopes, strict=True):
            reach += each[:, None] * slope
        if np.any(around_m) or np.any(spread):
            ratio = np.minimum(around_m * self.inverse_m, 0.5)
            # From a closer position, the box fills a larger angle.
            reach += ratio + ratio * ratio * ratio
            reach /= 1 - ratio
            reach += spread
            # From half the distance, the box may lie in any direction.
            wide += 2 * ratio
        # From inside the ball around the box, its parts may lie in any direction.
        np.copyto(reach, _ANY_DIRECTION, where=wide >= 1)
        # Add the depth past the nearer limit, which is the smaller of the two depths.
        reach -= np.abs(self.sine - (low + high) / 2)
        reach += (high - low) / 2
        return reach


@dataclass(frozen=True, eq=False)
class BeamTrack:
    """Positions along a track, each with its beam.

    The methods find the positions from which the beam touches boxes, from coarse to fine: first for
    whole runs of consecutive positions, then for the single positions of the runs that matter. The
    bounds are safe. A position whose beam touches a box is never missed, but a few others may be
    returned.

    Attributes
    ----------
    limits : (low, high)
        Sines of the aspect angle at which the beam begins and ends.
    position_m, along : float64 [positions, 3]
        Positions in order along the track, and its unit direction at each.
    """

    limits: tuple[float, float]
    position_m: NDArray[np.float64]
    along: NDArray[np.float64]

    @property
    def count(self) -> int:
        """Number of positions."""
        return len(self.position_m)

    @functools.cached_property
    def run(self) -> int:
        """Number of positions in a run, a power of two.

        Searching both ends of `count` positions takes count / run + 2 run tests. This length
        minimises their number.
        """
        return 2 ** max(round(math.log2(self.count / 2) / 2), 0)

    def touching(self, boxes: Boxes) -> NDArray[np.bool_]:
        """Return whether the beam touches each box from each position, bool [boxes, positions]."""
        found = np.zeros((len(boxes), self.count), np.bool_)
        box, run = np.nonzero(self._runs_touching(boxes))
        step = max(_PAIRS_AT_ONCE // self.run, 1)
        for start in range(0, len(box), step):
            some, index = box[start : start + step], self._members(run[start : start + step])
            found[some[:, None], index] = self.depth(boxes[some], index) > 0
        return found

    def spans(self, boxes: Boxes) -> Spans:
        """Return the first and the last position whose beam touches each box."""
        step = max(_PAIRS_AT_ONCE * self.run // self.count, 1)
        starts = range(0, max(len(boxes), 1), step)
        found = [self._spans(boxes[start : start + step]) for start in starts]
        return Spans(*np.concatenate(found, axis=1))

    def depth(self, boxes: Boxes, index: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return `Visibility.overlap` of each box at its own positions, [boxes, positions].

        It is positive where the beam may touch the box. `index` contains the numbers of the
        positions, int64 [boxes, positions].
        """
        centres_m = boxes.centres_m - self.position_m[0]
        visibility = Visibility.of_each(centres_m, boxes.axes_m, self._local_m, self.along, index)
        return visibility.overlap(self.limits, boxes.half)

    @functools.cached_property
    def _local_m(self) -> NDArray[np.float64]:
        """Positions relative to the first one; far from the origin, digits would cancel."""
        return self.position_m - self.position_m[0]

    @functools.cached_property
    def _runs(self) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """For each run, its representative position, and how far the others differ from it.

        The differences are the largest distance and the largest change of direction.
        """
        starts = np.arange(0, self.count, self.run)
        middle = np.minimum(starts + self.run // 2, self.count - 1)
        run = np.arange(self.count) // self.run
        around_m, spread = (
            np.maximum.reduceat(np.linalg.norm(each - each[middle[run]], axis=1), starts)
            for each in (self._local_m, self.along)
        )
        return middle, around_m, spread

    def _runs_touching(self, boxes: Boxes) -> NDArray[np.bool_]:
        """Return whether the beam may touch each box from anywhere in each run, [boxes, runs]."""
        middle, around_m, spread = self._runs
        centres_m = boxes.centres_m - self.position_m[0]
        visibility = Visibility.of(
            centres_m, boxes.axes_m, self._local_m[middle], self.along[middle]
        )
        return visibility.overlap(self.limits, boxes.half, around_m, spread) > 0

    def _members(self, run: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the numbers of the positions in runs, [runs, run]; the last position repeats."""
        return np.minimum(self.run * run[:, None] + np.arange(self.run), self.count - 1)

    def _spans(self, boxes: Boxes) -> tuple[NDArray[np.int64], ...]:
        """Return the fields of `spans` for a few boxes."""
        touched = self._runs_touching(boxes)
        ever = touched.any(axis=1)
        first_run = touched.argmax(axis=1)
        last_run = touched.shape[1] - 1 - touched[:, ::-1].argmax(axis=1)
        first, last = np.full(len(boxes), self.count), np.full(len(boxes), -1)
        for edge, start, stop, step in (
            (first, first_run, last_run, 1),
            (last, last_run, first_run, -1),
        ):
            some = np.flatnonzero(ever)
            run = start[some]
            while some.size:
                index = self._members(run)[:, ::step]
                inside = self.depth(boxes[some], index) > 0
                found = inside.any(axis=1)
                edge[some[found]] = index[found, inside[found].argmax(axis=1)]
                # A run may seem to touch a box although none of its positions does. Go on to the
                # next run.
                further = ~found & (run != stop[some])
                some, run = some[further], run[further] + step
        earliest = np.where(ever, self.run * first_run, self.count)
        latest = np.where(ever, np.minimum(self.run * (last_run + 1), self.count) - 1, -1)
        return first, last, earliest, latest


class Spans(NamedTuple):
    """The outermost positions whose beam touches each box, all int64 [boxes].

    Attributes
    ----------
    first, last : int64 [boxes]
        First and last position. `first` is greater than `last` where no position touches the box.
    earliest, latest : int64 [boxes]
        First and last position of the runs that may touch the box anywhere, also between their
        positions. `earliest` is greater than `latest` where none does.
    """

    first: NDArray[np.int64]
    last: NDArray[np.int64]
    earliest: NDArray[np.int64]
    latest: NDArray[np.int64]

    @property
    def ranges(self) -> NDArray[np.int32]:
        """First position and the one after the last, int32 [boxes, 2]; both 0 if none touches."""
        found = self.first <= self.last
        return np.where(found, [self.first, self.last + 1], 0).T.astype(np.int32)


def _sines(
    points_m: NDArray[np.float64], centres_m: NDArray[np.float64], along: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return sines of aspect angles (0 at distance 0) and distances, both [points, centres]."""
    origin_m = centres_m[0]  # keeps coordinates small; far from the origin, digits would cancel
    distance_m = cdist(points_m, centres_m)
    sine = (points_m - origin_m) @ along.T
    sine -= np.einsum("ci,ci->c", centres_m - origin_m, along)
    sine /= np.where(distance_m > 0, distance_m, np.inf)
    return sine, distance_m
