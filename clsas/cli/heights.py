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
from clsas.core import validate
from clsas.interferometry.heights import LEAST_COHERENCE


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
    callback=options.checked(partial(validate.number, "least_coherence", least=0.1, most=0.99)),
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
    The grid, from --scene or from --x, --y and --z, must be a plane. Heights are valid where the
    banks are coherent, and not in shadow or layover; the others are NaN.

    \b
    Example:  clsas heights lines.h5 --x -2:2:201 --y 30:34:201 --search-m -1:1 -o heights.h5
    """
    described, grid = read_grid(scene, given)
    beam = read_beam(described, given)
    if second_file is None:
        lines = load_lines(first_file, None, described)
        if lines.banks != 2:
            raise ValueError(
                f"{first_file} must hold range lines of 2 receiver banks, got {lines.banks}: give "
                "the lines of the other bank as a second file"
                if lines.banks == 1
                else f"{first_file} must hold range lines of 2 receiver banks, got {lines.banks}: "
                "take two of them by clsas convert --bank"
            )
        first, second = lines.bank(0), lines.bank(1)
    else:
        first, second = (load_lines(each, None, described) for each in (first_file, second_file))
    with progress_bar("measuring heights") as progress:
        found = clsas.heights(
            first, second, grid, search_m=search_m, window_m=window_m, tolerance_db=tolerance_db,
            least_coherence=least_coherence, beam=beam, device=device, progress=progress,
        )  # fmt: skip
    clsas.save(output, found)
    results: dict[str, Any] = {
        "valid": float(found.mask.mean()),
        "window_m": found.window_m,
        "looks": float(np.median(found.looks)),
        "coherence": float(np.median(found.coherence)),
        "ambiguity_m": 2 * np.pi * float(np.median(np.abs(found.m_per_rad))),
    }
    text = f"{100 * results['valid']:.3g} % of {found.mask.size} pixels are valid"
    if found.mask.any():
        known_m = found.height_m[found.mask]
        results["height_m"] = [float(known_m.min()), float(known_m.max())]
        results["median_sd_m"] = float(np.median(found.sd_m[found.mask]))
        text += (
            f", {known_m.min():.3f} to {known_m.max():.3f} m high, median deviation "
            f"{1e3 * results['median_sd_m']:.3g} mm"
        )
    report(
        as_json,
        f"{printable(output)}: {text}\n  coherence {results['coherence']:.2f}, windows of "
        f"{found.window_m:.3g} m with {results['looks']:.0f} looks, height of ambiguity "
        f"{results['ambiguity_m']:.3g} m",
        file=output,
        **results,
    )
