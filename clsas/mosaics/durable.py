"""Zarr arrays on disk whose writes are whole and on the disk once they return.

Zarr's own store renames chunks into place too, but does not wait for the disk, and leaves the
temporary files of killed processes.
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

from clsas.core.atomic import make_folders, replacing
from clsas.core.grid import Grid
from clsas.core.reading import check_ordinary


class DurableStore(LocalStore):
    """A folder as Zarr's store; chunks and documents are written as `clsas.core.atomic` does."""

    async def set(self, key: str, value: Buffer) -> None:
        """Write a chunk or document."""
        await asyncio.to_thread(self.set_sync, key, value)

    def set_sync(self, key: str, value: Buffer) -> None:
        """Write a chunk or document; some versions of Zarr call this one."""
        self._check_writable()
        path = Path(self.root) / key
        make_folders(path.parent)
        with replacing(path) as temporary:
            temporary.write_bytes(value.as_buffer_like())

    async def get(self, key: str, *options: Any, **named: Any) -> Buffer | None:
        """Read a chunk or document; a pipe or a device in its place is refused."""
        self._check_ordinary(key)
        return await super().get(key, *options, **named)

    def get_sync(self, key: str, *options: Any, **named: Any) -> Buffer | None:
        """Read a chunk or document; some versions of Zarr call this one."""
        self._check_ordinary(key)
        return super().get_sync(key, *options, **named)

    def _check_ordinary(self, key: str) -> None:
        with suppress(OSError):  # nothing there: a chunk of zeros
            check_ordinary(Path(self.root) / key)

    # Zarr's own, by way of `set`.
    set_if_not_exists = Store.set_if_not_exists


def create_arrays(path: Path, grid: Grid, patch_shape: tuple[int, int]) -> None:
    """Create the arrays of a mosaic: its pixels, all zero, and its coordinates."""
    files = DurableStore(path)
    # Noise does not compress; a checksum is appended to every chunk.
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
    coordinates = {}
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
    """Write pixels of whole patches; pixels that are all zero have no chunk."""
    zarr.open_array(DurableStore(path), path="pixels", mode="r+")[rows, columns] = pixels
