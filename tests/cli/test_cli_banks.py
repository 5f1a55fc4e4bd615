"""Commands that take one receiver bank of range lines."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

import clsas
from clsas import cli
from clsas.files.scene_files import parse_scene

SCENE = """
[sonar]
receivers = 4
spacing_m = 0.05
bank_heights_m = [-0.1, 0.2]
tx_length_m = 0.1
rx_length_m = 0.1

[sonar.pulse]
carrier_hz = 100e3
bandwidth_hz = 20e3
duration_s = 1e-3

[track]
start_m = [-1.0, 0.0, 5.0]
velocity_m_s = [1.0, 0.0, 0.0]
pings = 20
ping_interval_s = 0.1

[[targets]]
position_m = [0.0, 20.0, 0.0]

[grid]
x = { start_m = -0.5, stop_m = 0.5, count = 32 }
y = { start_m = 19.5, stop_m = 20.5, count = 64 }

[image]
tolerance_db = -40
"""


def run(*args, code=0):
    result = CliRunner().invoke(cli.main, [str(arg) for arg in args], prog_name="clsas")
    assert result.exit_code == code, (result.output, result.exception)
    return result.stdout, result.stderr


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A scene of two banks, and its range lines."""
    folder = tmp_path_factory.mktemp("banks")
    scene, lines = folder / "scene.toml", folder / "lines.h5"
    scene.write_text(SCENE)
    run("simulate", scene, "-o", folder / "echoes.h5")
    run("compress", folder / "echoes.h5", "-o", lines)
    return scene, lines


def test_a_scene_has_banks(made):
    lines = clsas.load(made[1])
    assert lines.banks == 2
    np.testing.assert_allclose(np.unique(lines.rx_m[:, 2]), [4.9, 5.2])


def test_images_of_one_bank(made, tmp_path):
    scene, lines = made
    images = []
    for bank in (0, 1):
        path = tmp_path / f"{bank}.h5"
        _, stderr = run("image", lines, "--scene", scene, "--bank", bank, "-o", path)
        assert "banks" not in stderr
        images.append(clsas.load(path).pixels)
    assert abs(np.vdot(*images)) > 0.9 * np.linalg.norm(images[0]) * np.linalg.norm(images[1])
    assert not np.array_equal(*images)
    _, stderr = run("image", lines, "--scene", scene, "-o", tmp_path / "both.h5")
    assert "lines have 2 banks, 0.3 m apart in height" in stderr


def test_one_bank_is_converted(made, tmp_path):
    run("convert", made[1], tmp_path / "upper.h5", "--bank", 1)
    upper = clsas.load(tmp_path / "upper.h5")
    assert upper.banks == 1
    np.testing.assert_array_equal(upper.samples, clsas.load(made[1]).bank(1).samples)


@pytest.mark.parametrize("command", ["image", "plan", "convert", "assess", "tradeoff"])
def test_a_bank_that_is_missing_is_named(made, command, tmp_path):
    output = {"image": ("-o", tmp_path / "i.h5"), "convert": (tmp_path / "c.h5",)}.get(command, ())
    scene = () if command == "convert" else ("--scene", made[0])
    _, stderr = run(command, made[1], *output, *scene, "--bank", 2, code=1)
    assert "--bank must be one of the banks 0, 1, got 2" in stderr


def test_assessments_take_a_bank(made):
    scene, lines = made
    results = [
        json.loads(run("assess", *args, "--json")[0])
        for args in ((scene,), (scene, "--bank", 1), (lines, "--scene", scene, "--bank", 0))
    ]
    assert {each["channels"] for each in results} == {80}
    _, stderr = run("assess", lines, "--scene", scene, code=1)
    assert "got 2: use --bank 0" in stderr


def test_a_case_has_no_banks():
    _, stderr = run("tradeoff", "--case", "ffbp-thesis", "--bank", 0, code=2)
    assert "leave out --bank" in stderr


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("receivers = 2\nspacing_m = 0.1\nbank_numbers = [0, 1]", "bank_heights_m"),
        ("rx_m = [[0, 0, 0], [0, 0, 1]]\nbank_heights_m = [0.0, 1.0]", "by `bank_numbers`"),
        ("rx_m = [[0, 0, 0], [0, 0, 1]]\nbank_numbers = [0, 2]", "without a gap"),
    ],
)
def test_wrong_banks_of_a_scene_are_refused(keys, message, tmp_path):
    pulse = "[sonar.pulse]\ncarrier_hz = 100e3\nbandwidth_hz = 20e3\nduration_s = 1e-3"
    with pytest.raises(ValueError, match=message):
        parse_scene(f"[sonar]\n{keys}\n{pulse}".encode(), name="scene.toml", folder=tmp_path)


def test_banks_by_positions(tmp_path):
    pulse = "[sonar.pulse]\ncarrier_hz = 100e3\nbandwidth_hz = 20e3\nduration_s = 1e-3"
    keys = "rx_m = [[0, 0, 0], [0, 0, 1]]\nbank_numbers = [0, 1]"
    text = f"[sonar]\n{keys}\n{pulse}".encode()
    assert parse_scene(text, name="scene.toml", folder=tmp_path).sonar.banks == 2
