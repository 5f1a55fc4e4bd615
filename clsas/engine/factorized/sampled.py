"""The scene as planning sees it: sample points all over the grid, and samples of the mean track.

Errors and costs of candidates are evaluated on these samples: which part of the track a subimage is
visible from, how fast phases turn along it, and how far channels lie from it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from clsas.engine.data.geometry import SAME_PLACE_M, pairwise_range_m
from clsas.engine.data.lines import (
    SAMPLED_CHANNELS,
    antennas_of,
    band_wavelength_m,
    cycles_per_m_at,
    some_channels,
    steepest,
)
from clsas.engine.data.surface import LEAST_SIDE, Surface, within_roots
from clsas.engine.data.visibility import Visibility
from clsas.engine.exact.layout import item_pixels
from clsas.engine.factorized.phase_rates import (
    BeamDirections,
    PhaseBoxes,
    SheetRates,
    beam_rate,
    cycles_per_extent,
    directions_of,
    drift,
    own_drift,
    sheet_beam_rates,
    sheet_rates,
    stretches,
)
from clsas.engine.factorized.track import MeanTrack, Shape, mean_track_of, simplest_track
from clsas.engine.scene import Scene
from clsas.engine.signal.spectrum import OUTSIDE, Spectrum, shares_of_bins

Side = tuple[int, int]
"""Rows and columns of a subimage."""

SMALL = (16, 16)
"""Rows and columns of a subimage that represents a pixel."""

SAMPLED_PIXELS = 8
"""Pixels sampled of every subimage. Twice as many move predicted errors by 0.05 dB at most."""

_FRACTIONS = (0.02, 0.25, 0.5, 0.75, 0.98)  # of the rows and columns
_WEIGHTS = np.array([0.135, 0.24, 0.25, 0.24, 0.135])  # of these fractions in means over the grid
_POINT_WEIGHTS = np.outer(_WEIGHTS, _WEIGHTS).ravel() / _WEIGHTS.sum() ** 2

INNER_POINTS = np.arange(len(_FRACTIONS) ** 2).reshape(len(_FRACTIONS), -1)[1:-1, 1:-1].ravel()
"""Indices of the sample points that do not lie at the grid's edges."""
SPREAD_POINTS = (0, 7, 14, 16, 23)
"""Of the 5 by 5 sample points, one in every row and column."""

_DENSE = 65  # points along either side, for the least distance; half moves errors by 0.05 dB
_NEAREST_CHANNELS = 4096  # of a dense aperture, for the least distance
_MOST_OUTSIDE = 1e-6  # share of power above the highest frequency; half or twice: no change
_LEAST_FREQUENCY = 1e-3  # of the highest; below, phases are constant to virtual channels
_NEIGHBOURS = 64  # channels over which density is measured; half or twice: no change
_WORST_CHANNELS = 32  # of the sampled channels: the loudest, or farthest from the mean track
_LEAST_BINS = 1 / 32  # of the lines' spectrum; a plain choice: smaller shifts widen no band
_MOST_CYCLES = 8.0  # per sample; far outside the pass band of any filter
_STRETCHES = -0.5, 1.0  # bounds of the mean stretch


@dataclass(frozen=True, eq=False)
class SampledScene:
    """A scene at 25 points of its grid and at samples of its mean track.

    Attributes
    ----------
    scene : Scene
    shape : str
        Shape of the mean track: see `clsas.engine.factorized.track`.
    track : MeanTrack
    channel_power : float64 [channels]
        Energy of each line over the mean of all.
    highest_cycles_per_m, rms_cycles_per_m : float
        Phase per metre of range, cycles: at the band's edge, and rms about the band's centre.
    points_m : float64 [points, 3]
        Sample points all over the grid, also near its corners.
    distances_m : float64 [parts]
        Lower bounds of the distance between channels and pixels, ascending. Each is that of an
        equally large part of the pixels.
    """

    scene: Scene
    shape: Shape
    track: MeanTrack
    channel_power: NDArray[np.float64]
    highest_cycles_per_m: float
    rms_cycles_per_m: float
    points_m: NDArray[np.float64]
    distances_m: NDArray[np.float64]
    _reliefs: dict[tuple[Side, Side], NDArray[np.float64]] = field(default_factory=dict)

    @classmethod
    def of(cls, scene: Scene, allowed_power: float = 1.0) -> SampledScene | None:
        """Return the scene with the simplest mean track; None if all channels lie at one place.

        `allowed_power` is the relative error power of the tolerance. Of the lines' power, a share
        that is small beside it may lie above `highest_cycles_per_m`.
        """
        lines, spectrum, energy = scene.lines, scene.spectrum, scene.line_energy
        shape, track = simplest_track(lines, band_wavelength_m(lines, spectrum.centre))
        if track is None:
            return None
        outside = min(OUTSIDE * allowed_power, _MOST_OUTSIDE)
        occupied = spectrum.frequency[np.cumsum(spectrum.share) < 1 - outside]
        half_band = (occupied[-1] if len(occupied) else 0.5) / lines.range_step_m
        centre = cycles_per_m_at(lines, spectrum.centre)
        mean_square = spectrum.share @ spectrum.frequency**2
        power = energy / max(float(energy.mean()), 1e-300) if energy.any() else 1 + energy
        return cls(
            scene,
            shape,
            track,
            channel_power=power,
            highest_cycles_per_m=float(abs(centre) + half_band),
            rms_cycles_per_m=float(np.sqrt(mean_square)) / lines.range_step_m,
            points_m=points_at_m(scene.surface, _FRACTIONS),
            distances_m=_distances_m(scene, track),
        )

    def with_shape(self, shape: Shape) -> SampledScene | None:
        """Return the same with a mean track of another shape; None if channels have none."""
        lines = self.scene.lines
        wavelength_m = band_wavelength_m(lines, self.scene.spectrum.centre)
        track = mean_track_of(lines, shape, wavelength_m)
        return None if track is None else replace(self, shape=shape, track=track)

    # Geometry between the track and the points

    @property
    def nearest_m(self) -> float:
        """Lower bound of the distance between any pixel and any channel."""
        return float(self.distances_m[0])

    @cached_property
    def spacing(self) -> NDArray[np.float64]:
        """Weight of each sample of the track in integrals over the aperture coordinate."""
        return trapezoidal_weights(self.track.samples)

    @cached_property
    def distance_m(self) -> NDArray[np.float64]:
        """Distance from every track sample to every point, [points, samples]."""
        away_m = self.points_m[:, None] - self.track.sampled_m[0]
        return np.maximum(np.linalg.norm(away_m, axis=-1), SAME_PLACE_M)

    @cached_property
    def sight(self) -> NDArray[np.float64]:
        """Unit vector from every track sample to every point, [points, samples, 3]."""
        return (self.points_m[:, None] - self.track.sampled_m[0]) / self.distance_m[..., None]

    @cached_property
    def directions(self) -> BeamDirections | None:
        """Unit directions of the beam anywhere on the track; None without a beam."""
        beam, along = self.scene.beam, self.scene.along
        return None if beam is None or along is None else directions_of(beam, along, self.track)

    @cached_property
    def along(self) -> NDArray[np.float64] | None:
        """Unit directions of the beam at the samples, [samples, 3]; None without a beam."""
        return None if self.directions is None else self.directions.at(self.track.samples)

    @cached_property
    def boxes(self) -> Visibility:
        """Boxes of cells at the sample points, seen from the track; only with a beam."""
        assert self.along is not None
        origin_m, track_m = self.points_m[0], self.track.sampled_m[0]
        return Visibility.of(
            self.points_m - origin_m, self.scene.surface.steps_m, track_m - origin_m, self.along
        )

    # Subimages of every size

    def count(self, side: Side) -> int:
        """Return the number of subimages of a size that contain a pixel."""
        surface = self.scene.surface
        if surface.is_plane:
            return math.prod(-(-n // s) for n, s in zip(surface.plane.shape, side, strict=True))
        return int((surface.counts(side) > 0).sum())

    def padded_pixels(self, side: Side, width: int) -> float:
        """Return the mean pixel count of a subimage after padding to whole work-items.

        On a plane, a subimage is whole work-items already; elsewhere its pixels form groups of
        blocks of `width` pixels.
        """
        if self.scene.surface.is_plane:
            return float(math.prod(side))
        padded = self._padded(side, width)
        return float(padded.sum() / (padded > 0).sum())

    def most_padded_pixels(self, side: Side, root: Side, width: int) -> int:
        """Return the largest padded pixel count of any root, summed over its leaves."""
        return int(within_roots(np.add, self._padded(side, width), side, root).max())

    def _padded(self, side: Side, width: int) -> NDArray[np.int64]:
        size = item_pixels(width)
        return -(-self.scene.surface.counts(side) // size) * size

    def extents(self, side: Side, root: Side, *, most: bool = False) -> NDArray[np.float64]:
        """Return the extents of subimages of a size, [axes]; see `Surface`.

        Their relief is the largest one within a root: the mean over all roots, or the maximum.
        """
        surface = self.scene.surface
        if surface.is_plane:
            return surface.extents(side)
        relief_m = self._relief_m(side, root)
        return surface.extents(
            side, float(relief_m.max() if most else relief_m.sum() / relief_m.size)
        )

    def _relief_m(self, side: Side, root: Side) -> NDArray[np.float64]:
        """Return the largest relief of subimages of a size in every root, [down, across]."""
        if (side, root) not in self._reliefs:
            # That of roots half as large, which is known in most cases, leaves two values each.
            axis = 0 if root[0] // side[0] > root[1] // side[1] else 1
            half = (root[0] // 2, root[1]) if axis == 0 else (root[0], root[1] // 2)
            if root == side:
                found = self.scene.surface.relief_m(side)
            elif root[axis] % 2 or half[axis] % side[axis]:
                found = self.scene.surface.relief_m(side, root)
            else:
                of_half = self._relief_m(side, half)
                starts = np.arange(0, of_half.shape[axis], 2)
                found = np.maximum.reduceat(of_half, starts, axis=axis)
            self._reliefs[side, root] = found
        return self._reliefs[side, root]

    # The lines

    def frequencies(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the phase per metre of range at the lines' frequencies, cycles, and power shares.

        The phase is positive, whatever its sign in the lines.
        """
        spectrum = self.scene.spectrum
        found, power = spectrum.frequency, spectrum.share
        found = spectrum.centre + np.concatenate([-found[::-1], found])
        cycles_per_m = np.abs(cycles_per_m_at(self.scene.lines, found))
        share = np.concatenate([power[::-1], power]) / 2
        return np.maximum(cycles_per_m, _LEAST_FREQUENCY * self.highest_cycles_per_m), share

    @cached_property
    def carriers(self) -> NDArray[np.float64]:
        """As many of these frequencies as pixels are sampled; all represent the same power."""
        cycles_per_m, share = self.frequencies()
        middles = (np.arange(SAMPLED_PIXELS) + 0.5) / SAMPLED_PIXELS
        index = np.interp(middles, np.cumsum(share), np.arange(len(share)))
        return np.interp(index, np.arange(len(share)), cycles_per_m)

    @cached_property
    def own_drift(self) -> NDArray[np.float64] | None:
        """`clsas.engine.factorized.phase_rates.own_drift` of the lines."""
        return own_drift(self.scene.lines)

    @cached_property
    def track_error_m(self) -> NDArray[np.float64]:
        """Distances of the channels from the mean track, [channels].

        Receiver motion that differs from the mean is added, with its effect at the median range.
        """
        error_m = np.linalg.norm(self.track.offsets_m(self.scene.lines.phase_centres_m), axis=1)
        if self.own_drift is not None:
            error_m += np.linalg.norm(self.own_drift, axis=1) * np.median(self.distance_m)
        return error_m

    @cached_property
    def peak_density(self) -> float:
        """Peak channel density along the aperture, relative to the mean.

        Many channels of a sheet may have the same coordinate along it, one in each of its rows.
        """
        at = np.sort(self.track.coordinate)
        rows = math.ceil(2 * math.sqrt(len(at))) if self.track.is_sheet else 1
        some = min(max(_NEIGHBOURS, rows), len(at) - 1)
        closest = float((at[some:] - at[:-some]).min())
        length = self.track.strips if self.track.strips > 1 else float(at[-1] - at[0])
        average = length * some / (len(at) - 1)
        return average / closest if closest > 0 else np.inf

    def range_window_m(self, root: Side) -> tuple[float, float]:
        """Return the least and the largest range of any pixel of roots, from lines' first samples.

        Ranges to a pixel and to the middle of the grid differ at most by their distance, or by
        slightly more for moving receivers: see `clsas.engine.data.lines.steepest`.
        """
        surface, lines = self.scene.surface, self.scene.lines
        plane = surface.plane
        whole = -(-plane.shape[0] // root[0]) * root[0], -(-plane.shape[1] // root[1]) * root[1]
        origin_m: Any = plane.origin_m
        middle_m = (origin_m + (np.array(whole) - 1) / 2 @ surface.steps_m[:2])[None]
        relief_m = 0.0 if surface.is_plane else 2 * float(np.abs(surface.off_m).max())
        extents = surface.extents(whole, relief_m)
        radius_m = float(np.linalg.norm(np.abs(extents[:, None] * surface.steps_m).sum(axis=0)))
        radius_m *= steepest(lines) / 2
        range_m = (
            pairwise_range_m(
                middle_m, lines.tx_m, lines.rx_m, lines.rx_velocity_m_s, lines.sound_speed_m_s
            )[0]
            - lines.first_range_m
        )
        return float(range_m.min()) - radius_m, float(range_m.max()) + radius_m


@dataclass(frozen=True, eq=False)
class Stretch:
    """Stretch of an image's lines, and the shifts of their band.

    Where transmitter and receiver lie apart, or receivers move, the range of a channel grows along
    the line of sight by a slightly different factor than the range from the mean track. The mean of
    this factor is a constant of the image. The first stage corrects deviations from it by turning
    the phase along each line. This shifts the band of the line, so that later range filters must
    pass a wider band.

    Attributes
    ----------
    mean : float
        Mean over channels and sample points, weighted by power; 0 for channels on the mean track.
    shares : float64 [2 n + 1] or None
        Share of the power that is shifted by -n, ..., n bins of the lines' spectrum; None where
        shifts are negligible.
    """

    mean: float = 0.0
    shares: NDArray[np.float64] | None = None

    def spectrum(self, given: Spectrum) -> Spectrum:
        """Return the spectrum of the lines after the first stage has turned their phases."""
        return given if self.shares is None else given.shifted(self.shares)


@dataclass(frozen=True, eq=False)
class SampledRoots:
    """What a beam touches of a sampled scene, and how fast phases turn, in roots of a size.

    Attributes
    ----------
    sampled : SampledScene
    limits : (low, high) or None
        Sines of the aspect angle between which channels are used for a subimage; None without a
        beam.
    side : (rows, columns) or None
        Size of the roots in which reliefs and phase rates are the largest; None for the subimages
        and the sample points alone.
    stretch : Stretch
        Stretch of the lines; only if `of` has found it.
    """

    sampled: SampledScene
    limits: tuple[float, float] | None
    side: Side | None = None
    stretch: Stretch = field(default_factory=Stretch)
    _visible: dict[Side, NDArray[np.bool_]] = field(default_factory=dict, init=False)

    @classmethod
    def of(cls, sampled: SampledScene, limits: tuple[float, float] | None) -> SampledRoots:
        """Return the sample points alone, with the stretch of the lines."""
        roots = cls(sampled, limits)
        return replace(roots, stretch=stretch_of(roots))

    def within(self, side: Side) -> SampledRoots:
        """Return the same in roots of a size."""
        return replace(self, side=side)

    @property
    def small(self) -> Side:
        """Rows and columns of subimages that represent a pixel; they divide the roots."""
        rows, columns = self.side or SMALL
        return math.gcd(rows, SMALL[0]), math.gcd(columns, SMALL[1])

    def extents(self, side: Side, *, most: bool = False) -> NDArray[np.float64]:
        """Return the extents of subimages of a size in roots: see `SampledScene.extents`.

        Without a size of roots, every subimage is a root.
        """
        return self.sampled.extents(side, self.side or side, most=most)

    # Visibility

    def visible(self, side: Side) -> NDArray[np.bool_]:
        """Return which track samples touch a subimage with their beam, bool [points, samples]."""
        if side not in self._visible:
            self._visible[side] = self.visible_by_size((side,))[0]
        return self._visible[side]

    def visible_by_size(self, sides: Sequence[Side]) -> NDArray[np.bool_]:
        """Return `visible` of subimages of some sizes, bool [sizes, points, samples]."""
        sampled, on_track = self.sampled, self.sampled.track.on_track
        shape = len(sides), *sampled.distance_m.shape
        if self.limits is None or sampled.track.is_dense:  # whose virtual channels are all formed
            return np.broadcast_to(on_track, shape)
        half = np.stack([self.extents(side, most=True) for side in sides]) / 2
        boxes, (low, high) = sampled.boxes, self.limits
        radius_m = np.linalg.norm(half @ np.abs(boxes.axes_m), axis=1)
        # Depth of the boxes in the beam, as of `Visibility.overlap`, for all sizes at once.
        factors = np.column_stack([half, radius_m**2])
        slopes = np.stack([*boxes.slopes, boxes.inverse_m**2]).reshape(factors.shape[1], -1)
        outside = np.abs(boxes.sine - (low + high) / 2) - (high - low) / 2
        return on_track & ((factors @ slopes).reshape(shape) > outside)

    def visible_share(self, side: Side, *, most: bool = False) -> float:
        """Fraction of channels whose beam touches a subimage: mean over the points, or maximum."""
        count = np.count_nonzero(self.visible(side), axis=1)
        return over_points(count / np.count_nonzero(self.sampled.track.on_track), most)

    @cached_property
    def visible_track_ends(self) -> float:
        """Mean number of the track's ends whose beam touches a sample point."""
        track = self.sampled.track
        if track.is_dense:
            return 2.0 * track.strips
        ends = np.flatnonzero(track.on_track)[[0, -1]]
        return float(self.visible(self.small)[:, ends].sum(axis=1).mean())

    # Phases along the aperture and across a sheet

    @cached_property
    def rates(self) -> NDArray[np.float64]:
        """Phase rates along the track, the largest in roots, float64 [axes, points, samples].

        They are in cycles per row, column and metre of relief of a subimage, and per unit aperture
        coordinate.
        """
        if self.sampled.track.is_sheet:
            return self._of_sheet.along
        return self._rates_along(self.root_extents, self.sampled.points_m)

    @cached_property
    def rates_across(self) -> NDArray[np.float64]:
        """The same per unit coordinate across a sheet, at the samples of a line across it."""
        return self._of_sheet.across

    @cached_property
    def beam_rates(self) -> NDArray[np.float64]:
        """Change of the beam's weights along the track as a phase rate, [points, samples].

        It is the largest in roots, and 0 without a beam: see `beam_rate`.
        """
        sampled, beam = self.sampled, self.sampled.scene.beam
        if beam is None or sampled.along is None:
            return np.zeros(sampled.distance_m.shape)
        if sampled.track.is_sheet:
            return self._of_beam_on_sheet.along
        return beam_rate(beam, sampled.track, sampled.along, sampled.points_m, self._sides_m)

    @cached_property
    def beam_rates_across(self) -> NDArray[np.float64]:
        """The same across a sheet, at the samples of a line across it."""
        sampled = self.sampled
        if sampled.scene.beam is None:
            return np.zeros((len(sampled.points_m), len(sampled.track.line_across(0.5).samples)))
        return self._of_beam_on_sheet.across

    @property
    def root_extents(self) -> NDArray[np.float64]:
        """Extents of the roots; 0 rows and columns at the sample points alone."""
        if self.side is None:
            return self.sampled.scene.surface.extents((0, 0))
        return self.extents(self.side, most=True)

    @property
    def _sides_m(self) -> NDArray[np.float64]:
        return self.root_extents[:, None] * self.sampled.scene.surface.steps_m

    def _boxes(self, extents: NDArray[np.float64], centres_m: NDArray[np.float64]) -> PhaseBoxes:
        s = self.sampled
        return PhaseBoxes(
            s.scene.surface.steps_m, centres_m, extents, s.highest_cycles_per_m, s.nearest_m
        )

    def _rates_along(
        self, extents: NDArray[np.float64], centres_m: NDArray[np.float64], every: int = 1
    ) -> NDArray[np.float64]:
        boxes, sampled = self._boxes(extents, centres_m), self.sampled
        return cycles_per_extent(sampled.track, boxes, self.limits, sampled.along, every)

    @cached_property
    def _of_sheet(self) -> SheetRates:
        boxes = self._boxes(self.root_extents, self.sampled.points_m)
        return sheet_rates(self.sampled.track, boxes)

    @cached_property
    def _of_beam_on_sheet(self) -> SheetRates:
        sampled, beam = self.sampled, self.sampled.scene.beam
        assert beam is not None
        assert sampled.directions is not None
        return sheet_beam_rates(
            beam, sampled.track, sampled.directions, sampled.points_m, self._sides_m
        )

    def coarse_rates(self, every: int) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Return `rates` and `rates_across` at the inner points and some samples, for the search.

        The second result is None without a sheet.
        """
        centres_m = self.sampled.points_m[INNER_POINTS]
        if not self.sampled.track.is_sheet:
            return self._rates_along(self.root_extents, centres_m, every), None
        rates = sheet_rates(self.sampled.track, self._boxes(self.root_extents, centres_m), every)
        return rates.along, rates.across

    def subimage_cycles(
        self, side: Side, visible: NDArray[np.bool_], *, most: bool = False
    ) -> float:
        """Return the cycles of the fastest phase in subimages of a size: mean, or maximum.

        The phase is accumulated along the visible part of the aperture, bool [points, samples].
        """
        extents = self.extents(side, most=most)
        return self._accumulated(np.tensordot(extents, self.rates, 1), visible, most)

    def beam_cycles(self, visible: NDArray[np.bool_], *, most: bool = False) -> float:
        """Return the cycles that the beam's weights add along the visible aperture."""
        return self._accumulated(self.beam_rates, visible, most)

    def _accumulated(
        self, rates: NDArray[np.float64], visible: NDArray[np.bool_], most: bool
    ) -> float:
        return over_points(np.where(visible, rates, 0.0) @ self.sampled.spacing, most)

    def beam_cycles_across(self, *, most: bool = False) -> float:
        """Return the cycles that the beam's weights add across a sheet; 0 without a sheet."""
        if not self.sampled.track.is_sheet:
            return 0.0
        return self._accumulated_across(self.beam_rates_across, most)

    def rows(
        self,
        side: Side,
        taps: float,
        density: float,
        beam_density: float = 0.0,
        *,
        most: bool = False,
    ) -> float:
        """Return the number of rows of virtual channels across a sheet.

        `density` and `beam_density` are the rows per cycle of the phase, and per cycle of the
        beam's weights. `taps` are those of the filter, which extends past the edges.
        """
        extents = self.extents(side, most=most)
        rates = density * np.tensordot(extents, self.rates_across, 1)
        cycles = self._accumulated_across(rates, most)
        if beam_density:
            cycles += beam_density * self.beam_cycles_across(most=most)
        return cycles + taps

    def _accumulated_across(self, rates: NDArray[np.float64], most: bool) -> float:
        line = self.sampled.track.line_across(0.5)
        weights = np.where(line.on_track, trapezoidal_weights(line.samples), 0.0)
        return over_points(rates @ weights, most)

    def virtual_channels(self, taps: Any, density: float, cycles: Any) -> Any:
        """Return the number of virtual channels of a subimage, from its phase in cycles.

        `taps` and `density`, in virtual channels per cycle, are those of the filter along the
        aperture, which extends past the track's ends. All arguments may be arrays.
        """
        ends = self.visible_track_ends
        return density * cycles + self.sampled.track.strips + ends * (taps / 2 - 0.5)


@dataclass(frozen=True, eq=False)
class SampledChannels:
    """Sampled channels whose beam touches subimages of a size at some of the sample points.

    Attributes
    ----------
    sampled : SampledScene
    points : int64 [points]
        Sample points whose subimage the beam of any channel touches.
    index : int64 [n]
        Indices of the channels.
    weight : float64 [points, n]
        Power of all channels that each one represents; 0 where its beam misses the subimage.
    part : MeanTrack
        The mean track with these channels.
    """

    sampled: SampledScene
    points: NDArray[np.int64]
    index: NDArray[np.int64]
    weight: NDArray[np.float64]
    part: MeanTrack

    @property
    def phase_centres_m(self) -> NDArray[np.float64]:
        """Middles between transmitters and receivers, [n, 3]."""
        return self.sampled.scene.lines.phase_centres_m[self.index]

    @property
    def antennas(self) -> tuple[Any, Any, Any, float]:
        """Positions of transmitters and receivers, velocities of receivers, and sound speed."""
        return antennas_of(self.sampled.scene.lines, self.index)

    def virtual_m(self, centres_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the positions on the track at which points see the channels, [points, n, 3]."""
        drifts = self.sampled.own_drift
        own = drifts if drifts is None else drifts[self.index]
        coordinates = self.part.apparent_coordinates(centres_m, self.phase_centres_m, own)
        return self.sampled.track.positions_m(*coordinates)


def sampled_channels(roots: SampledRoots, side: Side) -> SampledChannels:
    """Return sampled channels whose beam touches subimages of a size at the `SPREAD_POINTS`.

    The loudest and those farthest from the mean track are always among them: a single loud channel,
    or a few where the track turns sharply, may cause a larger error than all others together.
    """
    sampled, track = roots.sampled, roots.sampled.track
    points, power = np.array(SPREAD_POINTS), sampled.channel_power
    visible = roots.visible(side)[points]
    index = np.flatnonzero(np.interp(track.coordinate, track.samples, visible.any(axis=0)))
    weight = power[index]
    if len(index) > SAMPLED_CHANNELS:
        error = sampled.track_error_m[index] ** 2 * weight
        is_worst = np.zeros(len(index), bool)
        is_worst[np.argpartition(error, -_WORST_CHANNELS)[-_WORST_CHANNELS:]] = True
        others, worst = index[~is_worst], index[is_worst]
        some = others[some_channels(len(others), SAMPLED_CHANNELS - _WORST_CHANNELS)]
        scale = power[others].sum() / max(power[some].sum(), 1e-300)
        index = np.concatenate([some, worst])
        weight = np.concatenate([scale * power[some], power[worst]])
    part = track.some(index)
    sees = np.stack([np.interp(part.coordinate, track.samples, each) for each in visible]) > 0
    touched = sees.any(axis=1)
    return SampledChannels(sampled, points[touched], index, weight * sees[touched], part)


def stretch_of(roots: SampledRoots) -> Stretch:
    """Return the stretch of lines as seen from the sample points, which is that of all roots."""
    scene = roots.sampled.scene
    channels = sampled_channels(roots, SMALL)
    power = float(channels.weight.sum())
    if not power:  # no channel's beam touches the grid, or these channels are silent
        return Stretch()
    centres_m = roots.sampled.points_m[channels.points]
    found = stretches(
        *channels.antennas,
        drift(scene.lines),
        scene.surface.plane,
        centres_m,
        channels.virtual_m(centres_m),
    )
    share = channels.weight / power
    mean = float(np.clip(np.sum(share * found), *_STRETCHES))
    cycles = cycles_per_m_at(scene.lines, scene.spectrum.centre) * scene.lines.range_step_m
    shift = np.clip((found - mean) * cycles, -_MOST_CYCLES, _MOST_CYCLES)
    bins = shift / scene.spectrum.bin_width
    if np.abs(bins).max() < _LEAST_BINS:
        return Stretch(mean)
    return Stretch(mean, shares_of_bins(bins, share))


def points_at_m(
    surface: Surface, fractions: Sequence[float] | NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return positions at some fractions of the rows and columns, [n, 3]."""
    index = np.stack(np.meshgrid(fractions, fractions, indexing="ij"), axis=-1).reshape(-1, 2)
    index = index * (np.array(surface.plane.shape) - 1)
    origin_m: Any = surface.plane.origin_m
    plane_m = origin_m + index @ surface.steps_m[:2]
    if surface.is_plane:
        return plane_m
    # Points lie as far off the plane as the pixels around them.
    around = (index // LEAST_SIDE * LEAST_SIDE).astype(np.int64)
    middle = around + (np.array(LEAST_SIDE) - 1) / 2
    off_m = surface.middles_m(LEAST_SIDE, around) - origin_m
    return plane_m + off_m - middle @ surface.steps_m[:2]


def _distances_m(scene: Scene, track: MeanTrack) -> NDArray[np.float64]:
    """Return `SampledScene.distances_m`, with as many parts as there are dense points a side."""
    lines, surface = scene.lines, scene.surface
    dense_m = points_at_m(surface, np.linspace(0, 1, _DENSE))
    # Pixels between the dense points may be closer, by half a step at most.
    steps_m = np.linalg.norm(surface.steps_m[:2], axis=1)
    step_m = steps_m @ (np.array(surface.plane.shape) - 1) / (_DENSE - 1)
    between_m = (step_m + surface.relief_m(LEAST_SIDE).max()) / 2
    centres_m = lines.phase_centres_m
    if track.is_dense:
        centres_m = centres_m[some_channels(len(centres_m), _NEAREST_CHANNELS)]
    distances_m = np.sort(KDTree(centres_m).query(dense_m)[0])[::_DENSE] - between_m
    return np.maximum(distances_m, SAME_PLACE_M)


def mean_over_points(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return means over the grid of values at the sample points, [..., points]."""
    return values @ _POINT_WEIGHTS


def over_points(values: NDArray[np.float64], most: bool) -> float:
    """Return the largest of values at the sample points, or their mean over the grid."""
    return float(values.max() if most else mean_over_points(values))


def trapezoidal_weights(samples: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weights of samples in an integral over them (trapezoidal rule)."""
    halves = np.diff(samples) / 2
    return np.concatenate([halves, [0.0]]) + np.concatenate([[0.0], halves])


def pixels_m(
    surface: Surface, extents: NDArray[np.float64], point: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the centre of a subimage and sampled pixels, relative to the centre, [n + 1, 3].

    The second array, [n], contains a further number from 0 to 1 for each pixel, for example to
    choose its frequency. All numbers come from a Kronecker sequence (multiples of powers of an
    irrational number), which fills the subimage evenly. Every sample point has an interval of it.
    """
    dimensions = len(extents) + 1
    ratio = 1.0
    for _ in range(20):  # towards x^(dimensions + 1) = x + 1
        ratio = (1 + ratio) ** (1 / (dimensions + 1))
    index = point * SAMPLED_PIXELS + np.arange(SAMPLED_PIXELS)[:, None]
    numbers = (0.5 + index * ratio ** -np.arange(1.0, dimensions + 1)) % 1
    offsets_m = ((numbers[:, :-1] - 0.5) * extents) @ surface.steps_m
    return np.concatenate([np.zeros((1, 3)), offsets_m]), numbers[:, -1]


def reliefs_of(
    surface: Surface, side: Side, root: Side | None
) -> tuple[list[tuple[float, ...]], float]:
    """Return the extents of subimages without relief and, if there is some, of the largest relief.

    The second result is the share of the largest relief for `mean_over_relief`.
    """
    relief_m = surface.relief_m(side, root)
    largest_m = float(relief_m.max())
    if largest_m <= 0:
        return [tuple(surface.extents(side))], 0.0
    share = np.average((relief_m / largest_m) ** 2, weights=surface.counts(root or side))
    return [tuple(surface.extents(side)), tuple(surface.extents(side, largest_m))], float(share)


def mean_over_relief(errors: NDArray[np.float64], share: float) -> float:
    """Return the mean over the grid of errors in `reliefs_of`.

    Errors grow at least with the square of the relief, so that subimages of less relief are
    interpolated by the square.
    """
    return float(errors[0] + max(errors[-1] - errors[0], 0.0) * share)
