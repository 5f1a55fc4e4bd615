"""The filters between the stages of a factorized image: what they take to err by so little."""

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
"""Of the power of an image's error: what filters that upsample may add."""
_MOST_GAIN = 3.0  # of frequencies, which are amplified where lines hold next to nothing
_CORNERS_SHARE, _CORNERS_FROM = 0.5, 0.7  # of pixels, and how fast phases turn there
_STEPS, _SLOPE_DB, _CLOSE_DB = 3, 12.0, 0.1  # towards the sparsest virtual channels
_WORST_DB = -22.0  # of these; beyond it next to all of the error is that of the fastest phases
_RATES = tuple(np.geomspace(1, 12, 16))  # where errors are looked at
_FINENESS = 64


def steering_spectrum(of_highest: ArrayLike = 1.0, power: ArrayLike = 1.0) -> Spectrum:
    """Return the power spectrum of steering functions along the aperture.

    Virtual channels are counted by the turns of the fastest phase that there may be: at a corner
    of a subimage, and at the highest frequency. Most pixels' turn slower; corners are given more
    weight than they have, since a point may lie there and there only.

    Parameters
    ----------
    of_highest : float [n]
        Frequencies of the lines, over the highest.
    power : float [n]
        Share of the lines' power that each holds.
    """
    edges = np.linspace(0, 1, _FINENESS + 1) / np.asarray(of_highest).reshape(-1, 1)
    # What lies below: of a density like 1 - x^2 up to the fastest phase, and of an even one.
    inside = np.minimum(edges, 1) * (3 - np.minimum(edges, 1) ** 2) / 2
    corners = np.clip((edges - _CORNERS_FROM) / (1 - _CORNERS_FROM), 0, 1)
    both = (1 - _CORNERS_SHARE) * inside + _CORNERS_SHARE * corners
    share = np.broadcast_to(power, len(both)) @ np.diff(both, axis=1)
    return Spectrum(0.0, (np.arange(_FINENESS) + 0.5) / (2 * _FINENESS), share / share.sum())


_STEERING = steering_spectrum()


@dataclass(frozen=True)
class Filters:
    """Filters in range, along the aperture, and in range for the last stage."""

    align: Interpolator
    aperture: Interpolator
    final: Interpolator


def edges_gain(align: Interpolator, final: Interpolator, stages: int, ratio: float) -> Gain:
    """Return what makes up for all that range interpolation takes from lines upsampled by a ratio.

    It weakens the band's edges a little in every stage.
    """

    def gain(frequency: NDArray[np.float64]) -> NDArray[np.float64]:
        response = align.response(frequency / ratio) ** stages * final.response(frequency / ratio)
        return np.clip(1 / response, 1 / _MOST_GAIN, _MOST_GAIN)

    return gain


@dataclass(frozen=True)
class Choice:
    """Taps and rates of filters that are not designed yet.

    Attributes
    ----------
    align_taps, aperture_taps, final_taps : int
    rate : float
        By how much lines are upsampled.
    density : float
        Virtual channels over the least: per half a cycle.
    """

    align_taps: int
    rate: float
    aperture_taps: int
    density: float
    final_taps: int

    def design(
        self, spectrum: Spectrum, steering: Spectrum, stages: int, most_db: float
    ) -> Filters:
        """Return filters that err by no more than `most_db` together, and by little less.

        Lines are upsampled in whole phases; what filters in range then leave is for those along
        the aperture, whose functions have the spectrum `steering`.
        """
        rate = PHASES / max(int(PHASES / self.rate), 1)
        align = interpolation.design(self.align_taps, rate, spectrum)
        final = interpolation.design(self.final_taps, rate, spectrum)
        in_range = stages * power(align.scatter_db) + power(final.scatter_db)
        left = power(most_db) - in_range
        wanted_db = min(in_db(left / stages), _WORST_DB)
        aperture = tried = interpolation.design(self.aperture_taps, self.density, steering)
        for _ in range(_STEPS):
            # Errors fall by less than so many dB per tap when the density grows by a factor of e.
            spare_db = wanted_db - _CLOSE_DB - tried.error_db
            fewer = math.exp(-spare_db / (_SLOPE_DB * self.aperture_taps))
            density = max(tried.upsampling * fewer, _RATES[0])
            tried = interpolation.design(self.aperture_taps, density, steering)
            if tried.error_db <= wanted_db and density < aperture.upsampling:
                aperture = tried
        return Filters(align, aperture, final)


def choose(
    spectrum: Spectrum, align_taps: int, aperture_taps: int, stages: int, most_db: float
) -> Choice | None:
    """Return the least rates at which all interpolations together err by no more than `most_db`.

    There are two in each of some stages, and the last. None where no rate is enough.
    """
    each_db = most_db - 10 * math.log10(2 * stages + 1)
    rate = _least(align_taps, each_db, spectrum, "scatter_db")
    density = _least(aperture_taps, each_db, _STEERING, "error_db")
    if rate is None or density is None:
        return None
    needed = {taps: _least(taps, each_db, spectrum, "scatter_db") for taps in _FINAL_TAPS}
    final_taps = next(t for t in _FINAL_TAPS if needed[t] is not None and needed[t] <= rate)
    return Choice(align_taps, rate, aperture_taps, density, final_taps)


def _least(taps: int, wanted_db: float, spectrum: Spectrum, error: str) -> float | None:
    """Return the least rate at which a filter errs by no more, None where no rate is enough."""
    key = spectrum.frequency.tobytes(), spectrum.power.tobytes()
    errors = _errors_db(taps, error, *key)
    if errors[-1] > wanted_db:
        return None
    if errors[0] <= wanted_db:
        return _RATES[0]
    # Errors fall with the rate; a half per cent of rate and a tenth of a decibel are for rounding.
    return 1.005 * float(np.exp(np.interp(0.1 - wanted_db, -errors, np.log(_RATES))))


@functools.lru_cache(maxsize=64)
def _errors_db(taps: int, error: str, frequency: bytes, power: bytes) -> NDArray[np.float64]:
    """Return the errors of filters at all `_RATES`."""
    spectrum = Spectrum(0.0, np.frombuffer(frequency), np.frombuffer(power))
    found = [getattr(each, error) for each in interpolation.designs(taps, _RATES, spectrum)]
    return np.minimum.accumulate(found)
