"""Errors of a factorized image besides those of its filters: roots, spacing and leaves."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from clsas.core.geometry import pairwise_range_m
from clsas.core.lines import SAMPLED_CHANNELS, some_channels, wavelength_m
from clsas.exact.layout import ROUNDING
from clsas.exact.tiles import BLOCKS
from clsas.factorized.aperture import drift, stretches
from clsas.factorized.thesis import stage_errors_m
from clsas.opencl.device import Device
from clsas.planning.caching import cached
from clsas.planning.channels import own_drift, track_error_m
from clsas.planning.sample_pixels import SPREAD_POINTS, mean_over_relief, pixels_m
from clsas.planning.spacing_errors import bias_error, filter_error, spacing_error
from clsas.planning.subimages import Side
from clsas.planning.visibility_model import VisibilityModel
from clsas.signal.interpolation import Interpolator
from clsas.sonar.visibility import sines

# Rms error of a phase in the stages over the phase across a root, from float32: measured. With half
# of it images at -60 dB are up to 3 % faster; with twice of it measured errors fall by 0.1 dB.
_FLOAT32 = 4.5e-8
_DENSE_CHANNELS = 2048  # of a dense aperture, from which channels are sampled
_FARTHEST_CHANNELS = 32  # of those sampled: far from the mean track, where it turns sharply


@dataclass(frozen=True)
class Errors:
    """Error powers of a tree besides those of its range filters.

    Attributes
    ----------
    aperture : float
        The aperture's filter, in all stages.
    roots : float
        Rounding, and channels that are replaced by places on the mean track.
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
    """Return the errors of a tree; `model` is that within its roots, whose error is known."""
    last = len(sides) - 1
    stages = [
        (side, aperture, denser, beam_cycles if level == last else 0.0)
        for level, (side, denser) in enumerate(zip(sides, oversampling, strict=True))
    ]
    filters = sum(filter_error(model, *stage) for stage in stages)
    return Errors(
        aperture=filters + bias_error(model, stages),
        roots=roots,
        spacing=tuple(spacing_error(model, *stage) for stage in stages),
        leaves=float(leaf_error(model, np.array([sides[-1]]), device)[0]),
    )


def leaf_error(
    model: VisibilityModel, sides: NDArray[np.int64], device: Device
) -> NDArray[np.float64]:
    """Return the error power that expanding a leaf adds, per size.

    As in `clsas.exact.tiles.lay_out`, the remainder is of fourth order; in long leaves its rms is
    0.35 of its maximum. Off a plane nothing is expanded, and float32 rounds.
    """
    if not model.surface.is_plane:
        radius_m = np.array([model.surface.radius_m(tuple(side)) for side in sides.tolist()])
        return (ROUNDING * model.highest_cycles_per_m * radius_m) ** 2
    steps_m = np.linalg.norm(model.surface.steps_m, axis=1)
    radius_m = np.hypot(*(sides * steps_m).T) / 2
    block_m = np.hypot(*(np.array(BLOCKS[device.info.width]) * steps_m)) / 2
    nearest_m = np.maximum(model.nearest_m, 1e-6)
    remainder_m = 0.35 * radius_m**4 / (8 * nearest_m**3)
    result = (2 * np.pi * model.highest_cycles_per_m * remainder_m) ** 2
    if model.beam is not None:
        result += model.beam.block_error(block_m / nearest_m) ** 2
        window_sine = np.ptp(np.clip(model.beam.limits, -1, 1))
        result += (0.1 * (radius_m / nearest_m) ** 4 / window_sine) ** 2
    return result


@cached
def root_error(model: VisibilityModel, side: Side) -> float:
    """Return the error power of roots: rounding, and channels replaced by the mean track."""
    replaced = mean_over_relief(model, side, functools.partial(_mean_track_error, model, side))
    sides_m = model.extents(side, most=True) * np.linalg.norm(model.surface.steps_m, axis=1)
    radius_m = np.linalg.norm(sides_m) / 2
    rounding = (2 * np.pi * _FLOAT32 * model.highest_cycles_per_m * radius_m) ** 2
    return float(replaced + rounding)


def _mean_track_error(model: VisibilityModel, side: Side, extents: NDArray[np.float64]) -> float:
    """Return the error power of channels that are replaced by places on the mean track.

    For sampled channels, roots and pixels: the change in range from a root's centre to a pixel,
    less the same change for the place on the mean track, stretched as the first stage does. This
    covers track errors, separate transmitters and receivers, and motion during flight. With a beam
    it adds the difference between the weights of the two.
    """
    lines, track = model.lines, model.track
    points = np.array(SPREAD_POINTS)
    visible = model.visible(side)[points]
    candidates = np.flatnonzero(np.interp(track.coordinate, track.samples, visible.any(axis=0)))
    if track.is_dense:
        candidates = candidates[some_channels(len(candidates), _DENSE_CHANNELS)]
    index, counts = _sampled_channels(model, candidates)
    part = track.some(index)
    tx_m, rx_m, middle_m = (each[index] for each in (lines.tx_m, lines.rx_m, lines.phase_centres_m))
    velocity, drifts = lines.rx_velocity_m_s, own_drift(model)
    moving = velocity if velocity is None else velocity[index]
    own = drifts if drifts is None else drifts[index]
    antennas = tx_m, rx_m, moving, lines.sound_speed_m_s
    visible = np.stack([np.interp(part.coordinate, track.samples, each) for each in visible]) > 0
    touched = visible.any(axis=1)
    points, visible = points[touched], visible[touched]
    if not points.size:
        return 0.0
    # [points, pixels, channels]; the first pixel is the centre of a root.
    offsets_m = np.stack([pixels_m(model, extents, point)[0] for point in points])
    points_m = model.points_m[points, None] + offsets_m
    centres_m, all_m = points_m[:, 0], points_m.reshape(-1, 3)
    range_m = pairwise_range_m(all_m, *antennas).reshape(*points_m.shape[:2], -1)
    virtual_m = track.positions_m(*part.apparent_places(centres_m, middle_m, own))
    virtual_range_m = np.stack([cdist(*each) for each in zip(points_m, virtual_m, strict=True)])
    virtual_range_m -= (points_m @ drift(lines))[..., None]
    change_m, virtual_change_m = (each[:, 1:] - each[:, :1] for each in (range_m, virtual_range_m))
    stretch = stretches(*antennas, drift(lines), model.surface.plane, centres_m, virtual_m)[:, None]
    stretched_m = virtual_change_m * stretch
    residual_m = change_m - virtual_change_m - stretched_m
    wrong = (2 * np.pi * model.highest_cycles_per_m * residual_m) ** 2
    # Lines are stretched by turning their phase; their envelope stays.
    wrong += (2 * np.pi * model.rms_cycles_per_m * stretched_m) ** 2
    weights = np.ones_like(wrong)
    if model.beam is not None and model.directions is not None:
        directions = model.directions.at(part.coordinate, part.across)
        virtual = [sines(*each, directions) for each in zip(points_m, virtual_m, strict=True)]
        channels = [sines(each, middle_m, model.channels_along[index]) for each in points_m]
        weights, of_virtual = (
            model.beam.weights(np.stack(each).swapaxes(1, 2)[:, 1:], wavelength_m(lines))
            for each in (channels, virtual)
        )
        wrong = weights**2 * wrong + (weights - of_virtual) ** 2
    counts = counts * visible[:, None]
    return float(np.sum(counts * wrong) / max(np.sum(counts * weights**2), 1e-30))


def _sampled_channels(
    model: VisibilityModel, candidates: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Sample channels, those farthest from the mean track among them; return their weights too.

    Where a track turns sharply, a few channels may be much farther off than all others.
    """
    if len(candidates) <= SAMPLED_CHANNELS:
        return candidates, np.ones(len(candidates))
    by_distance = candidates[np.argsort(track_error_m(model, candidates), kind="stable")]
    others, farthest = np.split(by_distance, [-_FARTHEST_CHANNELS])
    others.sort()
    some = others[some_channels(len(others), SAMPLED_CHANNELS - _FARTHEST_CHANNELS)]
    counts = np.repeat([len(others) / len(some), 1.0], [len(some), _FARTHEST_CHANNELS])
    return np.concatenate([some, farthest]), counts


def nearest_errors(
    model: VisibilityModel, stages: Sequence[tuple[int, int]]
) -> tuple[float, list[float]]:
    """Return the error power of nearest beams, THESIS [45], and that of each stage.

    Range errors are taken as spread evenly up to the bound. Those of stages add, not their powers.
    """
    centres_m = model.lines.phase_centres_m[np.argsort(model.track.coordinate)]
    spacing_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1).mean()
    image_m = np.max(np.array(model.grid.shape) * np.linalg.norm(model.surface.steps_m, axis=1))
    errors_m = stage_errors_m(stages, spacing_m, image_m, model.nearest_m)

    def power_of(error_m: float) -> float:
        return (2 * math.pi * model.lines.carrier_cycles_per_m * error_m) ** 2 / 3

    return power_of(sum(errors_m)), [power_of(error_m) for error_m in errors_m]
