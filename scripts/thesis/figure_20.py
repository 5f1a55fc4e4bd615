#!/usr/bin/env python3
"""THESIS figure 20: seconds against error for 2 to 6 stages; and for interpolated plans."""

import math
from functools import partial
from itertools import product

import chapter5

TOLERANCES_DB = (-10, -15, -20, -25, -30, -35, -40, -45, -50)
MOST_DIVISIONS, MOST_BEAMS = 64, 80  # leave 16 pixels a side and 8 lines


def choices(number: int) -> list[chapter5.Stages]:
    """Return plans of some stages: any powers of two in the first stage, then twos.

    High factors belong in the first stage, says the thesis; the fastest are there.
    """
    rest = [(2, 2)] * (number - 2)
    found = [[first, *rest] for first in product((2, 4, 8, 16), (2, 4, 8, 16))]
    return [
        stages
        for stages in found
        if math.prod(beams for beams, _ in stages) <= MOST_BEAMS
        and math.prod(divisions for _, divisions in stages) <= MOST_DIVISIONS
    ]


def main() -> None:
    given, scene = chapter5.arguments(__doc__, repeats=2)
    rows = []
    named = {}
    for number in range(2, 7):
        for stages in choices(number):
            plan = scene.plan(stages=stages)
            named[number, chapter5.name(stages)] = plan, scene.error_m(stages)
    for db in TOLERANCES_DB:
        plan = scene.plan(tolerance_db=db)
        named[len(plan.sides) + 1, f"{db} dB"] = plan, None
    work = {key: partial(scene.form, plan) for key, (plan, _) in named.items()}
    seconds = chapter5.in_turn({"exact": scene.backproject} | work, given.repeats)
    error_db = {key: scene.measure(do()).error_db for key, do in work.items()}
    for (number, name), (_, error_m) in named.items():
        rows.append(
            {
                "stages": number,
                "QR x QI, or tolerance": name,
                "[45] m": f"{error_m:.3e}" if error_m else "",
                "log10": f"{math.log10(error_m):.2f}" if error_m else "",
                "image error dB": f"{error_db[number, name]:.1f}",
                "seconds": f"{seconds[number, name]:.3f}",
            }
        )
    blank = dict.fromkeys(rows[0], "")
    rows.insert(0, blank | {"stages": 1, "seconds": f"{seconds['exact']:.3f}"})
    chapter5.report(given.out, "figure_20", rows)

    figure = chapter5.figure(10, 4.5)
    thesis, ours = figure.subplots(1, 2, sharey=True)
    for number in range(2, 7):
        keys = [key for key in named if key[0] == number and named[key][1]]
        # Of the plans of one error the fastest.
        best = {}
        for key in keys:
            error = round(math.log10(named[key][1]), 6)
            best[error] = min(best.get(error, math.inf), seconds[key])
        thesis.plot(*zip(*sorted(best.items()), strict=True), "o-", label=f"{number} stages")
        measured = [error_db[key] for key in keys]
        ours.plot(measured, [seconds[key] for key in keys], "o", label=f"{number} stages")
    keys = [key for key in named if named[key][1] is None]
    measured = [error_db[key] for key in keys]
    ours.plot(measured, [seconds[key] for key in keys], "k^-", label="interpolated")
    for axes in (thesis, ours):
        axes.axhline(seconds["exact"], color="grey", linestyle=":", label="backprojection")
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    thesis.set(xlabel="log10 of the error by [45] (m)", ylabel="time (s)", ylim=(0, None))
    thesis.set_title("nearest beam: the fastest plan for an error")
    ours.set(xlabel="measured error of the image (dB)", title="every plan, and interpolated ones")
    chapter5.save(figure, given.out, "figure_20", dpi=80)


if __name__ == "__main__":
    main()
