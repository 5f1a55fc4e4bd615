"""Geometry between track and grid, sampled: the cost and error models are evaluated on it."""

from __future__ import annotations

import copy
from collections.abc import Callable, Hashable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from clsas.core.grid import Grid
from clsas.core.lines import RangeLines, some_channels
from clsas.factorized.beam_directions import BeamDirections
from clsas.factorized.dense_apertures import Shape, mean_track_of, simplest_track
from clsas.factorized.surface import LEAST_SIDE, surface_of
from clsas.planning.caching import cached, shared
from clsas.planning.sample_points import (
    over_points,
    points_at_m,
    sample_points_m,
    trapezoidal_weights,
)
from clsas.planning.subimages import SMALL, Side, Subimages
from clsas.signal.ambiguity import Ambiguity, ambiguity
from clsas.signal.spectrum import cycles_per_m_at, measure_spectrum
from clsas.sonar.beam import BeamWindow
from clsas.sonar.visibility import Visibility

_DENSE = 65  # points along either side, for the least distance of the grid; half: 0.05 dB
_NEAREST_CHANNELS = 4096  # of a dense aperture, for that distance
_MOST_OUTSIDE = 1e-6  # share of power above the highest frequency; half or twice: no change
_AMBIGUITY = "ambiguity"  # key of what mean tracks of all shapes have in common


class VisibilityModel:
    """Geometry between track and grid, sampled at 25 grid points.

    Errors and costs of candidates are evaluated on these samples. `outside` is the share of the
    lines' power that may lie above `highest_cycles_per_m`.

    Attributes
    ----------
    lines, grid, beam
        What is imaged.
    spectrum : Spectrum
        Of the lines, with the weight that frequencies have in the image.
    highest_cycles_per_m, rms_cycles_per_m : float
        Phase per metre of range, cycles: at the band's edge, and rms about the band's centre.
    track : MeanTrack or None
        None if all channels lie at one place. The attributes below are then missing.
    channels_along : float64 [channels, 3] or None
        Unit directions of the track at the channels, with a beam.
    surface : Surface
        Positions of the grid's pixels.
    subimages : Subimages
        Of every size, on the surface.
    points_m : float64 [points, 3]
        Sample points all over the grid, also near its corners.
    track_m : float64 [samples, 3]
        Positions at `track.samples`.
    directions : BeamDirections or None
        Unit directions of the beam anywhere on the track, with a beam.
    along : float64 [samples, 3] or None
        Those at `track.samples`.
    spacing : float64 [samples]
        Weight of each sample in integrals over the track's parameter.
    on_track : bool [samples]
        False past the track's ends.
    distance_m, sight : float64 [points, samples], [points, samples, 3]
        Distance and unit vector from every track sample to every point.
    nearest_m : float
        Lower bound of the distance between pixels and channels.
    limits : (low, high) or None
        Sines of the aspect angle between which channels are used for a subimage.
    shape : str
        Shape of the mean track: see `clsas.factorized.dense_apertures`.
    root : (rows, columns) or None
        Size of the roots within which `rates` holds; None for the sample points alone.
    """

    limits: tuple[float, float] | None
    root: Side | None
    shape: Shape = "track"
    along: Any
    directions: BeamDirections | None
    channels_along: Any

    def __init__(
        self,
        lines: RangeLines,
        grid: Grid,
        beam: BeamWindow | None,
        outside: float = _MOST_OUTSIDE,
    ) -> None:
        self.lines, self.grid, self.beam = lines, grid, beam
        self._cache: dict[Hashable, Any] = {}
        self.spectrum = measure_spectrum(lines, grid)
        outside = min(outside, _MOST_OUTSIDE)
        occupied = self.spectrum.frequency[np.cumsum(self.spectrum.share) < 1 - outside]
        half_band = (occupied[-1] if len(occupied) else 0.5) / lines.range_step_m
        centre = cycles_per_m_at(lines, self.spectrum.centre)
        self.highest_cycles_per_m = float(abs(centre) + half_band)
        mean_square = self.spectrum.share @ self.spectrum.frequency**2
        self.rms_cycles_per_m = float(np.sqrt(mean_square)) / lines.range_step_m
        self.limits, self.root = None if beam is None else beam.limits, None
        self.channels_along = None if beam is None else beam.directions(lines)
        self.shape, track = simplest_track(lines)
        self._put_track(track)

    def _put_track(self, track: Any) -> None:
        """Set what follows from the mean track."""
        self.track, self.along, self.directions, beam = track, None, None, self.beam
        if track is None:
            return
        self.surface = surface_of(self.grid)
        self.subimages = Subimages(self.surface)
        self.points_m = sample_points_m(self.surface)
        self.track_m, _ = self.track.sampled_m
        self.spacing = trapezoidal_weights(self.track.samples)
        sight = self.points_m[:, None] - self.track_m
        self.distance_m = np.maximum(np.linalg.norm(sight, axis=-1), 1e-9)
        self.sight = sight / self.distance_m[..., None]
        self.on_track = self.track.on_track
        if not hasattr(self, "nearest_m"):
            self.nearest_m = self._nearest_m()
        if beam is not None:
            self.directions = BeamDirections.of(beam, self.channels_along, self.track)
            self.along = self.directions.at(self.track.samples)

    def _nearest_m(self) -> float:
        """Lower bound of the distance between pixels and channels."""
        dense_m = points_at_m(self.surface, np.linspace(0, 1, _DENSE))
        # Pixels between the dense points may be closer; half a step bounds by how much.
        steps_m = np.linalg.norm(self.surface.steps_m[:2], axis=1)
        step_m = steps_m @ (np.array(self.surface.plane.shape) - 1) / (_DENSE - 1)
        between_m = (step_m + self.surface.relief_m(LEAST_SIDE).max()) / 2
        centres_m = self.lines.phase_centres_m
        if self.track.is_dense:
            centres_m = centres_m[some_channels(len(centres_m), _NEAREST_CHANNELS)]
        nearest_m = KDTree(dense_m).query(centres_m)[0].min() - between_m
        return max(float(nearest_m), 1e-9)

    def from_cache(self, key: Hashable, find: Callable[[], Any]) -> Any:
        """Return the value cached under a key; `find` computes it the first time."""
        if key not in self._cache:
            self._cache[key] = find()
        return self._cache[key]

    def with_shape(self, shape: Shape) -> VisibilityModel | None:
        """Return this model with a mean track of another shape; None if channels have none."""
        track = mean_track_of(self.lines, shape)
        if track is None:
            return None
        model = copy.copy(self)
        model._cache = {key: self._cache[key] for key in (_AMBIGUITY,) if key in self._cache}
        model._put_track(track)
        model.shape = shape
        return model

    def _with(self, **changes: Any) -> VisibilityModel:
        """Return this model with other limits or another root."""
        model = copy.copy(self)
        vars(model).update(changes)
        return model

    def with_limits(self, low: float, high: float) -> VisibilityModel:
        """Return this model with a narrower beam: sines of the aspect angle where it ends."""
        return self._with(limits=(low, high))

    def within(self, root: Side) -> VisibilityModel:
        """Return this model with the phase rates of subimages in roots of a size."""
        return self._with(root=root)

    @property
    def ambiguity(self) -> Ambiguity:
        """Errors that the lines themselves leave open."""
        given = self.lines, self.grid, self.spectrum, self.beam, self.channels_along
        found: Ambiguity = self.from_cache(_AMBIGUITY, lambda: ambiguity(*given))
        return found

    def extents(self, side: Side, *, most: bool = False) -> NDArray[np.float64]:
        """Return the extents of subimages of a size in roots of the model's: see `Subimages`.

        Without a size of roots every subimage is one.
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
        """Boxes of cells at the sample points, seen from the track."""
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
        return float(self.visible(SMALL)[:, ends].sum(axis=1).mean())
