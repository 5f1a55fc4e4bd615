"""Two-way delays along exact rays, of pairs of channels and points and of a sample of a scene."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.geometry import SAME_PLACE_M, pairwise_range_m
from clsas.engine.data.grid import Grid, spread_indices
from clsas.engine.data.lines import RangeLines, some_channels
from clsas.engine.data.sound_speed import SoundSpeed
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.visibility import is_within, sines
from clsas.engine.water.rays import Rays, rays, shadow
from clsas.engine.water.thinning import FEW, vertical_errors_s

POINTS = 9
"""Number of sample pixels along either side of a grid; points without rows have its square."""

_PARTS = 8  # along either side of a grid, whose highest and lowest pixels are sampled as well

OneWay = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]

_SAME_S = 1e-12  # differences of delays up to which no slope follows from them
_CHANNELS = 48  # sample channels, beside the first, the last, and those at extreme heights
_LEVEL = 1e-2  # sine of an angle below which rays count as level
_BEYOND_BEAM = 0.05  # sine by which a sample pixel may lie outside the beam


def at_speed(lines: RangeLines, sound_speed_m_s: float) -> RangeLines:
    """Return the same lines over ranges of another speed of sound, without a profile."""
    scale = sound_speed_m_s / lines.sound_speed_m_s
    return replace(
        lines,
        first_range_m=lines.first_range_m * scale,
        range_step_m=lines.range_step_m * scale,
        sound_speed_m_s=sound_speed_m_s,
        sound_speed=None,
    )


def delays_s(
    lines: RangeLines,
    channels: NDArray[np.int64],
    points_m: NDArray[np.float64],
    one_way_s: OneWay | None = None,
) -> NDArray[np.float64]:
    """Return the two-way delays along exact rays of pairs of channels and points, [n], seconds.

    Parameters
    ----------
    lines : RangeLines
        Lines with a profile.
    channels : int64 [n]
    points_m : float64 [n, 3]
    one_way_s : callable, optional
        Function that returns the travel times between points and antennas, [n, 3] each, infinite
        where there is no ray [`traced_s`, which raises ValueError there].
    """
    if one_way_s is None:
        assert lines.sound_speed is not None
        one_way_s = partial(traced_s, lines.sound_speed)
    tx_m, rx_m, velocity = lines.tx_m[channels], lines.rx_m[channels], lines.rx_velocity_m_s
    out_s = one_way_s(points_m, tx_m)
    if velocity is None:
        return out_s + (out_s if np.array_equal(tx_m, rx_m) else one_way_s(points_m, rx_m))

    def arrived_s(flight_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the delays to where receivers are after some time."""
        flight_s = np.where(np.isfinite(flight_s), flight_s, 0.0)
        return out_s + one_way_s(points_m, rx_m + velocity[channels] * flight_s[:, None])

    # Delays change little, and almost linearly, with this time: a secant finds where they agree.
    first_s = arrived_s(2 * out_s)
    second_s = arrived_s(first_s)
    with np.errstate(invalid="ignore"):  # where there is no ray
        step_s = first_s - 2 * out_s
        ratio = np.divide(
            second_s - first_s, step_s, out=np.zeros_like(step_s), where=np.abs(step_s) > _SAME_S
        )
        return first_s + (second_s - first_s) / (1 - ratio)


def traced_s(
    profile: SoundSpeed, points_m: NDArray[np.float64], antennas_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the travel times between pairs of points and antennas, [n], seconds."""
    distance_m = np.hypot(*(points_m[:, :2] - antennas_m[:, :2]).T)
    return times_s(profile, distance_m, antennas_m[:, 2], points_m[:, 2])


def times_s(
    profile: SoundSpeed,
    distance_m: NDArray[np.float64],
    one_z_m: NDArray[np.float64],
    other_z_m: NDArray[np.float64] | float,
) -> NDArray[np.float64]:
    """Return the travel times between heights; arguments broadcast as those of `rays_between`.

    What thinning the profile left out is added. By Fermat's principle, rays of the thinned profile
    serve for the given one. Where a ray falls at an angle, its time errs by the vertical error over
    the sine, at the lower end less the upper.
    """
    found = rays_between(profile, distance_m, one_z_m, other_z_m)
    time_s = found.time_s
    if len(profile.depth_m) <= FEW:
        return time_s
    for z_m, slope_s_m in (one_z_m, found.one_slope_s_m), (other_z_m, found.other_slope_s_m):
        sine = -slope_s_m * profile.at(z_m)
        error_s = np.broadcast_to(vertical_errors_s(profile, z_m), sine.shape)
        time_s = time_s + np.divide(
            error_s, sine, out=np.zeros_like(sine), where=np.abs(sine) > _LEVEL
        )
    return time_s


def rays_between(
    profile: SoundSpeed,
    distance_m: NDArray[np.float64],
    one_z_m: NDArray[np.float64],
    other_z_m: NDArray[np.float64] | float,
) -> Rays:
    """Return the rays between heights at some distances.

    Raises
    ------
    ValueError
        If no direct ray connects a pair.
    """
    found = rays(profile, distance_m, one_z_m, other_z_m)
    if not found.exists.all():
        dark = ~found.exists
        distance, one_z, other_z = (
            np.broadcast_to(each, dark.shape)[dark] for each in (distance_m, one_z_m, other_z_m)
        )
        nearest = distance.argmin()
        why = shadow(profile, *(float(each[nearest]) for each in (distance, one_z, other_z)))
        raise ArgumentError("sound_speed", "lead a direct ray to every pixel", hint=why)
    return found


def in_beam(
    lines: RangeLines,
    points_m: NDArray[np.float64],
    beam: BeamWindow,
    along: NDArray[np.float64],
    slack_m: float,
) -> NDArray[np.bool_]:
    """Return which points may lie in the beam of channels, [points, channels].

    Parameters
    ----------
    lines : RangeLines
    points_m : float64 [points, 3]
    beam : BeamWindow
    along : float64 [channels, 3]
        Directions of the beam.
    slack_m : float
        Distance from a point within which pixels count as well.
    """
    sine = sines(points_m, lines.phase_centres_m, along).T
    around = _BEYOND_BEAM + slack_m / np.maximum(straight_m(lines, points_m), SAME_PLACE_M)
    return is_within(sine, beam.limits, around)


@dataclass(frozen=True, eq=False)
class RaySample:
    """Sample pixels and channels with their exact ranges, [points, channels].

    Attributes
    ----------
    lines : RangeLines
        Lines of the sample channels, with the profile.
    channels : int64 [channels]
    pixels : int64 [points]
        Indices of the pixels.
    points_m : float64 [points, 3]
        Their positions.
    visible : bool
        False for pixels outside the beam or beyond the ends of a line.
    delay_s : float64
        Two-way delays along exact rays; 0 where not visible.
    """

    lines: RangeLines
    channels: NDArray[np.int64]
    pixels: NDArray[np.int64]
    points_m: NDArray[np.float64]
    visible: NDArray[np.bool_]
    delay_s: NDArray[np.float64]

    @classmethod
    def of(cls, lines: RangeLines, grid: Grid, beam: BeamWindow | None) -> RaySample:
        """Return a sample of lines and grid.

        Raises
        ------
        ValueError
            If no direct ray connects a visible pair.
        """
        extreme = [f(each[:, 2]) for each in (lines.tx_m, lines.rx_m)
                   for f in (np.argmin, np.argmax)]  # fmt: skip
        some = np.union1d(
            some_channels(lines.channels, _CHANNELS), [0, lines.channels - 1, *extreme]
        ).astype(np.int64)
        part, pixels = lines.select(some), sample_pixels(grid)
        points_m = grid.at(pixels)
        assert part.sound_speed is not None
        # Sound is faster or slower than the nominal speed, and pixels lie around the sample.
        range_m = straight_m(part, points_m)
        ratio = part.sound_speed_m_s / part.sound_speed.speed_m_s
        slack_m = float(np.ptp(points_m, axis=0).max()) / max(POINTS - 1, 1)
        visible = range_m * ratio.max() + slack_m >= part.first_range_m
        visible &= range_m * ratio.min() - slack_m <= part.last_range_m
        if beam is not None:
            visible &= in_beam(part, points_m, beam, beam.directions(lines)[some], slack_m)
        delay_s = np.zeros(visible.shape)
        point, channel = np.nonzero(visible)
        delay_s[visible] = delays_s(part, channel, points_m[point])
        return cls(part, some, pixels, points_m, visible, delay_s)

    @property
    def distances_m(self) -> NDArray[np.float64]:
        """Horizontal distances of the points from the phase centres."""
        offset = self.points_m[:, None, :2] - self.lines.phase_centres_m[:, :2]
        return np.hypot(offset[..., 0], offset[..., 1])

    @property
    def middle_m(self) -> NDArray[np.float64]:
        """Middle of the visible distances, [1]."""
        distance = self.distances_m[self.visible]
        return np.array([max((distance.min() + distance.max()) / 2, 1e-3)])

    @property
    def centre_m(self) -> NDArray[np.float64]:
        """Middle of the pixels that are visible, x and y."""
        seen_m = self.points_m[self.visible.any(axis=1), :2]
        return (seen_m.min(axis=0) + seen_m.max(axis=0)) / 2

    def middles_m(self, lines: RangeLines) -> NDArray[np.float64]:
        """Return the distance of every channel from the middle of the grid, [channels]."""
        distance = self.distances_m[self.visible]
        offset_m = lines.phase_centres_m[:, :2] - self.centre_m
        return np.clip(np.hypot(*offset_m.T), max(distance.min(), 1e-3), distance.max())

    def error(self, lines: RangeLines, range_m: NDArray[np.float64]) -> float:
        """Return the mean squared phase error of the worst pixel if its ranges are others.

        Parameters
        ----------
        lines : RangeLines
            Lines in which the ranges apply.
        range_m : float64 [points, channels]

        Returns
        -------
        float
            Mean over the channels that see the pixel, rad^2: its relative error power.
        """
        square = np.where(
            self.visible, (2 * range_m / lines.sound_speed_m_s - self.delay_s) ** 2, 0.0
        )
        seen = np.maximum(np.count_nonzero(self.visible, axis=1), 1)
        highest_hz = lines.highest_cycles_per_m * lines.sound_speed_m_s / 2
        return float((2 * np.pi * highest_hz) ** 2 * (square.sum(axis=1) / seen).max())


def sample_pixels(grid: Grid) -> NDArray[np.int64]:
    """Return the indices of sample pixels, [n].

    They are spread evenly, edges included. On a grid with relief, the highest and the lowest pixel
    of each of 64 parts follow, so that no rock lies unseen between the others.
    """
    spread = spread_indices(grid, POINTS if len(grid.shape) == 2 else POINTS**2)
    if grid.is_planar:
        return spread
    height_m = grid.height_m if grid.points_m is None else grid.points_m[..., 2]
    assert height_m is not None
    number = np.arange(grid.size).reshape(grid.shape)
    sides = [min(n, _PARTS if len(grid.shape) == 2 else _PARTS**2) for n in grid.shape]
    slices = [
        [slice(i * n // side, (i + 1) * n // side) for i in range(side)]
        for n, side in zip(grid.shape, sides, strict=True)
    ]
    extreme = [
        number[part].flat[find(height_m[part])]
        for part in itertools.product(*slices)
        for find in (np.argmax, np.argmin)
    ]
    return np.union1d(spread, extreme)


def straight_m(lines: RangeLines, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ranges along straight rays, [points, channels], metres."""
    return pairwise_range_m(
        points_m, lines.tx_m, lines.rx_m, lines.rx_velocity_m_s, lines.sound_speed_m_s
    )
