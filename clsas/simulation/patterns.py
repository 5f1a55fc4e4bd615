"""Element patterns in azimuth and elevation, expanded in frequency.

The pattern sinc(L/lambda sin theta) of an element (Ødegaard 2004, equations [9]-[12]) depends on
the point and on the frequency together. It is interpolated through Chebyshev nodes in frequency,
whose number follows from a bound on the remainder.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache, reduce

import numpy as np
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import NDArray
from scipy import fft

from clsas.engine.data import validate
from clsas.engine.data.system import Sonar, element_pattern
from clsas.engine.data.track import Channels
from clsas.simulation.refraction import Legs


@dataclass(frozen=True)
class ElementPatterns:
    """Two-way pattern of the elements of a sonar.

    Attributes
    ----------
    sonar : Sonar
    axes : float64 [pings, 3, 3]
        Unit vectors of the elements at every ping; see `clsas.Pointing.axes`.
    """

    sonar: Sonar
    axes: NDArray[np.float64]

    @property
    def elements(self) -> list[tuple[float, int, int]]:
        """Size (m), end of the path (0 for tx, 1 for rx) and axis of every one-way pattern."""
        sonar = self.sonar
        sizes = (
            (sonar.tx_length_m, 0, 0),
            (sonar.rx_length_m, 1, 0),
            (sonar.tx_height_m, 0, 2),
            (sonar.rx_height_m, 1, 2),
        )
        return [(size, end, axis) for size, end, axis in sizes if size is not None]

    def bound(self, ping: int, directions: NDArray, slack: NDArray | float) -> NDArray:
        """Return an upper bound on the two-way pattern; see `clsas.simulation.scenes.Observer`."""
        pulse = self.sonar.pulse
        lowest = max(pulse.carrier_hz - pulse.bandwidth_hz / 2, 0.0) / self.sonar.sound_speed_m_s
        components = directions @ self.axes[ping].T
        gain = np.where(components[:, 1] > -slack, 1.0, 0.0)
        for size, _, axis in self.elements:
            sine = np.maximum(np.abs(components[:, axis]) - slack, 0.0)
            gain /= np.maximum(np.pi * size * lowest * sine, 1.0)
        return gain

    def sines(
        self, points: NDArray, elements: Channels, legs: Legs, up: NDArray[np.float64]
    ) -> tuple[NDArray[np.bool_], list[NDArray]]:
        """Return a mask of the points in front of the elements, and the sines of their directions.

        Parameters
        ----------
        points : float64 [points, 3]
        elements : Channels
            Positions of one channel. All coordinates are along the axes of the elements.
        legs : Legs
        up : float64 [3]
            Direction of the vertical.

        Returns
        -------
        in_front : bool [points]
        sines : list of float64 [points]
            sin theta for each one-way pattern of `self.elements`, times the sonar's sound speed
            over that at the element.
        """
        tx, rx, velocity = elements
        at_reception = rx[:, None]
        if velocity is not None:
            at_reception = at_reception + velocity[:, None] * legs.delay_s
        ends_m = tx[:, None], at_reception
        if legs.bends is None:
            lengths_m = legs.out_m, legs.back_m
            in_front = (points[:, 1] > tx[1]) & (points[:, 1] > at_reception[1])
            return in_front, [
                (points[:, axis] - ends_m[end][axis]) / lengths_m[end]
                for _, end, axis in self.elements
            ]

        bends = legs.bends
        # Patterns depend on the wavelength at the elements.
        shorter = [self.sonar.sound_speed_m_s / bend.speed_m_s for bend in bends]

        def component(end: int, axis: int) -> NDArray:
            found = shorter[end] * bends[end].level_1_m * (points[:, axis] - ends_m[end][axis])
            return found + bends[end].lift * (shorter[end] * up[axis]) if up[axis] else found

        in_front = (component(0, 1) > 0) & (component(1, 1) > 0)
        return in_front, [component(end, axis) for _, end, axis in self.elements]

    def gains(
        self, sines: list[NDArray], error: float, dtype: type[np.floating], modes: int
    ) -> NDArray[np.float32]:
        """Return the two-way pattern at the Chebyshev nodes of the sampled band, [terms, points].

        Parameters
        ----------
        sines : list of [points]
            From `sines`.
        error : float
            Largest error of the interpolated pattern at any frequency. Half of it is reserved for
            rounding to single precision.
        dtype : numpy.float32 or numpy.float64
            Precision of the frequencies.
        modes : int
            Number of frequencies of the spectrum to be summed, with which memory is checked.

        Raises
        ------
        ValueError
            If elements are so long that the pattern and its spectrum do not fit into memory.

        Notes
        -----
        With a_i = pi L_i sine_i/c, derivatives of sinc(a_i f) of order k are below
        a_i^k min(1/(k + 1), 2/(a_i f)). Derivatives of order Q of the product of patterns are below

            (sum_i a_i)^Q min(1/(Q + 1), prod_i min(1, 2/(a_i f_least))).

        The error of interpolation through Q Chebyshev nodes over a band of +-h hertz is at most
        2 (h/2)^Q/Q! times this bound.
        """
        sonar = self.sonar
        half_band = sonar.sample_rate_hz / 2
        slopes = [
            np.abs(sine) * (np.pi * size / sonar.sound_speed_m_s)
            for (size, _, _), sine in zip(self.elements, sines, strict=True)
        ]
        reach = reduce(np.add, slopes) * (half_band / 2)
        lowest = max(sonar.pulse.carrier_hz - half_band, 0.0)
        level: NDArray | float = 2.0
        for slope in slopes:
            level = level / np.maximum(slope * (lowest / 2), 1.0)
        # By Stirling's formula, (reach e/Q)^Q falls below the error with at most this many terms.
        most = math.e * float(np.max(reach)) - math.log(error / 4)
        validate.memory("the sonar's element lengths", 8 * most * (most + len(reach) + 2 * modes))
        terms = needed_terms(reach, level, error / 2)
        nodes_hz = sonar.pulse.carrier_hz + _chebyshev_nodes(terms) * half_band
        frequency = nodes_hz[:, None].astype(dtype)
        patterns = (
            element_pattern(size, sine, frequency, sonar.sound_speed_m_s, np.float32)
            for (size, _, _), sine in zip(self.elements, sines, strict=True)
        )
        return reduce(np.multiply, patterns)


def needed_terms(reach: NDArray, level: NDArray | float, error: float) -> int:
    """Return the smallest Q with reach^Q/Q! min(2/(Q + 1), level) <= `error` everywhere."""
    with np.errstate(divide="ignore"):
        slope, cap = np.log(reach), np.log(level)
    # Computed with logarithms, because powers for a long element overflow before Q! catches up.
    terms, power = 1, slope
    while np.max(power + np.minimum(cap, math.log(2 / (terms + 1)))) > math.log(error):
        terms += 1
        power = power + (slope - math.log(terms))
    return terms


def _chebyshev_nodes(terms: int) -> NDArray[np.float64]:
    """Return Chebyshev nodes on [-1, 1]."""
    return np.cos(np.pi * (np.arange(terms) + 0.5) / terms)


@lru_cache(maxsize=32)
def interpolation_matrix(terms: int, modes: int) -> NDArray:
    """Return the matrix [terms, modes] from values at Chebyshev nodes to frequencies of the FFT."""
    to_coefficients = chebvander(_chebyshev_nodes(terms), terms - 1) * (2 / terms)
    to_coefficients[:, 0] /= 2
    return to_coefficients @ chebvander(2 * fft.fftfreq(modes), terms - 1).T
