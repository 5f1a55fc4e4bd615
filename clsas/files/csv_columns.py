"""Columns of numbers in CSV files."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clsas.core import reading, validate


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
    reader = csv.reader(io.StringIO(reading.read_text(path), newline=""), skipinitialspace=True)
    try:
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise ValueError(f"{path}: line {reader.line_num} is not CSV: {error}") from None
    names = [name.strip() for name in rows[0][1]] if rows else []
    check_names(names)
    if len(rows) < 2:
        raise ValueError(f"{path} must have {rows_of} below the names of the columns")
    values = np.empty((len(rows) - 1, len(names)))
    for into, (line, row) in zip(values, rows[1:], strict=True):
        try:
            into[:] = [float(value) for _, value in zip(names, row, strict=True)]
        except ValueError:
            got = validate.shown(",".join(row))
            raise ValueError(
                f"{path}: line {line} must be {len(names)} numbers, got {got}"
            ) from None
    return dict(zip(names, values.T, strict=True))
