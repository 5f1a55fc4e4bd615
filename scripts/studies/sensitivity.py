"""Sensitivity of plans and images to tuned constants, at half and twice their values."""

from __future__ import annotations

import ast
import functools
import importlib
import inspect
import math
import pkgutil
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ClsasWarning
from clsas.engine.device.device import Device
from clsas.engine.factorized.costs import Costs
from clsas.engine.imaging import backproject, factorize, plan
from clsas.selftest import cases
from studies.scaling import scaled

ROOMS = ("engine.factorized", "engine.exact")
MODULES = (
    "clsas.engine.signal.spectrum",
    "clsas.engine.signal.ambiguity",
    "clsas.engine.signal.interpolation",
)
FIXED = {
    "clsas.engine.factorized.measured_costs": "measures costs, which are given for the cases",
    "clsas.engine.exact.wavenumber": "another imager, which has its own tool",
    "STACK HELD CHUNK GUARD PHASES _GROUP _FINE VECTOR_ROOM": "layouts that kernels share",
    "_FAR _LARGEST_HALF _LEAST_HALF _MOST_EXPONENT _SINGULAR": "limits of number formats",
    "_PERPENDICULAR": "separates rounding from geometry",
    "MOST_TAPS": "follows from UPSAMPLING_TAPS",
    "WORST_TOLERANCE_DB BEST_ACCURACY_DB": "limits of input",
    "_READOUT_BYTES _READOUT_LINES": "memory of lines read on the host, outside of images",
    "ACCURACY_DB TOLERANCE_DB NEAREST_UPSAMPLING": "defaults of the interface",
}
"""Modules and constants that are not varied, and why."""

_SLOW_EXACT = Costs(pixel_ns=1e3, point_ns=1e3)  # so that small images are factorized
_REFERENCE_DB = -80.0
_RUNS = 3  # runs, of which the fastest counts


@dataclass(frozen=True)
class Constant:
    """A number at the top level of a module."""

    module: ModuleType
    name: str

    @property
    def value(self) -> float:
        """Present value of the constant."""
        value: float = getattr(self.module, self.name)
        return value

    @property
    def neighbours(self) -> tuple[float, float]:
        """Half and twice the value; for decibels, half and twice the power."""
        if self.name.endswith("_DB"):
            return self.value - 3.0, self.value + 3.0
        if isinstance(self.value, int):
            return max(self.value // 2, 1), 2 * self.value
        return self.value / 2, 2 * self.value

    @contextmanager
    def set_to(self, value: float) -> Iterator[None]:
        """Set another value, also in modules that import it; clear caches before and after."""
        before = self.value
        users = [self.module, *(m for m in _loaded() if self.name in _imported(m, self.module))]
        for module in users:
            setattr(module, self.name, value)
        _clear_caches()
        try:
            yield
        finally:
            for module in users:
                setattr(module, self.name, before)
            _clear_caches()


@dataclass(frozen=True)
class Trial:
    """A scene to plan and, if it is small, to image.

    Attributes
    ----------
    tolerance_db : float
    lines, grid, beam
    costs : Costs
    device : Device
    exact : bool
        True to form an exact image with the accuracy `tolerance_db` instead.
    reference : complex64 or None
        Exact image of -80 dB with which images are compared; None to make plans only.
    """

    tolerance_db: float
    lines: RangeLines
    grid: Grid
    beam: BeamWindow | None
    costs: Costs
    device: Device
    exact: bool = False
    reference: Any = None

    def run(self) -> Result:
        """Return the result of planning and, if there is a reference, of imaging."""
        predicted_s = predicted_db = measured_s = measured_db = planning_s = math.nan
        chosen = None
        if not self.exact:
            start = time.process_time()
            chosen = plan(
                self.lines,
                self.grid,
                tolerance_db=self.tolerance_db,
                beam=self.beam,
                device=self.device,
                costs=self.costs,
            )
            planning_s = time.process_time() - start
            predicted_s, predicted_db = chosen.predicted_seconds, chosen.predicted_error_db
        if self.reference is not None:
            image = self._form(chosen)
            measured_db = relative_error_db(image, self.reference)
            # On a busy machine, processor time scatters less than elapsed time.
            clock = time.process_time if self.device.info.kind == "cpu" else time.perf_counter
            measured_s = min(_seconds(lambda: self._form(chosen), clock) for _ in range(_RUNS))
        return Result(predicted_s, predicted_db, measured_s, measured_db, planning_s)

    def _form(self, chosen: Any) -> Any:
        if self.exact:
            form = functools.partial(backproject, accuracy_db=self.tolerance_db, beam=self.beam)
            return form(self.lines, self.grid, device=self.device)
        return factorize(self.lines, self.grid, replace(chosen), device=self.device)


@dataclass(frozen=True)
class Result:
    """Result of a trial: seconds, and errors in dB; NaN if nothing was planned or formed."""

    predicted_s: float
    predicted_db: float
    measured_s: float
    measured_db: float
    planning_s: float


def constants(patterns: Sequence[str] = ("",)) -> list[Constant]:
    """Return all tuned constants whose module and name contain one of some texts."""

    def chosen(name: str) -> bool:
        return any(pattern in name for pattern in patterns)

    found = []
    packages = [importlib.import_module(f"clsas.{room}") for room in ROOMS]
    names = [f"{p.__name__}.{m.name}" for p in packages for m in pkgutil.iter_modules(p.__path__)]
    fixed = {word for words in FIXED for word in words.split()}
    for name in (*names, *MODULES):
        module = importlib.import_module(name)
        if name in fixed:
            continue
        for each in _assigned(module):
            value = getattr(module, each)
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if number and value and each not in fixed and chosen(f"{name}.{each}"):
                found.append(Constant(module, each))
    return found


def trials(device: Device) -> list[Trial]:
    """Return the scenes: large ones to plan only, and small ones to image too."""
    found = []

    def add(case: cases.Case, tolerance_db: float, costs: Costs, **others: Any) -> None:
        measured, exact = others.pop("measured", False), others.pop("exact", False)
        lines = replace(case.lines(), **others)
        reference = None
        if measured:
            reference = backproject(
                lines, case.grid, device=device, beam=case.beam, accuracy_db=_REFERENCE_DB
            )
        found.append(
            Trial(tolerance_db, lines, case.grid, case.beam, costs, device, exact, reference)
        )

    large, medium, small = (scaled(size) for size in (2048, 512, 256))
    add(large, -50.0, Costs())
    add(replace(large, beam=None), -30.0, Costs())
    add(replace(medium, depth_m=20.0, relief_m=1.0), -50.0, _SLOW_EXACT)
    # The samples of a straight track serve for other tracks too: plans depend on the geometry.
    position_m = medium.lines().tx_m
    sway_m = np.zeros_like(position_m)
    sway_m[:, 1:] = 0.05 * np.sin(position_m[:, :1] / [2.0, 3.0])
    swaying = position_m + sway_m
    add(replace(medium, beam=None), -40.0, _SLOW_EXACT, tx_m=swaying, rx_m=swaying)
    apart_m, velocity_m_s = np.array([0.5, 0.0, 0.0]), np.array([2.0, 0.0, 0.0])
    add(
        medium,
        -50.0,
        _SLOW_EXACT,
        rx_m=position_m + apart_m,
        rx_velocity_m_s=np.broadcast_to(velocity_m_s, position_m.shape),
    )
    # A rough track with a gap; then noise in the whole band, which does not fade at the ends.
    random = np.random.default_rng(0)
    rough_m = position_m + random.standard_normal(position_m.shape) * [0.0, 2e-3, 2e-3]
    rough_m[:, 1] += 0.3 * np.sin(position_m[:, 0])
    rough_m[len(rough_m) // 2 :, 0] += 2.0
    add(medium, -30.0, _SLOW_EXACT, tx_m=rough_m, rx_m=rough_m)
    shape = (medium.channels, 200)
    noise = (random.standard_normal((*shape, 2)) @ [1, 1j]).astype(np.complex64)
    add(replace(medium, beam=None), -32.0, _SLOW_EXACT, samples=noise, first_range_m=45.0)
    add(small, -50.0, _SLOW_EXACT, measured=True)
    add(replace(small, beam=BeamWindow(20.0)), -35.0, _SLOW_EXACT, measured=True)
    add(replace(small, beam=None), -60.0, _SLOW_EXACT, measured=True)
    add(small, -50.0, Costs(), measured=True, exact=True)
    return found


def changes(device: Device, patterns: Sequence[str] = ("",)) -> Iterator[list[str]]:
    """Yield a row for every constant and each of two other values, with changes over all scenes.

    The columns are `COLUMNS`.
    """
    warnings.simplefilter("ignore", ClsasWarning)
    scenes = trials(device)
    for scene in scenes:  # builds the kernels
        scene.run()
    usual = [_best(scene) for scene in scenes]
    for constant in constants(patterns):
        name = f"{constant.module.__name__.removeprefix('clsas.engine.')}.{constant.name}"
        for other in sorted({*constant.neighbours} - {constant.value}):
            row = [name, f"{constant.value:.4g}", f"{other:.4g}"]
            with constant.set_to(other):
                try:
                    found = [scene.run() for scene in scenes]
                except Exception as error:  # a value that breaks something is a finding too
                    yield [*row, f"{type(error).__name__}: {str(error)[:60]}", *[""] * 4]
                    continue
            yield [*row, *_compared(usual, found)]


def _best(scene: Trial) -> Result:
    """Return the result for a scene, with the least times of several runs."""
    runs = [scene.run() for _ in range(_RUNS)]
    least = {name: min(getattr(r, name) for r in runs) for name in ("measured_s", "planning_s")}
    return replace(runs[0], **least)


COLUMNS = (
    "constant",
    "value",
    "set to",
    "predicted seconds, %",
    "predicted error, dB",
    "measured seconds, %",
    "measured error, dB",
    "planning, %",
)


def _compared(usual: list[Result], found: list[Result]) -> list[str]:
    """Return the cells of a row: the ranges of changes."""

    def span(values: list[float], least: float) -> str:
        kept = [value for value in values if not math.isnan(value)]
        low, high = min(kept), max(kept)
        if max(abs(low), abs(high)) < least:
            return ""
        return f"{low:+.3g}" if high - low < least else f"{low:+.3g} to {high:+.3g}"

    def percent(of: Callable[[Result], float]) -> list[float]:
        pairs = zip(usual, found, strict=True)
        return [100 * (of(after) / of(before) - 1) for before, after in pairs]

    def decibels(of: Callable[[Result], float]) -> list[float]:
        return [of(after) - of(before) for before, after in zip(usual, found, strict=True)]

    planning = [sum(r.planning_s for r in each if r.planning_s > 0) for each in (usual, found)]
    return [
        span(percent(lambda r: r.predicted_s), 0.5),
        span(decibels(lambda r: r.predicted_db), 0.05),
        span(percent(lambda r: r.measured_s), 15.0),
        span(decibels(lambda r: r.measured_db), 0.05),
        span([100 * (planning[1] / planning[0] - 1)], 10.0),
    ]


def _seconds(call: Callable[[], object], clock: Callable[[], float]) -> float:
    start = clock()
    call()
    return clock() - start


def _assigned(module: ModuleType) -> list[str]:
    """Return names in capitals that a module assigns at its top level."""
    names = []
    for node in ast.parse(inspect.getsource(module)).body:
        if isinstance(node, ast.Assign):
            names += [n.id for t in node.targets for n in ast.walk(t) if isinstance(n, ast.Name)]
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names.append(node.target.id)
    return [name for name in names if name.isupper()]


@functools.cache
def _imported(module: ModuleType, source: ModuleType) -> frozenset[str]:
    """Return the names that a module imports from another one."""
    nodes = ast.parse(inspect.getsource(module)).body
    return frozenset(
        alias.name
        for node in nodes
        if isinstance(node, ast.ImportFrom) and node.module == source.__name__
        for alias in node.names
    )


def _loaded() -> list[ModuleType]:
    return [m for name, m in list(sys.modules.items()) if name.startswith("clsas.")]


def _clear_caches() -> None:
    """Clear the caches of the library's functions, whose results may depend on a constant."""
    for module in _loaded():
        for value in list(vars(module).values()):
            if value is not _imported and hasattr(value, "cache_clear"):
                value.cache_clear()
