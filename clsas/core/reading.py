"""Reading files that users hand over: their kind, size and nesting are checked first."""

from __future__ import annotations

import json
import os
import stat
import tomllib
from pathlib import Path
from typing import Any

from clsas.core import validate

# Memory that parsing takes per byte of TOML or JSON: an empty list, "[],", is 64 bytes of Python.
_PARSED_BYTES = 32
_NO_FILE = {
    stat.S_ISFIFO: "a pipe",
    stat.S_ISSOCK: "a socket",
    stat.S_ISCHR: "a device",
    stat.S_ISBLK: "a device",
}


def check_ordinary(path: str | os.PathLike) -> None:
    """Raise ValueError if a path is a pipe, a socket or a device: reading those may never end.

    Raises OSError if there is nothing at the path.
    """
    mode = os.stat(path).st_mode
    for is_kind, kind in _NO_FILE.items():
        if is_kind(mode):
            raise ValueError(f"{os.fspath(path)} must be an ordinary file, got {kind}")


def read_bytes(path: str | os.PathLike) -> bytes:
    """Return what an ordinary file holds, to be parsed.

    Raises
    ------
    ValueError
        If it is not an ordinary file, or too large to be parsed in this machine's memory.
    OSError
        If it cannot be read.
    """
    path = Path(path)
    check_ordinary(path)
    validate.memory(str(path), _PARSED_BYTES * path.stat().st_size)
    return path.read_bytes()


def parse_toml(text: bytes) -> dict[str, Any]:
    """Return the tables of a TOML text; raises ValueError if it is none, or nested too deep."""
    try:
        return tomllib.loads(text.decode())
    except RecursionError:
        raise ValueError("nested too deep") from None


def parse_json(text: str | bytes) -> Any:
    """Return what a JSON text holds; raises ValueError if it is none, or nested too deep."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("nested too deep") from None
