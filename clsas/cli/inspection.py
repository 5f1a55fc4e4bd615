"""Command that checks a recording before it is imaged: inspect."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import click

import clsas
from clsas.cli import options
from clsas.cli.inputs import load, read_beam, read_grid, read_scene
from clsas.cli.outputs import report
from clsas.cli.parameters import INPUT
from clsas.cli.wording import command
from clsas.files.scene_files import SceneFile


@command()
@click.argument("recording", metavar="FILE", type=INPUT)
@options.grid
@options.beam
@options.device
@options.picture("levels of the lines, their spectrum and the track")
@options.as_json
def inspect(
    recording: Path,
    scene: Path | None,
    axes: dict[str, Any],
    beam: dict[str, Any],
    device: str | None,
    picture: Path | None,
    as_json: bool,
) -> None:
    """Show what a recording contains, and what is wrong with it.

    FILE is a recording that `clsas image` reads, or a file of echoes. Every finding states a
    measured value and what to do. The recording is checked against the grid and the beam from
    --scene or from the options, and against the element length of the scene's sonar. `clsas
    convert` has options that remove faults.

    \b
    Example:  clsas inspect recording.h5 --scene scene.toml --picture recording.png
    """
    described = SceneFile(name="") if scene is None else read_scene(scene)
    grid = described.grid
    if axes:
        described, grid = read_grid(scene, axes, memory=False)
    sonar = described.sonar
    found = clsas.inspect(
        load(recording, clsas.RangeLines, clsas.Echoes),
        grid,
        device=device,
        beam=read_beam(described, beam),
        element_length_m=None if sonar is None else sonar.element_length_m,
    )
    if picture is not None:
        from clsas import plot

        plot.save(plot.inspection(found, grid), picture)
    numbers = {f.name: getattr(found, f.name) for f in fields(found) if f.name != "lines"}
    report(as_json, found.describe(), file=recording, picture=picture, **numbers)
