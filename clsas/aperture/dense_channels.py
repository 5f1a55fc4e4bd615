"""Virtual channels of dense apertures: on strips, or in rows and columns on a sheet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.aperture.beam_directions import BeamDirections, beam_rate
from clsas.aperture.mean_track import ACROSS_AT, ALONG_AT, MeanTrack
from clsas.aperture.phase_rates import PhaseBoxes, largest_rates
from clsas.aperture.virtual_channels import (
    Bands,
    ChannelRanges,
    Spacing,
    VirtualChannels,
    interpolated_channels,
)
from clsas.signal.interpolation import Interpolator
from clsas.sonar.beam import BeamWindow


def strip_channels(
    track: MeanTrack,
    rate: NDArray[np.float64],
    coordinate: NDArray[np.float64],
    aperture: Interpolator,
) -> VirtualChannels:
    """Return the virtual channels of all strips, one strip after another.

    The parameters are those of `interpolated_channels`. Channels are in the order of strips.
    """
    strip_of_sample = track.strip_of(track.samples)
    # Channels are in the order of strips, those of a strip from one bound to the next.
    bounds = np.searchsorted(track.strip_of(coordinate[0]), np.arange(track.strips + 1))
    orders, coordinates, bases, between = [], [], [], []
    first = [0]
    for number, strip in enumerate(track.alone):
        start, stop = bounds[number], bounds[number + 1]
        apart = track.apart_of(number)
        local = coordinate[:, start:stop] - apart
        virtual = interpolated_channels(strip, rate[:, strip_of_sample == number], local, aperture)
        own_order = np.broadcast_to(np.arange(stop - start), local.shape)
        orders.append(start + (own_order if virtual.order is None else virtual.order))
        coordinates.append(virtual.coordinate + apart)
        bases.append(virtual.base + first[-1])
        between.append(virtual.between)
        first.append(first[-1] + virtual.coordinate.shape[1])
    order, found = np.concatenate(orders, axis=1), np.concatenate(coordinates, axis=1)
    in_order = bool((order == np.arange(order.shape[1])).all())
    every = np.ones((len(coordinate), 1), np.int64)
    bands = Bands(
        bounds=every * bounds,
        first=every * first[:-1],
        width=every * np.diff(first),
        old=np.zeros((len(coordinate), track.strips), np.int64),
        between=None,
    )
    return VirtualChannels(
        coordinate=found,
        position_m=track.positions_m(found),
        order=None if in_order else order,
        base=np.concatenate(bases, axis=1),
        between=np.concatenate(between, axis=1),
        aperture=aperture,
        bands=bands,
    )


@dataclass(frozen=True, eq=False)
class SheetChannels:
    """Coordinates of the virtual channels of a sheet, which follow each other row by row.

    Attributes
    ----------
    columns : float64 [roots, columns]
        Aperture coordinates of the columns.
    rows : float64 [roots, rows]
        Coordinates of the rows across the sheet.
    """

    columns: NDArray[np.float64]
    rows: NDArray[np.float64]

    @property
    def coordinate(self) -> NDArray[np.float64]:
        """Aperture coordinates of all virtual channels, [roots, n]."""
        roots, rows = self.rows.shape
        return np.broadcast_to(self.columns[:, None], (roots, rows, self.columns.shape[1])).reshape(
            roots, -1
        )


@dataclass(frozen=True, eq=False)
class SheetRates:
    """Largest phase rates of subimages on a sheet, cycles per unit of a coordinate.

    Attributes
    ----------
    along : float64 [..., samples]
        Rates at the samples of lines along the sheet.
    across : float64 [..., samples]
        Rates at the samples of lines across the sheet.
    """

    along: NDArray[np.float64]
    across: NDArray[np.float64]

    def plus(self, factor: float, others: SheetRates) -> SheetRates:
        """Return the sum of these rates and others times a factor."""
        return SheetRates(self.along + factor * others.along, self.across + factor * others.across)

    def times(self, extents: NDArray[np.float64]) -> SheetRates:
        """Return the rates [roots, samples] of subimages with given extents, [roots, axes]."""
        return SheetRates(
            *(np.einsum("ra,ars->rs", extents, each) for each in (self.along, self.across))
        )


def sheet_rates(track: MeanTrack, boxes: PhaseBoxes, every: int = 1) -> SheetRates:
    """Return the largest phase rates of subimages within boxes, along and across a sheet.

    They are [axes, boxes, samples] each, the largest of the rates on several lines. The parameters
    are those of `cycles_per_extent`.
    """
    lines = track.lines_along + track.lines_across
    sampled = [[each[::every] for each in line.sampled_m] for line in lines]
    positions_m, tangents_m = (np.concatenate(each) for each in zip(*sampled, strict=True))
    rates = largest_rates(positions_m, tangents_m, boxes)
    first = len(track.lines_along) * len(sampled[0][0])
    shape = rates.shape[:-1]
    along, across = rates[..., :first], rates[..., first:]
    return SheetRates(
        along.reshape(*shape, len(track.lines_along), -1).max(axis=-2),
        across.reshape(*shape, len(track.lines_across), -1).max(axis=-2),
    )


def sheet_beam_rates(
    beam: BeamWindow,
    track: MeanTrack,
    directions: BeamDirections,
    centres_m: NDArray[np.float64],
    sides_m: NDArray[np.float64],
) -> SheetRates:
    """Return the largest rates of a beam's weights, [boxes, samples] each: see `beam_rate`."""

    def largest(lines: tuple[MeanTrack, ...], *, places: Sequence[tuple[Any, Any]]) -> NDArray:
        rates = [
            beam_rate(beam, line, directions.at(*np.broadcast_arrays(*place)), centres_m, sides_m)
            for line, place in zip(lines, places, strict=True)
        ]
        return np.max(rates, axis=0)

    along, across = track.lines_along, track.lines_across
    return SheetRates(
        largest(along, places=[(along[0].samples, at) for at in ALONG_AT]),
        largest(across, places=[(at, across[0].samples) for at in ACROSS_AT]),
    )


def first_on_sheet(
    track: MeanTrack,
    rates: SheetRates,
    along: NDArray[np.float64],
    across: NDArray[np.float64],
    aperture: Interpolator,
) -> tuple[VirtualChannels, SheetChannels]:
    """Return the virtual channels of the first stage on a sheet, and their coordinates.

    Parameters
    ----------
    track : MeanTrack
        The sheet.
    rates : SheetRates
        Largest phase rates of the subimages, [roots, samples] each.
    along, across : float64 [roots, channels]
        Apparent coordinates of the raw channels.
    aperture : Interpolator
        Filter between virtual channels, in both dimensions.
    """
    taps = aperture.taps
    column, row, found = _grid(track, rates, along, across, aperture)
    above = np.floor(row)
    first_row = above.astype(np.int64) - (taps // 2 - 1)
    # NumPy sorts 16-bit integers in linear time. Channels are already sorted along the sheet.
    order = np.argsort(first_row.astype(np.int16), axis=1, kind="stable")
    column = np.take_along_axis(column, order, axis=1)
    first_row = np.take_along_axis(first_row, order, axis=1)
    if ((np.diff(column) < 0) & (np.diff(first_row) == 0)).any():
        again = np.lexsort((column, first_row))
        order = np.take_along_axis(order, again, axis=1)
        column = np.take_along_axis(column, again, axis=1)
        first_row = np.take_along_axis(first_row, again, axis=1)
    lower = np.floor(column)
    base = lower.astype(np.int64) - (taps // 2 - 1)
    rows, width = found.rows.shape[1], found.columns.shape[1]
    # There is a band for each row that may be the first of a channel's rows, even an empty band.
    numbers = np.arange(rows - taps + 1)
    bounds = np.stack([np.searchsorted(each, np.arange(len(numbers) + 1)) for each in first_row])
    shape = len(bounds), len(numbers)
    bands = Bands(
        bounds,
        np.broadcast_to(width * numbers, shape),
        np.full(shape, width),
        np.broadcast_to(np.where(numbers > 0, taps - 1, 0), shape),
        np.take_along_axis(row - above - 0.5, order, axis=1),
    )
    base += width * first_row
    return _of_sheet(track, found, order, base, column - lower - 0.5, aperture, bands), found


def later_on_sheet(
    track: MeanTrack, rates: SheetRates, parent: SheetChannels, aperture: Interpolator
) -> tuple[VirtualChannels, SheetChannels]:
    """Return the virtual channels of a later stage on a sheet, and their coordinates.

    Each row of the stage before is a band. `parent` has the coordinates of that stage; the other
    parameters are those of `first_on_sheet`.
    """
    taps = aperture.taps
    column, row, found = _grid(track, rates, parent.columns, parent.rows, aperture)
    lower, above = np.floor(column), np.floor(row)
    base, first_row = (each.astype(np.int64) - (taps // 2 - 1) for each in (lower, above))
    (roots, bands), channels = row.shape, column.shape[1]
    width, shape = found.columns.shape[1], (roots, bands, channels)
    of_bands = Bands(
        np.broadcast_to(channels * np.arange(bands + 1), (roots, bands + 1)),
        width * first_row,
        np.full((roots, bands), width),
        np.zeros((roots, bands), np.int64),
        np.broadcast_to((row - above - 0.5)[..., None], shape).reshape(roots, -1),
    )
    every = base[:, None] + width * first_row[..., None]
    between = np.broadcast_to((column - lower - 0.5)[:, None], shape).reshape(roots, -1)
    return (
        _of_sheet(track, found, None, every.reshape(roots, -1), between, aperture, of_bands),
        found,
    )


def _grid(
    track: MeanTrack,
    rates: SheetRates,
    along: NDArray[np.float64],
    across: NDArray[np.float64],
    aperture: Interpolator,
) -> tuple[NDArray[np.float64], NDArray[np.float64], SheetChannels]:
    """Return positions among columns and rows, and the coordinates of these."""
    found = []
    for line, rate, given in (
        (track.line_along(0.5), rates.along, along),
        (track.line_across(0.5), rates.across, across),
    ):
        spacing = Spacing.of(line, rate, aperture)
        position, origin = spacing.positions(given)
        count = int(position.max()) + aperture.taps // 2 + 1
        found.append((position, spacing.coordinates(origin + np.arange(count))))
    (column, columns), (row, rows) = found
    return column, row, SheetChannels(columns, rows)


def _of_sheet(
    track: MeanTrack,
    found: SheetChannels,
    order: NDArray[np.int64] | None,
    base: NDArray[np.int64],
    between: NDArray[np.float64],
    aperture: Interpolator,
    bands: Bands,
) -> VirtualChannels:
    position_m = track.sheet.positions_on_grid_m(found.columns, found.rows)
    position_m = position_m.reshape(len(position_m), -1, 3)
    return VirtualChannels(
        found.coordinate, position_m, order, base, between, aperture, bands, found.rows
    )


def all_channels(
    virtual: list[VirtualChannels], channels: int, inside: list[NDArray[np.bool_]]
) -> list[ChannelRanges]:
    """Return ranges of all channels for each subimage that contains a pixel, stage by stage.

    Parameters
    ----------
    virtual : list of VirtualChannels
        Virtual channels, stage by stage.
    channels : int
        Number of raw channels.
    inside : list of bool [roots, subimages]
        True for subimages that contain a pixel, stage by stage.
    """
    result = []
    for each, needed in zip(virtual, inside, strict=True):
        count = each.coordinate.shape[1]
        none = np.zeros(needed.shape, np.int64)
        result.append(ChannelRanges(none, count * needed, none, channels * needed))
        channels = count
    return result


def band_table(
    bands: Bands | None, need: ChannelRanges, first_of_parent: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the stage kernel's table of bands, [roots, subimages, bands, 7].

    Its columns are the members of `Band` in `cl/stages.h`.

    Parameters
    ----------
    bands : Bands or None
    need : ChannelRanges
        Channels that each subimage needs.
    first_of_parent : int64 [roots, subimages]
        Channel of the first line of each subimage's parent.
    """
    if bands is None:
        none = np.zeros_like(need.first)
        of_one = [need.begin, need.end, first_of_parent, need.first, need.last - need.first]
        return np.stack([*of_one, none, none], axis=-1)[:, :, None]
    begin, end = bands.bounds[:, :-1], bands.bounds[:, 1:]
    values = [begin, end, 0 * begin, bands.first, bands.width, bands.first, bands.old]
    needed = need.last > need.first
    return np.stack(values, axis=-1)[:, None] * needed[..., None, None]
