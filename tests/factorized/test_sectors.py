import numpy as np
import pytest
from factorizing import BEAMS, EXACT_IS_SLOW, around, over, swaying
from studies.scaling import scaled

from clsas.core.geometry import bistatic_range_m
from clsas.factorized.tree import geometry_of, references, sector_of, visible_stretches
from clsas.forming import scene_of_plan
from clsas.imaging import plan
from clsas.sonar.beam import BeamWindow

HANN = BEAMS[0]


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


@pytest.mark.slow
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
