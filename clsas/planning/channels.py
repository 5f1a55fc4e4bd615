"""The channels of a visibility model: their density, track errors and frequencies."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.aperture import phase_rates
from clsas.aperture.mean_track import MeanTrack
from clsas.core.geometry import pairwise_range_m
from clsas.core.lines import SAMPLED_CHANNELS, antennas_of, some_channels, steepest
from clsas.core.wavelengths import cycles_per_m_at
from clsas.planning.caching import cached, shared
from clsas.planning.sample_pixels import SPREAD_POINTS
from clsas.planning.subimages import Side
from clsas.planning.visibility_model import VisibilityModel

_NEIGHBOURS = 64  # channels over which density is measured; half or twice: no change
_SHEET_REFERENCES = 2.0  # references per channel of a sheet, measured with 54 000 channels
_WORST_CHANNELS = 32  # of the sampled channels: the loudest, or farthest from the mean track
_LEAST_FREQUENCY = 1e-3  # of the highest; below, phases are constant to virtual channels


def frequencies(model: VisibilityModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the phase per metre of range at the lines' frequencies, cycles, and shares of power.

    The phase is positive, whatever its sign in the lines.
    """
    found, power = model.spectrum.frequency, model.spectrum.share
    found = model.spectrum.centre + np.concatenate([-found[::-1], found])
    cycles_per_m = np.abs(cycles_per_m_at(model.lines, found))
    share = np.concatenate([power[::-1], power]) / 2
    return np.maximum(cycles_per_m, _LEAST_FREQUENCY * model.highest_cycles_per_m), share


def carriers(model: VisibilityModel, count: int) -> NDArray[np.float64]:
    """Return `count` of these frequencies, each of which represents the same power."""
    cycles_per_m, share = frequencies(model)
    index = np.interp((np.arange(count) + 0.5) / count, np.cumsum(share), np.arange(len(share)))
    return np.interp(index, np.arange(len(share)), cycles_per_m)


@shared
def track_error_m(model: VisibilityModel) -> NDArray[np.float64]:
    """Return the distances of the channels from the mean track, [channels].

    Receiver motion that differs from the mean is added, with its effect at the median range.
    """
    error_m = np.linalg.norm(model.track.offsets_m(model.lines.phase_centres_m), axis=1)
    drift = own_drift(model)
    if drift is not None:
        error_m += np.linalg.norm(drift, axis=1) * np.median(model.distance_m)
    return error_m


@shared
def own_drift(model: VisibilityModel) -> NDArray[np.float64] | None:
    """Return `clsas.aperture.phase_rates.own_drift` of the lines."""
    return phase_rates.own_drift(model.lines)


@shared
def peak_density(model: VisibilityModel) -> float:
    """Return the peak channel density along the aperture, relative to the mean.

    Many channels of a sheet may have the same coordinate along it, one in each of its rows.
    """
    at = np.sort(model.track.coordinate)
    rows = math.ceil(2 * math.sqrt(len(at))) if model.track.is_sheet else 1
    some = min(max(_NEIGHBOURS, rows), len(at) - 1)
    closest = float((at[some:] - at[:-some]).min())
    length = model.track.strips if model.track.strips > 1 else float(at[-1] - at[0])
    average = length * some / (len(at) - 1)
    return average / closest if closest > 0 else np.inf


@dataclass(frozen=True, eq=False)
class SampledChannels:
    """Sampled channels whose beam touches subimages of a size at some of the sample points.

    Attributes
    ----------
    model : VisibilityModel
    points : int64 [points]
        Sample points whose subimage the beam of any channel touches.
    index : int64 [n]
        Indices of the channels.
    weight : float64 [points, n]
        Power of all channels that each one represents; 0 where its beam misses the subimage.
    part : MeanTrack
        The mean track with these channels.
    """

    model: VisibilityModel
    points: NDArray[np.int64]
    index: NDArray[np.int64]
    weight: NDArray[np.float64]
    part: MeanTrack

    @property
    def phase_centres_m(self) -> NDArray[np.float64]:
        """Middles between transmitters and receivers, [n, 3]."""
        return self.model.lines.phase_centres_m[self.index]

    @property
    def antennas(self) -> tuple[Any, Any, Any, float]:
        """Positions of transmitters and receivers, velocities of receivers, and sound speed."""
        return antennas_of(self.model.lines, self.index)

    def virtual_m(self, centres_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the positions on the track at which points see the channels, [points, n, 3]."""
        drifts = own_drift(self.model)
        own = drifts if drifts is None else drifts[self.index]
        coordinates = self.part.apparent_coordinates(centres_m, self.phase_centres_m, own)
        return self.model.track.positions_m(*coordinates)


@cached
def sampled_channels(model: VisibilityModel, side: Side) -> SampledChannels:
    """Return sampled channels whose beam touches subimages of a size at the `SPREAD_POINTS`."""
    track, points = model.track, np.array(SPREAD_POINTS)
    visible = model.visible(side)[points]
    candidates = np.flatnonzero(np.interp(track.coordinate, track.samples, visible.any(axis=0)))
    index, weight = _some_of(model, candidates)
    part = track.some(index)
    sees = np.stack([np.interp(part.coordinate, track.samples, each) for each in visible]) > 0
    touched = sees.any(axis=1)
    return SampledChannels(model, points[touched], index, weight * sees[touched], part)


def _some_of(
    model: VisibilityModel, candidates: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return sampled channels, with the power that each represents.

    The loudest and those farthest from the mean track are always among them: a single loud channel,
    or a few where the track turns sharply, may cause a larger error than all others together.
    """
    power = model.channel_power
    if len(candidates) <= SAMPLED_CHANNELS:
        return candidates, power[candidates]
    error = track_error_m(model)[candidates] ** 2 * power[candidates]
    is_worst = np.zeros(len(candidates), bool)
    is_worst[np.argpartition(error, -_WORST_CHANNELS)[-_WORST_CHANNELS:]] = True
    others, worst = candidates[~is_worst], candidates[is_worst]
    some = others[some_channels(len(others), SAMPLED_CHANNELS - _WORST_CHANNELS)]
    scale = power[others].sum() / max(power[some].sum(), 1e-300)
    return np.concatenate([some, worst]), np.concatenate([scale * power[some], power[worst]])


def range_window_m(model: VisibilityModel, root: Side) -> tuple[float, float]:
    """Return the smallest and largest range of any pixel of roots, from the lines' first samples.

    Ranges to a pixel and to the middle of the grid differ at most by their distance, or by slightly
    more for moving receivers: see `clsas.core.lines.steepest`.
    """
    plane, lines = model.surface.plane, model.lines
    whole = -(-plane.shape[0] // root[0]) * root[0], -(-plane.shape[1] // root[1]) * root[1]
    origin_m: Any = plane.origin_m
    middle_m = (origin_m + (np.array(whole) - 1) / 2 @ model.surface.steps_m[:2])[None]
    relief_m = 0.0 if model.surface.is_plane else 2 * float(np.abs(model.surface.off_m).max())
    extents = model.surface.extents(whole, relief_m)
    radius_m = float(np.linalg.norm(np.abs(extents[:, None] * model.surface.steps_m).sum(axis=0)))
    radius_m *= steepest(lines) / 2
    range_m = model.from_cache(
        ("ranges", whole),
        lambda: (
            pairwise_range_m(
                middle_m, lines.tx_m, lines.rx_m, lines.rx_velocity_m_s, lines.sound_speed_m_s
            )[0]
            - lines.first_range_m
        ),
    )
    return float(range_m.min()) - radius_m, float(range_m.max()) + radius_m


def references(model: VisibilityModel) -> float:
    """Return the number of references of a root: one per channel, or more on a sheet.

    The host sorts the channels of a sheet by rows.
    """
    return model.lines.channels * (_SHEET_REFERENCES if model.track.is_sheet else 1.0)
