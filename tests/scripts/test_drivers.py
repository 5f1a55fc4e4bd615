"""The parts of scripts/drivers that need no chroot, and the table that it prints."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.fixture
def checkout(tmp_path):
    """A folder with the script, on a machine that cannot make a chroot."""
    (tmp_path / "scripts").mkdir()
    for name in ("drivers", "environment"):
        shutil.copy(SCRIPTS / name, tmp_path / "scripts")
    return tmp_path


def run(checkout, *arguments):
    return subprocess.run(
        ["bash", checkout / "scripts" / "drivers", *arguments], text=True, capture_output=True,
        env={"PATH": "/usr/bin:/bin"}, timeout=60,
    )  # fmt: skip


def test_where_there_is_no_chroot_to_be_had_it_says_why(checkout):
    done = run(checkout, "selftest")  # debootstrap is in /usr/sbin
    assert done.returncode == 77
    assert done.stderr.startswith("Cannot check other drivers here: ")
    assert "root" in done.stderr or "debootstrap is not installed" in done.stderr
    assert not (checkout / ".drivers").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--fast"], "unknown option --fast"),
        (["--turns", "0", "bench"], "--turns must be a whole number of at least 1"),
        (["speed"], "unknown part speed"),
        (["--driver", "cuda"], "--driver must be pypi, pocl, rusticl or rusticl-gpu"),
    ],
)
def test_a_wrong_argument_is_named(checkout, arguments, message):
    done = run(checkout, *arguments)
    assert done.returncode == 1
    assert message in done.stderr


def test_what_was_made_is_removed(checkout):
    (checkout / ".drivers" / "trixie" / "etc").mkdir(parents=True)
    done = run(checkout, "--remove")
    assert done.returncode == 0, done.stderr
    assert [path.name for path in checkout.iterdir()] == ["scripts"]


def test_nothing_is_removed_through_a_mount(checkout):
    kept, mounted = checkout / "kept", checkout / ".drivers" / "trixie" / "dev"
    kept.mkdir()
    (kept / "file").touch()
    mounted.mkdir(parents=True)
    namespace = ["unshare", "--mount", "--propagation", "private", "bash", "-c"]
    if subprocess.run([*namespace, f"mount --bind '{kept}' '{mounted}'"]).returncode:
        pytest.skip("mounts are not allowed here")
    command = f"mount --bind '{kept}' '{mounted}' && bash '{checkout}/scripts/drivers' --remove"
    done = subprocess.run([*namespace, command], text=True, capture_output=True)
    assert done.returncode == 1
    assert "nothing was deleted" in done.stderr
    assert (kept / "file").exists()


def test_the_table_shows_what_every_driver_did(tmp_path):
    results = [{"verdict": "ok"}, {"verdict": "MISSED"}]
    found = {"driver": "25.0.7", "results": results}
    (tmp_path / "rusticl.selftest").write_text(json.dumps(found))
    (tmp_path / "rusticl.tests").write_text("...\n2 failed, 1234 passed, 3 skipped in 9.00s\n")
    (tmp_path / "pocl.selftest").write_text("")
    for driver, factor in (("pypi", 1), ("rusticl", 4)):
        turns = [{"case": "bp-2k", "seconds": {"median": factor * s}} for s in (1.0, 2.0, 9.0)]
        (tmp_path / f"{driver}.bench").write_text("\n".join(map(json.dumps, turns)))
    done = subprocess.run(
        [sys.executable, SCRIPTS / "drivers_table.py", tmp_path], text=True, capture_output=True
    )
    assert done.returncode == 0, done.stderr
    _, _, pypi, pocl, rusticl = (
        [cell.strip() for cell in line.split("|")[1:-1]] for line in done.stdout.splitlines()
    )
    assert [pypi[0], *pypi[5:]] == ["pypi", "2 s (1)", "-"]
    assert [pocl[0], *pocl[3:]] == ["pocl", "ended early", "-", "-", "-"]
    assert rusticl[:2] == ["rusticl", "25.0.7"]
    assert rusticl[3:] == ["1 of 2", "2 failed, 1234 passed", "8 s (4)", "-"]
