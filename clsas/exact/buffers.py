"""The buffers of an exact image on a device: names, shapes and types.

The run allocates from these lists, and the prediction of memory adds them up. Lines and parts
come in two sets: the host fills one while the device works on the other.
"""

from __future__ import annotations

import numpy as np

from clsas.core.lines import RangeLines
from clsas.exact.blocks import Blocks
from clsas.opencl.buffers import VECTOR_ROOM, Buffer, Buffers, channel_pitch
from clsas.sonar.beam import BeamWindow


def is_bistatic(lines: RangeLines) -> bool:
    """Return whether paths out and back differ."""
    return lines.rx_velocity_m_s is not None or not np.array_equal(lines.tx_m, lines.rx_m)


def block_buffers(
    lines: RangeLines, channels: int, blocks: Blocks, beam: BeamWindow | None
) -> Buffers:
    """Return what a block of channels takes: upsampled lines, and the antennas' geometry.

    Parameters
    ----------
    lines : RangeLines
        All lines, whose kind of path decides about the geometry.
    channels : int
        Channels of the block.
    blocks : Blocks
    beam : BeamWindow or None
    """
    rows = 6 + 6 * is_bistatic(lines)
    rows += 3 * (lines.rx_velocity_m_s is not None) + 3 * (beam is not None)
    pitch = channel_pitch(channels) + VECTOR_ROOM
    return {
        "samples": Buffer((channels, blocks.pitch, 2), np.float32),
        "geometry": Buffer((rows, pitch), np.float32),
    }


def part_buffers(parts: int, part_pixels: int, channels: int, blocks: Blocks) -> Buffers:
    """Return what some parts take in one job besides their pixels.

    Parameters
    ----------
    parts, part_pixels : int
        Tiles or groups of the job, and the pixels of each.
    channels : int
        Channels of a block that any part needs, at most.
    blocks : Blocks
    """
    row = (parts, channel_pitch(channels))
    buffers = {
        "centres": Buffer((parts, 6), np.float32),
        "ranges": Buffer((parts, 3), np.int32),
        "sample": Buffer(row, np.int32),
        "fraction": Buffer(row, np.float32),
        "phase": Buffer(row, np.float32),
    }
    if blocks.terms:
        return buffers | {"expansions": Buffer((*row, blocks.terms), np.float32)}
    return buffers | {"offsets": Buffer((3, parts * part_pixels), np.float32)}
