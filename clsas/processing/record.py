"""Folder of a processing, with its record `process.json`, and the recording that it began with.

The record contains inputs, versions and numbers of every step. It also identifies the files in the
folder that clsas wrote and may replace.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from clsas.engine.data import reading, reprs, validate
from clsas.engine.data.atomic import locked, replacing
from clsas.engine.data.digests import DIGEST, digest, file_digest, is_intact, with_digest
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.version import __version__
from clsas.engine.signal.compression import compress
from clsas.engine.signal.echoes import Echoes
from clsas.files.formats import load
from clsas.files.json_types import json_able
from clsas.files.scene_files import SceneFile
from clsas.files.scene_tables import CORRECTIONS

NAME = "process.json"
_FORMAT, _VERSION = "clsas processing", 3
_MARK = f'"format": "{_FORMAT}"'.encode()
"""Text by which a damaged record can still be told from a file of another program."""


@dataclass(frozen=True, eq=False)
class RecordingFile:
    """Lines to begin with, which are read when they are needed.

    Attributes
    ----------
    described : dict
        Description of the lines for the record.
    digest : str
        Digest of the contents of the lines and, if they are echoes, of the options of compression.
    """

    described: dict[str, Any]
    digest: str
    _source: Path | RangeLines
    _compression: dict[str, Any]

    @classmethod
    def of(
        cls, scene: SceneFile, given: RangeLines | Echoes | str | os.PathLike | None
    ) -> RecordingFile:
        """Return the given recording, or that of the scene."""
        options = scene.compress
        if isinstance(given, Echoes):
            given = compress(given, **options)
        if isinstance(given, RangeLines):
            found = digest(given)
            return cls({"file": None, "digest": found}, found, given, options)
        path = scene.process.get("lines") if given is None else validate.path("lines", given)
        where = f"{scene.name}: [process]"
        if path is None:
            raise ArgumentError("lines", "be given", hint="the path of the recording", where=where)
        if given is None and not path.exists():
            hint = f"{path} does not exist"
            raise ArgumentError("lines", "be a file", hint=hint, where=where)
        found = file_digest(path)
        of_both = step_digest("recording", options, found)
        return cls({"file": str(path), "digest": found}, of_both, path, options)

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields to pickle, without lines that were read: they are read again."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    def read(self) -> RangeLines:
        """Return the lines; echoes are compressed.

        Raises
        ------
        ValueError
            If the file contains anything else, or has changed since its digest was computed.
        """
        return self._lines

    @cached_property
    def _lines(self) -> RangeLines:
        if isinstance(self._source, RangeLines):
            return self._source
        found = loaded(self._source, self.described["digest"], RangeLines, Echoes)
        return compress(found, **self._compression) if isinstance(found, Echoes) else found


def loaded(path: Path, expected: str, *kinds: type) -> Any:
    """Return the object in a file; raise ValueError if its type or digest is another one."""
    found = load(path)
    if not isinstance(found, kinds):
        names = " or ".join(f"`{kind.__name__}`" for kind in kinds)
        raise ValueError(f"{path} must contain {names}, got `{type(found).__name__}`")
    # Compute the digest after reading, so that a change in between is detected.
    if file_digest(path) != expected:
        raise ValueError(
            f"{path} has changed since its digest was recorded: run clsas process again"
        )
    return found


def checked_folder(
    scene: SceneFile, output: str | os.PathLike | None, recording: RecordingFile
) -> Path:
    """Return the given folder, or that of the scene; raise ValueError if it cannot be used."""
    if output is not None:
        folder = validate.path("output", output)
    elif "output" in scene.process:
        folder = scene.process["output"]
    elif Path(scene.name).suffix:
        folder = Path(scene.name).with_suffix("")
    else:
        allowed = "be given, since the scene has no file to name the folder after"
        raise ArgumentError("output", allowed)
    source = recording.described["file"]
    if source is not None and Path(source).parent.resolve() == folder.resolve():
        raise ArgumentError("output", "not be the folder of the recording", repr(str(folder)))
    if folder.exists() and not folder.is_dir():
        raise ArgumentError("output", "be a folder", f"the file {str(folder)!r}")
    if not folder.parent.is_dir():
        hint = f"there is no folder {str(folder.parent)!r}"
        raise ArgumentError("output", "lie in an existing folder", repr(str(folder)), hint)
    return folder


@contextmanager
def made(folder: Path) -> Iterator[None]:
    """Lock a folder, or raise BlockingIOError; a folder that is made is removed if still empty."""
    is_new = False
    try:
        with ExitStack() as held:
            while True:
                is_new = is_new or not folder.is_dir()
                folder.mkdir(exist_ok=True)
                # Another process may remove the folder, which it created, before this one locks it.
                with suppress(FileNotFoundError):
                    held.enter_context(locked(folder))
                    break
            yield
    finally:
        if is_new:
            with suppress(OSError):  # the folder is not empty
                folder.rmdir()


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
        State of the lines that the step began with: the digest of the recording, or the `inputs` of
        the last step before it that corrected the lines.
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
            # A name leads to a file in the folder, and not to one elsewhere.
            if isinstance(record.files, dict) and all(
                name not in ("", ".", "..") and Path(name).name == name for name in record.files
            ):
                found[str(record.name)] = record
    return found, len(found) < len(steps)


def _of_folder(scene: SceneFile, folder: Path) -> str:
    """Return the path of a scene's file relative to the folder, so that both can move together."""
    if not Path(scene.name).is_file():
        return scene.name
    return os.path.relpath(os.path.realpath(scene.name), os.path.realpath(folder))


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
