#!/usr/bin/env python3
"""THESIS section 7.1, angular interpolation: nearest beams and 2 to 8 taps at equal time or error.

For the six systems of `section_7_1.py`, images are formed by nearest beams and with 2, 4, 6 and 8
taps along the aperture. The plans of nearest beams are those that should be the fastest for their
error, of `plans_of_nearest_beams`.
"""

from __future__ import annotations

import argparse
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import chapter5
import numpy as np
from section_7_1 import SYSTEMS, System

import clsas
from clsas.engine.device.device import Device, open_device
from clsas.engine.factorized.planner import Request, planned
from clsas.engine.factorized.search import Choices
from clsas.measures.tradeoff import REFERENCE_DB

TAPS = (2, 4, 6, 8)
TOLERANCES_DB = (-10.0, -18.0, -28.0, -38.0, -48.0, -58.0)
LEVELS_DB = (-20.0, -30.0, -40.0)  # errors at which times are compared
AT_TAPS, AT_ERROR_DB = 6, -40.0  # image at whose time errors are compared
SAME_TIME = 1.1  # most time of the others, relative to it; else the fastest is compared
MOST_PLANS = 8  # of nearest beams, for each system
EXACT_DB = -40.0  # accuracy of the exact image that is timed


@dataclass(frozen=True)
class Trial:
    """An image: the method's name, how it is divided, and its time and error."""

    method: str
    stages: str
    seconds: float
    error_db: float


def interpolated(system: System, taps: int, tolerance_db: float, device: Device) -> clsas.Plan:
    """Return the plan with some taps along the aperture; any taps in range, any stages."""
    request = Request(system.lines, system.grid, tolerance_db=tolerance_db, beam=system.beam)
    # `clsas.plan` offers 4, 6 and 8 taps only.
    object.__setattr__(request, "choices", Choices(aperture_taps=(taps,)))
    return planned(request, device)[1]


def plans_of_nearest_beams(system: System, device: Device) -> dict[str, clsas.Plan]:
    """Return plans of which none is predicted to be both faster and more accurate than another.

    They have up to three stages of powers of two, high factors first, as the thesis recommends.
    """
    found = []
    for first, rest in product(product((2, 4, 8), (4, 8, 16, 32)), ([], [(2, 2)], [(2, 2)] * 2)):
        stages = [first, *rest]
        divisions = math.prod(divisions for _, divisions in stages)
        if 16 * divisions > system.pixels:
            continue
        plan = clsas.plan(system.lines, system.grid, stages=stages, beam=system.beam)
        found.append((plan.predicted_seconds, plan.predicted_error_db, chapter5.name(stages), plan))
    front, best_db = {}, math.inf
    for seconds, error_db, name, plan in sorted(found, key=lambda each: each[:2]):
        if error_db < best_db and seconds < 2 * plan.exact_seconds:
            front[name], best_db = plan, error_db
    names = list(front)
    some = np.linspace(0, len(names) - 1, min(MOST_PLANS, len(names))).round().astype(int)
    return {names[each]: front[names[each]] for each in some.tolist()}


def trials(system: System, device: Device, repeats: int) -> tuple[list[Trial], float]:
    """Return all images of a system, and the time of the exact one."""
    lines, grid, beam = system.lines, system.grid, system.beam
    plans = {("nearest", name): p for name, p in plans_of_nearest_beams(system, device).items()}
    for taps, tolerance_db in product(TAPS, TOLERANCES_DB):
        plan = interpolated(system, taps, tolerance_db, device)
        if not plan.is_exact:
            plans[f"{taps} taps", f"{tolerance_db:g} dB"] = plan
    reference = clsas.backproject(lines, grid, accuracy_db=REFERENCE_DB, beam=beam, device=device)
    form = {
        key: partial(clsas.factorize, lines, grid, plan, device=device)
        for key, plan in plans.items()
    }
    error_db = {key: clsas.relative_error_db(do(), reference) for key, do in form.items()}
    exactly = partial(
        clsas.backproject, lines, grid, accuracy_db=EXACT_DB, beam=beam, device=device
    )
    seconds = chapter5.in_turn({"exact": exactly} | form, repeats, min)
    found = [
        Trial(
            method,
            name if method == "nearest" else f"{len(plans[method, name].sides)} stages",
            seconds[method, name],
            error_db[method, name],
        )
        for method, name in plans
    ]
    return found, seconds["exact"]


def cells(system: System, found: Sequence[Trial], exact_s: float) -> list[dict[str, object]]:
    """Return the rows of a system's table: for each method, its error and times."""
    goal_s = SAME_TIME * time_to_compare(found) if found else exact_s
    rows = []
    for method in ["nearest", *(f"{taps} taps" for taps in TAPS)]:
        own = [each for each in found if each.method == method]
        if not own:
            continue
        within = [each for each in own if each.seconds <= goal_s]
        best = min(within, key=lambda each: each.error_db, default=None)
        best = best or min(own, key=lambda each: each.seconds)
        row: dict[str, object] = {"system": system.name, "method": method}
        row |= {"about equal time, s": f"{best.seconds:.3f}", "error dB": f"{best.error_db:.1f}"}
        row["stages"] = best.stages
        for level_db in LEVELS_DB:
            kept = [each.seconds for each in own if each.error_db <= level_db]
            row[f"{level_db:g} dB, s"] = f"{min(kept):.3f}" if kept else ""
        rows.append(row | {"exact, s": f"{exact_s:.3f}"})
    return rows


def time_to_compare(found: Sequence[Trial]) -> float:
    """Return the time of the fastest image with 6 taps that is accurate; else of the best one."""
    own = [each for each in found if each.method == f"{AT_TAPS} taps"] or found
    kept = [each.seconds for each in own if each.error_db <= AT_ERROR_DB]
    return min(kept) if kept else min(own, key=lambda each: each.error_db).seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    chapter5.add_output(parser)
    parser.add_argument("--pixels", type=int, help="pixels along each side, instead of 1024")
    parser.add_argument(
        "--system", action="append", choices=[each.name for each in SYSTEMS], help="only this one"
    )
    parser.add_argument("--repeats", type=int, default=3, help="timed runs [default: %(default)s]")
    given = parser.parse_args()
    device = open_device(given.device)
    out = chapter5.Output.of(given, device)
    rows, drawn = [], {}
    for system in SYSTEMS:
        if given.system and system.name not in given.system:
            continue
        if given.pixels:
            system = replace(system, pixels=given.pixels)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", clsas.ClsasWarning)
            found, exact_s = trials(system, device, given.repeats)
        rows += cells(system, found, exact_s)
        drawn[system.name] = found, exact_s
        print(f"{system.name}: {len(found)} images", flush=True)
    chapter5.report(out, "section_7_1_taps", rows)
    draw(drawn, out)


def draw(drawn: dict[str, tuple[list[Trial], float]], out: chapter5.Output) -> None:
    """Draw time over error, for each system and method."""
    figure = chapter5.figure(11, 6.5)
    panels = np.ravel(figure.subplots(2, 3, sharex=True))
    for (name, (found, exact_s)), axes in zip(drawn.items(), panels, strict=False):
        for method in dict.fromkeys(each.method for each in found):
            own = sorted((each.error_db, each.seconds) for each in found if each.method == method)
            style = "ks" if method == "nearest" else "o-"
            axes.semilogy(*zip(*own, strict=True), style, label=method, markersize=4)
        axes.axhline(exact_s, color="grey", linestyle=":", label="exact")
        axes.set_title(name, fontsize="medium")
        axes.set_xlim(5, -65)
        axes.grid(alpha=0.3, which="both")
    figure.supxlabel("Relative rms error (dB)")
    figure.supylabel("Imaging time (s)")
    panels[0].legend(fontsize="small")
    chapter5.save(figure, out, "section_7_1_taps", dpi=90)


if __name__ == "__main__":
    main()
