"""How many echoes decide a displacement, how they are weighed, and how certain their phases are."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

Window = tuple[NDArray[np.complex128], NDArray[np.complex128]]
"""Samples of both channels of all pairs in a window of range, [pairs, n] each."""

_HIGHLIGHT = 3.0  # times the median power, from which on echoes are weakened
# Power of side lobes and slopes over that of the strongest echo. Where all between the echoes is
# below it, the usual echo is none: with 0, yaw over one point errs by 7 times as much.
_SIDE_LOBES = 3e-3
_SMOOTHED = 9  # samples over which power is a mean
_EMPTY = 1e-3  # power over that of the strongest echo of a window, or a window's over all others
_MAIN_LOBE = 8.0  # independent samples, down to the former
_SPECKLE = 2.0  # mean square of speckle's power over the squared mean
_BLOCK_CELLS = 8.0  # independent samples of a block: neighbours share few echoes


def without_highlights(window: Window, largest: float) -> Window:
    """Return samples of both channels of all pairs, with strong echoes weakened.

    The stronger an echo, the less is left of it: it then weighs less than what is usual. A strong
    echo comes from one direction only. It would decide the mean phase, which is expected of echoes
    from all over the beam. `largest` is the power of the strongest echo of all windows.
    """
    power = uniform_filter1d(_power(window), _SMOOTHED, mode="nearest")
    usual = max(_HIGHLIGHT * float(np.median(power)), _SIDE_LOBES * largest)
    amplitude = np.minimum(1.0, usual / np.maximum(power, 1e-300))
    return amplitude * window[0], amplitude * window[1]


def strongest(windows: list[Window]) -> float:
    """Return the largest power, a mean over the pairs."""
    return max(float(_power(each).max()) for each in windows)


def independent_echoes(
    window: Window, weakened: Window, independent: float, largest: float
) -> float:
    """Return how many of the `independent` samples of a window hold echoes of their own.

    Speckle fills a window: all of them. A few reflectors leave most of it empty but for the slopes
    of their echoes: were m of them anywhere, each F samples long, a share exp(-m F/n) of n samples
    would stay empty. Where some echoes are far stronger than others in the `weakened` window, these
    decide.
    """
    power, left = _power(window), _power(weakened)
    count = len(power)
    length = _SMOOTHED + _MAIN_LOBE * count / independent
    if float(power.max()) <= _EMPTY * largest:
        return 0.0  # side lobes of echoes in other windows
    smoothed = uniform_filter1d(power, _SMOOTHED, mode="nearest")
    empty = float(np.mean(smoothed < _EMPTY * float(power.max())))
    reflectors = math.inf if not empty else -count / length * math.log(empty)
    even = _SPECKLE * float(np.sum(left)) ** 2 / max(count * float(np.sum(left**2)), 1e-300)
    return max(min(independent * min(even, 1.0), reflectors), 1.0)


def _power(window: Window) -> NDArray[np.float64]:
    """Return the mean power of both channels of all pairs, [n]."""
    one, other = window
    return np.asarray(np.mean(np.abs(one) ** 2 + np.abs(other) ** 2, axis=0)) / 2


def block_products(window: Window, lag: int, independent: float) -> NDArray[np.complex128]:
    """Return the correlation of all pairs at a lag in samples, block by block, [pairs, blocks]."""
    one, other = window
    count = one.shape[1]
    blocks = max(math.floor(independent / _BLOCK_CELLS), 1)
    first, stop = max(0, -lag), min(count, count - lag)
    product = np.zeros_like(one)
    product[:, first:stop] = one[:, first:stop] * other[:, first + lag : stop + lag].conj()
    starts = np.arange(blocks) * count // blocks
    return np.asarray(np.add.reduceat(product, starts, axis=1))


def phase_variance(
    coherence: NDArray[np.float64], independent: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the variance of a correlation's phase, rad^2.

    (1 - g^2)/(2 L g^2) for a coherence g over L independent samples; `coherence` is a sample's,
    which noise alone makes 1/sqrt(L).
    """
    square = np.clip((independent * coherence**2 - 1) / (independent - 1), 1e-6, 1 - 1e-9)
    return (1 - square) / (2 * independent * square)
