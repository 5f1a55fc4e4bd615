"""A factorized image at work: upload, sector after sector, stage after stage, then the leaves."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from clsas.engine.data import validate
from clsas.engine.data.lines import RangeLines, some_channels
from clsas.engine.data.validate import ArgumentError
from clsas.engine.device import kernels
from clsas.engine.device.buffers import (
    GUARD,
    MARGIN,
    Slot,
    filter_table,
    lines_buffer,
    padded_length,
    phase_polynomials,
    upsample,
    upsampled_lines,
)
from clsas.engine.device.device import Device, aligned
from clsas.engine.factorized.buffers import (
    CHUNK,
    DeviceLines,
    Level,
    row_pitch,
    stage_lines,
    stage_tables,
)
from clsas.engine.factorized.leaves import (
    Finish,
    LeafGroups,
    PlaneLeaves,
    SurfaceLeaves,
    leaf_groups,
)
from clsas.engine.factorized.plan import Factorization, Plan
from clsas.engine.factorized.track import MeanTrack
from clsas.engine.factorized.tree import (
    Geometry,
    Sector,
    geometry_of,
    references,
    sector_of,
    track_for,
)
from clsas.engine.factorized.virtual_channels import VirtualChannels, band_table
from clsas.engine.scene import Scene

_AHEAD_S = 0.1  # of enqueued work: hides the preparation of roots; an interruption waits for it
_PREPARED_FIRST = 4  # batches in the first sector, few, so that the device starts early
_MOST_KEPT_BYTES = 128 << 20  # kept of sectors, and of groups, for the next image
_SAMPLED_LINES = 64  # evenly spread lines whose power is measured
_LARGEST_HALF = 65504.0  # largest finite float16
_LEAST_HALF = 2.0**-13  # rms accepted in half precision: twice the smallest normal float16
_FILTERS_SUM = 8.0  # bounds the sum of absolute values of upsampling and aligning filters
_MOST_EXPONENT = 100  # of a gain: float32 can hold filters multiplied or divided by it
_GROUP = 64  # work-items that share a subimage where each has one lane
_GROUPS_PER_UNIT = 3  # work-groups per compute unit, at least, so that all end together


class FactorizedImager:
    """Imager that forms factorized images of any samples of a scene.

    What does not depend on samples is computed for the first image. It may be kept for the next
    ones, except for sectors, or groups of points off a plane, that need much memory.

    Parameters
    ----------
    scene : Scene
    plan : Plan
        A plan with a factorization, made for this geometry or for another one.
    device : Device
    track : MeanTrack, optional
        The mean track, of the shape that the factorization has, if planning has found it.
    keep : bool
        Whether sectors and groups are kept for the next image.
    """

    def __init__(
        self,
        scene: Scene,
        plan: Plan,
        device: Device,
        track: MeanTrack | None = None,
        *,
        keep: bool = True,
    ) -> None:
        self.scene, self.plan, self.device = scene, plan, device.for_stages()
        self._known_track = track
        self._most_kept_bytes = _MOST_KEPT_BYTES if keep else 0
        self._kept_sectors: list[Sector] | None = None
        self._kept_groups: LeafGroups | None = None

    def form(
        self,
        lines: RangeLines,
        largest: float,
        progress: Callable[[int, int], None] | None = None,
    ) -> NDArray[np.complex64]:
        """Return the pixels of the image of lines of the scene, as they are imaged.

        Parameters
        ----------
        lines : RangeLines
        largest : float
            Largest magnitude of a sample.
        progress : callable, optional
            Called as progress(pixels done, pixels).
        """
        device, factorization = self.device, self.plan.factorization
        pixels = aligned(np.empty, self.scene.grid.shape, np.complex64)

        # The device upsamples the lines while the host finds the geometry.
        uploaded = start_upsampling(
            lines, factorization, device, largest, half_precision=factorization.half_precision
        )
        geometry = self.geometry
        uploaded = in_enough_precision(uploaded, lines, geometry, device, largest)
        work = Slot(device)
        stages = StageKernels(uploaded, geometry, device, work)
        leaves = self._leaves(uploaded, work, pixels)

        # Some batches are under way at a time, so that the device works on one sector while the
        # host prepares the next. It fills one set of tables while the other is in use.
        at_once = factorization.roots_at_once
        batches = -(-len(geometry.roots) // at_once)
        ahead = math.ceil(_AHEAD_S * batches / max(self.plan.predicted_seconds, 1e-9))
        under_way: deque[Finish] = deque()
        slots = itertools.cycle([Slot(device), Slot(device)])
        done = 0
        for sector in self._sectors():
            tables = next(slots)
            tables.wait()
            stages.fill(tables, sector)
            leaves.fill(tables, sector)
            for first in range(0, len(sector.roots), at_once):
                batch = slice(first, min(first + at_once, len(sector.roots)))
                if sector.has_lines:
                    leaf_lines = stages.form(tables, sector, batch)
                    under_way.append(leaves.form(tables, sector, batch, leaf_lines))
                    work.busy = cl.enqueue_marker(device.queue)
                    device.queue.flush()
                else:
                    under_way.append(leaves.blank(sector, batch))
                if len(under_way) > max(ahead, 2):
                    done += under_way.popleft()()
                    if progress is not None:
                        progress(done, pixels.size)
            tables.busy = cl.enqueue_marker(device.queue)
        while under_way:
            done += under_way.popleft()()
            if progress is not None:
                progress(done, pixels.size)
        leaves.complete()
        return pixels

    @cached_property
    def track(self) -> MeanTrack | None:
        """The mean track, of the shape that the factorization has, None if there is none."""
        return self._known_track or track_for(self.scene, self.plan.factorization)

    @cached_property
    def geometry(self) -> Geometry:
        """Mean track, channels and subimages, found when they are first needed."""
        return geometry_of(self.scene, self.plan.factorization, self.track)

    def _leaves(
        self, uploaded: DeviceLines, work: Slot, pixels: NDArray[np.complex64]
    ) -> PlaneLeaves | SurfaceLeaves:
        """Return the leaves of an image: tiles on a plane, groups of points elsewhere."""
        geometry, device = self.geometry, self.device
        allowed_db = min(self.plan.predicted_error_db, self.plan.tolerance_db or 0.0)
        if geometry.surface.is_plane:
            return PlaneLeaves(uploaded, geometry, device, work, pixels, allowed_db)
        groups = self._kept_groups or leaf_groups(geometry, device.info.width)
        if groups.nbytes <= self._most_kept_bytes:
            self._kept_groups = groups
        return SurfaceLeaves(uploaded, geometry, device, work, pixels, allowed_db, groups)

    def _sectors(self) -> Iterator[Sector]:
        """Yield all roots in sectors; the first is small, so that the device can start early."""
        if self._kept_sectors is not None:
            yield from self._kept_sectors
            return
        factorization, roots = self.plan.factorization, len(self.geometry.roots)
        most = factorization.roots_prepared
        first, count = 0, min(_PREPARED_FIRST * factorization.roots_at_once, most)
        found: list[Sector] | None = []
        while first < roots:
            sector = sector_of(self.geometry, first, min(first + count, roots))
            yield sector
            first, count = first + count, min(2 * count, most)
            if found is not None:
                found.append(sector)
                if sum(each.nbytes for each in found) > self._most_kept_bytes:
                    found = None
        self._kept_sectors = found


def start_upsampling(
    lines: RangeLines,
    factorization: Factorization,
    device: Device,
    largest: float,
    *,
    half_precision: bool,
) -> DeviceLines:
    """Start upsampling all lines on a device.

    Parameters
    ----------
    lines : RangeLines
    factorization : Factorization
    device : Device
    largest : float
        Largest magnitude of a sample.
    half_precision : bool

    Raises
    ------
    ValueError
        If the upsampled lines do not fit into one buffer of the device.
    """
    resampling = factorization.resampling
    pitch = padded_length(resampling)
    needed = lines_buffer(lines.channels, pitch, half_precision).nbytes
    if needed > device.info.max_buffer_bytes:
        raise ArgumentError(
            "lines",
            f"take at most {device.info.max_buffer_bytes / 2**20:.0f} MiB when upsampled, which a "
            f"buffer of {device.info.label} can hold",
            f"{needed / 2**20:.0f} MiB for {lines.channels} lines of {lines.length} samples",
            "image a part of the lines, or backproject exactly",
        )
    if factorization.upsampler is None:
        align, final = factorization.align, factorization.final
        edges = factorization.aperture.lines_gain(align, final, resampling.ratio)
        samples = upsampled_lines(
            lines.samples, resampling, device.info.width, MARGIN, pitch, edges
        )
        return DeviceLines(device.share(samples), pitch, half_precision, 1.0)
    gain = 1.0
    if half_precision and largest > 0:
        # A power of 2 that keeps lines, and the sum of all, within half precision.
        most = _LARGEST_HALF / (_FILTERS_SUM * lines.channels * largest)
        exponent = math.floor(math.log2(most))
        gain = 2.0 ** min(max(exponent, -_MOST_EXPONENT), _MOST_EXPONENT)
    buffer = upsample(
        lines.samples,
        resampling,
        factorization.upsampler,
        pitch,
        device,
        half_precision=half_precision,
        gain=gain,
    )
    return DeviceLines(buffer, pitch, half_precision, gain)


def in_enough_precision(
    uploaded: DeviceLines, lines: RangeLines, geometry: Geometry, device: Device, largest: float
) -> DeviceLines:
    """Return the lines, upsampled again in single precision if half does not resolve them.

    Parameters
    ----------
    uploaded : DeviceLines
        The result of `start_upsampling`, for the same lines.
    lines, geometry, device, largest
        See `start_upsampling`.

    Warns
    -----
    ClsasWarning
        If the plan was made for half precision and single precision is used.
    """
    if not uploaded.half_precision:
        return uploaded
    rms = uploaded.gain * _imaged_rms(geometry, lines)
    if rms == 0 or _LEAST_HALF <= rms <= _LARGEST_HALF:
        return uploaded
    device.finish()  # kernels may still write to the buffer that is given up
    single = start_upsampling(lines, geometry.factorization, device, largest, half_precision=False)
    validate.warn(
        "the lines are kept in single precision, not in half as planned, and need up to twice the "
        "memory: echoes from the grid are too weak compared with the largest sample, "
        f"{largest:.3g}, or the gain that they need is out of range"
    )
    return single


def _imaged_rms(geometry: Geometry, lines: RangeLines) -> float:
    """Return the rms of samples at the ranges of pixels, over some of the lines."""
    some = some_channels(lines.channels, _SAMPLED_LINES)
    root_m = geometry.tree.centres_m(0, geometry.tree.roots)
    away_m = cdist(root_m, lines.phase_centres_m[some])
    radius_m = geometry.surface.radius_m(geometry.tree.sides[0])
    near_m, far_m = away_m.min(axis=0) - radius_m, away_m.max(axis=0) + radius_m
    total, count = 0.0, 0
    for i, near, far in zip(some, near_m, far_m, strict=True):
        limits = (np.array([near, far]) - lines.first_range_m[i]) / lines.range_step_m
        first, last = np.clip(limits, 0, lines.length).astype(np.int64)
        echoes = lines.samples[i, first : last + 1].astype(np.complex128)
        total += float(np.vdot(echoes, echoes).real)
        count += last + 1 - first
    return math.sqrt(total / max(count, 1))


class StageKernels:
    """The stages of an image on a device: from the raw lines to those of the leaves.

    Parameters
    ----------
    lines : DeviceLines
        The raw lines.
    geometry : Geometry
    device : Device
    work : Slot
        Buffers in which batches of roots are formed.
    """

    def __init__(self, lines: DeviceLines, geometry: Geometry, device: Device, work: Slot) -> None:
        self.lines, self.geometry, self.device, self.work = lines, geometry, device, work
        factorization, tree = geometry.factorization, geometry.tree
        align, aperture = factorization.align, factorization.aperture.filter
        self.levels = [Level.of(half, device.info.width) for half in factorization.half_lengths]
        # The first stage takes raw lines, and later ones those of virtual channels.
        options = {
            "WIDTH": device.info.width,
            "TAPS": align.taps,
            "APERTURE_TAPS": aperture.taps,
            "HALF": int(lines.half_precision),
            "CHUNK": CHUNK,
            "PHASE_TERMS": kernels.PRECISE_PHASE_TERMS,
        }
        ramp = int(geometry.ramps)
        if geometry.track.is_sheet:
            self._first = device.kernel("first_sheet_stage", RAMP=ramp, **options)
            self._later = device.kernel("later_sheet_stage", **options)
        else:
            self._first = device.kernel("stage", SHIFTS_GIVEN=1, RAMP=ramp, **options)
            self._later = device.kernel("stage", SHIFTS_GIVEN=0, RAMP=0, **options)
        self._filters = {
            "range_filter": filter_table(device, align.coefficients),
            "aperture_filter": filter_table(device, aperture.coefficients),
            "phase_polynomials": phase_polynomials(device, kernels.PRECISE_PHASE_TERMS),
        }
        self._parents = {
            level: device.upload(tree.parents(level).astype(np.int32))
            for level in range(1, len(tree.sides))
        }

    def fill(self, tables: Slot, sector: Sector) -> None:
        """Start copying the tables of a sector to the device; see `cl/stages.h`."""
        tree = self.geometry.tree
        for level, (virtual, need) in enumerate(zip(sector.virtual, sector.needs, strict=True)):
            values = {f"base{level}": virtual.base, f"between{level}": virtual.between}
            if virtual.bands is not None and virtual.bands.between is not None:
                values[f"rows{level}"] = virtual.bands.between
            if level == 0:
                # The host computes the shifts and phases of raw lines, in float64.
                first_of_parent = np.zeros_like(need.first)
                values |= references(self.geometry, sector)
            else:
                # The kernel finds those of later lines from the positions of virtual channels.
                parents = tree.parents(level)
                first_of_parent = sector.needs[level - 1].first[:, parents]
                parent_m = sector.relative_m[level - 1][:, parents]
                offsets_m = [parent_m, sector.relative_m[level] - parent_m]
                values[f"offsets{level}"] = np.concatenate(offsets_m, axis=-1)
                values[f"positions{level}"] = sector.positions_m(level - 1).swapaxes(1, 2)
            values[f"bands{level}"] = band_table(virtual.bands, need, first_of_parent)
            roots, channels = virtual.base.shape
            buffers = stage_tables(
                level,
                roots,
                tree.per_root(level),
                channels,
                ramps=self.geometry.ramps,
                bands=_band_count(virtual),
                rows=self.geometry.track.is_sheet,
            )
            for name, buffer in buffers.items():
                tables.fill(name, buffer.holding(values[name]))

    def form(self, tables: Slot, sector: Sector, batch: slice) -> cl.Buffer:
        """Start forming the lines of the leaves of some roots, and return their buffer.

        Parameters
        ----------
        tables : Slot
            Filled by `fill`.
        sector : Sector
        batch : slice
            The roots, among those of the sector.
        """
        geometry, tree, info = self.geometry, self.geometry.tree, self.device.info
        parent_lines = self.lines.samples
        for level, (layout, virtual) in enumerate(zip(self.levels, sector.virtual, strict=True)):
            per_root = tree.per_root(level)
            children = (batch.stop - batch.start) * per_root
            parents: dict[str, Any]
            if level == 0:  # raw lines, with the shifts and phases that the host has computed
                kernel = self._first
                names = ("order", "start", "nu", "cycles", *(["ramp"] if geometry.ramps else []))
                parents = {"parent_pitch": self.lines.pitch}
                parents |= {name: tables[name] for name in names}
            else:  # lines of virtual channels, which the kernel aligns by their positions
                kernel, before = self._later, self.levels[level - 1]
                parents = {
                    "parent_pitch": before.pitch,
                    "parents": self._parents[level],
                    "parents_per_root": tree.per_root(level - 1),
                    "lines_per_parent": sector.most_channels[level - 1],
                    "positions": tables[f"positions{level}"],
                    "offsets": tables[f"offsets{level}"],
                    "drift": geometry.drift,
                    "samples_per_m": geometry.samples_per_m,
                    "cycles_per_m": geometry.cycles_per_m,
                    "parent_centre": before.centre,
                }
            rows = {"row_position": tables[f"rows{level}"]} if geometry.track.is_sheet else {}

            # Most subimages fit from the start: a buffer that grows waits for all commands.
            stride = sector.most_channels[level]
            room = max(stride, geometry.factorization.most_channels[level])
            buffers = stage_lines(
                level, children, room, layout.pitch, half_precision=self.lines.half_precision
            )
            ((name, buffer),) = buffers.items()
            child_lines = self.work.zeros(name, buffer.nbytes)

            # With few subimages lines are divided into parts, so that all compute units have work.
            step = _GROUP if info.width == 1 else 8 * info.width
            wanted = _GROUPS_PER_UNIT * info.compute_units
            if geometry.track.is_dense and info.width > 1 and children < wanted:
                # Few subimages combine all channels of a dense aperture: they need every core.
                step = 2 * info.width
            parts = -(-wanted // children)
            part_length = step * -(-layout.length // (step * parts))

            items = _GROUP if info.width == 1 else 1
            self.device.run(
                kernel,
                (children * items, -(-layout.length // part_length)),
                bands=tables[f"bands{level}"],
                band_count=_band_count(virtual),
                first_child=batch.start * per_root,
                children_per_root=per_root,
                first_virtual=tables[f"base{level}"],
                tap_position=tables[f"between{level}"],
                **rows,
                channel_pitch=row_pitch(virtual.base.shape[1]),
                parent_lines=parent_lines,
                **parents,
                half_length=layout.half,
                **self._filters,
                child_lines=child_lines,
                lines_per_child=stride,
                child_pitch=layout.pitch,
                length=layout.length,
                part_length=part_length,
                guard=GUARD,
                wait_for=tables.filled,
                local=(items, 1),
            )
            parent_lines = child_lines
        return parent_lines


def _band_count(virtual: VirtualChannels) -> int:
    """Return the number of bands of a stage's channels."""
    return 1 if virtual.bands is None else virtual.bands.first.shape[1]
