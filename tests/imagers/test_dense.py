"""Factorized images of dense apertures against exact images."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from dense import TRACKS, scene
from factorizing import EXACT_IS_SLOW, peak_device_bytes

from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.image_error import relative_error_db
from clsas.exact import reference
from clsas.exact.backprojection import backproject
from clsas.factorized.plan import Plan
from clsas.opencl.device import open_device
from clsas.planning import planner
from clsas.planning.factorize import factorize
from clsas.planning.planner import plan
from clsas.sonar.beam import BeamWindow
from clsas.trials.selftest import driven

SHAPES = {"passes": "strips"}  # sheets otherwise
KINDS = ("hills", "volume", "bistatic", "moving")


@pytest.fixture(autouse=True)
def _searches_are_free(monkeypatch):
    """These images are so small that no second search would pay."""
    monkeypatch.setattr(planner, "_SEARCH_S", 0.0)


@cache
def exact(name, kind="plane"):
    return backproject(*scene(name, kind), accuracy_db=-80)


def planned(name, tolerance_db, kind="plane", **options):
    return plan(*scene(name, kind), tolerance_db=tolerance_db, costs=EXACT_IS_SLOW, **options)


def assert_keeps(chosen, error_db):
    """The error is within the tolerance, and not much better than predicted."""
    assert error_db <= chosen.tolerance_db + 0.3
    assert chosen.predicted_error_db - 1 <= chosen.tolerance_db
    assert -5 <= error_db - chosen.predicted_error_db <= 1


@pytest.mark.parametrize("tolerance_db", [-25, -40, -60])
@pytest.mark.parametrize("name", TRACKS)
def test_an_image_keeps_its_tolerance(name, tolerance_db):
    chosen = planned(name, tolerance_db)
    assert not chosen.is_exact
    # One curve is as fast for few small roots at low accuracy.
    if tolerance_db < -50 or name in ("helix", "raster", "spiral", "planar"):
        assert chosen.factorization.aperture.shape == SHAPES.get(name, "sheet")
    assert_keeps(chosen, relative_error_db(factorize(*scene(name), chosen), exact(name)))


@pytest.mark.parametrize("tolerance_db", [-25, -40])
def test_errors_on_a_sheet_are_predicted_within_3_db(tolerance_db):
    """Filters of few taps err with a bias that adds up from stage to stage; others do not."""
    chosen = planned("helix", tolerance_db)
    error_db = relative_error_db(factorize(*scene("helix"), chosen), exact("helix"))
    assert abs(error_db - chosen.predicted_error_db) < 3


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["jittered helix", "planar", "passes"])
def test_so_it_does_off_the_plane_and_with_separate_or_moving_receivers(name, kind):
    chosen = planned(name, -40, kind)
    if not chosen.is_exact:
        image = factorize(*scene(name, kind), chosen)
        assert_keeps(chosen, relative_error_db(image, exact(name, kind)))


@pytest.mark.parametrize("name", ["helix", "passes"])
def test_the_oracle_agrees(name):
    """Random pixels against sums in float64 that share nothing with the imagers."""
    lines, grid = scene(name)
    image = factorize(lines, grid, planned(name, -50))
    found_db = reference.sampled_error_db(
        image, lambda *given: reference.ideal(lines, *given), pixels=60
    )
    assert found_db < -49


def test_passes_with_a_beam():
    """Every pass has its own direction."""
    lines, grid = scene("passes")
    beam = BeamWindow(25, "hann")
    chosen = planned("passes", -40, beam=beam)
    assert chosen.factorization.aperture.shape == "strips"
    points = Grid.points(grid.positions_m())
    pixels = backproject(lines, points, beam=beam, accuracy_db=-80).pixels
    error_db = relative_error_db(factorize(lines, grid, chosen), Image(pixels, grid))
    assert_keeps(chosen, error_db)


@pytest.mark.parametrize("tolerance_db", [-30, -50])
@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("raster", "plane"),
        ("spiral", "plane"),
        ("planar", "bistatic"),
        ("planar", "moving"),
        ("planar", "hills"),
    ],
)
def test_sheets_with_a_beam(name, kind, tolerance_db):
    """A sonar whose heading stays the same, wherever it moves to."""
    lines, grid = scene(name, kind)
    beam = BeamWindow(25, "hann", along=(1.0, 0.0, 0.0))
    chosen = planned(name, tolerance_db, kind, beam=beam)
    assert chosen.factorization.aperture.shape == "sheet"
    points = Grid.points(grid.positions_m())
    pixels = backproject(lines, points, beam=beam, accuracy_db=-80).pixels
    error_db = relative_error_db(factorize(lines, grid, chosen), Image(pixels, grid))
    assert_keeps(chosen, error_db)


def test_a_beam_that_normalises_needs_a_single_curve():
    beam = BeamWindow(25, "hann", along=(1.0, 0.0, 0.0), normalise=True)
    assert planned("planar", -40, beam=beam).is_exact


@pytest.mark.parametrize("name", ["helix", "planar", "passes"])
def test_channels_may_be_shuffled(name):
    lines, grid = scene(name)
    order = np.random.default_rng(5).permutation(lines.channels)
    ordered, shuffled = planned(name, -60), lines.select(order)
    chosen = plan(shuffled, grid, tolerance_db=-60, costs=EXACT_IS_SLOW)
    assert chosen.factorization.aperture.shape == SHAPES.get(name, "sheet")
    assert chosen.predicted_seconds == pytest.approx(ordered.predicted_seconds, rel=0.1)
    image = factorize(shuffled, grid, chosen)
    assert relative_error_db(image, exact(name)) <= -59.7
    assert relative_error_db(image, factorize(lines, grid, ordered)) <= -57


def test_a_plan_holds_the_shape_of_the_aperture():
    for name in ("helix", "passes"):
        lines, grid = scene(name)
        chosen = planned(name, -60)
        again = Plan.from_json(chosen.to_json())
        assert again.factorization.aperture.shape == SHAPES.get(name, "sheet")
        image, same = (factorize(lines, grid, each) for each in (chosen, again))
        np.testing.assert_array_equal(image.pixels, same.pixels)


@pytest.mark.parametrize(
    ("name", "shape"), [("straight line", "strips"), ("straight line", "sheet")]
)
def test_a_plan_of_another_shape_is_refused(name, shape):
    lines, grid = scene("helix")
    tx_m = np.linspace([-1, 0, 0.5], [1, 0, 0.5], lines.channels)
    line = dataclasses.replace(lines, tx_m=tx_m, rx_m=tx_m)
    chosen = plan(line, grid, tolerance_db=-40, costs=EXACT_IS_SLOW)
    aperture = dataclasses.replace(chosen.factorization.aperture, shape=shape)
    with pytest.raises(ValueError, match=r"lines must have channels that lie on (several|a sheet)"):
        factorize(line, grid, chosen.changed(aperture=aperture))


@pytest.mark.parametrize(
    ("name", "beam"),
    [
        ("helix", None),
        ("passes", None),
        ("raster", BeamWindow(25, "hann", along=(1.0, 0.0, 0.0))),
    ],
)
def test_memory_is_as_predicted(name, beam, monkeypatch):
    lines, grid = scene(name)
    for limit in (None, 0.7):
        free = planned(name, -40, beam=beam)
        memory = None if limit is None else int(limit * free.memory_bytes)
        try:
            chosen = planned(name, -40, beam=beam, memory_bytes=memory)
        except ValueError as error:
            assert "memory_bytes must be at least" in str(error)  # noqa: PT017
            continue
        assert memory is None or chosen.memory_bytes <= memory
        if not chosen.is_exact:
            used = peak_device_bytes(
                monkeypatch, lambda chosen=chosen: factorize(lines, grid, chosen), grid.shape
            )
            assert used <= 1.02 * chosen.memory_bytes + (1 << 16)


def test_samples_that_no_pixel_needs_are_not_upsampled():
    lines, grid = scene("helix")
    longer = dataclasses.replace(
        lines, samples=np.concatenate([lines.samples, np.zeros((lines.channels, 500))], axis=1)
    )
    chosen = plan(longer, grid, tolerance_db=-40, costs=EXACT_IS_SLOW)
    resampling = chosen.factorization.resampling
    assert resampling.length < 0.5 * resampling.ratio * longer.length
    assert relative_error_db(factorize(longer, grid, chosen), exact("helix")) < -39.7


@pytest.mark.parametrize(("width", "permute"), [(1, False), (4, False), (8, True)])
@pytest.mark.parametrize("name", ["helix", "passes"])
def test_devices_of_any_width_agree(name, width, permute):
    device = driven(open_device(), width, permute)
    chosen = planned(name, -60, device=device)
    assert chosen.factorization.aperture.shape == SHAPES.get(name, "sheet")
    image = factorize(*scene(name), chosen, device=device)
    assert_keeps(chosen, relative_error_db(image, exact(name)))
