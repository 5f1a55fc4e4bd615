import builtins
import dataclasses
import json
import os
import pty
import re
import shlex
import shutil
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
import pytest
from click.shell_completion import ShellComplete
from click.testing import CliRunner
from interrupt import interrupted

import clsas
from clsas import cli
from clsas.cli import images
from clsas.engine.data import validate
from clsas.engine.device.device import choose
from clsas.engine.factorized import measured_costs as costs
from clsas.engine.factorized.measured_costs import Scale
from clsas.files.scene_files import built_in_scene, read_scene
from clsas.measures.resolution import expected_resolution_m
from clsas.selftest import cases, demo

pytest.importorskip("matplotlib")

ROOT = Path(__file__).parents[2]
TOUR = (ROOT / "docs" / "tour.md").read_text()
EXAMPLE, *_ = re.findall(
    r"```toml\n(.*?)```", (ROOT / "docs" / "scene-files.md").read_text(), re.DOTALL
)
SMALL = cases.Case(48, 8.25e-3, 1e6, 100e3, (-0.2, 0.2), (40.0, 40.4), 64)


def run(*args, code=0):
    """Run a command; return standard output and standard error."""
    result = CliRunner().invoke(cli.main, [str(arg) for arg in args], prog_name="clsas")
    assert result.exit_code == code, (result.output, result.exception)
    return result.stdout, result.stderr


def run_json(*args):
    stdout, stderr = run(*args, "--json")
    assert stderr == ""  # neither warnings nor, off a terminal, progress
    return json.loads(stdout)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with the documented scene and what the commands make of it, and their results."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "scene.toml").write_text(EXAMPLE)
    scene, echoes, lines, image = (
        folder / name for name in ("scene.toml", "echoes.h5", "lines.h5", "image.h5")
    )
    results = [
        run_json("simulate", scene, "-o", echoes, "--picture", folder / "geometry.png"),
        run_json(
            "compress", echoes, "--scene", scene, "-o", lines, "--picture", folder / "lines.png"
        ),
        run_json("image", lines, "--scene", scene, "-o", image, "--picture", folder / "image.png"),
        run_json("quality", image, "--near", "0,20", "--picture", folder / "cuts.png"),
    ]
    return folder, results


@pytest.mark.slow
def test_commands_do_what_the_library_does(made):
    folder, _ = made
    scene = read_scene(folder / "scene.toml")
    echoes = clsas.simulate(scene.sonar, scene.track, scene.targets, **scene.simulate)
    np.testing.assert_array_equal(clsas.load(folder / "echoes.h5").samples, echoes.samples)
    lines = clsas.compress(echoes, window="hamming")
    np.testing.assert_array_equal(clsas.load(folder / "lines.h5").samples, lines.samples)
    image = clsas.backproject(lines, scene.grid, accuracy_db=-60)
    assert clsas.relative_error_db(clsas.load(folder / "image.h5"), image) < -100
    for name in ("geometry", "lines", "image", "cuts"):
        assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_results_in_json(made):
    folder, (simulated, compressed, imaged, measured) = made
    assert simulated["file"] == str(folder / "echoes.h5")
    assert simulated["channels"] == compressed["channels"] == imaged["channels"] == 320
    assert compressed["range_step_m"] == pytest.approx(1500 / (4 * 60e3))
    assert imaged["shape"] == [201, 201]
    assert imaged["predicted_error_db"] < -60
    assert all(result["seconds"] > 0 for result in (simulated, compressed, imaged))
    point = measured["point"]
    # The documented scene has noise, sway and yaw, and sound that takes its time.
    assert (point["x_m"], point["y_m"]) == pytest.approx((0, 20), abs=1e-3)
    assert "offset_m" not in point["range"]
    scene = read_scene(folder / "scene.toml")
    azimuth_m, _ = expected_resolution_m(scene.sonar, scene.track, np.array([0, 20.0, 0]))
    assert point["azimuth"]["resolution_m"] == pytest.approx(azimuth_m, rel=0.02)
    # Hamming's 1.3 c/2B, and a little more along the ground.
    assert point["range"]["resolution_m"] == pytest.approx(1.3 * 0.0125, rel=0.1)


@pytest.mark.parametrize(
    ("spent", "words"),
    [
        (
            (2.0, 0.5, 0.25, None),
            "2.00 s (0.50 s of that to build kernels, which the driver keeps), planned in 0.25 s",
        ),
        (
            (2.0, 0.5, None, 0.06),
            "2.00 s (0.50 s of that to build kernels, which the driver keeps, and 0.06 s to "
            "measure its error)",
        ),
        ((2.0, 0.1, None, 0.06), "2.00 s (0.06 s of that to measure its error)"),
        ((2.0, 0.1, None, None), "2.00 s"),
        ((0.0, 0.0, None, None), "0.00 s"),
    ],
)
def test_time_that_goes_into_kernels_and_certificates_is_reported(spent, words):
    assert images._duration(*spent) == words


@pytest.mark.slow
def test_results_as_text(made, tmp_path):
    folder, _ = made
    stdout, _ = run("simulate", folder / "scene.toml", "-o", tmp_path / "echoes.h5")
    assert stdout.startswith(f"{tmp_path / 'echoes.h5'}: 320 channels of ")
    stdout, _ = run("compress", folder / "echoes.h5", "-o", tmp_path / "lines.h5")
    assert "320 lines of " in stdout
    assert "6.25 mm apart" in stdout
    grid = ("--x", "-0.1:0.1:11", "--y", "19.9:20.1:21")
    stdout, _ = run("image", folder / "lines.h5", *grid, "-o", tmp_path / "image.h5")
    assert "21 x 11 pixels from 320 lines" in stdout
    stdout, _ = run("quality", folder / "image.h5", "--near", "0,20")
    assert re.search(r"^point at x = -?0\.000\d\d m, y = (19\.999|20\.000)", stdout, re.MULTILINE)
    assert stdout.count("PSLR nearest") == 2


@pytest.mark.slow
def test_options_go_before_the_scene_file(made, tmp_path):
    folder, _ = made
    scene = ("--scene", folder / "scene.toml")
    lines = tmp_path / "lines.h5"
    result = run_json("compress", folder / "echoes.h5", *scene, "--oversampling", 4, "-o", lines)
    assert result["range_step_m"] == pytest.approx(1500 / (8 * 60e3))
    grid = ("--x", "-1:1:5", "--y", "20:21:6", "--z", "0.5")
    image = tmp_path / "image.h5"
    result = run_json("image", lines, *scene, *grid, "--taps", 8, "--upsampling", 2, "-o", image)
    assert result["shape"] == [6, 5]
    assert "8 taps" in result["how"]
    positions = clsas.load(image).grid.positions_m()
    np.testing.assert_allclose(positions[[0, -1], [0, -1]], [[-1, 20, 0.5], [1, 21, 0.5]])


def image_of(made, tmp_path, *args):
    """What `clsas image` says, and the image, on the documented scene's grid."""
    described = read_scene(made[0] / "scene.toml").grid.axes_m
    x, y = (f"{axis[0]}:{axis[-1]}:{len(axis)}" for axis in described)
    output = tmp_path / "image.h5"
    result = run_json("image", made[0] / "lines.h5", "--x", x, "--y", y, *args, "-o", output)
    return result, clsas.load(output)


@pytest.mark.slow
def test_the_dial(made, tmp_path):
    """Images to a tolerance, in wavelengths, in the thesis's stages and exactly."""
    exact = clsas.load(made[0] / "image.h5")
    for args, worst_db in (
        ([], -48),
        (["--tolerance-db", -30], -28),
        (["--tolerance-wavelengths", "1/40"], -13),
        (["--tolerance-wavelengths", "0.001"], -41),
    ):
        result, image = image_of(made, tmp_path, *args)
        assert clsas.relative_error_db(image, exact) < worst_db, args
        assert result["method"] in ("exact", "factorized")
        assert result["plan_seconds"] > 0
    result, image = image_of(made, tmp_path, "--stages", "2x4,2X4")
    assert result["method"] == "stages"
    assert result["predicted_seconds"] > 0
    lines = clsas.load(made[0] / "lines.h5")
    plan = clsas.plan(lines, exact.grid, stages=[(2, 4), (2, 4)])
    assert result["predicted_error_db"] == pytest.approx(plan.predicted_error_db)
    by_library = clsas.factorize(lines, exact.grid, plan)
    assert clsas.relative_error_db(image, by_library) < -100
    for args in (["--exact"], ["--accuracy-db", -60], ["--exact", "--accuracy-db", -60]):
        result, image = image_of(made, tmp_path, *args)
        assert (result["method"], "plan_seconds" in result) == ("exact", False)
        assert clsas.relative_error_db(image, exact) < -100


def test_mending_options_are_called_by_their_names(made, tmp_path):
    convert = "convert", made[0] / "lines.h5", tmp_path / "mended.h5"
    _, stderr = run(*convert, "--taper-m", "1000", code=1)
    assert "Error: --taper-m must be finite and > 0 and <=" in stderr
    lines = clsas.load(made[0] / "lines.h5")
    still = tmp_path / "still.h5"
    clsas.save(still, replace(lines, tx_m=lines.tx_m[0], rx_m=lines.rx_m[0]))
    _, stderr = run("convert", still, tmp_path / "mended.h5", "--without-still-pings", code=1)
    assert f"of {lines.channels} pings ({lines.channels} lines) only the first" in stderr
    assert not (tmp_path / "mended.h5").exists()


def test_bands_are_equalized_by_option_and_by_scene(made, tmp_path):
    folder, output = made[0], tmp_path / "lines.h5"
    expected = clsas.compress(clsas.load(folder / "echoes.h5"), equalize=True)
    run("compress", folder / "echoes.h5", "--equalize", "-o", output)
    np.testing.assert_allclose(clsas.load(output).samples, expected.samples, rtol=1e-6)
    scene = tmp_path / "equal.toml"
    scene.write_text("[compress]\nequalize = true\n")
    run("compress", folder / "echoes.h5", "--scene", scene, "-o", output)
    np.testing.assert_allclose(clsas.load(output).samples, expected.samples, rtol=1e-6)


def test_a_survey_that_is_equalized_is_assessed(made, tmp_path):
    text, scene = (made[0] / "scene.toml").read_text(), tmp_path / "equal.toml"
    assert "[compress]" in text
    scene.write_text(text.replace("[compress]", "[compress]\nequalize = true"))
    assert "needed" in run_json("assess", scene)


def test_density_is_compensated_on_the_way(made, tmp_path):
    """The last of 16 receivers repeats the phase centre of the first one, a ping before."""
    lines = clsas.load(made[0] / "lines.h5")
    weights = clsas.density_weights(lines).reshape(-1, 16)[1:-1]
    assert weights[:, [0, -1]] == pytest.approx(weights[0, 1] / 2, rel=5e-3)
    convert = "convert", made[0] / "lines.h5", tmp_path / "even.h5", "--compensate-density"
    text, _ = run(*convert)
    assert "the weights raise the noise by 0.13 dB" in text
    even = clsas.load(tmp_path / "even.h5")
    np.testing.assert_array_equal(even.samples, clsas.density_compensated(lines).samples)
    assert run_json(*convert)["noise_penalty_db"] == pytest.approx(0.13, abs=0.005)
    clsas.save(tmp_path / "one.h5", lines.select([0]))
    _, stderr = run("convert", tmp_path / "one.h5", *convert[2:], code=1)
    assert "Error: FILE must come from receivers that move along a track" in stderr


def test_a_plan_that_is_exact_is_as_accurate_as_asked_for(made, tmp_path):
    few = ("--x", "-0.02:0.02:3", "--y", "19.9:20.1:4", "--tolerance-db", -70)
    output = tmp_path / "image.h5"
    result = run_json("image", made[0] / "lines.h5", *few, "-o", output)
    assert result["method"] == "exact"
    assert result["predicted_error_db"] < -70
    assert 0 <= result["build_seconds"] < result["seconds"]
    text, _ = run("image", made[0] / "lines.h5", *few, "-o", output)
    assert "planned in " in text
    assert "(exact: nothing faster within -70 dB; " in text


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::clsas.ClsasWarning")
@pytest.mark.parametrize("method", [(), ("--exact",)], ids=["planned", "exact"])
def test_an_image_of_zeros_has_no_predicted_error(made, tmp_path, method):
    nowhere = ["--x", "0:1:4", "--y", "900:901:4", "-o", tmp_path / "zero.h5", "--allow-unreached"]
    command = ["image", made[0] / "lines.h5", *nowhere, *method]
    stdout, _ = run(*command)
    assert "all pixels are zero" in stdout
    assert "predicted error" not in stdout
    results = json.loads(run(*command, "--json")[0])
    assert results["is_zero"]
    assert results["predicted_error_db"] is None


@pytest.mark.slow
@pytest.mark.parametrize("method", [("--tolerance-db", -40), ("--exact",)])
def test_a_grid_on_the_wrong_side_is_a_warning_with_the_options_meant(made, tmp_path, method):
    folder, _ = made
    image, axes = ("image", folder / "lines.h5", "-o", tmp_path / "image.h5"), ("--x=-1:1:21",)
    _, warning = run(*image, *axes, "--y=-20.5:-19.5:21", *method)
    assert warning.count("the whole grid lies to starboard of the track") == 1
    (meant,) = re.findall(r"Use the mirrored grid,\s+(--x=\S+\s+--y=\S+)", warning)
    assert meant.split() == ["--x=-1:1:21", "--y=19.5:20.5:21"]
    assert run(*image, *meant.split(), *method)[1] == ""


@pytest.mark.slow
def test_stages_that_leave_no_image_are_a_warning(made, tmp_path):
    scene = ("--scene", made[0] / "scene.toml")
    for command in (("image", "-o", tmp_path / "image.h5"), ("plan",)):
        args = (command[0], made[0] / "lines.h5", *scene, *command[1:])
        _, stderr = run(*args, "--stages", "16x2")
        assert re.fullmatch(
            r"Warning: with these stages the error .* -?\d+ dB, too large.*\n", stderr
        )
        assert run(*args, "--stages", "2x16")[1] == ""


@pytest.mark.slow
def test_an_element_for_the_inverse_beam(made, tmp_path):
    """Options make the window that the library makes of them."""
    exact = clsas.load(made[0] / "image.h5")
    shape = ("--beam-deg", 5, "--beam-shape", "inverse", "--element-length-m", 0.03)
    _, image = image_of(made, tmp_path, "--exact", *shape)
    beam = clsas.BeamWindow(5.0, "inverse", element_length_m=0.03)
    expected = clsas.backproject(clsas.load(made[0] / "lines.h5"), exact.grid, beam=beam)
    assert clsas.relative_error_db(image, expected) < -100


@pytest.mark.slow
def test_a_beam_from_the_command_line(made, tmp_path):
    exact = clsas.load(made[0] / "image.h5")
    lines = clsas.load(made[0] / "lines.h5")
    beam = clsas.BeamWindow(5.0, "hann", squint_deg=1.0)
    options = ("--beam-deg", 5, "--beam-shape", "hann", "--squint-deg", 1)
    _, image = image_of(made, tmp_path, "--exact", *options)
    expected = clsas.backproject(lines, exact.grid, beam=beam)
    assert clsas.relative_error_db(image, expected) < -100
    _, image = image_of(made, tmp_path, "--tolerance-db", -40, *options)
    assert clsas.relative_error_db(image, expected) < -38


@pytest.mark.slow
def test_dial_and_beam_of_a_scene_file(made, tmp_path):
    """The scene's are used, and give way to options."""
    grid = EXAMPLE[EXAMPLE.index("[grid]") : EXAMPLE.index("[image]")]
    scene = tmp_path / "scene.toml"
    scene.write_text(f"{grid}[image]\nstages = [[2, 2]]\nbeam = {{ width_deg = 5.0 }}\n")
    image = "image", made[0] / "lines.h5", "--scene", scene, "-o", tmp_path / "image.h5"
    assert run_json(*image)["method"] == "stages"
    result = run_json(*image, "--exact", "--squint-deg", 1)
    assert result["method"] == "exact"
    lines, formed = clsas.load(made[0] / "lines.h5"), clsas.load(tmp_path / "image.h5")
    beam = clsas.BeamWindow(5.0, squint_deg=1.0)
    expected = clsas.backproject(lines, formed.grid, beam=beam)
    assert clsas.relative_error_db(formed, expected) < -100
    assert run("plan", *image[1:4])[0].startswith("Plan: stages as given")
    assert run("plan", *image[1:4], "--tolerance-db", -30)[0].startswith("Plan: tolerance -30 dB")


def test_plan(made):
    lines, scene = made[0] / "lines.h5", made[0] / "scene.toml"
    # The scene asks for an exact image.
    assert run("plan", lines, "--scene", scene)[0].startswith("Plan: tolerance -50 dB; predicted")
    args = "plan", lines, "--scene", scene, "--stages", "2x2"
    text, stderr = run(*args, "--json", "--filters")
    assert stderr == ""
    plan = clsas.Plan.from_json(text)
    assert plan.describe() + "\n" == run(*args)[0]
    assert plan.factorization.aperture.factors == (2,)
    short = run_json(*args)
    assert "coefficients" not in json.dumps(short)
    assert short["method"]["align"]["taps"] == 2
    assert short["prediction"]["error_db"] == plan.predicted_error_db
    assert "--filters requires --json" in run(*args, "--filters", code=2)[1]
    assert not (made[0] / "plan.json").exists()


@pytest.mark.slow
def test_tradeoff(made, tmp_path):
    table, png = tmp_path / "t.csv", tmp_path / "t.png"
    ways = ("--tolerance-db", -30, "--stages", "2x2,2x2", "--repeats", 1)
    grid = ("--x", "-0.3:0.3:64", "--y", "19.7:20.3:64")
    args = ("tradeoff", made[0] / "lines.h5", *grid, *ways)
    result = run_json(*args, "--csv", table, "--picture", png)
    assert [row["label"] for row in result["rows"]] == ["-30 dB", "2 of 2x2", "exact"]
    assert result["rows"][0]["error_db"] < -28
    assert (result["channels"], result["pixels"]) == (320, [64, 64])
    assert table.read_text().count("\n") == 4
    assert png.read_bytes().startswith(b"\x89PNG")
    text, _ = run(*args)
    assert text.startswith("320 lines, 64 x 64 pixels on ")
    assert "2 of 2x2" in text


def test_tradeoff_of_a_built_in_case(monkeypatch):
    beam = clsas.BeamWindow(1.0)
    monkeypatch.setattr(cases, "FACTORIZED_CASES", {"small": dataclasses.replace(SMALL, beam=beam)})
    seen = []

    def measured(lines, grid, **options):
        seen.append((lines.channels, grid.shape, options))
        return clsas.Tradeoff("abacus", "1.0", 48, grid.shape, 3, ())

    monkeypatch.setattr(clsas, "tradeoff", measured)
    run("tradeoff", "--case", "small")
    run("tradeoff", "--case", "small", "--beam-shape", "hann")
    assert [(channels, shape) for channels, shape, _ in seen] == [(48, (64, 64))] * 2
    options = seen[0][2]
    assert options["beam"].width_deg == 1.0
    assert not {"stages", "repeats"} & options.keys()
    assert (seen[1][2]["beam"].width_deg, seen[1][2]["beam"].shape) == (1.0, "hann")


def test_costs_are_measured_again(monkeypatch, tmp_path):
    """The device in use, and no other, even if its costs are known."""
    monkeypatch.setenv("CLSAS_CACHE", str(tmp_path))
    measured = []

    def measure(device):
        measured.append(device.info.index)
        return Scale(*(2.0 for _ in dataclasses.fields(Scale)))

    monkeypatch.setattr("clsas.engine.factorized.measured_costs.measure", measure)
    assert {each["source"] for each in run_json("devices")["costs"].values()} == {"default"}
    assert not measured
    result = run_json("devices", "--measure")
    used = result["used"]
    assert measured == [used]
    assert result["costs"][str(used)]["source"] == "scaled"
    known = costs.load(clsas.list_devices()[used])
    assert known.costs.pixel_ns == pytest.approx(2 * costs.defaults(choose()[0]).pixel_ns)


def test_an_image_tells_its_kernels_times(made, tmp_path):
    folder, _ = made
    image = "image", folder / "lines.h5", "--scene", folder / "scene.toml", "-o", tmp_path / "i.h5"
    kernels = run_json(*image, "--profile")["kernels"]
    for times in kernels.values():
        assert 0 < times["minimum_s"] <= times["median_s"] <= times["maximum_s"] <= times["total_s"]
    assert "backproject_tiles" in kernels
    assert re.search(r"backproject_tiles: \d+ runs? of .* ms, median", run(*image, "--profile")[0])
    assert run_json(*image)["kernels"] == {}


def test_an_image_against_itself_has_no_finite_error(made):
    image = made[0] / "image.h5"
    assert run_json("quality", image, "--reference", image)["relative_error_db"] is None
    assert "-inf dB" in run("quality", image, "--reference", image)[0]


def test_devices(monkeypatch):
    infos = clsas.list_devices()
    result = run_json("devices")
    assert [device["name"] for device in result["devices"]] == [info.name for info in infos]
    assert {each["source"] for each in result["costs"].values()} == {"scaled"}
    assert result["costs_file"] == str(costs.path())
    text, _ = run("devices")
    costs_of = r"^   costs: defaults, scaled by a short measurement on \d{4}-\d\d-\d\d \(today\)$"
    assert re.search(costs_of, text, re.MULTILINE)
    assert f"Costs are stored in {costs.path()}" in text
    assert all(info.label in text and info.driver in text for info in infos)
    assert f"Used: {result['used']} ({result['reason']})" in text
    last = infos[-1].index
    monkeypatch.setenv("CLSAS_DEVICE", str(last))
    assert run_json("devices")["used"] == last
    assert "CLSAS_DEVICE" in run("devices")[0]
    monkeypatch.setenv("CLSAS_DEVICE", "abacus")
    assert (
        "Error: No device matches 'abacus', which was requested by CLSAS_DEVICE"
        in run("devices", code=1)[1]
    )


def test_without_a_device_the_message_says_how_to_get_one(made, tmp_path, monkeypatch):
    monkeypatch.setattr("clsas.engine.device.device.list_devices", list)
    _, stderr = run("devices", code=1)
    assert stderr.startswith("Error: No OpenCL device was found.")
    assert "pip install" in stderr
    scene, lines = (made[0] / name for name in ("scene.toml", "lines.h5"))
    run("image", lines, "--scene", scene, "-o", tmp_path / "image.h5", code=1)
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_a_broken_sampling_limit_is_a_warning(made, tmp_path):
    sparse = tmp_path / "sparse.toml"
    sparse.write_text(EXAMPLE.replace("spacing_m = 0.02", "spacing_m = 0.04"))
    _, stderr = run("simulate", sparse, "-o", tmp_path / "echoes.h5")
    assert re.fullmatch(
        r"Warning: phase centres are up to 20 mm apart .* grating lobes .*\. See clsas limits .*\n",
        stderr,
    )
    lines = made[0] / "lines.h5"
    image = "image", lines, "--scene", sparse, "-o", tmp_path / "image.h5"
    assert run(*image)[1] == ""  # that of the scene's own grid was told when it was simulated
    _, stderr = run(*image, *GRID)
    assert stderr.startswith("Warning: phase centres are up to 20 mm")


@pytest.mark.slow
def test_limits_of_a_scene(tmp_path):
    scene = tmp_path / "scene.toml"
    scene.write_bytes(built_in_scene("thesis_wide_beam"))
    text, stderr = run("limits", scene)
    assert stderr == ""
    assert "distance per ping          0.528 m    at most 0.528 m   yes" in text
    result = run_json("limits", scene)
    assert result["exceeded"] == ["phase_centre_spacing_m", "doppler_bandwidth_hz"]
    assert result["missing"] == {}
    spacing = result["results"]["phase_centre_spacing_m"]
    assert spacing["value"] == pytest.approx(8.25e-3)
    del spacing["value"]
    assert spacing == {
        "unit": "m", "limit": 7.5e-3, "side": "most", "kept": False, "equation": "[27], [29]"
    }  # fmt: skip


def test_limits_of_scenes_with_missing_and_wrong_parts(tmp_path):
    scene = tmp_path / "scene.toml"
    scene.write_text('[sonar]\npreset = "edgetech"\n')
    text, _ = run("limits", scene)
    assert "range (c/2B)" in text
    assert "distance per ping, overlap of pings, speed" in text
    scene.write_text(EXAMPLE[EXAMPLE.index("[grid]") : EXAMPLE.index("[image]")])
    assert "missing table [sonar]" in run("limits", scene, code=1)[1]
    scene.write_text(EXAMPLE.replace("ping_interval_s", "ping_intervals"))
    assert "ping_intervals" in run("limits", scene, code=1)[1]


@pytest.mark.slow
@pytest.mark.parametrize("method", [(), ("--exact",), ("--stages", "2x2")])
def test_a_grid_that_no_line_reaches_is_refused_unless_it_is_allowed(made, tmp_path, method):
    grid, path = ("--x", "0:1:4", "--y", "20000:21000:4"), tmp_path / "image.h5"
    command = ("image", made[0] / "lines.h5", *grid, *method, "-o", path)
    _, stderr = run(*command, code=1)
    assert stderr.startswith("Error: no pixel of the grid lies within any line's range")
    assert "the grid lies at 19999.6 to 21000.5 m" in stderr
    assert "would be reached if it were in mm" in stderr
    assert stderr.endswith("To form it anyway, use --allow-unreached\n")
    assert stderr.count("\n") == 1
    assert not path.exists()
    _, stderr = run(*command, "--allow-unreached")
    assert stderr.startswith("Warning: ")
    assert stderr.count("so the image is zero") == 1
    assert not clsas.load(path).pixels.any()


def test_a_plan_for_a_grid_that_no_line_reaches_is_a_warning(made):
    grid = ("--x", "0:1:4", "--y", "500:501:4")
    assert "so the image is zero" in run("plan", made[0] / "lines.h5", *grid)[1]


@pytest.mark.parametrize(
    ("option", "name", "words"),
    [
        ("--picture", "x.tif", "must end in .png or .pdf or .svg, got 'x.tif'"),
        ("-o", "x.tif", "must end in .h5 or .hdf5 or .he5, got 'x.tif'"),
    ],
)
def test_a_file_is_written_as_its_name_says_or_not_at_all(
    made, tmp_path, monkeypatch, option, name, words
):
    monkeypatch.chdir(tmp_path)
    options = {"-o": "new.h5", option: name}
    given = [part for pair in options.items() for part in pair]
    assert words in run("image", made[0] / "lines.h5", *GRID, *given, code=2)[1]
    assert os.listdir() == []


GRID = ["--x", "0:1:4", "--y", "19:20:4"]
FIXED = ["--taps", "4", "--upsampling", "2"]


@pytest.mark.parametrize(
    ("args", "code", "message"),
    [
        (["image", "echoes.h5", *GRID, "-o", "new.h5"], 1, "must hold range lines (clsas compress"),
        (
            ["compress", "image.h5", "-o", "new.h5"],
            1,
            "image.h5 must hold echoes (clsas simulate makes them), got an image",
        ),
        (
            ["quality", "image.h5", "--reference", "scene.toml"],
            1,
            "scene.toml is of none of the formats",
        ),
        (["quality", "scene.toml"], 2, "IMAGE.H5 is missing, scene.toml is a scene: clsas quality"),
        (
            ["image", "scene.toml"],
            2,
            "scene.toml is a scene: clsas image LINES.H5 -o OUTPUT.H5 --scene scene.toml",
        ),
        (
            ["image", "lines.h5", "--x", "0:1:1", *GRID[2:], "-o", "new.h5"],
            2,
            "'--x': must start and stop at one position for 1 pixel, got 0.0 m to 1.0 m",
        ),
        (["simulate", "lines.h5", "-o", "new.h5"], 1, "lines.h5: an HDF5 file, not a scene file"),
        (["simulate", "typo.toml", "-o", "new.h5"], 1, "in [grid]: did you mean 'z_m'?"),
        (["simulate", "grid.toml", "-o", "new.h5"], 1, "grid.toml: missing table [sonar]"),
        (["compress", "echoes.h5", "-o", "new.h5", "--window", "bay"], 2, "bay"),
        (["compress", "echoes.h5", "-o", "new.h5", "--oversampling", "0.5"], 2, "oversampling"),
        (
            ["image", "lines.h5", *GRID, "-o", "new.h5", "--taps", "3"],
            2,
            "'--taps': must be one of",
        ),
        (
            ["image", "lines.h5", *GRID, "-o", "new.h5", "--accuracy-db", "3"],
            2,
            "'--accuracy-db': must",
        ),
        (
            ["image", "lines.h5", *GRID, "-o", "new.h5", "--upsampling", "0"],
            2,
            "'--upsampling': must",
        ),
        (["image", "lines.h5", *GRID, "-o", "new.h5", "--device", "abacus"], 1, "'abacus'"),
        (["image", "lines.h5", "--x", "0:1:0", *GRID[2:], "-o", "new.h5"], 2, "START:STOP:N"),
        (["image", "lines.h5", "--x", "0:nan:9", *GRID[2:], "-o", "new.h5"], 2, "START:STOP:N"),
        (["plan", "lines.h5", *GRID, "--z", "inf"], 2, "'--z': must be finite m, got inf"),
        (["quality", "image.h5", "--near", "9,9"], 1, "near must be inside the image"),
        (["quality", "image.h5", "--near", "0,20", "--search-m", "-1"], 2, "'--search-m': must be"),
        (["simulate", "none.toml", "-o", "new.h5"], 2, "'none.toml' does not exist"),
        (["simulate", "scene.toml"], 2, "Missing option '-o'"),
        (["simulate", "scene.toml", "-o", "no/new.h5"], 2, "there is no folder 'no'"),
        (["simulate", "scene.toml", "-o", "/proc/new.h5"], 2, "'/proc/new.h5' cannot be written: "),
        (["simulate", "scene.toml", "-o", "n" * 300], 2, "cannot be written: File name too long"),
        (["simulate", "scene.toml", "-o", "-"], 2, "must be a path; '-' for standard input or"),
        (["image", "-", *GRID, "-o", "new.h5"], 2, "must be a path; '-'"),
        (["show", "image.h5", "-o", "new.png", "--db", "1e300"], 2, "'--db': must be"),
        (["simulate", "scene.toml", "-o", "/dev/null"], 2, "'/dev/null' is not an ordinary file"),
        (["simulate", "scene.toml", "-o", "new", "--picture", "./new"], 2, "must be two files"),
        (["compress", "echoes.h5", "--picture", "new", "-o", "new"], 2, "must be two files"),
        (
            [
                "image",
                "lines.h5",
                *GRID,
                "-o",
                "new.h5",
                "--picture",
                "a",
                "--dynamic-range-db",
                "-5",
            ],
            2,
            "'--db': must be finite and > 0 and <= 2000 dB, got -5",
        ),
        (
            ["image", "lines.h5", "--x", "0:1:1000000", "--y", "0:1:1000000", "-o", "new.h5"],
            1,
            "--x and --y must ask for at most ",
        ),
        (
            ["image", "lines.h5", "--x", "0:1:9", "--y", f"0:1:{10**30}", "-o", "new.h5"],
            2,
            "'--y': count must be at most ",
        ),
        (
            ["image", "lines.h5", *GRID, "-o", "new.h5", *FIXED, "--accuracy-db", "-60"],
            2,
            "--accuracy-db has no effect",
        ),
        (
            ["image", "lines.h5", *GRID, "-o", "new.h5", "--tolerance-db", "-30", "--exact"],
            2,
            "give only one of --tolerance-db, --tolerance-wavelengths, --stages and --exact",
        ),
        (
            ["plan", "lines.h5", *GRID, "--tolerance-db", "-30", "--stages", "2x2"],
            2,
            "give only one of --tolerance-db, --tolerance-wavelengths and --stages",
        ),
        (
            ["image", "lines.h5", *GRID, "-o", "new.h5", "--stages", "2x2", "--taps", "4"],
            2,
            "--taps and --upsampling are for exact images and cannot be combined with --stages",
        ),
        (["plan", "lines.h5", *GRID, "--stages", "2x2,2"], 2, "'2x2,2' must be QRxQI for every"),
        (["plan", "lines.h5", *GRID, "--stages", "1x9"], 1, "stages must leave a line and a pixel"),
        (["plan", "lines.h5", *GRID, "--tolerance-wavelengths", "1/0"], 2, "a fraction such as"),
        (
            ["plan", "lines.h5", *GRID, "--tolerance-db", "-100"],
            2,
            "'--tolerance-db': must be finite",
        ),
        (["plan", "lines.h5", *GRID, "--tolerance-db", "nan"], 2, "and <= -10 dB, got nan"),
        (["tradeoff", "lines.h5", *GRID, "--tolerance-db", "-9"], 2, "dB, got -9"),
        (["plan", "lines.h5", *GRID, "--tolerance-wavelengths", "9"], 2, "wavelengths, got 9"),
        (["plan", "lines.h5", *GRID, "--tolerance-wavelengths", "1e999999999"], 2, "got inf"),
        (["plan", "lines.h5", *GRID, "--stages", "2x0"], 2, "'2x0' must be QRxQI for every"),
        (["plan", "lines.h5", *GRID, "--squint-deg", "3"], 2, "require --beam-deg"),
        (["plan", "lines.h5", *GRID, "--element-length-m", "1"], 2, "require --beam-deg"),
        (["plan", "lines.h5", *GRID, "--track-pings", "9"], 2, "require --beam-deg"),
        (["plan", "lines.h5", *GRID, "--beam-deg", "9", "--track-pings", "1"], 2, "at least 5"),
        (
            ["plan", "lines.h5", *GRID, "--beam-deg", "9", "--element-length-m", "1"],
            2,
            "--element-length-m requires --beam-shape inverse, got rectangular",
        ),
        (
            ["plan", "lines.h5", *GRID, "--beam-deg", "9", "--beam-shape", "inverse"],
            2,
            "--element-length-m must be given for --beam-shape inverse",
        ),
        (["plan", "lines.h5", *GRID, "--beam-deg", "-3"], 2, "'--beam-deg': must be finite"),
        (["plan", "lines.h5"], 2, "no grid given: use --scene, or --x and --y"),
        (["tradeoff", *GRID], 2, "give either LINES.H5 or --case"),
        (
            ["tradeoff", "lines.h5", "--case", "bp-thesis"],
            2,
            "--case has its own lines: leave out LINES.H5",
        ),
        (["tradeoff", "--case", "bp-nothing"], 2, "'bp-nothing' is not one of bp-thesis, "),
        (["tradeoff", "--case", "bp-thesis", *GRID], 2, "--case has its own grid"),
        (
            ["tradeoff", "lines.h5", *GRID, "--csv", "new", "--picture", "new"],
            2,
            "must be two files",
        ),
        (["image", "lines.h5", "-o", "new.h5"], 2, "no grid given: use --scene, or --x and --y"),
        (["image", "lines.h5", *GRID[:2], "-o", "new.h5"], 2, "--x and --y must be given together"),
        (["image", "lines.h5", "--x", "0:1", *GRID[2:], "-o", "new.h5"], 2, "START:STOP:N"),
        (["quality", "image.h5", "--near", "0"], 2, "must be X,Y or X,Y,Z in metres"),
        (["quality", "image.h5", "--picture", "new.png"], 2, "require --near"),
        (["bench", "bp-nothing"], 2, "'bp-nothing' is not one of bp-thesis, "),
        (["imagine"], 2, "No such command 'imagine'. Did you mean 'image'?"),
        (["image", "lines.h5", *GRID, "--tolerence-db", "-40"], 2, "'--tolerance-db'"),
        (["--trace", "devices"], 2, "Did you mean '--traceback'?"),
    ],
)
def test_errors_are_one_message_and_leave_nothing(made, monkeypatch, args, code, message):
    folder, _ = made
    monkeypatch.chdir(folder)
    grid = EXAMPLE[EXAMPLE.index("[grid]") : EXAMPLE.index("[image]")]
    Path("grid.toml").write_text(grid)
    Path("typo.toml").write_text(f"{grid}z = 3")
    before = set(folder.iterdir())
    stdout, stderr = run(*args, code=code)
    assert stdout == ""
    assert message in stderr
    assert len(re.findall("^Error: ", stderr, re.MULTILINE)) == 1
    assert stderr.count("\n") == 1 or code == 2
    assert set(folder.iterdir()) == before


@pytest.mark.slow
@pytest.mark.parametrize(
    ("args", "kept"),
    [
        (["simulate", "scene.toml", "-o", "scene.toml"], "scene.toml"),
        (["simulate", "scene.toml", "--picture", "scene.toml", "-o", "new"], "scene.toml"),
        (["simulate", "along.toml", "-o", "track.csv"], "track.csv"),
        (["compress", "echoes.h5", "-o", "echoes.h5"], "echoes.h5"),
        (["compress", "-o", "echoes.h5", "echoes.h5"], "echoes.h5"),
        (["compress", "echoes.h5", "--scene", "scene.toml", "-o", "scene.toml"], "scene.toml"),
        (["image", "lines.h5", *GRID, "-o", "lines.h5"], "lines.h5"),
        (["image", "lines.h5", *GRID, "-o", "link.h5"], "lines.h5"),
        (["image", "lines.h5", *GRID, "-o", "new", "--picture", "./lines.h5"], "lines.h5"),
        (["image", "lines.h5", "--scene", "scene.toml", "-o", "scene.toml"], "scene.toml"),
        (["image", "lines.h5", "--scene", "along.toml", "-o", "track.csv"], "track.csv"),
        (["quality", "image.h5", "--near", "0,20", "--picture", "image.h5"], "image.h5"),
        (
            ["quality", "image.h5", "--reference", "b.h5", "--near", "0,20", "--picture", "b.h5"],
            "b.h5",
        ),
        (["tradeoff", "lines.h5", *GRID, "--csv", "lines.h5"], "lines.h5"),
        (["mosaic", "scene.toml", "--lines", "lines.h5", "-o", "lines.h5"], "lines.h5"),
        (["mosaic", "scene.toml", "--lines", "lines.h5", "--picture", "lines.h5"], "lines.h5"),
        (["mosaic", "scene.toml", "--lines", "lines.h5", "--picture", "scene.toml"], "scene.toml"),
    ],
)
def test_what_is_read_is_not_written_over(made, tmp_path, monkeypatch, args, kept):
    for name in ("scene.toml", "echoes.h5", "lines.h5", "image.h5"):
        shutil.copy(made[0] / name, tmp_path)
    shutil.copy(made[0] / "image.h5", tmp_path / "b.h5")
    monkeypatch.chdir(tmp_path)
    Path("link.h5").symlink_to("lines.h5")
    Path("track.csv").write_text("time_s,x_m,y_m,z_m\n0,0,0,0\n1,1,0,0\n")
    start, end = EXAMPLE.index("[track]"), EXAMPLE.index("[[targets]]")
    Path("along.toml").write_text(f'{EXAMPLE[:start]}[track]\nfile = "track.csv"\n{EXAMPLE[end:]}')
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    stdout, stderr = run(*args, code=2)
    assert stdout == ""
    # Many are refused for their suffix already.
    refused = f"must be two files, got {kept!r}", "the file's name must end in"
    assert any(words in stderr for words in refused) or "link.h5" in args
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_link_to_itself_is_no_output(made, tmp_path):
    (tmp_path / "loop").symlink_to("loop")
    grid = ["--x", "0:1:4", "--y", "19:20:4"]
    _, stderr = run("image", made[0] / "lines.h5", *grid, "-o", tmp_path / "loop", code=2)
    assert "cannot be written" in stderr


def test_a_pipe_is_no_output(made, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    _, stderr = run("simulate", made[0] / "scene.toml", "-o", tmp_path / "pipe", code=2)
    assert "is not an ordinary file" in stderr
    assert (tmp_path / "pipe").is_fifo()


def test_running_out_of_memory_is_told(made, tmp_path, monkeypatch):
    def exhaust(*_, **__):
        raise MemoryError("Unable to allocate 7 TiB")

    monkeypatch.setattr(clsas, "compress", exhaust)
    _, stderr = run("compress", made[0] / "echoes.h5", "-o", tmp_path / "lines.h5", code=1)
    assert stderr == "Error: out of memory: Unable to allocate 7 TiB\n"


def test_traceback_on_request(made):
    args = ["--traceback", "quality", str(made[0] / "image.h5"), "--near", "9,9"]
    result = CliRunner().invoke(cli.main, args)
    assert isinstance(result.exception, ValueError)


def test_pictures_without_matplotlib_are_refused_before_any_work(made, tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    scene = made[0] / "scene.toml"
    png = ("--picture", tmp_path / "x.png")
    _, stderr = run("simulate", scene, "-o", tmp_path / "echoes.h5", *png, code=1)
    assert "pip install 'matplotlib>=3.10'" in stderr
    run("demo", "--out", tmp_path / "out", code=1)
    assert not any(tmp_path.iterdir())


def test_help_shows_an_example_that_parses(monkeypatch):
    context = cli.main.make_context("clsas", ["devices"])
    for name in cli.main.list_commands(context):
        command = cli.main.get_command(context, name)
        text, _ = run(name, "--help")
        ((variable, value, example),) = re.findall(r"Example:  (?:(\w+)=(\w+) )?clsas (.*)", text)
        given, *args = shlex.split(example)
        assert given == name
        files = [p.type for p in command.params if getattr(p.type, "exists", False)]
        for file in files:
            monkeypatch.setattr(file, "exists", False)  # an example's are nowhere
        command.make_context(name, args)
        if variable:
            with monkeypatch.context() as environment:
                environment.setenv(variable, value)
                assert variable in run(given, *args)[0]
        assert all(p.help for p in command.params if isinstance(p, click.Option)), name
    assert run("--version")[0] == f"clsas, version {clsas.__version__}\n"


@pytest.mark.exhaustive
def test_bench(monkeypatch):
    monkeypatch.setattr(cases, "EXACT_CASES", {"one": SMALL, "two": SMALL})
    monkeypatch.setattr(cases, "FACTORIZED_CASES", {"fast": SMALL})
    monkeypatch.setattr(cases, "MOSAIC_CASES", {})
    monkeypatch.setattr(cases, "HEIGHTS_CASES", {})
    result = run_json("bench", "one", "--repeats", 2)
    assert result["case"] == "one"
    assert result.keys() >= {"device", "driver", "gbp_per_s", "rounding_error_db"}
    seconds = result["seconds"]
    assert 0 < seconds["min"] <= seconds["median"] <= seconds["max"]
    assert result["true_error_db"] < -50
    stdout, _ = run("bench", "--repeats", 1, "--json")
    assert [json.loads(line)["case"] for line in stdout.splitlines()] == ["one", "two", "fast"]
    result = run_json("bench", "fast", "--repeats", 1, "--tolerance-db", -30)
    assert (result["case"], result["tolerance_db"]) == ("fast", -30)
    assert result["error_db"] < -28
    for args in (["fast", "--accuracy-db", "-30"], ["one", "--tolerance-db", "-30"]):
        assert "--tolerance-db for other cases" in run("bench", *args, code=2)[1]
    text, _ = run("bench", "one", "--repeats", 1)
    assert re.search(r"^ +gbp_per_s  \d", text, re.MULTILINE)
    assert "'one' or 'two'" not in text


@pytest.mark.slow
def test_demo_in_json(tmp_path, monkeypatch):
    small = built_in_scene("thesis_wide_beam").replace(b"count = 1024", b"count = 64")
    monkeypatch.setattr(demo, "built_in_scene", lambda name: small)
    result = run_json("demo", "--out", tmp_path / "new" / "folder")
    assert result["seconds"].keys() == {"simulate", "compress", "image", "close-up"}
    assert all(Path(file).stat().st_size > 0 for file in result["files"])
    point, expected = result["point"], result["expected"]
    assert (point["x_m"], point["y_m"]) == pytest.approx((0, 42.5), abs=1e-5)
    for axis in ("azimuth", "range"):
        assert point[axis]["resolution_m"] == pytest.approx(
            expected[f"{axis}_resolution_m"], rel=5e-3
        )
    assert {Path(file) for file in result["files"]} == set((tmp_path / "new/folder").iterdir())
    # A range side lobe of an unweighted band, and an azimuth one that the beams weigh.
    assert point["range"]["pslr_db"] == pytest.approx([-13.26, -13.26], abs=0.5)
    assert max(point["azimuth"]["pslr_db"]) < -20


@pytest.mark.exhaustive
def test_demo_writes_over_no_other_files(tmp_path, monkeypatch):
    small = built_in_scene("thesis_wide_beam").replace(b"count = 1024", b"count = 64")
    monkeypatch.setattr(demo, "built_in_scene", lambda name: small)
    out = tmp_path / "out"
    run("demo", "--out", out)
    run("demo", "--out", out)
    mine = small + b"# mine"
    (out / "scene.toml").write_bytes(mine)
    before = {file: file.read_bytes() for file in out.iterdir()}
    _, stderr = run("demo", "--out", out, code=1)
    assert "overwrite scene.toml, echoes.h5" in stderr
    (out / "scene.toml").unlink()
    assert "overwrite echoes.h5" in run("demo", "--out", out, code=1)[1]
    del before[out / "scene.toml"]
    assert {file: file.read_bytes() for file in out.iterdir()} == before


def test_ctrl_c_while_a_command_is_loaded_ends_with_130(monkeypatch):
    load = builtins.__import__

    def interrupted(name, *rest):
        if name == "pyopencl":
            raise KeyboardInterrupt
        return load(name, *rest)

    monkeypatch.setattr(builtins, "__import__", interrupted)
    result = CliRunner().invoke(cli.main, ["devices"])
    assert result.exit_code == 130
    assert result.stderr == "Interrupted\n"


@pytest.mark.slow
def test_ctrl_c_ends_with_130_and_leaves_no_file(tmp_path):
    """Interrupted once the warning of a sparse array says that work begins."""
    points = "".join(f"[[targets]]\nposition_m = [0, {20 + n / 1e3}, 0]\n" for n in range(2000))
    text = EXAMPLE.replace("pings = 20", "pings = 20000").replace(
        "spacing_m = 0.02", "spacing_m = 1"
    )
    (tmp_path / "scene.toml").write_text(points + text.replace("snr_db = 20", ""))
    command = ["simulate", "scene.toml", "-o", "echoes.h5"]
    code, stderr = interrupted(command, "Warning: phase centres", tmp_path, after_s=0.5)
    assert code == 130
    assert stderr.splitlines()[-1] == "Interrupted"
    assert "Traceback" not in stderr
    assert [path.name for path in tmp_path.iterdir()] == ["scene.toml"]


INTERRUPTED_IMPORT = """
import signal, sys

class Interrupting:
    def find_spec(self, name, path, target=None):
        if name == sys.argv[1]:
            sys.meta_path.remove(self)
            signal.raise_signal(signal.SIGINT)

signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Interrupting())
from clsas.__main__ import run
sys.argv[1:] = ["devices"]
run()
"""


@pytest.mark.exhaustive
@pytest.mark.parametrize("module", ["click", "clsas.cli", "numpy", "pyopencl", "clsas.cli.machine"])
def test_ctrl_c_while_modules_are_imported_ends_with_130(module):
    command = [sys.executable, "-c", INTERRUPTED_IMPORT.replace("sys.argv[1]", repr(module))]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "Interrupted\n")


@pytest.mark.slow
def test_progress_is_shown_on_a_terminal(made, tmp_path):
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "clsas", "compress", str(made[0] / "echoes.h5"), "-o", "l.h5"]
    subprocess.run(
        command, cwd=tmp_path, stderr=theirs, stdout=subprocess.DEVNULL, check=True,
        env={**os.environ, "TERM": "xterm"},
    )  # fmt: skip
    os.close(theirs)
    shown = b""
    try:
        while chunk := os.read(ours, 4096):
            shown += chunk
    except OSError:  # how a pseudo-terminal ends
        pass
    os.close(ours)
    assert b"compressing" in shown
    assert (tmp_path / "l.h5").exists()


@pytest.mark.watches("docs/tour.md", "scripts/pages")
def test_tour(tmp_path, monkeypatch):
    """Every command of the documentation's tour does what it says, in its order."""
    monkeypatch.chdir(tmp_path)
    commands, program = (
        "\n".join(re.findall(rf"```{kind}\n(.*?)```", TOUR, re.DOTALL)) for kind in ("sh", "python")
    )
    monkeypatch.setattr(cases, "FACTORIZED_CASES", {"ffbp-thesis": SMALL})
    shown = {}
    for line in filter(None, commands.splitlines()):
        name, *args = shlex.split(line)
        if name == "cd":
            monkeypatch.chdir(*args)
        else:
            assert name == "clsas"
            shown[args[0]] = shown.get(args[0], "") + run(*args)[0]
    assert re.search(
        r"azimuth 6\.58 mm wide at -3 dB \(theory 6\.58 mm; L/2 = 7\.50 mm\)", shown["demo"]
    )
    assert re.search(r"range +6\.86 mm wide at -3 dB \(theory 6\.86 mm", shown["demo"])
    assert "point at x = " in shown["quality"]
    error_db = float(re.search(r"error relative to exact.h5: (\S*) dB;", shown["quality"])[1])
    assert error_db < -38
    assert shown["plan"].startswith("Plan: tolerance -40 dB")
    pictures = {path.name for path in Path().glob("*.png")}
    assert pictures > {"geometry.png", "lines.png", "cuts.png", "tradeoff.png"}

    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert "Plan: tolerance -50 dB; predicted error" in done.stdout
    azimuth, range_ = map(float, re.findall(r"([\d.]+) mm", done.stdout))
    assert azimuth == pytest.approx(6.6, abs=0.3)
    assert range_ == pytest.approx(1.3 * 7.5, rel=0.1)


def test_pipes_and_devices_are_refused_as_inputs(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path, kind in ((tmp_path / "pipe", "a pipe"), ("/dev/zero", "a device")):
        for command in ("simulate", "compress"):
            _, stderr = run(command, path, "-o", tmp_path / "out.h5", code=2)
            assert f"must be an ordinary file, got {kind}" in stderr


def test_messages_hold_no_control_characters(tmp_path):
    path = tmp_path / "\x1b[31mname\x07"
    path.write_text("[sonar")
    for given, code in ((path, 1), (tmp_path / "\x1b]0;x", 2)):
        _, stderr = run("simulate", given, "-o", tmp_path / "out.h5", code=code)
        assert "\x1b" not in stderr
        assert stderr.count("Error: ") == 1


BAD = "\x1b[31mred\nError: gone\nWarning: fine.h5"


def test_names_of_files_reach_no_terminal(made, tmp_path):
    """Neither do escape sequences in them, nor lines that look like clsas's own."""
    for name in ("lines.h5", "image.h5", "scene.toml"):
        shutil.copy(made[0] / name, tmp_path / f"{name}{BAD}")
    (tmp_path / f"text{BAD}").write_text("no scene")
    out, grid = tmp_path / f"out{BAD}", ["--x", "-1:1:8", "--y", "19:21:8"]
    lines, image, text = (tmp_path / f"{name}{BAD}" for name in ("lines.h5", "image.h5", "text"))
    for args, code in (
        (["image", lines, *grid, "--exact", "-o", out], 0),
        (["convert", lines, out], 0),
        (["quality", image, "--reference", image], 0),
        (["simulate", tmp_path / f"scene.toml{BAD}", "-o", out], 0),
        (["simulate", text, "-o", tmp_path / "echoes.h5"], 1),
        (["compress", image, "-o", tmp_path / "new.h5"], 1),
        (["image", tmp_path / f"none{BAD}", *grid, "-o", tmp_path / "new.h5"], 2),
        ([f"--{BAD}"], 2),
        ([f"none{BAD}"], 2),
    ):
        stdout, stderr = run(*args, code=code)
        assert "\x1b" not in stdout + stderr
        assert r"\x1b[31mred\nError: gone\nWarning: fine.h5" in stdout + stderr
        assert len(re.findall("^Error: ", stdout + stderr, re.MULTILINE)) == (code > 0)
        assert not re.findall("^Warning: fine", stdout + stderr, re.MULTILINE)


def test_warnings_of_others_are_not_shown_as_clsas_own(monkeypatch, tmp_path):
    def warn(*_, **__):
        warnings.warn("of another library", DeprecationWarning, stacklevel=1)
        for _ in range(3):  # the same is shown once
            validate.warn("of clsas\x1b")
        raise ValueError("end")

    monkeypatch.setattr("clsas.cli.lines.read_scene", warn)
    (tmp_path / "scene.toml").touch()
    _, stderr = run("simulate", tmp_path / "scene.toml", "-o", tmp_path / "out.h5", code=1)
    assert stderr.count("Warning: of clsas\\x1b\n") == 1
    assert "\nWarning: of another" not in f"\n{stderr}"


def test_help_lists_every_command_once_on_a_line_in_four_groups():
    lines = run("--help")[0].splitlines()
    listed = "\n".join(lines[lines.index("Recordings:") :])
    groups = re.findall(r"^(\w+):\n((?:  .+\n?)+)", listed, re.MULTILINE)
    assert [heading for heading, _ in groups] == ["Recordings", "Images", "Measures", "Machine"]
    rows = [row for _, body in groups for row in body.splitlines()]
    context = cli.main.make_context("clsas", ["devices"])
    assert [row.split()[0] for row in rows] == cli.main.list_commands(context)
    assert all(re.fullmatch(r"  [\w-]+ +[A-Z].*\.", row) for row in rows)


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        (["mo"], ["mosaic"]),
        (["--tr"], ["--traceback"]),
        (["image", "--tol"], ["--tolerance-db", "--tolerance-wavelengths"]),
        (["process", "--step", "f"], ["focus"]),
    ],
)
def test_shells_complete_commands_options_and_choices(typed, expected):
    *args, incomplete = typed
    completion = ShellComplete(cli.main, {}, "clsas", "_CLSAS_COMPLETE")
    assert [item.value for item in completion.get_completions(args, incomplete)] == expected


def test_recordings_that_are_no_hdf5_are_assessed(made, tmp_path):
    pytest.importorskip("sarkit")
    lines = clsas.load(made[0] / "lines.h5")
    clsas.save(tmp_path / "lines.cphd", replace(lines, rx_velocity_m_s=None))
    assert "needed" in run_json("assess", tmp_path / "lines.cphd", *GRID)
