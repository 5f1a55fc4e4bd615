from itertools import pairwise

import numpy as np
import pytest
from cases import track_lines
from dense import TRACKS
from dense import WAVELENGTH as LONG_WAVELENGTH
from factorizing import CARRIER, SPEED, arc, made, near, straight, swaying

from clsas.engine.data.surface import surface_of
from clsas.engine.factorized.phase_rates import PhaseBoxes, SheetRates, cycles_per_extent
from clsas.engine.factorized.track import mean_track, mean_track_of
from clsas.engine.factorized.tree import Tree
from clsas.engine.factorized.virtual_channels import (
    NearestBeams,
    first_on_sheet,
    interpolated_channels,
    later_on_sheet,
    operations,
    stage_errors_m,
)
from clsas.engine.signal import interpolation
from clsas.engine.signal.spectrum import Spectrum

WAVELENGTH = SPEED / CARRIER
FLAT = Spectrum(0.0, (np.arange(64) + 0.5) / 128, np.full(64, 1 / 64))
SPACING_M, SIDE_M, NEAREST_M = 8.25e-3, 5.0, 40.0  # THESIS chapter 5


def interpolation_error_db(case, side, aperture, root=(128, 128)):
    """Error of interpolated steering functions of pixels in subimages of a size, in float64."""
    lines, grid = made(case)
    rng = np.random.default_rng(0)
    track, centres_m = mean_track(lines, WAVELENGTH), lines.phase_centres_m
    surface = surface_of(grid)
    tree = Tree(surface, (root, side))
    cycles_per_m = lines.carrier_cycles_per_m
    wrong = total = 0.0
    for corner in tree.roots[:2]:
        middle_m = tree.centres_m(0, corner[None])
        coordinate, _ = track.apparent_coordinates(middle_m, centres_m)
        extents, nearest_m = surface.extents(root), surface.radius_m(side)
        boxes = PhaseBoxes(surface.steps_m, middle_m, extents, cycles_per_m, nearest_m)
        rates = cycles_per_extent(track, boxes)
        rate = side[0] * rates[0] + side[1] * rates[1]
        virtual = interpolated_channels(track, rate, coordinate, aperture)
        between = virtual.base[0][:, None] + np.arange(virtual.taps)
        of_channels = track.positions_m(virtual.ordered(coordinate)[0])
        leaves_m = tree.centres_m(1, tree.corners(1, corner[None]))[0]
        for centre_m in leaves_m[rng.integers(0, len(leaves_m), 6)]:
            offset = rng.integers(0, side, (40, 2)) - (np.array(side) - 1) / 2
            pixels_m = centre_m + offset @ np.stack([grid.row_step_m, grid.column_step_m])

            def steering(position_m, pixels_m=pixels_m, centre_m=centre_m):
                range_m = np.linalg.norm(pixels_m[:, None] - position_m, axis=-1)
                range_m -= np.linalg.norm(centre_m - position_m, axis=-1)
                return np.exp(2j * np.pi * cycles_per_m * range_m)

            exact = steering(of_channels)
            interpolated = np.einsum(
                "pct,ct->pc", steering(virtual.position_m[0])[:, between], virtual.weights[0]
            )
            wrong += np.sum(np.abs(interpolated - exact) ** 2)
            total += np.sum(np.abs(exact) ** 2)
    return 10 * np.log10(wrong / total)


@pytest.mark.slow
@pytest.mark.parametrize(("taps", "density"), [(4, 1.48), (6, 2.07), (8, 2.16)])
@pytest.mark.parametrize("side", [(64, 64), (16, 16), (64, 8)])
@pytest.mark.parametrize("case", [straight, near, swaying, arc], ids=lambda case: case.__name__)
def test_steering_functions_are_interpolated_as_well_as_designed(case, side, taps, density):
    """A changing spacing of virtual channels adds a small error, which plans predict."""
    aperture = interpolation.design(taps, density, FLAT)
    designed, uneven = 10 ** (aperture.error_db / 10), 10**-6.3
    assert interpolation_error_db(case, side, aperture) <= 10 * np.log10(1.26 * designed + uneven)


def some_virtual_channels(shuffled=False):
    lines, grid = made(swaying)
    if shuffled:
        lines = lines.select(np.random.default_rng(0).permutation(lines.channels))
    track = mean_track(lines, WAVELENGTH)
    surface, side = surface_of(grid), (64, 64)
    middle_m = surface.middles_m(side, np.array([[0, 0], [64, 64]]))
    extents, cycles_per_m = surface.extents(side), lines.carrier_cycles_per_m
    boxes = PhaseBoxes(surface.steps_m, middle_m, extents, cycles_per_m, 0.1)
    rates = cycles_per_extent(track, boxes)
    coordinate, _ = track.apparent_coordinates(middle_m, lines.phase_centres_m)
    aperture = interpolation.design(6, 2.0, FLAT)
    return coordinate, interpolated_channels(track, 64 * rates.sum(axis=0), coordinate, aperture)


def test_every_channel_lies_between_its_middle_virtual_channels():
    coordinate, virtual = some_virtual_channels()
    coordinate = virtual.ordered(coordinate)
    rows = np.arange(2)[:, None]
    assert (np.diff(virtual.coordinate, axis=1) > 0).all()
    assert (virtual.coordinate[rows, virtual.base + 2] <= coordinate + 1e-9).all()
    assert (coordinate <= virtual.coordinate[rows, virtual.base + 3] + 1e-9).all()


@pytest.mark.parametrize("shuffled", [False, True])
def test_channels_come_in_the_order_of_their_virtual_channels(shuffled):
    coordinate, virtual = some_virtual_channels(shuffled)
    assert (virtual.order is None) == (not shuffled)
    assert (np.diff(virtual.base, axis=1) >= 0).all()
    assert (virtual.base >= 0).all()
    assert (virtual.base + virtual.taps <= virtual.coordinate.shape[1]).all()
    assert (np.diff(virtual.ordered(coordinate), axis=1) >= 0).all()
    np.testing.assert_array_equal(
        np.sort(virtual.ordered(coordinate), axis=1), np.sort(coordinate, axis=1)
    )


@pytest.mark.parametrize("cycles", [5.0, 40.0])
@pytest.mark.parametrize("taps", [4, 8])
def test_virtual_channels_lie_at_equal_steps_of_the_phase(cycles, taps):
    """A rate that doubles along the track halves the spacing."""
    lines, _ = made(straight)
    track, aperture = mean_track(lines, WAVELENGTH), interpolation.design(taps, 2.0, FLAT)
    inside = np.clip(track.samples, 0, 1)
    for slope in (0.0, 1.0):
        rate = cycles * (1 + slope * inside)[None]
        virtual = interpolated_channels(track, rate, track.coordinate[None], aperture)
        found = virtual.coordinate[0]
        middles = (found[1:] + found[:-1]) / 2
        steps = 2 * aperture.upsampling * np.diff(found) * cycles
        inside_ends = (middles > 0.1) & (middles < 0.9)
        exact = 1 / (1 + slope * middles)
        np.testing.assert_allclose(steps[inside_ends], exact[inside_ends], rtol=0.02)


def test_a_constant_is_interpolated_exactly_enough():
    _, virtual = some_virtual_channels()
    np.testing.assert_allclose(virtual.weights.sum(axis=-1), 1, atol=0.01)


@pytest.mark.parametrize("name", ["helix", "planar", "spiral"])
def test_weights_interpolate_smooth_functions_on_a_sheet(name):
    """There are two stages: from channels to virtual channels, and from these to fewer."""
    track = mean_track_of(track_lines(TRACKS[name]()), "sheet", LONG_WAVELENGTH)
    aperture = interpolation.design(6, 2.0, FLAT)
    samples = [line.samples.size for line in (track.line_along(0.5), track.line_across(0.5))]
    rates = [SheetRates(*(np.full((1, n), cycles) for n in samples)) for cycles in (12.0, 6.0)]
    order = np.argsort(track.coordinate)
    coordinates = track.coordinate[order][None], track.across[order][None]
    first, grid = first_on_sheet(track, rates[0], *coordinates, aperture)
    later, last = later_on_sheet(track, rates[1], grid, aperture)

    def function(along, across):
        return np.exp(2j * np.pi * (2.0 * along - 1.7 * across))

    for virtual, given, found in (
        (first, coordinates, grid),
        (later, (grid.coordinate, np.repeat(grid.rows, grid.columns.shape[1], axis=1)), last),
    ):
        width = found.columns.shape[1]
        values = function(found.columns[:, None], found.rows[..., None]).reshape(-1)
        taps = np.arange(virtual.taps)
        index = virtual.base[0][:, None, None] + width * taps[:, None] + taps
        assert 0 <= index.min() <= index.max() < values.size
        across = aperture.weights(virtual.bands.between[0])
        interpolated = np.einsum("nr,nc,nrc->n", across, virtual.weights[0], values[index])
        exact = virtual.ordered(function(*given))[0]
        assert np.abs(interpolated - exact).max() < 0.02
        # Within a band, virtual channels never decrease, and bands hold all channels.
        bounds = virtual.bands.bounds[0]
        assert (bounds[0], bounds[-1]) == (0, len(exact))
        for start, stop in pairwise(bounds):
            assert (np.diff(virtual.base[0][start:stop]) >= 0).all()


@pytest.mark.parametrize(("channels", "factor"), [(12, 3), (13, 3), (5, 5), (4, 9), (7, 1)])
def test_nearest_beams_are_means_of_neighbours(channels, factor):
    coordinate = np.random.default_rng(0).permutation(channels)[None] / channels
    position_m = coordinate[0][:, None] * [3.0, 1, 0]
    (virtual,) = NearestBeams((factor,)).virtual_channels(coordinate, position_m)
    assert virtual.coordinate.shape == (1, -(-channels // factor))
    for number in range(virtual.coordinate.shape[1]):
        mine = virtual.order[0, virtual.base[0] == number]
        assert virtual.coordinate[0, number] == pytest.approx(coordinate[0, mine].mean())
        np.testing.assert_allclose(virtual.position_m[0, number], position_m[mine].mean(axis=0))
    assert (virtual.weights == 1).all()


def test_later_nearest_beams_are_means_of_earlier_ones():
    coordinate = np.random.default_rng(0).permutation(12)[None] / 12
    position_m = coordinate[0][:, None] * [3.0, 1, 0]
    *_, twice = NearestBeams((2, 3)).virtual_channels(coordinate, position_m)
    (once,) = NearestBeams((6,)).virtual_channels(coordinate, position_m)
    np.testing.assert_allclose(twice.coordinate, once.coordinate)
    np.testing.assert_allclose(twice.position_m, once.position_m)


def range_error_m(r, t, a, b):
    """Error of a beam that stands for a sector, at a point [40].

    The point is at r from the middle of a subaperture of half length t, and at an angle b from the
    beam, whose angle with the subaperture is a.
    """
    square = r * r + t * t
    return np.sqrt(square - 2 * r * t * np.cos(a + b)) - np.sqrt(square - 2 * r * t * np.cos(a))


def largest_by_angle(half_length_m, range_m, away_rad):
    """Largest error [40] over beam directions, and over points up to an angle from the beam."""
    angle = np.linspace(0, np.pi, 721)[:, None]
    away = np.linspace(-away_rad, away_rad, 41)
    return np.abs(range_error_m(range_m, half_length_m, angle, away)).max()


def test_operations_of_the_worked_example():
    counts = operations([(2, 2), (2, 2)], 640, (3757, 1990), 1024**2)
    assert counts == [9_617_920, 10_188_800, 167_772_160]
    assert sum(counts) == 187_578_880
    assert operations([], 640, (), 1024**2) == [671_088_640]


def test_operations_of_lines_that_do_not_divide():
    # Sums of 3 of 10 lines are 4; each line of a stage costs gamma in addition.
    assert operations([(3, 2), (2, 1)], 10, (100, 50), 1000, gamma=5) == [
        10 * (4 * 100 + 5),
        4 * (4 * 50 + 5),
        2 * 1000,
    ]


def test_stage_errors_far_away():
    # 2 x 8.25 mm x 2.5 m / (4 x 40 m), in every stage of QR = QI.
    assert stage_errors_m([(2, 2)] * 3, SPACING_M, SIDE_M, NEAREST_M) == pytest.approx(
        [2.578125e-4] * 3, rel=1e-12
    )
    # Thesis 5.2.1: QI = 4, QR = 2 is lambda/11.6, not lambda/30.3.
    (error_m,) = stage_errors_m([(2, 4)], SPACING_M, SIDE_M, NEAREST_M)
    assert 1.5e-3 / error_m == pytest.approx(11.636, abs=1e-3)


def test_stage_errors_near_the_aperture():
    # Subapertures of 2, 4 and 8 m, subimages of 8, 4 and 2 m, and Rmin = 4 m.
    assert stage_errors_m([(2, 2)] * 3, 1.0, 16.0, 4.0) == [1.0, 1.0, 1.0]
    assert stage_errors_m([(2, 2)] * 3, 1.0, 16.0, 3.999) == [
        16 / (4 * 3.999),
        4 / 2,
        2 / 2,
    ]


def test_range_error_against_the_points_themselves():
    # The subaperture ends at (t, 0). Two points are at range r, at angles a and a + b.
    random = np.random.default_rng(1)
    r, t = random.uniform(1, 50, 200), random.uniform(0, 50, 200)
    a, b = random.uniform(0, np.pi, 200), random.uniform(-1, 1, 200)
    end = np.stack([t, 0 * t])
    points = [r * np.stack([np.cos(angle), np.sin(angle)]) for angle in (a, a + b)]
    at_beam, away = (np.linalg.norm(point - end, axis=0) for point in points)
    np.testing.assert_allclose(range_error_m(r, t, a, b), away - at_beam, atol=1e-12)


@pytest.mark.parametrize("length_m", [0.0165, 5.28, 20.0, 39.9])
@pytest.mark.parametrize("side_m", [0.1, 2.5, 20.0])
def test_the_formula_bounds_the_sector(length_m, side_m):
    """[40] <= [45] at every range, over the sector that a subimage's side spans across the beam."""
    (bound_m,) = stage_errors_m([(1, 1)], length_m, side_m, NEAREST_M)
    errors = [
        largest_by_angle(length_m / 2, range_m, side_m / 2 / range_m)
        for range_m in (NEAREST_M, 1.3 * NEAREST_M, 5 * NEAREST_M)
    ]
    assert max(errors) <= bound_m * (1 + 1e-9)
    assert errors[0] >= 0.98 * bound_m


@pytest.mark.parametrize("length_m", [40.1, 100.0, 1000.0])
def test_the_formula_bounds_long_subapertures(length_m):
    (bound_m,) = stage_errors_m([(1, 1)], length_m, 10.0, NEAREST_M)
    largest_m = largest_by_angle(length_m / 2, NEAREST_M, 5 / NEAREST_M)
    assert bound_m == 5
    assert largest_m <= bound_m
    # Tight only where half the subaperture is as long as the range: the branch changes too early.
    assert (largest_m >= 0.98 * bound_m) == (length_m >= 2 * NEAREST_M)


@pytest.mark.parametrize("squint_deg", [0, 7, 15, 22.5, 45, 70])
def test_the_formula_does_not_bound_oblique_squares(squint_deg):
    """A corner is (cos + sin) of the squint farther across the beam; the aperture shrinks by cos.

    At 22.5 degrees that is (1 + sqrt 2)/2, 21 % more than [45] says.
    """
    (bound_m,) = stage_errors_m([(1, 1)], 0.05, 0.1, NEAREST_M)
    squint = np.radians(squint_deg)
    centre = NEAREST_M * np.array([np.sin(squint), np.cos(squint)])
    point = centre + np.array([0.05, -0.05])
    angle, beam = np.arctan2(*point[::-1]), np.arctan2(*centre[::-1])
    error_m = abs(range_error_m(np.linalg.norm(point), 0.025, beam, angle - beam))
    ratio = np.cos(squint) * (np.cos(squint) + np.sin(squint))
    assert error_m / bound_m == pytest.approx(ratio, rel=0.005)
    assert ratio <= (1 + np.sqrt(2)) / 2 + 1e-12
