from dataclasses import replace

import numpy as np
import pytest
from cases import along_x, track_lines
from dense import TRACKS, to_and_fro, turning
from dense import WAVELENGTH as LONG_WAVELENGTH
from factorizing import BEAMS, arc, made
from hypothesis import given, settings
from hypothesis import strategies as st

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.surface import surface_of
from clsas.engine.factorized.phase_rates import (
    PhaseBoxes,
    beam_rate,
    cycles_per_extent,
    directions_of,
    drift,
    own_drift,
    stretches,
)
from clsas.engine.factorized.track import mean_track, mean_track_of

WAVELENGTH = 1500.0 / 120e3
PAST_THE_ENDS = np.array([-0.1, -0.05, 0.3, 1.05, 1.1])


def test_drift_is_the_mean_speed_of_receivers():
    tx = along_x(4, 1.0)
    assert not drift(track_lines(tx)).any()
    velocity = [[1.5, 0, 0], [3.0, 0, 3], [1.5, 0, 0], [0.0, 0, -3]]
    np.testing.assert_allclose(drift(track_lines(tx, velocity=velocity)), [1e-3, 0, 0])


@pytest.mark.parametrize("speed", [0.0, 20.0])
def test_stretched_ranges_grow_as_those_from_the_track(speed):
    """This includes receivers with different velocities."""
    rng, length_m = np.random.default_rng(7), 1e-3
    tx = along_x(200, 0.03)
    rx = tx + rng.normal(0, 0.1, 3)
    velocity = speed * rng.normal(0, 1, (200, 3)) if speed else None
    lines = track_lines(tx, rx, velocity=velocity)
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
    track = mean_track(track_lines(np.stack([turn, turn**2, turn**3], axis=1) @ bends), WAVELENGTH)
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
    track = mean_track(track_lines(along_x(300, 0.02)), WAVELENGTH)
    surface = surface_of(Grid.plane((-1, 1, 40), (3, 5, 40)))
    centres_m = np.random.default_rng(2).uniform((-3, 2, -1), (3, 9, 1), (300, 3))
    boxes = PhaseBoxes(surface.steps_m, centres_m, np.array([16.0, 8.0]), 160.0, 0.1)
    together = cycles_per_extent(track, boxes)
    for index in (0, 150, 299):
        alone = cycles_per_extent(track, replace(boxes, centres_m=centres_m[[index]]))
        # The density of points in all boxes depends on the distance of the nearest box.
        np.testing.assert_allclose(together[:, index], alone[:, 0], rtol=0.05)


@pytest.mark.parametrize("turns", ["circle", "helix"])
def test_a_beam_on_a_target_stays_there_past_the_ends(turns):
    """Past the ends positions continue straight; with constant headings the beam would miss."""
    tx_m = TRACKS["helix"]() if turns == "helix" else TRACKS["helix"]()[:180] * [1, 1, 0]
    lines = track_lines(tx_m)
    track = (
        mean_track_of(lines, "sheet", LONG_WAVELENGTH)
        if turns == "helix"
        else mean_track(lines, LONG_WAVELENGTH)
    )
    found = directions_of(BeamWindow(20, "hann"), turning(tx_m), track)
    sight = -track.positions_m(PAST_THE_ENDS) * [1, 1, 0]
    sine = np.einsum("pi,pi->p", sight, found.at(PAST_THE_ENDS))
    assert np.abs(sine / np.linalg.norm(sight, axis=1)).max() < 0.1


@pytest.mark.parametrize("squint_deg", [0.0, 5.0])
def test_a_scan_to_and_fro_has_one_heading_without_a_squint(squint_deg):
    track = mean_track_of(track_lines(TRACKS["raster"]()), "sheet", LONG_WAVELENGTH)
    beam = BeamWindow(20, "hann", squint_deg=squint_deg)
    along = directions_of(beam, to_and_fro(), track).at(track.coordinate, track.across)
    assert (np.ptp(along @ [1.0, 0.0, 0.0]) < 1e-6) == (squint_deg == 0)


def test_rates_hold_all_over_a_box():
    """Around the centre of a circle, weights change at the corners of a box, not in its middle."""
    tx_m = TRACKS["helix"]()[:180] * [1, 1, 0]
    track = mean_track(track_lines(tx_m), LONG_WAVELENGTH)
    beam = BeamWindow(20, "hann")
    along = directions_of(beam, turning(tx_m), track).along
    sides_m = np.diag([0.2, 0.2, 0.0])[:2]
    inside = track.on_track
    middle, box = (
        beam_rate(beam, track, along, np.zeros((1, 3)), sides)[0, inside]
        for sides in (0 * sides_m, sides_m)
    )
    corners_m = np.array([[x, y, 0] for x in (-0.1, 0.1) for y in (-0.1, 0.1)])
    at_corners = beam_rate(beam, track, along, corners_m, 0 * sides_m)[:, inside].max(axis=0)
    np.testing.assert_allclose(box, np.maximum(at_corners, middle), rtol=1e-9)
    assert middle.max() < 0.2 * box.max()


def test_directions_between_channels_are_of_length_one():
    lines, _ = made(arc)
    track = mean_track(lines, LONG_WAVELENGTH)
    along = directions_of(BEAMS[0], BEAMS[0].directions(lines), track).at(np.linspace(-1, 2, 50))
    np.testing.assert_allclose(np.linalg.norm(along, axis=1), 1)
