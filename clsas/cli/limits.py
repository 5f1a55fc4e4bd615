"""Command that shows what a survey can resolve, and which of its limits it keeps: limits."""

from __future__ import annotations

from pathlib import Path

import click

import clsas
from clsas.cli import options
from clsas.cli.inputs import read_scene
from clsas.cli.outputs import report
from clsas.cli.parameters import INPUT
from clsas.cli.wording import command
from clsas.files.json_types import json_able

_FROM_SCENE = ("range_m", "pointing", "element_pattern", "motion_in_flight")


@command()
@click.argument("scene", metavar="SCENE.TOML", type=INPUT)
@options.as_json
def limits(scene: Path, as_json: bool) -> None:
    """Show the limits of a survey: sampling, speed, resolution.

    The survey is that of a scene file, before anything is simulated or recorded. Every number comes
    with the limit that it should keep, the equation, and a sentence on what it means. A scene needs
    only a sonar. Results that require more are listed at the end.

    \b
    Example:  clsas limits scene.toml
    """
    described = read_scene(scene)
    (sonar,) = described.need("sonar")
    found = clsas.limits(
        sonar,
        described.track,
        described.grid,
        beam=described.image.get("beam"),
        window=described.compress.get("window", "none"),
        **{key: described.simulate[key] for key in _FROM_SCENE if key in described.simulate},
    )
    report(
        as_json,
        found.describe(),
        file=scene,
        results={each.name: _numbers(each) for each in found.results},
        exceeded=found.exceeded,
        missing=found.missing,
    )


def _numbers(each: clsas.Limit) -> dict[str, object]:
    """Return a result without the words that the table shows."""
    words = ("name", "subject", "label", "meaning", "consequence")
    return {key: value for key, value in json_able(each).items() if key not in words}
