"""Directions of the beam along a mean track, or over a sheet; and how fast its weights change."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from clsas.aperture.dense_tracks import smooth_over_sheet
from clsas.aperture.mean_track import MeanTrack
from clsas.sonar.beam import BeamWindow

_END = 0.03  # of a curve: over so much, turning at an end is measured


@dataclass(frozen=True, eq=False)
class BeamDirections:
    """Unit directions of the beam at any place of a mean track.

    Past its ends, where positions go on straight ahead, directions keep turning as at the ends. So
    weights of a beam that stays on a target change there as little as before.

    Attributes
    ----------
    coordinate : float64 [samples]
        Aperture coordinates of a curve's samples; none of a sheet.
    along : float64 [samples, 3]
        Directions there, between which others are interpolated.
    sheet : MeanTrack or None
        Of a sheet: the smooth directions nearest to those of the channels, as its positions.
    """

    coordinate: NDArray[np.float64]
    along: NDArray[np.float64]
    sheet: MeanTrack | None = None

    @classmethod
    def of(
        cls, beam: BeamWindow, channels_along: NDArray[np.float64], track: MeanTrack
    ) -> BeamDirections:
        """Return the directions over a mean track whose channels have directions [channels, 3]."""
        if track.is_sheet:
            smooth = smooth_over_sheet(track, channels_along, either_sign=beam.squint_deg == 0)
            return cls(np.zeros(0), np.zeros((0, 3)), smooth)
        order = np.argsort(track.coordinate, kind="stable")
        sampled = interpolated_directions(
            track.coordinate[order], channels_along[order], track.samples
        )
        return cls(track.samples, _turning_on(track, sampled))

    def at(
        self, coordinate: NDArray[np.float64], across: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return unit directions at aperture coordinates, [..., 3]; in the middle of a sheet."""
        if self.sheet is None:
            return interpolated_directions(self.coordinate, self.along, coordinate)
        return _unit(self.sheet.positions_m(coordinate, across))


def _turning_on(track: MeanTrack, sampled: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return directions at `track.samples` that turn past the curves' ends as before them."""
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
    """Largest phase rate at which a beam's weights change along a line, [boxes, samples].

    Virtual channels must sample the weights, too. An edge of the beam counts as one cycle.

    Parameters
    ----------
    beam : BeamWindow
    line : MeanTrack
    along : float64 [samples, 3]
        Directions of the beam at `line.samples`.
    centres_m : float64 [boxes, 3]
        Middles of boxes. The rates hold at these and at the corners.
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
