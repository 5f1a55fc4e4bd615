"""Command that corrects what two receiver banks have wrong in all pixels: pair-errors."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np

import clsas
from clsas.cli import options
from clsas.cli.inputs import load, load_banks, read_beam
from clsas.cli.outputs import printable, report
from clsas.cli.parameters import HDF5, INPUT, POSITION
from clsas.cli.wording import command
from clsas.core import banks, validate
from clsas.files.scene_files import SceneFile
from clsas.interferometry.pair_errors_result import UNKNOWNS


@command("pair-errors")
@click.argument("lines_file", metavar="LINES.H5", type=INPUT)
@click.argument("heights_file", metavar="HEIGHTS.H5", type=HDF5)
@options.output("Corrected range lines")
@click.option(
    "--known-height-m",
    type=float,
    help="Height of a level seabed above the grid of HEIGHTS.H5 (m).",
)
@click.option(
    "--point",
    "points",
    multiple=True,
    type=POSITION,
    help="Position of a control point on the seabed (m), at z = 0 by default; repeat the option "
    "for several.",
)
@click.option(
    "--other",
    nargs=2,
    type=HDF5,
    metavar="LINES.H5 HEIGHTS.H5",
    help="Range lines of the same sonar on another track, and heights of the same seabed.",
)
@click.option(
    "--known-sd-m",
    type=float,
    default=0.0,
    show_default=True,
    callback=options.checked(partial(validate.number, "known_sd_m", unit="m", least=0.0)),
    help="Standard deviation of known heights (m).",
)
@click.option(
    "--unknown",
    "unknowns",
    multiple=True,
    type=click.Choice(UNKNOWNS),
    help="Error to estimate, the most important first; repeat the option for several. "
    "[default: phase, delay, roll]",
)
@options.tolerance_of_images
@options.beam
@options.device
@options.as_json
def pair_errors(
    lines_file: Path,
    heights_file: Path,
    output: Path,
    known_height_m: float | None,
    points: tuple[tuple[float, ...], ...],
    other: tuple[Path, Path] | None,
    known_sd_m: float,
    unknowns: tuple[str, ...],
    tolerance_db: float,
    device: str | None,
    as_json: bool,
    **given: Any,
) -> None:
    """Correct phase, delay and roll of two receiver banks.

    HEIGHTS.H5 has the heights that clsas heights measured from both banks of LINES.H5. They are
    compared with --known-height-m, with control points, or with heights from another track. Then
    measure the heights again.

    \b
    Example:  clsas pair-errors lines.h5 heights.h5 --known-height-m 0 -o corrected.h5
    """
    beam = read_beam(SceneFile(name=""), given)
    sources = {"--known-height-m": known_height_m, "--point": points, "--other": other}
    used = [option for option, value in sources.items() if value not in (None, ())]
    if len(used) != 1:
        raise click.UsageError(
            "give one of --known-height-m, --point and --other, got "
            + (" and ".join(used) or "none")
        )
    lines, numbers = load_banks(lines_file)
    first, second = (lines.bank(number) for number in numbers)
    found = clsas.pair_errors(
        first, second, load(heights_file, clsas.Heights), known_height_m=known_height_m,
        points_m=[(*point, 0.0)[:3] for point in points] or None,
        other=_measured(*other) if other else None, known_sd_m=known_sd_m,
        unknowns=unknowns or UNKNOWNS, tolerance_db=tolerance_db, beam=beam, device=device,
    )  # fmt: skip
    clsas.save(output, _with_bank(lines, numbers[1], found.corrected(first, second)))
    described = found.describe().replace("\n", "\n  ")
    report(as_json, f"{printable(output)}: {described}", file=output, **found.figures)


def _measured(
    lines_file: Path, heights_file: Path
) -> tuple[clsas.RangeLines, clsas.RangeLines, clsas.Heights]:
    """Return the lines of both banks of a track, and the heights measured from them."""
    lines, (first, second) = load_banks(lines_file)
    return lines.bank(first), lines.bank(second), load(heights_file, clsas.Heights)


def _with_bank(lines: clsas.RangeLines, number: int, bank: clsas.RangeLines) -> clsas.RangeLines:
    """Return lines in which those of one bank have other samples, ranges and receivers."""
    members = banks.members(lines.bank_numbers, number)

    def put(name: str) -> Any:
        values = np.array(getattr(lines, name))
        values[members] = getattr(bank, name)
        return values

    return replace(
        lines, samples=put("samples"), first_range_m=put("first_range_m"), rx_m=put("rx_m")
    )
