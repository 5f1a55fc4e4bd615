"""Phase rates along the aperture and across a sheet, of subimages and of the beam's weights."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsas.aperture.beam_directions import beam_rate
from clsas.aperture.dense_channels import SheetRates, sheet_beam_rates, sheet_rates
from clsas.aperture.phase_rates import PhaseBoxes, cycles_per_extent
from clsas.planning.caching import cached
from clsas.planning.sample_points import INNER_POINTS, trapezoidal_weights
from clsas.planning.subimages import Side
from clsas.planning.visibility_model import VisibilityModel

_SEARCH_STEP = 8  # the search uses every eighth sample of the track; a fourth chose the same trees


@cached
def along(model: VisibilityModel) -> NDArray[np.float64]:
    """Return phase rates along the track, float64 [axes, points, samples].

    They are in cycles per row, column and metre of relief of a subimage, and per unit aperture
    coordinate. If the model has a root size, they are the largest within such roots.
    """
    return _along(model, _root_extents(model), model.points_m)


@cached
def across(model: VisibilityModel) -> NDArray[np.float64]:
    """Return the same per unit coordinate across a sheet, at the samples of a line across it."""
    return _of_sheet(model, _root_extents(model), model.points_m).across


@cached
def of_beam_along(model: VisibilityModel) -> NDArray[np.float64]:
    """Return the change of the beam's weights along the track as a phase rate, [points, samples].

    If the model has a root size, it is the largest within such roots: see `beam_rate`.
    """
    if model.beam is None or model.along is None:
        return np.zeros(model.distance_m.shape)
    if model.track.is_sheet:
        return _of_beam_on_sheet(model).along
    sides_m = _root_extents(model)[:, None] * model.surface.steps_m
    return beam_rate(model.beam, model.track, model.along, model.points_m, sides_m)


@cached
def of_beam_across(model: VisibilityModel) -> NDArray[np.float64]:
    """Return the same across a sheet, at the samples of a line across it; 0 without a beam."""
    if model.beam is None:
        return np.zeros((len(model.points_m), len(model.track.line_across(0.5).samples)))
    return _of_beam_on_sheet(model).across


def cycles_in_root(
    model: VisibilityModel, root: Side, sides: tuple[Side, ...]
) -> NDArray[np.float64]:
    """Return an estimate of the phase in a root, float64 [sizes, axes].

    It is in cycles per row, column and metre of relief, accumulated along the part of the aperture
    where a subimage of each size is visible, and averaged over the inner sample points. With a root
    of 0 rows, it is that at the points themselves.
    """
    rates = _along(model, _extents_of(model, root), model.points_m[INNER_POINTS], _SEARCH_STEP)
    return _visible_spacing(model, sides) @ rates.reshape(len(rates), -1).T


def cycles_across_root(model: VisibilityModel, root: Side) -> NDArray[np.float64] | None:
    """Return the same across a sheet, float64 [axes]; None without a sheet."""
    if not model.track.is_sheet:
        return None
    points_m = model.points_m[INNER_POINTS]
    rates = _of_sheet(model, _extents_of(model, root), points_m, _SEARCH_STEP).across
    line = model.track.line_across(0.5)
    spacing = (line.on_track * trapezoidal_weights(line.samples))[::_SEARCH_STEP]
    weights = trapezoidal_weights(line.samples[::_SEARCH_STEP]) * (spacing > 0)
    return (rates @ weights).mean(axis=1)


@cached
def _visible_spacing(model: VisibilityModel, sides: tuple[Side, ...]) -> NDArray[np.float64]:
    """Return weights of track samples at inner points, 0 where a size is invisible, [sizes, n]."""
    visible = model.visible_by_size(sides)[:, INNER_POINTS, ::_SEARCH_STEP]
    spacing = trapezoidal_weights(model.track.samples[::_SEARCH_STEP]) / len(INNER_POINTS)
    return (visible * spacing).reshape(len(sides), -1)


def _extents_of(model: VisibilityModel, root: Side) -> NDArray[np.float64]:
    return model.extents(root, most=True) if any(root) else model.surface.extents(root)


def _root_extents(model: VisibilityModel) -> NDArray[np.float64]:
    return _extents_of(model, model.root or (0, 0))


def _along(
    model: VisibilityModel,
    extents: NDArray[np.float64],
    centres_m: NDArray[np.float64],
    every: int = 1,
) -> NDArray[np.float64]:
    if model.track.is_sheet:
        return _of_sheet(model, extents, centres_m, every).along
    boxes = _boxes(model, extents, centres_m)
    return cycles_per_extent(model.track, boxes, model.limits, model.along, every)


def _of_sheet(
    model: VisibilityModel,
    extents: NDArray[np.float64],
    centres_m: NDArray[np.float64],
    every: int = 1,
) -> SheetRates:
    def find() -> SheetRates:
        return sheet_rates(model.track, _boxes(model, extents, centres_m), every)

    key = "sheet rates", tuple(extents), centres_m.tobytes(), every
    return model.from_cache(key, find)


def _boxes(
    model: VisibilityModel, extents: NDArray[np.float64], centres_m: NDArray[np.float64]
) -> PhaseBoxes:
    cycles_per_m, nearest_m = model.highest_cycles_per_m, model.nearest_m
    return PhaseBoxes(model.surface.steps_m, centres_m, extents, cycles_per_m, nearest_m)


@cached
def _of_beam_on_sheet(model: VisibilityModel) -> SheetRates:
    assert model.beam is not None
    assert model.directions is not None
    sides_m = _root_extents(model)[:, None] * model.surface.steps_m
    return sheet_beam_rates(model.beam, model.track, model.directions, model.points_m, sides_m)
