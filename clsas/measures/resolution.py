"""Predicted responses of a point: its -3 dB widths, and the level of its grating lobes.

Equations in brackets are those of the thesis (Ødegaard 2004).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import in_db
from clsas.engine.data.geometry import bistatic_range_m
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.system import Sonar, element_pattern
from clsas.engine.data.track import Pointing, Track, channels
from clsas.engine.data.visibility import sines
from clsas.engine.signal.compression import Window, band_window
from clsas.inspection.sampling import course

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
class View:
    """The channels of a survey, as a point sees them.

    Attributes
    ----------
    point_m : float64 [3]
    tx_m, rx_m : float64 [channels, 3]
        Transmitters and receivers of all channels.
    along : float64 [3]
        Unit vector along the track.
    patterns : float64 [channels]
        Two-way element pattern towards the point.
    beam : BeamWindow or None
        Weights of the channels in a pixel.
    directions : float64 [channels, 3] or None
        Direction of the track at every channel, to which the beam refers.
    """

    point_m: NDArray[np.float64]
    tx_m: NDArray[np.float64]
    rx_m: NDArray[np.float64]
    along: NDArray[np.float64]
    patterns: NDArray[np.float64]
    beam: BeamWindow | None = None
    directions: NDArray[np.float64] | None = None

    @property
    def weights(self) -> NDArray[np.float64]:
        """Weight of every channel in the peak of the point, [channels]."""
        return self.patterns * self.beam_weights(self.point_m[None])[0]

    def beam_weights(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the weights of the channels in pixels [points, 3], [points, channels]."""
        if self.beam is None or self.directions is None:
            return np.ones((len(points_m), len(self.tx_m)))
        centres_m = (self.tx_m + self.rx_m) / 2
        return self.beam.weights(sines(points_m, centres_m, self.directions).T)

    def of(self, used: NDArray[np.bool_]) -> View:
        """Return the view of some channels."""
        directions = None if self.directions is None else self.directions[used]
        return replace(
            self,
            tx_m=self.tx_m[used],
            rx_m=self.rx_m[used],
            patterns=self.patterns[used],
            directions=directions,
        )


def view(
    sonar: Sonar,
    track: Track,
    point_m: NDArray[np.float64],
    *,
    beam: BeamWindow | None = None,
    pointing: Pointing | None = None,
    element_pattern: bool = True,
) -> View:
    """Return the channels of a survey, as a point sees them.

    Parameters are those of `clsas.limits`.
    """
    tx, rx, _ = channels(sonar, track)
    patterns = np.ones(len(tx))
    if element_pattern and not sonar.is_omnidirectional:
        lengthwise = (pointing or Pointing()).axes(track)[:, 0]
        patterns = _patterns(sonar, point_m, tx, rx, np.repeat(lengthwise, sonar.receivers, axis=0))
    along = course((tx + rx) / 2)
    directions = None if beam is None else beam_directions(sonar, tx, rx, beam)
    return View(point_m, tx, rx, along, patterns, beam, directions)


def beam_directions(
    sonar: Sonar, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], beam: BeamWindow
) -> NDArray[np.float64]:
    """Return the direction of the track at every channel, to which a beam refers, [channels, 3]."""
    silent = np.zeros((len(tx_m), 1), np.complex64)
    carrier_hz, sound_m_s = sonar.pulse.carrier_hz, sonar.sound_speed_m_s
    return beam.directions(RangeLines(silent, 0.0, 1.0, tx_m, rx_m, carrier_hz, sound_m_s))


def expected_resolution_m(
    sonar: Sonar, track: Track, point_m: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the theoretical -3 dB widths of a point in azimuth and range."""
    return azimuth_width_m(view(sonar, track, point_m), sonar.wavelength_m), range_width_m(sonar)


def azimuth_width_m(seen: View, wavelength_m: float) -> float:
    """Return the -3 dB width of a point's response along the track.

    The response is the Fourier transform of the spectrum along the track [21]. The spectrum has the
    weight of every channel at its spatial frequency (sin theta_tx + sin theta_rx)/lambda. A width
    of infinity means that all channels have one frequency, so that there is no aperture.
    """
    sine = _sines(seen.point_m, seen.tx_m, seen.along) + _sines(seen.point_m, seen.rx_m, seen.along)
    return half_power_width(sine / wavelength_m, seen.weights)


def range_width_m(sonar: Sonar, window: Window = "none") -> float:
    """Return the -3 dB width of a point's response in range.

    The response is the Fourier transform of the matched pulse |P(f)|^2 [17], times the window of
    the pulse compression, at the spatial frequency 2 f/c.
    """
    frequency, power = _band(sonar, window)
    return half_power_width(2 * frequency / sonar.sound_speed_m_s, power)


def grating_lobe_db(
    sonar: Sonar, seen: View, lobe_m: float, width_m: float, window: Window = "none"
) -> float:
    """Return the level of the first grating lobes, in decibels relative to the peak of the point.

    Where frequencies differ, the lobe lies at different places, and the ranges of channels with
    equal phase differ by half a wavelength from one to the next. Wide bands therefore smear it. The
    level is the largest found at all places where the lobe may lie.

    The level is minus infinity if the lobe would lie beyond end-fire.

    Parameters
    ----------
    sonar : Sonar
    seen : View
        The channels, as the point sees them.
    lobe_m : float
        Distance of the lobe at the carrier along the track, metres [26].
    width_m : float
        The -3 dB width of the point along the track, metres.
    window
        As for `clsas.compress`.
    """
    peak = abs(float(seen.weights.sum()))
    seen = seen.of(np.abs(seen.patterns) > 1e-3 * np.abs(seen.patterns).max())
    tx, rx = seen.tx_m, seen.rx_m
    points_m = _lobe_positions_m(sonar, seen, lobe_m, width_m)
    if not len(points_m):
        return -np.inf
    points_m = points_m[:: -(-len(points_m) * len(tx) // _MOST_WORK)]
    range_m = bistatic_range_m(seen.point_m, tx, rx)
    parts_m = np.array_split(points_m, -(-len(points_m) * len(tx) // _MOST_TABLE))
    some_m = points_m[:: max(1, len(points_m) // _BOUNDING), None]
    farthest_m = 1.1 * float(np.abs(bistatic_range_m(some_m, tx, rx) - range_m).max())
    nodes_m, response = _range_response(sonar, window, farthest_m)
    largest = 0.0
    for part_m in parts_m:
        offset_m = bistatic_range_m(part_m[:, None], tx, rx) - range_m
        turns = np.exp(4j * np.pi / sonar.wavelength_m * offset_m)
        weights = seen.patterns * seen.beam_weights(part_m)
        totals = np.sum(weights * np.interp(offset_m, nodes_m, response) * turns, axis=1)
        largest = max(largest, float(np.abs(totals).max()))
    return in_db((largest / peak) ** 2)


def _lobe_positions_m(
    sonar: Sonar, seen: View, lobe_m: float, width_m: float
) -> NDArray[np.float64]:
    """Return positions at which the first grating lobes may lie, [points, 3].

    Seen from a phase centre, the lobe has the range of the point, and its distance along the track
    is inversely proportional to the frequency. The positions are those of all frequencies in the
    band, for some phase centres from which point and lobe may be received.
    """
    centres_m = (seen.tx_m + seen.rx_m) / 2
    middle_m = centres_m.mean(axis=0)
    foot_m = middle_m + ((seen.point_m - middle_m) @ seen.along) * seen.along
    aside_m = seen.point_m - foot_m
    abeam_m = float(np.linalg.norm(aside_m))
    places_m = (centres_m - foot_m) @ seen.along
    first_m, last_m = max(-lobe_m, places_m.min()), min(lobe_m, places_m.max())
    relative = sonar.pulse.bandwidth_hz / sonar.pulse.carrier_hz / 2
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
        forward_m = np.multiply.outer(ahead_m + place_m, seen.along)
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


def _patterns(
    sonar: Sonar,
    point_m: NDArray[np.float64],
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
    lengthwise: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the two-way pattern of elements along unit vectors [channels, 3], at the carrier."""
    gain = np.ones(len(tx_m))
    for size, end_m in ((sonar.tx_length_m, tx_m), (sonar.rx_length_m, rx_m)):
        if size is not None:
            sine = _sines(point_m, end_m, lengthwise)
            gain *= element_pattern(size, sine, sonar.pulse.carrier_hz, sonar.sound_speed_m_s)
    return gain


def _sines(
    point_m: NDArray[np.float64], ends_m: NDArray[np.float64], along: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the component along unit vectors of the directions from antennas to a point."""
    way_m = point_m - ends_m
    distance_m = np.linalg.norm(way_m, axis=1)
    forward_m = np.sum(way_m * along, axis=1)
    return np.divide(forward_m, distance_m, out=np.zeros_like(distance_m), where=distance_m > 0)


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
