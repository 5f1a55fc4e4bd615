"""Blocks: how much of an exact image's data is on a device at once."""

from __future__ import annotations

import math
from dataclasses import dataclass

from clsas.core.lines import RangeLines
from clsas.opencl.buffers import expansion_terms, round_up
from clsas.opencl.device import Device
from clsas.signal.interpolation import Resampling
from clsas.sonar.beam import BeamWindow

_CHANNELS_AT_ONCE = 512  # bounds a float32 partial sum; their lines stay in a CPU's cache
_PART_BYTES = 64 << 20  # device memory for one set of parts: a job of some tenths of a second


@dataclass(frozen=True)
class Blocks:
    """The data on a device at once: lines of a block of channels, references of a set of parts.

    Attributes
    ----------
    reach : int
        Samples by which a part may extend beyond a line's end.
    margin : int
        Zeros on either side of a line.
    pitch : int
        Samples of a line with both margins.
    terms : int
        Coefficients per (tile, channel); none for groups.
    channels_at_once, parts_at_once : int
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
    """Return how much of an image's data is on a device at once.

    Two blocks of lines take up to an eighth of the device's memory each, two sets of references a
    sixteenth each.

    Raises
    ------
    ValueError
        If a single line is too long for a buffer.
    """
    reach = math.ceil(radius_m * resampling.samples_per_m(lines) * 1.1) + taps
    margin = 2 * reach + 2 * device.info.width
    pitch = round_up(resampling.length + 2 * margin, 16)
    if pitch % 256 == 0:  # lines at equal positions in cache sets would evict each other
        pitch += 16
    terms = expansion_terms(beam) if tiled else 0
    line_bytes = 8 * pitch
    part_bytes = _CHANNELS_AT_ONCE * (16 + 4 * terms) + 12 * part_pixels
    most = device.info.max_buffer_bytes
    room = min(most, device.info.memory_bytes // 8)
    if line_bytes > most:
        raise ValueError(
            f"lines of {lines.length} samples need {line_bytes / 2**10:.0f} KiB each when "
            f"upsampled, more than a buffer of {device.info.label}, {most / 2**10:.0f} KiB"
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
    """Return how many parts a band of the image holds, whole rows of tiles.

    A band's pixels, and its sums of weights, are on the device together.
    """
    most = min(device.info.max_buffer_bytes, device.info.memory_bytes // 4)
    return max(most // (8 * (1 + normalise) * part_pixels) // across, 1) * across
