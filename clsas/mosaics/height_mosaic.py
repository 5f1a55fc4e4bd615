"""Mosaics of heights: measured patch by patch in bounded memory, and kept in a store.

A mosaic of heights is a `Mosaic` whose patches `measure_patch` measures instead of forming images.
Everything that does not depend on a patch is decided once: the window, so that all heights have the
same resolution, and the margin with which patches are measured. Both are kept with the inputs of
the store, and a run that continues it takes them from there.

A patch is measured together with a margin, so that the windows of its outermost pixels are complete
and the cycles of the phase are decided as in a measurement of the whole grid. Lines are read for
everything that the sweep images: the patch with its margin at all heights of the search, and what
lies at the same ranges. Shadows are found once all patches are finished
(`clsas.mosaics.relief_shadows`).
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow, scale_to_all
from clsas.engine.data.certificate import scaled
from clsas.engine.data.georeference import placed
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import holds_any
from clsas.engine.data.lines import RangeLines, bank_members, first_two_banks
from clsas.engine.data.validate import ArgumentError
from clsas.engine.device.device import Device
from clsas.engine.factorized.planner import TOLERANCE
from clsas.interferometry import heights
from clsas.interferometry.baseline import Baseline
from clsas.interferometry.checks import (
    COHERENCE,
    HEIGHTS_TOLERANCE_DB,
    PATCH,
    PATCH_PIXELS,
    SEARCH,
    WINDOW,
    Request,
    UnmeasurableError,
    check_grid,
    check_pair,
)
from clsas.interferometry.coherence import Window
from clsas.interferometry.curves import Curves
from clsas.interferometry.heights import LEAST_COHERENCE
from clsas.interferometry.pair import Pair
from clsas.interferometry.sweep import BEYOND
from clsas.mosaics.devices import open_devices, thread_device
from clsas.mosaics.document import PARTS_OF_B, PatchIndex, Record
from clsas.mosaics.levels import LAYERS, SHADOWED
from clsas.mosaics.mosaic import Mosaic, beam_of_mosaic, inputs_of, warn_of_window
from clsas.mosaics.patches import Block, Layout, aligned_shape, with_margin
from clsas.mosaics.relief_shadows import mask_shadows, of_shadows
from clsas.mosaics.store import Store
from clsas.mosaics.survey import PatchSource, Survey, SurveyVisibility, largest_gap_m, open_survey

_TRIAL = 512  # largest side of the part of the grid that decides on the windows; arbitrary
_NAMED = 4  # patches that a warning names; the others are only counted
_MARGIN_WINDOWS = 2.0  # beside half a large one: for as many passes, of half a window each
_PLACES = 30  # along the diagonal of a patch, for which curves are found; arbitrary


def mosaic_heights(
    a: RangeLines | str | os.PathLike,
    b: RangeLines | str | os.PathLike | None,
    grid: Grid,
    store: str | os.PathLike,
    *,
    search_m: Annotated[ArrayLike, SEARCH],
    window_m: Annotated[float | None, WINDOW] = None,
    tolerance_db: Annotated[float, TOLERANCE] = HEIGHTS_TOLERANCE_DB,
    least_coherence: Annotated[float, COHERENCE] = LEAST_COHERENCE,
    beam: BeamWindow | None = None,
    patch_m: Annotated[float | None, PATCH] = None,
    device: Device | str | int | Sequence[Device | str | int] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Store:
    """Measure the heights of a seabed of any size patch by patch, and return their store.

    The store keeps every patch as it is finished. After an interruption, the same call continues
    with the others. If files have been added since to the folder of the survey, or to those of both
    banks, finished patches to which their channels contribute are measured again.

    Parameters
    ----------
    a, b : RangeLines or path
        Range lines of the two banks, or files or folders of them as for `mosaic`, which are read in
        slices. If `b` is None, `a` contains both banks.
    grid : Grid
        Plane above which heights are measured, or height map where the search starts, as for
        `heights`.
    store : path
        Zarr store to write, or to continue.
    search_m, tolerance_db, least_coherence, beam
        See `heights`. A beam's direction is computed from the whole track, as for `mosaic`.
    window_m : float, optional
        Side of the windows, metres. By default those in the middle of the grid contain about 50
        independent samples. The window is the same in all patches.
    patch_m : float, optional
        Approximate side of the patches, metres; by default 1024 pixels. Memory grows with the size
        of a patch and its margin.
    device : Device, str or int, or a sequence of them, optional
        Devices that work side by side, as for `mosaic`.
    progress : callable, optional
        Called as progress(patches finished, number of patches).

    Returns
    -------
    Store
        `Store.heights` reads them, and `Store.overview_heights` those of fewer pixels. `clsas show`
        and `export` take the store too.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is outside its limits; if the banks do not belong
        together or do not show heights in the middle of the grid, as for `heights`; or if `store`
        was made with other inputs (the message names the differences).
    FileFormatError, OSError
        If a file cannot be read or the store cannot be written.
    ImportError
        If Zarr is not installed.
    DeviceError
        If there is no such device.

    Warns
    -----
    ClsasWarning
        If a store is damaged, whose damaged patches are then measured again; if `a` has more than
        two banks, of which the first two are used; or once, at the end, if there are patches in
        which the banks agree best at an end of the search, or which are too small to tell heights
        of ambiguity apart, as for `heights`.

    See Also
    --------
    heights : Measure heights in memory.
    mosaic : Form an image of any size.

    Notes
    -----
    Every patch is measured with a margin of two windows and half a large one, which decides between
    the cycles of the phase, and with all that lies at the same ranges within the search. So heights
    hardly depend on the division into patches: they change by about 0.2 standard deviations. The
    number of independent samples is measured in every
    patch, and with it the standard deviation and the threshold of the coherence. Shadows may be
    longer than patches: once all are finished, they are found from the relief of all of them.

    Patches without lines, or whose geometry shows no heights, such as one below the track, contain
    NaN. `Record.flags` gives the reason.

    Examples
    --------
    A flat seabed 0.2 m above the plane of the grid, 20 m away:

    >>> import tempfile
    >>> import clsas
    >>> import numpy as np
    >>> random = np.random.default_rng(1)
    >>> places_m = random.uniform([-0.9, 19.0, 0.2], [0.9, 21.6, 0.2], (10000, 3))
    >>> amplitudes = random.standard_normal((10000, 2)) @ [1, 1j]
    >>> scene = clsas.PointTargets(places_m, amplitudes)
    >>> tx_m = np.outer(np.linspace(-2, 2, 81), [1, 0, 0]) + [0, 0, 6]
    >>> lower, upper = (
    ...     clsas.simulate_lines(
    ...         tx_m, tx_m + [0, 0, up_m], scene, carrier_hz=100e3, bandwidth_hz=30e3
    ...     )
    ...     for up_m in (0.0, 0.2)
    ... )
    >>> grid = clsas.Grid.plane((-0.5, 0.5, 41), (19.6, 20.8, 49))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     store = clsas.mosaic_heights(
    ...         lower, upper, grid, f"{folder}/heights.zarr", search_m=(-0.1, 0.5), patch_m=0.6
    ...     )
    ...     print(f"{len(store.records())} patches, {np.nanmedian(store.heights().height_m):.2f} m")
    6 patches, 0.20 m
    """
    validate.instance("grid", grid, Grid)
    check_grid(grid)
    request = Request.checked(grid, search_m, window_m, tolerance_db, least_coherence, beam)
    if patch_m is not None:
        patch_m = PATCH.check("patch_m", patch_m)
    validate.progress(progress)
    opened = Store.at(validate.path("store", store))
    sources, beam = [], request.beam
    for name, each in (("a", a), *(() if b is None else [("b", b)])):
        source = each if isinstance(each, RangeLines) else validate.path(name, each)
        beam = beam_of_mosaic(beam, source, opened.path, grows=False)
        sources.append(source)
    given, request = request.beam, replace(request, beam=beam)
    banks = _banks(sources, beam)
    check_pair(*(bank.geometry for bank in banks))
    grid = placed(banks[1].geometry, placed(banks[0].geometry, grid))
    if given is not None and given is not beam:
        warn_of_window(given, banks[0].geometry, {"tolerance_db": request.tolerance_db})
    devices = open_devices(device)
    sides = [PATCH_PIXELS, PATCH_PIXELS]
    if patch_m is not None:
        sides = [round(patch_m / float(np.linalg.norm(step_m))) for step_m in grid.vectors_m[1:]]
    counts = [math.ceil(n / max(side, 1)) for n, side in zip(grid.shape, sides, strict=True)]
    patch_shape = aligned_shape(grid.shape, counts)

    # A store that exists has decided on the window and the margin, unless it is one of images.
    stored = {} if opened.patch_shape is None else opened.document.inputs
    decided: dict[str, Any] = {
        name: stored[name] for name in ("window_m", "margin") if name in stored
    }
    if len(decided) < 2 or request.window_m not in (None, decided["window_m"]):
        decided = _decide(banks, grid, request, devices[0])
    request = replace(request, window_m=decided["window_m"])
    assert request.window_m is not None
    if patch_m is not None and patch_m < request.window_m:
        allowed = f"be at least the side of a window, {request.window_m:.3g} m"
        raise ArgumentError("patch_m", allowed, f"{patch_m:g} m")
    inputs = inputs_of(banks[0].survey, grid, {"tolerance_db": request.tolerance_db}, beam)
    if banks[1].survey is not banks[0].survey:
        inputs[PARTS_OF_B] = banks[1].survey.digests()
    inputs |= {"search_m": list(request.search_m), "least_coherence": request.least_coherence}
    inputs = json.loads(json.dumps(inputs)) | decided
    opened.begin(inputs, grid, patch_shape, Window.of(grid, request.window_m).sides)

    margin, layout = tuple(decided["margin"]), Layout(grid, patch_shape)
    finished = {}
    for index, record in opened.undamaged_records().items():
        # Patches to which channels contribute that were added since are measured again.
        if record.survey_channels < len(banks[0].members):
            rows, columns, _ = with_margin(layout.window(index), margin, grid.shape)
            visible, _ = _swept(banks, grid.window(rows, columns), request)
            if visible[record.survey_channels :].any():
                continue
        finished[index] = record
    mosaic = Mosaic(
        grid,
        patch_shape,
        finished,
        _form=partial(measure_patch, banks, grid, request, margin, opened),
        _complete=partial(_complete, opened),
        _visibility=banks[0].visibility,
        _block_shape=patch_shape,
        _store=opened,
        _inputs=inputs,
        _devices=devices,
        _tolerance_db=request.tolerance_db,
        _on_miss="warn",
    )
    report = progress or (lambda done, total: None)
    report(len(finished), len(mosaic))
    with closing(iter(mosaic)) as measuring:
        for _ in measuring:
            report(len(finished), len(mosaic))
    _warn_of_doubts(finished)
    return opened


def _complete(store: Store) -> None:
    """Find the shadows of the whole relief, then compute the levels that mix patches."""
    mask_shadows(store)
    store.complete_levels()


@dataclass(frozen=True, eq=False)
class Bank:
    """One receiver bank of a survey.

    Attributes
    ----------
    survey : Survey
        The survey, which may have other banks too.
    members : int64 [channels]
        Channels of the survey that belong to the bank.
    visibility : SurveyVisibility
        The channels of the bank alone, without their samples.
    """

    survey: Survey
    members: NDArray[np.int64]
    visibility: SurveyVisibility

    @classmethod
    def of(cls, survey: Survey, number: int | None, beam: BeamWindow | None) -> Self:
        """Return a bank of a survey by its number; None stands for all channels."""
        geometry = survey.geometry
        chosen = np.arange(survey.channels)
        if number is not None:
            chosen = chosen[bank_members(geometry.bank_numbers, number)]
            geometry = geometry.bank(number)
        begins = np.searchsorted(chosen, survey.begins)
        alone = replace(survey, geometry=geometry, begins=tuple(map(int, begins)))
        return cls(survey, chosen, SurveyVisibility.of(alone, beam))

    @property
    def geometry(self) -> RangeLines:
        """Geometry of the bank's channels."""
        return self.visibility.survey.geometry

    def read(
        self, visible: NDArray[np.bool_], near_m: NDArray[np.float64], far_m: NDArray[np.float64]
    ) -> tuple[RangeLines, NDArray[np.bool_]]:
        """Return lines of the bank between two ranges; see `Survey.read`."""
        chosen = np.zeros(self.survey.channels, bool)
        chosen[self.members[visible]] = True
        ends_m = np.zeros((2, self.survey.channels))
        ends_m[:, self.members] = near_m, far_m
        lines, missing = self.survey.read(chosen, *ends_m)
        return replace(lines, bank_numbers=None), missing


def _banks(sources: Sequence[RangeLines | Path], beam: BeamWindow | None) -> tuple[Bank, Bank]:
    """Return the two banks of one source or of two."""
    surveys = [
        open_survey(each if isinstance(each, RangeLines) else each.resolve()) for each in sources
    ]
    first, second = surveys[0], surveys[-1]
    if len(surveys) == 1:
        if first.geometry.banks < 2:
            raise ArgumentError("a", "have at least 2 banks", "1", "give the other one as `b`")
        both = first_two_banks(first.geometry.bank_numbers)
        return Bank.of(first, both[0], beam), Bank.of(first, both[1], beam)
    for name, survey in (("a", first), ("b", second)):
        if survey.geometry.banks > 1:
            raise ArgumentError(
                name,
                "have the lines of one bank if `a` and `b` are given",
                f"{survey.geometry.banks} banks",
                "leave `b` out, or take one bank by `lines.bank(n)`",
            )
    return Bank.of(first, None, beam), Bank.of(second, None, beam)


def _decide(
    banks: tuple[Bank, Bank], grid: Grid, request: Request, device: Device
) -> dict[str, Any]:
    """Return the window and the margin of a new mosaic, from images of the middle of the grid."""
    part = []
    for count in grid.shape:
        side = min(count, _TRIAL)
        first = (count - side) // 2
        part.append(slice(first, first + side))
    middle = grid.window(*part)
    pair, known, silent = _seen(banks, middle, request, device)
    if silent:
        raise ArgumentError(
            silent[0],
            "contain echoes",
            "samples that are all zero or not finite in the "
            f"{known['channels']} channels that receive from the middle of the grid",
        )
    if pair is None:
        raise ArgumentError(
            "grid", "lie where the lines reach it", hint="no channel receives from its middle"
        )
    window_m, window, large = heights.windows(pair, middle, request)
    margin = [
        math.ceil(wide / 2 + _MARGIN_WINDOWS * side)
        for side, wide in zip(window.sides, large.sides, strict=True)
    ]
    return {"window_m": window_m, "margin": margin}


def measure_patch(
    banks: tuple[Bank, Bank],
    grid: Grid,
    request: Request,
    margin: tuple[int, int],
    store: Store,
    block: Block,
    _source: PatchSource,
    _missed: Record | None,
) -> list[tuple[Record, None]]:
    """Measure a patch of a grid with a margin, and write it to the store.

    Blocks have one patch each, because the margin depends on it. The banks do not grow, and no
    patch is measured again for its error. If the patch cannot be imaged, a note of the ValueError
    names it.
    """
    start = time.perf_counter()
    ((window, _),) = block.patches()
    rows, columns, inside = with_margin(window, margin, grid.shape)
    wide = grid.window(rows, columns)
    pixels: NDArray[np.complex64] = np.zeros(window.grid.shape, np.complex64)
    names = (*LAYERS, *SHADOWED)
    layers = {name: np.full(window.grid.shape, np.nan, np.float32) for name in names}
    try:
        pair, known, _silent = _seen(banks, wide, request, thread_device())
        if pair is not None:
            try:
                measured = heights.measured(pair, wide, request, None)
            except UnmeasurableError as error:
                known["heights"] = {"reason": str(error)}
            else:
                scale = scale_to_all(request.beam, pair.a.channels, len(banks[0].members))
                pixels = scale * measured.heights.image.pixels[inside]
                layers, known["heights"] = _results(measured, window.grid, inside)
                known["certificate"] = scaled(measured.heights.certificate, float(scale))
                known["unmeasured"] = measured.unmeasured
            known["has_pixels"] = holds_any(pixels)
        record = Record(**known, seconds=time.perf_counter() - start)
    except ValueError as error:
        error.add_note(str(block))
        raise
    store.write(*window[1:], pixels, record, layers)
    return [(record, None)]


def _results(
    measured: heights.Measured, grid: Grid, inside: tuple[slice, slice]
) -> tuple[dict[str, NDArray[np.float32]], dict[str, Any]]:
    """Return the layers of a patch, and what its record says about heights, as types of JSON."""
    found, refined, doubts = measured.heights, measured.refined, measured.doubts
    values = {name: getattr(found, name) for name in LAYERS}
    # Pixels that are hidden by the relief of the patch or of its margin.
    shadowed = refined.valid & ~found.mask
    for name, each in zip(SHADOWED, (refined.offset_m, refined.sd_m), strict=True):
        values[name] = np.where(shadowed, each, np.nan)
    layers = {name: each[inside].astype(np.float32) for name, each in values.items()}
    summary = {
        "valid": float(found.mask[inside].mean()),
        "looks": float(np.median(found.looks[inside])),
        "ambiguity_m": float(2 * np.pi * np.median(np.abs(found.m_per_rad[inside]))),
        "converged": refined.converged,
        "best_end": doubts.end,
        "large_m": doubts.large_m,
    }
    return layers, summary | of_shadows(layers, grid, measured.sights)


def _seen(
    banks: tuple[Bank, Bank], grid: Grid, request: Request, device: Device
) -> tuple[Pair | None, dict[str, Any], list[str]]:
    """Return what two banks recorded of a grid and of the heights to search above it.

    Returns
    -------
    pair : Pair or None
        Lines of both banks, or None if no channel of both has samples.
    known : dict
        Fields of the record of the patch.
    silent : list of {"a", "b"}
        Banks of which no channel has samples, though some receive from that part.
    """
    start = time.perf_counter()
    known: dict[str, Any] = {
        "survey_channels": len(banks[0].members),
        "device": device.info.label,
        "driver": device.info.driver,
    }
    visible, volume = _swept(banks, grid, request)
    known["channels"] = int(np.count_nonzero(visible))
    if not visible.any():
        return None, known, []
    (first, lost), (second, lost_too) = (
        bank.read(visible, *bank.visibility.ranges_m(volume)) for bank in banks
    )
    missing = lost | lost_too
    known |= {
        "missing_channels": int(np.count_nonzero(missing)),
        "gap_m": largest_gap_m(first.phase_centres_m, missing),
        "read_seconds": time.perf_counter() - start,
    }
    if missing.all():
        return None, known, [n for n, each in (("a", lost), ("b", lost_too)) if each.all()]
    chosen = visible.copy()
    chosen[visible] = ~missing
    if missing.any():
        first, second = first.select(~missing), second.select(~missing)
    beam = _beam_of(banks[0], request.beam, chosen)
    return Pair(first, second, request.tolerance_db, None, beam, device), known, []


def _swept(
    banks: tuple[Bank, Bank], grid: Grid, request: Request
) -> tuple[NDArray[np.bool_], Grid]:
    """Return the channels from which heights of a grid follow, and the volume that they image."""
    first, second = banks
    volume = _box(grid, request.search_m)
    visible = first.visibility.channels(volume) | second.visibility.channels(volume)
    if visible.any():
        some = [bank.geometry.select(visible) for bank in banks]
        baseline = Baseline.of(some[0], some[1], _beam_of(first, request.beam, visible), 1.0)
        step_m = float(np.linalg.norm(np.ptp(grid.spread(2)[:, :2], axis=0))) / _PLACES
        curves = Curves.over(baseline, grid, request.search_m, (step_m, step_m))
        low_m, *_, high_m = curves.lattice.offset_m
        volume = _box(curves.grid, (low_m, high_m))
        visible = first.visibility.channels(volume) | second.visibility.channels(volume)
    return visible, volume


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


def _warn_of_doubts(records: dict[PatchIndex, Record]) -> None:
    """Warn once of all patches in which the cycles of the phase are uncertain."""
    known = {index: each.heights for index, each in records.items() if each.heights is not None}
    measured = {index: each for index, each in known.items() if "reason" not in each}
    beyond = {index: each for index, each in measured.items() if each["best_end"]}
    if beyond:
        of_ends = {
            end: some
            for end in BEYOND
            if (some := [index for index, each in beyond.items() if each["best_end"] == end])
        }
        sides = [BEYOND[end] for end in of_ends]
        ends = [
            f"its {end} end in {_in_words(some)}, where most of the seabed seems to lie {side} it"
            for (end, some), side in zip(of_ends.items(), sides, strict=True)
        ]
        validate.warn(
            f"`search_m` may not contain the seabed: of {len(records)} patches, the banks agree "
            f"best at {'; and at '.join(ends)}. Heights may be wrong by multiples of the height of "
            f"ambiguity, {_span(beyond)}: search farther {' and '.join(sides)}"
        )
    small = {index: each for index, each in measured.items() if each["large_m"] is not None}
    if small:
        large_m = max(each["large_m"] for each in small.values())
        validate.warn(
            f"of {len(records)} patches, {_in_words(list(small))}, even with their margins, are "
            f"smaller than the windows of up to {large_m:.2g} m that tell heights apart which "
            f"differ by the height of ambiguity, {_span(small)}, where the coherence is low: make "
            "`patch_m` and the grid larger, or `search_m` smaller"
        )


def _in_words(indices: list[PatchIndex]) -> str:
    """Return the number of patches, and the first of them."""
    named = "; ".join(f"{row},{column}" for row, column in sorted(indices)[:_NAMED])
    return f"{len(indices)} ({named}{'; ...' if len(indices) > _NAMED else ''})"


def _span(measured: dict[PatchIndex, dict[str, Any]]) -> str:
    """Return the heights of ambiguity of some patches, in words."""
    least, most = (
        f"{edge(each['ambiguity_m'] for each in measured.values()):.3g}" for edge in (min, max)
    )
    return f"{least} m" if least == most else f"{least} to {most} m"
