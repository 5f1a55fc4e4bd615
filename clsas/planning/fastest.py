"""The fastest factorization within a tolerance and a memory limit.

The search proposes the fastest tree for the error that is left to its filters. The prediction then
adds all other errors, such as those of unevenly spaced virtual channels. If their sum exceeds the
tolerance, the next candidate has denser virtual channels, or more accurate filters; if it needs too
much memory, the next one has smaller roots. The candidates are therefore tried in the order of
their times, and the first that meets both limits is accepted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from clsas.aperture.filters import FilterRates, Filters, steering_spectrum
from clsas.aperture.interpolated import InterpolatedAperture
from clsas.aperture.mean_track import MeanTrack
from clsas.core.decibels import in_db, power
from clsas.opencl import phases
from clsas.planning.beam_coverage import trimmed
from clsas.planning.candidate import Candidate
from clsas.planning.channels import frequencies
from clsas.planning.errors import Errors, other_errors, root_error, spaced_stages
from clsas.planning.prediction import (
    Conditions,
    margin_db,
    predicted_plan,
)
from clsas.planning.search import Allowed, Tree, search
from clsas.planning.sizes import largest_root, root_limits
from clsas.planning.spacing_errors import spacing_error
from clsas.planning.stretches import aligned_spectrum
from clsas.planning.visibility_model import VisibilityModel
from clsas.plans.plan import Plan
from clsas.plans.predictions import ErrorBudget
from clsas.signal.spectrum import OUTSIDE, occupied_band

# Shares of the allowed error power, with the effect of half and twice the value, as measured by
# `scripts/bench sensitivity`.
_ROOTS_SHARE = 0.25  # for roots; twice: up to 5 % slower
_SPACING_SHARE = 0.2  # for uneven spacing of all stages; decides which refinement is tried first
_EDGES_SHARE = 0.03  # for edges of the beam that are left out; half: 0.5 % slower
_RESERVED_SHARE = 0.08  # for leaves, upsampling, rounding; half: 3 % faster, with one more trial
_MOST_SPENT = 0.9  # by everything but filters; 1 would require filters without any error
_LEAST_DENSER = 1.05  # factor of one step; half the step: planning takes 10 % longer
_MOST_OVERSAMPLING = 2.0  # of virtual channels; twice: planning takes 30 % longer for nothing
_DENSITY_POWER = 0.08  # of a relative excess; half or twice: planning up to 20 % longer
_LEAST_STEP = 0.02  # share added to the reserve at least; half or twice: errors move by 0.1 dB
_OVERSHOOT = 1.3  # of the excess, added to the reserve; twice: errors 0.2 dB below the tolerance
_LEAST_BEAM_CYCLES = 0.5  # of an edge of the beam, at first; half: 2 % faster, twice: 3 % slower
_MOST_BEAM_CYCLES = 64.0  # beyond, the weights are a step, which virtual channels cannot follow

_NOT_SMOOTH = (
    "channels deviate too much from a smooth aperture, in position, motion or heading, even for "
    "the smallest subimages"
)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Requirements that all candidates share.

    Attributes
    ----------
    model : VisibilityModel
        Without the edges of the beam, if there is one.
    conditions : Conditions
    designs : dict
        Filters that were designed for earlier candidates.
    """

    model: VisibilityModel
    conditions: Conditions
    designs: dict[tuple[FilterRates, int, float], Filters] = field(default_factory=dict)

    @property
    def tolerance_db(self) -> float:
        """Tolerated relative rms error, dB."""
        tolerance_db = self.conditions.tolerance_db
        assert tolerance_db is not None  # with given stages there is nothing to search
        return tolerance_db

    @property
    def allowed(self) -> float:
        """Error power of the tolerance."""
        return power(self.tolerance_db)

    @property
    def beam_edges(self) -> float:
        """Error power of the edges of the beam that are left out."""
        return 0.0 if self.model.beam is None else _EDGES_SHARE * self.allowed

    @property
    def reserved(self) -> float:
        """Least error power that is reserved for everything but filters and roots."""
        terms = phases.terms_within(self.tolerance_db, phases.FACTORIZED_SHARE)
        of_phases = phases.error(terms) ** 2
        return self.beam_edges + _RESERVED_SHARE * self.allowed + of_phases

    def filters_db(self, reserved: float, root: tuple[int, int]) -> float | None:
        """Return the error that is left to filters with roots of a size; None if almost nothing."""
        spent = reserved + root_error(self.model, root)
        if spent >= _MOST_SPENT * self.allowed:
            return None
        return in_db(self.allowed - spent) - margin_db(self.model)


@dataclass(frozen=True)
class _Trial:
    """Limits of the next candidate.

    Attributes
    ----------
    choices : Allowed
        Taps and numbers of stages to choose from.
    most_root : (rows, columns)
        Size of the largest roots.
    beam_cycles : float
        See `InterpolatedAperture`.
    reserved : float
        Error power that is reserved for everything but filters and roots.
    least_leaf_pixels : int
    tree : Tree or None
        The fastest tree within the limits; None if it must be searched for.
    oversampling : tuple of float
        Density of virtual channels over that which the filter requires, stage by stage.
    """

    choices: Allowed
    most_root: tuple[int, int]
    beam_cycles: float
    reserved: float
    least_leaf_pixels: int = 1
    tree: Tree | None = None
    oversampling: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of a search.

    Attributes
    ----------
    plan : Plan or None
        The fastest factorization; None if there is none, or none as fast as required.
    track : MeanTrack or None
        The plan's mean track.
    least_bytes : float
        Without a plan, the least memory of the candidates that did not fit.
    obstacle : str
        Why an image cannot be factorized at all, in words; "" if it can.
    """

    plan: Plan | None = None
    track: MeanTrack | None = None
    least_bytes: float = math.inf
    obstacle: str = ""


def fastest(
    model: VisibilityModel, conditions: Conditions, seconds: float, choices: Allowed
) -> Outcome:
    """Return the fastest plan within a tolerance, if it takes less than `seconds`."""
    problem = _Problem(model, conditions)
    problem = replace(problem, model=trimmed(model, _EDGES_SHARE * problem.allowed))
    most_root = root_limits(problem.model, _ROOTS_SHARE * problem.allowed)
    if most_root is None:
        return Outcome(obstacle=_NOT_SMOOTH)
    beam_cycles = 0.0 if model.beam is None else _LEAST_BEAM_CYCLES
    trial: _Trial | None = _Trial(choices, most_root, beam_cycles, problem.reserved)
    least_bytes = math.inf
    while trial is not None:
        tree = trial.tree
        if tree is None:
            trial = _searched(problem, trial)
            continue
        filters = _filters(problem, trial, tree)
        if filters is None:
            trial = _with_fewer_stages(problem, trial, tree)
            continue
        errors, found = _predicted(problem, trial, tree, filters)
        if found.predicted_seconds >= seconds:
            break
        if found.predicted_error_db > problem.tolerance_db:
            trial = _more_accurate(problem, trial, errors, found)
        elif found.memory_bytes > conditions.memory_bytes:
            least_bytes = min(least_bytes, found.memory_bytes)
            trial = _with_smaller_roots(trial, found)
        else:
            return Outcome(found, model.track)
    return Outcome(least_bytes=least_bytes)


def off_track(model: VisibilityModel, conditions: Conditions) -> bool:
    """Return whether channels lie too far from the mean track for the largest roots."""
    problem = _Problem(model, conditions)
    return root_error(problem.model, largest_root(model)) > _ROOTS_SHARE * problem.allowed


def _searched(problem: _Problem, trial: _Trial) -> _Trial | None:
    """Return the trial with the fastest tree; None if there is no tree."""
    filters_db = problem.filters_db(trial.reserved, trial.most_root)
    if filters_db is None:
        return None
    tree = search(
        problem.model,
        filters_db,
        trial.most_root,
        trial.least_leaf_pixels,
        trial.beam_cycles,
        problem.conditions.device,
        problem.conditions.costs,
        trial.choices,
    )
    return (
        None if tree is None else replace(trial, tree=tree, oversampling=(1.0,) * len(tree.sides))
    )


def _filters(problem: _Problem, trial: _Trial, tree: Tree) -> Filters | None:
    """Return the filters of a trial's tree; None if none are accurate enough."""
    # Roots are often smaller than the largest allowed, which leaves more to filters.
    filters_db = problem.filters_db(trial.reserved, tree.sides[0])
    if filters_db is None:
        return None
    model, stages = problem.model, len(tree.sides)
    spectrum = aligned_spectrum(model)
    choice = tree.filters(spectrum, filters_db)
    if choice is None:
        return None
    key = choice, stages, filters_db
    if key not in problem.designs:
        cycles_per_m, share = frequencies(model)
        steering = steering_spectrum(cycles_per_m / model.highest_cycles_per_m, share)
        problem.designs[key] = choice.design(spectrum, steering, stages, filters_db)
    return problem.designs[key]


def _predicted(
    problem: _Problem, trial: _Trial, tree: Tree, filters: Filters
) -> tuple[Errors, Plan]:
    """Return the errors of a candidate other than those of its range filters, and its plan."""
    sides, roots = tree.sides, root_error(problem.model, tree.sides[0])
    within = problem.model.within(sides[0])
    conditions = problem.conditions
    errors = other_errors(
        within,
        sides,
        roots,
        filters.aperture,
        trial.oversampling,
        trial.beam_cycles,
        conditions.device,
    )
    budget = ErrorBudget(
        aperture_filters=errors.aperture,
        roots=errors.roots,
        spacing=sum(errors.spacing),
        leaves=errors.leaves,
        beam_edges=problem.beam_edges,
    )
    aperture = InterpolatedAperture(
        filter=filters.aperture,
        oversampling=trial.oversampling,
        beam_cycles=trial.beam_cycles,
        shape=within.shape,
        band=occupied_band(within.spectrum, OUTSIDE * problem.allowed),
    )
    candidate = Candidate(
        sides=sides,
        tile=sides[-1],
        align=filters.align,
        final=filters.final,
        aperture=aperture,
        margin=power(margin_db(within)),
    )
    return errors, predicted_plan(within, candidate, budget, conditions)


def _with_smaller_roots(trial: _Trial, found: Plan) -> _Trial:
    """Return a trial whose roots have at most half as many pixels, which need less memory."""
    rows, columns = found.sides[0]
    smaller = (rows // 2, columns) if rows > columns else (rows, columns // 2)
    return replace(trial, most_root=smaller, tree=None)


def _with_fewer_stages(problem: _Problem, trial: _Trial, tree: Tree) -> _Trial | None:
    """Return a trial of fewer stages, whose larger subimages have more virtual channels.

    This helps if the virtual channels are as dense as allowed. Otherwise return None: no other
    refinement is left.
    """
    fewer = tuple(n for n in trial.choices.stages if n < len(tree.sides))
    if not fewer or _MOST_OVERSAMPLING not in trial.oversampling[:-1]:
        return None
    choices = replace(trial.choices, stages=fewer)
    return replace(trial, choices=choices, tree=None, reserved=problem.reserved)


def _more_accurate(problem: _Problem, trial: _Trial, errors: Errors, found: Plan) -> _Trial | None:
    """Return a trial with a smaller error than a candidate that missed the tolerance.

    Denser virtual channels reduce the errors of uneven spacing and of a beam. More accurate filters
    make up for other errors.
    """
    allowed, last = problem.allowed, found.sides[-1]
    share = _SPACING_SHARE * allowed / len(found.sides)
    excess = [max(of_stage - share, 0.0) for of_stage in errors.spacing]
    beam_cycles = trial.beam_cycles
    if excess[-1] and beam_cycles > 0:
        within = problem.model.within(found.sides[0])
        aperture = found.factorization.aperture.filter
        stages = spaced_stages(found.sides, aperture, trial.oversampling, None)
        without_beam = spacing_error(within, stages)
        if 2 * without_beam < errors.spacing[-1]:  # the beam causes most of it
            if beam_cycles >= _MOST_BEAM_CYCLES:
                return None  # virtual channels cannot follow a step
            beam_cycles, excess[-1] = 2 * beam_cycles, 0.0
            return replace(
                trial,
                beam_cycles=beam_cycles,
                oversampling=_denser(trial.oversampling, excess, share),
            )
    if excess[-1] and trial.oversampling[-1] == _MOST_OVERSAMPLING:
        # Smaller leaves have fewer virtual channels, less evenly spaced.
        return replace(trial, least_leaf_pixels=2 * math.prod(last), tree=None)
    if any(excess) and max(trial.oversampling) < _MOST_OVERSAMPLING:
        return replace(trial, oversampling=_denser(trial.oversampling, excess, share))
    too_much = power(-margin_db(problem.model)) * (power(found.predicted_error_db) - allowed)
    # Other errors fall together with those of filters, which keep at least half of their share.
    left = _MOST_SPENT * allowed - trial.reserved - errors.roots
    step = min(_OVERSHOOT * too_much, left / 2)
    return replace(trial, reserved=trial.reserved + step + _LEAST_STEP * allowed)


def _denser(
    oversampling: tuple[float, ...], excess: list[float], share: float
) -> tuple[float, ...]:
    """Return the next oversampling of virtual channels: higher where errors exceed their share."""
    return tuple(
        min(each * max((1 + over / share) ** _DENSITY_POWER, _LEAST_DENSER), _MOST_OVERSAMPLING)
        if over
        else each
        for each, over in zip(oversampling, excess, strict=True)
    )
