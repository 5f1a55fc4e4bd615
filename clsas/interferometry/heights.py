"""Heights of the seabed from two banks of receivers.

The method has two steps. A sweep finds, along curves of equal range, the heights at which the
banks agree (`clsas.interferometry.sweep`); large windows decide between the cycles of the phase.
Both banks are then imaged on that relief, and the remaining phase corrects it
(`clsas.interferometry.refinement`), with a plane fitted in every window
(`clsas.interferometry.planes`). Passes end when corrections are below the deviation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.georeference import placed
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, cycles_per_m_at
from clsas.engine.device.device import Device, open_device
from clsas.engine.factorized.planner import TOLERANCE
from clsas.engine.promise import report
from clsas.engine.signal.spectrum import measure_spectrum
from clsas.interferometry.baseline import Baseline, Lattice, sight_lattice
from clsas.interferometry.checks import (
    COHERENCE,
    HEIGHTS_TOLERANCE_DB,
    SEARCH,
    WINDOW,
    check_echoes,
    check_geometry,
    check_grid,
    check_pair,
)
from clsas.interferometry.coherence import (
    Window,
    check_looks,
    effective_looks,
    noise_coherence,
)
from clsas.interferometry.doubts import Doubts, end_of, larger_m
from clsas.interferometry.pair import Pair
from clsas.interferometry.refinement import PASSES, Refined, filled, refine
from clsas.interferometry.request import Request
from clsas.interferometry.result import Heights
from clsas.interferometry.shadows import in_shadow
from clsas.interferometry.side_lobes import from_elsewhere, point_response
from clsas.interferometry.sweep import STEPS_PER_CYCLE, Curves, Relief, sweep
from clsas.interferometry.task import Task

LEAST_COHERENCE = 0.5
"""Default of the smallest coherence with a valid height."""

_LOOKS = 50.0  # in the default window: a deviation of 0.1 rad at a coherence of 0.7
_TRIAL_PIXELS = 9  # side of the window that measures the density of samples; arbitrary
# Pixels along the side of a window in the sweep, about as many as independent samples. Twice as
# many make 93.0 % instead of 92.4 % of simulated dunes valid and take four times as long.
_SWEPT_PIXELS = 5
# Least error of the images of the sweep, dB, as a phase 0.03 rad. With -40 dB the same pixels are
# valid, and volumes that banks with separate transmitters see take four times as long.
_SWEPT_DB = -30.0
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
        Largest relative rms error of the images on the relief, dB, as for `factorize`. The error
        of those of the last pass is measured if they take 0.1 s or more; a warning appears if it
        exceeds the tolerance. Images of the sweep may have an error of -30 dB.
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

    The sweep images both banks at six heights per cycle, along those curves, on some of the pixels.
    At the height of the scatterers the phase is zero, and the magnitude of the coherence is
    largest. Large windows decide between cycles, small ones determine the height. Both banks are
    then imaged on the relief that was found. In every window a plane is fitted to the height plus
    what the remaining phase adds to it, until corrections are below 0.3 deviations. The
    reported deviation is ::

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

    The track may sway, but must be close to straight over the channels that see a pixel, since a
    scatterer above an imaged surface appears in one place only then.

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
    return found.heights


class Measured(NamedTuple):
    """Heights, and how they were found.

    Attributes
    ----------
    heights : Heights
    refined : Refined
        Includes pixels in shadow.
    sights : Lattice
        How the banks see the grid.
    doubts : Doubts
    """

    heights: Heights
    refined: Refined
    sights: Lattice
    doubts: Doubts


def measured(
    pair: Pair, grid: Grid, request: Request, progress: Callable[[int, int], None] | None
) -> Measured:
    """Return heights, and how they were found, without a warning of what is doubtful.

    Raises
    ------
    UnmeasurableError
        If the geometry or the images do not show heights.
    """
    task, images, window_m, window, looks = _begun(pair, grid, request)
    heights_m = _sweep_heights(task.search_m, task.ambiguity_m)
    total = len(heights_m) + PASSES
    report = progress or (lambda done, total: None)
    relief, doubts = _first_relief(
        task, images, window_m, heights_m, lambda done: report(done, total)
    )
    sights = sight_lattice(task.baseline, grid, task.search_m)
    refined = refine(
        replace(task, pair=pair),
        relief,
        sights,
        window,
        looks,
        lambda done: report(len(heights_m) + done, total),
    )
    report(total, total)
    response = point_response(task.pair, task.level)
    power = np.abs(refined.image.pixels.astype(np.complex128)) ** 2
    valid = refined.valid & ~from_elsewhere(power, response, window)
    hidden = in_shadow(task.plane, refined.offset_m, refined.sd_m, valid, sights, window)
    found = Heights(
        refined.offset_m,
        refined.sd_m,
        refined.coherence,
        valid & ~hidden,
        refined.looks,
        refined.m_per_rad,
        refined.image,
        window_m,
        refined.certificate,
    )
    return Measured(found, refined, sights, doubts)


def windows(pair: Pair, grid: Grid, request: Request) -> tuple[float, Window, Window]:
    """Return the windows with which heights of a grid, or of one like it, are measured.

    Returns
    -------
    window_m : float
        The requested one, or the default.
    window, large : Window
        Windows of the heights, and those that decide between cycles of the phase.
    """
    task, _, window_m, window, looks = _begun(pair, grid, request)
    large = _large_window(looks, window, task.relative_band, task.least_coherence)
    return window_m, window, large


class _Begun(NamedTuple):
    """The task, images on the plane, and the window with its effective number of looks."""

    task: Task
    images: tuple[NDArray[np.complex64], NDArray[np.complex64]]
    window_m: float
    window: Window
    looks: float


def _begun(pair: Pair, grid: Grid, request: Request) -> _Begun:
    """Return what images of the plane show; raise UnmeasurableError if they show no heights."""
    # Rays are exact on the relief that is refined. A sweep needs no more than nearly right ones.
    straight = pair.straightened(grid)
    task = _task(straight, grid, request.search_m, request.least_coherence)
    images = straight.images(task.level)
    window_m = request.window_m
    if window_m is None:
        window_m = _default_window_m(images, grid)
    window = Window.of(grid, window_m)
    looks = effective_looks(images, window)
    check_looks(window_m, looks)
    return _Begun(task, images, window_m, window, looks)


def _task(pair: Pair, grid: Grid, search_m: tuple[float, float], least_coherence: float) -> Task:
    """Return the task; raise UnmeasurableError unless the geometry shows heights."""
    spectrum = measure_spectrum(pair.a)
    cycles_per_m = float(cycles_per_m_at(pair.a, spectrum.centre))
    band_cycles_per_m = 1 / (spectrum.oversampling * pair.a.range_step_m)
    baseline = Baseline.of(pair.a, pair.b, pair.beam, cycles_per_m)
    relative_band = band_cycles_per_m / abs(cycles_per_m)
    ambiguity_m = check_geometry(baseline, grid, search_m, relative_band, least_coherence)
    return Task(pair, grid, search_m, least_coherence, baseline, relative_band, ambiguity_m)


def _first_relief(
    task: Task,
    images: tuple[NDArray[np.complex64], NDArray[np.complex64]],
    window_m: float,
    heights_m: NDArray[np.float64],
    progress: Callable[[int], None],
) -> tuple[Relief, Doubts]:
    """Return the relief that a sweep over heights finds, from some rows and columns of the grid.

    `images` are those on a level surface, which show how many independent samples there are.
    """
    every = max(min(Window.of(task.grid, window_m).sides) // _SWEPT_PIXELS, 1)
    few = slice(None, None, every)
    coarser = task.grid.window(few, few)
    small = Window.of(coarser, window_m)
    looks = effective_looks(tuple(each[few, few] for each in images), small)
    large = _large_window(looks, small, task.relative_band, task.least_coherence)
    large_m = None
    if task.search_m[1] - task.search_m[0] > task.ambiguity_m:
        large_m = larger_m(coarser, large)
    curves = Curves.over(task.baseline, coarser, heights_m)
    validate.memory("grid and search_m", 32 * len(heights_m) * curves.grid.size)
    found = sweep(task.pair.within(_SWEPT_DB), curves, small, large, progress)
    reliable = found.coherence >= noise_coherence(looks, _FALSE_ALARM / len(heights_m))
    end = end_of(found) if reliable.mean() > 2 * _FALSE_ALARM else None
    rows, columns = (np.arange(math.ceil((n - 1) / every) + 1.0) for n in task.grid.shape)
    relief = found.relief(rows, columns, reliable, task.ambiguity_m)
    return (
        _finer(relief, every, task.grid.shape),
        Doubts(end, large_m, task.ambiguity_m),
    )


def _finer(relief: Relief, every: int, shape: tuple[int, ...]) -> Relief:
    """Return the relief of a grid whose pixels are `every` times as close."""
    if every == 1:
        return relief
    rows, columns = (np.arange(n) / every for n in shape)
    nearest = np.ix_(rows.round().astype(int), columns.round().astype(int))
    known_m = filled(relief.offset_m, relief.surfaces == 1)
    at = np.broadcast_arrays(rows[:, None], columns)
    return Relief(map_coordinates(known_m, at, order=1), relief.surfaces[nearest])


def _sweep_heights(search_m: tuple[float, float], ambiguity_m: float) -> NDArray[np.float64]:
    """Return heights a sixth of a cycle apart, one of them beyond either end of the search."""
    step_m = ambiguity_m / STEPS_PER_CYCLE
    count = math.ceil((search_m[1] - search_m[0]) / step_m) + 2
    middle_m = (search_m[0] + search_m[1]) / 2
    return middle_m + step_m * (np.arange(count + 1.0) - count / 2)


def _default_window_m(images: tuple[NDArray, NDArray], grid: Grid) -> float:
    """Return the side of windows with about `_LOOKS` independent samples, metres."""
    steps_m = [float(np.linalg.norm(step)) for step in grid.vectors_m[1:]]
    most_m = min(n * step_m for n, step_m in zip(grid.shape, steps_m, strict=True))
    trial = Window.of(grid, min(_TRIAL_PIXELS * max(steps_m), most_m))
    pixel_m2 = math.prod(steps_m)
    looks_per_m2 = effective_looks(images, trial) / (trial.pixels * pixel_m2)
    return min(math.sqrt(_LOOKS / looks_per_m2), most_m)


def _large_window(
    looks: float, window: Window, relative_band: float, least_coherence: float
) -> Window:
    """Return the window that decides between cycles of the phase.

    From the magnitude of the coherence alone, N looks determine the difference of two ranges to
    sqrt(3/(2 N)) sqrt(1 - g^2)/(pi g) range resolutions (Bamler and Eineder 2005). Half a cycle is
    half the relative bandwidth of a range resolution.
    """
    per_look = math.sqrt(1.5 * (1 - least_coherence**2)) / (math.pi * least_coherence)
    needed = (_CYCLE_SD * per_look / (relative_band / 2)) ** 2
    return window.scaled(math.sqrt(max(needed / looks, 1)))


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
