"""The tree of a factorized image on the host, in float64: what stages and leaves need to know.

Factorized backprojection is fast because subimages form a tree, along which subapertures merge from
stage to stage (McCorkle and Rofheart 1996; Yegulalp 1999; Ulander, Hellsten and Stenström 2003).

A *root* is one of the largest subimages, a *leaf* one of the smallest. All subimages of one size
are a *level* of the tree, whose lines one *stage* forms. The host prepares roots in *sectors*, and
the device forms them in *batches*, several to a sector.

`geometry_of` finds what all subimages share: the mean track and its channels. The roots of the tree
are then prepared in sectors. `sector_of` places the virtual channels of their subimages and finds
the channels that each combines. `references` computes by how much the raw channels are shifted and
turned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.lines import RangeLines, antennas_of, band_wavelength_m
from clsas.engine.data.surface import Surface
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.visibility import BeamTrack, Boxes, sine_width
from clsas.engine.device.buffers import MARGIN
from clsas.engine.factorized.phase_rates import (
    BeamDirections,
    PhaseBoxes,
    beam_rate,
    cycles_per_extent,
    directions_of,
    drift,
    own_drift,
    sheet_beam_rates,
    sheet_rates,
    stretches,
)
from clsas.engine.factorized.plan import Factorization
from clsas.engine.factorized.track import MeanTrack, mean_track_of
from clsas.engine.factorized.virtual_channels import (
    ChannelRanges,
    NearestBeams,
    VirtualChannels,
    all_channels,
)
from clsas.engine.scene import Scene
from clsas.engine.water.ray_corrections import Corrections

BEAM_MARGIN = 1 / 16
"""Width by which finding visibility for a rectangle of leaves may widen it, in beam widths."""

_ON_TRACK = 1e-4  # distance within which channels lie on the mean track, wavelengths
_SHAPES = {"strips": "several passes", "sheet": "a sheet"}
_STEP = 2  # step between the samples of the track at which visibility is evaluated
_MARGIN = 0.2  # margin for motion of the beam between such samples, in steps between them
_FAR = 1 << 28  # samples; beyond the end of any line, and within int32


@dataclass(frozen=True)
class Tree:
    """Subimages of several sizes on a surface, each size within the one before.

    Attributes
    ----------
    surface : Surface
    sides : tuple of (rows, columns)
        Sizes of subimages in cells, from the roots to the leaves. Each divides the one before.
    """

    surface: Surface
    sides: tuple[tuple[int, int], ...]

    @property
    def roots(self) -> NDArray[np.int64]:
        """First row and column of each root, [roots, 2], row by row.

        The rows of most grids are along the track, so that successive roots use the same samples.
        """
        rows, columns = (
            np.arange(0, n, side)
            for n, side in zip(self.surface.plane.shape, self.sides[0], strict=True)
        )
        down, across = np.meshgrid(rows, columns, indexing="ij")
        return np.stack([down.ravel(), across.ravel()], axis=1)

    def per_root(self, level: int) -> int:
        """Return the number of subimages of a level within a root."""
        return math.prod(self._divided(0, level))

    def corners(self, level: int, roots: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return first rows and columns of the subimages of a level within some roots.

        The result is [roots, subimages, 2], with the subimages of a root in row order.
        """
        down, across = self._divided(0, level)
        inside: NDArray[np.int64] = np.stack(np.divmod(np.arange(down * across), across), axis=1)
        return roots[:, None] + inside * self.sides[level]

    def centres_m(self, level: int, corners: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the middles of subimages whose first cells are `corners`, [..., 3]."""
        return self.surface.middles_m(self.sides[level], corners)

    def parents(self, level: int) -> NDArray[np.int64]:
        """Return the number of each subimage's parent on the level before, [subimages]."""
        down, across = self._divided(0, level)
        rows, columns = self._divided(level - 1, level)
        row, column = np.divmod(np.arange(down * across), across)
        return row // rows * (across // columns) + column // columns

    def by_parent(self, level: int, values: NDArray) -> NDArray:
        """Return values [roots, subimages], sorted by the parents of subimages.

        The result is [roots, parents, subimages of each parent].
        """
        down, across = self._divided(0, level - 1)
        rows, columns = self._divided(level - 1, level)
        split = values.reshape(len(values), down, rows, across, columns).swapaxes(2, 3)
        return split.reshape(len(values), down * across, rows * columns)

    def _divided(self, level: int, later: int) -> tuple[int, int]:
        """Return the rows and columns of a later level's subimages within a subimage of a level."""
        (rows, columns), (less_rows, less_columns) = self.sides[level], self.sides[later]
        return rows // less_rows, columns // less_columns


@dataclass(frozen=True, eq=False)
class Geometry:
    """Mean track, channels and subimages of an image, in float64.

    Channels are in the order of the track. The geometry contains no samples, and serves any number
    of images.

    Attributes
    ----------
    lines : RangeLines
        The given lines without their samples.
    surface : Surface
    factorization : Factorization
    beam : BeamWindow or None
    tree : Tree
        Subimages of all stages.
    rectangles : Tree
        Roots, rectangles of leaves whose visibility is computed together, and leaves.
    roots : int64 [roots, 2]
        First cells of the roots in the order in which they are formed.
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
        See `clsas.engine.factorized.phase_rates`.
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
    tree: Tree
    rectangles: Tree
    roots: NDArray[np.int64]
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


def track_for(scene: Scene, factorization: Factorization) -> MeanTrack | None:
    """Return the mean track of a scene of the shape that a factorization has, None without one."""
    centre = factorization.resampling.centre_cycles_per_sample
    wavelength_m = band_wavelength_m(scene.lines, centre)
    return mean_track_of(scene.lines, factorization.aperture.shape, wavelength_m)


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
    resampling, sides = factorization.resampling, factorization.sides
    wavelength_m = band_wavelength_m(lines, resampling.centre_cycles_per_sample)
    shape, track = factorization.aperture.shape, track or track_for(scene, factorization)
    if track is None:
        raise ArgumentError(
            "lines",
            "have channels at more than one place for a plan that divides the image"
            if shape == "track"
            else f"have channels that lie on {_SHAPES[shape]}, as the plan assumes",
        )

    tree = Tree(surface, sides)
    roots, rectangle = tree.roots, sides[max(len(sides) - 2, 0)]
    directions = along = nearest_m = None
    if beam is not None and scene.along is not None:
        directions = directions_of(beam, scene.along, track)
        along = directions.at(track.samples)
        nearest_m = float(cdist(tree.centres_m(0, roots), lines.phase_centres_m).min())
        if factorization.limits is not None:
            rectangle = _rectangle(surface, sides, factorization.limits, along, nearest_m)
        # Roots that are visible from the same channels follow each other.
        advance = np.abs(surface.steps_m[:2] @ along.mean(axis=0))
        slow = int(np.argmax(advance * sides[0]))
        roots = roots[np.lexsort((roots[:, 1 - slow], roots[:, slow]))]

    channels = np.argsort(track.coordinate, kind="stable")
    track = track.some(channels)
    phase_centres_m = lines.phase_centres_m[channels]
    off_m = float(np.abs(track.offsets_m(phase_centres_m)).max())
    close_m = _ON_TRACK * wavelength_m
    on_track = off_m <= close_m
    own = own_drift(lines)
    if own is not None:
        off_m += np.linalg.norm(own, axis=1).max() * np.abs(lines.last_range_m).max()
    ramps = factorization.aperture.aligns_phases and (lines.paths_differ or off_m > close_m)
    # The apparent coordinate of a channel off the track depends on the point.
    slowest_m = np.linalg.norm(track.sampled_m[1], axis=1).min()
    return Geometry(
        lines=lines.without_samples(),
        surface=surface,
        factorization=factorization,
        beam=beam,
        tree=tree,
        rectangles=Tree(surface, (sides[0], rectangle, sides[-1])),
        roots=roots,
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


def _rectangle(
    surface: Surface,
    sides: tuple[tuple[int, int], ...],
    limits: tuple[float, float],
    along: NDArray[np.float64],
    nearest_m: float,
) -> tuple[int, int]:
    """Return the size of rectangles of leaves whose visibility is computed together.

    They lie within the parent of a leaf. The stretch of the track from which a rectangle is visible
    exceeds that of a leaf by no more than `BEAM_MARGIN`.
    """
    parent, side = sides[max(len(sides) - 2, 0)], sides[-1]
    most_m = BEAM_MARGIN * nearest_m * sine_width(limits)
    along_m = np.abs(surface.steps_m[:2] @ along.T)
    while True:
        doubled = [(2 * side[0], side[1]), (side[0], 2 * side[1])]
        fitting = [
            (rows, columns)
            for rows, columns in doubled
            if parent[0] % rows == parent[1] % columns == 0
            and ((rows, columns) @ along_m).max() <= most_m
        ]
        if not fitting:
            return side
        side = min(fitting, key=lambda each: (each @ along_m).max())


@dataclass(frozen=True, eq=False)
class Sector:
    """Some roots with the virtual channels of their subimages.

    Attributes
    ----------
    first : int
        Number of the first root among `Geometry.roots`.
    roots : int64 [roots, 2]
        First cells.
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
    most_channels : tuple of int
        Largest number of virtual channels of a subimage, stage by stage.
    coordinate : float64 [roots, channels]
        Apparent aperture coordinates of the raw channels.
    across : float64 [roots, channels] or None
        Their apparent coordinates across a sheet; None without a sheet.
    """

    first: int
    roots: NDArray[np.int64]
    root_m: NDArray[np.float64]
    channels: slice
    relative_m: list[NDArray[np.float64]]
    virtual: list[VirtualChannels]
    needs: list[ChannelRanges]
    most_channels: tuple[int, ...]
    coordinate: NDArray[np.float64]
    across: NDArray[np.float64] | None

    @property
    def has_lines(self) -> bool:
        """True if every stage has a subimage with a virtual channel."""
        return all(self.most_channels)

    @property
    def nbytes(self) -> int:
        """Approximate memory of all arrays."""
        parts = [self, *self.virtual, *self.needs]
        arrays = [value for part in parts for value in vars(part).values()] + self.relative_m
        return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))

    def positions_m(self, level: int) -> NDArray[np.float64]:
        """Return positions of a stage's virtual channels relative to the centres of their roots."""
        return self.virtual[level].position_m - self.root_m[:, None]


def sector_of(geometry: Geometry, first: int, stop: int) -> Sector:
    """Return the sector of the roots `first` to `stop - 1` of a geometry."""
    tree, surface, track = geometry.tree, geometry.surface, geometry.track
    aperture, sides = geometry.factorization.aperture, geometry.factorization.sides
    roots = geometry.roots[first:stop]
    root_m = tree.centres_m(0, roots)
    corners = [tree.corners(level, roots) for level in range(len(sides))]
    relative_m = [
        tree.centres_m(level, each) - root_m[:, None] for level, each in enumerate(corners)
    ]
    inside = surface.holds(sides[-1], corners[-1])

    # The raw channels from which leaves are visible. Dense apertures use all.
    visible, channels = None, slice(0, len(geometry.channels))
    if not track.is_dense:
        visible = _leaf_stretches(geometry, roots)
        begin, end = (each[inside] for each in visible)
        channels = aperture.used_channels(track.coordinate, begin, end, geometry.slack)
    own = None if geometry.own_drift is None else geometry.own_drift[channels]
    across: NDArray[np.float64] | None
    if track.is_sheet and own is None and geometry.on_track:
        coordinate, across = track.some(channels).coordinates_everywhere(len(root_m))
    else:
        coordinate, across = track.some(channels).apparent_coordinates(
            root_m, geometry.phase_centres_m[channels], own
        )

    if isinstance(aperture, NearestBeams):
        virtual = aperture.virtual_channels(coordinate, geometry.phase_centres_m[channels])
    else:
        virtual = _virtual_channels(geometry, roots, root_m, coordinate, across)

    if visible is not None:
        needs = channel_ranges(tree, virtual, coordinate, visible, inside)
    else:
        holding = [inside]  # True for subimages with a pixel, stage by stage
        for level in range(len(sides) - 1, 0, -1):
            holding.insert(0, np.any(tree.by_parent(level, holding[0]), axis=-1))
        needs = all_channels(virtual, coordinate.shape[1], holding)
    most_channels = tuple(int((need.last - need.first).max()) for need in needs)
    return Sector(
        first=first,
        roots=roots,
        root_m=root_m,
        channels=channels,
        relative_m=relative_m,
        virtual=virtual,
        needs=needs,
        most_channels=most_channels,
        coordinate=coordinate,
        across=across,
    )


def _leaf_stretches(
    geometry: Geometry, roots: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return aperture coordinates between which leaves are visible, [roots, leaves] each."""
    rectangles, surface = geometry.rectangles, geometry.surface
    middles_m = rectangles.centres_m(1, rectangles.corners(1, roots))
    extents = surface.extents_in(rectangles.sides[1], rectangles.sides[0], roots).max(axis=0)
    half_m = (extents / 2)[:, None] * surface.steps_m
    limits = geometry.factorization.limits
    begin, end = visible_stretches(limits, geometry.track, geometry.along, middles_m, half_m)
    of_leaf = rectangles.parents(2)
    return begin[:, of_leaf], end[:, of_leaf]


def visible_stretches(
    limits: tuple[float, float] | None,
    track: MeanTrack,
    along: NDArray[np.float64] | None,
    centres_m: NDArray[np.float64],
    half_m: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the stretch of the track from which each box is visible.

    Parameters
    ----------
    limits : (low, high), optional
        Sines of the aspect angle at which the beam begins and ends. Without them, each box is
        visible from everywhere.
    track : MeanTrack
    along : float64 [samples, 3]
        The track's direction at `track.samples`; not needed without limits.
    centres_m : float64 [..., 3]
        Middles of the boxes.
    half_m : float64 [axes, 3]
        Half the sides of the boxes, as vectors.

    Returns
    -------
    begin, end : float64 [...]
        First and last aperture coordinate. Where a box is visible from an end of the track, that
        one is infinite, because virtual channels lie beyond the ends too. Where a box is invisible,
        both are -inf.
    """
    shape = centres_m.shape[:-1]
    if limits is None or along is None:
        return np.full(shape, -np.inf), np.full(shape, np.inf)
    on_track = np.flatnonzero(track.on_track)[::_STEP]
    coordinate, last = track.samples[on_track], len(on_track) - 1
    beam = BeamTrack(limits, track.sampled_m[0][on_track], along[on_track])
    boxes = Boxes.equal(centres_m.reshape(-1, 3), half_m)
    spans = beam.spans(boxes)
    begin, end = np.full(len(boxes), -np.inf), np.full(len(boxes), -np.inf)

    # A box outside the beams of all samples may be visible from a point between two samples.
    bounds = np.concatenate([[-np.inf], coordinate[1:-1], [np.inf]])
    ever = spans.earliest <= spans.latest
    begin[ever] = bounds[np.maximum(spans.earliest[ever] - 1, 0)]
    end[ever] = bounds[np.minimum(spans.latest[ever] + 1, last)]

    # The beam begins to touch the others between the outermost sample that does and the next one.
    found = np.flatnonzero(spans.first <= spans.last)
    for edge, outermost, outward in ((begin, spans.first[found], -1), (end, spans.last[found], 1)):
        index = outermost[:, None] + outward * np.array([1, 0, -1])
        index = index.clip(0, last)
        outside, inside, further = beam.depth(boxes[found], index).T
        # The depth changes almost linearly between two samples, unless its maximum is there.
        even = (further > inside) & (outside <= 0)
        share = np.divide(outside, outside - inside, out=np.full(len(found), _MARGIN), where=even)
        share = (share - _MARGIN).clip(0)
        next_one = coordinate[index[:, 0]]
        crossing = next_one + share * (coordinate[outermost] - next_one)
        at_end = outermost == (0 if outward < 0 else last)
        edge[found] = np.where(at_end, outward * np.inf, crossing)
    return begin.reshape(shape), end.reshape(shape)


def _virtual_channels(
    geometry: Geometry,
    roots: NDArray[np.int64],
    root_m: NDArray[np.float64],
    coordinate: NDArray[np.float64],
    across: NDArray[np.float64] | None,
) -> list[VirtualChannels]:
    """Return virtual channels as dense as phases and beam in some roots need, stage by stage."""
    surface, track, beam = geometry.surface, geometry.track, geometry.beam
    factorization, along = geometry.factorization, geometry.along
    sides, aperture = factorization.sides, factorization.aperture
    assert not isinstance(aperture, NearestBeams)
    extents = [surface.extents_in(side, sides[0], roots) for side in sides]
    largest = extents[0].max(axis=0)
    sides_m = largest[:, None] * surface.steps_m
    nearest_m = min(surface.radius_m(sides[-1]), factorization.closest_m)
    boxes = PhaseBoxes(
        surface.steps_m, root_m, largest, factorization.highest_cycles_per_m, nearest_m
    )
    if across is None:
        rates = cycles_per_extent(track, boxes, factorization.limits, along)
        of_beam = None
        if beam is not None and along is not None:
            of_beam = beam_rate(beam, track, along, root_m, sides_m)
        return aperture.on_curves(track, rates, of_beam, extents, coordinate)
    rates_on_sheet, of_beam_on_sheet = sheet_rates(track, boxes), None
    if beam is not None and geometry.directions is not None:
        of_beam_on_sheet = sheet_beam_rates(beam, track, geometry.directions, root_m, sides_m)
    return aperture.on_sheet(track, rates_on_sheet, of_beam_on_sheet, extents, (coordinate, across))


def channel_ranges(
    tree: Tree,
    virtual: list[VirtualChannels],
    coordinate: NDArray[np.float64],
    visible: tuple[NDArray[np.float64], NDArray[np.float64]],
    inside: NDArray[np.bool_],
) -> list[ChannelRanges]:
    """Return the channels that each subimage needs, stage by stage.

    Multiplied by the beam's weights, a steering function is 0 outside the stretch of the track from
    which the subimage is visible. Channels and virtual channels outside it are omitted, even if the
    taps of a filter extend to them.

    Parameters
    ----------
    tree : Tree
    virtual : list of VirtualChannels
        Virtual channels, stage by stage.
    coordinate : float64 [roots, channels]
        Apparent aperture coordinates of the raw channels.
    visible : two float64 [roots, leaves]
        Aperture coordinates between which each leaf is visible.
    inside : bool [roots, leaves]
        True for leaves that contain a pixel.
    """
    coordinates = [virtual[0].ordered(coordinate), *(each.coordinate for each in virtual)]
    # Trailing virtual channels to which no channel contributes are empty.
    counts = [np.full((len(coordinate), 1), coordinate.shape[1])]
    for each in virtual:
        counts.append(np.take_along_axis(each.base, counts[-1] - 1, axis=1) + each.taps)

    # From the leaves to the roots: a parent is visible from wherever one of its children is.
    empty = ~inside | (visible[1] <= visible[0])
    start, stop = np.where(empty, np.inf, visible[0]), np.where(empty, -np.inf, visible[1])
    result: list[ChannelRanges] = []
    for level in reversed(range(len(virtual))):
        begin, end = _between(coordinates[level], counts[level], start, stop, nearest=level > 0)
        first, last = _between(coordinates[level + 1], counts[level + 1], start, stop, nearest=True)
        ranges = ChannelRanges(first, last, begin, end)
        _clear(ranges, (end <= begin) | (last <= first) | (stop < start))
        result.insert(0, ranges)
        if level:
            start = tree.by_parent(level, start).min(axis=-1)
            stop = tree.by_parent(level, stop).max(axis=-1)

    # Parents that are visible only from a gap of the track have no virtual channels.
    for level in range(1, len(virtual)):
        parent = result[level - 1]
        _clear(result[level], (parent.last <= parent.first)[:, tree.parents(level)])
    return result


def _clear(ranges: ChannelRanges, empty: NDArray[np.bool_]) -> None:
    """Make the ranges of some subimages empty."""
    for array in (ranges.first, ranges.last, ranges.begin, ranges.end):
        array[empty] = 0


def _between(
    coordinates: NDArray[np.float64],
    counts: NDArray[np.int64],
    start: NDArray[np.float64],
    stop: NDArray[np.float64],
    *,
    nearest: bool,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first of ascending coordinates from start to stop, and the one after the last.

    With `nearest`, a stretch that lies between two coordinates gets both of them. Coordinates are
    [roots, n], start and stop [roots, subimages].
    """
    # A single search serves all roots, whose coordinates are shifted apart and concatenated.
    least, most = coordinates[:, 0].min(), coordinates[:, -1].max()
    root = np.arange(len(coordinates))[:, None]
    apart, before = root * (most - least + 2), root * coordinates.shape[1]
    every = (coordinates + apart).ravel()
    start, stop = (np.clip(each, least - 1, most + 1) + apart for each in (start, stop))
    first = np.searchsorted(every, start, "left") - before
    last = np.searchsorted(every, stop, "right") - before
    if nearest:
        between = last <= first
        first, last = first - between, last + between
    return np.clip(first, 0, counts), np.clip(last, 0, counts)


def references(geometry: Geometry, sector: Sector) -> dict[str, NDArray]:
    """Return the shifts and phases by which roots align raw channels, by names of kernel tables.

    Arrays are [roots, channels], in the order in which channels are added. They are the line, its
    first sample, the position between samples, the phase in cycles and its change per sample.
    """
    lines, factorization, corrections = geometry.lines, geometry.factorization, geometry.corrections
    resampling, surface, virtual = factorization.resampling, geometry.surface, sector.virtual[0]
    channels = geometry.channels[sector.channels]
    tx_m, rx_m, velocity, speed = antennas_of(lines, channels)
    range_m = pairwise_range_m(sector.root_m, tx_m, rx_m, velocity, speed)
    if corrections is not None:
        # Leaves correct the ranges of virtual channels, whose receivers are as far from
        # transmitters as usual. Raw channels are corrected for the rest.
        antennas = corrections.antennas[channels]
        usual = corrections.usual(antennas[:, :3])
        beyond = corrections.weights(antennas) - corrections.weights(usual)
        middle = sector.roots + np.array(factorization.sides[0]) // 2
        range_m += corrections.at(surface.pixels_in(middle)) @ beyond.T

    position, cycles = resampling.places(range_m, lines.first_range_m[channels], lines)
    position += MARGIN - resampling.first - factorization.half_lengths[0]
    lower = np.floor(position)
    start = np.clip(lower + 1 - factorization.align.taps // 2, -_FAR, _FAR)
    found = {
        "order": virtual.ordered(np.broadcast_to(channels, position.shape)).astype(np.int32),
        "start": virtual.ordered(start).astype(np.int32),
        "nu": virtual.ordered(position - lower - 0.5).astype(np.float32),
        "cycles": virtual.ordered(cycles).astype(np.float32),
    }
    if geometry.ramps:
        # The excess of each channel's phase rate over the mean of all.
        virtual_m = geometry.track.positions_m(sector.coordinate, sector.across)
        stretch = stretches(
            tx_m, rx_m, velocity, speed, geometry.drift, surface.plane, sector.root_m, virtual_m
        )
        more = (stretch - factorization.stretch) / (1 + factorization.stretch)
        ramp = more * geometry.cycles_per_m / geometry.samples_per_m
        found["ramp"] = virtual.ordered(ramp).astype(np.float32)
    return found
