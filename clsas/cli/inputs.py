"""What a command is given: files, grid, beam, and how an image is wanted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

import clsas
from clsas.cli.parameters import keep_apart, need_matplotlib, written_to
from clsas.core import validate
from clsas.files import scene_files as config
from clsas.files.scene_files import DIAL, EXACT, SceneFile
from clsas.planning.planner import TOLERANCE_DB
from clsas.products.plot.colours import colour_map as check_colour_map

DEFAULT_WISH = {"tolerance_db": TOLERANCE_DB}


def load(path: Path, kind: type) -> Any:
    """Return what a file holds, which must be of a kind."""
    obj = clsas.load(path)
    if isinstance(obj, kind):
        return obj
    hint = {
        clsas.Echoes: " (clsas simulate makes them)",
        clsas.RangeLines: " (clsas compress makes them)",
        clsas.Image: " (clsas image makes it)",
    }
    raise ValueError(
        f"{path} must hold {kind.__name__}{hint.get(kind, '')}, got {type(obj).__name__}"
    )


def read_scene(path: Path) -> SceneFile:
    """Return what a scene file describes; nothing may be written over a file that it names."""
    described = config.read_scene(path)
    for key, file in described.files.items():
        for option, written in written_to(click.get_current_context()).items():
            keep_apart(f"{path}: {key}", file, option, written)
    return described


def read_grid(
    scene: Path | None, given: dict[str, Any], memory: bool = True
) -> tuple[SceneFile, clsas.Grid]:
    """Return what a scene file describes, or nothing, and the grid that is wanted.

    Its image must fit into the `memory`, if so told.
    """
    x, y, z = (given[name] for name in ("x", "y", "z"))
    if (x is None) != (y is None) or (z is not None and x is None):
        raise click.UsageError("--x and --y go together, and --z with them")
    if scene is None and x is None:
        raise click.UsageError("a grid is needed: --scene, or --x and --y")
    described = read_scene(scene) if scene is not None else SceneFile(name="")
    grid = clsas.Grid.plane(x, y, z or 0.0) if x and y else described.need("grid")[0]
    if memory:
        validate.memory("--x and --y" if x else "[grid]", 8 * grid.size)
    return described, grid


def read_wish(described: SceneFile, given: dict[str, Any], exact: bool = False) -> dict[str, Any]:
    """Return how an image is wanted: one of `DIAL`, or else what the exact image takes."""
    dial, exactly = (
        {name: given[name] for name in names if given.get(name) is not None}
        for names in (DIAL, EXACT)
    )
    if len(dial) + exact > 1:
        raise click.UsageError(
            "--tolerance-db, --tolerance-wavelengths, --stages and --exact exclude each other"
        )
    if dial and exactly:
        raise click.UsageError(
            "--accuracy-db, --taps and --upsampling are of the exact image, and play no part with "
            f"--{next(iter(dial)).replace('_', '-')}"
        )
    if len(exactly) == len(EXACT):
        raise click.UsageError(
            "--accuracy-db plays no part where --taps and --upsampling are given"
        )
    if dial:
        return dial
    described_exactly = {key: value for key, value in described.image.items() if key in EXACT}
    if exact or exactly:
        return described_exactly | exactly
    described_dial = {key: value for key, value in described.image.items() if key in DIAL}
    return described_dial or described_exactly or DEFAULT_WISH


def read_beam(described: SceneFile, given: dict[str, Any]) -> clsas.BeamWindow | None:
    """Return a scene file's beam, changed by what is given, or the beam that is."""
    beam = described.image.get("beam")
    options = {"width_deg": "beam_deg", "shape": "beam_shape", "squint_deg": "squint_deg"}
    options |= {"element_length_m": "element_length_m", "track_pings": "track_pings"}
    changes = {key: given[name] for key, name in options.items() if given[name] is not None}
    if not changes:
        return beam
    if beam is None and "width_deg" not in changes:
        raise click.UsageError(
            "--beam-shape, --squint-deg, --element-length-m and --track-pings go with --beam-deg"
        )
    try:
        changed = replace(beam, **changes) if beam is not None else clsas.BeamWindow(**changes)
        if "element_length_m" in changes and changed.shape != "inverse":
            raise ValueError(
                f"--element-length-m goes with --beam-shape inverse, got {changed.shape}"
            )
        return changed
    except ValueError as error:  # the scene's own was checked when it was read
        raise click.UsageError(str(error)) from error


def read_levels(
    dynamic_range_db: float | None,
    percentiles: tuple[float, float] | None,
    colour_map: str | None,
) -> dict[str, Any]:
    """Return the arguments of `clsas.plot.image` that say which levels a picture shows, checked."""
    if dynamic_range_db is not None and percentiles is not None:
        raise click.UsageError("--dynamic-range-db and --percentiles exclude each other")
    given = {
        "dynamic_range_db": dynamic_range_db,
        "percentiles": percentiles,
        "colour_map": colour_map,
    }
    if colour_map is not None:
        need_matplotlib()
        try:
            check_colour_map(colour_map)
        except ValueError as error:
            raise click.UsageError(str(error).replace("colour_map", "--colour-map")) from error
    return {name: value for name, value in given.items() if value is not None}


def warn_of_sampling(scene: SceneFile, grid: clsas.Grid | None = None) -> None:
    """Warn where a scene's survey breaks a limit of sampling, on its own grid or another."""
    grid = scene.grid if grid is None else grid
    if scene.sonar is None or scene.track is None or grid is None:
        return
    for finding in clsas.check_sampling(scene.sonar, scene.track, grid):
        click.echo(f"Warning: {finding.message}", err=True)
