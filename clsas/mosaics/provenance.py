"""Inputs of a mosaic: a description that is stored with it, and differences between two of them."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from clsas.core.digests import grid_digest
from clsas.core.grid import Grid
from clsas.mosaics.documents import read_document
from clsas.mosaics.survey import Survey
from clsas.sonar.beam import BeamWindow

REQUESTS = ("tolerance_db", "tolerance_wavelengths", "stages", "accuracy_db")
"""Requests for accuracy or a method, of which a mosaic takes at most one."""


class OtherInputsError(ValueError):
    """A store was made with other inputs than those given."""


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


def differences(
    attributes: dict[str, Any], given: dict[str, Any], patch_shape: tuple[int, int]
) -> list[str]:
    """Return one message for every difference between the attributes of a store and given inputs.

    The survey may have grown: the given parts only have to begin with the stored ones.
    """
    found, stored = [], attributes["inputs"]
    if attributes["patch_shape"] != list(patch_shape):
        mine, theirs = ("{} x {}".format(*s) for s in (attributes["patch_shape"], patch_shape))
        found.append(f"patches of {mine} pixels there, of {theirs} given")
    if given["parts"][: len(stored["parts"])] != stored["parts"]:
        found.append("the range lines are others")
    for name, theirs in given.items():
        mine = stored.get(name)
        if name == "parts":
            continue
        if name == "grid" and mine != theirs:
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


def stored_digest(path: Path) -> str:
    """Return a digest of the inputs with which the store at a path was made.

    Raises
    ------
    ValueError
        If there is no mosaic, or its document is damaged.
    """
    text = json.dumps(read_document(path)["inputs"], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def beam_json(beam: BeamWindow) -> str:
    """Return a beam as JSON."""
    return json.dumps(asdict(beam), default=lambda value: value.tolist())
