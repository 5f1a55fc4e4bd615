"""Zarr arrays whose writes are complete and on the disk when they return.

Zarr's own store also renames finished chunks, but it does not wait for the disk, and killed
processes leave temporary files.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from pathlib import Path
from typing import Any

from zarr.abc.store import Store
from zarr.core.buffer import Buffer, BufferPrototype, default_buffer_prototype
from zarr.storage import LocalStore

from clsas.engine.data.atomic import make_folders, replacing
from clsas.engine.data.reading import check_ordinary
from clsas.mosaics.documents import check_own
from clsas.mosaics.metadata import Checked


class DurableStore(LocalStore):
    """Zarr store in a folder, written with `clsas.engine.data.atomic`.

    Attributes
    ----------
    known : dict of str to bytes
        Contents of documents that Zarr receives from here instead of reading them from the folder,
        which may have changed since they were checked.
    chunk_bytes : int or None
        Size of every chunk's file; None while arrays are created.
    """

    def __init__(self, path: Path, *, read_only: bool = False) -> None:
        super().__init__(path, read_only=read_only)
        self.known: dict[str, bytes] = {}
        self.chunk_bytes: int | None = None

    @classmethod
    def of_array(cls, path: Path, name: str, metadata: Checked, read_only: bool) -> DurableStore:
        """Return the store of an array whose metadata have been checked."""
        made = cls(path, read_only=read_only)
        made.known = {f"{name}/zarr.json": metadata.text}
        made.chunk_bytes = metadata.chunk_bytes
        return made

    async def set(self, key: str, value: Buffer) -> None:
        """Write a chunk or document."""
        await asyncio.to_thread(self.set_sync, key, value)

    def set_sync(self, key: str, value: Buffer) -> None:
        """Write a chunk or document. Some versions of Zarr call this method instead of `set`."""
        self._check_writable()
        path = Path(self.root) / key
        check_own(Path(self.root), path.parent)
        make_folders(path.parent)
        with replacing(path) as temporary:
            temporary.write_bytes(value.as_buffer_like())

    async def get(
        self, key: str, prototype: BufferPrototype | None = None, *options: Any, **named: Any
    ) -> Buffer | None:
        """Read a chunk or document; raise ValueError if it is not an ordinary file of its size."""
        if key in self.known:
            return _buffer(prototype, self.known[key])
        self._check(key)
        return await super().get(key, prototype, *options, **named)

    def get_sync(
        self, key: str, *options: Any, prototype: BufferPrototype | None = None, **named: Any
    ) -> Buffer | None:
        """Read a chunk or document. Some versions of Zarr call this method instead of `get`."""
        if key in self.known:
            return _buffer(prototype, self.known[key])
        self._check(key)
        return super().get_sync(key, *options, prototype=prototype, **named)

    def _check(self, key: str) -> None:
        path = Path(self.root) / key
        with suppress(OSError):  # a missing file is a chunk of zeros
            check_ordinary(path)
            size = path.stat().st_size
            if self.chunk_bytes is not None and size != self.chunk_bytes:
                raise ValueError(f"{path} must have {self.chunk_bytes} bytes, got {size}")

    # LocalStore writes the file itself; the method of the base class calls `set`.
    set_if_not_exists = Store.set_if_not_exists


def _buffer(prototype: BufferPrototype | None, content: bytes) -> Buffer:
    return (prototype or default_buffer_prototype()).buffer.from_bytes(content)
