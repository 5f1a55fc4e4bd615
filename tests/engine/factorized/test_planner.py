import dataclasses
import re
import subprocess
import sys

import numpy as np
import pytest
from cases import along_x, lines_over
from exactly import sampled
from factorizing import (
    BEAMS,
    EXACT_IS_SLOW,
    TRACK,
    around,
    bistatic_array,
    hills,
    made,
    moving_array,
    over,
    planned,
    straight,
    swaying,
    swaying_while_moving,
    with_gap,
)
from tiers import also, thinned

from clsas.engine.certificate import certify
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.visibility import sines
from clsas.engine.factorized import candidates, measured_costs, planner
from clsas.engine.factorized.costs import Costs
from clsas.engine.factorized.plan import Plan
from clsas.engine.factorized.planner import trimmed
from clsas.engine.imaging import backproject, factorize, plan
from clsas.engine.signal.spectrum import OUTSIDE

# What is chosen


def test_lines_that_nearly_fill_the_sampled_band_are_upsampled_by_filters(monkeypatch):
    """FFTs in their place take several times as long, and lines of half precision need filters."""
    monkeypatch.setattr(measured_costs, "_BAND", 0.92)
    lines, grid = measured_costs.noise(300, 128)
    chosen = plan(lines, grid, tolerance_db=-45, costs=EXACT_IS_SLOW)
    assert chosen.factorization.upsampler is not None
    image, exact = factorize(lines, grid, chosen), backproject(lines, grid, accuracy_db=-80)
    assert relative_error_db(image, exact) < -45


@pytest.mark.parametrize(("seed", "tolerance_db"), [(1, -20), (14, -20), (32, -50)])
def test_roots_may_be_smaller_than_subimages_that_stand_for_a_pixel(seed, tolerance_db):
    """Points scattered off their plane, under a beam, need roots of few columns."""
    rng = np.random.default_rng(seed)
    wave_m, count = 1500 / 3.4e6, int(rng.integers(150, 2000))
    tx = along_x(130, wave_m * 10 ** rng.uniform(-0.5, 0.5))
    tx[:, 1] = wave_m * rng.uniform(0, 5) * np.abs(np.arange(130) / 11 % 2 - 1)
    spread_m = wave_m * np.array([0.3, 1, 10 ** rng.uniform(-1, 1.5)])
    grid = Grid.points(np.array([0, 0.488, -0.29]) + rng.normal(size=(count, 3)) * spread_m)
    lines = lines_over(grid, tx, carrier_hz=3.4e6, step_m=8e-4)
    beam = BeamWindow(64, "tukey", along=[1, 0, 0])
    chosen = plan(lines, grid, tolerance_db=tolerance_db, beam=beam, costs=EXACT_IS_SLOW)
    assert chosen.predicted_error_db <= tolerance_db


def test_a_small_image_is_backprojected():
    grid = around(0, 40, shape=(20, 20))
    lines, _ = over(grid, along_x(30, 0.02))
    chosen = plan(lines, grid, tolerance_db=-50, costs=Costs())
    assert chosen.is_exact
    assert chosen.predicted_seconds == chosen.exact_seconds
    assert chosen.predicted_error_db <= -50
    assert "Plain backprojection: it takes less time than the search" in chosen.describe()


def test_an_exact_plan_says_how_many_channels_receive_from_a_pixel():
    """The number is that of the pencil rule in docs/thesis-systems.md."""
    costs = Costs(pixel_ns=10, point_ns=10, sample_ns=1e5)
    request = {"tolerance_db": -40, "beam": BeamWindow(6, "hann"), "costs": costs}
    text = plan(*made(straight), **request).describe()
    found = re.search(
        r"no factorization is faster .*\. About (\d+) channels .* from about 30 on", text
    )
    spacing_m = TRACK[1, 0] - TRACK[0, 0]
    by_the_rule = 2 * 40 * np.tan(np.radians(3)) / spacing_m
    assert float(found[1]) == pytest.approx(by_the_rule, rel=0.1)
    # The rule was measured on planes.
    assert "channels" not in plan(*made(hills), **request).method.reason
    assert plan(*made(straight), stages=[]).method.reason == ""


@pytest.mark.slow
@pytest.mark.parametrize("bright_m", [1.0, *also(0.01)])
def test_leaves_suit_most_pixels_of_a_grid_that_begins_close_to_the_track(bright_m):
    """An array of 20 mm images from 6 to 54 mm, of which all or only the nearest are bright."""
    grid = Grid.plane((-0.0315, 0.0315, 512), (0.006, 0.054, 512))
    track_m, speed, step_m = along_x(256, 77e-6), 1540.0, 2e-4
    lines = lines_over(grid, track_m, carrier_hz=5e6, step_m=step_m, speed=speed)
    range_m = lines.first_range_m[:, None] + step_m * np.arange(lines.length)
    lines = dataclasses.replace(lines, samples=lines.samples * (range_m < bright_m))
    beam = BeamWindow(90, "hann")
    chosen = plan(lines, grid, tolerance_db=-40, beam=beam, costs=EXACT_IS_SLOW)
    assert not chosen.is_exact
    image = factorize(lines, grid, chosen)
    exact = backproject(lines, grid, accuracy_db=-70, beam=beam)
    assert relative_error_db(image, exact) < -40


@pytest.mark.slow
@pytest.mark.parametrize("tolerance_db", [-50, *also(-10, -75)])
def test_a_large_image_is_factorized(tolerance_db):
    """A million pixels from 2000 channels."""
    grid = around(0, 40, shape=(1000, 1000))
    lines, _ = over(grid, along_x(2000, 0.004))
    chosen = plan(lines, grid, tolerance_db=tolerance_db, costs=Costs())
    assert not chosen.is_exact
    assert chosen.predicted_seconds < 0.5 * chosen.exact_seconds


@pytest.mark.parametrize("case", [straight, swaying], ids=lambda case: case.__name__)
def test_factorized_images_keep_the_tightest_tolerance(case):
    lines, grid = made(case)
    chosen = planned(case, -85)
    certificate = certify(factorize(lines, grid, chosen), lines, pixels=1000, seed=0)
    assert certificate.verdict(-85) != "missed"


@pytest.mark.parametrize("case", [straight, swaying], ids=lambda case: case.__name__)
def test_a_looser_tolerance_never_takes_longer(case):
    plans = [planned(case, tolerance_db) for tolerance_db in (-10, -25, -40, -60)]
    seconds = np.array([each.predicted_seconds for each in plans])
    assert (np.diff(seconds) >= -0.05 * seconds[1:]).all()


@pytest.mark.parametrize(
    "case",
    [bistatic_array, moving_array, swaying_while_moving],
    ids=lambda case: case.__name__,
)
def test_arrays_are_factorized_at_60_db(case):
    """What vernier arrays and motion in flight leave is no reason to give up."""
    assert not planned(case, -60).is_exact


def test_expensive_parts_are_avoided():
    leaves, stages = (
        plan(*made(straight), tolerance_db=-30, costs=dataclasses.replace(EXACT_IS_SLOW, **dear))
        for dear in ({"leaf_ns": 30.0}, {"sample_ns": 30.0})
    )
    assert not leaves.is_exact
    assert not stages.is_exact
    assert leaves.stages[-1].operations < stages.stages[-1].operations


def test_a_beam_saves_time():
    lines, grid = made(straight)
    grid = around(0, 40, shape=(150, 160), pixel_m=(0.015, 0.03))
    lines, _ = over(grid)
    whole = plan(lines, grid, tolerance_db=-30, costs=EXACT_IS_SLOW)
    beam = plan(
        lines, grid, tolerance_db=-30, beam=dataclasses.replace(BEAMS[0], width_deg=3.0),
        costs=EXACT_IS_SLOW,
    )  # fmt: skip
    assert beam.exact_seconds < whole.exact_seconds


def test_relief_takes_virtual_channels_and_samples():
    lines, grid = made(hills)
    grid = around(0, 40, z=-12)
    row, column = np.indices(grid.shape)
    tilt, waves = 0.01 * row - 0.005 * column, np.sin(row / 9) * np.sin(column / 9)
    request = {"tolerance_db": -40, "costs": EXACT_IS_SLOW, "depth": 2, "full_model": True}
    plans = [
        plan(lines, grid.with_height(height_m), **request)
        for height_m in (0 * row, tilt, tilt + waves, tilt + 3 * waves)
    ]
    flat, tilted, low, high = (p.predicted_seconds for p in plans)
    assert tilted == pytest.approx(flat, rel=0.1)  # a slope is a plane
    assert tilted < low < high
    samples = [p.stages[0].samples for p in plans]
    assert samples[1] < samples[2] < samples[3]


@pytest.mark.parametrize("change", ["one channel", "one place", "one pixel"])
def test_without_an_aperture_or_an_image_it_is_plain_backprojection(change):
    grid = around(0, 40, shape=(1, 1) if change == "one pixel" else (40, 30))
    track = {"one channel": along_x(1, 1.0), "one place": np.zeros((30, 3))}
    lines, _ = over(grid, track.get(change, along_x(30, 0.02)))
    assert plan(lines, grid, tolerance_db=-40, costs=EXACT_IS_SLOW).is_exact


def test_what_is_hardly_seen_is_not_normalised_fast():
    """Where weights sum up to next to nothing the errors are amplified with the image."""
    beam = dataclasses.replace(BEAMS[0], normalise=True)
    lines, grid = made(straight)
    assert not plan(lines, grid, tolerance_db=-40, beam=beam, costs=EXACT_IS_SLOW).is_exact
    grid = around(7, 40, pixel_m=(0.03, 0.03))
    lines, _ = over(grid)
    assert plan(lines, grid, tolerance_db=-40, beam=beam, costs=EXACT_IS_SLOW).is_exact
    plain = dataclasses.replace(beam, normalise=False)
    assert not plan(lines, grid, tolerance_db=-40, beam=plain, costs=EXACT_IS_SLOW).is_exact


def test_wavelengths_are_a_range_error():
    """Errors of range, spread evenly between minus and plus so many wavelengths."""
    turn = 4 * np.pi * np.random.default_rng(0).uniform(-0.01, 0.01, 100_000)
    error_db = 20 * np.log10(np.sqrt(np.mean(np.abs(np.exp(1j * turn) - 1) ** 2)))
    chosen = plan(*made(straight), tolerance_wavelengths=0.01, costs=EXACT_IS_SLOW)
    assert chosen.tolerance_db == pytest.approx(error_db, abs=0.05)


def test_the_same_question_gets_the_same_answer():
    one, other = (plan(*made(swaying), tolerance_db=-45, costs=EXACT_IS_SLOW) for _ in range(2))
    assert one.to_json() == other.to_json()


def test_given_stages_are_those_given():
    lines, grid = made(straight)
    chosen = plan(lines, grid, stages=[(4, 2), (3, 3)])
    assert chosen.factorization.aperture.factors == (4, 3)
    (rows, columns), (fewer_rows, fewer_columns) = chosen.sides
    assert rows == 3 * fewer_rows
    assert columns == 3 * fewer_columns
    assert [stage.channels for stage in chosen.stages] == [150, 50, 50]
    # Range errors of stages add up to what nearest beams err by.
    powers = [10 ** (stage.error_db / 20) for stage in chosen.stages[:2]]
    assert 20 * np.log10(sum(powers)) == pytest.approx(chosen.predicted_error_db, abs=0.1)


@pytest.mark.parametrize("taps", [(4, 8), (8, 4)])
@pytest.mark.parametrize("depth", [1, 2])
def test_taps_and_depth_for_study(taps, depth):
    """Filters and stages are those requested, even if the exact image is faster."""
    costs = Costs(pixel_ns=1e-3, part_ns=0.0, upsampled_sample_ns=0.0)
    assert plan(*made(straight), tolerance_db=-30, costs=costs).is_exact
    chosen = plan(*made(straight), tolerance_db=-30, taps=taps, depth=depth, costs=costs)
    image = chosen.factorization
    assert (image.align.taps, image.aperture.filter.taps) == taps
    assert len(chosen.sides) == depth
    assert chosen.predicted_error_db <= -30
    assert chosen.predicted_seconds > chosen.exact_seconds


def test_given_taps_are_hardly_faster_than_the_planners_choice():
    """It searches with lengths that are not yet of whole vectors."""
    costs = dataclasses.replace(EXACT_IS_SLOW, sample_ns=0.28, sample_tap_ns=0.03, leaf_ns=0.8)
    best = plan(*made(straight), tolerance_db=-40, costs=costs)
    for taps in ((4, 4), (6, 8), (8, 6)):
        chosen = plan(*made(straight), tolerance_db=-40, taps=taps, costs=costs)
        assert chosen.predicted_seconds >= 0.99 * best.predicted_seconds


def test_half_precision_is_for_tolerances_and_devices_that_allow_it(device):
    lines, grid = made(straight)
    chosen, tighter = (
        plan(lines, grid, tolerance_db=tolerance_db, device=device, costs=EXACT_IS_SLOW)
        for tolerance_db in (-50, -70)
    )
    assert chosen.half_precision == device.info.half_precision
    assert not tighter.half_precision
    assert not plan(lines, grid, stages=[(4, 2)], device=device).half_precision


@pytest.mark.parametrize("width_deg", [20, 40])
def test_planning_ends_soon_where_virtual_channels_follow_no_step(monkeypatch, width_deg):
    """Denser ones do not help: once the densest allowed were tried, the search ends."""
    tried, errors = [], candidates.errors_of_tree

    def counted(*arguments):
        tried.append(arguments)
        return errors(*arguments)

    monkeypatch.setattr(candidates, "errors_of_tree", counted)
    grid = around(-2, 10.8, shape=(99, 164), pixel_m=(0.0016, 0.0036))
    lines, grid = over(grid, along_x(341, 0.0346), carrier_hz=300e3, band=0.05)
    beam = BeamWindow(width_deg)
    assert plan(lines, grid, tolerance_db=-40, beam=beam, costs=EXACT_IS_SLOW).is_exact
    assert 1 < len(tried) <= 12


def test_planning_ends_whatever_is_tried_in_vain(monkeypatch):
    """Errors of a stage may remain, however dense its virtual channels are."""
    lines, grid = over(around(0, 40))
    measured = candidates.errors_of_tree

    def hopeless(*arguments):
        errors, spacing = measured(*arguments)
        spacing = (1e-2, *spacing[1:])
        return dataclasses.replace(errors, spacing=sum(spacing)), spacing

    monkeypatch.setattr(candidates, "errors_of_tree", hopeless)
    request = {"tolerance_db": -40, "costs": EXACT_IS_SLOW}
    assert plan(lines, grid, **request).is_exact


def test_a_track_there_and_back_is_not_factorized_with_a_beam():
    """Neighbours on the track look opposite ways."""
    there_m = along_x(300, 0.02)
    track_m = np.concatenate([there_m, there_m[::-1] + [0, -0.05, 0]])
    lines, grid = over(around(0, 40), track_m)
    request = {"tolerance_db": -30, "costs": EXACT_IS_SLOW}
    assert not plan(lines, grid, **request).is_exact
    assert plan(lines, grid, beam=BeamWindow(8, "hann"), **request).is_exact


@pytest.mark.parametrize(("slope", "is_exact"), [(0.0005, False), (0.3, True)])
def test_a_beam_that_swings_past_within_few_channels_is_not_factorized(slope, is_exact):
    """At a kink of the track; elsewhere nothing of this image is seen where that is sharp."""
    track_m = along_x(1000, 0.0055)
    track_m[:, 1] = slope * np.abs(track_m[:, 0] - 0.3)
    lines, grid = over(around(-0.6, 50, pixel_m=(0.012, 0.012), shape=(133, 129)), track_m)
    request = {"beam": BeamWindow(4.4, "hann"), "tolerance_db": -40, "costs": EXACT_IS_SLOW}
    assert plan(lines, grid, **request).is_exact == is_exact


@pytest.mark.slow
def test_an_image_that_lies_in_a_gap_of_the_track_is_not_factorized():
    """Where hardly a pixel sees a channel, errors are as large as the image."""
    lines, grid = over(around(0.74, 18, shape=(200, 360)), with_gap(1000, 0.022, 7.2))
    for normalise in (False, True):
        beam = BeamWindow(2.8, "hann", normalise=normalise)
        assert plan(lines, grid, tolerance_db=-50, beam=beam, costs=EXACT_IS_SLOW).is_exact


def test_a_gap_is_not_covered_where_an_image_is_normalised():
    lines, grid = over(around(-1.2, 10, shape=(200, 100)), with_gap(1000, 0.011, 2))
    request = {"tolerance_db": -15, "costs": EXACT_IS_SLOW}
    assert plan(lines, grid, beam=BeamWindow(5, "hann", normalise=True), **request).is_exact
    assert not plan(lines, grid, beam=BeamWindow(5, "hann"), **request).is_exact


@pytest.mark.parametrize("tolerance_db", [-30, -50])
def test_what_may_be_lost_is_made_use_of(tolerance_db):
    lines, grid = over(around(0, 40, shape=(512, 512)))
    chosen = plan(lines, grid, tolerance_db=tolerance_db, costs=EXACT_IS_SLOW)
    assert tolerance_db - 0.8 <= chosen.predicted_error_db <= tolerance_db


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("factor", [0.0, 1e-44, 1e-40, 1e-30, 1e30])
def test_samples_of_any_size_are_planned_for(factor):
    lines, grid = over(around(0, 40))
    samples = (lines.samples / np.abs(lines.samples).max() * factor).astype(np.complex64)
    lines = dataclasses.replace(lines, samples=samples)
    assert not plan(lines, grid, tolerance_db=-40, costs=EXACT_IS_SLOW).is_exact


@pytest.mark.parametrize("carrier_hz", [0.0, 5e3])
def test_bands_about_0_are_planned_for(carrier_hz):
    """Half of them, or some, are negative frequencies."""
    lines, grid = over(around(0, 40))
    lines = dataclasses.replace(lines, carrier_hz=carrier_hz)
    assert plan(lines, grid, tolerance_db=-40, costs=EXACT_IS_SLOW).predicted_error_db <= -40


@pytest.mark.parametrize("beam_deg", [2, 9, 30])
@pytest.mark.parametrize("share", [1e-2, 1e-4])
def test_next_to_nothing_of_a_beam_is_left_out(beam_deg, share):
    """Also where no pixel sees more than a small part of it: the image is wider than the track."""
    grid = around(0, 40, pixel_m=(0.03, 0.3), shape=(50, 60))
    lines, _ = over(grid, along_x(200, 0.014))
    beam = BeamWindow(beam_deg, "hann")
    low, high = trimmed(sampled(lines, grid, beam).sampled, beam.limits, share)
    sine = sines(grid.positions_m().reshape(-1, 3), lines.phase_centres_m, beam.directions(lines))
    weights = beam.weights(sine) ** 2
    left_out = weights[(sine < low) | (sine > high)].sum() / weights.sum()
    assert left_out <= 2 * share


# Memory


@pytest.mark.slow
@pytest.mark.parametrize(
    ("costs", "beam"),
    thinned([EXACT_IS_SLOW, Costs(pixel_ns=1e-3, part_ns=0.0)], [None, BEAMS[0]]),
)
def test_memory_decides_whatever_things_cost(costs, beam):
    """What fits is taken, also if it is slower; and else the least that does is named."""
    lines, grid = over(around(0, 40, shape=(600, 700)))
    request = {"tolerance_db": -40, "beam": beam, "costs": costs}
    plain = plan(lines, grid, stages=[], beam=beam, costs=costs)
    little = plan(lines, grid, memory_bytes=plain.memory_bytes // 2, **request)
    assert not little.is_exact
    assert little.memory_bytes <= plain.memory_bytes // 2
    with pytest.raises(ValueError, match=r"memory_bytes must be at least .* MiB") as refused:
        plan(lines, grid, memory_bytes=1 << 20, **request)
    (named,) = re.findall(r"at least ([\d.]+) MiB", str(refused.value))
    enough = int(float(named) * 2**20)
    assert plan(lines, grid, memory_bytes=enough, **request).memory_bytes <= enough
    with pytest.raises(ValueError, match="memory_bytes must be at least"):
        plan(lines, grid, memory_bytes=int(0.8 * enough), **request)


def test_too_little_memory_for_a_relief_is_refused():
    """Also where no root of the image is small enough for it."""
    plane = around(0, 40, shape=(64, 64))
    grid = plane.with_height(0.05 * np.random.default_rng(1).standard_normal(plane.shape))
    lines, _ = over(plane)
    with pytest.raises(ValueError, match=r"memory_bytes must be at least .* MiB"):
        plan(lines, grid, tolerance_db=-40, costs=EXACT_IS_SLOW, memory_bytes=1 << 18)


@pytest.mark.parametrize("kind", ["stages", "one place"])
def test_plain_backprojection_may_need_too_much_as_well(kind):
    grid = around(0, 40)
    lines, _ = over(grid, TRACK if kind == "stages" else 0 * TRACK)
    request = {"stages": []} if kind == "stages" else {"tolerance_db": -40}
    needed = plan(lines, grid, **request).memory_bytes
    assert plan(lines, grid, memory_bytes=needed, **request).is_exact
    with pytest.raises(ValueError, match="memory_bytes must be") as refused:
        plan(lines, grid, memory_bytes=needed // 2, **request)
    (named,) = re.findall(r"at least ([\d.]+) MiB", str(refused.value))
    assert needed / 2**20 <= float(named) < needed / 2**20 + 0.1


# Bad input


@pytest.fixture(scope="module")
def good():
    grid = around(0, 40, shape=(9, 8))
    lines, _ = over(grid, along_x(20, 0.01))
    return {"lines": lines, "grid": grid}


@pytest.mark.parametrize(
    "requests",
    [
        {},
        {"tolerance_db": -40, "tolerance_wavelengths": 0.1},
        {"tolerance_db": -40, "stages": []},
        {"tolerance_wavelengths": 0.1, "stages": [(2, 2)]},
        {"tolerance_db": -40, "tolerance_wavelengths": 0.1, "stages": [(2, 2)]},
    ],
)
def test_exactly_one_request_is_needed(good, requests):
    says = (
        "tolerance_db must be given, or one of `tolerance_wavelengths` and `stages`, and only one"
    )
    with pytest.raises(ValueError, match=says):
        plan(**good, **requests)


@pytest.mark.parametrize(
    ("argument", "value", "error", "says"),
    [
        ("tolerance_db", -85.1, ValueError, r"tolerance_db must be .*>= -85 .*got -85\.1"),
        ("tolerance_db", -9, ValueError, "tolerance_db must be .*<= -10 dB, got -9"),
        ("tolerance_db", 0.001, ValueError, r"tolerance_db must be .*dB, got 0\.001"),
        ("tolerance_db", np.nan, ValueError, "tolerance_db must be finite.*nan"),
        ("tolerance_db", -np.inf, ValueError, "tolerance_db must be finite.*inf"),
        ("tolerance_db", "-40", TypeError, "tolerance_db must be .*'-40'"),
        ("tolerance_db", True, TypeError, "tolerance_db must be .*True"),
        ("tolerance_db", [-40], TypeError, r"tolerance_db must be .*\[-40\]"),
        ("tolerance_wavelengths", 0, ValueError, "tolerance_wavelengths must be .*>= .*got 0"),
        (
            "tolerance_wavelengths",
            -0.1,
            ValueError,
            "tolerance_wavelengths must be .*>= .*got -0.1",
        ),
        ("tolerance_wavelengths", np.nan, ValueError, "tolerance_wavelengths must be finite"),
        ("tolerance_wavelengths", 10, ValueError, "tolerance_wavelengths must be .*got 10"),
        ("tolerance_wavelengths", 1e-9, ValueError, "tolerance_wavelengths must be .*got 1e-09"),
        ("tolerance_wavelengths", "x", TypeError, "tolerance_wavelengths must be .*'x'"),
        ("stages", [(0, 2)], ValueError, "QR of stages must be at least 1, got 0"),
        ("stages", [(2, -1)], ValueError, "QI of stages must be at least 1, got -1"),
        ("stages", [(21, 1)], ValueError, "stages must .* sum 21 of 20 lines"),
        ("stages", [(5, 1), (5, 1)], ValueError, "stages must .* sum 25 of 20 lines"),
        ("stages", [(1, 9)], ValueError, "stages must .* divide 9 x 8 pixels by 9"),
        ("stages", [(2.0, 2)], TypeError, r"QR of stages must be a whole number, got 2\.0"),
        ("stages", [(2, True)], TypeError, "QI of stages must be a whole number, got True"),
        ("stages", [(2, 2, 2)], TypeError, r"stages must be a sequence of \(QR, QI\)"),
        ("stages", (2, 2), TypeError, r"stages must be a sequence of \(QR, QI\)"),
        ("stages", "ab", TypeError, r"stages must be a sequence of \(QR, QI\)"),
        ("stages", 5, TypeError, r"stages must be a sequence of \(QR, QI\)"),
    ],
)
def test_bad_requests_are_named(good, argument, value, error, says):
    with pytest.raises(error, match=says):
        plan(**good, **{argument: value})


@pytest.mark.parametrize(
    ("argument", "value", "error", "says"),
    [
        ("lines", np.zeros((2, 3), complex), TypeError, "lines must be .*RangeLines.*ndarray"),
        ("grid", (5, 5), TypeError, "grid must be .*Grid.*tuple"),
        (
            "grid",
            Grid.plane((-1, 1, 10**6), (30, 31, 10**6)),
            ValueError,
            "grid must ask for at most .* GiB",
        ),
        ("beam", 20.0, TypeError, "beam must be .*BeamWindow.*float"),
        ("device", 1.5, TypeError, "device must be .*1.5"),
        ("costs", 5, TypeError, "costs must be .*Costs.*int"),
        ("memory_bytes", 0, ValueError, "memory_bytes must be at least 1, got 0"),
        ("memory_bytes", 1e9, TypeError, "memory_bytes must be a whole number"),
        ("taps", 6, TypeError, "taps must be two, in range and along the aperture, got 6"),
        ("taps", (6, 2), ValueError, "taps must be one of 4, 6, 8, got 2"),
        ("taps", (4.0, 6), TypeError, "every entry of taps must be a whole number"),
        ("depth", 6, ValueError, "depth must be at most 5, got 6"),
        ("depth", 2.5, TypeError, "depth must be a whole number"),
    ],
)
def test_bad_arguments_are_named(good, argument, value, error, says):
    with pytest.raises(error, match=says):
        plan(**(good | {argument: value}), tolerance_db=-40)


@pytest.mark.parametrize("study", [{"taps": (4, 4)}, {"depth": 2}])
def test_taps_and_depth_go_with_a_tolerance(good, study):
    says = "stages must be left out with `taps` or `depth`: `taps` and `depth` go with a tolerance"
    with pytest.raises(ValueError, match=says):
        plan(**good, stages=[(2, 2)], **study)


def test_stages_off_a_plane_are_refused(good):
    grid = Grid.points(good["grid"].positions_m())
    with pytest.raises(ValueError, match="grid must be a plane for `stages`"):
        plan(good["lines"], grid, stages=[(2, 2)])


def test_the_highest_frequency_leaves_out_as_little_as_is_allowed():
    """Of lines with a noise floor of -70 dB over all that is sampled, above the echoes' band."""
    lines, grid = made(straight)
    floor = np.random.default_rng(3).normal(size=(2, *lines.samples.shape))
    floor = (floor[0] + 1j * floor[1]) * np.abs(lines.samples).max() * 1e-4
    noisy = dataclasses.replace(lines, samples=lines.samples + floor)
    highest, bin_m = [], 1 / (256 * lines.range_step_m)
    for outside in (1e-6, 1e-9, 1e-11):
        model = sampled(noisy, grid, None, outside / OUTSIDE).sampled
        cycles_per_m, share = model.frequencies()
        assert share[cycles_per_m > model.highest_cycles_per_m + bin_m].sum() <= outside
        highest.append(model.highest_cycles_per_m)
    assert highest[2] > highest[0]


# Estimates


@pytest.mark.parametrize("tolerance_db", [-30, -60])
@pytest.mark.parametrize("case", ["plane", "beam", "exact"])
def test_predictions_are_sums_over_work_and_causes(case, tolerance_db):
    lines, grid = straight()[:2]
    beam = BEAMS[0] if case == "beam" else None
    costs = (
        Costs(upsampled_sample_ns=0.0, pixel_ns=0.0, part_ns=0.0)
        if case == "exact"
        else EXACT_IS_SLOW
    )
    chosen = plan(lines, grid, tolerance_db=tolerance_db, beam=beam, costs=costs)
    assert chosen.is_exact == (case == "exact")
    seconds = sum(
        1e-9 * getattr(costs, f"{name}_ns") * amount for name, amount in vars(chosen.work).items()
    )
    assert chosen.predicted_seconds == pytest.approx(seconds)
    causes = vars(chosen.errors)
    assert chosen.predicted_error_db == pytest.approx(10 * np.log10(sum(causes.values())))
    described = chosen.describe()
    for name, power in causes.items():
        line = f"\n{name.replace(chr(95), chr(32)):<16}"
        assert (line in described) == (power > 1e-3 * sum(causes.values())), name
    read = Plan.from_json(chosen.to_json())
    assert read.work == chosen.work
    assert read.errors == chosen.errors


def test_no_search_where_the_exact_image_is_formed_sooner(monkeypatch):
    def searched(*_):
        pytest.fail("a search takes longer than the exact image")

    monkeypatch.setattr(planner, "fastest_plan", searched)
    lines, grid = over(around(0, 40, shape=(40, 40)))
    assert plan(lines, grid, tolerance_db=-40, costs=Costs()).is_exact
    with pytest.raises(pytest.fail.Exception):  # but those who ask for a factorization get one
        plan(lines, grid, tolerance_db=-40, costs=Costs(), taps=(4, 4))


@pytest.mark.slow
def test_planning_with_a_beam_imports_nothing_slow():
    """scipy.signal takes longer to import than planning an image of any size."""
    code = """
import sys
import numpy as np
import clsas
from clsas.engine.factorized.costs import Costs
along = np.arange(200)[:, None] * [0.05, 0, 0]
lines = clsas.RangeLines(np.ones((200, 512), complex), 40.0, 0.02, along, along, 120e3, 1500.0)
grid = clsas.Grid.plane((0, 5, 256), (41, 46, 256))
costs = Costs(pixel_ns=1e3, point_ns=1e3)
clsas.plan(lines, grid, tolerance_db=-40, beam=clsas.BeamWindow(20.0), costs=costs)
sys.exit("scipy.signal" in sys.modules)
"""
    assert not subprocess.run([sys.executable, "-c", code], check=False).returncode


def test_scattered_points_and_reliefs_of_any_size_are_planned():
    """Neither fills whole subimages."""
    lines, grid = over(around(0, 40, shape=(51, 37)))
    positions_m = grid.positions_m().reshape(-1, 3)
    for other in (Grid.points(positions_m[::17]), grid.with_height(np.zeros(grid.shape))):
        assert plan(lines, other, tolerance_db=-40, costs=EXACT_IS_SLOW).predicted_error_db <= -40
