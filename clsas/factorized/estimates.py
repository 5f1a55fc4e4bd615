"""Predictions of an image before it is formed: its work, its channels and its errors."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from clsas.core.decibels import in_db
from clsas.signal.interpolation import COST

Amount: TypeAlias = float | NDArray[np.float64]
"""A number, or one for each of some sizes of subimages."""


@dataclass(frozen=True)
class Work:
    """Counted operations of a device and its host.

    `clsas.planning.costs.Costs` has the same fields, in nanoseconds each: `Costs.seconds`
    multiplies the two. Amounts are numbers, or arrays over sizes of subimages.

    Attributes
    ----------
    call
        Images, however they are formed: decisions, buffers, launches.
    upsampled_sample, filtered_sample
        Samples of the upsampled lines, by FFT on the host and by filters on the device.
    reference
        Root subimages times channels, on the host.
    batch
        Stages of batches of roots: launches, tables, transfers; and of further strips.
    subimage
        Subimages, stage by stage.
    line
        Lines aligned and combined in stages: their shifts, phases and weights.
    sample, sample_tap
        Samples aligned and combined in stages; the same times the taps of both filters.
    single_sample
        Those of lines in single precision.
    given_sample
        Samples aligned in the first stage, whose lines come from main memory.
    leaf_channel
        Virtual channels of the leaves.
    leaf, leaf_point
        Pixels times virtual channels of leaves, with 4 taps, on a plane and off it.
    leaf_gathered
        Those of leaves so thick that samples are not looked up in registers.
    group
        Pixels off a plane that the host puts into groups.
    part
        Tiles, or groups, times channels of an exact image: references, on the host.
    pixel, point
        Pixels times channels of an exact image, with 4 taps, in tiles and in groups.
    beam
        Pixels times channels that a beam weighs, in exact images and leaves.
    """

    call: Amount = 0.0
    upsampled_sample: Amount = 0.0
    filtered_sample: Amount = 0.0
    reference: Amount = 0.0
    batch: Amount = 0.0
    subimage: Amount = 0.0
    line: Amount = 0.0
    sample: Amount = 0.0
    sample_tap: Amount = 0.0
    single_sample: Amount = 0.0
    given_sample: Amount = 0.0
    leaf_channel: Amount = 0.0
    leaf: Amount = 0.0
    leaf_point: Amount = 0.0
    leaf_gathered: Amount = 0.0
    group: Amount = 0.0
    part: Amount = 0.0
    pixel: Amount = 0.0
    point: Amount = 0.0
    beam: Amount = 0.0

    def __add__(self, other: Work) -> Work:
        """Return the work of both."""
        return Work(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


def upsampling(samples: Amount, *, filtered: bool) -> Work:
    """Return the work of making so many samples of upsampled lines."""
    return Work(filtered_sample=samples) if filtered else Work(upsampled_sample=samples)


def combining(
    lines: Amount, samples: Amount, taps: int, *, given: bool, half_precision: bool = True
) -> Work:
    """Return the work of aligning and combining lines of so many samples in a stage.

    `taps` are those of both filters; `given` is whether it is the first stage.
    """
    aligned = lines * samples
    return Work(
        line=lines,
        sample=aligned,
        sample_tap=aligned * taps,
        single_sample=aligned * (not half_precision),
        given_sample=aligned * given,
    )


def adding_in_rows(lines: Amount, samples: Amount, taps: Amount) -> Work:
    """Return the work of adding to lines of a sheet, which many bands read and write in turn."""
    return Work(given_sample=2 * lines * samples * taps)


def backprojecting_leaves(
    lines: Amount,
    pixels: Amount,
    taps: int,
    *,
    tiled: bool,
    weighted: bool,
    gathered: bool = False,
) -> Work:
    """Return the work of backprojecting the lines of leaves of so many pixels.

    `gathered` is whether samples are not looked up in registers.
    """
    pairs = lines * pixels
    weighted_pairs = pairs * weighted
    if tiled:
        return Work(leaf_channel=lines, leaf=pairs * COST[taps], beam=weighted_pairs)
    of_taps = pairs * COST[taps]
    return Work(
        leaf_channel=lines,
        leaf_point=of_taps,
        leaf_gathered=of_taps * gathered,
        beam=weighted_pairs,
    )


def backprojecting(
    parts: int, part_pixels: int, channels: float, taps: int, *, tiled: bool, weighted: bool
) -> Work:
    """Return the work of an exact image whose parts see so many channels each."""
    pairs = parts * part_pixels * channels
    of_taps, weighted_pairs = pairs * COST[taps], pairs * weighted
    if tiled:
        return Work(part=parts * channels, pixel=of_taps, beam=weighted_pairs)
    return Work(
        part=parts * channels, point=of_taps, beam=weighted_pairs, group=parts * part_pixels
    )


@dataclass(frozen=True)
class ErrorBudget:
    """Relative error powers that add up to the prediction, by cause.

    Attributes
    ----------
    exact
        The interpolation and arithmetic of exact backprojection.
    range_filters, aperture_filters
        Interpolation in range, and along the aperture, in all stages together.
    upsampling
        The filters that upsample the lines.
    roots
        Channels that are put on the mean track, and rounding in the roots.
    spacing
        Virtual channels whose spacing, or the beam's weights between them, changes.
    leaves
        Expansion of ranges and weights in the leaves.
    beam_edges
        Edges of the beam that are left out because hardly anything is seen there.
    phases
        Polynomials for sine and cosine.
    half_precision
        Rounding of the lines that stages hand on.
    nearest_beams
        THESIS: neighbours summed as they are.
    line_ends, aliasing
        What the lines themselves leave open: see `clsas.signal.ambiguity`.
    left_out
        Effects that the image does without: see `clsas.sonar.simplify`.
    """

    exact: float = 0.0
    range_filters: float = 0.0
    aperture_filters: float = 0.0
    upsampling: float = 0.0
    roots: float = 0.0
    spacing: float = 0.0
    leaves: float = 0.0
    beam_edges: float = 0.0
    phases: float = 0.0
    half_precision: float = 0.0
    nearest_beams: float = 0.0
    line_ends: float = 0.0
    aliasing: float = 0.0
    left_out: float = 0.0

    @property
    def total(self) -> float:
        """All of them: causes are independent, so that powers add."""
        return sum(asdict(self).values())

    @property
    def total_db(self) -> float:
        """Relative rms error of all of them, dB."""
        return in_db(self.total)

    def times(self, factor: float) -> ErrorBudget:
        """Return every contribution times a factor."""
        return ErrorBudget(*(factor * each for each in asdict(self).values()))

    def describe(self) -> list[str]:
        """Return one line per contribution, the largest first, without those far below the rest."""
        found = sorted(asdict(self).items(), key=lambda item: -item[1])
        return [
            f"{name.replace('_', ' '):<16}  {in_db(error):6.1f} dB"
            for name, error in found
            if error > _NEGLIGIBLE * self.total
        ]


_NEGLIGIBLE = 1e-3  # of the total
