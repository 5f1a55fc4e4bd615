import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import clsas

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """What a wheel built from this checkout installs, unpacked."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", folder, ROOT]
    built = subprocess.run(command, capture_output=True, text=True)
    if built.returncode and "No matching distribution found for hatchling" in built.stderr:
        pytest.skip("building a wheel needs hatchling, and no package index can be reached")
    assert built.returncode == 0, built.stderr
    (archive,) = folder.glob("clsas-*.whl")
    with zipfile.ZipFile(archive) as files:
        files.extractall(folder / "installed")
    return folder / "installed"


@pytest.mark.slow
def test_kernels_scenes_and_types_travel_in_the_wheel(wheel):
    assert {path.name for path in (wheel / "clsas" / "cl").iterdir()} == {
        path.name for path in (ROOT / "cl").iterdir()
    }
    assert (wheel / "clsas" / "scenes" / "thesis_wide_beam.toml").is_file()
    assert (wheel / "clsas" / "py.typed").is_file()
    assert not (wheel / "tests").exists()


@pytest.mark.slow
def test_the_wheel_images_on_its_own(wheel, tmp_path):
    program = """
import sys, clsas
from clsas.opencl.device import kernel_source
print(clsas.__file__)
origin = [[0.0, 0.0, 0.0]]
lines = clsas.RangeLines([[0j, 0j, 1, 0j, 0j]], 1.0, 0.1, origin, origin, 0, 1500)
image = clsas.backproject(lines, clsas.Grid.points([[0.0, 1.2, 0.0]]), taps=2, upsampling=1)
print(abs(image.pixels[0]))
"""
    environment = {**os.environ, "PYTHONPATH": str(wheel)}
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    file, peak = done.stdout.split()
    assert Path(file).is_relative_to(wheel)
    assert float(peak) == pytest.approx(1, abs=1e-3)


def test_versions_agree():
    assert PROJECT["version"] == clsas.__version__


def test_all_holds_every_extra_that_users_need():
    extras = PROJECT["optional-dependencies"]
    (everything,) = re.findall(r"clsas\[(.*)\]", *extras["all"])
    assert set(everything.split(",")) == extras.keys() - {"all", "test", "docs"}


@pytest.mark.parametrize("script", ["scripts/demo", "scripts/test", "scripts/docs", ".ci/run"])
def test_scripts_without_a_python_say_so(script, tmp_path):
    """In a copy of the checkout, so that no environment is there."""
    checkout, tools = tmp_path / "checkout", tmp_path / "bin"
    for name in ("scripts/environment", script):
        (checkout / name).parent.mkdir(parents=True, exist_ok=True)
        (checkout / name).write_bytes((ROOT / name).read_bytes())
    tools.mkdir()
    for tool in ("dirname", "cat", "rm"):
        found = subprocess.run(["which", tool], capture_output=True, text=True, check=True).stdout
        (tools / tool).symlink_to(found.strip())
    done = subprocess.run(
        ["/bin/bash", checkout / script], env={"PATH": str(tools)}, capture_output=True, text=True
    )
    assert done.returncode == 1
    assert "Python 3.11 or later is needed" in done.stderr
    assert "apt install python3 python3-venv" in done.stderr
