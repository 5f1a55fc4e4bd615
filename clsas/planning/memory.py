"""The device memory of a candidate, and how many roots are formed together within it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from clsas.exact.tiles import STACK
from clsas.factorized.buffers import LEAST_BATCH
from clsas.factorized.estimates import StageChannels
from clsas.opencl.buffers import (
    GIVEN_BYTES,
    GUARD,
    VECTOR_ROOM,
    expansion_terms,
    padded_length,
    sample_bytes,
)
from clsas.opencl.device import Device
from clsas.planning.view import View
from clsas.signal.interpolation import Resampling

_CACHED_BYTES, _BATCH_BYTES = 16 << 20, 256 << 20  # of a batch, on CPUs and elsewhere
_MOST_TABLE_BYTES = 64 << 20
_ROOTS_PREPARED = 16  # together, so that arrays are few and large


@dataclass(frozen=True)
class Batches:
    """Roots that are formed together, and whose geometry is prepared together."""

    at_once: int
    prepared: int
    memory_bytes: int


def batches_within(
    view: View,
    sides: tuple[tuple[int, int], ...],
    tile: tuple[int, int],
    samples: Sequence[int],
    channels: Sequence[StageChannels],
    most_channels: Sequence[float],
    resampling: Resampling,
    *,
    upsampled: bool,
    half_precision: bool,
    device: Device,
    memory_bytes: int,
) -> Batches:
    lines = view.lines
    line_bytes = sample_bytes(half_precision) * lines.channels * padded_length(resampling)
    if upsampled:
        line_bytes += min(lines.samples.nbytes, GIVEN_BYTES)
    root_bytes, table_bytes = _root_bytes(
        view,
        sides,
        tile,
        samples,
        channels,
        most_channels,
        device.info.width,
        sample_bytes(half_precision),
    )
    roots = view.subimages(sides[0])
    room = memory_bytes - line_bytes
    batch_bytes = _CACHED_BYTES if device.info.kind == "cpu" else _BATCH_BYTES
    # Tables come in two sets.
    at_once = max(batch_bytes // root_bytes, LEAST_BATCH)
    at_once = int(min(room // (root_bytes + 2 * table_bytes), at_once))
    at_once = min(max(at_once, 1), roots)
    room = min(room - at_once * root_bytes, _MOST_TABLE_BYTES)
    of_batch = 2 * at_once * table_bytes
    prepared = at_once * min(max(int(room // of_batch), 1), -(-_ROOTS_PREPARED // at_once))
    needed = int(line_bytes + at_once * root_bytes + 2 * prepared * table_bytes)
    return Batches(at_once, prepared, needed)


def _root_bytes(view, sides, tile, samples, stage_channels, most_channels, width, of_sample):
    channels, work, tables = view.lines.channels, 0.0, 0.0
    for level, most in enumerate(most_channels):
        side = sides[level]
        subimages = _subimages(sides[0], side)
        work += of_sample * subimages * most * (samples[level] + 2 * GUARD)
        tables += subimages * (44 if level else 20) + (channels + 32) * (8 + (12 if level else 20))
        channels = stage_channels[level].everywhere
    normalise = view.beam is not None and view.beam.normalise
    tables += 40 * channels
    if view.surface.is_plane:
        terms = expansion_terms(view.beam)
        parts, slots = _subimages(sides[0], tile), math.prod(sides[0])
        references = 0 if tile == sides[-1] else 12
        work += parts * ((most + VECTOR_ROOM) * (references + 4 * terms) + 24)
    else:
        slots = view.most_slots(sides[-1], sides[0], width)
        parts = slots / (STACK * width)
        tables += 24 * parts + 12 * slots
    return work + 8 * (1 + normalise) * slots, tables + 12 * parts


def _subimages(root: tuple[int, int], side: tuple[int, int]) -> int:
    return math.prod(a // b for a, b in zip(root, side, strict=True))
