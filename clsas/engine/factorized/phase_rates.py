"""How fast phases, beam weights and ranges of channels change, relative to the mean track.

Phase rates bound how far apart virtual channels may lie. The drift and the stretch of range lines
are what a channel off the mean track, or a moving receiver, adds to ranges from the track.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.geometry import SAME_PLACE_M, pairwise_range_m, unit_vectors
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines
from clsas.engine.factorized.track import ACROSS_AT, ALONG_AT, MeanTrack, smooth_over_sheet

_MOST_POINTS = 9  # most points along a side of a box at which rates are evaluated
_RATES_AT_ONCE = 1 << 15  # rates evaluated together, which fit into the cache of a core
_END = 0.03  # share of a curve over which the turning at an end is measured


# Phases of subimages


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

    # Products of the line of sight to the middle of each box, [..., boxes, samples].
    sight = boxes.centres_m[:, None] - position_m
    square = np.einsum("psi,psi->ps", sight, sight)
    ahead = np.einsum("psi,si->ps", sight, tangent_m)
    leaning = np.stack([sight @ step for step in steps_m])
    if beam is not None:
        (low, high), along = beam
        sideways = np.einsum("psi,si->ps", sight, along)

    # Points of a box as fractions of its sides, [n, axes], and half their distance. Boxes that are
    # large compared with their distance get more points.
    closest_m, lengths_m = np.sqrt(square.min()) + nearest_m, np.linalg.norm(sides_m, axis=1)
    counts = 3 + 2 * np.clip(lengths_m / closest_m, 0, _MOST_POINTS // 2 - 1).astype(int)
    counts[lengths_m == 0] = 1
    axes = [np.linspace(-0.5, 0.5, n) if n > 1 else np.zeros(1) for n in counts]
    points = np.array(list(product(*axes)))
    between_m = np.linalg.norm(1 / np.maximum(counts - 1, 1) @ np.abs(sides_m)) / 2

    # Products of the line of sight to a point of a box follow from those to its middle.
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


@dataclass(frozen=True, eq=False)
class SheetRates:
    """Largest phase rates of subimages on a sheet, cycles per unit of a coordinate.

    Attributes
    ----------
    along : float64 [..., samples]
        Rates at the samples of lines along the sheet.
    across : float64 [..., samples]
        Rates at the samples of lines across the sheet.
    """

    along: NDArray[np.float64]
    across: NDArray[np.float64]


def sheet_rates(track: MeanTrack, boxes: PhaseBoxes, every: int = 1) -> SheetRates:
    """Return the largest phase rates of subimages within boxes, along and across a sheet.

    They are [axes, boxes, samples] each, the largest of the rates on several lines. The parameters
    are those of `cycles_per_extent`.
    """
    lines = track.lines_along + track.lines_across
    sampled = [[each[::every] for each in line.sampled_m] for line in lines]
    positions_m, tangents_m = (np.concatenate(each) for each in zip(*sampled, strict=True))
    rates = largest_rates(positions_m, tangents_m, boxes)
    first = len(track.lines_along) * len(sampled[0][0])
    shape = rates.shape[:-1]
    along, across = rates[..., :first], rates[..., first:]
    return SheetRates(
        along.reshape(*shape, len(track.lines_along), -1).max(axis=-2),
        across.reshape(*shape, len(track.lines_across), -1).max(axis=-2),
    )


# Directions of the beam, and its weights


@dataclass(frozen=True, eq=False)
class DirectionsOnCurves:
    """Unit directions of the beam anywhere on one curve or on strips.

    Past the ends of a curve, where positions continue straight, directions keep turning as they do
    at the ends. The weights of a beam that stays on a target thus change no faster there.

    Attributes
    ----------
    coordinate : float64 [samples]
        Aperture coordinates of samples, ascending.
    along : float64 [samples, 3]
        Directions at the samples, between which others are interpolated.
    """

    coordinate: NDArray[np.float64]
    along: NDArray[np.float64]

    def at(
        self, coordinate: NDArray[np.float64], across: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return directions at aperture coordinates, [..., 3]; `across` has no effect."""
        return interpolated_directions(self.coordinate, self.along, coordinate)


@dataclass(frozen=True, eq=False)
class DirectionsOnSheet:
    """Unit directions of the beam anywhere on a sheet.

    Attributes
    ----------
    smooth : MeanTrack
        Its positions are smooth directions, the nearest to those of the channels.
    """

    smooth: MeanTrack

    def at(
        self, coordinate: NDArray[np.float64], across: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return directions at coordinates along and across, [..., 3]; by default in the middle."""
        return unit_vectors(self.smooth.positions_m(coordinate, across))


BeamDirections = DirectionsOnCurves | DirectionsOnSheet


def directions_of(
    beam: BeamWindow, channels_along: NDArray[np.float64], track: MeanTrack
) -> BeamDirections:
    """Return the directions of a beam over a mean track.

    Parameters
    ----------
    beam : BeamWindow
    channels_along : float64 [channels, 3]
        Directions of the track's channels.
    track : MeanTrack
    """
    if track.is_sheet:
        either_sign = beam.squint_deg == 0
        return DirectionsOnSheet(smooth_over_sheet(track, channels_along, either_sign=either_sign))
    samples, order = track.samples, np.argsort(track.coordinate, kind="stable")
    sampled = interpolated_directions(track.coordinate[order], channels_along[order], samples)

    # Past both ends of each curve, continue the turning over the last samples before the end.
    strip, along = track.strip_of(samples), sampled.copy()
    steps = max(round(_END * track.sampled), 1)
    for number in range(track.strips):
        inside = np.flatnonzero(track.on_track & (strip == number))
        for end, inner in ((inside[0], inside[steps]), (inside[-1], inside[-1 - steps])):
            # An end is the outermost sample on its curve: those beyond it are on the same side.
            beyond = (strip == number) & ~track.on_track
            beyond &= np.sign(samples - samples[end]) == np.sign(end - inner)
            slope = (sampled[end] - sampled[inner]) / (samples[end] - samples[inner])
            along[beyond] = sampled[end] + (samples[beyond] - samples[end])[:, None] * slope
    return DirectionsOnCurves(samples, unit_vectors(along))


def interpolated_directions(
    given: NDArray[np.float64], along: NDArray[np.float64], coordinate: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return unit directions at aperture coordinates, [..., 3], from those at ascending `given`."""
    return unit_vectors(np.stack([np.interp(coordinate, given, axis) for axis in along.T], axis=-1))


def beam_rate(
    beam: BeamWindow,
    line: MeanTrack,
    along: NDArray[np.float64],
    centres_m: NDArray[np.float64],
    sides_m: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the largest rates at which a beam's weights change along a line, [boxes, samples].

    Virtual channels must sample these weights, too. The rates are those of a phase that turns by
    one cycle over an edge of the beam, per unit of the aperture coordinate.

    Parameters
    ----------
    beam : BeamWindow
    line : MeanTrack
    along : float64 [samples, 3]
        Directions of the beam at `line.samples`.
    centres_m : float64 [boxes, 3]
        Middles of boxes. The rates are the largest of those at the middle and at the corners.
    sides_m : float64 [axes, 3]
        Sides of the boxes.
    """
    corners = [np.array(each) for each in product((-0.5, 0.5), repeat=len(sides_m))]
    offsets_m = [np.zeros(3), *(each @ sides_m for each in corners if sides_m.any())]
    rate = np.zeros((len(centres_m), len(line.samples)))
    for offset_m in offsets_m:
        sight = (centres_m + offset_m)[:, None] - line.sampled_m[0]
        distance_m = np.sqrt(np.einsum("psi,psi->ps", sight, sight))
        sine = np.einsum("psi,si->ps", sight, along) / np.maximum(distance_m, SAME_PLACE_M)
        np.maximum(rate, np.abs(np.gradient(sine, line.samples, axis=1)), out=rate)
    return rate / beam.edge


def sheet_beam_rates(
    beam: BeamWindow,
    track: MeanTrack,
    directions: BeamDirections,
    centres_m: NDArray[np.float64],
    sides_m: NDArray[np.float64],
) -> SheetRates:
    """Return the largest rates of a beam's weights, [boxes, samples] each: see `beam_rate`."""
    along, across = [], []
    for at, line in zip(ALONG_AT, track.lines_along, strict=True):
        there = directions.at(line.samples, np.full(line.samples.shape, at))
        along.append(beam_rate(beam, line, there, centres_m, sides_m))
    for at, line in zip(ACROSS_AT, track.lines_across, strict=True):
        there = directions.at(np.full(line.samples.shape, at), line.samples)
        across.append(beam_rate(beam, line, there, centres_m, sides_m))
    return SheetRates(np.max(along, axis=0), np.max(across, axis=0))


# Ranges relative to those from the track


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
    along = _sight(points_m, virtual_m)
    if rx_velocity_m_s is None:
        more = (_sight(points_m, tx_m) + _sight(points_m, rx_m)) / 2 - along
    else:
        range_m = pairwise_range_m(points_m, tx_m, rx_m, rx_velocity_m_s, sound_speed_m_s)
        speed = rx_velocity_m_s / sound_speed_m_s
        from_rx = _sight(points_m, rx_m + 2 * range_m[..., None] * speed)
        later = 1 + np.einsum("pci,ci->pc", from_rx, speed)
        more = (_sight(points_m, tx_m) + from_rx) / 2 / later[..., None] - along + drift
    normal = np.cross(*plane.vectors_m[1:])
    normal = normal / max(float(np.linalg.norm(normal)), 1e-300)
    along = along - (along @ normal)[..., None] * normal
    square = np.einsum("pci,pci->pc", along, along)
    # Directly below the track, ranges do not grow in the plane; the bound avoids a division by 0.
    return np.einsum("pci,pci->pc", more, along) / np.maximum(square, 1e-3)


def _sight(points_m: NDArray[np.float64], from_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit vectors to points from positions [channels, 3] or [points, channels, 3]."""
    return unit_vectors(points_m[:, None] - from_m)
