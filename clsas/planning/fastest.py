"""The fastest factorization that keeps a tolerance and a memory limit.

The search proposes the fastest tree for the error that is left to its filters. Its estimate then
says what else errs, such as unevenly spaced virtual channels. As long as the sum is too much, the
next candidate gets denser virtual channels, or leaves less to its filters; if it needs too much
memory, it gets smaller roots. Candidates therefore come in the order of their times.
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
from clsas.planning.channels import frequencies
from clsas.planning.errors import Errors, other_errors, root_error, spaced_stages
from clsas.planning.prediction import (
    Candidate,
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

# Shares of the allowed error power. `scripts/bench sensitivity` measured what half and twice do.
_ROOTS_SHARE = 0.25  # for roots; twice: up to 5 % slower
_SPACING_SHARE = 0.2  # for uneven spacing of all stages; chooses which remedy is tried first
_EDGES_SHARE = 0.03  # for edges of the beam that are left out; half: 0.5 % slower
_RESERVED_SHARE = 0.08  # for leaves, upsampling, rounding; half: 3 % faster after one more trial
_MOST_SPENT = 0.9  # before filters; 1 would ask for filters without any error
_LEAST_DENSER = 1.05  # factor of one step; half the step: planning takes 10 % longer
_MOST_OVERSAMPLING = 2.0  # of virtual channels; twice: planning takes 30 % longer for nothing
_DENSITY_POWER = 0.08  # of a relative excess; half or twice: planning up to 20 % longer
_LEAST_STEP = 0.02  # share added to the reserve at least; half or twice: errors move by 0.1 dB
_OVERSHOOT = 1.3  # of the excess, added to the reserve; twice: errors 0.2 dB less than asked
_LEAST_BEAM_CYCLES = 0.5  # of an edge of the beam at first; half: 2 % faster, twice: 3 % slower
_MOST_BEAM_CYCLES = 64.0  # beyond, virtual channels take the weights for a step

_NOT_SMOOTH = (
    "channels are too far from a smooth aperture, by their place, motion or heading, for the "
    "smallest subimages"
)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Conditions that all candidates share.

    Attributes
    ----------
    model : VisibilityModel
        Without the edges of the beam, if there is one.
    conditions : Conditions
    designs : dict
        Filters designed before.
    """

    model: VisibilityModel
    conditions: Conditions
    designs: dict[tuple[FilterRates, int, float], Filters] = field(default_factory=dict)

    @property
    def tolerance_db(self) -> float:
        """Relative rms error asked for."""
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
        """Error power that is kept for what neither filters nor roots add, at least."""
        terms = phases.terms_within(self.tolerance_db, phases.FACTORIZED_SHARE)
        of_phases = phases.error(terms) ** 2
        return self.beam_edges + _RESERVED_SHARE * self.allowed + of_phases

    def filters_db(self, reserved: float, root: tuple[int, int]) -> float | None:
        """Return what is left to filters beside roots of a size, None if next to nothing."""
        spent = reserved + root_error(self.model, root)
        if spent >= _MOST_SPENT * self.allowed:
            return None
        return in_db(self.allowed - spent) - margin_db(self.model)


@dataclass(frozen=True)
class _Trial:
    """Limits that the next candidate keeps to.

    Attributes
    ----------
    choices : Allowed
        Taps and numbers of stages to choose from.
    most_root : (rows, columns)
        The largest roots.
    beam_cycles : float
        See `InterpolatedAperture`.
    reserved : float
        Error power that is kept for what neither filters nor roots add.
    least_leaf_pixels : int
    tree : Tree or None
        The tree, once it was searched for.
    oversampling : tuple of float
        How much denser than the filter needs its virtual channels are, stage by stage.
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
        The fastest factorization; None if there is none, or none as fast as asked for.
    track : MeanTrack or None
        The plan's mean track.
    least_bytes : float
        Without a plan, the least memory of those that did not fit.
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
    """Return the fastest plan within a tolerance, if it takes less than some seconds."""
    problem = _Problem(model, conditions)
    problem = replace(problem, model=trimmed(model, _EDGES_SHARE * problem.allowed))
    most_root = root_limits(problem.model, _ROOTS_SHARE * problem.allowed)
    if most_root is None:
        return Outcome(obstacle=_NOT_SMOOTH)
    beam_cycles = 0.0 if model.beam is None else _LEAST_BEAM_CYCLES
    trial: _Trial | None = _Trial(choices, most_root, beam_cycles, problem.reserved)
    needed = math.inf
    while trial is not None:
        tree = trial.tree
        if tree is None:
            trial = _searched(problem, trial)
            continue
        filters = _filters(problem, trial, tree)
        if filters is None:
            trial = _with_fewer_stages(problem, trial, tree)
            continue
        errors, found = _estimated(problem, trial, tree, filters)
        if found.predicted_seconds >= seconds:
            break
        if found.predicted_error_db > problem.tolerance_db:
            trial = _more_accurate(problem, trial, errors, found)
        elif found.memory_bytes > conditions.memory_bytes:
            needed = min(needed, found.memory_bytes)
            rows, columns = found.sides[0]
            smaller = (rows // 2, columns) if rows > columns else (rows, columns // 2)
            trial = replace(trial, most_root=smaller, tree=None)
        else:
            return Outcome(found, model.track)
    return Outcome(least_bytes=needed)


def off_track(model: VisibilityModel, conditions: Conditions) -> bool:
    """Return whether channels lie too far from the mean track for the largest roots."""
    problem = _Problem(model, conditions)
    return root_error(problem.model, largest_root(model)) > _ROOTS_SHARE * problem.allowed


def _searched(problem: _Problem, trial: _Trial) -> _Trial | None:
    """Return the trial with the fastest tree, None without any."""
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
    # Roots are often smaller than they might be, and leave more to filters.
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


def _estimated(
    problem: _Problem, trial: _Trial, tree: Tree, filters: Filters
) -> tuple[Errors, Plan]:
    """Return the errors of a candidate besides those of its range filters, and its plan."""
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


def _with_fewer_stages(problem: _Problem, trial: _Trial, tree: Tree) -> _Trial | None:
    """Return a trial of fewer stages: their subimages are larger, with more virtual channels.

    That helps where virtual channels are as dense as they may be; else there is nothing left.
    """
    fewer = tuple(n for n in trial.choices.stages if n < len(tree.sides))
    if not fewer or _MOST_OVERSAMPLING not in trial.oversampling[:-1]:
        return None
    choices = replace(trial.choices, stages=fewer)
    return replace(trial, choices=choices, tree=None, reserved=problem.reserved)


def _more_accurate(problem: _Problem, trial: _Trial, errors: Errors, found: Plan) -> _Trial | None:
    """Return a trial that errs by less than a candidate that missed the tolerance.

    Denser virtual channels reduce the errors of uneven spacing and of a beam. Filters make up for
    the rest.
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
        if 2 * without_beam < errors.spacing[-1]:  # most of it is the beam's
            if beam_cycles >= _MOST_BEAM_CYCLES:
                return None  # no virtual channels follow a step
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
    # Some errors fall together with those of filters, which keep half of what they have at least.
    left = _MOST_SPENT * allowed - trial.reserved - errors.roots
    step = min(_OVERSHOOT * too_much, left / 2)
    return replace(trial, reserved=trial.reserved + step + _LEAST_STEP * allowed)


def _denser(
    oversampling: tuple[float, ...], excess: list[float], share: float
) -> tuple[float, ...]:
    """Return the next oversampling of virtual channels: more where errors exceed their share."""
    return tuple(
        min(each * max((1 + over / share) ** _DENSITY_POWER, _LEAST_DENSER), _MOST_OVERSAMPLING)
        if over
        else each
        for each, over in zip(oversampling, excess, strict=True)
    )
