"""Random scatterers on a height field, which produce the speckle of a seabed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from clsas.engine.data.validate import ArgumentError
from clsas.simulation.height_field import HeightField

_TILE_M = 2.0  # side of the tiles that are kept or left out as a whole, depending on the beam


class Scatterers(NamedTuple):
    """Scatterers sorted by tile, and the spheres that contain the tiles."""

    positions_m: NDArray[np.float64]  # [3, points]
    normals: NDArray[np.float32]  # [3, points], of the surface
    amplitudes: NDArray[np.complex64]  # [points]
    first: NDArray[np.intp]  # [tiles + 1]: where each tile begins
    centres_m: NDArray[np.float64]  # [tiles, 3]
    radii_m: NDArray[np.float64]  # [tiles]


def draw_scatterers(
    surface: HeightField, texture: NDArray[np.float64], density_m2: float, seed: int
) -> Scatterers:
    """Return random scatterers on a surface, with circular complex Gaussian amplitudes.

    Parameters
    ----------
    surface : HeightField
    texture : float64 [rows, columns]
        Backscattered amplitude of 1 m2.
    density_m2 : float
        Mean number of scatterers per m2 of surface.
    seed : int

    Raises
    ------
    ValueError
        If no scatterer lies on the surface.
    """
    random = np.random.default_rng(seed)
    counts = random.poisson(density_m2 * surface.cell_areas_m2)
    dx, dy = surface.steps_m
    rows, columns = np.indices(counts.shape)
    tiles = rows // max(1, round(_TILE_M / dy)), columns // max(1, round(_TILE_M / dx))
    tile = (tiles[0] * (tiles[1].max() + 1) + tiles[1]).ravel()
    order = np.argsort(tile, kind="stable")
    cells = np.repeat(order, counts.ravel()[order])
    if not cells.size:
        allowed = "put at least one scatterer on the seabed"
        raise ArgumentError("density_m2", allowed, f"{density_m2:g} per m2")
    row, column = np.divmod(cells, counts.shape[1])
    u, v = random.random((2, len(cells)))
    h = surface.heights_m
    corners = [h[row, column], h[row, column + 1], h[row + 1, column], h[row + 1, column + 1]]
    z = (1 - v) * ((1 - u) * corners[0] + u * corners[1])
    z += v * ((1 - u) * corners[2] + u * corners[3])
    slopes = (
        ((1 - v) * (corners[1] - corners[0]) + v * (corners[3] - corners[2])) / dx,
        ((1 - u) * (corners[2] - corners[0]) + u * (corners[3] - corners[1])) / dy,
    )
    positions = np.stack([surface.x_m[0] + dx * (column + u), surface.y_m[0] + dy * (row + v), z])
    normals = np.stack([-slopes[0], -slopes[1], np.ones_like(z)]).astype(np.float32)
    normals /= np.sqrt(np.einsum("ip,ip->p", normals, normals))
    deviation = map_coordinates(texture, [row + v, column + u], order=1, mode="nearest")
    deviation /= np.sqrt(2 * density_m2)
    amplitudes = random.standard_normal((len(cells), 2), dtype=np.float32).view(np.complex64)
    amplitudes = amplitudes[:, 0] * deviation.astype(np.float32)

    first = np.flatnonzero(np.diff(tile[cells], prepend=-1))
    centres = (
        np.maximum.reduceat(positions, first, axis=1)
        + np.minimum.reduceat(positions, first, axis=1)
    ) / 2
    ends = np.append(first, len(cells))
    from_centre = positions - np.repeat(centres, np.diff(ends), axis=1)
    radii = np.sqrt(np.maximum.reduceat(np.sum(from_centre**2, axis=0), first))
    return Scatterers(positions, normals, amplitudes, ends, centres.T, radii)
