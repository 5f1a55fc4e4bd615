"""Interpolation of range lines: least-squares filters, the upsampling before them, and reading.

Imagers interpolate on a device, with filters that are designed here. `Readout` and `interpolated`
read lines on the host.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar, cast

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, toeplitz

from clsas.engine.data import reprs
from clsas.engine.data.decibels import in_db, power
from clsas.engine.data.fourier import turned
from clsas.engine.data.lines import RangeLines, cycles_per_m_at
from clsas.engine.data.validate import ArgumentError
from clsas.engine.signal.spectrum import Spectrum, measure_spectrum

_Complex = TypeVar("_Complex", np.complex64, np.complex128)

TAPS = (2, 4, 6, 8)
"""Taps of filters that look up single samples: those of exact images, and of leaves. Kernels take
any even number (`cl/lookup.h`). Each needs its time in `COST`, and the largest is at most `REACH`
of `clsas.engine.data.lines`."""

STAGE_TAPS = (2, 4, 6, 8)
"""Taps of filters that slide along lines, for which stages have kernels (`cl/sliding_filter.h`)."""

UPSAMPLINGS = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 16.0)
MOST_UPSAMPLING = 64.0

COST = {2: 0.75, 4: 1.0, 6: 1.3, 8: 1.55}
"""Device time per pixel and channel by number of taps, relative to 4 taps. Measured with PoCL and
Intel's runtime on an AVX-512 CPU (`scripts/bench taps`). With AVX2, more taps cost a tenth more."""

_UPSAMPLING_COST = 40.0  # host time of one upsampled sample, in units of `COST`

Gain = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Spectral gain as a function of the distance from the spectral centre, cycles per sample."""

# Share of the power that is added to every bin, so that fits stay regular where the band is empty.
# Where a gap lies within the band, filters could amplify rounding errors in the gap, in every stage
# anew; there, the share grows by steps until a filter does not amplify white noise.
_NOISE_FLOOR, _MORE_NOISE, _MOST_NOISE_FLOOR = 1e-13, 100.0, 1e-3
_MOST_NOISE = 1.5  # power of white noise after a filter; without such gaps, at most 1.2
# Positions between two samples at which filters are fitted. Half or twice as many change errors by
# 0.3 dB.
_POSITIONS = 17
_SINGULAR = np.finfo(np.float64).eps  # smaller relative singular values are rounding errors
_SCATTER_DB = 0.5  # margin for the scatter of measured errors around predicted ones


@dataclass(frozen=True, eq=False)
class Interpolator:
    """Filter that evaluates upsampled lines between their samples.

    Attributes
    ----------
    taps : int
        Samples per evaluation, one of `TAPS` or `STAGE_TAPS`.
    upsampling : float
        Factor by which lines are upsampled by FFT before the filter is applied.
    coefficients : float64 [taps/2, 2, taps/2]
        Polynomials E and O for every pair of taps from the innermost outwards, highest power first.
        The weight of the tap at +-(pair + 1/2) from the middle is E(nu^2) +- nu O(nu^2), where nu
        in [-1/2, 1/2] is the position relative to the middle.
    error_db : float
        Predicted relative rms error of an evaluation of these lines, dB.
    scatter_db : float
        Predicted relative rms error if the lines have been divided by the mean response of the
        filter over all positions, `response`, dB.
    """

    taps: int
    upsampling: float
    coefficients: NDArray[np.float64]
    error_db: float
    scatter_db: float

    __repr__ = reprs.of_fields

    def __post_init__(self) -> None:
        """Keep the coefficients from being changed."""
        self.coefficients.flags.writeable = False

    @property
    def reach(self) -> int:
        """Samples on either side of a position, rounded to a sample, that may be read."""
        return self.taps // 2 + 1

    def weights(self, nu: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the weights of the taps at positions `nu` from the middle, [..., taps]."""
        nu = np.asarray(nu)
        square = (nu * nu)[..., None, None]
        values = np.zeros((*nu.shape, *self.coefficients.shape[:2]))
        for exponent in range(self.coefficients.shape[2]):  # the highest first
            values = values * square + self.coefficients[..., exponent]
        even, odd = values[..., 0], values[..., 1] * nu[..., None]
        return np.concatenate([(even - odd)[..., ::-1], even + odd], axis=-1)

    def response(self, frequency: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gain of the filter at some frequencies, averaged over all positions.

        `frequency` is the distance from the spectral centre, cycles per upsampled sample.
        """
        nu = np.linspace(-0.5, 0.5, _POSITIONS)
        taps_at = np.arange(self.taps) - (self.taps - 1) / 2
        cycles = np.asarray(frequency)[..., None, None] * (taps_at - nu[:, None])
        return np.mean(np.sum(self.weights(nu) * np.cos(2 * np.pi * cycles), axis=-1), axis=-1)


def design(taps: int, upsampling: float, spectrum: Spectrum) -> Interpolator:
    """Return the interpolator with the smallest rms error for lines with a given spectrum.

    Parameters
    ----------
    taps : int
        2 (linear interpolation), 4, 6 or 8.
    upsampling : float
        Factor by which the lines are upsampled before the filter is applied, >= 1.
    spectrum : Spectrum
        Spectrum of the lines before upsampling.

    Notes
    -----
    With the frequency f in cycles per upsampled sample and taps at +-a, a = 1/2, 3/2, ..., the
    error of a symmetric filter is

        2 sum_a E_a(nu^2) cos(2 pi f a) - cos(2 pi f nu)
        + j [2 nu sum_a O_a(nu^2) sin(2 pi f a) - sin(2 pi f nu)].

    The real and the imaginary part are two separate least-squares problems for the coefficients of
    the polynomials, weighted by the power at f. Linear interpolation is fixed: E = 1/2, O = 1.
    """
    return designs(taps, [upsampling], spectrum)[0]


def designs(taps: int, upsamplings: Sequence[float], spectrum: Spectrum) -> list[Interpolator]:
    """Return the interpolators of `design` for several upsampling factors at once."""
    rate = np.array(upsamplings, np.float64)[:, None, None]
    f = spectrum.frequency[:, None] / rate  # [rates, frequencies, 1]
    nu, of_position, from_positions = _positions(taps)
    turns = 2 * np.pi * f * (np.arange(taps // 2) + 0.5)
    aims = np.cos(2 * np.pi * f * nu), np.sin(2 * np.pi * f * nu)
    mean = np.array([1.0, *np.full(len(nu) - 1, 2.0)]) / (2 * len(nu) - 1)  # over positions
    floor = np.full((len(rate), 1), _NOISE_FLOOR)
    while True:
        share = np.sqrt(spectrum.power + floor)[..., None]
        coefficients = np.empty((len(rate), taps // 2, 2, taps // 2))
        residuals, noise = [], np.zeros(len(rate))
        for part, (aim, basis) in enumerate(zip(aims, (np.cos(turns), np.sin(turns)), strict=True)):
            of_frequency = 2 * basis
            if taps == 2:
                coefficients[:, :, part] = (0.5, 1.0)[part]
            else:
                # The basis is a product of functions of f and of nu, which are fitted one by one.
                q, r = np.linalg.qr(share * of_frequency)
                aim_in_basis = q.swapaxes(1, 2) @ (share * aim)
                at_positions = np.linalg.pinv(r, rcond=_SINGULAR) @ aim_in_basis
                coefficients[:, :, part] = at_positions @ from_positions[part].T
            noise += (
                2 * np.sum((coefficients[:, :, part] @ of_position[part].T) ** 2, axis=1) @ mean
            )
            residuals.append(of_frequency @ coefficients[:, :, part] @ of_position[part].T - aim)
        is_loud = (noise > _MOST_NOISE) & (floor[:, 0] < _MOST_NOISE_FLOOR)
        if not is_loud.any():
            break
        floor[is_loud] *= _MORE_NOISE
    # Once the phase of the position is removed, the error is the response minus 1. Its mean over
    # positions is real, because errors at nu and -nu are complex conjugates.
    even, odd = residuals
    square = (even**2 + odd**2) @ mean
    bias = (even * aims[0] + odd * aims[1]) @ mean
    scatter = np.maximum(square - bias**2, 0.0) / (1 + bias) ** 2
    error_db, scatter_db = (in_db(each @ spectrum.power) for each in (square, scatter))
    return [
        Interpolator(taps, *each)
        for each in zip(
            upsamplings, coefficients, error_db.tolist(), scatter_db.tolist(), strict=True
        )
    ]


@functools.lru_cache(maxsize=64)
def usual_designs(taps: int, frequency: bytes, power: bytes) -> tuple[Interpolator, ...]:
    """Return the interpolators of `designs` for all `UPSAMPLINGS`, which are remembered.

    The arrays are `Spectrum.as_bytes`.
    """
    spectrum = Spectrum(0.0, np.frombuffer(frequency), np.frombuffer(power))
    return tuple(designs(taps, UPSAMPLINGS, spectrum))


@functools.cache
def _positions(taps: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the positions at which filters are fitted, polynomials there, and their fit.

    Positions nu >= 0 suffice, because E is even in nu and nu O is odd. The polynomials have the
    shape [part, positions, powers]. The least-squares fit of powers to values at the positions has
    the shape [part, powers, positions].
    """
    nu = np.linspace(0, 0.5, _POSITIONS // 2 + 1)
    even = nu[:, None] ** (2 * np.arange(taps // 2)[::-1])
    basis = np.stack([even, nu[:, None] * even])
    # Every position except the middle represents two.
    weight = np.sqrt([1.0, *np.full(len(nu) - 1, 2.0)])
    fit = np.linalg.pinv(weight[:, None] * basis, rcond=_SINGULAR) * weight
    return nu, basis, fit.astype(np.float64, copy=False)


def choose(
    spectrum: Spectrum,
    accuracy_db: float,
    *,
    taps: int | None = None,
    upsampling: float | None = None,
    other_error: float = 0.0,
    pixels_per_sample: float = np.inf,
    lookup_cost: Callable[[int, float], float] = lambda taps, upsampling: 1.0,
) -> Interpolator:
    """Return the fastest interpolator that keeps the error below `accuracy_db`.

    A margin of half a decibel allows for the scatter of measured errors around predicted ones. If
    the power lies at few frequencies, errors do not average out, and the margin is larger by
    `Spectrum.scatter`.

    Parameters
    ----------
    spectrum : Spectrum
        Spectrum of the lines.
    accuracy_db : float
        Requested relative rms error, dB, negative.
    taps, upsampling : int, float, optional
        Fixed values for one or both. If both are fixed, `accuracy_db` has no effect.
    other_error : float
        Relative rms error from other causes, which adds in power.
    pixels_per_sample : float
        Number of pixels over number of samples of a line. The more pixels there are, the less the
        time of upsampling matters.
    lookup_cost : callable, optional
        Relative time per pixel and channel as a function of taps and upsampling.

    Raises
    ------
    ValueError
        If `accuracy_db` cannot be reached with the fixed value.
    """
    if taps is not None and upsampling is not None:
        return design(taps, upsampling, spectrum)
    power_left = power(accuracy_db) - other_error**2
    target_db = in_db(power_left / spectrum.scatter) - _SCATTER_DB
    candidates = []
    for each_taps in TAPS if taps is None else (taps,):
        if upsampling is None:
            designed = usual_designs(each_taps, *spectrum.as_bytes)
        else:
            designed = (design(each_taps, upsampling, spectrum),)
        for found in designed:
            if found.error_db <= target_db:
                candidates.append(found)
                break
    if not candidates:
        fixed = f"taps={taps}" if taps is not None else f"upsampling={upsampling}"
        allowed, best = f"be within reach of `{fixed}`", f"the best is {found.error_db:.1f} dB"
        raise ArgumentError("accuracy_db", allowed, f"{accuracy_db:g} dB", best)

    def cost(candidate: Interpolator) -> float:
        upsampling_cost = _UPSAMPLING_COST * candidate.upsampling / pixels_per_sample
        of_lookup = lookup_cost(candidate.taps, candidate.upsampling)
        return COST[candidate.taps] * of_lookup + upsampling_cost

    return min(candidates, key=cost)


@dataclass(frozen=True)
class Resampling:
    """Map from samples of a line to upsampled samples about the spectral centre.

    A line is zero beyond its ends. Upsampled sample m lies at the index (m + first) / ratio - lead
    of the line. Its phase is changed by -centre_cycles_per_sample (index + lead) cycles.

    Attributes
    ----------
    lead : int
        Number of zeros before a line.
    period, upsampled_period : int
        Number of samples before and after upsampling. These are the lengths of the FFTs, where FFTs
        are used.
    shift : int
        Frequency shift, cycles per period.
    first, length : int
        First upsampled sample that is kept, and the number of samples kept.
    """

    lead: int
    period: int
    upsampled_period: int
    shift: int
    first: int
    length: int

    @property
    def ratio(self) -> float:
        """Upsampled samples per sample."""
        return self.upsampled_period / self.period

    @property
    def centre_cycles_per_sample(self) -> float:
        """Frequency that is shifted to zero, cycles per original sample."""
        return self.shift / self.period

    def samples_per_m(self, lines: RangeLines) -> float:
        """Return the number of upsampled samples per metre of range."""
        return self.ratio / lines.range_step_m

    def places(
        self,
        range_m: NDArray[np.float64],
        first_range_m: NDArray[np.float64],
        lines: RangeLines,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return upsampled samples at ranges, and phases by which they are turned back, cycles.

        Samples are counted from the first of the whole upsampled line, not from `first`. Ranges are
        overwritten, since there are many.
        """
        position = (range_m - first_range_m) / lines.range_step_m + self.lead
        range_m *= lines.carrier_cycles_per_m
        cycles = range_m + position * self.centre_cycles_per_sample
        cycles -= np.rint(cycles)
        position *= self.ratio
        return position, cycles

    def cycles_per_m(self, lines: RangeLines) -> float:
        """Return the phase per metre of range at the spectral centre, cycles."""
        return cycles_per_m_at(lines, self.centre_cycles_per_sample)

    @property
    def frequency(self) -> NDArray[np.float64]:
        """Distances of the FFT's frequencies from the spectral centre, cycles per sample."""
        return np.abs(scipy.fft.fftfreq(self.period))

    def apply(
        self,
        samples: NDArray[np.complexfloating],
        gain: NDArray[np.float64] | None = None,
    ) -> NDArray[np.complexfloating]:
        """Return lines [channels, n], upsampled by FFT to [channels, length], in their precision.

        `gain` is a factor for the spectrum at every `frequency`.
        """
        padded = np.zeros((len(samples), self.period), samples.dtype)
        padded[:, self.lead : self.lead + samples.shape[1]] = samples
        spectrum = scipy.fft.fft(padded, axis=1, overwrite_x=True)
        if self.shift:
            spectrum = np.roll(spectrum, -self.shift, axis=1)
        factor = np.full(self.period, self.ratio, samples.real.dtype)
        if gain is not None:
            factor *= gain
        upper = self.period // 2  # bins of negative frequency, at the end
        lower, beyond = self.period - upper, self.upsampled_period - upper
        wide = np.empty((len(samples), self.upsampled_period), samples.dtype)
        np.multiply(spectrum[:, :lower], factor[:lower], out=wide[:, :lower])
        wide[:, lower:beyond] = 0
        np.multiply(spectrum[:, lower:], factor[lower:], out=wide[:, beyond:])
        result = scipy.fft.ifft(wide, axis=1, overwrite_x=True)
        return result[:, self.first : self.first + self.length]


# Zeros at either end of a line during its FFT. A band-limited line rings beyond its ends, and the
# ringing must decay before it wraps around to the other end.
_GUARD = 64


def resampling(length: int, interpolator: Interpolator, spectrum: Spectrum) -> Resampling:
    """Return the resampling by FFT of lines of `length` samples, as an interpolator needs it."""
    fft_length = scipy.fft.next_fast_len(length + 2 * _GUARD)
    upsampled_length = scipy.fft.next_fast_len(round(np.ceil(fft_length * interpolator.upsampling)))
    ratio = upsampled_length / fft_length
    beyond = interpolator.taps // 2  # so that the ends are interpolated like the middle
    first = int(np.ceil(_GUARD * ratio)) - beyond
    last = int(np.floor((_GUARD + length - 1) * ratio)) + beyond
    shift = round(spectrum.centre * fft_length)
    return Resampling(_GUARD, fft_length, upsampled_length, shift, first, last - first + 1)


PHASES = 32
"""Number of polyphase filters of an `Upsampler`."""
UPSAMPLING_TAPS = (8, 12, 16, 20, 24, 28, 32)
MOST_TAPS = max(UPSAMPLING_TAPS)
"""Samples of the widest filter of the imagers."""
_FINE = 4096  # frequency shifts are multiples of 1/(4096 step) cycles per sample
# Spectral centre, cycles per sample, up to which lines are not shifted. It is half the resolution
# of a measured spectrum.
_SAME = 0.5 / 256


@dataclass(frozen=True, eq=False)
class Upsampler:
    """Polyphase filters that upsample lines by a ratio of whole numbers and shape their spectrum.

    Attributes
    ----------
    step : int
        Distance between upsampled samples, in samples divided by `PHASES`.
    coefficients : float64 [PHASES, taps]
        Filters for positions p/PHASES after a sample. Half of the taps are the samples up to and
        including that sample, the other half the samples after it.
    error_db : float
        Predicted relative rms error of upsampled lines, dB.
    """

    step: int
    coefficients: NDArray[np.float64]
    error_db: float

    __repr__ = reprs.of_fields

    def __post_init__(self) -> None:
        """Keep the coefficients from being changed."""
        self.coefficients.flags.writeable = False

    @property
    def taps(self) -> int:
        """Number of samples that contribute to an upsampled sample."""
        return self.coefficients.shape[1]

    def resampling(self, length: int, beyond: int, spectrum: Spectrum) -> Resampling:
        """Return the resampling of lines of some length, with `beyond` samples past either end."""
        period, upsampled = self.step * _FINE, PHASES * _FINE
        last = (length - 1) * PHASES // self.step + beyond
        shift = 0 if abs(spectrum.centre) <= _SAME else round(spectrum.centre * period)
        return Resampling(0, period, upsampled, shift, -beyond, last + beyond + 1)


def upsampler(
    spectrum: Spectrum, step: int, gain: Gain, wanted_db: float, most_db: float | None = None
) -> Upsampler | None:
    """Return the shortest filters that upsample by PHASES / step with errors up to `wanted_db`.

    If there are none, because the lines fill nearly the whole sampled band, return the longest
    filters, provided that their error is at most `most_db` (by default `wanted_db`). Otherwise
    return None.

    Notes
    -----
    For every phase, sum_t h_t exp(j 2 pi f x_t) is fitted to gain(f) by least squares, weighted by
    the power at f, where x_t is the position of a tap relative to the upsampled sample. Solving the
    normal equations is accurate enough. Whatever their condition, rounding adds less than 1e-15 of
    the power, because its errors lie at frequencies where the lines have almost no power.
    """
    most_db = wanted_db if most_db is None else most_db
    aim = gain(spectrum.frequency)
    weight = spectrum.power + _NOISE_FLOOR
    # Values of cos(2 pi f x) at multiples of 1/PHASES samples. Sines cancel between f and -f.
    table = _cosines(spectrum.frequency.tobytes())
    of_taps, of_aim = weight @ table.T[:, ::PHASES], (weight * aim) @ table.T
    wanted = float(weight @ aim**2)
    first_half = np.arange(PHASES // 2 + 1)
    for taps in UPSAMPLING_TAPS:
        # Position of every tap relative to the upsampled sample, in phases.
        position = np.abs(PHASES * (np.arange(taps) + 1 - taps // 2)[:, None] - first_half)
        right = of_aim[position]
        # The matrix of the normal equations depends only on the distances between taps, so it is
        # the same for all phases.
        coefficients = cho_solve(cho_factor(toeplitz(of_taps[:taps])), right).T
        # Power of the residual of the best fit, by phase.
        residual = np.maximum(wanted - np.einsum("pt,tp->p", coefficients, right), 0.0)
        total = (residual.sum() + residual[1:-1].sum()) / PHASES / (spectrum.power @ aim**2)
        error_db = in_db(float(total))
        if error_db <= (most_db if taps == MOST_TAPS else wanted_db):
            # The filters of the second half mirror those of the first.
            coefficients = np.concatenate([coefficients, coefficients[-2:0:-1, ::-1]])
            return Upsampler(step, coefficients, error_db)
    return None


@functools.lru_cache(maxsize=4)
def _cosines(frequency: bytes) -> NDArray[np.float64]:
    """Return cosines at multiples of 1/PHASES samples, [multiples, frequencies of a spectrum]."""
    positions = np.arange(MOST_TAPS * PHASES) / PHASES
    return np.cos(2 * np.pi * np.outer(positions, np.frombuffer(frequency)))


# Upsampled lines of up to so many bytes are kept, because they are read many times. Larger ones are
# upsampled again for every reading.
_READOUT_BYTES = 1 << 29
_READOUT_LINES = 256  # lines upsampled at once; bounds the memory of their FFTs


@dataclass(frozen=True, eq=False)
class Readout:
    """Range lines with the filter that interpolates them.

    Attributes
    ----------
    lines : RangeLines
    spectrum : Spectrum
    interpolator : Interpolator
    resampling : Resampling
    """

    lines: RangeLines
    spectrum: Spectrum
    interpolator: Interpolator
    resampling: Resampling

    @classmethod
    def of(cls, lines: RangeLines, accuracy_db: float = -70.0) -> Readout:
        """Return the readout of lines with the fastest interpolator for an accuracy, dB."""
        spectrum = measure_spectrum(lines)
        interpolator = choose(spectrum, accuracy_db)
        of_filter = resampling(lines.length, interpolator, spectrum)
        return cls(lines, spectrum, interpolator, of_filter)

    def read(
        self, channels: NDArray[np.int64], range_m: NDArray[np.float64]
    ) -> NDArray[np.complex64]:
        """Return the lines of some channels, each at its own ranges; 0 beyond their ends.

        Parameters
        ----------
        channels : int64 [n]
        range_m : float64 [n, m]

        Returns
        -------
        complex64 [n, m]
            Interpolated samples. The carrier that was mixed out is not restored; see `turned`.
        """
        lines = self.lines
        index = (range_m - lines.first_range_m[channels, None]) / lines.range_step_m
        kept = self._upsampled
        some = self.resampling.apply(lines.samples[channels]) if kept is None else kept[channels]
        values = between(some, index, self.interpolator, self.resampling)
        values[(index < 0) | (index > lines.length - 1)] = 0
        return values

    @functools.cached_property
    def _upsampled(self) -> NDArray[np.complex64] | None:
        """All lines, upsampled; None if they are too large to be kept."""
        lines = self.lines
        if 8 * lines.channels * self.resampling.length > _READOUT_BYTES:
            return None
        kept = np.empty((lines.channels, self.resampling.length), np.complex64)
        for first in range(0, lines.channels, _READOUT_LINES):
            some = slice(first, first + _READOUT_LINES)
            kept[some] = self.resampling.apply(lines.samples[some])
        return kept


def interpolated(
    samples: NDArray[_Complex],
    index: NDArray[np.float64],
    interpolator: Interpolator,
    resampling: Resampling,
) -> NDArray[_Complex]:
    """Return lines between their samples, in their precision.

    Parameters
    ----------
    samples : complex [n, length]
    index : float64 [n, m]
        Positions in samples. Beyond its ends a line falls to zero within the taps of the filter.
    interpolator, resampling : Interpolator, Resampling
    """
    upsampled = cast("NDArray[_Complex]", resampling.apply(samples))
    return between(upsampled, index, interpolator, resampling)


def between(
    upsampled: NDArray[_Complex],
    index: NDArray[np.float64],
    interpolator: Interpolator,
    resampling: Resampling,
) -> NDArray[_Complex]:
    """Return lines between their samples, like `interpolated`, from lines already upsampled."""
    index = index + resampling.lead
    position = index * resampling.ratio - resampling.first
    lower = np.floor(position)
    weights = interpolator.weights(position - lower - 0.5).astype(upsampled.real.dtype)
    first = lower.astype(np.int64) + 1 - interpolator.taps // 2
    total = np.zeros(index.shape, upsampled.dtype)
    last = resampling.length - 1
    ends = first.min(initial=0) < 0 or first.max(initial=0) + interpolator.taps - 1 > last
    lines = resampling.length * np.arange(len(upsampled))[:, None]
    flat = np.ascontiguousarray(upsampled).reshape(-1)
    for tap in range(interpolator.taps):
        at = first + tap
        weight = weights[..., tap]
        if ends:
            weight = weight * ((at >= 0) & (at <= last))
            at = np.clip(at, 0, last)
        total += weight * flat[lines + at]
    if resampling.shift:
        total *= turned(resampling.centre_cycles_per_sample * index)
    return total
