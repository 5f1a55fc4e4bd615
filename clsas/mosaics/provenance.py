"""Inputs of a mosaic: a description that is stored with it, and differences between two of them."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

from clsas.core.digests import grid_digest
from clsas.core.grid import Grid
from clsas.mosaics.survey import Survey
from clsas.sonar.beam import BeamWindow

REQUESTS = ("tolerance_db", "tolerance_wavelengths", "stages", "accuracy_db")
"""Requests for accuracy or a method, of which a mosaic takes at most one."""


def inputs_of(
    survey: Survey, grid: Grid, request: dict[str, Any], beam: BeamWindow | None
) -> dict[str, Any]:
    """Return the inputs of a mosaic in types of JSON."""
    inputs = {
        "parts": survey.digests(),
        "grid": grid_digest(grid),
        "pixels": list(grid.shape),
        "beam": None if beam is None else json.loads(beam_json(beam)),
        **{name: request.get(name) for name in REQUESTS},
    }
    return json.loads(json.dumps(inputs))


def differences(stored: dict[str, Any], given: dict[str, Any]) -> list[str]:
    """Return one message for every difference between stored and given inputs.

    The survey may have grown: the given parts only have to begin with the stored ones.
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
