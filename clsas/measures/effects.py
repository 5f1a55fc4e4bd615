"""Effects that an image may model, and the error of an image without each of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import in_db
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.georeference import placed
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import (
    RangeLines,
    band_wavelength_m,
    cycles_per_m_at,
    some_channels,
    wavelength_m,
)
from clsas.engine.data.simplify import APART, MOTION, REFRACTION, RELIEF
from clsas.engine.data.surface import surface_of
from clsas.engine.data.system import Sonar, element_pattern
from clsas.engine.data.track import Pointing, Track
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.visibility import sines
from clsas.engine.signal.ambiguity import ends_error
from clsas.engine.signal.spectrum import measure_spectrum
from clsas.engine.water.refraction import Homogeneous

SWAY = "sway and yaw beyond a straight track"
PATTERN = "element pattern"
BEAM = "beam window"
ENDS = "ends of lines"
SINGLE = "single rather than half precision"

KEYS = {
    MOTION: "[simulate] motion_in_flight = false",
    APART: "[simulate] phase_centres = true",
    RELIEF: "",
    REFRACTION: "no [sound_speed]",
    SWAY: "no [track.sway], [track.yaw], ...",
    PATTERN: "[simulate] element_pattern = false",
    BEAM: "no [image.beam]",
    ENDS: "[simulate] range_m",
    SINGLE: "",
}
"""Key of a scene file that leaves each effect out; "" if there is none."""

_CHANNELS, _PIXELS = 256, 16  # channels sampled, and pixels along either side of the grid
_FREQUENCIES = 8  # frequencies of the band sampled, each with an equal share of the power
_IN_FRONT = 1e-12  # sine by which a point may lie behind an element's face, for rounding


@dataclass(frozen=True, eq=False)
class Survey:
    """Inputs of an image, and the survey that its lines come from as far as it is known.

    Attributes
    ----------
    lines, grid, beam
        Inputs of the image.
    sonar, track, pointing
        Survey that the lines come from; None if not known.
    element_pattern : bool
        True if the lines contain the sonar's element patterns.
    ends : bool
        True if recorded data end where the lines do.
    water : Homogeneous or None
        Homogeneous water of `lines` and `grid` if they replace lines in a profile of the sound
        speed.

    Raises
    ------
    TypeError, ValueError
        If a field has the wrong type, or the survey has other channels than the lines.
    """

    lines: RangeLines
    grid: Grid
    beam: BeamWindow | None = None
    sonar: Sonar | None = None
    track: Track | None = None
    pointing: Pointing | None = None
    element_pattern: bool = True
    ends: bool = True
    water: Homogeneous | None = None

    def __post_init__(self) -> None:
        """Check the fields."""
        validate.instance("lines", self.lines, RangeLines)
        validate.instance("grid", self.grid, Grid)
        placed(self.lines, self.grid)  # raises if the georeferences differ
        if self.beam is not None:
            validate.instance("beam", self.beam, BeamWindow)
        validate.instance("sonar", self.sonar, Sonar, type(None))
        validate.instance("track", self.track, Track, type(None))
        validate.instance("pointing", self.pointing, Pointing, type(None))
        validate.flag("element_pattern", self.element_pattern)
        validate.flag("ends", self.ends)
        if self.lines.banks > 1:
            hint = "use `lines.bank(0)`, with that bank of the sonar"
            raise ArgumentError("lines", "be of one bank", self.lines.banks, hint)
        if self.sonar is None or self.track is None:
            return
        if self.sonar.receivers * self.track.pings != self.lines.channels:
            raise ArgumentError(
                "sonar and track",
                f"have the channels of the lines, {self.lines.channels}",
                f"{self.sonar.receivers} receivers and {self.track.pings} pings",
            )

    @property
    def modelled(self) -> dict[str, bool]:
        """For each effect, True if the image models it."""
        lines = self.lines
        return {
            MOTION: lines.rx_velocity_m_s is not None,
            APART: not np.array_equal(lines.tx_m, lines.rx_m),
            RELIEF: not surface_of(self.grid).is_plane,
            REFRACTION: self.water is not None,
            SWAY: bool(track_errors_m(lines).any()),
            PATTERN: self.directive is not None and self.element_pattern,
            BEAM: self.beam is not None,
            ENDS: True,
        }

    @property
    def directive(self) -> tuple[Sonar, Track] | None:
        """Sonar and track if both are known and the elements are directive, else None."""
        if self.sonar is None or self.track is None or self.sonar.is_omnidirectional:
            return None
        return self.sonar, self.track

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
    error_db : float or None
        Relative rms error in dB; None if it is not known.
    range_wavelengths, most_wavelengths : float or None
        Rms and largest error of the ranges in wavelengths; None for effects on amplitudes.
    """

    error_db: float | None = None
    range_wavelengths: float | None = None
    most_wavelengths: float | None = None


def errors_without(survey: Survey) -> dict[str, ErrorWithout]:
    """Return the error of an image without each effect, for the effects whose error is known.

    The error is a mean over a sample of channels i and of pixels x all over the grid. Without an
    effect, ranges differ by d from those of the full model (in float64), and weights are w' instead
    of w. If the channels of a pixel add up incoherently, the relative error power is

        sum_ix |w - w' exp(j 2 pi f d)|^2 / sum_ix w^2,

    averaged over the frequencies f of the lines' band (cycles per metre of range). It includes the
    errors of phases and of envelopes, and reaches +3 dB where phases are unrelated.
    """
    lines, beam = survey.lines, survey.beam
    sample = _Sample.of(survey.full_lines, survey.grid, beam)
    pattern = None
    if survey.directive is not None:
        pattern = _pattern(sample, *survey.directive, survey.pointing)
    of_lines = pattern if pattern is not None and survey.element_pattern else 1.0
    errors = {
        name: sample.error_of_ranges(range_m, sample.weights * of_lines)
        for name, range_m in _ranges_without(survey, sample).items()
    }
    if pattern is not None:
        errors[PATTERN] = _error_of_weights(sample.weights * pattern, sample.weights)
    if beam is not None:
        with_it, without = sample.weights * of_lines, sample.inside * of_lines
        errors[BEAM] = _error_of_weights(with_it, without)
    if survey.water is not None and (straight := survey.water.straight) is not None:
        cycles_per_s = survey.water.sound_speed_m_s / sample.wavelength_m
        errors[REFRACTION] = ErrorWithout(
            in_db(straight.image_error(cycles_per_s)),
            straight.rms_s * cycles_per_s,
            straight.most_s * cycles_per_s,
        )
    if survey.ends:
        along = None if beam is None else beam.directions(lines)
        errors[ENDS] = ErrorWithout(
            in_db(ends_error(lines, survey.grid, measure_spectrum(lines), beam, along))
        )
    return errors


def _ranges_without(survey: Survey, sample: _Sample) -> dict[str, NDArray[np.float64]]:
    """Return the ranges of a sample without each effect on them."""
    lines = survey.full_lines
    ranges_m = {
        name: ranges_of(sample.points_m, without(lines).select(sample.channels))
        for name, without in LINES_WITHOUT.items()
        if name != MOTION or lines.rx_velocity_m_s is not None
    }
    return ranges_m | {RELIEF: ranges_of(sample.flat_m, sample.lines)}


def _on_straight_track(lines: RangeLines) -> RangeLines:
    """Return lines whose antennas are moved onto a straight track."""
    off_m = track_errors_m(lines)
    return replace(lines, tx_m=lines.tx_m - off_m, rx_m=lines.rx_m - off_m)


LINES_WITHOUT: dict[str, Callable[[RangeLines], RangeLines]] = {
    MOTION: lambda lines: replace(lines, rx_velocity_m_s=None),
    APART: lambda lines: replace(lines, tx_m=lines.phase_centres_m, rx_m=lines.phase_centres_m),
    SWAY: _on_straight_track,
}
"""Functions that return lines without an effect of their antennas."""


def ranges_of(points_m: NDArray[np.float64], lines: RangeLines) -> NDArray[np.float64]:
    """Return the ranges of points for every channel of some lines, [points, channels]."""
    return pairwise_range_m(
        points_m, lines.tx_m, lines.rx_m, lines.rx_velocity_m_s, lines.sound_speed_m_s
    )


def track_errors_m(lines: RangeLines) -> NDArray[np.float64]:
    """Return the distances of channels from a straight track, [channels, 3], in metres.

    The track is the line that fits the phase centres of the pings best. If all pings have the same
    number of channels, the mean distance of a channel over all pings is the shape of the array and
    not an error.
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
        Lines of the channels, with all effects.
    points_m, flat_m : float64 [pixels, 3]
        Positions of the pixels, with relief and without.
    range_m : float64
        Ranges with all effects.
    inside, weights : float64
        1 where a line contains the pixel, else 0; this times the beam's weights.
    cycles_per_m : float64 [frequencies]
        Frequencies of the band, each with an equal share of the power.
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
        range_m = ranges_of(points_m, part)
        contains = (range_m >= part.first_range_m) & (range_m <= part.last_range_m)
        inside = contains.astype(np.float64)
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
        """Return the error of an image with other ranges."""
        away_m = range_m - self.range_m
        square = weights**2
        total = max(square.sum(), 1e-30)
        # |1 - exp(j a)|^2 = 4 sin^2(a/2)
        wrong = np.mean([4 * np.sin(np.pi * f * away_m) ** 2 for f in self.cycles_per_m], axis=0)
        rms_m = np.sqrt(np.sum(square * away_m**2) / total)
        most_m = np.abs(away_m).max(where=weights > 0, initial=0.0)
        waves = 2 / self.wavelength_m  # the path is twice the range
        error_db = in_db(np.sum(square * wrong) / total)
        return ErrorWithout(error_db, float(rms_m * waves), float(most_m * waves))


def _error_of_weights(with_it: NDArray[np.float64], without: NDArray[np.float64]) -> ErrorWithout:
    """Return the error of an image with other weights."""
    return ErrorWithout(in_db(np.sum((with_it - without) ** 2) / max(np.sum(with_it**2), 1e-30)))


def _pixels_m(grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return pixels all over a grid and those of most relief, with the relief and without."""
    sides = [np.unique(np.linspace(0, n - 1, _PIXELS).round().astype(int)) for n in grid.shape]
    index = np.ravel_multi_index(np.ix_(*sides), grid.shape).ravel()
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
    """Return the two-way pattern at the carrier; it is 0 behind an element's face."""
    lines = sample.lines
    axes = (pointing or Pointing.broadside()).axes(track)
    axes = axes[sample.channels // sonar.receivers]
    received_m = np.broadcast_to(lines.rx_m, (len(sample.points_m), *lines.rx_m.shape))
    if lines.rx_velocity_m_s is not None:
        speed = lines.rx_velocity_m_s / lines.sound_speed_m_s
        received_m = received_m + 2 * sample.range_m[..., None] * speed
    pattern = np.ones_like(sample.range_m)
    antennas = (
        (lines.tx_m, sonar.tx_length_m, sonar.tx_height_m),
        (received_m, sonar.rx_length_m, sonar.rx_height_m),
    )
    for position_m, length_m, height_m in antennas:
        look = sample.points_m[:, None] - position_m
        look /= np.maximum(np.linalg.norm(look, axis=-1, keepdims=True), 1e-30)
        components = np.einsum("pci,cai->apc", look, axes)
        pattern *= components[1] > -_IN_FRONT
        for size_m, sine in ((length_m, components[0]), (height_m, components[2])):
            if size_m is not None:
                frequency_hz, sound = sonar.pulse.carrier_hz, sonar.sound_speed_m_s
                pattern *= element_pattern(size_m, sine, frequency_hz, sound)
    return pattern
