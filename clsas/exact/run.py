"""A prepared exact image at work on a device."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from clsas.core import validate
from clsas.core.geometry import bistatic_range_m, pairwise_range_m
from clsas.core.image import Image, holds_any
from clsas.core.lines import RangeLines
from clsas.exact.lookup import lookup_options
from clsas.exact.preparation import Preparation
from clsas.exact.tiles import STACK, Tiles
from clsas.opencl.buffers import (
    VECTOR_ROOM,
    beam_table,
    channel_pitch,
    expansion_kernel,
    expansion_terms,
    filter_table,
    float_pairs,
    phase_polynomials,
    round_up,
    slices,
    upsampled_lines,
)
from clsas.opencl.device import Device, Slot
from clsas.signal.interpolation import Resampling
from clsas.sonar.beam import INTERVALS, LEAST_WEIGHT_SUM, BeamWindow
from clsas.sonar.coverage import warn_unseen
from clsas.sonar.visibility import BeamTrack

_CHANNELS_AT_ONCE = 512  # bounds a float32 partial sum; lines that stay in a CPU's cache
_SINE_ROUNDING = 1e-5  # more than the device's rounding error of a sine
_PART_BYTES = 64 << 20  # device memory for one set of parts: a job of some tenths of a second


def execute(
    preparation: Preparation,
    *,
    progress: Callable[[int, int], None] | None = None,
    warned: bool = False,
) -> Image:
    """Form the image that was prepared; `warned` is whether one of zeros has been warned of.

    The image is formed in bands that fit the device, each from blocks of channels, each block in
    jobs of so many (part, channel) pairs; a job is prepared on the host while the one before runs.
    With a beam only pairs that see each other are prepared.
    """
    validate.progress(progress)
    p = preparation
    layout, device = p.layout, p.device
    pixels = np.empty(layout.parts * layout.part_pixels, np.complex64)
    normalise = p.beam is not None and p.beam.normalise
    try:
        run = _Run(p, progress)
        at_once = band_parts(device, layout.part_pixels, layout.across, normalise)
        for band in slices(slice(0, layout.parts), at_once):
            part = slice(band.start * layout.part_pixels, band.stop * layout.part_pixels)
            names = ["pixels", "weight_sums"] if normalise else ["pixels"]
            on_device = {name: device.zeros(pixels[part].nbytes) for name in names}
            for channels in slices(slice(0, p.lines.channels), run.channels_at_once):
                run.add(channels, band, on_device)
            cl.enqueue_copy(device.queue, pixels[part], on_device["pixels"])
            if normalise:
                sums = np.empty_like(pixels[part])
                cl.enqueue_copy(device.queue, sums, on_device["weight_sums"])
                pixels[part] *= normalising(sums.real, p.lines.channels)
    finally:
        device.finish()  # an interrupted run leaves nothing in use
    image = Image(layout.collect(pixels), p.given_grid or p.grid)
    if not warned and not holds_any(image.pixels) and p.lines.samples.any():
        warn_unseen(p.lines, layout.centres_m(slice(None)), p.beam, p.along)
    return image


def normalising(sums: NDArray[np.floating], channels: int) -> NDArray[np.floating]:
    """Return what a normalising beam multiplies pixels by whose weights have these sums."""
    return (channels / np.maximum(sums, LEAST_WEIGHT_SUM)).astype(sums.dtype)


@dataclass(frozen=True)
class Blocks:
    """What is on a device at once.

    Attributes
    ----------
    reach, margin : int
        Samples by which a part may reach beyond a line's end, and zeros around lines.
    pitch : int
        Samples of a line with these.
    terms : int
        Coefficients per (tile, channel); none off a plane.
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

    That is an eighth of its memory for either set of lines, a sixteenth for either of references.
    """
    # Zeros around a line on the device: a part may reach beyond its end by a radius.
    reach = math.ceil(radius_m * resampling.samples_per_m(lines) * 1.1) + taps
    margin = 2 * reach + 2 * device.info.width
    pitch = round_up(resampling.length + 2 * margin, 16)
    if pitch % 256 == 0:  # lines at equal places in cache sets would evict each other
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


class _Run:
    """A preparation at work: its kernels, its buffers, and how much it has done."""

    def __init__(
        self, preparation: Preparation, progress: Callable[[int, int], None] | None
    ) -> None:
        p = self.p = preparation
        device, layout = p.device, p.layout
        self.tiled = isinstance(layout, Tiles)
        self.moving = p.lines.rx_velocity_m_s is not None
        self.bistatic = self.moving or not np.array_equal(p.lines.tx_m, p.lines.rx_m)
        self.radius_m = layout.radius_m
        self.origin_m = layout.centres_m(slice(0, 1))[0]

        blocks = blocks_of(
            device,
            p.lines,
            p.resampling,
            p.interpolator.taps,
            radius_m=self.radius_m,
            part_pixels=layout.part_pixels,
            tiled=self.tiled,
            beam=p.beam,
        )
        self.reach, self.margin, self.pitch = blocks.reach, blocks.margin, blocks.pitch
        self.terms, self.channels_at_once = blocks.terms, blocks.channels_at_once
        self.parts_at_once = blocks.parts_at_once

        options = {
            "WIDTH": device.info.width,
            "TAPS": p.interpolator.taps,
            "BEAM": 0 if p.beam is None else INTERVALS,
            "ONE_CUBIC": int(p.one_cubic),
            "NORMALISE": int(p.beam is not None and p.beam.normalise),
            "PHASE_TERMS": p.phase_terms,
        }
        options |= lookup_options(device, layout, p.lines, p.samples_per_m, p.interpolator.taps)
        paths = {"BISTATIC": int(self.bistatic), "MOVING": int(self.moving)}
        if self.tiled:
            self.expand = expansion_kernel(device, p.beam, **paths)
            tile = {"TILE_ROWS": layout.side, "TILE_COLUMNS": layout.side}
            self.kernel = device.kernel("backproject_tiles", **options, **tile)
        else:
            self.kernel = device.kernel("backproject_points", **options, **paths)

        # While one set of buffers is in use on the device, the other is filled.
        self.line_slots = itertools.cycle([Slot(device), Slot(device)])
        self.part_slots = itertools.cycle([Slot(device), Slot(device)])
        self.filter = filter_table(device, p.interpolator.coefficients)
        self.phase_polynomials = phase_polynomials(device, p.phase_terms)
        self.beam = beam_table(device, p.beam, p.lines)
        self.corner = device.upload(np.zeros(2, np.int32))
        self.progress = progress
        self.done = 0

    def add(self, channels: slice, band: slice, pixels: dict[str, cl.Buffer]) -> None:
        """Add some channels to the pixels of a band of parts, and to the sums of their weights."""
        ranges = self._ranges(channels, band)
        seen = ranges[:, 1] > ranges[:, 0]
        if not seen.any():
            self._report((band.stop - band.start) * (channels.stop - channels.start))
            return
        # Lines that no part sees are left out.
        first, end = int(ranges[seen].min()), int(ranges[seen].max())
        ranges[seen] -= first
        of_all = channels.stop - channels.start
        channels = slice(channels.start + first, channels.start + end)
        lines = self.p.lines.select(channels)
        line_slot = next(self.line_slots)
        line_slot.wait()
        width, resampling = self.p.device.info.width, self.p.resampling
        samples = upsampled_lines(lines.samples, resampling, width, self.margin, self.pitch)
        line_slot.fill("samples", samples)
        geometry = self._geometry(lines, channels)
        line_slot.fill("geometry", geometry)
        for parts in slices(band, self.parts_at_once):
            of_parts = ranges[parts.start - band.start : parts.stop - band.start]
            if of_parts.any():
                slot = next(self.part_slots)
                slot.wait()
                centres_m = self.p.layout.centres_m(parts)
                slot.fill("centres", float_pairs(centres_m - self.origin_m))
                slot.fill("ranges", np.column_stack([of_parts, of_parts[:, 0]]))
                references = self._references(centres_m, lines, of_parts)
                for name, values in references.items():
                    slot.fill(name, values)
                pitches = (references["sample"].shape[1], geometry.shape[1])
                first_part = parts.start - band.start
                event = self._launch(line_slot, slot, parts, pitches, first_part, pixels)
                slot.busy = line_slot.busy = event
                self.p.device.queue.flush()
            self._report((parts.stop - parts.start) * of_all)

    def _ranges(self, channels: slice, band: slice) -> NDArray[np.int32]:
        """Return which of some channels each part of a band sees, [parts, 2]: first and end."""
        p = self.p
        count = channels.stop - channels.start
        if p.beam is None:
            return np.tile(np.array([0, count], np.int32), (band.stop - band.start, 1))
        low, high = p.beam.limits
        limits = low - _SINE_ROUNDING, high + _SINE_ROUNDING
        track = BeamTrack(limits, p.lines.phase_centres_m[channels], p.along[channels])
        return track.spans(p.layout.boxes(band)).ranges

    def _launch(
        self,
        line_slot: Slot,
        slot: Slot,
        parts: slice,
        pitches: tuple[int, int],
        first_part: int,
        pixels: dict[str, cl.Buffer],
    ) -> cl.Event:
        """Run the kernels of one job on buffers that are being filled.

        `pitches` are those of channels in what is held per part, and in the geometry.
        """
        p, device, layout = self.p, self.p.device, self.p.layout
        count = parts.stop - parts.start
        pitch, geometry_pitch = pitches
        geometry = {
            "geometry": line_slot["geometry"],
            "geometry_pitch": geometry_pitch,
            "centres": slot["centres"],
            "samples_per_m": p.samples_per_m,
        }
        ranges = {"ranges": slot["ranges"], "first_range": 0}
        if self.tiled:
            expansions = slot.buffer("expansions", 4 * self.terms * count * pitch)
            device.run(
                self.expand,
                (pitch // device.info.width, count),
                **geometry,
                **ranges,
                column_step=p.grid.column_step_m,
                row_step=p.grid.row_step_m,
                drift=(0.0, 0.0),
                **self.beam.origin,
                expansions=expansions,
                channel_pitch=pitch,
                wait_for=line_slot.filled + slot.filled,
            )
            size = (layout.part_pixels // (device.info.width * STACK), count)
            positions = {
                "expansions": expansions,
                "columns": layout.across * layout.side,
                "corners": self.corner,
                "tiles_down": layout.down,
                "tiles_across": layout.across,
                "first_tile": first_part,
            }
        else:
            slot.fill("offsets", layout.offset_m[parts].reshape(-1, 3).T)
            size = (count,)
            positions = geometry | {
                "offsets": slot["offsets"],
                "points": count * layout.part_pixels,
                "first_group": first_part,
            }
        return device.run(
            self.kernel,
            size,
            lines=line_slot["samples"],
            line_pitch=self.pitch,
            **ranges,
            reference_sample=slot["sample"],
            reference_fraction=slot["fraction"],
            reference_phase=slot["phase"],
            channel_pitch=pitch,
            cycles_per_sample=p.cycles_per_m / p.samples_per_m,
            filter=self.filter,
            phase_polynomials=self.phase_polynomials,
            **positions,
            **self.beam.arguments,
            **pixels,
            wait_for=line_slot.filled + slot.filled,
        )

    def _geometry(self, lines: RangeLines, channels: slice) -> NDArray[np.float32]:
        """Return positions about the origin, velocities over sound speed and directions.

        That is float32 [rows, channels]. A vector may begin at any channel.
        """
        rows = [float_pairs(lines.tx_m - self.origin_m)]
        if self.bistatic:
            rows.append(float_pairs(lines.rx_m - self.origin_m))
        if self.moving:
            rows.append((lines.rx_velocity_m_s / lines.sound_speed_m_s).astype(np.float32))
        if self.p.beam is not None:
            rows.append((self.p.along[channels] * self.beam.per_sine).astype(np.float32))
        pitch = channel_pitch(lines.channels) + VECTOR_ROOM
        geometry = np.concatenate(rows, axis=1).T
        return np.pad(geometry, ((0, 0), (0, pitch - lines.channels)), mode="edge")

    def _references(
        self, centres_m: NDArray[np.float64], lines: RangeLines, ranges: NDArray[np.int32]
    ) -> dict[str, NDArray]:
        """Return where each centre's echo lies in each line, and its phase, reduced in float64.

        These are [parts, channels], from the first channel in a part's range on.
        """
        resampling = self.p.resampling
        seen = ranges[:, 1] > ranges[:, 0]
        count = int((ranges[:, 1] - ranges[:, 0]).max())
        if count == lines.channels and not ranges[:, 0].any():
            seen[:] = True
            range_m = pairwise_range_m(
                centres_m,
                lines.tx_m,
                lines.rx_m,
                lines.rx_velocity_m_s,
                lines.sound_speed_m_s,
            )
            first_range_m = lines.first_range_m
        else:
            range_m, first_range_m = _windowed_ranges(
                centres_m[seen], lines, ranges[seen, 0], count
            )
        place = (range_m - first_range_m) / lines.range_step_m + resampling.lead
        range_m *= lines.carrier_cycles_per_m
        cycles = range_m + place * resampling.centre_cycles_per_sample
        cycles -= np.rint(cycles)
        place *= resampling.ratio
        place += self.margin - resampling.first
        nearest = np.rint(place)
        place -= nearest
        # A part that lies outside a line altogether is put where it reads zeros only.
        nearest = np.clip(
            nearest,
            self.margin - self.reach,
            self.margin + resampling.length + self.reach,
        )
        shape = (len(centres_m), channel_pitch(count))
        references = {
            "sample": np.zeros(shape, np.int32),
            "fraction": np.zeros(shape, np.float32),
            "phase": np.zeros(shape, np.float32),
        }
        for array, values in zip(references.values(), (nearest, place, cycles), strict=True):
            array[seen, :count] = values
        return references

    def _report(self, pairs: int) -> None:
        self.done += pairs
        if self.progress is not None:
            self.progress(self.done, self.p.layout.parts * self.p.lines.channels)


def _windowed_ranges(
    centres_m: NDArray[np.float64], lines: RangeLines, first: NDArray[np.int32], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the ranges of centres to `count` channels from each one's first, [centres, count].

    Beside them those of the lines' first samples. The last channel stands for those beyond it.
    """

    def window(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return sliding_window_view(np.pad(values, (0, count - 1), mode="edge"), count)[first]

    def distance_m(antennas_m: NDArray[np.float64]) -> NDArray[np.float64]:
        square = np.zeros((len(first), count))
        for axis in range(3):
            offset_m = window(antennas_m[:, axis])
            offset_m -= centres_m[:, axis, None]
            offset_m *= offset_m
            square += offset_m
        return np.sqrt(square, out=square)

    if lines.rx_velocity_m_s is not None:
        antennas = (lines.tx_m, lines.rx_m, lines.rx_velocity_m_s)
        moving = (np.stack([window(axis) for axis in each.T], axis=-1) for each in antennas)
        range_m = bistatic_range_m(centres_m[:, None], *moving, lines.sound_speed_m_s)
    else:
        range_m = distance_m(lines.tx_m)
        if not np.array_equal(lines.tx_m, lines.rx_m):
            range_m += distance_m(lines.rx_m)
            range_m *= 0.5
    return range_m, window(lines.first_range_m)


def band_parts(device: Device, part_pixels: int, across: int, normalise: bool) -> int:
    """Return how many parts' pixels may be on a device at once: whole rows of tiles."""
    most = min(device.info.max_buffer_bytes, device.info.memory_bytes // 4)
    return max(most // (8 * (1 + normalise) * part_pixels) // across, 1) * across
