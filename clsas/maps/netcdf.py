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
from clsas.engine.data.image import Image
from clsas.engine.data.validate import ArgumentError
from clsas.engine.data.version import __version__
from clsas.files.xarrays import GRID_MAPPING, grid_dims, to_xarray
from clsas.maps.georeferencing import warn_of_place
from clsas.maps.sources import Source, bands_of
from clsas.mosaics.pyramid import decibels

if TYPE_CHECKING:
    import xarray

SUFFIXES = (".nc",)
"""Suffix of netCDF files."""

_REFERENCE = 1.0  # amplitude of 0 dB
_BYTES = 40  # memory of a pixel: complex number, level, coordinates, and the file in memory
# Variable of the environment that replaces the time, which makes files reproducible: see
# reproducible-builds.org.
_EPOCH = "SOURCE_DATE_EPOCH"
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
    warn_of_place(source.grid)
    with needed("netCDF files"):
        import h5netcdf  # noqa: F401  xarray's message would not say how to install it
        import xarray  # noqa: F401
    if source.has_heights and source.grid.points_m is not None:
        raise ArgumentError("source", "be on a plane to have heights", "points")
    validate.memory("the pixels as netCDF", _BYTES * source.grid.size)
    data = _of_heights(source) if source.has_heights else _of_image(source)
    place = source.grid.georeference
    if place is not None:
        for name in data.data_vars:
            data[name].attrs["grid_mapping"] = GRID_MAPPING
        if source.grid.has_axes and not place.is_north_up:
            # Programs take x and y for easting and northing if there is a grid mapping. The
            # distances along and across the track therefore get other names.
            along = ("along_track", "across_track")
            data = data.rename_dims(x="column", y="row").rename_vars(x=along[0], y=along[1])
            for name in along:
                del data[name].attrs["axis"]
            data = data.reset_index(list(along), drop=False)
    now, given = datetime.now(UTC), os.environ.get(_EPOCH)
    if given is not None:
        try:
            now = datetime.fromtimestamp(int(given), UTC)
        except (ValueError, OverflowError, OSError):
            allowed = "be a whole number of seconds since 1970"
            raise ArgumentError(_EPOCH, allowed, validate.shown(given)) from None
    data = data.assign_attrs(
        {
            "Conventions": "CF-1.11",
            "source": f"clsas {__version__}",
            "history": f"{now:%Y-%m-%dT%H:%M:%SZ}: written by clsas.export of clsas {__version__}",
            **{name.lower(): value for name, value in tags.items()},
        }
    )
    for name in data.data_vars:
        data[name].encoding = {"zlib": True, "complevel": 1, "shuffle": True, "_FillValue": None}
    for name in data.coords:
        data[name].encoding = {"_FillValue": None}
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
    level = decibels(np.abs(image.pixels), _REFERENCE)
    array = array.copy(data=level.astype(np.float32))
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
