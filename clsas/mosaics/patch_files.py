"""Files of the patches of a store: chunks of pixels, layers and levels, and records."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.atomic import sync_folder
from clsas.engine.data.validate import ArgumentError
from clsas.mosaics.arrays import StoredArrays
from clsas.mosaics.document import (
    GROUP,
    REPAIR,
    DamageError,
    Document,
    check_own,
    write_attributes,
)
from clsas.mosaics.levels import IN_DB, StoredArray
from clsas.mosaics.pyramid import pyramid, values_of
from clsas.mosaics.record import Checksums, PatchIndex, Record, describe_damage

_Stamp = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class PatchFiles:
    """Files of the patches of a store.

    Attributes
    ----------
    arrays : StoredArrays
    """

    arrays: StoredArrays
    _read: dict[PatchIndex, tuple[_Stamp, Checksums]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, path: Path) -> PatchFiles:
        """Return the files of the store at a path; see `Document.read`."""
        return cls(StoredArrays(path, Document.read(path)))

    @property
    def path(self) -> Path:
        """Folder of the store."""
        return self.arrays.path

    @property
    def document(self) -> Document:
        """The store's document."""
        return self.arrays.document

    @property
    def shape(self) -> tuple[int, int]:
        """Number of patches along rows and columns."""
        sides = zip(self.document.shape, self.document.patch_shape, strict=True)
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
        for name in os.listdir(folders) if folders.is_dir() else ():
            if part := re.fullmatch(r"(\d+)\.(\d+)", name):
                index = int(part[1]), int(part[2])
                if index[0] < shape[0] and index[1] < shape[1]:
                    found.append(index)
        return sorted(found)

    def recorded(self) -> dict[PatchIndex, Checksums]:
        """Return the checksums in all intact records.

        Records are read again only if their files have been replaced, by this or another process.
        """
        found: dict[PatchIndex, Checksums] = {}
        for index in self.indices():
            with suppress(DamageError, FileNotFoundError):
                stamp = stamp_of(self.folder(index) / "zarr.json")
                if self._read.get(index, (None, {}))[0] != stamp:
                    stored = Record.read(self.folder(index))
                    if stored is None:
                        continue
                    self._read[index] = stamp, stored[1]
                found[index] = self._read[index][1]
        return found

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
        found = Record.read(self.folder(index))
        if found is None:
            return None
        record, expected = found
        for array in self.document.of_patches if arrays is None else arrays:
            chunks = array.chunks(index)
            try:
                same = self.arrays.checksums(array, chunks) == expected.get(array.name, "")
            except ValueError as error:
                raise DamageError(str(error)) from error
            if not same:
                how = "gone" if self.arrays.is_missing(array, chunks) else "not those of its record"
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
                            _ = self.arrays.opened(array.name)[array.window(index)]
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
        array, stored = self.document.arrays[name], self.arrays.opened(name)
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
            for name, each, most in zip(("row", "column"), index, self.shape, strict=True)
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
        layers = {name: _layer(name, values, shape) for name, values in layers.items()}

        folder = self.folder((row, column))
        check_own(self.path, folder)
        # Remove the old record first, so that it never stands beside pixels of the new patch.
        if (folder / "zarr.json").exists():
            (folder / "zarr.json").unlink()
            sync_folder(folder)
        with_levels = {name: layers[name] for name in document.layers}
        finest = {"pixels": pixels, "amplitude": np.abs(pixels), **with_levels}
        levels = pyramid(finest, document.levels.of_patches, document.window)
        levels[1] = finest | layers
        for array in document.of_patches:
            values = values_of(levels[array.factor], array.kind)
            self.arrays.write(array.name, array.window((row, column)), values)
        checksums = {
            array.name: self.arrays.checksums(array, array.chunks((row, column)))
            for array in document.of_patches
        }
        write_attributes(folder, record.attributes(checksums))


def stamp_of(path: Path) -> _Stamp:
    """Return what tells a file from another that has replaced it."""
    status = path.stat()
    return status.st_ino, status.st_mtime_ns, status.st_size


def _words(array: StoredArray) -> str:
    """Return what an array has of a patch, in words."""
    if array.name == "pixels":
        return "pixels"
    return "amplitudes in dB" if array.name == IN_DB else f"values of {array.name}"


def _layer(name: str, values: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return a layer of a patch as float32; raise TypeError or ValueError unless it is one."""
    validate.instance(name, values, np.ndarray)
    if values.dtype.kind != "f" or values.shape != shape or np.isinf(values).any():
        allowed = f"have real numbers of shape {shape}, finite or NaN"
        raise ArgumentError("layers", allowed, f"{validate.shown(values)} for {name}")
    return values.astype(np.float32)
