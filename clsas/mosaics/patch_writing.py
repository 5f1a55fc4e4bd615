"""Write a patch into a store: its pixels, its part of the levels, and last its record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.atomic import sync_folder
from clsas.engine.data.validate import ArgumentError
from clsas.mosaics.documents import check_own, read_document, write_attributes
from clsas.mosaics.levels import WINDOW, layers_of, shadowed_of, stored_levels
from clsas.mosaics.pyramid import Level, layer_levels, levels
from clsas.mosaics.record import PatchIndex, Record
from clsas.mosaics.stored_arrays import StoredArrays, zarr_arrays


@dataclass(frozen=True, eq=False)
class PatchValues:
    """Pixels, layers and record of a patch, as a store keeps them.

    Attributes
    ----------
    index : (row, column)
    pixels : complex64 [rows, columns]
    layers : dict of str to float32 [rows, columns]
    record : Record
    """

    index: PatchIndex
    pixels: NDArray[np.complex64]
    layers: dict[str, NDArray[np.float32]]
    record: Record

    @classmethod
    def checked(
        cls,
        arrays: StoredArrays,
        index: PatchIndex,
        place: tuple[slice, slice],
        pixels: NDArray[np.complex64],
        record: Record,
        layers: Mapping[str, NDArray[np.float32]],
    ) -> Self:
        """Return values of a patch after checking that they fit the arrays of a store.

        Raises
        ------
        TypeError, ValueError
            If there is no such patch, `place` is not its place, or the values are not those of the
            store.
        """
        row, column = (
            validate.count(name, each, least=0, most=most - 1)
            for name, each, most in zip(("row", "column"), index, arrays.files.shape, strict=True)
        )
        own = arrays.files.pixels.window((row, column))
        for name, given, part, count in zip(
            ("rows", "columns"), place, own, arrays.files.pixels.shape, strict=True
        ):
            if range(count)[validate.selection(name, given, ascending=True)] != range(count)[part]:
                allowed = f"be {part.start}:{part.stop} for patch {row},{column}"
                raise ArgumentError(name, allowed, validate.shown(given))
        shape = tuple(part.stop - part.start for part in own)
        pixels = validate.array("pixels", pixels, np.complex64, shape)
        validate.instance("record", record, Record)
        validate.instance("layers", layers, Mapping)
        attributes = read_document(arrays.path)
        expected = (*layers_of(attributes), *shadowed_of(attributes))
        if set(layers) != set(expected):
            allowed = f"be {', '.join(expected) or 'left out'} for {arrays.path}"
            raise ArgumentError("layers", allowed, ", ".join(layers) or "none")
        known = {name: _layer(name, values, shape) for name, values in layers.items()}
        return cls((row, column), pixels, known, record)


def write_patch(arrays: StoredArrays, patch: PatchValues) -> None:
    """Write a patch with its levels and then its record, and wait until they are on the disk.

    Raises
    ------
    OSError
        If the disk is full or the store is not writable.
    """
    path, files = arrays.path, arrays.files
    folder = files.folder(patch.index)
    check_own(path, folder)
    # Remove the old record first, so that it never stands beside pixels of the new patch.
    if (folder / "zarr.json").exists():
        (folder / "zarr.json").unlink()
        sync_folder(folder)
    attributes = read_document(path)
    factors = stored_levels(attributes).of_patches
    found = {1: Level(np.abs(patch.pixels), patch.pixels)} | levels(patch.pixels, factors)
    with_levels = {name: patch.layers[name] for name in layers_of(attributes)}
    of_layers = layer_levels(with_levels, factors, attributes.get(WINDOW)) | {1: patch.layers}
    first, *others = files.arrays
    values = {first: patch.pixels} | {
        array: found[array.factor]._replace(layers=of_layers[array.factor]).values_of(array)
        for array in others
    }
    for array, each in values.items():
        window = array.window(patch.index)
        zarr_arrays().write_values(path, attributes, array.name, window, each)
    write_attributes(folder, patch.record.attributes(files.checksums(patch.index)))


def _layer(name: str, values: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return a layer of a patch as float32; raise TypeError or ValueError unless it is one."""
    validate.instance(name, values, np.ndarray)
    if values.dtype.kind != "f" or values.shape != shape or np.isinf(values).any():
        allowed = f"have real numbers of shape {shape}, finite or NaN"
        raise ArgumentError("layers", allowed, f"{validate.shown(values)} for {name}")
    return values.astype(np.float32)
