"""A scene's sound speed reaches simulated echoes, recorded lines and assessments."""

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

import clsas
from clsas.cli import main

SCENE = """
[sonar]
receivers = 1
spacing_m = 0.1
[sonar.pulse]
carrier_hz = 100e3
bandwidth_hz = 20e3
duration_s = 1e-3
[track]
start_m = [-1.0, 0.0, -6.0]
velocity_m_s = [1.0, 0.0, 0.0]
pings = 60
ping_interval_s = 0.033
[[targets]]
position_m = [0.0, 30.0, -22.0]
[grid]
x = { start_m = -0.5, stop_m = 0.5, count = 41 }
y = { start_m = 29.5, stop_m = 30.5, count = 81 }
z_m = -22.0
[sound_speed]
depth_m = [0.0, 10.0, 13.0, 40.0]
speed_m_s = [1510.0, 1510.0, 1497.0, 1495.0]
"""


def run(*words):
    done = CliRunner().invoke(main, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    return done.output


@pytest.mark.slow
def test_from_scene_to_image(tmp_path):
    scene, echoes, lines, image = (
        tmp_path / name for name in ("scene.toml", "echoes.h5", "lines.h5", "image.h5")
    )
    scene.write_text(SCENE)
    run("simulate", scene, "-o", echoes)
    run("compress", echoes, "-o", lines)
    kept = clsas.load(lines)
    assert kept.sound_speed == clsas.SoundSpeed([0, 10, 13, 40], [1510, 1510, 1497, 1495])

    def peak_m():
        formed = clsas.load(image)
        row, column = np.unravel_index(np.abs(formed.pixels).argmax(), formed.shape)
        return formed.grid.positions_m()[row, column][:2]

    run("image", lines, "--scene", scene, "-o", image)
    assert peak_m() == pytest.approx([0, 30], abs=0.02)
    recorded = replace(kept, sound_speed=None)
    clsas.save(lines, recorded)
    run("image", lines, "--scene", scene, "-o", image)  # the scene's profile
    assert peak_m() == pytest.approx([0, 30], abs=0.02)
    run("image", lines, "--x=-0.5:0.5:41", "--y=29.5:30.5:81", "--z=-22", "-o", image)
    assert abs(peak_m()[1] - 30) > 0.03


def test_assess_and_plan_a_scene(tmp_path):
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE)
    found = json.loads(run("assess", scene, "--tolerance-db", "-50", "--json"))
    assert "refraction" in found["needed"]
    assert "refraction" in run("assess", scene, "--tolerance-db", "-50")
