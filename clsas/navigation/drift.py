"""Coarse errors of a track, from the drift of responses between subaperture images.

A subaperture in which the track is off by a slope shows every response displaced along the track,
by range times slope. Neighbouring subapertures see the same responses, so that the displacement
between their images gives the change of slope, even where the track is off by more than the range
resolution. This is the map drift autofocus of radar (Carrara, Goodman and Majewski 1995, chapter
6), on small images around responses, so that it works on any grid and track. Responses that see
the sonar from different directions are displaced differently, which tells several unknowns apart.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.fft
import scipy.linalg
from numpy.typing import NDArray

from clsas.core.phasors import phasors
from clsas.navigation.responses import Contributions, Passage

_LENGTH = 1.5
"""Length of a subaperture in Fresnel lengths. A longer one makes a finer image, but errors bend
more within it. With half or twice the length, errors of 2 wavelengths rms are not found."""
_LEAST_PINGS = 4  # of a subaperture
_CELLS = 12  # azimuth cells to either side of a response
_PER_CELL = 2
_LAGS = (1, 2, 3)  # subapertures apart that are compared; each starts half a length after the last


def drift_m(passage: Passage, found: Contributions) -> NDArray[np.float64] | None:
    """Return displacements of the pings that line subapertures up with each other.

    Parameters
    ----------
    found : Contributions
        With offsets in range.

    Returns
    -------
    float64 [unknowns, pings] or None
        None where the track is too short for three subapertures. Those in gaps of the track are
        left out.
    """
    along_m = passage.along_m
    length_m = _LENGTH * passage.fresnel_length_m(found)
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
    groups = _groups(found)
    images, views = [], []
    for each in number:
        some = channels[each]
        at_m = channel_m[some] - starts_m[each]
        taper = np.sin(np.pi * at_m / length_m) ** 2
        cycles = frequency[:, None] * at_m
        turn = taper.astype(np.float32) * phasors((-2 * np.pi * cycles).astype(np.float32))
        values = found.values[some]
        # Products of small matrices keep to one thread: waiting for others takes longer.
        image = turn @ values.transpose(1, 0, 2)
        images.append(image.real**2 + image.imag**2)
        power = taper[:, None] * np.sum(values.real**2 + values.imag**2, axis=2)
        views.append([_view(found.gradient[:, some], power, at_m, group) for group in groups])
    pairs = [
        (first, second)
        for second in range(len(number))
        for first in range(max(second - max(_LAGS), 0), second)
        if number[second] - number[first] in _LAGS
    ]
    if not pairs:
        return None
    # The phase of an echo turns by -4 pi/wavelength per metre of range.
    step = -passage.wavelength_m / 2 * (frequency[1] - frequency[0])
    changes = step * _shifts(images, pairs, groups)
    middles_m = starts_m[number] + length_m / 2
    slopes = _slopes(changes, np.array(pairs), number, np.array(views), middles_m)
    return np.stack([_integrated(along_m, middles_m, each) for each in slopes])


def _groups(found: Contributions) -> list[NDArray[np.int64]]:
    """Return numbers of responses in groups that see the sonar from like directions.

    A single unknown displaces all of them alike. With several, more groups than unknowns tell
    these apart.
    """
    unknowns = len(found.gradient)
    power = np.square(np.abs(found.values[..., 0]), dtype=np.float64)
    total = np.maximum(power.sum(axis=0), 1e-300)
    direction = np.einsum("ucp,cp->up", found.gradient, power) / total
    direction -= direction.mean(axis=1, keepdims=True)
    along = np.linalg.svd(direction, full_matrices=False)[2][0]
    return np.array_split(np.argsort(along, kind="stable"), 1 if unknowns == 1 else unknowns + 1)


def _view(
    gradient: NDArray[np.float64],
    power: NDArray[np.float64],
    at_m: NDArray[np.float64],
    group: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return the range per displacement, and its change per metre along the track, [2, unknowns].

    Both are means over a group of responses, weighted by what a subaperture receives of them.
    """
    weights = power[:, group]
    total = max(float(weights.sum()), 1e-300)
    mean = np.einsum("ucp,cp->u", gradient[:, :, group], weights) / total
    away_m = at_m - float(weights.sum(axis=1) @ at_m) / total
    spread = max(float(weights.sum(axis=1) @ away_m**2), 1e-300)
    change = np.einsum("ucp,cp,c->u", gradient[:, :, group], weights, away_m) / spread
    return np.stack([mean, change])


def _shifts(
    images: Sequence[NDArray[np.float32]],
    pairs: Sequence[tuple[int, int]],
    groups: Sequence[NDArray[np.int64]],
) -> NDArray[np.float64]:
    """Return the shift in frequency between pairs of images, in steps, [pairs, groups].

    Images are [points, frequencies, offsets]. A shift maximises the sum over a group's responses
    of their correlations.
    """
    size = [scipy.fft.next_fast_len(2 * images[0].shape[axis]) for axis in (1, 2)]
    spectra: dict[int, NDArray[np.complex64]] = {}
    products = []
    for first, second in pairs:
        for each in (first, second):
            if each not in spectra:
                spectra[each] = scipy.fft.rfftn(images[each], s=size, axes=(1, 2))
                spectra.pop(each - max(_LAGS) - 1, None)
        both = spectra[first].conj() * spectra[second]
        products.append([both[group].sum(axis=0) for group in groups])
    power = scipy.fft.irfftn(np.array(products), s=size, axes=(2, 3))
    peaks = np.argmax(power.reshape(*power.shape[:2], -1), axis=2)
    row, column = np.unravel_index(peaks, size)
    pair, group = np.ogrid[: len(pairs), : len(groups)]
    before, at, after = (power[pair, group, (row + n) % size[0], column] for n in (-1, 0, 1))
    bend = before - 2 * at + after
    fraction = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, 1.0), 0.0)
    return (row + size[0] // 2) % size[0] - size[0] // 2 + fraction


def _slopes(
    changes: NDArray[np.float64],
    pairs: NDArray[np.int64],
    number: NDArray[np.int64],
    views: NDArray[np.float64],
    middles_m: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the slope of every unknown in every subaperture, the least-squares solution.

    A displacement e changes the range by g e, and its slope by g e' + g' e, where e is the integral
    of the slopes before.

    Parameters
    ----------
    changes : float64 [pairs, groups]
        Change of the range error's slope from the first subaperture of a pair to the second one.
    pairs : int64 [pairs, 2]
    number : int64 [subapertures]
        Numbers along the track.
    views : float64 [subapertures, groups, 2, unknowns]
        See `_view`.
    middles_m : float64 [subapertures]
    """
    count, _, _, unknowns = views.shape
    integral = np.zeros((count, count))
    for each, step_m in enumerate(np.diff(middles_m)):
        integral[each + 1] = integral[each]
        integral[each + 1, each : each + 2] += step_m / 2
    # [subapertures, groups, unknowns, slopes]
    of_slopes = views[:, :, 0, :, None] * np.eye(count)[:, None, None]
    of_slopes = of_slopes + views[:, :, 1, :, None] * integral[:, None, None]
    first, second = pairs.T
    weights = 1 / (number[second] - number[first])  # the farther apart, the less they look alike
    design = (of_slopes[second] - of_slopes[first]) * weights[:, None, None, None]
    right = changes * weights[:, None]
    # A common slope is a linear trend of the track, which is not observable.
    level = np.kron(np.eye(unknowns), np.full(count, 1 / count))
    design = np.concatenate([design.reshape(-1, unknowns * count), level])
    right = np.concatenate([right.ravel(), np.zeros(unknowns)])
    found = scipy.linalg.lstsq(design, right, lapack_driver="gelsy", check_finite=False)[0]
    return found.reshape(unknowns, count)


def _integrated(
    along_m: NDArray[np.float64], middles_m: NDArray[np.float64], slopes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return what undoes slopes at some places along the track, at every ping."""
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
