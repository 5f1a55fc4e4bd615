"""Choosing a plan: what every division costs and errs by, and the fastest within a tolerance."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from clsas import interpolation, validate
from clsas.aperture import cycles_per_pixel, drift, mean_track, phase_centres_m, turned
from clsas.costs import WITH_BEAM, Costs
from clsas.costs import load as load_costs
from clsas.device import Device, open_device
from clsas.geometry import pairwise_range_m
from clsas.grid import Grid
from clsas.interpolation import Interpolator, Spectrum
from clsas.layout import BLOCKS
from clsas.lines import RangeLines
from clsas.nearest import stage_errors_m
from clsas.plan import GUARD, Plan, Stage, grid_digest, lines_digest, padded_length
from clsas.tree import (
    Division,
    beam_directions,
    beam_rate,
    interpolated_directions,
    interpolated_nodes,
)
from clsas.window import BeamWindow, touches_rectangles

BEST_TOLERANCE_DB = -75.0
"""The tightest tolerance that may be asked for: what float32 leaves of a factorized image."""
WORST_TOLERANCE_DB = -10.0

_ROWS = (16, 32, 64, 128, 256, 512, 1024, 2048)  # of subimages
_COLUMNS = (4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048)
_MOST_STAGES = 5
_ALIGN_TAPS, _APERTURE_TAPS, _FINAL_TAPS = (4, 6, 8), (4, 6, 8), (2, 4, 6, 8)
_RATES = tuple(np.geomspace(1, 12, 16))  # where filters' errors are looked at
_FLAT = Spectrum(0.0, (np.arange(64) + 0.5) / 128, np.full(64, 1 / 64))
NEAREST_UPSAMPLING = 8.0
"""By how much lines are upsampled before the linear interpolation of given stages."""

_MARGIN_DB = 1.0  # between prediction and tolerance, for what measured errors scatter
_FLOAT32 = 4.5e-8  # rms error of a phase in the stages over the phase across a root: measured
_MOST_BATCH_BYTES = 48 << 20  # what stays near a CPU's caches
_SPOTS = (0.02, 0.25, 0.5, 0.75, 0.98)  # of rows and columns, where the geometry is looked at
_COARSER = 4  # of the track's samples: where roots are compared
_ROOTS_SHARE, _NODES_SHARE = 0.25, 0.2  # of the error allowed
_MOST_CROWDING = 2.0
_LEAST_BEAM_CYCLES, _MOST_BEAM_CYCLES = 0.5, 64.0
_CHANNELS, _PLACES, _PIXELS = 256, 300, 24  # at which errors are evaluated
_SOME_SPOTS = 6  # one in so many of the spots, there


def plan(
    lines: RangeLines,
    grid: Grid,
    *,
    tolerance_db: float | None = None,
    tolerance_wavelengths: float | None = None,
    stages: Sequence[tuple[int, int]] | None = None,
    beam: BeamWindow | None = None,
    device: Device | str | int | None = None,
    memory_bytes: int | None = None,
    costs: Costs | None = None,
) -> Plan:
    """Choose the fastest way to an image of a given error.

    Exactly one of `tolerance_db`, `tolerance_wavelengths` and `stages` must be given.

    Parameters
    ----------
    lines : RangeLines
        What to image.
    grid : Grid
        Where.
    tolerance_db : float
        Wanted relative rms error against the exact image, dB, from -75 to -10.
    tolerance_wavelengths : float
        The same as a range error, in wavelengths of the carrier: that which is spread evenly
        between minus and plus so much, 4 pi/sqrt(3) radians rms per wavelength.
    stages : sequence of (QR, QI)
        Form the image as THESIS chapter 4 does: in every stage QR neighbouring lines are summed
        and the subimages divided by QI along either side; then the last ones are backprojected.
        No stage is plain backprojection. Range is interpolated linearly.
    beam : BeamWindow, optional
        Weights of the channels.
    device : Device, str or int, optional
        Whose costs count; see `clsas.device.choose`.
    memory_bytes : int, optional
        Device memory that may be used; half of the device's unless given.
    costs : Costs, optional
        Instead of those stored for the device.

    Returns
    -------
    Plan
        With empty `sides`, plain backprojection, where nothing is faster: near the aperture, with
        few channels or pixels, and off a plane.

    Raises
    ------
    TypeError, ValueError
        If an argument is not what is allowed, or the memory holds not even one root subimage.
    DeviceError
        If there is no such device.
    """
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    given = [tolerance_db, tolerance_wavelengths, stages]
    if sum(value is not None for value in given) != 1:
        raise ValueError(
            "exactly one of tolerance_db, tolerance_wavelengths and stages must be given, "
            f"got {tolerance_db}, {tolerance_wavelengths}, {stages}"
        )
    if tolerance_wavelengths is not None:
        limits = [wavelengths(each) for each in (BEST_TOLERANCE_DB, WORST_TOLERANCE_DB)]
        tolerance_wavelengths = validate.number(
            "tolerance_wavelengths",
            tolerance_wavelengths,
            "wavelengths",
            least=limits[0],
            most=limits[1],
        )
        tolerance_db = decibels(tolerance_wavelengths)
    elif tolerance_db is not None:
        tolerance_db = validate.number(
            "tolerance_db", tolerance_db, "dB", least=BEST_TOLERANCE_DB, most=WORST_TOLERANCE_DB
        )
    if costs is not None:
        validate.instance("costs", costs, Costs)
    device = open_device(device)
    costs = costs or load_costs(device)
    if memory_bytes is None:
        memory_bytes = device.info.memory_bytes // 2
    memory_bytes = validate.count("memory_bytes", memory_bytes)
    view = View(lines, grid, beam)
    if stages is not None:
        checked = _checked_stages(stages, lines, grid)
        if checked and view.track is None:
            raise ValueError("lines must have channels at more than one place for stages")
        if checked and beam is not None and beam.normalise:
            raise ValueError("beam must not normalise with stages; clsas.backproject does")
        return _nearest(view, checked, device, costs, memory_bytes)
    exact = _exact(view, tolerance_db, device, costs)
    if view.track is None or grid.size == 1 or (beam is not None and beam.normalise):
        return exact
    allowed = 10 ** (tolerance_db / 10)
    most = _root_limits(view, _ROOTS_SHARE * allowed)
    beam_cycles = 0.0 if beam is None else _LEAST_BEAM_CYCLES
    needed, spared = 0, 0.0 if most is None else _root_error(view, most) + 0.05 * allowed
    tree: _Tree | None = None
    while most is not None and beam_cycles <= _MOST_BEAM_CYCLES and spared < 0.9 * allowed:
        filters_db = _decibel(allowed - spared) - _MARGIN_DB
        if tree is None:
            tree = _search(view, filters_db, most, beam_cycles, device, costs)
            crowding = () if tree is None else (1.0,) * len(tree.sides)
        filters = None if tree is None else _filters(view, tree, filters_db)
        if filters is None and needed:
            raise ValueError(
                f"memory_bytes must be at least {needed / 2**20:.1f} MiB to factorize, "
                f"got {memory_bytes / 2**20:.1f} MiB; clsas.backproject needs less"
            )
        if filters is None:
            break
        within = view.within(tree.sides[0])
        others = _other_errors(within, tree.sides, filters.aperture, crowding, beam_cycles, device)
        found = _plan(
            within,
            tolerance_db,
            filters,
            tree.sides,
            others.total,
            device,
            costs,
            memory_bytes,
            crowding=crowding,
            beam_cycles=beam_cycles,
        )
        if found.predicted_seconds >= exact.predicted_seconds:
            break
        if found.memory_bytes > memory_bytes:
            needed, tree = found.memory_bytes, None
            rows, columns = found.sides[0]
            most = (rows // 2, columns) if rows > columns else (rows, columns // 2)
        elif found.predicted_error_db <= tolerance_db:
            return found
        else:
            # What uneven spacing and a beam add falls with the density of nodes; filters must
            # make up for the rest.
            share = _NODES_SHARE * allowed / len(found.sides)
            uneven = _excess_error(within, found.sides[-1], found.aperture, crowding[-1], None)
            if others.nodes[-1] > share and uneven < others.nodes[-1] / 2:
                beam_cycles *= 2
            elif max(others.nodes) > share and max(crowding) < _MOST_CROWDING:
                crowding = tuple(
                    1.1 * c if excess > share else c
                    for c, excess in zip(crowding, others.nodes, strict=True)
                )
            else:
                spared += max(others.total - spared, 0.1 * allowed)
    return exact


def _root_limits(view: View, allowed: float) -> tuple[int, int] | None:
    """Return the largest rows and columns of roots that keep their errors within a power.

    None where there are none.
    """
    rows, columns = (
        min((side for side in sides if side >= n), default=sides[-1])
        for sides, n in zip((_ROWS, _COLUMNS), view.grid.shape, strict=True)
    )
    while _root_error(view, (rows, columns)) > allowed:
        smaller = [(rows // 2, columns), (rows, columns // 2)]
        smaller = [side for side in smaller if side[0] >= _ROWS[0] and side[1] >= _COLUMNS[0]]
        if not smaller:
            return None
        rows, columns = min(smaller, key=lambda side: _root_error(view, side))
    return rows, columns


def decibels(wavelengths: float) -> float:
    """Return the relative rms error of range errors spread evenly up to some wavelengths, dB."""
    return 20 * math.log10(4 * math.pi * wavelengths / math.sqrt(3))


def wavelengths(decibels: float) -> float:
    """Return what `decibels` made an error of."""
    return 10 ** (decibels / 20) * math.sqrt(3) / (4 * math.pi)


class View:
    """How the track sees the grid at some spots: what costs and errors depend on.

    Attributes
    ----------
    spots_m : float64 [spots, 3]
        Over the whole grid, its corners among them.
    rates : float64 [2, spots, samples]
        Cycles per pixel row and column and per unit of the track's parameter.
    """

    def __init__(self, lines: RangeLines, grid: Grid, beam: BeamWindow | None) -> None:
        self.lines, self.grid, self.beam = lines, grid, beam
        self.spectrum = interpolation.measure_spectrum(lines)
        occupied = self.spectrum.frequency[np.cumsum(self.spectrum.power) < 1 - 1e-6]
        half_band = (occupied[-1] if len(occupied) else 0.5) / lines.range_step_m
        centre = lines.carrier_cycles_per_m + self.spectrum.centre / lines.range_step_m
        self.highest_cycles_per_m = abs(centre) + half_band
        self.track = mean_track(lines) if grid.is_planar else None
        if self.track is None:
            return
        self.steps_m = np.stack([grid.row_step_m, grid.column_step_m])
        self.spots_m = self._pixels_m(_SPOTS)
        position = self.track.positions_m(self.track.samples)
        sight = self.spots_m[:, None] - position
        self.distance_m = np.maximum(np.linalg.norm(sight, axis=-1), 1e-9)
        self.sight = sight / self.distance_m[..., None]
        self.on_track = np.abs(self.track.samples - 0.5) <= 0.5
        # Between the places that are looked at a pixel may come nearer.
        dense_m = self._pixels_m(np.linspace(0, 1, 65))
        cell_m = np.linalg.norm(self.steps_m, axis=1) @ (np.array(grid.shape) - 1) / 128
        nearest_m = KDTree(phase_centres_m(lines)).query(dense_m)[0].min() - cell_m
        self.nearest_m = max(float(nearest_m), 1e-9)
        self._cycles_in_root: dict[tuple[int, int], NDArray[np.float64]] = {}
        self.along = None
        if beam is not None:
            self.along = beam_directions(beam, lines, self.track, self.track.samples)
            self.beam_rates = beam_rate(beam, self.track, self.along, self.spots_m)
        self.rates = self._rates((0, 0), self.spots_m)

    def _pixels_m(self, places: Sequence[float]) -> NDArray[np.float64]:
        """Return positions at some parts of the rows and columns, [n, 3]."""
        index = np.array(list(product(places, places))) * (np.array(self.grid.shape) - 1)
        return self.grid.origin_m + index @ self.steps_m

    def seen(self, rows: float, columns: float) -> NDArray[np.bool_]:
        """Return from where channels see anything of subimages at the spots, [spots, samples]."""
        seen = np.broadcast_to(self.on_track, self.distance_m.shape)
        if self.beam is None:
            return seen
        half_m = np.array([[rows], [columns]]) / 2 * self.steps_m
        origin_m = self.spots_m[0]
        track_m = self.track.positions_m(self.track.samples) - origin_m
        return seen & touches_rectangles(
            self.beam, self.spots_m - origin_m, half_m, track_m, self.along
        )

    def cycles(
        self,
        rates: NDArray[np.float64],
        seen: NDArray[np.bool_],
        over: Callable[[NDArray[np.float64]], float] = np.mean,
    ) -> float:
        """Return how far a phase turns while it is seen, on average over the spots."""
        return float(over(turned(self.track, np.where(seen, rates, 0.0))[:, -1]))

    def turns(
        self,
        side: tuple[int, int],
        seen: NDArray[np.bool_],
        over: Callable[[NDArray[np.float64]], float] = np.mean,
    ) -> float:
        """Return `cycles` of the phases of subimages of a size."""
        return self.cycles(side[0] * self.rates[0] + side[1] * self.rates[1], seen, over)

    def within(self, root: tuple[int, int]) -> View:
        """Return this view with the rates of subimages in roots of a size."""
        view = copy.copy(self)
        view.rates = self._rates(root, self.spots_m)
        return view

    def cycles_in_root(self, root: tuple[int, int], seen: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return `cycles` per row and column in roots of a size, roughly, [n, 2].

        `seen` is [n, spots, samples]: while which of some subimages are seen.
        """
        if root in self._cycles_in_root:
            return self._cycles_in_root[root]
        middle = np.arange(len(_SPOTS) ** 2).reshape(len(_SPOTS), -1)[1:-1, 1:-1].ravel()
        rates = self._rates(root, self.spots_m[middle], _COARSER)
        steps = np.gradient(self.track.samples[::_COARSER])
        while_seen = seen[:, middle, ::_COARSER] * steps
        cycles = np.einsum("nps,kps->nk", while_seen, rates) / len(middle)
        self._cycles_in_root[root] = cycles
        return cycles

    def _rates(
        self, root: tuple[int, int], centres_m: NDArray[np.float64], every: int = 1
    ) -> NDArray[np.float64]:
        return cycles_per_pixel(
            self.track,
            self.grid,
            centres_m,
            root,
            self.highest_cycles_per_m,
            self.nearest_m,
            self.beam,
            self.along,
            every,
        )

    @functools.cached_property
    def slopes_m(self) -> tuple[float, float]:
        """Largest change of range per row and per column."""
        seen = self.seen(16, 16)
        slopes = np.abs(self.sight @ self.steps_m.T)
        slopes = slopes[seen] if seen.any() else slopes.reshape(-1, 2)
        return tuple(1.02 * slopes.max(axis=0))

    def reach_m(self, side: tuple[int, int]) -> float:
        """Return by how much a pixel's range may differ from that of its subimage's centre."""
        radius_m = Division(self.grid, (side,)).radius_m(0)
        bend_m = radius_m**2 / (2 * max(self.nearest_m, radius_m))
        return min(float(np.dot(side, self.slopes_m)) / 2 + bend_m, radius_m)

    def half_lengths(
        self,
        sides: Sequence[tuple[int, int]],
        align: Interpolator,
        final: Interpolator,
        ratio: float,
    ) -> tuple[int, ...]:
        """Return the samples to either side of a centre that the lines of each stage must hold."""
        samples_per_m = ratio / self.lines.range_step_m
        return tuple(
            math.ceil(self.reach_m(side) * samples_per_m)
            + (len(sides) - 1 - level) * (align.taps // 2 + 1)
            + final.taps // 2
            + 1
            for level, side in enumerate(sides)
        )


@dataclass(frozen=True)
class _Filters:
    align: Interpolator
    aperture: Interpolator
    final: Interpolator


@dataclass(frozen=True)
class _Choice:
    """Taps and rates of filters that are not designed yet."""

    align_taps: int
    rate: float
    aperture_taps: int
    density: float
    final_taps: int


@dataclass(frozen=True)
class _Tree:
    """Sizes of subimages, and taps of the filters between them."""

    sides: list[tuple[int, int]]
    align_taps: int
    aperture_taps: int


def _search(
    view: View,
    filters_db: float,
    most: tuple[int, int],
    beam_cycles: float,
    device: Device,
    costs: Costs,
) -> _Tree | None:
    """Return the fastest tree whose filters err by no more than `filters_db` together.

    None where there is none with roots of `most` rows and columns.

    For every number of stages and choice of filters, the fastest way from the whole grid to the
    leaves is a shortest path over the sizes that subimages may have.
    """
    lines, grid = view.lines, view.grid
    rows, columns = (
        [side for side in sides if side < 2 * max(n, min(sides))]
        for sides, n in zip((_ROWS, _COLUMNS), grid.shape, strict=True)
    )
    sides = np.array(list(product(rows, columns)))
    counts = np.prod(-(-np.array(grid.shape) // sides), axis=1)
    pixels = counts * np.prod(sides, axis=1)
    seen = np.array([view.seen(*side) for side in sides])
    share = seen[..., view.on_track].mean(axis=(1, 2))
    divides = (sides[:, None] % sides == 0).all(axis=-1) & (sides[:, None] != sides).any(axis=-1)
    too_curved = _leaf_error(view, sides, device) > 0.25 * 10 ** (filters_db / 10)
    reach_m = np.array([view.reach_m(side) for side in sides])

    leaf_ns = costs.leaf_ns * (1.0 if view.beam is None else WITH_BEAM)
    for_beam = np.zeros(len(sides))
    if view.beam is not None:
        for_beam = beam_cycles * np.array([view.cycles(view.beam_rates, s) for s in seen])

    choices = []
    for stages in range(1, _MOST_STAGES + 1):
        for taps in product(_ALIGN_TAPS, _APERTURE_TAPS):
            choice = _choice(view.spectrum, *taps, _each(filters_db, stages))
            if choice is None:
                continue
            samples = 2 * reach_m * choice.rate / lines.range_step_m + choice.final_taps + 16
            sample_ns = costs.sample_ns + costs.sample_tap_ns * sum(taps)
            per_channel = counts * (samples * sample_ns + costs.channel_ns)
            fixed = costs.upsampled_sample_ns * lines.samples.size * choice.rate
            choices.append((stages, choice, per_channel, fixed + stages * costs.batch_ns))
    best = math.inf, None, []
    for root in np.flatnonzero((sides <= most).all(axis=1)):
        within = np.flatnonzero((sides[root] % sides == 0).all(axis=1))
        cycles = None
        for stages, choice, per_channel, fixed in choices:
            first = share[root] * per_channel[root] + counts[root] * costs.reference_ns
            first = lines.channels * first + fixed
            if first >= best[0]:
                continue
            if cycles is None:
                # While a subimage of size i is seen, of phases that turn as for size j.
                cycles = view.cycles_in_root(tuple(sides[root]), seen[within]) @ sides[within].T
            density = 2 * choice.density
            nodes = density * (np.diag(cycles) + for_beam[within])
            nodes += 1 if view.beam else choice.aperture_taps
            # Channels of a parent of size j that a child of size i uses.
            used = density * cycles + 2 * choice.aperture_taps
            step = np.where(divides[np.ix_(within, within)].T, used, np.inf)
            step *= per_channel[within, None]
            last = pixels[within] * leaf_ns * interpolation.COST[choice.final_taps]
            last = nodes * (last + counts[within] * costs.channel_ns)
            last[too_curved[within]] = np.inf
            total = np.where(within == root, first, np.inf)
            path = []
            for _ in range(stages - 1):
                through = total + step
                path.append(through.argmin(axis=1))
                total = through.min(axis=1)
            leaf = int((total + last).argmin())
            if (total + last)[leaf] < best[0]:
                chain = [leaf]
                for parents in reversed(path):
                    chain.append(int(parents[chain[-1]]))
                best = (total + last)[leaf], choice, within[chain[::-1]]
    _, choice, chain = best
    if choice is None:
        return None
    chosen = [tuple(map(int, sides[i])) for i in chain]
    return _Tree(chosen, choice.align_taps, choice.aperture_taps)


def _filters(view: View, tree: _Tree, filters_db: float) -> _Filters | None:
    """Return the filters of a tree whose errors together are no more than `filters_db`."""
    choice = _choice(
        view.spectrum, tree.align_taps, tree.aperture_taps, _each(filters_db, len(tree.sides))
    )
    if choice is None:
        return None
    return _Filters(
        interpolation.design(choice.align_taps, choice.rate, view.spectrum),
        interpolation.design(choice.aperture_taps, choice.density, _FLAT),
        interpolation.design(choice.final_taps, choice.rate, view.spectrum),
    )


def _each(filters_db: float, stages: int) -> float:
    """Return the error that every interpolation may have: two of a stage, and the last."""
    return filters_db - 10 * math.log10(2 * stages + 1)


def _choice(
    spectrum: Spectrum, align_taps: int, aperture_taps: int, each_db: float
) -> _Choice | None:
    """Return the least rates at which every interpolation errs by no more; None without any."""
    rate = _least(align_taps, each_db, spectrum, "scatter_db")
    density = _least(aperture_taps, each_db, _FLAT, "error_db")
    if rate is None or density is None:
        return None
    needed = {taps: _least(taps, each_db, spectrum, "scatter_db") for taps in _FINAL_TAPS}
    final_taps = next(t for t in _FINAL_TAPS if needed[t] is not None and needed[t] <= rate)
    return _Choice(align_taps, rate, aperture_taps, density, final_taps)


def _least(taps: int, wanted_db: float, spectrum: Spectrum, error: str) -> float | None:
    """Return the least rate at which a filter errs by no more, None where no rate is enough."""
    key = spectrum.frequency.tobytes(), spectrum.power.tobytes()
    errors = _errors_db(taps, error, *key)
    if errors[-1] > wanted_db:
        return None
    if errors[0] <= wanted_db:
        return _RATES[0]
    # Errors fall with the rate; a half per cent of rate and a tenth of a decibel are for rounding.
    return 1.005 * float(np.exp(np.interp(0.1 - wanted_db, -errors, np.log(_RATES))))


@functools.lru_cache(maxsize=64)
def _errors_db(taps: int, error: str, frequency: bytes, power: bytes) -> NDArray[np.float64]:
    """Return the errors of filters at all `_RATES`."""
    spectrum = Spectrum(0.0, np.frombuffer(frequency), np.frombuffer(power))
    found = [getattr(interpolation.design(taps, rate, spectrum), error) for rate in _RATES]
    return np.minimum.accumulate(found)


def _leaf_error(view: View, sides: NDArray[np.int64], device: Device) -> NDArray[np.float64]:
    """Return the power of the error that expanding leaves of some sizes adds.

    See `layout.lay_out`: the fourth order of a tile, and the third within a block. In long leaves
    the former is 0.35 of the largest rms.
    """
    steps_m = np.linalg.norm(view.steps_m, axis=1)
    radius_m = np.hypot(*(sides * steps_m).T) / 2
    block_m = np.hypot(*(np.array(BLOCKS[device.info.width]) * steps_m)) / 2
    nearest_m = np.maximum(view.nearest_m, 1e-6)
    remainder_m = 0.35 * radius_m**4 / (8 * nearest_m**3) + 0.04 * block_m**3 / nearest_m**2
    power = (2 * np.pi * view.highest_cycles_per_m * remainder_m) ** 2
    if view.beam is not None:
        power += view.beam.block_error(block_m / nearest_m) ** 2
        window_sine = np.ptp(np.clip(view.beam.limits, -1, 1))
        power += (0.1 * (radius_m / nearest_m) ** 4 / window_sine) ** 2
    return power


def _plan(
    view: View,
    tolerance_db: float | None,
    filters: _Filters,
    sides: list[tuple[int, int]],
    other_error: float,
    device: Device,
    costs: Costs,
    memory_bytes: int,
    nearest: Sequence[tuple[int, int]] = (),
    crowding: tuple[float, ...] = (),
    beam_cycles: float = 0.0,
) -> Plan:
    """Return a plan with all that is expected of it.

    `view` is that within its roots where the aperture is interpolated; `other_error` the power of
    the errors that the filters do not account for.
    """
    lines, grid = view.lines, view.grid
    align, aperture, final = filters.align, filters.aperture, filters.final
    resampling = interpolation.resampling(lines.length, align, view.spectrum)
    halves = view.half_lengths(sides, align, final, resampling.ratio)
    density = 2 * aperture.upsampling
    stages, channels = [], float(lines.channels)
    tile = _tile(view, sides[-1], device) if nearest else sides[-1]
    width = device.info.width
    sample_ns = costs.sample_ns + costs.sample_tap_ns * (align.taps + aperture.taps)
    used = channels * view.seen(*sides[0])[:, view.on_track].mean()
    for level, side in enumerate(sides):
        count = math.prod(-(-n // s) for n, s in zip(grid.shape, side, strict=True))
        samples = -(-(2 * halves[level] + 1) // width) * width
        seen = view.seen(*side)
        turns = view.turns(side, seen)
        if level and not nearest:
            used = crowding[level - 1] * density * view.turns(sides[level - 1], seen)
            used = min(channels, used + 2 * aperture.taps)
        if nearest:
            used = channels
            channels = math.ceil(channels / nearest[level][0])
        else:
            turns *= crowding[level]
            if view.beam is not None and level == len(sides) - 1:
                turns += beam_cycles * view.cycles(view.beam_rates, seen)
            channels = density * turns + (1 if view.beam else aperture.taps)
        operations = count * used * samples
        seconds = 1e-9 * (operations * sample_ns + count * used * costs.channel_ns)
        if not level:
            seconds += 1e-9 * count * lines.channels * costs.reference_ns
            seconds += 1e-9 * costs.upsampled_sample_ns * lines.channels * resampling.length
        error = _power(align) if nearest else 10 ** (align.scatter_db / 10) + _power(aperture)
        stages.append(
            Stage(*side, count, round(channels), samples, operations, _decibel(error), seconds)
        )
    pixels = count * math.prod(side)
    operations = pixels * channels
    leaf_ns = costs.leaf_ns * (1.0 if view.beam is None else WITH_BEAM)
    seconds = 1e-9 * leaf_ns * interpolation.COST[final.taps] * operations
    seconds += 1e-9 * count * channels * costs.channel_ns
    stages.append(
        Stage(*side, count, round(channels), samples, operations, final.scatter_db, seconds)
    )
    line_bytes = 8 * lines.channels * padded_length(resampling, halves[0])
    root_bytes = _root_bytes(view, sides, tile, stages, filters, crowding, beam_cycles)
    room = min(memory_bytes - line_bytes, _MOST_BATCH_BYTES)
    at_once = min(max(int(room // root_bytes), 1), stages[0].subimages)
    batches = -(-stages[0].subimages // at_once)
    in_batches = 1e-9 * costs.batch_ns * batches * len(sides)
    error = other_error + sum(10 ** (stage.error_db / 10) for stage in stages)
    return Plan(
        tolerance_db=tolerance_db,
        sides=tuple(sides),
        tile=tile,
        nearest=tuple(beams for beams, _ in nearest),
        align=align,
        aperture=aperture,
        final=final,
        resampling=resampling,
        half_lengths=halves,
        highest_cycles_per_m=view.highest_cycles_per_m,
        roots_at_once=at_once,
        stages=tuple(stages),
        predicted_error_db=_decibel(error) + (_MARGIN_DB if not nearest else 0.0),
        predicted_seconds=sum(stage.seconds for stage in stages) + in_batches,
        exact_seconds=_exact_seconds(view, costs),
        memory_bytes=int(line_bytes + at_once * root_bytes),
        device=device.info.label,
        lines_digest=lines_digest(lines),
        grid_digest=grid_digest(grid),
        beam=view.beam,
        crowding=crowding,
        beam_cycles=beam_cycles,
    )


def _root_bytes(
    view: View,
    sides: Sequence[tuple[int, int]],
    tile: tuple[int, int],
    stages: Sequence[Stage],
    filters: _Filters,
    crowding: tuple[float, ...],
    beam_cycles: float,
) -> float:
    """Return the device memory that a root takes while it is worked on: see `factorize`."""
    taps, channels, result = filters.aperture.taps, view.lines.channels, 0.0
    density = 2 * filters.aperture.upsampling
    for level, side in enumerate(sides):
        seen = view.seen(*side)
        crowd = crowding[level] if crowding else 1.0
        # Virtual channels of the whole aperture, and those of the subimage that sees most.
        everywhere, most = (
            density * crowd * view.turns(side, where, np.max) + taps + 2
            for where in (np.ones_like(seen), seen)
        )
        if view.beam is not None and level == len(sides) - 1:
            most += density * beam_cycles * view.cycles(view.beam_rates, seen, np.max)
        if not crowding:  # nearest beams
            everywhere = most = stages[level].channels
        subimages = _subimages(sides[0], side)
        result += 8 * subimages * most * (stages[level].samples + 2 * GUARD)
        result += subimages * 56 + (channels + 32) * (4 + 4 * taps + (12 if level else 16))
        channels = everywhere
    terms = 9 if view.beam is None else 19
    result += _subimages(sides[0], tile) * ((most + 16) * (12 + 4 * terms) + 36)
    return result + 36 * channels + 8 * math.prod(sides[0])


def _subimages(root: tuple[int, int], side: tuple[int, int]) -> int:
    return math.prod(a // b for a, b in zip(root, side, strict=True))


@dataclass(frozen=True)
class _Errors:
    """Powers of the errors that filters do not account for.

    Of rounding and of putting channels on the track, of uneven nodes and weights stage by stage,
    and of expanding leaves.
    """

    roots: float
    nodes: tuple[float, ...]
    leaves: float

    @property
    def total(self) -> float:
        return self.roots + sum(self.nodes) + self.leaves


def _other_errors(
    view: View,
    sides: Sequence[tuple[int, int]],
    aperture: Interpolator,
    crowding: tuple[float, ...],
    beam_cycles: float,
    device: Device,
) -> _Errors:
    last = len(sides) - 1
    return _Errors(
        roots=_root_error(view, sides[0]),
        nodes=tuple(
            _excess_error(view, side, aperture, crowd, beam_cycles if level == last else None)
            for level, (side, crowd) in enumerate(zip(sides, crowding, strict=True))
        ),
        leaves=float(_leaf_error(view, np.array([sides[-1]]), device)[0]),
    )


def _root_error(view: View, side: tuple[int, int]) -> float:
    """Return the power of the error of roots: of rounding, and of channels put on the mean track.

    The latter is evaluated as it is: over channels, roots and pixels of these at random, how a
    range changes from a root's centre to a pixel for the channel, less the same for the place on
    the track that stands for it. That holds what the track does not follow, transmitters and
    receivers apart, and motion during flight.
    """
    lines, track = view.lines, view.track
    index = np.arange(0, lines.channels, -(-lines.channels // _CHANNELS))
    part = replace(track, place=track.place[index])
    middle_m = phase_centres_m(lines)
    side = np.minimum(side, view.grid.shape)
    seen = view.seen(*side)
    random = np.random.default_rng(0)
    powers, total = [], 0
    for spot in range(0, len(view.spots_m), _SOME_SPOTS):
        some = np.interp(part.place, track.samples, seen[spot]) > 0
        if not some.any():
            continue
        near_index = index[some]
        velocity = lines.rx_velocity_m_s
        near = replace(track, place=part.place[some])
        offset_m = random.uniform(-0.5, 0.5, (_PIXELS, 2)) * side @ view.steps_m
        points_m = view.spots_m[spot] + np.concatenate([np.zeros((1, 3)), offset_m])
        range_m = pairwise_range_m(
            points_m,
            lines.tx_m[near_index],
            lines.rx_m[near_index],
            velocity if velocity is None else velocity[near_index],
            lines.sound_speed_m_s,
        )
        virtual_m = track.positions_m(near.places_seen_from(points_m[:1], middle_m[near_index])[0])
        on_track_m = pairwise_range_m(points_m, virtual_m, virtual_m)
        on_track_m -= (points_m @ drift(lines))[:, None]
        away_m = (range_m - range_m[0]) - (on_track_m - on_track_m[0])
        powers.append(np.sum(away_m[1:] ** 2) / _PIXELS)
        total += len(index[some])
    off_track = (2 * np.pi * view.highest_cycles_per_m) ** 2 * sum(powers) / max(total, 1)
    radius_m = np.linalg.norm(side * np.linalg.norm(view.steps_m, axis=1)) / 2
    rounding = (2 * np.pi * _FLOAT32 * view.highest_cycles_per_m * radius_m) ** 2
    return float(off_track + rounding)


def _excess_error(
    view: View,
    side: tuple[int, int],
    aperture: Interpolator,
    crowding: float,
    beam_cycles: float | None,
) -> float:
    """Return the power of the error that a stage's nodes add to that of the aperture's filter.

    The filter takes nodes as equally spaced and weights as constant. Evaluated as it is, for
    subimages and pixels of them at random: steering functions between nodes against what
    interpolation makes of them; in the last stage, where `beam_cycles` is given, weighted.
    """
    track, random = view.track, np.random.default_rng(0)
    wavelength_m = view.lines.sound_speed_m_s / max(view.lines.carrier_hz, 1e-3)
    weighted = view.beam is not None and beam_cycles is not None
    seen = view.seen(*side)
    wrong = total = 0.0
    for spot in np.flatnonzero(seen.any(axis=1))[::_SOME_SPOTS]:
        places = track.samples[seen[spot]]
        place = np.linspace(places[0], places[-1], _PLACES)
        rate = crowding * (side[0] * view.rates[0, spot] + side[1] * view.rates[1, spot])
        if weighted:
            rate = rate + beam_cycles * view.beam_rates[spot]
        nodes = interpolated_nodes(track, rate[None], place[None], aperture)
        offset_m = random.uniform(-0.5, 0.5, (_PIXELS, 2)) * side @ view.steps_m
        points_m = view.spots_m[spot] + np.concatenate([np.zeros((1, 3)), offset_m])

        def steering(at: NDArray[np.float64], points_m: NDArray[np.float64] = points_m) -> NDArray:
            sight = points_m[:, None] - track.positions_m(at)
            range_m = np.linalg.norm(sight, axis=-1)
            turns = view.highest_cycles_per_m * (range_m[1:] - range_m[0])
            result = np.exp(2j * np.pi * turns)
            if weighted:
                along = interpolated_directions(track.samples, view.along, at)
                sine = np.einsum("psi,si->ps", sight[1:], along) / range_m[1:]
                result *= view.beam.weights(sine, wavelength_m)
            return result

        of_nodes = steering(nodes.place[0])
        index = nodes.base[0][:, None] + np.arange(nodes.taps)
        between = np.einsum("pct,ct->pc", of_nodes[:, index], nodes.weights[0])
        exact = steering(place[nodes.order[0]])
        wrong += np.sum(np.abs(between - exact) ** 2)
        total += np.sum(np.abs(exact) ** 2)
    return max(wrong / max(total, 1e-30) - _power(aperture), 0.0)


def _nearest(
    view: View,
    stages: Sequence[tuple[int, int]],
    device: Device,
    costs: Costs,
    memory_bytes: int,
) -> Plan:
    """Return the plan of THESIS chapter 4: nearest beams, linear interpolation in range."""
    if not stages:
        return _exact(view, None, device, costs)
    rows, columns = view.grid.shape
    division = math.prod(divisions for _, divisions in stages)
    # Whole work-items: 16 rows by 4 columns.
    leaf = 16 * math.ceil(rows / division / 16), 4 * math.ceil(columns / division / 4)
    sides = []
    for _, divisions in reversed(stages):
        sides.append(leaf)
        leaf = leaf[0] * divisions, leaf[1] * divisions
    linear = interpolation.design(2, NEAREST_UPSAMPLING, view.spectrum)
    filters = _Filters(linear, Interpolator(1, 1.0, np.zeros((0, 2, 0)), 0.0, 0.0), linear)
    error = _nearest_error(view, stages)
    chosen = _plan(view, None, filters, sides[::-1], error, device, costs, memory_bytes, stages)
    if chosen.memory_bytes > memory_bytes:
        raise ValueError(
            f"memory_bytes must be at least {chosen.memory_bytes / 2**20:.1f} MiB for these "
            f"stages, got {memory_bytes / 2**20:.1f} MiB"
        )
    return chosen


def _nearest_error(view: View, stages: Sequence[tuple[int, int]]) -> float:
    """Return the power of the error of nearest beams: THESIS [45], spread evenly."""
    centres_m = phase_centres_m(view.lines)[np.argsort(view.track.place)]
    spacing_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1).mean()
    image_m = np.max(np.array(view.grid.shape) * np.linalg.norm(view.steps_m, axis=1))
    total_m = sum(stage_errors_m(stages, spacing_m, image_m, view.nearest_m))
    return (2 * math.pi * view.lines.carrier_cycles_per_m * total_m) ** 2 / 3


def _tile(view: View, leaf: tuple[int, int], device: Device) -> tuple[int, int]:
    """Return the largest parts of a leaf that may be expanded about their centres."""
    parts = [
        (rows, columns)
        for rows in range(16, min(leaf[0], 64) + 1, 16)
        for columns in range(4, min(leaf[1], 64) + 1, 4)
        if leaf[0] % rows == 0 and leaf[1] % columns == 0
    ]
    fit = [part for part in parts if _leaf_error(view, np.array([part]), device)[0] < 1e-8]
    return max(fit or parts[:1], key=math.prod)


def _checked_stages(stages: Sequence[tuple[int, int]], lines: RangeLines, grid: Grid) -> list:
    """Return (QR, QI) of every stage, or raise what is wrong with them."""
    try:
        pairs = [(stage[0], stage[1]) for stage in stages if len(stage) == 2]
        whole = len(pairs) == len(stages)
    except TypeError:
        whole = False
    if not whole:
        raise TypeError(f"stages must be a sequence of (QR, QI), got {stages!r}")
    pairs = [
        (validate.count("QR of stages", beams), validate.count("QI of stages", divisions))
        for beams, divisions in pairs
    ]
    if not pairs:
        return pairs
    if not grid.is_planar:
        raise ValueError("grid must be a plane for stages")
    most_beams, most_divisions = lines.channels, max(min(grid.shape), 1)
    beams, divisions = (math.prod(numbers) for numbers in zip(*pairs, strict=True))
    if beams > most_beams or divisions > most_divisions:
        raise ValueError(
            f"stages must leave a line and a pixel: they sum {beams} of {lines.channels} lines and "
            f"divide {grid.shape[0]} x {grid.shape[1]} pixels by {divisions} along either side"
        )
    return pairs


def _exact(view: View, tolerance_db: float | None, device: Device, costs: Costs) -> Plan:
    """Return plain backprojection as a plan."""
    seconds = _exact_seconds(view, costs)
    return Plan(
        tolerance_db=tolerance_db,
        sides=(),
        tile=(0, 0),
        nearest=(),
        align=None,
        aperture=None,
        final=None,
        resampling=None,
        half_lengths=(),
        highest_cycles_per_m=view.highest_cycles_per_m,
        roots_at_once=1,
        stages=(),
        predicted_error_db=-60.0 if tolerance_db is None else tolerance_db - _MARGIN_DB,
        predicted_seconds=seconds,
        exact_seconds=seconds,
        memory_bytes=0,
        device=device.info.label,
        lines_digest=lines_digest(view.lines),
        grid_digest=grid_digest(view.grid),
        beam=view.beam,
    )


def _exact_seconds(view: View, costs: Costs) -> float:
    lines = view.lines
    share = 1.0
    if view.beam is not None:
        share = WITH_BEAM
        if view.track is not None:
            share *= view.seen(32, 32)[:, view.on_track].mean()
    pairs = lines.channels * view.grid.size * share
    return 1e-9 * (costs.pixel_ns * pairs + 2 * costs.upsampled_sample_ns * lines.samples.size)


def _power(interpolator: Interpolator) -> float:
    return 10 ** (interpolator.error_db / 10)


def _decibel(power: float) -> float:
    return 10 * math.log10(max(power, 1e-30))
