"""Scene files: sonar, track, targets, seabed, grid and processing from one TOML file.

docs/scene-files.md lists every key. A file is checked as a whole before anything is computed.
Every message names the file, the table and the key.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from clsas.core import reading, validate
from clsas.core.grid import Grid
from clsas.core.version import __version__
from clsas.files.mistakes import explain
from clsas.files.scene_tables import EXACT_KEYS, PLAN_KEYS, SceneTables
from clsas.simulation.scenes import Scene
from clsas.sonar.system import Sonar
from clsas.sonar.track import Track

_MOST_MISTAKES = 20  # listed in one message
_IMAGING = ("grid", "image", "mosaic", "process")  # tables without influence on range lines


@dataclass(frozen=True, eq=False)
class SceneFile:
    """Contents of a scene file. Tables that the file leaves out are None.

    Attributes
    ----------
    name : str
        Origin of the scene, for messages.
    sonar, track, grid
        From the tables of these names.
    targets : PointTargets, Seabed, or a tuple of both
        From the tables `targets` and `seabed`.
    simulate, compress, image : dict
        Keyword arguments for `clsas.simulate` and `clsas.compress`, and for `clsas.plan` (one of
        `PLAN_KEYS`) or `clsas.backproject` (some of `EXACT_KEYS`), either with a `beam`.
    mosaic : dict
        Paths that `clsas mosaic` reads (`lines`) and writes (`store`), and its `patches` and
        `memory_mib`.
    process : dict
        Paths that `clsas process` reads (`lines`) and writes (`output`), its `steps`, and keyword
        arguments of its steps: `calibrate`, `navigate` and `focus`.
    files : dict
        Paths of the files that the scene refers to, by key: "track.file", "grid.height_file",
        "mosaic.lines", "process.lines".
    """

    name: str
    sonar: Sonar | None = None
    track: Track | None = None
    targets: Scene | None = None
    grid: Grid | None = None
    simulate: dict[str, Any] = field(default_factory=dict)
    compress: dict[str, Any] = field(default_factory=dict)
    image: dict[str, Any] = field(default_factory=dict)
    mosaic: dict[str, Any] = field(default_factory=dict)
    process: dict[str, Any] = field(default_factory=dict)
    files: dict[str, Path] = field(default_factory=dict)

    @property
    def request(self) -> dict[str, Any]:
        """How `[image]` wants an image: one of `PLAN_KEYS`, some of `EXACT_KEYS`, or nothing."""
        planned = {key: value for key, value in self.image.items() if key in PLAN_KEYS}
        return planned or {key: value for key, value in self.image.items() if key in EXACT_KEYS}

    def need(self, *tables: str) -> tuple[Any, ...]:
        """Return the attributes of these names; raises ValueError if one is missing."""
        for table in tables:
            if getattr(self, table) is None:
                missing = "[[targets]] or [seabed]" if table == "targets" else f"[{table}]"
                raise ValueError(f"{self.name}: missing table {missing}")
        return tuple(getattr(self, table) for table in tables)


def read_scene(path: str | os.PathLike) -> SceneFile:
    """Read a scene file.

    Parameters
    ----------
    path : path-like
        The TOML file. Relative paths in it begin at its folder.

    Raises
    ------
    ValueError
        If the file is not TOML; if a key is unknown or missing, has the wrong type or is outside
        its limits; or if a file that it refers to cannot be read. The message has one line for
        each of the first 20 mistakes, with the key's path, its value and what is allowed.
    OSError
        If the file cannot be read.
    """
    path = Path(path)
    return parse_scene(reading.read_bytes(path), name=str(path), folder=path.parent)


def parse_scene(text: bytes, *, name: str, folder: Path) -> SceneFile:
    """Return the scene that a TOML text describes; see `read_scene`."""
    try:
        tables = reading.parse_toml(text)
    except ValueError as error:  # TOML's and UTF-8's
        kind = "an HDF5 file, not a scene" if text.startswith(b"\x89HDF") else f"not TOML: {error}"
        raise ValueError(f"{name}: is {kind}") from None
    try:
        return SceneFile(name=name, **SceneTables.model_validate(tables).build(folder))
    except ValidationError as error:
        mistakes = explain(error, tables, SceneTables)
        lines = [f"{name}: {line}" for line in mistakes[:_MOST_MISTAKES]]
        if len(mistakes) > _MOST_MISTAKES:
            lines.append(f"{name}: and {len(mistakes) - _MOST_MISTAKES} more mistakes")
        raise ValueError("\n  ".join(lines)) from None
    except RecursionError:
        raise ValueError(f"{name}: nested too deep") from None
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: {error}") from None


def simulation_digest(text: bytes, folder: Path) -> str:
    """Return a digest of everything that a scene's range lines depend on, with clsas's version."""
    tables = reading.parse_toml(text)
    used = {name: table for name, table in tables.items() if name not in _IMAGING}
    digest = hashlib.sha256(json.dumps([__version__, used], sort_keys=True, default=str).encode())
    if isinstance(file := tables.get("track", {}).get("file"), str):
        digest.update(reading.read_bytes(folder / file))
    return digest.hexdigest()[:12]


def built_in_scene(name: str) -> bytes:
    """Return the text of a scene file that comes with clsas, such as "thesis_wide_beam"."""
    folder = files("clsas") / "scenes"
    names = sorted(Path(item.name).stem for item in folder.iterdir())
    return (folder / f"{validate.one_of('name', name, names)}.toml").read_bytes()
