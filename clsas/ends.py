"""Ends of lines that do not fade: what images differ by there, whichever imager forms them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsas import validate
from clsas.decibels import in_db, power
from clsas.geometry import pairwise_range_m
from clsas.grid import Grid
from clsas.lines import RangeLines, some_channels
from clsas.window import BeamWindow, sines

_OF_AN_END, _END = 0.03, 4  # measured on noise of 40 to 90 % of the sampled band; samples
_BESIDE = 5  # samples
_CHANNELS, _PLACES = 64, 16  # looked at: channels, and pixels along either side of a grid
_MOST, _LEAST = 0.5, 1e-3  # of the power of the error allowed: made up for by the rest of it


def ends_error(
    lines: RangeLines, grid: Grid, beam: BeamWindow | None, along: NDArray[np.float64] | None
) -> float:
    """Return the power of what images differ by at the ends of lines that do not fade there.

    What lies beyond an end is not known: pixels of up to five samples around it get what filters
    make of the cut, each another. That is `_OF_AN_END` of a sample's power for every end that the
    grid comes so near to. `along` are the track's directions for a beam, [channels, 3].
    """
    some = some_channels(lines.channels, _CHANNELS)
    part, points_m = lines.select(some), grid.spread(_PLACES)
    range_m = pairwise_range_m(
        points_m, part.tx_m, part.rx_m, part.rx_velocity_m_s, part.sound_speed_m_s
    )
    place = (range_m - part.first_range_m) / part.range_step_m
    seen = np.ones(place.shape, bool)
    if beam is not None:
        low, high = beam.limits
        sine = sines(points_m, part.phase_centres_m, along[some]).T
        seen = (sine > low) & (sine < high)
    nearest = np.where(seen, place, np.inf).min(axis=0)
    farthest = np.where(seen, place, -np.inf).max(axis=0)
    at_ends, total = 0.0, 0.0
    for samples, near, far in zip(part.samples, nearest, farthest, strict=True):
        first, last = (int(np.clip(at, -1, lines.length)) for at in (near, far))
        line = samples.astype(np.complex128)
        within = line[max(first, 0) : last + 1]
        total += np.vdot(within, within).real
        for end, place_of_end in ((line[:_END], 0), (line[-_END:], lines.length - 1)):
            if near < place_of_end + _BESIDE and far > place_of_end - _BESIDE:
                at_ends += np.vdot(end, end).real / len(end)
    return _OF_AN_END * at_ends / total if total else 0.0


def besides_ends(wanted_db: float, ends: float) -> float:
    """Return what everything but the ends may err by, dB, so that with them it is as wanted.

    Where they alone err by too much for that, it is what is wanted, and `warn_of_ends` warns.
    """
    wanted = power(wanted_db)
    if _LEAST * wanted < ends <= _MOST * wanted:
        return in_db(wanted - ends)
    return wanted_db


def warn_of_ends(name: str, wanted_db: float, ends: float) -> None:
    """Warn where ends alone err by so much that what is wanted, of this name, may be missed."""
    wanted = power(wanted_db)
    if ends > _MOST * wanted:
        validate.warn(
            "the grid reaches ends of lines that do not fade: what pixels within five samples of "
            "an end get depends on how lines are interpolated, so that the error may be "
            f"{in_db(wanted + ends):.0f} dB in place of {name} {wanted_db:.3g} dB; let "
            "the grid end before the lines, or the lines fade"
        )
