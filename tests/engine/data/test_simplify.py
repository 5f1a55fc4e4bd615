"""Effects are left out only if no pixel changes noticeably, and then they cost nothing."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cases import along_x, beside, lines_over
from exactly import execute, prepare

from clsas import factorize, plan
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import in_db, power
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.simplify import APART, MOTION, RELIEF, SHARE, leave_out, simplify
from clsas.engine.data.visibility import sines
from clsas.engine.factorized.plan import Plan
from clsas.engine.imaging import backproject
from clsas.selftest.reference import ideal

LEAST_PIXELS = 1 << 15
CHANNELS, CARRIER, STEP = 96, 300e3, 0.012
APERTURE = along_x(CHANNELS, 0.02)
FLAT = Grid.plane((-0.9, 0.9, 192), (20.0, 21.8, 192))
DEEP = Grid.plane((-0.9, 0.9, 192), (20.0, 21.8, 192), -8.0)
BUMPS = np.random.default_rng(1).uniform(-1, 1, (192, 192))
PIXELS = np.random.default_rng(0).permutation(FLAT.size)[:250]


@pytest.fixture(autouse=True)
def small_images_count(monkeypatch):
    """Simplify small images too, because larger ones take long to check."""
    monkeypatch.setattr("clsas.engine.data.simplify.LEAST_PIXELS", LEAST_PIXELS)


def lines_on(grid, tx, rx=None, **others):
    return lines_over(grid, tx, rx, carrier_hz=CARRIER, step_m=STEP, **others)


def apart():
    return lines_on(FLAT, APERTURE, beside(APERTURE, 0.03, 0.0, 0.01)), FLAT, None


def moving():
    return lines_on(FLAT, APERTURE, velocity=[[0.02, 0.005, 0]] * CHANNELS), FLAT, None


def moving_and_apart():
    """Return receivers so far from transmitters that only motion can be left out."""
    rx_m = beside(APERTURE, 0.6, 0.0, 0.2)
    return lines_on(FLAT, APERTURE, rx_m, velocity=[[0.004, 0, 0]] * CHANNELS), FLAT, None


def relief():
    grid = DEEP.with_height(2e-6 * BUMPS + np.linspace(0, 0.3, 192))
    return lines_on(grid, APERTURE), grid, None


def relief_of_points():
    grid = Grid.points(DEEP.positions_m() + 2e-6 * BUMPS[..., None] * [1, -0.5, 1])
    return lines_on(grid, APERTURE), grid, None


def everything():
    grid = DEEP.with_height(1e-6 * BUMPS)
    rx_m = beside(APERTURE, 0.02, 0.0, 0.0)
    return lines_on(grid, APERTURE, rx_m, velocity=[[0.005, 0, 0]] * CHANNELS), grid, None


def with_beam():
    tx_m = np.repeat(APERTURE[::4], 4, axis=0)  # pings of four receivers
    rx_m = beside(tx_m, 0, 0, 0) + np.tile(along_x(4, 0.02), (CHANNELS // 4, 1))
    return lines_on(FLAT, tx_m, rx_m), FLAT, BeamWindow(4.0, "hann", track_pings=5)


CASES = {
    apart: (APART,),
    moving: (MOTION,),
    moving_and_apart: (MOTION,),
    relief: (RELIEF,),
    relief_of_points: (RELIEF,),
    everything: (MOTION, APART, RELIEF),
    with_beam: (APART,),
}
ALL = pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)


@cache
def made(case):
    """Return lines, grid, beam, the simplest model, and the accuracy at which it begins, dB."""
    lines, grid, beam = case()
    model = simplify(lines, grid, beam, -0.1)
    assert model.left_out == CASES[case] or case is moving_and_apart
    if case is moving_and_apart:  # transmitters are merged too if any error is allowed
        model = next(
            m
            for db in np.arange(-1, -70, -1.0)
            if (m := simplify(lines, grid, beam, db)).left_out == (MOTION,)
        )
    return lines, grid, beam, model, in_db(model.error / SHARE)


@cache
def wanted(case):
    lines, grid, beam, *_ = made(case)
    return ideal(lines, grid.at(PIXELS), beam=beam)


def true_error_db(case, image):
    return relative_error_db(image.pixels.ravel()[PIXELS], wanted(case))


@ALL
def test_the_simpler_model_is_within_its_error_at_every_pixel(case):
    lines, grid, _, model, _ = made(case)
    positions_m = grid.positions_m().reshape(-1, 3)[::37]
    simple_m = model.grid.positions_m().reshape(-1, 3)[::37]
    each, other = (
        pairwise_range_m(at, of.tx_m, of.rx_m, of.rx_velocity_m_s, of.sound_speed_m_s)
        for at, of in ((positions_m, lines), (simple_m, model.lines))
    )
    highest = lines.carrier_cycles_per_m + 0.4 / STEP  # of the band
    phase = 2 * np.pi * highest * np.abs(each - other)
    if case is with_beam:
        return  # pixels beyond the beam may be anything
    assert phase.max() <= np.sqrt(model.error)
    assert phase.max() > 0.2 * np.sqrt(model.error)  # and the bound is of use


@ALL
def test_effects_are_left_out_up_to_their_share_of_the_error(case):
    lines, grid, beam, model, begins_db = made(case)
    split = 6.0206 if CASES[case] == (MOTION, APART, RELIEF) else 0.0  # of two amplitudes each
    assert simplify(lines, grid, beam, begins_db + split + 0.1).left_out == model.left_out
    kept = simplify(lines, grid, beam, begins_db - 0.1)
    assert kept.left_out != model.left_out
    assert kept.error <= SHARE * power(begins_db)


@pytest.mark.slow
@ALL
@pytest.mark.parametrize("beside_db", [7, -0.1])
def test_exact_images_keep_their_accuracy_on_either_side(case, beside_db, platform):
    lines, grid, beam, model, begins_db = made(case)
    accuracy_db = min(max(begins_db + beside_db, -85), -1)
    preparation = prepare(lines, grid, accuracy_db=accuracy_db, beam=beam, device=platform)
    if beside_db > 0:
        assert preparation.scene.left_out == model.left_out
        assert preparation.scene.left_out_error == pytest.approx(model.error)
    image = execute(preparation)
    assert image.grid is grid
    assert preparation.error_db <= accuracy_db + 1e-9
    assert true_error_db(case, image) <= accuracy_db + 0.3


@pytest.mark.slow
@ALL
@pytest.mark.parametrize("beside_db", [7, -0.1])
def test_factorized_images_keep_their_tolerance_on_either_side(case, beside_db, platform):
    lines, grid, beam, _model, begins_db = made(case)
    tolerance_db = min(max(begins_db + beside_db, -75), -10)
    chosen = plan(lines, grid, tolerance_db=tolerance_db, beam=beam, device=platform)
    assert chosen.left_out == simplify(lines, grid, beam, tolerance_db).left_out
    image = factorize(lines, grid, chosen, device=platform)
    assert image.grid is grid
    assert chosen.predicted_error_db <= tolerance_db + 1e-9
    assert true_error_db(case, image) <= tolerance_db


def test_plans_with_stages_leave_out_the_same(platform):
    """So do images with other samples, and with a plan that was read back from JSON."""
    lines, grid, _, model, begins_db = made(apart)
    chosen = plan(lines, grid, tolerance_db=-40, depth=1, device=platform)
    assert begins_db < -40
    assert not chosen.is_exact
    assert chosen.left_out == (APART,)
    assert "transmitter and receiver apart" in chosen.describe()
    first = factorize(lines, grid, chosen, device=platform)
    assert true_error_db(apart, first) <= -40
    assert np.array_equal(factorize(lines, grid, chosen, device=platform).pixels, first.pixels)
    read = Plan.from_json(chosen.to_json())
    assert read.left_out == chosen.left_out
    assert np.array_equal(factorize(lines, grid, read, device=platform).pixels, first.pixels)
    twice = factorize(replace(lines, samples=2 * lines.samples), grid, chosen, device=platform)
    assert relative_error_db(twice.pixels, 2 * first.pixels) < -55
    with pytest.raises(ValueError, match="lines must have the geometry"):
        factorize(model.lines, grid, chosen, device=platform)


def test_plans_of_full_models_leave_out_nothing():
    lines, grid, *_ = made(apart)
    chosen = plan(lines, grid, tolerance_db=-40, full_model=True)
    assert chosen.left_out == ()
    assert Plan.from_json(chosen.to_json()).left_out == ()
    with pytest.raises(ValueError, match="left_out must be some of"):
        replace(chosen, left_out=("gravity",))


def test_the_error_of_what_is_left_out_is_predicted():
    lines, grid, _beam, model, begins_db = made(moving)
    with_it, without = (
        prepare(lines, grid, accuracy_db=begins_db + 1, full_model=full) for full in (True, False)
    )
    of_filter = power(without.interpolator.error_db)
    assert without.error_db == pytest.approx(in_db(of_filter + model.error))
    assert with_it.scene.left_out == ()
    assert with_it.scene.lines is lines


def test_an_image_without_the_effect_has_nothing_to_model():
    """Kernel options and uploads then know neither velocities nor a second antenna."""
    lines, grid, *_, begins_db = made(everything)
    preparation = prepare(lines, grid, accuracy_db=min(begins_db + 7, -1))
    assert preparation.scene.lines.rx_velocity_m_s is None
    assert np.array_equal(preparation.scene.lines.tx_m, preparation.scene.lines.rx_m)
    assert preparation.scene.grid.is_planar
    assert preparation.scene.given_grid is grid
    assert np.shares_memory(preparation.scene.lines.samples, lines.samples)


@pytest.mark.parametrize(
    ("lines", "grid"),
    [
        (lines_on(FLAT, APERTURE), FLAT),
        (lines_on(FLAT, APERTURE), Grid.points(FLAT.positions_m().reshape(-1, 3))),
    ],
    ids=["plane", "points"],
)
def test_lines_with_no_such_effect_are_taken_as_they_are(lines, grid):
    model = simplify(lines, grid, None, -10)
    assert model.lines is lines
    assert model.grid is grid
    assert model.error == 0
    assert not model.left_out


def test_a_fixed_interpolator_takes_the_full_model():
    lines, grid, *_ = made(apart)
    assert prepare(lines, grid, taps=4, upsampling=2).scene.left_out == ()


def test_small_images_are_not_worth_a_fit():
    lines, *_ = made(apart)
    side = int(LEAST_PIXELS**0.5) - 1
    small = Grid.plane((-0.9, 0.9, side), (20.0, 21.8, side))
    assert simplify(lines, small, None, -20).left_out == ()


def test_pixels_next_to_an_antenna_keep_both():
    """Near an antenna, range is nonlinear between the points at which it is compared."""
    grid = Grid.plane((-0.9, 0.9, 192), (0.05, 1.0, 192))
    lines = lines_on(grid, APERTURE, beside(APERTURE, 1e-4, 0, 0))
    assert simplify(lines, grid, None, -10).left_out == ()


def test_one_rock_on_a_plane_is_relief():
    """The rock may be the only reflector, however few its pixels are."""
    height_m = np.zeros((192, 192))
    height_m[101, 77] = 0.05
    lines = lines_on(DEEP, APERTURE)
    assert simplify(lines, DEEP.with_height(height_m), None, -20).left_out == ()
    assert simplify(lines, DEEP.with_height(0 * height_m), None, -75).left_out == (RELIEF,)


def test_one_channel_apart_keeps_all():
    rx_m = APERTURE.copy()
    rx_m[41] += [0.5, 0, 0]
    assert simplify(lines_on(FLAT, APERTURE, rx_m), FLAT, None, -20).left_out == ()
    one_moves = np.zeros((CHANNELS, 3))
    one_moves[41] = [5, 0, 0]
    assert simplify(lines_on(FLAT, APERTURE, velocity=one_moves), FLAT, None, -20).left_out == ()


def test_points_that_coincide_are_no_plane():
    grid = Grid.points(np.tile([0.0, 20.0, 0.0], (192, 192, 1)))
    assert simplify(lines_on(grid, APERTURE), grid, None, -20).left_out == ()


def test_a_beam_looks_where_the_given_antennas_do():
    """Fitted antennas no longer show pings, from which the track's direction follows."""
    lines, _grid, beam, model, _ = made(with_beam)
    assert np.allclose(model.beam.along, beam.directions(lines))
    assert not np.allclose(beam.directions(model.lines), beam.directions(lines), atol=1e-9)


def test_steps_of_a_beam_are_not_moved():
    """Shifting the edges of a rectangular beam would add or drop channels."""
    lines, grid, beam, _, _begins_db = made(with_beam)
    rx_m = beside(lines.rx_m, 0.0, 0.0, 0.0)
    moving_lines = replace(lines, rx_m=rx_m, rx_velocity_m_s=np.tile([0.5, 0, 0], (CHANNELS, 1)))
    smooth, steps = (
        simplify(moving_lines, grid, replace(beam, shape=shape), -15).error
        for shape in ("hann", "rectangular")
    )
    assert not steps or steps > smooth


def test_leaving_out_by_name_is_what_was_decided():
    for case in CASES:
        lines, grid, beam, model, _ = made(case)
        again = leave_out(lines, grid, beam, model.left_out)
        assert np.array_equal(again.lines.tx_m, model.lines.tx_m)
        assert np.array_equal(again.lines.rx_m, model.lines.rx_m)
        assert np.array_equal(again.grid.positions_m(), model.grid.positions_m())


def test_images_in_pieces_still_add_up(platform):
    lines, grid, *_ = made(apart)
    half = slice(0, CHANNELS // 2), slice(CHANNELS // 2, None)
    total = None
    for part in half:
        total = backproject(
            lines.select(part), grid, accuracy_db=-30, accumulate=total, device=platform
        )
    assert true_error_db(apart, total) <= -30


def random_survey(seed):
    """Return random antennas, motion, a beam, and a grid of any kind, up to kilometres wide."""
    random = np.random.default_rng(seed)

    def magnitude(least, most):
        return 10 ** random.uniform(least, most)

    count, extent_m = int(random.integers(2, 120)), magnitude(-1, 1.5)
    away_m = extent_m * magnitude(-0.7, 1.5)
    tx_m = np.zeros((count, 3))
    tx_m[:, 0] = np.sort(random.uniform(-extent_m / 2, extent_m / 2, count))
    if random.random() < 0.2:
        turn = np.linspace(0, random.uniform(0.5, 6), count)
        tx_m = extent_m * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=-1)
    tx_m += random.normal(size=(count, 3)) * extent_m * magnitude(-5, -1)
    each = random.random() < 0.3
    rx_m = tx_m + random.normal(size=(count, 3) if each else 3) * extent_m * magnitude(-6, -0.5)
    rx_m = tx_m if random.random() < 0.15 else rx_m
    velocity = None
    if random.random() < 0.6:
        velocity = random.normal(size=3) * magnitude(-5, 1)
        velocity = velocity + random.normal(size=(count, 3)) * magnitude(-6, -1)
    sides_m = away_m * 10 ** random.uniform(-2.5, 0.2, 2)
    columns, rows = (-sides_m[0] / 2, sides_m[0] / 2, 50), (away_m, away_m + sides_m[1], 60)
    grid = Grid.plane(columns, rows, -away_m * random.uniform(0, 0.7))
    if random.random() < 0.5:
        axes = np.linalg.qr(random.normal(size=(3, 3)))[0]
        steps_m = axes[0] * sides_m[0] / 60, axes[1] * sides_m[1] / 50
        grid = Grid.oriented(2 * away_m * axes[2], *steps_m, (60, 50))
    if random.random() < 0.4:
        slope_m = np.linspace(0, sides_m[1] * random.uniform(-0.3, 0.3), 60)
        bumps_m = random.normal(size=(60, 50)) * away_m * magnitude(-9, -3)
        grid = grid.with_height(slope_m[:, None] + bumps_m)
    elif random.random() < 0.2:
        bumps_m = random.normal(size=(60, 50, 3)) * away_m * magnitude(-9, -4)
        grid = Grid.points(grid.positions_m() + bumps_m)
    wave_m = away_m * magnitude(-4.5, -1.5)
    carrier_hz = 1500 / wave_m if random.random() < 0.9 else 0.0
    samples = np.zeros((count, 4), np.complex64)
    lines = RangeLines(
        samples, away_m, wave_m * random.uniform(0.4, 5), tx_m, rx_m, carrier_hz, 1500.0, velocity
    )
    beam = None
    if random.random() < 0.3:
        shape = random.choice(["hann", "rectangular", "tukey"])
        beam = BeamWindow(random.uniform(1, 60), str(shape), along=[1, 0, 0])
    return lines, grid, beam, random.uniform(-85, -10)


@pytest.mark.exhaustive
def test_no_geometry_leaves_out_more_than_is_allowed(monkeypatch):
    """Check all pixels and their visible channels in unusual random surveys."""
    monkeypatch.setattr("clsas.engine.data.simplify.LEAST_PIXELS", 1000)
    left_out = set()
    for seed in range(150):
        lines, grid, beam, allowed_db = random_survey(seed)
        model = simplify(lines, grid, beam, allowed_db)
        left_out.add(model.left_out)
        range_m, simple_m = (
            pairwise_range_m(
                on.positions_m().reshape(-1, 3), of.tx_m, of.rx_m, of.rx_velocity_m_s, 1500.0
            )
            for of, on in ((lines, grid), (model.lines, model.grid))
        )
        seen = np.ones(range_m.shape, bool)
        if beam is not None:
            points_m = grid.positions_m().reshape(-1, 3)
            sine = sines(points_m, lines.phase_centres_m, beam.directions(lines)).T
            seen = (sine > beam.limits[0]) & (sine < beam.limits[1])
        highest = lines.carrier_cycles_per_m + 0.5 / lines.range_step_m
        off_m = np.abs(range_m - simple_m).max(where=seen, initial=0)
        assert (2 * np.pi * highest * off_m) ** 2 <= SHARE * power(allowed_db), seed
    assert len(left_out) >= 7  # every way, and none
