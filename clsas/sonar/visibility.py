"""Visibility: which channels see a point, a ball or a box through a beam."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from clsas.core.lines import RangeLines
from clsas.sonar.beam import BeamWindow

_ROUNDING = 1e-5  # more than the device's rounding error of a sine
_RUN = 16  # channels tested together first


def sines(
    points_m: NDArray[np.float64],
    phase_centres_m: NDArray[np.float64],
    along: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the sine of every point's aspect angle at every channel, float64 [channels, points].

    The sine is 0 at the phase centre itself.

    Parameters
    ----------
    points_m : float64 [points, 3]
    phase_centres_m, along : float64 [channels, 3]
        Phase centres and the track's unit directions.
    """
    return _sines(points_m, phase_centres_m, along)[0].T


def channel_ranges(
    beam: BeamWindow,
    lines: RangeLines,
    along: NDArray[np.float64],
    centres_m: NDArray[np.float64],
    radius_m: float,
) -> NDArray[np.int32]:
    """Return the range of channels whose beam touches each of some balls, int32 [balls, 2].

    A range is the first of these channels and the one after the last, or 0, 0 if there is none.
    Runs of 16 channels are tested first, then the single channels of the runs at both ends.

    Parameters
    ----------
    beam : BeamWindow
    lines : RangeLines
    along : float64 [channels, 3]
        The track's unit directions.
    centres_m : float64 [balls, 3]
    radius_m : float
        Radius of every ball.
    """
    phase_centres_m = lines.phase_centres_m
    count, run = lines.channels, _RUN
    starts = np.arange(0, count, run)
    run_of = np.arange(count) // run
    # One channel in the middle stands for a run. The margins are how far the others lie from it
    # and how much their directions differ.
    middle_m = np.add.reduceat(phase_centres_m, starts, axis=0) / np.bincount(run_of)[:, None]
    reach_m = np.linalg.norm(phase_centres_m - middle_m[run_of], axis=1)
    direction = along[starts]
    spread = np.linalg.norm(along - direction[run_of], axis=1)
    sine, distance_m = _sines(centres_m, middle_m, direction)
    visible = _touches(
        beam,
        sine,
        distance_m,
        radius_m + np.maximum.reduceat(reach_m, starts),
        np.maximum.reduceat(spread, starts),
    )
    some = np.flatnonzero(visible.any(axis=1))
    ranges = np.zeros((len(centres_m), 2), np.int32)
    if not some.size:
        return ranges
    visible = visible[some]

    def touched(runs: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Channels of one run per ball that touch it, [balls, 16]; the last channel is repeated."""
        index = np.minimum(runs[:, None] * run + np.arange(run), count - 1)
        square, sine = np.zeros(index.shape), np.zeros(index.shape)
        for axis in range(3):
            offset_m = centres_m[some, axis, None] - phase_centres_m[index, axis]
            sine += offset_m * along[index, axis]
            square += offset_m * offset_m
        distance_m = np.sqrt(square)
        return _touches(beam, sine / np.maximum(distance_m, 1e-30), distance_m, radius_m)

    first = visible.argmax(axis=1)
    last = len(starts) - 1 - visible[:, ::-1].argmax(axis=1)
    inside = touched(first)
    begin = run * first + np.where(inside.any(axis=1), inside.argmax(axis=1), run)
    inside = touched(last)
    end = run * (last + 1) - np.where(inside.any(axis=1), inside[:, ::-1].argmax(axis=1), run)
    end = np.minimum(end, count)
    ranges[some, 0] = np.where(begin < end, begin, 0)
    ranges[some, 1] = np.where(begin < end, end, 0)
    return ranges


@dataclass(frozen=True, eq=False)
class Visibility:
    """Aspect angles of points, and of boxes around them, from positions on a track.

    Attributes
    ----------
    sine, inverse_m : float64 [points, positions]
        Sine of the aspect angle of a point, and one over its distance.
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
        index: NDArray[np.int64] | None = None,
    ) -> Visibility:
        """Return the visibility of points from positions on a track.

        Parameters
        ----------
        points_m : float64 [points, 3]
        axes_m : float64 [axes, 3]
        track_m, along : float64 [track positions, 3]
            Positions on the track, and its unit direction there.
        index : int64 [points, positions], optional
            Track positions to evaluate for each point. All, unless given.
        """
        changes = along @ axes_m.T  # [:, axes]
        slopes: Any  # an array, or a list of them
        changed: Any
        if index is None:
            sine, distance_m = _sines(points_m, track_m, along)
            slopes = (axes_m @ points_m.T)[..., None] - (axes_m @ track_m.T)[:, None]
            changed = changes.T
        else:
            sine, square = np.zeros(index.shape), np.zeros(index.shape)
            for point_m, from_m, direction in zip(points_m.T, track_m.T, along.T, strict=True):
                offset_m = point_m[:, None] - from_m[index]
                sine += offset_m * direction[index]
                square += offset_m * offset_m
            distance_m = np.sqrt(square)
            sine /= np.maximum(distance_m, 1e-9)
            towards_m = axes_m @ points_m.T
            slopes = [
                each[:, None] - from_m[index]
                for each, from_m in zip(towards_m, axes_m @ track_m.T, strict=True)
            ]
            changed = [each[index] for each in changes.T]
        inverse_m = 1 / np.maximum(distance_m, 1e-9, out=distance_m)
        for slope, change in zip(slopes, changed, strict=True):
            slope *= inverse_m
            slope *= sine
            np.subtract(change, slope, out=slope)
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
        """Depth by which boxes around the points may reach into a beam, [points, positions].

        The depth is an upper bound in sine of the aspect angle. It is negative where no part of
        the box lies in the beam.

        Parameters
        ----------
        limits : (low, high)
            Sines of the aspect angle at which the beam begins and ends.
        half : float64 [axes]
            Half the boxes' sides, in lengths of the axes.
        around_m, spread : float or float64 [positions]
            A position stands for others within this distance, whose directions differ from its
            own by a vector of at most this length.
        """
        radius_m = np.linalg.norm(np.abs(half[:, None] * self.axes_m).sum(axis=0))
        reach = radius_m * self.inverse_m
        reach *= reach
        for each, slope in zip(half, self.slopes, strict=True):
            reach += each * slope
        low, high = limits
        if np.any(around_m) or np.any(spread):
            ratio = np.minimum(around_m * self.inverse_m, 0.5)
            # Seen from closer, the box fills a larger angle. From half the distance it may lie
            # in any direction.
            reach = (reach + ratio + ratio**3) / (1 - ratio) + spread
            reach[ratio == 0.5] = np.inf
        # The depth past the nearer limit, which is the smaller of the two depths.
        reach -= np.abs(self.sine - (low + high) / 2)
        reach += (high - low) / 2
        return reach


def touches_boxes(
    limits: tuple[float, float],
    centres_m: NDArray[np.float64],
    half_m: NDArray[np.float64],
    track_m: NDArray[np.float64],
    along: NDArray[np.float64],
    around_m: float | NDArray[np.float64] = 0.0,
    spread: float | NDArray[np.float64] = 0.0,
) -> NDArray[np.bool_]:
    """Return which boxes a beam may touch from which positions, bool [boxes, positions].

    Parameters
    ----------
    limits : (low, high)
        Sines of the aspect angle at which the beam begins and ends.
    centres_m : float64 [boxes, 3]
    half_m : float64 [axes, 3]
        Half the boxes' sides, as vectors.
    track_m, along : float64 [positions, 3]
        Positions on the track, and its unit direction there.
    around_m, spread : float or float64 [positions]
        What each position stands for; see `Visibility.overlap`.
    """
    visibility = Visibility.of(centres_m, half_m, track_m, along)
    return visibility.overlap(limits, np.ones(len(half_m)), around_m, spread) > 0


def _sines(
    points_m: NDArray[np.float64], centres_m: NDArray[np.float64], along: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sines of aspect angles (0 at distance 0) and distances, both [points, centres]."""
    origin_m = centres_m[0]  # keeps coordinates small, which far from the origin would cancel
    distance_m = cdist(points_m, centres_m)
    sine = (points_m - origin_m) @ along.T
    sine -= np.einsum("ci,ci->c", centres_m - origin_m, along)
    sine /= np.where(distance_m > 0, distance_m, np.inf)
    return sine, distance_m


def _touches(
    beam: BeamWindow,
    sine: NDArray[np.float64],
    distance_m: NDArray[np.float64],
    radius_m: float | NDArray[np.float64],
    spread: float | NDArray[np.float64] = 0.0,
) -> NDArray[np.bool_]:
    """Return where a beam may touch a ball whose centre lies at a sine and a distance.

    `spread` is the largest change of the track's unit direction, as the length of a vector.
    """
    low, high = beam.limits
    ratio = radius_m / np.maximum(distance_m, 1e-30)
    # The direction to a point of the ball differs from that to its centre by at most asin(ratio).
    # The unit vectors then differ by the chord of that angle.
    wider = ratio * (1 + 0.42 * ratio * ratio) + (spread + _ROUNDING)
    return (ratio >= 1) | ((sine + wider > low) & (sine - wider < high))
