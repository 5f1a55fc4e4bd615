"""Documents of a store: JSON attributes of Zarr groups, with checksums.

The store's own document describes the mosaic and what it was made with. Every finished patch has
one more (`clsas.mosaics.record`).
"""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import Any

from clsas.core.atomic import make_folders, replacing
from clsas.core.reading import parse_json, read_bytes

CHECKSUM = "crc32"
"""Attribute with the checksum of all others."""


FORMAT = "clsas mosaic"
VERSION = 2  # version 1 had no checksums


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
        attributes = parse_json(read_bytes(folder / "zarr.json"))["attributes"]
    except (ValueError, LookupError, TypeError) as error:
        raise DamageError("its record cannot be read") from error
    if not isinstance(attributes, dict):
        raise DamageError("its record cannot be read")
    return attributes


def write_attributes(folder: Path, attributes: dict[str, Any]) -> None:
    """Write a Zarr group with attributes, and wait until it is on the disk."""
    make_folders(folder)
    document = {"zarr_format": 3, "node_type": "group", "attributes": attributes}
    with replacing(folder / "zarr.json") as temporary:
        temporary.write_text(json.dumps(document, indent=1))


def with_checksum(attributes: dict[str, Any]) -> dict[str, Any]:
    """Return attributes with a checksum added."""
    others = {name: value for name, value in attributes.items() if name != CHECKSUM}
    text = json.dumps(others, sort_keys=True, separators=(",", ":"))
    return others | {CHECKSUM: f"{zlib.crc32(text.encode()):08x}"}


def is_intact(attributes: dict[str, Any]) -> bool:
    """Return whether attributes match their checksum."""
    return attributes == with_checksum(attributes)


def read_document(path: Path) -> dict[str, Any]:
    """Return the attributes of a whole mosaic.

    Raises
    ------
    ValueError
        If the path holds something else, a mosaic of another version, or a damaged one.
    """
    try:
        attributes = read_attributes(path)
    except (OSError, DamageError) as error:
        raise ValueError(f"{path} exists and is not a mosaic of clsas") from error
    if attributes.get("format") != FORMAT:
        raise ValueError(f"{path} exists and is not a mosaic of clsas")
    if attributes.get("version") != VERSION:
        raise ValueError(
            f"{path} is a mosaic of version {attributes.get('version')}, this clsas works "
            f"with version {VERSION}: give it another path"
        )
    if not is_intact(attributes):
        raise ValueError(f"{path} is damaged: its attributes do not match their checksum")
    shape, inputs = attributes.get("patch_shape"), attributes.get("inputs")
    complete = isinstance(inputs, dict) and isinstance(inputs.get("parts"), list)
    complete = complete and isinstance(shape, list) and [type(n) for n in shape] == [int, int]
    if not complete:
        raise ValueError(f"{path} is damaged: its attributes are not those of a mosaic")
    return attributes
