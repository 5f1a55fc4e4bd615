"""Correlation of channels in consecutive pings that share a phase centre.

Both channels of a pair receive the same speckle. Each is read along a ray from the common phase
centre, at the ranges of its own transmitter and receiver to the points of the ray. This removes the
effects of range migration, separate transmitters and motion during flight. The difference that
remains is the change in range of an array that is displaced from its navigated position (Bellettini
and Pinto 2002).

In a wide beam, this holds for broadside alone. For an echo at an angle a off broadside, the ranges
of a pair differ by about u A sin(a)^2/R, where A is the advance, R the range and u the distance
along the overlap. This difference looks like a yaw, of milliradians if the beam is wide. Its mean
over the beam depends on where the echoes come from, and no scene spreads them evenly. The channels
of each ping are therefore combined along the overlap by linear filters, so that an echo from any
direction arrives with the phase that it would have at the mean of both geometries. This holds for
each direction by itself, however strong its echoes are.

A uniform array cannot distinguish directions whose sines differ by half a wavelength over the
spacing of the phase centres. The filters can be restricted to the middle of the beam, where the
ambiguous directions receive little power.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from clsas.engine.data import decibels
from clsas.engine.data.fourier import turned
from clsas.engine.data.lines import RangeLines, cycles_per_m_at
from clsas.engine.data.system import element_pattern
from clsas.engine.signal.interpolation import Readout
from clsas.navigation.overlap import Overlap, PairGeometry, Swath

DEAD_DB = -20.0
"""Power relative to the usual channel up to which a channel counts as dead. At -10 dB, channels at
the ends of a track would also count as dead, because targets leave the beam there."""

ALL, MIDDLE = 1.0, 0.25
"""Half widths of the passband of the filters, in periods of ambiguous directions: the whole beam,
or its middle. The middle gives the smaller error if there is little noise. With much noise, the
echoes of the whole beam are needed."""

Window = tuple[NDArray[np.complex128], NDArray[np.complex128]]
"""Samples of the first and second channels of all pairs in a window of range, [pairs, n] each."""

_FREQUENCIES = 9  # in either half of the band, each representing an equal share of the power
_SPECKLE_LAGS = 64  # samples over which speckle may be correlated in range

# Filters.
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

# Strong echoes, and their number.
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


@dataclass(frozen=True, eq=False)
class Correlation:
    """Correlation of channel pairs at lags of range.

    Attributes
    ----------
    values : complex128 [pairs, windows, lags]
        Cross-correlation. Its phase is 0 if the array lies at its navigated position.
    coherence : float64 [pairs, windows, lags]
        Magnitude of `values` over the geometric mean of the energies of both channels.
    lags_m : float64 [lags]
    cycles_per_m : float
        Phase per metre of range.
    sensitivity : float64 [pairs, windows]
        Decrease in range per metre of sway.
    pairs : Overlap
    independent : float64 [windows]
        Number of independent samples of speckle in a window.
    echoes : float64 [windows]
        Number of independent samples that contain echoes of their own.
    windows : list of Window
        The samples that were correlated.
    aligned : Alignment or None
        Filters that were applied to the channels, if any.
    """

    values: NDArray[np.complex128]
    coherence: NDArray[np.float64]
    lags_m: NDArray[np.float64]
    cycles_per_m: float
    sensitivity: NDArray[np.float64]
    pairs: Overlap
    independent: NDArray[np.float64]
    echoes: NDArray[np.float64]
    windows: list[Window]
    aligned: Alignment | None


class Correlator:
    """Range lines that are read along rays and correlated pair by pair."""

    def __init__(self, lines: RangeLines, swath: Swath) -> None:
        self.readout, self.swath = Readout.of(lines), swath
        self.spectrum = spectrum = self.readout.spectrum
        self.cycles_per_m = float(cycles_per_m_at(lines, spectrum.centre))
        self.step_m = lines.range_step_m
        counts = np.maximum(np.diff(swath.edges_m) / self.step_m, 1.0)
        self.samples = counts.astype(np.int64)

    @cached_property
    def live(self) -> NDArray[np.bool_]:
        """False for channels that are dead compared with the others of their ping, [channels].

        Channels of a ping without any echo are live: their pairs are not coherent.
        """
        lines = self.readout.lines
        samples = lines.samples
        power = np.einsum("cs,cs->c", samples, samples.conj(), dtype=np.complex128).real
        usual = np.array([np.median(each) for each in np.split(power, lines.ping_starts[1:])])
        return ~(are_dead(power, usual[lines.ping_numbers]) & (usual[lines.ping_numbers] > 0))

    @cached_property
    def independent(self) -> NDArray[np.float64]:
        """Number of independent samples of speckle in each window, [windows].

        It is N^2 over the sum of the squared correlations of all pairs of its N samples.
        """
        lags = np.arange(-_SPECKLE_LAGS, _SPECKLE_LAGS + 1)
        turns = np.cos(2 * np.pi * np.outer(lags, self.spectrum.frequency))
        correlated = (turns @ self.spectrum.share) ** 2
        return np.array(
            [
                n / float(np.sum(correlated * np.maximum(1 - np.abs(lags) / n, 0.0)))
                for n in self.samples
            ]
        )

    def correlate(self, geometry: PairGeometry, most_m: float, half_width: float) -> Correlation:
        """Return the correlation of pairs at lags of up to `most_m`; see `windows`."""
        most = max(math.ceil(most_m / self.step_m), 1)
        received, windows, aligned = self.windows(geometry, half_width)
        values, coherence = [], []
        for (one, other), n in zip(windows, self.samples, strict=True):
            length = scipy.fft.next_fast_len(int(n) + most)
            of_one, of_other = (scipy.fft.fft(each, length, axis=1) for each in (one, other))
            lagged = scipy.fft.ifft(of_one.conj() * of_other, axis=1).conj()
            lagged = np.concatenate([lagged[:, length - most :], lagged[:, : most + 1]], axis=1)
            energy = np.sqrt(np.sum(np.abs(one) ** 2, axis=1) * np.sum(np.abs(other) ** 2, axis=1))
            values.append(lagged)
            coherence.append(np.abs(lagged) / np.maximum(energy[:, None], 1e-300))
        if aligned is None:
            rays = geometry.rays(self.swath.middles_m)
            sensitivity = self.swath.side * rays @ geometry.outward
        else:
            sensitivity = aligned.sensitivity.T @ aligned.weights(self.swath.middles_m)
        largest = strongest(received)
        each_window = zip(received, windows, self.independent.tolist(), strict=True)
        return Correlation(
            values=np.stack(values, axis=1),
            coherence=np.stack(coherence, axis=1),
            lags_m=self.step_m * np.arange(-most, most + 1, dtype=np.float64),
            cycles_per_m=self.cycles_per_m,
            sensitivity=sensitivity,
            pairs=geometry.pairs,
            independent=self.independent,
            echoes=np.array([independent_echoes(*each, largest) for each in each_window]),
            windows=windows,
            aligned=aligned,
        )

    def windows(
        self, geometry: PairGeometry, half_width: float
    ) -> tuple[list[Window], list[Window], Alignment | None]:
        """Return both channels of all pairs by window of range, and the filters applied to them.

        Parameters
        ----------
        geometry : PairGeometry
            Its lines have the samples of the correlator's lines, and the positions to test.
        half_width : float
            See `alignment`. If the swath has no element lengths, the beam counts as narrow: all
            echoes are taken as coming from broadside, and no filters are applied.

        Returns
        -------
        received, windows : list of Window
            The latter are those to correlate. If filters are applied, strong echoes are weakened.
        aligned : Alignment or None
        """
        starts_m = self.swath.edges_m[:-1]
        each_m = [
            low_m + self.step_m * np.arange(n)
            for low_m, n in zip(starts_m, self.samples, strict=True)
        ]
        range_m = np.concatenate(each_m)
        values = (
            self._along_rays(geometry, geometry.pairs.first, range_m),
            self._along_rays(geometry, geometry.pairs.second, range_m),
        )
        aligned = None
        if self.swath.element_length_m is not None:
            # Frequencies that represent equal shares of the power.
            quantiles = (np.arange(_FREQUENCIES) + 0.5) / _FREQUENCIES
            share = np.cumsum(self.spectrum.share)
            away = np.interp(quantiles, share / share[-1], self.spectrum.frequency) / self.step_m
            band = np.concatenate([self.cycles_per_m - away[::-1], self.cycles_per_m + away])
            aligned = alignment(geometry, band, half_width)
            values = aligned.apply(values, range_m, self.cycles_per_m)
        ends = np.cumsum(self.samples)[:-1]
        parts = (np.split(each, ends, axis=1) for each in values)
        received: list[Window] = list(zip(*parts, strict=True))
        if aligned is None:
            return received, received, None
        largest = strongest(received)
        return received, [without_highlights(each, largest) for each in received], aligned

    def _along_rays(
        self, geometry: PairGeometry, channels: NDArray[np.int64], range_m: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        """Return channels at points of the rays from the phase centres, [channels, ranges].

        The phase of an echo is that of its distance along the ray.
        """
        points_m = geometry.centre_m[:, None] + range_m[:, None] * geometry.rays(range_m)
        path_m = geometry.ranges_m(channels, points_m)
        carrier = geometry.lines.carrier_cycles_per_m
        turns = carrier * path_m - self.cycles_per_m * range_m
        values = self.readout.read(channels, path_m).astype(np.complex128)
        return values * turned(turns)


def are_dead(power: NDArray[np.float64], usual: NDArray[np.float64] | float) -> NDArray[np.bool_]:
    """Return a mask of the channels without a signal, from their power and the usual power."""
    return power <= usual * decibels.power(DEAD_DB)


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
    pairs, swath, lengths_m = geometry.pairs, geometry.swath, geometry.swath.element_length_m
    assert lengths_m is not None
    cycles_per_m = band.reshape(_BANDS, -1).mean(axis=1)
    highest = float(np.abs(cycles_per_m).max())

    # Directions of the beam. Between neighbours, the phases of the outermost channels must change
    # by less than half a cycle.
    widest = math.sin(min(math.asin(min(2 / (max(lengths_m) * highest), 1.0)), _WIDEST))
    turns = 2 * widest * highest * float(np.ptp(pairs.along_m))
    sine = np.linspace(-widest, widest, max(_LEAST_ANGLES, 2 * int(turns) + 1))

    # Sines over the period at which directions are ambiguous, for each band and for the mean of
    # all, and the amplitudes that pass.
    frequencies = np.append(np.abs(cycles_per_m), np.abs(cycles_per_m).mean())
    periods = np.abs(sine) * frequencies[:, None] * pairs.spacing_m
    passed = 1 / (1 + np.exp((periods - half_width) / _EDGE))

    # Reference ranges, between which the phases of directions that pass change little.
    near_m, far_m = swath.edges_m[[0, -1]]
    (near_first, near_second, _), (far_first, far_second, _) = (
        _excess_m(geometry, sine, each) for each in (near_m, far_m)
    )
    change = highest * np.abs((far_second - far_first) - (near_second - near_first))
    ranges = min(2 + int(float((change * passed[-1]).max()) / _MOST_TURN), _MOST_RANGES)
    range_m = 1 / np.linspace(1 / near_m, 1 / far_m, ranges)

    # Filters of both pings for every range and band, and what is left of the echoes of an even
    # seabed and of white noise after them.
    count = pairs.pairs
    filters = np.zeros((2, ranges, _BANDS, count, count), np.complex128)
    echoes, noise = (np.zeros((count, count), np.complex128) for _ in range(2))
    sensitivity, coherence, middle_rad = np.zeros((ranges, count)), [], []
    for number, each_m in enumerate(range_m):
        first_m, second_m, rays = _excess_m(geometry, sine, each_m)
        products, of_middle = (np.zeros(count, np.complex128) for _ in range(2))
        passed_power, energy = np.zeros(len(sine)), np.zeros((2, count))
        for band_number, cycles in enumerate(cycles_per_m):
            power = _power(geometry, rays, sine, cycles)
            target = passed[band_number] * np.exp(-1j * np.pi * cycles * (first_m + second_m))
            aligned = []
            for ping, excess_m in enumerate((first_m, second_m)):
                steering = np.exp(-2j * np.pi * cycles * excess_m)
                matrix = _estimator(steering, target, power**_PRIOR)
                filters[ping, number, band_number] = matrix
                aligned.append(matrix @ steering)
                energy[ping] += np.abs(aligned[-1]) ** 2 @ power
                echoes += (power * aligned[-1]) @ aligned[-1].conj().T
                noise += matrix @ matrix.conj().T
            product = power * aligned[1].conj() * aligned[0]
            products += product.sum(axis=1)
            of_middle += product[:, periods[band_number] <= MIDDLE].sum(axis=1)
            passed_power += power * passed[band_number] ** 2
        # With few channels a phase difference remains. Its mean over an even seabed is removed.
        filters[1, number] *= (products / np.maximum(np.abs(products), 1e-300))[:, None]
        port = swath.side * geometry.outward
        sensitivity[number] = np.average(rays @ port, weights=passed_power)
        square = np.mean(np.abs(products) ** 2 / np.maximum(energy[0] * energy[1], 1e-300))
        coherence.append(np.sqrt(square))
        middle_rad.append(np.angle(of_middle * products.conj()))
    return Alignment(
        range_m=range_m,
        cycles_per_m=cycles_per_m,
        first=filters[0],
        second=filters[1],
        sensitivity=sensitivity,
        echoes=_normalised(echoes),
        noise=_normalised(noise),
        coherence=float(np.mean(coherence)),
        middle_rad=np.mean(middle_rad, axis=0),
    )


def _excess_m(
    geometry: PairGeometry, sine: NDArray[np.float64], range_m: float
) -> tuple[NDArray, NDArray, NDArray]:
    """Return the excess ranges of directions over the channels' own rays, and the directions.

    The excess ranges of both pings are [pairs, angles]. Directions, [angles, 3], start from the
    middle of the overlap.
    """
    own_rays = geometry.rays(np.array([range_m]))
    ray = own_rays.mean(axis=0)
    rays = np.sqrt(1 - sine**2)[:, None] * ray + sine[:, None] * geometry.forward
    points_m = (range_m * rays + geometry.centre_m.mean(axis=0))[None]
    own_m = range_m * own_rays + geometry.centre_m[:, None]
    first_m, second_m = (
        geometry.ranges_m(each, points_m) - geometry.ranges_m(each, own_m)
        for each in (geometry.pairs.first, geometry.pairs.second)
    )
    return first_m, second_m, rays


def _power(
    geometry: PairGeometry,
    rays: NDArray[np.float64],
    sine: NDArray[np.float64],
    cycles_per_m: float,
) -> NDArray[np.float64]:
    """Return the power that an even seabed returns from each direction."""
    weights = 1 / np.sqrt(1 - sine**2)  # because sines are evenly spaced, not angles
    for heading in geometry.headings:
        for length_m in geometry.swath.element_length_m or ():
            pattern = element_pattern(length_m, rays @ heading, 1.0, 2 / abs(cycles_per_m))
            weights = weights * pattern
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


def _normalised(covariance: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return the correlation matrix of a covariance matrix."""
    size = np.sqrt(np.diag(covariance).real)
    return covariance / np.outer(size, size)


def without_highlights(window: Window, largest: float) -> Window:
    """Return a window in which strong echoes are weakened.

    The stronger an echo is, the less of it remains, so that it weighs less than a usual one. A
    strong echo comes from a single direction. It would dominate the mean phase, whose expectation
    is that of echoes from the whole beam. `largest` is the power of the strongest echo of all
    windows.
    """
    power = uniform_filter1d(_mean_power(window), _SMOOTHED, mode="nearest")
    usual = max(_HIGHLIGHT * float(np.median(power)), _SIDE_LOBES * largest)
    amplitude = np.minimum(1.0, usual / np.maximum(power, 1e-300))
    return amplitude * window[0], amplitude * window[1]


def strongest(windows: list[Window]) -> float:
    """Return the largest power of all windows, averaged over the pairs."""
    return max(float(_mean_power(each).max()) for each in windows)


def independent_echoes(
    window: Window, weakened: Window, independent: float, largest: float
) -> float:
    """Return how many of the `independent` samples of a window contain echoes of their own.

    Speckle fills a window, so all samples count. A few reflectors leave most of it empty, except
    for the slopes of their echoes: if m echoes, each F samples long, lie at random positions among
    n samples, a share exp(-m F/n) of the samples stays empty. If some echoes are much stronger than
    others in the `weakened` window, only these count.
    """
    power, remaining = _mean_power(window), _mean_power(weakened)
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


def _mean_power(window: Window) -> NDArray[np.float64]:
    """Return the mean power of both channels of all pairs, [n]."""
    one, other = window
    return np.asarray(np.mean(np.abs(one) ** 2 + np.abs(other) ** 2, axis=0)) / 2
