#!/usr/bin/env python3
"""THESIS figure 37: the largest error with a usable image, against 2 to 5 stages.

Usable is: -3 dB width in azimuth within 20 % of the exact one, highest side lobe at most 3 dB
higher, peak at most 3 dB lower.
"""

import math
from itertools import product

import chapter5
from chapter5 import WAVELENGTH_M

MOST_DIVISIONS = 64
PLANS = 16  # for a number of stages
LEAST_M, MOST_M = WAVELENGTH_M / 16, WAVELENGTH_M / 1.5
TOLERANCES_DB = (-10, -12, -15, -20)


def choices(scene: chapter5.Scene, number: int) -> list[chapter5.Stages]:
    """Return plans of some stages, with errors by [45] that are spread evenly in logarithm."""
    pairs = list(product((2, 3, 4), (2, 4, 8, 16, 32)))
    found = {}
    for stages in product(pairs, repeat=number - 1):
        divisions = [division for _, division in stages]
        falling = all(a >= b for a, b in zip(stages, stages[1:], strict=False))
        if math.prod(divisions) > MOST_DIVISIONS or not falling:
            continue
        error_m = scene.error_m(stages)
        if LEAST_M <= error_m <= MOST_M:
            found.setdefault(round(error_m, 9), list(stages))
    errors = sorted(found)
    if len(errors) > PLANS:
        ratio = (errors[-1] / errors[0]) ** (1 / (PLANS - 1))
        wanted = [errors[0] * ratio**step for step in range(PLANS)]
        errors = sorted({min(errors, key=lambda e: abs(math.log(e / w))) for w in wanted})
    return [found[error] for error in errors]


def main() -> None:
    given, scene = chapter5.arguments(__doc__)
    exact = scene.exact_quality
    rows, limits = [], {}
    for number in range(2, 6):
        usable_yet = True
        for stages in choices(scene, number):
            error_m = scene.error_m(stages)
            plan = scene.plan(stages=stages)
            quality = scene.measure(scene.form(plan))
            usable = quality.usable(exact)
            usable_yet &= usable
            largest, unusable = limits.get(number, (None, None))
            if usable_yet:
                largest = error_m
            elif unusable is None:
                unusable = error_m
            limits[number] = largest, unusable
            rows.append(
                {
                    "stages": number,
                    "QR x QI": chapter5.name(stages),
                    "[45]": chapter5.fraction(error_m),
                    "measured": chapter5.fraction(scene.largest_error_m(plan)),
                    **quality.cells(),
                    "usable": "yes" if usable else "no",
                }
            )
    for db in TOLERANCES_DB:
        plan = scene.plan(tolerance_db=db)
        quality = scene.measure(scene.form(plan))
        usable = "yes" if quality.usable(exact) else "no"
        row = dict.fromkeys(rows[0], "") | {"stages": len(plan.sides) + 1}
        rows.append(row | {"QR x QI": f"{db} dB"} | quality.cells() | {"usable": usable})
    chapter5.report(given.out, "figure_37", rows)
    for number, (largest, unusable) in limits.items():
        ends = [chapter5.fraction(e) if e else "none" for e in (largest, unusable)]
        print(f"{number} stages: usable up to {ends[0]} by [45], first not usable {ends[1]}")

    figure = chapter5.figure()
    axes = figure.subplots()
    for row in rows:
        if row["[45]"]:
            style = "go" if row["usable"] == "yes" else "rx"
            axes.semilogy(row["stages"], float(row["[45]"].removeprefix("λ/")), style)
    known = [(n, WAVELENGTH_M / largest) for n, (largest, _) in limits.items() if largest]
    if known:
        axes.plot(*zip(*known, strict=True), "k-", label="largest usable error")
    axes.axhline(4, color="grey", linestyle=":", label="λ/4")
    ticks = (1, 2, 3, 4, 6, 8, 12, 16)
    axes.set_yticks(ticks, [f"λ/{tick}" for tick in ticks])
    axes.minorticks_off()
    axes.set(xlabel="number of stages", ylabel="error by [45]", xticks=range(2, 6))
    axes.set_title("nearest beam: usable (o) and not (x)")
    axes.grid(alpha=0.3)
    axes.legend()
    chapter5.save(figure, given.out, "figure_37")


if __name__ == "__main__":
    main()
