import dataclasses

import numpy as np
import pytest
from cases import along_x, beside, patch
from scipy.spatial.transform import Rotation

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.exact.decide import GEOMETRY_ERROR, fitting_tiles, largest_radius_m
from clsas.engine.exact.layout import BLOCKS, STACK, Groups, Tiles, gather

CYCLES_PER_M = 2 * 1e6 / 1500
TRACK = along_x(20, 0.2)
WIDTHS = sorted(BLOCKS)


def laid_out(grid, cycles_per_m, width, **options):
    """The tiles or groups that `decide` takes for antennas on the track."""
    tiles = fitting_tiles(grid, width, TRACK, cycles_per_m, **options)
    return tiles or gather(grid, largest_radius_m(len(TRACK), cycles_per_m), width)


def positions_of(layout):
    """Position of every pixel slot, float64 [parts, part_pixels, 3]."""
    if isinstance(layout, Groups):
        return layout.centre_m[:, None] + layout.offset_m
    local = np.arange(layout.side) - (layout.side - 1) / 2
    row, column = local[:, None, None], local[:, None]
    offsets = row * layout.grid.row_step_m + column * layout.grid.column_step_m
    return layout.centres_m(slice(None))[:, None] + offsets.reshape(-1, 3)


def distances_of(layout):
    return np.linalg.norm(positions_of(layout) - layout.centres_m(slice(None))[:, None], axis=-1)


def scattered(points, size_m, seed=0):
    return Grid.points(
        beside(np.random.default_rng(seed).uniform(0, size_m, (points, 3)), 0, 40, 0)
    )


@pytest.mark.parametrize("width", WIDTHS)
def test_a_far_plane_is_cut_into_tiles(width):
    assert isinstance(laid_out(patch(0, 40), CYCLES_PER_M, width), Tiles)


@pytest.mark.parametrize(
    "grid",
    [
        patch(0, 0.1),
        patch(0, 40).with_height(np.zeros((33, 40))),
        Grid.points(patch(0, 40).positions_m()),
        Grid.plane((0, 100, 50), (40, 140, 50)),
    ],
    ids=["near", "heights", "points", "coarse"],
)
def test_everything_else_is_grouped(grid):
    assert isinstance(laid_out(grid, CYCLES_PER_M, 16), Groups)


def test_tiles_shrink_towards_the_antennas():
    fine = {"pitch": 0.5e-3}
    sides = [laid_out(patch(0, y, **fine), CYCLES_PER_M, 16).side for y in (40.0, 3.0, 1.0)]
    assert sides[0] > sides[-1]
    assert sides == sorted(sides, reverse=True)


def test_tiles_shrink_where_a_beam_amplifies_errors_of_weights():
    """This happens in normalised images, next to the edge of the visible area."""
    grid, beam = patch(0, 4, pitch=2e-2), BeamWindow(18, "hamming")
    found = [
        laid_out(grid, 20.0, 8, error=7e-3, beam=beam, fullness=fullness)
        for fullness in (1.0, 0.1, 0.001)
    ]
    sides = [each.side if isinstance(each, Tiles) else 0 for each in found]
    assert sides[0] > sides[-1]
    assert sides == sorted(sides, reverse=True)


# Tiles


@pytest.mark.parametrize("shape", [(1, 1), (16, 16), (17, 33), (100, 5)])
@pytest.mark.parametrize("side", [16, 32])
def test_tiles_hold_every_pixel_where_it_lies(shape, side):
    grid = Grid.oriented([3, 40, -2], [0.001, 0.01, 0], [0.01, 0.002, 0.003], shape)
    tiles = Tiles(grid, side, 4)
    padded = (
        positions_of(tiles)
        .reshape(tiles.down, tiles.across, side, side, 3)
        .swapaxes(1, 2)
        .reshape(tiles.down * side, tiles.across * side, 3)
    )
    np.testing.assert_allclose(padded[: shape[0], : shape[1]], grid.positions_m(), atol=1e-12)
    assert tiles.parts == tiles.down * tiles.across
    assert (tiles.down - 1) * side < shape[0] <= tiles.down * side


def test_tiles_collect_rows_of_the_padded_plane():
    tiles = Tiles(patch(0, 40, 40, 33), 16, 4)
    padded = np.arange(48 * 48).reshape(48, 48).astype(np.complex64)
    image = tiles.collect(padded.ravel())
    np.testing.assert_array_equal(image, padded[:33, :40])
    assert image.flags.c_contiguous


def test_the_radius_of_a_tile_is_its_largest_distance():
    grid = Grid.oriented([3, 40, -2], [0.008, 0.01, 0], [0.01, 0.002, 0.003], (40, 40))
    tiles = Tiles(grid, 16, 4)
    assert tiles.radius_m == pytest.approx(distances_of(tiles).max(), rel=1e-12)


def test_centres_of_some_tiles_are_some_of_the_centres():
    tiles = Tiles(patch(0, 40, 100, 90), 16, 4)
    np.testing.assert_array_equal(tiles.centres_m(slice(5, 9)), tiles.centres_m(slice(None))[5:9])


# Groups

GRIDS = {
    "one": scattered(1, 1.0),
    "few": scattered(5, 1e-3),
    "volume": scattered(700, 0.3),
    "sparse": scattered(300, 1e4),
    "same": Grid.points(np.tile([1.0, 40, 0], (333, 1))),
    "cube": Grid.points(beside(np.random.default_rng(1).uniform(0, 0.1, (3, 4, 5, 3)), 0, 40, 0)),
    "row": Grid.points(patch(0, 40, 200, 1).positions_m()),
    "heights": patch(0, 40, 37, 35).with_height(np.random.default_rng(2).normal(0, 0.1, (35, 37))),
    "cliff": patch(0, 40, 37, 35).with_height(np.arange(35 * 37).reshape(35, 37) % 7 * 30.0),
    "near": patch(-0.1, 0.01, 37, 35),
}


@pytest.fixture(params=GRIDS.values(), ids=GRIDS.keys())
def grid(request):
    return request.param


@pytest.mark.parametrize("width", WIDTHS)
def test_groups_hold_every_pixel_where_it_lies(grid, width):
    groups = laid_out(grid, CYCLES_PER_M, width)
    assert isinstance(groups, Groups)
    assert groups.index.shape == (groups.parts, STACK * width) == groups.offset_m.shape[:2]
    np.testing.assert_array_equal(np.unique(groups.index), np.arange(grid.size))
    wanted = grid.positions_m().reshape(-1, 3)[groups.index]
    rounding = np.abs(groups.offset_m).max() * 2.0**-24 + 1e-14 * np.abs(wanted).max()
    np.testing.assert_allclose(positions_of(groups), wanted, atol=rounding)


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("cycles_per_m", [1.0, CYCLES_PER_M, 1e6])
def test_groups_stay_within_the_radius_that_float32_allows(grid, width, cycles_per_m):
    groups = laid_out(
        grid.with_height(np.zeros(grid.shape)) if grid.is_planar else grid, cycles_per_m, width
    )
    assert isinstance(groups, Groups)
    assert groups.radius_m == pytest.approx(distances_of(groups).max(), rel=1e-6)
    # Half a unit in the last place of a phase of so many cycles.
    phase_error = 2 * np.pi * groups.radius_m * cycles_per_m * 2.0**-24
    assert phase_error <= 3 * GEOMETRY_ERROR


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", ["few", "volume", "same", "cube", "row", "heights", "near"])
def test_neighbours_share_a_group(name, width):
    """Groups are few: pixels that lie close together are not spread over many."""
    grid = GRIDS[name]
    groups = laid_out(grid, 1.0, width)
    assert groups.parts <= 2 * -(-grid.size // (STACK * width)) + 8


def test_groups_collect_every_pixel(grid):
    groups = laid_out(grid, CYCLES_PER_M, 4)
    image = groups.collect(groups.index.ravel().astype(np.complex64))
    np.testing.assert_array_equal(image, np.arange(grid.size).reshape(grid.shape))


@pytest.mark.parametrize("width", WIDTHS)
def test_blocks_are_no_larger_than_groups(grid, width):
    groups = laid_out(grid, CYCLES_PER_M, width)
    assert groups.block_radius_m <= 2 * groups.radius_m * (1 + 1e-6)
    if width == 1:
        assert groups.block_radius_m == 0


def test_a_plane_without_a_carrier_is_laid_out_too():
    layout = laid_out(patch(0, 40), 0.0, 16)
    assert layout.parts >= 1
    heights = dataclasses.replace(patch(0, 40), height_m=np.zeros((33, 40)))
    assert np.isfinite(laid_out(heights, 0.0, 16).radius_m)


@pytest.mark.parametrize("width", WIDTHS)
def test_no_pixel_is_further_than_allowed_from_where_its_samples_are_looked_up(width):
    grid = Grid.oriented([0, 40, 0], [0.001, 0.004, 0.003], [0.004, 0.0025, -0.001], (64, 64))
    tiles, (rows, columns) = Tiles(grid, 64, width), BLOCKS[width]
    item = np.arange(STACK * rows * columns).reshape(STACK * rows, columns)
    row, column = np.divmod(item, columns)
    place_m = row[..., None] * grid.row_step_m + column[..., None] * grid.column_step_m
    found = set()
    for most_m in np.geomspace(1e-4, 0.2, 60):
        parts = tiles.windows(most_m)
        found.add(parts)
        for part in np.split(place_m, parts) if parts else []:
            middle_m = part.mean(axis=(0, 1))
            assert np.linalg.norm(part - middle_m, axis=-1).max() <= most_m * (1 + 1e-9)
    assert found == {16: {0, 1, 2, STACK}, 1: {STACK}}.get(width, {0, STACK})


@pytest.mark.parametrize("width", [8, 16])
@pytest.mark.parametrize("seed", range(4))
def test_ranges_change_within_a_block_by_no_more_than_allowed(width, seed):
    """Bounds on directions allow larger blocks if no antenna lies along their diagonal."""
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=seed).as_matrix()
    grid = Grid.oriented([0, 40, 0], 0.01 * turn[0], 0.02 * turn[1], (128, 64))
    bare, (rows, columns) = Tiles(grid, 64, width), BLOCKS[width]
    away_m = 30 * turn[rng.integers(3)] + rng.normal(0, 5, (50, 3))
    antennas_m = grid.positions_m()[64, 32] + away_m
    tiles = dataclasses.replace(bare, cosines=bare.cosines_of(antennas_m))
    places_m = grid.positions_m().reshape(128 // rows, rows, 64 // columns, columns, 3)
    blocks_m = places_m.swapaxes(1, 2).reshape(-1, rows * columns, 3)[rng.integers(0, 100, 40)]
    to_pixels_m = np.linalg.norm(blocks_m[..., None, :] - antennas_m, axis=-1)
    to_middle_m = np.linalg.norm(blocks_m.mean(axis=1)[:, None] - antennas_m, axis=-1)
    change_m = np.abs(to_pixels_m - to_middle_m[:, None]).max()
    least_m = next(most_m for most_m in np.geomspace(1e-3, 1, 500) if tiles.windows(most_m))
    bound_m = next(most_m for most_m in np.geomspace(1e-3, 1, 500) if bare.windows(most_m))
    assert change_m <= least_m <= bound_m
    if least_m < 0.9 * bound_m:
        assert change_m >= 0.5 * least_m


@pytest.mark.parametrize("squint", [0.0, 25.0])
@pytest.mark.parametrize("heading", [0.0, 20.0, 90.0])
def test_ranges_change_within_a_block_by_no_more_than_allowed_in_a_beam(heading, squint):
    """The beam bounds lines of sight, wherever the antennas of a turning track are."""
    rng = np.random.default_rng(3)
    grid = Grid.plane((0, 1.27, 128), (40, 40.63, 64))
    bare, (rows, columns) = Tiles(grid, 64, 8), BLOCKS[8]
    beam = BeamWindow(20.0, "hann", squint_deg=squint)
    angle = np.deg2rad(heading + np.linspace(-10, 10, 7))
    along = np.stack([np.cos(angle), np.sin(angle), np.zeros(7)], axis=1)
    tiles = dataclasses.replace(bare, cosines=bare.cosines_in_beam(beam, along))
    # Directions of the track between the given ones, and all lines of sight in the beam.
    between = np.deg2rad(heading + rng.uniform(-10, 10, 4000))
    forward = np.stack([np.cos(between), np.sin(between), np.zeros(4000)], axis=1)
    sine = rng.uniform(*beam.limits, 4000)[:, None]
    around = np.cross(forward, rng.standard_normal((4000, 3)))
    around /= np.linalg.norm(around, axis=1)[:, None]
    way = sine * forward + np.sqrt(1 - sine**2) * around
    row, column = np.mgrid[:rows, :columns].reshape(2, -1) - np.array(
        [[(rows - 1) / 2], [(columns - 1) / 2]]
    )
    place_m = row[:, None] * grid.row_step_m + column[:, None] * grid.column_step_m
    change_m = np.abs(place_m @ way.T).max()
    sizes_m = np.geomspace(1e-3, 1, 500)
    least_m = next(most_m for most_m in sizes_m if tiles.windows(most_m))
    assert change_m <= least_m
    assert least_m < 1.1 * change_m


def test_grids_that_are_not_rectangles_have_no_bound_of_directions():
    grid = Grid.oriented([0, 40, 0], [0.01, 0.002, 0], [0.002, 0.01, 0], (64, 64))
    tiles = Tiles(grid, 64, 8)
    assert tiles.cosines_of(np.array([[0.0, 0.0, 0.0]])) == (1.0, 1.0)
    beam = BeamWindow(5.0)
    assert tiles.cosines_in_beam(beam, np.array([[1.0, 0.0, 0.0]])) == (1.0, 1.0)
