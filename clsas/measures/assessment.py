"""Effects that an image needs: the error without each, and the time that each takes."""

from __future__ import annotations

import math
import time
import warnings
from dataclasses import dataclass, replace

import numpy as np

from clsas.core import validate
from clsas.core.decibels import in_db, power
from clsas.core.geometry import pairwise_range_m
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.exact.backprojection import prepare
from clsas.exact.run import execute
from clsas.factorized.factorization import Factorization
from clsas.factorized.plan import Plan
from clsas.measures.assessment_result import Assessment, Effect
from clsas.measures.effects import (
    BEAM,
    KEYS,
    SINGLE,
    SWAY,
    ErrorWithout,
    Survey,
    errors_without,
    track_errors_m,
)
from clsas.opencl.device import Device, open_device
from clsas.planning.costs import Costs
from clsas.planning.factorize import factorize
from clsas.planning.planner import BEST_TOLERANCE_DB, TOLERANCE_DB, WORST_TOLERANCE_DB, plan
from clsas.planning.prediction import half_precision_error
from clsas.signal.compression import Window
from clsas.signal.compression import check_options as check_compression
from clsas.signal.spectrum import band_wavelength_m, measure_spectrum
from clsas.simulation.scenes import PointTargets
from clsas.simulation.simulator import simulate_lines
from clsas.sonar.beam import BeamWindow
from clsas.sonar.simplify import APART, MOTION, RELIEF, SHARE, leave_out, simplify
from clsas.sonar.system import Sonar
from clsas.sonar.track import Pointing, Track, channels

_POINTS = 16  # grid points along either side at which ranges bound the extent of lines
_ROOM = 32  # samples of a survey's lines beyond the grid


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
    """Find out which effects an image needs: the error that it would have without each of them.

    Parameters
    ----------
    lines : RangeLines
        Lines to image; `survey_lines` makes them from a sonar and a track.
    grid : Grid
        Pixels of the image.
    beam : BeamWindow, optional
        Weights of the channels.
    tolerance_db : float
        Relative rms error allowed of the image, dB, from -75 to -10.
    sonar, track : Sonar, Track, optional
        Survey that the lines come from. It gives element patterns, and the receivers' velocity if
        the lines have none. Channels must be those of `clsas.channels`.
    pointing : Pointing, optional
        Directions of the elements.
    element_pattern : bool
        True if the lines hold the sonar's element patterns.
    device : Device, str or int, optional
        Device that forms the image; see `clsas.opencl.device.choose`.
    costs : Costs, optional
        Costs to use instead of those stored for the device.
    repeats : int
        Measure times instead of predicting them: form the image this many times with and without
        every effect, in turns, and take the shortest times.
    ends : bool
        True if recorded data end where the lines do.

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
    `clsas.measures.effects.errors_without` explains how errors are found.
    """
    tolerance_db = validate.number(
        "tolerance_db", tolerance_db, "dB", least=BEST_TOLERANCE_DB, most=WORST_TOLERANCE_DB
    )
    repeats = validate.count("repeats", repeats, least=0)
    survey = _checked_survey(lines, grid, beam, sonar, track, pointing, element_pattern, ends)
    device = open_device(device)
    left_out = simplify(lines, grid, beam, tolerance_db).left_out
    images = _images(survey, bool(left_out), tolerance_db, device, costs)
    full = images[_FULL].plan
    seconds = {name: image.plan.predicted_seconds for name, image in images.items()}
    if repeats:
        if full.half_precision:
            single = replace(full, image=replace(full.factorization, half_precision=False))
            images[SINGLE] = replace(images[_FULL], plan=single)
        seconds = _measured(images, device, repeats)
    errors, modelled = errors_without(survey), survey.modelled
    if not full.is_exact and device.info.half_precision:
        errors[SINGLE] = ErrorWithout(in_db(half_precision_error(len(full.sides))))
    modelled[SINGLE] = not full.half_precision
    return Assessment(
        tolerance_db=tolerance_db,
        wavelength_m=band_wavelength_m(lines, measure_spectrum(lines).centre),
        channels=lines.channels,
        pixels=grid.shape,
        device=device.info.label,
        measured=repeats > 0,
        seconds=seconds[_FULL],
        simple_seconds=seconds.get(_SIMPLE, seconds[_FULL]),
        effects=tuple(
            _effect(
                name,
                modelled[name],
                errors.get(name),
                SHARE * power(tolerance_db),
                name in left_out,
                seconds[_FULL] - seconds[name] if name in seconds else None,
            )
            for name in KEYS
        ),
    )


def _checked_survey(
    lines: RangeLines,
    grid: Grid,
    beam: BeamWindow | None,
    sonar: Sonar | None,
    track: Track | None,
    pointing: Pointing | None,
    element_pattern: bool,
    ends: bool,
) -> Survey:
    """Return a survey; raise TypeError or ValueError for arguments that do not fit together."""
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    validate.instance("sonar", sonar, Sonar, type(None))
    validate.instance("track", track, Track, type(None))
    validate.instance("pointing", pointing, Pointing, type(None))
    validate.flag("element_pattern", element_pattern)
    validate.flag("ends", ends)
    if sonar is not None and track is not None and sonar.receivers * track.pings != lines.channels:
        raise ValueError(
            f"sonar and track must have the channels of the lines, {lines.channels}, got "
            f"{sonar.receivers} receivers and {track.pings} pings"
        )
    return Survey(lines, grid, beam, sonar, track, pointing, element_pattern, ends)


def _effect(
    name: str,
    modelled: bool,
    error: ErrorWithout | None,
    allowed: float,
    left_out: bool,
    seconds: float | None,
) -> Effect:
    """Return one effect; it is needed if the power of its error is more than `allowed`."""
    needed = None if error is None else power(error.error_db) > allowed
    if name == SINGLE:  # images are formed in half precision where the plan says so
        needed = None if error is None else modelled
        seconds = None if seconds is None else -seconds
    return Effect(
        name,
        modelled,
        None if error is None else error.error_db,
        None if error is None else error.range_wavelengths,
        None if error is None else error.most_wavelengths,
        needed,
        left_out,
        seconds,
        KEYS[name],
    )


def survey_lines(
    sonar: Sonar,
    track: Track,
    grid: Grid,
    *,
    motion_in_flight: bool = False,
    phase_centres: bool = False,
    window: Window = "none",
    oversampling: float = 2.0,
) -> RangeLines:
    """Return the lines of one point, with the geometry and the band of a survey's lines.

    They take little time, and are long enough for the grid.

    Parameters
    ----------
    sonar, track, grid
        The survey, and the pixels of its image.
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
    validate.instance("grid", grid, Grid)
    check_compression(window=window, oversampling=oversampling)
    if validate.flag("phase_centres", phase_centres):
        middle_m = (geometry.tx_m + geometry.rx_m) / 2
        geometry = geometry._replace(tx_m=middle_m, rx_m=middle_m)
    pulse = sonar.pulse
    step_m = sonar.sound_speed_m_s / (2 * float(oversampling) * pulse.bandwidth_hz)
    range_m = pairwise_range_m(grid.spread(_POINTS), *geometry, sonar.sound_speed_m_s)
    first_m = range_m.min(axis=0) - _ROOM * step_m
    extent = float((range_m.max(axis=0) - first_m).max() / step_m)
    validate.memory("oversampling", 8 * len(first_m) * extent)
    length = math.ceil(extent) + _ROOM
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
    """An image to be formed: its inputs and its plan."""

    lines: RangeLines
    grid: Grid
    beam: BeamWindow | None
    plan: Plan
    full_model: bool

    def form(self, device: Device) -> None:
        """Form the image with a fresh copy of the plan, which has kept nothing of earlier runs."""
        image = self.plan.image
        if isinstance(image, Factorization):
            factorize(self.lines, self.grid, replace(self.plan), device=device)
            return
        preparation = prepare(
            self.lines,
            self.grid,
            device=device,
            accuracy_db=image.accuracy_db,
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
    if beam is not None:
        given[BEAM] = lines, grid, None
        # The directions of these lines, which moving antennas would change.
        beam = replace(beam, along=beam.directions(lines))
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
        for name, (some_lines, some_grid, some_beam) in given.items():
            full_model = name != _SIMPLE
            chosen = plan(
                some_lines,
                some_grid,
                tolerance_db=tolerance_db,
                beam=some_beam,
                device=device,
                costs=costs,
                full_model=full_model,
            )
            images[name] = _Image(some_lines, some_grid, some_beam, chosen, full_model)
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
