"""The stages of a factorized image on a device: from lines to those of the leaves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsas.aperture.dense_channels import band_table
from clsas.aperture.virtual_channels import VirtualChannels
from clsas.factorized.buffers import CHUNK, Level, row_pitch, stage_lines, stage_tables
from clsas.factorized.device_lines import DeviceLines
from clsas.factorized.geometry import Geometry
from clsas.factorized.sectors import Sector, references
from clsas.opencl import phases
from clsas.opencl.buffers import GUARD, Slot, filter_table, phase_polynomials
from clsas.opencl.device import Device
from clsas.opencl.kernels import Kernel

_GROUP = 64  # work-items that share a subimage where each has one lane
_GROUPS_PER_UNIT = 3  # work-groups per compute unit, at least, so that all end together


@dataclass(frozen=True)
class StageShape:
    """Sizes of a stage's tables and lines, for one sector.

    Attributes
    ----------
    pitch : int
        Entries in a row of the tables, one for each channel and some more.
    stride : int
        Lines of a subimage.
    bands : int
        Bands of channels; see `clsas.aperture.virtual_channels.Bands`.
    """

    pitch: int
    stride: int
    bands: int


@dataclass(frozen=True, eq=False)
class SectorTables:
    """Tables of a sector on the device.

    Attributes
    ----------
    slot : Slot
        The buffers, whose names are those of `clsas.factorized.buffers`.
    shapes : tuple of StageShape
        Sizes, stage by stage.
    """

    slot: Slot
    shapes: tuple[StageShape, ...]

    @property
    def has_lines(self) -> bool:
        """True if each stage has a subimage with a virtual channel."""
        return all(shape.stride for shape in self.shapes)


@dataclass(frozen=True, eq=False)
class _Kernels:
    """The stage kernel in both variants, and the tables that it takes for every sector.

    Attributes
    ----------
    first, later : Kernel
        For the stage that takes the raw lines, and for those that take virtual channels.
    filters : dict of str to Buffer
        Coefficients of filters and polynomials, by the names of the kernel's parameters.
    parents : list of Buffer or None
        Parent of each subimage of a root, stage by stage; the first stage has none.
    """

    first: Kernel
    later: Kernel
    filters: dict[str, cl.Buffer]
    parents: list[cl.Buffer | None]

    @classmethod
    def built(cls, geometry: Geometry, device: Device, *, half_precision: bool) -> _Kernels:
        """Build the kernels, and upload their tables."""
        align = geometry.factorization.align
        aperture = geometry.factorization.aperture.filter
        filters = {
            "range_filter": filter_table(device, align.coefficients),
            "aperture_filter": filter_table(device, aperture.coefficients),
            "phase_polynomials": phase_polynomials(device, phases.PRECISE_TERMS),
        }
        options = {
            "WIDTH": device.info.width,
            "TAPS": align.taps,
            "APERTURE_TAPS": aperture.taps,
            "HALF": int(half_precision),
            "CHUNK": CHUNK,
            "PHASE_TERMS": phases.PRECISE_TERMS,
        }
        ramp = int(geometry.ramps)
        division = geometry.division
        if geometry.track.is_sheet:
            first = device.kernel("first_sheet_stage", RAMP=ramp, **options)
            later = device.kernel("later_sheet_stage", **options)
        else:
            first = device.kernel("stage", SHIFTS_GIVEN=1, RAMP=ramp, **options)
            later = device.kernel("stage", SHIFTS_GIVEN=0, RAMP=0, **options)
        return cls(
            first=first,
            later=later,
            filters=filters,
            parents=[
                device.upload(division.parents(level).astype(np.int32)) if level else None
                for level in range(len(division.sides))
            ],
        )

    def of(self, level: int) -> Kernel:
        """Return the kernel of a stage."""
        return self.later if level else self.first


class Stages:
    """The stages of an image on a device.

    Parameters
    ----------
    lines : DeviceLines
        The raw lines.
    geometry : Geometry
    device : Device
    """

    def __init__(self, lines: DeviceLines, geometry: Geometry, device: Device) -> None:
        self.lines, self.geometry, self.device = lines, geometry, device
        self.division, self.width = geometry.division, device.info.width
        halves = geometry.factorization.half_lengths
        self.levels = [Level.of(half, self.width) for half in halves]
        self._kernels = _Kernels.built(geometry, device, half_precision=lines.half_precision)
        self._slot = Slot(device)

    def fill(self, slot: Slot, sector: Sector) -> SectorTables:
        """Start copying the tables of a sector to the device."""
        for level, virtual in enumerate(sector.virtual):
            values = _table_values(self.geometry, sector, level)
            roots, channels = virtual.base.shape
            tables = stage_tables(
                level,
                roots,
                self.division.per_root(level),
                channels,
                ramps=self.geometry.ramps,
                bands=_bands(virtual),
                rows=self.geometry.track.is_sheet,
            )
            for name, buffer in tables.items():
                slot.fill(name, buffer.holding(values[name]))
        shapes = (
            StageShape(row_pitch(virtual.base.shape[1]), sector.stride(level), _bands(virtual))
            for level, virtual in enumerate(sector.virtual)
        )
        return SectorTables(slot, tuple(shapes))

    def form(self, tables: SectorTables, batch: slice) -> cl.Buffer:
        """Start forming the lines of the leaves of some roots, and return their buffer.

        The buffer is in use until the event that is passed to `busy_until`.
        """
        for level in range(len(self.levels)):
            self._form(level, tables, batch)
        return self._slot[f"lines{len(self.levels) - 1}"]

    def busy_until(self, event: cl.Event) -> None:
        """Set the event after which lines may be overwritten."""
        self._slot.busy = event

    def _form(self, level: int, tables: SectorTables, batch: slice) -> None:
        """Form the lines of a stage from those of the one before, or from the raw ones."""
        lines, shape, slot = self.levels[level], tables.shapes[level], tables.slot
        per_root = self.division.per_root(level)
        children = (batch.stop - batch.start) * per_root
        child_lines = self._child_lines(level, children, shape.stride)
        part_length = self._part_length(lines.length, children)
        items = _GROUP if self.width == 1 else 1
        rows = {"row_position": slot[f"rows{level}"]} if self.geometry.track.is_sheet else {}
        self.device.run(
            self._kernels.of(level),
            (children * items, -(-lines.length // part_length)),
            bands=slot[f"bands{level}"],
            band_count=shape.bands,
            first_child=batch.start * per_root,
            children_per_root=per_root,
            first_virtual=slot[f"base{level}"],
            tap_position=slot[f"between{level}"],
            **rows,
            channel_pitch=shape.pitch,
            **(self._later_parents(tables, level) if level else self._raw_parents(tables)),
            half_length=lines.half,
            **self._kernels.filters,
            child_lines=child_lines,
            lines_per_child=shape.stride,
            child_pitch=lines.pitch,
            length=lines.length,
            part_length=part_length,
            guard=GUARD,
            wait_for=slot.filled,
            local=(items, 1),
        )

    def _child_lines(self, level: int, children: int, stride: int) -> cl.Buffer:
        """Return a buffer for the lines that a stage forms of some subimages."""
        # Most subimages fit from the start: a buffer that grows waits for all commands.
        lines_each = max(stride, self.geometry.factorization.most_channels[level])
        pitch, half = self.levels[level].pitch, self.lines.half_precision
        ((name, buffer),) = stage_lines(
            level, children, lines_each, pitch, half_precision=half
        ).items()
        return self._slot.zeros(name, buffer.nbytes)

    def _part_length(self, length: int, children: int) -> int:
        """Return the samples of a line that a work-group forms.

        With few subimages lines are divided into parts, so that all compute units have work.
        """
        step = _GROUP if self.width == 1 else 8 * self.width
        wanted = _GROUPS_PER_UNIT * self.device.info.compute_units
        if self.geometry.track.is_dense and self.width > 1 and children < wanted:
            # Few subimages combine all channels of a dense aperture: they need every core.
            step = 2 * self.width
        parts = -(-wanted // children)
        return step * -(-length // (step * parts))

    def _raw_parents(self, tables: SectorTables) -> dict[str, Any]:
        """Return the kernel's arguments about the raw lines, and how to align them.

        The host has computed their shifts and phases in float64.
        """
        names = ("order", "start", "nu", "cycles", *(["ramp"] if self.geometry.ramps else []))
        return {
            "parent_lines": self.lines.samples,
            "parent_pitch": self.lines.pitch,
            **{name: tables.slot[name] for name in names},
        }

    def _later_parents(self, tables: SectorTables, level: int) -> dict[str, Any]:
        """Return the kernel's arguments about the lines of the stage before.

        The kernel finds their shifts and phases from the positions of virtual channels.
        """
        geometry, before = self.geometry, self.levels[level - 1]
        return {
            "parent_lines": self._slot[f"lines{level - 1}"],
            "parent_pitch": before.pitch,
            "parents": self._kernels.parents[level],
            "parents_per_root": self.division.per_root(level - 1),
            "lines_per_parent": tables.shapes[level - 1].stride,
            "positions": tables.slot[f"positions{level}"],
            "offsets": tables.slot[f"offsets{level}"],
            "drift": geometry.drift,
            "samples_per_m": geometry.samples_per_m,
            "cycles_per_m": geometry.cycles_per_m,
            "parent_centre": before.centre,
        }


def _bands(virtual: VirtualChannels) -> int:
    """Return the number of bands of a stage's channels."""
    return 1 if virtual.bands is None else virtual.bands.first.shape[1]


def _table_values(geometry: Geometry, sector: Sector, level: int) -> dict[str, NDArray]:
    """Return the values of a stage's tables, by name; see `cl/stages.h`."""
    virtual, need = sector.virtual[level], sector.needs[level]
    values = {f"base{level}": virtual.base, f"between{level}": virtual.between}
    if virtual.bands is not None and virtual.bands.between is not None:
        values[f"rows{level}"] = virtual.bands.between
    if level == 0:
        first_of_parent = np.zeros_like(need.first)
        values |= references(geometry, sector)
    else:
        parents = geometry.division.parents(level)
        first_of_parent = sector.needs[level - 1].first[:, parents]
        parent_m = sector.relative_m[level - 1][:, parents]
        offsets_m = [parent_m, sector.relative_m[level] - parent_m]
        values[f"offsets{level}"] = np.concatenate(offsets_m, axis=-1)
        values[f"positions{level}"] = sector.positions_m(level - 1).swapaxes(1, 2)
    return values | {f"bands{level}": band_table(virtual.bands, need, first_of_parent)}
