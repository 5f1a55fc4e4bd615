import sys
from dataclasses import replace

import numpy as np
import pytest

from clsas.engine.data.georeference import Georeference
from clsas.engine.data.grid import Grid
from clsas.engine.data.image import Image
from clsas.engine.data.lines import RangeLines
from clsas.engine.data.system import Pulse
from clsas.engine.signal.echoes import Echoes
from clsas.files.xarrays import to_xarray

xarray = pytest.importorskip("xarray")

PLANE = Grid.plane(x=(1e6, 1e6 + 0.7, 5), y=(40, 41 / 3, 3), z=-1 / 3)


def objects():
    """One object of every kind, of noise."""
    random = np.random.default_rng(3)

    def noise(*shape):
        return random.normal(size=shape)

    def complex_noise(*shape):
        return (noise(*shape) + 1j * noise(*shape)).astype(np.complex64)

    return {
        "oriented": Grid.oriented(noise(3), noise(3), noise(3), (2, 3)),
        "height map": PLANE.with_height(noise(3, 5)),
        "points": Grid.points(noise(2, 3, 4, 3)),
        "image": Image(complex_noise(3, 5), PLANE),
        "image of points": Image(complex_noise(7), Grid.points(noise(7, 3))),
        "moving lines": RangeLines(
            complex_noise(4, 6), 40, 0.1, noise(4, 3), noise(4, 3), 0, 1500, noise(4, 3)
        ),
        "phase code": Echoes(
            complex_noise(4, 6), noise(4), 1e5, 1e6, [0, 0, 0], [0, 0, 0], 1500,
            Pulse.phase_code(1e6, 1e-3),
        ),
    }  # fmt: skip


OBJECTS = objects()


def test_xarray_of_an_image():
    image = OBJECTS["image"]
    array = to_xarray(image)
    assert array.dims == ("y", "x")
    for part, name in ((image.pixels.real, "pixels_real"), (image.pixels.imag, "pixels_imag")):
        np.testing.assert_array_equal(array[name], part)
        assert np.shares_memory(array[name].values, image.pixels)
    for name, axis in zip(("x", "y"), PLANE.axes_m, strict=True):
        np.testing.assert_array_equal(array[name], axis)
        assert array[name].attrs["units"] == "m"
    assert float(array.z) == -1 / 3
    corner = array.sel(x=1e6 + 0.7, y=40, method="nearest")
    assert corner["pixels_real"] + 1j * corner["pixels_imag"] == image.pixels[0, 4]
    level = 20 * np.log10(np.abs(image.pixels) / np.abs(image.pixels).max())
    np.testing.assert_allclose(array, level, atol=1e-4)
    assert array.attrs["reference"] == pytest.approx(np.abs(image.pixels).max())


def test_an_image_of_xarray_is_drawn_with_names_and_units():
    figure = pytest.importorskip("matplotlib.figure").Figure()
    to_xarray(OBJECTS["image"]).plot(ax=figure.subplots())
    axes, bar = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("Along-track [m]", "Across-track [m]")
    assert bar.get_ylabel() == "Amplitude re max [dB]"


@pytest.mark.parametrize("name", ["image", "image of points"])
def test_an_image_survives_netcdf(name, tmp_path):
    image = OBJECTS[name]
    image.to_xarray().to_netcdf(tmp_path / "image.nc")
    with xarray.open_dataarray(tmp_path / "image.nc") as read:
        xarray.testing.assert_identical(read.load(), to_xarray(image))
        pixels = read["pixels_real"].values + 1j * read["pixels_imag"].values
    np.testing.assert_array_equal(pixels, image.pixels)


@pytest.mark.parametrize("name", ["oriented", "height map", "points", "image of points"])
def test_xarray_positions_are_the_grids(name):
    obj = OBJECTS[name]
    grid = obj.grid if isinstance(obj, Image) else obj
    converted = to_xarray(obj)
    dims = converted.z.dims
    assert converted.z.shape == grid.shape
    assert converted.z.attrs["units"] == "m"
    x, y, z = (converted[axis].broadcast_like(converted.z).transpose(*dims) for axis in "xyz")
    np.testing.assert_allclose(np.stack([x, y, z], -1), grid.positions_m(), rtol=1e-15)


def test_xarray_of_lines():
    lines = OBJECTS["moving lines"]
    data = to_xarray(replace(lines, look_direction=[0, 1, 0]))
    assert data.look_direction.dims == ("channel", "axis")
    assert data.look_direction.attrs == {"long_name": "Look direction", "units": "1"}
    assert data.samples.dims == ("channel", "sample")
    assert data.tx_m.dims == ("channel", "axis")
    assert data.rx_velocity_m_s.attrs["units"] == "m s-1"
    assert data.attrs["carrier_hz"] == 0
    assert data.first_range_m.attrs["units"] == data.range_offset_m.attrs["units"] == "m"
    last = (data.first_range_m + data.range_offset_m)[:, -1]
    np.testing.assert_allclose(last, lines.last_range_m)
    np.testing.assert_array_equal(data.rx_m.sel(axis="z"), lines.rx_m[:, 2])


def test_xarray_of_echoes():
    data = to_xarray(OBJECTS["phase code"])
    assert data.attrs["pulse_carrier_hz"] == 1e6
    assert len(data.attrs["pulse_code"]) == 13
    assert data.time_offset_s[1] == 1e-5
    assert data.start_time_s.attrs["units"] == "s"


def test_xarray_names_bad_input(monkeypatch):
    with pytest.raises(TypeError, match="obj must be of type Grid or"):
        to_xarray(np.ones(3))
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ImportError, match="is needed for to_xarray: pip install 'xarray>="):
        to_xarray(PLANE)


@pytest.mark.parametrize("name", ["moving lines", "phase code"])
def test_lines_survive_netcdf_as_the_documentation_splits_them(name, tmp_path):
    lines = OBJECTS[name]
    data = to_xarray(lines)
    parts = data.assign(samples_real=data.samples.real, samples_imag=data.samples.imag)
    parts.drop_vars("samples").to_netcdf(tmp_path / "lines.nc")
    with xarray.open_dataset(tmp_path / "lines.nc") as read:
        samples = read["samples_real"].values + 1j * read["samples_imag"].values
        np.testing.assert_array_equal(samples, lines.samples)
        np.testing.assert_array_equal(read["tx_m"], lines.tx_m)
        assert read.attrs["carrier_hz"] == lines.carrier_hz


def test_names_and_units_are_those_of_the_documentation():
    array = to_xarray(OBJECTS["image"])
    assert array.name == "amplitude_db"
    assert set(array.coords) == {"x", "y", "z", "pixels_real", "pixels_imag"}
    assert set(array.attrs) == {"long_name", "units", "reference", "comment", "Conventions"}
    assert array.attrs["units"] == "dB"
    for name in ("x", "y", "z"):
        assert array[name].attrs["units"] == "m"
        assert array[name].attrs["long_name"]
    assert to_xarray(OBJECTS["oriented"]).x.dims == ("row", "column")
    assert to_xarray(OBJECTS["image of points"]).dims == ("point_0",)


def test_places_are_grid_mappings():
    rioxarray = pytest.importorskip("rioxarray")
    assert rioxarray
    utm = Georeference.projected("EPSG:32632")
    grid = Grid.plane((500_000, 500_010, 11), (6_700_000, 6_700_004, 5), georeference=utm)
    array = to_xarray(Image(np.ones((5, 11), complex), grid))
    assert array.rio.crs.to_epsg() == 32632
    assert array.rio.transform()[:6] == pytest.approx(utm.affine(grid))
    assert array.x.attrs["long_name"] == "Easting"
    local = Georeference.local(60.39, 5.32, heading_deg=217)
    placed = replace(grid, georeference=local)
    array = to_xarray(Image(np.ones((5, 11), complex), placed))
    on_map = local.to_map(placed.positions_m())
    np.testing.assert_array_equal(array.easting, on_map[..., 0])
    np.testing.assert_array_equal(array.northing, on_map[..., 1])
    assert array.x.attrs["long_name"] == "Along-track"
    stored = {k: v for k, v in array.spatial_ref.attrs.items() if k.startswith("clsas_")}
    assert Georeference(**{k.removeprefix("clsas_"): v for k, v in stored.items()}) == local
    lines = RangeLines(np.ones((1, 9), complex), 1, 1, np.zeros(3), np.zeros(3), 0, 1500)
    assert "spatial_ref" in to_xarray(replace(lines, georeference=local)).coords
