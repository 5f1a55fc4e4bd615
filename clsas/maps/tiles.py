"""Tiles of the viewer: 8-bit levels at every power of two of the pixel size, as scripts.

A page that was opened from a disk may not read files, and may not look into pictures that it shows.
It may run scripts, so that every tile is a script that hands its levels to the page: compressed by
zlib, in base64.
"""

from __future__ import annotations

import base64
import math
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SIDE = 512
"""Pixels along a side of a tile. Half as many would make four times as many files; twice as many
would take four times as long to appear."""

STEP_DB = 0.4
"""Smallest difference of neighbouring levels, dB. It errs by 0.12 dB rms, far below speckle, and
255 levels then span 101.6 dB. Half the step would make tiles of speckle larger by 18 %."""

NOTHING = 0
"""Level where nothing was received."""

BRIGHTEST = 255
"""Level of the reference; every level below is one step of dB lower."""

_FAINTEST = np.float32(1e-30)  # power that stays above 0 in float32, but below every level


@dataclass(frozen=True)
class Levels:
    """How amplitudes become the levels of tiles.

    Attributes
    ----------
    reference : float
        Amplitude of 0 dB, which no pixel exceeds.
    step_db : float
        Difference of neighbouring levels, dB.
    """

    reference: float
    step_db: float = STEP_DB

    def power(self, pixels: NDArray[np.complex64]) -> NDArray[np.float32]:
        """Return power relative to the reference. It is 0 only where nothing was received."""
        parts = np.ascontiguousarray(pixels).view(np.float32)
        # The reference itself may be too large for float32, but half of it never is.
        parts = np.multiply(parts, np.float32(0.5))
        parts /= np.float32(self.reference / 2)
        parts *= parts
        power = np.add(parts[:, ::2], parts[:, 1::2])
        np.maximum(power, _FAINTEST, out=power, where=pixels != 0)
        return power

    def encode(self, power: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Return the levels of relative power."""
        nothing = power == 0
        steps = np.log(np.maximum(power, _FAINTEST))
        steps *= np.float32(10 / math.log(10) / self.step_db)
        levels = np.clip(np.rint(steps) + BRIGHTEST, 1, BRIGHTEST).astype(np.uint8)
        levels[nothing] = NOTHING
        return levels


@dataclass(eq=False)
class _Tile:
    power: NDArray[np.float32]
    missing: int  # pixels that have not been added yet


def scales_of(shape: tuple[int, int]) -> range:
    """Return the scales of a pyramid, coarsest first.

    They are numbered as the levels of Deep Zoom: scale 0 would be a single pixel, and each has
    twice as many pixels as the one before along either side. The coarsest scale here is the largest
    that fits into one tile.
    """
    finest = math.ceil(math.log2(max(shape)))
    return range(finest - max(0, math.ceil(math.log2(max(shape) / SIDE))), finest + 1)


@dataclass(eq=False)
class Pyramid:
    """Tiles of an image at all scales, which are written as soon as all their pixels are known.

    Attributes
    ----------
    shape : (rows, columns)
        Shape of the image.
    levels : Levels
    folder : Path
        Folder of the tiles: SCALE/COLUMN_ROW.js.
    name : str
        Name of the image, by which its tiles call the page.
    """

    shape: tuple[int, int]
    levels: Levels
    folder: Path
    name: str
    _pending: dict[tuple[int, int, int], _Tile] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Create the folders."""
        for scale in scales_of(self.shape):
            (self.folder / str(scale)).mkdir(parents=True)

    def add(self, rows: slice, columns: slice, pixels: NDArray[np.complex64]) -> None:
        """Add the pixels of a window to the tiles of all scales. Windows must not overlap."""
        power = self.levels.power(pixels)
        self._add(scales_of(self.shape)[-1], rows.start, columns.start, power)

    def _add(self, scale: int, top: int, left: int, power: NDArray[np.float32]) -> None:
        """Add power at a place of a scale, and what it completes to coarser scales."""
        bottom, right = top + power.shape[0], left + power.shape[1]
        for row in range(top // SIDE, (bottom - 1) // SIDE + 1):
            for column in range(left // SIDE, (right - 1) // SIDE + 1):
                tile = self._tile(scale, row, column)
                rows, columns = (
                    slice(max(first, index * SIDE), min(last, (index + 1) * SIDE))
                    for first, last, index in ((top, bottom, row), (left, right, column))
                )
                part = power[rows.start - top : rows.stop - top]
                part = part[:, columns.start - left : columns.stop - left]
                y, x = row * SIDE, column * SIDE
                tile.power[rows.start - y : rows.stop - y, columns.start - x : columns.stop - x] = (
                    part
                )
                tile.missing -= part.size
                if not tile.missing:
                    self._finish(scale, row, column)

    def _tile(self, scale: int, row: int, column: int) -> _Tile:
        key = scale, row, column
        if key not in self._pending:
            factor = 1 << (scales_of(self.shape)[-1] - scale)
            height, width = (
                min(math.ceil(n / factor) - index * SIDE, SIDE)
                for n, index in zip(self.shape, (row, column), strict=True)
            )
            self._pending[key] = _Tile(np.empty((height, width), np.float32), height * width)
        return self._pending[key]

    def _finish(self, scale: int, row: int, column: int) -> None:
        """Write a tile, and add its means to the next coarser scale."""
        power = self._pending.pop((scale, row, column)).power
        path = self.folder / str(scale) / f"{column}_{row}.js"
        packed = base64.b64encode(_packed(self.levels.encode(power))).decode()
        path.write_text(f'clsasTile("{self.name}/{scale}/{column}_{row}","{packed}");\n')
        if scale > scales_of(self.shape)[0]:
            self._add(scale - 1, row * SIDE // 2, column * SIDE // 2, halved(power))


def halved(power: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the means of 2 x 2 pixels, or of those that exist at the end of odd sides."""
    rows, columns = (n % 2 for n in power.shape)
    even = np.pad(power, ((0, rows), (0, columns)), mode="edge") if rows or columns else power
    total = even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]
    return np.multiply(total, np.float32(0.25))


def _packed(levels: NDArray[np.uint8]) -> bytes:
    """Return levels compressed by zlib.

    Speckle has no strings that repeat, and is coded by its distribution: searching for strings
    would take three times as long for tiles 1 % larger. Z_RLE still packs constant areas.
    """
    packing = zlib.compressobj(1, zlib.DEFLATED, 15, 9, zlib.Z_RLE)
    return packing.compress(levels.tobytes()) + packing.flush()
