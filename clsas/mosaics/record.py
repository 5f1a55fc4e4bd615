"""Records of finished patches: how each was formed, and its checksums.

A record is stored as the attributes of an empty Zarr group. It contains a checksum of the patch's
pixels and a digest of itself, so that a changed bit in either is detected.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from clsas.engine.data import reprs
from clsas.engine.data.digests import is_intact, with_digest
from clsas.mosaics.document import DamageError, read_attributes

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

_LISTED = 3  # damaged patches that a message names; the others are only counted


@dataclass(frozen=True)
class Record:
    """Record of how a finished patch was formed, and of defects of its data.

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
        Longest distance between consecutive pings that contribute to the patch, if it exceeds
        three median steps; else 0.
    predicted_error_db : float or None
        Predicted relative rms error against the exact image, dB; None for an empty patch.
    predicted_seconds, plan_seconds, read_seconds, seconds : float
        Predicted time of imaging; measured times of planning, of reading lines, and in total, s.
    memory_bytes : int
        Predicted memory.
    device, driver : str
        Device that formed the patch, and its driver.
    plan : dict or None
        The plan as JSON, without the beam's directions; `clsas.Plan.from_json` reads it. None for
        an exact image or an empty patch.
    has_pixels : bool
        True if any pixel is not 0.
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
    heights: dict[str, Any] | None = None

    __repr__ = reprs.of_fields

    @property
    def flags(self) -> tuple[str, ...]:
        """Descriptions of the defects of the data; empty if there are none."""
        found = []
        if not self.channels:
            found.append("empty: outside the beam or recorded ranges of every channel")
        elif self.missing_channels:
            found.append(f"{self.missing_channels} of {self.channels} channels have no samples")
        if self.gap_m:
            found.append(f"a gap of {self.gap_m:.3g} m between pings")
        if self.heights is not None and "reason" in self.heights:
            found.append(f"no heights: {self.heights['reason']}")
        elif self.heights is not None and not self.heights["converged"]:
            found.append("heights still changed in the last pass")
        return tuple(found)

    def attributes(self, checksums: Checksums) -> dict[str, Any]:
        """Return the attributes to store, with the checksums of pixels and levels."""
        levels = {name: value for name, value in checksums.items() if name != "pixels"}
        stored = {PIXELS_CHECKSUM: checksums["pixels"], LEVELS_CHECKSUMS: levels}
        return with_digest(asdict(self) | stored)

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
            record = cls(**{name: value for name, value in stored.items() if name in names})
            checksums = {"pixels": stored[PIXELS_CHECKSUM], **stored[LEVELS_CHECKSUMS]}
        except (LookupError, TypeError) as error:
            raise DamageError("its record is incomplete") from error
        return record, checksums


def describe_damage(found: dict[PatchIndex, str]) -> str:
    """Return the first damaged patches with their reasons, and the number of others, in words."""
    named = [f"patch {row},{column}: {reason}" for (row, column), reason in found.items()]
    more = f" and {len(named) - _LISTED} more" if len(named) > _LISTED else ""
    return "; ".join(named[:_LISTED]) + more


def describe_arrays(found: dict[str, str]) -> str:
    """Return the damaged arrays with their reasons, in words."""
    return "; ".join(f"{name}: {reason}" for name, reason in found.items())
