"""Errors that no imager can avoid, because the lines do not determine the image.

Samples beyond the ends of a line are unknown. If the band fills the whole sampled band, it is also
unknown to which end of the band the energy between its edges belongs. Every imager adds these
errors to its prediction, and warns if they are too large.

The lines also decide how large any error becomes relative to the image. It is larger if most of
what the channels receive cancels in the image (`brightness`), and may be larger by chance if the
image has few resolution cells (`scatter`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.special
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow, normalising
from clsas.engine.data.decibels import in_db, power
from clsas.engine.data.fourier import turned
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import (
    GOLDEN,
    RangeLines,
    antennas_of,
    cycles_per_m_at,
    some_channels,
    wavelength_m,
)
from clsas.engine.data.visibility import is_within, sines
from clsas.engine.signal.interpolation import TAPS
from clsas.engine.signal.spectrum import NEEDED_OVERSAMPLING, Spectrum, representative_channels

BEST_DB = -85.0
"""Smallest relative rms error of an image that single precision allows."""
MARGIN_DB = 1.0
"""Margin of predicted errors, for the scatter of measured ones."""

# Margin by which a request may be out of reach without a warning: images at `BEST_DB` err by 3 dB
# less.
_CLOSE_DB = 2.5
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
        cells; see `scatter`.
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
            return f"the error may be {found_db:.0f} dB instead of `{name}` {requested_db:.3g} dB"

        if requested_db + in_db(self.brightness) < BEST_DB - _CLOSE_DB:
            dark_db = -in_db(self.brightness)
            validate.warn(
                f"the image is {dark_db:.0f} dB darker than the echoes at its ranges, because most "
                "of them come from places beside the grid, or that the beam hardly covers: the "
                f"error may be {BEST_DB + dark_db:.0f} dB instead of `{name}` {requested_db:.3g} "
                "dB; use a larger grid, or a wider beam"
            )
        if self.ends > _MOST * allowed:
            validate.warn(
                "the lines do not fade towards ends that the grid reaches, or their guard band is "
                f"thin (oversampling {self.oversampling:.4g}) and the cut affects samples farther "
                "inside: pixels depend on how the lines are interpolated, so that "
                f"{outcome(self.ends)}; let the grid end before the lines do, fade the lines "
                "(`lines.tapered_ends`), or sample them more finely"
            )
        if self.aliasing > _MOST * allowed:
            validate.warn(
                "the band of the lines fills the whole sampled band, so that its edges may alias: "
                f"oversampling is {self.oversampling:.4g}, but must be above "
                f"{NEEDED_OVERSAMPLING:.4g}; {outcome(self.aliasing)}; sample more finely "
                "(`clsas.compress(oversampling=...)`)"
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


# Unknown samples beyond the ends of lines.

# Error power near an end over the power of the end, measured on noise in 40 to 90 % of the band.
_AT_END = 0.03
# Samples whose mean power is taken as that of an end: the taps on one side of the widest filter.
_END = max(TAPS) // 2
_NEAR_END = _END + 1  # samples around an end within which interpolators differ
# An end fades if the power of its last sample is below this share of the mean of so many samples.
_CUT, _FADING = 0.01, 16
# Half bandwidth, cycles per sample, up to which a cut affects only the samples within `_NEAR_END`.
_THIN = 0.42
_END_CHANNELS = 64  # channels sampled; half or twice as many change nothing


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
    some = some_channels(lines.channels, _END_CHANNELS)
    part, points_m = lines.select(some), grid.spread()
    range_m = pairwise_range_m(
        points_m, part.tx_m, part.rx_m, part.rx_velocity_m_s, part.sound_speed_m_s
    )
    sample = (range_m - part.first_range_m) / part.range_step_m
    visible = np.ones(sample.shape, bool)
    if beam is not None and along is not None:
        sine = sines(points_m, part.phase_centres_m, along[some]).T
        visible = is_within(sine, beam.limits)
    nearest = np.where(visible, sample, np.inf).min(axis=0)
    farthest = np.where(visible, sample, -np.inf).max(axis=0)
    half_width = np.clip(0.5 / spectrum.oversampling, _THIN, 0.499)
    steepness = np.tan(np.pi * half_width) - np.tan(np.pi * _THIN)
    inside = steepness / (4 * np.pi**3 * half_width)
    last = lines.length - 1
    first = np.clip(nearest, 0, last).astype(np.int64)
    end = np.clip(farthest, -1, last).astype(np.int64) + 1
    square = _square(part)
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
    part = lines.select(some_channels(lines.channels, _END_CHANNELS))
    square = _square(part)
    mean = float(square.mean())
    if not mean:
        return 0.0, 0.0
    first, last = (
        float((_ends_loudly(samples) * samples[:, :_END].mean(axis=1)).mean()) / mean
        for samples in (square, square[:, ::-1])
    )
    return first, last


def _square(lines: RangeLines) -> NDArray[np.float64]:
    """Return the power of all samples."""
    square = lines.samples.real.astype(np.float64) ** 2
    square += lines.samples.imag.astype(np.float64) ** 2
    return square


def _ends_loudly(square: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask of lines that do not fade towards the first sample of `square`, [n, length]."""
    return square[:, 0] > _CUT * square[:, :_FADING].mean(axis=1)


# Power of the image over the power that its channels receive.

# Channels summed coherently. With half as many, echoes from beside a pixel cancel less, and images
# of points at the edge of the beam look 3 dB brighter than they are; twice as many change 1 dB.
_GROUP_CHANNELS = 64
_LEAST_GROUP = 32
_MOST_CHANNELS = 1024  # channels summed together if groups are dark: a plain choice
_GROUPS = 4  # groups of channels, spread evenly along the lines
# Points along either side of the grid: at first, and if those find little power.
_FEW, _MANY = 8, 48
_PAIRS_AT_ONCE = 1 << 16  # of points and channels; bounds memory
_DARKEST = 1e-8  # least ratio returned, far below what any image resolves
_DARK = 0.5  # ratio above which images are not dark; sampling alone changes it by 1 dB


def brightness(
    lines: RangeLines,
    grid: Grid,
    spectrum: Spectrum,
    beam: BeamWindow | None,
    along: NDArray[np.float64] | None,
) -> float:
    """Return the power of an image over the power that its channels receive, 1 unless it is dark.

    If most echoes at the ranges of the pixels come from places beside the grid, or from such that
    the beam hardly covers, most of what the channels receive cancels in the image. Interpolation
    errors do not cancel. They are therefore larger relative to such an image than relative to one
    of a seabed.

    Parameters
    ----------
    lines, grid, spectrum
        Lines, pixels, and the spectrum of the lines.
    beam, along : BeamWindow and float64 [channels, 3], or None
        Weights of the channels, and the unit directions of the track at the channels.

    Notes
    -----
    With z_i = w_i s_i(rho_i) exp(j 2 k rho_i), sums of z_i over groups of neighbouring channels
    keep what arrives from about the direction of a pixel: the beam of a group is so wide that no
    bright echo within the grid is missed. The brightness is the power of these sums, averaged over
    pixels and groups, over the power of all z_i. If it is low, it is that of the sums of all
    channels, where echoes from beside the grid cancel further.
    """
    if lines.channels < 2 * _LEAST_GROUP or lines.length < 2:
        return 1.0
    if beam is None and len(grid.spread(_FEW)) < _FEW**2:
        return 1.0  # a few pixels are dark by chance, which `scatter` allows for
    group = min(_GROUP_CHANNELS, lines.channels // 2)
    centres_m = lines.phase_centres_m  # in any order
    order = np.argsort(centres_m[:, np.ptp(centres_m, axis=0).argmax()], kind="stable")
    middles = order[np.linspace(0, lines.channels - 1, 2 * _GROUPS + 1)[1::2].astype(np.int64)]
    channels = np.stack(
        [
            np.argpartition(np.sum((centres_m - centres_m[each]) ** 2, axis=1), group - 1)[:group]
            for each in middles
        ]
    )
    found = 1.0
    for most in (_FEW, _MANY):
        points_m = grid.spread(most)
        found = _brightness_of_groups(lines, channels, points_m, spectrum, beam, along)
        if found > _DARK:
            return 1.0
    # Echoes from beside the grid also cancel between groups.
    whole = order[some_channels(lines.channels, _MOST_CHANNELS)][None]
    found = min(found, _brightness_of_groups(lines, whole, points_m, spectrum, beam, along))
    return max(found, _DARKEST)


def _brightness_of_groups(
    lines: RangeLines,
    groups: NDArray[np.int64],
    points_m: NDArray[np.float64],
    spectrum: Spectrum,
    beam: BeamWindow | None,
    along: NDArray[np.float64] | None,
) -> float:
    """Return the power of sums over groups [groups, channels], relative to that of their terms."""
    channels = groups.ravel()
    part, row = lines.select(channels), np.arange(len(channels))
    coherent = passed = 0.0
    at_once = max(_PAIRS_AT_ONCE // len(channels), 1)
    for first in range(0, len(points_m), at_once):
        some_m = points_m[first : first + at_once]
        range_m = pairwise_range_m(
            some_m, part.tx_m, part.rx_m, part.rx_velocity_m_s, part.sound_speed_m_s
        )

        # Linear interpolation about the centre of the band, [points, channels].
        sample = (range_m - part.first_range_m) / part.range_step_m
        lower = np.floor(sample)
        inside = (lower >= 0) & (lower < part.length - 1)
        index = np.where(inside, lower, 0).astype(np.int64)
        between = sample - lower
        values = (1 - between) * part.samples[row, index]
        values = values + between * part.samples[row, index + 1] * np.exp(
            -2j * np.pi * spectrum.centre
        )

        # Phases that focus on the points, and the weights of the beam.
        turns = spectrum.centre * between
        turns += part.carrier_cycles_per_m * range_m
        values *= turned(turns)
        values *= inside
        if beam is not None and along is not None:
            values *= _beam_weights(lines, channels, some_m, beam, along)

        sums = values.reshape(len(some_m), *groups.shape).sum(axis=-1)
        coherent += float(np.vdot(sums, sums).real)
        passed += float(np.vdot(values, values).real)
    return coherent / passed if passed else 1.0


def _beam_weights(
    lines: RangeLines,
    channels: NDArray[np.int64],
    points_m: NDArray[np.float64],
    beam: BeamWindow,
    along: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the weights of the beam, [points, channels]."""
    sine = sines(points_m, lines.phase_centres_m[channels], along[channels]).T
    weights: NDArray[np.float64] = beam.weights(sine, wavelength_m(lines))
    return weights


# Chance in images with few resolution cells.

_PIXELS = 256  # pixels sampled; with more independent pixels, the scatter is below `MARGIN_DB`
_NOISE_CHANNELS = 256  # channels sampled in addition to the loudest; a beam passes some of them
# Terms sampled of the sums over channels and frequencies; twice as many change nothing.
_TERMS = 256
_KEPT = 0.995  # share of images that must meet their accuracy


def scatter(independent: float) -> float:
    """Return the factor of relative error power that 99.5 % of noise images do not exceed.

    By chance, the power of an image with few resolution cells may be far below its expected value,
    and the power of its errors far above.

    Parameters
    ----------
    independent : float
        Number of `independent_pixels` of the images.

    Notes
    -----
    The ratio of two mean powers over N independent complex Gaussian values has the F distribution
    of 2 N and 2 N degrees of freedom.
    """
    quantile = scipy.special.fdtri(2 * independent, 2 * independent, _KEPT)
    return max(float(quantile) / power(MARGIN_DB), 1.0)


def independent_pixels(
    lines: RangeLines,
    grid: Grid,
    spectrum: Spectrum,
    energy: NDArray[np.float64],
    beam: BeamWindow | None,
    along: NDArray[np.float64] | None,
) -> float:
    """Return the number of independent pixels of a noise image, from 1 to 256.

    Parameters
    ----------
    lines, grid, spectrum, beam, along
        As for `brightness`.
    energy : float64 [channels]
        Energy of every line, in any unit.

    Notes
    -----
    A pixel is a sum of many terms, one for every channel and frequency. N is the inverse of the
    mean squared correlation of two pixels, over all pairs. Terms are sampled in proportion to their
    power. Sums of so few terms are correlated by 1/`_TERMS` even if the phases are random. This is
    subtracted, which overestimates N by up to a third for N up to 60.
    """
    is_whole = grid.size <= _PIXELS
    number = np.arange(_PIXELS)
    points_m = grid.at(
        np.arange(grid.size) if is_whole else (number * GOLDEN % 1 * grid.size).astype(np.int64)
    )
    some, factor = representative_channels(lines, _NOISE_CHANNELS, energy)
    weights = np.ones((len(points_m), len(some)))
    if beam is not None and along is not None:
        weights = _beam_weights(lines, some, points_m, beam, along)
        if beam.normalise:
            mean = weights.mean(axis=1, keepdims=True)
            weights *= normalising(mean * lines.channels, lines.channels)
    seen = np.mean(weights**2, axis=0)
    held = np.cumsum(seen * factor.astype(np.float64) ** 2 * (energy[some] / (energy.max() or 1.0)))
    if not held[-1]:
        return float(_PIXELS)
    term = np.arange(_TERMS)
    chosen = np.searchsorted(held, (term + 0.5) / _TERMS * held[-1])
    away = 2 * (term * GOLDEN % 1) - 1
    share = np.cumsum(spectrum.share)
    frequency = np.copysign(np.interp(np.abs(away), share / share[-1], spectrum.frequency), away)
    channels = some[chosen]
    range_m = pairwise_range_m(points_m, *antennas_of(lines, channels))
    per_m = cycles_per_m_at(lines, spectrum.centre + frequency)
    terms = turned(range_m * per_m).astype(np.complex64)
    sample = (range_m - lines.first_range_m[channels]) / lines.range_step_m
    is_reached = (sample > -1) & (sample < lines.length)
    terms *= is_reached * weights[:, chosen] / np.sqrt(_TERMS * seen[chosen])
    alike = np.abs(terms @ terms.conj().T) ** 2
    own = np.abs(terms).astype(np.float64) ** 2
    both = np.multiply.outer(own.sum(axis=1), own.sum(axis=1))
    if not is_whole:  # a pixel is not sampled twice
        np.fill_diagonal(alike, 0.0)
        np.fill_diagonal(both, 0.0)
    if not both.any():
        return float(_PIXELS)
    by_few = 1 / _TERMS
    mean = float(alike.sum(dtype=np.float64) / both.sum())
    return 1 / float(np.clip((mean - by_few) / (1 - by_few), 1 / _PIXELS, 1.0))
