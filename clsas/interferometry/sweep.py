"""First heights of a seabed: where along curves of equal range the two banks agree.

Both banks are imaged at many heights along the curves on which a scatterer keeps its range and its
position along the track (`clsas.interferometry.baseline`). Every curve shows the same speckle at
all heights, so its coherence is largest at the height of the scatterers: there the phase is zero,
and the ranges of both banks agree to a fraction of the resolution. On horizontal planes, by
contrast, a wrong height shows the speckle of another place, which may be brighter and therefore
more coherent.

The phase repeats with the height of ambiguity, and the magnitude of the coherence falls so slowly
that a window of tens of looks may not tell the cycles apart. So the heights at which the phase is
zero are candidates, and a larger window decides between them: for every height, the largest
coherence within half a height of ambiguity is averaged over that window. The relief may therefore
vary by most of a height of ambiguity within the large window, and the resolution of heights remains
that of the small one. Nothing is unwrapped.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, maximum_filter1d

from clsas.engine.data.grid import Grid, without_heights
from clsas.interferometry.baseline import (
    Baseline,
    Lattice,
    in_pixels,
    lattice_pixels,
    levels_m,
)
from clsas.interferometry.coherence import Moments, Window
from clsas.interferometry.pair import Pair

STEPS_PER_CYCLE = 6
"""Heights per height of ambiguity. 4 and 8 give the same rms errors on the dunes and on the tall
relief of tests/interferometry, to 1 % where the relief is several heights of ambiguity high."""

_CANDIDATE_RAD = (
    1.3 * math.pi / STEPS_PER_CYCLE
)  # phase at the height nearest to a zero, and margin
_PLACES = 33  # along either side, for which curves are found; 17 and 65 give the same heights
_ITERATIONS = 2  # of the curve through a place of a height map; 1 and 5 change heights by 1 µm
_LEAST_SPACE = 3  # pixels beyond the outermost curve
_PIXELS_AT_ONCE = 1 << 22  # of all heights that are imaged together; their positions take 96 MiB


@dataclass(frozen=True, eq=False)
class Curves:
    """Curves of equal range through the pixels of a plane or height map.

    Attributes
    ----------
    grid : Grid
        The plane or height map. It extends beyond the pixels whose heights are wanted, so that
        every pixel at every height lies on a curve through it.
    corner : (row, column)
        The pixel of `grid` that is the first of the wanted ones.
    offset_m : float64 [heights]
        Heights above the pixels of `grid` along their curves.
    lattices : tuple of Lattice
        For every one of these heights, the displacement of a curve, in rows and columns, and K
        (rad/m). They depend on how high the pixel of the curve lies above the plane.
    """

    grid: Grid
    corner: tuple[int, int]
    offset_m: NDArray[np.float64]
    lattices: tuple[Lattice, ...]

    @classmethod
    def over(cls, baseline: Baseline, grid: Grid, offset_m: NDArray[np.float64]) -> Self:
        """Return the curves that reach a grid's pixels at any of the heights."""
        traced = _traced(baseline, grid, offset_m)
        reach = np.concatenate([each.values[..., :2].reshape(-1, 2) for each in traced])
        before = (np.ceil(np.maximum(reach.max(axis=0), 0)) + _LEAST_SPACE).astype(int)
        after = (np.ceil(np.maximum(-reach.min(axis=0), 0)) + _LEAST_SPACE).astype(int)
        origin_m, row_step_m, column_step_m = grid.vectors_m
        beyond = tuple(zip(before, after, strict=True))
        wide = replace(
            grid,
            origin_m=origin_m - before[0] * row_step_m - before[1] * column_step_m,
            shape=tuple(np.array(grid.shape) + before + after),
            height_m=None if grid.height_m is None else np.pad(grid.height_m, beyond, "edge"),
        )
        corner = int(before[0]), int(before[1])
        return cls(wide, corner, offset_m, _traced(baseline, wide, offset_m))

    def points_m(self, index: int) -> NDArray[np.float64]:
        """Return the positions of all curves at a height, float64 [rows, columns, 3]."""
        _, row_step_m, column_step_m = self.grid.vectors_m
        down, across, _ = self._at(index)
        points_m = self.grid.positions_m()
        for along, step_m in ((down, row_step_m), (across, column_step_m)):
            points_m[..., :2] += along[..., None] * step_m[:2]
        points_m[..., 2] += self.offset_m[index]
        return points_m

    def rad_m(self, index: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return K of all curves at heights of their own, rad/m, float64 [rows, columns].

        `index`, [rows, columns], has the numbers of the heights.
        """
        found = np.empty(index.shape)
        for number in np.unique(index):
            some = index == number
            found[some] = self._at(number)[2][some]
        return found

    def _at(self, index: int) -> NDArray[np.float64]:
        """Return the values of a lattice at every curve, [3, rows, columns]."""
        rows, columns = map(np.arange, self.grid.shape)
        return self.lattices[index].over(rows, columns, self._above_plane_m)

    @property
    def _above_plane_m(self) -> NDArray[np.float64] | float:
        """Height of the pixels of `grid` above its plane."""
        return 0.0 if self.grid.height_m is None else self.grid.height_m

    @cached_property
    def z_m(self) -> NDArray[np.float64]:
        """The z of all pixels of `grid`, [rows, columns]."""
        return self.grid.positions_m()[..., 2]

    def through(
        self, index: int, rows: NDArray[np.float64], columns: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the curves that pass through places of the plane at a height.

        Displacements vary slowly. They are found for a few places, in three iterations, and
        interpolated in between.

        Parameters
        ----------
        index : int
            Number of the height.
        rows, columns : float64 [n], [m]
            Places, counted in rows and columns of the wanted pixels.

        Returns
        -------
        rows, columns : float64 [n, m]
            Curves, counted in rows and columns of `grid`.
        """
        inside = rows + self.corner[0], columns + self.corner[1]
        some = [np.linspace(each[0], each[-1], min(_PLACES, len(each))) for each in inside]
        lattice = self.lattices[index]
        place = np.stack(np.meshgrid(*some, indexing="ij"), axis=-1)[:, :, None]
        shift = np.zeros((*place.shape[:2], len(lattice.offset_m), 2))
        for _ in range(3):
            curve = place - shift
            shift = lattice.at(curve[..., 0], curve[..., 1], lattice.offset_m)[..., :2]
        backwards = Lattice(some[0], some[1], lattice.offset_m, shift)

        def curves(above_m: NDArray[np.float64] | float) -> tuple[NDArray, NDArray]:
            down, across = backwards.over(*inside, above_m)
            return inside[0][:, None] - down, inside[1] - across

        if self.grid.height_m is None:
            return curves(0.0)
        found: tuple[NDArray, NDArray] = np.meshgrid(*inside, indexing="ij")
        for _ in range(_ITERATIONS):  # which curve passes depends on the height of its pixel
            found = curves(map_coordinates(self.grid.height_m, found, order=1, mode="nearest"))
        return found


def _traced(baseline: Baseline, grid: Grid, offset_m: NDArray[np.float64]) -> tuple[Lattice, ...]:
    """Return displacement and K of curves through a few pixels, at every height (midpoint rule).

    The curves through a height map begin at a few heights between its lowest and its highest one.
    """
    rows, columns = lattice_pixels(grid)
    plane = without_heights(grid)
    above_m = levels_m(grid)
    start_m = plane.positions_m()[np.ix_(rows, columns)][:, :, None]
    start_m = (start_m + above_m[:, None] * [0.0, 0.0, 1.0]).reshape(-1, 3)

    def rising(points_m: NDArray[np.float64], rise_m: float) -> NDArray[np.float64]:
        tangent = baseline.sight(points_m).tangent
        return rise_m * np.column_stack([tangent, np.ones(len(tangent))])

    values = np.empty((len(offset_m), len(start_m), 3))
    upwards = [i for i, z in enumerate(offset_m) if z >= 0]
    downwards = [i for i, z in enumerate(offset_m) if z < 0][::-1]
    for indices in (upwards, downwards):
        points_m, height_m = start_m, 0.0
        for index in indices:
            rise_m = float(offset_m[index]) - height_m
            middle_m = points_m + rising(points_m, rise_m / 2)
            points_m, height_m = points_m + rising(middle_m, rise_m), float(offset_m[index])
            values[index, :, :2] = in_pixels(plane, (points_m - start_m)[:, :2])
            values[index, :, 2] = baseline.sight(points_m).rad_m
    shape = (len(rows), len(columns), len(above_m), 3)
    at = rows.astype(float), columns.astype(float), above_m
    return tuple(Lattice(*at, each.reshape(shape)) for each in values)


@dataclass(frozen=True, eq=False)
class Sweep:
    """Most likely height of the scatterers on every curve.

    Attributes
    ----------
    curves : Curves
    offset_m : float64 [rows, columns]
        Height along the curve above its pixel.
    coherence : float64 [rows, columns]
        Magnitude of the sample coherence at the height.
    profile : float64 [heights]
        Mean square of the coherence of all curves at every height, weighted by that at their most
        likely height.
    """

    curves: Curves
    offset_m: NDArray[np.float64]
    coherence: NDArray[np.float64]
    profile: NDArray[np.float64]

    def relief(
        self,
        rows: NDArray[np.float64],
        columns: NDArray[np.float64],
        reliable: NDArray[np.bool_],
        ambiguity_m: float,
    ) -> Relief:
        """Return the heights at places of the grid.

        A place has the height at which it lies on a curve whose scatterers have that height. In
        shadow there is none, and in layover there are several.

        Parameters
        ----------
        rows, columns : float64 [n], [m]
            Places, counted in rows and columns of the wanted pixels.
        reliable : bool [rows, columns]
            Curves whose height counts.
        ambiguity_m : float
            Height of ambiguity. Heights that differ by more than half of it are not neighbours on
            one surface.
        """
        found = np.where(reliable, self.offset_m, np.nan)
        shape = len(rows), len(columns)
        count, height_m = np.zeros(shape, int), np.full(shape, np.nan)
        corner = self.curves.corner
        z_m = map_coordinates(
            self.curves.z_m,
            np.meshgrid(rows + corner[0], columns + corner[1], indexing="ij"),
            order=1, mode="nearest",
        )  # fmt: skip
        below, last_m = np.full(shape, np.nan), np.zeros(shape)
        for index, offset_m in enumerate(self.curves.offset_m):
            at = self.curves.through(index, rows, columns)
            above = map_coordinates(found, at, order=1, cval=np.nan) - offset_m
            # The pixels of the curves may lie higher or lower than the place.
            here_m = offset_m + map_coordinates(self.curves.z_m, at, order=1, mode="nearest") - z_m
            with np.errstate(invalid="ignore"):
                crossed = (below >= 0) & (above < 0) & (below - above < ambiguity_m / 2)
            share = below[crossed] / (below - above)[crossed]
            height_m[crossed] = last_m[crossed] + share * (here_m - last_m)[crossed]
            count += crossed
            below, last_m = above, here_m
        return Relief(height_m, count)


@dataclass(frozen=True, eq=False)
class Relief:
    """Heights of places above a plane or height map.

    Attributes
    ----------
    offset_m : float64 [rows, columns]
        The only or the highest surface; NaN where there is none.
    surfaces : int [rows, columns]
        Number of surfaces: 0 in shadow and where images are not coherent, several in layover.
    """

    offset_m: NDArray[np.float64]
    surfaces: NDArray[np.int64]


def sweep(
    pair: Pair,
    curves: Curves,
    window: Window,
    coarse: Window,
    progress: Callable[[int], None],
) -> Sweep:
    """Return the most likely height along every curve.

    Parameters
    ----------
    pair : Pair
    curves : Curves
    window : Window
        Window of the heights.
    coarse : Window
        Window that decides between cycles of the phase.
    progress : callable
        Called with the number of heights done.
    """
    grid, offset_m = curves.grid, curves.offset_m
    coherence = np.empty((len(offset_m), *grid.shape), np.complex64)
    at_once = max(_PIXELS_AT_ONCE // grid.size, 1)
    for first in range(0, len(offset_m), at_once):
        some = range(first, min(first + at_once, len(offset_m)))
        slab = Grid.points(
            np.stack([curves.points_m(index) for index in some]), georeference=grid.georeference
        )
        for index, a, b in zip(some, *pair.images(slab), strict=True):
            coherence[index] = Moments.of(a, b, window).coherence
        progress(some[-1] + 1)
    best = likeliest(coherence, coarse)
    found = np.take_along_axis(coherence, best[None], axis=0)[0].astype(np.complex128)
    at_m = offset_m[best] - np.angle(found) / curves.rad_m(best)
    weight = np.abs(found) ** 2
    profile = np.array([np.vdot(weight, np.abs(each) ** 2) for each in coherence])
    return Sweep(curves, at_m, np.abs(found), profile / max(float(weight.sum()), 1e-9))


def likeliest(coherence: NDArray[np.complex64], coarse: Window) -> NDArray[np.intp]:
    """Return the index of the most likely height for every pixel, [rows, columns].

    Parameters
    ----------
    coherence : complex64 [heights, rows, columns]
        Coherence in small windows, at `STEPS_PER_CYCLE` heights per cycle of the phase.
    coarse : Window
        Window that decides between cycles.
    """
    magnitude = np.abs(coherence)
    candidate = np.abs(np.angle(coherence)) <= _CANDIDATE_RAD
    score = np.where(candidate, magnitude, coherence.real)
    cycle = maximum_filter1d(score, STEPS_PER_CYCLE + 1, axis=0, mode="nearest")
    support = coarse.sums(cycle) / (coarse.pixels * coarse.fullness(score.shape[1:]))
    # Where two neighbouring heights are candidates of the same cycle, the closer one counts.
    return np.where(candidate, support + 1e-3 * coherence.real, -1).argmax(axis=0)
