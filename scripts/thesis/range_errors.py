"""Range errors of nearest beams, followed channel by channel through the stages of a plan."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

import clsas
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.lines import band_wavelength_m
from clsas.engine.data.surface import surface_of
from clsas.engine.factorized.track import mean_track
from clsas.engine.factorized.tree import Tree
from clsas.engine.factorized.virtual_channels import NearestBeams


def range_errors_m(
    plan: clsas.Plan, lines: clsas.RangeLines, grid: clsas.Grid, pixels: ArrayLike
) -> NDArray[np.float64]:
    """Return the range errors of a plan of nearest beams, followed stage by stage.

    Parameters
    ----------
    plan : Plan
        Plan made with at least one of `stages`.
    lines : RangeLines
        Lines without motion during flight.
    grid : Grid
        Grid on a plane.
    pixels : array_like of int, [n, 2]
        Rows and columns of the pixels.

    Returns
    -------
    ndarray of float64, shape [n, channels]
        Range at which a pixel reads the line of a channel, minus the true range, metres. Channels
        are in order along the track.

    Notes
    -----
    [42] and [43] are applied to every channel. In each stage, the line of a channel is shifted so
    that the range of the subimage's centre is correct for the mean position of the channels that
    are combined, which then replaces the position of the channel.
    """
    image = plan.factorization
    wavelength_m = band_wavelength_m(lines, image.resampling.centre_cycles_per_sample)
    track = mean_track(lines, wavelength_m)
    if track is None or not isinstance(image.aperture, NearestBeams) or not grid.is_planar:
        raise ValueError("plan must be made with stages, for these lines and a plane grid")
    order = np.argsort(track.coordinate, kind="stable")
    ends_m = lines.tx_m[order], lines.rx_m[order]
    tree = Tree(surface_of(grid), image.sides)
    index = np.asarray(pixels, np.int64)
    points_m = np.asarray(grid.origin_m) + index @ tree.surface.steps_m
    errors_m = -pairwise_range_m(points_m, *ends_m)
    position_m = lines.phase_centres_m[order]
    beam = np.arange(lines.channels)  # the beam of the previous stage to which each channel belongs
    for level, (side, beams) in enumerate(zip(image.sides, image.aperture.factors, strict=True)):
        centres_m = tree.centres_m(level, index // side * side)
        errors_m += pairwise_range_m(centres_m, *ends_m)[:, beam]
        starts = np.arange(0, len(position_m), beams)
        counts = np.diff(np.append(starts, len(position_m)))
        position_m = np.add.reduceat(position_m, starts) / counts[:, None]
        beam, ends_m = beam // beams, (position_m, position_m)
        errors_m -= pairwise_range_m(centres_m, *ends_m)[:, beam]
    return errors_m + pairwise_range_m(points_m, *ends_m)[:, beam]
