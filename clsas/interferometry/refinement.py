"""Heights from the remaining phase on a relief, pass by pass until they no longer change."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt

from clsas.engine.data.certificate import Certificate
from clsas.engine.data.decibels import DEVIATION_PER_MEDIAN
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.interferometry.baseline import Lattice
from clsas.interferometry.coherence import (
    Window,
    debiased,
    noise_coherence,
    phase_sd_rad,
)
from clsas.interferometry.planes import edge_growth, fit_planes
from clsas.interferometry.sweep import Relief
from clsas.interferometry.task import Task

PASSES = 6
"""Most passes. Two or three are usual."""

# Rms correction, in standard deviations; it then adds 4 % to the deviation. Half and twice the
# value stop after the same pass on the reliefs of tests/interferometry.
_CONVERGED = 0.3
# Last correction of a pixel, in deviations, from which on it is not valid: its window reaches to
# where the relief is unknown, and contains echoes of another height.
_UNSETTLED = 2.0
_CREDIBLE = 0.25  # largest credible correction of the sweep, in heights of ambiguity; arbitrary
_FALSE_ALARM = 1e-3  # share of incoherent windows that exceed the threshold of coherence
# Rms distance of the relief from the plane of a window, in deviations. Noise of the heights makes
# 0.1 % of the windows of level seabeds rougher; those across steps are rougher by far. A parabola
# displaces the height in the middle by about as much as it makes the window rough. Half the value
# masks a fifth of simulated dunes, twice the value adds less than 1 % to the valid pixels.
_MOST_ROUGHNESS = 3.0
_LINEAR_RAD = 0.15  # roughness as a phase, up to which the fit of a plane is almost linear
# Variance in the middle of a window relative to that of an evenly lit one. It is 4 at the edge of a
# shadow, beyond which a plane would be extrapolated.
_MOST_GROWTH = 3.0
# Displacements by curvature are averaged over windows so much larger. Without curvature, the noise
# of level seabeds then adds 0.7 % to the deviation; with half the value, 1.4 %.
_BENDING = 2.0
# Mean square of `Planes.bend_m` on level seabeds, in variances of the height: 0.23 to 0.25 on the
# slopes of tests/interferometry. Evenly lit windows would have 0.32.
_BEND_NOISE = 0.25
_LEAST_FORESHORTENING = 0.2  # steeper slopes towards the sonar count as layover


@dataclass(frozen=True, eq=False)
class Refined:
    """Heights above a plane, [rows, columns] each, after the last pass.

    Attributes
    ----------
    offset_m, sd_m, coherence, looks, m_per_rad : float64
    valid : bool
    image : Image
        Image of the first bank on the relief of the last pass.
    correction : float
        Rms of the last correction, in standard deviations.
    certificate : Certificate or None
        Measured error of that bank's image in the last pass which errs more.
    """

    offset_m: NDArray[np.float64]
    sd_m: NDArray[np.float64]
    coherence: NDArray[np.float64]
    looks: NDArray[np.float64]
    m_per_rad: NDArray[np.float64]
    valid: NDArray[np.bool_]
    image: Image
    correction: float
    certificate: Certificate | None = None

    @property
    def converged(self) -> bool:
        """True if the last correction is well below the deviation."""
        return self.correction <= _CONVERGED


def refine(
    task: Task,
    relief: Relief,
    sights: Lattice,
    window: Window,
    looks: float,
    progress: Callable[[int], None],
) -> Refined:
    """Return heights, starting from those of a sweep.

    Parameters
    ----------
    task : Task
    relief : Relief
        Heights above the grid that the sweep found.
    sights : Lattice
        K and the tangent of the curves, from `sight_lattice`.
    window : Window
    looks : float
        Effective number of looks of a window on a level surface. They must not be measured on a
        relief: its small errors shift the phase of neighbouring pixels, which then seem
        uncorrelated.
    progress : callable
        Called with the number of passes done.
    """
    grid, start_m = task.plane, task.start_m
    found_once = relief.surfaces == 1
    # The sweep misses single curves. Where a window reaches known heights, it decides by itself.
    known = binary_dilation(found_once, np.ones(window.sides)) & (relief.surfaces < 2)
    # A slope that faces the sonar is imaged with more pixels per independent sample.
    level_m = np.full(grid.shape, task.level_m)
    _, level = sensitivity(grid, level_m, np.zeros((2, *grid.shape)), sights)
    level_growth = edge_growth(window, grid.shape)
    looks_on_plane = looks * window.fullness(grid.shape) / level
    relief_m = first_m = start_m + filled(relief.offset_m, found_once)
    slope_m = np.array(np.gradient(relief_m))
    for done in range(1, PASSES + 1):
        on_relief, started = grid.with_height(relief_m), time.perf_counter()
        image, other = (task.pair.image(bank, on_relief) for bank in (task.pair.a, task.pair.b))
        images, seconds = (image.pixels, other.pixels), time.perf_counter() - started
        rad_m, facing = sensitivity(grid, relief_m, slope_m, sights)
        planes = fit_planes(images, relief_m, -1 / rad_m, window)
        seen = looks_on_plane * np.maximum(facing, _LEAST_FORESHORTENING)
        coherence = debiased(planes.coherence, seen)
        sd_m = phase_sd_rad(coherence, seen / planes.growth) / np.abs(rad_m)
        valid = known & (facing > _LEAST_FORESHORTENING)
        valid &= coherence >= np.maximum(task.least_coherence, noise_coherence(seen, _FALSE_ALARM))
        valid &= np.abs(planes.height_m - first_m) < _CREDIBLE * task.ambiguity_m
        valid &= planes.growth < _MOST_GROWTH * level_growth
        # Without noise, the sweep's heights are rougher than the deviation. Filling their windows
        # would make steps, which make the neighbours rough in turn.
        smooth_m = _MOST_ROUGHNESS * sd_m
        usable = valid & (planes.roughness_m < np.maximum(smooth_m, _LINEAR_RAD / np.abs(rad_m)))
        valid &= planes.roughness_m < smooth_m
        change = np.abs(planes.height_m - relief_m) / sd_m
        # The median is not affected by the few pixels beside steps of the relief.
        median = float(np.median(change[valid])) if valid.any() else 0.0
        correction = DEVIATION_PER_MEDIAN * median
        settled = valid & (change < _UNSETTLED)
        whole_sd_m = np.hypot(sd_m, displacement_m(planes.bend_m, sd_m, settled, window))
        found = Refined(
            planes.height_m, whole_sd_m, coherence, seen, -1 / rad_m, settled, image, correction
        )
        progress(done)
        if found.converged:
            break
        relief_m = start_m + filled(planes.height_m - start_m, usable)
        slope_m = np.stack([planes.row_slope_m, planes.column_slope_m])
    return replace(found, certificate=task.pair.certificate(image, other, seconds))


def sensitivity(
    grid: Grid,
    offset_m: NDArray[np.float64],
    slope_m: NDArray[np.float64],
    sights: Lattice,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the change of phase per metre of height error, rad/m, and the foreshortening.

    Parameters
    ----------
    grid : Grid
        The plane.
    offset_m : float64 [rows, columns]
        Heights above it.
    slope_m : float64 [2, rows, columns]
        Their slopes, metres per row and per column.
    sights : Lattice
    """
    _, row_step_m, column_step_m = grid.vectors_m
    rows, columns = map(np.arange, grid.shape)
    rad_m, row_tangent, column_tangent = sights.over(rows, columns, offset_m)
    facing = 1 - (slope_m[0] + row_step_m[2]) * row_tangent
    facing -= (slope_m[1] + column_step_m[2]) * column_tangent
    return rad_m / np.maximum(facing, _LEAST_FORESHORTENING), facing


def displacement_m(
    bend_m: NDArray[np.float64],
    noise_m: NDArray[np.float64],
    valid: NDArray[np.bool_],
    window: Window,
) -> NDArray[np.float64]:
    """Return the rms displacement of heights by the curvature of the seabed within windows, metres.

    A plane displaces the middle of a curved window, and does so again if it is fitted to the
    heights that were found. That second displacement estimates the first one (Tukey 1977). Its mean
    square around every pixel, less that of noise, is the square of the result.

    Parameters
    ----------
    bend_m : float64 [rows, columns]
        Displacement of the relief by planes, `Planes.bend_m`.
    noise_m : float64 [rows, columns]
        Deviation of the heights by noise.
    valid : bool [rows, columns]
        Pixels that count.
    window : Window
    """
    excess = np.where(valid, bend_m**2 - _BEND_NOISE * noise_m**2, 0.0)
    around = window.scaled(_BENDING)
    share = around.sums(valid.astype(float))
    return np.sqrt(np.maximum(around.sums(excess), 0.0) / np.maximum(share, 1.0))


def filled(values: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return values in which unknown ones are those of the nearest known pixel, or 0 if none is."""
    if known.all():
        return values
    if not known.any():
        return np.zeros_like(values)
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return values[tuple(nearest)]
