import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import clsas
from clsas.engine.data import extras

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

IMAGING = """
from dataclasses import replace
import numpy as np
import clsas
from clsas.engine.factorized.costs import Costs

positions_m = np.zeros((64, 3))
positions_m[:, 0] = np.linspace(-0.5, 0.5, 64)
range_m = np.hypot(positions_m[:, 0], 20.0)
step_m, first_m, wavenumber = 0.01, 18.5, 2 * np.pi * 40
at_m = first_m + step_m * np.arange(300) - range_m[:, None]
samples = np.exp(-((at_m / 0.04) ** 2) - 2j * wavenumber * range_m[:, None])
lines = clsas.RangeLines(samples, first_m, step_m, positions_m, positions_m, 40 * 1500, 1500)
grid = clsas.Grid.plane(x=(-0.4, 0.4, 64), y=(19.6, 20.4, 64))
exact = clsas.backproject(lines, grid)
plan = clsas.plan(lines, grid, tolerance_db=-40, costs=Costs(pixel_ns=1e6))
print(plan.describe())
image = clsas.factorize(lines, grid, plan)
assert not plan.is_exact
assert clsas.relative_error_db(image, exact) < -40
assert clsas.relative_error_db(clsas.factorize(lines, grid, -40), exact) < -40
read = clsas.Plan.from_json(plan.to_json())
assert np.array_equal(clsas.factorize(lines, grid, read).pixels, image.pixels)
"""
"""An exact and a factorized image of arrays, and one by a plan that was stored as JSON."""

CORE = """
import sys

ALLOWED = {"clsas", "numpy", "scipy", "pyopencl", *sys.stdlib_module_names}
ALLOWED |= {"pytools", "platformdirs", "siphash24", "typing_extensions"}  # of PyOpenCL

class Blocking:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in ALLOWED and not name.startswith("_"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Blocking())
"""
"""Lets a program import only what a bare installation brings."""


def in_core(program, *arguments):
    """The finished process of a program that can import only what a bare installation brings."""
    command = [sys.executable, "-c", CORE + program, *arguments]
    return subprocess.run(command, capture_output=True, text=True)


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


@pytest.mark.watches("pyproject.toml", "clsas/__init__.py")
def test_kernels_scenes_and_types_travel_in_the_wheel(wheel):
    assert {path.name for path in (wheel / "clsas" / "cl").iterdir()} == {
        path.name for path in (ROOT / "cl").iterdir()
    }
    assert (wheel / "clsas" / "scenes" / "thesis_wide_beam.toml").is_file()
    assert (wheel / "clsas" / "maps" / "page" / "index.html").is_file()
    assert (wheel / "clsas" / "py.typed").is_file()
    assert not (wheel / "tests").exists()


@pytest.mark.watches("pyproject.toml", "clsas/__init__.py")
def test_the_wheel_images_on_its_own(wheel, tmp_path):
    program = """
import sys, clsas
from clsas.engine.device.kernels import kernel_source
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


@pytest.mark.watches("pyproject.toml", "clsas/__init__.py")
def test_a_bare_installation_forms_images(wheel, tmp_path):
    """Only a driver is added to it."""
    (archive,) = wheel.parent.glob("clsas-*.whl")
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "bare"], check=True)
    python = tmp_path / "bare" / "bin" / "python"
    command = [python, "-m", "pip", "install", "--quiet", f"{archive}[pocl]"]
    installed = subprocess.run(command, capture_output=True, text=True)
    if installed.returncode and "No matching distribution found" in installed.stderr:
        pytest.skip("no package index can be reached")
    assert installed.returncode == 0, installed.stderr
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def ran(*command):
        return subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True
        )

    optional = {
        re.split(r"[^\w-]", each)[0] for names in extras.PACKAGES.values() for each in names
    }
    program = f"""
import importlib.util
print({sorted(optional)}, [n for n in {sorted(optional)} if importlib.util.find_spec(n)])
"""
    assert ran(python, "-c", program).stdout.endswith("] ['pyopencl']\n")
    imaged = ran(python, "-c", IMAGING)
    assert imaged.returncode == 0, imaged.stderr
    told = ran(python.with_name("clsas"), "devices")
    assert told.returncode == 1
    assert told.stderr.startswith("Error: click is not installed, and is needed for the command")


@pytest.mark.slow
def test_echoes_and_images_need_numpy_scipy_and_pyopencl_alone():
    program = """
assert clsas.relative_error_db(clsas.wavenumber(lines, grid), exact) < -40
place = clsas.Georeference.local(60.39, 5.32, heading_deg=217)
assert clsas.backproject(replace(lines, georeference=place), grid).georeference == place
history = np.exp(-4j * np.pi * (4e4 + 20 * np.arange(128)) * (20.6 - 20) / 1500)
found = clsas.from_phase_history(
    [history], first_frequency_hz=4e4, frequency_step_hz=20, reference_range_m=20,
    tx_m=[0, 0, 0], rx_m=[0, 0, 0], sound_speed_m_s=1500,
)
peak_m = found.first_range_m[0] + found.range_step_m * np.abs(found.samples[0]).argmax()
assert abs(peak_m - 20.6) < found.range_step_m
sonar = clsas.Sonar(clsas.Pulse(100e3, 20e3, 1e-3), rx_m=[[0, 0, 0]])
track = clsas.Track.straight((0, 0, 0), (1, 0, 0), pings=2, ping_interval_s=0.1)
compressed = clsas.compress(clsas.simulate(sonar, track, clsas.PointTargets([[0, 20, 0]])))
assert abs(np.abs(compressed.samples).max() - 1) < 0.1
"""
    done = in_core(IMAGING + program)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_each_public_name_is_there_or_says_what_to_install():
    program = """
import clsas
for name in clsas.__all__:
    try:
        getattr(clsas, name)
    except ImportError as error:
        print(name, error, sep=": ")
"""
    done = in_core(program)
    assert done.returncode == 0, done.stderr
    said = dict(line.split(": ", 1) for line in done.stdout.splitlines())
    for name, message in said.items():
        pattern = rf"\w+ is not installed, and is needed for clsas\.{name}: pip install '.*'"
        assert re.fullmatch(pattern, message)
    assert said.keys() == {
        *("FileFormatError", "load", "save", "read_airsas", "read_cphd", "read_full_matrix"),
        *("read_phase_history", "write_cphd", "Mosaic", "Patch", "mosaic", "mosaic_heights"),
        *("Processed", "process", "read_sound_speed"),
    }
    assert "'sarkit>=" in said["read_cphd"]
    assert "'zarr>=" in said["mosaic"]


@pytest.mark.slow
def test_calls_say_what_to_install():
    needed, maps = "is not installed, and is needed for", "coordinate reference systems: "
    teos10, sea = "clsas.SoundSpeed.from_teos10", "SoundSpeed.from_teos10: "
    calls = {
        "clsas.to_xarray(grid)": "xarray is not installed, and is needed for to_xarray: ",
        "image.plot()": "matplotlib is not installed, and is needed for pictures: ",
        "clsas.plot.image_db(image)": "matplotlib is not installed, and is needed for pictures: ",
        "clsas.Georeference.projected('EPSG:32632')": f"pyproj {needed} {maps}",
        "place.wkt()": f"pyproj {needed} {maps}",
        "place.to_geographic([0, 1, 2])": f"pyproj {needed} {maps}",
        "clsas.Track.from_geographic([1, 1], [2, 3], 0, 90, [0, 1])": f"pyproj {needed} {maps}",
        f"{teos10}([0, 9], 5, 35, longitude_deg=1, latitude_deg=2)": f"gsw {needed} {sea}",
    }
    program = f"""
import numpy as np
import clsas
track = np.zeros((8, 3))
grid = clsas.Grid.plane(x=(0, 1, 4), y=(9, 10, 4))
image = clsas.Image(np.ones((4, 4), complex), grid)
lines = clsas.RangeLines(np.ones((8, 50), complex), 7.0, 0.1, track, track, 0, 1500)
place = clsas.Georeference.local(60.39, 5.32, heading_deg=217)
for call in {list(calls)}:
    try:
        eval(call)
    except ImportError as error:
        print(error)
"""
    done = in_core(program)
    assert done.returncode == 0, done.stderr
    for said, expected in zip(done.stdout.splitlines(), calls.values(), strict=True):
        assert said.startswith(expected)
        assert "pip install" in said


def test_the_command_says_what_to_install():
    program = "import clsas.__main__ as program; program.run()"
    done = in_core(program, "devices")
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.startswith(
        "Error: click is not installed, and is needed for the command line: pip install 'h5py>="
    )


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


def test_the_table_of_dependencies_names_each_with_its_extra():
    text = (ROOT / "docs" / "contributing.md").read_text()
    rows = re.findall(r"^\| ([\w-]+) \|.*\| (.+) \|$", text, re.MULTILINE)
    table = {name: needs.strip("`") for name, needs in rows if name != "dependency"}
    bare = {re.split(r"[^\w-]", each)[0] for each in PROJECT["dependencies"]}
    assert {name for name, needs in table.items() if needs == "everyone"} == bare
    for extra, requirements in PROJECT["optional-dependencies"].items():
        names = {re.split(r"[^\w-]", each)[0] for each in requirements} - {"clsas"}
        if extra == "pocl":
            assert table["pocl"] == "pocl"
        elif extra not in ("all", "test", "docs"):
            assert {name for name, needs in table.items() if needs == extra} == names
