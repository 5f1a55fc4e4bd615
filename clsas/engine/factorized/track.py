"""The mean track of an aperture: one smooth curve along its channels, strips, or a sheet.

The aperture coordinate is the parameter of a curve: 0 at its first channel and 1 at its last. One
curve cannot follow many passes, a raster scan, a helix or a planar array. Separate passes get a
curve each, called strips. Channels close to a smooth sheet, which is a curve that moves sideways,
are interpolated in both of its dimensions.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_lsq_spline
from scipy.linalg import solveh_banded
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from clsas.engine.data.geometry import SAME_PLACE_M
from clsas.engine.data.lines import RangeLines, some_channels
from clsas.engine.data.pings import PASS_JUMP

Shape = Literal["track", "strips", "sheet"]
"""Shape of a mean track: one curve, several curves, or a curve that moves sideways."""

# The effects of half and twice these values were measured by `scripts/bench sensitivity`.
# Samples of a single curve at which rates are evaluated. With half, errors are 0.1 dB larger.
_SAMPLES = 257
_STRIP_SAMPLES = 40  # the same on each strip, and on lines across a sheet
# Samples past either end, each twice as far as the one before. With half, images take up to 16 %
# more time.
_SAMPLES_BEYOND = 12
ALONG_AT = (0.0, 0.5, 1.0)
"""Coordinates across a sheet of the lines along it at which rates are evaluated."""
ACROSS_AT = tuple(np.linspace(0, 1, 9))
"""Aperture coordinates of the lines across a sheet at which rates are evaluated."""
APART = 16.0
"""Difference of aperture coordinates between strips; samples past their ends must not overlap."""

# One curve
_CHANNELS_PER_KNOT = 16
_MOST_INTERVALS = 64
_CLOSE_ENOUGH = 0.01  # rms distance of phase centres at which a curve is accepted, wavelengths
_SCREENED = 512  # channels by which a single curve is accepted or rejected
_FAR_OFF = 2.0  # rms distance per axis at which one curve is rejected, wavelengths

# Strips
_LEAST_OF_STRIP = 32  # fewest channels of a strip
_MOST_STRIPS = 128
_MOST_PAIRS = 64.0  # most neighbours of a channel within a jump, on average

# A sheet
_FITTED = 768  # most channels to which a sheet is fitted
_TRIED = (8, 2)  # intervals of a sheet's splines, and coefficients across it
_REFINED = ((64, 2), (8, 3), (64, 3))  # the same, tried in turn until channels lie on the sheet
_SHEET_CLOSE = 3e-5  # rms distance at which channels lie on a sheet, wavelengths
_ALONG_CLOSE = 1e-4  # rms error of fitted directions that no beam resolves
_OPEN = np.pi / 6  # widest gap of a closed ring, radians
_OVERLAP = 0.08  # by which the ends of a closed ring overlap, in aperture coordinate
_FLAT = 1e-6  # extents that count as zero, relative to the length
# Without the outermost tenth on either side, channels must still cover this share of the width of
# a sheet. Otherwise a single channel off a ring may define the width, and neighbours are far apart
# across the sheet. Regular apertures cover 0.4 to 1.
_SPREAD, _OUTERMOST = 0.2, 0.1
_CHANNELS_PER_TERM = 4  # fewest channels for each coefficient of a sheet
_RIDGE = 1e-10  # added to normal equations, relative, for coefficients without any channel


def simplest_track(lines: RangeLines, wavelength_m: float) -> tuple[Shape, MeanTrack | None]:
    """Return the simplest mean track and its shape: one curve, unless channels are far from it."""
    # A sample of the channels decides, so that curves are not fitted to a hundred thousand channels
    # in vain.
    some = some_channels(lines.channels, _SCREENED)
    sampled = None
    if len(some) < lines.channels:
        sampled = mean_track(lines.without_samples().select(some), wavelength_m)
    if sampled is not None:
        off_m = sampled.offsets_m(lines.phase_centres_m[some])
        if np.sqrt(np.mean(off_m**2)) >= _FAR_OFF * wavelength_m:
            for shape in shapes_after("track"):
                track = mean_track_of(lines, shape, wavelength_m)
                if track is not None:
                    return shape, track
    return "track", mean_track(lines, wavelength_m)


def shapes_after(shape: Shape) -> tuple[Shape, ...]:
    """Return the shapes to try after one that `simplest_track` returned.

    It has already rejected the shapes before that one.
    """
    order: tuple[Shape, ...] = ("track", "strips", "sheet")
    return order[order.index(shape) + 1 :]


def mean_track_of(lines: RangeLines, shape: Shape, wavelength_m: float) -> MeanTrack | None:
    """Return the mean track of a given shape, or None if the channels have no such track.

    Equal geometry and an equal wavelength (see `band_wavelength_m`) give
    equal tracks. A plan therefore contains the shape only.
    """
    of_shape = {"track": mean_track, "strips": strips, "sheet": sheet}
    return of_shape[shape](lines, wavelength_m)


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

    def positions_m(
        self, coordinate: NDArray[np.float64], across: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return positions at aperture coordinates, [..., 3]; by default in a sheet's middle."""
        if self.is_sheet:
            middle = np.full(np.shape(coordinate), 0.5)
            return self.sheet.positions_m(coordinate, middle if across is None else across)
        position_m: NDArray[np.float64]
        if self.others:
            strip, position_m = self.strip_of(coordinate), np.empty((*coordinate.shape, 3))
            for number, curve in enumerate(self.alone):
                its = strip == number
                position_m[its] = curve.positions_m(coordinate[its] - APART * number)
            return position_m
        inside = np.clip(coordinate, 0, 1)
        position_m = self.spline(inside)
        beyond = inside != coordinate
        past = (coordinate - inside)[beyond]
        if past.size:
            position_m[beyond] += past[:, None] * self.spline(inside[beyond], 1)
        return position_m

    def tangents_m(
        self, coordinate: NDArray[np.float64], across: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return the derivatives of positions by the aperture coordinate, [..., 3]."""
        if self.is_sheet:
            middle = np.full(np.shape(coordinate), 0.5)
            return self.sheet.tangents_m(coordinate, middle if across is None else across)
        tangent_m: NDArray[np.float64]
        if self.others:
            strip, tangent_m = self.strip_of(coordinate), np.empty((*coordinate.shape, 3))
            for number, curve in enumerate(self.alone):
                its = strip == number
                tangent_m[its] = curve.tangents_m(coordinate[its] - APART * number)
            return tangent_m
        tangent_m = self.spline(np.clip(coordinate, 0, 1), 1)
        return tangent_m

    def offsets_m(self, phase_centres_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the offsets of the channels' phase centres from the track, [channels, 3]."""
        return phase_centres_m - self.positions_m(self.coordinate, self.across)

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
            See `clsas.engine.factorized.phase_rates.own_drift`.

        Returns
        -------
        float64 [points, channels]
            Aperture coordinates.
        float64 [points, channels] or None
            Coordinates across a sheet.
        """
        off_m = self.offsets_m(phase_centres_m)[None]
        if own_drift is None and not np.abs(off_m).max() > SAME_PLACE_M:
            return self.coordinates_everywhere(len(points_m))
        sight = points_m[:, None] - phase_centres_m
        square = np.maximum(np.einsum("pci,pci->pc", sight, sight), 1e-30)
        if own_drift is not None:
            off_m = off_m + np.sqrt(square)[..., None] * own_drift
        if self.is_sheet:
            return self._apparent_on_sheet(sight / np.sqrt(square)[..., None], off_m)
        tangent = self.tangents_m(self.coordinate)
        along = np.einsum("pci,ci->pc", sight, tangent)
        toward = np.sum(sight * off_m, axis=-1)
        both = np.sum(tangent * off_m, axis=-1) - along * toward / square
        length = np.einsum("ci,ci->c", tangent, tangent)
        # Where the curve leads towards the point, the direction changes little along it.
        sideways = np.maximum(length - along**2 / square, 0.01 * length)
        return self.coordinate + both / sideways, None

    def coordinates_everywhere(
        self, points: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Return the coordinates of the channels, repeated for a number of points.

        If all channels lie on the track, `apparent_coordinates` are these.
        """
        shape = (points, len(self.coordinate))
        across = None if self.across is None else np.broadcast_to(self.across, shape)
        return np.broadcast_to(self.coordinate, shape), across

    # Strips

    @functools.cached_property
    def alone(self) -> tuple[MeanTrack, ...]:
        """A track for each curve, without channels."""
        curves = (self.spline, *self.others)
        return tuple(MeanTrack(each, np.zeros(0), sampled=self.sampled) for each in curves)

    def strip_of(self, coordinate: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the strip that each aperture coordinate belongs to."""
        return np.clip(np.rint((coordinate - 0.5) / APART), 0, self.strips - 1).astype(np.int64)

    # Sheets

    @functools.cached_property
    def sheet(self) -> Sheet:
        """Positions on the sheet; only for a track that is one."""
        return Sheet(self.spline)

    def line_along(self, across: float) -> MeanTrack:
        """Return the curve along a sheet at a coordinate across it."""
        spline, powers = self.spline, across ** np.arange(self.spline.c.shape[1])
        coefficients = np.einsum("nki,k->ni", spline.c, powers)
        return MeanTrack(BSpline(spline.t, coefficients, spline.k), np.zeros(0))

    def line_across(self, coordinate: float) -> MeanTrack:
        """Return the curve across a sheet at an aperture coordinate."""
        powers = self.spline(coordinate)
        degree = len(powers) - 1
        # Bernstein coefficients of the polynomial are those of a spline without inner knots.
        bernstein = np.array(
            [
                [math.comb(i, k) / math.comb(degree, k) for k in range(degree + 1)]
                for i in range(degree + 1)
            ]
        )
        knots = np.repeat([0.0, 1.0], degree + 1)
        spline = BSpline(knots, bernstein @ powers, degree)
        return MeanTrack(spline, np.zeros(0), sampled=_STRIP_SAMPLES)

    @functools.cached_property
    def lines_along(self) -> tuple[MeanTrack, ...]:
        """Lines along a sheet at which phase rates are evaluated."""
        return tuple(self.line_along(each) for each in ALONG_AT)

    @functools.cached_property
    def lines_across(self) -> tuple[MeanTrack, ...]:
        """Lines across a sheet at which phase rates are evaluated."""
        return tuple(self.line_across(each) for each in ACROSS_AT)

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


def mean_track(lines: RangeLines, wavelength_m: float) -> MeanTrack | None:
    """Return a curve along the phase centres of lines, or None if they all coincide.

    Channels may be in any order. Three orders are tried: the given one, along the principal axis,
    and by the angle around the middle. The one with the shortest path through the phase centres
    wins. The number of the curve's intervals is doubled until the curve follows them.
    """
    centres_m = lines.phase_centres_m
    if lines.channels == 1:
        return None

    # Order the channels by the shortest of three paths, and measure the length along it.
    offset_m = centres_m - centres_m.mean(axis=0)
    first, second = np.linalg.svd(offset_m, full_matrices=False)[2][:2] @ offset_m.T
    orders = (
        np.arange(lines.channels),
        np.argsort(first, kind="stable"),
        np.argsort(np.arctan2(second, first), kind="stable"),
    )
    order, along_m = orders[0], np.full(1, np.inf)
    for each in orders:
        steps_m = np.linalg.norm(np.diff(centres_m[each], axis=0), axis=1)
        if steps_m.sum() < 0.999 * along_m[-1]:
            order, along_m = each, np.concatenate([[0.0], np.cumsum(steps_m)])
    if along_m[-1] == 0:
        return None
    position_m, along = centres_m[order], along_m / along_m[-1]

    # Fit cubic splines by least squares, with knots where channels are, until one is close.
    distinct, index = np.unique(along, return_index=True)
    degree, middle_m = min(3, len(distinct) - 1), position_m.mean(axis=0)
    spline, spline_off_m, intervals = None, np.inf, 1
    while intervals <= min(_MOST_INTERVALS, max(lines.channels // _CHANNELS_PER_KNOT, 1)):
        inner = np.quantile(distinct, np.arange(1, intervals) / intervals)
        knots = np.concatenate([[0.0] * (degree + 1), inner, [1.0] * (degree + 1)])
        fitted = make_lsq_spline(distinct, position_m[index] - middle_m, knots, k=degree)
        tried = BSpline(fitted.t, fitted.c + middle_m, degree)
        off_m = np.sqrt(np.mean(np.sum((tried(along) - position_m) ** 2, axis=1)))
        if off_m < 0.8 * spline_off_m:
            spline, spline_off_m = tried, off_m
        if spline_off_m <= _CLOSE_ENOUGH * wavelength_m:
            break
        intervals *= 2

    # Move from the coordinates along the path to the nearest points of the curve, by Newton steps.
    coordinate = np.empty(lines.channels)
    coordinate[order] = along
    track = MeanTrack(spline, coordinate)
    for _ in range(3):
        tangent = track.tangents_m(coordinate)
        off_m = centres_m - track.positions_m(coordinate)
        square = np.maximum(np.einsum("ci,ci->c", tangent, tangent), 1e-30)
        step = np.einsum("ci,ci->c", off_m, tangent) / square
        coordinate = coordinate + np.clip(step, -0.1, 0.1)
    return replace(track, coordinate=coordinate)


def strips(lines: RangeLines, wavelength_m: float) -> MeanTrack | None:
    """Return a track with a curve for each pass, for channels in any order.

    The result is None for a single pass, or if any pass is short.
    """
    if lines.channels < 2 * _LEAST_OF_STRIP:
        return None
    passes = _passes_between_jumps(lines.phase_centres_m)
    if not _make_strips(passes):
        passes = _passes_of_neighbours(lines.phase_centres_m)
    if not _make_strips(passes):
        return None
    bare, splines, coordinate = lines.without_samples(), [], np.empty(lines.channels)
    for number, channels in enumerate(passes):
        track = mean_track(bare.select(channels), wavelength_m)
        if track is None:
            return None
        splines.append(track.spline)
        coordinate[channels] = APART * number + track.coordinate
    return MeanTrack(splines[0], coordinate, tuple(splines[1:]), sampled=_STRIP_SAMPLES)


def _passes_between_jumps(centres_m: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    """Return the channels of each pass, for passes that follow each other, separated by jumps."""
    steps_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1)
    jumps = np.flatnonzero(steps_m > PASS_JUMP * np.median(steps_m)) + 1
    return np.split(np.arange(len(centres_m)), jumps)


def _passes_of_neighbours(centres_m: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    """Return the channels of each pass, for passes that lie apart and channels in any order.

    Channels belong to one pass if a chain of near neighbours connects them. The list is empty for
    channels that cannot have passes.
    """
    # This tree takes half as long to build as a balanced one. Searches take longer, but are few.
    count, tree = len(centres_m), KDTree(centres_m, balanced_tree=False, compact_nodes=False)
    some = centres_m[some_channels(count, _SCREENED)]
    # Channels of a helix or a planar array, which have no passes, have many neighbours in a jump.
    step_m = float(np.median(tree.query(some, k=2)[0][:, -1]))
    neighbours = tree.query_ball_point(some, PASS_JUMP * step_m, return_length=True)
    # The mean bounds the memory for pairs: all channels of a platform at rest are neighbours.
    has_passes = np.median(neighbours) <= 2 * PASS_JUMP + 1 and np.mean(neighbours) <= _MOST_PAIRS
    if step_m == 0 or not has_passes:
        return []
    pairs = tree.query_pairs(PASS_JUMP * step_m, output_type="ndarray")
    joined = coo_array((np.ones(len(pairs), np.int8), tuple(pairs.T)), shape=(count, count))
    _, label = connected_components(joined, directed=False)
    return np.split(np.argsort(label, kind="stable"), np.cumsum(np.bincount(label))[:-1])


def _make_strips(passes: list[NDArray[np.int64]]) -> bool:
    """Return whether passes are neither too few, nor too many, nor too short."""
    return 1 < len(passes) <= _MOST_STRIPS and min(map(len, passes)) >= _LEAST_OF_STRIP


@dataclass(frozen=True, eq=False)
class Sheet:
    """A smooth sheet over an aperture coordinate and a coordinate across, each from 0 to 1.

    Positions are cubic splines along the aperture and polynomials across it. Past its edges the
    sheet is continued straight.

    Attributes
    ----------
    spline : BSpline
        Coefficients of the powers of the coordinate across, [powers, 3], over the aperture
        coordinate; metres.
    """

    spline: BSpline

    def positions_m(
        self, coordinate: NDArray[np.float64], across: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return positions, [..., 3]."""
        inside = np.clip(coordinate, 0, 1)
        position_m = _polynomial(self.spline(inside), across)
        beyond = inside != coordinate
        past = (coordinate - inside)[beyond]
        if past.size:
            tangent_m = _polynomial(self.spline(inside[beyond], 1), across[beyond])
            position_m[beyond] += past[:, None] * tangent_m
        return position_m

    def tangents_m(
        self, coordinate: NDArray[np.float64], across: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the derivatives of positions by the aperture coordinate, [..., 3]."""
        return _polynomial(self.spline(np.clip(coordinate, 0, 1), 1), across)

    def sideways_m(
        self, coordinate: NDArray[np.float64], across: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the derivatives of positions by the coordinate across, [..., 3]."""
        coefficients = self.spline(np.clip(coordinate, 0, 1))
        powers = np.arange(1, coefficients.shape[-2])
        inside = np.clip(across, 0, 1)[..., None]
        return np.einsum(
            "...ki,...k->...i", coefficients[..., 1:, :], powers * inside ** (powers - 1)
        )

    def positions_on_grid_m(
        self, columns: NDArray[np.float64], rows: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return positions at all pairs of a row and a column, [n, rows, columns, 3].

        Parameters
        ----------
        columns : float64 [n, columns]
            Aperture coordinates.
        rows : float64 [n, rows]
            Coordinates across.
        """
        inside = np.clip(columns, 0, 1)
        coefficients = self.spline(inside)
        coefficients += (columns - inside)[..., None, None] * self.spline(inside, 1)
        shape = (*rows.shape, columns.shape[1])
        return _polynomial(coefficients[:, None], np.broadcast_to(rows[..., None], shape))


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


def sheet(lines: RangeLines, wavelength_m: float) -> MeanTrack | None:
    """Return the smooth sheet nearest to the phase centres, or None if they lie on a line.

    A plane, or a ring around the middle, is bent until it follows the channels. The coordinates of
    channels are those on the plane or the ring.
    """
    centres_m = lines.phase_centres_m
    some = some_channels(lines.channels, _FITTED)
    middle_m = centres_m[some].mean(axis=0)
    some_m = centres_m[some] - middle_m

    # Choose the plane or ring from which a simple sheet deviates least.
    surface, least_m = None, np.inf
    for each in _surfaces(some_m):
        along, across = each.coordinates(some_m)
        low, high = np.quantile(across, [_OUTERMOST, 1 - _OUTERMOST])
        if high - low < _SPREAD:
            continue
        _, rms_m = _fitted((along, across), some_m, each.closed, *_TRIED)
        if rms_m < least_m:
            surface, least_m = each, rms_m
    if surface is None:
        return None

    # Bend it, and move it to the channels.
    along, across = surface.coordinates(centres_m - middle_m)
    close_m = _SHEET_CLOSE * wavelength_m
    found = _smoothest((along[some], across[some]), some_m, surface.closed, close_m)
    if found is None:
        return None
    best, _ = found
    coefficients = best.c.copy()
    coefficients[:, 0] += middle_m
    spline = BSpline(best.t, coefficients, best.k)
    return MeanTrack(spline, along, across=across, is_closed=surface.closed)


@dataclass(frozen=True, eq=False)
class _Surface:
    """A plane, or a ring around an axis, through the origin.

    Attributes
    ----------
    axes : float64 [3, 3]
        Unit vectors. The first is along a plane and the second across it; the third is the axis of
        a ring.
    centre : (float, float) or None
        Centre of the ring on the first two axes; None for a plane.
    start : float
        Angle at which the ring is cut, radians.
    closed : bool
        True for a whole ring, whose ends meet.
    """

    axes: NDArray[np.float64]
    centre: tuple[float, float] | None = None
    start: float = 0.0
    closed: bool = False

    def coordinates(
        self, offset_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return coordinates of channels along and across, each from 0 to 1."""
        first, second, third = self.axes @ offset_m.T
        if self.centre is None:
            return _scaled(first), _scaled(second)
        angle = np.arctan2(second - self.centre[1], first - self.centre[0])
        turn = (angle - self.start) / (2 * np.pi) % 1.0
        return turn if self.closed else _scaled(turn), _scaled(third)


def _scaled(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values moved and scaled to run from 0 to 1."""
    return (values - values.min()) / np.ptp(values)


def _surfaces(offset_m: NDArray[np.float64]) -> Iterator[_Surface]:
    """Yield the plane nearest to channels, and rings around two axes."""
    axes = np.linalg.eigh(offset_m.T @ offset_m)[1].T[::-1]
    length_m = np.ptp(offset_m @ axes.T, axis=0)
    if length_m[1] <= _FLAT * length_m[0]:
        return
    yield _Surface(axes)
    # Channels in a plane form no ring. Around an axis in this plane they appear at two angles only,
    # and a sheet that is fitted to both collapses to a curve between them.
    if length_m[2] <= _FLAT * length_m[0]:
        return
    for order in ((0, 1, 2), (1, 2, 0)):
        # The circle of least squares: x^2 + y^2 = 2 a x + 2 b y + c.
        turned = axes[list(order)]
        one, other, _ = turned @ offset_m.T
        terms = np.stack([2 * one, 2 * other, np.ones_like(one)], axis=1)
        a, b, _ = np.linalg.lstsq(terms, one**2 + other**2, rcond=None)[0]
        angle = np.sort(np.arctan2(other - b, one - a))
        gaps = np.diff(angle, append=angle[0] + 2 * np.pi)
        # The ring is cut in its widest gap.
        widest = int(gaps.argmax())
        closed = bool(gaps[widest] < _OPEN)
        yield _Surface(turned, (a, b), float(angle[widest] + gaps[widest] / 2), closed)


def _smoothest(
    coordinates: tuple[NDArray[np.float64], NDArray[np.float64]],
    values: NDArray[np.float64],
    closed: bool,
    close: float,
) -> tuple[BSpline, float] | None:
    """Return the simplest sheet that is close to values [n, 3], and its rms distance from them.

    If no sheet is close, return the closest one; with too few values, return None.
    """
    best: BSpline | None = None
    best_rms = np.inf
    for intervals, powers in (_TRIED, *_REFINED):
        if len(values) < _CHANNELS_PER_TERM * (intervals + 3) * powers:
            continue
        spline, rms = _fitted(coordinates, values, closed, intervals, powers)
        if rms < 0.5 * best_rms:
            best, best_rms = spline, rms
        if best_rms <= close:
            break
    return None if best is None else (best, best_rms)


def _fitted(
    coordinates: tuple[NDArray[np.float64], NDArray[np.float64]],
    values: NDArray[np.float64],
    closed: bool,
    intervals: int,
    powers: int,
) -> tuple[BSpline, float]:
    """Return the least-squares sheet of values [n, 3], and the rms distance from it.

    Values are cubic splines along it, and polynomials across.
    """
    (along, across), low, high = coordinates, 0.0, 1.0
    if closed:  # near the cut, channels from beyond it guide the splines
        low, high = -_OVERLAP, 1 + _OVERLAP
        turned = np.concatenate([along - 1, along, along + 1])
        near = np.flatnonzero((turned > low) & (turned < high))
        along, across = turned[near], across[near % len(across)]
        values = values[near % len(values)]

    # Each row of the terms has the 4 splines that are not 0 there, times each power.
    knots = np.concatenate([[low] * 3, np.linspace(low, high, intervals + 1), [high] * 3])
    basis = BSpline.design_matrix(along, knots, 3)
    power, splines = np.arange(powers), basis.shape[1]
    factors = basis.data.reshape(-1, 4, 1) * across[:, None, None] ** power
    columns = powers * basis.indices.reshape(-1, 4, 1) + power
    rows = np.arange(len(along) + 1) * (4 * powers)
    terms = csr_array(
        (factors.ravel(), columns.ravel(), rows), shape=(len(along), powers * splines)
    )

    # Terms that are `band` or more apart never coincide, so that the normal equations are banded. A
    # general solver takes ten times as long, and longer still when its threads compete for cores.
    band = 4 * powers
    normal = (terms.T @ terms).toarray()
    lower = np.zeros((band, len(normal)))
    for below in range(min(band, len(normal))):
        lower[below, : len(normal) - below] = np.diagonal(normal, -below)
    lower[0] += _RIDGE * np.trace(normal) / len(normal)
    coefficients = solveh_banded(lower, terms.T @ values, lower=True)

    off = terms @ coefficients - values
    rms = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    return BSpline(knots, coefficients.reshape(splines, powers, 3), 3), rms


def smooth_over_sheet(
    track: MeanTrack, along: NDArray[np.float64], *, either_sign: bool
) -> MeanTrack:
    """Return a track whose positions are smooth directions, the nearest to those of channels.

    Parameters
    ----------
    track : MeanTrack
        A sheet, whose coordinates the result shares.
    along : float64 [channels, 3]
        Directions of the channels.
    either_sign : bool
        True if opposite directions are equivalent, as on a scan to and fro.
    """
    some = some_channels(len(along), _FITTED)
    part, given = track.some(some), along[some]
    assert part.across is not None
    coordinates = part.coordinate, part.across
    signs = [np.ones(len(given))]
    if either_sign:
        # Other signs make directions agree along the sheet or across it, whichever is clearer.
        toward = []
        for axes_m in (part.sheet.tangents_m(*coordinates), part.sheet.sideways_m(*coordinates)):
            length_m = np.maximum(np.linalg.norm(axes_m, axis=1), 1e-30)
            toward.append(np.einsum("ci,ci->c", given, axes_m) / length_m)
        clearest = max(toward, key=lambda each: float(np.abs(each).mean()))
        signs.append(np.where(clearest < 0, -1.0, 1.0))
    fits = [
        _smoothest(coordinates, sign[:, None] * given, track.is_closed, _ALONG_CLOSE)
        for sign in np.unique(signs, axis=0)
    ]
    spline, _ = min((fit for fit in fits if fit is not None), key=lambda fit: fit[1])
    return replace(track, spline=spline)
