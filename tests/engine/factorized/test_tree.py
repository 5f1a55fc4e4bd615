import numpy as np
import pytest
from cases import along_x, thesis_lines
from factorizing import (
    BEAMS,
    CARRIER,
    EXACT_IS_SLOW,
    SPEED,
    around,
    made,
    near,
    over,
    swaying,
)
from studies.scaling import scaled

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.geometry import bistatic_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.surface import surface_of
from clsas.engine.data.visibility import Visibility
from clsas.engine.factorized import tree
from clsas.engine.factorized.phase_rates import directions_of
from clsas.engine.factorized.track import mean_track
from clsas.engine.factorized.tree import (
    Tree,
    channel_ranges,
    geometry_of,
    references,
    sector_of,
    visible_stretches,
)
from clsas.engine.forming import scene_of_plan
from clsas.engine.imaging import backproject, factorize, plan

HANN = BEAMS[0]
SIDES = ((64, 48), (32, 16), (16, 4))
WAVELENGTH = SPEED / CARRIER

# Subimages


@pytest.mark.parametrize("shape", [(1, 1), (64, 48), (65, 49), (200, 100)])
def test_roots_hold_every_pixel_once(shape):
    subimages = Tree(surface_of(around(0, 40, shape=shape)), SIDES)
    count = np.zeros((384, 384), int)
    for row, column in subimages.roots:
        count[row : row + 64, column : column + 48] += 1
    assert (count[: shape[0], : shape[1]] == 1).all()
    assert all(row < shape[0] and column < shape[1] for row, column in subimages.roots)


@pytest.mark.parametrize("level", [1, 2])
def test_subimages_fill_their_parents(level):
    subimages = Tree(surface_of(around(0, 40, shape=(150, 100))), SIDES)
    parents = subimages.corners(level - 1, subimages.roots)
    children = subimages.corners(level, subimages.roots)
    inside = children - parents[:, subimages.parents(level)]
    assert (inside >= 0).all()
    assert (inside + SIDES[level] <= SIDES[level - 1]).all()
    for root in children:
        assert len({tuple(corner) for corner in root}) == subimages.per_root(level)


def test_a_centre_is_the_mean_of_pixels():
    grid = around(3, 40, shape=(150, 100))
    surface = surface_of(grid)
    subimages = Tree(surface, SIDES)
    corners = subimages.corners(1, subimages.roots[:1])
    positions_m = grid.positions_m()
    for (row, column), centre_m in zip(corners[0], subimages.centres_m(1, corners)[0], strict=True):
        pixels_m = positions_m[row : row + 32, column : column + 16].reshape(-1, 3)
        np.testing.assert_allclose(centre_m, pixels_m.mean(axis=0), atol=1e-12)
        assert np.linalg.norm(pixels_m - centre_m, axis=1).max() <= surface.radius_m(SIDES[1])


# Channels that subimages need


def with_all_channels(lines, grid, chosen):
    """Return an image whose subimages combine all channels and have all virtual channels."""
    formed, needed = [], []

    def widened(subimages, virtual, coordinate, visible, inside):
        everywhere = np.full_like(visible[0], -np.inf), np.full_like(visible[1], np.inf)
        every_leaf = np.ones_like(inside)
        found = channel_ranges(subimages, virtual, coordinate, everywhere, every_leaf)
        usual = channel_ranges(subimages, virtual, coordinate, visible, inside)
        for counts, ranges in ((formed, found), (needed, usual)):
            counts += [(each.last - each.first).sum() for each in ranges]
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tree, "channel_ranges", widened)
        image = factorize(lines, grid, chosen)
    assert sum(formed) > sum(needed) > 0
    return image


@pytest.mark.slow
@pytest.mark.parametrize("beam", BEAMS, ids=["hann", "wide", "squint"])
def test_leaves_have_all_the_virtual_channels_they_need(beam):
    """Channels outside a beam have no weight, so that the image is as good without them."""
    grid = around(0, 12, pixel_m=(0.015, 0.05), shape=(130, 150))
    lines, _ = over(grid, along_x(700, 0.012))
    chosen = plan(lines, grid, tolerance_db=-45, beam=beam, costs=EXACT_IS_SLOW)
    assert not chosen.is_exact
    whole = with_all_channels(lines, grid, chosen)
    exact = backproject(lines, grid, accuracy_db=-85, beam=beam)
    assert relative_error_db(whole, exact) <= -45
    image = factorize(lines, grid, chosen)
    assert not np.array_equal(image.pixels, whole.pixels)
    assert relative_error_db(image, exact) <= relative_error_db(whole, exact) + 0.5


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(33, 65), (70, 129)])
def test_subimages_beyond_the_grid_are_not_missed(shape):
    grid = around(0, 40, shape=shape)
    lines, _ = over(grid)
    chosen = plan(lines, grid, tolerance_db=-45, costs=EXACT_IS_SLOW)
    assert not chosen.is_exact
    whole = with_all_channels(lines, grid, chosen)
    assert relative_error_db(factorize(lines, grid, chosen), whole) <= -110


# Stretches of the track from which subimages are visible


def test_a_visible_stretch_holds_every_channel_of_some_weight():
    lines, grid = made(near)
    beam, track = BEAMS[0], mean_track(lines, WAVELENGTH)
    along = directions_of(beam, beam.directions(lines), track).along
    subimages = Tree(surface_of(grid), ((16, 16),))
    corners = subimages.roots[:, None]
    half_m = 8 * np.stack([grid.row_step_m, grid.column_step_m])
    begin, end = visible_stretches(
        beam.limits, track, along, subimages.centres_m(0, corners), half_m
    )
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


# Sectors


@pytest.fixture(scope="module")
def wide_plan():
    """A plan with a narrow beam, for a scene that extends past both ends of the track."""
    case = scaled(512)
    lines, grid = case.lines(), case.grid
    return plan(lines, grid, tolerance_db=-40, beam=case.beam, costs=EXACT_IS_SLOW)


@pytest.fixture(scope="module")
def wide(wide_plan):
    case, chosen = scaled(512), wide_plan
    lines, grid = case.lines(), case.grid
    return geometry_of(scene_of_plan(lines, grid, chosen), chosen.factorization)


def beside():
    grid = around(0, 12, pixel_m=(0.015, 0.05), shape=(130, 150))
    track = np.stack([(np.arange(700) - 349.5) * 0.012, *np.zeros((2, 700))], axis=1)
    return over(grid, track)[0], grid


@pytest.fixture(scope="module", params=["whole", "gap"])
def any_track(request, wide):
    """The same geometry, and one with a gap in the track longer than a root and its beam."""
    if request.param == "whole":
        return wide
    case = scaled(512)
    lines = case.lines()
    lines = lines.select(np.flatnonzero(np.abs(lines.tx_m[:, 0] - 2) > 8))
    beam = BeamWindow(3.0, "hann")
    chosen = plan(lines, case.grid, tolerance_db=-40, beam=beam, costs=EXACT_IS_SLOW)
    return geometry_of(scene_of_plan(lines, case.grid, chosen), chosen.factorization)


# Channels that are formed


@pytest.mark.slow
def test_channels_are_as_many_as_planned(wide, wide_plan):
    sector = sector_of(wide, 0, len(wide.roots))
    for level, (need, stage) in enumerate(zip(sector.needs, wide_plan.stages, strict=False)):
        formed = (need.end - need.begin).sum() * stage.samples
        assert 0.75 <= formed / stage.operations <= 1.35, f"stage {level + 1}"
    pixels = np.prod(wide_plan.sides[-1]) * (need.last - need.first).sum()
    assert 0.75 <= pixels / wide_plan.stages[-1].operations <= 1.35


def test_both_ends_of_the_track_are_alike(wide):
    sector = sector_of(wide, 0, len(wide.roots))
    need = sector.needs[-1]
    x_m = sector.root_m[:, 0]
    assert abs(x_m.min() + x_m.max()) < 0.1  # metres; pixels are symmetric except for half a pixel
    left, right = ((need.last - need.first)[x_m == end].mean() for end in (x_m.min(), x_m.max()))
    assert left == pytest.approx(right, rel=0.1, abs=1.5)


def test_virtual_channels_without_contributions_are_not_formed(wide):
    sector = sector_of(wide, 0, len(wide.roots))
    counts = np.full(len(sector.roots), sector.coordinate.shape[1])
    for virtual, need in zip(sector.virtual, sector.needs, strict=True):
        assert (need.end <= counts[:, None]).all()
        counts = virtual.base[np.arange(len(counts)), counts - 1] + virtual.taps
        assert (need.last <= counts[:, None]).all()


@pytest.mark.exhaustive
def test_subimages_use_what_their_parents_have(any_track):
    wide = any_track
    sector = sector_of(wide, 0, len(wide.roots))
    for level in range(1, len(sector.needs)):
        need, above = sector.needs[level], sector.needs[level - 1]
        parents, used = wide.tree.parents(level), need.end > need.begin
        assert (need.begin >= above.first[:, parents])[used].all()
        assert (need.end <= above.last[:, parents])[used].all()


# Several roots together


@pytest.mark.parametrize("case", [beside, swaying], ids=["straight", "swaying"])
def test_roots_do_not_depend_on_those_prepared_beside_them(case):
    lines, grid = case()
    chosen = plan(lines, grid, tolerance_db=-40, costs=EXACT_IS_SLOW)
    geometry = geometry_of(scene_of_plan(lines, grid, chosen), chosen.factorization)
    together = sector_of(geometry, 0, len(geometry.roots))
    for index in range(len(geometry.roots)):
        alone = sector_of(geometry, index, index + 1)
        for level, virtual in enumerate(alone.virtual):
            count = int(alone.needs[level].last.max())
            for name in ("first", "last", "begin", "end"):
                mine = getattr(alone.needs[level], name)[0]
                np.testing.assert_array_equal(mine, getattr(together.needs[level], name)[index])
            np.testing.assert_allclose(
                virtual.position_m[0, :count],
                together.virtual[level].position_m[index, :count],
                atol=1e-9,
            )


def test_leaves_are_visible_from_wherever_they_are_alone():
    lines, grid = beside()
    chosen = plan(lines, grid, tolerance_db=-40, beam=HANN, costs=EXACT_IS_SLOW)
    geometry = geometry_of(scene_of_plan(lines, grid, chosen), chosen.factorization)
    sector = sector_of(geometry, 0, len(geometry.roots))
    last = len(chosen.sides) - 1
    leaves = geometry.tree.corners(last, sector.roots)
    half_m = np.array(chosen.sides[-1])[:, None] / 2
    half_m = half_m * [grid.row_step_m, grid.column_step_m]
    start, stop = visible_stretches(
        chosen.factorization.limits,
        geometry.track,
        geometry.along,
        geometry.tree.centres_m(last, leaves),
        half_m,
    )
    need, coordinate = sector.needs[-1], sector.virtual[-1].coordinate
    counts = np.full(len(sector.roots), sector.coordinate.shape[1])
    for virtual in sector.virtual:  # only those to which channels contribute
        counts = virtual.base[np.arange(len(counts)), counts - 1] + virtual.taps
    inside = np.all(leaves < grid.shape, axis=-1)
    for root, leaf in np.argwhere(inside & (stop > start)):
        mine = np.flatnonzero(
            (coordinate[root] >= start[root, leaf]) & (coordinate[root] <= stop[root, leaf])
        )
        mine = mine[mine < counts[root]]
        assert need.first[root, leaf] <= mine.min()
        assert need.last[root, leaf] > mine.max()


# Shifts and phases of raw channels


@pytest.mark.slow
def test_references_are_ranges_and_phases(wide):
    lines, resampling = wide.lines, wide.factorization.resampling
    sector = sector_of(wide, 0, 3)
    found = references(wide, sector)
    line = found["order"]
    range_m = bistatic_range_m(sector.root_m[:, None], lines.tx_m[line], lines.rx_m[line])
    index = (range_m - lines.first_range_m[line]) / lines.range_step_m
    centre = found["start"] + found["nu"].astype(float) + (wide.factorization.align.taps - 1) / 2
    # Positions of two channels differ as their ranges do, in upsampled samples.
    away = (centre - centre[:, :1]) / resampling.ratio
    np.testing.assert_allclose(away, index - index[:, :1], atol=1e-4)
    cycles = lines.carrier_cycles_per_m * range_m
    cycles += (index + resampling.lead) * resampling.centre_cycles_per_sample
    wrong = found["cycles"] - cycles
    assert np.abs(wrong - np.rint(wrong)).max() < 1e-5
