"""Bright responses of an image, and the errors of the track that they show.

Responses are local maxima of an image. What each ping contributes to them is read from the lines
along the assumed track. If the track is wrong, contributions differ in phase, and responses drift.
Three estimates follow from that, the coarse one first:

*Drift.* If the track is off by a slope within a subaperture, the subaperture's image shows every
response displaced along the track by the range times that slope. Neighbouring subapertures see the
same responses, and the displacement between their images measures the change of slope, even if the
track is off by more than the range resolution. This is the map-drift autofocus of radar (Carrara,
Goodman and Majewski 1995, chapter 6). Here it uses small images around responses, so that it works
with any grid and track. Responses that see the sonar from different directions are displaced
differently, which allows solving for several unknowns.

*Phase steps.* Phase-gradient autofocus (Wahl, Eichel, Ghiglia and Jakowatz 1994) solves for one
phase per ping. Here a position per ping is solved for instead, so that every response receives the
phase of its own direction.

*Single pings.* The sharpness of the responses is maximised over one ping after another (Ash 2012).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft
import scipy.linalg
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, maximum_filter
from scipy.spatial.distance import cdist

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import DEVIATION_PER_MEDIAN
from clsas.engine.data.fourier import phasors, turned_single
from clsas.engine.data.geometry import SAME_PLACE_M, pairwise_range_m
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines, wavelength_m
from clsas.engine.data.threads import in_threads
from clsas.engine.data.visibility import sines
from clsas.engine.signal.interpolation import Readout
from clsas.navigation.checks import displacement_axes, parabola_peak

READ_DB = -40.0
"""Accuracy with which the lines are read."""
_READ_AT_ONCE = 1 << 17  # samples per thread, which bounds the memory

# Drift.
# Length of a subaperture in Fresnel lengths. In a longer one the image is finer, but errors bend
# more. With half or twice this length, errors of 2 wavelengths rms are not found.
_LENGTH = 1.5
_LEAST_PINGS = 4  # pings in a subaperture
_CELLS = 12  # azimuth cells to either side of a response
_PER_CELL = 2  # image samples per azimuth cell
# Distances between the subapertures that are compared. Each starts half a length after the last.
_LAGS = (1, 2, 3)

# Phases.
_PASSES = 3  # alternations between steps of the track and slopes of the responses
_TRIED = 9  # displacements tried within half a wavelength: 4 per cycle of the sharpness
_NEWTON = 3  # Newton steps from the best of them
_SWEEPS = 2  # sweeps over all pings
# Blocks of pings that move together. With fewer blocks, the sum over the other pings would change
# too much while a block moves.
_BLOCKS = 16


@dataclass(frozen=True, eq=False)
class Passage:
    """Passage of the sonar: its pings, and the directions in which each may be displaced.

    Attributes
    ----------
    lines : RangeLines
    ping : int64 [channels]
        Ping of every channel.
    along_m : float64 [pings]
        Distance travelled.
    axes : float64 [unknowns, pings, 3]
        Unit vectors of the displacements that are solved for.
    wavelength_m : float
        Wavelength at the centre of the lines' band.
    """

    lines: RangeLines
    ping: NDArray[np.int64]
    along_m: NDArray[np.float64]
    axes: NDArray[np.float64]
    wavelength_m: float

    @classmethod
    def of(cls, lines: RangeLines, unknowns: tuple[str, ...], wavelength_m: float) -> Passage:
        """Return the passage of lines; `unknowns` are some of "sway", "heave" and "surge"."""
        steps_m = np.linalg.norm(np.diff(lines.ping_centres_m, axis=0), axis=1)
        travelled_m = np.concatenate([[0.0], np.cumsum(steps_m)])
        axes = displacement_axes(lines, unknowns)
        return cls(lines, lines.ping_numbers, travelled_m, axes, wavelength_m)

    @property
    def pings(self) -> int:
        """Number of pings."""
        return len(self.along_m)

    def fresnel_length_m(self, found: Contributions) -> float:
        """Return sqrt(wavelength range/2), the length over which wavefronts are nearly plane."""
        return math.sqrt(self.wavelength_m * float(np.median(found.range_m)) / 2)

    def by_ping(self, values: NDArray) -> NDArray:
        """Return sums of values, [channels, ...], over the channels of each ping, [pings, ...]."""
        return np.add.reduceat(values, self.lines.ping_starts, axis=0)

    def mean_by_ping(self, values: NDArray) -> NDArray:
        """Return means of values, [channels, n], over the channels of each ping, [pings, n]."""
        return self.by_ping(values) / np.bincount(self.ping)[:, None]

    def vectors_m(self, moved_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the displacements of channels, [channels, 3], for those of pings.

        `moved_m` is [unknowns, pings].
        """
        return np.einsum("up,upi->pi", moved_m, self.axes)[self.ping]


def brightest(image: Image, count: int, apart_m: float) -> NDArray[np.float64]:
    """Return the positions of the largest local maxima of an image, at most `count`, [n, 3].

    Each is the largest pixel within `apart_m` along rows and columns.
    """
    amplitude, points_m = np.abs(image.pixels), image.grid.points_m
    size = []
    for axis, most in enumerate(amplitude.shape):
        if points_m is None:
            step_m = float(np.linalg.norm(image.grid.vectors_m[1 + axis]))
        else:
            lengths_m = np.linalg.norm(np.diff(points_m, axis=axis), axis=-1)
            step_m = float(np.median(lengths_m)) if lengths_m.size else 0.0
        size.append(2 * math.ceil(min(apart_m / step_m, most)) + 1 if step_m > 0 else 1)
    largest = amplitude == maximum_filter(amplitude, size=tuple(size), mode="constant")
    found = np.flatnonzero((largest & (amplitude > 0)).ravel())
    found = found[np.argsort(-amplitude.ravel()[found], kind="stable")[:count]]
    return image.grid.at(found)


@dataclass(frozen=True, eq=False)
class Contributions:
    """Contributions of every channel to some points.

    Attributes
    ----------
    values : complex64 [channels, points, offsets]
        Samples at the range of the point plus each offset, with the phase of the path removed.
    gradient : float64 [unknowns, channels, points]
        Change in range per metre of displacement.
    range_m : float64 [channels, points]
    """

    values: NDArray[np.complex64]
    gradient: NDArray[np.float64]
    range_m: NDArray[np.float64]

    def of(self, points: NDArray[np.bool_]) -> Contributions:
        """Return the contributions to some of the points."""
        return Contributions(
            self.values[:, points], self.gradient[:, :, points], self.range_m[:, points]
        )


def contributions(
    passage: Passage,
    readout: Readout,
    lines: RangeLines,
    points_m: NDArray[np.float64],
    beam: BeamWindow | None,
    offsets_m: NDArray[np.float64] | None = None,
) -> Contributions:
    """Return the contributions to points and, with offsets, to ranges beside them.

    `readout` reads the lines of the passage, and `lines` are the same with corrected positions.
    """
    offsets_m = np.zeros(1) if offsets_m is None else offsets_m
    shape = lines.channels, len(points_m)
    values = np.empty((*shape, len(offsets_m)), np.complex64)
    gradient, range_m = np.empty((len(passage.axes), *shape)), np.empty(shape)
    along = None if beam is None else beam.directions(lines)
    step = max(_READ_AT_ONCE // max(len(points_m) * len(offsets_m), lines.length), 1)

    def read(first: int) -> None:
        some = np.arange(first, min(first + step, lines.channels))
        part = lines.select(slice(int(some[0]), int(some[-1]) + 1))
        gradient[:, some] = _gradient(points_m, part, passage.axes[:, passage.ping[some]])
        path_m = pairwise_range_m(
            points_m, part.tx_m, part.rx_m, part.rx_velocity_m_s, part.sound_speed_m_s
        ).T
        range_m[some] = path_m
        at_m = (path_m[..., None] + offsets_m).reshape(len(some), -1)
        received = readout.read(some, at_m) * turned_single(lines.carrier_cycles_per_m * at_m)
        values[some] = received.reshape(len(some), len(points_m), -1)
        if beam is not None and along is not None:
            sine = sines(points_m, part.phase_centres_m, along[some])
            values[some] *= beam.weights(sine, wavelength_m(lines))[..., None]

    for _ in in_threads(read, range(0, lines.channels, step)):
        pass
    return Contributions(values, gradient, range_m)


def _gradient(
    points_m: NDArray[np.float64], lines: RangeLines, axes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the change in range to points per metre along axes, [unknowns, channels, points].

    `axes` are [unknowns, channels, 3].
    """
    ends_m = (lines.tx_m,) if lines.is_monostatic else (lines.tx_m, lines.rx_m)
    total = np.zeros((*axes.shape[:2], len(points_m)))
    for end_m in ends_m:
        # Positions are relative to one of them, so that large coordinates do not cancel.
        along_m = axes @ (points_m - end_m[0]).T
        along_m -= np.sum(axes * (end_m - end_m[0]), axis=-1)[..., None]
        total -= along_m / np.maximum(cdist(end_m, points_m), SAME_PLACE_M)
    return total / len(ends_m)


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
    # Subapertures with enough pings; numbers of those in gaps are missing.
    along_m, channel_m = passage.along_m, _along_channels_m(passage)
    length_m = _LENGTH * passage.fresnel_length_m(found)
    length_m = max(length_m, _LEAST_PINGS * float(np.median(np.diff(along_m))))
    starts_m = np.arange(along_m[0], along_m[-1] - length_m, length_m / 2)
    members = [
        np.flatnonzero((channel_m >= start_m) & (channel_m <= start_m + length_m))
        for start_m in starts_m
    ]
    number = np.flatnonzero([len(some) >= _LEAST_PINGS for some in members])
    pairs = [
        (first, second)
        for second in range(len(number))
        for first in range(max(second - max(_LAGS), 0), second)
        if number[second] - number[first] in _LAGS
    ]
    if len(number) < 3 or not pairs:
        return None

    # Intensities of their images, small ones around each point, and the mean gradients of groups
    # of points.
    groups = _groups(found)
    frequency = np.arange(-_CELLS * _PER_CELL, _CELLS * _PER_CELL + 1) / (_PER_CELL * length_m)
    images, gradients = [], []
    for each in number.tolist():
        channels = members[each]
        at_m = channel_m[channels] - starts_m[each]
        taper = np.sin(np.pi * at_m / length_m) ** 2
        values = found.values[channels]
        turns = (-2 * np.pi * (frequency[:, None] * at_m)).astype(np.float32)
        # A stack of small matrices is multiplied in one thread; synchronising several takes longer.
        image = (taper.astype(np.float32) * phasors(turns)) @ values.transpose(1, 0, 2)
        images.append(image.real**2 + image.imag**2)
        power = taper[:, None] * np.sum(values.real**2 + values.imag**2, axis=2)
        of_channels = found.gradient[:, channels]
        gradients.append([_mean_gradient(of_channels, power, at_m, group) for group in groups])

    # The phase of an echo changes by -4 pi/wavelength per metre of range.
    step = -passage.wavelength_m / 2 * (frequency[1] - frequency[0])
    changes = step * _shifts(images, pairs, groups)
    middles_m = starts_m[number] + length_m / 2
    displacements_m = np.zeros((len(found.gradient), passage.pings))
    for unknown, slopes in enumerate(
        _slopes(changes, np.array(pairs), number, np.array(gradients), middles_m)
    ):
        slope = np.interp(along_m, middles_m, slopes)
        steps_m = np.diff(along_m) * (slope[1:] + slope[:-1]) / 2
        displacements_m[unknown, 1:] = np.cumsum(steps_m)
    return displacements_m


def _along_channels_m(passage: Passage) -> NDArray[np.float64]:
    """Return the positions of all phase centres along the track, [channels]."""
    centres_m, middles_m = passage.lines.phase_centres_m, passage.lines.ping_centres_m
    tangent = np.gradient(middles_m, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    ahead_m = np.einsum("ci,ci->c", centres_m - middles_m[passage.ping], tangent[passage.ping])
    return passage.along_m[passage.ping] + ahead_m


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
    images: list[NDArray[np.float32]],
    pairs: list[tuple[int, int]],
    groups: list[NDArray[np.int64]],
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


def phase_gradient_m(
    passage: Passage, found: Contributions, neighbourhood_m: float
) -> NDArray[np.float64]:
    """Return displacements of the pings, [unknowns, pings], that make phases of responses linear.

    Contributions are smoothed along the track so that only echoes within about `neighbourhood_m` of
    a response remain.
    """
    values = passage.by_ping(found.values[..., 0])
    turns = _turns(passage, found)
    spacing_m = float(np.median(np.diff(passage.along_m)))
    smoothed_m = passage.fresnel_length_m(found) ** 2 / neighbourhood_m
    width = min(smoothed_m / max(spacing_m, 1e-12) / 2, passage.pings)
    smooth = gaussian_filter1d(values, width, axis=0, mode="constant")
    product = smooth[1:] * smooth[:-1].conj()
    weights = np.abs(product).astype(np.float64)  # 1e-300 is 0 in single precision
    product = (product / np.maximum(weights, 1e-300)).astype(np.complex64)
    turns = (turns[:, 1:] + turns[:, :-1]) / 2
    slope = np.angle(np.sum(weights * product, axis=0))
    steps_m = np.zeros((len(turns), len(product)))
    normal = np.einsum("sp,usp,vsp->suv", weights, turns, turns)
    # Keeps the matrix regular where unknowns are nearly alike, or where nothing is received.
    normal += 1e-12 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(len(turns))
    normal += 1e-300 * np.eye(len(turns))
    total = np.maximum(weights.sum(axis=0), 1e-300)
    for _ in range(_PASSES):
        expected = slope - np.einsum("us,usp->sp", steps_m, turns)
        slope = slope + np.sum(weights * _phase(product, expected), axis=0) / total
        expected = slope - np.einsum("us,usp->sp", steps_m, turns)
        right = np.einsum("sp,usp,sp->su", weights, turns, _phase(product, expected))
        steps_m -= np.linalg.solve(normal, right[..., None])[..., 0].T
    # The steps lead from the assumed track to the true one, so that adding them corrects it.
    return np.concatenate([np.zeros((len(turns), 1)), np.cumsum(steps_m, axis=1)], axis=1)


def _phase(product: NDArray[np.complex64], expected: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the phases of `product` relative to the expected ones."""
    return np.angle(product * phasors(-expected.astype(np.float32)))


def _turns(passage: Passage, found: Contributions) -> NDArray[np.float64]:
    """Return the phase per displacement of a ping, rad/m, [unknowns, pings, points]."""
    gradient = np.stack([passage.mean_by_ping(each) for each in found.gradient])
    return 4 * np.pi / passage.wavelength_m * gradient


def sharpest_m(
    passage: Passage, found: Contributions
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return displacements of single pings that maximise the sharpness of the responses.

    Sharpness is the sum of the squared intensities of the responses. If all other pings are fixed,
    it is a function of the displacement of one ping alone. In closed-form backprojection autofocus
    (Ash 2012), it is a function of one phase. With several unknowns, a ping is moved along one
    direction after another; the directions are chosen so that their effects on the responses are
    independent.

    Returns
    -------
    moved_m : float64 [unknowns, pings]
    deviation_m : float64 [pings]
        Standard deviation of the length of the displacement, from the scatter of the contributions
        of a ping around their mean over all pings.
    """
    values = passage.by_ping(found.values[..., 0])
    turns = _turns(passage, found)
    # The responses are most sensitive to the first direction, [pings, directions, unknowns].
    normal = np.einsum("upk,vpk,pk->puv", turns, turns, np.abs(values) ** 2)
    directions = np.linalg.eigh(normal)[1].swapaxes(1, 2)[:, ::-1]
    turns = np.einsum("pau,upk->apk", directions, turns).astype(np.float32)
    furthest_m = passage.wavelength_m / 4
    unknowns, pings, _ = turns.shape
    moved_m = np.zeros((unknowns, pings), np.float32)
    turned, total = values.copy(), values.sum(axis=0)
    for sweep in range(_SWEEPS):
        order = np.random.default_rng(sweep).permutation(pings)
        for some in np.array_split(order, min(_BLOCKS, pings)):
            for axis, turn in enumerate(turns[:, some]):
                others = total - turned[some]
                own = turned[some] * phasors(-turn * moved_m[axis, some, None])
                level = np.abs(others) ** 2 + np.abs(own) ** 2
                best_m = _sharpest(level, others.conj() * own, turn, furthest_m)
                own *= phasors(turn * best_m[:, None])
                total = total + np.sum(own - turned[some], axis=0)
                moved_m[axis, some], turned[some] = best_m, own
    mean = total / pings
    noise = np.mean(np.abs(turned - mean) ** 2, axis=1)
    information = 2 * np.einsum("apk,k->ap", turns**2, np.abs(mean) ** 2).astype(np.float64)
    variance = np.sum(noise / np.maximum(information, 1e-300), axis=0)
    return np.einsum("pau,ap->up", directions, moved_m), np.sqrt(variance)


def _sharpest(
    level: NDArray[np.float32],
    cross: NDArray[np.complex64],
    turn: NDArray[np.float32],
    furthest_m: float,
) -> NDArray[np.float32]:
    """Return the displacements of some pings that maximise the sharpness, [pings].

    The intensity of a response is level + 2 Re(cross exp(j turn displacement)), where `level`,
    `cross` and `turn` are [pings, points].
    """
    step_m = 2 * furthest_m / (_TRIED - 1)
    rotation = phasors(turn * np.float32(step_m))
    tried = cross * phasors(-turn * np.float32(furthest_m))
    sharpness = np.empty((_TRIED, len(cross)), np.float32)
    for number in range(_TRIED):
        sharpness[number] = np.sum((level + 2 * tried.real) ** 2, axis=1)
        tried = tried * rotation
    first_m = np.float32(step_m) * np.argmax(sharpness, axis=0).astype(np.float32) - furthest_m
    moved_m = first_m.copy()
    for _ in range(_NEWTON):
        at = cross * phasors(turn * moved_m[:, None])
        intensity = level + 2 * at.real
        slope = -2 * turn * at.imag
        bend = np.sum(slope**2 - 2 * intensity * turn**2 * at.real, axis=1)
        gain = np.sum(intensity * slope, axis=1)
        # A Newton step increases the sharpness only where the curvature is negative.
        moved_m += np.where(bend < 0, -gain / np.where(bend < 0, bend, 1.0), 0.0)
        moved_m = np.clip(moved_m, first_m - step_m, first_m + step_m)
    return moved_m


def disagreement_m(passage: Passage, found: Contributions) -> float:
    """Return how much two halves of the responses disagree about the ranges of single pings.

    The responses of a scene agree because one track explains all of them. The brightest pixels of
    speckle can also be made brighter, but each by a different track. The result is the median over
    three ways to divide the responses, because a single one may put most of the bright ones into
    one half.
    """
    quarter = np.arange(found.values.shape[1]) % 4
    gradient = found.gradient[:, passage.lines.ping_starts]
    apart_m = []
    for other in (1, 2, 3):
        first = (quarter == 0) | (quarter == other)
        moved_m = [sharpest_m(passage, found.of(some))[0] for some in (first, ~first)]
        apart = moved_m[0] - moved_m[1]
        apart -= np.median(apart, axis=1, keepdims=True)
        # The median ignores single pings for which one half is off by half a wavelength of path.
        apart_m.append(np.median(np.abs(np.einsum("up,upk->pk", apart, gradient))))
    return float(np.median(apart_m)) * DEVIATION_PER_MEDIAN / 2
