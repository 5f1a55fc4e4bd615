#!/usr/bin/env python3
"""THESIS figure 37: largest error of a usable image, for 2 to 5 stages.

An image is usable if its -3 dB width in azimuth is within 20 % of the exact one, its highest side
lobe is at most 3 dB higher, and its peak is at most 3 dB lower.
"""

import math
from itertools import combinations_with_replacement, product

import chapter5
from chapter5 import WAVELENGTH_M

MOST_DIVISIONS, MOST_BEAMS = 64, 80  # these leave 16 pixels along each side and 8 lines
PLANS = 12  # for each number of stages
LEAST_M, MOST_M = WAVELENGTH_M / 16, WAVELENGTH_M / 1.5
THESIS = (2, 5), (4, 10)  # stages, and fractions of the wavelength, read from its figure
TOLERANCES_DB = (-10, -12, -15, -20)


def choices(scene: chapter5.Scene, number: int) -> list[chapter5.Stages]:
    """Return plans for a number of stages, whose errors from [45] are evenly spread in log."""
    # High factors come first, as the thesis recommends.
    pairs = sorted(product((2, 3, 4, 5, 6), (2, 4, 8, 16, 32)), reverse=True)
    found = {}
    for stages in combinations_with_replacement(pairs, number - 1):
        beams, divisions = (math.prod(factors) for factors in zip(*stages, strict=True))
        if beams > MOST_BEAMS or divisions > MOST_DIVISIONS:
            continue
        error_m = scene.error_m(stages)
        if LEAST_M <= error_m <= MOST_M:
            found.setdefault(round(error_m, 9), list(stages))
    errors = sorted(found)
    if len(errors) > PLANS:
        ratio = (errors[-1] / errors[0]) ** (1 / (PLANS - 1))
        targets = [errors[0] * ratio**step for step in range(PLANS)]
        errors = sorted({min(errors, key=lambda e: abs(math.log(e / w))) for w in targets})
    return [found[error] for error in errors]


def main() -> None:
    given, scene = chapter5.arguments(__doc__)
    exact = scene.exact_quality
    rows, tried = [], {}
    for number in range(2, 6):
        for stages in choices(scene, number):
            error_m = scene.error_m(stages)
            plan = scene.plan(stages=stages)
            quality = scene.measure(scene.form(plan))
            usable = quality.usable(exact)
            tried.setdefault((number, usable), {})[error_m] = chapter5.name(stages)
            rows.append(
                {
                    "stages": number,
                    "QR x QI": chapter5.name(stages),
                    "eq. 45": chapter5.fraction(error_m),
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
    if given.out.folder:
        chapter5.report(given.out, "figure_37_plans", rows)
    limits, largest = [], {}
    for number in range(2, 6):
        usable, unusable = (tried.get((number, yes), {}) for yes in (True, False))
        least, most = min(unusable, default=math.nan), max(usable, default=math.nan)
        limits.append(
            {
                "stages": number,
                "largest usable error, eq. 45": chapter5.fraction(most),
                "its plan, QR x QI": usable.get(most, ""),
                "least unusable error, eq. 45": chapter5.fraction(least),
                "its plan": unusable.get(least, ""),
                "thesis's limit": {2: "about λ/4", 5: "about λ/10"}.get(number, ""),
            }
        )
        largest[number] = WAVELENGTH_M / most
    chapter5.report(given.out, "figure_37", limits)

    figure = chapter5.figure()
    axes = figure.subplots()
    for row in rows:
        if row["eq. 45"]:
            style = "go" if row["usable"] == "yes" else "rx"
            axes.semilogy(row["stages"], float(row["eq. 45"].removeprefix("λ/")), style)
    axes.plot(largest.keys(), largest.values(), "k-", label="The largest usable of these")
    axes.plot(*THESIS, "b--", label="Ends of the thesis's figure")
    axes.axhline(4, color="grey", linestyle=":", label="λ/4")
    ticks = (1, 2, 3, 4, 6, 8, 12, 16)
    axes.set_yticks(ticks, [f"λ/{tick}" for tick in ticks])
    axes.minorticks_off()
    axes.set(xlabel="Number of stages", ylabel="Error from [45]", xticks=range(2, 6))
    axes.set_title("Nearest beam: usable (o) and not (x)")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=3)
    chapter5.save(figure, given.out, "figure_37")


if __name__ == "__main__":
    main()
