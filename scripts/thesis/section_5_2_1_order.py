#!/usr/bin/env python3
"""THESIS section 5.2.1, order of factors: the same stages in every order.

If QI/QR is the same in each stage, all orders have the same error by [45]. The thesis puts high
factors first. For interpolated images, the roots and leaves of the fastest plan are kept, and the
stages between them divided in every way.
"""

from __future__ import annotations

import math
from functools import partial
from itertools import permutations, product
from unittest import mock

import chapter5

import clsas
from clsas.engine.factorized import candidates
from clsas.engine.factorized.planner import Request, planned
from clsas.engine.factorized.search import Choices, Division

FACTORS = ((8, 2), (4, 4), (4, 2, 2), (16, 2), (8, 4), (8, 2, 2), (4, 4, 2))  # QR
RATIOS = (1, 2)  # QI over QR, the same in each stage
TOLERANCE_DB = -40.0


def orders(pixels: int) -> dict[str, chapter5.Stages]:
    """Return the stages of nearest beams by name, those of the same factors together."""
    found = [
        [(factor, ratio * factor) for factor in order]
        for ratio, factors in product(RATIOS, FACTORS)
        for order in sorted(set(permutations(factors)), reverse=True)
        if 16 * math.prod(factors) * ratio ** len(factors) <= pixels
    ]
    return {chapter5.name(stages): stages for stages in found}


def divisions(plan: clsas.Plan) -> list[tuple[tuple[int, int], ...]]:
    """Return subimages of two steps from the roots to the leaves of a plan, large factors first."""
    (rows, columns), (leaf_rows, leaf_columns) = plan.sides[0], plan.sides[-1]
    found = [
        ((rows, columns), (rows // by_rows, columns // by_columns), (leaf_rows, leaf_columns))
        for by_rows, by_columns in product((8, 4, 2, 1), (16, 8, 4, 2))
        if rows // leaf_rows % by_rows == 0 and columns // leaf_columns % (2 * by_columns) == 0
    ]
    return sorted(found, key=lambda sides: math.prod(sides[1]))


def with_sides(
    scene: chapter5.Scene, plan: clsas.Plan, sides: tuple[tuple[int, int], ...]
) -> clsas.Plan:
    """Return a plan of the same taps and tolerance with given subimages."""
    factorization = plan.factorization
    taps = factorization.align.taps, factorization.aperture.filter.taps
    request = Request(scene.lines, scene.grid, tolerance_db=TOLERANCE_DB)
    # A search for such trees that finds one, however slow it is.
    object.__setattr__(request, "choices", Choices(stages=(len(sides),)))
    with mock.patch.object(candidates, "search", return_value=Division(sides, *taps)):
        return planned(request, scene.device)[1]


def factors(plan: clsas.Plan) -> str:
    """Return the divisions of subimages between the stages of a plan, rows x columns."""
    return " ".join(
        f"{a // c}x{b // d}" for (a, b), (c, d) in zip(plan.sides, plan.sides[1:], strict=False)
    )


def main() -> None:
    given, scene = chapter5.arguments(__doc__, repeats=7)
    stages = orders(scene.pixels)
    plans = {("nearest", name): scene.plan(stages=each) for name, each in stages.items()}
    chosen = scene.plan(tolerance_db=TOLERANCE_DB)
    if not chosen.is_exact:
        trees = [with_sides(scene, chosen, sides) for sides in divisions(chosen)]
        plans["planned", factors(chosen)] = chosen
        plans |= {("interpolated", factors(plan)): plan for plan in trees}
    scattered = scene.scattered
    images = {key: scattered.form(plan) for key, plan in plans.items()}
    seconds = chapter5.in_turn(
        {key: partial(scattered.form, plan) for key, plan in plans.items()}, given.repeats, min
    )
    rows = []
    for (method, name), plan in plans.items():
        error_m = scene.error_m(stages[name]) if method == "nearest" else 0.0
        rows.append(
            {
                "method": method,
                "order": name,
                "eq. 45": chapter5.fraction(error_m) if error_m else "",
                "million operations": f"{sum(each.operations for each in plan.stages) / 1e6:.1f}",
                "seconds": f"{seconds[method, name]:.3f}",
                "scene error dB": (
                    f"{clsas.relative_error_db(images[method, name], scattered.exact):.1f}"
                ),
                "loss dB": f"{scene.measure(scene.form(plan)).loss_db:.2f}",
            }
        )
    chapter5.report(given.out, "section_5_2_1_order", rows)


if __name__ == "__main__":
    main()
