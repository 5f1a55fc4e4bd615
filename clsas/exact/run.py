"""Run of an exact image on its device, by the decision that was made for its scene."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from clsas.core.lines import RangeLines
from clsas.exact.blocks import band_parts, blocks_of
from clsas.exact.buffers import block_buffers, is_bistatic, part_buffers
from clsas.exact.decision import Decision
from clsas.exact.groups import Groups, GroupsEstimate
from clsas.exact.kept import Kept
from clsas.exact.lookup import lookup_options
from clsas.exact.references import geometry_rows, references_of
from clsas.exact.tiles import Tiles, item_pixels
from clsas.opencl.buffers import (
    Slot,
    beam_table,
    expansion_kernel,
    filter_table,
    float_pairs,
    phase_polynomials,
    pixel_buffers,
    slices,
    upsampled_lines,
)
from clsas.opencl.device import Device
from clsas.scene import Scene
from clsas.sonar.beam import INTERVALS, normalising
from clsas.sonar.visibility import BeamTrack

_SINE_ROUNDING = 1e-5  # upper bound on the device's rounding error of a sine
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
        self.kept = Kept(_MOST_KEPT_BYTES if keep else 0)

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
        layout, device, beam = self.layout, self.device, self.scene.beam
        pixels = np.empty(layout.parts * layout.part_pixels, np.complex64)
        normalise = beam is not None and beam.normalise
        run = _Run(self, lines, progress)
        at_once = band_parts(device, layout.part_pixels, layout.across, normalise)
        for band in slices(slice(0, layout.parts), at_once):
            part = slice(band.start * layout.part_pixels, band.stop * layout.part_pixels)
            buffers = pixel_buffers(part.stop - part.start, beam)
            on_device = {name: device.zeros(buffer.nbytes) for name, buffer in buffers.items()}
            for channels in slices(slice(0, lines.channels), run.blocks.channels_at_once):
                run.add(channels, band, on_device)
            cl.enqueue_copy(device.queue, pixels[part], on_device["pixels"])
            if normalise:
                sums = np.empty_like(pixels[part])
                cl.enqueue_copy(device.queue, sums, on_device["weight_sums"])
                pixels[part] *= normalising(sums.real, lines.channels)
        return layout.collect(pixels)


@dataclass(frozen=True, eq=False)
class _Job:
    """Some parts of a band and a block of channels, on which the device works in one launch.

    Attributes
    ----------
    line_slot, slot : Slot
        Buffers of the lines, and of the parts.
    geometry, ranges : dict
        Arguments of the kernels for antennas and centres, and for the channels of each part.
    parts : slice
        Parts of the image.
    first_part : int
        Number of the first part within the band.
    """

    line_slot: Slot
    slot: Slot
    geometry: dict[str, Any]
    ranges: dict[str, Any]
    parts: slice
    first_part: int

    @property
    def filled(self) -> list[cl.Event]:
        """Copies to the device for which kernels have to wait."""
        return self.line_slot.filled + self.slot.filled


class _Run:
    """Running image: its lines, kernels and buffers, and the number of pairs done."""

    def __init__(
        self,
        imager: ExactImager,
        lines: RangeLines,
        progress: Callable[[int, int], None] | None,
    ) -> None:
        scene, decision, device = imager.scene, imager.decision, imager.device
        self.scene, self.lines, self.decision, self.device = scene, lines, decision, device
        self.layout, self.kept, self.progress = imager.layout, imager.kept, progress
        resampling, taps = decision.resampling, decision.interpolator.taps
        self.samples_per_m = resampling.samples_per_m(lines)
        self.cycles_per_sample = resampling.cycles_per_m(lines) / self.samples_per_m
        self.bistatic = is_bistatic(lines)
        self.origin_m = self.layout.centres_m(slice(0, 1))[0]
        self.blocks = blocks_of(
            device,
            lines,
            resampling,
            taps,
            radius_m=self.layout.radius_m,
            part_pixels=self.layout.part_pixels,
            tiled=isinstance(self.layout, Tiles),
            beam=scene.beam,
        )
        paths = {
            "BISTATIC": int(self.bistatic),
            "MOVING": int(lines.rx_velocity_m_s is not None),
        }
        options = {
            "WIDTH": device.info.width,
            "TAPS": taps,
            "BEAM": 0 if scene.beam is None else INTERVALS,
            "ONE_CUBIC": int(decision.one_cubic),
            "NORMALISE": int(scene.beam is not None and scene.beam.normalise),
            "PHASE_TERMS": decision.phase_terms,
        }
        options |= lookup_options(device, self.layout, lines, self.samples_per_m, taps)
        if isinstance(self.layout, Tiles):
            tile = {"TILE_ROWS": self.layout.side, "TILE_COLUMNS": self.layout.side}
            self.kernel = device.kernel("backproject_tiles", **options, **tile)
            self.expand = expansion_kernel(device, scene.beam, **paths)
        else:
            self.kernel = device.kernel("backproject_points", **options, **paths)
        # While one set of buffers is in use on the device, the other is filled.
        self.line_slots = itertools.cycle([Slot(device), Slot(device)])
        self.part_slots = itertools.cycle([Slot(device), Slot(device)])
        self.filter = filter_table(device, decision.interpolator.coefficients)
        self.phase_polynomials = phase_polynomials(device, decision.phase_terms)
        self.beam = beam_table(device, scene.beam, lines)
        self.corner = device.upload(np.zeros(2, np.int32))
        self.at_nodes_m: dict[tuple[int, int], NDArray[np.float64]] = {}
        self.done = 0

    def add(self, channels: slice, band: slice, pixels: dict[str, Any]) -> None:
        """Add some channels to the pixels of a band of parts, and to the sums of their weights."""
        count = channels.stop - channels.start
        key = channels.start, channels.stop, band.start, band.stop
        ranges = self.kept.get(key, lambda: {"ranges": self._ranges(channels, band)})["ranges"]
        visible = ranges[:, 1] > ranges[:, 0]
        if not visible.any():
            self._report((band.stop - band.start) * count)
            return
        # Lines that no part needs are left out.
        first, end = int(ranges[visible].min()), int(ranges[visible].max())
        ranges = np.where(visible[:, None], ranges - np.int32(first), ranges)
        some = slice(channels.start + first, channels.start + end)
        lines, geometry, line_slot = self._upload_lines(some)
        for parts in slices(band, self.blocks.parts_at_once):
            of_parts = ranges[parts.start - band.start : parts.stop - band.start]
            if of_parts.any():
                job = self._job(lines, some, geometry, line_slot, parts, of_parts, band)
                job.slot.busy = line_slot.busy = self._launch(job, pixels)
                self.device.queue.flush()
            self._report((parts.stop - parts.start) * count)

    def _ranges(self, channels: slice, band: slice) -> NDArray[np.int32]:
        """Return the first channel and the end of those that each part of a band needs."""
        beam, along = self.scene.beam, self.scene.along
        if beam is None or along is None:
            every = np.array([0, channels.stop - channels.start], np.int32)
            return np.tile(every, (band.stop - band.start, 1))
        low, high = beam.limits
        limits = low - _SINE_ROUNDING, high + _SINE_ROUNDING
        track = BeamTrack(limits, self.lines.phase_centres_m[channels], along[channels])
        return track.spans(self.layout.boxes(band)).ranges

    def _upload_lines(self, channels: slice) -> tuple[RangeLines, dict[str, Any], Slot]:
        """Start copying upsampled lines and their antennas' geometry to the device.

        Returns the lines, the kernels' arguments for the geometry, and the slot with the buffers.
        """
        blocks, along = self.blocks, self.scene.along
        lines = self.lines.select(channels)
        slot = next(self.line_slots)
        slot.wait()
        slot.make(block_buffers(self.lines, lines.channels, blocks, self.scene.beam))
        samples = upsampled_lines(
            lines.samples,
            self.decision.resampling,
            self.device.info.width,
            blocks.margin,
            blocks.pitch,
        )
        slot.fill("samples", samples)
        directions = None if along is None else along[channels] * self.beam.per_sine
        rows = geometry_rows(lines, self.origin_m, bistatic=self.bistatic, directions=directions)
        slot.fill("geometry", rows)
        return lines, {"geometry": slot["geometry"], "geometry_pitch": rows.shape[1]}, slot

    def _job(
        self,
        lines: RangeLines,
        channels: slice,
        geometry: dict[str, Any],
        line_slot: Slot,
        parts: slice,
        ranges: NDArray[np.int32],
        band: slice,
    ) -> _Job:
        """Start copying the centres, ranges and references of some parts to the device."""
        slot = next(self.part_slots)
        slot.wait()
        layout = self.layout
        count = int((ranges[:, 1] - ranges[:, 0]).max())
        slot.make(part_buffers(len(ranges), layout.part_pixels, count, self.blocks))
        centres_m = layout.centres_m(parts)
        slot.fill("centres", float_pairs(centres_m - self.origin_m))
        slot.fill("ranges", np.column_stack([ranges, ranges[:, 0]]))
        references = self.kept.get(
            (channels.start, channels.stop, parts.start, parts.stop, band.start, band.stop),
            lambda: references_of(
                centres_m,
                lines,
                ranges,
                self.decision.resampling,
                self.blocks,
                self._correction_m(channels, parts),
            ),
        )
        for name, values in references.items():
            slot.fill(name, values)
        return _Job(
            line_slot,
            slot,
            geometry | {"centres": slot["centres"], "samples_per_m": self.samples_per_m},
            {
                "ranges": slot["ranges"],
                "first_range": 0,
                "channel_pitch": references["sample"].shape[1],
            },
            parts,
            parts.start - band.start,
        )

    def _correction_m(self, channels: slice, parts: slice) -> NDArray[np.float64] | None:
        """Return the corrections of ranges for some parts, [parts, channels], if there are any."""
        corrections = self.scene.water.corrections
        if corrections is None:
            return None
        layout, key = self.layout, (parts.start, parts.stop)
        assert isinstance(layout, Groups)
        if key not in self.at_nodes_m:  # along exact rays, once for all blocks of channels
            self.at_nodes_m[key] = corrections.at(layout.middle_pixels(parts))
        return self.at_nodes_m[key] @ corrections.weights(corrections.antennas[channels]).T

    def _launch(self, job: _Job, pixels: dict[str, Any]) -> cl.Event:
        """Run the kernels of a job; `pixels` are the pixel and weight buffers of its band."""
        layout, device = self.layout, self.device
        if isinstance(layout, Tiles):
            size, positions = self._expand(job, layout)
        else:
            offset_m = layout.offset_m[job.parts]
            job.slot.fill("offsets", offset_m.reshape(-1, 3).T)
            size = (device.in_whole_groups(len(offset_m)),)
            positions = job.geometry | {
                "offsets": job.slot["offsets"],
                "points": len(offset_m) * layout.part_pixels,
                "groups": len(offset_m),
                "first_group": job.first_part,
            }
        return device.run(
            self.kernel,
            size,
            lines=job.line_slot["samples"],
            line_pitch=self.blocks.pitch,
            **job.ranges,
            reference_sample=job.slot["sample"],
            reference_fraction=job.slot["fraction"],
            reference_phase=job.slot["phase"],
            cycles_per_sample=self.cycles_per_sample,
            filter=self.filter,
            phase_polynomials=self.phase_polynomials,
            **positions,
            **self.beam.arguments,
            **pixels,
            wait_for=job.filled,
        )

    def _expand(self, job: _Job, layout: Tiles) -> tuple[tuple[int, ...], dict[str, Any]]:
        """Expand ranges about the centres of a job's tiles.

        Returns the global size of the backprojection kernel, and its arguments for the tiles.
        """
        grid, device = self.scene.grid, self.device
        count = job.parts.stop - job.parts.start
        pitch = job.ranges["channel_pitch"]
        expansions = job.slot["expansions"]
        device.run(
            self.expand,
            (pitch // device.info.width, count),
            **job.geometry,
            **job.ranges,
            column_step=grid.column_step_m,
            row_step=grid.row_step_m,
            drift=(0.0, 0.0),
            **self.beam.origin,
            expansions=expansions,
            wait_for=job.filled,
        )
        size = (layout.part_pixels // item_pixels(device.info.width), count)
        return size, {
            "expansions": expansions,
            "columns": layout.across * layout.side,
            "corners": self.corner,
            "tiles_down": layout.down,
            "tiles_across": layout.across,
            "first_tile": job.first_part,
        }

    def _report(self, pairs: int) -> None:
        self.done += pairs
        if self.progress is not None:
            self.progress(self.done, self.layout.parts * self.lines.channels)
