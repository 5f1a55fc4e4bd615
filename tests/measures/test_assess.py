"""Assessed errors of leaving out effects agree with images formed without them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from cases import along_x, beside, lines_over
from click.testing import CliRunner
from scipy.optimize import minimize_scalar

import clsas
from clsas import SoundSpeed
from clsas.cli import main
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.simplify import APART, MOTION, RELIEF
from clsas.engine.data.system import line_array
from clsas.engine.water.ray_delays import at_speed
from clsas.engine.water.refraction import homogeneous
from clsas.files import scene_files as config
from clsas.measures.assess import (
    BEAM,
    ENDS,
    KEYS,
    PATTERN,
    REFRACTION,
    SINGLE,
    SWAY,
    assess,
    survey_lines,
    track_errors_m,
)
from clsas.selftest.reference import ideal

CHANNELS, CARRIER, STEP = 96, 300e3, 0.012
APERTURE = along_x(CHANNELS, 0.02)
GRID = Grid.plane((-0.9, 0.9, 64), (20.0, 21.8, 64), -3.0)
PIXELS = np.random.default_rng(0).permutation(GRID.size)[:300]
DEVICE = None


def lines_on(grid, tx, rx=None, **others):
    return lines_over(grid, tx, rx, carrier_hz=CARRIER, step_m=STEP, **others)


def measured_db(lines, other, grid=GRID, on=None, beam=None, without=None):
    """Return the error of other lines, pixels or weights, from float64 images."""
    full = ideal(lines, grid.at(PIXELS), beam=beam)
    return relative_error_db(ideal(other, (on or grid).at(PIXELS), beam=without), full)


@pytest.mark.parametrize("speed_m_s", [0.01, 0.1, 1.0])
def test_motion_during_flight(speed_m_s):
    lines = lines_on(GRID, APERTURE, velocity=[[speed_m_s, 0.0, 0.0]] * CHANNELS)
    found = assess(lines, GRID)[MOTION]
    assert found.modelled
    assert found.error_db == pytest.approx(
        measured_db(lines, replace(lines, rx_velocity_m_s=None)), abs=1.0
    )
    assert found.range_wavelengths < found.most_wavelengths


@pytest.mark.parametrize("apart_m", [0.01, 0.05, 0.2])
def test_transmitter_and_receiver_apart(apart_m):
    lines = lines_on(GRID, APERTURE, beside(APERTURE, apart_m, 0, 0))
    middle_m = lines.phase_centres_m
    found = assess(lines, GRID)[APART]
    wanted_db = measured_db(lines, replace(lines, tx_m=middle_m, rx_m=middle_m))
    assert found.modelled
    assert found.error_db == pytest.approx(wanted_db, abs=1.0)
    # b^2/8R at broadside, in wavelengths of the two-way path
    assert found.most_wavelengths == pytest.approx(
        apart_m**2 / (8 * 20.2) / (1500 / CARRIER) * 2, rel=0.1
    )


@pytest.mark.parametrize("relief_m", [1e-5, 1e-4, 1e-3])
def test_relief(relief_m):
    heights_m = relief_m * np.random.default_rng(2).normal(size=GRID.shape)
    grid = GRID.with_height(heights_m)
    lines = lines_on(grid, APERTURE)
    found = assess(lines, grid)[RELIEF]
    assert found.modelled
    assert found.error_db == pytest.approx(measured_db(lines, lines, grid, GRID), abs=2.0)


@pytest.mark.parametrize("sway_m", [1e-5, 1e-4, 5e-3])
def test_sway_beyond_a_straight_track(sway_m):
    off_m = sway_m * np.sin(np.arange(CHANNELS) / 7.0)
    tx_m = APERTURE + np.stack([0 * off_m, off_m, off_m], axis=-1)
    lines = lines_on(GRID, tx_m)
    straight_m = tx_m - track_errors_m(lines)
    found = assess(lines, GRID)[SWAY]
    wanted_db = measured_db(lines, replace(lines, tx_m=straight_m, rx_m=straight_m))
    assert found.modelled
    assert found.error_db == pytest.approx(wanted_db, abs=1.0)


def test_beam_window():
    lines = lines_on(GRID, APERTURE)
    beam = BeamWindow(6.0, "hann")
    found = assess(lines, GRID, beam=beam)[BEAM]
    assert found.modelled
    assert found.error_db == pytest.approx(measured_db(lines, lines, beam=beam), abs=1.0)
    assert assess(lines, GRID)[BEAM].error_db is None


def test_an_array_is_no_sway():
    """Receivers beside the track are no error if they are the same in all pings; a yaw differs."""
    sonar = replace(
        clsas.Sonar.edgetech(), rx_m=[[0.2, 0, 0.1], [0, 0, -0.1], [-0.2, 0, 0.1]], tx_m=[0, 0, 0.4]
    )
    course = dict(start_m=(-3, 0, 9), velocity_m_s=(1, 0.3, 0), pings=20, ping_interval_s=0.3)
    for yaw_rad, least, most in ((0.0, 0.0, 1e-12), (0.1 * np.sin(np.arange(20)), 0.005, 0.05)):
        track = clsas.Track.straight(**course, yaw_rad=yaw_rad)
        tx_m, rx_m, _ = clsas.channels(sonar, track)
        off_m = track_errors_m(lines_on(GRID, tx_m, rx_m))
        assert least <= np.abs(off_m).max() <= most


@pytest.mark.slow
def test_element_patterns_are_those_of_the_simulator():
    """Images of points all over the grid, with and without patterns."""
    sonar = clsas.Sonar(
        clsas.Pulse(CARRIER, 40e3, 1e-3),
        line_array(4, 0.04),
        tx_length_m=0.02,
        rx_length_m=0.03,
    )
    track = clsas.Track.straight((-0.9, 0, 0), (1, 0, 0), 24, 0.08)
    random = np.random.default_rng(3)
    grid = Grid.plane((-1.5, 1.5, 64), (10.0, 12.0, 64))
    places = np.stack(
        [random.uniform(-1.5, 1.5, 400), random.uniform(10, 12, 400), np.zeros(400)], -1
    )
    points = clsas.PointTargets(places, random.normal(size=400) + 1j * random.normal(size=400))
    with_it, without = (
        clsas.compress(clsas.simulate(sonar, track, points, element_pattern=on))
        for on in (True, False)
    )
    found = assess(with_it, grid, sonar=sonar, track=track)[PATTERN]
    pixels = random.permutation(grid.size)[:500]
    wanted = ideal(with_it, grid.at(pixels))
    error_db = relative_error_db(ideal(without, grid.at(pixels)), wanted)
    assert found.modelled
    assert found.error_db == pytest.approx(error_db, abs=2.0)
    missing = assess(without, grid, sonar=sonar, track=track, element_pattern=False)
    assert PATTERN in missing.missing
    assert MOTION in missing.missing or missing[MOTION].needed is False


def test_needed_effects_depend_on_the_tolerance():
    lines = lines_on(GRID, APERTURE, velocity=[[0.01, 0.0, 0.0]] * CHANNELS)
    error_db = assess(lines, GRID)[MOTION].error_db
    for beyond_db, needed in ((12.5, True), (13.5, False)):  # a twentieth is 13 dB
        found = assess(lines, GRID, tolerance_db=error_db + beyond_db)
        assert found[MOTION].needed is needed
        assert (MOTION in found.spare) is not needed


def test_absent_effects_have_no_error():
    found = assess(lines_on(GRID, APERTURE), GRID)
    for name in (APART, RELIEF, SWAY):
        assert not found[name].modelled
        assert found[name].error_db < -250
        assert found[name].needed is False
    assert found[MOTION].error_db is None  # the speed is not known
    assert found[MOTION].needed is None
    assert found[ENDS].error_db < -80  # these lines fade
    assert found.spare == () or found.spare == (ENDS,)
    assert [effect.name for effect in found.effects] == list(KEYS)


@pytest.mark.slow
def test_imagers_leave_out_the_effects_of_the_table():
    grid = Grid.plane((-0.9, 0.9, 512), (20.0, 21.8, 512))
    lines = lines_on(grid, APERTURE, beside(APERTURE, 0.01, 0, 0))
    found = assess(lines, grid, tolerance_db=-40, repeats=1)
    assert found[APART].left_out
    assert found.measured
    assert (found[SINGLE].seconds is None) == (
        not clsas.plan(lines, grid, tolerance_db=-40).half_precision
    )
    assert found.simple_seconds > 0
    assert "measured" in found.describe()
    assert clsas.plan(lines, grid, tolerance_db=-40).left_out == (APART,)


@pytest.mark.slow
def test_half_precision_is_assessed(platform):
    grid = Grid.plane((-0.9, 0.9, 512), (20.0, 21.8, 512))
    lines = lines_on(grid, APERTURE.repeat(4, axis=0) + along_x(4 * CHANNELS, 0.005))
    for tolerance_db in (-40, -70):
        chosen = clsas.plan(lines, grid, tolerance_db=tolerance_db, device=platform)
        found = assess(lines, grid, tolerance_db=tolerance_db, device=platform)[SINGLE]
        if chosen.is_exact or not platform.info.half_precision:
            assert found.needed is None
        else:
            assert found.needed is not chosen.half_precision
            assert -76 < found.error_db < -60


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        ({"lines": 1}, TypeError, "lines must be"),
        ({"grid": 1}, TypeError, "grid must be"),
        ({"beam": 20.0}, TypeError, "beam must be"),
        ({"tolerance_db": -90}, ValueError, "tolerance_db must be .*>= -85"),
        ({"repeats": -1}, ValueError, "repeats must be at least 0"),
        ({"sonar": 1}, TypeError, "sonar must be"),
        (
            {
                "sonar": clsas.Sonar.edgetech(),
                "track": clsas.Track.straight((0, 0, 0), (1, 0, 0), 3, 1.0),
            },
            ValueError,
            "must have the channels of the lines, 96, got 6 receivers and 3 pings",
        ),
    ],
)
def test_wrong_arguments_are_named(change, error, says):
    given = {"lines": lines_on(GRID, APERTURE), "grid": GRID} | change
    with pytest.raises(error, match=says):
        assess(**given)


@pytest.mark.slow
def test_lines_of_a_survey_have_its_geometry_and_band():
    scene = config.parse_scene(config.built_in_scene("thesis_wide_beam"), name="", folder=None)
    lines = survey_lines(scene.sonar, scene.track, scene.grid, motion_in_flight=True)
    tx_m, rx_m, velocity = clsas.channels(scene.sonar, scene.track, motion_in_flight=True)
    assert np.array_equal(lines.tx_m, tx_m)
    assert np.array_equal(lines.rx_m, rx_m)
    assert np.array_equal(lines.rx_velocity_m_s, velocity)
    together = survey_lines(scene.sonar, scene.track, scene.grid, phase_centres=True)
    assert np.allclose(together.tx_m, (tx_m + rx_m) / 2)
    assert together.tx_m is together.rx_m or np.array_equal(together.tx_m, together.rx_m)


SCENE = """
[sonar]
receivers = 4
spacing_m = 0.04
tx_length_m = 0.02
rx_length_m = 0.02
[sonar.pulse]
carrier_hz = 300e3
bandwidth_hz = 40e3
duration_s = 1e-3
[track]
start_m = [-0.9, 0.0, 0.0]
velocity_m_s = [1.0, 0.0, 0.0]
pings = 24
ping_interval_s = 0.08
[track.sway]
amplitude_m = 0.001
period_s = 1.0
[[targets]]
position_m = [0.0, 10.5, 0.0]
[simulate]
SIMULATE
[grid]
x = { start_m = -0.2, stop_m = 0.2, count = 64 }
y = { start_m = 10.4, stop_m = 10.6, count = 64 }
[image]
tolerance_db = -30
"""


def run(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def table(*arguments):
    result = run("assess", *arguments, "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    return found, {effect["name"]: effect for effect in found["effects"]}


@pytest.fixture
def scene(tmp_path):
    def write(simulate="", name="scene.toml", changes=None):
        text = SCENE.replace("SIMULATE", simulate)
        for old, new in (changes or {}).items():
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


@pytest.mark.slow
def test_a_scene_is_assessed_before_it_is_simulated(scene):
    found, effects = table(scene())
    assert found["tolerance_db"] == -30
    assert set(effects) == set(KEYS)
    assert not effects[MOTION]["modelled"]
    assert effects[MOTION]["error_db"] is not None
    assert effects[PATTERN]["modelled"]
    assert effects[SWAY]["modelled"]
    assert effects[ENDS]["error_db"] is None
    text = run("assess", scene()).stdout
    assert "4096" not in text
    assert "64 x 64 pixels from 96 channels, tolerance -30 dB, wavelength 5 mm" in text
    for name in KEYS:
        assert name in text


@pytest.mark.slow
def test_effects_that_a_scene_may_leave_out_have_their_key(scene):
    """Without them, the image of the scene stays within the tolerance."""
    slow = {
        "[1.0, 0": "[0.01, 0",
        "interval_s = 0.08": "interval_s = 8.0",
        "period_s = 1.0": "period_s = 60.0",
        "length_m = 0.02": "length_m = 1e-3",
    }
    full = "motion_in_flight = true\nelement_pattern = true"
    found, effects = table(scene(full, changes=slow), "--tolerance-db", "-10")
    keys = {
        MOTION: "motion_in_flight = false",
        PATTERN: "element_pattern = false",
        APART: "phase_centres = true",
    }
    spare = {name: key for name, key in keys.items() if name in found["spare"]}
    assert set(spare) == {MOTION, PATTERN}
    for name, key in spare.items():
        assert effects[name]["key"] == f"[simulate] {key}"
        assert key in run("assess", scene(full, changes=slow), "--tolerance-db", "-10").stdout
    given = {"motion_in_flight": "true", "element_pattern": "true"}
    given |= dict(key.split(" = ") for key in spare.values())
    images = []
    for name, table_ in (
        ("full", full),
        ("less", "\n".join(f"{k} = {v}" for k, v in given.items())),
    ):
        described = config.read_scene(scene(table_, f"{name}.toml", slow))
        echoes = clsas.simulate(
            described.sonar, described.track, described.targets, **described.simulate
        )
        images.append(clsas.backproject(clsas.compress(echoes), described.grid))
    assert relative_error_db(images[1].pixels, images[0].pixels) < -10


@pytest.mark.slow
def test_lines_are_assessed_with_the_scene_that_made_them(scene, tmp_path):
    path, echoes, lines = scene(), tmp_path / "echoes.h5", tmp_path / "lines.h5"
    assert run("simulate", path, "-o", echoes).exit_code == 0
    assert run("compress", echoes, "-o", lines).exit_code == 0
    found, effects = table(lines, "--scene", path)
    of_scene = table(path)[1]
    for name in (MOTION, APART, SWAY, PATTERN):
        assert effects[name]["error_db"] == pytest.approx(of_scene[name]["error_db"], abs=1.5)
    assert effects[ENDS]["error_db"] is not None
    # Without the scene, patterns and velocities are not known.
    bare = table(lines, "--x", "-0.2:0.2:64", "--y", "10.4:10.6:64")[1]
    assert bare[PATTERN]["error_db"] is None
    assert bare[MOTION]["error_db"] is None
    assert found["channels"] == 96


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--stages", "2x2"], "--stages implies no tolerance"),
        (["--scene", "SCENE"], "--scene requires LINES.H5"),
        (["--repeats", "-1"], "--repeats"),
    ],
)
def test_wrong_usage(scene, arguments, says):
    path = scene()
    result = run("assess", path, *(str(path) if a == "SCENE" else a for a in arguments))
    assert result.exit_code == 2
    assert says in result.output


def test_a_scene_without_a_survey_is_refused(tmp_path):
    path = tmp_path / "grid.toml"
    path.write_text(SCENE[SCENE.index("[grid]") :])
    result = run("assess", path)
    assert result.exit_code == 1
    assert "missing table [sonar]" in result.output


def test_every_key_is_one_of_scene_files():
    """Scene files accept the keys of the table."""
    for name, key in KEYS.items():
        if " = " in key:
            table_, setting = key.split("] ")
            described = config.parse_scene(f"{table_}]\n{setting}".encode(), name=name, folder=None)
            assert described.simulate


@pytest.mark.parametrize(("gradient", "needed"), [(0.05, False), (0.5, True)])
def test_refraction(gradient, needed):
    """The error is that of straight rays with the speed that fits them best."""
    profile = SoundSpeed([0, 40], [1500 - gradient, 1500 + 39 * gradient], surface_z_m=1.0)
    lines = replace(lines_on(GRID, APERTURE), sound_speed=profile)
    found = assess(lines, GRID, tolerance_db=-40)
    effect = found[REFRACTION]
    assert effect.modelled
    mean_m_s = profile.mean_m_s(0, -3)
    least = minimize_scalar(
        lambda speed_m_s: 10 ** (measured_db(lines, at_speed(lines, speed_m_s)) / 10),
        bounds=(mean_m_s - 0.02, mean_m_s + 0.02), method="bounded", options={"xatol": 1e-7},
    )  # fmt: skip
    assert effect.error_db == pytest.approx(10 * np.log10(least.fun), abs=1.0)
    assert effect.seconds > 0
    assert effect.most_wavelengths >= effect.range_wavelengths
    assert (effect.needed, effect.left_out) == (needed, False)
    assert REFRACTION in found.describe()


def test_a_level_grid_stays_level_where_ranges_are_corrected():
    """Imagers take its pixels as points then, which must not look like relief."""
    tx = np.repeat(along_x(15, 0.4, z=-10), 8, axis=0)
    rx = tx + np.tile(along_x(8, 0.17) + [0.7, 0, 0], (15, 1))
    grid = Grid.plane((-1, 1, 40), (57, 61, 40), -22)
    lines = lines_over(grid, tx, rx, carrier_hz=100e3, step_m=0.02, velocity=[1.8, 0, 0])
    profile = SoundSpeed([0, 14, 17, 60], [1505, 1505, 1495, 1495.5])
    lines = replace(lines, sound_speed=profile)
    assert homogeneous(lines, grid, None, None).corrections is not None
    assert not assess(lines, grid)[RELIEF].modelled


def test_lines_without_a_profile_have_no_refraction():
    effect = assess(lines_on(GRID, APERTURE), GRID)[REFRACTION]
    assert (effect.modelled, effect.error_db, effect.seconds) == (False, None, None)
