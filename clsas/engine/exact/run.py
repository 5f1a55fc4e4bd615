"""Form an exact image: band by band, and each band from one block of channels after the other.

The host computes ranges and phases of the centres of tiles or groups in float64. From these
references the device computes differences in float32, and adds the echoes to the pixels.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from clsas.engine.data.beam import INTERVALS, BeamWindow, normalising
from clsas.engine.data.geometry import bistatic_range_m, pairwise_range_m
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.visibility import BeamTrack
from clsas.engine.device.buffers import (
    Buffer,
    Buffers,
    Slot,
    beam_table,
    channel_pitch,
    expansion_kernel,
    expansion_terms,
    filter_table,
    float_pairs,
    geometry_buffer,
    padded_length,
    phase_polynomials,
    pixel_buffers,
    slices,
    upsampled_lines,
)
from clsas.engine.device.device import Device
from clsas.engine.exact.decide import Decision
from clsas.engine.exact.layout import Groups, GroupsEstimate, Tiles, item_pixels, lookup_options
from clsas.engine.scene import Scene
from clsas.engine.signal.interpolation import Resampling

# Channels of a block. The number bounds float32 partial sums, and their lines stay in the cache of
# a CPU.
_CHANNELS_AT_ONCE = 512
# Blocks and bands that the memory of a device has room for, of which two each are there at a time.
_BLOCKS_IN_MEMORY, _BANDS_IN_MEMORY = 8, 4
_PART_BYTES = 64 << 20  # device memory for one set of parts, a job of some tenths of a second
_MOST_SINE_ROUNDING = 1e-5  # upper bound on the device's rounding error of a sine
_MOST_KEPT_BYTES = 256 << 20  # of references that are kept: more than 20 million of 12 bytes each


class ExactImager:
    """Imager that forms exact images of any samples of a scene.

    Parameters
    ----------
    scene : Scene
    decision : Decision
    device : Device
    keep : bool
        Whether references are kept for the next image, if they are not too large.
    """

    def __init__(
        self,
        scene: Scene,
        decision: Decision,
        device: Device,
        *,
        keep: bool = True,
    ) -> None:
        assert not isinstance(decision.layout, GroupsEstimate)
        self.scene, self.decision, self.device = scene, decision, device
        self.layout: Tiles | Groups = decision.layout
        self._kept: dict[tuple[str, int, int, int, int], dict[str, NDArray]] = {}
        self._free_bytes = _MOST_KEPT_BYTES if keep else 0

    @functools.cached_property
    def blocks(self) -> Blocks:
        """Sizes of what is on the device at once. Raises ValueError if lines are too long."""
        return blocks_of(
            self.device,
            self.scene.lines,
            self.decision.resampling,
            self.decision.interpolator.taps,
            radius_m=self.layout.radius_m,
            part_pixels=self.layout.part_pixels,
            tiled=isinstance(self.layout, Tiles),
            beam=self.scene.beam,
        )

    def form(
        self, lines: RangeLines, progress: Callable[[int, int], None] | None = None
    ) -> NDArray[np.complex64]:
        """Return the pixels of the image of lines of the scene, as they are imaged.

        The image is formed band by band, each band from blocks of channels, and each block in jobs
        for some of the parts. The host prepares a job while the device runs the one before. With a
        beam, it only prepares pairs of parts and channels that the beam connects.

        Parameters
        ----------
        lines : RangeLines
        progress : callable, optional
            Called as progress(pairs of a part and a channel that are done, pairs).
        """
        layout, device, beam, blocks = self.layout, self.device, self.scene.beam, self.blocks
        part_pixels, normalise = layout.part_pixels, beam is not None and beam.normalise
        backprojection = _Backprojection(self, lines)
        at_nodes_m: dict[int, NDArray[np.float64]] = {}
        pixels = np.empty(layout.parts * part_pixels, np.complex64)
        report = progress or (lambda done, pairs: None)
        done, pairs = 0, layout.parts * lines.channels

        parts_of_band = band_parts(device, part_pixels, layout.across, normalise)
        for band in slices(slice(0, layout.parts), parts_of_band):
            in_band = slice(band.start * part_pixels, band.stop * part_pixels)
            buffers = pixel_buffers(in_band.stop - in_band.start, beam)
            sums = {name: device.zeros(buffer.nbytes) for name, buffer in buffers.items()}

            for channels in slices(slice(0, lines.channels), blocks.channels_at_once):
                count = channels.stop - channels.start
                needed = self._needed_channels(lines, channels, band)
                visible = needed[:, 1] > needed[:, 0]
                if not visible.any():
                    done += (band.stop - band.start) * count
                    report(done, pairs)
                    continue
                # Lines that no part needs are left out.
                first, end = int(needed[visible].min()), int(needed[visible].max())
                needed = np.where(visible[:, None], needed - np.int32(first), needed)
                some = slice(channels.start + first, channels.start + end)
                block = self.decision.crop.of(lines, some)
                backprojection.upload_lines(block, some)

                for parts in slices(band, blocks.parts_at_once):
                    of_parts = needed[parts.start - band.start : parts.stop - band.start]
                    if of_parts.any():
                        references = self._references(block, some, parts, of_parts, at_nodes_m)
                        backprojection.add(parts, of_parts, references, sums, band.start)
                    done += (parts.stop - parts.start) * count
                    report(done, pairs)

            cl.enqueue_copy(device.queue, pixels[in_band], sums["pixels"])
            if normalise:
                weights = np.empty_like(pixels[in_band])
                cl.enqueue_copy(device.queue, weights, sums["weight_sums"])
                pixels[in_band] *= normalising(weights.real, lines.channels)
        return layout.collect(pixels)

    def _needed_channels(
        self, lines: RangeLines, channels: slice, band: slice
    ) -> NDArray[np.int32]:
        """Return the first of some channels that each part of a band needs, and the end."""
        beam, along = self.scene.beam, self.scene.along
        key = "channels", channels.start, channels.stop, band.start, band.stop
        if key in self._kept:
            return self._kept[key]["ranges"]
        if beam is None or along is None:
            every = np.array([0, channels.stop - channels.start], np.int32)
            ranges = np.tile(every, (band.stop - band.start, 1))
        else:
            low, high = beam.limits
            limits = low - _MOST_SINE_ROUNDING, high + _MOST_SINE_ROUNDING
            track = BeamTrack(limits, lines.phase_centres_m[channels], along[channels])
            ranges = track.spans(self.layout.boxes(band)).ranges
        self._keep(key, {"ranges": ranges})
        return ranges

    def _references(
        self,
        block: RangeLines,
        channels: slice,
        parts: slice,
        needed: NDArray[np.int32],
        at_nodes_m: dict[int, NDArray[np.float64]],
    ) -> dict[str, NDArray]:
        """Return `references_of` some parts in a block of lines, from the image before if kept.

        `at_nodes_m` are the corrections of ranges along exact rays, by the first part. They serve
        all blocks of an image.
        """
        key = "references", channels.start, channels.stop, parts.start, parts.stop
        if key in self._kept:
            return self._kept[key]
        layout, corrections = self.layout, self.scene.water.corrections
        correction_m = None
        if corrections is not None:
            assert isinstance(layout, Groups)
            if parts.start not in at_nodes_m:
                at_nodes_m[parts.start] = corrections.at(layout.middle_pixels(parts))
            weights = corrections.weights(corrections.antennas[channels])
            correction_m = at_nodes_m[parts.start] @ weights.T
        centres_m, resampling = layout.centres_m(parts), self.decision.resampling
        found = references_of(centres_m, block, needed, resampling, self.blocks, correction_m)
        self._keep(key, found)
        return found

    def _keep(self, key: tuple[str, int, int, int, int], arrays: dict[str, NDArray]) -> None:
        """Keep arrays for the next image, unless all that is kept would take too much memory.

        Nobody may change them any more.
        """
        for array in arrays.values():
            array.flags.writeable = False
        size = sum(array.nbytes for array in arrays.values())
        if size <= self._free_bytes:
            self._kept[key] = arrays
            self._free_bytes -= size


class _Backprojection:
    """Backprojection on a device: its kernels, their buffers, and arguments that stay the same."""

    def __init__(self, imager: ExactImager, lines: RangeLines) -> None:
        self.scene, self.layout, self.blocks = imager.scene, imager.layout, imager.blocks
        self.device, self.lines, self.resampling = imager.device, lines, imager.decision.resampling
        device, decision, beam = imager.device, imager.decision, imager.scene.beam
        self.origin_m = self.layout.centres_m(slice(0, 1))[0]
        self.samples_per_m = self.resampling.samples_per_m(lines)
        self.beam = beam_table(device, beam, lines)
        self.arguments = {
            "line_pitch": self.blocks.pitch,
            "cycles_per_sample": self.resampling.cycles_per_m(lines) / self.samples_per_m,
            "filter": filter_table(device, decision.interpolator.coefficients),
            "phase_polynomials": phase_polynomials(device, decision.phase_terms),
            **self.beam.arguments,
        }
        # While one set of buffers is in use on the device, the other is filled.
        self.line_slots = itertools.cycle([Slot(device), Slot(device)])
        self.part_slots = itertools.cycle([Slot(device), Slot(device)])

        taps = decision.interpolator.taps
        options = {
            "WIDTH": device.info.width,
            "TAPS": taps,
            "BEAM": 0 if beam is None else INTERVALS,
            "ONE_CUBIC": int(decision.one_cubic),
            "NORMALISE": int(beam is not None and beam.normalise),
            "PHASE_TERMS": decision.phase_terms,
        }
        options |= lookup_options(device, self.layout, lines, self.samples_per_m, taps)
        paths = {
            "BISTATIC": int(lines.paths_differ),
            "MOVING": int(lines.rx_velocity_m_s is not None),
        }
        if isinstance(self.layout, Tiles):
            tile = {"TILE_ROWS": self.layout.side, "TILE_COLUMNS": self.layout.side}
            self.backproject = device.kernel("backproject_tiles", **options, **tile)
            self.expand = expansion_kernel(device, beam, **paths)
            self.corner = device.upload(np.zeros(2, np.int32))
        else:
            self.backproject = device.kernel("backproject_points", **options, **paths)

    def upload_lines(self, block: RangeLines, channels: slice) -> None:
        """Start copying the lines of some channels, upsampled, and their antennas to the device.

        `add` will use them. The antennas' geometry has the rows of cl/antennas.h.
        """
        blocks, along = self.blocks, self.scene.along
        slot = self.line_slot = next(self.line_slots)
        slot.wait()
        buffers = block_buffers(self.lines, block.channels, blocks, self.scene.beam)
        slot.make(buffers)
        samples = upsampled_lines(
            block.samples, self.resampling, self.device.info.width, blocks.margin, blocks.pitch
        )
        slot.fill("samples", samples)
        rows = [float_pairs(block.tx_m - self.origin_m)]
        if self.lines.paths_differ:
            rows.append(float_pairs(block.rx_m - self.origin_m))
        if block.rx_velocity_m_s is not None:
            rows.append((block.rx_velocity_m_s / block.sound_speed_m_s).astype(np.float32))
        if along is not None:
            rows.append((along[channels] * self.beam.per_sine).astype(np.float32))
        geometry = buffers["geometry"].holding(np.concatenate(rows, axis=1).T)
        slot.fill("geometry", geometry)
        self.geometry_pitch = geometry.shape[1]

    def add(
        self,
        parts: slice,
        ranges: NDArray[np.int32],
        references: dict[str, NDArray],
        sums: dict[str, Any],
        first_part: int,
    ) -> None:
        """Start adding the echoes of the uploaded lines to the pixels of some parts.

        Parameters
        ----------
        parts : slice
        ranges : int32 [parts, 2]
            First line that each part needs, and the one after the last.
        references : dict of str to array
            From `references_of`.
        sums : dict of str to Buffer
            Pixels of a band, and with a normalising beam the sums of their weights.
        first_part : int
            First part of the band.
        """
        device, layout, beam = self.device, self.layout, self.beam
        line_slot, slot = self.line_slot, next(self.part_slots)

        # Upload where the parts lie, which lines they need, and what the host has computed of them.
        slot.wait()
        count = parts.stop - parts.start
        most = int((ranges[:, 1] - ranges[:, 0]).max())
        slot.make(part_buffers(count, layout.part_pixels, most, self.blocks))
        slot.fill("centres", float_pairs(layout.centres_m(parts) - self.origin_m))
        slot.fill("ranges", np.column_stack([ranges, ranges[:, 0]]))
        for name, values in references.items():
            slot.fill(name, values)
        if isinstance(layout, Groups):
            slot.fill("offsets", layout.offset_m[parts].reshape(-1, 3).T)

        antennas: dict[str, Any] = {
            "geometry": line_slot["geometry"],
            "geometry_pitch": self.geometry_pitch,
            "centres": slot["centres"],
            "samples_per_m": self.samples_per_m,
        }
        of_parts: dict[str, Any] = {
            "ranges": slot["ranges"],
            "first_range": 0,
            "channel_pitch": channel_pitch(most),
        }
        uploaded = line_slot.filled + slot.filled
        items: tuple[int, ...]
        if isinstance(layout, Tiles):
            # Ranges are expanded about the centres of tiles first.
            device.run(
                self.expand,
                (channel_pitch(most) // device.info.width, count),
                **antennas,
                **of_parts,
                column_step=self.scene.grid.column_step_m,
                row_step=self.scene.grid.row_step_m,
                drift=(0.0, 0.0),
                **beam.origin,
                expansions=slot["expansions"],
                wait_for=uploaded,
            )
            items = (layout.part_pixels // item_pixels(device.info.width), count)
            positions: dict[str, Any] = {
                "expansions": slot["expansions"],
                "columns": layout.across * layout.side,
                "corners": self.corner,
                "tiles_down": layout.down,
                "tiles_across": layout.across,
                "first_tile": parts.start - first_part,
            }
        else:
            items = (device.in_whole_groups(count),)
            positions = antennas | {
                "offsets": slot["offsets"],
                "points": count * layout.part_pixels,
                "groups": count,
                "first_group": parts.start - first_part,
            }
        slot.busy = line_slot.busy = device.run(
            self.backproject,
            items,
            lines=line_slot["samples"],
            reference_sample=slot["sample"],
            reference_fraction=slot["fraction"],
            reference_phase=slot["phase"],
            **self.arguments,
            **of_parts,
            **positions,
            **sums,
            wait_for=uploaded,
        )
        device.queue.flush()


def references_of(
    centres_m: NDArray[np.float64],
    lines: RangeLines,
    ranges: NDArray[np.int32],
    resampling: Resampling,
    blocks: Blocks,
    correction_m: NDArray[np.float64] | None = None,
) -> dict[str, NDArray]:
    """Return the sample, its fraction and the phase of the echo of each centre in each line.

    Ranges are computed in float64. A reference consists of a whole sample, a fraction of a sample,
    and a phase in cycles, reduced to [-0.5, 0.5].

    Parameters
    ----------
    centres_m : float64 [parts, 3]
    lines : RangeLines
    ranges : int32 [parts, 2]
        First channel that each part needs, and the one after the last.
    resampling : Resampling
    blocks : Blocks
    correction_m : float64 [parts, channels], optional
        Corrections of the ranges.

    Returns
    -------
    dict of str to int32 or float32 [parts, channels]
        "sample", "fraction" and "phase", from the first channel in the range of each part.
    """
    visible = ranges[:, 1] > ranges[:, 0]
    count = int((ranges[:, 1] - ranges[:, 0]).max())
    if count == lines.channels and not ranges[:, 0].any():
        visible[:] = True
        range_m = pairwise_range_m(
            centres_m, lines.tx_m, lines.rx_m, lines.rx_velocity_m_s, lines.sound_speed_m_s
        )
        first_range_m = lines.first_range_m
        if correction_m is not None:
            range_m += correction_m
    else:
        first = ranges[visible, 0]
        range_m, first_range_m = _windowed_ranges(centres_m[visible], lines, first, count)
        if correction_m is not None:
            channel = np.minimum(first[:, None] + np.arange(count), lines.channels - 1)
            range_m += np.take_along_axis(correction_m[visible], channel, axis=1)
    position, cycles = resampling.places(range_m, first_range_m, lines)
    position += blocks.margin - resampling.first
    nearest = np.rint(position)
    position -= nearest
    # A part that lies completely outside a line is moved to where only zeros are read.
    nearest = np.clip(
        nearest,
        blocks.margin - blocks.reach,
        blocks.margin + resampling.length + blocks.reach,
    )
    shape = (len(centres_m), channel_pitch(count))
    references: dict[str, NDArray] = {
        "sample": np.zeros(shape, np.int32),
        "fraction": np.zeros(shape, np.float32),
        "phase": np.zeros(shape, np.float32),
    }
    for array, values in zip(references.values(), (nearest, position, cycles), strict=True):
        array[visible, :count] = values
    return references


def _windowed_ranges(
    centres_m: NDArray[np.float64], lines: RangeLines, first: NDArray[np.int32], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the ranges of centres to `count` channels from the first of each, [centres, count].

    The second result is the range of the first sample of these lines. The last channel is repeated.
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
        tx_m, rx_m, velocity_m_s = (
            np.stack([window(axis) for axis in each.T], axis=-1) for each in antennas
        )
        range_m = bistatic_range_m(
            centres_m[:, None], tx_m, rx_m, velocity_m_s, lines.sound_speed_m_s
        )
    else:
        range_m = distance_m(lines.tx_m)
        if not lines.is_monostatic:
            range_m += distance_m(lines.rx_m)
            range_m *= 0.5
    return range_m, window(lines.first_range_m)


# The sizes of what is on a device at once, from which its memory is also predicted


@dataclass(frozen=True)
class Blocks:
    """Sizes of a block of channels and of a set of parts, which are on a device at once.

    Attributes
    ----------
    reach : int
        Samples by which a part may extend beyond the end of a line.
    margin : int
        Zeros on either side of a line.
    pitch : int
        Samples of a line including both margins.
    terms : int
        Coefficients per (tile, channel); 0 for groups.
    channels_at_once, parts_at_once : int
        Channels of a block, and tiles or groups of a set.
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
    """Return the sizes of the blocks and sets of an image.

    Two blocks of lines take up to an eighth of the device's memory each, and two sets of references
    up to a sixteenth each.

    Raises
    ------
    ValueError
        If a single line is too long for a buffer.
    """
    reach = math.ceil(radius_m * resampling.samples_per_m(lines) * 1.1) + taps
    margin = 2 * reach + 2 * device.info.width
    pitch = padded_length(resampling, margin)
    terms = expansion_terms(beam) if tiled else 0
    line_bytes = 8 * pitch
    part_bytes = _CHANNELS_AT_ONCE * (16 + 4 * terms) + 12 * part_pixels
    most = device.info.max_buffer_bytes
    room = min(most, device.info.memory_bytes // _BLOCKS_IN_MEMORY)
    if line_bytes > most:
        raise ArgumentError(
            "lines",
            f"take at most {most / 2**10:.0f} KiB each when upsampled, which a buffer of "
            f"{device.info.label} can hold",
            f"{line_bytes / 2**10:.0f} KiB for {lines.length} samples",
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
    """Return the number of parts in a band of the image, which is made of whole rows of tiles.

    The pixels of a band, and its sums of weights, are on the device together.
    """
    most = min(device.info.max_buffer_bytes, device.info.memory_bytes // _BANDS_IN_MEMORY)
    return max(most // (8 * (1 + normalise) * part_pixels) // across, 1) * across


def block_buffers(
    lines: RangeLines, channels: int, blocks: Blocks, beam: BeamWindow | None
) -> Buffers:
    """Return the buffers of a block of channels: upsampled lines and the antennas' geometry.

    Parameters
    ----------
    lines : RangeLines
        All lines. Whether they are bistatic or moving determines the rows of the geometry.
    channels : int
        Number of channels of the block.
    blocks : Blocks
    beam : BeamWindow or None
    """
    return {
        "samples": Buffer((channels, blocks.pitch, 2), np.float32),
        "geometry": geometry_buffer(
            channel_pitch(channels),
            beam,
            bistatic=lines.paths_differ,
            moving=lines.rx_velocity_m_s is not None,
        ),
    }


def part_buffers(parts: int, part_pixels: int, channels: int, blocks: Blocks) -> Buffers:
    """Return the buffers of some parts in one job, except their pixels.

    Parameters
    ----------
    parts, part_pixels : int
        Number of tiles or groups of the job, and of pixels in each.
    channels : int
        Largest number of channels of a block that a part needs.
    blocks : Blocks
    """
    row = (parts, channel_pitch(channels))
    buffers = {
        "centres": Buffer((parts, 6), np.float32),
        "ranges": Buffer((parts, 3), np.int32),
        "sample": Buffer(row, np.int32),
        "fraction": Buffer(row, np.float32),
        "phase": Buffer(row, np.float32),
    }
    if blocks.terms:
        return buffers | {"expansions": Buffer((*row, blocks.terms), np.float32)}
    return buffers | {"offsets": Buffer((3, parts * part_pixels), np.float32)}
