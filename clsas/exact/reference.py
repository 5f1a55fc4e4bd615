"""Images in float64, at a few points: what a device's image is measured against."""

from __future__ import annotations

from collections.abc import Callable

import finufft
import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray

from clsas.core import validate
from clsas.core.geometry import pairwise_range_m
from clsas.core.image import Image
from clsas.core.image_error import relative_error_db
from clsas.core.lines import RangeLines, wavelength_m
from clsas.exact.preparation import Preparation
from clsas.exact.run import normalising
from clsas.signal.spectrum import measure_spectrum
from clsas.sonar.beam import BeamWindow
from clsas.sonar.visibility import sines

Progress = Callable[[int, int], None] | None
Evaluate = Callable[[NDArray[np.complex128], NDArray[np.float64]], NDArray[np.complex128]]

_PAIRS_AT_ONCE = 1 << 18  # (point, channel) pairs: bounds the memory
_SUM_ERROR = 1e-12


def same_interpolator(
    preparation: Preparation, points_m: ArrayLike, *, progress: Progress = None
) -> NDArray[np.complex128]:
    """Return the image of a preparation at some points, as the device forms it but in float64.

    What the device's image differs by is its rounding, its expansion of the geometry, and its
    polynomials for sine and cosine where these are short (`clsas.opencl.phases`).

    Parameters
    ----------
    preparation : Preparation
        What `clsas.exact.backprojection.prepare` decided: the lines, how they are interpolated,
        and the beam. The device itself is not used.
    points_m : array_like, [..., 3]
        Positions, metres.
    progress : callable, optional
        Called as progress(channels done, channels).

    Returns
    -------
    complex128 array, [...]

    Raises
    ------
    TypeError, ValueError
        If an argument is of a wrong kind or shape, or a position is not finite.
    """
    validate.instance("preparation", preparation, Preparation)
    resampling, interpolator = preparation.resampling, preparation.interpolator

    def evaluate(
        samples: NDArray[np.complex128], place: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        upsampled = resampling.apply(samples)
        place = place + resampling.lead
        position = place * resampling.ratio - resampling.first
        lower = np.floor(position)
        weights = interpolator.weights(position - lower - 0.5)
        first = lower.astype(np.int64) + 1 - interpolator.taps // 2
        total = np.zeros(place.shape, np.complex128)
        for tap in range(interpolator.taps):
            inside = (first + tap >= 0) & (first + tap < resampling.length)
            index = np.where(inside, first + tap, 0)
            taken = np.take_along_axis(upsampled, index, axis=1)
            total += inside * weights[..., tap] * taken
        return total * np.exp(2j * np.pi * resampling.centre_cycles_per_sample * place)

    return _sum_channels(preparation.lines, points_m, evaluate, progress, preparation.beam)


def ideal(
    lines: RangeLines,
    points_m: ArrayLike,
    *,
    beam: BeamWindow | None = None,
    padding: int = 64,
    progress: Progress = None,
) -> NDArray[np.complex128]:
    """Return the ideal image at some points: every line evaluated exactly, in float64.

    Parameters
    ----------
    lines : RangeLines
        What to image.
    points_m : array_like, [..., 3]
        Positions, metres.
    beam : BeamWindow, optional
        Weights of the channels by aspect angle.
    padding : int
        Zeros taken around a line, in samples at each end. It matters only for lines that are cut
        off in the middle of strong echoes: what is beyond their ends is not known, and which
        zeros are put there instead decides what rings into them.
    progress : callable, optional
        Called as progress(channels done, channels).

    Returns
    -------
    complex128 array, [...]

    Raises
    ------
    TypeError, ValueError
        If an argument is of a wrong kind or shape, a position is not finite, or the beam's track
        cannot be told from the lines.

    Notes
    -----
    I(x) = sum_i w_i(x) s_i(rho_i(x)) exp(+j 2 k rho_i(x)), with w_i the beam's weights (1 without
    one) and s_i the trigonometric polynomial through the line's samples and zeros around them whose
    frequencies lie within half a cycle per sample of the lines' spectral centre. A point beyond a
    line's first or last sample gets nothing from it. The polynomial is summed by a type-2
    non-uniform FFT, to twelve digits.
    """
    validate.instance("lines", lines, RangeLines)
    padding = validate.count("padding", padding, least=0)
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    modes = scipy.fft.next_fast_len(lines.length + 2 * padding)
    shift = round(measure_spectrum(lines).centre * modes)

    def evaluate(
        samples: NDArray[np.complex128], place: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        # finufft's frequencies run from -(modes // 2): here they are those about the centre.
        spectra = np.roll(scipy.fft.fft(samples, modes, axis=1), modes // 2 - shift, axis=1)
        values = np.zeros(place.shape, np.complex128)
        for line, spectrum, at in zip(values, spectra / modes, place, strict=True):
            inside = (at >= 0) & (at <= lines.length - 1)
            angle = 2 * np.pi / modes * at[inside]
            line[inside] = np.exp(1j * shift * angle) * finufft.nufft1d2(
                angle, spectrum, isign=1, eps=_SUM_ERROR, nthreads=1
            )
        return values

    return _sum_channels(lines, points_m, evaluate, progress, beam)


def sampled_error_db(
    image: Image,
    reference: Callable[[NDArray[np.float64]], NDArray[np.complex128]],
    *,
    pixels: int = 1000,
    seed: int = 0,
) -> float:
    """Return the relative rms error of an image at pixels chosen at random, dB.

    Parameters
    ----------
    image : Image
        What to measure.
    reference : callable
        Maps positions [n, 3] (metres) to what the image should be there, complex [n]: for example
        `functools.partial(same_interpolator, preparation)` or `functools.partial(ideal, lines)`.
    pixels : int
        How many pixels to compare, all of them where there are no more.
    seed : int
        Seeds the choice.

    Raises
    ------
    TypeError, ValueError
        If an argument is of a wrong kind, or the reference is zero at every pixel chosen.
    """
    validate.instance("image", image, Image)
    pixels = min(validate.count("pixels", pixels), image.grid.size)
    chosen = np.random.default_rng(seed).choice(image.grid.size, pixels, replace=False)
    wanted = reference(image.grid.positions_m().reshape(-1, 3)[chosen])
    return relative_error_db(image.pixels.ravel()[chosen], wanted)


def _sum_channels(
    lines: RangeLines,
    points_m: ArrayLike,
    evaluate: Evaluate,
    progress: Progress,
    beam: BeamWindow | None,
) -> NDArray[np.complex128]:
    """Return the sum over channels of evaluate(samples, places), in phase and weighted."""
    leading = np.shape(points_m)[:-1]
    points = validate.array("points_m", points_m, np.float64, (*(None,) * len(leading), 3))
    points = points.reshape(-1, 3)
    image = np.zeros(len(points), np.complex128)
    sums = np.zeros(len(points))
    along = None if beam is None else beam.directions(lines)
    step = max(_PAIRS_AT_ONCE // len(points), 1)
    for first in range(0, lines.channels, step):
        block = lines.select(slice(first, first + step))
        range_m = pairwise_range_m(
            points, block.tx_m, block.rx_m, block.rx_velocity_m_s, block.sound_speed_m_s
        ).T
        place = (range_m - block.first_range_m[:, None]) / block.range_step_m
        values = evaluate(block.samples.astype(np.complex128), place)
        if beam is not None:
            q = sines(points, block.phase_centres_m, along[first : first + step])
            weights = beam.weights(q, wavelength_m(lines))
            values *= weights
            sums += weights.sum(axis=0)
        image += np.sum(values * np.exp(2j * block.wavenumber_rad_m * range_m), axis=0)
        if progress is not None:
            progress(first + block.channels, lines.channels)
    if beam is not None and beam.normalise:
        image *= normalising(sums, lines.channels)
    return image.reshape(leading)
