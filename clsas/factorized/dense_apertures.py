"""Mean tracks of dense apertures: strips, one for each pass, and sheets along which all channels lie.

One curve does not follow many passes, a raster scan, a helix or a planar array. Passes apart from
each other get a curve each. Channels close to a smooth sheet are interpolated in both of its
dimensions.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from clsas.core.lines import RangeLines, wavelength_m
from clsas.factorized.aperture import (
    APART,
    CLOSE_ENOUGH,
    STRIP_SAMPLES,
    MeanTrack,
    mean_track,
)

Shape = Literal["track", "strips", "sheet"]
"""Mean tracks of one curve, of several, or of a curve that moves sideways."""

DENSE_SHAPES: tuple[Shape, ...] = ("strips", "sheet")
"""Shapes of the mean tracks of dense apertures."""

_JUMP = 8.0  # median steps from channel to channel, from which on another pass begins
_LEAST_OF_STRIP = 32  # channels
_MOST_STRIPS = 128
_FITTED = 1024  # channels to which a sheet is fitted
_INTERVALS = (1, 4, 16, 64)  # of a sheet's splines
_POWERS = (2, 3)  # coefficients across a sheet: straight, or bent
_CHANNELS_PER_TERM = 4
_RIDGE = 1e-10  # of the normal equations, where no channel determines a coefficient


def mean_track_of(lines: RangeLines, shape: Shape) -> MeanTrack | None:
    """Return the mean track of some shape, None if channels have none such.

    Equal geometry gives equal tracks: a plan holds the shape only.
    """
    if shape == "track":
        return mean_track(lines)
    return strips(lines) if shape == "strips" else sheet(lines)


def strips(lines: RangeLines) -> MeanTrack | None:
    """Return a track with a curve for each pass: channels follow each other without a jump.

    None for a single pass, and where passes are short.
    """
    bare, centres_m = lines.without_samples(), lines.phase_centres_m
    steps_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1)
    if not steps_m.size:
        return None
    jumps = np.flatnonzero(steps_m > _JUMP * np.median(steps_m)) + 1
    bounds = np.concatenate([[0], jumps, [lines.channels]])
    if not 1 <= len(jumps) < _MOST_STRIPS or np.diff(bounds).min() < _LEAST_OF_STRIP:
        return None
    found = [
        mean_track(bare.select(slice(int(a), int(b))))
        for a, b in zip(bounds[:-1], bounds[1:], strict=True)
    ]
    tracks = [track for track in found if track is not None]
    if len(tracks) < len(found):
        return None
    coordinate = [APART * n + track.coordinate for n, track in enumerate(tracks)]
    others = tuple(track.spline for track in tracks[1:])
    return MeanTrack(tracks[0].spline, np.concatenate(coordinate), others, sampled=STRIP_SAMPLES)


def sheet(lines: RangeLines) -> MeanTrack | None:
    """Return the smooth sheet nearest to the phase centres, None if they lie on a line.

    A plane, or a ring around the middle, is bent until it follows the channels. Every channel is
    given the coordinates of the plane or the ring.
    """
    centres_m = lines.phase_centres_m
    some = np.linspace(0, lines.channels - 1, min(_FITTED, lines.channels)).astype(int)
    middle_m = centres_m.mean(axis=0)
    close_m = CLOSE_ENOUGH * wavelength_m(lines)
    best, best_m, chosen = None, np.inf, None
    for along, across in _coordinates(centres_m - middle_m):
        for powers in _POWERS:
            for intervals in _INTERVALS:
                terms = (intervals + 3) * powers
                if len(some) < _CHANNELS_PER_TERM * terms or best_m <= close_m:
                    break
                spline = _fitted(along[some], across[some], centres_m[some] - middle_m, intervals, powers)
                track = MeanTrack(spline, along[some], across=across[some])
                off_m = centres_m[some] - middle_m - track.positions_m(along[some], across[some])
                rms_m = float(np.sqrt(np.mean(np.sum(off_m**2, axis=1))))
                if rms_m < 0.5 * best_m:
                    best, best_m, chosen = spline, rms_m, (along, across)
    if best is None or chosen is None:
        return None
    coefficients = best.c.copy()
    coefficients[:, 0] += middle_m
    spline = BSpline(best.t, coefficients, best.k)
    return MeanTrack(spline, chosen[0], across=chosen[1])


def _coordinates(
    offset_m: NDArray[np.float64],
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Yield coordinates of channels along and across a plane, and rings, each from 0 to 1."""
    axes = np.linalg.eigh(offset_m.T @ offset_m)[1].T[::-1]
    first, second, third = axes @ offset_m.T
    if np.ptp(second) <= 1e-6 * np.ptp(first):
        return
    yield _scaled(first), _scaled(second)
    for one, other, axis in ((first, second, third), (second, third, first)):
        if np.ptp(axis) <= 1e-6 * np.ptp(first):
            continue
        # The circle of least squares: x^2 + y^2 = 2 a x + 2 b y + c.
        terms = np.stack([2 * one, 2 * other, np.ones_like(one)], axis=1)
        a, b, _ = np.linalg.lstsq(terms, one**2 + other**2, rcond=None)[0]
        angle = np.arctan2(other - b, one - a)
        ordered = np.sort(angle)
        gaps = np.diff(ordered, append=ordered[0] + 2 * np.pi)
        # The ring is cut in its widest gap.
        start = ordered[(int(gaps.argmax()) + 1) % len(ordered)]
        yield _scaled((angle - start) % (2 * np.pi)), _scaled(axis)


def _scaled(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values moved and scaled to run from 0 to 1."""
    return (values - values.min()) / np.ptp(values)


def _fitted(
    along: NDArray[np.float64],
    across: NDArray[np.float64],
    position_m: NDArray[np.float64],
    intervals: int,
    powers: int,
) -> BSpline:
    """Return the least-squares sheet of positions [n, 3]: cubic along, a polynomial across."""
    knots = np.concatenate([[0.0] * 3, np.linspace(0, 1, intervals + 1), [1.0] * 3])
    basis = BSpline.design_matrix(along, knots, 3).toarray()
    terms = (basis[:, :, None] * across[:, None, None] ** np.arange(powers)).reshape(len(along), -1)
    normal = terms.T @ terms
    normal += _RIDGE * np.trace(normal) / len(normal) * np.eye(len(normal))
    coefficients = np.linalg.solve(normal, terms.T @ position_m)
    return BSpline(knots, coefficients.reshape(basis.shape[1], powers, 3), 3)
