"""The recording that a processing begins with."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
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
    _read: Callable[[], RangeLines | Echoes]
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
            return cls({"file": None, "digest": digest}, digest, lambda: lines, options)
        path = scene.process.get("lines") if given is None else validate.path("lines", given)
        if path is None:
            raise ValueError(
                f"{scene.name}: missing key 'lines' in [process], the recording to process"
            )
        if given is None and not path.exists():
            raise ValueError(f"{scene.name}: [process] lines must be a file, there is no {path}")
        digest = file_digest(path)
        of_both = step_digest("recording", options, digest)
        return cls({"file": str(path), "digest": digest}, of_both, partial(_any, path), options)

    @cached_property
    def lines(self) -> RangeLines:
        """The lines; those of echoes are compressed."""
        read = self._read()
        return compress(read, **self._compression) if isinstance(read, Echoes) else read


def _any(path: Path) -> RangeLines | Echoes:
    found = load(path)
    if not isinstance(found, (RangeLines, Echoes)):
        raise ValueError(f"{path} must hold RangeLines or Echoes, got {type(found).__name__}")
    return found


def loaded(path: Path) -> RangeLines:
    """Return the range lines in a file; raises ValueError if it holds anything else."""
    lines = _any(path)
    validate.instance(str(path), lines, RangeLines)
    assert isinstance(lines, RangeLines)  # for type checkers
    return lines
