"""The planner: what is asked for, and the plan of the fastest image that keeps to it.

A factorization competes with the exact image, and mean tracks of several shapes with each other.
What a beam does not cover, or what virtual channels cannot follow, is found first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import InitVar, dataclass, field, replace
from fractions import Fraction
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import amplitude, in_db, power
from clsas.engine.data.declared import Count, Flag, Number, Other, check_fields
from clsas.engine.data.digests import grid_digest, lines_digest
from clsas.engine.data.georeference import placed
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, some_channels, wavelength_m
from clsas.engine.data.validate import ArgumentError, ArgumentTypeError
from clsas.engine.data.visibility import is_within, sine_width, sines
from clsas.engine.device.device import Device
from clsas.engine.exact.decide import ACCURACY_DB, BEST_ACCURACY_DB
from clsas.engine.factorized import measured_costs
from clsas.engine.factorized.candidates import (
    EDGES_SHARE,
    Conditions,
    Outcome,
    exact_plan,
    fastest_plan,
    predicted_plan,
)
from clsas.engine.factorized.costs import (
    Costs,
    ExactPrediction,
    KnownCosts,
    predict_exact,
    worthwhile,
)
from clsas.engine.factorized.errors import leaf_error, nearest_errors
from clsas.engine.factorized.filters import ALIGN_TAPS
from clsas.engine.factorized.plan import UNREACHED, ErrorBudget, Plan, Work
from clsas.engine.factorized.sampled import SampledRoots, SampledScene, Side, points_at_m
from clsas.engine.factorized.search import MOST_STAGES, Choices
from clsas.engine.factorized.track import MeanTrack, shapes_after
from clsas.engine.factorized.virtual_channels import NearestBeams
from clsas.engine.scene import Scene
from clsas.engine.signal import interpolation
from clsas.engine.signal.ambiguity import MARGIN_DB

WORST_TOLERANCE_DB = -10.0
"""Loosest tolerance that may be requested."""
TOLERANCE_DB = -50.0
"""Tolerance of images for which none is requested."""
DEFAULT_REQUEST = {"tolerance_db": TOLERANCE_DB}
"""Request of an image without one."""
TOLERANCE = Number(
    "dB",
    least=BEST_ACCURACY_DB,
    most=WORST_TOLERANCE_DB,
    help="Largest relative rms error against the exact image.",
    default=f"{TOLERANCE_DB:g}",
)
"""Declares tolerances in dB."""

NEAREST_UPSAMPLING = 8.0
"""Upsampling of lines before their linear interpolation."""
SEARCH_S = 0.05
"""Time that a search takes at least: 0.05 to 0.12 s on a core of 2.5 GHz."""

_MOST_LEAF_ERROR = 1e-8  # power of the expansion of ranges in a tile: -80 dB
# `scripts/bench sensitivity` halves and doubles these; without a remark nothing changes.
_WORTH = 0.95  # of the time of an exact image, at most: less gain is within predictions' scatter

_NO_EXTENT = "all channels are at one place, or there is a single pixel"
_NOT_FASTER = "no factorization is faster within the tolerance"
_SOON_DONE = "it takes less time than the search for a factorization"

_SAMPLED_POINTS = np.linspace(0, 1, 17)  # fractions of rows and columns; their sines are smooth
_BINS = 512  # of power by aspect angle; half or twice as many change nothing
# Largest change of direction from one channel to the next, over the beam's width. At a kink of the
# track, the beam swings past pixels between two channels, which virtual channels cannot follow.
_MOST_TURNED = 1 / 16
_CELLS = 8, 3  # along and across a sheet: smooth directions are cubic across it at most
_LEAST_FILLED = 0.9  # share of these cells that contain channels, where directions differ
_EVERY_DIRECTION = (-2.0, 2.0)  # sines of the aspect angle, beyond any
# Share of the best pixel's sum of weights: normalising amplifies errors by its inverse.
_LEAST_COVERED = 0.25
_LEAST_SHARE_COVERED = 0.1  # of an image; below, little time is saved and errors scatter
_LEAST_PARTIAL = 0.25  # of an image; below, a step of the beam makes larger errors than predicted


@dataclass(frozen=True, eq=False)
class Request:
    """Arguments of `clsas.plan`, checked, with those that go together combined.

    Parameters are those of `clsas.plan`, and the same errors are raised.

    Attributes
    ----------
    lines, grid, beam, costs, full_model
        As given.
    tolerance_db : float or None
        The tolerance, also if it was given in wavelengths; None if stages were given.
    stages : sequence of (QR, QI) or None
    memory_bytes : int or None
    choices : Choices or None
        Filters and numbers of stages to choose from; None if the search is free.
    """

    lines: RangeLines
    grid: Grid
    tolerance_db: Annotated[float | None, TOLERANCE] = None
    tolerance_wavelengths: InitVar[Annotated[float | None, TOLERANCE_WAVELENGTHS]] = None
    stages: Annotated[Sequence[tuple[int, int]] | None, THESIS_STAGES] = None
    beam: BeamWindow | None = None
    memory_bytes: Annotated[int | None, Count(help="Device memory that may be used.")] = None
    costs: Costs | None = None
    taps: InitVar[tuple[int, int] | None] = None
    depth: InitVar[int | None] = None
    full_model: Annotated[bool, Flag(help="Model every effect, however small.")] = False
    choices: Choices | None = field(init=False, default=None)

    def __post_init__(
        self,
        tolerance_wavelengths: float | None,
        taps: tuple[int, int] | None,
        depth: int | None,
    ) -> None:
        """Check every argument, and combine those that go together."""
        validate.instance("lines", self.lines, RangeLines)
        validate.instance("grid", self.grid, Grid)
        placed(self.lines, self.grid)  # raises if the georeferences differ
        if self.beam is not None:
            validate.instance("beam", self.beam, BeamWindow)
        given = [self.tolerance_db, tolerance_wavelengths, self.stages]
        if sum(value is not None for value in given) != 1:
            raise ArgumentError(
                "tolerance_db",
                "be given, or one of `tolerance_wavelengths` and `stages`, and only one",
                f"{given[0]}, {given[1]} and {given[2]}",
            )
        validate.memory("grid", 8 * self.grid.size)
        check_fields(self)
        self._set("tolerance_db", tolerance_in_db(self.tolerance_db, tolerance_wavelengths))
        if self.stages is not None:
            self._set("stages", _stages_within(self.stages, self.lines, self.grid))
        self._set("choices", _choices(taps, depth))
        if self.choices is not None and self.stages is not None:
            hint = "`taps` and `depth` go with a tolerance"
            raise ArgumentError("stages", "be left out with `taps` or `depth`", hint=hint)
        if self.costs is not None:
            validate.instance("costs", self.costs, Costs)

    def _set(self, name: str, value: object) -> None:
        """Replace an argument by its checked value."""
        object.__setattr__(self, name, value)


def _checked_stages(_: str, stages: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return (QR, QI) of every stage; raise TypeError or ValueError if one is not allowed."""
    meaning = "a sequence of (QR, QI)"
    pairs = [
        validate.entries("stages", stage, meaning)
        for stage in validate.entries("stages", stages, meaning)
    ]
    if any(len(pair) != 2 for pair in pairs):
        raise ArgumentTypeError("stages", f"be {meaning}", validate.shown(stages))
    return [
        (validate.count("QR of stages", beams), validate.count("QI of stages", divisions))
        for beams, divisions in pairs
    ]


THESIS_STAGES = Other(
    _checked_stages,
    help="QR and QI of every stage of the thesis's method: the number of lines that are summed, "
    "and of divisions of a side.",
)
"""Declares stages of the thesis's method."""


def tolerance_in_db(
    tolerance_db: float | None, tolerance_wavelengths: float | None
) -> float | None:
    """Return the requested tolerance in dB, or None without one, after checking it."""
    if tolerance_db is not None:
        return TOLERANCE.check("tolerance_db", tolerance_db)
    if tolerance_wavelengths is None:
        return None
    return decibels(TOLERANCE_WAVELENGTHS.check("tolerance_wavelengths", tolerance_wavelengths))


def decibels(wavelengths: float) -> float:
    """Return the relative rms error of range errors spread evenly up to some wavelengths, dB."""
    return 20 * math.log10(4 * math.pi * wavelengths / math.sqrt(3))


def wavelengths(decibels: float) -> float:
    """Return the range error in wavelengths that causes a relative rms error in dB."""
    return amplitude(decibels) * math.sqrt(3) / (4 * math.pi)


TOLERANCE_WAVELENGTHS = Number(
    "wavelengths",
    least=wavelengths(BEST_ACCURACY_DB),
    most=wavelengths(WORST_TOLERANCE_DB),
    help="The tolerance as a range error, evenly distributed up to this many wavelengths.",
)
"""Declares tolerances in wavelengths."""


def _stages_within(
    stages: Sequence[tuple[int, int]], lines: RangeLines, grid: Grid
) -> list[tuple[int, int]]:
    """Return (QR, QI) of every stage; raise ValueError if lines or grid do not allow them."""
    pairs: list[tuple[int, int]] = THESIS_STAGES.check("stages", stages)
    if not pairs:
        return pairs
    if not grid.is_planar:
        raise ArgumentError("grid", "be a plane for `stages`")
    most_beams, most_divisions = lines.channels, max(min(grid.shape), 1)
    beams, divisions = (math.prod(numbers) for numbers in zip(*pairs, strict=True))
    if beams > most_beams or divisions > most_divisions:
        raise ArgumentError(
            "stages",
            "leave a line and a pixel",
            hint=f"they sum {beams} of {lines.channels} lines and divide {grid.shape[0]} x "
            f"{grid.shape[1]} pixels by {divisions} along either side",
        )
    return pairs


def _choices(taps: tuple[int, int] | None, depth: int | None) -> Choices | None:
    """Return the requested filters and stages; None if the search is free."""
    if taps is None and depth is None:
        return None
    fields = {}
    if taps is not None:
        meaning = "two, in range and along the aperture"
        given = validate.entries("taps", taps, meaning)
        if len(given) != 2:
            raise ArgumentTypeError("taps", f"be {meaning}", validate.shown(taps))
        align, aperture = (
            validate.one_of("taps", validate.count("every entry of taps", each), ALIGN_TAPS)
            for each in given
        )
        fields = {"align_taps": (align,), "aperture_taps": (aperture,)}
    if depth is not None:
        fields["stages"] = (validate.count("depth", depth, most=MOST_STAGES),)
    return Choices(**fields)


# The plan


def planned(
    request: Request, device: Device, *, doubts: bool = True
) -> tuple[Scene, Plan, MeanTrack | None]:
    """Return the scene of a request, its plan, and the mean track if that is a factorization.

    Effects whose errors lie far below the tolerance are left out of the scene.

    Parameters
    ----------
    request : Request
    device : Device
    doubts : bool
        Whether to warn of input that cannot be right.

    Raises
    ------
    ValueError
        If no plan fits the memory.

    Warns
    -----
    ClsasWarning
        For the reasons of `Scene.warn`, if no line adds anything to the image, or if the costs of
        the device cannot be read or stored.
    """
    effects_db = None if request.full_model else request.tolerance_db
    scene = Scene.of(request.lines, request.grid, request.beam, effects_db)
    scene.warn("tolerance_db", request.tolerance_db, doubts=doubts)
    exact_db, factorized_db = _left_to_methods_db(request.tolerance_db, scene)
    sampled = SampledScene.of(scene, power(request.tolerance_db or 0.0))
    roots = None
    if sampled is not None:
        roots = SampledRoots(sampled, None if scene.beam is None else scene.beam.limits)
    exact = predict_exact(scene, exact_db, device, roots)
    costs = _known_costs(request, exact, device, scene.is_reached)
    conditions = Conditions(
        factorized_db,
        exact,
        device.for_stages(),
        costs.costs,
        request.memory_bytes or device.info.usable_bytes,
    )
    if scene.is_reached:
        found, track = _chosen(request, scene, roots, conditions)
    else:  # an image of zeros needs no search, nor memory
        found, track = exact_plan(scene, conditions, UNREACHED), None
        scene.warn_unreached()
    return scene, _completed(found, request, scene, costs), track


def _left_to_methods_db(tolerance_db: float | None, scene: Scene) -> tuple[float, float | None]:
    """Return the error that is left to an exact image, and to a factorized one, dB.

    Errors that the lines themselves cause, and effects that are left out, already use up a part of
    the tolerance.
    """
    if tolerance_db is None:
        return ACCURACY_DB, None
    rest_db = scene.ambiguity.rest_db(tolerance_db, scene.left_out_error)
    return max(rest_db - MARGIN_DB, BEST_ACCURACY_DB), scene.ambiguity.of_passed_db(rest_db)


def _known_costs(
    request: Request, exact: ExactPrediction, device: Device, is_reached: bool
) -> KnownCosts:
    """Return the given costs, or those of the device; measure these before its first search."""
    if request.costs is not None:
        return KnownCosts(request.costs, "given")
    known = measured_costs.load(device)
    searches = is_reached and _worth_a_search(request, exact, known.costs)
    return measured_costs.scaled(device) if searches and known.source == "default" else known


def _chosen(
    request: Request, scene: Scene, roots: SampledRoots | None, conditions: Conditions
) -> tuple[Plan, MeanTrack | None]:
    """Return the plan that is chosen, and the mean track if it is a factorization."""
    exact, room = conditions.exact, conditions.memory_bytes
    if request.stages:
        return _with_given_stages(request.stages, roots, conditions)
    exact_fits, outcome, reason = _exact_fits(request, exact), Outcome(), _SOON_DONE
    if _worth_a_search(request, exact, conditions.costs):
        is_free = exact_fits and request.choices is None
        to_beat_s = _WORTH * conditions.costs.seconds(exact.work) if is_free else math.inf
        outcome = _fastest_of_shapes(roots, conditions, to_beat_s, request.choices or Choices())
        if outcome.plan is not None:
            return outcome.plan, outcome.track
        reason = _NOT_FASTER
    if not exact_fits:
        raise _too_little_memory(min(exact.memory_bytes, outcome.least_bytes), room)
    if request.stages is not None:
        reason = ""  # it was requested
    elif outcome.obstacle:
        reason = outcome.obstacle
    else:
        reason = ". ".join(filter(None, (reason, worthwhile(roots, exact))))
    return exact_plan(scene, conditions, reason), None


def _with_given_stages(
    stages: Sequence[tuple[int, int]], roots: SampledRoots | None, conditions: Conditions
) -> tuple[Plan, MeanTrack]:
    """Return the plan of given stages, and its mean track."""
    if roots is None:
        raise ArgumentError("lines", "have channels at more than one place for `stages`")
    beam = roots.sampled.scene.beam
    if beam is not None and beam.normalise:
        raise ArgumentError("beam", "not normalise with `stages`", hint="`clsas.backproject` does")
    found = nearest_plan(SampledRoots.of(roots.sampled, roots.limits), stages, conditions)
    if found.memory_bytes > conditions.memory_bytes:
        raise _too_little_memory(found.memory_bytes, conditions.memory_bytes)
    return found, roots.sampled.track


def _too_little_memory(least_bytes: float, room_bytes: int) -> ArgumentError:
    allowed = f"be at least {math.ceil(10 * least_bytes / 2**20) / 10:.1f} MiB for this image"
    return ArgumentError("memory_bytes", allowed, f"{room_bytes / 2**20:.3g} MiB")


def _exact_fits(request: Request, exact: ExactPrediction) -> bool:
    """Return whether an exact image fits the memory; without a limit it divides itself to fit."""
    return request.memory_bytes is None or exact.memory_bytes <= request.memory_bytes


def is_soon_done(lines: RangeLines, grid: Grid, device: Device) -> bool:
    """Return whether lines are backprojected in less time than a search for a plan takes.

    The time is that of 4 taps, all channels and all pixels, by the known costs of the device.
    """
    pairs = float(lines.channels * grid.size)
    work = Work(pixel=pairs) if grid.is_planar else Work(point=pairs)
    return bool(measured_costs.load(device).costs.seconds(work) <= SEARCH_S)


def _worth_a_search(request: Request, exact: ExactPrediction, costs: Costs) -> bool:
    """Return whether a search may pay, or is needed because the exact image does not fit."""
    if request.stages is not None:
        return False
    is_needed = not _exact_fits(request, exact) or request.choices is not None
    return is_needed or bool(costs.seconds(exact.work) > SEARCH_S)


def _completed(found: Plan, request: Request, scene: Scene, costs: KnownCosts) -> Plan:
    """Return a plan of the simplified scene as one of the request: with all errors, and origins."""
    ambiguity, errors = scene.ambiguity, found.errors
    if not found.is_exact:
        errors = errors.times(1 / ambiguity.least_brightness)
    errors = replace(
        errors,
        line_ends=ambiguity.ends,
        aliasing=ambiguity.aliasing,
        left_out=scene.left_out_error,
    )
    prediction = replace(
        found.prediction,
        error_db=errors.total_db,
        errors=errors,
        cost_source=costs.source,
        costs_measured=costs.measured,
    )
    return replace(
        found,
        tolerance_db=request.tolerance_db,
        prediction=prediction,
        left_out=scene.left_out,
        beam=request.beam,
        lines_digest=lines_digest(scene.given_lines),
        grid_digest=grid_digest(scene.given_grid),
    )


def _fastest_of_shapes(
    roots: SampledRoots | None, conditions: Conditions, to_beat_s: float, choices: Choices
) -> Outcome:
    """Return the fastest plan with a mean track of any shape: see `fastest_plan`.

    Strips and sheets are tried where channels lie too far from one curve for roots as large as
    the image.
    """
    if roots is None or roots.sampled.scene.grid.size == 1:
        return Outcome(obstacle=_NO_EXTENT)
    sampled, limits = roots.sampled, roots.limits
    others = shapes_after(sampled.shape)
    best = _fastest_unless_hindered(sampled, limits, conditions, to_beat_s, choices)
    if sampled.shape == "track" and not best.obstacle and not best.is_off_track:
        others = ()
    for shape in others:
        # Another search must pay for itself.
        if best.plan is not None:
            to_beat_s = _WORTH * best.plan.predicted_seconds
        other = sampled.with_shape(shape) if to_beat_s > SEARCH_S else None
        if other is None:
            continue
        found = _fastest_unless_hindered(other, limits, conditions, to_beat_s - SEARCH_S, choices)
        if found.plan is not None:
            best = found
        elif best.plan is None:
            best = replace(
                found,
                least_bytes=min(best.least_bytes, found.least_bytes),
                obstacle=best.obstacle if found.obstacle else "",
            )
    return best


def _fastest_unless_hindered(
    sampled: SampledScene,
    limits: tuple[float, float] | None,
    conditions: Conditions,
    to_beat_s: float,
    choices: Choices,
) -> Outcome:
    """Return the fastest plan with one mean track, unless the beam hinders any."""
    hindrance = obstacle(sampled)
    if hindrance:
        return Outcome(obstacle=hindrance)
    assert conditions.allowed_db is not None
    limits = trimmed(sampled, limits, EDGES_SHARE * power(conditions.allowed_db))
    return fastest_plan(SampledRoots.of(sampled, limits), conditions, to_beat_s, choices)


# Plans of given stages: nearest beams, as in chapter 4 of the thesis


def nearest_plan(
    roots: SampledRoots, stages: Sequence[tuple[int, int]], conditions: Conditions
) -> Plan:
    """Return the plan of given stages (QR, QI), with linear interpolation in range."""
    rows, columns = roots.sampled.scene.grid.shape
    division = math.prod(divisions for _, divisions in stages)
    # Whole work-items: 16 rows by 4 columns.
    side = 16 * math.ceil(rows / division / 16), 4 * math.ceil(columns / division / 4)
    sides = []
    for _, divisions in reversed(stages):
        sides.append(side)
        side = side[0] * divisions, side[1] * divisions
    linear = interpolation.design(2, NEAREST_UPSAMPLING, roots.sampled.scene.spectrum)
    error, by_stage = nearest_errors(roots, stages)
    found = predicted_plan(
        roots,
        conditions,
        ErrorBudget(nearest_beams=error),
        sides=tuple(sides[::-1]),
        tile=_tile(roots, sides[0], conditions.device),
        align=linear,
        final=linear,
        aperture=NearestBeams(factors=tuple(beams for beams, _ in stages)),
    )
    *divided, last = found.stages
    divided = [
        replace(stage, error_db=in_db(power(stage.error_db) + of_beams))
        for stage, of_beams in zip(divided, by_stage, strict=True)
    ]
    return replace(found, prediction=replace(found.prediction, stages=(*divided, last)))


def _tile(roots: SampledRoots, leaf: Side, device: Device) -> Side:
    """Return the largest tiles of a leaf in which ranges may be expanded about the centre."""
    parts = [
        (rows, columns)
        for rows in range(16, min(leaf[0], 64) + 1, 16)
        for columns in range(4, min(leaf[1], 64) + 1, 4)
        if leaf[0] % rows == 0 and leaf[1] % columns == 0
    ]
    fit = [
        part for part in parts if leaf_error(roots, np.array([part]), device)[0] < _MOST_LEAF_ERROR
    ]
    return max(fit or parts[:1], key=math.prod)


# How a beam sweeps over the grid


def trimmed(
    sampled: SampledScene, limits: tuple[float, float] | None, share: float
) -> tuple[float, float] | None:
    """Return the limits of a beam without its outermost edges, where its weights are small.

    The edges are left out where the beam sweeps evenly over the grid: an image of noise then loses
    `share` of its power. Elsewhere every channel is used for every subimage, and weights are
    applied in the leaves only.
    """
    beam, track = sampled.scene.beam, sampled.track
    if beam is None or limits is None:
        return limits
    if track.is_sheet or not sweeps_once(sampled):
        return _EVERY_DIRECTION
    low, high = np.clip(limits, -1, 1)
    on_track, bounds = track.on_track, []
    of_track = sines(_points_m(sampled), track.sampled_m[0][on_track], _along(sampled)[on_track])
    # The channels alone do not suffice, because filters extend into gaps of the track. Neither does
    # one point: from a short aperture, a pixel receives only from a small part of the beam.
    for sine in (_sines_of_channels(sampled), of_track):
        sine = sine[is_within(sine, (low, high))]
        power = beam.weights(sine, wavelength_m(sampled.scene.lines)) ** 2
        index = np.minimum((sine - low) * (_BINS / (high - low)), _BINS - 1).astype(np.int64)
        total = np.bincount(index, power, _BINS).cumsum()
        bounds.append(np.searchsorted(total, np.array([share / 2, 1 - share / 2]) * total[-1]))
    first, last = np.min(bounds, axis=0)[0], np.max(bounds, axis=0)[1]
    if not 0 < first <= last:
        return limits
    edges = np.linspace(low, high, _BINS + 1)
    return float(edges[first]), float(edges[min(last + 1, _BINS)])


def obstacle(sampled: SampledScene) -> str:
    """Return why virtual channels cannot follow the beam, in words; "" if they can."""
    beam = sampled.scene.beam
    if beam is None:
        return ""
    if sampled.track.is_sheet and _directions_unknown(sampled):
        return "the heading turns, and large parts of the smooth aperture have no channel"
    if not sampled.track.is_sheet and _turns_between_channels(sampled):
        return (
            "the heading changes from channel to channel by more than "
            f"{Fraction(_MOST_TURNED)} of the beam's width"
        )
    # Normalising divides by a small sum at the beam's edge, which amplifies errors there.
    if beam.normalise and coverage(sampled, 1).min() < _LEAST_COVERED:
        return (
            "the beam normalises, and weights of some pixels sum to less than "
            f"{Fraction(_LEAST_COVERED)} of the most"
        )
    # If a step of the beam crosses few pixels, their error exceeds the mean that is predicted.
    if beam.jumps and 0 < partly_visible_share(sampled) < _LEAST_PARTIAL:
        return "the step at the beam's edge crosses only few pixels"
    # If few pixels are visible, little time can be saved, and their errors cannot be predicted.
    if float(coverage(sampled, 2).mean()) < _LEAST_SHARE_COVERED:
        return "the beam covers less than a tenth of the image"
    return ""


def _directions_unknown(sampled: SampledScene) -> bool:
    """Return whether directions differ over a sheet of which parts have no channel.

    Smooth directions are then extrapolated, and may be arbitrary.
    """
    track, (columns, rows) = sampled.track, _CELLS
    assert sampled.directions is not None
    assert track.across is not None
    at = sampled.directions.at(track.coordinate, track.across)
    if np.linalg.norm(at - at.mean(axis=0), axis=1).max() <= _MOST_TURNED * _width(sampled):
        return False
    cell = [
        np.clip((each * count).astype(np.int64), 0, count - 1)
        for each, count in ((track.coordinate, columns), (track.across, rows))
    ]
    filled = len(np.unique(cell[0] * rows + cell[1]))
    return filled < _LEAST_FILLED * columns * rows


def _width(sampled: SampledScene) -> float:
    """Return the width of the beam, in sine of the aspect angle."""
    assert sampled.scene.beam is not None
    return sine_width(sampled.scene.beam.limits)


def _turns_between_channels(sampled: SampledScene) -> bool:
    """Return whether neighbours on the track have different directions.

    They do at a kink of the track, where the beam may swing past a point within a few channels, and
    where a track leads back beside itself.
    """
    assert sampled.scene.along is not None
    order = np.argsort(sampled.track.coordinate, kind="stable")
    strip = sampled.track.strip_of(sampled.track.coordinate[order])
    turned = np.linalg.norm(np.diff(sampled.scene.along[order], axis=0), axis=1)
    turned = turned[np.diff(strip) == 0]
    return bool(turned.max(initial=0.0) > _MOST_TURNED * _width(sampled))


def sweeps_once(sampled: SampledScene) -> bool:
    """Return whether the beam sweeps once, at an even rate, over every sample point.

    A subimage then needs a single interval of channels of each strip. Along a straight track, the
    sine of a point's aspect angle changes by (1 - sine^2)/distance per metre. Rates relative to
    that count as even if they vary by no more than their mean.
    """
    if sampled.scene.beam is None:
        return True
    strip = sampled.track.strip_of(sampled.track.samples)
    return all(_sweeps_once(sampled, strip == each) for each in range(sampled.track.strips))


def _sweeps_once(sampled: SampledScene, of_strip: NDArray[np.bool_]) -> bool:
    """Return whether the beam sweeps evenly along one strip."""
    assert sampled.scene.beam is not None
    on_track = sampled.track.on_track & of_strip
    position = sampled.track.sampled_m[0][on_track]
    along_m = np.concatenate([[0], np.linalg.norm(np.diff(position, axis=0), axis=1).cumsum()])
    sine = np.einsum("psi,si->ps", sampled.sight[:, on_track], _along(sampled)[on_track])
    along_m += 1e-9 * np.arange(len(along_m))  # a track may stand still
    rate = -np.gradient(sine, along_m, axis=1)
    rate *= sampled.distance_m[:, on_track] / np.maximum(1 - sine**2, 1e-3)
    visible = is_within(sine, sampled.scene.beam.limits)
    count = np.maximum(visible.sum(axis=1), 1)
    mean = rate.sum(axis=1, where=visible) / count
    fastest = rate.max(axis=1, where=visible, initial=-np.inf)
    slowest = rate.min(axis=1, where=visible, initial=np.inf)
    return not (visible.any(axis=1) & (fastest - slowest > np.abs(mean))).any()


def coverage(sampled: SampledScene, power: int) -> NDArray[np.float64]:
    """Return sums over channels of a power of the beam's weights, over the largest sum, [points].

    They are those of points all over the grid, and 0 if the beam touches none of them.
    """
    assert sampled.scene.beam is not None
    weights = sampled.scene.beam.weights(
        _sines_of_channels(sampled), wavelength_m(sampled.scene.lines)
    )
    sums = (weights**power).sum(axis=0)
    return sums / max(sums.max(), 1e-30)


def partly_visible_share(sampled: SampledScene) -> float:
    """Return the fraction of points in the beam of some channels, but not of others."""
    assert sampled.scene.beam is not None
    visible = is_within(_sines_of_channels(sampled), sampled.scene.beam.limits).mean(axis=0)
    return float(((visible > 0) & (visible < 1)).mean())


def _along(sampled: SampledScene) -> NDArray[np.float64]:
    """Return the beam's unit directions at the track's samples, [samples, 3]; only with a beam."""
    assert sampled.along is not None
    return sampled.along


def _points_m(sampled: SampledScene) -> NDArray[np.float64]:
    """Return points all over the grid, [points, 3]."""
    return points_at_m(sampled.scene.surface, _SAMPLED_POINTS)


def _sines_of_channels(sampled: SampledScene) -> NDArray[np.float64]:
    """Return sines of the aspect angle at points all over the grid, [channels, points]."""
    assert sampled.scene.along is not None
    some = some_channels(sampled.scene.lines.channels)
    return sines(
        _points_m(sampled), sampled.scene.lines.phase_centres_m[some], sampled.scene.along[some]
    )
