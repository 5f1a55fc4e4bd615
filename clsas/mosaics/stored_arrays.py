"""Arrays of a store, read window by window and compared with the records of their patches."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.extras import needed
from clsas.mosaics.documents import DamageError, read_document
from clsas.mosaics.levels import PixelArray, mosaic_arrays, patch_arrays
from clsas.mosaics.patch_files import PatchFiles
from clsas.mosaics.record import PatchIndex, describe_damage

if TYPE_CHECKING:
    import zarr

REPAIR = "; run `clsas.mosaic` with the same inputs to repair it"
"""End of messages about damage."""


@dataclass(frozen=True)
class StoredArrays:
    """Pixels and levels of a store.

    Attributes
    ----------
    path : Path
        Folder of the store.
    """

    path: Path

    @cached_property
    def files(self) -> PatchFiles:
        """The files that are written with each patch."""
        return PatchFiles(self.path, tuple(patch_arrays(read_document(self.path))))

    @cached_property
    def of_mosaic(self) -> list[PixelArray]:
        """The levels that mix patches."""
        return mosaic_arrays(read_document(self.path))

    @cached_property
    def pixels(self) -> zarr.Array:
        """Pixels on disk, complex64 [rows, columns]; raise ValueError if they are damaged."""
        return self._open("pixels")

    def opened(self, array: PixelArray) -> zarr.Array:
        """Return an array on disk; raise ValueError if its metadata are damaged."""
        return self.pixels if array.name == "pixels" else self._open(array.name)

    def named(self, name: str) -> PixelArray:
        """Return the array with a name, which must exist."""
        return next(array for array in (*self.files.arrays, *self.of_mosaic) if array.name == name)

    def read(self, array: PixelArray, rows: slice, columns: slice) -> NDArray:
        """Return a window of an array.

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
        stored = self.opened(array)
        requested = (
            len(range(n)[part]) for n, part in zip(stored.shape, (rows, columns), strict=True)
        )
        validate.memory("the mosaic", stored.dtype.itemsize * math.prod(requested))
        patches = list(array.touched(rows, columns)) if array in self.files.arrays else []
        try:
            zarr_arrays().check_metadata(self.path, read_document(self.path))
            for index in patches:
                self.files.record(index, [array])
            values = np.asarray(stored[rows, columns])
        except ValueError as error:
            found = self.damage([array], patches)
            reason = describe_damage(found) if found else f"{array.name}: {error}"
            if not found and array.name == "pixels":
                reason = str(error)
            raise ValueError(f"{self.path} is damaged: {reason}{REPAIR}") from error
        if not (np.isfinite(values) | (array.has_gaps & np.isnan(values))).all():
            raise ValueError(
                f"{self.path} must have finite numbers, but its {array.name} contain NaN or "
                "infinity, which clsas does not write"
            )
        return values

    def damage(
        self,
        arrays: Sequence[PixelArray],
        indices: Sequence[PatchIndex],
        progress: Callable[[int, int], object] | None = None,
    ) -> dict[PatchIndex, str]:
        """Read the parts of arrays that belong to patches; return the reasons for damaged ones."""
        found = {}
        for done, index in enumerate(indices, 1):
            try:
                self.files.verify(index, self.opened, arrays)
            except DamageError as error:
                found[index] = str(error)
            if progress is not None:
                progress(done, len(indices))
        return found

    def _open(self, name: str) -> zarr.Array:
        try:
            return zarr_arrays().open_array(self.path, read_document(self.path), name)
        except DamageError as error:
            raise ValueError(f"{self.path} is damaged: {name}: {error}{REPAIR}") from error


def zarr_arrays() -> ModuleType:
    """Return the module that needs Zarr."""
    with needed("stores of mosaics"):
        from clsas.mosaics import arrays
    return arrays
