import numpy as np
import pytest

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.visibility import BeamTrack, Boxes, Visibility, sines

BEAMS = {
    "narrow": BeamWindow(2, "hann"),
    "squinted": BeamWindow(12, squint_deg=25),
    "wide": BeamWindow(90),
    "backward": BeamWindow(20, squint_deg=-75),
    "all round": BeamWindow(180),
}


def bent_track(count, seed=1):
    """Return positions along a noisy curve, and unit directions that also sway."""
    rng = np.random.default_rng(seed)
    part = np.linspace(-1, 1, count)
    position_m = np.stack([25 * part, 3 * np.sin(4 * part), 0.5 * part], axis=1)
    position_m += rng.normal(0, 0.05, position_m.shape) + [1e6, -2e6, 0]
    along = np.stack([1 + 0 * part, 0.4 * np.cos(4 * part), rng.normal(0, 0.02, count)], axis=1)
    return position_m, along / np.linalg.norm(along, axis=1, keepdims=True)


def some_boxes(count, largest_m, seed=2):
    """Return boxes near the track and far from it, and some that the track runs through."""
    rng = np.random.default_rng(seed)
    axes_m = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    centres_m = rng.uniform([-45, -2, -3], [45, 60, 3], (count, 3)) + [1e6, -2e6, 0]
    return Boxes(centres_m, axes_m, rng.uniform(0, largest_m, (count, 3)))


def touched(beam, boxes, position_m, along, points=400, seed=3):
    """Return the positions whose beam touches any of many points in boxes, corners included."""
    rng = np.random.default_rng(seed)
    inside = rng.uniform(-1, 1, (points, 3))
    inside[: points // 2] = np.sign(inside[: points // 2])  # corners
    low, high = beam.limits
    found = []
    for centre_m, half in zip(boxes.centres_m, boxes.half, strict=True):
        sine = sines(centre_m + inside * half @ boxes.axes_m, position_m, along)
        found.append(((sine > low) & (sine < high)).any(axis=1))
    return np.array(found)


@pytest.mark.parametrize("largest_m", [0.3, 8.0])
@pytest.mark.parametrize("count", [1, 2, 17, 700])
@pytest.mark.parametrize("name", BEAMS)
def test_no_position_that_touches_a_box_is_missed(name, count, largest_m):
    beam, boxes = BEAMS[name], some_boxes(60, largest_m)
    position_m, along = bent_track(count)
    track = BeamTrack(beam.limits, position_m, along)
    seen = touched(beam, boxes, position_m, along)
    found = track.touching(boxes)
    assert not (seen & ~found).any()
    spans = track.spans(boxes)
    at = np.arange(count)
    between = (at >= spans.first[:, None]) & (at <= spans.last[:, None])
    assert not (seen & ~between).any()
    within = (at >= spans.earliest[:, None]) & (at <= spans.latest[:, None])
    assert not (between & ~within).any()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["narrow", "squinted", "wide"])
def test_few_other_positions_are_found(name):
    beam, boxes = BEAMS[name], some_boxes(200, 0.5)
    position_m, along = bent_track(1000)
    track = BeamTrack(beam.limits, position_m, along)
    seen = touched(beam, boxes, position_m, along)
    assert 0.01 < seen.mean() < 0.9
    assert np.count_nonzero(track.touching(boxes)) < 1.15 * np.count_nonzero(seen)


@pytest.mark.parametrize("name", BEAMS)
def test_runs_find_what_single_positions_find(name):
    """Searching from coarse to fine finds the same positions as testing every one."""
    boxes = some_boxes(100, 1.0)
    position_m, along = bent_track(1000)
    track = BeamTrack(BEAMS[name].limits, position_m, along)
    visibility = Visibility.of(boxes.centres_m, boxes.axes_m, position_m, along)
    single = visibility.overlap(track.limits, boxes.half) > 0
    np.testing.assert_array_equal(track.touching(boxes), single)
    some = np.flatnonzero(single.any(axis=1))
    spans = track.spans(boxes)
    np.testing.assert_array_equal(spans.first[some], single[some].argmax(axis=1))
    np.testing.assert_array_equal(spans.last[some], 999 - single[some, ::-1].argmax(axis=1))
    never = ~single.any(axis=1)
    assert (spans.first[never] > spans.last[never]).all()
    np.testing.assert_array_equal(spans.ranges[never], 0)
    np.testing.assert_array_equal(spans.ranges[some, 0], spans.first[some])
    np.testing.assert_array_equal(spans.ranges[some, 1], spans.last[some] + 1)


def test_boxes_touched_between_positions_only_are_within_a_run():
    """The beam is narrower than the step between positions."""
    x_m = np.arange(0, 32.0)
    position_m = np.stack([x_m, 0 * x_m, 0 * x_m], axis=1)
    along = np.tile([1.0, 0, 0], (len(x_m), 1))
    track = BeamTrack(BeamWindow(0.2).limits, position_m, along)
    boxes = Boxes.equal(np.array([[9.5, 20.0, 0], [9.0, 20.0, 0]]), np.full((1, 3), 1e-3))
    spans = track.spans(boxes)
    assert spans.first[0] > spans.last[0]
    assert spans.earliest[0] <= 9
    assert spans.latest[0] >= 10
    assert spans.first[1] == spans.last[1] == 9


def test_there_may_be_no_boxes():
    track = BeamTrack((-0.1, 0.1), *bent_track(20))
    none = Boxes.equal(np.zeros((0, 3)), np.eye(3))
    assert track.touching(none).shape == (0, 20)
    assert track.spans(none).ranges.shape == (0, 2)


def test_a_position_inside_a_box_sees_the_corner_behind():
    """The beam points away from the centre of the box, at a small corner of it."""
    position_m = np.array([[0.97, 0.97, 0.0]])
    along = np.array([[1.0, 1.0, 0.0]]) / np.sqrt(2)
    boxes = Boxes(np.zeros((1, 3)), np.eye(3), np.array([[1.0, 1.0, 0.0]]))
    beam = BeamWindow(20, squint_deg=80)
    assert touched(beam, boxes, position_m, along).all()
    assert BeamTrack(beam.limits, position_m, along).touching(boxes).all()
