"""Apparent antennas: antennas in homogeneous water that receive like those in a profile.

See `clsas.engine.water.refraction` for the method.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from clsas.engine.data.decibels import in_db, power
from clsas.engine.data.fourier import turned
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.simplify import SHARE
from clsas.engine.signal.interpolation import MOST_TAPS, Readout
from clsas.engine.water.ray_delays import (
    RaySample,
    at_speed,
    rays_between,
    straight_m,
    times_s,
)
from clsas.engine.water.rays import rays

_NODES = 36  # distances from which the change of a range axis follows; 64 leave the same error
_DEGREE = 28  # of the polynomial through them
_FLIGHT_STEPS = 4  # each multiplies the error of a moving receiver's delay by v/c, below 0.05
_FITTED_AT_ONCE = 1 << 9  # of these polynomials; bounds memory
_CHANGED_AT_ONCE = 1 << 16  # samples that are interpolated together; they fit into a cache
_BEYOND = 0.1  # of the distances of sample pixels, by which those of others may extend farther
_RESAMPLED_DB = -80.0  # largest error of the interpolation of samples
_NO_OFFSET_M = 1e-9  # up to which an offset is rounding: 1e-5 rad at 1 MHz


@dataclass(frozen=True, eq=False)
class Offsets:
    """Smooth functions of range, one for each kind of line.

    Attributes
    ----------
    limits_m : float64 [kinds, 2]
        Ranges between which they are polynomials. They continue linearly.
    coefficients : float64 [degree + 1, kinds]
        Chebyshev coefficients, metres.
    """

    limits_m: NDArray[np.float64]
    coefficients: NDArray[np.float64]

    @classmethod
    def through(cls, range_m: NDArray[np.float64], offset_m: NDArray[np.float64]) -> Offsets:
        """Return functions that fit values at some ranges best, [kinds, nodes].

        The nodes are dense towards the ends, so that the normal equations are well conditioned.
        """
        limits = np.stack([range_m.min(axis=1), range_m.max(axis=1)], axis=1)
        degree = _DEGREE if np.ptp(limits) else 0
        coefficients = np.empty((degree + 1, len(range_m)))
        for first in range(0, len(range_m), _FITTED_AT_ONCE):
            some = slice(first, first + _FITTED_AT_ONCE)
            terms = chebyshev.chebvander(_scaled(range_m[some], limits[some]), degree)
            across = terms.transpose(0, 2, 1)
            fitted = np.linalg.solve(across @ terms, across @ offset_m[some, :, None])
            coefficients[:, some] = fitted[..., 0].T
        return cls(limits, coefficients)

    def at(self, kinds: NDArray[np.int64], range_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the values of some kinds at ranges, [kinds, n], metres."""
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
        return np.asarray(value, np.float64)

    @property
    def most_m(self) -> float:
        """Upper bound of the values between the limits."""
        return float(np.abs(self.coefficients).sum(axis=0).max())

    @property
    def steepest(self) -> float:
        """Largest change per metre of range."""
        half_m = np.maximum(np.diff(self.limits_m), 1e-9) / 2
        scaled = np.linspace(-1, 1, _NODES)
        slopes = chebyshev.chebval(scaled, chebyshev.chebder(self.coefficients)) / half_m
        return float(np.abs(slopes).max())


@dataclass(frozen=True, eq=False)
class Change:
    """Apparent antennas, and the change of every line's range axis.

    In homogeneous water of speed c, a sample at range r belongs to the delay 2 (r + offset(r))/c.
    The delay 2 d/c belongs to the range d - inverse(d).

    Attributes
    ----------
    sound_speed_m_s : float
        Speed at the seabed.
    level_m : float
        Height of the seabed that the offsets are for.
    tx_z_m, rx_z_m : float64 [channels]
        Apparent heights of the transmitters, and of the receivers at transmission.
    ahead_s : float64 [channels]
        Time by which the delay at the middle is longer than in homogeneous water. A moving receiver
        is ahead by as much at transmission, so that it is in the right place when echoes arrive.
    climb : float64 [channels]
        Apparent over real vertical velocity of moving receivers: the ratio of the sines of the
        angles at which echoes arrive.
    kinds : int64 [channels]
        Number of every channel's pair of heights.
    offsets, inverse : Offsets
    accuracy_db : float
        Error of the interpolation of samples.
    """

    sound_speed_m_s: float
    level_m: float
    tx_z_m: NDArray[np.float64]
    rx_z_m: NDArray[np.float64]
    ahead_s: NDArray[np.float64]
    climb: NDArray[np.float64]
    kinds: NDArray[np.int64]
    offsets: Offsets
    inverse: Offsets
    accuracy_db: float

    @classmethod
    def of(
        cls,
        lines: RangeLines,
        sample: RaySample,
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
        near, far = _limits_m(sample, level)
        speed = float(profile.at(level))
        tx_z, rx_z, flight_s = lines.tx_m[:, 2], lines.rx_m[:, 2], np.zeros(lines.channels)
        if lines.rx_velocity_m_s is not None:  # heights when the echoes of the middle arrive
            out_s = times_s(profile, middle_m, tx_z, level)
            flight_s = 2 * out_s
            for _ in range(_FLIGHT_STEPS):
                rx_z = lines.rx_m[:, 2] + flight_s * lines.rx_velocity_m_s[:, 2]
                flight_s = out_s + times_s(profile, middle_m, rx_z, level)
        given = np.stack([tx_z, rx_z, np.broadcast_to(middle_m, tx_z.shape)], axis=1)
        triples, kinds = np.unique(given, axis=0, return_inverse=True)
        kinds, pairs, middle_m = kinds.reshape(-1), triples[:, :2], triples[:, 2:]
        arriving = rays_between(profile, middle_m, pairs, level)
        # Heights from which straight rays reach the level in the direction of the real ones.
        apparent = level - middle_m * arriving.other_slope_s_m / arriving.slowness_s_m

        distance = (near + far + (far - near) * chebyshev.chebpts2(_NODES)) / 2
        heights, which = np.unique(pairs, return_inverse=True)
        times = times_s(profile, distance, heights[:, None], level)
        delay = times[which.reshape(pairs.shape)].sum(axis=1)
        range_m = np.hypot(distance, apparent[..., None] - level).mean(axis=1)
        delay_m = speed * delay / 2
        offsets = Offsets.through(range_m, delay_m - range_m)
        inverse = Offsets.through(delay_m, delay_m - range_m)

        accuracy_db = _RESAMPLED_DB if allowed_db is None else allowed_db + in_db(SHARE)
        accuracy_db = min(accuracy_db, _RESAMPLED_DB)
        straight_s = np.hypot(middle_m, apparent - level).sum(axis=1)[kinds] / speed
        tx_z, rx_z = apparent[kinds].T
        climb = np.ones(lines.channels)
        if lines.rx_velocity_m_s is not None:
            climb = (-arriving.one_slope_s_m / arriving.other_slope_s_m)[kinds, 1]
            rx_z = rx_z - straight_s * climb * lines.rx_velocity_m_s[:, 2]
        return cls(
            speed, level, tx_z, rx_z, flight_s - straight_s, climb, kinds, offsets, inverse,
            accuracy_db,
        )  # fmt: skip

    def antennas(self, lines: RangeLines, channels: NDArray[np.int64] | slice) -> RangeLines:
        """Return lines of some channels with apparent antennas and unchanged samples."""
        tx_m, rx_m, velocity = np.array(lines.tx_m), np.array(lines.rx_m), lines.rx_velocity_m_s
        if velocity is not None:
            rx_m += self.ahead_s[channels, None] * velocity
            velocity = velocity.copy()
            velocity[:, 2] *= self.climb[channels]
        tx_m[:, 2], rx_m[:, 2] = self.tx_z_m[channels], self.rx_z_m[channels]
        moved = at_speed(lines, self.sound_speed_m_s)
        return replace(moved, tx_m=tx_m, rx_m=rx_m, rx_velocity_m_s=velocity)

    def offsets_m(
        self, channels: NDArray[np.int64], range_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the offsets at some ranges of some channels, [channels, n], metres."""
        return self.offsets.at(self.kinds[channels], range_m)

    def ranges_m(
        self, channels: NDArray[np.int64], delay_s: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the ranges of some channels that belong to delays, [channels, n], metres."""
        delay_m = self.sound_speed_m_s * delay_s / 2
        return delay_m - self.inverse.at(self.kinds[channels], delay_m)

    @property
    def resampling_error(self) -> float:
        """Relative error power of the interpolation of samples; 0 in water of one speed."""
        return power(self.accuracy_db) if self.offsets.most_m > _NO_OFFSET_M else 0.0

    def lines(self, lines: RangeLines) -> RangeLines:
        """Return lines of the geometry in homogeneous water, with samples over changed ranges.

        Where offsets change by a share of the range, so do the frequencies of echoes, the carrier
        included. Lines get as many more samples as their band then needs.
        """
        changed = self.antennas(lines, slice(None))
        if self.offsets.most_m <= _NO_OFFSET_M:
            return changed
        # Not `highest_cycles_per_m`: a band around the carrier reaches half the sample rate beyond.
        highest = 2 * lines.carrier_hz / self.sound_speed_m_s + 0.5 / changed.range_step_m
        finer = 1 + 2 * highest * self.offsets.steepest * changed.range_step_m
        length = 1 + math.ceil((lines.length - 1) * finer)
        changed = replace(changed, range_step_m=changed.range_step_m / finer)
        everyone = np.arange(lines.channels)
        first_s = 2 * changed.first_range_m / self.sound_speed_m_s
        first_m = self.ranges_m(everyone, first_s[:, None])[
            :, 0
        ]  # the first sample stays the first
        samples = np.empty((lines.channels, length), np.complex64)
        readout = Readout.of(lines, self.accuracy_db)
        steps_m = changed.range_step_m * np.arange(length)
        cycles_per_m = 2 * lines.carrier_hz / self.sound_speed_m_s
        scale = lines.sound_speed_m_s / self.sound_speed_m_s
        rows = max(1, _CHANGED_AT_ONCE // length)
        for first in range(0, lines.channels, rows):
            some = everyone[first : first + rows]
            range_m = first_m[some, None] + steps_m
            offset_m = self.offsets_m(some, range_m)
            values = readout.read(some, scale * (range_m + offset_m))
            samples[some] = values * turned(cycles_per_m * offset_m)
        return replace(changed, samples=samples, first_range_m=first_m)

    def error(
        self,
        sample: RaySample,
        points_m: NDArray[np.float64],
        correction_m: NDArray[np.float64] | float = 0.0,
    ) -> float:
        """Return the squared phase error of the worst sample pixel, rad^2.

        `points_m` are the apparent positions of the sample pixels. Corrections, [points, channels],
        are added to their ranges.
        """
        lines = self.antennas(sample.lines, sample.channels)
        range_m = straight_m(lines, points_m) + correction_m
        return sample.error(lines, range_m + self.offsets_m(sample.channels, range_m.T).T)


def _limits_m(sample: RaySample, level_m: float) -> tuple[float, float]:
    """Return the distances between which a level has all ranges of the visible pixels, metres.

    Pixels above the level are as far away as pixels of the level that are nearer, and pixels below
    it as far away as farther ones. Other pixels may be a little nearer or farther than those of
    the sample. Where rays do not reach farther, the limit is the farthest pixel.
    """
    distance = sample.distances_m
    antenna_z = sample.lines.phase_centres_m[:, 2]
    square = distance**2 + (sample.points_m[:, 2:] - antenna_z) ** 2 - (level_m - antenna_z) ** 2
    on_level = np.sqrt(np.maximum(square, 0.0))[sample.visible]
    distance = distance[sample.visible]
    near, far = min(on_level.min(), distance.min()), max(on_level.max(), distance.max())
    near, far = near - min(_BEYOND * (far - near), near / 2), far + _BEYOND * (far - near)
    depth_m = float(np.abs(antenna_z - level_m).max())
    # Where a line of few samples changes from a curved to a linear offset within those that an
    # image reads, it is not band-limited there.
    read_m = MOST_TAPS * sample.lines.range_step_m
    nearer = np.hypot(near, depth_m) - read_m
    near = max(near / 2, math.sqrt(max(nearer, depth_m) ** 2 - depth_m**2))
    far = math.sqrt((np.hypot(far, depth_m) + read_m) ** 2 - depth_m**2)
    profile = sample.lines.sound_speed
    assert profile is not None
    for z in (antenna_z.min(), antenna_z.max()):
        if not rays(profile, np.array([far]), z, level_m).exists.all():
            far = distance.max()
    return float(near), float(far)


def _scaled(range_m: NDArray[np.float64], limits_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ranges scaled so that the limits become -1 and 1, [n, m]."""
    low, high = limits_m[:, :1], limits_m[:, 1:]
    return (2 * range_m - (low + high)) / np.maximum(high - low, 1e-9)
