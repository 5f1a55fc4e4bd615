"""Speed against accuracy: images of one scene by many methods, timed and compared."""

from __future__ import annotations

import statistics
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from clsas.aperture.filters import ALIGN_TAPS, APERTURE_TAPS
from clsas.core import validate
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.image_error import relative_error_db
from clsas.core.lines import RangeLines
from clsas.exact.backprojection import ACCURACY_DB, form_exactly
from clsas.measures.cuts import Cut
from clsas.measures.quality import measure_point
from clsas.measures.shadows import DARKEST, dark_level_db
from clsas.measures.tradeoff_result import Response, Row, Tradeoff
from clsas.opencl.device import Device, open_device
from clsas.planning.factorize import factorize
from clsas.planning.planner import BEST_TOLERANCE_DB, WORST_TOLERANCE_DB, checked_pairs, plan
from clsas.plans.plan import Plan
from clsas.sonar.beam import BeamWindow

TOLERANCES_DB = (-20.0, -30.0, -40.0, -50.0, -60.0, -70.0)
STAGES = (*(((2, 2),) * count for count in range(1, 6)), ((2, 4),) * 2)
"""Plans of the thesis (chapter 4): 1 to 5 stages of 2 x 2, and 2 stages of QR = 2, QI = 4."""

STUDIED_TAPS = tuple(product(ALIGN_TAPS, APERTURE_TAPS))
STUDIED_DEPTHS = (1, 2, 3, 4)
"""Pairs of taps (in range, along the aperture) and numbers of stages that a study tries."""

REFERENCE_DB = -85.0
"""Accuracy of the exact image that all errors are relative to."""


def tradeoff(
    lines: RangeLines,
    grid: Grid,
    *,
    tolerances_db: Sequence[float] = TOLERANCES_DB,
    stages: Sequence[Sequence[tuple[int, int]]] | None = None,
    beam: BeamWindow | None = None,
    device: Device | str | int | None = None,
    repeats: int = 3,
    study: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Tradeoff:
    """Form one image by many methods; measure time and error of each.

    Every method runs once before any is timed. The timed runs then take turns, so that a machine
    that slows down slows all of them.

    Parameters
    ----------
    lines : RangeLines
        Lines to image.
    grid : Grid
        Pixels of the image.
    tolerances_db : sequence of float
        Tolerances as for `clsas.plan`.
    stages : sequence of sequences of (QR, QI), optional
        Stages of the thesis's method, as for `clsas.plan`; an empty sequence for none. By default
        those of `STAGES` that the lines and the grid allow.
    beam : BeamWindow, optional
        Weights of the channels, also for the exact image.
    device : Device, str or int, optional
        See `clsas.opencl.device.choose`.
    repeats : int
        Number of timed runs.
    study : bool
        For every tolerance, also form the image with all of `STUDIED_TAPS` and `STUDIED_DEPTHS`
        that can keep to it: the planner chooses from them. That takes long.
    progress : callable, optional
        Called as progress(images done, images).

    Returns
    -------
    Tradeoff
        The timed exact image has an accuracy of -60 dB, or of the tightest tolerance; errors are
        relative to one of -85 dB.

    Raises
    ------
    TypeError, ValueError
        If an argument is not what is allowed, see also `clsas.plan`; before anything is timed.
    DeviceError
        If there is no such device.
    """
    repeats = _check(lines, grid, beam, repeats, study)
    validate.progress(progress)
    if stages is not None:
        given = validate.entries("stages", stages, "a sequence of plans' (QR, QI)")
        stages = [checked_pairs(each) for each in given]
    tolerances = _checked_tolerances(tolerances_db)
    device = open_device(device)
    requests = _requests(
        tolerances, study, _feasible(lines, grid, beam) if stages is None else stages
    )
    candidates = list(_planned(requests, lines, grid, beam, device))
    candidates.append(_exactly(min([ACCURACY_DB, *tolerances]), lines, grid, beam, device))

    total = 1 + len(candidates) * (1 + repeats)
    done = 0

    def step() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    reference = form_exactly(lines, grid, accuracy_db=REFERENCE_DB, beam=beam, device=device)
    if not reference.pixels.any():
        raise ValueError("grid must lie where the lines hold anything: the exact image is zero")
    step()
    rows = []
    for each in candidates:  # the first run builds the kernels, and its image is measured
        rows.append(_measured(each.row, each.form(), reference))
        step()
    seconds = _timed(candidates, repeats, step)
    return Tradeoff(
        device=device.info.label,
        driver=device.info.driver,
        channels=lines.channels,
        pixels=grid.shape,
        repeats=repeats,
        rows=tuple(replace(row, seconds=median) for row, median in zip(rows, seconds, strict=True)),
        dark_level_db=dark_level_db(reference),
    )


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A method: its row as far as the plan tells, and the function that forms its image."""

    row: Row
    form: Callable[[], Image]


def _check(lines: object, grid: object, beam: object, repeats: int, study: object) -> int:
    """Raise TypeError or ValueError for arguments of a wrong kind; return the repeats."""
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    validate.flag("study", study)
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    return validate.count("repeats", repeats)


def _checked_tolerances(tolerances_db: Sequence[float]) -> list[float]:
    """Return the tolerances, of which there may be none."""
    given = validate.array("tolerances_db", tolerances_db, np.float64, None)
    return [
        validate.number(
            "every entry of tolerances_db", each, "dB", least=BEST_TOLERANCE_DB,
            most=WORST_TOLERANCE_DB,
        )
        for each in given.ravel()
    ]  # fmt: skip


def _requests(
    tolerances_db: Sequence[float], study: bool, stages: Sequence[Sequence[tuple[int, int]]]
) -> list[dict[str, Any]]:
    """Return the arguments of `clsas.plan` for every method but the exact one."""
    requests: list[dict[str, Any]] = [{"tolerance_db": each} for each in tolerances_db]
    if study:
        requests += [
            {"tolerance_db": each, "taps": taps, "depth": depth}
            for each, taps, depth in product(tolerances_db, STUDIED_TAPS, STUDIED_DEPTHS)
        ]
    return requests + [{"stages": each} for each in stages]


def _planned(
    requests: Sequence[dict[str, Any]],
    lines: RangeLines,
    grid: Grid,
    beam: BeamWindow | None,
    device: Device,
) -> Iterator[_Candidate]:
    """Yield the planned methods, without those of a study that cannot keep to the tolerance."""
    for request in requests:
        start = time.perf_counter()
        chosen = plan(lines, grid, **request, beam=beam, device=device)
        plan_seconds = time.perf_counter() - start
        if "taps" in request and chosen.is_exact:
            continue
        form = partial(factorize, lines, grid, chosen, device=device)
        yield _Candidate(_row(*_name(request), chosen, plan_seconds), form)


def _exactly(
    accuracy_db: float, lines: RangeLines, grid: Grid, beam: BeamWindow | None, device: Device
) -> _Candidate:
    """Return the exact image as a method."""
    chosen = plan(lines, grid, stages=[], beam=beam, device=device)
    row = replace(_row("exact", "exact", chosen, 0.0), predicted_error_db=accuracy_db)
    form = partial(form_exactly, lines, grid, accuracy_db=accuracy_db, beam=beam, device=device)
    return _Candidate(row, form)


def _timed(candidates: Sequence[_Candidate], repeats: int, step: Callable[[], None]) -> list[float]:
    """Return the median seconds of every method, formed in turns."""
    seconds: list[list[float]] = [[] for _ in candidates]
    for _ in range(repeats):
        for each, taken in zip(candidates, seconds, strict=True):
            start = time.perf_counter()
            each.form()
            taken.append(time.perf_counter() - start)
            step()
    return [statistics.median(taken) for taken in seconds]


def summary(chosen: Plan) -> str:
    """Return a plan in a line: its subimages (rows x columns) stage by stage, and its filters."""
    if chosen.is_exact:
        return "plain backprojection"
    sides = ", ".join(f"{rows}x{columns}" for rows, columns in chosen.sides)
    image = chosen.factorization
    return (
        f"{sides}; {image.align.taps} taps in range, {image.final.taps} at the end, "
        f"{image.aperture.describe()}"
    )


def _feasible(
    lines: RangeLines, grid: Grid, beam: BeamWindow | None
) -> list[tuple[tuple[int, int], ...]]:
    """Return the plans of `STAGES` for which lines and pixels suffice."""
    one_place = not np.ptp(lines.tx_m + lines.rx_m, axis=0).any()
    if not grid.is_planar or one_place or (beam is not None and beam.normalise):
        return []
    return [
        stages
        for stages in STAGES
        if np.prod([beams for beams, _ in stages]) <= lines.channels
        and np.prod([divisions for _, divisions in stages]) <= min(grid.shape)
    ]


def _name(request: dict[str, Any]) -> tuple[str, str]:
    """Return label and method: "-50 dB", "3 of 2x2" for equal stages, "2x2,4x2" for others."""
    if "taps" in request:
        (in_range, along), depth = request["taps"], request["depth"]
        taps = f"{in_range}+{along} taps, {depth} stage{'s' * (depth > 1)}"
        return f"{request['tolerance_db']:g} dB, {taps}", "study"
    if "stages" not in request:
        return f"{request['tolerance_db']:g} dB", "tolerance"
    each = [f"{beams}x{divisions}" for beams, divisions in request["stages"]]
    return f"{len(each)} of {each[0]}" if len(set(each)) == 1 else ",".join(each), "stages"


def _row(label: str, method: str, chosen: Plan, plan_seconds: float) -> Row:
    return Row(
        label=label,
        method=method,
        plan=summary(chosen),
        plan_seconds=plan_seconds,
        seconds=0.0,
        predicted_seconds=chosen.predicted_seconds,
        error_db=0.0,
        predicted_error_db=chosen.predicted_error_db,
    )


def _measured(row: Row, image: Image, reference: Image) -> Row:
    """Return a row with the error of its image, and the response of the strongest point."""
    azimuth, range_ = _responses(image, reference)
    return replace(
        row,
        error_db=relative_error_db(image, reference),
        azimuth=azimuth,
        range=range_,
        dark_error_db=relative_error_db(image, reference, darkest=DARKEST),
    )


def _responses(image: Image, reference: Image) -> tuple[Response | None, Response | None]:
    """Return the responses at the reference's strongest point, where they can be measured."""
    if image.grid.points_m is not None:
        return None, None
    across, upward = image.grid.sides
    row, column = np.unravel_index(np.abs(reference.pixels).argmax(), reference.grid.shape)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", validate.ClsasWarning)  # of other targets around
            point = measure_point(image, (across.places_m[column], upward.places_m[row]))
    except ValueError:  # no point response, or too near the border
        return None, None
    return _response(point.azimuth), _response(point.range)


def _response(cut: Cut) -> Response:
    return Response(cut.resolution_m, max(cut.pslr_nearest_db), cut.islr_db)
