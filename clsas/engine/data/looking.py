"""Sides of the track: where the elements look, and which pixels of a grid lie behind them.

Ranges from a straight track do not distinguish port from starboard: every pixel has the same ranges
as its mirror image about the vertical plane through the track. Only the elements determine from
which of the two an echo came, because they neither transmit nor receive behind their face.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.findings import Finding
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, antennas_of, some_channels

MIRRORED = 0.01
"""Least share of a grid behind the elements that is reported."""

# Plain choices. A grid on the right side takes less than a millisecond, on the wrong one some.
_PIXELS = 1024  # sampled pixels
_CHANNELS = 64  # sampled channels that reach the grid
_SEARCHED = 4096  # channels among which those that reach the grid are searched
_HEADINGS = 100  # least pings of a track over the pings that a heading is averaged over
_LEAST_ACROSS = 0.1  # part of the look direction across the track, below which it has no side
_STRAIGHT = 0.1  # width of a track over its length, or over its distance from the grid
_NARROW_M = 1e-6  # width of a track that only rounding makes wider than zero
_ALIGNED = 0.05  # sine of the angle of a track to x or y up to which a mirrored plane is aligned


@dataclass(frozen=True, eq=False)
class _Mirror:
    """Vertical plane through a straight track.

    Attributes
    ----------
    point_m : float64 [3]
        A point of the plane.
    normal : float64 [3]
        Horizontal unit vector across the plane, towards the side where the elements look.
    width_m : float
        Width of the track, metres.
    """

    point_m: NDArray[np.float64]
    normal: NDArray[np.float64]
    width_m: float

    def image_of(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the mirror images of points, [..., 3]."""
        distance_m = (points_m - self.point_m) @ self.normal
        return points_m - 2 * distance_m[..., None] * self.normal

    def rounded(self) -> _Mirror:
        """Return the plane at a position rounded to a power of ten above the width of the track.

        It is also turned parallel to x or y if it nearly is.
        """
        point_m, normal = self.point_m, np.rint(self.normal)
        if self.width_m > _NARROW_M:
            point_m = point_m.round(-math.ceil(math.log10(self.width_m)))
        if np.abs(self.normal - normal).max() > _ALIGNED:
            normal = self.normal
        return _Mirror(point_m, normal, self.width_m)


def behind(
    lines: RangeLines, grid: Grid, last_range_m: NDArray[np.float64] | None = None
) -> Finding | None:
    """Return which part of a grid lies behind the elements, or None if hardly any does.

    A pixel counts if it lies behind the elements of every channel whose line reaches it, and its
    mirror image lies in front of them. Sampled pixels represent the grid. There is no result if the
    look direction is unknown, or if the track is not straight, since it has no mirror images then.

    Parameters
    ----------
    lines : RangeLines
    grid : Grid
    last_range_m : float64 [channels], optional
        Range of each channel's last sample, for lines that are geometry without samples.
    """
    if lines.look_direction is None:
        return None
    last_m = lines.last_range_m if last_range_m is None else last_range_m
    points_m = _sampled(grid)
    some = _reaching(lines, points_m, last_m)
    if not some.size:
        return None
    in_front = _in_front(lines, some, points_m)
    if in_front.all():
        return None
    range_m = pairwise_range_m(points_m, *antennas_of(lines, some))
    mirror = _mirror(lines, some, float(np.median(range_m)))
    if mirror is None:
        return None
    reached = (range_m >= lines.first_range_m[some]) & (range_m <= last_m[some])
    is_mirrored = _in_front(lines, some, mirror.image_of(points_m)) & ~in_front & reached
    is_seen = (in_front & reached).any(axis=1)
    share = float((is_mirrored.any(axis=1) & ~is_seen).mean())
    return _described(lines, grid, mirror, share) if share >= MIRRORED else None


def _reaching(
    lines: RangeLines, points_m: NDArray[np.float64], last_m: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Return a few channels whose lines are long enough to reach a box around points."""
    searched = some_channels(lines.channels, _SEARCHED)
    centres_m = (lines.tx_m[searched] + lines.rx_m[searched]) / 2
    low_m, high_m = points_m.min(axis=0), points_m.max(axis=0)
    outside_m = np.maximum(np.maximum(low_m - centres_m, centres_m - high_m), 0)
    near = searched[np.linalg.norm(outside_m, axis=1) <= last_m[searched]]
    return near[some_channels(len(near), _CHANNELS)] if near.size else near


def _sampled(grid: Grid) -> NDArray[np.float64]:
    """Return positions of pixels in the middle of equal parts of the grid, [n, 3]."""
    most = max(round(_PIXELS ** (1 / len(grid.shape))), 1)
    indices = []
    for count in grid.shape:
        parts = min(most, count)
        indices.append(((np.arange(parts) + 0.5) * count / parts).astype(np.int64))
    return grid.at(np.ravel_multi_index(np.ix_(*indices), grid.shape).ravel())


def _in_front(
    lines: RangeLines, some: NDArray[np.int64], points_m: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return which points lie in front of the elements of channels, bool [points, channels]."""
    assert lines.look_direction is not None
    look = lines.look_direction[some]
    centres_m = (lines.tx_m[some] + lines.rx_m[some]) / 2
    origin_m = centres_m[0]  # differences of UTM coordinates lose no digits
    ahead_m = (points_m - origin_m) @ look.T
    return ahead_m > np.einsum("ci,ci->c", centres_m - origin_m, look)


def _mirror(lines: RangeLines, some: NDArray[np.int64], range_m: float) -> _Mirror | None:
    """Return the vertical plane through the track of some channels; None if there is none.

    `range_m` is the distance of the grid.
    """
    assert lines.look_direction is not None
    look = lines.look_direction[some, :2].mean(axis=0)
    centres_m = (lines.tx_m[some] + lines.rx_m[some]) / 2
    point_m = centres_m.mean(axis=0)
    offsets_m = (centres_m - point_m)[:, :2]
    _, sizes_m, axes = np.linalg.svd(offsets_m, full_matrices=True)
    long_m = float(sizes_m[0])
    across = look
    if long_m > 0 and (len(sizes_m) < 2 or sizes_m[1] <= _STRAIGHT * long_m):
        across = np.array([-axes[0, 1], axes[0, 0]])
        across = across * (look @ across)
    length = float(np.linalg.norm(across))
    if length < _LEAST_ACROSS:
        return None
    across = across / length
    width_m = float(np.ptp(offsets_m @ across))
    if width_m > _STRAIGHT * max(float(np.ptp(offsets_m @ axes[0])), range_m):
        return None
    return _Mirror(point_m, np.append(across, 0.0), width_m)


def side_of(lines: RangeLines, direction: NDArray[np.float64]) -> str:
    """Return the side of the track to which horizontal directions point.

    Parameters
    ----------
    lines : RangeLines
    direction : float64 [3] or [channels, 3]

    Returns
    -------
    str
        "port", "starboard" or "both sides"; "" if the directions point neither way, or the platform
        does not move.
    """
    places_m = lines.ping_centres_m[:, :2]
    ping = np.arange(len(places_m))
    apart = len(places_m) // _HEADINGS + 1
    heading = places_m[np.minimum(ping + apart, ping[-1])] - places_m[np.maximum(ping - apart, 0)]
    some = some_channels(lines.channels, _SEARCHED)
    of_channel = heading[lines.ping_numbers[some]]
    port = np.stack([-of_channel[:, 1], of_channel[:, 0]], axis=-1)
    to_port = np.einsum("ci,ci->c", port, np.broadcast_to(direction, lines.tx_m.shape)[some, :2])
    to_port = to_port[np.abs(to_port) > _LEAST_ACROSS * np.linalg.norm(port, axis=1)]
    if 2 * len(to_port) < len(some):
        return ""
    if (share := float((to_port > 0).mean())) > 1 - _LEAST_ACROSS:
        return "port"
    return "starboard" if share < _LEAST_ACROSS else "both sides"


def _described(lines: RangeLines, grid: Grid, mirror: _Mirror, share: float) -> Finding:
    """Return a part of a grid that lies behind the elements, in words."""
    part = "the whole grid lies" if share > 0.995 else f"{100 * share:.0f} % of the grid lies"
    opposite = {"port": "starboard", "starboard": "port"}
    side = side_of(lines, mirror.normal)
    if side in opposite:
        message = f"{part} to {opposite[side]} of the track, but the elements look to {side}"
    else:
        message, side = f"{part} behind the elements", "other"
    message += f". Pixels there only show the mirror image of the {side} side"
    remedy = f"keep the grid on the {side} side"
    if share >= 0.5:
        remedy = _mirrored(grid, mirror.rounded())
    return Finding("grid_behind", message, share, MIRRORED, remedy)


def _mirrored(grid: Grid, mirror: _Mirror) -> str:
    """Return advice to use the mirror image of a grid, as options of commands if it has axes."""
    if not grid.is_planar:
        (x_m, y_m, _), (across_x, across_y, _) = mirror.point_m, mirror.normal
        return (
            f"mirror the grid about the vertical plane through ({x_m:.6g}, {y_m:.6g}) m with the "
            f"normal ({across_x:.4g}, {across_y:.4g})"
        )
    origin_m, *steps_m = grid.vectors_m
    rows, columns = grid.shape
    if grid.has_axes and np.abs(mirror.normal).max() == 1:
        height = f" --z={origin_m[2]:.10g}" if origin_m[2] else ""
        x, y = (_option(grid, mirror, axis, n) for axis, n in enumerate((columns, rows)))
        return f"use the mirrored grid, {x} {y}{height}"
    vectors_m = [mirror.image_of(origin_m)]
    vectors_m += [step - 2 * (step @ mirror.normal) * mirror.normal for step in steps_m]
    origin, row_step, column_step = (
        "[" + ", ".join(f"{value:.8g}" for value in vector + 0.0) + "]" for vector in vectors_m
    )
    return (
        f"use the mirrored grid, origin_m = {origin}, row_step_m = {row_step}, "
        f"column_step_m = {column_step}, shape = [{rows}, {columns}]"
    )


def _option(grid: Grid, mirror: _Mirror, axis: int, count: int) -> str:
    """Return the option --x (axis 0) or --y (axis 1) of a mirrored grid.

    A mirrored axis ascends, and is rounded to a tenth of a pixel.
    """
    places_m = grid.axes_m[axis]
    ends_m = [float(places_m[0]), float(places_m[-1])]
    if mirror.normal[axis]:
        step_m = abs(ends_m[1] - ends_m[0]) / max(count - 1, 1) or 1.0
        digits = math.ceil(-math.log10(step_m / 10))
        ends_m = sorted(
            round(2 * float(mirror.point_m[axis]) - end, digits) + 0.0 for end in ends_m
        )
    return f"--{'xy'[axis]}={ends_m[0]:.10g}:{ends_m[1]:.10g}:{count}"
