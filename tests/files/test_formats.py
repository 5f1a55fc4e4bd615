"""Files of all kinds, which are recognised by their contents."""

import os
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

import clsas
from clsas.cli.lines import convert
from clsas.files.formats import FORMATS, load, save
from clsas.files.hdf5 import FileFormatError

LINES = clsas.RangeLines(np.ones((2, 3), complex), 1.0, 0.1, [0, 0, 0], [0, 0, 0], 1e5, 1500.0)


def test_the_name_of_a_file_does_not_matter(tmp_path):
    save(tmp_path / "lines.h5", LINES)
    (tmp_path / "lines.h5").rename(tmp_path / "lines.cphd")
    np.testing.assert_array_equal(load(tmp_path / "lines.cphd").samples, LINES.samples)


@pytest.mark.parametrize("format_", FORMATS, ids=lambda each: each.name)
def test_every_format_is_listed_where_users_look(format_):
    help_text = convert.help
    for text in (help_text, load.__doc__, Path("docs/how-to/recordings.md").read_text()):
        for word in (format_.name.split()[0], *(format_.suffixes[:1] if text is help_text else ())):
            assert word in text


def write_bytes(content):
    return lambda path: path.write_bytes(content)


def write_hdf5(*names):
    def write(path):
        with h5py.File(path, "w") as file:
            for name in names:
                file[name] = 1.0

    return write


UNKNOWN = {
    "empty": (write_bytes(b""), "is empty"),
    "text": (write_bytes(b"hello\n" * 100), "is of none of the formats that clsas reads"),
    "noise": (
        write_bytes(np.random.default_rng(0).bytes(4096)),
        "is of none of the formats that clsas reads",
    ),
    "foreign HDF5": (write_hdf5("a/b"), "is an HDF5 file, but was not written by clsas"),
    "MATLAB without a recording": (
        lambda path: savemat(path.open("wb"), {"a": 1}),
        "must contain one structure with the fields fp, freq, x, y, z, r0 or time_data",
    ),
    "a start of MATLAB's": (write_bytes(b"MATLAB 5.0"), "is of none of the formats"),
    "a header of MATLAB's": (
        write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM"),
        "must contain one structure",
    ),
    "a pipe": (os.mkfifo, "must be an ordinary file, got a pipe"),
    "a device": (lambda path: path.symlink_to("/dev/zero"), "an ordinary file, got a device"),
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_unknown_files_are_refused_by_name(name, tmp_path):
    write, said = UNKNOWN[name]
    path = tmp_path / "some.file"
    write(path)
    with pytest.raises(FileFormatError, match=rf"some\.file {said}|some\.file .*{said}"):
        load(path)


def test_files_that_are_not_there_and_folders_are_errors_of_the_system(tmp_path):
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "nowhere.cphd")
    with pytest.raises(IsADirectoryError):
        load(tmp_path)
    with pytest.raises(TypeError, match="path must be a path"):
        load(3)


def test_files_are_saved_by_their_suffix(tmp_path):
    with pytest.raises(ValueError, match=r"path must end in \.h5"):
        save(tmp_path / "lines.mat", LINES)
