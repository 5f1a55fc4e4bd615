"""Tuning: effect of the sizes of batches and work-groups on imaging times of a device."""

from __future__ import annotations

import importlib
import statistics
import time
from collections.abc import Callable, Iterator

from clsas.engine.data.image import Image
from clsas.engine.device.device import Device
from clsas.engine.imaging import backproject, factorize, plan
from clsas.selftest.cases import FFBP_2K, Case
from studies.sensitivity import Constant

COLUMNS = ("constant", "set to", "exact, s", "over usual", "factorized, s", "over usual")
FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Values to which each constant is set, over its usual value."""

_TOLERANCE_DB = -50.0
_RUNS = 3  # runs, of which the median counts


def constants(device: Device) -> list[Constant]:
    """Return the constants that affect imaging times on a device."""
    batch = "_CACHED_BYTES" if device.info.kind == "cpu" else "_BATCH_BYTES"
    names = [
        ("exact.run", "_CHANNELS_AT_ONCE"),
        ("exact.run", "_PART_BYTES"),
        ("factorized.costs", batch),
        ("factorized.stages", "_GROUPS_PER_UNIT"),
    ]
    if device.info.width == 1:
        names += [("factorized.stages", "_GROUP"), ("device.buffers", "_LINE_ITEMS")]
    return [Constant(importlib.import_module(f"clsas.engine.{room}"), name) for room, name in names]


def changes(device: Device, case: Case = FFBP_2K) -> Iterator[list[str]]:
    """Yield a row for every constant and value, with the times of an exact and a factorized image.

    The values of a constant take turns. The columns are `COLUMNS`.

    Parameters
    ----------
    device : Device
    case : Case
    """
    lines, grid, beam = case.lines(), case.grid, case.beam

    def exact() -> Image:
        return backproject(lines, grid, beam=beam, accuracy_db=_TOLERANCE_DB, device=device)

    def factorized() -> Image:
        chosen = plan(lines, grid, tolerance_db=_TOLERANCE_DB, beam=beam, device=device)
        return factorize(lines, grid, chosen, device=device)

    imagers = (exact, factorized)
    for form in imagers:
        form()  # builds the kernels
    for constant in constants(device):
        values = sorted({max(type(constant.value)(constant.value * f), 1) for f in FACTORS})
        seconds = {(value, form): [0.0] * _RUNS for value in values for form in imagers}
        for number in range(_RUNS):
            for (value, form), times in seconds.items():
                with constant.set_to(value):
                    times[number] = _seconds(form)
        medians = {key: statistics.median(times) for key, times in seconds.items()}
        name = f"{constant.module.__name__.removeprefix('clsas.engine.')}.{constant.name}"
        for value in values:
            cells = []
            for form in imagers:
                found, usual = medians[value, form], medians[constant.value, form]
                cells += [f"{found:.4g}", f"{found / usual:.2f}"]
            yield [name, f"{value:g}", *cells]


def _seconds(form: Callable[[], Image]) -> float:
    start = time.perf_counter()
    form()
    return time.perf_counter() - start
