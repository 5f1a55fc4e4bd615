"""Search for the responses of known points, which yields corrections to about a range cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from clsas.engine.data.lines import some_channels
from clsas.navigation.range_model import Model
from clsas.navigation.reflectors import LEAST_SNR, Reader

HALF_CELLS = 2.0
"""Half width of the interval within which responses are measured in the end, range cells."""

_SEARCHED_CHANNELS = 1024  # channels in which responses are searched; half as many suffice
_BLURRED = 1 / 32  # share of these channels over which powers are averaged in a wide search
_WIDE_CELLS = 8.0  # half width above which a search counts as wide, range cells
_NARROWER = 4.0  # factor by which each search is narrower than the last


def coarse_state(
    model: Model, reader: Reader, free: tuple[int, ...], search_m: float
) -> NDArray[np.float64]:
    """Return corrections to about a range cell, from the largest echoes near the points."""
    channels = some_channels(model.lines.channels, _SEARCHED_CHANNELS)
    state, half_m = np.zeros(5), search_m
    usual = np.maximum(noise_power(model, reader, state, search_m), 1e-300)
    while True:
        expected_m = model.range_m(state, channels)
        wide = half_m > _WIDE_CELLS * reader.cell_m
        blur = round(_BLURRED * len(channels)) if wide else 1
        error_m, power = reader.errors_m(channels, expected_m, half_m, blur)
        # The weight of a reflector grows with its power, up to where it certainly exceeds noise.
        weight = np.clip(power / usual / LEAST_SNR, 0.0, 1.0)
        echoes = _Echoes(channels, expected_m + error_m, weight)
        scale_m = half_m
        while True:
            state = _robust(model, state, free, echoes, scale_m)
            if scale_m <= reader.cell_m:
                break
            scale_m = max(scale_m / 2, reader.cell_m)
        if half_m <= HALF_CELLS * reader.cell_m:
            return state
        half_m = max(half_m / _NARROWER, HALF_CELLS * reader.cell_m)


@dataclass(frozen=True, eq=False)
class _Echoes:
    """Largest echoes near the points.

    Attributes
    ----------
    channels : int64 [channels]
    range_m : float64 [channels, points]
    weight : float64 [channels, points]
    """

    channels: NDArray[np.int64]
    range_m: NDArray[np.float64]
    weight: NDArray[np.float64]


def _robust(
    model: Model,
    state: NDArray[np.float64],
    free: tuple[int, ...],
    echoes: _Echoes,
    scale_m: float,
) -> NDArray[np.float64]:
    """Return the state that explains most of the ranges to within `scale_m`.

    Unknowns are scaled to metres of range, and weakly attracted to zero, so that combinations that
    the ranges do not determine remain small.
    """
    index = list(free)
    if not index:
        return state
    channels, weight = echoes.channels, echoes.weight
    unit = np.sqrt(np.mean(model.gradient(state, channels)[index] ** 2, axis=(1, 2)))
    unit = np.maximum(unit, 1e-12)
    pull = 1e-3 / scale_m

    def at(x: NDArray[np.float64]) -> NDArray[np.float64]:
        found = state.copy()
        found[index] = x / unit
        return found

    def residuals(x: NDArray[np.float64]) -> NDArray[np.float64]:
        away_m = weight * (echoes.range_m - model.range_m(at(x), channels))
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
    """Return the power of the noise around each reflector, [points]."""
    channels = some_channels(model.lines.channels, _SEARCHED_CHANNELS)
    half_m = max(search_m, _WIDE_CELLS * reader.cell_m)
    return reader.noise(channels, model.range_m(state, channels), half_m)
