"""Reading of sound-speed profiles from CSV files."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

from clsas.engine.data import validate
from clsas.engine.data.sound_speed import SoundSpeed
from clsas.engine.data.validate import ArgumentError
from clsas.files.csv_columns import read_columns
from clsas.files.mistakes import suggestion
from clsas.files.tables import located

_MEASURED = ("depth_m", "speed_m_s")
_DERIVED = ("depth_m", "temperature_c", "salinity")


def read_sound_speed(path: str | os.PathLike, *, surface_z_m: float = 0.0) -> SoundSpeed:
    """Return the sound-speed profile in a CSV file.

    The file has a line of column names and one line per depth, in ascending order. The columns are
    either depth_m and speed_m_s, or depth_m, temperature_c and salinity, from which Mackenzie's
    formula gives the speed (`SoundSpeed.from_temperature`). They may be in any order.

    Parameters
    ----------
    path : path-like
        The file.
    surface_z_m : float
        Height z of the surface, metres, as for `SoundSpeed`.

    Raises
    ------
    ValueError
        If a column is unknown, missing or repeated, a value is not a finite number, or the values
        are not those of a profile (`SoundSpeed`).
    OSError
        If the file cannot be read.

    Examples
    --------
    >>> import clsas
    >>> profile = clsas.read_sound_speed("cast.csv", surface_z_m=20.0)  # doctest: +SKIP
    """
    path = validate.path("path", path)
    column = read_columns(path, partial(_check_names, path), "depths")
    with located(f"{path}:"):
        if "speed_m_s" in column:
            return SoundSpeed(column["depth_m"], column["speed_m_s"], surface_z_m)
        return SoundSpeed.from_temperature(
            *(column[name] for name in _DERIVED), surface_z_m=surface_z_m
        )


def _check_names(path: Path, names: list[str]) -> None:
    """Raise ValueError unless the names of columns are those of one kind of file."""
    known = tuple(dict.fromkeys((*_MEASURED, *_DERIVED)))
    for name in names:
        if name not in known:
            raise ValueError(
                f"{path}: unknown column {validate.shown(name)}{suggestion(name, known)}"
            )
    if sorted(names) not in (sorted(_MEASURED), sorted(_DERIVED)):
        allowed = f"be {', '.join(_MEASURED)} or {', '.join(_DERIVED)}"
        raise ArgumentError("columns", allowed, ", ".join(names), where=f"{path}:")
