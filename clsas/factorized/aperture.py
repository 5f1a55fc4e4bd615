"""The aperture as a curve: where channels lie on it, and how densely a subimage must sample it."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_lsq_spline

from clsas.core.geometry import pairwise_range_m
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.factorized.surface import Surface

_POINTS = 257  # along the track, where rates are evaluated
_MOST_PLACES = 9  # along a side of a box, where rates are evaluated
_BEYOND = 12  # points past either end, each twice as far as the one before
_TOGETHER = 1 << 15  # rates that are evaluated together
_CHANNELS_PER_KNOT = 16
_MOST_INTERVALS = 64
_CLOSE_ENOUGH = 0.01  # distance of phase centres from the track, wavelengths rms


@dataclass(frozen=True, eq=False)
class MeanTrack:
    """A smooth curve along the phase centres, (tx + rx)/2, continued straight past its ends.

    Attributes
    ----------
    spline : BSpline
        Position in metres [3] over the parameter, 0 to 1.
    place : float64 [channels]
        Parameter of the point of the curve next to each phase centre.
    """

    spline: BSpline
    place: NDArray[np.float64]

    def positions_m(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the curve's positions, [..., 3]."""
        inside = np.clip(place, 0, 1)
        position_m = self.spline(inside)
        beyond = inside != place
        way = (place - inside)[beyond]
        position_m[beyond] += way[:, None] * self.spline(inside[beyond], 1)
        return position_m

    def tangents_m(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivative of the position by the parameter, [..., 3]."""
        return self.spline(np.clip(place, 0, 1), 1)

    @functools.cached_property
    def samples(self) -> NDArray[np.float64]:
        """Parameters at which rates along the curve are evaluated, past its ends too, [n]."""
        beyond = 2.0 ** np.arange(1 - _BEYOND, 1) * 4
        return np.concatenate([-beyond[::-1], np.linspace(0, 1, _POINTS), 1 + beyond])

    @functools.cached_property
    def sampled_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions and tangents at `samples`, [n, 3] each."""
        return self.positions_m(self.samples), self.tangents_m(self.samples)

    def places_seen_from(
        self,
        points_m: NDArray[np.float64],
        phase_centres_m: NDArray[np.float64],
        own_drift: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """Return where phase centres appear on the curve when seen from some points.

        A channel off the curve is replaced by the point of the curve in the same direction: what
        is left is a difference of distance, which matters least. What a receiver moves by during
        flight moves the phase centre by half as much.

        Parameters
        ----------
        points_m : float64 [points, 3]
        phase_centres_m : float64 [channels, 3]
            The channels of `place`.
        own_drift : float64 [channels, 3], optional
            See `own_drift`.

        Returns
        -------
        float64 [points, channels]
        """
        curve_m = self.positions_m(self.place)
        off_m = (phase_centres_m - curve_m)[None]
        shape = (len(points_m), len(self.place))
        if own_drift is None and not np.abs(off_m).max() > 1e-9:
            return np.broadcast_to(self.place, shape)
        tangent = self.tangents_m(self.place)
        sight = points_m[:, None] - phase_centres_m
        square = np.einsum("pci,pci->pc", sight, sight)
        square = np.maximum(square, 1e-30)
        if own_drift is not None:
            off_m = off_m + np.sqrt(square)[..., None] * own_drift
        along = np.einsum("pci,ci->pc", sight, tangent)
        across = np.sum(sight * off_m, axis=-1)
        both = np.sum(tangent * off_m, axis=-1) - along * across / square
        length = np.einsum("ci,ci->c", tangent, tangent)
        # Where the curve leads towards the point, direction says nothing about the place.
        seen = np.maximum(length - along**2 / square, 0.01 * length)
        return self.place + both / seen


def mean_track(lines: RangeLines) -> MeanTrack | None:
    """Return a curve along the phase centres of lines, or None where they all coincide.

    The channels may come in any order: as given, along the principal axis and around the middle
    are tried, and the shortest way through the phase centres is taken. The curve gets as many
    intervals as it takes to follow them.
    """
    centres_m = lines.phase_centres_m
    order, along = _order(centres_m)
    if along[-1] == 0:
        return None
    position_m, along = centres_m[order], along / along[-1]
    close_m = _CLOSE_ENOUGH * lines.sound_speed_m_s / max(lines.carrier_hz, 1.0)
    best, best_m, intervals = None, np.inf, 1
    while intervals <= min(_MOST_INTERVALS, max(lines.channels // _CHANNELS_PER_KNOT, 1)):
        spline = _fit(along, position_m, intervals)
        off_m = np.sqrt(np.mean(np.sum((spline(along) - position_m) ** 2, axis=1)))
        if off_m < 0.8 * best_m:
            best, best_m = spline, off_m
        if best_m <= close_m:
            break
        intervals *= 2
    place = np.empty(len(along))
    place[order] = along
    track = MeanTrack(best, place)
    for _ in range(3):
        tangent = track.tangents_m(place)
        away = centres_m - track.positions_m(place)
        square = np.maximum(np.einsum("ci,ci->c", tangent, tangent), 1e-30)
        place = place + np.clip(np.einsum("ci,ci->c", away, tangent) / square, -0.1, 0.1)
        track = MeanTrack(best, place)
    return track


def stretches(
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
    rx_velocity_m_s: NDArray[np.float64] | None,
    sound_speed_m_s: float,
    drift: NDArray[np.float64],
    plane: Grid,
    points_m: NDArray[np.float64],
    virtual_m: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return by how much faster channels' ranges grow than those of places that stand for them.

    The range of a channel grows along its gradient, that of a place on the track along the unit
    vector from there less the drift. Of what these differ by, the part along g, the unit vector
    within the plane, is a stretch of the range line about the point, and can be made up for;
    places_seen_from leaves little across it. Of a receiver in motion, where it is when an echo
    arrives counts, and the later that is the further it has come: with unit vectors u from both,

        gradient = (u_tx + u_rx) / 2 / (1 + u_rx . velocity / c).

    Parameters
    ----------
    tx_m, rx_m, rx_velocity_m_s, sound_speed_m_s
        Of the channels, as in RangeLines.
    drift : float64 [3]
        See `drift`.
    points_m : float64 [points, 3]
    virtual_m : float64 [points, channels, 3]
        For every channel a place on the track.

    Returns
    -------
    float64 [points, channels]
    """
    normal = np.cross(plane.row_step_m, plane.column_step_m)
    normal = normal / max(np.linalg.norm(normal), 1e-300)

    def sight(from_m: NDArray[np.float64]) -> NDArray[np.float64]:
        way = points_m[:, None] - from_m
        return way / np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-30)

    along = sight(virtual_m)
    if rx_velocity_m_s is None:
        more = (sight(tx_m) + sight(rx_m)) / 2 - along
    else:
        range_m = pairwise_range_m(points_m, tx_m, rx_m, rx_velocity_m_s, sound_speed_m_s)
        speed = rx_velocity_m_s / sound_speed_m_s
        from_rx = sight(rx_m + 2 * range_m[..., None] * speed)
        later = 1 + np.einsum("pci,ci->pc", from_rx, speed)
        more = (sight(tx_m) + from_rx) / 2 / later[..., None] - along + drift
    along = along - (along @ normal)[..., None] * normal
    square = np.einsum("pci,pci->pc", along, along)
    # Right below the track ranges do not grow at all.
    return np.einsum("pci,pci->pc", more, along) / np.maximum(square, 1e-3)


def drift(lines: RangeLines) -> NDArray[np.float64]:
    """Return the mean velocity of the receivers over the sound speed, [3].

    Motion during flight makes the range to a point x smaller by drift.(x - channel), to first
    order: what lines of one velocity share.
    """
    if lines.rx_velocity_m_s is None:
        return np.zeros(3)
    return lines.rx_velocity_m_s.mean(axis=0) / lines.sound_speed_m_s


def own_drift(lines: RangeLines) -> NDArray[np.float64] | None:
    """Return by how much every channel's drift differs from their mean, [channels, 3], if any."""
    if lines.rx_velocity_m_s is None:
        return None
    own = lines.rx_velocity_m_s / lines.sound_speed_m_s - drift(lines)
    return own if np.abs(own).max() > 1e-12 else None


def cycles_per_extent(
    track: MeanTrack,
    surface: Surface,
    centres_m: NDArray[np.float64],
    extents: NDArray[np.float64],
    cycles_per_m: float,
    nearest_m: float,
    limits: tuple[float, float] | None = None,
    along: NDArray[np.float64] | None = None,
    every: int = 1,
) -> NDArray[np.float64]:
    """Return how fast phases turn along the track for subimages inside larger ones.

    A channel's range to a pixel at d from a subimage's centre c exceeds that to c by e.d, with e
    the direction from the channel to c. Along the track, of tangent t, that changes by
    -(t - e (e.t)).d / R: for subimages of some extents the phase turns by at most these times the
    results, in cycles per unit of the track's parameter.

    Parameters
    ----------
    centres_m : float64 [n, 3]
        Middles of boxes of some extents; the result holds everywhere within them.
    extents : float64 [axes]
        See `Surface`.
    cycles_per_m : float
        Phase per metre of range.
    nearest_m : float
        Distance below which the track is taken not to come.
    limits : (low, high), optional
        Sines of the aspect angle beyond which nothing counts.
    along : float64 [samples, 3]
        With limits, the track's unit direction at `track.samples`.
    every : int
        Of the track's samples only one in so many.

    Returns
    -------
    float64 [axes, n, samples]
        Per row, per column and per metre of relief, at `track.samples`.
    """
    position, tangent = (each[::every] for each in track.sampled_m)
    along = along if along is None else along[::every]
    steps = surface.steps_m
    sides_m = extents[:, None] * steps
    rates = np.zeros((len(steps), len(centres_m), len(position)))
    # Products of the sight to a place in a box follow from those of that to its middle.
    sight = centres_m[:, None] - position
    square = np.einsum("psi,psi->ps", sight, sight)
    ahead = np.einsum("psi,si->ps", sight, tangent)
    leaning = np.stack([sight @ step for step in steps])
    sideways = None if limits is None else np.einsum("psi,si->ps", sight, along)
    # Places in a box lie closer where it is large against its distance.
    closest_m = np.sqrt(square.min()) + nearest_m
    counts = 3 + 2 * np.clip(
        np.linalg.norm(sides_m, axis=1) / closest_m, 0, _MOST_PLACES // 2 - 1
    ).astype(int)
    counts[extents == 0] = 1
    parts = np.array(
        list(product(*(np.linspace(-0.5, 0.5, n) if n > 1 else [0.0] for n in counts)))
    )
    apart = 1 / np.maximum(counts - 1, 1)
    between_m = np.linalg.norm(apart @ np.abs(sides_m)) / 2
    together = max(_TOGETHER // square.size, 1)
    for start in range(0, len(parts), together):
        some = parts[start : start + together]
        offset_m = some @ sides_m
        inverse = np.tensordot(2 * some * extents, leaning, 1)
        inverse += square
        inverse += np.einsum("oi,oi->o", offset_m, offset_m)[:, None, None]
        np.maximum(inverse, nearest_m**2, out=inverse)
        np.divide(1, np.sqrt(inverse, out=inverse), out=inverse)
        turn = ahead + (offset_m @ tangent.T)[:, None]
        turn *= inverse
        turn *= inverse
        if limits is not None:
            low, high = limits
            sine, reach = sideways + (offset_m @ along.T)[:, None], between_m * inverse
            sine *= inverse
            inverse[(sine + reach < low) | (sine - reach > high)] = 0  # as if far away
        for rate, step, lean in zip(rates, steps, leaning, strict=True):
            here = lean + (offset_m @ step)[:, None, None]
            here *= turn
            np.subtract(tangent @ step, here, out=here)
            here *= inverse
            np.maximum(rate, np.abs(here, out=here).max(axis=0), out=rate)
    return cycles_per_m / 2 * rates


def turned(track: MeanTrack, rate: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the integral of rates [..., samples] along the track: cycles at `track.samples`."""
    steps = np.diff(track.samples) * (rate[..., 1:] + rate[..., :-1]) / 2
    return np.concatenate([np.zeros((*rate.shape[:-1], 1)), np.cumsum(steps, axis=-1)], axis=-1)


def _order(centres_m: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the order of phase centres along the track, and how far along it each lies, metres."""
    if len(centres_m) == 1:
        return np.zeros(1, np.int64), np.zeros(1)
    away = centres_m - centres_m.mean(axis=0)
    first, second = np.linalg.svd(away, full_matrices=False)[2][:2] @ away.T
    candidates = (
        np.arange(len(centres_m)),
        np.argsort(first, kind="stable"),
        np.argsort(np.arctan2(second, first), kind="stable"),
    )
    best = None
    for order in candidates:
        steps = np.linalg.norm(np.diff(centres_m[order], axis=0), axis=1)
        if best is None or steps.sum() < 0.999 * best[1][-1]:
            best = order, np.concatenate([[0.0], np.cumsum(steps)])
    return best


def _fit(along: NDArray[np.float64], position_m: NDArray[np.float64], intervals: int) -> BSpline:
    """Return the least-squares cubic spline of positions [n, 3], with knots where channels are."""
    distinct, index = np.unique(along, return_index=True)
    degree = min(3, len(distinct) - 1)
    inner = np.quantile(distinct, np.arange(1, intervals) / intervals)
    knots = np.concatenate([[0.0] * (degree + 1), inner, [1.0] * (degree + 1)])
    middle = position_m.mean(axis=0)
    fitted = make_lsq_spline(distinct, position_m[index] - middle, knots, k=degree)
    return BSpline(fitted.t, fitted.c + middle, degree)
