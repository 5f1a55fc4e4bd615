"""Errors that no imager can avoid, because the lines do not hold what an image needs.

Samples beyond the ends of a line are unknown, and so is which side of the guard band the energy in
it belongs to. Every imager adds these errors to its prediction and warns where they are too large.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.core import validate
from clsas.core.decibels import in_db, power
from clsas.core.geometry import pairwise_range_m
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines, some_channels
from clsas.signal.spectrum import NEEDED_OVERSAMPLING, Spectrum
from clsas.sonar.beam import BeamWindow, sines

_AT_END, _END = 0.03, 4  # measured on noise that fills 40 to 90 % of the sampled band; samples
_BESIDE = 5  # samples
_CUT, _FADING = 0.01, 16  # a line fades if its last sample has less power than so many before it
_THIN = 0.42  # cycles per sample: with a narrower half band, cuts are not felt beyond `_BESIDE`
_CHANNELS, _PLACES = 64, 16  # sampled channels, and pixels along either side of a grid
_MOST, _LEAST = 0.5, 1e-3  # shares of the allowed error power: above, warn; below, ignore


@dataclass(frozen=True)
class Ambiguity:
    """Relative error power of an image that the lines themselves leave open.

    Attributes
    ----------
    ends : float
        From samples beyond the ends of lines that do not fade.
    aliasing : float
        From a band that fills all that is sampled: its edges cannot be told apart.
    oversampling : float
        Sample rate over the width of the occupied band.
    """

    ends: float = 0.0
    aliasing: float = 0.0
    oversampling: float = np.inf

    @property
    def error_power(self) -> float:
        """All of it."""
        return self.ends + self.aliasing

    def rest_db(self, wanted_db: float, other_error: float = 0.0) -> float:
        """Error left to everything else, dB, so that the whole image keeps `wanted_db`.

        `other_error` is power that is spent too. Where both take too much for that, it is
        `wanted_db`; `warn` then warns.
        """
        wanted, spent = power(wanted_db), self.error_power + other_error
        if _LEAST * wanted < spent <= _MOST * wanted:
            return in_db(wanted - spent)
        return wanted_db

    def warn(self, name: str, wanted_db: float) -> None:
        """Warn where the error asked for by the argument `name` may be missed."""
        wanted = power(wanted_db)

        def outcome(error_power: float) -> str:
            found_db = in_db(wanted + error_power)
            return f"the error may be {found_db:.0f} dB in place of {name} {wanted_db:.3g} dB"

        if self.ends > _MOST * wanted:
            validate.warn(
                "lines do not fade towards ends that the grid reaches, or their guard band is thin "
                f"(oversampling {self.oversampling:.4g}) and the cut is felt farther inside: what "
                f"pixels get depends on how lines are interpolated, so that {outcome(self.ends)}; "
                "let the grid end before the lines, let the lines fade, or sample them more finely"
            )
        if self.aliasing > _MOST * wanted:
            validate.warn(
                "the lines' band fills all that is sampled, so that its edges may alias: "
                f"oversampling is {self.oversampling:.4g}, more than {NEEDED_OVERSAMPLING:.4g} is "
                f"needed; {outcome(self.aliasing)}; sample more finely "
                "(compress(oversampling=...))"
            )


def ambiguity(
    lines: RangeLines,
    grid: Grid,
    spectrum: Spectrum,
    beam: BeamWindow | None = None,
    along: NDArray[np.float64] | None = None,
) -> Ambiguity:
    """Error power that lines leave open in an image on a grid.

    `along` are the track's directions for a beam, [channels, 3].
    """
    ends = ends_error(lines, grid, spectrum, beam, along)
    return Ambiguity(ends, spectrum.aliasing, spectrum.oversampling)


def ends_error(
    lines: RangeLines,
    grid: Grid,
    spectrum: Spectrum,
    beam: BeamWindow | None,
    along: NDArray[np.float64] | None,
) -> float:
    """Relative error power from truncated lines: the samples beyond an end are unknown.

    Notes
    -----
    Pixels within five samples of an end get what filters make of the cut, every filter another:
    `_AT_END` of an end sample's power altogether. A thin guard band carries the cut farther: at m
    samples from the end, the sinc interpolation of a component at distance d from the spectral
    centre errs by 1/(2 pi m cos(pi d)) of its amplitude. Summed over the samples from `near` to
    `far`, and over what a flat band of half width h holds beyond `_THIN`, that makes of an end
    sample's power, unless lines fade

        S/pi^2 (1/near - 1/far),  S = (tan(pi h) - tan(pi _THIN))/(4 pi h).
    """
    some = some_channels(lines.channels, _CHANNELS)
    part, points_m = lines.select(some), grid.spread(_PLACES)
    range_m = pairwise_range_m(
        points_m, part.tx_m, part.rx_m, part.rx_velocity_m_s, part.sound_speed_m_s
    )
    place = (range_m - part.first_range_m) / part.range_step_m
    seen = np.ones(place.shape, bool)
    if beam is not None and along is not None:
        low, high = beam.limits
        sine = sines(points_m, part.phase_centres_m, along[some]).T
        seen = (sine > low) & (sine < high)
    nearest = np.where(seen, place, np.inf).min(axis=0)
    farthest = np.where(seen, place, -np.inf).max(axis=0)
    half_width = np.clip(0.5 / spectrum.oversampling, _THIN, 0.499)
    steepness = np.tan(np.pi * half_width) - np.tan(np.pi * _THIN)
    inside = steepness / (4 * np.pi**3 * half_width)
    last = lines.length - 1
    at_ends, total = 0.0, 0.0
    for samples, near, far in zip(part.samples, nearest, farthest, strict=True):
        line = samples.astype(np.complex128)
        within = line[int(np.clip(near, 0, last)) : int(np.clip(far, -1, last)) + 1]
        if not within.size:
            continue
        total += _mean_square(within) * len(within)
        # From either end: its samples, and how far off the nearest and the farthest pixel are.
        for end, first, beyond in ((line, near, far), (line[::-1], last - far, last - near)):
            share = _AT_END if first < _BESIDE and beyond > -_BESIDE else 0.0
            if _mean_square(end[:1]) > _CUT * _mean_square(end[:_FADING]):
                first = max(first, _BESIDE)
                share += inside * max(1 / first - 1 / max(beyond, first), 0.0)
            at_ends += share * _mean_square(end[:_END])
    return at_ends / total if total else 0.0


def _mean_square(samples: NDArray[np.complex128]) -> float:
    """Mean square of samples."""
    return float(np.vdot(samples, samples).real) / len(samples)
