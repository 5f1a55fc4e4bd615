"""The fastest factorization that keeps a tolerance and a memory limit.

The search proposes the fastest tree for the error that is left to its filters. Its estimate then
says what else errs, such as unevenly spaced virtual channels. As long as the sum is too much, the
next candidate gets denser virtual channels, or leaves less to its filters; if it needs too much
memory, it gets smaller roots. Candidates therefore come in the order of their times.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from clsas.core.decibels import in_db, power
from clsas.factorized.estimates import ErrorBudget
from clsas.factorized.filters import FilterRates, Filters, steering_spectrum
from clsas.factorized.plan import Plan
from clsas.opencl import phases
from clsas.opencl.device import Device
from clsas.planning import forecast
from clsas.planning.costs import Costs
from clsas.planning.errors import Errors, excess_error, other_errors, root_error
from clsas.planning.exact_image import Exact
from clsas.planning.forecast import Candidate, margin_db
from clsas.planning.search import Allowed, Tree, root_limits, search
from clsas.planning.view import View

# Shares of the error power allowed: for roots, for the spacing of all stages' virtual channels, for
# edges of the beam that are left out, and for what is always there.
_ROOTS_SHARE, _SPACING_SHARE, _EDGES_SHARE, _RESERVED_SHARE = 0.25, 0.2, 0.03, 0.08
_MOST_SPENT = 0.9  # of the error power allowed, before filters
_LEAST_DENSER, _MOST_DENSITY = 1.05, 2.0  # virtual channels: at a time, and altogether
_DENSITY_POWER = 0.08  # of an error that denser virtual channels are to mend
_LEAST_STEP, _OVERSHOOT = 0.02, 1.3  # of the error allowed, and of what was too much
_LEAST_BEAM_CYCLES, _MOST_BEAM_CYCLES = 0.5, 64.0


@dataclass(frozen=True, eq=False)
class _Problem:
    """Conditions that all candidates share.

    Attributes
    ----------
    view : View
        Without the edges of the beam, if there is one.
    tolerance_db : float
    exact : Exact
        The image to beat.
    device, costs, memory_bytes
        What there is to work with.
    designs : dict
        Filters designed before.
    """

    view: View
    tolerance_db: float
    exact: Exact
    device: Device
    costs: Costs
    memory_bytes: int
    designs: dict[tuple[FilterRates, int, float], Filters] = field(default_factory=dict)

    @property
    def allowed(self) -> float:
        """Error power of the tolerance."""
        return power(self.tolerance_db)

    @property
    def beam_edges(self) -> float:
        """Error power of the edges of the beam that are left out."""
        return 0.0 if self.view.beam is None else _EDGES_SHARE * self.allowed

    @property
    def reserved(self) -> float:
        """Error power that is kept for what neither filters nor roots add, at least."""
        of_phases = phases.error(phases.terms_within(self.tolerance_db)) ** 2
        return self.beam_edges + _RESERVED_SHARE * self.allowed + of_phases

    def filters_db(self, reserved: float, root: tuple[int, int]) -> float | None:
        """Return what is left to filters beside roots of a size, None if next to nothing."""
        spent = reserved + root_error(self.view, root)
        if spent >= _MOST_SPENT * self.allowed:
            return None
        return in_db(self.allowed - spent) - margin_db(self.view)


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
        See `Plan`.
    reserved : float
        Error power that is kept for what neither filters nor roots add.
    least_leaf_pixels : int
    tree : Tree or None
        The tree, once it was searched for.
    density : tuple of float
        How much denser than the band limit asks for its virtual channels are, stage by stage.
    """

    choices: Allowed
    most_root: tuple[int, int]
    beam_cycles: float
    reserved: float
    least_leaf_pixels: int = 1
    tree: Tree | None = None
    density: tuple[float, ...] = ()


def fastest(
    view: View,
    tolerance_db: float,
    exact: Exact,
    seconds: float,
    device: Device,
    costs: Costs,
    memory_bytes: int,
    choices: Allowed,
) -> tuple[Plan | None, float]:
    """Return the fastest plan within a tolerance, if it takes less than some seconds.

    Beside it, where there is none, the least memory of those that did not fit.
    """
    trimmed = view.trimmed(_EDGES_SHARE * power(tolerance_db))
    problem = _Problem(trimmed, tolerance_db, exact, device, costs, memory_bytes)
    most_root = root_limits(trimmed, _ROOTS_SHARE * problem.allowed)
    needed, trial = math.inf, None
    if most_root is not None:
        beam_cycles = 0.0 if view.beam is None else _LEAST_BEAM_CYCLES
        trial = _Trial(choices, most_root, beam_cycles, problem.reserved)
    while trial is not None:
        if trial.tree is None:
            trial = _searched(problem, trial)
            continue
        filters = _filters(problem, trial)
        if filters is None:
            trial = _with_fewer_stages(problem, trial)
            continue
        errors, found = _estimated(problem, trial, filters)
        if found.predicted_seconds >= seconds:
            break
        if found.predicted_error_db > tolerance_db:
            trial = _more_accurate(problem, trial, errors, found)
        elif found.memory_bytes > memory_bytes:
            needed = min(needed, found.memory_bytes)
            rows, columns = found.sides[0]
            smaller = (rows // 2, columns) if rows > columns else (rows, columns // 2)
            trial = replace(trial, most_root=smaller, tree=None)
        else:
            return found, needed
    return None, needed


def _searched(problem: _Problem, trial: _Trial) -> _Trial | None:
    """Return the trial with the fastest tree, None without any."""
    filters_db = problem.filters_db(trial.reserved, trial.most_root)
    if filters_db is None:
        return None
    tree = search(
        problem.view,
        filters_db,
        trial.most_root,
        trial.least_leaf_pixels,
        trial.beam_cycles,
        problem.device,
        problem.costs,
        trial.choices,
    )
    return tree and replace(trial, tree=tree, density=(1.0,) * len(tree.sides))


def _filters(problem: _Problem, trial: _Trial) -> Filters | None:
    """Return the filters of a trial's tree, None where they cannot err by as little as is left."""
    # Roots are often smaller than they might be, and leave more to filters.
    filters_db = problem.filters_db(trial.reserved, trial.tree.sides[0])
    if filters_db is None:
        return None
    view, stages = problem.view, len(trial.tree.sides)
    choice = trial.tree.filters(view.spectrum, filters_db)
    if choice is None:
        return None
    key = choice, stages, filters_db
    if key not in problem.designs:
        frequencies, share = view.frequencies
        steering = steering_spectrum(frequencies / view.highest_cycles_per_m, share)
        problem.designs[key] = choice.design(view.spectrum, steering, stages, filters_db)
    return problem.designs[key]


def _estimated(problem: _Problem, trial: _Trial, filters: Filters) -> tuple[Errors, Plan]:
    """Return what a candidate errs by beside its filters, and its plan."""
    sides, roots = trial.tree.sides, root_error(problem.view, trial.tree.sides[0])
    within = problem.view.within(sides[0])
    errors = other_errors(
        within, sides, roots, filters.aperture, trial.density, trial.beam_cycles, problem.device
    )
    budget = ErrorBudget(
        roots=errors.roots,
        spacing=sum(errors.nodes),
        leaves=errors.leaves,
        beam_edges=problem.beam_edges,
    )
    candidate = Candidate(sides, filters, crowding=trial.density, beam_cycles=trial.beam_cycles)
    found = forecast.factorized(
        within,
        candidate,
        budget,
        problem.tolerance_db,
        problem.exact,
        problem.device,
        problem.costs,
        problem.memory_bytes,
    )
    return errors, found


def _with_fewer_stages(problem: _Problem, trial: _Trial) -> _Trial | None:
    """Return a trial of fewer stages: their subimages are larger, with more virtual channels.

    That helps where virtual channels are as dense as they may be; else there is nothing left.
    """
    fewer = tuple(n for n in trial.choices.stages if n < len(trial.tree.sides))
    if not fewer or _MOST_DENSITY not in trial.density[:-1]:
        return None
    choices = replace(trial.choices, stages=fewer)
    return replace(trial, choices=choices, tree=None, reserved=problem.reserved)


def _more_accurate(problem: _Problem, trial: _Trial, errors: Errors, found: Plan) -> _Trial | None:
    """Return a trial that errs by less than a candidate that missed the tolerance.

    What uneven spacing and a beam add falls with the density of virtual channels; filters must make
    up for the rest.
    """
    allowed, last = problem.allowed, found.sides[-1]
    share = _SPACING_SHARE * allowed / len(found.sides)
    excess = [max(of_stage - share, 0.0) for of_stage in errors.nodes]
    beam_cycles = trial.beam_cycles
    if excess[-1] and beam_cycles > 0:
        within = problem.view.within(found.sides[0])
        without_beam = excess_error(within, last, found.aperture, trial.density[-1], None)
        if 2 * without_beam < errors.nodes[-1]:  # most of it is the beam's
            if beam_cycles >= _MOST_BEAM_CYCLES:
                return None  # no virtual channels follow a step
            beam_cycles, excess[-1] = 2 * beam_cycles, 0.0
            return replace(
                trial, beam_cycles=beam_cycles, density=_denser(trial.density, excess, share)
            )
    if excess[-1] and trial.density[-1] == _MOST_DENSITY:
        # Smaller leaves have fewer virtual channels, less evenly spaced.
        return replace(trial, least_leaf_pixels=2 * math.prod(last), tree=None)
    if any(excess) and max(trial.density) < _MOST_DENSITY:
        return replace(trial, density=_denser(trial.density, excess, share))
    too_much = power(-margin_db(problem.view)) * (power(found.predicted_error_db) - allowed)
    return replace(trial, reserved=trial.reserved + _OVERSHOOT * too_much + _LEAST_STEP * allowed)


def _denser(density: tuple[float, ...], excess: list[float], share: float) -> tuple[float, ...]:
    """Return how dense virtual channels are next, where their errors exceed a share."""
    return tuple(
        min(each * max((1 + over / share) ** _DENSITY_POWER, _LEAST_DENSER), _MOST_DENSITY)
        if over
        else each
        for each, over in zip(density, excess, strict=True)
    )
