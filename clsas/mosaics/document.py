"""The document of a store, which says what its mosaic was made with, and the records of patches.

The document is what a mosaic was made with, as JSON attributes of its Zarr group. The record of a
patch, the attributes of an empty Zarr group, says how the patch was formed, with checksums of its
pixels. Both have digests, so that a changed bit is detected. Nothing here needs Zarr.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

from clsas.engine.data import reprs, validate
from clsas.engine.data.atomic import check_writable, make_folders, replacing
from clsas.engine.data.certificate import Certificate, of_parts
from clsas.engine.data.digests import digest, is_intact, with_digest
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.engine.data.reading import parse_json, read_bytes
from clsas.engine.data.validate import ArgumentError
from clsas.engine.factorized.planner import tolerance_in_db
from clsas.mosaics.levels import (
    IN_DB,
    LAYERS,
    SHADOWED,
    Levels,
    StoredArray,
    chunk_side,
    level_shape,
    levels_of,
    multiscales,
)

FORMAT = "clsas mosaic"
VERSION = 8
"""Version of stores. Those of other versions are refused."""

REPAIR = "; run `clsas.mosaic` with the same inputs to repair it"
"""End of messages about damage."""

GROUP = "patches"
"""Name of the group that contains the records of patches; it has no attributes of its own."""

PARTS_OF_B = "parts_of_b"
"""Input with the digests of the second bank's files, if they are not those of the first one."""

PIXELS_CHECKSUM = "pixels_crc32c"
"""Attribute with the checksum of a patch's pixels, or the list of those of its chunks."""

LEVELS_CHECKSUMS = "levels_crc32c"
"""Attribute with the checksums of a patch's levels, by the name of the array."""

Checksums = dict[str, str | list[str | None] | None]
"""Checksums of a patch by the name of the array: of its chunk, or a list of those of its chunks.

That of a chunk that does not exist, because it has only the fill value, is None.
"""

PatchIndex = tuple[int, int]
"""Row and column of a patch."""

_VECTORS = "origin_m", "row_step_m", "column_step_m"
_LISTED = 3  # damaged patches that a message names; the others are only counted


class DamageError(ValueError):
    """A patch or a document of a store differs from what was written."""


class OtherInputsError(ValueError):
    """A store was made with other inputs than those given."""


@dataclass(frozen=True, eq=False)
class Document:
    """Inputs, grid and division of a mosaic, from which all arrays of its store follow.

    Attributes
    ----------
    inputs : dict
        Inputs of the mosaic, as `clsas.mosaics.mosaic.inputs_of` returns them.
    patch_shape : (rows, columns)
    plane : Grid or None
        Grid of the mosaic without heights, or None for arbitrary points.
    has_height : bool
        True if the grid has heights.
    window : (rows, columns) or None
        Pixels of the window behind each height, for a mosaic of heights.
    metadata : dict of str to str
        Digest of the metadata of each array, as they were written.
    """

    inputs: dict[str, Any]
    patch_shape: tuple[int, int]
    plane: Grid | None
    has_height: bool
    window: tuple[int, int] | None
    metadata: dict[str, str]

    @classmethod
    def read(cls, path: Path) -> Document:
        """Return the document of the mosaic at a path.

        Raises
        ------
        ValueError
            If the path contains something else, a mosaic of another version, or a damaged one.
        """
        try:
            attributes = read_attributes(path)
        except (OSError, DamageError) as error:
            raise ValueError(f"{path} exists and is not a mosaic of clsas") from error
        if attributes.get("format") != FORMAT:
            raise ValueError(f"{path} exists and is not a mosaic of clsas")
        if attributes.get("version") != VERSION:
            raise ValueError(
                f"{path} is a mosaic of version {attributes.get('version')}, but this clsas works "
                f"with version {VERSION}: choose another path"
            )
        if not is_intact(attributes):
            raise ValueError(f"{path} is damaged: its attributes do not match their digest")
        try:
            inputs, stored = attributes["inputs"], attributes["grid"]
            metadata, window = attributes["metadata"], attributes.get("window")
            check_inputs(inputs, None)
            validate.instance("metadata", metadata, dict)
            plane = None
            if stored is not None:
                place = inputs.get("georeference")
                plane = Grid.oriented(
                    **{name: stored[name] for name in _VECTORS},
                    shape=tuple(inputs["pixels"]),
                    georeference=None if place is None else Georeference(**place),
                )
            return cls(
                inputs,
                validate.sides("patch_shape", attributes["patch_shape"]),
                plane,
                validate.flag("has_height", attributes["has_height"]),
                None if window is None else validate.sides("window", window),
                {name: validate.text(name, each) for name, each in metadata.items()},
            )
        except (LookupError, TypeError, ValueError) as error:
            raise ValueError(
                f"{path} is damaged: its attributes are not those of a mosaic"
            ) from error

    def write(self, path: Path) -> None:
        """Write the document, and wait until it is on the disk."""
        grid = None
        if self.plane is not None:
            grid = {name: getattr(self.plane, name).tolist() for name in _VECTORS}
        attributes = {
            "format": FORMAT,
            "version": VERSION,
            "patch_shape": list(self.patch_shape),
            "grid": grid,
            "has_height": self.has_height,
            "inputs": self.inputs,
            "metadata": self.metadata,
        } | ({} if self.window is None else {"window": list(self.window)})
        write_attributes(path, with_digest(attributes | multiscales(self.levels)))

    @property
    def shape(self) -> tuple[int, int]:
        """Number of pixels, (rows, columns)."""
        rows, columns = self.inputs["pixels"]
        return rows, columns

    @property
    def patches(self) -> tuple[int, int]:
        """Number of patches, (rows, columns)."""
        sides = zip(self.shape, self.patch_shape, strict=True)
        rows, columns = (math.ceil(count / side) for count, side in sides)
        return rows, columns

    @cached_property
    def levels(self) -> Levels:
        """Factors of the levels."""
        return levels_of(self.shape, self.patch_shape)

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers with levels, empty unless the mosaic has heights."""
        return () if self.window is None else tuple(LAYERS)

    @property
    def shadowed(self) -> tuple[str, ...]:
        """Names of the layers without levels, empty unless the mosaic has heights."""
        return () if self.window is None else tuple(SHADOWED)

    @property
    def groups(self) -> list[str]:
        """Names of the groups: that of the records, and one for each level."""
        return [GROUP, *(f"{factor}x" for factor in self.levels.factors)]

    @cached_property
    def of_patches(self) -> tuple[StoredArray, ...]:
        """Arrays that are written with each patch: the pixels first, layers, levels of patches."""
        pixels = StoredArray(
            "pixels", "complex64", self.shape, self._chunks(self.patch_shape, self.shape),
            self._dimensions, self._map, 1, self.patch_shape,
        )  # fmt: skip
        layers = [
            StoredArray(
                name, "float32", pixels.shape, pixels.chunk_shape, self._dimensions,
                _meaning(name), 1, self.patch_shape,
            )
            for name in (*self.layers, *self.shadowed)
        ]  # fmt: skip
        levels = [each for n in self.levels.of_patches for each in self._level(n)]
        return (pixels, *layers, *levels)

    @cached_property
    def of_mosaic(self) -> tuple[StoredArray, ...]:
        """Arrays of the levels that are computed when all patches are finished."""
        return tuple(each for n in self.levels.of_mosaic for each in self._level(n))

    @cached_property
    def coordinates(self) -> tuple[StoredArray, ...]:
        """Axes of the pixels and of the levels, unless the grid is rotated, and heights."""
        found = []
        if self.plane is not None and self.plane.has_axes:
            factors = self.levels.factors
            places = [("", "", 1), *((f"{n}x/", "", n) for n in factors)]
            places += [("overview_", "overview_", n) for n in factors[-1:]]
            for before, of_dimension, factor in places:
                for axis, name in enumerate("xy"):
                    count = (level_shape(self.shape, factor)[1 - axis],)
                    found.append(
                        StoredArray(
                            before + name, "float64", count, count, (of_dimension + name,),
                            {"units": "m"}, factor,
                        )
                    )  # fmt: skip
        if self.has_height:
            chunks = self._chunks(self.shape, self.shape)
            found.append(
                StoredArray(
                    "height", "float64", self.shape, chunks, self._dimensions, {"units": "m"}
                )
            )
        return tuple(found)

    @cached_property
    def arrays(self) -> dict[str, StoredArray]:
        """All arrays of the store, by name."""
        every = (*self.of_patches, *self.of_mosaic, *self.coordinates)
        return {array.name: array for array in every}

    @property
    def _dimensions(self) -> tuple[str, ...]:
        has_axes = self.plane is not None and self.plane.has_axes
        return ("y", "x") if has_axes else ("row", "column")

    @property
    def _map(self) -> dict[str, Any]:
        """Return the map projection in the convention of GDAL, if x and y are easting, northing."""
        place = None if self.plane is None else self.plane.georeference
        if self.plane is None or place is None or place.crs is None or not self.plane.has_axes:
            return {}
        authority, _, code = place.crs.partition(":")
        if authority == "EPSG" and code.isdigit():
            return {"_CRS": {"url": f"http://www.opengis.net/def/crs/EPSG/0/{code}"}}
        return {"_CRS": {"wkt": place.crs}} if "[" in place.crs else {}

    def _level(self, factor: int) -> list[StoredArray]:
        """Return the arrays of a level; the factor 1 stands for an array in dB alone."""
        shape = level_shape(self.shape, factor)
        patch = self.patch_shape if factor in self.levels.of_patches else self.shape
        chunks = self._chunks(level_shape(patch, factor), shape)
        kinds = {"pixels": "complex64", "amplitude": "float32"}
        kinds |= dict.fromkeys(self.layers, "float32")
        names = {f"{factor}x/{kind}": data_type for kind, data_type in kinds.items()}
        if factor == 1:
            names = {}
        if factor == self.levels.coarsest:
            names[IN_DB] = "float32"
        # Programs such as xarray demand one length of every dimension of a group.
        overview = tuple(f"overview_{name}" for name in self._dimensions)
        return [
            StoredArray(
                name, data_type, shape, chunks,
                overview if name == IN_DB and factor > 1 else self._dimensions,
                _meaning(name.rpartition("/")[2]), factor, self.patch_shape,
            )
            for name, data_type in names.items()
        ]  # fmt: skip

    @staticmethod
    def _chunks(patch: tuple[int, int], shape: tuple[int, int]) -> tuple[int, int]:
        rows, columns = map(chunk_side, patch, shape)
        return rows, columns


def _meaning(kind: str) -> dict[str, Any]:
    """Return unit and meaning of the numbers of a kind of array, as xarray shows them."""
    known = LAYERS | SHADOWED | {IN_DB: ("dB", "amplitude")}
    units, meaning = known.get(kind, ("", ""))
    return {name: each for name, each in (("units", units), ("long_name", meaning)) if each}


def check_inputs(inputs: Any, shape: Sequence[int] | None) -> None:
    """Check the inputs of a mosaic.

    Parameters
    ----------
    inputs : dict
        The inputs, as `clsas.mosaics.mosaic.inputs_of` returns them.
    shape : (rows, columns) or None
        Shape of the grid, which the number of pixels must equal; None for any shape.

    Raises
    ------
    TypeError
        If `inputs` are not a dict.
    ValueError
        If the list of parts or the number of pixels is missing or wrong.
    """
    validate.instance("inputs", inputs, dict)
    parts, pixels = inputs.get("parts"), inputs.get("pixels")
    for name, each in (("parts", parts), (PARTS_OF_B, inputs.get(PARTS_OF_B, []))):
        if not isinstance(each, list):
            raise ArgumentError("inputs", f"have a list {name!r}", validate.shown(each))
    is_shape = (
        isinstance(pixels, list)
        and len(pixels) == 2
        and all(type(side) is int and side > 0 for side in pixels)
    )
    if not is_shape or (shape is not None and pixels != list(shape)):
        expected = "of two numbers" if shape is None else f"{list(shape)}, the shape of the grid"
        raise ArgumentError("inputs", f"have 'pixels' {expected}", validate.shown(pixels))


def differences(
    document: Document, given: dict[str, Any], patch_shape: tuple[int, int]
) -> list[str]:
    """Return one message for every difference between the inputs of a store and the given ones.

    Files may have been added to the survey, so the given parts need only begin with the stored
    ones.
    """
    found, stored = [], document.inputs
    if ("search_m" in stored) != ("search_m" in given):
        kinds = ("heights", "images") if "search_m" in stored else ("images", "heights")
        return ["it is a mosaic of {}, not of {}".format(*kinds)]
    if document.patch_shape != patch_shape:
        shapes = "{} x {} pixels in the store, {} x {} here"
        found.append(f"patches have {shapes.format(*document.patch_shape, *patch_shape)}")
    before, now = (
        [each.get(name, []) for name in ("parts", PARTS_OF_B)] for each in (stored, given)
    )
    if any(new[: len(old)] != old for old, new in zip(before, now, strict=True)):
        found.append("the range lines differ")
    elif stored.keys() & {PARTS_OF_B} != given.keys() & {PARTS_OF_B}:
        found.append("the range lines of both banks were in one source, or are now")
    for name, theirs in given.items():
        mine = stored.get(name)
        if name in ("parts", PARTS_OF_B):
            continue
        if name == "grid" and mine != theirs:
            if stored.get("pixels") == given["pixels"]:
                found.append("the grid has another position or other heights")
        elif isinstance(mine, dict) and isinstance(theirs, dict):
            found += [
                f"`{name}`'s {key} is {_word(mine.get(key))} in the store, {_word(each)} here"
                for key, each in theirs.items()
                if mine.get(key) != each
            ]
        elif name == "pixels" and mine != theirs:
            shapes = "{} x {} pixels in the store, {} x {} here"
            found.append(f"the grid has {shapes.format(*stored[name], *theirs)}")
        elif mine != theirs:
            found.append(f"`{name}` is {_word(mine)} in the store, {_word(theirs)} here")
    return found


def _word(value: Any) -> str:
    """Return an input in words."""
    if value is None:
        return "not set"
    return "set" if isinstance(value, dict) else str(value)


def stored_digest(path: Path) -> str:
    """Return a digest of the inputs that the store at a path was made with.

    Raises
    ------
    ValueError
        If there is no mosaic at the path, or its document is damaged.
    """
    return digest(Document.read(path).inputs)


@dataclass(frozen=True)
class Record:
    """Record of how a finished patch was formed, and of defects of its data.

    Neighbouring patches are formed together, in a block. Plan, memory, predicted error and
    certificate are those of the block; times are the patch's share of its times.

    Attributes
    ----------
    channels : int
        Number of channels whose beam and recorded ranges touch the patch. If 0, all pixels are
        zero.
    survey_channels : int
        Number of channels in the survey when the patch was formed.
    missing_channels : int
        Number of `channels` without samples.
    gap_m : float
        Longest distance along the track between phase centres that contribute to the patch, if it
        exceeds three median distances; else 0.
    predicted_error_db : float or None
        Predicted relative rms error against the exact image, dB; None for an empty patch.
    predicted_seconds, plan_seconds, read_seconds, seconds : float
        Predicted time of imaging; measured times of planning, of reading lines, and in total, s.
    memory_bytes : int
        Predicted memory of the block.
    device, driver : str
        Device that formed the patch, and its driver.
    plan : dict or None
        The plan as JSON, without the beam's directions; `clsas.Plan.from_json` reads it. None for
        an exact image or an empty patch.
    has_pixels : bool
        True if any pixel is not 0.
    share : float
        Share of the patch in the pixels of its block; 0 if only other patches of the block have
        pixels that are not 0.
    certificate : Certificate or None
        Measured error of the block, with the worst pixels counted from its corner; of heights, that
        of the bank whose image has the larger error. None if it was not measured.
    unmeasured : str
        Why the error could not be measured; empty if it was, or was not to be.
    misses : tuple of str
        Predicted and measured errors of earlier images of the block, which was formed again
        because the mosaic missed its tolerance.
    heights : dict or None
        How the heights were measured: the share of `valid` pixels, the median of `looks`, the
        height of ambiguity `ambiguity_m`, and `converged`; or the `reason` why there are none.
        None for images.
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
    share: float = 1.0
    certificate: Certificate | None = field(default=None, compare=False)
    unmeasured: str = ""
    misses: tuple[str, ...] = ()
    heights: dict[str, Any] | None = None

    __repr__ = reprs.of_fields

    @property
    def is_exact(self) -> bool:
        """True if the patch is exact, whether its plan or the request says so."""
        return self.plan is None or "sides" not in self.plan["method"]

    @property
    def flags(self) -> tuple[str, ...]:
        """Descriptions of the defects of the data; empty if there are none."""
        found = []
        if not self.channels:
            found.append("empty: outside the beam or recorded ranges of every channel")
        elif self.missing_channels:
            found.append(f"{self.missing_channels} of {self.channels} channels have no samples")
        if self.gap_m:
            found.append(f"a gap of {self.gap_m:.3g} m along the track")
        if self.unmeasured:
            found.append(f"the error is not known: {self.unmeasured}")
        if self.heights is not None and "reason" in self.heights:
            found.append(f"no heights: {self.heights['reason']}")
        elif self.heights is not None and not self.heights["converged"]:
            found.append("heights still changed in the last pass")
        return tuple(found)

    def attributes(self, checksums: Checksums) -> dict[str, Any]:
        """Return the attributes to store, with the checksums of pixels and levels."""
        levels = {name: value for name, value in checksums.items() if name != "pixels"}
        stored = {PIXELS_CHECKSUM: checksums["pixels"], LEVELS_CHECKSUMS: levels}
        text = json.dumps(asdict(self) | stored, default=lambda array: array.tolist())
        return with_digest(json.loads(text))

    @classmethod
    def read(cls, folder: Path) -> tuple[Record, Checksums] | None:
        """Return the record in a folder and its checksums, or None if there is none.

        Raises
        ------
        DamageError
            If the record is damaged.
        """
        if not (folder / "zarr.json").exists():
            return None
        stored = read_attributes(folder)
        if not is_intact(stored):
            raise DamageError("its record does not match its digest")
        names = {field.name for field in fields(cls)}
        try:
            known = {name: value for name, value in stored.items() if name in names}
            if (certificate := known.get("certificate")) is not None:
                known["certificate"] = Certificate(**certificate)
            record = cls(**known | {"misses": tuple(known.get("misses", ()))})
            checksums = {"pixels": stored[PIXELS_CHECKSUM], **stored[LEVELS_CHECKSUMS]}
        except (LookupError, TypeError, ValueError) as error:
            raise DamageError("its record is incomplete") from error
        return record, checksums


def requested_db(request: Mapping[str, Any]) -> float | None:
    """Return the tolerance of a request, or of the inputs of a mosaic; None for a fixed method."""
    if request.get("accuracy_db") is not None:
        return request["accuracy_db"]
    return tolerance_in_db(request.get("tolerance_db"), request.get("tolerance_wavelengths"))


@dataclass(frozen=True, eq=False)
class MosaicCertificate:
    """Measured error of a mosaic, and of the blocks in which its patches were formed.

    Attributes
    ----------
    whole : Certificate
        Error of all certified patches together.
    patches : dict of (row, column) to Certificate
        Error of the block of each certified patch.
    of_patches : int
        Number of finished patches with pixels that are not 0, certified or not.
    """

    whole: Certificate
    patches: dict[PatchIndex, Certificate]
    of_patches: int

    @classmethod
    def of(cls, records: Mapping[PatchIndex, Record]) -> MosaicCertificate | None:
        """Return the error of finished patches, or None if none is certified."""
        known = {
            index: record.certificate
            for index, record in records.items()
            if record.certificate is not None
        }
        if not known:
            return None
        count = sum(record.has_pixels for record in records.values())
        shares = [records[index].share for index in known]
        return cls(of_parts(list(known.values()), shares), known, count)

    @property
    def error_db(self) -> float:
        """Estimate of the relative rms error of all certified patches, dB."""
        return self.whole.error_db

    def verdict(self, tolerance_db: float) -> str:
        """Return the verdict of `whole`."""
        return self.whole.verdict(tolerance_db)

    @property
    def of_all(self) -> Certificate | None:
        """Error of the whole mosaic; None if that of a patch with pixels is not known."""
        return self.whole if len(self.patches) >= self.of_patches else None

    @property
    def worst(self) -> PatchIndex:
        """The first patch of the block whose error is the largest relative to its own power."""
        return max(self.patches, key=lambda index: self.patches[index].error)

    def describe(self, tolerance_db: float | None = None) -> str:
        """Return the error of the whole and of the worst block as a line of text."""
        row, column = self.worst
        worst_db = self.patches[self.worst].error_db
        text = f"{self.whole.describe(tolerance_db)}; at worst {worst_db:.1f} dB in the block of "
        text += f"patch {row},{column}"
        if len(self.patches) < self.of_patches:
            text += f"; {len(self.patches)} of {self.of_patches} patches measured"
        return text

    @property
    def figures(self) -> dict[str, Any]:
        """Those of `whole`, and of how many of the patches it is that."""
        counts = {"patches": len(self.patches), "of_patches": self.of_patches}
        return self.whole.figures | counts

    def __repr__(self) -> str:
        """Return the description."""
        return f"MosaicCertificate({self.describe()})"


def describe_damage(found: dict[PatchIndex, str]) -> str:
    """Return the first damaged patches with their reasons, and the number of others, in words."""
    named = [f"patch {row},{column}: {reason}" for (row, column), reason in found.items()]
    more = f" and {len(named) - _LISTED} more" if len(named) > _LISTED else ""
    return "; ".join(named[:_LISTED]) + more


def describe_arrays(found: dict[str, str]) -> str:
    """Return the damaged arrays with their reasons, in words."""
    return "; ".join(f"{name}: {reason}" for name, reason in found.items())


def read_attributes(folder: Path) -> dict[str, Any]:
    """Return the attributes of a Zarr group.

    Raises
    ------
    DamageError
        If the group has no valid document.
    OSError
        If the document cannot be read.
    """
    try:
        document = parse_json(read_bytes(folder / "zarr.json"))
        is_group = (document["zarr_format"], document["node_type"]) == (3, "group")
        attributes = document["attributes"]
    except (ValueError, LookupError, TypeError) as error:
        raise DamageError("its record cannot be read") from error
    if not (is_group and isinstance(attributes, dict)):
        raise DamageError("its record cannot be read")
    return attributes


def write_attributes(folder: Path, attributes: dict[str, Any]) -> None:
    """Write a Zarr group with attributes, and wait until it is on the disk."""
    make_folders(folder)
    document = {"zarr_format": 3, "node_type": "group", "attributes": attributes}
    with replacing(folder / "zarr.json") as temporary:
        temporary.write_text(json.dumps(document, indent=1))


def stamp_of(path: Path) -> tuple[int, int, int]:
    """Return what tells a file from another that has replaced it."""
    status = path.stat()
    return status.st_ino, status.st_mtime_ns, status.st_size


def is_there(path: Path) -> bool:
    """Return whether the path of a store exists and is not an empty folder."""
    return path.exists() and not (path.is_dir() and not any(path.iterdir()))


def check_place(path: Path) -> None:
    """Check that a path contains a mosaic, or nothing yet and a mosaic can be created there.

    Raises
    ------
    ValueError
        If the path contains something else, or a damaged mosaic.
    OSError
        If the path cannot be written.
    """
    if is_there(path):
        Document.read(path)
    elif not path.parent.is_dir():
        raise FileNotFoundError(2, "there is no such folder", str(path.parent))
    check_writable(path if path.is_dir() else path.parent, path)


def check_own(store: Path, folder: Path) -> None:
    """Raise ValueError if a symbolic link leads a folder of a store to another place.

    Otherwise a store that comes from a stranger could make a run write into any folder of the user.
    """
    own = Path(os.path.realpath(store)) / folder.relative_to(store)
    if Path(os.path.realpath(folder)) != own:
        raise ValueError(
            f"{folder} must be a real folder of the store, but a symbolic link leads elsewhere: "
            "nothing is written through it"
        )
