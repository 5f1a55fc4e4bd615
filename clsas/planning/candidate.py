"""Candidates for a plan, and how their lines are upsampled."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from clsas.aperture.filters import LONGEST_UPSAMPLING_SHARE, UPSAMPLING_SHARE
from clsas.aperture.interpolated import InterpolatedAperture
from clsas.aperture.nearest import NearestBeams
from clsas.core.decibels import in_db, power
from clsas.exact.lookup import lookup_room
from clsas.opencl.device import Device
from clsas.planning.channels import range_window_m
from clsas.planning.stretches import uncompensated
from clsas.planning.visibility_model import VisibilityModel
from clsas.plans.predictions import ErrorBudget
from clsas.signal import interpolation
from clsas.signal.interpolation import PHASES, Interpolator, Resampling, Upsampler


@dataclass(frozen=True, eq=False)
class Candidate:
    """A factorization that the planner considers.

    Attributes
    ----------
    sides, tile, align, final, aperture
        Fields of `clsas.plans.factorization.Factorization`.
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
class UpsampledLines:
    """How lines are upsampled, with the errors of their filters.

    Attributes
    ----------
    upsampler, resampling
        Fields of `Factorization`.
    align_db : float
        Error of one interpolation between upsampled samples.
    errors : ErrorBudget
        Errors of all range filters, and those found before.
    """

    upsampler: Upsampler | None
    resampling: Resampling
    align_db: float
    errors: ErrorBudget


def upsampling_of(
    model: VisibilityModel, candidate: Candidate, other_errors: ErrorBudget
) -> UpsampledLines:
    """Return how the lines of a candidate are upsampled, with the errors of all range filters."""
    lines = _whole_lines(model, candidate, other_errors)
    return _trimmed(model, candidate, lines) if model.track.is_dense else lines


def _whole_lines(
    model: VisibilityModel, candidate: Candidate, other_errors: ErrorBudget
) -> UpsampledLines:
    """Return how whole lines are upsampled.

    A gain that corrects the attenuation of the range filters leaves only their scatter.
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
        allowed_db, most_db = (
            in_db(share * errors.total) for share in (UPSAMPLING_SHARE, LONGEST_UPSAMPLING_SHARE)
        )
        upsampler = interpolation.upsampler(model.spectrum, step, gain, allowed_db, most_db)
        if upsampler is not None:
            resampling = upsampler.resampling(samples, align.taps // 2, model.spectrum)
            errors = replace(errors, upsampling=power(upsampler.error_db))
            return UpsampledLines(upsampler, resampling, align_db, errors)
    resampling = interpolation.resampling(samples, align, model.spectrum)
    return UpsampledLines(None, resampling, align_db, errors)


def _trimmed(model: VisibilityModel, candidate: Candidate, lines: UpsampledLines) -> UpsampledLines:
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
    # The filters' phases repeat every PHASES samples, where a line must begin.
    first -= first % PHASES
    if last - first < 1 or candidate.aperture.method != "interpolated":
        return lines
    window = replace(resampling, first=resampling.first + first, length=last - first)
    return replace(lines, resampling=window)


def looked_up_singly(
    model: VisibilityModel, candidate: Candidate, lines: UpsampledLines, device: Device
) -> bool:
    """Return whether leaves of points are too thick to look samples up in registers.

    CPUs convert single samples of half precision ten times more slowly than whole registers.
    """
    if model.grid.points_m is None or device.info.width == 1:
        return False
    room = lookup_room(2, candidate.final.taps, device.info.width)
    thickness_m = float(model.surface.relief_m(candidate.sides[-1]).max())
    return thickness_m / 2 * lines.resampling.samples_per_m(model.lines) > room
