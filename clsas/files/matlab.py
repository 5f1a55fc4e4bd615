"""MATLAB files of version 5 to 7, read by SciPy after a check of their sizes.

A file decides how much memory a reader allocates: by how far its parts unpack, and by the number of
elements that cells and structures claim. Both are compared with the memory, and with what is there,
before SciPy reads the file.
"""

from __future__ import annotations

import math
import os
import struct
import zlib
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from clsas.core import reading, validate
from clsas.files.hdf5 import FileFormatError

_HEADER = 128  # bytes: text, and at their end version and byte order
_MATRIX, _COMPRESSED = 14, 15  # types of elements
_CELL, _STRUCT, _OBJECT = 1, 2, 3  # classes of matrices that hold further matrices
_DEEPEST = 32  # matrices within matrices
_READ_TIMES = 6  # memory that SciPy and a reader take per unpacked byte: 16-bit samples as complex


def is_matlab(start: bytes) -> bool:
    """Return whether the first bytes of a file are those of a MATLAB file, version 5 to 7."""
    return len(start) >= _HEADER and start[126:128] in (b"IM", b"MI") and start[:6] == b"MATLAB"


def read_matlab(path: str | os.PathLike) -> dict[str, Any]:
    """Read the variables of a MATLAB file: structures as dicts, without axes of length 1.

    Raises
    ------
    FileFormatError
        If the file is not one of version 5 to 7, is damaged, claims more than it holds, or is
        larger than memory when unpacked.
    OSError
        If the file cannot be read.
    """
    path = Path(path)
    try:
        content = reading.read_bytes(path)
    except ValueError as error:
        raise FileFormatError(str(error)) from None
    if not is_matlab(content):
        raise FileFormatError(f"{path} is not a MATLAB file of version 5 to 7")
    try:
        _check_sizes(content)
        return _loaded(content)
    except FileFormatError as error:
        raise FileFormatError(f"{path} {error}") from None
    except MemoryError:
        raise
    # SciPy reports damage by any exception.
    except Exception as error:
        raise FileFormatError(f"{path} is damaged: {error}") from error


def fields_of(path: str | os.PathLike, *names: str) -> dict[str, Any]:
    """Read the structure of a MATLAB file, or its variables, that has all these fields.

    Raises
    ------
    FileFormatError, OSError
        As `read_matlab` does, and if there is none, or more than one.
    """
    return only(path, groups(read_matlab(path), *names), *names)


def groups(variables: dict[str, Any], *names: str) -> list[dict[str, Any]]:
    """Return the sets of variables that have all these names: those of the file, or structures."""
    return [
        group
        for group in (variables, *variables.values())
        if isinstance(group, dict) and all(name in group for name in names)
    ]


def only(path: str | os.PathLike, found: list[dict[str, Any]], *names: str) -> dict[str, Any]:
    """Return the one structure that was found; raise FileFormatError for none or several."""
    if len(found) != 1:
        raise FileFormatError(
            f"{os.fspath(path)} must hold one structure with the fields {', '.join(names)}, got "
            f"{len(found)}"
        )
    return found[0]


def numbers(path: str | os.PathLike, group: dict[str, Any], name: str, ndim: int) -> np.ndarray:
    """Return a field that holds numbers, with `ndim` axes; those of length 1 may be missing."""
    value = np.asarray(group.get(name))
    if value.dtype.kind not in "iufc" or value.ndim > ndim or not value.size:
        raise FileFormatError(
            f"{os.fspath(path)} must hold {name} as numbers with {ndim} axes, got "
            f"{value.dtype} of shape {value.shape}"
        )
    return value.reshape(value.shape + (1,) * (ndim - value.ndim))


def _loaded(content: bytes) -> dict[str, Any]:
    # Several variables of one name, and other oddities, are warnings of SciPy that say nothing here.
    import warnings

    from scipy.io import loadmat  # slow to import

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return loadmat(BytesIO(content), simplify_cells=True, verify_compressed_data_integrity=True)


def _check_sizes(content: bytes) -> None:
    """Raise FileFormatError for parts that unpack beyond memory, or claim more than they hold."""
    order = "<" if content[126:128] == b"IM" else ">"
    place, unpacked = _HEADER, 0
    while place + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, place)
        body = memoryview(content)[place + 8 : place + 8 + size]
        if len(body) < size:
            raise FileFormatError("is damaged: its last variable is cut off")
        if kind == _COMPRESSED:
            body = memoryview(_unpacked(bytes(body), unpacked, order))
            kind, size = struct.unpack_from(f"{order}II", body)
            unpacked += len(body)
            body = body[8:]
            if len(body) < size:
                raise FileFormatError("is damaged: a compressed variable is cut off")
        if kind == _MATRIX:
            _check_matrix(body, order, 0)
        place += 8 + struct.unpack_from(f"{order}I", content, place + 4)[0]


def _unpacked(packed: bytes, before: int, order: str) -> bytes:
    """Unpack a variable, whose first 8 bytes tell its size, if that fits into memory."""
    unpacker = zlib.decompressobj()
    tag = unpacker.decompress(packed, 8)
    if len(tag) < 8:
        raise FileFormatError("is damaged: a compressed variable is cut off")
    size = struct.unpack(f"{order}I", tag[4:])[0]
    try:
        validate.memory("unpacking it", _READ_TIMES * (before + size))
    except ValueError as error:
        raise FileFormatError(f"is too large: {error}") from None
    return tag + unpacker.decompress(unpacker.unconsumed_tail, max(size, 1))


def _elements(body: memoryview, order: str) -> list[tuple[int, memoryview]]:
    """Return type and content of the elements of a matrix."""
    found, place = [], 0
    while place + 8 <= len(body):
        kind, size = struct.unpack_from(f"{order}II", body, place)
        if kind >> 16:  # up to 4 bytes, within the tag
            size, kind, start = kind >> 16, kind & 0xFFFF, place + 4
            place += 8
        else:
            start = place + 8
            place = start + size + -size % 8
        if start + size > len(body):
            raise FileFormatError("is damaged: a variable holds less than it claims")
        found.append((kind, body[start : start + size]))
    return found


def _check_matrix(body: memoryview, order: str, depth: int) -> None:
    if depth > _DEEPEST:
        raise FileFormatError(f"must hold at most {_DEEPEST} levels of structures")
    parts = _elements(body, order)
    if not parts:
        return  # an empty matrix
    if len(parts) < 2 or len(parts[0][1]) < 4:
        raise FileFormatError("is damaged: a variable lacks its header")
    flags = struct.unpack_from(f"{order}I", parts[0][1])[0]
    if flags & 0xFF not in (_CELL, _STRUCT, _OBJECT):
        return  # numbers: SciPy compares them with their shape
    count = math.prod(
        struct.unpack(f"{order}{len(parts[1][1]) // 4}i", parts[1][1][: len(parts[1][1]) // 4 * 4])
    )
    held = [part for kind, part in parts if kind == _MATRIX]
    if not 0 <= count <= max(len(held), 1):
        raise FileFormatError("is damaged: a structure claims more elements than it holds")
    for part in held:
        _check_matrix(part, order, depth + 1)
