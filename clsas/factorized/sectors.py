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
from clsas.aperture.phase_rates import PhaseBoxes, cycles_per_extent, stretches
from clsas.aperture.virtual_channels import ChannelRanges, VirtualChannels
from clsas.core.geometry import pairwise_range_m
from clsas.core.lines import antennas_of
from clsas.factorized import visibility
from clsas.factorized.geometry import Geometry, geometry_of
from clsas.factorized.leaf_groups import LeafGroups, leaf_groups
from clsas.factorized.tree import channel_ranges
from clsas.opencl.buffers import MARGIN
from clsas.plans.factorization import Factorization
from clsas.scene import Scene

_FAR = 1 << 28  # samples; beyond the end of any line, and within int32
_MOST_KEPT_BYTES = 128 << 20  # kept of sectors, and of groups, for the next image


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
        Raw channels from which any of the roots is visible, in the order of the track.
    relative_m : list of float64 [roots, subimages, 3]
        Centres of subimages relative to those of their roots, stage by stage.
    virtual : list of VirtualChannels
        Virtual channels, stage by stage.
    needs : list of ChannelRanges
        Virtual channels of each subimage and the channels that it combines, stage by stage.
    coordinate : float64 [roots, channels]
        Apparent aperture coordinates of the raw channels.
    across : float64 [roots, channels] or None
        Their apparent coordinates across a sheet; None without a sheet.
    """

    roots: NDArray[np.int64]
    root_m: NDArray[np.float64]
    channels: slice
    relative_m: list[NDArray[np.float64]]
    virtual: list[VirtualChannels]
    needs: list[ChannelRanges]
    coordinate: NDArray[np.float64]
    across: NDArray[np.float64] | None = None

    @property
    def nbytes(self) -> int:
        """Approximate memory of all arrays."""
        parts = [self, *self.virtual, *self.needs]
        arrays = [value for part in parts for value in vars(part).values()] + self.relative_m
        return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))

    def stride(self, level: int) -> int:
        """Return the largest number of virtual channels of any subimage of a stage."""
        need = self.needs[level]
        return int((need.last - need.first).max())

    def positions_m(self, level: int) -> NDArray[np.float64]:
        """Return positions of a stage's virtual channels relative to the centres of their roots."""
        return self.virtual[level].position_m - self.root_m[:, None]


def sector_of(geometry: Geometry, roots: NDArray[np.int64]) -> Sector:
    """Return the sector of some roots, given by their first pixels, [roots, 2]."""
    division, track = geometry.division, geometry.track
    sides, aperture = geometry.factorization.sides, geometry.factorization.aperture
    root_m = division.centres_m(0, roots)
    corners = [division.corners(level, roots) for level in range(len(sides))]
    relative_m = [
        division.centres_m(level, each) - root_m[:, None] for level, each in enumerate(corners)
    ]
    inside = geometry.surface.holds(sides[-1], corners[-1])
    channels = slice(0, len(geometry.channels))
    visible = None if track.is_dense else _visible_stretches(geometry, roots)
    if visible is not None:
        begin, end = (each[inside] for each in visible)
        channels = aperture.used_channels(track.coordinate, begin, end, geometry.slack)
    centres_m = geometry.phase_centres_m[channels]
    coordinate, across = _apparent(geometry, channels, root_m)
    virtual = _virtual_channels(geometry, roots, root_m, coordinate, across, centres_m)
    if visible is None:
        needs = all_channels(virtual, coordinate.shape[1], _holding(geometry, inside))
    else:
        needs = channel_ranges(division, virtual, coordinate, visible, inside)
    return Sector(roots, root_m, channels, relative_m, virtual, needs, coordinate, across)


def _visible_stretches(
    geometry: Geometry, roots: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return aperture coordinates between which leaves are visible, [roots, leaves] each."""
    rectangles, root = geometry.rectangles, geometry.factorization.sides[0]
    middles_m = rectangles.centres_m(1, rectangles.corners(1, roots))
    extents = geometry.surface.extents_in(rectangles.sides[1], root, roots).max(axis=0)
    half_m = (extents / 2)[:, None] * geometry.surface.steps_m
    limits, along = geometry.factorization.limits, geometry.along
    begin, end = visibility.visible_stretches(limits, geometry.track, along, middles_m, half_m)
    of_leaf = rectangles.parents(2)
    return begin[:, of_leaf], end[:, of_leaf]


def _apparent(
    geometry: Geometry, channels: slice, root_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Return the coordinates at which channels appear from the centres of roots.

    See `MeanTrack.apparent_coordinates`.
    """
    track = geometry.track.some(channels)
    drift = None if geometry.own_drift is None else geometry.own_drift[channels]
    if track.is_sheet and drift is None and geometry.on_track:
        return track.coordinates_everywhere(len(root_m))
    return track.apparent_coordinates(root_m, geometry.phase_centres_m[channels], drift)


def _holding(geometry: Geometry, inside: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    """Return which subimages contain a pixel, stage by stage, from the same for the leaves."""
    result = [inside]
    for level in range(len(geometry.division.sides) - 1, 0, -1):
        children = geometry.division.by_parent(level, result[0])
        result.insert(0, np.any(children, axis=-1))
    return result


def _virtual_channels(
    geometry: Geometry,
    roots: NDArray[np.int64],
    root_m: NDArray[np.float64],
    coordinate: NDArray[np.float64],
    across: NDArray[np.float64] | None,
    centres_m: NDArray[np.float64],
) -> list[VirtualChannels]:
    """Return the virtual channels of some roots, stage by stage."""
    aperture, sides, track = (
        geometry.factorization.aperture,
        geometry.factorization.sides,
        geometry.track,
    )
    if isinstance(aperture, NearestBeams):
        return aperture.virtual_channels(coordinate, centres_m)
    extents = [geometry.surface.extents_in(side, sides[0], roots) for side in sides]
    boxes = _boxes(geometry, roots, root_m)
    if across is not None:
        rates, beam_rates = sheet_rates(track, boxes), _sheet_beam_rates(geometry, roots, root_m)
        return aperture.on_sheet(track, rates, beam_rates, extents, (coordinate, across))
    rates_along = cycles_per_extent(track, boxes, geometry.factorization.limits, geometry.along)
    beam = _beam_rate(geometry, roots, root_m)
    return aperture.on_curves(track, rates_along, beam, extents, coordinate)


def _beam_rate(
    geometry: Geometry, roots: NDArray[np.int64], root_m: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Return the rates of the beam's weights in some roots on curves: see `beam_rate`."""
    if geometry.beam is None or geometry.along is None:
        return None
    return beam_rate(
        geometry.beam, geometry.track, geometry.along, root_m, _sides_m(geometry, roots)
    )


def _sheet_beam_rates(
    geometry: Geometry, roots: NDArray[np.int64], root_m: NDArray[np.float64]
) -> SheetRates | None:
    """Return the rates of the beam's weights in some roots, along and across a sheet."""
    if geometry.beam is None or geometry.directions is None:
        return None
    sides_m = _sides_m(geometry, roots)
    return sheet_beam_rates(geometry.beam, geometry.track, geometry.directions, root_m, sides_m)


def _sides_m(geometry: Geometry, roots: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the sides of a box as large as the largest of some roots, [axes, 3]."""
    side = geometry.factorization.sides[0]
    extents = geometry.surface.extents_in(side, side, roots).max(axis=0)
    return extents[:, None] * geometry.surface.steps_m


def _boxes(geometry: Geometry, roots: NDArray[np.int64], root_m: NDArray[np.float64]) -> PhaseBoxes:
    """Return boxes around some roots."""
    image, surface = geometry.factorization, geometry.surface
    extents = surface.extents_in(image.sides[0], image.sides[0], roots).max(axis=0)
    nearest_m = min(surface.radius_m(image.sides[-1]), image.closest_m)
    return PhaseBoxes(surface.steps_m, root_m, extents, image.highest_cycles_per_m, nearest_m)


def references(geometry: Geometry, sector: Sector) -> dict[str, NDArray]:
    """Return the shifts and phases by which roots align raw channels, by names of kernel tables.

    Arrays are [roots, channels], in the order in which channels are added. They are the line, its
    first sample, the position between samples, the phase in cycles and its change per sample.
    """
    lines, resampling, half = (
        geometry.lines,
        geometry.factorization.resampling,
        geometry.factorization.half_lengths[0],
    )
    virtual = sector.virtual[0]
    channels = geometry.channels[sector.channels]
    range_m = pairwise_range_m(sector.root_m, *antennas_of(geometry.lines, channels))
    if geometry.corrections is not None:
        range_m += _beyond_usual_m(geometry, sector, channels)
    position = (range_m - lines.first_range_m[channels]) / lines.range_step_m
    position += resampling.lead
    cycles = lines.carrier_cycles_per_m * range_m
    cycles += position * resampling.centre_cycles_per_sample
    cycles -= np.rint(cycles)
    position *= resampling.ratio
    position += MARGIN - resampling.first - half
    lower = np.floor(position)
    start = np.clip(lower + 1 - geometry.factorization.align.taps // 2, -_FAR, _FAR)
    channel = np.broadcast_to(channels, position.shape)
    references = {
        "order": virtual.ordered(channel).astype(np.int32),
        "start": virtual.ordered(start).astype(np.int32),
        "nu": virtual.ordered(position - lower - 0.5).astype(np.float32),
        "cycles": virtual.ordered(cycles).astype(np.float32),
    }
    if geometry.ramps:
        references["ramp"] = virtual.ordered(_ramp(geometry, sector)).astype(np.float32)
    return references


def _beyond_usual_m(
    geometry: Geometry, sector: Sector, channels: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the corrections of raw channels beyond those of virtual ones, [roots, channels].

    Leaves correct the ranges of virtual channels, whose receivers are as far from transmitters as
    usual.
    """
    corrections = geometry.corrections
    assert corrections is not None
    antennas = corrections.antennas[channels]
    usual = corrections.usual(antennas[:, :3])
    beyond = corrections.weights(antennas) - corrections.weights(usual)
    middle = sector.roots + np.array(geometry.division.sides[0]) // 2
    return corrections.at(geometry.surface.pixels_in(middle)) @ beyond.T


def _ramp(geometry: Geometry, sector: Sector) -> NDArray[np.float64]:
    """Return the excess of each channel's phase rate over the mean of all, cycles per sample."""
    virtual_m = geometry.track.positions_m(sector.coordinate, sector.across)
    tx_m, rx_m, velocity, speed = antennas_of(geometry.lines, geometry.channels[sector.channels])
    plane = geometry.surface.plane
    stretch = stretches(
        tx_m, rx_m, velocity, speed, geometry.drift, plane, sector.root_m, virtual_m
    )
    more = (stretch - geometry.factorization.stretch) / (1 + geometry.factorization.stretch)
    return more * geometry.cycles_per_m / geometry.samples_per_m


class Roots:
    """Geometry and sectors that all images of the same geometry share.

    They do not depend on samples, and are computed when they are first needed. Sectors, and groups
    of points off a plane, are kept for the next image unless they need much memory.

    Parameters
    ----------
    scene : Scene
    factorization : Factorization
    track : MeanTrack, optional
        The mean track, if planning has found it.
    """

    def __init__(
        self, scene: Scene, factorization: Factorization, track: MeanTrack | None = None
    ) -> None:
        self._scene, self._factorization, self._track = scene, factorization, track
        self._sectors: list[Sector] | None = None
        self._groups: LeafGroups | None = None

    @functools.cached_property
    def geometry(self) -> Geometry:
        """Geometry of lines and roots."""
        return geometry_of(self._scene, self._factorization, self._track)

    def sectors(self, first: int, most: int) -> Iterator[Sector]:
        """Yield all roots in sectors: a first one of `first` roots, then up to `most` in each.

        The first is small, so that the device can start early.
        """
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
        """Return the groups of points of all leaves, for a device with `width` lanes."""
        if self._groups is not None:
            return self._groups
        found = leaf_groups(self.geometry, width)
        if found.nbytes <= _MOST_KEPT_BYTES:
            self._groups = found
        return found
