"""Levels of a mosaic: the image at 2, 4, 8, ... times the pixel spacing, for pictures and maps.

Every level is a Zarr group, `2x`, `4x` and so on, with the arrays `pixels`, the mean of the complex
pixels, and `amplitude`, the root of their mean power. The attributes of the store list these groups
by the convention *multiscales* 0.1 of zarr-conventions, in the layout that GDAL itself writes. This
convention was chosen because GDAL reads it as overviews, from version 3.13 on, and because it needs
no axes of microscopy, as OME-Zarr does, and no tile matrix set, as drafts of GeoZarr did. For
xarray and Zarr the levels are ordinary groups.

If the factor of a level divides the sides of a patch, every pixel of the level belongs to one
patch. Such a level is *of patches*: it is written with each patch, and no two patches share a
chunk, so that any number of processes can write at once. The other levels are *of the mosaic*: one
process computes them when all patches are finished (`clsas.mosaics.store_files`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

CHUNK_SIDE = 1024
"""Largest side of a chunk, pixels: 8 MiB of complex pixels, which viewers load at once."""

COARSEST_SIDE = 1024
"""Largest side of the coarsest level and of overviews, pixels, which fills a screen."""

IN_DB = "amplitude_db"
"""Name of the array with the coarsest level in dB, which programs can plot as it is."""

LAYERS = {
    "height_m": ("m", "height above the plane of the grid"),
    "sd_m": ("m", "standard deviation of the height"),
    "coherence": ("", "coherence of the receiver banks"),
    "looks": ("", "effective number of independent samples"),
    "m_per_rad": ("m", "change of the height per radian of phase between the banks"),
}
"""Arrays of a mosaic of heights beside the pixels, with units and meaning, and all of its levels.

They have the names and the meaning of the attributes of `clsas.Heights`.
"""

SHADOWED = {
    "shadow_height_m": ("m", "height of a pixel in shadow, which is not valid"),
    "shadow_sd_m": ("m", "standard deviation of the height of a pixel in shadow"),
}
"""Arrays of a mosaic of heights without levels: what pixels in shadow show.

Whether a pixel is in shadow depends on patches that may be measured later, or again.
"""

LEVELS = "levels"
"""Name of the group that records the levels of the mosaic."""

_CONVENTION = {
    "uuid": "d35379db-88df-4056-af3a-620245f8e347",
    "schema_url": "https://raw.githubusercontent.com/zarr-conventions/multiscales/refs/tags/v0.1/"
    "schema.json",
    "spec_url": "https://github.com/zarr-conventions/multiscales/blob/v0.1/README.md",
    "name": "multiscales",
    "description": "Multiscale layout of zarr datasets",
}
_SMALLEST_CHUNK = 64  # pixels; a patch without a larger divisor is one chunk


@dataclass(frozen=True)
class Levels:
    """Factors of the levels of a store, each twice the one before.

    A mosaic that fits on a screen has the single factor 1, which stands for the array in dB.

    Attributes
    ----------
    of_patches : tuple of int
        Factors of the levels that are written with each patch.
    of_mosaic : tuple of int
        Factors of the levels that are computed when all patches are finished.
    """

    of_patches: tuple[int, ...]
    of_mosaic: tuple[int, ...] = ()

    @property
    def factors(self) -> tuple[int, ...]:
        """All factors, without the 1 of a mosaic that has only an array in dB."""
        return tuple(factor for factor in self.of_patches + self.of_mosaic if factor > 1)

    @property
    def coarsest(self) -> int:
        """Factor of the coarsest level."""
        return max(self.of_patches + self.of_mosaic)


@dataclass(frozen=True)
class StoredArray:
    """An array of a store: pixels, what belongs to them, or coordinates.

    Attributes
    ----------
    name : str
        Path in the store, such as "4x/amplitude".
    data_type : str
        "complex64", "float32" or "float64".
    shape, chunk_shape : tuple of int
    dimensions : tuple of str
        Names of the dimensions.
    attributes : dict
        Attributes for other programs.
    factor : int
        Pixels of the mosaic along each side of a pixel of this array.
    patch_shape : (rows, columns)
        Size of a patch, in pixels of the mosaic; empty for coordinates.
    """

    name: str
    data_type: str
    shape: tuple[int, ...]
    chunk_shape: tuple[int, ...]
    dimensions: tuple[str, ...]
    attributes: dict[str, Any]
    factor: int = 1
    patch_shape: tuple[int, ...] = ()

    @property
    def kind(self) -> str:
        """Kind of numbers: "pixels", "amplitude", `IN_DB`, or one of `LAYERS` or `SHADOWED`."""
        return self.name.rpartition("/")[2]

    @property
    def has_gaps(self) -> bool:
        """True if NaN stands for pixels without a value, False if all numbers are finite."""
        return self.kind in (IN_DB, *LAYERS, *SHADOWED)

    @property
    def fill_value(self) -> float:
        """Value where nothing has been written."""
        return math.nan if self.has_gaps else 0.0

    @property
    def chunk_bytes(self) -> int:
        """Size of the values of a chunk."""
        return math.prod(self.chunk_shape) * np.dtype(self.data_type).itemsize

    def window(self, index: tuple[int, int]) -> tuple[slice, slice]:
        """Return the pixels of this array that belong to a patch."""
        rows, columns = (
            slice(i * side // self.factor, min(-(-(i + 1) * side // self.factor), most))
            for i, side, most in zip(index, self.patch_shape, self.shape, strict=True)
        )
        return rows, columns

    def chunks(self, index: tuple[int, int]) -> list[tuple[int, int]]:
        """Return the indices of the chunks that belong to a patch, row by row."""
        window = zip(self.window(index), self.chunk_shape, strict=True)
        rows, columns = (range(part.start // side, -(-part.stop // side)) for part, side in window)
        return list(itertools.product(rows, columns))

    def touched(self, rows: slice, columns: slice) -> Iterator[tuple[int, int]]:
        """Yield the indices of the patches to which the pixels of a window belong."""
        touched: list[range] = []
        for part, count, side in zip((rows, columns), self.shape, self.patch_shape, strict=True):
            pixels = range(count)[part]
            if not pixels:
                return
            ends = sorted((pixels[0], pixels[-1]))
            first, last = (end * self.factor // side for end in ends)
            touched.append(range(first, last + 1))
        yield from itertools.product(*touched)


def factors_of(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the factors of the levels of a mosaic, down to one that fills a screen."""
    found, factor = [], 1
    while math.ceil(max(shape) / factor) > COARSEST_SIDE:
        factor *= 2
        found.append(factor)
    return tuple(found) or (1,)


def levels_of(shape: tuple[int, ...], patch_shape: tuple[int, int]) -> Levels:
    """Return the levels of a new store."""
    factors = factors_of(shape)
    aligned = tuple(
        factor
        for factor in factors
        if all(
            side % factor == 0 or side >= count
            for side, count in zip(patch_shape, shape, strict=True)
        )
    )
    return Levels(aligned, factors[len(aligned) :])


def aligned_side(side: int, count: int, pixels: int, coarsest: int) -> int:
    """Return the side of a patch, rounded up so that as many levels as possible are of patches.

    Parameters
    ----------
    side : int
        Smallest side of a patch, pixels.
    count : int
        Number of patches along this side, which the result keeps.
    pixels : int
        Pixels of the mosaic along this side.
    coarsest : int
        Factor of the coarsest level of the mosaic.
    """
    factor = coarsest
    while factor > 1:
        rounded = math.ceil(side / factor) * factor
        if math.ceil(pixels / rounded) == count:
            return rounded
        factor //= 2
    return side


def chunk_side(side: int, pixels: int) -> int:
    """Return the side of a chunk, which divides the side of a patch unless there is only one."""
    fewest = math.ceil(side / CHUNK_SIDE)
    if side >= pixels:
        return math.ceil(pixels / math.ceil(pixels / CHUNK_SIDE))
    for count in range(fewest, side // _SMALLEST_CHUNK + 1):
        if side % count == 0:
            return side // count
    return side


def level_shape(shape: tuple[int, ...], factor: int) -> tuple[int, int]:
    """Return the shape of a level. Its last pixels may cover fewer pixels of the mosaic."""
    rows, columns = (math.ceil(count / factor) for count in shape)
    return rows, columns


def axis_of(axis_m: NDArray[np.float64], factor: int) -> NDArray[np.float64]:
    """Return the coordinates of a level's pixels along an axis, which are as regular as the axis.

    The last pixel of a level may cover fewer pixels of the mosaic than the others. Its coordinate
    is the middle of all that it would cover.
    """
    if factor == 1:
        return axis_m
    count = math.ceil(len(axis_m) / factor)
    if count == 1:
        return np.asarray([axis_m.mean()])
    step_m = (axis_m[-1] - axis_m[0]) / (len(axis_m) - 1)
    return axis_m[0] + step_m * ((factor - 1) / 2 + factor * np.arange(count))


def multiscales(levels: Levels) -> dict[str, Any]:
    """Return the attributes by which other programs find the levels, empty if there are none."""
    if not levels.factors:
        return {}
    layout: list[dict[str, Any]] = [{"asset": "pixels", "transform": {"scale": [1.0, 1.0]}}]
    for factor in levels.factors:
        layout.append(
            {
                "asset": f"{factor}x",
                "derived_from": layout[-1]["asset"],
                # From the index of a pixel to that of its middle in the level before.
                "transform": {"scale": [2.0, 2.0], "translation": [0.5, 0.5]},
                "resampling_method": "average",
            }
        )
    return {"zarr_conventions": [_CONVENTION], "multiscales": {"layout": layout}}
