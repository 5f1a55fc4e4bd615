"""The command `clsas mosaic`."""

import io
import json
import os
import re
import runpy
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from interrupt import interrupted
from rich.console import Console
from tiers import also

import clsas
from clsas.cli import main, mosaics
from clsas.files.scene_files import read_scene

ROOT = Path(__file__).parents[2]
# The case that scripts/attack takes apart, with fewer pixels and patches, and no bound of memory.
SCENE = runpy.run_path(str(ROOT / "scripts" / "attack" / "case.py"))["SCENE"]
for many, few in {"= 140": "= 80", "= 2052": "= 100", "[6, 8]": "[2, 2]", "memory": "#"}.items():
    assert many in SCENE
    SCENE = SCENE.replace(many, few)


def run(*args, code=0):
    result = CliRunner().invoke(main, list(map(str, args)))
    assert result.exit_code == code, result.output
    return result.stdout, result.stderr


def lines_of(made):
    """The range lines that were simulated."""
    (path,) = made[0].glob("scene-*.lines.h5")
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A scene, its mosaic, and what the command printed."""
    folder = tmp_path_factory.mktemp("mosaic")
    (folder / "scene.toml").write_text(SCENE)
    return folder, run("mosaic", folder / "scene.toml", "--picture", folder / "image.png")


@pytest.mark.slow
def test_a_scene_is_all_it_needs(made):
    folder, (stdout, stderr) = made
    assert "2 x 2 patches of 50 x 40 pixels, 4 formed in" in stdout
    assert "predicted error at most -40" in stdout
    told = stderr.splitlines()
    assert re.search(r"scene-\w{16}\.lines\.h5: range lines, simulated from .*scene.toml$", told[0])
    assert sum(line.startswith("patch ") for line in told) == 4
    assert (folder / "image.png").read_bytes().startswith(b"\x89PNG")
    scene = read_scene(folder / "scene.toml")
    exact = clsas.backproject(clsas.load(lines_of(made)), scene.grid, beam=scene.image["beam"])
    image = clsas.Store.opened(folder / "scene.zarr").image()
    assert clsas.relative_error_db(image, exact) <= -40


@pytest.mark.slow
def test_the_same_command_goes_on(made):
    folder, _ = made
    shutil.rmtree(folder / "scene.zarr" / "patches" / "1.0")
    stdout, stderr = run("mosaic", folder / "scene.toml")
    assert "1 formed in" in stdout
    assert "3 finished before" in stdout
    assert "simulated before" in stderr
    result = json.loads(run("mosaic", folder / "scene.toml", "--json")[0])
    assert result["before"] == result["finished"] == 4
    assert result["patches"] == [2, 2]
    assert result["flags"] == {}
    assert result["predicted_error_db"] <= -40


@pytest.mark.slow
@pytest.mark.parametrize("workers", [(), *also(("--workers", "2"))], ids=["alone", "workers"])
def test_ctrl_c_keeps_what_is_finished(made, tmp_path, workers):
    """It ends with 130, and the same command goes on."""
    command = ["mosaic", made[0] / "scene.toml", "--lines", lines_of(made)]
    command += ["-o", tmp_path / "a.zarr", "--patches", "10x8", "--memory-mib", "64"]
    command += ["--on-miss", "warn", *workers]
    code, stderr = interrupted(command, "patch ")
    assert code == 130
    assert stderr.splitlines()[-1] == "Interrupted"
    assert "Traceback" not in stderr
    stdout, _ = run(*command[:-2] if workers else command)
    there = int(re.search(r"(\d+) finished before", stdout).group(1))
    assert 0 < there < 80
    assert f"{80 - there} formed in" in stdout


@pytest.mark.slow
def test_another_scene_has_other_lines(made, tmp_path):
    """Whatever the files' times; what lies beside the store counts only if it is of the scene."""
    text = (made[0] / "scene.toml").read_text()
    kept = tmp_path / lines_of(made).name
    shutil.copy(lines_of(made), kept)
    shutil.copy(lines_of(made), tmp_path / "image.lines.h5")
    (tmp_path / "scene.toml").write_text(text.replace("amplitude = 0.5", "amplitude = 0.7"))
    os.utime(tmp_path / "scene.toml", (0, 0))
    _, stderr = run("mosaic", tmp_path / "scene.toml", "-o", tmp_path / "image.zarr")
    assert "simulated from" in stderr
    (tmp_path / "scene.toml").write_text(text.replace("start_m = -2", "start_m = -1"))
    _, stderr = run("mosaic", tmp_path / "scene.toml")
    assert "simulated before" in stderr  # the grid is no part of them


@pytest.mark.slow
def test_lines_grid_and_beam_from_the_command_line(made, tmp_path):
    (tmp_path / "empty.toml").write_text("")
    stdout, _ = run(
        "mosaic", tmp_path / "empty.toml", "--lines", lines_of(made),
        "--x", "-2:2:80", "--y", "56:61:100", "--beam-deg", "6", "--beam-shape", "hann",
        "--tolerance-db", "-40", "--patches", "1x4", "-o", tmp_path / "a.zarr", "--device", "0",
    )  # fmt: skip
    assert "1 x 4 patches of 100 x 20 pixels, 4 formed" in stdout
    image, other = (
        clsas.Store.opened(path).image() for path in (tmp_path / "a.zarr", made[0] / "scene.zarr")
    )
    assert clsas.relative_error_db(image, other) < -37


@pytest.mark.slow
def test_processes_of_this_machine(made, tmp_path):
    pytest.importorskip("distributed")
    command = "mosaic", made[0] / "scene.toml", "--lines", lines_of(made), "--memory-mib", "64"
    run(*command, "-o", tmp_path / "alone.zarr")
    stdout, stderr = run(*command, "-o", tmp_path / "together.zarr", "--workers", "2")
    assert "4 formed" in stdout
    assert sum(line.startswith("patch ") for line in stderr.splitlines()) == 4
    ours, theirs = (
        clsas.Store.opened(tmp_path / f"{name}.zarr").image().pixels
        for name in ("alone", "together")
    )
    np.testing.assert_array_equal(ours, theirs)


@pytest.mark.slow
def test_a_folder_that_has_ended(made, tmp_path):
    folder = tmp_path / "survey"
    folder.mkdir()
    lines = clsas.load(lines_of(made))
    for part in range(3):
        clsas.save(folder / f"{part}.h5", lines.select(slice(120 * part, 120 * part + 120)))
    (folder / "end").touch()
    stdout, _ = run(
        "mosaic", made[0] / "scene.toml", "--lines", folder, "--follow", "-o", tmp_path / "a.zarr"
    )
    assert "4 formed" in stdout


def test_flags_are_told(made, tmp_path):
    stdout, _ = run(
        "mosaic", made[0] / "scene.toml", "--lines", lines_of(made),
        "--x", "100:104:20", "--y", "56:61:100", "-o", tmp_path / "a.zarr", "--allow-unreached",
    )  # fmt: skip
    assert "  patch 0,0; 0,1; 1,0 and 1 more: empty: outside the beam or recorded" in stdout


def test_exact_patches(made, tmp_path):
    scene, store = made[0] / "scene.toml", tmp_path / "exact.zarr"
    stdout, _ = run("mosaic", scene, "--lines", lines_of(made), "--exact", "-o", store)
    assert "predicted error at most -60" in stdout
    records = clsas.Store.opened(store).records().values()
    assert all(record.plan is None for record in records)


def test_a_mosaic_that_no_line_reaches_is_refused(made, tmp_path):
    store = tmp_path / "far.zarr"
    axes = "--x", "0:4:20", "--y", "56000:61000:20"
    stderr = run(
        "mosaic", made[0] / "scene.toml", "--lines", lines_of(made), *axes, "-o", store, code=1
    )[1]
    assert "no pixel of the grid lies within" in stderr
    assert "--allow-unreached" in stderr
    assert not store.exists()


def test_a_mosaic_of_zeros_has_no_predicted_error(made, tmp_path):
    command = [
        "mosaic", made[0] / "scene.toml", "--lines", lines_of(made), "--x", "100:104:20",
        "--y", "56:61:20", "-o", tmp_path / "zero.zarr", "--allow-unreached",
    ]  # fmt: skip
    stdout, stderr = run(*command)
    assert "; all pixels are zero" in stdout
    assert "predicted error" not in stdout + stderr
    results = json.loads(run(*command, "--json")[0])
    assert results["is_zero"]
    assert results["predicted_error_db"] is None


def test_a_store_is_verified_without_its_scene(made):
    store = made[0] / "scene.zarr"
    stdout, _ = run("mosaic", "--verify", "-o", store)
    assert "4 patches match their checksums, none damaged" in stdout
    assert run("mosaic", "--verify", made[0] / "scene.toml")[0] == stdout
    _, stderr = run("mosaic", "--verify", code=2)
    assert "--verify requires a store: clsas mosaic --verify -o STORE.zarr" in stderr
    _, stderr = run("mosaic", "-o", store, code=2)
    assert "without SCENE.TOML, give --lines, --x and --y too" in stderr


@pytest.mark.slow
def test_options_replace_the_scene(made, tmp_path):
    grid = "--x", "-2:2:80", "--y", "56:61:100"
    options = *grid, "--patches", "1x2", "--tolerance-db", "-40", "-o", tmp_path / "a.zarr"
    stdout, stderr = run("mosaic", "--lines", lines_of(made), *options)
    assert "1 x 2 patches of 100 x 40 pixels, 2 formed" in stdout
    assert "simulated" not in stderr
    assert clsas.Store.opened(tmp_path / "a.zarr").grid.shape == (100, 80)
    for missing, args in (
        ("--lines", [*grid, "-o", tmp_path / "b.zarr"]),
        ("--x and --y", ["--lines", lines_of(made), "-o", tmp_path / "b.zarr"]),
        ("-o", ["--lines", lines_of(made), *grid]),
        ("--lines, --x and --y, -o", []),
    ):
        assert f"without SCENE.TOML, give {missing} too" in run("mosaic", *args, code=2)[1]
    assert [path.name for path in tmp_path.iterdir()] == ["a.zarr"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("args", "code", "message"),
    [
        (["--exact", "--tolerance-db", "-30"], 2, "give only one of --tolerance-db"),
        (["--patches", "2y2"], 2, "'2y2' must be ROWSxCOLUMNS"),
        (["--patches", "0x2"], 2, "'0x2' must be ROWSxCOLUMNS, at least 1x1"),
        (["--patches", "90x2"], 1, "patches must all have pixels"),
        (["--workers", "2", "--scheduler", "tcp://localhost:1"], 2, "give only one of"),
        (["--workers", "2", "--device", "0"], 2, "--device has no effect"),
        (["--lines", "folder", "-o", "./folder"], 2, "--lines and -o must be two files"),
        (["-o", "new", "--picture", "new"], 2, "-o and --picture must be two files"),
        (
            ["-o", "scene.zarr", "--picture", "scene.zarr/all.png"],
            2,
            "--picture must not lie in the store",
        ),
        (["--follow"], 2, "--follow requires --lines with a folder"),
        (["--tolerance-db", "-30"], 1, "--tolerance-db is -40.0 in the store, -30.0 here"),
        (["--tolerance-db", "-300"], 2, "'--tolerance-db': must be"),
        (["--memory-mib", "0"], 2, "--memory-mib"),
        (["--device", "abacus", "-o", "new.zarr"], 1, "'abacus'"),
        (["-o", "no/such/new.zarr"], 1, "no/such"),
        (["--lines", "none.h5"], 2, "'none.h5' does not exist"),
        (["--lines", "scene.toml"], 1, "scene.toml is not an HDF5 file"),
        (["--idle-s", "-1", "--lines", "folder", "--follow"], 2, "'--idle-s': must be"),
        (["--accuracy-db", "3"], 2, "'--accuracy-db': must be"),
        (["--idle-s", "5"], 2, "--idle-s requires --follow"),
        (["--idle-s", "0.1", "--lines", "folder", "--follow"], 1, "folder, which has no file"),
    ],
)
def test_errors_are_one_message(made, monkeypatch, args, code, message):
    monkeypatch.chdir(made[0])
    (made[0] / "folder").mkdir(exist_ok=True)
    before = sorted(path.name for path in made[0].iterdir())
    _, stderr = run("mosaic", "scene.toml", *args, code=code)
    assert message in stderr
    assert "Traceback" not in stderr
    assert sorted(path.name for path in made[0].iterdir()) == before


def test_nothing_is_simulated_for_patches_that_cannot_be(tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE)
    _, stderr = run("mosaic", tmp_path / "scene.toml", "--patches", "90x2", code=1)
    assert "patches must all have pixels" in stderr
    assert [path.name for path in tmp_path.iterdir()] == ["scene.toml"]


@pytest.mark.slow
def test_a_scheduler_that_is_not_there(made, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("clsas.cli.mosaics._SCHEDULER_S", 0.5)
    _, stderr = run("mosaic", made[0] / "scene.toml", "--scheduler", "tcp://127.0.0.1:9", code=1)
    assert "--scheduler tcp://127.0.0.1:9 cannot be reached" in stderr


def test_lines_that_were_simulated_are_not_written_over(made, monkeypatch):
    monkeypatch.chdir(made[0])
    name = lines_of(made).name
    before = lines_of(made).read_bytes()
    _, stderr = run("mosaic", "scene.toml", "--picture", name, code=2)
    assert f"the file's name must end in .png or .pdf or .svg, got {name!r}" in stderr
    assert lines_of(made).read_bytes() == before


@pytest.mark.parametrize(
    ("mosaic", "args", "message"),
    [
        ("", ["-o", "a.png", "--picture", "a.png"], "-o and --picture must be two files"),
        ('store = "a.png"', ["--picture", "a.png"], "--picture and the store must be two files"),
        ('lines = "folder"', ["-o", "folder"], "mosaic.lines and -o must be two files"),
        ('lines = "a"', ["--picture", "./a"], "mosaic.lines and --picture must be two files"),
        ('lines = "folder"\nstore = "folder"', [], "the range lines and the store must be two"),
    ],
)
def test_what_a_scene_names_is_not_written_over(tmp_path, monkeypatch, mosaic, args, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE + mosaic)
    (tmp_path / "folder").mkdir()
    (tmp_path / "a").touch()
    _, stderr = run("mosaic", "scene.toml", *args, code=2)
    assert message in stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "folder", "scene.toml"]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("patches = [2]", "[mosaic] patches must be a list of 2"),
        ("patches = [0, 2]", "[mosaic] every entry of patches must be"),
        ("memory_mib = 0", "[mosaic] memory_mib must be"),
        ('lines = "none.h5"', "[mosaic] lines must be a file or folder"),
        ("patch = 2", "unknown key 'patch' in [mosaic]: did you mean 'patches'"),
    ],
)
def test_errors_of_scene_files(tmp_path, line, message):
    (tmp_path / "scene.toml").write_text(SCENE.replace("patches = [2, 2]", line))
    _, stderr = run("mosaic", tmp_path / "scene.toml", code=1)
    assert message in stderr
    assert [path.name for path in tmp_path.iterdir()] == ["scene.toml"]


@pytest.mark.parametrize("what", ["folder", "file", "no folder", "read-only"])
def test_a_store_that_cannot_be_is_refused_before_anything_is_simulated(tmp_path, what):
    store = tmp_path / "other" / "a"
    if what != "no folder":
        store.parent.mkdir()
    if what == "folder":
        store.mkdir()
        (store / "passwd").touch()
    elif what == "file":
        store.touch()
    elif what == "read-only":
        if os.geteuid() == 0:
            pytest.skip("root writes everywhere")
        store.parent.chmod(0o555)
    (tmp_path / "scene.toml").write_text(SCENE + f"store = '{store}'\n")
    before = sorted(tmp_path.rglob("*"))
    result = CliRunner().invoke(main, ["mosaic", str(tmp_path / "scene.toml")])
    assert result.exit_code == 1
    assert re.match(r"Error: .*(is not a mosaic of clsas|no such folder|denied)", result.stderr)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("name", ["a{2}", "{", "a{task.fields[x]}", "[bold]a", "[/]"])
def test_a_stores_name_is_shown_as_it_is(monkeypatch, name):
    """On a terminal, beside the progress bar."""
    text = io.StringIO()
    terminal = partial(Console, file=text, force_terminal=True, width=120)
    monkeypatch.setattr(mosaics, "Console", lambda **given: terminal(**given | {"stderr": False}))
    with mosaics._patch_progress(name, 2, 1):
        pass
    assert f"{name} " in re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", text.getvalue())
