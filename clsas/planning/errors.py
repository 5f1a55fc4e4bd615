"""Errors of a factorized image other than those of its range filters."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from clsas.aperture.nearest import stage_errors_m
from clsas.aperture.phase_rates import drift, stretches
from clsas.core.geometry import pairwise_range_m
from clsas.core.wavelengths import wavelength_m
from clsas.exact.layout import ROUNDING
from clsas.exact.tiles import BLOCKS
from clsas.opencl.device import Device
from clsas.planning.caching import cached
from clsas.planning.channels import SampledChannels, sampled_channels
from clsas.planning.sample_pixels import mean_over_relief, pixels_m
from clsas.planning.spacing_errors import (
    SpacedStage,
    Stages,
    bias_error,
    filter_error,
    spacing_error,
)
from clsas.planning.stretches import stretch_of
from clsas.planning.subimages import Side
from clsas.planning.visibility_model import VisibilityModel
from clsas.signal.interpolation import Interpolator
from clsas.sonar.beam import BeamWindow
from clsas.sonar.visibility import sines

# Rms error of a phase in the stages, from float32, over the phase across a root: measured. With
# half of it, images at -60 dB are up to 3 % faster; with twice, measured errors fall by 0.1 dB.
_FLOAT32 = 4.5e-8
# Largest error power of a leaf over the mean of all. The error grows with the sixth power of the
# inverse distance, and the nearest pixels may be the brightest. Images of an ultrasound array of
# 20 mm from 6 mm on keep -40 dB with 64 too, if only the nearest 3 % of the pixels are bright; with
# 4, no leaf of some of them is small enough. Half or twice changes no scene of
# `scripts/bench sensitivity`.
_MOST_OF_MEAN = 16.0


@dataclass(frozen=True)
class Errors:
    """Error powers of a tree other than those of its range filters.

    Attributes
    ----------
    aperture : float
        The filter along the aperture, in all stages.
    roots : float
        Rounding, and channels that are replaced by positions on the mean track.
    spacing : tuple of float
        Uneven spacing of virtual channels, and beam weights that change between them, by stage.
    leaves : float
        Expansion of ranges and weights in the leaves.
    """

    aperture: float
    roots: float
    spacing: tuple[float, ...]
    leaves: float


def other_errors(
    model: VisibilityModel,
    sides: Sequence[Side],
    roots: float,
    aperture: Interpolator,
    oversampling: tuple[float, ...],
    beam_cycles: float,
    device: Device,
) -> Errors:
    """Return the errors of a tree. `model` must have its root size; `roots` is its root error."""
    stages = spaced_stages(sides, aperture, oversampling, beam_cycles)
    each_stage = [stages[: level + 1] for level in range(len(stages))]
    filters = sum(filter_error(model, to) for to in each_stage)
    return Errors(
        aperture=filters + bias_error(model, stages),
        roots=roots,
        spacing=tuple(spacing_error(model, to) for to in each_stage),
        leaves=float(leaf_error(model, np.array([sides[-1]]), device)[0]),
    )


def spaced_stages(
    sides: Sequence[Side],
    aperture: Interpolator,
    oversampling: tuple[float, ...],
    beam_cycles: float | None,
) -> Stages:
    """Return the stages of a tree. Only the virtual channels of the last stage follow the beam."""
    last = len(sides) - 1
    return tuple(
        SpacedStage(side, aperture, denser, beam_cycles if level == last else 0.0)
        for level, (side, denser) in enumerate(zip(sides, oversampling, strict=True))
    )


def leaf_error(
    model: VisibilityModel, sides: NDArray[np.int64], device: Device
) -> NDArray[np.float64]:
    """Return the error power of expanding ranges and weights in leaves, [sizes].

    As in `clsas.exact.tiles.lay_out`, the remainder is of fourth order; in long leaves its rms is
    0.35 of its maximum. It is averaged over the pixels, among which the nearest have the largest
    error. Off a plane nothing is expanded, and the error is float32's rounding.
    """
    if not model.surface.is_plane:
        radius_m = np.array([model.surface.radius_m(tuple(side)) for side in sides.tolist()])
        return (ROUNDING * model.highest_cycles_per_m * radius_m) ** 2
    steps_m = np.linalg.norm(model.surface.steps_m, axis=1)
    radius_m = np.hypot(*(sides * steps_m).T)[:, None] / 2
    block_m = np.hypot(*(np.array(BLOCKS[device.info.width]) * steps_m)) / 2
    distance_m = np.maximum(model.distances_m, 1e-6)
    remainder_m = 0.35 * radius_m**4 / (8 * distance_m**3)
    result = (2 * np.pi * model.highest_cycles_per_m * remainder_m) ** 2
    if model.beam is not None:
        result += [model.beam.block_error(reach) ** 2 for reach in block_m / distance_m]
        window_sine = np.ptp(np.clip(model.beam.limits, -1, 1))
        result += (0.1 * (radius_m / distance_m) ** 4 / window_sine) ** 2
    return np.maximum(result.mean(axis=1), result[:, 0] / _MOST_OF_MEAN)


@cached
def root_error(model: VisibilityModel, side: Side) -> float:
    """Return the error power of roots: rounding, and channels replaced by the mean track."""
    replaced = mean_over_relief(model, side, functools.partial(_mean_track_error, model, side))
    sides_m = model.extents(side, most=True) * np.linalg.norm(model.surface.steps_m, axis=1)
    radius_m = np.linalg.norm(sides_m) / 2
    rounding = (2 * np.pi * _FLOAT32 * model.highest_cycles_per_m * radius_m) ** 2
    return float(replaced + rounding)


def _mean_track_error(model: VisibilityModel, side: Side, extents: NDArray[np.float64]) -> float:
    """Return the error power of channels that are replaced by positions on the mean track.

    This covers track errors, separate transmitters and receivers, and motion during flight. With a
    beam it adds the difference between the weights of the two.
    """
    channels = sampled_channels(model, side)
    if not channels.points.size:
        return 0.0
    # [points, pixels, channels]; the first pixel is the centre of a root.
    offsets_m = np.stack([pixels_m(model, extents, point)[0] for point in channels.points])
    points_m = model.points_m[channels.points, None] + offsets_m
    virtual_m = channels.virtual_m(points_m[:, 0])
    error = phase_error(model, channels, points_m, virtual_m)
    if model.beam is None:
        return relative_error(channels.weight, error, np.ones_like(error))
    weights, of_virtual = beam_weights(model, model.beam, channels, points_m, virtual_m)
    return relative_error(
        channels.weight, weights**2 * error + (weights - of_virtual) ** 2, weights
    )


def relative_error(
    channel_power: NDArray[np.float64], error: NDArray[np.float64], weights: NDArray[np.float64]
) -> float:
    """Return the power of errors over that of the contributions to an image.

    Parameters
    ----------
    channel_power : float64 [points, channels]
    error : float64 [points, pixels, channels]
        Error power of each contribution, for channels of unit power.
    weights : float64 [points, pixels, channels]
        Weights of the contributions; 1 without a beam.
    """
    channel_power = channel_power[:, None]
    image_power = max(np.sum(channel_power * weights**2), 1e-30)
    return float(np.sum(channel_power * error) / image_power)


def phase_error(
    model: VisibilityModel,
    channels: SampledChannels,
    points_m: NDArray[np.float64],
    virtual_m: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the error power of phases and envelopes, float64 [points, pixels - 1, channels].

    Channels are replaced by positions on the mean track that have the same range to the centre of a
    root. Their phase is wrong by the difference between the changes of both ranges from the centre
    to a pixel. The first stage makes up for a part of it by stretching the range from the virtual
    position.

    Parameters
    ----------
    model : VisibilityModel
    channels : SampledChannels
    points_m : float64 [points, pixels, 3]
        The centre of a root at each sample point, and then pixels of the root.
    virtual_m : float64 [points, channels, 3]
        Positions on the mean track that replace the channels.
    """
    along, stretch = drift(model.lines), stretch_of(model)
    range_m = pairwise_range_m(points_m.reshape(-1, 3), *channels.antennas)
    range_m = range_m.reshape(*points_m.shape[:2], -1)
    virtual_range_m = np.stack([cdist(*each) for each in zip(points_m, virtual_m, strict=True)])
    virtual_range_m -= (points_m @ along)[..., None]
    change_m, virtual_change_m = (each[:, 1:] - each[:, :1] for each in (range_m, virtual_range_m))
    of_channels = stretches(
        *channels.antennas, along, model.surface.plane, points_m[:, 0], virtual_m
    )[:, None]
    residual_m = change_m - virtual_change_m * (1 + of_channels)
    # A line's phase follows its channel's stretch, its envelope the mean of all.
    envelope_m = virtual_change_m * (of_channels - stretch.mean)
    error = (2 * np.pi * model.highest_cycles_per_m * residual_m) ** 2
    error += (2 * np.pi * model.rms_cycles_per_m * envelope_m) ** 2
    return error


def beam_weights(
    model: VisibilityModel,
    beam: BeamWindow,
    channels: SampledChannels,
    points_m: NDArray[np.float64],
    virtual_m: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a beam's weights of channels and of the positions that replace them.

    Arguments and shapes are those of `phase_error`.
    """
    assert model.directions is not None
    assert model.scene.along is not None
    part, along = channels.part, model.scene.along[channels.index]
    directions = model.directions.at(part.coordinate, part.across)
    virtual = [sines(*each, directions) for each in zip(points_m, virtual_m, strict=True)]
    real = [sines(each, channels.phase_centres_m, along) for each in points_m]
    weights, of_virtual = (
        beam.weights(np.stack(each).swapaxes(1, 2)[:, 1:], wavelength_m(model.lines))
        for each in (real, virtual)
    )
    return weights, of_virtual


def nearest_errors(
    model: VisibilityModel, stages: Sequence[tuple[int, int]]
) -> tuple[float, list[float]]:
    """Return the error power of nearest beams, and that of each stage.

    Range errors are assumed to be spread evenly up to the bound of Ødegaard (2004), eq. [45]. The
    errors of stages add, not their powers.
    """
    centres_m = model.lines.phase_centres_m[np.argsort(model.track.coordinate)]
    spacing_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1).mean()
    image_m = np.max(np.array(model.grid.shape) * np.linalg.norm(model.surface.steps_m, axis=1))
    errors_m = stage_errors_m(stages, spacing_m, image_m, model.nearest_m)

    def power_of(error_m: float) -> float:
        return (2 * math.pi * model.lines.carrier_cycles_per_m * error_m) ** 2 / 3

    return power_of(sum(errors_m)), [power_of(error_m) for error_m in errors_m]
