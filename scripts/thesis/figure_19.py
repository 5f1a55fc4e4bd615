#!/usr/bin/env python3
"""THESIS figure 19: range error by number of stages, QI = QR = 2, from [45] and measured."""

import math

import chapter5
import numpy as np
from chapter5 import WAVELENGTH_M, equal_stages

TOLERANCE_DB = -40


def in_metres(error_db: float) -> float:
    """Return the bound of uniformly distributed range errors that cause an image error, metres."""
    return WAVELENGTH_M * math.sqrt(3) / (4 * math.pi) * 10 ** (error_db / 20)


def main() -> None:
    given, scene = chapter5.arguments(__doc__)
    rows, by_formula, largest = [], [0.0], [0.0]
    for number in range(2, 8):
        stages = equal_stages(number)
        plan = scene.plan(stages=stages)
        by_formula.append(scene.error_m(stages))
        errors_m = scene.range_errors_m(plan)
        largest.append(np.abs(errors_m).max())
        quality = scene.measure(scene.form(plan))
        rows.append(
            {
                "stages": number,
                "eq. 45 mm": f"{1e3 * by_formula[-1]:.4f}",
                "eq. 45": chapter5.fraction(by_formula[-1]),
                "measured mm": f"{1e3 * largest[-1]:.4f}",
                "measured": chapter5.fraction(largest[-1]),
                "measured/eq. 45": f"{largest[-1] / by_formula[-1]:.3f}",
                "rms/eq. 45": f"{np.sqrt(np.mean(errors_m**2)) / by_formula[-1]:.3f}",
                **quality.cells(),
            }
        )
    plan = scene.plan(tolerance_db=TOLERANCE_DB)
    quality = scene.measure(scene.form(plan))
    interpolated_m = in_metres(quality.error_db)
    blank = dict.fromkeys(rows[0], "")
    name = f"{len(plan.sides) + 1}, interpolated"
    measured = {"measured mm": f"{1e3 * interpolated_m:.4f}"}
    measured["measured"] = chapter5.fraction(interpolated_m)
    rows.append(blank | {"stages": name} | measured | quality.cells())
    chapter5.report(given.out, "figure_19", rows)

    figure = chapter5.figure()
    axes = figure.subplots()
    numbers = np.arange(1, 8)
    axes.plot(numbers, by_formula, "o-", label="Nearest beam, from [45]")
    axes.plot(numbers, largest, "s-", label="Nearest beam, largest measured")
    label = f"Interpolated, {TOLERANCE_DB} dB: from the image error"
    axes.plot(len(plan.sides) + 1, interpolated_m, "^", label=label)
    axes.axhline(WAVELENGTH_M / 4, color="grey", linestyle=":", label="λ/4")
    axes.set(xlabel="Number of stages (1: backprojection)", ylabel="Range error (m)")
    axes.grid(alpha=0.3)
    axes.legend()
    chapter5.save(figure, given.out, "figure_19")


if __name__ == "__main__":
    main()
