"""Speed against accuracy: images of one scene at every turn of the dial, timed and compared."""

from __future__ import annotations

import csv
import math
import os
import statistics
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np

from clsas.core import reprs, validate
from clsas.core.atomic import replacing
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.image_error import relative_error_db
from clsas.core.lines import RangeLines
from clsas.core.tables import Report, Table
from clsas.exact.backprojection import ACCURACY_DB, form_exactly
from clsas.factorized.filters import ALIGN_TAPS, APERTURE_TAPS
from clsas.factorized.plan import Plan
from clsas.opencl.device import Device, open_device
from clsas.planning.factorize import factorize
from clsas.planning.planner import plan
from clsas.products.quality import Cut, measure_point
from clsas.products.shadows import DARKEST, dark_level_db
from clsas.sonar.beam import BeamWindow

TOLERANCES_DB = (-20.0, -30.0, -40.0, -50.0, -60.0, -70.0)
STAGES = (*(((2, 2),) * count for count in range(1, 6)), ((2, 4),) * 2)
"""Plans of THESIS chapter 4 that are shown: 1 to 5 stages of 2 x 2, and 2 of QR = 2, QI = 4."""

STUDIED_TAPS = tuple(product(ALIGN_TAPS, APERTURE_TAPS))
STUDIED_DEPTHS = (1, 2, 3, 4)
"""Taps in range and along the aperture, and numbers of stages, of a study."""

REFERENCE_DB = -85.0
"""Accuracy of the exact image that errors are against."""

_HEADER = ("label", "method", "plan", "plan_s", "time_s", "predicted_time_s", "error_db")
_HEADER += ("predicted_error_db", "dark_error_db")
_HEADER += tuple(
    f"{axis}_{figure}"
    for axis in ("azimuth", "range")
    for figure in ("resolution_m", "pslr_db", "islr_db")
)


@dataclass(frozen=True)
class Response:
    """A point's response along an axis; see `clsas.products.quality.Cut`.

    Attributes
    ----------
    resolution_m : float
        Width at -3 dB, metres.
    pslr_db : float
        The higher one of the two side lobes next to the main lobe, dB.
    islr_db : float
        Energy of side lobes over that of the main lobe, dB.
    """

    resolution_m: float
    pslr_db: float
    islr_db: float


@dataclass(frozen=True)
class Row:
    """One way to the image.

    Attributes
    ----------
    label : str
        The tolerance, the stages given ("3 of 2x2"), "exact", or of a study tolerance, taps in
        range and along the aperture, and stages ("-50 dB, 8+6 taps, 3 stages").
    method : str
        "tolerance", "study", "stages" or "exact".
    plan : str
        How it was divided, and with which filters.
    plan_seconds : float
        Time that planning took; 0 for the exact image.
    seconds : float
        Median time of the image, with the plan given.
    predicted_seconds : float
    error_db, predicted_error_db : float
        Relative rms error against the exact image.
    azimuth, range : Response or None
        Of the strongest point of the exact image; None where there is none to be measured.
    dark_error_db : float
        Error in the darkest tenth of the exact image, against the level there: see
        `clsas.products.shadows`.
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
    """Time against error, measured.

    Attributes
    ----------
    device, driver : str
        Whose times these are.
    channels : int
        Range lines.
    pixels : (rows, columns)
        Of the image.
    repeats : int
        Runs of which `seconds` are medians.
    rows : tuple of Row
        By tolerance, of a study, by stages, and the exact image last.
    dark_level_db : float
        Level of the darkest tenth of the exact image, over that of the whole image.
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
        """The exact image."""
        return self.rows[-1]

    @property
    def front(self) -> tuple[Row, ...]:
        """The rows that no other beats in both time and error (Pareto front), fastest first."""
        best, front = float("inf"), []
        for row in sorted(self.rows, key=lambda row: (row.seconds, row.error_db)):
            if row.error_db < best:
                best = row.error_db
                front.append(row)
        return tuple(front)

    def describe(self) -> str:
        """Return a table of all rows; resolutions are shown over those of the exact image.

        "In the dark" is the error in the darkest tenth of the image against the level there.
        """
        return self._report().text()

    def _report(self) -> Report:
        names = ("", "time (s)", "predicted (s)", "speedup", "error (dB)", "predicted (dB)")
        names += ("in the dark (dB)",)
        names += ("azimuth", "range", "azimuth PSLR", "range PSLR")
        table = []
        for row in self.rows:
            cells = (
                row.label,
                f"{row.seconds:.3g}",
                f"{row.predicted_seconds:.3g}",
                f"{self.exact.seconds / row.seconds:.2g}",
                f"{row.error_db:.1f}",
                f"{row.predicted_error_db:.1f}",
                f"{row.dark_error_db:.1f}",
            )
            pairs = ((row.azimuth, self.exact.azimuth), (row.range, self.exact.range))
            cells += tuple(
                f"{one.resolution_m / exact.resolution_m:.3f}" if one and exact else "-"
                for one, exact in pairs
            )
            cells += tuple(f"{one.pslr_db:.1f}" if one else "-" for one, _ in pairs)
            table.append(cells)
        return Report([Table(names, table)])

    def save_csv(self, path: str | os.PathLike) -> None:
        """Write all rows as CSV, replacing a file of that name at once or not at all.

        Raises
        ------
        ValueError
            If the file's name ends in another suffix than .csv.
        OSError
            If the folder does not exist or the file cannot be written.
        """
        validate.suffix("path", validate.path("path", path), ".csv")
        with replacing(path) as temporary, open(temporary, "w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(_HEADER)
            for row in self.rows:
                writer.writerow(
                    [
                        *(row.label, row.method, row.plan, row.plan_seconds, row.seconds),
                        *(row.predicted_seconds, row.error_db, row.predicted_error_db),
                        row.dark_error_db,
                        *_figures(row.azimuth),
                        *_figures(row.range),
                    ]
                )

    def save_png(self, path: str | os.PathLike, *, title: str = "") -> None:
        """Draw time against error; see `clsas.plot.tradeoff`.

        Raises
        ------
        ImportError
            If matplotlib is not installed.
        OSError
            If the folder does not exist or the file cannot be written.
        """
        from clsas.products import plot

        plot.save_png(plot.tradeoff(self, title=title), path)


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
    """Form one image in many ways; measure how long each takes and how much it errs.

    All of them run once before any is timed, and then take turns, so that a machine that slows down
    slows all of them.

    Parameters
    ----------
    lines : RangeLines
        What to image.
    grid : Grid
        Where.
    tolerances_db : sequence of float
        Tolerances as for `clsas.plan`.
    stages : sequence of sequences of (QR, QI), optional
        The thesis's method, as for `clsas.plan`. Unless given, those of `STAGES` that the lines and
        the grid leave room for.
    beam : BeamWindow, optional
        Weights of the channels, of the exact image too.
    device : Device, str or int, optional
        See `clsas.opencl.device.choose`.
    repeats : int
        Timed runs of each.
    study : bool
        Also form the image, for every tolerance, with all of `STUDIED_TAPS` and `STUDIED_DEPTHS`
        that can keep to it: what the planner chooses from. That takes long.
    progress : callable, optional
        Called as progress(images done, images).

    Returns
    -------
    Tradeoff
        The exact image that is timed has an accuracy of -60 dB, or the tightest tolerance; errors
        are against one of -85 dB.

    Raises
    ------
    TypeError, ValueError
        If an argument is not what is allowed, see also `clsas.plan`; before anything is timed.
    DeviceError
        If there is no such device.
    """
    validate.instance("lines", lines, RangeLines)
    validate.instance("grid", grid, Grid)
    validate.count("repeats", repeats)
    validate.progress(progress)
    validate.instance("study", study, bool)
    if beam is not None:
        validate.instance("beam", beam, BeamWindow)
    tolerances_db = np.atleast_1d(tolerances_db)
    if tolerances_db.size:
        tolerances_db = validate.array("tolerances_db", tolerances_db, np.float64, (None,))
    tolerances_db = tolerances_db.tolist()
    if not (stages is None or isinstance(stages, Sequence)):
        raise TypeError(
            f"stages must be a sequence of plans' (QR, QI), got {validate.shown(stages)}"
        )
    device = open_device(device)
    wishes: list[dict] = [{"tolerance_db": tolerance_db} for tolerance_db in tolerances_db]
    if study:
        wishes += [
            {"tolerance_db": tolerance_db, "taps": taps, "depth": depth}
            for tolerance_db, taps, depth in product(tolerances_db, STUDIED_TAPS, STUDIED_DEPTHS)
        ]
    wishes += [
        {"stages": given} for given in (_feasible(lines, grid, beam) if stages is None else stages)
    ]
    ways: list[tuple[Row, Callable[[], Image]]] = []
    for wish in wishes:
        start = time.perf_counter()
        chosen = plan(lines, grid, **wish, beam=beam, device=device)
        if "taps" in wish and chosen.is_exact:
            continue  # these cannot keep to it
        row = _row(*_name(wish), chosen, time.perf_counter() - start)
        ways.append((row, partial(factorize, lines, grid, chosen, device=device)))
    accuracy_db = min([ACCURACY_DB, *tolerances_db])
    exact = partial(form_exactly, lines, grid, device=device, beam=beam)
    row = _row("exact", "exact", plan(lines, grid, stages=[], beam=beam, device=device), 0.0)
    ways.append(
        (replace(row, predicted_error_db=accuracy_db), partial(exact, accuracy_db=accuracy_db))
    )

    images = 1 + len(ways) * (1 + repeats)
    done = 0

    def step() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, images)

    reference = exact(accuracy_db=REFERENCE_DB)
    if not reference.pixels.any():
        raise ValueError("grid must lie where the lines hold anything: the exact image is zero")
    step()
    rows = []
    for row, form in ways:  # the first run builds the kernels, and its image is measured
        rows.append(_measured(row, form(), reference))
        step()
    seconds: list[list[float]] = [[] for _ in ways]
    for _ in range(repeats):
        for (_, form), taken in zip(ways, seconds, strict=True):
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
    """Return those of `STAGES` that leave a line, and a pixel of a plane."""
    one_place = not np.ptp(lines.tx_m + lines.rx_m, axis=0).any()
    if not grid.is_planar or one_place or (beam is not None and beam.normalise):
        return []
    return [
        stages
        for stages in STAGES
        if np.prod([beams for beams, _ in stages]) <= lines.channels
        and np.prod([divisions for _, divisions in stages]) <= min(grid.shape)
    ]


def _name(wish: dict) -> tuple[str, str]:
    """Return label and method: "-50 dB", "3 of 2x2" for equal stages, "2x2,4x2" for others."""
    if "taps" in wish:
        (in_range, along), depth = wish["taps"], wish["depth"]
        taps = f"{in_range}+{along} taps, {depth} stage{'s' * (depth > 1)}"
        return f"{wish['tolerance_db']:g} dB, {taps}", "study"
    if "stages" not in wish:
        return f"{wish['tolerance_db']:g} dB", "tolerance"
    each = [f"{beams}x{divisions}" for beams, divisions in wish["stages"]]
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


def _figures(response: Response | None) -> tuple[float | None, ...]:
    if response is None:
        return (None,) * 3
    return response.resolution_m, response.pslr_db, response.islr_db
