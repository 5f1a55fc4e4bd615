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
from clsas.factorized.imager import NOTHING, Known
from clsas.opencl.device import Device, open_device
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
from clsas.planning.visibility_model import LinesModel, VisibilityModel, model_of
from clsas.plans.factorization import UNREACHED
from clsas.plans.plan import Plan
from clsas.signal.doubts import warn_before_imaging
from clsas.signal.refraction import Homogeneous, homogeneous
from clsas.signal.spectrum import OUTSIDE
from clsas.sonar.beam import BeamWindow
from clsas.sonar.coverage import reaches, warn_unreached
from clsas.sonar.simplify import Model, simplify

# `scripts/bench sensitivity` halves and doubles these; without a remark nothing changes.
_WORTH = 0.95  # of the time of an exact image, at most: less gain is within predictions' scatter
_SEARCH_S = 0.05  # that a search takes at least: 0.05 to 0.12 s on a core of 2.5 GHz

_NO_EXTENT = "all channels are at one place, or there is a single pixel"
_NOT_FASTER = "no factorization is faster within the tolerance"
_SOON_DONE = "it takes less time than the search for a factorization"


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
    """Return the plan of the fastest image within a tolerance.

    Exactly one of `tolerance_db`, `tolerance_wavelengths` and `stages` must be given.

    Parameters
    ----------
    lines : RangeLines
        Lines to image. Only the spectrum of their samples, and how far they fade towards the ends
        of the lines, influence the plan.
    grid : Grid
        Pixels of the image.
    tolerance_db : float, optional
        Largest relative rms error against the exact image, dB, from -75 to -10.
    tolerance_wavelengths : float, optional
        The same tolerance as a range error, in wavelengths of the carrier; see Notes.
    stages : sequence of (QR, QI), optional
        Form the image by the thesis's method, with nearest beams and linear interpolation in range
        [2]_. Every stage sums QR neighbouring lines and divides subimages by QI along either side;
        the last subimages are backprojected. An empty sequence is plain backprojection.
    beam : BeamWindow, optional
        Weights of the channels by aspect angle.
    device : Device, str or int, optional
        Device that forms the image; see `clsas.opencl.device.choose`.
    memory_bytes : int, optional
        Device memory that may be used. The default is half of the device's memory, or as much as
        plain backprojection needs.
    costs : Costs, optional
        Costs of each kind of work, instead of those stored for the device. If none are stored, the
        first search for a factorization measures how fast the device is, for 0.3 to 0.6 s, scales
        the default costs and stores them.
    taps : (range, aperture), optional
        For studies, with a tolerance: number of taps of the filters in range and along the
        aperture, 4, 6 or 8 each, instead of the fastest.
    depth : int, optional
        For studies, with a tolerance: number of stages, 1 to 5, instead of the fastest.
    full_model : bool
        For studies: model every effect, including those whose error lies far below the tolerance.

    Returns
    -------
    Plan
        How the image is formed, with its predicted error, time and memory. The plan is that of an
        exact image if no factorization is faster: close to the aperture, with few channels or
        pixels, or with much relief.

    Raises
    ------
    TypeError, ValueError
        If an argument is not allowed, or no plan fits the memory. In the latter case the message
        states how much memory is needed.
    DeviceError
        If the device does not exist.

    Warns
    -----
    ClsasWarning
        If the image may miss the tolerance, because the grid reaches ends of lines that do not
        fade, or because the lines' band fills the whole sampled band; if no pixel lies within the
        range of any line and the beam, so that the image will be zero; if pixels lie behind the
        elements, where they can only show mirror images; if lines, grid or beam cannot be
        right, such as positions in millimetres; or if the costs stored for the device
        cannot be read, or measured ones cannot be stored.

    See Also
    --------
    factorize : Form the image by a plan.
    Imager : Form several images by a plan.
    backproject : Form the exact image.

    Notes
    -----
    A factorized image divides the grid into subimages within subimages, and combines the channels
    of each into fewer, virtual ones, stage by stage [1]_. The search tries numbers of stages, sizes
    of subimages and taps of filters. It predicts the time of each factorization from counts of its
    operations, and the error from the sum of the powers of independent contributions
    (`Plan.errors`). The plan is the fastest factorization whose predicted error, with a margin for
    the scatter of measured ones, is within the tolerance.

    Range errors that are spread evenly between minus and plus w wavelengths turn phases by up to
    4 pi w. The relative rms error is therefore 4 pi w/sqrt(3), and ::

        tolerance_db = 20 log10(4 pi tolerance_wavelengths/sqrt(3))

    References
    ----------
    .. [1] Ulander, Hellsten, Stenström, "Synthetic-aperture radar processing using fast factorized
       back-projection", IEEE Transactions on Aerospace and Electronic Systems 39(3), 2003.
    .. [2] Ødegaard, "Fast time domain beamforming for synthetic aperture sonar", thesis,
       University of Oslo, 2004, chapter 4.

    Examples
    --------
    The planner decides whether a factorization is faster than the exact image. A small image is
    exact:

    >>> import clsas
    >>> import numpy as np
    >>> tx_m = np.outer(np.arange(64), [0.02, 0, 0])
    >>> point = clsas.PointTargets([[0.6, 20.0, 0.0]], [1.0])
    >>> lines = clsas.simulate_lines(tx_m, tx_m, point, carrier_hz=100e3, bandwidth_hz=20e3)
    >>> grid = clsas.Grid.plane((0.4, 0.8, 32), (19.8, 20.2, 32))
    >>> plan = clsas.plan(lines, grid, tolerance_db=-40)
    >>> plan.is_exact
    True

    Given a number of stages, it returns the fastest factorization that has them:

    >>> plan = clsas.plan(lines, grid, tolerance_db=-40, depth=1)
    >>> plan.is_exact, len(plan.sides)
    (False, 1)
    >>> plan.predicted_error_db <= -40
    True
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
    warn_before_imaging(lines, grid, beam)
    return planned(request).plan


@dataclass(frozen=True, eq=False)
class Planned:
    """A plan, with results of planning that forming its image needs again.

    Attributes
    ----------
    plan : Plan
    known : Known
        Results for a factorization; only the homogeneous water for an exact image.
    """

    plan: Plan
    known: Known = NOTHING


def planned(request: Request) -> Planned:
    """Return the plan of a request, with what its image needs again."""
    device = open_device(request.device)
    given = request
    water = homogeneous(
        given.lines, given.grid, given.beam, None if given.full_model else given.tolerance_db
    )
    request = given.with_scene(water.lines(given.lines), water.grid, water.beam)
    corrected = water.corrections is not None
    scene = _simplified(request, keeps_points=corrected)
    model = model_of(
        scene.lines, scene.grid, scene.beam, OUTSIDE * power(request.tolerance_db or 0.0)
    )
    left_out = scene.error + water.error
    exact_db, factorized_db = _left_to_methods_db(request.tolerance_db, model, left_out)
    exact = expect(model, exact_db, device)
    is_reached = reaches(request.lines, request.grid, request.beam, model.channels_along)
    costs = _known_costs(request, exact, device, is_reached)
    room = request.memory_bytes or device.info.memory_bytes // 2
    conditions = Conditions(
        factorized_db,
        exact,
        device.for_stages(),
        costs.costs,
        room,
        corrected=corrected,
    )
    if is_reached:
        found, track = _chosen(request, model, conditions)
    else:  # an image of zeros needs no search, nor memory
        found, track = exact_plan(model, conditions, UNREACHED), None
        warn_unreached(request.lines, request.grid, request.beam, model.channels_along)
    chosen = _completed(found, given, scene, water, model, costs)
    if chosen.is_exact or not isinstance(model, VisibilityModel):
        return Planned(chosen, Known(water=water))
    return Planned(chosen, Known(scene, track, model.surface, water))


def _simplified(request: Request, *, keeps_points: bool) -> Model:
    """Return the scene without effects whose errors lie far below the tolerance."""
    given = request.lines, request.grid, request.beam
    if request.full_model:
        return Model(*given)
    return simplify(*given, request.tolerance_db, keeps_points=keeps_points)


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
    return exact_plan(model, conditions, reason), None


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
    found: Plan,
    request: Request,
    scene: Model,
    water: Homogeneous,
    model: LinesModel,
    costs: KnownCosts,
) -> Plan:
    """Return a plan of the simplified scene as one of the request: with all errors, and origins."""
    ambiguity, errors = model.ambiguity, found.errors
    if not found.is_exact:
        errors = errors.times(1 / ambiguity.least_brightness)
    errors = replace(
        errors,
        line_ends=ambiguity.ends,
        aliasing=ambiguity.aliasing,
        left_out=scene.error + water.error,
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
        left_out=(*scene.left_out, *water.left_out),
        beam=request.beam,
    )
    if not scene.left_out and request.lines.sound_speed is None:
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
