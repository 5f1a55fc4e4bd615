"""The predicted time and device memory of exact images."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from clsas.exact.blocks import Blocks, band_parts, blocks_of
from clsas.exact.decision import decide
from clsas.exact.groups import GroupsEstimate
from clsas.exact.tiles import Tiles
from clsas.factorized.estimates import Work, backprojecting, upsampling
from clsas.opencl.buffers import VECTOR_ROOM, channel_pitch
from clsas.opencl.device import Device
from clsas.planning.view import View
from clsas.sonar.beam import INTERVALS


@dataclass(frozen=True)
class Exact:
    """An exact image, as `clsas.backproject` forms it.

    Attributes
    ----------
    accuracy_db : float
        Its relative rms error.
    tiled, weighted : bool
        True where pixels lie in tiles of a plane, not in groups; where a beam weighs them.
    parts, part_pixels : int
        Number of tiles or groups, and of pixels in each.
    channels, seen : int, float
        Number of channels, and mean number that sees a part.
    taps, samples : int
        Of the interpolator, and of an upsampled line.
    memory_bytes : int
        Largest amount of device memory needed.
    """

    accuracy_db: float
    tiled: bool
    weighted: bool
    parts: int
    part_pixels: int
    channels: int
    seen: float
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
            self.seen,
            self.taps,
            tiled=self.tiled,
            weighted=self.weighted,
        )
        return Work(call=1.0) + lines + pixels


def expect(view: View, accuracy_db: float, device: Device) -> Exact:
    """Predict an exact image, by the same decision that forms it."""
    lines, beam = view.lines, view.beam
    decision = decide(
        lines,
        view.grid,
        device=device,
        accuracy_db=accuracy_db,
        spectrum=view.spectrum,
        left_open=view.ambiguity,
        beam=beam,
        along=view.channels_along,
        estimate=True,
    )
    layout, interpolator, resampling = decision.layout, decision.interpolator, decision.resampling
    tiled = isinstance(layout, Tiles)
    share = most = 1.0
    if beam is not None and view.track is not None:
        share, most = view.share_seen((16, 16)), view.share_seen((64, 64), most=True)
    blocks = blocks_of(
        device,
        lines,
        resampling,
        interpolator.taps,
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
        seen=share * lines.channels,
        taps=interpolator.taps,
        samples=resampling.length,
        memory_bytes=_memory_bytes(view, device, blocks, layout, most),
    )


def _memory_bytes(
    view: View,
    device: Device,
    blocks: Blocks,
    layout: Tiles | GroupsEstimate,
    most: float,
) -> int:
    """Return the device memory that `backproject.execute` takes.

    Of a part's, a block's and a band's buffers there are two where there are two jobs. `most` is
    the largest share of the channels that a part sees.
    """
    lines, beam = view.lines, view.beam
    parts, part_pixels = layout.parts, layout.part_pixels
    normalise = beam is not None and beam.normalise
    of_band = min(band_parts(device, part_pixels, layout.across, normalise), parts)
    of_job = min(blocks.parts_at_once, of_band)
    bands, jobs_of_set = -(-parts // of_band), -(-of_band // of_job)
    # Channels of the first set, and of the other that there is room for.
    first = min(blocks.channels_at_once, lines.channels)
    rest = lines.channels - first if bands == 1 else first
    sets = [first, min(first, rest)]

    moving = lines.rx_velocity_m_s is not None
    bistatic = moving or not np.array_equal(lines.tx_m, lines.rx_m)
    rows = 6 + 6 * bistatic + 3 * moving + 3 * (beam is not None)
    seen = [channel_pitch(min(n, math.ceil(most * lines.channels))) for n in sets]
    if jobs_of_set > 1:
        seen[1] = seen[0]
    part_bytes = 36 + (0 if blocks.terms else 12 * part_pixels)
    line_bytes = sum(
        8 * n * blocks.pitch + 4 * rows * (channel_pitch(n) + VECTOR_ROOM) for n in sets if n
    )
    job_bytes = sum(of_job * (part_bytes + n * (12 + 4 * blocks.terms)) for n in seen if n)
    band_bytes = 8 * (1 + normalise) * of_band * part_pixels
    table_bytes = 0 if beam is None else 16 * INTERVALS
    return int(min(bands, 2) * band_bytes + line_bytes + job_bytes + table_bytes)
