"""Recording that a processing begins with."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

from clsas.engine.data import validate
from clsas.engine.data.digests import digest
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.engine.signal.compression import compress
from clsas.engine.signal.echoes import Echoes
from clsas.files.formats import load
from clsas.files.scene_files import SceneFile
from clsas.processing.record import file_digest, step_digest


@dataclass(frozen=True, eq=False)
class Recording:
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
    _path: Path | None
    _given: RangeLines | None
    _compression: dict[str, Any]

    @classmethod
    def of(
        cls, scene: SceneFile, given: RangeLines | Echoes | str | os.PathLike | None
    ) -> Recording:
        """Return the given recording, or that of the scene."""
        options = scene.compress
        if isinstance(given, Echoes):
            given = compress(given, **options)
        if isinstance(given, RangeLines):
            found = digest(given)
            return cls({"file": None, "digest": found}, found, None, given, options)
        path = scene.process.get("lines") if given is None else validate.path("lines", given)
        where = f"{scene.name}: [process]"
        if path is None:
            raise ArgumentError("lines", "be given", hint="the path of the recording", where=where)
        if given is None and not path.exists():
            hint = f"{path} does not exist"
            raise ArgumentError("lines", "be a file", hint=hint, where=where)
        found = file_digest(path)
        of_both = step_digest("recording", options, found)
        return cls({"file": str(path), "digest": found}, of_both, path, None, options)

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields to pickle, without lines that were read: they are read again."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

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
        if self._path is None:
            assert self._given is not None
            return self._given
        found: RangeLines | Echoes = loaded(
            self._path, self.described["digest"], RangeLines, Echoes
        )
        return compress(found, **self._compression) if isinstance(found, Echoes) else found


def loaded(path: Path, expected: str, *kinds: type) -> Any:
    """Return the object in a file after checking the digest of the file.

    Raises
    ------
    ValueError
        If the file contains an object of another type than `kinds`, or has another digest than
        `expected`.
    """
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
