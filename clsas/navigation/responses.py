"""Bright responses of an image, and what each ping contributes to them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.spatial.distance import cdist

from clsas.engine.data.beam import BeamWindow, track_directions
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines, wavelength_m
from clsas.engine.data.threads import in_threads
from clsas.engine.data.visibility import sines
from clsas.engine.signal.interpolation import Readout, phasors

READ_DB = -40.0
"""Accuracy with which the lines are read."""
_READ_AT_ONCE = 1 << 17  # samples per thread, which bounds the memory


def displacement_axes(lines: RangeLines, unknowns: tuple[str, ...]) -> NDArray[np.float64]:
    """Return the unit vectors of "sway", "heave" and "surge" at every ping, [unknowns, pings, 3].

    They point to port, up, and along the track.
    """
    along = track_directions(lines)[lines.ping_starts]
    sway = np.cross(np.array([0.0, 0.0, 1.0]), along)
    sway /= np.maximum(np.linalg.norm(sway, axis=1, keepdims=True), 1e-9)
    vectors = {"sway": sway, "heave": np.cross(along, sway), "surge": along}
    return np.stack([vectors[name] for name in unknowns])


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
    amplitude = np.abs(image.pixels)
    size = []
    for step_m, most in zip(_steps_m(image.grid), amplitude.shape, strict=True):
        size.append(2 * math.ceil(min(apart_m / step_m, most)) + 1 if step_m > 0 else 1)
    largest = amplitude == maximum_filter(amplitude, size=tuple(size), mode="constant")
    found = np.flatnonzero((largest & (amplitude > 0)).ravel())
    found = found[np.argsort(-amplitude.ravel()[found], kind="stable")[:count]]
    return image.grid.at(found)


def _steps_m(grid: Grid) -> list[float]:
    """Return the distances between neighbouring pixels along each axis of a grid."""
    if grid.points_m is None:
        return [float(np.linalg.norm(each)) for each in grid.vectors_m[1:]]
    steps = [np.diff(grid.points_m, axis=axis) for axis in range(grid.points_m.ndim - 1)]
    return [float(np.median(np.linalg.norm(s, axis=-1))) if s.size else 0.0 for s in steps]


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

    @property
    def points(self) -> int:
        """Number of points."""
        return self.values.shape[1]

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
        turns = lines.carrier_cycles_per_m * at_m
        phase = (2 * np.pi * (turns - np.rint(turns))).astype(np.float32)
        received = readout.read(some, at_m) * phasors(phase)
        values[some] = received.reshape(len(some), len(points_m), -1)
        if beam is not None and along is not None:
            sine = sines(points_m, part.phase_centres_m, along[some])
            values[some] *= beam.weights(sine, wavelength_m(lines))[..., None]

    for _ in in_threads(read, range(0, lines.channels, step)):
        pass
    return Contributions(values, gradient, range_m)


def received_share(found: Contributions) -> float:
    """Return the share of the channels that receive a response, the median over the responses.

    The share is (sum p)^2/(n sum p^2) for the powers p in n channels. Channels with equal power
    thus count fully, and weaker ones count less.
    """
    power = np.square(np.abs(found.values[..., 0]), dtype=np.float64)
    total, squares = power.sum(axis=0), np.sum(power**2, axis=0)
    share = total**2 / np.maximum(len(power) * squares, 1e-300)
    return float(np.clip(np.median(share), 1 / len(power), 1.0))


def _gradient(
    points_m: NDArray[np.float64], lines: RangeLines, axes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the change in range to points per metre along axes, [unknowns, channels, points].

    `axes` are [unknowns, channels, 3].
    """
    monostatic = np.array_equal(lines.tx_m, lines.rx_m)
    ends_m = (lines.tx_m,) if monostatic else (lines.tx_m, lines.rx_m)
    total = np.zeros((*axes.shape[:2], len(points_m)))
    for end_m in ends_m:
        # Positions are relative to one of them, so that large coordinates do not cancel.
        along_m = axes @ (points_m - end_m[0]).T
        along_m -= np.sum(axes * (end_m - end_m[0]), axis=-1)[..., None]
        total -= along_m / np.maximum(cdist(end_m, points_m), 1e-9)
    return total / len(ends_m)
