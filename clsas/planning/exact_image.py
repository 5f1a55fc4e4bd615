"""The predicted time and device memory of exact images."""

from __future__ import annotations

import math
from dataclasses import dataclass

from clsas.exact.blocks import Blocks, band_parts, blocks_of
from clsas.exact.buffers import block_buffers, part_buffers
from clsas.exact.decision import decide
from clsas.exact.groups import Groups, GroupsEstimate
from clsas.exact.tiles import STACK, Tiles
from clsas.opencl.buffers import beam_buffers, pixel_buffers, total_bytes
from clsas.opencl.device import Device
from clsas.planning.visibility_model import VisibilityModel
from clsas.planning.work import backprojecting, upsampling
from clsas.plans.predictions import Work
from clsas.scene import Scene

WORTHWHILE_CHANNELS = 30
"""Fewest channels per pixel with which factorized images were faster than exact ones at -40 dB.
Images had 1024 x 1024 pixels (`scripts/thesis/section_7_1.py`, docs/thesis-systems.md)."""

_LARGE = (64, 64)  # rows and columns of a subimage as large as any part of an exact image


@dataclass(frozen=True)
class Exact:
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


def expect(
    scene: Scene, accuracy_db: float, device: Device, model: VisibilityModel | None
) -> Exact:
    """Return the prediction of an exact image, by the same decision that forms it.

    `model` is that of the scene, in which the part that a beam covers is known.
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
    if beam is not None and model is not None:
        share, most = model.visible_share(model.small), model.visible_share(_LARGE, most=True)
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
    return Exact(
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
    """Return the device memory that `clsas.exact.run` needs.

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


def worthwhile(model: VisibilityModel | None, exact: Exact) -> str:
    """Return how many channels receive from a pixel, and from how many a factorization pays.

    The sentence is "" for grids off a plane, and for several passes and other dense apertures: the
    rule was not measured for them.
    """
    if model is None or not model.surface.is_plane or model.track.is_dense:
        return ""
    return (
        f"About {exact.visible_channels:.0f} channels receive from each pixel; factorization "
        f"usually pays from about {WORTHWHILE_CHANNELS} on, in images of 1000 x 1000 pixels or more"
    )
