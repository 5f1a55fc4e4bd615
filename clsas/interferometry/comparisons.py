"""Comparisons of heights with known ones, or with those of another track.

Each gives equations: what remains of the differences if the pair has a certain phase and roll.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import validate
from clsas.engine.data.validate import ArgumentError, ArgumentTypeError
from clsas.interferometry.checks import KNOWN_HEIGHT
from clsas.interferometry.coherence import Window
from clsas.interferometry.displaced import Displaced
from clsas.interferometry.error_fit import Equations, Places

_PER_WINDOW = 3  # pixels compared along each side of a window; twice as many show hardly more


@dataclass(frozen=True, eq=False)
class Comparison:
    """Heights that errors of the pair explain.

    Attributes
    ----------
    equations_at : callable
        Returns the equations at a phase and a roll, float64 [2].
    places : Places
    what : str
        Where heights are compared, for messages.
    roll_rad : float
        Largest phase per radian of roll.
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
