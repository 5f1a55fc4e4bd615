"""Geometry of a survey, and the response of a point that it predicts.

`Survey` has the geometry from which `clsas.limits` computes its results. The -3 dB widths of the
point in the middle, and the level of its grating lobes, follow from the channels as the point sees
them. Equations in brackets are those of the thesis (Ødegaard 2004).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import in_db
from clsas.engine.data.declared import check_declared
from clsas.engine.data.geometry import bistatic_range_m, course, pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, some_channels
from clsas.engine.data.system import Sonar, element_pattern
from clsas.engine.data.track import Pointing, Track, channels
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.visibility import is_within, sines
from clsas.engine.signal.compression import Window, band_window, compress
from clsas.inspection.sampling import corners_of, grating_lobe_m

_CHANNELS = 1024  # channels whose ranges to the grid are computed, beside the first and last ping
_STRAIGHT = 0.9  # length of a track over the path along it, below which the track is too curved
_ALONG = 0.01  # share of the array's extent that lies along the track, below which it is across

_FREQUENCIES = 4001  # across the band; twice as many change widths by 1e-4 at most
_PER_WIDTH = 4  # positions per -3 dB width at which the level of a grating lobe is computed
_MOST_POSITIONS = 2000  # arbitrary bound on the time of this computation
_BOUNDING = 64  # positions of a lobe from which the farthest distance in range follows
_CENTRES = 9  # phase centres from which lobes are searched; 17 change a level by less than 0.1 dB
_FEWEST = 401  # frequencies across the band for the response far from its peak
_PER_CELL = 20  # samples of the range response per c/2B, between which it is linear
_MOST_TABLE = 1 << 22  # complex numbers computed at once: 64 MiB
_MOST_WORK = 1 << 24  # pairs of positions and channels: 2 s. More channels get fewer positions.
_MOST_CHANNELS = 8192  # above which channels of nearly equal spatial frequencies are added up
_WIDEST = 64.0  # responses wider than this over the extent of their spectrum have no aperture


@dataclass(frozen=True, eq=False)
class Survey:
    """Arguments of `limits`, and the geometry that follows from them."""

    sonar: Sonar
    track: Track | None = None
    grid: Grid | None = None
    beam: BeamWindow | None = None
    range_m: Sequence[float] | None = None
    window: Window = "none"
    pointing: Pointing | None = None
    element_pattern: bool = True
    motion_in_flight: bool = False

    def __post_init__(self) -> None:
        """Check every argument."""
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

    @property
    def speed_m_s(self) -> float:
        """Highest speed along the track."""
        assert self.track is not None
        return float((self.steps_m / np.diff(self.track.time_s)).max())

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
            element_m = self.sonar.element_length_m
            return None if element_m is None else element_m / 2
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
        points_m = np.concatenate([corners_of(self.grid), self.grid.spread()])
        range_m = pairwise_range_m(points_m, tx[some], rx[some])
        if self.beam is not None and self.is_moving:
            sine = sines(points_m, self.centres_m[some], self.beam_directions[some]).T
            seen = is_within(sine, self.beam.limits)
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

    @property
    def has_aperture(self) -> bool:
        """True if the track moves, and the range of the point in the middle is known."""
        return self.point_m is not None and self.is_moving

    @cached_property
    def patterns(self) -> NDArray[np.float64]:
        """Two-way pattern of the elements towards the point, [channels], at the carrier."""
        tx, rx = self.antennas_m
        gain, sonar = np.ones(len(tx)), self.sonar
        if not self.element_pattern or sonar.is_omnidirectional:
            return gain
        assert self.track is not None
        assert self.point_m is not None
        lengthwise = (self.pointing or Pointing()).axes(self.track)[:, 0]
        lengthwise = np.repeat(lengthwise, sonar.receivers, axis=0)
        carrier_hz, sound_m_s = sonar.pulse.carrier_hz, sonar.sound_speed_m_s
        for size_m, ends_m in ((sonar.tx_length_m, tx), (sonar.rx_length_m, rx)):
            if size_m is not None:
                sine = sines(self.point_m[None], ends_m, lengthwise)[:, 0]
                gain *= element_pattern(size_m, sine, carrier_hz, sound_m_s)
        return gain

    @cached_property
    def beam_directions(self) -> NDArray[np.float64]:
        """Direction of the track at every channel, to which the beam refers, [channels, 3]."""
        assert self.beam is not None
        tx, rx = self.antennas_m
        silent = np.zeros((len(tx), 1), np.complex64)
        carrier_hz, sound_m_s = self.sonar.pulse.carrier_hz, self.sonar.sound_speed_m_s
        return self.beam.directions(RangeLines(silent, 0.0, 1.0, tx, rx, carrier_hz, sound_m_s))

    def beam_weights(
        self, points_m: NDArray[np.float64], used: NDArray[np.bool_] | slice = slice(None)
    ) -> NDArray[np.float64]:
        """Return the weights of some channels in pixels [points, 3], [points, channels]."""
        centres_m = self.centres_m[used]
        if self.beam is None:
            return np.ones((len(points_m), len(centres_m)))
        return self.beam.weights(sines(points_m, centres_m, self.beam_directions[used]).T)

    @cached_property
    def weights(self) -> NDArray[np.float64]:
        """Weight of every channel in the peak of the point, [channels]."""
        assert self.point_m is not None
        return self.patterns * self.beam_weights(self.point_m[None])[0]

    @cached_property
    def width_m(self) -> float | None:
        """The -3 dB width of the point along the track; None without an aperture.

        The response is the Fourier transform of the spectrum along the track [21]. The spectrum has
        the weight of every channel at its spatial frequency (sin theta_tx + sin theta_rx)/lambda.
        """
        if self.point_m is None or not self.has_aperture:
            return None
        tx, rx = self.antennas_m
        along = np.broadcast_to(self.along, tx.shape)
        sine_tx, sine_rx = (sines(self.point_m[None], each, along)[:, 0] for each in (tx, rx))
        width_m = half_power_width((sine_tx + sine_rx) / self.sonar.wavelength_m, self.weights)
        return width_m if math.isfinite(width_m) else None

    @cached_property
    def aperture_m(self) -> float:
        """Length of the synthetic aperture of the point in the middle."""
        assert self.point_m is not None
        seen = self.beam_weights(self.point_m[None])[0] > 0
        return _length_m((self.centres_m @ self.along)[seen])

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
        """Distance of the first grating lobes of an array's pings, if known."""
        if self.distance_m is None or not self.is_moving or not self.is_array:
            return None
        step_m = float(np.median(self.steps_m))
        return grating_lobe_m(self.sonar.wavelength_m, step_m, self.distance_m) if step_m else None

    @cached_property
    def lobe_db(self) -> float | None:
        """Level of the first grating lobes, if known."""
        return _grating_lobe_db(self, self.lobe_m)

    @cached_property
    def ping_lobe_db(self) -> float | None:
        """Level of the first grating lobes of an array's pings, if known."""
        return _grating_lobe_db(self, self.ping_lobe_m)

    @cached_property
    def beam_sines(self) -> tuple[float, float] | None:
        """Sines of the angles between which the beam, or else that of an element, extends."""
        pointing, element_m = self.pointing or Pointing(), self.sonar.element_length_m
        if self.beam is not None:
            limits_rad = np.array(self.beam.limits_rad)
        elif element_m is not None and self.element_pattern and pointing.spot_m is None:
            of_element = BeamWindow.of_element(element_m, self.sonar.wavelength_m)
            squint_rad = pointing.squint_rad
            limits_rad = of_element.limits_rad + np.array([min(squint_rad), max(squint_rad)])
        elif self.point_m is not None:
            way_m = self.point_m - self.centres_m
            sine = way_m @ self.along / np.linalg.norm(way_m, axis=1)
            return float(sine.min()), float(sine.max())
        else:
            return None
        low, high = np.sin(np.clip(limits_rad, -np.pi / 2, np.pi / 2))  # they end at end-fire
        return float(low), float(high)


def _length_m(places_m: NDArray[np.float64]) -> float:
    """Return the extent of places, each of which extends over the usual distance to the next."""
    return float(np.ptp(places_m)) + _usual_gap_m(places_m)


def _usual_gap_m(places_m: NDArray[np.float64]) -> float:
    """Return the median distance between neighbouring places; 0 if all are one."""
    gaps_m = np.diff(np.sort(places_m))
    gaps_m = gaps_m[gaps_m > 1e-9 * gaps_m.max(initial=0.0)]
    return float(np.median(gaps_m)) if gaps_m.size else 0.0


def expected_resolution_m(
    sonar: Sonar, track: Track, point_m: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the theoretical -3 dB widths of a point in azimuth and range.

    A width of infinity means that all channels have one frequency, so that there is no aperture.
    """
    survey = Survey(sonar, track, Grid.points(point_m[None]))
    return survey.width_m or math.inf, range_width_m(sonar)


def range_width_m(sonar: Sonar, window: Window = "none") -> float:
    """Return the -3 dB width of a point's response in range.

    The response is the Fourier transform of the matched pulse |P(f)|^2 [17], times the window of
    the pulse compression, at the spatial frequency 2 f/c.
    """
    frequency, power = _band(sonar, window)
    return half_power_width(2 * frequency / sonar.sound_speed_m_s, power)


def _grating_lobe_db(survey: Survey, lobe_m: float | None) -> float | None:
    """Return the level of lobes at a distance from the point, relative to its peak, if known.

    Where frequencies differ, the lobe lies at different places, and the ranges of channels with
    equal phase differ by half a wavelength from one to the next. Wide bands therefore smear it. The
    level is the largest found at all places where the lobe may lie. Beyond end-fire there is none.
    """
    if lobe_m is None or survey.point_m is None or survey.width_m is None:
        return None
    used = np.abs(survey.patterns) > 1e-3 * np.abs(survey.patterns).max()
    tx, rx = (ends_m[used] for ends_m in survey.antennas_m)
    points_m = _lobe_positions_m(survey, survey.point_m, survey.width_m, lobe_m, used)
    if not len(points_m):
        return None
    points_m = points_m[:: -(-len(points_m) * len(tx) // _MOST_WORK)]
    range_m = bistatic_range_m(survey.point_m, tx, rx)
    parts_m = np.array_split(points_m, -(-len(points_m) * len(tx) // _MOST_TABLE))
    some_m = points_m[:: max(1, len(points_m) // _BOUNDING), None]
    farthest_m = 1.1 * float(np.abs(bistatic_range_m(some_m, tx, rx) - range_m).max())
    nodes_m, response = _range_response(survey.sonar, survey.window, farthest_m)
    largest = 0.0
    for part_m in parts_m:
        offset_m = bistatic_range_m(part_m[:, None], tx, rx) - range_m
        turns = np.exp(4j * np.pi / survey.sonar.wavelength_m * offset_m)
        weights = survey.patterns[used] * survey.beam_weights(part_m, used)
        totals = np.sum(weights * np.interp(offset_m, nodes_m, response) * turns, axis=1)
        largest = max(largest, float(np.abs(totals).max()))
    peak = abs(float(survey.weights.sum()))
    return min(in_db((largest / peak) ** 2), 0.0)


def _lobe_positions_m(
    survey: Survey,
    point_m: NDArray[np.float64],
    width_m: float,
    lobe_m: float,
    used: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Return positions at which the first grating lobes may lie, [points, 3].

    Seen from a phase centre, the lobe has the range of the point, and its distance along the track
    is inversely proportional to the frequency. The positions are those of all frequencies in the
    band, for some phase centres from which point and lobe may be received.
    """
    centres_m, along = survey.centres_m[used], survey.along
    middle_m = centres_m.mean(axis=0)
    foot_m = middle_m + ((point_m - middle_m) @ along) * along
    aside_m = point_m - foot_m
    abeam_m = float(np.linalg.norm(aside_m))
    places_m = (centres_m - foot_m) @ along
    first_m, last_m = max(-lobe_m, places_m.min()), min(lobe_m, places_m.max())
    relative = survey.sonar.pulse.bandwidth_hz / survey.sonar.pulse.carrier_hz / 2
    near_m = max(lobe_m / (1 + relative) - 2 * width_m, width_m)
    far_m = lobe_m / max(1 - relative, 0.1) + 2 * width_m
    count = int(np.clip(_PER_WIDTH * (far_m - near_m) / width_m, 9, _MOST_POSITIONS))
    offsets_m = np.multiply.outer([-1, 1], np.linspace(near_m, far_m, count)).ravel()
    found = []
    for place_m in np.linspace(first_m, last_m, _CENTRES):
        distance_m = float(np.hypot(abeam_m, place_m))
        ahead_m = offsets_m - place_m  # from the phase centre, on the circle around it
        ahead_m = ahead_m[np.abs(ahead_m) < distance_m]
        aside = np.sqrt(distance_m**2 - ahead_m**2) / abeam_m
        forward_m = np.multiply.outer(ahead_m + place_m, along)
        found.append(foot_m + forward_m + np.multiply.outer(aside, aside_m))
    return np.concatenate(found)


def _range_response(
    sonar: Sonar, window: Window, farthest_m: float
) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
    """Return distances in range from the peak of a matched pulse, and its response there.

    The response of the peak is 1. `farthest_m` is the largest distance to either side.
    """
    sound_m_s, band_hz = sonar.sound_speed_m_s, sonar.pulse.bandwidth_hz
    # Steps in frequency so small that the response repeats only far beyond the farthest distance.
    count = max(_FEWEST, int(np.ceil(8 * farthest_m * band_hz / sound_m_s)))
    frequency = np.linspace(-0.5, 0.5, count) * band_hz
    power = np.interp(frequency, *_band(sonar, window))
    length = scipy.fft.next_fast_len(_PER_CELL * count)
    places_m = np.arange(length // 2) * sound_m_s * (count - 1) / (2 * length * band_hz)
    response = scipy.fft.ifft(power, length)[: length // 2] * length / power.sum()
    response *= np.exp(2j * np.pi / sound_m_s * -band_hz * places_m)
    mirrored = np.concatenate([-places_m[:0:-1], places_m])
    return mirrored, np.concatenate([response[:0:-1].conj(), response])


def _band(sonar: Sonar, window: Window) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return frequencies relative to the carrier, and the matched spectrum there."""
    pulse = sonar.pulse
    frequency = np.linspace(-0.5, 0.5, _FREQUENCIES) * pulse.bandwidth_hz
    power = np.abs(pulse.spectrum(frequency)) ** 2
    return frequency, power * band_window(window, pulse.bandwidth_hz)(frequency)


def half_power_width(cycles_per_m: NDArray[np.float64], weight: NDArray[np.float64]) -> float:
    """Return the full width at half power of |sum weight exp(j 2 pi cycles_per_m u)| at u = 0."""
    used = weight != 0
    cycles_per_m, weight = cycles_per_m[used], weight[used]
    extent = float(np.ptp(cycles_per_m)) if used.any() else 0.0
    if not extent:
        return np.inf
    if len(weight) > _MOST_CHANNELS:
        weight, edges = np.histogram(cycles_per_m, _MOST_CHANNELS, weights=weight)
        cycles_per_m = (edges[:-1] + edges[1:]) / 2
    reach = 1 / extent
    while reach < _WIDEST / extent:
        offset = np.linspace(0, reach, 2001)
        parts = np.array_split(offset, -(-len(offset) * len(cycles_per_m) // _MOST_TABLE))
        response = np.concatenate(
            [
                np.abs(np.exp(2j * np.pi * np.multiply.outer(part, cycles_per_m)) @ weight)
                for part in parts
            ]
        )
        power = (response / response[0]) ** 2
        if (below := np.flatnonzero(power <= 0.5)).size:
            first = int(below[0])
            return 2 * float(np.interp(-0.5, -power[: first + 1], offset[: first + 1]))
        reach *= 2
    return np.inf
