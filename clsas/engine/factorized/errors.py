"""The error of a candidate: one term for each cause, whose powers add up.

A candidate is a tree of subimages with filters between its stages. `errors_of_tree` finds what the
tree itself causes, `with_range_filters` and `with_arithmetic` add the terms of the filters in range
and of number formats, and choose the cheapest upsampling, polynomials and precision that the
tolerance leaves room for. `ErrorBudget` lists all terms, and says where each is found.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial.distance import cdist

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.decibels import in_db, power
from clsas.engine.data.geometry import pairwise_range_m
from clsas.engine.data.lines import wavelength_m
from clsas.engine.data.visibility import sine_width, sines
from clsas.engine.device import kernels
from clsas.engine.device.device import Device
from clsas.engine.exact.decide import ROUNDING
from clsas.engine.exact.layout import BLOCKS, lookup_room
from clsas.engine.factorized.buffers import CHUNK
from clsas.engine.factorized.filters import (
    LONGEST_UPSAMPLING_SHARE,
    UPSAMPLING_SHARE,
    Filters,
    Gain,
)
from clsas.engine.factorized.phase_rates import drift, interpolated_directions, stretches
from clsas.engine.factorized.plan import ErrorBudget
from clsas.engine.factorized.sampled import (
    SAMPLED_PIXELS,
    SPREAD_POINTS,
    SampledChannels,
    SampledRoots,
    Side,
    mean_over_relief,
    pixels_m,
    reliefs_of,
    sampled_channels,
)
from clsas.engine.factorized.track import MeanTrack
from clsas.engine.factorized.virtual_channels import (
    InterpolatedAperture,
    NearestBeams,
    VirtualChannels,
    interpolated_channels,
    stage_errors_m,
    strip_channels,
)
from clsas.engine.signal import interpolation
from clsas.engine.signal.ambiguity import MARGIN_DB
from clsas.engine.signal.interpolation import PHASES, Interpolator, Resampling, Upsampler

HALF_ROUNDING = 4e-8
"""Power of the error that rounding lines to half precision once adds: 2^-11/sqrt(6) rms."""

_FEW_CHANNELS = 7.0, 30.0  # per pixel, that double the scatter of errors; second: beams with steps
# Rms error of a phase in the stages, from float32, over the phase across a root: measured. With
# half of it, images at -60 dB are up to 3 % faster; with twice, measured errors fall by 0.1 dB.
_FLOAT32 = 4.5e-8
# Largest error power of a leaf over the mean of all. The error grows with the sixth power of the
# inverse distance, and the nearest pixels may be the brightest. Images of an ultrasound array of
# 20 mm from 6 mm on keep -40 dB with 64 too, if only the nearest 3 % of the pixels are bright; with
# 4, no leaf of some of them is small enough. Half or twice changes no scene of
# `scripts/bench sensitivity`.
_MOST_OF_MEAN = 16.0
_SAMPLED_CHANNELS = 96  # of the visible aperture; half as many move the error by 3 dB at most
_CHANNELS_OF_STRIP = 16  # more of them, for each strip after the first
_CHANNELS_OF_LINE = 384  # evenly spaced along a line of a sheet: four times those sampled of them
_ALONG, _ACROSS = (0.5,), (0.2, 0.5)  # where lines along and across a sheet lie
_ROUNDING_SHARE = 0.1  # of an image's error power, for half precision; half or twice: no change
_MOST_CHUNKS = 16  # in a sum in half precision; in longer sums, addends vanish by rounding


def margin_db(roots: SampledRoots) -> float:
    """Return the margin of predicted errors, dB, which covers the scatter of measured ones.

    Errors scatter more if a pixel receives from few channels, or if few channels have most of the
    power: they then depend on the positions of these channels between virtual ones, and relative to
    a step of the beam. They also scatter more if the lines' power lies at few frequencies.
    """
    scene, of_channels = roots.sampled.scene, roots.sampled.channel_power
    channels = (
        of_channels.sum() ** 2 / (of_channels @ of_channels) * roots.visible_share(roots.small)
    )
    few = _FEW_CHANNELS[scene.beam is not None and scene.beam.jumps]
    return MARGIN_DB + in_db(scene.spectrum.scatter * (1 + few / max(channels, 1.0)))


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


def errors_of_tree(
    spacing: SpacingErrors,
    sides: Sequence[Side],
    filters: Filters,
    oversampling: tuple[float, ...],
    beam_cycles: float,
    device: Device,
) -> tuple[ErrorBudget, tuple[float, ...]]:
    """Return the errors that a tree causes, and those of uneven spacing by stage.

    They are those of the filter along the aperture, of uneven spacing of virtual channels, and of
    the expansion of ranges in leaves. Only the virtual channels of the last stage follow the beam.
    """
    last = len(sides) - 1
    found = [
        spacing.of_stage(
            SpacedStage(side, filters.aperture, denser, beam_cycles if level == last else 0.0)
        )
        for level, (side, denser) in enumerate(zip(sides, oversampling, strict=True))
    ]
    by_stage = tuple(stage.uneven for stage in found)
    # Filters of few taps attenuate steering functions. The mean attenuation is common to all
    # interpolations on a sheet, along and across and in every stage, so that its amplitudes add.
    bias = np.array([each for stage in found for each in stage.biases])
    in_common = float(max(bias.sum() ** 2 - bias @ bias, 0.0))
    errors = ErrorBudget(
        aperture_filters=sum(stage.of_filter for stage in found) + in_common,
        spacing=sum(by_stage),
        leaves=float(leaf_error(spacing.roots, np.array([sides[-1]]), device)[0]),
    )
    return errors, by_stage


def leaf_error(
    roots: SampledRoots, sides: NDArray[np.int64], device: Device
) -> NDArray[np.float64]:
    """Return the error power of expanding ranges and weights in leaves, [sizes].

    As in exact images, the remainder is of fourth order; in long leaves its rms is 0.35 of its
    maximum. It is averaged over the pixels, among which the nearest have the largest error. Off a
    plane nothing is expanded, and the error is float32's rounding.
    """
    sampled, surface, beam = roots.sampled, roots.sampled.scene.surface, roots.sampled.scene.beam
    if not surface.is_plane:
        radius_m = np.array([surface.radius_m(tuple(side)) for side in sides.tolist()])
        return (ROUNDING * sampled.highest_cycles_per_m * radius_m) ** 2
    steps_m = np.linalg.norm(surface.steps_m, axis=1)
    radius_m = np.hypot(*(sides * steps_m).T)[:, None] / 2
    block_m = np.hypot(*(np.array(BLOCKS[device.info.width]) * steps_m)) / 2
    distance_m = sampled.distances_m
    remainder_m = 0.35 * radius_m**4 / (8 * distance_m**3)
    result = (2 * np.pi * sampled.highest_cycles_per_m * remainder_m) ** 2
    if beam is not None:
        result += [beam.block_error(reach) ** 2 for reach in block_m / distance_m]
        result += (0.1 * (radius_m / distance_m) ** 4 / sine_width(beam.limits)) ** 2
    return np.maximum(result.mean(axis=1), result[:, 0] / _MOST_OF_MEAN)


# Roots: channels are replaced by positions on the mean track


def root_error(roots: SampledRoots, side: Side) -> float:
    """Return the error power of roots: rounding, and channels replaced by the mean track.

    `roots` are the sample points alone, without a size.
    """
    surface = roots.sampled.scene.surface
    reliefs, share = reliefs_of(surface, side, None)
    errors = np.array([_mean_track_error(roots, side, each) for each in reliefs])
    replaced = mean_over_relief(errors, share)
    sides_m = roots.extents(side, most=True) * np.linalg.norm(surface.steps_m, axis=1)
    radius_m = np.linalg.norm(sides_m) / 2
    rounding = (2 * np.pi * _FLOAT32 * roots.sampled.highest_cycles_per_m * radius_m) ** 2
    return float(replaced + rounding)


def _mean_track_error(roots: SampledRoots, side: Side, extents: tuple[float, ...]) -> float:
    """Return the error power of channels that are replaced by positions on the mean track.

    This covers track errors, separate transmitters and receivers, and motion during flight. With a
    beam it adds the difference between the weights of the two.
    """
    sampled, channels = roots.sampled, sampled_channels(roots, side)
    if not channels.points.size:
        return 0.0
    # [points, pixels, channels]; the first pixel is the centre of a root.
    surface, beam = sampled.scene.surface, sampled.scene.beam
    offsets_m = np.stack(
        [pixels_m(surface, np.array(extents), point)[0] for point in channels.points]
    )
    points_m = sampled.points_m[channels.points, None] + offsets_m
    virtual_m = channels.virtual_m(points_m[:, 0])
    error = phase_error(roots, channels, points_m, virtual_m)
    if beam is None:
        return relative_error(channels.weight, error, np.ones_like(error))
    weights, of_virtual = beam_weights(beam, channels, points_m, virtual_m)
    return relative_error(
        channels.weight, weights**2 * error + (weights - of_virtual) ** 2, weights
    )


def relative_error(
    channel_power: NDArray[np.float64], error: NDArray[np.float64], weights: NDArray[np.float64]
) -> float:
    """Return the power of errors over that of the contributions to an image.

    Parameters
    ----------
    channel_power : float64 [points, channels]
    error : float64 [points, pixels, channels]
        Error power of each contribution, for channels of unit power.
    weights : float64 [points, pixels, channels]
        Weights of the contributions; 1 without a beam.
    """
    channel_power = channel_power[:, None]
    image_power = max(np.sum(channel_power * weights**2), 1e-30)
    return float(np.sum(channel_power * error) / image_power)


def phase_error(
    roots: SampledRoots,
    channels: SampledChannels,
    points_m: NDArray[np.float64],
    virtual_m: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the error power of phases and envelopes, float64 [points, pixels - 1, channels].

    Channels are replaced by positions on the mean track that have the same range to the centre of a
    root. Their phase is wrong by the difference between the changes of both ranges from the centre
    to a pixel. The first stage makes up for a part of it by stretching the range from the virtual
    position.

    Parameters
    ----------
    roots : SampledRoots
    channels : SampledChannels
    points_m : float64 [points, pixels, 3]
        The centre of a root at each sample point, and then pixels of the root.
    virtual_m : float64 [points, channels, 3]
        Positions on the mean track that replace the channels.
    """
    sampled, scene = roots.sampled, roots.sampled.scene
    along = drift(scene.lines)
    range_m = pairwise_range_m(points_m.reshape(-1, 3), *channels.antennas)
    range_m = range_m.reshape(*points_m.shape[:2], -1)
    virtual_range_m = np.stack([cdist(*each) for each in zip(points_m, virtual_m, strict=True)])
    virtual_range_m -= (points_m @ along)[..., None]
    change_m, virtual_change_m = (each[:, 1:] - each[:, :1] for each in (range_m, virtual_range_m))
    of_channels = stretches(
        *channels.antennas, along, scene.surface.plane, points_m[:, 0], virtual_m
    )[:, None]
    residual_m = change_m - virtual_change_m * (1 + of_channels)
    # A line's phase follows its channel's stretch, its envelope the mean of all.
    envelope_m = virtual_change_m * (of_channels - roots.stretch.mean)
    error = (2 * np.pi * sampled.highest_cycles_per_m * residual_m) ** 2
    error += (2 * np.pi * sampled.rms_cycles_per_m * envelope_m) ** 2
    return error


def beam_weights(
    beam: BeamWindow,
    channels: SampledChannels,
    points_m: NDArray[np.float64],
    virtual_m: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a beam's weights of channels and of the positions that replace them.

    Arguments and shapes are those of `phase_error`.
    """
    sampled = channels.sampled
    assert sampled.directions is not None
    assert sampled.scene.along is not None
    part, along = channels.part, sampled.scene.along[channels.index]
    directions = sampled.directions.at(part.coordinate, part.across)
    virtual = [sines(*each, directions) for each in zip(points_m, virtual_m, strict=True)]
    real = [sines(each, channels.phase_centres_m, along) for each in points_m]
    weights, of_virtual = (
        beam.weights(np.stack(each).swapaxes(1, 2)[:, 1:], wavelength_m(sampled.scene.lines))
        for each in (real, virtual)
    )
    return weights, of_virtual


# Spacing: steering functions are interpolated between virtual channels


@dataclass(frozen=True, eq=False)
class _Line:
    """A line of the aperture: the mean track, or a line along or across a sheet.

    Attributes
    ----------
    track : MeanTrack
        The line as a curve of its own.
    rates : float64 [axes, points, samples]
        Phase rates: see `SampledRoots`.
    channels : float64 [channels]
        Aperture coordinates of channels, ascending. On a sheet they are evenly spaced.
    along : float64 [samples, 3] or None
        Unit directions of the beam at `track.samples`.
    beam_rates : float64 [points, samples]
        Phase rates of the beam's weights, 0 without a beam.
    """

    track: MeanTrack
    rates: NDArray[np.float64]
    channels: NDArray[np.float64]
    along: NDArray[np.float64] | None
    beam_rates: NDArray[np.float64]

    def virtual_channels(
        self,
        points: NDArray[np.int64],
        stage: SpacedStage,
        extents: Sequence[float] | NDArray[np.float64],
        coordinate: NDArray[np.float64],
    ) -> VirtualChannels:
        """Return a stage's virtual channels for channels at aperture coordinates, [n, channels]."""
        rates = stage.oversampling * np.tensordot(extents, self.rates[:, points], 1)
        if stage.beam_cycles:
            rates = rates + stage.beam_cycles * self.beam_rates[points]
        interpolated = strip_channels if self.track.others else interpolated_channels
        return interpolated(self.track, rates, coordinate, stage.aperture)


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
    centres_m : float64 [n, 3]
        Centres of the subimages.
    offsets_m : float64 [n, pixels + 1, 3]
        From these the reference point, and then the pixels.
    cycles_per_m : float64 [n, pixels]
        Phase per metre of range of each pixel.
    exact : float32 [n, channels, 2 pixels]
        The steering functions: see `SpacingErrors.steering`.
    """

    points: NDArray[np.int64]
    count: NDArray[np.int64]
    coordinate: NDArray[np.float64]
    centres_m: NDArray[np.float64]
    offsets_m: NDArray[np.float64]
    cycles_per_m: NDArray[np.float64]
    exact: NDArray[np.float32]


@dataclass(frozen=True)
class StageErrors:
    """Errors of a stage's virtual channels.

    Attributes
    ----------
    uneven : float
        Error power that uneven spacing adds to that of the filter.
    of_filter : float
        Error power of the filter along the aperture. On a sheet, virtual channels are everywhere as
        dense as the largest phase rate of any line along it and across it requires. Where phases
        turn more slowly, the error is below the filter's worst.
    biases : list of float
        On a sheet, the biases of the filter along and across it.
    """

    uneven: float
    of_filter: float
    biases: list[float]


class SpacingErrors:
    """Error of virtual channels whose spacing changes, and of weights that change between them.

    The filter along the aperture is designed for equally spaced virtual channels and constant
    weights. Here the steering functions of sampled pixels are interpolated between the virtual
    channels of a candidate and compared with the exact ones. Candidates with roots of the same size
    share what is sampled, and stages that they have in common.

    Parameters
    ----------
    roots : SampledRoots
        In roots of the candidates' size.
    """

    def __init__(self, roots: SampledRoots) -> None:
        assert roots.side is not None
        self.roots = roots
        self._is_sheet = roots.sampled.track.is_sheet
        if self._is_sheet:
            self._lines = {
                "along": tuple(_line_along(roots, each) for each in _ALONG),
                "across": tuple(_line_across(roots, each) for each in _ACROSS),
            }
        else:
            self._lines = {"track": (_line_of_track(roots),)}
        self._samples: dict[tuple[_Line, Side, bool, tuple[float, ...]], _Samples | None] = {}
        self._found: dict[tuple[_Line, SpacedStage, tuple[float, ...]], tuple[float, float]] = {}

    def of_stage(self, stage: SpacedStage) -> StageErrors:
        """Return the errors of a stage, over the relief of the grid.

        On a sheet, errors along and across it add up.
        """
        surface = self.roots.sampled.scene.surface
        worst = power(stage.aperture.error_db)
        reliefs, share = reliefs_of(surface, stage.side, self.roots.side)
        uneven, of_filter, biases = 0.0, 0.0 if self._is_sheet else worst, []
        for lines in self._lines.values():
            found = [[self._error(line, stage, each) for each in reliefs] for line in lines]
            errors = [np.array([error for error, _ in of_line]) for of_line in found]
            above = [mean_over_relief(np.maximum(each - worst, 0.0), share) for each in errors]
            uneven += sum(above) / len(lines)
            if self._is_sheet:
                below = [mean_over_relief(np.minimum(each, worst), share) for each in errors]
                of_filter += sum(below) / len(lines)
                biases.append(float(np.mean([of_line[0][1] for of_line in found])))
        return StageErrors(uneven, of_filter, biases)

    def _error(
        self, line: _Line, stage: SpacedStage, extents: tuple[float, ...]
    ) -> tuple[float, float]:
        """Return the relative error power of steering functions in the subimages of a stage.

        The second result is the bias: the mean error in the direction of the exact functions, over
        their power. The error is 1, as large as the image, if no beam touches a subimage.
        """
        if (line, stage, extents) in self._found:
            return self._found[line, stage, extents]
        weighted = stage.beam_cycles is not None and self.roots.sampled.scene.beam is not None
        key = line, stage.side, weighted, extents
        if key not in self._samples:
            self._samples[key] = self._sampled(*key)
        samples = self._samples[key]
        if samples is None:
            return 1.0, 0.0
        virtual = line.virtual_channels(samples.points, stage, extents, samples.coordinate)
        steering = self._steering(line, samples, weighted, virtual.coordinate)
        steering = steering.reshape(-1, steering.shape[-1])
        # One sparse matrix interpolates at all aperture coordinates of all subimages.
        weights = virtual.weights.astype(np.float32).ravel()
        rows = np.arange(0, weights.size + 1, virtual.taps)
        interpolate = csr_array(
            (weights, virtual.contributed.ravel(), rows), shape=(len(rows) - 1, len(steering))
        )
        exact = samples.exact
        wrong = (interpolate @ steering).reshape(exact.shape) - exact
        error, bias, total = (
            float(samples.count @ np.einsum("nsp,nsp->n", *each, dtype=np.float64))
            for each in ((wrong, wrong), (wrong, exact), (exact, exact))
        )
        total = max(total, 1e-30)
        self._found[line, stage, extents] = error / total, bias / total
        return self._found[line, stage, extents]

    def _sampled(
        self, line: _Line, side: Side, weighted: bool, extents: tuple[float, ...]
    ) -> _Samples | None:
        """Return the samples for subimages of a size, None if no beam touches any."""
        sampled, channels = self.roots.sampled, line.channels
        first, count = self._visible_channels(channels, side)
        if not count.any():
            return None
        points = np.flatnonzero(count)
        # A step of the beam's weights crosses only some points, which must all be kept.
        beam = sampled.scene.beam
        steps = weighted and beam is not None and beam.jumps
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
        surface = sampled.scene.surface
        found = [pixels_m(surface, np.array(extents), point) for point in points.tolist()]
        chosen = [sampled.carriers[(share * SAMPLED_PIXELS).astype(int)] for _, share in found]
        samples = _Samples(
            points,
            count,
            coordinate,
            centres_m=sampled.points_m[points],
            offsets_m=np.stack([each_m for each_m, _ in found]),
            cycles_per_m=np.stack(chosen),
            exact=np.zeros(0, np.float32),
        )
        return replace(samples, exact=self._steering(line, samples, weighted, coordinate))

    def _visible_channels(
        self, channels: NDArray[np.float64], side: Side
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return which channels' beams touch subimages of a size at the sample points.

        For each point these are the first channel, and the number of channels, which is 0 where the
        track has a gap. The edges of visibility lie between samples of the track, so the range is
        one sample wider on either side.
        """
        samples = self.roots.sampled.track.samples
        if self._is_sheet:
            none = np.zeros(len(self.roots.sampled.points_m), np.int64)
            return none, none + len(channels)
        visible = self.roots.visible(side)
        begin = samples[np.maximum(visible.argmax(axis=1) - 1, 0)]
        last = visible.shape[1] - visible[:, ::-1].argmax(axis=1)
        end = samples[np.minimum(last, len(samples) - 1)]
        end[~visible.any(axis=1)] = -np.inf
        first = np.searchsorted(channels, begin)
        return first, np.maximum(np.searchsorted(channels, end, "right") - first, 0)

    def _steering(
        self, line: _Line, samples: _Samples, weighted: bool, at: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Return steering functions at aperture coordinates `at`, float32 [n, channels, 2 pixels].

        The real parts of all pixels come first, then the imaginary ones. If `weighted`, they are
        multiplied by the beam's weights.
        """
        scene = self.roots.sampled.scene
        sight = samples.centres_m[:, None] - line.track.positions_m(at)
        offsets_m = samples.offsets_m.swapaxes(1, 2)
        square = np.einsum("nsi,nsi->ns", sight, sight)[..., None] + 2 * sight @ offsets_m
        square += np.einsum("nip,nip->np", offsets_m, offsets_m)[:, None]
        range_m = np.sqrt(np.maximum(square, 1e-18))
        turns = samples.cycles_per_m[:, None] * (range_m[..., 1:] - range_m[..., :1])
        angle = (2 * np.pi * (turns - np.rint(turns))).astype(np.float32)
        result = np.concatenate([np.cos(angle), np.sin(angle)], axis=-1)
        if weighted and scene.beam is not None and line.along is not None:
            along = interpolated_directions(line.track.samples, line.along, at)
            sine = np.einsum("nsi,nsi->ns", sight, along)[..., None]
            sine = (sine + along @ offsets_m[..., 1:]) / range_m[..., 1:]
            weights = scene.beam.weights(sine, wavelength_m(scene.lines)).astype(np.float32)
            result *= np.concatenate([weights, weights], axis=-1)
        return result


def _line_of_track(roots: SampledRoots) -> _Line:
    """Return the mean track, if it is a curve or strips."""
    sampled = roots.sampled
    channels = np.sort(sampled.track.coordinate)
    return _Line(sampled.track, roots.rates, channels, sampled.along, roots.beam_rates)


def _line_along(roots: SampledRoots, across: float) -> _Line:
    """Return a line along a sheet, at a coordinate across it."""
    track = roots.sampled.track.line_along(across)
    along = _directions(roots, track.samples, np.full(track.samples.shape, across))
    evenly = np.linspace(0, 1, _CHANNELS_OF_LINE)
    return _Line(track, roots.rates, evenly, along, roots.beam_rates)


def _line_across(roots: SampledRoots, coordinate: float) -> _Line:
    """Return a line across a sheet, at an aperture coordinate."""
    track = roots.sampled.track.line_across(coordinate)
    along = _directions(roots, np.full(track.samples.shape, coordinate), track.samples)
    evenly = np.linspace(0, 1, _CHANNELS_OF_LINE)
    return _Line(track, roots.rates_across, evenly, along, roots.beam_rates_across)


def _directions(
    roots: SampledRoots, coordinate: NDArray[np.float64], across: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    directions = roots.sampled.directions
    return None if directions is None else directions.at(coordinate, across)


# Filters in range, and what is rounded


@dataclass(frozen=True, eq=False)
class UpsampledLines:
    """How lines are upsampled, with the errors of their filters.

    Attributes
    ----------
    upsampler, resampling
        Fields of `Factorization`.
    align_db : float
        Error of one interpolation between upsampled samples.
    errors : ErrorBudget
        Errors of all range filters, and those found before.
    """

    upsampler: Upsampler | None
    resampling: Resampling
    align_db: float
    errors: ErrorBudget


def with_range_filters(
    roots: SampledRoots,
    sides: Sequence[Side],
    align: Interpolator,
    final: Interpolator,
    aperture: InterpolatedAperture | NearestBeams,
    errors: ErrorBudget,
) -> UpsampledLines:
    """Return how the lines of a candidate are upsampled, with the errors of all range filters.

    A gain that corrects the attenuation of the range filters leaves only their scatter.
    """
    sampled, stages = roots.sampled, len(sides)
    spectrum, samples = sampled.scene.spectrum, sampled.scene.lines.length
    step = max(int(PHASES / align.upsampling), 1)
    gain = aperture.lines_gain(align, final, PHASES / step)
    align_db = align.error_db if gain is None else align.scatter_db
    in_range = stages * power(align_db) + power(final.scatter_db)
    if gain is not None:
        in_range += uncompensated(roots, align, final, stages, PHASES / step, gain)
    errors = replace(errors, range_filters=in_range)
    upsampler = None
    if gain is not None:
        allowed_db, most_db = (
            in_db(share * errors.total) for share in (UPSAMPLING_SHARE, LONGEST_UPSAMPLING_SHARE)
        )
        upsampler = interpolation.upsampler(spectrum, step, gain, allowed_db, most_db)
    if upsampler is None:
        resampling = interpolation.resampling(samples, align, spectrum)
    else:
        resampling = upsampler.resampling(samples, align.taps // 2, spectrum)
        errors = replace(errors, upsampling=power(upsampler.error_db))
    if sampled.track.is_dense and isinstance(aperture, InterpolatedAperture):
        resampling = _needed_samples(roots, sides, align, final, resampling)
    return UpsampledLines(upsampler, resampling, align_db, errors)


def _needed_samples(
    roots: SampledRoots,
    sides: Sequence[Side],
    align: Interpolator,
    final: Interpolator,
    resampling: Resampling,
) -> Resampling:
    """Return the upsampled samples without those that no pixel needs.

    Dense apertures have so many channels that upsampling whole lines takes most of the time.
    """
    step_m = roots.sampled.scene.lines.range_step_m
    spare = len(sides) * align.reach + 2 * final.reach
    first, last = (
        math.floor((each_m / step_m + resampling.lead) * resampling.ratio) - resampling.first
        for each_m in roots.sampled.range_window_m(sides[0])
    )
    first, last = max(first - spare, 0), min(last + 1 + spare, resampling.length)
    # The filters' phases repeat every PHASES samples, where a line must begin.
    first -= first % PHASES
    if last - first < 1:
        return resampling
    return replace(resampling, first=resampling.first + first, length=last - first)


def uncompensated(
    roots: SampledRoots,
    align: Interpolator,
    final: Interpolator,
    stages: int,
    ratio: float,
    gain: Gain,
) -> float:
    """Return the error power of a gain that is designed for lines whose band is not shifted.

    The gain corrects the mean response of all range filters. Only the first of them is applied
    before the shift. `ratio` is the number of upsampled samples per sample.
    """
    shares, spectrum = roots.stretch.shares, roots.sampled.scene.spectrum
    if shares is None:
        return 0.0
    before, wide = (
        np.concatenate([-each.frequency[::-1], each.frequency])
        for each in (spectrum, spectrum.shifted(shares))
    )
    after = align.response(wide / ratio) ** (stages - 1) * final.response(wide / ratio)
    shifted = np.lib.stride_tricks.sliding_window_view(after, len(shares))
    of_all = (gain(np.abs(before)) * align.response(before / ratio))[:, None] * shifted
    of_lines = np.concatenate([spectrum.power[::-1], spectrum.power]) / 2
    return float(of_lines @ (of_all - 1) ** 2 @ shares)


def with_arithmetic(
    roots: SampledRoots,
    allowed_db: float | None,
    lines: UpsampledLines,
    summed: Sequence[float],
    bands: int,
    can_halve: bool,
) -> tuple[ErrorBudget, int, bool]:
    """Return the errors with those of polynomials and rounding, and what these are.

    The second result is the number of terms of the polynomials for sine and cosine; the third says
    whether stages store lines in half precision.

    Parameters
    ----------
    roots : SampledRoots
    allowed_db : float or None
        See `Conditions`.
    lines : UpsampledLines
    summed : sequence of float
        Number of channels that a virtual one sums, stage by stage.
    bands : int
        Number of bands that add to a line one after another, in every stage of a sheet.
    can_halve : bool
        False if device, lines or leaves rule out half precision.
    """
    errors = lines.errors
    if allowed_db is None:
        terms = kernels.phase_terms_within(errors.total_db, kernels.FACTORIZED_PHASE_SHARE)
        return errors, terms, False
    terms = kernels.phase_terms_within(allowed_db, kernels.FACTORIZED_PHASE_SHARE)
    errors = replace(errors, phases=kernels.phase_error(terms) ** 2)
    if not can_halve:
        return errors, terms, False
    rounding = _half_rounding(roots, summed, bands)
    if rounding > _ROUNDING_SHARE * power(allowed_db):
        return errors, terms, False
    return replace(errors, half_precision=rounding), terms, True


def _half_rounding(roots: SampledRoots, summed: Sequence[float], bands: int) -> float:
    """Return the error power of rounding lines to half precision.

    Upsampled lines are rounded once. Lines of a stage are rounded once per chunk of channels, while
    the sum still grows; such a rounding counts half. In a sum of very many chunks, the last ones
    vanish by rounding, and the error is infinite.
    """
    chunks = np.array(summed) / CHUNK
    chunks[0] *= roots.sampled.peak_density
    if chunks.max() > _MOST_CHUNKS:
        return np.inf
    return HALF_ROUNDING * (1 + float(np.sum(1 + (chunks + bands) / 2)))


def half_precision_error(stages: int) -> float:
    """Return the least error power that half precision adds through some stages.

    The error is larger if virtual channels are sums of many: see `_half_rounding`.
    """
    return HALF_ROUNDING * (1 + 1.5 * stages)


def looked_up_singly(
    roots: SampledRoots, leaf: Side, taps: int, resampling: Resampling, device: Device
) -> bool:
    """Return whether leaves of points are too thick to look samples up in registers.

    CPUs convert single samples of half precision ten times more slowly than whole registers.
    """
    scene = roots.sampled.scene
    if scene.grid.points_m is None or device.info.width == 1:
        return False
    room = lookup_room(2, taps, device.info.width)
    thickness_m = float(scene.surface.relief_m(leaf).max())
    return thickness_m / 2 * resampling.samples_per_m(scene.lines) > room


# Nearest beams, as in chapter 4 of the thesis


def nearest_errors(
    roots: SampledRoots, stages: Sequence[tuple[int, int]]
) -> tuple[float, list[float]]:
    """Return the error power of nearest beams, and that of each stage.

    Range errors are assumed to be spread evenly up to the bound of Ødegaard (2004), eq. [45]. The
    errors of stages add, not their powers.
    """
    scene, track = roots.sampled.scene, roots.sampled.track
    centres_m = scene.lines.phase_centres_m[np.argsort(track.coordinate)]
    spacing_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1).mean()
    steps_m = np.linalg.norm(scene.surface.steps_m, axis=1)
    image_m = np.max(np.array(scene.grid.shape) * steps_m)
    errors_m = stage_errors_m(stages, spacing_m, image_m, roots.sampled.nearest_m)

    def power_of(error_m: float) -> float:
        return (2 * math.pi * scene.lines.carrier_cycles_per_m * error_m) ** 2 / 3

    return power_of(sum(errors_m)), [power_of(error_m) for error_m in errors_m]
