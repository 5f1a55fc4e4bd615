"""Levels of a mosaic that mix patches: computed by one process when the patches are finished.

Their record, the group `levels`, contains the checksums of their chunks, and a digest of those of
the pixels from which they were computed. If patches have changed since, the digests differ, and the
levels are computed again. The result depends on the pixels alone, so a run that is killed and
continued leaves the same levels.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.atomic import sync_folder
from clsas.engine.data.digests import digest, is_intact, with_digest
from clsas.mosaics.arrays import open_array, write_values
from clsas.mosaics.chunks import chunk_checksums
from clsas.mosaics.documents import (
    DamageError,
    check_own,
    read_attributes,
    write_attributes,
)
from clsas.mosaics.levels import (
    LAYERS,
    LEVELS,
    WINDOW,
    PixelArray,
    layers_of,
    mosaic_arrays,
    patch_arrays,
)
from clsas.mosaics.pyramid import Level, coarser, coarser_layers, covered
from clsas.mosaics.record import Checksums, PatchIndex

_KEPT = 4  # patches that are kept while levels are computed: those around a corner
_PATCHES = "patches"  # attribute with the digest of the patches
_CHUNKS = "chunks_crc32c"  # attribute with the checksums of the chunks, by the name of the array


def digest_of_patches(checksums: dict[PatchIndex, Checksums]) -> str:
    """Return a digest of the pixels and layers of the finished patches."""
    pixels: dict[str, Any] = {}
    for (row, column), each in checksums.items():
        layers = [each[name] for name in LAYERS if name in each]
        pixels[f"{row}.{column}"] = [each["pixels"], *layers] if layers else each["pixels"]
    return digest(pixels)


def is_current(path: Path, attributes: dict[str, Any], patches: str) -> bool:
    """Return whether the levels of a mosaic are those of its patches.

    Parameters
    ----------
    path : Path
        The store.
    attributes : dict
        Attributes of the store.
    patches : str
        Digest of the finished patches.
    """
    try:
        stored = _read_record(path)
        return stored[_PATCHES] == patches and all(
            chunk_checksums(path, array, _all_chunks(array)) == stored[_CHUNKS].get(array.name)
            for array in mosaic_arrays(attributes)
        )
    except (OSError, ValueError):
        return False


def damage(path: Path, attributes: dict[str, Any], patches: str) -> dict[str, str]:
    """Read the levels of a mosaic; return the reason for each damaged array, by its name.

    Levels that are missing or belong to other patches are not damaged: they are computed again.
    If their record is damaged, the result names it, since nothing else is known then.

    Raises
    ------
    OSError
        If the record cannot be read.
    """
    try:
        stored = _read_record(path)
    except DamageError as error:
        return {LEVELS: str(error)}
    if stored[_PATCHES] != patches:
        return {}
    found = {}
    for array in mosaic_arrays(attributes):
        try:
            values = open_array(path, attributes, array.name)
        except DamageError:  # of the metadata, which are compared elsewhere
            continue
        try:
            checksums = chunk_checksums(path, array, _all_chunks(array))
            same = checksums == stored[_CHUNKS].get(array.name)
            for window in (_window(array, chunk) for chunk in _all_chunks(array)):
                _ = values[window]
        except ValueError:  # Zarr's message about a checksum
            same = False
        if not same:
            found[array.name] = "its values do not match their checksum"
    return found


def _read_record(path: Path) -> dict[str, Any]:
    """Return the record of the levels; raise DamageError or OSError if it cannot be read."""
    stored = read_attributes(path / LEVELS)
    if not (is_intact(stored) and _PATCHES in stored and isinstance(stored.get(_CHUNKS), dict)):
        raise DamageError("its record does not match its digest")
    return stored


def complete(
    path: Path,
    attributes: dict[str, Any],
    patches: str,
    read: Callable[[str, slice, slice], NDArray],
    progress: Callable[[int, int], object] | None,
) -> None:
    """Compute the levels of a mosaic that mix patches, and write their record.

    Parameters
    ----------
    path : Path
        The store.
    attributes : dict
        Attributes of the store.
    patches : str
        Digest of the finished patches.
    read : callable
        Called as read(name, rows, columns) with slices; returns pixels or a layer of the mosaic.
    progress : callable or None
        Called as progress(chunks computed so far, number of chunks).
    """
    folder = path / LEVELS
    check_own(path, folder)
    # Remove the old record first, so that it never stands beside new chunks.
    if (folder / "zarr.json").exists():
        (folder / "zarr.json").unlink()
        sync_folder(folder)
    arrays = mosaic_arrays(attributes)
    by_factor = {
        factor: [array for array in arrays if array.factor == factor]
        for factor in sorted({array.factor for array in arrays})
    }
    work = [(factor, chunk) for factor, same in by_factor.items() for chunk in _in_order(same[0])]
    read_pixels = _by_patches(partial(read, "pixels"), patch_arrays(attributes)[0])
    for done, (factor, chunk) in enumerate(work, 1):
        same = by_factor[factor]
        window = _window(same[0], chunk)
        level = _level(path, attributes, factor, window, read_pixels)
        level = level._replace(layers=_layers(path, attributes, factor, window, read))
        for array in same:
            write_values(path, attributes, array.name, window, level.values_of(array))
        if progress is not None:
            progress(done, len(work))
    chunks = {array.name: chunk_checksums(path, array, _all_chunks(array)) for array in arrays}
    write_attributes(folder, with_digest({_PATCHES: patches, _CHUNKS: chunks}))


def _level(
    path: Path,
    attributes: dict[str, Any],
    factor: int,
    window: tuple[slice, slice],
    read: Callable[[slice, slice], NDArray[np.complex64]],
) -> Level:
    """Return a part of a level, computed from the level before or from the pixels."""
    if factor == 1:
        pixels = read(*window)
        return Level(np.abs(pixels), pixels)
    shape = attributes["inputs"]["pixels"]
    before = factor // 2
    finer = _finer(window, before, shape)
    weights = [
        covered(part.start, part.stop - part.start, before, count)
        for part, count in zip(finer, shape, strict=True)
    ]
    rows, columns = finer
    if before == 1:
        pixels = read(rows, columns)
        level = Level(np.abs(pixels), pixels)
    else:
        amplitude, pixels = (
            np.asarray(open_array(path, attributes, f"{before}x/{kind}")[rows, columns])
            for kind in ("amplitude", "pixels")
        )
        level = Level(amplitude, pixels)
    return coarser(level, weights[0], weights[1])


def _layers(
    path: Path,
    attributes: dict[str, Any],
    factor: int,
    window: tuple[slice, slice],
    read: Callable[[str, slice, slice], NDArray],
) -> dict[str, NDArray[np.float32]]:
    """Return a part of the layers of a level, computed from the level before or from the layers."""
    if factor == 1:
        return {}
    before = factor // 2
    found: dict[str, NDArray[np.float32]] = {}
    rows, columns = _finer(window, before, attributes["inputs"]["pixels"])
    for name in layers_of(attributes):
        if before == 1:
            values = read(name, rows, columns)
        else:
            values = np.asarray(open_array(path, attributes, f"{before}x/{name}")[rows, columns])
        found |= coarser_layers({name: values}, factor, attributes[WINDOW])
    return found


def _finer(window: tuple[slice, slice], before: int, shape: tuple[int, int]) -> tuple[slice, slice]:
    """Return the pixels of the level before, of factor `before`, that a window is made of."""
    rows, columns = (
        slice(2 * part.start, min(2 * part.stop, -(-count // before)))
        for part, count in zip(window, shape, strict=True)
    )
    return rows, columns


def _by_patches(
    read: Callable[[slice, slice], NDArray[np.complex64]], array: PixelArray
) -> Callable[[slice, slice], NDArray[np.complex64]]:
    """Return a function that reads whole patches, which may be one chunk, and keeps the latest."""

    @lru_cache(maxsize=_KEPT)
    def patch(index: PatchIndex) -> NDArray[np.complex64]:
        return read(*array.window(index))

    def window(rows: slice, columns: slice) -> NDArray[np.complex64]:
        pixels = np.empty((rows.stop - rows.start, columns.stop - columns.start), np.complex64)
        for index in array.touched(rows, columns):
            common = [
                (slice(max(a.start, b.start), min(a.stop, b.stop)), a.start, b.start)
                for a, b in zip((rows, columns), array.window(index), strict=True)
            ]
            to = tuple(slice(part.start - own, part.stop - own) for part, own, _ in common)
            of = tuple(slice(part.start - its, part.stop - its) for part, _, its in common)
            pixels[to] = patch(index)[of]
        return pixels

    return window


def _in_order(array: PixelArray) -> list[tuple[int, int]]:
    """Return all chunks of a level, those that begin in the same patch one after another."""

    def patch(chunk: tuple[int, int]) -> tuple[int, ...]:
        sides = zip(chunk, array.chunk_shape, array.patch_shape, strict=True)
        return tuple(i * side * array.factor // of_patch for i, side, of_patch in sides)

    return sorted(_all_chunks(array), key=lambda chunk: (patch(chunk), chunk))


def _all_chunks(array: PixelArray) -> list[tuple[int, int]]:
    rows, columns = (
        range(-(-count // side)) for count, side in zip(array.shape, array.chunk_shape, strict=True)
    )
    return list(itertools.product(rows, columns))


def _window(array: PixelArray, chunk: tuple[int, int]) -> tuple[slice, slice]:
    rows, columns = (
        slice(i * side, min((i + 1) * side, count))
        for i, side, count in zip(chunk, array.chunk_shape, array.shape, strict=True)
    )
    return rows, columns
