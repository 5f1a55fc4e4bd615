"""Command that measures heights of the seabed from two receiver banks: heights."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np

import clsas
from clsas.cli import options
from clsas.cli.inputs import load_lines, read_beam, read_grid
from clsas.cli.outputs import printable, progress_bar, report
from clsas.cli.parameters import INPUT, Parsed
from clsas.core import banks, validate
from clsas.interferometry.checks import checked_coherence
from clsas.interferometry.heights import LEAST_COHERENCE
from clsas.processing import numbers


def _heights(text: str) -> tuple[float, float]:
    low, high = map(float, text.split(":"))
    if not (np.isfinite([low, high]).all() and low < high):
        raise ValueError
    return low, high


_SEARCH = Parsed("LOW:HIGH", _heights, "LOW:HIGH, two ascending heights in metres, such as -1:2")


@click.command()
@click.argument("first_file", metavar="LINES.H5", type=INPUT)
@click.argument("second_file", metavar="[B.H5]", type=INPUT, required=False)
@options.output("Heights")
@options.grid
@click.option(
    "--search-m",
    type=_SEARCH,
    required=True,
    help="Heights above the grid between which the seabed lies (m).",
)
@click.option(
    "--window-m",
    type=float,
    callback=options.checked(partial(validate.positive, "window_m", unit="m")),
    help="Side of the windows, the resolution of the heights (m). [default: that of about 50 "
    "independent samples]",
)
@click.option(
    "--tolerance-db",
    type=float,
    default=-40.0,
    show_default=True,
    callback=options.check_tolerance_db,
    help="Largest relative rms error of the images (dB).",
)
@click.option(
    "--least-coherence",
    type=float,
    default=LEAST_COHERENCE,
    show_default=True,
    callback=options.checked(checked_coherence),
    help="Smallest coherence of a valid height.",
)
@options.beam
@options.device
@options.as_json
def heights(
    first_file: Path,
    second_file: Path | None,
    output: Path,
    scene: Path | None,
    search_m: tuple[float, float],
    window_m: float | None,
    tolerance_db: float,
    least_coherence: float,
    device: str | None,
    as_json: bool,
    **given: Any,
) -> None:
    """Measure the heights of a seabed from two receiver banks.

    LINES.H5 holds the range lines of both banks, or those of one if B.H5 holds those of the other.
    Of more than two banks in one file, the first two are taken; clsas convert --bank splits a file.
    The grid, from --scene or from --x, --y and --z, must be a plane. Heights are valid where the
    banks are coherent, and not in shadow or layover; the others are NaN.

    \b
    Example:  clsas heights lines.h5 --x -2:2:201 --y 30:34:201 --search-m -1:1 -o heights.h5
    """
    described, grid = read_grid(scene, given)
    beam = read_beam(described, given)
    if second_file is None:
        lines = load_lines(first_file, None, described)
        try:
            first, second = banks.pair(lines)
        except ValueError as error:
            raise ValueError(
                f"{first_file} {error}: give the lines of the other bank as a second file"
            ) from None
    else:
        first, second = (load_lines(each, None, described) for each in (first_file, second_file))
    with progress_bar("measuring heights") as progress:
        found = clsas.heights(
            first, second, grid, search_m=search_m, window_m=window_m, tolerance_db=tolerance_db,
            least_coherence=least_coherence, beam=beam, device=device, progress=progress,
        )  # fmt: skip
    clsas.save(output, found)
    results = numbers.of_heights(found)
    report(
        as_json,
        f"{printable(output)}: {in_words(results)}\n  coherence "
        f"{results['coherence']:.2f}, windows of {found.window_m:.3g} m with "
        f"{results['looks']:.0f} looks, height of ambiguity {results['ambiguity_m']:.3g} m",
        file=output,
        **results,
    )


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
