"""Sampled geometry between track and grid, on which costs and errors are evaluated."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from clsas.aperture.beam_directions import BeamDirections, directions_of
from clsas.aperture.dense_tracks import Shape, mean_track_of, simplest_track
from clsas.aperture.mean_track import MeanTrack
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines, some_channels
from clsas.core.surface import LEAST_SIDE, Surface
from clsas.core.wavelengths import band_wavelength_m, cycles_per_m_at
from clsas.planning.caching import cached, shared
from clsas.planning.sample_points import (
    over_points,
    points_at_m,
    sample_points_m,
    trapezoidal_weights,
)
from clsas.planning.subimages import SMALL, Side, Subimages
from clsas.scene import Scene
from clsas.signal.spectrum import Spectrum
from clsas.sonar.beam import BeamWindow
from clsas.sonar.visibility import Visibility

_DENSE = 65  # points along either side, for the least distance; half moves errors by 0.05 dB
_NEAREST_CHANNELS = 4096  # of a dense aperture, for the least distance
_MOST_OUTSIDE = 1e-6  # share of power above the highest frequency; half or twice: no change


_Value = TypeVar("_Value")


@dataclass(frozen=True, eq=False)
class VisibilityModel:
    """Geometry between mean track and grid, sampled at 25 grid points: what a beam touches.

    Errors and costs of candidates are evaluated on these samples. There is such a model only if
    channels lie at more than one place.

    Attributes
    ----------
    scene : Scene
    channel_power : float64 [channels]
        Energy of each line over the mean of all.
    highest_cycles_per_m, rms_cycles_per_m : float
        Phase per metre of range, cycles: at the band's edge, and rms about the band's centre.
    limits : (low, high) or None
        Sines of the aspect angle between which channels are used for a subimage; None without a
        beam.
    shape : str
        Shape of the mean track: see `clsas.aperture.dense_tracks`.
    track : MeanTrack
    subimages : Subimages
        Subimages of every size, on the grid's surface.
    points_m : float64 [points, 3]
        Sample points all over the grid, also near its corners.
    distances_m : float64 [parts]
        Lower bounds of the distance between channels and pixels, ascending. Each is that of an
        equally large part of the pixels.
    root : (rows, columns) or None
        Size of the roots in which reliefs and phase rates are the largest; None for the subimages
        and the sample points alone.
    """

    scene: Scene
    channel_power: NDArray[np.float64]
    highest_cycles_per_m: float
    rms_cycles_per_m: float
    limits: tuple[float, float] | None
    shape: Shape
    track: MeanTrack
    subimages: Subimages
    points_m: NDArray[np.float64]
    distances_m: NDArray[np.float64]
    root: Side | None = None
    _cache: dict[Hashable, Any] = field(default_factory=dict)

    @property
    def lines(self) -> RangeLines:
        """Lines that are imaged."""
        return self.scene.lines

    @property
    def grid(self) -> Grid:
        """Pixels of the image."""
        return self.scene.grid

    @property
    def beam(self) -> BeamWindow | None:
        """Weights of the channels."""
        return self.scene.beam

    @property
    def spectrum(self) -> Spectrum:
        """Spectrum of the lines."""
        return self.scene.spectrum

    def from_cache(self, key: Hashable, find: Callable[[], _Value]) -> _Value:
        """Return the value cached under a key; `find` computes it the first time."""
        if key not in self._cache:
            self._cache[key] = find()
        value: _Value = self._cache[key]
        return value

    def with_shape(self, shape: Shape) -> VisibilityModel | None:
        """Return this model with a mean track of another shape; None if channels have none."""
        wavelength_m = band_wavelength_m(self.lines, self.spectrum.centre)
        track = mean_track_of(self.lines, shape, wavelength_m)
        if track is None:
            return None
        return replace(self, shape=shape, track=track, _cache={})

    def with_limits(self, low: float, high: float) -> VisibilityModel:
        """Return this model with a narrower beam: sines of the aspect angle where it ends."""
        return replace(self, limits=(low, high))

    def within(self, root: Side) -> VisibilityModel:
        """Return this model with the largest phase rates in roots of a size."""
        return replace(self, root=root)

    @property
    def surface(self) -> Surface:
        """Positions of the grid's pixels."""
        return self.scene.surface

    @property
    def nearest_m(self) -> float:
        """Lower bound of the distance between any pixel and any channel."""
        return float(self.distances_m[0])

    @property
    @shared
    def track_m(self) -> NDArray[np.float64]:
        """Positions at `track.samples`, [samples, 3]."""
        return self.track.sampled_m[0]

    @property
    @shared
    def on_track(self) -> NDArray[np.bool_]:
        """False for samples past the track's ends."""
        return self.track.on_track

    @property
    @shared
    def spacing(self) -> NDArray[np.float64]:
        """Weight of each sample in integrals over the aperture coordinate."""
        return trapezoidal_weights(self.track.samples)

    @property
    @shared
    def distance_m(self) -> NDArray[np.float64]:
        """Distance from every track sample to every point, [points, samples]."""
        return np.maximum(np.linalg.norm(self.points_m[:, None] - self.track_m, axis=-1), 1e-9)

    @property
    @shared
    def sight(self) -> NDArray[np.float64]:
        """Unit vector from every track sample to every point, [points, samples, 3]."""
        return (self.points_m[:, None] - self.track_m) / self.distance_m[..., None]

    @property
    @shared
    def directions(self) -> BeamDirections | None:
        """Unit directions of the beam anywhere on the track; None without a beam."""
        if self.beam is None or self.scene.along is None:
            return None
        return directions_of(self.beam, self.scene.along, self.track)

    @property
    @shared
    def along(self) -> NDArray[np.float64] | None:
        """Unit directions of the beam at `track.samples`, [samples, 3]; None without a beam."""
        return None if self.directions is None else self.directions.at(self.track.samples)

    @property
    def small(self) -> Side:
        """Rows and columns of subimages that represent a pixel; they divide the model's roots."""
        rows, columns = self.root or SMALL
        return math.gcd(rows, SMALL[0]), math.gcd(columns, SMALL[1])

    def extents(self, side: Side, *, most: bool = False) -> NDArray[np.float64]:
        """Return the extents of subimages of a size in roots: see `Subimages.extents`.

        If the model has no root size, every subimage is a root.
        """
        return self.subimages.extents(side, self.root or side, most=most)

    @cached
    def visible(self, side: Side) -> NDArray[np.bool_]:
        """Return which track samples touch a subimage with their beam, bool [points, samples]."""
        if self.limits is None or self.track.is_dense:
            return np.broadcast_to(self.on_track, self.distance_m.shape)
        return self.visible_by_size((side,))[0]

    @cached
    def visible_by_size(self, sides: tuple[Side, ...]) -> NDArray[np.bool_]:
        """Return `visible` of subimages of some sizes, bool [sizes, points, samples]."""
        shape = len(sides), *self.distance_m.shape
        if self.limits is None or self.track.is_dense:  # whose virtual channels are all formed
            return np.broadcast_to(self.on_track, shape)
        half = np.stack([self.extents(side, most=True) for side in sides]) / 2
        boxes, (low, high) = self._boxes, self.limits
        radius_m = np.linalg.norm(half @ np.abs(boxes.axes_m), axis=1)
        # Depth of the boxes in the beam, as of `Visibility.overlap`, for all sizes at once.
        factors = np.column_stack([half, radius_m**2])
        slopes = np.stack([*boxes.slopes, boxes.inverse_m**2]).reshape(factors.shape[1], -1)
        outside = np.abs(boxes.sine - (low + high) / 2) - (high - low) / 2
        return self.on_track & ((factors @ slopes).reshape(shape) > outside)

    @property
    @shared
    def _boxes(self) -> Visibility:
        """Boxes of cells at the sample points, seen from the track; only with a beam."""
        assert self.along is not None
        origin_m = self.points_m[0]
        return Visibility.of(
            self.points_m - origin_m, self.surface.steps_m, self.track_m - origin_m, self.along
        )

    def visible_share(self, side: Side, *, most: bool = False) -> float:
        """Fraction of channels whose beam touches a subimage: mean over the points, or maximum."""
        count = np.count_nonzero(self.visible(side), axis=1)
        return over_points(count / np.count_nonzero(self.on_track), most)

    @property
    @cached
    def visible_track_ends(self) -> float:
        """Mean number of the track's ends whose beam touches a sample point."""
        if self.track.is_dense:
            return 2.0 * self.track.strips
        ends = np.flatnonzero(self.on_track)[[0, -1]]
        return float(self.visible(self.small)[:, ends].sum(axis=1).mean())


def model_of(scene: Scene, outside: float = _MOST_OUTSIDE) -> VisibilityModel | None:
    """Return the model with the simplest mean track; None if all channels lie at one place.

    `outside` is the share of the lines' power that may lie above `highest_cycles_per_m`.
    """
    lines, spectrum = scene.lines, scene.spectrum
    shape, track = simplest_track(lines, band_wavelength_m(lines, spectrum.centre))
    if track is None:
        return None
    occupied = spectrum.frequency[np.cumsum(spectrum.share) < 1 - min(outside, _MOST_OUTSIDE)]
    half_band = (occupied[-1] if len(occupied) else 0.5) / lines.range_step_m
    centre = cycles_per_m_at(lines, spectrum.centre)
    mean_square = spectrum.share @ spectrum.frequency**2
    energy = scene.line_energy
    return VisibilityModel(
        scene,
        channel_power=energy / max(float(energy.mean()), 1e-300) if energy.any() else 1 + energy,
        highest_cycles_per_m=float(abs(centre) + half_band),
        rms_cycles_per_m=float(np.sqrt(mean_square)) / lines.range_step_m,
        limits=None if scene.beam is None else scene.beam.limits,
        shape=shape,
        track=track,
        subimages=Subimages(scene.surface),
        points_m=sample_points_m(scene.surface),
        distances_m=_distances_m(lines, scene.surface, track),
    )


def _distances_m(lines: RangeLines, surface: Surface, track: MeanTrack) -> NDArray[np.float64]:
    """Return `VisibilityModel.distances_m`, with as many parts as there are dense points a side."""
    dense_m = points_at_m(surface, np.linspace(0, 1, _DENSE))
    # Pixels between the dense points may be closer, by half a step at most.
    steps_m = np.linalg.norm(surface.steps_m[:2], axis=1)
    step_m = steps_m @ (np.array(surface.plane.shape) - 1) / (_DENSE - 1)
    between_m = (step_m + surface.relief_m(LEAST_SIDE).max()) / 2
    centres_m = lines.phase_centres_m
    if track.is_dense:
        centres_m = centres_m[some_channels(len(centres_m), _NEAREST_CHANNELS)]
    distances_m = np.sort(KDTree(centres_m).query(dense_m)[0])[::_DENSE] - between_m
    return np.maximum(distances_m, 1e-9)
