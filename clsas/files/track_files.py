"""Reading of tracks from CSV files."""

from __future__ import annotations

import csv
import io
import os
from dataclasses import replace

import numpy as np

from clsas.core import reading, validate
from clsas.files.mistakes import suggestion
from clsas.files.tables import located
from clsas.sonar.track import Track

_POSITION = ("time_s", "x_m", "y_m", "z_m")
_VELOCITY = ("vx_m_s", "vy_m_s", "vz_m_s")
_ATTITUDE = ("yaw_deg", "pitch_deg", "roll_deg")


def read_track(path: str | os.PathLike) -> Track:
    """Return the track in a CSV file, which has a line of column names and one line per ping.

    The columns may be in any order. Required are time_s, x_m, y_m and z_m. Optional are yaw_deg,
    pitch_deg and roll_deg (0 by default), and all of vx_m_s, vy_m_s and vz_m_s together (by default
    the derivative of the positions).

    Raises
    ------
    ValueError
        If a column is unknown, missing or repeated, if there is no ping, if a value is not a finite
        number, or if time does not ascend.
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
            raise ValueError(
                f"{path}: unknown column {validate.shown(name)}{suggestion(name, known)}"
            )
    velocity = _VELOCITY if set(names) & set(_VELOCITY) else ()
    for name in (*_POSITION, *velocity, *names):
        if names.count(name) != 1:
            raise ValueError(f"{path}: column {name!r} must be present once")
    if not rows:
        raise ValueError(f"{path} must have at least one ping below the names of the columns")
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
    with located(f"{path}:"):
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
