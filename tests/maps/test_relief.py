"""Exports of heights from two banks: maps, netCDF files and pictures."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from placed import UTM_NORTH, at, in_order, local, scene
from scipy import ndimage
from stores import LINES

import clsas
from clsas.cli import main

rasterio = pytest.importorskip("rasterio")
cogeo = pytest.importorskip("rio_cogeo.cogeo")

NN2000 = clsas.Georeference.local(60.39, 5.32, -12.0, heading_deg=217.0, vertical_datum="NN2000")
SLOPE = 0.3, -0.2  # rise per metre along columns and rows


def relief(place, shape=(60, 80), seed=5):
    """Heights on a slanted plane 30 m deep, half of them masked in patches."""
    random = np.random.default_rng(seed)
    image, _ = scene(place, shape)
    origin_m, row_step_m, column_step_m = image.grid.vectors_m
    grid = clsas.Grid.oriented(
        origin_m - [0, 0, 30.0], row_step_m + [0, 0, 0.01], column_step_m + [0, 0, 0.02],
        shape, georeference=place,
    )  # fmt: skip
    mask = ndimage.gaussian_filter(random.normal(size=shape), 3.0) > 0
    height_m = random.normal(size=shape)
    return clsas.Heights(
        np.where(mask, height_m, np.nan),
        np.where(mask, random.uniform(0.01, 0.1, shape), np.nan),
        random.uniform(0.2, 1.0, shape),
        mask,
        np.full(shape, 25.0),
        np.full(shape, 0.3),
        clsas.Image(image.pixels, grid.with_height(np.where(mask, height_m, 0.0))),
        0.9,
    )


def z_of_plane_m(grid):
    """z of the plane below the heights, from its steps."""
    rows, columns = np.indices(grid.shape)
    origin_m, row_step_m, column_step_m = grid.vectors_m
    return origin_m[2] + rows * row_step_m[2] + columns * column_step_m[2]


def expected(heights, origin_m):
    """The three bands in the order of the image, with the height of the map's origin."""
    coherence = np.where(heights.mask, heights.coherence, np.nan)
    height_m = heights.height_m + z_of_plane_m(heights.image.grid) + origin_m
    return [height_m, heights.sd_m, coherence]


@pytest.mark.parametrize(("place", "origin_m"), [(UTM_NORTH, 0.0), (NN2000, -12.0)], ids=str)
def test_bands_are_height_deviation_and_coherence(place, origin_m, tmp_path):
    heights = relief(place)
    clsas.export(heights, tmp_path / "a.tif", lines=LINES)
    assert cogeo.cog_validate(tmp_path / "a.tif", strict=True) == (True, [], [])
    with rasterio.open(tmp_path / "a.tif") as file:
        assert file.dtypes == ("float32",) * 3
        assert file.descriptions == ("Height (m)", "Standard deviation (m)", "Coherence")
        assert file.units[:2] == ("m", "m")
        assert not file.units[2]
        assert np.isnan(file.nodata)
        bands = [in_order(heights.image, band, file.transform) for band in file.read()]
        tags = file.tags()
    for read, known in zip(bands, expected(heights, origin_m), strict=True):
        np.testing.assert_array_equal(np.isnan(read), ~heights.mask)
        np.testing.assert_allclose(read, known, rtol=1e-6)
    assert float(tags["WINDOW_M"]) == heights.window_m
    assert tags["CLSAS_VERSION"] == clsas.__version__
    assert float(tags["CARRIER_HZ"]) == LINES.carrier_hz
    assert tags.get("VERTICAL_DATUM") == place.vertical_datum


@pytest.mark.slow
def test_overviews_are_means_of_valid_pixels(tmp_path):
    heights = relief(UTM_NORTH, shape=(1101, 900))  # odd: the last row stands alone
    clsas.export(heights, tmp_path / "a.tif")
    with rasterio.open(tmp_path / "a.tif") as file:
        assert file.overviews(1) == [2, 4]
        finer = file.read().astype(float)
    for level in (0, 1):
        rows, columns = finer.shape[1:]
        blocks = np.pad(finer, [(0, 0), (0, rows % 2), (0, columns % 2)], constant_values=np.nan)
        blocks = blocks.reshape(3, (rows + 1) // 2, 2, (columns + 1) // 2, 2)
        count = np.isfinite(blocks).sum(axis=(2, 4))
        assert {0, 1, 4} <= set(np.unique(count))
        blocks[1] **= 2  # deviations are averaged by their squares
        total = np.nansum(blocks, axis=(2, 4))
        mean = np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
        mean[1] **= 0.5
        with rasterio.open(tmp_path / "a.tif", overview_level=level) as file:
            finer = file.read().astype(float)
        np.testing.assert_allclose(finer, mean, rtol=1e-6, atol=1e-6)


def test_a_slope_turned_north_up_stays_a_slope(tmp_path):
    place = local(217.0)
    heights = relief(place)
    grid = heights.image.grid
    slope_m = (grid.positions_m()[..., :2] - grid.vectors_m[0][:2]) @ SLOPE
    heights = replace(heights, height_m=np.where(heights.mask, slope_m, np.nan))
    clsas.export(heights, tmp_path / "a.tif", north_up=True, pixel_m=0.2)
    with rasterio.open(tmp_path / "a.tif") as file:
        assert (file.transform.a, file.transform.b, file.transform.e) == (0.2, 0.0, -0.2)
        bands, turn = file.read(), file.transform
    known = np.isfinite(bands[0])
    for band in bands:
        np.testing.assert_array_equal(np.isfinite(band), known)
    area_m2 = heights.mask.sum() * 0.25 * 0.2
    assert known.sum() * 0.2**2 == pytest.approx(area_m2, rel=0.03)
    rows, columns = np.indices(known.shape) + 0.5
    east, north = at(turn, columns, rows)
    place_m = place.from_map(np.stack([east, north, 0 * east], axis=-1))
    across, down = np.moveaxis((place_m - grid.vectors_m[0])[..., :2], -1, 0) / [[[0.25]], [[0.2]]]
    # Where all four neighbours are valid, linear interpolation of a slope is exact.
    corner = np.floor([down, across]).astype(int)
    inside = (corner >= 0).all(axis=0) & (corner[0] < 59) & (corner[1] < 79)
    whole = heights.mask[:-1, :-1] & heights.mask[1:, :-1]
    whole &= heights.mask[:-1, 1:] & heights.mask[1:, 1:]
    inside[inside] = whole[tuple(corner[:, inside])]
    assert inside.sum() > 1000
    at_m = (place_m - grid.vectors_m[0])[..., :2] @ SLOPE - 30 + 0.01 * down + 0.02 * across - 12
    np.testing.assert_allclose(bands[0][inside], at_m[inside], atol=1e-5)


@pytest.mark.exhaustive
def test_corners_far_from_a_narrow_swath_have_no_data(tmp_path):
    """Tiles of the north-up raster that the swath does not reach are not read at all."""
    heights = relief(local(217.0), shape=(9, 2000))
    clsas.export(heights, tmp_path / "a.tif", north_up=True, pixel_m=0.25)
    with rasterio.open(tmp_path / "a.tif") as file:
        bands = file.read()
    assert min(bands.shape[1:]) > 1024
    share = heights.mask.sum() * 0.25 * 0.2 / (bands[0].size * 0.25**2)
    for band in bands:
        assert np.isfinite(band).mean() == pytest.approx(share, rel=0.1)


@pytest.mark.parametrize("place", [UTM_NORTH, NN2000, None], ids=str)
def test_netcdf_has_the_numbers_of_the_bands(place, tmp_path):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    heights = relief(place or UTM_NORTH)
    grid = replace(heights.image.grid, georeference=place)
    heights = replace(heights, image=clsas.Image(heights.image.pixels, grid))
    clsas.export(heights, tmp_path / "a.nc")
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as data:
        data.load()
    origin_m = -12.0 if place == NN2000 else 0.0
    names = "height", "standard_deviation", "coherence"
    assert set(data.data_vars) == set(names)
    for name, known in zip(names, expected(heights, origin_m), strict=True):
        np.testing.assert_allclose(data[name], known, rtol=1e-14)
        of_map = data[name].attrs | data[name].encoding
        assert (of_map.get("grid_mapping") == "spatial_ref") == (place is not None)
    assert [data[name].attrs["units"] for name in names] == ["m", "m", "1"]
    assert data.attrs["window_m"] == heights.window_m
    assert data.attrs.get("vertical_datum") == (place and place.vertical_datum)


@pytest.mark.slow
def test_a_picture_has_no_world_file(tmp_path):
    pytest.importorskip("matplotlib")
    heights = relief(NN2000)
    for name in ("a.pgw", "a.png.aux.xml"):  # of an image that the picture replaces
        (tmp_path / name).touch()
    for name in ("a.png", "b.png", "a.svg"):
        colours = {"colour_map": "gray"} if name == "b.png" else {}
        clsas.export(heights, tmp_path / name, **colours)
    assert sorted(os.listdir(tmp_path)) == ["a.png", "a.svg", "b.png"]
    assert (tmp_path / "a.png").read_bytes() != (tmp_path / "b.png").read_bytes()
    assert "Standard deviation" in clsas.plot.heights(heights).axes[1].get_title()


def test_what_heights_cannot_become_is_refused(tmp_path):
    heights = relief(UTM_NORTH)
    image = heights.image
    nowhere = replace(
        heights, image=clsas.Image(image.pixels, replace(image.grid, georeference=None))
    )
    points = clsas.Grid.points(image.grid.positions_m(), georeference=UTM_NORTH)
    scattered = replace(heights, image=clsas.Image(image.pixels, points))
    for source, name, how, message in (
        (heights, "a.tif", {"kind": "complex"}, r"kind must be left out, .* on \.tif of heights$"),
        (heights, "a.tif", {"kind": "8bit"}, "kind must be left out"),
        (heights, "a.tif", {"reference": 1.0}, "reference must be left out"),
        (heights, "a.tif", {"pixel_m": 1.0}, "pixel_m must be left out, .* without `north_up`"),
        (heights, "a.png", {"dynamic_range_db": 40.0}, "dynamic_range_db must be left out"),
        (heights, "web", {}, r"path must end in \.tif or .* for heights, got '.*web'"),
        (heights, "a.nitf", {"lines": LINES}, r"path must end in \.tif or .* for heights"),
        (heights, "a.tif", {"georeference": NN2000}, "georeference must be left out"),
        (nowhere, "a.tif", {}, "source must have a georeference .*give `georeference`"),
        (scattered, "a.tif", {}, "source must be on a plane or height map"),
        (scattered, "a.nc", {}, "source must be on a plane to have heights"),
    ):
        with pytest.raises(ValueError, match=message):
            clsas.export(source, tmp_path / name, **how)
    assert not os.listdir(tmp_path)
    done = []
    clsas.export(
        nowhere, tmp_path / "a.tif", georeference=UTM_NORTH, progress=lambda *n: done.append(n)
    )
    assert done[-1][0] == done[-1][1]


def test_the_command_exports_a_file_of_heights(tmp_path, monkeypatch):
    heights = relief(UTM_NORTH)
    nowhere = replace(heights.image.grid, georeference=None)
    heights = replace(heights, image=clsas.Image(heights.image.pixels, nowhere))
    monkeypatch.chdir(tmp_path)
    clsas.save("heights.h5", heights)

    def run(*arguments):
        done = CliRunner().invoke(main, ["export", "heights.h5", *arguments])
        return done.exit_code, done.output

    code, output = run("a.tif", "--crs", "EPSG:32632", "--north-up", "--json")
    assert code == 0
    assert json.loads(output)["bytes"] == Path("a.tif").stat().st_size
    with rasterio.open("a.tif") as file:
        assert (file.count, file.crs.to_epsg()) == (3, 32632)
    code, output = run("a.tif", "--crs", "EPSG:32632", "--as", "8bit")
    assert (code, "--as must be left out" in output) == (1, True)
    code, output = run("web")
    assert (code, "must end in .tif or" in output) == (1, True)
    assert sorted(os.listdir()) == ["a.tif", "heights.h5"]
