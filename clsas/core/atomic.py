"""Files and folders that appear whole or not at all, even if the process is killed or power fails.

A file is written under a temporary name, `.clsas-*.part`, in the folder where it will lie. Its
writer holds a lock on it, so a temporary file without a lock is a leftover of a killed process; the
next writer in that folder removes it. Contents reach the disk before the name does.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_PATTERN = ".clsas-*.part"


@contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """Give an empty temporary file to write; rename it to `path` on success, else remove it.

    Raises
    ------
    OSError
        If the folder of `path` does not exist or cannot be written, if `path` is a folder, or on a
        full disk. It names `path`, not the temporary file.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: there is no folder {path.parent}")
    if path.is_dir():
        raise IsADirectoryError(f"cannot write {path}: it is a folder")
    with _temporary(path, _make_file) as (temporary, descriptor):
        yield temporary
        os.fsync(descriptor)
        os.replace(temporary, path)
        sync_folder(path.parent)


@contextmanager
def creating(path: Path) -> Iterator[Path]:
    """Give an empty temporary folder to fill; rename it to `path` on success, else remove it.

    If another process has made a folder with contents at `path` by then, that one stays.

    Raises
    ------
    OSError
        If the parent of `path` does not exist or cannot be written, or `path` is a file.
    """
    with _temporary(path, Path.mkdir) as (temporary, _):
        yield temporary
        try:
            os.rename(temporary, path)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
        sync_folder(path.parent)


def make_folders(path: Path) -> None:
    """Make a folder and its parents where they are missing, and wait until the disk has them."""
    missing = [each for each in (path, *path.parents) if not each.exists()]
    path.mkdir(parents=True, exist_ok=True)
    for each in missing:
        sync_folder(each.parent)


def sync_folder(path: Path) -> None:
    """Wait until the names in a folder are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Some network file systems do not sync folders; they have no other way to offer.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(descriptor)


@contextmanager
def _temporary(path: Path, make: Callable[[Path], object]) -> Iterator[tuple[Path, int]]:
    """Give a locked temporary beside `path` and its descriptor; remove it if it is left."""
    temporary = None
    try:
        _remove_leftovers(path.parent)
        temporary, descriptor = _claim(path.parent, make)
        try:
            yield temporary, descriptor
        finally:  # also on Ctrl-C
            _remove(temporary)
            os.close(descriptor)
    except OSError as error:
        # A full disk names no file, and the temporary name means nothing to a user.
        named = error.filename
        ours = named is None or (isinstance(named, str | Path) and Path(named).match(_PATTERN))
        if error.errno is not None and ours:
            raise type(error)(error.errno, error.strerror, str(path)) from error
        raise


def _claim(folder: Path, make: Callable[[Path], object]) -> tuple[Path, int]:
    while True:
        path = folder / _PATTERN.replace("*", uuid.uuid4().hex)
        make(path)
        with suppress(FileNotFoundError):
            descriptor = _open(path)
            with suppress(OSError):  # not every file system has locks; leftovers then stay
                fcntl.flock(descriptor, fcntl.LOCK_EX)
            # Another process may have taken it for a leftover before it was locked.
            if path.exists():
                return path, descriptor
            os.close(descriptor)


def _remove_leftovers(folder: Path) -> None:
    for path in folder.glob(_PATTERN):
        with suppress(OSError):  # another user's, or gone meanwhile
            descriptor = _open(path)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises if in use
                _remove(path)
            finally:
                os.close(descriptor)


def _make_file(path: Path) -> None:
    path.touch(exist_ok=False)


def _open(path: Path) -> int:
    # NFS locks only what is open for writing; a folder cannot be.
    access = os.O_RDONLY if path.is_dir() else os.O_RDWR
    return os.open(path, access | os.O_NOFOLLOW | os.O_NONBLOCK)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
