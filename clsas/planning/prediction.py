"""Plans of candidates, with their predicted error, time and memory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from clsas.aperture.filters import LONGEST_UPSAMPLING_SHARE, UPSAMPLING_SHARE
from clsas.aperture.interpolated import InterpolatedAperture
from clsas.aperture.nearest import NearestBeams
from clsas.aperture.predicted_channels import StageChannels
from clsas.core.decibels import in_db, power
from clsas.core.digests import grid_digest, lines_digest
from clsas.exact.lookup import lookup_room
from clsas.factorized.buffers import CHUNK, Level
from clsas.opencl import phases
from clsas.opencl.buffers import padded_length
from clsas.opencl.device import Device
from clsas.planning.aperture_phases import AperturePhases
from clsas.planning.channels import peak_density, range_window_m, references
from clsas.planning.costs import Costs
from clsas.planning.exact_image import Exact
from clsas.planning.memory import BufferSizes, batches_within
from clsas.planning.range_extents import half_line_lengths
from clsas.planning.stretches import stretch_of, uncompensated
from clsas.planning.visibility_model import VisibilityModel
from clsas.planning.work import adding_in_rows, backprojecting_leaves, combining, upsampling
from clsas.plans.factorization import ExactImage, Factorization
from clsas.plans.plan import Plan
from clsas.plans.predictions import ErrorBudget, Prediction, Stage, Work
from clsas.signal import interpolation
from clsas.signal.interpolation import PHASES, Interpolator, Resampling, Upsampler

HALF_ROUNDING = 4e-8
"""Power of the error that rounding lines to half precision once adds: 2^-11/sqrt(6) rms."""
MARGIN_DB = 1.0
"""Margin of predicted errors for the scatter of measured ones."""
_ROUNDING_SHARE = 0.1  # of an image's error power, for half precision; half or twice: the same
_MOST_CHUNKS = 16  # in a sum rounded to half precision; more lose what is added
_FEW_CHANNELS = 7.0, 30.0  # per pixel, that double the scatter of errors; the latter with steps
_ROOM = 1.06  # of buffers, over the predicted virtual channels; twice the spare room: 2 % slower


@dataclass(frozen=True)
class Conditions:
    """Requirements of a plan, and the exact image that it competes with.

    Attributes
    ----------
    tolerance_db : float or None
        None where stages were given.
    exact : Exact
    device : Device
    costs : Costs
    memory_bytes : int
        Device memory that may be used.
    """

    tolerance_db: float | None
    exact: Exact
    device: Device
    costs: Costs
    memory_bytes: int


@dataclass(frozen=True, eq=False)
class Candidate:
    """A factorization that the planner considers.

    Attributes
    ----------
    sides, tile, align, final, aperture
        As those of `clsas.plans.plan.Factorization`.
    margin : float
        Factor of the predicted error power, for the scatter of measured errors.
    """

    sides: tuple[tuple[int, int], ...]
    tile: tuple[int, int]
    align: Interpolator
    final: Interpolator
    aperture: InterpolatedAperture | NearestBeams
    margin: float = 1.0


@dataclass(frozen=True, eq=False)
class _Lines:
    """Upsampled lines.

    Attributes
    ----------
    upsampler, resampling
        As those of `Factorization`.
    align_db : float
        Error of an interpolation between their samples.
    errors : ErrorBudget
        Contributions of all filters, and those given.
    """

    upsampler: Upsampler | None
    resampling: Resampling
    align_db: float
    errors: ErrorBudget


def predicted_plan(
    model: VisibilityModel, candidate: Candidate, other_errors: ErrorBudget, conditions: Conditions
) -> Plan:
    """Return the plan of a candidate, with its predicted error, time and memory.

    Parameters
    ----------
    model : VisibilityModel
        That within the candidate's roots, where the aperture is interpolated.
    candidate : Candidate
    other_errors : ErrorBudget
        Contributions of all but the range filters.
    conditions : Conditions
    """
    sides, device = candidate.sides, conditions.device
    lines = _upsampled(model, candidate, other_errors)
    if model.track is not None and model.track.is_dense:
        lines = _trimmed(model, candidate, lines)
    half_lengths = half_line_lengths(
        model, sides, candidate.align, candidate.final, lines.resampling
    )
    channels = candidate.aperture.predicted_channels(AperturePhases(model), sides)
    levels = [Level.of(half, device.info.width) for half in half_lengths]
    errors, phase_terms, half_precision = _with_arithmetic(
        model, candidate, lines, channels, conditions
    )
    stages, work = _stages(
        model, candidate, lines, levels, channels, conditions, half_precision=half_precision
    )
    sizes = BufferSizes(
        model=model,
        width=device.info.width,
        sides=sides,
        tile=candidate.tile,
        pitches=tuple(level.pitch for level in levels),
        root_channels=tuple(math.ceil(each.everywhere) for each in channels),
        most_channels=tuple(math.ceil(_ROOM * each.most) for each in channels),
        bands=tuple(each.bands for each in channels),
        line_pitch=padded_length(lines.resampling),
        filtered=lines.upsampler is not None,
        half_precision=half_precision,
    )
    roots = stages[0].subimages
    batches = batches_within(sizes, roots, device, conditions.memory_bytes)
    # A stage of a sector takes the host as long for each strip as a batch does.
    sectors = 1 + max(roots - batches.at_once, 0) // batches.prepared
    launched = -(-roots // batches.at_once) + sectors * (model.track.strips - 1)
    work += Work(batch=float(launched * len(sides)))
    errors = errors.times(candidate.margin)
    image = Factorization(
        sides=sides,
        tile=candidate.tile,
        aperture=candidate.aperture,
        align=candidate.align,
        final=candidate.final,
        resampling=lines.resampling,
        upsampler=lines.upsampler,
        half_precision=half_precision,
        half_lengths=half_lengths,
        most_channels=sizes.most_channels,
        highest_cycles_per_m=model.highest_cycles_per_m,
        closest_m=model.nearest_m,
        phase_terms=phase_terms,
        stretch=stretch_of(model).mean if candidate.aperture.aligns_phases else 0.0,
        limits=model.limits,
        roots_at_once=batches.at_once,
        roots_prepared=batches.prepared,
    )
    return _plan(model, image, conditions, batches.memory_bytes, stages, work, errors)


def exact_plan(model: VisibilityModel, conditions: Conditions, reason: str) -> Plan:
    """Return the plan of the exact image; see `ExactImage` for the reason."""
    exact = conditions.exact
    image = ExactImage(accuracy_db=exact.accuracy_db, reason=reason)
    errors = ErrorBudget(exact=power(exact.accuracy_db))
    plan = _plan(model, image, conditions, exact.memory_bytes, [], exact.work, errors)
    return replace(plan, prediction=replace(plan.prediction, error_db=exact.accuracy_db))


def margin_db(model: VisibilityModel) -> float:
    """Return the margin of predicted errors, dB, which covers the scatter of measured ones.

    Errors scatter more if few channels see a pixel, or a few hold most of the power: they depend on
    the positions of these between virtual channels, and relative to a step of the beam. They also
    scatter more if the lines' power lies at few frequencies.
    """
    power = model.channel_power
    channels = power.sum() ** 2 / (power @ power) * model.visible_share(model.small)
    few = _FEW_CHANNELS[model.beam is not None and model.beam.jumps]
    return MARGIN_DB + in_db(model.spectrum.scatter * (1 + few / max(channels, 1.0)))


def half_precision_error(stages: int) -> float:
    """Return the least error power that half precision adds through some stages.

    It is more if virtual channels are sums of many: see `_half_rounding`.
    """
    return HALF_ROUNDING * (1 + 1.5 * stages)


def _plan(
    model: VisibilityModel,
    image: Factorization | ExactImage,
    conditions: Conditions,
    memory_bytes: int,
    stages: Sequence[Stage],
    work: Work,
    errors: ErrorBudget,
) -> Plan:
    """Return an image with its prediction."""
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
        tolerance_db=conditions.tolerance_db,
        method=image,
        prediction=prediction,
        beam=model.beam,
        lines_digest=model.from_cache("lines", lambda: lines_digest(model.lines)),
        grid_digest=model.from_cache("grid", lambda: grid_digest(model.grid)),
    )


def _upsampled(model: VisibilityModel, candidate: Candidate, other_errors: ErrorBudget) -> _Lines:
    """Return how lines are upsampled, and the errors of all filters.

    A gain that makes up for the range filters' attenuation leaves only their scatter.
    """
    align, final, aperture = candidate.align, candidate.final, candidate.aperture
    stages, samples = len(candidate.sides), model.lines.length
    step = max(int(PHASES / align.upsampling), 1)
    gain = aperture.lines_gain(align, final, PHASES / step)
    align_db = align.error_db if gain is None else align.scatter_db
    in_range = stages * power(align_db) + power(final.scatter_db)
    if gain is not None:
        in_range += uncompensated(model, align, final, stages, PHASES / step, gain)
    errors = replace(other_errors, range_filters=in_range)
    if gain is not None:
        wanted_db, most_db = (
            in_db(share * errors.total) for share in (UPSAMPLING_SHARE, LONGEST_UPSAMPLING_SHARE)
        )
        upsampler = interpolation.upsampler(model.spectrum, step, gain, wanted_db, most_db)
        if upsampler is not None:
            resampling = upsampler.resampling(samples, align.taps // 2, model.spectrum)
            errors = replace(errors, upsampling=power(upsampler.error_db))
            return _Lines(upsampler, resampling, align_db, errors)
    resampling = interpolation.resampling(samples, align, model.spectrum)
    return _Lines(None, resampling, align_db, errors)


def _trimmed(model: VisibilityModel, candidate: Candidate, lines: _Lines) -> _Lines:
    """Return upsampled lines without the samples that no pixel needs.

    Dense apertures have so many channels that upsampling whole lines takes most of the time.
    """
    resampling = lines.resampling
    low_m, high_m = range_window_m(model, candidate.sides[0])
    step_m = model.lines.range_step_m
    spare = len(candidate.sides) * (candidate.align.taps // 2 + 1) + candidate.final.taps + 2
    first, last = (
        math.floor((each_m / step_m + resampling.lead) * resampling.ratio) - resampling.first
        for each_m in (low_m, high_m)
    )
    first, last = max(first - spare, 0), min(last + 1 + spare, resampling.length)
    # Whole turns of the filters' phases, and a line at least.
    first -= first % PHASES
    if last - first < 1 or candidate.aperture.method != "interpolated":
        return lines
    window = replace(resampling, first=resampling.first + first, length=last - first)
    return replace(lines, resampling=window)


def _stages(
    model: VisibilityModel,
    candidate: Candidate,
    lines: _Lines,
    levels: Sequence[Level],
    channels: Sequence[StageChannels],
    conditions: Conditions,
    *,
    half_precision: bool,
) -> tuple[list[Stage], Work]:
    """Return the prediction of every stage and of the leaves, and the work of all."""
    device, costs = conditions.device, conditions.costs
    width, aperture = device.info.width, candidate.aperture.filter
    dimensions = candidate.aperture.dimensions
    taps = candidate.align.taps + aperture.taps**dimensions
    error_db = in_db(power(lines.align_db) + dimensions * power(aperture.error_db))
    stages, total = [], Work(call=1.0)

    def add(side: tuple[int, int], count: int, samples: int, work: Work, **figures: Any) -> None:
        nonlocal total
        total += work
        rows, columns = side
        seconds = float(costs.seconds(work))
        stages.append(Stage(rows, columns, count, samples=samples, seconds=seconds, **figures))

    for level, (side, of_stage) in enumerate(zip(candidate.sides, channels, strict=True)):
        count = model.subimages.count(side)
        samples = levels[level].length
        combined = count * of_stage.used
        work = combining(
            combined, samples, taps, given=level == 0, half_precision=half_precision
        ) + Work(subimage=count)
        if dimensions == 2:
            work += adding_in_rows(count * of_stage.count, levels[level].pitch, aperture.taps)
        if level == 0:
            upsampled = model.lines.channels * lines.resampling.length
            work += Work(reference=count * references(model))
            work += upsampling(upsampled, filtered=lines.upsampler is not None)
        add(
            side,
            count,
            samples,
            work,
            channels=round(of_stage.count),
            operations=float(combined * samples),
            error_db=error_db,
        )
    pixels, backprojected = model.subimages.padded_pixels(side, width), count * of_stage.count
    tiled, weighted = model.surface.is_plane, model.beam is not None
    taps = candidate.final.taps
    gathered = not tiled and _looked_up_singly(model, candidate, lines, device)
    work = backprojecting_leaves(
        backprojected, pixels, taps, tiled=tiled, weighted=weighted, gathered=gathered
    )
    if not tiled:
        work += Work(group=count * pixels)
    add(
        side,
        count,
        samples,
        work,
        channels=round(of_stage.count),
        operations=float(count * pixels * of_stage.count),
        error_db=candidate.final.scatter_db,
    )
    return stages, total


def _with_arithmetic(
    model: VisibilityModel,
    candidate: Candidate,
    lines: _Lines,
    channels: Sequence[StageChannels],
    conditions: Conditions,
) -> tuple[ErrorBudget, int, bool]:
    """Add the errors of polynomials and rounding.

    Return also how many terms polynomials have, and whether lines have half precision.
    """
    tolerance_db, errors = conditions.tolerance_db, lines.errors
    if tolerance_db is None:
        return errors, phases.terms_within(errors.total_db, phases.FACTORIZED_SHARE), False
    terms = phases.terms_within(tolerance_db, phases.FACTORIZED_SHARE)
    errors = replace(errors, phases=phases.error(terms) ** 2)
    if lines.upsampler is None or not conditions.device.info.half_precision:
        return errors, terms, False
    if _looked_up_singly(model, candidate, lines, conditions.device):
        return errors, terms, False
    # Each row of a sheet is read and written for about twice as many bands as it has taps.
    bands = 2 * candidate.aperture.filter.taps if candidate.aperture.dimensions == 2 else 0
    rounding = _half_rounding(model, [stage.summed for stage in channels], bands)
    if rounding > _ROUNDING_SHARE * power(tolerance_db):
        return errors, terms, False
    return replace(errors, half_precision=rounding), terms, True


def _looked_up_singly(
    model: VisibilityModel, candidate: Candidate, lines: _Lines, device: Device
) -> bool:
    """Return whether leaves of points are too thick to look samples up in a register.

    CPUs convert single samples of half precision ten times slower than whole registers.
    """
    if model.grid.points_m is None or device.info.width == 1:
        return False
    room = lookup_room(2, candidate.final.taps, device.info.width)
    thickness_m = float(model.surface.relief_m(candidate.sides[-1]).max())
    return thickness_m / 2 * lines.resampling.samples_per_m(model.lines) > room


def _half_rounding(model: VisibilityModel, summed: Sequence[float], bands: int) -> float:
    """Return the error power of rounding lines to half precision.

    `summed` is the number of channels that a virtual one sums, stage by stage, and `bands` that of
    the bands that add to it one after another, in every stage of a sheet. Upsampled lines are
    rounded once. Lines of a stage are rounded once per chunk of channels, while the sum still
    grows, which counts as half. A sum of very many chunks loses what is added last.
    """
    chunks = np.array(summed) / CHUNK
    chunks[0] *= peak_density(model)
    if chunks.max() > _MOST_CHUNKS:
        return np.inf
    return HALF_ROUNDING * (1 + float(np.sum(1 + (chunks + bands) / 2)))
