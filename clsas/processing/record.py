"""Record of a processing: inputs, versions and numbers of every step, as JSON beside the image.

The record also identifies the files in the folder that clsas wrote and may replace.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from clsas.engine.data import reading, reprs, validate
from clsas.engine.data.atomic import replacing
from clsas.engine.data.digests import DIGEST, digest, is_intact, with_digest
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.version import __version__
from clsas.files.json_types import json_able
from clsas.files.scene_files import SceneFile
from clsas.files.scene_tables import CORRECTIONS

NAME = "process.json"
_FORMAT, _VERSION = "clsas processing", 3
_MARK = f'"format": "{_FORMAT}"'.encode()
"""Text by which a damaged record can still be told from a file of another program."""

_BLOCK = 1 << 22  # bytes that are read at once: a plain choice


@dataclass(frozen=True)
class StepRecord:
    """Record of a step: its inputs, results and files.

    Attributes
    ----------
    name : str
        The step: "inspect", "calibrate", "navigate", "focus", "pair_errors", "image", "heights" or
        "mosaic".
    inputs : str
        Digest of the inputs, the options and the version of clsas.
    lines : str
        Digest of the lines that the step began with: that of the recording, or of the last step
        before it that corrected the lines.
    corrections : tuple of str
        Steps that had corrected these lines.
    options : dict
        Options of the step, as JSON types.
    numbers : dict
        Numbers that the step found, as JSON types.
    files : dict
        Digest of every file that the step wrote, by name.
    warnings : tuple of str
        Warnings of the step.
    seconds : float
        Time that the step took.
    device : str
        Device that the step used.
    """

    name: str
    inputs: str
    lines: str = ""
    corrections: tuple[str, ...] = ()
    options: dict[str, Any] = field(default_factory=dict)
    numbers: dict[str, Any] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    seconds: float = 0.0
    device: str = ""

    def __repr__(self) -> str:
        """Return the name, the number of files and the time of the step."""
        return reprs.summary(
            self, self.name, f"{len(self.files)} files", reprs.quantity(self.seconds, "s")
        )

    @property
    def result_file(self) -> str:
        """Name of the file for the lines, the image or the heights of the step, if it saves any."""
        return f"{self.name}.h5"

    def is_intact(self, folder: Path) -> bool:
        """Return whether all files of the step exist as they were written."""
        if self.name in (*CORRECTIONS, "image", "heights") and self.result_file not in self.files:
            return False
        try:
            return all(file_digest(folder / name) == each for name, each in self.files.items())
        except (OSError, ValueError):
            return False


def read_records(folder: Path, scene: SceneFile) -> tuple[dict[str, StepRecord], bool]:
    """Return the intact records in a scene's folder by step, and whether others are damaged.

    There are none without `process.json`, nor if its entries before the steps are damaged.

    Raises
    ------
    ValueError
        If `process.json` is not a record of clsas, or is of another version or scene.
    OSError
        If the file cannot be read.
    """
    text, document = b"", None
    try:
        text = reading.read_bytes(folder / NAME)
        document = reading.parse_json(text)
    except FileNotFoundError:
        return {}, False
    except (IsADirectoryError, ValueError):
        pass
    own, choose = repr(str(folder)), "choose another folder, or remove"
    if not isinstance(document, dict) or document.get("format") != _FORMAT:
        if _MARK in text:
            return {}, True
        allowed = f"not contain a {NAME} that clsas did not write, or whose beginning is damaged"
        raise ArgumentError("output", allowed, own, f"{choose} the file")
    if document.get("version") != _VERSION:
        allowed = f"not contain a {NAME} of another version of clsas"
        raise ArgumentError("output", allowed, own, f"{choose} this one")
    steps = document.pop("steps", None)
    if not is_intact(document) or not isinstance(steps, list):
        return {}, True
    if (other := document.get("scene")) != (this := _of_folder(scene, folder)):
        got = f"{own} with those of {validate.shown(other)} relative to the folder, not {this!r}"
        raise ArgumentError("output", "not contain results of another scene", got, f"{choose} it")
    found = {}
    for step in filter(is_intact, steps):
        values = {name: value for name, value in step.items() if name != DIGEST}
        with suppress(TypeError, LookupError):
            tuples = {name: tuple(step[name]) for name in ("corrections", "warnings")}
            record = StepRecord(**{**values, **tuples})
            if isinstance(record.files, dict) and all(_is_plain(name) for name in record.files):
                found[str(record.name)] = record
    return found, len(found) < len(steps)


def write_records(
    folder: Path, scene: SceneFile, given: dict[str, Any], records: Iterable[StepRecord]
) -> None:
    """Write the record of a folder in one step."""
    document: dict[str, Any] = {
        "format": _FORMAT,
        "version": _VERSION,
        "clsas": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "machine": platform.platform(),
        "scene": _of_folder(scene, folder),
        "recording": given,
    }
    steps = [with_digest(json_able(asdict(record))) for record in records]
    text = json.dumps(with_digest(document) | {"steps": steps}, indent=1, allow_nan=False)
    with replacing(folder / NAME) as temporary:
        temporary.write_text(text)


def step_digest(name: str, options: dict[str, Any], *inputs: str) -> str:
    """Return the digest of a step, from its options and the digests of its inputs."""
    return digest([__version__, name, options, *inputs])


def file_digest(path: Path) -> str:
    """Return a digest of a file's contents.

    Raises
    ------
    OSError, ValueError
        If the file cannot be read, or is not an ordinary file.
    """
    reading.check_ordinary(path)
    sha = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            sha.update(block)
    return sha.hexdigest()[:16]


def _of_folder(scene: SceneFile, folder: Path) -> str:
    """Return the path of a scene's file relative to the folder, so that both can move together."""
    if not Path(scene.name).is_file():
        return scene.name
    return os.path.relpath(os.path.realpath(scene.name), os.path.realpath(folder))


def _is_plain(name: object) -> bool:
    """Return whether a name is that of a file in the folder, not a path that leads elsewhere."""
    return isinstance(name, str) and name not in ("", ".", "..") and Path(name).name == name
