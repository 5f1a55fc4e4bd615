"""Heights of the pixels of a grid, from CSV and NumPy files."""

from __future__ import annotations

import io
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reading, validate
from clsas.engine.data.validate import ArgumentError

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
        raise ArgumentError("height_file", f"end in {' or '.join(SUFFIXES)}", repr(str(path)))
    try:
        reading.check_ordinary(path)
        heights = _from_csv(path) if path.suffix.lower() == ".csv" else _from_npy(path)
    except OSError as error:
        hint = f"{error.strerror or error}: {path}"
        raise ArgumentError("height_file", "be readable", hint=hint) from None
    if heights.shape != tuple(shape):
        got = f"{' x '.join(map(str, heights.shape)) or 'one'} in {path}"
        allowed = f"hold {' x '.join(map(str, shape))} heights (rows x columns of the grid)"
        raise ArgumentError("height_file", allowed, got)
    if heights.dtype.kind not in "iuf":
        raise ArgumentError("height_file", "hold real numbers", f"{heights.dtype} in {path}")
    validate.memory(str(path), 8 * heights.size)
    heights = np.array(heights, np.float64)  # a mapped array is read here
    if not np.isfinite(heights).all():
        got = f"NaN or infinity in {path}"
        raise ArgumentError("height_file", "hold finite heights", got)
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
        allowed = "hold numbers separated by commas"
        raise ArgumentError("height_file", allowed, hint=f"{reason}: {path}") from None


def _from_npy(path: Path) -> NDArray:
    """Return an array that is mapped to memory, so that its shape is known before it is read."""
    try:
        return np.lib.format.open_memmap(path, mode="r")
    except (ValueError, EOFError, OverflowError):
        allowed = "be an intact NumPy file of numbers"
        raise ArgumentError("height_file", allowed, hint=str(path)) from None
