"""Mean tracks of dense apertures: a strip for each pass, or one sheet.

A single curve cannot follow many passes, a raster scan, a helix or a planar array. Separate passes
get a curve each. Channels close to a smooth sheet are interpolated in both of its dimensions.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from clsas.aperture.mean_track import APART, STRIP_SAMPLES, MeanTrack, mean_track
from clsas.core.lines import RangeLines, some_channels

Shape = Literal["track", "strips", "sheet"]
"""Shape of a mean track: one curve, several curves, or a curve that moves sideways."""

DENSE_SHAPES: tuple[Shape, ...] = ("strips", "sheet")
"""Shapes of the mean tracks of dense apertures."""

_JUMP = 8.0  # median steps between channels; a longer step begins another pass
_LEAST_OF_STRIP = 32  # fewest channels of a strip
_MOST_STRIPS = 128
_MOST_PAIRS = 64.0  # most neighbours of a channel within a jump, on average
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
_SCREENED = 512  # channels by which a single curve is accepted or rejected
_FAR_OFF = 2.0  # rms distance per axis at which one curve is rejected, wavelengths
_CHANNELS_PER_TERM = 4  # fewest channels for each coefficient of a sheet
_RIDGE = 1e-10  # added to normal equations, relative, for coefficients without any channel


def mean_track_of(lines: RangeLines, shape: Shape, wavelength_m: float) -> MeanTrack | None:
    """Return the mean track of a given shape, or None if the channels have no such track.

    Equal geometry and an equal wavelength (see `clsas.core.wavelengths.band_wavelength_m`) give
    equal tracks. A plan therefore contains the shape only.
    """
    of_shape = {"track": mean_track, "strips": strips, "sheet": sheet}
    return of_shape[shape](lines, wavelength_m)


def shapes_after(shape: Shape) -> tuple[Shape, ...]:
    """Return the shapes to try after one that `simplest_track` returned.

    It has already rejected the shapes before that one.
    """
    order = ("track", *DENSE_SHAPES)
    return order[order.index(shape) + 1 :]


def simplest_track(lines: RangeLines, wavelength_m: float) -> tuple[Shape, MeanTrack | None]:
    """Return the simplest mean track and its shape: one curve, unless channels are far from it."""
    if not _follows_one_curve(lines, wavelength_m):
        for shape in DENSE_SHAPES:
            track = mean_track_of(lines, shape, wavelength_m)
            if track is not None:
                return shape, track
    return "track", mean_track(lines, wavelength_m)


def strips(lines: RangeLines, wavelength_m: float) -> MeanTrack | None:
    """Return a track with a curve for each pass, for channels in any order.

    The result is None for a single pass, or if any pass is short.
    """
    bare, centres_m = lines.without_samples(), lines.phase_centres_m
    passes = _following_each_other(centres_m) or _near_each_other(centres_m)
    if passes is None:
        return None
    tracks, coordinate = [], np.empty(lines.channels)
    for number, channels in enumerate(passes):
        track = mean_track(bare.select(channels), wavelength_m)
        if track is None:
            return None
        tracks.append(track)
        coordinate[channels] = APART * number + track.coordinate
    others = tuple(track.spline for track in tracks[1:])
    return MeanTrack(tracks[0].spline, coordinate, others, sampled=STRIP_SAMPLES)


def _following_each_other(centres_m: NDArray[np.float64]) -> list[NDArray[np.int64]] | None:
    """Return the channels of each pass if passes are separated by jumps, else None."""
    steps_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1)
    if not steps_m.size:
        return None
    jumps = np.flatnonzero(steps_m > _JUMP * np.median(steps_m)) + 1
    return _passes(np.split(np.arange(len(centres_m)), jumps))


def _near_each_other(centres_m: NDArray[np.float64]) -> list[NDArray[np.int64]] | None:
    """Return the channels of each pass if passes lie apart, for channels in any order; else None.

    Channels belong to one pass if a chain of near neighbours connects them.
    """
    # This tree takes half as long to build as a balanced one. Searches take longer, but are few.
    count, tree = len(centres_m), KDTree(centres_m, balanced_tree=False, compact_nodes=False)
    some = centres_m[some_channels(count, _SCREENED)]
    # Channels of a helix or a planar array, which have no passes, have many neighbours in a jump.
    step_m = float(np.median(tree.query(some, k=2)[0][:, -1]))
    neighbours = tree.query_ball_point(some, _JUMP * step_m, return_length=True)
    # The mean bounds the memory for pairs: all channels of a platform at rest are neighbours.
    if step_m == 0 or np.median(neighbours) > 2 * _JUMP + 1 or np.mean(neighbours) > _MOST_PAIRS:
        return None
    pairs = tree.query_pairs(_JUMP * step_m, output_type="ndarray")
    joined = coo_array((np.ones(len(pairs), np.int8), tuple(pairs.T)), shape=(count, count))
    number, label = connected_components(joined, directed=False)
    if number > _MOST_STRIPS:
        return None
    return _passes([np.flatnonzero(label == each) for each in range(number)])


def _passes(found: list[NDArray[np.int64]]) -> list[NDArray[np.int64]] | None:
    """Return the channels of passes, or None if passes are too few, too many or too short."""
    short = min(len(each) for each in found) < _LEAST_OF_STRIP
    return found if 1 < len(found) <= _MOST_STRIPS and not short else None


def sheet(lines: RangeLines, wavelength_m: float) -> MeanTrack | None:
    """Return the smooth sheet nearest to the phase centres, or None if they lie on a line.

    A plane, or a ring around the middle, is bent until it follows the channels. The coordinates of
    channels are those on the plane or the ring.
    """
    centres_m = lines.phase_centres_m
    some = some_channels(lines.channels, _FITTED)
    middle_m = centres_m[some].mean(axis=0)
    some_m = centres_m[some] - middle_m
    ranked: list[tuple[float, int, _Surface]] = []
    for surface in _surfaces(some_m):
        coordinates = surface.coordinates(some_m)
        low, high = np.quantile(coordinates[1], [_OUTERMOST, 1 - _OUTERMOST])
        if high - low < _SPREAD:
            continue
        _, rms_m = _fitted(coordinates, some_m, surface.closed, *_TRIED)
        ranked.append((rms_m, len(ranked), surface))
    if not ranked:
        return None
    surface = min(ranked)[2]
    along, across = surface.coordinates(centres_m - middle_m)
    found = _smoothest(
        (along[some], across[some]), some_m, surface.closed, _SHEET_CLOSE * wavelength_m
    )
    if found is None:
        return None
    best, _ = found
    coefficients = best.c.copy()
    coefficients[:, 0] += middle_m
    spline = BSpline(best.t, coefficients, best.k)
    return MeanTrack(spline, along, across=across, is_closed=surface.closed)


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
    assert track.across is not None
    some = some_channels(len(along), _FITTED)
    part, given = track.some(some), along[some]
    assert part.across is not None
    signs = [np.ones(len(given))]
    if either_sign:
        signs.append(_same_way(part, given))
    fits = [
        _smoothest(
            (part.coordinate, part.across), sign[:, None] * given, track.is_closed, _ALONG_CLOSE
        )
        for sign in np.unique(signs, axis=0)
    ]
    spline, _ = min((fit for fit in fits if fit is not None), key=lambda fit: fit[1])
    return replace(track, spline=spline)


def _same_way(track: MeanTrack, along: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return signs that make directions [channels, 3] agree along or across a sheet."""
    assert track.across is not None
    coordinates = track.coordinate, track.across
    toward = []
    for axes_m in (track.tangents_m(*coordinates), track.sheet.sideways_m(*coordinates)):
        length_m = np.maximum(np.linalg.norm(axes_m, axis=1), 1e-30)
        toward.append(np.einsum("ci,ci->c", along, axes_m) / length_m)
    clearest = max(toward, key=lambda each: float(np.abs(each).mean()))
    return np.where(clearest < 0, -1.0, 1.0)


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


def _follows_one_curve(lines: RangeLines, wavelength_m: float) -> bool:
    """Return whether channels may be close to one smooth curve.

    A sample of the channels decides, so that curves are not fitted to a hundred thousand channels
    in vain.
    """
    some = some_channels(lines.channels, _SCREENED)
    if len(some) == lines.channels:
        return True
    track = mean_track(lines.without_samples().select(some), wavelength_m)
    if track is None:
        return True
    off_m = track.offsets_m(lines.phase_centres_m[some])
    return bool(np.sqrt(np.mean(off_m**2)) < _FAR_OFF * wavelength_m)


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


def _scaled(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values moved and scaled to run from 0 to 1."""
    return (values - values.min()) / np.ptp(values)


def _fitted(
    coordinates: tuple[NDArray[np.float64], NDArray[np.float64]],
    position_m: NDArray[np.float64],
    closed: bool,
    intervals: int,
    powers: int,
) -> tuple[BSpline, float]:
    """Return the least-squares sheet of positions [n, 3], and the rms distance from it.

    Positions are cubic splines along it, and polynomials across.
    """
    (along, across), low, high = coordinates, 0.0, 1.0
    if closed:  # near the cut, channels from beyond it guide the splines
        low, high = -_OVERLAP, 1 + _OVERLAP
        turned = np.concatenate([along - 1, along, along + 1])
        near = np.flatnonzero((turned > low) & (turned < high))
        along, across = turned[near], across[near % len(across)]
        position_m = position_m[near % len(position_m)]
    knots = np.concatenate([[low] * 3, np.linspace(low, high, intervals + 1), [high] * 3])
    basis = BSpline.design_matrix(along, knots, 3)
    # Each row has the 4 splines that are not 0 there, times each power.
    power = np.arange(powers)
    values = basis.data.reshape(-1, 4, 1) * across[:, None, None] ** power
    columns = powers * basis.indices.reshape(-1, 4, 1) + power
    rows = np.arange(len(along) + 1) * (4 * powers)
    terms = csr_array(
        (values.ravel(), columns.ravel(), rows), shape=(len(along), powers * basis.shape[1])
    )
    coefficients = _least_squares(terms, position_m, 4 * powers)
    off_m = terms @ coefficients - position_m
    rms_m = float(np.sqrt(np.mean(np.sum(off_m**2, axis=1))))
    return BSpline(knots, coefficients.reshape(basis.shape[1], powers, 3), 3), rms_m


def _least_squares(terms: csr_array, values: NDArray[np.float64], band: int) -> NDArray[np.float64]:
    """Return the coefficients of terms [n, m] that fit values [n, 3] best, [m, 3].

    Terms that are `band` or more apart never coincide, so that the normal equations are banded. A
    general solver takes ten times as long, and longer still when its threads compete for cores.
    """
    normal = (terms.T @ terms).toarray()
    m = len(normal)
    lower = np.zeros((band, m))
    for below in range(min(band, m)):
        lower[below, : m - below] = np.diagonal(normal, -below)
    lower[0] += _RIDGE * np.trace(normal) / m
    return solveh_banded(lower, terms.T @ values, lower=True)
