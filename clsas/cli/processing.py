"""Command that takes a recording to a focused image: process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import clsas
from clsas.cli import heights, options
from clsas.cli.inputs import read_scene
from clsas.cli.outputs import printable, report, step_bar
from clsas.cli.parameters import INPUT, keep_apart
from clsas.cli.wording import command
from clsas.interferometry.pair_errors_result import in_words as error_in_words
from clsas.navigation.calibration import in_words as correction_in_words
from clsas.processing.record import StepRecord


@command()
@click.argument("scene", metavar="SCENE.TOML", type=INPUT)
@click.option("--lines", "lines_path", type=INPUT, help="Recording, instead of the scene's.")
@click.option(
    "-o",
    "--output",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder for the results. [default: `output` of the scene, or the name of its file]",
)
@options.of(clsas.process, "steps", into="chosen", called={"steps": ("--step",)})
@options.device
@options.as_json
@options.refusing_unreached
def process(
    scene: Path,
    lines_path: Path | None,
    output: Path | None,
    chosen: dict[str, Any],
    device: str | None,
    as_json: bool,
) -> None:
    """Take a recording to a focused image, step by step.

    The table [process] of the scene names the recording and the steps: inspect, calibrate,
    navigate, focus, pair_errors, image, heights and mosaic. The results go into one folder, where
    process.json records inputs, versions and results of every step. After an interruption the same
    command continues. It repeats a step only if something changed, and replaces only files that its
    record lists.

    \b
    Example:  clsas process scene.toml --lines lines.h5 -o processed
    """
    described = read_scene(scene)
    folder = output or described.process.get("output")
    keep_apart("the recording", lines_path or described.process.get("lines"), "output", folder)
    with step_bar() as progress:
        found = clsas.process(
            described, lines=lines_path, output=folder, **chosen, device=device,
            progress=progress,
        )  # fmt: skip
    rows = [f"  {printable(_row(step, step.name in found.repeated))}" for step in found.steps]
    report(
        as_json,
        "\n".join([f"{printable(found.folder)}:", *rows]),
        folder=found.folder,
        repeated=found.repeated,
        steps={step.name: _figures(step) for step in found.steps},
    )


def _row(step: StepRecord, is_new: bool) -> str:
    """Return the description of a step in a line."""
    done = f"{step.seconds:.2f} s" if is_new else "unchanged"
    files = f": {', '.join(step.files)}" if step.files else ""
    return f"{step.name}, {done}{files}{_in_words(step)}"


def _in_words(step: StepRecord) -> str:
    """Return the most important results of a step, in words."""
    numbers = step.numbers
    if step.name == "inspect":
        count = len(numbers["findings"])
        return f"; {count} finding{'s' * (count != 1)}"
    if step.name in ("calibrate", "pair_errors"):
        shown = correction_in_words if step.name == "calibrate" else error_in_words
        found = zip(numbers["unknowns"], numbers["values"], numbers["sd"], strict=True)
        return "; " + ", ".join(shown(name, value, sd) for name, value, sd in found)
    if step.name == "navigate":
        return (
            f"; {1e3 * numbers['sway_rms_m']:.3g} mm of sway rms, coherence "
            f"{numbers['coherence']:.2f}"
        )
    if step.name == "focus":
        return (
            f"; sharpness {numbers['sharpness_before']:.4g} to {numbers['sharpness_after']:.4g}"
            + ("" if numbers["focused"] else ", left as it was")
        )
    if step.name == "image":
        words = ""
        if "before" in numbers and numbers["peak_db"] is not None:
            gain_db = numbers["peak_db"] - (numbers["before"]["peak_db"] or 0.0)
            words = f"; peak {gain_db:+.1f} dB by the corrections"
        if numbers.get("error") is not None:
            words += f"; {numbers['error']}"
        return words
    if step.name == "heights":
        return f"; {heights.in_words(numbers)}"
    return ""


def _figures(step: StepRecord) -> dict[str, Any]:
    return {
        "seconds": step.seconds, "files": list(step.files), "warnings": list(step.warnings),
        **step.numbers,
    }  # fmt: skip
