"""Columns of numbers in CSV files."""

from __future__ import annotations

import csv
import io
import os
from array import array
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reading, validate
from clsas.engine.data.validate import ArgumentError


def read_columns(
    path: str | os.PathLike, check_names: Callable[[list[str]], None], rows_of: str
) -> dict[str, NDArray[np.float64]]:
    """Return the columns of a file by the names in its first line. Blank lines are skipped.

    Parameters
    ----------
    path : path-like
    check_names : callable
        Called with the names; raises ValueError unless they are allowed.
    rows_of : str
        What the rows contain, for messages.

    Raises
    ------
    ValueError
        If the file is not CSV in UTF-8, names are not allowed, there are no rows, or a row does not
        have a number for each name.
    """
    # Rows are converted one by one: kept as text, they would take 50 to 100 bytes per byte.
    text = reading.read_text(path, reading.COLUMNS_BYTES)
    reader = csv.reader(io.StringIO(text, newline=""), skipinitialspace=True)
    rows = (row for row in reader if any(cell.strip() for cell in row))
    values = array("d")
    try:
        names = [name.strip() for name in next(rows, [])]
        check_names(names)
        for row in rows:
            try:
                values.extend([float(value) for _, value in zip(names, row, strict=True)])
            except ValueError:
                got = validate.shown(",".join(row))
                line, where = f"line {reader.line_num}", f"{path}:"
                raise ArgumentError(line, f"be {len(names)} numbers", got, where=where) from None
    except csv.Error as error:
        raise ValueError(f"{path}: line {reader.line_num} is not CSV: {error}") from None
    if not values:
        raise ValueError(f"{path} must have {rows_of} below the names of the columns")
    return dict(zip(names, np.frombuffer(values).reshape(-1, len(names)).T, strict=True))
