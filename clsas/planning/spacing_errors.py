"""Error of virtual channels whose spacing changes, and of beam weights that change between them.

The aperture's filter takes virtual channels as equally spaced and weights as constant. Here the
steering functions of sampled pixels are interpolated between the virtual channels of a candidate,
and compared with the exact ones.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from clsas.aperture.beam_directions import interpolated_directions
from clsas.aperture.dense_channels import strip_channels
from clsas.aperture.mean_track import MeanTrack
from clsas.aperture.virtual_channels import VirtualChannels, interpolated_channels
from clsas.core.decibels import power
from clsas.core.wavelengths import wavelength_m
from clsas.planning import phase_rates
from clsas.planning.caching import cached
from clsas.planning.channels import carriers
from clsas.planning.sample_pixels import SAMPLED_PIXELS, SPREAD_POINTS, mean_over_relief, pixels_m
from clsas.planning.subimages import Side
from clsas.planning.visibility_model import VisibilityModel
from clsas.signal.interpolation import Interpolator

_Pixels = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]

_PLACES_OF_STRIP = 16  # more, for each strip after the first
# Corners of roots in which subimages are sampled, by row and column of the sample points: at the
# edges of the grid those that lie inside.
_CORNERS = np.stack(np.meshgrid((1, -1, 1, 1, -1), (1, -1, -1, 1, -1), indexing="ij"), axis=-1)
_SAMPLED_PLACES = 96  # along the visible aperture; half as many move the error by 3 dB at most


@dataclass(frozen=True)
class SpacedStage:
    """A stage, as far as its virtual channels depend on it.

    Attributes
    ----------
    side : (rows, columns)
        Size of its subimages.
    aperture : Interpolator
        Filter along the aperture.
    oversampling : float
        Density of virtual channels over that which the filter asks for.
    beam_cycles : float or None
        Phase cycles that an edge of the beam counts for. With None steering functions are not
        weighted by the beam.
    """

    side: Side
    aperture: Interpolator
    oversampling: float
    beam_cycles: float | None


Stages = tuple[SpacedStage, ...]
"""A stage, the last, and those before it."""


@cached
def spacing_error(model: VisibilityModel, stages: Stages) -> float:
    """Error power that uneven spacing adds to that of the aperture's filter, in the last stage.

    `model` is that within roots of the candidate's size.
    """

    def excess(error: float) -> float:
        return max(error - power(stages[-1].aperture.error_db), 0.0)

    return _over_places(model, stages, excess)


def filter_error(model: VisibilityModel, stages: Stages) -> float:
    """Error power of the aperture's filter itself, in the last stage: see `spacing_error`.

    On a sheet virtual channels are as dense everywhere as the largest phase rate of any line along
    it and across it asks for. Elsewhere the filter errs by less than at its worst.
    """
    worst = power(stages[-1].aperture.error_db)
    if not model.track.is_sheet:
        return worst

    def least(error: float) -> float:
        return min(error, worst)

    return _over_places(model, stages, least)


def bias_error(model: VisibilityModel, stages: Stages) -> float:
    """Error power by which biases of interpolations on a sheet add up beyond their own powers.

    Filters of few taps attenuate steering functions by a mean that all interpolations, along and
    across and in every stage, have in common. Their amplitudes add, not their powers.
    """
    if not model.track.is_sheet:
        return 0.0
    each_stage = [stages[: level + 1] for level in range(len(stages))]
    biases = np.array([_bias(model, places, to) for to in each_stage for places in _DIMENSIONS])
    return float(max(biases.sum() ** 2 - biases @ biases, 0.0))


def _bias(model: VisibilityModel, places: tuple[_Place, ...], stages: Stages) -> float:
    extents = tuple(model.surface.extents(stages[-1].side))
    return float(np.mean([_interpolated(model, each, stages, extents).bias for each in places]))


def _over_places(model: VisibilityModel, stages: Stages, part: Callable[[float], float]) -> float:
    """Return a part of the error of interpolating along the track, or along and across a sheet."""

    def error(place: _Place, extents: NDArray[np.float64]) -> float:
        return part(_interpolated(model, place, stages, tuple(extents)).error)

    def mean(places: tuple[_Place, ...]) -> float:
        side = stages[-1].side
        found = [mean_over_relief(model, side, functools.partial(error, each)) for each in places]
        return sum(found) / len(found)

    if not model.track.is_sheet:
        return mean((_TRACK,))
    return sum(mean(places) for places in _DIMENSIONS)


_Place = tuple[Literal["track", "along", "across"], float]
"""A curve: the track, or a line along or across a sheet at some coordinate."""
_TRACK: _Place = ("track", 0.0)
_LINES_ALONG: tuple[_Place, ...] = (("along", 0.5),)
_LINES_ACROSS: tuple[_Place, ...] = (("across", 0.2), ("across", 0.5))
_DIMENSIONS = (_LINES_ALONG, _LINES_ACROSS)


class _Interpolated(NamedTuple):
    """Steering functions between virtual channels: their error power, and their mean error."""

    error: float
    bias: float


@dataclass(frozen=True, eq=False)
class _Line:
    """A curve along which steering functions are interpolated.

    Attributes
    ----------
    track : MeanTrack
    rates : float64 [axes, points, samples]
        See `clsas.planning.phase_rates`.
    channels : float64 [channels]
        Aperture coordinates of channels, ascending.
    along : float64 [samples, 3] or None
        Unit directions of the beam at `track.samples`.
    beam_rates : float64 [points, samples]
        The beam's: see there.
    """

    track: MeanTrack
    rates: NDArray[np.float64]
    channels: NDArray[np.float64]
    along: NDArray[np.float64] | None
    beam_rates: Any

    def past_ends(self, coordinate: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which aperture coordinates lie past the ends of the curve, or of their strip."""
        strip = self.track.strip_of(self.channels)
        first, last = (
            np.searchsorted(strip, np.arange(self.track.strips), side) for side in ("left", "right")
        )
        of_strip = self.track.strip_of(coordinate)
        past: NDArray[np.bool_] = coordinate < self.channels[first][of_strip]
        return past | (coordinate > self.channels[last - 1][of_strip])


@cached
def _line(model: VisibilityModel, place: _Place) -> _Line:
    kind, at = place
    directions = model.directions
    if kind == "track":
        channels = np.sort(model.track.coordinate)
        return _Line(
            model.track,
            phase_rates.along(model),
            channels,
            model.along,
            phase_rates.of_beam_along(model),
        )
    evenly = np.linspace(0, 1, 4 * _SAMPLED_PLACES)
    if kind == "along":
        line = model.track.line_along(at)
        places = line.samples, np.full(line.samples.shape, at)
        rates, beam_rates = phase_rates.along(model), phase_rates.of_beam_along(model)
    else:
        line = model.track.line_across(at)
        places = np.full(line.samples.shape, at), line.samples
        rates = phase_rates.across(model)
        beam_rates = 0.0 if directions is None else phase_rates.of_beam_across(model)
    along = None if directions is None else directions.at(*places)
    return _Line(line, rates, evenly, along, beam_rates)


@cached
def _interpolated(
    model: VisibilityModel, line_at: _Place, stages: Stages, extents: tuple[float, ...]
) -> _Interpolated:
    """Errors of interpolated steering functions of the last stage's subimages of some extents.

    The error is 1, as large as the image, if no beam touches a subimage.
    """
    weighted = model.beam is not None and stages[-1].beam_cycles is not None
    line = _line(model, line_at)
    samples = _samples(model, line_at, stages[-1].side, weighted, extents)
    if samples is None:
        return _Interpolated(1.0, 0.0)
    at = _with_ends(model, line, samples, stages[:-1])
    nodes = _virtual_channels(line, samples.points, stages[-1], extents, at.coordinate)
    of_nodes = _steering(model, line, samples.pixels, weighted, nodes.coordinate)
    # One sparse matrix interpolates at all aperture coordinates of all subimages.
    index = nodes.contributed
    weights = nodes.weights.astype(np.float32).ravel()
    rows = np.arange(0, weights.size + 1, nodes.taps)
    of_nodes = of_nodes.reshape(-1, of_nodes.shape[-1])
    interpolate = csr_array((weights, index.ravel(), rows), shape=(len(rows) - 1, len(of_nodes)))
    exact = samples.exact
    if len(stages) > 1:
        exact = _steering(model, line, samples.pixels, weighted, at.coordinate)
    wrong = (interpolate @ of_nodes).reshape(exact.shape) - exact
    error, bias = (
        samples.count @ np.einsum("ns,nsp,nsp->n", at.share, *each, dtype=np.float64)
        for each in ((wrong, wrong), (wrong, exact))
    )
    total = samples.count @ np.einsum("nsp,nsp->n", samples.exact, samples.exact, dtype=np.float64)
    total = max(total, 1e-30)
    return _Interpolated(float(error / total), float(bias / total))


def _virtual_channels(
    line: _Line,
    points: NDArray[np.int64],
    stage: SpacedStage,
    extents: Sequence[float],
    coordinate: NDArray[np.float64],
) -> VirtualChannels:
    """Return a stage's virtual channels for channels at aperture coordinates, [n, places]."""
    rates = stage.oversampling * np.tensordot(extents, line.rates[:, points], 1)
    if stage.beam_cycles:
        rates = rates + stage.beam_cycles * line.beam_rates[points]
    interpolated = strip_channels if line.track.others else interpolated_channels
    return interpolated(line.track, rates, coordinate, stage.aperture)


@dataclass(frozen=True, eq=False)
class _Places:
    """Places along the aperture from which a stage interpolates, [n, places] each.

    Attributes
    ----------
    coordinate : float64
        Aperture coordinates, ascending.
    share : float64
        Power, in units of a sampled channel.
    """

    coordinate: NDArray[np.float64]
    share: NDArray[np.float64]


def _with_ends(model: VisibilityModel, line: _Line, samples: _Samples, before: Stages) -> _Places:
    """Return sampled channels, and the virtual channels past the aperture's ends of stages before.

    Filters extend past the ends, farther with every stage. What virtual channels hold there must be
    interpolated too, though it may lie where phases turn faster than they do on the track.
    """
    of_channels = samples.coordinate
    at = _Places(of_channels, np.ones(of_channels.shape))
    for stage in before:
        extents = model.extents(stage.side)
        nodes = _virtual_channels(line, samples.points, stage, tuple(extents), at.coordinate)
        share = at.share[..., None] * nodes.weights**2
        held = np.bincount(nodes.contributed.ravel(), share.ravel(), nodes.coordinate.size)
        held = held.reshape(nodes.coordinate.shape) * line.past_ends(nodes.coordinate)
        some = held.any(axis=0)
        coordinate = np.concatenate([of_channels, nodes.coordinate[:, some]], axis=1)
        share = np.concatenate([np.ones(of_channels.shape), held[:, some]], axis=1)
        order = np.argsort(coordinate, axis=1, kind="stable")
        at = _Places(*(np.take_along_axis(each, order, axis=1) for each in (coordinate, share)))
    return at


@dataclass(frozen=True, eq=False)
class _Samples:
    """Sampled subimages of a size, and the steering functions of sampled pixels in them.

    Attributes
    ----------
    points : int64 [n]
        The sample points that they lie at.
    count : int64 [n]
        Number of channels whose beam touches each.
    coordinate : float64 [n, places]
        Aperture coordinates, ascending, distributed as those of the channels.
    pixels : (centres_m, offsets_m, cycles_per_m)
        See `_steering`.
    exact : float32 [n, places, 2 pixels]
        The steering functions.
    """

    points: NDArray[np.int64]
    count: NDArray[np.int64]
    coordinate: NDArray[np.float64]
    pixels: _Pixels
    exact: NDArray[np.float32]


@cached
def _samples(
    model: VisibilityModel,
    line_at: _Place,
    side: Side,
    weighted: bool,
    extents: tuple[float, ...],
) -> _Samples | None:
    """Return the samples for subimages of a size, None if no beam touches any."""
    line = _line(model, line_at)
    channels, first, count = _visible_channels(model, line, side)
    if not count.any():
        return None
    points = np.flatnonzero(count)
    # A step of the beam's weights crosses only some points: these may not be left out.
    steps = weighted and model.beam is not None and model.beam.jumps
    if not steps and np.isin(points, SPREAD_POINTS).any():
        points = np.intersect1d(points, SPREAD_POINTS)
    first, count = first[points], count[points]
    # One channel more on either side: the edge of visibility lies in between.
    number = np.linspace(
        first - 1,
        first + count,
        _SAMPLED_PLACES + _PLACES_OF_STRIP * len(line.track.others),
        axis=1,
    )
    number = np.clip(number, 0, len(channels) - 1)
    if line.track.others:  # there is nothing between two strips
        number = np.rint(number)
    place = np.interp(number, np.arange(len(channels)), channels)
    cycles_per_m = carriers(model, SAMPLED_PIXELS)
    found = [pixels_m(model, np.array(extents), point) for point in points.tolist()]
    offsets_m = np.stack([each_m for each_m, _ in found])
    chosen = np.stack([cycles_per_m[(share * SAMPLED_PIXELS).astype(int)] for _, share in found])
    centres_m = model.points_m[points] + _within_roots_m(model, extents)[points]
    pixels = centres_m, offsets_m, chosen
    return _Samples(points, count, place, pixels, _steering(model, line, pixels, weighted, place))


def _within_roots_m(model: VisibilityModel, extents: tuple[float, ...]) -> NDArray[np.float64]:
    """Return where in roots about the sample points subimages are sampled, [points, 3].

    Phases turn fastest in a corner, for which the spacing is made. Where a beam selects channels
    they are those of the sample point itself.
    """
    if model.root is None or not (model.limits is None or model.track.is_dense):
        return np.zeros((len(model.points_m), 3))
    spare = np.maximum(model.extents(model.root, most=True) - extents, 0.0)[:2]
    return (_CORNERS.reshape(-1, 2) * spare / 2) @ model.surface.steps_m[:2]


def _visible_channels(
    model: VisibilityModel, line: _Line, side: Side
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Return which channels' beams touch subimages of a size at the sample points.

    The channels' aperture coordinates, ascending; then for each point the first channel, and the
    number of channels, 0 where the track has a gap. The edges of visibility lie between samples of
    the track, so the range is one sample wider on either side.
    """
    places, samples = line.channels, model.track.samples
    if model.track.is_sheet:
        none = np.zeros(len(model.points_m), np.int64)
        return places, none, none + len(places)
    visible = model.visible(side)
    begin = samples[np.maximum(visible.argmax(axis=1) - 1, 0)]
    last = visible.shape[1] - visible[:, ::-1].argmax(axis=1)
    end = samples[np.minimum(last, len(samples) - 1)]
    end[~visible.any(axis=1)] = -np.inf
    first = np.searchsorted(places, begin)
    return places, first, np.maximum(np.searchsorted(places, end, "right") - first, 0)


def _steering(
    model: VisibilityModel,
    line: _Line,
    pixels: _Pixels,
    weighted: bool,
    at: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return steering functions at aperture coordinates, float32 [n, places, 2 pixels].

    The real parts of all pixels come first, then the imaginary ones.

    Parameters
    ----------
    pixels : (centres_m, offsets_m, cycles_per_m)
        Centres of subimages, float64 [n, 3]; from these the reference point and then the pixels,
        [n, pixels + 1, 3]; phase per metre of range of each pixel, [n, pixels].
    weighted : bool
        Multiply by the beam's weights.
    at : float64 [n, places]
    """
    centres_m, offsets_m, cycles_per_m = pixels
    sight = centres_m[:, None] - line.track.positions_m(at)
    offsets_m = offsets_m.swapaxes(1, 2)
    square = np.einsum("nsi,nsi->ns", sight, sight)[..., None] + 2 * sight @ offsets_m
    square += np.einsum("nip,nip->np", offsets_m, offsets_m)[:, None]
    range_m = np.sqrt(np.maximum(square, 1e-18))
    turns = cycles_per_m[:, None] * (range_m[..., 1:] - range_m[..., :1])
    angle = (2 * np.pi * (turns - np.rint(turns))).astype(np.float32)
    result = np.concatenate([np.cos(angle), np.sin(angle)], axis=-1)
    if weighted and model.beam is not None and line.along is not None:
        along = interpolated_directions(line.track.samples, line.along, at)
        sine = np.einsum("nsi,nsi->ns", sight, along)[..., None]
        sine = (sine + along @ offsets_m[..., 1:]) / range_m[..., 1:]
        weights = model.beam.weights(sine, wavelength_m(model.lines)).astype(np.float32)
        result *= np.concatenate([weights, weights], axis=-1)
    return result
