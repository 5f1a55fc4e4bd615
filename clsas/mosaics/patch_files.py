"""Files of the patches of a store: chunks of pixels and of levels, and records."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from clsas.mosaics.chunks import any_missing, chunk_checksums
from clsas.mosaics.documents import DamageError
from clsas.mosaics.levels import IN_DB, PixelArray
from clsas.mosaics.metadata import GROUP
from clsas.mosaics.record import Checksums, PatchIndex, Record

_Stamp = tuple[int, int, int]


@dataclass(frozen=True)
class PatchFiles:
    """Files of the patches of a store.

    Attributes
    ----------
    path : Path
        The store.
    arrays : tuple of PixelArray
        Arrays that are written with each patch: the pixels, and the levels of patches. Methods
        take a part of them where not all are needed.
    """

    path: Path
    arrays: tuple[PixelArray, ...]
    _read: dict[PatchIndex, tuple[_Stamp, Checksums]] = field(
        default_factory=dict, repr=False, compare=False
    )

    @property
    def pixels(self) -> PixelArray:
        """The array of the pixels."""
        return self.arrays[0]

    @property
    def shape(self) -> tuple[int, int]:
        """Number of patches along rows and columns."""
        sides = zip(self.pixels.shape, self.pixels.patch_shape, strict=True)
        rows, columns = (math.ceil(count / side) for count, side in sides)
        return rows, columns

    def folder(self, index: PatchIndex) -> Path:
        """Return the folder of a patch's record."""
        return self.path / GROUP / "{}.{}".format(*index)

    def indices(self) -> list[PatchIndex]:
        """Return the patches that have a folder for their record, in order."""
        shape = self.shape
        folders = self.path / GROUP
        found = []
        for folder in folders.iterdir() if folders.is_dir() else ():
            if name := re.fullmatch(r"(\d+)\.(\d+)", folder.name):
                index = int(name[1]), int(name[2])
                if index[0] < shape[0] and index[1] < shape[1]:
                    found.append(index)
        return sorted(found)

    def checksums(self, index: PatchIndex) -> Checksums:
        """Return the checksums behind a patch's pixels and levels."""
        return {
            array.name: chunk_checksums(self.path, array, array.chunks(index))
            for array in self.arrays
        }

    def recorded(self) -> dict[PatchIndex, Checksums]:
        """Return the checksums in all intact records.

        Records are read again only if their files have been replaced, by this or another process.
        """
        found: dict[PatchIndex, Checksums] = {}
        for index in self.indices():
            with suppress(DamageError, FileNotFoundError):
                stamp = _stamp(self.folder(index) / "zarr.json")
                if self._read.get(index, (None, {}))[0] != stamp:
                    stored = Record.read(self.folder(index))
                    if stored is None:
                        continue
                    self._read[index] = stamp, stored[1]
                found[index] = self._read[index][1]
        return found

    def record(
        self, index: PatchIndex, arrays: Sequence[PixelArray] | None = None
    ) -> Record | None:
        """Return the record of a patch, or None if the patch is not finished.

        Raises
        ------
        DamageError
            If the record is damaged, or a checksum behind pixels or levels is not that of the
            record.
        """
        found = Record.read(self.folder(index))
        if found is None:
            return None
        record, expected = found
        for array in self.arrays if arrays is None else arrays:
            chunks = array.chunks(index)
            try:
                same = chunk_checksums(self.path, array, chunks) == expected.get(array.name, "")
            except ValueError as error:
                raise DamageError(str(error)) from error
            if not same:
                gone = any_missing(self.path, array, chunks)
                raise DamageError(
                    f"its {_words(array)} are " + ("gone" if gone else "not those of its record")
                )
        return record

    def verify(
        self,
        index: PatchIndex,
        opened: Callable[[PixelArray], Any],
        arrays: Sequence[PixelArray] | None = None,
    ) -> None:
        """Read a patch if it is finished; raise DamageError if it differs from what was written.

        Parameters
        ----------
        index : (row, column)
        opened : callable
            Returns the zarr.Array of an array.
        arrays : sequence of PixelArray, optional
            Arrays to read.
        """
        if self.record(index, arrays) is None:
            return
        for array in self.arrays if arrays is None else arrays:
            try:
                _ = opened(array)[array.window(index)]
            except ValueError as error:  # Zarr's message about a checksum
                raise DamageError(f"its {_words(array)} do not match their checksum") from error


def _stamp(path: Path) -> _Stamp:
    """Return what tells a file from another that has replaced it."""
    status = path.stat()
    return status.st_ino, status.st_mtime_ns, status.st_size


def _words(array: PixelArray) -> str:
    """Return what an array has of a patch, in words."""
    if array.name == "pixels":
        return "pixels"
    return "amplitudes in dB" if array.name == IN_DB else f"values of {array.name}"
