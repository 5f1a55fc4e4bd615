"""Numbers and structures from MATLAB files of version 5 to 7.

The files are not trusted. SciPy's reader crashes with a segmentation fault on some damaged files,
and allocates as much memory as cells claim to contain. This reader supports the part of the format
that recordings use. It compares every size with the file's contents, or with the available memory,
before it allocates anything.
"""

from __future__ import annotations

import math
import os
import struct
import zlib
from typing import Any

import numpy as np

from clsas.engine.data import reading, validate
from clsas.files.hdf5 import FileFormatError, too_large

_HEADER = 128  # bytes: a text, followed by the version and the byte order
_MATRIX, _COMPRESSED = 14, 15  # types of elements
_STRUCTURE, _COMPLEX = 2, 0x800  # class and flag of a matrix
_DEEPEST = 32  # levels of nested structures: arbitrary, more than any recording has
_PARTS, _PART_BYTES = 1000, 256  # elements per check of memory; bytes of one without its numbers
# Types of numbers in the file, and those of every class of matrix. They may differ: a double whose
# value is small may be stored as a byte.
_STORED = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
_CLASSES = dict(enumerate(("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"), start=6))


def is_matlab(start: bytes) -> bool:
    """Return whether a file that begins with these bytes is a MATLAB file of version 5 to 7."""
    return len(start) >= _HEADER and start[126:128] in (b"IM", b"MI") and start[:6] == b"MATLAB"


def read_matlab(path: str | os.PathLike) -> dict[str, Any]:
    """Return the variables of a MATLAB file by name: numbers as arrays, structures as dicts.

    Arrays lose their axes of length 1. Variables of other kinds, and arrays of structures, become
    None.

    Raises
    ------
    FileFormatError
        If the file is not of version 5 to 7, is damaged, claims more data than it contains, or is
        larger than memory when unpacked.
    OSError
        If the file cannot be read.
    """
    path = validate.path("path", path)
    try:
        reading.check_ordinary(path)
        budget = validate.Budget()
        budget.take(str(path), path.stat().st_size)
        content = path.read_bytes()
    except ValueError as error:
        raise FileFormatError(str(error)) from None
    if not is_matlab(content):
        raise FileFormatError(f"{path} is not a MATLAB file of version 5 to 7")
    try:
        return _variables(content, budget)
    except FileFormatError as error:
        raise FileFormatError(f"{path} {error}") from None
    except MemoryError:
        raise
    except (ValueError, LookupError, struct.error, zlib.error) as error:
        raise FileFormatError(f"{path} is damaged: {error}") from error


def fields_of(path: str | os.PathLike, *names: str) -> dict[str, Any]:
    """Return the structure of a MATLAB file, or its variables, with all the given fields.

    Raises
    ------
    FileFormatError, OSError
        As for `read_matlab`, or if no structure or more than one has the fields.
    """
    return only(path, groups(read_matlab(path), *names), *names)


def groups(variables: dict[str, Any], *names: str) -> list[dict[str, Any]]:
    """Return the groups, the file's variables or its structures, that have all given names."""
    return [
        group
        for group in (variables, *variables.values())
        if isinstance(group, dict) and all(name in group for name in names)
    ]


def only(path: str | os.PathLike, found: list[dict[str, Any]], *names: str) -> dict[str, Any]:
    """Return the only structure that was found; raise FileFormatError for none or several."""
    if len(found) != 1:
        raise FileFormatError(
            f"{os.fspath(path)} must contain one structure with the fields {', '.join(names)}, got "
            f"{len(found)}"
        )
    return found[0]


def numbers(
    path: str | os.PathLike, group: dict[str, Any], name: str, ndim: int, kinds: str = "iuf"
) -> np.ndarray:
    """Return a field of numbers with `ndim` axes, adding missing axes of length 1 at the end."""
    value = np.asarray(group.get(name))
    if value.dtype.kind not in kinds or value.ndim > ndim or not value.size:
        expected = "complex" if kinds == "c" else "real"
        raise FileFormatError(
            f"{os.fspath(path)} must contain {name} as {expected} numbers with {ndim} axes, got "
            f"{value.dtype} of shape {value.shape}"
        )
    return value.reshape(value.shape + (1,) * (ndim - value.ndim))


def _variables(content: bytes, budget: validate.Budget) -> dict[str, Any]:
    """Return the variables of a file by name."""
    order = "<" if content[126:128] == b"IM" else ">"
    found: dict[str, Any] = {}
    place = _HEADER
    while place + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, place)
        body = memoryview(content)[place + 8 : place + 8 + size]
        if len(body) < size:
            raise FileFormatError("is damaged: its last variable is cut off")
        place += 8 + size
        unpacked_bytes = 0
        if kind == _COMPRESSED:
            kind, body = _unpacked(body, order, budget)
            unpacked_bytes = len(body)
        if kind != _MATRIX:
            raise FileFormatError(f"is damaged: it contains an element of type {kind}")
        name, value = _matrix(body, order, 0, budget)
        budget.give_back(unpacked_bytes)
        found[name] = value
    return found


def _unpacked(packed: memoryview, order: str, budget: validate.Budget) -> tuple[int, memoryview]:
    """Return the type and contents of a compressed variable, if it fits into memory."""
    # The first 8 bytes give the type and the size.
    unpacker = zlib.decompressobj()
    kind, size = struct.unpack(f"{order}II", unpacker.decompress(packed, 8))
    with too_large():
        budget.take("unpacking it", size, passing_bytes=size)
    content = unpacker.decompress(unpacker.unconsumed_tail, size) if size else b""
    # Only the checksum follows, which the unpacker verifies.
    if unpacker.decompress(unpacker.unconsumed_tail, 1) or not unpacker.eof or len(content) < size:
        raise FileFormatError("is damaged: a variable does not unpack to its size")
    return kind, memoryview(content)


def _matrix(body: memoryview, order: str, depth: int, budget: validate.Budget) -> tuple[str, Any]:
    """Return the name and value of a matrix."""
    if depth > _DEEPEST:
        raise FileFormatError(f"must have at most {_DEEPEST} levels of nested structures")
    parts = _elements(body, order, budget)
    if not parts:
        return "", np.zeros(0)
    flags = struct.unpack_from(f"{order}I", parts[0][1])[0]
    kind = flags & 0xFF
    name = bytes(parts[2][1]).decode("latin-1")
    if kind not in _CLASSES and kind != _STRUCTURE:
        return name, None
    shape = [int(n) for n in np.frombuffer(parts[1][1], np.dtype(f"{order}i4"))]
    if len(shape) < 2 or min(shape) < 0:
        raise FileFormatError(f"is damaged: a variable has the shape {validate.shown(shape)}")
    if kind == _STRUCTURE:
        if math.prod(shape) != 1:
            return name, None
        length = struct.unpack_from(f"{order}i", parts[3][1])[0]
        names = bytes(parts[4][1])
        if length < 1 or len(names) // length != len(parts) - 5:
            raise FileFormatError("is damaged: a structure lacks names or values of fields")
        fields = [
            names[n : n + length].split(b"\0")[0].decode("latin-1")
            for n in range(0, len(names) // length * length, length)
        ]
        values = [_matrix(part, order, depth + 1, budget)[1] for _, part in parts[5:]]
        return name, dict(zip(fields, values, strict=True))
    value = _array(parts[3], shape, kind, order, budget)
    if flags & _COMPLEX:
        imaginary = _array(parts[4], shape, kind, order, budget)
        complex_bytes = math.prod(shape) * np.result_type(value, np.complex64).itemsize
        with too_large():
            budget.take("reading complex numbers", complex_bytes, passing_bytes=complex_bytes)
        budget.give_back(2 * value.nbytes)
        value = value + np.result_type(value, np.complex64).type(1j) * imaginary
    return name, value.squeeze()


def _elements(
    body: memoryview, order: str, budget: validate.Budget
) -> list[tuple[int, memoryview]]:
    """Return the type and contents of every element of a matrix."""
    found, place = [], 0
    while place + 8 <= len(body):
        kind, size = struct.unpack_from(f"{order}II", body, place)
        start, place = place + 8, place + 8 + size + -size % 8
        if kind >> 16:  # a short element, whose up to 4 bytes are in the tag
            size, kind, start, place = kind >> 16, kind & 0xFFFF, start - 4, start
        if start + size > min(len(body), place):
            raise FileFormatError("is damaged: a variable contains less than it claims")
        found.append((kind, body[start : start + size]))
        if not len(found) % _PARTS:
            with too_large():
                budget.take("reading fields", _PARTS * _PART_BYTES)
    return found


def _array(
    part: tuple[int, memoryview], shape: list[int], kind: int, order: str, budget: validate.Budget
) -> np.ndarray:
    stored = np.dtype(order + _STORED[part[0]])
    count = math.prod(shape)
    if count * stored.itemsize != len(part[1]):
        raise FileFormatError(
            f"is damaged: {len(part[1])} bytes are not a variable of shape {validate.shown(shape)}"
        )
    with too_large():
        budget.take("reading numbers", count * np.dtype(_CLASSES[kind]).itemsize)
    # MATLAB stores arrays column by column.
    return np.frombuffer(part[1], stored).astype(_CLASSES[kind]).reshape(shape, order="F")
