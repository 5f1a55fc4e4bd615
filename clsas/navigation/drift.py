"""Coarse errors of a track, from the drift of responses between images of subapertures.

If the track is off by a slope within a subaperture, the subaperture's image shows every response
displaced along the track by the range times that slope. Neighbouring subapertures see the same
responses, and the displacement between their images measures the change of slope, even if the track
is off by more than the range resolution. This is the map-drift autofocus of radar (Carrara, Goodman
and Majewski 1995, chapter 6). Here it uses small images around responses, so that it works with any
grid and track. Responses that see the sonar from different directions are displaced differently,
which allows solving for several unknowns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft
import scipy.linalg
from numpy.typing import NDArray

from clsas.engine.signal.interpolation import phasors
from clsas.navigation.peaks import parabola_peak
from clsas.navigation.responses import Contributions, Passage

_LENGTH = 1.5
"""Length of a subaperture in Fresnel lengths. In a longer one the image is finer, but errors bend
more. With half or twice this length, errors of 2 wavelengths rms are not found."""
_LEAST_PINGS = 4  # pings in a subaperture
_CELLS = 12  # azimuth cells to either side of a response
_PER_CELL = 2  # image samples per azimuth cell
# Distances between the subapertures that are compared. Each starts half a length after the last.
_LAGS = (1, 2, 3)


def drift_m(passage: Passage, found: Contributions) -> NDArray[np.float64] | None:
    """Return displacements of the pings that align the images of subapertures.

    Parameters
    ----------
    passage : Passage
    found : Contributions
        Contributions with offsets in range.

    Returns
    -------
    float64 [unknowns, pings] or None
        None if the track is too short for three subapertures, not counting those in gaps.
    """
    subapertures = _Subapertures.of(passage, found)
    number = subapertures.number
    if len(number) < 3:
        return None
    pairs = [
        (first, second)
        for second in range(len(number))
        for first in range(max(second - max(_LAGS), 0), second)
        if number[second] - number[first] in _LAGS
    ]
    if not pairs:
        return None
    length_m = subapertures.length_m
    frequency = np.arange(-_CELLS * _PER_CELL, _CELLS * _PER_CELL + 1) / (_PER_CELL * length_m)
    groups = _groups(found)
    images, gradients = [], []
    for channels, at_m in zip(subapertures.channels, subapertures.at_m, strict=True):
        taper = np.sin(np.pi * at_m / length_m) ** 2
        values = found.values[channels]
        images.append(_image(values, taper, frequency[:, None] * at_m))
        power = taper[:, None] * np.sum(values.real**2 + values.imag**2, axis=2)
        of_channels = found.gradient[:, channels]
        gradients.append([_mean_gradient(of_channels, power, at_m, group) for group in groups])
    # The phase of an echo changes by -4 pi/wavelength per metre of range.
    step = -passage.wavelength_m / 2 * (frequency[1] - frequency[0])
    changes = step * _shifts(images, pairs, groups)
    middles_m = subapertures.middles_m
    slopes = _slopes(changes, np.array(pairs), number, np.array(gradients), middles_m)
    return np.stack([_integrated(passage.along_m, middles_m, each) for each in slopes])


@dataclass(frozen=True, eq=False)
class _Subapertures:
    """Subapertures with enough pings.

    Attributes
    ----------
    length_m : float
    number : int64 [subapertures]
        Numbers along the track. Those of subapertures in gaps are missing.
    middles_m : float64 [subapertures]
        Positions of the middles along the track.
    channels : list of int64
        Channels of each subaperture.
    at_m : list of float64
        Positions of these channels along the track, from the start of the subaperture.
    """

    length_m: float
    number: NDArray[np.int64]
    middles_m: NDArray[np.float64]
    channels: list[NDArray[np.int64]]
    at_m: list[NDArray[np.float64]]

    @classmethod
    def of(cls, passage: Passage, found: Contributions) -> _Subapertures:
        """Return the subapertures of a passage, each starting half a length after the last."""
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
        return cls(
            length_m,
            number,
            starts_m[number] + length_m / 2,
            [channels[each] for each in number],
            [channel_m[channels[each]] - starts_m[each] for each in number],
        )


def _image(
    values: NDArray[np.complex64], taper: NDArray[np.float64], cycles: NDArray[np.float64]
) -> NDArray:
    """Return the intensities of small images around points, [points, frequencies, offsets].

    `values` are contributions, [channels, points, offsets], `taper` weighs the channels, and
    `cycles` are the phases that focus the frequencies, [frequencies, channels].
    """
    turn = taper.astype(np.float32) * phasors((-2 * np.pi * cycles).astype(np.float32))
    # A stack of small matrices is multiplied in one thread; synchronising several takes longer.
    image = turn @ values.transpose(1, 0, 2)
    return image.real**2 + image.imag**2


def _groups(found: Contributions) -> list[NDArray[np.int64]]:
    """Return the numbers of responses in groups that see the sonar from similar directions.

    A single unknown displaces all responses alike, so that one group is enough. Several unknowns
    need more groups than unknowns.
    """
    unknowns = len(found.gradient)
    power = np.square(np.abs(found.values[..., 0]), dtype=np.float64)
    total = np.maximum(power.sum(axis=0), 1e-300)
    direction = np.einsum("ucp,cp->up", found.gradient, power) / total
    direction -= direction.mean(axis=1, keepdims=True)
    along = np.linalg.svd(direction, full_matrices=False)[2][0]
    return np.array_split(np.argsort(along, kind="stable"), 1 if unknowns == 1 else unknowns + 1)


def _mean_gradient(
    gradient: NDArray[np.float64],
    power: NDArray[np.float64],
    at_m: NDArray[np.float64],
    group: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return the range per displacement, and its change per metre along the track, [2, unknowns].

    Both are means over a group of responses, weighted by the power that a subaperture receives.
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

    Images are [points, frequencies, offsets]. The shift maximises the sum of the correlations of a
    group's responses.
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
    around = (power[pair, group, (row + n) % size[0], column] for n in (-1, 0, 1))
    return (row + size[0] // 2) % size[0] - size[0] // 2 + parabola_peak(*around)


def _slopes(
    changes: NDArray[np.float64],
    pairs: NDArray[np.int64],
    number: NDArray[np.int64],
    gradients: NDArray[np.float64],
    middles_m: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the slope of each unknown in each subaperture, by least squares.

    A displacement e changes the range by g e and its slope by g e' + g' e, where e is the integral
    of the preceding slopes.

    Parameters
    ----------
    changes : float64 [pairs, groups]
        Change of the slope of the range error from the first subaperture of a pair to the second.
    pairs : int64 [pairs, 2]
    number : int64 [subapertures]
        Numbers along the track.
    gradients : float64 [subapertures, groups, 2, unknowns]
        g and g', see `_mean_gradient`.
    middles_m : float64 [subapertures]
    """
    count, _, _, unknowns = gradients.shape
    integral = np.zeros((count, count))
    for each, step_m in enumerate(np.diff(middles_m)):
        integral[each + 1] = integral[each]
        integral[each + 1, each : each + 2] += step_m / 2
    # [subapertures, groups, unknowns, slopes]
    of_slopes = gradients[:, :, 0, :, None] * np.eye(count)[:, None, None]
    of_slopes = of_slopes + gradients[:, :, 1, :, None] * integral[:, None, None]
    first, second = pairs.T
    weights = 1 / (number[second] - number[first])  # distant subapertures are less alike
    design = (of_slopes[second] - of_slopes[first]) * weights[:, None, None, None]
    right = changes * weights[:, None]
    # A common slope is a linear trend of the track, which cannot be observed.
    level = np.kron(np.eye(unknowns), np.full(count, 1 / count))
    design = np.concatenate([design.reshape(-1, unknowns * count), level])
    right = np.concatenate([right.ravel(), np.zeros(unknowns)])
    found = scipy.linalg.lstsq(design, right, lapack_driver="gelsy", check_finite=False)[0]
    return found.reshape(unknowns, count)


def _integrated(
    along_m: NDArray[np.float64], middles_m: NDArray[np.float64], slopes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the integral at every ping of slopes that are given at some positions."""
    slope = np.interp(along_m, middles_m, slopes)
    steps_m = np.diff(along_m) * (slope[1:] + slope[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(steps_m)])


def _along_channels_m(passage: Passage) -> NDArray[np.float64]:
    """Return the positions of all phase centres along the track, [channels]."""
    lines = passage.lines
    centres_m = lines.phase_centres_m
    middles_m = lines.ping_centres_m
    tangent = np.gradient(middles_m, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    ahead_m = np.einsum("ci,ci->c", centres_m - middles_m[passage.ping], tangent[passage.ping])
    return passage.along_m[passage.ping] + ahead_m
