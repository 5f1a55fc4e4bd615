"""Filters between the stages of a factorized image: the sample rates that an error requires."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.core.decibels import in_db, power
from clsas.signal import interpolation
from clsas.signal.interpolation import PHASES, Gain, Interpolator
from clsas.signal.spectrum import Spectrum

ALIGN_TAPS = APERTURE_TAPS = (4, 6, 8)
_FINAL_TAPS = (2, 4, 6, 8)
UPSAMPLING_SHARE = 0.03
"""Share of an image's error power that filters for upsampling may add."""
LONGEST_UPSAMPLING_SHARE = 0.2
"""The same for the longest filter, where no other is accurate enough. Past it FFTs upsample lines:
that takes more time than tighter filters elsewhere, and rules out half precision."""
_MOST_GAIN = 3.0  # limits the gain at band edges, where lines have little power
# Weight of pixels near the corners of a subimage: those with `_CORNERS_FROM` of the highest phase
# rate or more. Half: 1.5 % faster and 1 dB less error on average, but corners err more. Twice:
# tight tolerances find no filters.
_CORNERS_SHARE = 0.5
_CORNERS_FROM = 0.7
# Of the iteration to the least oversampling; once only: 1 % slower.
_STEPS = 3
_SLOPE_DB = 12.0  # per tap and factor e of oversampling; a quarter more: 0.15 dB
_CLOSE_DB = 0.1  # of the aim
_WORST_DB = -22.0  # aperture filters; with worse ones only pixels at the corners err
_COHERENT = 0.08  # of their error power; half: helices err by 0.5 dB more than predicted
_RATES = tuple(np.geomspace(1, 12, 16))  # at which errors of filters are evaluated
_BINS = 64  # of the steering functions' spectrum


def steering_spectrum(of_highest: ArrayLike = 1.0, power: ArrayLike = 1.0) -> Spectrum:
    """Return the power spectrum of steering functions along the aperture.

    The spacing of virtual channels follows from the highest phase rate: that of the highest
    frequency, at a corner of a subimage. Most pixels have lower rates. Corners get more weight than
    their share, since the only target of a scene may lie in one.

    Parameters
    ----------
    of_highest : float [n]
        Frequencies of the lines, relative to the highest.
    power : float [n]
        Share of the lines' power at each.
    """
    edges = np.linspace(0, 1, _BINS + 1) / np.asarray(of_highest).reshape(-1, 1)
    # Power below each edge, of a spectrum like 1 - x^2 up to the highest rate, and of a flat one.
    inside = np.minimum(edges, 1) * (3 - np.minimum(edges, 1) ** 2) / 2
    corners = np.clip((edges - _CORNERS_FROM) / (1 - _CORNERS_FROM), 0, 1)
    both = (1 - _CORNERS_SHARE) * inside + _CORNERS_SHARE * corners
    share = np.broadcast_to(power, len(both)) @ np.diff(both, axis=1)
    return Spectrum(0.0, (np.arange(_BINS) + 0.5) / (2 * _BINS), share / share.sum())


_STEERING = steering_spectrum()


@dataclass(frozen=True)
class Filters:
    """Designed filters.

    Attributes
    ----------
    align : Interpolator
        In range, between stages.
    aperture : Interpolator
        Along the aperture.
    final : Interpolator
        In range, for the pixels.
    """

    align: Interpolator
    aperture: Interpolator
    final: Interpolator


def edges_gain(align: Interpolator, final: Interpolator, stages: int, ratio: float) -> Gain:
    """Return the gain that compensates range interpolation, for lines upsampled by a ratio.

    Interpolation attenuates the band's edges a little in every stage.
    """

    def gain(frequency: NDArray[np.float64]) -> NDArray[np.float64]:
        response = align.response(frequency / ratio) ** stages * final.response(frequency / ratio)
        return np.clip(1 / response, 1 / _MOST_GAIN, _MOST_GAIN)

    return gain


@dataclass(frozen=True)
class FilterRates:
    """Taps of filters, and the sample rates that they need; the filters are not designed yet.

    Attributes
    ----------
    align_taps : int
    upsampling : float
        Factor by which range lines are upsampled.
    aperture_taps : int
    oversampling : float
        Virtual channels per half a cycle of the highest phase rate.
    final_taps : int
    dimensions : int
        Of the aperture, in which virtual channels are interpolated.
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
        """Return filters with a joint error of `most_db` or little less.

        The upsampling is rounded to whole phases of the filters' tables. The error that range
        filters leave is for the aperture filter.

        Parameters
        ----------
        spectrum, steering : Spectrum
            Of the range lines, and of the steering functions along the aperture.
        stages : int
        most_db : float
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
            oversampling = max(tried.upsampling * fewer, _RATES[0])
            tried = interpolation.design(self.aperture_taps, oversampling, steering)
            if tried.error_db <= allowed_db and oversampling < aperture.upsampling:
                aperture = tried
        return Filters(align, aperture, final)


def interpolations(stages: int, dimensions: int) -> float:
    """Return how many times the error power of an aperture's filter counts.

    Interpolations along and across a sheet err with the same sign at low phase rates, so that some
    of their errors add, not their powers.
    """
    if dimensions == 1:
        return stages
    count = stages * dimensions
    return count * (1 + _COHERENT * (count - 1))


def choose(
    spectrum: Spectrum,
    align_taps: int,
    aperture_taps: int,
    stages: int,
    most_db: float,
    dimensions: int = 1,
) -> FilterRates | None:
    """Return the least rates at which the joint error of all interpolations is at most `most_db`.

    These are two in each stage, three for a sheet, and the last one. The result is None if no rate
    suffices.
    """
    each_db = most_db - 10 * math.log10(stages + interpolations(stages, dimensions) + 1)
    upsampling = _least_rate(align_taps, each_db, spectrum, "scatter_db")
    oversampling = _least_rate(aperture_taps, each_db, _STEERING, "error_db")
    if upsampling is None or oversampling is None:
        return None
    final_taps = next(
        taps
        for taps in _FINAL_TAPS
        if (_least_rate(taps, each_db, spectrum, "scatter_db") or math.inf) <= upsampling
    )
    return FilterRates(align_taps, upsampling, aperture_taps, oversampling, final_taps, dimensions)


def _least_rate(taps: int, most_db: float, spectrum: Spectrum, error: str) -> float | None:
    """Return the least rate at which a filter's error is at most `most_db`, or None."""
    key = spectrum.frequency.tobytes(), spectrum.power.tobytes()
    errors = _errors_db(taps, error, *key)
    if errors[-1] > most_db:
        return None
    if errors[0] <= most_db:
        return _RATES[0]
    # Errors fall with the rate. Rounding is allowed half a per cent of rate and a tenth of a dB.
    return 1.005 * float(np.exp(np.interp(0.1 - most_db, -errors, np.log(_RATES))))


@functools.lru_cache(maxsize=64)
def _errors_db(taps: int, error: str, frequency: bytes, power: bytes) -> NDArray[np.float64]:
    """Return the errors of filters at all `_RATES`."""
    spectrum = Spectrum(0.0, np.frombuffer(frequency), np.frombuffer(power))
    found = [getattr(each, error) for each in interpolation.designs(taps, _RATES, spectrum)]
    return np.minimum.accumulate(found)
