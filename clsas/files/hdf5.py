"""Grids, range lines, echoes, images and heights in HDF5 files.

docs/format.md describes the schema. It follows the dataclasses: arrays are datasets, numbers and
strings are attributes, nested objects are groups, and fields that are None are left out.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from clsas.engine.data import reading, validate
from clsas.engine.data.atomic import replacing
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.certificate import Certificate
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Formed, Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.sound_speed import SoundSpeed
from clsas.engine.data.system import Pulse
from clsas.engine.signal.echoes import Echoes
from clsas.interferometry.interferogram import Interferogram
from clsas.interferometry.result import Heights

FORMAT = "clsas"
VERSION = 1
_KINDS = {
    "grid": Grid,
    "range_lines": RangeLines,
    "image": Image,
    "formed": Formed,
    "certificate": Certificate,
    "beam": BeamWindow,
    "echoes": Echoes,
    "pulse": Pulse,
    "georeference": Georeference,
    "interferogram": Interferogram,
    "heights": Heights,
    "sound_speed": SoundSpeed,
}
_SAVED = (Grid, RangeLines, Image, Echoes, Interferogram, Heights)

SUFFIXES = (".h5", ".hdf5", ".he5")
"""Suffixes that HDF5 files may have."""

Saved = Grid | RangeLines | Image | Echoes | Interferogram | Heights


class FileFormatError(ValueError):
    """The file is damaged, incomplete, or of a format or version that clsas does not read."""


def save(path: str | os.PathLike, obj: Saved) -> None:
    """Write an object to an HDF5 file. An existing file is replaced in one step.

    Parameters
    ----------
    path : path-like
        The file, whose folder must exist. Its name must have one of the `SUFFIXES` or none.
    obj : Grid, RangeLines, Image, Echoes, Interferogram or Heights
        The object; `load` returns it bit for bit.

    Raises
    ------
    TypeError
        If `obj` is of another type.
    ValueError
        If the file name has the suffix of another format, such as .tif, or `path` is a device, a
        pipe or a socket.
    OSError
        If the folder does not exist or the file cannot be written, for example on a full disk.

    Notes
    -----
    The file is assembled in memory first, since HDF5 does not recover from a full disk. This takes
    as much memory again as the object.
    """
    path = validate.path("path", path)
    validate.suffix("path", path, *SUFFIXES)
    validate.instance("obj", obj, *_SAVED)
    with replacing(path) as temporary:
        memory = BytesIO()
        # HDF5 protects all of its metadata with checksums only from format 1.10 on.
        with h5py.File(memory, "w", libver=("v110", "v110")) as content:
            _set(content, "format", FORMAT)
            content.attrs["version"] = VERSION
            _write(content, obj)
        temporary.write_bytes(memory.getbuffer())


def load(path: str | os.PathLike) -> Saved:
    """Return the object in a file that `save` wrote.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    Grid, RangeLines, Image, Echoes, Interferogram or Heights
        The object that was saved, bit for bit.

    Raises
    ------
    FileFormatError
        If the file is not HDF5, was not written by clsas, has another version, is incomplete or
        damaged, is larger than memory when unpacked, or contains links.
    OSError
        If the file does not exist (FileNotFoundError) or cannot be read.
    """
    with _opened(validate.path("path", path)) as file:
        obj = _read(file, validate.Budget())
        if not isinstance(obj, _SAVED):
            raise FileFormatError(f"contains only a {type(obj).__name__}")
        return obj


def read_geometry(path: str | os.PathLike) -> tuple[RangeLines, int]:
    """Return the range lines in a file, without their samples.

    Returns
    -------
    lines : RangeLines
        Lines with one sample per channel, whose value is zero.
    length : int
        Samples per channel in the file.

    Raises
    ------
    FileFormatError, OSError
        As for `load`, or if the file contains another kind of object.
    """
    with _opened(path) as file:
        dataset = _samples_of(file)
        nothing = np.zeros((dataset.shape[0], 1), np.complex64)
        return _read(file, validate.Budget(), samples=nothing), dataset.shape[1]


def read_samples(path: str | os.PathLike, rows: slice, columns: slice) -> np.ndarray:
    """Return a part of the samples of range lines in a file, [channels, samples].

    Raises
    ------
    FileFormatError, OSError
        As for `read_geometry`.
    """
    with _opened(path) as file:
        samples = _samples_of(file)
        counts = [
            len(range(n)[part]) for n, part in zip(samples.shape, (rows, columns), strict=True)
        ]
        _take(validate.Budget(), samples, samples.dtype.itemsize * math.prod(counts))
        return samples[rows, columns]


@contextmanager
def _opened(path: str | os.PathLike) -> Iterator[h5py.File]:
    """Open a clsas file for reading; any defect raises FileFormatError."""
    with opened(path) as file:
        if _attribute(file, "format") != FORMAT:
            raise FileFormatError(
                "is an HDF5 file, but was not written by clsas: it lacks the attribute format"
            )
        version = _attribute(file, "version")
        if not isinstance(version, int):
            raise FileFormatError(
                f"is damaged: its attribute version must be a number, got {version!r}"
            )
        if version != VERSION:
            raise FileFormatError(
                f"is of format version {version}, but this clsas reads version {VERSION}"
            )
        yield file


@contextmanager
def opened(path: str | os.PathLike) -> Iterator[h5py.File]:
    """Open any HDF5 file for reading; any defect raises FileFormatError.

    The file's name is put in front of the messages that the code reading the file raises.
    """
    path = Path(path)
    try:
        reading.check_ordinary(path)
    except ValueError as error:
        raise FileFormatError(str(error)) from None
    with path.open("rb"):
        pass  # raises if the file cannot be opened, with a clearer message than that of HDF5
    if not h5py.is_hdf5(path):
        raise FileFormatError(f"{path} is not an HDF5 file")
    try:
        with h5py.File(path, "r") as file:
            yield file
    except FileFormatError as error:
        raise FileFormatError(f"{path} {error}") from None
    # h5py raises any of these exceptions on damaged files.
    except (OSError, RuntimeError, LookupError, ValueError, TypeError) as error:
        raise FileFormatError(f"{path} is damaged: {error}") from error


def _write(group: h5py.Group, obj: Any) -> None:
    _set(group, "kind", next(name for name, kind in _KINDS.items() if type(obj) is kind))
    for field in fields(obj):
        value = getattr(obj, field.name)
        if value is None:
            continue
        if isinstance(value, np.ndarray):
            # A checksum, so that damage is detected.
            group.create_dataset(field.name, data=value, fletcher32=True)
        elif type(value) in _KINDS.values():
            _write(group.create_group(field.name), value)
        else:
            _set(group, field.name, value)


def _samples_of(file: h5py.File) -> h5py.Dataset:
    kind = _attribute(file, "kind")
    if kind != "range_lines":
        raise FileFormatError(f"must contain range lines, got {validate.shown(kind)}")
    samples = find_item(file, "samples")
    if not isinstance(samples, h5py.Dataset):
        raise FileFormatError("lacks samples of the range_lines at /")
    if samples.dtype.kind != "c" or len(samples.shape or ()) != 2 or not samples.size:
        raise FileFormatError(
            "must contain samples as complex numbers, [channels, samples], got "
            f"{samples.dtype} of shape {samples.shape}"
        )
    return samples


def _read(group: h5py.Group, budget: validate.Budget, **instead: Any) -> Any:
    """Return the object in a group. Fields in `instead` are taken from there, not read."""
    name = _attribute(group, "kind")
    if not isinstance(name, str) or name not in _KINDS:
        where = f"{validate.shown(name)} at {validate.shown(group.name)}"
        raise FileFormatError(f"contains an object of unknown kind {where}")
    kind = _KINDS[name]
    values = {}
    for field in fields(kind):
        if field.name in instead:
            values[field.name] = instead[field.name]
            continue
        if field.name in group.attrs:
            values[field.name] = _attribute(group, field.name)
            continue
        kinds_of_values = "b" if "bool" in str(field.type) else "iufc"
        if (item := find_item(group, field.name, kinds_of_values)) is not None:
            is_group = isinstance(item, h5py.Group)
            # Check the kind before reading, since a group may contain a link to itself.
            classes = str(field.type).split(" | ")  # such as "Pulse | None"
            allowed = next((each for each, one in _KINDS.items() if one.__name__ in classes), None)
            if is_group and allowed != _attribute(item, "kind"):
                raise FileFormatError(f"contains another object as {field.name} of the {name}")
            values[field.name] = _read(item, budget) if is_group else read_values(item, budget)
        elif "None" in str(field.type):
            values[field.name] = None
        else:
            raise FileFormatError(f"lacks {field.name} of the {name} at {group.name}")
    return kind(**values)


def find_item(
    group: h5py.Group, name: str, kinds: str = "iufc"
) -> h5py.Group | h5py.Dataset | None:
    """Return a group or dataset of the file, or None if none has that name.

    The type of a dataset must be one of NumPy's `kinds`.

    Links are refused, so that a file cannot determine which other files are read.
    """
    link = group.get(name, getlink=True)
    if link is None:
        return None
    if not isinstance(link, h5py.HardLink):
        raise FileFormatError(f"must contain {name} itself, got a link to another place")
    item = group[name]
    if isinstance(item, h5py.Dataset):
        if item.is_virtual or item.external:
            raise FileFormatError(
                f"must contain {name} itself, got a dataset stored in other files"
            )
        if item.dtype.kind not in kinds:
            wanted = "bools" if kinds == "b" else "numbers"
            raise FileFormatError(f"must contain {name} as {wanted}, got {item.dtype}")
    elif not isinstance(item, h5py.Group):
        raise FileFormatError(f"must contain {name} as a dataset, got a named datatype")
    return item


def read_values(dataset: h5py.Dataset, budget: validate.Budget) -> np.ndarray:
    """Return the values of a dataset; raise FileFormatError if it is incomplete or too large."""
    check_whole(dataset)
    _take(budget, dataset, dataset.nbytes)
    return dataset[()]


def check_whole(dataset: h5py.Dataset) -> None:
    """Raise FileFormatError if parts of a dataset are missing, for which HDF5 returns zeros."""
    if dataset.chunks is None:
        whole = dataset.id.get_storage_size() >= dataset.nbytes
    else:
        counts = map(math.ceil, np.divide(dataset.shape, dataset.chunks))
        whole = dataset.id.get_num_chunks() == math.prod(counts)
    if not whole:
        raise FileFormatError(f"lacks a part of {dataset.name}, of shape {dataset.shape}")


def unpacking_bytes(dataset: h5py.Dataset) -> int:
    """Return the bytes that reading a dataset takes temporarily: two buffers, each of a chunk."""
    return 2 * math.prod(dataset.chunks or (0,)) * dataset.dtype.itemsize


def _take(budget: validate.Budget, dataset: h5py.Dataset, size_bytes: int) -> None:
    """Raise FileFormatError unless `size_bytes` of a dataset can be read into memory."""
    name = f"reading {dataset.name}"
    with too_large():
        budget.take(name, size_bytes, passing_bytes=unpacking_bytes(dataset))


@contextmanager
def too_large() -> Iterator[None]:
    """Convert the error of a memory budget into a FileFormatError: the file is too large."""
    try:
        yield
    except ValueError as error:
        raise FileFormatError(f"is too large: {error}") from None


def _set(group: h5py.Group, name: str, value: Any) -> None:
    # HDF5's checksums cover strings of fixed length, but not those of variable length.
    if isinstance(value, str):
        value = np.bytes_(value.encode())
    elif isinstance(value, tuple) and value and all(isinstance(each, str) for each in value):
        value = np.array([each.encode() for each in value], np.bytes_)
    group.attrs[name] = value


def _attribute(group: h5py.Group, name: str) -> Any:
    """Return an attribute as a Python number, string or list, or None if it is missing."""
    value = group.attrs.get(name)
    value = value.tolist() if isinstance(value, np.generic | np.ndarray) else value
    if isinstance(value, list):
        return [each.decode() if isinstance(each, bytes) else each for each in value]
    return value.decode() if isinstance(value, bytes) else value
