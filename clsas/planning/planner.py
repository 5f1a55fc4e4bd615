"""Plans: the fastest factorization within a tolerance, or the exact image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from clsas.aperture.dense_tracks import shapes_after
from clsas.aperture.filters import ALIGN_TAPS
from clsas.aperture.mean_track import MeanTrack
from clsas.aperture.nearest import NearestBeams
from clsas.core import validate
from clsas.core.decibels import in_db, power
from clsas.core.digests import grid_digest, lines_digest
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines
from clsas.exact.backprojection import ACCURACY_DB
from clsas.factorized.surface import Surface
from clsas.opencl.device import Device, open_device
from clsas.planning import costs as stored_costs
from clsas.planning import scaling
from clsas.planning.beam_coverage import obstacle
from clsas.planning.costs import Costs, KnownCosts
from clsas.planning.errors import leaf_error, nearest_errors
from clsas.planning.exact_image import Exact, expect
from clsas.planning.fastest import Outcome, fastest, off_track
from clsas.planning.prediction import (
    MARGIN_DB,
    Candidate,
    Conditions,
    exact_plan,
    predicted_plan,
)
from clsas.planning.search import MOST_STAGES, Allowed
from clsas.planning.visibility_model import VisibilityModel
from clsas.plans.factorization import UNREACHED
from clsas.plans.plan import Plan
from clsas.plans.predictions import ErrorBudget
from clsas.signal import interpolation
from clsas.signal.spectrum import OUTSIDE
from clsas.sonar.beam import BeamWindow
from clsas.sonar.coverage import reaches, warn_unreached
from clsas.sonar.simplify import Model, simplify

BEST_TOLERANCE_DB = -75.0
"""The tightest tolerance that may be asked for: what float32 leaves of a factorized image."""
WORST_TOLERANCE_DB = -10.0

TOLERANCE_DB = -50.0
"""Tolerance of images for which none is asked."""

NEAREST_UPSAMPLING = 8.0
"""Upsampling of lines before the linear interpolation of given stages."""

# `scripts/bench sensitivity` halves and doubles these; without a remark nothing changes.
_WORTH = 0.95  # of the time of an exact image, at most: less gain is within predictions' scatter
_SEARCH_S = 0.05  # that a search takes at least: 0.05 to 0.12 s on a core of 2.5 GHz

_NO_EXTENT = "all channels are at one place, or there is a single pixel"


def plan(
    lines: RangeLines,
    grid: Grid,
    *,
    tolerance_db: float | None = None,
    tolerance_wavelengths: float | None = None,
    stages: Sequence[tuple[int, int]] | None = None,
    beam: BeamWindow | None = None,
    device: Device | str | int | None = None,
    memory_bytes: int | None = None,
    costs: Costs | None = None,
    taps: tuple[int, int] | None = None,
    depth: int | None = None,
    full_model: bool = False,
) -> Plan:
    """Plan the fastest image whose error keeps a tolerance.

    Exactly one of `tolerance_db`, `tolerance_wavelengths` and `stages` must be given.

    Parameters
    ----------
    lines : RangeLines
        Lines to image. Of their samples only the spectrum and the fading at the ends matter.
    grid : Grid
        Pixels of the image.
    tolerance_db : float
        Requested relative rms error against the exact image, dB, from -75 to -10.
    tolerance_wavelengths : float
        The same as a range error in wavelengths of the carrier. Errors that are spread evenly
        between minus and plus this value make 4 pi/sqrt(3) radians rms per wavelength.
    stages : sequence of (QR, QI)
        Form the image as THESIS chapter 4 does. Every stage sums QR neighbouring lines and divides
        subimages by QI along either side; then the last subimages are backprojected. An empty
        sequence is plain backprojection. Range is interpolated linearly.
    beam : BeamWindow, optional
        Weights of the channels.
    device : Device, str or int, optional
        Device that forms the image; see `clsas.opencl.device.choose`.
    memory_bytes : int, optional
        Device memory that may be used. By default half of the device's, or as much as plain
        backprojection takes.
    costs : Costs, optional
        Costs in place of those stored for the device. Where none are stored, a measurement of 0.3
        to 0.6 s scales the defaults, and is stored, before the first search for a factorization.
    taps : (range, aperture), optional
        For study, with a tolerance: numbers of taps, 4, 6 or 8, in place of the fastest.
    depth : int, optional
        For study, with a tolerance: number of stages, 1 to 5, in place of the fastest.
    full_model : bool
        For study: model every effect, also those whose error lies far below the tolerance.

    Returns
    -------
    Plan
        An exact image if nothing is faster: near the aperture, with few channels or pixels, or much
        relief.

    Raises
    ------
    TypeError, ValueError
        If an argument is not allowed, or no plan fits the memory: the message names what the least
        demanding one needs.
    DeviceError
        If there is no such device.

    Warns
    -----
    ClsasWarning
        If the tolerance may be missed because lines do not fade towards ends that the grid
        reaches, or because the lines' band fills all that is sampled; or if no pixel lies within
        any line's range, or the beam, so that the image will be zero; or if costs stored for the
        device cannot be read, or those measured cannot be stored.
    """
    return planned(
        lines,
        grid,
        tolerance_db=tolerance_db,
        tolerance_wavelengths=tolerance_wavelengths,
        stages=stages,
        beam=beam,
        device=device,
        memory_bytes=memory_bytes,
        costs=costs,
        taps=taps,
        depth=depth,
        full_model=full_model,
    ).plan


@dataclass(frozen=True, eq=False)
class Planned:
    """A plan, and what planning found on the way that its image needs again.

    Attributes
    ----------
    plan : Plan
    track : MeanTrack or None
        The mean track of a factorization.
    surface : Surface or None
        The surface of the grid without the effects that the plan leaves out.
    """

    plan: Plan
    track: MeanTrack | None = None
    surface: Surface | None = None


def planned(
    lines: RangeLines,
    grid: Grid,
    *,
    tolerance_db: float | None = None,
    tolerance_wavelengths: float | None = None,
    stages: Sequence[tuple[int, int]] | None = None,
    beam: BeamWindow | None = None,
    device: Device | str | int | None = None,
    memory_bytes: int | None = None,
    costs: Costs | None = None,
    taps: tuple[int, int] | None = None,
    depth: int | None = None,
    full_model: bool = False,
) -> Planned:
    """Return what `plan` does, with what its image needs again."""
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    given = [tolerance_db, tolerance_wavelengths, stages]
    if sum(value is not None for value in given) != 1:
        raise ValueError(
            "exactly one of tolerance_db, tolerance_wavelengths and stages must be given, "
            f"got {tolerance_db}, {tolerance_wavelengths} and {stages}"
        )
    validate.memory("grid", 8 * grid.size)
    tolerance_db = tolerance_in_db(tolerance_db, tolerance_wavelengths)
    if stages is not None:
        stages = _checked_stages(stages, lines, grid)
    allowed = _allowed(taps, depth)
    if allowed is not None and stages is not None:
        raise ValueError("taps and depth go with a tolerance, not with stages")
    if costs is not None:
        validate.instance("costs", costs, Costs)
    validate.flag("full_model", full_model)
    device = open_device(device)
    known = stored_costs.load(device) if costs is None else KnownCosts(costs, "given")
    if memory_bytes is not None:
        memory_bytes = validate.count("memory_bytes", memory_bytes)
    scene = Model(lines, grid, beam) if full_model else simplify(lines, grid, beam, tolerance_db)
    model = VisibilityModel.of(
        scene.lines, scene.grid, scene.beam, OUTSIDE * power(tolerance_db or 0.0)
    )
    rest_db = of_passed_db = tolerance_db
    if tolerance_db is not None:
        model.ambiguity.warn("tolerance_db", tolerance_db)
        rest_db = model.ambiguity.rest_db(tolerance_db, scene.error)
        of_passed_db = model.ambiguity.of_passed_db(rest_db)
    exact = expect(model, ACCURACY_DB if rest_db is None else rest_db - MARGIN_DB, device)
    # Exact imaging divides itself to fit a device.
    exact_fits = memory_bytes is None or exact.memory_bytes <= memory_bytes
    is_reached = reaches(lines, grid, beam, model.channels_along)
    searched = (
        is_reached and stages is None and _worth_a_search(exact, known.costs, exact_fits, allowed)
    )
    if searched and known.source == "default":
        known = scaling.scaled(device)
    room = device.info.memory_bytes // 2 if memory_bytes is None else memory_bytes
    conditions = Conditions(of_passed_db, exact, device.for_stages(), known.costs, room)
    if is_reached:
        found, track = _chosen(model, stages, conditions, exact_fits, allowed)
    else:  # an image of zeros needs no search, nor memory
        found, track = exact_plan(model, conditions, UNREACHED), None
    errors = found.errors
    if not found.is_exact:
        errors = errors.times(1 / model.ambiguity.least_brightness)
    errors = replace(
        errors,
        line_ends=model.ambiguity.ends,
        aliasing=model.ambiguity.aliasing,
        left_out=scene.error,
    )
    prediction = replace(
        found.prediction,
        error_db=errors.total_db,
        errors=errors,
        cost_source=known.source,
        costs_measured=known.measured,
    )
    found = replace(
        found,
        tolerance_db=tolerance_db,
        prediction=prediction,
        left_out=scene.left_out,
        beam=beam,
        lines_digest=lines_digest(lines) if scene.left_out else found.lines_digest,
        grid_digest=grid_digest(grid) if scene.left_out else found.grid_digest,
    )
    if not is_reached:
        warn_unreached(lines, grid, beam, model.channels_along)
    return Planned(found, track, None if found.is_exact else model.surface)


def _chosen(
    model: VisibilityModel,
    stages: list[tuple[int, int]] | None,
    conditions: Conditions,
    exact_fits: bool,
    allowed: Allowed | None,
) -> tuple[Plan, MeanTrack | None]:
    """Return the plan of checked arguments, and the mean track of a factorization."""
    beam, exact, room = model.beam, conditions.exact, conditions.memory_bytes
    least: float = exact.memory_bytes
    reason = ""
    if stages:
        if model.track is None:
            raise ValueError("lines must have channels at more than one place for stages")
        if beam is not None and beam.normalise:
            raise ValueError("beam must not normalise with stages; clsas.backproject does")
        found = _nearest(model, stages, conditions)
        if found.memory_bytes <= room:
            return found, model.track
        exact_fits, least = False, found.memory_bytes
    elif stages is None and _worth_a_search(exact, conditions.costs, exact_fits, allowed):
        is_free = exact_fits and allowed is None
        to_beat = _WORTH * conditions.costs.seconds(exact.work) if is_free else math.inf
        outcome = _fastest_of_shapes(model, conditions, to_beat, allowed or Allowed())
        if outcome.plan is not None:
            return outcome.plan, outcome.track
        least, reason = min(least, outcome.least_bytes), outcome.obstacle
    if not exact_fits:
        raise ValueError(
            f"memory_bytes must be at least {math.ceil(10 * least / 2**20) / 10:.1f} MiB for this "
            f"image, got {room / 2**20:.3g} MiB"
        )
    return exact_plan(model, conditions, reason), None


def _fastest_of_shapes(
    model: VisibilityModel, conditions: Conditions, seconds: float, choices: Allowed
) -> Outcome:
    """Return the fastest plan with a mean track of any shape: see `fastest`.

    Strips and sheets are tried where channels lie too far from one curve for roots as large as
    the image.
    """
    if model.track is None or model.grid.size == 1:
        return Outcome(obstacle=_NO_EXTENT)
    others = shapes_after(model.shape)
    best = _fastest_unless(obstacle(model), model, conditions, seconds, choices)
    if model.shape == "track" and not best.obstacle and not off_track(model, conditions):
        others = ()
    for shape in others:
        # Another search must pay for itself.
        to_beat = seconds if best.plan is None else _WORTH * best.plan.predicted_seconds
        other = model.with_shape(shape) if to_beat > _SEARCH_S else None
        if other is None:
            continue
        found = _fastest_unless(obstacle(other), other, conditions, to_beat - _SEARCH_S, choices)
        if found.plan is not None:
            best = found
        elif best.plan is None:
            best = replace(
                found,
                least_bytes=min(best.least_bytes, found.least_bytes),
                obstacle=best.obstacle if found.obstacle else "",
            )
    return best


def _fastest_unless(
    hindrance: str, model: VisibilityModel, conditions: Conditions, seconds: float, choices: Allowed
) -> Outcome:
    """Return the fastest plan, unless something hinders any: see `fastest`."""
    if hindrance:
        return Outcome(obstacle=hindrance)
    return fastest(model, conditions, seconds, choices)


def tolerance_in_db(
    tolerance_db: float | None, tolerance_wavelengths: float | None
) -> float | None:
    """Return the tolerance asked for, or None, after checking it."""
    if tolerance_db is not None:
        return validate.number(
            "tolerance_db", tolerance_db, "dB", least=BEST_TOLERANCE_DB, most=WORST_TOLERANCE_DB
        )
    if tolerance_wavelengths is None:
        return None
    least, most = (wavelengths(each) for each in (BEST_TOLERANCE_DB, WORST_TOLERANCE_DB))
    return decibels(
        validate.number(
            "tolerance_wavelengths", tolerance_wavelengths, "wavelengths", least=least, most=most
        )
    )


def _allowed(taps: tuple[int, int] | None, depth: int | None) -> Allowed | None:
    """Return the requested filters and stages, None if the search is free."""
    if taps is None and depth is None:
        return None
    fields = {}
    if taps is not None:
        meaning = "two, in range and along the aperture"
        given = validate.entries("taps", taps, meaning)
        if len(given) != 2:
            raise TypeError(f"taps must be {meaning}, got {validate.shown(taps)}")
        align, aperture = (
            validate.one_of("taps", validate.count("every entry of taps", each), ALIGN_TAPS)
            for each in given
        )
        fields = {"align_taps": (align,), "aperture_taps": (aperture,)}
    if depth is not None:
        depths = range(1, MOST_STAGES + 1)
        fields["stages"] = (validate.one_of("depth", validate.count("depth", depth), depths),)
    return Allowed(**fields)


def _worth_a_search(exact: Exact, costs: Costs, exact_fits: bool, allowed: Allowed | None) -> bool:
    """Return whether a search may pay, or is needed because the exact image does not fit."""
    return not exact_fits or allowed is not None or costs.seconds(exact.work) > _SEARCH_S


def decibels(wavelengths: float) -> float:
    """Return the relative rms error of range errors spread evenly up to some wavelengths, dB."""
    return 20 * math.log10(4 * math.pi * wavelengths / math.sqrt(3))


def wavelengths(decibels: float) -> float:
    """Return the range error, in wavelengths, that makes an error in decibels."""
    return 10 ** (decibels / 20) * math.sqrt(3) / (4 * math.pi)


def _nearest(
    model: VisibilityModel, stages: Sequence[tuple[int, int]], conditions: Conditions
) -> Plan:
    """Return the plan of THESIS chapter 4: nearest beams, linear interpolation in range."""
    rows, columns = model.grid.shape
    division = math.prod(divisions for _, divisions in stages)
    # Whole work-items: 16 rows by 4 columns.
    leaf = 16 * math.ceil(rows / division / 16), 4 * math.ceil(columns / division / 4)
    sides = []
    for _, divisions in reversed(stages):
        sides.append(leaf)
        leaf = leaf[0] * divisions, leaf[1] * divisions
    linear = interpolation.design(2, NEAREST_UPSAMPLING, model.spectrum)
    candidate = Candidate(
        sides=tuple(sides[::-1]),
        tile=_tile(model, sides[0], conditions.device),
        align=linear,
        final=linear,
        aperture=NearestBeams(factors=tuple(beams for beams, _ in stages)),
    )
    error, by_stage = nearest_errors(model, stages)
    found = predicted_plan(model, candidate, ErrorBudget(nearest_beams=error), conditions)
    *divided, last = found.stages
    divided = [
        replace(stage, error_db=in_db(power(stage.error_db) + of_beams))
        for stage, of_beams in zip(divided, by_stage, strict=True)
    ]
    return replace(found, prediction=replace(found.prediction, stages=(*divided, last)))


def _tile(model: VisibilityModel, leaf: tuple[int, int], device: Device) -> tuple[int, int]:
    """Return the largest tiles of a leaf that may be expanded about their centres."""
    parts = [
        (rows, columns)
        for rows in range(16, min(leaf[0], 64) + 1, 16)
        for columns in range(4, min(leaf[1], 64) + 1, 4)
        if leaf[0] % rows == 0 and leaf[1] % columns == 0
    ]
    fit = [part for part in parts if leaf_error(model, np.array([part]), device)[0] < 1e-8]
    return max(fit or parts[:1], key=math.prod)


def checked_pairs(stages: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return (QR, QI) of every stage; raises TypeError or ValueError if one is wrong."""
    meaning = "a sequence of (QR, QI)"
    pairs = [
        validate.entries("stages", stage, meaning)
        for stage in validate.entries("stages", stages, meaning)
    ]
    if any(len(pair) != 2 for pair in pairs):
        raise TypeError(f"stages must be {meaning}, got {validate.shown(stages)}")
    return [
        (validate.count("QR of stages", beams), validate.count("QI of stages", divisions))
        for beams, divisions in pairs
    ]


def _checked_stages(stages: Sequence[tuple[int, int]], lines: RangeLines, grid: Grid) -> list:
    """Return (QR, QI) of every stage; raises ValueError if lines or grid do not allow them."""
    pairs = checked_pairs(stages)
    if not pairs:
        return pairs
    if not grid.is_planar:
        raise ValueError("grid must be a plane for stages")
    most_beams, most_divisions = lines.channels, max(min(grid.shape), 1)
    beams, divisions = (math.prod(numbers) for numbers in zip(*pairs, strict=True))
    if beams > most_beams or divisions > most_divisions:
        raise ValueError(
            f"stages must leave a line and a pixel: they sum {beams} of {lines.channels} lines and "
            f"divide {grid.shape[0]} x {grid.shape[1]} pixels by {divisions} along either side"
        )
    return pairs
