"""Homogeneous water in place of a profile: lines and grids that any imager images correctly.

The two-way delay of a pixel depends on its horizontal distance D from the antennas and on three
heights. For one channel above a level seabed, it is therefore a function of D alone, and so is the
range in homogeneous water. `homogeneous` makes use of this:

- An *apparent antenna* takes the place of every antenna. It lies straight above or below it, on the
  tangent of the ray at the seabed, so that echoes come from the right direction. The speed is that
  at the seabed.
- The range axis of every line is changed by a smooth function, so that the delay is right at every
  distance. At the middle of the grid this is a shift. The samples are interpolated once.
- On a grid that is not level, pixels get *apparent positions*, a few millimetres to centimetres
  beside their own.

On level grids the remaining error is that of the bistatic geometry, usually far below -80 dB.
Where straight rays of the mean speed are accurate enough, they are used, and samples stay as they
are. Every error is computed from exact rays, at sample pixels and channels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from clsas.core import validate
from clsas.core.decibels import in_db, power
from clsas.core.geometry import pairwise_range_m
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines, some_channels
from clsas.core.rays import Rays, RayTable, rays, shadow
from clsas.core.sound_speed import SoundSpeed
from clsas.signal.readout import Readout
from clsas.sonar.beam import BeamWindow
from clsas.sonar.simplify import REFRACTION, SHARE
from clsas.sonar.visibility import sines

_POINTS = 9  # sample pixels along either side of a grid
_CHANNELS = 48  # sample channels, beside the first, the last, and those at extreme heights
_BEYOND_BEAM = 0.05  # sine by which a sample pixel may lie outside the beam
_NODES = 48  # distances from which the change of a range axis follows
_DEGREE = 20  # of the polynomial through them
_MOVED_AT_ONCE = 1 << 15  # pixels whose apparent positions are found together; bounds memory
_AROUND = 0.02  # share of a distance, over which the curvature of rays is measured
_LEVEL_M = 1e-6  # relief of a grid that counts as level
_FLIGHT_STEPS = 4  # each multiplies the error of a moving receiver's delay by v/c, below 0.05
_CHANGED_AT_ONCE = 1 << 20  # samples that are interpolated together; bounds memory
_RESAMPLED_DB = -80.0
"""Error of the interpolation of samples, dB, for images of any accuracy down to -67 dB."""
_MARGIN_DB = 13.0  # by which interpolation is better than the image: its share is a twentieth


@dataclass(frozen=True, eq=False)
class Homogeneous:
    """Homogeneous water that takes the place of a profile for one geometry.

    Attributes
    ----------
    grid : Grid
        Pixels, at apparent positions if they do not lie on a level plane.
    sound_speed_m_s : float
        Speed of the homogeneous water; 0 if the lines have no profile.
    change : Change or None
        Apparent antennas and the changes of range axes; None for straight rays of the mean speed.
    error : float
        Upper bound of the relative error power of images.
    mean_error : float
        The same for straight rays of the mean speed.
    """

    grid: Grid
    sound_speed_m_s: float = 0.0
    change: Change | None = None
    error: float = 0.0
    mean_error: float = 0.0

    @property
    def left_out(self) -> tuple[str, ...]:
        """`REFRACTION` if straight rays are accurate enough."""
        return (REFRACTION,) if self.sound_speed_m_s and self.change is None else ()

    def lines(self, lines: RangeLines) -> RangeLines:
        """Return lines of the geometry in homogeneous water; those without a profile as they are."""
        if lines.sound_speed is None:
            return lines
        if self.change is None:
            return at_speed(lines, self.sound_speed_m_s)
        return self.change.lines(lines, self.sound_speed_m_s)


def homogeneous(
    lines: RangeLines, grid: Grid, beam: BeamWindow | None, allowed_db: float | None
) -> Homogeneous:
    """Return the homogeneous water in which to image lines with a profile.

    Parameters
    ----------
    lines : RangeLines
    grid : Grid
    beam : BeamWindow or None
    allowed_db : float or None
        Allowed relative rms error of the image, dB. With None, or if straight rays are not within
        a small share of its power, there are apparent antennas.

    Raises
    ------
    ValueError
        If the profile does not reach an antenna or a pixel, or a pixel lies in a shadow zone of a
        channel that should receive from it.

    Warns
    -----
    ClsasWarning
        If refraction alone causes more than half of the allowed error power.

    Notes
    -----
    The error is that of the worst sample pixel, at the highest frequency of the sampled band.
    """
    profile = lines.sound_speed
    if profile is None:
        return Homogeneous(grid)
    low, high = grid.bounds_m
    profile.check_reaches(np.array([low[2], high[2]]), "the grid's pixels")
    sample = _Sample.of(lines, grid, beam)
    if not sample.visible.any():
        middle = profile.mean_m_s(float(lines.tx_m[0, 2]), float((low[2] + high[2]) / 2))
        return Homogeneous(grid, middle)
    mean_m_s = sample.mean_speed_m_s()
    mean_error = sample.error(at_speed(sample.lines, mean_m_s), None, sample.points_m)
    allowed = 0.0 if allowed_db is None else power(allowed_db)
    if mean_error <= SHARE * allowed:
        return Homogeneous(grid, mean_m_s, None, mean_error, mean_error)
    change = Change.of(lines, sample, allowed_db, sample.middle_m)
    best = Homogeneous(grid, change.sound_speed_m_s, change, change.error(sample), mean_error)
    if best.error > SHARE * allowed and not _is_level(grid):
        change = Change.of(lines, sample, allowed_db, sample.middles_m(lines))
        moved = _apparent(grid, lines, sample, change)
        error = change.error(sample, moved.spread(_POINTS))
        if error < best.error:
            best = replace(best, grid=moved, change=change, error=error)
    best = replace(best, error=best.error + power(change.accuracy_db))
    if allowed and best.error > allowed / 2:
        validate.warn(
            f"refraction leaves an error of up to {in_db(best.error):.0f} dB, and "
            f"{allowed_db:.3g} dB are requested: form the image in parts, as clsas.mosaic does"
        )
    return best


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


@dataclass(frozen=True, eq=False)
class _Sample:
    """Sample pixels and channels with their exact ranges, [points, channels].

    Attributes
    ----------
    lines : RangeLines
        Lines of the sample channels, with the profile.
    channels : int64 [channels]
    points_m : float64 [points, 3]
    visible : bool
        False for pixels outside the beam or beyond the ends of a line.
    delay_s : float64
        Two-way delays along exact rays; 0 where not visible.
    """

    lines: RangeLines
    channels: NDArray[np.int64]
    points_m: NDArray[np.float64]
    visible: NDArray[np.bool_]
    delay_s: NDArray[np.float64]

    @classmethod
    def of(cls, lines: RangeLines, grid: Grid, beam: BeamWindow | None) -> _Sample:
        """Return a sample of lines and grid."""
        extreme = [f(each[:, 2]) for each in (lines.tx_m, lines.rx_m)
                   for f in (np.argmin, np.argmax)]  # fmt: skip
        some = np.union1d(
            some_channels(lines.channels, _CHANNELS), [0, lines.channels - 1, *extreme]
        ).astype(np.int64)
        part, points_m = lines.select(some), grid.spread(_POINTS)
        assert part.sound_speed is not None
        straight_m = pairwise_range_m(
            points_m, part.tx_m, part.rx_m, part.rx_velocity_m_s, part.sound_speed_m_s
        )
        # Sound is faster or slower than the nominal speed, and pixels lie around the sample.
        ratio = part.sound_speed_m_s / part.sound_speed.speed_m_s
        slack_m = np.ptp(points_m, axis=0).max() / max(_POINTS - 1, 1)
        visible = straight_m * ratio.max() + slack_m >= part.first_range_m
        visible &= straight_m * ratio.min() - slack_m <= part.last_range_m
        if beam is not None:
            sine = sines(points_m, part.phase_centres_m, beam.directions(lines)[some]).T
            around = _BEYOND_BEAM + slack_m / np.maximum(straight_m, 1e-30)
            visible &= (sine > beam.limits[0] - around) & (sine < beam.limits[1] + around)
        delay_s = np.zeros(visible.shape)
        point, channel = np.nonzero(visible)
        delay_s[visible] = delays_s(part, channel, points_m[point])
        return cls(part, some, points_m, visible, delay_s)

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

    def mean_speed_m_s(self) -> float:
        """Return the speed with which straight rays fit the delays best, by least squares."""
        lines, speed = self.lines, self.lines.sound_speed_m_s
        for _ in range(2):  # the positions of moving receivers depend a little on the speed
            range_m = pairwise_range_m(
                self.points_m, lines.tx_m, lines.rx_m, lines.rx_velocity_m_s, speed
            )[self.visible]
            delay = self.delay_s[self.visible]
            speed = float(2 * (range_m @ delay) / (delay @ delay))
        return speed

    def error(
        self, lines: RangeLines, change: Change | None, points_m: NDArray[np.float64]
    ) -> float:
        """Return the mean squared phase error of the worst pixel, with other antennas and points.

        The mean is over the channels that see the pixel. The error is in rad^2: the relative error
        power of that pixel.
        """
        range_m = pairwise_range_m(
            points_m, lines.tx_m, lines.rx_m, lines.rx_velocity_m_s, lines.sound_speed_m_s
        )
        if change is not None:
            range_m = range_m + change.offsets_m(self.channels, range_m.T).T
        square = np.where(
            self.visible, (2 * range_m / lines.sound_speed_m_s - self.delay_s) ** 2, 0.0
        )
        seen = np.maximum(np.count_nonzero(self.visible, axis=1), 1)
        highest_hz = lines.carrier_hz + lines.sound_speed_m_s / (2 * lines.range_step_m)
        return float((2 * np.pi * highest_hz) ** 2 * (square.sum(axis=1) / seen).max())


def delays_s(
    lines: RangeLines, channels: NDArray[np.int64], points_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the two-way delays along exact rays of pairs of channels and points, [n], seconds.

    Raises
    ------
    ValueError
        If no direct ray connects a pair.
    """
    profile = lines.sound_speed
    assert profile is not None
    tx_m, rx_m = lines.tx_m[channels], lines.rx_m[channels]
    out = one_way_s(profile, points_m, tx_m)
    if lines.rx_velocity_m_s is None:
        monostatic = np.array_equal(tx_m, rx_m)
        return 2 * out if monostatic else out + one_way_s(profile, points_m, rx_m)
    velocity, delay = lines.rx_velocity_m_s[channels], 2 * out
    for _ in range(_FLIGHT_STEPS):
        delay = out + one_way_s(profile, points_m, rx_m + velocity * delay[:, None])
    return delay


def one_way_s(
    profile: SoundSpeed, points_m: NDArray[np.float64], antennas_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the travel times between pairs of points and antennas, [n], seconds.

    Raises
    ------
    ValueError
        If no direct ray connects a pair.
    """
    offset = points_m - antennas_m
    distance = np.hypot(offset[:, 0], offset[:, 1])
    found = rays(profile, distance, antennas_m[:, 2], points_m[:, 2])
    if not found.exists.all():
        dark = np.flatnonzero(~found.exists)
        nearest = dark[distance[dark].argmin()]
        place = distance[nearest], antennas_m[nearest, 2], points_m[nearest, 2]
        raise ValueError(f"sound_speed: {shadow(profile, *map(float, place))}")
    return found.time_s


@dataclass(frozen=True, eq=False)
class Change:
    """Apparent antennas, and the change of every line's range axis.

    In homogeneous water of speed c, a sample at range r belongs to the delay 2 (r + offset(r))/c.

    Attributes
    ----------
    sound_speed_m_s : float
        Speed at the seabed.
    level_m : float
        Height of the seabed that the offsets are for.
    tx_z_m, rx_z_m : float64 [channels]
        Apparent heights of the transmitters, and of the receivers at transmission.
    kinds : int64 [channels]
        Number of every channel's pair of heights.
    limits_m : float64 [kinds, 2]
        Ranges between which the offsets are polynomials. They continue linearly.
    coefficients : float64 [degree + 1, kinds]
        Chebyshev coefficients of the offsets, metres.
    accuracy_db : float
        Error of the interpolation of samples.
    """

    sound_speed_m_s: float
    level_m: float
    tx_z_m: NDArray[np.float64]
    rx_z_m: NDArray[np.float64]
    kinds: NDArray[np.int64]
    limits_m: NDArray[np.float64]
    coefficients: NDArray[np.float64]
    accuracy_db: float

    @classmethod
    def of(
        cls,
        lines: RangeLines,
        sample: _Sample,
        allowed_db: float | None,
        middle_m: NDArray[np.float64],
    ) -> Change:
        """Return the change for lines with a profile.

        The directions of echoes are right at the distances `middle_m`, [channels] or [1].
        """
        profile = lines.sound_speed
        assert profile is not None
        seen = sample.visible.any(axis=1)
        heights = sample.points_m[seen, 2]
        level = float(heights.min() + heights.max()) / 2
        distance = sample.distances_m[sample.visible]
        near, far = float(distance.min()), float(distance.max())
        speed = float(profile.at(level))
        tx_z = lines.tx_m[:, 2]
        rx_z, moved = lines.rx_m[:, 2], np.zeros(lines.channels)
        if lines.rx_velocity_m_s is not None:
            out = _times(profile, middle_m, tx_z, level)
            moved = 2 * out * lines.rx_velocity_m_s[:, 2]
            rx_z = rx_z + moved
        given = np.stack([tx_z, rx_z, np.broadcast_to(middle_m, tx_z.shape)], axis=1)
        triples, kinds = np.unique(given, axis=0, return_inverse=True)
        kinds, middle_m, pairs = kinds.reshape(-1), triples[:, 2], triples[:, :2]
        apparent = np.stack(
            [_apparent_z(profile, middle_m, each, level) for each in pairs.T], axis=1
        )
        nodes = (near + far + (far - near) * chebyshev.chebpts2(_NODES)) / 2
        delay = sum(_times(profile, nodes, each[:, None], level) for each in pairs.T)
        range_m = sum(np.hypot(nodes, each[:, None] - level) for each in apparent.T) / 2
        offset = speed * delay / 2 - range_m
        limits = np.stack([range_m.min(axis=1), range_m.max(axis=1)], axis=1)
        scaled = _scaled(range_m, limits)
        degree = min(_DEGREE, _NODES - 1) if far > near else 0
        coefficients = np.stack(
            [chebyshev.chebfit(x, y, degree) for x, y in zip(scaled, offset, strict=True)], axis=1
        )
        accuracy_db = _RESAMPLED_DB if allowed_db is None else allowed_db - _MARGIN_DB
        accuracy_db = min(accuracy_db, _RESAMPLED_DB)
        return cls(
            speed, level, apparent[kinds, 0], apparent[kinds, 1] - moved, kinds, limits,
            coefficients, accuracy_db,
        )  # fmt: skip

    def antennas(self, lines: RangeLines, channels: NDArray[np.int64] | slice) -> RangeLines:
        """Return lines of some channels with apparent antennas and unchanged samples."""
        tx_m, rx_m = np.array(lines.tx_m), np.array(lines.rx_m)
        tx_m[:, 2], rx_m[:, 2] = self.tx_z_m[channels], self.rx_z_m[channels]
        return replace(at_speed(lines, self.sound_speed_m_s), tx_m=tx_m, rx_m=rx_m)

    def offsets_m(
        self, channels: NDArray[np.int64], range_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the offsets at some ranges of some channels, [channels, n], metres."""
        kinds = self.kinds[channels]
        limits, coefficients = self.limits_m[kinds], self.coefficients[:, kinds]
        scaled = _scaled(range_m, limits)
        inside = np.clip(scaled, -1, 1)
        value = chebyshev.chebval(inside, coefficients[..., None], tensor=False)
        if not np.array_equal(inside, scaled):
            slopes = chebyshev.chebval(
                np.array([-1.0, 1.0]), chebyshev.chebder(coefficients)[..., None], tensor=False
            )
            slope = np.where(scaled < 0, slopes[:, :1], slopes[:, 1:])
            value = value + slope * (scaled - inside)
        return value

    def lines(self, lines: RangeLines, sound_speed_m_s: float) -> RangeLines:
        """Return lines of the geometry in homogeneous water, with samples over changed ranges."""
        changed = self.antennas(lines, slice(None))
        everyone = np.arange(lines.channels)
        first_m = changed.first_range_m.copy()
        for _ in range(_FLIGHT_STEPS):  # so that the first sample stays the first
            first_m = changed.first_range_m - self.offsets_m(everyone, first_m[:, None])[:, 0]
        samples = np.empty(lines.samples.shape, np.complex64)
        readout = Readout.of(lines, self.accuracy_db)
        steps_m = changed.range_step_m * np.arange(lines.length)
        cycles_per_m = 2 * lines.carrier_hz / sound_speed_m_s
        scale = lines.sound_speed_m_s / sound_speed_m_s
        rows = max(1, _CHANGED_AT_ONCE // lines.length)
        for first in range(0, lines.channels, rows):
            some = everyone[first : first + rows]
            range_m = first_m[some, None] + steps_m
            offset_m = self.offsets_m(some, range_m)
            turns = cycles_per_m * offset_m
            values = readout.read(some, scale * (range_m + offset_m))
            samples[some] = values * np.exp(2j * np.pi * (turns - np.rint(turns)))
        return replace(changed, samples=samples, first_range_m=first_m)

    def error(self, sample: _Sample, points_m: NDArray[np.float64] | None = None) -> float:
        """Return the squared phase error of the worst sample pixel, rad^2."""
        points_m = sample.points_m if points_m is None else points_m
        return sample.error(self.antennas(sample.lines, sample.channels), self, points_m)


def _apparent(grid: Grid, lines: RangeLines, sample: _Sample, change: Change) -> Grid:
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
    places_m = grid.positions_m().reshape(-1, 3)
    distance_m, nearest = cKDTree(centres_m[:, :2]).query(places_m[:, :2])
    bend = _curvature(profile, float(np.median(distance_m)), level.tx_m[0, 2], change.level_m)
    delay = _delays_of(profile, level, distance_m, places_m[:, 2])
    apparent_z = (change.tx_z_m + change.rx_z_m) / 2
    moved_m = places_m.copy()
    for first in range(0, len(moved_m), _MOVED_AT_ONCE):
        some = slice(first, first + _MOVED_AT_ONCE)
        channel, away_m = nearest[some], moved_m[some, :2] - sample.centre_m
        above_m = moved_m[some, 2] - change.level_m
        moved_m[some, :2] += bend * above_m[:, None] * away_m
        wanted_m = change.sound_speed_m_s * delay[some] / 2
        range_m = wanted_m.copy()
        for _ in range(_FLIGHT_STEPS):
            range_m = wanted_m - change.offsets_m(channel, range_m[:, None])[:, 0]
        offset_m = moved_m[some, :2] - centres_m[channel, :2]
        below2 = range_m**2 - np.einsum("ni,ni->n", offset_m, offset_m)
        side = np.sign(apparent_z[channel] - change.level_m)
        moved_m[some, 2] = apparent_z[channel] - side * np.sqrt(np.maximum(below2, 0.0))
    return Grid.points(moved_m.reshape(*grid.shape, 3), georeference=grid.georeference)


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


def _delays_of(
    profile: SoundSpeed,
    lines: RangeLines,
    distance_m: NDArray[np.float64],
    z_m: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the delays over some distances for antennas at the heights of the first channel.

    The delay is 0 where there is no ray, which happens only to pixels that no channel sees.
    """
    delay = np.zeros(len(z_m))
    limits = [(float(each.min()), float(each.max())) for each in (distance_m, z_m)]
    for antenna_z_m in (lines.tx_m[0, 2], lines.rx_m[0, 2]):
        table = RayTable.of(profile, float(antenna_z_m), *limits)
        if table is not None:
            delay += table.times(distance_m, z_m)
        else:
            found = rays(profile, distance_m, antenna_z_m, z_m)
            delay += np.where(found.exists, found.time_s, 0.0)
    return delay


def _times(
    profile: SoundSpeed, distance_m: NDArray[np.float64], z_m: NDArray[np.float64], level_m: float
) -> NDArray[np.float64]:
    """Return the travel times from heights to distances on a level; both arrays broadcast."""
    return _rays_to(profile, distance_m, z_m, level_m).time_s


def _rays_to(
    profile: SoundSpeed, distance_m: NDArray[np.float64], z_m: NDArray[np.float64], level_m: float
) -> Rays:
    """Return the rays from heights to distances on a level; raise ValueError if one is missing."""
    found = rays(profile, distance_m, z_m, level_m)
    if not found.exists.all():
        dark = ~found.exists
        distance, z = (
            float(np.broadcast_to(each, dark.shape)[dark][0]) for each in (distance_m, z_m)
        )
        raise ValueError(f"sound_speed: {shadow(profile, distance, z, level_m)}")
    return found


def _apparent_z(
    profile: SoundSpeed, distance_m: NDArray[np.float64], z_m: NDArray[np.float64], level_m: float
) -> NDArray[np.float64]:
    """Return heights from which straight rays reach a level in the direction of the real ones."""
    found = _rays_to(profile, distance_m, z_m, level_m)
    return level_m - distance_m * found.other_slope_s_m / found.slowness_s_m


def _scaled(range_m: NDArray[np.float64], limits_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ranges scaled so that the limits become -1 and 1, [n, m]."""
    low, high = limits_m[:, :1], limits_m[:, 1:]
    return (2 * range_m - (low + high)) / np.maximum(high - low, 1e-9)


def _is_level(grid: Grid) -> bool:
    low, high = grid.bounds_m
    return bool(high[2] - low[2] <= _LEVEL_M)
