"""Which effects an image needs: the error of leaving each out, and the time that it takes."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass, replace

import numpy as np

from clsas.core import reprs, validate
from clsas.core.decibels import in_db, power
from clsas.core.geometry import pairwise_range_m
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.core.tables import Report, Table
from clsas.exact.backprojection import prepare
from clsas.exact.run import execute
from clsas.factorized.plan import Plan
from clsas.opencl.device import Device, open_device
from clsas.planning.costs import Costs
from clsas.planning.factorize import factorize
from clsas.planning.planner import BEST_TOLERANCE_DB, TOLERANCE_DB, WORST_TOLERANCE_DB, plan
from clsas.planning.prediction import half_precision_error
from clsas.products.effects import (
    BEAM,
    ENDS,
    KEYS,
    SINGLE,
    SWAY,
    ErrorWithout,
    Survey,
    band_wavelength_m,
    errors_without,
    track_errors_m,
)
from clsas.simulation.scenes import PointTargets
from clsas.simulation.simulator import simulate_lines
from clsas.sonar.beam import BeamWindow
from clsas.sonar.simplify import APART, MOTION, RELIEF, SHARE, leave_out, simplify
from clsas.sonar.system import Sonar
from clsas.sonar.track import Pointing, Track, channels

NONE_DB = -250.0
"""Below this an error is none at all."""

_POINTS = 16  # along either side of a grid, where the extent of lines is found
_ROOM = 32  # samples of a survey's lines beyond the grid


@dataclass(frozen=True)
class Effect:
    """What leaving out one effect does to an image.

    Attributes
    ----------
    name : str
    modelled : bool
        Whether lines, grid and beam hold the effect as they are.
    error_db : float or None
        Relative rms error of the image without it, dB; -300 where it does nothing, None where it
        cannot be told from what is given.
    range_wavelengths, most_wavelengths : float or None
        By how much ranges are off without it, rms and at most; None of effects on amplitudes.
    needed : bool or None
        Whether its error is more than `clsas.sonar.simplify.SHARE` of the power that the tolerance
        allows.
    left_out : bool
        Whether `clsas.plan` and `clsas.backproject` leave it out by themselves, with antennas
        moved to make up for it.
    seconds : float or None
        By how much less time the image takes without it; negative where it saves time.
    key : str
        What leaves it out of a scene file.
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
    """Which effects an image needs, and what they cost; made by `assess`.

    Attributes
    ----------
    tolerance_db : float
        Relative rms error allowed.
    wavelength_m : float
        At the middle of the band.
    channels : int
    pixels : tuple of int
        Shape of the grid.
    device : str
        Whose times these are.
    measured : bool
        Whether times were measured; otherwise the cost model predicts them.
    seconds, simple_seconds : float
        Time of the image with all effects that are modelled, and as it is formed: without those
        that are left out.
    effects : tuple of Effect
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
        """Return the tolerance, and which effects are missing and which could be left out."""
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
        """Return the effect of a name."""
        return {effect.name: effect for effect in self.effects}[name]

    @property
    def spare(self) -> tuple[str, ...]:
        """Effects that are modelled and not needed."""
        return tuple(
            e.name for e in self.effects if e.modelled and e.needed is False and e.name != ENDS
        )

    @property
    def missing(self) -> tuple[str, ...]:
        """Effects that are needed and not modelled."""
        return tuple(e.name for e in self.effects if e.needed and not e.modelled)

    def describe(self) -> str:
        """Return a table of the effects."""
        return self._report().text()

    def _report(self) -> Report:
        names = ("effect", "modelled", "error", "wavelengths", "needed", "costs", "left out")
        rows = []
        for e in self.effects:
            rows.append(
                (
                    e.name,
                    "yes" if e.modelled else "no",
                    _decibels(e.error_db),
                    _wavelengths(e),
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
    repeats: int = 0,
    ends: bool = True,
) -> Assessment:
    """Find out which effects an image needs: what its error would be without each of them.

    Parameters
    ----------
    lines : RangeLines
        What to image; `survey_lines` makes some of a sonar and a track.
    grid : Grid
        Where.
    beam : BeamWindow, optional
        Weights of the channels.
    tolerance_db : float
        Relative rms error allowed of the image, dB, from -75 to -10.
    sonar, track : Sonar, Track, optional
        What made the lines: tells element patterns, and the velocity of receivers where the lines
        hold none. Channels must be those of `clsas.channels`.
    pointing : Pointing, optional
        Where elements look.
    element_pattern : bool
        Whether the lines hold the sonar's element patterns.
    device : Device, str or int, optional
        Whose times count; see `clsas.opencl.device.choose`.
    costs : Costs, optional
        Instead of those stored for the device.
    repeats : int
        Form the image with and without every effect so many times, in turns, and tell the least
        times instead of predicted ones.
    ends : bool
        Whether the lines' ends are those of data.

    Returns
    -------
    Assessment

    Raises
    ------
    TypeError, ValueError
        If an argument is not what is allowed, or sonar and track do not have the lines' channels.
    DeviceError
        If there is no such device.

    Notes
    -----
    `clsas.products.effects.errors_without` tells how errors are found.
    """
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    validate.number(
        "tolerance_db", tolerance_db, "dB", least=BEST_TOLERANCE_DB, most=WORST_TOLERANCE_DB
    )
    validate.instance("sonar", sonar, Sonar, type(None))
    validate.instance("track", track, Track, type(None))
    repeats = validate.count("repeats", repeats, least=0)
    if sonar is not None and track is not None and sonar.receivers * track.pings != lines.channels:
        raise ValueError(
            f"sonar and track must have the channels of the lines, {lines.channels}, got "
            f"{sonar.receivers} receivers and {track.pings} pings"
        )
    survey = Survey(lines, grid, beam, sonar, track, pointing, element_pattern, ends)
    device = open_device(device)
    left_out = simplify(lines, grid, beam, tolerance_db).left_out
    images = _images(survey, bool(left_out), tolerance_db, device, costs)
    full = images[_FULL].plan
    seconds = {name: image.plan.predicted_seconds for name, image in images.items()}
    if repeats:
        if full.half_precision:
            images[SINGLE] = replace(images[_FULL], plan=full.changed(half_precision=False))
        seconds = _measured(images, device, repeats)
    errors, modelled = errors_without(survey), survey.modelled
    if not full.is_exact and device.info.half_precision:
        errors[SINGLE] = ErrorWithout(in_db(half_precision_error(len(full.sides))))
    modelled[SINGLE] = not full.half_precision
    allowed = SHARE * power(tolerance_db)
    effects = []
    for name, key in KEYS.items():
        error = errors.get(name)
        needed = None if error is None else power(error.error_db) > allowed
        costs_s = seconds[_FULL] - seconds[name] if name in seconds else None
        if name == SINGLE:  # images are formed in half precision where the plan says so
            needed = None if error is None else modelled[SINGLE]
            costs_s = None if costs_s is None else -costs_s
        effects.append(
            Effect(
                name,
                modelled[name],
                None if error is None else error.error_db,
                None if error is None else error.range_wavelengths,
                None if error is None else error.most_wavelengths,
                needed,
                name in left_out,
                costs_s,
                key,
            )
        )
    return Assessment(
        tolerance_db=float(tolerance_db),
        wavelength_m=band_wavelength_m(lines),
        channels=lines.channels,
        pixels=grid.shape,
        device=device.info.label,
        measured=repeats > 0,
        seconds=seconds[_FULL],
        simple_seconds=seconds.get(_SIMPLE, seconds[_FULL]),
        effects=tuple(effects),
    )


def survey_lines(
    sonar: Sonar,
    track: Track,
    grid: Grid,
    *,
    motion_in_flight: bool = False,
    phase_centres: bool = False,
    window: object = "none",
    oversampling: float = 2.0,
) -> RangeLines:
    """Return lines of a survey before anything is simulated: one point's, as long as the grid asks.

    They have the geometry and the band of the survey's lines.

    Parameters
    ----------
    sonar, track, grid
        The survey, and where it is imaged.
    motion_in_flight, phase_centres
        As for `clsas.simulate`.
    window, oversampling
        As for `clsas.compress`.

    Raises
    ------
    TypeError, ValueError
        As `clsas.simulate_lines` does.
    """
    geometry = channels(sonar, track, motion_in_flight=motion_in_flight)
    if phase_centres:
        middle_m = (geometry.tx_m + geometry.rx_m) / 2
        geometry = geometry._replace(tx_m=middle_m, rx_m=middle_m)
    pulse = sonar.pulse
    step_m = sonar.sound_speed_m_s / (2 * oversampling * pulse.bandwidth_hz)
    range_m = pairwise_range_m(grid.spread(_POINTS), *geometry, sonar.sound_speed_m_s)
    first_m = range_m.min(axis=0) - _ROOM * step_m
    length = int(np.ceil((range_m.max(axis=0) - first_m).max() / step_m)) + _ROOM
    middle = np.ravel_multi_index([n // 2 for n in grid.shape], grid.shape)
    return simulate_lines(
        geometry.tx_m,
        geometry.rx_m,
        PointTargets(grid.at(np.array([middle])), [1.0]),
        carrier_hz=pulse.carrier_hz,
        bandwidth_hz=pulse.bandwidth_hz,
        window=window,
        oversampling=oversampling,
        sound_speed_m_s=sonar.sound_speed_m_s,
        first_range_m=first_m,
        length=length,
        rx_velocity_m_s=geometry.rx_velocity_m_s,
    )


_FULL, _SIMPLE = "full", "simple"  # images beside those without one effect


@dataclass(frozen=True, eq=False)
class _Image:
    """An image to be formed: of what, and by which plan."""

    lines: RangeLines
    grid: Grid
    beam: BeamWindow | None
    plan: Plan
    full_model: bool

    def form(self, device: Device) -> None:
        """Form it from the beginning: without what an image before it has found out."""
        if not self.plan.is_exact:
            factorize(self.lines, self.grid, replace(self.plan), device=device)
            return
        preparation = prepare(
            self.lines,
            self.grid,
            device=device,
            accuracy_db=self.plan.image.accuracy_db,
            beam=self.beam,
            full_model=self.full_model,
        )
        execute(preparation)


def _images(
    survey: Survey, simple: bool, tolerance_db: float, device: Device, costs: Costs | None
) -> dict[str, _Image]:
    """Return the image in full, without each effect that it models, and as it is formed."""
    lines, grid, beam = survey.lines, survey.grid, survey.beam
    given: dict[str, tuple[RangeLines, Grid, BeamWindow | None]] = {_FULL: (lines, grid, beam)}
    if simple:
        given[_SIMPLE] = lines, grid, beam
    modelled = survey.modelled
    if modelled[BEAM]:
        given[BEAM] = lines, grid, None
        beam = replace(beam, along=beam.directions(lines))  # which moved antennas would change
    if modelled[MOTION]:
        given[MOTION] = replace(lines, rx_velocity_m_s=None), grid, beam
    if modelled[APART]:
        middle_m = lines.phase_centres_m
        given[APART] = replace(lines, tx_m=middle_m, rx_m=middle_m), grid, beam
    if modelled[RELIEF] and len(grid.shape) == 2:
        flat = leave_out(lines, grid, beam, (RELIEF,)).grid
        if flat.is_planar:
            given[RELIEF] = lines, flat, beam
    if modelled[SWAY]:
        off_m = track_errors_m(lines)
        straight = replace(lines, tx_m=lines.tx_m - off_m, rx_m=lines.rx_m - off_m)
        given[SWAY] = straight, grid, beam
    images = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", validate.ClsasWarning)  # of ends, which are an effect
        for name, (of, on, seen_by) in given.items():
            full_model = name != _SIMPLE
            chosen = plan(
                of,
                on,
                tolerance_db=tolerance_db,
                beam=seen_by,
                device=device,
                costs=costs,
                full_model=full_model,
            )
            images[name] = _Image(of, on, seen_by, chosen, full_model)
    return images


def _measured(images: dict[str, _Image], device: Device, repeats: int) -> dict[str, float]:
    """Return the least time of every image, formed in turns after an untimed one."""
    seconds: dict[str, list[float]] = {name: [] for name in images}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", validate.ClsasWarning)
        for turn in range(repeats + 1):
            for name, image in images.items():
                start = time.perf_counter()
                image.form(device)
                if turn:
                    seconds[name].append(time.perf_counter() - start)
    return {name: min(each) for name, each in seconds.items()}


def _decibels(error_db: float | None) -> str:
    if error_db is None:
        return "-"
    return "none" if error_db < NONE_DB else f"{error_db:.1f} dB"


def _wavelengths(effect: Effect) -> str:
    if effect.range_wavelengths is None or effect.most_wavelengths is None:
        return "-"
    if not effect.most_wavelengths:
        return "none"
    return f"{effect.range_wavelengths:.2g}, at most {effect.most_wavelengths:.2g}"
