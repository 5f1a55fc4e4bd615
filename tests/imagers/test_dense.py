"""Factorized images of dense apertures against exact images."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from cases import lines_over
from dense import TRACKS, headings, scene, to_and_fro, turning
from factorizing import EXACT_IS_SLOW, changed, peak_device_bytes
from tiers import also, thinned

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.device.device import open_device
from clsas.engine.factorized import planner
from clsas.engine.factorized.costs import Costs
from clsas.engine.factorized.plan import Plan
from clsas.engine.factorized.tree import geometry_of, sector_of
from clsas.engine.forming import scene_of_plan
from clsas.engine.imaging import backproject, factorize, plan
from clsas.selftest import reference
from clsas.selftest.accuracy import driven

SHAPES = {"passes": "strips"}  # sheets otherwise
KINDS = ("hills", "volume", "bistatic", "moving")


@pytest.fixture(autouse=True)
def _searches_are_free(monkeypatch):
    """These images are so small that no second search would pay."""
    monkeypatch.setattr(planner, "SEARCH_S", 0.0)


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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "tolerance_db"), thinned(TRACKS, [-25, -40, -60], whole=("helix", "passes"))
)
def test_an_image_keeps_its_tolerance(name, tolerance_db):
    chosen = planned(name, tolerance_db)
    assert not chosen.is_exact
    # One curve is as fast for few small roots at low accuracy.
    if tolerance_db < -50 or name in ("helix", "raster", "spiral", "planar"):
        assert chosen.factorization.aperture.shape == SHAPES.get(name, "sheet")
    assert_keeps(chosen, relative_error_db(factorize(*scene(name), chosen), exact(name)))


@pytest.mark.slow
@pytest.mark.parametrize("tolerance_db", [-25, -40])
def test_errors_on_a_sheet_are_predicted_within_3_db(tolerance_db):
    """Filters of few taps err with a bias that adds up from stage to stage; others do not."""
    chosen = planned("helix", tolerance_db)
    error_db = relative_error_db(factorize(*scene("helix"), chosen), exact("helix"))
    assert abs(error_db - chosen.predicted_error_db) < 3


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "name"), thinned(KINDS, ["jittered helix", "planar", "passes"]))
def test_so_it_does_off_the_plane_and_with_separate_or_moving_receivers(name, kind):
    chosen = planned(name, -40, kind)
    if not chosen.is_exact:
        image = factorize(*scene(name, kind), chosen)
        assert_keeps(chosen, relative_error_db(image, exact(name, kind)))


def on_carrier(name):
    """Ten rings, or a helix of ten turns, around a small grid; lines keep their carrier of 20 kHz.

    In air, and sampled at 100 kHz, as recordings of microphones are.
    """
    turn = np.arange(900) / 90
    up = np.floor(turn) if name == "rings" else turn
    angle = 2 * np.pi * turn
    tx = np.stack([0.83 * np.cos(angle), 0.83 * np.sin(angle), 0.5 + 0.02 * up], axis=1)
    grid = Grid.plane((-0.11, 0.11, 48), (-0.11, 0.11, 48))
    band = {"occupied": 0.02, "centre": 0.2, "speed": 348.9}
    return lines_over(grid, tx, carrier_hz=0.0, step_m=348.9 / 2e5, **band), grid


@pytest.mark.slow
@pytest.mark.parametrize(("name", "tolerance_db"), thinned(["rings", "helix"], [-50, -60]))
def test_rings_and_helices_keep_their_tolerance_on_their_carrier(name, tolerance_db):
    lines, grid = on_carrier(name)
    chosen = plan(lines, grid, tolerance_db=tolerance_db, costs=EXACT_IS_SLOW)
    assert not chosen.is_exact
    exact_image = backproject(lines, grid, accuracy_db=-85)
    error_db = relative_error_db(factorize(lines, grid, chosen), exact_image)
    assert error_db <= chosen.predicted_error_db


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["helix", *also("passes")])
def test_the_oracle_agrees(name):
    """Random pixels against sums in float64 that share nothing with the imagers."""
    lines, grid = scene(name)
    image = factorize(lines, grid, planned(name, -50))
    found_db = reference.sampled_error_db(
        image, lambda *given: reference.ideal(lines, *given), pixels=60
    )
    assert found_db < -49


WINDOWS = {
    "all": None,
    "hann": BeamWindow(20, "hann"),
    "squinted": BeamWindow(20, "hann", squint_deg=6),
    "normalising": BeamWindow(25, "hann", normalise=True),
}
SIDE = 64
CASES = [(kind, window) for window in WINDOWS for kind in ("plane", *KINDS)]


def with_headings(name, beam):
    """A beam with the headings of an aperture's platform."""
    if beam is None:
        return None
    return dataclasses.replace(beam, along=headings(name, beam.squint_deg))


def exactly(lines, grid, beam):
    """The exact image; point by point a window is evaluated for every pixel."""
    pixels = backproject(lines, Grid.points(grid.positions_m()), beam=beam, accuracy_db=-80).pixels
    return Image(pixels, grid)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "name"), thinned(CASES, [name for name in TRACKS if name != "spiral"])
)
def test_every_aperture_with_every_beam(case, name):
    """On a plane and off it, with separate and with moving receivers."""
    kind, window = case
    lines, grid = scene(name, kind, SIDE)
    beam = with_headings(name, WINDOWS[window])
    chosen = plan(lines, grid, tolerance_db=-40, beam=beam, costs=EXACT_IS_SLOW)
    assert not chosen.is_exact
    error_db = relative_error_db(factorize(lines, grid, chosen), exactly(lines, grid, beam))
    assert error_db <= -40
    assert -4 <= error_db - chosen.predicted_error_db <= 1


@pytest.mark.exhaustive
@pytest.mark.parametrize("window", ["squinted", *also("all", "hann")])
def test_images_of_a_helix_pay_with_a_beam(window):
    """Costs are those of a CPU: an image of some size is factorized because that is faster."""
    lines, grid = scene("helix", side=224)
    beam = with_headings("helix", WINDOWS[window])
    chosen = plan(lines, grid, tolerance_db=-40, beam=beam, costs=Costs())
    assert chosen.factorization.aperture.shape == "sheet"
    assert chosen.predicted_seconds < chosen.exact_seconds
    error_db = relative_error_db(factorize(lines, grid, chosen), exactly(lines, grid, beam))
    assert error_db <= -40
    assert -4 <= error_db - chosen.predicted_error_db <= 1


@pytest.mark.exhaustive
def test_the_oracle_agrees_with_a_beam_that_turns():
    lines, grid = scene("helix")
    beam = with_headings("helix", WINDOWS["squinted"])
    image = factorize(lines, grid, planned("helix", -50, beam=beam))
    found_db = reference.sampled_error_db(
        image, lambda *given: reference.ideal(lines, *given, beam=beam), pixels=60
    )
    assert found_db < -49


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "squint_deg", "along", "reason"),
    [
        ("spiral", 0.0, turning(TRACKS["spiral"]()), "deviate too much from a smooth aperture"),
        ("raster", 6.0, to_and_fro(), "deviate too much from a smooth aperture"),
    ],
)
def test_a_plan_tells_why_an_image_is_exact(name, squint_deg, along, reason):
    """Neighbours look elsewhere: in the middle of the spiral, and on the way back of a scan."""
    beam = BeamWindow(20, "hann", squint_deg=squint_deg, along=along)
    chosen = planned(name, -40, beam=beam)
    assert chosen.is_exact
    assert reason in chosen.describe()
    assert Plan.from_json(chosen.to_json()).method == chosen.method


@pytest.mark.slow
@pytest.mark.parametrize("name", ["helix", "raster", "planar", "passes"])
def test_virtual_channels_are_as_many_as_predicted(name):
    """Filters of each stage extend past the ends of those before: these count too."""
    lines, grid = scene(name)
    chosen = planned(name, -60, depth=3)
    geometry = geometry_of(scene_of_plan(lines, grid, chosen), chosen.factorization)
    sector = sector_of(geometry, 0, len(geometry.roots))
    for level, stage in enumerate(chosen.stages[:-1]):
        counts = sector.needs[level].last - sector.needs[level].first
        assert stage.channels == pytest.approx(counts[counts > 0].mean(), rel=0.25)


@pytest.mark.slow
def test_turns_of_a_helix_that_lie_above_each_other_are_held_in_half_precision():
    """Many channels at the same angle are no crowd: each is in a row of its own."""
    assert planned("helix", -40).half_precision == open_device().info.half_precision


@pytest.mark.slow
@pytest.mark.parametrize("name", ["passes", *also("helix", "planar")])
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


@pytest.mark.slow
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
        factorize(line, grid, changed(chosen, aperture=aperture))


@pytest.mark.slow
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


@pytest.mark.slow
def test_samples_that_no_pixel_needs_are_not_upsampled():
    lines, grid = scene("helix")
    longer = dataclasses.replace(
        lines, samples=np.concatenate([lines.samples, np.zeros((lines.channels, 500))], axis=1)
    )
    chosen = plan(longer, grid, tolerance_db=-40, costs=EXACT_IS_SLOW)
    resampling = chosen.factorization.resampling
    assert resampling.length < 0.5 * resampling.ratio * longer.length
    assert relative_error_db(factorize(longer, grid, chosen), exact("helix")) < -39.7


@pytest.mark.slow
@pytest.mark.parametrize(
    ("way", "name"), thinned([(1, False), (4, False), (8, True)], ["helix", "passes"])
)
def test_devices_of_any_width_agree(way, name):
    device = driven(open_device(), *way)
    chosen = planned(name, -60, device=device)
    assert chosen.factorization.aperture.shape == SHAPES.get(name, "sheet")
    image = factorize(*scene(name), chosen, device=device)
    assert_keeps(chosen, relative_error_db(image, exact(name)))
