"""Arrays of a store in Zarr: created, opened, written durably, compared and repaired.

Zarr decodes an array as its metadata specify, and some decoders run code contained in the array.
Since a store may come from a stranger, Zarr never reads metadata from it: what it receives follows
from the store's document. The metadata in the folder are for other programs.
"""

from __future__ import annotations

import asyncio
import json
import math
import shutil
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.abc.store import Store as ZarrStore
from zarr.codecs import Crc32cCodec
from zarr.core.buffer import Buffer, BufferPrototype, default_buffer_prototype
from zarr.storage import LocalStore, MemoryStore

from clsas.engine.data import validate
from clsas.engine.data.atomic import creating, make_folders, replacing
from clsas.engine.data.digests import digest, grid_digest
from clsas.engine.data.grid import Grid
from clsas.engine.data.reading import check_ordinary, parse_json, read_bytes
from clsas.mosaics.document import (
    DamageError,
    Document,
    check_own,
    read_attributes,
    write_attributes,
)
from clsas.mosaics.levels import StoredArray, axis_of

_CHECKSUM_BYTES = 4
_COPIES = 3  # copies of coordinates or heights in memory: Zarr's, the grid's, one for the digest
_WRONG = "its values do not match their checksum"


@dataclass(frozen=True, eq=False)
class StoredArrays:
    """Arrays of a store, each opened once.

    Attributes
    ----------
    path : Path
        Folder of the store.
    document : Document
    """

    path: Path
    document: Document
    _opened: dict[tuple[str, bool], zarr.Array] = field(default_factory=dict, repr=False)

    @classmethod
    def create(cls, path: Path, document: Document, grid: Grid) -> None:
        """Create a store in one step, so that a killed process leaves no partial store.

        Pixels and levels have no chunks yet, which means that they are 0 or NaN.

        Raises
        ------
        OSError
            If the parent folder cannot be written.
        """
        texts = {name: _metadata(array) for name, array in document.arrays.items()}
        digests = {name: digest(json.loads(text)) for name, text in texts.items()}
        document = replace(document, metadata=digests)
        with creating(path) as temporary:
            arrays = cls(temporary, document)
            for name in document.groups:
                write_attributes(temporary / name, {})
            for name in document.arrays:
                arrays._write(name, grid)
            document.write(temporary)

    def opened(self, name: str, *, writable: bool = False) -> zarr.Array:
        """Return an array; Zarr verifies checksums on reading.

        Raises
        ------
        ValueError
            If a chunk does not fit into memory.
        """
        if (name, writable) not in self._opened:
            array = self.document.arrays[name]
            validate.memory(f"a chunk of {name} in {self.path}", 2 * array.chunk_bytes)
            files = _Files(self.path, array, read_only=not writable)
            mode = "r+" if writable else "r"
            self._opened[name, writable] = zarr.open_array(
                files, path=name, mode=mode, zarr_format=3
            )
        return self._opened[name, writable]

    def write(self, name: str, window: tuple[slice, slice], values: NDArray) -> None:
        """Write whole chunks of an array. Zarr writes no chunk that has only the fill value."""
        self.opened(name, writable=True)[window] = values

    def checksums(
        self, array: StoredArray, chunks: Sequence[tuple[int, ...]]
    ) -> str | list[str | None] | None:
        """Return the checksums behind chunks of an array; without a list if there is only one.

        That of a chunk that does not exist, because it has only the fill value, is None.

        Raises
        ------
        ValueError
            If a chunk is not an ordinary file.
        """
        found: list[str | None] = []
        for chunk in chunks:
            path = self._chunk(array, chunk)
            try:
                check_ordinary(path)
                with path.open("rb") as file:
                    file.seek(array.chunk_bytes)
                    found.append(file.read(2 * _CHECKSUM_BYTES).hex())  # half as many if intact
            except FileNotFoundError:
                found.append(None)
        return found[0] if len(found) == 1 else found

    def is_missing(self, array: StoredArray, chunks: Sequence[tuple[int, ...]]) -> bool:
        """Return whether any of the chunks of an array does not exist."""
        return not all(self._chunk(array, chunk).exists() for chunk in chunks)

    def grid(self) -> Grid | None:
        """Return the grid with its heights; None for arbitrary points.

        Raises
        ------
        DamageError
            If the heights differ from those that were written.
        """
        plane = self.document.plane
        if plane is None or not self.document.has_height:
            return plane
        try:
            grid = plane.with_height(self._values("height"))
        except DamageError:
            raise
        except ValueError as error:
            raise DamageError(f"its values are not heights: {error}") from error
        if grid_digest(grid) != self.document.inputs.get("grid"):
            raise DamageError("its values differ from those that were written")
        return grid

    def damage(self) -> dict[str, str]:
        """Compare metadata, coordinates and heights with what was written.

        Returns
        -------
        dict of str to str
            Reason for each damaged array or group, by its name.
        """
        return dict(self._damage())

    def repair(self, grid: Grid) -> dict[str, str]:
        """Rewrite damaged metadata, coordinates and heights; return what was damaged.

        A run that is killed meanwhile leaves damage, which the next one finds.
        """
        found = self.damage()
        digests = dict(self.document.metadata)
        for name in found:
            if name in self.document.arrays:
                digests[name] = digest(json.loads(self._write(name, grid)))
            else:
                self._make_folder(self.path / name)
                write_attributes(self.path / name, {})
        if digests != self.document.metadata:
            replace(self.document, metadata=digests).write(self.path)
        return found

    def _damage(self) -> Iterator[tuple[str, str]]:
        for name in self.document.groups:
            try:
                if read_attributes(self.path / name):
                    yield name, "it has attributes that were not written"
            except PermissionError:
                raise
            except (OSError, DamageError):
                yield name, "its metadata cannot be read"
        for name, array in self.document.arrays.items():
            try:
                self._check_metadata(name)
                if name == "height":
                    self.grid()
                elif not array.patch_shape:
                    self._check_axis(array)
            except DamageError as error:
                yield name, str(error)

    def _check_metadata(self, name: str) -> None:
        try:
            found = digest(parse_json(read_bytes(self.path / name / "zarr.json")))
        except FileNotFoundError as error:
            raise DamageError("its metadata are missing") from error
        except PermissionError:
            raise
        except (OSError, ValueError) as error:
            raise DamageError(f"its metadata cannot be read: {error}") from error
        if found != self.document.metadata.get(name):
            raise DamageError("its metadata do not match their digest")

    def _check_axis(self, array: StoredArray) -> None:
        assert self.document.plane is not None  # it has axes
        if not np.array_equal(self._values(array.name), _axis_m(array, self.document.plane)):
            raise DamageError("its values differ from those of the grid")

    def _values(self, name: str) -> NDArray[np.float64]:
        """Return the values of coordinates or heights; raise DamageError if they are damaged."""
        array = self.opened(name)
        validate.memory(f"{name} in {self.path}", _COPIES * 8 * math.prod(array.shape))
        try:
            return np.asarray(array[...])
        except ValueError as error:  # Zarr's message about a checksum
            raise DamageError(_WRONG) from error

    def _write(self, name: str, grid: Grid) -> bytes:
        """Write the metadata of an array, and its values if it has coordinates or heights."""
        array, folder = self.document.arrays[name], self.path / name
        text = _metadata(array)
        self._make_folder(folder)
        with replacing(folder / "zarr.json") as temporary:
            temporary.write_bytes(text)
        if not array.patch_shape:
            if (folder / "c").exists():
                shutil.rmtree(folder / "c")
            values_m: Any = grid.height_m if name == "height" else _axis_m(array, grid)
            self.opened(name, writable=True)[...] = values_m
        return text

    def _make_folder(self, folder: Path) -> None:
        """Make a folder of the store, also where damage has left something else."""
        check_own(self.path, folder)
        if folder.exists() and not folder.is_dir():
            folder.unlink()
        make_folders(folder)
        if (folder / "zarr.json").is_dir():
            shutil.rmtree(folder / "zarr.json")

    def _chunk(self, array: StoredArray, chunk: tuple[int, ...]) -> Path:
        return self.path.joinpath(*array.name.split("/"), "c", *map(str, chunk))


class _Files(LocalStore):
    """Zarr store of one array, whose writes are complete and on the disk when they return.

    Zarr's own store also renames finished chunks, but it does not wait for the disk, and killed
    processes leave temporary files.
    """

    def __init__(self, path: Path, array: StoredArray, *, read_only: bool) -> None:
        super().__init__(path, read_only=read_only)
        self._known = {f"{array.name}/zarr.json": _metadata(array)}
        self._size = array.chunk_bytes + _CHECKSUM_BYTES

    async def set(self, key: str, value: Buffer) -> None:
        """Write a chunk."""
        await asyncio.to_thread(self.set_sync, key, value)

    def set_sync(self, key: str, value: Buffer) -> None:
        """Write a chunk. Some versions of Zarr call this method instead of `set`."""
        self._check_writable()
        path = Path(self.root) / key
        check_own(Path(self.root), path.parent)
        make_folders(path.parent)
        with replacing(path) as temporary:
            temporary.write_bytes(value.as_buffer_like())

    async def get(
        self, key: str, prototype: BufferPrototype | None = None, *options: Any, **named: Any
    ) -> Buffer | None:
        """Read a chunk; raise ValueError if it is not an ordinary file of its size."""
        if key in self._known:
            return _buffer(prototype, self._known[key])
        self._check(key)
        return await super().get(key, prototype, *options, **named)

    def get_sync(
        self, key: str, *options: Any, prototype: BufferPrototype | None = None, **named: Any
    ) -> Buffer | None:
        """Read a chunk. Some versions of Zarr call this method instead of `get`."""
        if key in self._known:
            return _buffer(prototype, self._known[key])
        self._check(key)
        return super().get_sync(key, *options, prototype=prototype, **named)

    def _check(self, key: str) -> None:
        path = Path(self.root) / key
        with suppress(OSError):  # a missing file is a chunk of the fill value
            check_ordinary(path)
            if (size := path.stat().st_size) != self._size:
                raise ValueError(f"{path} must have {self._size} bytes, got {size}")

    # LocalStore writes the file itself; the method of the base class calls `set`.
    set_if_not_exists = ZarrStore.set_if_not_exists


def _buffer(prototype: BufferPrototype | None, content: bytes) -> Buffer:
    return (prototype or default_buffer_prototype()).buffer.from_bytes(content)


def _metadata(array: StoredArray) -> bytes:
    """Return the metadata that Zarr writes for an array. Its only codec is a checksum.

    Noise does not compress.
    """
    files: dict[str, Buffer] = {}
    zarr.create_array(
        MemoryStore(files),
        name=array.name,
        shape=array.shape,
        dtype=array.data_type,
        chunks=array.chunk_shape,
        compressors=Crc32cCodec(),
        fill_value=array.fill_value,
        dimension_names=array.dimensions,
        attributes=array.attributes,
    )
    return files[f"{array.name}/zarr.json"].to_bytes()


def _axis_m(array: StoredArray, plane: Grid) -> NDArray[np.float64]:
    """Return the coordinates of an axis."""
    return axis_of(plane.axes_m["xy".index(array.name[-1])], array.factor)
