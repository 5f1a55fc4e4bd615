"""netCDF 4 files of images and heights, after the CF conventions."""

from __future__ import annotations

import os
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clsas.engine.data import validate
from clsas.engine.data.atomic import replacing
from clsas.engine.data.extras import needed
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.version import __version__
from clsas.files.xarrays import GRID_MAPPING, grid_dims, to_xarray
from clsas.maps.bands import bands_of
from clsas.maps.encoding import Encoding
from clsas.maps.sources import Source
from clsas.plot.canvas import DYNAMIC_RANGE_DB

if TYPE_CHECKING:
    import xarray

SUFFIXES = (".nc",)
"""Suffix of netCDF files."""

_REFERENCE = 1.0  # amplitude of 0 dB
_BYTES = 40  # memory of a pixel: complex number, level, coordinates, and the file in memory
_EPOCH = "SOURCE_DATE_EPOCH"  # variable of the environment, of reproducible-builds.org
_ALL = slice(None), slice(None)


def write(path: Path, source: Source, tags: dict[str, Any]) -> None:
    """Write a netCDF 4 file; an existing file is replaced in one step.

    Raises
    ------
    ValueError
        If the pixels do not fit into memory, heights are on points, or SOURCE_DATE_EPOCH is no
        time.
    ImportError
        If xarray or h5netcdf is not installed, or pyproj for an image with a georeference.
    OSError
        If the file cannot be written.
    """
    with needed("netCDF files"):
        import h5netcdf  # noqa: F401  xarray's message would not say how to install it
        import xarray  # noqa: F401
    if source.has_heights and source.grid.points_m is not None:
        raise ArgumentError("source", "be on a plane to have heights", "points")
    validate.memory("the pixels as netCDF", _BYTES * source.grid.size)
    data = _of_heights(source) if source.has_heights else _of_image(source)
    data = _described(data, source.grid, tags)
    source.check_unchanged()
    # HDF5 does not recover from a full disk, so the file is assembled in memory.
    content = data.to_netcdf(engine="h5netcdf")
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def _of_image(source: Source) -> xarray.Dataset:
    """Return an image with its coordinates.

    Levels are those of a GeoTIFF and of stores: relative to 1, and NaN where nothing was received.
    """
    pixels = source.read(*_ALL) if source.image is None else source.image.pixels
    image = Image(pixels, source.grid)
    array = to_xarray(image)
    level = Encoding("db", _REFERENCE, DYNAMIC_RANGE_DB).encode(np.abs(image.pixels))
    array = array.copy(data=level)
    of_level = {
        "long_name": "Amplitude re 1",
        "reference": _REFERENCE,
        "comment": "20 log10(amplitude / reference); NaN where a pixel is 0",
    }
    array.attrs = {name: v for name, v in array.attrs.items() if name != "Conventions"} | of_level
    data = array.to_dataset().reset_coords(["pixels_real", "pixels_imag"])
    return data.assign_attrs(title="Synthetic aperture image", reference_amplitude=_REFERENCE)


def _of_heights(source: Source) -> xarray.Dataset:
    """Return heights with the coordinates of their grid: the numbers of the bands of a GeoTIFF."""
    # The heights say where the pixels are; z is that of the image, which differs a little.
    data = to_xarray(source.grid).drop_vars("z")
    dims = grid_dims(source.grid)
    for band in bands_of(source, "db"):
        words = {"long_name": band.name, "units": band.unit or "1"}
        data[band.name.lower().replace(" ", "_")] = (dims, band.read(*_ALL), words)
    data["height"].attrs |= {"positive": "up", "ancillary_variables": "standard_deviation"}
    return data.assign_attrs(title="Heights from two receiver banks")


def _described(data: xarray.Dataset, grid: Grid, tags: dict[str, Any]) -> xarray.Dataset:
    """Return variables with the map, the origin and the compression of a file."""
    if grid.georeference is not None:
        for name in data.data_vars:
            data[name].attrs["grid_mapping"] = GRID_MAPPING
        if grid.has_axes and not grid.georeference.is_north_up:
            data = _with_places_on_map(data)
    origin: dict[str, Any] = {
        "Conventions": "CF-1.11",
        "source": f"clsas {__version__}",
        "history": f"{_now():%Y-%m-%dT%H:%M:%SZ}: written by clsas.export of clsas {__version__}",
        **{name.lower(): value for name, value in tags.items()},
    }
    compressed = {"zlib": True, "complevel": 1, "shuffle": True}
    for name in data.data_vars:
        data[name].encoding = {**compressed, "_FillValue": None}
    for name in data.coords:
        data[name].encoding = {"_FillValue": None}
    return data.assign_attrs(origin)


def _now() -> datetime:
    """Return the time in UTC, or that of SOURCE_DATE_EPOCH, which makes files reproducible."""
    given = os.environ.get(_EPOCH)
    if given is None:
        return datetime.now(UTC)
    try:
        return datetime.fromtimestamp(int(given), UTC)
    except (ValueError, OverflowError, OSError):
        raise ArgumentError(
            _EPOCH, "be a whole number of seconds since 1970", validate.shown(given)
        ) from None


def _with_places_on_map(data: xarray.Dataset) -> xarray.Dataset:
    """Return variables along a track with rows and columns as dimensions.

    Programs take x and y for easting and northing if there is a grid mapping. The distances along
    and across the track therefore get other names.
    """
    renamed = data.rename_dims(x="column", y="row").rename_vars(x="along_track", y="across_track")
    for name in ("along_track", "across_track"):
        del renamed[name].attrs["axis"]
    return renamed.reset_index(["along_track", "across_track"], drop=False)
