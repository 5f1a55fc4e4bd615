"""Plans: the fastest factorization within a tolerance, or the exact image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from clsas.aperture.dense_tracks import shapes_after
from clsas.aperture.mean_track import MeanTrack
from clsas.core.decibels import power
from clsas.core.digests import grid_digest, lines_digest
from clsas.exact.decision import ACCURACY_DB
from clsas.opencl.device import Device
from clsas.planning import costs as stored_costs
from clsas.planning import scaling
from clsas.planning.beam_coverage import obstacle
from clsas.planning.costs import Costs, KnownCosts
from clsas.planning.exact_image import Exact, expect, worthwhile
from clsas.planning.fastest import Outcome, fastest, off_track
from clsas.planning.nearest_beams import nearest_plan
from clsas.planning.prediction import MARGIN_DB, Conditions, exact_plan
from clsas.planning.request import Request
from clsas.planning.search import Allowed
from clsas.planning.visibility_model import VisibilityModel, model_of
from clsas.plans.factorization import UNREACHED
from clsas.plans.plan import Plan
from clsas.scene import Scene
from clsas.signal.spectrum import OUTSIDE

# `scripts/bench sensitivity` halves and doubles these; without a remark nothing changes.
_WORTH = 0.95  # of the time of an exact image, at most: less gain is within predictions' scatter
_SEARCH_S = 0.05  # that a search takes at least: 0.05 to 0.12 s on a core of 2.5 GHz

_NO_EXTENT = "all channels are at one place, or there is a single pixel"
_NOT_FASTER = "no factorization is faster within the tolerance"
_SOON_DONE = "it takes less time than the search for a factorization"


def planned(scene: Scene, request: Request, device: Device) -> tuple[Plan, MeanTrack | None]:
    """Return the plan of a scene, and the mean track if it is a factorization.

    Parameters
    ----------
    scene : Scene
        That of the request.
    request : Request
    device : Device

    Raises
    ------
    ValueError
        If no plan fits the memory.

    Warns
    -----
    ClsasWarning
        If no line adds anything to the image, or the costs of the device cannot be read or stored.
    """
    exact_db, factorized_db = _left_to_methods_db(request.tolerance_db, scene)
    model = model_of(scene, OUTSIDE * power(request.tolerance_db or 0.0))
    exact = expect(scene, exact_db, device, model)
    costs = _known_costs(request, exact, device, scene.is_reached)
    conditions = Conditions(
        factorized_db,
        exact,
        device.for_stages(),
        costs.costs,
        request.memory_bytes or device.info.memory_bytes // 2,
    )
    if scene.is_reached:
        found, track = _chosen(request, scene, model, conditions)
    else:  # an image of zeros needs no search, nor memory
        found, track = exact_plan(scene, conditions, UNREACHED), None
        scene.warn_unreached()
    return _completed(found, request, scene, costs), track


def _left_to_methods_db(tolerance_db: float | None, scene: Scene) -> tuple[float, float | None]:
    """Return the error that is left to an exact image, and to a factorized one, dB.

    Errors that the lines themselves cause, and effects that are left out, already use up a part of
    the tolerance.
    """
    if tolerance_db is None:
        return ACCURACY_DB, None
    rest_db = scene.ambiguity.rest_db(tolerance_db, scene.left_out_error)
    return rest_db - MARGIN_DB, scene.ambiguity.of_passed_db(rest_db)


def _known_costs(request: Request, exact: Exact, device: Device, is_reached: bool) -> KnownCosts:
    """Return the given costs, or those of the device; measure these before its first search."""
    if request.costs is not None:
        return KnownCosts(request.costs, "given")
    known = stored_costs.load(device)
    searches = is_reached and _worth_a_search(request, exact, known.costs)
    return scaling.scaled(device) if searches and known.source == "default" else known


def _chosen(
    request: Request, scene: Scene, model: VisibilityModel | None, conditions: Conditions
) -> tuple[Plan, MeanTrack | None]:
    """Return the plan that is chosen, and the mean track if it is a factorization."""
    exact, room = conditions.exact, conditions.memory_bytes
    if request.stages:
        return _with_given_stages(request.stages, model, conditions)
    exact_fits, outcome, reason = _exact_fits(request, exact), Outcome(), _SOON_DONE
    if _worth_a_search(request, exact, conditions.costs):
        is_free = exact_fits and request.allowed is None
        to_beat_s = _WORTH * conditions.costs.seconds(exact.work) if is_free else math.inf
        outcome = _fastest_of_shapes(model, conditions, to_beat_s, request.allowed or Allowed())
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
        reason = ". ".join(filter(None, (reason, worthwhile(model, exact))))
    return exact_plan(scene, conditions, reason), None


def _with_given_stages(
    stages: Sequence[tuple[int, int]], model: VisibilityModel | None, conditions: Conditions
) -> tuple[Plan, MeanTrack]:
    """Return the plan of given stages, and its mean track."""
    if model is None:
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
    model: VisibilityModel | None, conditions: Conditions, seconds: float, choices: Allowed
) -> Outcome:
    """Return the fastest plan with a mean track of any shape: see `fastest`.

    Strips and sheets are tried where channels lie too far from one curve for roots as large as
    the image.
    """
    if model is None or model.grid.size == 1:
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
