from dataclasses import replace

import numpy as np
import pytest
from cases import along_x, beside
from hypothesis import given, settings
from hypothesis import strategies as st

from clsas.aperture.mean_track import mean_track
from clsas.aperture.phase_rates import (
    PhaseBoxes,
    cumulative_cycles,
    cycles_per_extent,
    drift,
    own_drift,
    stretches,
)
from clsas.core.geometry import pairwise_range_m
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.core.surface import surface_of

CARRIER = 120e3
WAVELENGTH = 1500.0 / CARRIER


def lines_of(tx, rx=None, velocity=None):
    """Lines of one sample each, of which only the geometry matters."""
    rx = tx if rx is None else rx
    return RangeLines(np.ones((len(tx), 1), complex), 1.0, 0.01, tx, rx, CARRIER, 1500.0, velocity)


def circle(channels, degrees, radius_m=20.0):
    turn = np.radians(np.linspace(0, degrees, channels, endpoint=degrees < 360))
    return radius_m * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)


def distance_m(track, centres_m):
    """Distances of phase centres from their positions on the track."""
    return np.linalg.norm(track.positions_m(track.coordinate) - centres_m, axis=1)


def pings():
    """Pings of 6 receivers. The first receiver of a ping is behind the last of the ping before."""
    tx = np.repeat(along_x(60, 0.07), 6, axis=0)
    return tx, tx + np.tile(along_x(6, 0.034), (60, 1))


TRACKS = {
    "straight": along_x(300, 0.02),
    "tilted": along_x(300, 0.02) @ np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0],
    "arc": circle(500, 60),
    "half circle": circle(500, 180),
    "circle": circle(1000, 360),
    "uneven": np.sort(np.random.default_rng(1).uniform(-3, 3, 300))[:, None] * [1, 0.2, 0],
}


@pytest.mark.parametrize("name", TRACKS)
def test_the_track_follows_a_smooth_path(name):
    lines = lines_of(TRACKS[name])
    track = mean_track(lines, WAVELENGTH)
    assert distance_m(track, TRACKS[name]).max() < 0.05 * WAVELENGTH


@pytest.mark.parametrize("name", TRACKS)
def test_coordinates_increase_along_a_path(name):
    coordinate = mean_track(lines_of(TRACKS[name]), WAVELENGTH).coordinate
    steps = np.diff(coordinate)
    assert (steps > 0).all() or (steps < 0).all()
    assert np.ptp(coordinate) == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("name", TRACKS)
def test_the_order_of_channels_does_not_matter(name):
    centres_m = TRACKS[name]
    order = np.random.default_rng(2).permutation(len(centres_m))
    track = mean_track(lines_of(centres_m[order]), WAVELENGTH)
    assert distance_m(track, centres_m[order]).max() < 0.05 * WAVELENGTH
    steps = np.diff(track.coordinate[np.argsort(order)])
    if name == "circle":  # its track may begin anywhere
        steps = np.delete(steps, np.abs(steps).argmax())
    assert (steps > 0).all() or (steps < 0).all()


def test_the_track_of_pings_of_many_receivers_is_straight():
    lines = lines_of(*pings())
    track = mean_track(lines, WAVELENGTH)
    assert distance_m(track, lines.phase_centres_m).max() < 0.01 * WAVELENGTH
    x = lines.phase_centres_m[:, 0]
    order = np.argsort(x)
    assert (np.diff(track.coordinate[order]) >= -1e-9).all()


def test_the_track_does_not_follow_jitter():
    """Navigation errors that differ from channel to channel do not belong to a smooth path."""
    rng = np.random.default_rng(3)
    lines = lines_of(TRACKS["straight"] + rng.normal(0, 0.01, (300, 3)) * [0, 1, 1])
    tangent = mean_track(lines, WAVELENGTH).tangents_m(np.linspace(0, 1, 100))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    assert tangent[:, 0].min() > 0.99


@pytest.mark.parametrize("channels", [1, 2, 40])
def test_channels_at_one_position_have_no_track(channels):
    assert mean_track(lines_of(np.tile([1.0, 2, 3], (channels, 1))), WAVELENGTH) is None


@pytest.mark.parametrize("channels", [2, 3, 4, 5])
def test_a_few_channels_have_a_track(channels):
    centres_m = along_x(channels, 0.3)
    track = mean_track(lines_of(centres_m), WAVELENGTH)
    assert distance_m(track, centres_m).max() < 1e-9


def test_beyond_its_ends_a_track_is_straight():
    track = mean_track(lines_of(TRACKS["arc"]), WAVELENGTH)
    for end, beyond in ((0.0, -0.5), (1.0, 1.5)):
        at_m, far_m = track.positions_m(np.array([end, beyond]))
        np.testing.assert_allclose(
            far_m, at_m + (beyond - end) * track.tangents_m(np.array([end]))[0], atol=1e-9
        )


def test_the_tangent_is_the_derivative():
    track, coordinate = mean_track(lines_of(TRACKS["arc"]), WAVELENGTH), np.linspace(0.01, 0.99, 50)
    slope = (track.positions_m(coordinate + 1e-6) - track.positions_m(coordinate - 1e-6)) / 2e-6
    np.testing.assert_allclose(track.tangents_m(coordinate), slope, rtol=1e-5, atol=1e-4)


def test_a_channel_off_the_track_appears_in_its_direction():
    centres_m = along_x(200, 0.03) + np.random.default_rng(4).normal(0, 0.05, (200, 3)) * [0, 1, 1]
    track = mean_track(lines_of(centres_m), WAVELENGTH)
    points_m = np.array([[0.5, 40, -5], [30, 30, -5], [-20, 25, 3]])
    coordinates, _ = track.apparent_coordinates(points_m, centres_m)
    for point_m, coordinate in zip(points_m, coordinates, strict=True):
        ways = [position - point_m for position in (track.positions_m(coordinate), centres_m)]
        virtual, real = (way / np.linalg.norm(way, axis=1, keepdims=True) for way in ways)
        tangent = track.tangents_m(coordinate)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        # Along the track, directions agree far better than the angles by which channels are off.
        off = np.abs(np.einsum("ci,ci->c", virtual - real, tangent))
        assert off.max() < 2e-5


def test_channels_on_a_straight_track_appear_where_they_are():
    track = mean_track(lines_of(TRACKS["straight"]), WAVELENGTH)
    coordinates, _ = track.apparent_coordinates(
        np.array([[0.0, 10, 0], [5, 3, 1]]), TRACKS["straight"]
    )
    np.testing.assert_allclose(coordinates, np.tile(track.coordinate, (2, 1)), atol=1e-9)


def test_drift_is_the_mean_speed_of_receivers():
    tx = along_x(4, 1.0)
    assert not drift(lines_of(tx)).any()
    velocity = [[1.5, 0, 0], [3.0, 0, 3], [1.5, 0, 0], [0.0, 0, -3]]
    np.testing.assert_allclose(drift(lines_of(tx, velocity=velocity)), [1e-3, 0, 0])


@pytest.mark.parametrize("speed", [0.0, 20.0])
def test_stretched_ranges_grow_as_those_from_the_track(speed):
    """This includes receivers with different velocities."""
    rng, length_m = np.random.default_rng(7), 1e-3
    tx = along_x(200, 0.03)
    rx = tx + rng.normal(0, 0.1, 3)
    velocity = speed * rng.normal(0, 1, (200, 3)) if speed else None
    lines = lines_of(tx, rx, velocity=velocity)
    track = mean_track(lines, WAVELENGTH)
    point_m = np.array([[3.0, 40.0, -8.0]])
    coordinate, _ = track.apparent_coordinates(point_m, lines.phase_centres_m, own_drift(lines))
    virtual_m = track.positions_m(coordinate)
    plane = Grid.plane((0, 1, 2), (0, 1, 2))
    antennas = tx, rx, velocity, 1500.0
    found = stretches(*antennas, drift(lines), plane, point_m, virtual_m)[0]
    sight = point_m - virtual_m[0]
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    within = sight * [1, 1, 0]
    size = np.linalg.norm(within, axis=1)
    aside = np.cross(within / size[:, None], [0, 0, 1])
    of_motion = np.abs(np.sum(own_drift(lines) * aside, axis=1)).max() if speed else 0.0
    little = 2e-5 + 0.1 * of_motion
    for way, stretch, most in ((within / size[:, None], found * size, 1e-7), (aside, 0.0, little)):
        ends = [
            np.diag(pairwise_range_m(point_m + sign * length_m * way, *antennas))
            for sign in (-0.5, 0.5)
        ]
        grown = (ends[1] - ends[0]) / length_m
        of_place = np.sum((sight - drift(lines)) * way, axis=1)
        assert np.abs(grown - of_place - stretch).max() < most


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_no_phase_turns_faster_than_its_bound(seed):
    """The phase is that of any pixel relative to its subimage's centre, along any track."""
    rng = np.random.default_rng(seed)
    turn = np.linspace(-1, 1, 200)
    bends = rng.normal(size=(3, 3)) * [[4], [1], [0.5]]
    track = mean_track(lines_of(np.stack([turn, turn**2, turn**3], axis=1) @ bends), WAVELENGTH)
    steps = rng.normal(0, 0.01, (2, 3))
    grid = Grid.oriented(rng.normal([0, 25, 0], 3), *steps, (64, 64))
    side, inside = (64, 64), (16, 8)
    centre_m = grid.origin_m + 31.5 * steps.sum(axis=0)
    cycles_per_m = 2 / WAVELENGTH
    surface = surface_of(grid)
    extents = surface.extents(side)
    boxes = PhaseBoxes(surface.steps_m, centre_m[None], extents, cycles_per_m, 0.1)
    bound = cycles_per_extent(track, boxes)[:, 0]
    bound = inside[0] * bound[0] + inside[1] * bound[1]
    # A subimage of 16 x 8 pixels anywhere in the box, and a pixel anywhere in the subimage.
    coordinates = track.samples
    room = (np.array(side) - inside) / 2
    for _ in range(20):
        middle_m = centre_m + rng.uniform(-room, room) @ steps
        pixel_m = middle_m + rng.uniform(-0.5, 0.5, 2) * inside @ steps

        def phase(at, pixel_m=pixel_m, middle_m=middle_m):
            position = track.positions_m(at)
            return cycles_per_m * (
                np.linalg.norm(pixel_m - position, axis=1)
                - np.linalg.norm(middle_m - position, axis=1)
            )

        rate = np.abs(phase(coordinates + 1e-5) - phase(coordinates - 1e-5)) / 2e-5
        within = np.abs(coordinates - 0.5) <= 0.5
        assert (rate <= 1.1 * bound + 1e-3 * bound.max())[within].all()


def test_rates_in_many_boxes_are_those_in_each():
    track = mean_track(lines_of(along_x(300, 0.02)), WAVELENGTH)
    surface = surface_of(Grid.plane((-1, 1, 40), (3, 5, 40)))
    centres_m = np.random.default_rng(2).uniform((-3, 2, -1), (3, 9, 1), (300, 3))
    boxes = PhaseBoxes(surface.steps_m, centres_m, np.array([16.0, 8.0]), 160.0, 0.1)
    together = cycles_per_extent(track, boxes)
    for index in (0, 150, 299):
        alone = cycles_per_extent(track, replace(boxes, centres_m=centres_m[[index]]))
        # The density of points in all boxes depends on the distance of the nearest box.
        np.testing.assert_allclose(together[:, index], alone[:, 0], rtol=0.05)


def test_phases_are_the_integral_of_rates():
    track = mean_track(lines_of(TRACKS["straight"]), WAVELENGTH)
    coordinate = track.samples
    cycles = cumulative_cycles(track, np.full((1, len(coordinate)), 7.0))[0]
    np.testing.assert_allclose(np.diff(cycles), 7 * np.diff(coordinate), rtol=1e-9)
    rate = 3 * np.clip(coordinate, 0, 1)[None]
    inside = np.searchsorted(coordinate, [0, 1])
    rising = cumulative_cycles(track, rate)[0, inside]
    assert rising[1] - rising[0] == pytest.approx(1.5, rel=1e-4)


def test_turns_are_the_integral_of_their_rate():
    track = mean_track(lines_of(TRACKS["straight"]), WAVELENGTH)
    rate = np.stack([np.ones_like(track.samples), np.abs(track.samples - 0.5)])
    cycles = cumulative_cycles(track, rate)[:, np.abs(track.samples - 0.5) <= 0.5]
    assert np.ptp(cycles, axis=1) == pytest.approx([1.0, 0.25], rel=1e-3)


def test_bistatic_channels_are_at_their_phase_centres():
    tx = TRACKS["straight"]
    track = mean_track(lines_of(tx, beside(tx, 0.4, 0.1, -0.1)), WAVELENGTH)
    middle_m = beside(tx, 0.2, 0.05, -0.05)
    assert np.linalg.norm(track.positions_m(track.coordinate) - middle_m, axis=1).max() < 1e-6
