"""Virtual channels: where they lie on the mean track, and which channels each stands for.

Relative to the centre of a subimage, the steering function of a pixel varies slowly along the
aperture. It is interpolated from its values at fewer, virtual channels, whose lines are weighted
sums of aligned lines. `InterpolatedAperture` places them as densely as band-limited steering
functions need, on a curve, on strips or on a sheet. `NearestBeams`, the method of chapter 4 of
THESIS, sums neighbouring channels instead.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from clsas.engine.data import reprs
from clsas.engine.factorized.filters import edges_gain
from clsas.engine.factorized.phase_rates import SheetRates
from clsas.engine.factorized.track import APART, MeanTrack, Shape
from clsas.engine.signal.interpolation import Gain, Interpolator

_SMOOTHED_CHANNELS = 2.5  # rms width over which the spacing is smoothed, virtual channels
_LEAST_RATE = 0.3  # lower bound of phase rates, relative to their mean over the track
_LEAST_CHANNELS = 2.0  # lower bound of the virtual channels between the ends of the track

ThesisStages = Sequence[tuple[int, int]]
"""(QR, QI) of each stage: the number of lines summed, and the divisor of both image sides."""


@dataclass(frozen=True, eq=False)
class InterpolatedAperture:
    """Virtual channels between which steering functions are interpolated.

    Attributes
    ----------
    filter : Interpolator
        Filter along the aperture. Its `upsampling` is the density of virtual channels relative to
        the band limit.
    oversampling : tuple of float
        Density of virtual channels relative to what the filter needs, stage by stage. It
        compensates for their uneven spacing along the track.
    beam_cycles : float
        Cycles per edge of the beam that the virtual channels of the last stage can sample.
    shape : str
        Shape of the mean track: one curve ("track"), several ("strips"), or a "sheet".
    band : (centre, half width)
        Frequencies for which all filters were designed, cycles per sample.
    """

    filter: Interpolator
    oversampling: tuple[float, ...]
    beam_cycles: float
    band: tuple[float, float]
    shape: Shape = "track"
    method: Literal["interpolated"] = "interpolated"

    aligns_phases: ClassVar[bool] = True
    """The first stage turns the phases of channels off the mean track along their lines."""

    splits_leaves: ClassVar[bool] = False
    """Leaves are small enough for expansions of ranges about their centres."""

    __repr__ = reprs.of_fields

    @property
    def dimensions(self) -> int:
        """Dimensions of the aperture in which the filter interpolates."""
        return 2 if self.shape == "sheet" else 1

    @property
    def stages(self) -> int:
        """Number of stages."""
        return len(self.oversampling)

    def describe(self) -> str:
        """Return the filter in words."""
        where = {"track": "along", "strips": "along strips of", "sheet": "along and across"}
        return (
            f"{self.filter.taps} taps {where[self.shape]} the aperture at "
            f"{self.filter.upsampling:.2f} x"
        )

    def lines_gain(self, align: Interpolator, final: Interpolator, ratio: float) -> Gain | None:
        """Return the gain of upsampled lines that compensates for the loss in range filters."""
        return edges_gain(align, final, self.stages, ratio)

    def used_channels(
        self,
        coordinate: NDArray[np.float64],
        start: NDArray[np.float64],
        stop: NDArray[np.float64],
        slack: float,
    ) -> slice:
        """Return the channels that a sector needs, at least one.

        Parameters
        ----------
        coordinate : float64 [channels]
            Aperture coordinates of channels, ascending.
        start, stop : float64 [leaves]
            Aperture coordinates between which each leaf is visible.
        slack : float
            Largest difference between apparent coordinates and these.
        """
        visible = stop > start
        if not visible.any():
            return slice(0, 1)
        first = np.searchsorted(coordinate, start[visible].min() - slack, "left")
        last = np.searchsorted(coordinate, stop[visible].max() + slack, "right")
        return slice(int(min(first, len(coordinate) - 1)), int(max(last, first + 1)))

    def on_curves(
        self,
        track: MeanTrack,
        rates: NDArray[np.float64],
        beam_rate: NDArray[np.float64] | None,
        extents: Sequence[NDArray[np.float64]],
        coordinate: NDArray[np.float64],
    ) -> list[VirtualChannels]:
        """Return the virtual channels of some roots, stage by stage, on one curve or on strips.

        Parameters
        ----------
        track : MeanTrack
        rates : float64 [axes, roots, samples]
            Largest phase rates of subimages in the roots: see `cycles_per_extent`.
        beam_rate : float64 [roots, samples] or None
            Rates at which the beam's weights change, which count in the last stage only.
        extents : sequence of float64 [roots, axes]
            Extents of the subimages, stage by stage.
        coordinate : float64 [roots, channels]
            Aperture coordinates of the raw channels.
        """
        interpolated = strip_channels if track.is_dense else interpolated_channels
        found: list[VirtualChannels] = []
        for oversampling, extent in zip(self.oversampling, extents, strict=True):
            rate = np.einsum("ra,ars->rs", oversampling * extent, rates)
            if beam_rate is not None and len(found) == len(extents) - 1:
                rate += self.beam_cycles * beam_rate
            found.append(interpolated(track, rate, coordinate, self.filter))
            coordinate = found[-1].coordinate
        return found

    def on_sheet(
        self,
        track: MeanTrack,
        rates: SheetRates,
        beam_rates: SheetRates | None,
        extents: Sequence[NDArray[np.float64]],
        coordinates: tuple[NDArray[np.float64], NDArray[np.float64]],
    ) -> list[VirtualChannels]:
        """Return the virtual channels of some roots, stage by stage, on a sheet.

        The parameters are those of `on_curves`, with rates along and across the sheet, and the
        coordinates of the raw channels along and across it.
        """
        found: list[VirtualChannels] = []
        parent: SheetChannels | None = None
        for oversampling, extent in zip(self.oversampling, extents, strict=True):
            along, across = (
                np.einsum("ra,ars->rs", oversampling * extent, each)
                for each in (rates.along, rates.across)
            )
            if beam_rates is not None and len(found) == len(extents) - 1:
                along += self.beam_cycles * beam_rates.along
                across += self.beam_cycles * beam_rates.across
            rate = SheetRates(along, across)
            if parent is None:
                virtual, parent = first_on_sheet(track, rate, *coordinates, self.filter)
            else:
                virtual, parent = later_on_sheet(track, rate, parent, self.filter)
            found.append(virtual)
        return found


@dataclass(frozen=True, eq=False)
class VirtualChannels:
    """Virtual channels of one stage for some roots, shared by all subimages within a root.

    Attributes
    ----------
    coordinate : float64 [roots, virtual channels]
        Aperture coordinates on the mean track. On a sheet, those of the columns.
    position_m : float64 [roots, virtual channels, 3]
        Positions, metres.
    order : int64 [roots, channels] or None
        Order in which the channels of the stage before are added; None if it is their own order.
    base : int64 [roots, channels]
        First virtual channel to which each channel contributes, in that order. It never decreases
        within a band.
    between : float64 [roots, channels]
        Position of each channel relative to the middle of the virtual channels to which it
        contributes, from -0.5 to 0.5 of their spacing.
    aperture : Interpolator or None
        Filter that weights the contributions; None if each channel is added to one virtual channel.
    bands : Bands or None
        Bands of strips or of a sheet; None for a single curve.
    rows : float64 [roots, rows] or None
        Coordinates of the rows across a sheet; None without a sheet.
    """

    coordinate: NDArray[np.float64]
    position_m: NDArray[np.float64]
    order: NDArray[np.int64] | None
    base: NDArray[np.int64]
    between: NDArray[np.float64]
    aperture: Interpolator | None
    bands: Bands | None = None
    rows: NDArray[np.float64] | None = None

    @property
    def across(self) -> NDArray[np.float64] | None:
        """Coordinates across a sheet, [roots, virtual channels]; None without a sheet."""
        if self.rows is None:
            return None
        return np.repeat(self.rows, self.coordinate.shape[1] // self.rows.shape[1], axis=1)

    @property
    def taps(self) -> int:
        """Number of virtual channels to which a channel contributes."""
        return 1 if self.aperture is None else self.aperture.taps

    @property
    def weights(self) -> NDArray[np.float64]:
        """Weights of channels in the virtual channels from `base` on, [roots, channels, taps]."""
        if self.aperture is None:
            return np.ones((*self.base.shape, 1))
        return self.aperture.weights(self.between)

    @property
    def contributed(self) -> NDArray[np.int64]:
        """Virtual channels to which channels contribute, numbered through all roots.

        int64 [roots, channels, taps], as `weights`.
        """
        first = self.coordinate.shape[1] * np.arange(len(self.base))
        return (first[:, None] + self.base)[..., None] + np.arange(self.taps)

    def ordered(self, values: NDArray) -> NDArray:
        """Return values of every channel, [roots, channels], in the order of `base`."""
        return values if self.order is None else np.take_along_axis(values, self.order, axis=1)


@dataclass(frozen=True, eq=False)
class Bands:
    """Groups of channels that contribute to the same rows of virtual channels.

    Virtual channels are ordered row by row. Bands are in the order of their rows. Each strip is a
    row of its own.

    Attributes
    ----------
    bounds : int64 [roots, bands + 1]
        First channel of each band, in the order in which channels are added, and the total.
    first : int64 [roots, bands]
        First virtual channel of the first row to which a band contributes.
    width : int64 [roots, bands]
        Number of virtual channels in each of these rows.
    old : int64 [roots, bands]
        Number of leading rows to which earlier bands have already contributed.
    between : float64 [roots, channels] or None
        Position of each channel relative to the middle of its rows, from -0.5 to 0.5; None if each
        band contributes to a single row.
    """

    bounds: NDArray[np.int64]
    first: NDArray[np.int64]
    width: NDArray[np.int64]
    old: NDArray[np.int64]
    between: NDArray[np.float64] | None


def interpolated_channels(
    track: MeanTrack,
    rate: NDArray[np.float64],
    coordinate: NDArray[np.float64],
    aperture: Interpolator,
) -> VirtualChannels:
    """Return virtual channels on a curve, between which steering functions are interpolated.

    They lie at equal steps of the phase, the integral of the largest phase rate. As a function of
    this phase, every steering function is band-limited to one cycle per unit, whatever the track.

    Parameters
    ----------
    track : MeanTrack
    rate : float64 [roots, samples]
        Largest phase rates at `track.samples`, cycles per unit of the aperture coordinate.
    coordinate : float64 [roots, channels]
        Apparent aperture coordinates of the channels.
    aperture : Interpolator
        Filter along the aperture. Its `upsampling` is the oversampling of virtual channels.

    Notes
    -----
    In butterfly algorithms, a separable low-rank expansion serves the same purpose (Demanet et al.
    2012).
    """
    position, found = equal_phase_steps(track, rate, coordinate, aperture)
    # Channels are added in the order of virtual channels, each to half the taps on either side.
    order = None
    if (np.diff(position) < 0).any():
        order = np.argsort(position, axis=1, kind="stable")
        position = np.take_along_axis(position, order, axis=1)
    lower = np.floor(position)
    base = lower.astype(np.int64) - (aperture.taps // 2 - 1)
    between = position - lower - 0.5
    return VirtualChannels(found, track.positions_m(found), order, base, between, aperture)


def equal_phase_steps(
    track: MeanTrack,
    rate: NDArray[np.float64],
    coordinate: NDArray[np.float64],
    aperture: Interpolator,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return channels and virtual channels along a curve: see `interpolated_channels`.

    Returns
    -------
    float64 [roots, channels]
        Position of each channel among the virtual channels, counted from the first of them.
    float64 [roots, virtual channels]
        Aperture coordinates of the virtual channels.
    """
    samples, on_track = track.samples, np.flatnonzero(track.on_track)
    per_cycle, half = 2 * aperture.upsampling, aperture.taps // 2
    inside = rate[:, on_track]

    # The rate is 0 where a root is invisible. The spacing nearby is continued there.
    every = np.arange(len(on_track))
    for root in np.flatnonzero((inside <= 0).any(axis=1)):
        visible = np.flatnonzero(inside[root] > 0)
        inside[root] = np.interp(every, visible, inside[root, visible]) if visible.size else 1.0

    # Where phases turn slowly, virtual channels do not lie much farther apart than elsewhere.
    mean = inside.mean(axis=1, keepdims=True)
    inside = np.maximum(inside, np.maximum(_LEAST_RATE * mean, _LEAST_CHANNELS / per_cycle))

    # Filters interpolate band-limited functions well only if the spacing is nearly constant. The
    # logarithms of the rates are therefore smoothed over a few virtual channels. Roots of similar
    # widths are smoothed together.
    channels_per_sample = per_cycle * inside.mean(axis=1) / (len(on_track) - 1)
    width = np.ceil(2 * np.log2(_SMOOTHED_CHANNELS / channels_per_sample)).astype(int)
    inside = np.log(inside, out=inside)
    for each in np.unique(width):
        same = width == each
        inside[same] = gaussian_filter1d(inside[same], 2 ** (each / 2), mode="nearest")
    inside = np.exp(inside, out=inside)

    # Past the ends of the curve, the spacing is that at the ends.
    smooth = inside[:, np.clip(np.arange(len(samples)) - on_track[0], 0, len(on_track) - 1)]

    # The number of virtual channels up to each sample is the integral of the rates.
    steps = np.diff(samples) * (smooth[:, 1:] + smooth[:, :-1]) / 2
    cycles = np.concatenate([np.zeros((len(steps), 1)), np.cumsum(steps, axis=1)], axis=1)
    phase = per_cycle * cycles
    position = np.stack(
        [np.interp(at, samples, of_root) for at, of_root in zip(coordinate, phase, strict=True)]
    )

    # Number them from the first to which the first channel contributes, to the last of the last.
    origin = np.floor(position.min(axis=1, keepdims=True)) - (half - 1)
    position -= origin
    numbers = origin + np.arange(int(position.max()) + half + 1)
    found = [np.interp(at, of_root, samples) for at, of_root in zip(numbers, phase, strict=True)]
    return position, np.stack(found)


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
        local = coordinate[:, start:stop] - APART * number
        virtual = interpolated_channels(strip, rate[:, strip_of_sample == number], local, aperture)
        own_order = np.broadcast_to(np.arange(stop - start), local.shape)
        orders.append(start + (own_order if virtual.order is None else virtual.order))
        coordinates.append(virtual.coordinate + APART * number)
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


# Sheets


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
        return np.tile(self.columns, self.rows.shape[1])


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
    column, columns = equal_phase_steps(track.line_along(0.5), rates.along, along, aperture)
    row, rows = equal_phase_steps(track.line_across(0.5), rates.across, across, aperture)
    above = np.floor(row)
    first_row = above.astype(np.int64) - (taps // 2 - 1)

    # Order the channels by the first of their rows, and those of a row by their columns. NumPy
    # sorts 16-bit integers in linear time. Channels are already sorted along the sheet.
    order = np.argsort(first_row.astype(np.int16), axis=1, kind="stable")
    column = np.take_along_axis(column, order, axis=1)
    first_row = np.take_along_axis(first_row, order, axis=1)
    if ((np.diff(column) < 0) & (np.diff(first_row) == 0)).any():
        again = np.lexsort((column, first_row))
        order = np.take_along_axis(order, again, axis=1)
        column = np.take_along_axis(column, again, axis=1)
        first_row = np.take_along_axis(first_row, again, axis=1)
    lower, width = np.floor(column), columns.shape[1]
    base = lower.astype(np.int64) - (taps // 2 - 1) + width * first_row

    # There is a band for each row that may be the first of a channel's rows, even an empty band.
    numbers = np.arange(rows.shape[1] - taps + 1)
    bounds = np.stack([np.searchsorted(each, np.arange(len(numbers) + 1)) for each in first_row])
    shape = len(bounds), len(numbers)
    bands = Bands(
        bounds=bounds,
        first=np.broadcast_to(width * numbers, shape),
        width=np.full(shape, width),
        old=np.broadcast_to(np.where(numbers > 0, taps - 1, 0), shape),
        between=np.take_along_axis(row - above - 0.5, order, axis=1),
    )
    found = SheetChannels(columns, rows)
    between = column - lower - 0.5
    return _virtual_on_sheet(track, found, order, base, between, aperture, bands), found


def later_on_sheet(
    track: MeanTrack, rates: SheetRates, parent: SheetChannels, aperture: Interpolator
) -> tuple[VirtualChannels, SheetChannels]:
    """Return the virtual channels of a later stage on a sheet, and their coordinates.

    Each row of the stage before is a band. `parent` has the coordinates of that stage; the other
    parameters are those of `first_on_sheet`.
    """
    half = aperture.taps // 2
    along, across = track.line_along(0.5), track.line_across(0.5)
    column, columns = equal_phase_steps(along, rates.along, parent.columns, aperture)
    row, rows = equal_phase_steps(across, rates.across, parent.rows, aperture)
    lower, above = np.floor(column), np.floor(row)
    first_column, first_row = (each.astype(np.int64) - (half - 1) for each in (lower, above))
    (roots, count), channels, width = row.shape, column.shape[1], columns.shape[1]
    shape = roots, count, channels
    bands = Bands(
        bounds=np.broadcast_to(channels * np.arange(count + 1), (roots, count + 1)),
        first=width * first_row,
        width=np.full((roots, count), width),
        old=np.zeros((roots, count), np.int64),
        between=np.broadcast_to((row - above - 0.5)[..., None], shape).reshape(roots, -1),
    )
    found = SheetChannels(columns, rows)
    base = (first_column[:, None] + width * first_row[..., None]).reshape(roots, -1)
    between = np.broadcast_to((column - lower - 0.5)[:, None], shape).reshape(roots, -1)
    return _virtual_on_sheet(track, found, None, base, between, aperture, bands), found


def _virtual_on_sheet(
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


# Channels of subimages, and the kernels' table of bands


@dataclass(frozen=True, eq=False)
class ChannelRanges:
    """Ranges of the channels that each subimage of a stage needs, all int64 [roots, subimages].

    Ranges are empty for subimages that are visible from no channel.

    Attributes
    ----------
    first, last
        First virtual channel of the subimage, and the one after its last.
    begin, end
        First channel of the stage before that the subimage uses, and the one after the last.
    """

    first: NDArray[np.int64]
    last: NDArray[np.int64]
    begin: NDArray[np.int64]
    end: NDArray[np.int64]


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


# Nearest beams


@dataclass(frozen=True)
class NearestBeams:
    """Virtual channels that are plain sums of neighbours, at their mean positions [43].

    `InterpolatedAperture` is the alternative.

    Attributes
    ----------
    factors : tuple of int
        Number of neighbours that are summed into one virtual channel, QR, stage by stage.
    """

    factors: tuple[int, ...]
    method: Literal["nearest"] = "nearest"

    filter: ClassVar[Interpolator] = Interpolator(1, 1.0, np.zeros((0, 2, 0)), -math.inf, -math.inf)
    """A single tap of weight 1."""
    band: ClassVar[None] = None
    """Linear interpolation serves any band."""
    dimensions: ClassVar[int] = 1
    shape: ClassVar[Shape] = "track"
    """Virtual channels are means of neighbours on one curve."""

    aligns_phases: ClassVar[bool] = False
    splits_leaves: ClassVar[bool] = True
    """Leaves have the size that the stages define, and are backprojected in smaller tiles."""

    @property
    def stages(self) -> int:
        """Number of stages."""
        return len(self.factors)

    def describe(self) -> str:
        """Return the sums in words."""
        return f"sums of {', '.join(map(str, self.factors))} neighbours"

    def lines_gain(self, align: Interpolator, final: Interpolator, ratio: float) -> Gain | None:
        """Return None: the thesis does not compensate for range filters."""

    def used_channels(
        self,
        coordinate: NDArray[np.float64],
        start: NDArray[np.float64],
        stop: NDArray[np.float64],
        slack: float,
    ) -> slice:
        """Return all channels: the choice of neighbours does not depend on the sector."""
        return slice(0, len(coordinate))

    def virtual_channels(
        self, coordinate: NDArray[np.float64], channels_m: NDArray[np.float64]
    ) -> list[VirtualChannels]:
        """Return the virtual channels of some roots, stage by stage.

        These are the nodes of THESIS, equation 43.

        Parameters
        ----------
        coordinate : float64 [roots, channels]
            Aperture coordinates of the raw channels.
        channels_m : float64 [channels, 3]
            Their positions.
        """
        found, position_m = [], np.broadcast_to(channels_m, (*coordinate.shape, 3))
        for factor in self.factors:
            roots, channels = coordinate.shape
            order = np.argsort(coordinate, axis=1, kind="stable")
            coordinate = np.take_along_axis(coordinate, order, axis=1)
            position_m = np.take_along_axis(position_m, order[..., None], axis=1)
            starts = np.arange(0, channels, factor)
            counts = np.diff(np.append(starts, channels))
            coordinate = np.add.reduceat(coordinate, starts, axis=1) / counts
            position_m = np.add.reduceat(position_m, starts, axis=1) / counts[:, None]
            base = np.broadcast_to(np.arange(channels) // factor, (roots, channels))
            between = np.zeros((roots, channels))
            found.append(VirtualChannels(coordinate, position_m, order, base, between, None))
        return found


def stage_errors_m(
    stages: ThesisStages, aperture_m: float, image_m: float, nearest_m: float
) -> list[float]:
    """Return the largest range error of each stage [45]; those of all stages add up.

    Parameters
    ----------
    stages : sequence of (QR, QI)
    aperture_m : float
        Distance between neighbouring channels of the raw lines.
    image_m : float
        Longer side of the image.
    nearest_m : float
        Smallest range, Rmin.

    Notes
    -----
    The error is L_A L_I/(4 Rmin) for L_A <= Rmin, else L_I/2, where L_A is the length of the
    subaperture and L_I the side of the subimage after the stage. It bounds the range error of one
    beam that stands for a sector [40],

        sqrt(r^2 + t^2 - 2 r t cos(a + b)) - sqrt(r^2 + t^2 - 2 r t cos(a)),

    for a point at range r, half the subaperture's length t = L_A/2, an angle a between subaperture
    and beam, and angles b from the beam to the point of up to L_I/(2 r), because
    |d rho/d angle| <= min(r, t). Channels are closer to the middle, at (QR - 1)/QR of t at most.
    Corners of square subimages have errors up to (1 + sqrt 2)/2 larger where they are seen
    obliquely, the most at 22.5 degrees.
    """
    errors, length_m, side_m = [], aperture_m, image_m
    for summed, divisions in stages:
        length_m *= summed
        side_m /= divisions
        near = length_m > nearest_m
        errors.append(side_m / 2 if near else length_m * side_m / (4 * nearest_m))
    return errors


def operations(
    stages: ThesisStages, channels: int, samples: Sequence[int], pixels: int, gamma: float = 0.0
) -> list[float]:
    """Return the operations of each stage and, last, of the backprojection [44].

    Parameters
    ----------
    stages : sequence of (QR, QI)
    channels : int
        Number of raw lines, N.
    samples : sequence of int
        Range samples per line, Nr, stage by stage.
    pixels : int
        Pixels of the whole image, X Y.
    gamma : float
        Cost of a line in a stage in addition to its samples, operations.

    Notes
    -----
    As in the worked example of the thesis, N lines take part in the first stage for each of its
    QI^2 subimages, N/QR in the second for each of its QI^4, and so on.
    [44] as printed divides the operations of a stage by the QR of that stage, too.
    """
    counts, subimages = [], 1
    for (summed, divisions), length in zip(stages, samples, strict=True):
        subimages *= divisions**2
        counts.append(float(channels * (subimages * length + gamma)))
        channels = math.ceil(channels / summed)
    counts.append(float(channels * pixels))
    return counts
