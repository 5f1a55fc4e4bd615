"""Command that measures heights of the seabed from two receiver banks: heights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import clsas
from clsas.cli import options
from clsas.cli.inputs import load_banks, load_lines, read_beam, read_grid
from clsas.cli.outputs import described_flags, printable, progress_bar, report
from clsas.cli.parameters import INPUT, File, Output, Store, keep_out
from clsas.cli.wording import command
from clsas.files.hdf5 import SUFFIXES
from clsas.files.height_files import read_heights
from clsas.files.scene_files import SceneFile
from clsas.files.scene_tables import HeightsTable

STORE_SUFFIX = ".zarr"
"""Suffix of the stores of mosaics."""


class _Target(File):
    """An HDF5 file, or a Zarr store, which is a folder."""

    written = True

    def convert(self, value: Any, param: Any, ctx: Any) -> Path:
        """Return the path; a usage error if nothing can be written there."""
        is_store = Path(value).suffix.lower() == STORE_SUFFIX
        kind = Store() if is_store else Output(*SUFFIXES)
        return kind.convert(value, param, ctx)


@command()
@click.argument("first_file", metavar="LINES.H5", type=INPUT)
@click.argument("second_file", metavar="[B.H5]", type=INPUT, required=False)
@click.option(
    "-o",
    "--output",
    type=_Target(),
    required=True,
    help="Heights to write: an HDF5 file, or a Zarr store that is measured patch by patch.",
)
@options.grid
@options.of(clsas.heights, "search_m", into="request", required=True)
@click.option(
    "--relief",
    type=INPUT,
    help="CSV or .npy file of the pixels' heights above the plane in metres, such as a coarse "
    "bathymetry. --search-m then counts from this relief.",
)
@options.of(clsas.heights, "window_m", "tolerance_db", "least_coherence", into="request")
@options.of(
    HeightsTable, "patch_m", into="of_mosaic", beside=f"an output that ends in {STORE_SUFFIX}"
)
@options.beam
@options.device
@options.as_json
def heights(
    first_file: Path,
    second_file: Path | None,
    output: Path,
    scene: Path | None,
    axes: dict[str, Any],
    request: dict[str, Any],
    relief: Path | None,
    of_mosaic: dict[str, Any],
    beam: dict[str, Any],
    device: str | None,
    as_json: bool,
) -> None:
    """Measure the heights of a seabed from two receiver banks.

    LINES.H5 has the range lines of both banks, or those of one if B.H5 has those of the other.
    Of more than two banks in one file, the first two are taken; clsas convert --bank splits a file.
    The grid, from --scene or from --x, --y and --z, is a plane, or a height map from which the
    search starts. Heights are above the plane, and valid where the banks are coherent, and not in
    shadow or layover; the others are NaN.

    If the name of the output ends in .zarr, heights are measured patch by patch, and may be larger
    than memory. After an interruption, the same command continues.

    \b
    Example:  clsas heights lines.h5 --x -2:2:201 --y 30:34:201 --search-m -1:1 -o heights.h5
    """
    is_mosaic = output.suffix.lower() == STORE_SUFFIX
    if of_mosaic and not is_mosaic:
        raise click.UsageError(f"--patch-m requires an output that ends in {STORE_SUFFIX}")
    described, grid = read_grid(scene, axes, memory=not is_mosaic)
    if relief is not None:
        grid = _raised(grid, relief)
    request |= {"beam": read_beam(described, beam), "device": device}
    if is_mosaic:
        keep_out("LINES.H5", first_file, "the store", output)
        # Lines are read in slices, unless they get the sound speed of the scene.
        a: Path | clsas.RangeLines = first_file
        b: Path | clsas.RangeLines | None = second_file
        if described.sound_speed is not None:
            a, b = _both_banks(first_file, second_file, described)
        with progress_bar("measuring heights") as progress:
            store = clsas.mosaic_heights(
                a, b, grid, output, **request, **of_mosaic, progress=progress
            )
        _report_store(store, output, as_json)
        return
    first, second = _both_banks(first_file, second_file, described)
    with progress_bar("measuring heights") as progress:
        found = clsas.heights(first, second, grid, **request, progress=progress)
    clsas.save(output, found)
    results = found.figures
    report(
        as_json,
        f"{printable(output)}: {in_words(results)}\n  coherence "
        f"{results['coherence']:.2f}, windows of {found.window_m:.3g} m with "
        f"{results['looks']:.0f} looks, height of ambiguity {results['ambiguity_m']:.3g} m",
        file=output,
        **results,
    )


def _both_banks(
    first_file: Path, second_file: Path | None, described: SceneFile
) -> tuple[clsas.RangeLines, clsas.RangeLines]:
    """Return the range lines of both banks, from one file or from two."""
    if second_file is not None:
        first, second = (load_lines(each, described) for each in (first_file, second_file))
        return first, second
    remedy = "give the lines of the other bank as a second file"
    lines, both = load_banks(first_file, described, remedy)
    return lines.bank(both[0]), lines.bank(both[1])


def _report_store(store: clsas.Store, output: Path, as_json: bool) -> None:
    """Report the valid share of a mosaic of heights, and the patches with defects."""
    records, (rows, columns) = store.records(), store.patch_shape or (0, 0)
    found = store.overview_heights()
    results = found.figures
    counts = [1 + max(each) for each in zip(*records, strict=True)]
    flagged = {index: record.flags for index, record in records.items() if record.flags}
    lines = [
        f"{printable(output)}: {counts[0]} x {counts[1]} patches of {rows} x {columns} pixels",
        f"  at {found.mask.shape[0]} x {found.mask.shape[1]} pixels, {in_words(results)}",
        *described_flags(flagged),
    ]
    report(
        as_json, "\n".join(lines), file=output, patches=counts, patch_shape=(rows, columns),
        flags={f"{row},{column}": flags for (row, column), flags in flagged.items()}, **results,
    )  # fmt: skip


def _raised(plane: clsas.Grid, relief: Path) -> clsas.Grid:
    """Return a plane with the heights in a file; a usage error unless it is a plane."""
    if not plane.is_planar:
        raise click.UsageError("--relief requires a plane, but the grid of the scene has heights")
    return plane.with_height(read_heights(relief, plane.shape))


def in_words(results: dict[str, Any]) -> str:
    """Return the valid share, the span of heights and the median deviation, in words."""
    valid = f"{100 * results['valid']:.3g} % of {results['pixels']} pixels are valid"
    if results["height_m"] is None:
        return valid
    low_m, high_m = results["height_m"]
    return (
        f"{valid}, {low_m:.3f} to {high_m:.3f} m high, median deviation "
        f"{1e3 * results['median_sd_m']:.3g} mm"
    )
