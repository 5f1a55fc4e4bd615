"""Factorized backprojection: the aperture interpolated, stage by stage."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsas import tree, validate
from clsas.aperture import cycles_per_pixel, drift, mean_track, stretches
from clsas.backproject import (
    backproject,
    beam_arguments,
    check_numbers,
    float_pairs,
    lookup_room,
    padded_lines,
    warn_unseen,
)
from clsas.device import Device, Slot, open_device
from clsas.geometry import bistatic_range_m, pairwise_range_m
from clsas.grid import Grid
from clsas.image import Image
from clsas.layout import STACK, Tiles
from clsas.lines import RangeLines
from clsas.plan import GUARD, Plan, margin, padded_length
from clsas.planner import BEST_TOLERANCE_DB, WORST_TOLERANCE_DB, plan
from clsas.tree import Division, Nodes, Ranges
from clsas.window import INTERVALS, BeamWindow

_GROUP = 64  # work-items that share a subimage where each has one lane
_MOST_GAIN = 3.0  # of frequencies, which are amplified where lines hold next to nothing
_ON_TRACK = 1e-4  # wavelengths
_LINES_AT_ONCE = 256  # upsampled together: what stays in a CPU's cache


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
class _Batch:
    """Some roots: where their subimages are, and which virtual channels they have.

    Attributes
    ----------
    roots : int [roots, 2]
        Their first pixels.
    root_m : float64 [roots, 3]
        Middles of the roots.
    relative_m : list of float64 [roots, subimages, 3]
        Middles of the subimages from those of their roots, stage by stage.
    nodes : list of Nodes
    needs : list of Ranges
    place : float64 [roots, channels]
        Where the raw channels appear on the track.
    """

    roots: NDArray[np.int64]
    root_m: NDArray[np.float64]
    relative_m: list[NDArray[np.float64]]
    nodes: list[Nodes]
    needs: list[Ranges]
    place: NDArray[np.float64]

    def stride(self, level: int) -> int:
        """Return how many lines a subimage of a stage has at most."""
        need = self.needs[level]
        return int((need.last - need.first).max())


class _Run:
    """A plan at work on a device."""

    def __init__(self, lines: RangeLines, grid: Grid, chosen: Plan, device: Device) -> None:
        self.lines, self.grid, self.plan, self.device = lines, grid, chosen, device
        self.width = device.info.width
        resampling = chosen.resampling
        self.samples_per_m = resampling.ratio / lines.range_step_m
        self.cycles_per_m = (
            lines.carrier_cycles_per_m + resampling.centre_cycles_per_sample / lines.range_step_m
        )
        self.division = Division(grid, chosen.sides)
        self.track = mean_track(lines)
        self.along = None
        if chosen.beam is not None:
            along = chosen.beam.directions(lines)
            self.along = tree.beam_directions(along, self.track, self.track.samples)
        self.phase_centres_m = lines.phase_centres_m
        self.drift = drift(lines)
        # The thesis's method has none; on the track itself there is nothing to make up for.
        self.ramps = not chosen.nearest and (
            not np.array_equal(lines.tx_m, lines.rx_m)
            or np.abs(self.phase_centres_m - self.track.positions_m(self.track.place)).max()
            > _ON_TRACK * lines.sound_speed_m_s / max(lines.carrier_hz, 1.0)
        )
        self.levels = [
            _Level(half, -(-(2 * half + 1) // self.width) * self.width)
            for half in chosen.half_lengths
        ]
        self.filters = {
            name: device.upload(getattr(chosen, name).coefficients.astype(np.float32))
            for name in ("align", "final")
        }
        options = {"WIDTH": self.width, "TAPS": chosen.align.taps}
        options["APERTURE_TAPS"] = chosen.aperture.taps
        self.first_stage = device.kernel("stage", "stage", GIVEN=1, RAMP=int(self.ramps), **options)
        self.later_stage = device.kernel("stage", "stage", GIVEN=0, RAMP=0, **options)
        block_m = Tiles(grid, chosen.tile[0], self.width).block_radius_m
        fits = block_m * self.samples_per_m <= lookup_room(chosen.final.taps)
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
        }
        self.expand = device.kernel("backproject", "expand_tiles", **last)
        self.backproject = device.kernel("backproject", "backproject_tiles", **last)
        self.per_sine, self.beam = beam_arguments(device, chosen.beam, lines)
        self.margin = margin(self.levels[0].half)
        self.pitch = padded_length(resampling, self.levels[0].half)
        self.samples = self._upload_lines()
        self.slots = [Slot(device) for _ in self.levels]
        self.last_slot = Slot(device)

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
        # Every stage's range interpolation weakens the band's edges a little: make up for it.
        response = self.plan.align.response(resampling.frequency) ** len(self.levels)
        response *= self.plan.final.response(resampling.frequency)
        gain = np.clip(1 / response, 1 / _MOST_GAIN, _MOST_GAIN).astype(np.float32)
        if self.plan.nearest:
            gain = None
        buffer = device.buffer(count * line_bytes)
        for start in range(0, count, _LINES_AT_ONCE):
            upsampled = resampling.apply(self.lines.samples[start : start + _LINES_AT_ONCE], gain)
            padded = padded_lines(upsampled, self.width, self.margin, self.pitch)
            cl.enqueue_copy(device.queue, buffer, padded, dst_offset=start * line_bytes)
        return buffer

    def into(self, pixels: NDArray[np.complex64]) -> Iterator[int]:
        """Form all pixels, [rows, columns]; yield how many each time that some are finished.

        The geometry of a batch is prepared while the device works on the one before.
        """
        roots, before = self.division.roots, None
        for start in range(0, len(roots), self.plan.roots_at_once):
            batch = self._batch(roots[start : start + self.plan.roots_at_once])
            if before is not None:
                yield self._finished(*before)
            before = self._start(batch, pixels)
        yield self._finished(*before)

    def _start(self, batch: _Batch, pixels: NDArray[np.complex64]) -> tuple[int, list[cl.Event]]:
        """Start a batch; return how many pixels it has, and when they are there."""
        parts = [self._part(root) for root in batch.roots]
        if batch.stride(0):
            for level in range(len(self.levels)):
                self._stage(batch, level)
            ready = self._backproject(batch, pixels, parts)
        else:
            ready = []
            for part in parts:
                pixels[part] = 0
        return sum(pixels[part].size for part in parts), ready

    @staticmethod
    def _finished(formed: int, ready: list[cl.Event]) -> int:
        """Wait for the pixels of a batch that was started; return how many they are."""
        for event in ready:
            event.wait()
        return formed

    def _part(self, root: NDArray[np.int64]) -> tuple[slice, slice]:
        """Return which pixels of the image a root has."""
        ends = np.minimum(root + self.plan.sides[0], self.grid.shape)
        rows, columns = (slice(int(a), int(b)) for a, b in zip(root, ends, strict=True))
        return rows, columns

    def _batch(self, roots: NDArray[np.int64]) -> _Batch:
        division, chosen, track = self.division, self.plan, self.track
        corners = [division.corners(level, roots) for level in range(len(self.levels))]
        centres_m = [division.centres_m(*each) for each in enumerate(corners)]
        root_m = centres_m[0][:, 0]
        seen_at = place = track.places_seen_from(root_m, self.phase_centres_m)
        nodes = []
        if chosen.nearest:
            position_m = np.broadcast_to(self.phase_centres_m, (*place.shape, 3))
            for factor in chosen.nearest:
                nodes.append(tree.nearest_nodes(place, position_m, factor))
                place, position_m = nodes[-1].place, nodes[-1].position_m
        else:
            rates = cycles_per_pixel(
                track,
                self.grid,
                root_m,
                chosen.sides[0],
                chosen.highest_cycles_per_m,
                division.radius_m(len(self.levels) - 1),
                chosen.beam,
                self.along,
            )
            for level, (rows, columns) in enumerate(chosen.sides):
                rate = chosen.crowding[level] * (rows * rates[0] + columns * rates[1])
                if chosen.beam is not None and level == len(self.levels) - 1:
                    rate += chosen.beam_cycles * tree.beam_rate(
                        chosen.beam, track, self.along, root_m
                    )
                nodes.append(tree.interpolated_nodes(track, rate, place, chosen.aperture))
                place = nodes[-1].place
        half_m = np.array(chosen.sides[-1])[:, None] / 2
        half_m = half_m * [self.grid.row_step_m, self.grid.column_step_m]
        seen = tree.seen_from(chosen.beam, track, self.along, centres_m[-1], half_m)
        inside = np.all(corners[-1] < self.grid.shape, axis=-1)
        needs = tree.ranges(division, nodes, seen, inside)
        relative_m = [each - root_m[:, None] for each in centres_m]
        return _Batch(roots, root_m, relative_m, nodes, needs, seen_at)

    def _stage(self, batch: _Batch, level: int) -> None:
        """Form the lines of a stage from those of the one before, or from the raw ones."""
        device, slot, shape = self.device, self.slots[level], self.levels[level]
        nodes, need, stride = batch.nodes[level], batch.needs[level], batch.stride(level)
        roots, subimages = need.first.shape
        children = np.zeros((roots, subimages, 8), np.int32)
        children[..., 1] = np.arange(roots)[:, None]
        children[..., 2], children[..., 3] = need.begin, need.end
        children[..., 5], children[..., 6] = need.first, need.last - need.first
        slot.wait()
        slot.fill("base", _padded(nodes.base, np.int32))
        slot.fill("aperture", _padded(nodes.weights, np.float32))
        if level == 0:
            kernel, parent, parent_pitch = self.first_stage, self.samples, self.pitch
            references = self._references(batch, shape.half)
            for name, values in references.items():
                slot.fill(name, values)
            geometry = [slot[name] for name in references]
        else:
            kernel, before = self.later_stage, self.levels[level - 1]
            parent, parent_pitch = self.slots[level - 1]["lines"], before.pitch
            parents, parent_m = self.division.parents(level), batch.relative_m[level - 1]
            index = np.arange(roots)[:, None] * parent_m.shape[1] + parents
            children[..., 0] = index * batch.stride(level - 1)
            children[..., 4] = batch.needs[level - 1].first[:, parents]
            position_m = batch.nodes[level - 1].position_m - batch.root_m[:, None]
            slot.fill("positions", _padded(position_m, np.float32).swapaxes(1, 2))
            offsets = [parent_m[:, parents], batch.relative_m[level] - parent_m[:, parents]]
            slot.fill("offsets", np.concatenate(offsets, axis=-1).astype(np.float32))
            geometry = [
                slot["positions"],
                slot["offsets"],
                np.append(self.drift, 0).astype(np.float32),
                self.samples_per_m,
                self.cycles_per_m,
                before.centre,
            ]
        slot.fill("children", children)
        items = _GROUP if self.width == 1 else 1
        slot.busy = device.run(
            kernel,
            (roots * subimages * items,),
            parent,
            parent_pitch,
            slot["children"],
            slot["base"],
            slot["aperture"],
            _pitch(nodes.base.shape[1]),
            *geometry,
            shape.half,
            self.filters["align"],
            slot.zeros("lines", 8 * roots * subimages * stride * shape.pitch),
            stride,
            shape.pitch,
            shape.length,
            GUARD,
            wait_for=slot.filled,
            local=(items,),
        )

    def _references(self, batch: _Batch, half: int) -> dict[str, NDArray]:
        """Return how roots see the raw channels, in the order of their nodes.

        First sample, place between samples, phase in cycles and its ramp; all from float64.
        """
        lines, resampling = self.lines, self.plan.resampling
        range_m = pairwise_range_m(
            batch.root_m, lines.tx_m, lines.rx_m, lines.rx_velocity_m_s, lines.sound_speed_m_s
        )
        place = (range_m - lines.first_range_m) / lines.range_step_m + resampling.lead
        cycles = lines.carrier_cycles_per_m * range_m
        cycles += place * resampling.centre_cycles_per_sample
        place *= resampling.ratio
        place += self.margin - resampling.first - half
        lower = np.floor(place)
        start = np.clip(lower + 1 - self.plan.align.taps // 2, -half, self.pitch)
        order = batch.nodes[0].order

        def ordered(values: NDArray[np.float64], kind: type) -> NDArray:
            return _padded(np.take_along_axis(values, order, axis=1), kind)

        return {
            "order": _padded(order, np.int32),
            "start": ordered(start, np.int32),
            "nu": ordered(place - lower - 0.5, np.float32),
            "cycles": ordered(cycles - np.rint(cycles), np.float32),
            "ramp": ordered(self._ramp(batch), np.float32),
        }

    def _ramp(self, batch: _Batch) -> NDArray[np.float64]:
        """Return by how many cycles per sample the phase of channels grows beyond their place's."""
        if not self.ramps:
            return np.zeros_like(batch.place)
        virtual_m = self.track.positions_m(batch.place)
        stretch = stretches(self.lines.tx_m, self.lines.rx_m, self.grid, batch.root_m, virtual_m)
        return stretch * self.cycles_per_m / self.samples_per_m

    def _backproject(
        self,
        batch: _Batch,
        image: NDArray[np.complex64],
        parts: list[tuple[slice, slice]],
    ) -> list[cl.Event]:
        """Form the pixels of roots from their last stage, and start reading their parts."""
        device, slot, chosen, level = self.device, self.last_slot, self.plan, self.levels[-1]
        nodes, need, stride = batch.nodes[-1], batch.needs[-1], batch.stride(len(self.levels) - 1)
        roots = len(batch.root_m)
        tiles = Division(self.grid, (chosen.sides[0], chosen.sides[-1], chosen.tile))
        per_root, leaf_of = tiles.per_root(2), tiles.parents(2)
        relative_m = tiles.centres_m(2, tiles.corners(2, np.zeros((1, 2), np.int64)))
        relative_m = relative_m - tiles.centres_m(0, np.zeros((1, 1, 2), np.int64))
        first, last = need.first[:, leaf_of], need.last[:, leaf_of]
        ranges = np.empty((roots, per_root, 3), np.int32)
        root = np.arange(roots)[:, None]
        ranges[..., 0] = root * nodes.place.shape[1] + first
        ranges[..., 1] = root * nodes.place.shape[1] + last
        ranges[..., 2] = (root * need.first.shape[1] + leaf_of) * stride
        pitch = -(-stride // 16) * 16

        position_m = nodes.position_m - batch.root_m[:, None]
        rows = [float_pairs(position_m.reshape(-1, 3))]
        if chosen.beam is not None:
            along = tree.interpolated_directions(self.track.samples, self.along, nodes.place)
            rows.append((along * self.per_sine).astype(np.float32).reshape(-1, 3))
        geometry = np.pad(np.concatenate(rows, axis=1).T, ((0, 0), (0, 16)), mode="edge")
        slot.wait()
        slot.fill("geometry", geometry)
        slot.fill("ranges", ranges)
        centres_m = np.broadcast_to(relative_m, (roots, per_root, 3))
        slot.fill("centres", float_pairs(centres_m.reshape(-1, 3)))
        for name, values in self._leaf_references(batch, leaf_of, centres_m, pitch).items():
            slot.fill(name, values)
        steps_m = (self.grid.column_step_m, self.grid.row_step_m)
        terms = 9 + (10 if chosen.beam is not None else 0)
        expansion = slot.buffer("expansion", 4 * terms * roots * per_root * pitch)
        slot.busy = device.run(
            self.expand,
            (pitch // self.width, roots * per_root),
            slot["geometry"],
            pitch,
            geometry.shape[1],
            slot["ranges"],
            slot["centres"],
            *(np.append(step, 0).astype(np.float32) for step in steps_m),
            self.samples_per_m,
            np.array([self.drift @ s * self.samples_per_m for s in steps_m], np.float32),
            expansion,
            *self.beam[1:2],
            wait_for=slot.filled,
        )
        height, width = chosen.sides[0]
        bytes_ = 8 * roots * height * width
        pixels = slot.buffer("pixels", bytes_)
        cl.enqueue_fill_buffer(device.queue, pixels, np.uint32(0), 0, bytes_)
        slot.busy = device.run(
            self.backproject,
            (chosen.tile[0] * chosen.tile[1] // (self.width * STACK), roots * per_root),
            self.slots[-1]["lines"],
            level.pitch,
            slot["sample"],
            slot["fraction"],
            slot["phase"],
            expansion,
            pitch,
            slot["ranges"],
            self.cycles_per_m / self.samples_per_m,
            self.filters["final"],
            pixels,
            width,
            0,
            *self.beam,
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

    def _leaf_references(
        self, batch: _Batch, leaf_of: NDArray[np.int64], centres_m: NDArray[np.float64], pitch: int
    ) -> dict[str, NDArray]:
        """Return where tiles' centres lie in the lines of their leaves, [tiles, pitch].

        Where tile and leaf are one, every line is aligned on its centre.
        """
        level, shape = self.levels[-1], (*centres_m.shape[:2], pitch)
        sample = np.full(shape, level.centre, np.int32)
        fraction, phase = np.zeros((2, *shape), np.float32)
        if self.plan.tile != self.plan.sides[-1]:
            nodes, need = batch.nodes[-1], batch.needs[-1]
            for root, position_m in enumerate(nodes.position_m - batch.root_m[:, None]):
                first = need.first[root, leaf_of]
                index = np.minimum(first[:, None] + np.arange(pitch), len(position_m) - 1)
                leaf_m = batch.relative_m[-1][root, leaf_of]
                tile_m, node_m = centres_m[root], position_m[index]
                range_m = bistatic_range_m(tile_m[:, None], node_m, node_m)
                range_m -= bistatic_range_m(leaf_m[:, None], node_m, node_m)
                range_m -= (tile_m - leaf_m) @ self.drift[:, None]
                place = range_m * self.samples_per_m
                sample[root] += np.rint(place).astype(np.int32)
                fraction[root] = place - np.rint(place)
                phase[root] = np.remainder(self.cycles_per_m * range_m + 0.5, 1) - 0.5
        return {"sample": sample, "fraction": fraction, "phase": phase}


def _pitch(channels: int) -> int:
    """Channels of a row in a table, with room for a vector that begins at the last."""
    return -(-channels // 16) * 16 + 16


def _padded(values: NDArray, kind: type) -> NDArray:
    """Return [roots, channels, ...] as the stages' kernel wants it: rows of whole vectors."""
    padding = [(0, 0)] * values.ndim
    padding[1] = (0, _pitch(values.shape[1]) - values.shape[1])
    return np.pad(values.astype(kind), padding)
