"""Counts of operations, which the search, predictions and the scaling of costs share."""

from __future__ import annotations

from clsas.plans.predictions import Amount, Work
from clsas.signal.interpolation import COST


def upsampling(samples: Amount, *, filtered: bool) -> Work:
    """Return the work of upsampling lines to a number of samples, by filters or by FFT."""
    return Work(filtered_sample=samples) if filtered else Work(upsampled_sample=samples)


def combining(
    lines: Amount, samples: Amount, taps: int, *, given: bool, half_precision: bool = True
) -> Work:
    """Return the work of aligning and combining lines of `samples` samples in a stage.

    `taps` is the sum of the taps of both filters. `given` is true for the first stage, which
    combines the given lines.
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
    """Return the work of backprojecting `lines` lines to leaves of `pixels` pixels each.

    `gathered` is true if samples are read from memory one by one, instead of looked up in
    registers.
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
    """Return the work of an exact image of `parts` parts, from `channels` channels each."""
    pairs = parts * part_pixels * channels
    of_taps, weighted_pairs = pairs * COST[taps], pairs * weighted
    if tiled:
        return Work(part=parts * channels, pixel=of_taps, beam=weighted_pairs)
    return Work(
        part=parts * channels, point=of_taps, beam=weighted_pairs, group=parts * part_pixels
    )
