"""Visibility along the track: the stretch from which a beam covers a subimage."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsas.aperture.mean_track import MeanTrack
from clsas.sonar.visibility import BeamTrack, Boxes

_STEP = 2  # visibility is evaluated at every second sample of the track
_MARGIN = 0.2  # of the step between two such samples, for what the beam does in between


def visible_stretches(
    limits: tuple[float, float] | None,
    track: MeanTrack,
    along: NDArray[np.float64] | None,
    centres_m: NDArray[np.float64],
    half_m: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the stretch of the track from which each box is visible: two arrays [...].

    They hold the first and the last aperture coordinate. These are infinite where the box is
    visible from an end of the track, and both -inf where it is invisible.

    Parameters
    ----------
    limits : (low, high), optional
        Sines of the aspect angle at which the beam begins and ends. Without them every box is
        visible from everywhere.
    track : MeanTrack
    along : float64 [samples, 3]
        The track's direction at `track.samples`; not needed without limits.
    centres_m : float64 [..., 3]
    half_m : float64 [axes, 3]
        Half the boxes' sides, as vectors.
    """
    shape = centres_m.shape[:-1]
    if limits is None or along is None:
        return np.full(shape, -np.inf), np.full(shape, np.inf)
    on_track = np.flatnonzero(track.on_track)[::_STEP]
    coordinate = track.samples[on_track]
    beam = BeamTrack(limits, track.sampled_m[0][on_track], along[on_track])
    boxes = Boxes.equal(centres_m.reshape(-1, 3), half_m)
    spans = beam.spans(boxes)
    begin, end = np.full(len(boxes), -np.inf), np.full(len(boxes), -np.inf)
    # A box that no sample's beam touches may be visible from between two samples.
    bounds = np.concatenate([[-np.inf], coordinate[1:-1], [np.inf]])
    ever = spans.earliest <= spans.latest
    begin[ever] = bounds[np.maximum(spans.earliest[ever] - 1, 0)]
    end[ever] = bounds[np.minimum(spans.latest[ever] + 1, len(coordinate) - 1)]
    found = np.flatnonzero(spans.first <= spans.last)
    for edge, outermost, outward in ((begin, spans.first[found], -1), (end, spans.last[found], 1)):
        edge[found] = _crossing(beam, coordinate, boxes[found], outermost, outward)
    return begin.reshape(shape), end.reshape(shape)


def _crossing(
    beam: BeamTrack,
    coordinate: NDArray[np.float64],
    boxes: Boxes,
    outermost: NDArray[np.int64],
    outward: int,
) -> NDArray[np.float64]:
    """Return the aperture coordinate at which the beam begins to touch each box, [boxes].

    Parameters
    ----------
    beam : BeamTrack
    coordinate : float64 [samples]
        Aperture coordinates of its positions.
    boxes : Boxes
    outermost : int64 [boxes]
        Outermost sample whose beam touches each box.
    outward : int
        -1 or 1, towards the track's first or last sample.
    """
    beyond = (outermost == 0) if outward < 0 else (outermost == len(coordinate) - 1)
    index = outermost[:, None] + outward * np.array([1, 0, -1])
    index = index.clip(0, len(coordinate) - 1)
    outside, inside, further = beam.depth(boxes, index).T
    # The depth changes nearly evenly between two samples, unless it is largest there.
    even = (further > inside) & (outside <= 0)
    share = np.divide(outside, outside - inside, out=np.full(len(boxes), _MARGIN), where=even)
    share = (share - _MARGIN).clip(0)
    next_one = coordinate[index[:, 0]]
    crossing = next_one + share * (coordinate[outermost] - next_one)
    return np.where(beyond, outward * np.inf, crossing)
