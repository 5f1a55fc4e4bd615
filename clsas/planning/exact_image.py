"""What plain backprojection takes: time and device memory."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from clsas.core.lines import fastest
from clsas.exact import tiles as layout
from clsas.exact.backprojection import antennas_and_phase, fullness_of
from clsas.exact.lookup import most_upsampling
from clsas.exact.run import Blocks, band_parts, blocks_of
from clsas.exact.tiles import STACK, Tiles
from clsas.factorized.estimates import Work, backprojecting, upsampling
from clsas.opencl import phases
from clsas.opencl.buffers import VECTOR_ROOM, channel_pitch
from clsas.opencl.device import Device
from clsas.planning.view import View
from clsas.signal import interpolation
from clsas.sonar.beam import INTERVALS


@dataclass(frozen=True)
class Exact:
    """Plain backprojection, as `clsas.backproject` would prepare it.

    Attributes
    ----------
    accuracy_db : float
        Its relative rms error.
    tiled, weighted : bool
        Whether pixels lie in tiles of a plane, or in groups; whether a beam weighs them.
    parts, part_pixels : int
        How many tiles or groups, and pixels of each.
    channels, seen : int, float
        How many there are, and how many a part sees on average.
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
        """What it does."""
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
    """Return how an image would be backprojected plainly.

    What `clsas.backproject` decides before it starts; off a plane, where groups are not made for
    this, they are taken as full, and as wide as float32 allows.
    """
    lines, grid, beam, width = view.lines, view.grid, view.beam, device.info.width
    antennas_m, cycles_per_m = antennas_and_phase(lines, view.spectrum, beam)
    error = layout.allowed(accuracy_db)
    tiles = layout.tiles(
        grid,
        antennas_m,
        cycles_per_m,
        width,
        error=error,
        speed_ratio=fastest(lines),
        beam=beam,
        fullness=1.0 if beam is None else fullness_of(lines, grid, beam, view.channels_along),
    )
    if tiles is not None:
        parts, part_pixels, across, radius_m = (
            tiles.parts, tiles.part_pixels, tiles.across, tiles.radius_m,
        )  # fmt: skip
    else:
        part_pixels, across = STACK * width, 1
        parts = -(-grid.size // part_pixels)
        radius_m = min(
            layout.largest_radius_m(cycles_per_m, len(antennas_m)),
            lines.length * lines.range_step_m,
        )
    block_m = Tiles(grid, 16, width).lookup_radius_m if grid.is_planar else 0.0
    interpolator = interpolation.choose(
        view.spectrum,
        view.ambiguity.rest_db(accuracy_db),
        other_error=math.hypot(error, phases.error(phases.terms_within(accuracy_db))),
        pixels_per_sample=grid.size / lines.length,
        most_upsampling=most_upsampling(device, lines, block_m),
    )
    resampling = interpolation.resampling(lines.length, interpolator, view.spectrum)
    share = most = 1.0
    if beam is not None and view.track is not None:
        share, most = view.share_seen((16, 16)), view.share_seen((64, 64), most=True)
    blocks = blocks_of(
        device,
        lines,
        resampling,
        interpolator.taps,
        radius_m=radius_m,
        part_pixels=part_pixels,
        tiled=tiles is not None,
        beam=beam,
    )
    return Exact(
        accuracy_db=accuracy_db,
        tiled=tiles is not None,
        weighted=beam is not None,
        parts=parts,
        part_pixels=part_pixels,
        channels=lines.channels,
        seen=share * lines.channels,
        taps=interpolator.taps,
        samples=resampling.length,
        memory_bytes=_memory_bytes(view, device, blocks, parts, part_pixels, across, most),
    )


def _memory_bytes(
    view: View,
    device: Device,
    blocks: Blocks,
    parts: int,
    part_pixels: int,
    across: int,
    most: float,
) -> int:
    """Return the device memory that `backproject.execute` takes.

    Of a part's, a block's and a band's buffers there are two where there are two jobs. `most` is
    the largest share of the channels that a part sees.
    """
    lines, beam = view.lines, view.beam
    normalise = beam is not None and beam.normalise
    of_band = min(band_parts(device, part_pixels, across, normalise), parts)
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
