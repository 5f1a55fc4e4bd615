"""Plans of candidates, with their predicted error, time and memory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from clsas.aperture.predicted_channels import StageChannels
from clsas.core.decibels import in_db, power
from clsas.factorized.buffers import CHUNK, Level
from clsas.opencl import phases
from clsas.opencl.buffers import padded_length
from clsas.opencl.device import Device
from clsas.planning.aperture_phases import AperturePhases
from clsas.planning.candidate import (
    Candidate,
    UpsampledLines,
    looked_up_singly,
    upsampling_of,
)
from clsas.planning.channels import peak_density, references
from clsas.planning.costs import Costs
from clsas.planning.exact_image import Exact
from clsas.planning.memory import BufferSizes, batches_within
from clsas.planning.range_extents import half_line_lengths
from clsas.planning.stretches import stretch_of
from clsas.planning.visibility_model import VisibilityModel
from clsas.planning.work import adding_in_rows, backprojecting_leaves, combining, upsampling
from clsas.plans.factorization import ExactImage, Factorization
from clsas.plans.plan import Plan
from clsas.plans.predictions import ErrorBudget, Prediction, Stage, Work
from clsas.scene import Scene

HALF_ROUNDING = 4e-8
"""Power of the error that rounding lines to half precision once adds: 2^-11/sqrt(6) rms."""
MARGIN_DB = 1.0
"""Margin of predicted errors, for the scatter of measured ones."""
_ROUNDING_SHARE = 0.1  # of an image's error power, for half precision; half or twice: no change
_MOST_CHUNKS = 16  # in a sum in half precision; in longer sums, addends vanish by rounding
_FEW_CHANNELS = 7.0, 30.0  # per pixel, that double the scatter of errors; second: beams with steps
_ROOM = 1.06  # size of buffers over the predicted virtual channels; with 1.12: 2 % slower


@dataclass(frozen=True)
class Conditions:
    """Requirements of a plan, and the exact image that it competes with.

    Attributes
    ----------
    tolerance_db : float or None
        None if stages were given.
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


def predicted_plan(
    model: VisibilityModel, candidate: Candidate, other_errors: ErrorBudget, conditions: Conditions
) -> Plan:
    """Return the plan of a candidate, with its predicted error, time and memory.

    Parameters
    ----------
    model : VisibilityModel
        With the candidate's root size, if the aperture is interpolated.
    candidate : Candidate
    other_errors : ErrorBudget
        Errors other than those of the range filters.
    conditions : Conditions
    """
    sides, device = candidate.sides, conditions.device
    lines = upsampling_of(model, candidate, other_errors)
    half_lengths = half_line_lengths(
        model, sides, candidate.align, candidate.final, lines.resampling
    )
    channels = candidate.aperture.predicted_channels(AperturePhases(model), sides)
    levels = [Level.of(half, device.info.width) for half in half_lengths]
    errors, phase_terms, half_precision = _with_arithmetic(
        model, candidate, lines, channels, conditions
    )
    forming = _Forming(model, candidate, lines, levels, channels, device, half_precision)
    parts = [*(forming.stage(level) for level in range(len(sides))), forming.leaves()]
    work = sum((part.work for part in parts), Work(call=1.0))
    stages = [part.predicted(conditions.costs) for part in parts]
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
        corrected=model.scene.water.corrections is not None,
        filtered=lines.upsampler is not None,
        half_precision=half_precision,
    )
    roots = stages[0].subimages
    batches = batches_within(sizes, roots, device, conditions.memory_bytes)
    # For each strip of a sector, a stage takes the host as long as a batch.
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
    return _plan(model.scene, image, conditions, batches.memory_bytes, stages, work, errors)


def exact_plan(scene: Scene, conditions: Conditions, reason: str) -> Plan:
    """Return the plan of the exact image; `reason` is that of `ExactImage`."""
    exact = conditions.exact
    image = ExactImage(accuracy_db=exact.accuracy_db, reason=reason)
    errors = ErrorBudget(exact=power(exact.accuracy_db))
    plan = _plan(scene, image, conditions, exact.memory_bytes, [], exact.work, errors)
    return replace(plan, prediction=replace(plan.prediction, error_db=exact.accuracy_db))


def margin_db(model: VisibilityModel) -> float:
    """Return the margin of predicted errors, dB, which covers the scatter of measured ones.

    Errors scatter more if a pixel receives from few channels, or if few channels have most of the
    power: they then depend on the positions of these channels between virtual ones, and relative to
    a step of the beam. They also scatter more if the lines' power lies at few frequencies.
    """
    power = model.channel_power
    channels = power.sum() ** 2 / (power @ power) * model.visible_share(model.small)
    few = _FEW_CHANNELS[model.beam is not None and model.beam.jumps]
    return MARGIN_DB + in_db(model.spectrum.scatter * (1 + few / max(channels, 1.0)))


def half_precision_error(stages: int) -> float:
    """Return the least error power that half precision adds through some stages.

    The error is larger if virtual channels are sums of many: see `_half_rounding`.
    """
    return HALF_ROUNDING * (1 + 1.5 * stages)


def _plan(
    scene: Scene,
    image: Factorization | ExactImage,
    conditions: Conditions,
    memory_bytes: int,
    stages: Sequence[Stage],
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
        tolerance_db=conditions.tolerance_db,
        method=image,
        prediction=prediction,
        beam=scene.beam,
        lines_digest="",  # the planner completes the plan that it chooses
        grid_digest="",
    )


@dataclass(frozen=True, eq=False)
class _Part:
    """Subimages of a stage or the leaves, and the work of forming them.

    Attributes
    ----------
    side, count, channels, samples, operations, error_db
        As those of `Stage`, without rounding.
    work : Work
    """

    side: tuple[int, int]
    count: int
    channels: float
    samples: int
    operations: float
    error_db: float
    work: Work

    def predicted(self, costs: Costs) -> Stage:
        """Return this part's prediction."""
        return Stage(
            *self.side,
            self.count,
            channels=round(self.channels),
            samples=self.samples,
            operations=float(self.operations),
            error_db=self.error_db,
            seconds=float(costs.seconds(self.work)),
        )


@dataclass(frozen=True, eq=False)
class _Forming:
    """A candidate with all that the work of forming its image depends on, [stages] each.

    Attributes
    ----------
    model, candidate, lines
    levels : sequence of Level
        Lengths of the lines.
    channels : sequence of StageChannels
    device : Device
    half_precision : bool
        True if stages hand on lines in half precision.
    """

    model: VisibilityModel
    candidate: Candidate
    lines: UpsampledLines
    levels: Sequence[Level]
    channels: Sequence[StageChannels]
    device: Device
    half_precision: bool

    def stage(self, level: int) -> _Part:
        """Return a stage: its channels are aligned and combined."""
        candidate, channels = self.candidate, self.channels[level]
        side = candidate.sides[level]
        aperture, dimensions = candidate.aperture.filter, candidate.aperture.dimensions
        count, samples = self.model.subimages.count(side), self.levels[level].length
        combined = count * channels.used
        taps = candidate.align.taps + aperture.taps**dimensions
        work = combining(
            combined, samples, taps, given=level == 0, half_precision=self.half_precision
        ) + Work(subimage=count)
        if dimensions == 2:
            work += adding_in_rows(count * channels.count, self.levels[level].pitch, aperture.taps)
        if level == 0:
            upsampled = self.model.lines.channels * self.lines.resampling.length
            work += Work(reference=count * references(self.model))
            work += upsampling(upsampled, filtered=self.lines.upsampler is not None)
        error_db = in_db(power(self.lines.align_db) + dimensions * power(aperture.error_db))
        operations = combined * samples
        return _Part(side, count, channels.count, samples, operations, error_db, work)

    def leaves(self) -> _Part:
        """Return the leaves: their virtual channels are backprojected to their pixels."""
        model, final, side = self.model, self.candidate.final, self.candidate.sides[-1]
        channels, samples = self.channels[-1].count, self.levels[-1].length
        count, pixels = (
            model.subimages.count(side),
            model.subimages.padded_pixels(side, self.device.info.width),
        )
        tiled = model.surface.is_plane
        work = backprojecting_leaves(
            count * channels,
            pixels,
            final.taps,
            tiled=tiled,
            weighted=model.beam is not None,
            gathered=not tiled and looked_up_singly(model, self.candidate, self.lines, self.device),
        )
        if not tiled:
            work += Work(group=count * pixels)
        operations = count * pixels * channels
        return _Part(side, count, channels, samples, operations, final.scatter_db, work)


def _with_arithmetic(
    model: VisibilityModel,
    candidate: Candidate,
    lines: UpsampledLines,
    channels: Sequence[StageChannels],
    conditions: Conditions,
) -> tuple[ErrorBudget, int, bool]:
    """Return the errors with those of polynomials and rounding.

    Return also the number of terms of the polynomials for sine and cosine, and whether stages store
    lines in half precision.
    """
    tolerance_db, errors = conditions.tolerance_db, lines.errors
    if tolerance_db is None:
        return errors, phases.terms_within(errors.total_db, phases.FACTORIZED_SHARE), False
    terms = phases.terms_within(tolerance_db, phases.FACTORIZED_SHARE)
    errors = replace(errors, phases=phases.error(terms) ** 2)
    if lines.upsampler is None or not conditions.device.info.half_precision:
        return errors, terms, False
    if looked_up_singly(model, candidate, lines, conditions.device):
        return errors, terms, False
    # Each row of a sheet is read and written for about twice as many bands as it has taps.
    bands = 2 * candidate.aperture.filter.taps if candidate.aperture.dimensions == 2 else 0
    rounding = _half_rounding(model, [stage.summed for stage in channels], bands)
    if rounding > _ROUNDING_SHARE * power(tolerance_db):
        return errors, terms, False
    return replace(errors, half_precision=rounding), terms, True


def _half_rounding(model: VisibilityModel, summed: Sequence[float], bands: int) -> float:
    """Return the error power of rounding lines to half precision.

    `summed` is the number of channels that a virtual one sums, stage by stage, and `bands` the
    number of bands that add to it one after another, in every stage of a sheet. Upsampled lines are
    rounded once. Lines of a stage are rounded once per chunk of channels, while the sum still
    grows; such a rounding counts half. In a sum of very many chunks, the last ones vanish by
    rounding, and the error is infinite.
    """
    chunks = np.array(summed) / CHUNK
    chunks[0] *= peak_density(model)
    if chunks.max() > _MOST_CHUNKS:
        return np.inf
    return HALF_ROUNDING * (1 + float(np.sum(1 + (chunks + bands) / 2)))
