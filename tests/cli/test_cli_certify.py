"""Measured errors on the command line: of files, and of images that were just formed."""

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

import clsas
from clsas import cli
from clsas.engine import promise

AXES = "--x", "-1:1:48", "--y", "39.5:40.5:48"
BEAM = clsas.BeamWindow(4.0)


def run(*args, code=0):
    """Run a command; return standard output and standard error."""
    result = CliRunner().invoke(cli.main, [str(arg) for arg in args], prog_name="clsas")
    assert result.exit_code == code, (result.output, result.exception)
    return result.stdout, result.stderr


@pytest.fixture(scope="module")
def lines():
    """Lines of points all over the grid."""
    random = np.random.default_rng(5)
    tx_m = np.outer(np.linspace(-1, 1, 40), [1.0, 0, 0])
    points = clsas.PointTargets(
        np.stack([random.uniform(-1, 1, 60), random.uniform(39.5, 40.5, 60), np.zeros(60)], axis=1)
    )
    return clsas.simulate_lines(tx_m, tx_m, points, carrier_hz=100e3, bandwidth_hz=30e3)


@pytest.fixture(scope="module")
def folder(lines, tmp_path_factory):
    """A folder with lines, other lines, and an image under a beam."""
    folder = tmp_path_factory.mktemp("certify")
    grid = clsas.Grid.plane((-1, 1, 48), (39.5, 40.5, 48))
    clsas.save(folder / "lines.h5", lines)
    clsas.save(folder / "other.h5", replace(lines, samples=lines.samples[::-1]))
    clsas.save(folder / "image.h5", clsas.backproject(lines, grid, beam=BEAM))
    return folder


def test_the_error_of_a_file_is_that_of_the_library(folder, lines):
    image = clsas.load(folder / "image.h5")
    files = folder / "image.h5", folder / "lines.h5"
    found = clsas.certify(image, lines, pixels=64, seed=1)
    stdout, stderr = run("certify", *files, "--pixels", 64, "--seed", 1)
    first, _, headings, *rows = stdout.splitlines()
    assert stderr == ""
    assert first == f"{found.describe()}; -60 dB requested"
    assert headings.split()[:2] == ["row", "column"]
    assert [list(map(int, row.split()[:2])) for row in rows] == found.worst.tolist()

    known = json.loads(run("certify", *files, "--pixels", 64, "--seed", 1, "--json")[0])
    assert known["upper_db"] == found.upper_db
    row, column = known["worst"][0]
    np.testing.assert_allclose(known["worst_m"][0], image.grid.positions_m()[row, column])


def test_an_image_from_elsewhere_takes_the_beam_of_the_options_and_of_the_scene(folder, tmp_path):
    image = clsas.load(folder / "image.h5")
    clsas.save(tmp_path / "image.h5", clsas.Image(3j * image.pixels, image.grid))
    (tmp_path / "scene.toml").write_text("[image.beam]\nwidth_deg = 4.0\n")
    files = tmp_path / "image.h5", folder / "lines.h5"
    for beam, db in (
        ((), 10),
        (("--beam-deg", 4), -55),
        (("--scene", tmp_path / "scene.toml"), -55),
        (("--scene", tmp_path / "scene.toml", "--beam-deg", 2), 10),
    ):
        found = json.loads(run("certify", *files, "--scale", *beam, "--json")[0])
        assert (found["error_db"] < -55) == (db == -55)


def test_other_lines_are_warned_of(folder):
    stdout, stderr = run("certify", folder / "image.h5", folder / "other.h5")
    assert "was formed from other lines than those given" in stderr
    assert stdout.startswith("error ")


def test_the_error_of_a_mosaic_is_measured_once_it_is_finished(folder, lines, tmp_path):
    image = clsas.load(folder / "image.h5")
    store, given = tmp_path / "a.zarr", folder / "lines.h5"
    request = {"tolerance_db": -40, "beam": BEAM, "patches": (4, 2)}
    mosaic = clsas.mosaic(lines, image.grid, store, **request, memory_bytes=64 << 20)
    unfinished = iter(mosaic)
    next(unfinished)
    unfinished.close()
    assert "must be finished" in run("certify", store, given, code=1)[1]
    mosaic.image()
    stdout, _ = run("certify", store, given)
    assert "; -40 dB requested" in stdout
    assert float(stdout.split()[1]) < -38


def test_an_image_says_its_error_on_request_and_by_default(folder, tmp_path, monkeypatch):
    command = "image", folder / "lines.h5", *AXES, "--tolerance-db", -40, "-o", tmp_path / "a.h5"
    assert "confidence" in run(*command, "--certificate")[0].splitlines()[-1]
    measured = json.loads(run(*command, "--certificate", "--json")[0])
    assert measured["certificate"]["upper_db"] >= measured["certificate"]["error_db"]
    assert measured["certificate"]["seconds"] < measured["seconds"]
    assert measured["misses"] == []
    assert (
        clsas.load(tmp_path / "a.h5").formed.certificate.error == measured["certificate"]["error"]
    )
    assert json.loads(run(*command, "--no-certificate", "--json")[0])["certificate"] is None

    monkeypatch.setattr(promise, "LEAST_SECONDS", 0.0)
    assert "confidence" in run(*command)[0]
    (tmp_path / "scene.toml").write_text("[image]\ncertificate = false\n")
    assert "confidence" not in run(*command, "--scene", tmp_path / "scene.toml")[0]
    stages = *command[:-4], "--stages", "2x2", *command[-2:]
    assert "confidence" not in run(*stages)[0]  # often bad on purpose


def test_an_image_that_misses_is_not_written_on_request(folder, tmp_path, monkeypatch):
    bad = clsas.Certificate(64, 2304, 0.1, 1.0, 1.0, 0.0, 0.0)
    monkeypatch.setattr(promise, "measured", lambda *_: bad)
    command = "image", folder / "lines.h5", *AXES, "--certificate", "-o", tmp_path / "a.h5"
    _, stderr = run(*command, "--on-miss", "raise", code=1)
    assert stderr.startswith("Error: the image misses its tolerance: error 0.0 dB (")
    assert not (tmp_path / "a.h5").exists()
    stdout, stderr = run(*command, "--on-miss", "warn")
    assert "Warning: the image misses its tolerance" in stderr
    assert "error 0.0 dB" in stdout
