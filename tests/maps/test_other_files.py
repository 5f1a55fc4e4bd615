"""netCDF files, and pictures with world files."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from placed import TARGET_M, UTM_NORTH, at, local, scene

import clsas

rasterio = pytest.importorskip("rasterio")
xarray = pytest.importorskip("xarray")
pytest.importorskip("h5netcdf")


def test_netcdf_has_a_history_and_is_reproducible(tmp_path, monkeypatch):
    image = clsas.Image(np.ones((2, 3), np.complex64), clsas.Grid.plane((0, 1, 3), (9, 10, 2)))
    path = tmp_path / "a.nc"

    def history():
        clsas.export(image, path)
        with xarray.open_dataset(path, engine="h5netcdf") as data:
            return data.attrs["history"]

    before = datetime.now(UTC).replace(microsecond=0)
    stamp, _, rest = history().partition(": ")
    assert before <= datetime.fromisoformat(stamp) <= datetime.now(UTC)
    assert rest == f"written by clsas.export of clsas {clsas.__version__}"
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1000000000")
    assert history().startswith("2001-09-09T01:46:40Z: written by clsas")
    first = path.read_bytes()
    history()
    assert path.read_bytes() == first
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "yesterday")
    with pytest.raises(ValueError, match="SOURCE_DATE_EPOCH must be a whole number of seconds"):
        history()
    assert path.read_bytes() == first


@pytest.mark.parametrize("shape", [(6,), (6, 1), (3, 2, 1)])
def test_images_on_points_become_netcdf_and_nothing_else(shape, tmp_path):
    points_m = np.random.default_rng(1).uniform(0, 1, (*shape, 3))
    image = clsas.Image(np.ones(shape, np.complex64), clsas.Grid.points(points_m))
    clsas.export(image, tmp_path / "a.nc")
    with xarray.open_dataset(tmp_path / "a.nc") as found:
        assert found["pixels_real"].size == 6
    for name in ("a.tif", "a.nitf", "a.png"):
        with pytest.raises(ValueError, match=r"points|plane|georeference"):
            clsas.export(image, tmp_path / name)
        assert not (tmp_path / name).exists()


def test_netcdf_says_how_the_image_was_formed(tmp_path):
    track_m = np.outer(np.arange(64), [0.02, 0, 0])
    point = clsas.PointTargets([[0.6, 20, 0]])
    lines = clsas.simulate_lines(track_m, track_m, point, carrier_hz=1e5, bandwidth_hz=2e4)
    image = clsas.wavenumber(lines, clsas.Grid.plane((0.4, 0.8, 16), (19.8, 20.2, 16)))
    clsas.export(image, tmp_path / "a.nc")
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as data:
        assert data.attrs["method"] == "wavenumber"
        assert data.attrs["plan"] == "with motion compensation"
        assert data.attrs["lines_digest"] == image.formed.lines_digest
        assert "tolerance_db" not in data.attrs  # none was requested


@pytest.mark.parametrize("place", [UTM_NORTH, local(90.0), local(217.0), None], ids=str)
def test_netcdf_restores_the_image_and_its_place(place, tmp_path):
    pytest.importorskip("rioxarray")
    image, _ = scene(place or UTM_NORTH)
    image = clsas.Image(image.pixels, replace(image.grid, georeference=place))
    clsas.export(image, tmp_path / "a.nc")
    assert (tmp_path / "a.nc").read_bytes()[:4] == b"\x89HDF"  # netCDF 4
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as data:
        data.load()
    assert data.attrs["Conventions"] == "CF-1.11"
    pixels = data.pixels_real.values + 1j * data.pixels_imag.values
    np.testing.assert_array_equal(pixels, image.pixels)
    assert data.attrs["reference_amplitude"] == 1.0  # as in a GeoTIFF and in stores
    level = np.where(image.pixels == 0, np.nan, image.db(reference=1.0))
    np.testing.assert_allclose(data.amplitude_db, level, atol=1e-4)
    assert data.amplitude_db.dtype == np.float32
    if place is not None and not place.is_projected:
        assert data.attrs["origin_latitude_deg"] == place.latitude_deg  # a number
        assert data.attrs["x_axis_heading_deg"] == place.heading_deg
    if place is None:
        assert data.amplitude_db.dims == ("y", "x")
        assert "spatial_ref" not in data.coords
        return
    crs = place.map_crs()
    assert data.rio.crs.to_wkt() == rasterio.crs.CRS.from_wkt(crs.to_wkt()).to_wkt()
    on_map = place.to_map(image.grid.positions_m())
    if place.is_north_up:
        assert data.amplitude_db.dims == ("y", "x")
        east, north = np.meshgrid(data.x, data.y)
        names = {"x": "projection_x_coordinate", "y": "projection_y_coordinate"}
        with rasterio.open(f"netcdf:{tmp_path / 'a.nc'}:amplitude_db") as file:
            turn, read = file.transform, file.read(1)
        assert (turn.a, turn.e) == pytest.approx((0.25, -0.2))
        row, column = np.unravel_index(np.nanargmax(read), read.shape)
        np.testing.assert_allclose(
            at(turn, column + 0.5, row + 0.5), TARGET_M[:2] + on_map[0, 0, :2] - [10, 40], atol=0.15
        )
    else:
        assert data.amplitude_db.dims == ("row", "column")
        east, north = data.easting, data.northing
        names = {"easting": "projection_x_coordinate", "northing": "projection_y_coordinate"}
        assert "x" not in data.coords
    np.testing.assert_allclose(east, on_map[..., 0], atol=1e-9)
    np.testing.assert_allclose(north, on_map[..., 1], atol=1e-9)
    for name, standard in names.items():
        assert data[name].attrs["standard_name"] == standard
    for name in ("amplitude_db", "pixels_real", "pixels_imag"):
        assert "spatial_ref" in (data[name].attrs | data[name].encoding)["grid_mapping"]
    assert data.spatial_ref.attrs["long_name"] == "Coordinate reference system"


@pytest.mark.slow
@pytest.mark.parametrize("place", [UTM_NORTH, local(217.0)], ids=str)
def test_a_png_has_its_place_on_the_map(place, tmp_path):
    pytest.importorskip("matplotlib")
    image, _ = scene(place)
    dark = clsas.Image(np.where(np.abs(image.pixels) > 1, image.pixels, 1e-6), image.grid)
    clsas.export(dark, tmp_path / "a.png", colour_map="gray", north_arrow=False)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.pgw", "a.png", "a.png.aux.xml"]
    shift = [500_000, 6_700_000, 0] if place.is_projected else 0
    east, north, _ = place.to_map(TARGET_M + shift)
    with rasterio.open(tmp_path / "a.png") as file:
        column, row = at(~file.transform, east, north)
        picture = file.read(1)
        wkt = file.crs.to_wkt()
        placed = file.transform
    assert ("UTM" if place.is_projected else "Transverse Mercator about 60.39") in wkt
    window = picture[int(row) - 12 : int(row) + 13, int(column) - 12 : int(column) + 13]
    rows, columns = np.nonzero(window > 100)
    assert abs(rows.mean() + 0.5 + int(row) - 12 - row) < 1
    assert abs(columns.mean() + 0.5 + int(column) - 12 - column) < 1
    # Programs without GDAL read the world file, whose origin is the centre of the first pixel.
    a, d, b, e, c, f = map(float, (tmp_path / "a.pgw").read_text().split())
    np.testing.assert_allclose((a, b, d, e), (placed.a, placed.b, placed.d, placed.e))
    np.testing.assert_allclose((c, f), at(placed, 0.5, 0.5))


@pytest.mark.slow
def test_the_centre_of_a_pixel_of_a_picture_is_where_the_image_has_it(tmp_path):
    grid = clsas.Grid.oriented(
        [10, 40, 0], [0, 2.0, 0], [2.0, 0, 0], (14, 18), georeference=local(90.0)
    )
    pixels = np.full(grid.shape, 1e-6 + 0j)
    pixels[5, 8] = 1.0
    image = clsas.Image(pixels, grid)
    clsas.export(image, tmp_path / "a.png", colour_map="gray", north_arrow=False)
    east, north, _ = grid.georeference.to_map(grid.positions_m()[5, 8])
    with rasterio.open(tmp_path / "a.png") as file:
        column, row = at(~file.transform, east, north)
        side = round(2.0 / abs(file.transform.a))  # dots per pixel of the image
        picture = file.read(1)
    assert side > 10
    near = np.indices((2 * side, 2 * side)) + np.array(
        [[[int(row) - side]], [[int(column) - side]]]
    )
    found = near[:, picture[tuple(near)] > 100].mean(axis=1) + 0.5
    np.testing.assert_allclose(found, (row, column), atol=0.1 * side)


@pytest.mark.slow
def test_files_beside_a_replaced_file_do_not_describe_the_new_one(tmp_path):
    pytest.importorskip("matplotlib")
    image, _ = scene(local(217.0))
    nowhere = clsas.Image(image.pixels, replace(image.grid, georeference=None))
    clsas.export(image, tmp_path / "a.png")
    for name in ("b.tif.aux.xml", "b.tif.ovr", "c.nc.aux.xml", "b.pgw"):
        (tmp_path / name).touch()
    clsas.export(nowhere, tmp_path / "a.png")
    clsas.export(image, tmp_path / "b.tif")
    clsas.export(nowhere, tmp_path / "c.nc")
    names = sorted(p.name for p in tmp_path.iterdir())
    assert names == ["a.png", "b.pgw", "b.tif", "c.nc"]  # b.pgw belongs to another picture


def test_a_png_of_a_vertical_plane_has_no_place_on_a_map(tmp_path):
    pytest.importorskip("matplotlib")
    grid = clsas.Grid.oriented([0, 0, -9], [0, 0, 1], [1, 0.5, 0], (9, 9), georeference=local(30.0))
    clsas.export(clsas.Image(np.ones((9, 9), complex), grid), tmp_path / "a.png")
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


@pytest.mark.slow
def test_pictures_without_a_place_stand_alone(tmp_path):
    pytest.importorskip("matplotlib")
    image, _ = scene(UTM_NORTH)
    nowhere = clsas.Image(image.pixels, replace(image.grid, georeference=None))
    clsas.export(nowhere, tmp_path / "a.png", scale_bar=True)
    clsas.export(image, tmp_path / "a.pdf", dynamic_range_db=40.0)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.pdf", "a.png"]
    with pytest.raises(ValueError, match=r"kind must be left out, since it has no effect on \.png"):
        clsas.export(image, tmp_path / "b.png", kind="db")
    with pytest.raises(ValueError, match=r"reference must be left out, .* on \.nc"):
        clsas.export(image, tmp_path / "b.nc", reference=1.0)
    for name in (".tif", "bad.", ".hidden.png"):
        with pytest.raises(ValueError, match=r"path must not begin or end with a dot, got '"):
            clsas.export(image, tmp_path / name)
    clsas.save(tmp_path / "grid.h5", image.grid)
    with pytest.raises(
        ValueError, match=r"source must contain an image or heights, got .*grid.h5 with `Grid`"
    ):
        clsas.export(tmp_path / "grid.h5", tmp_path / "b.tif")
