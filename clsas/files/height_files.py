"""Heights of the pixels of a grid, from CSV and NumPy files."""

from __future__ import annotations

import io
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reading, validate

SUFFIXES = (".csv", ".npy")
"""Suffixes of files of heights."""


def read_heights(path: str | os.PathLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the heights of a grid's pixels, float64 [rows, columns], metres.

    Parameters
    ----------
    path : path-like
        A CSV file with one line per row of the grid, without a heading, or a NumPy file (.npy) with
        an array of real numbers.
    shape : (rows, columns)
        Shape of the grid, which the heights must have.

    Raises
    ------
    ValueError
        If the file cannot be read, does not hold numbers, has another suffix, or holds an array of
        another shape.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"must end in {' or '.join(SUFFIXES)}, got {str(path)!r}")
    try:
        reading.check_ordinary(path)
        heights = _from_csv(path) if path.suffix.lower() == ".csv" else _from_npy(path)
    except OSError as error:
        raise ValueError(f"must be readable: {error.strerror or error}: {path}") from None
    if heights.shape != tuple(shape):
        raise ValueError(
            f"must hold {' x '.join(map(str, shape))} heights (rows x columns of the grid), got "
            f"{' x '.join(map(str, heights.shape)) or 'one'} in {path}"
        )
    if heights.dtype.kind not in "iuf":
        raise ValueError(f"must hold real numbers, got {heights.dtype} in {path}")
    validate.memory(str(path), 8 * heights.size)
    heights = np.array(heights, np.float64)  # a mapped array is read here
    if not np.isfinite(heights).all():
        raise ValueError(f"must hold finite heights, got NaN or infinity in {path}")
    return heights


def _from_csv(path: Path) -> NDArray:
    try:
        text = reading.read_bytes(path, reading.COLUMNS_BYTES).decode("utf-8-sig")
        if not text.strip():
            raise ValueError("the file is empty")
        return np.loadtxt(io.StringIO(text), np.float64, delimiter=",", ndmin=2)
    except ValueError as error:  # UnicodeDecodeError too
        # What follows the semicolon is advice for callers of NumPy.
        reason = str(error).partition(";")[0]
        raise ValueError(f"must hold numbers separated by commas: {reason}: {path}") from None


def _from_npy(path: Path) -> NDArray:
    """Return an array that is mapped to memory, so that its shape is known before it is read."""
    try:
        return np.lib.format.open_memmap(path, mode="r")
    except (ValueError, EOFError, OverflowError):
        raise ValueError(f"must be an intact NumPy file of numbers: {path}") from None
