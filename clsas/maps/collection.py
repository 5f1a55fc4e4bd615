"""The range lines of an image, as its pixels receive them: directions, weights and frequencies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.geometry import bistatic_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, cycles_per_m_at, wavelength_m
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.visibility import sines
from clsas.engine.signal.spectrum import measure_spectrum, power_spectrum


def check_lines(lines: RangeLines, grid: Grid) -> None:
    """Raise ValueError if lines lie elsewhere on Earth than an image of them, or are silent."""
    if lines.georeference not in (None, grid.georeference):
        allowed = f"have the georeference of the source ({grid.georeference})"
        raise ArgumentError("lines", allowed, str(lines.georeference))
    if not lines.samples.any():
        raise ArgumentError("lines", "have samples other than 0, from which the band is measured")


@dataclass(frozen=True, eq=False)
class Collection:
    """The range lines of an image, as its pixels receive them.

    Attributes
    ----------
    lines : RangeLines
    beam : BeamWindow or None
        Beam with which the image was formed.
    along : float64 [channels, 3] or None
        Direction of the track at every channel, to which the beam refers.
    cycles_per_m, amplitude : float64 [frequencies]
        Two-way phase per metre of range, cycles, over the band that the lines occupy, ascending;
        and the amplitude of the lines there.
    """

    lines: RangeLines
    beam: BeamWindow | None
    along: NDArray[np.float64] | None
    cycles_per_m: NDArray[np.float64]
    amplitude: NDArray[np.float64]

    @classmethod
    def of(cls, lines: RangeLines, beam: BeamWindow | None) -> Collection:
        """Return the collection of some lines, which must have samples other than 0."""
        spectrum = measure_spectrum(lines)
        frequency, power = power_spectrum(lines)
        offset = (frequency - spectrum.centre + 0.5) % 1.0 - 0.5
        order = np.argsort(offset)
        order = order[np.abs(offset[order]) <= 0.5 / spectrum.oversampling]
        cycles = cycles_per_m_at(lines, spectrum.centre + offset[order])
        along = None if beam is None else beam.directions(lines)
        return cls(lines, beam, along, cycles, np.sqrt(power[order]))

    @property
    def band_hz(self) -> tuple[float, float]:
        """Lowest and highest frequency of the band that the lines occupy."""
        lowest_hz, highest_hz = self.cycles_per_m[[0, -1]] * self.lines.sound_speed_m_s / 2
        return float(lowest_hz), float(highest_hz)

    def weights(self, point_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the weight of every channel in a pixel, float64 [channels]."""
        lines = self.lines
        range_m = bistatic_range_m(point_m, lines.tx_m, lines.rx_m)
        reached = (range_m >= lines.first_range_m) & (range_m <= lines.last_range_m)
        if self.beam is None or self.along is None:
            return reached.astype(np.float64)
        sine = sines(point_m[None], lines.phase_centres_m, self.along)[:, 0]
        return reached * self.beam.weights(sine, wavelength_m(lines))

    def contributions(
        self, point_m: NDArray[np.float64], steps_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the channels that a pixel receives from.

        Parameters
        ----------
        point_m : float64 [3]
            Position of the pixel.
        steps_m : float64 [2, 3]
            Steps from row to row and from column to column.

        Returns
        -------
        channels : int64 [n]
        weights : float64 [n]
        changes_m : float64 [2, n]
            Change of the range from row to row and from column to column.
        """
        weights = self.weights(point_m)
        channels = np.flatnonzero(weights)
        changes_m = np.zeros((2, len(channels)))
        for antenna_m in (self.lines.tx_m[channels], self.lines.rx_m[channels]):
            way_m = point_m - antenna_m
            unit = way_m / np.linalg.norm(way_m, axis=1, keepdims=True)
            changes_m += steps_m @ unit.T / 2
        return channels, weights[channels], changes_m

    def support(self, changes_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the lowest and highest frequencies around a pixel, cycles per pixel, [2, 2].

        Rows of the result are frequencies along rows and columns, for the changes of the range that
        `contributions` returns.
        """
        cycles = np.multiply.outer(changes_m, self.cycles_per_m[[0, -1]])
        return np.stack([cycles.min(axis=(1, 2)), cycles.max(axis=(1, 2))], axis=1)
