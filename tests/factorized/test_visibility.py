import numpy as np
import pytest
from cases import thesis_lines
from factorizing import BEAMS, CARRIER, SPEED, made, near

from clsas.aperture.beam_directions import directions_of
from clsas.aperture.mean_track import mean_track
from clsas.core.grid import Grid
from clsas.core.surface import surface_of
from clsas.factorized.tree import Tree, visible_stretches
from clsas.sonar.beam import BeamWindow
from clsas.sonar.visibility import Visibility

WAVELENGTH = SPEED / CARRIER


def test_a_visible_stretch_holds_every_channel_of_some_weight():
    lines, grid = made(near)
    beam, track = BEAMS[0], mean_track(lines, WAVELENGTH)
    along = directions_of(beam, beam.directions(lines), track).along
    tree = Tree(surface_of(grid), ((16, 16),))
    corners = tree.roots[:, None]
    half_m = 8 * np.stack([grid.row_step_m, grid.column_step_m])
    begin, end = visible_stretches(beam.limits, track, along, tree.centres_m(0, corners), half_m)
    coordinate = np.linspace(0, 1, 2001)
    position_m = track.positions_m(coordinate)
    direction = directions_of(beam, beam.directions(lines), track).at(coordinate)
    for (corner,), (first,), (last,) in zip(corners, begin, end, strict=True):
        for pixel in corner + np.array([[0, 0], [0, 15], [15, 0], [15, 15], [7, 8]]):
            pixel_m = grid.origin_m + pixel @ np.stack([grid.row_step_m, grid.column_step_m])
            sight = pixel_m - position_m
            sine = np.einsum("pi,pi->p", sight, direction) / np.linalg.norm(sight, axis=1)
            weighs = coordinate[beam.weights(sine) > 0]
            assert ((weighs >= first) & (weighs <= last)).all()


@pytest.mark.slow
@pytest.mark.parametrize("range_m", [3, 40])
@pytest.mark.parametrize("beam", [BeamWindow(1), BeamWindow(8), BeamWindow(60, squint_deg=20)])
def test_visible_stretches_are_hardly_longer_than_they_must_be(beam, range_m):
    coordinate = np.linspace(0, 1, 300)
    track_m = np.stack([80 * coordinate - 40, 0.3 * np.sin(9 * coordinate), 0 * coordinate], axis=1)
    lines = thesis_lines(Grid.plane((-1, 1, 4), (29, 30, 4)), track_m)
    track = mean_track(lines, WAVELENGTH)
    along = directions_of(beam, beam.directions(lines), track).along
    random = np.random.default_rng(1)
    centres_m = random.uniform((-70, 0.7 * range_m, -1), (70, 1.3 * range_m, 1), (300, 3))
    half_m = range_m * np.array([[0.02, 0, 0], [0, 0.01, 0]])
    begin, end = visible_stretches(beam.limits, track, along, centres_m, half_m)
    coordinate = np.linspace(0, 1, 4001)
    spacing = 2 / 256  # of the samples at which visibility is evaluated
    direction = directions_of(beam, beam.directions(lines), track).at(coordinate)
    boxes = Visibility.of(centres_m, half_m, track.positions_m(coordinate), direction)
    visible = boxes.overlap(beam.limits, np.ones(2)) > 0
    ever = visible.any(axis=1)
    assert 50 < np.count_nonzero(ever) < 300
    first = coordinate[visible.argmax(axis=1)][ever]
    last = coordinate[::-1][visible[:, ::-1].argmax(axis=1)][ever]
    begin, end = begin[ever], end[ever]
    assert (begin <= first).all()
    assert (end >= last).all()
    wide = (last - first > 2 * spacing) & np.isfinite(begin) & np.isfinite(end)
    assert wide.any() or range_m == 3
    assert (first - begin)[wide].max(initial=0) < 0.4 * spacing
    assert (end - last)[wide].max(initial=0) < 0.4 * spacing
