"""Scene files: sonar, track, targets, seabed, grid and processing, described in one TOML file.

docs/scene-files.md lists all keys. The whole file is checked before anything is computed. Every
message names the file, the table and the key.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from clsas.engine.data import reading, validate
from clsas.engine.data.digests import digest
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.engine.data.sound_speed import SoundSpeed
from clsas.engine.data.system import Sonar
from clsas.engine.data.track import Track
from clsas.engine.data.version import __version__
from clsas.files.scene_tables import EXACT_KEYS, PLAN_KEYS, PROMISE_KEYS, SceneTables
from clsas.files.tables import closest, located, models_in, suggestion
from clsas.simulation.scenes import Scene

_MOST_MISTAKES = 20  # listed in one message: a plain choice, which fits on a screen
_BARE_KEY = re.compile(r"[\w-]{1,100}", re.ASCII)
# Required kind of value for pydantic's types of errors. Other errors keep pydantic's message.
_MUST_BE = {
    "bool_type": "true or false",
    "float_type": "a number",
    "int_type": "a whole number",
    "list_type": "a list in [...]",
    "model_type": "a table of keys",
    "string_type": "a text in quotes",
}
_IMAGING = ("grid", "image", "mosaic", "process")  # tables that do not affect range lines


@dataclass(frozen=True, eq=False)
class SceneFile:
    """Contents of a scene file. Attributes of missing tables are None or empty.

    Attributes
    ----------
    name : str
        Origin of the scene, for messages.
    sonar, track, grid, georeference, sound_speed
        From the tables of these names. Track and grid have the georeference.
    targets : PointTargets, Seabed, or a tuple of both
        From the tables `targets` and `seabed`.
    simulate, compress, image : dict
        Keyword arguments for `clsas.simulate` (with the sound speed), for `clsas.compress`, and for
        `clsas.plan` (one of `PLAN_KEYS`) or `clsas.backproject` (any of `EXACT_KEYS`). The last
        may include a `beam`, and `PROMISE_KEYS` for `clsas.factorize` and `clsas.backproject`.
    mosaic : dict
        Paths that `clsas mosaic` reads (`lines`) and writes (`store`), and its `patches` and
        `memory_mib`.
    process : dict
        Paths that `clsas process` reads (`lines`) and writes (`output`), its `steps`, the receiver
        `bank` that it images, and the keyword arguments of the steps `calibrate`, `navigate`,
        `focus` and `heights`.
    files : dict
        Paths of the files that the scene refers to, by key: "track.file", "grid.height_file",
        "sound_speed.file", "mosaic.lines", "process.lines".
    """

    name: str
    sonar: Sonar | None = None
    track: Track | None = None
    targets: Scene | None = None
    grid: Grid | None = None
    georeference: Georeference | None = None
    sound_speed: SoundSpeed | None = None
    simulate: dict[str, Any] = field(default_factory=dict)
    compress: dict[str, Any] = field(default_factory=dict)
    image: dict[str, Any] = field(default_factory=dict)
    mosaic: dict[str, Any] = field(default_factory=dict)
    process: dict[str, Any] = field(default_factory=dict)
    files: dict[str, Path] = field(default_factory=dict)

    @property
    def request(self) -> dict[str, Any]:
        """Request of `[image]`: one of `PLAN_KEYS` or any of `EXACT_KEYS`, or an empty dict."""
        planned = {key: value for key, value in self.image.items() if key in PLAN_KEYS}
        return planned or {key: value for key, value in self.image.items() if key in EXACT_KEYS}

    @property
    def promise(self) -> dict[str, Any]:
        """Those `PROMISE_KEYS` that `[image]` has: whether its error is measured, and what for."""
        return {key: value for key, value in self.image.items() if key in PROMISE_KEYS}

    def need(self, *tables: str) -> tuple[Any, ...]:
        """Return the attributes with the given names; raise ValueError if one is missing."""
        for table in tables:
            if getattr(self, table) is None:
                missing = "[[targets]] or [seabed]" if table == "targets" else f"[{table}]"
                raise ValueError(f"{self.name}: missing table {missing}")
        return tuple(getattr(self, table) for table in tables)


def read_scene(path: str | os.PathLike) -> SceneFile:
    """Return the contents of a scene file.

    Parameters
    ----------
    path : path-like
        The TOML file. Relative paths in it start from its folder.

    Raises
    ------
    ValueError
        If the file is not TOML, if a key is unknown, missing, of the wrong type or outside its
        limits, or if a file that the scene refers to cannot be read. The message has one line for
        each of the first 20 mistakes, with the key, its value and the allowed values.
    OSError
        If the file cannot be read.
    """
    path = Path(path)
    return parse_scene(
        reading.read_bytes(path, reading.TOML_BYTES), name=str(path), folder=path.parent
    )


def parse_scene(text: bytes, *, name: str, folder: Path) -> SceneFile:
    """Return the scene that a TOML text describes; see `read_scene`."""
    try:
        tables = reading.parse_toml(text)
    except ValueError as error:  # from TOML or UTF-8
        if text.startswith(b"\x89HDF"):
            raise ValueError(f"{name}: an HDF5 file, not a scene file") from None
        raise ValueError(f"{name}: not a TOML file: {error}") from None
    try:
        model = SceneTables.model_validate(tables)
    except ValidationError as error:
        mistakes = _explained(error, tables)
        lines = [f"{name}: {line}" for line in mistakes[:_MOST_MISTAKES]]
        if len(mistakes) > _MOST_MISTAKES:
            lines.append(f"{name}: and {len(mistakes) - _MOST_MISTAKES} more mistakes")
        raise ValueError("\n  ".join(lines)) from None
    except RecursionError:
        raise ValueError(f"{name}: tables or lists are nested too deeply") from None
    with located(f"{name}:"):
        return SceneFile(name=name, **model.build(folder))


def _explained(error: ValidationError, tables: dict[str, Any]) -> list[str]:
    """Return a line of text for every key of a parsed file that pydantic refuses."""
    lines: dict[tuple, str] = {}
    musts: dict[tuple, dict[str, None]] = {}  # dicts that serve as ordered sets
    mistyped: set[tuple] = set()
    for problem in error.errors(include_url=False):
        kind, location = problem["type"], problem["loc"]
        if kind == "missing":
            lines[location] = f"missing key {location[-1]!r} in {_table(location[:-1])}"
            continue
        # Pydantic's location also contains members of unions, which the file does not have.
        path: tuple[str | int, ...] = ()
        inside: Any = tables
        for part in location:
            try:
                inside = inside[part]
            except (KeyError, IndexError, TypeError):
                break
            path = *path, part
        if kind == "extra_forbidden":
            *parents, name = *path[:-1], str(path[-1])
            model: type[BaseModel] = SceneTables
            for part in parents:
                if isinstance(part, str):
                    model = next(models_in(model.model_fields[part].annotation))
            allowed = list(model.model_fields)
            mistyped |= {(*parents, guess) for guess in closest(name, allowed)}
            if parents:
                unknown = f"key {validate.shown(name)} in {_table(parents)}"
            else:
                unknown = f"table [{name if _BARE_KEY.fullmatch(name) else validate.shown(name)}]"
            lines[path] = f"unknown {unknown}{suggestion(name, allowed)}"
            continue
        context = problem.get("ctx", {})
        if path == ("targets",):
            must = "one or more tables [[targets]]"
        elif "actual_length" in context:
            must = f"a list of {context.get('min_length', context.get('max_length'))}"
        else:
            must = _MUST_BE.get(kind, problem["msg"])
        musts.setdefault(path, {})[must] = None  # pydantic reports one error per member of a union
        last = max(index for index, part in enumerate(path) if isinstance(part, str))
        key = f"{path[last]}" + "".join(f"[{index}]" for index in path[last + 1 :])
        key = f"{_table(path[:last])} {key}" if last else key
        got = validate.shown(problem["input"])
        lines[path] = f"{key} must be {' or '.join(musts[path])}, got {got}"
    return [line for path, line in lines.items() if path not in mistyped]


def _table(path: Sequence[str | int]) -> str:
    """Return the name of a table as in the file; repeated tables are counted from 1."""
    name = ".".join(str(part) for part in path if isinstance(part, str))
    return f"[[{name}]] number {path[-1] + 1}" if isinstance(path[-1], int) else f"[{name}]"


def simulation_digest(text: bytes, folder: Path) -> str:
    """Return a digest of all that a scene's range lines depend on, including clsas's version."""
    tables = reading.parse_toml(text)
    used = {name: table for name, table in tables.items() if name not in _IMAGING}
    paths = [
        folder / file
        for table in ("track", "sound_speed")
        if isinstance(file := tables.get(table, {}).get("file"), str)
    ]
    return digest([__version__, used, *map(reading.read_bytes, paths)])


def built_in_scene(name: str) -> bytes:
    """Return the text of a scene file that is part of clsas, such as "thesis_wide_beam"."""
    folder = files("clsas") / "scenes"
    names = sorted(Path(item.name).stem for item in folder.iterdir())
    return (folder / f"{validate.one_of('name', name, names)}.toml").read_bytes()
