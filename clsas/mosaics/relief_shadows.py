"""Shadows of the relief in a mosaic of heights, which may be longer than patches.

A patch is measured before others that may hide its pixels, or be hidden by them. So the store also
keeps the heights of pixels in shadow, and once all patches are finished, the mask of every patch
follows from the heights of all, by the rule for a relief in memory
(`clsas.interferometry.shadows`). It depends on neither the order of the patches nor interruptions.
Memory is that of a few patches.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.grid import Grid, without_heights
from clsas.interferometry.baseline import Lattice
from clsas.interferometry.coherence import Window
from clsas.interferometry.shadows import ReliefPart, Skyline
from clsas.mosaics.levels import LAYERS, SHADOWED
from clsas.mosaics.patches import Layout, PatchWindow, Wide
from clsas.mosaics.record import PatchIndex, Record
from clsas.mosaics.store import Store

_KEPT = 8  # patches whose skyline is kept: those that lines of sight from one patch cross at once
_DIGITS = 7  # of stored numbers

_SIGHTS = "sights"
_HIGHEST = "highest_m"
_HEIGHT, _SD = "height_m", "sd_m"
_SHADOW_HEIGHT, _SHADOW_SD = SHADOWED


def of_shadows(
    layers: dict[str, NDArray[np.float32]], grid: Grid, sights: Lattice
) -> dict[str, Any]:
    """Return what the record of a patch says for its shadows, as types of JSON.

    Parameters
    ----------
    layers : dict of str to float32 [rows, columns]
    grid : Grid
        Grid of the patch.
    sights : Lattice
        K and the tangent, over the patch with its margin.
    """
    relief = _Relief.joined(layers)
    z_m = without_heights(grid).positions_m()[..., 2] + relief.offset_m
    return {
        _HIGHEST: float(z_m[relief.valid].max()) if relief.valid.any() else None,
        _SIGHTS: {
            "rows": sights.rows.tolist(),
            "columns": sights.columns.tolist(),
            "offset_m": sights.offset_m.tolist(),
            "tangent": _rounded(sights.values[..., 1:]).tolist(),
        },
    }


def mask_shadows(store: Store) -> int:
    """Mask the pixels of a finished mosaic of heights that others hide, and unmask the others.

    Returns
    -------
    int
        Number of patches that were written.

    Raises
    ------
    ValueError
        If a patch is damaged; the message names it.
    OSError
        If the store cannot be read or written.
    """
    records = {
        index: record
        for index, record in store.records().items()
        if record.heights is not None and record.heights.get(_HIGHEST) is not None
    }
    if not records:
        return 0
    seabed = _Seabed.of(store, records)
    fine, coarse = seabed.skylines()
    return sum(_masked(store, seabed, index, fine, coarse) for index in records)


def _masked(
    store: Store, seabed: _Seabed, index: PatchIndex, fine: Skyline, coarse: Skyline
) -> bool:
    """Write the shadows of a patch unless they are as they should be; return whether it did."""
    window = seabed.layout.window(index)
    part, wide = seabed.part(index)
    hidden = part.hidden_by(fine, coarse, wide.inside)
    rows, columns = window.rows, window.columns
    layers = {name: store.read_layer(name, rows, columns) for name in (*LAYERS, *SHADOWED)}
    if np.array_equal(hidden, ~np.isnan(layers[_SHADOW_HEIGHT])):
        return False
    relief = _Relief.joined(layers)
    for name, shadow, values in (
        (_HEIGHT, _SHADOW_HEIGHT, relief.offset_m),
        (_SD, _SHADOW_SD, relief.sd_m),
    ):
        layers[name] = np.where(hidden, np.float32(np.nan), values)
        layers[shadow] = np.where(hidden, values, np.float32(np.nan))
    record = seabed.records[index]
    assert record.heights is not None
    valid = float(np.mean(relief.valid & ~hidden))
    record = replace(record, heights=record.heights | {"valid": valid})
    store.write(*index, rows, columns, store.read(rows, columns), record, layers)
    return True


@dataclass(frozen=True, eq=False)
class _Relief:
    """Heights of a window, whether in shadow or not, float32 [rows, columns].

    Attributes
    ----------
    offset_m, sd_m : float32
    """

    offset_m: NDArray[np.float32]
    sd_m: NDArray[np.float32]

    @classmethod
    def joined(cls, layers: dict[str, NDArray[np.float32]]) -> _Relief:
        """Return what layers contain of a relief."""
        return cls(
            *(
                np.where(np.isnan(layers[shadow]), layers[name], layers[shadow])
                for name, shadow in ((_HEIGHT, _SHADOW_HEIGHT), (_SD, _SHADOW_SD))
            )
        )

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Pixels with a height."""
        return ~np.isnan(self.offset_m)


@dataclass(frozen=True, eq=False)
class _Seabed:
    """Heights of a store, to be read patch by patch.

    Attributes
    ----------
    store : Store
    layout : Layout
    window : Window
    margin : (rows, columns)
        Pixels beyond each side of a patch that were measured with it.
    records : dict of (row, column) to Record
        Patches with heights.
    """

    store: Store
    layout: Layout
    window: Window
    margin: tuple[int, int]
    records: dict[PatchIndex, Record]

    @classmethod
    def of(cls, store: Store, records: dict[PatchIndex, Record]) -> _Seabed:
        """Return the heights of a store, given the records of patches with heights."""
        document = store.document
        assert document.window is not None  # the store has heights
        down, across = document.inputs["margin"]
        layout = Layout(without_heights(store.grid), document.patch_shape)
        return cls(store, layout, Window(*document.window), (down, across), records)

    def part(self, index: PatchIndex) -> tuple[ReliefPart, Wide]:
        """Return a patch with heights and its margin, as it was measured."""
        wide = Wide.of(self.layout.window(index), self.margin, self.layout.grid.shape)
        relief = _Relief.joined(
            {
                name: self.store.read_layer(name, wide.rows, wide.columns)
                for name in (_HEIGHT, _SD, _SHADOW_HEIGHT, _SHADOW_SD)
            }
        )
        part = ReliefPart.of(
            self.layout.grid.window(wide.rows, wide.columns),
            np.nan_to_num(relief.offset_m.astype(np.float64)),
            np.nan_to_num(relief.sd_m.astype(np.float64)),
            relief.valid,
            _lattice(self.records[index]),
            self.window,
            (wide.rows.start, wide.columns.start),
        )
        return part, wide

    def skylines(self) -> tuple[Skyline, Skyline]:
        """Return the skylines of pixels and of blocks, computed for the patches that are asked for.

        No roof is higher than the highest pixel.
        """
        most_m = max(record.heights[_HIGHEST] for record in self.records.values() if record.heights)
        every = max(min(self.window.sides) // 2, 1)
        pixels = self.layout.grid.shape
        blocks = tuple(-(-n // every) for n in pixels)

        @lru_cache(maxsize=_KEPT)
        def tiles(index: PatchIndex) -> tuple[_Tile, _Tile]:
            part, wide = self.part(index)
            window = self.layout.window(index)
            return _Tile.of(part.roof_m, wide, window, 1), _Tile.of(
                part.highest_m, wide, window, every
            )

        def at(place: NDArray[np.int64], side: int, which: int) -> NDArray[np.float64]:
            of = place * side // np.array(self.layout.patch_shape)[:, None]
            number = np.ravel_multi_index(tuple(of), self.layout.shape)
            found = np.full(number.shape, -np.inf)
            for each in np.unique(number):
                row, column = map(int, np.unravel_index(each, self.layout.shape))
                if (row, column) in self.records:
                    some = number == each
                    found[some] = tiles((row, column))[which].at(place[:, some])
            return found

        return (
            Skyline(pixels, most_m, lambda place: at(place, 1, 0)),
            Skyline(blocks, most_m, lambda place: at(place, every, 1)),
        )


@dataclass(frozen=True, eq=False)
class _Tile:
    """A skyline over a patch.

    Attributes
    ----------
    values : float64 [rows, columns]
    first : int64 [2, 1]
        Place of the first of them.
    """

    values: NDArray[np.float64]
    first: NDArray[np.int64]

    @classmethod
    def of(cls, values: NDArray[np.float64], wide: Wide, window: PatchWindow, every: int) -> _Tile:
        """Return the values at the first pixel of each block in a patch; it may have none."""
        first = [-(-part.start // every) for part in (window.rows, window.columns)]
        rows, columns = (
            slice(n * every - around.start, part.stop - around.start, every)
            for n, part, around in zip(
                first, (window.rows, window.columns), (wide.rows, wide.columns), strict=True
            )
        )
        return cls(values[rows, columns].copy(), np.array(first)[:, None])

    def at(self, place: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the values at places, int64 [2, n]."""
        return self.values[tuple(place - self.first)]


def _lattice(record: Record) -> Lattice:
    """Return the tangents in the record of a patch; K is not needed, and 0."""
    assert record.heights is not None
    stored = record.heights[_SIGHTS]
    tangent = np.array(stored["tangent"], np.float64)
    rows, columns, offset_m = (
        np.array(stored[name], np.float64) for name in ("rows", "columns", "offset_m")
    )
    values = np.concatenate([np.zeros_like(tangent[..., :1]), tangent], axis=-1)
    return Lattice(rows, columns, offset_m, values)


def _rounded(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values rounded to some digits of the largest one."""
    largest = float(np.abs(values).max(initial=0.0))
    decimals = _DIGITS - int(np.ceil(np.log10(largest))) if largest else 0
    return np.round(values, decimals)
