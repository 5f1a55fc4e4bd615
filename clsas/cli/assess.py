"""Command that finds the effects an image needs: assess."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import clsas
from clsas.cli import options
from clsas.cli.inputs import load_lines, read_beam, read_grid, read_request
from clsas.cli.outputs import json_able, report
from clsas.cli.parameters import INPUT
from clsas.cli.wording import command
from clsas.engine.exact.decide import BEST_ACCURACY_DB
from clsas.engine.factorized.planner import (
    TOLERANCE_DB,
    WORST_TOLERANCE_DB,
    tolerance_in_db,
)
from clsas.files.formats import format_of


@command()
@click.argument("file", metavar="SCENE.TOML|LINES.H5", type=INPUT)
@options.bank
@options.grid
@options.method
@options.beam
@options.device
@options.of(clsas.assess, "repeats", into="timed")
@options.as_json
def assess(
    file: Path,
    of_bank: dict[str, Any],
    scene: Path | None,
    axes: dict[str, Any],
    request: dict[str, Any],
    beam: dict[str, Any],
    device: str | None,
    timed: dict[str, Any],
    as_json: bool,
) -> None:
    """Show which effects an image needs, and what each costs.

    The table states the error of the image without each effect. Assess a scene before you simulate
    it, or range lines with a grid from --scene or from --x, --y and --z. If the scene describes
    sonar and track, element patterns are assessed too, and so is the motion of the receivers, even
    if the lines have no velocities. Of a scene with several banks, the first one is assessed unless
    --bank names another. Specify grid, beam and tolerance as for `clsas image`.

    \b
    Example:  clsas assess scene.toml --tolerance-db -40
              clsas assess lines.h5 --scene scene.toml --repeats 5
    """
    is_lines = format_of(file) is not None
    if not is_lines:
        if scene is not None:
            raise click.UsageError(
                f"--scene requires LINES.H5, but {file} is a scene: give one of them"
            )
        scene = file
    described, grid = read_grid(scene, axes)
    simulate = described.simulate
    known: dict[str, Any] = {}
    if is_lines:
        lines = load_lines(file, described, **of_bank)
        sonar, track = described.sonar, described.track
        if sonar is not None and sonar.banks > 1 and lines.banks == 1:
            sonar = sonar.bank(of_bank.get("number", 0))
        # A scene that describes another survey than the lines provides only grid and beam.
        if sonar and track and sonar.receivers * track.pings == lines.channels:
            known = {"sonar": sonar, "track": track}
    else:
        sonar, track = described.need("sonar", "track")
        sonar = sonar.bank(of_bank.get("number", 0))
        survey = {
            name: simulate[name]
            for name in ("motion_in_flight", "phase_centres", "sound_speed")
            if name in simulate
        }
        # Their band is flat, as if it were equalized.
        band = {name: each for name, each in described.compress.items() if name != "equalize"}
        lines = clsas.survey_lines(sonar, track, grid, **survey, **band)
        known = {"sonar": sonar, "track": track, "ends": False}
    if known:
        known |= {
            name: simulate[name] for name in ("pointing", "element_pattern") if name in simulate
        }
    found = clsas.assess(
        lines,
        grid,
        beam=read_beam(described, beam),
        tolerance_db=_tolerance_db(read_request(described, request)),
        device=device,
        **timed,
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


def _tolerance_db(request: dict[str, Any]) -> float:
    """Return the tolerance of a request, dB; for an exact image, its accuracy."""
    if request.get("stages") is not None:
        raise click.UsageError("--stages implies no tolerance: use --tolerance-db instead")
    tolerance_db = tolerance_in_db(
        request.get("tolerance_db"), request.get("tolerance_wavelengths")
    )
    if tolerance_db is None:
        tolerance_db = request.get("accuracy_db", TOLERANCE_DB)
    return min(max(tolerance_db, BEST_ACCURACY_DB), WORST_TOLERANCE_DB)
