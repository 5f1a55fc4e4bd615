#!/usr/bin/env python3
"""THESIS figure 20: imaging time by error for 2 to 6 stages, and for interpolated plans."""

import math
from functools import partial
from itertools import product

import chapter5

TOLERANCES_DB = (-10, -15, -20, -25, -30, -35, -40, -45, -50)
MOST_DIVISIONS, MOST_BEAMS = 64, 80  # these leave 16 pixels along each side and 8 lines


def choices(number: int) -> list[chapter5.Stages]:
    """Return plans for a number of stages: powers of two in the first stage, then twos.

    According to the thesis, high factors belong in the first stage; this gives the fastest plans.
    """
    rest = [(2, 2)] * (number - 2)
    found = [[first, *rest] for first in product((2, 4, 8), (2, 4, 8, 16))]
    return [
        stages
        for stages in found
        if math.prod(beams for beams, _ in stages) <= MOST_BEAMS
        and math.prod(divisions for _, divisions in stages) <= MOST_DIVISIONS
    ]


def main() -> None:
    given, scene = chapter5.arguments(__doc__, repeats=2)
    requests = {
        (number, chapter5.name(stages)): {"stages": stages}
        for number in range(2, 7)
        for stages in choices(number)
    }
    plans = {key: scene.plan(**request) for key, request in requests.items()}
    for db in TOLERANCES_DB:
        plan = scene.plan(tolerance_db=db)
        key = len(plan.sides) + 1, f"{db} dB"
        requests[key], plans[key] = {"tolerance_db": db}, plan
    work = {key: partial(scene.form, plan) for key, plan in plans.items()}
    seconds = chapter5.in_turn({"exact": scene.backproject} | work, given.repeats)
    error_db = {key: scene.scattered.error_db(**request) for key, request in requests.items()}
    error_m = {key: scene.error_m(r["stages"]) for key, r in requests.items() if "stages" in r}

    rows = [{"stages": 1, "QR x QI, or tolerance": "", "eq. 45 m": "", "log10": ""}]
    rows[0] |= {"scene error dB": "", "seconds": f"{seconds['exact']:.3f}"}
    for key in work:
        formula_m = error_m.get(key)
        rows.append(
            {
                "stages": key[0],
                "QR x QI, or tolerance": key[1],
                "eq. 45 m": f"{formula_m:.3e}" if formula_m else "",
                "log10": f"{math.log10(formula_m):.2f}" if formula_m else "",
                "scene error dB": f"{error_db[key]:.1f}",
                "seconds": f"{seconds[key]:.3f}",
            }
        )
    if given.out.folder:
        chapter5.report(given.out, "figure_20_plans", rows)
    # The page shows, for each number of stages, the fastest of the plans with the same error.
    fastest = {}
    for row in rows:
        same = row["stages"], row["log10"] or row["QR x QI, or tolerance"]
        if same not in fastest or float(row["seconds"]) < float(fastest[same]["seconds"]):
            fastest[same] = row
    chapter5.report(given.out, "figure_20", list(fastest.values()))

    figure = chapter5.figure(10, 4.5)
    thesis, ours = figure.subplots(1, 2, sharey=True)
    for number in range(2, 7):
        keys = [key for key in error_m if key[0] == number]
        # Keep the fastest of the plans with the same error.
        best = {}
        for key in keys:
            error = round(math.log10(error_m[key]), 6)
            best[error] = min(best.get(error, math.inf), seconds[key])
        thesis.plot(*zip(*sorted(best.items()), strict=True), "o-", label=f"{number} stages")
        measured = [error_db[key] for key in keys]
        ours.plot(measured, [seconds[key] for key in keys], "o", label=f"{number} stages")
    keys = [key for key in work if key not in error_m]
    measured = [error_db[key] for key in keys]
    ours.plot(measured, [seconds[key] for key in keys], "k^-", label="interpolated")
    for axes in (thesis, ours):
        axes.axhline(seconds["exact"], color="grey", linestyle=":", label="backprojection")
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    thesis.set(xlabel="log10 of the error from [45] (m)", ylabel="Imaging time (s)", ylim=(0, None))
    thesis.set_title("nearest beam: the fastest plan for each error")
    ours.set(
        xlabel="Measured error of an image of 300 points (dB)",
        title="every plan, and interpolated ones",
    )
    chapter5.save(figure, given.out, "figure_20", dpi=80)


if __name__ == "__main__":
    main()
