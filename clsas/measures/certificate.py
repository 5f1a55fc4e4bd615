"""Error of a formed image, measured: a few of its pixels are formed again from lines and positions.

Nothing here is shared with the imagers but the containers, the definition of a beam, and rays in
water whose sound speed varies. What an imager assumes, such as a spectrum, a mean track or a band
of phases, is not assumed again.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
import scipy.fft
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.beam import LEAST_WEIGHT_SUM, BeamWindow
from clsas.engine.data.georeference import placed
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines, some_channels
from clsas.engine.data.sound_speed import SoundSpeed, check_reaches
from clsas.engine.data.threads import in_threads
from clsas.engine.data.validate import ArgumentError
from clsas.engine.water.rays import rays

WORST = 5
"""Number of pixels with the largest errors that a certificate lists."""

_PIXELS_AT_ONCE = 1 << 12  # formed again together; these three bound memory
_PAIRS_AT_ONCE = 1 << 13  # of pixels and channels; half or twice as many take as long
_SAMPLES_AT_ONCE = 1 << 17  # of the lines in a block
_POWERS_AT_ONCE = 1 << 16  # pixels whose power is summed together
# Lines are made twice as dense, so that their band fills half of the sampled one. Then 16 taps
# under a Kaiser window leave -120 dB, and linear interpolation between 1024 phases -130 dB.
_TAPS, _PHASES, _KAISER = 16, 1024, 12.3
_PADDING = 64  # zeros at either end of a line, beyond the reach of the taps
_SPECTRA = 512  # lines whose spectra show where the band lies; few of them may lie elsewhere
_OUTSIDE = (1e-6, 1e-4, 1e-3, 1e-2, 5e-2)  # shares of the power that may lie outside the band
_WIDEST = 0.95  # width of a band beside which there is a guard band, cycles per sample
# Of a normal distribution, 97.5 %. With 1.645 (95 %) the bound held in fewer than 95 % of draws of
# 64 pixels from factorized images of random scenes, whose errors have longer tails.
_QUANTILE = 1.96


@dataclass(frozen=True, eq=False)
class Certificate:
    """Measured error of an image, as returned by `certify`.

    Attributes
    ----------
    error_db : float
        Estimate of the relative rms error of the whole image, dB.
    upper_db : float
        Upper bound of that error, dB, meant to hold in 95 of 100 draws of pixels; less often where
        a few pixels have most of the error. It equals `error_db` if all pixels were formed again.
    pixels : int
        Number of pixels drawn. A pixel that was drawn several times counts as often.
    seconds : float
        Time that it took.
    worst : ndarray of int64, shape [n, axes]
        Row and column (for points, the indices) of those formed pixels that err most, the worst
        first; at most 5.
    worst_db : ndarray of float64, shape [n]
        Their errors relative to the rms of the image, dB.

    See Also
    --------
    certify : Function that returns it, with an example.
    """

    error_db: float
    upper_db: float
    pixels: int
    seconds: float
    worst: NDArray[np.int64]
    worst_db: NDArray[np.float64]

    def __repr__(self) -> str:
        """Return the error, its bound, and what they were measured with."""
        return reprs.summary(
            self,
            f"error {self.error_db:.1f} dB",
            f"at most {self.upper_db:.1f} dB",
            f"{self.pixels} pixels in {reprs.quantity(self.seconds, 's')}",
        )


def certify(
    image: Image,
    lines: RangeLines,
    *,
    beam: BeamWindow | None = None,
    pixels: int = 256,
    seed: int | None = None,
) -> Certificate:
    """Return the error of an image, measured at a few pixels that are formed again in float64.

    The pixels are summed from the raw lines and the positions of the antennas by NumPy, by code
    that shares nothing with the imagers. The error therefore includes what no prediction knows,
    such as a fault of the library, of a driver or of a processor, or a beam other than the one
    that the image should have.

    Parameters
    ----------
    image : Image
        Image of these lines, formed by any imager without `accumulate`.
    lines : RangeLines
        Lines from which it was formed.
    beam : BeamWindow, optional
        Weights of the channels that the image should have.
    pixels : int
        Number of pixels to draw. If the image has no more, all of them are formed again, and the
        error is exact.
    seed : int, optional
        Seed of the draw. By default every call draws other pixels.

    Returns
    -------
    Certificate

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type, the grid of the image has another georeference than the
        lines, a sound-speed profile does not include its pixels, or the beam does not suit the
        lines.

    See Also
    --------
    relative_error_db : Error of an image relative to another one.
    plan : Predicts the error of an image before it is formed.

    Notes
    -----
    The ideal image is I(x) = sum_i w_i(x) s_i(rho_i(x)) exp(+j 2 k rho_i(x)). Each line s_i is the
    trigonometric polynomial through its samples and zeros beyond its ends, with frequencies within
    half a cycle per sample of the middle of the band that the lines occupy. It contributes only
    between its first and its last sample.

    Half of the pixels are drawn uniformly, and half in proportion to their power. With q(x) the
    mean of the two probabilities and N the number of pixels, |error|^2/(N q) is an unbiased
    estimate of the mean error power, whether a few pixels are bright or all are speckle.

    A fault in a single pixel of a large image is usually not found. An image without any echo has
    an error of minus infinity if its pixels are 0, and of infinity otherwise.

    Examples
    --------
    >>> import clsas
    >>> import numpy as np
    >>> tx_m = np.stack([np.linspace(-2, 2, 81), np.zeros(81), np.zeros(81)], axis=1)
    >>> point = clsas.PointTargets([[0, 40, 0]])
    >>> lines = clsas.simulate_lines(tx_m, tx_m, point, carrier_hz=100e3, bandwidth_hz=30e3)
    >>> grid = clsas.Grid.plane(x=(-1, 1, 81), y=(39.8, 40.2, 81))
    >>> image = clsas.backproject(lines, grid, accuracy_db=-60)
    >>> certificate = clsas.certify(image, lines, seed=1)
    >>> certificate.upper_db < -60
    True

    An image that was formed with a beam differs from that of all channels:

    >>> wrong = clsas.backproject(lines, grid, beam=clsas.BeamWindow(3.0))
    >>> clsas.certify(wrong, lines, seed=1).error_db > -10
    True
    """
    started = time.perf_counter()
    _check(image, lines, beam)
    pixels = validate.count("pixels", pixels)
    random = np.random.default_rng(None if seed is None else validate.count("seed", seed, least=0))

    formed = image.pixels.reshape(-1)
    drawn, weight, mean_power = _draw(formed, pixels, random)
    some, of_some = np.unique(drawn, return_inverse=True)
    given = formed[some].astype(np.complex128)
    ideal = _formed_again(lines, image.grid.at(some), beam)

    error = _power(given - ideal)
    errors = weight * error[of_some]
    # The mean power of the ideal image differs little from that of the image, which is known.
    differences = weight * (_power(ideal) - _power(given))[of_some]
    ideal_power = mean_power + float(differences.mean())
    if not ideal_power > mean_power / 4:  # far from ideal, so that the difference says nothing
        ideal_power = float((weight * _power(ideal)[of_some]).mean())
    mean = float(errors.mean())
    upper = mean if len(some) == formed.size else _upper(errors)

    worst = np.argsort(error)[::-1][:WORST]
    return Certificate(
        _ratio_db(mean, ideal_power),
        _ratio_db(upper, ideal_power),
        len(drawn),
        time.perf_counter() - started,
        np.stack(np.unravel_index(some[worst], image.shape), axis=1),
        np.array([_ratio_db(float(each), ideal_power) for each in error[worst]]),
    )


def _check(image: Image, lines: RangeLines, beam: BeamWindow | None) -> None:
    """Raise an error unless the image may be one of these lines with this beam."""
    validate.instance("image", image, Image)
    validate.instance("lines", lines, RangeLines)
    validate.instance("beam", beam, BeamWindow, type(None))
    placed(lines, image.grid)
    if beam is not None and beam.shape == "inverse" and not lines.carrier_hz:
        raise ArgumentError("carrier_hz", "be above 0 for a beam of shape 'inverse'")
    farthest_m = float(np.abs([lines.first_range_m, lines.last_range_m]).max())
    validate.phase(lines.carrier_hz, lines.sound_speed_m_s, farthest_m)
    if lines.sound_speed is not None:
        check_reaches(lines.sound_speed, [each[2] for each in image.grid.bounds_m], "pixels")


def _draw(
    formed: NDArray[np.complex64], count: int, random: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.float64], float]:
    """Return the numbers of the pixels drawn, their weights 1/(N q), and the image's mean power.

    Both halves are stratified: each draw has an equal part of all pixels, or of all power, of its
    own.
    """
    size = len(formed)
    starts = np.arange(0, size, _POWERS_AT_ONCE)
    until = np.cumsum([_power(formed[first : first + _POWERS_AT_ONCE]).sum() for first in starts])
    total = float(until[-1])
    if count >= size:
        return np.arange(size), np.ones(size), total / size

    by_power = count // 2 if total else 0
    uniform = count - by_power
    drawn = np.empty(count, np.int64)
    drawn[:uniform] = (np.arange(uniform) + random.random(uniform)) * (size / uniform)
    wanted = (np.arange(by_power) + random.random(by_power)) * (total / max(by_power, 1))
    part = np.minimum(np.searchsorted(until, wanted, side="right"), len(until) - 1)
    for number in np.unique(part):
        first, here = starts[number], part == number
        sums = np.cumsum(_power(formed[first : first + _POWERS_AT_ONCE]))
        sums += until[number] - sums[-1]
        index = np.searchsorted(sums, wanted[here], side="right")
        drawn[uniform:][here] = first + np.minimum(index, len(sums) - 1)
    np.minimum(drawn, size - 1, out=drawn)

    share = uniform / count
    of_power = _power(formed[drawn]) * (size / total) if total else np.zeros(count)
    return drawn, 1 / (share + (1 - share) * of_power), total / size


def _formed_again(
    lines: RangeLines, points_m: NDArray[np.float64], beam: BeamWindow | None
) -> NDArray[np.complex128]:
    """Return the ideal image at some points, complex128 [points]."""
    middle = _middle_of_band(lines.samples)
    along = None if beam is None else beam.directions(lines)
    image = np.zeros(len(points_m), np.complex128)
    for first in range(0, len(points_m), _PIXELS_AT_ONCE):
        part = slice(first, first + _PIXELS_AT_ONCE)
        points, weights = points_m[part], np.zeros(len(points_m[part]))
        step = max(min(_PAIRS_AT_ONCE // len(points), _SAMPLES_AT_ONCE // lines.length), 1)
        blocks = [slice(start, start + step) for start in range(0, lines.channels, step)]
        work = partial(_sums, lines, points, middle, beam, along)
        for contributions, of_channels in in_threads(work, blocks):
            image[part] += contributions
            weights += of_channels
        if beam is not None and beam.normalise:
            image[part] *= lines.channels / np.maximum(weights, LEAST_WEIGHT_SUM)
    return image


def _sums(
    lines: RangeLines,
    points_m: NDArray[np.float64],
    middle: float,
    beam: BeamWindow | None,
    along: NDArray[np.float64] | None,
    channels: slice,
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Return what some channels contribute to points, and the sums of their weights, [points]."""
    lines = lines.select(channels)
    range_m = _ranges_m(lines, points_m)
    position = (range_m - lines.first_range_m[:, None]) / lines.range_step_m
    counts = (position >= 0) & (position <= lines.length - 1)
    weights = np.ones(range_m.shape)
    if beam is not None and along is not None:
        weights = beam.weights(_sines(lines, points_m, along[channels]), _wavelength_m(lines))
        counts &= weights != 0
    contributions = np.zeros(range_m.shape, np.complex128)
    received = counts.any(axis=1)
    if received.any():
        dense = _twice_as_dense(lines.samples[received], middle)
        row = (np.cumsum(received) - 1)[np.nonzero(counts)[0]]
        at = position[counts]
        values = _interpolated(dense, row, 2 * (at + _PADDING))
        cycles = middle * at + 2 * lines.carrier_hz / lines.sound_speed_m_s * range_m[counts]
        contributions[counts] = weights[counts] * values * np.exp(2j * np.pi * np.mod(cycles, 1))
    return contributions.sum(axis=0), weights.sum(axis=0)


def _ranges_m(lines: RangeLines, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ranges of points, half the two-way path, [channels, points], metres.

    With times in metres of path, |x - tx| = R and |x - rx - v t| = t - R. That is a quadratic in
    t, whose larger root is the delay. Where no ray arrives, the range is infinite.
    """
    profile, speed_m_s = lines.sound_speed, lines.sound_speed_m_s
    out_m = _distances_m(profile, speed_m_s, points_m, lines.tx_m)
    if lines.rx_velocity_m_s is None:
        return (out_m + _distances_m(profile, speed_m_s, points_m, lines.rx_m)) / 2
    v = lines.rx_velocity_m_s / speed_m_s
    if profile is not None:
        path_m = 2 * out_m
        for _ in range(8):  # each leaves v of the error
            path_m = out_m + _distances_m(
                profile,
                speed_m_s,
                points_m,
                lines.rx_m,
                np.where(np.isfinite(path_m), path_m, 0),
                v,
            )
        return path_m / 2
    d = [points_m[:, axis] - lines.rx_m[:, axis, None] for axis in range(3)]
    square = 1 - np.sum(v * v, axis=1)[:, None]
    half = out_m - sum(d[axis] * v[:, axis, None] for axis in range(3))
    rest = out_m**2 - sum(each**2 for each in d)
    return (half + np.sqrt(half**2 - square * rest)) / square / 2


def _distances_m(
    profile: SoundSpeed | None,
    speed_m_s: float,
    points_m: NDArray[np.float64],
    antennas_m: NDArray[np.float64],
    path_m: NDArray[np.float64] | float = 0.0,
    velocity: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Return one-way paths, [channels, points]: distances, or times along rays as such."""
    x, y, z = (points_m[:, axis] - antennas_m[:, axis, None] for axis in range(3))
    if velocity is not None:
        x, y, z = (each - velocity[:, axis, None] * path_m for axis, each in enumerate((x, y, z)))
    if profile is None:
        return np.sqrt(x * x + y * y + z * z)
    return speed_m_s * rays(profile, np.hypot(x, y), points_m[:, 2] - z, points_m[:, 2]).time_s


def _sines(
    lines: RangeLines, points_m: NDArray[np.float64], along: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the sines of aspect angles, [channels, points]; 0 at a phase centre itself.

    In water whose speed varies, they are those of the rays where they leave the phase centres.
    """
    centres_m = (lines.tx_m + lines.rx_m) / 2
    x, y, z = (points_m[:, axis] - centres_m[:, axis, None] for axis in range(3))
    if lines.sound_speed is None:
        distance_m = np.sqrt(x * x + y * y + z * z)
    else:
        level_m = np.hypot(x, y)
        found = rays(lines.sound_speed, level_m, centres_m[:, 2, None], points_m[:, 2])
        speed_m_s = lines.sound_speed.at(centres_m[:, 2])[:, None]
        # The direction (x, y, z) / distance_m of the ray, whose level part is slowness times speed.
        distance_m = level_m / np.where(found.exists, found.slowness_s_m * speed_m_s, 1.0)
        z = np.where(found.exists, -found.one_slope_s_m * speed_m_s * distance_m, z)
    sine = sum(each * along[:, axis, None] for axis, each in enumerate((x, y, z)))
    return np.divide(sine, distance_m, out=np.zeros_like(distance_m), where=distance_m > 0)


def _wavelength_m(lines: RangeLines) -> float:
    """Return the wavelength of the carrier at the antennas, which weights of elements need."""
    if not lines.carrier_hz:
        return math.inf
    if lines.sound_speed is None:
        return lines.sound_speed_m_s / lines.carrier_hz
    heights_m = (lines.tx_m[:, 2] + lines.rx_m[:, 2]) / 2
    return float(lines.sound_speed.at(heights_m).mean()) / lines.carrier_hz


def _middle_of_band(samples: NDArray[np.complex64]) -> float:
    """Return the middle of the band that lines occupy, cycles per sample.

    The band leaves out as little power as possible and yet has a guard band beside it. It does not
    contain half the sample rate if that is quiet; else it is the narrowest arc of the circle of
    frequencies. A white floor of noise does not count.
    """
    some = samples[some_channels(len(samples), _SPECTRA)]
    window = np.sin(np.pi * (np.arange(some.shape[1]) + 0.5) / some.shape[1]) ** 2
    bins = scipy.fft.next_fast_len(max(some.shape[1], 64))
    power = sum((_power(scipy.fft.fft(line * window, bins)) for line in some), np.zeros(bins))
    if not power.any():
        return 0.0
    width = max(bins // 16, 1)
    floor = np.convolve(np.tile(power, 2), np.ones(width) / width, "valid").min()
    power = np.maximum(power - 2 * floor, 0) if (power > 2 * floor).any() else power
    until = np.cumsum(np.append(0, np.tile(power, 2)))
    ascending = np.cumsum(scipy.fft.fftshift(power)) / power.sum()
    for outside in _OUTSIDE:
        low, high = np.searchsorted(ascending, [outside / 2, 1 - outside / 2])
        if high - low + 1 <= _WIDEST * bins:
            return float((low + high) / 2 - bins // 2) / bins
        ends = np.searchsorted(until, until[:bins] + (1 - outside) * until[bins])
        lengths = ends - np.arange(bins)
        first = int(lengths.argmin())
        if lengths[first] <= _WIDEST * bins:
            break
    return ((first + (int(lengths[first]) - 1) / 2) / bins + 0.5) % 1 - 0.5


def _twice_as_dense(samples: NDArray[np.complex64], middle: float) -> NDArray[np.complex128]:
    """Return lines moved to 0 Hz and twice as dense, with `_PADDING` zeros around them."""
    length = samples.shape[1]
    bins = scipy.fft.next_fast_len(length + 2 * _PADDING)
    lines = np.zeros((len(samples), bins), np.complex128)
    turns = np.exp(-2j * np.pi * np.mod(middle * np.arange(length), 1))
    np.multiply(samples, turns, out=lines[:, _PADDING : _PADDING + length])
    spectra = scipy.fft.fft(lines, axis=1, norm="forward", overwrite_x=True)
    wide = np.zeros((len(samples), 2 * bins), np.complex128)
    positive = (bins + 1) // 2
    wide[:, :positive] = spectra[:, :positive]
    wide[:, positive - bins :] = spectra[:, positive:]
    return scipy.fft.ifft(wide, axis=1, norm="forward", overwrite_x=True)


def _interpolated(
    dense: NDArray[np.complex128], row: NDArray[np.int64], at: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """Return the values of lines at some positions, of a band that fills half the sampled one."""
    whole = at.astype(np.int64)
    phase = (at - whole) * _PHASES
    entry = phase.astype(np.int64)
    table = _taps()
    weights = table[entry]
    weights += (phase - entry)[:, None] * (table[entry + 1] - weights)
    first = row * dense.shape[1] + whole - (_TAPS // 2 - 1)
    values = sliding_window_view(dense.reshape(-1), _TAPS)[first]
    return np.einsum("nt,nt->n", values, weights)


@cache
def _taps() -> NDArray[np.float64]:
    """Return the taps of a sinc under a Kaiser window for every phase, [phases, taps]."""
    number = np.arange(_TAPS) - (_TAPS // 2 - 1)
    offset = np.arange(_PHASES + 2)[:, None] / _PHASES - number
    inside = np.sqrt(np.maximum(1 - (2 * offset / _TAPS) ** 2, 0))
    return np.sinc(offset) * np.i0(_KAISER * inside) / np.i0(_KAISER)


def _upper(errors: NDArray[np.float64]) -> float:
    """Return an upper 95 % bound of the mean of errors.

    Errors have a long upper tail, so that estimates are too low more often than too high. The third
    moment corrects this (Johnson 1978).
    """
    count, mean, deviation = len(errors), float(errors.mean()), float(errors.std())
    if count < 2:
        return math.inf
    if not deviation:
        return mean
    skewness = float((((errors - mean) / deviation) ** 3).mean())
    quantile = _QUANTILE + skewness / 6 / math.sqrt(count) * (1 + 2 * _QUANTILE**2)
    return mean + quantile * deviation / math.sqrt(count - 1)


def _power(values: NDArray) -> NDArray[np.float64]:
    return values.real.astype(np.float64) ** 2 + values.imag.astype(np.float64) ** 2


def _ratio_db(power: float, of: float) -> float:
    """Return 10 log10(power / of); minus infinity for no power, and infinity if only `of` is 0."""
    if not power:
        return -math.inf
    return 10 * math.log10(power / of) if of else math.inf
