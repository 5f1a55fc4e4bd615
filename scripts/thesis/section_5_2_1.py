#!/usr/bin/env python3
"""THESIS 5.2.1: two plans with the same error according to [45], and interpolated plans."""

from functools import partial

import chapter5

STAGES = {"2 stages": [(2, 4)], "3 stages": [(2, 2), (2, 2)]}
TOLERANCES_DB = (-15, -20, -30, -40, -50)


def main() -> None:
    given, scene = chapter5.arguments(__doc__, repeats=5)
    requests = {title: {"stages": stages} for title, stages in STAGES.items()}
    requests |= {f"interpolated, {db} dB": {"tolerance_db": db} for db in TOLERANCES_DB}
    plans = {title: scene.plan(**request) for title, request in requests.items()}
    work = {"backprojection": scene.backproject}
    work |= {title: partial(scene.form, plan) for title, plan in plans.items()}
    seconds = chapter5.in_turn(work, given.repeats)
    rows = []
    for title, do in work.items():
        stages, exact = STAGES.get(title), title == "backprojection"
        quality = scene.exact_quality if exact else scene.measure(do())
        row = {"plan": title, "QR x QI": "", "eq. 45 mm": "", "eq. 45": "", "measured": ""}
        if stages:
            error_m = scene.error_m(stages)
            row |= {
                "QR x QI": chapter5.name(stages),
                "eq. 45 mm": f"{1e3 * error_m:.4f}",
                "eq. 45": chapter5.fraction(error_m),
                "measured": chapter5.fraction(scene.largest_error_m(plans[title])),
            }
        error = "" if exact else f"{scene.scattered.error_db(**requests[title]):.1f}"
        measured = {"scene error dB": error, "seconds": f"{seconds[title]:.3f}"}
        rows.append(row | quality.cells() | measured)
    chapter5.report(given.out, "section_5_2_1", rows)

    figure = chapter5.figure()
    axes = figure.subplots()
    for row in rows[1:]:
        place = float(row["scene error dB"]), float(row["seconds"])
        axes.plot(*place, "^" if not row["eq. 45"] else "o", label=row["plan"])
    axes.axhline(seconds["backprojection"], color="grey", linestyle=":", label="backprojection")
    axes.set(
        xlabel="measured error of an image of 300 points (dB)", ylabel="time (s)", ylim=(0, None)
    )
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    chapter5.save(figure, given.out, "section_5_2_1")


if __name__ == "__main__":
    main()
