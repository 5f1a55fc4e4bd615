"""Geometry of a survey, from which `clsas.limits` computes its results.

Equations in brackets are those of the thesis (Ødegaard 2004).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.declared import check_declared
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import some_channels
from clsas.engine.data.system import Sonar
from clsas.engine.data.track import Pointing, Track, channels
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.visibility import sines
from clsas.engine.signal.compression import Window, compress
from clsas.inspection.sampling import corners_of, course, grating_lobe_m
from clsas.measures.resolution import (
    View,
    azimuth_width_m,
    beam_directions,
    grating_lobe_db,
    view,
)

_CHANNELS = 1024  # channels whose ranges to the grid are computed, beside the first and last ping
_POINTS = 16  # grid points along either side for these ranges; the corners are among them
_STRAIGHT = 0.9  # length of a track over the path along it, below which the track is too curved
_ALONG = 0.01  # share of the array's extent that lies along the track, below which it is across


@dataclass(frozen=True, eq=False)
class Survey:
    """Arguments of `limits`, and the geometry that follows from them."""

    sonar: Sonar
    track: Track | None
    grid: Grid | None
    beam: BeamWindow | None
    range_m: Sequence[float] | None
    window: Window
    pointing: Pointing | None
    element_pattern: bool
    motion_in_flight: bool

    def __post_init__(self) -> None:
        """Check every argument."""
        validate.instance("sonar", self.sonar, Sonar)
        kinds = {"track": Track, "grid": Grid, "beam": BeamWindow, "pointing": Pointing}
        for name, kind in kinds.items():
            if getattr(self, name) is not None:
                validate.instance(name, getattr(self, name), kind)
        if self.range_m is not None:
            near_m, far_m = validate.array("range_m", self.range_m, np.float64, (2,)).tolist()
            if not 0 <= near_m < far_m:
                allowed = "be 0 <= nearest < farthest in m"
                raise ArgumentError("range_m", allowed, (near_m, far_m))
            object.__setattr__(self, "range_m", (near_m, far_m))
        check_declared(compress, {"window": self.window})
        for name in ("element_pattern", "motion_in_flight"):
            object.__setattr__(self, name, validate.flag(name, getattr(self, name)))
        if self.distance_m == 0:
            raise ArgumentError("grid", "not have its middle at a phase centre of the track")

    @property
    def element_m(self) -> float | None:
        """Length L of the elements."""
        return self.sonar.element_length_m

    @property
    def is_moving(self) -> bool:
        """True if the track has pings at different positions."""
        return self.track is not None and bool(np.ptp(self.track.positions_m, axis=0).any())

    @cached_property
    def antennas_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Transmitter and receiver of every channel, [channels, 3]."""
        track = self.track or Track(np.zeros((1, 3)), np.zeros(1))
        tx, rx, _ = channels(self.sonar, track)
        return tx, rx

    @cached_property
    def centres_m(self) -> NDArray[np.float64]:
        """Phase centres [32], [channels, 3]."""
        return (self.antennas_m[0] + self.antennas_m[1]) / 2

    @cached_property
    def along(self) -> NDArray[np.float64]:
        """Unit vector along the track, or along the array if there is no track."""
        return course(self.centres_m)

    @cached_property
    def steps_m(self) -> NDArray[np.float64]:
        """Advance of every ping along the track."""
        assert self.track is not None
        return np.abs(np.diff(self.track.positions_m @ self.along))

    @cached_property
    def is_straight(self) -> bool:
        """True if the course of the track describes it."""
        if self.track is None or not self.is_moving:
            return True
        path_m = np.linalg.norm(np.diff(self.track.positions_m, axis=0), axis=1).sum()
        return bool(np.ptp(self.track.positions_m @ self.along) > _STRAIGHT * path_m)

    @property
    def interval_s(self) -> float | None:
        """Shortest time between pings; None if there is only one."""
        if self.track is None or self.track.pings < 2:
            return None
        return float(np.diff(self.track.time_s).min())

    @cached_property
    def is_array(self) -> bool:
        """True if the receivers extend along the track."""
        extent_m = float(np.ptp(self.ping_m @ self.along))
        return extent_m > _ALONG * float(np.linalg.norm(np.ptp(self.ping_m, axis=0)))

    @cached_property
    def array_m(self) -> float | None:
        """Extent of the phase centres of a ping along the track, half the length of the array.

        Every phase centre extends over the distance to its neighbour, or, if it is the only one,
        over half an element. None if there is one omnidirectional element.
        """
        if not self.is_array:
            return None if self.element_m is None else self.element_m / 2
        return _length_m(self.ping_m @ self.along)

    @property
    def ping_m(self) -> NDArray[np.float64]:
        """Phase centres of the first ping, [receivers, 3]."""
        return self.centres_m[: self.sonar.receivers]

    @cached_property
    def extents_m(self) -> tuple[float, float] | None:
        """Nearest and farthest range of the grid within the beam, or else those recorded."""
        if self.grid_extents_m is not None or self.range_m is None:
            return self.grid_extents_m
        near_m, far_m = self.range_m
        return near_m, far_m

    @cached_property
    def grid_extents_m(self) -> tuple[float, float] | None:
        """Nearest and farthest range at which pixels lie within the beam; None if not known."""
        if self.grid is None or self.track is None:
            return None
        tx, rx = self.antennas_m
        each = self.sonar.receivers
        ends = np.concatenate([np.arange(each), np.arange(len(tx) - each, len(tx))])
        some = np.unique(np.concatenate([ends, some_channels(len(tx), _CHANNELS)]))
        points_m = np.concatenate([corners_of(self.grid), self.grid.spread(_POINTS)])
        range_m = pairwise_range_m(points_m, tx[some], rx[some])
        if self.beam is not None and self.is_moving:
            low, high = self.beam.limits
            directions = beam_directions(self.sonar, tx, rx, self.beam)[some]
            sine = sines(points_m, self.centres_m[some], directions).T
            seen = (sine > low) & (sine < high)
            if seen.any():
                range_m = range_m[seen]
        return float(range_m.min()), float(range_m.max())

    @cached_property
    def point_m(self) -> NDArray[np.float64] | None:
        """The point in the middle; None if its range is not known."""
        if self.grid is not None and self.track is not None:
            middle = np.ravel_multi_index([(n - 1) // 2 for n in self.grid.shape], self.grid.shape)
            next_to = np.ravel_multi_index([n // 2 for n in self.grid.shape], self.grid.shape)
            return self.grid.at(np.array([middle, next_to])).mean(axis=0)
        if self.range_m is None:
            return None
        aside = np.array([-self.along[1], self.along[0], 0.0])
        if not aside.any():  # a vertical track
            aside[1] = 1.0
        aside /= np.linalg.norm(aside)
        return self.centres_m.mean(axis=0) + np.mean(self.range_m) * aside

    @property
    def distance_m(self) -> float | None:
        """Range of the point in the middle from the nearest phase centre."""
        if self.point_m is None:
            return None
        return float(np.linalg.norm(self.centres_m - self.point_m, axis=1).min())

    @cached_property
    def view(self) -> View | None:
        """The channels, as the point in the middle sees them."""
        if self.point_m is None or self.track is None or not self.is_moving:
            return None
        return view(
            self.sonar,
            self.track,
            self.point_m,
            beam=self.beam,
            pointing=self.pointing,
            element_pattern=self.element_pattern,
        )

    @cached_property
    def width_m(self) -> float | None:
        """The -3 dB width of the point in the middle along the track; None without an aperture."""
        if self.view is None:
            return None
        width_m = azimuth_width_m(self.view, self.sonar.wavelength_m)
        return width_m if math.isfinite(width_m) else None

    @cached_property
    def aperture_m(self) -> float:
        """Length of the synthetic aperture of the point in the middle."""
        assert self.view is not None
        seen = self.view.beam_weights(self.view.point_m[None])[0] > 0
        return _length_m((self.centres_m @ self.along)[seen])

    @cached_property
    def spacing_m(self) -> float:
        """Largest gap between neighbouring phase centres along the track; 0 if there is one."""
        return float(np.diff(np.sort(self.centres_m @ self.along)).max(initial=0.0))

    @cached_property
    def pitch_m(self) -> float:
        """Regular spacing of the phase centres: that of the array, or the usual advance."""
        if self.is_array:
            return _usual_gap_m(self.ping_m @ self.along)
        return float(np.median(self.steps_m)) if self.is_moving else 0.0

    @property
    def lobe_m(self) -> float | None:
        """Distance of the first grating lobes from a target in the middle [26], if known."""
        if self.distance_m is None or not self.pitch_m:
            return None
        return grating_lobe_m(self.sonar.wavelength_m, self.pitch_m, self.distance_m)

    @property
    def ping_lobe_m(self) -> float | None:
        """The same for the spacing of the pings of an array."""
        if self.distance_m is None or not self.is_moving or not self.is_array:
            return None
        step_m = float(np.median(self.steps_m))
        return grating_lobe_m(self.sonar.wavelength_m, step_m, self.distance_m) if step_m else None

    def lobe_db(self, lobe_m: float) -> float | None:
        """Return the level of lobes at a distance from a target in the middle, if known."""
        if self.view is None or self.width_m is None:
            return None
        if lobe_m not in self._levels_db:
            level_db = grating_lobe_db(self.sonar, self.view, lobe_m, self.width_m, self.window)
            self._levels_db[lobe_m] = min(level_db, 0.0)
        level_db = self._levels_db[lobe_m]
        return level_db if math.isfinite(level_db) else None

    @cached_property
    def _levels_db(self) -> dict[float, float]:
        """Levels of lobes that have been computed, by their distances."""
        return {}

    @cached_property
    def beam_sines(self) -> tuple[float, float] | None:
        """Sines of the angles between which the beam, or else that of an element, extends."""
        pointing = self.pointing or Pointing()
        if self.beam is not None:
            return _clipped(*self.beam.limits_rad)
        if self.element_m is not None and self.element_pattern and pointing.spot_m is None:
            of_element = BeamWindow.of_element(self.element_m, self.sonar.wavelength_m)
            low, high = of_element.limits_rad
            return _clipped(low + min(pointing.squint_rad), high + max(pointing.squint_rad))
        if self.point_m is None:
            return None
        way_m = self.point_m - self.centres_m
        sine = way_m @ self.along / np.linalg.norm(way_m, axis=1)
        return float(sine.min()), float(sine.max())


def _length_m(places_m: NDArray[np.float64]) -> float:
    """Return the extent of places, each of which extends over the usual distance to the next."""
    return float(np.ptp(places_m)) + _usual_gap_m(places_m)


def _usual_gap_m(places_m: NDArray[np.float64]) -> float:
    """Return the median distance between neighbouring places; 0 if all are one."""
    gaps_m = np.diff(np.sort(places_m))
    gaps_m = gaps_m[gaps_m > 1e-9 * gaps_m.max(initial=0.0)]
    return float(np.median(gaps_m)) if gaps_m.size else 0.0


def _clipped(low_rad: float, high_rad: float) -> tuple[float, float]:
    """Return the sines of two angles, which end at end-fire."""
    low, high = np.clip([low_rad, high_rad], -np.pi / 2, np.pi / 2)
    return float(np.sin(low)), float(np.sin(high))
