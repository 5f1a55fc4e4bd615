"""Files of a store: arrays in Zarr and the records of patches, written durably and verified.

A patch is written in this order: its former record is removed, then its pixels and levels are
written, then its new record, which contains their checksums. Each is on the disk before the next.
So a run that is killed at any time leaves whole patches, and patches that are not finished. Any
number of processes can write patches at once, since no two patches share a file.

Levels that mix patches are computed by one process when the patches are finished. Their record, the
group `levels`, contains the checksums of their chunks, and a digest of those of the pixels from
which they were computed. If patches have changed since, the digests differ, and the levels are
computed again. The result depends on the pixels alone, so a run that is killed and continued leaves
the same levels.

Zarr decodes an array as its metadata specify, and some decoders run code contained in the array.
Since a store may come from a stranger, Zarr never reads metadata from it: what it receives follows
from the store's document. The metadata in the folder are for other programs.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import math
import os
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
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
from clsas.engine.data.atomic import creating, make_folders, replacing, sync_folder
from clsas.engine.data.digests import digest, grid_digest, is_intact, with_digest
from clsas.engine.data.grid import Grid
from clsas.engine.data.reading import check_ordinary, parse_json, read_bytes
from clsas.engine.data.validate import ArgumentError
from clsas.mosaics.document import (
    GROUP,
    REPAIR,
    Checksums,
    DamageError,
    Document,
    PatchIndex,
    Record,
    check_own,
    describe_damage,
    read_attributes,
    stamp_of,
    write_attributes,
)
from clsas.mosaics.levels import IN_DB, LAYERS, LEVELS, StoredArray, axis_of
from clsas.mosaics.pyramid import Values, coarser, covered, pyramid, values_of

_PATCHES = "patches"  # attribute of the levels' record with the digest of the patches
_CHUNKS = "chunks_crc32c"  # its attribute with the checksums of chunks, by the name of the array
_CHECKSUM_BYTES = 4
_COPIES = 3  # copies of coordinates or heights in memory: Zarr's, the grid's, one for the digest
_WRONG = "its values do not match their checksum"

_Stamp = tuple[int, int, int]  # of the file of a record, see `stamp_of`


@dataclass(frozen=True, eq=False)
class StoreFiles:
    """Files of a store. Each array is opened once.

    Attributes
    ----------
    path : Path
        Folder of the store.
    document : Document
    """

    path: Path
    document: Document
    _opened: dict[tuple[str, bool], zarr.Array] = field(default_factory=dict, repr=False)
    _checksums: dict[PatchIndex, tuple[tuple[int, int, int], Checksums]] = field(
        default_factory=dict, repr=False
    )

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
            files = cls(temporary, document)
            for name in document.groups:
                write_attributes(temporary / name, {})
            for name in document.arrays:
                files._write_array(name, grid)
            document.write(temporary)

    def write(
        self,
        index: PatchIndex,
        place: tuple[slice, slice],
        pixels: NDArray[np.complex64],
        record: Record,
        layers: Mapping[str, NDArray[np.float32]],
    ) -> None:
        """Write a patch with its levels and then its record, and wait until they are on the disk.

        Raises
        ------
        TypeError, ValueError
            If there is no such patch, `place` is not its place, or the values are not those of the
            store.
        OSError
            If the disk is full or the store is not writable.
        """
        document = self.document
        row, column = (
            validate.count(name, each, least=0, most=most - 1)
            for name, each, most in zip(("row", "column"), index, document.patches, strict=True)
        )
        own = document.of_patches[0].window((row, column))
        for name, given, part, count in zip(
            ("rows", "columns"), place, own, document.shape, strict=True
        ):
            if range(count)[validate.selection(name, given, ascending=True)] != range(count)[part]:
                allowed = f"be {part.start}:{part.stop} for patch {row},{column}"
                raise ArgumentError(name, allowed, validate.shown(given))
        shape = tuple(part.stop - part.start for part in own)
        pixels = validate.array("pixels", pixels, np.complex64, shape)
        validate.instance("record", record, Record)
        validate.instance("layers", layers, Mapping)
        if set(layers) != {*document.layers, *document.shadowed}:
            expected = ", ".join((*document.layers, *document.shadowed)) or "left out"
            allowed = f"be {expected} for {self.path}"
            raise ArgumentError("layers", allowed, ", ".join(layers) or "none")
        finest: dict[str, NDArray[Any]] = {"pixels": pixels, "amplitude": np.abs(pixels)}
        shadowed: dict[str, NDArray[Any]] = {}
        for name, values in layers.items():
            validate.instance(name, values, np.ndarray)
            if values.dtype.kind != "f" or values.shape != shape or np.isinf(values).any():
                allowed = f"have real numbers of shape {shape}, finite or NaN"
                raise ArgumentError("layers", allowed, f"{validate.shown(values)} for {name}")
            into = finest if name in document.layers else shadowed
            into[name] = values.astype(np.float32)

        folder = self._folder((row, column))
        self._remove_record(folder)
        levels = pyramid(finest, document.levels.of_patches, document.window)
        levels[1] = finest | shadowed
        for array in document.of_patches:
            values = values_of(levels[array.factor], array.kind)
            self._write_chunks(array.name, array.window((row, column)), values)
        checksums = {
            array.name: self._checksums_of(array, array.chunks((row, column)))
            for array in document.of_patches
        }
        write_attributes(folder, record.attributes(checksums))

    def indices(self) -> list[PatchIndex]:
        """Return the patches that have a folder for their record, in order."""
        rows, columns = self.document.patches
        folders = self.path / GROUP
        found = []
        for name in os.listdir(folders) if folders.is_dir() else ():
            if part := re.fullmatch(r"(\d+)\.(\d+)", name):
                index = int(part[1]), int(part[2])
                if index[0] < rows and index[1] < columns:
                    found.append(index)
        return sorted(found)

    def record(
        self, index: PatchIndex, arrays: Sequence[StoredArray] | None = None
    ) -> Record | None:
        """Return the record of a patch, or None if the patch is not finished.

        Parameters
        ----------
        index : (row, column)
        arrays : sequence of StoredArray, optional
            Arrays whose checksums are compared, by default all that are written with patches.

        Raises
        ------
        DamageError
            If the record is damaged, or a checksum behind the values is not that of the record.
        """
        found = Record.read(self._folder(index))
        if found is None:
            return None
        record, expected = found
        for array in self.document.of_patches if arrays is None else arrays:
            chunks = array.chunks(index)
            try:
                same = self._checksums_of(array, chunks) == expected.get(array.name, "")
            except ValueError as error:
                raise DamageError(str(error)) from error
            if not same:
                are_there = all(self._chunk(array, chunk).exists() for chunk in chunks)
                how = "not those of its record" if are_there else "gone"
                raise DamageError(f"its {_words(array)} are {how}")
        return record

    def damage(
        self,
        indices: Sequence[PatchIndex],
        arrays: Sequence[StoredArray] | None = None,
        progress: Callable[[int, int], object] | None = None,
    ) -> dict[PatchIndex, str]:
        """Read what arrays have of patches; return the reasons for damaged patches."""
        found = {}
        for done, index in enumerate(indices, 1):
            try:
                if self.record(index, arrays) is not None:
                    for array in self.document.of_patches if arrays is None else arrays:
                        try:
                            _ = self.opened(array.name)[array.window(index)]
                        except ValueError as error:  # Zarr's message about a checksum
                            words = f"its {_words(array)} do not match their checksum"
                            raise DamageError(words) from error
            except DamageError as error:
                found[index] = str(error)
            if progress is not None:
                progress(done, len(indices))
        return found

    def read(self, name: str, rows: slice, columns: slice) -> NDArray:
        """Return a window of an array of pixels.

        Raises
        ------
        ValueError
            If a finished patch in the window is damaged, or a number is not finite; the message
            names it.
        OSError
            If a file cannot be read.
        """
        validate.selection("rows", rows, ascending=True)
        validate.selection("columns", columns, ascending=True)
        array, stored = self.document.arrays[name], self.opened(name)
        requested = (
            len(range(n)[part]) for n, part in zip(array.shape, (rows, columns), strict=True)
        )
        validate.memory("the mosaic", stored.dtype.itemsize * math.prod(requested))
        patches = list(array.touched(rows, columns)) if array in self.document.of_patches else []
        try:
            for index in patches:
                self.record(index, [array])
            values = np.asarray(stored[rows, columns])
        except ValueError as error:
            found = self.damage(patches, [array])
            reason = describe_damage(found) if found else f"{name}: {error}"
            raise ValueError(f"{self.path} is damaged: {reason}{REPAIR}") from error
        if not (np.isfinite(values) | (array.has_gaps & np.isnan(values))).all():
            raise ValueError(
                f"{self.path} must have finite numbers, but its {name} contain NaN or infinity, "
                "which clsas does not write"
            )
        return values

    def levels_are_current(self) -> bool:
        """Return whether the levels that mix patches are those of the present patches."""
        try:
            stored = self._read_levels_record()
            return stored[_PATCHES] == self._digest_of_patches() and all(
                self._checksums_of(array, _all_chunks(array)) == stored[_CHUNKS].get(array.name)
                for array in self.document.of_mosaic
            )
        except (OSError, ValueError):
            return False

    def complete_levels(self, progress: Callable[[int, int], object] | None) -> None:
        """Compute the levels that mix patches, and write their record.

        Parameters
        ----------
        progress : callable or None
            Called as progress(chunks computed so far, number of chunks).
        """
        of_mosaic, patches = self.document.of_mosaic, self._digest_of_patches()
        self._remove_record(self.path / LEVELS)
        by_factor: dict[int, list[StoredArray]] = {}
        for array in of_mosaic:
            by_factor.setdefault(array.factor, []).append(array)
        work = [(same, chunk) for same in by_factor.values() for chunk in _all_chunks(same[0])]
        for done, (same, chunk) in enumerate(work, 1):
            window = _window(same[0], chunk)
            level = self._level(same[0].factor, window)
            for array in same:
                self._write_chunks(array.name, window, values_of(level, array.kind))
            if progress is not None:
                progress(done, len(work))
        chunks = {array.name: self._checksums_of(array, _all_chunks(array)) for array in of_mosaic}
        attributes = with_digest({_PATCHES: patches, _CHUNKS: chunks})
        write_attributes(self.path / LEVELS, attributes)

    def _level(self, factor: int, window: tuple[slice, slice]) -> Values:
        """Return a part of a level, computed from the level before or from the pixels."""
        if factor == 1:
            return {"amplitude": np.abs(self.read("pixels", *window))}
        document, before = self.document, factor // 2
        finer = [
            slice(2 * part.start, min(2 * part.stop, -(-count // before)))
            for part, count in zip(window, document.shape, strict=True)
        ]
        prefix = f"{before}x/" if before > 1 else ""
        kinds = ("pixels", *document.layers) + (("amplitude",) if prefix else ())
        values: dict[str, NDArray[Any]] = {
            kind: self.read(prefix + kind, finer[0], finer[1]) for kind in kinds
        }
        values.setdefault("amplitude", np.abs(values["pixels"]))
        rows, columns = (
            covered(part.start, part.stop - part.start, before, count)
            for part, count in zip(finer, document.shape, strict=True)
        )
        return coarser(values, factor, rows, columns, document.window)

    def level_damage(self) -> dict[str, str]:
        """Read the levels that mix patches; return the reason for each damaged array, by its name.

        Levels that are missing or belong to other patches are not damaged: they are computed again.
        If their record is damaged, the result names it, since nothing else is known then.

        Raises
        ------
        OSError
            If the record cannot be read.
        """
        if not (self.path / LEVELS / "zarr.json").exists():
            return {}
        try:
            stored = self._read_levels_record()
        except DamageError as error:
            return {LEVELS: str(error)}
        if stored[_PATCHES] != self._digest_of_patches():
            return {}
        found = {}
        for array in self.document.of_mosaic:
            values, chunks = self.opened(array.name), _all_chunks(array)
            try:
                whole = self._checksums_of(array, chunks) == stored[_CHUNKS].get(array.name)
                for chunk in chunks:
                    _ = values[_window(array, chunk)]
            except ValueError:  # Zarr's message about a checksum
                whole = False
            if not whole:
                found[array.name] = _WRONG
        return found

    def _read_levels_record(self) -> dict[str, Any]:
        """Return the record of the levels; raise DamageError or OSError if it cannot be read."""
        stored = read_attributes(self.path / LEVELS)
        if not (is_intact(stored) and _PATCHES in stored and isinstance(stored.get(_CHUNKS), dict)):
            raise DamageError("its record does not match its digest")
        return stored

    def _digest_of_patches(self) -> str:
        """Return a digest of the pixels and layers of the patches with intact records.

        Records are read again only if their files have been replaced, by this or another process.
        """
        found: dict[str, Any] = {}
        for index in self.indices():
            with suppress(DamageError, FileNotFoundError):
                folder = self._folder(index)
                stamp = stamp_of(folder / "zarr.json")
                if self._checksums.get(index, (None, {}))[0] != stamp:
                    stored = Record.read(folder)
                    if stored is None:
                        continue
                    self._checksums[index] = stamp, stored[1]
                each = self._checksums[index][1]
                layers = [each[name] for name in LAYERS if name in each]
                found[folder.name] = [each["pixels"], *layers] if layers else each["pixels"]
        return digest(found)

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
            grid = plane.with_height(self._coordinates("height"))
        except DamageError:
            raise
        except ValueError as error:
            raise DamageError(f"its values are not heights: {error}") from error
        if grid_digest(grid) != self.document.inputs.get("grid"):
            raise DamageError("its values differ from those that were written")
        return grid

    def array_damage(self) -> dict[str, str]:
        """Compare metadata, coordinates and heights with what was written.

        Returns
        -------
        dict of str to str
            Reason for each damaged array or group, by its name.
        """
        found = {}
        for name in self.document.groups:
            try:
                if read_attributes(self.path / name):
                    found[name] = "it has attributes that were not written"
            except PermissionError:
                raise
            except (OSError, DamageError):
                found[name] = "its metadata cannot be read"
        for name, array in self.document.arrays.items():
            try:
                self._check_array(array)
            except DamageError as error:
                found[name] = str(error)
        return found

    def _check_array(self, array: StoredArray) -> None:
        """Raise DamageError if metadata, coordinates or heights differ from what was written."""
        try:
            found = digest(parse_json(read_bytes(self.path / array.name / "zarr.json")))
        except FileNotFoundError as error:
            raise DamageError("its metadata are missing") from error
        except PermissionError:
            raise
        except (OSError, ValueError) as error:
            raise DamageError(f"its metadata cannot be read: {error}") from error
        if found != self.document.metadata.get(array.name):
            raise DamageError("its metadata do not match their digest")
        if array.name == "height":
            self.grid()
        elif not array.patch_shape:
            assert self.document.plane is not None  # it has axes
            axis_m = _axis_m(array, self.document.plane)
            if not np.array_equal(self._coordinates(array.name), axis_m):
                raise DamageError("its values differ from those of the grid")

    def repair(self, grid: Grid) -> dict[str, str]:
        """Rewrite damaged metadata, coordinates and heights; return what was damaged.

        A run that is killed meanwhile leaves damage, which the next one finds.
        """
        found = self.array_damage()
        digests = dict(self.document.metadata)
        for name in found:
            if name in self.document.arrays:
                digests[name] = digest(json.loads(self._write_array(name, grid)))
            else:
                self._make_folder(self.path / name)
                write_attributes(self.path / name, {})
        if digests != self.document.metadata:
            replace(self.document, metadata=digests).write(self.path)
        return found

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
            files = _ChunkFiles(self.path, array, read_only=not writable)
            mode = "r+" if writable else "r"
            self._opened[name, writable] = zarr.open_array(
                files, path=name, mode=mode, zarr_format=3
            )
        return self._opened[name, writable]

    def _coordinates(self, name: str) -> NDArray[np.float64]:
        """Return the values of coordinates or heights; raise DamageError if they are damaged."""
        array = self.opened(name)
        validate.memory(f"{name} in {self.path}", _COPIES * 8 * math.prod(array.shape))
        try:
            return np.asarray(array[...])
        except ValueError as error:  # Zarr's message about a checksum
            raise DamageError(_WRONG) from error

    def _write_array(self, name: str, grid: Grid) -> bytes:
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

    def _write_chunks(self, name: str, window: tuple[slice, slice], values: NDArray) -> None:
        """Write whole chunks of an array. Zarr writes no chunk that has only the fill value."""
        self.opened(name, writable=True)[window] = values

    def _checksums_of(
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

    def _remove_record(self, folder: Path) -> None:
        """Remove the old record of a group, so that it never stands beside new chunks."""
        check_own(self.path, folder)
        if (folder / "zarr.json").exists():
            (folder / "zarr.json").unlink()
            sync_folder(folder)

    def _make_folder(self, folder: Path) -> None:
        """Make a folder of the store, also where damage has left something else."""
        check_own(self.path, folder)
        if folder.exists() and not folder.is_dir():
            folder.unlink()
        make_folders(folder)
        if (folder / "zarr.json").is_dir():
            shutil.rmtree(folder / "zarr.json")

    def _folder(self, index: PatchIndex) -> Path:
        """Return the folder of a patch's record."""
        return self.path / GROUP / "{}.{}".format(*index)

    def _chunk(self, array: StoredArray, chunk: tuple[int, ...]) -> Path:
        return self.path.joinpath(*array.name.split("/"), "c", *map(str, chunk))


def _words(array: StoredArray) -> str:
    """Return what an array has of a patch, in words."""
    if array.name == "pixels":
        return "pixels"
    return "amplitudes in dB" if array.name == IN_DB else f"values of {array.name}"


def _all_chunks(array: StoredArray) -> list[tuple[int, ...]]:
    sides = zip(array.shape, array.chunk_shape, strict=True)
    return list(itertools.product(*(range(-(-count // side)) for count, side in sides)))


def _window(array: StoredArray, chunk: tuple[int, ...]) -> tuple[slice, slice]:
    rows, columns = (
        slice(i * side, min((i + 1) * side, count))
        for i, side, count in zip(chunk, array.chunk_shape, array.shape, strict=True)
    )
    return rows, columns


def _axis_m(array: StoredArray, plane: Grid) -> NDArray[np.float64]:
    """Return the coordinates of an axis."""
    return axis_of(plane.axes_m["xy".index(array.name[-1])], array.factor)


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


class _ChunkFiles(LocalStore):
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
