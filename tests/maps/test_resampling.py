"""North-up maps of images that are turned against the map."""

import numpy as np
import pytest
from placed import at, local
from scipy import ndimage

import clsas
from clsas.maps import geotiff
from clsas.maps.sources import windows_of

rasterio = pytest.importorskip("rasterio")

PLACE = local(33.0)
GRID = clsas.Grid.oriented([10, 40, 0], [0, 0.2, 0], [0.25, 0, 0], (60, 80), georeference=PLACE)


def speckle():
    return np.random.default_rng(1).normal(size=(*GRID.shape, 2)) @ [1, 1j]


def north_up(pixels, path, pixel_m):
    """Return the power of a north-up map, NaN where nothing was received, and its transform."""
    clsas.export(clsas.Image(pixels, GRID), path, north_up=True, pixel_m=pixel_m)
    with rasterio.open(path) as file:
        return 10 ** (file.read(1).astype(float) / 10), file.transform


def samples_of(shape, transform, count):
    """Return rows and columns of the image at `count` x `count` samples of every pixel."""
    rows, columns = (np.indices([count * n for n in shape]) + 0.5) / count
    east, north = at(transform, columns, rows)
    position_m = PLACE.from_map(np.stack([east, north, 0 * east], axis=-1))
    x_m, y_m = np.moveaxis(position_m - [10, 40, 0], -1, 0)[:2]
    return y_m / 0.2, x_m / 0.25


@pytest.mark.parametrize(("pixel_m", "count"), [(0.1, 1), (0.2, 1), (0.7, 4)])
def test_pixels_are_means_of_interpolated_power(pixel_m, count, tmp_path):
    pixels = speckle()
    found, transform = north_up(pixels, tmp_path / "a.tif", pixel_m)
    row, column = samples_of(found.shape, transform, count)
    power = ndimage.map_coordinates(np.abs(pixels) ** 2, [row, column], order=1)
    inside = (row >= 0) & (row <= 59) & (column >= 0) & (column <= 79)
    blocks = found.shape[0], count, found.shape[1], count
    expected = power.reshape(blocks).mean(axis=(1, 3))
    whole = inside.reshape(blocks).all(axis=(1, 3))
    assert whole.sum() > 200
    np.testing.assert_allclose(found[whole], expected[whole], rtol=1e-4)


@pytest.mark.parametrize("pixel_m", [0.1, 0.7])
def test_what_was_not_received_darkens_no_edge(pixel_m, tmp_path):
    pixels = np.full(GRID.shape, 2 + 0j)
    pixels[20:30, :33] = 0
    found, _ = north_up(pixels, tmp_path / "a.tif", pixel_m)
    received = np.isfinite(found)
    np.testing.assert_allclose(found[received], 4, rtol=1e-5)
    area_m2 = (pixels != 0).sum() * 0.25 * 0.2
    assert received.sum() * pixel_m**2 == pytest.approx(area_m2, rel=0.03)


@pytest.mark.parametrize("pixel_m", [0.2, 0.26, 0.7])
def test_windows_have_no_seams(pixel_m, tmp_path, monkeypatch):
    whole, _ = north_up(speckle(), tmp_path / "a.tif", pixel_m)
    monkeypatch.setattr(geotiff, "windows_of", lambda shape, *_: windows_of(shape, (16, 16)))
    pieces, _ = north_up(speckle(), tmp_path / "b.tif", pixel_m)
    np.testing.assert_allclose(pieces, whole, rtol=1e-5)
