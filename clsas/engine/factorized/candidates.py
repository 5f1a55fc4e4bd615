"""The fastest factorization within a tolerance and a memory limit.

The search proposes the fastest division for the error that is left to its filters. The prediction
then adds all other errors, such as those of unevenly spaced virtual channels. If their sum exceeds
the tolerance, the next candidate has denser virtual channels, or more accurate filters; if it needs
too much memory, the next one has smaller roots. The candidates are therefore tried in the order of
their times, and the first that meets both limits is accepted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from clsas.engine.data.decibels import in_db, power
from clsas.engine.device import kernels
from clsas.engine.device.buffers import padded_length
from clsas.engine.device.device import Device
from clsas.engine.factorized.buffers import Level
from clsas.engine.factorized.costs import (
    BufferSizes,
    Costs,
    ExactPrediction,
    adding_in_rows,
    backprojecting_leaves,
    batches_within,
    combining,
    references,
    upsampling,
)
from clsas.engine.factorized.errors import (
    SpacedStage,
    SpacingErrors,
    UpsampledLines,
    errors_of_tree,
    looked_up_singly,
    margin_db,
    root_error,
    with_arithmetic,
    with_range_filters,
)
from clsas.engine.factorized.filters import FilterRates, Filters, steering_spectrum
from clsas.engine.factorized.plan import (
    ErrorBudget,
    ExactImage,
    Factorization,
    Plan,
    Prediction,
    StagePrediction,
    Work,
)
from clsas.engine.factorized.sampled import SampledRoots, Side
from clsas.engine.factorized.search import (
    Choices,
    Division,
    Sizes,
    all_sizes,
    half_range_extents_m,
    ladder,
    largest_root,
    search,
)
from clsas.engine.factorized.track import MeanTrack
from clsas.engine.factorized.tree import BEAM_MARGIN
from clsas.engine.factorized.virtual_channels import InterpolatedAperture, NearestBeams
from clsas.engine.scene import Scene
from clsas.engine.signal.interpolation import Interpolator
from clsas.engine.signal.spectrum import OUTSIDE, occupied_band

# Shares of the allowed error power, with the effect of half and twice the value, as measured by
# `scripts/bench sensitivity`.
_ROOTS_SHARE = 0.25  # for roots; twice: up to 5 % slower
_SPACING_SHARE = 0.2  # for uneven spacing of all stages; decides which refinement is tried first
EDGES_SHARE = 0.03
"""For edges of the beam that are left out; half: 0.5 % slower."""
_RESERVED_SHARE = 0.08  # for leaves, upsampling, rounding; half: 3 % faster, with one more trial
_MOST_SPENT = 0.9  # by everything but filters; 1 would require filters without any error
_LEAST_DENSER = 1.05  # factor of one step; half the step: planning takes 10 % longer
_MOST_OVERSAMPLING = 2.0  # of virtual channels; twice: planning takes 30 % longer for nothing
_DENSITY_POWER = 0.08  # of a relative excess; half or twice: planning up to 20 % longer
_LEAST_STEP = 0.02  # share added to the reserve at least; half or twice: errors move by 0.1 dB
_OVERSHOOT = 1.3  # of the excess, added to the reserve; twice: errors 0.2 dB below the tolerance
_LEAST_BEAM_CYCLES = 0.5  # of an edge of the beam, at first; half: 2 % faster, twice: 3 % slower
_MOST_BEAM_CYCLES = 64.0  # beyond, the weights are a step, which virtual channels cannot follow
_ROOM = 1.06  # size of buffers over the predicted virtual channels; with 1.12: 2 % slower

_NOT_SMOOTH = (
    "channels deviate too much from a smooth aperture, in position, motion or heading, even for "
    "the smallest subimages"
)


@dataclass(frozen=True)
class Conditions:
    """Requirements of a plan, and the exact image that it competes with.

    Attributes
    ----------
    allowed_db : float or None
        Error that a factorization may have: what the errors of the lines themselves leave of the
        tolerance. None if stages were given.
    exact : ExactPrediction
    device : Device
    costs : Costs
    memory_bytes : int
        Device memory that may be used.
    """

    allowed_db: float | None
    exact: ExactPrediction
    device: Device
    costs: Costs
    memory_bytes: int


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
    is_off_track : bool
        True if channels lie too far from the mean track for the largest roots.
    """

    plan: Plan | None = None
    track: MeanTrack | None = None
    least_bytes: float = math.inf
    obstacle: str = ""
    is_off_track: bool = False


@dataclass(frozen=True)
class _Trial:
    """Limits of the next candidate.

    Attributes
    ----------
    choices : Choices
        Taps and numbers of stages to choose from.
    most_root : int
        Number of the ladder's rung that is the size of the largest roots.
    beam_cycles : float
        See `InterpolatedAperture`.
    reserved : float
        Error power that is reserved for everything but filters and roots.
    least_leaf_pixels : int
    division : Division or None
        The fastest division within the limits; None if it must be searched for.
    oversampling : tuple of float
        Density of virtual channels over that which the filter requires, stage by stage.
    """

    choices: Choices
    most_root: int
    beam_cycles: float
    reserved: float
    least_leaf_pixels: int = 1
    division: Division | None = None
    oversampling: tuple[float, ...] = ()


def fastest_plan(
    roots: SampledRoots, conditions: Conditions, to_beat_s: float, choices: Choices
) -> Outcome:
    """Return the fastest plan within a tolerance, if it takes less than `to_beat_s`.

    `roots` are the sample points, without a size of roots, within the limits of the beam that
    matter.
    """
    candidates = _Candidates(roots, conditions)
    rungs, of_roots = candidates.rungs, _ROOTS_SHARE * candidates.allowed
    most_root = largest_root(rungs, candidates.root_error, of_roots)
    if most_root < 0:
        return Outcome(obstacle=_NOT_SMOOTH, is_off_track=True)
    is_off_track = most_root < len(rungs) - 1
    beam_cycles = 0.0 if roots.sampled.scene.beam is None else _LEAST_BEAM_CYCLES
    trial: _Trial | None = _Trial(choices, most_root, beam_cycles, candidates.reserved)
    least_bytes = math.inf
    while trial is not None:
        division = trial.division
        if division is None:
            trial = candidates.searched(trial)
            continue
        filters = candidates.filters(trial, division)
        if filters is None:
            trial = candidates.with_fewer_stages(trial, division)
            continue
        found, spacing = candidates.predicted(trial, division, filters)
        if found.predicted_seconds >= to_beat_s:
            break
        if found.predicted_error_db > candidates.allowed_db:
            trial = candidates.more_accurate(trial, spacing, found)
        elif found.memory_bytes > conditions.memory_bytes:
            least_bytes = min(least_bytes, found.memory_bytes)
            smaller = rungs.index(found.sides[0]) - 1
            trial = None if smaller < 0 else replace(trial, most_root=smaller, division=None)
        else:
            return Outcome(found, roots.sampled.track, is_off_track=is_off_track)
    return Outcome(least_bytes=least_bytes, is_off_track=is_off_track)


class _Candidates:
    """Candidates for a plan of one scene, which share what was found for earlier ones."""

    def __init__(self, roots: SampledRoots, conditions: Conditions) -> None:
        assert conditions.allowed_db is not None  # with given stages there is nothing to search
        self.roots, self.conditions = roots, conditions
        self.allowed_db = conditions.allowed_db
        self.allowed = power(self.allowed_db)
        has_beam = roots.sampled.scene.beam is not None
        # Error power of the edges of the beam, and the least that is reserved for everything but
        # filters and roots.
        self.beam_edges = EDGES_SHARE * self.allowed if has_beam else 0.0
        terms = kernels.phase_terms_within(self.allowed_db, kernels.FACTORIZED_PHASE_SHARE)
        of_phases = kernels.phase_error(terms) ** 2
        self.reserved = self.beam_edges + _RESERVED_SHARE * self.allowed + of_phases
        self.margin_db = margin_db(roots)
        self.rungs = ladder(roots)
        self._root_errors: dict[Side, float] = {}
        self._sizes: dict[int, Sizes] = {}
        self._spacing: dict[Side, SpacingErrors] = {}
        self._designs: dict[tuple[FilterRates, int, float], Filters] = {}

    def root_error(self, side: Side) -> float:
        """Return `root_error` of roots of a size."""
        if side not in self._root_errors:
            self._root_errors[side] = root_error(self.roots, side)
        return self._root_errors[side]

    def filters_db(self, reserved: float, root: Side) -> float | None:
        """Return the error that is left to filters with roots of a size; None if almost nothing."""
        spent = reserved + self.root_error(root)
        if spent >= _MOST_SPENT * self.allowed:
            return None
        return in_db(self.allowed - spent) - self.margin_db

    def searched(self, trial: _Trial) -> _Trial | None:
        """Return the trial with the fastest division; None if there is no division."""
        filters_db = self.filters_db(trial.reserved, self.rungs[trial.most_root])
        if filters_db is None:
            return None
        if trial.most_root not in self._sizes:
            most = self.rungs[trial.most_root]
            within = [side for side in self.rungs if side[0] <= most[0] and side[1] <= most[1]]
            self._sizes[trial.most_root] = all_sizes(self.roots, within, self.conditions.device)
        division = search(
            self._sizes[trial.most_root],
            filters_db,
            trial.least_leaf_pixels,
            trial.beam_cycles,
            self.conditions.costs,
            trial.choices,
        )
        if division is None:
            return None
        return replace(trial, division=division, oversampling=(1.0,) * len(division.sides))

    def filters(self, trial: _Trial, division: Division) -> Filters | None:
        """Return the filters of a trial's division; None if none are accurate enough."""
        # Roots are often smaller than the largest allowed, which leaves more to filters.
        filters_db = self.filters_db(trial.reserved, division.sides[0])
        if filters_db is None:
            return None
        sampled, stages = self.roots.sampled, len(division.sides)
        spectrum = self.roots.stretch.spectrum(sampled.scene.spectrum)
        choice = division.filters(spectrum, filters_db)
        if choice is None:
            return None
        key = choice, stages, filters_db
        if key not in self._designs:
            cycles_per_m, share = sampled.frequencies()
            steering = steering_spectrum(cycles_per_m / sampled.highest_cycles_per_m, share)
            self._designs[key] = choice.design(spectrum, steering, stages, filters_db)
        return self._designs[key]

    def predicted(
        self, trial: _Trial, division: Division, filters: Filters
    ) -> tuple[Plan, tuple[float, ...]]:
        """Return the plan of a candidate, and its errors of uneven spacing, stage by stage."""
        sides = division.sides
        if sides[0] not in self._spacing:
            self._spacing[sides[0]] = SpacingErrors(self.roots.within(sides[0]))
        spacing = self._spacing[sides[0]]
        roots, scene = spacing.roots, self.roots.sampled.scene
        errors, by_stage = errors_of_tree(
            spacing,
            sides,
            filters,
            trial.oversampling,
            trial.beam_cycles,
            self.conditions.device,
        )
        errors = replace(errors, roots=self.root_error(sides[0]), beam_edges=self.beam_edges)
        aperture = InterpolatedAperture(
            filter=filters.aperture,
            oversampling=trial.oversampling,
            beam_cycles=trial.beam_cycles,
            shape=roots.sampled.shape,
            band=occupied_band(scene.spectrum, OUTSIDE * self.allowed),
        )
        plan = predicted_plan(
            roots,
            self.conditions,
            errors,
            sides=sides,
            tile=sides[-1],
            align=filters.align,
            final=filters.final,
            aperture=aperture,
            margin=power(margin_db(roots)),
        )
        return plan, by_stage

    def with_fewer_stages(self, trial: _Trial, division: Division) -> _Trial | None:
        """Return a trial of fewer stages, whose larger subimages have more virtual channels.

        This helps if the virtual channels are as dense as allowed. Otherwise return None: no other
        refinement is left.
        """
        fewer = tuple(n for n in trial.choices.stages if n < len(division.sides))
        if not fewer or _MOST_OVERSAMPLING not in trial.oversampling[:-1]:
            return None
        choices = replace(trial.choices, stages=fewer)
        return replace(trial, choices=choices, division=None, reserved=self.reserved)

    def more_accurate(
        self, trial: _Trial, spacing: tuple[float, ...], found: Plan
    ) -> _Trial | None:
        """Return a trial with a smaller error than a candidate that missed the tolerance.

        Denser virtual channels reduce the errors of uneven spacing and of a beam. More accurate
        filters make up for other errors.
        """
        allowed, last = self.allowed, found.sides[-1]
        share = _SPACING_SHARE * allowed / len(found.sides)
        excess = [max(of_stage - share, 0.0) for of_stage in spacing]
        beam_cycles = trial.beam_cycles
        if excess[-1] and beam_cycles > 0:
            aperture = found.factorization.aperture.filter
            stage = SpacedStage(last, aperture, trial.oversampling[-1], None)
            without_beam = self._spacing[found.sides[0]].of_stage(stage).uneven
            if 2 * without_beam < spacing[-1]:  # the beam causes most of it
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
            return replace(trial, least_leaf_pixels=2 * math.prod(last), division=None)
        if any(excess) and max(trial.oversampling) < _MOST_OVERSAMPLING:
            return replace(trial, oversampling=_denser(trial.oversampling, excess, share))
        too_much = power(-self.margin_db) * (power(found.predicted_error_db) - allowed)
        # Other errors fall together with those of filters, which keep at least half of their share.
        left = _MOST_SPENT * allowed - trial.reserved - self.root_error(found.sides[0])
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


# From a candidate to its plan


def predicted_plan(
    roots: SampledRoots,
    conditions: Conditions,
    errors: ErrorBudget,
    *,
    sides: tuple[Side, ...],
    tile: Side,
    align: Interpolator,
    final: Interpolator,
    aperture: InterpolatedAperture | NearestBeams,
    margin: float = 1.0,
) -> Plan:
    """Return the plan of a candidate, with its predicted error, time and memory.

    Parameters
    ----------
    roots : SampledRoots
        In the candidate's roots, if the aperture is interpolated.
    conditions : Conditions
    errors : ErrorBudget
        Errors other than those of range filters and of number formats.
    sides, tile, align, final, aperture
        Fields of `Factorization`.
    margin : float
        Factor of the predicted error power, for the scatter of measured errors.
    """
    sampled, scene = roots.sampled, roots.sampled.scene
    device, costs, width = conditions.device, conditions.costs, conditions.device.info.width
    lines = with_range_filters(roots, sides, align, final, aperture, errors)
    # On either side of a subimage's centre, lines are longer by half of the taps of later stages.
    samples_per_m = lines.resampling.samples_per_m(scene.lines) * (1 + max(roots.stretch.mean, 0.0))
    half_lengths = tuple(
        math.ceil(extent_m * samples_per_m) + (len(sides) - 1 - level) * align.reach + final.reach
        for level, extent_m in enumerate(half_range_extents_m(roots, sides))
    )
    levels = [Level.of(half, width) for half in half_lengths]
    channels = predicted_channels(roots, aperture, sides)
    singly = looked_up_singly(roots, sides[-1], final.taps, lines.resampling, device)
    # Each row of a sheet is read and written for about twice as many bands as it has taps.
    rounded_bands = 2 * aperture.filter.taps if aperture.dimensions == 2 else 0
    errors, phase_terms, half_precision = with_arithmetic(
        roots,
        conditions.allowed_db,
        lines,
        [stage.summed for stage in channels],
        rounded_bands,
        lines.upsampler is not None and device.info.half_precision and not singly,
    )
    work, stages = _work(
        roots, sides, align, final, aperture, lines, levels, channels, width, half_precision, singly
    )
    sizes = BufferSizes(
        roots=roots,
        width=width,
        sides=sides,
        tile=tile,
        pitches=tuple(level.pitch for level in levels),
        root_channels=tuple(math.ceil(each.everywhere) for each in channels),
        most_channels=tuple(math.ceil(_ROOM * each.most) for each in channels),
        bands=tuple(each.bands for each in channels),
        line_pitch=padded_length(lines.resampling),
        filtered=lines.upsampler is not None,
        half_precision=half_precision,
    )
    count = stages[0].subimages
    batches = batches_within(sizes, count, device, conditions.memory_bytes)
    # For each strip of a sector, a stage takes the host as long as a batch.
    sectors = 1 + max(count - batches.at_once, 0) // batches.prepared
    launched = -(-count // batches.at_once) + sectors * (sampled.track.strips - 1)
    work_in_all = sum(work, Work(call=1.0)) + Work(batch=float(launched * len(sides)))
    method = Factorization(
        sides=sides,
        tile=tile,
        aperture=aperture,
        align=align,
        final=final,
        resampling=lines.resampling,
        upsampler=lines.upsampler,
        half_precision=half_precision,
        half_lengths=half_lengths,
        most_channels=sizes.most_channels,
        highest_cycles_per_m=sampled.highest_cycles_per_m,
        closest_m=sampled.nearest_m,
        phase_terms=phase_terms,
        stretch=roots.stretch.mean if aperture.aligns_phases else 0.0,
        limits=roots.limits,
        roots_at_once=batches.at_once,
        roots_prepared=batches.prepared,
    )
    in_time = [
        replace(stage, seconds=float(costs.seconds(of_stage)))
        for stage, of_stage in zip(stages, work, strict=True)
    ]
    return _plan(
        scene, method, conditions, batches.memory_bytes, in_time, work_in_all, errors.times(margin)
    )


def exact_plan(scene: Scene, conditions: Conditions, reason: str) -> Plan:
    """Return the plan of the exact image; `reason` is that of `ExactImage`."""
    exact = conditions.exact
    method = ExactImage(accuracy_db=exact.accuracy_db, reason=reason)
    errors = ErrorBudget(exact=power(exact.accuracy_db))
    plan = _plan(scene, method, conditions, exact.memory_bytes, [], exact.work, errors)
    return replace(plan, prediction=replace(plan.prediction, error_db=exact.accuracy_db))


def _plan(
    scene: Scene,
    method: Factorization | ExactImage,
    conditions: Conditions,
    memory_bytes: int,
    stages: Sequence[StagePrediction],
    work: Work,
    errors: ErrorBudget,
) -> Plan:
    """Return the plan of an image, with its prediction."""
    costs = conditions.costs
    prediction = Prediction(
        error_db=errors.total_db,
        seconds=float(costs.seconds(work)),
        exact_seconds=float(costs.seconds(conditions.exact.work)),
        memory_bytes=memory_bytes,
        device=conditions.device.info.label,
        stages=tuple(stages),
        work=work,
        errors=errors,
    )
    return Plan(
        tolerance_db=None,  # the planner completes the plan that it chooses
        method=method,
        prediction=prediction,
        beam=scene.beam,
        lines_digest="",
        grid_digest="",
    )


def _work(
    roots: SampledRoots,
    sides: tuple[Side, ...],
    align: Interpolator,
    final: Interpolator,
    aperture: InterpolatedAperture | NearestBeams,
    lines: UpsampledLines,
    levels: Sequence[Level],
    channels: Sequence[StageChannels],
    width: int,
    half_precision: bool,
    singly: bool,
) -> tuple[list[Work], list[StagePrediction]]:
    """Return the work of every stage and of the leaves, and their descriptions, without times."""
    sampled, scene = roots.sampled, roots.sampled.scene
    work, stages = [], []
    for level, (side, predicted) in enumerate(zip(sides, channels, strict=True)):
        count, samples = sampled.count(side), levels[level].length
        combined = count * predicted.used
        taps = align.taps + aperture.filter.taps**aperture.dimensions
        of_stage = combining(
            combined, samples, taps, given=level == 0, half_precision=half_precision
        ) + Work(subimage=count)
        if aperture.dimensions == 2:
            rows = count * predicted.count
            of_stage += adding_in_rows(rows, levels[level].pitch, aperture.filter.taps)
        if level == 0:
            upsampled = scene.lines.channels * lines.resampling.length
            of_stage += Work(reference=count * references(roots))
            of_stage += upsampling(upsampled, filtered=lines.upsampler is not None)
        error = power(lines.align_db) + aperture.dimensions * power(aperture.filter.error_db)
        work.append(of_stage)
        operations = float(combined * samples)
        stages.append(
            StagePrediction(
                *side, count, round(predicted.count), samples, operations, in_db(error), 0.0
            )
        )
    leaf, virtual = sides[-1], channels[-1].count
    count, pixels = sampled.count(leaf), sampled.padded_pixels(leaf, width)
    tiled = scene.surface.is_plane
    of_leaves = backprojecting_leaves(
        count * virtual,
        pixels,
        final.taps,
        tiled=tiled,
        weighted=scene.beam is not None,
        gathered=not tiled and singly,
    )
    if not tiled:
        of_leaves += Work(group=count * pixels)
    work.append(of_leaves)
    operations = float(count * pixels * virtual)
    samples = levels[-1].length
    stages.append(
        StagePrediction(*leaf, count, round(virtual), samples, operations, final.scatter_db, 0.0)
    )
    return work, stages


# Numbers of virtual channels


@dataclass(frozen=True)
class StageChannels:
    """Predicted channels of a stage.

    Attributes
    ----------
    used : float
        Channels of the stage before that one subimage combines, on average.
    count : float
        Virtual channels of a subimage, on average.
    summed : float
        Channels whose weighted sum is one virtual channel.
    everywhere : float
        Upper bound on the virtual channels of a root along the whole aperture.
    most : float
        Upper bound on the virtual channels of a subimage.
    bands : int
        Upper bound on the bands of the stage's channels; see
        `clsas.engine.factorized.virtual_channels.Bands`.
    """

    used: float
    count: float
    summed: float
    everywhere: float
    most: float
    bands: int = 1


def predicted_channels(
    roots: SampledRoots, aperture: InterpolatedAperture | NearestBeams, sides: Sequence[Side]
) -> list[StageChannels]:
    """Return the predicted channels of subimages, stage by stage."""
    if isinstance(aperture, NearestBeams):
        found, channels = [], roots.sampled.scene.lines.channels
        for factor in aperture.factors:
            used, channels = channels, math.ceil(channels / factor)
            found.append(StageChannels(used, channels, factor, channels, channels))
        return found
    if aperture.shape == "sheet":
        return _channels_on_sheet(roots, aperture, sides)
    return _channels_on_curves(roots, aperture, sides)


def _channels_on_curves(
    roots: SampledRoots, aperture: InterpolatedAperture, sides: Sequence[Side]
) -> list[StageChannels]:
    """Return the predicted channels on one curve or on strips."""
    scene, strips = roots.sampled.scene, roots.sampled.track.strips
    density, taps = 2 * aperture.filter.upsampling, aperture.filter.taps
    margin = 1.0 if scene.beam is None else 1 + BEAM_MARGIN  # for rectangles of leaves
    anywhere = np.ones_like(roots.visible(sides[0]))
    used = scene.lines.channels * roots.visible_share(sides[0])
    overhang = _Overhang()
    found: list[StageChannels] = []
    for level, (side, denser) in enumerate(zip(sides, aperture.oversampling, strict=True)):
        visible = roots.visible(side)
        if level:
            before = aperture.oversampling[level - 1]
            of_parent = before * roots.subimage_cycles(sides[level - 1], visible)
            used = min(found[-1].count, roots.virtual_channels(overhang.taps, density, of_parent))
        beam_cycles = aperture.beam_cycles * (level == len(sides) - 1)
        cycles = denser * roots.subimage_cycles(side, visible)
        cycles += beam_cycles * roots.beam_cycles(visible)
        overhang = overhang.after(density * cycles, taps)
        count = roots.virtual_channels(overhang.taps, density, cycles)
        everywhere, most = (
            density * denser * roots.subimage_cycles(side, where, most=True)
            + density * beam_cycles * roots.beam_cycles(where, most=True)
            + strips * (overhang.taps + 2)
            for where in (anywhere, visible)
        )
        found.append(
            StageChannels(used, count, taps * used / count, everywhere, most * margin, strips)
        )
    return found


def _channels_on_sheet(
    roots: SampledRoots, aperture: InterpolatedAperture, sides: Sequence[Side]
) -> list[StageChannels]:
    """Return the predicted channels on a sheet, where they form rows and columns."""
    scene = roots.sampled.scene
    density, taps = 2 * aperture.filter.upsampling, aperture.filter.taps
    margin = 1.0 if scene.beam is None else 1 + BEAM_MARGIN
    anywhere = np.ones_like(roots.visible(sides[0]))
    used = scene.lines.channels * roots.visible_share(sides[0])
    along = across = _Overhang()
    bands = 0
    found: list[StageChannels] = []
    for level, (side, denser) in enumerate(zip(sides, aperture.oversampling, strict=True)):
        visible = roots.visible(side)
        if level:
            before, parent = aperture.oversampling[level - 1], sides[level - 1]
            of_parent = before * roots.subimage_cycles(parent, visible)
            columns = roots.virtual_channels(along.taps, density, of_parent)
            used = min(found[-1].count, columns * roots.rows(parent, across.taps, density * before))
        beam_cycles = aperture.beam_cycles * (level == len(sides) - 1)
        cycles = denser * roots.subimage_cycles(side, visible)
        cycles += beam_cycles * roots.beam_cycles(visible)
        along = along.after(density * cycles, taps)
        densities = density * denser, density * beam_cycles
        across = across.after(roots.rows(side, 0, *densities), taps)
        rows = roots.rows(side, across.taps, *densities)
        most_rows = roots.rows(side, across.taps, *densities, most=True)
        count = rows * roots.virtual_channels(along.taps, density, cycles)
        everywhere, most = (
            densities[0] * roots.subimage_cycles(side, where, most=True)
            + densities[1] * roots.beam_cycles(where, most=True)
            + roots.sampled.track.strips * (along.taps + 2)
            for where in (anywhere, visible)
        )
        found.append(
            StageChannels(
                used=used,
                count=count,
                summed=taps**2 * used / count,
                everywhere=most_rows * everywhere,
                most=most_rows * most * margin,
                # Raw channels have a band for each row that may be the first of their rows. Those
                # of later stages have a band for each row of the stage before.
                bands=bands if level else math.ceil(most_rows) + 2,
            )
        )
        bands = math.ceil(most_rows) + 3
    return found


@dataclass(frozen=True)
class _Overhang:
    """Virtual channels past the ends of the aperture, where filters extend beyond it.

    Each stage interpolates the virtual channels that the stage before has past the ends, and needs
    further ones for that. Their number grows from stage to stage, as if filters had more taps.

    Attributes
    ----------
    between : float
        Virtual channels between the ends, in one dimension of the aperture.
    taps : float
        Taps of a single filter that would extend as far past the ends.
    """

    between: float = 1.0
    taps: float = 0.0

    def after(self, between: float, taps: int) -> _Overhang:
        """Return the overhang of the next stage, with `between` virtual channels."""
        # These are farther apart than those of this stage, so that fewer fill the same overhang.
        return _Overhang(between, taps + self.taps * min(between / max(self.between, 1e-9), 1.0))
