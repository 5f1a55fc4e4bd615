"""Blocks: the amount of data of an exact image that is on a device at once."""

from __future__ import annotations

import math
from dataclasses import dataclass

from clsas.core.lines import RangeLines
from clsas.opencl.buffers import expansion_terms, round_up
from clsas.opencl.device import Device
from clsas.signal.interpolation import Resampling
from clsas.sonar.beam import BeamWindow

# Channels of a block. The number bounds float32 partial sums, and their lines stay in the cache of
# a CPU.
_CHANNELS_AT_ONCE = 512
_PART_BYTES = 64 << 20  # device memory for one set of parts, a job of some tenths of a second


@dataclass(frozen=True)
class Blocks:
    """Sizes of a block of channels and of a set of parts, which are on a device at once.

    Attributes
    ----------
    reach : int
        Samples by which a part may extend beyond the end of a line.
    margin : int
        Zeros on either side of a line.
    pitch : int
        Samples of a line including both margins.
    terms : int
        Coefficients per (tile, channel); 0 for groups.
    channels_at_once, parts_at_once : int
        Channels of a block, and tiles or groups of a set.
    """

    reach: int
    margin: int
    pitch: int
    terms: int
    channels_at_once: int
    parts_at_once: int


def blocks_of(
    device: Device,
    lines: RangeLines,
    resampling: Resampling,
    taps: int,
    *,
    radius_m: float,
    part_pixels: int,
    tiled: bool,
    beam: BeamWindow | None,
) -> Blocks:
    """Return the sizes of the blocks and sets of an image.

    Two blocks of lines take up to an eighth of the device's memory each, and two sets of references
    up to a sixteenth each.

    Raises
    ------
    ValueError
        If a single line is too long for a buffer.
    """
    reach = math.ceil(radius_m * resampling.samples_per_m(lines) * 1.1) + taps
    margin = 2 * reach + 2 * device.info.width
    pitch = round_up(resampling.length + 2 * margin, 16)
    if pitch % 256 == 0:  # lines at the same positions of cache sets would evict each other
        pitch += 16
    terms = expansion_terms(beam) if tiled else 0
    line_bytes = 8 * pitch
    part_bytes = _CHANNELS_AT_ONCE * (16 + 4 * terms) + 12 * part_pixels
    most = device.info.max_buffer_bytes
    room = min(most, device.info.memory_bytes // 8)
    if line_bytes > most:
        raise ValueError(
            f"lines of {lines.length} samples are too long: upsampled they take "
            f"{line_bytes / 2**10:.0f} KiB each, but a buffer of {device.info.label} has at most "
            f"{most / 2**10:.0f} KiB"
        )
    return Blocks(
        reach,
        margin,
        pitch,
        terms,
        channels_at_once=min(_CHANNELS_AT_ONCE, max(room // line_bytes, 1)),
        parts_at_once=max(min(_PART_BYTES, room // 2) // part_bytes, 1),
    )


def band_parts(device: Device, part_pixels: int, across: int, normalise: bool) -> int:
    """Return the number of parts in a band of the image, which is made of whole rows of tiles.

    The pixels of a band, and its sums of weights, are on the device together.
    """
    most = min(device.info.max_buffer_bytes, device.info.memory_bytes // 4)
    return max(most // (8 * (1 + normalise) * part_pixels) // across, 1) * across
