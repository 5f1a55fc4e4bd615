"""Names, shapes and types of the buffers of an exact image on a device.

The run allocates buffers from these lists, and the prediction of memory adds up their sizes. There
are two sets for lines and for parts: the host fills one while the device works on the other.
"""

from __future__ import annotations

import numpy as np

from clsas.core.lines import RangeLines
from clsas.exact.blocks import Blocks
from clsas.opencl.buffers import VECTOR_ROOM, Buffer, Buffers, channel_pitch
from clsas.sonar.beam import BeamWindow


def is_bistatic(lines: RangeLines) -> bool:
    """Return whether the paths to a point and back differ."""
    return lines.rx_velocity_m_s is not None or not np.array_equal(lines.tx_m, lines.rx_m)


def block_buffers(
    lines: RangeLines, channels: int, blocks: Blocks, beam: BeamWindow | None
) -> Buffers:
    """Return the buffers of a block of channels: upsampled lines and the antennas' geometry.

    Parameters
    ----------
    lines : RangeLines
        All lines. Whether they are bistatic or moving determines the rows of the geometry.
    channels : int
        Number of channels of the block.
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
    """Return the buffers of some parts in one job, except their pixels.

    Parameters
    ----------
    parts, part_pixels : int
        Number of tiles or groups of the job, and of pixels in each.
    channels : int
        Largest number of channels of a block that a part needs.
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
