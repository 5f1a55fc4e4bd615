"""Results of `clsas.tradeoff`: time against error, as a table, CSV and a picture."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass

from clsas.engine.data import reprs, validate
from clsas.engine.data.atomic import replacing
from clsas.engine.data.reprs import Report, Table

_FIGURES = ("resolution_m", "pslr_db", "islr_db")
_HEADER = (
    "label",
    "method",
    "plan",
    "plan_s",
    "time_s",
    "predicted_time_s",
    "error_db",
    "predicted_error_db",
    "dark_error_db",
    *(f"{axis}_{figure}" for axis in ("azimuth", "range") for figure in _FIGURES),
)
_COLUMNS = (
    "",
    "time (s)",
    "predicted (s)",
    "speedup",
    "error (dB)",
    "predicted (dB)",
    "in the dark (dB)",
    "azimuth",
    "range",
    "azimuth PSLR",
    "range PSLR",
)


@dataclass(frozen=True)
class Response:
    """Response of a point along one axis; see `clsas.measures.cuts.Cut`.

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
        `clsas.measures.shadows`.
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
        return Report([Table(_COLUMNS, [[*_cells(row, self.exact)] for row in self.rows])])

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


def _cells(row: Row, exact: Row) -> Iterator[str]:
    """Yield the cells of a row of the table; some are relative to the exact image."""
    yield row.label
    yield f"{row.seconds:.3g}"
    yield f"{row.predicted_seconds:.3g}"
    yield f"{exact.seconds / row.seconds:.2g}"
    yield f"{row.error_db:.1f}"
    yield f"{row.predicted_error_db:.1f}"
    yield f"{row.dark_error_db:.1f}"
    for one, other in ((row.azimuth, exact.azimuth), (row.range, exact.range)):
        yield f"{one.resolution_m / other.resolution_m:.3f}" if one and other else "-"
    for one in (row.azimuth, row.range):
        yield f"{one.pslr_db:.1f}" if one else "-"


def _figures(response: Response | None) -> list[float | None]:
    """Return the cells of a response in a CSV file."""
    return [getattr(response, figure, None) for figure in _FIGURES]
