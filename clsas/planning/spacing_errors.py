"""Error of virtual channels whose spacing changes, and of beam weights that change between them.

The filter along the aperture is designed for equally spaced virtual channels and constant weights.
Here the steering functions of sampled pixels are interpolated between the virtual channels of a
candidate and compared with the exact ones.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from clsas.aperture.beam_directions import interpolated_directions
from clsas.aperture.dense_channels import strip_channels
from clsas.aperture.virtual_channels import VirtualChannels, interpolated_channels
from clsas.core.decibels import power
from clsas.core.wavelengths import wavelength_m
from clsas.planning.aperture_lines import Line, SampledLine, sampled_line, visible_channels
from clsas.planning.caching import cached
from clsas.planning.channels import carriers
from clsas.planning.sample_pixels import SAMPLED_PIXELS, SPREAD_POINTS, mean_over_relief, pixels_m
from clsas.planning.subimages import Side
from clsas.planning.visibility_model import VisibilityModel
from clsas.signal.interpolation import Interpolator

# Corners of roots in which subimages are sampled, by row and column of the sample points: at the
# edges of the grid those that lie inside.
_CORNERS = np.stack(np.meshgrid((1, -1, 1, 1, -1), (1, -1, -1, 1, -1), indexing="ij"), axis=-1)
_SAMPLED_CHANNELS = 96  # of the visible aperture; half as many move the error by 3 dB at most
_CHANNELS_OF_STRIP = 16  # more of them, for each strip after the first


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


_TRACK = (Line("track"),)
_ALONG = (Line("along", 0.5),)
_ACROSS = (Line("across", 0.2), Line("across", 0.5))


@cached
def spacing_error(model: VisibilityModel, stages: Stages) -> float:
    """Return the error power that uneven spacing adds to that of the filter, in the last stage.

    `model` must have the root size of the candidate.
    """

    def excess(error: float) -> float:
        return max(error - power(stages[-1].aperture.error_db), 0.0)

    return _sum_over_dimensions(model, stages, excess)


def filter_error(model: VisibilityModel, stages: Stages) -> float:
    """Return the error power of the filter along the aperture, in the last stage.

    On a sheet, virtual channels are everywhere as dense as the largest phase rate of any line along
    it and across it requires. Where phases turn more slowly, the error is below the filter's worst.
    """
    worst = power(stages[-1].aperture.error_db)
    if not model.track.is_sheet:
        return worst

    def least(error: float) -> float:
        return min(error, worst)

    return _sum_over_dimensions(model, stages, least)


def bias_error(model: VisibilityModel, stages: Stages) -> float:
    """Return the extra error power because filter biases on a sheet add coherently.

    Filters of few taps attenuate steering functions. The mean attenuation is common to all
    interpolations, along and across and in every stage, so that its amplitudes add, not its powers.
    """
    if not model.track.is_sheet:
        return 0.0
    each_stage = [stages[: level + 1] for level in range(len(stages))]
    biases = np.array([_bias(model, lines, to) for to in each_stage for lines in (_ALONG, _ACROSS)])
    return float(max(biases.sum() ** 2 - biases @ biases, 0.0))


def _bias(model: VisibilityModel, lines: tuple[Line, ...], stages: Stages) -> float:
    """Return the mean relative error of amplitudes over some lines, in the last stage."""
    extents = tuple(model.surface.extents(stages[-1].side))
    errors = [_interpolation_error(model, each, stages, extents) for each in lines]
    return float(np.mean([each.bias for each in errors]))


def _sum_over_dimensions(
    model: VisibilityModel, stages: Stages, part: Callable[[float], float]
) -> float:
    """Return a part of the error of interpolating along the track, or along and across a sheet."""

    def error(line: Line, extents: NDArray[np.float64]) -> float:
        return part(_interpolation_error(model, line, stages, tuple(extents)).power)

    def mean(lines: tuple[Line, ...]) -> float:
        side = stages[-1].side
        found = [mean_over_relief(model, side, functools.partial(error, each)) for each in lines]
        return sum(found) / len(found)

    if not model.track.is_sheet:
        return mean(_TRACK)
    return sum(mean(lines) for lines in (_ALONG, _ACROSS))


@dataclass(frozen=True)
class _InterpolationError:
    """Error of steering functions that are interpolated between virtual channels.

    Attributes
    ----------
    power : float
        Relative error power.
    bias : float
        Mean error in the direction of the exact functions, over their power.
    """

    power: float
    bias: float


@cached
def _interpolation_error(
    model: VisibilityModel, line_at: Line, stages: Stages, extents: tuple[float, ...]
) -> _InterpolationError:
    """Return the error of steering functions in the last stage's subimages of some extents.

    It is 1, as large as the image, if no beam touches a subimage.
    """
    weighted = model.beam is not None and stages[-1].beam_cycles is not None
    line = sampled_line(model, line_at)
    samples = _samples(model, line_at, stages[-1].side, weighted, extents)
    if samples is None:
        return _InterpolationError(power=1.0, bias=0.0)
    sources = _with_ends(model, line, samples, stages[:-1])
    virtual = _virtual_channels(line, samples.points, stages[-1], extents, sources.coordinate)
    steering = _steering(model, line, samples.pixels, weighted, virtual.coordinate)
    steering = steering.reshape(-1, steering.shape[-1])
    # One sparse matrix interpolates at all aperture coordinates of all subimages.
    weights = virtual.weights.astype(np.float32).ravel()
    rows = np.arange(0, weights.size + 1, virtual.taps)
    interpolate = csr_array(
        (weights, virtual.contributed.ravel(), rows), shape=(len(rows) - 1, len(steering))
    )
    exact = samples.exact
    if len(stages) > 1:
        exact = _steering(model, line, samples.pixels, weighted, sources.coordinate)
    wrong = (interpolate @ steering).reshape(exact.shape) - exact
    error, bias = (
        samples.count @ np.einsum("ns,nsp,nsp->n", sources.share, *each, dtype=np.float64)
        for each in ((wrong, wrong), (wrong, exact))
    )
    total = samples.count @ np.einsum("nsp,nsp->n", samples.exact, samples.exact, dtype=np.float64)
    total = max(total, 1e-30)
    return _InterpolationError(power=float(error / total), bias=float(bias / total))


def _virtual_channels(
    line: SampledLine,
    points: NDArray[np.int64],
    stage: SpacedStage,
    extents: Sequence[float],
    coordinate: NDArray[np.float64],
) -> VirtualChannels:
    """Return a stage's virtual channels for channels at aperture coordinates, [n, channels]."""
    rates = stage.oversampling * np.tensordot(extents, line.rates[:, points], 1)
    if stage.beam_cycles:
        rates = rates + stage.beam_cycles * line.beam_rates[points]
    interpolated = strip_channels if line.track.others else interpolated_channels
    return interpolated(line.track, rates, coordinate, stage.aperture)


@dataclass(frozen=True, eq=False)
class _Sources:
    """Channels, or virtual channels, that a stage interpolates for, [n, channels] each.

    Attributes
    ----------
    coordinate : float64
        Aperture coordinates, ascending.
    share : float64
        Power, in units of a sampled channel.
    """

    coordinate: NDArray[np.float64]
    share: NDArray[np.float64]


def _with_ends(
    model: VisibilityModel, line: SampledLine, samples: _Samples, before: Stages
) -> _Sources:
    """Return sampled channels, with the earlier stages' virtual channels past the aperture's ends.

    Filters extend past the ends, farther with every stage. The power of virtual channels there must
    be interpolated too, although phases may turn faster there than on the track.
    """
    of_channels = samples.coordinate
    sources = _Sources(of_channels, np.ones(of_channels.shape))
    for stage in before:
        extents = tuple(model.extents(stage.side))
        virtual = _virtual_channels(line, samples.points, stage, extents, sources.coordinate)
        share = sources.share[..., None] * virtual.weights**2
        size = virtual.coordinate.size
        power_past = np.bincount(virtual.contributed.ravel(), share.ravel(), size)
        power_past = power_past.reshape(virtual.coordinate.shape)
        power_past = power_past * line.past_ends(virtual.coordinate)
        some = power_past.any(axis=0)
        coordinate = np.concatenate([of_channels, virtual.coordinate[:, some]], axis=1)
        share = np.concatenate([np.ones(of_channels.shape), power_past[:, some]], axis=1)
        order = np.argsort(coordinate, axis=1, kind="stable")
        sources = _Sources(*(np.take_along_axis(each, order, 1) for each in (coordinate, share)))
    return sources


@dataclass(frozen=True, eq=False)
class _Pixels:
    """Sampled pixels of n subimages.

    Attributes
    ----------
    centres_m : float64 [n, 3]
        Centres of the subimages.
    offsets_m : float64 [n, pixels + 1, 3]
        From these the reference point, and then the pixels.
    cycles_per_m : float64 [n, pixels]
        Phase per metre of range of each pixel.
    """

    centres_m: NDArray[np.float64]
    offsets_m: NDArray[np.float64]
    cycles_per_m: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Samples:
    """Sampled subimages of a size, with the steering functions of sampled pixels in them.

    Attributes
    ----------
    points : int64 [n]
        Sample points at which they lie.
    count : int64 [n]
        Number of channels whose beam touches each.
    coordinate : float64 [n, channels]
        Aperture coordinates of sampled channels, ascending.
    pixels : _Pixels
    exact : float32 [n, channels, 2 pixels]
        The steering functions: see `_steering`.
    """

    points: NDArray[np.int64]
    count: NDArray[np.int64]
    coordinate: NDArray[np.float64]
    pixels: _Pixels
    exact: NDArray[np.float32]


@cached
def _samples(
    model: VisibilityModel,
    line_at: Line,
    side: Side,
    weighted: bool,
    extents: tuple[float, ...],
) -> _Samples | None:
    """Return the samples for subimages of a size, None if no beam touches any."""
    line = sampled_line(model, line_at)
    channels, first, count = visible_channels(model, line, side)
    if not count.any():
        return None
    points = np.flatnonzero(count)
    # A step of the beam's weights crosses only some points, which must all be kept.
    steps = weighted and model.beam is not None and model.beam.jumps
    if not steps and np.isin(points, SPREAD_POINTS).any():
        points = np.intersect1d(points, SPREAD_POINTS)
    first, count = first[points], count[points]
    # One channel more on either side: the edge of visibility lies in between.
    number = np.linspace(
        first - 1,
        first + count,
        _SAMPLED_CHANNELS + _CHANNELS_OF_STRIP * len(line.track.others),
        axis=1,
    )
    number = np.clip(number, 0, len(channels) - 1)
    if line.track.others:  # there is nothing between two strips
        number = np.rint(number)
    coordinate = np.interp(number, np.arange(len(channels)), channels)
    cycles_per_m = carriers(model, SAMPLED_PIXELS)
    found = [pixels_m(model, np.array(extents), point) for point in points.tolist()]
    offsets_m = np.stack([each_m for each_m, _ in found])
    chosen = np.stack([cycles_per_m[(share * SAMPLED_PIXELS).astype(int)] for _, share in found])
    centres_m = model.points_m[points] + _within_roots_m(model, extents)[points]
    pixels = _Pixels(centres_m, offsets_m, chosen)
    exact = _steering(model, line, pixels, weighted, coordinate)
    return _Samples(points, count, coordinate, pixels, exact)


def _within_roots_m(model: VisibilityModel, extents: tuple[float, ...]) -> NDArray[np.float64]:
    """Return the offsets of sampled subimages from the sample points, in roots there, [points, 3].

    Virtual channels are spaced for the corner of a root, where phases turn fastest, and errors are
    sampled there. Where a beam selects channels, they are those of the sample point itself.
    """
    if model.root is None or not (model.limits is None or model.track.is_dense):
        return np.zeros((len(model.points_m), 3))
    spare = np.maximum(model.extents(model.root, most=True) - extents, 0.0)[:2]
    return (_CORNERS.reshape(-1, 2) * spare / 2) @ model.surface.steps_m[:2]


def _steering(
    model: VisibilityModel,
    line: SampledLine,
    pixels: _Pixels,
    weighted: bool,
    at: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return steering functions at aperture coordinates `at`, float32 [n, channels, 2 pixels].

    The real parts of all pixels come first, then the imaginary ones. If `weighted`, they are
    multiplied by the beam's weights.
    """
    cycles_per_m = pixels.cycles_per_m
    sight = pixels.centres_m[:, None] - line.track.positions_m(at)
    offsets_m = pixels.offsets_m.swapaxes(1, 2)
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
