"""How a beam sweeps over a grid: the part an image needs, and whether it can be factorized."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsas.core.lines import some_channels
from clsas.core.wavelengths import wavelength_m
from clsas.planning.caching import shared
from clsas.planning.sample_points import points_at_m
from clsas.planning.visibility_model import VisibilityModel
from clsas.sonar.visibility import sines

_SAMPLED_POINTS = np.linspace(0, 1, 17)  # fractions of rows and columns; their sines are smooth
_BINS = 512  # of power by aspect angle; half or twice as many change nothing
# Largest change of direction from one channel to the next, over the beam's width. At a kink of the
# track, the beam swings past pixels between two channels, which virtual channels cannot follow.
_MOST_TURNED = 1 / 16
_CELLS = 8, 3  # along and across a sheet: smooth directions are cubic across it at most
_LEAST_FILLED = 0.9  # share of these cells that contain channels, where directions differ
_EVERY_DIRECTION = (-2.0, 2.0)  # sines of the aspect angle, beyond any
# Share of the best pixel's sum of weights: normalising amplifies errors by its inverse.
_LEAST_COVERED = 0.25
_LEAST_SHARE_COVERED = 0.1  # of an image; below, little time is saved and errors scatter
_LEAST_PARTIAL = 0.25  # of an image; below, a step of the beam makes larger errors than predicted


def trimmed(model: VisibilityModel, share: float) -> VisibilityModel:
    """Return a model without the outermost edges of the beam, where its weights are small.

    The edges are left out where the beam sweeps evenly over the grid: an image of noise then loses
    `share` of its power. Elsewhere every channel is used for every subimage, and weights are
    applied in the leaves only.
    """
    if model.beam is None or model.limits is None:
        return model
    if model.track.is_sheet or not sweeps_once(model):
        return model.with_limits(*_EVERY_DIRECTION)
    low, high = np.clip(model.limits, -1, 1)
    on_track, bounds = model.on_track, []
    of_track = sines(_points_m(model), model.track_m[on_track], _along(model)[on_track])
    # The channels alone do not suffice, because filters extend into gaps of the track. Neither does
    # one point: from a short aperture, a pixel receives only from a small part of the beam.
    for sine in (_sines_of_channels(model), of_track):
        sine = sine[(sine > low) & (sine < high)]
        power = model.beam.weights(sine, wavelength_m(model.lines)) ** 2
        index = np.minimum((sine - low) * (_BINS / (high - low)), _BINS - 1).astype(np.int64)
        total = np.bincount(index, power, _BINS).cumsum()
        bounds.append(np.searchsorted(total, np.array([share / 2, 1 - share / 2]) * total[-1]))
    first, last = np.min(bounds, axis=0)[0], np.max(bounds, axis=0)[1]
    if not 0 < first <= last:
        return model
    edges = np.linspace(low, high, _BINS + 1)
    return model.with_limits(float(edges[first]), float(edges[min(last + 1, _BINS)]))


def obstacle(model: VisibilityModel) -> str:
    """Return why virtual channels cannot follow the beam, in words; "" if they can."""
    beam = model.beam
    if beam is None:
        return ""
    if model.track.is_sheet and _directions_unknown(model):
        return "the heading turns, and large parts of the smooth aperture have no channel"
    if not model.track.is_sheet and _turns_between_channels(model):
        return "the heading changes from channel to channel by more than 1/16 of the beam's width"
    # Normalising divides by a small sum at the beam's edge, which amplifies errors there.
    if beam.normalise and coverage(model, 1).min() < _LEAST_COVERED:
        return "the beam normalises, and weights of some pixels sum to less than 1/4 of the most"
    # If a step of the beam crosses few pixels, their error exceeds the mean that is predicted.
    if beam.jumps and 0 < partly_visible_share(model) < _LEAST_PARTIAL:
        return "the step at the beam's edge crosses only few pixels"
    # If few pixels are visible, little time can be saved, and their errors cannot be predicted.
    if float(coverage(model, 2).mean()) < _LEAST_SHARE_COVERED:
        return "the beam covers less than a tenth of the image"
    return ""


def _directions_unknown(model: VisibilityModel) -> bool:
    """Return whether directions differ over a sheet of which parts have no channel.

    Smooth directions are then extrapolated, and may be arbitrary.
    """
    track, (columns, rows) = model.track, _CELLS
    assert model.directions is not None
    assert track.across is not None
    at = model.directions.at(track.coordinate, track.across)
    if np.linalg.norm(at - at.mean(axis=0), axis=1).max() <= _MOST_TURNED * _width(model):
        return False
    cell = [
        np.clip((each * count).astype(np.int64), 0, count - 1)
        for each, count in ((track.coordinate, columns), (track.across, rows))
    ]
    filled = len(np.unique(cell[0] * rows + cell[1]))
    return filled < _LEAST_FILLED * columns * rows


def _width(model: VisibilityModel) -> float:
    """Return the width of the beam, in sine of the aspect angle."""
    assert model.beam is not None
    return float(np.ptp(np.clip(model.beam.limits, -1, 1)))


def _turns_between_channels(model: VisibilityModel) -> bool:
    """Return whether neighbours on the track have different directions.

    They do at a kink of the track, where the beam may swing past a point within a few channels, and
    where a track leads back beside itself.
    """
    assert model.scene.along is not None
    order = np.argsort(model.track.coordinate, kind="stable")
    strip = model.track.strip_of(model.track.coordinate[order])
    turned = np.linalg.norm(np.diff(model.scene.along[order], axis=0), axis=1)
    turned = turned[np.diff(strip) == 0]
    return bool(turned.max(initial=0.0) > _MOST_TURNED * _width(model))


def sweeps_once(model: VisibilityModel) -> bool:
    """Return whether the beam sweeps once, at an even rate, over every sample point.

    A subimage then needs a single interval of channels of each strip. Along a straight track, the
    sine of a point's aspect angle changes by (1 - sine^2)/distance per metre. Rates relative to
    that count as even if they vary by no more than their mean.
    """
    if model.beam is None:
        return True
    strip = model.track.strip_of(model.track.samples)
    return all(_sweeps_once(model, strip == each) for each in range(model.track.strips))


def _sweeps_once(model: VisibilityModel, of_strip: NDArray[np.bool_]) -> bool:
    """Return whether the beam sweeps evenly along one strip."""
    assert model.beam is not None
    on_track = model.on_track & of_strip
    position = model.track_m[on_track]
    along_m = np.concatenate([[0], np.linalg.norm(np.diff(position, axis=0), axis=1).cumsum()])
    sine = np.einsum("psi,si->ps", model.sight[:, on_track], _along(model)[on_track])
    along_m += 1e-9 * np.arange(len(along_m))  # a track may stand still
    rate = -np.gradient(sine, along_m, axis=1)
    rate *= model.distance_m[:, on_track] / np.maximum(1 - sine**2, 1e-3)
    low, high = model.beam.limits
    visible = (sine > low) & (sine < high)
    count = np.maximum(visible.sum(axis=1), 1)
    mean = rate.sum(axis=1, where=visible) / count
    fastest = rate.max(axis=1, where=visible, initial=-np.inf)
    slowest = rate.min(axis=1, where=visible, initial=np.inf)
    return not (visible.any(axis=1) & (fastest - slowest > np.abs(mean))).any()


def coverage(model: VisibilityModel, power: int) -> NDArray[np.float64]:
    """Return sums over channels of a power of the beam's weights, over the largest sum, [points].

    They are those of points all over the grid, and 0 if the beam touches none of them.
    """
    assert model.beam is not None
    weights = model.beam.weights(_sines_of_channels(model), wavelength_m(model.lines))
    sums = (weights**power).sum(axis=0)
    return sums / max(sums.max(), 1e-30)


def partly_visible_share(model: VisibilityModel) -> float:
    """Return the fraction of points in the beam of some channels, but not of others."""
    assert model.beam is not None
    low, high = model.beam.limits
    sine = _sines_of_channels(model)
    visible = ((sine > low) & (sine < high)).mean(axis=0)
    return float(((visible > 0) & (visible < 1)).mean())


def _along(model: VisibilityModel) -> NDArray[np.float64]:
    """Return the beam's unit directions at the track's samples, [samples, 3]; only with a beam."""
    assert model.along is not None
    return model.along


@shared
def _points_m(model: VisibilityModel) -> NDArray[np.float64]:
    """Return points all over the grid, [points, 3]."""
    return points_at_m(model.surface, _SAMPLED_POINTS)


@shared
def _sines_of_channels(model: VisibilityModel) -> NDArray[np.float64]:
    """Return sines of the aspect angle at points all over the grid, [channels, points]."""
    assert model.scene.along is not None
    some = some_channels(model.lines.channels)
    return sines(_points_m(model), model.lines.phase_centres_m[some], model.scene.along[some])
