"""The command that tells which effects an image needs: assess."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import clsas
from clsas.cli import options
from clsas.cli.inputs import load, read_beam, read_grid, read_wish
from clsas.cli.outputs import json_able, report
from clsas.cli.parameters import INPUT
from clsas.planning.planner import (
    BEST_TOLERANCE_DB,
    TOLERANCE_DB,
    WORST_TOLERANCE_DB,
    tolerance_in_db,
)

_HDF5 = b"\x89HDF"


@click.command()
@click.argument("file", metavar="SCENE.TOML|LINES.H5", type=INPUT)
@options.grid
@options.dial
@options.beam
@options.device
@click.option(
    "--repeats", type=click.IntRange(0), default=0, show_default=True,
    help="Also form the image with and without every effect so often, and tell measured times.",
)  # fmt: skip
@options.as_json
def assess(
    file: Path,
    scene: Path | None,
    device: str | None,
    repeats: int,
    as_json: bool,
    **given: Any,
) -> None:
    """Tell which effects an image needs, what error leaving each out adds, and what it costs.

    Of a scene before anything is simulated, or of range lines with the grid of --scene or of --x,
    --y and --z. Sonar and track of a scene tell element patterns too, and the motion of receivers
    where the lines hold none. Grid, beam and tolerance as for `clsas image`.

    \b
    Example:  clsas assess scene.toml --tolerance-db -40
              clsas assess lines.h5 --scene scene.toml --repeats 5
    """
    with open(file, "rb") as opened:
        is_lines = opened.read(4) == _HDF5
    if not is_lines:
        if scene is not None:
            raise click.UsageError(
                f"--scene goes with LINES.H5, and {file} is none: give one of them"
            )
        scene = file
    described, grid = read_grid(scene, given)
    simulate = described.simulate
    known: dict[str, Any] = {}
    if is_lines:
        lines = load(file, clsas.RangeLines)
        sonar, track = described.sonar, described.track
        # A scene may describe another survey than that of the lines: then it tells grid and beam.
        if sonar and track and sonar.receivers * track.pings == lines.channels:
            known = {"sonar": sonar, "track": track}
    else:
        sonar, track = described.need("sonar", "track")
        survey = {
            name: simulate[name]
            for name in ("motion_in_flight", "phase_centres")
            if name in simulate
        }
        lines = clsas.survey_lines(sonar, track, grid, **survey, **described.compress)
        known = {"sonar": sonar, "track": track, "ends": False}
    if known:
        known |= {
            name: simulate[name] for name in ("pointing", "element_pattern") if name in simulate
        }
    found = clsas.assess(
        lines,
        grid,
        beam=read_beam(described, given),
        tolerance_db=_tolerance_db(read_wish(described, given)),
        device=device,
        repeats=repeats,
        **known,
    )
    report(
        as_json,
        found.describe(),
        **json_able(found),
        needed=[effect.name for effect in found.effects if effect.needed],
        spare=found.spare,
        missing=found.missing,
    )


def _tolerance_db(wish: dict[str, Any]) -> float:
    """Return the tolerance that a wish stands for: that of the exact image is its accuracy."""
    if wish.get("stages") is not None:
        raise click.UsageError("--stages has no tolerance to assess by: give --tolerance-db")
    tolerance_db = tolerance_in_db(wish.get("tolerance_db"), wish.get("tolerance_wavelengths"))
    if tolerance_db is None:
        tolerance_db = wish.get("accuracy_db", TOLERANCE_DB)
    return min(max(tolerance_db, BEST_TOLERANCE_DB), WORST_TOLERANCE_DB)
