"""Virtual channels: their positions on the mean track, and the channels that they stand for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from clsas.aperture.mean_track import MeanTrack
from clsas.aperture.phase_rates import cumulative_cycles
from clsas.signal.interpolation import Interpolator

_SMOOTHED_CHANNELS = 2.5  # rms width over which the spacing is smoothed, virtual channels
_LEAST_RATE = 0.3  # lower bound of phase rates, relative to their mean over the track
_LEAST_CHANNELS = 2.0  # lower bound of the virtual channels between the ends of the track


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
    spacing = Spacing.of(track, rate, aperture)
    position, origin, taps = *spacing.positions(coordinate), aperture.taps
    order = None
    if (np.diff(position) < 0).any():
        order = np.argsort(position, axis=1, kind="stable")
        position = np.take_along_axis(position, order, axis=1)
    lower = np.floor(position)
    base = lower.astype(np.int64) - (taps // 2 - 1)
    found = spacing.coordinates(origin + np.arange(base.max() + taps))
    between = position - lower - 0.5
    return VirtualChannels(found, track.positions_m(found), order, base, between, aperture)


@dataclass(frozen=True, eq=False)
class Spacing:
    """Virtual channels along a curve, at equal steps of the phase.

    Attributes
    ----------
    track : MeanTrack
    phase : float64 [roots, samples]
        Number of virtual channels up to each of `track.samples`.
    taps : int
        Taps of the aperture filter.
    """

    track: MeanTrack
    phase: NDArray[np.float64]
    taps: int

    @classmethod
    def of(cls, track: MeanTrack, rate: NDArray[np.float64], aperture: Interpolator) -> Spacing:
        """Return the spacing that phase rates require: see `interpolated_channels`."""
        per_cycle = 2 * aperture.upsampling
        rates = _smoothed_rates(track, rate, per_cycle)
        return cls(track, per_cycle * cumulative_cycles(track, rates), aperture.taps)

    def positions(
        self, coordinate: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions among virtual channels, [roots, channels], and that of the first one.

        Positions are counted from the first virtual channel; that of the first, from the first
        sample of the curve.
        """
        position = np.stack(
            [
                np.interp(c, self.track.samples, p)
                for c, p in zip(coordinate, self.phase, strict=True)
            ]
        )
        origin = np.floor(position.min(axis=1, keepdims=True)) - (self.taps // 2 - 1)
        position -= origin
        return position, origin

    def coordinates(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return aperture coordinates of positions counted from the first sample of the curve."""
        return np.stack(
            [np.interp(v, p, self.track.samples) for v, p in zip(position, self.phase, strict=True)]
        )


def _smoothed_rates(
    track: MeanTrack, rate: NDArray[np.float64], per_cycle: float
) -> NDArray[np.float64]:
    """Return phase rates that change little over the taps of a filter, [roots, samples].

    Filters interpolate band-limited functions well only if the spacing is nearly constant. The
    logarithms of the rates are therefore smoothed over a few virtual channels. The spacing nearby
    is continued where the root is invisible (the rate is 0), past the ends of the track, and where
    phases hardly turn.
    """
    on_track = np.flatnonzero(track.on_track)
    inside = rate[:, on_track]
    for root in np.flatnonzero((inside <= 0).any(axis=1)):
        visible = np.flatnonzero(inside[root] > 0)
        every = np.arange(len(on_track))
        inside[root] = np.interp(every, visible, inside[root, visible]) if visible.size else 1.0
    mean = inside.mean(axis=1, keepdims=True)
    inside = np.maximum(inside, np.maximum(_LEAST_RATE * mean, _LEAST_CHANNELS / per_cycle))
    channels_per_sample = per_cycle * inside.mean(axis=1) / (len(on_track) - 1)
    # Roots of similar widths are smoothed together.
    width = np.ceil(2 * np.log2(_SMOOTHED_CHANNELS / channels_per_sample)).astype(int)
    inside = np.log(inside, out=inside)
    for each in np.unique(width):
        same = width == each
        inside[same] = gaussian_filter1d(inside[same], 2 ** (each / 2), mode="nearest")
    nearest = np.clip(np.arange(rate.shape[1]) - on_track[0], 0, len(on_track) - 1)
    return np.exp(inside, out=inside)[:, nearest]


def summed_neighbours(
    coordinate: NDArray[np.float64], position_m: NDArray[np.float64], factor: int
) -> VirtualChannels:
    """Return virtual channels that are sums of `factor` neighbours, at their mean positions.

    These are the nodes of THESIS, equation 43.

    Parameters
    ----------
    coordinate : float64 [roots, channels]
        Aperture coordinates of the channels.
    position_m : float64 [roots, channels, 3]
        Their positions.
    factor : int
    """
    roots, channels = coordinate.shape
    order = np.argsort(coordinate, axis=1, kind="stable")
    starts = np.arange(0, channels, factor)
    counts = np.diff(np.append(starts, channels))
    in_order = np.take_along_axis(coordinate, order, axis=1)
    in_order_m = np.take_along_axis(position_m, order[..., None], axis=1)
    base = np.broadcast_to(np.arange(channels) // factor, (roots, channels))
    return VirtualChannels(
        np.add.reduceat(in_order, starts, axis=1) / counts,
        np.add.reduceat(in_order_m, starts, axis=1) / counts[:, None],
        order,
        base,
        np.zeros((roots, channels)),
        None,
    )


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
