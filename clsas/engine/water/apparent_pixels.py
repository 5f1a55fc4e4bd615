"""Apparent pixels: where the pixels of a relief lie in homogeneous water."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.sound_speed import SoundSpeed
from clsas.engine.data.threads import cores, in_threads
from clsas.engine.water.apparent_antennas import Change
from clsas.engine.water.ray_delays import RaySample
from clsas.engine.water.ray_times import RayTimes
from clsas.engine.water.rays import rays

_MOVED_AT_ONCE = 1 << 15  # pixels whose apparent positions are found together; bounds memory
_AROUND = 0.02  # share of a distance, over which the curvature of rays is measured


def apparent_grid(grid: Grid, lines: RangeLines, sample: RaySample, change: Change) -> Grid:
    """Return a grid with apparent positions of the pixels, for directions right at its middle.

    In a linear gradient, rays near the horizontal are parabolas, straight in coordinates that bend
    with them. Verticals converge there. A pixel at height h above the level therefore moves away
    from the middle of the grid horizontally by h/R times its distance, where R is the radius of the
    rays. It moves vertically so that the delay to the nearest channel is right.
    """
    profile = lines.sound_speed
    assert profile is not None
    # A track at the usual heights, from which each pixel is seen by a channel at the nearest place.
    usual = int(np.argsort(lines.phase_centres_m[:, 2])[lines.channels // 2])
    level = _at_heights(lines, float(lines.tx_m[usual, 2]), float(lines.rx_m[usual, 2]))
    middles_m = sample.middles_m(lines)
    if np.ptp(lines.tx_m[:, 2]) or np.ptp(lines.rx_m[:, 2]):
        change = Change.of(level, sample, None, middles_m)
    centres_m = level.phase_centres_m
    moved_m = grid.positions_m().reshape(-1, 3).copy()
    distance_m, nearest = cKDTree(centres_m[:, :2]).query(moved_m[:, :2], workers=cores())
    bend = _curvature(profile, float(np.median(distance_m)), level.tx_m[0, 2], change.level_m)
    limits = [(float(each.min()), float(each.max())) for each in (distance_m, moved_m[:, 2])]
    times = RayTimes(profile, limits[0], limits[1], expected=grid.size)
    real_z_m = [float(each[0, 2]) for each in (level.tx_m, level.rx_m)]

    def move(first: int) -> None:
        some = slice(first, first + _MOVED_AT_ONCE)
        z_m = moved_m[some, 2]
        delay_s = np.sum([times.between(distance_m[some], z, z_m) for z in real_z_m], axis=0)
        # The sample shows that there are rays to all pixels that channels see. Others stay near.
        straight_s = 2 * distance_m[some] / change.sound_speed_m_s
        delay_s = np.where(np.isfinite(delay_s), delay_s, straight_s)
        channel, away_m = nearest[some], moved_m[some, :2] - sample.centre_m
        moved_m[some, :2] += bend * (z_m - change.level_m)[:, None] * away_m
        range_m = change.ranges_m(channel, delay_s[:, None])[:, 0]
        aside_m = np.linalg.norm(moved_m[some, :2] - centres_m[channel, :2], axis=1)
        apparent_z_m = change.tx_z_m[channel], change.rx_z_m[channel]
        moved_m[some, 2] = _heights(range_m, aside_m, apparent_z_m, change.level_m)

    for _ in in_threads(move, range(0, len(moved_m), _MOVED_AT_ONCE)):
        pass
    return Grid.points(moved_m.reshape(*grid.shape, 3), georeference=grid.georeference)


def _heights(
    range_m: NDArray[np.float64],
    aside_m: NDArray[np.float64],
    antennas_z_m: tuple[NDArray[np.float64], NDArray[np.float64]],
    level_m: float,
) -> NDArray[np.float64]:
    """Return heights at some ranges of a transmitter and a receiver above each other, [n].

    They lie on an ellipse, on the side of the level.
    """
    middle_m, apart_m = sum(antennas_z_m) / 2, (antennas_z_m[0] - antennas_z_m[1]) / 2
    square = np.maximum(range_m**2 - aside_m**2 - apart_m**2, 0.0)
    below_m = np.sqrt(square / (1 - (apart_m / range_m) ** 2))
    return middle_m - np.sign(middle_m - level_m) * below_m


def _at_heights(lines: RangeLines, tx_z_m: float, rx_z_m: float) -> RangeLines:
    """Return the geometry of lines with all antennas at the same heights, at rest."""
    tx_m, rx_m = np.array(lines.tx_m), np.array(lines.rx_m)
    tx_m[:, 2], rx_m[:, 2] = tx_z_m, rx_z_m
    return replace(lines.without_samples(), tx_m=tx_m, rx_m=rx_m, rx_velocity_m_s=None)


def _curvature(profile: SoundSpeed, distance_m: float, z_m: float, level_m: float) -> float:
    """Return the curvature of the rays that reach a level, 1/m; positive if they bend down.

    With the slope T of the ray at the level, D T falls by D^2/(2 R) below the height difference.
    """
    around_m = distance_m * np.array([1 - _AROUND, 1 + _AROUND])
    found = rays(profile, around_m, z_m, level_m)
    if not found.exists.all():
        return 0.0
    fall_m = -around_m * found.other_slope_s_m / found.slowness_s_m
    return float(-2 * np.diff(fall_m)[0] / np.diff(around_m**2)[0])
