"""Digests of geometries. Equal geometries have equal digests, whatever the samples are."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from clsas.core.grid import Grid
from clsas.core.lines import RangeLines


def lines_digest(lines: RangeLines) -> str:
    """Return a digest of everything in range lines from which images of any samples follow."""
    numbers = np.array([lines.range_step_m, lines.carrier_hz, lines.sound_speed_m_s])
    others = lines.per_channel
    for name in ("look_direction", "bank_numbers"):  # do not change images
        others.pop(name, None)
    # Changing this order would invalidate the digests in stores and plans.
    arrays = [others.pop(name) for name in ("tx_m", "rx_m", "first_range_m")]
    others_given = list(others.values())
    if (profile := lines.sound_speed) is not None:
        surface = np.array([profile.surface_z_m])
        others_given += [profile.depth_m, profile.speed_m_s, surface]
    return _digest(np.array(lines.samples.shape), *arrays, numbers, *others_given)


def grid_digest(grid: Grid) -> str:
    """Return a digest of the positions of a grid's pixels."""
    parts = (grid.origin_m, grid.row_step_m, grid.column_step_m, grid.height_m, grid.points_m)
    return _digest(np.array(grid.shape), *(part for part in parts if part is not None))


def _digest(*arrays: NDArray) -> str:
    sha = hashlib.sha256()
    for array in arrays:
        sha.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return sha.hexdigest()[:16]
