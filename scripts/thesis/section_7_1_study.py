#!/usr/bin/env python3
"""THESIS section 7.1, angular interpolation: taps, oversampling and stages against time and error.

`clsas.tradeoff` with `study=True`, which is `clsas tradeoff --study`, forms the image of 300 points
with all taps and numbers of stages that keep a tolerance.
"""

from __future__ import annotations

from itertools import product

import chapter5

import clsas
from clsas.engine.factorized.planner import Request, planned
from clsas.measures.tradeoff import STUDIED_DEPTHS, STUDIED_TAPS, Row, Tradeoff

TOLERANCES_DB = (-30.0, -40.0, -50.0)


def rows_of(measured: Tradeoff, tolerance_db: float, taps: tuple[int, int]) -> dict[int, Row]:
    """Return the rows of a study for some taps, by number of stages."""
    start = f"{tolerance_db:g} dB, {taps[0]}+{taps[1]} taps, "
    study = {row.label: row for row in measured.rows if row.method == "study"}
    labels = {depth: f"{start}{depth} stage{'s' * (depth > 1)}" for depth in STUDIED_DEPTHS}
    return {depth: study[label] for depth, label in labels.items() if label in study}


def main() -> None:
    given, scene = chapter5.arguments(__doc__, repeats=3)
    lines, grid, device = scene.scattered.lines, scene.grid, scene.device
    measured = clsas.tradeoff(
        lines, grid, tolerances_db=TOLERANCES_DB, stages=[], device=device,
        repeats=given.repeats, study=True,
    )  # fmt: skip
    rows = []
    for tolerance_db, taps in product(TOLERANCES_DB, STUDIED_TAPS):
        found = rows_of(measured, tolerance_db, taps)
        if not found:
            continue
        depth = min(found, key=lambda each: found[each].seconds)
        best, plans = found[depth], {}
        for name, some in (("best", {"taps": taps, "depth": depth}), ("chosen", {})):
            request = Request(lines, grid, tolerance_db=tolerance_db, **some)
            plans[name] = planned(request, device)[1].method
        kept, chosen = plans["best"], plans["chosen"]
        is_chosen = chosen.sides and taps == (chosen.align.taps, chosen.aperture.filter.taps)
        seconds = {
            f"{each} stage{'s' * (each > 1)}, s": (
                f"{found[each].seconds:.3f}" if each in found else ""
            )
            for each in STUDIED_DEPTHS
        }
        rows.append(
            {
                "tolerance dB": f"{tolerance_db:g}",
                "taps in range": taps[0],
                "taps along the aperture": taps[1],
                "oversampling in range": f"{kept.align.upsampling:.2f}",
                "oversampling along the aperture": f"{kept.aperture.filter.upsampling:.2f}",
                **seconds,
                "error dB": f"{best.error_db:.1f}",
                "chosen": f"{len(chosen.sides)} stages" if is_chosen else "",
            }
        )
    chapter5.report(given.out, "section_7_1_study", rows)


if __name__ == "__main__":
    main()
