"""Files of every kind that clsas reads and writes, told apart by their contents."""

from __future__ import annotations

import os

import h5py

from clsas.core import reading, validate
from clsas.core.lines import RangeLines
from clsas.files import cphd, cphd_writing, hdf5, matlab
from clsas.files.airsas import is_airsas, read_airsas
from clsas.files.full_matrix import FIELDS as FULL_MATRIX
from clsas.files.full_matrix import full_matrix_lines
from clsas.files.hdf5 import FileFormatError, Saved
from clsas.files.phase_histories import FIELDS as PHASE_HISTORY
from clsas.files.phase_histories import phase_history_lines

SUFFIXES = (*hdf5.SUFFIXES, *cphd_writing.SUFFIXES)
"""Suffixes of files that `save` writes."""


def load(path: str | os.PathLike) -> Saved:
    """Read a file that `save` wrote, or a recording of another kind as range lines.

    The content decides, not the name. Recordings are read with the defaults of `read_cphd`,
    `read_phase_history`, `read_full_matrix` or `read_airsas`, which take options.

    Parameters
    ----------
    path : path-like
        The file: HDF5 of clsas or of AirSAS, CPHD, or MATLAB's with a phase history or a full
        matrix capture.

    Returns
    -------
    Grid, RangeLines, Image or Echoes
        What was saved, bit for bit; for CPHD files and recordings RangeLines.

    Raises
    ------
    FileFormatError
        If the file is of no such kind, was written by a newer version, is incomplete or damaged, is
        larger than memory when unpacked, or contains links.
    ImportError
        If it is a CPHD file and sarkit is not installed (extra `radar`).
    OSError
        If the file does not exist (FileNotFoundError) or cannot be read.
    """
    path = validate.path("path", path)
    try:
        reading.check_ordinary(path)
    except ValueError as error:
        raise FileFormatError(str(error)) from None
    with path.open("rb") as file:
        start = file.read(128)
    if not start:
        raise FileFormatError(f"{path} is empty")
    if start.startswith(cphd.START):
        return cphd.read_cphd(path)
    if matlab.is_matlab(start):
        variables = matlab.read_matlab(path)
        for fields, lines_of in (
            (PHASE_HISTORY, phase_history_lines),
            (FULL_MATRIX, full_matrix_lines),
        ):
            if found := matlab.groups(variables, *fields):
                return lines_of(path, matlab.only(path, found, *fields))
        raise FileFormatError(
            f"{path} must hold one structure with the fields {', '.join(PHASE_HISTORY)} or "
            f"{', '.join(FULL_MATRIX)}"
        )
    if h5py.is_hdf5(path):
        with hdf5.opened(path) as content:
            foreign = "format" not in content.attrs and is_airsas(content)
        return read_airsas(path) if foreign else hdf5.load(path)
    raise FileFormatError(
        f"{path} is not an HDF5 file, nor one of CPHD or of MATLAB's version 5 to 7"
    )


def save(path: str | os.PathLike, obj: Saved) -> None:
    """Write an object to an HDF5 file, or range lines to a CPHD file.

    An existing file is replaced in one step and keeps its mode. A symbolic link stays: the file it
    leads to is replaced.

    Parameters
    ----------
    path : path-like
        The file. Its name ends in .h5, .hdf5, .he5 or nothing for HDF5, and in .cphd for CPHD,
        which `write_cphd` describes. Its folder must exist.
    obj : Grid, RangeLines, Image or Echoes
        The object; `load` returns it from HDF5 bit for bit.

    Raises
    ------
    TypeError
        If `obj` is of another type.
    ValueError
        If the file's name has the suffix of another format, such as .tif, CPHD cannot represent the
        lines, or `path` is a device, a pipe or a socket.
    ImportError
        If a CPHD file is wanted and sarkit is not installed (extra `radar`).
    OSError
        If the folder does not exist or the file cannot be written, as on a full disk.

    Notes
    -----
    HDF5 files are assembled in memory first, since HDF5 does not recover from a full disk. This
    takes as much memory again as the object.
    """
    path = validate.path("path", path)
    if path.suffix.lower() in cphd_writing.SUFFIXES:
        validate.instance("obj", obj, RangeLines)
        assert isinstance(obj, RangeLines)  # for type checkers
        cphd_writing.write_cphd(path, obj)
    else:
        hdf5.save(path, obj)
