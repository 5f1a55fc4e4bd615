"""Costs: operations of exact and factorized images, their time on a device, and their memory."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from datetime import datetime
from typing import Any, get_args

import numpy as np

from clsas.engine.data import validate
from clsas.engine.data.validate import ArgumentError
from clsas.engine.device.buffers import (
    Buffer,
    Buffers,
    beam_buffers,
    lines_buffer,
    pixel_buffers,
    total_bytes,
    upsampling_buffers,
)
from clsas.engine.device.device import Device, DeviceInfo
from clsas.engine.exact.decide import decide
from clsas.engine.exact.layout import STACK, Groups, GroupsEstimate, Tiles, item_pixels
from clsas.engine.exact.run import Blocks, band_parts, block_buffers, blocks_of, part_buffers
from clsas.engine.factorized.buffers import (
    LEAST_BATCH,
    leaf_tables,
    stage_lines,
    stage_tables,
    tile_buffers,
)
from clsas.engine.factorized.plan import Amount, CostSource, Work
from clsas.engine.factorized.sampled import SampledRoots, Side
from clsas.engine.scene import Scene
from clsas.engine.signal.interpolation import COST

WORTHWHILE_CHANNELS = 30
"""Fewest channels per pixel with which factorized images were faster than exact ones at -40 dB.
Images had 1024 x 1024 pixels (`scripts/thesis/section_7_1.py`, docs/thesis-systems.md)."""

_LARGE = (64, 64)  # rows and columns of a subimage as large as any part of an exact image
_MOST_NS = 1e15  # arbitrary: eleven days for one unit; times of any image stay finite
_SHEET_REFERENCES = 2.0  # references per channel of a sheet, measured with 54 000 channels
# Size of a batch on CPUs: a last-level cache. Half: 2 % slower, twice: 3 % faster.
_CACHED_BYTES = 16 << 20
_BATCH_BYTES = 256 << 20  # of a batch elsewhere; not measured
_MOST_TABLE_BYTES = 64 << 20
_ROOTS_PREPARED = 16  # together, so that arrays are few and large; half or twice: the same


@dataclass(frozen=True)
class Costs:
    """Time of each kind of work, in nanoseconds per unit of the field of `Work` with that name.

    The defaults are fitted to times of kernels and host that `scripts/bench predictions` measured
    with PoCL on 2 AVX-512 cores. `defaults` returns those for a device.
    """

    call_ns: float = 1.35e7
    upsampled_sample_ns: float = 18.0
    filtered_sample_ns: float = 1.9
    reference_ns: float = 125.0
    batch_ns: float = 1.0e5
    subimage_ns: float = 300.0
    line_ns: float = 32.0
    sample_ns: float = 0.1
    sample_tap_ns: float = 0.02
    single_sample_ns: float = 1.15
    given_sample_ns: float = 0.05
    leaf_channel_ns: float = 11.0
    leaf_ns: float = 0.53
    leaf_point_ns: float = 1.2
    leaf_gathered_ns: float = 1.25
    group_ns: float = 243.0
    part_ns: float = 16.0
    pixel_ns: float = 0.66
    point_ns: float = 0.85
    beam_ns: float = 0.12

    def __post_init__(self) -> None:
        """Check every cost."""
        for field in fields(self):
            validate.number(field.name, getattr(self, field.name), "ns", least=0.0, most=_MOST_NS)

    def times(self, factors: Mapping[str, float]) -> Costs:
        """Return these costs, with those named multiplied by their factors."""
        return replace(self, **{name: each * getattr(self, name) for name, each in factors.items()})

    def seconds(self, work: Work) -> Any:
        """Return the time of work: sum of amounts times costs, an array if amounts are arrays."""
        total_ns: Any = 0.0
        for name, amount in vars(work).items():
            if isinstance(amount, np.ndarray) or amount:
                total_ns = total_ns + getattr(self, f"{name}_ns") * amount
        return 1e-9 * total_ns


_AVX2 = Costs(
    call_ns=9.2e6,
    upsampled_sample_ns=20.0,
    filtered_sample_ns=1.8,
    reference_ns=122.0,
    batch_ns=8.0e5,
    subimage_ns=1450.0,
    line_ns=24.0,
    sample_ns=0.05,
    sample_tap_ns=0.0235,
    single_sample_ns=0.2,
    given_sample_ns=0.01,
    leaf_channel_ns=5.0,
    leaf_ns=0.69,
    leaf_point_ns=1.53,
    leaf_gathered_ns=0.85,
    group_ns=234.0,
    part_ns=50.0,
    pixel_ns=0.57,
    point_ns=1.7,
    beam_ns=0.4,
)
"""Fitted to processor times of kernels and host for images of the benchmarks at several tolerances,
on 2 cores of Zen 4 with PoCL 3.0. Processor times depend little on other work on the machine."""


@dataclass(frozen=True)
class KnownCosts:
    """Costs of a device, with their origin.

    Attributes
    ----------
    costs : Costs
    source : str
        "given" by the caller; "scaled" from the defaults by a short measurement; or "default".
    measured : str
        Time of the measurement, UTC, in ISO 8601; "" without one.
    """

    costs: Costs
    source: CostSource
    measured: str = ""

    def __post_init__(self) -> None:
        """Check the source and the time."""
        validate.one_of("source", self.source, get_args(CostSource))
        if self.measured and datetime.fromisoformat(self.measured).tzinfo is None:
            raise ArgumentError("measured", "have a time zone", self.measured)


def defaults(device: Device | DeviceInfo) -> Costs:
    """Return the costs that are assumed for a device that was not measured.

    For a device of 8 lanes, they are those of 2 AVX2 cores with PoCL.
    """
    info = device.info if isinstance(device, Device) else device
    return _AVX2 if info.width == 8 else Costs()


# Operations


def upsampling(samples: Amount, *, filtered: bool) -> Work:
    """Return the work of upsampling lines to a number of samples, by filters or by FFT."""
    return Work(filtered_sample=samples) if filtered else Work(upsampled_sample=samples)


def combining(
    lines: Amount, samples: Amount, taps: int, *, given: bool, half_precision: bool = True
) -> Work:
    """Return the work of aligning and combining lines of `samples` samples in a stage.

    `taps` is the sum of the taps of both filters. `given` is true for the first stage, which
    combines the given lines.
    """
    aligned = lines * samples
    return Work(
        line=lines,
        sample=aligned,
        sample_tap=aligned * taps,
        single_sample=aligned * (not half_precision),
        given_sample=aligned * given,
    )


def adding_in_rows(lines: Amount, samples: Amount, taps: Amount) -> Work:
    """Return the work of adding to lines of a sheet, which many bands read and write in turn."""
    return Work(given_sample=2 * lines * samples * taps)


def backprojecting_leaves(
    lines: Amount,
    pixels: Amount,
    taps: int,
    *,
    tiled: bool,
    weighted: bool,
    gathered: bool = False,
) -> Work:
    """Return the work of backprojecting `lines` lines to leaves of `pixels` pixels each.

    `gathered` is true if samples are read from memory one by one, instead of looked up in
    registers.
    """
    pairs = lines * pixels
    weighted_pairs = pairs * weighted
    if tiled:
        return Work(leaf_channel=lines, leaf=pairs * COST[taps], beam=weighted_pairs)
    of_taps = pairs * COST[taps]
    return Work(
        leaf_channel=lines,
        leaf_point=of_taps,
        leaf_gathered=of_taps * gathered,
        beam=weighted_pairs,
    )


def backprojecting(
    parts: int, part_pixels: int, channels: float, taps: int, *, tiled: bool, weighted: bool
) -> Work:
    """Return the work of an exact image of `parts` parts, from `channels` channels each."""
    pairs = parts * part_pixels * channels
    of_taps, weighted_pairs = pairs * COST[taps], pairs * weighted
    if tiled:
        return Work(part=parts * channels, pixel=of_taps, beam=weighted_pairs)
    return Work(
        part=parts * channels, point=of_taps, beam=weighted_pairs, group=parts * part_pixels
    )


def references(roots: SampledRoots) -> float:
    """Return the number of references of a root: one per channel, or more on a sheet.

    The host sorts the channels of a sheet by rows.
    """
    channels = roots.sampled.scene.lines.channels
    return channels * (_SHEET_REFERENCES if roots.sampled.track.is_sheet else 1.0)


# Exact images


@dataclass(frozen=True)
class ExactPrediction:
    """Prediction of an exact image, as `clsas.backproject` forms it.

    Attributes
    ----------
    accuracy_db : float
        Relative rms error.
    tiled, weighted : bool
        True if pixels lie in tiles of a plane, not in groups; true if a beam weights them.
    parts, part_pixels : int
        Number of tiles or groups, and of pixels in each.
    channels, visible_channels : int, float
        Number of channels, and mean number of those whose beam touches a part.
    taps, samples : int
        Taps of the interpolator, and samples of an upsampled line.
    memory_bytes : int
        Largest amount of device memory needed.
    """

    accuracy_db: float
    tiled: bool
    weighted: bool
    parts: int
    part_pixels: int
    channels: int
    visible_channels: float
    taps: int
    samples: int
    memory_bytes: int

    @property
    def work(self) -> Work:
        """Work of forming the image."""
        lines = upsampling(self.channels * self.samples, filtered=False)
        pixels = backprojecting(
            self.parts,
            self.part_pixels,
            self.visible_channels,
            self.taps,
            tiled=self.tiled,
            weighted=self.weighted,
        )
        return Work(call=1.0) + lines + pixels


def predict_exact(
    scene: Scene, accuracy_db: float, device: Device, roots: SampledRoots | None = None
) -> ExactPrediction:
    """Return the prediction of an exact image, by the same decision that forms it.

    With `roots`, the sample points of the scene, the part that a beam covers is known.
    """
    lines, beam = scene.lines, scene.beam
    decision = decide(scene, device, accuracy_db, estimate=True)
    layout, interpolator, resampling = decision.layout, decision.interpolator, decision.resampling
    tiled = isinstance(layout, Tiles)
    largest = decision
    if not tiled and scene.grid.points_m is not None:
        # Points may lie far apart: samples are then looked up more slowly, in longer lines.
        others = [
            decide(scene, device, accuracy_db, estimate=True, windows=each) for each in (STACK, 0)
        ]
        largest = max((decision, *others), key=lambda each: each.resampling.length)
    share = most = 1.0
    if beam is not None and roots is not None:
        share, most = roots.visible_share(roots.small), roots.visible_share(_LARGE, most=True)
    blocks = blocks_of(
        device,
        lines,
        largest.resampling,
        largest.interpolator.taps,
        radius_m=layout.radius_m,
        part_pixels=layout.part_pixels,
        tiled=tiled,
        beam=beam,
    )
    return ExactPrediction(
        accuracy_db=accuracy_db,
        tiled=tiled,
        weighted=beam is not None,
        parts=layout.parts,
        part_pixels=layout.part_pixels,
        channels=lines.channels,
        visible_channels=share * lines.channels,
        taps=interpolator.taps,
        samples=resampling.length,
        memory_bytes=_memory_bytes(scene, device, blocks, layout, most),
    )


def _memory_bytes(
    scene: Scene,
    device: Device,
    blocks: Blocks,
    layout: Tiles | Groups | GroupsEstimate,
    most: float,
) -> int:
    """Return the device memory that `clsas.engine.exact.run` needs.

    There are two sets of the buffers of parts, blocks and bands if there are two jobs. `most` is
    the largest fraction of the channels whose beam touches a part.
    """
    lines, beam = scene.lines, scene.beam
    parts, part_pixels = layout.parts, layout.part_pixels
    normalise = beam is not None and beam.normalise
    of_band = min(band_parts(device, part_pixels, layout.across, normalise), parts)
    of_job = min(blocks.parts_at_once, of_band)
    bands, jobs_of_set = -(-parts // of_band), -(-of_band // of_job)
    # Channels of the first set of buffers, and the remaining channels of the second set.
    first = min(blocks.channels_at_once, lines.channels)
    rest = lines.channels - first if bands == 1 else first
    sets = [n for n in (first, min(first, rest)) if n]
    visible = [min(n, math.ceil(most * lines.channels)) for n in sets]
    if jobs_of_set > 1:
        visible = [visible[0]] * 2
    bands_at_once = min(bands, 2) * [pixel_buffers(of_band * part_pixels, beam)]
    lists = [
        beam_buffers(beam),
        *bands_at_once,
        *(block_buffers(lines, n, blocks, beam) for n in sets),
        *(part_buffers(of_job, part_pixels, n, blocks) for n in visible),
    ]
    return sum(total_bytes(buffers) for buffers in lists)


def worthwhile(roots: SampledRoots | None, exact: ExactPrediction) -> str:
    """Return how many channels receive from a pixel, and from how many a factorization pays.

    The sentence is "" for grids off a plane, and for several passes and other dense apertures: the
    rule was not measured for them.
    """
    if roots is None:
        return ""
    if not roots.sampled.scene.surface.is_plane or roots.sampled.track.is_dense:
        return ""
    return (
        f"About {exact.visible_channels:.0f} channels receive from each pixel; factorization "
        f"usually pays from about {WORTHWHILE_CHANNELS} on, in images of 1000 x 1000 pixels or more"
    )


# Memory of factorized images


@dataclass(frozen=True, eq=False)
class BufferSizes:
    """Predicted sizes of a candidate's buffers.

    Attributes
    ----------
    roots : SampledRoots
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
        Bands of channels, stage by stage: see `clsas.engine.factorized.virtual_channels.Bands`.
    line_pitch : int
        Samples of an upsampled line including the zeros around it.
    filtered : bool
        True if the device upsamples the lines by filters.
    half_precision : bool
        True if stages store lines in half precision.
    """

    roots: SampledRoots
    width: int
    sides: tuple[Side, ...]
    tile: Side
    pitches: tuple[int, ...]
    root_channels: tuple[int, ...]
    most_channels: tuple[int, ...]
    bands: tuple[int, ...]
    line_pitch: int
    filtered: bool
    half_precision: bool

    def constant(self) -> Buffers:
        """Return the buffers that do not depend on the number of roots."""
        scene = self.roots.sampled.scene
        lines = scene.lines
        buffers = {"lines": lines_buffer(lines.channels, self.line_pitch, self.half_precision)}
        if self.filtered:
            buffers = upsampling_buffers(
                lines.channels, lines.length, self.line_pitch, self.half_precision
            )
        return buffers | beam_buffers(scene.beam)

    def tables(self, roots: int) -> Buffers:
        """Return the tables of `roots` roots."""
        sampled, scene = self.roots.sampled, self.roots.sampled.scene
        channels, tables = scene.lines.channels, Buffers()
        for level, side in enumerate(self.sides):
            subimages = self._divided(side)
            tables |= stage_tables(
                level,
                roots,
                subimages,
                channels,
                ramps=True,
                bands=self.bands[level],
                rows=sampled.track.is_sheet,
            )
            channels = self.root_channels[level]
        parts, pixels = self._parts()
        points = None if scene.surface.is_plane else roots * pixels
        corrected = self.most_channels[-1] if scene.water.corrections is not None else 0
        counts = roots * channels, roots * parts, points
        return tables | leaf_tables(*counts, scene.beam, corrected)

    def work(self, roots: int) -> Buffers:
        """Return the buffers in which `roots` roots are formed together."""
        buffers, scene = Buffers(), self.roots.sampled.scene
        for level, side in enumerate(self.sides):
            subimages, pitch = roots * self._divided(side), self.pitches[level]
            most, half = self.most_channels[level], self.half_precision
            buffers |= stage_lines(level, subimages, most, pitch, half_precision=half)
        parts, pixels = self._parts()
        if scene.surface.is_plane:
            aligned = self.tile == self.sides[-1]
            buffers |= tile_buffers(roots * parts, most, scene.beam, aligned=aligned)
            buffers["tile_centres"] = Buffer((roots * parts, 6), np.float32)
        return buffers | pixel_buffers(roots * pixels, scene.beam)

    def _divided(self, side: Side) -> int:
        """Return the number of subimages of a size in a root."""
        return math.prod(a // b for a, b in zip(self.sides[0], side, strict=True))

    def _parts(self) -> tuple[int, int]:
        """Return the largest numbers of tiles or groups of a root, and of its pixels."""
        sampled = self.roots.sampled
        if sampled.scene.surface.is_plane:
            return self._divided(self.tile), math.prod(self.sides[0])
        pixels = sampled.most_padded_pixels(self.sides[-1], self.sides[0], self.width)
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
