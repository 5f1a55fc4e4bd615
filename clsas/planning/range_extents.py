"""Extents of subimages in range, which decide the length of their lines."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from clsas.planning.caching import cached
from clsas.planning.stretches import stretch_of
from clsas.planning.subimages import Side
from clsas.planning.visibility_model import VisibilityModel
from clsas.signal.interpolation import Interpolator, Resampling


def half_range_extents_m(model: VisibilityModel, sides: Sequence[Side]) -> NDArray[np.float64]:
    """Return the largest difference in range between a pixel and its subimage's centre, [sizes].

    It is the projection of the sides onto the line of sight, plus the curvature of the wavefront in
    subimages close to the track.
    """
    steps_m = model.surface.steps_m
    boxes = np.stack([model.subimages.extents(side, side, most=True) for side in sides])
    corners = np.array(list(product((-0.5, 0.5), repeat=len(steps_m))))
    radius_m = np.linalg.norm((boxes[:, None] * corners) @ steps_m, axis=-1).max(axis=1)
    bend_m = radius_m**2 / (2 * np.maximum(model.nearest_m, radius_m))
    return np.minimum(boxes @ _range_slopes(model) / 2 + bend_m, radius_m)


@cached
def _range_slopes(model: VisibilityModel) -> NDArray[np.float64]:
    """Return the largest change of range per row, column and metre of relief, [axes]."""
    visible = model.visible(model.small)
    slopes = np.abs(model.sight @ model.surface.steps_m.T)
    if model.track.is_sheet:
        edges = [model.track.line_along(across) for across in (0.0, 1.0)]
        sight = model.points_m[:, None] - np.concatenate([each.sampled_m[0] for each in edges])
        sight /= np.maximum(np.linalg.norm(sight, axis=-1, keepdims=True), 1e-9)
        more = np.abs(sight @ model.surface.steps_m.T)[:, np.tile(model.on_track, 2)]
        return 1.02 * np.maximum(slopes[visible].max(axis=0), more.max(axis=(0, 1)))
    slopes = slopes[visible] if visible.any() else slopes.reshape(-1, slopes.shape[-1])
    return 1.02 * slopes.max(axis=0)


def half_line_lengths(
    model: VisibilityModel,
    sides: Sequence[Side],
    align: Interpolator,
    final: Interpolator,
    to: Resampling,
) -> tuple[int, ...]:
    """Return the number of samples on either side of a subimage's centre, stage by stage.

    `to` is the resampling of the lines before the first stage.
    """
    samples_per_m = to.samples_per_m(model.lines) * (1 + max(stretch_of(model).mean, 0.0))
    return tuple(
        math.ceil(extent_m * samples_per_m)
        + (len(sides) - 1 - level) * (align.taps // 2 + 1)
        + final.taps // 2
        + 1
        for level, extent_m in enumerate(half_range_extents_m(model, sides))
    )
