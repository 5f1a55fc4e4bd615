"""The recording that a processing begins with."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

from clsas.core import validate
from clsas.core.lines import RangeLines
from clsas.files.formats import load
from clsas.files.scene_files import SceneFile
from clsas.processing.record import contents_digest, file_digest, step_digest
from clsas.signal.compression import compress
from clsas.signal.echoes import Echoes


@dataclass(frozen=True, eq=False)
class Recording:
    """The lines to begin with, read when they are needed.

    Attributes
    ----------
    described : dict
        What the record says of them.
    digest : str
        Of their contents, and how echoes are compressed.
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
        """Return the recording given, or that of the scene."""
        options = scene.compress
        if isinstance(given, Echoes):
            given = compress(given, **options)
        if isinstance(given, RangeLines):
            lines, digest = given, contents_digest(given)
            return cls({"file": None, "digest": digest}, digest, None, lines, options)
        path = scene.process.get("lines") if given is None else validate.path("lines", given)
        if path is None:
            raise ValueError(
                f"{scene.name}: missing key 'lines' in [process], the recording to process"
            )
        if given is None and not path.exists():
            raise ValueError(f"{scene.name}: [process] lines must be a file, there is no {path}")
        digest = file_digest(path)
        of_both = step_digest("recording", options, digest)
        return cls({"file": str(path), "digest": digest}, of_both, path, None, options)

    def __getstate__(self) -> dict[str, Any]:
        """Pickle without lines that were read: they are read again from their file."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def read(self) -> RangeLines:
        """Return the lines; those of echoes are compressed.

        Raises
        ------
        ValueError
            If the file holds anything else, or changed since its digest was taken.
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


def loaded(path: Path, digest: str, *kinds: type) -> Any:
    """Return the object in a file whose contents have a digest.

    Raises
    ------
    ValueError
        If the file holds an object of another type than `kinds`, or other contents.
    """
    found = load(path)
    if not isinstance(found, kinds):
        wanted = " or ".join(kind.__name__ for kind in kinds)
        raise ValueError(f"{path} must hold {wanted}, got {type(found).__name__}")
    # After reading, so that nothing can take its place in between.
    if file_digest(path) != digest:
        raise ValueError(f"{path} changed since its digest was recorded: process it again")
    return found
