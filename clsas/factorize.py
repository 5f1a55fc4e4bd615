"""Factorized backprojection: the aperture interpolated, stage by stage."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsas import tree, validate
from clsas.backproject import (
    backproject,
    beam_arguments,
    channel_pitch,
    check_numbers,
    float_pairs,
    lookup_room,
    upsampled_lines,
    warn_unseen,
)
from clsas.device import Device, Slot, open_device
from clsas.geometry import bistatic_range_m
from clsas.grid import Grid
from clsas.image import Image
from clsas.layout import STACK, Tiles
from clsas.lines import RangeLines
from clsas.plan import GUARD, Plan, margin, padded_length
from clsas.planner import BEST_TOLERANCE_DB, WORST_TOLERANCE_DB, plan
from clsas.sector import Geometry, Sector
from clsas.tree import Division
from clsas.window import INTERVALS, BeamWindow

_GROUP = 64  # work-items that share a subimage where each has one lane
_GROUPS_PER_UNIT = 3  # at least, of compute units: so that they end together
_MOST_GAIN = 3.0  # of frequencies, which are amplified where lines hold next to nothing


def factorize(
    lines: RangeLines,
    grid: Grid,
    plan_or_tolerance: Plan | float,
    *,
    beam: BeamWindow | None = None,
    device: Device | str | int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Image:
    """Form the image of range lines fast, to a tolerance.

    Parameters
    ----------
    lines : RangeLines
        Any number of channels, monostatic, bistatic or moving.
    grid : Grid
        Any number of pixels. Off a plane the image is backprojected plainly.
    plan_or_tolerance : Plan or float
        A plan made by `clsas.plan` for these lines and this grid, or the relative rms error
        wanted against the exact image, dB, from -75 to -10.
    beam : BeamWindow, optional
        Weights of the channels; a plan holds its own.
    device : Device, str or int, optional
        See `clsas.device.choose`.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    Image
        complex64, phase-preserving.

    Raises
    ------
    TypeError, ValueError
        If an argument is not what is allowed, the plan was made for other lines or another grid,
        or `beam` is given beside a plan.
    DeviceError
        If there is no such device.

    Notes
    -----
    Aligned on a subimage's centre c, channel n's steering function exp(j 2 k (rho_n(x) - rho_n(c)))
    varies slowly along the track, and is interpolated from those of fewer, virtual channels:
    f_n ~ sum_m a_nm f_m. Hence sum_n s_n f_n ~ sum_m (sum_n a_nm s_n) f_m: the virtual channels'
    lines are weighted sums of aligned lines, and so again from stage to stage.
    """
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    validate.progress(progress)
    device = open_device(device)
    if not isinstance(plan_or_tolerance, Plan):
        validate.number(
            "plan_or_tolerance",
            plan_or_tolerance,
            "dB",
            least=BEST_TOLERANCE_DB,
            most=WORST_TOLERANCE_DB,
        )
        chosen = plan(lines, grid, tolerance_db=plan_or_tolerance, beam=beam, device=device)
    elif beam is not None:
        raise ValueError("beam must be left out with a plan, which holds its own")
    else:
        chosen = plan_or_tolerance
        chosen.check(lines, grid)
    if chosen.is_exact:
        return backproject(
            lines,
            grid,
            device=device,
            accuracy_db=chosen.predicted_error_db,
            beam=chosen.beam,
            progress=progress,
        )
    check_numbers(lines, chosen.beam)
    pixels, done = np.empty(grid.shape, np.complex64), 0
    try:
        run = _Run(lines, grid, chosen, device)
        for formed in run.into(pixels):
            done += formed
            if progress is not None:
                progress(done, grid.size)
    finally:
        device.finish()  # an interrupted run leaves nothing in use
    image = Image(pixels, grid)
    if not pixels.any() and lines.samples.any():
        corners_m = run.division.centres_m(0, run.division.roots)
        along = None if chosen.beam is None else chosen.beam.directions(lines)
        warn_unseen(lines, corners_m, chosen.beam, along)
    return image


@dataclass(frozen=True)
class _Level:
    """The lines of one stage: `half` samples to either side of a subimage's centre."""

    half: int
    length: int

    @property
    def pitch(self) -> int:
        """Samples of a line with the zeros around it."""
        return self.length + 2 * GUARD

    @property
    def centre(self) -> int:
        """Sample of the subimage's centre."""
        return self.half + GUARD


@dataclass(frozen=True, eq=False)
class _Tables:
    """What a device is told of a sector's roots, all at once.

    Attributes
    ----------
    slot : Slot
        Its buffers.
    pitches : list of int
        Channels of a row, stage by stage.
    strides : list of int
        Lines of a subimage, stage by stage.
    geometry_pitch : int
        Virtual channels of all roots in the last stage, in a row.
    """

    slot: Slot
    pitches: list[int]
    strides: list[int]
    geometry_pitch: int


class _Run:
    """A plan at work on a device."""

    def __init__(self, lines: RangeLines, grid: Grid, chosen: Plan, device: Device) -> None:
        self.lines, self.grid, self.plan, self.device = lines, grid, chosen, device
        self.width = device.info.width
        self.geometry = Geometry(lines, grid, chosen)
        self.division = self.geometry.division
        self.levels = [
            _Level(half, -(-(2 * half + 1) // self.width) * self.width)
            for half in chosen.half_lengths
        ]
        self.filters = {
            name: device.upload(getattr(chosen, name).coefficients.astype(np.float32))
            for name in ("align", "aperture", "final")
        }
        options = {"WIDTH": self.width, "TAPS": chosen.align.taps}
        options["APERTURE_TAPS"] = chosen.aperture.taps
        ramp = int(self.geometry.ramps)
        self.first_stage = device.kernel("stage", "stage", GIVEN=1, RAMP=ramp, **options)
        self.later_stage = device.kernel("stage", "stage", GIVEN=0, RAMP=0, **options)
        block_m = Tiles(grid, chosen.tile[0], self.width).block_radius_m
        fits = block_m * self.geometry.samples_per_m <= lookup_room(chosen.final.taps)
        # Where tile and leaf are one, every line is aligned on its centre.
        self.centred = chosen.tile == chosen.sides[-1]
        last = {
            "WIDTH": self.width,
            "TAPS": chosen.final.taps,
            "TILE_ROWS": chosen.tile[0],
            "TILE_COLUMNS": chosen.tile[1],
            "PERMUTE": int(device.info.permute and fits),
            "BISTATIC": 0,
            "MOVING": 0,
            "BEAM": 0 if chosen.beam is None else INTERVALS,
            "NORMALISE": 0,
            "ALONE": 1,
            "CENTRED": int(self.centred),
        }
        self.expand = device.kernel("backproject", "expand_tiles", **last)
        self.backproject = device.kernel("backproject", "backproject_tiles", **last)
        self.per_sine, self.beam = beam_arguments(device, chosen.beam, lines)
        self.pitch = padded_length(chosen.resampling, self.levels[0].half)
        self.samples = self._upload_lines()
        self.tiles = Division(grid, (chosen.sides[0], chosen.sides[-1], chosen.tile))
        self.per_root, self.leaf_of = self.tiles.per_root(2), self.tiles.parents(2)
        first = np.zeros((1, 2), np.int64)
        centres_m = self.tiles.centres_m(2, self.tiles.corners(2, first))[0]
        self.tile_m = centres_m - self.tiles.centres_m(0, first)
        self.centres = device.upload(np.tile(float_pairs(self.tile_m), (chosen.roots_at_once, 1)))
        later = range(1, len(self.levels))
        self.offsets = {level: self._offsets(level) for level in later}
        self.parents = {
            level: device.upload(self.division.parents(level).astype(np.int32)) for level in later
        }
        # One set of tables is filled while the device works with the other.
        self.table_slots = itertools.cycle([Slot(device), Slot(device)])
        self.slot = Slot(device)

    def _upload_lines(self) -> cl.Buffer:
        """Return all lines on the device, upsampled."""
        device, resampling, count = self.device, self.plan.resampling, self.lines.channels
        line_bytes = 8 * self.pitch
        if count * line_bytes > device.info.max_buffer_bytes:
            raise ValueError(
                f"{count} lines of {self.lines.length} samples need "
                f"{count * line_bytes / 2**20:.0f} MiB when upsampled, more than a buffer of "
                f"{device.info.label}, {device.info.max_buffer_bytes / 2**20:.0f} MiB: image "
                f"a part of them, or backproject exactly"
            )
        gain = None
        if not self.plan.nearest:
            # Range interpolation weakens the band's edges a little in every stage.
            frequency = resampling.frequency / resampling.ratio
            response = self.plan.align.response(frequency) ** len(self.levels)
            response *= self.plan.final.response(frequency)
            gain = np.clip(1 / response, 1 / _MOST_GAIN, _MOST_GAIN).astype(np.float32)
        zeros = margin(self.levels[0].half)
        return device.share(
            upsampled_lines(self.lines.samples, resampling, self.width, zeros, self.pitch, gain)
        )

    def _offsets(self, level: int) -> cl.Buffer:
        """Return the middles of parents from their root's, and of their subimages from theirs."""
        parent_m = self.geometry.relative_m[level - 1][self.division.parents(level)]
        offsets_m = [parent_m, self.geometry.relative_m[level] - parent_m]
        return self.device.upload(np.concatenate(offsets_m, axis=1).astype(np.float32))

    def into(self, pixels: NDArray[np.complex64]) -> Iterator[int]:
        """Form all pixels, [rows, columns]; yield how many each time that some are finished.

        The geometry of a sector is prepared while the device works on the one before.
        """
        roots, at_once, under_way = self.division.roots, self.plan.roots_at_once, deque()
        for start in range(0, len(roots), self.plan.roots_prepared):
            sector = self.geometry.sector(roots[start : start + self.plan.roots_prepared])
            tables = self._upload_tables(sector)
            for first in range(0, len(sector.roots), at_once):
                under_way.append(self._start(sector, tables, first, pixels))
                if len(under_way) > 2:  # so that an interruption need not wait long
                    yield self._finished(*under_way.popleft())
            tables.slot.busy = cl.enqueue_marker(self.device.queue)
        while under_way:
            yield self._finished(*under_way.popleft())

    def _start(
        self, sector: Sector, tables: _Tables, first: int, pixels: NDArray[np.complex64]
    ) -> tuple[int, list[cl.Event]]:
        """Start some roots of a sector; return how many pixels they have, and when to read."""
        batch = slice(first, min(first + self.plan.roots_at_once, len(sector.roots)))
        parts = [self._part(root) for root in sector.roots[batch]]
        if all(tables.strides):
            for level in range(len(self.levels)):
                self._stage(tables, level, batch)
            ready = self._backproject(sector, tables, batch, pixels, parts)
        else:
            ready = []
            for part in parts:
                pixels[part] = 0
        return sum(pixels[part].size for part in parts), ready

    @staticmethod
    def _finished(formed: int, ready: list[cl.Event]) -> int:
        """Wait for the pixels of roots that were started; return how many they are."""
        for event in ready:
            event.wait()
        return formed

    def _part(self, root: NDArray[np.int64]) -> tuple[slice, slice]:
        """Return which pixels of the image a root has."""
        ends = np.minimum(root + self.plan.sides[0], self.grid.shape)
        rows, columns = (slice(int(a), int(b)) for a, b in zip(root, ends, strict=True))
        return rows, columns

    def _upload_tables(self, sector: Sector) -> _Tables:
        """Start copying to the device all that it is told of a sector's roots."""
        slot, levels = next(self.table_slots), range(len(self.levels))
        slot.wait()
        strides = [sector.stride(level) for level in levels]
        for name, values in self.geometry.references(sector).items():
            slot.fill(name, _padded(values))
        for level, (nodes, need) in enumerate(zip(sector.nodes, sector.needs, strict=True)):
            children = np.zeros((*need.first.shape, 5), np.int32)
            children[..., 0], children[..., 1] = need.begin, need.end
            if level:
                parents = self.division.parents(level)
                children[..., 2] = sector.needs[level - 1].first[:, parents]
                position_m = sector.positions_m(level - 1).swapaxes(1, 2)
                slot.fill(f"positions{level}", _padded(position_m.astype(np.float32)))
            children[..., 3], children[..., 4] = need.first, need.last - need.first
            slot.fill(f"children{level}", children)
            slot.fill(f"base{level}", _padded(nodes.base.astype(np.int32)))
            slot.fill(f"between{level}", _padded(nodes.between.astype(np.float32)))

        rows = [float_pairs(sector.positions_m(-1).reshape(-1, 3))]
        if self.plan.beam is not None:
            along = tree.interpolated_directions(
                self.geometry.track.samples, self.geometry.along, sector.nodes[-1].place
            )
            rows.append((along * self.per_sine).astype(np.float32).reshape(-1, 3))
        geometry = np.pad(np.concatenate(rows, axis=1).T, ((0, 0), (0, 16)), mode="edge")
        slot.fill("geometry", geometry)
        need, (roots, node_pitch) = sector.needs[-1], sector.nodes[-1].place.shape
        root = np.arange(roots)[:, None]
        ranges = np.empty((roots, self.per_root, 3), np.int32)
        ranges[..., 0] = root * node_pitch + need.first[:, self.leaf_of]
        ranges[..., 1] = root * node_pitch + need.last[:, self.leaf_of]
        in_batch = root % self.plan.roots_at_once
        ranges[..., 2] = (in_batch * need.first.shape[1] + self.leaf_of) * strides[-1]
        slot.fill("ranges", ranges)
        pitches = [_pitch(nodes.base.shape[1]) for nodes in sector.nodes]
        return _Tables(slot, pitches, strides, geometry.shape[1])

    def _stage(self, tables: _Tables, level: int, batch: slice) -> None:
        """Form the lines of a stage from those of the one before, or from the raw ones."""
        device, table, shape, stride = (
            self.device,
            tables.slot,
            self.levels[level],
            tables.strides[level],
        )
        per_root = self.division.per_root(level)
        children = (batch.stop - batch.start) * per_root
        if level == 0:
            kernel, parent, parent_pitch = self.first_stage, self.samples, self.pitch
            names = ("order", "start", "nu", "cycles", *(["ramp"] if self.geometry.ramps else []))
            geometry = [table[name] for name in names]
        else:
            kernel, before = self.later_stage, self.levels[level - 1]
            parent, parent_pitch = self.slot[f"lines{level - 1}"], before.pitch
            geometry = [
                self.parents[level],
                self.division.per_root(level - 1),
                tables.strides[level - 1],
                table[f"positions{level}"],
                self.offsets[level],
                np.append(self.geometry.drift, 0).astype(np.float32),
                self.geometry.samples_per_m,
                self.geometry.cycles_per_m,
                before.centre,
            ]
        items = _GROUP if self.width == 1 else 1
        # Few children are divided, so that there is work for all.
        step = _GROUP if self.width == 1 else 8 * self.width
        parts = -(-_GROUPS_PER_UNIT * device.info.compute_units // children)
        part_length = step * -(-shape.length // (step * parts))
        device.run(
            kernel,
            (children * items, -(-shape.length // part_length)),
            parent,
            parent_pitch,
            table[f"children{level}"],
            batch.start * per_root,
            per_root,
            table[f"base{level}"],
            table[f"between{level}"],
            tables.pitches[level],
            *geometry,
            shape.half,
            self.filters["align"],
            self.filters["aperture"],
            self.slot.zeros(f"lines{level}", 8 * children * stride * shape.pitch),
            stride,
            shape.pitch,
            shape.length,
            part_length,
            GUARD,
            wait_for=table.filled,
            local=(items, 1),
        )

    def _backproject(
        self,
        sector: Sector,
        tables: _Tables,
        batch: slice,
        image: NDArray[np.complex64],
        parts: list[tuple[slice, slice]],
    ) -> list[cl.Event]:
        """Form the pixels of roots from their last stage, and start reading their parts."""
        device, slot, chosen, level = self.device, self.slot, self.plan, self.levels[-1]
        tiles, first_tile = len(parts) * self.per_root, batch.start * self.per_root
        pitch = channel_pitch(tables.strides[-1])
        if self.centred:
            references = [level.centre]
        else:
            slot.wait()
            values = self._leaf_references(sector, batch, pitch)
            for name, each in values.items():
                slot.fill(name, each)
            references = [slot[name] for name in values]
        steps_m = (self.grid.column_step_m, self.grid.row_step_m)
        samples_per_m = self.geometry.samples_per_m
        terms = 9 + (10 if chosen.beam is not None else 0)
        expansion = slot.buffer("expansion", 4 * terms * tiles * pitch)
        device.run(
            self.expand,
            (pitch // self.width, tiles),
            tables.slot["geometry"],
            pitch,
            tables.geometry_pitch,
            tables.slot["ranges"],
            first_tile,
            self.centres,
            *(np.append(step, 0).astype(np.float32) for step in steps_m),
            samples_per_m,
            np.array([self.geometry.drift @ s * samples_per_m for s in steps_m], np.float32),
            expansion,
            *self.beam[1:2],
        )
        height, width = chosen.sides[0]
        pixels = slot.buffer("pixels", 8 * len(parts) * height * width)
        slot.busy = device.run(
            self.backproject,
            (chosen.tile[0] * chosen.tile[1] // (self.width * STACK), tiles),
            slot[f"lines{len(self.levels) - 1}"],
            level.pitch,
            *references,
            expansion,
            pitch,
            tables.slot["ranges"],
            first_tile,
            self.geometry.cycles_per_m / samples_per_m,
            self.filters["final"],
            pixels,
            width,
            0,
            *self.beam,
            wait_for=slot.filled,
        )
        ready = []
        for index, (down, across) in enumerate(parts):
            ready.append(
                cl.enqueue_copy(
                    device.queue,
                    image,
                    pixels,
                    buffer_origin=(0, index * height, 0),
                    buffer_pitches=(8 * width, 0),
                    host_origin=(8 * across.start, down.start, 0),
                    host_pitches=(8 * image.shape[1], 0),
                    region=(8 * (across.stop - across.start), down.stop - down.start, 1),
                    is_blocking=False,
                )
            )
        device.queue.flush()
        return ready

    def _leaf_references(self, sector: Sector, batch: slice, pitch: int) -> dict[str, NDArray]:
        """Return where tiles' centres lie in the lines of their leaves, [roots, tiles, pitch]."""
        shape, centre = (batch.stop - batch.start, self.per_root, pitch), self.levels[-1].centre
        sample = np.full(shape, centre, np.int32)
        fraction, phase = np.zeros((2, *shape), np.float32)
        first = sector.needs[-1].first[batch][:, self.leaf_of]
        leaf_m = self.geometry.relative_m[-1][self.leaf_of]
        for root, position_m in enumerate(sector.positions_m(-1)[batch]):
            index = np.minimum(first[root][:, None] + np.arange(pitch), len(position_m) - 1)
            node_m = position_m[index]
            range_m = bistatic_range_m(self.tile_m[:, None], node_m, node_m)
            range_m -= bistatic_range_m(leaf_m[:, None], node_m, node_m)
            range_m -= (self.tile_m - leaf_m) @ self.geometry.drift[:, None]
            place = range_m * self.geometry.samples_per_m
            sample[root] += np.rint(place).astype(np.int32)
            fraction[root] = place - np.rint(place)
            phase[root] = np.remainder(self.geometry.cycles_per_m * range_m + 0.5, 1) - 0.5
        return {"sample": sample, "fraction": fraction, "phase": phase}


def _pitch(channels: int) -> int:
    """Channels of a row in a table, with room for a vector that begins at the last."""
    return channel_pitch(channels) + 16


def _padded(values: NDArray) -> NDArray:
    """Return [..., channels] as the stages' kernel wants it: rows of whole vectors."""
    count = values.shape[-1]
    padded = np.zeros((*values.shape[:-1], _pitch(count)), values.dtype)
    padded[..., :count] = values
    return padded
