"""Mosaics in Zarr stores: one array of pixels, and for every patch one chunk and one record.

docs/mosaic.md describes the layout. A patch is finished once it has a record, which is written
after its pixels. Pixels and records have checksums. Both are on the disk when `Store.write`
returns.
"""

from __future__ import annotations

import itertools
import math
import os
import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsas.core import reprs, validate
from clsas.core.atomic import sync_folder
from clsas.core.digests import grid_digest
from clsas.core.extras import install_command
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.reading import check_ordinary
from clsas.mosaics.documents import (
    DamageError,
    read_document,
    with_checksum,
    write_attributes,
)
from clsas.mosaics.overview import reduced
from clsas.mosaics.provenance import differences
from clsas.mosaics.record import PatchIndex, Record, describe_damage

if TYPE_CHECKING:
    import zarr

_OVERVIEW = 1024  # pixels along the longer side


@dataclass(frozen=True)
class Store:
    """A mosaic on disk.

    Attributes
    ----------
    path : Path
    """

    path: Path

    def __repr__(self) -> str:
        """Return where the store is."""
        return reprs.summary(self, repr(str(self.path)))

    @classmethod
    def at(cls, path: str | os.PathLike) -> Store:
        """Return the store at a path where a mosaic may or may not exist.

        Raises
        ------
        ImportError
            If Zarr is not installed.
        """
        _zarr()
        return cls(validate.path("store", path).resolve())

    @classmethod
    def opened(cls, path: str | os.PathLike) -> Store:
        """Return the mosaic at a path.

        Raises
        ------
        OSError
            If there is none.
        ValueError
            If the path holds something else, or a mosaic of another version.
        """
        store = cls.at(path)
        if not store.path.exists():
            raise FileNotFoundError(2, "there is no mosaic", str(path))
        read_document(store.path)
        return store

    @property
    def patch_shape(self) -> tuple[int, int] | None:
        """Pixels of a patch, or None if there is no mosaic yet."""
        if not self._is_there():
            return None
        rows, columns = read_document(self.path)["patch_shape"]
        return rows, columns

    @cached_property
    def pixels(self) -> zarr.Array:
        """Pixels on disk, complex64 [rows, columns]. Zarr verifies their checksums."""
        pixels, attributes = self._array("pixels"), read_document(self.path)
        described = list(pixels.shape), list(pixels.chunks), pixels.dtype, pixels.fill_value
        expected = attributes["inputs"].get("pixels"), attributes["patch_shape"], np.complex64, 0
        if described != expected:
            raise ValueError(f"{self.path} is damaged: its pixels are not those of its grid")
        return pixels

    @property
    def grid(self) -> Grid:
        """Grid of the pixels.

        Raises
        ------
        ValueError
            If the mosaic has arbitrary points, which are not stored, or the grid is damaged.
        """
        attributes = read_document(self.path)
        stored = attributes["grid"]
        if stored is None:
            raise ValueError(f"{self.path} is a mosaic of points, whose grid it does not hold")
        rows, columns = self.pixels.shape
        grid = Grid.oriented(**stored, shape=(rows, columns))
        if (self.path / "height").exists():
            grid = grid.with_height(self._values("height"))
        if grid_digest(grid) != attributes["inputs"].get("grid"):
            raise ValueError(f"{self.path} is damaged: its grid is not the one that was written")
        return grid

    def begin(self, inputs: dict[str, Any], grid: Grid, patch_shape: tuple[int, int]) -> None:
        """Create the store, or check that it was made with the same inputs.

        Raises
        ------
        ValueError
            If the path holds something else, or a mosaic with other inputs; the message names the
            differences.
        OSError
            If the store cannot be written.
        """
        if not self._is_there():
            from clsas.mosaics.durable import create_store

            create_store(self.path, inputs, grid, patch_shape)
        stored = read_document(self.path)
        found = differences(stored["inputs"], inputs)
        if stored["patch_shape"] != list(patch_shape):
            mine, theirs = ("{} x {}".format(*s) for s in (stored["patch_shape"], patch_shape))
            found.insert(0, f"patches of {mine} pixels there, of {theirs} given")
        if found:
            ways = "give it another path or the same inputs"
            if not self.records():
                ways += ", or delete it: no patch of it was finished"
            raise ValueError(f"{self.path} was made with other inputs: {'; '.join(found)}; {ways}")
        with tempfile.TemporaryFile(dir=self.path):
            pass  # raises where it cannot be written
        _ = self.pixels  # raises where they are damaged
        self.grow(inputs)

    def grow(self, inputs: dict[str, Any]) -> None:
        """Store the inputs of a survey that has grown."""
        attributes = read_document(self.path)
        if attributes["inputs"] != inputs:
            write_attributes(self.path, with_checksum(attributes | {"inputs": inputs}))

    def records(self) -> dict[PatchIndex, Record]:
        """Return the records of all finished patches, by row and column.

        Patches are left out if their records or the checksums behind their pixels are damaged.
        `damage` also reads the pixels.
        """
        found = {}
        for index in self._indices():
            try:
                record = self._record(index)
            except DamageError:
                continue
            if record is not None:
                found[index] = record
        return found

    def damage(self, tell: Callable[[int, int], object] | None = None) -> dict[PatchIndex, str]:
        """Read every finished patch, and return the reason for each that is damaged.

        Parameters
        ----------
        tell : callable, optional
            Called with the number of patches read so far and the number of all.

        Returns
        -------
        dict of (row, column) to str
            Reasons, such as "its pixels do not match their checksum".

        Raises
        ------
        OSError
            If a file cannot be read.
        """
        found, indices = {}, self._indices()
        for done, index in enumerate(indices, 1):
            try:
                self._verify(index)
            except DamageError as error:
                found[index] = str(error)
            if tell is not None:
                tell(done, len(indices))
        return found

    def write(
        self,
        row: int,
        column: int,
        rows: slice,
        columns: slice,
        pixels: NDArray[np.complex64],
        record: Record,
    ) -> None:
        """Write a patch and then its record, and wait until both are on the disk.

        Raises
        ------
        OSError
            If the disk is full or the store is not writable.
        """
        from clsas.mosaics.durable import write_pixels

        folder = self._folder((row, column))
        # Remove the old record before the pixels that it belongs to are replaced.
        if (folder / "zarr.json").exists():
            (folder / "zarr.json").unlink()
            sync_folder(folder)
        write_pixels(self.path, rows, columns, pixels)
        write_attributes(folder, record.attributes(self._checksum((row, column))))

    def read(
        self, rows: slice = slice(None), columns: slice = slice(None)
    ) -> NDArray[np.complex64]:
        """Return pixels, by default all, complex64 [rows, columns].

        Raises
        ------
        ValueError
            If a finished patch among them is damaged; the message names it.
        OSError
            If a file cannot be read.
        """
        indices = self._touched(rows, columns)
        try:
            for index in indices:
                self._record(index)
            return np.asarray(self.pixels[rows, columns])
        except ValueError as error:
            found = {}
            for index in indices:
                try:
                    self._verify(index)
                except DamageError as damage:
                    found[index] = str(damage)
            reason = describe_damage(found) if found else str(error)
            raise ValueError(
                f"{self.path} is damaged: {reason}; clsas mosaic with the same inputs mends it"
            ) from error

    def image(self, rows: slice = slice(None), columns: slice = slice(None)) -> Image:
        """Return pixels, by default all, as an image.

        Raises
        ------
        ValueError
            If a finished patch among them is damaged, or the image does not fit into memory.
        OSError
            If a file cannot be read.
        """
        window = self.grid.window(rows, columns)
        validate.memory("the mosaic", 8 * window.size)
        return Image(self.read(rows, columns), window)

    def overview(self, most: int = _OVERVIEW) -> Image:
        """Return the mosaic at fewer pixels, each with the mean power of those it covers.

        Raises
        ------
        ValueError
            If a finished patch is damaged.
        """
        validate.count("most", most)
        rows, columns = self.pixels.chunks
        return reduced(self.grid, (rows, columns), self.read, most)

    def _array(self, name: str) -> zarr.Array:
        _zarr()
        from clsas.mosaics.durable import open_array

        try:
            return open_array(self.path, name)
        except (LookupError, OSError, ValueError, TypeError) as error:
            raise ValueError(f"{self.path} is damaged: {name} cannot be read: {error}") from error

    def _values(self, name: str) -> NDArray:
        """Return a whole array."""
        array = self._array(name)
        chunk_bytes = math.prod(array.chunks) * array.dtype.itemsize
        # As read, and as converted; and a chunk as stored, which may be larger than the array.
        validate.memory(f"{name} in {self.path}", 2 * array.nbytes + 2 * chunk_bytes)
        try:
            return np.asarray(array[:])
        except ValueError as error:
            raise ValueError(f"{self.path} is damaged: {name} cannot be read: {error}") from error

    def _indices(self) -> list[PatchIndex]:
        """Patches that have a folder for their record, in order."""
        shape = self._shape
        folders = self.path / "patches"
        found = []
        for folder in folders.iterdir() if folders.is_dir() else ():
            if name := re.fullmatch(r"(\d+)\.(\d+)", folder.name):
                index = int(name[1]), int(name[2])
                if index[0] < shape[0] and index[1] < shape[1]:
                    found.append(index)
        return sorted(found)

    @property
    def _shape(self) -> tuple[int, int]:
        """Number of patches along rows and columns."""
        pixels = self.pixels
        rows, columns = (math.ceil(n / m) for n, m in zip(pixels.shape, pixels.chunks, strict=True))
        return rows, columns

    def _touched(self, rows: slice, columns: slice) -> list[PatchIndex]:
        """Patches to which some pixels belong."""
        touched: list[range] = []
        for part, count, side in zip(
            (rows, columns), self.pixels.shape, self.pixels.chunks, strict=True
        ):
            pixels = range(count)[part]
            if not pixels:
                return []
            ends = sorted((pixels[0], pixels[-1]))
            touched.append(range(ends[0] // side, ends[1] // side + 1))
        rows_of, columns_of = touched
        return list(itertools.product(rows_of, columns_of))

    def _folder(self, index: PatchIndex) -> Path:
        return self.path / "patches" / "{}.{}".format(*index)

    def _chunk(self, index: PatchIndex) -> Path:
        return self.path.joinpath("pixels", "c", *map(str, index))

    def _checksum(self, index: PatchIndex) -> str | None:
        """Return the checksum behind a patch's pixels, or None if the pixels are all zero."""
        try:
            check_ordinary(self._chunk(index))
            with self._chunk(index).open("rb") as file:
                file.seek(8 * math.prod(self.pixels.chunks))
                return file.read().hex()
        except FileNotFoundError:
            return None  # Zarr writes no chunk of zeros

    def _record(self, index: PatchIndex) -> Record | None:
        """Return the record of a patch, or None if the patch is not finished.

        Raises
        ------
        DamageError
            If the record is damaged, or the checksum behind the pixels is another one.
        """
        found = Record.read(self._folder(index))
        if found is None:
            return None
        record, expected = found
        try:
            matches = self._checksum(index) == expected
        except ValueError as error:
            raise DamageError(str(error)) from error
        if not matches:
            gone = not self._chunk(index).exists()
            raise DamageError("its pixels are " + ("gone" if gone else "not those of its record"))
        return record

    def _verify(self, index: PatchIndex) -> None:
        """Read a patch; raise DamageError if it is finished and differs from what was written."""
        if self._record(index) is None:
            return
        row, column = (
            slice(i * n, (i + 1) * n) for i, n in zip(index, self.pixels.chunks, strict=True)
        )
        try:
            _ = self.pixels[row, column]
        except ValueError as error:  # Zarr's message about a checksum
            raise DamageError("its pixels do not match their checksum") from error

    def _is_there(self) -> bool:
        """Return whether there is anything at the path."""
        return self.path.exists() and not (self.path.is_dir() and not any(self.path.iterdir()))


def _zarr() -> Any:
    try:
        import zarr
    except ImportError:
        raise ImportError(f"stores of mosaics need Zarr: {install_command('mosaic')}") from None
    return zarr
