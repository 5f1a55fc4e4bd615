"""Phase rates along mean tracks, and the motion and stretch of range lines relative to them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from clsas.aperture.mean_track import MeanTrack
from clsas.core.geometry import pairwise_range_m
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines

_MOST_POINTS = 9  # most points along a side of a box at which rates are evaluated
_RATES_AT_ONCE = 1 << 15  # rates evaluated together, which fit into the cache of a core


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
    """Return the stretch of range lines relative to those from the mean track, [points, channels].

    Parameters
    ----------
    tx_m, rx_m, rx_velocity_m_s, sound_speed_m_s
        Positions, velocities and sound speed of the channels, as in RangeLines.
    drift : float64 [3]
        See `drift`.
    plane : Grid
        The plane of the pixels.
    points_m : float64 [points, 3]
    virtual_m : float64 [points, channels, 3]
        Position on the track at which each channel appears from each point.

    Notes
    -----
    The range of a channel grows along its gradient, and that of a position on the track along the
    unit vector from there, minus the drift. Let g be that unit vector, projected onto the plane.
    The component along g of the difference between both gradients stretches the range line about
    the point, which can be compensated. The component across g is small, because channels are
    replaced by positions at their `apparent_coordinates`.

    For a moving receiver, the position at the time when the echo arrives counts. With unit vectors
    u from both antennas,

        gradient = (u_tx + u_rx) / 2 / (1 + u_rx . velocity / c).
    """
    normal = np.cross(*plane.vectors_m[1:])
    normal = normal / max(float(np.linalg.norm(normal)), 1e-300)

    def sight(from_m: NDArray[np.float64]) -> NDArray[np.float64]:
        offset_m = points_m[:, None] - from_m
        return offset_m / np.maximum(np.linalg.norm(offset_m, axis=-1, keepdims=True), 1e-30)

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
    # Directly below the track, ranges hardly grow in the plane; the bound avoids a division by 0.
    return np.einsum("pci,pci->pc", more, along) / np.maximum(square, 1e-3)


def drift(lines: RangeLines) -> NDArray[np.float64]:
    """Return the mean velocity of the receivers divided by the sound speed, [3].

    To first order, motion during flight shortens the range to a point x by drift.(x - channel).
    """
    if lines.rx_velocity_m_s is None:
        return np.zeros(3)
    return lines.rx_velocity_m_s.mean(axis=0) / lines.sound_speed_m_s


def own_drift(lines: RangeLines) -> NDArray[np.float64] | None:
    """Return the drift of each channel minus the mean, [channels, 3]; None if all are equal."""
    if lines.rx_velocity_m_s is None:
        return None
    own = lines.rx_velocity_m_s / lines.sound_speed_m_s - drift(lines)
    return own if np.abs(own).max() > 1e-12 else None


@dataclass(frozen=True, eq=False)
class PhaseBoxes:
    """Boxes in which the phases of subimages are bounded.

    Attributes
    ----------
    steps_m : float64 [axes, 3]
        Steps of an extent of 1 along each axis; see `Surface`.
    centres_m : float64 [boxes, 3]
        Middles of the boxes.
    extents : float64 [axes]
        Extents of the boxes; see `Surface`.
    cycles_per_m : float
        Phase per metre of range.
    nearest_m : float
        Lower bound assumed for distances from the track.
    """

    steps_m: NDArray[np.float64]
    centres_m: NDArray[np.float64]
    extents: NDArray[np.float64]
    cycles_per_m: float
    nearest_m: float


def cycles_per_extent(
    track: MeanTrack,
    boxes: PhaseBoxes,
    limits: tuple[float, float] | None = None,
    along: NDArray[np.float64] | None = None,
    every: int = 1,
) -> NDArray[np.float64]:
    """Return the largest phase rates along curves, per extent of subimages within boxes.

    Parameters
    ----------
    track : MeanTrack
        One curve, or strips.
    boxes : PhaseBoxes
        The rates hold everywhere within them.
    limits : (low, high), optional
        Sines of the aspect angle at which the beam begins and ends; rates beyond are 0. Strips
        ignore them: all their virtual channels are formed and used, wherever beams point.
    along : float64 [samples, 3]
        With limits, the track's unit direction at `track.samples`.
    every : int
        Use only one in `every` samples of the track.

    Returns
    -------
    float64 [axes, boxes, samples]
        Cycles per unit of the aperture coordinate, per row, per column and per metre of relief, at
        `track.samples`.

    Notes
    -----
    The range of a channel to a pixel at d from a subimage's centre c exceeds that to c by e.d,
    where e is the unit vector from the channel to c. Along a track with tangent t, this difference
    changes by -(t - e (e.t)).d / R per unit of the aperture coordinate. The phase of a subimage
    therefore changes at most by its extents times the results. Yegulalp (1999) and Ulander,
    Hellsten and Stenström (2003) bound the same phase to find the sampling of subapertures.
    """
    position_m, tangent_m = (each[::every] for each in track.sampled_m)
    if limits is None or along is None or track.is_dense:
        return largest_rates(position_m, tangent_m, boxes)
    return largest_rates(position_m, tangent_m, boxes, (limits, along[::every]))


def largest_rates(
    position_m: NDArray[np.float64],
    tangent_m: NDArray[np.float64],
    boxes: PhaseBoxes,
    beam: tuple[tuple[float, float], NDArray[np.float64]] | None = None,
) -> NDArray[np.float64]:
    """Return the largest phase rates at some positions: see `cycles_per_extent`.

    Parameters
    ----------
    position_m, tangent_m : float64 [samples, 3]
        Positions on a track, and their derivatives by the aperture coordinate.
    boxes : PhaseBoxes
    beam : (limits, along), optional
        Limits of the beam and directions at the positions, as in `cycles_per_extent`.
    """
    steps_m, extents, nearest_m = boxes.steps_m, boxes.extents, boxes.nearest_m
    sides_m = extents[:, None] * steps_m
    rates = np.zeros((len(steps_m), len(boxes.centres_m), len(position_m)))
    # Products of the line of sight to a point of a box follow from those to its middle.
    sight = boxes.centres_m[:, None] - position_m
    square = np.einsum("psi,psi->ps", sight, sight)
    ahead = np.einsum("psi,si->ps", sight, tangent_m)
    leaning = np.stack([sight @ step for step in steps_m])
    if beam is not None:
        (low, high), along = beam
        sideways = np.einsum("psi,si->ps", sight, along)
    points, between_m = _points_of_box(sides_m, float(np.sqrt(square.min()) + nearest_m))
    together = max(_RATES_AT_ONCE // square.size, 1)
    for start in range(0, len(points), together):
        some = points[start : start + together]
        offset_m = some @ sides_m
        inverse = np.tensordot(2 * some * extents, leaning, 1)
        inverse += square
        inverse += np.einsum("oi,oi->o", offset_m, offset_m)[:, None, None]
        np.maximum(inverse, nearest_m**2, out=inverse)
        np.divide(1, np.sqrt(inverse, out=inverse), out=inverse)
        turn = ahead + (offset_m @ tangent_m.T)[:, None]
        turn *= inverse
        turn *= inverse
        if beam is not None:
            sine, margin = sideways + (offset_m @ along.T)[:, None], between_m * inverse
            sine *= inverse
            inverse[(sine + margin < low) | (sine - margin > high)] = 0  # as if infinitely far
        for rate, step, lean in zip(rates, steps_m, leaning, strict=True):
            here = lean + (offset_m @ step)[:, None, None]
            here *= turn
            np.subtract(tangent_m @ step, here, out=here)
            here *= inverse
            np.maximum(rate, np.abs(here, out=here).max(axis=0), out=rate)
    return boxes.cycles_per_m / 2 * rates


def _points_of_box(
    sides_m: NDArray[np.float64], closest_m: float
) -> tuple[NDArray[np.float64], float]:
    """Return points of a box as fractions of its sides, [n, axes], and half their distance.

    Boxes that are large compared with their distance get more points.
    """
    lengths_m = np.linalg.norm(sides_m, axis=1)
    counts = 3 + 2 * np.clip(lengths_m / closest_m, 0, _MOST_POINTS // 2 - 1).astype(int)
    counts[lengths_m == 0] = 1
    points = product(*(np.linspace(-0.5, 0.5, n) if n > 1 else [0.0] for n in counts))
    apart = 1 / np.maximum(counts - 1, 1)
    return np.array(list(points)), float(np.linalg.norm(apart @ np.abs(sides_m)) / 2)


def cumulative_cycles(track: MeanTrack, rate: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the phase at `track.samples`, the integral of rates [..., samples], in cycles."""
    steps = np.diff(track.samples) * (rate[..., 1:] + rate[..., :-1]) / 2
    return np.concatenate([np.zeros((*rate.shape[:-1], 1)), np.cumsum(steps, axis=-1)], axis=-1)
