"""The Zarr store of a mosaic: its pixels in one array, one chunk and one record per patch.

docs/mosaic.md describes the layout. A patch is finished once its record is there, which is written
after its pixels; both are renamed into place, so that neither is ever half there.
"""

from __future__ import annotations

import errno
import json
import math
import os
import re
import shutil
import tempfile
import uuid
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsas import validate
from clsas.extras import install_command
from clsas.grid import Grid
from clsas.image import Image

if TYPE_CHECKING:
    import zarr

FORMAT = "clsas mosaic"
VERSION = 1

_OVERVIEW = 1024  # pixels along the longer side, at most


@dataclass(frozen=True)
class Record:
    """What is known about a finished patch.

    Attributes
    ----------
    channels : int
        Channels that may see it; with 0 the patch is empty: all zero.
    survey_channels : int
        Channels that the survey had when it was formed.
    missing_channels : int
        Those of `channels` without samples.
    gap_m : float
        Longest way between pings that see it where that is a gap (three usual steps), else 0.
    predicted_error_db : float or None
        Relative rms error expected against the exact image; None for an empty patch.
    predicted_seconds, plan_seconds, read_seconds, seconds : float
        Expected for imaging; taken by planning and by reading; and by all of it.
    memory_bytes : int
        What it was planned to take.
    device, driver : str
        Where it was formed.
    plan : dict or None
        The plan, as `clsas.Plan.from_json` reads it, its beam without directions; None for an exact
        image or an empty patch.
    has_pixels : bool
        Whether any pixel is not 0.
    """

    channels: int
    survey_channels: int
    missing_channels: int = 0
    gap_m: float = 0.0
    predicted_error_db: float | None = None
    predicted_seconds: float = 0.0
    plan_seconds: float = 0.0
    read_seconds: float = 0.0
    seconds: float = 0.0
    memory_bytes: int = 0
    device: str = ""
    driver: str = ""
    plan: dict[str, Any] | None = None
    has_pixels: bool = False

    @property
    def is_empty(self) -> bool:
        """Whether no channel contributes, so that all pixels are zero."""
        return self.channels == self.missing_channels

    @property
    def is_whole(self) -> bool:
        """Whether every number is one, as a record from a file may not have them."""
        allowed = {"int": (int,), "float": (int, float), "float | None": (int, float, type(None))}
        numbers = [
            (getattr(self, field.name), allowed[str(field.type)])
            for field in fields(self)
            if field.type in allowed
        ]
        return all(
            type(value) in kinds and (value is None or math.isfinite(value))
            for value, kinds in numbers
        )

    @property
    def flags(self) -> tuple[str, ...]:
        """What a user should know, in words; nothing if all is well."""
        found = []
        if not self.channels:
            found.append("empty: in no channel's beam and range")
        elif self.missing_channels:
            found.append(f"{self.missing_channels} of {self.channels} channels have no samples")
        if self.gap_m:
            found.append(f"a gap of {self.gap_m:.3g} m between pings")
        return tuple(found)


@dataclass(frozen=True)
class Store:
    """A mosaic on disk.

    Attributes
    ----------
    path : Path
    """

    path: Path

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
        """The pixels, complex64 [rows, columns], on disk."""
        return self._array("pixels", "r")

    @property
    def grid(self) -> Grid:
        """Where the pixels lie.

        Raises
        ------
        ValueError
            If the mosaic is not of a plane or height map, whose grid alone is stored.
        """
        stored = self._attributes()["grid"]
        if stored is None:
            raise ValueError(f"{self.path} is a mosaic of points, whose grid it does not hold")
        shape = tuple(self.pixels.shape)
        grid = Grid.oriented(**stored, shape=shape)
        height = self.path / "height"
        if not height.exists():
            return grid
        return grid.with_height(_zarr().open_array(height, mode="r")[:])

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
        if differences := self._differences(inputs, patch_shape):
            ways = "give it another path or the same inputs"
            if not self.records():
                ways += ", or delete it: no patch of it was finished"
            raise ValueError(
                f"{self.path} was made with other inputs: {'; '.join(differences)}; {ways}"
            )
        with tempfile.TemporaryFile(dir=self.path):
            pass  # raises where it cannot be written
        pixels = self.pixels
        if (pixels.shape, pixels.chunks) != (grid.shape, patch_shape):
            raise ValueError(f"{self.path} is damaged: its pixels are not those of its grid")
        self.grow(inputs)

    def grow(self, inputs: dict[str, Any]) -> None:
        """Keep the inputs of a survey that has grown."""
        if self._attributes()["inputs"] != inputs:
            _zarr().open_group(self.path, mode="r+").attrs["inputs"] = inputs

    def _create(self, inputs: dict[str, Any], grid: Grid, patch_shape: tuple[int, int]) -> None:
        """Create the store, whole or not at all."""
        if not self.path.parent.is_dir():
            raise FileNotFoundError(2, "there is no such folder", str(self.path.parent))
        temporary = self.path.with_name(f".{uuid.uuid4().hex}.part")
        try:
            self._fill(temporary, inputs, grid, patch_shape)
            try:
                os.rename(temporary, self.path)
            except OSError as error:
                # Another process was first: what it made is checked.
                if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                    raise
        finally:
            shutil.rmtree(temporary, ignore_errors=True)

    @staticmethod
    def _fill(path: Path, inputs: dict[str, Any], grid: Grid, patch_shape: tuple[int, int]) -> None:
        root = _zarr().create_group(path)
        names = ("y", "x") if grid.has_axes else ("row", "column")
        root.create_array(
            "pixels",
            shape=grid.shape,
            dtype=np.complex64,
            chunks=patch_shape,
            compressors=None,  # noise does not compress
            fill_value=0,
            dimension_names=names,
        )
        plane = None
        if grid.points_m is None:
            steps = ("origin_m", "row_step_m", "column_step_m")
            plane = {name: getattr(grid, name).tolist() for name in steps}
        if grid.has_axes:
            for name, axis in zip(("x", "y"), grid.axes_m, strict=True):
                root.create_array(
                    name, data=axis, dimension_names=(name,), attributes={"units": "m"}
                )
        if grid.height_m is not None:
            root.create_array("height", data=grid.height_m, dimension_names=names)
        root.create_group("patches")
        root.attrs.update(
            format=FORMAT,
            version=VERSION,
            patch_shape=list(patch_shape),
            grid=plane,
            inputs=inputs,
        )

    def records(self) -> dict[tuple[int, int], Record]:
        """Return the records of all finished patches, by row and column.

        A record whose pixels are not there, or not all, does not count.
        """
        found = {}
        known = {field.name for field in fields(Record)}
        pixels = self.pixels
        shape = [math.ceil(n / m) for n, m in zip(pixels.shape, pixels.chunks, strict=True)]
        folders = self.path / "patches"
        for folder in folders.iterdir() if folders.is_dir() else ():
            if not (name := re.fullmatch(r"(\d+)\.(\d+)", folder.name)):
                continue
            place = int(name[1]), int(name[2])
            if place[0] >= shape[0] or place[1] >= shape[1]:
                continue
            try:
                stored = json.loads((folder / "zarr.json").read_text())["attributes"]
                record = Record(**{k: v for k, v in stored.items() if k in known})
            except (OSError, ValueError, KeyError, TypeError):
                continue  # cut off while it was written
            if not record.is_whole:
                continue
            chunk = self.path / "pixels" / "c" / name[1] / name[2]
            # Zarr leaves out a chunk that is all zero.
            size = chunk.stat().st_size if chunk.exists() else 0
            if size == 8 * math.prod(pixels.chunks) or not (size or record.has_pixels):
                found[place] = record
        return dict(sorted(found.items()))

    def write(
        self,
        row: int,
        column: int,
        rows: slice,
        columns: slice,
        pixels: NDArray[np.complex64],
        record: Record,
    ) -> None:
        """Write a patch and then its record.

        Raises
        ------
        OSError
            If the disk is full or the store not writable.
        """
        self._array("pixels", "r+")[rows, columns] = pixels
        _zarr().create_group(
            self.path / "patches" / f"{row}.{column}", attributes=asdict(record), overwrite=True
        )

    def image(self, rows: slice = slice(None), columns: slice = slice(None)) -> Image:
        """Return some of the pixels, all unless told otherwise, as an image."""
        window = self.grid.window(rows, columns)
        validate.memory("the mosaic", 8 * window.size)
        return Image(self.pixels[rows, columns], window)

    def overview(self, most: int = _OVERVIEW) -> Image:
        """Return the mosaic at fewer pixels, each the root of the mean power of those it covers."""
        validate.count("most", most)
        grid, (height, width) = self.grid, self.pixels.chunks
        step = math.ceil(max(grid.shape) / most)
        shape = tuple(n // step or 1 for n in grid.shape)
        step = [min(step, n) for n in grid.shape]
        power = np.zeros(shape)
        # Bands of whole patches and whole pixels of the overview.
        band = max(height // step[0], 1)
        for first in range(0, shape[0], band):
            last = min(first + band, shape[0])
            for start in range(0, shape[1], max(width // step[1], 1)):
                stop = min(start + max(width // step[1], 1), shape[1])
                part = self.pixels[
                    first * step[0] : last * step[0], start * step[1] : stop * step[1]
                ]
                blocks = (np.abs(part) ** 2).reshape(last - first, step[0], stop - start, step[1])
                power[first:last, start:stop] = blocks.mean(axis=(1, 3))
        middle = sum(
            (n - 1) / 2 * each
            for n, each in zip(step, (grid.row_step_m, grid.column_step_m), strict=True)
        )
        coarse = Grid.oriented(
            grid.origin_m + middle, grid.row_step_m * step[0], grid.column_step_m * step[1], shape
        )
        return Image(np.sqrt(power).astype(np.complex64), coarse)

    def _array(self, name: str, mode: str) -> zarr.Array:
        try:
            return _zarr().open_array(self.path / name, mode=mode)
        except (LookupError, OSError, ValueError, TypeError) as error:
            raise ValueError(f"{self.path} is damaged: {name} cannot be read: {error}") from error

    def _is_there(self) -> bool:
        """Return whether the path holds anything."""
        return self.path.exists() and not (self.path.is_dir() and not any(self.path.iterdir()))

    def _attributes(self) -> dict[str, Any]:
        """Return what is known about the mosaic as a whole; raises ValueError if it is none."""
        try:
            attributes = json.loads((self.path / "zarr.json").read_text())["attributes"]
            ours = attributes["format"] == FORMAT
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise ValueError(f"{self.path} exists and is not a mosaic of clsas") from error
        if not ours:
            raise ValueError(f"{self.path} exists and is not a mosaic of clsas")
        if attributes.get("version") != VERSION:
            raise ValueError(
                f"{self.path} is a mosaic of version {attributes.get('version')}, this clsas works "
                f"with version {VERSION}: give it another path"
            )
        shape, inputs = attributes.get("patch_shape"), attributes.get("inputs")
        whole = isinstance(inputs, dict) and isinstance(inputs.get("parts"), list)
        whole = whole and isinstance(shape, list) and [type(n) for n in shape] == [int, int]
        if not whole:
            raise ValueError(f"{self.path} is damaged: its attributes are not those of a mosaic")
        return attributes

    def _differences(self, given: dict[str, Any], patch_shape: tuple[int, int]) -> list[str]:
        """Return in what the inputs that the store was made with differ from those given."""
        attributes, differences = self._attributes(), []
        stored = attributes["inputs"]
        if attributes["patch_shape"] != list(patch_shape):
            mine, theirs = ("{} x {}".format(*s) for s in (attributes["patch_shape"], patch_shape))
            differences.append(f"patches of {mine} pixels there, of {theirs} given")
        for name in given:
            mine, theirs = stored.get(name), given[name]
            if name == "parts":
                if theirs[: len(mine)] != mine:
                    differences.append("the range lines are others")
            elif name == "grid" and mine != theirs:
                if stored.get("pixels") == given["pixels"]:
                    differences.append("the grid lies elsewhere")
            elif isinstance(mine, dict) and isinstance(theirs, dict):
                differences += [
                    f"{name}'s {key} is {mine.get(key)} there, {theirs[key]} given"
                    for key in theirs
                    if mine.get(key) != theirs[key]
                ]
            elif mine != theirs:
                differences.append(f"{name} is {mine} there, {theirs} given")
        return differences


def _zarr() -> Any:
    try:
        import zarr
    except ImportError:
        raise ImportError(f"stores of mosaics need Zarr: {install_command('mosaic')}") from None
    return zarr
