"""Descriptions of calls, and the tiny scene and files that the calls use."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.io

import clsas
from clsas.engine.data.extras import is_installed
from clsas.engine.factorized.costs import Costs

RESULTS = (
    "Assessment", "Autofocus", "Calibration", "Certificate", "Effect", "Finding", "Inspection",
    "Limit", "Limits", "Micronavigation",
    "Mosaic", "PairErrors", "Patch", "PhaseSign", "Plan", "Processed", "Tradeoff",
)  # fmt: skip
"""Classes whose constructors check nothing, since only clsas calls them."""

LARGE = ("2.15e+09", "9.22e+18")
"""Numbers of repetitions that are valid, but take too long."""
EMPTY = ("empty list", "empty array")
"""Values that elementwise functions accept, and for which they return an empty result."""


@dataclass(frozen=True)
class Call:
    """A valid call, and special properties of its arguments.

    Attributes
    ----------
    function : callable
    arguments : dict
        By name. Every parameter should be given, so that it is attacked.
    kinds : dict of str to str
        Kinds of arguments, of `api_values`, that their valid values do not show.
    names : dict of str to tuple of str
        Other names by which messages may call an argument.
    accepts : dict of str to tuple of str
        Labels of values that look wrong for an argument's kind but are not.
    skips : dict of str to tuple of str
        Labels of values that say nothing of clsas, such as a user's function that raises.
    may_be_nan : bool
        Whether NaN in the result is documented.
    """

    function: Callable[..., Any]
    arguments: dict[str, Any]
    kinds: Mapping[str, str] = field(default_factory=dict)
    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    accepts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    skips: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    may_be_nan: bool = False


def public() -> list[str]:
    """Return the names of all functions, constructors and methods to attack."""
    found = []
    for name in clsas.__all__:
        value = getattr(clsas, name)
        if name == "plot":
            found += [f"plot.{each}" for each in value.__all__]
        elif not inspect.isclass(value):
            found.append(name)
        elif not issubclass(value, BaseException):
            found += [] if name in RESULTS else [name]
            found += [f"{name}.{method}" for method in _methods(value)]
    return found


def _methods(kind: type) -> Iterator[str]:
    for name in sorted(dir(kind)):
        value = inspect.getattr_static(kind, name)
        if not name.startswith("_") and (callable(value) or isinstance(value, classmethod)):
            yield name


def objects(folder: Path) -> dict[str, Any]:
    """Return objects of many public classes, none of which may replace another."""
    s = scene(folder)
    return {
        "a Grid": s.grid,
        "an Image": s.image,
        "RangeLines": s.lines,
        "a Sonar": s.sonar,
        "a BeamWindow": s.beam,
    }


@dataclass(frozen=True)
class Scene:
    """A sonar with one receiver that passes two points, and the products of its echoes."""

    sonar: clsas.Sonar
    track: clsas.Track
    targets: clsas.PointTargets
    echoes: clsas.Echoes
    lines: clsas.RangeLines
    grid: clsas.Grid
    beam: clsas.BeamWindow
    image: clsas.Image
    plan: clsas.Plan
    seabed: clsas.Seabed


@cache
def scene(folder: Path) -> Scene:
    """Return the scene, which is made once."""
    sonar = clsas.Sonar(
        clsas.Pulse(100e3, 20e3, 1e-3), [[0.0, 0.0, 0.0]], tx_length_m=0.1, rx_length_m=0.1
    )
    track = clsas.Track.straight((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), 40, 0.05)
    targets = clsas.PointTargets([[0.1, 15.0, 0.0], [-0.3, 15.4, 0.0]], [1.0, 0.5])
    echoes = clsas.simulate(sonar, track, targets)
    lines = clsas.compress(echoes)
    grid = clsas.Grid.plane((-0.5, 0.5, 20), (14.6, 15.6, 24))
    beam = clsas.BeamWindow(20.0, "hann", along=[1.0, 0.0, 0.0])
    image = clsas.backproject(lines, grid)
    plan = clsas.plan(lines, grid, stages=[(2, 2)], costs=Costs())
    heights = np.add.outer(0.1 * np.arange(4.0), 0.05 * np.arange(5.0))
    seabed = clsas.Seabed((-1.0, 1.0), (14.0, 16.0), heights, density_m2=20.0)
    return Scene(sonar, track, targets, echoes, lines, grid, beam, image, plan, seabed)


def fields(obj: Any) -> dict[str, Any]:
    """Return the fields of a dataclass as arguments of its constructor."""
    return {each.name: getattr(obj, each.name) for each in dataclasses.fields(obj) if each.init}


def nothing(*_: Any) -> None:
    """Accept a progress report."""


def axes() -> Any:
    from matplotlib.figure import Figure

    return Figure().subplots()


SCENE = """\
[sonar]
rx_m = [[0.0, 0.0, 0.0]]
[sonar.pulse]
carrier_hz = 1e5
bandwidth_hz = 2e4
duration_s = 1e-3
[track]
start_m = [-1.0, 0.0, 0.0]
velocity_m_s = [1.0, 0.0, 0.0]
pings = 40
ping_interval_s = 0.05
[[targets]]
position_m = [0.1, 15.0, 0.0]
[grid]
x = {start_m = -0.5, stop_m = 0.5, count = 20}
y = {start_m = 14.6, stop_m = 15.6, count = 24}
[image]
tolerance_db = -40.0
[process]
lines = "lines.h5"
"""


def write_files(folder: Path) -> None:
    """Write the small files with which readers are attacked."""
    s = scene(folder)
    random = np.random.default_rng(0)
    (folder / "folder").mkdir(exist_ok=True)
    (folder / "empty").write_bytes(b"")
    (folder / "text.txt").write_text("text\n")
    (folder / "scene.toml").write_text(SCENE)
    clsas.save(folder / "lines.h5", s.lines)
    x = np.linspace(-1, 1, 8)
    history = {
        "fp": np.exp(1j * random.normal(size=(16, 8))).astype(np.complex64),
        "freq": 9e9 + 1e6 * np.arange(16.0),
        "r0": np.hypot(30.0, x),
        **dict(zip("xyz", (x, 0 * x + 30, 0 * x), strict=True)),
    }
    scipy.io.savemat(folder / "pass.mat", {"data": history})
    capture = {
        "time_data": random.normal(size=(60, 3)),
        "time": np.arange(60) / 25e6,
        "tx": [1, 1, 2],
        "rx": [1, 2, 2],
        "array": {"el_xc": [0.0, 1e-3], "centre_freq": 5e6},
        "ph_velocity": 6000.0,
    }
    scipy.io.savemat(folder / "capture.mat", {"exp_data": capture})
    shared = folder / "characterization data"
    shared.mkdir(exist_ok=True)
    values = (1e5, 38.2, 4, 10, 1, 2, 3, 30e3, 10e3, 1e-3, 1, 0, 0.1)
    (shared / "acquistionParams.csv").write_text("".join(f"a,{v},unit\n" for v in values))
    (shared / "sensorCoordinates.csv").write_text("0,0,0,1\n1,0.1,0,1\n")
    (folder / "scenes").mkdir(exist_ok=True)
    with h5py.File(folder / "scenes" / "a.h5", "w") as file:
        file["na/position"], file["na/temperature"] = x, np.full((2, 8), 20.0)
        file["ch1/ts"] = random.normal(size=(8, 400))
    if is_installed("sarkit"):
        clsas.write_cphd(folder / "lines.cphd", s.lines)
