#!/usr/bin/env python3
"""THESIS figure 18: imaging time by number of stages, QI = QR = 2, and of interpolated plans."""

from functools import partial

import chapter5
from chapter5 import equal_stages

from clsas.engine.factorized import virtual_channels

TOLERANCES_DB = (-20, -30, -40, -50)


def main() -> None:
    given, scene = chapter5.arguments(__doc__, repeats=5)
    plans = {number: scene.plan(stages=equal_stages(number)) for number in range(2, 8)}
    plans |= {f"{db} dB": scene.plan(tolerance_db=db) for db in TOLERANCES_DB}
    work = {1: scene.backproject} | {k: partial(scene.form, p) for k, p in plans.items()}
    seconds = chapter5.in_turn(work, given.repeats)

    rows, exact = [], scene.lines.channels * scene.grid.size
    for key in work:
        if key == 1:
            stages, operations = 1, exact
        elif key in range(2, 8):
            samples = [stage.samples for stage in plans[key].stages[:-1]]
            counts = (scene.lines.channels, samples, scene.grid.size)
            stages, operations = key, sum(virtual_channels.operations(equal_stages(key), *counts))
        else:
            stages = len(plans[key].sides) + 1
            operations = sum(s.operations for s in plans[key].stages) or exact
        rows.append(
            {
                "plan": "nearest beam" if isinstance(key, int) else f"interpolated, {key}",
                "stages": stages,
                "million operations": f"{operations / 1e6:.1f}",
                "seconds": f"{seconds[key]:.3f}",
                "over backprojection": f"{seconds[1] / seconds[key]:.2f}",
            }
        )
    chapter5.report(given.out, "figure_18", rows)

    figure = chapter5.figure()
    axes = figure.subplots()
    axes.plot(range(1, 8), [seconds[k] for k in range(1, 8)], "o-", label="Nearest beam, 2 x 2")
    for row, key in zip(rows[7:], list(plans)[6:], strict=True):
        axes.plot(row["stages"], seconds[key], "s", label=row["plan"])
    axes.set(
        xlabel="Number of stages (1: backprojection)", ylabel="Imaging time (s)", ylim=(0, None)
    )
    axes.grid(alpha=0.3)
    axes.legend()
    chapter5.save(figure, given.out, "figure_18")


if __name__ == "__main__":
    main()
