"""Metadata of a store's arrays: which are accepted, and their digests.

Zarr decodes an array as its metadata specify, and some decoders run code contained in the array.
Since a store may come from a stranger, its metadata are read and checked here, and passed on to
Zarr only if they describe an array as clsas writes it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.digests import digest
from clsas.engine.data.grid import Grid
from clsas.engine.data.reading import parse_json, read_bytes
from clsas.mosaics.documents import DIGESTS, DamageError, plane_of, read_attributes
from clsas.mosaics.levels import axis_of, mosaic_arrays, patch_arrays, stored_levels

GROUP = "patches"
"""Name of the group that contains the records; the group has no attributes of its own."""

ITEM_BYTES = {"complex64": 8, "float64": 8, "float32": 4}
"""Size of a value by its type."""

CHECKSUM_BYTES = 4
"""Size in bytes of the checksum behind every chunk."""

_CODECS = [("bytes", {"endian": "little"}), ("crc32c", {})]
_KEYS = {
    "zarr_format", "node_type", "data_type", "shape", "chunk_grid", "chunk_key_encoding",
    "fill_value", "codecs", "attributes", "dimension_names", "storage_transformers",
}  # fmt: skip


@dataclass(frozen=True)
class Form:
    """Required type and shape of an array.

    Attributes
    ----------
    data_type : str
        "complex64", "float64" or "float32".
    shape : tuple of int
    chunk_shape : tuple of int or None
        Shape of a chunk, or None if Zarr chose it.
    fill_value : complex or float
        Value where nothing has been written.
    """

    data_type: str
    shape: tuple[int, ...]
    chunk_shape: tuple[int, ...] | None = None
    fill_value: complex | float = 0


@dataclass(frozen=True)
class Checked:
    """Metadata of an array that have passed the check.

    Attributes
    ----------
    text : bytes
        Contents of the metadata file that was checked.
    chunk_bytes : int
        Size of the file of every chunk.
    digest : str
        Digest of the metadata, which does not depend on the layout of the text.
    """

    text: bytes
    chunk_bytes: int
    digest: str


def forms(attributes: Mapping[str, Any], has_height: bool) -> dict[str, Form]:
    """Return the required form of every array of a store, by its name."""
    rows, columns = attributes["inputs"]["pixels"]
    arrays = [*patch_arrays(attributes), *mosaic_arrays(attributes)]
    found = {
        array.name: Form(array.data_type, array.shape, array.chunk_shape, array.fill_value)
        for array in arrays
    }
    for name, axis in axes_of(attributes).items():
        count = (columns, rows)[axis.side]
        found[name] = Form("float64", (math.ceil(count / axis.factor),))
    if has_height:
        found["height"] = Form("float64", (rows, columns))
    return found


class Axis(NamedTuple):
    """Coordinates of the pixels of a mosaic or of a level, along one side.

    Attributes
    ----------
    dimension : str
        Name of the dimension.
    side : int
        0 for x, 1 for y.
    factor : int
        Factor of the level; 1 for the pixels of the mosaic.
    """

    dimension: str
    side: int
    factor: int

    def values_m(self, plane: Grid) -> NDArray[np.float64]:
        """Return the coordinates, m."""
        return axis_of(plane.axes_m[self.side], self.factor)


def axes_of(attributes: Mapping[str, Any]) -> dict[str, Axis]:
    """Return the axes of a store by the name of their array; none if the grid is rotated."""
    plane, factors = plane_of(attributes), stored_levels(attributes).factors
    if plane is None or not plane.has_axes:
        return {}
    found = {}
    for side, name in enumerate("xy"):
        found[name] = Axis(name, side, 1)
        found |= {f"{factor}x/{name}": Axis(name, side, factor) for factor in factors}
        if factors:
            found[f"overview_{name}"] = Axis(f"overview_{name}", side, factors[-1])
    return found


def has_height(attributes: Mapping[str, Any]) -> bool:
    """Return whether the grid of a store has heights."""
    return "height" in attributes[DIGESTS]


def checked(path: Path, name: str, form: Form, expected: str | None) -> Checked:
    """Return the metadata of an array of a store after checking them.

    Parameters
    ----------
    path : Path
        The store.
    name : str
        Name of the array.
    form : Form
        Required type and shape of the array.
    expected : str or None
        Expected digest, or None for any.

    Raises
    ------
    DamageError
        If the metadata differ from what was written.
    """
    try:
        text = read_bytes(path / name / "zarr.json")
        metadata = parse_json(text)
    except FileNotFoundError as error:
        raise DamageError("its metadata are missing") from error
    except PermissionError:
        raise
    except (OSError, ValueError) as error:
        raise DamageError(f"its metadata cannot be read: {error}") from error
    difference = _difference(metadata, form)
    if difference:
        raise DamageError(f"its metadata are not those of a mosaic: {difference}")
    found = digest(metadata)
    if expected is not None and found != expected:
        raise DamageError("its metadata do not match their digest")
    chunk = math.prod(metadata["chunk_grid"]["configuration"]["chunk_shape"])
    return Checked(text, chunk * ITEM_BYTES[form.data_type] + CHECKSUM_BYTES, found)


def groups_of(attributes: Mapping[str, Any]) -> list[str]:
    """Return the names of the groups of a store: that of the records, and one for each level."""
    return [GROUP, *(f"{factor}x" for factor in stored_levels(attributes).factors)]


def check_group(path: Path, name: str) -> None:
    """Raise DamageError if a group without attributes differs from what was written."""
    try:
        attributes = read_attributes(path / name)
    except PermissionError:
        raise
    except (OSError, DamageError) as error:
        raise DamageError("its metadata cannot be read") from error
    if attributes:
        raise DamageError("it has attributes that were not written")


def _difference(metadata: Any, form: Form) -> str | None:
    """Return the first difference of metadata from what clsas writes, in words, or None."""
    if not isinstance(metadata, dict):
        return "they are not a table"
    if metadata.keys() - _KEYS:
        return f"{sorted(metadata.keys() - _KEYS)[0]!r} is unknown"
    chunks = _named(metadata.get("chunk_grid"))
    encoding = _named(metadata.get("chunk_key_encoding"))
    codecs = metadata.get("codecs")
    codecs = [_named(codec) for codec in codecs] if isinstance(codecs, list) else None
    fill: Any = [0.0, 0.0] if form.data_type == "complex64" else 0.0
    if math.isnan(abs(form.fill_value)):
        fill = "NaN"
    matches = {
        "zarr_format": metadata.get("zarr_format") == 3,
        "node_type": metadata.get("node_type") == "array",
        "data_type": metadata.get("data_type") == form.data_type,
        "shape": _are_counts(metadata.get("shape")) and tuple(metadata["shape"]) == form.shape,
        "chunk_grid": chunks is not None and chunks[0] == "regular" and _fits(chunks[1], form),
        "chunk_key_encoding": encoding in (("default", {"separator": "/"}), ("default", {})),
        "codecs": codecs == _CODECS,
        "fill_value": metadata.get("fill_value") == fill,
        "storage_transformers": metadata.get("storage_transformers", []) == [],
        "attributes": isinstance(metadata.get("attributes", {}), dict),
        "dimension_names": _are_names(metadata.get("dimension_names"), len(form.shape)),
    }
    return next((f"{name} differs" for name, is_same in matches.items() if not is_same), None)


def _named(part: Any) -> tuple[str, Any] | None:
    """Return the name and configuration of a part of metadata, or None if it has no name."""
    if isinstance(part, str):
        return part, {}
    if isinstance(part, dict) and part.keys() <= {"name", "configuration"} and "name" in part:
        return part["name"], part.get("configuration", {})
    return None


def _fits(configuration: Any, form: Form) -> bool:
    """Return whether the chunks agree with a form."""
    if not isinstance(configuration, dict) or configuration.keys() != {"chunk_shape"}:
        return False
    shape = configuration["chunk_shape"]
    if not _are_counts(shape) or len(shape) != len(form.shape):
        return False
    if form.chunk_shape is not None:
        return tuple(shape) == form.chunk_shape
    return all(1 <= side <= most for side, most in zip(shape, form.shape, strict=True))


def _are_counts(values: Any) -> bool:
    return isinstance(values, list) and all(type(n) is int and n > 0 for n in values)


def _are_names(values: Any, count: int) -> bool:
    if values is None:
        return True
    return (
        isinstance(values, list)
        and len(values) == count
        and all(isinstance(name, str) for name in values)
    )
