"""Commands that correct a track from the echoes: known-points, navigate, focus."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

import clsas
from clsas.cli import options
from clsas.cli.inputs import load, read_beam, read_grid
from clsas.cli.outputs import printable, progress_bar, report
from clsas.cli.parameters import INPUT
from clsas.cli.wording import command


@command("known-points")
@click.argument("lines_file", metavar="LINES.H5", type=INPUT)
@options.output("Corrected range lines")
@options.of(
    clsas.calibrate_track, "points_m", into="how", called={"points_m": ("--point",)}, required=True
)
@options.of(
    clsas.calibrate_track, "unknowns", "search_m", into="how", called={"unknowns": ("--unknown",)}
)
@options.as_json
def known_points(
    lines_file: Path,
    output: Path,
    how: dict[str, Any],
    as_json: bool,
) -> None:
    """Correct timing, sound speed and lever arm by known points.

    The ranges of all reflectors are measured in all channels and fitted together. The lever arm
    (forward, port, up) is a displacement along, across and above the track. LINES.H5 may also be a
    recording of another kind.

    \b
    Example:  clsas known-points lines.h5 --point 3,12 --point 5,19,-1 -o corrected.h5
    """
    lines = load(lines_file, clsas.RangeLines)
    with progress_bar("measuring ranges") as progress:
        found = clsas.calibrate_track(lines, **how, progress=progress)
    clsas.save(output, found.lines)
    results = found.figures
    seen = ", ".join(map(str, results["seen"]))
    report(
        as_json,
        f"{printable(output)}: {found.describe()}\n  seen in {seen} channels; ± covers noise and "
        "errors that change along the track, but no displacement or bend of the whole track",
        file=output,
        **results,
    )


@command()
@click.argument("lines_file", metavar="LINES.H5", type=INPUT)
@options.output("Corrected range lines")
@options.of(
    clsas.micronavigate, "range_m", "window_m", "side", "seabed_z_m", "element_length_m",
    "sway_sd_m", "yaw_sd_deg", "surge_sd_m", "unknowns", into="how",
    called={"unknowns": ("--unknown",)},
)  # fmt: skip
@options.as_json
def navigate(
    lines_file: Path,
    output: Path,
    how: dict[str, Any],
    as_json: bool,
) -> None:
    """Correct the track of an array by micronavigation.

    The phase centres of the array must overlap from ping to ping (displaced phase centres). Sway,
    yaw and surge between pings are measured from the echoes that both pings share, and combined
    with the navigation data.

    \b
    Example:  clsas navigate lines.h5 --range-m 30:60 --element-length-m 0.015 -o corrected.h5
    """
    lines = load(lines_file, clsas.RangeLines)
    with progress_bar("navigating") as progress:
        found = clsas.micronavigate(lines, **how, progress=progress)
    clsas.save(output, found.lines)
    results = found.figures
    shape_m = results["shape_sd_m"]
    shape = "unknown" if np.isnan(shape_m) else f"at most {1e3 * shape_m:.3g} mm"
    report(
        as_json,
        f"{printable(output)}: {results['pings']} pings, {results['overlap']} overlapping phase "
        f"centres or more, median coherence {results['coherence']:.2f}\n"
        f"  corrected by {1e3 * results['sway_rms_m']:.3g} mm of sway, "
        f"{np.degrees(results['yaw_rms_rad']):.3g} degrees of yaw and "
        f"{1e3 * results['surge_rms_m']:.3g} mm of surge, rms\n"
        f"  standard deviation per ping {1e6 * results['sway_step_sd_m']:.3g} um of sway, "
        f"{1e6 * results['yaw_step_sd_rad']:.3g} urad of yaw; of the track's shape {shape}",
        file=output,
        **results,
    )


@command()
@click.argument("lines_file", metavar="LINES.H5", type=INPUT)
@options.output("Corrected range lines")
@options.grid
@options.of(clsas.autofocus, "unknowns", into="how", called={"unknowns": ("--unknown",)})
@options.beam
@options.device
@options.as_json
def focus(
    lines_file: Path,
    output: Path,
    scene: Path | None,
    axes: dict[str, Any],
    how: dict[str, Any],
    beam: dict[str, Any],
    device: str | None,
    as_json: bool,
) -> None:
    """Correct a track by autofocus on bright responses.

    The grid, from --scene or from --x, --y and --z, should contain a dozen or so bright responses.
    A shift and a linear trend of the track cannot be observed, and are not corrected.

    \b
    Example:  clsas focus lines.h5 --x 2:10:512 --y 28:32:320 -o focused.h5
    """
    described, grid = read_grid(scene, axes)
    window = read_beam(described, beam)
    lines = load(lines_file, clsas.RangeLines)
    with progress_bar("focusing") as progress:
        found = clsas.autofocus(lines, grid, beam=window, **how, device=device, progress=progress)
    clsas.save(output, found.lines)
    results = found.figures
    rms_m = results["correction_rms_m"]
    moved = f"corrected by {1e3 * rms_m:.3g} mm rms" if found.focused else "left as they were"
    steps = "".join(f"\n  {name}: {value:.4g}" for name, value in found.sharpness)
    report(
        as_json,
        f"{printable(output)}: {lines.channels} lines, {moved}; sharpness "
        f"{found.sharpness_before:.4g} to {found.sharpness_after:.4g}{steps}",
        file=output,
        **results,
    )  # fmt: skip
