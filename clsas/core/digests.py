"""Digests of geometries: equal ones have equal digests, whatever the samples are."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from clsas.core.grid import Grid
from clsas.core.lines import RangeLines


def lines_digest(lines: RangeLines) -> str:
    """Return a digest of everything about lines but their samples."""
    velocity = lines.rx_velocity_m_s
    numbers = [lines.range_step_m, lines.carrier_hz, lines.sound_speed_m_s]
    arrays = [lines.tx_m, lines.rx_m, lines.first_range_m, np.array(numbers)]
    arrays += [] if velocity is None else [velocity]
    return _digest(np.array(lines.samples.shape), *arrays)


def grid_digest(grid: Grid) -> str:
    """Return a digest of the positions of a grid's pixels."""
    parts = (grid.origin_m, grid.row_step_m, grid.column_step_m, grid.height_m, grid.points_m)
    return _digest(np.array(grid.shape), *(part for part in parts if part is not None))


def _digest(*arrays: NDArray) -> str:
    sha = hashlib.sha256()
    for array in arrays:
        sha.update(np.ascontiguousarray(array).tobytes())
    return sha.hexdigest()[:16]
