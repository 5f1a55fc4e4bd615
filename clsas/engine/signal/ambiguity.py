"""Errors that no imager can avoid, because the lines do not determine the image.

Samples beyond the ends of a line are unknown. If the band fills the whole sampled band, it is also
unknown to which end of the band the energy between its edges belongs. Every imager adds these
errors to its prediction, and warns if they are too large.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import in_db, power
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, some_channels
from clsas.engine.data.visibility import sines
from clsas.engine.signal.brightness import brightness
from clsas.engine.signal.scatter import independent_pixels, scatter
from clsas.engine.signal.spectrum import NEEDED_OVERSAMPLING, Spectrum

BEST_DB = -85.0
"""Smallest relative rms error of an image that single precision allows."""

# Margin by which a request may be out of reach without a warning: images at `BEST_DB` err by 3 dB
# less.
_CLOSE_DB = 2.5
# Error power near an end over the power of the end, measured on noise in 40 to 90 % of the band.
_AT_END = 0.03
_END = 4  # samples whose mean power is taken as that of an end: the taps on one side of a filter
_NEAR_END = 5  # samples around an end within which interpolators differ: half of 8 taps, plus one
# An end fades if the power of its last sample is below this share of the mean of so many samples.
_CUT, _FADING = 0.01, 16
# Half bandwidth, cycles per sample, up to which a cut affects only the samples within `_NEAR_END`.
_THIN = 0.42
_CHANNELS = 64  # channels sampled; half or twice as many change nothing
_POINTS = 16  # points sampled along either side of the grid
# Share of the allowed error power above which to warn: the error is then 1.8 dB above the request.
_MOST = 0.5
_LEAST = 1e-3  # share of the allowed error power below which errors are ignored


@dataclass(frozen=True)
class Ambiguity:
    """Relative error power of an image that follows from the lines themselves.

    Attributes
    ----------
    ends : float
        Error power due to unknown samples beyond the ends of lines that do not fade.
    aliasing : float
        Error power due to band edges that alias, if the band fills the whole sampled band.
    oversampling : float
        Sample rate over the width of the occupied band.
    brightness : float
        Power of the image over the power that its beam passes; see `brightness`.
    scatter : float
        Factor by which chance may raise the relative error power of images with few resolution
        cells; see `clsas.engine.signal.scatter`.
    """

    ends: float = 0.0
    aliasing: float = 0.0
    oversampling: float = np.inf
    brightness: float = 1.0
    scatter: float = 1.0

    @property
    def least_brightness(self) -> float:
        """Power of the image over the power that its beam passes, as low as chance may make it."""
        return self.brightness / self.scatter

    @property
    def error_power(self) -> float:
        """Total relative error power."""
        return self.ends + self.aliasing

    def of_passed_db(self, requested_db: float) -> float:
        """Return the error relative to what the beam passes that meets `requested_db`, dB.

        The result is never below `BEST_DB`. If the image is so dark that the request cannot be met,
        `warn` warns. It does not warn of what only chance may cause, which predicted errors
        include.
        """
        return max(requested_db + in_db(self.least_brightness), min(requested_db, BEST_DB))

    def rest_db(self, requested_db: float, other_error: float = 0.0) -> float:
        """Return the error left for all other causes, dB, so that the image meets `requested_db`.

        `other_error` is the error power of causes that are already known. If these leave too
        little, the result is `requested_db`, and `warn` warns.
        """
        allowed, spent = power(requested_db), self.error_power + other_error
        if _LEAST * allowed < spent <= _MOST * allowed:
            return in_db(allowed - spent)
        return requested_db

    def warn(self, name: str, requested_db: float) -> None:
        """Warn if the error requested by the argument `name` may be exceeded."""
        allowed = power(requested_db)

        def outcome(error_power: float) -> str:
            found_db = in_db(allowed + error_power)
            return f"the error may be {found_db:.0f} dB instead of {name} {requested_db:.3g} dB"

        if requested_db + in_db(self.brightness) < BEST_DB - _CLOSE_DB:
            dark_db = -in_db(self.brightness)
            validate.warn(
                f"the image is {dark_db:.0f} dB darker than the echoes at its ranges, because most "
                "of them come from places beside the grid, or that the beam hardly covers: the "
                f"error may be {BEST_DB + dark_db:.0f} dB instead of {name} {requested_db:.3g} dB; "
                "use a larger grid, or a wider beam"
            )
        if self.ends > _MOST * allowed:
            validate.warn(
                "lines do not fade towards ends that the grid reaches, or their guard band is thin "
                f"(oversampling {self.oversampling:.4g}) and the cut affects samples farther "
                "inside: pixels depend on how the lines are interpolated, so that "
                f"{outcome(self.ends)}; let the grid end before the lines do, fade the lines "
                "(lines.tapered_ends), or sample them more finely"
            )
        if self.aliasing > _MOST * allowed:
            validate.warn(
                "the band of the lines fills the whole sampled band, so that its edges may alias: "
                f"oversampling is {self.oversampling:.4g}, but must be above "
                f"{NEEDED_OVERSAMPLING:.4g}; {outcome(self.aliasing)}; sample more finely "
                "(compress(oversampling=...))"
            )


def ambiguity(
    lines: RangeLines,
    grid: Grid,
    spectrum: Spectrum,
    energy: NDArray[np.float64],
    beam: BeamWindow | None = None,
    along: NDArray[np.float64] | None = None,
) -> Ambiguity:
    """Return the unavoidable error power of an image on a grid.

    `energy` is the energy of every line in any unit, [channels]. `along` are the unit directions of
    the track, [channels, 3], or None without a beam.
    """
    return Ambiguity(
        ends_error(lines, grid, spectrum, beam, along),
        spectrum.aliasing,
        spectrum.oversampling,
        brightness(lines, grid, spectrum, beam, along),
        scatter(independent_pixels(lines, grid, spectrum, energy, beam, along)),
    )


def ends_error(
    lines: RangeLines,
    grid: Grid,
    spectrum: Spectrum,
    beam: BeamWindow | None,
    along: NDArray[np.float64] | None,
) -> float:
    """Return the relative error power due to truncated lines, whose further samples are unknown.

    Notes
    -----
    Within five samples of an end, every interpolator responds differently to the cut. The total
    error there is `_AT_END` times the power of an end sample. With a thin guard band the cut also
    affects samples farther inside. At m samples from the end, the sinc interpolation of a component
    at distance d from the spectral centre has an error of 1/(2 pi m cos(pi d)) of its amplitude.
    Summed over the samples from `near` to `far`, and over the part of a flat band of half width h
    beyond `_THIN`, the error is

        S/pi^2 (1/near - 1/far),  S = (tan(pi h) - tan(pi _THIN))/(4 pi h),

    times the power of an end sample, unless the lines fade.
    """
    some = some_channels(lines.channels, _CHANNELS)
    part, points_m = lines.select(some), grid.spread(_POINTS)
    range_m = pairwise_range_m(
        points_m, part.tx_m, part.rx_m, part.rx_velocity_m_s, part.sound_speed_m_s
    )
    sample = (range_m - part.first_range_m) / part.range_step_m
    visible = np.ones(sample.shape, bool)
    if beam is not None and along is not None:
        low, high = beam.limits
        sine = sines(points_m, part.phase_centres_m, along[some]).T
        visible = (sine > low) & (sine < high)
    nearest = np.where(visible, sample, np.inf).min(axis=0)
    farthest = np.where(visible, sample, -np.inf).max(axis=0)
    half_width = np.clip(0.5 / spectrum.oversampling, _THIN, 0.499)
    steepness = np.tan(np.pi * half_width) - np.tan(np.pi * _THIN)
    inside = steepness / (4 * np.pi**3 * half_width)
    last = lines.length - 1
    first = np.clip(nearest, 0, last).astype(np.int64)
    end = np.clip(farthest, -1, last).astype(np.int64) + 1
    square = part.samples.real.astype(np.float64) ** 2
    square += part.samples.imag.astype(np.float64) ** 2
    imaged = end > first
    if not imaged.any():
        return 0.0
    at_ends = np.zeros(len(some))
    # For either end: the samples counted from it, and the nearest and the farthest pixel.
    for samples, near, far in (
        (square, nearest, farthest),
        (square[:, ::-1], last - farthest, last - nearest),
    ):
        share = np.where((near < _NEAR_END) & (far > -_NEAR_END), _AT_END, 0.0)
        ends_loudly = _ends_loudly(samples)
        near = np.maximum(near, _NEAR_END)
        share += ends_loudly * inside * np.maximum(1 / near - 1 / np.maximum(far, near), 0.0)
        at_ends += share * samples[:, :_END].mean(axis=1)
    index = np.arange(lines.length)
    within = (index >= first[:, None]) & (index < end[:, None])
    total = square.sum(where=within)
    return float(at_ends[imaged].sum() / total) if total else 0.0


def end_powers(lines: RangeLines) -> tuple[float, float]:
    """Return the power of the first and last samples over the mean power; 0 where lines fade."""
    part = lines.select(some_channels(lines.channels, _CHANNELS))
    square = part.samples.real.astype(np.float64) ** 2
    square += part.samples.imag.astype(np.float64) ** 2
    mean = float(square.mean())
    if not mean:
        return 0.0, 0.0
    first, last = (
        float((_ends_loudly(samples) * samples[:, :_END].mean(axis=1)).mean()) / mean
        for samples in (square, square[:, ::-1])
    )
    return first, last


def _ends_loudly(square: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask of lines that do not fade towards the first sample of `square`, [n, length]."""
    return square[:, 0] > _CUT * square[:, :_FADING].mean(axis=1)
