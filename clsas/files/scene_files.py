"""Scene files: sonar, track, targets, seabed, grid and processing from one TOML file.

docs/scene-files.md lists every key. A file is checked whole before anything is computed, and every
message names the file, the table and the key.
"""

from __future__ import annotations

import csv
import difflib
import hashlib
import inspect
import io
import json
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from clsas.core import reading, validate
from clsas.core.grid import Grid
from clsas.core.version import __version__
from clsas.exact.backprojection import BEST_ACCURACY_DB
from clsas.planning.planner import checked_pairs, tolerance_in_db
from clsas.signal.compression import check_options as check_compression
from clsas.signal.interpolation import MOST_UPSAMPLING, TAPS
from clsas.simulation.scenes import PointTargets, Scene, Seabed
from clsas.simulation.seabeds import pipeline, rocks, wreck
from clsas.simulation.simulator import check_options as check_simulation
from clsas.sonar.beam import BeamWindow
from clsas.sonar.system import Pulse, Sonar, line_array
from clsas.sonar.track import Motion, Pointing, Track

PRESETS = ("thesis_wide_beam", "edgetech", "sensotek")
SEABEDS: dict[str, Callable[..., Seabed]] = {"wreck": wreck, "pipeline": pipeline, "rocks": rocks}

_MOST_MISTAKES = 20  # in one message
_IMAGING = ("grid", "image", "mosaic")  # tables that range lines do not depend on

DIAL = ("tolerance_db", "tolerance_wavelengths", "stages")
"""Keys of `[image]` of which `clsas.plan` takes one."""
EXACT = ("accuracy_db", "taps", "upsampling")
"""Keys of `[image]` that `clsas.backproject` takes."""


@dataclass(frozen=True, eq=False)
class SceneFile:
    """What a scene file describes; a part that it leaves out is None.

    Attributes
    ----------
    name : str
        Where it came from, for messages.
    sonar, track, grid
        The tables of these names.
    targets : PointTargets, Seabed, or a tuple of both
        What the tables `targets` and `seabed` describe.
    simulate, compress, image : dict
        Keyword arguments for `clsas.simulate` and `clsas.compress`, and for `clsas.plan` (one of
        `DIAL`) or `clsas.backproject` (some of `EXACT`), either with a `beam`.
    mosaic : dict
        What `clsas mosaic` reads (`lines`), writes (`store`), and its `patches` and `memory_mib`.
    files : dict
        The paths of what is read beside it, by their keys: "track.file", "mosaic.lines".
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
    files: dict[str, Path] = field(default_factory=dict)

    def need(self, *tables: str) -> tuple[Any, ...]:
        """Return the parts of these names; raises ValueError naming one that is missing."""
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
        The TOML file. Files that it names are looked for beside it.

    Raises
    ------
    ValueError
        If it is not TOML, a key is unknown, missing, of a wrong type or outside its limits (one
        line per mistake, each with the key's path, what was given and what is allowed, for the
        first 20), or a file that it names cannot be read.
    OSError
        If it cannot be read.
    """
    path = Path(path)
    return parse_scene(reading.read_bytes(path), name=str(path), folder=path.parent)


def parse_scene(text: bytes, *, name: str, folder: Path) -> SceneFile:
    """Return what the TOML `text` describes; `read_scene` for text that is in no file."""
    try:
        tables = reading.parse_toml(text)
    except ValueError as error:  # TOML's and UTF-8's
        kind = "an HDF5 file, not a scene" if text.startswith(b"\x89HDF") else f"not TOML: {error}"
        raise ValueError(f"{name}: is {kind}") from None
    try:
        return _Scene.model_validate(tables).build(name, folder)
    except ValidationError as error:
        mistakes = _explain(error, tables)
        lines = [f"{name}: {line}" for line in mistakes[:_MOST_MISTAKES]]
        if len(mistakes) > _MOST_MISTAKES:
            lines.append(f"{name}: and {len(mistakes) - _MOST_MISTAKES} more mistakes")
        raise ValueError("\n".join(lines)) from None
    except RecursionError:
        raise ValueError(f"{name}: nested too deep") from None
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: {error}") from None


def simulation_digest(text: bytes, folder: Path) -> str:
    """Return a digest of all that the range lines of a scene file depend on, clsas included."""
    tables = reading.parse_toml(text)
    told = {name: table for name, table in tables.items() if name not in _IMAGING}
    digest = hashlib.sha256(json.dumps([__version__, told], sort_keys=True, default=str).encode())
    if isinstance(file := tables.get("track", {}).get("file"), str):
        digest.update(reading.read_bytes(folder / file))
    return digest.hexdigest()[:12]


def built_in_scene(name: str) -> bytes:
    """Return the text of a scene file that comes with clsas, such as "thesis_wide_beam"."""
    folder = files("clsas") / "scenes"
    names = sorted(Path(item.name).stem for item in folder.iterdir())
    return (folder / f"{validate.one_of('name', name, names)}.toml").read_bytes()


Vector = Annotated[list[float], Field(min_length=3, max_length=3)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    def given(self) -> dict[str, Any]:
        """Return the keys that the file sets."""
        return {name: getattr(self, name) for name in self.model_fields_set}


class _Pulse(_Table):
    carrier_hz: float
    duration_s: float
    bandwidth_hz: float | None = None
    code: str | list[int] = "up"
    taper: float = 0.0

    def build(self) -> Pulse:
        if self.bandwidth_hz is not None:
            code = self.code if isinstance(self.code, str) else tuple(self.code)
            return Pulse(self.carrier_hz, self.bandwidth_hz, self.duration_s, code, self.taper)
        if isinstance(self.code, str):
            raise ValueError("missing key 'bandwidth_hz' (only a phase code sets its own)")
        return Pulse.phase_code(
            self.carrier_hz, self.duration_s, tuple(self.code), taper=self.taper
        )


class _Sonar(_Table):
    preset: str | None = None
    pulse: _Pulse | None = None
    receivers: int | None = None
    spacing_m: float | None = None
    rx_m: list[Vector] | None = None
    tx_m: Vector = [0.0, 0.0, 0.0]
    sample_rate_hz: float | None = None
    sound_speed_m_s: float = 1500.0
    tx_length_m: float | None = None
    rx_length_m: float | None = None
    tx_height_m: float | None = None
    rx_height_m: float | None = None

    def build(self) -> Sonar:
        with _in("[sonar]"):
            if self.preset is not None:
                others = sorted(self.model_fields_set - {"preset"})
                if others:
                    raise ValueError(f"preset must stand alone, got also {', '.join(others)}")
                validate.one_of("preset", self.preset, PRESETS)
                return getattr(Sonar, self.preset)()
            if self.pulse is None:
                raise ValueError("missing table [sonar.pulse], or key 'preset'")
            match self.rx_m, self.receivers, self.spacing_m:
                case list(), None, None:
                    rx = np.array(self.rx_m)
                case None, int(count), float(spacing):
                    rx = line_array(count, spacing)
                case _:
                    raise ValueError("receivers must be given by receivers and spacing_m, or rx_m")
        with _in("[sonar.pulse]"):
            pulse = self.pulse.build()
        skipped = {"preset", "pulse", "receivers", "spacing_m", "rx_m"}
        with _in("[sonar]"):
            return Sonar(pulse, rx, **self.model_dump(exclude=skipped))


class _Motion(_Table):
    """A sinusoid in time, or random motion of the same power."""

    period_s: float
    phase_deg: float = 0.0
    random_seed: int | None = None

    def _motion(self, name: str, unit: str, scale: float = 1.0) -> Motion:
        amplitude = scale * validate.number(name, getattr(self, name), unit)
        period = validate.positive("period_s", self.period_s, "s")
        phase = validate.number("phase_deg", self.phase_deg, "degrees")
        phases, frequencies = np.radians([phase]), np.array([1 / period])
        if self.random_seed is not None:
            if "phase_deg" in self.model_fields_set:
                raise ValueError("phase_deg must be left out with random_seed")
            # Sinusoids of random frequency and phase, none faster than the period given.
            random = np.random.default_rng(validate.count("random_seed", self.random_seed, least=0))
            frequencies = random.uniform(0.1, 1.0, 32) / period
            phases = random.uniform(0, 2 * np.pi, 32)
        amplitude /= np.sqrt(len(phases))

        def motion(time: NDArray[np.float64]) -> NDArray[np.float64]:
            turns = np.multiply.outer(time, frequencies)
            return amplitude * np.sin(2 * np.pi * turns + phases).sum(axis=-1)

        return motion


class _Displacement(_Motion):
    amplitude_m: float

    def build(self) -> Motion:
        return self._motion("amplitude_m", "m")


class _Rotation(_Motion):
    amplitude_deg: float

    def build(self) -> Motion:
        return self._motion("amplitude_deg", "degrees", np.pi / 180)


class _Track(_Table):
    file: str | None = None
    start_m: Vector | None = None
    velocity_m_s: Vector | None = None
    pings: int | None = None
    ping_interval_s: float | None = None
    surge: _Displacement | None = None
    sway: _Displacement | None = None
    heave: _Displacement | None = None
    yaw: _Rotation | None = None
    pitch: _Rotation | None = None
    roll: _Rotation | None = None

    def build(self, folder: Path) -> Track:
        if self.file is not None:
            others = sorted(self.model_fields_set - {"file"})
            if others:
                raise ValueError(f"[track] file must stand alone, got also {', '.join(others)}")
            with _in("[track] file"):
                try:
                    return read_track(folder / self.file)
                except OSError as error:
                    raise ValueError(
                        f"must be readable: {error.strerror}: {folder / self.file}"
                    ) from None
                except UnicodeDecodeError as error:
                    raise ValueError(f"must be text: {folder / self.file}: {error}") from None
        course = ("start_m", "velocity_m_s", "pings", "ping_interval_s")
        for name in course:
            if getattr(self, name) is None:
                raise ValueError(f"[track] missing key {name!r} (or 'file')")
        motions = {}
        for argument in ("surge_m", "sway_m", "heave_m", "yaw_rad", "pitch_rad", "roll_rad"):
            table = argument.split("_")[0]
            if (motion := getattr(self, table)) is not None:
                with _in(f"[track.{table}]"):
                    motions[argument] = motion.build()
        with _in("[track]"):
            return Track.straight(*(getattr(self, name) for name in course), **motions)


class _Target(_Table):
    position_m: Vector
    amplitude: float = 1.0


class _Seabed(_Table):
    scene: str
    x_m: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None
    y_m: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None
    position_m: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None
    heading_deg: float | None = None
    mast_m: float | None = None
    count: int | None = None
    cell_m: float = 0.1
    density_m2: float = 600.0
    seed: int = 0
    floor_db: float = -50.0

    def build(self) -> Seabed:
        with _in("[seabed]"):
            make = SEABEDS[validate.one_of("scene", self.scene, tuple(SEABEDS))]
            options = self.given()
            del options["scene"]
            known = inspect.signature(make).parameters
            for name in options:
                if name not in known:
                    raise ValueError(
                        f"{name} must be left out with the scene {validate.shown(self.scene)}"
                    )
            return make(**options)


class _Axis(_Table):
    start_m: float
    stop_m: float
    count: int

    def build(self) -> tuple[float, float, int]:
        return self.start_m, self.stop_m, self.count


class _Grid(_Table):
    x: _Axis
    y: _Axis
    z_m: float = 0.0

    def build(self) -> Grid:
        with _in("[grid]"):
            return Grid.plane(self.x.build(), self.y.build(), self.z_m)


class _Pointing(_Table):
    squint_deg: float | list[float] = 0.0
    depression_deg: float = 0.0
    spot_m: Vector | None = None

    def build(self) -> Pointing:
        with _in("[simulate.pointing]"):
            if self.spot_m is None:
                squint = np.atleast_1d(self.squint_deg)
                squint = validate.array("squint_deg", squint, np.float64, (None,))
                depression = validate.number("depression_deg", self.depression_deg, "degrees")
                return Pointing.scan(np.radians(squint), depression_rad=np.radians(depression))
            if len(self.model_fields_set) > 1:
                raise ValueError("spot_m must stand alone: it sets the angles")
            return Pointing.spot(self.spot_m)


class _Simulate(_Table):
    spreading: bool = False
    motion_in_flight: bool = False
    element_pattern: bool = True
    phase_centres: bool = False
    range_m: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None
    snr_db: float | None = None
    seed: int = 0
    pointing: _Pointing | None = None

    def build(self) -> dict[str, Any]:
        options = self.given()
        if self.pointing is not None:
            options["pointing"] = self.pointing.build()
        with _in("[simulate]"):
            check_simulation(**options)
        return options


class _Compress(_Table):
    window: str | list[str | float] = "none"
    oversampling: float = 2.0

    def build(self) -> dict[str, Any]:
        options = self.given()
        if isinstance(self.window, list):
            options["window"] = tuple(self.window)
        with _in("[compress]"):
            check_compression(**options)
        return options


class _Beam(_Table):
    width_deg: float
    shape: str = "rectangular"
    squint_deg: float = 0.0
    taper: float = 0.5
    element_length_m: float | None = None
    normalise: bool = False
    track_pings: int | None = None

    def build(self) -> BeamWindow:
        with _in("[image.beam]"):
            return BeamWindow(**self.given())


class _Image(_Table):
    tolerance_db: float | None = None
    tolerance_wavelengths: float | None = None
    stages: list[Annotated[list[int], Field(min_length=2, max_length=2)]] | None = None
    accuracy_db: float | None = None
    taps: int | None = None
    upsampling: float | None = None
    beam: _Beam | None = None

    def build(self) -> dict[str, Any]:
        options = self.given()
        with _in("[image]"):
            dial = [name for name in DIAL if name in options]
            if len(dial) > 1 or (dial and options.keys() & set(EXACT)):
                others = [name for name in (*DIAL, *EXACT) if name in options and name != dial[0]]
                raise ValueError(f"{dial[0]} must stand alone, got also {', '.join(others)}")
            tolerance_in_db(self.tolerance_db, self.tolerance_wavelengths)
            checked_pairs(self.stages or [])
            if self.accuracy_db is not None:
                validate.number(
                    "accuracy_db", self.accuracy_db, "dB", least=BEST_ACCURACY_DB, below=0.0
                )
            if self.taps is not None and self.taps not in TAPS:
                raise ValueError(f"taps must be one of {TAPS}, got {self.taps}")
            if self.upsampling is not None:
                validate.number("upsampling", self.upsampling, least=1.0, most=MOST_UPSAMPLING)
        if self.stages is not None:
            options["stages"] = [tuple(stage) for stage in self.stages]
        if self.beam is not None:
            options["beam"] = self.beam.build()
        return options


class _Mosaic(_Table):
    lines: str | None = None
    store: str | None = None
    patches: Annotated[list[int], Field(min_length=2, max_length=2)] | None = None
    memory_mib: int | None = None

    def build(self, folder: Path) -> dict[str, Any]:
        options = self.given()
        with _in("[mosaic]"):
            for name in ("lines", "store"):
                if name in options:
                    if not options[name]:
                        raise ValueError(f"{name} must be a path, got an empty one")
                    options[name] = folder / options[name]
            if "lines" in options and not options["lines"].exists():
                raise ValueError(f"lines must be a file or folder, there is no {options['lines']}")
            if self.patches is not None:
                rows, columns = (validate.count("every entry of patches", n) for n in self.patches)
                options["patches"] = rows, columns
            if self.memory_mib is not None:
                validate.count("memory_mib", self.memory_mib)
        return options


class _Scene(_Table):
    sonar: _Sonar | None = None
    track: _Track | None = None
    targets: list[_Target] | None = None
    seabed: _Seabed | None = None
    grid: _Grid | None = None
    simulate: _Simulate = _Simulate()
    compress: _Compress = _Compress()
    image: _Image = _Image()
    mosaic: _Mosaic = _Mosaic()

    def build(self, name: str, folder: Path) -> SceneFile:
        parts: list[PointTargets | Seabed] = []
        if self.targets is not None:
            with _in("[[targets]]"):
                parts.append(
                    PointTargets(
                        np.reshape([target.position_m for target in self.targets], (-1, 3)),
                        np.array([target.amplitude for target in self.targets], complex),
                    )
                )
        if self.seabed is not None:
            parts.append(self.seabed.build())
        read = {
            "track.file": self.track and self.track.file,
            "mosaic.lines": self.mosaic.lines,
        }
        return SceneFile(
            name=name,
            sonar=self.sonar.build() if self.sonar else None,
            track=self.track.build(folder) if self.track else None,
            targets=tuple(parts) if len(parts) > 1 else parts[0] if parts else None,
            grid=self.grid.build() if self.grid else None,
            simulate=self.simulate.build(),
            compress=self.compress.build(),
            image=self.image.build(),
            mosaic=self.mosaic.build(folder),
            files={key: folder / file for key, file in read.items() if file},
        )


_POSITION = ("time_s", "x_m", "y_m", "z_m")
_VELOCITY = ("vx_m_s", "vy_m_s", "vz_m_s")
_ATTITUDE = ("yaw_deg", "pitch_deg", "roll_deg")


def read_track(path: str | os.PathLike) -> Track:
    """Read a track from a CSV file with one line per ping under a line of column names.

    Columns, in any order: time_s, x_m, y_m, z_m; if known yaw_deg, pitch_deg, roll_deg (zero unless
    given) and, together, vx_m_s, vy_m_s, vz_m_s (the slope of the positions unless given).

    Raises
    ------
    ValueError
        If a column is unknown, missing or there twice, a value is not a finite number, or time
        does not ascend.
    OSError
        If the file cannot be read.
    """
    text = reading.read_bytes(path).decode("utf-8-sig")
    reader = csv.reader(io.StringIO(text, newline=""), skipinitialspace=True)
    try:
        names = [name.strip() for name in next(reader, [])]
        rows = [(reader.line_num, row) for row in reader if row]
    except csv.Error as error:
        raise ValueError(f"{path}: line {reader.line_num} is not CSV: {error}") from None
    known = (*_POSITION, *_ATTITUDE, *_VELOCITY)
    for name in names:
        if name not in known:
            raise ValueError(f"{path}: unknown column {validate.shown(name)}{_near(name, known)}")
    velocity = _VELOCITY if set(names) & set(_VELOCITY) else ()
    for name in (*_POSITION, *velocity, *names):
        if names.count(name) != 1:
            raise ValueError(f"{path}: column {name!r} must be there once")
    values = np.empty((len(rows), len(names)))
    for index, (line, row) in enumerate(rows):
        try:
            values[index] = [float(value) for value in row]
        except ValueError:
            got = validate.shown(",".join(row))
            raise ValueError(
                f"{path}: line {line} must be {len(names)} numbers, got {got}"
            ) from None
    column = dict(zip(names, values.T, strict=True))
    with _in(f"{path}:"):
        time, *position = (column[name] for name in _POSITION)
        positions = np.stack(position, axis=-1)
        track = Track(
            positions,
            time,
            yaw_rad=np.radians(column.get("yaw_deg", 0.0)),
            pitch_rad=np.radians(column.get("pitch_deg", 0.0)),
            roll_rad=np.radians(column.get("roll_deg", 0.0)),
        )
        if velocity:
            return replace(track, velocity_m_s=np.stack([column[v] for v in velocity], axis=-1))
        if track.pings > 1:
            return replace(track, velocity_m_s=np.gradient(positions, time, axis=0))
        return track


@contextmanager
def _in(place: str) -> Iterator[None]:
    """Put the place in the file before the library's own messages."""
    try:
        yield
    except (TypeError, ValueError) as error:
        raise ValueError(f"{place} {error}") from None


_BARE_KEY = re.compile(r"[\w-]{1,100}", re.ASCII)

# What a value must be, by pydantic's name for the mistake; its own words for any other.
_MUST_BE = {
    "bool_type": "true or false",
    "float_type": "a number",
    "int_type": "a whole number",
    "list_type": "a list in [...]",
    "model_type": "a table of keys",
    "string_type": "a text in quotes",
}


def _explain(error: ValidationError, tables: dict[str, Any]) -> list[str]:
    """Return one line per key that pydantic refuses."""
    lines: dict[tuple, str] = {}
    musts: dict[tuple, dict[str, None]] = {}  # as ordered sets
    mistyped: set[tuple] = set()
    for problem in error.errors(include_url=False):
        kind, path = problem["type"], _path_in(tables, problem["loc"])
        if kind == "missing":
            path = problem["loc"]
            lines[path] = f"missing key {path[-1]!r} in {_table(path[:-1])}"
        elif kind == "extra_forbidden":
            *place, name = *path[:-1], str(path[-1])
            allowed = list(_model_at(place).model_fields)
            mistyped |= {(*place, guess) for guess in _close(name, allowed)}
            table = name if _BARE_KEY.fullmatch(name) else validate.shown(name)
            unknown = (
                f"key {validate.shown(name)} in {_table(place)}" if place else f"table [{table}]"
            )
            lines[path] = f"unknown {unknown}{_near(name, allowed)}"
        else:  # each member of a union of types reports its own
            musts.setdefault(path, {})[_must_be(problem, path)] = None
            expected = " or ".join(musts[path])
            lines[path] = f"{_key(path)} must be {expected}, got {validate.shown(problem['input'])}"
    return [line for path, line in lines.items() if path not in mistyped]


def _must_be(problem: Any, path: tuple) -> str:
    if path == ("targets",):
        return "one or more tables [[targets]]"
    if "actual_length" in problem.get("ctx", {}):
        return f"a list of {problem['ctx'].get('min_length', problem['ctx'].get('max_length'))}"
    return _MUST_BE.get(problem["type"], problem["msg"])


def _path_in(tables: Any, location: Sequence[str | int]) -> tuple[str | int, ...]:
    """Return the part of pydantic's location that is in the file: no members of unions."""
    for depth, part in enumerate(location):
        try:
            tables = tables[part]
        except (KeyError, IndexError, TypeError):
            return tuple(location[:depth])
    return tuple(location)


def _table(path: Sequence[str | int]) -> str:
    """Return a table's name as the file writes it, counted from 1 where there are several."""
    name = ".".join(str(part) for part in path if isinstance(part, str))
    return f"[[{name}]] number {path[-1] + 1}" if isinstance(path[-1], int) else f"[{name}]"


def _key(path: Sequence[str | int]) -> str:
    last = max(index for index, part in enumerate(path) if isinstance(part, str))
    name = f"{path[last]}" + "".join(f"[{index}]" for index in path[last + 1 :])
    return f"{_table(path[:last])} {name}" if last else name


def _model_at(place: Sequence[str | int]) -> type[BaseModel]:
    model: type[BaseModel] = _Scene
    for part in place:
        if isinstance(part, str):
            model = next(_models(model.model_fields[part].annotation))
    return model


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the tables in a type such as list[_Target] | None."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models(argument)


def _close(name: str, allowed: Sequence[str]) -> list[str]:
    without_unit = [other for other in allowed if other.startswith(f"{name}_")]
    return (without_unit or difflib.get_close_matches(name, allowed))[:1]


def _near(name: str, allowed: Sequence[str]) -> str:
    if close := _close(name, allowed):
        return f": did you mean {close[0]!r}?"
    return f"; allowed are {', '.join(allowed)}"
