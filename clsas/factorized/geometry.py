"""Geometry of a factorized image: the mean track, its channels, and the roots."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from clsas.aperture.beam_directions import BeamDirections, directions_of
from clsas.aperture.dense_tracks import mean_track_of
from clsas.aperture.mean_track import MeanTrack
from clsas.aperture.phase_rates import drift, own_drift
from clsas.aperture.predicted_channels import BEAM_MARGIN
from clsas.core.lines import RangeLines, some_channels
from clsas.core.surface import Surface
from clsas.core.wavelengths import band_wavelength_m
from clsas.factorized.tree import Division
from clsas.plans.factorization import Factorization
from clsas.scene import Scene
from clsas.signal.ray_corrections import Corrections
from clsas.sonar.beam import BeamWindow

_ON_TRACK = 1e-4  # distance within which channels lie on the mean track, wavelengths
_SHAPES = {"strips": "several passes", "sheet": "a sheet"}
_SAMPLED_LINES = 64  # evenly spread lines whose power is measured


@dataclass(frozen=True, eq=False)
class Geometry:
    """Geometry of lines and roots in float64, with channels in the order of the track.

    It contains no samples, and serves any number of images.

    Attributes
    ----------
    lines : RangeLines
        The given lines without their samples.
    surface : Surface
    factorization : Factorization
    beam : BeamWindow or None
    division : Division
        Subimages of all stages.
    rectangles : Division
        Roots, rectangles of leaves whose visibility is computed together, and leaves.
    track : MeanTrack
    channels : int64 [channels]
        Numbers of the lines, in the order of the track.
    phase_centres_m : float64 [channels, 3]
    directions : BeamDirections or None
        Unit directions of the beam anywhere on the track; None without a beam.
    along : float64 [samples, 3] or None
        Directions of the beam at `track.samples`.
    drift : float64 [3]
    own_drift : float64 [channels, 3] or None
        See `clsas.aperture.phase_rates`.
    samples_per_m, cycles_per_m : float
        Samples and phase of the upsampled lines per metre of range from the mean track.
    nearest_m : float or None
        With a beam, the smallest distance between a channel and the centre of a root.
    on_track : bool
        True if all channels lie on the mean track, so that there is nothing to align.
    ramps : bool
        True if the first stage turns the phases of channels along their lines.
    slack : float
        Largest difference of aperture coordinates at which a channel appears from two points.
    corrections : Corrections or None
        Corrections of ranges along exact rays.
    """

    lines: RangeLines
    surface: Surface
    factorization: Factorization
    beam: BeamWindow | None
    division: Division
    rectangles: Division
    track: MeanTrack
    channels: NDArray[np.int64]
    phase_centres_m: NDArray[np.float64]
    directions: BeamDirections | None
    along: NDArray[np.float64] | None
    drift: NDArray[np.float64]
    own_drift: NDArray[np.float64] | None
    samples_per_m: float
    cycles_per_m: float
    nearest_m: float | None
    on_track: bool
    ramps: bool
    slack: float
    corrections: Corrections | None = None

    @property
    def roots(self) -> NDArray[np.int64]:
        """First pixels of roots in the order in which they are formed, [roots, 2].

        With a beam, roots that are visible from the same channels follow each other.
        """
        roots = self.division.roots
        if self.along is None:
            return roots
        along = np.abs(self.surface.steps_m[:2] @ self.along.mean(axis=0))
        slow = int(np.argmax(along * self.factorization.sides[0]))
        return roots[np.lexsort((roots[:, 1 - slow], roots[:, slow]))]


def geometry_of(
    scene: Scene, factorization: Factorization, track: MeanTrack | None = None
) -> Geometry:
    """Return the geometry of a factorized image.

    Parameters
    ----------
    scene : Scene
    factorization : Factorization
    track : MeanTrack, optional
        The mean track of the lines, with the shape that the factorization names, if it is known.

    Raises
    ------
    ValueError
        If the lines have no such mean track.
    """
    lines, surface, beam = scene.lines, scene.surface, scene.beam
    resampling, division = factorization.resampling, Division(surface, factorization.sides)
    wavelength_m = band_wavelength_m(lines, resampling.centre_cycles_per_sample)
    track = track or _mean_track(lines, factorization, wavelength_m)
    directions = along = nearest_m = None
    if beam is not None and scene.along is not None:
        directions = directions_of(beam, scene.along, track)
        along = directions.at(track.samples)
        root_m = division.centres_m(0, division.roots)
        nearest_m = float(cdist(root_m, lines.phase_centres_m).min())
    channels = np.argsort(track.coordinate, kind="stable")
    track = track.some(channels)
    phase_centres_m = lines.phase_centres_m[channels]
    off_m = float(np.abs(track.offsets_m(phase_centres_m)).max())
    close_m = _ON_TRACK * wavelength_m
    on_track = off_m <= close_m
    own = own_drift(lines)
    if own is not None:
        off_m += np.linalg.norm(own, axis=1).max() * np.abs(lines.last_range_m).max()
    bistatic = lines.rx_velocity_m_s is not None or not np.array_equal(lines.tx_m, lines.rx_m)
    ramps = factorization.aperture.aligns_phases and (bistatic or off_m > close_m)
    # The apparent coordinate of a channel off the track depends on the point.
    slowest_m = np.linalg.norm(track.sampled_m[1], axis=1).min()
    together = _rectangle(surface, factorization, along, nearest_m)
    return Geometry(
        lines=lines.without_samples(),
        surface=surface,
        factorization=factorization,
        beam=beam,
        division=division,
        rectangles=Division(surface, (factorization.sides[0], together, factorization.sides[-1])),
        track=track,
        channels=channels,
        phase_centres_m=phase_centres_m,
        directions=directions,
        along=along,
        drift=drift(lines),
        own_drift=None if own is None else own[channels],
        samples_per_m=resampling.samples_per_m(lines) * (1 + factorization.stretch),
        cycles_per_m=resampling.cycles_per_m(lines) * (1 + factorization.stretch),
        nearest_m=nearest_m,
        on_track=on_track,
        ramps=bool(ramps),
        slack=2 * off_m / max(slowest_m, 1e-9),
        corrections=scene.water.corrections,
    )


def _mean_track(lines: RangeLines, factorization: Factorization, wavelength_m: float) -> MeanTrack:
    """Return the mean track of the shape that a factorization names, or raise ValueError."""
    shape = factorization.aperture.shape
    track = mean_track_of(lines, shape, wavelength_m)
    if track is None:
        raise ValueError(
            "lines must have channels at more than one place for a plan that divides the image"
            if shape == "track"
            else f"lines must have channels that lie on {_SHAPES[shape]}, as the plan assumes"
        )
    return track


def imaged_rms(geometry: Geometry, lines: RangeLines) -> float:
    """Return the rms of samples at the ranges of pixels, over some of the lines."""
    some = some_channels(lines.channels, _SAMPLED_LINES)
    root_m = geometry.division.centres_m(0, geometry.division.roots)
    away_m = cdist(root_m, lines.phase_centres_m[some])
    radius_m = geometry.surface.radius_m(geometry.factorization.sides[0])
    near_m, far_m = away_m.min(axis=0) - radius_m, away_m.max(axis=0) + radius_m
    total, count = 0.0, 0
    for i, near, far in zip(some, near_m, far_m, strict=True):
        limits = (np.array([near, far]) - lines.first_range_m[i]) / lines.range_step_m
        first, last = np.clip(limits, 0, lines.length).astype(np.int64)
        echoes = lines.samples[i, first : last + 1].astype(np.complex128)
        total += float(np.vdot(echoes, echoes).real)
        count += last + 1 - first
    return math.sqrt(total / max(count, 1))


def _rectangle(
    surface: Surface,
    factorization: Factorization,
    along: NDArray[np.float64] | None,
    nearest_m: float | None,
) -> tuple[int, int]:
    """Return the size of rectangles of leaves whose visibility is computed together.

    They lie within the parent of a leaf. The stretch of the track from which a rectangle is visible
    exceeds that of a leaf by no more than `BEAM_MARGIN`.
    """
    sides, limits = factorization.sides, factorization.limits
    leaf, parent = sides[-1], sides[max(len(sides) - 2, 0)]
    if along is None or nearest_m is None or limits is None:
        return parent
    most_m = BEAM_MARGIN * nearest_m * np.ptp(np.clip(limits, -1, 1))
    along_m = np.abs(surface.steps_m[:2] @ along.T)

    def fits(side: tuple[int, int]) -> bool:
        inside = parent[0] % side[0] == parent[1] % side[1] == 0
        return inside and (side @ along_m).max() <= most_m

    side = leaf
    while wider := [each for each in _doubled(side) if fits(each)]:
        side = min(wider, key=lambda each: (each @ along_m).max())
    return side


def _doubled(side: tuple[int, int]) -> list[tuple[int, int]]:
    """Return two sizes, one with twice the rows and one with twice the columns."""
    return [(2 * side[0], side[1]), (side[0], 2 * side[1])]
