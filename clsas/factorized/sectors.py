"""Sectors: some roots of a factorized image with the virtual channels of their subimages."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsas.aperture.beam_directions import beam_rate
from clsas.aperture.dense_channels import SheetRates, all_channels, sheet_beam_rates, sheet_rates
from clsas.aperture.mean_track import MeanTrack
from clsas.aperture.nearest import NearestBeams
from clsas.aperture.phase_rates import cycles_per_extent, stretches
from clsas.aperture.virtual_channels import ChannelRanges, VirtualChannels
from clsas.core.geometry import pairwise_range_m
from clsas.core.grid import Grid
from clsas.core.lines import RangeLines, antennas_of
from clsas.factorized import visibility
from clsas.factorized.geometry import Geometry, geometry_of
from clsas.factorized.leaf_groups import LeafGroups, leaf_groups
from clsas.factorized.surface import Surface, surface_of
from clsas.factorized.tree import channel_ranges
from clsas.opencl.buffers import MARGIN
from clsas.plans.factorization import Factorization
from clsas.sonar.beam import BeamWindow

_FAR = 1 << 28  # samples: off any line, and within int32
_MOST_KEPT_BYTES = 128 << 20  # of sectors, and of groups


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


def sector_of(geometry: Geometry, roots: NDArray[np.int64]) -> Sector:
    """Return the geometry of some roots, given by their first pixels, [roots, 2]."""
    division, track, surface = geometry.division, geometry.track, geometry.surface
    sides, aperture = geometry.factorization.sides, geometry.factorization.aperture
    root_m = division.centres_m(0, roots)
    corners = [division.corners(level, roots) for level in range(len(sides))]
    relative_m = [
        division.centres_m(level, each) - root_m[:, None] for level, each in enumerate(corners)
    ]
    together = geometry.seen.sides[1]
    seen_m = geometry.seen.centres_m(1, geometry.seen.corners(1, roots))
    half_m = surface.extents_in(together, sides[0], roots).max(axis=0) / 2
    half_m = half_m[:, None] * surface.steps_m
    inside = surface.holds(sides[-1], corners[-1])
    channels = slice(0, len(geometry.channels))
    if not track.is_dense:
        begin, end = (
            each[:, geometry.seen.parents(2)]
            for each in visibility.visible_stretches(
                geometry.factorization.limits, track, geometry.along, seen_m, half_m
            )
        )
        channels = aperture.used_channels(
            track.coordinate, begin[inside], end[inside], geometry.slack
        )
    centres_m, some = geometry.phase_centres_m[channels], track.some(channels)
    own = None if geometry.own_drift is None else geometry.own_drift[channels]
    place, across = _apparent(geometry, some, root_m, centres_m, own)
    nodes = _virtual_channels(geometry, roots, root_m, place, across, centres_m)
    if track.is_dense:
        needs = all_channels(nodes, place.shape[1], _holding(geometry, inside))
    else:
        needs = channel_ranges(division, nodes, place, (begin, end), inside)
    return Sector(roots, root_m, channels, relative_m, nodes, needs, place, across)


def _apparent(
    geometry: Geometry,
    some: MeanTrack,
    root_m: NDArray[np.float64],
    centres_m: NDArray[np.float64],
    own: NDArray[np.float64] | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Return coordinates at which channels appear: see `MeanTrack.apparent_places`."""
    if some.across is None or own is not None or not geometry.on_sheet:
        return some.apparent_places(root_m, centres_m, own)
    shape = (len(root_m), len(centres_m))
    return np.broadcast_to(some.coordinate, shape), np.broadcast_to(some.across, shape)


def _holding(geometry: Geometry, inside: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    """Return which subimages hold a pixel, stage by stage, from those of the leaves."""
    result = [inside]
    for level in range(len(geometry.division.sides) - 1, 0, -1):
        held = geometry.division.by_parent(level, result[0])
        result.insert(0, np.any(held, axis=-1))
    return result


def _virtual_channels(
    geometry: Geometry,
    roots: NDArray[np.int64],
    root_m: NDArray[np.float64],
    coordinate: NDArray[np.float64],
    across: NDArray[np.float64] | None,
    centres_m: NDArray[np.float64],
) -> list[VirtualChannels]:
    """Return the virtual channels of some roots, stage by stage, from their raw channels."""
    aperture, sides, track = (
        geometry.factorization.aperture,
        geometry.factorization.sides,
        geometry.track,
    )
    if isinstance(aperture, NearestBeams):
        return aperture.beams(coordinate, centres_m)
    extents = [geometry.surface.extents_in(side, sides[0], roots) for side in sides]
    boxes = _boxes(geometry, roots, root_m)
    if across is not None:
        rates, beam_rates = sheet_rates(track, *boxes), _sheet_beam_rates(geometry, roots, root_m)
        return aperture.on_sheet(track, rates, beam_rates, extents, (coordinate, across))
    rates_along = cycles_per_extent(track, *boxes, geometry.factorization.limits, geometry.along)
    beam = _beam_rate(geometry, roots, root_m)
    return aperture.on_curves(track, rates_along, beam, extents, coordinate)


def _beam_rate(
    geometry: Geometry, roots: NDArray[np.int64], root_m: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Return the phase rates of the beam's weights in some roots: see `beam_rate`."""
    if geometry.beam is None or geometry.along is None:
        return None
    return beam_rate(
        geometry.beam, geometry.track, geometry.along, root_m, _sides_m(geometry, roots)
    )


def _sheet_beam_rates(
    geometry: Geometry, roots: NDArray[np.int64], root_m: NDArray[np.float64]
) -> SheetRates | None:
    """Return the phase rates of the beam's weights in some roots, along and across a sheet."""
    if geometry.beam is None or geometry.directions is None:
        return None
    sides_m = _sides_m(geometry, roots)
    return sheet_beam_rates(geometry.beam, geometry.track, geometry.directions, root_m, sides_m)


def _sides_m(geometry: Geometry, roots: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the sides of the largest of some roots, [axes, 3]."""
    side = geometry.factorization.sides[0]
    extents = geometry.surface.extents_in(side, side, roots).max(axis=0)
    return extents[:, None] * geometry.surface.steps_m


def _boxes(
    geometry: Geometry, roots: NDArray[np.int64], root_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float, float]:
    """Return roots as boxes of `cycles_per_extent`: its steps to its nearest range."""
    image, surface = geometry.factorization, geometry.surface
    extents = surface.extents_in(image.sides[0], image.sides[0], roots).max(axis=0)
    nearest_m = min(surface.radius_m(image.sides[-1]), image.closest_m)
    return surface.steps_m, root_m, extents, image.highest_cycles_per_m, nearest_m


def references(geometry: Geometry, sector: Sector) -> dict[str, NDArray]:
    """Return how roots align the raw channels, in the order of their nodes, [roots, channels].

    By name: the line, its first sample, the position between samples, the phase in cycles and
    its change per sample.
    """
    lines, resampling, half = (
        geometry.lines,
        geometry.factorization.resampling,
        geometry.factorization.half_lengths[0],
    )
    nodes = sector.nodes[0]
    channels = geometry.channels[sector.channels]
    range_m = pairwise_range_m(sector.root_m, *antennas_of(geometry.lines, channels))
    place = (range_m - lines.first_range_m[channels]) / lines.range_step_m
    place += resampling.lead
    cycles = lines.carrier_cycles_per_m * range_m
    cycles += place * resampling.centre_cycles_per_sample
    cycles -= np.rint(cycles)
    place *= resampling.ratio
    place += MARGIN - resampling.first - half
    lower = np.floor(place)
    start = np.clip(lower + 1 - geometry.factorization.align.taps // 2, -_FAR, _FAR)
    channel = np.broadcast_to(channels, place.shape)
    references = {
        "order": nodes.ordered(channel).astype(np.int32),
        "start": nodes.ordered(start).astype(np.int32),
        "nu": nodes.ordered(place - lower - 0.5).astype(np.float32),
        "cycles": nodes.ordered(cycles).astype(np.float32),
    }
    if geometry.ramps:
        references["ramp"] = nodes.ordered(_ramp(geometry, sector)).astype(np.float32)
    return references


def _ramp(geometry: Geometry, sector: Sector) -> NDArray[np.float64]:
    """Return cycles per sample by which channels' phases grow faster than the mean of all."""
    virtual_m = geometry.track.positions_m(sector.coordinate, sector.across)
    tx_m, rx_m, velocity, speed = antennas_of(geometry.lines, geometry.channels[sector.channels])
    plane = geometry.surface.plane
    stretch = stretches(
        tx_m, rx_m, velocity, speed, geometry.drift, plane, sector.root_m, virtual_m
    )
    more = (stretch - geometry.factorization.stretch) / (1 + geometry.factorization.stretch)
    return more * geometry.cycles_per_m / geometry.samples_per_m


class Roots:
    """What all images of a geometry share, found when it is first needed.

    Nothing of it depends on samples. Sectors, and groups of points off a plane, are kept for the
    next image unless they take much memory.

    Parameters
    ----------
    lines, grid, factorization, beam
        What is imaged, and how.
    track, surface : optional
        Results of planning: see `geometry_of`.
    """

    def __init__(
        self,
        lines: RangeLines,
        grid: Grid,
        factorization: Factorization,
        beam: BeamWindow | None,
        *,
        track: MeanTrack | None = None,
        surface: Surface | None = None,
    ) -> None:
        self._given = lines, grid, factorization, beam, track, surface
        self._sectors: list[Sector] | None = None
        self._groups: LeafGroups | None = None

    @functools.cached_property
    def geometry(self) -> Geometry:
        """Geometry of lines and roots."""
        lines, grid, factorization, beam, track, surface = self._given
        return geometry_of(lines, surface or surface_of(grid), factorization, beam, track)

    def sectors(self, first: int, most: int) -> Iterator[Sector]:
        """Yield all roots in sectors: of `first` roots, for a device to begin with, then more."""
        if self._sectors is not None:
            yield from self._sectors
            return
        roots, start, count = self.geometry.roots, 0, min(first, most)
        found: list[Sector] | None = []
        while start < len(roots):
            sector = sector_of(self.geometry, roots[start : start + count])
            yield sector
            start, count = start + count, min(2 * count, most)
            if found is not None:
                found.append(sector)
                if sum(each.nbytes for each in found) > _MOST_KEPT_BYTES:
                    found = None
        self._sectors = found

    def groups(self, width: int) -> LeafGroups:
        """Return the groups of points of all leaves, for a device of some width."""
        if self._groups is not None:
            return self._groups
        found = leaf_groups(self.geometry, width)
        if found.nbytes <= _MOST_KEPT_BYTES:
            self._groups = found
        return found
