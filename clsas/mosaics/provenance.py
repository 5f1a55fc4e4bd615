"""Inputs of a mosaic: the description stored with it, and differences between two descriptions."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.digests import digest, grid_digest
from clsas.engine.data.grid import Grid
from clsas.mosaics.document import PARTS_OF_B, Document
from clsas.mosaics.survey import Survey

REQUESTS = ("tolerance_db", "tolerance_wavelengths", "stages", "accuracy_db")
"""Requests for accuracy or a method, of which a mosaic takes at most one."""


class OtherInputsError(ValueError):
    """A store was made with other inputs than those given."""


def inputs_of(
    survey: Survey, grid: Grid, request: dict[str, Any], beam: BeamWindow | None
) -> dict[str, Any]:
    """Return the inputs of a mosaic as JSON types."""
    inputs = {
        "parts": survey.digests(),
        "grid": grid_digest(grid),
        "pixels": list(grid.shape),
        "carrier_hz": survey.geometry.carrier_hz,
        "sound_speed_m_s": survey.geometry.sound_speed_m_s,
        "georeference": None if grid.georeference is None else asdict(grid.georeference),
        "beam": None if beam is None else json.loads(beam_json(beam)),
        **{name: request.get(name) for name in REQUESTS},
    }
    return json.loads(json.dumps(inputs))


def differences(
    document: Document, given: dict[str, Any], patch_shape: tuple[int, int]
) -> list[str]:
    """Return one message for every difference between the inputs of a store and the given ones.

    Files may have been added to the survey, so the given parts need only begin with the stored
    ones.
    """
    found, stored = [], document.inputs
    if ("search_m" in stored) != ("search_m" in given):
        kinds = ("heights", "images") if "search_m" in stored else ("images", "heights")
        return ["it is a mosaic of {}, not of {}".format(*kinds)]
    if document.patch_shape != patch_shape:
        shapes = "{} x {} pixels in the store, {} x {} here"
        found.append(f"patches have {shapes.format(*document.patch_shape, *patch_shape)}")
    before, now = (
        [each.get(name, []) for name in ("parts", PARTS_OF_B)] for each in (stored, given)
    )
    if any(new[: len(old)] != old for old, new in zip(before, now, strict=True)):
        found.append("the range lines differ")
    elif stored.keys() & {PARTS_OF_B} != given.keys() & {PARTS_OF_B}:
        found.append("the range lines of both banks were in one source, or are now")
    for name, theirs in given.items():
        mine = stored.get(name)
        if name in ("parts", PARTS_OF_B):
            continue
        if name == "grid" and mine != theirs:
            if stored.get("pixels") == given["pixels"]:
                found.append("the grid has another position or other heights")
        elif isinstance(mine, dict) and isinstance(theirs, dict):
            found += [
                f"`{name}`'s {key} is {_word(mine.get(key))} in the store, {_word(each)} here"
                for key, each in theirs.items()
                if mine.get(key) != each
            ]
        elif name == "pixels" and mine != theirs:
            shapes = "{} x {} pixels in the store, {} x {} here"
            found.append(f"the grid has {shapes.format(*stored[name], *theirs)}")
        elif mine != theirs:
            found.append(f"`{name}` is {_word(mine)} in the store, {_word(theirs)} here")
    return found


def _word(value: Any) -> str:
    """Return an input in words."""
    if value is None:
        return "not set"
    return "set" if isinstance(value, dict) else str(value)


def stored_digest(path: Path) -> str:
    """Return a digest of the inputs that the store at a path was made with.

    Raises
    ------
    ValueError
        If there is no mosaic at the path, or its document is damaged.
    """
    return digest(Document.read(path).inputs)


def beam_json(beam: BeamWindow) -> str:
    """Return a beam as JSON."""
    return json.dumps(asdict(beam), default=lambda value: value.tolist())
