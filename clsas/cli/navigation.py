"""Commands that correct a track from the echoes: known-points, navigate, focus."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np

import clsas
from clsas.cli import options
from clsas.cli.inputs import load, read_beam, read_grid
from clsas.cli.outputs import printable, progress_bar, report
from clsas.cli.parameters import INPUT, POSITION, RANGE
from clsas.cli.wording import command
from clsas.engine.data import validate
from clsas.navigation.autofocus import UNKNOWNS as FOCUSED
from clsas.navigation.known_points import DEFAULT_UNKNOWNS
from clsas.navigation.known_points import UNKNOWNS as CALIBRATED
from clsas.navigation.micronavigation import UNKNOWNS as NAVIGATED
from clsas.processing import numbers


def _positive(name: str, unit: str) -> Any:
    return options.checked(partial(validate.positive, name, unit=unit))


@command("known-points")
@click.argument("lines_file", metavar="LINES.H5", type=INPUT)
@options.output("Corrected range lines")
@click.option(
    "--point",
    "points",
    multiple=True,
    required=True,
    type=POSITION,
    help="Position of a reflector (m), at z = 0 by default; repeat the option for several.",
)
@click.option(
    "--unknown",
    "unknowns",
    multiple=True,
    type=click.Choice(CALIBRATED),
    help="Unknown to solve for, the most important first; repeat the option for several. "
    "[default: time_offset and sound_speed]",
)
@click.option(
    "--search-m",
    type=float,
    callback=_positive("search_m", "m"),
    help="Largest range error to search for (m). [default: 50 resolution cells, or 70 % of the "
    "smallest distance in range between two reflectors if that is less]",
)
@options.as_json
def known_points(
    lines_file: Path,
    output: Path,
    points: tuple[tuple[float, ...], ...],
    unknowns: tuple[str, ...],
    search_m: float | None,
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
    positions = [(*point, 0.0)[:3] for point in points]
    with progress_bar("measuring ranges") as progress:
        found = clsas.calibrate_track(
            lines, positions, unknowns=unknowns or DEFAULT_UNKNOWNS, search_m=search_m,
            progress=progress,
        )  # fmt: skip
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
@click.option("--range-m", type=RANGE, help="Nearest and farthest range to use, NEAR:FAR (m).")
@click.option(
    "--window-m",
    type=float,
    callback=_positive("window_m", "m"),
    help="Length of a window in range (m). [default: about 150 resolution cells]",
)
@click.option(
    "--side",
    type=click.Choice(("port", "starboard")),
    default="port",
    show_default=True,
    help="Side on which the seabed lies.",
)
@click.option(
    "--seabed-z-m", type=float, help="Height of the seabed (m). [default: rays are horizontal]"
)
@click.option(
    "--element-length-m",
    type=float,
    callback=_positive("element_length_m", "m"),
    help="Length of the elements (m), which wide beams need for accurate yaw.",
)
@click.option(
    "--sway-sd-m",
    type=float,
    default=0.1,
    show_default=True,
    callback=_positive("sway_sd_m", "m"),
    help="Standard deviation of the sway in the navigation data (m).",
)
@click.option(
    "--yaw-sd-deg",
    type=float,
    default=1.0,
    show_default=True,
    callback=options.checked(
        partial(validate.number, "yaw_sd_deg", unit="degrees", above=0.0, most=180.0)
    ),
    help="Standard deviation of the yaw in the navigation data (degrees).",
)
@click.option(
    "--surge-sd-m",
    type=float,
    default=0.1,
    show_default=True,
    callback=_positive("surge_sd_m", "m"),
    help="Standard deviation of the surge in the navigation data (m).",
)
@click.option(
    "--unknown",
    "unknowns",
    multiple=True,
    type=click.Choice(NAVIGATED),
    help="Unknown to solve for; repeat the option for several. [default: sway, yaw, surge]",
)
@options.as_json
def navigate(
    lines_file: Path,
    output: Path,
    yaw_sd_deg: float,
    unknowns: tuple[str, ...],
    as_json: bool,
    **given: Any,
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
        found = clsas.micronavigate(
            lines, **given, yaw_sd_rad=np.radians(yaw_sd_deg), unknowns=unknowns or NAVIGATED,
            progress=progress,
        )  # fmt: skip
    clsas.save(output, found.lines)
    results = numbers.of_navigation(found)
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
@click.option(
    "--unknown",
    "unknowns",
    multiple=True,
    type=click.Choice(FOCUSED),
    help="Displacement to solve for; repeat the option for several. [default: sway]",
)
@options.beam
@options.device
@options.as_json
def focus(
    lines_file: Path,
    output: Path,
    scene: Path | None,
    unknowns: tuple[str, ...],
    device: str | None,
    as_json: bool,
    **given: Any,
) -> None:
    """Correct a track by autofocus on bright responses.

    The grid, from --scene or from --x, --y and --z, should contain a dozen or so bright responses.
    A shift and a linear trend of the track cannot be observed, and are not corrected.

    \b
    Example:  clsas focus lines.h5 --x 2:10:512 --y 28:32:320 -o focused.h5
    """
    described, grid = read_grid(scene, given)
    beam = read_beam(described, given)
    lines = load(lines_file, clsas.RangeLines)
    with progress_bar("focusing") as progress:
        found = clsas.autofocus(
            lines, grid, beam=beam, unknowns=unknowns or FOCUSED[:1], device=device,
            progress=progress,
        )  # fmt: skip
    clsas.save(output, found.lines)
    results = numbers.of_focus(found)
    rms_m = results["correction_rms_m"]
    how = f"corrected by {1e3 * rms_m:.3g} mm rms" if found.focused else "left as they were"
    steps = "".join(f"\n  {name}: {value:.4g}" for name, value in found.sharpness)
    report(
        as_json,
        f"{printable(output)}: {lines.channels} lines, {how}; sharpness "
        f"{found.sharpness_before:.4g} to {found.sharpness_after:.4g}{steps}",
        file=output,
        **results,
    )  # fmt: skip
