"""Records of finished patches: how each was formed, and checksums of it.

A record is stored as the attributes of an empty Zarr group. It has a checksum of the patch's pixels
and one of itself, so that a changed bit in either is found.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from clsas.core import reprs
from clsas.mosaics.documents import DamageError, is_intact, read_attributes, with_checksum

PIXELS_CHECKSUM = "pixels_crc32c"
"""Attribute with the checksum of a patch's pixels."""

PatchIndex = tuple[int, int]
"""Row and column of a patch."""

_LISTED = 3  # damaged patches that a message names; it counts the others


@dataclass(frozen=True)
class Record:
    """How a finished patch was formed, and defects of its data.

    Attributes
    ----------
    channels : int
        Channels whose beam and recorded ranges touch the patch. If 0, all pixels are zero.
    survey_channels : int
        Channels of the survey at that time.
    missing_channels : int
        Number of `channels` without samples.
    gap_m : float
        Longest distance between consecutive pings that contribute to the patch, if it exceeds
        three median steps; else 0.
    predicted_error_db : float or None
        Predicted relative rms error against the exact image, dB; None for an empty patch.
    predicted_seconds, plan_seconds, read_seconds, seconds : float
        Predicted time of imaging; measured times of planning, of reading lines, and in total.
    memory_bytes : int
        Planned memory.
    device, driver : str
        Device that formed the patch, and its driver.
    plan : dict or None
        The plan, as `clsas.Plan.from_json` reads it, without the beam's directions; None for an
        exact image or an empty patch.
    has_pixels : bool
        True if any pixel is not 0.
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
        """True if no channel contributes; all pixels are then zero."""
        return self.channels == self.missing_channels

    @property
    def flags(self) -> tuple[str, ...]:
        """Defects of the data in words; empty if there are none."""
        found = []
        if not self.channels:
            found.append("empty: in no channel's beam and range")
        elif self.missing_channels:
            found.append(f"{self.missing_channels} of {self.channels} channels have no samples")
        if self.gap_m:
            found.append(f"a gap of {self.gap_m:.3g} m between pings")
        return tuple(found)

    def attributes(self, pixels_checksum: str | None) -> dict[str, Any]:
        """Return the record for a store; the checksum of pixels that are all zero is None."""
        return with_checksum(asdict(self) | {PIXELS_CHECKSUM: pixels_checksum})

    @classmethod
    def read(cls, folder: Path) -> tuple[Record, str | None] | None:
        """Return the record in a folder and the checksum of its pixels, or None if there is none.

        Raises
        ------
        DamageError
            If the record is damaged.
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


def describe_damage(found: dict[PatchIndex, str]) -> str:
    """Return the first damaged patches with their reasons, and the number of the others."""
    named = [f"patch {row},{column}: {reason}" for (row, column), reason in found.items()]
    more = f" and {len(named) - _LISTED} more" if len(named) > _LISTED else ""
    return "; ".join(named[:_LISTED]) + more


def describe_arrays(found: dict[str, str]) -> str:
    """Return the damaged arrays with their reasons."""
    return "; ".join(f"{name}: {reason}" for name, reason in found.items())
