"""How the phase between two banks changes with height, and where a scatterer above a plane appears.

A scatterer above an imaged surface appears where its range to the first bank and its position along
the track are the same. Around a straight track, these points form a circle; t is its tangent,
scaled to a rise of 1 m. Along that curve an image shows the same speckle at every height. D is the
gradient of the difference of the two banks' ranges. If a scatterer lies e higher along the curve
than the pixel that shows it, the phase in that pixel is

    arg(a b*) = -K e,   K = 2 k D.t.

On a seabed of slope m, a surface that passes e above the pixel meets the curve e/(1 - m.t) above
it, so an error e of the assumed height causes the phase -K e/(1 - m.t). The factor 1 - m.t is the
foreshortening: less than 1 on slopes that face the sonar, 0 where the slope is perpendicular to the
line of sight, and negative in layover.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator, make_interp_spline

from clsas.engine.data.beam import BeamWindow, track_directions
from clsas.engine.data.geometry import unit_vectors
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, some_channels, wavelength_m
from clsas.engine.data.threads import in_threads
from clsas.measures.elevation import Sight, sight_along

_POINTS_AT_ONCE = 64
_ROWS_AT_ONCE = 64  # of interpolated quantities, which then fit into caches
_LATTICE = 9  # points along either side of a grid; 5 and 17 change heights by at most 1 mm
_LEVELS = 5  # heights of a lattice; 3 and 9 give the same heights


@dataclass(frozen=True, eq=False)
class Baseline:
    """Two banks, represented by some channels.

    Attributes
    ----------
    a, b : RangeLines
    channels : int64 [n]
    along : float64 [n, 3]
        Direction of the track at each channel.
    beam : BeamWindow or None
    rad_per_m : float
        Two-way phase per metre of range in the middle of the band.
    """

    a: RangeLines
    b: RangeLines
    channels: NDArray[np.int64]
    along: NDArray[np.float64]
    beam: BeamWindow | None
    rad_per_m: float

    @classmethod
    def of(cls, a: RangeLines, b: RangeLines, beam: BeamWindow | None, cycles_per_m: float) -> Self:
        """Return the baseline of two banks of one sonar."""
        channels = some_channels(a.channels)
        along = track_directions(a) if beam is None else beam.directions(a)
        return cls(a, b, channels, along[channels], beam, 2 * np.pi * cycles_per_m)

    def sight(self, points_m: NDArray[np.float64]) -> Sight:
        """Return how the banks see points, float64 [points, 3]."""
        parts = max(len(points_m) // _POINTS_AT_ONCE, 1)
        found = [self._sight(some) for some in np.array_split(points_m, parts)]
        return Sight(*(np.concatenate(each) for each in zip(*found, strict=True)))

    def _sight(self, points_m: NDArray[np.float64]) -> Sight:
        of_a, of_b = self.gradients(points_m)
        return sight_along(self.weights(points_m) @ self.along, of_a, of_a - of_b, self.rad_per_m)

    def gradients(
        self, points_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the gradients of the ranges to both banks, float64 [points, 3] each."""
        weight = self.weights(points_m)

        def towards(antennas_m: NDArray[np.float64]) -> NDArray[np.float64]:
            sight = unit_vectors(points_m[:, None] - antennas_m[self.channels])
            return np.einsum("pc,pci->pi", weight, sight)

        of_a, of_b = ((towards(lines.tx_m) + towards(lines.rx_m)) / 2 for lines in (self.a, self.b))
        return of_a, of_b

    def rad_per_roll(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the phase of b per radian by which b is turned about a, rad, [points].

        The turn is right-handed about the direction of the track: the port side rises.
        """
        rx_m = self.b.rx_m[self.channels]
        moves_m = np.cross(self.along, rx_m - self.a.rx_m[self.channels])

        def of(some_m: NDArray[np.float64]) -> NDArray[np.float64]:
            sight = unit_vectors(some_m[:, None] - rx_m)
            # A receiver that approaches a point by 1 m shortens the range, half the path, by 0.5 m.
            return np.einsum("pc,pci,ci->p", self.weights(some_m), sight, moves_m) / 2

        parts = max(len(points_m) // _POINTS_AT_ONCE, 1)
        nearer_m = np.concatenate([of(some_m) for some_m in np.array_split(points_m, parts)])
        return self.rad_per_m * nearer_m

    def weights(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the weights of the channels in points, float64 [points, channels]; sums are 1."""
        if self.beam is None:
            return np.full((len(points_m), len(self.channels)), 1 / len(self.channels))
        sight_m = points_m[:, None] - self.a.phase_centres_m[self.channels]
        sine = np.einsum("pci,ci->pc", sight_m, self.along) / np.linalg.norm(sight_m, axis=2)
        weight = self.beam.weights(sine, wavelength_m(self.a))
        total = weight.sum(axis=1, keepdims=True)
        return np.where(total > 0, weight, 1) / np.where(total > 0, total, weight.shape[1])

    def course(self, point_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the mean direction of the track as a point sees it, [3]; short if it turns."""
        course: NDArray[np.float64] = (self.weights(point_m[None]) @ self.along)[0]
        return course


@dataclass(frozen=True, eq=False)
class Lattice:
    """Quantities at a few pixels and heights above a grid, interpolated linearly in between.

    Attributes
    ----------
    rows, columns, offset_m : float64 [n], [m], [levels]
    values : float64 [n, m, levels, quantities]
    """

    rows: NDArray[np.float64]
    columns: NDArray[np.float64]
    offset_m: NDArray[np.float64]
    values: NDArray[np.float64]

    def every(self, rows: int, columns: int, units: list[int]) -> Self:
        """Return the lattice of every so many rows and columns, with quantities in other units."""
        places = self.rows / rows, self.columns / columns
        return type(self)(*places, self.offset_m, self.values / np.array(units))

    def at(
        self,
        rows: NDArray[np.float64],
        columns: NDArray[np.float64],
        offset_m: NDArray[np.float64] | float,
    ) -> NDArray[np.float64]:
        """Return the quantities at places, which broadcast, [..., quantities].

        The outermost values apply beyond the lattice.
        """
        axes, values = [], self.values
        for axis, places in enumerate((self.rows, self.columns, self.offset_m)):
            if len(places) == 1:  # interpolation needs two
                places, values = np.array([0.0, 1.0]), np.repeat(values, 2, axis=axis)
            axes.append(places)
        inside = [
            np.clip(each, places[0], places[-1])
            for each, places in zip((rows, columns, offset_m), axes, strict=True)
        ]
        return RegularGridInterpolator(tuple(axes), values)(
            np.stack(np.broadcast_arrays(*inside), axis=-1)
        )

    def over(
        self,
        rows: NDArray,
        columns: NDArray,
        offset_m: NDArray[np.float64] | float,
    ) -> NDArray[np.float64]:
        """Return the quantities at all crossings of rows and columns, [quantities, n, m].

        Heights broadcast to [n, m]. Between the points of the lattice, quantities are cubic splines
        along rows and columns, and a polynomial along heights.
        """
        middle_m = (self.offset_m[0] + self.offset_m[-1]) / 2
        half_m = max(float(np.ptp(self.offset_m)) / 2, 1e-9)
        height = np.clip((offset_m - middle_m) / half_m, -1, 1)
        powers = np.linalg.inv(np.vander((self.offset_m - middle_m) / half_m))
        if height.ndim == 0:  # one polynomial for all
            powers, height = np.vander(height[None], len(powers)) @ powers, np.zeros((1, 1))
        terms = np.tensordot(powers, self.values.transpose(2, 3, 0, 1), 1)
        terms = terms @ _splines(columns, self.columns).T
        of_rows = _splines(rows, self.rows)
        height = np.broadcast_to(height, (len(rows), len(columns)))

        def strip(first: int) -> NDArray[np.float64]:
            some = slice(first, first + _ROWS_AT_ONCE)
            found = of_rows[some] @ terms[0]
            for term in terms[1:]:
                found *= height[some]
                found += of_rows[some] @ term
            return found

        strips = in_threads(strip, range(0, len(rows), _ROWS_AT_ONCE))
        return np.concatenate(list(strips), axis=1)


def _splines(places: NDArray, known: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix of cubic splines from known places to others, [places, known]."""
    if len(known) == 1:
        return np.ones((len(places), 1))
    spline = make_interp_spline(known, np.eye(len(known)), k=min(3, len(known) - 1))
    return np.asarray(spline(np.clip(places, known[0], known[-1])))


def sight_lattice(
    baseline: Baseline,
    plane: Grid,
    span_m: tuple[float, float],
    counts: tuple[int, int, int] = (_LATTICE, _LATTICE, _LEVELS),
) -> Lattice:
    """Return how the banks see places between two heights above a plane.

    The quantities are K (rad/m), the tangent, in rows and columns per metre of rise, and the phase
    per radian of roll.
    """
    rows, columns = lattice_places(plane, counts[:2])
    offset_m = np.linspace(*span_m, counts[2])
    points_m = plane.positions_m()[np.ix_(rows, columns)][..., None, :]
    points_m = (points_m + offset_m[:, None] * [0.0, 0.0, 1.0]).reshape(-1, 3)
    sight, roll = baseline.sight(points_m), baseline.rad_per_roll(points_m)
    values = np.column_stack([sight.rad_m, in_pixels(plane, sight.tangent), roll])
    values = values.reshape(len(rows), len(columns), len(offset_m), 4)
    return Lattice(rows.astype(float), columns.astype(float), offset_m, values)


def lattice_places(
    plane: Grid, counts: tuple[int, int] = (_LATTICE, _LATTICE)
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows and columns spread over a plane."""
    rows, columns = (
        np.unique(np.linspace(0, n - 1, min(count, n)).round().astype(int))
        for n, count in zip(plane.shape, counts, strict=True)
    )
    return rows, columns


def in_pixels(grid: Grid, horizontal_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return horizontal vectors, [..., 2] in x and y, as [..., 2] in rows and columns."""
    _, row_step_m, column_step_m = grid.vectors_m
    return horizontal_m @ np.linalg.inv(np.array([row_step_m[:2], column_step_m[:2]]))
