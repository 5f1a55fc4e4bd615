#!/usr/bin/env python3
"""THESIS 4.2: operations of its worked example in both forms of [44], and gamma of each stage."""

import math
import time

import chapter5
from chapter5 import equal_stages

import clsas
from clsas.engine.factorized.virtual_channels import operations

STAGES = [(2, 2), (2, 2)]
SAMPLES = (3757, 1990)  # samples that the subimages of the thesis need in its two stages
LARGEST = 7  # stages for which gamma is measured, the final backprojection included


def as_printed(counts: list[float]) -> list[float]:
    """Return the operations of [44] as it is printed, from those of the worked example.

    The printed sum divides the operations of a stage by the QR of that stage, too.
    """
    shares = [count / beams for count, (beams, _) in zip(counts[:-1], STAGES, strict=True)]
    return [*shares, counts[-1]]


def seconds_of(scene: chapter5.Scene, plan: clsas.Plan) -> list[float]:
    """Return seconds of each stage's kernel, of the final kernels, and outside of kernels."""
    device, stages = scene.device, len(plan.sides)
    start = time.perf_counter()
    with device.profile():
        scene.form(plan)
        device.finish()
        whole_s = time.perf_counter() - start
        events = list(device._events)  # one by one, while `profile` adds them up
    stage_s, final_s = [], []
    for name, event in events:
        seconds = 1e-9 * (event.profile.end - event.profile.start)
        (stage_s if name == "stage" else final_s).append(seconds)
    # Each batch of subimages runs all stages, one after the other.
    found = [sum(stage_s[level::stages]) for level in range(stages)]
    return [*found, sum(final_s), whole_s - sum(stage_s) - sum(final_s)]


def measured_gammas(scene: chapter5.Scene, repeats: int) -> list[dict[str, object]]:
    """Return a row for each stage of the largest plan with QR = QI = 2.

    The time of an operation of plain backprojection converts seconds to operations. Times are the
    shortest of several, since a kernel of a few milliseconds may wait for a core as long again.
    """
    channels, pixels = scene.lines.channels, scene.grid.size
    plan = scene.plan(stages=equal_stages(LARGEST))
    exact_s, runs = [], []
    for _ in range(repeats + 1):
        with scene.device.profile() as times:
            scene.backproject()
        exact_s.append(sum(each.total_s for each in times.values()))
        runs.append(seconds_of(scene, plan))
    unit_s = min(exact_s[1:]) / (channels * pixels)
    seconds = [min(column) for column in zip(*runs[1:], strict=True)]
    rows = []

    def add(stage: object, lines: object, subimages: object, samples: object, count: int) -> None:
        taken_s = seconds[len(rows)]
        gamma = (taken_s / unit_s - count) / channels
        rows.append(
            {
                "stage": stage,
                "lines": lines,
                "subimages": subimages,
                "samples": samples,
                "million operations": f"{count / 1e6:.2f}" if count else "",
                "ms": f"{1e3 * taken_s:.1f}",
                "ns per operation": f"{1e9 * taken_s / count:.2f}" if count else "",
                "γ": f"{gamma:.0f}",
                "γ N over operations": f"{gamma * channels / count:.2f}" if count else "",
            }
        )

    lines, subimages = channels, 1
    for number, stage in enumerate(plan.stages[:-1], start=1):
        subimages *= 4
        add(number, lines, subimages, stage.samples, lines * subimages * stage.samples)
        lines = math.ceil(lines / 2)
    add("backprojection and upsampling", lines, subimages, "", lines * pixels)
    add("outside of kernels", "", "", "", 0)
    print(f"An operation of plain backprojection takes {1e9 * unit_s:.3f} ns")
    return rows


def main() -> None:
    given, scene = chapter5.arguments(__doc__, repeats=15)
    channels, pixels = scene.lines.channels, scene.grid.size
    plan = scene.plan(stages=STAGES)
    own = [stage.samples for stage in plan.stages[:-1]]
    cases = {
        "thesis's": (operations(STAGES, 640, SAMPLES, 1024**2), 640 * 1024**2),
        "here": (operations(STAGES, channels, own, pixels), channels * pixels),
    }
    forms = {"worked example": list, "eq. 44 as printed": as_printed}
    counted = {
        (form, case): (counts(found), exact)
        for form, counts in forms.items()
        for case, (found, exact) in cases.items()
    }
    rows = [
        {
            "form": form,
            "samples": case,
            **{f"stage {i + 1}": f"{count:.0f}" for i, count in enumerate(counts)},
            "total": f"{sum(counts):.0f}",
            "backprojection": exact,
            "ratio": f"{exact / sum(counts):.3f}",
        }
        for (form, case), (counts, exact) in counted.items()
    ]
    chapter5.report(given.out, "section_4_2", rows)
    chapter5.report(given.out, "section_4_2_gamma", measured_gammas(scene, given.repeats))
    figure = chapter5.figure()
    axes = figure.subplots()
    bottom = [0.0] * (len(counted) + 1)
    names = ["\n".join(key) for key in counted] + ["backprojection"]
    for stage in range(len(STAGES) + 1):
        heights = [counts[stage] for counts, _ in counted.values()] + [0.0]
        axes.bar(names, heights, bottom=bottom, label=f"stage {stage + 1}")
        bottom = [low + height for low, height in zip(bottom, heights, strict=True)]
    axes.bar(names, [0.0] * len(counted) + [channels * pixels], color="grey")
    axes.set(ylabel="operations")
    axes.tick_params(axis="x", labelsize="x-small")
    axes.legend()
    chapter5.save(figure, given.out, "section_4_2")


if __name__ == "__main__":
    main()
