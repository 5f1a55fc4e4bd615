"""Tracks and sound-speed profiles in CSV files: a line of column names, then numbers."""

from __future__ import annotations

import csv
import io
import os
from array import array
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reading, validate
from clsas.engine.data.findings import warn_of
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.sound_speed import SoundSpeed
from clsas.engine.data.track import Track, doubts_of_track
from clsas.engine.data.validate import ArgumentError
from clsas.files.tables import located, suggestion

_POSITION = ("x_m", "y_m", "z_m")
_VELOCITY = ("vx_m_s", "vy_m_s", "vz_m_s")
_ATTITUDE = ("yaw_deg", "pitch_deg", "roll_deg")
_GEOGRAPHIC = ("latitude_deg", "longitude_deg", "height_m", "heading_deg")
_MEASURED = ("depth_m", "speed_m_s")
_DERIVED = ("depth_m", "temperature_c", "salinity")


def read_track(path: str | os.PathLike, georeference: Georeference | None = None) -> Track:
    """Return the track in a CSV file, which has a line of column names and one line per ping.

    The columns may be in any order. Required are time_s, and either x_m, y_m and z_m, or
    latitude_deg, longitude_deg, height_m and heading_deg, which `Track.from_geographic` describes.

    With positions in metres, yaw_deg, pitch_deg and roll_deg are optional (0 by default), and so
    are vx_m_s, vy_m_s and vz_m_s together (by default the derivative of the positions). With
    latitudes and longitudes, pitch_deg (positive with the bow up) and roll_deg are.

    Parameters
    ----------
    path : path-like
    georeference : Georeference, optional
        Frame of the track. Without it, latitudes and longitudes make a frame of their own.

    Raises
    ------
    ValueError
        If a column is unknown, missing or repeated, if there is no ping, if a value is not a finite
        number or outside its limits, or if time does not ascend.
    ImportError
        If latitudes and longitudes are given and pyproj is not installed (extra `maps`).
    OSError
        If the file cannot be read.
    """

    def check(names: list[str]) -> None:
        if set(names) & set(_GEOGRAPHIC):
            required: tuple[str, ...] = ("time_s", *_GEOGRAPHIC)
            for name in names:
                if name not in (*required, *_ATTITUDE[1:]):
                    allowed = "be left out with latitude_deg and longitude_deg"
                    raise ArgumentError(f"column {name!r}", allowed, where=f"{path}:")
        else:
            velocity = _VELOCITY if set(names) & set(_VELOCITY) else ()
            required = ("time_s", *_POSITION, *velocity)
        for name in (*required, *names):
            if names.count(name) != 1:
                raise ArgumentError(f"column {name!r}", "be present once", where=f"{path}:")

    known = ("time_s", *_POSITION, *_ATTITUDE, *_VELOCITY, *_GEOGRAPHIC)
    column = read_columns(path, known, check, "at least one ping")
    with located(f"{path}:"):
        if set(column) & set(_GEOGRAPHIC):
            return Track.from_geographic(**column, georeference=georeference)
        positions = np.stack([column[name] for name in _POSITION], axis=-1)
        track = Track(
            positions,
            column["time_s"],
            yaw_rad=np.radians(column.get("yaw_deg", 0.0)),
            pitch_rad=np.radians(column.get("pitch_deg", 0.0)),
            roll_rad=np.radians(column.get("roll_deg", 0.0)),
            georeference=georeference,
        )
        warn_of(doubts_of_track(positions, track.time_s), f"{path}: ")
        if set(column) & set(_VELOCITY):
            return replace(track, velocity_m_s=np.stack([column[v] for v in _VELOCITY], axis=-1))
        if track.pings > 1:
            return replace(track, velocity_m_s=np.gradient(positions, track.time_s, axis=0))
        return track


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

    def check(names: list[str]) -> None:
        if sorted(names) not in (sorted(_MEASURED), sorted(_DERIVED)):
            allowed = f"be {', '.join(_MEASURED)} or {', '.join(_DERIVED)}"
            raise ArgumentError("columns", allowed, ", ".join(names), where=f"{path}:")

    known = tuple(dict.fromkeys((*_MEASURED, *_DERIVED)))
    column = read_columns(path, known, check, "depths")
    with located(f"{path}:"):
        if "speed_m_s" in column:
            return SoundSpeed(column["depth_m"], column["speed_m_s"], surface_z_m)
        return SoundSpeed.from_temperature(
            *(column[name] for name in _DERIVED), surface_z_m=surface_z_m
        )


def read_columns(
    path: str | os.PathLike,
    known: tuple[str, ...],
    check: Callable[[list[str]], None],
    rows_of: str,
) -> dict[str, NDArray[np.float64]]:
    """Return the columns of a file by the names in its first line. Blank lines are skipped.

    Parameters
    ----------
    path : path-like
    known : tuple of str
        Names that columns may have.
    check : callable
        Called with the names, all of which are known; raises ValueError unless they are complete.
    rows_of : str
        What the rows contain, for messages.

    Raises
    ------
    ValueError
        If the file is not CSV in UTF-8, names are not allowed, there are no rows, or a row does not
        have a number for each name.
    """
    # Rows are converted one by one: kept as text, they would take 50 to 100 bytes per byte.
    text = reading.read_text(path, reading.COLUMNS_BYTES)
    reader = csv.reader(io.StringIO(text, newline=""), skipinitialspace=True)
    rows = (row for row in reader if any(cell.strip() for cell in row))
    values = array("d")
    try:
        names = [name.strip() for name in next(rows, [])]
        for name in names:
            if name not in known:
                raise ValueError(
                    f"{path}: unknown column {validate.shown(name)}{suggestion(name, known)}"
                )
        check(names)
        for row in rows:
            try:
                values.extend([float(value) for _, value in zip(names, row, strict=True)])
            except ValueError:
                got = validate.shown(",".join(row))
                line, where = f"line {reader.line_num}", f"{path}:"
                raise ArgumentError(line, f"be {len(names)} numbers", got, where=where) from None
    except csv.Error as error:
        raise ValueError(f"{path}: line {reader.line_num} is not CSV: {error}") from None
    if not values:
        raise ValueError(f"{path} must have {rows_of} below the names of the columns")
    return dict(zip(names, np.frombuffer(values).reshape(-1, len(names)).T, strict=True))
