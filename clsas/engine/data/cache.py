"""The cache folder: compiled kernels, measured costs, simulated lines, folders of worker processes.

Drivers load compiled kernels into the process, worker processes import modules from their folder,
and plans depend on stored costs. Anybody who can write to the cache folder can therefore act as its
user. It is used only if nobody else can write to it.
"""

from __future__ import annotations

import grp
import os
import pwd
import stat
import sys
from contextlib import suppress
from pathlib import Path

_MODE = 0o700  # of folders that are created here
_VARIABLE = "CLSAS_CACHE"


def cache_folder() -> Path:
    """Return the cache folder: the one in the variable CLSAS_CACHE, or the user's default.

    The folder is not checked and may not exist; see `trusted_cache` and `private_folder`.
    """
    return Path(os.environ.get(_VARIABLE) or user_caches() / "clsas")


def user_caches() -> Path:
    """Return the user's cache folder for all programs, by the XDG specification or as on macOS.

    It begins with "~" if the user has no home directory, and is then refused by `made_private`.
    """
    if os.path.isabs(given := os.environ.get("XDG_CACHE_HOME", "")):
        return Path(given)  # the specification tells programs to ignore relative paths
    home = Path(os.path.expanduser("~"))
    return home / ("Library/Caches" if sys.platform == "darwin" else ".cache")


def trusted_cache() -> Path:
    """Return the cache folder after checking that nobody else can write to it; it may not exist.

    Raises
    ------
    PermissionError
        If another user can change the contents of the folder, or this user cannot read it. The
        message names the folder and CLSAS_CACHE.
    """
    folder = cache_folder()
    _check(folder, _VARIABLE)
    _check_access(folder, _VARIABLE, os.R_OK | os.X_OK, "read")
    return folder


def private_folder(*names: str) -> Path:
    """Return the cache folder, or a folder in it, that only this user can write to.

    Folders that do not exist are created.

    Parameters
    ----------
    *names : str
        Path of the folder in the cache folder.

    Raises
    ------
    PermissionError
        As from `made_private`.
    """
    return made_private(trusted_cache().joinpath(*names), _VARIABLE)


def made_private(folder: Path, variable: str) -> Path:
    """Return a folder that only this user can write to, and create it if it does not exist.

    Parameters
    ----------
    folder : Path
    variable : str
        Environment variable that selects the folder, which the message of an error names.

    Raises
    ------
    PermissionError
        If another user can change the contents of the folder, or this user cannot create it or
        write to it.
    """
    _check(folder, variable)
    try:
        for each in reversed([folder, *folder.parents]):
            if not each.is_dir():
                with suppress(FileExistsError):  # another process created it; checked below
                    each.mkdir(_MODE)
    except OSError as error:
        raise _refusal(folder, variable, f"it cannot be created ({error.strerror})") from error
    _check(folder, variable)
    if not folder.is_dir():
        raise _refusal(folder, variable, "it is not a folder")
    _check_access(folder, variable, os.W_OK | os.X_OK, "write to")
    return folder


def _check(folder: Path, variable: str) -> None:
    """Raise PermissionError if another user can change the contents of a folder or replace it."""
    if folder.parts[:1] == ("~",):
        raise _refusal(folder, variable, "your home directory is not known")
    try:
        real = Path(os.path.realpath(folder))
        links = _links(Path(os.path.abspath(folder)), set())
        reasons = (_exposure(each.parent, each) for each in links)
        found = next(filter(None, reasons), None) or _exposure(real)
    except PermissionError as error:
        found = f"{error.filename} cannot be searched"
    if found:
        raise _refusal(folder, variable, found)


def _check_access(folder: Path, variable: str, access: int, verb: str) -> None:
    """Raise PermissionError if the folder exists and this user has no such access to it."""
    if folder.is_dir() and not os.access(folder, access, effective_ids=True):
        raise _refusal(folder, variable, f"you cannot {verb} it")


def _refusal(folder: Path, variable: str, reason: str) -> PermissionError:
    return PermissionError(
        f"the cache folder {folder} is not used because {reason}: set the environment variable "
        f"{variable} to a folder that belongs to you and that others cannot write to"
    )


def _links(path: Path, found: set[Path]) -> set[Path]:
    """Return the symbolic links along a path, each in its real folder."""
    for each in (*reversed(path.parents), path):
        if each.is_symlink():
            link = Path(os.path.realpath(each.parent), each.name)
            if link not in found:
                found.add(link)
                _links(link.parent / os.readlink(link), found)
    return found


def _exposure(folder: Path, link: Path | None = None) -> str | None:
    """Return how another user could change the entries of a folder, or None if nobody can.

    The owner of a folder, and others where its mode allows it, can rename its entries. All folders
    above it are therefore checked as well. In a sticky folder, such as /tmp, others can only add
    entries of their own. That is safe for the folders above, and for a folder that contains `link`,
    a symbolic link to the cache.
    """
    # The owner of the root folder can do everything. In a container that need not be user 0.
    trusted = {0, os.geteuid(), os.lstat("/").st_uid}
    is_closed = False  # whether others cannot reach deeper folders
    for each in (*reversed(folder.parents), folder, *([link] if link else ())):
        try:
            found = os.lstat(each)
        except (FileNotFoundError, NotADirectoryError):
            return None
        if found.st_uid not in trusted:
            return f"{each} belongs to {_user(found.st_uid)}"
        if each == link:
            continue
        is_closed = is_closed or not found.st_mode & (stat.S_IXGRP | stat.S_IXOTH)
        to_group = found.st_mode & stat.S_IWGRP and not _is_private(found.st_gid)
        is_open = (to_group or found.st_mode & stat.S_IWOTH) and not is_closed
        lets_only_add = found.st_mode & stat.S_ISVTX and (link is not None or each != folder)
        if is_open and not lets_only_add:
            return f"other users can write to {each}"
    return None


def _is_private(group: int) -> bool:
    """Return whether this user is the only member of a group, as many systems arrange it."""
    with suppress(KeyError):
        found, user = grp.getgrgid(group), pwd.getpwuid(os.geteuid())
        # The group's list leaves out the users whose primary group it is.
        members = {each.pw_uid for each in pwd.getpwall() if each.pw_gid == group}
        is_own = group == user.pw_gid and found.gr_name == user.pw_name and not found.gr_mem
        return is_own and members == {user.pw_uid}
    return False


def _user(number: int) -> str:
    try:
        return f"the user {pwd.getpwuid(number).pw_name}"
    except KeyError:
        return f"user {number}"
