"""Geometry of a factorized image: virtual channels of roots, and how these see the raw ones."""

from __future__ import annotations

import functools
import math
from collections.abc import Hashable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from clsas.aperture.beam_directions import BeamDirections, beam_rate
from clsas.aperture.dense_channels import SheetRates, all_channels, sheet_beam_rates, sheet_rates
from clsas.aperture.dense_tracks import mean_track_of
from clsas.aperture.interpolated import BEAM_MARGIN
from clsas.aperture.mean_track import MeanTrack
from clsas.aperture.nearest import NearestBeams
from clsas.aperture.phase_rates import cycles_per_extent, drift, own_drift, stretches
from clsas.aperture.virtual_channels import ChannelRanges, VirtualChannels
from clsas.core.geometry import pairwise_range_m
from clsas.core.lines import RangeLines, antennas_of, some_channels
from clsas.core.wavelengths import band_wavelength_m
from clsas.factorized import visibility
from clsas.factorized.plan import Plan
from clsas.factorized.surface import Surface
from clsas.factorized.tree import Division, channel_ranges
from clsas.opencl.buffers import MARGIN

_ON_TRACK = 1e-4  # wavelengths; closer, channels lie on the mean track
_SHAPES = {"strips": "several passes", "sheet": "a sheet"}
_SAMPLED_LINES = 64  # whose power is measured, spread evenly
_FAR = 1 << 28  # samples: off any line, and within int32
MOST_KEPT_BYTES = 128 << 20
"""Most memory of sectors, and of groups, that a plan keeps for its next image."""


@dataclass(frozen=True, eq=False)
class Sector:
    """Some roots with the virtual channels of their subimages.

    Attributes
    ----------
    roots : int [roots, 2]
        First pixels.
    root_m : float64 [roots, 3]
        Centres of the roots.
    channels : slice
        Raw channels, in the order of the track, that see any of them.
    relative_m : list of float64 [roots, subimages, 3]
        Centres of subimages relative to those of their roots, stage by stage.
    nodes : list of VirtualChannels
        Virtual channels, stage by stage.
    needs : list of Ranges
        Virtual channels of each subimage, and the channels that it combines, stage by stage.
    coordinate : float64 [roots, channels]
        Aperture coordinates of the raw channels.
    across : float64 [roots, channels] or None
        Their coordinates across a sheet.
    """

    roots: NDArray[np.int64]
    root_m: NDArray[np.float64]
    channels: slice
    relative_m: list[NDArray[np.float64]]
    nodes: list[VirtualChannels]
    needs: list[ChannelRanges]
    coordinate: NDArray[np.float64]
    across: NDArray[np.float64] | None = None

    @property
    def nbytes(self) -> int:
        """Approximate memory of all arrays."""
        parts = [self, *self.nodes, *self.needs]
        arrays = [value for part in parts for value in vars(part).values()] + self.relative_m
        return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))

    def stride(self, level: int) -> int:
        """Return the largest number of virtual channels of a stage's subimages."""
        need = self.needs[level]
        return int((need.last - need.first).max())

    def positions_m(self, level: int) -> NDArray[np.float64]:
        """Return virtual channels of a stage relative to the centres of their roots."""
        return self.nodes[level].position_m - self.root_m[:, None]


class Geometry:
    """Geometry of a plan's lines and roots in float64, with channels in the order of the track.

    It serves any number of images, and holds no samples.

    Attributes
    ----------
    kept : dict
        Other results that do not depend on samples.
    channels : int [channels]
        Lines in the order of the track.
    division : Division
    drift : float64 [3]
        See `clsas.aperture.phase_rates.drift`.
    ramps : bool
        True if the first stage turns the phase of channels along their lines.
    samples_per_m, cycles_per_m : float
        Samples and phase of the upsampled lines per metre of range from the mean track.

    Raises
    ------
    ValueError
        If all channels are at one place.
    """

    def __init__(self, lines: RangeLines, surface: Surface, chosen: Plan) -> None:
        self.lines, self.surface, self.plan = lines.without_samples(), surface, chosen
        image, beam = chosen.factorization, chosen.beam
        self.factorization, self.beam = image, beam
        self.kept: dict[Hashable, Any] = {}
        self.samples_per_m = image.resampling.samples_per_m(lines) * (1 + image.stretch)
        self.cycles_per_m = image.resampling.cycles_per_m(lines) * (1 + image.stretch)
        self.division = Division(surface, image.sides)
        wavelength_m = band_wavelength_m(lines, image.resampling.centre_cycles_per_sample)
        track = chosen.kept.get("track") or mean_track_of(lines, image.aperture.shape, wavelength_m)
        if track is None:
            raise ValueError(
                "lines must have channels at more than one place for a plan that divides"
                if image.aperture.shape == "track"
                else f"lines must have channels that lie on {_SHAPES[image.aperture.shape]}, as "
                "the plan has them"
            )
        self.channels = np.argsort(track.coordinate, kind="stable")
        self.track = track.some(self.channels)
        self.directions: BeamDirections | None = None
        self.along: NDArray[np.float64] | None = None
        if beam is not None:
            self.directions = BeamDirections.of(beam, beam.directions(lines), track)
            self.along = self.directions.at(track.samples)
        self.phase_centres_m = lines.phase_centres_m[self.channels]
        self.drift, own = drift(lines), own_drift(lines)
        self.own_drift = own if own is None else own[self.channels]
        self._seen = Division(surface, (image.sides[0], self._together(), image.sides[-1]))
        # On the track itself there is nothing to align.
        off_m = np.abs(self.track.offsets_m(self.phase_centres_m)).max()
        self._on_sheet = off_m <= _ON_TRACK * wavelength_m
        if own is not None:
            off_m += np.linalg.norm(own, axis=1).max() * np.abs(lines.last_range_m).max()
        apart = lines.rx_velocity_m_s is not None or not np.array_equal(lines.tx_m, lines.rx_m)
        away = apart or off_m > _ON_TRACK * wavelength_m
        self.ramps = bool(away and image.aperture.aligns_phases)
        # From elsewhere a channel off the track appears at another place.
        way_m = np.linalg.norm(self.track.sampled_m[1], axis=1)
        self._slack = 2 * off_m / max(way_m.min(), 1e-9)

    @property
    def roots(self) -> NDArray[np.int64]:
        """First pixels of roots in the order in which they are formed, [roots, 2].

        With a beam, roots that the same channels see follow each other.
        """
        roots = self.division.roots
        if self.along is None:
            return roots
        along = np.abs(self.surface.steps_m[:2] @ self.along.mean(axis=0))
        slow = int(np.argmax(along * self.factorization.sides[0]))
        return roots[np.lexsort((roots[:, 1 - slow], roots[:, slow]))]

    @functools.cached_property
    def nearest_m(self) -> float:
        """Least distance between a channel and the centre of a root."""
        root_m = self.division.centres_m(0, self.division.roots)
        return float(cdist(root_m, self.phase_centres_m).min())

    def rms(self, lines: RangeLines) -> float:
        """Return the rms of samples at ranges where pixels lie, over some of the lines."""
        some = some_channels(lines.channels, _SAMPLED_LINES)
        root_m = self.division.centres_m(0, self.division.roots)
        away_m = cdist(root_m, lines.phase_centres_m[some])
        radius_m = self.surface.radius_m(self.factorization.sides[0])
        near_m, far_m = away_m.min(axis=0) - radius_m, away_m.max(axis=0) + radius_m
        total, count = 0.0, 0
        for i, near, far in zip(some, near_m, far_m, strict=True):
            limits = (np.array([near, far]) - lines.first_range_m[i]) / lines.range_step_m
            first, last = np.clip(limits, 0, lines.length).astype(np.int64)
            seen = lines.samples[i, first : last + 1].astype(np.complex128)
            total += float(np.vdot(seen, seen).real)
            count += last + 1 - first
        return math.sqrt(total / max(count, 1))

    def _together(self) -> tuple[int, int]:
        """Return the size of rectangles of leaves whose visibility is found together.

        They lie within a leaf's parent, and are hardly visible from further along the track than
        one leaf.
        """
        sides = self.factorization.sides
        leaf, parent = sides[-1], sides[max(len(sides) - 2, 0)]
        limits = self.factorization.limits
        if self.along is None or limits is None:
            return parent
        most_m = BEAM_MARGIN * self.nearest_m * np.ptp(np.clip(limits, -1, 1))
        along_m = np.abs(self.surface.steps_m[:2] @ self.along.T)

        def fits(side: tuple[int, int]) -> bool:
            inside = parent[0] % side[0] == parent[1] % side[1] == 0
            return inside and (side @ along_m).max() <= most_m

        side = leaf
        while wider := [each for each in _doubled(side) if fits(each)]:
            side = min(wider, key=lambda each: (each @ along_m).max())
        return side

    def sectors(self, first: int, most: int) -> Iterator[Sector]:
        """Yield all roots in sectors: of `first` roots, for a device to begin with, then more.

        They are kept for the next image, unless they take much memory.
        """
        if "sectors" in self.kept:
            yield from self.kept["sectors"]
            return
        roots, start, count = self.roots, 0, min(first, most)
        found: list[Sector] | None = []
        while start < len(roots):
            sector = self.sector(roots[start : start + count])
            yield sector
            start, count = start + count, min(2 * count, most)
            if found is not None:
                found.append(sector)
                if sum(each.nbytes for each in found) > MOST_KEPT_BYTES:
                    found = None
        if found is not None:
            self.kept["sectors"] = found

    def sector(self, roots: NDArray[np.int64]) -> Sector:
        """Return the geometry of some roots, given by their first pixels, [roots, 2]."""
        division, track, surface = self.division, self.track, self.surface
        sides, aperture = self.factorization.sides, self.factorization.aperture
        root_m = division.centres_m(0, roots)
        corners = [division.corners(level, roots) for level in range(len(sides))]
        relative_m = [
            division.centres_m(level, each) - root_m[:, None] for level, each in enumerate(corners)
        ]
        together = self._seen.sides[1]
        seen_m = self._seen.centres_m(1, self._seen.corners(1, roots))
        half_m = surface.extents_in(together, sides[0], roots).max(axis=0) / 2
        half_m = half_m[:, None] * surface.steps_m
        inside = surface.holds(sides[-1], corners[-1])
        channels = slice(0, len(self.channels))
        if not track.is_dense:
            begin, end = (
                each[:, self._seen.parents(2)]
                for each in visibility.visible_stretches(
                    self.factorization.limits, track, self.along, seen_m, half_m
                )
            )
            channels = aperture.used_channels(
                track.coordinate, begin[inside], end[inside], self._slack
            )
        centres_m, some = self.phase_centres_m[channels], track.some(channels)
        own = None if self.own_drift is None else self.own_drift[channels]
        place, across = self._apparent(some, root_m, centres_m, own)
        nodes = self._virtual_channels(roots, root_m, place, across, centres_m)
        if track.is_dense:
            needs = all_channels(nodes, place.shape[1], self._holding(inside))
        else:
            needs = channel_ranges(division, nodes, place, (begin, end), inside)
        return Sector(roots, root_m, channels, relative_m, nodes, needs, place, across)

    def _apparent(
        self,
        some: MeanTrack,
        root_m: NDArray[np.float64],
        centres_m: NDArray[np.float64],
        own: NDArray[np.float64] | None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Return coordinates at which channels appear: see `MeanTrack.apparent_places`."""
        if some.across is None or own is not None or not self._on_sheet:
            return some.apparent_places(root_m, centres_m, own)
        shape = (len(root_m), len(centres_m))
        return np.broadcast_to(some.coordinate, shape), np.broadcast_to(some.across, shape)

    def _holding(self, inside: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
        """Return which subimages hold a pixel, stage by stage, from those of the leaves."""
        result = [inside]
        for level in range(len(self.division.sides) - 1, 0, -1):
            held = self.division.by_parent(level, result[0])
            result.insert(0, np.any(held, axis=-1))
        return result

    def _virtual_channels(
        self,
        roots: NDArray[np.int64],
        root_m: NDArray[np.float64],
        coordinate: NDArray[np.float64],
        across: NDArray[np.float64] | None,
        centres_m: NDArray[np.float64],
    ) -> list[VirtualChannels]:
        """Return the virtual channels of some roots, stage by stage, from their raw channels."""
        aperture, sides, track = self.factorization.aperture, self.factorization.sides, self.track
        if isinstance(aperture, NearestBeams):
            return aperture.beams(coordinate, centres_m)
        extents = [self.surface.extents_in(side, sides[0], roots) for side in sides]
        boxes = self._boxes(roots, root_m)
        if across is not None:
            rates, beam_rates = sheet_rates(track, *boxes), self._sheet_beam_rates(roots, root_m)
            return aperture.on_sheet(track, rates, beam_rates, extents, (coordinate, across))
        rates_along = cycles_per_extent(track, *boxes, self.factorization.limits, self.along)
        beam = self._beam_rate(roots, root_m)
        return aperture.on_curves(track, rates_along, beam, extents, coordinate)

    def _beam_rate(
        self, roots: NDArray[np.int64], root_m: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        """Return the phase rates of the beam's weights in some roots: see `beam_rate`."""
        if self.beam is None or self.along is None:
            return None
        return beam_rate(self.beam, self.track, self.along, root_m, self._sides_m(roots))

    def _sheet_beam_rates(
        self, roots: NDArray[np.int64], root_m: NDArray[np.float64]
    ) -> SheetRates | None:
        """Return the phase rates of the beam's weights in some roots, along and across a sheet."""
        if self.beam is None or self.directions is None:
            return None
        sides_m = self._sides_m(roots)
        return sheet_beam_rates(self.beam, self.track, self.directions, root_m, sides_m)

    def _sides_m(self, roots: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the sides of the largest of some roots, [axes, 3]."""
        side = self.factorization.sides[0]
        extents = self.surface.extents_in(side, side, roots).max(axis=0)
        return extents[:, None] * self.surface.steps_m

    def _boxes(
        self, roots: NDArray[np.int64], root_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float, float]:
        """Return roots as boxes of `cycles_per_extent`: its steps to its nearest range."""
        image, surface = self.factorization, self.surface
        extents = surface.extents_in(image.sides[0], image.sides[0], roots).max(axis=0)
        nearest_m = min(surface.radius_m(image.sides[-1]), image.closest_m)
        return surface.steps_m, root_m, extents, image.highest_cycles_per_m, nearest_m

    def references(self, sector: Sector) -> dict[str, NDArray]:
        """Return how roots align the raw channels, in the order of their nodes, [roots, channels].

        By name: the line, its first sample, the position between samples, the phase in cycles and
        its change per sample.
        """
        lines, resampling, half = (
            self.lines,
            self.factorization.resampling,
            self.factorization.half_lengths[0],
        )
        nodes = sector.nodes[0]
        channels = self.channels[sector.channels]
        range_m = pairwise_range_m(sector.root_m, *self._antennas(sector))
        place = (range_m - lines.first_range_m[channels]) / lines.range_step_m
        place += resampling.lead
        cycles = lines.carrier_cycles_per_m * range_m
        cycles += place * resampling.centre_cycles_per_sample
        cycles -= np.rint(cycles)
        place *= resampling.ratio
        place += MARGIN - resampling.first - half
        lower = np.floor(place)
        start = np.clip(lower + 1 - self.factorization.align.taps // 2, -_FAR, _FAR)
        channel = np.broadcast_to(channels, place.shape)
        references = {
            "order": nodes.ordered(channel).astype(np.int32),
            "start": nodes.ordered(start).astype(np.int32),
            "nu": nodes.ordered(place - lower - 0.5).astype(np.float32),
            "cycles": nodes.ordered(cycles).astype(np.float32),
        }
        if self.ramps:
            references["ramp"] = nodes.ordered(self._ramp(sector)).astype(np.float32)
        return references

    def _antennas(self, sector: Sector) -> tuple:
        """Return antennas, velocities and sound speed of a sector's channels."""
        return antennas_of(self.lines, self.channels[sector.channels])

    def _ramp(self, sector: Sector) -> NDArray[np.float64]:
        """Return cycles per sample by which channels' phases grow faster than the mean of all."""
        virtual_m = self.track.positions_m(sector.coordinate, sector.across)
        tx_m, rx_m, velocity, speed = self._antennas(sector)
        plane = self.surface.plane
        stretch = stretches(
            tx_m, rx_m, velocity, speed, self.drift, plane, sector.root_m, virtual_m
        )
        more = (stretch - self.factorization.stretch) / (1 + self.factorization.stretch)
        return more * self.cycles_per_m / self.samples_per_m


def _doubled(side: tuple[int, int]) -> list[tuple[int, int]]:
    """Return a size with twice the rows, and with twice the columns."""
    return [(2 * side[0], side[1]), (side[0], 2 * side[1])]
