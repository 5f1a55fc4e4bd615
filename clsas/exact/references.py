"""References: ranges and phases of the centres of parts in float64, and the antennas' geometry.

A reference consists of a whole sample, a fraction of a sample, and a phase in cycles, reduced to
[-0.5, 0.5]. The device only computes differences from it.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from clsas.core.geometry import bistatic_range_m, pairwise_range_m
from clsas.core.lines import RangeLines
from clsas.exact.blocks import Blocks
from clsas.opencl.buffers import VECTOR_ROOM, channel_pitch, float_pairs
from clsas.signal.interpolation import Resampling


def geometry_rows(
    lines: RangeLines,
    origin_m: NDArray[np.float64],
    *,
    bistatic: bool,
    directions: NDArray[np.float64] | None,
) -> NDArray[np.float32]:
    """Return the antennas' geometry in the format of the kernels, float32 [rows, pitch].

    The rows contain positions relative to the origin, velocities of receivers over the speed of
    sound, and track directions (cl/antennas.h). They are padded, so that a vector may begin at the
    last channel.

    Parameters
    ----------
    lines : RangeLines
    origin_m : float64 [3]
    bistatic : bool
        Whether kernels need the positions of receivers.
    directions : float64 [channels, 3] or None
        Directions of the track times `BeamTable.per_sine`; None without a beam.
    """
    rows = [float_pairs(lines.tx_m - origin_m)]
    if bistatic:
        rows.append(float_pairs(lines.rx_m - origin_m))
    if lines.rx_velocity_m_s is not None:
        rows.append((lines.rx_velocity_m_s / lines.sound_speed_m_s).astype(np.float32))
    if directions is not None:
        rows.append(directions.astype(np.float32))
    pitch = channel_pitch(lines.channels) + VECTOR_ROOM
    geometry = np.concatenate(rows, axis=1).T
    return np.pad(geometry, ((0, 0), (0, pitch - lines.channels)), mode="edge")


def references_of(
    centres_m: NDArray[np.float64],
    lines: RangeLines,
    ranges: NDArray[np.int32],
    resampling: Resampling,
    blocks: Blocks,
    correction_m: NDArray[np.float64] | None = None,
) -> dict[str, NDArray]:
    """Return the sample, its fraction and the phase of the echo of each centre in each line.

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
    position = (range_m - first_range_m) / lines.range_step_m + resampling.lead
    range_m *= lines.carrier_cycles_per_m
    cycles = range_m + position * resampling.centre_cycles_per_sample
    cycles -= np.rint(cycles)
    position *= resampling.ratio
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
        if not np.array_equal(lines.tx_m, lines.rx_m):
            range_m += distance_m(lines.rx_m)
            range_m *= 0.5
    return range_m, window(lines.first_range_m)
