"""Sizes of subimages that the search chooses from, and their phases within roots."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from numpy.typing import NDArray

from clsas.opencl.device import Device
from clsas.planning import phase_rates
from clsas.planning.aperture_phases import AperturePhases
from clsas.planning.caching import cached
from clsas.planning.errors import leaf_error, root_error
from clsas.planning.range_extents import half_range_extents_m
from clsas.planning.sample_points import mean_over_points
from clsas.planning.subimages import Side
from clsas.planning.visibility_model import VisibilityModel

_ROWS = (16, 32, 64, 128, 256, 512, 1024, 2048)  # of subimages, in whole work-items
_COLUMNS = (4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048)
_MOST_OVERHANG = 1.1  # rows or columns of roots over those of the image that they fit


@dataclass(frozen=True, eq=False)
class Sizes:
    """Subimages of every size that the search considers, [sizes] each.

    Attributes
    ----------
    model : VisibilityModel
    sides : int64 [sizes, 2]
        Rows and columns.
    counts : float64
        Number of subimages that contain a pixel.
    padded_pixels : float64
        Mean pixel count of a subimage, padded to whole work-items.
    visible_share : float64
        Mean fraction of the channels whose beam touches a subimage.
    half_range_extent_m : float64
        Largest difference in range between a pixel and the centre.
    beam_cycles : float64
        Phase cycles that the beam's weights add along the visible aperture: see `beam_rate`.
    beam_cycles_across : float
        Phase cycles that they add across a sheet.
    leaf_error : float64
        Error power that expanding a leaf of this size adds.
    """

    model: VisibilityModel
    sides: NDArray[np.int64]
    counts: NDArray[np.float64]
    padded_pixels: NDArray[np.float64]
    visible_share: NDArray[np.float64]
    half_range_extent_m: NDArray[np.float64]
    beam_cycles: NDArray[np.float64]
    leaf_error: NDArray[np.float64]
    beam_cycles_across: float = 0.0
    _in_roots: dict[int, Division] = field(default_factory=dict, init=False)

    @functools.cached_property
    def pairs(self) -> tuple[Side, ...]:
        """`sides` as pairs of int."""
        return tuple((int(rows), int(columns)) for rows, columns in self.sides)

    @functools.cached_property
    def divides(self) -> NDArray[np.bool_]:
        """True where subimages of one size divide into those of another, [sizes, sizes]."""
        return (self.sides[:, None] % self.sides == 0).all(axis=-1)

    @functools.cached_property
    def anywhere(self) -> Division:
        """All sizes, with the phases at the sample points: lower bounds of those in a root."""
        return self._division((0, 0), np.arange(len(self.sides)))

    def in_root(self, root: int) -> Division:
        """Return the sizes that divide a root, with the largest phases in it."""
        if root not in self._in_roots:
            index = np.flatnonzero(self.divides[root])
            self._in_roots[root] = self._division(self.pairs[root], index)
        return self._in_roots[root]

    def _division(self, root: Side, index: NDArray[np.int64]) -> Division:
        """Return sizes with their phases in a root; a root of 0 rows is a sample point."""
        if self.model.surface.is_plane:
            extents = self.sides[index].astype(np.float64)
        else:
            subimages, pairs = self.model.subimages, [self.pairs[i] for i in index]
            extents = np.stack(
                [subimages.extents(side, root if any(root) else side) for side in pairs]
            )
        cycles = phase_rates.cycles_in_root(self.model, root, self.pairs)[index] @ extents.T
        smaller = self.divides[np.ix_(index, index)].T & (index[:, None] != index)
        of_axes = phase_rates.cycles_across_root(self.model, root)
        across = None if of_axes is None else extents @ of_axes
        return Division(index, cycles, np.where(smaller, 0.0, np.inf), across)


@dataclass(frozen=True, eq=False)
class Division:
    """Sizes of the subimages into which a root may be divided, with their phases.

    Attributes
    ----------
    index : int64 [n]
        Indices into `Sizes`.
    cycles : float64 [n, n]
        Phase cycles of a parent of size j, accumulated where a child of size i is visible.
    divisible_s : float64 [n, n]
        0 where a parent of size j may divide into children of size i, else infinite.
    across : float64 [n] or None
        Phase cycles of subimages across a sheet; None without a sheet.
    """

    index: NDArray[np.int64]
    cycles: NDArray[np.float64]
    divisible_s: NDArray[np.float64]
    across: NDArray[np.float64] | None = None


def _lengths(model: VisibilityModel) -> tuple[tuple[int, ...], ...]:
    """Return the numbers of rows and columns that subimages may have.

    Every channel of a dense aperture is aligned for every root. There, sizes include those whose
    roots fit the image.
    """
    if not model.track.is_dense:
        return _ROWS, _COLUMNS
    found = []
    for sides, n in zip((_ROWS, _COLUMNS), model.surface.plane.shape, strict=True):
        least, fitting = sides[0], set(sides)
        for parts in (1, 2, 4):
            part = least * math.ceil(n / (least * parts))
            if parts * part <= _MOST_OVERHANG * max(n, least):
                fitting |= {part * 2**k for k in range(parts.bit_length())}
        found.append(tuple(sorted(fitting)))
    return tuple(found)


@cached
def all_sizes(model: VisibilityModel, most: Side, device: Device) -> Sizes:
    """Return the sizes of subimages up to `most` rows and columns."""
    rows, columns = (
        [side for side in sides if side <= limit and side < 2 * max(n, min(sides))]
        for sides, n, limit in zip(_lengths(model), model.surface.plane.shape, most, strict=True)
    )
    pairs = tuple(product(rows, columns))
    sides = np.array(pairs, np.int64).reshape(-1, 2)
    if not pairs:
        return Sizes(model, sides, *np.zeros((6, 0)))
    visible = model.visible_by_size(pairs)
    share = mean_over_points(visible.sum(axis=-1)) / np.count_nonzero(model.on_track)
    beam_cycles, across = np.zeros(len(sides)), 0.0
    if model.beam is not None:
        rates = phase_rates.of_beam_along(model) * model.spacing
        beam_cycles = mean_over_points(np.einsum("nps,ps->np", visible, rates))
        across = AperturePhases(model).beam_phase_cycles_across()
    return Sizes(
        model,
        sides,
        counts=np.array([float(model.subimages.count(side)) for side in pairs]),
        padded_pixels=np.array(
            [model.subimages.padded_pixels(side, device.info.width) for side in pairs]
        ),
        visible_share=share,
        half_range_extent_m=half_range_extents_m(model, pairs),
        beam_cycles=beam_cycles,
        leaf_error=leaf_error(model, sides, device),
        beam_cycles_across=across,
    )


def largest_root(model: VisibilityModel) -> Side:
    """Return the rows and columns of the largest roots of an image."""
    rows, columns = (
        min((side for side in sides if side >= n), default=sides[-1])
        for sides, n in zip(_lengths(model), model.surface.plane.shape, strict=True)
    )
    return rows, columns


def root_limits(model: VisibilityModel, allowed: float) -> Side | None:
    """Return the largest rows and columns of roots whose error power is within `allowed`.

    Return None if even the smallest roots exceed it.
    """
    rows, columns = largest_root(model)
    if root_error(model, (rows, columns)) <= allowed:
        return rows, columns
    if root_error(model, (_ROWS[0], _COLUMNS[0])) > allowed:
        return None
    while root_error(model, (rows, columns)) > allowed:
        smaller = [(rows // 2, columns), (rows, columns // 2)]
        smaller = [side for side in smaller if side[0] >= _ROWS[0] and side[1] >= _COLUMNS[0]]
        if not smaller:
            return None
        rows, columns = min(smaller, key=functools.partial(root_error, model))
    return rows, columns
