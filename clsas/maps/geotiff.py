"""Cloud-optimized GeoTIFF of images, mosaics and heights, written window by window.

GDAL's driver for cloud-optimized files copies a file and its overviews in the required order. The
file and each overview are first written here, since GDAL would average decibels or complex numbers
instead of power: overviews follow the rule of `clsas.mosaics.pyramid`. Memory is bounded by the
window.
"""

from __future__ import annotations

import errno
import itertools
import math
import shutil
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import reprs, validate
from clsas.engine.data.atomic import assembling
from clsas.engine.data.extras import needed
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.engine.data.threads import cores
from clsas.engine.data.validate import ArgumentError
from clsas.maps.georeferencing import Affine, Orientation, cover, warn_of_place
from clsas.maps.sources import Band, Source, bands_of, windows_of
from clsas.mosaics.pyramid import (
    BRIGHTEST,
    NOTHING,
    SQUARED,
    block_means,
    covered,
    decibels,
    eight_bits,
)
from clsas.plot.canvas import colour_map as colours_of

SUFFIXES = (".tif", ".tiff")
"""Suffixes of GeoTIFF files."""

KINDS = ("db", "complex", "8bit")
"""What the pixels of a GeoTIFF of an image may be."""

_MOST_RATIO = 16  # times that new pixels may be smaller or larger: a plain choice
_TILE = 512  # side of a tile in pixels, as GDAL and web servers prefer
_CACHE_MB = 128  # GDAL's cache of tiles: a plain choice; its default is a share of the memory
_COMPRESSION: dict[str, dict[str, str]] = {
    "complex": {"COMPRESS": "NONE"},  # noise does not compress
    "db": {"COMPRESS": "DEFLATE", "PREDICTOR": "YES", "LEVEL": "1"},
    "8bit": {"COMPRESS": "DEFLATE", "PREDICTOR": "NO"},
}

# Free space per pixel and band that an export needs at least, in bytes: the file, its overviews
# and, for complex pixels, which are not compressed, their copy.
_SPACE_BYTES = {"complex": 21, "db": 9, "8bit": 6}
_FULL_BYTES = 1 << 24  # free space below which a disk may be too full for what GDAL writes at once

Progress = Callable[[int, int], object]


def write(
    path: Path,
    source: Source,
    *,
    kind: str,
    reference: float | None,
    dynamic_range_db: float,
    colour_map: str,
    north_up: bool,
    pixel_m: float | None,
    tags: dict[str, str],
    progress: Progress | None,
) -> None:
    """Write a cloud-optimized GeoTIFF; an existing file is replaced in one step.

    Parameters
    ----------
    path : Path
    source : Source
    kind : str
        One of `KINDS`. Bands without amplitudes are float32, as those of "db".
    reference : float or None
        Amplitude of 0 dB; None for 1, or for the largest amplitude if the kind is "8bit".
    dynamic_range_db : float
        Level of the first 8-bit level below the reference, dB.
    colour_map : str
        Colours of 8-bit levels.
    north_up : bool
        True to resample the image on the axes of the map; complex pixels must lie so already.
    pixel_m : float or None
        Size of the pixels then, metres; None for the distance of the image's.
    tags : dict
        Tags of the file.
    progress : callable or None
        Called as progress(done, total).

    Raises
    ------
    ValueError
        If the grid is vertical, has no georeference or consists of points, complex pixels would be
        resampled, the source is damaged or changes, or UTF-8 cannot encode the path.
    OSError
        If the file cannot be written, for example on a full disk.
    ImportError
        If rasterio or pyproj is not installed, or matplotlib for 8-bit levels.

    Warns
    -----
    ClsasWarning
        If 8-bit levels leave out the heights of a height map, or as `warn_of_place`.
    """
    grid, place = source.grid, source.grid.georeference
    if grid.points_m is not None:
        raise ArgumentError("source", "be on a plane or height map for a GeoTIFF", "points")
    if place is None:
        raise ArgumentError(
            "source",
            "have a georeference for a GeoTIFF, since a map needs a place on Earth",
            hint="give `georeference`, or form the image by a scene with a table [georeference]",
        )
    turned = Orientation.of(source.shape, place.affine(grid))
    # Pixels that lie north-up already are kept.
    is_resampled = north_up and (pixel_m is not None or not turned.is_north_up)
    if kind == "complex" and is_resampled:
        _refuse_phase(place, grid, pixel_m)
    if grid.height_m is not None and kind == "8bit":
        validate.warn(
            "8-bit levels leave out the heights of the grid; `kind='db'` has them as second band"
        )
    warn_of_place(grid)
    with needed("GeoTIFF files"):
        import rasterio
        import rasterio.shutil
    colours = None
    if kind == "8bit":
        shades = np.linspace(0, 1, BRIGHTEST)  # of the levels above nothing, which is transparent
        rgb = colours_of(colour_map)(shades, bytes=True)[:, :3].tolist()
        colours = {level: (*each, 255) for level, each in enumerate(rgb, 1)}
        colours[NOTHING] = 0, 0, 0, 0
    bands = bands_of(source, kind)
    steps = _Steps(progress, 4 * grid.size)
    with assembling(path) as made, rasterio.Env(GDAL_CACHEMAX=_CACHE_MB):
        validate.text("path of a GeoTIFF", str(made))  # rasterio encodes it as UTF-8
        check_space(made.parent, len(bands) * _SPACE_BYTES[kind] * grid.size)
        try:
            raster = _Raster(made.parent, turned.shape, turned.affine, place.wkt(), bands)
            numbers, largest = _read(raster, source, turned, kind, is_resampled, steps)
            if is_resampled:
                raster, numbers = _resampled(raster, numbers, pixel_m, steps)
            if reference is None:
                reference = largest if kind == "8bit" and largest else 1.0
            step_db = dynamic_range_db / (BRIGHTEST - 1)
            base = _with_overviews(raster, numbers, kind, reference, step_db, steps)
            with rasterio.open(base, "r+") as file:
                file.update_tags(**tags)
                names = [f"{b.name} ({b.unit})" if b.unit else b.name for b in bands]
                units = [b.unit for b in bands]
                if bands[0].kind == "amplitude" and kind == "complex":
                    names[0] = "Complex pixels"
                elif bands[0].kind == "amplitude":
                    names[0], units[0] = f"{names[0]} (dB re {reference:.9g})", "dB"
                file.descriptions, file.units = names, units
                if colours is not None:
                    file.write_colormap(1, colours)
                    file.scales, file.offsets = (step_db,), (-dynamic_range_db - step_db,)
            rasterio.shutil.copy(
                base, made, driver="COG", OVERVIEWS="FORCE_USE_EXISTING", BLOCKSIZE=_TILE,
                BIGTIFF="IF_SAFER", NUM_THREADS=cores(), **_COMPRESSION[kind],
            )  # fmt: skip
            steps.add(4 * grid.size)
            check_whole(made)
        except Exception as error:
            if not type(error).__module__.startswith("rasterio"):
                raise
            raise_cause(made.parent, str(error))
        source.check_unchanged()


def _refuse_phase(place: Georeference, grid: Grid, pixel_m: float | None) -> NoReturn:
    """Raise the error for complex pixels that would be resampled: it says what to do instead."""
    hint = "leave `north_up` out; the transform of the file then states how the image is rotated"
    if grid.is_planar and not any(step_m[2] for step_m in grid.vectors_m[1:]):
        onto = place.north_up(grid, pixel_m)
        names = ("origin_m", "row_step_m", "column_step_m")
        table = [
            f"{name} = {each.tolist()}" for name, each in zip(names, onto.vectors_m, strict=True)
        ]
        hint = (
            "form the image on `georeference.north_up(grid, pixel_m)`, and export it without "
            "`north_up`. In a scene file, this grid is\n  "
        ) + "\n  ".join(["[grid]", *table, f"shape = {list(onto.shape)}"])
    raise ArgumentError(
        "kind", "not be complex with `north_up`, since only power can be resampled", hint=hint
    )


class _Steps:
    """Pixels done of all passes over an image, for a progress bar."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._total, self._done = progress, total, 0

    def add(self, pixels: int) -> None:
        self._done += pixels
        if self._progress is not None:
            self._progress(min(self._done, self._total), self._total)


@dataclass(frozen=True, eq=False)
class _Raster:
    """Pixels of files in a folder: where they lie on the map, and their bands."""

    folder: Path
    shape: tuple[int, int]
    affine: Affine
    crs: str
    bands: tuple[Band, ...]

    def created(
        self, path: Path, shape: tuple[int, int], dtype: Any, nodata: float | None = None
    ) -> Any:
        """Return a new file of plain tiles, open for writing, that covers the whole raster."""
        import rasterio

        a, b, c, d, e, f = self.affine
        across, down = self.shape[1] / shape[1], self.shape[0] / shape[0]
        affine = rasterio.Affine(a * across, b * down, c, d * across, e * down, f)
        count = len(self.bands)
        tiles = math.prod(math.ceil(n / _TILE) for n in shape)
        check_space(self.folder, count * tiles * _TILE**2 * np.dtype(dtype).itemsize)
        return rasterio.open(
            path, "w", driver="GTiff", height=shape[0], width=shape[1], count=count, dtype=dtype,
            crs=self.crs, transform=affine, nodata=nodata, INTERLEAVE="BAND", BIGTIFF="YES",
            tiled=True, blockxsize=_TILE, blockysize=_TILE,
        )  # fmt: skip


def _read(
    raster: _Raster,
    source: Source,
    turned: Orientation,
    kind: str,
    is_resampled: bool,
    steps: _Steps,
) -> tuple[Path, float]:
    """Write all bands in the order of the raster; return the file and the largest amplitude.

    What is resampled are numbers whose means make sense, such as power, and NaN without a value.
    """
    path, largest = raster.folder / "first.tif", 0.0
    dtype: Any = np.complex64 if kind == "complex" else np.float32
    nodata = None
    if is_resampled:
        dtype, nodata = np.float64, math.nan
    with raster.created(path, raster.shape, dtype, nodata) as file:
        for rows, columns in source.windows():
            window = turned.window(rows, columns)
            for number, band in enumerate(raster.bands, 1):
                values = band.read(rows, columns)
                if band.kind == "amplitude":
                    largest = max(largest, float(np.abs(values).max()))
                if is_resampled:
                    values = values.astype(np.float64)
                    if band.kind == "amplitude":
                        values[values == 0] = math.nan
                    if band.kind in SQUARED:
                        values *= values
                _put(file, number, window, turned.turned(values))
            steps.add(values.size)
    check_whole(path)
    return path, largest


def _resampled(
    raster: _Raster, given: Path, pixel_m: float | None, steps: _Steps
) -> tuple[_Raster, Path]:
    """Return the raster on the axes of the map, and the file with its numbers.

    GDAL interpolates bilinearly between pixels that have data. Pixels that are larger than those of
    the image are means of several such samples, at least half of which have data.
    """
    import rasterio
    from rasterio.enums import Resampling
    from rasterio.warp import reproject

    a, b, _, d, e, _ = raster.affine
    finest_m = min(math.hypot(a, d), math.hypot(b, e))
    pixel_m = pixel_m or finest_m
    if not finest_m / _MOST_RATIO <= pixel_m <= finest_m * _MOST_RATIO:
        raise ArgumentError(
            "pixel_m",
            f"be {finest_m / _MOST_RATIO:g} to {finest_m * _MOST_RATIO:g} m, since the pixels "
            f"of the image are {finest_m:g} m apart",
            f"{pixel_m:g} m",
        )
    left, bottom, height, width = cover(raster.shape, raster.affine, pixel_m)
    west_m, north_m = left * pixel_m, (bottom + height) * pixel_m
    affine = (pixel_m, 0.0, west_m, 0.0, -pixel_m, north_m)
    share = math.prod(raster.shape) / (height * width)
    turned = replace(raster, shape=(height, width), affine=affine)

    path = raster.folder / "north_up.tif"
    count = max(math.ceil(pixel_m / finest_m - 1e-6), 1)  # samples along each side of a pixel
    step_m = pixel_m / count
    with (
        rasterio.open(given) as file,
        turned.created(path, turned.shape, np.float32) as new,
    ):
        for rows, columns in windows_of(turned.shape, (_TILE // count, _TILE // count)):
            shape = count * (rows.stop - rows.start), count * (columns.stop - columns.start)
            left_m, top_m = west_m + columns.start * pixel_m, north_m - rows.start * pixel_m
            for number, band in enumerate(raster.bands, 1):
                samples = np.full(shape, math.nan)
                # Without XSCALE, GDAL blurs pixels by a ratio that it derives from each window.
                reproject(
                    rasterio.band(file, number), samples, dst_crs=file.crs,
                    dst_transform=rasterio.Affine(step_m, 0.0, left_m, 0.0, -step_m, top_m),
                    dst_nodata=math.nan, resampling=Resampling.bilinear, XSCALE=1, YSCALE=1,
                )  # fmt: skip
                if band.kind in SQUARED:
                    samples = np.sqrt(samples)
                if band.kind == "amplitude":
                    samples = np.nan_to_num(samples)
                means = block_means(band.kind, samples, 1.0, count, count, least=count**2 / 2)
                _put(new, number, (rows, columns), means)
            steps.add(int(means.size * share))
    check_whole(path)
    given.unlink()
    return turned, path


def _with_overviews(
    raster: _Raster, given: Path, kind: str, reference: float, step_db: float, steps: _Steps
) -> Path:
    """Write the encoded pixels of a file of numbers and of its overviews; return the first file.

    Every level is computed from the numbers of the one before. GDAL finds the overviews of a file
    in file.ovr, and further ones in file.ovr.ovr.
    """
    import rasterio
    from rasterio.windows import Window

    dtype, nodata = {
        "complex": (np.complex64, None),  # 0, a complex number, says itself that nothing was there
        "db": (np.float32, math.nan),
        "8bit": (np.uint8, NOTHING),
    }[kind]
    base = path = raster.folder / "base.tif"
    numbers, shape, factor = given, raster.shape, 1
    if kind == "complex":
        numbers = given.rename(base)  # they are encoded already
    while True:
        finer, finer_shape, is_last = numbers, shape, max(shape) <= _TILE
        shape = (shape[0] + 1) // 2, (shape[1] + 1) // 2
        numbers = raster.folder / f"numbers-{2 * factor}.tif"
        with ExitStack() as opened:
            file = opened.enter_context(rasterio.open(finer))
            encoded = coarser = None
            if path != finer:
                encoded = opened.enter_context(raster.created(path, finer_shape, dtype, nodata))
            if not is_last:
                coarser = opened.enter_context(raster.created(numbers, shape, np.float32))
            for rows, columns in windows_of(finer_shape):
                halves = tuple(slice(p.start // 2, (p.stop + 1) // 2) for p in (rows, columns))
                weights = np.multiply.outer(
                    covered(rows.start, rows.stop - rows.start, factor, raster.shape[0]),
                    covered(columns.start, columns.stop - columns.start, factor, raster.shape[1]),
                )
                for number, band in enumerate(raster.bands, 1):
                    values = file.read(number, window=Window.from_slices(rows, columns))
                    if encoded is not None:
                        pixels = values
                        if band.kind == "amplitude" and kind == "db":
                            pixels = decibels(values, reference)
                        elif band.kind == "amplitude" and kind == "8bit":
                            pixels = eight_bits(values, reference, step_db)
                        _put(encoded, number, (rows, columns), pixels)
                    if coarser is not None:
                        values = np.abs(values) if band.kind == "amplitude" else values.real
                        means = block_means(band.kind, values, weights)
                        _put(coarser, number, halves, means)
                steps.add(weights.size * 3 // 4)
        check_whole(path)
        if path != finer:
            finer.unlink()
        if is_last:
            return base
        check_whole(numbers)
        path, factor = path.with_name(f"{path.name}.ovr"), 2 * factor


def _put(file: Any, number: int, window: tuple[slice, ...], values: NDArray) -> None:
    """Write a window of a band of a file."""
    from rasterio.windows import Window

    values = np.ascontiguousarray(values, file.dtypes[0])
    file.write(values, number, window=Window.from_slices(*window))


# Full disks, which GDAL does not always report


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
