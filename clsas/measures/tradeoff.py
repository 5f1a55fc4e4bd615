"""Time against error: one image formed by many methods, timed and compared, as a table and CSV."""

from __future__ import annotations

import csv
import math
import os
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count, product
from typing import Annotated

import numpy as np

from clsas.engine.data import reprs, validate
from clsas.engine.data.atomic import replacing
from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.declared import Count, Flag, Several, check_declared
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.image_error import relative_error_db
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.reprs import Report, Table
from clsas.engine.data.validate import ArgumentError
from clsas.engine.device.device import Device, open_device
from clsas.engine.exact.decide import ACCURACY_DB
from clsas.engine.factorized.filters import ALIGN_TAPS, APERTURE_TAPS
from clsas.engine.factorized.plan import Plan
from clsas.engine.factorized.planner import (
    THESIS_STAGES,
    TOLERANCE,
    Request,
    planned,
)
from clsas.engine.forming import form_exactly
from clsas.engine.imaging import factorize
from clsas.engine.signal.ambiguity import BEST_DB
from clsas.engine.signal.doubts import warn_before_imaging
from clsas.measures.quality import DARKEST, dark_level_db, measure_point

TOLERANCES_DB = (-20.0, -30.0, -40.0, -50.0, -60.0, -70.0)
STAGES = (*(((2, 2),) * count for count in range(1, 6)), ((2, 4),) * 2)
"""Stages of Ødegaard (2004), chapter 4: 1 to 5 of QR = QI = 2, and 2 of QR = 2 and QI = 4."""

STUDIED_TAPS = tuple(product(ALIGN_TAPS, APERTURE_TAPS))
STUDIED_DEPTHS = (1, 2, 3, 4)
"""Taps (in range, along the aperture) and numbers of stages that a study tries."""

REFERENCE_DB = BEST_DB
"""Accuracy of the exact image that all errors are relative to, in dB."""

_FIGURES = ("resolution_m", "pslr_db", "islr_db")
_COLUMNS = (
    "", "time (s)", "predicted (s)", "speedup", "error (dB)", "predicted (dB)", "in the dark (dB)",
    "azimuth", "range", "azimuth PSLR", "range PSLR",
)  # fmt: skip
_HEADER = (
    "label", "method", "plan", "plan_s", "time_s", "predicted_time_s", "error_db",
    "predicted_error_db", "dark_error_db",
    *(f"{axis}_{figure}" for axis in ("azimuth", "range") for figure in _FIGURES),
)  # fmt: skip


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
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    options = {
        "tolerances_db": tolerances_db, "stages": stages, "repeats": repeats, "study": study
    }  # fmt: skip
    tolerances, stages, repeats, study = check_declared(tradeoff, options).values()
    validate.progress(progress)
    device = open_device(device)
    warn_before_imaging(lines, grid, beam)
    if stages is None:
        stages = _feasible_stages(lines, grid, beam)
    candidates = list(_candidates(lines, grid, beam, device, tolerances, stages, study))

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
    for row, form in candidates:  # the first run builds the kernels, and its image is measured
        rows.append(_with_errors(row, form(), reference))
        step()
    seconds: list[list[float]] = [[] for _ in candidates]
    for _ in range(repeats):
        for (_, form), taken in zip(candidates, seconds, strict=True):
            start = time.perf_counter()
            form()
            taken.append(time.perf_counter() - start)
            step()
    return Tradeoff(
        device=device.info.label,
        driver=device.info.driver,
        channels=lines.channels,
        pixels=grid.shape,
        repeats=repeats,
        rows=tuple(
            replace(row, seconds=statistics.median(taken))
            for row, taken in zip(rows, seconds, strict=True)
        ),
        dark_level_db=dark_level_db(reference),
    )


def _feasible_stages(
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


def _candidates(
    lines: RangeLines,
    grid: Grid,
    beam: BeamWindow | None,
    device: Device,
    tolerances: Sequence[float],
    stages: Sequence[Sequence[tuple[int, int]]],
    study: bool,
) -> Iterator[tuple[Row, Callable[[], Image]]]:
    """Yield every method: its row without measurements, and a function that forms its image.

    Methods of a study that cannot keep the tolerance are left out.
    """
    ask = partial(Request, lines, grid, beam=beam)
    methods = [
        (f"{each:g} dB", "tolerance", partial(ask, tolerance_db=each)) for each in tolerances
    ]
    if study:
        for each, taps, depth in product(tolerances, STUDIED_TAPS, STUDIED_DEPTHS):
            label = f"{each:g} dB, {taps[0]}+{taps[1]} taps, {depth} stage{'s' * (depth > 1)}"
            methods.append(
                (label, "study", partial(ask, tolerance_db=each, taps=taps, depth=depth))
            )
    for pairs in stages:
        names = [f"{beams}x{divisions}" for beams, divisions in pairs]
        label = f"{len(names)} of {names[0]}" if len(set(names)) == 1 else ",".join(names)
        methods.append((label, "stages", partial(ask, stages=pairs)))
    for label, method, asked_for in methods:
        start = time.perf_counter()
        _, chosen, _ = planned(asked_for(), device, doubts=False)
        plan_seconds = time.perf_counter() - start
        if method == "study" and chosen.is_exact:
            continue
        row = _planned_row(label, method, chosen, plan_seconds)
        yield row, partial(factorize, lines, grid, chosen, device=device)

    accuracy_db = min([ACCURACY_DB, *tolerances])
    _, chosen, _ = planned(ask(stages=[]), device, doubts=False)
    row = replace(_planned_row("exact", "exact", chosen, 0.0), predicted_error_db=accuracy_db)
    yield row, partial(form_exactly, lines, grid, accuracy_db=accuracy_db, beam=beam, device=device)


def _planned_row(label: str, method: str, chosen: Plan, plan_seconds: float) -> Row:
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


def _with_errors(row: Row, image: Image, reference: Image) -> Row:
    """Return a row with the error of its image and the response of the strongest point."""
    azimuth = range_ = None
    if image.grid.points_m is None:
        across, upward = image.grid.sides
        at = np.unravel_index(np.abs(reference.pixels).argmax(), reference.grid.shape)
        try:
            with validate.muted():  # about other targets nearby
                point = measure_point(image, (across.places_m[at[1]], upward.places_m[at[0]]))
            azimuth, range_ = (
                Response(cut.resolution_m, max(cut.pslr_nearest_db), cut.islr_db)
                for cut in (point.azimuth, point.range)
            )
        except ValueError:  # there is no point response, or it is too close to the border
            pass
    return replace(
        row,
        error_db=relative_error_db(image, reference),
        azimuth=azimuth,
        range=range_,
        dark_error_db=relative_error_db(image, reference, darkest=DARKEST),
    )


@dataclass(frozen=True)
class Response:
    """Response of a point along one axis; see `clsas.measures.quality.Cut`.

    Attributes
    ----------
    resolution_m : float
        Width at -3 dB in metres.
    pslr_db : float
        Higher one of the two side lobes next to the main lobe, in dB.
    islr_db : float
        Energy of the side lobes relative to that of the main lobe, in dB.
    """

    resolution_m: float
    pslr_db: float
    islr_db: float


@dataclass(frozen=True)
class Row:
    """Time and errors of an image formed by one method.

    Attributes
    ----------
    label : str
        The tolerance, the given stages ("3 of 2x2"), or "exact". In a study, the tolerance, taps
        in range and along the aperture, and number of stages ("-50 dB, 8+6 taps, 3 stages").
    method : str
        "tolerance", "study", "stages" or "exact".
    plan : str
        Subimages of every stage, and the filters.
    plan_seconds : float
        Time that planning took; 0 for the exact image.
    seconds : float
        Median time of the image, without planning.
    predicted_seconds : float
        Time that the plan predicts.
    error_db, predicted_error_db : float
        Measured and predicted relative rms error, in dB.
    azimuth, range : Response or None
        Response at the strongest point of the exact image; None if it cannot be measured.
    dark_error_db : float
        Error in the darkest tenth of the exact image, relative to the level there, in dB; see
        `clsas.measures.quality`.
    """

    label: str
    method: str
    plan: str
    plan_seconds: float
    seconds: float
    predicted_seconds: float
    error_db: float
    predicted_error_db: float
    azimuth: Response | None = None
    range: Response | None = None
    dark_error_db: float = -math.inf


@dataclass(frozen=True)
class Tradeoff:
    """Measured times and errors of one image by many methods, as returned by `tradeoff`.

    Attributes
    ----------
    device, driver : str
        Device that formed the images, and its driver.
    channels : int
        Number of range lines.
    pixels : (rows, columns)
        Shape of the image.
    repeats : int
        Number of timed runs; `seconds` are their medians.
    rows : tuple of Row
        Images to a tolerance, then those of a study, then those by given stages, and the exact
        image last.
    dark_level_db : float
        Level of the darkest tenth of the exact image relative to the whole image, in dB.

    See Also
    --------
    tradeoff : Function that returns it, with an example.
    """

    device: str
    driver: str
    channels: int
    pixels: tuple[int, ...]
    repeats: int
    rows: tuple[Row, ...]
    dark_level_db: float = 0.0

    def __repr__(self) -> str:
        """Return the sizes, the device, and the spans of times and errors."""
        seconds = [row.seconds for row in self.rows]
        errors_db = [row.error_db for row in self.rows]
        return reprs.summary(
            self,
            f"{len(self.rows)} images of {reprs.by(self.pixels)} pixels from "
            f"{self.channels} channels",
            f"{reprs.quantity(min(seconds), 's')} to {reprs.quantity(max(seconds), 's')}",
            f"errors {reprs.span(min(errors_db), max(errors_db), 'dB')}",
            self.device,
        )

    def _repr_html_(self) -> str:
        return self._report().html()

    @property
    def exact(self) -> Row:
        """Row of the exact image."""
        return self.rows[-1]

    @property
    def front(self) -> tuple[Row, ...]:
        """Rows that no other row beats in both time and error (Pareto front), fastest first."""
        best = math.inf
        front: list[Row] = []
        for row in sorted(self.rows, key=lambda row: (row.seconds, row.error_db)):
            if row.error_db < best:
                best = row.error_db
                front.append(row)
        return tuple(front)

    def describe(self) -> str:
        """Return a table of all rows as text.

        Resolutions are relative to those of the exact image. "In the dark" is the error in the
        darkest tenth of the image, relative to the level there.
        """
        return self._report().text()

    def _report(self) -> Report:
        rows = []
        for row in self.rows:
            cells = [
                row.label,
                f"{row.seconds:.3g}",
                f"{row.predicted_seconds:.3g}",
                f"{self.exact.seconds / row.seconds:.2g}",
                f"{row.error_db:.1f}",
                f"{row.predicted_error_db:.1f}",
                f"{row.dark_error_db:.1f}",
            ]
            for one, exact in ((row.azimuth, self.exact.azimuth), (row.range, self.exact.range)):
                cells.append(
                    f"{one.resolution_m / exact.resolution_m:.3f}" if one and exact else "-"
                )
            cells += [f"{one.pslr_db:.1f}" if one else "-" for one in (row.azimuth, row.range)]
            rows.append(cells)
        return Report([Table(_COLUMNS, rows)])

    def save_csv(self, path: str | os.PathLike) -> None:
        """Write all rows as CSV. An existing file is replaced in one step.

        Raises
        ------
        ValueError
            If the suffix is not .csv.
        OSError
            If the folder does not exist or the file cannot be written.
        """
        validate.suffix("path", validate.path("path", path), ".csv")
        with replacing(path) as temporary, open(temporary, "w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(_HEADER)
            for row in self.rows:
                cells = [row.label, row.method, row.plan, row.plan_seconds, row.seconds]
                cells += [row.predicted_seconds, row.error_db, row.predicted_error_db]
                cells.append(row.dark_error_db)
                for response in (row.azimuth, row.range):
                    cells += [getattr(response, figure, None) for figure in _FIGURES]
                writer.writerow(cells)

    def save_png(self, path: str | os.PathLike, *, title: str = "") -> None:
        """Write a picture of time against error as PNG; see `clsas.plot.tradeoff`.

        Raises
        ------
        ImportError
            If matplotlib is not installed.
        OSError
            If the folder does not exist or the file cannot be written.
        """
        import clsas  # the public face, which imports the room plot only when it is used

        clsas.plot.save_png(clsas.plot.tradeoff(self, title=title), path)
