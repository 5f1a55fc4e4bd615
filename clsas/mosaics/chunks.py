"""Checksums behind the chunks of a store, which Zarr writes and verifies."""

from __future__ import annotations

from pathlib import Path

from clsas.engine.data.reading import check_ordinary
from clsas.mosaics.levels import PixelArray
from clsas.mosaics.metadata import CHECKSUM_BYTES, ITEM_BYTES
from clsas.mosaics.record import PatchIndex


def any_missing(path: Path, array: PixelArray, chunks: list[PatchIndex]) -> bool:
    """Return whether any of the chunks of an array does not exist."""
    return not all(_file(path, array, chunk).exists() for chunk in chunks)


def chunk_checksums(
    path: Path, array: PixelArray, chunks: list[PatchIndex]
) -> str | list[str | None] | None:
    """Return the checksums behind chunks of an array; without a list if there is only one.

    That of a chunk that does not exist, because it has only the fill value, is None.

    Raises
    ------
    ValueError
        If a chunk is not an ordinary file.
    """
    size = ITEM_BYTES[array.data_type] * array.chunk_shape[0] * array.chunk_shape[1]
    found: list[str | None] = []
    for chunk in chunks:
        file_path = _file(path, array, chunk)
        try:
            check_ordinary(file_path)
            with file_path.open("rb") as file:
                file.seek(size)
                found.append(file.read(2 * CHECKSUM_BYTES).hex())  # half as many if intact
        except FileNotFoundError:
            found.append(None)
    return found[0] if len(found) == 1 else found


def _file(path: Path, array: PixelArray, chunk: PatchIndex) -> Path:
    return path.joinpath(*array.name.split("/"), "c", *map(str, chunk))
