"""Conversion of grids, images, range lines and echoes to xarray, with coordinates and units."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from clsas.engine.data import validate
from clsas.engine.data.decibels import largest_amplitude
from clsas.engine.data.extras import needed
from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.signal.echoes import Echoes

if TYPE_CHECKING:
    import xarray

_KINDS = (Grid, RangeLines, Image, Echoes)
_AXES = {
    "x": {"units": "m", "long_name": "Along-track"},
    "y": {"units": "m", "long_name": "Across-track"},
    "z": {"units": "m", "long_name": "Height", "positive": "up"},
}
_ON_MAP = {
    "x": {"units": "m", "long_name": "Easting", "standard_name": "projection_x_coordinate"},
    "y": {"units": "m", "long_name": "Northing", "standard_name": "projection_y_coordinate"},
    "z": _AXES["z"],
}
GRID_MAPPING = "spatial_ref"
"""Name of the coordinate that describes the map, as rioxarray calls it."""
_NAMES = {
    "samples": "Samples",
    "tx_m": "Transmitter position",
    "rx_m": "Receiver position",
    "rx_velocity_m_s": "Receiver velocity",
    "look_direction": "Look direction",
    "bank_numbers": "Receiver bank",
    "first_range_m": "Range of the first sample",
    "start_time_s": "Time of the first sample after transmission",
}
_UNITS = {"_m_s": "m s-1", "_m": "m", "_s": "s", "_hz": "Hz"}


@overload
def to_xarray(obj: Image) -> xarray.DataArray: ...
@overload
def to_xarray(obj: Grid | RangeLines | Echoes) -> xarray.Dataset: ...
def to_xarray(obj: Grid | RangeLines | Image | Echoes) -> xarray.DataArray | xarray.Dataset:
    """Return an object as an xarray DataArray or Dataset, with coordinates in metres.

    An object with a georeference gets the coordinate `spatial_ref`, a grid mapping of the CF
    conventions. Where x points east, x and y are easting and northing; otherwise `easting` and
    `northing` of every pixel are further coordinates of images and grids.

    An image becomes a DataArray of its level in dB, relative to its largest amplitude. Neither
    pictures nor netCDF accept complex numbers. The complex pixels are therefore split into the
    coordinates `pixels_real` and `pixels_imag`, so that `.plot()` and `.to_netcdf()` work;
    `a["pixels_real"] + 1j * a["pixels_imag"]` restores them. The amplitude at 0 dB is
    `attrs["reference"]`.

    A grid becomes a Dataset that consists of coordinates. Range lines and echoes become Datasets
    over (channel, sample) with complex `samples`.

    Parameters
    ----------
    obj : Grid, RangeLines, Image or Echoes
        The object. Its arrays are shared, not copied.

    Returns
    -------
    xarray.DataArray or xarray.Dataset
        A DataArray for an image, a Dataset for any other object. The attributes `long_name` and
        `units` follow the CF conventions. Numbers that belong to no axis are attributes, with the
        unit in their name.

    Raises
    ------
    ImportError
        If xarray is not installed, or the object has a georeference and pyproj is not.
    TypeError
        If `obj` is of another type.

    Examples
    --------
    >>> import clsas
    >>> grid = clsas.Grid.plane((-5, 5, 101), (20, 40, 201))
    >>> data = clsas.to_xarray(grid)
    >>> dict(data.sizes)
    {'x': 101, 'y': 201}
    >>> float(data.y.max()), data.y.units
    (40.0, 'm')
    """
    with needed("to_xarray"):
        import xarray
    validate.instance("obj", obj, *_KINDS)
    match obj:
        case Grid():
            return xarray.Dataset(coords=_grid_coordinates(obj), attrs={"Conventions": "CF-1.11"})
        case Image():
            return _image_to_xarray(xarray, obj)
    return _channels_to_xarray(xarray, obj)


def _image_to_xarray(xarray: ModuleType, image: Image) -> xarray.DataArray:
    dims = grid_dims(image.grid)
    coordinates = _grid_coordinates(image.grid)
    for name, words in (("real", "Real"), ("imag", "Imaginary")):
        attributes = {"units": "1", "long_name": f"{words} part of the pixels"}
        coordinates[f"pixels_{name}"] = (dims, getattr(image.pixels, name), attributes)
    reference = largest_amplitude(image.pixels)
    of_level = {
        "long_name": "Amplitude re max",
        "units": "dB",
        "reference": reference,
        "comment": "20 log10(amplitude / reference); minus infinity where a pixel is 0",
        "Conventions": "CF-1.11",
    }
    if image.georeference is not None:
        of_level["grid_mapping"] = GRID_MAPPING
    # DataArray would copy the coordinates; Dataset shares them.
    level = {"amplitude_db": (dims, image.db(), of_level)}
    return xarray.Dataset(level, coordinates)["amplitude_db"]


def grid_dims(grid: Grid) -> tuple[str, ...]:
    """Return the names of the axes of an image on a grid."""
    if grid.points_m is not None:
        return tuple(f"point_{axis}" for axis in range(len(grid.shape)))
    return ("y", "x") if grid.has_axes else ("row", "column")


def _grid_coordinates(grid: Grid) -> dict[str, Any]:
    """Return the coordinates of a grid, and those on the map if it has a georeference."""
    place, dims = grid.georeference, grid_dims(grid)
    words = _ON_MAP if place is not None and place.is_north_up else _AXES
    if grid.has_axes:
        x, y = grid.axes_m
        z: tuple[Any, Any] = ((), grid.positions_m(slice(1), slice(1))[0, 0, 2])
        if grid.height_m is not None:
            z = (dims, grid.positions_m()[..., 2])
        known: dict[str, Any] = {
            "x": ("x", x, words["x"] | {"axis": "X"}),
            "y": ("y", y, words["y"] | {"axis": "Y"}),
            "z": (*z, dict(words["z"])),
        }
    else:
        positions = np.moveaxis(grid.positions_m(), -1, 0)
        known = {
            name: (dims, values, dict(words[name]))
            for name, values in zip("xyz", positions, strict=True)
        }
    if place is None:
        return known
    if not place.is_north_up:
        on_map = np.moveaxis(place.to_map(grid.positions_m()), -1, 0)
        for name, axis, values in zip(("easting", "northing"), "xy", on_map, strict=False):
            known[name] = (dims, values, dict(_ON_MAP[axis]))
    return known | {GRID_MAPPING: ((), 0, grid_mapping(place))}


def grid_mapping(place: Georeference) -> dict[str, Any]:
    """Return the attributes of a grid mapping of the CF conventions.

    Those whose names begin with `clsas_` restore the georeference.
    """
    of_map = place.map_crs().to_cf()
    fields_given = {
        f"clsas_{field.name}": getattr(place, field.name)
        for field in fields(place)
        if getattr(place, field.name) is not None
    }
    words = {"long_name": "Coordinate reference system", "spatial_ref": of_map["crs_wkt"]}
    return {**of_map, **words, **fields_given}


def _channels_to_xarray(xarray: ModuleType, obj: RangeLines | Echoes) -> xarray.Dataset:
    steps = np.arange(obj.samples.shape[1])
    if isinstance(obj, RangeLines):
        known = {"units": "m", "long_name": "Range from the first sample"}
        offset: dict[str, Any] = {"range_offset_m": ("sample", steps * obj.range_step_m, known)}
    else:
        known = {"units": "s", "long_name": "Time from the first sample"}
        offset = {"time_offset_s": ("sample", steps / obj.sample_rate_hz, known)}
    variables: dict[str, Any] = {}
    attributes: dict[str, Any] = {}
    for field in fields(obj):
        name, value = field.name, getattr(obj, field.name)
        if isinstance(value, np.ndarray):
            dims = ("channel", "sample" if name == "samples" else "axis")[: value.ndim]
            unit = next((unit for end, unit in _UNITS.items() if name.endswith(end)), "1")
            known = {"long_name": _NAMES.get(name, name), "units": unit}
            variables[name] = (dims, value, known)
        elif isinstance(value, Georeference):
            offset[GRID_MAPPING] = ((), 0, grid_mapping(value))
        elif is_dataclass(value):
            attributes |= {
                f"{name}_{part.name}": getattr(value, part.name) for part in fields(value)
            }
        elif value is not None:
            attributes[name] = value
    return xarray.Dataset(variables, {**offset, "axis": ["x", "y", "z"]}, attributes)
