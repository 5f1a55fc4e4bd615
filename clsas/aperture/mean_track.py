"""The mean track of an aperture: smooth curves along its channels, or a sheet.

The aperture coordinate is the parameter of a curve: 0 at its first channel and 1 at its last. A
dense aperture has several curves, called strips, or a sheet, which is a curve that moves sideways.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_lsq_spline

from clsas.aperture.sheets import Sheet
from clsas.core.lines import RangeLines

# The effects of half and twice these values were measured by `scripts/bench sensitivity`.
# Samples of a single curve at which rates are evaluated. With half, errors are 0.1 dB larger.
_SAMPLES = 257
# Samples past either end, each twice as far as the one before. With half, images take up to 16 %
# more time.
_SAMPLES_BEYOND = 12
ALONG_AT = (0.0, 0.5, 1.0)
"""Coordinates across a sheet of the lines along it at which rates are evaluated."""
ACROSS_AT = tuple(np.linspace(0, 1, 9))
"""Aperture coordinates of the lines across a sheet at which rates are evaluated."""
STRIP_SAMPLES = 40
"""Samples at which rates are evaluated on each strip, and on lines across a sheet."""
APART = 16.0
"""Difference of aperture coordinates between strips; samples past their ends must not overlap."""
_SAME_PLACE_M = 1e-9  # channels that are closer to the mean track lie on it
_CHANNELS_PER_KNOT = 16
_MOST_INTERVALS = 64
CLOSE_ENOUGH = 0.01
"""Rms distance of phase centres from a mean track that is close enough, wavelengths."""


@dataclass(frozen=True, eq=False)
class MeanTrack:
    """Smooth curves or a sheet through the phase centres, (tx + rx)/2.

    Past their ends they are continued straight.

    Attributes
    ----------
    spline : BSpline
        Position over the aperture coordinate from 0 to 1, metres [3]. For a sheet, the
        coefficients of the powers of the coordinate across, [powers, 3].
    coordinate : float64 [channels]
        Aperture coordinate of the point of the track that is nearest to each phase centre. The
        coordinates of strip n run from 16 n to 16 n + 1.
    others : tuple of BSpline
        The curves of further strips.
    across : float64 [channels] or None
        Coordinate of each phase centre across a sheet, 0 to 1; None without a sheet.
    sampled : int
        Number of samples of each curve at which rates are evaluated.
    is_closed : bool
        True for a sheet that is a whole ring: its first and last columns coincide.
    """

    spline: BSpline
    coordinate: NDArray[np.float64]
    others: tuple[BSpline, ...] = ()
    across: NDArray[np.float64] | None = None
    sampled: int = _SAMPLES
    is_closed: bool = False

    @property
    def strips(self) -> int:
        """Number of curves; 1 for a sheet."""
        return 1 + len(self.others)

    @property
    def is_dense(self) -> bool:
        """True for several strips, or a sheet."""
        return bool(self.others) or self.is_sheet

    @property
    def is_sheet(self) -> bool:
        """True for a sheet."""
        return self.across is not None

    def some(self, channels: Any) -> MeanTrack:
        """Return this track with only some of the channels, in any order."""
        across = None if self.across is None else self.across[channels]
        return replace(self, coordinate=self.coordinate[channels], across=across)

    @functools.cached_property
    def alone(self) -> tuple[MeanTrack, ...]:
        """A track for each curve, without channels."""
        curves = (self.spline, *self.others)
        return tuple(MeanTrack(each, np.zeros(0), sampled=self.sampled) for each in curves)

    def apart_of(self, strip: int) -> float:
        """Return the aperture coordinate at the first end of a strip."""
        return APART * strip

    def strip_of(self, coordinate: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the strip that each aperture coordinate belongs to."""
        return np.clip(np.rint((coordinate - 0.5) / APART), 0, self.strips - 1).astype(np.int64)

    @functools.cached_property
    def sheet(self) -> Sheet:
        """Positions on the sheet; only for a track that is one."""
        return Sheet(self.spline)

    def positions_m(
        self, coordinate: NDArray[np.float64], across: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return positions at aperture coordinates, [..., 3]; by default in a sheet's middle."""
        if self.is_sheet:
            return self.sheet.positions_m(coordinate, _across_or_middle(coordinate, across))
        return self._on_strips(_positions_on_curve_m, coordinate)

    def tangents_m(
        self, coordinate: NDArray[np.float64], across: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return the derivatives of positions by the aperture coordinate, [..., 3]."""
        if self.is_sheet:
            return self.sheet.tangents_m(coordinate, _across_or_middle(coordinate, across))
        return self._on_strips(_tangents_of_curve_m, coordinate)

    def _on_strips(
        self,
        evaluate: Callable[[BSpline, NDArray[np.float64]], NDArray[np.float64]],
        coordinate: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Evaluate each coordinate on the curve of its strip."""
        if not self.others:
            return evaluate(self.spline, coordinate)
        strip, result = self.strip_of(coordinate), np.empty((*coordinate.shape, 3))
        for number, spline in enumerate((self.spline, *self.others)):
            its = strip == number
            result[its] = evaluate(spline, coordinate[its] - APART * number)
        return result

    def line_along(self, across: float) -> MeanTrack:
        """Return the curve along a sheet at a coordinate across it."""
        return MeanTrack(self.sheet.curve_along(across), np.zeros(0))

    def line_across(self, coordinate: float) -> MeanTrack:
        """Return the curve across a sheet at an aperture coordinate."""
        return MeanTrack(self.sheet.curve_across(coordinate), np.zeros(0), sampled=STRIP_SAMPLES)

    @functools.cached_property
    def samples(self) -> NDArray[np.float64]:
        """Aperture coordinates at which rates are evaluated, also past the ends of curves, [n]."""
        beyond = 2.0 ** np.arange(1 - _SAMPLES_BEYOND, 1) * 4
        one = np.concatenate([-beyond[::-1], np.linspace(0, 1, self.sampled), 1 + beyond])
        return (APART * np.arange(self.strips)[:, None] + one).ravel()

    @functools.cached_property
    def on_track(self) -> NDArray[np.bool_]:
        """False for samples past the ends of curves, [n]."""
        return np.abs(self.samples - APART * self.strip_of(self.samples) - 0.5) <= 0.5

    @functools.cached_property
    def lines_along(self) -> tuple[MeanTrack, ...]:
        """Lines along a sheet at which phase rates are evaluated."""
        return tuple(self.line_along(each) for each in ALONG_AT)

    @functools.cached_property
    def lines_across(self) -> tuple[MeanTrack, ...]:
        """Lines across a sheet at which phase rates are evaluated."""
        return tuple(self.line_across(each) for each in ACROSS_AT)

    @functools.cached_property
    def sampled_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions and tangents at `samples`, [n, 3] each."""
        return self.positions_m(self.samples), self.tangents_m(self.samples)

    def apparent_coordinates(
        self,
        points_m: NDArray[np.float64],
        phase_centres_m: NDArray[np.float64],
        own_drift: NDArray[np.float64] | None = None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Return the coordinates at which phase centres appear from some points.

        A channel off the track is replaced by the point of the track that is seen in the same
        direction. Only its distance is then different, which matters least. The motion of a
        receiver during flight moves the phase centre by half as much.

        Parameters
        ----------
        points_m : float64 [points, 3]
        phase_centres_m : float64 [channels, 3]
            Phase centres of the channels of `coordinate`.
        own_drift : float64 [channels, 3], optional
            See `clsas.aperture.phase_rates.own_drift`.

        Returns
        -------
        float64 [points, channels]
            Aperture coordinates.
        float64 [points, channels] or None
            Coordinates across a sheet.
        """
        off_m = self.offsets_m(phase_centres_m)[None]
        if own_drift is None and not np.abs(off_m).max() > _SAME_PLACE_M:
            return self.coordinates_everywhere(len(points_m))
        sight = points_m[:, None] - phase_centres_m
        square = np.maximum(np.einsum("pci,pci->pc", sight, sight), 1e-30)
        if own_drift is not None:
            off_m = off_m + np.sqrt(square)[..., None] * own_drift
        if self.is_sheet:
            return self._apparent_on_sheet(sight / np.sqrt(square)[..., None], off_m)
        return self._apparent_on_curves(sight, square, off_m), None

    def coordinates_everywhere(
        self, points: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Return the coordinates of the channels, repeated for a number of points.

        If all channels lie on the track, `apparent_coordinates` are these.
        """
        shape = (points, len(self.coordinate))
        across = None if self.across is None else np.broadcast_to(self.across, shape)
        return np.broadcast_to(self.coordinate, shape), across

    def _apparent_on_curves(
        self, sight: NDArray[np.float64], square: NDArray[np.float64], off_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return apparent coordinates along curves, [points, channels].

        Parameters
        ----------
        sight : float64 [points, channels, 3]
            From channels to points, metres.
        square : float64 [points, channels]
            Squares of their lengths.
        off_m : float64 [1 or points, channels, 3]
            From the track to channels.
        """
        tangent = self.tangents_m(self.coordinate)
        along = np.einsum("pci,ci->pc", sight, tangent)
        toward = np.sum(sight * off_m, axis=-1)
        both = np.sum(tangent * off_m, axis=-1) - along * toward / square
        length = np.einsum("ci,ci->c", tangent, tangent)
        # Where the curve leads towards the point, the direction changes little along it.
        sideways = np.maximum(length - along**2 / square, 0.01 * length)
        return self.coordinate + both / sideways

    def _apparent_on_sheet(
        self, sight: NDArray[np.float64], off_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return apparent coordinates along and across a sheet, [points, channels] each.

        Parameters
        ----------
        sight : float64 [points, channels, 3]
            Unit vectors from channels to points.
        off_m : float64 [1 or points, channels, 3]
            From the sheet to channels.
        """
        assert self.across is not None
        tangent = self.sheet.tangents_m(self.coordinate, self.across)
        sideways = self.sheet.sideways_m(self.coordinate, self.across)
        axes = np.stack([tangent, sideways])
        length = np.einsum("aci,aci->ac", axes, axes)
        toward = np.einsum("pci,aci->apc", sight, axes)
        off_toward = np.sum(sight * off_m, axis=-1)
        first, second = np.sum(axes[:, None] * off_m, axis=-1) - toward * off_toward
        # Where the sheet leads towards a point, directions change little along it.
        square = length[:, None] - toward**2 + 0.01 * length[:, None]
        mixed = np.einsum("ci,ci->c", tangent, sideways) - toward[0] * toward[1]
        determinant = np.maximum(square[0] * square[1] - mixed**2, 1e-30)
        return (
            self.coordinate + (first * square[1] - second * mixed) / determinant,
            self.across + (second * square[0] - first * mixed) / determinant,
        )

    def offsets_m(self, phase_centres_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the offsets of the channels' phase centres from the track, [channels, 3]."""
        return phase_centres_m - self.positions_m(self.coordinate, self.across)


def _across_or_middle(
    coordinate: NDArray[np.float64], across: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Return coordinates across a sheet; by default its middle, for each aperture coordinate."""
    return np.full(np.shape(coordinate), 0.5) if across is None else across


def _positions_on_curve_m(spline: BSpline, coordinate: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return positions on a curve, which is continued straight past its ends, [..., 3]."""
    inside = np.clip(coordinate, 0, 1)
    position_m: NDArray[np.float64] = spline(inside)
    beyond = inside != coordinate
    past = (coordinate - inside)[beyond]
    if past.size:
        position_m[beyond] += past[:, None] * spline(inside[beyond], 1)
    return position_m


def _tangents_of_curve_m(spline: BSpline, coordinate: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the derivatives of positions on a curve by the aperture coordinate, [..., 3]."""
    tangent_m: NDArray[np.float64] = spline(np.clip(coordinate, 0, 1), 1)
    return tangent_m


def mean_track(lines: RangeLines, wavelength_m: float) -> MeanTrack | None:
    """Return a curve along the phase centres of lines, or None if they all coincide.

    Channels may be in any order. Three orders are tried: the given one, along the principal axis,
    and by the angle around the middle. The one with the shortest path through the phase centres
    wins. The number of the curve's intervals is doubled until the curve follows them.
    """
    centres_m = lines.phase_centres_m
    order, along = _order(centres_m)
    if along[-1] == 0:
        return None
    position_m, along = centres_m[order], along / along[-1]
    close_m = CLOSE_ENOUGH * wavelength_m
    best, best_m, intervals = None, np.inf, 1
    while intervals <= min(_MOST_INTERVALS, max(lines.channels // _CHANNELS_PER_KNOT, 1)):
        spline = _fit(along, position_m, intervals)
        off_m = np.sqrt(np.mean(np.sum((spline(along) - position_m) ** 2, axis=1)))
        if off_m < 0.8 * best_m:
            best, best_m = spline, off_m
        if best_m <= close_m:
            break
        intervals *= 2
    coordinate = np.empty(len(along))
    coordinate[order] = along
    track = MeanTrack(best, coordinate)
    # Newton steps towards the nearest points of the curve.
    for _ in range(3):
        tangent = track.tangents_m(coordinate)
        off_m = centres_m - track.positions_m(coordinate)
        square = np.maximum(np.einsum("ci,ci->c", tangent, tangent), 1e-30)
        step = np.einsum("ci,ci->c", off_m, tangent) / square
        coordinate = coordinate + np.clip(step, -0.1, 0.1)
        track = MeanTrack(best, coordinate)
    return track


def _order(centres_m: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the order of phase centres along the track, and their path lengths along it, m."""
    if len(centres_m) == 1:
        return np.zeros(1, np.int64), np.zeros(1)
    offset_m = centres_m - centres_m.mean(axis=0)
    first, second = np.linalg.svd(offset_m, full_matrices=False)[2][:2] @ offset_m.T
    candidates = (
        np.arange(len(centres_m)),
        np.argsort(first, kind="stable"),
        np.argsort(np.arctan2(second, first), kind="stable"),
    )
    best, along_m = candidates[0], np.full(1, np.inf)
    for order in candidates:
        steps_m = np.linalg.norm(np.diff(centres_m[order], axis=0), axis=1)
        if steps_m.sum() < 0.999 * along_m[-1]:
            best, along_m = order, np.concatenate([[0.0], np.cumsum(steps_m)])
    return best, along_m


def _fit(along: NDArray[np.float64], position_m: NDArray[np.float64], intervals: int) -> BSpline:
    """Return the least-squares cubic spline of positions [n, 3], with knots where channels are."""
    distinct, index = np.unique(along, return_index=True)
    degree = min(3, len(distinct) - 1)
    inner = np.quantile(distinct, np.arange(1, intervals) / intervals)
    knots = np.concatenate([[0.0] * (degree + 1), inner, [1.0] * (degree + 1)])
    middle = position_m.mean(axis=0)
    fitted = make_lsq_spline(distinct, position_m[index] - middle, knots, k=degree)
    return BSpline(fitted.t, fitted.c + middle, degree)
