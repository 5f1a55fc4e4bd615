"""Plans: the fastest factorization within a tolerance, or the exact image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from clsas.aperture.dense_tracks import shapes_after
from clsas.aperture.mean_track import MeanTrack
from clsas.core.decibels import power
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
from clsas.planning.exact_image import Exact, expect
from clsas.planning.fastest import Outcome, fastest, off_track
from clsas.planning.nearest_beams import nearest_plan
from clsas.planning.prediction import MARGIN_DB, Conditions, exact_plan
from clsas.planning.request import BEST_TOLERANCE_DB as BEST_TOLERANCE_DB
from clsas.planning.request import TOLERANCE_DB as TOLERANCE_DB
from clsas.planning.request import WORST_TOLERANCE_DB as WORST_TOLERANCE_DB
from clsas.planning.request import Request
from clsas.planning.request import checked_pairs as checked_pairs
from clsas.planning.request import tolerance_in_db as tolerance_in_db
from clsas.planning.request import wavelengths as wavelengths
from clsas.planning.search import Allowed
from clsas.planning.visibility_model import LinesModel, VisibilityModel, model_of
from clsas.plans.factorization import UNREACHED
from clsas.plans.plan import Plan
from clsas.signal.spectrum import OUTSIDE
from clsas.sonar.beam import BeamWindow
from clsas.sonar.coverage import reaches, warn_unreached
from clsas.sonar.simplify import Model, simplify

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
    request = Request(
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
    )
    return planned(request).plan


@dataclass(frozen=True, eq=False)
class Planned:
    """A plan, with results of planning that forming its image needs again.

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


def planned(request: Request) -> Planned:
    """Return the plan of a request, with what its image needs again."""
    device = open_device(request.device)
    scene = _simplified(request)
    model = model_of(
        scene.lines, scene.grid, scene.beam, OUTSIDE * power(request.tolerance_db or 0.0)
    )
    exact_db, factorized_db = _left_to_methods_db(request.tolerance_db, model, scene.error)
    exact = expect(model, exact_db, device)
    is_reached = reaches(request.lines, request.grid, request.beam, model.channels_along)
    costs = _known_costs(request, exact, device, is_reached)
    room = request.memory_bytes or device.info.memory_bytes // 2
    conditions = Conditions(factorized_db, exact, device.for_stages(), costs.costs, room)
    if is_reached:
        found, track = _chosen(request, model, conditions)
    else:  # an image of zeros needs no search, nor memory
        found, track = exact_plan(model, conditions, UNREACHED), None
        warn_unreached(request.lines, request.grid, request.beam, model.channels_along)
    chosen = _completed(found, request, scene, model, costs)
    if chosen.is_exact or not isinstance(model, VisibilityModel):
        return Planned(chosen)
    return Planned(chosen, track, model.surface)


def _simplified(request: Request) -> Model:
    """Return the scene without effects whose errors lie far below the tolerance."""
    given = request.lines, request.grid, request.beam
    return Model(*given) if request.full_model else simplify(*given, request.tolerance_db)


def _left_to_methods_db(
    tolerance_db: float | None, model: LinesModel, left_out: float
) -> tuple[float, float | None]:
    """Return the error that is left to an exact image, and to a factorized one, dB.

    Errors that the lines themselves cause, of which this warns, and effects that are left out
    already use up a part of the tolerance.
    """
    if tolerance_db is None:
        return ACCURACY_DB, None
    model.ambiguity.warn("tolerance_db", tolerance_db)
    rest_db = model.ambiguity.rest_db(tolerance_db, left_out)
    return rest_db - MARGIN_DB, model.ambiguity.of_passed_db(rest_db)


def _known_costs(request: Request, exact: Exact, device: Device, is_reached: bool) -> KnownCosts:
    """Return the given costs, or those of the device; measure these before its first search."""
    if request.costs is not None:
        return KnownCosts(request.costs, "given")
    known = stored_costs.load(device)
    searches = is_reached and _worth_a_search(request, exact, known.costs)
    return scaling.scaled(device) if searches and known.source == "default" else known


def _chosen(
    request: Request, model: LinesModel, conditions: Conditions
) -> tuple[Plan, MeanTrack | None]:
    """Return the plan that is chosen, and the mean track if it is a factorization."""
    exact, room = conditions.exact, conditions.memory_bytes
    if request.stages:
        return _with_given_stages(request.stages, model, conditions)
    exact_fits, outcome = _exact_fits(request, exact), Outcome()
    if _worth_a_search(request, exact, conditions.costs):
        is_free = exact_fits and request.allowed is None
        to_beat_s = _WORTH * conditions.costs.seconds(exact.work) if is_free else math.inf
        outcome = _fastest_of_shapes(model, conditions, to_beat_s, request.allowed or Allowed())
        if outcome.plan is not None:
            return outcome.plan, outcome.track
    if not exact_fits:
        raise _too_little_memory(min(exact.memory_bytes, outcome.least_bytes), room)
    return exact_plan(model, conditions, outcome.obstacle), None


def _with_given_stages(
    stages: Sequence[tuple[int, int]], model: LinesModel, conditions: Conditions
) -> tuple[Plan, MeanTrack]:
    """Return the plan of given stages, and its mean track."""
    if not isinstance(model, VisibilityModel):
        raise ValueError("lines must have channels at more than one place for stages")
    if model.beam is not None and model.beam.normalise:
        raise ValueError("beam must not normalise with stages; clsas.backproject does")
    found = nearest_plan(model, stages, conditions)
    if found.memory_bytes > conditions.memory_bytes:
        raise _too_little_memory(found.memory_bytes, conditions.memory_bytes)
    return found, model.track


def _too_little_memory(least_bytes: float, room_bytes: int) -> ValueError:
    return ValueError(
        f"memory_bytes must be at least {math.ceil(10 * least_bytes / 2**20) / 10:.1f} MiB for "
        f"this image, got {room_bytes / 2**20:.3g} MiB"
    )


def _exact_fits(request: Request, exact: Exact) -> bool:
    """Return whether an exact image fits the memory; without a limit it divides itself to fit."""
    return request.memory_bytes is None or exact.memory_bytes <= request.memory_bytes


def _worth_a_search(request: Request, exact: Exact, costs: Costs) -> bool:
    """Return whether a search may pay, or is needed because the exact image does not fit."""
    if request.stages is not None:
        return False
    is_needed = not _exact_fits(request, exact) or request.allowed is not None
    return is_needed or bool(costs.seconds(exact.work) > _SEARCH_S)


def _completed(
    found: Plan, request: Request, scene: Model, model: LinesModel, costs: KnownCosts
) -> Plan:
    """Return a plan of the simplified scene as one of the request: with all errors, and origins."""
    ambiguity, errors = model.ambiguity, found.errors
    if not found.is_exact:
        errors = errors.times(1 / ambiguity.least_brightness)
    errors = replace(
        errors, line_ends=ambiguity.ends, aliasing=ambiguity.aliasing, left_out=scene.error
    )
    prediction = replace(
        found.prediction,
        error_db=errors.total_db,
        errors=errors,
        cost_source=costs.source,
        costs_measured=costs.measured,
    )
    found = replace(
        found,
        tolerance_db=request.tolerance_db,
        prediction=prediction,
        left_out=scene.left_out,
        beam=request.beam,
    )
    if not scene.left_out:
        return found
    return replace(
        found, lines_digest=lines_digest(request.lines), grid_digest=grid_digest(request.grid)
    )


def _fastest_of_shapes(
    model: LinesModel, conditions: Conditions, seconds: float, choices: Allowed
) -> Outcome:
    """Return the fastest plan with a mean track of any shape: see `fastest`.

    Strips and sheets are tried where channels lie too far from one curve for roots as large as
    the image.
    """
    if not isinstance(model, VisibilityModel) or model.grid.size == 1:
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
