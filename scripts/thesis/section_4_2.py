#!/usr/bin/env python3
"""THESIS 4.2: number of operations in its worked example, and in the same plan here."""

import chapter5

from clsas.aperture import nearest

STAGES = [(2, 2), (2, 2)]
SAMPLES = (3757, 1990)  # samples that the subimages of the thesis need in its two stages


def main() -> None:
    given, scene = chapter5.arguments(__doc__)
    channels, pixels = scene.lines.channels, scene.grid.size
    plan = scene.plan(stages=STAGES)
    own = [stage.samples for stage in plan.stages[:-1]]
    cases = {
        "thesis's samples": (nearest.operations(STAGES, 640, SAMPLES, 1024**2), 640 * 1024**2),
        "samples here": (nearest.operations(STAGES, channels, own, pixels), channels * pixels),
    }
    rows = [
        {
            "case": case,
            **{f"stage {i + 1}": f"{count:.0f}" for i, count in enumerate(counts)},
            "total": f"{sum(counts):.0f}",
            "backprojection": exact,
            "ratio": f"{exact / sum(counts):.3f}",
        }
        for case, (counts, exact) in cases.items()
    ]
    chapter5.report(given.out, "section_4_2", rows)
    figure = chapter5.figure()
    axes = figure.subplots()
    bottom = [0.0, 0.0, 0.0]
    names = [*cases, "backprojection"]
    for stage in range(len(STAGES) + 1):
        heights = [counts[stage] for counts, _ in cases.values()] + [0.0]
        axes.bar(names, heights, bottom=bottom, label=f"stage {stage + 1}")
        bottom = [low + height for low, height in zip(bottom, heights, strict=True)]
    axes.bar(names, [0.0, 0.0, channels * pixels], color="grey")
    axes.set(ylabel="operations")
    axes.legend()
    chapter5.save(figure, given.out, "section_4_2")


if __name__ == "__main__":
    main()
