"""Effects that an image needs: the error without each of them, and the time that it costs.

`assess` plans the image with all effects and without each of them, and computes the errors for a
sample of channels and pixels (`errors_without`). `survey_lines` makes lines to assess before there
are any.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import in_db, power
from clsas.engine.data.declared import Count, check_declared
from clsas.engine.data.geometry import course, pairwise_range_m, unit_vectors
from clsas.engine.data.georeference import placed
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import (
    RangeLines,
    band_wavelength_m,
    cycles_per_m_at,
    some_channels,
    wavelength_m,
)
from clsas.engine.data.pings import channels_per_ping
from clsas.engine.data.reprs import Report, Table
from clsas.engine.data.simplify import APART, MOTION, RELIEF, SHARE, leave_out
from clsas.engine.data.sound_speed import SoundSpeed, range_bounds_m
from clsas.engine.data.surface import surface_of
from clsas.engine.data.system import Sonar, element_pattern
from clsas.engine.data.track import Pointing, Track, channels
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.visibility import sines
from clsas.engine.device.device import Device, open_device
from clsas.engine.factorized.costs import Costs
from clsas.engine.factorized.errors import half_precision_error
from clsas.engine.factorized.plan import Plan
from clsas.engine.factorized.planner import TOLERANCE, TOLERANCE_DB
from clsas.engine.forming import form
from clsas.engine.imaging import plan
from clsas.engine.scene import Scene
from clsas.engine.signal.ambiguity import ends_error
from clsas.engine.signal.compression import Window, compress
from clsas.engine.signal.interpolation import MOST_TAPS
from clsas.engine.signal.spectrum import measure_spectrum
from clsas.engine.water.ray_delays import RaySample, at_speed, straight_m
from clsas.engine.water.refraction import homogeneous
from clsas.simulation.scenes import PointTargets
from clsas.simulation.simulator import simulate_lines

REFRACTION = "refraction"
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

NONE_DB = -250.0
"""Errors below this level, in dB, are shown as "none"."""

_Error = tuple[float, float | None, float | None]
"""Error of an image without an effect, dB, and the rms and largest error of its ranges, in
wavelengths; None for effects on amplitudes."""

_FULL, _FORMED = "full", "formed"  # images beside those without one effect
_CHANNELS, _PIXELS = 256, 16  # channels sampled, and pixels along either side of the grid
_FREQUENCIES = 8  # frequencies of the band sampled, each with an equal share of the power
_IN_FRONT = 1e-12  # sine by which a point may lie behind an element's face, for rounding


def assess(
    lines: RangeLines,
    grid: Grid,
    *,
    beam: BeamWindow | None = None,
    tolerance_db: float = TOLERANCE_DB,
    sonar: Sonar | None = None,
    track: Track | None = None,
    pointing: Pointing | None = None,
    element_pattern: bool = True,
    device: Device | str | int | None = None,
    costs: Costs | None = None,
    repeats: Annotated[
        int,
        Count(0, help="Also time the image with and without each effect, in this many runs."),
    ] = 0,
    ends: bool = True,
) -> Assessment:
    """Return which effects an image needs, by its error and its time without each of them.

    Parameters
    ----------
    lines : RangeLines
        Lines to image; `survey_lines` makes them from a sonar and a track.
    grid : Grid
        Pixels of the image.
    beam : BeamWindow, optional
        Weights of the channels.
    tolerance_db : float
        Relative rms error of the image that is allowed, in dB, from -85 to -10.
    sonar, track : Sonar, Track, optional
        Survey that the lines come from, with the channels of `clsas.channels`. It determines the
        element patterns, and the velocity of the receivers if the lines have none.
    pointing : Pointing, optional
        Directions of the elements; by default to broadside.
    element_pattern : bool
        True if the lines contain the sonar's element patterns.
    device : Device, str or int, optional
        Device that forms the image; see `clsas.engine.device.device.choose`.
    costs : Costs, optional
        Costs to use instead of those stored for the device.
    repeats : int
        If not 0, measure times instead of predicting them: form the images with all effects and
        without each of them in turns, this many times, and take the shortest times.
    ends : bool
        True if recorded data end where the lines do.

    Returns
    -------
    Assessment

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is out of bounds, the lines have several banks, or
        sonar and track have other channels than the lines.
    DeviceError
        If the device does not exist.

    See Also
    --------
    survey_lines : Lines of a survey that has not been simulated yet.
    plan : Leaves out effects whose error is far below the tolerance.

    Notes
    -----
    Errors are computed in float64 for a sample of channels and pixels:
    `clsas.measures.assess.errors_without` has the equation. Without an effect, an image is planned
    like the one with all effects, and the difference of their times is the cost of the effect. The
    cost of refraction is the time that it took to convert the lines. The other effects are those of
    the converted lines.

    Examples
    --------
    Receivers at 1 m/s move on while the echoes of targets at 20 m travel:

    >>> import clsas
    >>> import numpy as np
    >>> tx_m = np.outer(np.arange(32), [0.02, 0, 0])
    >>> grid = clsas.Grid.plane((0.2, 0.4, 16), (19.9, 20.1, 16))
    >>> lines = clsas.simulate_lines(
    ...     tx_m, tx_m, clsas.PointTargets([[0.3, 20.0, 0.0]], [1.0]), carrier_hz=100e3,
    ...     bandwidth_hz=20e3, window="hann", rx_velocity_m_s=[1.0, 0, 0],
    ... )
    >>> motion = clsas.assess(lines, grid, tolerance_db=-30)["motion during flight"]
    >>> print(f"{motion.error_db:.0f} dB without it")
    -19 dB without it
    >>> motion.needed
    True
    """
    tolerance_db = TOLERANCE.check("tolerance_db", tolerance_db)
    repeats = check_declared(assess, {"repeats": repeats})["repeats"]
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    in_profile, refraction_s = None, 0.0
    if lines.sound_speed is not None:
        in_profile = RaySample.of(lines, grid, beam)
        start = time.perf_counter()
        water = homogeneous(lines, grid, beam, None, corrected=False)
        lines, grid, beam = water.lines(lines), water.grid, water.beam
        refraction_s = time.perf_counter() - start
    inputs = Inputs(lines, grid, beam, sonar, track, pointing, element_pattern, ends, in_profile)
    device = open_device(device)

    images = _images(inputs, partial(plan, tolerance_db=tolerance_db, device=device, costs=costs))
    full = images[_FULL].plan
    left_out = images[_FORMED].plan.left_out if _FORMED in images else full.left_out
    if repeats and full.half_precision:
        single = replace(full, method=replace(full.factorization, half_precision=False))
        images[SINGLE] = images[_FULL]._replace(plan=single)
    if repeats:
        seconds = _measured(images, device, repeats)
    else:
        seconds = {name: image.plan.predicted_seconds for name, image in images.items()}

    errors, modelled = errors_without(inputs), inputs.modelled
    modelled[SINGLE] = not full.half_precision
    if not full.is_exact and device.info.half_precision:
        errors[SINGLE] = in_db(half_precision_error(len(full.sides))), None, None
    allowed = SHARE * power(tolerance_db)
    if in_profile is not None:
        seconds[REFRACTION] = seconds[_FULL] - refraction_s

    effects = []
    for name, key in KEYS.items():
        error_db, range_wavelengths, most_wavelengths = errors.get(name, (None, None, None))
        needed, cost_s = None, None
        if name == SINGLE and error_db is not None:
            needed = modelled[SINGLE]  # the plan has decided already
        elif error_db is not None:
            needed = power(error_db) > allowed
        if name in seconds:
            cost_s = seconds[_FULL] - seconds[name]
        if name == SINGLE and cost_s is not None:
            cost_s = -cost_s  # of all images, only this one has the effect that the full one lacks
        effects.append(
            Effect(
                name=name,
                modelled=modelled[name],
                error_db=error_db,
                range_wavelengths=range_wavelengths,
                most_wavelengths=most_wavelengths,
                needed=needed,
                left_out=name in left_out,
                seconds=cost_s,
                key=key,
            )
        )
    return Assessment(
        tolerance_db=tolerance_db,
        wavelength_m=band_wavelength_m(lines, measure_spectrum(lines).centre),
        channels=lines.channels,
        pixels=grid.shape,
        device=device.info.label,
        measured=repeats > 0,
        seconds=seconds[_FULL],
        simple_seconds=seconds.get(_FORMED, seconds[_FULL]),
        effects=tuple(effects),
    )


@dataclass(frozen=True, eq=False)
class Inputs:
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
    in_profile : RaySample or None
        Delays along exact rays, if `lines` and `grid` replace those in a profile of the sound
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
    in_profile: RaySample | None = None

    def __post_init__(self) -> None:
        """Check the fields."""
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
            APART: not lines.is_monostatic,
            RELIEF: not surface_of(self.grid).is_plane,
            REFRACTION: self.in_profile is not None,
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


class _Image(NamedTuple):
    """Inputs of an image, and its plan."""

    lines: RangeLines
    grid: Grid
    beam: BeamWindow | None
    plan: Plan


def _images(inputs: Inputs, planned: Callable[..., Plan]) -> dict[str, _Image]:
    """Return the image with all effects, without each effect that it models, and as it is formed.

    The last is there only if the planner leaves out effects. `planned` is `clsas.plan` with the
    request.
    """
    lines, grid, beam = inputs.lines, inputs.grid, inputs.beam
    altered: dict[str, tuple[RangeLines, Grid, BeamWindow | None]] = {}
    if beam is not None:
        altered[BEAM] = lines, grid, None
        # Moving antennas changes the directions of a track: keep those of the given lines.
        beam = replace(beam, along=beam.directions(lines))
    modelled = inputs.modelled
    for name, without in LINES_WITHOUT.items():
        if modelled[name]:
            altered[name] = without(lines), grid, beam
    if modelled[RELIEF] and len(grid.shape) == 2:
        flat = leave_out(lines, grid, beam, (RELIEF,)).grid
        if flat.is_planar:
            altered[RELIEF] = lines, flat, beam
    with validate.muted():  # about ends, which are an effect
        full = planned(lines, grid, beam=inputs.beam)
        images = {}
        if full.left_out:
            images[_FORMED] = _Image(lines, grid, inputs.beam, full)
            full = planned(lines, grid, beam=inputs.beam, full_model=True)
        images[_FULL] = _Image(lines, grid, inputs.beam, full)
        for name, given in altered.items():
            chosen = planned(*given[:2], beam=given[2], full_model=True)
            images[name] = _Image(*given, chosen)
    return images


def _measured(images: dict[str, _Image], device: Device, repeats: int) -> dict[str, float]:
    """Return the shortest time of every image; they are formed in turns, after an untimed one."""
    seconds: dict[str, list[float]] = {name: [] for name in images}
    with validate.muted():
        for turn in range(repeats + 1):
            for name, (lines, grid, beam, chosen) in images.items():
                start = time.perf_counter()
                allowed_db = chosen.tolerance_db if name == _FORMED else None
                scene = Scene.of(lines, grid, beam, allowed_db, left_out=chosen.left_out)
                form(scene, chosen, device)
                if turn:
                    seconds[name].append(time.perf_counter() - start)
    return {name: min(each) for name, each in seconds.items()}


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


def errors_without(inputs: Inputs) -> dict[str, _Error]:
    """Return the error of an image without each effect, for the effects whose error is known.

    The error is a mean over a sample of channels i and of pixels x all over the grid. Without an
    effect, ranges differ by d from those of the full model (in float64), and weights are w' instead
    of w. If the channels of a pixel add up incoherently, the relative error power is

        sum_ix |w - w' exp(j 2 pi f d)|^2 / sum_ix w^2,

    averaged over the frequencies f of the lines' band (cycles per metre of range). It includes the
    errors of phases and of envelopes, and reaches +3 dB where phases are unrelated.
    """
    lines, beam = inputs.lines, inputs.beam
    if lines.rx_velocity_m_s is None and inputs.sonar is not None and inputs.track is not None:
        velocity_m_s = np.repeat(inputs.track.velocity_m_s, inputs.sonar.receivers, axis=0)
        lines = replace(lines, rx_velocity_m_s=velocity_m_s)
    some = some_channels(lines.channels, _CHANNELS)
    part = lines.select(some)
    points_m, flat_m = _pixels_m(inputs.grid)
    range_m = _ranges_m(points_m, part)

    # Weights with all effects, [pixels, channels]: 1 where a line contains the pixel, times the
    # beam, times the elements' patterns if the lines have them.
    contains = (range_m >= part.first_range_m) & (range_m <= part.last_range_m)
    inside = contains.astype(np.float64)
    weights, along = inside, None
    if beam is not None:
        along = beam.directions(lines)
        sine = sines(points_m, part.phase_centres_m, along[some]).T
        weights = inside * beam.weights(sine, wavelength_m(lines))
    pattern, of_lines = None, np.ones(1)
    if inputs.directive is not None:
        pattern = _pattern(points_m, range_m, part, some, *inputs.directive, inputs.pointing)
        if inputs.element_pattern:
            of_lines = pattern
    weighted = weights * of_lines

    # Frequencies of the band with equal shares of the power, in cycles per metre of range.
    spectrum = measure_spectrum(lines)
    shares = (np.arange(_FREQUENCIES // 2) + 0.5) / (_FREQUENCIES // 2)
    away = np.interp(shares, np.cumsum(spectrum.share), spectrum.frequency)
    beside = np.concatenate([-away, away]) / lines.range_step_m
    cycles_per_m = cycles_per_m_at(lines, spectrum.centre) + beside
    middle_m = band_wavelength_m(lines, spectrum.centre)

    # Errors of ranges, whose phases and envelopes are wrong.
    ranges_m = {
        name: _ranges_m(points_m, without(lines).select(some))
        for name, without in LINES_WITHOUT.items()
        if name != MOTION or lines.rx_velocity_m_s is not None
    }
    ranges_m[RELIEF] = _ranges_m(flat_m, part)
    errors: dict[str, _Error] = {}
    square = weighted**2
    total = max(square.sum(), 1e-30)
    for name, other_m in ranges_m.items():
        away_m = other_m - range_m
        # |1 - exp(j a)|^2 = 4 sin^2(a/2)
        wrong = np.mean([4 * np.sin(np.pi * f * away_m) ** 2 for f in cycles_per_m], axis=0)
        rms_m = np.sqrt(np.sum(square * away_m**2) / total)
        most_m = np.abs(away_m).max(where=weighted > 0, initial=0.0)
        waves = 2 / middle_m  # the path is twice the range
        error_db = in_db(np.sum(square * wrong) / total)
        errors[name] = error_db, float(rms_m * waves), float(most_m * waves)

    # Errors of amplitudes, of refraction, and of the ends of lines.
    if pattern is not None:
        errors[PATTERN] = _error_of_weights(weights * pattern, weights)
    if beam is not None:
        errors[BEAM] = _error_of_weights(weighted, inside * of_lines)
    if inputs.in_profile is not None and inputs.in_profile.visible.any():
        away_s = _straight_errors_s(inputs.in_profile)
        cycles_per_s = lines.sound_speed_m_s / middle_m
        errors[REFRACTION] = (
            in_db(np.mean(4 * np.sin(np.pi * cycles_per_s * away_s) ** 2)),
            float(np.sqrt(np.mean(away_s**2)) * cycles_per_s),
            float(np.abs(away_s).max() * cycles_per_s),
        )
    if inputs.ends:
        error = ends_error(inputs.lines, inputs.grid, spectrum, beam, along)
        errors[ENDS] = in_db(error), None, None
    return errors


def _straight_errors_s(sample: RaySample) -> NDArray[np.float64]:
    """Return the errors of delays along straight rays of the speed that fits them best, [pairs]."""
    lines, delay_s = sample.lines, sample.delay_s[sample.visible]
    for _ in range(2):  # the positions of moving receivers depend a little on the speed
        range_m = straight_m(lines, sample.points_m)[sample.visible]
        lines = at_speed(lines, float(2 * (range_m @ delay_s) / (delay_s @ delay_s)))
    range_m = straight_m(lines, sample.points_m)[sample.visible]
    return 2 * range_m / lines.sound_speed_m_s - delay_s


def _error_of_weights(with_it: NDArray[np.float64], without: NDArray[np.float64]) -> _Error:
    """Return the error of an image with other weights."""
    error = np.sum((with_it - without) ** 2) / max(np.sum(with_it**2), 1e-30)
    return in_db(error), None, None


def _ranges_m(points_m: NDArray[np.float64], lines: RangeLines) -> NDArray[np.float64]:
    """Return the ranges of points for every channel of some lines, [points, channels]."""
    return pairwise_range_m(
        points_m, lines.tx_m, lines.rx_m, lines.rx_velocity_m_s, lines.sound_speed_m_s
    )


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


def track_errors_m(lines: RangeLines) -> NDArray[np.float64]:
    """Return the distances of channels from a straight track, [channels, 3], in metres.

    The track is the line that fits the phase centres of the pings best. If all pings have the same
    number of channels, the mean distance of a channel over all pings is the shape of the array and
    not an error.
    """
    centres_m = lines.phase_centres_m
    counts = channels_per_ping(lines.ping_starts, lines.channels)
    pings_m = lines.ping_centres_m
    direction = course(pings_m)
    away_m = centres_m - pings_m.mean(axis=0)
    away_m = away_m - np.outer(away_m @ direction, direction)
    if (counts == counts[0]).all():
        by_ping = away_m.reshape(-1, counts[0], 3)
        away_m = (by_ping - by_ping.mean(axis=0)).reshape(-1, 3)
    # Rounding puts channels of a straight track beside it.
    size_m = np.abs(centres_m).max()
    return np.where(np.abs(away_m) > 1e-14 * size_m, away_m, 0.0)


def _pattern(
    points_m: NDArray[np.float64],
    range_m: NDArray[np.float64],
    lines: RangeLines,
    numbers: NDArray[np.int64],
    sonar: Sonar,
    track: Track,
    pointing: Pointing | None,
) -> NDArray[np.float64]:
    """Return the two-way pattern at the carrier, [pixels, channels]; it is 0 behind a face.

    `numbers` are those of the channels of `lines` in the survey.
    """
    axes = (pointing or Pointing.broadside()).axes(track)
    axes = axes[numbers // sonar.receivers]
    received_m = np.broadcast_to(lines.rx_m, (len(points_m), *lines.rx_m.shape))
    if lines.rx_velocity_m_s is not None:
        speed = lines.rx_velocity_m_s / lines.sound_speed_m_s
        received_m = received_m + 2 * range_m[..., None] * speed
    pattern = np.ones_like(range_m)
    antennas = (
        (lines.tx_m, sonar.tx_length_m, sonar.tx_height_m),
        (received_m, sonar.rx_length_m, sonar.rx_height_m),
    )
    for position_m, length_m, height_m in antennas:
        look = unit_vectors(points_m[:, None] - position_m)
        components = np.einsum("pci,cai->apc", look, axes)
        pattern *= components[1] > -_IN_FRONT
        for size_m, sine in ((length_m, components[0]), (height_m, components[2])):
            if size_m is not None:
                frequency_hz, sound = sonar.pulse.carrier_hz, sonar.sound_speed_m_s
                pattern *= element_pattern(size_m, sine, frequency_hz, sound)
    return pattern


@dataclass(frozen=True)
class Effect:
    """An effect that an image may model, with the error without it and the time it costs.

    Attributes
    ----------
    name : str
    modelled : bool
        True if the image as given models the effect.
    error_db : float or None
        Relative rms error of the image without the effect, in dB: -300 if it has no influence, None
        if the inputs are not sufficient to know.
    range_wavelengths, most_wavelengths : float or None
        Rms and largest error of the ranges without the effect, in wavelengths; None for effects on
        amplitudes.
    needed : bool or None
        True if the error power is more than `simplify.SHARE` of the power that the
        tolerance allows; None if the error is not known.
    left_out : bool
        True if `clsas.plan` and `clsas.backproject` leave the effect out of their own accord. They
        move antennas to compensate for it.
    seconds : float or None
        Time by which the effect makes the image slower; negative if it makes it faster. None if
        there is no image without it.
    key : str
        Key of a scene file that leaves the effect out; "" if there is none.

    See Also
    --------
    assess : Function that returns it, with an example.
    """

    name: str
    modelled: bool
    error_db: float | None
    range_wavelengths: float | None
    most_wavelengths: float | None
    needed: bool | None
    left_out: bool
    seconds: float | None
    key: str

    __repr__ = reprs.of_fields


@dataclass(frozen=True)
class Assessment:
    """Effects of an image, with errors and times, as returned by `assess`.

    Attributes
    ----------
    tolerance_db : float
        Relative rms error that is allowed, in dB.
    wavelength_m : float
        Wavelength at the middle of the band, in metres.
    channels : int
        Number of range lines.
    pixels : tuple of int
        Shape of the grid.
    device : str
        Device that forms the image.
    measured : bool
        True if times were measured, False if the cost model predicts them.
    seconds, simple_seconds : float
        Time of the image with all modelled effects, and of the image as it is formed, without
        those that are left out.
    effects : tuple of Effect
        All effects; ``assessment[name]`` is the one with a name.

    See Also
    --------
    assess : Function that returns it, with an example.
    """

    tolerance_db: float
    wavelength_m: float
    channels: int
    pixels: tuple[int, ...]
    device: str
    measured: bool
    seconds: float
    simple_seconds: float
    effects: tuple[Effect, ...]

    def __repr__(self) -> str:
        """Return a summary: the tolerance, and which effects are missing or not needed."""
        return reprs.summary(
            self,
            f"tolerance {reprs.quantity(self.tolerance_db, 'dB')}",
            f"{len(self.effects)} effects",
            f"needed and not modelled: {', '.join(self.missing) or 'none'}",
            f"modelled and not needed: {', '.join(self.spare) or 'none'}",
            self.device,
        )

    def _repr_html_(self) -> str:
        return self._report().html()

    def __getitem__(self, name: str) -> Effect:
        """Return the effect with a name; raise KeyError if there is none."""
        return {effect.name: effect for effect in self.effects}[name]

    @property
    def spare(self) -> tuple[str, ...]:
        """Names of the effects that are modelled but not needed."""
        return tuple(
            e.name for e in self.effects if e.modelled and e.needed is False and e.name != ENDS
        )

    @property
    def missing(self) -> tuple[str, ...]:
        """Names of the effects that are needed but not modelled."""
        return tuple(e.name for e in self.effects if e.needed and not e.modelled)

    def describe(self) -> str:
        """Return a table of the effects as text."""
        return self._report().text()

    def _report(self) -> Report:
        names = ("effect", "modelled", "error", "wavelengths", "needed", "costs", "left out")
        rows = []
        for e in self.effects:
            error = wavelengths = "-"
            if e.error_db is not None:
                error = "none" if e.error_db < NONE_DB else f"{e.error_db:.1f} dB"
            if e.range_wavelengths is not None and e.most_wavelengths is not None:
                wavelengths = f"{e.range_wavelengths:.2g}, at most {e.most_wavelengths:.2g}"
                if not e.most_wavelengths:
                    wavelengths = "none"
            rows.append(
                (
                    e.name,
                    "yes" if e.modelled else "no",
                    error,
                    wavelengths,
                    {True: "yes", False: "no", None: "-"}[e.needed],
                    "-" if e.seconds is None else f"{1e3 * e.seconds:+.0f} ms",
                    "yes" if e.left_out else "-",
                )
            )
        how = "measured" if self.measured else "predicted"
        before = [
            f"{' x '.join(map(str, self.pixels))} pixels from {self.channels} channels, tolerance "
            f"{self.tolerance_db:.4g} dB, wavelength {1e3 * self.wavelength_m:.4g} mm; "
            f"{1e3 * self.seconds:.0f} ms with all effects modelled, "
            f"{1e3 * self.simple_seconds:.0f} ms as it is formed ({how}, {self.device})",
        ]
        after = []
        for name in self.missing:
            after.append(f"Needed and not modelled: {name}")
        for name in self.spare:
            how = f": {KEYS[name]}" if KEYS[name] else ""
            after.append(f"Modelled and not needed: {name}{how}")
        return Report([*before, Table(names, rows, align="left"), *after])


def survey_lines(
    sonar: Sonar,
    track: Track,
    grid: Grid,
    *,
    motion_in_flight: bool = False,
    phase_centres: bool = False,
    window: Window = "none",
    oversampling: float = 2.0,
    sound_speed: SoundSpeed | None = None,
) -> RangeLines:
    """Return range lines of a single point, with the geometry and the band of a survey.

    They take little time to compute, and can replace the lines of the survey in `assess` and
    `plan`. They extend from the range of the nearest pixel of the grid to that of the farthest,
    and some samples beyond.

    Parameters
    ----------
    sonar : Sonar
    track : Track
    grid : Grid
        Pixels of the image. The point lies in the middle of the grid.
    motion_in_flight, phase_centres : bool
        As for `clsas.simulate`.
    window, oversampling
        As for `clsas.compress`.
    sound_speed : SoundSpeed, optional
        Sound speed over depth, as for `clsas.simulate`.

    Returns
    -------
    RangeLines

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is out of bounds, or the lines do not fit into
        memory.

    See Also
    --------
    assess : Effects that the image of a survey needs.

    Examples
    --------
    >>> import clsas
    >>> sonar = clsas.Sonar(clsas.Pulse(100e3, 20e3, 1e-3), [[0.0, 0, 0]])
    >>> track = clsas.Track.straight((0, 0, 0), (1.0, 0, 0), pings=32, ping_interval_s=0.1)
    >>> grid = clsas.Grid.plane((1.0, 2.0, 101), (20.0, 21.0, 101))
    >>> lines = clsas.survey_lines(sonar, track, grid)
    >>> lines.samples.shape
    (32, 122)
    """
    geometry = channels(sonar, track, motion_in_flight=motion_in_flight)
    validate.instance("grid", grid, Grid)
    check_declared(compress, {"window": window, "oversampling": oversampling})
    if validate.flag("phase_centres", phase_centres):
        middle_m = (geometry.tx_m + geometry.rx_m) / 2
        geometry = geometry._replace(tx_m=middle_m, rx_m=middle_m)
    pulse = sonar.pulse
    step_m = sonar.sound_speed_m_s / (2 * float(oversampling) * pulse.bandwidth_hz)
    range_m = pairwise_range_m(grid.spread(), *geometry, sonar.sound_speed_m_s)
    near_m, far_m = range_m.min(axis=0), range_m.max(axis=0)
    if sound_speed is not None:
        validate.instance("sound_speed", sound_speed, SoundSpeed)
        near_m, far_m = range_bounds_m(sound_speed, near_m, far_m, sonar.sound_speed_m_s)
    # Filters read beyond the grid on either side.
    first_m = near_m - MOST_TAPS * step_m
    extent = float((far_m - first_m).max() / step_m)
    validate.memory("oversampling", 8 * len(first_m) * extent)
    length = math.ceil(extent) + MOST_TAPS
    middle = np.ravel_multi_index([n // 2 for n in grid.shape], grid.shape)
    lines = simulate_lines(
        geometry.tx_m,
        geometry.rx_m,
        PointTargets(grid.at(np.array([middle]))),
        carrier_hz=pulse.carrier_hz,
        bandwidth_hz=pulse.bandwidth_hz,
        window=window,
        oversampling=oversampling,
        sound_speed_m_s=sonar.sound_speed_m_s,
        first_range_m=first_m,
        length=length,
        rx_velocity_m_s=geometry.rx_velocity_m_s,
        sound_speed=sound_speed,
    )
    return replace(lines, bank_numbers=sonar.channel_banks(track.pings))
