"""Which effects an image needs: the error of leaving each out, and the time that it takes."""

from __future__ import annotations

import statistics
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from clsas import interpolation, validate
from clsas.backproject import execute, prepare, wavelength_m
from clsas.costs import Costs
from clsas.decibels import in_db, power
from clsas.device import Device, open_device
from clsas.ends import ends_error
from clsas.factorize import factorize
from clsas.forecast import HALF_ROUNDING
from clsas.geometry import pairwise_range_m
from clsas.grid import Grid
from clsas.lines import RangeLines, some_channels
from clsas.plan import Plan
from clsas.planner import BEST_TOLERANCE_DB, TOLERANCE_DB, WORST_TOLERANCE_DB, plan
from clsas.scene import PointTargets
from clsas.simplify import APART, MOTION, RELIEF, SHARE, leave_out, simplify
from clsas.simulate import simulate_lines
from clsas.sonar import Sonar, element_pattern
from clsas.surface import surface_of
from clsas.track import Pointing, Track, channels
from clsas.window import BeamWindow, sines

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
"""What leaves an effect out of a scene file; nothing does that is decided by grid or device."""

NONE_DB = -250.0
"""Below this an error is none at all."""

_CHANNELS, _PIXELS = 256, 16  # sampled: channels, and pixels along either side of the grid
_FREQUENCIES = 8  # of the band, each with as much of the power
_ROOM = 32  # samples of a survey's lines beyond the grid
_BEFORE = 1e-12  # of a direction: what lies in the plane of an element's face is before it


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
        Whether its error is more than `clsas.simplify.SHARE` of the power that the tolerance
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

    def __getitem__(self, name: str) -> Effect:
        """Return the effect of a name."""
        return {effect.name: effect for effect in self.effects}[name]

    @property
    def spare(self) -> tuple[str, ...]:
        """Effects that are modelled and not needed."""
        return tuple(e.name for e in self.effects if e.modelled and e.needed is False)

    @property
    def missing(self) -> tuple[str, ...]:
        """Effects that are needed and not modelled."""
        return tuple(e.name for e in self.effects if e.needed and not e.modelled)

    def describe(self) -> str:
        """Return a table of the effects."""
        rows = [("effect", "modelled", "error", "wavelengths", "needed", "costs", "left out")]
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
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        table = ["  ".join(f"{c:<{w}}" for c, w in zip(r, widths, strict=True)) for r in rows]
        how = "measured" if self.measured else "predicted"
        text = [
            f"{' x '.join(map(str, self.pixels))} pixels from {self.channels} channels, tolerance "
            f"{self.tolerance_db:.4g} dB, wavelength {1e3 * self.wavelength_m:.4g} mm; "
            f"{1e3 * self.seconds:.0f} ms with all effects modelled, "
            f"{1e3 * self.simple_seconds:.0f} ms as it is formed ({how}, {self.device})",
            *(row.rstrip() for row in table),
        ]
        for name in self.missing:
            text.append(f"Needed and not modelled: {name}")
        for name in self.spare:
            how = f": {KEYS[name]}" if KEYS[name] else ""
            text.append(f"Modelled and not needed: {name}{how}")
        return "\n".join(text)


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
        Whose times count; see `clsas.device.choose`.
    costs : Costs, optional
        Instead of those stored for the device.
    repeats : int
        Form the image with and without every effect so many times, in turns, and tell the median
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
    For a sample of channels i and pixels x, all over the grid and its corners among them, ranges
    without an effect differ by d from those of the full model, in float64, and weights w' from w.
    The relative error of an image whose channels add up incoherently is then

        sum_ix |w - w' exp(j 2 pi f d)|^2 / sum_ix w^2,

    averaged over the frequencies f of the lines' band (cycles per metre of range). That holds
    phases and the shift of envelopes, and grows to +3 dB where phases have nothing in common.
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
    device = open_device(device)
    left_out = simplify(lines, grid, beam, tolerance_db).left_out
    variants = _variants(lines, grid, beam)
    if left_out:
        variants[_SIMPLE] = lines, grid, beam
    full = lines
    if lines.rx_velocity_m_s is None and sonar is not None and track is not None:
        velocity = np.repeat(track.velocity_m_s, sonar.receivers, axis=0)
        full = replace(lines, rx_velocity_m_s=velocity)
    sample = _Sample.of(full, grid, beam)
    if sonar is not None and track is not None and not sonar.is_omnidirectional:
        sample = replace(sample, pattern=_pattern(sample, sonar, track, pointing))
    has_pattern = sample.pattern is not None and element_pattern
    in_full = sample.weights * (1.0 if not has_pattern else sample.pattern)

    moved: dict[str, NDArray[np.float64]] = {}
    some, points_m = sample.lines, sample.points_m
    antennas = some.tx_m, some.rx_m, some.rx_velocity_m_s, some.sound_speed_m_s
    if some.rx_velocity_m_s is not None:
        moved[MOTION] = pairwise_range_m(points_m, some.tx_m, some.rx_m)
    middle_m = some.phase_centres_m
    moved[APART] = pairwise_range_m(points_m, middle_m, middle_m, *antennas[2:])
    moved[RELIEF] = pairwise_range_m(sample.flat_m, *antennas)
    off_m = track_errors_m(lines)[sample.channels]
    moved[SWAY] = pairwise_range_m(points_m, some.tx_m - off_m, some.rx_m - off_m, *antennas[2:])
    weighted: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
    if sample.pattern is not None:
        weighted[PATTERN] = sample.weights * sample.pattern, sample.weights
    if beam is not None:
        without = sample.inside * (sample.pattern if has_pattern else 1.0)
        weighted[BEAM] = in_full, without

    plans = _plans(variants, tolerance_db, device, costs)
    taken = {name: each.predicted_seconds for name, each in plans.items()}
    fast = plans[_FULL]
    if repeats:
        if fast.half_precision:
            variants[SINGLE] = variants[_FULL]
            plans[SINGLE] = replace(fast, half_precision=False)
        taken = _measured(variants, plans, device, repeats)
    known: dict[str, tuple[float, float | None, float | None]] = {
        name: sample.error_of_ranges(range_m, in_full) for name, range_m in moved.items()
    }
    known |= {name: (in_db(_of_weights(*pair)), None, None) for name, pair in weighted.items()}
    if ends:
        along = None if beam is None else beam.directions(lines)
        known[ENDS] = in_db(ends_error(lines, grid, beam, along)), None, None
    if not fast.is_exact and not fast.nearest and device.info.half_precision:
        # Lines are rounded when they are upsampled and by every stage, there as half of sums too.
        rounding = HALF_ROUNDING * (1 + 1.5 * len(fast.sides))
        known[SINGLE] = in_db(rounding), None, None
    modelled = {
        MOTION: lines.rx_velocity_m_s is not None,
        APART: not np.array_equal(lines.tx_m, lines.rx_m),
        RELIEF: not surface_of(grid).is_plane,
        SWAY: bool(np.abs(track_errors_m(lines)).max() > 0),
        PATTERN: has_pattern,
        BEAM: beam is not None,
        ENDS: True,
        SINGLE: not fast.half_precision,
    }
    allowed = SHARE * power(tolerance_db)
    effects = []
    for name, key in KEYS.items():
        error_db, rms, most = known.get(name, (None, None, None))
        needed = None if error_db is None else power(error_db) > allowed
        if name == SINGLE and error_db is not None:
            needed = not fast.half_precision
        costs_s = taken[_FULL] - taken[name] if name in taken else None
        if name == SINGLE and costs_s is not None:
            costs_s = -costs_s  # the image is formed without it
        effects.append(
            Effect(
                name, modelled[name], error_db, rms, most, needed, name in left_out, costs_s, key
            )
        )
    return Assessment(
        tolerance_db=float(tolerance_db),
        wavelength_m=sample.wavelength_m,
        channels=lines.channels,
        pixels=grid.shape,
        device=device.info.label,
        measured=repeats > 0,
        seconds=taken[_FULL],
        simple_seconds=taken.get(_SIMPLE, taken[_FULL]),
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
    range_m = pairwise_range_m(grid.spread(_PIXELS), *geometry, sonar.sound_speed_m_s)
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


def track_errors_m(lines: RangeLines) -> NDArray[np.float64]:
    """Return how far channels lie beside where a straight track has them, [channels, 3], metres.

    The track is the line that fits the pings' phase centres best. What all pings have in common
    is the array's shape: where each has the same number of channels, the mean of each over the
    pings is no track error.
    """
    centres_m = lines.phase_centres_m
    starts = lines.ping_starts
    counts = np.diff(np.append(starts, lines.channels))
    pings_m = np.add.reduceat(centres_m, starts, axis=0) / counts[:, None]
    middle_m = pings_m.mean(axis=0)
    direction = np.linalg.svd(pings_m - middle_m, full_matrices=False)[2][0]
    away_m = centres_m - middle_m
    away_m = away_m - np.outer(away_m @ direction, direction)
    if (counts == counts[0]).all():
        by_ping = away_m.reshape(-1, counts[0], 3)
        away_m = (by_ping - by_ping.mean(axis=0)).reshape(-1, 3)
    # What rounding leaves of a straight track is none.
    size_m = np.abs(centres_m).max()
    return np.where(np.abs(away_m) > 1e-14 * size_m, away_m, 0.0)


@dataclass(frozen=True, eq=False)
class _Sample:
    """Some channels and pixels, and how they see each other; arrays are [pixels, channels].

    Attributes
    ----------
    channels : int [channels]
        Which of all these are.
    lines : RangeLines
        Theirs, with everything modelled.
    points_m, flat_m : float64 [pixels, 3]
        The pixels, and where they lie on the plane without relief.
    range_m : float64
        Ranges of the full model.
    inside, weights : float64
        1 where a channel's line holds the pixel; the beam's weights there.
    cycles_per_m : float64 [frequencies]
        Of the band, each with as much of the power.
    wavelength_m : float
    pattern : float64 or None
        Two-way element patterns.
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
    pattern: NDArray[np.float64] | None = None

    @classmethod
    def of(cls, lines: RangeLines, grid: Grid, beam: BeamWindow | None) -> _Sample:
        """Return a sample of some lines and a grid."""
        some = some_channels(lines.channels, _CHANNELS)
        part = lines.select(some)
        points_m, flat_m = _pixels_m(grid)
        range_m = pairwise_range_m(
            points_m, part.tx_m, part.rx_m, part.rx_velocity_m_s, part.sound_speed_m_s
        )
        inside = (range_m >= part.first_range_m) & (range_m <= part.last_range_m)
        inside = inside.astype(np.float64)
        weights = inside
        if beam is not None:
            sine = sines(points_m, part.phase_centres_m, beam.directions(lines)[some]).T
            weights = inside * beam.weights(sine, wavelength_m(lines))
        spectrum = interpolation.measure_spectrum(lines)
        away = np.interp(
            (np.arange(_FREQUENCIES // 2) + 0.5) / (_FREQUENCIES // 2),
            np.cumsum(spectrum.power),
            spectrum.frequency,
        )
        centre = interpolation.cycles_per_m(lines, spectrum.centre)
        beside = np.concatenate([-away, away]) / lines.range_step_m
        return cls(
            some, part, points_m, flat_m, range_m, inside, weights, centre + beside,
            2 / max(abs(centre), 1e-30),
        )  # fmt: skip

    def error_of_ranges(
        self, range_m: NDArray[np.float64], weights: NDArray[np.float64]
    ) -> tuple[float, float, float]:
        """Return the error of other ranges, dB, and by how many wavelengths these are off.

        The latter rms and at most.
        """
        away_m = range_m - self.range_m
        square = weights**2
        total = max(square.sum(), 1e-30)
        # |1 - exp(j a)|^2 = 4 sin^2(a/2)
        wrong = np.mean([4 * np.sin(np.pi * f * away_m) ** 2 for f in self.cycles_per_m], axis=0)
        rms_m = np.sqrt(np.sum(square * away_m**2) / total)
        most_m = np.abs(away_m).max(where=weights > 0, initial=0.0)
        # A path is there and back.
        waves = 2 / self.wavelength_m
        return in_db(np.sum(square * wrong) / total), float(rms_m * waves), float(most_m * waves)


def _of_weights(full: NDArray[np.float64], without: NDArray[np.float64]) -> float:
    """Return the power of the error of other weights."""
    return float(np.sum((full - without) ** 2) / max(np.sum(full**2), 1e-30))


def _pixels_m(grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return pixels all over a grid and those of most relief, and where they lie without it."""
    places = [np.unique(np.linspace(0, n - 1, _PIXELS).round().astype(int)) for n in grid.shape]
    index = np.ravel_multi_index(np.ix_(*places), grid.shape).ravel()
    surface = surface_of(grid)
    if surface.is_plane:
        points_m = grid.at(index)
        return points_m, points_m
    index = np.append(index, [surface.off_m.argmin(), surface.off_m.argmax()])
    points_m = grid.at(index)
    return points_m, points_m - surface.off_m[index, None] * surface.steps_m[2]


def _pattern(
    sample: _Sample, sonar: Sonar, track: Track, pointing: Pointing | None
) -> NDArray[np.float64]:
    """Return the two-way pattern at the carrier, 0 behind an element's face."""
    lines = sample.lines
    axes = (pointing or Pointing.broadside()).axes(track)[sample.channels // sonar.receivers]
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


_FULL, _SIMPLE = "full", "simple"  # variants of an image, beside those without one effect

_Given = tuple[RangeLines, Grid, BeamWindow | None]


def _variants(lines: RangeLines, grid: Grid, beam: BeamWindow | None) -> dict[str, _Given]:
    """Return what an image is formed of in full, and without each effect that it models."""
    variants: dict[str, _Given] = {_FULL: (lines, grid, beam)}
    if beam is not None:
        beam = replace(beam, along=beam.directions(lines))  # which moved antennas would change
        variants[BEAM] = lines, grid, None
    if lines.rx_velocity_m_s is not None:
        variants[MOTION] = replace(lines, rx_velocity_m_s=None), grid, beam
    if not np.array_equal(lines.tx_m, lines.rx_m):
        middle_m = lines.phase_centres_m
        variants[APART] = replace(lines, tx_m=middle_m, rx_m=middle_m), grid, beam
    if not grid.is_planar and len(grid.shape) == 2:
        flat = leave_out(lines, grid, beam, (RELIEF,)).grid
        if flat.is_planar:
            variants[RELIEF] = lines, flat, beam
    off_m = track_errors_m(lines)
    if off_m.any():
        straight = replace(lines, tx_m=lines.tx_m - off_m, rx_m=lines.rx_m - off_m)
        variants[SWAY] = straight, grid, beam
    return variants


def _plans(
    variants: dict[str, _Given], tolerance_db: float, device: Device, costs: Costs | None
) -> dict[str, Plan]:
    """Return the plan of every variant."""
    plans = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", validate.ClsasWarning)  # of ends, which are an effect
        for name, (lines, on, beam) in variants.items():
            plans[name] = plan(
                lines,
                on,
                tolerance_db=tolerance_db,
                beam=beam,
                device=device,
                costs=costs,
                full_model=name != _SIMPLE,
            )
    return plans


def _measured(
    variants: dict[str, _Given], plans: dict[str, Plan], device: Device, repeats: int
) -> dict[str, float]:
    """Return the median time of every variant's image, formed in turns after an untimed one."""
    forms: dict[str, Callable[[], object]] = {}
    for name, (lines, grid, beam) in variants.items():
        forms[name] = partial(_form, lines, grid, beam, plans[name], device, name != _SIMPLE)
    seconds: dict[str, list[float]] = {name: [] for name in forms}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", validate.ClsasWarning)
        for turn in range(repeats + 1):
            for name, form in forms.items():
                start = time.perf_counter()
                form()
                if turn:
                    seconds[name].append(time.perf_counter() - start)
    return {name: statistics.median(each) for name, each in seconds.items()}


def _form(
    lines: RangeLines,
    grid: Grid,
    beam: BeamWindow | None,
    chosen: Plan,
    device: Device,
    full_model: bool,
) -> None:
    """Form an image from the beginning: without what an image before it has found out."""
    if not chosen.is_exact:
        factorize(lines, grid, replace(chosen), device=device)
        return
    execute(
        prepare(
            lines, grid, device=device, accuracy_db=chosen.accuracy_db, beam=beam,
            full_model=full_model,
        )
    )  # fmt: skip


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
