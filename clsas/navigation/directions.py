"""Alignment of two pings for echoes from every direction of a wide beam.

The channels of a pair share a phase centre, but not their transmitter and receiver. For an echo at
an angle a off broadside, their ranges differ by about u A sin(a)^2/R, where A is the advance, R the
range and u the distance along the overlap. This difference looks like a yaw, of milliradians if the
beam is wide. Its mean over the beam depends on where the echoes come from, and no scene spreads
them evenly. The channels of each ping are therefore combined along the overlap by linear filters,
so that an echo from any direction arrives with the phase that it would have at the mean of both
geometries. This holds for each direction by itself, however strong its echoes are.

A uniform array cannot distinguish directions whose sines differ by half a wavelength over the
spacing of the phase centres. The filters can be restricted to the middle of the beam, where the
ambiguous directions receive little power.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from clsas.engine.data.system import element_pattern
from clsas.navigation.pair_geometry import PairGeometry

ALL, MIDDLE = 1.0, 0.25
"""Half widths of the passband of the filters, in periods of ambiguous directions: the whole beam,
or its middle. The middle gives the smaller error if there is little noise. With much noise, the
echoes of the whole beam are needed."""

_BANDS = 6  # parts of the spectrum, each with its own filters
_EDGE = 0.03  # width of the edges of the passband, in the same periods
# The filters weigh directions by the power that an even seabed would return, raised to this
# exponent. With an exponent of 1, strong echoes from the edge of the beam pass the filters, and
# the error in a scene of few scatterers is 1.7 times that with 0.25.
_PRIOR = 0.25
_NOISE = 0.01  # assumed noise power over the echoes' power, which regularises the filters
_MOST_TURN = 0.1  # most cycles by which a direction's phase changes between reference ranges
_MOST_RANGES = 16
_WIDEST = math.radians(75)  # largest half width of the beam that is considered
_LEAST_ANGLES = 65
_PADDING = 16  # samples of zeros appended to the lines; the filters delay by less


@dataclass(frozen=True, eq=False)
class Alignment:
    """Filters along an overlap that convert both pings to one common geometry.

    Attributes
    ----------
    range_m : float64 [ranges]
        Reference ranges for which filters are designed. Between them, filters are interpolated
        linearly in the inverse of range.
    cycles_per_m : float64 [bands]
        Phase per metre of range in the middle of each band.
    first, second : complex128 [ranges, bands, pairs, pairs]
        Filters of each ping. Each row yields one channel of the common geometry.
    sensitivity : float64 [ranges, pairs]
        Decrease in range per metre of sway, a mean over the directions that pass.
    echoes, noise : complex128 [pairs, pairs]
        Correlation between filtered channels, for echoes of an even seabed and for white noise.
    coherence : float
        Coherence of both pings over an even seabed. It is below 1 because the filters leave
        differences between the pings.
    middle_rad : float64 [pairs]
        Phases of echoes from the middle of the beam alone, relative to those of an even seabed.
    """

    range_m: NDArray[np.float64]
    cycles_per_m: NDArray[np.float64]
    first: NDArray[np.complex128]
    second: NDArray[np.complex128]
    sensitivity: NDArray[np.float64]
    echoes: NDArray[np.complex128]
    noise: NDArray[np.complex128]
    coherence: float
    middle_rad: NDArray[np.float64]

    def apply(
        self,
        values: tuple[NDArray[np.complex128], NDArray[np.complex128]],
        range_m: NDArray[np.float64],
        cycles_per_m: float,
    ) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return the channels of both pings in the common geometry, [pairs, samples].

        `values` are the samples along the rays at `range_m`, and `cycles_per_m` is the phase per
        metre of range that was removed from them.
        """
        count = len(range_m)
        step_m = float(range_m[1] - range_m[0])
        length = scipy.fft.next_fast_len(count + _PADDING)
        frequency_per_m = cycles_per_m + scipy.fft.fftfreq(length, step_m)
        band = np.argmin(np.abs(frequency_per_m[:, None] - self.cycles_per_m), axis=1)
        members = [np.flatnonzero(band == each) for each in range(len(self.cycles_per_m))]
        weights = self.weights(range_m)
        aligned = []
        for samples, filters in zip(values, (self.first, self.second), strict=True):
            spectrum = scipy.fft.fft(samples, length, axis=1)
            total = np.zeros_like(samples)
            for weight, of_range in zip(weights, filters, strict=True):
                filtered = np.empty_like(spectrum)
                for some, matrix in zip(members, of_range, strict=True):
                    filtered[:, some] = matrix @ spectrum[:, some]
                total += weight * scipy.fft.ifft(filtered, axis=1)[:, :count]
            aligned.append(total)
        return aligned[0], aligned[1]

    def phase_correlation(self, coherence: float) -> NDArray[np.float64]:
        """Return the correlation of the phase errors of pairs, [pairs, pairs].

        A phase error stems from products of one channel's echoes with the other's noise, and of
        both noises. Filtered neighbours have a part of both in common.
        """
        echoes, noise = coherence, 1 - coherence
        products = 2 * echoes * (self.echoes.conj() * self.noise).real
        products += noise * np.abs(self.noise) ** 2
        return products / (2 * echoes + noise)

    def weights(self, range_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the interpolation weights of the reference ranges, [ranges, samples]."""
        index = np.arange(len(self.range_m), dtype=np.float64)
        # np.interp needs rising values, and inverse ranges fall.
        at = np.interp(-1 / range_m, -1 / self.range_m, index)
        return np.maximum(1 - np.abs(at - index[:, None]), 0.0)


def alignment(geometry: PairGeometry, band: NDArray[np.float64], half_width: float) -> Alignment:
    """Return the filters that convert the channels of two pings to one geometry.

    Each filter is the linear least-mean-square-error estimate of the channels that the mean
    geometry would have, for an even seabed under the beam.

    Parameters
    ----------
    geometry : PairGeometry
        The swath must have element lengths.
    band : float64 [frequencies]
        Phase per metre of range at frequencies that represent equal shares of the power, ascending.
    half_width : float
        `ALL` or `MIDDLE`.
    """
    cycles_per_m = band.reshape(_BANDS, -1).mean(axis=1)
    beam = _Beam(geometry, cycles_per_m, half_width)
    near_m, far_m = geometry.swath.edges_m[[0, -1]]
    range_m = 1 / np.linspace(1 / near_m, 1 / far_m, beam.range_count(near_m, far_m))
    made = [beam.filters(each) for each in range_m]
    return Alignment(
        range_m=range_m,
        cycles_per_m=cycles_per_m,
        first=np.stack([each.first for each in made]),
        second=np.stack([each.second for each in made]),
        sensitivity=np.stack([each.sensitivity for each in made]),
        echoes=_normalised(np.stack([each.echoes for each in made]).mean(axis=0)),
        noise=_normalised(np.stack([each.noise for each in made]).mean(axis=0)),
        coherence=float(np.stack([each.coherence for each in made]).mean()),
        middle_rad=np.stack([each.middle_rad for each in made]).mean(axis=0),
    )


def _normalised(covariance: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return the correlation matrix of a covariance matrix."""
    size = np.sqrt(np.diag(covariance).real)
    return covariance / np.outer(size, size)


@dataclass(frozen=True, eq=False)
class _RangeFilters:
    """Filters for one range, with the attributes of an `Alignment` at that range.

    `echoes` and `noise` are covariances here, [pairs, pairs].
    """

    first: NDArray[np.complex128]
    second: NDArray[np.complex128]
    sensitivity: NDArray[np.float64]
    echoes: NDArray[np.complex128]
    noise: NDArray[np.complex128]
    coherence: np.float64
    middle_rad: NDArray[np.float64]


class _Beam:
    """Directions of a beam, and the phases with which two pings receive their echoes."""

    def __init__(
        self, geometry: PairGeometry, cycles_per_m: NDArray[np.float64], half_width: float
    ) -> None:
        lengths_m = geometry.swath.element_length_m
        assert lengths_m is not None
        self.geometry, self.lengths_m = geometry, lengths_m
        self.cycles_per_m, self.half_width = cycles_per_m, half_width
        highest = float(np.abs(cycles_per_m).max())
        longest_m = max(lengths_m) * highest / 2
        widest = math.sin(min(math.asin(min(1 / longest_m, 1.0)), _WIDEST))
        # Between neighbouring directions, the phases of the outermost channels must change by less
        # than half a cycle.
        turns = 2 * widest * highest * float(np.ptp(geometry.pairs.along_m))
        self.sine = np.linspace(-widest, widest, max(_LEAST_ANGLES, 2 * int(turns) + 1))

    def range_count(self, near_m: float, far_m: float) -> int:
        """Return the number of reference ranges that are needed."""
        turn = []
        for range_m in (near_m, far_m):
            first_m, second_m, _ = self._excess_m(range_m)
            turn.append((second_m - first_m) * np.abs(self.cycles_per_m).max())
        change = np.abs(turn[1] - turn[0]) * self._passed(float(np.abs(self.cycles_per_m).mean()))
        return min(2 + int(float(change.max()) / _MOST_TURN), _MOST_RANGES)

    def filters(self, range_m: float) -> _RangeFilters:
        """Return the filters for echoes at a range."""
        first_m, second_m, rays = self._excess_m(range_m)
        count, bands = len(first_m), len(self.cycles_per_m)
        filters = np.zeros((2, bands, count, count), np.complex128)
        products, of_middle = (np.zeros(count, np.complex128) for _ in range(2))
        passed_power = np.zeros(len(self.sine))
        echoes, noise = (np.zeros((count, count), np.complex128) for _ in range(2))
        energy = np.zeros((2, count))
        for band, cycles_per_m in enumerate(self.cycles_per_m):
            power = self._power(rays, cycles_per_m)
            passed = self._passed(cycles_per_m)
            target = passed * np.exp(-1j * np.pi * cycles_per_m * (first_m + second_m))
            aligned = []
            for ping, excess_m in enumerate((first_m, second_m)):
                steering = np.exp(-2j * np.pi * cycles_per_m * excess_m)
                matrix = _estimator(steering, target, power**_PRIOR)
                filters[ping, band] = matrix
                aligned.append(matrix @ steering)
                energy[ping] += np.abs(aligned[-1]) ** 2 @ power
                echoes += (power * aligned[-1]) @ aligned[-1].conj().T
                noise += matrix @ matrix.conj().T
            product = power * aligned[1].conj() * aligned[0]
            products += product.sum(axis=1)
            of_middle += product[:, self._periods(cycles_per_m) <= MIDDLE].sum(axis=1)
            passed_power += power * passed**2
        # With few channels a phase difference remains. Its mean over an even seabed is removed.
        filters[1] *= (products / np.maximum(np.abs(products), 1e-300))[:, None]
        port = self.geometry.swath.side * self.geometry.outward
        square = np.mean(np.abs(products) ** 2 / np.maximum(energy[0] * energy[1], 1e-300))
        return _RangeFilters(
            first=filters[0],
            second=filters[1],
            sensitivity=np.full(count, float(np.average(rays @ port, weights=passed_power))),
            echoes=echoes,
            noise=noise,
            coherence=np.sqrt(square),
            middle_rad=np.angle(of_middle * products.conj()),
        )

    def _excess_m(self, range_m: float) -> tuple[NDArray, NDArray, NDArray]:
        """Return the excess ranges of directions over the channels' own rays, and the directions.

        The excess ranges of both pings are [pairs, angles]. Directions, [angles, 3], start from the
        middle of the overlap.
        """
        geometry = self.geometry
        own_rays = geometry.rays(np.array([range_m]))
        ray = own_rays.mean(axis=0)
        rays = np.sqrt(1 - self.sine**2)[:, None] * ray + self.sine[:, None] * geometry.forward
        points_m = (range_m * rays + geometry.centre_m.mean(axis=0))[None]
        own_m = range_m * own_rays + geometry.centre_m[:, None]
        first_m, second_m = (
            geometry.ranges_m(each, points_m) - geometry.ranges_m(each, own_m)
            for each in (geometry.pairs.first, geometry.pairs.second)
        )
        return first_m, second_m, rays

    def _passed(self, cycles_per_m: float) -> NDArray[np.float64]:
        """Return the amplitude with which each direction passes."""
        return 1 / (1 + np.exp((self._periods(cycles_per_m) - self.half_width) / _EDGE))

    def _periods(self, cycles_per_m: float) -> NDArray[np.float64]:
        """Return the sines of the directions over the period at which they are ambiguous."""
        return np.abs(self.sine) * abs(cycles_per_m) * self.geometry.pairs.spacing_m

    def _power(self, rays: NDArray[np.float64], cycles_per_m: float) -> NDArray[np.float64]:
        """Return the power that an even seabed returns from each direction."""
        weights = 1 / np.sqrt(1 - self.sine**2)  # because sines are evenly spaced, not angles
        for heading in self.geometry.headings:
            for length_m in self.lengths_m:
                sine = rays @ heading
                weights = weights * element_pattern(length_m, sine, 1.0, 2 / abs(cycles_per_m))
        return np.abs(weights)


def _estimator(
    steering: NDArray[np.complex128], target: NDArray[np.complex128], power: NDArray[np.float64]
) -> NDArray:
    """Return the filter that estimates `target` from the channels, [pairs, pairs].

    `steering` and `target` are what the channels receive and should receive, [pairs, angles], and
    `power` weighs the directions, [angles].
    """
    weighted = (power * steering).conj().T
    covariance = steering @ weighted
    covariance += _NOISE * np.sum(power) * np.eye(len(steering))
    # The covariance is Hermitian, so solving from the left gives the transpose of the filter.
    return np.linalg.solve(covariance.conj(), (target @ weighted).T).T
