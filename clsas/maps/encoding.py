"""Encoding of amplitudes in rasters: complex, in dB, or as 8-bit levels with colours."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray

KINDS = ("db", "complex", "8bit")
"""What the pixels of a GeoTIFF may be."""

NOTHING = 0
"""8-bit level where nothing was received."""

_LEVELS = 254  # steps from level 1 to level 255


@dataclass(frozen=True)
class Encoding:
    """How amplitudes become pixels of a raster. Amplitude 0 means that nothing was received.

    Attributes
    ----------
    kind : str
        One of `KINDS`.
    reference : float
        Amplitude of 0 dB.
    dynamic_range_db : float
        Level of the first 8-bit level below the reference, dB.
    """

    kind: str
    reference: float
    dynamic_range_db: float

    @property
    def dtype(self) -> DTypeLike:
        """Type of the pixels."""
        return {"complex": np.complex64, "db": np.float32, "8bit": np.uint8}[self.kind]

    @property
    def nodata(self) -> float | None:
        """Pixel where nothing was received; None if 0, a complex number, says so itself."""
        return {"complex": None, "db": math.nan, "8bit": NOTHING}[self.kind]

    @property
    def step_db(self) -> float:
        """Difference of neighbouring 8-bit levels, dB."""
        return self.dynamic_range_db / _LEVELS

    @property
    def scale_and_offset(self) -> tuple[float, float]:
        """Numbers that turn pixels into dB: level = scale * pixel + offset."""
        if self.kind == "8bit":
            return self.step_db, -self.dynamic_range_db - self.step_db
        return 1.0, 0.0

    def encode(self, amplitude: NDArray[np.float32]) -> NDArray:
        """Return the pixels of amplitudes."""
        if self.kind == "complex":
            return amplitude.astype(np.complex64)
        nothing = amplitude == 0
        level = np.full(amplitude.shape, np.nan)
        # In double precision, so that levels do not depend on how an image is divided.
        np.log10(amplitude, out=level, where=~nothing, dtype=np.float64)
        level = 20 * (level - math.log10(self.reference))
        if self.kind == "db":
            return level.astype(np.float32)
        level[nothing] = 0  # any number: it is replaced below
        steps = np.rint((level + self.dynamic_range_db) / self.step_db)
        encoded = (1 + np.clip(steps, 0, _LEVELS)).astype(np.uint8)
        encoded[nothing] = NOTHING
        return encoded


def colour_table(name: str) -> dict[int, tuple[int, int, int, int]]:
    """Return the colours of 8-bit levels; 0 is transparent.

    Raises
    ------
    ValueError
        If there is no such colour map.
    ImportError
        If matplotlib is not installed.
    """
    from clsas.plot.canvas import colour_map

    levels = np.arange(1, _LEVELS + 2)
    colours = colour_map(name)((levels - 1) / _LEVELS, bytes=True)
    table = {
        int(level): (int(red), int(green), int(blue), 255)
        for level, (red, green, blue, _) in zip(levels, colours, strict=True)
    }
    return {NOTHING: (0, 0, 0, 0), **table}
