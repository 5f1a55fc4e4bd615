"""Errors of a factorized image beside those of its filters: of roots, spacing and leaves."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial.distance import cdist

from clsas.core.decibels import power
from clsas.core.geometry import pairwise_range_m
from clsas.core.lines import some_channels, wavelength_m
from clsas.exact.layout import ROUNDING
from clsas.exact.tiles import BLOCKS
from clsas.factorized.aperture import drift, stretches
from clsas.factorized.thesis import stage_errors_m
from clsas.factorized.tree import interpolated_channels
from clsas.factorized.visibility import interpolated_directions
from clsas.opencl.device import Device
from clsas.planning.view import View, kept
from clsas.signal.interpolation import Interpolator
from clsas.sonar.visibility import sines

_FLOAT32 = 4.5e-8  # rms error of a phase in the stages over the phase across a root: measured
_CHANNELS, _FURTHEST, _PLACES, _PIXELS = 128, 32, 160, 24  # sampled for errors
_SOME_POINTS = (0, 7, 14, 16, 23)  # of 5 by 5 sample points, one in every row and column


def leaf_error(view: View, sides: NDArray[np.int64], device: Device) -> NDArray[np.float64]:
    """Return the power of the error that expanding leaves of some sizes adds.

    See `layout.lay_out`: the fourth order, in long leaves 0.35 of the largest rms. Off a plane
    nothing is expanded, and float32 rounds.
    """
    if not view.surface.is_plane:
        radius_m = np.array([view.surface.radius_m(tuple(side)) for side in sides.tolist()])
        return (ROUNDING * view.highest_cycles_per_m * radius_m) ** 2
    steps_m = np.linalg.norm(view.surface.steps_m, axis=1)
    radius_m = np.hypot(*(sides * steps_m).T) / 2
    block_m = np.hypot(*(np.array(BLOCKS[device.info.width]) * steps_m)) / 2
    nearest_m = np.maximum(view.nearest_m, 1e-6)
    remainder_m = 0.35 * radius_m**4 / (8 * nearest_m**3)
    result = (2 * np.pi * view.highest_cycles_per_m * remainder_m) ** 2
    if view.beam is not None:
        result += view.beam.block_error(block_m / nearest_m) ** 2
        window_sine = np.ptp(np.clip(view.beam.limits, -1, 1))
        result += (0.1 * (radius_m / nearest_m) ** 4 / window_sine) ** 2
    return result


@dataclass(frozen=True)
class Errors:
    """Powers of the errors that filters do not account for.

    Attributes
    ----------
    roots : float
        Of rounding, and of channels put on the mean track.
    nodes : tuple of float
        Of unevenly spaced virtual channels, and of weights that change between them, by stage.
    leaves : float
        Of expanding the leaves.
    """

    roots: float
    nodes: tuple[float, ...]
    leaves: float


def other_errors(
    view: View,
    sides: Sequence[tuple[int, int]],
    roots: float,
    aperture: Interpolator,
    crowding: tuple[float, ...],
    beam_cycles: float,
    device: Device,
) -> Errors:
    """Return the errors of a tree; `view` is that within its roots, whose error is known."""
    last = len(sides) - 1
    return Errors(
        roots=roots,
        nodes=tuple(
            excess_error(view, side, aperture, crowd, beam_cycles if level == last else 0.0)
            for level, (side, crowd) in enumerate(zip(sides, crowding, strict=True))
        ),
        leaves=float(leaf_error(view, np.array([sides[-1]]), device)[0]),
    )


def _over_relief(
    view: View, side: tuple[int, int], error: Callable[[NDArray[np.float64]], float]
) -> float:
    """Return the mean over the grid of an error that depends on the extents of subimages.

    It grows with the relief's square at least: of as much as the highest root adds, others add no
    more than by the squares of their relief.
    """
    surface = view.surface
    plane = error(surface.extents(side))
    relief_m = surface.relief_m(side, view.root)
    most_m = float(relief_m.max())
    if most_m <= 0:
        return plane
    share = np.average((relief_m / most_m) ** 2, weights=surface.counts(view.root or side))
    return plane + max(error(surface.extents(side, most_m)) - plane, 0.0) * float(share)


@kept
def root_error(view: View, side: tuple[int, int]) -> float:
    """Return the power of the error of roots: of rounding, and of channels put on the mean track.

    The latter is `_off_track`.
    """
    off_track = _over_relief(view, side, functools.partial(_off_track, view, side))
    sides_m = view.extents(side, most=True) * np.linalg.norm(view.surface.steps_m, axis=1)
    radius_m = np.linalg.norm(sides_m) / 2
    rounding = (2 * np.pi * _FLOAT32 * view.highest_cycles_per_m * radius_m) ** 2
    return float(off_track + rounding)


def _off_track(view: View, side: tuple[int, int], extents: NDArray[np.float64]) -> float:
    """Return the power of the error that channels put on the mean track make.

    It is evaluated for sampled channels, roots and pixels: the change in range from a root's centre
    to a pixel for the channel, less the same change for its stand-in on the mean track, stretched
    as the first stage does. This covers track errors, separate transmitters and receivers, and
    motion during flight. With a beam it adds the difference between the weights of the two.
    """
    lines, track = view.lines, view.track
    points = np.array(_SOME_POINTS)
    seen = view.seen(side)[points]
    candidates = np.flatnonzero(np.interp(track.coordinate, track.samples, seen.any(axis=0)))
    index, counts = _some_off_track(view, candidates)
    part = replace(track, coordinate=track.coordinate[index])
    tx_m, rx_m, middle_m = (each[index] for each in (lines.tx_m, lines.rx_m, lines.phase_centres_m))
    velocity = lines.rx_velocity_m_s
    moving = velocity if velocity is None else velocity[index]
    own = view.own_drift if view.own_drift is None else view.own_drift[index]
    antennas = tx_m, rx_m, moving, lines.sound_speed_m_s
    seen = np.stack([np.interp(part.coordinate, track.samples, each) for each in seen]) > 0
    sees_any = seen.any(axis=1)
    points, seen = points[sees_any], seen[sees_any]
    if not points.size:
        return 0.0
    # [points, pixels, channels]; the first pixel is the middle of a root.
    pixels_m = np.stack([_pixels_m(view, extents, point)[0] for point in points])
    points_m = view.points_m[points, None] + pixels_m
    centres_m, all_m = points_m[:, 0], points_m.reshape(-1, 3)
    range_m = pairwise_range_m(all_m, *antennas)
    range_m = range_m.reshape(*points_m.shape[:2], -1)
    virtual_m = track.positions_m(part.apparent_coordinates(centres_m, middle_m, own))
    on_track_m = np.stack([cdist(*each) for each in zip(points_m, virtual_m, strict=True)])
    on_track_m -= (points_m @ drift(lines))[..., None]
    range_m, on_track_m = (each[:, 1:] - each[:, :1] for each in (range_m, on_track_m))
    stretch = stretches(*antennas, drift(lines), view.surface.plane, centres_m, virtual_m)[:, None]
    stretched_m = on_track_m * stretch
    wrong = (2 * np.pi * view.highest_cycles_per_m * (range_m - on_track_m - stretched_m)) ** 2
    # Lines are stretched by turning their phase; their envelope stays.
    wrong += (2 * np.pi * view.rms_cycles_per_m * stretched_m) ** 2
    weights = np.ones_like(wrong)
    if view.beam is not None:
        directions = interpolated_directions(track.samples, view.along, part.coordinate)
        virtual = [sines(*each, directions) for each in zip(points_m, virtual_m, strict=True)]
        channels = [sines(each, middle_m, view.channels_along[index]) for each in points_m]
        weights, of_virtual = (
            view.beam.weights(np.stack(each).swapaxes(1, 2)[:, 1:], wavelength_m(lines))
            for each in (channels, virtual)
        )
        wrong = weights**2 * wrong + (weights - of_virtual) ** 2
    counts = counts * seen[:, None]
    return float(np.sum(counts * wrong) / max(np.sum(counts * weights**2), 1e-30))


def _some_off_track(
    view: View, candidates: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Sample channels, the furthest off the track among them; return their weights too.

    Where a track turns sharply, a few channels may be much further off than all others.
    """
    if len(candidates) <= _CHANNELS:
        return candidates, np.ones(len(candidates))
    by_distance = candidates[np.argsort(view.off_track_m[candidates], kind="stable")]
    others, furthest = np.split(by_distance, [-_FURTHEST])
    others.sort()
    some = others[some_channels(len(others), _CHANNELS - _FURTHEST)]
    counts = np.repeat([len(others) / len(some), 1.0], [len(some), _FURTHEST])
    return np.concatenate([some, furthest]), counts


@kept
def excess_error(
    view: View,
    side: tuple[int, int],
    aperture: Interpolator,
    crowding: float,
    beam_cycles: float | None,
) -> float:
    """Return the power of the error that uneven spacing adds to that of the aperture's filter.

    See `_between_nodes`.
    """
    error = functools.partial(_between_nodes, view, side, aperture, crowding, beam_cycles)
    return _over_relief(view, side, error)


def _between_nodes(
    view: View,
    side: tuple[int, int],
    aperture: Interpolator,
    crowding: float,
    beam_cycles: float | None,
    extents: NDArray[np.float64],
) -> float:
    """Return the error power between virtual channels beside that of the aperture's filter.

    The filter takes virtual channels as equally spaced and weights as constant. Here steering
    functions are interpolated and compared with the exact ones, for sampled subimages, pixels and
    aperture coordinates. Unless `beam_cycles` is None, the beam weighs both: the image leaves out
    what the beam does not see. Where nothing is seen nothing is known: the error is then as large
    as the image.
    """
    weighted = view.beam is not None and beam_cycles is not None
    samples = _samples(view, side, weighted, tuple(extents))
    if samples is None:
        return 1.0
    rates = crowding * np.tensordot(extents, view.rates[:, samples.points], 1)
    if weighted:
        rates = rates + beam_cycles * view.beam_rates[samples.points]
    nodes = interpolated_channels(view.track, rates, samples.coordinate, aperture)
    of_nodes = _steering(view, *samples.pixels, weighted, nodes.coordinate)
    # A matrix that interpolates at all aperture coordinates of one subimage after the other.
    index = nodes.base[..., None] + np.arange(nodes.taps)
    index += nodes.coordinate.shape[1] * np.arange(len(index))[:, None, None]
    weights = nodes.weights.astype(np.float32).ravel()
    rows = np.arange(0, weights.size + 1, nodes.taps)
    of_nodes = of_nodes.reshape(-1, of_nodes.shape[-1])
    interpolate = csr_array((weights, index.ravel(), rows), shape=(len(rows) - 1, len(of_nodes)))
    away = (interpolate @ of_nodes).reshape(samples.exact.shape) - samples.exact
    wrong, total = (
        samples.count @ np.einsum("nsp,nsp->n", each, each, dtype=np.float64)
        for each in (away, samples.exact)
    )
    return float(max(wrong / max(total, 1e-30) - power(aperture.error_db), 0.0))


@dataclass(frozen=True, eq=False)
class _Samples:
    """Sampled subimages of a size, and the steering functions of sampled pixels in them.

    Attributes
    ----------
    points : int64 [n]
        The sample points that they lie at.
    count : int64 [n]
        Number of channels that see each.
    coordinate : float64 [n, places]
        Aperture coordinates, ascending, distributed as those of the channels.
    pixels : (centres_m, pixels_m, carriers)
        Arguments of `_steering`.
    exact : float32 [n, places, 2 pixels]
        The steering functions.
    """

    points: NDArray[np.int64]
    count: NDArray[np.int64]
    coordinate: NDArray[np.float64]
    pixels: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
    exact: NDArray[np.float32]


@kept
def _samples(
    view: View, side: tuple[int, int], weighted: bool, extents: tuple[float, ...]
) -> _Samples | None:
    """Return samples for errors between virtual channels, None where nothing is seen."""
    channels, first, count = _channels_seen(view, side)
    if not count.any():
        return None
    everywhere = weighted and view.beam.jumps  # only some points see a step
    points = np.flatnonzero(count)
    if not everywhere and np.isin(points, _SOME_POINTS).any():
        points = np.intersect1d(points, _SOME_POINTS)
    first, count = first[points], count[points]
    # One channel beyond those that see anything: edges lie in between.
    number = np.linspace(first - 1, first + count, _PLACES, axis=1)
    number = np.clip(number, 0, len(channels) - 1)
    place = np.interp(number, np.arange(len(channels)), channels)
    frequencies = view.carriers(_PIXELS)
    found = [_pixels_m(view, np.array(extents), point) for point in points]
    pixels_m = np.stack([each_m for each_m, _ in found])
    carriers = np.stack([frequencies[(share * _PIXELS).astype(int)] for _, share in found])
    pixels = view.points_m[points], pixels_m, carriers
    return _Samples(points, count, place, pixels, _steering(view, *pixels, weighted, place))


def _channels_seen(
    view: View, side: tuple[int, int]
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the channels' aperture coordinates, and the range of them that sees each subimage.

    The coordinates ascend. Of subimages at all sample points follow the first channel that sees it,
    and the number of channels that do: none where the track has a gap. The edges of visibility lie
    between the track's samples.
    """
    places, samples = np.sort(view.track.coordinate), view.track.samples
    seen = view.seen(side)
    begin = samples[np.maximum(seen.argmax(axis=1) - 1, 0)]
    end = samples[np.minimum(seen.shape[1] - seen[:, ::-1].argmax(axis=1), len(samples) - 1)]
    end[~seen.any(axis=1)] = -np.inf
    first = np.searchsorted(places, begin)
    return places, first, np.maximum(np.searchsorted(places, end, "right") - first, 0)


def _steering(
    view: View,
    centres_m: NDArray[np.float64],
    pixels_m: NDArray[np.float64],
    carriers: NDArray[np.float64],
    weighted: bool,
    at: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return steering functions at aperture coordinates, float32 [n, places, 2 pixels].

    The real parts of all pixels come first, then the imaginary ones.

    Parameters
    ----------
    centres_m : float64 [n, 3]
        Middles of subimages.
    pixels_m : float64 [n, pixels + 1, 3]
        From these: the point of reference, and pixels.
    carriers : float64 [n, pixels]
        The frequency of each, cycles per m.
    weighted : bool
        Whether the beam weighs them.
    at : float64 [n, places]
    """
    sight = centres_m[:, None] - view.track.positions_m(at)
    pixels_m = pixels_m.swapaxes(1, 2)
    square = np.einsum("nsi,nsi->ns", sight, sight)[..., None] + 2 * sight @ pixels_m
    square += np.einsum("nip,nip->np", pixels_m, pixels_m)[:, None]
    range_m = np.sqrt(np.maximum(square, 1e-18))
    turns = carriers[:, None] * (range_m[..., 1:] - range_m[..., :1])
    angle = (2 * np.pi * (turns - np.rint(turns))).astype(np.float32)
    result = np.concatenate([np.cos(angle), np.sin(angle)], axis=-1)
    if weighted:
        along = interpolated_directions(view.track.samples, view.along, at)
        sine = np.einsum("nsi,nsi->ns", sight, along)[..., None]
        sine = (sine + along @ pixels_m[..., 1:]) / range_m[..., 1:]
        weights = view.beam.weights(sine, wavelength_m(view.lines)).astype(np.float32)
        result *= np.concatenate([weights, weights], axis=-1)
    return result


def _pixels_m(
    view: View, extents: NDArray[np.float64], point: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return sampled pixels of a subimage, relative to its middle, [n + 1, 3]; the middle is first.

    A second array holds one more number for each, from 0 to 1. All numbers come from a Kronecker
    sequence (multiples of powers of an irrational number), which spreads evenly; every sample point
    has its own stretch of it.
    """
    dimensions = len(extents) + 1
    ratio = 1.0
    for _ in range(20):  # towards x^(dimensions + 1) = x + 1
        ratio = (1 + ratio) ** (1 / (dimensions + 1))
    index = point * _PIXELS + np.arange(_PIXELS)[:, None]
    places = (0.5 + index * ratio ** -np.arange(1.0, dimensions + 1)) % 1
    pixels_m = ((places[:, :-1] - 0.5) * extents) @ view.surface.steps_m
    return np.concatenate([np.zeros((1, 3)), pixels_m]), places[:, -1]


def nearest_errors(view: View, stages: Sequence[tuple[int, int]]) -> tuple[float, list[float]]:
    """Return the power of the error of nearest beams, THESIS [45], spread evenly, and by stage.

    Range errors of stages add, not their powers.
    """
    centres_m = view.lines.phase_centres_m[np.argsort(view.track.coordinate)]
    spacing_m = np.linalg.norm(np.diff(centres_m, axis=0), axis=1).mean()
    image_m = np.max(np.array(view.grid.shape) * np.linalg.norm(view.surface.steps_m, axis=1))
    errors_m = stage_errors_m(stages, spacing_m, image_m, view.nearest_m)

    def power_of(error_m: float) -> float:
        return (2 * math.pi * view.lines.carrier_cycles_per_m * error_m) ** 2 / 3

    return power_of(sum(errors_m)), [power_of(error_m) for error_m in errors_m]
