"""Reading of tracks from CSV files."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial

import numpy as np

from clsas.engine.data import validate
from clsas.engine.data.findings import warn_of
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.track import Track, doubts_of_track
from clsas.engine.data.validate import ArgumentError
from clsas.files.csv_columns import read_columns
from clsas.files.mistakes import suggestion
from clsas.files.tables import located

_POSITION = ("x_m", "y_m", "z_m")
_VELOCITY = ("vx_m_s", "vy_m_s", "vz_m_s")
_ATTITUDE = ("yaw_deg", "pitch_deg", "roll_deg")
_GEOGRAPHIC = ("latitude_deg", "longitude_deg", "height_m", "heading_deg")


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
    column = read_columns(path, partial(_check_names, path), "at least one ping")
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


def _check_names(path: str | os.PathLike, names: list[str]) -> None:
    """Raise ValueError unless the names of columns are those of one kind of file."""
    in_metres = ("time_s", *_POSITION, *_ATTITUDE, *_VELOCITY)
    for name in names:
        if name not in (known := (*in_metres, *_GEOGRAPHIC)):
            raise ValueError(
                f"{path}: unknown column {validate.shown(name)}{suggestion(name, known)}"
            )
    if set(names) & set(_GEOGRAPHIC):
        required: tuple[str, ...] = ("time_s", *_GEOGRAPHIC)
        for name in names:
            if name not in (*required, *_ATTITUDE[1:]):
                allowed = "be left out with latitude_deg and longitude_deg"
                raise ArgumentError(f"column {name!r}", allowed, where=f"{path}:")
    else:
        required = ("time_s", *_POSITION, *(_VELOCITY if set(names) & set(_VELOCITY) else ()))
    for name in (*required, *names):
        if names.count(name) != 1:
            raise ArgumentError(f"column {name!r}", "be present once", where=f"{path}:")
