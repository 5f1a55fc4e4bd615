"""The Zarr store of a mosaic: its pixels in one array, one chunk and one record per patch.

docs/mosaic.md describes the layout. A patch is finished once its record is there, which is written
after its pixels. Both carry checksums, and both are on the disk before `Store.write` returns.
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
from clsas.core.atomic import creating, sync_folder
from clsas.core.extras import install_command
from clsas.core.grid import Grid
from clsas.core.image import Image
from clsas.core.reading import check_ordinary
from clsas.factorized.plan import grid_digest
from clsas.mosaics.overview import reduced
from clsas.mosaics.provenance import differences
from clsas.mosaics.record import (
    DamageError,
    Place,
    Record,
    describe_damage,
    is_intact,
    read_attributes,
    with_checksum,
    write_attributes,
)

if TYPE_CHECKING:
    import zarr

FORMAT = "clsas mosaic"
VERSION = 2  # 1 had no checksums

_OVERVIEW = 1024  # pixels along the longer side, at most


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
        """Return the store at a path, which need not exist yet.

        Raises
        ------
        ImportError
            If Zarr is not installed.
        """
        _zarr()
        return cls(validate.path("store", path).resolve())

    @classmethod
    def opened(cls, path: str | os.PathLike) -> Store:
        """Return the store at a path.

        Raises
        ------
        OSError
            If there is none.
        ValueError
            If it is not of this library, or of another version.
        """
        store = cls.at(path)
        if not store.path.exists():
            raise FileNotFoundError(2, "there is no mosaic", str(path))
        store._attributes()
        return store

    @property
    def patch_shape(self) -> tuple[int, int] | None:
        """Pixels of a patch, or None where there is no mosaic yet."""
        if not self._is_there():
            return None
        rows, columns = self._attributes()["patch_shape"]
        return rows, columns

    @cached_property
    def pixels(self) -> zarr.Array:
        """The pixels, complex64 [rows, columns], on disk; Zarr verifies their checksums."""
        pixels, attributes = self._array("pixels"), self._attributes()
        described = list(pixels.shape), list(pixels.chunks), pixels.dtype, pixels.fill_value
        expected = attributes["inputs"].get("pixels"), attributes["patch_shape"], np.complex64, 0
        if described != expected:
            raise ValueError(f"{self.path} is damaged: its pixels are not those of its grid")
        return pixels

    @property
    def grid(self) -> Grid:
        """Where the pixels lie.

        Raises
        ------
        ValueError
            If the mosaic is of points, whose grid is not stored, or the grid is damaged.
        """
        attributes = self._attributes()
        stored = attributes["grid"]
        if stored is None:
            raise ValueError(f"{self.path} is a mosaic of points, whose grid it does not hold")
        grid = Grid.oriented(**stored, shape=tuple(self.pixels.shape))
        if (self.path / "height").exists():
            grid = grid.with_height(self._values("height"))
        if grid_digest(grid) != attributes["inputs"].get("grid"):
            raise ValueError(f"{self.path} is damaged: its grid is not the one that was written")
        return grid

    def begin(self, inputs: dict[str, Any], grid: Grid, patch_shape: tuple[int, int]) -> None:
        """Create the store, or check that it was made with these inputs.

        Raises
        ------
        ValueError
            If the path holds something else, or a mosaic of other inputs; the message names them.
        OSError
            If it cannot be written.
        """
        if not self._is_there():
            self._create(inputs, grid, patch_shape)
        stored = self._attributes()
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
        """Keep the inputs of a survey that has grown."""
        attributes = self._attributes()
        if attributes["inputs"] != inputs:
            write_attributes(self.path, with_checksum(attributes | {"inputs": inputs}))

    def _create(self, inputs: dict[str, Any], grid: Grid, patch_shape: tuple[int, int]) -> None:
        """Create the store, whole or not at all."""
        if not self.path.parent.is_dir():
            raise FileNotFoundError(2, "there is no such folder", str(self.path.parent))
        from clsas.mosaics.durable import create_arrays

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
        with creating(self.path) as temporary:
            create_arrays(temporary, grid, patch_shape)
            write_attributes(temporary / "patches", {})
            write_attributes(temporary, with_checksum(attributes))

    def records(self) -> dict[Place, Record]:
        """Return the records of all finished patches, by row and column.

        Damaged patches are left out as far as their records and the sizes of their pixels tell;
        `damage` also reads the pixels.
        """
        found = {}
        for place in self._places():
            try:
                record = self._record(place)
            except DamageError:
                continue
            if record is not None:
                found[place] = record
        return found

    def damage(self, tell: Callable[[int, int], object] | None = None) -> dict[Place, str]:
        """Read every finished patch; return what is wrong with each that is damaged.

        Parameters
        ----------
        tell : callable, optional
            Called with the number of patches that were read and of all.

        Returns
        -------
        dict of (row, column) to str
            Reasons, such as "its pixels do not match their checksum".

        Raises
        ------
        OSError
            If a file cannot be read.
        """
        found, places = {}, self._places()
        for done, place in enumerate(places, 1):
            try:
                self._verify(place)
            except DamageError as error:
                found[place] = str(error)
            if tell is not None:
                tell(done, len(places))
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
        """Write a patch and then its record; both are on the disk when this returns.

        Raises
        ------
        OSError
            If the disk is full or the store not writable.
        """
        from clsas.mosaics.durable import write_pixels

        folder = self._folder((row, column))
        # A record is of the pixels it was written for: it goes before they are replaced.
        if (folder / "zarr.json").exists():
            (folder / "zarr.json").unlink()
            sync_folder(folder)
        write_pixels(self.path, rows, columns, pixels)
        write_attributes(folder, record.attributes(self._checksum((row, column))))

    def read(
        self, rows: slice = slice(None), columns: slice = slice(None)
    ) -> NDArray[np.complex64]:
        """Return some of the pixels, all by default, complex64 [rows, columns].

        Raises
        ------
        ValueError
            If a finished patch among them is damaged; the message names it.
        OSError
            If a file cannot be read.
        """
        places = self._touched(rows, columns)
        try:
            for place in places:
                self._record(place)
            return self.pixels[rows, columns]
        except ValueError as error:
            found = {}
            for place in places:
                try:
                    self._verify(place)
                except DamageError as damage:
                    found[place] = str(damage)
            told = describe_damage(found) if found else str(error)
            raise ValueError(
                f"{self.path} is damaged: {told}; clsas mosaic with the same inputs mends it"
            ) from error

    def image(self, rows: slice = slice(None), columns: slice = slice(None)) -> Image:
        """Return some of the pixels, all by default, as an image.

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
        """Return the mosaic at fewer pixels, each the root of the mean power of those it covers.

        Raises
        ------
        ValueError
            If a finished patch is damaged.
        """
        validate.count("most", most)
        return reduced(self.grid, self.pixels.chunks, self.read, most)

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
        try:
            return array[:]
        except ValueError as error:
            raise ValueError(f"{self.path} is damaged: {name} cannot be read: {error}") from error

    def _places(self) -> list[Place]:
        """Return the patches that have a folder for their record, in order."""
        shape = self._shape
        folders = self.path / "patches"
        found = []
        for folder in folders.iterdir() if folders.is_dir() else ():
            if name := re.fullmatch(r"(\d+)\.(\d+)", folder.name):
                place = int(name[1]), int(name[2])
                if place[0] < shape[0] and place[1] < shape[1]:
                    found.append(place)
        return sorted(found)

    @property
    def _shape(self) -> tuple[int, int]:
        """Number of patches along rows and columns."""
        pixels = self.pixels
        rows, columns = (math.ceil(n / m) for n, m in zip(pixels.shape, pixels.chunks, strict=True))
        return rows, columns

    def _touched(self, rows: slice, columns: slice) -> list[Place]:
        """Return the patches that some pixels belong to."""
        indices = []
        for part, count, side in zip(
            (rows, columns), self.pixels.shape, self.pixels.chunks, strict=True
        ):
            pixels = range(count)[part]
            if not pixels:
                return []
            ends = sorted((pixels[0], pixels[-1]))
            indices.append(range(ends[0] // side, ends[1] // side + 1))
        return list(itertools.product(*indices))

    def _folder(self, place: Place) -> Path:
        return self.path / "patches" / "{}.{}".format(*place)

    def _chunk(self, place: Place) -> Path:
        return self.path.joinpath("pixels", "c", *map(str, place))

    def _checksum(self, place: Place) -> str | None:
        """Return the checksum that a patch's pixels end with, or None where they are all zero."""
        try:
            check_ordinary(self._chunk(place))
            with self._chunk(place).open("rb") as file:
                file.seek(8 * math.prod(self.pixels.chunks))
                return file.read().hex()
        except FileNotFoundError:
            return None  # Zarr leaves out a chunk that is all zero

    def _record(self, place: Place) -> Record | None:
        """Return the record of a patch, or None if it is not finished.

        Raises
        ------
        DamageError
            If the record is damaged, or the pixels on disk end with another checksum.
        """
        found = Record.read(self._folder(place))
        if found is None:
            return None
        record, expected = found
        try:
            matches = self._checksum(place) == expected
        except ValueError as error:
            raise DamageError(str(error)) from error
        if not matches:
            gone = not self._chunk(place).exists()
            raise DamageError("its pixels are " + ("gone" if gone else "not those of its record"))
        return record

    def _verify(self, place: Place) -> None:
        """Read a patch; raise DamageError if it is finished and not what was written."""
        if self._record(place) is None:
            return
        row, column = (
            slice(i * n, (i + 1) * n) for i, n in zip(place, self.pixels.chunks, strict=True)
        )
        try:
            _ = self.pixels[row, column]
        except ValueError as error:  # Zarr's, of a checksum
            raise DamageError("its pixels do not match their checksum") from error

    def _is_there(self) -> bool:
        """Return whether the path holds anything."""
        return self.path.exists() and not (self.path.is_dir() and not any(self.path.iterdir()))

    def _attributes(self) -> dict[str, Any]:
        """Return what is known about the mosaic as a whole.

        Raises
        ------
        ValueError
            If the path holds something else, a mosaic of another version, or a damaged one.
        """
        try:
            attributes = read_attributes(self.path)
        except (OSError, DamageError) as error:
            raise ValueError(f"{self.path} exists and is not a mosaic of clsas") from error
        if attributes.get("format") != FORMAT:
            raise ValueError(f"{self.path} exists and is not a mosaic of clsas")
        if attributes.get("version") != VERSION:
            raise ValueError(
                f"{self.path} is a mosaic of version {attributes.get('version')}, this clsas works "
                f"with version {VERSION}: give it another path"
            )
        if not is_intact(attributes):
            raise ValueError(f"{self.path} is damaged: its attributes do not match their checksum")
        shape, inputs = attributes.get("patch_shape"), attributes.get("inputs")
        whole = isinstance(inputs, dict) and isinstance(inputs.get("parts"), list)
        whole = whole and isinstance(shape, list) and [type(n) for n in shape] == [int, int]
        if not whole:
            raise ValueError(f"{self.path} is damaged: its attributes are not those of a mosaic")
        return attributes


def _zarr() -> Any:
    try:
        import zarr
    except ImportError:
        raise ImportError(f"stores of mosaics need Zarr: {install_command('mosaic')}") from None
    return zarr
