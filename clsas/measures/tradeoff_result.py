"""Results of `clsas.tradeoff`: rows of time against error, as a table, CSV and a picture."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass

from clsas.core import reprs, validate
from clsas.core.atomic import replacing
from clsas.core.tables import Report, Table

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
    """A point's response along an axis; see `clsas.measures.cuts.Cut`.

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
    """An image formed by one method: its time and its errors.

    Attributes
    ----------
    label : str
        The tolerance, the stages given ("3 of 2x2"), or "exact". In a study: tolerance, taps in
        range and along the aperture, and stages ("-50 dB, 8+6 taps, 3 stages").
    method : str
        "tolerance", "study", "stages" or "exact".
    plan : str
        Subimages of every stage, and filters.
    plan_seconds : float
        Time of planning; 0 for the exact image.
    seconds : float
        Median time of the image, without planning.
    predicted_seconds : float
    error_db, predicted_error_db : float
        Relative rms error against the exact image.
    azimuth, range : Response or None
        Response of the exact image's strongest point; None if it cannot be measured.
    dark_error_db : float
        Error in the darkest tenth of the exact image, relative to the level there; see
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
    """Time against error, measured.

    Attributes
    ----------
    device, driver : str
        Device that formed the images.
    channels : int
        Number of range lines.
    pixels : (rows, columns)
        Shape of the image.
    repeats : int
        Number of timed runs; `seconds` are their medians.
    rows : tuple of Row
        Images by tolerance, of a study, by stages, and the exact image last.
    dark_level_db : float
        Level of the darkest tenth of the exact image relative to the whole image.
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
        best = math.inf
        front: list[Row] = []
        for row in sorted(self.rows, key=lambda row: (row.seconds, row.error_db)):
            if row.error_db < best:
                best = row.error_db
                front.append(row)
        return tuple(front)

    def describe(self) -> str:
        """Return a table of all rows; resolutions are shown over those of the exact image.

        "In the dark" is the error in the darkest tenth of the image, relative to the level there.
        """
        return self._report().text()

    def _report(self) -> Report:
        return Report([Table(_COLUMNS, [[*_cells(row, self.exact)] for row in self.rows])])

    def save_csv(self, path: str | os.PathLike) -> None:
        """Write all rows as CSV. An existing file is replaced in one step.

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
        import clsas  # the public face, which imports the room of pictures when it is used

        clsas.plot.save_png(clsas.plot.tradeoff(self, title=title), path)


def _cells(row: Row, exact: Row) -> Iterator[str]:
    """Yield the cells of one row of the table; times and resolutions relative to `exact` too."""
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
    """Return the cells of one response in a CSV file."""
    return [getattr(response, figure, None) for figure in _FIGURES]
