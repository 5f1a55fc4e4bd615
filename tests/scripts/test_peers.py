"""The comparison with other codes, without them."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from peers import codes, compare, focus, scenes, workers
from studies import focusing

import clsas
from clsas.selftest import cases, reference

SCRIPTS = Path(__file__).parents[2] / "scripts"

ECHO = """
import os
import sys
sys.path.insert(0, {folder!r})
from protocol import serve

def answer(image_file, **settings):
    if settings.get("fails"):
        raise ValueError("not this scene")
    print("chatter")
    if settings.get("counts"):
        return {{"cores": len(os.sched_getaffinity(0)), "threads": os.environ["OMP_NUM_THREADS"]}}
    return {{"file": image_file, **settings}}

serve(answer)
"""


@pytest.fixture
def program(tmp_path):
    """Return a program that answers requests without any code."""
    path = tmp_path / "echo.py"
    path.write_text(ECHO.format(folder=str(SCRIPTS / "peers")))
    return path


def over_channels(lines, points_m):
    """Return ranges from points to the transmitters of channels, [points, channels]."""
    return np.linalg.norm(points_m[:, None] - lines.tx_m, axis=-1)


@pytest.mark.parametrize(("track", "pixels"), [("straight", 32), ("circle", 24)])
def test_samples_over_frequency_give_the_ideal_image(track, pixels):
    """With the sum that codes for radar form, in float64."""
    scene = scenes.TRACKS[track](pixels)
    lines = scene.lines()
    given = scenes.as_history(lines)
    points_m = scene.grid.positions_m().reshape(-1, 3)[::31]
    range_m = over_channels(lines, points_m) - given["ref_m"]
    frequency_hz = given["first_hz"] + given["step_hz"] * np.arange(given["history"].shape[1])
    cycles = 2 * frequency_hz * range_m[..., None] / scenes.LIGHT_M_S
    found = np.einsum("pk,npk->n", given["history"], np.exp(2j * np.pi * cycles))
    found /= given["history"].shape[1]
    assert clsas.relative_error_db(found, reference.ideal(lines, points_m)) < -88


@pytest.mark.parametrize(("track", "pixels"), [("straight", 32), ("circle", 24)])
def test_lines_from_one_range_give_the_ideal_image(track, pixels):
    """With the sum that torchbp forms, of the trigonometric polynomials of lines, in float64."""
    scene = scenes.TRACKS[track](pixels)
    lines = scene.lines()
    given = scenes.as_profiles(lines)
    points_m = scene.grid.positions_m().reshape(-1, 3)[::31]
    range_m = over_channels(lines, points_m)
    count = given["profiles"].shape[1]
    spectrum = np.fft.fft(given["profiles"].astype(np.complex128), axis=1) / count
    at = (range_m - given["begin_m"]) / lines.range_step_m
    wave = scenes.waves(lines, count)
    phases = np.exp(2j * np.pi / count * wave * at[..., None])
    samples = np.einsum("pk,npk->np", spectrum[:, wave % count], phases)
    carrier = np.exp(4j * np.pi * given["centre_hz"] * range_m / scenes.LIGHT_M_S)
    found = (samples * carrier).sum(axis=1)
    assert clsas.relative_error_db(found, reference.ideal(lines, points_m)) < -88


def test_a_file_holds_the_scene_in_every_convention(tmp_path):
    scene = scenes.straight(32)
    lines = scene.lines()
    scenes.write(tmp_path / "scene.npz", scene, lines)
    given = np.load(tmp_path / "scene.npz")
    (columns, rows), (step_x, step_y) = given["pixels"], given["step_m"]
    x_m = given["corner_m"][0] + step_x * np.arange(columns)
    y_m = given["corner_m"][1] + step_y * np.arange(rows)
    np.testing.assert_allclose(x_m, scene.grid.axes_m[0], atol=1e-12)
    np.testing.assert_allclose(y_m, scene.grid.axes_m[1], atol=1e-12)
    # The band keeps its wavelengths, so frequencies are proportional to the speed of waves.
    wavelengths_m = scenes.LIGHT_M_S / given["band_hz"]
    np.testing.assert_allclose(wavelengths_m, 1500 / np.array([105e3, 135e3]))


def test_a_part_of_the_scene_keeps_its_spacings():
    whole, part = scenes.straight(2048), scenes.straight(512)
    assert (whole.channels, part.channels) == (2048, 512)
    for one, other in zip(whole.grid.vectors_m[1:], part.grid.vectors_m[1:], strict=True):
        np.testing.assert_allclose(one, other)


def test_the_helix_has_a_turn_for_every_pixel_along_a_side():
    whole = cases.FACTORIZED_CASES["ffbp-helix"].track()
    np.testing.assert_array_equal(scenes.spiral(150).track(), whole)
    part = scenes.spiral(30).track()
    assert len(part) == 30 * 360
    assert part[:, 2].mean() == pytest.approx(whole[:, 2].mean(), abs=1e-3)


@pytest.mark.parametrize("pixels", [128, 512])
def test_channels_of_the_circle_do_not_alias(pixels):
    """Phases of the farthest pixels change by at most half a cycle from channel to channel."""
    scene = scenes.circle(pixels)
    corners_m = focus.corners_m(scene.grid).reshape(-1, 3)
    range_m = np.linalg.norm(corners_m[:, None] - scene.track(), axis=-1)
    relative_m = range_m - np.linalg.norm(scene.track(), axis=-1)
    shortest_m = 1500 / (scene.carrier_hz + scene.bandwidth_hz / 2)
    cycles = 2 * np.abs(np.diff(relative_m, axis=1)) / shortest_m
    assert cycles.max() < 0.6


def test_errors_do_not_count_a_common_factor():
    ideal = np.array([1, 2j, -3])
    assert compare.error_db(2j * ideal, np.arange(3), ideal) < -120


def test_errors_are_relative_to_the_whole_image():
    """Whether the pixels that are compared are bright or dark."""
    image = np.array([100.0, 1, 1, 1], complex)
    chosen = np.array([1, 2, 3])
    wrong = image + [0, 0.1, -0.1, 0]
    expected = 20 * np.log10(np.sqrt(0.02 / 3) / np.sqrt((1e4 + 3) / 4))
    assert compare.error_db(wrong, chosen, image[chosen]) == pytest.approx(expected, abs=0.1)


def test_a_program_answers_with_what_it_found(program, tmp_path):
    with workers.worker(sys.executable, program, tmp_path / "none") as ask:
        assert ask(image_file="a", level=-50.0) == {"file": "a", "level": -50.0}
        assert ask(image_file="b") == {"file": "b"}


def test_a_refusal_tells_why_and_the_next_request_is_answered(program, tmp_path):
    with workers.worker(sys.executable, program, tmp_path / "none") as ask:
        assert ask(image_file="a", fails=True) == {"refused": "ValueError: not this scene"}
        assert ask(image_file="b") == {"file": "b"}


def test_a_program_has_as_many_cores_as_it_is_given(program, tmp_path):
    before = os.sched_getaffinity(0)
    with workers.worker(sys.executable, program, tmp_path / "none", 1) as ask:
        assert ask(image_file="a", counts=True) == {"cores": 1, "threads": "1"}
    assert os.sched_getaffinity(0) == before


def test_more_cores_than_there_are_are_refused(program, tmp_path):
    with (
        pytest.raises(workers.PeerError, match="4096 cores were requested, but only"),
        workers.worker(sys.executable, program, tmp_path / "none", 4096),
    ):
        pass


def test_a_program_that_fails_is_named(tmp_path):
    program = tmp_path / "broken.py"
    program.write_text("raise SystemExit(3)")
    with (
        workers.worker(sys.executable, program, tmp_path / "none") as ask,
        pytest.raises(workers.PeerError, match=r"broken\.py ended with exit code 3"),
    ):
        ask(image_file="a")


@pytest.mark.watches("scripts/peers")
def test_a_package_that_is_not_there_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("CLSAS_CACHE", str(tmp_path))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    with pytest.raises(workers.PeerError, match="code cannot be installed: ERROR"):
        workers.environment("code", ["no-such-package==1"])


def test_a_folder_without_torchbp_is_refused(tmp_path):
    with pytest.raises(workers.PeerError, match="is not a checkout of torchbp"):
        workers.built(tmp_path, codes.TORCH)


@pytest.mark.parametrize("kind", ["exact", "factorized"])
def test_every_code_has_settings_for_every_table(kind):
    found = [each for each in codes.methods(["pocl"]) if each.kind == kind]
    for code in ("clsas", "FastSAR", "torchbp"):
        assert sum(each.best for each in found if each.code == code) == 1


def test_rows_tell_what_was_measured_and_what_was_refused():
    method = codes.Method("code", "exact", "its settings", {})
    measured = compare.Measured(method, None, 1.5, [3.0, 1.0, 2.0], -51.25)
    assert compare.row(measured, 4_000_000_000) == [
        "exact", "code", "its settings", "2.000 (1.000 to 3.000)", "1.50", "2.00", "-51.2",
    ]  # fmt: skip
    refused = compare.Measured(method, None, refused="ValueError: no helix")
    assert compare.row(refused, 1)[3] == "refused: ValueError: no helix"


@pytest.mark.watches("scripts/peers")
def test_clsas_is_measured_by_its_own_program(platform):
    """Images of the program that is timed satisfy their requests, exact and factorized."""
    here = codes.Code(sys.executable, SCRIPTS / "peers" / "with_clsas.py")
    chosen = [each for each in codes.methods([platform.info.label]) if each.code == "clsas"]
    found = compare.measure(scenes.straight(64), {"clsas": here}, chosen, repeats=1)
    assert [one.method.kind for one in found] == ["exact", "exact", "factorized", "factorized"]
    for one in found:
        asked = one.method.settings.get("accuracy_db") or one.method.settings["tolerance_db"]
        assert one.error_db < asked
        assert len(one.seconds) == 1


@pytest.mark.parametrize("course_degrees", [0.0, 30.0])
def test_displacements_of_the_other_frame_move_lines_as_they_are(course_degrees):
    """A sway along x of that frame is a sway of the lines, whatever their course."""
    turn = np.radians(course_degrees)
    ahead, aside = [np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0]
    along_m = 0.1 * np.arange(-20, 21)[:, None]
    track_m = along_m * ahead + [3.0, 4.0, 2.0]
    middle_m = 10 * np.array(aside) + [3.0, 4.0, 0.0]
    grid = clsas.Grid.plane(
        (middle_m[0] - 1, middle_m[0] + 1, 3), (middle_m[1] - 1, middle_m[1] + 1, 3)
    )
    lines = clsas.RangeLines(np.ones((41, 8), complex), 9.0, 0.1, track_m, track_m, 1e5, 1500.0)
    frame = focus.Frame.of(lines, grid)
    seen_m = frame.of_points(track_m)
    np.testing.assert_allclose(seen_m[:, 0], 0, atol=1e-12)
    np.testing.assert_allclose(seen_m[:, 2], 2.0)
    sway_m = focusing.smooth_m(0.01, pings=41)
    moved = frame.moved(lines, np.stack([sway_m, 0 * sway_m, 0 * sway_m], axis=1))
    np.testing.assert_allclose(moved.tx_m - track_m, sway_m[:, None] * aside, atol=1e-12)


def test_a_polar_grid_holds_the_image():
    points_m = np.array([[[18.0, -2.5, 0], [18.0, 2.5, 0]], [[21.0, -2.5, 0], [21.0, 2.5, 0]]])
    grid = focus.polar_grid(points_m, 0.01, 1e-3)
    assert grid["r"] == (18.0, pytest.approx(np.hypot(21, 2.5)))
    assert grid["theta"] == (pytest.approx(-0.13757, abs=1e-4), pytest.approx(0.13757, abs=1e-4))
    assert (grid["nr"], grid["ntheta"]) == (315, 276)
