"""Shadows of the relief in a mosaic of heights, which may be longer than patches.

A patch is measured before others that may hide its pixels, or be hidden by them. So the store also
keeps the heights of pixels in shadow, and once all patches are finished, the mask of every patch
follows from the heights of all, by the rule for a relief in memory
(`clsas.interferometry.shadows`). It depends on neither the order of the patches nor interruptions.
Memory is that of a few patches.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.grid import Grid, without_heights
from clsas.interferometry.baseline import Lattice
from clsas.interferometry.coherence import Window
from clsas.interferometry.shadows import ReliefPart, Skyline
from clsas.mosaics.document import PatchIndex, Record
from clsas.mosaics.levels import LAYERS, SHADOWED
from clsas.mosaics.patches import Layout, PatchWindow, with_margin
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
    offset_m, _ = _relief(layers)
    valid = ~np.isnan(offset_m)
    z_m = without_heights(grid).positions_m()[..., 2] + offset_m
    # Tangents are rounded to some digits of the largest one.
    tangent = sights.values[..., 1:3]
    largest = float(np.abs(tangent).max(initial=0.0))
    decimals = _DIGITS - int(np.ceil(np.log10(largest))) if largest else 0
    return {
        _HIGHEST: float(z_m[valid].max()) if valid.any() else None,
        _SIGHTS: {
            "rows": sights.rows.tolist(),
            "columns": sights.columns.tolist(),
            "offset_m": sights.offset_m.tolist(),
            "tangent": np.round(tangent, decimals).tolist(),
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
    seabed, written = _Seabed(store, records), 0
    fine, coarse = seabed.skylines()
    for index, record in records.items():
        window = seabed.layout.window(index)
        rows, columns = window.rows, window.columns
        part, inside, _ = seabed.part(index)
        hidden = part.hidden_by(fine, coarse, inside)
        layers = {name: store.read_layer(name, rows, columns) for name in (*LAYERS, *SHADOWED)}
        if np.array_equal(hidden, ~np.isnan(layers[_SHADOW_HEIGHT])):
            continue
        offset_m, sd_m = _relief(layers)
        for name, shadow, values in ((_HEIGHT, _SHADOW_HEIGHT, offset_m), (_SD, _SHADOW_SD, sd_m)):
            layers[name] = np.where(hidden, np.float32(np.nan), values)
            layers[shadow] = np.where(hidden, values, np.float32(np.nan))
        assert record.heights is not None
        valid = float(np.mean(~np.isnan(offset_m) & ~hidden))
        masked = replace(record, heights=record.heights | {"valid": valid})
        store.write(*index, rows, columns, store.read(rows, columns), masked, layers)
        written += 1
    return written


def _relief(
    layers: dict[str, NDArray[np.float32]],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return heights of pixels, whether in shadow or not, and their deviations."""
    offset_m, sd_m = (
        np.where(np.isnan(layers[shadow]), layers[name], layers[shadow])
        for name, shadow in ((_HEIGHT, _SHADOW_HEIGHT), (_SD, _SHADOW_SD))
    )
    return offset_m, sd_m


class _Seabed:
    """Heights of a store, to be read patch by patch, given the records of patches with heights."""

    def __init__(self, store: Store, records: dict[PatchIndex, Record]) -> None:
        document = store.document
        assert document.window is not None  # the store has heights
        self.layout = Layout(without_heights(store.grid), document.patch_shape)
        self._store, self._records = store, records
        self._window = Window(*document.window)
        self._margin: tuple[int, int] = tuple(document.inputs["margin"])

    def part(
        self, index: PatchIndex
    ) -> tuple[ReliefPart, tuple[slice, slice], tuple[slice, slice]]:
        """Return a patch and its margin, as it was measured; where it lies in it; and its pixels.

        The pixels are those of the patch with its margin, rows and columns of the mosaic.
        """
        rows, columns, inside = with_margin(
            self.layout.window(index), self._margin, self.layout.grid.shape
        )
        names = (_HEIGHT, _SD, _SHADOW_HEIGHT, _SHADOW_SD)
        offset_m, sd_m = _relief(
            {name: self._store.read_layer(name, rows, columns) for name in names}
        )
        heights = self._records[index].heights
        assert heights is not None
        sights = heights[_SIGHTS]
        tangent = np.array(sights["tangent"], np.float64)
        k = np.zeros_like(tangent[..., :1])  # which is not needed
        lattice = Lattice(
            np.array(sights["rows"], np.float64),
            np.array(sights["columns"], np.float64),
            np.array(sights["offset_m"], np.float64),
            np.concatenate([k, tangent], axis=-1),
        )
        part = ReliefPart.of(
            self.layout.grid.window(rows, columns),
            np.nan_to_num(offset_m.astype(np.float64)),
            np.nan_to_num(sd_m.astype(np.float64)),
            ~np.isnan(offset_m),
            lattice,
            self._window,
            (rows.start, columns.start),
        )
        return part, inside, (rows, columns)

    def skylines(self) -> tuple[Skyline, Skyline]:
        """Return the skylines of pixels and of blocks, computed for the patches that are asked for.

        No roof is higher than the highest pixel.
        """
        layout, records = self.layout, self._records
        most_m = max(record.heights[_HIGHEST] for record in records.values() if record.heights)
        every = max(min(self._window.sides) // 2, 1)

        @lru_cache(maxsize=_KEPT)
        def tiles(index: PatchIndex) -> tuple[_Tile, _Tile]:
            part, _, around = self.part(index)
            window = layout.window(index)
            fine = _tile(part.roof_m, around, window, 1)
            return fine, _tile(part.highest_m, around, window, every)

        def at(place: NDArray[np.int64], side: int, which: int) -> NDArray[np.float64]:
            of = place * side // np.array(layout.patch_shape)[:, None]
            number = np.ravel_multi_index(tuple(of), layout.shape)
            found = np.full(number.shape, -np.inf)
            for each in np.unique(number):
                row, column = map(int, np.unravel_index(each, layout.shape))
                if (row, column) in records:
                    some = number == each
                    values, first = tiles((row, column))[which]
                    found[some] = values[tuple(place[:, some] - first)]
            return found

        pixels = layout.grid.shape
        blocks = tuple(-(-n // every) for n in pixels)
        return (
            Skyline(pixels, most_m, lambda place: at(place, 1, 0)),
            Skyline(blocks, most_m, lambda place: at(place, every, 1)),
        )


_Tile = tuple[NDArray[np.float64], NDArray[np.int64]]  # values over a patch, place of the first


def _tile(
    values: NDArray[np.float64], around: tuple[slice, slice], window: PatchWindow, every: int
) -> _Tile:
    """Return the values at the first pixel of each block in a patch; it may have none."""
    own = window.rows, window.columns
    first = [-(-part.start // every) for part in own]
    rows, columns = (
        slice(n * every - wide.start, part.stop - wide.start, every)
        for n, part, wide in zip(first, own, around, strict=True)
    )
    return values[rows, columns].copy(), np.array(first)[:, None]
