"""Arrays of a store: create, open after a check of the metadata, compare and repair them."""

from __future__ import annotations

import math
import os
import uuid
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import Crc32cCodec

from clsas.engine.data import validate
from clsas.engine.data.atomic import creating, make_folders, staging, sync_folder
from clsas.engine.data.digests import grid_digest, with_digest
from clsas.engine.data.grid import Grid
from clsas.mosaics.documents import (
    DIGESTS,
    FORMAT,
    VECTORS,
    VERSION,
    DamageError,
    check_own,
    plane_of,
    read_document,
    write_attributes,
)
from clsas.mosaics.durable import DurableStore
from clsas.mosaics.levels import (
    CHUNK_SHAPE,
    IN_DB,
    LAYERS,
    LEVELS,
    SHADOWED,
    WINDOW,
    PixelArray,
    chunk_side,
    levels_of,
    mosaic_arrays,
    multiscales,
    patch_arrays,
)
from clsas.mosaics.metadata import (
    Checked,
    Form,
    axes_of,
    check_group,
    checked,
    forms,
    groups_of,
    has_height,
)

_COPIES = 3  # copies of coordinates or heights in memory: Zarr's, the grid's, one for the digest


def create_store(
    path: Path,
    inputs: dict[str, Any],
    grid: Grid,
    patch_shape: tuple[int, int],
    window: tuple[int, int] | None,
) -> None:
    """Create the store of a mosaic in one step, so that a killed process leaves no partial store.

    Raises
    ------
    ValueError
        If a patch does not fit in memory.
    OSError
        If the parent folder cannot be written.
    """
    validate.memory("a patch of pixels", 2 * 8 * math.prod(patch_shape))  # complex64
    plane = None
    if grid.points_m is None:
        plane = {name: getattr(grid, name).tolist() for name in VECTORS}
    levels = levels_of(grid.shape, patch_shape)
    attributes = {
        "format": FORMAT,
        "version": VERSION,
        "patch_shape": list(patch_shape),
        CHUNK_SHAPE: list(map(chunk_side, patch_shape, grid.shape)),
        LEVELS: levels.json(),
        "grid": plane,
        "inputs": inputs,
    } | multiscales(levels)
    if window is not None:
        attributes[WINDOW] = list(window)
    with creating(path) as temporary:
        _create_arrays(temporary, grid, attributes)
        digests = _digests(temporary, attributes, grid.height_m is not None)
        write_attributes(temporary, with_digest(attributes | {DIGESTS: digests}))


def open_array(path: Path, attributes: dict[str, Any], name: str) -> zarr.Array:
    """Open an array of a store for reading.

    Raises
    ------
    DamageError
        If the metadata are not those of a mosaic, or differ from those that were written.
    """
    return _opened(path, attributes, name, read_only=True)


def write_values(
    path: Path,
    attributes: dict[str, Any],
    name: str,
    window: tuple[slice, slice],
    values: NDArray[np.complex64] | NDArray[np.float32],
) -> None:
    """Write whole chunks of an array. Zarr writes no chunk that has only the fill value."""
    _opened(path, attributes, name, read_only=False)[window] = values


def check_metadata(path: Path, attributes: dict[str, Any]) -> None:
    """Raise a DamageError that names the array if the metadata of any array are damaged."""
    for name, form in forms(attributes, has_height(attributes)).items():
        try:
            _checked(path, attributes, name, form)
        except DamageError as error:
            raise DamageError(f"{name}: {error}") from error


def compared(
    path: Path, attributes: dict[str, Any], with_height: bool
) -> tuple[Grid | None, dict[str, str]]:
    """Compare metadata, coordinates and heights of a store with what was written.

    Returns
    -------
    grid : Grid or None
        The store's grid, with its heights if they are intact; None for arbitrary points.
    damage : dict of str to str
        Reason for each damaged array or group, by its name.
    """
    grid, found = plane_of(attributes), {}
    axes = axes_of(attributes)
    for name, form in forms(attributes, with_height).items():
        try:
            _checked(path, attributes, name, form)
            if name in axes and grid is not None:
                values_m = _values(path, attributes, name)
                if not np.array_equal(values_m, axes[name].values_m(grid)):
                    raise DamageError("its values differ from those of the grid")
            if name == "height" and grid is not None:
                grid = _raised(grid, _values(path, attributes, name), attributes)
        except DamageError as error:
            found[name] = str(error)
    for name in groups_of(attributes):
        try:
            check_group(path, name)
        except DamageError as error:
            found[name] = str(error)
    return grid, found


def repair(path: Path, grid: Grid) -> dict[str, str]:
    """Rewrite damaged metadata, coordinates and heights.

    Parameters
    ----------
    path : Path
        The store.
    grid : Grid
        The grid that the store was made with.

    Returns
    -------
    dict of str to str
        Reason for each array or group that was damaged, by its name.
    """
    attributes = read_document(path)
    with_height = grid.height_m is not None
    _, found = compared(path, attributes, with_height)
    if found:
        axes = {*axes_of(attributes), "height"}
        with staging(path) as temporary:
            new, old = temporary / "new", temporary / "old"
            new.mkdir()
            old.mkdir()
            _create_arrays(new, grid, attributes)
            for name in found:
                # Replace the metadata alone, since the chunks of pixels and the records must stay.
                _exchange(path, name if name in axes else f"{name}/zarr.json", new, old)
        digests = _digests(path, attributes, with_height)
        write_attributes(path, with_digest(attributes | {DIGESTS: digests}))
    return found


def _exchange(path: Path, name: str, new: Path, old: Path) -> None:
    """Move a part of a store into `old`, and its replacement from `new` to its place."""
    target = path / name
    check_own(path, target.parent)
    make_folders(target.parent)
    if os.path.lexists(target):
        target.rename(old / uuid.uuid4().hex)
    (new / name).rename(target)
    sync_folder(target.parent)


def _digests(path: Path, attributes: dict[str, Any], with_height: bool) -> dict[str, str]:
    return {
        name: checked(path, name, form, None).digest
        for name, form in forms(attributes, with_height).items()
    }


def _checked(path: Path, attributes: dict[str, Any], name: str, form: Form) -> Checked:
    """Return the metadata of an array; raise DamageError if they are damaged."""
    return checked(path, name, form, attributes[DIGESTS].get(name))


def _opened(path: Path, attributes: dict[str, Any], name: str, *, read_only: bool) -> zarr.Array:
    form = forms(attributes, name == "height")[name]
    metadata = _checked(path, attributes, name, form)
    validate.memory(f"a chunk of {name} in {path}", 2 * metadata.chunk_bytes)
    files = DurableStore.of_array(path, name, metadata, read_only=read_only)
    return zarr.open_array(files, path=name, mode="r" if read_only else "r+", zarr_format=3)


def _values(path: Path, attributes: dict[str, Any], name: str) -> NDArray[np.float64]:
    """Return the values of coordinates or heights; raise DamageError if they cannot be read."""
    array = open_array(path, attributes, name)
    validate.memory(f"{name} in {path}", _COPIES * 8 * math.prod(array.shape))
    try:
        return np.asarray(array[...])
    except ValueError as error:  # Zarr's message about a checksum
        raise DamageError("its values do not match their checksum") from error


def _raised(plane: Grid, height_m: NDArray[np.float64], attributes: dict[str, Any]) -> Grid:
    """Return a grid with heights; raise DamageError if they differ from what was written."""
    try:
        grid = plane.with_height(height_m)
    except ValueError as error:
        raise DamageError(f"its values are not heights: {error}") from error
    if grid_digest(grid) != attributes["inputs"].get("grid"):
        raise DamageError("its values differ from those that were written")
    return grid


def _map_of(grid: Grid | None) -> dict[str, Any]:
    """Return the map projection in the convention of GDAL, if x and y are easting and northing."""
    place = None if grid is None else grid.georeference
    if grid is None or place is None or place.crs is None or not grid.has_axes:
        return {}
    authority, _, code = place.crs.partition(":")
    if authority == "EPSG" and code.isdigit():
        return {"_CRS": {"url": f"http://www.opengis.net/def/crs/EPSG/0/{code}"}}
    return {"_CRS": {"wkt": place.crs}} if "[" in place.crs else {}


def _meaning(array: PixelArray) -> dict[str, Any]:
    """Return unit and meaning of the numbers of an array, as xarray shows them."""
    if array.name == IN_DB:
        return {"units": "dB", "long_name": "amplitude"}
    known = LAYERS | SHADOWED
    if array.kind not in known:
        return {}
    units, meaning = known[array.kind]
    return {"units": units, "long_name": meaning} if units else {"long_name": meaning}


def _create_arrays(path: Path, grid: Grid | None, attributes: dict[str, Any]) -> None:
    """Create the groups and arrays of a mosaic: pixels, all zero, levels, coordinates, heights."""
    files = DurableStore(path)
    for name in groups_of(attributes):
        write_attributes(path / name, {})
    # Noise does not compress, so the only codec is a checksum behind every chunk.
    checksum = Crc32cCodec()
    names = ("y", "x") if grid is not None and grid.has_axes else ("row", "column")
    first, *others = [*patch_arrays(attributes), *mosaic_arrays(attributes)]
    zarr.create_array(
        files,
        name="pixels",
        shape=first.shape,
        dtype=np.complex64,
        chunks=first.chunk_shape,
        compressors=checksum,
        fill_value=0,
        dimension_names=names,
        attributes=_map_of(grid),
    )
    for array in others:
        in_db = array.name == IN_DB
        zarr.create_array(
            files,
            name=array.name,
            shape=array.shape,
            dtype=array.data_type,
            chunks=array.chunk_shape,
            compressors=checksum,
            fill_value=array.fill_value,
            # Programs such as xarray demand one length of every dimension of a group.
            dimension_names=[f"overview_{n}" for n in names]
            if in_db and array.factor > 1
            else names,
            attributes=_meaning(array),
        )
    coordinates: dict[str, tuple[tuple[str, ...], NDArray[np.float64]]] = {}
    if grid is not None:
        coordinates |= {
            name: ((axis.dimension,), axis.values_m(grid))
            for name, axis in axes_of(attributes).items()
        }
    if grid is not None and grid.height_m is not None:
        coordinates["height"] = names, grid.height_m
    for name, (dimensions, values) in coordinates.items():
        zarr.create_array(
            files,
            name=name,
            data=values,
            compressors=checksum,
            dimension_names=dimensions,
            attributes={"units": "m"},
        )
