"""Weights of echoes, their number, and the uncertainty of their phases."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

Window = tuple[NDArray[np.complex128], NDArray[np.complex128]]
"""Samples of the first and second channels of all pairs in a window of range, [pairs, n] each."""

_HIGHLIGHT = 3.0  # power over the median above which echoes are weakened
# Power of side lobes and slopes of echoes over that of the strongest echo. If everything between
# the echoes is weaker than this, the median is no measure of echoes. With 0, the error of yaw over
# a single point is 7 times as large.
_SIDE_LOBES = 3e-3
_SMOOTHED = 9  # samples over which power is averaged
# Power below which a sample counts as empty, relative to the strongest echo of its window, and a
# window relative to the strongest echo of all windows.
_EMPTY = 1e-3
# Power relative to the median below which a sample counts as empty, if most samples are not. Dips
# of speckle are seldom deeper. Beside a bright reflector, which raises the other limit, they would
# pass for gaps: the speckle of docs/tutorials/focus.md counts as 164 echoes, and without this limit
# as 45. With 0.2, it sometimes counts as 77; with 0.05, 30 reflectors count as 36 instead of 27.
_DIP = 0.1
_MAIN_LOBE = 8.0  # length of an echo down to that level, independent samples
_SPECKLE = 2.0  # mean square of the power of speckle over its squared mean
_BLOCK_CELLS = 8.0  # independent samples in a block: neighbouring blocks share few echoes


def without_highlights(window: Window, largest: float) -> Window:
    """Return a window in which strong echoes are weakened.

    The stronger an echo is, the less of it remains, so that it weighs less than a usual one. A
    strong echo comes from a single direction. It would dominate the mean phase, whose expectation
    is that of echoes from the whole beam. `largest` is the power of the strongest echo of all
    windows.
    """
    power = uniform_filter1d(_power(window), _SMOOTHED, mode="nearest")
    usual = max(_HIGHLIGHT * float(np.median(power)), _SIDE_LOBES * largest)
    amplitude = np.minimum(1.0, usual / np.maximum(power, 1e-300))
    return amplitude * window[0], amplitude * window[1]


def strongest(windows: list[Window]) -> float:
    """Return the largest power of all windows, averaged over the pairs."""
    return max(float(_power(each).max()) for each in windows)


def independent_echoes(
    window: Window, weakened: Window, independent: float, largest: float
) -> float:
    """Return how many of the `independent` samples of a window contain echoes of their own.

    Speckle fills a window, so all samples count. A few reflectors leave most of it empty, except
    for the slopes of their echoes: if m echoes, each F samples long, lie at random positions among
    n samples, a share exp(-m F/n) of the samples stays empty. If some echoes are much stronger than
    others in the `weakened` window, only these count.
    """
    power, remaining = _power(window), _power(weakened)
    count = len(power)
    length = _SMOOTHED + _MAIN_LOBE * count / independent
    if float(power.max()) <= _EMPTY * largest:
        return 0.0  # side lobes of echoes in other windows
    smoothed = uniform_filter1d(power, _SMOOTHED, mode="nearest")
    least, usual = _EMPTY * float(power.max()), float(np.median(smoothed))
    if usual > least:
        least = min(least, _DIP * usual)
    empty = float(np.mean(smoothed < least))
    reflectors = math.inf if not empty else -count / length * math.log(empty)
    square = max(count * float(np.sum(remaining**2)), 1e-300)
    even = _SPECKLE * float(np.sum(remaining)) ** 2 / square
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
    """Return the variance of the phase of a correlation, rad^2.

    It is (1 - g^2)/(2 L g^2) for a coherence g over L independent samples. `coherence` is the
    sample coherence, which is 1/sqrt(L) for noise alone.
    """
    square = np.clip((independent * coherence**2 - 1) / (independent - 1), 1e-6, 1 - 1e-9)
    return (1 - square) / (2 * independent * square)
