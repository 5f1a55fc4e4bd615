"""Coarse errors of a track, from the drift of responses between subaperture images.

A subaperture in which the track is off by a slope shows every response displaced along the track,
by range times slope. Neighbouring subapertures see the same responses, so that the displacement
between their images gives the change of slope, even where the track is off by more than the range
resolution. This is the map drift autofocus of radar (Carrara, Goodman and Majewski 1995, chapter
6), on small images around responses, so that it works on any grid and track.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from clsas.core.lines import wavelength_m
from clsas.navigation.responses import Contributions, Passage

_LENGTH = 1.5
"""Length of a subaperture in lengths of sqrt(wavelength range/2). A longer one makes a finer image,
but errors bend more within it. With half or twice the length, errors of 2 wavelengths rms are not
found."""
_LEAST_PINGS = 4  # of a subaperture
_CELLS = 12  # azimuth cells to either side of a response
_PER_CELL = 4
_LAGS = (1, 2, 3)  # subapertures apart that are compared; each starts half a length after the last


def drift_m(passage: Passage, found: Contributions) -> NDArray[np.float64] | None:
    """Return the displacement of every ping that lines its subaperture up with the others.

    Parameters
    ----------
    found : Contributions
        With one unknown at least, the first of which is solved for, and offsets in range.

    Returns
    -------
    float64 [pings] or None
        None where the track is too short for three subapertures. Those in gaps of the track are
        left out.
    """
    wave_m = wavelength_m(passage.lines)
    along_m = passage.along_m
    length_m = _LENGTH * math.sqrt(wave_m * float(np.median(found.range_m)) / 2)
    length_m = max(length_m, _LEAST_PINGS * float(np.median(np.diff(along_m))))
    starts_m = np.arange(along_m[0], along_m[-1] - length_m, length_m / 2)
    channel_m = _along_channels_m(passage)
    channels = [
        np.flatnonzero((channel_m >= start_m) & (channel_m <= start_m + length_m))
        for start_m in starts_m
    ]
    number = np.flatnonzero([len(some) >= _LEAST_PINGS for some in channels])
    if len(number) < 3:
        return None
    frequency = np.arange(-_CELLS * _PER_CELL, _CELLS * _PER_CELL + 1) / (_PER_CELL * length_m)
    images, per_slope = [], []
    for each in number:
        some = channels[each]
        at_m = channel_m[some] - starts_m[each]
        taper = np.sin(np.pi * at_m / length_m) ** 2
        turn = taper * np.exp(-2j * np.pi * frequency[:, None] * at_m)
        values = found.values[some]
        image = np.tensordot(turn.astype(np.complex64), values.astype(np.complex64), 1)
        images.append(np.abs(image) ** 2)
        per_slope.append(-2 / wave_m * float(found.gradient[0, some].mean()))
    slopes = _slopes(images, number, frequency, per_slope)
    return _integrated(passage, starts_m[number] + length_m / 2, slopes)


def _slopes(
    images: list[NDArray[np.float32]],
    number: NDArray[np.int64],
    frequency: NDArray[np.float64],
    per_slope: list[float],
) -> NDArray[np.float64]:
    """Return the slope of the track's error in every subaperture, the least-squares solution.

    Images are [frequencies, points, offsets], of subapertures of some numbers along the track;
    `per_slope` is the frequency of a slope of 1.
    """
    count, step = len(images), frequency[1] - frequency[0]
    size = [scipy.fft.next_fast_len(2 * images[0].shape[axis]) for axis in (0, 2)]
    spectra = [scipy.fft.fftn(each, s=size, axes=(0, 2)) for each in images]
    rows, right = [], []
    for first in range(count):
        for second in range(first + 1, min(first + max(_LAGS) + 1, count)):
            lag = int(number[second] - number[first])
            if lag not in _LAGS:
                continue
            both = np.sum(spectra[first].conj() * spectra[second], axis=1)
            power = scipy.fft.ifftn(both).real
            row, column = np.unravel_index(int(np.argmax(power)), power.shape)
            before, at, after = (power[(row + n) % size[0], column] for n in (-1, 0, 1))
            bend = before - 2 * at + after
            shift = (row + size[0] // 2) % size[0] - size[0] // 2
            shift += 0.5 * (before - after) / bend if bend < 0 else 0.0
            each = np.zeros(count)
            each[second], each[first] = 1 / lag, -1 / lag
            rows.append(each)
            mean = (per_slope[first] + per_slope[second]) / 2
            right.append(shift * step / mean / lag)
    if not rows:
        return np.zeros(count)
    return np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]


def _integrated(
    passage: Passage, middles_m: NDArray[np.float64], slopes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return what undoes slopes at some places along the track, at every ping."""
    along_m = passage.along_m
    slope = np.interp(along_m, middles_m, slopes)
    steps_m = np.diff(along_m) * (slope[1:] + slope[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(steps_m)])


def _along_channels_m(passage: Passage) -> NDArray[np.float64]:
    """Return how far along the track every channel's phase centre lies."""
    lines = passage.lines
    centres_m = lines.phase_centres_m
    middles_m = lines.ping_centres_m
    tangent = np.gradient(middles_m, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    ahead_m = np.einsum("ci,ci->c", centres_m - middles_m[passage.ping], tangent[passage.ping])
    return passage.along_m[passage.ping] + ahead_m
