"""Correlation of channels in consecutive pings that share a phase centre.

Both channels of a pair receive the same speckle. Each is read along a ray from the common phase
centre, at the ranges of its own transmitter and receiver to the points of the ray. This removes the
effects of range migration, separate transmitters and motion during flight. The difference that
remains is the change in range of an array that is displaced from its navigated position (Bellettini
and Pinto 2002).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from clsas.engine.data import decibels
from clsas.engine.data.lines import RangeLines, cycles_per_m_at
from clsas.engine.signal.interpolation import Readout
from clsas.navigation.directions import Alignment, alignment
from clsas.navigation.echoes import Window, independent_echoes, strongest, without_highlights
from clsas.navigation.overlap import Overlap
from clsas.navigation.pair_geometry import PairGeometry
from clsas.navigation.swath import Swath

_FREQUENCIES = 9  # in either half of the band, each representing an equal share of the power
_SPECKLE_LAGS = 64  # samples over which speckle may be correlated in range

DEAD_DB = -20.0
"""Power relative to the usual channel up to which a channel counts as dead. At -10 dB, channels at
the ends of a track would also count as dead, because targets leave the beam there."""


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
        received, aligned = self._received(geometry, half_width)
        windows = _weighed(received, aligned)
        values, coherence = [], []
        for (one, other), n in zip(windows, self.samples, strict=True):
            length = scipy.fft.next_fast_len(int(n) + most)
            of_one, of_other = (scipy.fft.fft(each, length, axis=1) for each in (one, other))
            lagged = scipy.fft.ifft(of_one.conj() * of_other, axis=1).conj()
            lagged = np.concatenate([lagged[:, length - most :], lagged[:, : most + 1]], axis=1)
            energy = np.sqrt(np.sum(np.abs(one) ** 2, axis=1) * np.sum(np.abs(other) ** 2, axis=1))
            values.append(lagged)
            coherence.append(np.abs(lagged) / np.maximum(energy[:, None], 1e-300))
        return Correlation(
            values=np.stack(values, axis=1),
            coherence=np.stack(coherence, axis=1),
            lags_m=self.step_m * np.arange(-most, most + 1, dtype=np.float64),
            cycles_per_m=self.cycles_per_m,
            sensitivity=self._sensitivity(geometry, aligned),
            pairs=geometry.pairs,
            independent=self.independent,
            echoes=self._echoes(received, windows),
            windows=windows,
            aligned=aligned,
        )

    def windows(
        self, geometry: PairGeometry, half_width: float
    ) -> tuple[list[Window], Alignment | None]:
        """Return both channels of all pairs by window of range, and the filters applied to them.

        Parameters
        ----------
        geometry : PairGeometry
            Its lines have the samples of the correlator's lines, and the positions to test.
        half_width : float
            See `alignment`. If the swath has no element lengths, the beam counts as narrow: all
            echoes are taken as coming from broadside, and no filters are applied. Otherwise strong
            echoes are weakened.
        """
        received, aligned = self._received(geometry, half_width)
        return _weighed(received, aligned), aligned

    def _received(
        self, geometry: PairGeometry, half_width: float
    ) -> tuple[list[Window], Alignment | None]:
        """Return the same as `windows`, but without weakening strong echoes."""
        range_m = np.concatenate(
            [
                low + self.step_m * np.arange(n)
                for low, n in zip(self.swath.edges_m[:-1], self.samples, strict=True)
            ]
        )
        first, second = (
            self._along_rays(geometry, each, range_m)
            for each in (geometry.pairs.first, geometry.pairs.second)
        )
        ends = np.cumsum(self.samples)[:-1]
        if self.swath.element_length_m is None:
            return _split(first, second, ends), None
        aligned = alignment(geometry, self._band(), half_width)
        first, second = aligned.apply((first, second), range_m, self.cycles_per_m)
        return _split(first, second, ends), aligned

    def _echoes(self, received: list[Window], windows: list[Window]) -> NDArray[np.float64]:
        """Return the number of independent samples with echoes of their own, [windows]."""
        largest = strongest(received)
        each = zip(received, windows, self.independent.tolist(), strict=True)
        return np.array([independent_echoes(*some, largest) for some in each])

    def _sensitivity(
        self, geometry: PairGeometry, aligned: Alignment | None
    ) -> NDArray[np.float64]:
        """Return the decrease in range per metre of sway, [pairs, windows]."""
        middles_m = self.swath.middles_m
        if aligned is not None:
            return aligned.sensitivity.T @ aligned.weights(middles_m)
        return self.swath.side * geometry.rays(middles_m) @ geometry.outward

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
        return values * np.exp(2j * np.pi * (turns - np.rint(turns)))

    def _band(self) -> NDArray[np.float64]:
        """Return phases per metre at frequencies that represent equal shares of the power."""
        quantiles = (np.arange(_FREQUENCIES) + 0.5) / _FREQUENCIES
        share = np.cumsum(self.spectrum.share)
        away = np.interp(quantiles, share / share[-1], self.spectrum.frequency) / self.step_m
        return np.concatenate([self.cycles_per_m - away[::-1], self.cycles_per_m + away])


def _weighed(received: list[Window], aligned: Alignment | None) -> list[Window]:
    """Return windows with strong echoes weakened if the whole beam counts."""
    if aligned is None:
        return received
    largest = strongest(received)
    return [without_highlights(each, largest) for each in received]


def _split(
    first: NDArray[np.complex128], second: NDArray[np.complex128], ends: NDArray[np.int64]
) -> list[Window]:
    """Return the channels of both pings by window."""
    parts = np.split(first, ends, axis=1), np.split(second, ends, axis=1)
    return list(zip(*parts, strict=True))


def are_dead(power: NDArray[np.float64], usual: NDArray[np.float64] | float) -> NDArray[np.bool_]:
    """Return a mask of the channels without a signal, from their power and the usual power."""
    return power <= usual * decibels.power(DEAD_DB)
