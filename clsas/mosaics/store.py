"""Mosaics in Zarr stores: an array of pixels with one chunk per patch, and one record per patch.

docs/mosaic.md describes the layout. A patch is finished once it has a record, which is written
after its pixels. Pixels and records have checksums, and `Store.write` returns once both are on the
disk.
"""

from __future__ import annotations

import itertools
import math
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsas.core import reprs, validate
from clsas.core.atomic import sync_folder
from clsas.core.digests import grid_digest
from clsas.core.extras import needed
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.reading import check_ordinary
from clsas.mosaics.documents import (
    DIGESTS,
    DamageError,
    check_inputs,
    check_own,
    check_place,
    is_there,
    read_document,
    with_checksum,
    write_attributes,
)
from clsas.mosaics.metadata import CHECKSUM_BYTES, GROUP, has_height
from clsas.mosaics.overview import reduced
from clsas.mosaics.provenance import OtherInputsError, differences
from clsas.mosaics.record import PatchIndex, Record, describe_arrays, describe_damage

if TYPE_CHECKING:
    import zarr

_REPAIR = "; run clsas mosaic with the same inputs to repair it"
_OVERVIEW = 1024  # pixels along the longer side, which fills a screen


@dataclass(frozen=True)
class Store:
    """A mosaic on disk.

    Attributes
    ----------
    path : Path
        Folder of the Zarr store.
    """

    path: Path

    def __post_init__(self) -> None:
        """Check the path and convert it."""
        object.__setattr__(self, "path", validate.path("path", self.path))

    def __repr__(self) -> str:
        """Return the path of the store."""
        return reprs.summary(self, repr(str(self.path)))

    @classmethod
    def at(cls, path: str | os.PathLike) -> Store:
        """Return the store at a path, whether or not a mosaic exists there.

        Raises
        ------
        ImportError
            If Zarr is not installed.
        """
        _arrays()
        return cls(validate.path("path", path).resolve())

    @classmethod
    def opened(cls, path: str | os.PathLike) -> Store:
        """Return the mosaic at a path.

        Raises
        ------
        OSError
            If nothing exists at the path.
        ValueError
            If the path contains something else, or a mosaic of another version.
        ImportError
            If Zarr is not installed.
        """
        store = cls.at(path)
        if not store.path.exists():
            raise FileNotFoundError(2, "there is no mosaic", str(path))
        read_document(store.path)
        return store

    @property
    def patch_shape(self) -> tuple[int, int] | None:
        """Number of pixels of a patch, (rows, columns), or None if there is no mosaic yet."""
        if not is_there(self.path):
            return None
        rows, columns = read_document(self.path)["patch_shape"]
        return rows, columns

    @cached_property
    def pixels(self) -> zarr.Array:
        """Pixels on disk, complex64 [rows, columns]. Zarr verifies their checksums on reading."""
        try:
            return _arrays().open_array(self.path, read_document(self.path), "pixels")
        except DamageError as error:
            raise ValueError(f"{self.path} is damaged: pixels: {error}{_REPAIR}") from error

    @property
    def has_digests(self) -> bool:
        """True if the store has digests of its arrays' metadata.

        Stores of early versions lack them until a run continues the mosaic.
        """
        return DIGESTS in read_document(self.path)

    @property
    def grid(self) -> Grid:
        """Grid of the pixels.

        Raises
        ------
        ValueError
            If the mosaic has arbitrary points, which are not stored, or if metadata, coordinates
            or heights are damaged.
        """
        grid, found = self._compared()
        if grid is None:
            raise ValueError(
                f"{self.path} is a mosaic of arbitrary points, whose grid is not stored"
            )
        if found:
            raise ValueError(f"{self.path} is damaged: {describe_arrays(found)}{_REPAIR}")
        if grid_digest(grid) != read_document(self.path)["inputs"].get("grid"):
            raise ValueError(f"{self.path} is damaged: its grid differs from what was written")
        return grid

    def array_damage(self) -> dict[str, str]:
        """Return the arrays whose metadata, coordinates or heights differ from what was written.

        Returns
        -------
        dict of str to str
            Reason for each damaged array, by its name, such as "its metadata do not match their
            digest". Empty if there is no damage.

        Raises
        ------
        ValueError
            If the store's own document is damaged.
        """
        return self._compared()[1]

    def begin(self, inputs: dict[str, Any], grid: Grid, patch_shape: tuple[int, int]) -> None:
        """Create the store, or check that the one at the path was made with the same inputs.

        Parameters
        ----------
        inputs : dict
            Inputs of the mosaic: digests of its parts, its grid and its request.
        grid : Grid
            Grid of the mosaic.
        patch_shape : (rows, columns)
            Number of pixels of a patch.

        Raises
        ------
        TypeError, ValueError
            If `inputs` are not those of a mosaic on the grid.
        OtherInputsError
            If the path contains a mosaic with other inputs; the message names the differences.
        ValueError
            If the path contains something else.
        OSError
            If the store cannot be written.
        """
        arrays = _arrays()
        validate.instance("grid", grid, Grid)
        check_inputs(inputs, grid.shape)
        patch_shape = validate.sides("patch_shape", patch_shape)
        check_place(self.path)
        if not is_there(self.path):
            arrays.create_store(self.path, inputs, grid, patch_shape)
        stored = read_document(self.path)
        if found := differences(stored, inputs, patch_shape):
            ways = "choose another path or repeat the inputs"
            if not any((self.path / GROUP).glob("*/zarr.json")):
                ways += ", or delete the store: it has no finished patch"
            raise OtherInputsError(
                f"{self.path} was made with other inputs: {'; '.join(found)}; {ways}"
            )
        if repaired := arrays.repair(self.path, grid):
            validate.warn(
                f"{self.path} was damaged and has been repaired: {describe_arrays(repaired)}"
            )
        self.grow(inputs)

    def grow(self, inputs: dict[str, Any]) -> None:
        """Store the inputs of a survey to which files have been added.

        Raises
        ------
        TypeError, ValueError
            If `inputs` are not those of a mosaic on the store's grid.
        """
        attributes = read_document(self.path)
        check_inputs(inputs, attributes["inputs"]["pixels"])
        if attributes["inputs"] != inputs:
            write_attributes(self.path, with_checksum(attributes | {"inputs": inputs}))

    def records(self) -> dict[PatchIndex, Record]:
        """Return the records of all finished patches, by row and column.

        Patches whose record, or the checksum behind whose pixels, is damaged are left out. The
        pixels themselves are not read; `damage` reads them too.
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
        """Read every finished patch, and return those that are damaged.

        Parameters
        ----------
        tell : callable, optional
            Called as tell(patches read so far, number of patches).

        Returns
        -------
        dict of (row, column) to str
            Reason for each damaged patch, such as "its pixels do not match their checksum".

        Raises
        ------
        OSError
            If a file cannot be read.
        """
        validate.function("tell", tell)
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

        Parameters
        ----------
        row, column : int
            Index of the patch.
        rows, columns : slice
            Pixels of the mosaic that belong to the patch.
        pixels : complex64 [rows, columns]
        record : Record

        Raises
        ------
        OSError
            If the disk is full or the store is not writable.
        """
        row, column = (
            validate.count(name, index, least=0, most=most - 1)
            for name, index, most in zip(("row", "column"), (row, column), self._shape, strict=True)
        )
        part = [
            range(count)[validate.selection(name, given, ascending=True)]
            for name, given, count in zip(
                ("rows", "columns"), (rows, columns), self.pixels.shape, strict=True
            )
        ]
        pixels = validate.array("pixels", pixels, np.complex64, tuple(map(len, part)))
        validate.instance("record", record, Record)
        folder = self._folder((row, column))
        check_own(self.path, folder)
        # Remove the old record first, so that it never stands beside pixels of the new patch.
        if (folder / "zarr.json").exists():
            (folder / "zarr.json").unlink()
            sync_folder(folder)
        _arrays().write_pixels(self.path, read_document(self.path), rows, columns, pixels)
        write_attributes(folder, record.attributes(self._checksum((row, column))))

    def read(
        self, rows: slice = slice(None), columns: slice = slice(None)
    ) -> NDArray[np.complex64]:
        """Return the pixels of a window, by default all, complex64 [rows, columns].

        Raises
        ------
        ValueError
            If a finished patch among them is damaged; the message names it.
        OSError
            If a file cannot be read.
        """
        validate.selection("rows", rows, ascending=True)
        validate.selection("columns", columns, ascending=True)
        requested = (
            len(range(n)[part]) for n, part in zip(self.pixels.shape, (rows, columns), strict=True)
        )
        validate.memory("the mosaic", 8 * math.prod(requested))
        try:
            _arrays().check_metadata(self.path, read_document(self.path))
            for index in self._touched(rows, columns):
                self._record(index)
            return np.asarray(self.pixels[rows, columns])
        except ValueError as error:
            found = {}
            for index in self._touched(rows, columns):
                try:
                    self._verify(index)
                except DamageError as damage:
                    found[index] = str(damage)
            reason = describe_damage(found) if found else str(error)
            raise ValueError(f"{self.path} is damaged: {reason}{_REPAIR}") from error

    def image(self, rows: slice = slice(None), columns: slice = slice(None)) -> Image:
        """Return the pixels of a window, by default all, as an image.

        Raises
        ------
        ValueError
            If a finished patch among them is damaged, or the image does not fit into memory.
        OSError
            If a file cannot be read.
        """
        window = self.grid.window(rows, columns)
        return Image(self.read(rows, columns), window)

    def overview(
        self,
        most: int = _OVERVIEW,
        rows: slice = slice(None),
        columns: slice = slice(None),
    ) -> Image:
        """Return the mosaic at fewer pixels, each with the mean power of those that it covers.

        About one patch at a time is read, so the pixels may take more than memory. A height map
        becomes a plane.

        Parameters
        ----------
        most : int
            Largest number of pixels along the longer side of the overview.
        rows, columns : slice
            Part of the mosaic; by default all of it.

        Raises
        ------
        TypeError
            If `rows` or `columns` is not a slice of whole numbers.
        ValueError
            If nothing is selected, or a finished patch is damaged.
        """
        validate.count("most", most)
        parts = [
            range(count)[validate.selection(name, given, ascending=True)]
            for name, given, count in zip(
                ("rows", "columns"), (rows, columns), self.pixels.shape, strict=True
            )
        ]
        part = self.grid.window(rows, columns)

        def read(*within: slice) -> NDArray[np.complex64]:
            chosen = (whole[each] for whole, each in zip(parts, within, strict=True))
            return self.read(*(slice(each.start, each.stop, each.step) for each in chosen))

        height, width = self.pixels.chunks
        return reduced(part, (height, width), read, most)

    def _compared(self) -> tuple[Grid | None, dict[str, str]]:
        attributes = read_document(self.path)
        return _arrays().compared(self.path, attributes, has_height(self.path, attributes))

    def _indices(self) -> list[PatchIndex]:
        """Return the patches that have a folder for their record, in order."""
        shape = self._shape
        folders = self.path / GROUP
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

    def _touched(self, rows: slice, columns: slice) -> Iterator[PatchIndex]:
        """Yield the patches to which the pixels of a window belong."""
        touched: list[range] = []
        for part, count, side in zip(
            (rows, columns), self.pixels.shape, self.pixels.chunks, strict=True
        ):
            pixels = range(count)[part]
            if not pixels:
                return
            ends = sorted((pixels[0], pixels[-1]))
            touched.append(range(ends[0] // side, ends[1] // side + 1))
        yield from itertools.product(*touched)

    def _folder(self, index: PatchIndex) -> Path:
        return self.path / GROUP / "{}.{}".format(*index)

    def _chunk(self, index: PatchIndex) -> Path:
        return self.path.joinpath("pixels", "c", *map(str, index))

    def _checksum(self, index: PatchIndex) -> str | None:
        """Return the checksum behind a patch's pixels, or None if the pixels are all zero."""
        try:
            check_ordinary(self._chunk(index))
            with self._chunk(index).open("rb") as file:
                file.seek(8 * math.prod(self.pixels.chunks))
                return file.read(2 * CHECKSUM_BYTES).hex()  # of an intact file, half as many bytes
        except FileNotFoundError:
            return None  # Zarr writes no chunk of zeros

    def _record(self, index: PatchIndex) -> Record | None:
        """Return the record of a patch, or None if the patch is not finished.

        Raises
        ------
        DamageError
            If the record is damaged, or the checksum behind the pixels is not that of the record.
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
        """Read a patch if it is finished; raise DamageError if it differs from what was written."""
        if self._record(index) is None or not self._chunk(index).exists():
            return
        row, column = (
            slice(i * n, (i + 1) * n) for i, n in zip(index, self.pixels.chunks, strict=True)
        )
        try:
            _ = self.pixels[row, column]
        except ValueError as error:  # Zarr's message about a checksum
            raise DamageError("its pixels do not match their checksum") from error


def _arrays() -> ModuleType:
    """Return the module that needs Zarr."""
    with needed("stores of mosaics"):
        from clsas.mosaics import arrays
    return arrays
