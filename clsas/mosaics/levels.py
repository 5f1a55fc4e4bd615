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
process computes them when all patches are finished (`clsas.mosaics.completing`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

CHUNK_SIDE = 1024
"""Largest side of a chunk, pixels: 8 MiB of complex pixels, which viewers load at once."""

COARSEST_SIDE = 1024
"""Largest side of the coarsest level, pixels, which fills a screen."""

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

WINDOW = "window"
"""Attribute of mosaics of heights: rows and columns of the window behind each height."""

LEVELS = "levels"
"""Attribute that lists the levels, and name of the group that records those of the mosaic."""

CHUNK_SHAPE = "chunk_shape"
"""Attribute with the shape of a chunk of the pixels."""

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

    def json(self) -> dict[str, list[int]]:
        """Return the attribute to store."""
        return {"of_patches": list(self.of_patches), "of_mosaic": list(self.of_mosaic)}


@dataclass(frozen=True)
class PixelArray:
    """An array of a store with one value for every pixel of the mosaic or of a level.

    Attributes
    ----------
    name : str
        Path in the store, such as "4x/amplitude".
    factor : int
        Pixels of the mosaic along each side of a pixel of this array.
    data_type : str
        "complex64" or "float32".
    shape, chunk_shape : (rows, columns)
    patch_shape : (rows, columns)
        Size of a patch, in pixels of the mosaic.
    has_gaps : bool
        True if NaN stands for pixels without a value, False if all numbers are finite.
    """

    name: str
    factor: int
    data_type: str
    shape: tuple[int, int]
    chunk_shape: tuple[int, int]
    patch_shape: tuple[int, int]
    has_gaps: bool = False

    @property
    def fill_value(self) -> complex | float:
        """Value where nothing has been written."""
        return math.nan if self.has_gaps else 0

    @property
    def kind(self) -> str:
        """Kind of numbers: "pixels", "amplitude", `IN_DB`, or one of `LAYERS` or `SHADOWED`."""
        return self.name.rpartition("/")[2]

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


def stored_levels(attributes: Mapping[str, Any]) -> Levels:
    """Return the levels in the attributes of a store."""
    stored = attributes[LEVELS]
    return Levels(tuple(stored["of_patches"]), tuple(stored["of_mosaic"]))


def layers_of(attributes: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the layers in the attributes of a store: `LAYERS` for a mosaic of heights."""
    return tuple(LAYERS) if WINDOW in attributes else ()


def shadowed_of(attributes: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the layers without levels in the attributes of a store, `SHADOWED` or none."""
    return tuple(SHADOWED) if WINDOW in attributes else ()


def are_levels(attributes: Mapping[str, Any]) -> bool:
    """Return whether chunks and levels in the attributes of a store are as clsas writes them.

    `patch_shape` and the number of pixels must have been checked.
    """
    shape, patch_shape = attributes["inputs"]["pixels"], attributes["patch_shape"]
    return (
        attributes.get(CHUNK_SHAPE) == list(map(chunk_side, patch_shape, shape))
        and attributes.get(LEVELS) == levels_of(shape, patch_shape).json()
    )


def patch_arrays(attributes: Mapping[str, Any]) -> list[PixelArray]:
    """Return the arrays that are written with each patch: the pixels, and the levels of patches."""
    chunk_shape = tuple(attributes[CHUNK_SHAPE])
    shape, patch_shape = tuple(attributes["inputs"]["pixels"]), tuple(attributes["patch_shape"])
    pixels = PixelArray("pixels", 1, "complex64", shape, chunk_shape, patch_shape)
    layers = [
        replace(pixels, name=name, data_type="float32", has_gaps=True)
        for name in (*layers_of(attributes), *shadowed_of(attributes))
    ]
    levels = stored_levels(attributes)
    return [pixels, *layers, *_level_arrays(attributes, levels, levels.of_patches)]


def mosaic_arrays(attributes: Mapping[str, Any]) -> list[PixelArray]:
    """Return the arrays of the levels that are computed when all patches are finished."""
    levels = stored_levels(attributes)
    return _level_arrays(attributes, levels, levels.of_mosaic)


def _level_arrays(
    attributes: Mapping[str, Any], levels: Levels, factors: tuple[int, ...]
) -> list[PixelArray]:
    shape, patch_shape = tuple(attributes["inputs"]["pixels"]), tuple(attributes["patch_shape"])
    found = []
    for factor in factors:
        reduced = level_shape(shape, factor)
        if factor in levels.of_patches:
            of_patch = level_shape(patch_shape, factor)
            chunks = tuple(map(chunk_side, of_patch, reduced))
        else:
            chunks = tuple(chunk_side(count, count) for count in reduced)
        kinds = {f"{factor}x/pixels": "complex64", f"{factor}x/amplitude": "float32"}
        kinds |= {f"{factor}x/{name}": "float32" for name in layers_of(attributes)}
        names = kinds if factor > 1 else {}
        if factor == levels.coarsest:
            names = names | {IN_DB: "float32"}
        found += [
            PixelArray(
                name,
                factor,
                data_type,
                reduced,
                (chunks[0], chunks[1]),
                patch_shape,
                has_gaps=name.rpartition("/")[2] in (IN_DB, *LAYERS),
            )
            for name, data_type in names.items()
        ]
    return found


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
