"""What a mosaic was made with: a description to keep with it, and how two of them differ."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

from clsas.core.grid import Grid
from clsas.factorized.plan import grid_digest
from clsas.mosaics.survey import Survey
from clsas.sonar.beam import BeamWindow

REQUESTS = ("tolerance_db", "tolerance_wavelengths", "stages", "accuracy_db")
"""How a mosaic may be wished for: at most one of these."""


def inputs_of(
    survey: Survey, grid: Grid, wish: dict[str, Any], beam: BeamWindow | None
) -> dict[str, Any]:
    """Return what a mosaic is made with, as JSON holds it."""
    inputs = {
        "parts": survey.digests(),
        "grid": grid_digest(grid),
        "pixels": list(grid.shape),
        "beam": None if beam is None else json.loads(beam_json(beam)),
        **{name: wish.get(name) for name in REQUESTS},
    }
    return json.loads(json.dumps(inputs))


def differences(stored: dict[str, Any], given: dict[str, Any]) -> list[str]:
    """Return how given inputs differ from stored ones, one message each.

    A survey may have grown: the stored parts need only be the first of those given.
    """
    found = []
    for name in given:
        mine, theirs = stored.get(name), given[name]
        if name == "parts":
            if theirs[: len(mine)] != mine:
                found.append("the range lines are others")
        elif name == "grid" and mine != theirs:
            if stored.get("pixels") == given["pixels"]:
                found.append("the grid lies elsewhere")
        elif isinstance(mine, dict) and isinstance(theirs, dict):
            found += [
                f"{name}'s {key} is {mine.get(key)} there, {theirs[key]} given"
                for key in theirs
                if mine.get(key) != theirs[key]
            ]
        elif mine != theirs:
            found.append(f"{name} is {mine} there, {theirs} given")
    return found


def beam_json(beam: BeamWindow | None) -> str | None:
    """Return a beam as JSON."""
    return None if beam is None else json.dumps(asdict(beam), default=lambda value: value.tolist())
