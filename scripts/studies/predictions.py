"""Predicted and measured times of the benchmarks' cases."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

from clsas.engine.device.device import Device
from clsas.engine.factorized import measured_costs as costs
from clsas.engine.factorized.costs import KnownCosts, predict_exact
from clsas.engine.factorized.plan import costs_in_words
from clsas.engine.factorized.sampled import SampledRoots, SampledScene
from clsas.engine.forming import form_exactly
from clsas.engine.imaging import factorize, plan
from clsas.engine.scene import Scene
from clsas.selftest import cases
from studies.tables import TOLERANCES_DB

COLUMNS = ("case", "dB", "subimages", "predicted s", "measured s: median (min to max)", "ratio")
ACCURACIES_DB = (-50.0, -80.0)
"""Accuracies for the cases of exact imaging."""


def requests(names: Sequence[str] | None = None) -> list[tuple[str, float]]:
    """Return all or some cases with the accuracies or tolerances of the benchmarks, dB."""
    known: dict[str, tuple[float, ...]] = dict.fromkeys(cases.EXACT_CASES, ACCURACIES_DB)
    known |= {case: TOLERANCES_DB.get(case, (-50.0,)) for case in cases.FACTORIZED_CASES}
    return [(case, asked_db) for case in names or known for asked_db in known[case]]


def known_costs(device: Device) -> KnownCosts:
    """Return the costs that a plan would use: stored ones, or else scaled ones."""
    known = costs.load(device)
    return costs.scaled(device) if known.source == "default" else known


def title(device: Device) -> str:
    """Return the device and the origin of its costs."""
    known, info = known_costs(device), device.info
    origin = costs_in_words(known.source, known.measured)
    return f"{info.label}, {info.driver}, {info.compute_units} compute units: {origin}"


def rows(
    device: Device, names: Sequence[str] | None = None, repeats: int = 5
) -> Iterator[list[str]]:
    """Yield a row of the table for every request, with the costs of `known_costs`."""
    known = known_costs(device)
    for case, asked_db in requests(names):
        sides, predicted_s, form = _prepared(case, asked_db, device, known)
        form()  # builds the kernels
        measured_s = [_seconds(form) for _ in range(repeats)]
        median_s = statistics.median(measured_s)
        yield [
            case,
            f"{asked_db:g}",
            sides,
            f"{predicted_s:.3f}",
            f"{median_s:.3f} ({min(measured_s):.3f} to {max(measured_s):.3f})",
            f"{predicted_s / median_s:.3g}",
        ]


def _prepared(
    case: str, asked_db: float, device: Device, known: KnownCosts
) -> tuple[str, float, Callable[[], object]]:
    """Return the sides of the subimages, the predicted time, and a function to form the image."""
    described = (cases.EXACT_CASES | cases.FACTORIZED_CASES)[case]
    lines, grid, beam = described.lines(), described.grid, described.beam
    if case in cases.EXACT_CASES:
        scene = Scene.of(lines, grid, beam, None)
        sampled = SampledScene.of(scene)
        roots = None
        if sampled is not None:
            roots = SampledRoots(sampled, None if beam is None else beam.limits)
        work = predict_exact(scene, asked_db, device, roots).work
        form = partial(form_exactly, lines, grid, beam=beam, accuracy_db=asked_db, device=device)
        return "", float(known.costs.seconds(work)), form
    chosen = plan(lines, grid, tolerance_db=asked_db, beam=beam, device=device, costs=known.costs)
    sides = ", ".join(f"{rows} x {columns}" for rows, columns in chosen.sides)
    # A copy of the plan lacks the geometry of an earlier image.
    return (
        sides or "exact",
        chosen.predicted_seconds,
        lambda: factorize(lines, grid, replace(chosen), device=device),
    )


def _seconds(act: Callable[[], object]) -> float:
    """Return the time that a call takes."""
    start = time.perf_counter()
    act()
    return time.perf_counter() - start
