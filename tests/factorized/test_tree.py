import numpy as np
import pytest
from cases import along_x, thesis_lines
from factorizing import (
    BEAMS,
    CARRIER,
    EXACT_IS_SLOW,
    SPEED,
    arc,
    around,
    made,
    near,
    over,
    straight,
    swaying,
)

from clsas.aperture.beam_directions import BeamDirections
from clsas.aperture.mean_track import mean_track
from clsas.aperture.phase_rates import cycles_per_extent
from clsas.aperture.virtual_channels import interpolated_channels, nearest_nodes
from clsas.core.grid import Grid
from clsas.core.image_error import relative_error_db
from clsas.exact.backprojection import backproject
from clsas.factorized import sectors, tree, visibility
from clsas.factorized.surface import surface_of
from clsas.factorized.tree import Division
from clsas.planning.factorize import factorize
from clsas.planning.planner import plan
from clsas.signal import interpolation
from clsas.signal.spectrum import Spectrum
from clsas.sonar.beam import BeamWindow
from clsas.sonar.visibility import Visibility

WAVELENGTH = SPEED / CARRIER
FLAT = Spectrum(0.0, (np.arange(64) + 0.5) / 128, np.full(64, 1 / 64))


# Division


SIDES = ((64, 48), (32, 16), (16, 4))


@pytest.mark.parametrize("shape", [(1, 1), (64, 48), (65, 49), (200, 100)])
def test_roots_hold_every_pixel_once(shape):
    division = Division(surface_of(around(0, 40, shape=shape)), SIDES)
    count = np.zeros((384, 384), int)
    for row, column in division.roots:
        count[row : row + 64, column : column + 48] += 1
    assert (count[: shape[0], : shape[1]] == 1).all()
    assert all(row < shape[0] and column < shape[1] for row, column in division.roots)


@pytest.mark.parametrize("level", [1, 2])
def test_subimages_fill_their_parents(level):
    division = Division(surface_of(around(0, 40, shape=(150, 100))), SIDES)
    parents = division.corners(level - 1, division.roots)
    children = division.corners(level, division.roots)
    inside = children - parents[:, division.parents(level)]
    assert (inside >= 0).all()
    assert (inside + SIDES[level] <= SIDES[level - 1]).all()
    for root in children:
        assert len({tuple(corner) for corner in root}) == division.per_root(level)


def test_a_centre_is_the_mean_of_pixels():
    grid = around(3, 40, shape=(150, 100))
    surface = surface_of(grid)
    division = Division(surface, SIDES)
    corners = division.corners(1, division.roots[:1])
    positions_m = grid.positions_m()
    for (row, column), centre_m in zip(corners[0], division.centres_m(1, corners)[0], strict=True):
        pixels_m = positions_m[row : row + 32, column : column + 16].reshape(-1, 3)
        np.testing.assert_allclose(centre_m, pixels_m.mean(axis=0), atol=1e-12)
        assert np.linalg.norm(pixels_m - centre_m, axis=1).max() <= surface.radius_m(SIDES[1])


# Virtual channels


def interpolation_error_db(case, side, aperture, root=(128, 128)):
    """Of steering functions of pixels in subimages of a size, anywhere in a root; float64."""
    lines, grid = made(case)
    rng = np.random.default_rng(0)
    track, centres_m = mean_track(lines, WAVELENGTH), lines.phase_centres_m
    surface = surface_of(grid)
    division = Division(surface, (root, side))
    cycles_per_m = lines.carrier_cycles_per_m
    wrong = total = 0.0
    for corner in division.roots[:2]:
        middle_m = division.centres_m(0, corner[None])
        place = track.apparent_coordinates(middle_m, centres_m)
        extents, nearest_m = surface.extents(root), surface.radius_m(side)
        rates = cycles_per_extent(
            track, surface.steps_m, middle_m, extents, cycles_per_m, nearest_m
        )
        rate = side[0] * rates[0] + side[1] * rates[1]
        nodes = interpolated_channels(track, rate, place, aperture)
        between = nodes.base[0][:, None] + np.arange(nodes.taps)
        of_channels = track.positions_m(nodes.ordered(place)[0])
        leaves_m = division.centres_m(1, division.corners(1, corner[None]))[0]
        for centre_m in leaves_m[rng.integers(0, len(leaves_m), 6)]:
            offset = rng.integers(0, side, (40, 2)) - (np.array(side) - 1) / 2
            pixels_m = centre_m + offset @ np.stack([grid.row_step_m, grid.column_step_m])

            def steering(position_m, pixels_m=pixels_m, centre_m=centre_m):
                range_m = np.linalg.norm(pixels_m[:, None] - position_m, axis=-1)
                range_m -= np.linalg.norm(centre_m - position_m, axis=-1)
                return np.exp(2j * np.pi * cycles_per_m * range_m)

            wanted = steering(of_channels)
            got = np.einsum(
                "pct,ct->pc", steering(nodes.position_m[0])[:, between], nodes.weights[0]
            )
            wrong += np.sum(np.abs(got - wanted) ** 2)
            total += np.sum(np.abs(wanted) ** 2)
    return 10 * np.log10(wrong / total)


@pytest.mark.slow
@pytest.mark.parametrize(("taps", "density"), [(4, 1.48), (6, 2.07), (8, 2.16)])
@pytest.mark.parametrize("side", [(64, 64), (16, 16), (64, 8)])
@pytest.mark.parametrize("case", [straight, near, swaying, arc], ids=lambda case: case.__name__)
def test_steering_functions_are_interpolated_as_well_as_designed(case, side, taps, density):
    """But for what nodes at slowly changing distances add, which plans account for."""
    aperture = interpolation.design(taps, density, FLAT)
    designed, uneven = 10 ** (aperture.error_db / 10), 10**-6.3
    assert interpolation_error_db(case, side, aperture) <= 10 * np.log10(1.26 * designed + uneven)


def any_nodes(shuffled=False):
    lines, grid = made(swaying)
    if shuffled:
        lines = lines.select(np.random.default_rng(0).permutation(lines.channels))
    track = mean_track(lines, WAVELENGTH)
    surface, side = surface_of(grid), (64, 64)
    middle_m = surface.middles_m(side, np.array([[0, 0], [64, 64]]))
    extents, cycles_per_m = surface.extents(side), lines.carrier_cycles_per_m
    rates = cycles_per_extent(track, surface.steps_m, middle_m, extents, cycles_per_m, 0.1)
    place = track.apparent_coordinates(middle_m, lines.phase_centres_m)
    aperture = interpolation.design(6, 2.0, FLAT)
    return place, interpolated_channels(track, 64 * rates.sum(axis=0), place, aperture)


def test_every_channel_lies_between_its_middle_nodes():
    place, nodes = any_nodes()
    place = nodes.ordered(place)
    rows = np.arange(2)[:, None]
    assert (np.diff(nodes.coordinate, axis=1) > 0).all()
    assert (nodes.coordinate[rows, nodes.base + 2] <= place + 1e-9).all()
    assert (place <= nodes.coordinate[rows, nodes.base + 3] + 1e-9).all()


@pytest.mark.parametrize("shuffled", [False, True])
def test_channels_come_in_the_order_of_their_nodes(shuffled):
    place, nodes = any_nodes(shuffled)
    assert (nodes.order is None) == (not shuffled)
    assert (np.diff(nodes.base, axis=1) >= 0).all()
    assert (nodes.base >= 0).all()
    assert (nodes.base + nodes.taps <= nodes.coordinate.shape[1]).all()
    assert (np.diff(nodes.ordered(place), axis=1) >= 0).all()
    np.testing.assert_array_equal(np.sort(nodes.ordered(place), axis=1), np.sort(place, axis=1))


def test_a_constant_is_interpolated_exactly_enough():
    _, nodes = any_nodes()
    np.testing.assert_allclose(nodes.weights.sum(axis=-1), 1, atol=0.01)


@pytest.mark.parametrize(("channels", "factor"), [(12, 3), (13, 3), (5, 5), (4, 9), (7, 1)])
def test_nearest_nodes_are_means_of_neighbours(channels, factor):
    place = np.random.default_rng(0).permutation(channels)[None] / channels
    position_m = place[..., None] * [3.0, 1, 0]
    nodes = nearest_nodes(place, position_m, factor)
    assert nodes.coordinate.shape == (1, -(-channels // factor))
    for node in range(nodes.coordinate.shape[1]):
        mine = nodes.order[0, nodes.base[0] == node]
        assert nodes.coordinate[0, node] == pytest.approx(place[0, mine].mean())
        np.testing.assert_allclose(nodes.position_m[0, node], position_m[0, mine].mean(axis=0))
    assert (nodes.weights == 1).all()


# What subimages need


@pytest.fixture
def everything(monkeypatch):
    """Images whose subimages get all nodes and channels there are."""

    def widened(division, nodes, place, seen, inside):
        everywhere = np.full_like(seen[0], -np.inf), np.full_like(seen[1], np.inf)
        return ranges(division, nodes, place, everywhere, np.ones_like(inside))

    ranges = tree.channel_ranges
    monkeypatch.setattr(sectors, "channel_ranges", widened)


@pytest.mark.slow
@pytest.mark.parametrize("beam", BEAMS, ids=["hann", "wide", "squint"])
def test_leaves_have_all_the_nodes_they_need(beam, everything, monkeypatch):
    """What lies outside a beam weighs nothing: leaving it out makes nothing worse."""
    grid = around(0, 12, pixel_m=(0.015, 0.05), shape=(130, 150))
    lines, _ = over(grid, along_x(700, 0.012))
    chosen = plan(lines, grid, tolerance_db=-45, beam=beam, costs=EXACT_IS_SLOW)
    assert not chosen.is_exact
    whole = factorize(lines, grid, chosen)
    monkeypatch.undo()
    exact = backproject(lines, grid, accuracy_db=-85, beam=beam)
    assert relative_error_db(whole, exact) <= -45
    image = factorize(lines, grid, chosen)
    assert relative_error_db(image, exact) <= relative_error_db(whole, exact) + 0.5


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(33, 65), (70, 129)])
def test_subimages_beyond_the_grid_are_not_missed(shape, everything, monkeypatch):
    grid = around(0, 40, shape=shape)
    lines, _ = over(grid)
    chosen = plan(lines, grid, tolerance_db=-45, costs=EXACT_IS_SLOW)
    assert not chosen.is_exact
    whole = factorize(lines, grid, chosen)
    monkeypatch.undo()
    assert relative_error_db(factorize(lines, grid, chosen), whole) <= -110


def test_places_from_where_leaves_are_seen_hold_all_that_weigh():
    lines, grid = made(near)
    beam, track = BEAMS[0], mean_track(lines, WAVELENGTH)
    along = BeamDirections.of(beam, beam.directions(lines), track).along
    division = Division(surface_of(grid), ((16, 16),))
    corners = division.roots[:, None]
    half_m = 8 * np.stack([grid.row_step_m, grid.column_step_m])
    begin, end = visibility.visible_stretches(
        beam.limits, track, along, division.centres_m(0, corners), half_m
    )
    place = np.linspace(0, 1, 2001)
    position_m = track.positions_m(place)
    direction = BeamDirections.of(beam, beam.directions(lines), track).at(place)
    for (corner,), (first,), (last,) in zip(corners, begin, end, strict=True):
        for pixel in corner + np.array([[0, 0], [0, 15], [15, 0], [15, 15], [7, 8]]):
            pixel_m = grid.origin_m + pixel @ np.stack([grid.row_step_m, grid.column_step_m])
            sight = pixel_m - position_m
            sine = np.einsum("pi,pi->p", sight, direction) / np.linalg.norm(sight, axis=1)
            weighs = place[beam.weights(sine) > 0]
            assert ((weighs >= first) & (weighs <= last)).all()


@pytest.mark.slow
@pytest.mark.parametrize("range_m", [3, 40])
@pytest.mark.parametrize("beam", [BeamWindow(1), BeamWindow(8), BeamWindow(60, squint_deg=20)])
def test_boxes_are_seen_from_where_they_are_and_from_hardly_more(beam, range_m):
    place = np.linspace(0, 1, 300)
    track_m = np.stack([80 * place - 40, 0.3 * np.sin(9 * place), 0 * place], axis=1)
    lines = thesis_lines(Grid.plane((-1, 1, 4), (29, 30, 4)), track_m)
    track = mean_track(lines, WAVELENGTH)
    along = BeamDirections.of(beam, beam.directions(lines), track).along
    random = np.random.default_rng(1)
    centres_m = random.uniform((-70, 0.7 * range_m, -1), (70, 1.3 * range_m, 1), (300, 3))
    half_m = range_m * np.array([[0.02, 0, 0], [0, 0.01, 0]])
    begin, end = visibility.visible_stretches(beam.limits, track, along, centres_m, half_m)
    place, spacing = np.linspace(0, 1, 4001), 2 / 256  # of those that are looked at
    direction = BeamDirections.of(beam, beam.directions(lines), track).at(place)
    boxes = Visibility.of(centres_m, half_m, track.positions_m(place), direction)
    seen = boxes.overlap(beam.limits, np.ones(2)) > 0
    ever = seen.any(axis=1)
    assert 50 < np.count_nonzero(ever) < 300
    first = place[seen.argmax(axis=1)][ever]
    last = place[::-1][seen[:, ::-1].argmax(axis=1)][ever]
    begin, end = begin[ever], end[ever]
    assert (begin <= first).all()
    assert (end >= last).all()
    wide = (last - first > 2 * spacing) & np.isfinite(begin) & np.isfinite(end)
    assert wide.any() or range_m == 3
    assert (first - begin)[wide].max(initial=0) < 0.4 * spacing
    assert (end - last)[wide].max(initial=0) < 0.4 * spacing


def test_directions_between_channels_are_of_length_one():
    lines, _ = made(arc)
    track = mean_track(lines, WAVELENGTH)
    along = BeamDirections.of(BEAMS[0], BEAMS[0].directions(lines), track).at(
        np.linspace(-1, 2, 50)
    )
    np.testing.assert_allclose(np.linalg.norm(along, axis=1), 1)
