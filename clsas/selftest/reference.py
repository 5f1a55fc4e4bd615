"""Reference images in float64 at a few points, with which images of devices are compared."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow, normalising
from clsas.engine.data.fourier import fourier_series
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.image import Image
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.lines import RangeLines, wavelength_m
from clsas.engine.data.visibility import sines
from clsas.engine.exact.decide import Decision
from clsas.engine.signal.interpolation import interpolated
from clsas.engine.signal.spectrum import measure_spectrum
from clsas.engine.water.ray_delays import delays_s

Progress = Callable[[int, int], None] | None
Evaluate = Callable[[NDArray[np.complex128], NDArray[np.float64]], NDArray[np.complex128]]

_PAIRS_AT_ONCE = 1 << 18  # pairs of points and channels; bounds memory
_SUM_ERROR_DB = -240.0  # of non-uniform FFTs


def same_interpolator(
    lines: RangeLines,
    decision: Decision,
    points_m: ArrayLike,
    *,
    beam: BeamWindow | None = None,
    progress: Progress = None,
) -> NDArray[np.complex128]:
    """Return the image of a decision at some points, as the device forms it but in float64.

    The image of the device differs by rounding, by the expansion of the geometry, and by short
    polynomials for sine and cosine (`clsas.engine.device.kernels`).

    Parameters
    ----------
    lines : RangeLines
    decision : Decision
        Interpolation of the lines.
    points_m : array_like, [..., 3]
        Positions, metres.
    beam : BeamWindow, optional
        Weights of the channels by aspect angle.
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
    resampling, interpolator = decision.resampling, decision.interpolator

    def evaluate(
        samples: NDArray[np.complex128], position: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        return interpolated(samples, position, interpolator, resampling)

    return _sum_channels(decision.crop.of(lines), points_m, evaluate, progress, beam)


def ideal(
    lines: RangeLines,
    points_m: ArrayLike,
    *,
    beam: BeamWindow | None = None,
    padding: int = 64,
    progress: Progress = None,
) -> NDArray[np.complex128]:
    """Return the ideal image at some points, for which lines are evaluated exactly in float64.

    Parameters
    ----------
    lines : RangeLines
        Lines to image.
    points_m : array_like, [..., 3]
        Positions, metres.
    beam : BeamWindow, optional
        Weights of the channels by aspect angle.
    padding : int
        Zeros added at either end of a line, samples. Their number matters only for lines that are
        cut off within strong echoes. The samples beyond are unknown, and the zeros that replace
        them ring into the line.
    progress : callable, optional
        Called as progress(channels done, channels).

    Returns
    -------
    complex128 array, [...]

    Raises
    ------
    TypeError, ValueError
        If an argument is of a wrong kind or shape, a position is not finite, or the beam's track
        cannot be found from the lines.

    Notes
    -----
    The image is I(x) = sum_i w_i(x) s_i(rho_i(x)) exp(+j 2 k rho_i(x)), where w_i are the weights
    of the beam (1 without a beam). s_i is the trigonometric polynomial through the samples of a
    line and the zeros around them. Its frequencies lie within half a cycle per sample of the
    spectral centre of the lines. A line does not contribute to points beyond its first or last
    sample. A type-2 non-uniform FFT evaluates the polynomial to twelve digits.
    """
    validate.instance("lines", lines, RangeLines)
    padding = validate.count("padding", padding, least=0)
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    modes = scipy.fft.next_fast_len(lines.length + 2 * padding)
    # The lowest frequency, cycles per `modes` samples.
    lowest = round(measure_spectrum(lines).centre * modes) - modes // 2

    def evaluate(
        samples: NDArray[np.complex128], position: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        spectra = np.roll(scipy.fft.fft(samples, modes, axis=1), -lowest, axis=1) / modes
        values = np.zeros(position.shape, np.complex128)
        for line, spectrum, at in zip(values, spectra, position, strict=True):
            inside = (at >= 0) & (at <= lines.length - 1)
            cycles = at[inside] / modes
            turns = np.exp(2j * np.pi * lowest * cycles)
            line[inside] = turns * fourier_series(spectrum, cycles, _SUM_ERROR_DB)
        return values

    return _sum_channels(lines, points_m, evaluate, progress, beam)


def sampled_error_db(
    image: Image,
    reference: Callable[[NDArray[np.float64]], NDArray[np.complex128]],
    *,
    pixels: int = 1000,
    seed: int = 0,
) -> float:
    """Return the relative rms error of an image at random pixels, dB.

    Parameters
    ----------
    image : Image
        Image to measure.
    reference : callable
        Function of positions [n, 3], metres, that returns the correct pixels there, complex [n].
        Examples are `functools.partial(same_interpolator, lines, decision)` and
        `functools.partial(ideal, lines)`.
    pixels : int
        Number of pixels to compare. If the image has fewer, all of them are compared.
    seed : int
        Seed of the random choice.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type, or the reference is zero at every pixel compared.
    """
    validate.instance("image", image, Image)
    pixels = min(validate.count("pixels", pixels), image.grid.size)
    chosen = np.random.default_rng(seed).choice(image.grid.size, pixels, replace=False)
    correct = reference(image.grid.positions_m().reshape(-1, 3)[chosen])
    return relative_error_db(image.pixels.ravel()[chosen], correct)


def _sum_channels(
    lines: RangeLines,
    points_m: ArrayLike,
    evaluate: Evaluate,
    progress: Progress,
    beam: BeamWindow | None,
) -> NDArray[np.complex128]:
    """Return the sum over channels of evaluate(samples, positions), in phase and weighted.

    Positions are in samples from the first sample of each line, [channels, points].
    """
    leading = np.shape(points_m)[:-1]
    points = validate.array("points_m", points_m, np.float64, (*(None,) * len(leading), 3))
    points = points.reshape(-1, 3)
    image = np.zeros(len(points), np.complex128)
    sums = np.zeros(len(points))
    along = None if beam is None else beam.directions(lines)
    step = max(_PAIRS_AT_ONCE // len(points), 1)
    for first in range(0, lines.channels, step):
        block = lines.select(slice(first, first + step))
        if block.sound_speed is None:
            motion = block.rx_velocity_m_s, block.sound_speed_m_s
            range_m = pairwise_range_m(points, block.tx_m, block.rx_m, *motion).T
        else:  # along rays
            channel, point = np.divmod(np.arange(block.channels * len(points)), len(points))
            delay_s = delays_s(block, channel, points[point]).reshape(-1, len(points))
            range_m = block.sound_speed_m_s / 2 * delay_s
        position = (range_m - block.first_range_m[:, None]) / block.range_step_m
        values = evaluate(block.samples.astype(np.complex128), position)
        if beam is not None and along is not None:
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
