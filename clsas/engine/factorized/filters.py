"""Filters of a factorized image, and the sample rates that they need for a given error."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data.decibels import in_db, power
from clsas.engine.signal import interpolation
from clsas.engine.signal.interpolation import PHASES, TAPS, UPSAMPLINGS, Gain, Interpolator
from clsas.engine.signal.spectrum import Spectrum

ALIGN_TAPS = APERTURE_TAPS = (4, 6, 8)
UPSAMPLING_SHARE = 0.03
"""Share of an image's error power that upsampling filters may add."""
LONGEST_UPSAMPLING_SHARE = 0.2
"""The same for the longest filter, if no shorter one is accurate enough. Beyond it, FFTs upsample
the lines, which takes more time than tighter filters elsewhere and rules out half precision."""
_MOST_GAIN = 3.0  # limits the gain at band edges, where lines have little power
# Weight of pixels near the corners of a subimage, which have at least `_CORNERS_FROM` of the
# highest phase rate. With half the weight, images are 1.5 % faster and their errors 1 dB smaller
# on average, but larger at corners. With twice, there are no filters for tight tolerances.
_CORNERS_SHARE = 0.5
_CORNERS_FROM = 0.7
_STEPS = 3  # iterations towards the least oversampling; with one, images take 1 % more time
_SLOPE_DB = 12.0  # bounds the fall of errors per tap and e-fold rate; 15 makes 0.15 dB difference
_CLOSE_DB = 0.1  # distance from the allowed error at which the iteration aims
_WORST_DB = -22.0  # of aperture filters; with worse ones, errors concentrate at corners
# Share of the error power of aperture filters that is of the same sign along and across a sheet.
# With half, errors of helices exceed the prediction by 0.5 dB.
_COHERENT = 0.08
_BINS = 64  # frequencies of the spectrum of steering functions


def choose(
    spectrum: Spectrum,
    align_taps: int,
    aperture_taps: int,
    stages: int,
    most_db: float,
    dimensions: int = 1,
) -> FilterRates | None:
    """Return the lowest rates at which the joint error of all interpolations is at most `most_db`.

    There are two interpolations in each stage, three on a sheet, and one at the end. All may err as
    much. The one at the end reads the same samples as those in range before it, so that it never
    needs more taps. The result is None if no rate suffices.
    """
    each_db = most_db - 10 * math.log10(stages + interpolations(stages, dimensions) + 1)
    upsampling = _least_rate(align_taps, each_db, spectrum, "scatter_db")
    oversampling = _least_rate(aperture_taps, each_db, _STEERING, "error_db")
    if upsampling is None or oversampling is None:
        return None
    final_taps = next(
        taps
        for taps in TAPS
        if (_least_rate(taps, each_db, spectrum, "scatter_db") or math.inf) <= upsampling
    )
    return FilterRates(align_taps, upsampling, aperture_taps, oversampling, final_taps, dimensions)


def interpolations(stages: int, dimensions: int) -> float:
    """Return the factor by which the error power of the aperture filter counts in an image.

    Errors of interpolation along and across a sheet have the same sign at low phase rates, so that
    in part they add up themselves, rather than their powers.
    """
    if dimensions == 1:
        return stages
    count = stages * dimensions
    return count * (1 + _COHERENT * (count - 1))


def _least_rate(taps: int, most_db: float, spectrum: Spectrum, error: str) -> float | None:
    """Return the lowest rate at which a filter's error is at most `most_db`, or None."""
    errors = _errors_db(taps, error, *spectrum.as_bytes)
    if errors[-1] > most_db:
        return None
    if errors[0] <= most_db:
        return UPSAMPLINGS[0]
    # Errors fall with the rate. The margins for rounding are half a per cent and a tenth of a dB.
    return 1.005 * float(np.exp(np.interp(0.1 - most_db, -errors, np.log(UPSAMPLINGS))))


@functools.lru_cache(maxsize=64)
def _errors_db(taps: int, error: str, frequency: bytes, power: bytes) -> NDArray[np.float64]:
    """Return the errors of filters at all `UPSAMPLINGS`, never increasing."""
    found = interpolation.usual_designs(taps, frequency, power)
    return np.minimum.accumulate([getattr(each, error) for each in found])


def steering_spectrum(of_highest: ArrayLike = 1.0, power: ArrayLike = 1.0) -> Spectrum:
    """Return the power spectrum of steering functions along the aperture.

    The spacing of virtual channels follows from the highest phase rate, which is that of the
    highest frequency at a corner of a subimage. Most pixels have lower rates. Corners get more
    weight than their share of the pixels, since the only target of a scene may be in a corner.

    Parameters
    ----------
    of_highest : float [n]
        Frequencies of the lines, relative to the highest.
    power : float [n]
        Share of the lines' power at each frequency.
    """
    edges = np.linspace(0, 1, _BINS + 1) / np.asarray(of_highest).reshape(-1, 1)
    # Power below each edge: of a spectrum 1 - x^2 up to the highest rate, and of a flat spectrum.
    inside = np.minimum(edges, 1) * (3 - np.minimum(edges, 1) ** 2) / 2
    corners = np.clip((edges - _CORNERS_FROM) / (1 - _CORNERS_FROM), 0, 1)
    both = (1 - _CORNERS_SHARE) * inside + _CORNERS_SHARE * corners
    share = np.broadcast_to(power, len(both)) @ np.diff(both, axis=1)
    return Spectrum(0.0, (np.arange(_BINS) + 0.5) / (2 * _BINS), share / share.sum())


_STEERING = steering_spectrum()


@dataclass(frozen=True)
class FilterRates:
    """Taps of filters that are not designed yet, and the sample rates that they need.

    Attributes
    ----------
    align_taps : int
    upsampling : float
        Factor by which range lines are upsampled.
    aperture_taps : int
    oversampling : float
        Virtual channels per half cycle of the highest phase rate.
    final_taps : int
    dimensions : int
        Dimensions of the aperture in which virtual channels are interpolated.
    """

    align_taps: int
    upsampling: float
    aperture_taps: int
    oversampling: float
    final_taps: int
    dimensions: int = 1

    @property
    def stage_taps(self) -> int:
        """Multiplications of each sample that a stage aligns and combines."""
        return self.align_taps + self.aperture_taps**self.dimensions

    def design(
        self, spectrum: Spectrum, steering: Spectrum, stages: int, most_db: float
    ) -> Filters:
        """Return filters with a joint error of `most_db`, or a little less.

        The upsampling is rounded so that samples lie at whole phases of the filters' tables. The
        aperture filter may have the error that range filters leave.

        Parameters
        ----------
        spectrum, steering : Spectrum
            Spectra of the range lines, and of the steering functions along the aperture.
        stages : int
        most_db : float
            Relative rms error, dB.
        """
        upsampling = PHASES / max(int(PHASES / self.upsampling), 1)
        align = interpolation.design(self.align_taps, upsampling, spectrum)
        final = interpolation.design(self.final_taps, upsampling, spectrum)
        in_range = stages * power(align.scatter_db) + power(final.scatter_db)
        rest = power(most_db) - in_range
        allowed_db = min(in_db(rest / interpolations(stages, self.dimensions)), _WORST_DB)
        aperture = tried = interpolation.design(self.aperture_taps, self.oversampling, steering)
        for _ in range(_STEPS):
            # Errors fall by less than _SLOPE_DB per tap when the oversampling grows e-fold.
            spare_db = allowed_db - _CLOSE_DB - tried.error_db
            fewer = math.exp(-spare_db / (_SLOPE_DB * self.aperture_taps))
            oversampling = max(tried.upsampling * fewer, UPSAMPLINGS[0])
            tried = interpolation.design(self.aperture_taps, oversampling, steering)
            if tried.error_db <= allowed_db and oversampling < aperture.upsampling:
                aperture = tried
        return Filters(align, aperture, final)


@dataclass(frozen=True)
class Filters:
    """Designed filters.

    Attributes
    ----------
    align : Interpolator
        Filter in range, of the stages.
    aperture : Interpolator
        Filter along the aperture.
    final : Interpolator
        Filter in range, of the last backprojection.
    """

    align: Interpolator
    aperture: Interpolator
    final: Interpolator


def edges_gain(align: Interpolator, final: Interpolator, stages: int, ratio: float) -> Gain:
    """Return the gain that compensates for range interpolation of lines upsampled by a ratio.

    Interpolation attenuates the edges of the band a little in every stage.
    """

    def gain(frequency: NDArray[np.float64]) -> NDArray[np.float64]:
        response = align.response(frequency / ratio) ** stages * final.response(frequency / ratio)
        return np.clip(1 / response, 1 / _MOST_GAIN, _MOST_GAIN)

    return gain
