"""Comparisons of heights with known ones, or with those of another track.

Each gives equations: what remains of the differences if the pair has a certain phase and roll.

If bank b has a phase psi that its lines do not account for, a scatterer appears e = psi/K higher
along the curve on which its range from bank a is constant, and moves along that curve over the
ground too (K and the tangent t of the curve are those of `clsas.interferometry.baseline`). The
height at a place is therefore that found at the place plus t e, minus e.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from clsas.engine.data import validate
from clsas.engine.data.grid import Grid, without_heights
from clsas.engine.data.validate import ArgumentError, ArgumentTypeError
from clsas.engine.signal.spectrum import middle_cycles_per_m
from clsas.interferometry.baseline import Baseline, Lattice, in_pixels, sight_lattice
from clsas.interferometry.checks import KNOWN_HEIGHT
from clsas.interferometry.coherence import Window
from clsas.interferometry.error_fit import Equations, Places
from clsas.interferometry.pair import Pair
from clsas.interferometry.result import Heights

_PER_WINDOW = 3  # pixels compared along each side of a window; twice as many show hardly more
_UP = np.array([0.0, 0.0, 1.0])
_SMOOTHED = 3.0  # windows along either side, over which slopes are averaged
_STEPS = 3  # to the middle of the curve; more change displacements of 2 m by less than 1 mm
# Between points of the lattice that are a fiftieth of the range apart, K errs by 1e-4, which is
# 1 mrad where heights are displaced by one and a half heights of ambiguity.
_SPACING = 1 / 50
_MOST_POINTS = 65  # along each axis of the lattice, for the time that they take
_ENDS = 33  # points along either side, among which the nearest and the farthest are found
_MOST_CYCLES = 3.0  # heights of ambiguity by which heights may be displaced; arbitrary


@dataclass(frozen=True, eq=False)
class Comparison:
    """Heights that errors of the pair explain.

    The equations are those at a phase and a roll, float64 [2]. For messages, `what` says where
    heights are compared, and `roll_rad` is the largest phase per radian of roll.
    """

    equations_at: Callable[[NDArray[np.float64]], Equations]
    places: Places
    what: str
    roll_rad: float


def at_pixels(surface: Displaced, known_height_m: ArrayLike, known_sd_m: float) -> Comparison:
    """Compare heights with those known at pixels."""
    plane = surface.plane
    known_m = _checked_heights(known_height_m, (plane.shape[0], plane.shape[1]))
    window = Window.of(plane, surface.found.window_m)
    row, column = (each.ravel() for each in _some_pixels(plane.shape, window))
    offset_m = known_m[row, column]
    if not np.isfinite(offset_m).any():  # few are known, perhaps between the pixels compared
        row, column = np.nonzero(np.isfinite(known_m))
        offset_m = known_m[row, column]
    z_m = surface.plane_z_m(row, column) + offset_m
    points_m = np.column_stack([plane.positions_m()[row, column, :2], z_m])
    return _against(surface, points_m[np.isfinite(z_m)], known_sd_m, "a place of known height")


def _checked_heights(known_height_m: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return known heights as float64 [rows, columns]; NaN is allowed."""
    name = "known_height_m"
    if isinstance(known_height_m, Real):
        known_height_m = KNOWN_HEIGHT.check("known_height_m", known_height_m)
    given = np.asanyarray(known_height_m)
    if np.ma.isMaskedArray(given) or given.dtype.kind not in "iuf":
        allowed = "be a real number or an array of real numbers, NaN where heights are not known"
        raise ArgumentTypeError(name, allowed, validate.shown(known_height_m))
    if given.shape not in ((), shape):
        allowed = f"be a number or have the shape of the heights, {shape}"
        raise ArgumentError(name, allowed, str(given.shape))
    known_m = np.broadcast_to(given.astype(np.float64), shape)
    if np.isinf(known_m).any() or np.isnan(known_m).all():
        got = "infinite heights" if np.isinf(known_m).any() else "NaN everywhere"
        raise ArgumentError(name, "be finite, or NaN where it is not known", got)
    if float(np.nanmax(np.abs(known_m))) > validate.FARTHEST_M:
        raise ArgumentError(
            name,
            f"lie within {validate.FARTHEST_M:g} m of the grid",
            f"heights from {np.nanmin(known_m):g} to {np.nanmax(known_m):g} m",
        )
    return known_m


def at_points(surface: Displaced, points_m: NDArray[np.float64], known_sd_m: float) -> Comparison:
    """Compare heights with control points."""
    return _against(surface, points_m, known_sd_m, "one of `points_m`")


def _against(
    surface: Displaced, points_m: NDArray[np.float64], known_sd_m: float, what: str
) -> Comparison:
    """Compare heights with known points on the seabed."""

    def equations_at(errors_rad: NDArray[np.float64]) -> Equations:
        moved = surface.moved_back(points_m[:, :2], points_m[:, 2], errors_rad)
        return Equations(
            moved.z_m - points_m[:, 2], moved.per_error_m, np.hypot(moved.sd_m, known_sd_m)
        )

    places = _places(surface, points_m[:, :2], surface.found.window_m)
    return Comparison(equations_at, places, what, _most_roll_rad(surface))


def in_overlap(first: Displaced, second: Displaced) -> Comparison:
    """Compare heights of one seabed that were measured on two tracks."""
    window_m = max(first.found.window_m, second.found.window_m)
    row, column = (
        each.ravel() for each in _some_pixels(first.plane.shape, Window.of(first.plane, window_m))
    )
    places_m = first.plane.positions_m()[row, column, :2]
    offset_m = first.found.height_m[row, column]
    usual_m = float(np.nanmedian(first.found.height_m))
    rough_m = first.plane_z_m(row, column) + np.where(np.isfinite(offset_m), offset_m, usual_m)

    def equations_at(errors_rad: NDArray[np.float64]) -> Equations:
        z_m = first.moved_back(places_m, rough_m, errors_rad).z_m
        rough = np.where(np.isfinite(z_m), z_m, rough_m)
        one, two = (each.moved_back(places_m, rough, errors_rad) for each in (first, second))
        return Equations(
            one.z_m - two.z_m, one.per_error_m - two.per_error_m, np.hypot(one.sd_m, two.sd_m)
        )

    places = _places(first, places_m, window_m)
    what = "a place that `other` measured as well"
    return Comparison(equations_at, places, what, _most_roll_rad(first))


def _some_pixels(
    shape: tuple[int, ...], window: Window
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows and columns of some pixels of every window."""
    steps = (max(side // _PER_WINDOW, 1) for side in window.sides)
    row, column = np.mgrid[tuple(slice(0, n, step) for n, step in zip(shape, steps, strict=True))]
    return row, column


def _places(surface: Displaced, places_m: NDArray[np.float64], window_m: float) -> Places:
    shape = surface.plane.shape
    nearest = surface.pixels_of(places_m).round()
    row, column = np.clip(nearest, 0, np.array(shape) - 1).astype(np.int64).T
    return Places(row, column, shape, Window.of(surface.plane, window_m))


def _most_roll_rad(surface: Displaced) -> float:
    return max(abs(each.rad_per_roll) for each in (surface.near, surface.far))


class MovedBack(NamedTuple):
    """Heights at some places, without the displacement that errors of the pair cause.

    The last ones are the changes of z per radian of phase and per radian of roll, [n, 2]. NaN where
    none was found.
    """

    z_m: NDArray[np.float64]
    sd_m: NDArray[np.float64]
    per_error_m: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Displaced:
    """Heights found by a pair whose phase and roll may be wrong.

    Attributes
    ----------
    found : Heights
    plane : Grid
        The plane above which they were measured.
    sights : Lattice
        K, the tangent in rows and columns, and the phase per radian of roll.
    m_per_rad : float64 [rows, columns]
        Change of the height per radian of phase, smoothed: noise of the slopes that it depends on
        would hide how little phase and roll differ.
    near, far : Elevation
        How the pair sees the nearest and the farthest pixel of the plane.
    """

    found: Heights
    plane: Grid
    sights: Lattice
    m_per_rad: NDArray[np.float64]
    near: Elevation
    far: Elevation

    @classmethod
    def of(cls, pair: Pair, found: Heights) -> Self:
        """Return heights together with the geometry of the pair that found them."""
        plane = without_heights(found.image.grid)
        straight = pair.straightened(plane)
        cycles_per_m = middle_cycles_per_m(straight.a)
        baseline = Baseline.of(straight.a, straight.b, straight.beam, cycles_per_m)
        beyond_m = 2 * np.pi * _MOST_CYCLES * float(np.median(np.abs(found.m_per_rad)))
        known_m = found.height_m[found.mask]
        span_m = float(known_m.min()) - beyond_m, float(known_m.max()) + beyond_m
        level_m = plane.spread(_ENDS) + float(np.median(known_m)) * _UP
        antennas_m = straight.a.phase_centres_m[baseline.channels]
        range_m = np.linalg.norm(level_m[:, None] - antennas_m, axis=2).min(axis=1)
        sides_m = [
            n * float(np.linalg.norm(step))
            for n, step in zip(plane.shape, plane.vectors_m[1:], strict=True)
        ]
        rows, columns, levels = (
            min(math.ceil(side_m / (_SPACING * float(range_m.min()))) + 2, _MOST_POINTS)
            for side_m in (*sides_m, span_m[1] - span_m[0])
        )
        lattice = sight_lattice(baseline, plane, span_m, (rows, columns, levels))
        rad_m, rolled = baseline.sight(level_m).rad_m, baseline.rad_per_roll(level_m)
        near, far = (
            Elevation(float(range_m[n]), float(rad_m[n]), float(rolled[n]))
            for n in (range_m.argmin(), range_m.argmax())
        )
        return cls(found, plane, lattice, _smooth_m_per_rad(found, plane), near, far)

    def moved_back(
        self,
        places_m: NDArray[np.float64],
        rough_z_m: NDArray[np.float64],
        errors_rad: NDArray[np.float64],
    ) -> MovedBack:
        """Return the heights at places, x and y [n, 2], if the pair has a certain phase and roll.

        K and the tangent are evaluated at the rough z, [n].
        """
        row, column = self.pixels_of(places_m).T
        offset_m = rough_z_m - self.plane_z_m(row, column)
        start = self.sights.at(row, column, offset_m)
        per_error = np.stack([np.ones(len(row)), start[:, 3]], axis=1)
        error_rad = per_error @ errors_rad
        rise_m, moved = np.zeros(len(row)), np.zeros((2, len(row)))
        for _ in range(_STEPS):
            # The chord of the curve is parallel to its tangent halfway. K hardly changes along the
            # curve, but off the curve, in the middle of the chord, it would be larger.
            end = self.sights.at(row + moved[0], column + moved[1], offset_m + rise_m)
            halfway = row + moved[0] / 2, column + moved[1] / 2, offset_m + rise_m / 2
            tangent = self.sights.at(*halfway)[:, 1:3]
            with np.errstate(divide="ignore", invalid="ignore"):
                rise_m = error_rad / ((start[:, 0] + end[:, 0]) / 2)
            moved = rise_m * tangent.T
        row, column = row + moved[0], column + moved[1]
        height_m, sd_m, m_per_rad = (
            map_coordinates(values, [row, column], order=1, cval=np.nan)
            for values in (self.found.height_m, self.found.sd_m, self.m_per_rad)
        )
        z_m = self.plane_z_m(row, column) + height_m - rise_m
        return MovedBack(z_m, sd_m, m_per_rad[:, None] * per_error)

    def pixels_of(self, places_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the rows and columns of places, [n, 2], from their x and y, [n, 2]."""
        return in_pixels(self.plane, places_m - self.plane.vectors_m[0][:2])

    def plane_z_m(
        self,
        row: NDArray[np.float64] | NDArray[np.int64],
        column: NDArray[np.float64] | NDArray[np.int64],
    ) -> NDArray[np.float64]:
        """Return the z of the plane, [n]."""
        origin_m, row_step_m, column_step_m = self.plane.vectors_m
        return np.asarray(origin_m[2] + row * row_step_m[2] + column * column_step_m[2])


def _smooth_m_per_rad(found: Heights, plane: Grid) -> NDArray[np.float64]:
    """Return the mean of the valid changes per radian around every pixel; 0 if there are none."""
    window = Window.of(plane, _SMOOTHED * found.window_m)
    sums = window.sums(np.where(found.mask, found.m_per_rad, 0.0))
    valid = window.sums(found.mask.astype(np.float64))
    return np.divide(sums, valid, out=np.zeros_like(sums), where=valid > 0.5)


class Elevation(NamedTuple):
    """How a pair sees one place: range, K along the curve of constant range, and rad per roll."""

    range_m: float
    rad_m: float
    rad_per_roll: float
