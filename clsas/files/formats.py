"""Reading and writing of files of all kinds, which are distinguished by their contents."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py

from clsas.engine.data import reading, validate
from clsas.engine.data.lines import RangeLines
from clsas.files import cphd, hdf5, matlab
from clsas.files.airsas import is_airsas, read_airsas
from clsas.files.full_matrix import FIELDS as FULL_MATRIX
from clsas.files.full_matrix import full_matrix_lines
from clsas.files.hdf5 import FileFormatError, Saved
from clsas.files.phase_histories import FIELDS as PHASE_HISTORY
from clsas.files.phase_histories import phase_history_lines
from clsas.files.positions import checked


def load(path: str | os.PathLike) -> Saved:
    """Return the object in a file that `save` wrote, or the range lines of another recording.

    The kind of file is determined by its contents, not its name. Recordings are read with the
    defaults of `read_cphd`, `read_phase_history`, `read_full_matrix` or `read_airsas`; call these
    functions to set their options.

    Parameters
    ----------
    path : path-like
        The file: HDF5 from clsas or AirSAS, CPHD, or a MATLAB file with a phase history or a full
        matrix capture.

    Returns
    -------
    Grid, RangeLines, Image, Echoes, Interferogram or Heights
        The object that was saved, bit for bit; RangeLines for CPHD files and recordings.

    Raises
    ------
    FileFormatError
        If the file is of another kind, has another version, is incomplete or damaged, is
        larger than memory when unpacked, or contains links.
    ImportError
        If the file is CPHD and sarkit is not installed (extra `radar`).
    OSError
        If the file does not exist (FileNotFoundError) or cannot be read.

    See Also
    --------
    save : Write a file.

    Examples
    --------
    >>> import tempfile
    >>> import clsas
    >>> grid = clsas.Grid.plane((-5, 5, 101), (20, 40, 201))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     clsas.save(f"{folder}/grid.h5", grid)
    ...     clsas.load(f"{folder}/grid.h5").shape
    (201, 101)
    """
    path = validate.path("path", path)
    found = format_of(path)
    if found is None:
        names = ", ".join(each.name for each in FORMATS)
        raise FileFormatError(f"{path} is of none of the formats that clsas reads: {names}")
    return found.read(path)


def save(path: str | os.PathLike, obj: Saved) -> None:
    """Write an object to an HDF5 file, or range lines to a CPHD file.

    An existing file is replaced in one step and keeps its mode. If `path` is a symbolic link, the
    file that it leads to is replaced.

    Parameters
    ----------
    path : path-like
        File to write, in a folder that exists. The suffix selects the format: .h5, .hdf5, .he5 or
        no suffix for HDF5, and .cphd for CPHD (see `write_cphd`).
    obj : Grid, RangeLines, Image, Echoes, Interferogram or Heights
        The object. `load` returns it from HDF5 bit for bit.

    Raises
    ------
    TypeError
        If `obj` is of another type.
    ValueError
        If the file name has the suffix of another format, such as .tif, if CPHD cannot represent
        the lines, or if `path` is a device, a pipe or a socket.
    ImportError
        If a CPHD file is requested and sarkit is not installed (extra `radar`).
    OSError
        If the folder does not exist or the file cannot be written, for example on a full disk.

    See Also
    --------
    load : Read the file, with an example.

    Notes
    -----
    HDF5 files are assembled in memory first, since HDF5 does not recover from a full disk. This
    takes as much memory again as the object.
    """
    path = validate.path("path", path)
    validate.suffix("path", path, *SUFFIXES)
    named = format_named(path)
    if named is None:
        hdf5.save(path, obj)
        return
    if named.has_only_lines:
        validate.instance("obj", obj, RangeLines)
    assert named.write is not None  # as the format has a suffix
    named.write(path, obj)


def format_named(path: Path) -> Format | None:
    """Return the format that the suffix of a path selects; None without a suffix."""
    return next((each for each in FORMATS if path.suffix.lower() in each.suffixes), None)


def format_of(path: Path) -> Format | None:
    """Return the format of a file by its contents, or None if it is none of the `FORMATS`.

    Raises
    ------
    FileFormatError
        If the file is empty, a device, a pipe or a socket.
    OSError
        If the file does not exist or cannot be read.
    """
    try:
        reading.check_ordinary(path)
    except ValueError as error:
        raise FileFormatError(str(error)) from None
    with path.open("rb") as file:
        start = file.read(128)
    if not start:
        raise FileFormatError(f"{path} is empty")
    return next((each for each in FORMATS if each.is_of(path, start)), None)


def _read_hdf5(path: Path) -> Saved:
    with hdf5.opened(path) as content:
        foreign = "format" not in content.attrs and is_airsas(content)
    if foreign:
        return read_airsas(path)
    saved = hdf5.load(path)
    return checked(path, saved) if isinstance(saved, RangeLines) else saved


def _read_matlab(path: Path) -> RangeLines:
    variables = matlab.read_matlab(path)
    for fields, lines_of in (
        (PHASE_HISTORY, phase_history_lines),
        (FULL_MATRIX, full_matrix_lines),
    ):
        if found := matlab.groups(variables, *fields):
            return lines_of(path, matlab.only(path, found, *fields))
    raise FileFormatError(
        f"{path} must contain one structure with the fields {', '.join(PHASE_HISTORY)} or "
        f"{', '.join(FULL_MATRIX)}"
    )


@dataclass(frozen=True)
class Format:
    """A format of files.

    Attributes
    ----------
    name : str
        Name in messages, help texts and the documentation.
    is_of : callable
        Called as is_of(path, its first 128 bytes); returns whether a file is of this format.
    read : callable
        Called with the path; returns the object.
    suffixes : tuple of str
        Suffixes of files that `save` writes in this format.
    write : callable or None
        Called as write(path, object).
    has_only_lines : bool
        True if `write` takes nothing but range lines.
    """

    name: str
    is_of: Callable[[Path, bytes], bool]
    read: Callable[[Path], Saved]
    suffixes: tuple[str, ...] = ()
    write: Callable[[Path, Any], None] | None = None
    has_only_lines: bool = False


FORMATS = (
    Format(
        "CPHD", lambda _, start: start.startswith(cphd.START), cphd.read_cphd,
        cphd.SUFFIXES, cphd.write_cphd, has_only_lines=True,
    ),
    Format("MATLAB 5 to 7", lambda _, start: matlab.is_matlab(start), _read_matlab),
    Format("HDF5", lambda path, _: h5py.is_hdf5(path), _read_hdf5, hdf5.SUFFIXES, hdf5.save),
)  # fmt: skip
"""Formats that `load` reads and `save` writes. A file is of the first that recognizes it."""

SUFFIXES = tuple(suffix for each in FORMATS[::-1] for suffix in each.suffixes)
"""Suffixes of files that `save` writes."""
