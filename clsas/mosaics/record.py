"""Records of finished patches: what is known about a patch, and checksums of it.

A record is the attributes of an empty Zarr group. It holds the checksum of its patch's pixels and
one of itself, so a changed bit in either is found.
"""

from __future__ import annotations

import json
import zlib
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from clsas.core import reprs
from clsas.core.atomic import make_folders, replacing
from clsas.core.reading import parse_json, read_bytes

CHECKSUM = "crc32"
"""Attribute that holds the checksum of the other attributes."""

PIXELS_CHECKSUM = "pixels_crc32c"
"""Attribute that holds the checksum of a patch's pixels."""


Place = tuple[int, int]
"""Row and column of a patch."""

_LISTED = 3  # damaged patches that a message names


class DamageError(ValueError):
    """A patch or a document of a store that is not what was written."""


@dataclass(frozen=True)
class Record:
    """How a finished patch was formed, and what a user should know of it.

    Attributes
    ----------
    channels : int
        Channels whose beam and recorded ranges touch the patch. With 0 its pixels are all zero.
    survey_channels : int
        Channels of the survey at that time.
    missing_channels : int
        Number of `channels` that have no samples.
    gap_m : float
        Longest distance between successive pings that see the patch if it exceeds three median
        steps, else 0.
    predicted_error_db : float or None
        Predicted relative rms error against the exact image, dB; None for an empty patch.
    predicted_seconds, plan_seconds, read_seconds, seconds : float
        Predicted imaging time; time for planning, for reading lines, and in total.
    memory_bytes : int
        Planned memory.
    device, driver : str
        Device that formed the patch, and its driver.
    plan : dict or None
        The plan, as `clsas.Plan.from_json` reads it, without the beam's directions; None for an
        exact image or an empty patch.
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

    __repr__ = reprs.of_fields

    @property
    def is_empty(self) -> bool:
        """Whether no channel contributes, so that all pixels are zero."""
        return self.channels == self.missing_channels

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

    def attributes(self, pixels_checksum: str | None) -> dict[str, Any]:
        """Return what a store keeps of a record; the checksum is None for pixels that are all 0."""
        return with_checksum(asdict(self) | {PIXELS_CHECKSUM: pixels_checksum})

    @classmethod
    def read(cls, folder: Path) -> tuple[Record, str | None] | None:
        """Return the record in a folder and its pixels' checksum, or None if there is none.

        Raises
        ------
        DamageError
            If it is not what was written.
        """
        if not (folder / "zarr.json").exists():
            return None
        stored = read_attributes(folder)
        if not is_intact(stored):
            raise DamageError("its record does not match its checksum")
        names = {field.name for field in fields(cls)}
        try:
            record = cls(**{name: value for name, value in stored.items() if name in names})
            checksum = stored[PIXELS_CHECKSUM]
        except (LookupError, TypeError) as error:
            raise DamageError("its record is incomplete") from error
        return record, checksum


def read_attributes(folder: Path) -> dict[str, Any]:
    """Return the attributes of a Zarr group.

    Raises
    ------
    DamageError
        If the group's document is not one.
    OSError
        If it cannot be read.
    """
    try:
        attributes = parse_json(read_bytes(folder / "zarr.json"))["attributes"]
    except (ValueError, LookupError, TypeError) as error:
        raise DamageError("its record cannot be read") from error
    if not isinstance(attributes, dict):
        raise DamageError("its record cannot be read")
    return attributes


def write_attributes(folder: Path, attributes: dict[str, Any]) -> None:
    """Write a Zarr group of these attributes; it is on the disk when this returns."""
    make_folders(folder)
    document = {"zarr_format": 3, "node_type": "group", "attributes": attributes}
    with replacing(folder / "zarr.json") as temporary:
        temporary.write_text(json.dumps(document, indent=1))


def with_checksum(attributes: dict[str, Any]) -> dict[str, Any]:
    """Return attributes with the checksum of all the others."""
    others = {name: value for name, value in attributes.items() if name != CHECKSUM}
    text = json.dumps(others, sort_keys=True, separators=(",", ":"))
    return others | {CHECKSUM: f"{zlib.crc32(text.encode()):08x}"}


def is_intact(attributes: dict[str, Any]) -> bool:
    """Return whether attributes match the checksum among them."""
    return attributes == with_checksum(attributes)


def describe_damage(found: dict[Place, str]) -> str:
    """Return damaged patches in words: how many, and the first of them with the reason."""
    named = [f"patch {row},{column}: {reason}" for (row, column), reason in found.items()]
    more = f" and {len(named) - _LISTED} more" if len(named) > _LISTED else ""
    return "; ".join(named[:_LISTED]) + more
