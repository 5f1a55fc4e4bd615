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

from clsas.mosaics.means import block_means

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
class Quantization:
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


def factors_of(shape: tuple[int, int], steps_m: tuple[float, float]) -> dict[int, tuple[int, int]]:
    """Return pixels of the image along the rows and columns of a tile's pixel, by scale.

    Scales are ascending, and the finest has the number of its level in Deep Zoom: the base 2
    logarithm of the longer side, rounded up. The coarsest scale is the largest that fits into one
    tile. From scale to scale both factors double, unless pixels are at least sqrt(2) times longer
    along one side: then only the other factor does, since rows of 1 m are not to be averaged where
    columns of 1 mm are too fine for a screen.

    Parameters
    ----------
    shape : (rows, columns)
        Shape of the image.
    steps_m : (float, float)
        Distance of its rows and of its columns.
    """
    scale, factors = math.ceil(math.log2(max(shape))), (1, 1)
    found = {scale: factors}
    while max(counts := shape_of(shape, factors)) > SIDE:
        sides_m = [factor * step for factor, step in zip(factors, steps_m, strict=True)]
        rows_finer, columns_finer = (
            count > SIDE and math.sqrt(2) * side_m < other_m
            for count, side_m, other_m in zip(counts, sides_m, sides_m[::-1], strict=True)
        )
        factors = factors[0] << (not columns_finer), factors[1] << (not rows_finer)
        scale -= 1
        found[scale] = factors
    return dict(sorted(found.items()))


def shape_of(shape: tuple[int, int], factors: tuple[int, int]) -> tuple[int, int]:
    """Return the rows and columns of a scale with some factors."""
    rows, columns = (math.ceil(n / factor) for n, factor in zip(shape, factors, strict=True))
    return rows, columns


@dataclass(eq=False)
class Pyramid:
    """Tiles of an image at all scales, which are written as soon as all their pixels are known.

    Attributes
    ----------
    shape : (rows, columns)
        Shape of the image.
    quantization : Quantization
    folder : Path
        Folder of the tiles: SCALE/COLUMN_ROW.js.
    name : str
        Name of the image, by which its tiles call the page.
    factors : dict
        Scales and their factors, as `factors_of` returns them.
    """

    shape: tuple[int, int]
    quantization: Quantization
    folder: Path
    name: str
    factors: dict[int, tuple[int, int]]
    _pending: dict[tuple[int, int, int], _Tile] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Create the folders."""
        for scale in self.factors:
            (self.folder / str(scale)).mkdir(parents=True)

    def add(self, rows: slice, columns: slice, pixels: NDArray[np.complex64]) -> None:
        """Add the pixels of a window to the tiles of all scales. Windows must not overlap."""
        power = self.quantization.power(pixels)
        self._add(max(self.factors), rows.start, columns.start, power)

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
            height, width = (
                min(n - index * SIDE, SIDE)
                for n, index in zip(
                    shape_of(self.shape, self.factors[scale]), (row, column), strict=True
                )
            )
            self._pending[key] = _Tile(np.empty((height, width), np.float32), height * width)
        return self._pending[key]

    def _finish(self, scale: int, row: int, column: int) -> None:
        """Write a tile, and add its means to the next coarser scale."""
        power = self._pending.pop((scale, row, column)).power
        path = self.folder / str(scale) / f"{column}_{row}.js"
        packed = base64.b64encode(_packed(self.quantization.encode(power))).decode()
        path.write_text(f'clsasTile("{self.name}/{scale}/{column}_{row}","{packed}");\n')
        if scale > min(self.factors):
            coarser, own = self.factors[scale - 1], self.factors[scale]
            down, across = coarser[0] // own[0], coarser[1] // own[1]
            top, left = row * SIDE // down, column * SIDE // across
            self._add(scale - 1, top, left, block_means(power, power > 0, down, across))


def _packed(levels: NDArray[np.uint8]) -> bytes:
    """Return levels compressed by zlib.

    Speckle has no strings that repeat, and is coded by its distribution: searching for strings
    would take three times as long for tiles 1 % larger. Z_RLE still packs constant areas.
    """
    packing = zlib.compressobj(1, zlib.DEFLATED, 15, 9, zlib.Z_RLE)
    return packing.compress(levels.tobytes()) + packing.flush()
