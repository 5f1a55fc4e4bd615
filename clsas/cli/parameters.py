"""Types of options and arguments: parsed values, and files that are checked before any work."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from clsas.cli.wording import option_name
from clsas.engine.data import validate
from clsas.engine.data.atomic import check_writable
from clsas.engine.data.extras import check_installed
from clsas.engine.data.reading import check_ordinary


class Parsed(click.ParamType):
    """A value that a function parses from text.

    Parameters
    ----------
    name : str
        Form of the text, as --help shows it.
    parse : callable
        Returns the value; raises ValueError or ArithmeticError if the text has another form.
    expected : str
        Form of the text in messages, after "must be".
    """

    def __init__(self, name: str, parse: Callable[[str], Any], expected: str) -> None:
        self.name = name
        self._parse = parse
        self._expected = expected

    def convert(self, value: str, param: Any, ctx: Any) -> Any:
        """Return the value of a text; a usage error if the text has another form."""
        try:
            return self._parse(value)
        except (ValueError, ArithmeticError):
            self.fail(f"{validate.shown(value)} must be {self._expected}", param, ctx)


def _axis(text: str) -> tuple[float, float, int]:
    start, stop, count = text.split(":")
    axis = float(start), float(stop), int(count)
    if not (math.isfinite(axis[0]) and math.isfinite(axis[1]) and axis[2] > 0):
        raise ValueError
    if axis[2] > 1 and axis[0] == axis[1]:
        raise ValueError
    return axis


def _position(text: str) -> tuple[float, ...]:
    position = tuple(map(float, text.split(",")))
    if len(position) not in (2, 3) or not all(map(math.isfinite, position)):
        raise ValueError
    return position


def _stages(text: str) -> tuple[tuple[int, int], ...]:
    pairs = [stage.lower().split("x") for stage in text.split(",")]
    stages = tuple((int(beams), int(divisions)) for beams, divisions in pairs)
    if min(map(min, stages)) < 1:
        raise ValueError
    return stages


def _counts(text: str) -> tuple[int, int]:
    rows, columns = map(int, text.lower().split("x"))
    if min(rows, columns) < 1:
        raise ValueError
    return rows, columns


def _span(text: str) -> tuple[float, float]:
    low, high = map(float, text.split(":"))
    return low, high


def _ratio(text: str) -> float:
    above, _, below = text.partition("/")
    return float(above) / float(below or 1)


AXIS = Parsed("START:STOP:N", _axis, "START:STOP:N, two positions in metres and a number of pixels")
POSITION = Parsed("X,Y", _position, "X,Y or X,Y,Z in metres, without a space, such as 0,42.5")
ORIGIN = Parsed(
    "LATITUDE,LONGITUDE",
    _position,
    "LATITUDE,LONGITUDE in degrees, or LATITUDE,LONGITUDE,HEIGHT, without a space, such as "
    "60.39,5.32",
)
RATIO = Parsed("NUMBER", _ratio, "a number or a fraction such as 1/30")
STAGES = Parsed("QRxQI,...", _stages, "QRxQI for every stage, such as 2x2,2x2")
SPAN = Parsed("LOW:HIGH", _span, "LOW:HIGH, two numbers, such as 30:60")
COUNTS = Parsed("ROWSxCOLUMNS", _counts, "ROWSxCOLUMNS, at least 1x1, such as 8x8")


class File(click.Path):
    """A file or folder that a command reads or writes. No output may replace an input."""

    written = False

    def __init__(self, **allowed: Any) -> None:
        super().__init__(**allowed, path_type=Path)

    def convert(self, value: Any, param: Any, ctx: Any) -> Path:
        """Return the path; a usage error if it is both read and written."""
        if not os.fspath(value):
            self.fail("must be a path, got an empty one", param, ctx)
        if os.fspath(value) == "-":
            self.fail("must be a path; '-' for standard input or output is not one", param, ctx)
        path: Any = super().convert(value, param, ctx)
        if not self.written and path.exists():
            try:
                check_ordinary(path)
            except ValueError as error:
                self.fail(str(error), param, ctx)
        for other in ctx.command.params:
            # Of two parameters, the second one to be converted finds the first one here.
            if other is not param and isinstance(other.type, File):
                taken = ctx.params.get(other.name)
                if self.written or other.type.written:
                    for each in taken if isinstance(taken, tuple) else (taken,):
                        keep_apart(option_name(other), each, option_name(param), path)
        return path


class Output(File):
    """A file to write, which is checked to be writable before any work."""

    written = True

    def __init__(self, *suffixes: str) -> None:
        super().__init__(dir_okay=False, writable=True)
        self._suffixes = suffixes

    def convert(self, value: Any, param: Any, ctx: Any) -> Path:
        """Return the path; a usage error if the file cannot be written."""
        path = super().convert(value, param, ctx)
        try:
            validate.suffix("the file's name", path, *self._suffixes)
        except ValueError as error:
            self.fail(str(error), param, ctx)
        if not path.parent.is_dir():
            self.fail(f"there is no folder {str(path.parent)!r}", param, ctx)
        try:
            special = _exists(path) and not path.is_file()
            check_writable(path.parent, path)
        except OSError as error:
            self.fail(f"{str(path)!r} cannot be written: {error.strerror}", param, ctx)
        if special:
            self.fail(f"{str(path)!r} is not an ordinary file", param, ctx)
        if param.name == "picture":
            need_matplotlib()
        return path


class Store(File):
    """A Zarr store to write, which is a folder."""

    written = True


class Hdf5(File):
    """An HDF5 file to read. If it is a scene file, the message shows the usual command."""

    def __init__(self, *, or_store: bool = False) -> None:
        super().__init__(exists=True, dir_okay=or_store)

    def convert(self, value: Any, param: Any, ctx: Any) -> Path:
        """Return the path; a usage error if it is a scene file."""
        path = super().convert(value, param, ctx)
        if path.suffix.lower() != ".toml":
            return path
        name = option_name(param)
        usual = [ctx.command_path, name]
        for other in ctx.command.params:
            if other.name == "scene":
                usual.append(f"--scene {path}")
            elif other.name == "output":
                usual.append("-o OUTPUT.H5")
        raise click.UsageError(f"{name} is missing, {path} is a scene: {' '.join(usual)}", ctx)


INPUT = File(exists=True, dir_okay=False)
HDF5 = Hdf5()
HDF5_OR_STORE = Hdf5(or_store=True)


def keep_apart(one: str, path: Path | None, other: str, path_of_other: Path | None) -> None:
    """Raise UsageError if two files, which messages call `one` and `other`, are the same."""
    if path and path_of_other and os.path.realpath(path) == os.path.realpath(path_of_other):
        raise click.UsageError(f"{one} and {other} must be two files, got {str(path)!r}")


def keep_out(option: str, path: Path | None, what: str, folder: Path) -> None:
    """Raise UsageError if the file of an option lies in a folder, which messages call `what`."""
    if path is not None and Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder)):
        raise click.UsageError(f"{option} must not lie in {what}, got {str(path)!r}")


def written_to(ctx: click.Context) -> dict[str, Path]:
    """Return the paths that the running command writes, by option."""
    outputs = [p for p in ctx.command.params if isinstance(p.type, File) and p.type.written]
    paths = {option_name(param): ctx.params.get(param.name) for param in outputs}
    return {shown: path for shown, path in paths.items() if path is not None}


def _exists(path: Path) -> bool:
    """Return whether a path exists; raise OSError if it cannot, as with too long a name."""
    try:
        path.stat()
    except FileNotFoundError:
        return False
    return True


def need_matplotlib() -> None:
    """End the command if pictures cannot be drawn."""
    check_installed("matplotlib", "pictures")
