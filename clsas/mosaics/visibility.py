"""Visibility in surveys: which channels reach a patch with their beam and recorded ranges."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import MOST_TRACK_PINGS, BeamWindow
from clsas.engine.data.geometry import bistatic_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.visibility import BeamTrack, Boxes
from clsas.mosaics.survey import Survey

# Bytes per channel that finding the visibility takes, without and with a beam: measured with 1e6
# pings.
_CHANNEL_BYTES, _BEAM_CHANNEL_BYTES = 200, 400


@dataclass(frozen=True, eq=False)
class SurveyVisibility:
    """A survey and a beam, which determine the channels that contribute to a patch.

    Attributes
    ----------
    survey : Survey
    beam : BeamWindow or None
    along : float64 [channels, 3] or None
        Unit direction of the track at every channel; None without a beam.
    phase_centres_m : float64 [channels, 3]
    """

    survey: Survey
    beam: BeamWindow | None
    along: NDArray[np.float64] | None
    phase_centres_m: NDArray[np.float64]

    @classmethod
    def of(cls, survey: Survey, beam: BeamWindow | None) -> SurveyVisibility:
        """Return the visibility of a survey, with the directions of its track if there is a beam.

        Raises
        ------
        ValueError
            If the channels of the survey do not fit into memory.
        """
        per_channel = _CHANNEL_BYTES if beam is None else _BEAM_CHANNEL_BYTES
        validate.memory(f"the {survey.channels} channels of source", per_channel * survey.channels)
        geometry = survey.geometry
        along = None if beam is None else beam.directions(geometry)
        return cls(survey, beam, along, geometry.phase_centres_m)

    @property
    def settled(self) -> int:
        """Number of leading channels whose direction later channels cannot change."""
        if self.beam is None:
            return 0  # later channels may receive from any patch
        if self.beam.along is not None:
            return self.survey.channels
        pings = self.survey.geometry.ping_starts
        later = (self.beam.track_pings or MOST_TRACK_PINGS) // 2 + 1
        return int(pings[-later]) if len(pings) > 2 * later else 0

    def ranges_m(self, grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return bounds of the nearest and farthest range of a grid from every channel, metres."""
        centre_m, half_m = bounding_box(grid)
        geometry = self.survey.geometry
        middle_m = bistatic_range_m(centre_m, geometry.tx_m, geometry.rx_m)
        radius_m = np.linalg.norm(np.abs(half_m).sum(axis=0))
        extent_m = np.full(len(middle_m), radius_m + 2 * geometry.range_step_m)
        if geometry.rx_velocity_m_s is not None:
            speed = np.linalg.norm(geometry.rx_velocity_m_s, axis=1) / geometry.sound_speed_m_s
            extent_m += 1.1 * speed * (middle_m + radius_m)
        near_m, far_m = middle_m - extent_m, middle_m + extent_m
        if (profile := geometry.sound_speed) is not None:
            near_m = near_m * (geometry.sound_speed_m_s / profile.speed_m_s.max())
            far_m = far_m * (geometry.sound_speed_m_s / profile.speed_m_s.min())
        return near_m, far_m

    def channels(self, grid: Grid) -> NDArray[np.bool_]:
        """Return which channels may contribute to a grid, bool [channels]."""
        found = self.survey.within(*self.ranges_m(grid))
        if self._beam_track is not None:
            centre_m, half_m = bounding_box(grid)
            found &= self._beam_track.touching(Boxes.equal(centre_m[None], half_m))[0]
        return found

    @functools.cached_property
    def _beam_track(self) -> BeamTrack | None:
        if self.beam is None or self.along is None:
            return None
        return BeamTrack(self.beam.limits, self.phase_centres_m, self.along)

    def any_channel_from(self, first: int, grid: Grid) -> bool:
        """Return whether any channel from number `first` on may contribute to a grid."""
        return first < self.survey.channels and bool(self.channels(grid)[first:].any())

    def has_passed(self, grid: Grid, settled: int) -> bool:
        """Return whether the beam of the latest settled channel has passed a grid completely."""
        if self.beam is None or self.along is None or self.any_channel_from(settled, grid):
            return False
        centre_m, half_m = bounding_box(grid)
        offset_m = centre_m - self.phase_centres_m[settled - 1]
        direction = self.along[settled - 1]
        extent_m = np.abs(half_m @ direction).sum()
        low, away_m = max(self.beam.limits[0], -1.0), float(np.linalg.norm(offset_m))
        radius_m = float(np.linalg.norm(np.abs(half_m).sum(axis=0)))
        # The beam leaves the farthest point of the box last, or the nearest if it points ahead.
        distance_m = away_m + radius_m if low < 0 else max(away_m - radius_m, 0.0)
        return bool(direction @ offset_m + extent_m < low * distance_m)


def bounding_box(grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the centre of a box around a grid, and half its edges as vectors [n, 3], metres."""
    if grid.points_m is not None:
        low, high = (edge(grid.points_m, axis=(0, 1)) for edge in (np.min, np.max))
        return (low + high) / 2, np.diag((high - low) / 2)
    rows, columns = grid.shape
    origin_m, row_step_m, column_step_m = grid.vectors_m
    half_m = np.array([row_step_m * (rows - 1), column_step_m * (columns - 1)]) / 2
    centre_m = origin_m + half_m.sum(axis=0)
    if grid.height_m is None:
        return centre_m, half_m
    low, high = grid.height_m.min(), grid.height_m.max()
    up = np.array([0.0, 0.0, 1.0])
    return centre_m + up * (low + high) / 2, np.concatenate([half_m, [up * (high - low) / 2]])
