"""Measure the heights of one patch of a mosaic, and write them to the store.

A patch is measured together with a margin, so that the windows of its outermost pixels are complete
and the cycles of the phase are decided as in a measurement of the whole grid. Lines are read for
everything that the sweep images: the patch with its margin at all heights of the search, and what
lies at the same ranges.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image, holds_any
from clsas.engine.device.device import Device
from clsas.interferometry import heights
from clsas.interferometry.baseline import Baseline
from clsas.interferometry.errors import UnmeasurableError
from clsas.interferometry.pair import Pair
from clsas.interferometry.request import Request
from clsas.interferometry.sweep import Curves
from clsas.mosaics.banks import Bank
from clsas.mosaics.devices import thread_device
from clsas.mosaics.levels import LAYERS, SHADOWED
from clsas.mosaics.patches import PatchWindow, Wide
from clsas.mosaics.record import Record
from clsas.mosaics.relief_shadows import mask_shadows, of_shadows
from clsas.mosaics.store import Store
from clsas.mosaics.survey import largest_gap_m
from clsas.mosaics.visibility import SurveyVisibility

_PLACES = 5  # along either side of a patch, for which curves are found; arbitrary


class Seen(NamedTuple):
    """Lines of two banks from which heights of a part of a grid follow.

    Attributes
    ----------
    pair : Pair or None
        Lines of both banks, or None if no channel of both has samples.
    known : dict
        Fields of the record of the patch.
    silent : tuple of {"a", "b"}
        Banks of which no channel has samples, though some receive from that part.
    """

    pair: Pair | None
    known: dict[str, Any]
    silent: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class HeightsJob:
    """Settings that all patches of a mosaic of heights share.

    Attributes
    ----------
    banks : (Bank, Bank)
    grid : Grid
        Grid of the whole mosaic.
    request : Request
        With the side of the windows.
    margin : (rows, columns)
        Pixels beyond each side of a patch that are measured with it.
    store : Path
    """

    banks: tuple[Bank, Bank]
    grid: Grid
    request: Request
    margin: tuple[int, int]
    store: Path

    @property
    def beam(self) -> BeamWindow | None:
        """Beam of the request."""
        return self.request.beam

    def on(self, visibility: SurveyVisibility, in_process: bool) -> HeightsJob:
        """Return the settings themselves, since the survey does not change."""
        return self

    def opened_store(self) -> Store:
        """Return the store."""
        return Store.at(self.store)

    def complete(self) -> None:
        """Find the shadows of the whole relief, then compute the levels that mix patches."""
        store = self.opened_store()
        mask_shadows(store)
        store.complete_levels()

    def is_current(self, record: Record, window: PatchWindow) -> bool:
        """Return whether no channel that was added since a patch was measured contributes to it."""
        if record.survey_channels >= len(self.banks[0].members):
            return True
        visible, _ = _swept(self.banks, self._wide_grid(self._wide(window)), self.request)
        return not visible[record.survey_channels :].any()

    def form(self, window: PatchWindow) -> tuple[Record, Image | None]:
        """Measure a patch and write it to the store.

        Raises
        ------
        ValueError
            If the patch cannot be imaged; a note says which patch it is.
        """
        try:
            record, pixels, layers = self._measured(window, thread_device())
        except ValueError as error:
            error.add_note(f"patch {window.row},{window.column}")
            raise
        self.opened_store().write(*window[1:], pixels, record, layers)
        return record, None

    def _measured(
        self, window: PatchWindow, device: Device
    ) -> tuple[Record, NDArray[np.complex64], dict[str, NDArray[np.float32]]]:
        """Return the record, the pixels and the layers of a patch."""
        start = time.perf_counter()
        wide = self._wide(window)
        grid = self._wide_grid(wide)
        pair, known, _ = seen(self.banks, grid, self.request, device)
        pixels: NDArray[np.complex64] = np.zeros(window.grid.shape, np.complex64)
        names = (*LAYERS, *SHADOWED)
        layers = {name: np.full(window.grid.shape, np.nan, np.float32) for name in names}
        if pair is None:
            return Record(**known, seconds=time.perf_counter() - start), pixels, layers
        try:
            measured = heights.measured(pair, grid, self.request, None)
        except UnmeasurableError as error:
            known["heights"] = {"reason": str(error)}
        else:
            scale = 1.0
            if self.beam is not None and self.beam.normalise:  # by the channels of this patch
                scale = len(self.banks[0].members) / pair.a.channels
            pixels = np.complex64(scale) * measured.heights.image.pixels[wide.inside]
            layers = _layers(measured, wide.inside)
            known["heights"] = _summary(measured, layers, window.grid, wide.inside)
        known |= {"has_pixels": holds_any(pixels), "seconds": time.perf_counter() - start}
        return Record(**known), pixels, layers

    def _wide(self, window: PatchWindow) -> Wide:
        return Wide.of(window, self.margin, self.grid.shape)

    def _wide_grid(self, wide: Wide) -> Grid:
        return self.grid.window(wide.rows, wide.columns)


def seen(banks: tuple[Bank, Bank], grid: Grid, request: Request, device: Device) -> Seen:
    """Return what two banks recorded of a grid and of the heights to search above it."""
    start = time.perf_counter()
    known: dict[str, Any] = {
        "survey_channels": len(banks[0].members),
        "device": device.info.label,
        "driver": device.info.driver,
    }
    visible, volume = _swept(banks, grid, request)
    known["channels"] = int(np.count_nonzero(visible))
    if not visible.any():
        return Seen(None, known)
    (first, lost), (second, lost_too) = (
        bank.read(visible, *bank.visibility.ranges_m(volume)) for bank in banks
    )
    missing = lost | lost_too
    known |= {
        "missing_channels": int(np.count_nonzero(missing)),
        "gap_m": largest_gap_m(first, missing),
        "read_seconds": time.perf_counter() - start,
    }
    if missing.all():
        silent = (name for name, each in (("a", lost), ("b", lost_too)) if each.all())
        return Seen(None, known, tuple(silent))
    chosen = visible.copy()
    chosen[visible] = ~missing
    if missing.any():
        first, second = first.select(~missing), second.select(~missing)
    beam = _beam_of(banks[0], request.beam, chosen)
    pair = Pair(first, second, request.tolerance_db, None, beam, device)
    return Seen(pair, known)


def _swept(
    banks: tuple[Bank, Bank], grid: Grid, request: Request
) -> tuple[NDArray[np.bool_], Grid]:
    """Return the channels from which heights of a grid follow, and the volume that they image."""
    volume = _box(grid, request.search_m)
    visible = _visible(banks, volume)
    if visible.any():
        some = [bank.geometry.select(visible) for bank in banks]
        baseline = Baseline.of(some[0], some[1], _beam_of(banks[0], request.beam, visible), 1.0)
        every = [slice(None, None, max((n - 1) // _PLACES, 1)) for n in grid.shape]
        reached = Curves.over(baseline, grid.window(*every), np.array(request.search_m)).grid
        volume = _box(reached, request.search_m)
        visible = _visible(banks, volume)
    return visible, volume


def _visible(banks: tuple[Bank, Bank], volume: Grid) -> NDArray[np.bool_]:
    """Return the channels with which either bank receives from a volume."""
    first, second = (bank.visibility.channels(volume) for bank in banks)
    return first | second


def _beam_of(bank: Bank, beam: BeamWindow | None, channels: NDArray[np.bool_]) -> BeamWindow | None:
    """Return the beam with the directions of the track at some channels."""
    along = bank.visibility.along
    return None if beam is None or along is None else replace(beam, along=along[channels])


def _box(grid: Grid, search_m: tuple[float, float]) -> Grid:
    """Return a grid of four pixels that span the volume of all heights to search above a grid."""
    rows, columns = grid.shape
    origin_m, row_step_m, column_step_m = grid.vectors_m
    lowest_m, highest_m = 0.0, 0.0
    if grid.height_m is not None:
        lowest_m, highest_m = float(grid.height_m.min()), float(grid.height_m.max())
    ends_m = lowest_m + search_m[0], highest_m + search_m[1]
    corners = Grid.oriented(
        origin_m, (rows - 1) * row_step_m, (columns - 1) * column_step_m, (2, 2)
    )
    return corners.with_height([ends_m, ends_m[::-1]])


def _layers(
    measured: heights.Measured, inside: tuple[slice, slice]
) -> dict[str, NDArray[np.float32]]:
    """Return the layers of a patch, with pixels that its own relief and its margin's shadow."""
    found, refined = measured.heights, measured.refined
    layers = {name: getattr(found, name) for name in LAYERS}
    shadowed = refined.valid & ~found.mask
    for name, values in zip(SHADOWED, (refined.offset_m, refined.sd_m), strict=True):
        layers[name] = np.where(shadowed, values, np.nan)
    return {name: values[inside].astype(np.float32) for name, values in layers.items()}


def _summary(
    measured: heights.Measured,
    layers: dict[str, NDArray[np.float32]],
    grid: Grid,
    inside: tuple[slice, slice],
) -> dict[str, Any]:
    """Return what a record says about heights, as types of JSON."""
    found, doubts = measured.heights, measured.doubts
    summary = {
        "valid": float(found.mask[inside].mean()),
        "looks": float(np.median(found.looks[inside])),
        "ambiguity_m": float(2 * np.pi * np.median(np.abs(found.m_per_rad[inside]))),
        "converged": measured.refined.converged,
        "best_end": doubts.end,
        "large_m": doubts.large_m,
    }
    return summary | of_shadows(layers, grid, measured.sights)
