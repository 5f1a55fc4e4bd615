"""Curves of equal range, and the images of both banks along them.

A scatterer keeps its range to the first bank and its position along the track while it rises along
a curve: around a straight track, a circle. So the image of the first bank is the same at all
heights along these curves. That of the second bank changes only because the range to its receivers
does, and is its own image of a plane at another place: where the plane has the range of the point
on the curve. One image of a plane per bank therefore shows both banks at any height.

That holds for straight tracks. Deviations from one blur both images alike, the more, the farther a
scatterer lies from the plane. They change neither coherence nor phase, but cost resolution along
the track, until both banks are imaged on the relief.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter1d

from clsas.engine.data.fourier import phasors, turned
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.grid import Grid, without_heights
from clsas.engine.data.lines import antennas_of
from clsas.interferometry.baseline import Baseline, Lattice, in_pixels, lattice_places
from clsas.interferometry.coherence import Images, Moments
from clsas.interferometry.pair import Pair

_OVERSAMPLING = 2.0  # of the band across the track; cubic splines then err by -45 dB at its ends
_LEVELS = 5  # heights of the lattice, which a polynomial connects
_SEEN = 0.01  # least relative weight of a channel that counts for the band
_LEAST_SLOPE = 1e-3  # of ranges, relative; below the track, nothing is displaced
_SPACE = 3  # pixels beyond the outermost curve, for the taps of the interpolation
_TURNS = 10  # iterations of the curve through a place of a relief


@dataclass(frozen=True, eq=False)
class Curves:
    """Curves of equal range to the first bank, one through every pixel of a level plane.

    Attributes
    ----------
    baseline : Baseline
    grid : Grid
        The level plane. Its rows run along the track. It extends beyond the places whose heights
        are wanted, so that each of them lies on one of the curves at every height.
    lattice : Lattice
        At heights above the plane: by how many rows and columns a curve has moved, by how many rows
        the image of the second bank is displaced, and K (rad/m).
    """

    baseline: Baseline
    grid: Grid
    lattice: Lattice

    @classmethod
    def over(
        cls,
        baseline: Baseline,
        grid: Grid,
        search_m: tuple[float, float],
        steps_m: tuple[float, float],
    ) -> Self:
        """Return the curves that reach a grid at the heights of a search above its pixels.

        Steps are their distances across and along the track. Beyond the search, curves do not move.
        """
        low_m, high_m = (float(each[2]) for each in grid.bounds_m)
        z_m = np.linspace(low_m + search_m[0], high_m + search_m[1], _LEVELS)
        level_m = float(np.clip((low_m + high_m) / 2, z_m[0], z_m[-1]))
        places_m = without_heights(grid).spread(3)
        places_m[:, 2] = level_m
        middle_m = places_m.mean(axis=0)
        along = baseline.course(middle_m) * [1, 1, 0]
        along /= np.linalg.norm(along)
        plane = Grid.oriented(
            middle_m, steps_m[0] * np.cross([0, 0, 1], along), steps_m[1] * along, (2, 2),
            georeference=grid.georeference,
        )  # fmt: skip

        # The rectangle in which curves through places of the grid pass the plane
        rising = _traced(baseline, plane, places_m, z_m - level_m)[..., :2]
        passed = in_pixels(plane, (places_m - middle_m)[:, :2])[:, None] - rising
        first = np.floor(passed.min(axis=(0, 1))) - _SPACE
        shape = np.ceil(passed.max(axis=(0, 1))).astype(int) + _SPACE + 1 - first.astype(int)
        plane = replace(
            plane,
            origin_m=middle_m + first @ np.stack(plane.vectors_m[1:]),
            shape=tuple(map(int, shape)),
        )

        rows, columns = lattice_places(plane)
        points_m = plane.positions_m()[np.ix_(rows, columns)].reshape(-1, 3)
        values = _traced(baseline, plane, points_m, z_m - level_m)
        values = values.reshape(len(rows), len(columns), *values.shape[1:])
        places = rows.astype(float), columns.astype(float)
        return cls(baseline, plane, Lattice(*places, z_m - level_m, values))

    @property
    def sights(self) -> Lattice:
        """K along the curves, on which scatterers do not move: the tangent is 0."""
        return replace(self.lattice, values=self.lattice.values[..., 3:4] * [1, 0, 0])

    @property
    def level_m(self) -> float:
        """The z of the plane."""
        return float(self.grid.vectors_m[0][2])

    def every(self, rows: int, columns: int) -> Self:
        """Return some of the curves: those of every so many rows and columns."""
        lattice = self.lattice.every(rows, columns, [rows, columns, rows, 1])
        grid = self.grid.window(slice(None, None, rows), slice(None, None, columns))
        return replace(self, grid=grid, lattice=lattice)

    def _over_all(self, height_m: NDArray[np.float64] | float, some: slice) -> NDArray[np.float64]:
        """Return some values of the lattice at heights of all curves, [values, rows, columns]."""
        rows, columns = map(np.arange, self.grid.shape)
        lattice = replace(self.lattice, values=self.lattice.values[..., some])
        return lattice.over(rows, columns, height_m)

    def moved(self, height_m: NDArray[np.float64] | float) -> NDArray[np.float64]:
        """Return by how many rows and columns the curves have moved, [2, rows, columns]."""
        return self._over_all(height_m, slice(0, 2))

    def displaced(self, height_m: NDArray[np.float64] | float) -> NDArray[np.float64]:
        """Return by how many rows the image of the second bank is displaced, [rows, columns]."""
        return self._over_all(height_m, slice(2, 3))[0]

    def rad_m(self, height_m: NDArray[np.float64] | float) -> NDArray[np.float64]:
        """Return K, rad/m, [rows, columns]."""
        return self._over_all(height_m, slice(3, 4))[0]

    def points_m(self, height_m: NDArray[np.float64] | float) -> NDArray[np.float64]:
        """Return the positions of all curves at heights above the plane, [rows, columns, 3]."""
        _, row_step_m, column_step_m = self.grid.vectors_m
        down, across = self.moved(height_m)
        points_m = self.grid.positions_m()
        points_m += down[..., None] * row_step_m + across[..., None] * column_step_m
        points_m[..., 2] += height_m
        return points_m

    def start_m(self, start: Grid) -> NDArray[np.float64]:
        """Return how high above the plane the curves pass through a plane or height map."""
        origin_m, row_step_m, column_step_m = start.vectors_m
        height_m = np.zeros(self.grid.shape)
        for _ in range(_TURNS):
            places_m = self.points_m(height_m)[..., :2] - origin_m[:2]
            row, column = np.moveaxis(in_pixels(start, places_m), -1, 0)
            height_m = origin_m[2] - self.level_m + row * row_step_m[2] + column * column_step_m[2]
            if start.height_m is not None:
                height_m += map_coordinates(start.height_m, [row, column], order=1, mode="nearest")
        return height_m


def spacing_m(baseline: Baseline, plane: Grid, relative_band: float) -> float:
    """Return how close curves must be to sample images across the track, metres.

    Images contain the band, as far as the range changes across the track, for channels in all
    directions.
    """
    points_m = plane.spread(3)
    weights = baseline.weights(points_m)
    away_m = points_m[:, None] - baseline.a.phase_centres_m[baseline.channels]
    along_m = np.einsum("pci,pi->pc", away_m, weights @ baseline.along)
    level_m = np.linalg.norm(away_m[..., :2], axis=2)
    steepness = np.sqrt(np.maximum(level_m**2 - along_m**2, 0)) / np.linalg.norm(away_m, axis=2)
    seen = weights > _SEEN * weights.max(axis=1, keepdims=True)
    steepest = np.where(seen, steepness, 0).max(axis=1)
    span = steepest - np.where(seen, steepness, 1).min(axis=1)
    cycles_per_m = abs(baseline.rad_per_m) / (2 * np.pi)
    return 1 / (_OVERSAMPLING * cycles_per_m * float(np.max(relative_band * steepest + span)))


def _traced(
    baseline: Baseline, plane: Grid, points_m: NDArray[np.float64], heights_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the values of a lattice at points of a level plane, [points, heights, 4]."""
    weights, (_, of_b) = baseline.weights(points_m), baseline.gradients(points_m)
    per_row = of_b @ plane.vectors_m[1]
    per_row[np.abs(per_row) < _LEAST_SLOPE * np.abs(per_row).max()] = np.inf
    banks = [antennas_of(lines, baseline.channels)[:2] for lines in (baseline.a, baseline.b)]
    at_start_m = [pairwise_range_m(points_m, *antennas_m) for antennas_m in banks]

    def rising(at_m: NDArray[np.float64], rise_m: float) -> NDArray[np.float64]:
        tangent = baseline.sight(at_m).tangent
        return rise_m * np.column_stack([tangent, np.ones(len(tangent))])

    values = np.empty((len(points_m), len(heights_m), 4))
    upwards = [n for n, height_m in enumerate(heights_m) if height_m >= 0]
    downwards = [n for n, height_m in enumerate(heights_m) if height_m < 0][::-1]
    for numbers in (upwards, downwards):
        at_m, height_m = points_m, 0.0
        for number in numbers:  # by the midpoint rule
            rise_m = float(heights_m[number]) - height_m
            at_m = at_m + rising(at_m + rising(at_m, rise_m / 2), rise_m)
            height_m = float(heights_m[number])
            change_m = [
                pairwise_range_m(at_m, *antennas_m) - start_m
                for antennas_m, start_m in zip(banks, at_start_m, strict=True)
            ]
            nearer_m = np.einsum("nc,nc->n", weights, change_m[1] - change_m[0])
            values[:, number, :2] = in_pixels(plane, (at_m - points_m)[:, :2])
            values[:, number, 2] = nearer_m / per_row
            values[:, number, 3] = baseline.sight(at_m).rad_m
    return values


@dataclass(frozen=True, eq=False)
class CurveImages:
    """Images of both banks along curves of equal range, which show them at any height.

    Those of the second bank are on every row of the curves, as coefficients of a cubic spline with
    one row before and two behind; those of the first, and `curves`, on every so many rows.
    `phase_rad`, that of the range to every row, was taken out of both.
    """

    curves: Curves
    first: NDArray[np.complex64]
    second: NDArray[np.complex64]
    every: int
    phase_rad: NDArray[np.float64]

    @classmethod
    def of(cls, pair: Pair, fine: Curves, every: int) -> Self:
        """Form images on curves as close as the band requires; keep every so many of the first."""
        plane = fine.grid
        first, second = pair.images(plane).pixels

        # Without the phase of the range, images are smooth from row to row.
        along_m = plane.vectors_m[2]
        away_m = plane.positions_m()[:, 0] - fine.baseline.a.phase_centres_m.mean(axis=0)
        range_m = np.linalg.norm(np.cross(away_m, along_m / np.linalg.norm(along_m)), axis=1)
        phase_rad = fine.baseline.rad_per_m * range_m
        smooth = second * turned(-phase_rad / (2 * np.pi))[:, None]
        phase_rad += np.angle(np.vdot(smooth[:-1], smooth[1:])) * np.arange(len(phase_rad))
        back = turned(-phase_rad / (2 * np.pi)).astype(np.complex64)[:, None]
        return cls(
            fine.every(every, 1),
            (first * back)[::every],
            np.pad(
                spline_filter1d(second * back, axis=0, output=np.complex64),
                ((1, 2), (0, 0)),
                "reflect",
            ),
            every,
            phase_rad,
        )

    def at(self, height_m: NDArray[np.float64] | float) -> Images:
        """Return the images at heights above the plane, without a phase that both share."""
        moved = self.every * self.curves.displaced(height_m)
        row = self.every * np.arange(len(self.first))[:, None]
        slope = np.gradient(self.phase_rad)
        rate, bend = slope[row], np.gradient(slope)[row]
        before = np.floor(row + moved)
        t = (row + moved - before).astype(np.float32)
        left, right = (1 - t) ** 3 / 6, t**3 / 6
        middle = 2 / 3 - t**2 * (1 - t / 2)
        flat, columns = self.second.ravel(), t.shape[1]
        at = np.clip(before, 0, len(self.second) - 4).astype(np.intp) * columns
        at += np.arange(columns)
        found = left * flat[at]
        for weight in (middle, 1 - left - middle - right, right):
            at += columns
            found += weight * flat[at]
        found *= phasors((moved * (rate + moved * bend / 2)).astype(np.float32))
        return self.first, found

    def products(self, height_m: NDArray[np.float64] | float) -> Moments:
        """Return the products of the images at heights above the plane."""
        return Moments.multilooked(*self.at(height_m), 1)
