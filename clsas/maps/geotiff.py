"""Cloud-optimized GeoTIFF of images, mosaics and heights, written window by window.

GDAL's driver for cloud-optimized files copies a file and its overviews in the required order. The
file and each overview are first written here, since GDAL would average decibels or complex numbers
instead of power. A pixel of an overview is the mean power of the pixels that received something;
those that did not are left out, as GDAL leaves out pixels without data. Heights and other numbers
are averaged themselves. Memory is bounded by the window.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data import validate
from clsas.engine.data.atomic import assembling
from clsas.engine.data.extras import needed
from clsas.engine.data.validate import ArgumentError
from clsas.maps.bands import Band, bands_of
from clsas.maps.encoding import Encoding, colour_table
from clsas.maps.geotiff_checks import check_space, check_whole, raise_cause
from clsas.maps.map_grids import cover
from clsas.maps.orientation import Orientation
from clsas.maps.sources import Source, windows_of

SUFFIXES = (".tif", ".tiff")
"""Suffixes of GeoTIFF files."""

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

Progress = Callable[[int, int], object]


@dataclass(frozen=True)
class Options:
    """How an image becomes a GeoTIFF.

    Attributes
    ----------
    kind : str
        One of `clsas.maps.encoding.KINDS`. Bands without amplitudes are float32, as those of "db".
    north_up : bool
        True to resample the image on the axes of the map; complex pixels must lie so already.
    pixel_m : float or None
        Size of the pixels then, metres; None for the distance of the image's.
    dynamic_range_db : float
    reference : float or None
        Amplitude of 0 dB; None for 1, or for the largest amplitude if the kind is "8bit".
    colour_map : str
    """

    kind: str
    north_up: bool
    pixel_m: float | None
    dynamic_range_db: float
    reference: float | None
    colour_map: str


def resamples(turned: Orientation, *, north_up: bool, pixel_m: float | None) -> bool:
    """Return whether pixels of a raster are resampled: not if they lie north-up already."""
    return north_up and (pixel_m is not None or not turned.is_north_up)


def write(
    path: Path, source: Source, options: Options, tags: dict[str, str], progress: Progress | None
) -> None:
    """Write a cloud-optimized GeoTIFF; an existing file is replaced in one step.

    Raises
    ------
    ValueError
        If the grid is vertical, the source is damaged or changes, or UTF-8 cannot encode the path.
    OSError
        If the file cannot be written, for example on a full disk.
    ImportError
        If rasterio or pyproj is not installed, or matplotlib for 8-bit levels.
    """
    with needed("GeoTIFF files"):
        import rasterio
    colours = colour_table(options.colour_map) if options.kind == "8bit" else None
    with assembling(path) as made, rasterio.Env(GDAL_CACHEMAX=_CACHE_MB):
        validate.text("path of a GeoTIFF", str(made))  # rasterio encodes it as UTF-8
        folder = made.parent
        bands = bands_of(source, options.kind)
        check_space(folder, len(bands) * _SPACE_BYTES[options.kind] * source.grid.size)
        try:
            _Export(folder, source, bands, options, progress).write(made, tags, colours)
        except Exception as error:
            if not type(error).__module__.startswith("rasterio"):
                raise
            raise_cause(folder, str(error))
        source.check_unchanged()


@dataclass(frozen=True, eq=False)
class _Level:
    """An overview, or the raster itself.

    Attributes
    ----------
    numbers : Path
        File with its amplitudes and the numbers of other bands.
    path : Path
        File with its encoded pixels, which may be the same.
    shape : (rows, columns)
    """

    numbers: Path
    path: Path
    shape: tuple[int, int]

    def below(self, folder: Path) -> _Level | None:
        """Return the overview with half as many rows and columns, or None if none is needed."""
        if max(self.shape) <= _TILE:
            return None
        # GDAL finds the overviews of a file in file.ovr, and further ones in file.ovr.ovr.
        path = self.path.with_name(f"{self.path.name}.ovr")
        shape = (self.shape[0] + 1) // 2, (self.shape[1] + 1) // 2
        return _Level(folder / f"numbers-{shape[0]}-{shape[1]}.tif", path, shape)


class _Steps:
    """Pixels done of all passes over an image, for a progress bar."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._total, self._done = progress, total, 0

    def add(self, pixels: int) -> None:
        self._done += pixels
        if self._progress is not None:
            self._progress(min(self._done, self._total), self._total)


class _Export:
    """One export: the passes over the image, with files in a temporary folder."""

    def __init__(
        self,
        folder: Path,
        source: Source,
        bands: tuple[Band, ...],
        options: Options,
        progress: Progress | None,
    ) -> None:
        place = source.grid.georeference
        assert place is not None  # the caller has checked it
        self._folder, self._source, self._options = folder, source, options
        self._bands = bands
        self._crs = place.wkt()
        shape = source.grid.shape
        self._turned = Orientation.of((shape[0], shape[1]), place.affine(source.grid))
        self._shape, self._affine = self._turned.shape, self._turned.affine
        self._resamples = resamples(
            self._turned, north_up=options.north_up, pixel_m=options.pixel_m
        )
        self._largest = 0.0
        self._steps = _Steps(progress, 4 * source.grid.size)

    def write(self, path: Path, tags: dict[str, str], colours: dict | None) -> None:
        """Write the file from the passes: read, resample, encode with overviews, and copy."""
        how = self._options
        first = self._folder / "first.tif"
        self._read(first)
        if self._resamples:
            first = self._resampled(first)
        reference = how.reference
        if reference is None:
            reference = self._largest if how.kind == "8bit" and self._largest else 1.0
        encoding = Encoding(how.kind, reference, how.dynamic_range_db)
        base = self._levels(first, encoding, tags, colours)
        self._copy(base, path)
        check_whole(path)

    def _read(self, path: Path) -> None:
        """Write all bands in the order of the raster; summands of means if it is resampled."""
        dtype: Any = np.complex64 if self._options.kind == "complex" else np.float32
        nodata = None
        if self._resamples:
            dtype, nodata = np.float64, math.nan
        with self._created(path, self._shape, dtype, nodata) as file:
            for rows, columns in self._source.windows():
                window = self._turned.window(rows, columns)
                for number, band in enumerate(self._bands, 1):
                    values = band.read(rows, columns)
                    if band.is_amplitude:
                        self._largest = max(self._largest, float(np.abs(values).max()))
                    if self._resamples:
                        values = band.summands(values)
                    self._put(file, window, self._turned.turned(values), number)
                self._steps.add(values.size)
        check_whole(path)

    def _resampled(self, given: Path) -> Path:
        """Write means of summands on the axes of the map; return the file.

        GDAL interpolates bilinearly between pixels that have data. Pixels that are larger than
        those of the image are means of several such samples.
        """
        import rasterio
        from rasterio.enums import Resampling
        from rasterio.warp import reproject

        a, b, _, d, e, _ = self._affine
        finest_m = min(math.hypot(a, d), math.hypot(b, e))
        pixel_m = self._options.pixel_m or finest_m
        if not finest_m / _MOST_RATIO <= pixel_m <= finest_m * _MOST_RATIO:
            raise ArgumentError(
                "pixel_m",
                f"be {finest_m / _MOST_RATIO:g} to {finest_m * _MOST_RATIO:g} m, since the pixels "
                f"of the image are {finest_m:g} m apart",
                f"{pixel_m:g} m",
            )
        left, bottom, height, width = cover(self._shape, self._affine, pixel_m)
        west_m, north_m = left * pixel_m, (bottom + height) * pixel_m
        share = self._source.grid.size / (height * width)
        self._shape = height, width
        self._affine = (pixel_m, 0.0, west_m, 0.0, -pixel_m, north_m)

        path = self._folder / "north_up.tif"
        count = max(math.ceil(pixel_m / finest_m - 1e-6), 1)  # samples along each side of a pixel
        step_m = pixel_m / count
        with _opened(given) as file, self._created(path, self._shape, np.float32) as new:
            for rows, columns in windows_of(self._shape, (_TILE // count, _TILE // count)):
                shape = count * (rows.stop - rows.start), count * (columns.stop - columns.start)
                left_m, top_m = west_m + columns.start * pixel_m, north_m - rows.start * pixel_m
                affine = rasterio.Affine(step_m, 0.0, left_m, 0.0, -step_m, top_m)
                for number, band in enumerate(self._bands, 1):
                    samples = np.full(shape, math.nan)
                    # Without XSCALE, GDAL blurs pixels by a ratio that it derives from each window.
                    reproject(
                        rasterio.band(file, number), samples, dst_crs=file.crs,
                        dst_transform=affine, dst_nodata=math.nan,
                        resampling=Resampling.bilinear, XSCALE=1, YSCALE=1,
                    )  # fmt: skip
                    means = band.means(samples, count, count**2 / 2)
                    self._put(new, (rows, columns), means, number)
                self._steps.add(int(means.size * share))
        check_whole(path)
        given.unlink()
        return path

    def _levels(
        self, first: Path, encoding: Encoding, tags: dict[str, str], colours: dict | None
    ) -> Path:
        """Write the encoded file and its overviews beside it; return the file."""
        base = self._folder / "base.tif"
        level: _Level | None = _Level(first, base, self._shape)
        if encoding.kind == "complex":  # encoded already
            level = _Level(first.rename(base), base, self._shape)
        while level is not None:
            below = level.below(self._folder)
            self._encode(level, below, encoding)
            if level.path == base:
                self._describe(base, encoding, tags, colours)
            if level.numbers != level.path:
                level.numbers.unlink()
            level = below
        return base

    def _encode(self, level: _Level, below: _Level | None, encoding: Encoding) -> None:
        """Write a level from its numbers, and the numbers of the level below it."""
        with ExitStack() as opened:
            file = opened.enter_context(_opened(level.numbers))
            encoded = smaller = None
            if level.path != level.numbers:
                encoded = opened.enter_context(
                    self._created(level.path, level.shape, encoding.dtype, encoding.nodata)
                )
            if below is not None:
                smaller = opened.enter_context(
                    self._created(below.numbers, below.shape, np.float32)
                )
            for window in windows_of(level.shape):
                halves = tuple(slice(p.start // 2, (p.stop + 1) // 2) for p in window)
                for number, band in enumerate(self._bands, 1):
                    values = _get(file, number, *window)
                    if encoded is not None:
                        pixels = encoding.encode(values) if band.is_amplitude else values
                        self._put(encoded, window, pixels, number)
                    if smaller is not None:
                        self._put(smaller, halves, band.halved(values), number)
                self._steps.add(values.size * 3 // 4)
        for written in (level.path, None if below is None else below.numbers):
            if written is not None:
                check_whole(written)

    def _describe(
        self, path: Path, encoding: Encoding, tags: dict[str, str], colours: dict | None
    ) -> None:
        """Add tags, colours and the meaning of the bands to a file."""
        with _opened(path, "r+") as file:
            file.update_tags(**tags)
            file.descriptions = [_description(band, encoding) for band in self._bands]
            of_amplitude = "" if encoding.kind == "complex" else "dB"
            file.units = [of_amplitude if b.is_amplitude else b.unit for b in self._bands]
            if colours is not None:
                file.write_colormap(1, colours)
                scale, offset = encoding.scale_and_offset
                file.scales, file.offsets = (scale,), (offset,)

    def _copy(self, base: Path, path: Path) -> None:
        """Copy a file with its overviews in the order of a cloud-optimized file."""
        from rasterio.shutil import copy

        copy(
            base, path, driver="COG", OVERVIEWS="FORCE_USE_EXISTING", BLOCKSIZE=_TILE,
            BIGTIFF="IF_SAFER", NUM_THREADS="ALL_CPUS", **_COMPRESSION[self._options.kind],
        )  # fmt: skip
        self._steps.add(4 * self._source.grid.size)

    def _created(
        self, path: Path, shape: tuple[int, int], dtype: Any, nodata: float | None = None
    ) -> Any:
        """Return a new file of plain tiles, open for writing, that covers the whole raster."""
        import rasterio

        a, b, c, d, e, f = self._affine
        across, down = self._shape[1] / shape[1], self._shape[0] / shape[0]
        affine = rasterio.Affine(a * across, b * down, c, d * across, e * down, f)

        tiles = math.prod(math.ceil(n / _TILE) for n in shape)
        bands = len(self._bands)
        check_space(self._folder, bands * tiles * _TILE**2 * np.dtype(dtype).itemsize)
        tiled = {"tiled": True, "blockxsize": _TILE, "blockysize": _TILE, "BIGTIFF": "YES"}
        return rasterio.open(
            path, "w", driver="GTiff", height=shape[0], width=shape[1], count=bands, dtype=dtype,
            crs=self._crs, transform=affine, nodata=nodata,
            INTERLEAVE="BAND", **tiled,
        )  # fmt: skip

    def _put(self, file: Any, window: Any, values: NDArray, number: int) -> None:
        from rasterio.windows import Window

        file.write(
            np.ascontiguousarray(values, file.dtypes[0]), number, window=Window.from_slices(*window)
        )


def _opened(path: Path, mode: str = "r") -> Any:
    import rasterio

    return rasterio.open(path, mode)


def _get(file: Any, number: int, rows: slice, columns: slice) -> NDArray:
    """Return a window of a band of a file."""
    from rasterio.windows import Window

    return file.read(number, window=Window.from_slices(rows, columns))


def _description(band: Band, encoding: Encoding) -> str:
    """Return what a band of an encoded file contains, with the unit."""
    if not band.is_amplitude:
        return f"{band.name} ({band.unit})" if band.unit else band.name
    if encoding.kind == "complex":
        return "Complex pixels"
    return f"{band.name} (dB re {encoding.reference:.9g})"
