"""The geometry of some roots of a factorized image: what the device is told of them."""

from __future__ import annotations

import functools
import math
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from clsas.core.geometry import pairwise_range_m
from clsas.core.lines import RangeLines, some_channels
from clsas.factorized import tree, visibility
from clsas.factorized.aperture import cycles_per_extent, drift, mean_track, own_drift, stretches
from clsas.factorized.plan import Plan
from clsas.factorized.surface import Surface
from clsas.factorized.tree import ChannelRanges, Division, VirtualChannels
from clsas.opencl.buffers import MARGIN

_ON_TRACK = 1e-4  # wavelengths
_SOME_LINES = 64  # of which samples are looked at
_FAR = 1 << 28  # samples: off any line, and within int32
MOST_KEPT_BYTES = 128 << 20
"""Of what one image leaves for the next by the same plan, at most, each of sectors and groups."""
OF_BEAM = 1 / 16
"""Of what a beam covers: by how much it may be taken to cover more."""


@dataclass(frozen=True, eq=False)
class Sector:
    """Some roots: which virtual channels their subimages have, and how they see the raw ones.

    Attributes
    ----------
    roots : int [roots, 2]
        Their first pixels.
    root_m : float64 [roots, 3]
        Middles of the roots.
    channels : slice
        Which of the raw channels, in the order of the track, see any of them.
    relative_m : list of float64 [roots, subimages, 3]
        Those of subimages from that of their root, stage by stage.
    nodes : list of VirtualChannels
        Stage by stage.
    needs : list of Ranges
    coordinate : float64 [roots, channels]
        Where these raw channels appear on the track.
    """

    roots: NDArray[np.int64]
    root_m: NDArray[np.float64]
    channels: slice
    relative_m: list[NDArray[np.float64]]
    nodes: list[VirtualChannels]
    needs: list[ChannelRanges]
    coordinate: NDArray[np.float64]

    @property
    def nbytes(self) -> int:
        """Memory of all arrays, about."""
        parts = [self, *self.nodes, *self.needs]
        arrays = [value for part in parts for value in vars(part).values()] + self.relative_m
        return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))

    def stride(self, level: int) -> int:
        """Return how many lines a subimage of a stage has at most."""
        need = self.needs[level]
        return int((need.last - need.first).max())

    def positions_m(self, level: int) -> NDArray[np.float64]:
        """Return the virtual channels of a stage from the middles of their roots."""
        return self.nodes[level].position_m - self.root_m[:, None]


class Geometry:
    """How lines see the roots of a plan, in float64; channels are in the order of the track.

    It serves any number of images, and holds no samples.

    Attributes
    ----------
    kept : dict
        What else was found out that does not depend on samples.
    channels : int [channels]
        Which line each is.
    division : Division
    drift : float64 [3]
    ramps : bool
        Whether channels' phases are turned along their lines.
    samples_per_m, cycles_per_m : float
        Of the upsampled lines.
    """

    def __init__(self, lines: RangeLines, surface: Surface, chosen: Plan) -> None:
        self.lines, self.surface, self.plan = lines.without_samples(), surface, chosen
        self.kept: dict[Hashable, Any] = {}
        self.samples_per_m = chosen.resampling.samples_per_m(lines)
        self.cycles_per_m = chosen.resampling.cycles_per_m(lines)
        self.division = Division(surface, chosen.sides)
        track = mean_track(lines)
        self.channels = np.argsort(track.coordinate, kind="stable")
        self.track = replace(track, coordinate=track.coordinate[self.channels])
        self.along = None
        if chosen.beam is not None:
            along = chosen.beam.directions(lines)[self.channels]
            self.along = visibility.beam_directions(along, self.track, track.samples)
        self.phase_centres_m = lines.phase_centres_m[self.channels]
        self.drift, own = drift(lines), own_drift(lines)
        self.own_drift = own if own is None else own[self.channels]
        self._seen = Division(surface, (chosen.sides[0], self._together(), chosen.sides[-1]))
        # The thesis's method has none; on the track itself there is nothing to make up for.
        off_m = np.abs(self.phase_centres_m - self.track.positions_m(self.track.coordinate)).max()
        wavelength_m = lines.sound_speed_m_s / max(lines.carrier_hz, 1.0)
        if own is not None:
            off_m += np.linalg.norm(own, axis=1).max() * np.abs(lines.last_range_m).max()
        apart = lines.rx_velocity_m_s is not None or not np.array_equal(lines.tx_m, lines.rx_m)
        away = apart or off_m > _ON_TRACK * wavelength_m
        self.ramps = bool(away and not chosen.nearest)
        # From elsewhere a channel off the track appears at another place.
        way_m = np.linalg.norm(self.track.sampled_m[1], axis=1)
        self._slack = 2 * off_m / max(way_m.min(), 1e-9)

    @property
    def roots(self) -> NDArray[np.int64]:
        """Roots in the order in which they are formed, [roots, 2].

        With a beam, so that those come together which the same channels see.
        """
        roots = self.division.roots
        if self.plan.limits is None:
            return roots
        along = np.abs(self.surface.steps_m[:2] @ self.along.mean(axis=0))
        slow = int(np.argmax(along * self.plan.sides[0]))
        return roots[np.lexsort((roots[:, 1 - slow], roots[:, slow]))]

    @functools.cached_property
    def nearest_m(self) -> float:
        """Least distance of a channel from a root's middle."""
        root_m = self.division.centres_m(0, self.division.roots)
        return float(cdist(root_m, self.phase_centres_m).min())

    def rms(self, lines: RangeLines) -> float:
        """Return the rms value of lines' samples, of some of them, from about where pixels lie."""
        some = some_channels(lines.channels, _SOME_LINES)
        root_m = self.division.centres_m(0, self.division.roots)
        away_m = cdist(root_m, lines.phase_centres_m[some])
        radius_m = self.surface.radius_m(self.plan.sides[0])
        near_m, far_m = away_m.min(axis=0) - radius_m, away_m.max(axis=0) + radius_m
        total, count = 0.0, 0
        for i, near, far in zip(some, near_m, far_m, strict=True):
            limits = (np.array([near, far]) - lines.first_range_m[i]) / lines.range_step_m
            first, last = np.clip(limits, 0, lines.length).astype(np.int64)
            seen = lines.samples[i, first : last + 1].astype(np.complex128)
            total += np.vdot(seen, seen).real
            count += last + 1 - first
        return math.sqrt(total / max(count, 1))

    def _together(self) -> tuple[int, int]:
        """Return the size of rectangles of leaves for all of which it is decided who sees them.

        They lie within a leaf's parent, and add little to what the beam covers.
        """
        leaf, parent = self.plan.sides[-1], self.plan.sides[max(len(self.plan.sides) - 2, 0)]
        if self.plan.beam is None:
            return parent
        most_m = OF_BEAM * self.nearest_m * np.ptp(np.clip(self.plan.limits, -1, 1))
        along_m = np.abs(self.surface.steps_m[:2] @ self.along.T)

        def fits(side: tuple[int, int]) -> bool:
            inside = parent[0] % side[0] == parent[1] % side[1] == 0
            return inside and (side @ along_m).max() <= most_m

        side = leaf
        while wider := [each for each in _doubled(side) if fits(each)]:
            side = min(wider, key=lambda each: (each @ along_m).max())
        return side

    def sectors(self, first: int, most: int) -> Iterator[Sector]:
        """Yield all roots, some together: `first`, for a device to begin with, then more.

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
        """Return the geometry of some roots, given by their first pixels [roots, 2]."""
        division, chosen, track, surface = self.division, self.plan, self.track, self.surface
        sides, last = chosen.sides, len(chosen.sides) - 1
        root_m = division.centres_m(0, roots)
        corners = [division.corners(level, roots) for level in range(len(sides))]
        relative_m = [
            division.centres_m(level, each) - root_m[:, None] for level, each in enumerate(corners)
        ]
        together = self._seen.sides[1]
        seen_m = self._seen.centres_m(1, self._seen.corners(1, roots))
        half_m = surface.extents_in(together, sides[0], roots).max(axis=0) / 2
        half_m = half_m[:, None] * surface.steps_m
        seen = visibility.visible_stretches(chosen.limits, track, self.along, seen_m, half_m)
        seen = tuple(each[:, self._seen.parents(2)] for each in seen)
        inside = surface.holds(sides[-1], corners[-1])
        channels = self._used(*(each[inside] for each in seen))
        centres_m = self.phase_centres_m[channels]
        some = replace(track, coordinate=track.coordinate[channels])
        own = None if self.own_drift is None else self.own_drift[channels]
        seen_at = place = some.apparent_coordinates(root_m, centres_m, own)
        nodes = []
        if chosen.nearest:
            position_m = np.broadcast_to(centres_m, (*place.shape, 3))
            for factor in chosen.nearest:
                nodes.append(tree.nearest_nodes(place, position_m, factor))
                place, position_m = nodes[-1].coordinate, nodes[-1].position_m
        else:
            rates = cycles_per_extent(
                track,
                surface,
                root_m,
                surface.extents_in(sides[0], sides[0], roots).max(axis=0),
                chosen.highest_cycles_per_m,
                min(surface.radius_m(sides[-1]), chosen.closest_m),
                chosen.limits,
                self.along,
            )
            for level, side in enumerate(sides):
                extents = chosen.crowding[level] * surface.extents_in(side, sides[0], roots)
                rate = np.einsum("ra,ars->rs", extents, rates)
                if chosen.beam is not None and level == last:
                    rate += chosen.beam_cycles * visibility.beam_rate(
                        chosen.beam, track, self.along, root_m
                    )
                nodes.append(tree.interpolated_channels(track, rate, place, chosen.aperture))
                place = nodes[-1].coordinate
        needs = tree.channel_ranges(division, nodes, seen_at, seen, inside)
        return Sector(roots, root_m, channels, relative_m, nodes, needs, seen_at)

    def _used(self, start: NDArray[np.float64], stop: NDArray[np.float64]) -> slice:
        """Return the channels at places on the track from where leaves are seen; one at least."""
        seen, place = stop > start, self.track.coordinate
        if self.plan.nearest or not seen.any():
            return slice(0, len(place) if self.plan.nearest else 1)
        first = np.searchsorted(place, start[seen].min() - self._slack, "left")
        last = np.searchsorted(place, stop[seen].max() + self._slack, "right")
        return slice(int(min(first, len(place) - 1)), int(max(last, first + 1)))

    def references(self, sector: Sector) -> dict[str, NDArray]:
        """Return how roots see the raw channels, in the order of their nodes, [roots, channels].

        The line, its first sample, the place between samples, phase in cycles and its ramp.
        """
        lines, resampling, half = self.lines, self.plan.resampling, self.plan.half_lengths[0]
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
        start = np.clip(lower + 1 - self.plan.align.taps // 2, -_FAR, _FAR)
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
        """Return what `pairwise_range_m` takes of the channels of a sector."""
        lines, channels = self.lines, self.channels[sector.channels]
        velocity = lines.rx_velocity_m_s
        moving = velocity if velocity is None else velocity[channels]
        return lines.tx_m[channels], lines.rx_m[channels], moving, lines.sound_speed_m_s

    def _ramp(self, sector: Sector) -> NDArray[np.float64]:
        """Return by how many cycles per sample the phase of channels grows beyond their place's."""
        virtual_m = self.track.positions_m(sector.coordinate)
        antennas, plane = self._antennas(sector), self.surface.plane
        stretch = stretches(*antennas, self.drift, plane, sector.root_m, virtual_m)
        return stretch * self.cycles_per_m / self.samples_per_m


def _doubled(side: tuple[int, int]) -> list[tuple[int, int]]:
    """Return a size with twice the rows, and with twice the columns."""
    return [(2 * side[0], side[1]), (side[0], 2 * side[1])]
