"""Documents of a store: JSON attributes of Zarr groups, with digests.

The store's own document describes the mosaic and the inputs that it was made with. Every finished
patch has a document too, its record (`clsas.mosaics.record`).
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from clsas.engine.data import validate
from clsas.engine.data.atomic import make_folders, replacing
from clsas.engine.data.digests import is_intact
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.engine.data.reading import parse_json, read_bytes
from clsas.engine.data.validate import ArgumentError
from clsas.mosaics.levels import WINDOW, are_levels

FORMAT = "clsas mosaic"
VERSION = 6
"""Version of stores. Those of other versions are refused."""

DIGESTS = "metadata"
"""Attribute with a digest of every array's metadata."""

PARTS_OF_B = "parts_of_b"
"""Input with the digests of the second bank's files, if they are not those of the first one."""

VECTORS = "origin_m", "row_step_m", "column_step_m"
"""Vectors that define the plane of a grid."""


class DamageError(ValueError):
    """A patch or a document of a store differs from what was written."""


def read_attributes(folder: Path) -> dict[str, Any]:
    """Return the attributes of a Zarr group.

    Raises
    ------
    DamageError
        If the group has no valid document.
    OSError
        If the document cannot be read.
    """
    try:
        document = parse_json(read_bytes(folder / "zarr.json"))
        is_group = (document["zarr_format"], document["node_type"]) == (3, "group")
        attributes = document["attributes"]
    except (ValueError, LookupError, TypeError) as error:
        raise DamageError("its record cannot be read") from error
    if not (is_group and isinstance(attributes, dict)):
        raise DamageError("its record cannot be read")
    return attributes


def is_there(path: Path) -> bool:
    """Return whether the path of a store exists and is not an empty folder."""
    return path.exists() and not (path.is_dir() and not any(path.iterdir()))


def check_place(path: Path) -> None:
    """Check that a path contains a mosaic, or nothing yet and a mosaic can be created there.

    Raises
    ------
    ValueError
        If the path contains something else, or a damaged mosaic.
    OSError
        If the path cannot be written.
    """
    if is_there(path):
        read_document(path)
    elif not path.parent.is_dir():
        raise FileNotFoundError(2, "there is no such folder", str(path.parent))
    try:
        with tempfile.TemporaryFile(dir=path if path.is_dir() else path.parent):
            pass
    except OSError as error:  # it names the temporary file
        raise type(error)(error.errno, error.strerror, str(path)) from error


def check_own(store: Path, folder: Path) -> None:
    """Raise ValueError if a symbolic link leads a folder of a store to another place.

    Otherwise a store that comes from a stranger could make a run write into any folder of the user.
    """
    own = Path(os.path.realpath(store)) / folder.relative_to(store)
    if Path(os.path.realpath(folder)) != own:
        raise ValueError(
            f"{folder} must be a real folder of the store, but a symbolic link leads elsewhere: "
            "nothing is written through it"
        )


def write_attributes(folder: Path, attributes: dict[str, Any]) -> None:
    """Write a Zarr group with attributes, and wait until it is on the disk."""
    make_folders(folder)
    document = {"zarr_format": 3, "node_type": "group", "attributes": attributes}
    with replacing(folder / "zarr.json") as temporary:
        temporary.write_text(json.dumps(document, indent=1))


def read_document(path: Path) -> dict[str, Any]:
    """Return the attributes of a whole mosaic.

    Raises
    ------
    ValueError
        If the path contains something else, a mosaic of another version, or a damaged one.
    """
    try:
        attributes = read_attributes(path)
    except (OSError, DamageError) as error:
        raise ValueError(f"{path} exists and is not a mosaic of clsas") from error
    if attributes.get("format") != FORMAT:
        raise ValueError(f"{path} exists and is not a mosaic of clsas")
    if attributes.get("version") != VERSION:
        raise ValueError(
            f"{path} is a mosaic of version {attributes.get('version')}, but this clsas works "
            f"with version {VERSION}: choose another path"
        )
    if not is_intact(attributes):
        raise ValueError(f"{path} is damaged: its attributes do not match their digest")
    if not _is_complete(attributes):
        raise ValueError(f"{path} is damaged: its attributes are not those of a mosaic")
    return attributes


def plane_of(attributes: Mapping[str, Any]) -> Grid | None:
    """Return the plane of a mosaic's grid, without heights, or None if it has arbitrary points."""
    stored = attributes["grid"]
    if stored is None:
        return None
    inputs = attributes["inputs"]
    place = inputs.get("georeference")
    georeference = None if place is None else Georeference(**place)
    return Grid.oriented(**stored, shape=tuple(inputs["pixels"]), georeference=georeference)


def check_inputs(inputs: Any, shape: Sequence[int] | None) -> None:
    """Check the inputs of a mosaic.

    Parameters
    ----------
    inputs : dict
        The inputs, as `clsas.mosaics.provenance.inputs_of` returns them.
    shape : (rows, columns) or None
        Shape of the grid, which the number of pixels must equal; None for any shape.

    Raises
    ------
    TypeError
        If `inputs` are not a dict.
    ValueError
        If the list of parts or the number of pixels is missing or wrong.
    """
    validate.instance("inputs", inputs, dict)
    parts, pixels = inputs.get("parts"), inputs.get("pixels")
    for name, each in (("parts", parts), (PARTS_OF_B, inputs.get(PARTS_OF_B, []))):
        if not isinstance(each, list):
            raise ArgumentError("inputs", f"have a list {name!r}", validate.shown(each))
    if not _is_shape(pixels) or (shape is not None and pixels != list(shape)):
        expected = "of two numbers" if shape is None else f"{list(shape)}, the shape of the grid"
        raise ArgumentError("inputs", f"have 'pixels' {expected}", validate.shown(pixels))


def _is_complete(attributes: dict[str, Any]) -> bool:
    """Return whether attributes have all entries of a mosaic, of the required types."""
    grid = attributes.get("grid", ())
    try:
        check_inputs(attributes.get("inputs"), None)
    except (TypeError, ValueError):
        return False
    if not (
        _is_shape(attributes.get("patch_shape"))
        and isinstance(attributes.get(DIGESTS), dict)
        and (grid is None or (isinstance(grid, dict) and grid.keys() == set(VECTORS)))
        and (WINDOW not in attributes or (grid is not None and _is_shape(attributes[WINDOW])))
    ):
        return False
    try:
        plane_of(attributes)
    except (TypeError, ValueError):
        return False
    return are_levels(attributes)


def _is_shape(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 2
        and all(type(side) is int and side > 0 for side in value)
    )
