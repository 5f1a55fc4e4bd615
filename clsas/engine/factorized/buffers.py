"""The buffers of a factorized image on a device: their names, shapes and types.

The run allocates from these lists, and the prediction of memory adds them up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from clsas.engine.data.beam import BeamWindow
from clsas.engine.device.buffers import (
    GUARD,
    VECTOR_ROOM,
    Buffer,
    Buffers,
    channel_pitch,
    expansion_terms,
    geometry_buffer,
    lines_buffer,
    round_up,
)

CHUNK = 32
"""Channels that the stage kernel adds up before it writes its sums, and resumes unfinished ones."""
LEAST_BATCH = 2
"""Least number of roots formed together if memory allows, so that commands are few."""


@dataclass(frozen=True, eq=False)
class DeviceLines:
    """Upsampled lines on a device.

    Attributes
    ----------
    samples : Buffer
    pitch : int
        Samples from one line to the next.
    half_precision : bool
        True if these lines, and those that stages form, are in half precision.
    gain : float
        Power of 2 by which the samples were multiplied; 1 in single precision.
    """

    samples: cl.Buffer
    pitch: int
    half_precision: bool
    gain: float


@dataclass(frozen=True)
class Level:
    """Layout of the lines of a stage, with `half` samples on either side of a subimage's centre.

    Attributes
    ----------
    half, length : int
        Samples needed on either side, and in total, rounded up to whole vectors.
    """

    half: int
    length: int

    @classmethod
    def of(cls, half: int, width: int) -> Level:
        """Return the layout for a device with `width` lanes."""
        return cls(half, round_up(2 * half + 1, width))

    @property
    def pitch(self) -> int:
        """Samples of a line, including the zeros around it."""
        return self.length + 2 * GUARD

    @property
    def centre(self) -> int:
        """Sample at the centre of the subimage."""
        return self.half + GUARD


def row_pitch(channels: int) -> int:
    """Return the length of a table's row, in which a vector may begin at the last channel."""
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
    """Return the tables of a stage, by which channels are aligned and combined.

    Parameters
    ----------
    level : int
        Number of the stage.
    roots, subimages : int
        Number of roots, and of the stage's subimages in each.
    channels : int
        Channels of the stage before in each root; for the first stage, raw channels.
    ramps : bool
        True if phases of raw channels are turned along their lines.
    bands : int
        Number of bands of channels; see `clsas.engine.factorized.virtual_channels.Bands`.
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
    """Return the buffer of the lines that a stage forms, `channels` for each subimage."""
    return {f"lines{level}": lines_buffer(subimages * channels, pitch, half_precision)}


def leaf_tables(
    virtual_channels: int,
    parts: int,
    points: int | None,
    beam: BeamWindow | None,
    corrected_channels: int = 0,
) -> Buffers:
    """Return the tables of leaves.

    Parameters
    ----------
    virtual_channels : int
        Virtual channels of all roots together.
    parts : int
        Number of tiles or groups.
    points : int or None
        Number of points in all groups; None on a plane.
    beam : BeamWindow or None
    corrected_channels : int
        Virtual channels of a leaf if ranges are corrected, else 0.
    """
    geometry = geometry_buffer(virtual_channels, beam)
    tables = {
        "geometry": geometry,
        "ranges": Buffer((parts, 3), np.int32),
    }
    if beam is not None and beam.normalise:
        tables["represented"] = Buffer((1, geometry.shape[1]), np.float32)
    if points is not None:
        tables["centres"] = Buffer((parts, 6), np.float32)
        tables["offsets"] = Buffer((3, points), np.float32)
    if corrected_channels:
        tables["corrections"] = Buffer((parts, channel_pitch(corrected_channels)), np.float32)
    return tables


def tile_buffers(tiles: int, channels: int, beam: BeamWindow | None, *, aligned: bool) -> Buffers:
    """Return the buffers of a batch of tiles, apart from those of the pixels.

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
