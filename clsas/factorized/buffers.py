"""The buffers of a factorized image on a device: names, shapes and types.

The run allocates from these lists, and the prediction of memory adds them up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clsas.opencl.buffers import (
    GUARD,
    VECTOR_ROOM,
    Buffer,
    Buffers,
    channel_pitch,
    expansion_terms,
    lines_buffer,
    round_up,
)
from clsas.sonar.beam import BeamWindow

CHUNK = 32
"""Channels that a stage adds up before it hands on the sums, and takes up those still open."""
LEAST_BATCH = 2
"""Roots that are formed together at least, if they fit the memory: fewer commands."""


@dataclass(frozen=True)
class Level:
    """Lines of one stage: `half` samples to either side of a subimage's centre.

    Attributes
    ----------
    half, length : int
        Samples that are needed to either side, and in all, in whole vectors.
    """

    half: int
    length: int

    @classmethod
    def of(cls, half: int, width: int) -> Level:
        """Return the lines of a stage for a device with some lanes."""
        return cls(half, round_up(2 * half + 1, width))

    @property
    def pitch(self) -> int:
        """Samples of a line with the zeros around it."""
        return self.length + 2 * GUARD

    @property
    def centre(self) -> int:
        """Sample of the subimage's centre."""
        return self.half + GUARD


def row_pitch(channels: int) -> int:
    """Return the channels of a row in a table, where a vector may begin at the last."""
    return channel_pitch(channels) + VECTOR_ROOM


def stage_tables(
    level: int,
    roots: int,
    subimages: int,
    channels: int,
    *,
    ramps: bool,
    bands: int = 1,
    rows: bool = False,
) -> Buffers:
    """Return the tables of a stage, which tell how channels are aligned and combined.

    Parameters
    ----------
    level : int
        Number of the stage.
    roots, subimages : int
        Roots, and the stage's subimages in each.
    channels : int
        Channels of the stage before in each root; of the first stage raw ones.
    ramps : bool
        True if phases of raw channels are turned along their lines.
    bands : int
        Bands of channels: see `clsas.aperture.virtual_channels.Bands`.
    rows : bool
        True if virtual channels lie in the rows of a sheet.
    """
    row = (roots, row_pitch(channels))
    tables = {
        f"bands{level}": Buffer((roots, subimages, bands, 7), np.int32),
        f"base{level}": Buffer(row, np.int32),
        f"between{level}": Buffer(row, np.float32),
    }
    if rows:
        tables[f"rows{level}"] = Buffer(row, np.float32)
    if level:
        tables[f"positions{level}"] = Buffer((roots, 3, row[1]), np.float32)
        tables[f"offsets{level}"] = Buffer((roots, subimages, 6), np.float32)
        return tables
    tables |= {name: Buffer(row, np.int32) for name in ("order", "start")}
    names = ("nu", "cycles", *(["ramp"] if ramps else []))
    return tables | {name: Buffer(row, np.float32) for name in names}


def stage_lines(
    level: int, subimages: int, channels: int, pitch: int, *, half_precision: bool
) -> Buffers:
    """Return the lines that a stage forms: so many virtual channels of some subimages."""
    return {f"lines{level}": lines_buffer(subimages * channels, pitch, half_precision)}


def leaf_tables(
    virtual_channels: int, parts: int, points: int | None, beam: BeamWindow | None
) -> Buffers:
    """Return the tables of leaves.

    Parameters
    ----------
    virtual_channels : int
        Of all roots together.
    parts : int
        Tiles or groups.
    points : int or None
        Off a plane, the points of all groups.
    beam : BeamWindow or None
    """
    columns = virtual_channels + VECTOR_ROOM
    tables = {
        "geometry": Buffer((6 if beam is None else 9, columns), np.float32),
        "ranges": Buffer((parts, 3), np.int32),
    }
    if beam is not None and beam.normalise:
        tables["represented"] = Buffer((1, columns), np.float32)
    if points is not None:
        tables["centres"] = Buffer((parts, 6), np.float32)
        tables["offsets"] = Buffer((3, points), np.float32)
    return tables


def tile_buffers(tiles: int, channels: int, beam: BeamWindow | None, *, aligned: bool) -> Buffers:
    """Return what a batch of tiles takes besides their pixels.

    Parameters
    ----------
    tiles : int
    channels : int
        Virtual channels of a leaf.
    beam : BeamWindow or None
    aligned : bool
        True if tiles are leaves, on whose centres lines are aligned.
    """
    row = (tiles, channel_pitch(channels))
    buffers = {"expansions": Buffer((*row, expansion_terms(beam)), np.float32)}
    if not aligned:
        buffers["sample"] = Buffer(row, np.int32)
        buffers |= {name: Buffer(row, np.float32) for name in ("fraction", "phase")}
    return buffers
