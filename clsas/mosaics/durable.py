"""Zarr arrays whose writes are complete and on the disk when they return.

Zarr's own store also renames finished chunks, but it does not wait for the disk, and killed
processes leave temporary files.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.abc.store import Store
from zarr.codecs import Crc32cCodec
from zarr.core.buffer import Buffer
from zarr.storage import LocalStore

from clsas.core.atomic import creating, make_folders, replacing
from clsas.core.grid import Grid
from clsas.core.reading import check_ordinary
from clsas.mosaics.documents import FORMAT, VERSION, with_checksum, write_attributes


class DurableStore(LocalStore):
    """Zarr store in a folder, written with `clsas.core.atomic`."""

    async def set(self, key: str, value: Buffer) -> None:
        """Write a chunk or document."""
        await asyncio.to_thread(self.set_sync, key, value)

    def set_sync(self, key: str, value: Buffer) -> None:
        """Write a chunk or document. Some versions of Zarr call this method directly."""
        self._check_writable()
        path = Path(self.root) / key
        make_folders(path.parent)
        with replacing(path) as temporary:
            temporary.write_bytes(value.as_buffer_like())

    async def get(self, key: str, *options: Any, **named: Any) -> Buffer | None:
        """Read a chunk or document; raise ValueError if it is a pipe or a device."""
        self._check_ordinary(key)
        return await super().get(key, *options, **named)

    def get_sync(self, key: str, *options: Any, **named: Any) -> Buffer | None:
        """Read a chunk or document. Some versions of Zarr call this method directly."""
        self._check_ordinary(key)
        return super().get_sync(key, *options, **named)

    def _check_ordinary(self, key: str) -> None:
        with suppress(OSError):  # no file: a chunk of zeros
            check_ordinary(Path(self.root) / key)

    # Zarr's base class implements this with `set`.
    set_if_not_exists = Store.set_if_not_exists


def create_store(
    path: Path, inputs: dict[str, Any], grid: Grid, patch_shape: tuple[int, int]
) -> None:
    """Create the store of a mosaic in one step, so that a killed process leaves no part of it.

    Raises
    ------
    OSError
        If the folder around it does not exist or cannot be written.
    """
    if not path.parent.is_dir():
        raise FileNotFoundError(2, "there is no such folder", str(path.parent))
    plane = None
    if grid.points_m is None:
        steps = ("origin_m", "row_step_m", "column_step_m")
        plane = {name: getattr(grid, name).tolist() for name in steps}
    attributes = {
        "format": FORMAT,
        "version": VERSION,
        "patch_shape": list(patch_shape),
        "grid": plane,
        "inputs": inputs,
    }
    with creating(path) as temporary:
        _create_arrays(temporary, grid, patch_shape)
        write_attributes(temporary / "patches", {})
        write_attributes(temporary, with_checksum(attributes))


def _create_arrays(path: Path, grid: Grid, patch_shape: tuple[int, int]) -> None:
    """Create the arrays of a mosaic: pixels, all zero, and coordinates."""
    files = DurableStore(path)
    # No compression, since noise does not compress; only a checksum behind every chunk.
    checksum = Crc32cCodec()
    names = ("y", "x") if grid.has_axes else ("row", "column")
    zarr.create_array(
        files,
        name="pixels",
        shape=grid.shape,
        dtype=np.complex64,
        chunks=patch_shape,
        compressors=checksum,
        fill_value=0,
        dimension_names=names,
    )
    coordinates: dict[str, tuple[tuple[str, ...], NDArray[np.float64]]] = {}
    if grid.has_axes:
        coordinates |= {name: ((name,), axis) for name, axis in zip("xy", grid.axes_m, strict=True)}
    if grid.height_m is not None:
        coordinates["height"] = names, grid.height_m
    for name, (dimensions, values) in coordinates.items():
        zarr.create_array(
            files,
            name=name,
            data=values,
            compressors=checksum,
            dimension_names=dimensions,
            attributes={"units": "m"},
        )


def open_array(path: Path, name: str) -> zarr.Array:
    """Open an array of a mosaic for reading."""
    return zarr.open_array(DurableStore(path, read_only=True), path=name, mode="r")


def write_pixels(path: Path, rows: slice, columns: slice, pixels: NDArray[np.complex64]) -> None:
    """Write the pixels of whole patches. Zarr writes no chunk for pixels that are all zero."""
    zarr.open_array(DurableStore(path), path="pixels", mode="r+")[rows, columns] = pixels
