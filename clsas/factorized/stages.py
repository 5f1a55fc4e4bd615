"""One factorized image at work on a device, stage by stage."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsas.aperture.dense_channels import band_table
from clsas.core import validate
from clsas.core.lines import RangeLines
from clsas.factorized.buffers import CHUNK, Level, row_pitch, stage_lines, stage_tables
from clsas.factorized.geometry import imaged_rms
from clsas.factorized.leaves import Finish
from clsas.factorized.plane_leaves import PlaneLeaves
from clsas.factorized.sectors import Roots, Sector, references
from clsas.factorized.surface_leaves import SurfaceLeaves
from clsas.opencl import phases
from clsas.opencl.buffers import (
    GUARD,
    MARGIN,
    Slot,
    filter_table,
    lines_buffer,
    padded_length,
    phase_polynomials,
    upsampled_lines,
)
from clsas.opencl.device import Device
from clsas.opencl.upsampling import upsample
from clsas.plans.plan import Plan

_GROUP = 64  # work-items that share a subimage where each has one lane
_AHEAD_S = 0.1  # of enqueued work: hides the preparation of roots; an interruption waits for it
_PREPARED_FIRST = 4  # batches in the first sector, few, so that the device starts early
_LARGEST_HALF, _LEAST_HALF = 65504.0, 2.0**-13  # below twice the latter, half precision coarsens
_FILTERS_SUM = 8.0  # bounds the sum of absolute values of upsampling and aligning filters
_MOST_EXPONENT = 100  # of a gain: float32 holds filters multiplied and divided by it
_GROUPS_PER_UNIT = 3  # work-groups per compute unit, at least, so that all end together


@dataclass(frozen=True, eq=False)
class _Tables:
    """Tables of a sector on the device.

    Attributes
    ----------
    slot : Slot
        Buffers, see `clsas.factorized.buffers`.
    pitches : list of int
        Channels of a row, stage by stage.
    strides : list of int
        Lines of a subimage, stage by stage.
    bands : list of int
        Bands of channels, stage by stage: see `clsas.aperture.virtual_channels.Bands`.
    """

    slot: Slot
    pitches: list[int]
    strides: list[int]
    bands: list[int]


class Run:
    """An image of some lines at work on a device: its kernels, tables and buffers."""

    def __init__(
        self,
        lines: RangeLines,
        plan: Plan,
        roots: Roots,
        device: Device,
        pixels: NDArray[np.complex64],
        largest: float,
    ) -> None:
        image = plan.factorization
        self.lines, self.plan, self.factorization, self.device = lines, plan, image, device
        self.width, self.pitch = device.info.width, padded_length(image.resampling)
        self.half_precision = image.half_precision
        self.gain = _gain(largest, lines.channels) if self.half_precision and largest > 0 else 1.0
        self.samples = self._upload_lines()  # early: a device upsamples them beside what follows
        self.roots, self.geometry = roots, roots.geometry
        self.division = self.geometry.division
        if self.half_precision and not _holds(self.gain * imaged_rms(self.geometry, lines)):
            device.finish()  # the buffer given up may still be written
            self.half_precision, self.gain = False, 1.0
            self.samples = self._upload_lines()
            validate.warn(
                "lines are held in single precision, not in half as planned, which takes up to "
                "twice the memory: what can be seen of the grid is too faint beside the "
                f"largest sample, {largest:.3g}, or that is too far from 1"
            )
        self.levels = [Level.of(half, self.width) for half in image.half_lengths]
        self.filters = {
            "range_filter": filter_table(device, image.align.coefficients),
            "aperture_filter": filter_table(device, image.aperture.filter.coefficients),
            "phase_polynomials": phase_polynomials(device, phases.PRECISE_TERMS),
        }
        options = {"WIDTH": self.width, "TAPS": image.align.taps}
        options |= {"APERTURE_TAPS": image.aperture.filter.taps, "HALF": int(self.half_precision)}
        options |= {"CHUNK": CHUNK, "PHASE_TERMS": phases.PRECISE_TERMS}
        ramp = int(self.geometry.ramps)
        if self.geometry.track.is_sheet:
            self.first_stage = device.kernel("first_sheet_stage", RAMP=ramp, **options)
            self.later_stage = device.kernel("later_sheet_stage", **options)
        else:
            self.first_stage = device.kernel("stage", SHIFTS_GIVEN=1, RAMP=ramp, **options)
            self.later_stage = device.kernel("stage", SHIFTS_GIVEN=0, RAMP=0, **options)
        kind = PlaneLeaves if self.geometry.surface.is_plane else SurfaceLeaves
        self.leaves = kind(
            lines, roots, plan, self.levels[-1], device, pixels, self.half_precision, self.gain
        )
        later = range(1, len(self.levels))
        self.parents = {
            level: device.upload(self.division.parents(level).astype(np.int32)) for level in later
        }
        # One set of tables is filled while the device works with the other.
        self.table_slots = itertools.cycle([Slot(device), Slot(device)])
        self.slot = Slot(device)

    def _upload_lines(self) -> cl.Buffer:
        """Return all lines on the device, upsampled."""
        device, image, count = self.device, self.factorization, self.lines.channels
        resampling = image.resampling
        needed = lines_buffer(count, self.pitch, self.half_precision).nbytes
        if needed > device.info.max_buffer_bytes:
            raise ValueError(
                f"{count} lines of {self.lines.length} samples need "
                f"{needed / 2**20:.0f} MiB when upsampled, more than a buffer of "
                f"{device.info.label}, {device.info.max_buffer_bytes / 2**20:.0f} MiB: image "
                f"a part of them, or backproject exactly"
            )
        if image.upsampler is not None:
            return upsample(
                self.lines.samples,
                resampling,
                image.upsampler,
                self.pitch,
                device,
                half_precision=self.half_precision,
                gain=self.gain,
            )
        gain = image.aperture.lines_gain(image.align, image.final, resampling.ratio)
        return device.share(
            upsampled_lines(self.lines.samples, resampling, self.width, MARGIN, self.pitch, gain)
        )

    def parts(self) -> Iterator[int]:
        """Form all pixels; yield how many each time that some are finished.

        The geometry of a sector is prepared while the device works on the one before.
        """
        under_way: deque[Finish] = deque()
        batches = -(-len(self.division.roots) // self.factorization.roots_at_once)
        most = max(math.ceil(_AHEAD_S * batches / max(self.plan.predicted_seconds, 1e-9)), 2)
        for sector, tables in self._sectors():
            for first in range(0, len(sector.roots), self.factorization.roots_at_once):
                under_way.append(self._start(sector, tables, first))
                if len(under_way) > most:
                    yield under_way.popleft()()
            tables.slot.busy = cl.enqueue_marker(self.device.queue)
        while under_way:
            yield under_way.popleft()()
        self.leaves.complete()

    def _sectors(self) -> Iterator[tuple[Sector, _Tables]]:
        """Prepare sectors of roots; the first is small, for the device to begin with."""
        first = _PREPARED_FIRST * self.factorization.roots_at_once
        for sector in self.roots.sectors(first, self.factorization.roots_prepared):
            yield sector, self._upload_tables(sector)

    def _start(self, sector: Sector, tables: _Tables, first: int) -> Finish:
        """Start forming the pixels of some roots of a sector."""
        batch = slice(first, min(first + self.factorization.roots_at_once, len(sector.roots)))
        if not all(tables.strides):
            return self.leaves.blank(sector, batch)
        for level in range(len(self.levels)):
            self._stage(tables, level, batch)
        lines = self.slot[f"lines{len(self.levels) - 1}"]
        finish = self.leaves.form(tables.slot, sector, batch, lines)
        self.slot.busy = cl.enqueue_marker(self.device.queue)
        return finish

    def _upload_tables(self, sector: Sector) -> _Tables:
        """Start copying the tables of a sector to the device."""
        slot, levels = next(self.table_slots), range(len(self.levels))
        slot.wait()
        strides = [sector.stride(level) for level in levels]
        for level in levels:
            roots, channels = sector.nodes[level].base.shape
            subimages = self.division.per_root(level)
            values = self._stage_values(sector, level)
            ramps = self.geometry.ramps
            for name, buffer in stage_tables(
                level,
                roots,
                subimages,
                channels,
                ramps=ramps,
                bands=values[f"bands{level}"].shape[2],
                rows=self.geometry.track.is_sheet,
            ).items():
                slot.fill(name, buffer.holding(values[name]))
        self.leaves.fill(slot, sector)
        pitches = [row_pitch(nodes.base.shape[1]) for nodes in sector.nodes]
        bands = [1 if each.bands is None else each.bands.first.shape[1] for each in sector.nodes]
        return _Tables(slot, pitches, strides, bands)

    def _stage_values(self, sector: Sector, level: int) -> dict[str, NDArray]:
        """Return what the tables of a stage hold, see `cl/stages.h`."""
        nodes, need = sector.nodes[level], sector.needs[level]
        values = {f"base{level}": nodes.base, f"between{level}": nodes.between}
        first_of_parent = np.zeros_like(need.first)
        if level:
            parents = self.division.parents(level)
            first_of_parent = sector.needs[level - 1].first[:, parents]
            parent_m = sector.relative_m[level - 1][:, parents]
            offsets_m = [parent_m, sector.relative_m[level] - parent_m]
            values[f"offsets{level}"] = np.concatenate(offsets_m, axis=-1)
            values[f"positions{level}"] = sector.positions_m(level - 1).swapaxes(1, 2)
        else:
            values |= references(self.geometry, sector)
        values[f"bands{level}"] = band_table(nodes.bands, need, first_of_parent)
        if nodes.bands is not None and nodes.bands.between is not None:
            values[f"rows{level}"] = nodes.bands.between
        return values

    def _stage(self, tables: _Tables, level: int, batch: slice) -> None:
        """Form the lines of a stage from those of the one before, or from the raw ones."""
        device, table = self.device, tables.slot
        shape, stride = self.levels[level], tables.strides[level]
        # Room for most subimages from the start: a buffer that grows waits for all commands.
        lines_each = max(stride, self.factorization.most_channels[level])
        per_root = self.division.per_root(level)
        children = (batch.stop - batch.start) * per_root
        ((name, buffer),) = stage_lines(
            level, children, lines_each, shape.pitch, half_precision=self.half_precision
        ).items()
        child_lines = self.slot.zeros(name, buffer.nbytes)
        items = _GROUP if self.width == 1 else 1
        # Few children are divided, so that there is work for all.
        step = _GROUP if self.width == 1 else 8 * self.width
        if self.geometry.track.is_dense and self.width > 1:
            # All channels of a dense aperture go into few children: they need every core.
            few = children < _GROUPS_PER_UNIT * device.info.compute_units
            step = 2 * self.width if few else step
        parts = -(-_GROUPS_PER_UNIT * device.info.compute_units // children)
        part_length = step * -(-shape.length // (step * parts))
        device.run(
            self.later_stage if level else self.first_stage,
            (children * items, -(-shape.length // part_length)),
            bands=table[f"bands{level}"],
            band_count=tables.bands[level],
            first_child=batch.start * per_root,
            children_per_root=per_root,
            first_virtual=table[f"base{level}"],
            tap_position=table[f"between{level}"],
            **({"row_position": table[f"rows{level}"]} if self.geometry.track.is_sheet else {}),
            channel_pitch=tables.pitches[level],
            **self._shifts(tables, level),
            half_length=shape.half,
            **self.filters,
            child_lines=child_lines,
            lines_per_child=stride,
            child_pitch=shape.pitch,
            length=shape.length,
            part_length=part_length,
            guard=GUARD,
            wait_for=table.filled,
            local=(items, 1),
        )

    def _shifts(self, tables: _Tables, level: int) -> dict[str, Any]:
        """Return the kernel's arguments about a stage's parents, and how their lines are shifted.

        Shifts of raw lines are found on the host in float64. Later ones follow from positions.
        """
        table, geometry = tables.slot, self.geometry
        if level == 0:
            names = ("order", "start", "nu", "cycles", *(["ramp"] if geometry.ramps else []))
            shifts = {name: table[name] for name in names}
            return {"parent_lines": self.samples, "parent_pitch": self.pitch, **shifts}
        before = self.levels[level - 1]
        return {
            "parent_lines": self.slot[f"lines{level - 1}"],
            "parent_pitch": before.pitch,
            "parents": self.parents[level],
            "parents_per_root": self.division.per_root(level - 1),
            "lines_per_parent": tables.strides[level - 1],
            "positions": table[f"positions{level}"],
            "offsets": table[f"offsets{level}"],
            "drift": geometry.drift,
            "samples_per_m": geometry.samples_per_m,
            "cycles_per_m": geometry.cycles_per_m,
            "parent_centre": before.centre,
        }


def _gain(largest: float, channels: int) -> float:
    """Return a power of 2 with which lines, and the sum of all, stay within half precision."""
    exponent = math.floor(math.log2(_LARGEST_HALF / (_FILTERS_SUM * channels * largest)))
    return 2.0 ** min(max(exponent, -_MOST_EXPONENT), _MOST_EXPONENT)


def _holds(rms: float) -> bool:
    """Return whether half precision resolves lines of an rms value; zeros it does."""
    return rms == 0 or _LEAST_HALF <= rms <= _LARGEST_HALF
