"""Inputs of commands: files, grid, beam, levels of pictures, and how to form an image."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

import clsas
from clsas.cli.options import option_of
from clsas.cli.outputs import warn
from clsas.cli.parameters import keep_apart, need_matplotlib, written_to
from clsas.cli.wording import error_message
from clsas.engine.data import reading, validate
from clsas.engine.data.lines import first_two_banks
from clsas.engine.data.validate import ArgumentError
from clsas.engine.factorized.planner import DEFAULT_REQUEST
from clsas.files import scene_files as config
from clsas.files.scene_files import SceneFile
from clsas.files.scene_tables import EXACT_KEYS, PLAN_KEYS
from clsas.plot.canvas import colour_map as check_colour_map


def load(path: Path, *kinds: type) -> Any:
    """Return what a file holds; raise ValueError unless it is of one of the types `kinds`."""
    obj = clsas.load(path)
    if isinstance(obj, kinds):
        return obj
    hint = {
        clsas.Echoes: " (clsas simulate makes them)",
        clsas.RangeLines: " (clsas compress makes them)",
        clsas.Image: " (clsas image makes it)",
        clsas.Heights: " (clsas heights makes them)",
    }
    wanted = " or ".join(f"`{kind.__name__}`{hint.get(kind, '')}" for kind in kinds)
    raise ValueError(f"{path} must hold {wanted}, got `{type(obj).__name__}`")


def load_heights(path: Path) -> clsas.Heights:
    """Return the heights of a file, or those of some pixels of every window of a store."""
    if path.is_dir():
        return clsas.Store.opened(path).sampled_heights()
    heights: clsas.Heights = load(path, clsas.Heights)
    return heights


def load_lines(
    path: Path, described: SceneFile | None = None, *, number: int | None = None
) -> clsas.RangeLines:
    """Return the range lines of a file, or those of the receiver bank with a number.

    They get the sound speed of the scene unless they have their own.
    """
    lines: clsas.RangeLines = load(path, clsas.RangeLines)
    if described and described.sound_speed is not None and lines.sound_speed is None:
        lines = replace(lines, sound_speed=described.sound_speed)
    if number is None:
        return lines
    try:
        return lines.bank(number)
    except ArgumentError as error:
        error.add_note(str(path))
        raise


def load_banks(
    path: Path, described: SceneFile | None = None, remedy: str = ""
) -> tuple[clsas.RangeLines, tuple[int, int]]:
    """Return the range lines of a file of several receiver banks, and the first two banks.

    If there is only one, the error ends with the `remedy`, if any.
    """
    lines = load_lines(path, described)
    try:
        return lines, first_two_banks(lines.bank_numbers)
    except ArgumentError as error:
        said = f"{path} must {error.allowed}, got {error.given}"
        raise ValueError(said + (f": {remedy}" if remedy else "")) from None


def read_plan(path: Path) -> clsas.Plan:
    """Return the plan in a file of `clsas plan --json --filters`."""
    try:
        return clsas.Plan.from_json(reading.read_bytes(path).decode())
    except ValueError as error:
        reason = error.hint if isinstance(error, ArgumentError) else "it is not text"
        raise ValueError(
            f"{path} must be a plan of `clsas plan --json --filters`: {reason}"
        ) from None


def read_scene(path: Path) -> SceneFile:
    """Return a scene; raise UsageError if the command would replace a file that it refers to."""
    described = config.read_scene(path)
    for key, file in described.files.items():
        for option, written in written_to(click.get_current_context()).items():
            keep_apart(f"{path}: {key}", file, option, written)
    return described


def read_grid(
    scene: Path | None, axes: dict[str, Any], memory: bool = True
) -> tuple[SceneFile, clsas.Grid]:
    """Return the scene, empty if there is none, and the grid of the options or of the scene.

    If `memory`, raise ValueError if an image on the grid does not fit into memory.
    """
    if axes and not {"x", "y"} <= axes.keys():
        raise click.UsageError("--x and --y must be given together; --z requires them")
    if scene is None and not axes:
        raise click.UsageError("no grid given: use --scene, or --x and --y")
    described = read_scene(scene) if scene is not None else SceneFile(name="")
    if axes:
        grid = clsas.Grid.plane(**axes, georeference=described.georeference)
    else:
        (grid,) = described.need("grid")
    if memory:
        validate.memory("--x and --y" if axes else "[grid]", 8 * grid.size)
    return described, grid


def read_request(
    described: SceneFile, given: dict[str, Any], exact: bool = False
) -> dict[str, Any]:
    """Return the request of the options, or else of the scene, or else the default tolerance.

    It has one of `PLAN_KEYS`; or, for an exact image, some or none of `EXACT_KEYS`.
    """
    planned = {name: given[name] for name in PLAN_KEYS if name in given}
    exactly = {name: given[name] for name in EXACT_KEYS if name in given}
    if len(planned) + exact > 1:
        params = click.get_current_context().command.params
        named = {getattr(param, "argument", param.name): param.opts[0] for param in params}
        *others, last = (named[name] for name in (*PLAN_KEYS, "exact") if name in named)
        raise click.UsageError(f"give only one of {', '.join(others)} and {last}")
    if planned and exactly:
        raise click.UsageError(
            "--accuracy-db, --taps and --upsampling are for exact images and cannot be combined "
            f"with {option_of(next(iter(planned)))}"
        )
    if planned:
        return planned
    if exact or exactly:
        in_scene = {key: described.image[key] for key in EXACT_KEYS if key in described.image}
        exactly = in_scene | exactly
        if "accuracy_db" in given and len(exactly) == len(EXACT_KEYS):
            raise click.UsageError(
                "--accuracy-db has no effect beside both --taps and --upsampling, or `taps` and "
                "`upsampling` of the scene: leave one of them out"
            )
        return exactly
    return described.request or DEFAULT_REQUEST


def read_beam(described: SceneFile, changes: dict[str, Any]) -> clsas.BeamWindow | None:
    """Return the beam of the scene as changed by the options, or that of the options alone."""
    beam = described.image.get("beam")
    if not changes:
        return beam
    if beam is None and "width_deg" not in changes:
        raise click.UsageError(
            "--beam-shape, --squint-deg, --element-length-m and --track-pings require --beam-deg"
        )
    try:
        changed = replace(beam, **changes) if beam is not None else clsas.BeamWindow(**changes)
        if "element_length_m" in changes and changed.shape != "inverse":
            raise click.UsageError(
                f"--element-length-m requires --beam-shape inverse, got {changed.shape}"
            )
        return changed
    except ArgumentError as error:  # the scene's own beam was checked when it was read
        raise click.UsageError(error_message(error)) from error


def check_levels(levels: dict[str, Any]) -> None:
    """Raise UsageError for levels and colours that no picture can have."""
    if {"dynamic_range_db", "percentiles"} <= levels.keys():
        raise click.UsageError("--dynamic-range-db and --percentiles exclude each other")
    if "colour_map" in levels:
        need_matplotlib()
        try:
            check_colour_map(levels["colour_map"])
        except ArgumentError as error:
            raise click.UsageError(error_message(error)) from error


def warn_of_sampling(scene: SceneFile, grid: clsas.Grid | None = None) -> None:
    """Warn of every sampling limit that a scene breaks, on its own grid or another one."""
    grid = scene.grid if grid is None else grid
    if scene.sonar is None or scene.track is None or grid is None:
        return
    for finding in clsas.check_sampling(scene.sonar, scene.track, grid):
        warn(f"{finding.message}. See clsas limits {scene.name}")
