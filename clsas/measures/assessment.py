"""Effects that an image needs: the error without each of them, and the time that it costs."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated

import numpy as np

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import in_db, power
from clsas.engine.data.declared import Count, check_declared
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, band_wavelength_m
from clsas.engine.data.simplify import REFRACTION, RELIEF, SHARE, leave_out
from clsas.engine.data.sound_speed import SoundSpeed
from clsas.engine.data.system import Sonar
from clsas.engine.data.track import Pointing, Track, channels
from clsas.engine.device.device import Device, open_device
from clsas.engine.factorized.costs import Costs
from clsas.engine.factorized.errors import half_precision_error
from clsas.engine.factorized.plan import Plan
from clsas.engine.factorized.planner import TOLERANCE_DB, checked_tolerance_db
from clsas.engine.forming import form
from clsas.engine.imaging import plan
from clsas.engine.scene import Scene
from clsas.engine.signal.compression import Window, compress
from clsas.engine.signal.spectrum import measure_spectrum
from clsas.engine.water.refraction import homogeneous
from clsas.measures.assessment_result import Assessment, Effect
from clsas.measures.effects import (
    BEAM,
    KEYS,
    LINES_WITHOUT,
    SINGLE,
    ErrorWithout,
    Survey,
    errors_without,
)
from clsas.simulation.scenes import PointTargets
from clsas.simulation.simulator import simulate_lines

_FULL, _FORMED = "full", "formed"  # images beside those without one effect
_POINTS = 16  # grid points along either side whose ranges determine the extent of lines
_MARGIN = 32  # samples of the lines of a survey on either side of the grid


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
        Relative rms error of the image that is allowed, in dB, from -75 to -10.
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
    `clsas.measures.effects.errors_without` has the equation. Without an effect, an image is planned
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
    tolerance_db = checked_tolerance_db(tolerance_db)
    repeats = check_declared(assess, {"repeats": repeats})["repeats"]
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    start, water = time.perf_counter(), None
    if lines.sound_speed is not None:
        water = homogeneous(lines, grid, beam, None, corrected=False)
        lines, grid, beam = water.lines(lines), water.grid, water.beam
    refraction_s = time.perf_counter() - start
    survey = Survey(lines, grid, beam, sonar, track, pointing, element_pattern, ends, water)
    device = open_device(device)
    images = _images(survey, partial(plan, tolerance_db=tolerance_db, device=device, costs=costs))
    full, left_out = images[_FULL].plan, images.get(_FORMED, images[_FULL]).plan.left_out
    if repeats and full.half_precision:
        single = replace(full, method=replace(full.factorization, half_precision=False))
        images[SINGLE] = replace(images[_FULL], plan=single)
    seconds = {name: image.plan.predicted_seconds for name, image in images.items()}
    if repeats:
        seconds = _measured(images, device, repeats)
    errors, modelled = errors_without(survey), survey.modelled
    modelled[SINGLE] = not full.half_precision
    if not full.is_exact and device.info.half_precision:
        errors[SINGLE] = ErrorWithout(in_db(half_precision_error(len(full.sides))))
    allowed = SHARE * power(tolerance_db)
    if water is not None and water.straight is not None:
        seconds[REFRACTION] = seconds[_FULL] - refraction_s
        if water.straight.error <= allowed:
            left_out = (*left_out, REFRACTION)
    return Assessment(
        tolerance_db=tolerance_db,
        wavelength_m=band_wavelength_m(lines, measure_spectrum(lines).centre),
        channels=lines.channels,
        pixels=grid.shape,
        device=device.info.label,
        measured=repeats > 0,
        seconds=seconds[_FULL],
        simple_seconds=seconds.get(_FORMED, seconds[_FULL]),
        effects=tuple(
            Effect(
                name=name,
                modelled=modelled[name],
                **vars(errors.get(name, ErrorWithout())),
                needed=_is_needed(name, modelled[name], errors.get(name), allowed),
                left_out=name in left_out,
                seconds=_costs_s(name, seconds),
                key=KEYS[name],
            )
            for name in KEYS
        ),
    )


def _is_needed(
    name: str, modelled: bool, error: ErrorWithout | None, allowed: float
) -> bool | None:
    """Return True if the error power without an effect exceeds `allowed`; None if it is unknown.

    The plan has decided about single precision already.
    """
    if error is None or error.error_db is None:
        return None
    return modelled if name == SINGLE else power(error.error_db) > allowed


def _costs_s(name: str, seconds: dict[str, float]) -> float | None:
    """Return the time that an effect costs, from images without it; None if there is none.

    Only the image for single precision has the effect that the full image lacks.
    """
    if name not in seconds:
        return None
    saved_s = seconds[_FULL] - seconds[name]
    return -saved_s if name == SINGLE else saved_s


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
    range_m = pairwise_range_m(grid.spread(_POINTS), *geometry, sonar.sound_speed_m_s)
    near_m, far_m = range_m.min(axis=0), range_m.max(axis=0)
    if sound_speed is not None:
        validate.instance("sound_speed", sound_speed, SoundSpeed)
        near_m = near_m * (sonar.sound_speed_m_s / sound_speed.speed_m_s.max())
        far_m = far_m * (sonar.sound_speed_m_s / sound_speed.speed_m_s.min())
    first_m = near_m - _MARGIN * step_m
    extent = float((far_m - first_m).max() / step_m)
    validate.memory("oversampling", 8 * len(first_m) * extent)
    length = math.ceil(extent) + _MARGIN
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


@dataclass(frozen=True, eq=False)
class _Image:
    """An image to be formed: its inputs and its plan."""

    lines: RangeLines
    grid: Grid
    beam: BeamWindow | None
    plan: Plan
    full_model: bool

    def form(self, device: Device) -> None:
        """Form the image."""
        allowed_db = None if self.full_model else self.plan.tolerance_db
        left_out = self.plan.left_out
        scene = Scene.of(self.lines, self.grid, self.beam, allowed_db, left_out=left_out)
        form(scene, self.plan, device)


def _images(survey: Survey, planned: Callable[..., Plan]) -> dict[str, _Image]:
    """Return the image with all effects, without each effect that it models, and as it is formed.

    The last is there only if the planner leaves out effects. `planned` is `clsas.plan` with the
    request.
    """
    lines, grid, beam = survey.lines, survey.grid, survey.beam
    inputs: dict[str, tuple[RangeLines, Grid, BeamWindow | None]] = {}
    if beam is not None:
        inputs[BEAM] = lines, grid, None
        # Moving antennas changes the directions of a track: keep those of the given lines.
        beam = replace(beam, along=beam.directions(lines))
    modelled = survey.modelled
    for name, without in LINES_WITHOUT.items():
        if modelled[name]:
            inputs[name] = without(lines), grid, beam
    if modelled[RELIEF] and len(grid.shape) == 2:
        flat = leave_out(lines, grid, beam, (RELIEF,)).grid
        if flat.is_planar:
            inputs[RELIEF] = lines, flat, beam
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", validate.ClsasWarning)  # of ends, which are an effect
        formed = planned(lines, grid, beam=survey.beam)
        full = formed
        if formed.left_out:
            full = planned(lines, grid, beam=survey.beam, full_model=True)
        images = {_FULL: _Image(lines, grid, survey.beam, full, full_model=True)}
        if formed.left_out:
            images[_FORMED] = _Image(lines, grid, survey.beam, formed, full_model=False)
        for name, given in inputs.items():
            chosen = planned(*given[:2], beam=given[2], full_model=True)
            images[name] = _Image(*given, chosen, full_model=True)
    return images


def _measured(images: dict[str, _Image], device: Device, repeats: int) -> dict[str, float]:
    """Return the shortest time of every image; they are formed in turns, after an untimed one."""
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
