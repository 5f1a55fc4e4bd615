"""Coverage: which of a grid's pixels lines can show at all.

A pixel is reached if it lies in the beam, and within the range, of some channel's line. It also has
to lie in front of the elements. Ranges from a straight track do not distinguish port from
starboard: every pixel has the same ranges as its mirror image about the vertical plane through the
track. Only the elements determine from which of the two an echo came, because they neither transmit
nor receive behind their face.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.findings import Finding
from clsas.engine.data.geometry import STRAIGHT, pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, antennas_of, reached_m, some_channels
from clsas.engine.data.visibility import BeamTrack, Boxes, is_within, sines

MIRRORED = 0.01
"""Least share of a grid behind the elements that is reported."""

# Channels in the quick test of `reaches`, which finds that nearly every grid is covered.
_SAMPLED_CHANNELS = 64
_BLOCKS = 8  # along either side of the grid; smaller blocks would find smaller gaps

# Of `behind`. Plain choices: a grid on the right side takes less than a millisecond, on the wrong
# one some.
_PIXELS = 1024  # sampled pixels
_CHANNELS = 64  # sampled channels that reach the grid
_SEARCHED = 4096  # channels among which those that reach the grid are searched
_HEADINGS = 100  # least pings of a track over the pings that a heading is averaged over
_LEAST_ACROSS = 0.1  # part of the look direction across the track, below which it has no side
_NARROW_M = 1e-6  # width of a track that only rounding makes wider than zero
_ALIGNED = 0.05  # sine of the angle of a track to x or y up to which a mirrored plane is aligned

_Span = tuple[float, float]  # nearest and farthest range, metres


class UnreachedWarning(validate.ClsasWarning):
    """Warning that no line contributes to any pixel, so that the image is zero."""


def reaches(
    lines: RangeLines, grid: Grid, beam: BeamWindow | None, along: NDArray[np.float64] | None
) -> bool:
    """Return False only if certainly no pixel lies in the beam and within the range of any line.

    `along` contains the unit directions of the track, [channels, 3]; it is None without a beam.
    """
    # The quick test: does any sampled channel receive from any sampled pixel?
    some = some_channels(lines.channels, _SAMPLED_CHANNELS)
    points_m = grid.spread()
    range_m = pairwise_range_m(points_m, *antennas_of(lines, some))
    inside = (range_m >= lines.first_range_m[some]) & (range_m <= lines.last_range_m[some])
    track = None
    if beam is not None and along is not None:
        track = BeamTrack(beam.limits, lines.phase_centres_m, along)
        sine = sines(points_m, track.position_m[some], along[some]).T
        inside &= is_within(sine, beam.limits)
    if inside.any():
        return True

    # The full test: may any channel receive from any of the boxes that contain the pixels?
    for centre_m, sides_m in zip(*_boxes(grid), strict=True):
        near_m, far_m = reached_m(lines, centre_m, np.diag(sides_m))
        reached = (far_m >= lines.first_range_m) & (near_m <= lines.last_range_m)
        if track is not None and reached.any():
            reached &= track.touching(Boxes.equal(centre_m[None], np.diag(sides_m)))[0]
        if reached.any():
            return True
    return False


def _boxes(grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return centres and half sides along x, y and z, [boxes, 3], of boxes around all pixels."""
    parts = []
    for count in grid.shape[:2]:
        edges = np.unique(np.linspace(0, count, min(count, _BLOCKS) + 1).astype(np.int64))
        parts.append([slice(first, last) for first, last in itertools.pairwise(edges)])
    ends_m = []
    for part in itertools.product(*parts):
        block = grid.window(*part)
        if block.is_planar:
            block = block.window(*(slice(None, None, max(n - 1, 1)) for n in block.shape))
        positions_m = block.positions_m().reshape(-1, 3)
        ends_m.append((positions_m.min(axis=0), positions_m.max(axis=0)))
    low_m, high_m = np.array(ends_m).swapaxes(0, 1)
    return (low_m + high_m) / 2, (high_m - low_m) / 2


def warn_unreached(
    lines: RangeLines,
    grid: Grid,
    beam: BeamWindow | None,
    along: NDArray[np.float64] | None,
    lines_m: _Span | None = None,
) -> None:
    """Warn that no line contributes to a grid; name the distances and the likely cause.

    Lines that are all zero cause no warning. `lines_m` is the nearest and the farthest range of
    lines that are geometry without samples.
    """
    if lines_m is None:
        if not lines.samples.any():
            return
        lines_m = float(lines.first_range_m.min()), float(lines.last_range_m.max())
    some = some_channels(lines.channels, _SAMPLED_CHANNELS)
    points_m = grid.spread()
    range_m = pairwise_range_m(points_m, *antennas_of(lines, some))
    where = (
        f"the lines span {lines_m[0]:.6g} to {lines_m[1]:.6g} m, the grid lies at "
        f"{range_m.min():.6g} to {range_m.max():.6g} m"
    )
    if beam is not None and along is not None:
        sine = sines(points_m, lines.phase_centres_m[some], along[some])
        low, high = np.degrees(np.arcsin(np.clip([sine.min(), sine.max()], -1, 1)))
        first, last = np.degrees(beam.limits_rad)
        where = (
            f"the beam spans {first:.4g} to {last:.4g} degrees, the grid lies at {low:.4g} to "
            f"{high:.4g} degrees; {where}"
        )
    within = "any line's range" if beam is None else "the beam and the range of any line"
    validate.warn(
        f"no pixel of the grid lies within {within}, so the image is zero: {where}. "
        f"{_likely_cause(lines, points_m, some, lines_m)}",
        UnreachedWarning,
    )


def _likely_cause(
    lines: RangeLines, points_m: NDArray[np.float64], some: NDArray[np.int64], lines_m: _Span
) -> str:
    """Return the probable mistake, found by assuming that the grid is in other units."""

    def fits(factor: float) -> bool:
        range_m = pairwise_range_m(factor * points_m, *antennas_of(lines, some))
        return bool(((range_m >= lines_m[0]) & (range_m <= lines_m[1])).any())

    if fits(1.0):
        return "Check the width and squint of the beam, and the grid's position along the track"
    for factor, unit in ((1e3, "km"), (1e-3, "mm")):
        if fits(factor):
            return f"The grid would be reached if it were in {unit}: lengths must be given in m"
    return "Check the grid, the positions of the antennas and `first_range_m`, all in m"


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
    if long_m > 0 and (len(sizes_m) < 2 or sizes_m[1] <= STRAIGHT * long_m):
        across = np.array([-axes[0, 1], axes[0, 0]])
        across = across * (look @ across)
    length = float(np.linalg.norm(across))
    if length < _LEAST_ACROSS:
        return None
    across = across / length
    width_m = float(np.ptp(offsets_m @ across))
    if width_m > STRAIGHT * max(float(np.ptp(offsets_m @ axes[0])), range_m):
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
