"""Echoes from all directions of a beam, as two pings of one common geometry would receive them.

Pairs of channels share a phase centre, but not their transmitter and receiver. For an echo at an
angle a off broadside their ranges differ by about u A sin(a)^2/R, for an advance A, a range R and a
distance u along the overlap. That looks like a yaw, of milliradians where beams are wide. Its mean
over the beam depends on where the echoes come from, which no scene spreads evenly. Therefore the
channels of either ping are combined along the overlap: every direction of the beam then arrives
with the phase that it would have with the mean of both geometries. This holds for each direction by
itself, however strong its echoes are.

Uniform arrays cannot tell directions apart whose sines differ by half a wavelength over the spacing
of the phase centres. Filters may let only the middle of the beam pass, whose partners are weak.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from clsas.core.geometry import bistatic_range_m
from clsas.core.lines import RangeLines
from clsas.navigation.overlap import Array, Overlap
from clsas.navigation.swath import Swath
from clsas.sonar.system import element_pattern

ALL, MIDDLE = 1.0, 0.25
"""Half width of what passes, in periods of ambiguous directions: all of them, or the middle of the
beam. The middle has the least error where there is little noise; noise wants all echoes."""

_BANDS = 6  # of the spectrum, with filters of their own
_EDGE = 0.03  # of that period: how gradually
# Exponent of the even beam's power, by which filters weigh directions. With 1 strong echoes at the
# edge of the beam pass too: 1.7 times the error in a scene of few scatterers, beside 0.25.
_PRIOR = 0.25
_NOISE = 0.01  # power over the echoes', against which filters are regularised
_TURN = 0.1  # cycles by which a direction's phase may change from one node in range to the next
_MOST_NODES = 16
_WIDEST = math.radians(75)  # half of the beam that is considered
_LEAST_ANGLES = 65
_PADDING = 16  # samples of zeros beyond the lines: filters delay by less


@dataclass(frozen=True, eq=False)
class Frame:
    """Geometry of an overlap: the pairs' phase centres, and the rays to the seabed.

    Attributes
    ----------
    centre_m : float64 [pairs, 3]
        Phase centres, means of both channels'.
    forward, outward : float64 [3]
        Horizontal unit vectors along the array and to the seabed.
    """

    centre_m: NDArray[np.float64]
    forward: NDArray[np.float64]
    outward: NDArray[np.float64]

    def rays(self, swath: Swath, range_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return unit vectors from phase centres to the seabed at ranges, [pairs, n, 3]."""
        across, up = swath.slopes(self.centre_m[:, 2:], range_m)
        shape = len(self.centre_m), len(range_m)
        rays = np.broadcast_to(across, shape)[..., None] * self.outward
        rays[..., 2] += up
        return rays


@dataclass(frozen=True, eq=False)
class Alignment:
    """Filters along an overlap that bring both pings to one geometry.

    Attributes
    ----------
    range_m : float64 [nodes]
        Ranges that filters are made for. They change linearly with the inverse of range between.
    cycles_per_m : float64 [bands]
        Phase per metre of range in the middle of each band.
    first, second : complex128 [nodes, bands, pairs, pairs]
        Filters of either ping: rows give channels of the common geometry.
    sensitivity : float64 [nodes, pairs]
        Decrease in range per metre of sway, a mean over the directions that pass.
    echoes, noise : complex128 [pairs, pairs]
        Correlation that filtered channels have of an even seabed, and of white noise.
    coherence : float
        Of both pings over an even seabed: filters leave differences.
    uneven_rad : float64 [pairs]
        Phases of echoes from the middle of the beam alone, beside those of an even seabed.
    """

    range_m: NDArray[np.float64]
    cycles_per_m: NDArray[np.float64]
    first: NDArray[np.complex128]
    second: NDArray[np.complex128]
    sensitivity: NDArray[np.float64]
    echoes: NDArray[np.complex128]
    noise: NDArray[np.complex128]
    coherence: float
    uneven_rad: NDArray[np.float64]

    def apply(
        self,
        values: tuple[NDArray[np.complex128], NDArray[np.complex128]],
        range_m: NDArray[np.float64],
        cycles_per_m: float,
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return channels of both pings in the common geometry, [pairs, ranges].

        `values` are read along rays, at `range_m`; `cycles_per_m` is the phase that was left out.
        """
        count = len(range_m)
        step_m = float(range_m[1] - range_m[0])
        length = scipy.fft.next_fast_len(count + _PADDING)
        at = cycles_per_m + scipy.fft.fftfreq(length, step_m)
        band = np.argmin(np.abs(at[:, None] - self.cycles_per_m), axis=1)
        members = [np.flatnonzero(band == each) for each in range(len(self.cycles_per_m))]
        shares = self.shares(range_m)
        found = []
        for each, filters in zip(values, (self.first, self.second), strict=True):
            spectrum = scipy.fft.fft(each, length, axis=1)
            total = np.zeros_like(each)
            for share, node in zip(shares, filters, strict=True):
                filtered = np.empty_like(spectrum)
                for some, matrix in zip(members, node, strict=True):
                    filtered[:, some] = matrix @ spectrum[:, some]
                total += share * scipy.fft.ifft(filtered, axis=1)[:, :count]
            found.append(total)
        return found[0], found[1]

    def shared(self, coherence: float) -> NDArray[np.float64]:
        """Return how pairs' phase errors correlate, [pairs, pairs].

        A phase errs by products of one channel's echoes with the other's noise, and of both noises.
        Neighbours share some of both, once filtered.
        """
        echoes, noise = coherence, 1 - coherence
        products = 2 * echoes * (self.echoes.conj() * self.noise).real
        products += noise * np.abs(self.noise) ** 2
        return products / (2 * echoes + noise)

    def shares(self, range_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the weights of nodes at ranges, [nodes, ranges]."""
        nodes = np.arange(len(self.range_m), dtype=np.float64)
        # Inverse ranges fall, np.interp wants them to rise.
        place = np.interp(-1 / range_m, -1 / self.range_m, nodes)
        return np.maximum(1 - np.abs(place - nodes[:, None]), 0.0)


def ranges_m(
    lines: RangeLines, channels: NDArray[np.int64], points_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return ranges of points [channels or 1, n, 3] in channels, [channels, n]."""
    velocity = lines.rx_velocity_m_s
    return bistatic_range_m(
        points_m,
        lines.tx_m[channels, None],
        lines.rx_m[channels, None],
        None if velocity is None else velocity[channels, None],
        lines.sound_speed_m_s,
    )


def alignment(
    lines: RangeLines,
    array: Array,
    pairs: Overlap,
    frame: Frame,
    swath: Swath,
    band: NDArray[np.float64],
    half_width: float,
) -> Alignment:
    """Return the filters that bring the channels of two pings to one geometry.

    A filter is the linear estimate with the least mean square error, over an even seabed under the
    beam, of the channels that the mean geometry would have. `band` is the phase per metre of range
    at frequencies that stand for equal shares of the power, ascending; `half_width` is `ALL` or
    `MIDDLE`.
    """
    cycles_per_m = band.reshape(_BANDS, -1).mean(axis=1)
    beam = _Beam(lines, array, pairs, frame, swath, cycles_per_m, half_width)
    near_m, far_m = swath.edges_m[[0, -1]]
    range_m = 1 / np.linspace(1 / near_m, 1 / far_m, beam.nodes(near_m, far_m))
    made = [beam.filters(each) for each in range_m]
    first, second, sensitivity, echoes, noise, coherence, uneven_rad = (
        np.stack(each) for each in zip(*made, strict=True)
    )
    return Alignment(
        range_m,
        cycles_per_m,
        first,
        second,
        sensitivity,
        _normalised(echoes.mean(axis=0)),
        _normalised(noise.mean(axis=0)),
        float(coherence.mean()),
        uneven_rad.mean(axis=0),
    )


def _normalised(covariance: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return the correlations of a covariance."""
    size = np.sqrt(np.diag(covariance).real)
    return covariance / np.outer(size, size)


class _Beam:
    """Directions of a beam, and the phases with which two pings receive them."""

    def __init__(
        self,
        lines: RangeLines,
        array: Array,
        pairs: Overlap,
        frame: Frame,
        swath: Swath,
        cycles_per_m: NDArray[np.float64],
        half_width: float,
    ) -> None:
        assert swath.element_length_m is not None
        self.lines, self.pairs, self.frame, self.swath = lines, pairs, frame, swath
        self.cycles_per_m, self.lengths_m = cycles_per_m, swath.element_length_m
        self.half_width = half_width
        self.headings = [
            array.forward[int(np.searchsorted(array.starts, each[0], "right")) - 1]
            for each in (pairs.first, pairs.second)
        ]
        highest = float(np.abs(cycles_per_m).max())
        longest_m = max(self.lengths_m) * highest / 2
        widest = math.sin(min(math.asin(min(1 / longest_m, 1.0)), _WIDEST))
        # Phases of the outermost channels must not turn by half a cycle between directions.
        turns = 2 * widest * highest * float(np.ptp(pairs.along_m))
        self.sine = np.linspace(-widest, widest, max(_LEAST_ANGLES, 2 * int(turns) + 1))

    def nodes(self, near_m: float, far_m: float) -> int:
        """Return the number of ranges that filters must be made for."""
        turn = []
        for each in (near_m, far_m):
            first, second, _ = self._late_m(each)
            turn.append((second - first) * np.abs(self.cycles_per_m).max())
        change = np.abs(turn[1] - turn[0]) * self._passed(float(np.abs(self.cycles_per_m).mean()))
        return min(2 + int(float(change.max()) / _TURN), _MOST_NODES)

    def filters(self, range_m: float) -> tuple[NDArray, ...]:
        """Return what an `Alignment` holds at a range, from filters to `uneven_rad`."""
        first_m, second_m, rays = self._late_m(range_m)
        count, bands = len(first_m), len(self.cycles_per_m)
        filters = np.zeros((2, bands, count, count), np.complex128)
        expected, of_middle = (np.zeros(count, np.complex128) for _ in range(2))
        seen = np.zeros(len(self.sine))
        echoes, noise = (np.zeros((count, count), np.complex128) for _ in range(2))
        energy = np.zeros((2, count))
        for band, cycles_per_m in enumerate(self.cycles_per_m):
            power = self._power(rays, cycles_per_m)
            passed = self._passed(cycles_per_m)
            target = passed * np.exp(-1j * np.pi * cycles_per_m * (first_m + second_m))
            arrived = []
            for ping, late_m in enumerate((first_m, second_m)):
                steering = np.exp(-2j * np.pi * cycles_per_m * late_m)
                weighted = (power**_PRIOR * steering).conj().T
                covariance = steering @ weighted
                covariance += _NOISE * np.sum(power**_PRIOR) * np.eye(count)
                # The covariance is Hermitian: solving from the left gives the filter's transpose.
                matrix = np.linalg.solve(covariance.conj(), (target @ weighted).T).T
                filters[ping, band] = matrix
                arrived.append(matrix @ steering)
                energy[ping] += np.abs(arrived[-1]) ** 2 @ power
                echoes += (power * arrived[-1]) @ arrived[-1].conj().T
                noise += matrix @ matrix.conj().T
            products = power * arrived[1].conj() * arrived[0]
            expected += products.sum(axis=1)
            of_middle += products[:, self._periods(cycles_per_m) <= MIDDLE].sum(axis=1)
            seen += power * passed**2
        # Few channels leave a phase, which an even seabed's mean tells.
        filters[1] *= (expected / np.maximum(np.abs(expected), 1e-300))[:, None]
        port = self.swath.side * self.frame.outward
        sensitivity = np.full(count, float(np.average(rays @ port, weights=seen)))
        square = np.mean(np.abs(expected) ** 2 / np.maximum(energy[0] * energy[1], 1e-300))
        uneven_rad = np.angle(of_middle * expected.conj())
        return filters[0], filters[1], sensitivity, echoes, noise, np.sqrt(square), uneven_rad

    def _late_m(self, range_m: float) -> tuple[NDArray, NDArray, NDArray]:
        """Return ranges of directions beyond those of channels' own rays, and the directions.

        Both pings' are [pairs, angles]; directions are seen from the middle of the overlap.
        """
        frame = self.frame
        own = frame.rays(self.swath, np.array([range_m]))
        ray = own.mean(axis=0)
        rays = np.sqrt(1 - self.sine**2)[:, None] * ray + self.sine[:, None] * frame.forward
        points_m = (range_m * rays + frame.centre_m.mean(axis=0))[None]
        own_m = range_m * own + frame.centre_m[:, None]
        late_m = [
            ranges_m(self.lines, each, points_m) - ranges_m(self.lines, each, own_m)
            for each in (self.pairs.first, self.pairs.second)
        ]
        return late_m[0], late_m[1], rays

    def _passed(self, cycles_per_m: float) -> NDArray[np.float64]:
        """Return the amplitude with which directions pass."""
        return 1 / (1 + np.exp((self._periods(cycles_per_m) - self.half_width) / _EDGE))

    def _periods(self, cycles_per_m: float) -> NDArray[np.float64]:
        """Return directions in periods of those that the array cannot tell apart."""
        steps_m = np.diff(np.sort(self.pairs.along_m))
        spacing_m = float(np.median(steps_m)) if len(steps_m) else 0.0
        return np.abs(self.sine) * abs(cycles_per_m) * spacing_m

    def _power(self, rays: NDArray[np.float64], cycles_per_m: float) -> NDArray[np.float64]:
        """Return the power that an even seabed returns from directions."""
        weights = 1 / np.sqrt(1 - self.sine**2)  # sines are evenly spaced, not angles
        for heading in self.headings:
            for length_m in self.lengths_m:
                sine = rays @ heading
                weights = weights * element_pattern(length_m, sine, 1.0, 2 / abs(cycles_per_m))
        return np.abs(weights)
