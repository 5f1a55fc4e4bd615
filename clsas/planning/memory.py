"""Device memory of a candidate, and the number of roots that are formed together within it.

Predicted sizes go into the same lists of buffers that a run allocates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from clsas.exact.tiles import item_pixels
from clsas.factorized.buffers import (
    LEAST_BATCH,
    leaf_tables,
    stage_lines,
    stage_tables,
    tile_buffers,
)
from clsas.opencl.buffers import (
    Buffer,
    Buffers,
    beam_buffers,
    lines_buffer,
    pixel_buffers,
    total_bytes,
)
from clsas.opencl.device import Device
from clsas.opencl.upsampling import upsampling_buffers
from clsas.planning.visibility_model import VisibilityModel

# Size of a batch on CPUs: a last-level cache. Half: 2 % slower, twice: 3 % faster.
_CACHED_BYTES = 16 << 20
_BATCH_BYTES = 256 << 20  # of a batch elsewhere; not measured
_MOST_TABLE_BYTES = 64 << 20
_ROOTS_PREPARED = 16  # together, so that arrays are few and large; half or twice: the same


@dataclass(frozen=True, eq=False)
class BufferSizes:
    """Predicted sizes of a candidate's buffers.

    Attributes
    ----------
    model : VisibilityModel
    width : int
        Lanes of the device.
    sides, tile
        As those of `Factorization`.
    pitches : tuple of int
        Samples of a line including the zeros around it, stage by stage.
    root_channels : tuple of int
        Largest number of virtual channels of a root along the whole aperture, stage by stage.
    most_channels : tuple of int
        Largest number of virtual channels of a subimage, stage by stage.
    bands : tuple of int
        Bands of channels, stage by stage: see `clsas.aperture.virtual_channels.Bands`.
    line_pitch : int
        Samples of an upsampled line including the zeros around it.
    corrected : bool
        True if ranges are corrected along exact rays.
    filtered : bool
        True if the device upsamples the lines by filters.
    half_precision : bool
        True if stages store lines in half precision.
    """

    model: VisibilityModel
    width: int
    sides: tuple[tuple[int, int], ...]
    tile: tuple[int, int]
    pitches: tuple[int, ...]
    root_channels: tuple[int, ...]
    most_channels: tuple[int, ...]
    bands: tuple[int, ...]
    line_pitch: int
    corrected: bool
    filtered: bool
    half_precision: bool

    def constant(self) -> Buffers:
        """Return the buffers that do not depend on the number of roots."""
        lines = self.model.lines
        buffers = {"lines": lines_buffer(lines.channels, self.line_pitch, self.half_precision)}
        if self.filtered:
            buffers = upsampling_buffers(
                lines.channels, lines.length, self.line_pitch, self.half_precision
            )
        return buffers | beam_buffers(self.model.beam)

    def tables(self, roots: int) -> Buffers:
        """Return the tables of `roots` roots."""
        channels, tables = self.model.lines.channels, Buffers()
        for level, side in enumerate(self.sides):
            subimages = self._divided(side)
            tables |= stage_tables(
                level,
                roots,
                subimages,
                channels,
                ramps=True,
                bands=self.bands[level],
                rows=self.model.track.is_sheet,
            )
            channels = self.root_channels[level]
        parts, pixels = self._parts()
        points = None if self.model.surface.is_plane else roots * pixels
        corrected = self.most_channels[-1] if self.corrected else 0
        counts = roots * channels, roots * parts, points
        return tables | leaf_tables(*counts, self.model.beam, corrected)

    def work(self, roots: int) -> Buffers:
        """Return the buffers in which `roots` roots are formed together."""
        buffers, beam = Buffers(), self.model.beam
        for level, side in enumerate(self.sides):
            subimages, pitch = roots * self._divided(side), self.pitches[level]
            most, half = self.most_channels[level], self.half_precision
            buffers |= stage_lines(level, subimages, most, pitch, half_precision=half)
        parts, pixels = self._parts()
        if self.model.surface.is_plane:
            aligned = self.tile == self.sides[-1]
            buffers |= tile_buffers(roots * parts, most, beam, aligned=aligned)
            buffers["tile_centres"] = Buffer((roots * parts, 6), np.float32)
        return buffers | pixel_buffers(roots * pixels, beam)

    def _divided(self, side: tuple[int, int]) -> int:
        """Return the number of subimages of a size in a root."""
        return math.prod(a // b for a, b in zip(self.sides[0], side, strict=True))

    def _parts(self) -> tuple[int, int]:
        """Return the largest numbers of tiles or groups of a root, and of its pixels."""
        if self.model.surface.is_plane:
            return self._divided(self.tile), math.prod(self.sides[0])
        pixels = self.model.subimages.most_padded_pixels(self.sides[-1], self.sides[0], self.width)
        return pixels // item_pixels(self.width), pixels


@dataclass(frozen=True)
class Batches:
    """Numbers of roots that are processed together.

    Attributes
    ----------
    at_once, prepared : int
        Roots that are formed together, and roots whose geometry is prepared together.
    memory_bytes : int
        Device memory that the image needs.
    """

    at_once: int
    prepared: int
    memory_bytes: int


def batches_within(sizes: BufferSizes, roots: int, device: Device, memory_bytes: int) -> Batches:
    """Return batches that fill the smaller of cache and memory, with at least one root each."""
    constant = total_bytes(sizes.constant())
    of_root, of_tables = total_bytes(sizes.work(1)), total_bytes(sizes.tables(1))
    room = memory_bytes - constant
    batch_bytes = _CACHED_BYTES if device.info.kind == "cpu" else _BATCH_BYTES
    at_once = max(batch_bytes // of_root, LEAST_BATCH)
    # One set of tables is filled while the other is in use.
    at_once = min(room // (of_root + 2 * of_tables), at_once)
    at_once = min(max(at_once, 1), roots)
    room = min(room - at_once * of_root, _MOST_TABLE_BYTES)
    most = max(room // (2 * at_once * of_tables), 1)
    prepared = at_once * min(most, -(-_ROOTS_PREPARED // at_once))
    tables = 2 * total_bytes(sizes.tables(min(prepared, roots)))
    needed = constant + total_bytes(sizes.work(at_once)) + tables
    return Batches(at_once, prepared, needed)
