"""Plans of candidates, with their predicted time, error and memory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from clsas.core.decibels import in_db, power
from clsas.exact.tiles import STACK
from clsas.factorized.estimates import (
    ErrorBudget,
    Work,
    backprojecting_leaves,
    combining,
    upsampling,
)
from clsas.factorized.filters import UPSAMPLING_SHARE, Filters, edges_gain
from clsas.factorized.plan import CHUNK, LEAST_BATCH, Plan, Stage, grid_digest, lines_digest
from clsas.factorized.sector import OF_BEAM
from clsas.opencl import phases
from clsas.opencl.buffers import (
    GIVEN_BYTES,
    GUARD,
    VECTOR_ROOM,
    expansion_terms,
    padded_length,
    sample_bytes,
)
from clsas.opencl.device import Device
from clsas.planning.channels import peak_density
from clsas.planning.costs import Costs
from clsas.planning.errors import leaf_error
from clsas.planning.exact_image import Exact
from clsas.planning.visibility_model import VisibilityModel
from clsas.signal import interpolation
from clsas.signal.interpolation import PHASES

HALF_ROUNDING = 4e-8
"""Power of the error that rounding lines to half precision once adds: 2^-11/sqrt(6) rms."""
_ROOM = 1.06  # buffers hold so many times the largest predicted number of virtual channels
_ROUNDING_SHARE = 0.1  # of an image's error power, for half precision
_MOST_CHUNKS = 16  # in a sum that is rounded to half precision
MARGIN_DB = 1.0  # of predictions, for the scatter of measured errors
OUTSIDE = 0.1  # of the error power allowed may come from outside of the nominal band
_FEW_CHANNELS = 7.0, 30.0  # see a pixel where errors scatter much; with stepped weights
_CACHED_BYTES, _BATCH_BYTES = 16 << 20, 256 << 20  # of a batch, on CPUs and elsewhere
_MOST_TABLE_BYTES = 64 << 20
_ROOTS_PREPARED = 16  # together, so that arrays are few and large


def margin_db(view: VisibilityModel) -> float:
    """Return the margin of predicted errors, dB, which covers the scatter of measured ones.

    Errors scatter more where few channels see a pixel: they depend on how these happen to lie
    between virtual channels, and to a step of the beam. They also scatter more where the lines'
    power lies at few frequencies.
    """
    channels = view.lines.channels * view.visible_share((16, 16))
    few = _FEW_CHANNELS[view.beam is not None and view.beam.jumps]
    return MARGIN_DB + in_db(view.spectrum.scatter * (1 + few / max(channels, 1.0)))


@dataclass(frozen=True)
class Candidate:
    """A factorization that the planner considers; attributes as those of `Plan`."""

    sides: tuple[tuple[int, int], ...]
    filters: Filters
    nearest: tuple[int, ...] = ()
    crowding: tuple[float, ...] = ()
    beam_cycles: float = 0.0


def factorized(
    view: VisibilityModel,
    candidate: Candidate,
    other_errors: ErrorBudget,
    tolerance_db: float | None,
    exact: Exact,
    device: Device,
    costs: Costs,
    memory_bytes: int,
) -> Plan:
    """Return the plan of a candidate, with its predicted time, error and memory.

    `view` is that within its roots where the aperture is interpolated; `other_errors` are those
    that the filters do not account for.
    """
    lines, sides, nearest = view.lines, candidate.sides, candidate.nearest
    align, aperture, final = (
        candidate.filters.align,
        candidate.filters.aperture,
        candidate.filters.final,
    )
    errors = replace(other_errors, **_filter_errors(candidate))
    upsampler = None
    if not nearest:
        step = max(int(PHASES / align.upsampling), 1)
        gain = edges_gain(align, final, len(sides), PHASES / step)
        most_db = in_db(UPSAMPLING_SHARE * errors.total)
        upsampler = interpolation.upsampler(view.spectrum, step, gain, most_db)
    if upsampler is None:
        resampling = interpolation.resampling(lines.length, align, view.spectrum)
    else:
        resampling = upsampler.resampling(lines.length, align.taps // 2, view.spectrum)
        errors = replace(errors, upsampling=power(upsampler.error_db))
    halves = view.half_lengths(sides, align, final, resampling)
    of_aperture = aperture.taps, 2 * aperture.upsampling
    stages, channels, reach, work = [], float(lines.channels), [], Work(call=1.0)
    width = device.info.width
    used = channels * view.visible_share(sides[0])
    for level, side in enumerate(sides):
        count = view.subimages(side)
        samples = -(-(2 * halves[level] + 1) // width) * width
        seen = view.visible(side)
        if nearest:
            used, channels = channels, math.ceil(channels / nearest[level])
        else:
            if level:
                turns = candidate.crowding[level - 1] * view.subimage_phase_cycles(
                    sides[level - 1], seen
                )
                used = min(channels, view.virtual_channels(*of_aperture, turns))
            turns = candidate.crowding[level] * view.subimage_phase_cycles(side, seen)
            if view.beam is not None and level == len(sides) - 1:
                turns += candidate.beam_cycles * view.visible_phase_cycles(view.beam_rates, seen)
            channels = view.virtual_channels(*of_aperture, turns)
            reach.append(aperture.taps * used / channels)
        taps = align.taps + aperture.taps
        of_stage = combining(count * used, samples, taps, given=level == 0)
        of_stage += Work(subimage=count)
        if not level:
            of_stage += Work(reference=count * lines.channels)
            upsampled = lines.channels * resampling.length
            of_stage += upsampling(upsampled, filtered=upsampler is not None)
        work += of_stage
        operations, error_db = count * used * samples, in_db(_power_of_stage(candidate))
        seconds = costs.seconds(of_stage)
        stages.append(Stage(*side, count, round(channels), samples, operations, error_db, seconds))
    tiled, pixels = view.surface.is_plane, view.padded_pixels(side, width)
    operations = count * pixels * channels
    of_leaves = backprojecting_leaves(
        count * channels, pixels, final.taps, tiled=tiled, weighted=view.beam is not None
    )
    if not tiled:
        of_leaves += Work(group=count * pixels)
    work += of_leaves
    error_db, seconds = final.scatter_db, costs.seconds(of_leaves)
    stages.append(Stage(*side, count, round(channels), samples, operations, error_db, seconds))
    tile = _tile(view, sides[-1], device) if nearest else sides[-1]
    if tolerance_db is not None:
        of_phases = phases.error(phases.terms_within(tolerance_db)) ** 2
        errors = replace(errors, phases=of_phases)
    half_precision = False
    if upsampler is not None and tolerance_db is not None and device.info.half_precision:
        rounding = _half_rounding(view, reach)
        half_precision = rounding <= _ROUNDING_SHARE * power(tolerance_db)
        errors = replace(errors, half_precision=rounding if half_precision else 0.0)
    line_bytes = sample_bytes(half_precision) * lines.channels * padded_length(resampling)
    if upsampler is not None:
        line_bytes += min(lines.samples.nbytes, GIVEN_BYTES)
    most_channels = _most_channels(view, candidate, stages)
    root_bytes, table_bytes = _root_bytes(
        view, candidate, tile, stages, most_channels, width, sample_bytes(half_precision)
    )
    room = memory_bytes - line_bytes
    batch_bytes = _CACHED_BYTES if device.info.kind == "cpu" else _BATCH_BYTES
    # Tables come in two sets.
    at_once = max(batch_bytes // root_bytes, LEAST_BATCH)
    at_once = int(min(room // (root_bytes + 2 * table_bytes), at_once))
    at_once = min(max(at_once, 1), stages[0].subimages)
    room = min(room - at_once * root_bytes, _MOST_TABLE_BYTES)
    of_batch = 2 * at_once * table_bytes
    prepared = at_once * min(max(int(room // of_batch), 1), -(-_ROOTS_PREPARED // at_once))
    batches = -(-stages[0].subimages // at_once)
    work += Work(batch=float(batches * len(sides)))
    if not nearest:
        errors = errors.times(power(margin_db(view)))
    return Plan(
        tolerance_db=tolerance_db,
        sides=sides,
        tile=tile,
        nearest=nearest,
        align=align,
        aperture=aperture,
        final=final,
        resampling=resampling,
        upsampler=upsampler,
        half_precision=half_precision,
        half_lengths=halves,
        highest_cycles_per_m=view.highest_cycles_per_m,
        closest_m=view.nearest_m,
        roots_at_once=at_once,
        roots_prepared=prepared,
        stages=tuple(stages),
        predicted_error_db=errors.total_db,
        predicted_seconds=float(costs.seconds(work)),
        exact_seconds=float(costs.seconds(exact.work)),
        memory_bytes=int(line_bytes + at_once * root_bytes + 2 * prepared * table_bytes),
        device=device.info.label,
        lines_digest=lines_digest(lines),
        grid_digest=grid_digest(view.grid),
        beam=view.beam,
        limits=view.limits,
        crowding=candidate.crowding,
        beam_cycles=candidate.beam_cycles,
        most_channels=tuple(math.ceil(most) for _, most in most_channels),
        band=None if nearest else _band(view, OUTSIDE * power(tolerance_db)),
        work=work,
        errors=errors,
    )


def _band(view: VisibilityModel, outside: float) -> tuple[float, float]:
    """Return the centre and half width of the band that holds all but a share of the power."""
    spectrum = view.spectrum
    bins = np.searchsorted(np.cumsum(spectrum.share), 1 - outside)
    return spectrum.centre, float(min((bins + 1) / (2 * len(spectrum.power)), 0.5))


def half_precision_error(stages: int) -> float:
    """Return the least error power that half precision adds through some stages.

    It is more where virtual channels are sums of many: see `_half_rounding`.
    """
    return HALF_ROUNDING * (1 + 1.5 * stages)


def _half_rounding(view: VisibilityModel, reach: Sequence[float]) -> float:
    """Return the power of the error that rounding lines to half precision adds.

    `reach` is the number of channels that a virtual one sums, stage by stage. Rounded are the
    upsampled lines, and the lines that a stage hands on: the latter once per chunk of channels,
    while the sum still grows, which counts as half. A sum of very many chunks loses what is added.
    """
    chunks = np.array(reach) / CHUNK
    chunks[0] *= peak_density(view)
    if chunks.max() > _MOST_CHUNKS:
        return np.inf
    return HALF_ROUNDING * (1 + float(np.sum(1 + chunks / 2)))


def _power_of_stage(candidate: Candidate) -> float:
    """Return the power of the errors that the filters of one stage add."""
    if candidate.nearest:
        return power(candidate.filters.align.error_db)
    return power(candidate.filters.align.scatter_db) + power(candidate.filters.aperture.error_db)


def _filter_errors(candidate: Candidate) -> dict[str, float]:
    """Return the errors that all filters add, by their names in the budget."""
    align, aperture, final = (
        candidate.filters.align,
        candidate.filters.aperture,
        candidate.filters.final,
    )
    stages, last = len(candidate.sides), power(final.scatter_db)
    if candidate.nearest:
        return {"range_filters": stages * power(align.error_db) + last}
    return {
        "range_filters": stages * power(align.scatter_db) + last,
        "aperture_filters": stages * power(aperture.error_db),
    }


def _most_channels(
    view: VisibilityModel, candidate: Candidate, stages: Sequence[Stage]
) -> list[tuple[float, float]]:
    """Return the virtual channels of the whole aperture, and the most of a subimage, by stage.

    The latter includes spare room, since buffers are allocated once.
    """
    if candidate.nearest:
        return [(stage.channels, _ROOM * stage.channels) for stage in stages[:-1]]
    taps, density, found = (
        candidate.filters.aperture.taps,
        2 * candidate.filters.aperture.upsampling,
        [],
    )
    for level, side in enumerate(candidate.sides):
        seen = view.visible(side)
        everywhere, most = (
            density * candidate.crowding[level] * view.subimage_phase_cycles(side, where, most=True)
            + taps
            + 2
            for where in (np.ones_like(seen), seen)
        )
        if view.beam is not None:
            if level == len(candidate.sides) - 1:
                most += (
                    density
                    * candidate.beam_cycles
                    * view.visible_phase_cycles(view.beam_rates, seen, most=True)
                )
            most *= 1 + OF_BEAM
        found.append((everywhere, _ROOM * most))
    return found


def _root_bytes(
    view: VisibilityModel,
    candidate: Candidate,
    tile: tuple[int, int],
    stages: Sequence[Stage],
    most_channels: Sequence[tuple[float, float]],
    width: int,
    of_sample: int,
) -> tuple[float, float]:
    """Return the device memory of a root at work, and of its tables, bytes.

    See `factorize` and `leaves`.
    """
    channels, work, tables, sides = view.lines.channels, 0.0, 0.0, candidate.sides
    for level, (everywhere, most) in enumerate(most_channels):
        side = sides[level]
        subimages = _subimages(sides[0], side)
        work += of_sample * subimages * most * (stages[level].samples + 2 * GUARD)
        tables += subimages * (44 if level else 20) + (channels + 32) * (8 + (12 if level else 20))
        channels = everywhere
    normalise = view.beam is not None and view.beam.normalise
    tables += 40 * channels
    if view.surface.is_plane:
        terms = expansion_terms(view.beam)
        parts, slots = _subimages(sides[0], tile), math.prod(sides[0])
        references = 0 if tile == sides[-1] else 12
        work += parts * ((most + VECTOR_ROOM) * (references + 4 * terms) + 24)
    else:
        slots = view.most_padded_pixels(sides[-1], sides[0], width)
        parts = slots / (STACK * width)
        tables += 24 * parts + 12 * slots
    return work + 8 * (1 + normalise) * slots, tables + 12 * parts


def _subimages(root: tuple[int, int], side: tuple[int, int]) -> int:
    return math.prod(a // b for a, b in zip(root, side, strict=True))


def _tile(view: VisibilityModel, leaf: tuple[int, int], device: Device) -> tuple[int, int]:
    """Return the largest tiles of a leaf that may be expanded about their centres."""
    parts = [
        (rows, columns)
        for rows in range(16, min(leaf[0], 64) + 1, 16)
        for columns in range(4, min(leaf[1], 64) + 1, 4)
        if leaf[0] % rows == 0 and leaf[1] % columns == 0
    ]
    fit = [part for part in parts if leaf_error(view, np.array([part]), device)[0] < 1e-8]
    return max(fit or parts[:1], key=math.prod)


def plain(
    view: VisibilityModel, tolerance_db: float | None, exact: Exact, device: Device, costs: Costs
) -> Plan:
    """Return the plan of an exact image."""
    seconds = float(costs.seconds(exact.work))
    return Plan(
        tolerance_db=tolerance_db,
        sides=(),
        tile=(0, 0),
        nearest=(),
        align=None,
        aperture=None,
        final=None,
        resampling=None,
        upsampler=None,
        half_precision=False,
        half_lengths=(),
        highest_cycles_per_m=view.highest_cycles_per_m,
        closest_m=0.0,
        roots_at_once=1,
        roots_prepared=1,
        stages=(),
        predicted_error_db=exact.accuracy_db,
        accuracy_db=exact.accuracy_db,
        predicted_seconds=seconds,
        exact_seconds=seconds,
        memory_bytes=exact.memory_bytes,
        device=device.info.label,
        lines_digest=lines_digest(view.lines),
        grid_digest=grid_digest(view.grid),
        beam=view.beam,
        limits=view.limits,
        work=exact.work,
        errors=ErrorBudget(exact=power(exact.accuracy_db)),
    )
