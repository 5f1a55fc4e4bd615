"""Command that corrects what two receiver banks have wrong in all pixels: pair-errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import clsas
from clsas.cli import options
from clsas.cli.inputs import load_banks, load_heights, read_beam
from clsas.cli.outputs import printable, report
from clsas.cli.parameters import HDF5_OR_STORE, INPUT, keep_out
from clsas.cli.wording import command
from clsas.files.scene_files import SceneFile
from clsas.interferometry.pair_errors_result import with_bank
from clsas.mosaics.store import check_heights


@command("pair-errors")
@click.argument("lines_file", metavar="LINES.H5", type=INPUT)
@click.argument("heights_file", metavar="HEIGHTS", type=HDF5_OR_STORE)
@options.output("Corrected range lines")
@options.of(
    clsas.pair_errors, "known_height_m", "points_m", into="known",
    called={"points_m": ("--point",)},
)  # fmt: skip
@click.option(
    "--other",
    nargs=2,
    type=HDF5_OR_STORE,
    metavar="LINES.H5 HEIGHTS",
    help="Range lines of the same sonar on another track, and heights of the same seabed.",
)
@options.of(
    clsas.pair_errors, "known_sd_m", "unknowns", "tolerance_db", into="request",
    called={"unknowns": ("--unknown",)},
)  # fmt: skip
@options.beam
@options.device
@options.as_json
def pair_errors(
    lines_file: Path,
    heights_file: Path,
    output: Path,
    known: dict[str, Any],
    other: tuple[Path, Path] | None,
    request: dict[str, Any],
    beam: dict[str, Any],
    device: str | None,
    as_json: bool,
) -> None:
    """Correct phase, delay and roll of two receiver banks.

    HEIGHTS has the heights that clsas heights measured from both banks of LINES.H5: an HDF5 file,
    or the store of a mosaic, of which some pixels of every window are read. They are compared with
    --known-height-m, with control points, or with heights from another track. Then measure the
    heights again.

    \b
    Example:  clsas pair-errors lines.h5 heights.h5 --known-height-m 0 -o corrected.h5
    """
    used = ["--point" if name == "points_m" else options.option_of(name) for name in known]
    used += ["--other"] if other else []
    if len(used) != 1:
        raise click.UsageError(
            "give one of --known-height-m, --point and --other, got "
            + (" and ".join(used) or "none")
        )
    if other and other[0].is_dir():
        raise click.UsageError(
            "the first value of --other must be a file of range lines, got the folder "
            f"{str(other[0])!r}"
        )
    for store in (heights_file, *(other or ())[1:]):
        if store.is_dir():
            check_heights(clsas.Store.opened(store))
            keep_out("--output", output, "the store", store)
    lines, numbers = load_banks(lines_file)
    first, second = (lines.bank(number) for number in numbers)
    if other:
        known["other"] = _measured(*other)
    found = clsas.pair_errors(
        first, second, load_heights(heights_file), **known, **request,
        beam=read_beam(SceneFile(name=""), beam), device=device,
    )  # fmt: skip
    clsas.save(output, with_bank(lines, numbers[1], found.corrected(first, second)))
    described = found.describe().replace("\n", "\n  ")
    report(as_json, f"{printable(output)}: {described}", file=output, **found.figures)


def _measured(
    lines_file: Path, heights_file: Path
) -> tuple[clsas.RangeLines, clsas.RangeLines, clsas.Heights]:
    """Return the lines of both banks of a track, and the heights measured from them."""
    lines, (first, second) = load_banks(lines_file)
    return lines.bank(first), lines.bank(second), load_heights(heights_file)
