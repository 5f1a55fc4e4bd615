"""Search for the responses of known points: corrections to a resolution cell or so."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from clsas.core.lines import some_channels
from clsas.navigation.range_model import Model
from clsas.navigation.reflectors import LEAST_SNR, Reader

HALF_CELLS = 2.0
"""Half width within which responses are measured in the end, range resolution cells."""

_SEARCHED_CHANNELS = 1024  # in which responses are looked for; half do as well
_BLURRED = 1 / 32  # of these channels, over which powers are averaged in a wide search
_WIDE_CELLS = 8.0  # half width of a search that counts as wide
_NARROWER = 4.0  # from a search to the next


def found(
    model: Model, reader: Reader, free: tuple[int, ...], search_m: float
) -> NDArray[np.float64]:
    """Return corrections to a resolution cell or so, from the largest echoes near the points."""
    some = some_channels(model.lines.channels, _SEARCHED_CHANNELS)
    state, half_m = np.zeros(5), search_m
    usual = np.maximum(noise_power(model, reader, state, search_m), 1e-300)
    while True:
        expected_m = model.range_m(state, some)
        wide = half_m > _WIDE_CELLS * reader.cell_m
        blur = round(_BLURRED * len(some)) if wide else 1
        error_m, power = reader.errors_m(some, expected_m, half_m, blur)
        # A reflector weighs the more the more it stands out, up to where it certainly does.
        weight = np.clip(power / usual / LEAST_SNR, 0.0, 1.0)
        scale_m = half_m
        while True:
            state = _robust(model, state, free, some, expected_m + error_m, weight, scale_m)
            if scale_m <= reader.cell_m:
                break
            scale_m = max(scale_m / 2, reader.cell_m)
        if half_m <= HALF_CELLS * reader.cell_m:
            return state
        half_m = max(half_m / _NARROWER, HALF_CELLS * reader.cell_m)


def _robust(
    model: Model,
    state: NDArray[np.float64],
    free: tuple[int, ...],
    channels: NDArray[np.int64],
    measured_m: NDArray[np.float64],
    weight: NDArray[np.float64],
    scale_m: float,
) -> NDArray[np.float64]:
    """Return the state that explains most of the ranges within `scale_m`.

    Unknowns are counted in metres of range, and drawn weakly to zero: what the ranges do not tell
    apart stays small.
    """
    index = list(free)
    if not index:
        return state
    unit = np.sqrt(np.mean(model.gradient(state, channels)[index] ** 2, axis=(1, 2)))
    unit = np.maximum(unit, 1e-12)
    pull = 1e-3 / scale_m

    def at(x: NDArray[np.float64]) -> NDArray[np.float64]:
        found = state.copy()
        found[index] = x / unit
        return found

    def residuals(x: NDArray[np.float64]) -> NDArray[np.float64]:
        away_m = weight * (measured_m - model.range_m(at(x), channels))
        return np.concatenate([away_m.ravel() / scale_m, pull * x])

    def jacobian(x: NDArray[np.float64]) -> NDArray[np.float64]:
        slopes = model.gradient(at(x), channels)[index] / unit[:, None, None]
        of_ranges = -(weight * slopes).reshape(len(index), -1).T / scale_m
        return np.concatenate([of_ranges, pull * np.eye(len(index))])

    solved = least_squares(residuals, state[index] * unit, jacobian, loss="cauchy")
    return at(solved.x)


def noise_power(
    model: Model, reader: Reader, state: NDArray[np.float64], search_m: float
) -> NDArray[np.float64]:
    """Return the power of the noise around every reflector."""
    some = some_channels(model.lines.channels, _SEARCHED_CHANNELS)
    half_m = max(search_m, _WIDE_CELLS * reader.cell_m)
    return reader.noise(some, model.range_m(state, some), half_m)
