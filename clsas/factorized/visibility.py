"""Visibility: the stretches of the track from which a beam covers subimages."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsas.aperture.mean_track import MeanTrack
from clsas.sonar.visibility import BeamTrack, Boxes

_STEP = 2  # step between the samples of the track at which visibility is evaluated
_MARGIN = 0.2  # margin for motion of the beam between such samples, in steps between them


def visible_stretches(
    limits: tuple[float, float] | None,
    track: MeanTrack,
    along: NDArray[np.float64] | None,
    centres_m: NDArray[np.float64],
    half_m: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the stretch of the track from which each box is visible.

    Parameters
    ----------
    limits : (low, high), optional
        Sines of the aspect angle at which the beam begins and ends. Without them, each box is
        visible from everywhere.
    track : MeanTrack
    along : float64 [samples, 3]
        The track's direction at `track.samples`; not needed without limits.
    centres_m : float64 [..., 3]
        Middles of the boxes.
    half_m : float64 [axes, 3]
        Half the sides of the boxes, as vectors.

    Returns
    -------
    begin, end : float64 [...]
        First and last aperture coordinate. Where a box is visible from an end of the track, that
        one is infinite; where a box is invisible, both are -inf.
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
    # A box outside the beams of all samples may be visible from a point between two samples.
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
        -1 towards the first sample of the track, 1 towards the last.
    """
    beyond = (outermost == 0) if outward < 0 else (outermost == len(coordinate) - 1)
    index = outermost[:, None] + outward * np.array([1, 0, -1])
    index = index.clip(0, len(coordinate) - 1)
    outside, inside, further = beam.depth(boxes, index).T
    # The depth changes almost linearly between two samples, unless its maximum is there.
    even = (further > inside) & (outside <= 0)
    share = np.divide(outside, outside - inside, out=np.full(len(boxes), _MARGIN), where=even)
    share = (share - _MARGIN).clip(0)
    next_one = coordinate[index[:, 0]]
    crossing = next_one + share * (coordinate[outermost] - next_one)
    return np.where(beyond, outward * np.inf, crossing)
