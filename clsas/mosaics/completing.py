"""Levels of a mosaic that mix patches: computed by one process when the patches are finished.

Their record, the group `levels`, contains the checksums of their chunks, and a digest of those of
the pixels from which they were computed. If patches have changed since, the digests differ, and the
levels are computed again. The result depends on the pixels alone, so a run that is killed and
continued leaves the same levels.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.atomic import sync_folder
from clsas.engine.data.digests import digest, is_intact, with_digest
from clsas.mosaics.document import DamageError, check_own, read_attributes, write_attributes
from clsas.mosaics.levels import LAYERS, LEVELS, StoredArray
from clsas.mosaics.patch_files import PatchFiles
from clsas.mosaics.pyramid import Values, coarser, covered, values_of

_PATCHES = "patches"  # attribute with the digest of the patches
_CHUNKS = "chunks_crc32c"  # attribute with the checksums of the chunks, by the name of the array


def is_current(files: PatchFiles) -> bool:
    """Return whether the levels that mix patches are those of the present patches."""
    try:
        stored = _read_record(files.path)
        return stored[_PATCHES] == _digest_of_patches(files) and all(
            files.arrays.checksums(array, _all_chunks(array)) == stored[_CHUNKS].get(array.name)
            for array in files.document.of_mosaic
        )
    except (OSError, ValueError):
        return False


def damage(files: PatchFiles) -> dict[str, str]:
    """Read the levels that mix patches; return the reason for each damaged array, by its name.

    Levels that are missing or belong to other patches are not damaged: they are computed again.
    If their record is damaged, the result names it, since nothing else is known then.

    Raises
    ------
    OSError
        If the record cannot be read.
    """
    if not (files.path / LEVELS / "zarr.json").exists():
        return {}
    try:
        stored = _read_record(files.path)
    except DamageError as error:
        return {LEVELS: str(error)}
    if stored[_PATCHES] != _digest_of_patches(files):
        return {}
    found = {}
    for array in files.document.of_mosaic:
        values, chunks = files.arrays.opened(array.name), _all_chunks(array)
        try:
            same = files.arrays.checksums(array, chunks) == stored[_CHUNKS].get(array.name)
            for window in (_window(array, chunk) for chunk in chunks):
                _ = values[window]
        except ValueError:  # Zarr's message about a checksum
            same = False
        if not same:
            found[array.name] = "its values do not match their checksum"
    return found


def complete(files: PatchFiles, progress: Callable[[int, int], object] | None) -> None:
    """Compute the levels that mix patches, and write their record.

    Parameters
    ----------
    files : PatchFiles
    progress : callable or None
        Called as progress(chunks computed so far, number of chunks).
    """
    folder, document = files.path / LEVELS, files.document
    patches = _digest_of_patches(files)
    check_own(files.path, folder)
    # Remove the old record first, so that it never stands beside new chunks.
    if (folder / "zarr.json").exists():
        (folder / "zarr.json").unlink()
        sync_folder(folder)
    by_factor: dict[int, list[StoredArray]] = {}
    for array in document.of_mosaic:
        by_factor.setdefault(array.factor, []).append(array)
    work = [(factor, chunk) for factor, same in by_factor.items() for chunk in _all_chunks(same[0])]
    for done, (factor, chunk) in enumerate(work, 1):
        window = _window(by_factor[factor][0], chunk)
        level = _level(files, factor, window)
        for array in by_factor[factor]:
            files.arrays.write(array.name, window, values_of(level, array.kind))
        if progress is not None:
            progress(done, len(work))
    chunks = {
        array.name: files.arrays.checksums(array, _all_chunks(array))
        for array in document.of_mosaic
    }
    write_attributes(folder, with_digest({_PATCHES: patches, _CHUNKS: chunks}))


def _level(files: PatchFiles, factor: int, window: tuple[slice, slice]) -> Values:
    """Return a part of a level, computed from the level before or from the pixels."""
    document = files.document
    if factor == 1:
        return {"amplitude": np.abs(files.read("pixels", *window))}
    before = factor // 2
    finer = [
        slice(2 * part.start, min(2 * part.stop, -(-count // before)))
        for part, count in zip(window, document.shape, strict=True)
    ]
    prefix = f"{before}x/" if before > 1 else ""
    kinds = ("pixels", *document.layers) + (("amplitude",) if prefix else ())
    values: dict[str, NDArray[Any]] = {
        kind: files.read(prefix + kind, finer[0], finer[1]) for kind in kinds
    }
    values.setdefault("amplitude", np.abs(values["pixels"]))
    rows, columns = (
        covered(part.start, part.stop - part.start, before, count)
        for part, count in zip(finer, document.shape, strict=True)
    )
    return coarser(values, factor, rows, columns, document.window)


def _digest_of_patches(files: PatchFiles) -> str:
    """Return a digest of the pixels and layers of the finished patches."""
    pixels: dict[str, Any] = {}
    for (row, column), each in files.recorded().items():
        layers = [each[name] for name in LAYERS if name in each]
        pixels[f"{row}.{column}"] = [each["pixels"], *layers] if layers else each["pixels"]
    return digest(pixels)


def _read_record(path: Path) -> dict[str, Any]:
    """Return the record of the levels; raise DamageError or OSError if it cannot be read."""
    stored = read_attributes(path / LEVELS)
    if not (is_intact(stored) and _PATCHES in stored and isinstance(stored.get(_CHUNKS), dict)):
        raise DamageError("its record does not match its digest")
    return stored


def _all_chunks(array: StoredArray) -> list[tuple[int, ...]]:
    sides = zip(array.shape, array.chunk_shape, strict=True)
    return list(itertools.product(*(range(-(-count // side)) for count, side in sides)))


def _window(array: StoredArray, chunk: tuple[int, ...]) -> tuple[slice, slice]:
    rows, columns = (
        slice(i * side, min((i + 1) * side, count))
        for i, side, count in zip(chunk, array.chunk_shape, array.shape, strict=True)
    )
    return rows, columns
