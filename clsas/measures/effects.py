"""Effects that a model of an image holds, and the error of an image without each of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clsas.core.decibels import in_db
from clsas.core.geometry import pairwise_range_m
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines, some_channels
from clsas.core.wavelengths import band_wavelength_m, cycles_per_m_at, wavelength_m
from clsas.factorized.surface import surface_of
from clsas.signal.ambiguity import ends_error
from clsas.signal.spectrum import measure_spectrum
from clsas.sonar.beam import BeamWindow
from clsas.sonar.simplify import APART, MOTION, RELIEF
from clsas.sonar.system import Sonar, element_pattern
from clsas.sonar.track import Pointing, Track
from clsas.sonar.visibility import sines

SWAY = "sway and yaw beyond a straight track"
PATTERN = "element pattern"
BEAM = "beam window"
ENDS = "ends of lines"
SINGLE = "single rather than half precision"

KEYS = {
    MOTION: "[simulate] motion_in_flight = false",
    APART: "[simulate] phase_centres = true",
    RELIEF: "",
    SWAY: "no [track.sway], [track.yaw], ...",
    PATTERN: "[simulate] element_pattern = false",
    BEAM: "no [image.beam]",
    ENDS: "[simulate] range_m",
    SINGLE: "",
}
"""Key of a scene file that leaves each effect out; "" where the grid or the device decides."""

_CHANNELS, _PIXELS = 256, 16  # sampled: channels, and pixels along either side of the grid
_FREQUENCIES = 8  # samples of the band, each with an equal part of the power
_BEFORE = 1e-12  # sine: points in the plane of an element's face count as before it


@dataclass(frozen=True, eq=False)
class Survey:
    """Inputs of an image, and the survey that its lines come from as far as it is known.

    Attributes
    ----------
    lines, grid, beam
        Inputs of the image.
    sonar, track, pointing
        Survey that the lines come from; None if not known.
    has_pattern : bool
        True if the lines hold the sonar's element patterns.
    has_ends : bool
        True if recorded data end where the lines do.
    """

    lines: RangeLines
    grid: Grid
    beam: BeamWindow | None = None
    sonar: Sonar | None = None
    track: Track | None = None
    pointing: Pointing | None = None
    has_pattern: bool = True
    has_ends: bool = True

    @property
    def directive(self) -> tuple[Sonar, Track] | None:
        """Sonar and track if they are known and the elements are directive, else None."""
        if self.sonar is None or self.track is None or self.sonar.is_omnidirectional:
            return None
        return self.sonar, self.track

    @property
    def modelled(self) -> dict[str, bool]:
        """For each effect, True if the image models it."""
        lines = self.lines
        return {
            MOTION: lines.rx_velocity_m_s is not None,
            APART: not np.array_equal(lines.tx_m, lines.rx_m),
            RELIEF: not surface_of(self.grid).is_plane,
            SWAY: bool(track_errors_m(lines).any()),
            PATTERN: self.directive is not None and self.has_pattern,
            BEAM: self.beam is not None,
            ENDS: True,
        }

    @property
    def full_lines(self) -> RangeLines:
        """Lines with the receivers' velocity, taken from the track if the lines have none."""
        if self.lines.rx_velocity_m_s is not None or self.sonar is None or self.track is None:
            return self.lines
        velocity = np.repeat(self.track.velocity_m_s, self.sonar.receivers, axis=0)
        return replace(self.lines, rx_velocity_m_s=velocity)


@dataclass(frozen=True)
class ErrorWithout:
    """Error of an image without an effect.

    Attributes
    ----------
    error_db : float
        Relative rms error, dB.
    range_wavelengths, most_wavelengths : float or None
        Error of ranges, rms and at most, wavelengths; None for effects on amplitudes.
    """

    error_db: float
    range_wavelengths: float | None = None
    most_wavelengths: float | None = None


def errors_without(survey: Survey) -> dict[str, ErrorWithout]:
    """Return the error of an image without each effect, for the effects whose error is known.

    The error is a mean over a sample of channels i and of pixels x all over the grid. Without an
    effect, ranges differ by d from the full model's (float64), and weights are w' instead of w. The
    relative error of an image whose channels add up incoherently is then

        sum_ix |w - w' exp(j 2 pi f d)|^2 / sum_ix w^2,

    averaged over the frequencies f of the lines' band (cycles per metre of range). It holds the
    errors of phases and of envelopes, and grows to +3 dB where phases have nothing in common.
    """
    lines, beam = survey.lines, survey.beam
    sample = _Sample.of(survey.full_lines, survey.grid, beam)
    pattern = None
    if survey.directive is not None:
        pattern = _pattern(sample, *survey.directive, survey.pointing)
    of_lines = pattern if pattern is not None and survey.has_pattern else 1.0
    errors = {
        name: sample.error_of_ranges(range_m, sample.weights * of_lines)
        for name, range_m in _ranges_without(sample, lines).items()
    }
    if pattern is not None:
        errors[PATTERN] = _error_of_weights(sample.weights * pattern, sample.weights)
    if beam is not None:
        with_it, without = sample.weights * of_lines, sample.inside * of_lines
        errors[BEAM] = _error_of_weights(with_it, without)
    if survey.has_ends:
        along = None if beam is None else beam.directions(lines)
        errors[ENDS] = ErrorWithout(
            in_db(ends_error(lines, survey.grid, measure_spectrum(lines), beam, along))
        )
    return errors


def _ranges_without(sample: _Sample, lines: RangeLines) -> dict[str, NDArray[np.float64]]:
    """Return the ranges of a sample of lines without each effect on them."""
    some, points_m = sample.lines, sample.points_m
    moving = some.rx_velocity_m_s, some.sound_speed_m_s
    middle_m, off_m = some.phase_centres_m, track_errors_m(lines)[sample.channels]
    ranges_m = {
        APART: pairwise_range_m(points_m, middle_m, middle_m, *moving),
        RELIEF: pairwise_range_m(sample.flat_m, some.tx_m, some.rx_m, *moving),
        SWAY: pairwise_range_m(points_m, some.tx_m - off_m, some.rx_m - off_m, *moving),
    }
    if some.rx_velocity_m_s is not None:
        ranges_m[MOTION] = pairwise_range_m(points_m, some.tx_m, some.rx_m)
    return ranges_m


def track_errors_m(lines: RangeLines) -> NDArray[np.float64]:
    """Return the distances of channels from a straight track, [channels, 3], metres.

    The track is the line that fits the pings' phase centres best. If all pings have the same number
    of channels, the mean distance of a channel over the pings is the array's shape, and no error.
    """
    centres_m = lines.phase_centres_m
    starts = lines.ping_starts
    counts = np.diff(np.append(starts, lines.channels))
    pings_m = lines.ping_centres_m
    middle_m = pings_m.mean(axis=0)
    direction = np.linalg.svd(pings_m - middle_m, full_matrices=False)[2][0]
    away_m = centres_m - middle_m
    away_m = away_m - np.outer(away_m @ direction, direction)
    if (counts == counts[0]).all():
        by_ping = away_m.reshape(-1, counts[0], 3)
        away_m = (by_ping - by_ping.mean(axis=0)).reshape(-1, 3)
    # Rounding puts channels of a straight track beside it.
    size_m = np.abs(centres_m).max()
    return np.where(np.abs(away_m) > 1e-14 * size_m, away_m, 0.0)


@dataclass(frozen=True, eq=False)
class _Sample:
    """A sample of channels and pixels; arrays are [pixels, channels].

    Attributes
    ----------
    channels : int [channels]
        Indices of the channels.
    lines : RangeLines
        Lines of the channels, with everything modelled.
    points_m, flat_m : float64 [pixels, 3]
        Positions of the pixels, with relief and without.
    range_m : float64
        Ranges of the full model.
    inside, weights : float64
        1 where a channel's line holds the pixel; the beam's weights there.
    cycles_per_m : float64 [frequencies]
        Frequencies of the band, each with an equal part of the power.
    wavelength_m : float
        Wavelength at the middle of the band.
    """

    channels: NDArray[np.int64]
    lines: RangeLines
    points_m: NDArray[np.float64]
    flat_m: NDArray[np.float64]
    range_m: NDArray[np.float64]
    inside: NDArray[np.float64]
    weights: NDArray[np.float64]
    cycles_per_m: NDArray[np.float64]
    wavelength_m: float

    @classmethod
    def of(cls, lines: RangeLines, grid: Grid, beam: BeamWindow | None) -> _Sample:
        """Return a sample of some lines and a grid."""
        some = some_channels(lines.channels, _CHANNELS)
        part = lines.select(some)
        points_m, flat_m = _pixels_m(grid)
        range_m = pairwise_range_m(
            points_m, part.tx_m, part.rx_m, part.rx_velocity_m_s, part.sound_speed_m_s
        )
        holds = (range_m >= part.first_range_m) & (range_m <= part.last_range_m)
        inside = holds.astype(np.float64)
        weights = inside
        if beam is not None:
            sine = sines(points_m, part.phase_centres_m, beam.directions(lines)[some]).T
            weights = inside * beam.weights(sine, wavelength_m(lines))
        spectrum = measure_spectrum(lines)
        away = np.interp(
            (np.arange(_FREQUENCIES // 2) + 0.5) / (_FREQUENCIES // 2),
            np.cumsum(spectrum.share),
            spectrum.frequency,
        )
        centre = cycles_per_m_at(lines, spectrum.centre)
        beside = np.concatenate([-away, away]) / lines.range_step_m
        return cls(
            some, part, points_m, flat_m, range_m, inside, weights, centre + beside,
            band_wavelength_m(lines, spectrum.centre),
        )  # fmt: skip

    def error_of_ranges(
        self, range_m: NDArray[np.float64], weights: NDArray[np.float64]
    ) -> ErrorWithout:
        """Return the error of other ranges."""
        away_m = range_m - self.range_m
        square = weights**2
        total = max(square.sum(), 1e-30)
        # |1 - exp(j a)|^2 = 4 sin^2(a/2)
        wrong = np.mean([4 * np.sin(np.pi * f * away_m) ** 2 for f in self.cycles_per_m], axis=0)
        rms_m = np.sqrt(np.sum(square * away_m**2) / total)
        most_m = np.abs(away_m).max(where=weights > 0, initial=0.0)
        # A path is there and back.
        waves = 2 / self.wavelength_m
        error_db = in_db(np.sum(square * wrong) / total)
        return ErrorWithout(error_db, float(rms_m * waves), float(most_m * waves))


def _error_of_weights(with_it: NDArray[np.float64], without: NDArray[np.float64]) -> ErrorWithout:
    """Return the error of other weights."""
    return ErrorWithout(in_db(np.sum((with_it - without) ** 2) / max(np.sum(with_it**2), 1e-30)))


def _pixels_m(grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return pixels all over a grid and those of most relief, with the relief and without."""
    places = [np.unique(np.linspace(0, n - 1, _PIXELS).round().astype(int)) for n in grid.shape]
    index = np.ravel_multi_index(np.ix_(*places), grid.shape).ravel()
    surface = surface_of(grid)
    if surface.is_plane:
        points_m = grid.at(index)
        return points_m, points_m
    relief_m = surface.off_m
    index = np.append(index, [relief_m.argmin(), relief_m.argmax()])
    points_m = grid.at(index)
    return points_m, points_m - relief_m[index, None] * surface.steps_m[2]


def _pattern(
    sample: _Sample, sonar: Sonar, track: Track, pointing: Pointing | None
) -> NDArray[np.float64]:
    """Return the two-way pattern at the carrier, 0 behind an element's face."""
    lines = sample.lines
    axes = (pointing or Pointing.broadside()).axes(track)
    axes = axes[sample.channels // sonar.receivers]
    heard_m = np.broadcast_to(lines.rx_m, (len(sample.points_m), *lines.rx_m.shape))
    if lines.rx_velocity_m_s is not None:
        speed = lines.rx_velocity_m_s / lines.sound_speed_m_s
        heard_m = heard_m + 2 * sample.range_m[..., None] * speed
    pattern = np.ones_like(sample.range_m)
    ends = (
        (lines.tx_m, sonar.tx_length_m, sonar.tx_height_m),
        (heard_m, sonar.rx_length_m, sonar.rx_height_m),
    )
    for position_m, length_m, height_m in ends:
        way = sample.points_m[:, None] - position_m
        way /= np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-30)
        components = np.einsum("pci,cai->apc", way, axes)
        pattern *= components[1] > -_BEFORE
        for size_m, sine in ((length_m, components[0]), (height_m, components[2])):
            if size_m is not None:
                frequency_hz, sound = sonar.pulse.carrier_hz, sonar.sound_speed_m_s
                pattern *= element_pattern(size_m, sine, frequency_hz, sound)
    return pattern
