"""Error of a formed image, measured: a few of its pixels are formed again from lines and positions.

Nothing here is shared with the imagers but the containers, the definition of a beam, the device,
and rays in water whose sound speed varies. What an imager assumes, such as a spectrum, a mean track
or a band of phases, is not assumed again.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from functools import cache, partial
from types import EllipsisType
from typing import Annotated

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from clsas.engine.data import validate
from clsas.engine.data.beam import LEAST_WEIGHT_SUM, BeamWindow
from clsas.engine.data.certificate import Certificate
from clsas.engine.data.decibels import in_db
from clsas.engine.data.declared import Count, Flag, check_declared
from clsas.engine.data.digests import samples_digest
from clsas.engine.data.georeference import placed
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines, some_channels
from clsas.engine.data.sound_speed import SoundSpeed, check_reaches
from clsas.engine.data.threads import in_threads
from clsas.engine.data.validate import ArgumentError
from clsas.engine.device.device import Device, open_device
from clsas.engine.water.rays import rays

PIXELS = 256
"""Number of pixels at which an error is measured by default."""
WORST = 5
"""Number of pixels with the largest errors that a certificate lists."""

_PIXELS_AT_ONCE = 1 << 12  # formed again together; these three bound memory
_PAIRS_AT_ONCE = 1 << 16  # of pixels and channels
_SAMPLES_AT_ONCE = 1 << 22  # of the lines in a block
_BLOCK = 1 << 10  # pixels whose power is summed together
_DRAWN_AT_ONCE = 1 << 11  # bounds memory for the blocks of the pixels drawn

# Filters are sincs under a Kaiser window. They need the longer a window, the less they may leave,
# and the narrower the guard band is. Interpolation between phases leaves -115 dB.
_PHASES = 512
_TAPS = (12, 16, 20, 24, 28, 32, 40, 48, 56, 64)  # tried before lines are made twice as dense
_DENSE_TAPS = 20  # enough for -120 dB if lines are twice as dense
_STOPBANDS_DB = (70.0, 120.0)  # least and most
_BELOW_TOLERANCE_DB = 25.0  # by which filters are better than an image may be
_SLACK_DB = 5.0  # by which the error of a filter may exceed that of its stop band
_GROUP = 16  # channels that a work-item adds up in single precision
_POINTS, _POINTS_OF_GPU = 64, 16  # for which it does so
_PADDING = 64  # zeros at either end of a line that is made denser, beyond the reach of the taps

_SPECTRA, _SPECTRUM_SAMPLES = 256, 256  # pieces of lines that show where the band lies
_SPECTRUM_POINTS = 16  # around which they lie, at least
_OUTSIDE = (1e-6, 1e-4, 1e-3, 1e-2, 5e-2)  # shares of the power that may lie outside the band
_WIDEST = 0.95  # width of a band beside which there is a guard band, cycles per sample
_GUARD, _QUIET = 0.0125, 0.25  # half the width of a guard band, and its most power, of the mean


def certify(
    image: Image,
    lines: RangeLines,
    *,
    beam: BeamWindow | EllipsisType | None = ...,
    pixels: Annotated[int, Count(help="Number of pixels to form again.")] = PIXELS,
    seed: Annotated[
        int | None, Count(0, help="Seed of the draw of pixels.", default="others every time")
    ] = None,
    scale: Annotated[
        bool, Flag("Fit a complex factor by which the image may differ from the ideal one.")
    ] = False,
    device: Device | str | int | None = None,
) -> Certificate:
    """Return the error of an image, measured at a few pixels that are formed again.

    The pixels are summed from the raw lines and the positions of the antennas, with ranges and
    phases in float64, by code that shares nothing with the imagers. The error therefore includes
    what no prediction knows, such as a fault of the library or of another program.

    Parameters
    ----------
    image : Image
        Image of these lines, formed by any imager or program, without `accumulate`.
    lines : RangeLines
        Lines from which it was formed.
    beam : BeamWindow or None, optional
        Weights of the channels that the image should have; None for no weights. If left out, the
        beam is that of `image.formed`.
    pixels : int
        Number of pixels to draw. If the image has no more, all of them are formed again, and the
        error is exact.
    seed : int, optional
        Seed of the draw. By default every call draws other pixels.
    scale : bool
        Whether the image may differ from the ideal one by a complex factor, as those of other
        programs do. The factor is fitted, and the error is that of the rest.
    device : Device, str or int, optional
        Device that adds up the samples; see `clsas.engine.device.device.choose`.

    Returns
    -------
    Certificate

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type, the grid of the image has another georeference than the
        lines, a sound-speed profile does not include its pixels, or the beam does not suit the
        lines or is None for an image that was formed with one. If there is nothing to measure,
        because the lines have no echoes at the pixels, or because their band fills the whole
        sampled band, so that no interpolation is right.
    DeviceError
        If the device does not exist.

    Warns
    -----
    ClsasWarning
        If the image was formed from other lines.

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

    A quarter of the pixels is drawn uniformly, half about in proportion to their amplitude, and a
    quarter in proportion to their power. With q(x) the mean probability of a pixel and N the number
    of pixels, |error|^2/(N q) is an unbiased estimate of the mean error power, whether a few pixels
    are bright or all are speckle.

    A fault in a single pixel of a large image is usually not found. Where lines do not fade towards
    an end, values between their samples depend on how they are continued, near the end by -30 dB or
    more of its power, so that no error much smaller has a meaning there.

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
    >>> pixels_only = clsas.Image(wrong.pixels, grid)
    >>> clsas.certify(pixels_only, lines, seed=1).error_db > -10
    True
    """
    validate.instance("image", image, Image)
    validate.instance("lines", lines, RangeLines)
    formed = image.formed
    formed_beam = None if formed is None else formed.beam
    if beam is ...:
        beam = formed_beam
    validate.instance("beam", beam, BeamWindow, type(None))
    if beam is None and formed_beam is not None:
        allowed = "be that of `image.formed`, or be left out"
        raise ArgumentError("beam", allowed, "None for an image that was formed with a beam")
    if formed and formed.method != "mosaic" and formed.lines_digest != samples_digest(lines):
        validate.warn("the image was formed from other lines than those given")
    asked = check_declared(certify, {"pixels": pixels, "seed": seed, "scale": scale})
    measurement = Measurement(image, lines, beam, open_device(device), asked["seed"])
    measurement.draw(asked["pixels"])
    return measurement.certificate(scale=asked["scale"])


class Measurement:
    """Error of an image, measured at more and more pixels.

    Parameters
    ----------
    image, lines, beam
        As for `certify`.
    device : Device
    seed : int, optional
    tolerance_db : float, optional
        Tolerance of the image, dB. Filters are as long as it needs.

    Raises
    ------
    ValueError
        If lines, beam and image do not suit each other, or the band of the lines fills the whole
        sampled band.
    """

    def __init__(
        self,
        image: Image,
        lines: RangeLines,
        beam: BeamWindow | None,
        device: Device,
        seed: int | None = None,
        *,
        tolerance_db: float | None = None,
    ) -> None:
        started = time.perf_counter()
        _check(image, lines, beam)
        self._image, self._lines, self._beam, self._device = image, lines, beam, device
        self._random = np.random.default_rng(seed)
        self._formed = image.pixels.reshape(-1)
        self._power = _power_of_blocks(self._formed)
        self._ideal: IdealImage | None = None
        self._drawn = np.zeros(0, np.int64)
        self._weight = np.zeros(0)
        self._values = np.zeros(0, np.complex128)
        below_db = math.inf if tolerance_db is None else _BELOW_TOLERANCE_DB - tolerance_db
        self._stopband_db = float(np.clip(below_db, *_STOPBANDS_DB))
        self.seconds = time.perf_counter() - started

    @property
    def is_complete(self) -> bool:
        """True if all pixels have been formed again."""
        return len(self._drawn) == len(self._formed)

    def draw(self, count: int) -> None:
        """Form `count` more pixels again, or all of them if the image has no more in all."""
        started = time.perf_counter()
        if len(self._drawn) + count >= len(self._formed):
            self._drawn, self._weight = np.arange(len(self._formed)), np.ones(len(self._formed))
            self._values, some = np.zeros(0, np.complex128), self._drawn
        else:
            rounds = [
                _draw(self._formed, self._power, min(_DRAWN_AT_ONCE, count - first), self._random)
                for first in range(0, count, _DRAWN_AT_ONCE)
            ]
            some, weight = (np.concatenate(each) for each in zip(*rounds, strict=True))
            self._drawn = np.append(self._drawn, some)
            self._weight = np.append(self._weight, weight)
        self._values = np.append(self._values, self.ideal(some))
        self.seconds += time.perf_counter() - started

    def sharpen(self) -> None:
        """Form the pixels drawn so far again with the best filters."""
        started = time.perf_counter()
        self._ideal, self._stopband_db = None, _STOPBANDS_DB[1]
        self._values = self.ideal(self._drawn)
        self.seconds += time.perf_counter() - started

    def ideal(self, numbers: NDArray[np.int64]) -> NDArray[np.complex128]:
        """Return pixels of the ideal image, whose flat numbers are given."""
        numbers, of_number = np.unique(numbers, return_inverse=True)
        points_m = self._image.grid.at(numbers)
        if self._ideal is None:
            self._ideal = IdealImage(
                self._lines, self._beam, self._device, points_m, self._random, self._stopband_db
            )
        return self._ideal.at(points_m)[of_number]

    def certificate(self, *, scale: bool = False) -> Certificate:
        """Return the error measured at the pixels drawn so far."""
        given, ideal, weight = self._formed[self._drawn], self._values, self._weight
        given = given.astype(np.complex128)
        size, count = len(self._formed), len(self._drawn)
        if scale and (energy := (weight * _power(ideal)).sum()):
            factor = (weight * ideal.conj() * given).sum() / energy
            ideal = ideal * (factor or 1.0)  # no factor makes an image of zeros
        error = _power(given - ideal)
        # The mean power of the ideal image differs little from that of the image, which is known.
        known = float(self._power.sum()) / size
        power = known + float((weight * (_power(ideal) - _power(given))).mean())
        if not power > known / 4:  # far from ideal, so that the difference says nothing
            power = float((weight * _power(ideal)).mean())
        if not power:
            raise ArgumentError(
                "lines",
                "have echoes at the pixels of the image, to measure its error",
                "none there" if known else "none there, and an image of zeros",
            )
        errors = weight * error / power
        mean, variance, third = float(errors.mean()), 0.0, 0.0
        if count < size and count > 1:
            variance = float(errors.var()) / (count - 1)
            third = float(((errors - mean) ** 3).mean()) / count**2
        _, first = np.unique(self._drawn, return_index=True)
        worst = first[np.argsort(error[first])[::-1][:WORST]]
        return Certificate(
            pixels=count,
            of_pixels=size,
            seconds=self.seconds,
            power=power,
            error=mean,
            error_variance=variance,
            error_third=third,
            worst=np.stack(np.unravel_index(self._drawn[worst], self._image.shape), axis=1),
            worst_db=in_db(error[worst] / power),
        )


def _check(image: Image, lines: RangeLines, beam: BeamWindow | None) -> None:
    """Raise an error unless the image may be one of these lines with this beam."""
    placed(lines, image.grid)
    if beam is not None and beam.shape == "inverse" and not lines.carrier_hz:
        raise ArgumentError("carrier_hz", "be above 0 for a beam of shape 'inverse'")
    farthest_m = float(np.abs([lines.first_range_m, lines.last_range_m]).max())
    validate.phase(lines.carrier_hz, lines.sound_speed_m_s, farthest_m)
    if lines.sound_speed is not None:
        check_reaches(lines.sound_speed, [each[2] for each in image.grid.bounds_m], "pixels")


def _power_of_blocks(formed: NDArray[np.complex64]) -> NDArray[np.float64]:
    """Return the power of all pixels of every block of `_BLOCK`."""
    parts = np.ascontiguousarray(formed).view(np.float32)
    whole = parts[: len(parts) // (2 * _BLOCK) * 2 * _BLOCK].reshape(-1, 2 * _BLOCK)
    pieces = [whole, parts[whole.size :][None]] if whole.size < len(parts) else [whole]
    with np.errstate(over="ignore"):
        power = np.concatenate([np.einsum("bn,bn->b", each, each) for each in pieces])
    if not 1e-20 < power.sum() < 1e38:  # squares may over- or underflow
        power = np.concatenate([(each.astype(np.float64) ** 2).sum(axis=1) for each in pieces])
    return power.astype(np.float64)


def _draw(
    formed: NDArray[np.complex64],
    power: NDArray[np.float64],
    count: int,
    random: np.random.Generator,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the numbers of the pixels drawn, and their weights 1/(N q).

    A block is drawn by the amplitude that its pixels would have if all were equally bright, or by
    its power, and then a pixel of it by its amplitude or power. Draws are stratified: each has an
    equal part of all pixels, or of all amplitude or power, of its own.
    """
    size = len(formed)
    length = np.minimum(_BLOCK, size - _BLOCK * np.arange(len(power)))
    of_block = (np.sqrt(length * power), power)
    counts = (count // 2, count // 4) if power.any() else (0, 0)
    uniform = count - sum(counts)
    drawn = [(_stratified(uniform, random) * size).astype(np.int64)]
    for order, (number, weights) in enumerate(zip(counts, of_block, strict=True), start=1):
        until = np.cumsum(weights)
        wanted = _stratified(number, random) * until[-1]
        block = np.minimum(np.searchsorted(until, wanted, side="right"), len(power) - 1)
        left = (until[block] - wanted) / np.maximum(weights[block], 1e-300)
        sums = np.cumsum(_amplitudes(formed, block) ** order, axis=1)
        index = (sums <= (1 - left)[:, None] * sums[:, -1:]).sum(axis=1)
        drawn.append(block * _BLOCK + np.minimum(index, _BLOCK - 1))
    some = np.minimum(np.concatenate(drawn), size - 1)

    density, block = np.full(count, uniform / count), some // _BLOCK
    amplitude, amplitudes = np.abs(formed[some]).astype(np.float64), _amplitudes(formed, block)
    for order, (number, weights) in enumerate(zip(counts, of_block, strict=True), start=1):
        if number:
            per_pixel = weights[block] / (amplitudes**order).sum(axis=1).clip(1e-300)
            density += number / count * amplitude**order * per_pixel * (size / weights.sum())
    return some, 1 / density


def _stratified(count: int, random: np.random.Generator) -> NDArray[np.float64]:
    """Return numbers from 0 to 1, one in each of `count` equal intervals."""
    return (np.arange(count) + random.random(count)) / max(count, 1)


def _amplitudes(formed: NDArray[np.complex64], blocks: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the amplitudes of the pixels of some blocks, 0 beyond the last pixel."""
    index = blocks[:, None] * _BLOCK + np.arange(_BLOCK)
    amplitude = np.abs(formed[np.minimum(index, len(formed) - 1)]).astype(np.float64)
    return np.where(index < len(formed), amplitude, 0.0)


class IdealImage:
    """Pixels of the ideal image of lines, summed over all channels.

    Parameters
    ----------
    lines, beam
        As for `certify`.
    device : Device
    points_m : float64 [points, 3]
        Some of the pixels. The samples around them show which band the lines occupy.
    random : Generator
    stopband_db : float
        Attenuation outside the pass band of the filters, dB. They leave about as little error.

    Raises
    ------
    ValueError
        If the band fills the whole sampled band.
    """

    def __init__(
        self,
        lines: RangeLines,
        beam: BeamWindow | None,
        device: Device,
        points_m: NDArray[np.float64],
        random: np.random.Generator,
        stopband_db: float = _STOPBANDS_DB[1],
    ) -> None:
        self._lines, self._beam, self._device = lines, beam, device
        self._geometry = lines.without_samples()
        self._along = None if beam is None else beam.directions(lines)
        power = _spectrum(lines.samples, self._geometry, points_m, random)
        self._middle = _middle_of_band(power)
        self._taps, self._denser = _filter_for(power, self._middle, stopband_db)
        middle = 0.0 if self._denser > 1 else self._middle
        self._filters = device.upload(_complex_taps(self._taps, stopband_db, middle))
        # On a CPU, one work-item reads the samples of a line for many points in turn.
        self._points_together = _POINTS if device.info.width > 1 else _POINTS_OF_GPU
        self._kernel = device.kernel(
            "sum_pixels", PHASES=_PHASES, GROUP=_GROUP, POINTS=self._points_together
        )

    def at(self, points_m: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the pixels at some points [points, 3], metres; complex128 [points]."""
        lines, beam = self._lines, self._beam
        image = np.zeros(len(points_m), np.complex128)
        nearest_first = np.argsort(cdist(points_m, lines.tx_m[:1])[:, 0])  # lines are read in order
        points_m = points_m[nearest_first]
        for first in range(0, len(points_m), _PIXELS_AT_ONCE):
            part = slice(first, first + _PIXELS_AT_ONCE)
            points, weights = points_m[part], np.zeros(len(points_m[part]))
            step = max(min(_PAIRS_AT_ONCE // len(points), _SAMPLES_AT_ONCE // lines.length), 1)
            blocks = [slice(start, start + step) for start in range(0, lines.channels, step)]
            pairs_of = partial(self._pairs, points)
            for pairs in in_threads(pairs_of, blocks) if len(blocks) > 1 else map(pairs_of, blocks):
                image[part] += self._summed(pairs)
                weights += pairs.weight.sum(axis=0)
            if beam is not None and beam.normalise:
                image[part] *= lines.channels / np.maximum(weights, LEAST_WEIGHT_SUM)
        image[nearest_first] = image.copy()
        return image

    def _pairs(self, points_m: NDArray[np.float64], channels: slice) -> _Pairs:
        """Return where some channels receive from points, and how they add up."""
        lines, length = self._geometry.select(channels), self._lines.length
        range_m = _ranges_m(lines, points_m)
        position = range_m - lines.first_range_m[:, None]
        position /= lines.range_step_m
        counts = (position >= 0) & (position <= length - 1)
        weight = np.ones(range_m.shape)
        if self._beam is not None and self._along is not None:
            sines = _sines(lines, points_m, self._along[channels])
            weight = self._beam.weights(sines, _wavelength_m(lines))
        position[~counts] = range_m[~counts] = 0.0  # also where no ray arrives
        cycles = range_m
        cycles *= 2 * lines.carrier_hz / lines.sound_speed_m_s
        samples = self._lines.samples[channels]
        if self._denser > 1:
            cycles += self._middle * position
            samples = _twice_as_dense(samples, self._middle)
            position = 2 * (position + _PADDING)
        whole = position.astype(np.int32)
        fraction = np.subtract(position, whole, out=position)
        if self._denser == 1:
            cycles += self._middle * fraction
        cycles -= np.rint(cycles)
        phase = cycles.astype(np.float32)
        phase *= np.float32(2 * np.pi)
        counted = (weight * counts).astype(np.float32)
        factors = np.empty(phase.shape, np.complex64)
        np.multiply(np.cos(phase), counted, out=factors.real)
        np.multiply(np.sin(phase), counted, out=factors.imag)
        return _Pairs(samples, whole, fraction.astype(np.float32), factors, weight)

    def _summed(self, pairs: _Pairs) -> NDArray[np.complex128]:
        """Return the sums over the channels of pairs, [points]."""
        channels, points = pairs.whole.shape
        sums = np.empty((-(-channels // _GROUP), points), np.complex64)
        device = self._device
        result = device.share(sums)
        device.run(
            self._kernel,
            (-(-points // self._points_together), len(sums)),
            samples=device.share(pairs.samples),
            length=pairs.samples.shape[1],
            filters=self._filters,
            taps=self._taps,
            whole=device.share(pairs.whole),
            fraction=device.share(pairs.fraction),
            factors=device.share(pairs.factors),
            channels=channels,
            points=points,
            sums=result,
        )
        device.read(result, sums)
        return sums.sum(axis=0, dtype=np.complex128)


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Samples of some channels, and positions and factors by which they add up at some points.

    All but the samples are [channels, points]. Factors turn phases and weigh. They are 0 where a
    line does not reach a point.
    """

    samples: NDArray[np.complex64]
    whole: NDArray[np.int32]
    fraction: NDArray[np.float32]
    factors: NDArray[np.complex64]
    weight: NDArray[np.float64]


def _ranges_m(lines: RangeLines, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ranges of points, half the two-way path, [channels, points], metres.

    With times in metres of path, |x - tx| = R and |x - rx - v t| = t - R. That is a quadratic in
    t, whose larger root is the delay. Where no ray arrives, the range is infinite.
    """
    profile, speed_m_s = lines.sound_speed, lines.sound_speed_m_s
    out_m = _distances_m(profile, speed_m_s, points_m, lines.tx_m)
    if not lines.paths_differ:
        return out_m
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
    root = np.maximum(half**2 - square * rest, 0.0)  # below 0 only by rounding
    return (half + np.sqrt(root)) / square / 2


def _distances_m(
    profile: SoundSpeed | None,
    speed_m_s: float,
    points_m: NDArray[np.float64],
    antennas_m: NDArray[np.float64],
    path_m: NDArray[np.float64] | float = 0.0,
    velocity: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Return one-way paths, [channels, points]: distances, or times along rays as such."""
    if profile is None:
        return cdist(antennas_m, points_m)
    x, y, z = (points_m[:, axis] - antennas_m[:, axis, None] for axis in range(3))
    if velocity is not None:
        x, y, z = (each - velocity[:, axis, None] * path_m for axis, each in enumerate((x, y, z)))
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


def _spectrum(
    samples: NDArray[np.complex64],
    geometry: RangeLines,
    points_m: NDArray[np.float64],
    random: np.random.Generator,
) -> NDArray[np.float64]:
    """Return the power spectrum of pieces of lines around points, frequencies as in FFTs.

    A line that is cut off near a point has all frequencies there.
    """
    channels, length = some_channels(geometry.channels, _SPECTRA), samples.shape[1]
    points = max(_SPECTRUM_POINTS, -(-_SPECTRA // len(channels)))
    points_m = points_m[random.integers(len(points_m), size=points)]
    some = geometry.select(channels)
    position = (_ranges_m(some, points_m) - some.first_range_m[:, None]) / some.range_step_m
    middle = np.clip(np.nan_to_num(position), 0, length - 1).astype(np.int64)
    piece = np.arange(_SPECTRA)
    row, column = piece % len(channels), (piece + piece // len(channels)) % points
    power = _power_of_pieces(samples, channels[row], middle[row, column])
    if not power.any():  # silent there, so take pieces of the loudest lines
        energy = np.einsum("cs,cs->c", samples, samples.conj()).real
        loudest = np.argsort(energy)[-_SPECTRUM_POINTS:]
        power = _power_of_pieces(samples, loudest, np.abs(samples[loudest]).argmax(axis=1))
    return power


def _power_of_pieces(
    samples: NDArray[np.complex64], channels: NDArray[np.int64], middle: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the power spectrum of pieces of some lines around a sample of each."""
    index = middle[:, None] + np.arange(_SPECTRUM_SAMPLES) - _SPECTRUM_SAMPLES // 2
    taken = samples[channels[:, None], np.clip(index, 0, samples.shape[1] - 1)]
    window = np.sin(np.pi * (np.arange(_SPECTRUM_SAMPLES) + 0.5) / _SPECTRUM_SAMPLES) ** 4
    inside = (index >= 0) & (index < samples.shape[1])
    taken = taken * np.where(inside, window, 0).astype(np.float32)
    return _power(scipy.fft.fft(taken, axis=-1)).sum(axis=0)


def _middle_of_band(power: NDArray[np.float64]) -> float:
    """Return the middle of the band that lines with a power spectrum occupy, cycles per sample.

    Raises
    ------
    ValueError
        If there is no guard band around the frequency half a cycle per sample away from it.
    """
    bins, middle = len(power), _least_power_outside(power)
    apart = (scipy.fft.fftfreq(bins) - middle + 0.5) % 1 - 0.5
    guard = power[np.abs(apart) > 0.5 - _GUARD]
    if guard.mean() <= _QUIET * power.mean():
        return middle
    raise ArgumentError(
        "lines",
        "leave a part of the sampled band empty, without which their values between samples, and "
        "so the error of an image, are not defined",
        "power throughout the sampled band",
    )


def _least_power_outside(power: NDArray[np.float64]) -> float:
    """Return the middle of the band that leaves out as little power as possible.

    It has a guard band beside it if that is possible. It does not contain half the sample rate if
    that is quiet; else it is the narrowest arc of the circle of frequencies. A white floor of noise
    does not count.
    """
    bins = len(power)
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


def _filter_for(power: NDArray[np.float64], middle: float, stopband_db: float) -> tuple[int, int]:
    """Return the taps with which lines are interpolated, and by how much they are made denser."""
    frequency = (scipy.fft.fftfreq(len(power)) - middle + 0.5) % 1 - 0.5
    for taps in _TAPS:
        error = np.interp(np.abs(frequency), *_filter_errors(taps, stopband_db))
        if in_db((error * power).sum() / (power.sum() or 1.0)) < _SLACK_DB - stopband_db:
            return taps, 1
    return _DENSE_TAPS, 2


@cache
def _filter_errors(
    taps: int, stopband_db: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return frequencies, cycles per sample, and the error power of a filter at each."""
    frequency, phase = np.linspace(0, 0.5, 513), np.arange(16) / 16
    turns = np.exp(2j * np.pi * _tap_numbers(taps)[:, None] * frequency)
    found = _taps(taps, stopband_db)[(phase * _PHASES).astype(int)] @ turns
    exact = np.exp(2j * np.pi * phase[:, None] * frequency)
    return frequency, _power(found - exact).mean(axis=0)


def _twice_as_dense(samples: NDArray[np.complex64], middle: float) -> NDArray[np.complex64]:
    """Return lines moved to 0 Hz and twice as dense, with `_PADDING` zeros around them."""
    length = samples.shape[1]
    bins = scipy.fft.next_fast_len(length + 2 * _PADDING)
    lines = np.zeros((len(samples), bins), np.complex64)
    turns = np.exp(-2j * np.pi * np.mod(middle * np.arange(length), 1)).astype(np.complex64)
    np.multiply(samples, turns, out=lines[:, _PADDING : _PADDING + length])
    spectra = scipy.fft.fft(lines, axis=1, norm="forward", overwrite_x=True)
    wide = np.zeros((len(samples), 2 * bins), np.complex64)
    positive = (bins + 1) // 2
    wide[:, :positive] = spectra[:, :positive]
    wide[:, positive - bins :] = spectra[:, positive:]
    return scipy.fft.ifft(wide, axis=1, norm="forward", overwrite_x=True)


def _tap_numbers(taps: int) -> NDArray[np.int64]:
    """Return which samples filters weigh, counted from the last one before the position."""
    return np.arange(taps) - (taps // 2 - 1)


@cache
def _taps(taps: int, stopband_db: float) -> NDArray[np.float64]:
    """Return the taps of a sinc under a Kaiser window for every phase, [phases, taps]."""
    beta = 0.1102 * (stopband_db - 8.7)  # Kaiser (1974), above 50 dB
    offset = np.arange(_PHASES + 2)[:, None] / _PHASES - _tap_numbers(taps)
    inside = np.sqrt(np.maximum(1 - (2 * offset / taps) ** 2, 0))
    return np.sinc(offset) * np.i0(beta * inside) / np.i0(beta)


def _complex_taps(taps: int, stopband_db: float, middle: float) -> NDArray[np.float32]:
    """Return filters for lines about a frequency in the format of cl/sum_pixels.cl."""
    turns = np.exp(-2j * np.pi * np.mod(middle * _tap_numbers(taps), 1))
    filters = _taps(taps, stopband_db) * turns
    parts = np.stack([filters.real, filters.imag], axis=1).astype(np.float32)
    return np.repeat(parts[..., None], 2, axis=-1)


def _power(values: NDArray) -> NDArray[np.float64]:
    return values.real.astype(np.float64) ** 2 + values.imag.astype(np.float64) ** 2
