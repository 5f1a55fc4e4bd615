"""The mean track of an aperture: smooth curves along its channels.

An aperture coordinate is a curve's parameter: 0 at its first and 1 at its last channel. A dense
aperture has several curves, its strips, or is a sheet: a curve that moves sideways.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_lsq_spline

from clsas.core.lines import RangeLines

# What half and twice change, by `scripts/bench sensitivity`, where they change anything:
_SAMPLES = 257  # of the track, at which rates are evaluated; half: errors 0.1 dB larger
# Past either end, each twice as far as the one before; half: images up to 16 % slower.
_SAMPLES_BEYOND = 12
ALONG_AT = (0.0, 0.5, 1.0)
"""Coordinates across a sheet of the lines along it at which rates are evaluated."""
ACROSS_AT = tuple(np.linspace(0, 1, 9))
"""Aperture coordinates of the lines across a sheet at which rates are evaluated."""
STRIP_SAMPLES = 40
"""Samples of each of several strips, and of lines across a sheet."""
APART = 16.0
"""Aperture coordinates from one strip to the next, more than samples go past the ends."""
_SAME_PLACE_M = 1e-9  # within which channels lie on the mean track
_CHANNELS_PER_KNOT = 16
_MOST_INTERVALS = 64
CLOSE_ENOUGH = 0.01
"""Distance of phase centres from the mean track that needs no better one, wavelengths rms."""


@dataclass(frozen=True, eq=False)
class MeanTrack:
    """Smooth curves along the phase centres, (tx + rx)/2, continued straight past their ends.

    Attributes
    ----------
    spline : BSpline
        Position in metres [3] over the aperture coordinate, 0 to 1. Of a sheet, coefficients of
        the powers of the coordinate across it, [powers, 3].
    coordinate : float64 [channels]
        Aperture coordinate of the point of the curve nearest to each phase centre. The coordinates
        of strip n run from 16 n to 16 n + 1.
    others : tuple of BSpline
        The curves of further strips.
    across : float64 [channels] or None
        Coordinate of each phase centre across a sheet, 0 to 1; None without a sheet.
    sampled : int
        Samples of each strip at which rates are evaluated.
    is_closed : bool
        True for a sheet whose first and last column coincide: a whole ring.
    """

    spline: BSpline
    coordinate: NDArray[np.float64]
    others: tuple[BSpline, ...] = ()
    across: NDArray[np.float64] | None = None
    sampled: int = _SAMPLES
    is_closed: bool = False

    @property
    def strips(self) -> int:
        """Number of curves."""
        return 1 + len(self.others)

    @property
    def is_dense(self) -> bool:
        """True for several strips, or a sheet."""
        return bool(self.others) or self.is_sheet

    @property
    def is_sheet(self) -> bool:
        """True if the curve moves sideways."""
        return self.across is not None

    def some(self, channels: Any) -> MeanTrack:
        """Return this track with some of the channels, in any order."""
        across = None if self.across is None else self.across[channels]
        return replace(self, coordinate=self.coordinate[channels], across=across)

    @functools.cached_property
    def alone(self) -> tuple[MeanTrack, ...]:
        """The curve of each strip as a track of its own, without channels."""
        curves = (self.spline, *self.others)
        return tuple(MeanTrack(each, np.zeros(0), sampled=self.sampled) for each in curves)

    def apart_of(self, strip: int) -> float:
        """Return the aperture coordinate at the first end of a strip."""
        return APART * strip

    def strip_of(self, coordinate: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the strip that each aperture coordinate belongs to."""
        return np.clip(np.rint((coordinate - 0.5) / APART), 0, self.strips - 1).astype(np.int64)

    def positions_m(
        self, coordinate: NDArray[np.float64], across: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return positions at aperture coordinates, [..., 3]; in the middle across a sheet."""
        return self._in_strips(self._position_m, coordinate, across)

    def tangents_m(
        self, coordinate: NDArray[np.float64], across: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return the derivative of the position by the aperture coordinate, [..., 3]."""
        return self._in_strips(self._tangent_m, coordinate, across)

    def _in_strips(
        self,
        evaluate: Callable[..., NDArray[np.float64]],
        coordinate: NDArray[np.float64],
        across: NDArray[np.float64] | None,
    ) -> NDArray[np.float64]:
        """Evaluate each coordinate on the curve of its strip."""
        if not self.others:
            return evaluate(self.spline, coordinate, across)
        strip, result = self.strip_of(coordinate), np.empty((*coordinate.shape, 3))
        for number, spline in enumerate((self.spline, *self.others)):
            its = strip == number
            result[its] = evaluate(spline, coordinate[its] - APART * number, None)
        return result

    def _position_m(
        self,
        spline: BSpline,
        coordinate: NDArray[np.float64],
        across: NDArray[np.float64] | None,
    ) -> NDArray[np.float64]:
        inside = np.clip(coordinate, 0, 1)
        position_m = self._swept(spline(inside), across)
        beyond = inside != coordinate
        past = (coordinate - inside)[beyond]
        if past.size:
            sideways = None if across is None else across[beyond]
            position_m[beyond] += past[:, None] * self._swept(spline(inside[beyond], 1), sideways)
        return position_m

    def _tangent_m(
        self,
        spline: BSpline,
        coordinate: NDArray[np.float64],
        across: NDArray[np.float64] | None,
    ) -> NDArray[np.float64]:
        return self._swept(spline(np.clip(coordinate, 0, 1), 1), across)

    def _swept(
        self, values: NDArray[np.float64], across: NDArray[np.float64] | None
    ) -> NDArray[np.float64]:
        """Return the polynomial across a sheet of coefficients [..., powers, 3], [..., 3]."""
        if not self.is_sheet:
            return values
        return _polynomial(values, np.full(values.shape[:-2], 0.5) if across is None else across)

    def positions_on_grid_m(
        self, coordinate: NDArray[np.float64], across: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return positions of a sheet at columns [n, columns] and rows [n, rows].

        float64 [n, rows, columns, 3].
        """
        inside = np.clip(coordinate, 0, 1)
        coefficients = self.spline(inside)
        coefficients += (coordinate - inside)[..., None, None] * self.spline(inside, 1)
        shape = (*across.shape, coordinate.shape[1])
        return _polynomial(coefficients[:, None], np.broadcast_to(across[..., None], shape))

    def line_along(self, across: float) -> MeanTrack:
        """Return the curve along a sheet at a coordinate across it."""
        powers = across ** np.arange(self.spline.c.shape[1])
        coefficients = np.einsum("nki,k->ni", self.spline.c, powers)
        return MeanTrack(BSpline(self.spline.t, coefficients, self.spline.k), np.zeros(0))

    def line_across(self, coordinate: float) -> MeanTrack:
        """Return the curve across a sheet at an aperture coordinate."""
        powers = self.spline(coordinate)
        degree = len(powers) - 1
        # Bernstein's coefficients of a polynomial.
        bernstein = np.array(
            [
                [math.comb(i, k) / math.comb(degree, k) for k in range(degree + 1)]
                for i in range(degree + 1)
            ]
        )
        knots = np.repeat([0.0, 1.0], degree + 1)
        spline = BSpline(knots, bernstein @ powers, degree)
        return MeanTrack(spline, np.zeros(0), sampled=STRIP_SAMPLES)

    @functools.cached_property
    def samples(self) -> NDArray[np.float64]:
        """Aperture coordinates at which rates are evaluated, past the curves' ends too, [n]."""
        beyond = 2.0 ** np.arange(1 - _SAMPLES_BEYOND, 1) * 4
        one = np.concatenate([-beyond[::-1], np.linspace(0, 1, self.sampled), 1 + beyond])
        return (APART * np.arange(self.strips)[:, None] + one).ravel()

    @functools.cached_property
    def on_track(self) -> NDArray[np.bool_]:
        """False for samples past the curves' ends, [n]."""
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
        """Return the aperture coordinates at which phase centres appear from some points.

        A channel off the track is replaced by the point of the track in the same direction. The
        remaining difference, of distance, matters least. A receiver's motion during flight moves
        the phase centre by half as much.

        Parameters
        ----------
        points_m : float64 [points, 3]
        phase_centres_m : float64 [channels, 3]
            Those of the channels of `coordinate`.
        own_drift : float64 [channels, 3], optional
            See `own_drift`.

        Returns
        -------
        float64 [points, channels]
            Along the track.
        float64 [points, channels] or None
            Across a sheet.
        """
        shape = (len(points_m), len(self.coordinate))
        across = None if self.across is None else np.broadcast_to(self.across, shape)
        off_m = self.offsets_m(phase_centres_m)[None]
        if own_drift is None and not np.abs(off_m).max() > _SAME_PLACE_M:
            return np.broadcast_to(self.coordinate, shape), across
        tangent = self.tangents_m(self.coordinate, self.across)
        sight = points_m[:, None] - phase_centres_m
        square = np.einsum("pci,pci->pc", sight, sight)
        square = np.maximum(square, 1e-30)
        if own_drift is not None:
            off_m = off_m + np.sqrt(square)[..., None] * own_drift
        if across is not None:
            return self._apparent_on_sheet(sight / np.sqrt(square)[..., None], off_m, tangent)
        along = np.einsum("pci,ci->pc", sight, tangent)
        toward = np.sum(sight * off_m, axis=-1)
        both = np.sum(tangent * off_m, axis=-1) - along * toward / square
        length = np.einsum("ci,ci->c", tangent, tangent)
        # Where the curve leads towards the point, the direction changes little along it.
        sideways = np.maximum(length - along**2 / square, 0.01 * length)
        return self.coordinate + both / sideways, None

    def _apparent_on_sheet(
        self, sight: NDArray[np.float64], off_m: NDArray[np.float64], tangent: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return coordinates along and across a sheet; `sight` are unit vectors to the points."""
        assert self.across is not None
        sideways = self.sideways_m(self.coordinate, self.across)
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

    def sideways_m(
        self, coordinate: NDArray[np.float64], across: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the derivative of a sheet's position by the coordinate across it, [..., 3]."""
        coefficients = self.spline(np.clip(coordinate, 0, 1))
        powers = np.arange(1, coefficients.shape[-2])
        inside = np.clip(across, 0, 1)[..., None]
        return np.einsum(
            "...ki,...k->...i", coefficients[..., 1:, :], powers * inside ** (powers - 1)
        )

    def offsets_m(self, phase_centres_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the offsets of the channels' phase centres from the track, [channels, 3]."""
        return phase_centres_m - self.positions_m(self.coordinate, self.across)


def _polynomial(coefficients: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return polynomials of coefficients [..., powers, 3], straight beyond 0 to 1, [..., 3]."""
    powers = coefficients.shape[-2]
    if powers == 2:
        return coefficients[..., 0, :] + at[..., None] * coefficients[..., 1, :]
    inside = np.clip(at, 0, 1)[..., None]
    value, slope = np.zeros((2, *at.shape, 3))
    for power in reversed(range(powers)):
        slope = slope * inside + value
        value = value * inside + coefficients[..., power, :]
    return value + (at[..., None] - inside) * slope


def mean_track(lines: RangeLines, wavelength_m: float) -> MeanTrack | None:
    """Return a curve along the phase centres of lines, or None if they all coincide.

    Channels may be in any order. Three orders are tried: as given, along the principal axis, and
    around the middle. The one with the shortest path through the phase centres is taken. The
    curve has as many intervals as it needs to follow them.
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
    # Newton's steps towards the nearest point of the curve.
    for _ in range(3):
        tangent = track.tangents_m(coordinate)
        off_m = centres_m - track.positions_m(coordinate)
        square = np.maximum(np.einsum("ci,ci->c", tangent, tangent), 1e-30)
        step = np.einsum("ci,ci->c", off_m, tangent) / square
        coordinate = coordinate + np.clip(step, -0.1, 0.1)
        track = MeanTrack(best, coordinate)
    return track


def _order(centres_m: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the order of phase centres along the track, and each one's distance along it, m."""
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
