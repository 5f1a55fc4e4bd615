"""Heights of the seabed from two banks of receivers.

One image of a plane per bank shows the banks at all heights along curves of equal range
(`clsas.interferometry.curves`). A sweep finds the heights at which they agree
(`clsas.interferometry.sweep`); large windows decide between the cycles of the phase. The phase that
remains corrects them, with a plane fitted in every window (`clsas.interferometry.refinement`). Both
banks are then imaged on the relief, and corrections end when they are below the deviation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import affine_transform

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.georeference import placed
from clsas.engine.data.grid import Grid, without_heights
from clsas.engine.data.lines import RangeLines, cycles_per_m_at
from clsas.engine.device.device import Device, open_device
from clsas.engine.factorized.planner import TOLERANCE
from clsas.engine.imaging import Imager
from clsas.engine.promise import report
from clsas.engine.signal.spectrum import measure_spectrum
from clsas.interferometry.baseline import Baseline, Lattice, in_pixels, sight_lattice
from clsas.interferometry.checks import (
    COHERENCE,
    HEIGHTS_TOLERANCE_DB,
    SEARCH,
    WINDOW,
    Request,
    check_echoes,
    check_geometry,
    check_grid,
    check_looks,
    check_pair,
)
from clsas.interferometry.coherence import (
    Moments,
    Window,
    block_sums,
    effective_looks,
    noise_coherence,
)
from clsas.interferometry.curves import CurveImages, Curves, spacing_m
from clsas.interferometry.pair import Pair, PairImages
from clsas.interferometry.refinement import PASSES, Refined, View, enlarged, filled, refine
from clsas.interferometry.result import Heights
from clsas.interferometry.shadows import in_shadow
from clsas.interferometry.side_lobes import from_elsewhere, point_response
from clsas.interferometry.sweep import STEPS_PER_CYCLE, Doubts, Relief, end_of, relief_of, sweep

LEAST_COHERENCE = 0.5
"""Default of the smallest coherence with a valid height."""

_LOOKS = 50.0  # in the default window: a deviation of 0.1 rad at a coherence of 0.7
_TRIAL_PIXELS = 9  # side of the window that measures the density of samples; arbitrary
# Curves along the side of a window. With 5, heights on the relief differ from those on the curves
# by a deviation, and 1 % of simulated dunes is lost; with 10, the sweep takes twice as long.
_CURVES = 7
_BLOCKS = 10  # along the side of a window
# Half a cycle, in deviations of the height that the magnitude of the coherence shows: 0.1 % of the
# cycles are wrong at the least coherence. Half the value loses a tenth of simulated dunes, twice
# the value gives the same heights.
_CYCLE_SD = 3.3
# Share of the incoherent curves that the sweep takes for coherent. Each adds a surface at a random
# height, which looks like layover. Passes on the relief use the threshold of the coherence itself.
_FALSE_ALARM = 0.05


def heights(
    a: RangeLines,
    b: RangeLines,
    grid: Grid,
    *,
    search_m: Annotated[ArrayLike, SEARCH],
    window_m: Annotated[float | None, WINDOW] = None,
    tolerance_db: Annotated[float, TOLERANCE] = HEIGHTS_TOLERANCE_DB,
    least_coherence: Annotated[float, COHERENCE] = LEAST_COHERENCE,
    beam: BeamWindow | None = None,
    device: Device | str | int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Heights:
    """Return the heights of a seabed, and their deviations, from two banks of receivers.

    Parameters
    ----------
    a, b : RangeLines
        Range lines of the two banks: the same pings, with receivers at different heights.
    grid : Grid
        Plane above which heights are measured, along z. If the grid is a height map, such as a
        coarse bathymetry, its relief is where the search starts.
    search_m : (lowest, highest)
        Heights above the pixels of the grid between which the seabed lies, metres: above the plane,
        or above the relief of a height map. The phase repeats with the height of ambiguity: a
        seabed outside the search may appear inside it, too high or too low by that much. A warning
        appears if most of the seabed seems to lie outside.
    window_m : float, optional
        Side of the windows in which the coherence is estimated, metres. It is the resolution of the
        heights. By default windows contain about 50 independent samples.
    tolerance_db : float
        Largest relative rms error of the images, dB, as for `factorize`. The error of the last
        ones on the relief is measured if they take 0.1 s or more; a warning appears if it exceeds
        the tolerance.
    least_coherence : float
        Smallest coherence of a valid height, 0.1 to 0.99.
    beam : BeamWindow, optional
        Weights of the channels by aspect angle.
    device : Device, str or int, optional
        See `clsas.engine.device.device.choose`.
    progress : callable, optional
        Called as progress(steps done, steps at most).

    Returns
    -------
    Heights
        Heights above the plane, even if the grid is a height map.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is outside its limits; if the banks have different
        pings, carriers or range steps, no distance across the line of sight, or one so large that a
        level seabed is not coherent; if the grid consists of points, or its plane is vertical; if
        the search reaches the sonar or lies outside the range of the lines; or if a window contains
        fewer than 4 independent samples.
    DeviceError
        If the device does not exist.

    Warns
    -----
    ClsasWarning
        If the search spans several heights of ambiguity and the grid is too small to tell them
        apart; if the banks agree best at an end of the search, so that the seabed seems to lie
        outside; if less than a hundredth of the pixels is coherent; if the corrections do not
        fall below the deviation; or if an image of the last pass misses its tolerance.

    See Also
    --------
    interferogram : Phase and coherence of two images.
    pair_errors : Phase, delay and roll of the banks, from known heights.

    Notes
    -----
    Banks whose receivers are apart see a scatterer from different elevations. If both images are
    formed on a surface that passes e below the scatterer, the scatterer has the phase [1]_ ::

        arg(a b*) = -e K / (1 - m.t),   K = 2 k D.t

    where D is the gradient of the difference between the two ranges, t is the tangent of the curve
    on which range and position along the track are constant, per metre of rise, and m is the slope
    of the seabed. The height of ambiguity, 2 pi/K, changes the phase by a cycle.

    Along those curves, an image of the first bank is the same at all heights, and one of the second
    bank is that of a plane, displaced by the change of its range. The sweep therefore compares both
    images of one plane, at six heights per cycle. At the height of the scatterers the phase is
    zero, and the magnitude of the coherence is largest. Large windows decide between cycles, small
    ones determine the height. In every window a plane is then fitted to the height plus what the
    remaining phase adds to it. At last both banks are imaged on the relief that was found, and the
    fit is repeated until corrections are below the deviation. The reported deviation is ::

        sd = sqrt((1 - m.t)^2 / K^2 (1 - g^2) / (2 L g^2) + d^2)

    with the coherence g, L independent samples, and the displacement d of planes in windows within
    which the seabed bends. A plane that is fitted to the heights found displaces them as it
    displaced the true ones; d is the rms of that around the pixel, less what noise causes.

    Images are coregistered because they are formed in the time domain, and a sway or yaw of the
    track is accounted for like any other motion. The mask leaves out what is not coherent, pixels
    on none of the curves or hidden by other pixels (shadow), and pixels on several curves or on
    slopes that face the sonar too steeply (layover). It also leaves out windows that receive most
    of their power from elsewhere, by side lobes and ambiguities of brighter places, as far as the
    response to a point in the middle of the grid shows.

    Errors that all pixels have in common are not part of the deviation. A constant phase between
    the banks, as from a delay of one receiver, adds `Heights.m_per_rad` per radian. An error of the
    baseline's roll turns the seabed about the track by as much: 1 mm of height per metre of ground
    range and mrad. `pair_errors` estimates both.

    Side lobes and ambiguities of brighter places carry the phase of those places. Weight the band
    in `compress` and the directions by `beam` where the brightness varies strongly. On simulated
    dunes with an unweighted band, errors were 1.1 times the deviation, since range side lobes make
    crests too low and troughs too high; with a Hamming window they were 1.0 times. On a rock whose
    far side is 25 dB darker than the seabed beside it, they were 2.9 times the deviation with equal
    weights for all directions, and 0.9 times with a Hann window of 14 degrees.

    The track may sway, but must be close to straight over the channels that see a pixel. Deviations
    blur what lies above or below an imaged plane along the track, in both images alike.

    References
    ----------
    .. [1] Rodriguez and Martin, "Theory and design of interferometric synthetic aperture radars",
       IEE Proceedings F 139(2), 1992.

    Examples
    --------
    A flat seabed 0.2 m above the plane of the grid, 20 m away:

    >>> import clsas
    >>> import numpy as np
    >>> random = np.random.default_rng(1)
    >>> places_m = random.uniform([-0.6, 19.4, 0.2], [0.6, 21.2, 0.2], (6000, 3))
    >>> amplitudes = random.standard_normal((6000, 2)) @ [1, 1j]
    >>> scene = clsas.PointTargets(places_m, amplitudes)
    >>> tx_m = np.outer(np.linspace(-2, 2, 81), [1, 0, 0]) + [0, 0, 6]
    >>> lower, upper = (
    ...     clsas.simulate_lines(
    ...         tx_m, tx_m + [0, 0, up_m], scene, carrier_hz=100e3, bandwidth_hz=30e3
    ...     )
    ...     for up_m in (0.0, 0.2)
    ... )
    >>> grid = clsas.Grid.plane((-0.4, 0.4, 33), (19.8, 20.6, 33))
    >>> found = clsas.heights(lower, upper, grid, search_m=(-0.4, 0.6))
    >>> print(f"{np.median(found.height_m[found.mask]):.2f} m")
    0.20 m
    """
    check_pair(a, b)
    check_echoes(a, b)
    validate.instance("grid", grid, Grid)
    check_grid(grid)
    grid = placed(b, placed(a, grid))
    request = Request.checked(grid, search_m, window_m, tolerance_db, least_coherence, beam)
    validate.progress(progress)
    pair = Pair(a, b, request.tolerance_db, None, beam, open_device(device))
    return measure(pair, grid, request, progress)


def measure(
    pair: Pair, grid: Grid, request: Request, progress: Callable[[int, int], None] | None
) -> Heights:
    """Return the heights that a pair of banks shows."""
    found = measured(pair, grid, request, progress)
    found.doubts.warn()
    _warn(found.refined)
    if (certificate := found.heights.certificate) is not None:
        report(certificate, request.tolerance_db, "warn")
    elif found.unmeasured:
        validate.warn(f"the error of the images is not known: {found.unmeasured}")
    return found.heights


class Measured(NamedTuple):
    """Heights, and how they were found.

    Attributes
    ----------
    heights : Heights
    refined : Refined
        The same with pixels in shadow.
    sights : Lattice
        How the banks see the grid.
    doubts : Doubts
    unmeasured : str
        Why the error of the images could not be measured; "" if it was, or was not to be.
    """

    heights: Heights
    refined: Refined
    sights: Lattice
    doubts: Doubts
    unmeasured: str


def measured(
    pair: Pair, grid: Grid, request: Request, progress: Callable[[int, int], None] | None
) -> Measured:
    """Return heights, and how they were found, without a warning of what is doubtful.

    Raises
    ------
    UnmeasurableError
        If the geometry or the images do not show heights.
    """
    task = Task.of(pair, grid, request)
    offset_m = _sweep_heights(request.search_m, task.ambiguity_m)
    total = len(offset_m) + PASSES
    report = progress or (lambda done, total: None)
    relief_m, known, doubts = _first_relief(task, offset_m, lambda done: report(done, total))

    plane, side = without_heights(grid), task.side
    shape = grid.shape[0], grid.shape[1]
    last: list[tuple[PairImages, Moments]] = []

    def products_at(relief_m: NDArray[np.float64]) -> Moments:
        first = (1 - side) / (2 * side)  # pixel, counted from the first block
        finer_m = affine_transform(relief_m, 2 * [1 / side], first, shape, order=1, mode="nearest")
        images = pair.images(plane.with_height(finer_m))
        last[:] = [(images, Moments.multilooked(*images.pixels, side))]
        return last[0][1]

    start_m = np.zeros(1) if grid.height_m is None else grid.height_m
    span_m = start_m.min() + request.search_m[0], start_m.max() + request.search_m[1]
    sights = sight_lattice(task.baseline, plane, span_m)
    window = Window.of(task.blocks, task.window_m)
    view = View(
        task.blocks, sights.every(side, side, [1, side, side, 1]), window,
        task.looks * window.pixels * side**2 / task.window.pixels, request.least_coherence,
        task.ambiguity_m,
    )  # fmt: skip
    refined = refine(
        products_at,
        relief_m,
        known,
        view,
        progress=lambda done: report(len(offset_m) + done, total),
    )
    report(total, total)
    images, products = last[0]
    response = block_sums(point_response(task.straight, task.level, task.imager), side)
    valid = refined.valid & ~from_elsewhere(products.power_a, response, window)
    valid &= ~in_shadow(task.blocks, refined.offset_m, refined.sd_m, valid, view.sights, window)
    refined = refined.in_pixels(side, shape)
    certificate, unmeasured = pair.certificate(images)
    found = Heights(
        refined.offset_m,
        refined.sd_m,
        refined.coherence,
        enlarged(valid, side, shape),
        refined.looks,
        refined.m_per_rad,
        images.first,
        task.window_m,
        certificate,
    )
    return Measured(found, refined, sights, doubts, unmeasured)


def windows(pair: Pair, grid: Grid, request: Request) -> tuple[float, Window, Window]:
    """Return the windows with which heights of a grid, or of one like it, are measured.

    They are the side of the windows, metres, these windows, and those that decide between cycles
    of the phase.
    """
    task = Task.of(pair, grid, request)
    return task.window_m, task.window, task.large_window(task.looks, task.window)


@dataclass(frozen=True, eq=False)
class Task:
    """Two banks, the grid whose heights they measure, and what follows from both.

    The banks are those in homogeneous water: rays are exact only in the last images. `level` is the
    plane of the grid, raised by its mean height, and `imager` forms images there. `looks` is
    the effective number of looks of a window. `side` is that of the blocks of pixels over which
    products of images are summed at once.
    """

    straight: Pair
    grid: Grid
    request: Request
    baseline: Baseline
    relative_band: float
    ambiguity_m: float
    level: Grid
    imager: Imager
    window_m: float
    window: Window
    looks: float
    side: int

    @classmethod
    def of(cls, pair: Pair, grid: Grid, request: Request) -> Self:
        """Return the task; raise UnmeasurableError if geometry or images show no heights."""
        straight = pair.straightened(grid)
        spectrum = measure_spectrum(straight.a)
        cycles_per_m = float(cycles_per_m_at(straight.a, spectrum.centre))
        relative_band = 1 / (spectrum.oversampling * straight.a.range_step_m * abs(cycles_per_m))
        baseline = Baseline.of(straight.a, straight.b, straight.beam, cycles_per_m)
        ambiguity_m = check_geometry(
            baseline, grid, request.search_m, relative_band, request.least_coherence
        )
        mean_m = 0.0 if grid.height_m is None else float(grid.height_m.mean())
        level = replace(without_heights(grid), origin_m=grid.vectors_m[0] + [0.0, 0.0, mean_m])
        images = straight.images(level)
        window_m = request.window_m or _default_window_m(images.pixels, grid)
        window = Window.of(grid, window_m)
        looks = effective_looks(images.pixels, window)
        check_looks(window_m, looks)
        return cls(
            straight, grid, request, baseline, relative_band, ambiguity_m, level, images.imager,
            window_m, window, looks, max(min(window.sides) // _BLOCKS, 1),
        )  # fmt: skip

    @property
    def blocks(self) -> Grid:
        """The plane of the grid, with a place for every block."""
        origin_m, row_step_m, column_step_m = self.grid.vectors_m
        return replace(
            without_heights(self.grid),
            origin_m=origin_m + (self.side - 1) / 2 * (row_step_m + column_step_m),
            row_step_m=self.side * row_step_m,
            column_step_m=self.side * column_step_m,
            shape=tuple(math.ceil(n / self.side) for n in self.grid.shape),
        )

    def large_window(self, looks: float, window: Window) -> Window:
        """Return the window that decides between cycles of the phase.

        From the magnitude of the coherence alone, N looks determine the difference of two ranges to
        sqrt(3/(2 N)) sqrt(1 - g^2)/(pi g) range resolutions (Bamler and Eineder 2005). Half a cycle
        is half the relative bandwidth of a range resolution.
        """
        least = self.request.least_coherence
        per_look = math.sqrt(1.5 * (1 - least**2)) / (math.pi * least)
        needed = (_CYCLE_SD * per_look / (self.relative_band / 2)) ** 2
        return window.scaled(math.sqrt(max(needed / looks, 1)))


def _first_relief(
    task: Task, offset_m: NDArray[np.float64], progress: Callable[[int], None]
) -> tuple[NDArray[np.float64], NDArray[np.bool_], Doubts]:
    """Return the relief that images of a plane show, where it is known, and doubts about it."""
    grid, window_m, request = task.grid, task.window_m, task.request
    step_m = window_m / _CURVES
    across_m = spacing_m(task.baseline, task.level, task.relative_band)
    every = max(round(step_m / across_m), 1)
    ends_m = float(offset_m[0]), float(offset_m[-1])
    fine = Curves.over(task.baseline, grid, ends_m, (across_m, step_m))
    validate.memory("grid and search_m", 8 * len(offset_m) * fine.grid.size // every)
    images = CurveImages.of(task.straight, fine, every)
    curves = images.curves
    window = Window.of(curves.grid, window_m)
    looks = effective_looks(images.at(0.0), window)
    large = task.large_window(looks, window)
    swept = sweep(images, curves.start_m(grid), offset_m, window, large, progress)
    reliable = swept.coherence >= noise_coherence(looks, _FALSE_ALARM / len(offset_m))
    end = end_of(swept) if reliable.mean() > 2 * _FALSE_ALARM else None
    side_m, large_m = large.rows * float(np.linalg.norm(curves.grid.vectors_m[1])), None
    if np.ptp(request.search_m) > task.ambiguity_m and side_m > min(_sides_m(grid)):
        large_m = side_m
    doubts = Doubts(end, large_m, task.ambiguity_m)

    height_m = filled(swept.height_m, reliable)
    view = View(
        curves.grid, curves.sights, window, looks, request.least_coherence, task.ambiguity_m
    )
    found = refine(images.products, height_m, window.any_of(reliable), view)
    height_m = found.relief_m
    seen = reliable & found.usable  # other heights jump, which looks like layover
    relief = relief_of(curves.moved(height_m), height_m, seen, task.ambiguity_m)
    return *_at_pixels(relief, curves, window, task.blocks), doubts


def _at_pixels(
    relief: Relief, curves: Curves, window: Window, grid: Grid
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return a relief at the pixels of a grid, above its plane, and where it is known."""
    origin_m, *steps_m = grid.vectors_m
    first = in_pixels(curves.grid, origin_m[:2] - curves.grid.vectors_m[0][:2])
    steps = in_pixels(curves.grid, np.array(steps_m)[:, :2]).T

    def at_pixels(values: NDArray, order: int) -> NDArray:
        return np.asarray(
            affine_transform(
                values, steps, first, output_shape=grid.shape, order=order, mode="nearest"
            )
        )

    found_once = relief.surfaces == 1
    # Single curves may be missing. Where a window reaches known heights, it decides by itself.
    known = window.any_of(found_once) & (relief.surfaces < 2)
    height_m = at_pixels(filled(relief.height_m, found_once), 1)
    plane_m = without_heights(grid).positions_m()[..., 2]
    return height_m + curves.level_m - plane_m, at_pixels(known.astype(np.uint8), 0) > 0


def _sweep_heights(search_m: tuple[float, float], ambiguity_m: float) -> NDArray[np.float64]:
    """Return heights a sixth of a cycle apart, one of them beyond either end of the search."""
    step_m = ambiguity_m / STEPS_PER_CYCLE
    count = math.ceil((search_m[1] - search_m[0]) / step_m) + 2
    middle_m = (search_m[0] + search_m[1]) / 2
    return middle_m + step_m * (np.arange(count + 1.0) - count / 2)


def _default_window_m(images: tuple[NDArray, NDArray], grid: Grid) -> float:
    """Return the side of windows with about `_LOOKS` independent samples, metres."""
    steps_m = [float(np.linalg.norm(step)) for step in grid.vectors_m[1:]]
    most_m = min(_sides_m(grid))
    trial = Window.of(grid, min(_TRIAL_PIXELS * max(steps_m), most_m))
    pixel_m2 = math.prod(steps_m)
    looks_per_m2 = effective_looks(images, trial) / (trial.pixels * pixel_m2)
    return min(math.sqrt(_LOOKS / looks_per_m2), most_m)


def _sides_m(grid: Grid) -> tuple[float, float]:
    """Return the lengths of the sides of a plane or height map, metres."""
    down, across = (
        n * float(np.linalg.norm(step))
        for n, step in zip(grid.shape, grid.vectors_m[1:], strict=True)
    )
    return down, across


def _warn(refined: Refined) -> None:
    share = float(refined.valid.mean())
    if share < 0.01:
        validate.warn(
            f"only {100 * share:.2g} % of the pixels are coherent: the seabed may lie outside "
            "`search_m`, or the positions of the banks may be wrong"
        )
    elif not refined.converged:
        validate.warn(
            f"after {PASSES} passes the heights still change by {refined.correction:.2g} standard "
            "deviations: steep relief may need smaller windows"
        )
