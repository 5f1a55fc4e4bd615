"""Directions of the beam anywhere on a mean track, and the rates at which its weights change."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from clsas.aperture.dense_tracks import smooth_over_sheet
from clsas.aperture.mean_track import MeanTrack
from clsas.sonar.beam import BeamWindow

_END = 0.03  # share of a curve over which the turning at an end is measured


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
        return _unit(self.smooth.positions_m(coordinate, across))


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
    order = np.argsort(track.coordinate, kind="stable")
    sampled = interpolated_directions(track.coordinate[order], channels_along[order], track.samples)
    return DirectionsOnCurves(track.samples, _turning_on(track, sampled))


def _turning_on(track: MeanTrack, sampled: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return directions at `track.samples` that keep turning past the ends of curves."""
    strip, result = track.strip_of(track.samples), sampled.copy()
    steps = max(round(_END * track.sampled), 1)
    for number in range(track.strips):
        inside = np.flatnonzero(track.on_track & (strip == number))
        for end, inner in ((inside[0], inside[steps]), (inside[-1], inside[-1 - steps])):
            # An end is the outermost sample on its curve: those beyond it are on the same side.
            beyond = (strip == number) & ~track.on_track
            beyond &= np.sign(track.samples - track.samples[end]) == np.sign(end - inner)
            slope = (sampled[end] - sampled[inner]) / (track.samples[end] - track.samples[inner])
            past = track.samples[beyond] - track.samples[end]
            result[beyond] = sampled[end] + past[:, None] * slope
    return _unit(result)


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


def interpolated_directions(
    given: NDArray[np.float64], along: NDArray[np.float64], coordinate: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return unit directions at aperture coordinates, [..., 3], from those at ascending `given`."""
    between = np.stack([np.interp(coordinate, given, axis) for axis in along.T], axis=-1)
    return _unit(between)


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
        sine = np.einsum("psi,si->ps", sight, along) / np.maximum(distance_m, 1e-9)
        np.maximum(rate, np.abs(np.gradient(sine, line.samples, axis=1)), out=rate)
    return rate / beam.edge
