import numpy as np
import pytest
from factorizing import CARRIER, SPEED, arc, made, near, straight, swaying

from clsas.aperture.mean_track import mean_track
from clsas.aperture.phase_rates import PhaseBoxes, cycles_per_extent
from clsas.aperture.virtual_channels import interpolated_channels, summed_neighbours
from clsas.core.surface import surface_of
from clsas.factorized.tree import Tree
from clsas.signal import interpolation
from clsas.signal.spectrum import Spectrum

WAVELENGTH = SPEED / CARRIER
FLAT = Spectrum(0.0, (np.arange(64) + 0.5) / 128, np.full(64, 1 / 64))


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


def test_a_constant_is_interpolated_exactly_enough():
    _, virtual = some_virtual_channels()
    np.testing.assert_allclose(virtual.weights.sum(axis=-1), 1, atol=0.01)


@pytest.mark.parametrize(("channels", "factor"), [(12, 3), (13, 3), (5, 5), (4, 9), (7, 1)])
def test_nearest_beams_are_means_of_neighbours(channels, factor):
    coordinate = np.random.default_rng(0).permutation(channels)[None] / channels
    position_m = coordinate[..., None] * [3.0, 1, 0]
    virtual = summed_neighbours(coordinate, position_m, factor)
    assert virtual.coordinate.shape == (1, -(-channels // factor))
    for number in range(virtual.coordinate.shape[1]):
        mine = virtual.order[0, virtual.base[0] == number]
        assert virtual.coordinate[0, number] == pytest.approx(coordinate[0, mine].mean())
        np.testing.assert_allclose(virtual.position_m[0, number], position_m[0, mine].mean(axis=0))
    assert (virtual.weights == 1).all()
