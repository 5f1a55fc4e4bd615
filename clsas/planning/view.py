"""The model of a scene that costs and errors are evaluated on.

It holds the lines' spectrum, the mean track, and what the track's samples see of some points of
the grid.
"""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from clsas.core.grid import Grid
from clsas.core.lines import RangeLines, some_channels, wavelength_m
from clsas.exact.tiles import STACK
from clsas.factorized.aperture import cycles_per_extent, mean_track, own_drift
from clsas.factorized.surface import LEAST_SIDE, surface_of, within_roots
from clsas.factorized.visibility import beam_directions, beam_rate
from clsas.signal.ambiguity import Ambiguity, ambiguity
from clsas.signal.interpolation import Interpolator, Resampling
from clsas.signal.spectrum import cycles_per_m_at, measure_spectrum
from clsas.sonar.beam import BeamWindow
from clsas.sonar.visibility import Visibility, sines

_NEIGHBOURS = 64  # channels over which the density of channels is taken
_CHANNELS = 256  # sampled for what they see
_POINTS = (0.02, 0.25, 0.5, 0.75, 0.98)  # sample points, as parts of the rows and columns
_WEIGHTS = np.array([0.135, 0.24, 0.25, 0.24, 0.135])  # of these in means over the grid
_SHARES = np.outer(_WEIGHTS, _WEIGHTS).ravel() / _WEIGHTS.sum() ** 2
_MIDDLE = np.arange(len(_POINTS) ** 2).reshape(len(_POINTS), -1)[1:-1, 1:-1].ravel()
_EVERYWHERE = np.linspace(0, 1, 17)  # parts of rows and columns
_BINS = 512  # of a beam
_MOST_OUTSIDE = 1e-6  # of the lines' power, beyond what counts as their highest frequency
_MOST_TURNED = 1 / 16  # of a beam, from one channel to the next
_COARSER = 4  # every so many samples of the track are enough to compare roots


def kept(function: Callable[..., Any]) -> Callable[..., Any]:
    """Cache a function, or method, of a view by the view's limits and root and by its arguments.

    Views that were derived from each other share what they keep.
    """

    @functools.wraps(function)
    def from_before(view: View, *arguments: Hashable, **options: Hashable) -> Any:
        key = (function.__qualname__, view.limits, view.root, arguments, *options.items())
        return view.cached(key, lambda: function(view, *arguments, **options))

    return from_before


def shared(function: Callable[[View], Any]) -> Callable[[View], Any]:
    """Cache what views with other limits or roots have in common."""

    @functools.wraps(function)
    def from_before(view: View) -> Any:
        return view.cached(function.__qualname__, lambda: function(view))

    return from_before


class View:
    """The track as seen from sample points of the grid: what costs and errors depend on.

    Attributes
    ----------
    surface : Surface
        The positions of the grid's pixels.
    points_m : float64 [points, 3]
        Sample points all over the grid, near its corners too.
    track_m : float64 [samples, 3]
        Positions at `track.samples`.
    spacing : float64 [samples]
        Weight of each of these in integrals over the track's parameter.
    limits : (low, high) or None
        Sines of the aspect angle between which the beam weighs anything.
    root : (rows, columns) or None
        Pixels of the roots that `rates` hold for; None for the plane of the grid.
    kept : dict
        Cached results of this view and those derived from it; see `kept`.

    `outside` is the share of the lines' power that may lie outside of their nominal band.
    """

    def __init__(
        self,
        lines: RangeLines,
        grid: Grid,
        beam: BeamWindow | None,
        outside: float = _MOST_OUTSIDE,
    ) -> None:
        self.lines, self.grid, self.beam = lines, grid, beam
        self.kept: dict[Hashable, Any] = {}
        self.spectrum = measure_spectrum(lines, grid)
        outside = min(outside, _MOST_OUTSIDE)
        occupied = self.spectrum.frequency[np.cumsum(self.spectrum.share) < 1 - outside]
        half_band = (occupied[-1] if len(occupied) else 0.5) / lines.range_step_m
        centre = cycles_per_m_at(lines, self.spectrum.centre)
        self.highest_cycles_per_m = float(abs(centre) + half_band)
        mean_square = self.spectrum.share @ self.spectrum.frequency**2
        self.rms_cycles_per_m = float(np.sqrt(mean_square)) / lines.range_step_m  # of the band
        self.track, self.limits = mean_track(lines), None if beam is None else beam.limits
        self.along, self.channels_along = None, None if beam is None else beam.directions(lines)
        if self.track is None:
            return
        self.surface, self.root = surface_of(grid), None
        self.points_m = self._pixels_m(_POINTS)
        self.track_m, _ = self.track.sampled_m
        self.spacing = _spacing(self.track.samples)
        sight = self.points_m[:, None] - self.track_m
        self.distance_m = np.maximum(np.linalg.norm(sight, axis=-1), 1e-9)
        self.sight = sight / self.distance_m[..., None]
        self.on_track = np.abs(self.track.samples - 0.5) <= 0.5
        # A pixel may come nearer between these.
        dense_m = self._pixels_m(np.linspace(0, 1, 65))
        steps_m = np.linalg.norm(self.surface.steps_m[:2], axis=1)
        between_m = steps_m @ (np.array(self.surface.plane.shape) - 1) / 128
        between_m += self.surface.relief_m(LEAST_SIDE).max() / 2
        nearest_m = KDTree(dense_m).query(lines.phase_centres_m)[0].min() - between_m
        self.nearest_m = max(float(nearest_m), 1e-9)
        if beam is not None:
            self.along = beam_directions(self.channels_along, self.track, self.track.samples)
            self.beam_rates = beam_rate(beam, self.track, self.along, self.points_m)

    def cached(self, key: Hashable, find: Callable[[], Any]) -> Any:
        """Return what is kept under a key; find it first if there is nothing."""
        if key not in self.kept:
            self.kept[key] = find()
        return self.kept[key]

    def _with(self, **changes: Any) -> View:
        """Return this view with other limits, or within roots of a size."""
        view = copy.copy(self)
        vars(view).update(changes)
        return view

    @property
    @kept
    def rates(self) -> NDArray[np.float64]:
        """Cycles per row, column and metre of relief, and per unit of the track's parameter.

        float64 [axes, points, samples]; within roots of the view's size if it has any.
        """
        if self.root is None:
            extents = np.zeros(len(self.surface.steps_m))
        else:
            extents = self.extents(self.root, most=True)
        return self._rates(extents, self.points_m)

    @property
    def frequencies(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Frequencies of the lines, cycles per m, and the share of their power that each holds.

        That is phase per metre of range, whatever its sign, and above 0.
        """
        found, power = self.spectrum.frequency, self.spectrum.share
        found = self.spectrum.centre + np.concatenate([-found[::-1], found])
        cycles_per_m = np.abs(cycles_per_m_at(self.lines, found))
        share = np.concatenate([power[::-1], power]) / 2
        return np.maximum(cycles_per_m, 1e-3 * self.highest_cycles_per_m), share

    def carriers(self, count: int) -> NDArray[np.float64]:
        """Return so many of these frequencies, each of which stands for the same power."""
        cycles_per_m, share = self.frequencies
        place = np.interp((np.arange(count) + 0.5) / count, np.cumsum(share), np.arange(len(share)))
        return np.interp(place, np.arange(len(share)), cycles_per_m)

    @property
    def sweeps_once(self) -> bool:
        """True where the beam sweeps once, at an even rate, over every sample point.

        Virtual channels cannot follow a beam that swings as fast as it sweeps. Seen from a point,
        the sine of the aspect angle changes along a straight track by (1 - sine^2)/distance. Rates
        between half and one and a half times the mean are followed.
        """
        if self.beam is None:
            return True
        # Neighbours on the track must look much the same way. At a kink the beam may swing past a
        # point within a few channels, and a track may lead back beside itself.
        along = self.channels_along[np.argsort(self.track.coordinate, kind="stable")]
        turned = np.linalg.norm(np.diff(along, axis=0), axis=1)
        if turned.max(initial=0.0) > _MOST_TURNED * np.ptp(np.clip(self.beam.limits, -1, 1)):
            return False
        on_track = self.on_track
        position = self.track_m[on_track]
        along_m = np.concatenate([[0], np.linalg.norm(np.diff(position, axis=0), axis=1).cumsum()])
        sine = np.einsum("psi,si->ps", self.sight[:, on_track], self.along[on_track])
        along_m += 1e-9 * np.arange(len(along_m))  # a track may stand still
        rate = -np.gradient(sine, along_m, axis=1)
        rate *= self.distance_m[:, on_track] / np.maximum(1 - sine**2, 1e-3)
        low, high = self.beam.limits
        for each in np.where((sine > low) & (sine < high), rate, np.nan):
            seen = each[np.isfinite(each)]
            if seen.size and np.ptp(seen) > abs(seen.mean()):
                return False
        return True

    def trimmed(self, share: float) -> View:
        """Return this view without the outermost edges of the beam.

        An image of noise loses `share` of its power.
        """
        if self.beam is None:
            return self
        low, high = np.clip(self.limits, -1, 1)
        on_track, bounds = self.on_track, []
        of_track = sines(self._everywhere_m, self.track_m[on_track], self.along[on_track])
        # Of channels and of the track: the track may have gaps, into which filters reach. Of points
        # everywhere: a pixel sees but a small part of the beam from a short aperture.
        for sine in (self._sines_of_channels, of_track):
            sine = sine[(sine > low) & (sine < high)]
            power = self.beam.weights(sine, wavelength_m(self.lines)) ** 2
            place = np.minimum((sine - low) * (_BINS / (high - low)), _BINS - 1).astype(np.int64)
            power = np.bincount(place, power, _BINS).cumsum()
            bounds.append(np.searchsorted(power, np.array([share / 2, 1 - share / 2]) * power[-1]))
        first, last = np.min(bounds, axis=0)[0], np.max(bounds, axis=0)[1]
        if not 0 < first <= last:
            return self
        edges = np.linspace(low, high, _BINS + 1)
        return self._with(limits=(float(edges[first]), float(edges[min(last + 1, _BINS)])))

    def coverage(self, power: int) -> NDArray[np.float64]:
        """Return sums over channels of a power of the beam's weights, over the largest, [points].

        At points all over the grid; 0 where nothing is seen from anywhere.
        """
        weights = self.beam.weights(self._sines_of_channels, wavelength_m(self.lines))
        sums = (weights**power).sum(axis=0)
        return sums / max(sums.max(), 1e-30)

    @property
    def share_partial(self) -> float:
        """Share of the image's points that see the track through an edge of the beam."""
        low, high = self.beam.limits
        seen = ((self._sines_of_channels > low) & (self._sines_of_channels < high)).mean(axis=0)
        return float(((seen > 0) & (seen < 1)).mean())

    @property
    @shared
    def ambiguity(self) -> Ambiguity:
        """Errors that the lines themselves leave open."""
        return ambiguity(self.lines, self.grid, self.spectrum, self.beam, self.channels_along)

    @property
    @shared
    def _everywhere_m(self) -> NDArray[np.float64]:
        return self._pixels_m(_EVERYWHERE)

    @property
    @shared
    def _sines_of_channels(self) -> NDArray[np.float64]:
        """Sines of the aspect angle of all over the grid, [channels, points]; of some channels."""
        some = some_channels(self.lines.channels, _CHANNELS)
        position_m, along = self.lines.phase_centres_m[some], self.channels_along[some]
        return sines(self._everywhere_m, position_m, along)

    @property
    @shared
    def off_track_m(self) -> NDArray[np.float64]:
        """Track errors: distances of channels from the mean track, [channels]."""
        aalong_m = self.lines.phase_centres_m - self.track.positions_m(self.track.coordinate)
        off_m = np.linalg.norm(aalong_m, axis=1)
        if self.own_drift is not None:
            off_m += np.linalg.norm(self.own_drift, axis=1) * np.median(self.distance_m)
        return off_m

    @property
    @shared
    def own_drift(self) -> NDArray[np.float64] | None:
        """See `clsas.factorized.aperture.own_drift`."""
        return own_drift(self.lines)

    @property
    @shared
    def densest(self) -> float:
        """Largest density of channels along the track, over the mean density."""
        place = np.sort(self.track.coordinate)
        some = min(_NEIGHBOURS, len(place) - 1)
        closest = float((place[some:] - place[:-some]).min())
        average = float(place[-1] - place[0]) * some / (len(place) - 1)
        return average / closest if closest > 0 else np.inf

    def _pixels_m(self, places: Sequence[float]) -> NDArray[np.float64]:
        """Return positions at some parts of the rows and columns, [n, 3]."""
        index = np.stack(np.meshgrid(places, places, indexing="ij"), axis=-1).reshape(-1, 2)
        index = index * (np.array(self.surface.plane.shape) - 1)
        plane_m = self.surface.plane.origin_m + index @ self.surface.steps_m[:2]
        # As far off the plane as the pixels around.
        around = (index // LEAST_SIDE * LEAST_SIDE).astype(np.int64)
        middle = around + (np.array(LEAST_SIDE) - 1) / 2
        off_m = self.surface.middles_m(LEAST_SIDE, around) - self.surface.plane.origin_m
        return plane_m + off_m - middle @ self.surface.steps_m[:2]

    def subimages(self, side: tuple[int, int]) -> int:
        """Return how many subimages of a size hold a pixel."""
        if self.surface.is_plane:
            shape = self.surface.plane.shape
            return math.prod(-(-n // s) for n, s in zip(shape, side, strict=True))
        return int((self.surface.counts(side) > 0).sum())

    def slots(self, side: tuple[int, int], width: int) -> float:
        """Return the mean number of pixels of a subimage, padded to whole work-items.

        On a plane these are all its pixels; elsewhere groups of blocks of `width` pixels.
        """
        if self.surface.is_plane:
            return float(math.prod(side))
        slots = self._filled_up(side, width)
        return float(slots.sum() / (slots > 0).sum())

    def most_slots(self, side: tuple[int, int], root: tuple[int, int], width: int) -> int:
        """Return the largest number of padded pixels of a root's leaves."""
        return int(within_roots(np.add, self._filled_up(side, width), side, root).max())

    def _filled_up(self, side: tuple[int, int], width: int) -> NDArray[np.int64]:
        size = STACK * width
        return -(-self.surface.counts(side) // size) * size

    @kept
    def seen(self, side: tuple[int, int]) -> NDArray[np.bool_]:
        """Return which samples of the track see any of a subimage, bool [points, samples]."""
        if self.limits is None:
            return np.broadcast_to(self.on_track, self.distance_m.shape)
        half = self.extents(side, most=True) / 2
        return self.on_track & (self._boxes.overlap(self.limits, half) > 0)

    @property
    @shared
    def _boxes(self) -> Visibility:
        """Boxes of cells at the sample points, as seen from the track."""
        origin_m = self.points_m[0]
        return Visibility.of(
            self.points_m - origin_m, self.surface.steps_m, self.track_m - origin_m, self.along
        )

    def share_seen(self, side: tuple[int, int], *, most: bool = False) -> float:
        """Return the share of the channels that see any of a subimage, its mean or its maximum."""
        count = np.count_nonzero(self.seen(side), axis=1)
        return _over_points(count / np.count_nonzero(self.on_track), most)

    def cycles(
        self, rates: NDArray[np.float64], seen: NDArray[np.bool_], *, most: bool = False
    ) -> float:
        """Return the cycles that a phase turns by while it is seen, their mean or their maximum."""
        return _over_points(np.where(seen, rates, 0.0) @ self.spacing, most)

    def turns(self, side: tuple[int, int], seen: NDArray[np.bool_], *, most: bool = False) -> float:
        """Return `cycles` of the phases of subimages of a size."""
        rates = np.tensordot(self.extents(side, most=most), self.rates, 1)
        return self.cycles(rates, seen, most=most)

    def extents(
        self, side: tuple[int, int], root: tuple[int, int] | None = None, *, most: bool = False
    ) -> NDArray[np.float64]:
        """Return the extents of subimages of a size, [axes].

        Their relief is the most in a root, of this view unless given, on average over the roots or
        at most.
        """
        if self.surface.is_plane:
            return self.surface.extents(side)
        relief_m = self.surface.relief_m(side, root or self.root)
        return self.surface.extents(side, float(relief_m.max() if most else relief_m.mean()))

    def channels(self, taps: int, density: float, turns: ArrayLike) -> ArrayLike:
        """Return the number of virtual channels of a subimage whose phase turns by some cycles.

        `taps` and `density`, virtual channels per cycle, are the aperture filter's. The filter
        reaches beyond the track's ends.
        """
        return density * turns + 1 + self.ends_seen * (taps / 2 - 0.5)

    @property
    @kept
    def ends_seen(self) -> float:
        """Mean number of the track's ends that see a sample point."""
        ends = np.flatnonzero(self.on_track)[[0, -1]]
        return float(self.seen((16, 16))[:, ends].sum(axis=1).mean())

    def within(self, root: tuple[int, int]) -> View:
        """Return this view with the rates of subimages in roots of a size."""
        return self._with(root=root)

    def cycles_in_root(
        self, root: tuple[int, int], sides: Sequence[tuple[int, int]]
    ) -> NDArray[np.float64]:
        """Return `cycles` per extent in a root, while subimages of some sizes are seen.

        Roughly; [sides, axes].
        """
        extents = self.extents(root, most=True) if any(root) else self.surface.extents(root)
        rates = self._rates(extents, self.points_m[_MIDDLE], _COARSER)
        while_seen = np.stack([self._while_seen(side) for side in sides])
        return while_seen @ rates.reshape(len(rates), -1).T / len(_MIDDLE)

    @kept
    def _while_seen(self, side: tuple[int, int]) -> NDArray[np.float64]:
        """Return the weights of the samples that see subimages in the middle, flat; 0 elsewhere."""
        seen = self.seen(side)[_MIDDLE, ::_COARSER]
        return (seen * _spacing(self.track.samples[::_COARSER])).ravel()

    def _rates(
        self, extents: NDArray[np.float64], centres_m: NDArray[np.float64], every: int = 1
    ) -> NDArray[np.float64]:
        return cycles_per_extent(
            self.track,
            self.surface,
            centres_m,
            extents,
            self.highest_cycles_per_m,
            self.nearest_m,
            self.limits,
            self.along,
            every,
        )

    @property
    @kept
    def slopes_m(self) -> NDArray[np.float64]:
        """Largest change of range per row, column and metre of relief, [axes]."""
        seen = self.seen((16, 16))
        slopes = np.abs(self.sight @ self.surface.steps_m.T)
        slopes = slopes[seen] if seen.any() else slopes.reshape(-1, slopes.shape[-1])
        return 1.02 * slopes.max(axis=0)

    def reach_m(self, side: tuple[int, int]) -> float:
        """Return the largest difference in range between a pixel and its subimage's centre."""
        radius_m = self.surface.radius_m(side)
        bend_m = radius_m**2 / (2 * max(self.nearest_m, radius_m))
        extents = self.surface.extents(side, self.surface.relief_m(side).max())
        return min(float(extents @ self.slopes_m) / 2 + bend_m, radius_m)

    def half_lengths(
        self,
        sides: Sequence[tuple[int, int]],
        align: Interpolator,
        final: Interpolator,
        resampling: Resampling,
    ) -> tuple[int, ...]:
        """Return the samples that the lines of each stage hold to either side of a centre."""
        samples_per_m = resampling.samples_per_m(self.lines)
        return tuple(
            math.ceil(self.reach_m(side) * samples_per_m)
            + (len(sides) - 1 - level) * (align.taps // 2 + 1)
            + final.taps // 2
            + 1
            for level, side in enumerate(sides)
        )


def _over_points(values: NDArray[np.float64], most: bool) -> float:
    """Return the largest of values at the sample points, or their mean over the grid."""
    return float(values.max() if most else values @ _SHARES)


def _spacing(samples: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weights of samples in an integral over them (trapezoidal rule)."""
    halves = np.diff(samples) / 2
    return np.concatenate([halves, [0.0]]) + np.concatenate([[0.0], halves])
