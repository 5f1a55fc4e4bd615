"""Mosaics in Zarr stores: pixels and levels in chunks that belong to one patch, and its record.

docs/mosaic.md describes the layout. A patch is finished once it has a record, which is written
after its pixels and levels. All of them have checksums, and `Store.write` returns once they are on
the disk.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.extras import needed
from clsas.engine.data.grid import Grid, without_heights
from clsas.engine.data.image import Image
from clsas.engine.data.validate import ArgumentError
from clsas.interferometry.refinement import filled
from clsas.interferometry.result import Heights
from clsas.mosaics.document import (
    GROUP,
    REPAIR,
    DamageError,
    Document,
    MosaicCertificate,
    OtherInputsError,
    PatchIndex,
    Record,
    check_inputs,
    check_place,
    describe_arrays,
    describe_damage,
    differences,
    is_there,
    stamp_of,
)
from clsas.mosaics.levels import COARSEST_SIDE, LAYERS, LEVELS, SHADOWED, level_shape
from clsas.mosaics.pyramid import coarser, reduced, step_of

if TYPE_CHECKING:
    import zarr

    from clsas.mosaics.store_files import StoreFiles

_READ = 2048  # pixels along a side that are read at once; a plain choice
_AMPLITUDE = "amplitude"
_HEIGHTS_BYTES = 100  # per pixel of `Heights`: eight numbers and their copies


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
        _store_files()
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
        _ = store.document
        return store

    @property
    def document(self) -> Document:
        """What the mosaic was made with.

        Raises
        ------
        ValueError
            If the path contains something else, a mosaic of another version, or a damaged one.
        """
        return self._files.document

    @property
    def patch_shape(self) -> tuple[int, int] | None:
        """Number of pixels of a patch, (rows, columns), or None if there is no mosaic yet."""
        if not is_there(self.path):
            return None
        return self.document.patch_shape

    @property
    def pixels(self) -> zarr.Array:
        """Pixels on disk, complex64 [rows, columns]. Zarr verifies their checksums on reading."""
        return self._files.opened("pixels")

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the arrays that `read_layer` can read, empty unless the mosaic has heights."""
        return (*self.document.layers, *self.document.shadowed)

    @property
    def levels(self) -> tuple[int, ...]:
        """Factors of the levels that `read_level` can read, ascending, such as (2, 4, 8).

        Empty for a mosaic that fits on a screen. Levels that mix patches are missing until a run
        has finished all patches.
        """
        levels = self.document.levels
        if levels.of_mosaic and self._files.levels_are_current():
            return levels.factors
        return tuple(factor for factor in levels.of_patches if factor > 1)

    @property
    def grid(self) -> Grid:
        """Grid of the pixels.

        Raises
        ------
        ValueError
            If the mosaic has arbitrary points, which are not stored, or if heights are damaged.
        """
        try:
            grid = self._files.grid()
        except DamageError as error:
            raise ValueError(f"{self.path} is damaged: height: {error}{REPAIR}") from error
        if grid is None:
            raise ValueError(
                f"{self.path} is a mosaic of arbitrary points, whose grid is not stored"
            )
        return grid

    def array_damage(self) -> dict[str, str]:
        """Return the arrays whose metadata, coordinates or heights differ from what was written.

        Levels that mix patches, which `damage` does not read, are read here.

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
        return self._files.level_damage() | self._files.array_damage()

    def begin(
        self,
        inputs: dict[str, Any],
        grid: Grid,
        patch_shape: tuple[int, int],
        window_shape: tuple[int, int] | None = None,
    ) -> None:
        """Create the store, or check that the one at the path was made with the same inputs.

        Parameters
        ----------
        inputs : dict
            Inputs of the mosaic: digests of its parts, its grid and its request.
        grid : Grid
            Grid of the mosaic.
        patch_shape : (rows, columns)
            Number of pixels of a patch.
        window_shape : (rows, columns), optional
            Pixels of the window behind each height, for a mosaic of heights.

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
        validate.instance("grid", grid, Grid)
        check_inputs(inputs, grid.shape)
        patch_shape = validate.sides("patch_shape", patch_shape)
        if window_shape is not None:
            window_shape = validate.sides("window_shape", window_shape)
        check_place(self.path)
        if not is_there(self.path):
            validate.memory("a patch of pixels", 2 * 8 * math.prod(patch_shape))  # complex64
            plane = None if grid.points_m is not None else without_heights(grid)
            has_height = grid.height_m is not None
            document = Document(inputs, patch_shape, plane, has_height, window_shape, {})
            _store_files().create(self.path, document, grid)
        if found := differences(self.document, inputs, patch_shape):
            ways = "choose another path or repeat the inputs"
            if not any((self.path / GROUP).glob("*/zarr.json")):
                ways += ", or delete the store: it has no finished patch"
            raise OtherInputsError(
                f"{self.path} was made with other inputs: {'; '.join(found)}; {ways}"
            )
        if repaired := self._files.repair(grid):
            validate.warn(
                f"{self.path} was damaged and has been repaired: {describe_arrays(repaired)}"
            )
        if damaged := self._files.level_damage():
            # Without their record, the run computes them again when all patches are finished.
            (self.path / LEVELS / "zarr.json").unlink()
            validate.warn(
                f"{self.path} was damaged; these levels are computed again: "
                f"{describe_arrays(damaged)}"
            )
        self.grow(inputs)

    def grow(self, inputs: dict[str, Any]) -> None:
        """Store the inputs of a survey to which files have been added.

        Raises
        ------
        TypeError, ValueError
            If `inputs` are not those of a mosaic on the store's grid.
        """
        document = self.document
        check_inputs(inputs, document.shape)
        if document.inputs != inputs:
            replace(document, inputs=inputs).write(self.path)

    def records(self) -> dict[PatchIndex, Record]:
        """Return the records of all finished patches, by row and column.

        Patches are left out if their record is damaged, or a checksum behind their pixels or their
        part of the levels. The values themselves are not read; `damage` reads them too.
        """
        found = {}
        files = self._files
        for index in files.indices():
            try:
                record = files.record(index)
            except DamageError:
                continue
            if record is not None:
                found[index] = record
        return found

    def certificate(self) -> MosaicCertificate | None:
        """Return the measured error of the whole and of the patches; None if none was measured."""
        return MosaicCertificate.of(self.records())

    def undamaged_records(self) -> dict[PatchIndex, Record]:
        """Return the records of intact patches after reading all; warn of damaged ones."""
        damage = self.damage()
        if damage:
            validate.warn(
                f"{self.path} is damaged; these patches are formed again: {describe_damage(damage)}"
            )
        return {index: record for index, record in self.records().items() if index not in damage}

    def damage(self, progress: Callable[[int, int], object] | None = None) -> dict[PatchIndex, str]:
        """Read every finished patch, and return those that are damaged.

        Parameters
        ----------
        progress : callable, optional
            Called as progress(patches read so far, number of patches).

        Returns
        -------
        dict of (row, column) to str
            Reason for each damaged patch, such as "its pixels do not match their checksum".

        Raises
        ------
        OSError
            If a file cannot be read.
        """
        validate.progress(progress)
        files = self._files
        return files.damage(files.indices(), progress=progress)

    def write(
        self,
        row: int,
        column: int,
        rows: slice,
        columns: slice,
        pixels: NDArray[np.complex64],
        record: Record,
        layers: Mapping[str, NDArray[np.float32]] = MappingProxyType({}),
    ) -> None:
        """Write a patch with its levels and then its record, and wait until they are on the disk.

        Any number of processes can write patches at once, since no two patches share a file.

        Parameters
        ----------
        row, column : int
            Index of the patch.
        rows, columns : slice
            Pixels of the mosaic that belong to the patch.
        pixels : complex64 [rows, columns]
        record : Record
        layers : dict of str to float32 [rows, columns]
            Heights and what belongs to them, by the names of `layers`; NaN where there is none.

        Raises
        ------
        ValueError
            If `rows` or `columns` are not those of the patch, or `layers` not those of the store.
        OSError
            If the disk is full or the store is not writable.
        """
        self._files.write((row, column), (rows, columns), pixels, record, layers)

    def complete_levels(self, progress: Callable[[int, int], object] | None = None) -> bool:
        """Compute the levels that mix patches, unless they already are those of the patches.

        A run does so when all patches are finished. Only one process may do so at a time.

        Parameters
        ----------
        progress : callable, optional
            Called as progress(chunks computed so far, number of chunks).

        Returns
        -------
        bool
            True if levels were computed.

        Raises
        ------
        ValueError
            If a patch is damaged; the message names it.
        OSError
            If the store cannot be read or written.
        """
        validate.progress(progress)
        files = self._files
        if not files.document.of_mosaic or files.levels_are_current():
            return False
        files.complete_levels(progress)
        return True

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
        return self._files.read("pixels", rows, columns)

    def read_layer(
        self,
        name: str,
        rows: slice = slice(None),
        columns: slice = slice(None),
        *,
        factor: int = 1,
    ) -> NDArray[np.float32]:
        """Return a window of a layer of a mosaic of heights, by default all of it.

        Parameters
        ----------
        name : str
            One of `layers`.
        rows, columns : slice
            Pixels of the mosaic, or of the level.
        factor : int
            1, or one of `levels`, whose values are means of the pixels that have one; `sd_m` is the
            standard deviation of the mean of the heights. Heights of shadows have no levels.

        Returns
        -------
        float32 [rows, columns]
            NaN where there is no value.

        Raises
        ------
        ValueError
            If there is no such layer or level, or a finished patch among the pixels is damaged.
        OSError
            If a file cannot be read.
        """
        if validate.text("name", name) not in self.layers:
            known = ", ".join(self.layers) or "none: it has no heights"
            raise ArgumentError("name", f"be that of a layer of {self.path} ({known})", repr(name))
        if validate.count("factor", factor) != 1:
            if name in SHADOWED:
                raise ArgumentError("factor", f"be 1 for {name}, which has no levels", str(factor))
            factor = self._checked_factor(factor)
        return self._files.read(f"{factor}x/{name}" if factor > 1 else name, rows, columns)

    def read_level(
        self,
        factor: int,
        rows: slice = slice(None),
        columns: slice = slice(None),
        *,
        coherent: bool = False,
    ) -> NDArray[np.float32] | NDArray[np.complex64]:
        """Return a window of a level, by default all of it.

        Parameters
        ----------
        factor : int
            One of `levels`: the pixels of the mosaic along each side of a pixel of the level.
        rows, columns : slice
            Pixels of the level.
        coherent : bool
            False for amplitudes, the root of the mean power of the pixels that are covered; True
            for the mean of the complex pixels.

        Returns
        -------
        float32 or complex64 [rows, columns]

        Raises
        ------
        ValueError
            If there is no such level, or a finished patch among the pixels is damaged.
        OSError
            If a file cannot be read.
        """
        factor = self._checked_factor(factor)
        validate.flag("coherent", coherent)
        return self._files.read(f"{factor}x/{'pixels' if coherent else 'amplitude'}", rows, columns)

    def image(self, rows: slice = slice(None), columns: slice = slice(None)) -> Image:
        """Return the pixels of a window, by default all, as an image.

        The image of a mosaic of heights is that of the first bank on the relief, as in `heights`.

        Raises
        ------
        ValueError
            If a finished patch among them is damaged, or the image does not fit into memory.
        OSError
            If a file cannot be read.
        """
        if self.layers:
            return self.heights(rows, columns).image
        window = self.grid.window(rows, columns)
        return Image(self.read(rows, columns), window)

    def heights(self, rows: slice = slice(None), columns: slice = slice(None)) -> Heights:
        """Return the heights in a window of a mosaic of heights, by default all.

        Heights of the relief outside the mask, where the image needs some, are those of the nearest
        valid pixel in the window.

        Raises
        ------
        ValueError
            If the mosaic is one of images, a finished patch in the window is damaged, or the
            heights do not fit into memory.
        OSError
            If a file cannot be read.
        """
        check_heights(self)
        plane = without_heights(self.grid.window(rows, columns))
        validate.memory("heights", _HEIGHTS_BYTES * plane.size)
        layers = {name: self.read_layer(name, rows, columns) for name in LAYERS}
        return self._heights(plane, self.read(rows, columns), layers)

    def sampled_heights(self, per_window: int = 6) -> Heights:
        """Return the heights of some pixels of every window of a mosaic of heights.

        Heights of neighbouring pixels share most of their windows, so that these contain nearly all
        that the mosaic shows, in less memory. They suffice for `pair_errors`.

        Parameters
        ----------
        per_window : int
            Largest number of pixels along each side of a window. With 3 instead of 6, the phase and
            the delay that `pair_errors` tells apart have twice the deviation.

        Raises
        ------
        ValueError
            If the mosaic is one of images, a finished patch is damaged, or the heights do not fit
            into memory.
        OSError
            If a file cannot be read.
        """
        validate.count("per_window", per_window)
        check_heights(self)
        assert self.document.window is not None  # the store has heights
        rows, columns = (
            slice(None, None, max(side // per_window, 1)) for side in self.document.window
        )
        return self.heights(rows, columns)

    def overview_heights(
        self,
        most: int = COARSEST_SIDE,
        rows: slice = slice(None),
        columns: slice = slice(None),
    ) -> Heights:
        """Return the heights at fewer pixels, each with the mean of those that it covers.

        Parameters
        ----------
        most : int
            Largest number of pixels along the longer side. The overview has the pixels of a level,
            2, 4, 8, ... times as far apart as those of the mosaic.
        rows, columns : slice
            Part of the mosaic, without steps; by default all of it.

        Raises
        ------
        ValueError
            If the mosaic is one of images, nothing is selected, or a finished patch is damaged.
        OSError
            If a file cannot be read.
        """
        validate.count("most", most)
        check_heights(self)
        grid, window = self.grid, self.document.window
        part = without_heights(grid.window(rows, columns))
        first, last = [], []
        for name, given, count in zip(
            ("rows", "columns"), (rows, columns), grid.shape, strict=True
        ):
            pixels = range(count)[validate.selection(name, given, ascending=True)]
            if pixels.step != 1:
                raise ArgumentError(name, "have no step for an overview", str(pixels.step))
            first.append(pixels.start)
            last.append(pixels.stop)
        factor = 1
        while math.ceil(max(part.shape) / factor) > most:
            factor *= 2
        if factor == 1:
            return self.heights(rows, columns)
        # A level serves if the part begins and ends with one of its pixels.
        finest = max(
            level
            for level in (1, *self.levels)
            if level <= factor
            and not any(start % level for start in first)
            and all(n % level == 0 or n == count for n, count in zip(last, grid.shape, strict=True))
        )
        read = self.read if finest == 1 else partial(self.read_level, finest)
        shape = level_shape(part.shape, factor)
        found = {name: np.empty(shape, np.float32) for name in (*LAYERS, _AMPLITUDE)}
        side = max(_READ * finest // factor, 1)
        for top, left in itertools.product(range(0, shape[0], side), range(0, shape[1], side)):
            down, across = (
                slice(
                    (begin + start * factor) // finest,
                    -(-min(begin + (start + side) * factor, end) // finest),
                )
                for start, begin, end in zip((top, left), first, last, strict=True)
            )
            block: dict[str, NDArray[Any]] = {
                name: self.read_layer(name, down, across, factor=finest) for name in LAYERS
            }
            block[_AMPLITUDE] = np.abs(read(down, across))
            level = finest
            while level < factor:
                level *= 2
                height, width = block[_AMPLITUDE].shape
                block = coarser(block, level, np.ones(height), np.ones(width), window)
            for name, values in block.items():
                found[name][top : top + side, left : left + side] = values
        # Pixels of a level lie in the middle of those that they cover.
        origin_m, row_step_m, column_step_m = part.vectors_m
        plane = Grid.oriented(
            origin_m + (factor - 1) / 2 * (row_step_m + column_step_m),
            factor * row_step_m,
            factor * column_step_m,
            shape,
            georeference=part.georeference,
        )
        return self._heights(plane, found.pop(_AMPLITUDE).astype(np.complex64), found)

    def _heights(
        self, plane: Grid, pixels: NDArray, layers: dict[str, NDArray[np.float32]]
    ) -> Heights:
        """Return heights of a plane's pixels, with the image on their relief."""
        values = {name: each.astype(np.float64) for name, each in layers.items()}
        mask = ~np.isnan(values["height_m"])
        # Patches that are not finished or not seen have neither coherence nor sensitivity.
        for name in ("coherence", "looks", "m_per_rad"):
            values[name] = np.nan_to_num(values[name])
        image = Image(pixels, plane.with_height(filled(values["height_m"], mask)))
        window_m = float(self.document.inputs["window_m"])
        return Heights(**values, mask=mask, image=image, window_m=window_m, certificate=None)

    def overview(
        self,
        most: int = COARSEST_SIDE,
        rows: slice = slice(None),
        columns: slice = slice(None),
    ) -> Image:
        """Return the mosaic at fewer pixels, each with the mean power of those that it covers.

        If the store has levels, the coarsest is read whose pixels make up those of the overview,
        which may then have up to a quarter fewer pixels along a side. Otherwise the pixels are
        read, about one patch at a time, so they may take more than memory. A height map becomes a
        plane.

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
                ("rows", "columns"), (rows, columns), self.document.shape, strict=True
            )
        ]
        part = self.grid.window(rows, columns)
        # Levels serve if the part has every pixel, and begins at a pixel of the level.
        dense = all(each.step == 1 for each in parts)
        usable = [
            factor
            for factor in (self.levels if dense else ())
            if all(each.start % factor == 0 for each in parts)
        ]
        step, factor = step_of(part.shape, most, usable)
        array = f"{factor}x/amplitude" if factor > 1 else "pixels"

        def read(*within: slice) -> NDArray[np.complex64] | NDArray[np.float32]:
            chosen = (whole[each] for whole, each in zip(parts, within, strict=True))
            return self._files.read(
                array,
                *(slice(e.start // factor, -(-e.stop // factor), e.step) for e in chosen),
            )

        rows_at_once, columns_at_once = (factor * side for side in self.document.patch_shape)
        return reduced(part, read, factor, (rows_at_once, columns_at_once), step)

    def _checked_factor(self, factor: int) -> int:
        """Return the factor of a level; raise ValueError if there is none."""
        factor = validate.count("factor", factor)
        if factor not in (found := self.levels):
            if damaged := self._files.level_damage():
                raise ValueError(f"{self.path} is damaged: {describe_arrays(damaged)}{REPAIR}")
            known = ", ".join(map(str, found)) or "none"
            raise ArgumentError(
                "factor", f"be that of a level of {self.path} ({known})", str(factor)
            )
        return factor

    @property
    def _files(self) -> StoreFiles:
        """Files of the store, opened again if the document has been replaced."""
        try:
            stamp = stamp_of(self.path / "zarr.json")
        except OSError:  # reading the document raises an error that says what is wrong
            return _store_files()(self.path, Document.read(self.path))
        return _opened(self.path, stamp)


@lru_cache(maxsize=4)
def _opened(path: Path, stamp: tuple[int, int, int]) -> StoreFiles:
    return _store_files()(path, Document.read(path))


def _store_files() -> type[StoreFiles]:
    """Return the class of the files of stores, which needs Zarr."""
    with needed("stores of mosaics"):
        from clsas.mosaics import store_files
    return store_files.StoreFiles


def check_heights(store: Store) -> None:
    """Raise ValueError if a store has no heights."""
    if not store.layers:
        raise ValueError(
            f"{store.path} must be a mosaic of heights, got one of images: `clsas.mosaic_heights` "
            "makes one of heights"
        )
