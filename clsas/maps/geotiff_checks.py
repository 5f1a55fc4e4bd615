"""Checks of GeoTIFF files for a full disk, which GDAL does not always report."""

from __future__ import annotations

import errno
import itertools
import math
import shutil
import tempfile
from pathlib import Path
from typing import NoReturn

from clsas.engine.data import reprs

_FULL_BYTES = 1 << 24  # free space below which a disk may be too full for what GDAL writes at once


def check_space(folder: Path, least_bytes: int) -> None:
    """Raise OSError if a folder has too little space. GDAL's own message would be less clear."""
    free_bytes = shutil.disk_usage(folder).free
    if free_bytes < least_bytes:
        raise OSError(
            errno.ENOSPC,
            f"the export needs {reprs.quantity(least_bytes, 'bytes')} of free space in the folder "
            f"of the file, which has {reprs.quantity(free_bytes, 'bytes')}",
        )


def check_whole(path: Path) -> None:
    """Raise OSError if a file or an overview in it lacks a tile.

    GDAL does not report a full disk if it notices that only when a file is closed.
    """
    import rasterio

    size_bytes = path.stat().st_size
    with rasterio.open(path) as file:
        for band in range(1, file.count + 1):
            for level in (None, *range(len(file.overviews(band)))):
                factor = 1 if level is None else 2 ** (level + 1)
                down, across = (
                    math.ceil(n / factor / side)
                    for n, side in zip(file.shape, file.block_shapes[band - 1], strict=True)
                )
                for row, column in itertools.product(range(down), range(across)):
                    place, length = (
                        int(file.get_tag_item(f"{name}_{column}_{row}", "TIFF", band, level) or 0)
                        for name in ("BLOCK_OFFSET", "BLOCK_SIZE")
                    )
                    if not place or place + length > size_bytes:
                        raise_cause(path.parent, "a tile is missing")


def raise_cause(folder: Path, reported: str) -> NoReturn:
    """Raise the OSError of a write of GDAL that failed, of which GDAL prints the cause only.

    It is that of a full disk or quota if the folder has one, or else says what was reported.
    """
    with tempfile.TemporaryFile(dir=folder) as file:
        file.write(bytes(_FULL_BYTES))
    raise OSError(errno.EIO, f"GDAL cannot write the file ({reported})")
