"""Reading of users' files, with checks of their type, size and nesting."""

from __future__ import annotations

import json
import os
import stat
import tomllib
from pathlib import Path
from typing import Any

from clsas.engine.data import validate

# Most memory that parsing a byte takes, which tests/engine/data/test_reading.py measures. The worst
# cases are empty lists in JSON, nested tables in TOML, one long heading over columns, and short
# rows.
JSON_BYTES = 32
TOML_BYTES = 500
COLUMNS_BYTES = 40
ROWS_BYTES = 100
_NOT_ORDINARY = {
    stat.S_ISFIFO: "a pipe",
    stat.S_ISSOCK: "a socket",
    stat.S_ISCHR: "a device",
    stat.S_ISBLK: "a device",
}


def check_ordinary(path: str | os.PathLike) -> None:
    """Raise ValueError if a path is a pipe, socket or device, from which reading may never end.

    Raises OSError if the path does not exist.
    """
    mode = os.stat(path).st_mode
    for is_kind, kind in _NOT_ORDINARY.items():
        if is_kind(mode):
            raise ValueError(f"{os.fspath(path)} must be an ordinary file, got {kind}")


def read_bytes(path: str | os.PathLike, parsed_bytes: int = JSON_BYTES) -> bytes:
    """Return the contents of an ordinary file that is to be parsed.

    `parsed_bytes` is the memory that parsing may take per byte of the file.

    Raises
    ------
    ValueError
        If the file is not an ordinary file, or is too large to be parsed in the memory left.
    OSError
        If the file cannot be read.
    """
    path = Path(path)
    check_ordinary(path)
    validate.memory(str(path), parsed_bytes * path.stat().st_size)
    return path.read_bytes()


def read_text(path: str | os.PathLike, parsed_bytes: int) -> str:
    """Return the text of an ordinary file in UTF-8, with or without a byte-order mark.

    Raises ValueError if it is not UTF-8, and as `read_bytes` does.
    """
    try:
        return read_bytes(path, parsed_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{os.fspath(path)} must be text in UTF-8, got the byte "
            f"{error.object[error.start]:#04x} at position {error.start}"
        ) from None


def parse_toml(text: bytes) -> dict[str, Any]:
    """Return the tables of a TOML text; raises ValueError if it is invalid or too deeply nested."""
    try:
        return tomllib.loads(text.decode())
    except RecursionError:
        raise ValueError("nested too deep") from None


def parse_json(text: str | bytes) -> Any:
    """Return the value of a JSON text; raises ValueError if it is invalid or too deeply nested."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("nested too deep") from None
