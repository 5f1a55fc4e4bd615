"""Files and folders that appear complete or not at all, even after a crash or power failure.

A file is written under a temporary name, `.clsas-*.part`, in its destination folder, and its writer
keeps it locked. A temporary file that is not locked was left behind by a killed process, and the
next writer in the folder removes it. The contents reach the disk before the file gets its name.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import shutil
import stat
import tempfile
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from clsas.engine.data.reading import check_ordinary

_PATTERN = ".clsas-*.part"
_LOCK = ".clsas.lock"
_HERE, _EXCHANGE = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux


def check_writable(folder: Path, path: Path) -> None:
    """Raise OSError, which names `path`, if no file can be written into a folder."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:  # it names the temporary file
        raise type(error)(error.errno, error.strerror, str(path)) from error


@contextmanager
def replacing(path: str | os.PathLike) -> Iterator[Path]:
    """Yield an empty temporary file to write; rename it to `path` on success, else remove it.

    If `path` is a symbolic link, the link stays and the file it points to is replaced. The new file
    keeps the mode of the old one and, where that is permitted, its owner and group.

    Raises
    ------
    ValueError
        If `path` is a device, a pipe or a socket.
    OSError
        If the folder of `path` does not exist or cannot be written, if `path` is a folder, or on a
        full disk. The error names `path`, not the temporary file.
    """
    path, before = _target(Path(path))
    with _temporary(path, lambda new: new.touch(exist_ok=False)) as (temporary, descriptor):
        if before is not None:
            # Done while the file is still empty, so that no other user can read its contents in the
            # meantime. The writer must be able to open it.
            _own_as(descriptor, before)
            os.fchmod(descriptor, stat.S_IMODE(before.st_mode) | stat.S_IWUSR)
        yield temporary
        if before is not None:
            os.fchmod(descriptor, stat.S_IMODE(before.st_mode))
        os.fsync(descriptor)
        os.replace(temporary, path)
        sync_folder(path.parent)


@contextmanager
def assembling(path: str | os.PathLike) -> Iterator[Path]:
    """Yield the path of a file to write in a temporary folder; rename it to `path` on success.

    Programs may replace the file and keep files of their own in that folder. Everything else is as
    for `replacing`.

    Raises
    ------
    ValueError, OSError
        As for `replacing`.
    """
    path, before = _target(Path(path))
    with _temporary(path, Path.mkdir, path.parent) as (folder, _):
        folder.chmod(stat.S_IRWXU)  # nobody else can read the file before it has its mode
        made = folder / path.name
        yield made
        descriptor = _open(made)
        try:
            if before is not None:
                _own_as(descriptor, before)
                os.fchmod(descriptor, stat.S_IMODE(before.st_mode))
            os.fsync(descriptor)
            os.replace(made, path)
        finally:
            os.close(descriptor)
        sync_folder(path.parent)


def _target(given: Path) -> tuple[Path, os.stat_result | None]:
    """Return the file to replace, behind links, and its status if it exists."""
    path = Path(os.path.realpath(given)) if given.is_symlink() else given
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {given}: there is no folder {path.parent}")
    if path.is_dir():
        raise IsADirectoryError(f"cannot write {given}: it is a folder")
    with suppress(FileNotFoundError):
        check_ordinary(given)
        return path, path.stat()
    return path, None


def _own_as(descriptor: int, before: os.stat_result) -> None:
    """Give a file the owner and the group of another one, each where that is permitted."""
    for owner, group in ((before.st_uid, -1), (-1, before.st_gid)):
        with suppress(PermissionError):
            os.fchown(descriptor, owner, group)


@contextmanager
def creating(path: Path) -> Iterator[Path]:
    """Yield an empty temporary folder to fill; rename it to `path` on success, else remove it.

    If another process has meanwhile created a folder with contents at `path`, that folder stays.

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


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Yield an empty temporary folder to fill; on success it replaces the folder `path`, if any.

    The old folder stays in place until the new one is complete and on the disk. Then both are
    exchanged in one step, if system and file system can do so. Otherwise the old folder is at
    `.clsas-NAME.old` for a moment; if the process is killed then, the next call for `path` restores
    it.

    Raises
    ------
    OSError
        If the parent of `path` does not exist or cannot be written, `path` is a file, or the disk
        is full.
    """
    old = path.with_name(f".clsas-{path.name}.old")
    if old.is_dir() and not path.exists():
        os.rename(old, path)
    with _temporary(path, Path.mkdir) as (new, _):
        yield new
        os.sync()  # one call for thousands of files
        if not path.is_dir():
            os.rename(new, path)
        elif not _exchanged(new, path):
            _remove(old)
            os.rename(path, old)
            try:
                os.rename(new, path)
            except OSError:
                os.rename(old, path)
                raise
        sync_folder(path.parent)
        _remove(old)


def _exchanged(first: Path, second: Path) -> bool:
    """Exchange two folders in one step; return False where this is not possible."""
    try:
        exchange = ctypes.CDLL(None, use_errno=True).renameat2
    except AttributeError:  # of Linux alone
        return False
    if exchange(_HERE, os.fsencode(first), _HERE, os.fsencode(second), _EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP):
        return False
    raise OSError(number, os.strerror(number), str(second))


@contextmanager
def staging(folder: Path) -> Iterator[Path]:
    """Yield an empty temporary folder within a folder, for files to move from; then remove it."""
    with _temporary(folder, Path.mkdir, folder) as (temporary, _):
        yield temporary


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep a folder locked, which only one process can do at a time.

    The lock is on a file in the folder that is removed at the end. A killed process leaves the file
    behind, but not the lock. Where the file cannot be created, or the file system has no locks,
    nothing is locked.

    Raises
    ------
    BlockingIOError
        If the folder is locked already.
    """
    descriptor = _lock(folder)
    try:
        yield
    finally:
        if descriptor is not None:
            (folder / _LOCK).unlink(missing_ok=True)
            os.close(descriptor)


def _lock(folder: Path) -> int | None:
    """Return the descriptor of a folder's locked file, or None if it cannot be created."""
    path = folder / _LOCK
    while True:
        try:
            descriptor = os.open(
                path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666
            )
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
                return None
            raise
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            raise BlockingIOError(
                errno.EAGAIN, "another process of clsas is at work in this folder", str(folder)
            ) from None
        except OSError:  # some file systems have no locks
            return descriptor
        # The previous owner of the lock may have removed the file in the meantime.
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), os.stat(path)):
                return descriptor
        os.close(descriptor)


def make_folders(path: Path) -> None:
    """Create a folder and missing parents, and wait until they are on the disk."""
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
        # Some network file systems cannot sync folders, and there is no alternative.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(descriptor)


@contextmanager
def _temporary(
    path: Path, make: Callable[[Path], object], folder: Path | None = None
) -> Iterator[tuple[Path, int]]:
    """Yield a locked temporary beside `path` and its descriptor; remove it if it still exists.

    If `folder` is given, the temporary is a folder in it, and its files will move there.
    """
    temporary = (folder or path.parent) / _PATTERN.replace("*", uuid.uuid4().hex)
    try:
        _remove_leftovers(temporary.parent)
        descriptor = _claim(temporary, make)
        try:
            yield temporary, descriptor
        finally:  # also on Ctrl-C
            _remove(temporary)
            os.close(descriptor)
    except OSError as error:
        # The error of a full disk names no file, and a temporary name would not help the user.
        named = temporary if error.filename is None else error.filename
        _, ours, within = str(named).partition(temporary.name)
        if error.errno is None or not ours:
            raise
        meant = folder if within and folder else path
        raise type(error)(error.errno, error.strerror, f"{meant}{within}") from error


def _claim(path: Path, make: Callable[[Path], object]) -> int:
    """Make a temporary, and return its locked descriptor."""
    while True:
        make(path)
        with suppress(FileNotFoundError):
            descriptor = _open(path)
            # A shared lock keeps others from removing it, and lets HDF5, which takes one too, read
            # it once it has its name. To change an exclusive lock would free it for a moment.
            with suppress(OSError):  # some file systems have no locks, so leftovers stay
                fcntl.flock(descriptor, fcntl.LOCK_SH)
            # Another process may have removed it as a leftover before it was locked.
            if path.exists():
                return descriptor
            os.close(descriptor)


def _remove_leftovers(folder: Path) -> None:
    for path in folder.glob(_PATTERN):
        with suppress(OSError):  # it belongs to another user, or was removed in the meantime
            descriptor = _open(path)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises if in use
                # Another process may have removed it, and its maker have taken the name again.
                if os.path.samestat(os.fstat(descriptor), os.stat(path)):
                    _remove(path)
            finally:
                os.close(descriptor)


def _open(path: Path) -> int:
    # NFS locks only files that are open for writing. Folders cannot be opened that way.
    access = os.O_RDONLY if path.is_dir() else os.O_RDWR
    return os.open(path, access | os.O_NOFOLLOW | os.O_NONBLOCK)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
