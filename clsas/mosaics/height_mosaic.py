"""Mosaics of heights: measured patch by patch in bounded memory, and kept in a store.

Everything that does not depend on a patch is decided once: the window, so that all heights have the
same resolution, and the margin with which patches are measured. Both are kept with the inputs of
the store, and a run that continues it takes them from there.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.georeference import placed
from clsas.engine.data.grid import Grid
from clsas.engine.data.lines import RangeLines, first_two_banks
from clsas.engine.data.validate import ArgumentError
from clsas.engine.device.device import Device
from clsas.engine.factorized.planner import TOLERANCE
from clsas.interferometry import heights
from clsas.interferometry.checks import COHERENCE, PATCH, SEARCH, WINDOW, check_grid, check_pair
from clsas.interferometry.coherence import Window
from clsas.interferometry.doubts import BEYOND
from clsas.interferometry.heights import LEAST_COHERENCE
from clsas.interferometry.request import Request
from clsas.mosaics.arguments import beam_of_mosaic, warn_of_window
from clsas.mosaics.banks import Bank
from clsas.mosaics.devices import open_devices
from clsas.mosaics.document import PARTS_OF_B
from clsas.mosaics.height_patches import HeightsJob, seen
from clsas.mosaics.levels import aligned_side, factors_of
from clsas.mosaics.patches import Layout
from clsas.mosaics.provenance import inputs_of
from clsas.mosaics.record import PatchIndex, Record
from clsas.mosaics.scheduling import Run, form_patches
from clsas.mosaics.store import Store
from clsas.mosaics.survey import open_survey

_SIDE = 1024  # pixels along a patch by default, which then takes about 0.6 GiB
_TRIAL = 512  # largest side of the part of the grid that decides on the windows; arbitrary
_NAMED = 4  # patches that a warning names; the others are only counted
_MARGIN_WINDOWS = 2.0  # beside half a large one: for as many passes, of half a window each

Lines = RangeLines | str | os.PathLike


def mosaic_heights(
    a: Lines,
    b: Lines | None,
    grid: Grid,
    store: str | os.PathLike,
    *,
    search_m: Annotated[ArrayLike, SEARCH],
    window_m: Annotated[float | None, WINDOW] = None,
    tolerance_db: Annotated[float, TOLERANCE] = -40.0,
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
    hardly depend on the division into patches: at most as much as they still change in the last
    pass, about 0.3 standard deviations. The number of independent samples is measured in every
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
    beam = request.beam
    for name, source in (("a", a), *(() if b is None else [("b", b)])):
        beam = beam_of_mosaic(beam, _source(name, source), opened.path, grows=False)
    given, request = request.beam, replace(request, beam=beam)
    banks = _banks(a, b, request.beam)
    check_pair(*(bank.geometry for bank in banks))
    grid = placed(banks[1].geometry, placed(banks[0].geometry, grid))
    if given is not None and given is not beam:
        warn_of_window(given, banks[0].geometry, {"tolerance_db": request.tolerance_db})
    devices = open_devices(device)
    patch_shape = _patch_shape(grid, patch_m)
    decided = _decided(opened)
    if decided is None or request.window_m not in (None, decided["window_m"]):
        decided = _decide(banks, grid, request, devices[0])
    window_m = decided["window_m"]
    if patch_m is not None and patch_m < window_m:
        allowed = f"be at least the side of a window, {window_m:.3g} m"
        raise ArgumentError("patch_m", allowed, f"{patch_m:g} m")
    inputs = _inputs(banks, grid, request) | decided
    opened.begin(inputs, grid, patch_shape, Window.of(grid, window_m).sides)
    request = replace(request, window_m=window_m)
    job = HeightsJob(banks, grid, request, tuple(decided["margin"]), opened.path)
    layout = Layout(grid, patch_shape)
    run = Run(layout, job, inputs, banks[0].visibility, devices, None, None)
    finished = {
        index: record
        for index, record in opened.undamaged_records().items()
        if job.is_current(record, layout.window(index))
    }
    report = progress or (lambda done, total: None)
    report(len(finished), len(layout))
    with closing(form_patches(run, finished)) as forming:
        for _ in forming:
            report(len(finished), len(layout))
    _warn_of_doubts(finished)
    return opened


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


def _banks(a: Lines, b: Lines | None, beam: BeamWindow | None) -> tuple[Bank, Bank]:
    """Return the two banks of one source or of two."""
    if b is not None:
        first, second = (
            open_survey(each if isinstance(each, RangeLines) else Path(each).resolve())
            for each in (_source("a", a), _source("b", b))
        )
        for name, survey in (("a", first), ("b", second)):
            if survey.geometry.banks > 1:
                raise ArgumentError(
                    name,
                    "have the lines of one bank if `a` and `b` are given",
                    f"{survey.geometry.banks} banks",
                    "leave `b` out, or take one bank by `lines.bank(n)`",
                )
        return Bank.of(first, None, beam), Bank.of(second, None, beam)
    source = _source("a", a)
    survey = open_survey(source if isinstance(source, RangeLines) else source.resolve())
    if survey.geometry.banks < 2:
        raise ArgumentError("a", "have at least 2 banks", "1", "give the other one as `b`")
    both = first_two_banks(survey.geometry.bank_numbers)
    return Bank.of(survey, both[0], beam), Bank.of(survey, both[1], beam)


def _source(name: str, lines: Any) -> RangeLines | Path:
    return lines if isinstance(lines, RangeLines) else validate.path(name, lines)


def _patch_shape(grid: Grid, patch_m: float | None) -> tuple[int, int]:
    """Return the number of pixels of a patch, rounded so that levels end at its borders."""
    sides = []
    coarsest = factors_of(grid.shape)[-1]
    for step_m, count in zip(grid.vectors_m[1:], grid.shape, strict=True):
        side = _SIDE if patch_m is None else round(patch_m / float(np.linalg.norm(step_m)))
        patches = math.ceil(count / min(max(side, 1), count))
        sides.append(aligned_side(math.ceil(count / patches), patches, count, coarsest))
    return sides[0], sides[1]


def _inputs(banks: tuple[Bank, Bank], grid: Grid, request: Request) -> dict[str, Any]:
    """Return the inputs of a mosaic of heights as JSON types."""
    first, second = (bank.survey for bank in banks)
    inputs = inputs_of(first, grid, {"tolerance_db": request.tolerance_db}, request.beam)
    if second is not first:
        inputs[PARTS_OF_B] = second.digests()
    inputs |= {"search_m": list(request.search_m), "least_coherence": request.least_coherence}
    return json.loads(json.dumps(inputs))


def _decided(store: Store) -> dict[str, Any] | None:
    """Return the window and the margin of a store that exists."""
    if store.patch_shape is None:
        return None
    inputs = store.document.inputs
    if "window_m" not in inputs or "margin" not in inputs:  # a mosaic of images
        return None
    return {"window_m": inputs["window_m"], "margin": inputs["margin"]}


def _decide(
    banks: tuple[Bank, Bank], grid: Grid, request: Request, device: Device
) -> dict[str, Any]:
    """Return the window and the margin of a new mosaic, from images of the middle of the grid."""
    middle = grid.window(*(_middle(count) for count in grid.shape))
    pair, known, silent = seen(banks, middle, request, device)
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


def _middle(count: int) -> slice:
    side = min(count, _TRIAL)
    first = (count - side) // 2
    return slice(first, first + side)
