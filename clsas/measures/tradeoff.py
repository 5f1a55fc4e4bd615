"""Time against error: one image formed by many methods, timed and compared."""

from __future__ import annotations

import statistics
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count, product
from typing import Annotated

import numpy as np

from clsas.engine.data import validate
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.declared import Count, Flag, Several
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.validate import ArgumentError
from clsas.engine.device.device import Device, open_device
from clsas.engine.exact.decide import ACCURACY_DB
from clsas.engine.factorized.filters import ALIGN_TAPS, APERTURE_TAPS
from clsas.engine.factorized.plan import Plan
from clsas.engine.factorized.planner import (
    BEST_TOLERANCE_DB,
    THESIS_STAGES,
    TOLERANCE,
    WORST_TOLERANCE_DB,
    Request,
    checked_pairs,
    planned,
)
from clsas.engine.forming import form_exactly
from clsas.engine.imaging import factorize
from clsas.engine.signal.doubts import warn_before_imaging
from clsas.measures.cuts import Cut
from clsas.measures.quality import measure_point
from clsas.measures.shadows import DARKEST, dark_level_db
from clsas.measures.tradeoff_result import Response, Row, Tradeoff

TOLERANCES_DB = (-20.0, -30.0, -40.0, -50.0, -60.0, -70.0)
STAGES = (*(((2, 2),) * count for count in range(1, 6)), ((2, 4),) * 2)
"""Stages of Ødegaard (2004), chapter 4: 1 to 5 of QR = QI = 2, and 2 of QR = 2 and QI = 4."""

STUDIED_TAPS = tuple(product(ALIGN_TAPS, APERTURE_TAPS))
STUDIED_DEPTHS = (1, 2, 3, 4)
"""Taps (in range, along the aperture) and numbers of stages that a study tries."""

REFERENCE_DB = -85.0
"""Accuracy of the exact image that all errors are relative to, in dB."""


def tradeoff(
    lines: RangeLines,
    grid: Grid,
    *,
    tolerances_db: Annotated[
        Sequence[float], Several(TOLERANCE, help="Tolerances of the images.")
    ] = TOLERANCES_DB,
    stages: Annotated[
        Sequence[Sequence[tuple[int, int]]] | None,
        Several(
            THESIS_STAGES,
            help="Stages of the thesis's method for an image.",
            default="1 to 5 of 2x2, 2 of 2x4",
        ),
    ] = None,
    beam: BeamWindow | None = None,
    device: Device | str | int | None = None,
    repeats: Annotated[int, Count(help="Timed runs of each image.")] = 3,
    study: Annotated[
        bool, Flag("Also vary the taps of the filters, and the number of stages.")
    ] = False,
    progress: Callable[[int, int], None] | None = None,
) -> Tradeoff:
    """Return the measured time and error of one image formed by many methods.

    Every method forms the image once before any is timed. The timed runs take turns, so that a
    machine that becomes slower affects all methods alike.

    Parameters
    ----------
    lines : RangeLines
        Lines to image.
    grid : Grid
        Pixels of the image.
    tolerances_db : sequence of float
        Tolerances as for `clsas.plan`.
    stages : sequence of sequences of (QR, QI), optional
        Stages of the method of Ødegaard (2004), as for `clsas.plan`; an empty sequence for none.
        By default all of `STAGES` that lines and grid allow.
    beam : BeamWindow, optional
        Weights of the channels, also for the exact image.
    device : Device, str or int, optional
        See `clsas.engine.device.device.choose`.
    repeats : int
        Number of timed runs.
    study : bool
        True to form the image also with all of `STUDIED_TAPS` and `STUDIED_DEPTHS` that can keep
        each tolerance. The planner chooses from these. This takes long.
    progress : callable, optional
        Called as progress(images formed, all images).

    Returns
    -------
    Tradeoff
        The timed exact image has an accuracy of -60 dB, or of the tightest tolerance. Errors are
        relative to an exact image with an accuracy of -85 dB.

    Raises
    ------
    TypeError, ValueError
        If an argument has the wrong type or is out of bounds (see also `clsas.plan`), before
        anything is timed; or if the exact image is zero.
    DeviceError
        If the device does not exist.

    See Also
    --------
    plot.tradeoff : Draw the result.
    plan : The fastest image within a tolerance.

    References
    ----------
    Ødegaard (2004), "Fast time domain beamforming for synthetic aperture sonar", chapter 4.

    Examples
    --------
    >>> import clsas
    >>> import numpy as np
    >>> tx_m = np.outer(np.arange(64), [0.02, 0, 0])
    >>> point = clsas.PointTargets([[0.6, 20.0, 0.0]], [1.0])
    >>> lines = clsas.simulate_lines(tx_m, tx_m, point, carrier_hz=100e3, bandwidth_hz=20e3)
    >>> grid = clsas.Grid.plane((0.4, 0.8, 32), (19.8, 20.2, 32))
    >>> measured = clsas.tradeoff(lines, grid, tolerances_db=[-30], stages=[], repeats=1)
    >>> [row.label for row in measured.rows]
    ['-30 dB', 'exact']
    >>> measured.rows[0].error_db < -30
    True
    """
    repeats = _check(lines, grid, beam, repeats, study)
    validate.progress(progress)
    if stages is not None:
        given = validate.entries("stages", stages, "a sequence of plans' (QR, QI)")
        stages = [checked_pairs(each) for each in given]
    tolerances = _checked_tolerances(tolerances_db)
    device = open_device(device)
    warn_before_imaging(lines, grid, beam)
    requests = _requests(
        tolerances, study, _feasible(lines, grid, beam) if stages is None else stages
    )
    candidates = list(_planned(requests, lines, grid, beam, device))
    candidates.append(_exactly(min([ACCURACY_DB, *tolerances]), lines, grid, beam, device))

    total, done = 1 + len(candidates) * (1 + repeats), count(1)

    def step() -> None:
        if progress is not None:
            progress(next(done), total)

    reference = form_exactly(lines, grid, accuracy_db=REFERENCE_DB, beam=beam, device=device)
    if not reference.pixels.any():
        hint = "the exact image is zero everywhere"
        raise ArgumentError("grid", "lie where the lines have echoes", hint=hint)
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


@dataclass(frozen=True)
class _Request:
    """Arguments of `clsas.plan` for one method, and how its row is labelled."""

    label: str
    method: str
    tolerance_db: float | None = None
    stages: Sequence[tuple[int, int]] | None = None
    taps: tuple[int, int] | None = None
    depth: int | None = None


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A method: its row as planned, without measurements, and a function that forms its image."""

    row: Row
    form: Callable[[], Image]


def _check(lines: object, grid: object, beam: object, repeats: int, study: object) -> int:
    """Return the repeats; raise TypeError or ValueError if an argument has the wrong type."""
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    validate.flag("study", study)
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    return validate.count("repeats", repeats)


def _checked_tolerances(tolerances_db: Sequence[float]) -> list[float]:
    """Return the tolerances, which may be an empty list."""
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
) -> list[_Request]:
    """Return a request for every method but the exact one."""
    requests = [_Request(f"{each:g} dB", "tolerance", each) for each in tolerances_db]
    if study:
        for each, taps, depth in product(tolerances_db, STUDIED_TAPS, STUDIED_DEPTHS):
            label = f"{each:g} dB, {taps[0]}+{taps[1]} taps, {depth} stage{'s' * (depth > 1)}"
            requests.append(_Request(label, "study", each, taps=taps, depth=depth))
    return requests + [_Request(_label(each), "stages", stages=each) for each in stages]


def _label(stages: Sequence[tuple[int, int]]) -> str:
    """Return "3 of 2x2" for equal stages, "2x2,4x2" for others."""
    each = [f"{beams}x{divisions}" for beams, divisions in stages]
    return f"{len(each)} of {each[0]}" if len(set(each)) == 1 else ",".join(each)


def _planned(
    requests: Sequence[_Request],
    lines: RangeLines,
    grid: Grid,
    beam: BeamWindow | None,
    device: Device,
) -> Iterator[_Candidate]:
    """Yield the planned methods, without those of a study that cannot keep the tolerance."""
    for request in requests:
        start = time.perf_counter()
        asked = Request(
            lines, grid, tolerance_db=request.tolerance_db, stages=request.stages,
            taps=request.taps, depth=request.depth, beam=beam,
        )  # fmt: skip
        scene = asked.scene()
        scene.warn("tolerance_db", asked.tolerance_db, doubts=False)
        chosen, _ = planned(scene, asked, device)
        plan_seconds = time.perf_counter() - start
        if request.taps is not None and chosen.is_exact:
            continue
        form = partial(factorize, lines, grid, chosen, device=device)
        yield _Candidate(_row(request.label, request.method, chosen, plan_seconds), form)


def _exactly(
    accuracy_db: float, lines: RangeLines, grid: Grid, beam: BeamWindow | None, device: Device
) -> _Candidate:
    """Return the exact image as a candidate."""
    asked = Request(lines, grid, stages=[], beam=beam)
    chosen, _ = planned(asked.scene(), asked, device)
    row = replace(_row("exact", "exact", chosen, 0.0), predicted_error_db=accuracy_db)
    form = partial(form_exactly, lines, grid, accuracy_db=accuracy_db, beam=beam, device=device)
    return _Candidate(row, form)


def _timed(candidates: Sequence[_Candidate], repeats: int, step: Callable[[], None]) -> list[float]:
    """Return the median time of every candidate in seconds; they are formed in turns."""
    seconds: list[list[float]] = [[] for _ in candidates]
    for _ in range(repeats):
        for each, taken in zip(candidates, seconds, strict=True):
            start = time.perf_counter()
            each.form()
            taken.append(time.perf_counter() - start)
            step()
    return [statistics.median(taken) for taken in seconds]


def summary(chosen: Plan) -> str:
    """Return a plan as one line: the subimages (rows x columns) of every stage, and its filters."""
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
    """Return those of `STAGES` for which there are enough lines and pixels."""
    at_one_position = not np.ptp(lines.tx_m + lines.rx_m, axis=0).any()
    if not grid.is_planar or at_one_position or (beam is not None and beam.normalise):
        return []
    return [
        stages
        for stages in STAGES
        if np.prod([beams for beams, _ in stages]) <= lines.channels
        and np.prod([divisions for _, divisions in stages]) <= min(grid.shape)
    ]


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
    """Return a row with the error of its image and the response of the strongest point."""
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
            warnings.simplefilter("ignore", validate.ClsasWarning)  # about other targets nearby
            point = measure_point(image, (across.places_m[column], upward.places_m[row]))
    except ValueError:  # there is no point response, or it is too close to the border
        return None, None
    return _response(point.azimuth), _response(point.range)


def _response(cut: Cut) -> Response:
    return Response(cut.resolution_m, max(cut.pslr_nearest_db), cut.islr_db)
